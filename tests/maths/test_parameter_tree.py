"""Rules: parameters that know their unit and range, and trees of them by dotted name."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxik.maths import parameter_tree


class Lift(eqx.Module):
    height: jax.Array = parameter_tree.parameter(0.1, unit="m", low=0.0, high=0.5)
    top: jax.Array = parameter_tree.parameter(
        (0.2, 0.3), unit="m", low=0.0, high=1.0, kind="threshold", above="height"
    )
    gain: jax.Array = parameter_tree.parameter(0.5, unit="1/tick", low=0.0, high=1.0, scale="gain")
    tick_hz: jax.Array = parameter_tree.constant(30.0)
    early: jax.Array = parameter_tree.switch(True)


class Walk(eqx.Module):
    lift: Lift = eqx.field(default_factory=Lift)
    speed: jax.Array = parameter_tree.parameter(1.4, unit="m/s", low=0.0, high=3.0)


def test_parameters_and_constants_become_floats_and_switches_booleans():
    lift = Lift()
    assert (lift.height.shape, lift.top.shape) == ((), (2,))
    assert lift.height.dtype == lift.top.dtype == lift.tick_hz.dtype == jnp.result_type(float)
    assert lift.early.dtype == bool and lift.early.shape == ()
    assert_allclose(lift.top, [0.2, 0.3])
    assert len(jax.tree.leaves(lift)) == 5


def test_what_a_user_gives_is_converted_and_arrays_stay_as_they_are():
    single = jnp.asarray(0.25, jnp.float32)
    lift = Lift(height=1, top=[1, 2], gain=single, early=0)  # type: ignore[arg-type]
    assert lift.height.dtype == lift.top.dtype == jnp.result_type(float)
    assert lift.gain is single
    assert not lift.early


def test_a_rule_can_be_made_of_traced_values():
    slope = jax.grad(lambda height: 3.0 * Lift(height=height).height)(0.2)
    assert slope == 3.0
    assert_allclose(jax.vmap(lambda x: Lift(height=x))(jnp.arange(4.0)).height, np.arange(4.0))
    assert not jax.jit(lambda early: Lift(early=early).early)(jnp.asarray(False))


def test_two_rules_do_not_share_their_defaults():
    assert Lift().height is not Lift().height


def test_declarations_are_found_by_dotted_name_in_order_and_nothing_else_is():
    found = parameter_tree.declarations(Walk())
    assert list(found) == ["lift.height", "lift.top", "lift.gain", "speed"]
    assert found["lift.height"] == parameter_tree.Declaration(
        "m", 0.0, 0.5, "smooth", "linear", None
    )
    assert found["lift.top"] == parameter_tree.Declaration(
        "m", 0.0, 1.0, "threshold", "linear", "height"
    )
    assert found["lift.gain"].scale == "gain"


def test_leaves_are_got_by_dotted_name():
    walk = Walk(lift=Lift(height=0.3))  # type: ignore[arg-type]
    assert parameter_tree.get(walk, "lift.height") is walk.lift.height
    assert parameter_tree.get(walk, "speed") is walk.speed


def test_replacing_leaves_changes_these_and_no_others():
    before = Walk()
    after = parameter_tree.replace(before, {"lift.height": 0.4, "speed": 2, "lift.early": False})
    assert (after.lift.height, after.speed, after.lift.early) == (0.4, 2.0, False)
    assert after.lift.gain is before.lift.gain and before.lift.height == 0.1
    assert parameter_tree.replace(before, {}) == before


def test_a_replaced_leaf_keeps_its_precision_and_may_become_one_a_leg():
    single = Walk(speed=jnp.asarray(1.0, jnp.float32))
    after = parameter_tree.replace(
        single, {"speed": np.array([1.0, 2.0]), "lift.height": jnp.float32(0.5)}
    )
    assert after.speed.dtype == jnp.float32 and after.speed.shape == (2,)
    assert after.lift.height.dtype == jnp.float64


def test_leaves_are_replaced_inside_jit_and_slopes_pass_through():
    def height(x):
        return parameter_tree.replace(Walk(), {"lift.height": 2.0 * x}).lift.height

    assert jax.jit(jax.grad(height))(0.1) == 2.0


@pytest.mark.parametrize("name", ["lift.hight", "lft.height", "lift", "speed.height", ""])
def test_a_name_that_is_not_there_is_answered_with_those_that_are(name):
    with pytest.raises(ValueError, match="lift.height.*lift.top.*lift.gain.*speed") as caught:
        parameter_tree.replace(Walk(), {name: 1.0})
    assert repr(name) in str(caught.value)
