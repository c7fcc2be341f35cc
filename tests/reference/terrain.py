"""Rays down onto planes and triangle lists, by trying every surface."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from .maths import Array

# Cosine between a surface's normal and up below which a vertical ray runs along the surface.
EDGE_ON = 1e-9
# Barycentric slack, so that a ray through a shared edge meets at least one of its triangles.
SLACK = 1e-12


class Hit(NamedTuple):
    """Where a ray ended. Without a find: the ray's end, and up as normal."""

    found: bool
    point: Array
    normal: Array


@dataclass
class Terrain:
    """Planes and triangles under one up direction.

    Args:
        up: unit (3); rays run against it.
        planes: pairs of a point (3) and a normal (3, any length), seen from both sides.
        triangles: (count, 3 corners, 3), m, seen from both sides, in any winding.
    """

    up: Array
    planes: list[tuple[Array, Array]] = field(default_factory=list)
    triangles: Array = field(default_factory=lambda: np.zeros((0, 3, 3)))

    def __post_init__(self) -> None:
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

    def cast(self, origin: Array, reach: float) -> Hit:
        """The first surface at most `reach` m below `origin`, its normal towards up.

        Among surfaces at the same distance the first in the list wins, planes before triangles.
        """
        nearest, normal, found = reach, self.up, False
        for point, plane_normal in self.planes:
            facing = plane_normal / np.linalg.norm(plane_normal)
            facing = -facing if facing @ self.up < 0.0 else facing
            if facing @ self.up <= EDGE_ON:
                continue
            distance = float((origin - point) @ facing / (facing @ self.up))
            if 0.0 <= distance <= reach and (not found or distance < nearest):
                nearest, normal, found = distance, facing, True
        if len(self.triangles):
            distances = self._distances(origin)
            best = int(np.argmin(distances))
            distance = float(distances[best])
            if distance <= reach and (not found or distance < nearest):
                nearest, normal, found = distance, self._normal[best], True
        return Hit(found, origin - self.up * nearest, normal)

    def _distances(self, origin: Array) -> Array:
        """Distance down to every triangle (count), infinite where the ray passes it by."""
        away = origin - self._corner
        first = np.sum(away * self._side, axis=-1) * self._scale
        turned = np.cross(away, self._first)
        second = (turned @ -self.up) * self._scale
        distance = np.sum(turned * self._second, axis=-1) * self._scale
        inside = (first >= -SLACK) & (second >= -SLACK) & (first + second <= 1.0 + SLACK)
        return np.where(self._usable & inside & (distance >= 0.0), distance, np.inf)
