"""Uneven ground as vertices and triangles, terrains of every kind, and rays traced by Embree."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import trimesh

from jaxik.world import terrain
from jaxik.world.terrain import Hit, Terrain

# Embree computes in float32: with coordinates up to 10 m and slopes up to 20, heights agree to
# this.
EMBREE = 1e-4  # m
UP = np.array([0.0, 1.0, 0.0])

Arrays = tuple[np.ndarray, np.ndarray]  # vertices, m, and triangles


def lattice(heights: np.ndarray, spacing: Any = 1.0, origin: Any = (0.0, 0.0, 0.0)) -> Arrays:
    """The triangles of a heightfield: rows along z, the diagonal to the next row and column.

    There are none around a height that is NaN.
    """
    rows, columns = heights.shape
    row, column = np.indices(heights.shape)
    (size_x, size_z), corner = np.broadcast_to(spacing, 2), np.arange(heights.size)
    vertices = np.stack([column * size_x, np.nan_to_num(heights), row * size_z], axis=-1)
    near = corner.reshape(rows, columns)[:-1, :-1].ravel()[:, None]
    triangles = np.stack([near + [0, columns, columns + 1], near + [0, columns + 1, 1]], axis=1)
    solid = np.isfinite(heights).ravel()[near + [0, 1, columns, columns + 1]].all(axis=1)
    return vertices.reshape(-1, 3) + origin, triangles[solid].reshape(-1, 3)


def rough(count: int = 40, seed: int = 0) -> Arrays:
    """Hills of 8 m x 8 m with jittered vertices."""
    rng = np.random.default_rng(seed)
    shape = count + 1, count + 1
    vertices, triangles = lattice(np.zeros(shape), 8.0 / count, (-4.0, 0.0, -4.0))
    inner = np.pad(np.ones((count - 1, count - 1)), 1).reshape(-1, 1)
    vertices[:, ::2] += inner * rng.uniform(-0.05, 0.05, (len(vertices), 2))
    vertices[:, 1] = np.sin(vertices[:, 0]) + rng.normal(size=len(vertices)) * 0.1
    return vertices, triangles


def arrays(mesh: Any) -> Arrays:
    """Vertices and triangles of a trimesh, or of several."""
    mesh = trimesh.util.concatenate(mesh)
    return np.array(mesh.vertices), np.array(mesh.faces)


def box(size: tuple[float, float, float], centre: tuple[float, float, float]) -> trimesh.Trimesh:
    return trimesh.creation.box(size, trimesh.transformations.translation_matrix(centre))


def turned(vertices: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Vertices turned from y up to another `up`."""
    return vertices @ np.asarray(trimesh.geometry.align_vectors(UP, up))[:3, :3].T


def every_kind(layered: bool = False, dtype: Any = np.float64) -> Terrain:
    """A mesh, two heightfields, a function and a plane, on layers 0 to 4 if `layered`."""
    heights = np.random.default_rng(0).uniform(-0.5, 0.5, (9, 9)).astype(dtype)
    corner = (-2.0, 0.0, -2.0)
    layers = range(5) if layered else [0] * 5
    vertices, triangles = lattice(heights, 0.5, corner)
    return terrain.combine(
        terrain.mesh(vertices.astype(dtype), triangles, layer=layers[0]),
        terrain.heightfield(heights[::-1], 0.5, corner, layer=layers[1]),
        terrain.heightfield(heights.T, 0.5, corner, layer=layers[2], interpolation="triangulated"),
        terrain.function(
            lambda x, z: 0.3 * jnp.sin(3 * x) * jnp.cos(2 * z), layer=layers[3], dtype=dtype
        ),
        terrain.plane((0.0, -0.4, 0.0), (0.1, 1.0, 0.1), layer=layers[4], dtype=dtype),
    )


def cast(ground: Terrain, origins: Any) -> Hit:
    return terrain.cast(ground, jnp.asarray(origins), jnp.inf)


class Comparison(NamedTuple):
    """Rays compared with those of Embree, each True or False."""

    hits: np.ndarray
    both: np.ndarray
    agree: np.ndarray
    """On whether they hit, and where."""
    off: np.ndarray
    """m, apart."""
    same_normal: np.ndarray


def against_embree(
    hit: Hit, vertices: np.ndarray, triangles: np.ndarray, origins: Any, up: np.ndarray = UP
) -> Comparison:
    """Compares hits with those of Embree on the same triangles.

    The two may differ where Embree's float32 decides otherwise (a ray along a silhouette, an
    origin on a surface); such rays must be very few.
    """
    origins = np.asarray(origins)
    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    tracer = trimesh.ray.ray_pyembree.RayMeshIntersector(mesh)  # pyright: ignore
    index = tracer.intersects_first(origins, np.broadcast_to(-up, origins.shape))
    normal = mesh.face_normals[index] * np.sign(mesh.face_normals[index] @ up)[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        drop = ((origins - vertices[triangles[index, 0]]) * normal).sum(-1) / (normal @ up)
    hits, expected = np.asarray(hit.found) > 0, index >= 0
    off = np.abs(np.asarray(hit.distance) - drop)
    same_normal = np.abs(np.asarray(hit.normal) - normal).max(axis=-1) < 1e-6
    agree = (hits == expected) & ((off < EMBREE) | ~hits)
    return Comparison(hits, hits & expected, agree, off, same_normal)
