"""Ground that is too high, too low or too steep: refused gradually, the same by every probe."""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from jaxik import HARD
from jaxik.maths import parameter_tree
from jaxik.stages.inputs import Inputs
from jaxik.stages.probe.limits import AbstractLimitedProbe
from jaxik.world.frame import GroundHits
from jaxik.world.terrain import ALL_LAYERS
from reference import maths
from reference.characters import Parameters
from reference.maths import Array
from reference.stages import limits
from reference.terrain import Terrain as PlainTerrain
from support.cases import QUICK, RIG
from support.clips import animate, planes, to_frames, to_rig, to_terrain

LIMITS = {"max_step_up": 0.3, "max_step_down": 0.25, "max_slope": 0.7}
PROBES = {
    "FootProbe": jaxik.presets.ozz,
    "RootProbe": jaxik.presets.unreal,
    "CornerProbe": jaxik.presets.mec,
    "StrideProbe": jaxik.presets.stride,
}
FRAME = animate(RIG, count=1)[0]
UP_START = 1.2  # m above the root, where rays start


def system(preset: str, **values: Any) -> jaxik.FootIK:
    """The preset with these limits."""
    named = {f"probe.{name}": value for name, value in (LIMITS | values).items()}
    return parameter_tree.replace(PROBES[preset](), named)


@functools.partial(jax.jit, compiler_options=QUICK)
def ground_under(ik: jaxik.FootIK, ground: Any, frames: jaxik.Frame) -> GroundHits:
    """What the probe finds in each frame."""

    def sense(frame: jaxik.Frame) -> GroundHits:
        inputs = Inputs(to_rig(RIG), ground, frame, HARD)
        contact = ik.contact.sense(inputs)
        return ik.probe.sense(inputs, contact, ik.target.foot_height)

    return jax.vmap(sense)(frames)


def accepted_ground(ik: jaxik.FootIK, ground: Any, starts_ws: Array) -> Any:
    """Accepted ground below the starts (rays, legs, 3), of a character that stands still."""
    frame = jax.tree.map(lambda x: x[0], to_frames([FRAME]))
    inputs = Inputs(to_rig(RIG), ground, frame, HARD)
    assert isinstance(ik.probe, AbstractLimitedProbe)
    starts, layers = jnp.asarray(starts_ws), jnp.asarray(ALL_LAYERS, jnp.uint32)
    hit = ik.probe.cast(inputs, starts, jnp.asarray(2.4), layers)
    return hit.found, hit.point, hit.normal


read = jax.jit(accepted_ground, compiler_options=QUICK)


def quad(*corners: tuple[float, float, float]) -> list:
    """Two triangles over four corners in turn."""
    a, b, c, d = ([*corner] for corner in corners)
    return [[a, b, c], [a, c, d]]


def level(height: float, near: float = -0.5, far: float = 0.8) -> PlainTerrain:
    """A level plate over the origin."""
    corners = ((-1, near), (1, near), (1, far), (-1, far))
    plate = quad(*((x, height, z) for x, z in corners))
    return PlainTerrain(maths.Y, triangles=np.array(plate))


def bumps() -> PlainTerrain:
    """Rough ground, much of it too steep or too high, over a tilted floor with a hole."""
    rng = np.random.default_rng(3)
    line = np.linspace(-1.5, 1.5, 9)
    heights = rng.uniform(-0.5, 0.7, (9, 9)) * (rng.random((9, 9)) < 0.6)
    rough = []
    for i in range(8):
        for j in range(8):
            corners = ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1))
            rough += quad(*((line[a], heights[a, b], line[b]) for a, b in corners))
    floor = [(-1.5, -0.3, -1.5), (0.5, -0.3, -1.5), (0.5, 0.05, 1.5), (-1.5, 0.05, 1.5)]
    return PlainTerrain(maths.Y, triangles=np.array(rough + quad(*floor)))


# The decision.


def test_it_agrees_with_the_reference():
    ground, rng = bumps(), np.random.default_rng(0)
    starts = rng.uniform(-1.6, 1.6, (600, 2, 3)) * [1, 0, 1] + [0, UP_START, 0]
    per_leg = {"max_step_up": [0.3, 0.2], "max_slope": [0.6, 0.9]}
    ik = system("FootProbe", **per_leg)
    found, point, normal = map(np.asarray, read(ik, to_terrain(ground), starts))
    values = {f"probe.{name}": np.asarray(value) for name, value in (LIMITS | per_leg).items()}
    defaults = {f"probe.{name}": 0.0 for name in LIMITS}
    parameters = Parameters(values, defaults)
    expected = [
        [
            limits.read(parameters, ground, leg, np.zeros(3), start, 2.4)
            for leg, start in enumerate(row)
        ]
        for row in starts
    ]
    accepted = np.array([[reading.found for reading in row] for row in expected])
    np.testing.assert_allclose(found, accepted, rtol=0, atol=1e-9)
    assert ((accepted > 0.05) & (accepted < 0.95)).sum() > 30
    assert (accepted == 0).sum() > 100 and (accepted == 1).sum() > 100
    counts = accepted > 0
    for ours, name in ((point, "point"), (normal, "normal")):
        theirs = np.array([[getattr(reading, name) for reading in row] for row in expected])
        np.testing.assert_allclose(ours[counts], theirs[counts], rtol=0, atol=1e-9)


def test_a_slope_is_no_step_however_far_it_goes():
    starts = np.array([[[0.0, 2.0, z]] * 2 for z in (-0.5, 0.5, 2.0)])
    slope = to_terrain(planes((0.5, 0, 0)))
    found, _, _ = read(system("FootProbe", max_slope=0.6), slope, starts)
    assert (np.asarray(found) == 1).all()


