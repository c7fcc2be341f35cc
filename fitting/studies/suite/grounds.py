"""Grounds of the suite: functions of the place, sampled on one grid.

All have the same grid, so that one compiled program runs a system on any of them. Along the path it
is so fine that a riser of stairs is one centimetre deep.
"""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from jaxtyping import Float64

from fitting.datasets.synthetic.trajectories import smoothstep
from jaxik.world.terrain import Terrain, heightfield

SPACING = 0.05, 0.01  # m, across the path and along it
HALF_WIDTH, BEHIND, AHEAD = 2.0, 3.0, 17.0  # m, around the origin
GRADE = np.tan(np.radians(15.0))
HILL_HEIGHT, HILL_LENGTH = 2.0, 7.0  # m; its steepest part has 24 degrees
RISE, TREAD, STEPS = 0.15, 0.30, 8  # m, m and count, of stairs
CURB, KERBSIDE = 0.15, 2.0  # m, height and width of a traffic island
RUBBLE, RUBBLE_CELL = 0.06, 0.4  # m, height over and under the floor, and spacing of its corners
BLOCK = 0.12  # m, under one foot
PLATEAU = 0.5  # m

HeightAt: TypeAlias = Callable[[np.ndarray, np.ndarray], np.ndarray | float]
"""Height of the ground, m, at x (to the left) and z (ahead), m."""


def sampled(height: HeightAt) -> Terrain:
    """The ground of a function as a heightfield, in JAX's default precision."""
    x = np.arange(-HALF_WIDTH, HALF_WIDTH + SPACING[0] / 2, SPACING[0])
    z = np.arange(-BEHIND, AHEAD + SPACING[1] / 2, SPACING[1])
    heights = np.broadcast_to(height(x, z[:, None]), (len(z), len(x)))
    return heightfield(heights, SPACING, origin=(-HALF_WIDTH, 0.0, -BEHIND))


def flat(x: np.ndarray, z: np.ndarray) -> float:
    """A level floor."""
    return 0.0


def hill(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """A rise of 2 m, as smooth as a cosine."""
    return HILL_HEIGHT * 0.5 * (1.0 - np.cos(np.pi * np.clip(z / HILL_LENGTH, 0.0, 1.0)))


def stairs_up(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Eight steps up, from 1 m ahead."""
    return RISE * np.clip(np.floor((z - 1.0) / TREAD) + 1.0, 0.0, STEPS)


def stairs_down(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Eight steps down, from 1 m ahead."""
    return -stairs_up(x, z)


def slope_along(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """A slope up the path."""
    return GRADE * z


def slope_across(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """A slope up to the left."""
    return GRADE * x


def rubble(x: np.ndarray, z: np.ndarray) -> Float64[np.ndarray, "rows columns"]:
    """Corners at random heights, with straight lines between them."""
    rows, columns = np.floor(z / RUBBLE_CELL), np.floor(x / RUBBLE_CELL)
    along, across = z / RUBBLE_CELL - rows, x / RUBBLE_CELL - columns
    corners = np.random.default_rng(3).uniform(-RUBBLE, RUBBLE, (64, 16))

    def corner(row: int, column: int) -> np.ndarray:
        return corners[(rows + row).astype(int) + 8, (columns + column).astype(int) + 8]

    near = corner(0, 0) + across * (corner(0, 1) - corner(0, 0))
    far = corner(1, 0) + across * (corner(1, 1) - corner(1, 0))
    return near + along * (far - near)


def curb(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """A traffic island: up a curb 1 m ahead, and down again after 2 m."""
    return CURB * ((z >= 1.0) & (z < 1.0 + KERBSIDE))


def block(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """A block under the left foot."""
    return BLOCK * (x > 0.0)


def plateau(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """A plateau of half a metre, which begins 8 m ahead."""
    return PLATEAU * smoothstep((z - 4.0) / 4.0)
