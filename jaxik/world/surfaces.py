"""The surfaces of a terrain and how rays along -up hit them: planes, meshes, what moves."""

import dataclasses
from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from jaxik.maths import vec

from .grid import Grid, build, padded
from .skeleton import Transform

STATIC = -1  # the platform of what never moves
SLANTED = 5  # times that a slanted ray asks for the ground ahead


class AbstractSurface(eqx.Module):
    """Something that rays along -up can hit."""

    @property
    def platform(self) -> int:
        """Number of the platform that it moves with, or `STATIC`."""
        return STATIC

    def at(self, platforms: Transform) -> "AbstractSurface":
        """The surface where the platforms `world_from_platform` are."""
        return self

    @abstractmethod
    def moved(self, by_ws: Float[Array, "3"]) -> "AbstractSurface":
        """The surface moved by `by_ws`, m, world axes: for coordinates with another origin."""

    @abstractmethod
    def intersect(
        self, origins_ws: Float[Array, "*b 3"], up_ws: Float[Array, "3"], mask: UInt[Array, "*#b"]
    ) -> tuple[Float[Array, "*b"], Float[Array, "*b 3"], Bool[Array, "*b"]]:
        """Intersects rays with the surface; numbers stay finite where there is no hit.

        Returns:
            Distance, m, to the nearest hit at or below each origin; the unit normal there, on the
            side of the origin; and whether there is a hit.
        """


class Plane(AbstractSurface):
    """An infinite two-sided plane. A plane that contains up is never hit."""

    point_ws: Float[Array, "*t 3"]  # m
    normal_ws: Float[Array, "*t 3"]  # unit
    layers: UInt[Array, "*t"]  # one bit

    def moved(self, by_ws: Float[Array, "3"]) -> "Plane":
        return dataclasses.replace(self, point_ws=self.point_ws + by_ws)

    def intersect(
        self, origins_ws: Float[Array, "*b 3"], up_ws: Float[Array, "3"], mask: UInt[Array, "*#b"]
    ) -> tuple[Float[Array, "*b"], Float[Array, "*b 3"], Bool[Array, "*b"]]:
        rise = vec.dot(self.normal_ws, up_ws)
        # The point may be far away: its height is rounded once, and so in the same way for all.
        over = vec.dot(origins_ws, self.normal_ws) - vec.dot(self.point_ws, self.normal_ws)
        distance = vec.safe_divide(over, rise)
        # A ray that starts on the plane hits it, however the difference is rounded.
        parts = (vec.dot(jnp.abs(x), jnp.abs(self.normal_ws)) for x in (origins_ws, self.point_ws))
        tolerance = 4 * jnp.finfo(distance.dtype).eps * jax.lax.stop_gradient(sum(parts))
        steepness = jnp.abs(rise)
        hit = (steepness > 0) & (distance * steepness >= -tolerance) & (self.layers & mask != 0)
        normal = jnp.where(rise < 0, -self.normal_ws, self.normal_ws)
        return distance, jnp.broadcast_to(normal, (*distance.shape, 3)), hit


