"""The NumPy references of `ozz`, `unreal` and `mec`: facts that hold whatever the JAX code does."""

import math
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from reference import maths
from reference.characters import Frame, Ground, Parameters
from reference.maths import Array, Transform
from reference.sample_poses import ANKLE, make_frame, make_rig, plane, rotation_angle, standing
from reference.systems import mec, ozz, record, unreal
from reference.terrain import LegTerrains, Terrain
from support import clips

EXACT = 1e-9  # m and rad
RIG = make_rig(np.random.default_rng(0))
FLAT, DEEP, STEEP = plane(0.0, 0.0), plane(0.0, 0.0, -9.0), plane(1.0, 0.0)
HALVES = [  # 0.1 m lower under the left leg than under the right
    [[0.0, -0.1, -9.0], [9.0, -0.1, 0.0], [0.0, -0.1, 9.0]],
    [[0.0, 0.0, -9.0], [-9.0, 0.0, 0.0], [0.0, 0.0, 9.0]],
]
LEFT_LOW, LEFT_ONLY = (Terrain(maths.Y, triangles=np.array(HALVES[:n])) for n in (2, 1))
AHEAD = np.array([[[-9.0, 0.06, 0.1], [9.0, 0.06, 0.1], [0.0, 0.06, 9.0]]])
STEP = Terrain(maths.Y, FLAT.planes, AHEAD)  # flat, and 0.06 m higher from 0.1 m ahead
BESIDE = np.array([[[0.02, 0.03, -9.0], [0.02, 0.03, 9.0], [-0.05, 0.03, 0.0]]])
PILLAR = Terrain(maths.Y, FLAT.planes, BESIDE)  # 0.08 m to the right of the left foot
UNEVEN = LegTerrains(FLAT, [plane(0.0, 0.0, -0.3), plane(0.0, 0.0, 0.45)])


def parameters(system: ModuleType, changes: dict[str, Any] | None = None) -> Parameters:
    """Feet as high as those of `poses`, unless told otherwise."""
    sole = {} if system is unreal else {"target.foot_height": ANKLE}
    return Parameters(sole | (changes or {}), system.DEFAULTS)


def solved(
    system: ModuleType, terrain: Ground, frame: Frame, changes: dict[str, Any] | None = None
) -> dict[str, Array]:
    return system.step(parameters(system, changes), RIG, terrain, None, frame)[1]


def follow(
    grounds: Sequence[Ground], frames: Sequence[Frame], changes: dict[str, Any] | None = None
) -> list[dict[str, Array]]:
    """The outputs of `mec` for a clip with different ground in each frame."""
    state, outputs = None, []
    for ground, frame in zip(grounds, frames, strict=True):
        state, output = mec.step(parameters(mec, changes), RIG, ground, state, frame)
        outputs.append(output)
    return outputs


def stand(forward: float = 0.05, height: float = ANKLE, **changes: Any) -> Frame:
    return make_frame(RIG, standing((height, height), forward), **changes)


def at(*place: float) -> Transform:
    return Transform(np.array(place), maths.IDENTITY)


def level(height: float) -> Terrain:
    return plane(0.0, 0.0, height)


def of_leg(leg: int) -> Array:
    """Weights of the two legs, of which only one counts."""
    return np.eye(2)[leg]


