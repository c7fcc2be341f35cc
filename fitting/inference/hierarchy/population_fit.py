"""The fit of a hierarchy: centres, spreads and each clip's parameters, from all clips together.

It alternates, as Lindstrom and Bates (1990) do for nonlinear mixed models, between the linear mixed
model that the clips' residuals give around their present parameters, which has the most probable
spreads, and a step of Gauss and Newton towards its mode, halved until the cost falls. Thresholds
are held: they have no derivatives.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float

from fitting.problem.problem import Problem
from fitting.problem.space import Space
from fitting.runtime.precision import in_float64

from .grouping import Grouping
from .likelihoods import Likelihoods, approximate_prior, expand
from .mixed_model import MixedModel

MAX_ROUNDS = 60
SMALL_STEP = 0.01  # of a parameter's standard deviation: nothing moves by more at the end
SMALL_CHANGE = 1e-3  # of a spread, relative to its scale, likewise
HALVINGS = 12  # of a step

Points = Float[np.ndarray, "clips free"]


@dataclasses.dataclass(frozen=True)
class PopulationFit:
    """The mode of a hierarchy, and the mixed model there."""

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

        Those of its own group where other clips belong to it, else the centre.

        Args:
            grouping: of all clips; the fit's is `grouping.without(clip)`.
            clip: the one left out.
        """
        others = np.delete(np.arange(len(grouping.group)), clip).tolist()
        predicted = self.centre.copy()
        for k in grouping.varying:
            companions = grouping.companions(clip, k)
            if companions.size:
                predicted[k] = self.clips[others.index(companions[0]), k]
        return predicted


@in_float64
def fit_population(
    problems: Sequence[Problem],
    grouping: Grouping,
    starts: Sequence[Points],
    progress: Callable[[int, float], None] = lambda rounds, cost: None,
) -> PopulationFit:
    """The most probable of the modes that the starts lead to.

    Args:
        problems: of one clip each, with the same free parameters and prior.
        grouping: of the clips, for each free parameter; thresholds are shared.
        starts: of all clips, in u; thresholds are held at the values of the first one's first clip.
        progress: called after each round with its number and the cost.

    Raises:
        ValueError: a threshold is not shared; residuals or derivatives are not finite at a start.
    """
    space = problems[0].space
    check_thresholds(space, grouping)
    smooth = np.asarray(space.smooth)
    held = np.where(smooth, 0.0, starts[0][0])
    fits = [
        _Search(problems, space, grouping, smooth, progress).run(np.where(smooth, start, held))
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
    """The linear mixed model of the smooth parameters around these points.

    Args:
        likelihoods: of the clips.
        space: of the free parameters, with their prior.
        grouping: of the clips, for each free parameter.
        centre: in u, where the prior is approximated.
    """
    smooth = np.flatnonzero(space.smooth)
    prior = approximate_prior(space.prior, centre)
    return MixedModel(
        grouping=grouping.of(smooth),
        information=likelihoods.information[:, smooth][:, :, smooth],
        vector=likelihoods.vector[:, smooth],
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
    """There."""


@dataclasses.dataclass(frozen=True)
class _Search:
    """What stays the same in a search."""

    problems: Sequence[Problem]
    space: Space
    grouping: Grouping
    smooth: Bool[np.ndarray, " free"]
    progress: Callable[[int, float], None]

    def run(self, start: Points) -> PopulationFit:
        """The mode that a start leads to."""
        likelihoods = expand(self.problems, start)
        if not _finite(likelihoods):
            raise ValueError("residuals or derivatives are not finite where the hierarchy begins")
        model = model_around(likelihoods, self.space, self.grouping, start.mean(axis=0))
        state = self._at(*self._mode(model, start))
        for rounds in range(1, MAX_ROUNDS + 1):
            before, model = model, self._model(state)
            spreads, target = model.most_probable_spreads, self._mode(model, state.likelihoods.u)
            gap = np.abs(target[0] + target[1] - state.likelihoods.u)[:, self.smooth]
            change = np.abs(spreads - before.most_probable_spreads) / model.spread_scale
            near = np.all(gap <= SMALL_STEP * model.estimate(spreads).clip_sd)
            if near and np.all(change <= SMALL_CHANGE):
                return self._finished(state, rounds, converged=True)
            after = self._step(state, target, self._of_all(spreads))
            if after is state:
                break
            state = after
            self.progress(rounds, float(state.likelihoods.cost.sum()))
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

    def _step(self, state: _State, target: tuple[np.ndarray, Points], spread: np.ndarray) -> _State:
        """The state on the way to the target where the cost is no higher, or the state itself."""
        here = state
        collapsed = np.where(spread > 0, state.deviations, 0.0)
        if np.any(collapsed != state.deviations):  # a spread is 0 now
            here = self._at(state.centre, collapsed)
        cost = self._cost(here, spread)
        for halving in range(HALVINGS):
            fraction = 0.5**halving
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
