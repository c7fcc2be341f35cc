"""Limbs bent to a pole: geometry, ozz's formulas written with angles, limits, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from jaxik.maths import quat, vec
from jaxik.maths.gate import HARD, AbstractGate, Smooth
from jaxik.solvers import pole as poles
from jaxik.solvers.two_bone import Limb
from support.gradients import (
    TINY,
    assert_gradients_match,
    finite_jacobian,
    numbers,
    quaternions,
    vectors,
)
from support.limbs import limbs

few = settings(max_examples=20, derandomize=True, deadline=None)
X, Y, Z = np.eye(3)
ONE, NONE = np.float64(1.0), np.float64(0.0)


def bend(to_hip, to_ankle, hinge, to_target, pole, soften, twist, gate: AbstractGate = HARD):
    """`bend_to_pole` of plain arrays."""
    arrays = map(jnp.asarray, (to_hip, to_ankle, hinge, to_target, pole, soften, twist))
    to_hip, to_ankle, hinge, to_target, pole, soften, twist = arrays
    target = poles.PoleTarget(to_target, pole, twist)
    return poles.bend_to_pole(Limb(to_hip, to_ankle, hinge), target, soften, gate)


@jax.jit
def solve(to_hip, to_ankle, hinge, *task):
    """Knee and ankle relative to the hip, hinge and swing after the bend; and `reached`."""
    bent = bend(to_hip, to_ankle, hinge, *task)
    knee_rot = quat.from_half_angle(hinge, bent.half_cos, bent.half_sin)
    knee = -quat.rotate(bent.swing, to_hip)
    ankle = knee + quat.rotate(bent.swing, quat.rotate(knee_rot, to_ankle))
    return knee, ankle, quat.rotate(bent.swing, hinge), bent.swing, bent.reached


def joints(to_hip, to_ankle, hinge, *task):
    """Knee, ankle and hinge after the bend: independent of the sign of a quaternion."""
    unit = jnp.asarray(hinge) / jnp.linalg.norm(hinge, axis=-1, keepdims=True)
    return solve(to_hip, to_ankle, unit, *task)[:3]


@st.composite
def targets(draw: st.DrawFn, to_hip, to_ankle) -> tuple[np.ndarray, np.ndarray]:
    """A target well within reach, and a pole, of any length, well away from its direction."""
    thigh, shin = np.linalg.norm(to_hip), np.linalg.norm(to_ankle)
    direction, pole = draw(vectors(sizes=(1.0,))), draw(vectors(sizes=(1.0, 30.0, 1e-3)))
    direction = direction / np.linalg.norm(direction)
    across = np.linalg.norm(np.cross(direction, pole)) / np.linalg.norm(pole)
    if across < 0.1:
        pole = np.roll(direction, 1) * [1.0, -1.0, 0.5]
    fraction = draw(numbers(0.05, 0.95))
    distance = abs(thigh - shin) + fraction * (thigh + shin - abs(thigh - shin))
    return direction * distance, pole


@st.composite
def tasks(draw: st.DrawFn) -> tuple[np.ndarray, ...]:
    """A limb bent either way, its target and its pole."""
    knee_angles = numbers(0.1, 3.0).flatmap(lambda x: st.sampled_from([x, -x]))
    to_hip, to_ankle, hinge = draw(limbs(knee_angles))
    return (to_hip, to_ankle, hinge, *draw(targets(to_hip, to_ankle)))


def solve_by_angles(to_hip, to_ankle, hinge, target, pole, soften, twist):
    """Knee and hip rotation as ozz's two-bone job has them: arc cosines, planes by unit normals."""
    a, b, distance = (np.linalg.norm(v) for v in (to_hip, to_ankle, target))
    free = soften * (a + b)
    if distance > free and soften < 1:
        room = a + b - free
        alpha = (distance - free) / room
        distance = free + room * (1 - 3**4 / (alpha + 3) ** 4)
    now = np.arccos(np.clip(to_hip @ to_ankle / (a * b), -1, 1))
    if hinge @ np.cross(to_hip, to_ankle) < 0:
        now = -now
    wanted = np.arccos(np.clip((a * a + b * b - distance**2) / (2 * a * b), -1, 1))
    knee = Rotation.from_rotvec((wanted - now) * hinge)

    bent, aim = knee.apply(to_ankle) - to_hip, target / np.linalg.norm(target)
    axis = np.cross(bent, target)
    arc = np.arctan2(np.linalg.norm(axis), bent @ target) * axis / np.linalg.norm(axis)
    arc = Rotation.from_rotvec(arc)
    reference, normal = np.cross(target, pole), arc.apply(hinge)
    cos = np.clip(reference @ normal / np.linalg.norm(reference), -1, 1)
    plane = Rotation.from_rotvec(np.copysign(np.arccos(cos), normal @ pole) * aim)
    return knee, Rotation.from_rotvec(twist * aim) * plane * arc


