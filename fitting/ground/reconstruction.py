"""Reconstructs the ground below a captured clip from where its feet stood.

Three kinds of surface are fitted to the footprints: a plane, a smooth thin plate and level blocks
on a square grid. Each predicts the height of every footprint from the others, and the simplest kind
that no other predicts clearly better is chosen.

Pitch, heading and offset of the grid are unknown, and so is the height of every block. A grid is
scored by its evidence: the probability of all measured heights with the unknown block heights
integrated out (MacKay, "Bayesian interpolation", 1992). Evidence penalises complexity by itself:
grids with blocks that are too small, or too many, score lower unless the heights require them.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.interpolate import RBFInterpolator
from scipy.linalg import null_space
from scipy.optimize import least_squares
from scipy.spatial import KDTree
from scipy.special import log_ndtr

from fitting.clips import contacts, edit
from fitting.clips.clip import Clip
from fitting.clips.rigs import flat_frames

from .meshes import Mesh, grid_faces

NOISE = 0.005  # m, standard deviation of heights measured on the same block
OUTLIER_FRACTION = 0.05  # of stances at an edge or mislabelled, which say nothing of their block
HEEL_TOLERANCE = 0.01  # m: the ground below a heel is not higher than that below the ball by more
PITCHES = (0.2, 1.5)  # m, range of the search
PITCH_STEP = 0.015  # relative; it moves the edge of 4 m of ground by 3 cm
HEADING_STEP = np.radians(1.5)
OFFSETS = 10  # tried in each direction
MAX_COARSE_STANCES = 100  # evenly chosen, for ranking the coarse grids
COARSE_BEST = 30  # coarse grids whose neighbourhood is searched
NEIGHBOURS = (-0.75, 0.0, 0.75)  # coarse steps from a grid to those around it
LATTICE = (-3, -2, -1, 0, 1, 2, 3)  # standard deviations, over the region of high evidence
# Largest standard deviations of pitch, heading and the two offsets, in coarse steps.
MAX_WIDTH = np.array([2.0, 1.0, 0.5, 0.5])
MIN_WIDTH_RATIO = 0.1  # to the maximum
ROUNDS = 4  # of moving to the mean of the evidence
MOST_PARTITIONS = 150  # partitions of the stances that cross-validation chooses from
CREDIBLE = 2.0  # nats of evidence below the best: odds of 1 to 7

PLANE_NOISE = 0.01  # m: footprints farther from the plane weigh less (soft L1)
SLOPE_PRIOR = 0.05  # m per m, standard deviation; it fixes the tilt across a straight walk
VERTEX_SPACING = 0.1  # m, in the mesh of a thin plate
MAX_CELLS = 2_000_000  # of a mesh
CHUNK = 10_000  # cells whose heights are found at a time; bounds the memory
SMOOTHING = 10.0 ** np.arange(-6.0, 2.1, 0.5)  # m², candidates for a thin plate

# A foot is on its toes where it is pitched down more than usual: by 5 degrees, and by three
# standard deviations (estimated from the median absolute deviation), as slopes make pitch vary.
TOE_PITCH, TOE_DEVIATIONS = np.radians(5.0), 3.0 * 1.4826
NEAR = 0.3  # m, about a foot's length: a stance on toes is not used if a flat one is as near
MIN_STANCES = 4  # three determine a plane, and one tests it
MOST_STANCES = 300  # evenly chosen where there are more: all kinds are fitted in some minutes
WIDEST = 1000.0  # m, between stances
SURFACE_KINDS = ("plane", "smooth", "blocks")  # from simple to complex


@dataclass(frozen=True)
class Grid:
    """Squares over the ground plane.

    A point is in cell (i, j) with i = floor((u - u0) / pitch) and j likewise from v, where
    u = cos(heading) x + sin(heading) z and v = -sin(heading) x + cos(heading) z.
    """

    pitch: float
    """Metres."""
    heading: float
    """rad, -pi/4 to pi/4, as a quarter turn gives the same grid."""
    origin: tuple[float, float]
    """m, (u0, v0), each from 0 to pitch."""

    def cells(self, points: Float64[np.ndarray, "points 2"]) -> Int64[np.ndarray, "points 2"]:
        """The cell of each point (x, z), m."""
        return np.floor(self.coordinates(points)).astype(np.int64)

    def coordinates(
        self, points: Float64[np.ndarray, "points 2"]
    ) -> Float64[np.ndarray, "points 2"]:
        """Points (x, z), m, in units of cells: whole numbers are corners."""
        return (points @ _uv_from_xz(self.heading).T - np.array(self.origin)) / self.pitch

    def points(self, coordinates: Float64[np.ndarray, "*b 2"]) -> Float64[np.ndarray, "*b 2"]:
        """Points (x, z), m, at these coordinates: the inverse of `coordinates`."""
        return (self.pitch * coordinates + np.array(self.origin)) @ _uv_from_xz(self.heading)


@dataclass(frozen=True)
class Footprints:
    """Where flat feet stood, which is what grids and surfaces are fitted to."""

    balls: Float64[np.ndarray, "stances 2"]
    """m, (x, z)."""
    heights: Float64[np.ndarray, " stances"]
    """m, of the ground below the balls."""
    ankles: Float64[np.ndarray, "stances 2"]
    """m, (x, z); the ground below is not higher."""

    def without(self, index: int) -> "Footprints":
        """All footprints except one."""
        others = np.arange(len(self.balls)) != index
        return Footprints(self.balls[others], self.heights[others], self.ankles[others])


@dataclass(frozen=True)
class RankedGrids:
    """Candidate grids that partition the stances differently, the most probable first."""

    grids: tuple[Grid, ...]
    extra_evidence: Float64[np.ndarray, " grids"]
    """Nats, from other grids with the same partition."""
    pitches: tuple[float, float]
    """m, range of grids nearly as probable as the best."""
    headings: tuple[float, float]
    """rad, range of the same grids."""


def search(feet: Footprints) -> RankedGrids:
    """The grids that explain the heights best. Deterministic.

    1. Coarse: for every pitch and heading, the offset with the most pairs of similar heights in
       common blocks.
    2. A grid may explain the heights by chance, just where it lies. The best coarse grids are
       therefore scored together with their neighbours, and the best neighbourhood is chosen.
    3. Fine: a lattice of grids moves to the mean of the evidence and adapts its spacing, a few
       times.
    4. Grids of the last lattice are grouped by how they partition the stances. Each group is
       represented by the grid nearest to the mean, with the evidence of the whole group.

    Args:
        feet: two or more footprints.
    """
    score, centre = _Evidence(feet), feet.balls.mean(axis=0)
    coarse = sorted(_coarse_grids(feet), key=score.of, reverse=True)[:COARSE_BEST]
    best = max(coarse, key=lambda grid: score.of_any(_neighbours(grid, centre)))
    lattice, width = np.array(list(product(LATTICE, repeat=4))), MAX_WIDTH
    for _ in range(ROUNDS):
        steps = width * lattice
        grids = [_moved(best, step, centre) for step in steps]
        evidence = np.array([score.of(grid) for grid in grids])
        weight = np.exp(evidence - evidence.max())
        mean = np.average(steps, axis=0, weights=weight)
        deviation = np.sqrt(np.average((steps - mean) ** 2, axis=0, weights=weight))
        by_distance = np.argsort(np.linalg.norm((steps - mean) / width, axis=1), kind="stable")
        best = _moved(best, mean, centre)
        width = np.clip(deviation, MIN_WIDTH_RATIO * MAX_WIDTH, MAX_WIDTH)
    partitions: dict[bytes, list[int]] = {}
    for index in by_distance:
        partition = _cell_numbers(grids[index].cells(feet.balls)).tobytes()
        partitions.setdefault(partition, []).append(int(index))
    group_evidence = {
        group[0]: float(np.logaddexp.reduce(evidence[group])) for group in partitions.values()
    }
    best_groups = sorted(group_evidence, key=lambda index: -group_evidence[index])[:MOST_PARTITIONS]
    credible = [grids[index] for index in np.flatnonzero(evidence >= evidence.max() - CREDIBLE)]
    return RankedGrids(
        tuple(grids[index] for index in best_groups),
        np.array([group_evidence[index] - evidence[index] for index in best_groups]),
        _range([grid.pitch for grid in credible]),
        _range([grid.heading for grid in credible]),
    )


def most_probable(ranked: RankedGrids, feet: Footprints) -> Grid:
    """The candidate grid whose partition of these footprints has the most evidence."""
    score = _Evidence(feet)
    evidence = [score.of(grid) for grid in ranked.grids]
    return ranked.grids[int(np.argmax(evidence + ranked.extra_evidence))]


class _Evidence:
    """Log evidence of grids, nats, for the same footprints.

    Block heights are discretised to levels, so integrating them out is a sum.
    """

    def __init__(self, feet: Footprints) -> None:
        heights = feet.heights
        mean, spread = _mean_and_spread(heights)
        levels = np.arange(heights.min() - 3 * NOISE, heights.max() + 3 * NOISE, NOISE)
        error = heights[:, None] - levels
        ball = _with_outliers(
            _log_normal(error, NOISE), _log_normal(heights[:, None] - mean, spread)
        )
        ankle = _with_outliers(log_ndtr((error + HEEL_TOLERANCE) / NOISE), np.zeros(()))
        prior = _log_normal(levels - mean, spread)
        self.points = np.concatenate([feet.balls, feet.ankles])
        self.likelihood = np.concatenate([ball, ankle])  # log, (points, levels)
        self.prior = prior - float(np.logaddexp.reduce(prior))  # log, (levels,)

    def of(self, grid: Grid) -> float:
        """Of one grid: the log of the sum over levels, summed over the blocks."""
        number = _cell_numbers(grid.cells(self.points))
        order = np.argsort(number, kind="stable")
        first = np.searchsorted(number[order], np.arange(number.max() + 1))
        cells = np.add.reduceat(self.likelihood[order], first) + self.prior
        top = cells.max(axis=1)
        return float(np.sum(top + np.log(np.exp(cells - top[:, None]).sum(axis=1))))

    def of_any(self, grids: Sequence[Grid]) -> float:
        """Of one of these grids, all equally probable beforehand."""
        return float(np.logaddexp.reduce([self.of(grid) for grid in grids]) - np.log(len(grids)))


def _with_outliers(inlier: np.ndarray, outlier: np.ndarray) -> np.ndarray:
    """Log likelihood of stances of which a few are outliers, from those of either kind."""
    return np.logaddexp(np.log(1.0 - OUTLIER_FRACTION) + inlier, np.log(OUTLIER_FRACTION) + outlier)


def _coarse_grids(feet: Footprints) -> list[Grid]:
    """For every pitch and heading, the grid whose offset suits pairs of stances best."""
    chosen = np.linspace(0, len(feet.balls) - 1, MAX_COARSE_STANCES)
    chosen = np.unique(chosen.round().astype(int))
    points, heights = feet.balls[chosen], feet.heights[chosen]
    centre = points.mean(axis=0)
    first, second = np.triu_indices(len(points), 1)
    _, spread = _mean_and_spread(heights)
    difference = heights[first] - heights[second]
    apart = _log_normal(difference, np.sqrt(2) * spread)
    together = _with_outliers(_log_normal(difference, np.sqrt(2) * NOISE), apart)
    gain_of_pair = together - apart  # nats, for having both in one block
    offsets = np.arange(OFFSETS) / OFFSETS
    pitches = np.exp(np.arange(np.log(PITCHES[0]), np.log(PITCHES[1]), PITCH_STEP))
    grids = []
    for heading in np.arange(-np.pi / 4, np.pi / 4, HEADING_STEP):
        uv = (points - centre) @ _uv_from_xz(heading).T
        for pitch in pitches:
            cells = np.floor(uv[None] / pitch + offsets[:, None, None])
            same = cells[:, first] == cells[:, second]  # (offsets, pairs, 2)
            gain = (same[..., 0] * gain_of_pair) @ same[..., 1].T.astype(np.float64)
            best = np.unravel_index(np.argmax(gain), gain.shape)
            origin = centre @ _uv_from_xz(heading).T - pitch * offsets[list(best)]
            grids.append(_canonical(pitch, heading, origin))
    return grids


def _neighbours(grid: Grid, centre: np.ndarray) -> list[Grid]:
    """A grid and those around it in pitch, heading and offset."""
    return [_moved(grid, np.array(step), centre) for step in product(NEIGHBOURS, repeat=4)]


def _moved(grid: Grid, steps: np.ndarray, centre: np.ndarray) -> Grid:
    """A grid scaled, rotated and shifted by coarse steps, about the centre."""
    pitch = grid.pitch * np.exp(PITCH_STEP * steps[0])
    heading = grid.heading + HEADING_STEP * steps[1]
    centre_uv = grid.coordinates(centre[None])[0] + steps[2:] / OFFSETS
    return _canonical(pitch, heading, centre @ _uv_from_xz(heading).T - pitch * centre_uv)


def _canonical(pitch: float, heading: float, origin: np.ndarray) -> Grid:
    """The grid with heading and origin in their ranges."""
    quarters = int(np.round(heading / (np.pi / 2)))
    for _ in range(quarters % 4):  # rotate the grid's axes back: u becomes -v, v becomes u
        origin = np.array([-origin[1], origin[0]])
    u, v = np.mod(origin, pitch)
    return Grid(float(pitch), float(heading - quarters * np.pi / 2), (float(u), float(v)))


def _uv_from_xz(heading: float) -> np.ndarray:
    cos, sin = np.cos(heading), np.sin(heading)
    return np.array([[cos, sin], [-sin, cos]])


def _cell_numbers(cells: np.ndarray) -> np.ndarray:
    """The number of each cell among those that occur, in order of their position."""
    low = cells.min(axis=0)
    key = (cells[:, 0] - low[0]) * (np.ptp(cells[:, 1]) + 1) + cells[:, 1] - low[1]
    return np.unique(key, return_inverse=True)[1].astype(np.int64)


def _range(values: Sequence[float]) -> tuple[float, float]:
    return min(values), max(values)


def _mean_and_spread(heights: np.ndarray) -> tuple[float, float]:
    """Mean and standard deviation of block heights, m, the latter at least 3 times the noise."""
    return float(np.mean(heights)), max(float(np.std(heights)), 3 * NOISE)


def _log_normal(error: np.ndarray, deviation: float) -> np.ndarray:
    """Log density of a normal distribution."""
    return -0.5 * (error / deviation) ** 2 - np.log(deviation * np.sqrt(2 * np.pi))


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
    grid = most_probable(ranked, feet)
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


SurfaceFit = Callable[[Footprints], Surface]


@dataclass(frozen=True)
class Stances:
    """Where feet stood, in order of time."""

    leg: Int64[np.ndarray, " stances"]
    """Index."""
    first: Int64[np.ndarray, " stances"]
    """Frame."""
    last: Int64[np.ndarray, " stances"]
    """Frame, included."""
    points: Float64[np.ndarray, "stances 2"]
    """m, (x, z) of the ball."""
    ankles: Float64[np.ndarray, "stances 2"]
    """m, (x, z)."""
    heights: Float64[np.ndarray, " stances"]
    """m, of the ground below the ball."""
    toes: Bool[np.ndarray, " stances"]
    """True where the heel is in the air."""
    used: Bool[np.ndarray, " stances"]
    """True where the surfaces are fitted to it."""

    @property
    def footprints(self) -> Footprints:
        """The stances that are used."""
        used = self.used
        return Footprints(self.points[used], self.heights[used], self.ankles[used])


@dataclass(frozen=True)
class Prediction:
    """How well a kind of surface predicts each used stance from the others."""

    errors: Float64[np.ndarray, " stances"]
    """m, predicted minus measured."""
    alone: Bool[np.ndarray, " stances"]
    """No other stance on its block: predicted from neighbours."""

    @property
    def rms(self) -> float:
        """Root mean square error over all used stances, m."""
        return _rms(self.errors)

    @property
    def rms_shared(self) -> float:
        """Root mean square error over stances that share their block, m; NaN without any."""
        return _rms(self.errors[~self.alone])


@dataclass(frozen=True)
class Reconstruction:
    """The surfaces fitted to a clip's stances, and which of them was chosen."""

    stances: Stances
    surfaces: Mapping[str, Surface]
    """By kind."""
    predictions: Mapping[str, Prediction]
    """By kind."""
    grids: RankedGrids
    chosen: str
    """Kind."""
    sole: float
    """m, height of the ball joints above the soles."""

    @property
    def surface(self) -> Surface:
        """The chosen surface."""
        return self.surfaces[self.chosen]

    def extent(self, margin: float) -> tuple[Float64[np.ndarray, "2"], Float64[np.ndarray, "2"]]:
        """Lowest and highest (x, z) of all stances, m, with a margin around them."""
        points = self.stances.points
        return points.min(axis=0) - margin, points.max(axis=0) + margin


