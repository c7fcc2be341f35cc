"""The NumPy reference of `mec` by itself: facts that hold whatever the JAX code does."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from reference import maths
from reference.characters import Frame, Ground, Parameters
from reference.maths import Array, Transform
from reference.sample_poses import ANKLE, STILL, make_frame, make_rig, plane, standing
from reference.systems import mec
from reference.terrain import LegTerrains, Terrain

EXACT = 1e-9  # m and rad
DT = 1 / 60  # s, frame time
RIG = make_rig(np.random.default_rng(0))
FLAT, DEEP = plane(0.0, 0.0), plane(0.0, 0.0, -9.0)
STEP = Terrain(  # flat, and 0.06 m higher from 0.1 m ahead
    maths.Y,
    planes=[(np.zeros(3), maths.Y)],
    triangles=np.array([[[-9.0, 0.06, 0.1], [9.0, 0.06, 0.1], [0.0, 0.06, 9.0]]]),
)
LEFT_EDGE = np.array([[[0.02, 0.03, -9.0], [0.02, 0.03, 9.0], [-0.05, 0.03, 0.0]]])


def step(
    terrain: Ground, frame: Frame, changes: dict[str, Any] | None = None, state: Any = None
) -> tuple[mec.State, dict[str, Array]]:
    """Feet as high as those of `poses`, unless told otherwise."""
    values = Parameters({"target.foot_height": ANKLE} | (changes or {}), mec.DEFAULTS)
    return mec.step(values, RIG, terrain, state, frame)


def follow(grounds: Sequence[Ground], frames: Sequence[Frame], **changes: Any) -> list:
    """The outputs of a clip with different ground in each frame."""
    state, outputs = None, []
    for ground, frame in zip(grounds, frames, strict=True):
        changed = {name.replace("__", "."): value for name, value in changes.items()}
        state, output = step(ground, frame, changed, state)
        outputs.append(output)
    return outputs


def stand(forward: float = 0.05, height: float = ANKLE, **changes: Any) -> Frame:
    return make_frame(RIG, standing((height, height), forward), **changes)


def angle_of(rot: Array) -> float:
    """Angle between the up of a foot and the world's, rad."""
    return maths.angle_between(maths.rotate(rot, maths.Y), maths.Y)


def test_pitch_comes_from_the_toe_ray_and_roll_from_the_corner_ray():
    _, output = step(STEP, stand())
    assert output["pitch"] == pytest.approx(math.atan2(0.06, 0.2))
    assert output["roll"] == pytest.approx(0.0)
    _, output = step(STEP, stand(), {"probe.foot_length": 0.04})
    assert output["pitch"] == pytest.approx(0.0)
    _, output = step(plane(0.0, 0.3), stand())
    assert output["roll"] == pytest.approx(math.atan(-0.3)) and output["pitch"] == pytest.approx(0)
    half_width = {"probe.half_width": 0.1}
    pillar = Terrain(maths.Y, FLAT.planes, LEFT_EDGE)  # 0.08 m to the right of the left foot
    assert step(pillar, stand())[1]["roll"].tolist() == [0.0, 0.0]
    roll = step(pillar, stand(), half_width)[1]["roll"]
    assert roll == pytest.approx([math.atan2(0.03, 0.1), 0.0])


@pytest.mark.parametrize("rise", [(0.3, 0.0), (0.0, 0.3), (0.0, -0.4), (-0.2, 0.0)])
def test_a_foot_lies_flat_on_a_slope_and_keeps_its_yaw(rise):
    _, output = step(plane(*rise), stand())
    normal = maths.unit(np.array([-rise[1], 1.0, -rise[0]]), maths.Y)
    for leg in range(2):
        foot = maths.multiply(output["ankle_rot"][leg], RIG.ankle_from_foot[leg])
        assert np.allclose(maths.rotate(foot, maths.Y), normal, atol=EXACT)
        assert maths.rotate(foot, maths.Z)[0] == pytest.approx(0.0, abs=EXACT)


def test_a_foot_rolls_first_and_pitches_then():
    pitch, roll = math.atan(0.4), math.atan(0.5)
    _, output = step(plane(0.4, 0.5), stand())
    expected = [
        -math.sin(roll),
        math.cos(roll) * math.cos(pitch),
        -math.cos(roll) * math.sin(pitch),
    ]
    assert maths.rotate(output["goal_rot"][0], maths.Y) == pytest.approx(expected)


def test_the_toe_ray_follows_the_forward_axis_of_the_foot():
    _, output = step(plane(0.3, 0.2), stand(), {"probe.forward": np.array([1.0, 0.4, 0.0])})
    assert output["pitch"] == pytest.approx(math.atan(0.2))
    assert output["roll"] == pytest.approx(math.atan(0.3))  # right of left is ahead
    for leg in range(2):
        heading = maths.rotate(output["goal_rot"][leg], maths.Z)
        assert heading @ maths.Z > 0.9  # the foot itself keeps its yaw


