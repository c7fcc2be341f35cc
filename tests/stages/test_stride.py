"""The preset `stride`: the ground under its feet never jumps.

Also soles with too little ground, which slide along themselves to where more of them has some; and
feet that swing over uneven ground, later, higher, and with the toes pointed down.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from jaxik.maths import quat
from jaxik.stages import effector
from jaxik.stages.probe.swing import bump
from jaxik.world.frame import GroundHits
from reference import characters, maths
from reference.stages import stride_probe as reference
from reference.terrain import Terrain as PlainTerrain
from support.cases import RIG
from support.clips import animate, assert_close, at, to_frames, to_ik, to_terrain
from support.gradients import finite_jacobian
from support.probing import BLOCKS, ground_under, level_blocks, quad
from support.strides import WAYS, walk

# The ground under a swinging foot.


def sensed_ground(ik: jaxik.FootIK, ground: PlainTerrain, frames: jaxik.Frame) -> GroundHits:
    """What the probe finds; strides that leave ways out say so, to share a program with others."""
    missing = [name for name in WAYS if getattr(frames.stride, name) is None]
    zeros = dict.fromkeys(missing, jnp.zeros_like(frames.stride.last_ws))
    stride = dataclasses.replace(frames.stride, **zeros)
    return ground_under(ik, to_terrain(ground), dataclasses.replace(frames, stride=stride))


def swing(fractions: np.ndarray, last: Any = 0.0, following: Any = 0.8) -> jaxik.Frame:
    """Feet that swing from `last` to `following`, m forward, each one value or one per frame."""
    frame = animate(RIG, count=1)[0]
    frames = []
    for fraction, start, end in np.broadcast(fractions, last, following):
        sideways = frame.toe.pos * [1.0, 0.0, 0.0]
        stride = characters.Stride(
            standing=np.zeros(2),
            last_ws=sideways + start * maths.Z,
            next_ws=sideways + end * maths.Z,
            fraction=np.full(2, fraction),
            known=np.ones(2),
        )
        ahead = maths.lerp(start, end, maths.smooth01(fraction)) - frame.toe.pos[0, 2]
        root = frame.world_from_model._replace(pos=ahead * maths.Z)
        frames.append(dataclasses.replace(frame, stride=stride, world_from_model=root))
    return to_frames(frames)


def heights(ground: PlainTerrain, frames: jaxik.Frame) -> np.ndarray:
    """Ground height under the left ankle by the probe of `stride`, m (frames).

    Feet swing as animated, so that edges on the way have to be cleared.
    """
    ik = to_ik({"probe.swing_as_animated": True}, "stride")
    return np.asarray(sensed_ground(ik, ground, frames).ankle.point)[:, 0, 1]


def step_up(height: float) -> PlainTerrain:
    return level_blocks((-3.0, 0.3, 0.0), (0.3, 3.0, height))


STEP_UP, FLOOR = step_up(0.25), level_blocks((-3.0, 3.0, 0.0))
STEP_DOWN = level_blocks((-3.0, 0.5, 0.25), (0.5, 3.0, 0.0))
HURDLE, HIGH_HURDLE = (
    level_blocks((-3.0, 0.35, 0.0), (0.35, 0.45, height), (0.45, 3.0, 0.0)) for height in (0.2, 0.4)
)
CLIFF = level_blocks((-3.0, 0.5, 0.0), (0.5, 3.0, -0.8))
FINE = np.linspace(0.0, 1.0, 801)


@pytest.mark.parametrize(
    ("ground", "end", "highest"),
    [(STEP_UP, 0.25, 0.25), (STEP_DOWN, 0.0, 0.25), (HURDLE, 0.0, 0.2)],
    ids=["up", "down", "over a hurdle"],
)
def test_the_ground_of_a_swing_is_one_arc_that_leads_to_the_next_foothold(ground, end, highest):
    height = heights(ground, swing(FINE))
    assert height[-1] == pytest.approx(end, abs=1e-12)
    assert 0.1 < height.max() <= highest + 0.06
    top = np.argmax(height)
    for way in (height[: top + 1], height[: top - 1 : -1]):  # from either end to the top
        assert (np.maximum.accumulate(way) - way < 1e-4).all()
    coarse, fine = (np.abs(np.diff(height[::step])).max() for step in (8, 1))
    assert coarse < 0.02 and fine < coarse / 6, "at a jump both would be equally large"


def test_a_cliff_and_its_edge_do_not_change_the_ground():
    assert np.abs(heights(CLIFF, swing(FINE))).max() == 0.0
    along_edge = swing(np.full(801, 0.6), following=np.linspace(0.4, 0.6, 801))
    assert np.abs(heights(CLIFF, along_edge)).max() == 0.0


def test_a_step_fades_out_gradually_as_it_becomes_too_high():
    """Between 0.6 and 0.7 m down, the foot returns to the height of its last foothold."""
    drops, arrived = np.linspace(0.58, 0.72, 15), swing(np.full(801, 1.0))
    grounds = [level_blocks((-3.0, 0.5, 0.0), (0.5, 3.0, -drop)) for drop in drops]
    height = np.array([heights(ground, arrived)[0] for ground in grounds])
    followed, ignored = drops < 0.6, drops > 0.7 + 1e-9
    assert_close(height[followed], -drops[followed], 1e-12)
    assert_close(height[ignored], 0.0, 1e-12)
    # 0.6 m within 0.1 m, at no more than 1.5 times the mean slope.
    assert np.abs(np.diff(height)).max() < 0.12


def test_stairs_are_climbed_that_are_as_high_as_a_ledge_that_is_refused():
    frames = swing(FINE, following=1.4)
    path = 0.5 * frames.world_from_model.pos[:, 2]  # the game has the root on the stairs
    frames = frames.translated(path[:, None] * np.array([0.0, 1.0, 0.0]))
    # The last foothold lies in the middle of a tread, the next one is moved there.
    treads = [(0.3 * n - 0.15, 0.3 * n + 0.15, 0.15 * n) for n in range(1, 6)]
    climbed = heights(level_blocks((-3.0, 0.15, 0.0), *treads), frames)
    assert climbed[-1] == pytest.approx(0.75, abs=1e-12)
    assert np.abs(np.diff(climbed)).max() < 0.01
    ledge = level_blocks((-3.0, 0.9, 0.0), (0.9, 3.0, 0.75))
    assert np.abs(heights(ledge, frames)[: len(FINE) // 2]).max() < 0.2


# Soles with too little ground.

HEEL, TOE = 0.07, 0.04  # m, of the soles behind the ankle and ahead of the ball
PLACES = np.linspace(-0.3, 0.3, 801)  # m, forward


@functools.cache
def standing() -> jaxik.Frame:
    """The left foot standing flat with its ball at each of the places `PLACES`."""
    frames = swing(np.zeros(801), PLACES, PLACES)
    stride = dataclasses.replace(frames.stride, standing=jnp.ones((801, 2)))
    return dataclasses.replace(frames, stride=stride)


def slides(ground: PlainTerrain, frames: Any = None, **values: float) -> tuple[np.ndarray, ...]:
    """The slide of the left foot, m, its support and the height of its ground, m (frames)."""
    frames = frames or standing()
    ik = to_ik({f"probe.{name}": value for name, value in values.items()}, "stride")
    hits = sensed_ground(ik, ground, frames)
    ankles = frames.world_from_model.pos[:, None] + frames.pose.ankle.pos
    found = (hits.ankle.point - ankles)[..., 2], hits.support, hits.ankle.point[..., 1]
    return tuple(np.asarray(x)[:, 0] for x in found)


DROP_AHEAD = level_blocks((-3.0, 0.0, 0.0), (0.0, 3.0, -0.25))
DROP_BEHIND = level_blocks((-3.0, 0.0, -0.25), (0.0, 3.0, 0.0))
WALL_BEHIND = level_blocks((-3.0, 0.0, 0.25), (0.0, 3.0, 0.0))


@pytest.mark.parametrize("slope", [(0, 0, 0), (0.4, 0, 0), (-0.3, 0.2, 0.1)])
def test_a_plane_supports_the_whole_sole_and_moves_no_foot(slope):
    forward, left, height = slope
    corners = ((-4, -4), (-4, 4), (4, 4), (4, -4))
    plane = quad(*((x, left * x + forward * z + height, z) for x, z in corners)) * BLOCKS
    slide, support, _ = slides(PlainTerrain(maths.Y, triangles=np.array(plane)))
    assert_close([slide, support], [0.0 * slide, 1.0 + 0.0 * slide], 1e-9)


def test_the_slope_under_a_ball_goes_no_further_than_the_ground_under_the_ankle():
    """On a root of 7 cm, whose flanks are of 54 degrees."""
    profile = np.array(
        [[-3.0, 0.0], [-0.08, 0.0], [-0.03, 0.07], [0.03, 0.07], [0.08, 0.0], [3.0, 0.0]]
    )
    sides = [
        quad((-2.0, low, near), (-2.0, high, far), (2.0, high, far), (2.0, low, near))
        for (near, low), (far, high) in zip(profile[:-1], profile[1:], strict=True)
    ]
    ground = PlainTerrain(maths.Y, triangles=np.array(sum([*sides, sides[-1]], [])))
    frames = standing()
    slide, _, height = slides(ground, frames)
    ankle = (frames.world_from_model.pos[:, None] + frames.pose.ankle.pos)[:, 0, 2] + slide
    assert np.abs(height - np.interp(ankle, *profile.T)).max() < 0.075
    settled = np.abs(np.diff(slide)) < 1e-6
    assert np.abs(np.diff(height))[settled].max() < 0.01, "over 0.5 mm"


def test_toes_may_hang_over_an_edge():
    slide, support, height = slides(DROP_AHEAD)
    on_top = (PLACES < 0) & (height > -0.1)
    assert (slide[on_top] == 0).all()
    assert_close([support[on_top].min(), support[on_top].max()], [9 / 11, 1.0], 1e-9)


def test_a_heel_over_a_drop_slides_onto_the_block_of_its_ball():
    slide, support, height = slides(DROP_BEHIND)
    on_block = (PLACES > 0.005) & (np.abs(height) < 0.1)
    # Shares of the sole on ground ahead of 0 m.
    before, after = (np.clip((x + TOE) / sole(), 0.0, 1.0) for x in (PLACES, PLACES + slide))
    assert (slide[on_block & (before > 0.65)] == 0).all()
    lacking = on_block & (before < 0.4)
    assert lacking.sum() > 10 and (slide[lacking] > 0.04).all()
    assert (after[lacking] > before[lacking] + 0.1).all()
    # Points lie along the sole in tenths, so that the shares of both differ by a point at most.
    assert np.abs(support - after)[on_block].max() < 0.12


def test_a_standing_foot_that_turns_over_an_edge_keeps_its_place():
    """It turns on its ball by up to 50 degrees to either side, its heel over a drop."""
    frames = swing(np.zeros(801), 0.02, 0.02)
    turns = [maths.from_axis_angle(maths.Y, angle) for angle in np.linspace(-0.9, 0.9, 801)]
    pose, turn = frames.pose, jnp.asarray(turns)[:, None]
    arm = quat.rotate(turn, pose.ankle.pos - pose.toe.pos)
    ankle = jaxik.Transform(pose.toe.pos + arm, quat.multiply(turn, pose.ankle.rot))
    frames = dataclasses.replace(frames, pose=dataclasses.replace(pose, ankle=ankle))

    def moved(**headings: Any) -> np.ndarray:
        """How the left foot slides, m, level (frames 2)."""
        stride = dataclasses.replace(frames.stride, **headings)
        turned = dataclasses.replace(frames, stride=stride)
        hits = sensed_ground(to_ik({}, "stride"), DROP_BEHIND, turned)
        return np.asarray(hits.ankle.point - frames.world_from_model.pos[:, None] - ankle.pos)[
            :, 0, ::2
        ]

    stood = jnp.broadcast_to(jnp.array([0.0, 0.1, 2.0]), (801, 2, 3))  # neither level nor unit
    slid = moved(last_ahead_ws=stood, next_ahead_ws=stood)
    assert_close(slid - slid[0], 0.0, 1e-12)
    assert abs(slid[0, 1]) > 0.02 and slid[0, 0] == pytest.approx(0.0, abs=1e-12)
    assert np.abs(np.diff(moved(), axis=0)).max() > 0.02, "judged by where it points now, it jumps"


def test_a_heel_in_a_wall_slides_out_of_it_or_the_ball_onto_it():
    slide, support, height = slides(WALL_BEHIND)
    near, ball = np.abs(PLACES - 0.05) < 0.2, PLACES + slide
    assert support[near].min() > 0.8
    on_top = height > 0.2
    assert 0.3 < on_top[near].mean() < 0.8 and ball[near & on_top].max() <= 0.0
    heel = ball + TOE - sole()
    assert heel[near & ~on_top].min() > -0.1 * sole()
    # The foot goes to the nearer of both places: only between them it moves by more than a point.
    moved = np.abs(np.diff(ball[near]))
    assert (moved > 0.11 * sole()).sum() == 1


def sole() -> float:
    """Length of a sole, m."""
    pose = at(standing().pose, (0, 0))
    return HEEL + float(pose.toe.pos[2] - pose.ankle.pos[2]) + TOE


def test_a_ball_over_a_narrow_gap_slides_to_its_rim_however_deep_it_is():
    """Deeper than a foot can step down, too: the rims are over the ground below the foot."""
    for depth in (0.3, 0.61):
        gap = level_blocks((-3.0, -0.03, 0.0), (-0.03, 0.03, -depth), (0.03, 3.0, 0.0))
        slide, _, height = slides(gap)
        assert np.abs(height).max() < 1e-6
        assert np.abs(slide[np.abs(PLACES) < 0.02]).min() > 0.02


def test_a_lower_limit_makes_slides_shorter():
    """They go in tenths of a sole, of 0.026 m, and no further than they need to."""
    longest = [np.abs(slides(DROP_BEHIND, max_slide=x)[0]).max() for x in (0.0, 0.06, 0.1)]
    np.testing.assert_allclose(longest, [0.0, 0.052, 0.077], rtol=0, atol=2e-3)


def test_a_swinging_foot_slides_gradually_from_one_foothold_to_the_next():
    frames = swing(np.linspace(0.0, 1.0, 801), last=-0.6, following=0.12)
    slide, *_ = slides(WALL_BEHIND, frames)
    assert slide[0] == 0 and slide[-1] > 0.09
    assert (np.diff(slide) >= 0).all() and np.diff(slide).max() < 0.001


def test_predicted_footholds_and_feet_without_ground_do_not_slide():
    slide, support, _ = slides(WALL_BEHIND, use_strides=False)
    assert (slide == 0).all() and support.min() < 0.6
    for ground, values in ((level_blocks((50.0, 51.0, 0.0)), {}), (WALL_BEHIND, {"layers": 0})):
        slide, support, _ = slides(ground, **values)
        assert (slide == 0).all() and (support == 0).all()


# Swings.


@functools.cache
def walked() -> jaxik.Frame:
    """A walk of 90 frames, the last repeated so often that it shares a program with the rest."""
    frames = to_frames(walk(RIG, 90, start=(0.0, 0.0, -0.5)))
    return jax.tree.map(lambda x: x[np.minimum(np.arange(len(FINE)), 89)], frames)


def hits(ground: PlainTerrain, stride: dict | None = None, **values: float) -> Any:
    """What feet find with strides changed, and with these numbers of the probe."""
    frames, ik = walked(), to_ik({f"probe.{name}": x for name, x in values.items()}, "stride")
    frames = dataclasses.replace(frames, stride=dataclasses.replace(frames.stride, **stride or {}))
    return jax.tree.map(np.asarray, sensed_ground(ik, ground, frames))


def test_a_bump_is_one_at_its_peak_and_nothing_at_both_ends():
    peaks = np.array([0.23, 0.5, 0.75])
    x = np.union1d(np.linspace(0.0, 1.0, 41), peaks)
    of_all = jax.vmap(jax.vmap(jax.value_and_grad(bump), (0, None)), (None, 0))
    values, slopes = jax.jit(of_all)(jnp.asarray(x), jnp.asarray(peaks))
    expected = [[reference.bump(fraction, peak) for fraction in x] for peak in peaks]
    np.testing.assert_allclose(values, expected, rtol=0, atol=1e-6)
    np.testing.assert_allclose(values[:, np.searchsorted(x, peaks)].diagonal(), 1.0, atol=1e-6)
    assert np.isfinite(slopes).all()
    np.testing.assert_array_equal(slopes[:, [0, -1]], 0.0)


def test_only_swinging_feet_are_lifted_and_pitched_and_only_onto_a_step():
    for swing in (hits(FLOOR), hits(STEP_UP, swing_as_animated=True)):
        assert np.abs(swing.lift).max() == np.abs(swing.pitch).max() == 0.0
    swing = hits(STEP_UP, held_lift=0.0)
    assert np.abs(swing.lift[np.asarray(walked().stride.fraction) == 0.0]).max() == 0.0
    assert swing.lift.max() > 0.1 and swing.pitch.min() < -0.2


def test_strides_that_are_not_used_are_as_if_unknown():
    predicted = hits(STEP_UP, {"known": jnp.zeros_like(walked().stride.known)})
    unused, used = (hits(STEP_UP, use_strides=use) for use in (False, True))
    for name in ("lift", "pitch"):
        np.testing.assert_array_equal(getattr(unused, name), getattr(predicted, name))
    np.testing.assert_array_equal(unused.ankle.point, predicted.ankle.point)
    assert np.abs(unused.ankle.point - used.ankle.point).max() > 0.1


@pytest.mark.parametrize(
    ("name", "less", "more"), [("clearance", 0.0, 0.05), ("toe_length", 0.02, 0.08)]
)
def test_the_whole_sole_clears_an_edge(name: str, less: float, more: float):
    """The longer it is, and the less of its animated lift it may lose, the higher it goes."""
    still: dict[str, Any] = {"swing_as_animated": True, "max_slide": 0.0, "min_sole": 0.0}
    ground = [hits(HURDLE, None, **still | {name: value}) for value in (less, more)]
    swinging = np.asarray(walked().stride.fraction) > 0
    rise = (ground[1].ankle.point - ground[0].ankle.point)[..., 1][swinging]
    assert rise.max() > 0.002 and rise.min() > -1e-9


@pytest.mark.parametrize("way", [1.0, -1.0], ids=["up", "down"])
def test_steps_higher_than_captured_ones_change_a_swing_no_more(way: float):
    low, high, higher = (hits(step_up(way * height)) for height in (0.2, 0.35, 0.5))
    for name in ("lift", "pitch"):
        assert_close(getattr(higher, name), getattr(high, name), 1e-9)
        assert np.abs(getattr(low, name) - getattr(high, name)).max() > 0.02


def test_a_hurdle_higher_than_captured_ones_is_passed_no_further_away():
    low, high = (hits(ground) for ground in (HURDLE, HIGH_HURDLE))
    heights = [x.ankle.point[..., 1] + x.lift for x in (low, high)]
    assert 0.18 < (heights[1] - heights[0]).max() < 0.22  # m, for 0.2
    assert_close(high.pitch, low.pitch, 1e-9)


def test_a_foot_that_goes_round_a_hurdle_does_not_step_over_it():
    stride = walked().stride
    last, following, fraction = (
        np.asarray(x)[:, 0] for x in (stride.last_ws, stride.next_ws, stride.fraction)
    )
    middle = int(np.argmax(fraction > 0.4))
    same = np.all(last == last[middle], axis=-1)  # the frames of one swing of the left foot
    x, _, z = 0.5 * (last[middle] + following[middle])
    hurdle = level_blocks((-3.0, 3.0, 0.0), (z - 0.06, z + 0.06, 0.2, x - 0.5, x + 0.5))
    aside = jnp.broadcast_to(jnp.asarray([1.0, 0.0, 0.0]), stride.last_ws.shape)
    straight, round_it = (
        hits(hurdle, {"aside_ws": way * aside}, held_lift=0.0).lift[same, 0] for way in (0.0, 1.0)
    )
    assert straight.max() > 0.2
    assert np.abs(round_it).max() < 0.01


# Heels that rise about the ball.


def test_the_angle_has_finite_gradients_where_there_is_no_solution():
    to_ball, arm, length = zip(
        ([0.0, -0.9, 0.0], [0.0, 0.0, 0.0], 0.8),  # ankle on the ball
        ([0.0, 0.0, 0.0], [0.0, 0.1, -0.1], 0.8),  # ball on the hip
        ([0.0, -0.9, -0.9], [0.0, 0.1, 0.1], 0.8),  # cannot become so short
        ([0.0, -0.9, 0.2], [0.0, 0.0, -0.1], 0.0),  # a leg of no length
        ([0.0, -0.9, 0.0], [0.1, 0.0, 0.0], 0.8),  # along the axis
        strict=True,
    )
    axis = np.tile(-maths.X, (len(length), 1))
    finite_jacobian(effector.heel_angle, np.array(to_ball), np.array(arm), axis, np.array(length))
