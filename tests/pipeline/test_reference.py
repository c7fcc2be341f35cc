"""The NumPy reference of `record` by itself: facts that hold whatever the JAX code does.

Symmetries are shown of the JAX code, which agrees with this reference: see `test_properties`.
"""

import math
from typing import Any

import numpy as np
import pytest

from reference import maths
from reference.characters import Ground
from reference.sample_poses import (
    ANKLE,
    make_frame,
    make_rig,
    plane,
    rotation_angle,
    standing,
    stepping,
)
from reference.systems.record import Frame, Parameters, Transform, run, step
from reference.terrain import Terrain
from support.clips import named

EXACT = 1e-9  # m and rad
RIG = make_rig(np.random.default_rng(0))
FLAT = plane(0.0, 0.0)
UNLIMITED = named("target", max_ankle_height=9.0, min_ankle_height=-9.0) | named(
    "foot", max_pitch=math.pi, min_pitch=-math.pi, max_roll=math.pi, min_roll=-math.pi
)
NO_LEAN = {"lean.forward_rate": 0.0, "lean.side_rate": 0.0}
NO_LOCK = {"lock.enabled": False}
LIFTED = make_frame(RIG, standing((0.2, 0.2)))


def solved(ground: Ground, frame: Frame, changes: dict[str, Any]) -> dict[str, np.ndarray]:
    return step(Parameters(changes), RIG, ground, None, frame)[1]


def stand(forward: float = 0.05, **changes: Any) -> Frame:
    return make_frame(RIG, standing(forward=forward), **changes)


def normal_of(slope_forward: float, slope_left: float) -> np.ndarray:
    return maths.unit(np.array([-slope_left, 1.0, -slope_forward]), maths.Y)


def assert_unchanged(output: dict[str, np.ndarray], frames: list[Frame]) -> None:
    for name in ("hip", "knee", "ankle", "toe"):
        animated = [getattr(frame, name) for frame in frames]
        assert np.allclose(output[f"{name}_pos"], [a.pos for a in animated], atol=EXACT)
        assert rotation_angle(output[f"{name}_rot"], np.array([a.rot for a in animated])) < EXACT


def test_flat_ground_leaves_standing_and_stepping_unchanged_locks_included():
    frames = [stand()] * 5
    output = run(Parameters(), RIG, FLAT, frames)
    assert_unchanged(output, frames)
    assert output["reached"].all() and output["locked"].all()
    frames = stepping(RIG)
    output = run(Parameters(UNLIMITED), RIG, FLAT, frames)
    assert_unchanged(output, frames)
    switches = np.diff(output["locked"].astype(int), axis=0)
    assert (switches == 1).any(axis=0).all() and (switches == -1).any(axis=0).all()


# Legs.


def test_the_knee_limit_keeps_the_leg_from_straightening():
    limit = math.radians(150)
    changes = {"leg.max_knee_angle": limit, "pelvis.limit": 0.0, "target.min_ankle_height": -9.0}
    output = solved(plane(0.0, 0.0, height=-0.6), stand(), NO_LEAN | NO_LOCK | changes)
    thigh = output["hip_pos"] - output["knee_pos"]
    shin = output["ankle_pos"] - output["knee_pos"]
    angles = [maths.angle_between(a, b) for a, b in zip(thigh, shin, strict=True)]
    assert not output["reached"].any()
    assert angles == pytest.approx([limit, limit], abs=1e-6)


# Feet.


@pytest.mark.parametrize("use_toe", [False, True])
def test_the_sole_takes_the_slope_of_the_ground_when_limits_are_wide(use_toe):
    rng = np.random.default_rng(5)
    for _ in range(20):
        rises = rng.uniform(-0.5, 0.5, size=2)
        root = Transform(np.zeros(3), maths.from_axis_angle(maths.Y, rng.uniform(-3, 3)))
        frame = stand(world_from_model=root)
        output = solved(plane(*rises), frame, UNLIMITED | {"probe.use_toe": use_toe})
        for leg in range(2):
            foot = maths.multiply(output["ankle_rot"][leg], RIG.ankle_from_foot[leg])
            sole = maths.rotate(root.rot, maths.rotate(foot, maths.Y))
            ahead = maths.rotate(root.rot, maths.rotate(foot, maths.Z))
            heading = maths.rotate(root.rot, maths.Z)
            assert np.allclose(sole, normal_of(*rises), atol=EXACT)
            assert abs(maths.signed_angle(heading, ahead, maths.Y)) < EXACT


def test_limits_mirror_and_stop_the_outer_edge():
    changes = {"foot.max_roll": 0.1, "foot.min_roll": -0.3, "probe.use_toe": False}
    output = solved(plane(0.0, 0.5), stand(), UNLIMITED | changes | NO_LEAN)
    tilts = []
    for leg in range(2):
        shin = maths.unit(output["ankle_pos"][leg] - output["knee_pos"][leg], -maths.Y)
        foot = maths.multiply(output["ankle_rot"][leg], RIG.ankle_from_foot[leg])
        # Limits apply to the angle between foot and shin.
        joint = -math.asin(float(RIG.side[leg] * maths.X @ shin))
        up = maths.rotate(foot, maths.Y)
        tilts.append(joint + math.atan2(-RIG.side[leg] * up[0], up[1]))
    # Ground rising to the left lifts the left foot's outer edge and lowers the right one's.
    assert tilts == pytest.approx([0.1, -0.3], abs=EXACT)