@few
@given(tasks(), numbers(-3, 3))
def test_a_target_within_reach_is_reached_with_the_knee_towards_the_pole(task, twist):
    to_hip, to_ankle, hinge, target, pole = task
    knee, ankle, normal, swing, reached = solve(*task, ONE, NONE)
    assert reached == 1
    assert_allclose(ankle, target, atol=1e-12)
    plane = np.cross(target, pole)
    assert_allclose(normal, plane / np.linalg.norm(plane), atol=1e-9)
    assert np.dot(np.cross(target, knee), plane) > 0
    assert_allclose(np.linalg.norm(knee), np.linalg.norm(to_hip), atol=1e-14)
    assert_allclose(np.linalg.norm(swing), 1.0, atol=1e-14)

    twisted, ankle, *_ = solve(*task, ONE, np.float64(twist))
    aim = target / np.linalg.norm(target)
    assert_allclose(ankle, target, atol=1e-12)
    assert_allclose(twisted, Rotation.from_rotvec(twist * aim).as_matrix() @ knee, atol=1e-12)


@few
@given(limbs(numbers(0.1, 3.0)), st.sampled_from([1e-3, 1.0, 30.0]))
def test_a_limb_already_at_its_target_does_not_rotate(limb, length):
    to_hip, to_ankle, _ = limb
    pole = length * -to_hip
    knee, ankle, _, swing, reached = solve(*limb, to_ankle - to_hip, pole, ONE, NONE)
    assert_allclose(swing, quat.identity(jnp.float64), atol=1e-9)
    assert_allclose(knee, -to_hip, atol=1e-9)
    assert_allclose(ankle, to_ankle - to_hip, atol=1e-9)
    assert reached == 1


@few
@given(tasks(), quaternions(), numbers(0.5, 1.0), numbers(-3, 3))
def test_rotating_the_task_rotates_the_result(task, rot, soften, twist):
    options = np.float64(soften), np.float64(twist)
    world = Rotation.from_quat(rot, scalar_first=True)
    original = solve(*task, *options)[:3]
    rotated = solve(*map(world.apply, task), *options)[:3]
    for before, after in zip(original, rotated, strict=True):
        assert_allclose(after, world.as_matrix() @ before, atol=1e-9)


@few
@given(tasks(), vectors((0.3, TINY)), numbers(0.3, 1.0), numbers(0.5, 2.0), numbers(-3, 3))
def test_tilted_hinges_and_soft_limits_follow_the_formulas_of_ozz(task, tilt, soften, far, twist):
    to_hip, to_ankle, hinge, target, pole = task
    hinge = (hinge + tilt) / np.linalg.norm(hinge + tilt)
    target = far * target
    task = to_hip, to_ankle, hinge, target, pole, np.float64(soften), np.float64(twist)
    knee_rot, hip_rot = solve_by_angles(*task)
    knee, ankle, *_ = solve(*task)
    # An arc cosine near 1 is only accurate to the square root of the rounding error.
    assert_allclose(knee, -hip_rot.apply(to_hip), atol=1e-6)
    assert_allclose(ankle, hip_rot.apply(knee_rot.apply(to_ankle) - to_hip), atol=1e-6)


