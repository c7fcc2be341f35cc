"""Surfaces fitted to footprints: a plane, a smooth thin plate, level blocks."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.interpolate import RBFInterpolator
from scipy.linalg import null_space
from scipy.optimize import least_squares

from . import block_grids
from .block_grids import Footprints, Grid, RankedGrids
from .meshes import Mesh, grid_faces

PLANE_NOISE = 0.01  # m: footprints farther from the plane weigh less (soft L1)
SLOPE_PRIOR = 0.05  # m per m, standard deviation; it fixes the tilt across a straight walk
VERTEX_SPACING = 0.1  # m, in the mesh of a thin plate
MAX_CELLS = 2_000_000  # of a mesh
CHUNK = 10_000  # cells whose heights are found at a time; bounds the memory
SMOOTHING = 10.0 ** np.arange(-6.0, 2.1, 0.5)  # m², candidates for a thin plate


class Surface(ABC):
    """Ground height as a function of (x, z)."""

    @abstractmethod
    def heights(self, points: Float64[np.ndarray, "points 2"]) -> Float64[np.ndarray, " points"]:
        """Ground height at points, m."""

    @abstractmethod
    def supported(self, points: Float64[np.ndarray, "points 2"]) -> Bool[np.ndarray, " points"]:
        """Whether a footprint determines the height at each point; else its neighbours do."""

    @abstractmethod
    def mesh(self, low: Float64[np.ndarray, "2"], high: Float64[np.ndarray, "2"]) -> Mesh:
        """A mesh over all points from `low` to `high`, (x, z), m."""


@dataclass(frozen=True)
class Plane(Surface):
    """The plane y = level + slope · (x, z)."""

    level: float
    """m, at the origin."""
    slope: tuple[float, float]
    """m per m along x and z."""

    def heights(self, points: Float64[np.ndarray, "points 2"]) -> Float64[np.ndarray, " points"]:
        return self.level + points @ np.array(self.slope)

    def supported(self, points: Float64[np.ndarray, "points 2"]) -> Bool[np.ndarray, " points"]:
        return np.ones(len(points), bool)

    def mesh(self, low: Float64[np.ndarray, "2"], high: Float64[np.ndarray, "2"]) -> Mesh:
        return _grid_mesh(self, *(np.array([a, b]) for a, b in zip(low, high, strict=True)))


@dataclass(frozen=True)
class ThinPlate(Surface):
    """A thin-plate smoothing spline (Duchon 1977; Wahba, "Spline models", 1990)."""

    plate: RBFInterpolator
    smoothing: float
    """m²; 0 interpolates every footprint."""
    lowest: float
    """m; heights are clipped to those of the footprints."""
    highest: float
    """Metres."""

    def heights(self, points: Float64[np.ndarray, "points 2"]) -> Float64[np.ndarray, " points"]:
        return np.clip(self.plate(points), self.lowest, self.highest)

    def supported(self, points: Float64[np.ndarray, "points 2"]) -> Bool[np.ndarray, " points"]:
        return np.ones(len(points), bool)

    def mesh(self, low: Float64[np.ndarray, "2"], high: Float64[np.ndarray, "2"]) -> Mesh:
        count = np.ceil((high - low) / VERTEX_SPACING).astype(int) + 1
        _check_cells(count, VERTEX_SPACING, high - low)
        return _grid_mesh(
            self, *(np.linspace(*part) for part in zip(low, high, count, strict=True))
        )


@dataclass(frozen=True)
class LevelBlocks(Surface):
    """Level blocks. One without footprints has the mean height of the nearest that have any."""

    grid: Grid
    cells: Int64[np.ndarray, "blocks 2"]
    """With footprints."""
    tops: Float64[np.ndarray, " blocks"]
    """Metres."""
    stances: Int64[np.ndarray, " blocks"]
    """Number of footprints."""

    def heights(self, points: Float64[np.ndarray, "points 2"]) -> Float64[np.ndarray, " points"]:
        return self._heights_of(self.grid.cells(points))

    def supported(self, points: Float64[np.ndarray, "points 2"]) -> Bool[np.ndarray, " points"]:
        return (self._rings(self.grid.cells(points)) == 0).any(axis=1)

    def mesh(self, low: Float64[np.ndarray, "2"], high: Float64[np.ndarray, "2"]) -> Mesh:
        box = np.array([[x, z] for x in (low[0], high[0]) for z in (low[1], high[1])])
        reached = self.grid.cells(box)
        first, shape = reached.min(axis=0), np.ptp(reached, axis=0) + 1
        _check_cells(shape, self.grid.pitch, high - low)
        index = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)
        tops = self._heights_of((first + index).reshape(-1, 2)).reshape(shape)
        corners = np.array([[0, 0], [0, 1], [1, 1], [1, 0]])  # of a block, seen from below
        points = self.grid.points(((first + index)[..., None, :] + corners).astype(np.float64))
        y = np.broadcast_to(tops[..., None], points.shape[:-1])
        vertices = np.stack([points[..., 0], y, points[..., 1]], axis=-1)
        vertex = np.arange(4 * tops.size).reshape(*shape, 4)
        near, far = vertex[:-1], vertex[1:]
        along_u = np.stack([near[..., 3], near[..., 2], far[..., 1], far[..., 0]], axis=-1)
        near, far = vertex[:, :-1], vertex[:, 1:]
        along_v = np.stack([near[..., 2], near[..., 1], far[..., 0], far[..., 3]], axis=-1)
        risers = [along_u[np.diff(tops, axis=0) != 0], along_v[np.diff(tops, axis=1) != 0]]
        quads = np.concatenate([vertex.reshape(-1, 4), *risers])
        faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
        return Mesh(vertices.reshape(-1, 3), faces.astype(np.int64))

    def _heights_of(self, cells: np.ndarray) -> np.ndarray:
        """Heights of cells: their own, or the mean over the nearest ring of blocks."""
        heights = []
        for part in np.array_split(cells, len(cells) // CHUNK + 1):
            rings = self._rings(part)
            nearest = rings == rings.min(axis=1, keepdims=True)
            heights.append((nearest * self.tops).sum(axis=1) / nearest.sum(axis=1))
        return np.concatenate(heights)

    def _rings(self, cells: np.ndarray) -> np.ndarray:
        """Distance of cells to blocks with footprints, in blocks, diagonals counting as one."""
        return np.abs(cells[:, None] - self.cells).max(axis=-1)


def fit_plane(feet: Footprints) -> Plane:
    """The plane through the footprints by robust least squares (soft L1).

    Where the footprints do not determine the slope, the plane is level.
    """
    points, heights = feet.balls, feet.heights
    centre, median = points.mean(axis=0), float(np.median(heights))

    def residuals(plane: np.ndarray) -> np.ndarray:
        error = plane[0] + (points - centre) @ plane[1:] - (heights - median)
        return np.concatenate([error / PLANE_NOISE, plane[1:] / SLOPE_PRIOR])

    level, *slope = least_squares(residuals, np.zeros(3), loss="soft_l1").x
    return Plane(float(median + level - centre @ slope), (float(slope[0]), float(slope[1])))


def fit_thin_plate(feet: Footprints) -> ThinPlate:
    """The thin plate with the smoothing that minimises the leave-one-out error.

    Raises:
        ValueError: all footprints are in a line.
    """
    points, heights = feet.balls, feet.heights
    centre = points.mean(axis=0)
    spread = np.linalg.svd(points - centre, compute_uv=False)
    if len(spread) < 2 or spread[1] < 1e-6 * spread[0]:
        raise ValueError("all stances are in a line; a smooth surface needs some beside it")
    smoothing = min(SMOOTHING, key=_leave_one_out_error(points - centre, heights))
    plate = RBFInterpolator(points, heights, smoothing=smoothing)
    return ThinPlate(plate, float(smoothing), float(heights.min()), float(heights.max()))


def _leave_one_out_error(points: np.ndarray, heights: np.ndarray) -> Callable[[float], float]:
    """The squared error, m², of predicting each height from the others, by smoothing, m²."""
    distance = np.linalg.norm(points[:, None] - points, axis=-1)
    log = np.log(np.where(distance > 0, distance, 1.0))
    not_planar = null_space(np.column_stack([np.ones(len(points)), points]).T)
    stiffness, modes = np.linalg.eigh(not_planar.T @ (distance**2 * log) @ not_planar)
    modes = not_planar @ modes

    def error(smoothing: float) -> float:
        # With P the projection on the modes and K the kernel: the leave-one-out residual at each
        # point is ((P K P + smoothing P)⁻¹ heights) divided by the inverse's own diagonal.
        weights = 1.0 / (np.maximum(stiffness, 0.0) + smoothing)
        diagonal = modes**2 @ weights
        predicted = diagonal > 1e-9 * diagonal.max(initial=0.0)  # the others determine a height
        residuals = modes @ (weights * (modes.T @ heights))
        return float(np.sum((residuals[predicted] / diagonal[predicted]) ** 2))

    return error


def fit_blocks(ranked: RankedGrids, feet: Footprints) -> LevelBlocks:
    """Blocks on the most probable grid, each at the median height of its footprints."""
    grid = block_grids.most_probable(ranked, feet)
    cells, block = np.unique(grid.cells(feet.balls), axis=0, return_inverse=True)
    block = block.reshape(-1)
    tops = np.array([np.median(feet.heights[block == index]) for index in range(len(cells))])
    return LevelBlocks(grid, cells, tops, np.bincount(block).astype(np.int64))


def _check_cells(shape: np.ndarray, pitch: float, extent: np.ndarray) -> None:
    """ValueError for a mesh of too many cells."""
    if (cells := int(np.prod(shape.astype(float)))) > MAX_CELLS:
        raise ValueError(
            f"{extent[0]:.4g} m by {extent[1]:.4g} m of ground in cells of {pitch:.3g} m are "
            f"{cells} cells; wanted at most {MAX_CELLS}: a clip or a margin that is smaller"
        )


def _grid_mesh(surface: Surface, x: np.ndarray, z: np.ndarray) -> Mesh:
    """A mesh of a surface with vertices at all combinations of `x` and `z`."""
    grid_x, grid_z = (part.reshape(-1) for part in np.meshgrid(x, z))
    y = surface.heights(np.stack([grid_x, grid_z], axis=-1))
    return Mesh(np.stack([grid_x, y, grid_z], axis=-1), grid_faces(len(z), len(x)))
