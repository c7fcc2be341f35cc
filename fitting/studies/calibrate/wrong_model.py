"""Calibration under a wrong model: another system makes the motion, captured with errors.

Then no value of the fitted parameters is true. Still, what a fit says of its motion must be, on
frames that were held out, against the capture and against the motion without errors. Errors are
those of captures: slow, constant and sudden ones, and swings as no system makes them. None of them
is the noise that a fit assumes, which is independent of frame and joint.

Nobody sees differences as small as `UNSEEN`. A verdict is false if more contradicts it: "fits" if
the motion without errors is further off than what looks the same, or if the fit has made something
worse; "worse" if the distance that it names is not larger than the other one there; "does not fit",
which is said of the capture, if the capture without noise and jumps is clearly close enough.
"""

import copy
import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypedDict, cast

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

import jaxik
from fitting.clips import contacts, edit
from fitting.experiment import systems
from fitting.experiment.experiment import Experiment
from fitting.experiment.in_memory import with_files
from fitting.experiment.problems import load_clips, problem_from_clips
from fitting.inference import sensitivity
from fitting.inference.proportions import Proportion, proportion
from fitting.motion import goodness
from fitting.motion.goodness import (
    CLOSE,
    NAMES,
    PART_NAMES,
    UNSEEN,
    Distances,
    Kinds,
    Motion,
    Part,
    describe_distances,
    size,
)
from fitting.problem.problem import Problem
from fitting.problem.scene import Scene
from fitting.problem.simulation import displaced, with_motion_of
from fitting.problem.space import free_parameter, make_space, present_value
from fitting.report import pages
from fitting.report.document import Document, Finding, Grid, Points, Section, Text
from fitting.report.formatting import Table, counted, percent
from fitting.runtime import activity, cluster
from fitting.runtime.json_files import Finite, JsonFile
from fitting.runtime.precision import in_float64, with_floats
from fitting.runtime.validation import Content
from fitting.studies.fit.fit import plain_parts
from fitting.studies.output import as_experiment, output_folder, publish
from fitting.studies.translation import NamedSystem, load_named_system
from jaxik.world.skeleton import Transform

from .calibration import NUMBERS, SUMMARY, WIDE, bounds_text, listed_replicates, share_row
from .replicates import (
    ADVICE,
    WRITER,
    Judgement,
    Kind,
    Replicate,
    claim,
    fit_simulated,
    make_replicates,
    numbers,
)

SPREAD = 0.3  # of u, in which the truth's parameters are drawn around the values of the system

LEVEL = 0.95  # of the bounds of shares
TRUE_VERDICTS = 0.95  # of all, at least
POSITIONS = "ankle", "knee", "pelvis"
WORSE = 0.002  # m rms, further off than the animation
WORDS = "fits", "does not fit", "worse"

DRIFT_PERIODS = (10.0, 30.0)  # s
JUMP_EVERY = 2.0  # s, on average
JUMP_FRAMES = 4  # at most
SWING_SPEED = 0.4  # m/s, of an animated ankle, above which its foot swings
KNEE_SHARE = 0.5  # of the ankle's deviation in a swing

Series = Float[np.ndarray, "frames ..."]

MOTIONS = {
    "animation": "the flat animation",
    "before": "the system before the fit",
    "fitted": "the fitted system",
    "kept": "the selected system",
}
COVERED = (
    "How often the fit's 95 % intervals contain the value of the system that made the motion, for "
    "parameters that both have. Nothing says that they should: under a wrong model a parameter "
    "also does the work of what the system lacks."
)

LIMITS = [
    "Errors and truths are drawn at random, and sizes of errors are those of a careful capture: a "
    "worse one, or a person who walks as no system does, may leave more.",
    "A part that is held out goes on with the same walk over the same ground.",
]


class KindDistances(TypedDict):
    """Distances of a motion by kind of joint, m and rad."""

    ankle: Finite
    knee: Finite
    pelvis: Finite
    foot: Finite


class MotionDistances(TypedDict):
    """Distances of all motions on the same frames."""

    animation: KindDistances
    before: KindDistances
    fitted: KindDistances