def test_a_tilt_is_limited_to_a_cone_about_its_own_axis():
    slope = plane(1.0, 0.5)
    outputs = {limit: step(slope, stand(), {"foot.max_tilt": limit})[1] for limit in (3.0, 0.3)}
    for leg in range(2):
        full, kept = (outputs[limit]["goal_rot"][leg] for limit in (3.0, 0.3))
        assert angle_of(full) > 0.7 and 0.2 < angle_of(kept) <= 0.3
        upright = maths.inverse(maths.multiply(RIG.ankle_from_foot[leg], stand().ankle.rot[leg]))
        wide, narrow = (maths.multiply(rot, upright)[1:] for rot in (full, kept))
        assert np.allclose(np.cross(wide, narrow), 0.0, atol=EXACT)
        assert 2 * math.asin(maths.length(narrow)) == pytest.approx(0.3)


@pytest.mark.parametrize(
    "changes, height, speed, extra",
    [
        ({}, 0.11, 9.0, 0.3),
        ({}, 0.16, 0.0, 0.0),
        ({"probe.stable_height": 0.2}, 0.16, 0.0, 0.3),
        ({"probe.by_speed": True}, 0.11, 0.6, 0.0),
        ({"probe.by_speed": True, "probe.stable_speed": 0.7}, 0.11, 0.6, 0.3),
        ({"probe.by_height": False, "probe.by_speed": True}, 0.3, 0.4, 0.3),
        ({"probe.by_height": False}, 0.3, 9.0, 0.2),
        ({"probe.by_height": False, "probe.extra": 0.1}, 0.3, 9.0, 0.1),
        ({"probe.extra_max": 0.5}, 0.11, 0.0, 0.5),
        ({"probe.extra_min": 0.1}, 0.16, 0.0, 0.1),
    ],
)
def test_the_extra_ray_length_is_chosen_by_height_and_speed(changes, height, speed, extra):
    frame = stand(height=height, foot_speed=np.full(2, speed))
    for margin, hits in ((-0.001, True), (0.001, False)):
        ground = plane(0.0, 0.0, height - ANKLE - extra - margin)
        _, output = step(ground, frame, changes)
        assert output["extra"] == pytest.approx(extra)
        assert (output["found"] == hits).all()


def test_rays_start_above_the_ankle_and_inactive_feet_find_no_ground():
    for ray_up, hits in ((0.5, False), (0.6, True)):
        _, output = step(plane(0.0, 0.0, ANKLE + 0.55), stand(), {"probe.ray_up": ray_up})
        assert (output["found"] == hits).all()
    _, output = step(FLAT, stand(), {"probe.active": [True, False]})
    assert output["found"].tolist() == [True, False] and output["weight"].tolist() == [1.0, 0.0]


def test_rays_pass_through_layers_outside_their_mask():
    ground = Terrain(maths.Y, [*FLAT.planes, (0.1 * maths.Y, maths.Y)], plane_layers=[0, 5])
    for mask, height in ((0xFFFFFFFF, 0.1), (1, 0.0), (1 << 5, 0.1)):
        _, output = step(ground, stand(), {"probe.layers": mask})
        assert output["target_ws"][:, 1] == pytest.approx(height + ANKLE)


def test_the_weight_moves_linearly_over_the_transition_time_and_the_last_goal_is_kept():
    raised = plane(0.0, 0.0, 0.05)
    frames = [stand(0.05 + 0.002 * i) for i in range(30)]
    outputs = follow([raised] + [DEEP] * 14 + [raised] * 15, frames)
    fade = np.array([output["fade"][0] for output in outputs])
    expected = [max(1 - i / 12, 0.0) for i in range(15)] + [min(i / 12, 1.0) for i in range(1, 16)]
    assert np.allclose(fade, expected, atol=EXACT)
    for index in range(1, 15):
        expected = frames[index].ankle.pos + 0.05 * maths.Y
        assert np.allclose(outputs[index]["target_ws"], expected, atol=EXACT)
    heights = [output["ankle_pos"][0, 1] - output["pelvis_height"] for output in outputs[:13]]
    assert (np.diff(heights) < 0.0).all() and heights[12] == pytest.approx(ANKLE)
    turned = [Transform(np.zeros(3), maths.from_axis_angle(maths.Y, angle)) for angle in (0.3, 0.5)]
    frames = [stand(world_from_model=root) for root in turned]
    changes = {"probe__forward": maths.rotate(maths.inverse(turned[0].rot), maths.Z)}
    first, last = follow([plane(0.3, 0.0), DEEP], frames, **changes)
    normal = maths.unit(np.array([0.0, 1.0, -0.3]), maths.Y)
    assert maths.rotate(first["goal_rot"][0], maths.Y) == pytest.approx(normal)
    for rots in zip(first["goal_rot"], last["goal_rot"], strict=True):
        # In world space the foot keeps the rotation from its animation that it had on the ground.
        one, other = (
            maths.multiply(rot, maths.inverse(root.rot))
            for rot, root in zip(rots, turned, strict=True)
        )
        assert one == pytest.approx(other) and abs(one[0]) < 0.999
    jumping = follow([raised, DEEP], frames[:2], effector__transition_time=0.0)
    assert jumping[1]["fade"].tolist() == [0.0, 0.0]


