"""The stride pipeline against its independent NumPy reference."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from reference import characters, maths, sample_poses
from reference.systems import stride
from support.agreement import assert_agreement
from support.clips import named, to_frames, to_ik, to_rig, to_terrain
from support.stride_runs import FRAMES, UNEVEN, compiled, of_legs, solved
from support.strides import walk

HZ = 10
RULES = {"stride": ("label", "reach"), "by speed": ("speed", "support")}
LOCKS = {"lock.enabled": True}
ODD: dict[str, Any] = (  # away from the defaults
    LOCKS
    | named("probe", ray_up=0.7, ray_down=0.11, rise_start=0.1, rise_end=0.8, steepness=2.7)
    | named("probe", max_step_up=0.16, max_step_down=0.14, max_slope=0.1, clearance=0.05)
    | named("probe", heel_length=0.1, ball_height=0.04, toe_length=0.06)
    | named("probe", held_lift=0.4, toe_clearance=0.05, lift_per_rise=0.3, lift_per_fall=0.6)
    | named(
        "probe", lift_ahead=1.1, lift_over=1.2, toes_up=0.2, toes_down=0.1, toes_down_per_height=1.4
    )
    | named("probe", toes_first=1.1, min_sole=0.9, max_slide=0.06)
    | named("probe", stance_time=0.5, swing_time=0.37)
    | named("target", foot_height=0.07, max_slope=0.08, max_ankle_height=0.25)
    | named("target", rise_half_life=0.03, fall_half_life=0.05)
    | named("lock", lock_half_life=0.02, release_heading=0.04, release_speed=0.8)
    | named("lock", release_distance=0.05)
    | named("lean", pelvis_rate=-0.4, pelvis_side_rate=0.3, half_life=0.15)
    | named("effector", extension=0.94, max_lift=0.11)
    | {"leg.soften": 0.95, "leg.twist": 0.1, "foot.max_roll": 0.05}
)
REACH = (
    {"contact.ground_height": 0.01}
    | named("pelvis", highest_share=0.5, extension=0.93, softness=0.04, shift=0.3)
    | named("pelvis", rise_half_life=0.04, fall_half_life=0.07, landing_time=0.2)
    | named("pelvis", rise_speed=0.1, most_shift=0.03)
)
SUPPORT = (
    named("contact", ground_height=0.01, planted_height=0.071, raised_height=0.09)
    | named("contact", planted_speed=0.31, raised_speed=0.9, half_life=0.03)
    | named("pelvis", lowest_share=0.6, rise_half_life=0.05, fall_half_life=0.03)
)
SPRUNG = {"target.spring": True, "target.follow_slopes": True, "pelvis.spring": True}
TILTS = [maths.from_axis_angle(axis, 0.2) for axis in (maths.X, -maths.Z)]
AS_ANIMATED = {"leg.as_animated": False, "probe.swing_as_animated": True}
CASES: dict[str, tuple[Any, ...]] = {  # system, values, and how the clip is unlike the usual one
    "as it is": ("stride", {}),
    "footholds unknown": ("stride", LOCKS, "unknown"),
    "odd": ("stride", ODD | REACH | {"leg.weight": [1.0, 0.9]}),
    "odd, with different ups": ("stride", ODD | REACH | {"leg.weight": [1.0, 0.9]}, "tilted"),
    "odd, sprung and without footholds": ("stride", ODD | REACH | SPRUNG, "unknown"),
    "held by the ankle and softened": ("stride", LOCKS | {"lock.hold_ball": False} | AS_ANIMATED),
    "footholds unused": ("stride", {"probe.use_strides": False}),
    "on a platform that moves": ("stride", LOCKS | {"lock.release_heading": 0.06}, "rides"),
    "by speed": ("by speed", {}, "unknown", "leaps"),
    "by speed, odd and sprung": ("by speed", ODD | SUPPORT | SPRUNG),
}
# Rules that no preset has, in a program of their own, and cases of which others have every part.
AT_LENGTH = ("odd", "footholds unknown", "by speed", "by speed, odd and sprung")
NAMES = [
    pytest.param(name, marks=pytest.mark.slow) if name in AT_LENGTH else name for name in CASES
]
RIG = sample_poses.make_rig(np.random.default_rng(4))


def carousel(time: float) -> characters.Transform:
    """A platform that drifts and turns."""
    pos = np.array([-0.1, 0.05, -0.2]) + time * np.array([0.03, -0.01, 0.08])
    return maths.Transform(pos, maths.from_axis_angle(maths.Y, 0.02 * time))


def clip(*unlike: str) -> list[characters.Frame]:
    """A walk across all blocks and beyond, with slipping, turning and partly weighted feet.

    Even known footholds are unknown for a while, and contact labels are uncertain for another. The
    ways between known footholds bend. The walk can leap at the start and once again with feet too
    fast to stand. Its ground is a platform, on which it can ride.
    """
    rng = np.random.default_rng(5)
    way: dict[str, Any] = {"start": (-0.5, 0.03, -3.7), "heading": 0.12, "speed": 0.8}
    frames = walk(RIG, FRAMES, hz=HZ, known="unknown" not in unlike, **way)
    aside = np.outer(RIG.side, [0.12, 0.03, 0.05])  # also upward, which does not count
    ahead = np.array([[0.6, 0.3, 1.2], [0.0, 0.0, 0.0]])  # the other is not known
    changed = []
    for index, frame in enumerate(frames):
        fraction, time, before = index / FRAMES, index / HZ, max(index - 1, 0) / HZ
        stride = frame.stride
        assert stride is not None
        platforms = [
            carousel(x) if "rides" in unlike else sample_poses.STILL for x in (time, before)
        ]
        weight, known, standing = np.ones(2), stride.known, stride.standing
        if 0.5 < fraction < 0.55:
            weight[0] = 0.5
        if 0.6 < fraction < 0.62:
            weight[-1] = 0.0
        if 0.7 < fraction < 0.8:
            known = 0.0 * known
        if 0.3 < fraction < 0.4:
            standing = 0.2 + 0.6 * standing
        axis, angle = maths.unit(rng.normal(size=3), maths.Y), rng.uniform(0.0, 0.1)
        wobble = maths.from_axis_angle(axis, angle)
        turned = maths.from_axis_angle(maths.Y, 0.1 * np.sin(time))
        slip = frame.world_from_model.pos + [0.02 * np.sin(7 * time), 0.01 * np.sin(5 * time), 0.0]
        root = maths.Transform(slip, maths.multiply(frame.world_from_model.rot, turned))
        rots = np.array([maths.multiply(wobble, rot) for rot in frame.ankle.rot])
        changes: dict[str, Any] = {"known": known, "standing": standing, "aside_ws": aside}
        changes |= {"last_ahead_ws": ahead, "next_ahead_ws": np.flip(ahead, axis=0)}
        changed.append(
            dataclasses.replace(
                frame,
                world_from_model=root,
                ankle=frame.ankle._replace(rot=rots),
                weight=weight,
                stride=dataclasses.replace(stride, **changes),
                platforms=platforms[:1],
                platforms_before=platforms[1:],
            )
        )
    flights = ((0.0, 0.2), (6.7, 7.3)) if "leaps" in unlike else ()  # s
    timed = sample_poses.with_speeds(changed)
    for index, frame in enumerate(timed):
        frame.toe_speed += 3.0 * any(start <= index / HZ < end for start, end in flights)
    return timed


@pytest.mark.parametrize("name", RULES)
def test_the_defaults_are_those_of_the_reference(name):
    ik = to_ik({}, name)
    for key, expected in stride.defaults(*RULES[name]).items():
        rule, _, leaf = key.partition(".")
        actual = np.asarray(getattr(getattr(ik, rule), leaf))
        np.testing.assert_allclose(actual, expected, rtol=1e-6, err_msg=key)


@pytest.mark.parametrize("name", NAMES)
def test_a_clip_agrees_with_the_reference(name):
    """Of `stride`, each leg has its numbers and a terrain, in one case with its own up."""
    preset, values, *unlike = CASES[name]
    frames, rules, plain = clip(*unlike), RULES[preset], UNEVEN
    if preset == "stride":
        plain = of_legs(UNEVEN, *(TILTS if "tilted" in unlike else ()))
        result = solved(values, RIG, plain, frames)
    else:
        ik, ground = to_ik(values, preset), to_terrain(UNEVEN)
        result = compiled(ik, to_rig(RIG), ground, to_frames(frames))
    arrays = {key: np.asarray(x) if isinstance(x, list) else x for key, x in values.items()}
    parameters = characters.Parameters(arrays, defaults=stride.defaults(*rules))
    expected: dict[str, Any] = stride.run(parameters, RIG, plain, frames)
    sensed, advanced = result.trace.sensed, result.trace.advanced
    after, hit, found = advanced.state, sensed.ground.ankle, expected["found"][..., None]
    outputs: dict[str, Any] = {
        "found": sensed.foothold.found,
        "standing": sensed.contact.planted,
        "locked": after.lock.locked,
        # For a leg exactly as long as animated, rounding decides whether it reaches.
        "reached": np.where(
            np.abs(expected["stretch"]) > 1e-9, result.reached, expected["reached"]
        ),
        "contact": sensed.contact.weight,
        "hit_ws": np.where(found, hit.point, expected["hit_ws"]),
        "normal": np.where(found, hit.normal, expected["normal"]),
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
    }
    for name in ("found", "standing", "locked", "reached"):
        outputs[name], expected[name] = outputs[name] > 0.5, expected[name] > 0.5
        if name != "locked" or values.get("lock.enabled", False):
            assert 0.02 < expected[name].mean() < 0.99, name
    assert 0.02 < (expected["heel_lift"] > 0).mean() < 0.9
    assert_agreement(result, expected, outputs)
