"""The ozz, Unreal and Mec pipelines against their independent NumPy references."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import jaxik
from reference import characters, maths, sample_poses
from reference.systems import mec, ozz, unreal
from reference.terrain import LegTerrains
from reference.terrain import Terrain as PlainTerrain
from support.clips import to_frames, to_ik, to_leg_terrains, to_rig, to_terrain, wandering

pytestmark = pytest.mark.slow

POSITION = 1e-5  # m
ANGLE = 1e-4  # rad
FRAMES = 600
STANDS = (0.05, 0.2, 0.3, 0.45, 0.6, 0.7, 0.8, 0.95)  # start, end, ..., fractions of the clip
SYSTEMS: dict[str, Any] = {"ozz": ozz, "unreal": unreal, "mec": mec}
CASES: list[tuple[str, str, dict[str, Any], int]] = [
    ("ozz", "as it is", {}, 2),
    ("ozz", "as the original", {"root.half_life": 0.0}, 2),
    ("ozz", "only its pelvis", {"root.enabled": False, "leg.enabled": False}, 2),
    ("ozz", "only its legs", {"pelvis.enabled": False, "foot.enabled": False}, 3),
    (
        "ozz",
        "odd",
        {
            "root.ray_up": 0.02,
            "root.half_life": 0.06,
            "root.max_speed": 0.5,
            "root.max_step": 0.05,
            "probe.ray_up": 0.3,
            "probe.ray_down": 0.08,
            "target.foot_height": 0.09,
            "target.max_slope": 0.05,
            "leg.soften": 0.9,
            "leg.twist": 0.2,
            "leg.weight": 0.8,
            "foot.offset": [0.02, 0.03, -0.04],
            "foot.twist": -0.3,
            "foot.weight": 0.7,
        },
        2,
    ),
    ("unreal", "as it is", {}, 2),
    ("unreal", "without the latch", {"effector.latch": False}, 3),
    (
        "unreal",
        "odd",
        {
            "probe.ray_up": 0.7,
            "probe.ray_down": 0.01,
            "contact.idle_speed": 0.1,
            "target.adjust": 0.02,
            "pelvis.speed": 3.0,
            "pelvis.half_height": 0.8,
            "effector.speed": 9.0,
            "effector.latch_distance": 0.003,
            "leg.weight": 0.9,
        },
        2,
    ),
    ("unreal", "without its pelvis", {"pelvis.enabled": False, "contact.idle_speed": np.inf}, 2),
    ("mec", "as it is", {}, 2),
    ("mec as it comes", "slow and low feet", {}, 2),
    ("mec", "never planted", {"lock.plant": False, "probe.by_speed": False}, 3),
    (
        "mec",
        "odd",
        {
            "probe.ray_up": 0.3,
            "probe.foot_length": 0.16,
            "probe.half_width": 0.06,
            "probe.extra_min": 0.01,
            "probe.extra_max": 0.06,
            "probe.stable_height": 0.13,
            "target.foot_height": 0.085,
            "lock.plant_weight": 0.6,
            "pelvis.min_length": 0.86,
            "pelvis.max_length": 0.89,
            "pelvis.speed": 4.0,
            "effector.transition_time": 0.11,
            "leg.hint_offset": [0.1, -0.05, 0.2],
            "leg.soften": 0.95,
            "leg.twist": -0.1,
            "leg.weight": 0.9,
            "foot.max_tilt": 0.1,
        },
        2,
    ),
    (
        "mec",
        "one active foot, fixed rays, undamped",
        {
            "probe.active": [True, False],
            "probe.by_height": False,
            "probe.by_speed": False,
            "probe.extra": 0.02,
            "pelvis.damp": False,
            "effector.transition_time": 0.0,
        },
        2,
    ),
]
UNLIKE_CASES = [("mec", {}, 2), ("mec", {"pelvis.enabled": False, "lock.plant_weight": 0.5}, 3)]
JOINTS = ("hip", "knee", "ankle", "toe")
OWN: dict[str, dict[str, Callable[[jaxik.Result], Any]]] = {  # outputs of one system only
    "ozz": {
        "lift": lambda result: result.trace.sensed.root_ws[:, 1],
        "foot_reached": lambda result: result.aimed,
    },
    "unreal": {
        "half_height": lambda result: result.trace.advanced.state.pelvis.half_height,
        "effector": lambda result: result.trace.advanced.state.effector.height,
        "asleep": lambda result: result.trace.advanced.state.effector.asleep,
        "idle": lambda result: result.trace.sensed.contact.planted[:, 0],
    },
    "mec": {
        "extra": lambda result: result.trace.sensed.ground.rays.below,
        "planted": lambda result: result.trace.advanced.hold.locked,
        "plant_weight": lambda result: result.trace.advanced.state.lock.weight,
        "fade": lambda result: result.trace.advanced.state.effector.weight,
    },
}


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_defaults_are_those_of_the_reference(name):
    ik = to_ik({}, name)
    expected = SYSTEMS[name].DEFAULTS
    for key in set(expected) - {"probe.forward"}:  # ours takes it from the rig's foot axes
        stage, _, leaf = key.partition(".")
        actual = np.asarray(getattr(getattr(ik, stage), leaf))
        np.testing.assert_allclose(actual, expected[key], rtol=1e-6, err_msg=key)


@pytest.mark.parametrize(
    ("name", "values", "legs"),
    [(name, values, legs) for name, _, values, legs in CASES],
    ids=[f"{name}, {how}" for name, how, _, _ in CASES],
)
def test_600_frames_agree_with_the_reference(name, values, legs):
    rng = np.random.default_rng(7)
    ground = sample_poses.rough(rng, cells=14, size=4.5)
    compare(name, values, legs, rng, ground, to_terrain(ground))


@pytest.mark.parametrize(("name", "values", "legs"), UNLIKE_CASES)
def test_feet_with_different_ups_agree_with_the_reference(name, values, legs):
    rng = np.random.default_rng(8)
    triangles = sample_poses.rough(rng, cells=14, size=4.5).triangles
    tilts = [maths.from_axis_angle(axis, 0.25) for axis in (maths.X, -maths.Z, maths.Z)]
    ups = [maths.Y, *(maths.rotate(tilt, maths.Y) for tilt in tilts)]
    body, *each = [PlainTerrain(up, triangles=triangles) for up in ups]
    under_legs = LegTerrains(body, each[:legs])
    compare(name, values, legs, rng, under_legs, to_leg_terrains(under_legs))


def compare(
    name: str, values: dict[str, Any], legs: int, rng: np.random.Generator, plain: Any, ours: Any
) -> None:
    """Asserts that all outputs of 600 frames agree with the reference."""
    rig = sample_poses.make_rig(rng, legs)
    frames = wandering(rig, rng, FRAMES, stand=STANDS)
    system, own = SYSTEMS[name.partition(" ")[0]], OWN[name.partition(" ")[0]]
    defaults = system.STANDS_BY_SPEED if name.endswith("as it comes") else system.DEFAULTS
    arrays = {k: np.asarray(v) if isinstance(v, list) else v for k, v in values.items()}
    parameters = characters.Parameters(arrays, defaults=defaults)
    expected = system.run(parameters, rig, plain, frames)
    result = jaxik.run(to_ik(values, name), to_rig(rig), ours, to_frames(frames))

    hits = np.asarray(result.trace.sensed.foothold.found) > 0
    np.testing.assert_array_equal(hits, expected["found"])
    assert 0.1 < hits.mean() < 0.98, "the clip has both hits and misses"
    advanced, sensed = result.trace.advanced, result.trace.sensed
    if name == "unreal" and values == {}:
        assert np.abs(np.diff(expected["asleep"].astype(int))).sum() >= 6, (
            "the latch sleeps and wakes"
        )
    pairs = {
        "body_pos": result.body.pos,
        "body_offset_ws": sensed.root_ws + advanced.state.pelvis.offset_ws,
        "pelvis_height": advanced.state.pelvis.height,
        "target_ws": advanced.effector.target_ws,
        "weight": advanced.effector.weight,
        **{f"{joint}_pos": getattr(result.pose, joint).pos for joint in JOINTS},
        **{key: read(result) for key, read in own.items()},
    }
    if not values.get("leg.enabled", True):
        del pairs["weight"]  # the reference reports legs only, ours also feet
    for key, actual in pairs.items():
        theirs = expected[key]
        if key == "target_ws":  # legs that are not solved have none
            reported = (expected["weight"] > 0)[..., None]
            actual, theirs = np.where(reported, actual, 0.0), np.where(reported, theirs, 0.0)
        np.testing.assert_allclose(np.asarray(actual), theirs, rtol=0, atol=POSITION, err_msg=key)
    for joint in JOINTS:
        rot = np.asarray(getattr(result.pose, joint).rot)
        assert sample_poses.rotation_angle(rot, expected[f"{joint}_rot"]) < ANGLE, joint
    np.testing.assert_array_equal(np.asarray(result.reached) > 0.5, expected["reached"] > 0.5)
