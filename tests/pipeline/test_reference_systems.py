"""The NumPy references of `ozz`, `unreal` and `mec`: facts that hold whatever the JAX code does.

More about `mec` is in `test_reference_mec`.
"""

import dataclasses
import math
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from reference import maths
from reference.characters import Frame, Ground, Parameters, Rig
from reference.maths import Array, Transform
from reference.sample_poses import ANKLE, make_frame, make_rig, plane, rotation_angle, standing
from reference.systems import mec, ozz, unreal
from reference.terrain import Terrain
from support import clips

EXACT = 1e-9  # m and rad
RIG = make_rig(np.random.default_rng(0))
FLAT = plane(0.0, 0.0)
LEFT_LOW = Terrain(  # 0.1 m lower under the left leg than under the right
    maths.Y,
    triangles=np.array(
        [
            [[0.0, -0.1, -9.0], [9.0, -0.1, 0.0], [0.0, -0.1, 9.0]],
            [[0.0, 0.0, -9.0], [-9.0, 0.0, 0.0], [0.0, 0.0, 9.0]],
        ]
    ),
)
LEFT_ONLY = Terrain(maths.Y, triangles=LEFT_LOW.triangles[:1])


def parameters(system: ModuleType, changes: dict[str, Any] | None = None) -> Parameters:
    """Feet as high as those of `poses`, unless told otherwise."""
    sole = {} if system is unreal else {"target.foot_height": ANKLE}
    return Parameters(sole | (changes or {}), system.DEFAULTS)


def step(
    system: ModuleType,
    terrain: Ground,
    frame: Frame,
    changes: dict[str, Any] | None = None,
    state: Any = None,
    rig: Rig = RIG,
) -> tuple[Any, dict[str, Array]]:
    return system.step(parameters(system, changes), rig, terrain, state, frame)


def stand(forward: float = 0.05, **changes: Any) -> Frame:
    return make_frame(RIG, standing(forward=forward), **changes)


def foot_axis(output: dict[str, Array], leg: int, axis: Array) -> Array:
    """An axis of the solved foot, model space."""
    return maths.rotate(maths.multiply(output["ankle_rot"][leg], RIG.ankle_from_foot[leg]), axis)


# All three systems.


@pytest.mark.parametrize("system", [ozz, unreal, mec])
def test_flat_ground_leaves_a_standing_pose_unchanged(system):
    frame = stand()
    _, output = step(system, FLAT, frame)
    for name in ("hip", "knee", "ankle", "toe"):
        assert np.allclose(output[f"{name}_pos"], getattr(frame, name).pos, atol=EXACT)
        assert rotation_angle(output[f"{name}_rot"], getattr(frame, name).rot) < 1e-7
    assert output["reached"].all() and (output["weight"] == 1.0).all()


@pytest.mark.parametrize("system", [ozz, unreal, mec])
def test_bones_keep_their_lengths_and_reached_ankles_are_on_their_targets(system):
    rig = clips.make_rig(1)
    frames = clips.wandering(rig, np.random.default_rng(1), 90, stand=(0.1, 0.4, 0.6, 0.9))
    output = system.run(parameters(system), rig, clips.BROKEN, frames)
    for one, other in (("hip", "knee"), ("knee", "ankle"), ("ankle", "toe")):
        after = output[f"{one}_pos"] - output[f"{other}_pos"]
        before = np.array([getattr(f, one).pos - getattr(f, other).pos for f in frames])
        assert np.allclose(
            np.linalg.norm(after, axis=-1), np.linalg.norm(before, axis=-1), atol=EXACT
        )
    assert 20 < output["reached"].sum() < output["reached"].size
    for index, leg in zip(*np.nonzero(output["reached"]), strict=True):
        ankle = maths.apply(frames[index].world_from_model, output["ankle_pos"][index, leg])
        assert np.allclose(ankle, output["target_ws"][index, leg], atol=EXACT)


def test_an_unknown_parameter_is_named_with_those_of_the_system():
    with pytest.raises(ValueError, match=r"lock\.enabled.*effector\.latch"):
        Parameters({"lock.enabled": True}, unreal.DEFAULTS)


