"""The spine that leans into hills: against NumPy, its directions, limits and derivatives."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxik.maths import quat
from jaxik.maths.gate import HARD, Smooth
from jaxik.stages.inputs import Inputs, SensedMoment
from jaxik.stages.lean import SpineLean
from jaxik.world.frame import Contact, Frame, GroundHits, Sensed
from jaxik.world.skeleton import Rig, Transform
from jaxik.world.terrain import Hit, Terrain
from reference.characters import Parameters
from reference.stages import spine
from support.fragments import fragment
from support.gradients import assert_gradients_match, finite_jacobian
from support.rule_checks import assert_lanes_agree, assert_single_precision_agrees

FRAMES, DT = 60, 1.0 / 30.0
RATES = {"uphill_rate": -0.4, "downhill_rate": -0.7, "side_rate": 0.3, "pelvis_rate": -0.25}
RATES |= {"pelvis_side_rate": 0.15, "forward_rate_slide": 0.8, "side_rate_slide": -0.5}
VALUES = RATES | {"head_share": 0.6, "spacing": 0.4, "half_life": 0.15}
RULE = SpineLean(**VALUES)


def leans(rule, rots, points, normals, weights, slides, *, gate=HARD):
    """Rotations of trunk, head and pelvis (frames, 4), world axes."""
    terrain = fragment(Terrain, up_ws=jnp.asarray([0.0, 1.0, 0.0], normals.dtype))

    def frame(carry, inputs):
        state, started = carry
        rot, point, normal, weight, slide = inputs
        root = fragment(Frame, world_from_model=Transform(jnp.zeros(3, rot.dtype), rot))
        hits = fragment(Hit, found=jnp.ones_like(weight), point=point, normal=normal)
        slope = rule.sense(
            fragment(Inputs, frame=root, terrain=terrain),
            fragment(GroundHits, ankle=hits),
            fragment(Contact, weight=weight),
            jnp.ones_like(weight),
        )
        sensed = fragment(Sensed, slope=slope, slide=slide, up_ws=terrain.up_ws)
        now = SensedMoment(jnp.asarray(DT, rot.dtype), started, gate, sensed, terrain)
        state, lean = rule.advance(now, state)
        trunk = quat.multiply(lean.spine_ws, lean.rot_ws)
        return (state, jnp.ones_like(started)), (trunk, lean.head_ws, lean.rot_ws)

    rig = fragment(Rig, side=jnp.zeros(2, normals.dtype))
    start = rule.init(rig), jnp.zeros((), bool)
    return jax.lax.scan(frame, start, (rots, points, normals, weights, slides))[1]


lean_all = jax.jit(leans)
rotation = functools.partial(Rotation.from_quat, scalar_first=True)


def hills(frames=FRAMES, seed=3):
    """Headings, normals of uphill and downhill ground, weights with flights, and slides."""
    rng = np.random.default_rng(seed)
    yaw = np.linspace(0.0, 5.0, frames)
    rots = Rotation.from_rotvec(np.outer(yaw, [0.0, 1.0, 0.0])).as_quat(scalar_first=True)
    rise = np.sin(np.linspace(0.0, 9.0, frames))[:, None, None] * [0.4, 0.0, 0.3]
    normals = rise + rng.normal(0.0, 0.05, (frames, 2, 3)) + [0.0, 1.0, 0.0]
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    weights = rng.uniform(0.0, 1.0, (frames, 2)) * (np.arange(frames) % 7 > 0)[:, None]
    slides = (np.arange(frames) // 15 % 2).astype(float)
    return rots, rng.normal(0.0, 0.3, normals.shape), normals, weights, slides


def uphill(angle, frames=FRAMES, yaw=0.0):
    """A walk that faces `yaw` on ground that rises ahead by `angle`, rad."""
    turned = Rotation.from_rotvec([0.0, yaw, 0.0])
    rots = np.tile(turned.as_quat(scalar_first=True), (frames, 1))
    normal = turned.apply([0.0, np.cos(angle), -np.sin(angle)])
    normals = np.broadcast_to(normal, (frames, 2, 3))
    ways = np.linspace(-0.4, 0.4, frames)[:, None, None] * [[1.0], [-1.0]]
    steps = ways * turned.apply([0.0, 0.0, 1.0])
    points = steps - (steps @ normal / normal[1])[..., None] * [0.0, 1.0, 0.0]
    return rots, points, normals, np.ones((frames, 2)), np.zeros(frames)


def test_trunk_head_and_pelvis_turn_as_in_numpy():
    clip = hills()
    parameters = Parameters(defaults={f"lean.{name}": value for name, value in VALUES.items()})
    state, expected = None, []
    for frame in zip(*clip, strict=True):
        state, *rotations = spine.lean(parameters, *frame, DT, state)
        expected.append(rotations)
    actual = np.stack(lean_all(RULE, *clip), axis=1)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-12)
    assert np.degrees(rotation(actual[:, 0]).magnitude()).max() > 5.0


@pytest.mark.parametrize(("angle", "rate"), [(0.3, -0.4), (-0.3, -0.7), (0.0, 0.0)])
@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_people_lean_forward_uphill_and_backward_downhill(angle, rate, yaw):
    turned = (np.asarray(rot)[-1] for rot in lean_all(RULE, *uphill(angle, yaw=yaw)))
    forward = Rotation.from_rotvec([0.0, yaw, 0.0]).apply([0.0, 0.0, 1.0])
    tops = [rotation(rot).apply([0.0, 1.0, 0.0]) @ forward for rot in turned]
    expected = np.sin(np.array([-rate, 0.6 * rate, 0.25]) * angle)
    np.testing.assert_allclose(tops, expected, atol=1e-12)


def test_stairs_are_a_slope_from_foot_to_foot():
    rots, points, _, weights, slides = uphill(0.5)
    level = np.broadcast_to([0.0, 1.0, 0.0], points.shape)
    wide = np.asarray(lean_all(RULE, rots, points, level, weights, slides)[0])[-1, 1]
    narrow = np.asarray(lean_all(RULE, rots, 0.05 * points, level, weights, slides)[0])[-1, 1]
    ramp = np.asarray(lean_all(RULE, rots, points, *uphill(0.5)[2:])[0])[-1, 1]
    assert 0.4 * ramp < wide < 0.9 * ramp and 0.0 < narrow < 0.05 * ramp


def test_a_head_that_turns_back_all_the_way_stays_level():
    trunk, head, _ = lean_all(dataclasses.replace(RULE, head_share=jnp.asarray(1.0)), *hills())
    np.testing.assert_allclose((rotation(head) * rotation(trunk)).magnitude(), 0.0, atol=1e-12)


def test_the_lean_crosses_level_ground_without_a_jump():
    angles = np.linspace(-0.01, 0.01, 41)
    last = [np.asarray(lean_all(RULE, *uphill(angle))[0])[-1, 1] for angle in angles]
    assert np.abs(np.diff(last)).max() < 0.7 * 0.0005 / 2 * 1.01


def test_single_precision_and_lanes_give_the_same():
    clip = hills()
    assert_single_precision_agrees(lean_all, RULE, *clip)
    few = tuple(values[:3] for values in clip)
    head = lambda share: leans(dataclasses.replace(RULE, head_share=share), *few)[1]  # noqa: E731
    assert_lanes_agree(head, jnp.asarray([0.0, 0.5, 1.0]))


@pytest.mark.parametrize("gate", [HARD, Smooth(1.0)], ids=["hard", "smooth"])
def test_derivatives_are_difference_quotients_and_finite_on_level_ground(gate):
    rots, points, normals, *rest = hills(frames=4)

    def rotations(values, points, normals):
        return jnp.stack(leans(SpineLean(**values), rots, points, normals, *rest, gate=gate))

    assert_gradients_match(rotations, VALUES, points, normals)
    level = np.broadcast_to([0.0, 1.0, 0.0], normals.shape)
    finite_jacobian(rotations, VALUES, np.zeros_like(points), level)
