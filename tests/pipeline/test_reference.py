"""The NumPy references of `record`, `ozz`, `unreal` and `mec`: facts that hold whatever JAX does.

The JAX code agrees with them (`test_pipeline`), and its symmetries are shown in `test_properties`.
"""

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
from support.clips import named

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
    """Feet as high as those of `stand`, unless told otherwise."""
    sole = {} if system is unreal else {"target.foot_height": ANKLE}
    return Parameters(sole | (changes or {}), system.DEFAULTS)


def solved(
    system: ModuleType, terrain: Ground, frame: Frame, changes: dict[str, Any] | None = None
) -> dict[str, Array]:
    return system.step(parameters(system, changes), RIG, terrain, None, frame)[1]


def run_record(changes: dict[str, Any], terrain: Ground, frames: list[Frame]) -> dict[str, Array]:
    return record.run(parameters(record, changes), RIG, terrain, frames)


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


def normal_of(slope_forward: float, slope_left: float) -> Array:
    return maths.unit(np.array([-slope_left, 1.0, -slope_forward]), maths.Y)


def foot_axis(output: dict[str, Array], leg: int, axis: Array) -> Array:
    """An axis of the solved foot, model space."""
    return maths.rotate(maths.multiply(output["ankle_rot"][leg], RIG.ankle_from_foot[leg]), axis)


