"""Systems whose numbers follow a body: lengths, speeds, times, and heights over the sole."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from jaxik import presets
from jaxik.maths import parameter_tree
from jaxik.maths.parameter_tree import Leaf, Rule, half_life_parameter, parameter
from jaxik.pipeline.shapes import check_system
from jaxik.stages.contact import HeightContact, SpeedContact
from jaxik.world import body
from support.clips import make_rig, to_rig

PRESETS = ["record", "ozz", "unreal", "mec", "stride"]


class Kick(Rule):
    """A rule of a user's own."""

    reach: Leaf = parameter((0.1, 0.2), unit="m", low=0.0, high=1.0, doc="How far it goes.")
    speed: Leaf = parameter(1.0, unit="m/s", low=0.0, high=4.0, doc="How fast it is.")
    pause: Leaf = parameter(1.0, unit="s", low=0.0, high=4.0, follows="time", doc="How long.")
    height: Leaf = parameter(
        0.115, unit="m", low=0.0, high=0.4, follows="over ankle height", doc="How high it is."
    )
    free: Leaf = parameter(float("inf"), unit="m", low=0.0, high=1.0, doc="How far it may go.")
    angle: Leaf = parameter(1.0, unit="rad", low=0.0, high=2.0, doc="How far it turns.")
    half_life: Leaf = half_life_parameter(0.1, doc="How smooth it is.")


def make_body(
    leg: Any = body.LEG, ankle: Any = body.ANKLE, ball: Any = body.BALL, foot: Any = None
) -> jaxik.Rig:
    """A rig with legs, ankles and balls of these lengths and heights, m; feet as long as legs."""
    rig = to_rig(make_rig())
    lengths = {"thigh": 0.5 * leg, "shin": 0.5 * leg, "ankle_height": ankle, "ball_height": ball}
    lengths["foot"] = body.FOOT * leg / body.LEG if foot is None else foot
    return dataclasses.replace(rig, **{k: v * jnp.ones(2) for k, v in lengths.items()})


def number(system: eqx.Module, name: str) -> jax.Array:
    return parameter_tree.get(system, name)


def values(system: eqx.Module) -> dict[str, np.ndarray]:
    return {name: np.asarray(number(system, name)) for name in parameter_tree.declarations(system)}


def ray_up(system: eqx.Module) -> jax.Array:
    return number(system, "probe.ray_up")


def test_numbers_of_any_rule_follow_what_they_declare():
    scaled = body.scale(Kick(), make_body(4 * body.LEG, 0.3))
    np.testing.assert_allclose(scaled.reach, [0.4, 0.8], rtol=1e-6)
    assert float(scaled.speed) == pytest.approx(2.0) and float(scaled.pause) == pytest.approx(2.0)
    assert float(scaled.height) == pytest.approx(0.3 + 4 * 0.03)
    assert np.isinf(scaled.free)
    assert float(scaled.angle) == 1.0 and float(scaled.half_life) == pytest.approx(0.1)


@pytest.mark.parametrize("name", PRESETS)
def test_the_adult_differs_from_a_preset_only_in_the_height_of_its_own_ankle(name):
    adult, preset = values(getattr(presets, name)(make_body())), values(getattr(presets, name)())
    for parameter_name, value in preset.items():
        expected = body.ANKLE if parameter_name == "target.foot_height" else value
        np.testing.assert_allclose(adult[parameter_name], expected, rtol=1e-6, atol=1e-7)


def test_heights_of_soles_are_those_of_the_rig():
    rig = make_body(2.1, 0.31, 0.12)
    for name in ("record", "ozz", "mec", "stride"):
        ik = getattr(presets, name)(rig)
        assert float(number(ik, "target.foot_height")) == pytest.approx(0.31)
    assert float(number(presets.stride(rig), "probe.ball_height")) == pytest.approx(0.12)
    contact = body.scale(SpeedContact(), rig)
    assert float(contact.planted_height) == pytest.approx(0.12 + 2.5 * 0.02)


def test_heights_over_a_flat_foot_follow_its_length_within_twice_that_of_the_leg():
    for foot, ratio in ((0.18, 1.5), (0.06, 0.5), (0.5, 2.0), (0.0, 0.5)):
        rig = make_body(body.LEG, 0.1, 0.06, foot)
        planted = body.scale(HeightContact(), rig).planted_height
        assert float(planted) == pytest.approx(0.1 + ratio * 0.015)
        assert float(ray_up(presets.record(rig))) == pytest.approx(0.5)


