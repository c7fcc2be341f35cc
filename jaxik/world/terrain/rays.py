"""Surfaces under one up direction, and rays cast onto them along -up."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt

from jaxik.maths import vec
from jaxik.maths.struct import place, struct
from jaxik.world.skeleton import Transform
from jaxik.world.surfaces import STATIC, AbstractSurface, Mesh

ALL_LAYERS = 0xFFFFFFFF  # a mask that includes every layer
HORIZON = 1e4  # m; longer rays, infinite ones too, end here


@struct
class Hit:
    """What a ray hit. A miss has `found` 0, the end of the ray as its point and up as normal."""

    point: Float[Array, "*b 3"] = place("point")
    """m, world."""
    normal: Float[Array, "*b 3"]
    """Unit, on the side of the ray's origin: never points down."""
    distance: Float[Array, "*b"]
    """m from the origin; the full length of the ray for a miss."""
    found: Float[Array, "*b"]
    """1 or 0."""
    platform: Int[Array, "*b"] | None = None
    """Number of the platform that was hit, `STATIC` for static ground and misses; None where the
    terrain has no platforms."""


@struct
class Terrain:
    """Surfaces under one up direction."""

    up_ws: Float[Array, "*t 3"]
    """Unit; rays run along its opposite."""
    surfaces: tuple[AbstractSurface, ...]

    @property
    def body(self) -> "Terrain":
        """The terrain that rays of the root hit."""
        return self

    @property
    def leg_up_ws(self) -> Float[Array, "*t 3"]:
        """Up of the legs, which all share it."""
        return self.up_ws

    @property
    def platform_count(self) -> int:
        """How many platforms it needs at least; 0 where nothing moves."""
        return 1 + max((surface.platform for surface in self.surfaces), default=STATIC)

    def at(self, platforms: Transform) -> "Terrain":
        """The terrain with what moves where the platforms `world_from_platform` (platforms) are."""
        surfaces = tuple(surface.at(platforms) for surface in self.surfaces)
        return Terrain(self.up_ws, surfaces)

    def moved(self, by_ws: Float[Array, "3"]) -> "Terrain":
        """The terrain moved by `by_ws`, m, with the platforms where they are now."""
        return Terrain(self.up_ws, tuple(surface.moved(by_ws) for surface in self.surfaces))

    def first_hits(
        self,
        origins_ws: Float[Array, "*b 3"],
        reach: Float[Array, "*#b"],
        mask: UInt[Array, "*#b"],
        moves: bool,
    ) -> Hit:
        """What `cast` gives for these rays; `moves` is whether hits have platforms."""
        return _nearest(self, origins_ws, reach, mask, moves)

    def with_vertices(self, vertices_ws: Float[Array, "vertices 3"], surface: int = 0) -> "Terrain":
        """This terrain with moved vertices in one of its meshes; see `Mesh.with_vertices`.

        Raises:
            ValueError: that surface is not a mesh.
        """
        mesh = self.surfaces[surface]
        if not isinstance(mesh, Mesh):
            raise ValueError(
                f"surface {surface} is a {type(mesh).__name__}; only a Mesh has vertices"
            )
        return eqx.tree_at(
            lambda terrain: terrain.surfaces[surface], self, mesh.with_vertices(vertices_ws)
        )


@struct
class LegTerrains:
    """The same world with an up direction per leg: rays of leg i run along -up of leg i.

    For feet on walls and hands on ladders. The grid of a mesh is built for one up direction, so
    each distinct up needs its own copy of the mesh; legs with the same up can share a terrain.
    """

    body: Terrain
    """Up of the body, and the ground that rays of the root hit."""
    legs: tuple[Terrain, ...]
    """One per leg."""

    @property
    def up_ws(self) -> Float[Array, "3"]:
        """Up of the body."""
        return self.body.up_ws

    @property
    def leg_up_ws(self) -> Float[Array, "legs 3"]:
        """Up of each leg."""
        return jnp.stack([terrain.up_ws for terrain in self.legs])

    @property
    def platform_count(self) -> int:
        """How many platforms it needs at least; 0 where nothing moves."""
        return max(terrain.platform_count for terrain in (self.body, *self.legs))

    def at(self, platforms: Transform) -> "LegTerrains":
        """The terrains with what moves where the platforms are; see `Terrain.at`."""
        legs = tuple(terrain.at(platforms) for terrain in self.legs)
        return LegTerrains(self.body.at(platforms), legs)

    def moved(self, by_ws: Float[Array, "3"]) -> "LegTerrains":
        """The terrains moved by `by_ws`, m; see `Terrain.moved`."""
        legs = tuple(terrain.moved(by_ws) for terrain in self.legs)
        return LegTerrains(self.body.moved(by_ws), legs)


def cast(
    terrain: Terrain | LegTerrains,
    origins_ws: Float[Array, "*b 3"],
    reach: Float[Array, "*#b"] | float,
    mask: UInt[Array, "*#b"] | int = ALL_LAYERS,
) -> Hit:
    """The first hits of rays along -up.

    A ray that starts on a surface hits it; its distance can then be negative by a rounding error.
    On an edge that triangles share, the normal of either may be returned.

    Args:
        terrain: the surfaces.
        origins_ws: where the rays start, m; with `LegTerrains` (..., legs, 3).
        reach: their lengths, m; more than `HORIZON`, or infinite, counts as `HORIZON`.
        mask: the layers that each ray can hit, one bit per layer (`layer_mask`).
    """
    reach, mask = jnp.asarray(reach, origins_ws.dtype), jnp.asarray(mask, jnp.uint32)
    moves = terrain.platform_count > 0
    if isinstance(terrain, Terrain):
        return terrain.first_hits(origins_ws, reach, mask, moves)
    reach, mask = (jnp.broadcast_to(x, origins_ws.shape[:-1]) for x in (reach, mask))
    hits = [
        ground.first_hits(origins_ws[..., leg, :], reach[..., leg], mask[..., leg], moves)
        for leg, ground in enumerate(terrain.legs)
    ]
    axis = origins_ws.ndim - 2
    return jax.tree.map(lambda *leaves: jnp.stack(leaves, axis=axis), *hits)


# Outside jit, a call then compiles once per shape and not once per operation.
@functools.partial(jax.jit, static_argnames="moves")
def _nearest(
    terrain: Terrain,
    origins_ws: Float[Array, "*b 3"],
    reach: Float[Array, "*#b"],
    mask: UInt[Array, "*#b"],
    moves: bool,
) -> Hit:
    distance = jnp.broadcast_to(jnp.minimum(reach, HORIZON), origins_ws.shape[:-1])
    normal = jnp.broadcast_to(terrain.up_ws, origins_ws.shape)
    found = jnp.zeros(distance.shape, bool)
    platform = jnp.full(distance.shape, STATIC)
    for surface in terrain.surfaces:
        drop, facing, hit = surface.intersect(origins_ws, terrain.up_ws, mask)
        nearer = hit & (drop <= distance)
        distance = jnp.where(nearer, drop, distance)
        pairs = zip(vec.components(facing), vec.components(normal), strict=True)
        normal = vec.barrier(vec.stack(*(jnp.where(nearer, new, old) for new, old in pairs)))
        found |= nearer
        platform = jnp.where(nearer, surface.platform, platform)
    # Hits have many consumers, each of which would compute them again without the barrier.
    distance, found = vec.stacked_barrier(distance, found.astype(distance.dtype))
    point = origins_ws - vec.scale(terrain.up_ws, distance)
    return Hit(point, normal, distance, found, platform if moves else None)