@pytest.mark.parametrize("mask, height", [(0b01, 0.0), (0b10, 0.1), (0b100, 0.2), (0b111, 0.2)])
def test_a_ray_hits_only_layers_in_its_mask(mask, height):
    ground = Terrain(
        maths.Y,
        planes=[(maths.Y * 0.0, maths.Y), (maths.Y * 0.1, maths.Y)],
        plane_layers=[0, 1],
        triangles=LEFT_LOW.triangles[:1] + 0.3 * maths.Y,
        triangle_layers=[2],
    )
    hit = ground.cast(np.array([1.0, 1.0, 0.0]), math.inf, mask)
    assert hit.found and hit.point[1] == pytest.approx(height, abs=EXACT)
    assert not ground.cast(np.array([-1.0, 1.0, 0.0]), math.inf, 0b100).found


def test_standing_parts_of_the_wandering_clip_have_no_speed():
    frames = clips.wandering(RIG, np.random.default_rng(2), 60, stand=(0.4, 0.6))
    speed = np.array([frame.speed for frame in frames])
    assert (speed[24:36] == 0.0).all()
    assert np.allclose(np.concatenate([speed[:24], speed[36:]]), 0.6, atol=EXACT)
    still = np.array([frame.foot_speed for frame in frames[25:36]])
    assert (still > 0.0).all() and (still < 0.15).all()


# ozz.


def test_ozz_puts_the_sole_on_a_slope_and_keeps_the_heading_of_the_toes():
    slope = plane(0.3, -0.2)
    normal = maths.unit(np.array([0.2, 1.0, -0.3]), maths.Y)
    _, output = step(ozz, slope, stand(), {"target.foot_height": 0.12})
    carried = {"target.foot_height": 0.12, "foot.enabled": False}
    _, carried = step(ozz, slope, stand(), carried)
    assert output["reached"].all() and output["foot_reached"].all()
    for leg in range(2):
        assert output["ankle_pos"][leg] @ normal == pytest.approx(0.12, abs=EXACT)
        assert np.allclose(foot_axis(output, leg, maths.Y), normal, atol=EXACT)
        before, after = (foot_axis(pose, leg, maths.Z) for pose in (carried, output))
        assert abs(np.cross(normal, before) @ after) < EXACT and before @ after > 0.9


def test_ozz_raises_the_root_or_else_the_pelvis_onto_the_ground():
    raised = plane(0.0, 0.0, 0.4)
    outputs = [step(ozz, raised, stand(), {"root.enabled": on})[1] for on in (True, False)]
    assert [float(output["lift"]) for output in outputs] == pytest.approx([0.4, 0.0])
    assert [float(output["pelvis_height"]) for output in outputs] == pytest.approx([0.0, 0.4])
    for output in outputs:
        assert np.allclose(output["body_offset_ws"], [0.0, 0.4, 0.0], atol=EXACT)
        assert np.allclose(output["ankle_pos"], stand().ankle.pos + 0.4 * maths.Y, atol=EXACT)


def test_ozz_sinks_to_the_lowest_foot_and_bends_the_other_leg():
    frame = stand(world_from_model=Transform(np.array([-0.01, 0.0, 0.0]), maths.IDENTITY))
    _, output = step(ozz, LEFT_LOW, frame)
    assert output["lift"] == 0.0
    assert output["pelvis_height"] == pytest.approx(-0.1, abs=EXACT)
    assert np.allclose(output["ankle_pos"][:, 1], [ANKLE - 0.1, ANKLE], atol=EXACT)
    half = dataclasses.replace(frame, weight=np.array([0.5, 1.0]))
    assert step(ozz, LEFT_LOW, half)[1]["pelvis_height"] == pytest.approx(-0.05, abs=EXACT)
    _, level = step(ozz, LEFT_LOW, frame, {"pelvis.enabled": False})
    assert level["pelvis_height"] == 0.0 and np.allclose(level["hip_pos"], frame.hip.pos)


def test_ozz_moves_a_leg_without_ground_only_with_the_body():
    frame = stand(world_from_model=Transform(np.array([0.01, 0.0, 0.0]), maths.IDENTITY))
    _, output = step(ozz, LEFT_ONLY, frame, {"target.foot_height": 0.05})
    assert output["lift"] == pytest.approx(-0.1, abs=EXACT)
    assert output["pelvis_height"] == pytest.approx(-0.03, abs=EXACT)
    assert output["weight"].tolist() == [1.0, 0.0] and not output["reached"][1]
    assert np.allclose(output["knee_pos"], frame.knee.pos - 0.13 * maths.Y, atol=EXACT)
    assert rotation_angle(output["ankle_rot"], frame.ankle.rot) < 1e-7


