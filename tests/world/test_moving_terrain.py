"""Terrain on platforms: rays against moved copies of it, and which platform they hit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxik
from jaxik.world import terrain
from world.test_terrain import EMBREE, cast_all, embree, rough

UP = np.array([0.0, 1.0, 0.0])


def pose(pos: tuple[float, ...], turn: tuple[float, ...]) -> jaxik.Transform:
    """One platform, shifted by m and turned by a rotation vector, rad."""
    rot = Rotation.from_rotvec(turn).as_quat(scalar_first=True)
    return jaxik.Transform(jnp.asarray([pos], float), jnp.asarray(rot)[None])


def matrix_of(platform: jaxik.Transform) -> np.ndarray:
    return Rotation.from_quat(np.asarray(platform.rot[0]), scalar_first=True).as_matrix()


SHIFTED, TURNED = pose((0.7, 1.5, -0.4), (0.0, 0.0, 0.0)), pose((-1.0, 0.3, 2.0), (0.0, 0.8, 0.0))


def origins(count: int = 3000) -> jax.Array:
    rng = np.random.default_rng(7)
    return jnp.asarray(rng.uniform((-5.0, 4.0, -5.0), (5.0, 5.0, 5.0), (count, 3)))


@pytest.mark.parametrize("platform", [SHIFTED, TURNED], ids=["shifted", "turned"])
def test_rays_hit_a_moved_mesh_where_embree_hits_its_copy(platform):
    vertices, triangles = rough()
    moved = vertices @ matrix_of(platform).T + np.asarray(platform.pos[0])
    ground = terrain.moving(terrain.mesh(vertices, triangles), 0)
    hit = cast_all(ground.at(platform), origins())
    index, drop = embree(moved, triangles, np.asarray(origins()), UP)
    np.testing.assert_array_equal(hit.platform, np.where(hit.found > 0, 0, -1))
    both = (index >= 0) & (np.asarray(hit.found) > 0)
    assert ((index >= 0) == (np.asarray(hit.found) > 0)).mean() > 0.999 and both.mean() > 0.4
    assert np.abs(np.asarray(hit.distance) - drop)[both].max() < EMBREE


TILTED = pose((0.5, 1.0, -0.3), (0.12, 0.6, -0.1))


def test_rays_hit_a_tilted_mesh_where_embree_hits_its_copy():
    vertices, triangles = rough()
    moved = vertices @ matrix_of(TILTED).T + np.asarray(TILTED.pos[0])
    ground = terrain.moving(terrain.mesh(vertices, triangles), 0, tilts=True)
    hit = cast_all(ground.at(TILTED), origins())
    index, drop = embree(moved, triangles, np.asarray(origins()), UP)
    both = (index >= 0) & (np.asarray(hit.found) > 0)
    assert ((index >= 0) == (np.asarray(hit.found) > 0)).mean() > 0.97 and both.mean() > 0.4
    error = np.abs(np.asarray(hit.distance) - drop)[both]
    assert (error < EMBREE).mean() > 0.99 and np.median(error) < 1e-6


def test_a_tilted_heightfield_is_hit_where_its_surface_is():
    rng = np.random.default_rng(4)
    field = terrain.heightfield(rng.uniform(0.0, 0.1, (20, 20)), 0.5, (-5.0, 0.0, -5.0))
    hit = cast_all(terrain.moving(field, 0, tilts=True).at(TILTED), origins())
    found = np.asarray(hit.found) > 0
    on_platform = TILTED.inverse().apply(hit.point)[found]
    below = terrain.cast(field, on_platform + jnp.array([0.0, 1.0, 0.0]), jnp.inf)
    np.testing.assert_allclose(below.point, on_platform, atol=1e-6)
    # Rays stay on their lines, and normals turn with the platform.
    np.testing.assert_array_equal(hit.point[:, [0, 2]], origins()[:, [0, 2]])
    np.testing.assert_allclose(hit.normal[found], TILTED.turn(below.normal), atol=1e-5)


def test_a_tilted_plane_is_hit_as_the_plane_that_it_then_is():
    platform = pose((0.0, 1.0, 0.0), (0.3, 0.2, -0.25))
    still = terrain.plane(platform.pos[0], matrix_of(platform) @ UP)
    moving = terrain.moving(terrain.plane(), 0).at(platform)
    actual, expected = cast_all(moving, origins()), cast_all(still, origins())
    np.testing.assert_allclose(actual.point, expected.point, atol=1e-12)
    np.testing.assert_allclose(actual.normal, expected.normal, atol=1e-12)


def test_a_ray_hits_the_nearest_of_platforms_and_static_ground_and_says_which():
    floor, cabin = terrain.plane(), terrain.heightfield(jnp.zeros((3, 3)), 1.0)
    both = terrain.combine(floor, *(terrain.moving(cabin, number) for number in (0, 1)))
    poses = jax.tree.map(
        lambda *x: jnp.concatenate(x),
        pose((0.0, 0.5, 0.0), (0, 0, 0)),
        pose((1.5, 0.7, 0.0), (0, 0, 0)),
    )
    points = jnp.array([[-0.5, 2.0, 0.5], [0.5, 2.0, 0.5], [1.7, 2.0, 0.5], [3.0, 2.0, 0.5]])
    hit = terrain.cast(both.at(poses), points, 9.0)
    assert hit.platform.tolist() == [-1, 0, 1, 1]
    np.testing.assert_allclose(hit.point[:, 1], [0.0, 0.5, 0.7, 0.7])
    assert terrain.cast(floor, points, 9.0).platform is None, "what nobody needs costs nothing"


def test_the_hit_is_differentiable_in_the_pose_of_its_platform():
    ground = terrain.moving(terrain.mesh(*rough(10)), 0)
    some = origins(20)

    def heights(platform: jaxik.Transform) -> jax.Array:
        hit = terrain.cast(ground.at(platform), some, jnp.inf)
        return jnp.where(hit.found > 0, hit.point[:, 1], 0.0)

    slope = jax.jacfwd(heights)(TURNED)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope))
    np.testing.assert_allclose(slope.pos[:, 0, 1], heights(TURNED) != 0, atol=1e-9)
    backward = jax.jacrev(heights)(TURNED)
    np.testing.assert_allclose(backward.pos, slope.pos, atol=1e-9)


def test_a_terrain_moves_with_one_platform_only():
    moving = terrain.moving(terrain.plane(), 1)
    assert moving.platform_count == 2
    with pytest.raises(ValueError, match="moves with a platform already"):
        terrain.moving(terrain.combine(terrain.plane(), moving), 0)
    with pytest.raises(ValueError, match="numbered from 0; got -1"):
        terrain.moving(terrain.plane(), -1)
