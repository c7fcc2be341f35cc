"""Sweeps: agreement with trimesh's distances and with formulas, gradients, batches, layers."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxik import lanes
from jaxik.world import sweep, terrain
from jaxik.world.skeleton import Transform
from jaxik.world.sweep import shapes
from support.cases import QUICK
from support.clips import assert_close
from support.gradients import unit
from support.meshes import UP, arrays, box, every_kind, lattice

REACH = 9.0
RADIUS = 0.3
HALF = np.array([0.25, 0.05, -0.4])
CORNER = (-2.0, 0.0, -2.0)
HEIGHTS = np.random.default_rng(0).uniform(-0.5, 0.5, (9, 9))
VERTICES, TRIANGLES = lattice(HEIGHTS, 0.5, CORNER)
each_shape = pytest.mark.parametrize("half", [None, HALF], ids=["sphere", "capsule"])


@functools.partial(jax.jit, compiler_options=QUICK)
def swept(ground, centres, radius, half=None):
    return sweep.sweep(ground, centres, radius, REACH, half_ws=half)


@functools.cache
def mesh() -> terrain.Terrain:
    return sweep.sweepable(terrain.mesh(VERTICES, TRIANGLES), RADIUS + 0.5)


def field(heights=HEIGHTS, interpolation="triangulated") -> terrain.Terrain:
    return terrain.heightfield(heights, 0.5, CORNER, interpolation=interpolation)


def centres(count: int, seed: int = 1) -> np.ndarray:
    """Starts over the rough ground and a little beyond, m."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-2.4, 2.4, (count, 3)) * [1, 0, 1] + [0, 3.0, 0]


def ends(starts: np.ndarray, hit: terrain.Hit, fraction: float = 1.0) -> np.ndarray:
    """Where the shapes are at this fraction of their way, m."""
    return starts - fraction * np.asarray(hit.distance)[:, None] * UP


def axis_points(centre: np.ndarray, half: np.ndarray | None, count: int = 81) -> np.ndarray:
    """Points on the axis of each shape, (count, shapes, 3), m."""
    if half is None:
        return centre[None]
    return centre + np.linspace(-1.0, 1.0, count)[:, None, None] * half


def distances(points: np.ndarray) -> np.ndarray:
    """To the mesh, m."""
    flat, count = points.reshape(-1, 3), len(TRIANGLES)
    corners = np.tile(VERTICES[TRIANGLES], (len(flat), 1, 1))
    repeated = np.repeat(flat, count, axis=0)
    nearest = trimesh.triangles.closest_point(corners, repeated)
    gaps = np.linalg.norm(nearest - repeated, axis=-1).reshape(len(flat), count)
    return gaps.min(axis=1).reshape(points.shape[:-1])


@each_shape
def test_a_shape_stops_where_its_distance_to_a_mesh_or_heightfield_is_its_radius(half):
    on_mesh, on_field = (swept(ground, centres(300), RADIUS, half) for ground in (mesh(), field()))
    assert_close(on_field, on_mesh, 1e-9)
    hit, starts = jax.tree.map(lambda leaf: leaf[:40], on_mesh), centres(300)[:40]
    met = np.asarray(hit.found) > 0
    assert met.sum() > 20
    resting = ends(starts, hit)[met]
    gap = distances(axis_points(resting, half)).min(axis=0)
    # Between two points of the axis the capsule is nearer than from either.
    np.testing.assert_allclose(gap, RADIUS, rtol=0, atol=1e-9 if half is None else 2e-4)
    for fraction in (0.3, 0.7, 0.95, 0.999):
        above = axis_points(ends(starts, hit, fraction), half, 9)
        assert distances(above).min() > RADIUS - 1e-9
    touching = np.asarray(hit.point)[met]
    assert distances(touching).max() < 1e-9
    from_axis = touching + RADIUS * np.asarray(hit.normal)[met] - resting
    if half is not None:
        place = from_axis @ half / (half @ half)
        assert np.abs(place).max() <= 1 + 1e-9
        from_axis = from_axis - place[:, None] * half
    assert np.abs(from_axis).max() < 1e-9, "the normal leads from the contact to the axis"


@each_shape
def test_a_bilinear_heightfield_is_a_fine_mesh(half):
    coarse = field(0.4 * HEIGHTS, "bilinear")
    x, z = np.meshgrid(*[np.linspace(-2.0, 2.0, 8 * 32 + 1)] * 2)
    rays = terrain.cast(coarse, jnp.stack([x, 0 * x + 3.0, z], -1), REACH)
    fine = terrain.heightfield(rays.point[..., 1], 0.5 / 32, CORNER, interpolation="triangulated")
    shape = (0.2, half if half is None else 0.4 * half)
    ours, finer = (swept(g, 0.7 * centres(24) + UP, *shape) for g in (coarse, fine))
    assert (np.asarray(ours.found) > 0).all()
    # A cell of 1/32 of the size is as good as flat: within the twist over 4 * 32², 0.2 mm.
    np.testing.assert_allclose(ours.distance, finer.distance, rtol=0, atol=3e-4)


