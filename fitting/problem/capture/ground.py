"""Ground that is higher than its file says, or tilted.

A ray along -up keeps its place seen from above, so it meets raised ground where a ray that starts
as much lower meets the ground as it is. So no mesh is built anew, nor moved for each parameter.
"""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt

from jaxik.maths import vec
from jaxik.world.skeleton import Transform
from jaxik.world.surfaces import AbstractSurface
from jaxik.world.terrain import Terrain


class RaisedSurface(AbstractSurface):
    """A surface raised along up by a height that is linear in the place."""

    surface: AbstractSurface
    centre_ws: Float[Array, "3"]
    """m, where it is raised by `height`."""
    height: Float[Array, ""]
    """Metres."""
    slope_ws: Float[Array, "3"]
    """m/m, at right angles to up: what the height gains along each axis of the world."""

    @property
    def platform(self) -> int:
        """That of the surface."""
        return self.surface.platform

    def at(self, platforms: Transform) -> "RaisedSurface":
        """The surface where the platforms are, raised as before."""
        return dataclasses.replace(self, surface=self.surface.at(platforms))

    def moved(self, by_ws: Float[Array, "3"]) -> "RaisedSurface":
        """The raised surface moved by `by_ws`, m."""
        surface, centre_ws = self.surface.moved(by_ws), self.centre_ws + by_ws
        return dataclasses.replace(self, surface=surface, centre_ws=centre_ws)

    def intersect(
        self, origins_ws: Float[Array, "*b 3"], up_ws: Float[Array, "3"], mask: UInt[Array, "*#b"]
    ) -> tuple[Float[Array, "*b"], Float[Array, "*b 3"], Bool[Array, "*b"]]:
        """Intersects rays with the raised surface; see `AbstractSurface.intersect`."""
        rise = self.height + vec.dot(origins_ws - self.centre_ws, self.slope_ws)
        lowered = origins_ws - vec.scale(up_ws, rise)
        distance, normal, hit = self.surface.intersect(lowered, up_ws, mask)
        sheared = normal - vec.scale(self.slope_ws, vec.dot(normal, up_ws))
        return distance, vec.scale(sheared, 1.0 / vec.length(sheared)), hit


def raised(
    terrain: Terrain,
    centre_ws: Float[Array, "3"],
    height: Float[Array, ""],
    tilts: tuple[Float[Array, ""], Float[Array, ""]],
) -> Terrain:
    """The terrain, raised and tilted along up.

    Args:
        terrain: the terrain.
        centre_ws: m, about which it is tilted.
        height: m, by which it is raised there.
        tilts: rad, by which it rises along the world's x and z.
    """
    along_x, along_z = map(jnp.tan, tilts)
    slope_ws = vec.stack(along_x, jnp.zeros_like(along_x), along_z)
    slope_ws = slope_ws - vec.scale(terrain.up_ws, vec.dot(slope_ws, terrain.up_ws))
    surfaces = (RaisedSurface(surface, centre_ws, height, slope_ws) for surface in terrain.surfaces)
    return Terrain(terrain.up_ws, tuple(surfaces))
