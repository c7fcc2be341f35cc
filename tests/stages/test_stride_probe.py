"""The stride probe: nothing moves on a flat floor, and the ground never jumps.

Also soles with too little ground, which slide along themselves to where more of them has some, and
feet that swing over uneven ground: later, higher, and with the toes pointed down.
"""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from jaxik import HARD
from jaxik.maths.gate import AbstractGate, Smooth
from jaxik.stages.probe.swing import bump
from jaxik.world.frame import GroundHits
from jaxik.world.terrain import Terrain
from reference import characters, maths, sample_poses
from reference.stages import swing as reference
from reference.terrain import Terrain as PlainTerrain
from support.cases import RIG
from support.clips import FLAT, FRAMES, animate, assert_close, to_frames, to_ik, to_rig, to_terrain
from support.probing import BLOCKS, ground_under, level_blocks, quad
from support.rule_checks import assert_single_precision_agrees
from support.strides import walk

JOINTS = ("hip", "knee", "ankle", "toe")


# Flat floor.


@pytest.mark.parametrize("known", [True, False], ids=["known", "unknown"])
def test_nothing_changes_on_a_flat_floor(known: bool):
    frames = to_frames(walk(RIG, FRAMES, known=known, heading=0.4, start=(0.3, 0.0, -0.2)))
    legs = np.linalg.norm(frames.pose.ankle.pos - frames.pose.hip.pos, axis=-1)
    assert legs.max() > 0.99 * (sample_poses.THIGH + sample_poses.SHIN), (
        "knees are straight and heels rise"
    )
    ik = to_ik({"lock.enabled": True}, "stride")
    result = jaxik.run(ik, to_rig(RIG), to_terrain(FLAT), frames)
    assert 0.3 < np.asarray(result.trace.advanced.state.lock.locked).mean() < 0.9
    sensed, effector = result.trace.sensed, result.trace.advanced.effector
    assert_close(effector.target_ws, sensed.ankle_ws, 1e-9)
    assert_close(effector.rot_ws, sensed.ankle_rot_ws, 1e-9)
    assert np.abs(result.body.pos).max() < 1e-9
    for joint in JOINTS:
        actual, expected = (getattr(pose, joint) for pose in (result.pose, frames.pose))
        np.testing.assert_allclose(actual.pos, expected.pos, rtol=0, atol=1e-9, err_msg=joint)
        assert (
            sample_poses.rotation_angle(np.asarray(actual.rot), np.asarray(expected.rot)) < 1e-7
        ), joint


# The ground under a swinging foot.


def sensed_ground(
    ik: jaxik.FootIK, ground: Terrain, frames: jaxik.Frame, gate: AbstractGate = HARD
) -> GroundHits:
    """What the probe finds; strides that go straight say so, to share a program with the others."""
    if frames.stride.aside_ws is None:
        straight = dataclasses.replace(
            frames.stride, aside_ws=jnp.zeros_like(frames.stride.last_ws)
        )
        frames = dataclasses.replace(frames, stride=straight)
    return ground_under(ik, ground, frames, gate)


def swing(fractions: np.ndarray, last: float = 0.0, following: Any = 0.8) -> jaxik.Frame:
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


def heights(ground: PlainTerrain, frames: jaxik.Frame, gate: AbstractGate = HARD) -> np.ndarray:
    """Ground height under the left ankle by the probe of `stride`, m (frames).

    Feet swing as animated, so that edges on the way have to be cleared.
    """
    ik = to_ik({"probe.swing_as_animated": True}, "stride")
    return np.asarray(sensed_ground(ik, to_terrain(ground), frames, gate).ankle.point)[:, 0, 1]


STEP_UP = level_blocks((-3.0, 0.3, 0.0), (0.3, 3.0, 0.25))
STEP_DOWN = level_blocks((-3.0, 0.5, 0.25), (0.5, 3.0, 0.0))
HURDLE = level_blocks((-3.0, 0.35, 0.0), (0.35, 0.45, 0.2), (0.45, 3.0, 0.0))
CLIFF = level_blocks((-3.0, 0.5, 0.0), (0.5, 3.0, -0.8))
FINE = np.linspace(0.0, 1.0, 801)


