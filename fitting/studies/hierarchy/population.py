"""An experiment's clips fitted each alone, all pooled, and as a population."""

import dataclasses
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypedDict

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import jaxik
from fitting.experiments.experiment import ClipEntry, Experiment
from fitting.inference.hierarchy.population_fit import (
    PopulationFit,
    check_thresholds,
    fit_population,
)
from fitting.inference.optimisation.solution import Progress
from fitting.problem.problem import Problem
from fitting.runtime import activity
from fitting.runtime.precision import in_float64

from .estimates import ParameterEstimates, summarise
from .kept_searches import Found, KeptSearches
from .left_out import ClipErrors, error_at, predict, without_clip

EVERYTHING = "all clips"


class PopulationSummary(TypedDict):
    """The content of `population.json`."""

    experiment: str
    clips: list[str]
    subjects: list[str]
    converged: bool
    message: str
    leg_length: float | None
    """m, of the body that the values are for; None if they fit any body as they are."""
    parameters: list[ParameterEstimates]
    errors: list[dict[str, str | float]]


@dataclasses.dataclass(frozen=True)
class Population:
    """The clips of an experiment, fitted each alone, pooled, and as a population."""

    experiment: Experiment
    problem: Problem[jaxik.FootIK]
    """Of all clips."""
    clips: tuple[str, ...]
    """A name for each."""
    subjects: tuple[str, ...]
    """Whom each shows; the clip's own name where the experiment does not say."""
    alone: tuple[Found, ...]
    pooled: Found
    others: tuple[Found, ...]
    """All clips but each, pooled."""
    fit: PopulationFit
    parameters: list[ParameterEstimates]
    errors: list[ClipErrors]

    @property
    def converged(self) -> bool:
        """Whether all searches and the fit of the population have."""
        return not self.unconverged

    @property
    def unconverged(self) -> list[str]:
        """What has not converged, in a sentence each."""
        searches = (*self.alone, self.pooled, *self.others)
        lines = [f"{one['name']}: {one['message']}" for one in searches if not one["converged"]]
        if not self.fit.converged:
            lines.append(f"population: not converged after {self.fit.rounds} rounds")
        return lines

    @property
    def leg_length(self) -> float | None:
        """Leg length, m, of the body that the values are for; None if they fit any body."""
        return self.experiment.leg_length(self.problem.data[0].rig)

    @property
    def summary(self) -> PopulationSummary:
        """The numbers as JSON holds them."""
        return {
            "experiment": self.experiment.name,
            "clips": list(self.clips),
            "subjects": list(self.subjects),
            "converged": self.converged,
            "message": " ".join(self.unconverged),
            "leg_length": self.leg_length,
            "parameters": self.parameters,
            "errors": [dataclasses.asdict(row) for row in self.errors],
        }


def clip_names(entries: Sequence[ClipEntry]) -> tuple[str, ...]:
    """A name for each clip: that of its file, and where a file has several, which part of it."""
    stems = [entry.reference.stem for entry in entries]
    counts = Counter(stems)
    names = [
        f"{stem} from {entry.start:g} s" if counts[stem] > 1 else stem
        for stem, entry in zip(stems, entries, strict=True)
    ]
    counts = Counter(names)
    return tuple(
        f"{name} ({number})" if counts[name] > 1 else name for number, name in enumerate(names, 1)
    )


@in_float64
def fit_clips_and_population(
    experiment: Experiment,
    problem: Problem[jaxik.FootIK],
    folder: Path | None = None,
    progress: Callable[[Progress], None] | None = None,
    on_found: Callable[[Found], object] = lambda found: None,
) -> Population:
    """Fits each clip alone, all pooled, the population, and all without each clip in turn.

    Noise that the experiment estimates is estimated in each clip alone, where no difference between
    clips counts as noise, and is taken from there.

    Args:
        experiment: with parameters that vary between clips or subjects.
        problem: of the experiment.
        folder: where finished searches are kept; what it has is not repeated. None keeps none.
        progress: called as a search goes on; its stage names what is fitted.
        on_found: called with each new search.

    Raises:
        KeyboardInterrupt: it was interrupted; finished searches are in the folder.
        ValueError: nothing varies, or a threshold does; the folder holds something else.
    """
    if not experiment.hierarchy.varying:
        raise ValueError(
            f"{experiment.path}: nothing varies between the clips; name free parameters in the "
            "table [hierarchy], as per_clip or as per_subject"
        )
    clips, names = clip_names(experiment.clips), problem.space.names
    subjects = tuple(
        entry.subject or clip for entry, clip in zip(experiment.clips, clips, strict=True)
    )
    grouping = experiment.hierarchy.grouping(names, clips, subjects)
    check_thresholds(problem.space, grouping)
    searches = KeptSearches(experiment, folder, progress, on_found)
    problems, alone = [], []
    for name, scene in zip(clips, problem.data, strict=True):
        single = eqx.tree_at(lambda p: p.data, problem, (scene,))
        single, found = searches.fit(name, single, with_its_noise=True)
        problems.append(single)
        alone.append(found)
    pooled_problem = _joined(problem, problems)
    _, pooled = searches.fit(EVERYTHING, pooled_problem)
    alone_u, pooled_u = np.array([found["u"] for found in alone]), np.array(pooled["u"])
    rounds = _Rounds(progress)
    starts = [np.tile(pooled_u, (len(clips), 1)), alone_u]
    with activity.announced("Fitting the population"):
        fit = fit_population(problems, grouping, starts, rounds.of("population"))
    errors, others = [], []
    for c, name in enumerate(clips):
        rest = f"{EVERYTHING} but {name}"
        others.append(searches.fit(rest, without_clip(pooled_problem, c))[1])
        others_u = np.array(others[c]["u"])
        with activity.announced(f"Predicting {name} from the others"):
            expected = predict(
                problems, grouping, fit, others_u, c, rounds.of(f"{rest}, population")
            )
            points = (alone_u[c], pooled_u, fit.clips[c], others_u, expected)
            errors.append(ClipErrors(name, *(error_at(problems[c], u) for u in points)))
    levels = [experiment.hierarchy.level(name) for name in names]
    return Population(
        experiment=experiment,
        problem=problem,
        clips=clips,
        subjects=subjects,
        alone=tuple(alone),
        pooled=pooled,
        others=tuple(others),
        fit=fit,
        parameters=summarise(problems, alone_u, pooled_u, fit, levels),
        errors=errors,
    )


def _joined(
    problem: Problem[jaxik.FootIK], problems: Sequence[Problem[jaxik.FootIK]]
) -> Problem[jaxik.FootIK]:
    """The problem of all clips, each with its own sigmas and correlations.

    What only a whole problem has, the independent fraction and Student's tails, is their mean.
    """
    fraction = jnp.mean(jnp.stack([single.weight for single in problems]))
    tails = jnp.mean(jnp.stack([single.tails for single in problems]))
    scenes = tuple(scene for single in problems for scene in single.data)
    return eqx.tree_at(lambda p: (p.data, p.weight, p.tails), problem, (scenes, fraction, tails))


@dataclasses.dataclass(frozen=True)
class _Rounds:
    """Reports the rounds of a population's fit as a search does its steps."""

    progress: Callable[[Progress], None] | None
    began: float = dataclasses.field(default_factory=time.perf_counter)

    def of(self, name: str) -> Callable[[int, float], None]:
        """What to call after each round."""

        def report(rounds: int, cost: float) -> None:
            if self.progress is not None:
                elapsed = time.perf_counter() - self.began
                self.progress(Progress(name, 0, rounds, cost, cost, elapsed))

        return report