NOT_RAISED = {"root.enabled": False}
FAR = -1.12 + math.sqrt(0.88**2 - 0.05**2)  # m, where the pelvis is that is 0.3 m too high
NEAR = -0.37 + math.sqrt(0.5**2 - 0.05**2)  # m, and that is 0.45 m too low
LEFT: dict[str, Any] = {"world_from_model": at(0.01, 0.0, 0.0)}  # of the border
RIGHT: dict[str, Any] = {"world_from_model": at(-0.01, 0.0, 0.0)}
FACTS: dict[ModuleType, list[tuple[Ground, Frame, dict[str, Any], dict[str, Any]]]] = {
    ozz: [  # ground, frame, changes of parameters, outputs; heights are those of ankles and goals
        # The root is raised onto the ground, or else the pelvis.
        (level(0.4), stand(), {}, {"lift": 0.4, "pelvis_height": 0.0, "height": ANKLE + 0.4}),
        (level(0.4), stand(), NOT_RAISED, {"lift": 0, "pelvis_height": 0.4, "height": ANKLE + 0.4}),
        # It sinks to the lowest foot and bends the other leg.
        (LEFT_LOW, stand(**RIGHT), {}, {"lift": 0.0, "pelvis_height": -0.1}),
        (LEFT_LOW, stand(**RIGHT), {}, {"height": [ANKLE - 0.1, ANKLE]}),
        (LEFT_LOW, stand(**RIGHT, weight=np.array([0.5, 1.0])), {}, {"pelvis_height": -0.05}),
        (LEFT_LOW, stand(**RIGHT), {"pelvis.enabled": False}, {"pelvis_height": 0.0}),
        # A leg without ground moves only with the body.
        (LEFT_ONLY, stand(**LEFT), {"target.foot_height": 0.05}, {"lift": -0.1, "weight": [1, 0]}),
        (LEFT_ONLY, stand(**LEFT), {"target.foot_height": 0.05}, {"body_offset_ws": [0, -0.13, 0]}),
        # There is no ground beyond its rays.
        (level(0.4), stand(), {"root.ray_up": 0.3}, {"lift": 0.0, "found": True}),
        (level(-0.4), stand(), {"root.ray_down": 0.3}, {"lift": 0.0, "found": True}),
        (level(-0.4), stand(), {"root.ray_down": 0.5}, {"lift": -0.4, "found": True}),
        (level(0.4), stand(), NOT_RAISED | {"probe.ray_up": 0.3}, {"found": False}),
        (level(-0.4), stand(), NOT_RAISED | {"probe.ray_down": 0.4}, {"found": False}),
        # A slope raises the ankle only so far.
        (STEEP, stand(), {}, {"goal": 0.05 + ANKLE * math.sqrt(2.0)}),
        (STEEP, stand(), {"target.max_slope": 0.3}, {"goal": 0.05 + ANKLE / math.cos(0.3)}),
    ],
    unreal: [
        # It starts at its goals.
        (LEFT_LOW, stand(), {}, {"hip": -0.1, "half_height": 0.85, "effector": [0.0, 0.1]}),
        (LEFT_LOW, stand(), {}, {"asleep": True, "height": [ANKLE - 0.1, ANKLE]}),
        (LEFT_LOW, stand(), {"pelvis.enabled": False}, {"hip": 0.0, "effector": [-0.1, 0.0]}),
        (LEFT_LOW, stand(weight=of_leg(1)), {}, {"hip": 0.0, "effector": [-0.1, 0.0]}),
        # It idles below a speed.
        (LEFT_LOW, stand(speed=0.5), {}, {"hip": 0.0, "idle": False}),
        (LEFT_LOW, stand(speed=0.5), {"contact.idle_speed": 0.5}, {"hip": -0.1, "idle": True}),
        # It measures from the origin and finds no ground beyond its ray.
        (level(0.1), stand(), {}, {"effector": 0.1, "hip": 0.0}),
        (level(0.1), stand(), {"target.adjust": 0.02}, {"effector": 0.12, "hip": 0.0}),
        (level(0.91), stand(), {}, {"effector": 0.0}),
        (level(0.91), stand(), {"probe.ray_up": 0.92}, {"effector": 0.91}),
        (level(-0.51), stand(), {}, {"effector": 0.0, "hip": 0.0}),
        (level(-0.51), stand(), {"probe.ray_down": 0.52}, {"effector": 0.0, "hip": -0.51}),
    ],
    mec: [
        # Pitch comes from the toe ray and roll from the corner ray.
        (STEP, stand(), {}, {"pitch": math.atan2(0.06, 0.2), "roll": 0.0}),
        (STEP, stand(), {"probe.foot_length": 0.04}, {"pitch": 0.0}),
        (plane(0.0, 0.3), stand(), {}, {"pitch": 0.0, "roll": math.atan(-0.3)}),
        (PILLAR, stand(), {}, {"roll": 0.0}),
        (PILLAR, stand(), {"probe.half_width": 0.1}, {"roll": [math.atan2(0.03, 0.1), 0.0]}),
        # Rays start above the ankle and depend on its height over the origin; idle feet have none.
        (level(ANKLE + 0.55), stand(), {"probe.ray_up": 0.5}, {"found": False}),
        (level(ANKLE + 0.55), stand(), {"probe.ray_up": 0.6}, {"found": True}),
        (FLAT, stand(), {"probe.active": [True, False]}, {"found": [1, 0], "weight": [1, 0]}),
        (level(2.0), stand(world_from_model=at(0, 2, 0)), {}, {"extra": 0.3, "found": True}),
        # The pelvis moves only as far as leg lengths require, above all for legs that are too long.
        (level(-0.3), stand(), {}, {"pelvis_height": FAR}),
        (level(0.45), stand(), {}, {"pelvis_height": NEAR}),
        (FLAT, stand(), {}, {"pelvis_height": 0.0}),
        (UNEVEN, stand(), {}, {"pelvis_height": FAR}),
        (UNEVEN, stand(weight=of_leg(1)), {}, {"pelvis_height": NEAR}),
        (level(0.45), stand(), {"pelvis.min_length": 0.3}, {"pelvis_height": 0.0}),
        (level(0.45), stand(), {"pelvis.enabled": False}, {"pelvis_height": 0.0}),
        (level(-0.3), stand(), {"pelvis.max_length": 1.3}, {"pelvis_height": 0, "reached": False}),
    ],
}