@pytest.mark.parametrize(
    ("ground", "end", "highest"),
    [(STEP_UP, 0.25, 0.25), (STEP_DOWN, 0.0, 0.25), (HURDLE, 0.0, 0.2)],
    ids=["up", "down", "over a hurdle"],
)
def test_the_ground_of_a_swing_does_not_jump_and_leads_to_the_next_foothold(ground, end, highest):
    height = heights(ground, swing(FINE))
    assert height[-1] == pytest.approx(end, abs=1e-12)
    assert 0.1 < height.max() <= highest + 1e-12
    coarse, fine = (np.abs(np.diff(height[::step])).max() for step in (8, 1))
    assert coarse < 0.02 and fine < coarse / 6, "at a jump both would be equally large"


@pytest.mark.slow
def test_a_predicted_stride_hardly_depends_on_decisions_that_are_hardly_blurred():
    walked = walk(RIG, len(FINE), hz=800.0, known=False, start=(0.0, 0.0, -1.0))
    frames = to_frames(walked)
    hard = heights(STEP_UP, frames)
    assert np.ptp(hard) > 0.2, "the walk goes up the step"
    blurred = heights(STEP_UP, frames, Smooth(1e-5))
    np.testing.assert_allclose(blurred, hard, rtol=0, atol=1e-5)


def test_a_cliff_and_its_edge_do_not_change_the_ground():
    assert np.abs(heights(CLIFF, swing(FINE))).max() == 0.0
    along_edge = swing(np.full(801, 0.6), following=np.linspace(0.4, 0.6, 801))
    assert np.abs(heights(CLIFF, along_edge)).max() == 0.0


def test_a_step_fades_out_gradually_as_it_becomes_too_high():
    """Between 0.6 and 0.7 m down, the foot returns to the height of its last foothold."""
    drops, arrived = np.linspace(0.5, 0.8, 61), swing(np.full(801, 1.0))
    grounds = [level_blocks((-3.0, 0.5, 0.0), (0.5, 3.0, -drop)) for drop in drops]
    height = np.array([heights(ground, arrived)[0] for ground in grounds])
    followed, ignored = drops < 0.6, drops > 0.7 + 1e-9
    np.testing.assert_allclose(height[followed], -drops[followed], rtol=0, atol=1e-12)
    np.testing.assert_allclose(height[ignored], 0.0, rtol=0, atol=1e-12)
    assert np.abs(np.diff(height)).max() < 0.06, (
        "0.6 m within 0.1 m, at no more than 1.5 times the mean slope"
    )


