"""Rules that none of the games has: a spine that leans into hills, feet apart, scaled strides.

Each against NumPy, its limits, precision and derivatives; and on walks.
"""

import dataclasses
import functools
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxik
from fitting.clips import contacts, edit
from fitting.clips.clip_frames import clip_from_result, frames_from_clip
from fitting.synthetic import walker
from jaxik.maths import parameter_tree, quat
from jaxik.maths.gate import HARD
from jaxik.stages.inputs import Inputs, SensedMoment
from jaxik.stages.lean import SpineLean
from jaxik.stages.lock import Hold
from jaxik.stages.separation import FootSeparation
from jaxik.stages.warp import StrideWarp, about_up
from jaxik.world import terrain
from jaxik.world.frame import Contact, Foothold, Frame, GroundHits, Sensed, Slope, Turn
from jaxik.world.skeleton import LegPose, Rig, Still, Transform
from jaxik.world.terrain import Hit, Terrain
from reference import maths
from reference.characters import Parameters
from reference.stages import shifts, spine
from support.cases import Either
from support.clips import at, make_rig, to_frames, wandering
from support.fragments import fragment
from support.gradients import assert_gradients_match, finite_jacobian

FRAMES, DT = 60, 1.0 / 30.0


def assert_single_precision_agrees(function: Callable, *args: Any, atol: float = 2e-6) -> None:
    """Asserts that a function of 32-bit floats gives such floats, nearly those of 64 bits."""
    floats, rest = eqx.partition(jax.tree.map(jnp.asarray, args), eqx.is_inexact_array)
    single = jax.tree.map(lambda x: x.astype(jnp.float32), floats)
    rounded, exact = (jax.tree.leaves(function(*eqx.combine(x, rest))) for x in (single, floats))
    for actual, expected in zip(rounded, exact, strict=True):
        assert actual.dtype == jnp.float32
        np.testing.assert_allclose(actual, expected, rtol=0, atol=atol)


def assert_lanes_agree(function: Callable, *args: Any) -> None:
    """Asserts that `lanes` of a function is its `vmap`."""
    in_lanes, expected = (jax.jit(f(function))(*args) for f in (jaxik.lanes, jax.vmap))
    for a, b in zip(jax.tree.leaves(in_lanes), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)


# A spine that leans into hills.

LEAN = {"uphill_rate": -0.4, "downhill_rate": -0.7, "side_rate": 0.3, "pelvis_rate": -0.25}
LEAN |= {"pelvis_side_rate": 0.15, "forward_rate_slide": 0.8, "side_rate_slide": -0.5}
LEAN |= {"head_share": 0.6, "spacing": 0.4, "half_life": 0.15}
SPINE = SpineLean(**LEAN)


def leans(rule, points, normals, rots, weights, slides, gate=HARD):
    """Rotations of trunk, head and pelvis (frames, 4), world axes."""
    terrain = fragment(Terrain, up_ws=jnp.asarray([0.0, 1.0, 0.0], normals.dtype))
    rig = fragment(Rig, side=jnp.zeros(2, normals.dtype), present=jnp.ones(2, bool))

    def frame(carry, inputs):
        state, started = carry
        rot, point, normal, weight, slide = inputs
        root = fragment(Frame, world_from_model=Transform(jnp.zeros(3, rot.dtype), rot))
        hits = fragment(Hit, found=jnp.ones_like(weight), point=point, normal=normal)
        slope = rule.sense(
            fragment(Inputs, rig=rig, frame=root, terrain=terrain),
            fragment(GroundHits, ankle=hits),
            fragment(Contact, weight=weight),
            jnp.ones_like(weight),
        )
        sensed = fragment(Sensed, slope=slope, slide=slide, up_ws=terrain.up_ws)
        now = SensedMoment(jnp.asarray(DT, rot.dtype), started, gate, sensed, terrain)
        state, lean = rule.advance(now, state)
        trunk = quat.multiply(lean.spine_ws, lean.rot_ws)
        return (state, jnp.ones_like(started)), (trunk, lean.head_ws, lean.rot_ws)

    start = rule.init(rig), jnp.zeros((), bool)
    return jax.lax.scan(frame, start, (rots, points, normals, weights, slides))[1]