@each_shape
def test_a_plane_is_met_by_the_lowest_point(half):
    normal = unit(np.array([0.3, 1.0, -0.2]))
    hit = swept(terrain.plane(normal=normal), centres(20), RADIUS, half)
    lowest = (axis_points(ends(centres(20), hit), half) @ normal).min(axis=0)
    np.testing.assert_allclose(lowest, RADIUS, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.asarray(hit.point) @ normal, 0.0, rtol=0, atol=1e-12)


def test_a_shape_on_a_function_rests_as_on_the_ball_or_the_plane_that_it_is():
    def ball(x, z):
        inside = 1.0 - x * x - z * z
        return jnp.where(inside > 0.01, jnp.sqrt(jnp.maximum(inside, 0.01)), jnp.nan)

    starts = 0.3 * centres(50) + [0, 2.0, 0]
    hit = swept(terrain.function(ball), starts, RADIUS)
    away = np.sum(starts[:, ::2] ** 2, axis=1)
    expected = starts[:, 1] - np.sqrt((1 + RADIUS) ** 2 - away)
    np.testing.assert_allclose(hit.distance, expected, rtol=0, atol=1e-5)
    np.testing.assert_allclose(hit.normal, ends(starts, hit) / (1 + RADIUS), rtol=0, atol=3e-3)
    slope = terrain.function(lambda x, z: 0.2 * z - 0.3 * x)
    plane = terrain.plane(normal=(0.3, 1.0, -0.2))
    for half in (HALF, HALF * [1, 1, -1], HALF * [-1, -1, 1]):
        ours, exact = (swept(ground, centres(20), RADIUS, half) for ground in (slope, plane))
        assert_close(ours, exact, 1e-9)


def test_an_upright_edge_is_met_at_its_upper_end_whichever_end_it_starts_from():
    aside, start, radius = 0.06, 0.2, jnp.asarray(0.1)
    for fall in (0.4, -0.4, -1.5):
        edge, along = (map(jnp.asarray, x) for x in ((aside, start, 0.0), (0.0, fall, 0.0)))
        rest, place = shapes.on_edge(tuple(edge), tuple(along), radius)  # type: ignore[arg-type]
        top = max(start, start + fall)
        np.testing.assert_allclose(rest.height, top + 0.08, rtol=0, atol=1e-12)
        np.testing.assert_allclose(rest.contact, (aside, top, 0.0), rtol=0, atol=1e-12)
        assert place == float(fall > 0)


@functools.cache
def grating() -> terrain.Terrain:
    """Boxes 10 cm wide with gaps of 5 cm, 1 m above a floor."""
    bars = arrays([box((4.0, 0.1, 0.1), (0.0, 0.95, 0.15 * place)) for place in range(-5, 6)])
    return sweep.sweepable(terrain.combine(terrain.mesh(*bars), terrain.plane()), 0.3)


def test_a_sphere_does_not_fall_through_a_grating_nor_meet_a_face_that_it_overlaps():
    z = np.linspace(-0.3, 0.3, 61)
    starts = np.stack([0 * z, 0 * z + 2.0, z], -1)
    hit = swept(grating(), starts, 0.05)
    from_bar = np.maximum(np.abs((z + 0.075) % 0.15 - 0.075) - 0.05, 0.0)
    expected = 1.0 + np.sqrt(0.05**2 - from_bar**2)
    np.testing.assert_allclose(2.0 - np.asarray(hit.distance), expected, rtol=0, atol=1e-9)
    through = swept(grating(), starts, 0.02)
    assert (np.asarray(through.distance) > 1.9).any(), "a smaller one does"
    starts[:3] = [[0.0, 0.95, 0.08], [0.0, 1.02, 0.0], [0.0, 1.05, 0.0]]
    hit = swept(grating(), starts, 0.05)
    np.testing.assert_allclose(hit.point[:2, 1], 0.9, rtol=0, atol=1e-12)  # the next face
    assert float(hit.found[2]) == 1 and abs(float(hit.distance[2])) < 1e-6


@pytest.mark.parametrize("interpolation", ["bilinear", "triangulated"])
def test_a_shape_in_or_beside_the_ground_meets_nothing(interpolation):
    """Also in the first cell, whose number is 0."""
    ground = terrain.heightfield(jnp.zeros((3, 3)), 1.0, interpolation=interpolation)
    centres = np.array([[x, 0.02, z] for x in (0.5, 1.5) for z in (0.5, 1.5)])
    assert not np.asarray(swept(ground, centres, 0.1).found).any()
    assert np.asarray(swept(ground, centres + 0.3 * UP, 0.1).found).all()
    plate = terrain.heightfield(jnp.zeros((2, 2)), 1.0)
    hit = swept(plate, np.array([[0.5, 9.5, 0.5], [3.0, 2.0, 0.5]]), 0.2)
    np.testing.assert_array_equal(hit.found, 0.0)
    np.testing.assert_array_equal(hit.distance, REACH)
    np.testing.assert_allclose(hit.point, [[0.5, 0.5, 0.5], [3.0, -7.0, 0.5]], atol=1e-12)
    np.testing.assert_array_equal(hit.normal, [UP] * 2)


