"""Ground: planes and triangle meshes, met by rays along -up.

All rays of a terrain are parallel, so a mesh needs no tree: seen along up it is a drawing in the
plane, and a grid over that drawing (`grid`) says which triangles a ray can meet. Which triangle is
met is a discrete answer without a slope; where and at what angle follows from the plane of that
triangle and differentiates with respect to the ray, up and the vertices.
"""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float, Int, UInt

from jaxik.maths import vec
from jaxik.maths.struct import struct

from . import grid

ALL_LAYERS = 0xFFFFFFFF  # a mask that sees every layer
LAYERS = 32
HORIZON = 1e4  # m; a longer ray, an endless one too, ends here


@struct
class Hit:
    """What a ray met; a miss has `found` 0, the ray's end as its point and up as its normal."""

    point: Float[Array, "*b 3"]  # m, world
    normal: Float[Array, "*b 3"]  # unit, on the side of the ray's origin: never below the horizon
    distance: Float[Array, "*b"]  # m from the origin; a miss has the ray's whole length
    found: Float[Array, "*b"]  # 1 or 0


class AbstractSurface(eqx.Module):
    """Something that rays along -up can meet."""

    @abstractmethod
    def meet(
        self, origins_ws: Float[Array, "*b 3"], up_ws: Float[Array, "3"], mask: UInt[Array, "*#b"]
    ) -> tuple[Float[Array, "*b"], Float[Array, "*b 3"], Bool[Array, "*b"]]:
        """Distance to the nearest meeting at or below each origin, m, the unit normal there, facing
        the origin, and whether there is one; finite numbers where there is none."""


class Plane(AbstractSurface):
    """An endless plane, seen from both sides. One that contains up is never met."""

    point_ws: Float[Array, "*t 3"]  # m
    normal_ws: Float[Array, "*t 3"]  # unit
    layers: UInt[Array, "*t"]  # one bit

    def meet(
        self, origins_ws: Float[Array, "*b 3"], up_ws: Float[Array, "3"], mask: UInt[Array, "*#b"]
    ) -> tuple[Float[Array, "*b"], Float[Array, "*b 3"], Bool[Array, "*b"]]:
        distance = _drop(origins_ws, up_ws, self.point_ws, self.normal_ws)
        rise = vec.dot(self.normal_ws, up_ws)
        # A ray that starts on the plane meets it, whatever rounding makes of the difference.
        size = vec.sum_last(jnp.abs(origins_ws)) + vec.sum_last(jnp.abs(self.point_ws))
        allowance = 4 * jnp.finfo(distance.dtype).eps * jax.lax.stop_gradient(size)
        seen = (rise != 0) & (distance * jnp.abs(rise) >= -allowance) & (self.layers & mask != 0)
        normal = jnp.where(rise < 0, -self.normal_ws, self.normal_ws)
        return distance, jnp.broadcast_to(normal, (*distance.shape, 3)), seen


