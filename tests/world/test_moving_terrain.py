"""Terrain on platforms: rays against moved copies of it, and which platform they hit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxik
from jaxik.world import terrain
from support.meshes import EMBREE, UP, against_embree, cast, rough


def pose(pos: tuple[float, ...], turn: tuple[float, ...] = (0.0, 0.0, 0.0)) -> jaxik.Transform:
    """One platform, shifted by m and turned by a rotation vector, rad."""
    rot = Rotation.from_rotvec(turn).as_quat(scalar_first=True)
    return jaxik.Transform(jnp.asarray([pos], float), jnp.asarray(rot)[None])


SHIFTED, TURNED = pose((0.7, 1.5, -0.4)), pose((-1.0, 0.3, 2.0), (0.0, 0.8, 0.0))
TILTED = pose((0.5, 1.0, -0.3), (0.12, 0.6, -0.1))
ORIGINS = np.random.default_rng(7).uniform((-5.0, 4.0, -5.0), (5.0, 5.0, 5.0), (3000, 3))


@pytest.mark.parametrize("tilts", [False, True])
def test_rays_hit_a_moved_mesh_where_embree_hits_its_copy(tilts):
    vertices, triangles = rough()
    ground = terrain.moving(terrain.mesh(vertices, triangles), 0, tilts=tilts)
    for platform in [TILTED] if tilts else [SHIFTED, TURNED]:
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


def test_a_tilted_heightfield_is_hit_where_its_surface_is():
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


def test_a_tilted_plane_is_hit_as_the_plane_that_it_then_is():
    platform = pose((0.0, 1.0, 0.0), (0.3, 0.2, -0.25))
    still = terrain.plane(platform.pos[0], platform.turn(jnp.asarray(UP))[0])
    moving = terrain.moving(terrain.plane(), 0).at(platform)
    actual, expected = cast(moving, ORIGINS), cast(still, ORIGINS)
    np.testing.assert_allclose(actual.point, expected.point, atol=1e-12)
    np.testing.assert_allclose(actual.normal, expected.normal, atol=1e-12)


def test_a_ray_hits_the_nearest_of_platforms_and_static_ground_and_says_which():
    floor, cabin = terrain.plane(), terrain.heightfield(jnp.zeros((3, 3)), 1.0)
    both = terrain.combine(floor, *(terrain.moving(cabin, number) for number in (0, 1)))
    poses = jax.tree.map(lambda *x: jnp.concatenate(x), pose((0, 0.5, 0)), pose((1.5, 0.7, 0)))
    points = jnp.array([[-0.5, 2.0, 0.5], [0.5, 2.0, 0.5], [1.7, 2.0, 0.5], [3.0, 2.0, 0.5]])
    hit = cast(both.at(poses), points)
    assert hit.platform is not None and hit.platform.tolist() == [-1, 0, 1, 1]
    np.testing.assert_allclose(hit.point[:, 1], [0.0, 0.5, 0.7, 0.7])
    assert cast(floor, points).platform is None, "what nobody needs costs nothing"


def test_the_hit_is_differentiable_in_the_pose_of_its_platform():
    ground = terrain.moving(terrain.mesh(*rough(10)), 0)

    def heights(platform: jaxik.Transform) -> jax.Array:
        hit = cast(ground.at(platform), ORIGINS[:20])
        return jnp.where(hit.found > 0, hit.point[:, 1], 0.0)

    slope, backward = jax.jit(lambda p: (jax.jacfwd(heights)(p), jax.jacrev(heights)(p)))(TURNED)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope))
    np.testing.assert_allclose(slope.pos[:, 0, 1], heights(TURNED) != 0, atol=1e-9)
    np.testing.assert_allclose(backward.pos, slope.pos, atol=1e-9)


def test_a_terrain_moves_with_one_platform_only():
    moving = terrain.moving(terrain.plane(), 1)
    assert moving.platform_count == 2
    with pytest.raises(ValueError, match="moves with a platform already"):
        terrain.moving(terrain.combine(terrain.plane(), moving), 0)
    with pytest.raises(ValueError, match="numbered from 0; got -1"):
        terrain.moving(terrain.plane(), -1)
