"""Modes: parts of a posterior that lie apart, so that small steps do not lead between them.

They are found in the draws by single linkage: two draws belong together if a chain of draws with
small gaps leads from one to the other. Around each mode stands a multivariate t distribution,
from which jumps between modes are proposed.
"""

import dataclasses
import math
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from .chain import autocorrelation_time

POINTS = 1000  # draws among which gaps are sought, at most
GAP = 1.6  # spreads, and times the usual gap on either side, that separate modes
USUAL = 0.9  # quantile of the gaps between neighbours that is usual
MAX_MODES = 8  # if more are found, the walkers have not mixed yet
SMALLEST = 0.01  # fraction of the draws of a mode
DEGREES = 5.0  # of freedom of the t distribution: tails wide enough for modes that are not normal
MIN_EXCHANGES = 20  # of a mode with the others, below which its weight is unknown


@dataclasses.dataclass(frozen=True)
class Modes:
    """A mixture of multivariate t distributions, one around each mode."""

    centres: Float[np.ndarray, "modes free"]
    factors: Float[np.ndarray, "modes free free"]
    """Of the scale matrices, lower triangular (Cholesky)."""
    weights: Float[np.ndarray, " modes"]
    """Of the mixture; not those of the posterior."""

    def __len__(self) -> int:
        return len(self.weights)

    def log_densities(self, u: Float[np.ndarray, "draws free"]) -> Float[np.ndarray, "modes draws"]:
        """Of each mode's part of the mixture, up to a constant that is the same for all."""
        free = u.shape[1]
        away = np.linalg.solve(self.factors, np.swapaxes(u[None] - self.centres[:, None], 1, 2))
        squares = np.sum(away**2, axis=1)
        log_volumes = np.sum(np.log(np.diagonal(self.factors, axis1=1, axis2=2)), axis=1)
        heights = np.log(self.weights) - log_volumes
        return heights[:, None] - 0.5 * (DEGREES + free) * np.log1p(squares / DEGREES)

    def log_density(self, u: Float[np.ndarray, "draws free"]) -> Float[np.ndarray, " draws"]:
        """Of the mixture, up to a constant."""
        return np.logaddexp.reduce(self.log_densities(u), axis=0)

    def labels(
        self, u: Float[np.ndarray, "steps walkers free"]
    ) -> Int[np.ndarray, "steps walkers"]:
        """The mode in which each draw lies."""
        flat = u.reshape(-1, u.shape[-1])
        return np.argmax(self.log_densities(flat), axis=0).reshape(u.shape[:-1])

    def draw(self, random: np.random.RandomState, count: int) -> Float[np.ndarray, "draws free"]:
        """Draws of the mixture."""
        mode = random.choice(len(self), size=count, p=self.weights)
        normal = random.standard_normal((count, self.centres.shape[1]))
        scale = np.sqrt(DEGREES / random.chisquare(DEGREES, count))
        return self.centres[mode] + scale[:, None] * np.einsum(
            "nij,nj->ni", self.factors[mode], normal
        )


def find_modes(u: Float[np.ndarray, "steps walkers free"]) -> Modes:
    """The modes in which these draws lie, those of fewer than 1 % of them left aside."""
    from scipy.cluster import hierarchy  # here, for it takes a while to import

    flat = u.reshape(-1, u.shape[-1])
    spread = local_spread(u)
    points = flat[np.unique(np.linspace(0, len(flat) - 1, POINTS).astype(int))]
    if len(points) < 2:
        return _around([points], spread)
    root: Any = hierarchy.to_tree(hierarchy.linkage(points / spread, "single"))
    apart = _split(root, max(2.0, SMALLEST * len(points)))
    if len(apart) > MAX_MODES:
        apart = [root]
    return _around([points[node.pre_order()] for node in apart], spread)


def _split(root: Any, smallest: float) -> list[Any]:
    """The nodes of a tree of single linkage between which there are gaps."""
    apart, waiting = [], [root]
    while waiting:
        top = node = waiting.pop()
        while not node.is_leaf() and min(node.left.count, node.right.count) < smallest:
            node = max(node.left, node.right, key=lambda child: child.count)
        sides = [] if node.is_leaf() else [node.left, node.right]
        if sides and node.dist > GAP * max(1.0, *map(_usual_gap, sides)):
            waiting += sides
        else:
            apart.append(top)
    return apart


