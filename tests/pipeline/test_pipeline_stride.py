"""The stride pipeline against its independent NumPy reference."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
import pytest

import jaxik
from reference import characters, maths, sample_poses
from reference.systems import stride
from reference.terrain import LegTerrains
from reference.terrain import Terrain as PlainTerrain
from support.cases import QUICK
from support.clips import to_frames, to_ik, to_leg_terrains, to_rig, to_terrain
from support.strides import blocks, walk

POSITION = 1e-5  # m
ANGLE = 1e-4  # rad
FRAMES = 600
JOINTS = ("hip", "knee", "ankle", "toe")
RULES = {"stride": ("label", "reach"), "by speed": ("speed", "support")}
LOCKS = {"lock.enabled": True}
ODD: dict[str, Any] = LOCKS | {  # away from the defaults
    "probe.ray_up": 0.7,
    "probe.ray_down": 0.11,
    "probe.rise_start": 0.1,
    "probe.rise_end": 0.8,
    "probe.steepness": 2.7,
    "probe.max_step_up": 0.16,
    "probe.max_step_down": 0.14,
    "probe.max_slope": 0.1,
    "probe.clearance": 0.05,
    "probe.way_slope": 0.7,
    "probe.heel_length": 0.1,
    "probe.ball_height": 0.04,
    "probe.toe_length": 0.06,
    "probe.held_lift": 0.4,
    "probe.toe_clearance": 0.05,
    "probe.lift_per_rise": 0.3,
    "probe.lift_per_fall": 0.6,
    "probe.lift_over": 1.2,
    "probe.toes_up": 0.2,
    "probe.toes_down": 0.1,
    "probe.toes_down_per_height": 1.4,
    "probe.toes_first": 1.1,
    "probe.min_sole": 0.9,
    "probe.max_slide": 0.06,
    "probe.stance_time": 0.5,
    "probe.swing_time": 0.37,
    "target.foot_height": 0.07,
    "target.max_slope": 0.08,
    "target.max_ankle_height": 0.25,
    "target.rise_half_life": 0.03,
    "target.fall_half_life": 0.05,
    "lock.lock_half_life": 0.02,
    "lock.release_heading": 0.04,
    "lock.release_speed": 0.8,
    "lock.release_distance": 0.05,
    "lean.pelvis_rate": -0.4,
    "lean.pelvis_side_rate": 0.3,
    "lean.half_life": 0.15,
    "effector.extension": 0.94,
    "effector.max_lift": 0.11,
    "leg.soften": 0.95,
    "leg.twist": 0.1,
    "foot.max_roll": 0.05,
}
REACH = {
    "contact.ground_height": 0.01,
    "pelvis.highest_share": 0.5,
    "pelvis.extension": 0.93,
    "pelvis.softness": 0.04,
    "pelvis.shift": 0.3,
    "pelvis.rise_half_life": 0.04,
    "pelvis.fall_half_life": 0.07,
}
SUPPORT = {
    "contact.ground_height": 0.01,
    "contact.planted_height": 0.071,
    "contact.raised_height": 0.09,
    "contact.planted_speed": 0.31,
    "contact.raised_speed": 0.9,
    "contact.half_life": 0.03,
    "pelvis.lowest_share": 0.6,
    "pelvis.rise_half_life": 0.05,
    "pelvis.fall_half_life": 0.03,
}
SPRUNG = {"target.spring": True, "target.follow_slopes": True, "pelvis.spring": True}
CASES: list[tuple[str, str, dict[str, Any], dict[str, Any]]] = [
    ("as it is", "stride", {}, {}),
    ("unknown footholds", "stride", LOCKS, {"footholds_known": False}),
    ("odd", "stride", ODD | REACH | {"leg.weight": np.array([1.0, 0.9])}, {}),
    (
        "odd, sprung and without footholds",
        "stride",
        ODD | REACH | SPRUNG,
        {"footholds_known": False},
    ),
    (
        "held by the ankle, softened and swung as animated",
        "stride",
        LOCKS
        | {"lock.hold_ball": False, "leg.as_animated": False, "probe.swing_as_animated": True},
        {},
    ),
    ("unused footholds", "stride", {"probe.use_strides": False}, {}),
    ("on a platform", "stride", LOCKS | {"lock.release_heading": 0.06}, {"rides": True}),
    ("as it is", "by speed", {}, {"footholds_known": False, "leaps": True}),
    ("odd and sprung", "by speed", ODD | SUPPORT | SPRUNG, {}),
]
compiled = jax.jit(jaxik.run, compiler_options=QUICK)


@functools.cache
def rig_of(legs: int = 2) -> characters.Rig:
    return sample_poses.make_rig(np.random.default_rng(4), legs)


@functools.cache
def uneven() -> PlainTerrain:
    return blocks(np.random.default_rng(3))


def carousel(time: float) -> characters.Transform:
    """A platform that drifts and turns."""
    pos = np.array([-0.1, 0.05, -0.2]) + time * np.array([0.03, -0.01, 0.08])
    return maths.Transform(pos, maths.from_axis_angle(maths.Y, 0.02 * time))


def clip(
    legs: int = 2, footholds_known: bool = True, rides: bool = False, leaps: bool = False
) -> list[characters.Frame]:
    """A walk across all blocks and beyond, with slipping, turning and partly weighted feet.

    Even known footholds are unknown for a while, and contact labels are uncertain for another. The
    ways between known footholds bend. The walk can leap at the start and once again with feet too
    fast to stand. Its ground can ride on a platform.
    """
    rig, rng = rig_of(legs), np.random.default_rng(5)
    frames = walk(
        rig, FRAMES, known=footholds_known, heading=0.12, start=(-0.5, 0.03, -3.7), speed=0.8
    )
    aside = np.outer(rig.side, [0.12, 0.03, 0.05])  # also upward, which does not count
    changed = []
    for index, frame in enumerate(frames):
        fraction, time = index / FRAMES, index / 60
        stride = frame.stride
        assert stride is not None
        weight, known, standing = np.ones(legs), stride.known, stride.standing
        if 0.5 < fraction < 0.55:
            weight[0] = 0.5
        if 0.6 < fraction < 0.62:
            weight[-1] = 0.0
        if 0.7 < fraction < 0.8:
            known = 0.0 * known
        if 0.3 < fraction < 0.4:
            standing = 0.2 + 0.6 * standing
        wobble = maths.from_axis_angle(
            maths.unit(rng.normal(size=3), maths.Y), rng.uniform(0.0, 0.1)
        )
        slip = frame.world_from_model.pos + [0.02 * np.sin(7 * time), 0.01 * np.sin(5 * time), 0.0]
        rot = maths.multiply(
            frame.world_from_model.rot, maths.from_axis_angle(maths.Y, 0.1 * np.sin(time))
        )
        changed.append(
            dataclasses.replace(
                frame,
                world_from_model=maths.Transform(slip, rot),
                ankle=frame.ankle._replace(
                    rot=np.array([maths.multiply(wobble, r) for r in frame.ankle.rot])
                ),
                weight=weight,
                stride=dataclasses.replace(stride, known=known, standing=standing, aside_ws=aside),
                platforms=[carousel(time)] if rides else [],
                platforms_before=[carousel(max(index - 1, 0) / 60)] if rides else [],
            )
        )
    timed = sample_poses.with_speeds(changed)
    airborne = [leaps and (i < 12 or 400 < i < 440) for i in range(FRAMES)]
    return [
        dataclasses.replace(frame, toe_speed=frame.toe_speed + 3.0 * flies)
        for frame, flies in zip(timed, airborne, strict=True)
    ]


@pytest.mark.parametrize("name", RULES)
def test_the_defaults_are_those_of_the_reference(name):
    ik = to_ik({}, name)
    for key, expected in stride.defaults(*RULES[name]).items():
        rule, _, leaf = key.partition(".")
        actual = np.asarray(getattr(getattr(ik, rule), leaf))
        np.testing.assert_allclose(actual, expected, rtol=1e-6, err_msg=key)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("preset", "values", "how"),
    [case[1:] for case in CASES],
    ids=[f"{preset}, {name}" for name, preset, *_ in CASES],
)
def test_600_frames_agree_with_the_reference(preset, values, how):
    ground = dataclasses.replace(uneven(), platform=0 if how.get("rides") else -1)
    compare(preset, values, clip(**how), ground, to_terrain(ground))


@pytest.mark.slow
def test_feet_with_different_ups_agree_with_the_reference():
    tilts = [maths.from_axis_angle(axis, 0.2) for axis in (maths.X, -maths.Z, maths.Z)]
    ups = [maths.Y, *(maths.rotate(tilt, maths.Y) for tilt in tilts)]
    body, *each = [PlainTerrain(up, triangles=uneven().triangles) for up in ups]
    under_legs = LegTerrains(body, each)
    compare("stride", ODD | REACH, clip(legs=3), under_legs, to_leg_terrains(under_legs))


def compare(
    preset: str, values: dict[str, Any], frames: Sequence[characters.Frame], plain: Any, ours: Any
) -> None:
    """Asserts that all outputs of 600 frames agree with the reference."""
    rules = RULES[preset]
    rig = rig_of(len(frames[0].weight))
    parameters = characters.Parameters(values, defaults=stride.defaults(*rules))
    expected = stride.run(parameters, rig, plain, frames, *rules)
    result = compiled(to_ik(values, preset), to_rig(rig), ours, to_frames(frames))

    sensed, advanced = result.trace.sensed, result.trace.advanced
    after = advanced.state
    flags = {
        "found": sensed.foothold.found,
        "standing": sensed.contact.planted,
        "locked": after.lock.locked,
        "reached": result.reached,
    }
    # For a leg exactly as long as animated, rounding decides whether it reaches.
    sure = {"reached": np.abs(expected["stretch"]) > 1e-9}
    for key, actual in flags.items():
        certain = np.where(sure.get(key, True), expected[key], actual) > 0.5
        np.testing.assert_array_equal(np.asarray(actual) > 0.5, certain, err_msg=key)
        if key != "locked" or values.get("lock.enabled", False):
            assert 0.02 < expected[key].mean() < 0.99, key
    assert 0.02 < (expected["heel_lift"] > 0).mean() < 0.9
    hit = sensed.ground.ankle
    reported = expected["found"][..., None]
    pairs = {
        "contact": sensed.contact.weight,
        "hit_ws": np.where(reported, hit.point, expected["hit_ws"]),
        "normal": np.where(reported, hit.normal, expected["normal"]),
        "support": sensed.ground.support,
        "ground_height": after.target.height,
        "ground_velocity": after.target.velocity,
        "foothold_ws": advanced.foothold_ws,
        "factor": after.lock.factor,
        "pelvis_goal": after.pelvis.goal,
        "pelvis_height": after.pelvis.height,
        "pelvis_velocity": after.pelvis.velocity,
        "pelvis_ahead": after.pelvis.ahead,
        "target_ws": advanced.effector.target_ws,
        "body_pos": result.body.pos,
        **{f"{joint}_pos": getattr(result.pose, joint).pos for joint in JOINTS},
    }
    for key, actual in pairs.items():
        np.testing.assert_allclose(
            np.asarray(actual), expected[key], rtol=0, atol=POSITION, err_msg=key
        )
    for joint in JOINTS:
        rot = np.asarray(getattr(result.pose, joint).rot)
        assert sample_poses.rotation_angle(rot, expected[f"{joint}_rot"]) < ANGLE, joint
