"""Level blocks on a square grid that nobody told of: its pitch, heading and offset from heights.

A grid is judged by its evidence: the probability of all heights when each block has one height
that is not known, integrated out (MacKay 1992). Feet that share a block then need not be explained
twice, and blocks that are too small, or too many, pay for themselves.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float64, Int64
from scipy.special import log_ndtr

NOISE = 0.005  # m, by which heights measured on one block differ (normal, standard deviation)
ODD = 0.05  # share of stances at an edge or mislabelled, which tell nothing of their block
UNDER = 0.01  # m: by no more the ground below a heel is over that below the ball
PITCHES = (0.2, 1.5)  # m, the grids that are looked for
PITCH_STEP = 0.015  # relative: the rim of 4 m of ground then moves by 3 cm
HEADING_STEP = np.radians(1.5)
SHIFTS = 10  # offsets that are tried in each direction
COARSE = 100  # stances, evenly chosen, that rank the coarse grids
PROMISING = 30  # coarse grids whose surroundings are searched
NEXT = (-0.75, 0.0, 0.75)  # coarse steps to the grids around one
WIDE = (-3, -2, -1, 0, 1, 2, 3)  # standard deviations, over all that may be about as likely
WIDEST = np.array([2.0, 1.0, 0.5, 0.5])  # coarse steps of pitch, heading and offsets that these are
NARROWEST = 0.1  # of the widest
ROUNDS = 4  # of moving to the middle of what is likely
KEPT = 150  # divisions of the stances that go on to be judged without one of them
AS_LIKELY = 2.0  # nats of evidence below the best: 1 to 7


@dataclass(frozen=True)
class Grid:
    """Squares over the ground plan: cell (i, j) is where floor((u - u0) / pitch) is i, v likewise.

    u = cos(heading) x + sin(heading) z and v = -sin(heading) x + cos(heading) z.
    """

    pitch: float  # m
    heading: float  # rad, from -pi/4 to pi/4: a quarter turn is the same grid
    origin: tuple[float, float]  # m, (u0, v0), each from 0 to pitch

    def cells(self, points: Float64[np.ndarray, "points 2"]) -> Int64[np.ndarray, "points 2"]:
        """In which cell each (x, z) lies."""
        return self._floored(points)

    def places(self, at: Float64[np.ndarray, "*b 2"]) -> Float64[np.ndarray, "*b 2"]:
        """(x, z), m, of places in cells: (i, j) is a cell's first corner, (i + 1, j) the next."""
        return (self.pitch * at + np.array(self.origin)) @ _turn(self.heading)

    def _floored(self, points: np.ndarray) -> np.ndarray:
        return np.floor(self._along(points)).astype(np.int64)

    def _along(self, points: np.ndarray) -> np.ndarray:
        return (points @ _turn(self.heading).T - np.array(self.origin)) / self.pitch


@dataclass(frozen=True)
class Footprints:
    """Where flat feet stood: what tells a grid."""

    balls: Float64[np.ndarray, "stances 2"]  # m, (x, z)
    heights: Float64[np.ndarray, " stances"]  # m, of the ground below the balls
    ankles: Float64[np.ndarray, "stances 2"]  # m, (x, z): the ground below is no higher

    def without(self, one: int) -> "Footprints":
        """All but one."""
        others = np.arange(len(self.balls)) != one
        return Footprints(self.balls[others], self.heights[others], self.ankles[others])


@dataclass(frozen=True)
class RankedGrids:
    """Grids that divide the stances differently, the likeliest first."""

    grids: tuple[Grid, ...]
    latitudes: Float64[np.ndarray, " grids"]  # nats, by which all grids that divide alike add
    pitches: tuple[float, float]  # m, from where to where grids are about as likely as the best
    headings: tuple[float, float]  # rad, likewise


