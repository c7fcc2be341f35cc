"""The linear mixed model: quadratic likelihoods of several clips, tied by a population.

Minus the log-likelihood of clip c is `½ u'A_c u - a_c'u`. A parameter of it is

    u = centre                        where all clips share it
    u = centre + spread z_g           where it varies: z_g is standard normal, one for each group

which is the non-centred form: it has no singularity where the spread is 0 and all groups are alike.
Given the spreads, centres and z are normal, and integrated out exactly. Centres have the prior of
the parameters. Spreads have a half-normal prior with the standard deviation that the parameters'
prior has: groups differ no more than the prior allows a parameter to vary. Its density is highest,
and finite, at 0; with flat priors this is restricted maximum likelihood (REML).
"""

import dataclasses
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import linalg, optimize

from .grouping import SHARED, Grouping

GRID = np.linspace(0.0, 1.0, 401) ** 2  # of the widest spread: where a density is computed
WIDEST = 4.0  # scales of the half-normal prior, where the grid ends
MAX_SWEEPS = 200  # over the spreads, each maximised for the others
TOLERANCE = 1e-6  # of a spread, relative to its scale, that ends the sweeps
BLOCK = 200  # draws computed at once
BURN_IN = 50  # draws of the spreads that are dropped

Spreads = Float[np.ndarray, " parameters"]


class Estimate(NamedTuple):
    """What the model says of centres and clips, given the spreads."""

    centre: Float[np.ndarray, " parameters"]
    clips: Float[np.ndarray, "clips parameters"]
    centre_sd: Float[np.ndarray, " parameters"]
    clip_sd: Float[np.ndarray, "clips parameters"]


class SpreadDensity(NamedTuple):
    """The distribution of a spread, all else integrated out."""

    edges: Float[np.ndarray, " edges"]
    """Of cells, from 0 up."""
    probability: Float[np.ndarray, " cells"]

    def draw(self, random: np.random.Generator, count: int) -> np.ndarray:
        """Independent draws, uniform in each cell."""
        cells = random.choice(len(self.probability), size=count, p=self.probability)
        return self.edges[cells] + np.diff(self.edges)[cells] * random.random(count)

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """The shortest interval with this probability; from 0 where the density is high there."""
        density = self.probability / np.diff(self.edges)
        order = np.argsort(-density, kind="stable")
        enough = int(np.searchsorted(np.cumsum(self.probability[order]), level))
        cells = order[: enough + 1]
        return float(self.edges[cells.min()]), float(self.edges[cells.max() + 1])


class Draws(NamedTuple):
    """Draws of everything that is unknown, from its joint distribution."""

    spread: Float[np.ndarray, "draws parameters"]
    """0 where shared."""
    spread_density: dict[int, SpreadDensity]
    """Of each parameter that varies: the mean of its conditional ones."""
    centre: Float[np.ndarray, "draws parameters"]
    clips: Float[np.ndarray, "draws clips parameters"]


class _Conditional(NamedTuple):
    """What the data say of the spread of one parameter, given the others: `log_density`."""

    information: np.ndarray  # of the groups' deviations, along its eigenvectors
    score: np.ndarray  # of them, at 0, squared
    scale: float  # of the half-normal prior

    def log_density(self, spread: np.ndarray) -> np.ndarray:
        """Of spreads, up to a constant.

        The integral of `exp(score'b - ½ b'S b)` over deviations b with variance `spread²` is a
        product over the eigenvectors of S.
        """
        variance = np.square(spread)[..., None]
        inflation = 1 + variance * self.information
        gain = variance * self.score / inflation - np.log(inflation)
        return 0.5 * gain.sum(axis=-1) - 0.5 * np.square(spread / self.scale)

    def grid(self) -> np.ndarray:
        """Spreads from 0 to the widest, closest to each other at 0."""
        return WIDEST * self.scale * GRID

    def most_probable(self) -> float:
        """The spread with the highest density."""
        grid = self.grid()
        best = int(np.argmax(self.log_density(grid)))
        bounds = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
        found = optimize.minimize_scalar(
            lambda spread: -float(self.log_density(np.asarray(spread))),
            bounds=bounds,
            method="bounded",
            options={"xatol": 1e-9 * self.scale},
        )
        return 0.0 if self.log_density(np.zeros(())) >= -found.fun else float(found.x)

    def density(self) -> SpreadDensity:
        """The distribution on the grid; in each cell, the density is that of its middle."""
        grid = self.grid()
        density = self.log_density(0.5 * (grid[1:] + grid[:-1]))
        weight = np.exp(density - density.max()) * np.diff(grid)
        return SpreadDensity(grid, weight / weight.sum())


