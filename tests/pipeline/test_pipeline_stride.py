"""The preset `stride` against its NumPy reference, on a flat floor, and what its locks hold.

Also heels that rise about the ball. All clips share a program.
"""

import dataclasses
import functools
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq, minimize_scalar

import jaxik
from jaxik.maths import quat
from jaxik.stages import effector
from reference import characters, maths, sample_poses
from reference.systems import stride
from support import cases
from support.agreement import assert_agreement
from support.clips import assert_close, named, to_frames, to_ik, to_rig, to_terrain
from support.stride_runs import FLAT, FRAMES, UNEVEN, compiled, of_legs, on_platform, solved
from support.strides import WAYS, blocks, walk

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


FLOORS, RATE = of_legs(FLAT), 25.0


def four_seconds(start: float = -2.0, **changes: Any) -> list[characters.Frame]:
    """A walk, m forward from the start, on a platform that stays where it is."""
    still = {name: [sample_poses.STILL] for name in ("platforms", "platforms_before")}
    frames = walk(cases.RIG, FRAMES, hz=RATE, start=start * maths.Z, **still, **changes)
    none = dict.fromkeys(WAYS, np.zeros((2, 3)))
    for frame in frames:
        assert frame.stride is not None
        frame.stride = dataclasses.replace(frame.stride, **none)
    return frames


# Flat floor.


@pytest.mark.parametrize("known", [True, False], ids=["known", "unknown"])
def test_nothing_changes_on_a_flat_floor(known: bool):
    plain = four_seconds(known=known, heading=0.1)
    frames = to_frames(plain)
    legs = np.linalg.norm(frames.pose.ankle.pos - frames.pose.hip.pos, axis=-1)
    assert legs.max() > 0.99 * (sample_poses.THIGH + sample_poses.SHIN), "knees are straight"
    result = solved({"lock.enabled": True}, cases.RIG, FLOORS, plain)
    assert 0.3 < np.asarray(result.trace.advanced.state.lock.locked).mean() < 0.9
    sensed, effector = result.trace.sensed, result.trace.advanced.effector
    assert_close(effector.target_ws, sensed.ankle_ws, 1e-9)
    assert_close(effector.rot_ws, sensed.ankle_rot_ws, 1e-9)
    assert np.abs(result.body.pos).max() < 1e-9
    for joint in ("hip", "knee", "ankle", "toe"):
        actual, expected = (getattr(pose, joint) for pose in (result.pose, frames.pose))
        assert_close(actual.pos, expected.pos, 1e-9)
        rots = np.asarray(actual.rot), np.asarray(expected.rot)
        assert sample_poses.rotation_angle(*rots) < 1e-7, joint


# Feet that stand.


def test_a_locked_ball_does_not_slide_while_the_heel_rises():
    """On a walk whose standing feet slip sideways."""
    plain, slips = four_seconds(), []
    for index, frame in enumerate(plain):
        pos = frame.world_from_model.pos + 0.08 * index / RATE * maths.X
        root = frame.world_from_model._replace(pos=pos)
        plain[index] = dataclasses.replace(frame, world_from_model=root)
    plain = sample_poses.with_speeds(plain)
    frames = to_frames(plain)
    for hold_ball in (True, False):
        values = {"lock.enabled": True, "lock.hold_ball": hold_ball, "lock.lock_half_life": 0.0}
        result = solved(values, cases.RIG, FLOORS, plain)
        ball = jax.vmap(jaxik.Transform.apply)(frames.world_from_model, result.pose.toe.pos)
        locked = np.asarray(result.trace.advanced.state.lock.locked) > 0
        locked_twice = locked[1:] & locked[:-1] & (np.asarray(result.reached) > 0)[1:]
        assert locked_twice.mean() > 0.3
        slip = np.linalg.norm(np.diff(ball, axis=0)[..., [0, 2]], axis=-1)
        slips.append(slip[locked_twice].max())
    assert slips[0] < 1e-9 and slips[1] > 1e-3, "a locked ankle lets the ball slide"


# Heels that rise about the ball, compared with a numerical search.

RISES, STAYS = 0.0, 0.3  # sine of a leg's angle ahead of its hip
VALUES = {"effector.extension": 0.97, "effector.max_lift": 0.1, "probe.swing_as_animated": True}


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
    columns = map(np.stack, zip(*legs, strict=True))
    actual = jax.jit(effector.heel_angle)(*columns)
    assert 0.2 < (expected > 0).mean() < 0.9
    # Where the length cannot be reached, the search is only as precise as a minimum.
    np.testing.assert_allclose(np.maximum(actual, 0.0), expected, rtol=0, atol=1e-6)