def test_a_ray_from_no_higher_than_a_step_looks_no_further_than_its_first_ground():
    """Only a ray from further up may have met a table."""
    steep = quad((-1, -1.6, -1), (1, -1.6, -1), (1, 1.6, 1), (-1, 1.6, 1))
    floor = quad((-1, -0.9, -1), (1, -0.9, -1), (1, -0.9, 1), (-1, -0.9, 1))
    ground = to_terrain(PlainTerrain(maths.Y, triangles=np.array(steep + floor)))
    starts = np.array([[[0.0, height, 0.0]] * 2 for height in (0.05, 0.2, 0.5)])
    found, point, _ = read(system("FootProbe", max_step_down=2.0), ground, starts)
    np.testing.assert_array_equal(found, 0.0)
    np.testing.assert_allclose(point, 0.0, rtol=0, atol=1e-12)


def test_infinite_limits_refuse_nothing():
    rng = np.random.default_rng(1)
    starts = rng.uniform(-1.4, 1.4, (100, 2, 3)) * [1, 0, 1] + [0, UP_START, 0]
    wide = system("FootProbe", **dict.fromkeys(LIMITS, np.inf))
    never = dataclasses.replace(wide, probe=dataclasses.replace(wide.probe, limited=False))
    ground = to_terrain(bumps())
    for ours, theirs in zip(*(read(ik, ground, starts) for ik in (wide, never)), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12)


def test_gradients_are_finite_where_ground_is_accepted_in_part_or_not_at_all():
    ik, ground = system("FootProbe", max_step_down=0.1), to_terrain(bumps())
    starts = np.random.default_rng(2).uniform(-1.6, 1.6, (200, 2, 3)) * [1, 0, 1]
    starts = starts + [0, UP_START, 0]

    floats, rest = eqx.partition(ik.probe, eqx.is_inexact_array)

    def total(floats: Any, starts: Any) -> jax.Array:
        probe = eqx.combine(floats, rest)
        found, point, normal = accepted_ground(dataclasses.replace(ik, probe=probe), ground, starts)
        return found.sum() + point[..., 1].sum() + normal.sum()

    gradient = jax.jit(jax.grad(total, (0, 1)), compiler_options=QUICK)
    by_limit, by_start = gradient(floats, jnp.asarray(starts))
    slopes = [np.asarray(getattr(by_limit, name)) for name in LIMITS]
    assert np.isfinite(slopes).all() and np.abs(slopes).min() > 0
    assert np.isfinite(by_start).all()


# What the probes do with it.


@pytest.mark.parametrize("preset", PROBES)
def test_a_foot_stands_on_the_floor_under_a_table(preset):
    table, floor = level(0.5), level(-0.02)
    ground = PlainTerrain(maths.Y, triangles=np.concatenate([table.triangles, floor.triangles]))
    hits = ground_under(system(preset), to_terrain(ground), to_frames([FRAME]))
    np.testing.assert_allclose(hits.ankle.point[0, :, 1], -0.02, rtol=0, atol=1e-12)
    assert (np.asarray(hits.ankle.found) == 1).all()


@pytest.mark.parametrize("preset", PROBES)
@pytest.mark.parametrize("height", [0.41, -0.36], ids=["up", "down"])
def test_a_foot_stays_as_animated_where_nothing_is_accepted(preset, height):
    ground = np.concatenate([level(height).triangles] * 2)
    frames = to_frames([FRAME])
    ik = system(preset)
    hits = ground_under(ik, to_terrain(PlainTerrain(maths.Y, triangles=ground)), frames)
    assert (np.asarray(hits.ankle.found) == 0).all()


@pytest.mark.parametrize("preset", PROBES)
def test_a_step_fades_out_as_it_becomes_too_high(preset):
    """The foothold leaves the ground without a jump, and is the animated one in the end."""
    frames = to_frames([FRAME])
    heights = np.linspace(0.25, 0.45, 41)
    grounds = [to_terrain(level(height)) for height in heights]
    ik = system(preset)
    hits = [ground_under(ik, ground, frames).ankle for ground in grounds]
    found = np.array([hit.found[0, 0] for hit in hits])
    assert (found[heights <= 0.3] == 1).all() and (found[heights > 0.4] == 0).all()
    assert np.abs(np.diff(found)).max() < 1.5 * 0.005 / 0.1 + 1e-9


def test_a_toe_on_half_accepted_ground_is_between_it_and_the_level_of_the_foot():
    """The rule of Mec looks for its toe from where it puts the sole."""
    height, ik = 0.33, system("CornerProbe")
    frame = jax.tree.map(lambda x: x[:1], to_frames([FRAME]))
    ground = jax.tree.map(lambda x: x[0], ground_under(ik, to_terrain(level(height)), frame))
    found, foot_height = np.asarray(ground.ankle.found), float(ik.target.foot_height)
    assert ((found > 0.05) & (found < 0.95)).all()
    foot = np.asarray(frame.pose.ankle.pos[0, :, 1] + frame.world_from_model.pos[0, 1])
    sole = (1 - found) * (foot - foot_height) + found * height
    weight = np.asarray(ground.toe.found)
    np.testing.assert_allclose(weight, found**2, rtol=1e-6)
    np.testing.assert_allclose(
        ground.toe.point[:, 1], (1 - weight) * sole + weight * height, rtol=1e-9
    )