@dataclasses.dataclass(frozen=True)
class MixedModel:
    """Clips with quadratic likelihoods, and the prior of what they share."""

    grouping: Grouping
    information: Float[np.ndarray, "clips parameters parameters"]
    """A of each clip."""
    vector: Float[np.ndarray, "clips parameters"]
    """a of each clip: its information times where its likelihood is highest."""
    prior_information: Float[np.ndarray, " parameters"]
    """Of the centres."""
    prior_vector: Float[np.ndarray, " parameters"]
    """Likewise, times their prior means."""
    spread_scale: Spreads
    """Of the half-normal prior of the spreads."""

    @cached_property
    def most_probable_spreads(self) -> Spreads:
        """The spreads of highest density, all else integrated out; 0 where shared."""
        spreads = np.where(self.grouping.counts > 0, self.spread_scale, 0.0)
        for _ in range(MAX_SWEEPS):
            before = spreads.copy()
            for k in self.grouping.varying:
                spreads[k] = self._conditional(k, spreads).most_probable()
            if np.all(np.abs(spreads - before) <= TOLERANCE * self.spread_scale):
                break
        return spreads

    def log_volume(self, spreads: Spreads) -> float:
        """Log of the integral over centres and z relative to its integrand at the mode.

        Up to a constant, and with the prior of the spreads.
        """
        lower = linalg.cholesky(self._posterior(spreads)[0], lower=True)
        prior = float(np.sum(np.square(spreads / self.spread_scale)))
        return -float(np.sum(np.log(np.diag(lower)))) - 0.5 * prior

    def log_marginal(self, spreads: Spreads) -> float:
        """Log-probability of spreads, up to a constant, all else integrated out."""
        precision, vector, _ = self._posterior(spreads)
        at_mode = float(vector @ linalg.solve(precision, vector, assume_a="pos"))
        return 0.5 * at_mode + self.log_volume(spreads)

    def estimate(self, spreads: Spreads) -> Estimate:
        """Means and standard deviations, given the spreads."""
        precision, vector, scale = self._posterior(spreads)
        covariance = linalg.inv(precision)
        mean = covariance @ vector
        to_clips = self._designs * scale
        variance = np.einsum("cki,ij,ckj->ck", to_clips, covariance, to_clips)
        centres = slice(0, self._size)
        return Estimate(
            centre=mean[centres],
            clips=to_clips @ mean,
            centre_sd=np.sqrt(np.diag(covariance)[centres]),
            clip_sd=np.sqrt(variance),
        )

    def draw(self, random: np.random.Generator, count: int) -> Draws:
        """Draws of spreads, centres and clips."""
        spreads, densities = self._draw_spreads(random, count)
        parts = np.array_split(spreads, count // BLOCK + 1)
        blocks = [self._draw_given(part, random) for part in parts]
        centres, clips = (np.concatenate(column) for column in zip(*blocks, strict=True))
        return Draws(spreads, densities, centres, clips)

    def _draw_spreads(
        self, random: np.random.Generator, count: int
    ) -> tuple[np.ndarray, dict[int, SpreadDensity]]:
        """Draws of the spreads by a Gibbs sampler in which all else is integrated out.

        Each is drawn from its density on a grid (Ritter and Tanner 1992); where only one parameter
        varies, that is its distribution, and the draws are independent.
        """
        varying, spreads = self.grouping.varying, np.zeros((count, self._size))
        if len(varying) == 1:
            density = self._conditional(varying[0], spreads[0]).density()
            spreads[:, varying[0]] = density.draw(random, count)
            return spreads, {varying[0]: density}
        present, rounds = self.most_probable_spreads.copy(), []
        for number in range(-BURN_IN, count):
            densities = {}
            for k in varying:
                densities[k] = self._conditional(k, present).density()
                present[k] = densities[k].draw(random, 1)[0]
            if number >= 0:
                spreads[number] = present
                rounds.append(densities)
        means = {
            k: SpreadDensity(
                rounds[0][k].edges, np.mean([each[k].probability for each in rounds], axis=0)
            )
            for k in varying
        }
        return spreads, means

    def _draw_given(
        self, spreads: Float[np.ndarray, "draws parameters"], random: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """A draw of centres and clips for each draw of the spreads."""
        each = [self._posterior(row) for row in spreads]
        precision, vector, scale = (np.stack(part) for part in zip(*each, strict=True))
        lower = np.linalg.cholesky(precision)
        mean = np.linalg.solve(precision, vector[..., None])
        white = random.normal(size=mean.shape)
        drawn = (mean + np.linalg.solve(lower.transpose(0, 2, 1), white))[..., 0]
        clips = np.einsum("cki,di->dck", self._designs, scale * drawn)
        return drawn[:, : self._size], clips

    def _posterior(self, spreads: Spreads) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Precision and information vector of centres and z, and the scale of each column."""
        scale = np.concatenate([np.ones(self._size), spreads[self._owners]])
        information, vector = self._joint
        precision = scale[:, None] * information * scale
        precision[np.diag_indices_from(precision)] += self._prior_precision
        shifted = scale * vector
        shifted[: self._size] += self.prior_vector
        return precision, shifted, scale

    def _conditional(self, k: int, spreads: Spreads) -> _Conditional:
        """What the data say of one spread, all deviations of others integrated out."""
        own = np.concatenate([np.zeros(self._size, bool), self._owners == k])
        as_deviations = np.where(np.arange(self._size) == k, 1.0, spreads)
        precision, vector, _ = self._posterior(as_deviations)
        within = precision[np.ix_(own, own)] - np.eye(int(own.sum()))
        across = precision[np.ix_(~own, own)]
        rest = linalg.cho_factor(precision[np.ix_(~own, ~own)])
        eliminated = linalg.cho_solve(rest, np.column_stack([across, vector[~own]]))
        schur = within - across.T @ eliminated[:, :-1]
        score = vector[own] - across.T @ eliminated[:, -1]
        information, directions = np.linalg.eigh(schur)
        return _Conditional(
            np.maximum(information, 0.0), np.square(directions.T @ score), self.spread_scale[k]
        )

    @property
    def _size(self) -> int:
        """Number of parameters."""
        return self.grouping.group.shape[1]

    @cached_property
    def _owners(self) -> np.ndarray:
        """The parameter that each z belongs to."""
        return np.repeat(np.arange(self._size), self.grouping.counts)

    @cached_property
    def _prior_precision(self) -> np.ndarray:
        """Of the centres, and of the z."""
        return np.concatenate([self.prior_information, np.ones(len(self._owners))])

    @cached_property
    def _designs(self) -> Float[np.ndarray, "clips parameters columns"]:
        """How each clip's parameters are made of the centres and of deviations."""
        clips, size = self.grouping.group.shape
        first = size + np.concatenate([[0], np.cumsum(self.grouping.counts)[:-1]])
        designs = np.zeros((clips, size, size + len(self._owners)))
        designs[:, np.arange(size), np.arange(size)] = 1.0
        for clip, row in enumerate(self.grouping.group):
            for k in np.flatnonzero(row != SHARED):
                designs[clip, k, first[k] + row[k]] = 1.0
        return designs

    @cached_property
    def _joint(self) -> tuple[np.ndarray, np.ndarray]:
        """Information matrix and vector of centres and deviations, over all clips."""
        designs = self._designs
        information = np.einsum("cki,ckl,clj->ij", designs, self.information, designs)
        return information, np.einsum("cki,ck->i", designs, self.vector)
