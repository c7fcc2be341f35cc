"""An experiment's clips fitted each alone, all pooled, and as a population, and what they show.

Where they show two or more subjects, each subject is also measured with parameters that were fitted
on others, or on its own other clips.

Each search has a file whose name is a digest of its problem, settings and seed. An interrupted
study that is called again reads the finished searches, and continues the one that was running
after its last stage.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, TypeAlias, TypedDict

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import jaxik
from fitting.experiment import file_tables, parameter_files
from fitting.experiment.experiment import Experiment
from fitting.experiment.experiment_files import experiment_to_toml
from fitting.experiment.in_memory import with_files
from fitting.experiment.problems import load_clip_data, make_problem
from fitting.experiment.systems import Preset
from fitting.inference.mixed_model import (
    Draws,
    Grouping,
    PopulationFit,
    check_thresholds,
    expand,
    fit_population,
    model_around,
    smooth_model,
)
from fitting.inference.noise import NoiseModel, NoiseOptions, with_noise
from fitting.inference.optimise.checkpoints import Checkpoints
from fitting.motion import accuracy
from fitting.motion.accuracy import ACCURACY, IN_BRIEF, Accuracy, position_error
from fitting.problem.problem import Problem, digest, digest_with
from fitting.problem.space import INTERVAL, Space
from fitting.report import pages, style
from fitting.report.document import (
    Block,
    Document,
    Finding,
    Grid,
    Plot,
    Points,
    Section,
    Terms,
    Text,
)
from fitting.report.formatting import Table, counted, interval, listed, meanings, number
from fitting.report.style import AFTER, BEFORE, CAPTURED, PRIOR, STAGES
from fitting.runtime import activity, files
from fitting.runtime.json_files import Finite, JsonFile, Store
from fitting.runtime.precision import in_float64
from fitting.runtime.validation import Content
from jaxik.maths import parameter_tree

from .animations import capture_errors
from .campaign import Campaign, clip_names
from .fit import run_folder
from .fit.assess import search_identity, search_with_noise
from .fit.fit import SearchRecord, record_search
from .output import as_experiment, output_folder, publish

SEARCHES, FITS = "searches", "fits"
DRAWS = 2000  # from the hierarchy
NORMAL = 1.96  # standard deviations in half a 95 % interval
EVERYTHING = "all clips"

NUMBERS, SUMMARY, FIGURE = "population.json", "summary.md", "population.png"
FEW = 5  # clips or subjects, from which little is known of a spread
PARAMETERS = (
    "Intervals are those of 95 %. **Fitted alone** is a fit of one clip, and **pooled** one of all "
    "clips with the same values. In the population, what varies is normal around the centre, in "
    "`u`, the coordinate of the prior; the spread is its standard deviation there. What a clip "
    "leaves open comes from the others."
)
ERRORS = (
    "Distance of pelvis, knees and ankles from the captured ones, rms over joints and frames. "
    "**Left out** is the error of a clip that had no part in the fit: with the values pooled over "
    "the others, and with those that the population of the others expects of it."
)

CROSSED = (
    "A subject's clips with parameters that were fitted, pooled, on clips of which none is the one "
    "that is measured; **nothing** is the system of the experiment as it comes. Measured at the "
    "rate of the clips."
)
NOTHING, OWN, OTHERS, ALL = (
    "nothing", "the subject's other clips", "other subjects", "all other clips"
)  # fmt: skip

ERROR_NAMES = {
    "alone": "fitted alone",
    "pooled": "pooled",
    "population": "population",
    "left_out_pooled": "left out, pooled",
    "left_out_population": "left out, population",
}
CM = 100.0  # in a metre
MINUTE = 60.0  # s
Clips: TypeAlias = frozenset[int]

APART = 0.16  # of a row, from its middle to an estimate
COLOURS = dict(zip(ERROR_NAMES, (BEFORE, CAPTURED, AFTER, STAGES[1], STAGES[4]), strict=True))
PANELS_PER_ROW = 3


class SearchResult(SearchRecord):
    """The result of a search, as its file holds it."""

    name: str
    """What was fitted."""
    u: list[Finite]


RESULT_FILE = JsonFile(
    SearchResult, "written by `jaxik population`", "delete it, and its search is made anew"
)


class SearchTask(NamedTuple):
    """A search with the settings of an experiment."""

    name: str
    """What is fitted, in words."""
    problem: Problem[jaxik.FootIK]
    experiment: Experiment
    key: str
    """A digest of everything that its result follows from."""


def _task(name: str, problem: Problem[jaxik.FootIK], experiment: Experiment) -> SearchTask:
    return SearchTask(name, problem, experiment, search_identity(problem, experiment)[:16])


def _search_all(title: str, tasks: Sequence[SearchTask], folder: Path | None) -> list[SearchResult]:
    """The results of searches, those that are stored and new ones, which are stored.

    Raises:
        KeyboardInterrupt: a search was interrupted; it goes on when it is called again.
        ValueError: a file in the folder is something else.
    """
    folder = None if folder is None else folder / SEARCHES
    store = search_store(folder, tasks[0].problem.space.size)

    def checkpoints(task: SearchTask) -> Checkpoints:
        return Checkpoints(folder, f"{task.key}.part", task.key)

    def search(task: SearchTask) -> SearchResult:
        with checkpoints(task):
            return _search(task)

    def read(task: SearchTask) -> SearchResult | None:
        if (result := store.read(f"{task.key}.json")) is not None:
            checkpoints(task).remove()
        return result

    def write(task: SearchTask, result: SearchResult) -> None:
        store.write(f"{task.key}.json", result)
        checkpoints(task).remove()

    return Campaign(title, tasks, search, read, write, result_line, lambda task: task.name).run()


def _search(task: SearchTask) -> SearchResult:
    with activity.announced(f"Fitting {task.name}"):
        fitted, solution = search_with_noise(task.problem, task.experiment)
    if solution.interrupted:
        raise KeyboardInterrupt
    record = record_search(task.experiment, fitted, solution)
    return {"name": task.name, "u": solution.u.tolist(), **record}


def result_line(result: SearchResult) -> str:
    """A finished search in one line, for the terminal."""
    return f"{result['name']}: cost {number(result['cost'])}, {result['seconds']:.1f} s"


def search_store(folder: Path | None, size: int) -> Store[SearchResult]:
    """The results of searches, each of which has `size` parameters."""

    def check(result: SearchResult) -> None:
        if len(result["u"]) != size:
            raise ValueError(
                f"u has {len(result['u'])} numbers; wanted {size}, one of each parameter"
            )
        if "noise" in result:
            NoiseModel(**result["noise"])  # checks its numbers

    return Store(RESULT_FILE, folder, check=check)


class FitResult(TypedDict):
    """The fit of a population, as its file holds it; `PopulationFit` explains the entries."""

    centre: list[Finite]
    clips: list[list[Finite]]
    spread: list[Finite]
    information: list[list[list[Finite]]]
    """Of the mixed model, like the vector."""
    vector: list[list[Finite]]
    cost: Finite
    log_probability: Finite
    rounds: int
    converged: bool


FIT_FILE = JsonFile(FitResult, "written by `jaxik population`", "delete it, and it is made anew")


def fit_or_recall(
    problems: Sequence[Problem[jaxik.FootIK]],
    grouping: Grouping,
    starts: Sequence[Float[np.ndarray, "clips free"]],
    folder: Path | None,
) -> PopulationFit:
    """The result of `fit_population`, the stored one or a new one, which is stored.

    Raises:
        ValueError: a file in the folder is something else.
    """
    space, count = problems[0].space, len(problems)
    size, smooth = space.size, sum(space.smooth)
    shapes = {
        "centre": (size,),
        "clips": (count, size),
        "spread": (size,),
        "information": (count, smooth, smooth),
        "vector": (count, smooth),
    }

    def check(result: FitResult) -> None:
        for name, shape in shapes.items():
            if (stored := np.shape(result[name])) != shape:
                raise ValueError(f"{name} has shape {stored}; wanted {shape}")

    def fit() -> FitResult:
        fitted = fit_population(problems, grouping, starts)
        return {
            "centre": fitted.centre.tolist(),
            "clips": fitted.clips.tolist(),
            "spread": fitted.spread.tolist(),
            "information": fitted.model.information.tolist(),
            "vector": fitted.model.vector.tolist(),
            "cost": fitted.cost,
            "log_probability": fitted.log_probability,
            "rounds": fitted.rounds,
            "converged": fitted.converged,
        }

    begins = [np.asarray(start).tolist() for start in starts]
    key = digest_with(problems[0], list(map(digest, problems)), grouping.group.tolist(), begins)
    store = Store(FIT_FILE, None if folder is None else folder / FITS, check=check)
    result = store.remember(f"{key[:16]}.json", fit)
    arrays = {name: np.array(result[name], float) for name in shapes}
    information, vector = arrays.pop("information"), arrays.pop("vector")
    return PopulationFit(
        **arrays,
        model=smooth_model(information, vector, space, grouping, arrays["centre"]),
        smooth=np.asarray(space.smooth),
        cost=result["cost"],
        log_probability=result["log_probability"],
        rounds=result["rounds"],
        converged=result["converged"],
    )


class Estimate(TypedDict):
    """A value with its 95 % interval; a threshold has none."""

    value: float
    interval: list[float] | None


class ParameterEstimates(TypedDict):
    """The estimates of a parameter, in its unit, as `population.json` holds them."""

    name: str
    unit: str
    level: str
    """What has a value of its own: `clip` or `subject`; else it is `shared`."""
    alone: list[Estimate]
    """One for each clip, fitted by itself."""
    pooled: Estimate
    """One value for all clips together."""
    clips: list[Estimate]
    """One for each clip, in the population."""
    centre: Estimate
    """The centre of the population."""
    spread: Estimate | None
    """Standard deviation of u in the population; None where shared."""
    range: list[float] | None
    """The central 95 % of further clips or subjects; None where shared."""


@in_float64
def summarise(
    problems: Sequence[Problem],
    alone: Float[np.ndarray, "clips free"],
    pooled: Float[np.ndarray, " free"],
    fit: PopulationFit,
    levels: Sequence[str],
) -> list[ParameterEstimates]:
    """The estimates of all parameters, in the order of `u`.

    Problems are of one clip each; `alone` and `pooled` are best fits, in u; `levels` says at which
    each parameter varies.
    """
    space = problems[0].space
    of_clips = [_laplace([problem], u[None]) for problem, u in zip(problems, alone, strict=True)]
    of_pooled = _laplace(problems, np.tile(pooled, (len(problems), 1)))
    random = np.random.default_rng(0)
    draws = fit.model.draw(random, DRAWS)
    new = draws.centre + draws.spread * random.normal(size=draws.centre.shape)
    centres = _quantiles(space, fit, draws.centre)
    expected = _quantiles(space, fit, new)
    members = [_quantiles(space, fit, draws.clips[:, c]) for c in range(len(problems))]
    at_centre, at_clips = _values(space, fit.centre[None])[0], _values(space, fit.clips)
    units = parameter_tree.declarations(space.system)
    rows: list[ParameterEstimates] = []
    for k, parameter in enumerate(space.parameters):
        smooth = bool(fit.smooth[k])

        def estimate(value: float, interval: np.ndarray, smooth: bool = smooth) -> Estimate:
            return {"value": float(value), "interval": interval.tolist() if smooth else None}

        varies = levels[k] != "shared"
        rows.append(
            {
                "name": parameter.name,
                "unit": units[parameter.leaf].unit,
                "level": levels[k],
                "alone": [estimate(value[k], interval[k]) for value, interval in of_clips],
                "pooled": estimate(of_pooled[0][k], of_pooled[1][k]),
                "clips": [
                    estimate(at_clips[c, k], interval[k]) for c, interval in enumerate(members)
                ],
                "centre": estimate(at_centre[k], centres[k]),
                "spread": _spread(fit, draws, k) if varies else None,
                "range": expected[k].tolist() if varies else None,
            }
        )
    return rows


def _spread(fit: PopulationFit, draws: Draws, k: int) -> Estimate:
    density = draws.spread_density[np.flatnonzero(fit.smooth).tolist().index(k)]
    return {"value": float(fit.spread[k]), "interval": list(density.interval())}


def _laplace(
    problems: Sequence[Problem], u: Float[np.ndarray, "clips free"]
) -> tuple[np.ndarray, np.ndarray]:
    """Values (free,) and 95 % intervals (free, 2) of clips that share everything."""
    space = problems[0].space
    grouping = Grouping.pooled(*u.shape)
    model = model_around(expand(problems, u), space, grouping, u[0])
    smooth = np.flatnonzero(space.smooth)
    estimate = model.estimate(np.zeros(len(smooth)))
    moves = np.zeros((space.size, space.size))
    moves[smooth, smooth] = NORMAL * estimate.centre_sd
    values = _values(space, np.concatenate([u[:1], u[0] - moves, u[0] + moves]))
    low, high = np.split(values[1:], 2)
    return values[0], np.stack([np.diag(low), np.diag(high)], axis=1)


def _quantiles(
    space: Space, fit: PopulationFit, draws: Float[np.ndarray, "draws smooth"]
) -> Float[np.ndarray, "free 2"]:
    """Central 95 % of draws of the smooth parameters, in the parameters' units."""
    u = np.tile(fit.centre, (len(draws), 1))
    u[:, fit.smooth] = draws
    return np.quantile(_values(space, u), INTERVAL, axis=0).T