@pytest.mark.parametrize(
    ("distance", "soften", "reached"),
    [
        (0.0, 1.0, 0),
        (0.25, 1.0, 0),
        (0.2501, 1.0, 1),
        (1.25, 1.0, 1),
        (1.2501, 1.0, 0),
        (0.625, 0.5, 1),
        (0.6251, 0.5, 0),
        (1.25, 1.5, 1),
        (0.3, -1.0, 0),
    ],
)
def test_a_target_is_reached_beyond_the_bones_difference_and_up_to_the_soft_length(
    distance, soften, reached
):
    args = 0.75 * X, 0.5 * Y, Z, distance * Y, X, np.float64(soften), NONE
    assert solve(*args)[-1] == reached
    smooth = bend(*args, gate=Smooth(0.1)).reached
    assert (smooth > 0.5) == reached or distance in (0.25, 1.25, 0.625)


def test_a_target_on_the_hip_folds_the_knee_and_does_not_rotate_the_hip():
    knee, ankle, _, swing, reached = solve(0.5 * X, 0.5 * Y, Z, 0 * X, Y, ONE, ONE)
    assert_allclose(swing, quat.identity(jnp.float64), atol=0)
    assert_allclose(knee, -0.5 * X, atol=0)
    assert_allclose(ankle, 0 * X, atol=1e-15)
    assert reached == 0


@pytest.mark.parametrize("pole", [0 * X, Y, -3 * Y], ids=["none", "along", "against"])
def test_a_pole_without_a_plane_leaves_the_shortest_arc(pole):
    hinge = (Z + 0.2 * Y) / np.sqrt(1.04)
    knee, ankle, _, swing, _ = solve(0.5 * X, 0.4 * Y, hinge, 0.7 * Y, pole, ONE, NONE)
    bent = quat.unrotate(swing, jnp.asarray(ankle))
    direct = quat.shortest_arc(vec.normalize(bent, bent), jnp.asarray(Y), jnp.asarray(X))
    assert_allclose(quat.angle(direct, swing), 0.0, atol=1e-12)
    assert_allclose(knee, -quat.rotate(direct, jnp.asarray(0.5 * X)), atol=1e-12)


def test_a_limb_with_bones_of_length_zero_stays_a_point():
    knee, ankle, normal, swing, reached = solve(0 * X, 0 * X, Z, Y, X, ONE, NONE)
    assert_allclose([knee, ankle], 0.0, atol=0)
    assert_allclose([np.linalg.norm(normal), np.linalg.norm(swing)], 1.0, atol=1e-15)
    assert reached == 0


BENT = 0.6 * X, 0.4 * Y, Z
STRAIGHT = 0.6 * X, -0.4 * X, Z
NEARLY = 0.6 * X, -0.4 * X + TINY * Y, Z
SINGULAR = {
    "straight, target nearer": (*STRAIGHT, 0.7 * Y, X, ONE),
    "straight, target at full length": (*STRAIGHT, -1.0 * X, Y, ONE),
    "straight, target out of reach": (*STRAIGHT, -2.0 * X, Y, np.float64(0.97)),
    "nearly straight": (*NEARLY, -0.8 * X, Y, ONE),
    "nearly straight, bent backwards": (0.6 * X, -0.4 * X - TINY * Y, Z, -0.8 * X, Y, ONE),
    "folded, target where it is": (0.6 * X, 0.4 * X, Z, -0.2 * X, Y, ONE),
    "folded, target too near": (0.6 * X, 0.4 * X, Z, -0.1 * X, Y, ONE),
    "ankle on the hip": (0.5 * X, 0.5 * X, Z, 0.3 * Y, X, ONE),
    "target on the hip": (*BENT, 0 * X, X, ONE),
    "folded onto a target on the hip": (0.5 * X, 0.5 * X, Z, 0 * X, X, ONE),
    "target beside the hip": (0.5 * X, 0.5 * Y, Z, TINY * Y, X, ONE),
    "target at full length": (*BENT, Y, X, ONE),
    "target where softening starts": (*BENT, 0.5 * Y, X, np.float64(0.5)),
    "softened from the start": (*BENT, 0.5 * Y, X, NONE),
    "pole along the target": (*BENT, 0.7 * Y, Y, ONE),
    "pole against the target": (*BENT, 0.7 * Y, -Y, ONE),
    "pole beside the target": (*BENT, 0.7 * Y, Y + TINY * X, ONE),
    "no pole": (*BENT, 0.7 * Y, 0 * X, ONE),
    "pole opposed to the knee": (*BENT, 0.4 * Y - 0.6 * X, X, ONE),
    "target opposed to the ankle": (*BENT, 0.6 * X - 0.4 * Y, X, ONE),
    "no thigh": (0 * X, 0.4 * Y, Z, 0.7 * Y, X, ONE),
    "no shin": (0.6 * X, 0 * X, Z, 0.7 * Y, X, ONE),
    "no bones": (0 * X, 0 * X, Z, 0.7 * Y, X, ONE),
    "hinge along the thigh": (0.6 * X, 0.4 * Y, X, 0.7 * Y, Z, ONE),
    "already at its target": (*BENT, 0.4 * Y - 0.6 * X, -X, ONE),
}


