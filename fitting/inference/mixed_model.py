"""The linear mixed model of several clips, and the fit of its centres, spreads and parameters.

The fit alternates, as Lindstrom and Bates (1990) do for nonlinear mixed models, between the linear
model that the clips' residuals give around their present parameters, which has the most probable
spreads, and a step of Gauss and Newton towards its mode, halved until the cost falls. Thresholds
are held: they have no derivatives. Likelihoods are approximated as Laplace's approximation of a
single fit does, by Gauss and Newton with the Fisher information where the loss has one, which takes
no program that a search has not compiled already.

Minus the log-likelihood of clip c is then `½ u'A_c u - a_c'u`. A parameter of it is

    u = centre                        where all clips share it
    u = centre + spread z_g           where it varies: z_g is standard normal, one for each group

which is the non-centred form: it has no singularity where the spread is 0 and all groups are alike.
Given the spreads, centres and z are normal, and integrated out exactly. Centres have the prior of
the parameters. Spreads have a half-normal prior with the standard deviation that the parameters'
prior has: groups differ no more than the prior allows a parameter to vary. Its density is highest,
and finite, at 0; with flat priors this is restricted maximum likelihood (REML).
"""

import dataclasses
from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import linalg, optimize

from fitting.problem.problem import Problem
from fitting.problem.space import Prior, Space, Vector
from fitting.runtime import activity
from fitting.runtime.precision import in_float64

from .noise import information_of_slopes
from .optimise import levenberg_marquardt
from .optimise.levenberg_marquardt import HardModel

SHARED = -1  # the group of every clip, for a parameter that all clips have in common

GRID = np.linspace(0.0, 1.0, 401) ** 2  # of the widest spread: where a density is computed
WIDEST = 4.0  # scales of the half-normal prior, where the grid ends
MAX_SWEEPS = 200  # over the spreads, each maximised for the others
ROUNDING = 1e-9  # of a log-density, by which a spread of 0 is no worse than another
TOLERANCE = 1e-6  # of a spread, relative to its scale, that ends the sweeps
BLOCK = 200  # draws computed at once
BURN_IN = 50  # draws of the spreads that are dropped

Spreads = Float[np.ndarray, " parameters"]

MAX_ROUNDS = 60
SMALL_STEP = 0.01  # of a parameter's standard deviation: nothing moves by more at the end
SMALL_CHANGE = 1e-3  # of a spread at the end, relative to its scale
HALVINGS = 12  # of a step

Points = Float[np.ndarray, "clips free"]


class Likelihoods(NamedTuple):
    """Clips at one point each, with thresholds held there; minus the log-likelihood is the cost."""

    u: Float[np.ndarray, "clips free"]
    cost: Float[np.ndarray, " clips"]
    gradient: Float[np.ndarray, "clips free"]
    """0 for thresholds."""
    information: Float[np.ndarray, "clips free free"]
    """0 for thresholds."""

    @property
    def vector(self) -> Float[np.ndarray, "clips free"]:
        """The information times where each approximation is lowest."""
        return np.einsum("cij,cj->ci", self.information, self.u) - self.gradient


def expand(problems: Sequence[Problem], u: Float[np.ndarray, "clips free"]) -> Likelihoods:
    """The likelihoods of clips around a point each.

    The problems have one clip each and the same free parameters; their priors do not count.
    """
    each = [_expand(problem, row) for problem, row in zip(problems, u, strict=True)]
    return Likelihoods(u, *(np.stack(column) for column in zip(*each, strict=True)))