def _values(space: Space, u: Float[np.ndarray, "rows free"]) -> Float[np.ndarray, "rows free"]:
    return np.asarray(space.values(u))


@dataclasses.dataclass(frozen=True)
class ClipErrors:
    """Distance of a clip's joints from the captured ones, m, rms; see `position_error`."""

    clip: str
    alone: float
    """Fitted to this clip."""
    pooled: float
    """Fitted to all clips with one value of each parameter."""
    population: float
    """With the clip's own parameters in the population."""
    left_out_pooled: float
    """Fitted to all other clips."""
    left_out_population: float
    """As expected from the population of all others, and of the clip's subject if they show it."""


def with_clips(problem: Problem[jaxik.FootIK], clips: Clips) -> Problem[jaxik.FootIK]:
    """The problem in which only these clips count: no frame of another one was observed.

    The others are still played, so that the whole problem's programs can be used.
    """
    for c, scene in enumerate(problem.data):
        if c not in clips:
            none = jnp.zeros_like(scene.reference.observed)
            problem = eqx.tree_at(lambda p, c=c: p.data[c].reference.observed, problem, none)
    return problem


class Crossing(NamedTuple):
    """The clips of a subject, and on which clips the parameters of each are fitted."""

    subject: str
    fitted_on: str
    """In words."""
    fits: dict[int, Clips]
    """Fitted clips by measured one; none of them leaves the system as it comes."""


