"""Meshes merged into one: rays meet each where it was put."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxik.world import terrain
from jaxik.world.terrain import Terrain, cast, merge


def bumps(seed: int, layer: int = 0) -> Terrain:
    """A square metre of triangles of random heights."""
    rows, columns = np.indices((5, 5)).reshape(2, -1)
    heights = np.random.default_rng(seed).uniform(0, 0.2, rows.size)
    vertices = np.stack([rows / 4, heights, columns / 4], axis=1)
    corner = (np.arange(4)[:, None] * 5 + np.arange(4)).ravel()
    lower, upper = corner[:, None] + [0, 1, 5], corner[:, None] + [1, 6, 5]
    return terrain.mesh(vertices, np.concatenate([lower, upper]), layer=layer)


def test_rays_meet_each_terrain_where_it_was_put():
    grounds = bumps(1), bumps(2, layer=3).moved(jnp.array([0.0, 1.0, 0.0]))
    offsets = np.array([[0.0, 0.0, 0.0], [40.0, 0.5, -8.0]])
    merged = merge(grounds, offsets)
    points = np.random.default_rng(0).uniform([0, 3, 0], [1, 3, 1], (200, 3))
    for ground, offset in zip(grounds, offsets, strict=True):
        expected = cast(ground, jnp.asarray(points), 9.0)
        hit = cast(merged, jnp.asarray(points + offset), 9.0 + offset[1])
        assert expected.found.all()
        np.testing.assert_allclose(hit.point, expected.point + offset, atol=1e-5)
        np.testing.assert_allclose(hit.normal, expected.normal, atol=1e-5)
    assert not cast(merged, jnp.array([20.0, 3.0, 0.0]), 9.0).found
    masked = cast(merged, jnp.asarray(points + offsets[1]), 9.0, terrain.layer_mask(0))
    assert not masked.found.any()


@pytest.mark.parametrize(
    ("grounds", "offsets", "message"),
    [
        ((bumps(1),), np.zeros((2, 3)), "1 terrains and 2 offsets"),
        ((), np.zeros((0, 3)), "at least one terrain"),
        ((bumps(1), terrain.plane()), np.zeros((2, 3)), "only static meshes merge; got a Plane"),
        ((terrain.moving(bumps(1), 0),), np.zeros((1, 3)), "got a MovingSurface"),
        ((bumps(1), terrain.plane(up=(0, 0, 1))), np.zeros((2, 3)), "share one up direction"),
    ],
)
def test_what_cannot_be_merged_is_refused(grounds, offsets, message):
    with pytest.raises(ValueError, match=message):
        merge(grounds, offsets)