def test_stairs_are_climbed_that_are_as_high_as_a_ledge_that_is_refused():
    frames = swing(FINE, following=1.4)
    path = 0.5 * frames.world_from_model.pos[:, 2]  # the game has the root on the stairs
    frames = frames.translated(path[:, None] * np.array([0.0, 1.0, 0.0]))
    # Both footholds lie in the middle of a tread.
    treads = [(0.3 * n - 0.15, 0.3 * n + 0.15, 0.15 * n) for n in range(1, 6)]
    climbed = heights(level_blocks((-3.0, 0.15, 0.0), *treads), frames)
    assert climbed[-1] == pytest.approx(0.75, abs=1e-12)
    assert np.abs(np.diff(climbed)).max() < 0.01
    ledge = level_blocks((-3.0, 0.9, 0.0), (0.9, 3.0, 0.75))
    assert np.abs(heights(ledge, frames)[: len(FINE) // 2]).max() < 0.2


# Feet that stand.


def drifting_walk() -> jaxik.Frame:
    """A walk whose standing feet slip sideways while their heels rise."""
    frames = []
    for index, frame in enumerate(walk(RIG, FRAMES)):
        root = frame.world_from_model
        moved = root._replace(pos=root.pos + 0.08 * index / 60 * maths.X)
        frames.append(dataclasses.replace(frame, world_from_model=moved))
    return to_frames(sample_poses.with_speeds(frames))


def ball_slip(hold_ball: bool) -> np.ndarray:
    """How far the solved ball of a locked foot moves along the ground in each frame, m."""
    values = {"lock.enabled": True, "lock.hold_ball": hold_ball, "lock.lock_half_life": 0.0}
    frames = drifting_walk()
    result = jaxik.run(to_ik(values, "stride"), to_rig(RIG), to_terrain(FLAT), frames)
    ball = jax.vmap(lambda root, ball: root.apply(ball))(
        frames.world_from_model, result.pose.toe.pos
    )
    locked = np.asarray(result.trace.advanced.state.lock.locked) > 0
    locked_twice = locked[1:] & locked[:-1] & (np.asarray(result.reached) > 0)[1:]
    assert locked_twice.mean() > 0.3
    return np.linalg.norm(np.diff(ball, axis=0)[..., [0, 2]], axis=-1)[locked_twice]


def test_a_locked_ball_does_not_slide_while_the_heel_rises():
    assert ball_slip(hold_ball=True).max() < 1e-9
    assert ball_slip(hold_ball=False).max() > 1e-3, "a locked ankle lets the ball slide"


# Soles with too little ground.

HEEL, TOE = 0.07, 0.04  # m, of the soles behind the ankle and ahead of the ball
PLACES = np.linspace(-0.3, 0.3, 801)  # m, forward


@functools.cache
def standing() -> jaxik.Frame:
    """The left foot standing flat with its ball at each of the places `PLACES`."""
    frame = animate(RIG, count=1)[0]
    frames = []
    for place in PLACES:
        root = frame.world_from_model._replace(pos=(place - frame.toe.pos[0, 2]) * maths.Z)
        ball = frame.toe.pos + root.pos
        stride = characters.Stride(np.ones(2), ball, ball, np.zeros(2), np.ones(2))
        frames.append(dataclasses.replace(frame, world_from_model=root, stride=stride))
    return to_frames(frames)


def sensed(ik: jaxik.FootIK, ground: Terrain, frames: jaxik.Frame, gate: AbstractGate = HARD):
    """The slide of the left foot, m, its support and the height of its ground, m (frames)."""
    hits = sensed_ground(ik, ground, frames, gate)
    assert hits.support is not None
    ankles = frames.world_from_model.pos[:, None] + frames.pose.ankle.pos
    return (hits.ankle.point - ankles)[:, 0, 2], hits.support[:, 0], hits.ankle.point[:, 0, 1]


def slides(ground: PlainTerrain, **values: float) -> list[np.ndarray]:
    ik = to_ik({f"probe.{name}": value for name, value in values.items()}, "stride")
    return [np.asarray(x) for x in sensed(ik, to_terrain(ground), standing())]


def share_on_block(balls: np.ndarray) -> np.ndarray:
    """Share of a sole that lies on ground ahead of 0 m, by where its ball is."""
    pose = standing().pose
    ankle_to_ball = float(pose.toe.pos[0, 0, 2] - pose.ankle.pos[0, 0, 2])
    length = HEEL + ankle_to_ball + TOE
    return np.clip((balls + TOE) / length, 0.0, 1.0)


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


def test_toes_may_hang_over_an_edge():
    slide, support, height = slides(DROP_AHEAD)
    on_top = (PLACES < 0) & (height > -0.1)
    assert (slide[on_top] == 0).all()
    assert_close([support[on_top].min(), support[on_top].max()], [5 / 6, 1.0], 1e-9)


@pytest.mark.parametrize("ground", [DROP_BEHIND, WALL_BEHIND], ids=["over a drop", "in a wall"])
def test_a_heel_without_support_slides_onto_the_block_of_its_ball(ground):
    slide, support, height = slides(ground)
    on_block = (PLACES > 0.005) & (np.abs(height) < 0.1)
    before, after = share_on_block(PLACES), share_on_block(PLACES + slide)
    assert (slide[on_block & (before > 0.85)] == 0).all()
    lacking = on_block & (before < 0.4)
    assert lacking.sum() > 20 and (slide[lacking] > 0.04).all()
    assert (after[lacking] > before[lacking] + 0.1).all()
    # Points lie along the sole in fifths, so that the shares of both differ by a point at most.
    assert np.abs(support - after)[on_block].max() < 0.25


def test_a_lower_limit_makes_slides_shorter():
    """They go in fifths of a sole, of 0.05 m, and may pass their limit by a part of one."""
    longest = [np.abs(slides(DROP_BEHIND, max_slide=x)[0]).max() for x in (0.0, 0.06, 0.1)]
    np.testing.assert_allclose(longest, [0.0, 0.052, 0.104], rtol=0, atol=2e-3)


def test_a_swinging_foot_slides_gradually_from_one_foothold_to_the_next():
    frames = swing(np.linspace(0.0, 1.0, 801), last=-0.6, following=0.03)
    slide, *_ = sensed(to_ik({}, "stride"), to_terrain(WALL_BEHIND), frames)
    assert slide[0] == 0 and slide[-1] > 0.09
    assert (np.diff(slide) >= 0).all() and np.diff(slide).max() < 0.001


def test_predicted_footholds_do_not_slide():
    slide, support, _ = slides(WALL_BEHIND, use_strides=False)
    assert (slide == 0).all() and support.min() < 0.6


def test_a_foot_without_ground_stays_and_is_not_supported():
    slide, support, _ = slides(level_blocks((50.0, 51.0, 0.0)))
    assert (slide == 0).all() and (support == 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("gate", [HARD, Smooth(1.0)], ids=["hard", "smooth"])
def test_gradients_of_soles_are_finite_and_reach_both_parameters(gate):
    ground = to_terrain(DROP_BEHIND)

    @eqx.filter_jit
    @eqx.filter_grad
    def slopes(inputs):
        return sum(map(jnp.sum, sensed(inputs[0], ground, inputs[1], gate)))

    frames = jax.tree.map(lambda x: x[::8], standing())
    by_system, by_frame = slopes((to_ik({}, "stride"), frames))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((by_system, by_frame)))
    assert abs(float(by_system.probe.min_sole)) > 1e-3
    assert abs(float(by_system.probe.max_slide)) > 1e-6


@pytest.mark.slow
def test_single_precision_gives_the_same_support():
    inputs = to_ik({}, "stride"), to_terrain(DROP_BEHIND), standing()
    assert_single_precision_agrees(sensed, *inputs, atol=1e-4)


# Swings.

FLOOR = level_blocks((-3.0, 3.0, 0.0))


def step_up(height: float) -> PlainTerrain:
    """A step across the way of `walked`, m."""
    return level_blocks((-3.0, 0.3, 0.0), (0.3, 3.0, height))


@functools.cache
def walked() -> jaxik.Frame:
    """A walk of 90 frames, the last repeated so often that it shares a program with the rest."""
    frames = to_frames(walk(RIG, 90, start=(0.0, 0.0, -0.5)))
    return jax.tree.map(lambda x: x[np.minimum(np.arange(len(FINE)), 89)], frames)


def hits(ground: PlainTerrain, stride: dict | None = None, **values: float) -> Any:
    """What feet find with strides changed, and with these numbers of the probe."""
    frames, ik = walked(), to_ik({f"probe.{name}": x for name, x in values.items()}, "stride")
    frames = dataclasses.replace(frames, stride=dataclasses.replace(frames.stride, **stride or {}))
    return jax.tree.map(np.asarray, sensed_ground(ik, to_terrain(ground), frames))


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


@pytest.mark.parametrize(("ground", "as_animated"), [(FLOOR, False), (STEP_UP, True)])
def test_on_a_flat_floor_or_as_animated_no_foot_is_lifted_or_pitched(ground, as_animated):
    swing = hits(ground, swing_as_animated=as_animated)
    assert np.abs(swing.lift).max() == np.abs(swing.pitch).max() == 0.0


def test_strides_that_are_not_used_are_as_if_unknown():
    predicted = hits(STEP_UP, {"known": jnp.zeros_like(walked().stride.known)})
    unused, used = (hits(STEP_UP, use_strides=use) for use in (False, True))
    for name in ("lift", "pitch"):
        np.testing.assert_array_equal(getattr(unused, name), getattr(predicted, name))
    np.testing.assert_array_equal(unused.ankle.point, predicted.ankle.point)
    assert np.abs(unused.ankle.point - used.ankle.point).max() > 0.1


def test_only_swinging_feet_are_lifted_onto_a_step():
    swing = hits(STEP_UP, held_lift=0.0)
    assert np.abs(swing.lift[np.asarray(walked().stride.fraction) == 0.0]).max() == 0.0
    assert swing.lift.max() > 0.1 and swing.pitch.min() < -0.2


@pytest.mark.parametrize("way", [1.0, -1.0], ids=["up", "down"])
def test_steps_higher_than_captured_ones_change_a_swing_no_more(way: float):
    low, high, higher = (hits(step_up(way * height)) for height in (0.2, 0.35, 0.5))
    for name in ("lift", "pitch"):
        highest = getattr(high, name)
        np.testing.assert_allclose(getattr(higher, name), highest, rtol=0, atol=1e-9)
        assert np.abs(getattr(low, name) - highest).max() > 0.02


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