class Mesh(AbstractSurface):
    """Two-sided triangles and the grid that finds them.

    Watertight: no ray passes through an edge or a corner that triangles share. A triangle that
    contains up (a wall) or has no area is never hit, since a ray along it has no single answer.

    Arrays have one of a few lengths, so that meshes of different sizes share compiled programs.
    What fills them up, copies of a vertex and triangles without area on no layer, is never hit;
    `on_host` leaves it out.
    """

    vertices_ws: Float[Array, "*t vertices 3"]  # m
    triangles: Int[Array, "*t triangles 3"]
    layers: UInt[Array, "*t triangles"]  # one bit each
    grid: Grid
    offset_ws: Float[Array, "*t 3"] | None = None
    """m, to be added to vertices and grid; None for nothing."""

    @classmethod
    def build(
        cls,
        vertices_ws: Float[np.ndarray, "vertices 3"],
        triangles: Int[np.ndarray, "triangles 3"],
        layers: UInt[np.ndarray, " triangles"],
        up_ws: Float[Array, "3"],
        slack: float = 0.0,
    ) -> "Mesh":
        """A mesh of arrays on the host, and its grid; see `jaxik.terrain.mesh`."""
        faces = padded(triangles.astype(np.int32), triangles[0, 0])
        arrays = (
            jnp.asarray(padded(vertices_ws, vertices_ws[0], len(faces))),
            jnp.asarray(faces),
            jnp.asarray(padded(layers.astype(np.uint32), 0)),
        )
        return cls(*arrays, build(*arrays, up_ws, slack))

    def on_host(
        self,
    ) -> tuple[
        Float[np.ndarray, "vertices 3"],
        Int[np.ndarray, "triangles 3"],
        UInt[np.ndarray, " triangles"],
    ]:
        """Vertices where they have moved to, m, triangles and their layers."""
        layers = np.asarray(self.layers)
        triangles = np.asarray(self.triangles)[layers > 0]
        vertices_ws = np.asarray(self.vertices_ws)[: triangles.max() + 1]
        if self.offset_ws is not None:
            vertices_ws = vertices_ws + np.asarray(self.offset_ws)
        return vertices_ws, triangles, layers[layers > 0]

    def moved(self, by_ws: Float[Array, "3"]) -> "Mesh":
        offset_ws = by_ws if self.offset_ws is None else self.offset_ws + by_ws
        return dataclasses.replace(self, offset_ws=offset_ws)

    def centre_of(self, grid: Grid) -> Float[Array, "3"]:
        """m, the origin of a grid's frame, which has moved with the mesh."""
        return grid.centre_ws if self.offset_ws is None else grid.centre_ws + self.offset_ws

    def with_vertices(self, vertices_ws: Float[Array, "vertices 3"]) -> "Mesh":
        """The same triangles with moved vertices, m; differentiable.

        The grid is kept. It finds every triangle as long as no vertex has moved further sideways
        (at right angles to up) than the `slack` that the mesh was built with; movement along up is
        unlimited. Beyond that, a ray may miss a moved triangle.

        Raises:
            ValueError: more vertices than the mesh has.
        """
        missing = len(self.vertices_ws) - len(vertices_ws)
        if missing < 0:
            raise ValueError(
                f"the mesh has at most {len(self.vertices_ws)} vertices; got {len(vertices_ws)}"
            )
        ends = jnp.broadcast_to(vertices_ws[:1], (missing, 3))
        vertices_ws = jnp.concatenate([vertices_ws, ends])
        triangles, layers = self.triangles, self.layers
        grid = self.grid.with_vertices(vertices_ws, triangles, layers)
        return Mesh(vertices_ws, triangles, layers, grid, self.offset_ws)

    def intersect(
        self, origins_ws: Float[Array, "*b 3"], up_ws: Float[Array, "3"], mask: UInt[Array, "*#b"]
    ) -> tuple[Float[Array, "*b"], Float[Array, "*b 3"], Bool[Array, "*b"]]:
        triangle = self.grid.search(origins_ws - self.centre_of(self.grid), mask)
        hit = triangle >= 0
        corners = self.triangles.at[jnp.where(hit, triangle, 0)].get(mode="promise_in_bounds")
        a, b, c = (
            self.vertices_ws.at[corners[..., corner]].get(mode="promise_in_bounds")
            for corner in range(3)
        )
        if self.offset_ws is not None:
            a, b, c = (corner + self.offset_ws for corner in (a, b, c))
        normal = vec.triangle_normal(a, b, c, up_ws)
        distance = plane_distance(origins_ws, up_ws, a, normal)
        # A ray that rounding lets in lies just outside its triangle, which a steep plane turns into
        # a large error: the value is clipped to the corners, the gradient stays that of the plane.
        drops = [vec.dot(origins_ws - corner, up_ws) for corner in (a, b, c)]
        low = jnp.minimum(jnp.minimum(drops[0], drops[1]), drops[2])
        high = jnp.maximum(jnp.maximum(drops[0], drops[1]), drops[2])
        distance += jax.lax.stop_gradient(jnp.clip(distance, low, high) - distance)
        # Without the barrier each use of a hit would compute it from the corners again.
        x, y, z, distance = vec.stacked_barrier(*vec.components(normal), distance)
        return distance, vec.stack(x, y, z), hit


class MovingSurface(AbstractSurface):
    """A surface given in the space of a platform, which moves."""

    surface: AbstractSurface
    world_from_platform: Transform
    up_ps: Float[Array, "*t 3"]
    """Unit, up of the surface in the platform's space."""
    number: int = eqx.field(static=True)
    """Of the platform, among `Frame.platforms`."""
    tilts: bool = eqx.field(static=True)
    """Whether its up may leave the world's."""

    @property
    def platform(self) -> int:
        return self.number

    def at(self, platforms: Transform) -> "MovingSurface":
        pose = Transform(platforms.pos[..., self.number, :], platforms.rot[..., self.number, :])
        return dataclasses.replace(self, world_from_platform=pose)

    def moved(self, by_ws: Float[Array, "3"]) -> "MovingSurface":
        pose = self.world_from_platform
        return dataclasses.replace(self, world_from_platform=Transform(pose.pos + by_ws, pose.rot))

    def intersect(
        self, origins_ws: Float[Array, "*b 3"], up_ws: Float[Array, "3"], mask: UInt[Array, "*#b"]
    ) -> tuple[Float[Array, "*b"], Float[Array, "*b 3"], Bool[Array, "*b"]]:
        platform_from_world = self.world_from_platform.inverse()
        origins, up = platform_from_world.apply(origins_ws), platform_from_world.turn(up_ws)
        cast = self._slanted if self.tilts else self.surface.intersect
        distance, normal, hit = cast(origins, up, mask)
        return distance, self.world_from_platform.turn(normal), hit

    def _slanted(
        self, origins: Float[Array, "*b 3"], up: Float[Array, "3"], mask: UInt[Array, "*#b"]
    ) -> tuple[Float[Array, "*b"], Float[Array, "*b 3"], Bool[Array, "*b"]]:
        """Intersects rays that do not run along the up that the surface is made for.

        By Newton's method: the plane of the ground below the ray, as it is where the ray meets the
        plane found before. Where the slope of the ground times that of the tilt is below 1, there
        is one hit and this finds it, but for rays beside the edge of a step, within its height
        times the tilt.
        """
        start = origins
        for _ in range(SLANTED):
            start = jax.lax.stop_gradient(start)
            drop, normal, hit = self.surface.intersect(start, self.up_ps, mask)
            touched = start - vec.scale(self.up_ps, drop)
            distance = plane_distance(origins, up, touched, normal)
            start = origins + vec.scale(self.up_ps - up, distance)
        return distance, normal, hit & (vec.dot(normal, up) > 0)


def plane_distance(
    origins: Float[Array, "*b 3"],
    up: Float[Array, "3"],
    point: Float[Array, "*#b 3"],
    normal: Float[Array, "*#b 3"],
) -> Float[Array, "*b"]:
    """Distance of points along -up to a plane, m; 0 where the plane contains up."""
    return vec.safe_divide(vec.dot(origins - point, normal), vec.dot(up, normal))
