"""Translation: the parameters of one system fitted to the motion of another.

The source runs on flat animations over terrain; its motion is the reference of an ordinary
experiment in which parameters of the target are free. The folder is a run like any other, with
these files in addition:

source.npz              the source's motion (source_1.npz, ... for several clips)
source.toml             the source's parameters
<preset>.toml           the fitted parameters again, under the name of the target's preset
translation.json        the remaining differences, as numbers
difference.png          the remaining differences over time
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Array
from matplotlib.artist import Artist
from matplotlib.figure import Figure

import jaxik
from fitting import clips
from fitting.clips import clip_frames, edit
from fitting.experiment import parameter_files, systems
from fitting.experiment.experiment import ClipEntry, Experiment
from fitting.experiment.problems import ClipData, load_known_values, problem_from_clips
from fitting.ground.ground_path import place_root
from fitting.inference import sensitivity
from fitting.inference.noise import NoiseOptions
from fitting.inference.optimise.evolution import evaluate, sweep
from fitting.inference.optimise.solution import Search, SearchSettings, SearchState
from fitting.inference.sensitivity import FreeTable
from fitting.motion import accuracy
from fitting.motion.accuracy import NEGLIGIBLE, Difference, Remainder, summarise_differences
from fitting.problem.problem import Problem
from fitting.problem.space import free_parameter
from fitting.report import style
from fitting.report.document import Block, Grid, Plot, Points, Section, Text, brief
from fitting.report.formatting import DIFFERENCES, Table, number, percent
from fitting.report.style import AFTER, BEFORE, EARTH, area_key, legend, line_key, panels, styled
from fitting.runtime import activity, files, validation
from fitting.runtime.declarations import TABLE, Key, check_table
from fitting.runtime.json_files import write_json
from fitting.runtime.precision import in_float64, with_floats
from fitting.runtime.validation import error_context
from jaxik.maths import parameter_tree

from .animations import AnimationFiles, load_animation
from .fit import fit_jobs, fit_report, run_folder
from .fit.assess import assess_solution, search
from .fit.fit import Fit
from .output import log_output, output_folder

# The source has no noise: these say how far apart two motions still count as the same.
TOLERANCES = {
    "ankle": 0.005,  # m
    "knee": 0.005,  # m
    "pelvis": 0.005,  # m
    "foot": 0.03,  # rad
    "body": 0.03,  # rad
}
MAX_SWEEPS = 20  # over the free parameters, before the search
MIN_SWEEP_GAIN = 0.01  # relative fall of the cost that makes another sweep worthwhile
SOURCE = "source.toml"

NUMBERS = "translation.json"

FAITHFUL = 0.95  # fraction of a correction from which on it counts as reproduced


@dataclass(frozen=True)
class NamedSystem:
    """A system under the name that the user gave."""

    name: str
    """Of a preset, or the stem of a parameter file."""
    preset: systems.Preset
    ik: jaxik.FootIK


@dataclass(frozen=True)
class TranslationRequest:
    """Which system is fitted to which, and on what."""

    source: NamedSystem
    """Whose motion is reproduced."""
    target: NamedSystem
    """Whose parameters are fitted, starting from these values."""
    animations: tuple[AnimationFiles, ...]
    free: FreeTable | None = None
    """None: all that move these clips."""
    fps: float | None = None
    """Clips are resampled to this rate first."""


@dataclass(frozen=True)
class Translation:
    """A translation that is ready to be fitted."""

    source: NamedSystem
    target: NamedSystem
    experiment: Experiment
    clips: tuple[ClipData, ...]
    """Their references are the motions of the source."""
    problem: Problem[jaxik.FootIK]
    free_was_chosen: bool
    """By the user, and not by a sweep over all parameters."""

    @property
    def names(self) -> tuple[str, str]:
        """The source and the target as texts refer to them."""
        same = self.source.name == self.target.name
        return f"`{self.source.name}`{' (source)' if same else ''}", f"`{self.target.name}`"


@in_float64
def load_named_system(
    text: str, option: str = "system", rig: jaxik.Rig | None = None
) -> NamedSystem:
    """The system with the name of a preset, or in a parameter file (.toml).

    Args:
        text: the name or the path.
        option: what the user set to this text, for the error message.
        rig: whose body the system is for; None is the adult.

    Raises:
        ValueError: there is no such preset or file, or the file has a table [noise].
    """
    path = Path(text)
    if path.suffix.lower() == ".toml":
        _check_no_noise(validation.read_toml(path, "a parameter"), text)
        ik, preset = parameter_files.load_system(path, rig)
        return NamedSystem(path.stem, preset, ik)
    with error_context(f"{option} takes a preset or a parameter .toml"):
        preset = systems.Preset(text)
        return NamedSystem(text, preset, preset.system(rig))


def read_free(text: str, ik: jaxik.FootIK, rig: jaxik.Rig | None = None) -> FreeTable:
    """Free parameters as `--free` names them: `name,name`, or a TOML file with a [free] table.

    Args:
        text: names or path.
        ik: the system that has them.
        rig: whose body their ranges are for; None is the adult.

    Raises:
        ValueError: no parameter is named, one is unknown, or it cannot be what the table says; the
            file has a table [noise].
    """
    path = Path(text)
    free: FreeTable
    if path.suffix.lower() == ".toml":
        content = validation.read_toml(path, "a free-parameter")
        _check_no_noise(content, text)
        check_table(content, {"free": Key(TABLE, "What is fitted.")}, text)
        free = systems.read_free_table(content.get("free", {}), ik, f"{text} [free]")
    else:
        free = {name.strip(): {} for name in text.split(",") if name.strip()}
    if not free:
        raise ValueError(f"--free {text}: names no parameter")
    with error_context(f"--free {text}"):
        for name, overrides in free.items():
            free_parameter(ik, name, rig, **overrides)
    return free


def _check_no_noise(content: validation.Table, where: str) -> None:
    if "noise" in content:
        raise ValueError(
            f"{where}: there is a table [noise], but nothing to estimate: the reference of a "
            "translation is exact, and its sigmas are tolerances; leave the table out"
        )


def prepare(request: TranslationRequest, run: Path) -> Translation:
    """Runs the source and builds the problem of fitting the target to it; writes nothing.

    Args:
        request: what is translated.
        run: the folder that the run is going to have.

    Raises:
        ValueError: there is no clip, or a file cannot be read; the source moves nothing in these
            clips; no parameter of the target does.
    """
    if not request.animations:
        raise ValueError("no clip; wanted at least one, with a terrain for each")
    source, target = (
        replace(named, ik=with_floats(named.ik, np.float64))
        for named in (request.source, request.target)
    )
    run = run.resolve()
    with activity.announced(f"Running {source.name} on {len(request.animations)} clip(s)"):
        data = [_source_motion(source, files, request.fps) for files in request.animations]
    rig = data[0].base.rig
    preset = target.preset.system(rig)
    rules = systems.changed_rules(target.ik, preset)
    start = systems.with_rules(preset, rules, target.name, rig)
    experiment = Experiment(
        path=run / run_folder.EXPERIMENT,
        clips=_clip_entries(request, run),
        free=request.free or sensitivity.all_parameters(target.ik, rig),
        preset=target.preset.name,
        faithful=target.preset.faithful,
        name=f"{source.name} to {target.name}",
        fps=request.fps,
        holdout=0.0,
        loss="squares",  # another system's motion has neither outliers nor noise
        noise=NoiseOptions(correlation="given"),
        rules=rules,
        parameters=systems.changed_values(target.ik, start),
        sigmas=TOLERANCES,
    )
    problem = problem_from_clips(experiment, data)
    with activity.announced(f"Measuring what {source.name} moves"):
        _check_moves(source, problem)
    if request.free is None:
        with activity.announced(f"Trying {len(experiment.free)} parameters over their ranges"):
            moving = sensitivity.measure_sensitivity(target.ik, experiment.free, problem.data)
        if not moving:
            raise ValueError(f"no parameter of {target.name} moves anything in these clips")
        experiment = replace(experiment, free={name: experiment.free[name] for name in moving})
        problem = problem_from_clips(experiment, data)
    chosen = request.free is not None
    return Translation(source, target, experiment, tuple(data), problem, chosen)


def _clip_entries(request: TranslationRequest, run: Path) -> tuple[ClipEntry, ...]:
    source, count = request.source, len(request.animations)
    same_rules = systems.rule_names(source.ik) == systems.rule_names(request.target.ik)
    return tuple(
        ClipEntry(
            reference=run / (f"source_{number}.npz" if count > 1 else "source.npz"),
            terrain=animation.terrain,
            base=animation.clip,
            truth=run / SOURCE if same_rules else None,
            **vars(animation.clip_options),
            **vars(animation.terrain_options),
            label=f"source: {source.name}",
            mask_pops=False,
            root=animation.root,
        ).with_paths(Path.resolve)
        for number, animation in enumerate(request.animations, 1)
    )


def _source_motion(source: NamedSystem, files: AnimationFiles, fps: float | None) -> ClipData:
    """The clip with its motion by the source as the reference."""
    animation = load_animation(files, to_fit=True)
    if fps is not None:
        clip = edit.resample(animation.clip, fps)
        clip, root = place_root(clip, animation.terrain, animation.root.root, animation.floor)
        animation = replace(animation, clip=clip, root=root)
    with error_context(source.name):
        animation.check_shapes(source.ik)
        _, solved = animation.solve(source.ik)
    solved = replace(solved, source=f"{source.name} on {animation.clip.source}")
    return ClipData(solved, animation.clip, animation.terrain, animation.root)


def _check_moves(source: NamedSystem, problem: Problem[jaxik.FootIK]) -> None:
    """Raises ValueError if the source leaves every clip as it is."""
    for scene in problem.data:
        corrections = accuracy.correction(scene)
        if any(series.max() > accuracy.NEGLIGIBLE for series in corrections.values()):
            return
    raise ValueError(f"{source.name} moves nothing in these clips: there is nothing to reproduce")


def starting_point(problem: Problem[jaxik.FootIK]) -> np.ndarray:
    """Where the search starts, (free,) in u: the target's values, improved one by one.

    Far from the source, a descent makes each parameter do the work of another one. Moving single
    values over their ranges first does not.
    """
    u = np.asarray(problem.space.pack({}))
    with activity.announced("Moving single parameters over their ranges"):
        cost = float(evaluate(problem, u[None]).cost[0])
        search = Search(problem, SearchSettings(min_sweep_gain=MIN_SWEEP_GAIN))
        state = SearchState.at(u, cost)
        for _ in range(MAX_SWEEPS):
            before = state.point
            state = sweep(search, state)
            if state.point is before:
                break
    return state.point.u


def is_translation(run: Path) -> bool:
    """Whether the folder of a run holds a translation."""
    return (run / SOURCE).is_file()


def check_folder(run: Path) -> None:
    """Checks that a translation can be made here: in a new folder, or where one is unfinished.

    Raises:
        ValueError: the folder holds something else, or cannot be made.
    """
    if not (is_translation(run) and (run / run_folder.SEARCH).is_file()):
        run_folder.check_new_folder(run)


def save_source(run: Path, translation: Translation) -> None:
    """Starts the folder of the run with the source's parameters, which name it, and its motion."""
    run.mkdir(parents=True, exist_ok=True)
    source = translation.source
    files.write_text(run / SOURCE, parameter_files.system_to_toml(source.ik, source.preset))
    for entry, data in zip(translation.experiment.clips, translation.clips, strict=True):
        motion = data.reference
        clips.save_clip(entry.reference, motion, joints=clip_frames.positions_by_role(motion))