def crossings(subjects: Sequence[str]) -> list[Crossing]:
    """What is fitted on and measured; nothing where there is only one subject.

    A subject with a single clip has no other ones, and all other clips are those of the others.
    """
    everybody = frozenset(range(len(subjects)))
    crossed = []
    for subject in dict.fromkeys(subjects):
        own = frozenset(c for c in everybody if subjects[c] == subject)
        rows = {NOTHING: dict.fromkeys(sorted(own), Clips())}
        if len(own) > 1:
            rows[OWN] = {c: own - {c} for c in sorted(own)}
        rows[OTHERS] = dict.fromkeys(sorted(own), everybody - own)
        if len(own) > 1:
            rows[ALL] = {c: everybody - {c} for c in sorted(own)}
        crossed += [Crossing(subject, words, fits) for words, fits in rows.items()]
    return crossed if own != everybody else []


@dataclasses.dataclass(frozen=True)
class CrossedErrors:
    """How far the clips of a subject are from the capture with parameters of others."""

    subject: str
    fitted_on: str
    """In words."""
    accuracy: Accuracy


def measure_crossings(
    experiment: Experiment,
    space: Space[jaxik.FootIK],
    crossed: Sequence[Crossing],
    fits: Mapping[Clips, SearchResult],
) -> list[CrossedErrors]:
    """The errors of each row, at the clips' own rate, with these fits of sets of clips.

    Raises:
        ValueError: as `capture_errors`.
    """
    if not crossed:
        return []
    with activity.announced("Reading the clips at their own rate"):
        data = [load_clip_data(entry, None) for entry in experiment.placed_clips()]
    sizes = [experiment.size(clip.base.rig, data[0].base.rig) for clip in data]
    rows = []
    with activity.announced("Measuring subjects with what others gave", len(crossed)) as measuring:
        for subject, fitted_on, of_clips in crossed:
            errors = []
            for c, fitted in of_clips.items():
                u = jnp.asarray(fits[fitted]["u"]) if fitted else None
                ik = space.system if u is None else space.unpack(u)
                errors.append(capture_errors(ik, data[c], sizes[c]))
            rows.append(CrossedErrors(subject, fitted_on, accuracy.summarise(errors)))
            measuring.advance()
    return rows


