"""One fit: the result of its search, and its numbers as `fit.json` holds them."""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NotRequired, TypeAlias, TypedDict

import equinox as eqx
import numpy as np
from jaxtyping import Float

import jaxik
from fitting.experiment.experiment import Experiment
from fitting.experiment.problems import ClipData
from fitting.inference.identifiability import Identifiability
from fitting.inference.noise import NoiseModel, noise_of
from fitting.inference.optimise.solution import Solution
from fitting.inference.profiles import profile
from fitting.motion import goodness, playback
from fitting.motion.goodness import Assumed, Distances, Group, Verdict, describe_setback
from fitting.motion.playback import Playback
from fitting.problem.capture_system import is_of_capture, system_and_scenes
from fitting.problem.problem import Problem
from fitting.problem.scene import WHITENED, Reference, Scene
from fitting.problem.space import Space
from fitting.runtime import activity
from fitting.runtime.declarations import number
from fitting.runtime.display import Displayable, data_frame
from fitting.runtime.json_files import Finite, length
from fitting.runtime.precision import in_float64
from fitting.runtime.validation import Content
from jaxik.maths import parameter_tree

from . import capture_check
from .capture_check import CaptureCheck, CaptureSigns

if TYPE_CHECKING:
    import pandas


# Walkers start in a ball around the fit. Its width, in u, is the Laplace standard deviation, which
# for a threshold would be the prior's: walkers that start far from a threshold's value get stuck.
THRESHOLD_SD = 0.05
MIN_START_SD, MAX_START_SD = 1e-3, 0.5

# Beyond these, a parameter is at the end of its range to the last digit, where no fit ends.
U: TypeAlias = Annotated[float, number(-40.0, 40.0)]
StartSd: TypeAlias = Annotated[float, number(1e-6, 40.0)]
Interval: TypeAlias = Annotated[list[Finite], length(2)]


class GroupSummary(TypedDict):
    """The residuals of one kind in one clip, as `fit.json` holds them; None where not measured."""

    clip: int
    """From 1."""
    kind: str
    count: int
    """Active residuals."""
    degrees: float
    """Degrees of freedom of the reduced chi-square, after correlation and fitted parameters."""
    chi_square: float
    """Reduced."""
    p: float | None
    sigma: float
    """The assumed one."""
    noise: float
    """The sigma that the residuals imply."""
    correlation: float
    """The assumed one, from frame to frame."""
    correlation_found: float
    correlation_left: float
    correlation_left_p: float | None
    """Of the Ljung-Box test."""
    independent_every: float
    """s, that would be right with the assumed correlation."""
    swing_ratio: float | None
    """Size in swing over size in stance."""
    swing_p: float | None
    beyond_3: float
    """Fraction beyond 3 standard deviations, these taken from the median."""
    beyond_5: float


class GoodnessSummary(TypedDict):
    """Goodness of fit, as `fit.json` holds it."""

    fits: bool
    sentence: str
    groups: list[GroupSummary]


class DistancesSummary(TypedDict):
    """How far motions are from the captured one, as `fit.json` holds it."""

    fitted: NotRequired[dict[str, dict[str, float]]]
    """On fitted frames: m and rad, by motion (animation, before, fitted) and kind of joint."""
    held_out: NotRequired[dict[str, dict[str, float]]]
    """The same on frames that were held out."""
    setbacks: list[str]
    """Where the fit has made it visibly worse, in words."""
    kept: str
    """Whose parameters are in `parameters.toml`: fitted, or before."""


def plain_parts(distances: Distances) -> dict[str, dict[str, dict[str, float]]]:
    """The distances as JSON holds them: by part, motion and kind."""
    return {
        part: {motion: dict(kinds) for motion, kinds in motions.items()}
        for part, motions in distances.parts.items()
    }


def summarise_distances(distances: Distances) -> DistancesSummary:
    """The distances, and what follows from them."""
    setbacks = [describe_setback(setback) for setback in distances.setbacks]
    return {**plain_parts(distances), "setbacks": setbacks, "kept": distances.better}  # type: ignore[typeddict-item]


