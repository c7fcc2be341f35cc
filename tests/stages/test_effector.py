"""Feet that follow their heights relative to the body, by hand."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxik import HARD
from jaxik.stages.effector import BodyEffector, BodyState
from jaxik.stages.inputs import SensedMoment
from jaxik.stages.pelvis import PelvisState
from jaxik.world.frame import Contact, Sensed
from jaxik.world.skeleton import Transform
from jaxik.world.terrain import Terrain
from support.fragments import fragment

UP = np.array([0.0, 1.0, 0.0])


@pytest.mark.parametrize(
    ("started", "fraction"), [(True, 0.25), (False, 1.0)], ids=["later", "first frame"]
)
def test_feet_cover_a_part_of_their_way_to_their_heights_over_the_body(started, fraction):
    """At 15 / s a quarter in 1/60 s; all of it in the first frame."""
    requested, goal, before = np.array([0.10, -0.05]), -0.05, np.array([0.02, 0.0])
    up, both = jnp.asarray(UP), jnp.ones(2)
    sensed = fragment(
        Sensed,
        ankle_ws=jnp.zeros((2, 3)),
        leg_up_ws=up,
        weight=both,
        contact=fragment(Contact, planted=both),
    )
    now = SensedMoment(
        jnp.asarray(1 / 60), jnp.asarray(started), HARD, sensed, fragment(Terrain, up_ws=up)
    )
    target = Transform(jnp.asarray(requested[:, None] * UP), jnp.eye(4)[jnp.zeros(2, int)])
    pelvis = fragment(PelvisState, goal=jnp.asarray(goal), offset_ws=jnp.asarray(-0.03 * UP))
    state, effector = BodyEffector(speed=15.0).advance(
        now, target, pelvis, BodyState(jnp.asarray(before), jnp.zeros(()))
    )
    height = before + fraction * (requested - goal - before)
    np.testing.assert_allclose(state.height, height, rtol=0, atol=1e-12)
    np.testing.assert_allclose(effector.target_ws[:, 1], height - 0.03, rtol=0, atol=1e-12)
