"""Limbs that bend to a pole: what they must do, ozz's formulas by angles, answers, slopes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from jaxik.maths import quat, vec
from jaxik.maths.gate import HARD, Smooth
from jaxik.solvers import two_bone
from support.gradients import (
    TINY,
    assert_gradients_match,
    finite_jacobian,
    numbers,
    quaternions,
    vectors,
)

few = settings(max_examples=20, derandomize=True, deadline=None)
X, Y, Z = np.eye(3)
ONE, NONE = np.float64(1.0), np.float64(0.0)


@jax.jit
def solved(to_hip, to_ankle, hinge, to_target, pole, soften, twist):
    """Knee and ankle, from the hip, the hinge and the swing after the bend; and `reached`."""
    args = map(jnp.asarray, (to_hip, to_ankle, hinge, to_target, pole, soften, twist))
    bend = two_bone.pole_bend(*args, gate=HARD)
    turn = quat.from_half_angle(hinge, bend.half_cos, bend.half_sin)
    knee = -quat.rotate(bend.swing, to_hip)
    ankle = knee + quat.rotate(bend.swing, quat.rotate(turn, to_ankle))
    return knee, ankle, quat.rotate(bend.swing, hinge), bend.swing, bend.reached


def ends(to_hip, to_ankle, hinge, *rest):
    """Knee, ankle and hinge after the bend: free of a quaternion's choice of sign."""
    unit = jnp.asarray(hinge) / jnp.linalg.norm(hinge, axis=-1, keepdims=True)
    return solved(to_hip, to_ankle, unit, *rest)[:3]


@st.composite
def limbs(draw: st.DrawFn, bend: st.SearchStrategy[float]) -> tuple[np.ndarray, ...]:
    """To hip, to ankle, hinge, at any attitude, with an interior angle from `bend`, rad."""
    thigh, shin, angle = draw(numbers(0.2, 0.6)), draw(numbers(0.2, 0.6)), draw(bend)
    attitude = Rotation.from_quat(draw(quaternions()), scalar_first=True)
    to_ankle = shin * (np.cos(angle) * X + np.sin(angle) * Y)
    return attitude.apply(thigh * X), attitude.apply(to_ankle), attitude.apply(Z)


@st.composite
def targets(draw: st.DrawFn, to_hip, to_ankle) -> tuple[np.ndarray, np.ndarray]:
    """A target well within reach, and a pole, of any length, well away from its direction."""
    thigh, shin = np.linalg.norm(to_hip), np.linalg.norm(to_ankle)
    direction, pole = draw(vectors(sizes=(1.0,))), draw(vectors(sizes=(1.0, 30.0, 1e-3)))
    direction = direction / np.linalg.norm(direction)
    across = np.linalg.norm(np.cross(direction, pole)) / np.linalg.norm(pole)
    if across < 0.1:
        pole = np.roll(direction, 1) * [1.0, -1.0, 0.5]
    share = draw(numbers(0.05, 0.95))
    return direction * (abs(thigh - shin) + share * (thigh + shin - abs(thigh - shin))), pole


@st.composite
def tasks(draw: st.DrawFn) -> tuple[np.ndarray, ...]:
    """A limb bent either way, and what it is to do."""
    bend = numbers(0.1, 3.0).flatmap(lambda x: st.sampled_from([x, -x]))
    to_hip, to_ankle, hinge = draw(limbs(bend))
    return (to_hip, to_ankle, hinge, *draw(targets(to_hip, to_ankle)))


def by_angles(to_hip, to_ankle, hinge, target, pole, soften, twist):
    """Ozz's two-bone job in its own words: angles by arc cosines, planes by unit normals.

    The knee's rotation and the hip's.
    """
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
def test_a_target_within_reach_is_met_with_the_knee_towards_the_pole(task, twist):
    to_hip, to_ankle, hinge, target, pole = task
    knee, ankle, normal, swing, reached = solved(*task, ONE, NONE)
    assert reached == 1
    assert_allclose(ankle, target, atol=1e-12)
    plane = np.cross(target, pole)
    assert_allclose(normal, plane / np.linalg.norm(plane), atol=1e-9)
    assert np.dot(np.cross(target, knee), plane) > 0
    assert_allclose(np.linalg.norm(knee), np.linalg.norm(to_hip), atol=1e-14)
    assert_allclose(np.linalg.norm(swing), 1.0, atol=1e-14)

    turned, ankle, *_ = solved(*task, ONE, np.float64(twist))
    aim = target / np.linalg.norm(target)
    assert_allclose(ankle, target, atol=1e-12)
    assert_allclose(turned, Rotation.from_rotvec(twist * aim).as_matrix() @ knee, atol=1e-12)