def search(feet: Footprints) -> RankedGrids:
    """The grids that explain heights best; the same for the same heights, always.

    Every pitch and heading is tried with the offset that has most pairs of like height in common
    blocks. A grid may explain the heights by chance where it lies just so: the likeliest are judged
    with their surroundings, over which the evidence is averaged, and the best of them moves to the
    mean of all that is likely around it. Of grids that divide the stances alike, the one that is
    nearest to this mean is kept.

    Args:
        feet: of two or more stances.
    """
    judge, middle = _Judge(feet), feet.balls.mean(axis=0)
    coarse = sorted(_coarse(feet), key=judge.evidence, reverse=True)[:PROMISING]
    at = max(coarse, key=lambda grid: judge.around(_around(grid, NEXT, middle)))
    lattice, width = np.array(list(product(WIDE, repeat=4))), WIDEST
    for _ in range(ROUNDS):
        steps = width * lattice
        grids = [_moved(at, each, middle) for each in steps]
        evidence = np.array([judge.evidence(grid) for grid in grids])
        weight = np.exp(evidence - evidence.max())
        mean = np.average(steps, axis=0, weights=weight)
        deviation = np.sqrt(np.average((steps - mean) ** 2, axis=0, weights=weight))
        near = np.argsort(np.linalg.norm((steps - mean) / width, axis=1), kind="stable")
        at, width = _moved(at, mean, middle), np.clip(deviation, NARROWEST * WIDEST, WIDEST)
    divisions: dict[bytes, list[int]] = {}
    for index in near:
        division = _numbered(grids[index]._floored(feet.balls)).tobytes()
        divisions.setdefault(division, []).append(int(index))
    together = {
        alike[0]: float(np.logaddexp.reduce(evidence[alike])) for alike in divisions.values()
    }
    kept = sorted(together, key=lambda index: -together[index])[:KEPT]
    alike = [grids[index] for index in np.flatnonzero(evidence >= evidence.max() - AS_LIKELY)]
    return RankedGrids(
        tuple(grids[index] for index in kept),
        np.array([together[index] - evidence[index] for index in kept]),
        _extent([grid.pitch for grid in alike]),
        _extent([grid.heading for grid in alike]),
    )


def likeliest(ranked: RankedGrids, feet: Footprints) -> Grid:
    """The grid whose division of the stances has the most evidence."""
    judge = _Judge(feet)
    evidence = [judge.evidence(grid) for grid in ranked.grids]
    return ranked.grids[int(np.argmax(evidence + ranked.latitudes))]


class _Judge:
    """Evidence of grids for the same footprints."""

    def __init__(self, feet: Footprints) -> None:
        heights = feet.heights
        centre, spread = _spread(heights)
        levels = np.arange(heights.min() - 3 * NOISE, heights.max() + 3 * NOISE, NOISE)
        apart = heights[:, None] - levels
        ball = _mixed(_log_normal(apart, NOISE), _log_normal(heights[:, None] - centre, spread))
        ankle = _mixed(log_ndtr((apart + UNDER) / NOISE), np.zeros(()))
        prior = _log_normal(levels - centre, spread)
        self.points = np.concatenate([feet.balls, feet.ankles])
        self.likelihood = np.concatenate([ball, ankle])  # (points, levels)
        self.prior = prior - _log_sum(prior)

    def evidence(self, grid: Grid) -> float:
        """Log of the probability density of the heights, nats."""
        number = _numbered(grid._floored(self.points))
        member = np.equal.outer(np.arange(number.max() + 1), number).astype(np.float64)
        cells = member @ self.likelihood + self.prior
        top = cells.max(axis=1)
        return float(np.sum(top + np.log(np.exp(cells - top[:, None]).sum(axis=1))))

    def around(self, grids: Sequence[Grid]) -> float:
        """Evidence for one of these grids, none of them likelier beforehand, nats."""
        return float(
            np.logaddexp.reduce([self.evidence(grid) for grid in grids]) - np.log(len(grids))
        )


def _mixed(usual: np.ndarray, odd: np.ndarray) -> np.ndarray:
    """Log likelihood of stances of which a few are odd."""
    return np.logaddexp(np.log(1.0 - ODD) + usual, np.log(ODD) + odd)