lean_all = jax.jit(leans)
rotation = functools.partial(Rotation.from_quat, scalar_first=True)


def hills(frames=FRAMES):
    """Uphill and downhill ground, headings, weights with flights, and slides."""
    rng = np.random.default_rng(3)
    yaw = np.linspace(0.0, 5.0, frames)
    rots = Rotation.from_rotvec(np.outer(yaw, [0.0, 1.0, 0.0])).as_quat(scalar_first=True)
    rise = np.sin(np.linspace(0.0, 9.0, frames))[:, None, None] * [0.4, 0.0, 0.3]
    normals = rise + rng.normal(0.0, 0.05, (frames, 2, 3)) + [0.0, 1.0, 0.0]
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    weights = rng.uniform(0.0, 1.0, (frames, 2)) * (np.arange(frames) % 7 > 0)[:, None]
    slides = (np.arange(frames) // 15 % 2).astype(float)
    return rng.normal(0.0, 0.3, normals.shape), normals, rots, weights, slides


def uphill(angle, yaw=0.0):
    """A walk that faces `yaw` on ground that rises ahead by `angle`, rad."""
    turned = Rotation.from_rotvec([0.0, yaw, 0.0])
    rots = np.tile(turned.as_quat(scalar_first=True), (FRAMES, 1))
    normal = turned.apply([0.0, np.cos(angle), -np.sin(angle)])
    normals = np.broadcast_to(normal, (FRAMES, 2, 3))
    ways = np.linspace(-0.4, 0.4, FRAMES)[:, None, None] * [[1.0], [-1.0]]
    steps = ways * turned.apply([0.0, 0.0, 1.0])
    points = steps - (steps @ normal / normal[1])[..., None] * [0.0, 1.0, 0.0]
    return points, normals, rots, np.ones((FRAMES, 2)), np.zeros(FRAMES)


def test_trunk_head_and_pelvis_turn_as_in_numpy():
    clip = hills()
    parameters = Parameters(defaults={f"lean.{name}": value for name, value in LEAN.items()})
    state, expected = None, []
    for point, normal, rot, weight, slide in zip(*clip, strict=True):
        state, *rotations = spine.lean(parameters, rot, point, normal, weight, slide, DT, state)
        expected.append(rotations)
    actual = np.stack(lean_all(SPINE, *clip), axis=1)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-12)
    assert np.degrees(rotation(actual[:, 0]).magnitude()).max() > 5.0


@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_people_lean_forward_uphill_and_backward_downhill(yaw):
    forward = Rotation.from_rotvec([0.0, yaw, 0.0]).apply([0.0, 0.0, 1.0])
    for angle, rate in ((0.3, -0.4), (-0.3, -0.7), (0.0, 0.0)):
        turned = (np.asarray(rot)[-1] for rot in lean_all(SPINE, *uphill(angle, yaw)))
        tops = [rotation(rot).apply([0.0, 1.0, 0.0]) @ forward for rot in turned]
        expected = np.sin(np.array([-rate, 0.6 * rate, 0.25]) * angle)
        np.testing.assert_allclose(tops, expected, atol=1e-12)


def test_stairs_are_a_slope_from_foot_to_foot():
    points, normals, *rest = uphill(0.5)
    level = np.broadcast_to([0.0, 1.0, 0.0], points.shape)
    wide, narrow, ramp = (
        np.asarray(lean_all(SPINE, *ground, *rest)[0])[-1, 1]
        for ground in ((points, level), (0.05 * points, level), (points, normals))
    )
    assert 0.4 * ramp < wide < 0.9 * ramp and 0.0 < narrow < 0.05 * ramp


def test_a_head_that_turns_back_all_the_way_stays_level():
    trunk, head, _ = lean_all(SpineLean(**LEAN | {"head_share": 1.0}), *hills())
    np.testing.assert_allclose((rotation(head) * rotation(trunk)).magnitude(), 0.0, atol=1e-12)


def test_the_lean_crosses_level_ground_without_a_jump():
    angles = np.linspace(-0.01, 0.01, 41)
    last = [np.asarray(lean_all(SPINE, *uphill(angle))[0])[-1, 1] for angle in angles]
    assert np.abs(np.diff(last)).max() < 0.7 * 0.0005 / 2 * 1.01


