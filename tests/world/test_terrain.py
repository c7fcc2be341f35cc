"""Terrain: agreement with Embree, no leaks, gradients, layers, and batches."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from jax.test_util import check_grads

from jaxik.world import cells, terrain
from jaxik.world.surfaces import Mesh

# Embree computes in float32: with coordinates up to 10 m and slopes up to 20, heights agree to
# this.
EMBREE = 1e-4  # m
Y, TILTED, SIDEWAYS, UPSIDE_DOWN = (
    (0.0, 1.0, 0.0),
    (0.3, 0.9, -0.2),
    (1.0, 0.02, 0.01),
    (0.0, -1.0, 0.0),
)


def rough(count: int = 40, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A height field of 8 m x 8 m with jittered vertices."""
    rng = np.random.default_rng(seed)
    x, z = np.meshgrid(np.linspace(-4, 4, count + 1), np.linspace(-4, 4, count + 1), indexing="ij")
    inner = np.pad(np.ones((count - 1, count - 1)), 1)
    x = x + inner * rng.uniform(-0.05, 0.05, x.shape)
    z = z + inner * rng.uniform(-0.05, 0.05, x.shape)
    y = np.sin(x) + rng.normal(size=x.shape) * 0.1
    a = (np.arange(count)[:, None] * (count + 1) + np.arange(count)).reshape(-1)
    b, c, d = a + 1, a + count + 1, a + count + 2
    triangles = np.concatenate([np.stack([a, b, c], -1), np.stack([b, d, c], -1)])
    return np.stack([x, y, z], -1).reshape(-1, 3), triangles