class PartDistances(TypedDict):
    """Distances on fitted and on held-out frames, as `Distances` has them."""

    fitted: MotionDistances
    held_out: MotionDistances


class Verdict(TypedDict):
    """The verdict of a fit on its motion, and the distances behind it."""

    fits: bool
    sentence: str
    distances: PartDistances


class WrongModelFit(Replicate):
    """The fit to motion that another system has made."""

    truth_values: dict[str, Finite]
    """Of the parameters of that system, by dotted name."""
    errors: dict[str, Finite]
    """Sizes of the capture's errors, as `ErrorSizes` has them."""
    captured: Verdict
    """The fit against the capture, as `jaxik fit` reports it."""
    lasting: Verdict
    """The same fit against a capture with only the errors that last: no noise and no jumps."""
    noise_free: Verdict
    """The same fit against the motion without errors."""


def fit_line(fitted: WrongModelFit) -> str:
    """A finished fit in one line, for the terminal."""
    distances = distances_of(fitted["captured"])
    motions = distances.parts["held_out"]
    selection = "" if distances.better == "fitted" else ", not selected"
    return (
        f"replicate {fitted['number'] + 1}: {word(fitted['captured'])}"
        f"{'' if is_true(fitted) else ', which is not true'}{selection}; held out: ankles "
        f"{size('ankle', motions['fitted']['ankle'])}, without foot IK "
        f"{size('ankle', motions['animation']['ankle'])}; {fitted['seconds']:.1f} s"
    )


WRONG_MODEL = Kind("wrong_model", "fits", JsonFile(WrongModelFit, WRITER, ADVICE), fit_line)


@dataclasses.dataclass(frozen=True)
class WrongModelAssessment(Judgement):
    """The results, on held-out frames unless a field says otherwise."""

    kept_no_worse: Proportion
    """How often the selected system is no further from the capture than the flat animation, by the
    root mean square over ankles, knees and pelvis."""
    kept_no_worse_anywhere: Proportion
    """How often no kind of joint, nor the orientation of the feet, is further off."""
    kept_no_worse_noise_free: Proportion
    """The first again, against the motion without errors."""
    fitted_no_worse: Proportion
    """The first again, of the fitted system, selected or not."""
    verdicts: Proportion
    """How often the verdict is true."""
    verdicts_of: Mapping[str, Proportion]
    """The same, by what it says."""
    coverage_of: Mapping[str, Proportion]
    """How often the fit's 95 % intervals contain the value of the system that made the motion, by
    parameter that both have; nothing says that they should."""
    medians: Mapping[str, Mapping[str, float]]
    """m or rad, of the distances from the motion without errors, by motion and kind of joint."""
    worse: tuple[int, ...]
    """Replicates whose selected system is worse than the animation, from 1."""
    false: tuple[int, ...]
    """Replicates whose verdict is not true."""
    unconverged: tuple[int, ...]

    @property
    def checks(self) -> Mapping[str, Proportion]:
        """Both claims that are checked."""
        return {
            "the selected system against the animation": self.kept_no_worse,
            "the share of true verdicts": self.verdicts,
        }