# Feet that keep apart.

SIDES = np.array([1.0, -1.0, 1.0, -1.0, 0.0])
LEGS = len(SIDES)
APART = {"distance": 0.15, "half_life": 0.05}
RULE = FootSeparation(**APART)


def moves(rule, animated, offsets, locked, contact, weight, normals, yaw, gate=HARD, turn=None):
    """How far the feet of a clip move (frames legs 3), m; `offsets` are those of the locks."""
    dtype = animated.dtype
    up = jnp.asarray([0.0, 1.0, 0.0], dtype)

    def frame(carry, inputs):
        state, started = carry
        ankle, offset, locked, contact, weight, normal, yaw = inputs
        right = jnp.stack([-jnp.cos(yaw), jnp.zeros_like(yaw), jnp.sin(yaw)])
        warp = None if turn is None else ankle - about_up(turn.pelvis - turn.feet).turn(ankle)
        sensed = fragment(
            Sensed,
            slope=fragment(Slope, right_ws=right),
            carry=Still(),
            contact=fragment(Contact, weight=contact),
            side=jnp.asarray(SIDES, dtype),
            weight=weight,
            ankle_ws=ankle,
            warp_ws=warp,
            turn=turn,
            ground=fragment(GroundHits, ankle=fragment(Hit, normal=normal)),
            foothold=fragment(Foothold, found=jnp.ones_like(weight)),
            up_ws=up,
            leg_up_ws=up,
        )
        ground = fragment(Terrain, up_ws=up)
        now = SensedMoment(jnp.asarray(DT, dtype), started, gate, sensed, ground)
        hold = fragment(Hold, offset_ws=offset, locked=locked)
        state, moved = rule.advance(now, ankle, hold, state)
        return (state, jnp.ones_like(started)), moved

    start = rule.init(fragment(Rig, knee_axis_ls=jnp.zeros((LEGS, 3), dtype))), jnp.zeros((), bool)
    clip = animated, offsets, locked, contact, weight, normals, yaw
    return jax.lax.scan(frame, start, clip)[1]


moves_of = jax.jit(moves)


def stroll(frames=FRAMES):
    """Feet that step, locks that pull them together, legs without foot IK, ground that slopes."""
    rng = np.random.default_rng(0)
    time = np.linspace(0.0, 6.0, frames)[:, None]
    animated = rng.normal(0.0, 0.2, (frames, LEGS, 3))
    animated[..., 0] = 0.1 * SIDES + 0.08 * np.sin(time + np.arange(LEGS))
    locked = (np.sin(2.0 * time + 2.0 * np.arange(LEGS)) > 0.3).astype(float)
    contact = np.clip(np.sin(2.0 * time + 2.0 * np.arange(LEGS)) + 0.5, 0.0, 1.0)
    offsets = rng.normal(0.0, 0.02, (frames, LEGS, 3))
    offsets[..., 0] -= 0.12 * SIDES * locked
    weight = (rng.uniform(size=(frames, LEGS)) > 0.1).astype(float)
    normals = rng.normal(0.0, 0.3, (frames, LEGS, 3)) + [0.0, 1.0, 0.0]
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return animated, offsets, locked, contact, weight, normals, 0.8 * np.sin(time[:, 0])


@pytest.mark.parametrize("half_life", [0.05, [0.0, 0.05, 0.1, 0.02, 0.3]], ids=["one", "per leg"])
def test_feet_give_way_as_in_numpy(half_life):
    clip = stroll()
    changes = {"separation.half_life": half_life}
    defaults = {f"separation.{name}": value for name, value in APART.items()}
    parameters, offsets, expected = Parameters(changes, defaults), None, []
    for animated, lock, locked, contact, weight, normals, yaw in zip(*clip, strict=True):
        left = np.array([np.cos(yaw), 0.0, -np.sin(yaw)])
        standing = 1.0 - (1.0 - locked) * (1.0 - contact)
        feet = shifts.Feet(
            SIDES, animated, animated + lock, standing, weight, normals, np.ones(LEGS), left, DT
        )
        offsets, moved = shifts.separate(parameters, feet, offsets)
        expected.append(moved)
    actual = moves_of(FootSeparation(distance=0.15, half_life=half_life), *clip)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-12)
    assert np.mean(np.abs(expected) > 0.01) > 0.2
    assert not np.any(np.array(expected)[:, 4])  # the leg in the middle