@pytest.mark.parametrize(
    "changes, height, lift, hits",
    [
        ({"root.ray_up": 0.3}, 0.4, 0.0, True),
        ({"root.ray_down": 0.3}, -0.4, 0.0, True),
        ({"root.ray_down": 0.5}, -0.4, -0.4, True),
        ({"root.enabled": False, "probe.ray_up": 0.3}, 0.4, 0.0, False),
        ({"root.enabled": False, "probe.ray_down": 0.4}, -0.4, 0.0, False),
    ],
)
def test_ozz_finds_no_ground_beyond_its_rays(changes, height, lift, hits):
    _, output = step(ozz, plane(0.0, 0.0, height), stand(), changes)
    assert output["lift"] == pytest.approx(lift) and (output["found"] == hits).all()
    moved = height if hits else 0.0
    assert np.allclose(output["ankle_pos"], stand().ankle.pos + moved * maths.Y, atol=EXACT)


def test_ozz_limits_how_far_a_slope_raises_the_ankle():
    for slope, steepest, cosine in ((1.0, 1.5, math.sqrt(0.5)), (1.0, 0.3, math.cos(0.3))):
        _, output = step(ozz, plane(slope, 0.0), stand(), {"target.max_slope": steepest})
        assert output["target_ws"][:, 1] == pytest.approx(0.05 * slope + ANKLE / cosine)


@pytest.mark.parametrize("leg, foot", [(False, True), (True, False), (False, False)])
def test_ozz_can_switch_off_leg_and_foot_separately(leg, foot):
    frame = stand()
    changes = {"leg.enabled": leg, "foot.enabled": foot, "pelvis.enabled": False}
    _, output = step(ozz, plane(0.3, 0.0, 0.05), frame, changes | {"root.enabled": False})
    assert np.allclose(output["ankle_pos"], frame.ankle.pos, atol=EXACT) == (not leg)
    turned = rotation_angle(output["ankle_rot"], frame.ankle.rot) > 1e-3
    assert turned == (leg or foot) and output["foot_reached"].all() == foot


def test_ozz_aims_from_an_offset_and_leaves_the_foot_where_the_offset_is_too_far():
    slope = plane(0.3, 0.0)
    normal = maths.unit(np.array([0.0, 1.0, -0.3]), maths.Y)
    offset = np.array([0.02, 0.01, 0.1])
    _, output = step(ozz, slope, stand(), {"foot.offset": offset})
    for leg in range(2):
        away = normal - foot_axis(output, leg, offset)
        assert np.allclose(np.cross(foot_axis(output, leg, maths.Y), away), 0.0, atol=EXACT)
    far = {"foot.offset": np.array([0.0, 0.0, 2.0])}
    _, output = step(ozz, slope, stand(), far)
    _, carried = step(ozz, slope, stand(), {"foot.enabled": False})
    assert not output["foot_reached"].any()
    assert rotation_angle(output["ankle_rot"], carried["ankle_rot"]) < EXACT


# unreal.


def test_unreal_starts_at_its_goals():
    _, output = step(unreal, LEFT_LOW, stand())
    assert output["hip"] == pytest.approx(-0.1) and output["half_height"] == pytest.approx(0.85)
    assert np.allclose(output["effector"], [0.0, 0.1], atol=EXACT) and output["asleep"]
    assert np.allclose(output["ankle_pos"][:, 1], [ANKLE - 0.1, ANKLE], atol=EXACT)
    assert rotation_angle(output["ankle_rot"], stand().ankle.rot) < 1e-7


def test_unreal_moves_by_the_clamped_speed_law_and_its_latch_freezes_the_hip_short():
    frames = [stand(speed=1.0)] + [stand()] * 4 + [stand(speed=1.0)] * 2
    for latch, hips in (
        (True, [0.0, -0.025, -0.025, -0.025, -0.025, -0.01875, -0.0140625]),
        (False, [0.0, *(-0.1 * (1 - 0.75**n) for n in range(1, 5))]),
    ):
        values = parameters(unreal, {"effector.latch": latch})
        output = unreal.run(values, RIG, plane(0.0, 0.0, -0.1), frames)
        assert np.allclose(output["hip"][: len(hips)], hips, atol=EXACT)
        half = 0.9 + np.array(hips) / 2
        assert np.allclose(output["half_height"][: len(hips)], half, atol=EXACT)
        assert output["asleep"].tolist() == [False] + [latch] * 4 + [False] * 2


