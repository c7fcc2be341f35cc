"""Structs, frozen trees for JAX; and rules: structs of parameters that know unit and range.

Trees of rules are read and changed by dotted name.
"""

import dataclasses
import pickle
from typing import Any
from xml.etree import ElementTree

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxik.maths import parameter_tree
from jaxik.maths.parameter_tree import (
    Leaf,
    Rule,
    angle,
    half_life,
    length,
    parameter,
    speed,
    threshold,
)
from jaxik.maths.struct import struct
from jaxik.world.skeleton import Transform

TRANSFORMS = Transform(jnp.zeros((4, 3)), jnp.ones((4, 4)))


@struct
class Named:
    inner: Any
    name: str = eqx.field(static=True)
    size: Any


def test_jax_flattens_a_struct_in_field_order_and_rebuilds_it():
    named = Named(TRANSFORMS, "left", jnp.ones(2))
    paths, structure = jax.tree_util.tree_flatten_with_path(named)
    leaves = {jax.tree_util.keystr(path): leaf.shape for path, leaf in paths}
    expected = {".inner.pos": (4, 3), ".inner.rot": (4, 4), ".size": (2,)}
    assert list(leaves.items()) == list(expected.items())
    rebuilt = jax.tree.unflatten(structure, jax.tree.leaves(named))
    assert isinstance(rebuilt, Named) and isinstance(rebuilt.inner, Transform)
    assert eqx.tree_equal(rebuilt, named)


def test_static_fields_belong_to_the_structure():
    left, right = (Named(jnp.ones(1), name, None) for name in ("left", "right"))
    assert len(jax.tree.leaves(left)) == 1
    assert jax.tree.structure(left) != jax.tree.structure(right)
    assert jax.jit(jax.vmap(lambda named: named))(right).name == "right"


def test_a_struct_is_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        Transform.identity().pos = jnp.ones(3)  # pyright: ignore[reportAttributeAccessIssue]
    replaced = dataclasses.replace(Transform.identity(), pos=jnp.ones(3))
    np.testing.assert_array_equal(replaced.pos, 1.0)


def test_a_struct_prints_shapes_and_can_be_pickled():
    assert "Transform(pos=f64[4,3]" in repr(TRANSFORMS)
    assert eqx.tree_equal(pickle.loads(pickle.dumps(TRANSFORMS)), TRANSFORMS)


# Rules.

HIGH = "Height above which the foot is lifted."


class Lift(Rule):
    height: Leaf = length(0.1, 0, 0.5, "Height of the foot.")
    top: Leaf = threshold((0.2, 0.3), 0, 1, HIGH, unit="m", above="height")
    half_life: Leaf = half_life(0.1, "Time in which half of the gap closes.")
    tick_hz: Leaf = parameter_tree.constant(30, "Ticks per second.", unit="Hz")
    early: Leaf = parameter_tree.switch(True, "Whether the foot is lifted early.")
    layers: Leaf = parameter_tree.layers()


class Walk(Rule):
    lift: Lift = eqx.field(default_factory=Lift)
    max_angle: Leaf = angle(0.5, 0, 3, "Largest angle.")
    speed: Leaf = speed(1.4, 0, 3, "Speed of the walk.")


def test_parameters_and_constants_become_floats_and_switches_booleans():
    lift = Lift()
    assert (lift.height.shape, lift.top.shape) == ((), (2,))
    assert lift.height.dtype == lift.top.dtype == lift.tick_hz.dtype == jnp.result_type(float)
    assert lift.early.dtype == bool and lift.early.shape == ()
    assert_allclose(lift.top, [0.2, 0.3])
    assert lift.layers.dtype == jnp.uint32
    assert len(jax.tree.leaves(lift)) == 6
    assert lift.height is not Lift().height, "rules share no defaults"


def test_what_a_user_gives_is_converted_and_arrays_stay_as_they_are():
    single = jnp.asarray(0.25, jnp.float32)
    lift = Lift(height=1, top=[1, 2], half_life=single, early=0)
    assert lift.height.dtype == lift.top.dtype == jnp.result_type(float)
    assert lift.half_life is single
    assert not lift.early


def test_a_rule_can_be_made_and_changed_with_traced_values():
    slope = jax.grad(lambda height: 3.0 * Lift(height=height).height)(0.2)
    assert slope == 3.0
    assert_allclose(jax.vmap(lambda x: Lift(height=x))(jnp.arange(4.0)).height, np.arange(4.0))
    assert not jax.jit(lambda early: Lift(early=early).early)(jnp.asarray(False))

    def height(x):
        return parameter_tree.replace(Walk(), {"lift.height": 2.0 * x}).lift.height

    assert jax.jit(jax.grad(height))(0.1) == 2.0


