"""Strides scaled with the speed of the character: against NumPy, and feet that do not skate."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from fitting.datasets.clip_frames import clip_from_result, frames_from_clip
from fitting.datasets.clips import contacts, edit
from fitting.datasets.synthetic import walker
from jaxik.maths.gate import HARD, Smooth
from jaxik.stages.inputs import Inputs
from jaxik.stages.warp import NoWarp, StrideWarp
from jaxik.world import terrain
from jaxik.world.frame import Frame, Sensed
from jaxik.world.skeleton import LegPose, Transform
from jaxik.world.terrain import Terrain
from reference import maths
from reference.characters import Parameters
from reference.stages import warp
from support.clips import make_rig, to_frames, wandering
from support.fragments import fragment
from support.gradients import assert_gradients_match, finite_jacobian
from support.rule_checks import assert_lanes_agree, assert_single_precision_agrees

LEGS = 3
VALUES = {"min_scale": 0.6, "max_scale": 1.4, "width": 0.3}
PER_LEG = {"min_scale": [0.6, 0.9, 0], "max_scale": [1.4, 1, 2], "width": [0, 0.3, 1]}


def offsets(rule, root, toes_ms, velocity_ws, scale, gate=HARD):
    """How far the feet of one frame move (legs 3), m."""
    pose = fragment(LegPose, toe=fragment(Transform, pos=toes_ms))
    frame = fragment(
        Frame, world_from_model=root, pose=pose, velocity_ws=velocity_ws, stride_scale=scale
    )
    ground = fragment(Terrain, up_ws=jnp.asarray([0.0, 1.0, 0.0], toes_ms.dtype))
    return rule.sense(fragment(Inputs, frame=frame, terrain=ground, gate=gate))


offsets_of_all = jax.jit(jax.vmap(offsets, in_axes=(None, 0, 0, 0, 0)))


@pytest.fixture(scope="module")
def animation():
    """Frames of a wandering creature, with velocities and scales of all sizes."""
    frames = wandering(make_rig(legs=LEGS), np.random.default_rng(4))
    scales = np.random.default_rng(5).uniform(0.2, 2.2, len(frames))
    each = to_frames(frames)
    arrays = each.world_from_model, each.pose.toe.pos, each.velocity_ws, jnp.asarray(scales)
    return frames, arrays


@pytest.mark.parametrize("values", [VALUES, PER_LEG], ids=["shared", "per leg"])
def test_feet_move_as_in_numpy(animation, values):
    frames, arrays = animation
    changes, defaults = (
        {f"warp.{name}": value for name, value in each.items()} for each in (values, VALUES)
    )
    parameters = Parameters(changes, defaults)
    expected = [
        [warp.moved(parameters, frame, leg, velocity, scale, maths.Y) for leg in range(LEGS)]
        for frame, velocity, scale in zip(frames, *map(np.asarray, arrays[2:]), strict=True)
    ]
    actual = offsets_of_all(StrideWarp(**values), *arrays)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-12)
    assert np.abs(expected).max() > 0.05


def test_a_place_on_the_ground_stays_one_whatever_the_way(animation):
    _, (root, toes, velocity, _) = animation
    scale = 1.3
    balls = np.asarray(jax.vmap(lambda root, toes: root.apply(toes))(root, toes))
    faster = np.asarray(root.pos) * (scale - 1.0) * [1.0, 0.0, 1.0]
    moved = offsets_of_all(StrideWarp(), root, toes, velocity, jnp.full(len(toes), scale))
    actual = balls + faster[:, None] + np.asarray(moved)
    np.testing.assert_allclose(actual, balls * [scale, 1.0, scale], rtol=0, atol=1e-12)


def test_single_precision_and_lanes_give_the_same(animation):
    few = jax.tree.map(lambda leaf: leaf[:4], animation[1])
    assert_single_precision_agrees(offsets_of_all, StrideWarp(**VALUES), *few)
    assert_lanes_agree(lambda *frame: offsets(StrideWarp(**VALUES), *frame), *few)


@pytest.mark.parametrize("gate", [HARD, Smooth(1.0)], ids=["hard", "smooth"])
def test_derivatives_are_difference_quotients_and_finite_at_rest(animation, gate):
    root, toes, velocity, _ = jax.tree.map(lambda leaf: leaf[0], animation[1])

    def moved(values, toes, velocity, scale):
        return offsets(StrideWarp(**values), root, toes, velocity, scale, gate)

    assert_gradients_match(moved, VALUES, toes, velocity, jnp.asarray(1.2))
    finite_jacobian(moved, VALUES, jnp.zeros((LEGS, 3)), jnp.zeros(3), jnp.asarray(0.0))


def test_without_a_scale_there_is_no_warp():
    for rule, scale in ((StrideWarp(), None), (NoWarp(), jnp.asarray(1.3))):
        root = Transform.identity()
        assert offsets(rule, root, jnp.zeros((2, 3)), jnp.zeros(3), scale) is None


def test_ankles_before_strides_are_scaled_are_where_the_animation_has_them():
    animated, warp_ws = jnp.arange(6.0).reshape(2, 3), jnp.ones((2, 3))
    for moved, by in ((animated, None), (animated + warp_ws, warp_ws)):
        sensed = SimpleNamespace(ankle_ws=moved, warp_ws=by)
        unscaled = vars(Sensed)["unscaled_ankle_ws"].fget(sensed)
        np.testing.assert_allclose(unscaled, animated)


def slides(clip, stance):
    """Horizontal way of the ball in each stance, m."""
    steps = np.linalg.norm(np.diff(clip.joints_ws(3)[..., [0, 2]], axis=0), axis=-1)
    return [
        steps[first:last, leg].sum()
        for leg in range(stance.shape[1])
        for first, last in contacts.runs(stance[:, leg])
    ]


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.7, 1.3])
def test_feet_of_a_faster_or_slower_walk_do_not_skate(speed):
    clip = walker.walk(3.0, 30.0)
    played = edit.at_speed(clip, speed)
    frames = frames_from_clip(played, stride_scale=speed)
    unscaled = dataclasses.replace(frames, stride_scale=jnp.ones_like(frames.dt))
    ik, ground = jaxik.presets.stride(), terrain.plane()
    results = [jaxik.run(ik, clip.rig, ground, each) for each in (frames, unscaled)]
    stance = clip.stance_labels()
    scaled, skating = (slides(clip_from_result(played, result), stance) for result in results)
    assert np.median(skating) > 0.10 and np.median(scaled) < 0.005
    reached = np.asarray(results[0].reached) > 0
    assert reached[stance].mean() > 0.95
    # Before it lands, a foot ahead of a leg that is too short for the stride may lag behind.
    assert reached.mean() > 0.85
    # Longer strides need a lower pelvis; shorter ones do not.
    lowered = np.asarray(results[0].body.pos[:, 1]).min()
    assert (lowered < -0.01) == (speed > 1)