def reconstruct(
    clip: Clip, *, sole: float | None = None, kind: str | None = None
) -> Reconstruction:
    """The ground below a captured clip.

    Args:
        clip: over ground of any shape, with y up.
        sole: m, height of the ball joints above the soles; it shifts the whole ground. None is the
            mean of the rig's.
        kind: which of `SURFACE_KINDS` to choose; None chooses by cross-validation.

    Raises:
        ValueError: an unknown kind, a clip without legs, too few stances, or some too far apart.
    """
    if kind not in (None, *SURFACE_KINDS):
        raise ValueError(f"no kind of ground named {kind!r}; there are {list(SURFACE_KINDS)}")
    if sole is None:
        sole = float(np.mean(np.asarray(clip.rig.ball_height)))
    stances = find_stances(clip, sole)
    feet = stances.footprints
    if len(feet.balls) < MIN_STANCES:
        raise ValueError(
            f"{clip.source}: {len(feet.balls)} stances; reconstruction needs {MIN_STANCES} or more"
        )
    places = np.column_stack([feet.balls, feet.heights])
    if (extent := np.ptp(places, axis=0).max()) > WIDEST:
        raise ValueError(
            f"{clip.source}: its stances are up to {extent:.4g} m apart; wanted at most {WIDEST:g}"
        )
    stances = thin_out(stances)
    feet = stances.footprints
    grids = search(feet)
    fits: dict[str, SurfaceFit] = {
        "plane": fit_plane,
        "smooth": fit_thin_plate,
        "blocks": partial(fit_blocks, grids),
    }
    predictions = {name: leave_one_out(fit, feet) for name, fit in fits.items()}
    fitted = {name: fit(feet) for name, fit in fits.items()}
    chosen = choose(predictions) if kind is None else kind
    return Reconstruction(stances, fitted, predictions, grids, chosen, sole)