def _summarise_group(group: Group) -> GroupSummary:
    measured = group.is_measured
    return {
        "clip": group.clip + 1,
        "kind": group.kind,
        "count": group.left.count,
        "degrees": group.left.degrees,
        "chi_square": group.left.mean_square,
        "p": group.left.p if measured else None,
        "sigma": group.sigma,
        "noise": group.sigma * group.plain.scale,
        "correlation": group.correlation,
        "correlation_found": group.plain.autocorrelation,
        "correlation_left": group.left.autocorrelation,
        "correlation_left_p": group.left.autocorrelation_p if measured else None,
        "independent_every": group.left.spacing * group.dt,
        "swing_ratio": group.swing_ratio,
        "swing_p": group.swing_p if measured else None,
        "beyond_3": group.near,
        "beyond_5": group.far,
    }


class PriorSummary(TypedDict):
    """The prior of one parameter, as `fit.json` and `posterior.json` hold it."""

    shape: str
    """Normal or uniform."""
    centre: float | None
    """In the parameter's unit, with the other parameters at their centres; None where uniform."""
    spread: float | None
    """Standard deviation of u; None where uniform."""
    interval: list[float]
    """The central 95 %, in the parameter's unit."""


@in_float64
def summarise_priors(space: Space) -> dict[str, PriorSummary]:
    """The priors of a space's parameters by name."""
    centre, spread = np.asarray(space.values(space.prior.centre)), np.asarray(space.prior.spread)
    uniform, interval = np.asarray(space.prior.uniform), space.prior_interval()
    return {
        name: PriorSummary(
            shape="uniform" if uniform[i] else "normal",
            centre=None if uniform[i] else float(centre[i]),
            spread=None if uniform[i] else float(spread[i]),
            interval=[float(end) for end in interval[i]],
        )
        for i, name in enumerate(space.names)
    }


class FittedMinimum(TypedDict):
    """A part of a parameter's range in which the cost is low."""

    value: Finite
    """Where it is lowest."""
    rise: Finite
    """Its cost above the lowest of all minima."""
    interval: Interval
    values: NotRequired[list[Finite]]
    """All parameters there; fits by earlier versions lack them."""


class FittedParameter(TypedDict):
    """A free parameter after a fit, as `fit.json` holds it."""

    name: str
    of: NotRequired[Literal["system", "capture"]]
    """What it belongs to; fits by earlier versions lack it."""
    kind: Literal["smooth", "threshold"]
    unit: str
    u: U
    start_sd: StartSd
    """Width of the ball in which walkers start, in u."""
    value: Finite
    before: float
    """The value before the fit."""
    low: float
    high: float
    prior: PriorSummary
    interval: Interval
    """95 %."""
    verdict: profile.Verdict
    """Which sides the clips bound."""
    valleys: list[FittedMinimum]
    """From low values to high ones; one unless the verdict says several."""
    contraction: float
    """0 where only the prior is known, 1 where the clips decide."""
    at_bound: Literal["", "low", "high"]
    determined: bool


class SearchRecord(TypedDict):
    """The result of a search, as the files of all studies hold it."""

    converged: bool
    message: str
    noise: NotRequired[Annotated[Content, NoiseModel]]
    """The noise that was estimated, as `NoiseModel` holds it."""
    cost_before: float
    cost: Finite
    steps: int
    starts: int
    """Independent ones."""
    agreeing: int
    """Starts that ended at this cost, or hardly above it."""
    seconds: float


def record_search(
    experiment: Experiment, problem: Problem[jaxik.FootIK], solution: Solution
) -> SearchRecord:
    """The record of a solution, and of the noise of its problem if the experiment estimates it."""
    record: SearchRecord = {
        "converged": solution.converged,
        "message": solution.message,
        "cost_before": solution.cost_before,
        "cost": solution.cost,
        "steps": solution.steps,
        "starts": solution.starts,
        "agreeing": solution.agreeing,
        "seconds": solution.seconds,
    }
    if experiment.noise.estimates_any:
        record["noise"] = dataclasses.asdict(noise_of(problem))
    return record


class FitRecord(SearchRecord):
    """The content of `fit.json`."""

    experiment: str
    goodness: GoodnessSummary
    distances: NotRequired[DistancesSummary]
    """Fits by earlier versions lack them."""
    parameters: list[FittedParameter]
    correlated: list[list[str | float]]
    """Two names and their correlation."""
    weakest: list[str]
    history: list[Content]
    left: list[float]
    """Costs of solutions that were left because their profiles met a lower point."""
    improvement: float
    """How far below the cost the lowest point of the last profiles is."""


