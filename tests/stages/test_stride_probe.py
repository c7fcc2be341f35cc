"""The stride probe: nothing moves on a flat floor, and the ground never jumps."""

import dataclasses
import functools
from typing import Any

import jax
import numpy as np
import pytest

import jaxik
from jaxik import HARD
from jaxik.maths.gate import AbstractGate, Smooth
from jaxik.stages.inputs import Inputs
from reference import characters, maths, sample_poses
from reference.terrain import Terrain as PlainTerrain
from support.cases import QUICK, RIG
from support.clips import (
    FLAT,
    FRAMES,
    animate,
    assert_close,
    to_frames,
    to_ik,
    to_rig,
    to_terrain,
)
from support.strides import walk

JOINTS = ("hip", "knee", "ankle", "toe")
run = jax.jit(jaxik.run, compiler_options=QUICK)


def level_blocks(*tops: tuple[float, float, float]) -> PlainTerrain:
    """Three level blocks, each given by where it starts and ends forward, and its height, m.

    Missing blocks repeat the last one: equal shapes share a program.
    """
    triangles = []
    for near, far, height in (*tops, *(tops[-1:] * 3))[:3]:
        a, b, c, d = ([x, height, z] for x in (-2.0, 2.0) for z in (near, far))
        triangles += [[a, b, c], [b, d, c]]
    return PlainTerrain(maths.Y, triangles=np.array(triangles))


# Flat floor.


@pytest.mark.parametrize("known", [True, False], ids=["known", "unknown"])
def test_nothing_changes_on_a_flat_floor(known: bool):
    frames = to_frames(walk(RIG, FRAMES, known=known, heading=0.4, start=(0.3, 0.0, -0.2)))
    legs = np.linalg.norm(frames.pose.ankle.pos - frames.pose.hip.pos, axis=-1)
    assert legs.max() > 0.99 * (sample_poses.THIGH + sample_poses.SHIN), (
        "knees are straight and heels rise"
    )
    ik = to_ik({"lock.enabled": True}, "stride")
    result = run(ik, to_rig(RIG), to_terrain(FLAT), frames)
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


@functools.partial(jax.jit, compiler_options=QUICK)
def heights(ground: Any, frames: jaxik.Frame, gate: AbstractGate = HARD) -> jax.Array:
    """Ground height under the left ankle by the probe of `stride`, m (frames).

    Feet swing as animated, so that edges on the way have to be cleared.
    """
    ik, rig = to_ik({"probe.swing_as_animated": True}, "stride"), to_rig(RIG)

    def height(frame: jaxik.Frame) -> jax.Array:
        inputs = Inputs(rig, ground, frame, gate)
        contact = ik.contact.sense(inputs)
        ground_hits = ik.probe.sense(inputs, contact, ik.target.foot_height)
        return ground_hits.ankle.point[0, 1]

    return jax.vmap(height)(frames)


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
    height = np.asarray(heights(to_terrain(ground), swing(FINE)))
    assert height[-1] == pytest.approx(end, abs=1e-12)
    assert 0.1 < height.max() <= highest + 1e-12
    coarse, fine = (np.abs(np.diff(height[::step])).max() for step in (8, 1))
    assert coarse < 0.02 and fine < coarse / 6, "at a jump both would be equally large"


def test_a_predicted_stride_hardly_depends_on_decisions_that_are_hardly_blurred():
    walked = walk(RIG, len(FINE), hz=800.0, known=False, start=(0.0, 0.0, -1.0))
    ground, frames = to_terrain(STEP_UP), to_frames(walked)
    hard = np.asarray(heights(ground, frames))
    assert np.ptp(hard) > 0.2, "the walk goes up the step"
    blurred = heights(ground, frames, Smooth(1e-5))
    np.testing.assert_allclose(blurred, hard, rtol=0, atol=1e-5)


def test_a_cliff_and_its_edge_do_not_change_the_ground():
    assert np.abs(heights(to_terrain(CLIFF), swing(FINE))).max() == 0.0
    along_edge = swing(np.full(801, 0.6), following=np.linspace(0.4, 0.6, 801))
    assert np.abs(heights(to_terrain(CLIFF), along_edge)).max() == 0.0


def test_a_step_fades_out_gradually_as_it_becomes_too_high():
    """Between 0.6 and 0.7 m down, the foot returns to the height of its last foothold."""
    drops, arrived = np.linspace(0.5, 0.8, 61), swing(np.full(801, 1.0))
    grounds = [to_terrain(level_blocks((-3.0, 0.5, 0.0), (0.5, 3.0, -drop))) for drop in drops]
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
    edges = np.arange(0.15, 1.4, 0.3)  # so that both footholds lie in the middle of a tread
    steps = [(edge, edge + 0.3, 0.15 * (index + 1)) for index, edge in enumerate(edges)]
    stairs = [
        level_blocks((-3.0, 0.15, 0.0), *pair) for pair in zip(steps, steps[1:], strict=False)
    ]
    ledge = level_blocks((-3.0, 0.9, 0.0), (0.9, 3.0, 0.75))
    triangles = np.concatenate([part.triangles for part in stairs])
    climbed = heights(to_terrain(PlainTerrain(maths.Y, triangles=triangles)), frames)
    assert climbed[-1] == pytest.approx(0.75, abs=1e-12)
    assert np.abs(np.diff(climbed)).max() < 0.01
    assert np.abs(heights(to_terrain(ledge), frames)[: len(FINE) // 2]).max() < 0.2


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
    result = run(to_ik(values, "stride"), to_rig(RIG), to_terrain(FLAT), frames)
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