@few
@given(limbs(numbers(0.1, 3.0)), st.sampled_from([1e-3, 1.0, 30.0]))
def test_nothing_turns_where_the_limb_is_as_it_should_be(posed, length):
    to_hip, to_ankle, hinge = posed
    pole = length * -to_hip
    knee, ankle, _, swing, reached = solved(*posed, to_ankle - to_hip, pole, ONE, NONE)
    assert_allclose(swing, quat.identity(jnp.float64), atol=1e-9)
    assert_allclose(knee, -to_hip, atol=1e-9)
    assert_allclose(ankle, to_ankle - to_hip, atol=1e-9)
    assert reached == 1


@few
@given(tasks(), quaternions(), numbers(0.5, 1.0), numbers(-3, 3))
def test_turning_the_world_turns_the_answer(task, turn, soften, twist):
    rest = np.float64(soften), np.float64(twist)
    world = Rotation.from_quat(turn, scalar_first=True)
    for here, there in zip(
        solved(*task, *rest)[:3], solved(*map(world.apply, task), *rest)[:3], strict=True
    ):
        assert_allclose(there, world.as_matrix() @ here, atol=1e-9)


@few
@given(tasks(), vectors((0.3, TINY)), numbers(0.3, 1.0), numbers(0.5, 2.0), numbers(-3, 3))
def test_tilted_hinges_and_soft_limits_follow_ozz_s_own_formulas(task, tilt, soften, far, twist):
    to_hip, to_ankle, hinge, target, pole = task
    hinge = (hinge + tilt) / np.linalg.norm(hinge + tilt)
    target = far * target
    task = to_hip, to_ankle, hinge, target, pole, np.float64(soften), np.float64(twist)
    bent, swung = by_angles(*task)
    knee, ankle, *_ = solved(*task)
    # An arc cosine near one is only good to the root of the rounding.
    assert_allclose(knee, -swung.apply(to_hip), atol=1e-6)
    assert_allclose(ankle, swung.apply(bent.apply(to_ankle) - to_hip), atol=1e-6)


def test_the_soft_curve_passes_its_start_and_rises_to_its_limit():
    x = np.linspace(0.0, 50.0, 5001)
    y = np.asarray(two_bone.quartic_limit(jnp.asarray(x), jnp.asarray(0.9), jnp.asarray(1.4)))
    assert_allclose(y[x <= 0.9], x[x <= 0.9], atol=0)
    assert (np.diff(y) > 0).all() and y[-1] < 1.4
    assert_allclose(y[-1], 1.4, atol=1e-6)
    assert_allclose((y - x).max(), 0.028 * 0.5, rtol=0.02)
    assert_allclose(
        finite_jacobian(two_bone.quartic_limit, 0.9 + 1e-9, 0.9, 1.4)[0, 0], 4 / 3, atol=1e-6
    )


def test_without_room_nothing_is_softened():
    x = jnp.asarray([0.5, 1.0, 3.0])
    assert_allclose(two_bone.quartic_limit(x, jnp.asarray(1.0), jnp.asarray(1.0)), x, atol=0)


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
def test_reached_is_more_than_the_bones_difference_and_at_most_the_soft_length(
    distance, soften, reached
):
    args = 0.75 * X, 0.5 * Y, Z, distance * Y, X, np.float64(soften), NONE
    assert solved(*args)[-1] == reached
    smooth = two_bone.pole_bend(*map(jnp.asarray, args), gate=Smooth(0.1)).reached
    assert (smooth > 0.5) == reached or distance in (0.25, 1.25, 0.625)


def test_a_target_on_the_hip_folds_the_knee_and_leaves_the_hip():
    knee, ankle, _, swing, reached = solved(0.5 * X, 0.5 * Y, Z, 0 * X, Y, ONE, ONE)
    assert_allclose(swing, quat.identity(jnp.float64), atol=0)
    assert_allclose(knee, -0.5 * X, atol=0)
    assert_allclose(ankle, 0 * X, atol=1e-15)
    assert reached == 0


@pytest.mark.parametrize("pole", [0 * X, Y, -3 * Y], ids=["none", "along", "against"])
def test_a_pole_without_a_plane_leaves_the_shortest_arc(pole):
    hinge = (Z + 0.2 * Y) / np.sqrt(1.04)
    knee, ankle, _, swing, _ = solved(0.5 * X, 0.4 * Y, hinge, 0.7 * Y, pole, ONE, NONE)
    bent = quat.unrotate(swing, jnp.asarray(ankle))
    direct = quat.shortest_arc(vec.normalize(bent, bent), jnp.asarray(Y), jnp.asarray(X))
    assert_allclose(quat.angle(direct, swing), 0.0, atol=1e-12)
    assert_allclose(knee, -quat.rotate(direct, jnp.asarray(0.5 * X)), atol=1e-12)