@in_float64
def calibrate_wrong_model(
    experiment: Experiment | str | Path,
    truth: str,
    output: str | Path | None = None,
    *,
    replicates: int = 200,
    noise_factor: float = 1.0,
    workers: int = 0,
    scheduler: str | None = None,
) -> WrongModelAssessment:
    """Fits an experiment to motion that another system makes, and judges what the fits say.

    Truths are drawn around the parameters of that system; each of their motions is captured with
    errors that a real capture has, and fitted as `fit` does, with a part held out. A call with the
    same folder continues where an interrupted one ended, as for `calibrate`.

    Args:
        experiment: an experiment, or the path of its file.
        truth: the system that makes the motion: a preset or a parameter .toml.
        output: folder for the replicates and the report.
        replicates: number of truths.
        noise_factor: how much larger the errors of the captures are than usual.
        workers: as for `calibrate`.
        scheduler: as for `calibrate`.

    Raises:
        ValueError: as `calibrate`; there is no such system; no frame is held out.
    """
    experiment = as_experiment(experiment)
    with output_folder(output) as folder:
        experiment = with_files(experiment, folder)
        clips = load_clips(experiment)
        rig = clips[0].base.rig if experiment.body == "clip" else None
        system = load_named_system(truth, "truth", rig)
        if any(clip.root.rise is not None for clip in clips):
            system = dataclasses.replace(system, ik=systems.without_own_root(system.ik))
        problem = problem_from_clips(experiment, clips)
        activity.log(f"{replicates} motions of {system.name}, fitted by {experiment.preset}")
        if not any(np.any(scene.reference.held_out) for scene in problem.data):
            raise ValueError(
                f"{experiment.path}: no frame is held out, which would show what a fit under a "
                "wrong model is worth; give `holdout` a fraction above 0, and clips 3 s or more"
            )
        claim(folder, replicates, experiment, problem, noise_factor, identity_of(system))
        fit = functools.partial(
            fit_wrong_model, problem, experiment, system.ik, noise_factor=noise_factor
        )
        names, numbered = problem.space.names, range(replicates)
        with cluster.connect(workers, scheduler) as client:
            fits = make_replicates(WRONG_MODEL, folder, names, fit, numbered, client)
        assessment = assess(fits)
        publish(folder, document(experiment, system.name, fits, assessment))
        return assessment


@in_float64
def draw_system(
    truth: jaxik.FootIK, rig: jaxik.Rig | None, random: np.random.Generator
) -> tuple[jaxik.FootIK, dict[str, float]]:
    """A system near the given one, and its parameters by name, over ranges of the rig or the adult.

    What is 0 stays 0, and what is at a bound stays there: both mean that something is off. Vectors
    stay, as they are places on the body, and so does what another parameter stays above.
    """
    table = sensitivity.all_parameters(truth, rig)
    numbers = [name for name in table if present_value(truth, name) and "[" not in name]
    parameters = [free_parameter(truth, name, rig, **table[name]) for name in numbers]
    below = {parameter.above for parameter in parameters}
    parameters = [parameter for parameter in parameters if parameter.leaf not in below]
    space = make_space(with_floats(truth, np.float64), parameters)
    u = np.asarray(space.pack({})) + SPREAD * random.normal(size=space.size)
    ik = space.unpack(u)
    return ik, {name: present_value(ik, name) for name in table}


def fit_wrong_model(
    problem: Problem[jaxik.FootIK],
    experiment: Experiment,
    truth: jaxik.FootIK,
    number: int,
    noise_factor: float = 1.0,
) -> WrongModelFit:
    """Fits a replicate, of a system around `truth` captured with errors, as `jaxik fit` does.

    Raises:
        KeyboardInterrupt, ValueError: as `fit_simulated`.
    """
    random = np.random.default_rng([experiment.seed, number])
    rig = problem.data[0].rig if experiment.body == "clip" else None
    ik, values = draw_system(truth, rig, random)
    masked = [clip.mask_pops for clip in experiment.clips]
    exact, sizes = with_motion_of(problem, ik), draw_sizes(random, noise_factor)
    lasting_sizes = dataclasses.replace(sizes, jump=0.0, noise=0.0)
    lasting = with_errors(exact, lasting_sizes, masked, copy.deepcopy(random))
    captured = with_errors(exact, sizes, masked, random)
    own = dataclasses.replace(experiment, seed=int(random.integers(2**32)))
    fitted = fit_simulated(captured, own)
    return {
        "number": number,
        **fitted.search,
        "parameters": fitted.parameters,
        "truth_values": values,
        "errors": dataclasses.asdict(sizes),
        "captured": _stored(fitted.verdict, fitted.distances),
        "lasting": _stored(*fitted.against([scene.reference for scene in lasting.data])),
        "noise_free": _stored(*fitted.against([scene.reference for scene in exact.data])),
    }


def _stored(verdict: goodness.Verdict, distances: Distances) -> Verdict:
    parts = cast(PartDistances, plain_parts(distances))
    return {"fits": verdict.fits, "sentence": verdict.sentence, "distances": parts}


