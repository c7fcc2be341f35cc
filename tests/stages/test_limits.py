"""Ground too high, too low, too steep or too narrow: refused gradually, the same by every probe.

The probe that is as wide as a foot also finds no ground in narrow cracks.
"""

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
from jaxik.maths.parameter_tree import with_option
from jaxik.stages.inputs import Inputs
from jaxik.stages.probe import AbstractLimitedProbe, foot_heading
from jaxik.world.frame import GroundHits
from jaxik.world.terrain import ALL_LAYERS
from reference import maths
from reference.characters import Footing, Parameters
from reference.stages import limits
from reference.terrain import Terrain as PlainTerrain
from support.cases import RIG
from support.clips import animate, at, to_frames, to_rig, to_terrain
from support.probing import BLOCKS, ground_under, level_blocks, quad

LIMITS = {"max_step_up": 0.3, "max_step_down": 0.25, "max_slope": 0.7}
WIDTHS = {"min_support": 0.5, "support_radius": 0.04}
PROBES = {
    "FootProbe": jaxik.presets.ozz,
    "RootProbe": jaxik.presets.unreal,
    "CornerProbe": jaxik.presets.mec,
    "StrideProbe": lambda: with_option(jaxik.presets.stride(), "probe.slide_to_support", False),
}
FIRST = ["FootProbe", *(pytest.param(x, marks=pytest.mark.slow) for x in list(PROBES)[1:])]
FRAME = animate(RIG, count=1)[0]
FLOOR = (-3.0, 3.0, -0.02)  # a level block
UP_START = 1.2  # m above the root, where rays start
STEP = 0.005  # m, between heights
UP, DOWN = np.arange(0.25, 0.45, STEP), -np.arange(0.20, 0.40, STEP)  # m, of too high and low steps


def system(preset: str, check_support: bool = False, **values: Any) -> jaxik.FootIK:
    """The preset with these limits; it refuses narrow ground too if it checks for support."""
    named = {f"probe.{name}": value for name, value in (LIMITS | values).items()}
    ik = parameter_tree.replace(PROBES[preset](), named)
    return with_option(ik, "probe.check_support", check_support)


def inputs_of(ground: Any) -> Inputs:
    """A character that stands still."""
    return Inputs(to_rig(RIG), ground, at(to_frames([FRAME]), 0), HARD)


@jax.jit
def accepted_ground(ik: jaxik.FootIK, ground: Any, starts_ws: Any) -> Any:
    """Accepted ground below the starts (rays, legs, 3), m."""
    assert isinstance(ik.probe, AbstractLimitedProbe)
    layers = jnp.asarray(ALL_LAYERS, jnp.uint32)
    hit = ik.probe.cast(inputs_of(ground), starts_ws, jnp.asarray(2.4), layers)
    return hit.found, hit.point, hit.normal


@jax.jit
def carrying_ground(ik: jaxik.FootIK, ground: Any, starts_ws: Any) -> Any:
    """The same, over gaps."""
    assert isinstance(ik.probe, AbstractLimitedProbe)
    layers = jnp.asarray(ALL_LAYERS, jnp.uint32)
    hit = ik.probe.cast_over_gaps(inputs_of(ground), starts_ws, jnp.asarray(2.4), layers)
    return hit.found, hit.point, hit.normal, hit.distance


def read(ik: jaxik.FootIK, ground: PlainTerrain, starts: Any) -> list[np.ndarray]:
    return [np.asarray(x) for x in accepted_ground(ik, to_terrain(ground), jnp.asarray(starts))]


def found_on(ik: jaxik.FootIK, ground: PlainTerrain, *places: float, up: float = UP_START):
    """How far the ground below five places, m forward, is accepted for the left leg."""
    z = (*places, *(places[-1:] * 5))[:5]
    starts = np.array([[[0.0, up, place]] * 2 for place in z])
    return read(ik, ground, starts)[0][:, 0]


@functools.cache
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


def starts_over_bumps(seed: int) -> np.ndarray:
    places = np.random.default_rng(seed).uniform(-1.6, 1.6, (300, 2, 3))
    return places * [1, 0, 1] + [0, UP_START, 0]


def sloped(slope: float) -> list:
    """Two triangles that rise forward by this slope."""
    return quad(*((x, slope * z, z) for x, z in ((-3, -3), (3, -3), (3, 3), (-3, 3))))


# The decision.