@dataclasses.dataclass(frozen=True)
class Fit(Displayable):
    """A fitted experiment."""

    experiment: Experiment
    problem: Problem[jaxik.FootIK]
    solution: Solution
    identifiability: Identifiability
    known_values: Mapping[str, float] | None = None
    """Parameters that made a synthetic reference, by name."""
    run: Path | None = None
    """The folder where it is written."""
    has_noise: bool = True
    """False if the reference is the motion of another system: then sigmas are tolerances."""
    left: tuple[float, ...] = ()
    """Costs of solutions that were left because their profiles met a lower point."""
    clips: tuple[ClipData, ...] = ()
    """The clips of the problem with whole skeletons; without them no motion is shown or saved."""

    @cached_property
    def _fitted(self) -> tuple[jaxik.FootIK, tuple[Scene, ...]]:
        return system_and_scenes(self.problem, self.solution.u)

    @property
    def ik(self) -> jaxik.FootIK:
        """The fitted system."""
        return self._fitted[0]

    @property
    def scenes(self) -> tuple[Scene, ...]:
        """The clips of the problem, with the fitted parameters of the capture if there are any."""
        return self._fitted[1]

    @cached_property
    def results(self) -> tuple[jaxik.Result, ...]:
        """The motion of each clip by the fitted system."""
        with activity.announced("Playing the clips with the fitted system"):
            return playback.run_all(self.ik, self.scenes)

    @cached_property
    def playbacks(self) -> tuple[Playback, ...]:
        """The clips with the fitted system."""
        scenes = zip(self.scenes, self.results, strict=True)
        return tuple(playback.play(scene, result) for scene, result in scenes)

    @cached_property
    def assumed(self) -> Assumed:
        """What the fit assumes of its residuals."""
        return Assumed(
            loss=self.problem.loss,
            weight=float(self.problem.weight),
            tails=float(self.problem.tails),
            sigmas_estimated=self.experiment.noise.sigmas == "estimated",
            whitened=self.experiment.noise.correlation == "whitened",
            counted=self.experiment.noise.correlation == "counted",
            parameters=float(self.identifiability.contraction.sum()),
        )

    @cached_property
    def noise(self) -> NoiseModel:
        """The noise that the fit assumes, or has estimated."""
        return noise_of(self.problem)

    @cached_property
    def groups(self) -> list[Group]:
        """The residuals of each kind in each clip."""
        return self._groups(self.playbacks)

    def _groups(self, playbacks: Sequence[Playback]) -> list[Group]:
        correlations = [
            {kind: float(scene.sigmas.correlation_of(kind)) for kind in WHITENED}
            for scene in self.problem.data
        ]
        return goodness.measure_groups(playbacks, correlations, self.assumed)

    @cached_property
    def before(self) -> tuple[jaxik.Result, ...]:
        """The motion of each clip by the system before the fit."""
        with activity.announced("Playing the clips with the system before the fit"):
            return playback.run_all(*self._before)

    @cached_property
    def _before(self) -> tuple[jaxik.FootIK, tuple[Scene, ...]]:
        return system_and_scenes(self.problem, self.problem.space.pack({}))

    @cached_property
    def distances(self) -> Distances:
        """How far animation, system before the fit and fitted one are from the capture."""
        scenes = zip(self._before[1], self.before, strict=True)
        before = [playback.play(scene, result) for scene, result in scenes]
        return goodness.measure_distances(before, self.playbacks)

    @cached_property
    def check(self) -> CaptureCheck:
        """What the clips can tell, whatever is fitted to them."""
        return capture_check.check(self.clips)

    @property
    def selected_system(self) -> jaxik.FootIK:
        """The fitted system, unless the one before the fit is better."""
        return self.ik if self.distances.better == "fitted" else self._before[0]

    @cached_property
    def verdict(self) -> Verdict:
        """Whether it fits."""
        if self.has_noise:
            return goodness.judge(self.groups, self.assumed, self.distances)
        return goodness.judge_tolerances(self.groups)

    def against(self, references: Sequence[Reference]) -> tuple[Verdict, Distances]:
        """The verdict and the distances beside other references, on the frames of its own."""
        before = _play_beside(references, self._before[1], self.before)
        after = _play_beside(references, self.scenes, self.results)
        distances = goodness.measure_distances(before, after)
        return goodness.judge(self._groups(after), self.assumed, distances), distances

    @property
    def is_worse(self) -> bool:
        """Whether it is visibly further from a capture than what there was before it."""
        return self.has_noise and bool(self.distances.setbacks)

    @cached_property
    def capture_signs(self) -> list[CaptureSigns]:
        """Signs of an offset or a lag in the capture of each clip."""
        return capture_check.find(self.clips, self.playbacks) if self.has_noise else []

    @property
    def start_sd(self) -> Float[np.ndarray, " free"]:
        """Width, in u, of the ball in which walkers start."""
        sd = np.where(np.isfinite(self.identifiability.sd), self.identifiability.sd, THRESHOLD_SD)
        return np.clip(sd, MIN_START_SD, MAX_START_SD)

    @cached_property
    @in_float64
    def parameters(self) -> list[FittedParameter]:
        """The free parameters in the order of `u`."""
        return _fitted_parameters(self)

    def table(self) -> "pandas.DataFrame":
        """The free parameters by name, as pandas has tables; `low95` and `high95` are intervals.

        Raises:
            ImportError: pandas is not installed.
        """
        hidden = ("u", "start_sd", "prior", "valleys", "interval")
        rows = (
            {key: value for key, value in row.items() if key not in hidden}
            | dict(zip(("low95", "high95"), row["interval"], strict=True))
            for row in self.parameters
        )
        return data_frame(rows, "name")

    @cached_property
    @in_float64
    def summary(self) -> FitRecord:
        """The numbers of the fit as JSON holds them."""
        return {
            "experiment": self.experiment.name,
            **self.search,
            "goodness": {
                "fits": self.verdict.fits,
                "sentence": self.verdict.sentence,
                "groups": list(map(_summarise_group, self.groups)),
            },
            "distances": summarise_distances(self.distances),
            "parameters": self.parameters,
            "correlated": [list(pair) for pair in self.identifiability.correlated],
            "weakest": list(self.identifiability.weakest),
            "history": [dataclasses.asdict(step) for step in self.solution.history],
            "left": list(self.left),
            "improvement": self.identifiability.improvement,
        }

    @property
    def search(self) -> SearchRecord:
        """The record of its search."""
        return record_search(self.experiment, self.problem, self.solution)