def test_a_planted_foot_stays_and_a_free_foot_follows_the_animation():
    frames = [stand(0.05 + 0.03 * i) for i in range(3)]
    for changes, place in (
        ({}, 0.05),
        ({"lock__plant_weight": 0.5}, 0.08),
        ({"lock__plant_weight": 0.0}, 0.11),
        ({"lock__plant": False}, 0.11),
    ):
        last = follow([FLAT] * 3, frames, **changes)[-1]
        assert last["target_ws"][:, 2] == pytest.approx(place)
        assert (last["planted"] == ("lock__plant" not in changes)).all()


def test_the_plant_weight_moves_by_its_speed():
    state, output = step(FLAT, stand(), {"lock.plant_weight": 1.0})
    weights = []
    for _ in range(4):
        release = {"lock.plant_weight": 0.0, "lock.plant_speed": 20.0}
        state, output = step(FLAT, stand(0.17), release, state)
        weights.append(float(output["plant_weight"][0]))
        assert output["target_ws"][0, 2] == pytest.approx(0.17 - 0.12 * weights[-1])
    assert weights == pytest.approx([2 / 3, 1 / 3, 0.0, 0.0])
    _, output = step(FLAT, stand(0.17), {"lock.plant_weight": 0.7}, state)
    assert output["plant_weight"] == pytest.approx(0.7)


def test_a_planted_foot_keeps_its_pose_on_a_platform_and_follows_the_ground():
    slope = plane(0.3, 0.0)
    grounds = [slope, plane(0.0, 0.0, 0.04), plane(0.0, 0.0, 0.9)]
    outputs = follow(grounds, [stand(), stand(0.09), stand(0.09)], pelvis__enabled=False)
    assert outputs[1]["target_ws"][:, 1:] == pytest.approx(np.array([[0.04 + ANKLE, 0.05]] * 2))
    assert angle_of(outputs[1]["goal_rot"][0]) == pytest.approx(math.atan(0.3))
    half = follow(grounds[:2], [stand(), stand(0.09)], lock__plant_weight=0.5)[1]
    assert angle_of(half["goal_rot"][0]) == pytest.approx(math.atan(0.3) / 2)
    assert not outputs[2]["planted"].any()  # ground above the start of the ray is not hit
    turned = Transform(np.array([0.1, 0.0, 0.2]), maths.from_axis_angle(maths.Y, 0.5))
    ride = stand(platforms=[turned], platforms_before=[STILL])
    moved = follow([slope, replace(FLAT, platform=0)], [stand(), ride])[1]
    for leg in range(2):
        stood = maths.apply(turned, np.array([(0.1, -0.1)[leg], 0.0, 0.05]))
        assert moved["target_ws"][leg] == pytest.approx(stood + ANKLE * maths.Y)
        ahead = maths.rotate(moved["goal_rot"][leg], maths.Z)
        assert math.atan2(ahead[0], ahead[2]) == pytest.approx(0.5)


def test_a_planted_foot_keeps_its_height_when_its_ground_disappears():
    ahead = Terrain(maths.Y, triangles=np.array([[[-9.0, 0.02, 0.2], [9.0, 0.02, 0.2], [0, 0, 9]]]))
    last = follow([FLAT, ahead], [stand(), stand(0.3)])[1]
    assert last["found"].all() and last["target_ws"][:, 1:] == pytest.approx(
        np.array([[ANKLE, 0.05]] * 2)
    )


def test_planting_starts_again_after_the_foot_was_in_the_air():
    frames = [stand(0.05), stand(0.1), stand(0.15)]
    outputs = follow([FLAT, DEEP, FLAT], frames)
    assert [output["planted"].all() for output in outputs] == [True, False, True]
    assert outputs[2]["target_ws"][:, 2] == pytest.approx(0.15)


