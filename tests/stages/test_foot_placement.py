"""What Unreal's Foot Placement and Mecanim have besides: legs that stretch, toes that bend.

Each against geometry or NumPy, its limits, precision and derivatives.
"""

import jax
import jax.numpy as jnp
import numpy as np

from fitting.runtime.precision import with_floats
from jaxik.maths import quat
from jaxik.maths.gate import HARD
from jaxik.stages.leg import LegGoal, TwoBone
from jaxik.world.skeleton import LegPose, Rig, Transform
from support.cases import Either
from support.fragments import fragment
from support.gradients import (
    assert_finite_in_single_precision,
    assert_gradients_match,
    finite_jacobian,
)

THIGH, SHIN = 0.44, 0.40  # m


# Legs that stretch.

LEG = TwoBone(max_knee_angle=np.pi, soften=0.95, max_stretch=1.1, allow_stretch=True)
BENT = np.array([0.0, -0.4125, 0.153114])  # m, from hip to knee, with the ankle 0.775 m below
WAY = np.array([0.1, -0.9, 0.3]) / np.linalg.norm([0.1, -0.9, 0.3])


def solved(rule, targets, weight=1.0, gate=HARD):
    """Knees and ankles (legs 3) of legs with their hips at the origin, m; stretch, and reached."""
    floats = targets.dtype
    zero, ones = jnp.zeros_like(targets), jnp.ones_like(targets[..., 0])
    rot = zero[..., :1] + quat.identity(floats)
    knees, ankles = (zero + jnp.asarray(x, floats) for x in (BENT, [0.0, -0.775, 0.0]))
    pose = LegPose(*(Transform(joint, rot) for joint in (zero, knees, ankles, ankles)))
    rig = fragment(Rig, knee_axis_ls=zero + jnp.asarray([-1.0, 0.0, 0.0], floats))
    leg = rule.solve(rig, LegGoal(pose, targets, weight * ones), gate)
    return leg.pose.knee.pos, leg.pose.ankle.pos, leg.stretch, leg.reached


solve = jax.jit(solved)


def test_a_leg_whose_target_is_out_of_reach_stretches_to_it_and_no_further():
    thigh, shin = np.linalg.norm(BENT), np.linalg.norm(BENT - [0.0, -0.775, 0.0])
    free = 0.95 * (thigh + shin)
    distances = free * np.array([0.6, 0.9, 1.0, 1.04, 1.09, 1.1, 1.2, 1.6])
    targets = jnp.asarray(distances[:, None] * WAY)
    weights = jnp.array([1.0] * 8 + [0.5])
    targets = jnp.concatenate([targets, targets[3:4]])
    *rows, reached = (np.asarray(x) for x in solve(LEG, targets, weights))
    (knee, ankle, stretch), reached = (x[:8] for x in rows), reached[:8]
    expected = np.clip(distances / free, 1.0, 1.1)
    np.testing.assert_allclose(stretch, expected, atol=1e-12)
    np.testing.assert_array_equal(reached, distances < 1.15 * free)
    np.testing.assert_allclose(ankle[:6], targets[:6], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(knee, axis=-1), thigh * expected, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(ankle - knee, axis=-1), shin * expected, atol=1e-12)
    bend = np.vecdot(knee, ankle - knee) / expected**2
    np.testing.assert_allclose(bend[2:6], bend[2], atol=1e-9)
    lengths = np.linalg.norm(ankle[6:], axis=-1)
    assert np.all(lengths > 1.1 * free) and np.all(lengths < 1.1 * (thigh + shin))

    np.testing.assert_allclose(rows[2][8], 1.02, atol=1e-12, err_msg="half of the foot IK")
    rigid = solve(TwoBone(max_knee_angle=np.pi, soften=0.95), targets, weights)
    assert rigid[2] is None
    np.testing.assert_array_equal(rigid[0][:2], knee[:2])


def test_a_stretched_leg_has_right_and_finite_derivatives():
    def of_leg(values, target, blurred):
        rule = TwoBone(max_knee_angle=np.pi, allow_stretch=True, **values)
        return solved(rule, target[None], gate=Either(blurred > 0.5))[:3]

    reach = np.linalg.norm(BENT) + np.linalg.norm(BENT - [0.0, -0.775, 0.0])
    values = {"soften": 0.95, "max_stretch": 1.1}
    straight = {"soften": 1.0, "max_stretch": 1.0}
    for blurred in (0.0, 1.0):
        for share in (0.8, 1.0, 1.3):
            assert_gradients_match(of_leg, values, share * reach * WAY, blurred)
        for target in (reach * WAY, 0.0 * WAY, 1.05 * reach * WAY):
            finite_jacobian(of_leg, straight, target, blurred)
    rows = np.array([reach * WAY, 0.0 * WAY, 1.02 * reach * WAY])
    single = with_floats(LEG, np.dtype(np.float32))
    assert_finite_in_single_precision(lambda target: solved(single, target[None])[:3], rows)