def predict(
    problems: Sequence[Problem[jaxik.FootIK]],
    grouping: Grouping,
    fit: PopulationFit,
    pooled: Float[np.ndarray, " free"],
    clip: int,
    folder: Path | None = None,
) -> Float[np.ndarray, " free"]:
    """The parameters of a clip, in u, as the population of the others expects them.

    The search begins at `fit`, of all clips, and at `pooled`, the best fit of all but this one, in
    u.
    """
    rest = [problem for c, problem in enumerate(problems) if c != clip]
    starts = [np.tile(pooled, (len(rest), 1)), np.delete(fit.clips, clip, axis=0)]
    others = fit_or_recall(rest, grouping.without(clip), starts, folder)
    return others.predict(grouping, clip)


def error_at(problem: Problem[jaxik.FootIK], u: Float[np.ndarray, " free"]) -> float:
    """The error of a problem's only clip with these parameters, m."""
    (scene,) = problem.data
    return position_error(problem.space.unpack(jnp.asarray(u)), scene)


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
    crossed: list[Content]
    """The rows of `CrossedErrors`."""


@dataclasses.dataclass(frozen=True)
class Population:
    """The clips of an experiment, fitted each alone, pooled, and as a population."""

    experiment: Experiment
    problem: Problem[jaxik.FootIK]
    """Of all clips."""
    clips: tuple[str, ...]
    """A name for each."""
    subjects: tuple[str, ...]
    """The subject of each; the clip's own name where the experiment names none."""
    searches: tuple[SearchResult, ...]
    """Of each clip alone, then of all and of some, pooled."""
    fit: PopulationFit
    parameters: list[ParameterEstimates]
    errors: list[ClipErrors]
    crossed: list[CrossedErrors]

    @property
    def converged(self) -> bool:
        """Whether all searches and the fit of the population have converged."""
        return not self.unconverged

    @property
    def unconverged(self) -> list[str]:
        """What has not converged, in a sentence each."""
        lines = [f"{of['name']}: {of['message']}" for of in self.searches if not of["converged"]]
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
            "crossed": [
                {"subject": row.subject, "fitted_on": row.fitted_on, **row.accuracy.numbers()}
                for row in self.crossed
            ],
        }