@functools.cache
def over_blocks() -> SimpleNamespace:
    """Heels on a walk across uneven blocks; (frames, legs), but for the clip and its result."""
    plain = four_seconds(start=-2.5, heading=0.1)
    ground = blocks(np.random.default_rng(5), max_height=0.2, irregular=False)
    result = solved(VALUES, cases.RIG, of_legs(on_platform(ground.triangles)), plain)
    frames = to_frames(plain)
    sensed, advanced = result.trace.sensed, result.trace.advanced
    hip = sensed.hip_ws + advanced.state.pelvis.offset_ws[:, None]
    lift = np.asarray(sensed.foothold.lift)[..., None] * sensed.leg_up_ws
    before = advanced.foothold_ws + advanced.hold.offset_ws + lift - hip
    animated = np.linalg.norm(sensed.ankle_ws - sensed.hip_ws, axis=-1)
    extension = VALUES["effector.extension"] * (sample_poses.THIGH + sample_poses.SHIN)
    longest = np.maximum(extension, animated)

    normal = sensed.ground.ankle.normal
    up = jnp.broadcast_to(jnp.asarray(maths.Y), normal.shape)
    tilt = quat.shortest_arc(up, normal, sensed.ahead_ws)
    arm = quat.rotate(tilt, sensed.ankle_ws - sensed.ball_ws)
    level_axis = -quat.rotate(frames.world_from_model.rot, jnp.asarray(maths.X))
    axis = quat.rotate(tilt, jnp.broadcast_to(level_axis[:, None], arm.shape))
    columns = [np.reshape(x, (-1, 3)) for x in (before - arm, arm, axis)]
    searched = [search_angle(*leg) for leg in zip(*columns, longest.ravel(), strict=True)]
    cosine = np.abs(np.sum(advanced.effector.rot_ws * sensed.ankle_rot_ws, axis=-1))
    length = np.linalg.norm(before, axis=-1)
    return SimpleNamespace(
        frames=frames,
        result=result,
        lift=2.0 * np.arccos(np.minimum(cosine, 1.0)),  # rad
        searched=np.reshape(searched, longest.shape),  # rad
        ahead=np.sum(before * sensed.ahead_ws, -1) / length,  # sine of the leg's angle
        before=length,  # m, of the leg, with its heel down
        after=np.linalg.norm(advanced.effector.target_ws - hip, axis=-1),
        longest=longest,
        to_ball_ws=np.asarray(-arm),  # m, from the ankle, of a level sole laid on the ground
    )


def test_on_a_walk_a_heel_rises_as_far_as_a_search_finds_within_its_limit():
    """But less, the further its leg points ahead."""
    walk, max_lift = over_blocks(), VALUES["effector.max_lift"]
    trailing = walk.searched[walk.ahead <= RISES]
    assert 0.02 < (trailing > 0.0).mean() < 0.9 and (trailing > max_lift).any()
    too_long = np.minimum(walk.searched, max_lift)
    share = [1.0 - maths.smooth01((x - RISES) / (STAYS - RISES)) for x in walk.ahead.ravel()]
    expected = too_long * np.reshape(share, too_long.shape)
    assert (too_long - expected).max() > 0.02
    np.testing.assert_allclose(walk.lift, expected, rtol=0, atol=1e-6)


def test_a_rising_heel_keeps_the_leg_at_its_longest_and_stays_down_where_it_is_shorter():
    walk, max_lift = over_blocks(), VALUES["effector.max_lift"]
    rises = (walk.lift > 1e-6) & (walk.searched < max_lift) & (walk.ahead <= RISES)
    assert rises.mean() > 0.02
    np.testing.assert_allclose(walk.after[rises], walk.longest[rises], rtol=0, atol=1e-9)
    short = walk.before < walk.longest - 1e-9
    assert short.mean() > 0.1
    assert walk.lift[short].max() < 1e-7
    np.testing.assert_allclose(walk.after[short], walk.before[short], rtol=0, atol=1e-12)


def test_the_ball_stays_in_place_while_the_heel_rises():
    walk = over_blocks()
    sensed, advanced = walk.result.trace.sensed, walk.result.trace.advanced
    world = walk.frames.world_from_model
    ball = jax.vmap(jaxik.Transform.apply)(world, walk.result.pose.toe.pos)
    lift = np.asarray(sensed.foothold.lift)[..., None] * sensed.leg_up_ws
    moved = np.asarray(ball - (advanced.foothold_ws + lift + walk.to_ball_ws))
    arrived = (np.asarray(walk.result.reached) > 0) & (np.asarray(walk.result.aimed) > 0)
    assert (walk.lift[arrived] > 0.02).any()
    along = np.sum(moved * sensed.ground.ankle.normal, axis=-1)
    assert np.abs(along)[arrived].max() < 1e-8
    # Pitch and roll turn the foot a little about the normal, and so the ball along the ground.
    assert np.abs(moved)[arrived].max() < 0.002