def identity_of(truth: NamedSystem) -> Content:
    """What the truths of all replicates follow from, as JSON holds it."""
    leaves = {name: present_value(truth.ik, name) for name in sensitivity.all_parameters(truth.ik)}
    return {"name": truth.name, "rules": systems.rule_names(truth.ik), "values": leaves}


def assess(fits: Sequence[WrongModelFit]) -> WrongModelAssessment:
    """Judges all replicates of a calibration under a wrong model."""
    captured = [distances_of(fit["captured"]) for fit in fits]
    noise_free = [distances_of(fit["noise_free"]) for fit in fits]
    selected: list[Motion] = [distances.better for distances in captured]
    pairs = list(zip(captured, selected, strict=True))
    kept_no_worse = np.array([_no_worse(*pair) for pair in pairs])
    true = np.array([is_true(fit) for fit in fits])
    words = np.array([word(fit["captured"]) for fit in fits])
    return WrongModelAssessment(
        replicates=len(fits),
        kept_no_worse=_share(kept_no_worse, wanted=(1.0, 1.0)),
        kept_no_worse_anywhere=_share([_no_worse_anywhere(*pair) for pair in pairs]),
        kept_no_worse_noise_free=_share(
            [_no_worse(*pair) for pair in zip(noise_free, selected, strict=True)]
        ),
        fitted_no_worse=_share([_no_worse(distances, "fitted") for distances in captured]),
        verdicts=_share(true, wanted=(TRUE_VERDICTS, 1.0)),
        verdicts_of={verdict: _share(true[words == verdict]) for verdict in WORDS},
        coverage_of=_coverage(fits),
        medians=_medians(noise_free, selected),
        worse=numbers(~kept_no_worse),
        false=numbers(~true),
        unconverged=numbers([not fit["converged"] for fit in fits]),
    )


def word(verdict: Verdict) -> str:
    """The verdict of a fit, one of `WORDS`."""
    if verdict["fits"]:
        return "fits"
    return "worse" if distances_of(verdict).setbacks else "does not fit"


def is_true(fit: WrongModelFit) -> bool:
    """Whether the motion and its capture, without noise, agree with what a fit says."""
    noise_free = distances_of(fit["noise_free"])
    if fit["captured"]["fits"]:
        return not _is_far(noise_free, 1.0) and not noise_free.setbacks
    if setbacks := distances_of(fit["captured"]).setbacks:
        part, kind, _, other, _ = setbacks[0]
        motions = noise_free.parts[part]
        return motions["fitted"][kind] > motions[other][kind]
    return not fit["lasting"]["fits"] or _is_far(distances_of(fit["lasting"]), -1.0)


def distances_of(verdict: Verdict) -> Distances:
    """The distances of a verdict that was read from a file."""
    return Distances(cast(Mapping[Part, Mapping[Motion, Kinds]], verdict["distances"]))


def _no_worse(distances: Distances, motion: Motion) -> bool:
    """Whether the joints of a motion are not visibly further off than the animation's."""
    motions = distances.parts["held_out"]
    of_motion, of_animation = (
        math.sqrt(np.mean([motions[name][kind] ** 2 for kind in POSITIONS]))
        for name in (motion, "animation")
    )
    return of_motion <= of_animation + WORSE


def _no_worse_anywhere(distances: Distances, motion: Motion) -> bool:
    """Whether no kind of joint, nor the orientation of the feet, is visibly further off."""
    motions = distances.parts["held_out"]
    return all(
        motions[motion][kind] <= motions["animation"][kind] + UNSEEN[kind] for kind in UNSEEN
    )


def _is_far(distances: Distances, margin: float) -> bool:
    """Whether the fitted motion is off by more than looks the same plus `margin` times `UNSEEN`."""
    return any(
        motions["fitted"][kind] > CLOSE[kind] + margin * UNSEEN[kind]
        for motions in distances.parts.values()
        for kind in CLOSE
    )


def _share(hits: Any, wanted: tuple[float, float] = (0.0, 1.0)) -> Proportion:
    return proportion(np.asarray(hits, bool)[:, None], level=LEVEL, wanted=wanted)