@pytest.mark.parametrize("check_support", [False, True])
def test_it_agrees_with_the_reference(check_support):
    ground, starts = bumps(), starts_over_bumps(seed=0)
    per_leg = {"max_step_up": [0.3, 0.2], "max_slope": [0.6, 0.9]}
    if check_support:
        per_leg |= {"min_support": [0.9, 0.7], "support_radius": [0.1, 0.06]}
    found, point, normal = read(system("FootProbe", check_support, **per_leg), ground, starts)
    values = {f"probe.{name}": np.asarray(x) for name, x in (LIMITS | per_leg).items()}
    parameters = Parameters(values, dict.fromkeys(values, 0.0))
    inputs = inputs_of(to_terrain(ground))
    ahead = np.asarray(foot_heading(inputs)[0])
    heading = ahead if check_support else [None, None]
    expected = [
        [
            limits.read(Footing(leg, parameters, ground), start, 2.4, heading[leg])
            for leg, start in enumerate(row)
        ]
        for row in starts
    ]
    accepted = np.array([[reading.found for reading in row] for row in expected])
    np.testing.assert_allclose(found, accepted, rtol=0, atol=1e-9)
    assert ((accepted > 0.05) & (accepted < 0.95)).sum() > 15
    assert (accepted == 0).sum() > 50 and (accepted == 1).sum() > 50
    counts = accepted > 0
    for ours, name in ((point, "point"), (normal, "normal")):
        theirs = np.array([[getattr(reading, name) for reading in row] for row in expected])
        np.testing.assert_allclose(ours[counts], theirs[counts], rtol=0, atol=1e-9)


def test_a_slope_is_no_step_however_far_it_goes_and_supports_all_of_the_sole():
    slope = PlainTerrain(maths.Y, triangles=np.array(sloped(0.5) * BLOCKS))
    for check_support in (False, True):
        ik = system("FootProbe", check_support, max_slope=0.6)
        assert (found_on(ik, slope, -0.5, 0.0, 0.5, 2.0, up=2.0) == 1).all()


def test_a_ray_from_no_higher_than_a_step_looks_no_further_than_its_first_ground():
    """Only a ray from further up may have met a table."""
    floor = level_blocks((-1.0, 1.0, -0.9)).triangles[2:]
    ground = PlainTerrain(maths.Y, triangles=np.concatenate([sloped(1.6), floor]))
    starts = np.array([[[0.0, height, 0.0]] * 2 for height in (0.05, 0.1, 0.2, 0.3, 0.5)])
    found, point, _ = read(system("FootProbe", max_step_down=2.0), ground, starts)
    np.testing.assert_array_equal(found, 0.0)
    np.testing.assert_allclose(point, 0.0, rtol=0, atol=1e-12)


def test_infinite_limits_refuse_nothing():
    wide = system("FootProbe", False, **dict.fromkeys(LIMITS, np.inf))
    never = with_option(wide, "probe.limited", False)
    ours, theirs = (read(ik, bumps(), starts_over_bumps(seed=1)) for ik in (wide, never))
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)


def test_ground_narrower_than_the_sole_is_refused():
    plates = {"post": (0.02, 0.02), "beam": (0.02, 1.0), "beam across": (1.0, 0.02)}
    plates |= {"plank": (0.06, 1.0), "floor": (1.0, 1.0)}
    for name, (left, ahead) in plates.items():
        ground = level_blocks((-ahead, ahead, 0.0, -left, left), (-3.0, 3.0, -0.5))
        found = found_on(system("FootProbe", check_support=True), ground, 0.0)[0]
        assert found == (name in ("plank", "floor")), name
        assert found_on(system("FootProbe"), ground, 0.0)[0] == 1, name


@pytest.mark.slow
def test_feet_stand_over_gaps_narrower_than_half_a_sole_and_step_into_wider_ones():
    ik, heights = system("FootProbe"), {}
    starts = np.zeros((60, 2, 3)) + [0.0, UP_START, 0.0]
    starts[:, 0, 2] = np.linspace(-0.15, 0.15, 60)
    starts[:, 1, 0] = np.linspace(-0.15, 0.15, 60)  # along the other axis
    for width in (0.0, 0.03, 0.2):
        plates = [(-2.0, -width / 2), (width / 2, 2.0)]
        across = level_blocks(*((*ends, 0.0) for ends in plates), (-3.0, 3.0, -0.2))
        along = level_blocks(*((-2.0, 2.0, 0.0, *ends) for ends in plates), (-3.0, 3.0, -0.2))
        for leg, ground in enumerate((across, along)):
            found, point, normal, distance = carrying_ground(ik, to_terrain(ground), starts)
            np.testing.assert_array_equal(found, 1.0)
            np.testing.assert_allclose(normal[..., 1], 1.0, atol=1e-12)
            np.testing.assert_allclose(distance, UP_START - point[..., 1], atol=1e-12)
            heights[width] = np.asarray(point)[:, leg, 1]
            place = starts[:, leg, [2, 0][leg]]
            gap = (np.abs(place) < width / 2) & (width > 0.1)
            np.testing.assert_allclose(heights[width], np.where(gap, -0.2, 0.0), atol=1e-12)
    unlimited = with_option(ik, "probe.limited", False)
    slope = PlainTerrain(maths.Y, triangles=np.array(sloped(0.5) * BLOCKS))
    for system_on, ground in ((ik, slope), (unlimited, bumps())):
        places = system_on, to_terrain(ground), jnp.asarray(starts_over_bumps(seed=4))
        for plain, carrying in zip(
            accepted_ground(*places), carrying_ground(*places), strict=False
        ):
            np.testing.assert_allclose(carrying, plain, rtol=0, atol=1e-12)


