"""Grounds through the heights of stances: a plane, a smooth surface, level blocks."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.interpolate import RBFInterpolator
from scipy.linalg import null_space
from scipy.optimize import least_squares

from fitting.datasets.synthetic.terrain_meshes import Mesh, quads

from . import block_grids

PLANE_NOISE = 0.01  # m: a stance farther from the plane is trusted less (soft L1)
SLOPE = 0.05  # m per m, prior deviation: across a straight walk nothing else holds the plane
SPACING = 0.1  # m, between vertices of a smooth surface
SMOOTHING = 10.0 ** np.arange(-6.0, 2.1, 0.5)  # m², of a thin plate


class Surface(ABC):
    """A ground over (x, z)."""

    @abstractmethod
    def heights(self, points: Float64[np.ndarray, "points 2"]) -> Float64[np.ndarray, " points"]:
        """Of the ground at points, m."""

    @abstractmethod
    def shared(self, points: Float64[np.ndarray, "points 2"]) -> Bool[np.ndarray, " points"]:
        """Where stances tell the height; elsewhere it is their neighbours' mean."""

    @abstractmethod
    def mesh(self, low: Float64[np.ndarray, "2"], high: Float64[np.ndarray, "2"]) -> Mesh:
        """Triangles, m, y up, over all points from `low` to `high`."""


@dataclass(frozen=True)
class Plane(Surface):
    """level + slope · (x, z)."""

    level: float  # m, at the origin
    slope: tuple[float, float]  # m per m along x and z

    def heights(self, points: Float64[np.ndarray, "points 2"]) -> Float64[np.ndarray, " points"]:
        return self.level + points @ np.array(self.slope)

    def shared(self, points: Float64[np.ndarray, "points 2"]) -> Bool[np.ndarray, " points"]:
        return np.ones(len(points), bool)

    def mesh(self, low: Float64[np.ndarray, "2"], high: Float64[np.ndarray, "2"]) -> Mesh:
        return _sheet(self, *(np.array([a, b]) for a, b in zip(low, high, strict=True)))


@dataclass(frozen=True)
class ThinPlate(Surface):
    """A thin plate that bends as little as the stances let it (Duchon 1977; Wahba 1990)."""

    plate: RBFInterpolator
    smoothing: float  # m²; 0 goes through every stance
    lowest: float  # m, and highest: of the stances, beyond which it does not swing
    highest: float

    def heights(self, points: Float64[np.ndarray, "points 2"]) -> Float64[np.ndarray, " points"]:
        return np.clip(self.plate(points), self.lowest, self.highest)

    def shared(self, points: Float64[np.ndarray, "points 2"]) -> Bool[np.ndarray, " points"]:
        return np.ones(len(points), bool)

    def mesh(self, low: Float64[np.ndarray, "2"], high: Float64[np.ndarray, "2"]) -> Mesh:
        count = np.ceil((high - low) / SPACING).astype(int) + 1
        return _sheet(self, *(np.linspace(*part) for part in zip(low, high, count, strict=True)))


@dataclass(frozen=True)
class LevelBlocks(Surface):
    """Level blocks; one that nobody stepped on has the mean height of those next to it."""

    grid: block_grids.Grid
    cells: Int64[np.ndarray, "blocks 2"]  # that somebody stepped on
    tops: Float64[np.ndarray, " blocks"]  # m
    stances: Int64[np.ndarray, " blocks"]  # how many told each

    def heights(self, points: Float64[np.ndarray, "points 2"]) -> Float64[np.ndarray, " points"]:
        return self._tops_of(self.grid.cells(points))

    def shared(self, points: Float64[np.ndarray, "points 2"]) -> Bool[np.ndarray, " points"]:
        return (self._rings(self.grid.cells(points)) == 0).any(axis=1)

    def mesh(self, low: Float64[np.ndarray, "2"], high: Float64[np.ndarray, "2"]) -> Mesh:
        box = np.array([[x, z] for x in (low[0], high[0]) for z in (low[1], high[1])])
        reached = self.grid.cells(box)
        first, shape = reached.min(axis=0), np.ptp(reached, axis=0) + 1
        index = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)
        tops = self._tops_of((first + index).reshape(-1, 2)).reshape(shape)
        around = np.array([[0, 0], [0, 1], [1, 1], [1, 0]])  # corners of a block, seen from below
        places = self.grid.places(((first + index)[..., None, :] + around).astype(np.float64))
        y = np.broadcast_to(tops[..., None], places.shape[:-1])
        vertices = np.stack([places[..., 0], y, places[..., 1]], axis=-1)
        corner = np.arange(4 * tops.size).reshape(*shape, 4)
        here, there = corner[:-1], corner[1:]
        along_u = np.stack([here[..., 3], here[..., 2], there[..., 1], there[..., 0]], axis=-1)
        here, there = corner[:, :-1], corner[:, 1:]
        along_v = np.stack([here[..., 2], here[..., 1], there[..., 0], there[..., 3]], axis=-1)
        risers = np.concatenate(
            [along_u[np.diff(tops, axis=0) != 0], along_v[np.diff(tops, axis=1) != 0]]
        )
        quads = np.concatenate([corner.reshape(-1, 4), risers])
        faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
        return Mesh(vertices.reshape(-1, 3), faces.astype(np.int64))

    def _tops_of(self, cells: np.ndarray) -> np.ndarray:
        """Heights of blocks: their own, or the mean of the nearest ring that has any."""
        rings = self._rings(cells)
        nearest = rings == rings.min(axis=1, keepdims=True)
        return (nearest * self.tops).sum(axis=1) / nearest.sum(axis=1)

    def _rings(self, cells: np.ndarray) -> np.ndarray:
        """How many blocks apart, diagonals counting one, these are from those stepped on."""
        return np.abs(cells[:, None] - self.cells).max(axis=-1)


