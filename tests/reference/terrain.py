"""Rays cast down onto planes and lists of triangles, by testing every surface."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reference.maths import Array, Transform, apply, rotate

EDGE_ON = 1e-9  # cosine between a surface's normal and up below which rays run along the surface
ALL_LAYERS = 0xFFFFFFFF
SLACK = 1e-12  # barycentric: a ray through a shared edge hits at least one of its triangles


class Hit(NamedTuple):
    """What a ray hit. For a miss: the end of the ray (its start if infinite) and up as normal."""

    found: float
    point: Array
    normal: Array
    platform: int = -1


@dataclass
class Terrain:
    """Planes and triangles under one up direction.

    Args:
        up: unit (3); rays run against it.
        planes: pairs of a point (3) and a normal (3, any length), two-sided.
        triangles: (count, 3 corners, 3), m, two-sided, in any winding.
        plane_layers: layer of each plane, 0 to 31; all 0 by default.
        triangle_layers: (count), layer of each triangle, likewise.
        platform: number of the platform in whose space all of it is given; -1 for the world.
    """

    up: Array
    planes: list[tuple[Array, Array]] = field(default_factory=list)
    triangles: Array = field(default_factory=lambda: np.zeros((0, 3, 3)))
    plane_layers: list[int] = field(default_factory=list)
    triangle_layers: Sequence[int] | NDArray[np.integer] = ()
    platform: int = -1

    def __post_init__(self) -> None:
        self.plane_layers = list(self.plane_layers) or [0] * len(self.planes)
        if len(self.triangle_layers) == 0:
            self.triangle_layers = np.zeros(len(self.triangles), int)
        self._layers = np.concatenate([self.plane_layers, self.triangle_layers]).astype(int)
        points, normals = np.reshape(self.planes, (-1, 2, 3)).swapaxes(0, 1)
        corners = self.triangles[:, 0]
        first, second = self.triangles[:, 1] - corners, self.triangles[:, 2] - corners
        self._points = np.concatenate([points, corners])
        normals = np.concatenate([normals, np.cross(first, second)])
        size = np.linalg.norm(normals, axis=-1, keepdims=True)
        normals = normals / np.where(size > 0.0, size, 1.0)
        self._normals = normals * np.where(normals @ self.up < 0.0, -1.0, 1.0)[:, None]
        facing = self._normals @ self.up
        self._usable = facing > EDGE_ON
        # What gives, of the way from a point of a surface to a ray's origin, the distance down and
        # the barycentric coordinates there, 0 for planes: after Moeller and Trumbore.
        sides = np.cross(-self.up, second), np.cross(first, -self.up)
        volume = np.sum(first * sides[0], axis=-1, keepdims=True)
        scale = np.where(volume == 0.0, 0.0, 1.0 / np.where(volume == 0.0, 1.0, volume))
        self._axes = np.zeros((3, *self._points.shape))
        self._axes[0] = self._normals / np.where(self._usable, facing, 1.0)[:, None]
        self._axes[1:, len(points) :] = np.array(sides) * scale

    def at(self, platforms: Sequence[Transform]) -> "Terrain":
        """The terrain where its platform is, in world space."""
        if self.platform < 0:
            return self
        pose = platforms[self.platform]
        axes = np.array([rotate(pose.rot, axis) for axis in np.eye(3)])
        return replace(
            self,
            planes=[
                (apply(pose, point), rotate(pose.rot, normal)) for point, normal in self.planes
            ],
            triangles=pose.pos + self.triangles @ axes,
        )

    def cast(self, origin: Array, reach: float, mask: int = ALL_LAYERS) -> Hit:
        """The first surface at most `reach` m below `origin`, its normal towards up.

        Rays pass through surfaces whose layer is not in `mask`. Among surfaces at the same
        distance the first in the list wins, planes before triangles.
        """
        away = origin - self._points
        distances, first, second = np.einsum("kij,ij->ki", self._axes, away)
        inside = (first >= -SLACK) & (second >= -SLACK) & (first + second <= 1.0 + SLACK)
        hit = self._usable & inside & (mask >> self._layers & 1 == 1)
        hit &= (distances >= 0.0) & (distances <= reach)
        if not hit.any():
            return Hit(False, origin - self.up * reach if math.isfinite(reach) else origin, self.up)
        best = int(np.argmin(np.where(hit, distances, np.inf)))
        point = origin - self.up * distances[best]
        return Hit(True, point, self._normals[best], self.platform)


@dataclass
class LegTerrains:
    """The world with an up direction per leg; the body has a terrain too."""

    body: Terrain
    legs: Sequence[Terrain]

    @property
    def up(self) -> Array:
        """Up of the body."""
        return self.body.up

    def at(self, platforms: Sequence[Transform]) -> "LegTerrains":
        """The terrains where their platforms are."""
        return LegTerrains(self.body.at(platforms), [leg.at(platforms) for leg in self.legs])

    def cast(self, origin: Array, reach: float, mask: int = ALL_LAYERS) -> Hit:
        """The first hit of a ray of the body."""
        return self.body.cast(origin, reach, mask)