def test_a_shape_that_starts_at_rest_high_up_has_come_no_way():
    """Heights there are rounded by more than those at the origin."""
    ground, starts = field(HEIGHTS + 300.0), 0.7 * centres(60) + 300 * UP
    again = swept(ground, ends(starts, swept(ground, starts, RADIUS)), RADIUS)
    np.testing.assert_array_equal(again.found, 1.0)
    np.testing.assert_allclose(again.distance, 0.0, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    "half",
    [pytest.param(None, id="sphere"), pytest.param(HALF, id="capsule", marks=pytest.mark.slow)],
)
def test_gradients_are_those_of_differences(half):
    ground = field(HEIGHTS[::-1], "bilinear") if half is None else mesh()
    step = 1e-6

    def distance(start, radius):
        return sweep.sweep(ground, start, radius, REACH, half_ws=half).distance

    @functools.partial(jax.jit, compiler_options=QUICK)
    def slopes_and_moved(starts):
        slopes = jax.vmap(jax.grad(distance, (0, 1)), (0, None))(starts, jnp.asarray(RADIUS))
        moves = step * jnp.concatenate([jnp.eye(4), -jnp.eye(4)])
        moved = jax.vmap(lambda move: distance(starts + move[:3], RADIUS + move[3]))(moves)
        return slopes, (moved[:4] - moved[4:]) / (2 * step)

    starts = 0.7 * centres(4, seed=4) + [0, 0.5, 0]
    (by_start, by_radius), differences = slopes_and_moved(starts)
    np.testing.assert_allclose(by_start.T, differences[:3], atol=2e-3)
    np.testing.assert_allclose(by_radius, differences[3], atol=2e-3)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_gradients_are_finite_everywhere_in_both_precisions(dtype):
    floats, rest = eqx.partition(grating(), eqx.is_inexact_array)
    ground = eqx.combine(jax.tree.map(lambda x: x.astype(dtype), floats), rest)
    z = jnp.linspace(-0.3, 0.3, 121, dtype=dtype)
    starts = jnp.stack([0 * z, 0 * z + 2, z], -1)

    def total(starts, radius):
        hit = sweep.sweep(ground, starts, radius, REACH)
        return hit.distance.sum() + hit.normal.sum() + hit.point.sum()

    slopes = jax.jit(jax.grad(total, (0, 1)), compiler_options=QUICK)
    gradients = slopes(starts, jnp.asarray(0.025, dtype))
    assert all(np.isfinite(gradient).all() for gradient in gradients)
    assert gradients[0].dtype == dtype


def test_batches_of_capsules_meet_what_each_meets():
    ground, starts = field(HEIGHTS[::-1], "bilinear"), jnp.asarray(centres(12).reshape(3, 4, 3))

    def single(start):
        return sweep.sweep(ground, start, RADIUS, REACH, half_ws=jnp.asarray(HALF))

    batched = jax.jit(lanes(jax.vmap(single)), compiler_options=QUICK)(starts)
    assert_close(batched, swept(ground, starts, RADIUS, jnp.asarray(HALF)), 1e-9)


def test_layers_platforms_and_ups_are_those_of_rays():
    low, high = terrain.plane(layer=3), terrain.plane((0.0, 1.0, 0.0), layer=5)
    both = terrain.combine(low, terrain.moving(high, 0))
    pose = Transform(jnp.array([[0.0, 0.5, 0.0]]), jnp.array([[1.0, 0.0, 0.0, 0.0]]))
    masks = jnp.asarray([terrain.ALL_LAYERS, terrain.layer_mask(3)], jnp.uint32)
    hit = sweep.sweep(both.at(pose), jnp.asarray([[0.0, 4.0, 0.0]] * 2), 0.1, REACH, masks)
    assert hit.platform is not None and hit.platform.tolist() == [0, -1]
    np.testing.assert_allclose(hit.distance, [2.4, 3.9])
    sideways = terrain.plane(normal=(1.0, 0.0, 0.0), up=(1.0, 0.0, 0.0))
    legs = terrain.LegTerrains(low, (low, sideways))
    hit = sweep.sweep(legs, jnp.array([[0.0, 1.0, 0.0], [2.0, 0.0, 0.0]]), 0.1, REACH)
    np.testing.assert_allclose(hit.distance, [0.9, 1.9], rtol=0, atol=1e-6)


def test_an_unprepared_mesh_and_a_bad_margin_are_refused():
    ground = every_kind()
    with pytest.raises(ValueError, match="sweepable"):
        sweep.sweep(ground, jnp.zeros(3), 0.1, REACH)
    with pytest.raises(ValueError, match="above 0"):
        sweep.sweepable(ground, 0.0)