@in_float64
def fit_clips_and_population(
    experiment: Experiment,
    problem: Problem[jaxik.FootIK],
    folder: Path | None = None,
) -> Population:
    """Fits each clip alone, all pooled, the population, and all without each clip in turn.

    Where there are several subjects, it also fits what `crossings` names.

    Noise that the experiment estimates is estimated in each clip alone, where no difference between
    clips counts as noise, and is taken from there.

    Raises:
        KeyboardInterrupt: it was interrupted; finished searches and fits are in the folder.
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
    singles = [eqx.tree_at(lambda p: p.data, problem, (scene,)) for scene in problem.data]
    tasks = [_task(*pair, experiment) for pair in zip(clips, singles, strict=True)]
    alone = _search_all(f"Fitting {len(clips)} clips, each alone", tasks, folder)
    problems = [
        with_noise(single, NoiseModel(**result["noise"])) if "noise" in result else single
        for single, result in zip(singles, alone, strict=True)
    ]
    whole = _joined(problem, problems)
    known = dataclasses.replace(experiment, noise=NoiseOptions(correlation="given"))
    everything, crossed = Clips(range(len(clips))), crossings(subjects)
    fits = {Clips([c]): result for c, result in enumerate(alone)}
    sets = {everything: EVERYTHING}
    sets |= {everything - {c}: f"{EVERYTHING} but {name}" for c, name in enumerate(clips)}
    for subject, fitted_on, of_clips in crossed:
        for c, fitted in of_clips.items():
            which = f"of {subject} but {clips[c]}" if fitted_on == OWN else f"but {subject}'s"
            sets.setdefault(fitted, f"{EVERYTHING} {which}")
    sets = {fitted: name for fitted, name in sets.items() if fitted and fitted not in fits}
    tasks = [_task(name, with_clips(whole, fitted), known) for fitted, name in sets.items()]
    pooled = _search_all("Fitting all clips, and some of them", tasks, folder)
    fits |= zip(sets, pooled, strict=True)
    alone_u, pooled_u = (
        np.array([result["u"] for result in alone]),
        np.array(fits[everything]["u"]),
    )
    starts = [np.tile(pooled_u, (len(clips), 1)), alone_u]
    with activity.announced("Fitting the population"):
        fit = fit_or_recall(problems, grouping, starts, folder)
    errors = []
    for c, name in enumerate(clips):
        others_u = np.array(fits[everything - {c}]["u"])
        with activity.announced(f"Predicting {name} from the others"):
            expected = predict(problems, grouping, fit, others_u, c, folder)
            points = (alone_u[c], pooled_u, fit.clips[c], others_u, expected)
            errors.append(ClipErrors(name, *(error_at(problems[c], u) for u in points)))
    levels = [experiment.hierarchy.level(name) for name in names]
    return Population(
        experiment=experiment,
        problem=problem,
        clips=clips,
        subjects=subjects,
        searches=tuple(fits.values()),
        fit=fit,
        parameters=summarise(problems, alone_u, pooled_u, fit, levels),
        errors=errors,
        crossed=measure_crossings(experiment, problem.space, crossed, fits),
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


def document(population: Population) -> Document:
    """What a population says."""
    count = len(population.unconverged)
    title = f"{population.experiment.name}: clips and their population"
    return Document(
        file=SUMMARY,
        kind="Clips fitted alone, pooled and as a population",
        title=population.experiment.name,
        verdict="Converged" if population.converged else f"{count} not converged",
        good=population.converged,
        findings=findings(population),
        sections=[
            Section(
                "Parameters",
                [
                    Grid(parameter_table(population), "Parameters of clips and population"),
                    Text(PARAMETERS),
                    Plot(FIGURE, title, lambda: overview(population, title)),
                ],
            ),
            Section("Errors", [Grid(error_table(population), "Errors"), Text(ERRORS)]),
            Section("Subjects crossed", _crossed(population)),
            Section("Searches", [Grid(search_table(population), "Searches", brief=False)]),
            Section("In detail", [Points(remarks(population), brief=True)]),
            _limits(population),
        ],
        setup=[*pages.rows(population.experiment), ["What varies", _varying(population)]],
        numbers={NUMBERS: population.summary},
        files={run_folder.PARAMETERS: "the population's centre"},
    )


def remarks(population: Population) -> list[str]:
    """What the findings leave out, a sentence each."""
    lines = [f"**Not converged**: {line}" for line in population.unconverged]
    lines += [
        _difference(population, row) for row in population.parameters if row["spread"] is not None
    ]
    if (leg_length := population.leg_length) is not None:
        lines.append(
            f"Values are those of a body with legs of {number(leg_length)} m; those of each clip's "
            "body are dynamically similar."
        )
    return lines


def _difference(population: Population, row: ParameterEstimates) -> str:
    """Whether clips or subjects differ in a parameter."""
    spread, members = row["spread"], f"{row['level']}s"
    assert spread is not None and spread["interval"] is not None  # of a parameter that varies
    low, high = spread["interval"]
    size = f"spread {number(spread['value'])}"
    count = len(set(population.subjects if row["level"] == "subject" else population.clips))
    few = f", from {count} {members} only" if count < FEW else ""
    if low > 0:
        words = f"differs between {members}: {size} ({interval(low, high)})"
    elif spread["value"] > 0:
        words = f"may differ between {members}: {size}, at most {high:.4g}"
    else:
        words = f"is alike in all {members} as far as they tell: spread at most {high:.4g}"
    return f"`{row['name']}` {words}{few}."


def parameter_table(population: Population) -> Table:
    """For each parameter a row per clip, one for all pooled, and one to three for the population.

    What clips share has its value in the population's row only.
    """
    table = [["parameter", "", "fitted alone", "in the population"]]
    for row in population.parameters:
        varies = row["spread"] is not None
        lines = [
            [clip_label(population, c), cell(alone), cell(within) if varies else ""]
            for c, (alone, within) in enumerate(zip(row["alone"], row["clips"], strict=True))
        ]
        lines += [["pooled", cell(row["pooled"]), ""], ["population", "", cell(row["centre"])]]
        if row["spread"] is not None and row["range"] is not None:
            lines.append(["spread, of u", "", cell(row["spread"])])
            lines.append([f"95 % of {row['level']}s", "", interval(*row["range"])])
        heading = f"`{row['name']}`, {_unit(row)}{_level(row)}"
        table += [[heading, *lines[0]], *(["", *line] for line in lines[1:])]
    return table


def error_table(population: Population) -> Table:
    """A row for each clip, and one for all; rms distances in cm."""
    table = [["error, cm", *ERROR_NAMES.values()]]
    for row in population.errors:
        table.append([row.clip, *(f"{CM * getattr(row, key):.2f}" for key in ERROR_NAMES)])
    table.append(["all", *(f"{CM * mean_error(population, key):.2f}" for key in ERROR_NAMES)])
    return table


def _crossed(population: Population) -> list[Block]:
    """Nothing where there is one subject."""
    if not population.crossed:
        return []
    table = Grid(crossed_table(population), "Errors of subjects with parameters of others")
    meaning = Terms(meanings({key: ACCURACY[key] for key in IN_BRIEF}))
    return [table, Text(CROSSED), meaning]


def crossed_table(population: Population) -> Table:
    """A row for each subject and what its parameters were fitted on."""
    table = [["subject", "fitted on", *(ACCURACY[key].title for key in IN_BRIEF)]]
    for row in population.crossed:
        figures = (row.accuracy.text(key) for key in IN_BRIEF)
        table.append([row.subject, row.fitted_on, *figures])
    return table


def search_table(population: Population) -> Table:
    """A row for each search."""
    table = [["fitted", "cost", "starts that agree", "minutes"]]
    for of in population.searches:
        agreeing = f"{of['agreeing']} of {of['starts']}"
        table.append([of["name"], number(of["cost"]), agreeing, f"{of['seconds'] / MINUTE:.1f}"])
    return table


def mean_error(population: Population, key: str) -> float:
    """Root mean square over the clips of one column of the errors, m."""
    squares = [getattr(row, key) ** 2 for row in population.errors]
    return math.sqrt(sum(squares) / len(squares))


def clip_label(population: Population, clip: int) -> str:
    """A clip's name, with its subject if the experiment names that."""
    name, subject = population.clips[clip], population.experiment.clips[clip].subject
    return name if subject is None else f"{name} ({subject})"