def test_a_limb_without_bones_stays_a_point():
    knee, ankle, normal, swing, reached = solved(0 * X, 0 * X, Z, Y, X, ONE, NONE)
    assert_allclose([knee, ankle], 0.0, atol=0)
    assert_allclose([np.linalg.norm(normal), np.linalg.norm(swing)], 1.0, atol=1e-15)
    assert reached == 0


@pytest.mark.parametrize("side", [X, Y, 0 * X], ids=["across", "along", "none"])
def test_half_a_turn_goes_about_a_side_at_right_angles(side):
    for start in (Y, -Y, Z):
        turn = two_bone.arc_beside(jnp.asarray(start), jnp.asarray(-start), jnp.asarray(side))
        assert_allclose(quat.rotate(turn, jnp.asarray(start)), -start, atol=1e-15)
        assert_allclose(np.linalg.norm(turn), 1.0, atol=1e-15)


BENT = 0.6 * X, 0.4 * Y, Z
STRAIGHT = 0.6 * X, -0.4 * X, Z
NEARLY = 0.6 * X, -0.4 * X + TINY * Y, Z
SINGULAR = {
    "straight, to be bent": (*STRAIGHT, 0.7 * Y, X, ONE),
    "straight, and so its target": (*STRAIGHT, -1.0 * X, Y, ONE),
    "straight, out of reach": (*STRAIGHT, -2.0 * X, Y, np.float64(0.97)),
    "nearly straight": (*NEARLY, -0.8 * X, Y, ONE),
    "nearly straight, bent backwards": (0.6 * X, -0.4 * X - TINY * Y, Z, -0.8 * X, Y, ONE),
    "folded, and to stay so": (0.6 * X, 0.4 * X, Z, -0.2 * X, Y, ONE),
    "folded, target too near": (0.6 * X, 0.4 * X, Z, -0.1 * X, Y, ONE),
    "ankle on the hip": (0.5 * X, 0.5 * X, Z, 0.3 * Y, X, ONE),
    "target on the hip": (*BENT, 0 * X, X, ONE),
    "folded onto a target on the hip": (0.5 * X, 0.5 * X, Z, 0 * X, X, ONE),
    "target beside the hip": (0.5 * X, 0.5 * Y, Z, TINY * Y, X, ONE),
    "target at full length": (*BENT, Y, X, ONE),
    "target where it grows soft": (*BENT, 0.5 * Y, X, np.float64(0.5)),
    "soft all the way": (*BENT, 0.5 * Y, X, NONE),
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
    "nothing to do": (*BENT, 0.4 * Y - 0.6 * X, -X, ONE),
}


# Ozz's angle between the normals has a kink where a hinge begins to tilt in a plane that needs no
# turn, or half a turn: slopes are held against differences away from there, and finite there.
@pytest.mark.parametrize("tilt", [0.0, 0.3], ids=["square", "tilted"])
@pytest.mark.parametrize("seed", range(4))
def test_slopes_are_those_of_finite_differences(seed, tilt):
    rng = np.random.default_rng(seed)
    hinge, to_hip, to_ankle, target, pole, across = rng.normal(size=(6, 3))
    hinge = hinge / np.linalg.norm(hinge)
    to_hip, to_ankle = np.cross(hinge, to_hip), np.cross(hinge, to_ankle)
    length = np.linalg.norm(to_hip) + np.linalg.norm(to_ankle)
    target = rng.uniform(0.7, 1.2) * length * target / np.linalg.norm(target)
    task = to_hip, to_ankle, hinge + tilt * across, target, pole
    assert_gradients_match(ends, *task, rng.uniform(0.5, 0.9), rng.uniform(-3, 3))


@few
@given(numbers(0.1, 3.0), numbers(0.1, 1.0), numbers(1.1, 2.0))
def test_slopes_of_the_soft_curve_are_those_of_finite_differences(x, free, limit):
    if abs(x - free) > 0.01:
        assert_gradients_match(two_bone.quartic_limit, x, free, limit)


def test_a_straight_knee_has_the_slope_of_its_sine():
    slopes = finite_jacobian(ends, *STRAIGHT, -0.8 * X, Y, ONE, 0.0)
    # Knee and ankle, by the ankle's way sideways: from wherever it starts it ends at one place.
    assert_allclose(slopes[:6, 4], 0.0, atol=1e-12)


@pytest.mark.parametrize("case", SINGULAR.values(), ids=SINGULAR.keys())
def test_slopes_are_finite_where_a_limb_has_no_single_answer(case):
    finite_jacobian(ends, *case, 0.3)