def _coverage(fits: Sequence[WrongModelFit]) -> dict[str, Proportion]:
    """By parameter that both systems have."""
    hits: dict[str, list[bool]] = {}
    for fit in fits:
        for row in fit["parameters"]:
            if (truth := fit["truth_values"].get(row["name"])) is not None:
                low, high = row["interval"]
                hits.setdefault(row["name"], []).append(low <= truth <= high)
    return {name: _share(covered) for name, covered in hits.items()}


def _medians(
    distances: Sequence[Distances], selected: Sequence[Motion]
) -> dict[str, dict[str, float]]:
    parts = [each.parts["held_out"] for each in distances]
    names: list[Motion] = ["animation", "before", "fitted"]
    motions = {name: [part[name] for part in parts] for name in names}
    pairs = zip(parts, selected, strict=True)
    motions |= {"kept": [part[name] for part, name in pairs]}  # type: ignore[dict-item]
    return {
        name: {kind: float(np.median([each[kind] for each in kinds])) for kind in CLOSE}
        for name, kinds in motions.items()
    }


@dataclasses.dataclass(frozen=True)
class ErrorSizes:
    """How large the errors of a capture are."""

    drift: float
    """m, by which the floor rises and sinks in `DRIFT_PERIODS`."""
    offset: float
    """m, standard deviation of each coordinate of a joint's constant offset, which turns with the
    pelvis."""
    turn: float
    """rad, standard deviation of the constant rotations of pelvis and feet, about each axis."""
    jump: float
    """m, by which a marker jumps, with one or more frames of one joint."""
    swing: float
    """m, by which a swinging ankle is off its path in mid-swing, smoothly."""
    noise: float
    """m, standard deviation of each coordinate, independent in each frame."""


LARGEST = ErrorSizes(drift=0.01, offset=0.01, turn=0.03, jump=0.10, swing=0.03, noise=0.002)


def draw_sizes(random: np.random.Generator, factor: float = 1.0) -> ErrorSizes:
    """Sizes between none and `factor` times the `LARGEST`, all equally likely."""
    return ErrorSizes(*factor * random.random(6) * dataclasses.astuple(LARGEST))


def with_errors(
    problem: Problem[jaxik.FootIK],
    sizes: ErrorSizes,
    mask_pops: Sequence[bool],
    random: np.random.Generator,
) -> Problem[jaxik.FootIK]:
    """The problem with errors in its references, which have none.

    Where `mask_pops` says so of a clip, frames in which a joint jumps are left out, as in a fit.
    """
    scenes = tuple(
        _with_errors(scene, sizes, masked, random)
        for scene, masked in zip(problem.data, mask_pops, strict=True)
    )
    return eqx.tree_at(lambda problem: problem.data, problem, scenes)


def _with_errors(
    scene: Scene, sizes: ErrorSizes, mask_pops: bool, random: np.random.Generator
) -> Scene:
    reference, dt = scene.reference, np.asarray(scene.frames.dt)
    time, count = np.cumsum(dt) - dt[0], len(scene.rig.side)
    joints = (len(dt), 1 + 2 * count, 3)  # pelvis, knees, ankles
    deviation = swing_deviation(np.asarray(scene.frames.foot_speed), sizes.swing, random)
    shift = sizes.noise * random.normal(size=joints) + marker_jumps(
        joints, time, sizes.jump, random
    )
    drift = floor_drift(time, sizes.drift, random)
    shift += drift[:, None, None] * np.asarray(scene.terrain.up_ws)
    heading = Rotation.from_quat(np.asarray(reference.pelvis.rot), scalar_first=True)
    for joint, offset in enumerate(sizes.offset * random.normal(size=joints[1:])):
        shift[:, joint] += heading.apply(offset)
    shift[:, 1 : 1 + count] += KNEE_SHARE * deviation
    shift[:, 1 + count :] += deviation
    turns = sizes.turn * random.normal(size=(1 + count, 3))
    pelvis = _displaced(reference.pelvis, shift[:, 0], turns[0])
    knee_ws = np.asarray(reference.knee_ws) + shift[:, 1 : 1 + count]
    ankle = _displaced(reference.ankle, shift[:, 1 + count :], turns[1:])
    seen = np.ones(len(dt), bool)
    if mask_pops:
        positions = [pelvis.pos[:, None], knee_ws, ankle.pos]
        seen = ~edit.jumps(np.concatenate(positions, axis=1), float(1 / dt.mean()))
    captured = dataclasses.replace(
        reference,
        pelvis=pelvis,
        knee_ws=jax.device_put(knee_ws),
        ankle=ankle,
        observed=reference.observed & seen,
        held_out=reference.held_out & seen,
    )
    return dataclasses.replace(scene, reference=captured)