def test_unreal_sleeps_only_when_all_active_feet_are_near_their_goals():
    for weight, naps in ((np.ones(2), False), (np.array([1.0, 0.0]), True)):
        frames = [stand(speed=1.0, weight=weight), stand(weight=weight)]
        output = unreal.run(parameters(unreal), RIG, LEFT_LOW, frames)
        assert bool(output["asleep"][1]) == naps
        assert np.allclose(output["effector"][1], [0.0, 0.025], atol=EXACT)
    for distance, naps in ((0.074, False), (0.076, True)):
        frames = [stand(speed=1.0), stand()]
        values = parameters(unreal, {"effector.latch_distance": distance})
        assert unreal.run(values, RIG, LEFT_LOW, frames)["asleep"][1] == naps


@pytest.mark.parametrize(
    "changes, height, effector",
    [
        ({}, 0.1, 0.1),
        ({"target.adjust": 0.02}, 0.1, 0.12),
        ({}, 0.91, 0.0),
        ({"probe.ray_up": 0.92}, 0.91, 0.91),
        ({}, -0.51, 0.0),
        ({"probe.ray_down": 0.52}, -0.51, 0.0),
    ],
)
def test_unreal_measures_from_the_origin_and_finds_no_ground_beyond_its_ray(
    changes, height, effector
):
    _, output = step(unreal, plane(0.0, 0.0, height), stand(), changes)
    assert np.allclose(output["effector"], effector, atol=EXACT)
    assert output["hip"] == pytest.approx(height if changes and height < 0 else 0.0)


def test_unreal_brings_each_foot_to_its_own_ground_and_idles_below_a_speed():
    _, output = step(unreal, LEFT_LOW, stand())
    assert np.allclose(output["target_ws"][:, 1], [ANKLE - 0.1, ANKLE], atol=EXACT)
    _, output = step(unreal, LEFT_LOW, stand(speed=0.5))
    assert output["hip"] == 0.0 and not output["idle"]
    _, output = step(unreal, LEFT_LOW, stand(speed=0.5), {"contact.idle_speed": 0.5})
    assert output["hip"] == pytest.approx(-0.1) and output["idle"]
    _, output = step(unreal, LEFT_LOW, stand(weight=np.array([0.0, 1.0])))
    assert output["hip"] == 0.0 and output["effector"][0] == pytest.approx(-0.1)
    _, output = step(unreal, LEFT_LOW, stand(), {"pelvis.enabled": False})
    assert output["hip"] == 0.0 and np.allclose(output["effector"], [-0.1, 0.0], atol=EXACT)


# Parameters that no test above changes.

OTHER_NUMBERS = {
    ozz: {
        "pelvis.limit": 0.02,
        "pelvis.on_gain": 0.2,
        "leg.soften": 0.9,
        "leg.twist": 0.2,
        "leg.weight": 0.5,
        "foot.twist": 0.2,
        "foot.weight": 0.5,
    },
    unreal: {
        "pelvis.speed": 5.0,
        "pelvis.half_height": 1.0,
        "effector.speed": 5.0,
        "leg.min_knee_angle": 2.9,
        "leg.max_knee_angle": 1.5,
        "leg.soften": 0.8,
        "leg.twist": 0.2,
        "leg.weight": 0.5,
    },
    mec: {"leg.soften": 0.8, "leg.twist": 0.2, "leg.weight": 0.5, "foot.max_tilt": 0.05},
}
PLACES = ("hip_pos", "knee_pos", "ankle_pos", "toe_pos", "half_height")


@pytest.mark.parametrize(
    "system, name", [(system, name) for system, names in OTHER_NUMBERS.items() for name in names]
)
def test_each_parameter_changes_the_result(system, name):
    rig = clips.make_rig(1)
    frames = clips.wandering(rig, np.random.default_rng(1), 16, stand=(0.4, 0.8))
    ground = clips.planes((0.4, 0.2, 1.35))  # uneven under the clip, and nearby
    plain = system.run(parameters(system), rig, ground, frames)
    value = OTHER_NUMBERS[system][name]
    changed = system.run(parameters(system, {name: value}), rig, ground, frames)
    assert any(np.abs(plain[key] - changed[key]).max() > 1e-3 for key in PLACES if key in plain)