@pytest.mark.parametrize("system", [ozz, unreal, mec])
def test_one_frame_has_the_outputs_that_follow_from_the_description(system):
    for number, (ground, frame, changes, expected) in enumerate(FACTS[system]):
        output = solved(system, ground, frame, changes)
        output |= {"height": output["ankle_pos"][:, 1], "goal": output["target_ws"][:, 1]}
        for name, value in expected.items():
            actual, message = output[name].astype(float), f"{name} of fact {number}: {changes}"
            wanted = np.broadcast_to(value, actual.shape)
            np.testing.assert_allclose(actual, wanted, rtol=0, atol=EXACT, err_msg=message)


@pytest.mark.parametrize("system", [ozz, unreal, mec])
def test_flat_ground_leaves_a_standing_pose_unchanged(system):
    frame = stand()
    output = solved(system, FLAT, frame)
    for name in ("hip", "knee", "ankle", "toe"):
        assert np.allclose(output[f"{name}_pos"], getattr(frame, name).pos, atol=EXACT)
        assert rotation_angle(output[f"{name}_rot"], getattr(frame, name).rot) < 1e-7
    assert output["reached"].all() and (output["weight"] == 1.0).all()


@pytest.mark.parametrize("system", [record, ozz, unreal, mec])
def test_joints_carry_their_bones_and_reached_ankles_are_on_their_targets(system):
    rig = clips.make_rig(1)
    frames = clips.wandering(rig, np.random.default_rng(1), 90, stand=(0.1, 0.4, 0.6, 0.9))
    output = system.run(parameters(system, {"leg.twist": 0.3}), rig, clips.BROKEN, frames)
    assert 20 < output["reached"].sum() < output["reached"].size
    for index, leg in np.ndindex(*output["reached"].shape):
        frame = frames[index]
        for one, other in (("hip", "knee"), ("knee", "ankle"), ("ankle", "toe")):
            joint = Transform(*(part[leg] for part in getattr(frame, one)))
            local = maths.unapply(joint, getattr(frame, other).pos[leg])
            now = Transform(output[f"{one}_pos"][index, leg], output[f"{one}_rot"][index, leg])
            carried = maths.apply(now, local)
            assert np.allclose(carried, output[f"{other}_pos"][index, leg], atol=EXACT)
        ankle = maths.apply(frame.world_from_model, output["ankle_pos"][index, leg])
        if output["reached"][index, leg]:
            assert np.allclose(ankle, output["target_ws"][index, leg], atol=EXACT)


def test_an_unknown_parameter_is_named_with_those_of_the_system():
    with pytest.raises(ValueError, match=r"lock\.enabled.*effector\.latch"):
        Parameters({"lock.enabled": True}, unreal.DEFAULTS)


def foot_axis(output: dict[str, Array], leg: int, axis: Array) -> Array:
    """An axis of the solved foot, model space."""
    return maths.rotate(maths.multiply(output["ankle_rot"][leg], RIG.ankle_from_foot[leg]), axis)


@pytest.mark.parametrize("rise", [(0.3, 0.0), (0.0, 0.3), (0.0, -0.4), (-0.2, 0.0)])
def test_a_sole_lies_on_a_slope_and_keeps_the_heading_of_the_toes(rise):
    normal = maths.unit(np.array([-rise[1], 1.0, -rise[0]]), maths.Y)
    of_mec, of_ozz = (solved(system, plane(*rise), stand()) for system in (mec, ozz))
    carried = solved(ozz, plane(*rise), stand(), {"foot.enabled": False})
    for leg in range(2):
        for output in (of_mec, of_ozz):
            assert np.allclose(foot_axis(output, leg, maths.Y), normal, atol=EXACT)
        assert foot_axis(of_mec, leg, maths.Z)[0] == pytest.approx(0.0, abs=EXACT)
        before, after = (foot_axis(pose, leg, maths.Z) for pose in (carried, of_ozz))
        assert abs(np.cross(normal, before) @ after) < EXACT and before @ after > 0.9


# unreal.