def floor_drift(time: Series, size: float, random: np.random.Generator) -> Series:
    """Height, m, (frames,), of a floor that slowly rises and sinks by `size`; time in s."""
    phase, period = random.uniform(0.0, 2 * np.pi), random.uniform(*DRIFT_PERIODS)
    return size * np.sin(phase + 2 * np.pi * time / period)


def swing_deviation(speed: Series, size: float, random: np.random.Generator) -> Series:
    """How far each ankle is off its path, m, (frames, legs, 3): smooth, and 0 while a foot stands.

    Each swing has a direction of its own, and its size, m, in mid-swing; the speed of the animated
    ankles, m/s, (frames, legs), says when a foot swings.
    """
    deviation = np.zeros((*speed.shape, 3))
    for leg, moving in enumerate((speed > SWING_SPEED).T):
        for first, last in contacts.runs(moving):
            direction = random.normal(size=3)
            place = (np.arange(first, last + 1) - first + 1) / (last - first + 2)
            bump = size * np.sin(np.pi * place) ** 2
            deviation[first : last + 1, leg] = bump[:, None] * direction / np.linalg.norm(direction)
    return deviation


def marker_jumps(
    shape: tuple[int, int, int], time: Series, size: float, random: np.random.Generator
) -> Series:
    """Jumps of `size`, m, of single joints for a few frames, as of a marker mistaken for another.

    The shape is (frames, joints, 3), the time in s.
    """
    frames, joints, _ = shape
    jumps = np.zeros(shape)
    for _ in range(random.poisson(time[-1] / JUMP_EVERY)):
        first, joint = random.integers(frames), random.integers(joints)
        direction = random.normal(size=3)
        last = first + random.integers(1, JUMP_FRAMES + 1)
        jumps[first:last, joint] = size * direction / np.linalg.norm(direction)
    return jumps


def _displaced(joint: Transform, shift: Series, turn: Float[np.ndarray, "*joints 3"]) -> Transform:
    return displaced(joint, shift, np.broadcast_to(turn, shift.shape))


def explanation(truth: str) -> str:
    """The method, and what the words mean."""
    unseen = ", ".join(f"{NAMES[kind]} {size(kind, value)}" for kind, value in UNSEEN.items())
    return (
        f"Systems were drawn around `{truth}`, and their motion was captured with errors: a drift "
        "of the floor, constant offsets of joints, jumps of markers, swings as no system makes "
        "them, and noise. Each was fitted as `jaxik fit` does; distances are those on frames that "
        "were held out. A motion is worse if it is further off by more than "
        f"{1000 * WORSE:.0f} mm, the root mean square over ankles, knees and pelvis. A verdict is "
        "true unless the motion without errors contradicts it by more than nobody sees "
        f'({unseen}): one that says "fits" if this motion is further off than what looks the same '
        f'({describe_distances(CLOSE)}) or the fit has made it worse, "worse" if the distance that '
        'it names is not larger than the other. "Does not fit" is said of the capture, whose drift '
        "and offsets no system has: it is false if the capture without noise and jumps is nearer "
        "everywhere. "
        f"Bounds are those of the probability behind a share, at {percent(LEVEL, 0)}."
    )


def checks_table(assessment: WrongModelAssessment) -> Table:
    """A row for each claim, checked ones first."""
    rows = [["", "found", "share", "bounds", "wanted", "inside"]]
    wanted = f"{percent(TRUE_VERDICTS, 0)} or more"
    selected = "the selected system no worse than the animation"
    rows.append(share_row(selected, assessment.kept_no_worse, "all"))
    rows.append(share_row("true verdicts", assessment.verdicts, wanted))
    others = {
        f'true where the verdict is "{verdict}"': of
        for verdict, of in assessment.verdicts_of.items()
    }
    others |= {
        "the selected system no worse, by the motion without errors": (
            assessment.kept_no_worse_noise_free
        ),
        "the selected system no worse in any kind of joint": assessment.kept_no_worse_anywhere,
        "the fitted system no worse, selected or not": assessment.fitted_no_worse,
    }
    return rows + [[*share_row(words, of, "")[:-1], ""] for words, of in others.items()]


