"""Feet whose soles find too little ground slide along themselves to where more of them has some."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_stride_probe import level_blocks, swing

import jaxik
from jaxik import HARD
from jaxik.maths.gate import Smooth
from jaxik.stages.inputs import Inputs
from reference import characters, maths
from reference.terrain import Terrain as PlainTerrain
from support.cases import QUICK, RIG
from support.clips import animate, assert_close, planes, to_frames, to_ik, to_rig, to_terrain

HEEL, TOE = 0.07, 0.04  # m, of the soles behind the ankle and ahead of the ball
FINE = np.linspace(-0.3, 0.3, 601)


def standing_at(places: np.ndarray) -> jaxik.Frame:
    """A frame for each place, m forward, of the ball of the left foot, which stands flat."""
    frame = animate(RIG, count=1)[0]
    frames = []
    for place in places:
        root = frame.world_from_model._replace(pos=(place - frame.toe.pos[0, 2]) * maths.Z)
        ball = frame.toe.pos + root.pos
        stride = characters.Stride(np.ones(2), ball, ball, np.zeros(2), np.ones(2))
        frames.append(dataclasses.replace(frame, world_from_model=root, stride=stride))
    return to_frames(frames)


def sense_all(ik: jaxik.FootIK, rig, ground, frames, gate):
    """The slide of the left foot, m, its support and the height of its ground, m (frames)."""

    def sense(frame):
        inputs = Inputs(rig, ground, frame, gate)
        hits = ik.probe.sense(inputs, ik.contact.sense(inputs), ik.target.foot_height)
        slide = hits.ankle.point - frame.world_from_model.apply(frame.pose.ankle.pos)
        assert hits.support is not None
        return slide[0, 2], hits.support[0], hits.ankle.point[0, 1]

    return jax.vmap(sense)(frames)


sensed = jax.jit(sense_all, compiler_options=QUICK)


def slides(ground: PlainTerrain, places: np.ndarray = FINE, **values: float):
    ik = to_ik({f"probe.{name}": value for name, value in values.items()}, "stride")
    return map(np.asarray, sensed(ik, to_rig(RIG), to_terrain(ground), standing_at(places), HARD))


def share_on_block(balls: np.ndarray) -> np.ndarray:
    """Share of a sole that lies on ground ahead of 0 m, by where its ball is."""
    pose = standing_at(np.zeros(1)).pose
    ankle_to_ball = float(pose.toe.pos[0, 0, 2] - pose.ankle.pos[0, 0, 2])
    length = HEEL + ankle_to_ball + TOE
    return np.clip((balls + TOE) / length, 0.0, 1.0)


DROP_AHEAD = level_blocks((-3.0, 0.0, 0.0), (0.0, 3.0, -0.25))
DROP_BEHIND = level_blocks((-3.0, 0.0, -0.25), (0.0, 3.0, 0.0))
WALL_BEHIND = level_blocks((-3.0, 0.0, 0.25), (0.0, 3.0, 0.0))


@pytest.mark.parametrize("slope", [(0, 0, 0), (0.4, 0, 0), (-0.3, 0.2, 0.1)])
def test_a_plane_supports_the_whole_sole_and_moves_no_foot(slope):
    slide, support, _ = slides(planes(slope))
    assert_close([slide, support], [0.0 * slide, 1.0 + 0.0 * slide], 1e-9)


def test_toes_may_hang_over_an_edge():
    slide, support, height = slides(DROP_AHEAD)
    on_top = (FINE < 0) & (height > -0.1)
    assert (slide[on_top] == 0).all()
    assert_close([support[on_top].min(), support[on_top].max()], [5 / 6, 1.0], 1e-9)


@pytest.mark.parametrize("ground", [DROP_BEHIND, WALL_BEHIND], ids=["over a drop", "in a wall"])
def test_a_heel_without_support_slides_onto_the_block_of_its_ball(ground):
    slide, support, height = slides(ground)
    on_block = (FINE > 0.005) & (np.abs(height) < 0.1)
    before, after = share_on_block(FINE), share_on_block(FINE + slide)
    assert (slide[on_block & (before > 0.85)] == 0).all()
    lacking = on_block & (before < 0.4)
    assert lacking.sum() > 20 and (slide[lacking] > 0.04).all()
    assert (after[lacking] > before[lacking] + 0.1).all()
    # Points lie along the sole in fifths, so that the shares of both differ by a point at most.
    assert np.abs(support - after)[on_block].max() < 0.25


def test_a_lower_limit_makes_slides_shorter():
    """They go in fifths of a sole, of 0.05 m, and may pass their limit by a part of one."""
    longest = [np.abs(next(slides(DROP_BEHIND, max_slide=x))).max() for x in (0.0, 0.06, 0.1)]
    np.testing.assert_allclose(longest, [0.0, 0.052, 0.104], rtol=0, atol=2e-3)


def test_a_swinging_foot_slides_gradually_from_one_foothold_to_the_next():
    frames = swing(np.linspace(0.0, 1.0, 801), last=-0.6, following=0.03)
    slide, *_ = sensed(to_ik({}, "stride"), to_rig(RIG), to_terrain(WALL_BEHIND), frames, HARD)
    assert slide[0] == 0 and slide[-1] > 0.09
    assert (np.diff(slide) >= 0).all() and np.diff(slide).max() < 0.001


def test_predicted_footholds_do_not_slide():
    slide, support, _ = slides(WALL_BEHIND, use_strides=False)
    assert (slide == 0).all() and support.min() < 0.6


def test_a_foot_without_ground_stays_and_is_not_supported():
    slide, support, _ = slides(level_blocks((50.0, 51.0, 0.0)))
    assert (slide == 0).all() and (support == 0).all()


@pytest.mark.parametrize("gate", [HARD, Smooth(1.0)], ids=["hard", "smooth"])
def test_gradients_are_finite_and_reach_both_parameters(gate):
    floats, rest = eqx.partition(to_ik({}, "stride"), eqx.is_inexact_array)

    def total(floats, frames):
        ik = eqx.combine(floats, rest)
        return sum(map(jnp.sum, sense_all(ik, to_rig(RIG), to_terrain(DROP_BEHIND), frames, gate)))

    by_system, by_frame = eqx.filter_grad(lambda x: total(*x))((floats, standing_at(FINE)))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((by_system, by_frame)))
    assert abs(float(by_system.probe.min_sole)) > 1e-3
    assert abs(float(by_system.probe.max_slide)) > 1e-6


def test_single_precision_gives_the_same():
    double = (
        to_ik({}, "stride"),
        to_rig(RIG),
        to_terrain(DROP_BEHIND),
        standing_at(FINE[::10]),
        HARD,
    )
    single = jax.tree.map(lambda x: x.astype(np.float32) if x.dtype == np.float64 else x, double)
    for actual, expected in zip(sensed(*single), sensed(*double), strict=True):
        assert actual.dtype == np.float32
        np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-4)