def cell(estimate: Estimate) -> str:
    """A value with its interval in brackets."""
    ends = estimate["interval"]
    return number(estimate["value"]) + ("" if ends is None else f" ({interval(*ends)})")


def _unit(row: ParameterEstimates) -> str:
    return "" if row["unit"] == "1" else f"{row['unit']}, "


def _level(row: ParameterEstimates) -> str:
    return row["level"] if row["level"] == "shared" else f"per {row['level']}"


@style.styled
def overview(population: Population, title: str) -> Figure:
    """A panel for each parameter that varies, and one with the errors of all clips."""
    varying = [row for row in population.parameters if row["spread"] is not None]
    labels = [clip_label(population, c) for c in range(len(population.clips))]
    columns = min(PANELS_PER_ROW, len(varying) + 1)
    height, width = 0.45 * len(labels) + 1.6, 5.6 * columns
    count = len(varying) + 1
    figure, grid = style.panels(count, columns, title, height, 1.6, width=width, sharey=True)
    for axes, row in zip(grid, varying, strict=False):
        _estimates(axes, row)
    _errors(grid[-1], population)
    for axes in grid[::columns]:
        style.name_rows(axes, labels)
    style.legend(
        figure,
        style.line_key("fitted alone, 95 %", BEFORE, marker="o"),
        style.line_key("in the population, 95 %", AFTER, marker="o"),
        style.line_key("centre of the population", PRIOR),
        style.area_key("95 % of clips or subjects", PRIOR, alpha=0.15),
        style.line_key("pooled", CAPTURED, linestyle="--"),
        *(
            style.line_key(f"error, {words}", COLOURS[key], marker="D", linestyle="")
            for key, words in ERROR_NAMES.items()
        ),
        columns=5,
    )
    return figure