def _coarse(feet: Footprints) -> list[Grid]:
    """For every pitch and heading the grid whose offset suits pairs of stances best."""
    chosen = np.unique(np.linspace(0, len(feet.balls) - 1, COARSE).round().astype(int))
    points, heights = feet.balls[chosen], feet.heights[chosen]
    middle = points.mean(axis=0)
    first, second = np.triu_indices(len(points), 1)
    _, spread = _spread(heights)
    apart = heights[first] - heights[second]
    unlike = _log_normal(apart, np.sqrt(2) * spread)
    like = _mixed(_log_normal(apart, np.sqrt(2) * NOISE), unlike)
    worth = like - unlike  # nats, of having the two in one block
    shifts = np.arange(SHIFTS) / SHIFTS
    pitches = np.exp(np.arange(np.log(PITCHES[0]), np.log(PITCHES[1]), PITCH_STEP))
    grids = []
    for heading in np.arange(-np.pi / 4, np.pi / 4, HEADING_STEP):
        turned = (points - middle) @ _turn(heading).T
        for pitch in pitches:
            cells = np.floor(turned[None] / pitch + shifts[:, None, None])
            together = cells[:, first] == cells[:, second]  # (shifts, pairs, 2)
            gain = (together[..., 0] * worth) @ together[..., 1].T.astype(np.float64)
            best = np.unravel_index(np.argmax(gain), gain.shape)
            origin = middle @ _turn(heading).T - pitch * shifts[list(best)]
            grids.append(_grid(pitch, heading, origin))
    return grids


def _around(grid: Grid, steps: Sequence[float], middle: np.ndarray) -> list[Grid]:
    """Grids larger or smaller, turned and shifted by all of these coarse steps."""
    return [_moved(grid, np.array(each), middle) for each in product(steps, repeat=4)]


def _moved(grid: Grid, steps: np.ndarray, middle: np.ndarray) -> Grid:
    """A grid that grew, turned and shifted by coarse steps, about the middle."""
    pitch = grid.pitch * np.exp(PITCH_STEP * steps[0])
    heading = grid.heading + HEADING_STEP * steps[1]
    at = grid._along(middle[None])[0] + steps[2:] / SHIFTS
    return _grid(pitch, heading, middle @ _turn(heading).T - pitch * at)


def _grid(pitch: float, heading: float, origin: np.ndarray) -> Grid:
    """The grid in its one way of writing."""
    quarters = int(np.round(heading / (np.pi / 2)))
    for _ in range(quarters % 4):  # the axes of the grid turned back: u is -v, v is u
        origin = np.array([-origin[1], origin[0]])
    u, v = np.mod(origin, pitch)
    return Grid(float(pitch), float(heading - quarters * np.pi / 2), (float(u), float(v)))


def _turn(heading: float) -> np.ndarray:
    """(u, v) from (x, z)."""
    cos, sin = np.cos(heading), np.sin(heading)
    return np.array([[cos, sin], [-sin, cos]])


def _numbered(cells: np.ndarray) -> np.ndarray:
    """Cells by number, in order of their place."""
    low = cells.min(axis=0)
    key = (cells[:, 0] - low[0]) * (np.ptp(cells[:, 1]) + 1) + cells[:, 1] - low[1]
    return np.unique(key, return_inverse=True)[1].astype(np.int64)


def _extent(values: Sequence[float]) -> tuple[float, float]:
    return min(values), max(values)


def _spread(heights: np.ndarray) -> tuple[float, float]:
    """Where block heights are, and how far apart, m, at least so much that a pair can be unlike."""
    return float(np.mean(heights)), max(float(np.std(heights)), 3 * NOISE)


def _log_sum(logs: np.ndarray) -> float:
    return float(np.logaddexp.reduce(logs))


def _log_normal(apart: np.ndarray, deviation: float) -> np.ndarray:
    return -0.5 * (apart / deviation) ** 2 - np.log(deviation * np.sqrt(2 * np.pi))