def test_declarations_list_the_parameters_in_order_and_nothing_else():
    declared = parameter_tree.declarations(Walk())
    lift = ["lift.height", "lift.top", "lift.half_life"]
    assert list(declared) == [*lift, "max_angle", "speed"]
    declaration = parameter_tree.Declaration
    assert declared["lift.height"] == declaration(
        "m", 0.0, 0.5, "smooth", "linear", None, "Height of the foot.", "leg length"
    )
    assert declared["lift.top"] == declaration(
        "m", 0.0, 1.0, "threshold", "linear", "height", HIGH, "leg length"
    )
    half_life = declared["lift.half_life"]
    assert (half_life.unit, half_life.scale) == ("s", "log")
    assert (half_life.low, half_life.high) == (0.002, 0.5)


def test_everything_declared_has_a_sentence_of_meaning():
    docs = parameter_tree.docs(Walk())
    assert docs["lift.height"] == "Height of the foot."
    assert docs["lift.early"] == "Whether the foot is lifted early."
    assert list(docs)[-3:] == ["lift.layers", "max_angle", "speed"] and len(docs) == 8
    with pytest.raises(TypeError, match="doc"):
        parameter(0.1, 0, 0.5, unit="m")  # pyright: ignore[reportCallIssue]
    # So that `help` lists them.
    described = "Attributes:\n    height: Height of the foot. Unit m. Range 0 to 0.5.\n"
    assert described in str(Lift.__doc__)


PRINTED = """\
Walk
  lift       Lift
    height     0.1 m
    top        [0.2, 0.3] m
    half_life  0.1 s
    tick_hz    30 Hz
    early      on
    layers     all
  max_angle  0.5 rad (28.65°)
  speed      1.4 m/s"""


def test_printing_a_tree_of_rules_shows_values_with_units_switches_and_layers():
    assert str(Walk()) == PRINTED
    lift = repr(Lift(height=jnp.inf, early=jnp.asarray([True, False]), layers=0b101)).splitlines()
    assert lift[:2] == ["Lift", "  height     inf m"]
    assert lift[-2:] == ["  early      [on, off]", "  layers     0x5"]


def test_a_notebook_shows_value_range_and_meaning_of_each_parameter():
    lift = Lift(height=0.25, early=False)
    rows = ElementTree.fromstring(lift._repr_html_()).findall("tr")
    cells = {row[0].text: [cell.text for cell in row[1:]] for row in rows}
    assert cells["Lift"] == ["value", "range", "meaning"]
    assert cells["height"] == ["0.25 m", "0 to 0.5", "Height of the foot."]
    assert cells["tick_hz"] == ["30 Hz", None, "Ticks per second."]
    assert cells["early"][0] == "off"
    walk = ElementTree.fromstring(Walk()._repr_html_())
    assert {"lift", "lift.height", "max_angle"} <= {row[0].text for row in walk}


def test_printing_a_batch_or_a_traced_rule_shows_shapes():
    batch = jax.tree.map(lambda x: jnp.broadcast_to(x, (1000, *x.shape)), Lift())
    assert f"  height     f{8 * batch.height.dtype.itemsize}[1000] m" in repr(batch)
    texts = []
    jax.jit(lambda lift: texts.extend([repr(lift), lift._repr_html_()]))(Lift())
    assert "  early      bool[]" in texts[0].splitlines()
    assert "bool[]" in texts[1] and "Whether the foot is lifted early." in texts[1]
    assert "None" in repr(eqx.filter(Lift(), eqx.is_inexact_array))


def test_replacing_leaves_changes_these_and_no_others():
    before = Walk()
    after = parameter_tree.replace(before, {"lift.height": 0.4, "speed": 2, "lift.early": False})
    assert (after.lift.height, after.speed, after.lift.early) == (0.4, 2.0, False)
    assert after.lift.half_life is before.lift.half_life and before.lift.height == 0.1
    assert parameter_tree.get(after, "lift.height") is after.lift.height
    assert parameter_tree.replace(before, {}) == before


def test_a_replaced_leaf_keeps_its_precision_and_may_become_one_a_leg():
    single = Walk(speed=jnp.asarray(1.0, jnp.float32))
    after = parameter_tree.replace(single, {"speed": [1.0, 2.0], "lift.height": jnp.float32(0.5)})
    assert after.speed.dtype == jnp.float32 and after.speed.shape == (2,)
    assert after.lift.height.dtype == jnp.float64


@pytest.mark.parametrize("name", ["lift.hight", "lft.height", "lift", "speed.height", ""])
def test_a_name_that_is_not_there_is_answered_with_those_that_are(name):
    with pytest.raises(ValueError, match="lift.height.*lift.top.*lift.half_life.*speed") as caught:
        parameter_tree.replace(Walk(), {name: 1.0})
    assert repr(name) in str(caught.value)