def _estimates(axes: Axes, row: ParameterEstimates) -> None:
    """One parameter: each clip alone and in the population."""
    assert row["range"] is not None  # of a parameter that varies
    axes.axvspan(*row["range"], color=PRIOR, alpha=0.15, linewidth=0)
    axes.axvline(row["centre"]["value"], color=PRIOR)
    axes.axvline(row["pooled"]["value"], color=CAPTURED, linestyle="--")
    for c, (alone, within) in enumerate(zip(row["alone"], row["clips"], strict=True)):
        _bar(axes, c - APART, alone, BEFORE)
        _bar(axes, c + APART, within, AFTER)
    axes.set_title(row["name"])
    axes.set_xlabel("" if row["unit"] == "1" else row["unit"])


def _bar(axes: Axes, place: float, estimate: Estimate, colour: str) -> None:
    axes.plot([estimate["value"]], [place], "o", color=colour, markersize=6)
    if estimate["interval"] is not None:
        axes.plot(estimate["interval"], [place, place], color=colour)


def _errors(axes: Axes, population: Population) -> None:
    """Errors of all clips."""
    for c, row in enumerate(population.errors):
        for place, key in zip(np.linspace(-0.24, 0.24, len(ERROR_NAMES)), ERROR_NAMES, strict=True):
            axes.plot([CM * getattr(row, key)], [c + place], "D", color=COLOURS[key], markersize=6)
    axes.set_xlim(left=0.0)
    axes.set_title("Error")
    axes.set_xlabel("cm, rms")


def findings(population: Population) -> list[Finding]:
    """Whether all converged, what differs, and whether clips are predicted from each other."""
    return [_convergence(population), _differences(population), _prediction(population)]


def _convergence(population: Population) -> Finding:
    lines = population.unconverged
    if lines:
        return Finding(
            f"{len(lines)} of the searches did not converge, so that differences may be those of "
            f"the search: {listed(lines).rstrip('.')}.",
            bad=True,
        )
    count = len(population.searches)
    return Finding(f"All {count} searches and the fit of the population converged.")