def _expand(problem: Problem, u: Vector) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cost, gradient and information of the likelihood of one clip."""
    space = problem.space
    point = jnp.asarray(u, space.start.dtype)
    lm = levenberg_marquardt.evaluate(HardModel(problem, point), point)
    # Few rows with the same squares as all residuals, those of the prior and of thresholds too.
    residuals, jacobian = np.asarray(lm.compressed.residuals), np.asarray(lm.compressed.jacobian)
    weight = float(problem.weight)
    at_prior = PriorApproximation(
        *(weight * part for part in approximate_prior(space.prior, np.asarray(u)))
    )
    smooth = np.asarray(space.smooth)
    gradient = np.where(smooth, jacobian.T @ residuals - at_prior.gradient, 0.0)
    information = jacobian.T @ jacobian - np.diag(at_prior.information)
    information *= np.outer(smooth, smooth)
    factor = information_of_slopes(problem.loss, float(problem.tails))
    return np.asarray(lm.cost - at_prior.cost.sum(), float), gradient, factor * information


class PriorApproximation(NamedTuple):
    """Minus the log density of the prior around a point; of each parameter."""

    cost: Float[np.ndarray, " free"]
    gradient: Float[np.ndarray, " free"]
    information: Float[np.ndarray, " free"]
    """Slope of the residual, squared; always above 0."""


def approximate_prior(prior: Prior, u: Float[np.ndarray, " free"]) -> PriorApproximation:
    """The prior around a point; exact where it is normal."""
    spread, uniform = np.asarray(prior.spread), np.asarray(prior.uniform)
    z = (u - np.asarray(prior.centre)) / spread
    cost = np.where(uniform, 2 * (np.logaddexp(z / 2, -z / 2) - np.log(2)), 0.5 * z**2)
    gradient = np.where(uniform, np.tanh(z / 2), z) / spread
    near = np.abs(z) < 1e-4  # where both vanish; there the information is that of the limit
    limit = np.where(uniform, 0.5, 1.0) / spread**2
    information = np.where(near, limit, gradient**2 / (2 * np.where(near, 1.0, cost)))
    return PriorApproximation(cost, gradient, information)


@dataclasses.dataclass(frozen=True)
class Grouping:
    """The group that each clip belongs to, for each parameter."""

    group: Int[np.ndarray, "clips parameters"]
    """From 0 for each parameter that varies; `SHARED` for the others."""

    @classmethod
    def of_labels(cls, labels: Sequence[Sequence[str] | None]) -> "Grouping":
        """The grouping in which clips with the same label share a value.

        The labels are those of all clips for each parameter, or None if they share it.

        Raises:
            ValueError: all labels are None, so that the number of clips is not known.
        """
        counts = {len(each) for each in labels if each is not None}
        if len(counts) != 1:
            raise ValueError(f"wanted a label for each clip, got {sorted(counts)} of them")
        columns = [
            np.full(next(iter(counts)), SHARED) if each is None else _numbered(each)
            for each in labels
        ]
        return cls(np.stack(columns, axis=1))

    @classmethod
    def pooled(cls, clips: int, parameters: int) -> "Grouping":
        """The grouping in which all clips share everything."""
        return cls(np.full((clips, parameters), SHARED))

    @property
    def varying(self) -> tuple[int, ...]:
        """Indices of the parameters that are not shared."""
        return tuple(np.flatnonzero((self.group != SHARED).any(axis=0)).tolist())

    @property
    def counts(self) -> Int[np.ndarray, " parameters"]:
        """The number of groups of each parameter; 0 where shared."""
        return self.group.max(axis=0) + 1

    def without(self, clip: int) -> "Grouping":
        """The grouping of the other clips; groups that have none left are gone."""
        rest = np.delete(self.group, clip, axis=0)
        columns = [
            column if column[0] == SHARED else np.unique(column, return_inverse=True)[1]
            for column in rest.T
        ]
        return Grouping(np.stack(columns, axis=1))

    def of(self, parameters: Sequence[int] | np.ndarray) -> "Grouping":
        """The grouping of some of the parameters."""
        return Grouping(self.group[:, np.asarray(parameters, int)])

    def companions(self, clip: int, parameter: int) -> np.ndarray:
        """Indices of the other clips that share a varying parameter's value with a clip."""
        column = self.group[:, parameter]
        alike = np.flatnonzero(column == column[clip])
        return alike[alike != clip]


def _numbered(labels: Sequence[str]) -> np.ndarray:
    """The labels as numbers, in the order in which they first appear."""
    numbers = {label: i for i, label in enumerate(dict.fromkeys(labels))}
    return np.array([numbers[label] for label in labels])


class Estimate(NamedTuple):
    """Centres and clips by the model, given the spreads."""

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
    """The density of the spread of one parameter, given the others."""

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
        optimum = optimize.minimize_scalar(
            lambda spread: -float(self.log_density(np.asarray(spread))),
            bounds=bounds,
            method="bounded",
            options={"xatol": 1e-9 * self.scale},
        )
        gain = -optimum.fun - float(self.log_density(np.zeros(())))
        return float(optimum.x) if gain > ROUNDING else 0.0

    def density(self) -> SpreadDensity:
        """The distribution on the grid; in each cell, the density is that of its middle."""
        grid = self.grid()
        density = self.log_density(0.5 * (grid[1:] + grid[:-1]))
        weight = np.exp(density - density.max()) * np.diff(grid)
        return SpreadDensity(grid, weight / weight.sum())


