"""Dynamically similar bodies: what follows from a unit, and motions that are exactly alike."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from fitting.datasets.clip_frames import frames_from_clip
from fitting.datasets.clips import edit, load_clip
from jaxik import presets
from jaxik.maths import parameter_tree
from jaxik.maths.parameter_tree import Leaf, Rule, constant, gain_parameter, parameter, switch
from jaxik.world import terrain
from jaxik.world.similarity import exponent, similar
from support.bodies import scaled

BASE = Path(__file__).resolve().parents[2] / "data" / "clips" / "uneven_walk_base.npz"
PRESETS = ["record", "ozz", "unreal", "mec", "stride"]
SIZE = 1.3


class Step(Rule):
    """A rule of a user's own."""

    height: Leaf = parameter((0.1, 0.2), unit="m", low=0.0, high=1.0, doc="How high it is.")
    pull: Leaf = parameter(8.0, unit="m/s²", low=0.0, high=20.0, doc="How hard it pulls.")
    gain: Leaf = gain_parameter(0.3, doc="How fast it follows.")
    free: Leaf = parameter(float("inf"), unit="m", low=0.0, high=1.0, doc="How far it may go.")
    tick_hz: Leaf = constant(30.0, unit="Hz", doc="Ticks per second.")
    on: Leaf = switch(True, doc="Whether it does anything.")


def test_the_power_of_the_ratio_follows_from_the_unit():
    powers = {
        "m": 1.0, "m/s": 0.5, "s": 0.5, "1/s": -0.5, "Hz": -0.5, "m/s²": 0.0, "m²": 2.0,
        "1/m": -1.0, "rad/s": -0.5, "rad": 0.0, "1": 0.0, "1/tick": 0.0,
    }  # fmt: skip
    assert {unit: exponent(unit) for unit in powers} == powers
    for unit in ("kg", "m/kg", "m s", ""):
        with pytest.raises(ValueError, match=r"is not made of \['m', 's', 'Hz'"):
            exponent(unit)


def test_every_number_of_every_preset_has_a_known_unit():
    for name in PRESETS:
        for slot in parameter_tree.slots(getattr(presets, name)()):
            exponent(slot.unit)


def test_numbers_change_by_their_units_and_nothing_else_does():
    larger = similar(Step(), 4.0)
    np.testing.assert_allclose(larger.height, [0.4, 0.8], rtol=1e-6)
    assert float(larger.tick_hz) == pytest.approx(15.0) and float(larger.gain) == Step().gain
    assert float(larger.pull) == 8.0 and np.isinf(larger.free) and bool(larger.on)
    back = similar(larger, jnp.asarray(0.25))
    np.testing.assert_allclose(back.height, Step().height, rtol=1e-6)
    slope = jax.jit(jax.grad(lambda r: jnp.sum(similar(Step(), r).height)))(jnp.asarray(1.0))
    assert float(slope) == pytest.approx(0.3, rel=1e-6)


@pytest.mark.parametrize(
    "name",
    ["ozz", *(pytest.param(name, marks=pytest.mark.slow) for name in PRESETS if name != "ozz")],
)
def test_two_bodies_of_equal_shape_move_alike(name):
    """The larger one 1.3 times as far in the root of 1.3 times the time."""
    heights = 0.04 * np.random.default_rng(0).normal(size=(40, 40))

    def solve(ik: jaxik.FootIK, size: float) -> jaxik.Result:
        clip = edit.trim(load_clip(BASE), 0.0, 1.5)
        body = scaled(clip, size, froude=True)
        ground = terrain.heightfield(size * heights, size * 0.25, origin=(-5.0 * size, 0.0, -size))
        return run(ik, body.rig, ground, frames_from_clip(body))

    run = jax.jit(jaxik.run)
    ik = getattr(presets, name)()
    small, large, unscaled = solve(ik, 1.0), solve(similar(ik, SIZE), SIZE), solve(ik, SIZE)

    def difference(result: jaxik.Result) -> float:  # m, of the small body
        legs = np.abs(result.pose.ankle.pos / SIZE - small.pose.ankle.pos).max()
        return float(max(legs, np.abs(result.body.pos / SIZE - small.body.pos).max()))

    # The probe of `stride` rounds distances of a micrometre, whatever the body.
    assert difference(large) < (1e-5 if name == "stride" else 1e-8)
    assert difference(unscaled) > 3e-3
    assert np.abs(small.body.pos).max() > 0.02, "there was something to do"
