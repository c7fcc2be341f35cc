"""Places that platforms carry from one frame to the next."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxik.world.frame import rise_of
from jaxik.world.skeleton import Still, Transform

UP = np.array([0.0, 1.0, 0.0])
BEFORE = np.array([[0.3, 0.1, -0.2], [-0.4, 0.2, 0.5]])


@pytest.mark.parametrize("angles", [[0, 0, 0], [20, -30, 15]], ids=["level", "turning"])
def test_a_place_rises_as_the_platform_that_carries_it(angles):
    turn, shift = Rotation.from_euler("xyz", angles, degrees=True), np.array([0.2, 0.35, -0.1])
    after = turn.apply(BEFORE) + shift
    carry = Transform(jnp.asarray(shift), jnp.asarray(turn.as_quat(scalar_first=True)))
    rise = rise_of(carry.repeat(2), jnp.asarray(after), jnp.asarray(UP))
    np.testing.assert_allclose(rise, (after - BEFORE)[:, 1], rtol=0, atol=1e-12)


def test_no_place_rises_where_the_ground_stands_still():
    np.testing.assert_array_equal(rise_of(Still(), jnp.asarray(BEFORE), jnp.asarray(UP)), 0.0)