def fit_plane(feet: block_grids.Footprints) -> Plane:
    """The plane through heights that a few odd ones cannot pull far.

    Least squares under a soft L1 loss; where points do not tell the slope, it is level.
    """
    points, heights = feet.balls, feet.heights
    middle, level = points.mean(axis=0), float(np.median(heights))

    def rows(at: np.ndarray) -> np.ndarray:
        apart = at[0] + (points - middle) @ at[1:] - (heights - level)
        return np.concatenate([apart / PLANE_NOISE, at[1:] / SLOPE])

    found = least_squares(rows, np.zeros(3), loss="soft_l1").x
    slope = float(found[1]), float(found[2])
    return Plane(float(level + found[0] - middle @ found[1:]), slope)


def fit_thin_plate(feet: block_grids.Footprints) -> ThinPlate:
    """The thin plate whose smoothing predicts each height best from the others.

    Points in a line bend a plate along it only, and leave it level across.
    """
    points, heights = feet.balls, feet.heights
    middle = points.mean(axis=0)
    spread = np.linalg.svd(points - middle, compute_uv=False)
    if len(spread) < 2 or spread[1] < 1e-6 * spread[0]:
        raise ValueError("all stances are in a line; wanted some beside it for a smooth surface")
    smoothing = min(SMOOTHING, key=_errors_of_plates(points - middle, heights))
    plate = RBFInterpolator(points, heights, smoothing=smoothing)
    return ThinPlate(plate, float(smoothing), float(heights.min()), float(heights.max()))


def _errors_of_plates(points: np.ndarray, heights: np.ndarray) -> Callable[[float], float]:
    """Squared error, m², with which a plate of a smoothing predicts each height from the others."""
    distance = np.linalg.norm(points[:, None] - points, axis=-1)
    log = np.log(np.where(distance > 0, distance, 1.0))
    bases = null_space(np.column_stack([np.ones(len(points)), points]).T)  # what a plane is not
    stiffness, modes = np.linalg.eigh(bases.T @ (distance**2 * log) @ bases)
    modes = bases @ modes

    def error(smoothing: float) -> float:
        # With P the projection on the modes and K the kernel, (P K P + smoothing P)⁻¹ heights over
        # its own diagonal: what is left at each point by the plate through the others.
        bent = modes / (np.maximum(stiffness, 0.0) + smoothing) @ modes.T
        lever = np.diag(bent)
        known = lever > 1e-9 * lever.max(initial=0.0)  # others tell a height there
        return float(np.sum(((bent @ heights)[known] / lever[known]) ** 2))

    return error


def fit_blocks(ranked: block_grids.RankedGrids, feet: block_grids.Footprints) -> LevelBlocks:
    """Blocks of the likeliest of these grids, each as high as the median of the heights on it."""
    grid = block_grids.likeliest(ranked, feet)
    cells, which = np.unique(grid.cells(feet.balls), axis=0, return_inverse=True)
    which = which.reshape(-1)
    tops = np.array([np.median(feet.heights[which == one]) for one in range(len(cells))])
    return LevelBlocks(grid, cells, tops, np.bincount(which).astype(np.int64))


def _sheet(surface: Surface, x: np.ndarray, z: np.ndarray) -> Mesh:
    """A surface over a grid of points."""
    across, along = (part.reshape(-1) for part in np.meshgrid(x, z))
    y = surface.heights(np.stack([across, along], axis=-1))
    return Mesh(np.stack([across, y, along], axis=-1), quads(len(z), len(x)))
