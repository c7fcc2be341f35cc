"""Makes terrains: of planes, meshes, heightfields and functions, combined, and on platforms."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from jaxik.world import arguments, grid
from jaxik.world.heightfield import Heightfield, HeightFunction, HeightOf
from jaxik.world.skeleton import Transform
from jaxik.world.surfaces import Mesh, MovingSurface, Plane

from .rays import Terrain


def layer_mask(*layers: int) -> int:
    """The mask of these layers and no others."""
    return sum(int(arguments.layer_bits(layer)) for layer in set(layers))


def plane(
    point: ArrayLike | tuple[float, ...] = (0.0, 0.0, 0.0),
    normal: ArrayLike | tuple[float, ...] = (0.0, 1.0, 0.0),
    up: ArrayLike | tuple[float, ...] = (0.0, 1.0, 0.0),
    layer: int = 0,
    dtype=None,
) -> Terrain:
    """A terrain of one infinite plane through `point`, m, on one layer (0 to 31).

    `normal` and `up` need not be unit vectors. The dtype defaults to that of the arrays among the
    arguments, else to JAX's default.

    Raises:
        ValueError: a direction of length zero, or a layer that does not exist.
    """
    dtype = dtype or arguments.float_dtype(point, normal, up)
    surface = Plane(
        jnp.asarray(point, dtype),
        arguments.direction(normal, "normal", dtype),
        jnp.asarray(arguments.layer_bits(layer)),
    )
    return Terrain(arguments.direction(up, "up", dtype), (surface,))


def mesh(
    vertices: ArrayLike,
    triangles: ArrayLike,
    up: ArrayLike | tuple[float, ...] = (0.0, 1.0, 0.0),
    layer: int | ArrayLike = 0,
    slack: float = 0.0,
) -> Terrain:
    """A terrain of triangles in world space; built on the host, so not under jit.

    Floats have the dtype of `vertices`, or 32 bits where JAX's 64-bit mode is off.

    Args:
        vertices: (vertices, 3), m.
        triangles: (triangles, 3), indices of vertices in either winding.
        up: need not be a unit vector.
        layer: 0 to 31, one for all triangles or one each.
        slack: how far `with_vertices` may later move a vertex sideways, m. More slack means longer
            lists in the grid: keep it below the size of a triangle.

    Raises:
        ValueError: arrays of the wrong shape, no triangles, vertices that are not finite, indices
            out of range, an `up` of length zero, or a layer that does not exist.
    """
    dtype = arguments.float_dtype(vertices)
    positions, corners = np.asarray(vertices), np.asarray(triangles)
    arguments.check_mesh(positions, corners)
    up_ws = arguments.direction(up, "up", dtype)
    # Cast by NumPy: JAX would compile a program for it.
    bits = np.broadcast_to(arguments.layer_bits(layer), len(corners))
    return Terrain(up_ws, (Mesh.build(positions.astype(dtype), corners, bits, up_ws, slack),))


def heightfield(
    heights: ArrayLike,
    spacing: ArrayLike | tuple[float, ...],
    origin: ArrayLike | tuple[float, ...] = (0.0, 0.0, 0.0),
    up: ArrayLike | tuple[float, ...] = (0.0, 1.0, 0.0),
    layer: int = 0,
    interpolation: str = "bilinear",
) -> Terrain:
    """A terrain of heights on a regular grid; also under jit, where `heights` may be traced.

    Rows follow each other along z and columns along x, in the world or, where `up` is not its y, in
    `frame_axes(up)` of `jaxik.world.grid`. A ray takes one look-up on a grid of any size: on a CPU
    less than half of the time of a ray onto a mesh of the same 20,000 triangles, a fifth for two
    million. Floats have the dtype of `heights`, or 32 bits where JAX's 64-bit mode is off.

    Args:
        heights: (rows, columns), m along `up` from `origin`. Where one is NaN, the cells around it
            are holes.
        spacing: m, between neighbours; two numbers are those along x and along z.
        origin: of row 0 and column 0 at height 0, m, world.
        up: need not be a unit vector; not traced.
        layer: 0 to 31.
        interpolation: "bilinear" within each cell, or "triangulated": two triangles a cell, divided
            by the diagonal from [row, column] to [row + 1, column + 1].

    Raises:
        ValueError: arrays of the wrong shape, heights that are infinite or that leave no cell, a
            spacing that is not above 0, an unknown interpolation, an `up` of length zero, or a
            layer that does not exist.
    """
    arguments.check_heightfield(heights, spacing, origin, interpolation)
    dtype = arguments.float_dtype(heights)
    up_ws, axes_ws = _frame(up, dtype)
    surface = Heightfield(
        jnp.asarray(origin, dtype),
        axes_ws,
        jnp.asarray(arguments.layer_bits(layer)),
        jnp.asarray(heights, dtype),
        jnp.broadcast_to(jnp.asarray(spacing, dtype), 2),
        interpolation,
    )
    return Terrain(up_ws, (surface,))


def function(
    height: HeightOf,
    up: ArrayLike | tuple[float, ...] = (0.0, 1.0, 0.0),
    layer: int = 0,
    dtype=None,
) -> Terrain:
    """A terrain whose height is a function of x and z; its normal follows by differentiation.

    x and z are world coordinates or, where `up` is not the world's y, those along the first and
    third of `frame_axes(up)` of `jaxik.world.grid`.

    Every new function is compiled anew, and so is what it closes over: define it once. Numbers
    that change belong in a `jax.tree_util.Partial` or an `equinox.Module`, which are trees: their
    arrays are traced, may be batched and have derivatives.

    Args:
        height: takes x and z, m, of one point and returns its height along `up`, m, in JAX. Where
            it is not finite, or its slope is not, there is no ground. For finite derivatives there
            too, compute a finite height first and replace it last:
            `jnp.where(outside, jnp.nan, height)`.
        up: need not be a unit vector; not traced.
        layer: 0 to 31.
        dtype: of up; None takes JAX's default.

    Raises:
        ValueError: `height` holds something else than arrays or returns anything but one real
            number; an `up` of length zero, or a layer that does not exist.
    """
    dtype = dtype or arguments.float_dtype(up)
    up_ws, axes_ws = _frame(up, dtype)
    traced_height = arguments.height_function(height, dtype)
    bits = jnp.asarray(arguments.layer_bits(layer))
    surface = HeightFunction(jnp.zeros_like(up_ws), axes_ws, bits, traced_height)
    return Terrain(up_ws, (surface,))


def _frame(
    up: ArrayLike | tuple[float, ...], dtype
) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """Up as a unit vector, and the axes about it."""
    up_ws = arguments.direction(up, "up", dtype)
    # By NumPy again: under jit, `up_ws` is traced.
    unit = np.asarray(up, np.float64) / np.linalg.norm(np.asarray(up, np.float64))
    return up_ws, grid.frame_axes(unit.astype(dtype))


def combine(*terrains: Terrain) -> Terrain:
    """One terrain with the surfaces of all; a ray hits the nearest.

    Raises:
        ValueError: no terrains, or terrains with different up directions.
    """
    if not terrains:
        raise ValueError("combine needs at least one terrain")
    ups = [terrain.up_ws for terrain in terrains]
    if not any(isinstance(up, Tracer) for up in ups):
        if not all(np.allclose(up, ups[0], rtol=0, atol=1e-6) for up in ups):
            listed = ", ".join(str(np.asarray(up).tolist()) for up in ups)
            raise ValueError(f"combined terrains must share one up direction; got {listed}")
    surfaces = (surface for terrain in terrains for surface in terrain.surfaces)
    return Terrain(ups[0], tuple(surfaces))


def merge(
    terrains: Sequence[Terrain],
    offsets_ws: Sequence[Float[np.ndarray, "3"]] | Float[np.ndarray, "terrains 3"],
) -> Terrain:
    """One mesh of the triangles of several terrains, each moved; built on the host, not under jit.

    One grid finds them all, so that a ray onto many terrains costs as much as onto one, where those
    that `combine` has put together cost one look-up each. Put side by side, they are the grounds of
    many characters in one call.

    Args:
        terrains: static meshes under one up direction; several surfaces of one count as one.
        offsets_ws: m, by which each is moved.

    Raises:
        ValueError: not as many offsets as terrains, none at all, another surface than a static
            mesh, or different up directions.
    """
    if len(offsets_ws) != len(terrains):
        raise ValueError(f"merge got {len(terrains)} terrains and {len(offsets_ws)} offsets")
    up_ws = combine(*terrains).up_ws
    vertices, triangles, layers, count = [], [], [], 0
    for terrain, offset_ws in zip(terrains, offsets_ws, strict=True):
        for surface in terrain.surfaces:
            if not isinstance(surface, Mesh):
                raise ValueError(f"only static meshes merge; got a {type(surface).__name__}")
            moved = surface.moved(jnp.asarray(offset_ws, surface.vertices_ws.dtype))
            corners, members, bits = moved.on_host()
            vertices.append(corners)
            triangles.append(members + count)
            layers.append(bits)
            count += len(corners)
    corners, members, bits = map(np.concatenate, (vertices, triangles, layers))
    return Terrain(up_ws, (Mesh.build(corners, members, bits, up_ws),))


def moving(terrain: Terrain, platform: int, tilts: bool = False) -> Terrain:
    """The terrain with its surfaces on a platform: they are given in its space and move with it.

    Where platforms are, `Frame.platforms` says in each frame; `Terrain.at` puts them there for rays
    outside the pipeline. Until then the platform is at the world's origin. `combine` mixes terrains
    of several platforms with static ones.

    Platforms may be shifted and turned about up. Planes may also tilt. Other surfaces may tilt if
    `tilts` says so, at several times the cost of a ray, because their rays no longer run along the
    up that they are made for: by up to about 20 degrees for walkable ground. Beside the edge of a
    step, within its height times the tilt, a ray then hits one of its two treads.

    Args:
        terrain: its up direction is that of the platform's space and of the world.
        platform: number of the platform, from 0.
        tilts: whether the platform's up may leave the world's, as that of a ship does; if not, rays
            hit tilted ground in a wrong place, planes excepted.

    Raises:
        ValueError: the number is negative, or the terrain moves already.
    """
    if platform < 0:
        raise ValueError(f"platforms are numbered from 0; got {platform}")
    if terrain.platform_count:
        raise ValueError("the terrain moves with a platform already; move each terrain only once")
    pose, up = Transform.identity(terrain.up_ws.dtype), terrain.up_ws
    surfaces = tuple(
        MovingSurface(surface, pose, up, platform, tilts and not isinstance(surface, Plane))
        for surface in terrain.surfaces
    )
    return Terrain(up, surfaces)
