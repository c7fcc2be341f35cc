"""Sweeps over whole terrains."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt

from jaxik.maths import vec
from jaxik.world import grid
from jaxik.world.surfaces import STATIC, AbstractSurface, Mesh, MovingSurface
from jaxik.world.terrain import ALL_LAYERS, HORIZON, Hit, LegTerrains, Terrain

from .surfaces import Shapes, rest_on


def sweep(
    terrain: Terrain | LegTerrains,
    centres_ws: Float[Array, "*b 3"],
    radius: Float[Array, "*#b"] | float,
    reach: Float[Array, "*#b"] | float,
    mask: UInt[Array, "*#b"] | int = ALL_LAYERS,
    half_ws: Float[Array, "*#b 3"] | None = None,
) -> Hit:
    """What spheres or capsules meet first on their way along -up.

    The point of a hit is the contact, its distance how far the shape has come, and its normal
    points from the contact to the shape. Of a miss, the point is below the centre. What overlaps
    the shape where it starts is not met, nor are walls, as with rays: the sides of a box are not,
    but its upper edges are.

    Exact on planes, meshes and triangulated heightfields. On bilinear ones the error falls with the
    square of the cell's curvature times the radius at each of 16 steps. On functions the shape may
    rest too low by what the ground rises within a quarter of the radius, never too high.

    Args:
        terrain: the surfaces; meshes prepared by `sweepable`.
        centres_ws: where the centres start, m; with `LegTerrains` (..., legs, 3).
        radius: of the spheres, m.
        reach: how far they come down, m.
        mask: the layers that they meet.
        half_ws: from the centre of a capsule to the centre of the sphere at one end, m; None for
            spheres.

    Raises:
        ValueError: a mesh that was not prepared.
    """
    batch = centres_ws.shape[:-1]
    radius = jnp.broadcast_to(jnp.asarray(radius, centres_ws.dtype), batch)
    half = None if half_ws is None else jnp.broadcast_to(half_ws, centres_ws.shape)
    reach = jnp.broadcast_to(jnp.asarray(reach, centres_ws.dtype), batch)
    mask = jnp.broadcast_to(jnp.asarray(mask, jnp.uint32), batch)
    shapes, moves = Shapes(centres_ws, radius, half), terrain.platform_count > 0
    if isinstance(terrain, Terrain):
        return _first(terrain, shapes, reach, mask, moves)
    hits = []
    for leg, ground in enumerate(terrain.legs):
        of_leg = Shapes(
            centres_ws[..., leg, :], radius[..., leg], None if half is None else half[..., leg, :]
        )
        hits.append(_first(ground, of_leg, reach[..., leg], mask[..., leg], moves))
    axis = len(batch) - 1
    return jax.tree.map(lambda *leaves: jnp.stack(leaves, axis=axis), *hits)


def _first(terrain: Terrain, shapes: Shapes, reach: Array, mask: Array, moves: bool) -> Hit:
    distance = jnp.minimum(reach, HORIZON)
    normal = jnp.broadcast_to(terrain.up_ws, shapes.centre_ws.shape)
    point = shapes.centre_ws - vec.scale(terrain.up_ws, distance)
    found, platform = jnp.zeros(reach.shape, bool), jnp.full(reach.shape, STATIC)
    for surface in terrain.surfaces:
        drop, facing, contact, met = rest_on(surface, shapes, terrain.up_ws, mask)
        nearer = met & (drop <= distance)
        distance = jnp.where(nearer, drop, distance)
        normal = jnp.where(nearer[..., None], facing, normal)
        point = jnp.where(nearer[..., None], contact, point)
        platform = jnp.where(nearer, surface.platform, platform)
        found |= nearer
    found = found.astype(distance.dtype)
    return Hit(point, normal, distance, found, platform if moves else None)


def sweepable(terrain: Terrain, margin: float) -> Terrain:
    """The terrain with grids that find all triangles within `margin`, m, of an axis.

    A sphere needs its radius, a capsule that and half its length; wider shapes may miss triangles
    beside them. Rays are as fast as before. Built on the host, so not under jit.

    Raises:
        ValueError: a margin that is not above 0.
    """
    if not 0 < margin < np.inf:
        raise ValueError(f"margin is a length above 0, m; got {margin}")

    def prepared(surface: AbstractSurface) -> AbstractSurface:
        if isinstance(surface, MovingSurface):
            return eqx.tree_at(lambda s: s.surface, surface, prepared(surface.surface))
        if not isinstance(surface, Mesh):
            return surface
        arrays = surface.vertices_ws, surface.triangles, surface.layers
        up_ws = surface.grid.axes_ws[1]
        return dataclasses.replace(surface, wide=grid.build(*arrays, up_ws, margin))

    return Terrain(terrain.up_ws, tuple(map(prepared, terrain.surfaces)))
