"""Heightfields and height functions: agreement with meshes, SciPy and formulas; gradients."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from jax.test_util import check_grads
from jax.tree_util import Partial
from scipy.interpolate import RegularGridInterpolator

import jaxik
from fitting import frames_from_clip
from fitting.datasets.synthetic import walker
from jaxik.world import grid, terrain

EMBREE = 1e-4  # m; Embree computes in float32
ROWS, COLUMNS = 24, 33
SPACING = np.array([0.25, 0.4])  # m, along x and z
ORIGIN = np.array([-3.0, 0.5, -4.0])  # m
UPS = {"y": (0.0, 1.0, 0.0), "tilted": (0.3, 0.9, -0.2), "z": (0.0, 0.0, 2.0)}
INTERPOLATIONS = ["bilinear", "triangulated"]


def hills(seed: int = 0, holes: int = 0) -> np.ndarray:
    """Heights, m, of hills with rubble on them; NaN at some places."""
    rng = np.random.default_rng(seed)
    x, z = np.meshgrid(np.arange(COLUMNS) * SPACING[0], np.arange(ROWS) * SPACING[1])
    heights = np.sin(x) * np.cos(0.7 * z) + rng.normal(scale=0.1, size=x.shape)
    heights.reshape(-1)[rng.choice(heights.size, holes, replace=False)] = np.nan
    return heights


def axes_about(up) -> np.ndarray:
    """The axes of a heightfield: rows x, up and z."""
    return np.asarray(grid.frame_axes(np.array(up) / np.linalg.norm(up)))


def as_mesh(heights: np.ndarray, up=UPS["y"]) -> tuple[np.ndarray, np.ndarray]:
    """The triangles of a grid, cell by cell: the diagonal runs from a corner to the next row."""
    rows, columns = heights.shape
    column, row = np.meshgrid(np.arange(columns), np.arange(rows))
    local = np.stack([column * SPACING[0], heights, row * SPACING[1]], axis=-1).reshape(-1, 3)
    triangles = []
    for i in range(rows - 1):
        for j in range(columns - 1):
            if np.isfinite(heights[i : i + 2, j : j + 2]).all():
                near, far = i * columns + j, (i + 1) * columns + j
                triangles += [[near, far, far + 1], [near, far + 1, near + 1]]
    return np.nan_to_num(local) @ axes_about(up) + ORIGIN, np.array(triangles)


def rays(count: int, up=UPS["y"], beside: float = 0.5) -> np.ndarray:
    """Origins over the grid and up to `beside` m beside it, every other one among the hills."""
    size = np.array([COLUMNS - 1, 0.0, ROWS - 1]) * [SPACING[0], 0.0, SPACING[1]]
    rng = np.random.default_rng(1)
    low, high = [-beside, -1.0, -beside], size + [beside, 2.0, beside]
    local = rng.uniform(low, high, (count, 3))
    local[::2, 1] = 5.0
    return local @ axes_about(up) + ORIGIN


def field(heights, interpolation="bilinear", **named) -> terrain.Terrain:
    return terrain.heightfield(heights, SPACING, ORIGIN, interpolation=interpolation, **named)


@jax.jit
def cast_all(ground: terrain.Terrain, origins: jax.Array) -> terrain.Hit:
    return terrain.cast(ground, origins, jnp.inf)


def assert_same(actual, expected, tolerance=1e-12):
    for x, y in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(x, y, rtol=0, atol=tolerance)


@pytest.mark.parametrize("up", UPS.values(), ids=UPS)
def test_triangulated_rays_agree_with_embree_on_the_same_triangles(up):
    heights = hills(holes=40)
    vertices, triangles = as_mesh(heights, up)
    origins = rays(20_000, up)
    hit = cast_all(field(heights, "triangulated", up=up), jnp.asarray(origins))
    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    tracer = trimesh.ray.ray_pyembree.RayMeshIntersector(mesh)  # pyright: ignore
    up = np.array(up) / np.linalg.norm(up)
    index = tracer.intersects_first(origins, np.broadcast_to(-up, origins.shape))
    normal = mesh.face_normals[index]
    normal *= np.sign(normal @ up)[:, None]
    drop = ((origins - vertices[triangles[index, 0]]) * normal).sum(-1) / (normal @ up)
    hits = np.asarray(hit.found) > 0.5
    same = np.abs(np.asarray(hit.normal) - normal).max(axis=-1) < 1e-6
    near = np.abs(np.asarray(hit.distance) - drop) < EMBREE
    assert np.mean((hits == (index >= 0)) & (near & same | ~hits)) > 1 - 5e-4
    assert 0.4 < hits.mean() < 0.8
    np.testing.assert_allclose(hit.point, origins - np.outer(hit.distance, up), atol=1e-12)


@pytest.mark.parametrize("up", UPS.values(), ids=UPS)
def test_triangulated_rays_are_those_of_a_mesh_of_the_same_triangles(up):
    heights = hills(holes=40)
    origins = jnp.asarray(rays(20_000, up))
    expected = cast_all(terrain.mesh(*as_mesh(heights, up), up=up), origins)
    assert_same(cast_all(field(heights, "triangulated", up=up), origins), expected, 1e-9)


def test_bilinear_heights_and_slopes_are_those_of_scipy():
    heights = hills()
    origins = rays(5000)
    hit = cast_all(field(heights), jnp.asarray(origins))
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
    normal = np.stack([-slopes[0], np.ones(len(origins)), -slopes[1]], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    error = np.abs(np.asarray(hit.normal) - normal)[found].max(axis=-1)
    assert np.mean(error < 1e-8) > 0.999  # the rest straddle a line between cells


def test_bilinear_and_triangulated_agree_on_the_lines_of_the_grid():
    heights = hills()
    row = np.arange(ROWS)[:, None] * SPACING[1] + ORIGIN[2]
    place = np.linspace(0.0, 1.0, 200) * (COLUMNS - 1) * SPACING[0] + ORIGIN[0]
    origins = jnp.stack(jnp.broadcast_arrays(place, jnp.asarray(9.0), row), axis=-1)
    both = [cast_all(field(heights, name), origins) for name in INTERPOLATIONS]
    assert np.all(both[0].found == 1.0)
    np.testing.assert_allclose(both[0].point, both[1].point, atol=1e-12)


@pytest.mark.parametrize("interpolation", INTERPOLATIONS)
def test_the_cells_around_a_nan_are_holes(interpolation):
    heights = np.zeros((4, 5))
    heights[1, 2] = np.nan
    ground = terrain.heightfield(heights, 1.0, interpolation=interpolation)
    x, z = jnp.meshgrid(jnp.arange(4) + 0.5, jnp.arange(3) + 0.5)
    found = terrain.cast(ground, jnp.stack([x, 0 * x + 1.0, z], axis=-1), jnp.inf).found
    np.testing.assert_array_equal(found, [[1, 0, 0, 1], [1, 0, 0, 1], [1, 1, 1, 1]])


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_the_border_belongs_to_the_field_and_nothing_beyond_it(dtype):
    # Far from the world's origin, where a float32 is rounded by 0.06 mm.
    origin, spacing = np.array([1000.1, 0.0, -700.3]), 0.1
    ground = terrain.heightfield(np.zeros((31, 31), dtype), spacing, origin)
    line = spacing * np.arange(31)
    sides = [np.stack(np.broadcast_arrays(line, 1.0, side), -1) for side in (0.0, line[-1])]
    border = np.concatenate([*sides, *(side[:, ::-1] for side in sides)])
    border[:, 1] = 1.0
    outwards = 1e-3 * np.sign(border - [1.5, 1.0, 1.5])
    for offset, found in ((0.0 * outwards, 1.0), (-outwards, 1.0), (outwards, 0.0)):
        hit = cast_all(ground, jnp.asarray(border + offset + origin, dtype))
        np.testing.assert_array_equal(hit.found, found)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_ray_that_starts_on_the_ground_hits_it_and_one_from_below_misses(dtype):
    heights = 50.0 * hills()  # steep
    ground = terrain.heightfield(heights.astype(dtype), SPACING, ORIGIN + [300.0, 0.0, 0.0])
    origins = jnp.asarray(rays(5000, beside=-0.01) + [300.0, 200.0, 0.0], dtype)
    first = cast_all(ground, origins)
    over = first.found == 1.0
    again = cast_all(ground, first.point)
    np.testing.assert_array_equal(again.found, first.found)
    assert np.abs(again.distance[over]).max() < 1e4 * jnp.finfo(dtype).eps
    below = cast_all(ground, first.point - jnp.asarray([0.0, 0.1, 0.0], dtype))
    np.testing.assert_array_equal(below.found, 0.0)


def test_rays_from_nowhere_and_beyond_the_grid_miss():
    origins = jnp.array([[99.0, 3.0, 0.0], [jnp.nan, 3.0, 0.0], [jnp.inf, 3.0, 0.0], [0, -9.0, 0]])
    hit = cast_all(field(hills()), origins)
    np.testing.assert_array_equal(hit.found, 0.0)
    np.testing.assert_array_equal(hit.normal, np.eye(3)[[1, 1, 1, 1]])


def test_a_ray_hits_the_nearest_of_meshes_planes_and_heightfields_on_its_layers():
    floor = terrain.plane((0.0, 0.2, 0.0), layer=1)
    table = terrain.mesh(*as_mesh(np.full((ROWS, COLUMNS), 0.6)), layer=2)
    wave = terrain.function(lambda x, z: 0.4 + 0.0 * x, layer=3)
    ground = terrain.combine(floor, field(hills(), layer=31), table, wave)
    origins = jnp.asarray(rays(2000)).at[:, 1].set(9.0)
    masks = [terrain.layer_mask(*layers) for layers in ((31,), (31, 1), (1, 2, 3, 31), (3,))]
    hills_only, with_floor, everything, wave_only = (
        np.asarray(terrain.cast(ground, origins, 99.0, mask).point[:, 1]) for mask in masks
    )
    np.testing.assert_allclose(with_floor, np.maximum(hills_only, 0.2), atol=1e-12)
    over = hills_only > -90.0
    np.testing.assert_allclose(everything[over], np.maximum(hills_only, 1.1)[over], atol=1e-12)
    np.testing.assert_allclose(everything[~over], 0.4, atol=1e-12)
    np.testing.assert_allclose(wave_only, 0.4, atol=1e-12)


@pytest.mark.parametrize("up", UPS.values(), ids=UPS)
@pytest.mark.parametrize("interpolation", INTERPOLATIONS)
def test_gradients_match_finite_differences(interpolation, up):
    heights = hills(holes=10)
    holes = np.isnan(heights)
    origins = rays(60, up)

    @jax.jit
    def cast(origins, heights, spacing, origin):
        heights = jnp.where(holes, jnp.nan, heights)
        ground = terrain.heightfield(heights, spacing, origin, up, interpolation=interpolation)
        hit = terrain.cast(ground, origins, jnp.inf)
        return hit.point, hit.normal, hit.distance

    arguments = map(jnp.asarray, (origins, np.nan_to_num(heights), SPACING, ORIGIN))
    check_grads(cast, tuple(arguments), 1, ["fwd", "rev"], atol=1e-6, rtol=1e-6, eps=1e-6)


@pytest.mark.parametrize("interpolation", INTERPOLATIONS)
def test_gradients_are_finite_on_lines_corners_holes_borders_and_misses(interpolation):
    heights = hills(holes=30)
    corners = (np.nan_to_num(as_mesh(np.nan_to_num(heights))[0])).reshape(-1, 3)
    middles = corners + [SPACING[0] / 2, 0.0, 0.0]
    points = np.concatenate([corners, corners + [0, 1, 0], middles + [0, 1, 0], corners + 99.0])

    def total(inputs):
        ground, origins = inputs
        hit = terrain.cast(ground, origins, 50.0)
        return sum(jnp.sum(jnp.sin(leaf)) for leaf in jax.tree.leaves(hit))

    inputs = field(heights, interpolation), jnp.asarray(points)
    gradients = jax.tree.leaves(eqx.filter_jit(eqx.filter_grad(total))(inputs))
    assert len(gradients) == 6
    assert all(np.isfinite(gradient).all() for gradient in gradients)
    forward = jax.jacfwd(
        lambda scale: total(
            (terrain.heightfield(scale * heights, scale * SPACING, scale * ORIGIN), scale * points)
        )
    )(jnp.ones(()))
    assert np.isfinite(forward)


def mixed() -> terrain.Terrain:
    wave = terrain.function(Partial(wave_height, jnp.array([0.3, 1.5])), layer=4)
    return terrain.combine(field(hills(holes=20)), field(hills(3), "triangulated", layer=2), wave)


def wave_height(numbers, x, z):
    amplitude, frequency = numbers
    return amplitude * jnp.sin(frequency * x) + 0.1 * z


def test_jit_vmap_scan_lanes_and_a_loop_agree():
    ground = mixed()
    origins = jnp.asarray(rays(48)).reshape(24, 2, 3)

    def cast(origins):
        return terrain.cast(ground, origins, jnp.inf)

    whole = cast_all(ground, origins)
    assert 0.2 < np.mean(whole.found) < 1.0
    assert_same(jax.vmap(jax.vmap(cast))(origins), whole)
    assert_same(jaxik.lanes(cast)(origins), whole)
    assert_same(jaxik.lanes(cast, block=7)(origins), whole)
    assert_same(jax.lax.scan(lambda _, o: (None, cast(o)), None, origins)[1], whole)
    looped = [cast(origin) for origin in origins]
    assert_same(jax.tree.map(lambda *leaves: jnp.stack(leaves), *looped), whole)


@pytest.mark.parametrize("batch", [jax.vmap, jaxik.lanes])
def test_heightfields_and_functions_of_one_shape_form_a_batch(batch):
    origins = jnp.asarray(rays(40))
    numbers = jnp.array([[0.3, 1.0], [0.2, 2.0], [0.5, 0.7]])
    heights = jnp.stack([jnp.asarray(hills(seed, holes=20)) for seed in range(3)])

    def cast(heights, numbers):
        wave = terrain.function(Partial(wave_height, numbers))
        return terrain.cast(terrain.combine(field(heights), wave), origins, 9.0)

    alone = [cast(*each) for each in zip(heights, numbers, strict=True)]
    together = jax.jit(batch(cast))(heights, numbers)
    assert_same(together, jax.tree.map(lambda *leaves: jnp.stack(leaves), *alone))


def test_float32_stays_float32_under_strict_promotion():
    with jax.numpy_dtype_promotion("strict"):
        ground = terrain.combine(
            field(hills().astype(np.float32)),
            field(hills().astype(np.float32), "triangulated"),
            terrain.function(lambda x, z: jnp.sin(x) + z, dtype=jnp.float32),
        )
        hit = terrain.cast(ground, jnp.zeros((4, 3), jnp.float32), 3.0)
    assert {leaf.dtype for leaf in jax.tree.leaves(hit)} == {jnp.dtype(jnp.float32)}


def test_whole_numbers_are_heights_too():
    ground = terrain.heightfield(np.array([[0, 1], [0, 1]], np.uint16), 1.0)
    hit = terrain.cast(ground, jnp.array([0.25, 5.0, 0.5]), jnp.inf)
    np.testing.assert_allclose(hit.point, [0.25, 0.25, 0.5], atol=1e-12)


@pytest.mark.parametrize("up", UPS.values(), ids=UPS)
def test_a_function_gives_the_height_and_its_normal(up):
    ground = terrain.function(lambda x, z: 0.3 * jnp.sin(2.0 * x) + 0.2 * z * z, up)
    axes = axes_about(up)
    local = np.random.default_rng(3).uniform(-2.0, 2.0, (500, 3)) + [0.0, 5.0, 0.0]
    hit = cast_all(ground, jnp.asarray(local @ axes))
    x, _, z = local.T
    expected = np.stack([x, 0.3 * np.sin(2.0 * x) + 0.2 * z * z, z], axis=-1)
    normal = np.stack([-0.6 * np.cos(2.0 * x), np.ones(500), -0.4 * z], axis=-1)
    np.testing.assert_allclose(hit.point, expected @ axes, atol=1e-12)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    np.testing.assert_allclose(hit.normal, normal @ axes, atol=1e-12)


def test_a_function_may_be_written_for_single_points_only():
    table = jnp.array([0.0, 1.0, 0.5, 2.0])

    def stairs_or_ramp(x, z):
        return jax.lax.cond(z > 0, lambda: jnp.interp(x, jnp.arange(4.0), table), lambda: x)

    origins = jnp.array([[0.5, 9.0, 1.0], [2.5, 9.0, 1.0], [2.5, 9.0, -1.0]])
    hit = terrain.cast(terrain.function(stairs_or_ramp), origins, jnp.inf)
    np.testing.assert_allclose(hit.point[:, 1], [0.5, 1.25, 2.5], atol=1e-12)
    np.testing.assert_allclose(hit.normal[:, 0] / hit.normal[:, 1], [-1.0, -1.5, -1.0], atol=1e-12)


def test_a_function_that_is_not_finite_leaves_a_hole_with_finite_gradients():
    def crater(numbers, x, z):
        return jnp.where(x * x + z * z < 1.0, jnp.nan, wave_height(numbers, x, z))

    origins = jnp.array([[0.1, 3.0, 0.2], [1.5, 3.0, 0.2]])

    def total(numbers, origins):
        hit = terrain.cast(terrain.function(Partial(crater, numbers)), origins, 9.0)
        return jnp.sum(hit.point + hit.normal), hit

    (_, hit), gradients = jax.value_and_grad(total, (0, 1), has_aux=True)(jnp.ones(2), origins)
    np.testing.assert_array_equal(hit.found, [0.0, 1.0])
    assert all(np.isfinite(gradient).all() for gradient in gradients)
    cliff = terrain.function(lambda x, z: jnp.where(x > 0, jnp.sqrt(jnp.abs(x)), 0.0))
    assert terrain.cast(cliff, jnp.array([0.0, 3.0, 0.0]), 9.0).found in (0.0, 1.0)


def test_gradients_of_a_function_match_finite_differences():
    origins = jnp.asarray(rays(40))

    @jax.jit
    def cast(origins, numbers):
        hit = terrain.cast(terrain.function(Partial(wave_height, numbers)), origins, jnp.inf)
        return hit.point, hit.normal

    arguments = origins, jnp.array([0.3, 1.5])
    check_grads(cast, arguments, 1, ["fwd", "rev"], atol=1e-6, rtol=1e-6, eps=1e-6)


class Dome(eqx.Module):
    """A height function with parameters."""

    radii: jax.Array

    def __call__(self, x, z):
        return self.radii[0] - self.radii[1] * (x * x + z * z)


@pytest.mark.parametrize("make", [lambda numbers: Partial(wave_height, numbers), Dome])
def test_numbers_of_a_function_change_without_a_new_trace(make):
    traces = []

    @jax.jit
    def cast(ground):
        traces.append(ground)
        return terrain.cast(ground, jnp.array([0.5, 9.0, 0.0]), jnp.inf)

    grounds = [terrain.function(make(jnp.array([size, 1.0]))) for size in (1.0, 2.0, 3.0)]
    assert len({float(cast(ground).point[1]) for ground in grounds}) == 3
    assert len(traces) == 1
    cast(terrain.function(lambda x, z: wave_height((1.0, 1.0), x, z)))
    assert len(traces) == 2  # another function


def test_python_numbers_of_a_function_are_traced_too():
    traces = []

    @eqx.filter_jit
    def cast(ground):
        traces.append(ground)
        return terrain.cast(ground, jnp.array([0.5, 9.0, 0.0]), jnp.inf).point[1]

    heights = [cast(terrain.function(Partial(wave_height, (size, 1.0)))) for size in (1.0, 2.0)]
    assert float(heights[1]) == pytest.approx(2 * float(heights[0]))
    assert len(traces) == 1


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["record", "stride"])
def test_a_walk_over_a_heightfield_is_that_over_the_same_mesh(preset):
    heights = 0.2 * hills()
    frames = frames_from_clip(clip := walker.walk(2.0, 30.0, 0))
    # The walk starts in the middle of the field, not on a line of the grid, where slopes jump.
    start = np.asarray(frames.world_from_model.pos[0])
    origin = start - np.array([16.37, 0.0, 12.21]) * [SPACING[0], 0.0, SPACING[1]]
    vertices, triangles = as_mesh(heights)
    over = [
        terrain.heightfield(heights, SPACING, origin, interpolation="triangulated"),
        terrain.mesh(vertices - ORIGIN + origin, triangles),
    ]
    ik = getattr(jaxik.presets, preset)()
    results = [jaxik.run(ik, clip.rig, ground, frames) for ground in over]
    # Not `reached`, which rounding decides for a leg at its full length.
    field_walk, mesh_walk = ((each.pose, each.body, each.trace) for each in results)
    assert_same(field_walk, mesh_walk, 1e-6)
    assert np.ptp(np.asarray(results[0].body.pos)[:, 1]) > 0.02  # the ground matters


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda h: terrain.heightfield(h[0], 1.0), r"2 or more columns\); got \(33,\)"),
        (lambda h: terrain.heightfield(h[:1], 1.0), r"got \(1, 33\)"),
        (lambda h: terrain.heightfield(np.where(h == h[2, 3], np.inf, h), 1.0), r"heights\[2, 3\]"),
        (lambda h: terrain.heightfield(h * np.nan, 1.0), "no ground at all"),
        (lambda h: terrain.heightfield(h, 0.0), "above 0; got 0.0"),
        (lambda h: terrain.heightfield(h, (1.0, -1.0)), r"above 0; got \[1.0, -1.0\]"),
        (lambda h: terrain.heightfield(h, (1.0, 1.0, 1.0)), r"between rows; got the shape \(3,\)"),
        (lambda h: terrain.heightfield(h, 1.0, (0.0, 0.0)), r"origin must have the shape \(3,\)"),
        (
            lambda h: terrain.heightfield(h, 1.0, (0.0, np.nan, 0.0)),
            "origin is three numbers of at most",
        ),
        (
            lambda h: terrain.heightfield(h, 1.0, interpolation="cubic"),
            "'triangulated'; got 'cubic'",
        ),
        (lambda h: terrain.heightfield(h, 1.0, up=(0.0, 0.0, 0.0)), "up is a direction"),
        (lambda h: terrain.heightfield(h, 1.0, layer=32), "from 0 to 31; got 32"),
        (lambda h: terrain.function(lambda x, z: jnp.stack([x, z])), r"got the shape \(2,\)"),
        (lambda h: terrain.function(lambda x, z: 1j * x), "dtype complex128"),
        (lambda h: terrain.function(Partial(wave_height, "steep")), "one is a str"),
        (lambda h: terrain.function(lambda x, z: x, up=(0.0, 0.0, 0.0)), "up is a direction"),
        (lambda h: terrain.function(lambda x, z: x, layer=-1), "from 0 to 31; got -1"),
        (lambda h: field(h).with_vertices(jnp.zeros((4, 3))), "surface 0 is a Heightfield"),
    ],
)
def test_what_is_no_heightfield_is_rejected_with_what_was_expected(make, message):
    with pytest.raises(ValueError, match=message):
        make(hills())
