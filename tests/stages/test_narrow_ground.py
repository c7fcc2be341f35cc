"""Ground narrower than a sole: refused by every probe that is asked to, gradually."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_limits import FRAME, PROBES, UP_START, bumps, ground_under, level, quad, system

import jaxik
from jaxik import HARD
from jaxik.maths import parameter_tree
from jaxik.stages.inputs import Inputs
from jaxik.stages.probe import foot_heading
from jaxik.stages.probe.limits import AbstractLimitedProbe
from jaxik.world.terrain import ALL_LAYERS
from reference import maths
from reference.characters import Parameters
from reference.stages import limits
from reference.terrain import Terrain as PlainTerrain
from support.cases import RIG
from support.clips import to_frames, to_rig, to_terrain

VALUES = {"max_step_up": 0.3, "max_step_down": 0.4, "max_slope": 0.7}


def checked(preset: str, **values: Any) -> jaxik.FootIK:
    """The preset with these limits, which refuses narrow ground."""
    ik = system(preset, **(VALUES | values))
    return parameter_tree.with_option(ik, "probe.check_support", True)


def inputs_of(ground: Any) -> Inputs:
    frame = jax.tree.map(lambda x: x[0], to_frames([FRAME]))
    return Inputs(to_rig(RIG), ground, frame, HARD)


@jax.jit
def accepted_ground(ik: jaxik.FootIK, ground: Any, starts_ws: Any) -> Any:
    """Accepted ground below the starts (rays, legs, 3), of a character that stands still."""
    assert isinstance(ik.probe, AbstractLimitedProbe)
    layers = jnp.asarray(ALL_LAYERS, jnp.uint32)
    hit = ik.probe.cast(inputs_of(ground), starts_ws, jnp.asarray(2.4), layers)
    return hit.found, hit.point, hit.normal


def box(height: float, half_left: float, half_ahead: float, over: np.ndarray) -> PlainTerrain:
    """A plate of this size around each point, over a floor half a metre lower."""
    plates = []
    for x, _, z in over:
        corners = ((-1, -1), (1, -1), (1, 1), (-1, 1))
        plates += quad(*((x + a * half_left, height, z + b * half_ahead) for a, b in corners))
    floor = level(height - 0.5, near=-3.0, far=3.0).triangles
    return PlainTerrain(maths.Y, triangles=np.concatenate([np.array(plates), floor]))


def found_on(ik: jaxik.FootIK, ground: PlainTerrain, at: np.ndarray) -> np.ndarray:
    """How far the ground below each point is accepted, for the left leg."""
    starts = np.repeat((at + [0, UP_START, 0])[:, None], 2, axis=1)
    return np.asarray(accepted_ground(ik, to_terrain(ground), jnp.asarray(starts))[0])[:, 0]


# The decision.


def test_it_agrees_with_the_reference():
    ground, rng = bumps(), np.random.default_rng(0)
    starts = rng.uniform(-1.6, 1.6, (600, 2, 3)) * [1, 0, 1] + [0, UP_START, 0]
    per_leg = {"min_support": [0.9, 0.7], "support_radius": [0.1, 0.06]}
    found, point, normal = map(
        np.asarray,
        accepted_ground(checked("FootProbe", **per_leg), to_terrain(ground), jnp.asarray(starts)),
    )
    values = {f"probe.{name}": np.asarray(value) for name, value in (VALUES | per_leg).items()}
    parameters = Parameters(values, {name: 0.0 for name in values})
    inputs = inputs_of(to_terrain(ground))
    ahead = np.asarray(foot_heading(inputs, inputs.terrain.leg_up_ws)[0])
    expected = [
        [
            limits.read(parameters, ground, leg, np.zeros(3), start, 2.4, ahead=ahead[leg])
            for leg, start in enumerate(row)
        ]
        for row in starts
    ]
    accepted = np.array([[reading.found for reading in row] for row in expected])
    np.testing.assert_allclose(found, accepted, rtol=0, atol=1e-9)
    assert ((accepted > 0.05) & (accepted < 0.95)).sum() > 30
    counts = accepted > 0
    for ours, name in ((point, "point"), (normal, "normal")):
        theirs = np.array([[getattr(reading, name) for reading in row] for row in expected])
        np.testing.assert_allclose(ours[counts], theirs[counts], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("half_left", "half_ahead", "accepted"),
    [(0.02, 0.02, 0), (0.02, 1.0, 0), (1.0, 0.02, 0), (0.06, 1.0, 1), (1.0, 1.0, 1)],
    ids=["post", "beam", "beam across", "plank", "floor"],
)
def test_ground_narrower_than_the_sole_is_refused(half_left, half_ahead, accepted):
    at = np.zeros((1, 3))
    ground = box(0.0, half_left, half_ahead, at)
    assert found_on(checked("FootProbe"), ground, at)[0] == accepted
    assert found_on(system("FootProbe", **VALUES), ground, at)[0] == 1


def test_a_foot_may_stand_on_an_edge_and_beside_a_wall():
    at = np.array([[0.0, 0.0, z] for z in (-0.199, -0.1, 0.0, 0.1, 0.199)])
    edge = box(0.0, 1.0, 0.2, np.zeros((1, 3)))
    assert (found_on(checked("FootProbe"), edge, at) == 1).all()
    wall = level(0.9, near=0.2, far=2.0).triangles
    beside = PlainTerrain(maths.Y, triangles=np.concatenate([level(0.0).triangles, wall]))
    assert (found_on(checked("FootProbe"), beside, at) == 1).all()


def test_a_slope_supports_all_of_the_sole():
    steep = np.array(quad((-2, -1, -2), (2, -1, -2), (2, 1, 2), (-2, 1, 2)))
    found = found_on(checked("FootProbe"), PlainTerrain(maths.Y, triangles=steep), np.zeros((1, 3)))
    assert found[0] == 1


def test_ground_fades_out_as_it_becomes_narrower():
    widths = np.linspace(0.005, 0.06, 111)
    at = np.stack([np.arange(111) * 0.5 - 30.0, 0 * widths, 0 * widths], -1)
    plates = [box(0.0, half, 1.0, at[i : i + 1]).triangles[:2] for i, half in enumerate(widths)]
    ground = PlainTerrain(maths.Y, triangles=np.concatenate(plates))
    found = found_on(checked("FootProbe", max_step_up=9.0), ground, at)
    assert found[0] == 0 and found[-1] == 1 and (np.diff(found) >= 0).all()


def test_gradients_are_finite_and_reach_both_parameters():
    ik, ground = checked("FootProbe", min_support=0.8, support_radius=0.1), to_terrain(bumps())
    starts = np.random.default_rng(2).uniform(-1.6, 1.6, (200, 2, 3)) * [1, 0, 1]
    floats, rest = eqx.partition(ik.probe, eqx.is_inexact_array)

    def total(floats: Any, starts: Any) -> jax.Array:
        probe = eqx.combine(floats, rest)
        found, point, normal = accepted_ground(dataclasses.replace(ik, probe=probe), ground, starts)
        return found.sum() + point[..., 1].sum() + normal.sum()

    gradient = jax.jit(jax.grad(total, (0, 1)))
    by_limit, by_start = gradient(floats, jnp.asarray(starts + [0, UP_START, 0]))
    slopes = [np.asarray(getattr(by_limit, name)) for name in ("min_support", "support_radius")]
    assert np.isfinite(slopes).all() and np.abs(slopes).min() > 0
    assert np.isfinite(by_start).all()


# What the probes do with it.


@pytest.mark.parametrize("preset", PROBES)
def test_no_foot_stands_on_a_post_but_on_the_floor_below(preset):
    frames = to_frames([FRAME])
    floor = level(-0.02, near=-3.0, far=3.0)
    feet = np.asarray(ground_under(system(preset), to_terrain(floor), frames).ankle.point)[0]
    balls = np.asarray(frames.world_from_model.apply(frames.pose.toe.pos[0]))
    posts = box(0.2, 0.02, 0.02, np.concatenate([feet, balls])).triangles[:-2]
    ground = PlainTerrain(maths.Y, triangles=np.concatenate([posts, floor.triangles]))
    on_posts = ground_under(system(preset), to_terrain(ground), frames).ankle
    assert np.asarray(on_posts.point)[0, :, 1].max() > 0.1, "feet would stand there"
    hits = ground_under(checked(preset), to_terrain(ground), frames).ankle
    low = np.asarray(hits.found)[0] * (np.asarray(hits.point)[0, :, 1] + 0.02)
    np.testing.assert_allclose(low, 0.0, rtol=0, atol=1e-9)