class Mesh(AbstractSurface):
    """Triangles, seen from both sides, with a grid that finds them.

    No ray falls through an edge or a corner that triangles share. A triangle that contains up (a
    wall) or has no area is never met: a ray along it has no single answer.
    """

    vertices_ws: Float[Array, "*t vertices 3"]  # m
    triangles: Int[Array, "*t triangles 3"]
    layers: UInt[Array, "*t triangles"]  # one bit each
    grid: grid.Grid

    def with_vertices(self, vertices_ws: Float[Array, "vertices 3"]) -> "Mesh":
        """The same triangles over moved vertices, m; slopes pass through.

        The grid stays. It finds every triangle while no vertex has moved further sideways (at right
        angles to up) than the `slack` that the mesh was made with; moves along up are free.
        Beyond that a ray may miss what moved.
        """
        found_by = self.grid.moved(vertices_ws, self.triangles, self.layers)
        return Mesh(vertices_ws, self.triangles, self.layers, found_by)

    def meet(
        self, origins_ws: Float[Array, "*b 3"], up_ws: Float[Array, "3"], mask: UInt[Array, "*#b"]
    ) -> tuple[Float[Array, "*b"], Float[Array, "*b 3"], Bool[Array, "*b"]]:
        triangle = self.grid.search(origins_ws, mask)
        seen = triangle >= 0
        ends = self.triangles.at[jnp.where(seen, triangle, 0)].get(mode="promise_in_bounds")
        a, b, c = (
            self.vertices_ws.at[ends[..., corner]].get(mode="promise_in_bounds")
            for corner in range(3)
        )
        normal = vec.triangle_normal(a, b, c, up_ws)
        distance = _drop(origins_ws, up_ws, a, normal)
        # A ray let in by rounding lies outside its triangle by a hair, which a steep plane makes
        # long: the value stays between the corners, the slope is that of the plane.
        drops = [vec.dot(origins_ws - corner, up_ws) for corner in (a, b, c)]
        low = jnp.minimum(jnp.minimum(drops[0], drops[1]), drops[2])
        high = jnp.maximum(jnp.maximum(drops[0], drops[1]), drops[2])
        distance += jax.lax.stop_gradient(jnp.clip(distance, low, high) - distance)
        # Once, or all that is made of a hit would compute it from the corners again.
        x, y, z, distance = vec.stacked_barrier(*vec.components(normal), distance)
        return distance, vec.stack(x, y, z), seen


@struct
class Terrain:
    """Surfaces under one up direction."""

    up_ws: Float[Array, "*t 3"]  # unit; rays run along its opposite
    surfaces: tuple[AbstractSurface, ...]

    @property
    def body(self) -> "Terrain":
        """What rays of the root meet."""
        return self

    @property
    def leg_up_ws(self) -> Float[Array, "*t 3"]:
        """Up of the legs, which all share it."""
        return self.up_ws

    def with_vertices(self, vertices_ws: Float[Array, "vertices 3"], surface: int = 0) -> "Terrain":
        """This terrain with one of its meshes over moved vertices; see `Mesh.with_vertices`."""
        moved = self.surfaces[surface]
        if not isinstance(moved, Mesh):
            raise ValueError(f"surface {surface} is a {type(moved).__name__}; vertices need a Mesh")
        return eqx.tree_at(
            lambda terrain: terrain.surfaces[surface], self, moved.with_vertices(vertices_ws)
        )


@struct
class LegTerrains:
    """The same world as each leg meets it: rays of leg i run along the opposite of its own up.

    For feet on walls and hands on ladders. A mesh is gridded for one up, so that each up that
    occurs needs the mesh once more; legs that share an up share its terrain.
    """

    body: Terrain  # up of the body, and the ground that rays of the root meet
    legs: tuple[Terrain, ...]  # one a leg

    @property
    def up_ws(self) -> Float[Array, "3"]:
        """Up of the body."""
        return self.body.up_ws

    @property
    def leg_up_ws(self) -> Float[Array, "legs 3"]:
        """Up of each leg."""
        return jnp.stack([terrain.up_ws for terrain in self.legs])


def cast(
    terrain: Terrain | LegTerrains,
    origins_ws: Float[Array, "*b 3"],
    reach: Float[Array, "*#b"] | float,
    mask: UInt[Array, "*#b"] | int = ALL_LAYERS,
) -> Hit:
    """What rays along -up meet first.

    A ray that starts on a surface meets it; there the distance can be below zero by a rounding
    error. On an edge that triangles share either normal may come back.

    Args:
        terrain: what there is to meet.
        origins_ws: where the rays start, m; with `LegTerrains` (..., legs, 3).
        reach: their lengths, m; above `HORIZON`, infinite too, it counts as `HORIZON`.
        mask: the layers that each ray sees, one bit a layer (`layer_mask`).
    """
    reach, mask = jnp.asarray(reach, origins_ws.dtype), jnp.asarray(mask, jnp.uint32)
    if isinstance(terrain, Terrain):
        return _nearest(terrain, origins_ws, reach, mask)
    reach, mask = (jnp.broadcast_to(x, origins_ws.shape[:-1]) for x in (reach, mask))
    hits = [
        _nearest(one, origins_ws[..., leg, :], reach[..., leg], mask[..., leg])
        for leg, one in enumerate(terrain.legs)
    ]
    axis = origins_ws.ndim - 2
    return jax.tree.map(lambda *leaves: jnp.stack(leaves, axis=axis), *hits)