@in_float64
def differences(fitted: Fit) -> list[Difference]:
    """The remaining differences from the source, for each clip."""
    return [
        accuracy.measure_difference(scene, result)
        for scene, result in zip(fitted.problem.data, fitted.results, strict=True)
    ]


@in_float64
def write(run: Path, translation: Translation, fitted: Fit, clips: Sequence[Difference]) -> None:
    """Writes parameters, numbers, plots and summary of a translation into the folder of its run."""
    source, target = translation.source, translation.target
    content = {
        "source": source.name,
        "target": target.name,
        "reproduced": numbers(clips),
        "clips": [numbers([clip]) for clip in clips],
        "shortcomings": shortcomings(clips, source.name, target.name),
    }
    write_json(run / NUMBERS, content)
    parameters = parameter_files.system_to_toml(fitted.ik, target.preset)
    files.write_text(run / f"{target.preset.name}.toml", parameters)
    first, second = source.name, target.name
    for plot, clip in zip(_plots(translation, len(clips)), clips, strict=True):
        style.save(run / plot.name, difference(clip, first, second, plot.caption))
    sections = [opening(translation, fitted, clips)], [_parameters_of_both(translation, fitted)]
    fit_report.write_fit(run, fitted, *sections)


def _plots(translation: Translation, count: int) -> list[Plot]:
    """A plot of what remains for each of `count` clips."""
    name = translation.experiment.name
    if count == 1:
        return [Plot("difference.png", f"{name}: what remains")]
    return [
        Plot(f"difference_{number}.png", f"{name}, clip {number}: what remains")
        for number in range(1, count + 1)
    ]