UNLIMITED = named("target", max_ankle_height=9.0, min_ankle_height=-9.0) | named(
    "foot", max_pitch=math.pi, min_pitch=-math.pi, max_roll=math.pi, min_roll=-math.pi
)
NO_LEAN = {"lean.forward_rate": 0.0, "lean.side_rate": 0.0}
STIFF = NO_LEAN | {"lock.enabled": False, "pelvis.limit": 0.0, "target.min_ankle_height": -9.0}
AT_ONCE = {"lock.lock_half_life": 0.0}
NOT_RAISED = {"root.enabled": False}
FAR = -1.12 + math.sqrt(0.88**2 - 0.05**2)  # m, where the pelvis is that is 0.3 m too high
NEAR = -0.37 + math.sqrt(0.5**2 - 0.05**2)  # m, and that is 0.45 m too low
LEFT: dict[str, Any] = {"world_from_model": at(0.01, 0.0, 0.0)}  # of the border
RIGHT: dict[str, Any] = {"world_from_model": at(-0.01, 0.0, 0.0)}
# Changes of the probe of `mec`, height of the ankle, speed of the foot, extra length of the ray.
EXTRAS: list[tuple[dict[str, Any], float, float, float]] = [
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
]
# Ground, frame, changes of parameters, outputs; heights are those of ankles and goals.
FACTS: dict[ModuleType, list[tuple[Ground, Frame, dict[str, Any], dict[str, Any]]]] = {
    record: [
        # The body sinks to the lower foot, and the ankle stays a foot's height above a slope.
        (LEFT_LOW, stand(), NO_LEAN, {"pelvis_height": -0.1, "body_pos": [0.0, -0.1, 0.0]}),
        (plane(0.4, 0.0), stand(), UNLIMITED | NO_LEAN, {"goal": 0.02 + ANKLE * math.sqrt(1.16)}),
        # The knee's limit keeps the leg from straightening.
        (level(-0.6), stand(), STIFF | {"leg.max_knee_angle": 2.6}, {"knee": math.cos(2.6)}),
        (level(-0.6), stand(), STIFF | {"leg.max_knee_angle": 2.6}, {"reached": False}),
    ],
    ozz: [
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
        *(
            (
                level(height - ANKLE - extra + above),
                stand(height=height, foot_speed=np.full(2, speed)),
                named("probe", **changes),
                {"extra": extra, "found": above > 0.0},
            )
            for changes, height, speed, extra in EXTRAS
            for above in (0.001, -0.001)
        ),
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


@pytest.mark.parametrize("system", FACTS)
def test_one_frame_has_the_outputs_that_follow_from_the_description(system):
    for number, (ground, frame, changes, expected) in enumerate(FACTS[system]):
        output = solved(system, ground, frame, changes)
        output |= {"height": output["ankle_pos"][:, 1], "goal": output["target_ws"][:, 1]}
        bones = (output[f"{joint}_pos"] - output["knee_pos"] for joint in ("hip", "ankle"))
        thigh, shin = (bone / np.linalg.norm(bone, axis=-1, keepdims=True) for bone in bones)
        output["knee"] = np.sum(thigh * shin, axis=-1)  # cosine of its angle
        for name, value in expected.items():
            actual, message = output[name].astype(float), f"{name} of fact {number}: {changes}"
            wanted = np.broadcast_to(value, actual.shape)
            np.testing.assert_allclose(actual, wanted, rtol=0, atol=EXACT, err_msg=message)


@pytest.mark.parametrize("system", FACTS)
def test_flat_ground_leaves_a_standing_pose_unchanged(system):
    frame = stand()
    output = solved(system, FLAT, frame)
    for name in ("hip", "knee", "ankle", "toe"):
        assert np.allclose(output[f"{name}_pos"], getattr(frame, name).pos, atol=EXACT)
        assert rotation_angle(output[f"{name}_rot"], getattr(frame, name).rot) < 1e-7
    assert output["reached"].all() and np.all(output.get("weight", 1.0) == 1.0)


@pytest.mark.parametrize("system", FACTS)
def test_joints_carry_their_bones_and_reached_ankles_are_on_their_targets(system):
    rig = clips.make_rig(1)
    frames = clips.wandering(rig, np.random.default_rng(1), 90, stand=(0.1, 0.4, 0.6, 0.9))
    output = system.run(parameters(system, {"leg.twist": 0.3}), rig, clips.BROKEN, frames)
    assert 20 < output["reached"].sum() < output["reached"].size
    for index, leg in np.ndindex(*output["reached"].shape):
        frame = frames[index]
        for upper, lower in (("hip", "knee"), ("knee", "ankle"), ("ankle", "toe")):
            joint = Transform(*(part[leg] for part in getattr(frame, upper)))
            local = maths.unapply(joint, getattr(frame, lower).pos[leg])
            if upper != "ankle" and "stretch" in output:
                local = local * output["stretch"][index, leg]
            now = Transform(output[f"{upper}_pos"][index, leg], output[f"{upper}_rot"][index, leg])
            carried = maths.apply(now, local)
            assert np.allclose(carried, output[f"{lower}_pos"][index, leg], atol=EXACT)
        ankle = maths.apply(frame.world_from_model, output["ankle_pos"][index, leg])
        if output["reached"][index, leg]:
            assert np.allclose(ankle, output["target_ws"][index, leg], atol=EXACT)


@pytest.mark.parametrize("rise", [(0.3, 0.0), (0.0, 0.3), (0.0, -0.4), (-0.2, 0.0), (0.2, -0.3)])
def test_a_sole_lies_on_a_slope_and_keeps_the_heading_of_the_toes(rise):
    """Of `mec`, if it rises ahead or aside. `ozz` keeps the heading of the foot on its leg."""
    ground, normal = plane(*rise), normal_of(*rise)
    upright = [
        solved(record, ground, stand(), UNLIMITED | {"probe.use_toe": use_toe})
        for use_toe in (False, True)
    ]
    upright += [solved(mec, ground, stand())] if 0.0 in rise else []
    of_ozz, carried = (
        solved(ozz, ground, stand(), {"foot.enabled": enabled}) for enabled in (True, False)
    )
    for leg in range(2):
        for output in (*upright, of_ozz):
            assert np.allclose(foot_axis(output, leg, maths.Y), normal, atol=EXACT)
        for output in upright:
            assert foot_axis(output, leg, maths.Z)[0] == pytest.approx(0.0, abs=EXACT)
        before, after = (foot_axis(pose, leg, maths.Z) for pose in (carried, of_ozz))
        assert abs(np.cross(normal, before) @ after) < EXACT and before @ after > 0.9


# record.


def test_limits_mirror_and_stop_the_outer_edge():
    changes = {"foot.max_roll": 0.1, "foot.min_roll": -0.3, "probe.use_toe": False}
    output = solved(record, plane(0.0, 0.5), stand(), UNLIMITED | changes | NO_LEAN)
    tilts = []
    for leg in range(2):
        shin = maths.unit(output["ankle_pos"][leg] - output["knee_pos"][leg], -maths.Y)
        # Limits apply to the angle between foot and shin.
        joint = -math.asin(float(RIG.side[leg] * maths.X @ shin))
        up = foot_axis(output, leg, maths.Y)
        tilts.append(joint + math.atan2(-RIG.side[leg] * up[0], up[1]))
    # Ground rising to the left lifts the left foot's outer edge and lowers the right one's.
    assert tilts == pytest.approx([0.1, -0.3], abs=EXACT)


@pytest.mark.parametrize("hz", [30.0, 120.0])
def test_a_released_offset_halves_each_half_life(hz):
    half_life, dt = 0.1, 1.0 / hz
    dragged = [stand(0.02 * i, dt=dt) for i in range(3)]
    lifted = [make_frame(RIG, standing((0.2, 0.2)), dt=dt)] * (1 + int(hz * half_life))
    output = run_record(AT_ONCE | {"lock.unlock_half_life": half_life}, FLAT, dragged + lifted)
    offset, locked = output["offset_ws"], output["locked"]
    assert locked[:3].all() and not locked[3:].any()
    assert np.allclose(offset[2], [0.0, 0.0, -0.04], atol=EXACT)
    assert np.allclose(offset[3], offset[2] * 2 ** (-dt / half_life), atol=EXACT)
    assert np.allclose(offset[-1], offset[3] / 2.0, atol=EXACT)


def test_a_foot_locks_again_only_below_the_threshold():
    frames = [stand(), *[make_frame(RIG, standing((0.2, 0.2)))] * 3, *[stand()] * 20]
    changes = AT_ONCE | {"lock.unlock_half_life": 0.1, "lock.relock_threshold": 0.3}
    locked = run_record(changes, FLAT, frames)["locked"]
    first = 4 + int(np.argmax(locked[4:, 0]))
    # Free since frame 1 with a factor of 2^(-frames / 6).
    assert 2 ** (-(first - 1) / 6) <= 0.3 < 2 ** (-(first - 2) / 6)
    assert not locked[1:first].any() and locked[first:].all()


def test_a_lock_waits_until_the_pelvis_brings_the_leg_within_reach():
    output = run_record({}, level(-0.1), [stand()] * 2)
    assert output["locked"].tolist() == [[False, False], [True, True]]


@pytest.mark.parametrize("height", [0.0, -0.1])
def test_the_release_cone_is_measured_from_the_lowered_hip(height):
    places = [0.1 + 0.03 * i for i in range(5)]
    # The pelvis settles in the first frame, so the hip is as far from the sole as animated.
    frames = [stand(place) for place in [places[0], *places]]
    cone = math.radians(4.5)
    output = run_record(AT_ONCE | {"lock.release_cone": cone}, level(height), frames)
    angles = [math.atan2(place, 0.9 - ANKLE) for place in places]
    inside = [angle - angles[0] <= cone for angle in angles]
    assert inside == [True, True, True, False, False]
    assert output["locked"][1:].T.tolist() == [inside, inside]


@pytest.mark.parametrize("hz", [30, 60, 120])
def test_the_pelvis_gets_as_far_at_any_rate(hz):
    frames = [make_frame(RIG, standing((0.2, 0.2)), dt=1 / hz)] + [stand(dt=1 / hz)] * (hz // 10)
    expected = -0.1 * (1.0 - 0.5 ** (0.1 / 0.09065))
    heights = run_record(NO_LEAN, LEFT_LOW, frames)["pelvis_height"]
    assert heights[-1] == pytest.approx(expected, abs=EXACT)


def test_the_body_leans_about_its_hips_as_far_as_its_rate_and_can_sink_along_the_normal():
    for rises in ((0.3, 0.0), (0.0, 0.3)):
        output = solved(record, plane(*rises), stand(), dict.fromkeys(NO_LEAN, 1.0))
        assert np.allclose(maths.rotate(output["body_rot"], maths.Y), normal_of(*rises), atol=EXACT)
    for vertical_only, direction in ((True, maths.Y), (False, normal_of(0.3, 0.2))):
        changes = {"pelvis.vertical_only": vertical_only, "lean.forward_rate": 0.7}
        output = solved(record, plane(0.3, 0.2, -0.1), stand(), changes)
        assert output["pelvis_height"] < -0.05
        assert rotation_angle(output["body_rot"], maths.IDENTITY) > 0.1
        moved = np.mean(output["hip_pos"] - stand().hip.pos, axis=0)
        assert np.allclose(moved, output["pelvis_height"] * direction, atol=EXACT)


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


def test_the_pelvis_of_mec_is_damped_by_the_clamped_speed_law():
    for speed, damp, part in ((10, True, 1 / 6), (30, True, 0.5), (10, False, 1)):
        changes = {"pelvis.speed": speed, "pelvis.damp": damp}
        last = follow([FLAT, level(-0.3)], [stand()] * 2, changes)[-1]
        assert last["pelvis_height"] == pytest.approx(part * FAR)


def test_the_knee_of_mec_points_at_a_hint_above_the_toe_hit_or_without_ground_below_the_ankle():
    for ground, height in ((STEP, 0.06), (FLAT, 0.0), (DEEP, 0.0)):
        toes = stand().ankle.pos + np.array([0.0, height - ANKLE, 0.2])
        calf = stand().knee.pos - stand().ankle.pos
        assert solved(mec, ground, stand())["hint_ws"] == pytest.approx(toes + calf)
    offset, root = np.array([0.2, 0.1, 0.0]), at(0.3, 0.0, 0.2)
    root = root._replace(rot=maths.from_axis_angle(maths.Y, 0.4))
    frame = stand(world_from_model=root)
    changes = {"pelvis.max_length": 0.8, "leg.hint_offset": offset}
    output = solved(mec, level(-0.1), frame, changes)
    assert output["pelvis_height"] < -0.1 and output["reached"].all()
    for leg in range(2):
        calf = frame.knee.pos[leg] - frame.ankle.pos[leg]
        hint = frame.ankle.pos[leg] + np.array([0.0, -ANKLE - 0.1, 0.2]) + calf + offset
        assert output["hint_ws"][leg] == pytest.approx(maths.apply(root, hint))
        hip, knee, ankle = (output[f"{name}_pos"][leg] for name in ("hip", "knee", "ankle"))
        assert abs(np.cross(ankle - hip, hint - hip) @ (knee - hip)) < EXACT
        along = maths.unit(ankle - hip, maths.Y)
        assert maths.across(knee - hip, along) @ maths.across(hint - hip, along) > 0.0


def test_a_foot_of_mec_with_its_own_up_stands_on_a_wall():
    wall = Terrain(-maths.X, planes=[(0.15 * maths.X, maths.X)])
    output = solved(mec, LegTerrains(FLAT, [wall, FLAT]), stand())
    assert output["target_ws"][0] == pytest.approx([0.15 - ANKLE, ANKLE, 0.05])
    assert maths.rotate(output["goal_rot"][0], maths.Y) == pytest.approx(-maths.X)
    assert maths.rotate(output["goal_rot"][0], maths.Z) == pytest.approx(maths.Z)
    assert output["target_ws"][1] == pytest.approx(stand().ankle.pos[1])
    assert output["reached"].all()
