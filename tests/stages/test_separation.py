"""Feet that keep apart: against NumPy, what they never do, and a walk that drifts aside."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from fitting.datasets.clip_frames import frames_from_clip
from fitting.datasets.synthetic import walker
from jaxik.maths import parameter_tree
from jaxik.maths.gate import HARD, Smooth
from jaxik.stages.inputs import SensedMoment
from jaxik.stages.lock import Hold
from jaxik.stages.separation import FootSeparation, NoSeparation
from jaxik.world import terrain
from jaxik.world.frame import Contact, Foothold, GroundHits, Sensed, Slope
from jaxik.world.skeleton import Rig, Still
from jaxik.world.terrain import Hit, Terrain
from reference.characters import Parameters
from reference.stages import separation
from support.fragments import fragment
from support.gradients import assert_gradients_match, finite_jacobian
from support.rule_checks import assert_lanes_agree, assert_single_precision_agrees

SIDES = np.array([1.0, -1.0, 1.0, -1.0, 0.0])
LEGS, FRAMES, DT = len(SIDES), 60, 1.0 / 30.0
VALUES = {"distance": 0.15, "half_life": 0.05}
RULE = FootSeparation(**VALUES)


def moves(rule, animated, offsets, locked, contact, weight, normals, yaw, *, gate=HARD):
    """How far the feet of a clip move (frames legs 3), m; `offsets` are those of the locks."""
    dtype = animated.dtype
    up = jnp.asarray([0.0, 1.0, 0.0], dtype)

    def frame(carry, inputs):
        state, started = carry
        ankle, offset, locked, contact, weight, normal, yaw = inputs
        right = jnp.stack([-jnp.cos(yaw), jnp.zeros_like(yaw), jnp.sin(yaw)])
        sensed = fragment(
            Sensed,
            slope=fragment(Slope, right_ws=right),
            carry=Still(),
            contact=fragment(Contact, weight=contact),
            side=jnp.asarray(SIDES, dtype),
            weight=weight,
            ankle_ws=ankle,
            warp_ws=None,
            ground=fragment(GroundHits, ankle=fragment(Hit, normal=normal)),
            foothold=fragment(Foothold, found=jnp.ones_like(weight)),
            leg_up_ws=up,
        )
        ground = fragment(Terrain, up_ws=up)
        now = SensedMoment(jnp.asarray(DT, dtype), started, gate, sensed, ground)
        hold = fragment(Hold, offset_ws=offset, locked=locked)
        state, moved = rule.advance(now, ankle, hold, state)
        return (state, jnp.ones_like(started)), moved

    state = rule.init(fragment(Rig, knee_axis_ls=jnp.zeros((LEGS, 3), dtype)))
    clip = animated, offsets, locked, contact, weight, normals, yaw
    return jax.lax.scan(frame, (state, jnp.zeros((), bool)), clip)[1]


moves_of = jax.jit(moves)


def stroll(frames=FRAMES, seed=0):
    """Feet that step, locks that pull them together, legs without foot IK, ground that slopes."""
    rng = np.random.default_rng(seed)
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
    defaults = {f"separation.{name}": value for name, value in VALUES.items()}
    parameters, offsets, expected = Parameters(changes, defaults), None, []
    for animated, lock, locked, contact, weight, normals, yaw in zip(*clip, strict=True):
        left = np.array([np.cos(yaw), 0.0, -np.sin(yaw)])
        standing = 1.0 - (1.0 - locked) * (1.0 - contact)
        feet = separation.Feet(
            SIDES, animated, animated + lock, standing, weight, normals, np.ones(LEGS), left, DT
        )
        offsets, moved = separation.separate(parameters, feet, offsets)
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


def test_standing_feet_keep_the_place_where_they_came_down():
    clip = stroll()
    moved = np.asarray(moves_of(RULE, *clip))[..., [0, 2]]
    held = (clip[2] == 1.0) | (clip[3] == 1.0)
    steps = np.abs(np.diff(moved, axis=0)).max(axis=-1)
    assert steps[held[1:]].max() < 1e-12 < 0.01 < steps[~held[1:]].max()


def two_feet(pull, locked, frames=FRAMES):
    """A left and a right foot, animated 0.2 m apart and pulled together by locks."""
    animated = np.zeros((frames, LEGS, 3))
    animated[..., 0] = 0.1 * SIDES
    offsets = np.zeros_like(animated)
    offsets[..., 0] = -pull * SIDES
    weight = np.tile([1.0, 1.0, 0.0, 0.0, 0.0], (frames, 1))
    normals = np.tile([0.0, 1.0, 0.0], (frames, LEGS, 1))
    held = np.tile([*locked, 0.0, 0.0, 0.0], (frames, 1))
    return animated, offsets, held, held, weight, normals, np.zeros(frames)


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


def test_single_precision_and_lanes_give_the_same():
    clip = stroll(3)
    assert_single_precision_agrees(moves_of, RULE, *clip)

    def of_distance(distance):
        return moves(dataclasses.replace(RULE, distance=distance), *clip)

    assert_lanes_agree(of_distance, jnp.asarray([0.05, 0.15, 0.25]))


@pytest.mark.parametrize("gate", [HARD, Smooth(1.0)], ids=["hard", "smooth"])
def test_derivatives_are_difference_quotients_and_finite_where_feet_meet(gate):
    animated, offsets, *rest = stroll(3)

    def moved(values, animated, offsets):
        return moves(FootSeparation(**values), animated, offsets, *rest, gate=gate)

    assert_gradients_match(moved, VALUES, animated, offsets)
    nowhere = np.zeros_like(animated)
    finite_jacobian(moved, VALUES, nowhere, nowhere)


def widths(result):
    """Distance from the right ankle to the left, to the left of the character, m."""
    left = -np.asarray(result.trace.sensed.slope.right_ws)
    ankles = np.asarray(result.trace.advanced.effector.target_ws)
    return np.sum((ankles[:, 0] - ankles[:, 1]) * left, axis=-1)


@pytest.mark.slow
def test_locked_feet_of_a_walk_that_drifts_sideways_do_not_cross():
    clip = walker.walk(4.0, 30.0)
    # The character glides to its right and back, so that swinging feet pass over locked ones.
    glide = 0.16 * np.sin(np.arange(clip.frame_count) * (2 * np.pi / 25))
    aside = glide[:, None, None] * [1.0, 0.0, 0.0]
    gliding = clip.with_motion(clip.positions_ws + aside, clip.rotations_ws)
    gliding = dataclasses.replace(gliding, stance=clip.stance_labels())
    ik = parameter_tree.replace(jaxik.presets.stride(clip.rig), {"lock.enabled": True})
    frames, ground = frames_from_clip(gliding), terrain.plane()
    crossing = dataclasses.replace(ik, separation=NoSeparation())
    apart, crossed = (jaxik.run(system, clip.rig, ground, frames) for system in (ik, crossing))
    assert widths(crossed).min() < 0.0
    assert np.sort(widths(apart))[len(glide) // 20] > 0.06
    locked = np.asarray(apart.trace.advanced.hold.locked)[1:] > 0
    steps = np.diff(np.asarray(apart.trace.advanced.state.separation.offset_ws), axis=0)
    assert np.abs(steps[locked]).max() < 1e-12
    assert np.abs(steps).max() > 0.005