def opening(translation: Translation, fitted: Fit, clips: Sequence[Difference]) -> Section:
    """How close the fit is, and what it cannot do; the plots are drawn by `write`."""
    source, target = translation.names
    phases = accuracy.summarise_differences(clips)
    blocks: list[Block] = [
        Text(headline(phases["all frames"], source, target), brief=True),
        Text(
            "Reproduced is 1 - rms(what remains) / rms(source - animation): 100 % is the same "
            "motion, 0 % is no better than the animation, and negative is worse; – where the "
            "source corrects nothing."
        ),
    ]
    for phase, remainders in phases.items():
        blocks.append(Text(f"{phase.capitalize()}:", brief=True))
        blocks.append(Grid(table(remainders, source), f"What remains, {phase}"))
    if remarks := shortcomings(clips, source, target):
        blocks.append(Text(f"What {target} does not do as {source} does:"))
        blocks.append(Points(remarks, brief=True))
    ends = zip(fitted.identifiability.names, fitted.identifiability.at_bound, strict=True)
    if at_bound := [f"`{name}`" for name, end in ends if end]:
        names = ", ".join(at_bound)
        blocks.append(Text(f"At an end of their range, which may be too narrow: {names}."))
    free = translation.experiment.free
    fixed = [f"`{n}`" for n in sensitivity.all_parameters(translation.target.ik) if n not in free]
    reason = (
        "as requested" if translation.free_was_chosen else "as they move nothing in these clips"
    )
    blocks.append(
        Text(
            f"Parameters of {target} that kept their values, {reason}: "
            f"{', '.join(fixed) or 'none'}. The source has no noise; the sigmas of the fit (5 mm, "
            "0.03 rad) say how far apart still counts as the same, and so decide what is called "
            "determined below."
        )
    )
    blocks += _plots(translation, len(clips))
    return Section(f"How much of {source} {target} reproduces", blocks)