# Ozz's angle between the normals has a kink where a hinge begins to tilt in a plane that needs no
# rotation, or one by pi: gradients are compared away from there, and only have to be finite there.
@pytest.mark.slow
@pytest.mark.parametrize("tilt", [0.0, 0.3], ids=["square", "tilted"])
@pytest.mark.parametrize("seed", range(4))
def test_gradients_match_finite_differences(seed, tilt):
    rng = np.random.default_rng(seed)
    hinge, to_hip, to_ankle, target, pole, across = rng.normal(size=(6, 3))
    hinge = hinge / np.linalg.norm(hinge)
    to_hip, to_ankle = np.cross(hinge, to_hip), np.cross(hinge, to_ankle)
    length = np.linalg.norm(to_hip) + np.linalg.norm(to_ankle)
    target = rng.uniform(0.7, 1.2) * length * target / np.linalg.norm(target)
    task = to_hip, to_ankle, hinge + tilt * across, target, pole
    assert_gradients_match(joints, *task, rng.uniform(0.5, 0.9), rng.uniform(-3, 3))


@pytest.mark.slow
def test_a_straight_knee_ends_at_one_place_wherever_it_starts():
    jacobian = finite_jacobian(joints, *STRAIGHT, -0.8 * X, Y, ONE, 0.0)
    # Knee and ankle do not depend on where the ankle was sideways.
    assert_allclose(jacobian[:6, 4], 0.0, atol=1e-12)


@pytest.mark.parametrize("case", SINGULAR.values(), ids=SINGULAR.keys())
def test_gradients_are_finite_where_a_limb_has_no_single_answer(case):
    finite_jacobian(joints, *case, 0.3)


def test_gradients_are_finite_there_in_single_precision_too():
    cases = [(*case, np.float64(0.3)) for case in SINGULAR.values()]
    batch = [jnp.asarray(np.stack(x), jnp.float32) for x in zip(*cases, strict=True)]
    results, vjp = jax.vjp(joints, *batch)
    # A gradient that is not finite makes a sum of gradients not finite either.
    gradients = vjp(jax.tree.map(jnp.ones_like, results))
    for leaf in jax.tree.leaves((results, gradients)):
        assert leaf.dtype == jnp.float32
        assert np.isfinite(leaf).all()


def test_gradients_are_finite_through_a_smooth_gate():
    def reached(*case):
        return bend(*case, gate=Smooth(1.0)).reached

    for case in SINGULAR.values():
        finite_jacobian(reached, *case, 0.3)


def test_a_compiled_batch_equals_single_calls_in_either_precision():
    for dtype, tolerance in ((jnp.float64, 1e-13), (jnp.float32, 2e-6)):
        cases = [(*case, np.float64(0.3)) for case in SINGULAR.values()]
        batch = [jnp.asarray(np.stack(x), dtype) for x in zip(*cases, strict=True)]
        singles = [solve(*(x[i] for x in batch)) for i in range(3)]
        for single, batched in zip(zip(*singles, strict=True), solve(*batch), strict=True):
            assert batched.dtype == dtype
            assert_allclose(np.stack(single), batched[:3], atol=tolerance)


def test_legs_and_batches_broadcast():
    targets = np.broadcast_to(0.7 * Y, (3, 2, 3))
    bent = bend(*BENT, targets, Z, np.ones(2), 0.3)
    assert bent.swing.shape == (3, 2, 4)
    assert bent.half_cos.shape == bent.half_sin.shape == bent.reached.shape == (3, 2)
