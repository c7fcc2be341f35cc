"""Footprints on known ground, for the tests of terrain reconstruction."""

import numpy as np

from fitting.datasets.terrain.block_grids import Footprints, Grid

TILTED = Grid(0.45, np.radians(20.0), (0.1, 0.3))


def block_heights(grid: Grid, points: np.ndarray) -> np.ndarray:
    """Heights of arbitrary blocks at points, m: from 0 to 35 cm in steps of 5."""
    i, j = grid.cells(points).T
    return 0.05 * ((3 * i + 5 * j + i * j) % 8)


def block_footprints(grid: Grid, count: int = 60, outliers: int = 3) -> Footprints:
    """Feet scattered over 3 m by 3 m of blocks, none with its heel inside a higher one.

    The first ones are outliers, 6 cm too high.
    """
    rng = np.random.default_rng(4)
    balls = rng.uniform(-1.5, 1.5, (20 * count, 2))
    heading = rng.uniform(0.0, 2.0 * np.pi, len(balls))
    ankles = balls - 0.1 * np.stack([np.sin(heading), np.cos(heading)], axis=-1)
    possible = np.flatnonzero(block_heights(grid, ankles) <= block_heights(grid, balls))[:count]
    heights = block_heights(grid, balls[possible]) + rng.normal(0.0, 0.003, count)
    heights[:outliers] += 0.06
    return Footprints(balls[possible], heights, ankles[possible])


def hill_footprints(count: int = 30) -> Footprints:
    """Feet scattered over a smooth hill."""
    balls = np.random.default_rng(1).uniform(-2.0, 2.0, (count, 2))
    heights = 0.3 * np.exp(-np.sum(balls**2, axis=-1))
    return Footprints(balls, heights, balls)