def _parameters_of_both(translation: Translation, fitted: Fit) -> Section:
    """The section with the values of both systems side by side."""
    source, target = translation.names
    iks = translation.source.ik, fitted.ik
    leaves = [systems.leaf_names(ik) for ik in iks]
    declarations = [parameter_tree.declarations(ik) for ik in iks]
    table = [["parameter", "unit", source, f"{target}, fitted", "remarks"]]
    free_leaves = {name.partition("[")[0] for name in translation.experiment.free}
    for name in dict.fromkeys([*leaves[0], *leaves[1]]):
        units = [declared[name].unit for declared in declarations if name in declared]
        values = [
            _value_text(parameter_tree.get(ik, name)) if name in own else "–"
            for ik, own in zip(iks, leaves, strict=True)
        ]
        stage = name.partition(".")[0]
        rules = {type(getattr(ik, stage)) for ik in iks}
        remarks = ["fitted"] if name in free_leaves else []
        remarks += ["of another rule"] if "–" not in values and len(rules) > 1 else []
        table.append([f"`{name}`", units[0] if units else "", *values, ", ".join(remarks)])
    grid = Grid(table, "Parameters of both systems", brief=False)
    return Section("Parameters of both systems", [grid])


def _value_text(value: Array) -> str:
    """The values of a parameter, or the state of a switch."""
    array = np.asarray(value)
    formats = {"b": lambda x: "on" if x else "off", "f": lambda x: number(float(x))}
    return ", ".join(formats.get(array.dtype.kind, str)(x) for x in array.ravel())