def _usual_gap(node: Any) -> float:
    """A gap between neighbours below a node that most do not exceed."""
    gaps, waiting = [], [node]
    while waiting:
        node = waiting.pop()
        if node.dist > 0:
            gaps.append(node.dist)
            waiting += [node.left, node.right]
    return float(np.quantile(gaps, USUAL)) if gaps else 0.0


def local_spread(u: Float[np.ndarray, "steps walkers free"]) -> Float[np.ndarray, " free"]:
    """Standard deviation of each parameter within a mode, roughly.

    It comes from the shorter ones of the walkers' steps, which stay in their mode. A step of
    differential evolution has `2.38 / sqrt(free)` standard deviations (ter Braak 2006).
    """
    steps = np.abs(np.diff(u, axis=0)).reshape(-1, u.shape[-1])
    moved = steps[np.any(steps > 0, axis=1)]
    if not len(moved):
        return np.ones(u.shape[-1])
    quarter = 0.3186 * 2.38 / math.sqrt(u.shape[-1])  # lower quartile of the steps' sizes
    return np.maximum(np.quantile(moved, 0.25, axis=0) / quarter, 1e-12)


def _around(members: list[Float[np.ndarray, "draws free"]], spread: np.ndarray) -> Modes:
    """A t distribution around each mode.

    Where a mode has few draws, its covariance is drawn towards that of all modes together.
    """
    free = len(spread)
    centres = np.stack([points.mean(axis=0) for points in members])
    scatter = np.stack([len(points) * np.cov(points.T, bias=True) for points in members])
    scatter = scatter.reshape(-1, free, free)
    counts = np.array([len(points) for points in members], float)
    floor = np.diag((1e-3 * spread) ** 2)
    pooled = scatter.sum(axis=0) / counts.sum() + floor
    extra = 2.0 * free
    covariances = (scatter + extra * pooled) / (counts + extra)[:, None, None]
    weights = 0.5 * (counts / counts.sum() + 1 / len(counts))
    return Modes(centres, np.linalg.cholesky(covariances), weights)


@dataclasses.dataclass(frozen=True)
class Mode:
    """A mode, as a chain has visited it."""

    median: Float[np.ndarray, " free"]
    """Of u there."""
    weight: float
    """Fraction of the draws; one of the posterior only if walkers come and go."""
    error: float
    """Standard error of the weight; NaN where it is out of reach."""
    exchanges: int
    """How often a walker came or left."""
    walkers: int
    """Number of walkers in the mode at the end."""
    log_probability: float
    """The highest one there."""

    @property
    def is_weighed(self) -> bool:
        """Whether walkers come and go often enough for the weight to be that of the posterior."""
        return self.exchanges >= MIN_EXCHANGES


def survey(
    u: Float[np.ndarray, "steps walkers free"], log_probability: Float[np.ndarray, "steps walkers"]
) -> tuple[Mode, ...]:
    """The modes in which walkers are, the heaviest first; none where there is only one."""
    mixture = find_modes(u)
    if len(mixture) == 1:
        return ()
    labels = mixture.labels(u)
    changes = labels[1:] != labels[:-1]
    modes = []
    for label in np.unique(labels):
        there = labels == label
        exchanges = int(np.sum(changes & (there[1:] | there[:-1])))
        weight = float(there.mean())
        time = float(autocorrelation_time(there[..., None].astype(float))[0])
        error = math.sqrt(weight * (1 - weight) * time / there.size)
        modes.append(
            Mode(
                median=np.median(u[there], axis=0),
                weight=weight,
                error=error if exchanges >= MIN_EXCHANGES else math.nan,
                exchanges=exchanges,
                walkers=int(there[-1].sum()),
                log_probability=float(log_probability[there].max()),
            )
        )
    return tuple(sorted(modes, key=lambda mode: -mode.weight))


def log_mass(
    u: Float[np.ndarray, "steps walkers free"], log_probability: Float[np.ndarray, "steps walkers"]
) -> float:
    """Logarithm of the integral of the density over a mode, if that is normal.

    The integral's logarithm is the mean of the log-density plus the entropy, which for a normal
    follows from the covariance. Minus infinity where walkers never move.
    """
    covariance = np.atleast_2d(np.cov(u.reshape(-1, u.shape[-1]).T))
    sign, log_determinant = np.linalg.slogdet(2 * np.pi * np.e * covariance)
    return float(log_probability.mean() + 0.5 * log_determinant) if sign > 0 else -math.inf