def test_legs_that_only_the_animation_crosses_stay_as_animated():
    animated, _, locked, contact, weight, normals, yaw = stroll()
    crossed = animated * [-1.0, 1.0, 1.0]
    still = np.zeros_like(animated)
    for feet in (animated, crossed):
        moved = moves_of(RULE, feet, still, locked, contact, weight, normals, yaw)
        np.testing.assert_array_equal(moved, 0.0)


def test_feet_of_turned_strides_give_way_along_them_as_they_do_unturned():
    animated, offsets, *rest, normals, yaw = stroll()
    expected = moves_of(RULE, animated, offsets, *rest, normals, yaw)
    turn = Turn(pelvis=jnp.asarray(0.5), feet=jnp.asarray(1.3))
    rot = Rotation.from_rotvec([0.0, 1.3, 0.0])
    turned = ((x @ rot.as_matrix().T) for x in (animated, offsets, normals, np.asarray(expected)))
    animated, offsets, normals, expected = turned
    moved = moves_of(RULE, animated, offsets, *rest, normals, yaw, turn=turn)
    np.testing.assert_allclose(moved, expected, rtol=0, atol=1e-12)


def test_standing_feet_keep_the_place_where_they_came_down():
    clip = stroll()
    moved = np.asarray(moves_of(RULE, *clip))[..., [0, 2]]
    held = (clip[2] == 1.0) | (clip[3] == 1.0)
    steps = np.abs(np.diff(moved, axis=0)).max(axis=-1)
    assert steps[held[1:]].max() < 1e-12 < 0.01 < steps[~held[1:]].max()


def two_feet(pull, locked):
    """A left and a right foot, animated 0.2 m apart and pulled together by locks."""
    animated = np.zeros((FRAMES, LEGS, 3))
    animated[..., 0] = 0.1 * SIDES
    offsets = np.zeros_like(animated)
    offsets[..., 0] = -pull * SIDES
    weight = np.tile([1.0, 1.0, 0.0, 0.0, 0.0], (FRAMES, 1))
    normals = np.tile([0.0, 1.0, 0.0], (FRAMES, LEGS, 1))
    held = np.tile([*locked, 0.0, 0.0, 0.0], (FRAMES, 1))
    return animated, offsets, held, held, weight, normals, np.zeros(FRAMES)


@pytest.mark.parametrize(
    ("pull", "locked", "moves"),
    [
        (0.09, (0.0, 0.0), (0.065, -0.065)),  # 2 cm apart, 13 cm missing: half for each
        (0.09, (1.0, 0.0), (0.0, -0.13)),  # the swinging foot gives way
        (0.14, (0.0, 1.0), (0.23, 0.0)),  # crossed
        (0.09, (1.0, 1.0), (0.0, 0.0)),  # standing feet stay
        (0.02, (0.0, 0.0), (0.0, 0.0)),  # wide enough
    ],
)
def test_the_swinging_foot_gives_way_and_two_swinging_feet_share(pull, locked, moves):
    last = np.asarray(moves_of(RULE, *two_feet(pull, locked)))[-1, :2]
    np.testing.assert_allclose(last[:, 0], moves, atol=1e-9)
    np.testing.assert_array_equal(last[:, 1:], 0.0)