def test_unreal_moves_by_the_clamped_speed_law_and_its_latch_freezes_the_hip_short():
    frames = [stand(speed=1.0)] + [stand()] * 4 + [stand(speed=1.0)] * 2
    for latch, hips in (
        (True, [0.0, -0.025, -0.025, -0.025, -0.025, -0.01875, -0.0140625]),
        (False, [0.0, *(-0.1 * (1 - 0.75**n) for n in range(1, 5))]),
    ):
        values = parameters(unreal, {"effector.latch": latch})
        output = unreal.run(values, RIG, level(-0.1), frames)
        assert np.allclose(output["hip"][: len(hips)], hips, atol=EXACT)
        half = 0.9 + np.array(hips) / 2
        assert np.allclose(output["half_height"][: len(hips)], half, atol=EXACT)
        assert output["asleep"].tolist() == [False] + [latch] * 4 + [False] * 2


def test_unreal_sleeps_only_when_all_active_feet_are_near_their_goals():
    for weight, naps in ((np.ones(2), False), (of_leg(0), True)):
        frames = [stand(speed=1.0, weight=weight), stand(weight=weight)]
        output = unreal.run(parameters(unreal), RIG, LEFT_LOW, frames)
        assert bool(output["asleep"][1]) == naps
        assert np.allclose(output["effector"][1], [0.0, 0.025], atol=EXACT)
    for distance, naps in ((0.074, False), (0.076, True)):
        frames = [stand(speed=1.0), stand()]
        values = parameters(unreal, {"effector.latch_distance": distance})
        assert unreal.run(values, RIG, LEFT_LOW, frames)["asleep"][1] == naps


# mec.


def test_mec_limits_a_tilt_to_a_cone_about_its_own_axis():
    slope = plane(1.0, 0.5)
    outputs = {limit: solved(mec, slope, stand(), {"foot.max_tilt": limit}) for limit in (3.0, 0.3)}
    for leg in range(2):
        full, kept = (outputs[limit]["goal_rot"][leg] for limit in (3.0, 0.3))
        upright = maths.inverse(maths.multiply(RIG.ankle_from_foot[leg], stand().ankle.rot[leg]))
        wide, narrow = (maths.multiply(rot, upright)[1:] for rot in (full, kept))
        assert np.allclose(np.cross(wide, narrow), 0.0, atol=EXACT)
        assert 2 * math.asin(maths.length(wide)) > 0.7
        assert 2 * math.asin(maths.length(narrow)) == pytest.approx(0.3)


@pytest.mark.parametrize(
    "changes, height, speed, extra",
    [
        ({}, 0.11, 9.0, 0.3),
        ({}, 0.16, 0.0, 0.0),
        ({"stable_height": 0.2}, 0.16, 0.0, 0.3),
        ({"by_speed": True}, 0.11, 0.6, 0.0),
        ({"by_speed": True, "stable_speed": 0.7}, 0.11, 0.6, 0.3),
        ({"by_height": False, "by_speed": True}, 0.3, 0.4, 0.3),
        ({"by_height": False}, 0.3, 9.0, 0.2),
        ({"by_height": False, "extra": 0.1}, 0.3, 9.0, 0.1),
        ({"extra_max": 0.5}, 0.11, 0.0, 0.5),
        ({"extra_min": 0.1}, 0.16, 0.0, 0.1),
    ],
)
def test_mec_chooses_the_extra_length_of_its_ray_by_height_and_speed(changes, height, speed, extra):
    frame = stand(height=height, foot_speed=np.full(2, speed))
    for margin, hits in ((-0.001, True), (0.001, False)):
        ground = level(height - ANKLE - extra - margin)
        output = solved(mec, ground, frame, clips.named("probe", **changes))
        assert output["extra"] == pytest.approx(extra)
        assert (output["found"] == hits).all()


def test_the_weight_of_mec_moves_linearly_over_a_time_and_its_last_goal_is_kept():
    raised, frames = level(0.05), [stand(0.05 + 0.002 * i) for i in range(30)]
    outputs = follow([raised] + [DEEP] * 14 + [raised] * 15, frames)
    fade = np.array([output["fade"][0] for output in outputs])
    expected = [max(1 - i / 12, 0.0) for i in range(15)] + [min(i / 12, 1.0) for i in range(1, 16)]
    assert np.allclose(fade, expected, atol=EXACT)
    for index in range(1, 15):
        goal = frames[index].ankle.pos + 0.05 * maths.Y
        assert np.allclose(outputs[index]["target_ws"], goal, atol=EXACT)
    heights = [output["ankle_pos"][0, 1] - output["pelvis_height"] for output in outputs[:13]]
    assert (np.diff(heights) < 0.0).all() and heights[12] == pytest.approx(ANKLE)
    jumping = follow([raised, DEEP], frames[:2], {"effector.transition_time": 0.0})
    assert jumping[1]["fade"].tolist() == [0.0, 0.0]