def find_stances(clip: Clip, sole: float) -> Stances:
    """Position and height of every stance of a clip.

    They are medians over the frames in which the foot is stillest, without frames in which a marker
    jumped. A foot on its toes often leans on an edge or hangs over one, so it is used only if no
    flat stance is near. What the fit leaves out is not used.

    Raises:
        ValueError: no foot ever stands.
    """
    clip = edit.mask_marker_jumps(clip)
    standing, ankles, balls = clip.stance_labels(), clip.joints_ws(2), clip.joints_ws(3)
    records = []
    for leg in range(standing.shape[1]):
        for first, last in contacts.runs(standing[:, leg]):
            beside = slice(max(first - 1, 0), last + 2)  # a frame before and after, for speeds
            frames = np.arange(beside.start, min(beside.stop, clip.frame_count))
            good = clip.observed[beside] & (first <= frames) & (frames <= last)
            if good.any():
                here = ankles[beside, leg], balls[beside, leg]
                flat = flat_frames(here[0], here[1], good)
                ankle, ball = (np.median(joint[flat], axis=0) for joint in here)
                foot = ball - ankle
                pitch = np.arctan2(foot[1], np.linalg.norm(foot[[0, 2]]))
                records.append((first, leg, last, *ball, *ankle[[0, 2]], pitch))
    if not records:
        raise ValueError(
            f"{clip.source}: no foot ever stands; wanted {MIN_STANCES} stances or more"
        )
    first, leg, last, x, y, z, *ankle, pitch = np.array(sorted(records)).reshape(-1, 9).T
    for index in np.unique(leg):
        pitch[leg == index] -= np.median(pitch[leg == index])
    toes = -pitch > np.maximum(TOE_PITCH, TOE_DEVIATIONS * np.median(np.abs(pitch)))
    points, ankles = (np.stack(pair, axis=-1) for pair in ((x, z), ankle))
    distance_to_flat = np.full(len(points), np.inf)
    if not toes.all():
        distance_to_flat, _ = KDTree(points[~toes]).query(points)
    leg, first, last = (column.astype(np.int64) for column in (leg, first, last))
    used = (~toes | (distance_to_flat > NEAR)) & clip.fitted_stances()[first, leg]
    return Stances(leg, first, last, points, ankles, y - sole, toes, used)