def _play_beside(
    references: Sequence[Reference], scenes: Sequence[Scene], results: Sequence[jaxik.Result]
) -> tuple[Playback, ...]:
    """Clips beside other references, of which the same frames count."""
    playbacks = []
    for reference, scene, result in zip(references, scenes, results, strict=True):
        own = scene.reference
        counted = ("observed", "held_out", "left_out")
        beside = dataclasses.replace(reference, **{name: getattr(own, name) for name in counted})
        scene = eqx.tree_at(lambda scene: scene.reference, scene, beside)
        playbacks.append(playback.play(scene, result))
    return tuple(playbacks)


def _fitted_parameters(fitted: Fit) -> list[FittedParameter]:
    solution, space, known = fitted.solution, fitted.problem.space, fitted.identifiability
    declared = parameter_tree.declarations(space.system)
    before = np.asarray(space.values(space.pack({})))
    priors = summarise_priors(space)
    rows = []
    for i, parameter in enumerate(space.parameters):
        curve = known.profiles[parameter.name]
        row: FittedParameter = {
            "name": parameter.name,
            "of": "capture" if is_of_capture(parameter.name) else "system",
            "kind": parameter.kind,
            "unit": declared[parameter.leaf].unit,
            "u": float(solution.u[i]),
            "start_sd": float(fitted.start_sd[i]),
            "value": float(solution.values[i]),
            "before": float(before[i]),
            "low": parameter.low,
            "high": parameter.high,
            "prior": priors[parameter.name],
            "interval": list(curve.interval),
            "verdict": curve.verdict,
            "valleys": [
                {
                    "value": v.value,
                    "rise": v.rise,
                    "interval": list(v.interval),
                    "values": curve.path[np.argmin(np.abs(curve.values - v.value))].tolist(),
                }
                for v in curve.minima
            ],
            "contraction": float(known.contraction[i]),
            "at_bound": known.at_bound[i],
            "determined": parameter.name in known.determined,
        }
        rows.append(row)
    return rows