def numbers(clips: Sequence[Difference]) -> dict[str, dict[str, dict[str, float | None]]]:
    """Figures of each phase and quantity as JSON holds them, in the units of `DIFFERENCES`.

    `correction` (rms); `rms`, `p95` and `max` of what remains; and `reproduced`, which is
    1 - rms / correction, or None where the reference corrects nothing.
    """
    return {
        phase: {name: _numbers(name, remainder) for name, remainder in remainders.items()}
        for phase, remainders in summarise_differences(clips).items()
    }


def _numbers(quantity: str, remainder: Remainder) -> dict[str, float | None]:
    factor = DIFFERENCES[quantity].factor
    return {
        "correction": factor * remainder.correction,
        "rms": factor * remainder.rms,
        "p95": factor * remainder.p95,
        "max": factor * remainder.max,
        "reproduced": remainder.reproduced,
    }


def table(remainders: Mapping[str, Remainder], source: str) -> Table:
    """A row for each quantity of one phase.

    Args:
        remainders: by quantity.
        source: name of the system that made the reference.
    """
    rows = [["", f"correction by {source}, rms", "remaining, rms", "95 %", "max", "reproduced"]]
    for quantity, remainder in remainders.items():
        name, unit, factor = DIFFERENCES[quantity]
        values = remainder.correction, remainder.rms, remainder.p95, remainder.max
        reproduced = "–" if remainder.reproduced is None else percent(remainder.reproduced)
        rows.append([name, *(f"{factor * value:.2f} {unit}" for value in values), reproduced])
    return rows


def headline(remainders: Mapping[str, Remainder], source: str, target: str) -> str:
    """The share of the source's correction that the target reproduces, in one sentence."""
    parts = [
        f"{percent(remainder.reproduced)} of that of the {DIFFERENCES[quantity].name}"
        for quantity, remainder in remainders.items()
        if remainder.reproduced is not None
    ]
    return f"Of the correction that {source} makes, {target} reproduces {', '.join(parts)}."


def shortcomings(clips: Sequence[Difference], source: str, target: str) -> list[str]:
    """What the target does not do as the source does: a sentence each, with the worst place."""
    sentences = []
    for quantity, remainder in summarise_differences(clips)["all frames"].items():
        name, unit, factor = DIFFERENCES[quantity]
        remaining = f"{number(factor * remainder.rms)} {unit}"
        worst = _worst(clips, quantity)
        if remainder.reproduced is None:
            if remainder.rms > NEGLIGIBLE:
                sentences.append(
                    f"{source} leaves the {name} as animated; {target} is {remaining} (rms) off, "
                    f"{worst}."
                )
        elif remainder.reproduced < FAITHFUL:
            correction = f"{number(factor * remainder.correction)} {unit}"
            sentences.append(
                f"{name.capitalize()}: {remaining} (rms) remain of {correction}, {worst}."
            )
    return sentences