def test_slopes_are_finite_there_in_single_precision_too():
    cases = [(*case, np.float64(0.3)) for case in SINGULAR.values()]
    batch = [jnp.asarray(np.stack(x), jnp.float32) for x in zip(*cases, strict=True)]
    answers, pull = jax.vjp(ends, *batch)
    # What is not finite in one slope is not finite in a sum of slopes either.
    slopes = pull(jax.tree.map(jnp.ones_like, answers))
    for leaf in jax.tree.leaves((answers, slopes)):
        assert leaf.dtype == jnp.float32
        assert np.isfinite(leaf).all()


def test_slopes_are_finite_through_a_smooth_gate():
    def reached(*case):
        return two_bone.pole_bend(*map(jnp.asarray, case), gate=Smooth(1.0)).reached

    for case in SINGULAR.values():
        finite_jacobian(reached, *case, 0.3)


def test_a_compiled_batch_is_many_singles_in_either_precision():
    for dtype, tolerance in ((jnp.float64, 1e-13), (jnp.float32, 2e-6)):
        cases = [(*case, np.float64(0.3)) for case in SINGULAR.values()]
        batch = [jnp.asarray(np.stack(x), dtype) for x in zip(*cases, strict=True)]
        whole = solved(*batch)
        singles = [solved(*(x[i] for x in batch)) for i in range(3)]
        for one, many in zip(zip(*singles, strict=True), whole, strict=True):
            assert many.dtype == dtype
            assert_allclose(np.stack(one), many[:3], atol=tolerance)


def test_legs_and_batches_are_broadcast():
    to_hip, to_ankle, hinge = (jnp.asarray(v) for v in BENT)
    target = jnp.asarray(np.broadcast_to(0.7 * Y, (3, 2, 3)))
    soften, twist = jnp.ones(2), jnp.asarray(0.3)
    bend = two_bone.pole_bend(to_hip, to_ankle, hinge, target, hinge, soften, twist, HARD)
    assert bend.swing.shape == (3, 2, 4)
    assert bend.half_cos.shape == bend.half_sin.shape == bend.reached.shape == (3, 2)


def swung(bent, to_target, hinge, twist):
    """The axes after a swing: free of a quaternion's choice of sign."""
    return quat.axes(two_bone.swing_rotation(bent, to_target, hinge, twist))


@few
@given(vectors((1.0,)), vectors((1.0,)), vectors((1.0,)), numbers(-3, 3))
def test_the_slopes_of_a_swing_agree_with_differences(bent, to_target, hinge, twist):
    hinge = hinge / np.linalg.norm(hinge)
    aims = [v / np.linalg.norm(v) for v in (bent, to_target)]
    assume(aims[0] @ aims[1] > -0.99)
    assume(max(abs(aims[0] @ hinge), abs(aims[1] @ hinge)) < 0.99)
    assert_gradients_match(swung, bent, to_target, hinge, twist)


@few
@given(limbs(numbers(0.1, 3.0)), st.floats(0.2, 0.9))
def test_the_slopes_of_a_knee_agree_with_differences(drawn, share):
    to_hip, to_ankle, hinge = drawn[:3]
    thigh, shin = np.linalg.norm(to_hip), np.linalg.norm(to_ankle)
    reach = abs(thigh - shin) + share * (thigh + shin - abs(thigh - shin))
    assert_gradients_match(two_bone.hinge_rotation, to_hip, to_ankle, hinge, reach)


def test_slopes_are_finite_where_a_swing_or_a_knee_has_no_single_answer():
    swings = ((X, -X, Y), (X, -X, X), (X, Y, X), (X, Y, Y), (X, X, X), (0 * X, Y, Z))
    for bent, target, hinge in swings:
        finite_jacobian(two_bone.swing_rotation, bent, target, hinge, 0.3)
    for hip, ankle, hinge in ((X, -X, Y), (X, X, Y), (X, Y, X), (0 * X, Y, Z), (X, Y, Z)):
        for reach in (0.0, 1.0, 2.0, 3.0):
            finite_jacobian(two_bone.hinge_rotation, hip, ankle, hinge, reach)


@few
@given(limbs(numbers(0.1, 3.0)))
def test_a_limb_straight_to_within_rounding_has_no_slope_by_its_reach(drawn):
    to_hip, to_ankle, hinge = drawn[:3]
    whole = np.linalg.norm(to_hip) + np.linalg.norm(to_ankle)
    for reach in (whole, np.nextafter(whole, 0.0), np.nextafter(whole, 9.0)):
        given_as = [jnp.asarray(x) for x in (to_hip, to_ankle, hinge, reach)]
        slopes = jax.jacfwd(two_bone.hinge_rotation, argnums=3)(*given_as)
        np.testing.assert_array_equal(slopes, 0.0)