def test_the_ankle_stays_one_foot_height_above_a_slope():
    output = solved(plane(0.4, 0.0), stand(), UNLIMITED | NO_LEAN)
    assert np.allclose(output["target_ws"] @ normal_of(0.4, 0.0), ANKLE, atol=EXACT)


# Locks.


@pytest.mark.parametrize("hz", [30.0, 60.0, 120.0])
def test_a_released_offset_halves_each_half_life(hz):
    half_life, dt = 0.1, 1.0 / hz
    dragged = [stand(0.02 * i, dt=dt) for i in range(3)]
    lifted = [make_frame(RIG, standing((0.2, 0.2)), dt=dt)] * (1 + int(hz * half_life))
    changes = {"lock.lock_half_life": 0.0, "lock.unlock_half_life": half_life}
    output = run(Parameters(changes), RIG, FLAT, dragged + lifted)
    offset, locked = output["offset_ws"], output["locked"]
    assert locked[:3].all() and not locked[3:].any()
    assert np.allclose(offset[2], [0.0, 0.0, -0.04], atol=EXACT)
    assert np.allclose(offset[3], offset[2] * 2 ** (-dt / half_life), atol=EXACT)
    assert np.allclose(offset[-1], offset[3] / 2.0, atol=EXACT)


def test_a_foot_locks_again_only_below_the_threshold():
    frames = [stand(), *[LIFTED] * 3, *[stand()] * 20]
    changes = {"lock.lock_half_life": 0.0, "lock.unlock_half_life": 0.1}
    output = run(Parameters(changes | {"lock.relock_threshold": 0.3}), RIG, FLAT, frames)
    first = 4 + int(np.argmax(output["locked"][4:, 0]))
    # Free since frame 1 with a factor of 2^(-frames / 6).
    assert 2 ** (-(first - 1) / 6) <= 0.3 < 2 ** (-(first - 2) / 6)
    assert not output["locked"][1:first].any() and output["locked"][first:].all()


def test_a_lock_waits_until_the_pelvis_brings_the_leg_within_reach():
    output = run(Parameters(), RIG, plane(0.0, 0.0, -0.1), [stand()] * 2)
    assert output["locked"].tolist() == [[False, False], [True, True]]


@pytest.mark.parametrize("height", [0.0, -0.1])
def test_the_release_cone_is_measured_from_the_lowered_hip(height):
    places = [0.1 + 0.03 * i for i in range(5)]
    # The pelvis settles in the first frame, so the hip is as far from the sole as animated.
    frames = [stand(place) for place in [places[0], *places]]
    cone = math.radians(4.5)
    changes = {"lock.lock_half_life": 0.0, "lock.release_cone": cone}
    output = run(Parameters(changes), RIG, plane(0.0, 0.0, height), frames)
    angles = [math.atan2(place, 0.9 - ANKLE) for place in places]
    inside = [angle - angles[0] <= cone for angle in angles]
    assert inside == [True, True, True, False, False]
    assert output["locked"][1:].T.tolist() == [inside, inside]


# The body.


def test_the_body_sinks_to_the_lower_foot_and_gains_mean_the_same_at_any_rate():
    halves = [
        [[0.0, -0.1, -9.0], [9.0, -0.1, 0.0], [0.0, -0.1, 9.0]],
        [[0.0, 0.0, -9.0], [-9.0, 0.0, 0.0], [0.0, 0.0, 9.0]],
    ]
    left_low = Terrain(maths.Y, triangles=np.array(halves))
    output = solved(left_low, stand(), NO_LEAN)
    assert output["pelvis_height"] == pytest.approx(-0.1, abs=EXACT)
    assert np.allclose(output["body_pos"], [0.0, -0.1, 0.0], atol=EXACT)
    for hz in (30, 60, 120):
        frames = [make_frame(RIG, standing((0.2, 0.2)), dt=1 / hz)]
        frames += [stand(dt=1 / hz)] * (hz // 10)
        output = run(Parameters(NO_LEAN), RIG, left_low, frames)
        expected = -0.1 * (1.0 - (1.0 - 0.225) ** 3)
        assert output["pelvis_height"][-1] == pytest.approx(expected, abs=EXACT)


def test_a_lean_rate_of_one_aligns_the_body_with_the_normal():
    rates = {f"lean.{name}_rate": 1.0 for name in ("forward", "side")}
    for rises in ((0.3, 0.0), (0.0, 0.3)):
        up = maths.rotate(solved(plane(*rises), stand(), rates)["body_rot"], maths.Y)
        assert np.allclose(up, normal_of(*rises), atol=EXACT)


def test_the_body_leans_about_its_hips_and_can_sink_along_the_normal():
    for vertical_only, direction in ((True, maths.Y), (False, normal_of(0.3, 0.2))):
        changes = {"pelvis.vertical_only": vertical_only, "lean.forward_rate": 0.7}
        output = solved(plane(0.3, 0.2, -0.1), stand(), changes)
        assert output["pelvis_height"] < -0.05
        assert rotation_angle(output["body_rot"], maths.IDENTITY) > 0.1
        moved = np.mean(output["hip_pos"] - stand().hip.pos, axis=0)
        assert np.allclose(moved, output["pelvis_height"] * direction, atol=EXACT)
