"""Heightfields: one height over each point of a plane at right angles to up.

Over a regular grid (`Heightfield`), or by a function of one's own (`HeightFunction`). Neither
searches: the place of a ray says at once which cell it hits, however large the grid is.
"""

import dataclasses
from abc import abstractmethod
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, UInt

from jaxik.maths import vec

from .surfaces import AbstractSurface

INTERPOLATIONS = ("bilinear", "triangulated")
HeightOf: TypeAlias = Callable[[Array, Array], ArrayLike]  # of x and z, m


class Sample(NamedTuple):
    """A heightfield over some points of its plane; finite over holes too."""

    height: Float[Array, "*b"]
    """m along up, from the origin."""
    slope_x: Float[Array, "*b"]
    """m/m."""
    slope_z: Float[Array, "*b"]
    """m/m."""
    solid: Bool[Array, "*b"]
    """False over a hole and beyond the border."""


class AbstractHeightfield(AbstractSurface):
    """One height over each point of a plane at right angles to up, except over holes."""

    origin_ws: Float[Array, "*t 3"]
    """m, where x, z and height are 0."""
    axes_ws: Float[Array, "*t 3 3"]
    """Rows: x, up and z, unit; those of the world where up is its y."""
    layers: UInt[Array, "*t"]
    """One bit."""

    def moved(self, by_ws: Float[Array, "3"]) -> "AbstractHeightfield":
        return dataclasses.replace(self, origin_ws=self.origin_ws + by_ws)

    @abstractmethod
    def sample(
        self, x: Float[Array, "*b"], z: Float[Array, "*b"], rounding: Float[Array, "*b"]
    ) -> Sample:
        """Heights and slopes.

        Args:
            x: m from the origin, along the first axis.
            z: m from the origin, along the third axis.
            rounding: m by which x and z may be off; a point this far outside the border is inside.
        """

    def intersect(
        self, origins_ws: Float[Array, "*b 3"], up_ws: Float[Array, "3"], mask: UInt[Array, "*#b"]
    ) -> tuple[Float[Array, "*b"], Float[Array, "*b 3"], Bool[Array, "*b"]]:
        offset = origins_ws - self.origin_ws
        x, y, z = vec.stacked_barrier(*(vec.dot(offset, self.axes_ws[axis]) for axis in range(3)))
        # As for a plane: a ray that starts on the ground hits it, however its numbers are rounded.
        size = vec.sum_last(jnp.abs(origins_ws)) + vec.sum_last(jnp.abs(self.origin_ws))
        rounding = jnp.finfo(y.dtype).eps * jax.lax.stop_gradient(size)
        height, slope_x, slope_z, solid = self.sample(x, z, rounding)
        distance = y - height
        steepness = jax.lax.stop_gradient(jnp.abs(slope_x) + jnp.abs(slope_z))
        hit = solid & (distance >= -rounding * (1 + steepness)) & (self.layers & mask != 0)
        inverse = 1 / jnp.sqrt(1 + slope_x * slope_x + slope_z * slope_z)
        axes = zip(*(vec.components(self.axes_ws[axis]) for axis in range(3)), strict=True)
        normal = ((up - slope_x * side - slope_z * front) * inverse for side, up, front in axes)
        # Without the barrier each use of a hit would compute it from the heights again.
        distance, *normal = vec.stacked_barrier(distance, *normal)
        return distance, vec.stack(*normal), hit


class Heightfield(AbstractHeightfield):
    """Heights on a regular grid, rows along z and columns along x.

    Differentiable in the rays, the heights, the spacing and the origin. On a line between cells
    the slope is that of the cell on its far side.
    """

    heights: Float[Array, "*t rows columns"]
    """m; a cell with a NaN at a corner is a hole."""
    spacing: Float[Array, "*t 2"]
    """m between columns (along x) and between rows (along z)."""
    interpolation: str = eqx.field(static=True)
    """One of `INTERPOLATIONS`, within each cell; see `jaxik.world.terrain.heightfield`."""

    def sample(
        self, x: Float[Array, "*b"], z: Float[Array, "*b"], rounding: Float[Array, "*b"]
    ) -> Sample:
        rows, columns = self.heights.shape
        size_x, size_z = vec.unstack(self.spacing)
        column, across, inside_x = _cell(x, size_x, columns, rounding)
        row, along, inside_z = _cell(z, size_z, rows, rounding)
        heights, corner = self.heights.reshape(-1), row * columns + column
        corners = [
            heights.at[corner + step].get(mode="promise_in_bounds")
            for step in (0, 1, columns, columns + 1)
        ]
        solid = inside_x & inside_z & jnp.isfinite(sum(corners[1:], corners[0]))
        near, near_next, far, far_next = (jnp.where(solid, height, 0.0) for height in corners)
        if self.interpolation == "bilinear":
            twist = near - near_next - far + far_next
            rise_x = near_next - near + along * twist
            rise_z = far - near + across * twist
            height = near + across * (near_next - near) + along * rise_z
        else:
            below = along >= across  # in the triangle that has the corner of the next row
            rise_x = jnp.where(below, far_next - far, near_next - near)
            rise_z = jnp.where(below, far - near, far_next - near_next)
            height = near + across * rise_x + along * rise_z
        return Sample(height, rise_x / size_x, rise_z / size_z, solid)


def _cell(
    distance: Float[Array, "*b"], spacing: Float[Array, ""], count: int, rounding: Array
) -> tuple[Array, Float[Array, "*b"], Bool[Array, "*b"]]:
    """The cell along one axis of `count` lines, the place in it from 0 to 1, whether inside."""
    place = distance / spacing
    slack = rounding / jax.lax.stop_gradient(spacing)
    inside = (place >= -slack) & (place <= count - 1 + slack)
    place = jnp.where(inside, place, 0.0)
    index = jnp.clip(jnp.floor(jax.lax.stop_gradient(place)), 0, count - 2)
    return index.astype(jnp.int32), place - index, inside


class HeightFunction(AbstractHeightfield):
    """Heights by a function; see `jaxik.world.terrain.function`."""

    height: HeightOf
    """Of x and z, m, of one point; a tree, whose arrays are traced."""

    def sample(
        self, x: Float[Array, "*b"], z: Float[Array, "*b"], rounding: Float[Array, "*b"]
    ) -> Sample:
        def height_at(x: Float[Array, ""], z: Float[Array, ""]) -> Float[Array, ""]:
            return jnp.asarray(self.height(x, z), x.dtype)

        @jnp.vectorize
        def height_and_slopes(x: Float[Array, ""], z: Float[Array, ""]) -> tuple[Array, ...]:
            one, zero = jnp.ones_like(x), jnp.zeros_like(x)
            height, slope_x = jax.jvp(height_at, (x, z), (one, zero))
            return height, slope_x, jax.jvp(height_at, (x, z), (zero, one))[1]

        height, slope_x, slope_z = height_and_slopes(x, z)
        solid = jnp.isfinite(height + slope_x + slope_z)
        height, slope_x, slope_z = (
            jnp.where(solid, number, 0.0) for number in (height, slope_x, slope_z)
        )
        return Sample(height, slope_x, slope_z, solid)