def test_a_planted_foot_of_mec_stays_until_it_loses_its_ground_and_a_free_one_follows():
    frames = [stand(0.05 + 0.03 * i) for i in range(3)]
    for changes, place in (
        ({}, 0.05),
        ({"lock.plant_weight": 0.5}, 0.08),
        ({"lock.plant_weight": 0.0}, 0.11),
        ({"lock.plant": False}, 0.11),
    ):
        last = follow([FLAT] * 3, frames, changes)[-1]
        assert last["target_ws"][:, 2] == pytest.approx(place)
        assert (last["planted"] == ("lock.plant" not in changes)).all()
    outputs = follow([FLAT, DEEP, FLAT], frames)
    assert [output["planted"].all() for output in outputs] == [True, False, True]
    assert outputs[2]["target_ws"][:, 2] == pytest.approx(0.11)


def test_a_planted_foot_of_mec_follows_the_height_of_its_ground_and_keeps_its_slope():
    grounds, frames = [plane(0.3, 0.0), level(0.04), level(0.9)], [stand(), *[stand(0.09)] * 2]
    for weight in (1.0, 0.5):
        changes = {"pelvis.enabled": False, "lock.plant_weight": weight}
        _, kept, lost = follow(grounds, frames, changes)
        tilt = maths.angle_between(maths.rotate(kept["goal_rot"][0], maths.Y), maths.Y)
        assert tilt == pytest.approx(weight * math.atan(0.3))
        assert not lost["planted"].any()  # ground above the start of the ray is not hit
        place = [0.04 + ANKLE, 0.05 if weight == 1.0 else 0.07]
        assert kept["target_ws"][:, 1:] == pytest.approx(np.array([place] * 2))


def test_the_plant_weight_of_mec_moves_by_its_speed():
    state, _ = mec.step(parameters(mec), RIG, FLAT, None, stand())
    release = parameters(mec, {"lock.plant_weight": 0.0, "lock.plant_speed": 20.0})
    for weight in (2 / 3, 1 / 3, 0.0, 0.0):
        state, output = mec.step(release, RIG, FLAT, state, stand(0.17))
        assert output["plant_weight"] == pytest.approx(weight)
        assert output["target_ws"][0, 2] == pytest.approx(0.17 - 0.12 * weight)


@pytest.mark.parametrize(
    "speed, damp, weight", [(10, True, 1 / 6), (30, True, 0.5), (10, False, 1)]
)
def test_the_pelvis_of_mec_is_damped_by_the_clamped_speed_law(speed, damp, weight):
    changes = {"pelvis.speed": speed, "pelvis.damp": damp}
    last = follow([FLAT, level(-0.3)], [stand()] * 2, changes)[-1]
    assert last["pelvis_height"] == pytest.approx(weight * FAR)


def test_the_knee_of_mec_points_at_the_hint():
    offset = np.array([0.2, 0.1, 0.0])
    root = Transform(np.array([0.3, 0.0, 0.2]), maths.from_axis_angle(maths.Y, 0.4))
    frame = stand(world_from_model=root)
    changes = {"pelvis.max_length": 0.8, "leg.hint_offset": offset}
    output = solved(mec, level(-0.1), frame, changes)
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


def test_the_hint_of_mec_is_above_the_toe_hit_or_without_ground_below_the_ankle():
    frame = stand()
    calf = frame.knee.pos - frame.ankle.pos
    for ground, height in ((STEP, 0.06), (FLAT, 0.0), (DEEP, 0.0)):
        toes = frame.ankle.pos + np.array([0.0, height - ANKLE, 0.2])
        assert solved(mec, ground, frame)["hint_ws"] == pytest.approx(toes + calf)


def test_a_foot_of_mec_with_its_own_up_stands_on_a_wall():
    wall = Terrain(-maths.X, planes=[(0.15 * maths.X, maths.X)])
    output = solved(mec, LegTerrains(FLAT, [wall, FLAT]), stand())
    assert output["target_ws"][0] == pytest.approx([0.15 - ANKLE, ANKLE, 0.05])
    assert maths.rotate(output["goal_rot"][0], maths.Y) == pytest.approx(-maths.X)
    assert maths.rotate(output["goal_rot"][0], maths.Z) == pytest.approx(maths.Z)
    assert output["target_ws"][1] == pytest.approx(stand().ankle.pos[1])
    assert output["reached"].all()