@pytest.mark.slow
def test_locked_feet_of_a_walk_that_drifts_sideways_do_not_cross():
    clip = walker.walk(4.0, 30.0)
    # The character glides to its right and back, so that swinging feet pass over locked ones.
    glide = 0.16 * np.sin(np.arange(clip.frame_count) * (2 * np.pi / 25))
    aside = np.multiply.outer(glide, [[1.0, 0.0, 0.0]])
    gliding = clip.with_motion(clip.positions_ws + aside, clip.rotations_ws)
    frames = frames_from_clip(dataclasses.replace(gliding, stance=clip.stance_labels()))
    widths, traces = [], []
    for distance in (0.0, 0.1):
        values = {"lock.enabled": True, "separation.distance": distance}
        ik = parameter_tree.replace(jaxik.presets.stride(clip.rig), values)
        trace = jaxik.run(ik, clip.rig, terrain.plane(), frames).trace
        ankles = trace.advanced.effector.target_ws
        to_left = (ankles[:, 1] - ankles[:, 0]) * trace.sensed.slope.right_ws
        widths.append(np.sort(np.sum(to_left, axis=-1)))
        traces.append(trace.advanced)
    assert widths[0].min() < 0.0
    assert widths[1][len(glide) // 20] > 0.06
    locked = np.asarray(traces[1].hold.locked)[1:] > 0
    steps = np.diff(np.asarray(traces[1].state.separation.offset_ws), axis=0)
    assert np.abs(steps[locked]).max() < 1e-12
    assert np.abs(steps).max() > 0.005


# Strides scaled with the speed of the character.

SCALED = {"width": 0.3, "min_scale": 0.6, "max_scale": 1.4}
PER_LEG = {"min_scale": [0.6, 0.9, 0], "max_scale": [1.4, 1, 2], "width": [0, 0.3, 1]}


def offsets(rule, toes_ms, velocity_ws, scale, root, gate=HARD):
    """How far the feet of one frame move (legs 3), m."""
    pose = fragment(LegPose, toe=fragment(Transform, pos=toes_ms))
    frame = fragment(
        Frame, world_from_model=root, pose=pose, velocity_ws=velocity_ws, stride_scale=scale
    )
    ground = fragment(Terrain, up_ws=jnp.asarray([0.0, 1.0, 0.0], toes_ms.dtype))
    return rule.offset(fragment(Inputs, frame=frame, terrain=ground, gate=gate))


offsets_of_all = jax.jit(jax.vmap(offsets, in_axes=(None, 0, 0, 0, 0)))


@functools.cache
def animation():
    """Frames of a wandering creature, with velocities and scales of all sizes."""
    frames = wandering(make_rig(legs=3), np.random.default_rng(4))
    scales = np.random.default_rng(5).uniform(0.2, 2.2, len(frames))
    each = to_frames(frames)
    arrays = each.pose.toe.pos, each.velocity_ws, jnp.asarray(scales), each.world_from_model
    return frames, arrays


@pytest.mark.parametrize("values", [SCALED, PER_LEG], ids=["shared", "per leg"])
def test_strides_are_scaled_as_in_numpy(values):
    frames, arrays = animation()
    changes, defaults = (
        {f"warp.{name}": value for name, value in each.items()} for each in (values, SCALED)
    )
    parameters = Parameters(changes, defaults)
    expected = [
        [shifts.warp(parameters, frame, leg, velocity, scale, maths.Y) for leg in range(3)]
        for frame, velocity, scale in zip(frames, *map(np.asarray, arrays[1:3]), strict=True)
    ]
    actual = offsets_of_all(StrideWarp(**values), *arrays)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-12)
    assert np.abs(expected).max() > 0.05


def test_a_place_on_the_ground_stays_one_whatever_the_way():
    _, (toes, velocity, _, root) = animation()
    scale = 1.3
    balls = np.asarray(jax.vmap(lambda root, toes: root.apply(toes))(root, toes))
    faster = np.asarray(root.pos) * (scale - 1.0) * [1.0, 0.0, 1.0]
    moved = offsets_of_all(StrideWarp(), toes, velocity, jnp.full(len(toes), scale), root)
    actual = balls + faster[:, None] + np.asarray(moved)
    np.testing.assert_allclose(actual, balls * [scale, 1.0, scale], rtol=0, atol=1e-12)


def test_without_a_scale_there_is_no_warp():
    assert (
        offsets(StrideWarp(), jnp.zeros((2, 3)), jnp.zeros(3), None, Transform.identity()) is None
    )


def test_ankles_before_strides_are_scaled_are_where_the_animation_has_them():
    animated, warp_ws = jnp.arange(6.0).reshape(2, 3), jnp.ones((2, 3))
    for moved, by in ((animated, None), (animated + warp_ws, warp_ws)):
        sensed = SimpleNamespace(ankle_ws=moved, warp_ws=by)
        unscaled = vars(Sensed)["unscaled_ankle_ws"].fget(sensed)
        np.testing.assert_allclose(unscaled, animated)