@dataclasses.dataclass(frozen=True)
class MixedModel:
    """Clips with quadratic likelihoods, and the prior of their centres and spreads."""

    grouping: Grouping
    information: Float[np.ndarray, "clips parameters parameters"]
    """A of each clip."""
    vector: Float[np.ndarray, "clips parameters"]
    """a of each clip: its information times where its likelihood is highest."""
    prior_information: Float[np.ndarray, " parameters"]
    """Of the centres."""
    prior_vector: Float[np.ndarray, " parameters"]
    """The prior information times the prior means."""
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
        """The density of one spread, all deviations of others integrated out."""
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


@dataclasses.dataclass(frozen=True)
class PopulationFit:
    """The mode of the joint distribution, and the mixed model there."""

    centre: Float[np.ndarray, " free"]
    """In u; thresholds are where they were held."""
    clips: Points
    """In u."""
    spread: Float[np.ndarray, " free"]
    """Of u; 0 where shared, and where all groups are most probably alike."""
    model: MixedModel
    """Of the smooth parameters, at the mode."""
    smooth: Bool[np.ndarray, " free"]
    cost: float
    """Minus the log-likelihood of all clips."""
    log_probability: float
    """Of the spreads, all else integrated out around the mode; to compare modes."""
    rounds: int
    converged: bool

    def predict(self, grouping: Grouping, clip: int) -> Float[np.ndarray, " free"]:
        """The parameters that the fit, made without a clip, expects of it, in u.

        Those of its own group where other clips belong to it, else the centre. The grouping is of
        all clips; the fit's is `grouping.without(clip)`.
        """
        others = np.delete(np.arange(len(grouping.group)), clip).tolist()
        predicted = self.centre.copy()
        for k in grouping.varying:
            companions = grouping.companions(clip, k)
            if companions.size:
                predicted[k] = self.clips[others.index(companions[0]), k]
        return predicted


class Round(NamedTuple):
    """One report of a running fit."""

    number: int
    cost: float

    def __str__(self) -> str:
        return f"round {self.number}  cost {self.cost:.6g}"


@in_float64
def fit_population(
    problems: Sequence[Problem],
    grouping: Grouping,
    starts: Sequence[Points],
) -> PopulationFit:
    """The most probable of the modes that the starts lead to.

    Args:
        problems: of one clip each, with the same free parameters and prior.
        grouping: of the clips, for each free parameter; thresholds are shared.
        starts: of all clips, in u; thresholds are held at the values of the first one's first clip.

    Raises:
        ValueError: a threshold is not shared; residuals or derivatives are not finite at a start.
    """
    space = problems[0].space
    check_thresholds(space, grouping)
    smooth = np.asarray(space.smooth)
    held = np.where(smooth, 0.0, starts[0][0])
    fits = [
        _Search(problems, space, grouping, smooth).run(np.where(smooth, start, held))
        for start in starts
    ]
    return max(fits, key=lambda fit: fit.log_probability)


def check_thresholds(space: Space, grouping: Grouping) -> None:
    """Raises ValueError if a threshold varies."""
    if thresholds := [space.names[k] for k in grouping.varying if not space.smooth[k]]:
        raise ValueError(
            f"{thresholds[0]} is a threshold: residuals jump with it, so that no derivative says "
            "how far it may vary between clips; leave it shared"
        )


def model_around(
    likelihoods: Likelihoods,
    space: Space,
    grouping: Grouping,
    centre: Float[np.ndarray, " free"],
) -> MixedModel:
    """The linear mixed model of the smooth parameters around the points of these likelihoods.

    The grouping is for each free parameter; the prior is approximated at the centre, in u.
    """
    smooth = np.flatnonzero(space.smooth)
    information = likelihoods.information[:, smooth][:, :, smooth]
    return smooth_model(information, likelihoods.vector[:, smooth], space, grouping, centre)


def smooth_model(
    information: Float[np.ndarray, "clips smooth smooth"],
    vector: Float[np.ndarray, "clips smooth"],
    space: Space,
    grouping: Grouping,
    centre: Float[np.ndarray, " free"],
) -> MixedModel:
    """The model of `model_around` from the information and vector of its smooth parameters."""
    smooth = np.flatnonzero(space.smooth)
    prior = approximate_prior(space.prior, centre)
    return MixedModel(
        grouping=grouping.of(smooth),
        information=information,
        vector=vector,
        prior_information=prior.information[smooth],
        prior_vector=(prior.information * centre - prior.gradient)[smooth],
        spread_scale=np.asarray(space.prior.sd, float)[smooth],
    )


@dataclasses.dataclass(frozen=True)
class _State:
    """Where a search stands."""

    centre: Float[np.ndarray, " free"]
    deviations: Points
    """Of each clip from the centre; 0 where shared."""
    likelihoods: Likelihoods
    """At these points."""


