"""Rays cast down onto planes and lists of triangles, by testing every surface."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reference.maths import Array, Transform, apply, rotate

# Cosine between a surface's normal and up below which the ray runs along the surface.
EDGE_ON = 1e-9
ALL_LAYERS = 0xFFFFFFFF
# Barycentric tolerance: a ray through a shared edge hits at least one of its triangles.
SLACK = 1e-12


class Hit(NamedTuple):
    """What a ray hit. For a miss: the end of the ray (its start if infinite) and up as normal."""

    found: bool
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
        self.triangle_layers = np.asarray(self.triangle_layers)
        self._corner = self.triangles[:, 0]
        self._first = self.triangles[:, 1] - self._corner
        self._second = self.triangles[:, 2] - self._corner
        normal = np.cross(self._first, self._second)
        size = np.linalg.norm(normal, axis=-1)
        solid = size > 0.0
        normal = normal / np.where(solid, size, 1.0)[:, None]
        self._normal = normal * np.where(normal @ self.up < 0.0, -1.0, 1.0)[:, None]
        # Moeller and Trumbore, with the direction -up: what does not depend on the origin.
        self._side = np.cross(-self.up, self._second)
        volume = np.sum(self._first * self._side, axis=-1)
        self._usable = solid & (self._normal @ self.up > EDGE_ON)
        self._scale = np.where(self._usable, 1.0 / np.where(self._usable, volume, 1.0), 0.0)

    def at(self, platforms: Sequence[Transform]) -> "Terrain":
        """The terrain where its platform is, in world space."""
        if self.platform < 0:
            return self
        pose = platforms[self.platform]
        corners = [apply(pose, corner) for corner in self.triangles.reshape(-1, 3)]
        return replace(
            self,
            planes=[
                (apply(pose, point), rotate(pose.rot, normal)) for point, normal in self.planes
            ],
            triangles=np.reshape(corners, (-1, 3, 3)),
        )

    def cast(self, origin: Array, reach: float, mask: int = ALL_LAYERS) -> Hit:
        """The first surface at most `reach` m below `origin`, its normal towards up.

        Rays pass through surfaces whose layer is not in `mask`. Among surfaces at the same
        distance the first in the list wins, planes before triangles.
        """
        nearest, normal, found = reach, self.up, False
        for (point, plane_normal), layer in zip(self.planes, self.plane_layers, strict=True):
            if not mask >> layer & 1:
                continue
            facing = plane_normal / np.linalg.norm(plane_normal)
            facing = -facing if facing @ self.up < 0.0 else facing
            if facing @ self.up <= EDGE_ON:
                continue
            distance = float((origin - point) @ facing / (facing @ self.up))
            if 0.0 <= distance <= reach and (not found or distance < nearest):
                nearest, normal, found = distance, facing, True
        if len(self.triangles):
            visible = (mask >> np.asarray(self.triangle_layers)) & 1 == 1
            distances = np.where(visible, self._distances(origin), np.inf)
            best = int(np.argmin(distances))
            distance = float(distances[best])
            if math.isfinite(distance) and distance <= reach and (not found or distance < nearest):
                nearest, normal, found = distance, self._normal[best], True
        platform = self.platform if found else -1
        if math.isinf(nearest):
            return Hit(found, origin, normal, platform)
        return Hit(found, origin - self.up * nearest, normal, platform)

    def _distances(self, origin: Array) -> Array:
        """Distance down to every triangle (count), infinite where the ray misses it."""
        away = origin - self._corner
        first = np.sum(away * self._side, axis=-1) * self._scale
        cross = np.cross(away, self._first)
        second = (cross @ -self.up) * self._scale
        distance = np.sum(cross * self._second, axis=-1) * self._scale
        inside = (first >= -SLACK) & (second >= -SLACK) & (first + second <= 1.0 + SLACK)
        return np.where(self._usable & inside & (distance >= 0.0), distance, np.inf)


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