@jax.jit  # a call outside jit compiles once a shape, not once an operation
def _nearest(
    terrain: Terrain,
    origins_ws: Float[Array, "*b 3"],
    reach: Float[Array, "*#b"],
    mask: UInt[Array, "*#b"],
) -> Hit:
    distance = jnp.broadcast_to(jnp.minimum(reach, HORIZON), origins_ws.shape[:-1])
    normal = jnp.broadcast_to(terrain.up_ws, origins_ws.shape)
    found = jnp.zeros(distance.shape, bool)
    for surface in terrain.surfaces:
        drop, facing, seen = surface.meet(origins_ws, terrain.up_ws, mask)
        nearer = seen & (drop <= distance)
        distance = jnp.where(nearer, drop, distance)
        pairs = zip(vec.components(facing), vec.components(normal), strict=True)
        normal = vec.barrier(vec.stack(*(jnp.where(nearer, new, old) for new, old in pairs)))
        found |= nearer
    # Of all that follows much asks for a hit, and would work it out anew.
    distance, found = vec.stacked_barrier(distance, found.astype(distance.dtype))
    point = origins_ws - vec.scale(terrain.up_ws, distance)
    return Hit(point, normal, distance, found)


def layer_mask(*layers: int) -> int:
    """The mask that sees these layers and no others."""
    return sum(int(_bits(layer)) for layer in set(layers))


def plane(
    point: ArrayLike | tuple[float, ...] = (0.0, 0.0, 0.0),
    normal: ArrayLike | tuple[float, ...] = (0.0, 1.0, 0.0),
    up: ArrayLike | tuple[float, ...] = (0.0, 1.0, 0.0),
    layer: int = 0,
    dtype=None,
) -> Terrain:
    """An endless plane through `point`, m, on one layer (0 to 31).

    `normal` and `up` need not be unit. The dtype is that of the arrays given, else JAX's default.

    Raises:
        ValueError: a direction of no length, a layer that does not exist.
    """
    dtype = dtype or _dtype(point, normal, up)
    surface = Plane(
        jnp.asarray(point, dtype), _direction(normal, "normal", dtype), jnp.asarray(_bits(layer))
    )
    return Terrain(_direction(up, "up", dtype), (surface,))


def mesh(
    vertices: ArrayLike,
    triangles: ArrayLike,
    up: ArrayLike | tuple[float, ...] = (0.0, 1.0, 0.0),
    layer: int | ArrayLike = 0,
    slack: float = 0.0,
    dtype=None,
) -> Terrain:
    """Triangles over `vertices`, m, world; made on the host, so outside jit.

    Args:
        vertices: (vertices, 3), m.
        triangles: (triangles, 3), rows of `vertices`; either winding.
        up: need not be unit.
        layer: 0 to 31, one for all or one a triangle.
        slack: m, how far `with_vertices` may later move a vertex sideways. It lengthens the grid's
            lists: keep it below the size of a triangle.
        dtype: of the floats; None takes that of `vertices`, as far as JAX has it switched on.

    Raises:
        ValueError: wrong shapes, no triangle, vertices that are not finite or not there, an `up`
            of no length, a layer that does not exist.
    """
    dtype = dtype or _dtype(vertices)
    places, corners = np.asarray(vertices), np.asarray(triangles)
    _check(places, corners)
    up_ws = _direction(up, "up", dtype)
    surface = (
        jnp.asarray(places.astype(dtype), dtype),  # else the conversion would be a program
        jnp.asarray(corners.astype(np.int32), np.int32),
        jnp.asarray(np.broadcast_to(_bits(layer), len(corners)), np.uint32),
    )
    return Terrain(up_ws, (Mesh(*surface, grid.build(*surface, up_ws, slack)),))


