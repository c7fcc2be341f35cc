"""Heels that rise about the ball, compared with a numerical search and along whole walks."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import brentq, minimize_scalar

import jaxik
from jaxik.maths import quat
from jaxik.stages import effector
from reference import maths, sample_poses
from support.cases import RIG
from support.clips import to_frames, to_ik, to_rig, to_terrain
from support.gradients import finite_jacobian
from support.strides import blocks, walk

RISES, STAYS = 0.2, 0.4  # sine of a leg's angle ahead of its hip
VALUES = {"effector.extension": 0.97, "effector.max_lift": 0.1, "probe.swing_as_animated": True}
angle_of = jax.jit(effector.heel_angle)


def search_angle(to_ball: np.ndarray, arm: np.ndarray, axis: np.ndarray, length: float) -> float:
    """The smallest angle, rad, that brings the ankle within `length`, m, or as near as possible.

    It is 0 for a leg that is short enough, or that a small rise of the heel would lengthen.
    """

    def distance(angle: float) -> float:
        return maths.length(to_ball + maths.rotate(maths.from_axis_angle(axis, -angle), arm))

    if distance(0.0) <= length or distance(1e-5) > distance(0.0):
        return 0.0
    best: Any = minimize_scalar(
        distance, bounds=(0.0, np.pi), method="bounded", options={"xatol": 1e-9}
    )
    if distance(best.x) >= length:
        return float(best.x)
    root = brentq(lambda angle: distance(angle) - length, 0.0, best.x, xtol=1e-12)
    return root  # pyright: ignore[reportReturnType]  # a float without `full_output`


def test_the_angle_of_the_heel_is_the_one_that_a_search_finds():
    """Of random balls, ankles behind and above them, and expected lengths, some too short."""
    rng = np.random.default_rng(2)
    legs = []
    for _ in range(60):
        axis = maths.unit(np.array([-1.0, *rng.normal(0.0, 0.3, 2)]), maths.X)
        to_ball = np.array([rng.normal(0.0, 0.1), -0.9, rng.uniform(-0.6, 0.6)])
        arm = np.array([rng.normal(0.0, 0.02), rng.uniform(0.0, 0.1), rng.uniform(-0.18, -0.1)])
        excess = rng.choice([-0.02, 0.01, 0.05, 0.3])
        legs.append((to_ball, arm, axis, maths.length(to_ball + arm) - excess))
    expected = np.array([search_angle(*each) for each in legs])
    actual = angle_of(*(jnp.asarray(np.stack(column)) for column in zip(*legs, strict=True)))
    assert 0.2 < (expected > 0).mean() < 0.9
    # Where the length cannot be reached, the search is only as precise as a minimum.
    np.testing.assert_allclose(np.maximum(actual, 0.0), expected, rtol=0, atol=1e-6)


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


@functools.cache
def walked() -> tuple[jaxik.Frame, jaxik.Result]:
    """A walk across uneven blocks."""
    frames = to_frames(walk(RIG, 240, start=(0.0, 0.0, -2.5), heading=0.1))
    ground = to_terrain(blocks(np.random.default_rng(5), max_height=0.2, irregular=False))
    return frames, jaxik.run(to_ik(VALUES, "stride"), to_rig(RIG), ground, frames)


def tilt_of(sensed: jaxik.world.frame.Sensed) -> jax.Array:
    """Rotations that lay level soles on the ground."""
    normal = sensed.ground.ankle.normal
    up = jnp.broadcast_to(jnp.asarray(maths.Y), normal.shape)
    return quat.shortest_arc(up, normal, sensed.ahead_ws)


@functools.cache
def heels() -> dict[str, np.ndarray]:
    """Each heel's lift and expected lift, rad; its leg's length before, after and at most, m.

    And the sine of the angle by which each leg points ahead.
    """
    frames, result = walked()
    sensed, advanced = result.trace.sensed, result.trace.advanced
    hip = sensed.hip_ws + advanced.state.pelvis.offset_ws[:, None]
    lift = np.asarray(sensed.foothold.lift)[..., None] * sensed.leg_up_ws[:, None]
    before = advanced.foothold_ws + advanced.hold.offset_ws + lift - hip
    after = advanced.effector.target_ws - hip
    animated = np.linalg.norm(sensed.ankle_ws - sensed.hip_ws, axis=-1)
    longest = np.maximum(
        VALUES["effector.extension"] * (sample_poses.THIGH + sample_poses.SHIN), animated
    )

    tilt = tilt_of(sensed)
    arm = quat.rotate(tilt, sensed.ankle_ws - sensed.ball_ws)
    level_axis = -quat.rotate(frames.world_from_model.rot, jnp.asarray(maths.X))
    axis = quat.rotate(tilt, jnp.broadcast_to(level_axis[:, None], arm.shape))
    expected = [
        search_angle(*leg)
        for legs in zip(*map(np.asarray, (before - arm, arm, axis, longest)), strict=True)
        for leg in zip(*legs, strict=True)
    ]
    ahead = np.sum(before * np.asarray(sensed.ahead_ws), -1) / np.linalg.norm(before, axis=-1)
    cosine = np.abs(np.sum(advanced.effector.rot_ws * sensed.ankle_rot_ws, axis=-1))
    return {
        "lift": 2.0 * np.arccos(np.minimum(cosine, 1.0)),
        "expected": np.reshape(expected, longest.shape),
        "ahead": ahead,
        "before": np.linalg.norm(before, axis=-1),
        "after": np.linalg.norm(after, axis=-1),
        "longest": longest,
    }


def test_on_a_walk_a_heel_rises_as_far_as_a_search_finds_within_its_limit():
    """But less, the further its leg points ahead."""
    walk, max_lift = heels(), VALUES["effector.max_lift"]
    trailing = walk["expected"][walk["ahead"] <= RISES]
    assert 0.02 < (trailing > 0.0).mean() < 0.9 and (trailing > max_lift).any()
    too_long = np.minimum(walk["expected"], max_lift)
    share = [1.0 - maths.smooth01((x - RISES) / (STAYS - RISES)) for x in walk["ahead"].ravel()]
    expected = too_long * np.reshape(share, too_long.shape)
    assert (too_long - expected).max() > 0.02
    np.testing.assert_allclose(walk["lift"], expected, rtol=0, atol=1e-6)


def test_a_rising_heel_keeps_the_leg_at_its_longest():
    walk, max_lift = heels(), VALUES["effector.max_lift"]
    rises = (walk["lift"] > 1e-6) & (walk["expected"] < max_lift) & (walk["ahead"] <= RISES)
    assert rises.mean() > 0.02
    np.testing.assert_allclose(walk["after"][rises], walk["longest"][rises], rtol=0, atol=1e-9)


def test_a_heel_stays_down_where_the_leg_is_short_enough():
    walk = heels()
    short = walk["before"] < walk["longest"] - 1e-9
    assert short.mean() > 0.1
    assert walk["lift"][short].max() < 1e-7
    np.testing.assert_allclose(walk["after"][short], walk["before"][short], rtol=0, atol=1e-12)


def test_the_ball_stays_in_place_while_the_heel_rises():
    frames, result = walked()
    sensed, advanced = result.trace.sensed, result.trace.advanced
    ball = jax.vmap(jaxik.Transform.apply)(frames.world_from_model, result.pose.toe.pos)
    lift = np.asarray(sensed.foothold.lift)[..., None] * sensed.leg_up_ws[:, None]
    normal = sensed.ground.ankle.normal
    to_ball = quat.rotate(tilt_of(sensed), sensed.ball_ws - sensed.ankle_ws)
    moved = np.asarray(ball - (advanced.foothold_ws + lift + to_ball))
    arrived = (np.asarray(result.reached) > 0) & (np.asarray(result.aimed) > 0)
    assert (heels()["lift"][arrived] > 0.02).any()
    assert np.abs(np.sum(moved * normal, axis=-1))[arrived].max() < 1e-8
    # Pitch and roll turn the foot a little about the normal, and so the ball along the ground.
    assert np.abs(moved)[arrived].max() < 0.002