def test_a_foot_may_stand_on_an_edge_and_beside_a_wall():
    edge = level_blocks((-0.2, 0.2, 0.0), (-3.0, 3.0, -0.5))
    wall = level_blocks((-3.0, 3.0, 0.0), (0.2, 2.0, 0.9))
    for ground in (edge, wall):
        found = found_on(system("FootProbe", True), ground, -0.199, -0.1, 0.0, 0.1, 0.199)
        assert (found == 1).all()


@pytest.mark.slow
def test_gradients_are_finite_where_ground_is_accepted_in_part_or_not_at_all():
    limits = {"max_step_down": 0.1, "min_support": 0.8, "support_radius": 0.1}
    ik, ground = system("FootProbe", True, **limits), to_terrain(bumps())
    floats, rest = eqx.partition(ik.probe, eqx.is_inexact_array)

    def total(floats: Any, starts: Any) -> jax.Array:
        probe = eqx.combine(floats, rest)
        found, point, normal = accepted_ground(dataclasses.replace(ik, probe=probe), ground, starts)
        return found.sum() + point[..., 1].sum() + normal.sum()

    gradient = jax.jit(jax.grad(total, (0, 1)))
    by_limit, by_start = gradient(floats, jnp.asarray(starts_over_bumps(seed=2)))
    slopes = [np.asarray(getattr(by_limit, name)) for name in LIMITS | WIDTHS]
    assert np.isfinite(slopes).all() and np.abs(slopes).min() > 0
    assert np.isfinite(by_start).all()


# What the probes do with it.


@functools.cache
def raised() -> jaxik.Frame:
    """The character as high over level ground as it would be over steps up and down."""
    heights = np.concatenate([[0.0], UP, DOWN])
    frames = to_frames([FRAME] * len(heights))
    return frames.translated(jnp.asarray(-heights[:, None] * maths.Y))


def on_steps(ik: jaxik.FootIK) -> GroundHits:
    ground = to_terrain(level_blocks((-3.0, 3.0, 0.0)))
    return at(jax.device_get(ground_under(ik, ground, raised())), slice(1, None))


def on_blocks(ik: jaxik.FootIK, *blocks: tuple[float, ...]) -> GroundHits:
    return at(jax.device_get(ground_under(ik, to_terrain(level_blocks(*blocks)), raised())), 0)


@pytest.mark.parametrize("preset", FIRST)
def test_a_foot_stands_on_the_floor_under_a_table(preset):
    hits = on_blocks(system(preset, check_support=True), (-3.0, 3.0, 0.5), FLOOR)
    np.testing.assert_allclose(hits.ankle.point[:, 1], -0.02, rtol=0, atol=1e-12)
    assert (hits.ankle.found == 1).all()


@pytest.mark.parametrize("preset", FIRST)
def test_a_step_fades_out_as_it_becomes_too_high_or_too_low(preset):
    """The foothold leaves the ground without a jump, and is the animated one in the end."""
    found = on_steps(system(preset, check_support=True)).ankle.found
    assert (found[-1] == 0).all()
    both = [(UP, found[: len(UP)], 0.3), (-DOWN, found[len(UP) :], 0.25)]
    for heights, part, limit in both[:1] if preset == "CornerProbe" else both:  # its rays end there
        assert (part[heights < limit - 1e-9] == 1).all()
        assert (part[heights > limit + 0.1 + 1e-9] == 0).all()
        assert np.abs(np.diff(part, axis=0)).max() < 1.5 * STEP / 0.1 + 1e-9


@pytest.mark.slow
def test_a_toe_on_half_accepted_ground_is_between_it_and_the_level_of_the_foot():
    """The rule of Mec looks for its toe from where it puts the sole."""
    ik = system("CornerProbe", check_support=True)
    ground, root = on_steps(ik), np.asarray(raised().world_from_model.pos[1:, 1])
    found, weight = ground.ankle.found, ground.toe.found
    half = ((found > 0.05) & (found < 0.95)).all(axis=1) & (root < 0)
    assert half.sum() > 10
    sole = (1 - found) * (FRAME.ankle.pos[:, 1] + root[:, None] - float(ik.target.foot_height))
    np.testing.assert_allclose(weight[half], found[half] ** 2, rtol=1e-6)
    toes = ground.toe.point[half, :, 1]
    np.testing.assert_allclose(toes, ((1 - weight) * sole)[half], rtol=1e-9)


@pytest.mark.parametrize("preset", FIRST)
def test_no_foot_stands_on_a_post_but_on_the_floor_below(preset):
    ik = system(preset, check_support=True)
    below = np.concatenate([on_blocks(ik, FLOOR).ankle.point, FRAME.toe.pos])
    posts = [(z - 0.02, z + 0.02, 0.2, x - 0.02, x + 0.02) for x, _, z in below]
    if preset == "FootProbe":
        on_posts = on_blocks(system(preset), *posts, FLOOR).ankle
        assert on_posts.point[:, 1].max() > 0.1, "feet would stand there"
    hits = on_blocks(ik, *posts, FLOOR).ankle
    np.testing.assert_allclose(hits.found * (hits.point[:, 1] + 0.02), 0.0, rtol=0, atol=1e-9)