def test_the_pelvis_moves_only_as_far_as_leg_lengths_require():
    far = -1.12 + math.sqrt(0.88**2 - 0.05**2)
    near = -0.37 + math.sqrt(0.5**2 - 0.05**2)
    for height, pelvis in ((-0.3, far), (0.45, near), (0.0, 0.0)):
        _, output = step(plane(0.0, 0.0, height), stand())
        assert output["pelvis_height"] == pytest.approx(pelvis, abs=EXACT)
    # Not over-stretching the left leg takes precedence over the minimum length of the right.
    uneven = LegTerrains(FLAT, [plane(0.0, 0.0, -0.3), plane(0.0, 0.0, 0.45)])
    assert step(uneven, stand())[1]["pelvis_height"] == pytest.approx(far)
    lone = stand(weight=np.array([0.0, 1.0]))
    assert step(uneven, lone)[1]["pelvis_height"] == pytest.approx(near)
    drawn_up = make_frame(RIG, standing((ANKLE, 0.6)))
    assert step(LegTerrains(FLAT, [FLAT, DEEP]), drawn_up)[1]["pelvis_height"] == 0.0
    for changes in ({"pelvis.min_length": 0.3}, {"pelvis.enabled": False}):
        assert step(plane(0.0, 0.0, 0.45), stand(), changes)[1]["pelvis_height"] == 0.0
    _, output = step(plane(0.0, 0.0, -0.3), stand(), {"pelvis.max_length": 1.3})
    assert output["pelvis_height"] == 0.0 and not output["reached"].any()


def test_the_pelvis_is_damped_by_the_clamped_speed_law():
    state, _ = step(FLAT, stand())
    goal = -1.12 + math.sqrt(0.88**2 - 0.05**2)
    for changes, weight in (
        ({}, 1 / 6),
        ({"pelvis.speed": 30.0}, 0.5),
        ({"pelvis.damp": False}, 1),
    ):
        _, output = step(plane(0.0, 0.0, -0.3), stand(), changes, state)
        assert output["pelvis_height"] == pytest.approx(weight * goal)


def test_the_knee_points_at_the_hint():
    offset = np.array([0.2, 0.1, 0.0])
    root = Transform(np.array([0.3, 0.0, 0.2]), maths.from_axis_angle(maths.Y, 0.4))
    frame = stand(world_from_model=root)
    ground, changes = plane(0.0, 0.0, -0.1), {"pelvis.max_length": 0.8}
    _, output = step(ground, frame, changes | {"leg.hint_offset": offset})
    assert output["pelvis_height"] < -0.1 and output["reached"].all()
    for leg in range(2):
        calf = frame.knee.pos[leg] - frame.ankle.pos[leg]
        toes = frame.ankle.pos[leg] + np.array([0.0, -ANKLE - 0.1, 0.2])
        hint = toes + calf + offset
        assert output["hint_ws"][leg] == pytest.approx(maths.apply(root, hint))
        hip, knee, ankle = (output[f"{name}_pos"][leg] for name in ("hip", "knee", "ankle"))
        assert abs(np.cross(ankle - hip, hint - hip) @ (knee - hip)) < EXACT
        along = maths.unit(ankle - hip, maths.Y)
        assert maths.across(knee - hip, along) @ maths.across(hint - hip, along) > 0.0


def test_the_hint_is_above_the_toe_hit_or_without_ground_below_the_ankle():
    frame = stand()
    calf = frame.knee.pos - frame.ankle.pos
    for ground, height in ((STEP, 0.06), (FLAT, 0.0), (DEEP, 0.0)):
        toes = frame.ankle.pos + np.array([0.0, height - ANKLE, 0.2])
        assert step(ground, frame)[1]["hint_ws"] == pytest.approx(toes + calf)


def test_ankle_heights_are_relative_to_the_origin():
    up = Transform(2.0 * maths.Y, maths.IDENTITY)
    _, output = step(plane(0.0, 0.0, 2.0), stand(world_from_model=up))
    assert output["extra"] == pytest.approx(0.3) and output["found"].all()


def test_a_foot_with_its_own_up_stands_on_a_wall():
    wall = Terrain(-maths.X, planes=[(0.15 * maths.X, maths.X)])
    _, output = step(LegTerrains(FLAT, [wall, FLAT]), stand())
    assert output["target_ws"][0] == pytest.approx([0.15 - ANKLE, ANKLE, 0.05])
    assert maths.rotate(output["goal_rot"][0], maths.Y) == pytest.approx(-maths.X)
    assert maths.rotate(output["goal_rot"][0], maths.Z) == pytest.approx(maths.Z)
    assert output["target_ws"][1] == pytest.approx(stand().ankle.pos[1])
    assert output["reached"].all()
