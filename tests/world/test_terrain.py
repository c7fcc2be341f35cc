"""Terrain: agreement with Embree, no leaks, gradients, layers, batches, merging, and platforms."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

import jaxik
from jaxik import lanes
from jaxik.world import cells, terrain
from jaxik.world.surfaces import Mesh
from support import meshes
from support.clips import assert_close
from support.gradients import unit
from support.meshes import EMBREE, UP, Arrays, against_embree, arrays, cast, lattice, rough, turned

WALL = np.array([[-1.0, 0, 0], [1, 0, 0], [0, 2, 0]])
TRIANGLE = np.array([[0, 1, 2]])
RAYS = 21_000


def stepped() -> Arrays:
    """Boxes of different heights side by side: level tops and vertical walls."""
    heights = np.random.default_rng(1).uniform(0.1, 1.0, (8, 8))
    boxes = (
        meshes.box((1, high, 1), (x - 3.5, high / 2, z - 3.5))
        for (x, z), high in np.ndenumerate(heights)
    )
    return arrays(list(boxes))


def overhanging() -> Arrays:
    """Spheres and a ring above and inside each other: several surfaces over one point."""
    ring = trimesh.creation.torus(2.5, 0.6)
    ball = trimesh.creation.icosphere(subdivisions=3, radius=1.5)
    small = trimesh.creation.icosphere(subdivisions=2, radius=0.7)
    small.apply_translation((0.2, 2.5, -0.3))
    return arrays([ring, ball, small])


def degenerate() -> Arrays:
    """Rough ground with points, lines, needles, walls and duplicate triangles mixed in."""
    vertices, triangles = rough(20, seed=2)
    rng = np.random.default_rng(3)
    chosen = triangles[rng.choice(len(triangles), 60, replace=False)]
    points, lines = chosen[:20, [0, 0, 0]], chosen[20:40, [0, 1, 1]]
    needle = np.array([[-4.0, 2.0, -4.0], [4.0, 2.0, 4.0], [4.0, 2.0, 4.0 + 1e-9]])
    wall = np.array([[-4.0, 0.0, 0.1], [4.0, 0.0, 0.1], [0.0, 3.0, 0.1]])
    corners = len(vertices) + np.arange(6).reshape(2, 3)
    added = points, triangles, lines, chosen[40:], corners
    return np.concatenate([vertices, needle, wall]), np.concatenate(added)


MESHES = {
    "rough": (rough, (0.3, 0.9, -0.2)),
    "stepped": (stepped, (0.3, 0.9, -0.2)),
    "level steps": (stepped, (0.0, 1.0, 0.0)),
    "overhanging": (overhanging, (1.0, 0.02, 0.01)),
    "degenerate": (degenerate, (0.0, -1.0, 0.0)),
}


@functools.cache
def mesh(name: str) -> tuple[terrain.Terrain, np.ndarray, np.ndarray, np.ndarray]:
    """The terrain of a mesh that is turned to its up, its vertices, its triangles and that up."""
    make, up = MESHES[name]
    vertices, triangles = make()
    up = turned(UP, np.array(up))
    vertices = turned(vertices, up)
    return terrain.mesh(vertices, triangles, up=up), vertices, triangles, up


@pytest.mark.parametrize("name", MESHES)
def test_random_rays_agree_with_embree(name):
    ground, vertices, triangles, up = mesh(name)
    # Half from above and half from among the surfaces.
    local = np.random.default_rng(5).uniform((-4.5, -1.0, -4.5), (4.5, 4.0, 4.5), (RAYS, 3))
    local[::2, 1] = 5.0
    origins = turned(local, up)
    hit = cast(ground, origins)
    compared = against_embree(hit, vertices, triangles, origins, up)
    assert compared.agree.mean() > 1 - 5e-4
    assert 0.1 < compared.hits.mean() < 0.999
    assert np.all(np.asarray(hit.normal) @ up >= 0)
    np.testing.assert_allclose(np.linalg.norm(hit.normal, axis=-1), 1.0, atol=1e-12)
    np.testing.assert_allclose(hit.point, origins - np.outer(hit.distance, up), atol=1e-12)


@pytest.mark.parametrize("name", ["rough", "rough in 32 bits", "stepped in 32 bits", "overhanging"])
def test_no_ray_passes_through_an_edge_or_a_corner(name):
    name, in_32_bits, _ = name.partition(" in 32 bits")
    dtype = np.float32 if in_32_bits else np.float64
    ground, vertices, triangles, up = mesh(name)
    if in_32_bits:
        ground = terrain.mesh(vertices.astype(dtype), triangles, up=up)
    corners = vertices[triangles]
    weight = np.random.default_rng(6).uniform(size=(len(corners), 3, 1))
    edges = weight * corners + (1 - weight) * np.roll(corners, -1, axis=1)
    points = np.concatenate([corners.reshape(-1, 3), edges.reshape(-1, 3), corners.mean(axis=1)])
    # Keep off the outline, which a rounded ray may rightly miss.
    back = turned(np.eye(3), up)
    local, extent = points @ back.T, 0.999 * np.abs(vertices @ back.T).max(axis=0)
    inner = (np.abs(local) < extent)[:, [0, 2]].all(axis=1)
    if name == "overhanging":  # inside the ball's outline
        inner = np.hypot(local[:, 0], local[:, 2]) < 1.49
    assert inner.sum() > 1000
    chosen = np.resize(np.flatnonzero(inner), RAYS)  # as many as above, for the same program
    hit = cast(ground, np.asarray(points[chosen] + 6.0 * up, dtype))
    assert hit.point.dtype == dtype
    assert np.all(hit.found == 1.0)
    # Nor is something further down hit instead. (Not tested on the steps: a rounded ray may rightly
    # pass the edge of a top.)
    if name == "rough":
        assert np.all(np.asarray(hit.distance) <= 6.0 + (2e-4 if in_32_bits else 1e-9))
    if name == "overhanging":
        away = (local[chosen][:, ::2] ** 2).sum(axis=1)
        assert np.all(np.asarray(hit.point) @ up >= np.sqrt(np.maximum(1.47**2 - away, 0)))


def test_a_ray_onto_the_edge_of_a_step_hits_its_top_and_not_its_wall():
    ground, vertices, triangles, _ = mesh("level steps")
    tops = np.resize(vertices[triangles].reshape(-1, 3) + [0.0, 3.0, 0.0], (RAYS, 3))
    np.testing.assert_allclose(cast(ground, tops).normal, np.tile(UP, (RAYS, 1)), atol=1e-9)


def test_a_miss_has_the_end_of_the_ray_as_point_and_up_as_normal():
    origins = jnp.array([[0.0, 3.0, 0.0], [99.0, 3.0, 0.0], [0.0, -3.0, 0.0], [jnp.nan] * 3])
    for ground in (
        terrain.mesh(*rough(4)),
        terrain.plane((0.0, -2.5, 0.0)),
        terrain.heightfield(np.zeros((3, 3)), 1.0, (-1.0, 0.0, -1.0)),
        terrain.mesh(WALL, TRIANGLE),
    ):
        hit = terrain.cast(ground, origins, jnp.array([0.5, 2.0, jnp.inf, 1.0]))
        np.testing.assert_array_equal(hit.found, 0.0)
        np.testing.assert_array_equal(hit.distance, [0.5, 2.0, terrain.HORIZON, 1.0])
        np.testing.assert_array_equal(hit.point[:3, 1], [2.5, 1.0, -3.0 - terrain.HORIZON])
        np.testing.assert_array_equal(hit.normal, np.tile(UP, (4, 1)))


def test_a_plane_is_hit_from_both_sides_and_from_itself_within_reach_but_never_edge_on():
    origin = jnp.array([1.0, 2.0, 0.0])
    for sign in (1.0, -1.0):
        hit = terrain.cast(terrain.plane(normal=(-sign, sign, 0.0)), origin, 9.0)
        np.testing.assert_allclose(hit.point, [1.0, 1.0, 0.0], atol=1e-15)
        np.testing.assert_allclose(hit.normal, np.array([-1.0, 1.0, 0.0]) / np.sqrt(2), atol=1e-15)
    assert terrain.cast(terrain.plane(normal=(1.0, 0.0, 0.0)), origin, 9.0).found == 0.0
    origins = jnp.broadcast_to(jnp.asarray(UP), (2, 3, 3))
    hit = terrain.cast(terrain.plane(), origins, jnp.array([0.5, 1.0, 2.0]))
    np.testing.assert_array_equal(hit.found, [[0.0, 1.0, 1.0]] * 2)
    np.testing.assert_array_equal(hit.distance, [[0.5, 1.0, 1.0]] * 2)
    # A ray that starts on it hits it, whatever is rounded.
    rng = np.random.default_rng(3)
    for rise in (0.9, 0.02):  # slanted, and steep
        normal = unit(np.array([0.3, rise, -0.2]))
        for distance in (1.0, 1e2, 1e4):
            point = distance * rng.normal(size=3)
            offsets = distance * rng.normal(size=(2000, 3))
            origins = point + offsets - (offsets @ normal)[:, None] * normal  # on it, but rounded
            ground = terrain.plane(np.float32(point), np.float32(normal))
            above = np.sign(origins.astype(np.float32) @ normal - point.astype(np.float32) @ normal)
            assert (above < 0).mean() > 0.1, "no ray starts a little below"
            for starts, found in ((origins, 1.0), (origins - 1e-5 * distance * normal, 0.0)):
                hit = terrain.cast(ground, jnp.asarray(starts, jnp.float32), 1.0)
                assert np.all(hit.found == found), (rise, distance)


def test_a_ray_hits_the_nearest_surface_on_the_layers_of_its_mask():
    origins = jnp.asarray(np.random.default_rng(7).uniform(-2.2, 2.2, (300, 3))).at[:, 1].set(9.0)
    subsets = [(0,), (1,), (2,), (3,), (4,), (0, 1), (1, 3), (2, 4), (0, 1, 2, 3, 4), (7, 31), ()]
    masks = jnp.asarray([terrain.layer_mask(*layers) for layers in subsets], jnp.uint32)
    hit = terrain.cast(meshes.every_kind(layered=True), origins, 99.0, masks[:, None])
    heights = np.where(hit.found > 0, hit.point[..., 1], -np.inf)
    for layers, actual in zip(subsets, heights, strict=True):
        there = [layer for layer in layers if layer < 5]
        np.testing.assert_array_equal(actual, heights[there].max(axis=0, initial=-np.inf))
    nearest = heights[:5].argmax(axis=0)
    assert set(nearest[np.isfinite(heights[:5]).all(axis=0)]) >= {0, 1, 2, 3}
    x, _, z = np.asarray(origins).T
    np.testing.assert_allclose(heights[3], 0.3 * np.sin(3 * x) * np.cos(2 * z), atol=1e-12)
    np.testing.assert_allclose(heights[4], -0.4 - 0.1 * (x + z), atol=1e-12)
    # Each triangle of a mesh has its own.
    vertices, triangles = rough(4)
    corners = np.concatenate([vertices, vertices + [0.0, 3.0, 0.0]])
    both = np.concatenate([triangles, triangles + len(vertices)])
    ground = terrain.mesh(corners, both, layer=np.repeat([0, 31], len(triangles)))
    masks = jnp.array([1, 1 << 31, 8], jnp.uint32)
    hit = terrain.cast(ground, jnp.array([0.1, 9.0, 0.2]), 99.0, masks)
    np.testing.assert_array_equal(hit.found, [1.0, 1.0, 0.0])
    np.testing.assert_allclose(hit.point[1, 1] - hit.point[0, 1], 3.0, atol=1e-12)


def test_gradients_in_the_origin_and_the_vertices_match_finite_differences():
    vertices, triangles = rough(6)
    up = unit(np.array([0.3, 0.9, -0.2]))
    vertices, slope = turned(vertices, up), turned(np.array([0.3, 0.9, 0.1]), up)
    mesh = terrain.mesh(vertices, triangles, up=up, slack=1e-3)
    local = np.random.default_rng(9).uniform(-3.5, 3.5, (40, 3)) * [1, 0, 1] + [0, 4, 0]

    @jax.jit
    def hits(origins, vertices):
        plane = terrain.plane((0.0, 0.0, 0.0), slope, up)
        ground = terrain.combine(mesh.with_vertices(vertices), plane)
        hit = terrain.cast(ground, origins, jnp.inf)
        return hit.point, hit.normal, hit.distance

    arguments = jnp.asarray(turned(local, up)), jnp.asarray(vertices)
    check_grads(hits, arguments, 1, ["fwd", "rev"], eps=1e-6, atol=1e-6, rtol=1e-6)
    assert np.all(cast(mesh, arguments[0]).found == 1.0)


def test_gradients_are_finite_on_edges_corners_walls_and_misses():
    (vertices, triangles), (steps, sides) = degenerate(), stepped()
    ground = terrain.combine(
        terrain.mesh(vertices, triangles, slack=0.01),
        terrain.mesh(steps, sides),
        terrain.plane((0.0, -3.0, 0.0), (1.0, 0.0, 0.0)),
    )
    points = np.concatenate([vertices, steps])
    origins = jnp.asarray(np.concatenate([points, points + [0, 1, 0], points + [99, 0, 0]]))

    def total(inputs, scale=1.0):
        ground, origins, reach = inputs
        hit = terrain.cast(ground.with_vertices(vertices * scale), origins, reach)
        return sum(jnp.sum(jnp.sin(leaf)) for leaf in jax.tree.leaves(hit))

    @eqx.filter_jit
    def gradients(inputs):
        forward = jax.jacfwd(functools.partial(total, inputs))(jnp.ones(()))
        return eqx.filter_grad(total)(inputs), forward

    leaves = jax.tree.leaves(gradients((ground, origins, jnp.array(50.0))))
    assert len(leaves) > 8
    assert all(np.isfinite(leaf).all() for leaf in leaves)


def test_a_mesh_with_moved_vertices_equals_a_mesh_built_there():
    vertices, triangles = rough()
    rng = np.random.default_rng(10)
    moved = vertices + rng.uniform(-0.05, 0.05, vertices.shape)
    moved[:, 1] += rng.uniform(-1, 1, len(moved))  # movement along up is unlimited
    updated = terrain.mesh(vertices, triangles, slack=0.05).with_vertices(jnp.asarray(moved))
    rebuilt = terrain.mesh(moved, triangles)
    origins = rng.uniform(-4.2, 4.2, (RAYS, 3)) * [1, 0, 1] + [0, 5, 0]
    assert_close(cast(updated, origins), cast(rebuilt, origins), 1e-9)
    # A wall leans over within the slack.
    ground = terrain.mesh(WALL, TRIANGLE, slack=0.1)
    origin = jnp.array([0.0, 5.0, 0.05])
    assert terrain.cast(ground, origin, 9.0).found == 0.0
    leaning = jnp.asarray(WALL).at[2, 2].set(0.1)
    hit = terrain.cast(ground.with_vertices(leaning), origin, 9.0)
    np.testing.assert_allclose(hit.point, [0.0, 1.0, 0.05], atol=1e-12)


@pytest.mark.slow
def test_batches_over_terrains_masks_and_rays_equal_single_casts():
    vertices, triangles = rough(6)
    mesh = terrain.mesh(vertices, triangles, layer=np.arange(len(triangles)) % 3)
    others = meshes.every_kind()
    origins = jnp.asarray(np.random.default_rng(15).uniform(-3, 3, (3, 5, 3))).at[..., 1].set(5.0)
    lifts, masks = jnp.array([0.0, 0.5, 2.0]), jnp.array([1, 3, 7], jnp.uint32)

    def hits(lift, mask, origins):
        raised = mesh.with_vertices(jnp.asarray(vertices) + lift * UP)
        ground = terrain.combine(raised, others.moved(lift * UP))
        return terrain.cast(ground, origins, 9.0, mask)

    alone = map(jax.jit(hits), lifts, masks, origins)
    expected = jax.tree.map(lambda *leaves: jnp.stack(leaves), *alone)
    assert len(np.unique(np.round(expected.point[..., 1], 3))) > 10
    for batched in (jax.vmap(hits), lanes(hits, block=2)):
        assert_close(jax.jit(batched)(lifts, masks, origins), expected, 1e-12)


def test_float32_stays_float32_and_has_accurate_normals_far_from_the_origin():
    with jax.numpy_dtype_promotion("strict"):
        ground = meshes.every_kind(dtype=jnp.float32)
        hit = terrain.cast(ground, jnp.zeros((4, 3), jnp.float32), 3.0)
    assert {leaf.dtype for leaf in jax.tree.leaves(hit)} == {jnp.dtype(jnp.float32)}
    assert terrain.cast(ground, jnp.zeros((0, 3), jnp.float32), 1.0).point.shape == (0, 3)
    small = np.array([[0.0, 0, 0], [0, 0, 1], [1, 1, 0]]) * 1e-2 + [64.0, 0.0, 64.0]
    ground = terrain.mesh(small.astype(np.float32), TRIANGLE)
    hit = cast(ground, np.float32(small.mean(axis=0) + UP))
    np.testing.assert_allclose(hit.normal, np.array([-1.0, 1.0, 0.0]) / np.sqrt(2), atol=2e-3)


def test_an_uneven_mesh_keeps_its_lists_short():
    # A wide floor with a small detailed object, as in an animator's scene.
    floor = np.array([[-100.0, 0, -100], [100, 0, -100], [100, 0, 100], [-100, 0, 100]])
    vertices, triangles = rough(60)
    vertices = np.concatenate([floor, vertices * 0.02 + [30.0, 0.5, 30.0]])
    triangles = np.concatenate([[[0, 1, 2], [0, 2, 3]], triangles + 4])
    ground = terrain.mesh(vertices, triangles)
    (surface,) = ground.surfaces
    assert isinstance(surface, Mesh)
    grid = surface.grid
    assert grid.depth > 0
    assert np.diff(grid.first).max() <= 2 * cells.CROWD
    assert len(grid.members) < 20 * len(triangles) and len(grid.children) < 20 * len(triangles)
    local, wide = np.random.default_rng(12).uniform(-1, 1, (2, 4000, 3))
    origins = np.concatenate([0.09 * local + 30.0, 99.0 * wide])
    origins[:, 1] = 2.0
    hit = cast(ground, origins)
    assert np.all(hit.found == 1.0)
    assert (against_embree(hit, vertices, triangles, origins).off < EMBREE).mean() > 0.998
    # So does one whose triangles all lie on each other.
    lying = np.tile([[0.0, 0.0], [9.0, 0.0], [0.0, 9.0]], (300, 1, 1))
    lists = cells.build(lying, np.ones(300, bool), 0.0)
    assert 300 <= len(lists.members) < 2 * cells.ENTRIES * 300


def test_stacked_triangles_and_triangles_around_one_corner_are_found():
    sheet = np.array([[-1.0, 0, -1], [1, 0, -1], [0, 0, 2]])
    heights = np.linspace(0.0, 1.0, 300)
    stack = (sheet + heights[:, None, None] * UP).reshape(-1, 3)
    angles = np.linspace(0, 2 * np.pi, 500, endpoint=False)
    rim = np.stack([np.cos(angles), 0 * angles + 2.0, np.sin(angles)], -1)
    fan = np.stack([0 * np.arange(500), 1 + np.arange(500), 1 + np.roll(np.arange(500), -1)], -1)
    vertices = np.concatenate([stack, [[0.0, 2.5, 0.0]], rim])
    triangles = np.concatenate([np.arange(900).reshape(-1, 3), fan + 900])
    ground = terrain.mesh(vertices, triangles)
    inside = np.random.default_rng(13).uniform(-0.3, 0.3, (2000, 3))
    inside[:, 1] = 0.5
    highest = heights[heights <= 0.5].max()
    np.testing.assert_allclose(cast(ground, inside).point[:, 1], highest, atol=1e-12)
    inside[:, 1], inside[0] = 5.0, [0.0, 5.0, 0.0]
    radius = np.hypot(inside[:, 0], inside[:, 2])
    np.testing.assert_allclose(cast(ground, inside).point[:, 1], 2.5 - 0.5 * radius, atol=1e-4)


def bumps(seed: int, shape: tuple[int, int] = (5, 5), layer: int = 0) -> terrain.Terrain:
    """Triangles of random heights, a square metre or more."""
    heights = np.random.default_rng(seed).uniform(0, 0.2, shape)
    return terrain.mesh(*lattice(heights, 0.25), layer=layer)


@pytest.mark.slow
def test_rays_meet_each_of_several_merged_terrains_of_any_shape_where_it_was_put():
    raised = bumps(2, (7, 6), layer=3).moved(jnp.array([0.0, 1.0, 0.0]))
    grounds = bumps(1), raised, terrain.combine(bumps(3), bumps(4, (5, 9)))
    offsets = np.array([[0.0, 0.0, 0.0], [40.0, 0.5, -8.0], [-20.0, -0.3, 4.0]])
    merged = terrain.merge(grounds, offsets)
    points = np.random.default_rng(0).uniform([0, 3, 0], [1, 3, 1], (200, 3))
    for ground, offset in zip(grounds, offsets, strict=True):
        expected, hit = cast(ground, points), cast(merged, points + offset)
        assert expected.found.all()
        np.testing.assert_allclose(hit.point, expected.point + offset, atol=1e-5)
        np.testing.assert_allclose(hit.normal, expected.normal, atol=1e-5)
    assert not cast(merged, [20.0, 3.0, 0.0]).found
    over_second = jnp.asarray(points + offsets[1])
    assert not terrain.cast(merged, over_second, 9.0, terrain.layer_mask(0)).found.any()


def pose(pos: tuple[float, ...], turn: tuple[float, ...] = (0.0, 0.0, 0.0)) -> jaxik.Transform:
    """One platform, shifted by m and turned by a rotation vector, rad."""
    rot = Rotation.from_rotvec(turn).as_quat(scalar_first=True)
    return jaxik.Transform(jnp.asarray([pos], float), jnp.asarray(rot)[None])


SHIFTED, TURNED = pose((0.7, 1.5, -0.4)), pose((-1.0, 0.3, 2.0), (0.0, 0.8, 0.0))


TILTED = pose((0.5, 1.0, -0.3), (0.12, 0.6, -0.1))


ORIGINS = np.random.default_rng(7).uniform((-5.0, 4.0, -5.0), (5.0, 5.0, 5.0), (3000, 3))


def test_rays_hit_a_moved_mesh_where_embree_hits_its_copy():
    vertices, triangles = rough()
    for platform in (SHIFTED, TURNED, TILTED):
        tilts = platform is TILTED
        ground = terrain.moving(terrain.mesh(vertices, triangles), 0, tilts=tilts)
        hit = cast(ground.at(platform), ORIGINS)
        moved = np.asarray(platform.apply(jnp.asarray(vertices)))
        compared = against_embree(hit, moved, triangles, ORIGINS)
        np.testing.assert_array_equal(hit.platform, np.where(compared.hits, 0, -1))
        assert compared.both.mean() > 0.4
        off = compared.off[compared.both]
        if tilts:
            assert compared.both.sum() > 0.97 * compared.hits.sum()
            assert (off < EMBREE).mean() > 0.99 and np.median(off) < 1e-6
        else:
            assert compared.agree.mean() > 0.999 and off.max() < EMBREE


def test_a_tilted_heightfield_or_plane_is_hit_where_its_surface_is():
    rng = np.random.default_rng(4)
    field = terrain.heightfield(rng.uniform(0.0, 0.1, (20, 20)), 0.5, (-5.0, 0.0, -5.0))
    hit = cast(terrain.moving(field, 0, tilts=True).at(TILTED), ORIGINS)
    found = np.asarray(hit.found) > 0
    on_platform = TILTED.inverse().apply(hit.point)[found]
    below = cast(field, on_platform + UP)
    np.testing.assert_allclose(below.point, on_platform, atol=1e-6)
    # Rays stay on their lines, and normals turn with the platform.
    np.testing.assert_array_equal(hit.point[:, [0, 2]], ORIGINS[:, [0, 2]])
    np.testing.assert_allclose(hit.normal[found], TILTED.turn(below.normal), atol=1e-5)
    platform = pose((0.0, 1.0, 0.0), (0.3, 0.2, -0.25))
    still = terrain.plane(platform.pos[0], platform.turn(jnp.asarray(UP))[0])
    hit, expected = (
        cast(terrain.moving(terrain.plane(), 0).at(platform), ORIGINS),
        cast(still, ORIGINS),
    )
    np.testing.assert_allclose(hit.point, expected.point, atol=1e-12)
    np.testing.assert_allclose(hit.normal, expected.normal, atol=1e-12)


def test_a_ray_hits_the_nearest_of_platforms_and_static_ground_and_says_which():
    floor, cabin = terrain.plane(), terrain.heightfield(jnp.zeros((3, 3)), 1.0)
    both = terrain.combine(floor, *(terrain.moving(cabin, number) for number in (0, 1)))
    poses = jax.tree.map(lambda *x: jnp.concatenate(x), pose((0, 0.5, 0)), pose((1.5, 0.7, 0)))
    points = jnp.array([[-0.5, 2.0, 0.5], [0.5, 2.0, 0.5], [1.7, 2.0, 0.5], [3.0, 2.0, 0.5]])
    hit = cast(both.at(poses), points)
    assert hit.platform is not None and hit.platform.tolist() == [-1, 0, 1, 1]
    np.testing.assert_allclose(hit.point[:, 1], [0.0, 0.5, 0.7, 0.7])
    assert cast(floor, points).platform is None, "what nobody needs costs nothing"


@pytest.mark.slow
def test_the_hit_is_differentiable_in_the_pose_of_its_platform():
    ground = terrain.moving(terrain.mesh(*rough(10)), 0)

    def heights(platform: jaxik.Transform) -> jax.Array:
        hit = cast(ground.at(platform), ORIGINS[:20])
        return jnp.where(hit.found > 0, hit.point[:, 1], 0.0)

    slope, backward = jax.jit(lambda p: (jax.jacfwd(heights)(p), jax.jacrev(heights)(p)))(TURNED)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope))
    np.testing.assert_allclose(slope.pos[:, 0, 1], heights(TURNED) != 0, atol=1e-9)
    np.testing.assert_allclose(backward.pos, slope.pos, atol=1e-9)


def test_what_is_no_terrain_is_refused_with_what_was_expected():
    v, t = rough(3)
    mesh, plane, merge, moving = terrain.mesh, terrain.plane, terrain.merge, terrain.moving
    ground, none = bumps(1), np.zeros((0, 3))
    moved = moving(plane(), 1)
    assert moved.platform_count == 2
    for make, message in (
        (lambda: mesh(v[:, :2], t), "vertices must have the shape"),
        (lambda: mesh(v, t[:0]), "triangles must have the shape"),
        (lambda: mesh(v, t * 1.0), "integer indices"),
        (lambda: mesh(v, t + 99), "index vertices 0 to 15; got 99 to 114"),
        (lambda: mesh(v, t - 1), "index vertices 0 to 15; got -1 to 14"),
        (lambda: mesh(v * np.where(v == v[5], np.nan, 1), t), "not finite"),
        (lambda: mesh(v + np.where(v == v[5], 1e308, 0), t), "vertices are too far "),
        (lambda: mesh(v, t, up=(0.0, 0.0, 0.0)), "up is a direction"),
        (lambda: mesh(v, t, layer=32), "from 0 to 31; got 32"),
        (lambda: plane(normal=(0.0, 0.0, 0.0)), "normal is a direction"),
        (lambda: plane(layer=-1), "from 0 to 31; got -1"),
        (lambda: plane().with_vertices(jnp.asarray(v)), "surface 0 is a Plane"),
        (lambda: terrain.layer_mask(40), "from 0 to 31; got 40"),
        (lambda: terrain.combine(), "at least one"),
        (lambda: terrain.combine(plane(), mesh(v, t, up=(1.0, 0.0, 0.0))), "must share one up"),
        (lambda: merge((ground,), np.zeros((2, 3))), "1 terrains and 2 offsets"),
        (lambda: merge((), none), "at least one terrain"),
        (lambda: merge((ground, plane()), np.zeros((2, 3))), "static meshes merge; got a Plane"),
        (lambda: merge((moving(ground, 0),), np.zeros((1, 3))), "got a MovingSurface"),
        (lambda: merge((ground, plane(up=(0, 0, 1))), np.zeros((2, 3))), "share one up direction"),
        (lambda: moving(terrain.combine(plane(), moved), 0), "moves with a platform already"),
        (lambda: moving(plane(), -1), "numbered from 0; got -1"),
    ):
        with pytest.raises(ValueError, match=message):
            make()


def test_meshes_of_different_sizes_have_arrays_of_one_shape_and_are_as_they_were():
    types = set()
    for size in (2, 9, 15):  # 8 to 450 triangles
        vertices, triangles = rough(size)
        ground = terrain.mesh(vertices, triangles, layer=3)
        (surface,) = ground.surfaces
        assert isinstance(surface, Mesh)
        corners, members, layers = surface.on_host()
        np.testing.assert_array_equal(corners, vertices)
        np.testing.assert_array_equal(members, triangles)
        assert (layers == terrain.layer_mask(3)).all()
        leaves, structure = jax.tree.flatten(ground)
        types.add((structure, *((leaf.shape, leaf.dtype) for leaf in leaves)))
        raised = np.asarray(surface.moved(jnp.ones(3)).on_host()[0])
        np.testing.assert_array_equal(raised, vertices + 1.0)
    assert len(types) == 1


def test_more_vertices_than_a_mesh_has_are_refused():
    ground = terrain.mesh(*rough(3))
    with pytest.raises(ValueError, match="at most 512 vertices; got 600"):
        ground.with_vertices(jnp.zeros((600, 3)))