def arrays(mesh) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a trimesh."""
    return np.array(mesh.vertices), np.array(mesh.faces)


def stepped() -> tuple[np.ndarray, np.ndarray]:
    """Boxes of different heights side by side: level tops and vertical walls."""
    rng = np.random.default_rng(1)
    boxes = []
    for row in range(8):
        for column in range(8):
            height = rng.uniform(0.1, 1.0)
            box = trimesh.creation.box((1.0, height, 1.0))
            box.apply_translation((row - 3.5, height / 2, column - 3.5))
            boxes.append(box)
    return arrays(trimesh.util.concatenate(boxes))


def overhanging() -> tuple[np.ndarray, np.ndarray]:
    """Spheres and a ring above and inside each other: several surfaces over one point."""
    ring = trimesh.creation.torus(2.5, 0.6)
    ball = trimesh.creation.icosphere(subdivisions=3, radius=1.5)
    small = trimesh.creation.icosphere(subdivisions=2, radius=0.7)
    small.apply_translation((0.2, 2.5, -0.3))
    return arrays(trimesh.util.concatenate([ring, ball, small]))


def degenerate() -> tuple[np.ndarray, np.ndarray]:
    """Rough ground with points, lines, needles, walls and duplicate triangles mixed in."""
    vertices, triangles = rough(20, seed=2)
    rng = np.random.default_rng(3)
    chosen = triangles[rng.choice(len(triangles), 60, replace=False)]
    points, lines = chosen[:20, [0, 0, 0]], chosen[20:40, [0, 1, 1]]
    needle = np.array([[-4.0, 2.0, -4.0], [4.0, 2.0, 4.0], [4.0, 2.0, 4.0 + 1e-9]])
    wall = np.array([[-4.0, 0.0, 0.1], [4.0, 0.0, 0.1], [0.0, 3.0, 0.1]])
    corners = len(vertices) + np.arange(6).reshape(2, 3)
    return (
        np.concatenate([vertices, needle, wall]),
        np.concatenate([points, triangles, lines, chosen[40:], corners]),
    )


MESHES = {"rough": rough, "stepped": stepped, "overhanging": overhanging, "degenerate": degenerate}


def rotation_to(up: tuple[float, ...]) -> np.ndarray:
    """A rotation matrix that takes y to `up`."""
    return np.asarray(trimesh.geometry.align_vectors([0, 1, 0], up))[:3, :3]


def embree(vertices: np.ndarray, triangles: np.ndarray, origins: np.ndarray, up: np.ndarray):
    """The first triangle that each ray hits, -1 for none, and the distance to it."""
    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    tracer = trimesh.ray.ray_pyembree.RayMeshIntersector(mesh)  # pyright: ignore
    directions = np.broadcast_to(-up, origins.shape)
    index = tracer.intersects_first(origins, directions)
    corner = vertices[triangles[index]]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    with np.errstate(invalid="ignore", divide="ignore"):
        drop = ((origins - corner[:, 0]) * normal).sum(-1) / (normal @ up)
    return index, drop


@jax.jit
def cast_all(ground: terrain.Terrain, origins: jax.Array) -> terrain.Hit:
    return terrain.cast(ground, origins, jnp.inf)


@pytest.mark.parametrize(
    "name, up",
    [
        ("rough", TILTED),
        ("stepped", Y),
        ("stepped", SIDEWAYS),
        ("overhanging", TILTED),
        ("degenerate", UPSIDE_DOWN),
    ],
)
def test_random_rays_agree_with_embree(name, up):
    # 21,000 rays per case, half from above and half from among the surfaces.
    vertices, triangles = MESHES[name]()
    rot = rotation_to(up)
    rng = np.random.default_rng(5)
    local = rng.uniform((-4.5, -1.0, -4.5), (4.5, 4.0, 4.5), (21000, 3))
    local[::2, 1] = 5.0
    vertices, origins, up = vertices @ rot.T, local @ rot.T, rot @ [0.0, 1.0, 0.0]
    ground = terrain.mesh(vertices, triangles, up=up)
    hit = cast_all(ground, jnp.asarray(origins))
    index, drop = embree(vertices, triangles, origins, up)
    # The two may differ where Embree's float32 decides otherwise (a ray along a silhouette, an
    # origin on a surface); such rays must be very few.
    hits = np.asarray(hit.found) > 0.5
    near = np.abs(np.asarray(hit.distance) - drop) < EMBREE
    agree = (hits == (index >= 0)) & (near | ~hits)
    assert agree.mean() > 1 - 5e-4
    assert 0.1 < hits.mean() < 0.999
    assert np.all(np.asarray(hit.normal) @ up >= 0)
    np.testing.assert_allclose(np.linalg.norm(hit.normal, axis=-1), 1.0, atol=1e-12)
    np.testing.assert_allclose(hit.point, origins - np.outer(hit.distance, up), atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, up, dtype",
    [
        ("rough", Y, jnp.float32),
        ("rough", TILTED, jnp.float64),
        ("stepped", TILTED, jnp.float32),
        ("overhanging", SIDEWAYS, jnp.float64),
    ],
)
def test_no_ray_passes_through_an_edge_or_a_corner(name, up, dtype):
    vertices, triangles = MESHES[name]()
    rot = rotation_to(up)
    vertices, up = vertices @ rot.T, rot @ [0.0, 1.0, 0.0]
    ground = terrain.mesh(vertices.astype(dtype), triangles, up=up)
    corners = vertices[triangles]
    weight = np.random.default_rng(6).uniform(size=(len(corners), 3, 1))
    edges = weight * corners + (1 - weight) * np.roll(corners, -1, axis=1)
    points = np.concatenate([corners.reshape(-1, 3), edges.reshape(-1, 3), corners.mean(axis=1)])
    local = rot.T @ points.T  # keep off the outline, which a rounded ray may rightly miss
    extent = np.abs(rot.T @ vertices.T).max(axis=1) * 0.999
    inner = (np.abs(local[0]) < extent[0]) & (np.abs(local[2]) < extent[2])
    if name == "overhanging":  # inside the ball's outline
        inner = np.hypot(local[0], local[2]) < 1.49
    origins = points[inner] + 6.0 * up
    hit = cast_all(ground, jnp.asarray(origins, dtype))
    assert hit.point.dtype == dtype
    assert inner.sum() > 1000
    assert np.all(hit.found == 1.0)
    # Nor is something further down hit instead. (Not tested on the steps: a rounded ray may rightly
    # pass the edge of a top.)
    if name == "rough":
        assert np.all(np.asarray(hit.distance) <= 6.0 + (1e-9 if dtype == jnp.float64 else 2e-4))
    if name == "overhanging":
        height = np.asarray(hit.point) @ up
        assert np.all(
            height >= np.sqrt(np.maximum(1.47**2 - (local[0] ** 2 + local[2] ** 2)[inner], 0))
        )


def test_a_ray_onto_the_edge_of_a_step_hits_its_top_and_not_its_wall():
    vertices, triangles = stepped()
    ground = terrain.mesh(vertices, triangles)
    tops = vertices[triangles].reshape(-1, 3)
    hit = cast_all(ground, jnp.asarray(tops + [0.0, 3.0, 0.0]))
    np.testing.assert_allclose(hit.normal, np.broadcast_to([0.0, 1.0, 0.0], tops.shape), atol=1e-9)


def test_a_ray_from_under_an_overhang_hits_what_is_below_it():
    floor = np.array([[-9.0, 0, -9], [9, 0, -9], [0, 0, 9]])
    roof = floor + [0.0, 2.0, 0.0]
    ground = terrain.mesh(np.concatenate([floor, roof]), np.array([[0, 1, 2], [3, 4, 5]]))
    origins = jnp.array([[0.0, 3.0, 0.0], [0.0, 2.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    hit = terrain.cast(ground, origins, jnp.inf)
    np.testing.assert_allclose(hit.distance[:3], [1.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_array_equal(hit.found, [1.0, 1.0, 1.0, 0.0])


def test_a_miss_has_the_end_of_the_ray_as_point_and_up_as_normal():
    for ground in (terrain.mesh(*rough()), terrain.plane((0.0, -2.5, 0.0))):
        origins = jnp.array([[0.0, 3.0, 0.0], [99.0, 3.0, 0.0], [0.0, -3.0, 0.0], [jnp.nan] * 3])
        hit = terrain.cast(ground, origins, jnp.array([0.5, 2.0, jnp.inf, 1.0]))
        np.testing.assert_array_equal(hit.found, 0.0)
        np.testing.assert_array_equal(hit.distance, [0.5, 2.0, terrain.HORIZON, 1.0])
        np.testing.assert_array_equal(hit.point[:3, 1], [2.5, 1.0, -3.0 - terrain.HORIZON])
        np.testing.assert_array_equal(hit.normal, np.eye(3)[[1, 1, 1, 1]])


def test_reach_limits_a_ray_and_broadcasts():
    ground = terrain.plane()
    origins = jnp.broadcast_to(jnp.array([0.0, 1.0, 0.0]), (2, 3, 3))
    hit = terrain.cast(ground, origins, jnp.array([0.5, 1.0, 2.0]))
    np.testing.assert_array_equal(hit.found, [[0.0, 1.0, 1.0]] * 2)
    np.testing.assert_array_equal(hit.distance, [[0.5, 1.0, 1.0]] * 2)


def test_a_plane_is_hit_from_both_sides_but_never_edge_on():
    origin = jnp.array([1.0, 2.0, 0.0])
    for sign in (1.0, -1.0):
        hit = terrain.cast(terrain.plane(normal=(-sign, sign, 0.0)), origin, 9.0)
        np.testing.assert_allclose(hit.point, [1.0, 1.0, 0.0], atol=1e-15)
        np.testing.assert_allclose(hit.normal, np.array([-1.0, 1.0, 0.0]) / np.sqrt(2), atol=1e-15)
    assert terrain.cast(terrain.plane(normal=(1.0, 0.0, 0.0)), origin, 9.0).found == 0.0


def test_a_ray_hits_only_the_layers_of_its_mask():
    vertices, triangles = rough(4)
    high = vertices + [0.0, 3.0, 0.0]
    ground = terrain.combine(
        terrain.mesh(
            np.concatenate([vertices, high]),
            np.concatenate([triangles, triangles + len(vertices)]),
            layer=np.repeat([0, 31], len(triangles)),
        ),
        terrain.plane((0.0, -5.0, 0.0), layer=7),
    )
    origin = jnp.array([0.1, 9.0, 0.2])
    hits = {
        layers: terrain.cast(ground, origin, 99.0, terrain.layer_mask(*layers))
        for layers in [(0,), (31,), (7,), (0, 31), (0, 7), (3,), ()]
    }
    low, over = hits[(0,)].point[1], hits[(31,)].point[1]
    np.testing.assert_allclose(over - low, 3.0, atol=1e-12)
    np.testing.assert_allclose(hits[(7,)].point[1], -5.0, atol=1e-12)
    assert hits[(0, 31)].point[1] == over and hits[(0, 7)].point[1] == low
    assert hits[(3,)].found == 0.0 and hits[()].found == 0.0
    assert terrain.cast(ground, origin, 99.0).point[1] == over
    each_mask = terrain.cast(
        ground, jnp.stack([origin] * 3), 99.0, jnp.array([1, 1 << 31, 8], jnp.uint32)
    )
    np.testing.assert_array_equal(each_mask.found, [1.0, 1.0, 0.0])
    np.testing.assert_array_equal(each_mask.point[:2, 1], [low, over])


def test_the_nearest_of_several_surfaces_is_hit():
    ground = terrain.combine(terrain.plane((0.0, 0.3, 0.0), layer=1), terrain.mesh(*rough()))
    origins = jnp.asarray(np.random.default_rng(7).uniform(-3, 3, (500, 3))).at[:, 1].set(5.0)
    combined, level, uneven = (
        terrain.cast(ground, origins, jnp.inf, mask).point[:, 1] for mask in (3, 2, 1)
    )
    np.testing.assert_allclose(level, 0.3, atol=1e-12)
    np.testing.assert_array_equal(combined, np.maximum(level, uneven))
    assert 50 < np.sum(np.asarray(uneven) > 0.3) < 450


def test_gradients_in_the_origin_match_finite_differences():
    vertices, triangles = rough(10)
    rot = rotation_to(TILTED)
    ground = terrain.combine(
        terrain.mesh(vertices @ rot.T, triangles, up=rot @ [0.0, 1.0, 0.0]),
        terrain.plane((0.0, 0.0, 0.0), rot @ [0.3, 0.9, 0.1], up=rot @ [0.0, 1.0, 0.0]),
    )
    local = np.random.default_rng(8).uniform(-3.5, 3.5, (40, 3))
    origins = jnp.asarray((local * [1, 0, 1] + [0, 4, 0]) @ rot.T)

    @jax.jit
    def cast(origins):
        hit = terrain.cast(ground, origins, jnp.inf)
        return hit.point, hit.normal, hit.distance

    check_grads(cast, (origins,), order=1, modes=["fwd", "rev"], eps=1e-6, atol=1e-6, rtol=1e-6)


def test_gradients_in_the_vertices_match_finite_differences():
    vertices, triangles = rough(6)
    ground = terrain.mesh(vertices, triangles, slack=1e-3)
    origins = jnp.asarray(np.random.default_rng(9).uniform(-3.5, 3.5, (40, 3))).at[:, 1].set(4.0)

    @jax.jit
    def cast(vertices):
        hit = terrain.cast(ground.with_vertices(vertices), origins, jnp.inf)
        return hit.point, hit.normal

    check_grads(
        cast,
        (jnp.asarray(vertices),),
        order=1,
        modes=["fwd", "rev"],
        eps=1e-6,
        atol=1e-6,
        rtol=1e-6,
    )
    assert np.all(terrain.cast(ground, origins, jnp.inf).found == 1.0)


@pytest.mark.slow
def test_gradients_are_finite_on_edges_corners_walls_and_misses():
    vertices, triangles = degenerate()
    steps, _ = stepped()
    ground = terrain.combine(
        terrain.mesh(vertices, triangles, slack=0.01),
        terrain.mesh(*stepped()),
        terrain.plane((0.0, -3.0, 0.0), (1.0, 0.0, 0.0)),
    )
    points = np.concatenate([vertices, steps])
    origins = jnp.asarray(np.concatenate([points, points + [0, 1, 0], points + [99, 0, 0]]))

    def total(ground, origins, reach):
        hit = terrain.cast(ground, origins, reach)
        return sum(jnp.sum(jnp.sin(leaf)) for leaf in jax.tree.leaves(hit))

    @eqx.filter_jit
    def gradients(args):
        backward = eqx.filter_grad(lambda args: total(*args))(args)
        forward = jax.jacfwd(
            lambda scale: total(ground.with_vertices(vertices * scale), origins, args[2])
        )(jnp.ones(()))
        return backward, forward

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
    origins = jnp.asarray(rng.uniform(-4.2, 4.2, (20000, 3))).at[:, 1].set(5.0)
    hits = (jax.tree.leaves(cast_all(ground, origins)) for ground in (updated, rebuilt))
    for actual, expected in zip(*hits, strict=True):
        np.testing.assert_allclose(actual, expected, atol=1e-9)


def test_a_wall_that_is_moved_within_the_slack_to_lean_over_is_hit():
    wall = np.array([[-1.0, 0, 0], [1, 0, 0], [0, 2, 0]])
    ground = terrain.mesh(wall, np.array([[0, 1, 2]]), slack=0.1)
    origin = jnp.array([0.0, 5.0, 0.05])
    assert terrain.cast(ground, origin, 9.0).found == 0.0
    leaning = jnp.asarray(wall).at[2, 2].set(0.1)
    hit = terrain.cast(ground.with_vertices(leaning), origin, 9.0)
    np.testing.assert_allclose(hit.point, [0.0, 1.0, 0.05], atol=1e-12)


def test_jit_vmap_scan_and_a_loop_agree():
    ground = terrain.combine(terrain.mesh(*overhanging()), terrain.plane((0.0, -1.0, 0.0)))
    origins = jnp.asarray(np.random.default_rng(11).uniform(-3, 3, (40, 2, 3)))
    whole = cast_all(ground, origins)
    mapped = jax.vmap(jax.vmap(lambda origin: terrain.cast(ground, origin, jnp.inf)))(origins)
    _, scanned = jax.lax.scan(lambda _, o: (None, terrain.cast(ground, o, jnp.inf)), None, origins)
    looped = jax.tree.map(
        lambda *leaves: jnp.stack(leaves), *[terrain.cast(ground, o, jnp.inf) for o in origins]
    )
    for other in (mapped, scanned, looped):
        for actual, expected in zip(jax.tree.leaves(other), jax.tree.leaves(whole), strict=True):
            np.testing.assert_allclose(actual, expected, atol=1e-12)


def test_vmap_works_over_terrains_of_the_same_shape():
    vertices, triangles = rough(6)
    lifts = jnp.array([0.0, 0.5, 2.0])
    ground = terrain.mesh(vertices, triangles)
    origins = jnp.array([[0.1, 5.0, 0.2], [1.0, 5.0, -1.0]])

    def lifted(lift):
        higher = ground.with_vertices(jnp.asarray(vertices) + lift * jnp.array([0.0, 1.0, 0.0]))
        return terrain.combine(higher, terrain.plane(jnp.stack([0 * lift, lift, 0 * lift])))

    grounds = jax.vmap(lifted)(lifts)
    hit = jax.vmap(lambda ground: terrain.cast(ground, origins, jnp.inf))(grounds)
    heights = np.asarray(hit.point[..., 1]) - np.asarray(lifts)[:, None]
    np.testing.assert_allclose(heights, np.broadcast_to(heights[0], (3, 2)), atol=1e-12)


def test_vmap_over_masks_and_rays_equals_single_casts():
    vertices, triangles = rough(6)
    ground = terrain.mesh(vertices, triangles, layer=np.arange(len(triangles)) % 3)
    origins = jnp.asarray(np.random.default_rng(15).uniform(-3, 3, (4, 5, 3))).at[..., 1].set(5.0)
    masks = jnp.array([1, 2, 4, 7], jnp.uint32)

    def distance(origins, mask):
        return terrain.cast(ground, origins, 9.0, mask).distance

    single = jnp.stack([jnp.stack([distance(rays, mask) for rays in origins]) for mask in masks])
    together = jax.vmap(distance)(origins, masks)
    np.testing.assert_allclose(together, single[np.arange(4), np.arange(4)], atol=1e-12)
    np.testing.assert_allclose(
        jax.vmap(distance, (None, 0))(origins[0], masks), single[:, 0], atol=1e-12
    )
    apart = jax.vmap(jax.vmap(distance, (0, None)), (None, 0))(origins, masks)
    np.testing.assert_allclose(apart, single, atol=1e-12)
    assert len(np.unique(single[:, 0, 0])) > 1


def test_float32_stays_float32_under_strict_promotion():
    vertices, triangles = rough(6)
    with jax.numpy_dtype_promotion("strict"):
        ground = terrain.combine(
            terrain.mesh(vertices.astype(np.float32), triangles), terrain.plane(dtype=jnp.float32)
        )
        hit = terrain.cast(ground, jnp.zeros((4, 3), jnp.float32), 3.0)
    assert {leaf.dtype for leaf in jax.tree.leaves(hit)} == {jnp.dtype(jnp.float32)}


def test_an_empty_batch_of_rays_gives_an_empty_batch_of_hits():
    assert terrain.cast(terrain.mesh(*rough(3)), jnp.zeros((0, 3)), 1.0).point.shape == (0, 3)


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
    rng = np.random.default_rng(12)
    local = rng.uniform(-0.09, 0.09, (4000, 3)) + [30.0, 0.0, 30.0]
    wide = rng.uniform(-99, 99, (4000, 3))
    origins = np.concatenate([local, wide])
    origins[:, 1] = 2.0
    hit = cast_all(ground, jnp.asarray(origins))
    _, drop = embree(vertices, triangles, origins, np.array([0.0, 1.0, 0.0]))
    assert np.all(hit.found == 1.0)
    assert np.mean(np.abs(np.asarray(hit.distance) - drop) < EMBREE) > 0.998


def test_stacked_triangles_and_triangles_around_one_corner_are_found():
    sheet = np.array([[-1.0, 0, -1], [1, 0, -1], [0, 0, 2]])
    heights = np.linspace(0.0, 1.0, 300)
    stack = (sheet + heights[:, None, None] * np.array([0.0, 1.0, 0.0])).reshape(-1, 3)
    angles = np.linspace(0, 2 * np.pi, 500, endpoint=False)
    rim = np.stack([np.cos(angles), 0 * angles + 2.0, np.sin(angles)], -1)
    fan = np.stack([0 * np.arange(500), 1 + np.arange(500), 1 + np.roll(np.arange(500), -1)], -1)
    vertices = np.concatenate([stack, [[0.0, 2.5, 0.0]], rim])
    triangles = np.concatenate([np.arange(900).reshape(-1, 3), fan + 900])
    ground = terrain.mesh(vertices, triangles)
    inside = np.random.default_rng(13).uniform(-0.3, 0.3, (2000, 3))
    inside[:, 1] = 0.5
    hit = cast_all(ground, jnp.asarray(inside))
    np.testing.assert_allclose(hit.point[:, 1], heights[heights <= 0.5].max(), atol=1e-12)
    inside[:, 1], inside[0] = 5.0, [0.0, 5.0, 0.0]
    hit = cast_all(ground, jnp.asarray(inside))
    radius = np.hypot(inside[:, 0], inside[:, 2])
    np.testing.assert_allclose(hit.point[:, 1], 2.5 - 0.5 * radius, atol=1e-4)


def test_a_mesh_of_walls_only_is_never_hit():
    wall = np.array([[-1.0, 0, 0], [1, 0, 0], [0, 2, 0]])
    ground = terrain.mesh(wall, np.array([[0, 1, 2]]))
    assert terrain.cast(ground, jnp.array([0.0, 5.0, 0.0]), jnp.inf).found == 0.0


def test_a_tiny_mesh_far_from_the_origin_has_accurate_normals_in_float32():
    small = np.array([[0.0, 0, 0], [0, 0, 1], [1, 1, 0]]) * 1e-2 + [64.0, 0.0, 64.0]
    ground = terrain.mesh(small.astype(np.float32), np.array([[0, 1, 2]]))
    origin = jnp.asarray(small.mean(axis=0) + [0.0, 1.0, 0.0], jnp.float32)
    hit = terrain.cast(ground, origin, 5.0)
    np.testing.assert_allclose(hit.normal, np.array([-1.0, 1.0, 0.0]) / np.sqrt(2), atol=2e-3)


def test_rays_onto_the_scanned_blocks_agree_with_embree(mocap):
    mesh = trimesh.load_mesh(mocap / "blocks" / "terrain.ply", process=False)
    vertices, triangles = arrays(mesh)
    low, high = mesh.bounds
    origins = np.random.default_rng(14).uniform(low - 0.2, high + 0.2, (20000, 3))
    origins[:, 1] = high[1] + 1.0
    hit = cast_all(terrain.mesh(vertices, triangles), jnp.asarray(origins))
    index, drop = embree(vertices, triangles, origins, np.array([0.0, 1.0, 0.0]))
    hits = np.asarray(hit.found) > 0.5
    agree = (hits == (index >= 0)) & (~hits | (np.abs(np.asarray(hit.distance) - drop) < EMBREE))
    assert agree.mean() > 1 - 2e-4 and hits.mean() > 0.5
    np.testing.assert_allclose(np.asarray(hit.normal)[hits][:, 1], 1.0, atol=1e-6)


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda v, t: terrain.mesh(v[:, :2], t), "vertices must have the shape"),
        (lambda v, t: terrain.mesh(v, t[:0]), "triangles must have the shape"),
        (lambda v, t: terrain.mesh(v, t * 1.0), "integer indices"),
        (lambda v, t: terrain.mesh(v, t + 99), "index vertices 0 to 15; got 99 to 114"),
        (lambda v, t: terrain.mesh(v, t - 1), "index vertices 0 to 15; got -1 to 14"),
        (lambda v, t: terrain.mesh(v * np.where(v == v[5], np.nan, 1), t), "not finite"),
        (lambda v, t: terrain.mesh(v + np.where(v == v[5], 1e308, 0), t), "vertices are too far "),
        (lambda v, t: terrain.mesh(v, t, up=(0.0, 0.0, 0.0)), "up is a direction"),
        (lambda v, t: terrain.mesh(v, t, layer=32), "from 0 to 31; got 32"),
        (lambda v, t: terrain.plane(normal=(0.0, 0.0, 0.0)), "normal is a direction"),
        (lambda v, t: terrain.plane(layer=-1), "from 0 to 31; got -1"),
        (lambda v, t: terrain.layer_mask(40), "from 0 to 31; got 40"),
        (lambda v, t: terrain.combine(), "at least one"),
        (
            lambda v, t: terrain.combine(terrain.plane(), terrain.mesh(v, t, up=(1.0, 0.0, 0.0))),
            "must share one up",
        ),
        (lambda v, t: terrain.plane().with_vertices(jnp.asarray(v)), "surface 0 is a Plane"),
    ],
)
def test_invalid_terrain_is_rejected_with_what_was_expected(make, message):
    with pytest.raises(ValueError, match=message):
        make(*rough(3))


@pytest.mark.parametrize("distance", [1.0, 1e2, 1e4])
@pytest.mark.parametrize("rise", [0.9, 0.02], ids=["slanted", "steep"])
def test_a_ray_that_starts_on_a_plane_hits_it_whatever_is_rounded(distance, rise):
    rng = np.random.default_rng(3)
    normal = np.array([0.3, rise, -0.2]) / np.linalg.norm([0.3, rise, -0.2])
    point = distance * rng.normal(size=3)
    offsets = distance * rng.normal(size=(2000, 3))
    origins = point + offsets - (offsets @ normal)[:, None] * normal  # on it, but for rounding
    ground = terrain.plane(jnp.asarray(point, jnp.float32), jnp.asarray(normal, jnp.float32))
    above = np.sign(origins.astype(np.float32) @ normal - point.astype(np.float32) @ normal)
    assert (above < 0).mean() > 0.1, "no ray starts a little below"
    cast = jax.jit(lambda origins: terrain.cast(ground, origins, 1.0).found)
    assert np.all(cast(jnp.asarray(origins, jnp.float32)) == 1.0)
    below = origins - 1e-5 * distance * normal
    assert np.all(cast(jnp.asarray(below, jnp.float32)) == 0.0)


def test_lists_stay_short_where_all_triangles_lie_on_each_other():
    count = 300
    corners = np.array([[0.0, 0.0], [9.0, 0.0], [0.0, 9.0]])
    lists = cells.build(np.tile(corners, (count, 1, 1)), np.ones(count, bool), 0.0)
    assert count <= len(lists.members) < 2 * cells.ENTRIES * count
