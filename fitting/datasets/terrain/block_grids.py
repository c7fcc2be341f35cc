"""Finds the square grid of level blocks that best explains where feet stood, and how high.

Pitch, heading and offset of the grid are unknown, and so is the height of every block. A grid is
scored by its evidence: the probability of all measured heights with the unknown block heights
integrated out (MacKay, "Bayesian interpolation", 1992). Evidence penalises complexity by itself:
grids with blocks that are too small, or too many, score lower unless the heights require them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float64, Int64
from scipy.special import log_ndtr

NOISE = 0.005  # m, standard deviation of heights measured on the same block
OUTLIER_FRACTION = 0.05  # of stances at an edge or mislabelled, which say nothing of their block
HEEL_TOLERANCE = 0.01  # m: the ground below a heel is not higher than that below the ball by more
PITCHES = (0.2, 1.5)  # m, range of the search
PITCH_STEP = 0.015  # relative; it moves the edge of 4 m of ground by 3 cm
HEADING_STEP = np.radians(1.5)
OFFSETS = 10  # tried in each direction
MAX_COARSE_STANCES = 100  # evenly chosen, for ranking the coarse grids
COARSE_KEPT = 30  # coarse grids whose neighbourhood is searched
NEIGHBOURS = (-0.75, 0.0, 0.75)  # coarse steps from a grid to those around it
LATTICE = (-3, -2, -1, 0, 1, 2, 3)  # standard deviations, over the region of high evidence
# Largest standard deviations of pitch, heading and the two offsets, in coarse steps.
MAX_WIDTH = np.array([2.0, 1.0, 0.5, 0.5])
MIN_WIDTH_RATIO = 0.1  # to the maximum
ROUNDS = 4  # of moving to the mean of the evidence
PARTITIONS_KEPT = 150  # partitions of the stances that cross-validation chooses from
CREDIBLE = 2.0  # nats of evidence below the best: odds of 1 to 7


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
    """rad, likewise."""


def search(feet: Footprints) -> RankedGrids:
    """The grids that explain the heights best. Deterministic.

    1. Coarse: for every pitch and heading, the offset with the most pairs of similar heights in
       common blocks.
    2. A grid may explain the heights by chance, just where it lies. The best coarse grids are
       therefore scored together with their neighbours, and the best neighbourhood is kept.
    3. Fine: a lattice of grids moves to the mean of the evidence and adapts its spacing, a few
       times.
    4. Grids of the last lattice are grouped by how they partition the stances. Each group is
       represented by the grid nearest to the mean, with the evidence of the whole group.

    Args:
        feet: two or more footprints.
    """
    score, centre = _Evidence(feet), feet.balls.mean(axis=0)
    coarse = sorted(_coarse_grids(feet), key=score.of, reverse=True)[:COARSE_KEPT]
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
    kept = sorted(group_evidence, key=lambda index: -group_evidence[index])[:PARTITIONS_KEPT]
    credible = [grids[index] for index in np.flatnonzero(evidence >= evidence.max() - CREDIBLE)]
    return RankedGrids(
        tuple(grids[index] for index in kept),
        np.array([group_evidence[index] - evidence[index] for index in kept]),
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
