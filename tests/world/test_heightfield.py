"""Heightfields and height functions: agreement with meshes, SciPy and formulas; gradients."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from jax.tree_util import Partial
from scipy.interpolate import RegularGridInterpolator

import jaxik
from jaxik.world import grid, terrain
from support.clips import assert_close
from support.gradients import unit
from support.meshes import against_embree, cast, lattice

ROWS, COLUMNS = 24, 33
SPACING = np.array([0.25, 0.4])  # m, along x and z
ORIGIN = np.array([-3.0, 0.5, -4.0])  # m
UPS = {"y": (0.0, 1.0, 0.0), "tilted": (0.3, 0.9, -0.2), "z": (0.0, 0.0, 2.0)}
KINDS = "bilinear", "triangulated"
RAYS = 20_000
each_kind = pytest.mark.parametrize("interpolation", KINDS)


def hills(seed: int = 0, holes: int = 0) -> np.ndarray:
    """Heights, m, of hills with rubble on them; NaN at some places."""
    rng = np.random.default_rng(seed)
    x, z = np.meshgrid(np.arange(COLUMNS) * SPACING[0], np.arange(ROWS) * SPACING[1])
    heights = np.sin(x) * np.cos(0.7 * z) + rng.normal(scale=0.1, size=x.shape)
    heights.reshape(-1)[rng.choice(heights.size, holes, replace=False)] = np.nan
    return heights


def axes_about(up) -> np.ndarray:
    """The axes of a heightfield: rows x, up and z."""
    return np.asarray(grid.frame_axes(unit(np.array(up))))


def rays(count: int, up=UPS["y"], beside: float = 0.5) -> np.ndarray:
    """Origins over the grid and up to `beside` m beside it, every other one among the hills."""
    size = np.array([COLUMNS - 1, 0.0, ROWS - 1]) * [SPACING[0], 0.0, SPACING[1]]
    low, high = [-beside, -1.0, -beside], size + [beside, 2.0, beside]
    local = np.random.default_rng(1).uniform(low, high, (count, 3))
    local[::2, 1] = 5.0
    return local @ axes_about(up) + ORIGIN


def field(heights, interpolation="bilinear", origin: Any = ORIGIN, **named) -> terrain.Terrain:
    return terrain.heightfield(heights, SPACING, origin, interpolation=interpolation, **named)


def wave_height(numbers, x, z):
    amplitude, frequency = numbers
    return amplitude * jnp.sin(frequency * x) + 0.1 * z


def test_triangulated_rays_are_those_of_a_mesh_of_the_same_triangles_and_of_embree():
    heights = hills(holes=40)
    corners, triangles = lattice(heights, SPACING)
    for up in UPS.values():
        vertices, origins = corners @ axes_about(up) + ORIGIN, rays(RAYS, up)
        hit = cast(field(heights, "triangulated", up=up), origins)
        assert_close(hit, cast(terrain.mesh(vertices, triangles, up=up), origins), 1e-9)
        unit_up = unit(np.array(up))
        compared = against_embree(hit, vertices, triangles, origins, unit_up)
        right = compared.agree & (compared.same_normal | ~compared.hits)
        assert right.mean() > 1 - 5e-4 and 0.4 < compared.hits.mean() < 0.8, up
        points = origins - np.outer(hit.distance, unit_up)
        np.testing.assert_allclose(hit.point, points, atol=1e-12)


def test_bilinear_heights_and_slopes_are_those_of_scipy():
    heights, origins = hills(), rays(RAYS)
    hit = cast(field(heights), origins)
    lines = ORIGIN[2] + np.arange(ROWS) * SPACING[1], ORIGIN[0] + np.arange(COLUMNS) * SPACING[0]
    surface = RegularGridInterpolator(lines, heights + ORIGIN[1], bounds_error=False)
    expected = surface(origins[:, [2, 0]])
    found = origins[:, 1] >= expected  # False where NaN
    np.testing.assert_array_equal(np.asarray(hit.found) > 0.5, found)
    np.testing.assert_allclose(np.asarray(hit.point)[found, 1], expected[found], atol=1e-12)
    step = 1e-6  # m; a bilinear cell is straight along either axis
    slopes = [
        (surface(origins[:, [2, 0]] + move) - surface(origins[:, [2, 0]] - move)) / (2 * step)
        for move in ([0.0, step], [step, 0.0])
    ]
    normal = unit(np.stack([-slopes[0], np.ones(RAYS), -slopes[1]], axis=-1))
    error = np.abs(np.asarray(hit.normal) - normal)[found].max(axis=-1)
    assert np.mean(error < 1e-8) > 0.999  # the rest straddle a line between cells


def test_the_cells_around_a_nan_are_holes_and_whole_numbers_are_heights():
    heights = np.zeros((4, 5))
    heights[1, 2] = np.nan
    x, z = np.meshgrid(np.arange(4) + 0.5, np.arange(3) + 0.5)
    for interpolation in KINDS:
        ground = terrain.heightfield(heights, 1.0, interpolation=interpolation)
        found = cast(ground, np.stack([x, 0 * x + 1.0, z], axis=-1)).found
        np.testing.assert_array_equal(found, [[1, 0, 0, 1], [1, 0, 0, 1], [1, 1, 1, 1]])
    ground = terrain.heightfield(np.array([[0, 1], [0, 1]], np.uint16), 1.0)
    np.testing.assert_allclose(cast(ground, [0.25, 5.0, 0.5]).point, [0.25, 0.25, 0.5], atol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_border_belongs_to_the_field_as_does_a_ray_that_starts_on_it(dtype):
    # Far from the world's origin, where a float32 is rounded by 0.06 mm.
    origin, spacing = np.array([1000.1, 0.0, -700.3]), 0.1
    ground = terrain.heightfield(np.zeros((31, 31), dtype), spacing, origin)
    line = spacing * np.arange(31)
    sides = [np.stack(np.broadcast_arrays(line, 1.0, side), -1) for side in (0.0, line[-1])]
    border = np.concatenate([*sides, *(side[:, ::-1] for side in sides)])
    border[:, 1] = 1.0
    outwards = 1e-3 * np.sign(border - [1.5, 1.0, 1.5])
    for offset, found in ((0.0 * outwards, 1.0), (-outwards, 1.0), (outwards, 0.0)):
        hit = cast(ground, np.asarray(border + offset + origin, dtype))
        np.testing.assert_array_equal(hit.found, found)
    ground = field((50.0 * hills()).astype(dtype), origin=ORIGIN + [300.0, 0.0, 0.0])  # steep
    first = cast(ground, np.asarray(rays(RAYS, beside=-0.01) + [300.0, 200.0, 0.0], dtype))
    again = cast(ground, first.point)
    np.testing.assert_array_equal(again.found, first.found)
    assert np.abs(again.distance[first.found == 1.0]).max() < 1e4 * np.finfo(dtype).eps
    below = cast(ground, first.point - jnp.asarray([0.0, 0.1, 0.0], dtype))
    np.testing.assert_array_equal(below.found, 0.0)


@each_kind
def test_gradients_match_finite_differences(interpolation):
    heights, up = hills(holes=10), UPS["tilted"]
    holes = np.isnan(heights)
    origins = rays(60, up)

    @jax.jit
    def hits(origins, heights, spacing, origin):
        heights = jnp.where(holes, jnp.nan, heights)
        ground = terrain.heightfield(heights, spacing, origin, up, interpolation=interpolation)
        hit = terrain.cast(ground, origins, jnp.inf)
        return hit.point, hit.normal, hit.distance

    arguments = map(jnp.asarray, (origins, np.nan_to_num(heights), SPACING, ORIGIN))
    check_grads(hits, tuple(arguments), 1, ["fwd", "rev"], atol=1e-6, rtol=1e-6, eps=1e-6)


@each_kind
def test_gradients_are_finite_on_lines_corners_holes_borders_and_misses(interpolation):
    heights = hills(holes=30)
    corners = lattice(np.nan_to_num(heights), SPACING, ORIGIN)[0]
    middles = corners + [SPACING[0] / 2, 0.0, 0.0]
    points = np.concatenate([corners, corners + [0, 1, 0], middles + [0, 1, 0], corners + 99.0])
    inputs = field(heights, interpolation), jnp.asarray(points)
    floats, rest = eqx.partition(inputs, eqx.is_inexact_array)

    def total(floats, scale=1.0):
        ground, origins = eqx.combine(jax.tree.map(lambda x: scale * x, floats), rest)
        hit = terrain.cast(ground, origins, 50.0)
        return sum(jnp.sum(jnp.sin(leaf)) for leaf in jax.tree.leaves(hit))

    @jax.jit
    def derivatives(floats):
        return jax.grad(total)(floats), jax.jacfwd(total, argnums=1)(floats, jnp.ones(()))

    gradients = jax.tree.leaves(derivatives(floats))
    assert len(gradients) == 7
    assert all(np.isfinite(gradient).all() for gradient in gradients)


@pytest.mark.parametrize("batch", [jax.vmap, jaxik.lanes])
def test_heightfields_and_functions_of_one_shape_form_a_batch(batch):
    origins = jnp.asarray(rays(40))
    numbers = jnp.array([[0.3, 1.0], [0.2, 2.0], [0.5, 0.7]])
    heights = jnp.stack([jnp.asarray(hills(seed, holes=20)) for seed in range(3)])

    def hits(heights, numbers):
        wave = terrain.function(Partial(wave_height, numbers))
        return terrain.cast(terrain.combine(field(heights), wave), origins, 9.0)

    alone = [hits(*each) for each in zip(heights, numbers, strict=True)]
    together = jax.jit(batch(hits))(heights, numbers)
    assert_close(together, jax.tree.map(lambda *leaves: jnp.stack(leaves), *alone), 1e-12)


def test_a_function_gives_height_and_normal_also_if_written_for_single_points_only():
    local = np.random.default_rng(3).uniform(-2.0, 2.0, (500, 3)) + [0.0, 5.0, 0.0]
    x, _, z = local.T
    expected = np.stack([x, 0.3 * np.sin(2.0 * x) + 0.2 * z * z, z], axis=-1)
    normal = unit(np.stack([-0.6 * np.cos(2.0 * x), np.ones(500), -0.4 * z], axis=-1))
    for up in UPS.values():
        ground = terrain.function(lambda x, z: 0.3 * jnp.sin(2.0 * x) + 0.2 * z * z, up)
        axes = axes_about(up)
        hit = cast(ground, local @ axes)
        np.testing.assert_allclose(hit.point, expected @ axes, atol=1e-12)
        np.testing.assert_allclose(hit.normal, normal @ axes, atol=1e-12)
    table = jnp.array([0.0, 1.0, 0.5, 2.0])

    def stairs_or_ramp(x, z):
        return jax.lax.cond(z > 0, lambda: jnp.interp(x, jnp.arange(4.0), table), lambda: x)

    hit = cast(terrain.function(stairs_or_ramp), [[0.5, 9.0, 1.0], [2.5, 9.0, 1.0], [2.5, 9.0, -1]])
    np.testing.assert_allclose(hit.point[:, 1], [0.5, 1.25, 2.5], atol=1e-12)
    np.testing.assert_allclose(hit.normal[:, 0] / hit.normal[:, 1], [-1.0, -1.5, -1.0], atol=1e-12)


def test_gradients_of_a_function_are_those_of_differences_and_finite_at_a_hole():
    def crater(numbers, x, z):
        return jnp.where(x * x + z * z < 1.0, jnp.nan, wave_height(numbers, x, z))

    origins = jnp.array([[0.1, 3.0, 0.2], [1.5, 3.0, 0.2]])

    def total(numbers, origins):
        hit = terrain.cast(terrain.function(Partial(crater, numbers)), origins, 9.0)
        return jnp.sum(hit.point + hit.normal), hit

    value_and_grad = jax.jit(jax.value_and_grad(total, (0, 1), has_aux=True))
    (_, hit), gradients = value_and_grad(jnp.ones(2), origins)
    np.testing.assert_array_equal(hit.found, [0.0, 1.0])
    assert all(np.isfinite(gradient).all() for gradient in gradients)

    @jax.jit
    def hits(origins, numbers):
        hit = terrain.cast(terrain.function(Partial(wave_height, numbers)), origins, jnp.inf)
        return hit.point, hit.normal

    arguments = jnp.asarray(rays(40)), jnp.array([0.3, 1.5])
    check_grads(hits, arguments, 1, ["fwd", "rev"], atol=1e-6, rtol=1e-6, eps=1e-6)


class Dome(eqx.Module):
    """A height function with parameters."""

    radii: jax.Array

    def __call__(self, x, z):
        return self.radii[0] - self.radii[1] * (x * x + z * z)


def test_numbers_of_a_function_change_without_a_new_trace():
    for make in (
        lambda size: Partial(wave_height, jnp.array([size, 1.0])),
        lambda size: Partial(wave_height, (size, 1.0)),
        lambda size: Dome(jnp.array([size, 1.0])),
    ):
        traces = []

        @eqx.filter_jit
        def height(ground, traces=traces):
            traces.append(ground)
            return cast(ground, [0.5, 9.0, 0.0]).point[1]

        assert len({float(height(terrain.function(make(size)))) for size in (1.0, 2.0, 3.0)}) == 3
        assert len(traces) == 1
        height(terrain.function(lambda x, z: wave_height((1.0, 1.0), x, z)))
        assert len(traces) == 2  # another function


def test_what_is_no_heightfield_is_refused_with_what_was_expected():
    h, of, function = hills(), terrain.heightfield, terrain.function
    for make, message in (
        (lambda: of(h[0], 1.0), r"2 or more columns\); got \(33,\)"),
        (lambda: of(h[:1], 1.0), r"got \(1, 33\)"),
        (lambda: of(np.where(h == h[2, 3], np.inf, h), 1.0), r"heights\[2, 3\]"),
        (lambda: of(h * np.nan, 1.0), "no ground at all"),
        (lambda: of(h, 0.0), "above 0; got 0.0"),
        (lambda: of(h, (1.0, -1.0)), r"above 0; got \[1.0, -1.0\]"),
        (lambda: of(h, (1.0, 1.0, 1.0)), r"between rows; got the shape \(3,\)"),
        (lambda: field(h, origin=(0.0, 0.0)), r"origin must have the shape \(3,\)"),
        (lambda: field(h, origin=(0.0, np.nan, 0.0)), "origin is three numbers of at most"),
        (lambda: field(h, "cubic"), "'triangulated'; got 'cubic'"),
        (lambda: field(h, up=(0.0, 0.0, 0.0)), "up is a direction"),
        (lambda: field(h, layer=32), "from 0 to 31; got 32"),
        (lambda: field(h).with_vertices(jnp.zeros((4, 3))), "surface 0 is a Heightfield"),
        (lambda: function(lambda x, z: jnp.stack([x, z])), r"got the shape \(2,\)"),
        (lambda: function(lambda x, z: 1j * x), "dtype complex128"),
        (lambda: function(Partial(wave_height, "steep")), "one is a str"),
        (lambda: function(lambda x, z: x, up=(0.0, 0.0, 0.0)), "up is a direction"),
        (lambda: function(lambda x, z: x, layer=-1), "from 0 to 31; got -1"),
    ):
        with pytest.raises(ValueError, match=message):
            make()