def thin_out(stances: Stances) -> Stances:
    """The stances, of which no more than `MOST_STANCES` are used, chosen evenly in time.

    A surface takes time by the cube of their number, and is fitted without each of them.
    """
    used = np.flatnonzero(stances.used)
    if len(used) <= MOST_STANCES:
        return stances
    chosen = used[np.linspace(0, len(used) - 1, MOST_STANCES).round().astype(int)]
    return replace(stances, used=np.isin(np.arange(len(stances.used)), chosen))


def leave_one_out(fit: SurfaceFit, feet: Footprints) -> Prediction:
    """How well a kind of surface predicts each footprint when it is fitted to all the others.

    For blocks, the grid is chosen anew each time among the candidates found from all footprints.
    """
    errors, supported = np.zeros(len(feet.balls)), np.zeros(len(feet.balls), bool)
    for index in range(len(feet.balls)):
        surface, point = fit(feet.without(index)), feet.balls[[index]]
        errors[index] = surface.heights(point)[0] - feet.heights[index]
        supported[index] = surface.supported(point)[0]
    return Prediction(errors, ~supported)


def choose(predictions: Mapping[str, Prediction]) -> str:
    """The simplest kind whose squared error is within one standard error of the smallest.

    The standard error is that of the mean difference to the best kind, stance by stance: the
    one-standard-error rule of Breiman, Friedman, Olshen and Stone, "Classification and regression
    trees" (1984), for paired errors.
    """
    squares = {kind: predictions[kind].errors ** 2 for kind in SURFACE_KINDS}
    best = min(SURFACE_KINDS, key=lambda kind: squares[kind].mean())
    for kind in SURFACE_KINDS:
        excess = squares[kind] - squares[best]
        if excess.mean() <= excess.std() / np.sqrt(len(excess)):
            return kind
    return best


def _rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(errors**2))) if errors.size else float("nan")
