"""Curves that synthetic motion follows: easing between values, and paths over the floor."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

WAVELENGTHS = (9.0, 5.3)  # m, of a path's bends


def smoothstep(x: np.ndarray) -> np.ndarray:
    """Quintic from 0 to 1 as x goes from 0 to 1, with zero slope and curvature at both ends."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10.0 + x * (6.0 * x - 15.0))


def hermite(
    x: np.ndarray, start: np.ndarray, slope: np.ndarray, end: np.ndarray, end_slope: np.ndarray
) -> np.ndarray:
    """Cubic Hermite curve at `x` in 0..1, with these end values and slopes (per unit of x)."""
    x = x[:, None]
    first = (1.0 - x) ** 2 * ((1.0 + 2.0 * x) * start + x * slope)
    return first + x**2 * ((3.0 - 2.0 * x) * end + (x - 1.0) * end_slope)


def heading_vectors(yaw: np.ndarray) -> np.ndarray:
    """Unit vectors, (..., 3), of headings in rad: 0 faces +z, pi/2 faces +x."""
    return np.stack([np.sin(yaw), np.zeros_like(yaw), np.cos(yaw)], axis=-1)


@dataclass(frozen=True)
class GroundPath:
    """A gently bending line over the floor, through x = 0 at z = 0, as a function of z, m."""

    bend: float
    """rad, about how far the path turns away from +z to either side."""
    phase: float
    """rad, of the bends at z = 0."""

    def yaw(self, z: np.ndarray) -> np.ndarray:
        """Heading, rad; 0 faces +z."""
        return np.arctan(self._sum_of_waves(z, np.cos, 0))

    def points(self, z: np.ndarray, left: np.ndarray | float, height: np.ndarray) -> np.ndarray:
        """Points to the left of the path by `left`, m, at heights above the floor, m."""
        x = self._sum_of_waves(z, np.sin, 1) - self._sum_of_waves(np.zeros(1), np.sin, 1)
        on_path = np.stack([x, height, z], axis=-1)
        return on_path + np.asarray(left)[..., None] * heading_vectors(self.yaw(z) + np.pi / 2)

    def _sum_of_waves(
        self, z: np.ndarray, wave: Callable[[np.ndarray], np.ndarray], power: int
    ) -> np.ndarray:
        """The waves divided by their wave numbers to a power: 1 integrates them."""
        wave_numbers = [2.0 * np.pi / length for length in WAVELENGTHS]
        waves = [wave(k * z + self.phase) / k**power for k in wave_numbers]
        return 0.5 * self.bend * np.sum(waves, axis=0)