def _worst(clips: Sequence[Difference], quantity: str) -> str:
    """Where what remains of a quantity is largest."""
    _, unit, factor = DIFFERENCES[quantity]
    index = int(np.argmax([clip.remaining[quantity].max() for clip in clips]))
    clip, remaining = clips[index], clips[index].remaining[quantity]
    frame, column = np.unravel_index(np.argmax(remaining), remaining.shape)
    of_clip = f" of clip {index + 1}" if len(clips) > 1 else ""
    of_leg = f" ({clip.legs[column]})" if remaining.shape[1] > 1 else ""
    largest = number(factor * float(remaining[frame, column]))
    return f"at most {largest} {unit} at {clip.time[frame]:.2f} s{of_clip}{of_leg}"


@styled
def difference(clip: Difference, source: str, target: str, title: str) -> Figure:
    """Size of the source's correction, and of what remains of it under the target, over time."""
    names = [
        name
        for name in DIFFERENCES
        if max(clip.correction[name].max(), clip.remaining[name].max()) > NEGLIGIBLE
    ]
    figure, rows = panels(max(len(names), 1), 1, title, 2.9, 1.8, sharex=True)
    for axes, name in zip(rows, names, strict=False):
        kind = DIFFERENCES[name]
        of_legs = clip.remaining[name].shape[1] > 1
        for series, colour in ((clip.correction, BEFORE), (clip.remaining, AFTER)):
            axes.plot(clip.time, kind.factor * series[name].max(axis=1), color=colour)
        axes.set_title(kind.name.capitalize() + (" (the larger of the legs)" if of_legs else ""))
        axes.set_ylabel(kind.unit)
        axes.set_ylim(bottom=0)
        style.shade(axes, clip.time, clip.standing, EARTH)
    rows[-1].set_xlabel("time, s")
    rows[-1].set_xlim(clip.time[0], clip.time[-1])
    entries: list[Artist] = [
        line_key(f"{source} - animation: its correction", BEFORE, linewidth=3),
        line_key(f"{source} - {target}: what remains", AFTER, linewidth=3),
    ]
    if clip.standing.any():
        entries.append(area_key("the character stands", EARTH))
    legend(figure, *entries)
    return figure


@in_float64
def translate(
    request: TranslationRequest,
    output: str | Path | None = None,
) -> Fit:
    """Fits the parameters of one system to the motion of another.

    KeyboardInterrupt (Ctrl-C) ends the search, and a second call with the same folder goes on, as
    in `fit`. The folder is a run: `sample` and `apply` take it.

    Args:
        request: which system is fitted to which, and on what.
        output: a new folder for the run, or that of a translation that was killed or interrupted.

    Raises:
        ValueError: as `prepare`, or the folder holds something already.
    """
    run = None if output is None else Path(output)
    if run is not None:
        check_folder(run)
    with output_folder(run):
        prepared = prepare(request, Path() if run is None else run)
        experiment, problem = prepared.experiment, prepared.problem
        activity.log(
            f"fitting {len(experiment.free)} parameters of {request.target.name} to "
            f"{request.source.name} on {len(prepared.clips)} clip(s)"
        )
        start = starting_point(problem)
        checkpoints = fit_jobs.open_checkpoints(run, experiment, problem)
        with checkpoints:
            solution = search(problem, experiment, start)
            if solution.interrupted:
                activity.log(fit_jobs.INTERRUPTED)
            known = None
            if run is not None:
                save_source(run, prepared)
                known = load_known_values(experiment, problem.space.system)
            fitted = assess_solution(
                experiment, problem, solution,
                known_values=known, run=run, has_noise=False, clips=prepared.clips,
            )  # fmt: skip
            if run is not None:
                run_folder.save_fit(run, fitted)
        remainders = differences(fitted)
        if run is not None:
            write(run, prepared, fitted, remainders)
        if not fitted.solution.interrupted:
            checkpoints.remove()
        activity.log(f"\n{solution.message} {fitted.verdict.sentence}\n")
        activity.log(brief([opening(prepared, fitted, remainders)]))
        log_output(run, run_folder.SUMMARY)
        return fitted