def _differences(population: Population) -> Finding:
    clear, open_, alike = [], [], []
    for row in population.parameters:
        spread = row["spread"]
        if spread is None or spread["interval"] is None:
            continue
        differs = spread["interval"][0] > 0
        group = clear if differs else open_ if spread["value"] > 0 else alike
        group.append(f"`{row['name']}`")
    parts = [
        f"{listed(clear)} {_verb(clear, 'differs', 'differ')} between them" if clear else "",
        f"{listed(open_)} may differ" if open_ else "",
        f"{listed(alike)} {_verb(alike, 'is', 'are')} alike as far as they tell" if alike else "",
    ]
    subjects = counted(len(set(population.subjects)), "subject")
    who = f"{len(population.clips)} clips of {subjects}"
    few = len(population.clips) < FEW
    return Finding(
        f"Of {who}{', too few to say much of spreads' if few else ''}: "
        f"{'; '.join(filter(None, parts))}.",
        bad=few,
    )


def _verb(names: list[str], singular: str, plural: str) -> str:
    return singular if len(names) == 1 else plural


def _prediction(population: Population) -> Finding:
    by_population, by_pooled, alone = (
        mean_error(population, key) for key in ("left_out_population", "left_out_pooled", "alone")
    )
    text = (
        f"A clip that is left out is predicted to {CM * by_population:.2f} cm by the population of "
        f"the others and to {CM * by_pooled:.2f} cm by their pooled fit; fitted alone, "
        f"{CM * alone:.2f} cm are left"
    )
    if by_population > by_pooled:
        return Finding(f"The population predicts worse than one fit to all clips: {text}.", True)
    return Finding(f"{text}.")


def _varying(population: Population) -> str:
    rows = [row for row in population.parameters if row["level"] != "shared"]
    return ", ".join(f"`{row['name']}` per {row['level']}" for row in rows)


def _limits(population: Population) -> Section:
    lines = [
        "Spreads are of these clips and subjects; how far others differ follows only if they were "
        "chosen as these were.",
    ]
    if len(population.clips) < FEW:
        lines.append(f"There are {len(population.clips)} clips: a spread is hardly known.")
    return Section("Limits of the data", [Points(lines)])


@in_float64
def population(
    experiment: Experiment | str | Path,
    output: str | Path | None = None,
) -> Population:
    """Fits the clips of an experiment each alone, all pooled, and as a population.

    What varies between clips or subjects stands in the experiment's table [hierarchy]. Each clip is
    also predicted from the others, and each subject measured with parameters that were fitted on
    others. Each finished search is written at once, and a call with the same folder continues where
    an interrupted one ended.

    Args:
        experiment: an experiment, or the path of its file.
        output: folder for the searches and the report.

    Raises:
        ValueError: the experiment is wrong, fits a capture, too, nothing in it varies, or a
            threshold does; it does not fit its clips; the folder cannot be made or holds something
            else.
    """
    experiment = as_experiment(experiment)
    file_tables.refuse(experiment.capture, str(experiment.path), "population")
    with output_folder(output) as folder:
        experiment = replace(with_files(experiment, folder), holdout=0.0)
        problem = make_problem(experiment)
        activity.log(
            f"fitting {problem.space.size} parameters of {experiment.preset} to "
            f"{len(experiment.clips)} clips, {len(experiment.hierarchy.varying)} of them varying"
        )
        fitted = fit_clips_and_population(experiment, problem, folder)
        if folder is not None:
            _write_systems(folder, fitted)
        publish(folder, document(fitted))
        return fitted


def _write_systems(folder: Path, fitted: Population) -> None:
    """The experiment, and parameter files: of the population's centre, and of each clip."""
    experiment, space = fitted.experiment, fitted.problem.space
    preset = Preset(experiment.preset, experiment.faithful)
    folder.mkdir(parents=True, exist_ok=True)
    clips = folder / "clips"
    clips.mkdir(exist_ok=True)
    files.write_text(folder / run_folder.EXPERIMENT, experiment_to_toml(experiment, folder))
    paths = [folder / run_folder.PARAMETERS, *(clips / f"{name}.toml" for name in fitted.clips)]
    for path, u in zip(paths, [fitted.fit.centre, *fitted.fit.clips], strict=True):
        ik = space.unpack(jnp.asarray(u))
        files.write_text(path, parameter_files.system_to_toml(ik, preset, fitted.leg_length))