def test_legs_share_a_number_unless_they_differ_noticeably_and_may_have_their_own():
    alike = presets.mec(make_body(jnp.array([0.80, 0.82])))
    assert ray_up(alike).shape == number(alike, "pelvis.max_length").shape == ()
    legs = np.array([0.8, 0.4])
    unlike = presets.mec(make_body(jnp.asarray(legs)))
    np.testing.assert_allclose(ray_up(unlike), legs * 0.5 / 0.84, rtol=1e-6)
    np.testing.assert_allclose(number(unlike, "pelvis.max_length"), legs * 0.88 / 0.84)
    assert number(unlike, "root.ray_up").shape == ()  # of the whole body
    toe = number(presets.record(make_body(jnp.asarray(legs))), "probe.toe_ls")
    np.testing.assert_allclose(toe[0], 2.0 * toe[1], rtol=1e-6)
    for name in PRESETS:
        check_system(getattr(presets, name)(make_body(jnp.asarray(legs))), make_body())


def test_values_per_leg_stay_so_and_legs_that_are_absent_or_without_length_do_not_count():
    ik = parameter_tree.replace(presets.record(), {"probe.ray_up": [0.5, 0.6]})
    scaled = body.scale(ik, make_body(2 * body.LEG))
    np.testing.assert_allclose(ray_up(scaled), [1.0, 1.2], rtol=1e-6)
    for rig in (
        dataclasses.replace(make_body(jnp.array([1.68, 9.0])), present=jnp.array([True, False])),
        make_body(jnp.array([1.68, 0.0])),
    ):
        assert float(ray_up(presets.record(rig))) == pytest.approx(1.0)
        assert body.ratio(rig) == pytest.approx(2.0)
    assert body.ratio(make_body(0.0)) == 1.0
    rig = to_rig(make_rig(legs=3))
    lengths, present = jnp.array([1.0, 3.0, 9.0]) * body.LEG, jnp.array([True, True, False])
    rig = dataclasses.replace(rig, thigh=0.5 * lengths, shin=0.5 * lengths, present=present)
    assert body.ratio(rig) == pytest.approx(2.0)


@pytest.mark.parametrize("name", PRESETS)
def test_ranges_of_a_fit_follow_the_body_and_contain_its_values(name):
    adult = getattr(presets, name)()
    of_adult, before = values(adult), parameter_tree.declarations(adult)
    for rig in (make_body(2.1, 0.25, 0.14), make_body(0.46, 0.04, 0.02), make_body(0.84, 0.3)):
        ik = getattr(presets, name)(rig)
        ranges = body.scaled_declarations(ik, rig)
        for parameter_name, value in values(ik).items():
            (low, high), (adult_low, adult_high) = (
                (declared[parameter_name].low, declared[parameter_name].high)
                for declared in (ranges, before)
            )
            assert low < high
            inside = (adult_low <= of_adult[parameter_name]).all()
            if inside and (of_adult[parameter_name] <= adult_high).all():
                assert (low <= value).all() and (value <= high).all(), parameter_name


def test_ranges_of_any_rule_follow_what_it_declares():
    declared = body.scaled_declarations(Kick(), make_body(4 * body.LEG, 0.3))
    assert (declared["speed"].high, declared["angle"].high) == (8.0, 2.0)
    assert body.scaled_declarations(Kick(), None)["speed"].high == 4.0


def test_a_batch_of_bodies_has_the_numbers_of_each_alone():
    legs = jnp.array([[0.84, 0.84], [2.1, 2.1], [0.46, 0.8]])
    bodies = [make_body(leg) for leg in legs]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *bodies)

    def height(rig: jaxik.Rig) -> jax.Array:
        return ray_up(presets.record(rig))

    expected = [jnp.broadcast_to(height(rig), 2) for rig in bodies]
    for batched in (jax.jit(jax.vmap(height)), jax.jit(jaxik.lanes(height))):
        np.testing.assert_allclose(batched(batch), expected, rtol=1e-6)

    def ray_down(leg: jax.Array) -> jax.Array:
        return number(presets.ozz(make_body(leg)), "probe.ray_down")

    slopes = jax.jit(jax.jacobian(ray_down))(jnp.ones(2))
    assert np.isfinite(slopes).all()  # the ray is endless