@dataclasses.dataclass(frozen=True)
class _Search:
    """The constants of a search."""

    problems: Sequence[Problem]
    space: Space
    grouping: Grouping
    smooth: Bool[np.ndarray, " free"]

    def run(self, start: Points) -> PopulationFit:
        """The mode that a start leads to."""
        likelihoods = expand(self.problems, start)
        if not _finite(likelihoods):
            raise ValueError("residuals or derivatives are not finite where the mixed model begins")
        model = model_around(likelihoods, self.space, self.grouping, start.mean(axis=0))
        state, fraction, way = self._at(*self._mode(model, start)), 1.0, np.zeros(())
        for rounds in range(1, MAX_ROUNDS + 1):
            before, model = model, self._model(state)
            spreads, target = model.most_probable_spreads, self._mode(model, state.likelihoods.u)
            away = (target[0] + target[1] - state.likelihoods.u)[:, self.smooth]
            last, way = way, away / model.estimate(spreads).clip_sd
            change = np.abs(spreads - before.most_probable_spreads) / model.spread_scale
            if np.all(np.abs(way) <= SMALL_STEP) and np.all(change <= SMALL_CHANGE):
                return self._finished(state, rounds, converged=True)
            if np.sum(way * last) < 0 and np.abs(way).max() > 0.5 * np.abs(last).max():
                fraction *= 0.5  # steps overshoot, and two points may lead to each other for ever
            after = self._step(state, target, self._of_all(spreads), fraction)
            if after is state:
                break
            state = after
            reached = Round(rounds, float(state.likelihoods.cost.sum()))
            activity.report(reached, str(reached))
        return self._finished(state, rounds, converged=False)

    def _finished(self, state: _State, rounds: int, *, converged: bool) -> PopulationFit:
        model = self._model(state)
        spread = self._of_all(model.most_probable_spreads)
        volume = model.log_volume(model.most_probable_spreads)
        return PopulationFit(
            centre=state.centre,
            clips=state.likelihoods.u,
            spread=spread,
            model=model,
            smooth=self.smooth,
            cost=float(state.likelihoods.cost.sum()),
            log_probability=volume - self._cost(state, spread),
            rounds=rounds,
            converged=converged,
        )

    def _model(self, state: _State) -> MixedModel:
        return model_around(state.likelihoods, self.space, self.grouping, state.centre)

    def _mode(self, model: MixedModel, u: Points) -> tuple[np.ndarray, Points]:
        """Centre and clips' deviations at the mode of a model; thresholds as in `u`."""
        estimate = model.estimate(model.most_probable_spreads)
        centre, clips = u[0].copy(), u.copy()
        centre[self.smooth], clips[:, self.smooth] = estimate.centre, estimate.clips
        return centre, clips - centre

    def _step(
        self,
        state: _State,
        target: tuple[np.ndarray, Points],
        spread: np.ndarray,
        longest: float,
    ) -> _State:
        """The state on the way to the target where the cost is no higher, or the state itself.

        `longest` is the largest fraction of the way.
        """
        here = state
        collapsed = np.where(spread > 0, state.deviations, 0.0)
        if np.any(collapsed != state.deviations):  # a spread is 0 now
            here = self._at(state.centre, collapsed)
        cost = self._cost(here, spread)
        for halving in range(HALVINGS):
            fraction = longest * 0.5**halving
            centre = here.centre + fraction * (target[0] - here.centre)
            deviations = here.deviations + fraction * (target[1] - here.deviations)
            trial = self._at(centre, deviations)
            if self._cost(trial, spread) <= cost:
                return trial
        return here

    def _at(self, centre: np.ndarray, deviations: Points) -> _State:
        return _State(centre, deviations, expand(self.problems, centre + deviations))

    def _cost(self, state: _State, spread: np.ndarray) -> float:
        """Minus the log-probability of centres and deviations, given the spreads."""
        if not _finite(state.likelihoods):
            return np.inf
        prior = approximate_prior(self.space.prior, state.centre).cost[self.smooth].sum()
        squares = 0.0
        for k in self.grouping.varying:
            _, firsts = np.unique(self.grouping.group[:, k], return_index=True)
            if spread[k] > 0:
                squares += float(np.sum((state.deviations[firsts, k] / spread[k]) ** 2))
        return float(state.likelihoods.cost.sum() + prior + 0.5 * squares)

    def _of_all(self, spreads: np.ndarray) -> Float[np.ndarray, " free"]:
        """Spreads of all free parameters; thresholds have none."""
        spread = np.zeros(self.space.size)
        spread[self.smooth] = spreads
        return spread


def _finite(likelihoods: Likelihoods) -> bool:
    return all(np.isfinite(part).all() for part in likelihoods)