def distances_table(assessment: WrongModelAssessment) -> Table:
    """A row for each motion: medians of its distances."""
    rows = [["median off the motion without errors", *(NAMES[kind] for kind in CLOSE)]]
    for motion, kinds in assessment.medians.items():
        rows.append([MOTIONS[motion], *(size(kind, kinds[kind]) for kind in CLOSE)])
    return rows


def coverage_table(assessment: WrongModelAssessment) -> Table:
    """A row for each parameter that both systems have."""
    rows = [["parameter", "found", "share", "bounds"]]
    for name, of in assessment.coverage_of.items():
        rows.append(share_row(name, of, "")[:4])
    return rows


def remarks(assessment: WrongModelAssessment, fits: Sequence[WrongModelFit]) -> list[str]:
    """Replicates that need attention, and what each false verdict says."""
    sentences = {
        "The selected system is worse than the animation in replicates": assessment.worse,
        "The verdict is not true in replicates": assessment.false,
        "Fits that did not converge": assessment.unconverged,
    }
    lines = listed_replicates(sentences)
    for number in assessment.false:
        fitted = fits[number - 1]
        off = "; ".join(
            f"{describe_distances(motions['fitted'])} in {PART_NAMES[part]}"
            for part, motions in distances_of(fitted["noise_free"]).parts.items()
        )
        sentence = fitted["captured"]["sentence"]
        lines.append(f'Replicate {number} says: "{sentence}" Without errors: {off}.')
    return lines


def document(
    experiment: Experiment,
    truth: str,
    fits: Sequence[WrongModelFit],
    assessment: WrongModelAssessment,
) -> Document:
    """What a calibration under a wrong model says."""
    checks = [
        Text(explanation(truth)),
        Grid(checks_table(assessment), "All checks"),
        Points(remarks(assessment, fits), brief=True),
    ]
    sections = [
        Section("Checks", checks),
        Section("Distances", [Grid(distances_table(assessment), "Distances by motion")]),
    ]
    if assessment.coverage_of:
        covered = Grid(coverage_table(assessment), "Intervals of shared parameters")
        sections.append(Section("Parameters of both systems", [Text(COVERED), covered]))
    return Document(
        file=SUMMARY,
        kind="Fits of motion that another system makes",
        title=experiment.name,
        verdict="True" if assessment.inside else "Not true",
        good=assessment.inside,
        findings=findings(assessment),
        sections=[*sections, Section("Limits of the data", [Points(LIMITS)])],
        setup=[
            *pages.rows(experiment),
            ["Made by", truth],
            ["Simulated motions", f"{assessment.replicates}"],
        ],
        numbers={NUMBERS: {"experiment": experiment.name, "truth": truth, **assessment.summary}},
    )


def findings(assessment: WrongModelAssessment) -> list[Finding]:
    """The results, and whether there are too few motions for them."""
    selected, true = assessment.kept_no_worse, assessment.verdicts
    motions = f"{counted(assessment.replicates, 'motion')} of another system"
    shares = (
        "The selected system is no worse than the animation in "
        f"{selected.hits} of {selected.total} cases, and {true.hits} of {true.total} verdicts are "
        "true."
    )
    text = f"True under a wrong model: on {motions} everything is inside its bounds. {shares}"
    if not assessment.inside:
        outside = " and ".join(assessment.outside)
        text = (
            f"Not true under a wrong model: on {motions}, outside their bounds: {outside}. {shares}"
        )
    lines = [Finding(text, bad=not assessment.inside)]
    if true.high - true.low > WIDE:
        bounds = bounds_text(true)
        few = f"So few motions prove little: the share of true verdicts may be {bounds}."
        lines.append(Finding(few, bad=True))
    return lines