@pytest.mark.slow
def test_feet_of_a_faster_or_slower_walk_do_not_skate():
    clip = walker.walk(3.0, 30.0)
    stance = clip.stance_labels()
    for speed in (0.7, 1.3):
        played, slides = edit.at_speed(clip, speed), []
        for scale in (1.0, speed):
            frames = frames_from_clip(played, stride_scale=scale)
            result = jaxik.run(jaxik.presets.stride(), clip.rig, terrain.plane(), frames)
            balls = clip_from_result(played, result).joints_ws(3)[..., [0, 2]]
            steps = np.linalg.norm(np.diff(balls, axis=0), axis=-1)
            stances = [(leg, *run) for leg in range(2) for run in contacts.runs(stance[:, leg])]
            slides.append(np.median([steps[a:b, leg].sum() for leg, a, b in stances]))
        assert slides[0] > 0.10 and slides[1] < 0.005, "m in each stance"
        reached = np.asarray(result.reached) > 0
        assert reached[stance].mean() > 0.95
        # Before it lands, a foot ahead of a leg that is too short for the stride may lag behind.
        assert reached.mean() > 0.85
        # Longer strides need a lower pelvis; shorter ones do not.
        lowered = np.asarray(result.body.pos[:, 1]).min()
        assert (lowered < -0.01) == (speed > 1)


@pytest.mark.slow
@pytest.mark.parametrize("direction", [0.5, -1.2])
def test_feet_of_a_walk_in_another_direction_do_not_skate(direction):
    clip = walker.walk(3.0, 30.0)
    stance = clip.stance_labels()
    played, slides = edit.in_direction(clip, direction), []
    for orientation in (None, direction):
        frames = frames_from_clip(played, orientation=orientation)
        result = jaxik.run(jaxik.presets.stride(), clip.rig, terrain.plane(), frames)
        solved = clip_from_result(played, result)
        steps = np.linalg.norm(np.diff(solved.joints_ws(3)[..., [0, 2]], axis=0), axis=-1)
        stances = [(leg, *run) for leg in range(2) for run in contacts.runs(stance[:, leg])]
        slides.append(np.median([steps[a:b, leg].sum() for leg, a, b in stances]))
    assert slides[0] > 0.10 and slides[1] < 0.005, "m in each stance"


# All of them.


def example_of(name: str) -> tuple[Any, ...]:
    """A function of a rule, the rule, its values, and inputs: regular, singular, and the rest.

    Derivatives are by values and regular inputs, and finite at the singular ones.
    """
    if name == "lean":
        points, normals, *rest = hills(4)
        level = np.broadcast_to([0.0, 1.0, 0.0], normals.shape)
        return leans, SpineLean, LEAN, (points, normals), (0.0 * points, level), rest
    if name == "separation":
        animated, pulls, *rest = stroll(3)
        nowhere = np.zeros_like(animated)
        return moves, FootSeparation, APART, (animated, pulls), (nowhere, nowhere), rest
    toes, velocity, _, root = at(animation()[1], 0)
    at_rest = np.zeros((3, 3)), np.zeros(3), 0.0
    return offsets, StrideWarp, SCALED, (toes, velocity, 1.2), at_rest, (root,)


NAMES = [*(pytest.param(name, marks=pytest.mark.slow) for name in ("lean", "separation")), "warp"]


@pytest.mark.parametrize("name", NAMES)
def test_single_precision_and_lanes_give_the_same(name):
    function, rule, values, inputs, _, rest = example_of(name)
    assert_single_precision_agrees(jax.jit(function), rule(**values), *inputs, *rest)
    first = next(iter(values))

    def scaled(by):
        return function(rule(**values | {first: values[first] * by}), *inputs, *rest)

    assert_lanes_agree(scaled, jnp.asarray([0.5, 1.0, 1.5]))


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_are_difference_quotients_and_finite_where_formulas_are_singular(name):
    function, rule, values, inputs, singular, rest = example_of(name)

    def results(values, blurred, *inputs):
        return function(rule(**values), *inputs, *rest, Either(blurred > 0.5))

    for blurred in (0.0, 1.0):
        assert_gradients_match(results, values, blurred, *inputs)
        finite_jacobian(results, values, blurred, *singular)
