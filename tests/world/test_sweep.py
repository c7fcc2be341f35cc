"""Sweeps: agreement with trimesh's distances and with formulas, gradients, batches, layers."""

import functools

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

REACH = 9.0
RADIUS = 0.3
HALF = np.array([0.25, 0.05, -0.4])


@functools.partial(jax.jit, compiler_options=QUICK)
def swept(ground, centres, radius, half=None):
    return sweep.sweep(ground, centres, radius, REACH, half_ws=half)


def rough(count: int = 9, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Heights on a regular grid of 4 m by 4 m, and the two triangles of each of its cells."""
    rng = np.random.default_rng(seed)
    heights = rng.uniform(-0.5, 0.5, (count, count))
    place = np.linspace(-2.0, 2.0, count)
    vertices = np.stack(
        [np.broadcast_to(place, (count, count)), heights, np.repeat(place[:, None], count, 1)], -1
    ).reshape(-1, 3)
    a = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).reshape(-1)
    triangles = np.concatenate(
        [np.stack([a, a + count, a + count + 1], -1), np.stack([a, a + 1, a + count + 1], -1)]
    )
    return heights, vertices, triangles


def centres(count: int, seed: int = 1) -> np.ndarray:
    """Starts over the rough ground and a little beyond, m."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-2.4, 2.4, (count, 3)) * [1, 0, 1] + [0, 3.0, 0]


def axis_points(centre: np.ndarray, half: np.ndarray | None, count: int = 81) -> np.ndarray:
    """Points on the axis of each shape, (count, shapes, 3), m."""
    if half is None:
        return centre[None]
    return centre + np.linspace(-1.0, 1.0, count)[:, None, None] * half


def distances(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """To the mesh, m."""
    flat, count = points.reshape(-1, 3), len(mesh.triangles)
    corners, repeated = np.tile(mesh.triangles, (len(flat), 1, 1)), np.repeat(flat, count, axis=0)
    nearest = trimesh.triangles.closest_point(corners, repeated)
    gaps = np.linalg.norm(nearest - repeated, axis=-1).reshape(len(flat), count)
    return gaps.min(axis=1).reshape(points.shape[:-1])


def half_of(capsule: bool) -> np.ndarray | None:
    return HALF if capsule else None


# Against trimesh.


@pytest.mark.parametrize("capsule", [False, True], ids=["sphere", "capsule"])
def test_a_shape_stops_where_its_distance_to_the_mesh_is_its_radius(capsule):
    _, vertices, triangles = rough()
    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    ground = sweep.sweepable(terrain.mesh(vertices, triangles), RADIUS + 0.5)
    starts = centres(40)
    hit = swept(ground, starts, RADIUS, half_of(capsule))
    met = np.asarray(hit.found) > 0
    assert met.sum() > 20
    resting = starts - np.asarray(hit.distance)[:, None] * [0, 1, 0]
    gap = distances(mesh, axis_points(resting[met], half_of(capsule))).min(axis=0)
    # Between two points of the axis the capsule is nearer than from either.
    np.testing.assert_allclose(gap, RADIUS, rtol=0, atol=2e-4 if capsule else 1e-9)
    for fraction in (0.3, 0.7, 0.95, 0.999):
        above = starts - fraction * np.asarray(hit.distance)[:, None] * [0, 1, 0]
        assert distances(mesh, axis_points(above, half_of(capsule), 9)).min() > RADIUS - 1e-9
    touching = np.asarray(hit.point)[met]
    assert distances(mesh, touching).max() < 1e-9
    from_axis = touching + RADIUS * np.asarray(hit.normal)[met] - resting[met]
    if capsule:
        place = from_axis @ HALF / (HALF @ HALF)
        assert np.abs(place).max() <= 1 + 1e-9
        from_axis = from_axis - place[:, None] * HALF
    assert np.abs(from_axis).max() < 1e-9, "the normal leads from the contact to the axis"


@pytest.mark.parametrize("capsule", [False, True], ids=["sphere", "capsule"])
def test_a_triangulated_heightfield_is_a_mesh(capsule):
    heights, vertices, triangles = rough()
    field = terrain.heightfield(heights, 0.5, (-2.0, 0.0, -2.0), interpolation="triangulated")
    ground = sweep.sweepable(terrain.mesh(vertices, triangles), RADIUS + 0.5)
    shape = (RADIUS, half_of(capsule))
    ours, mesh = (swept(g, centres(300), *shape) for g in (field, ground))
    np.testing.assert_array_equal(ours.found, mesh.found)
    for name in ("distance", "point", "normal"):
        np.testing.assert_allclose(getattr(ours, name), getattr(mesh, name), rtol=0, atol=1e-9)


@pytest.mark.parametrize("capsule", [False, True], ids=["sphere", "capsule"])
def test_a_bilinear_heightfield_is_a_fine_mesh(capsule):
    heights, _, _ = rough()
    coarse = terrain.heightfield(0.4 * heights, 0.5, (-2.0, 0.0, -2.0))
    fine_place = np.linspace(-2.0, 2.0, 8 * 32 + 1)
    x, z = np.meshgrid(fine_place, fine_place)
    rays = terrain.cast(coarse, jnp.stack([x, 0 * x + 3.0, z], -1), REACH)
    fine = terrain.heightfield(
        rays.point[..., 1], 0.5 / 32, (-2.0, 0.0, -2.0), interpolation="triangulated"
    )
    shape = (0.2, 0.4 * HALF if capsule else None)
    ours, finer = (swept(g, 0.7 * centres(24) + [0, 1, 0], *shape) for g in (coarse, fine))
    assert (np.asarray(ours.found) > 0).all()
    # A cell of 1/32 of the size is as good as flat: within the twist over 4 * 32², 0.2 mm.
    np.testing.assert_allclose(ours.distance, finer.distance, rtol=0, atol=3e-4)


# Against formulas.


def test_a_sphere_on_a_function_rests_as_on_a_ball():
    def ball(x, z):
        inside = 1.0 - x * x - z * z
        return jnp.where(inside > 0.01, jnp.sqrt(jnp.maximum(inside, 0.01)), jnp.nan)

    starts = 0.3 * centres(50) + [0, 2.0, 0]
    hit = swept(terrain.function(ball), starts, RADIUS)
    away = np.sum(starts[:, ::2] ** 2, axis=1)
    expected = starts[:, 1] - np.sqrt((1 + RADIUS) ** 2 - away)
    np.testing.assert_allclose(hit.distance, expected, rtol=0, atol=1e-5)
    over = starts - np.asarray(hit.distance)[:, None] * [0, 1, 0]
    np.testing.assert_allclose(hit.normal, over / (1 + RADIUS), rtol=0, atol=3e-3)


@pytest.mark.parametrize("capsule", [False, True], ids=["sphere", "capsule"])
def test_a_plane_is_met_by_the_lowest_point(capsule):
    slope = terrain.plane(normal=(0.3, 1.0, -0.2))
    hit = swept(slope, centres(20), RADIUS, half_of(capsule))
    normal = np.array([0.3, 1.0, -0.2]) / np.linalg.norm([0.3, 1.0, -0.2])
    resting = centres(20) - np.asarray(hit.distance)[:, None] * [0, 1, 0]
    lowest = (axis_points(resting, half_of(capsule)) @ normal).min(axis=0)
    np.testing.assert_allclose(lowest, RADIUS, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.asarray(hit.point) @ normal, 0.0, rtol=0, atol=1e-12)


def test_a_capsule_on_a_function_that_is_a_plane_rests_as_on_the_plane():
    slope = terrain.function(lambda x, z: 0.2 * z - 0.3 * x)
    plane = terrain.plane(normal=(0.3, 1.0, -0.2))
    for half in (HALF, HALF * [1, 1, -1], HALF * [-1, -1, 1]):
        ours, exact = (swept(ground, centres(20), RADIUS, half) for ground in (slope, plane))
        for name in ("distance", "point", "normal"):
            np.testing.assert_allclose(getattr(ours, name), getattr(exact, name), atol=1e-9)


@pytest.mark.parametrize("fall", [0.4, -0.4, -1.5])
def test_an_upright_edge_is_met_at_its_upper_end(fall):
    """Whichever end it starts from."""
    aside, start, radius = 0.06, 0.2, jnp.asarray(0.1)
    edge, along = (map(jnp.asarray, x) for x in ((aside, start, 0.0), (0.0, fall, 0.0)))
    rest, place = shapes.on_edge(tuple(edge), tuple(along), radius)  # type: ignore[arg-type]
    top = max(start, start + fall)
    np.testing.assert_allclose(rest.height, top + 0.08, rtol=0, atol=1e-12)
    np.testing.assert_allclose(rest.contact, (aside, top, 0.0), rtol=0, atol=1e-12)
    assert place == float(fall > 0)


def box_grid() -> terrain.Terrain:
    """A grating: boxes 10 cm wide with gaps of 5 cm, 1 m above a floor."""
    boxes = []
    for place in np.arange(-5, 6) * 0.15:
        box = trimesh.creation.box((4.0, 0.1, 0.1))
        box.apply_translation((0.0, 0.95, place))
        boxes.append(box)
    mesh = trimesh.util.concatenate(boxes)
    assert isinstance(mesh, trimesh.Trimesh)
    bars = terrain.mesh(np.array(mesh.vertices), np.array(mesh.faces))
    return sweep.sweepable(terrain.combine(bars, terrain.plane()), 0.3)


def test_a_sphere_does_not_fall_through_a_grating():
    z = np.linspace(-0.3, 0.3, 61)
    starts = np.stack([0 * z, 0 * z + 2.0, z], -1)
    hit = swept(box_grid(), starts, 0.05)
    from_bar = np.maximum(np.abs((z + 0.075) % 0.15 - 0.075) - 0.05, 0.0)
    expected = 1.0 + np.sqrt(0.05**2 - from_bar**2)
    np.testing.assert_allclose(2.0 - np.asarray(hit.distance), expected, rtol=0, atol=1e-9)
    through = swept(box_grid(), starts, 0.02)
    assert (np.asarray(through.distance) > 1.9).any(), "a smaller one does"


def test_a_face_that_a_shape_overlaps_at_its_start_is_not_met_but_the_next_is():
    hit = swept(box_grid(), np.array([[0.0, 0.95, 0.08], [0.0, 1.02, 0.0]]), 0.05)
    np.testing.assert_allclose(hit.point[:, 1], 0.9, rtol=0, atol=1e-12)


@pytest.mark.parametrize("interpolation", ["bilinear", "triangulated"])
def test_a_shape_in_the_ground_of_any_cell_meets_nothing(interpolation):
    """Also in the first cell, whose number is 0."""
    ground = terrain.heightfield(jnp.zeros((3, 3)), 1.0, interpolation=interpolation)
    centres = np.array([[x, 0.02, z] for x in (0.5, 1.5) for z in (0.5, 1.5)])
    assert not np.asarray(swept(ground, centres, 0.1).found).any()
    assert np.asarray(swept(ground, centres + np.array([0.0, 0.3, 0.0]), 0.1).found).all()


def test_a_shape_that_starts_at_rest_has_come_no_way():
    hit = swept(box_grid(), np.array([[0.0, 1.05, 0.0]]), 0.05)
    assert float(hit.found[0]) == 1 and abs(float(hit.distance[0])) < 1e-6


def test_a_shape_that_starts_at_rest_high_up_has_come_no_way():
    """Heights there are rounded by more than those at the origin."""
    heights, starts = rough()[0] + 300.0, 0.7 * centres(60) + [0, 300, 0]
    ground = terrain.heightfield(heights, 0.5, (-2.0, 0.0, -2.0), interpolation="triangulated")
    resting = starts - np.asarray(swept(ground, starts, RADIUS).distance)[:, None] * [0, 1, 0]
    again = swept(ground, resting, RADIUS)
    np.testing.assert_array_equal(again.found, 1.0)
    np.testing.assert_allclose(again.distance, 0.0, rtol=0, atol=1e-12)


def test_a_miss_has_the_end_of_the_way_as_point_and_up_as_normal():
    plate = terrain.heightfield(jnp.zeros((2, 2)), 1.0)
    hit = swept(plate, np.array([[0.5, 9.5, 0.5], [3.0, 2.0, 0.5]]), 0.2)
    np.testing.assert_array_equal(hit.found, 0.0)
    np.testing.assert_array_equal(hit.distance, REACH)
    np.testing.assert_allclose(hit.point, [[0.5, 0.5, 0.5], [3.0, -7.0, 0.5]], atol=1e-12)
    np.testing.assert_array_equal(hit.normal, [[0, 1, 0]] * 2)


# Transformations.


def ground_of_all() -> terrain.Terrain:
    """Every kind of surface at once."""
    heights, vertices, triangles = rough()
    return terrain.combine(
        sweep.sweepable(terrain.mesh(vertices, triangles), 1.0),
        terrain.heightfield(heights[::-1], 0.5, (-2.0, 0.0, -2.0)),
        terrain.heightfield(heights.T, 0.5, (-2.0, 0.0, -2.0), interpolation="triangulated"),
        terrain.function(lambda x, z: 0.3 * jnp.sin(3 * x) * jnp.cos(2 * z)),
        terrain.plane((0.0, -0.4, 0.0), (0.1, 1.0, 0.1)),
    )


@functools.partial(jax.jit, compiler_options=QUICK)
def slopes(ground, start, half):
    """Distance, and its gradient by start and radius in reverse mode."""

    def distance(start, radius):
        return sweep.sweep(ground, start, radius, REACH, half_ws=half).distance

    return jax.value_and_grad(distance, (0, 1))(start, jnp.asarray(RADIUS))


@pytest.mark.slow
@pytest.mark.parametrize("capsule", [False, True], ids=["sphere", "capsule"])
def test_gradients_are_those_of_differences(capsule):
    ground, half = ground_of_all(), half_of(capsule)
    for start in 0.7 * centres(4, seed=4) + [0, 0.5, 0]:
        _, (by_start, by_radius) = slopes(ground, start, half)
        step = 1e-6
        moves = [start + sign * step * axis for axis in np.eye(3) for sign in (1, -1)]
        values = np.array([slopes(ground, move, half)[0] for move in moves]).reshape(3, 2)
        np.testing.assert_allclose(by_start, (values[:, 0] - values[:, 1]) / (2 * step), atol=2e-3)
        wider, narrower = (
            swept(ground, start, RADIUS + sign * step, half).distance for sign in (1, -1)
        )
        np.testing.assert_allclose(by_radius, (wider - narrower) / (2 * step), atol=2e-3)


def test_gradients_are_finite_everywhere_in_both_precisions():
    for dtype in (jnp.float32, jnp.float64):
        ground = jax.tree.map(
            lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x,  # noqa: B023
            box_grid(),
        )
        z = jnp.linspace(-0.3, 0.3, 121, dtype=dtype)
        starts = jnp.stack([0 * z, 0 * z + 2, z], -1)

        def total(starts, radius):
            hit = sweep.sweep(ground, starts, radius, REACH)  # noqa: B023
            return hit.distance.sum() + hit.normal.sum() + hit.point.sum()

        gradients = jax.jit(jax.grad(total, (0, 1)), compiler_options=QUICK)(
            starts, jnp.asarray(0.025, dtype)
        )
        assert all(np.isfinite(gradient).all() for gradient in gradients)
        assert gradients[0].dtype == dtype


@pytest.mark.slow
def test_batches_of_any_kind_give_the_same():
    ground, starts = ground_of_all(), jnp.asarray(centres(12).reshape(3, 4, 3))

    def one(start):
        return sweep.sweep(ground, start, RADIUS, REACH, half_ws=jnp.asarray(HALF))

    whole = swept(ground, starts, RADIUS, jnp.asarray(HALF))
    for batched in (jax.vmap(jax.vmap(one)), lanes(jax.vmap(one))):
        for ours, theirs in zip(
            jax.tree.leaves(jax.jit(batched, compiler_options=QUICK)(starts)),
            jax.tree.leaves(whole),
            strict=True,
        ):
            np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9)


def test_layers_platforms_and_ups_are_those_of_rays():
    low, high = terrain.plane(layer=3), terrain.plane((0.0, 1.0, 0.0), layer=5)
    both = terrain.combine(low, terrain.moving(high, 0))
    pose = Transform(jnp.array([[0.0, 0.5, 0.0]]), jnp.array([[1.0, 0.0, 0.0, 0.0]]))
    start = jnp.array([0.0, 4.0, 0.0])
    hit = sweep.sweep(both.at(pose), start, 0.1, REACH)
    assert hit.platform is not None and int(hit.platform) == 0
    assert float(hit.distance) == pytest.approx(2.4)
    hit = sweep.sweep(both.at(pose), start, 0.1, REACH, terrain.layer_mask(3))
    assert hit.platform is not None and int(hit.platform) == -1
    assert float(hit.distance) == pytest.approx(3.9)
    sideways = terrain.plane(normal=(1.0, 0.0, 0.0), up=(1.0, 0.0, 0.0))
    legs = terrain.LegTerrains(low, (low, sideways))
    hit = sweep.sweep(legs, jnp.array([[0.0, 1.0, 0.0], [2.0, 0.0, 0.0]]), 0.1, REACH)
    np.testing.assert_allclose(hit.distance, [0.9, 1.9], rtol=0, atol=1e-6)


def test_an_unprepared_mesh_and_a_bad_margin_are_refused():
    _, vertices, triangles = rough()
    ground = terrain.mesh(vertices, triangles)
    with pytest.raises(ValueError, match="sweepable"):
        sweep.sweep(ground, jnp.zeros(3), 0.1, REACH)
    with pytest.raises(ValueError, match="above 0"):
        sweep.sweepable(ground, 0.0)