def combine(*terrains: Terrain) -> Terrain:
    """One terrain with the surfaces of all; a ray meets the nearest.

    Raises:
        ValueError: nothing given, or up directions that differ.
    """
    if not terrains:
        raise ValueError("combine needs at least one terrain")
    ups = [terrain.up_ws for terrain in terrains]
    if not any(isinstance(up, Tracer) for up in ups):
        if not all(np.allclose(up, ups[0], rtol=0, atol=1e-6) for up in ups):
            listed = ", ".join(str(np.asarray(up).tolist()) for up in ups)
            raise ValueError(f"terrains to combine share one up direction; got {listed}")
    surfaces = (surface for terrain in terrains for surface in terrain.surfaces)
    return Terrain(ups[0], tuple(surfaces))


def _drop(
    origins: Float[Array, "*b 3"],
    up: Float[Array, "3"],
    point: Float[Array, "*#b 3"],
    normal: Float[Array, "*#b 3"],
) -> Float[Array, "*b"]:
    """Distance along -up to the plane; 0 where the plane contains up."""
    return vec.safe_divide(vec.dot(origins - point, normal), vec.dot(up, normal))


def _dtype(*given: ArrayLike | tuple[float, ...]) -> jnp.dtype:
    """The float dtype of the arrays among `given`, JAX's default where there are none."""
    arrays = [array for array in given if isinstance(array, jax.Array | np.ndarray)]
    return jnp.result_type(float, *arrays)


def _direction(given: ArrayLike | tuple[float, ...], name: str, dtype) -> Float[Array, "3"]:
    direction = jnp.asarray(given, dtype)
    if not isinstance(direction, Tracer):
        if direction.shape != (3,) or not 0 < np.sum(np.square(direction)) < np.inf:
            raise ValueError(f"{name} is a direction, three numbers with a length; got {given}")
    return _normalised(direction)


@jax.jit  # outside jit one program, not six
def _normalised(direction: Float[Array, "3"]) -> Float[Array, "3"]:
    return vec.scale(direction, 1.0 / vec.length(direction))


def _bits(layer: int | ArrayLike) -> np.ndarray:
    """The bit of each layer."""
    numbers = np.asarray(layer)
    if not np.issubdtype(numbers.dtype, np.integer) or ((numbers < 0) | (numbers >= LAYERS)).any():
        raise ValueError(f"layers are whole numbers from 0 to {LAYERS - 1}; got {layer}")
    return np.asarray(np.uint32(1) << numbers.astype(np.uint32))


def _check(vertices: np.ndarray, triangles: np.ndarray) -> None:
    """Refuses what is not a mesh."""
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ValueError(f"vertices have the shape (vertices, 3); got {vertices.shape}")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or not len(triangles):
        raise ValueError(f"triangles have the shape (1 or more, 3); got {triangles.shape}")
    if not np.issubdtype(triangles.dtype, np.integer):
        raise ValueError(f"triangles are rows of vertices, whole numbers; got {triangles.dtype}")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise ValueError(
            f"triangles name vertices 0 to {len(vertices) - 1}; got {triangles.min()} to "
            f"{triangles.max()}"
        )
    wrong = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if len(wrong):
        raise ValueError(
            f"{len(wrong)} of {len(vertices)} vertices are not finite, the first is vertex "
            f"{wrong[0]}: {vertices[wrong[0]].tolist()}"
        )
