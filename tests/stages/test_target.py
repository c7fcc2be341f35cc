"""How far the smoothing of a foothold's height moves it, by hand."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxik import HARD
from jaxik.stages.inputs import SensedMoment
from jaxik.stages.target import SlopeTarget, TargetState
from jaxik.world.frame import Foothold, GroundHits, Sensed
from jaxik.world.skeleton import Still
from jaxik.world.terrain import Hit, Terrain
from support.cases import QUICK
from support.fragments import fragment

DT, UP = 1 / 60, np.array([0.0, 1.0, 0.0])
BEFORE, NOW = [0.0, 0.3], [0.2, 0.1]  # m, heights of two footholds


def moved(rule: SlopeTarget, started: bool) -> np.ndarray:
    """How far the rule moves the two footholds along up, m, with ankles 0.1 m above them."""
    up, places = jnp.asarray(UP), jnp.zeros((2, 3))
    foothold = fragment(
        Foothold,
        point_ws=places,
        height=jnp.array(NOW),
        ankle_height_ms=jnp.full(2, 0.1),
        climb=jnp.ones(2),
    )
    ground = fragment(GroundHits, ankle=fragment(Hit, normal=jnp.broadcast_to(up, (2, 3))))
    sensed = fragment(Sensed, foothold=foothold, ground=ground, leg_up_ws=up, carry=Still())
    terrain = fragment(Terrain, up_ws=up)
    now = SensedMoment(jnp.asarray(DT), jnp.asarray(started), HARD, sensed, terrain)
    state = TargetState(jnp.array(BEFORE), jnp.zeros(2), places)

    def advance(rule: SlopeTarget) -> jax.Array:
        return rule.advance(now, state)[1]

    return np.asarray(jax.jit(advance, compiler_options=QUICK)(rule))


def test_a_foothold_covers_half_its_way_in_a_half_life_up_and_down():
    halves = moved(SlopeTarget(rise_half_life=DT, fall_half_life=DT), started=True)
    np.testing.assert_allclose(halves, [-0.1, 0.1], rtol=0, atol=1e-12)
    slower = moved(SlopeTarget(rise_half_life=DT, fall_half_life=DT / 2), started=True)
    np.testing.assert_allclose(slower, [-0.1, 0.05], rtol=0, atol=1e-12)


def test_a_foothold_is_where_the_ground_is_in_the_first_frame():
    slow = SlopeTarget(rise_half_life=0.5, fall_half_life=0.5)
    np.testing.assert_allclose(moved(slow, started=False), 0.0, rtol=0, atol=1e-12)
