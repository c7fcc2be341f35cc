"""Several systems on one flat animation, measured side by side: the job, and its report."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypedDict

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase

import jaxik
from fitting.clips import flight
from fitting.experiment.parameter_files import load_system
from fitting.experiment.systems import preset_system, without_own_root
from fitting.ground import ground_path
from fitting.motion import accuracy
from fitting.motion.accuracy import Accuracy
from fitting.motion.measures import (
    BOUNDED,
    MEASURES,
    Bounded,
    Cause,
    Measures,
    PlacedMotion,
    Soles,
    with_soles_of,
)
from fitting.motion.worst_window import SECONDS, window_sums
from fitting.report import motion_data, style
from fitting.report.document import (
    Block,
    Document,
    Finding,
    Grid,
    Jump,
    Plot,
    Points,
    Section,
    Terms,
    Text,
    View,
)
from fitting.report.formatting import Table, figures_table, listed, meanings, percent, transposed
from fitting.report.live_data import LiveClip, LiveSystem
from fitting.report.motion_data import MAX_RATE, Appearance, ViewedClip, ViewedMotion
from fitting.report.sliders import sliders
from fitting.report.style import BEFORE, CAPTURED, STAGES
from fitting.runtime import activity
from fitting.runtime.display import Displayable, data_frame
from fitting.runtime.precision import in_float64, with_floats
from fitting.runtime.validation import error_context
from jaxik.world.terrain import moving

from . import animations
from .animations import JOINTS, Animation, RateDifference
from .fit.run_folder import PARAMETERS
from .output import output_folder, publish

if TYPE_CHECKING:
    import pandas


ANIMATED = "as animated"  # the name of the animation itself, without foot IK

TABLE, NUMBERS, FIGURE = "compare.md", "compare.json", "compare.png"
RATES = (
    "How far joints are from where they are at the clip's own rate: rms over frames and legs, and "
    "the largest distance. Labels, strides, speeds and root stay those at the clip's own rate, as "
    "a game stores them with the animation. Pelvis and feet of `unreal` and the pelvis of `mec` "
    "follow by the engine's interp-to, whose half-life depends on the frame rate, as in the "
    "originals: at a speed of 15 it is 33 ms at 30 Hz and 40 ms at 60 Hz."
)

COLOURS = (*STAGES, CAPTURED)
Dashes: TypeAlias = Literal["-", "--", ":"]
DASHES: tuple[Dashes, ...] = ("-", "--", ":")  # for more systems than colours
BAR_PANELS = 4  # in a row, wide enough for their titles

THICKNESS = 0.9  # of the body of a system
CAPTURE = "captured"  # key of the captured motion, which no system has
UNKNOWN = Bounded("", 0.0, "nothing is known of its feet")
MARKED = "What is marked (!) is beyond its bound."
BOUND, MISS = "bound", "!"  # a row of tables, and the mark of what is beyond it


@dataclass(frozen=True)
class Comparison(Displayable):
    """One clip under several systems, by name; the animation itself comes first."""

    title: str
    animation: Animation
    motions: Mapping[str, PlacedMotion]
    """The animation as foot IK gets it, and what systems make of it."""
    causes: Mapping[str, Cause | None]
    """Why feet are off their ground, of the systems; None where they are not."""
    failures: Mapping[str, str] = field(default_factory=dict)
    """The errors of systems that gave no motion, by name."""
    rates: Sequence[RateDifference] = ()
    """At other frame rates, system by system."""
    solved_by: Mapping[str, jaxik.FootIK] = field(default_factory=dict)
    """The systems as they ran, by name."""

    @property
    def animated(self) -> PlacedMotion:
        """The animation as foot IK gets it."""
        return self.motions[ANIMATED]

    @property
    def systems(self) -> tuple[str, ...]:
        """Names of the systems that gave a motion."""
        return tuple(self.causes)

    @property
    def bounds(self) -> dict[str, float]:
        """The bounds of all systems, by measure."""
        return self.animation.bounds

    @cached_property
    def captured(self) -> PlacedMotion | None:
        """The captured motion, where it is known."""
        captured = self.animation.captured
        if captured is None:
            return None
        return self.animation.place(with_soles_of(captured, self.animation.clip))

    @cached_property
    def accuracy(self) -> dict[str, Accuracy]:
        """How far each is from the captured motion; of none where that is unknown."""
        captured, flat = self.animation.captured, self.animated.clip
        if captured is None:
            return {}
        return {
            name: accuracy.summarise([accuracy.clip_errors(motion.clip, captured, flat)])
            for name, motion in self.motions.items()
        }

    def against(self, system: str) -> list[Bounded]:
        """The measures of a system beside their bounds, the worst first."""
        return self.motions[system].measures.against(self.bounds)

    def table(self) -> "pandas.DataFrame":
        """The measures in SI units, a row for each system, as pandas has tables.

        Raises:
            ImportError: pandas is not installed.
        """
        rows = (
            {"system": name} | {key: getattr(motion.measures, key) for key in MEASURES}
            for name, motion in self.motions.items()
        )
        return data_frame(rows, "system")


@in_float64
def named_systems(
    options: Iterable[tuple[str, str]], rig: jaxik.Rig | None = None
) -> dict[str, jaxik.FootIK]:
    """Systems by the name of their preset, parameter file or run, in the order of the options.

    Args:
        options: pairs of `--presets` and names of presets, or of `--parameters` and parameter
            files or folders of runs, separated by commas.
        rig: whose body they are for; None is the adult.

    Raises:
        ValueError: there is no system; a name occurs twice; a preset or a file does not exist, or
            a file is wrong.
    """
    entries = []
    for option, text in options:
        for entry in (part.strip() for part in text.split(",")):
            if not entry:
                raise ValueError(f"{option} {text!r}: wanted names with commas between them")
            entries.append((option, entry))
    files = _file_names([Path(entry) for option, entry in entries if option == "--parameters"])
    systems: dict[str, jaxik.FootIK] = {}
    for option, entry in entries:
        is_file = option == "--parameters"
        name = files[Path(entry)] if is_file else entry
        if name in (*systems, ANIMATED):
            raise ValueError(f"{option} {entry!r}: there already is a system named {name!r}")
        systems[name] = (
            load_system(_parameter_file(Path(entry)), rig)[0]
            if is_file
            else preset_system(entry, rig)
        )
    if not systems:
        raise ValueError("nothing to compare; wanted --presets or --parameters")
    return systems


def _parameter_file(path: Path) -> Path:
    """The parameter file at a path, or in the folder of a run."""
    return path / PARAMETERS if path.is_dir() else path


def _file_names(paths: Sequence[Path]) -> dict[Path, str]:
    """Short names of parameter files: their stem, and of a run's that of its folder.

    Those that would be alike have as many folders before them as it takes.
    """
    parts = {}
    for path in paths:
        whole = _parameter_file(path).resolve()
        parts[path] = (
            whole.parent.parts if whole.name == PARAMETERS else whole.with_suffix("").parts
        )
    names = {}
    for path, own in parts.items():
        endings = range(1, len(own) + 1)
        alone = (n for n in endings if sum(x[-n:] == own[-n:] for x in parts.values()) == 1)
        names[path] = "/".join(own[-next(alone, 1) :])
    return names


def run_systems(
    systems: Mapping[str, jaxik.FootIK],
    animation: Animation,
    *,
    title: str = "",
    keep_going: bool = False,
) -> Comparison:
    """Runs all systems on an animation and measures the motions.

    Stances are those of the animation, the same for every system.

    Args:
        systems: by name.
        animation: the flat animation and the terrain, y up.
        title: of tables and figures.
        keep_going: whether a system that gives no motion is noted, and the others go on.

    Raises:
        ValueError: parameters do not fit the legs, or give poses that are not finite.
    """
    if not keep_going:
        for name, ik in systems.items():
            with error_context(name):
                animation.check_shapes(ik)
    if animation.root.rise is not None:
        systems = {name: without_own_root(ik) for name, ik in systems.items()}
    solved, failures = {}, {}
    for name, ik in systems.items():
        try:
            with activity.announced(f"Compiling and running {name}"):
                animation.check_shapes(ik)
                solved[name] = animation.solve(ik)
        except ValueError as error:
            if not keep_going:
                raise ValueError(f"{name}: {error}") from error
            failures[name] = str(error)
    with activity.announced("Measuring the motions"):
        motions = {ANIMATED: animation.place(animation.placed_clip)}
        motions |= {name: animation.place(clip, result) for name, (result, clip) in solved.items()}
        causes = {name: animation.cause(motions[name], systems[name]) for name in solved}
    solved_by = {name: systems[name] for name in solved}
    return Comparison(title, animation, motions, causes, failures, solved_by=solved_by)


def worst_seconds(feet: Soles, fps: float) -> tuple[int, int]:
    """First and last frame of the `SECONDS` in which feet are furthest off their ground.

    What counts is the depth of any foot in the ground and the height of standing ones above it,
    summed over feet and frames. A foot without ground counts for nothing.

    Args:
        feet: soles over the ground.
        fps: frames per second.
    """
    gap = np.nan_to_num(feet.gap)
    off = np.sum(np.maximum(-gap, 0.0) + np.where(feet.stance, np.maximum(gap, 0.0), 0.0), axis=1)
    frames = min(len(off), round(SECONDS * fps) + 1)
    start = int(np.argmax(window_sums(off, frames)))
    return start, start + frames - 1


def rows(comparison: Comparison, names: Sequence[str]) -> Table:
    """The bounds, and these measures of all systems, with marks; a row each, its name first."""
    bounds = comparison.bounds
    limits = [MEASURES[name].limit(bounds[name]) if name in bounds else "" for name in names]
    measured = [[system, *_cells(comparison, system, names)] for system in comparison.motions]
    failed = [[system, *[f"none{MISS}" for _ in names]] for system in comparison.failures]
    return [[BOUND, *limits], *measured, *failed]


def _cells(comparison: Comparison, system: str, names: Sequence[str]) -> list[str]:
    measured = comparison.motions[system].measures
    beyond = {b.name for b in measured.against(comparison.bounds) if b.is_beyond}
    return [
        MEASURES[name].format(getattr(measured, name)) + (MISS if name in beyond else "")
        for name in names
    ]


def reasons(names: Iterable[str] = BOUNDED) -> list[str]:
    """The bounds of measures with their reasons, a sentence each."""
    return [
        f"{measure.heading} {measure.limit(measure.bound)} {measure.unit}: {measure.reason}"
        for measure in map(MEASURES.__getitem__, names)
    ]


def rate_table(comparison: Comparison) -> Table:
    """How far each system is from its motion at the clip's rate, rms and largest, in mm."""
    heading = [f"mm from {comparison.animation.clip.fps:g} Hz", "at", *JOINTS, "largest"]
    return [heading] + [
        [row.system, f"{row.fps:g} Hz"]
        + [f"{1000 * row.rms[joint]:.1f}" for joint in JOINTS]
        + [f"{1000 * max(row.largest.values()):.1f}"]
        for row in comparison.rates
    ]


def numbers(comparison: Comparison) -> dict[str, Any]:
    """The content of compare.json: SI units, radians and fractions of 1; null for NaN."""
    animation = comparison.animation
    return {
        "title": comparison.title,
        "frames": animation.clip.frame_count,
        "fps": animation.clip.fps,
        "root": animation.root.reason,
        "bounds": comparison.bounds,
        "systems": [
            {"name": name, **motion.measures.numbers()}
            | {"beyond": [b.name for b in comparison.against(name) if b.is_beyond]}
            | {"cause": cause.kind if (cause := comparison.causes.get(name)) else None}
            for name, motion in comparison.motions.items()
        ],
        "failures": dict(comparison.failures),
        "rates": [asdict(row) for row in comparison.rates],
    }


class LineStyle(TypedDict):
    """How a system is drawn, as keywords of `Axes.plot`."""

    color: str
    linestyle: Dashes
    linewidth: float


@style.styled
def overview(comparison: Comparison) -> Figure:
    """Heights of ankles and pelvis under every system, with the ground, and bars of measures."""
    styles = _line_styles(comparison.motions)
    legs = comparison.animation.clip.rig.names
    bar_rows = -(-len(MEASURES) // BAR_PANELS)
    heights = 3.4 * (len(legs) + 1) + 0.6, bar_rows * (0.42 * len(styles) + 1.0)
    figure = Figure(figsize=(17, sum(heights) + 1.6), layout="constrained")
    figure.suptitle(comparison.title)
    (upper,), (lower,) = figure.subfigures(2, 1, squeeze=False, height_ratios=heights)
    _draw_heights(upper, comparison, styles)
    grid = lower.subplots(bar_rows, BAR_PANELS, squeeze=False, sharey=True)
    measured = {name: motion.measures for name, motion in comparison.motions.items()}
    for axes, key in zip(grid.flat, MEASURES, strict=False):
        _bars(axes, key, measured, styles)
    for unused in grid.flat[len(MEASURES) :]:
        unused.remove()
    lines = [style.line_key(name, **line) for name, line in styles.items()]
    style.legend(figure, *lines, style.ground_key(), columns=6)
    return figure


def _draw_heights(
    figure: FigureBase, comparison: Comparison, styles: Mapping[str, LineStyle]
) -> None:
    """Heights over time, a panel for each leg and one for the pelvis."""
    ground, clip = comparison.animated.soles.ground[..., 0], comparison.animated.clip
    time = np.arange(clip.frame_count) / clip.fps
    clips = {name: motion.clip for name, motion in comparison.motions.items()}
    pelvises = {name: own.positions_ws[:, own.rig.pelvis, 1] for name, own in clips.items()}
    pelvis = np.mean(list(pelvises.values()), axis=0)
    columns = style.whole_and_part(figure, time, pelvis, len(clip.rig.names) + 1)
    for panels in columns:
        for leg, (axes, name) in enumerate(zip(panels, clip.rig.names, strict=False)):
            for system, own in clips.items():
                axes.plot(time, 100 * own.joints_ws(2)[:, leg, 1], **styles[system])
            style.earth(axes, time, 100 * ground[:, leg])
            axes.set_title(f"{_title(name)} ankle, with the ground under the animated one")
        for system, heights in pelvises.items():
            panels[-1].plot(time, 100 * heights, **styles[system])
        style.earth(panels[-1], time, 100 * ground.mean(axis=1))
        panels[-1].set_title("Pelvis, with the mean ground under the animated feet")
    for axes in columns[0]:
        axes.set_ylabel("height, cm")


def _line_styles(systems: Iterable[str]) -> dict[str, LineStyle]:
    """Line styles by system; the first one, which is the animation, is grey.

    Each line is thinner than the one drawn before it, so that both are visible where they coincide.
    """
    first, *others = systems
    styles: dict[str, LineStyle] = {first: {"color": BEFORE, "linestyle": "-", "linewidth": 3.5}}
    for index, name in enumerate(others):
        repeat, colour = divmod(index, len(COLOURS))
        dashes = DASHES[repeat % len(DASHES)]
        width = max(1.1, 2.6 - 0.4 * index)
        styles[name] = {"color": COLOURS[colour], "linestyle": dashes, "linewidth": width}
    return styles


def _title(name: str) -> str:
    """The name of a leg at the beginning of a title."""
    return name.replace("_", " ").capitalize()


def _bars(
    axes: Axes, key: str, measures: Mapping[str, Measures], styles: Mapping[str, LineStyle]
) -> None:
    """One measure of all systems, with the value at the end of each bar."""
    values = [getattr(measured, key) for measured in measures.values()]
    # No bar for less than nothing, such as a clearance that was gained; its value says so.
    widths = np.clip(MEASURES[key].factor * np.nan_to_num(values), 0.0, None)
    rows = range(len(values))
    axes.barh(rows, widths, color=[styles[name]["color"] for name in measures], height=0.7)
    for row, width, value in zip(rows, widths, values, strict=True):
        style.write_beside(axes, MEASURES[key].format(value), width, row, 4)
    smallest = 10.0 ** (1 - MEASURES[key].digits)  # on whose axis what rounds to 0 looks like 0
    axes.set_xlim(0.0, 1.35 * max(*widths, smallest))
    axes.xaxis.set_visible(False)  # the values are at the bars
    axes.spines["bottom"].set_visible(False)
    style.name_rows(axes, list(measures))
    axes.grid(False)
    axes.set_title(MEASURES[key].title.capitalize(), fontsize="medium")


@in_float64
def document(comparison: Comparison) -> Document:
    """What a comparison says."""
    systems = comparison.systems
    failing = beyond(comparison)
    measures = list(MEASURES)
    titles = ["", *(measure.title for measure in MEASURES.values())]
    visible = comparison.animated.measures.visible
    caption = "Feet and pelvis over the ground, and the measures"
    return Document(
        file=TABLE,
        kind="Foot IK systems compared on one clip",
        title=comparison.title,
        verdict=f"{len(failing)} of {len(systems)} beyond a bound"
        if failing
        else "All within bounds",
        good=not failing,
        findings=findings(comparison),
        sections=[
            Section(
                "Measures",
                [
                    Text(MARKED),
                    Grid(transposed([titles, *rows(comparison, measures)]), "Measures"),
                    Plot(FIGURE, caption, lambda: overview(comparison)),
                    Terms(meanings(MEASURES)),
                    Text(
                        f"`{ANIMATED}` is the animation without foot IK. A foot stands where the "
                        "animation says so: by its contact labels or, without them, by its motion."
                    ),
                ],
            ),
            Section("Bounds", [Points(reasons(comparison.bounds))]),
            Section(
                "Beside the captured motion",
                [
                    Grid(figures_table("difference", comparison.accuracy), "Accuracy", brief=False),
                    Text("Distances and angles are root mean squares."),
                ]
                if comparison.accuracy
                else [],
            ),
            Section(
                "At other frame rates",
                [Text(RATES), Grid(rate_table(comparison), "Motion at other frame rates")]
                if comparison.rates
                else [],
            ),
            _worst(comparison),
            _limits(comparison),
        ],
        setup=_setup(comparison),
        numbers={NUMBERS: numbers(comparison)},
        view=View(
            [viewed_clip(comparison, systems, _worst_system(comparison), live_clip(comparison))],
            [comparison.title],
            f"{100 * visible:.2g} cm",
        ),
    )


def _worst(comparison: Comparison) -> Section:
    """The worst seconds of each system, what is beyond its bounds or nearest to one, and why."""
    blocks: list[Block] = []
    for name in comparison.systems:
        start, end = _window(comparison, name)
        fps = comparison.animation.clip.fps
        worst, *others = comparison.against(name) or [UNKNOWN]
        words = [worst.words, *(other.words for other in others if other.is_beyond)]
        if (cause := comparison.causes.get(name)) is not None:
            words.append(cause.sentence)
        text = f"`{name}`, {start / fps:.2f} to {end / fps:.2f} s. In the whole clip: "
        blocks += [
            Text(f"{text}{'; '.join(words)}."),
            Jump(f"Show {name} in the view", 0, key(name)),
        ]
    return Section("The worst two seconds of each system", blocks)


def _window(comparison: Comparison, name: str) -> tuple[int, int]:
    motion = comparison.motions[name]
    return worst_seconds(motion.soles, motion.clip.fps)


def _limits(comparison: Comparison) -> Section:
    animation, clip = comparison.animation, comparison.animation.clip
    lines = [
        "The systems are compared on this clip and this ground alone; on others they may stand "
        "differently."
    ]
    if comparison.captured is None:
        lines.append(
            "The captured motion is not known: figures say how feet stand on the ground, not "
            "whether people would move like this."
        )
    if clip.fps > MAX_RATE:
        lines.append(
            f"The view shows {MAX_RATE:g} frames a second or fewer; all figures are of all frames, "
            f"at {clip.fps:g} Hz."
        )
    if clip.stance is None:
        lines.append("The clip has no contact labels; stances are found by its motion.")
    if groundless := comparison.animated.measures.groundless:
        lines.append(
            f"{percent(groundless)} of the animated soles' points have no ground under them and "
            "are left out."
        )
    notes = [
        f"Root: {animation.root.reason}. Presets that leave the character's height to their game "
        "(`unreal`, `mec`) have it on the ground below it, unless `--root animation` was given."
    ]
    if in_the_air := flight.describe(clip):
        notes.append(f"{in_the_air.capitalize()}.")
    return Section(
        "Limits of the data", [Points(lines), Points([*notes, *clip.remarks], brief=True)]
    )


def _setup(comparison: Comparison) -> Table:
    animation = comparison.animation
    clip = animation.clip
    rows = [
        ["Clip and ground", comparison.title],
        ["Frames", f"{clip.frame_count}, {clip.seconds:.2f} s at {clip.fps:g} Hz"],
        ["Systems", ", ".join(f"`{name}`" for name in comparison.systems)],
        ["Root", animation.root.root],
    ]
    if animation.speed != 1.0:
        rows.append(["Speed", f"{animation.speed:g} times that of the clip"])
    if animation.direction != 0.0:
        rows.append(["Direction", f"{np.degrees(animation.direction):g}° to the clip's left"])
    if animation.tracks:
        rows.append(["Tracks", ", ".join(f"`{name}`" for name in animation.tracks)])
    if comparison.rates:
        rates = dict.fromkeys(f"{row.fps:g} Hz" for row in comparison.rates)
        rows.append(["Other frame rates", ", ".join(rates)])
    return rows


def findings(comparison: Comparison) -> list[Finding]:
    """What is worst, which system stands best, and which is closest to the captured motion.

    Where that is not known, the last one says which system reaches its targets.
    """
    last = _closeness(comparison) if comparison.accuracy else _reach(comparison)
    return [_worst_finding(comparison), _standing(comparison), last]


def beyond(comparison: Comparison) -> list[str]:
    """Names of systems of which something is beyond its bound."""
    return [name for name in comparison.systems if _nearest(comparison, name).is_beyond]


def _nearest(comparison: Comparison, name: str) -> Bounded:
    """What is furthest beyond its bound, or nearest to it."""
    return next(iter(comparison.against(name)), UNKNOWN)


def _worst_system(comparison: Comparison) -> str:
    return max(comparison.systems, key=lambda name: _nearest(comparison, name).excess)


def _worst_finding(comparison: Comparison) -> Finding:
    failing, name = beyond(comparison), _worst_system(comparison)
    words = _nearest(comparison, name).words
    if not failing:
        whole = "The system stays" if len(comparison.systems) == 1 else "All systems stay"
        return Finding(f"{whole} within all bounds; nearest to one comes `{name}`: {words}.")
    others = [f"`{other}`" for other in failing if other != name]
    also = ""
    if others:
        also = f"; {listed(others)} {'goes' if len(others) == 1 else 'go'} beyond a bound, too"
    return Finding(f"Worst is `{name}`: {words}{also}.", bad=True)


def _standing(comparison: Comparison) -> Finding:
    shares = {name: comparison.motions[name].measures.contact for name in comparison.systems}
    shares = {name: share for name, share in shares.items() if not math.isnan(share)}
    if not shares:
        return Finding("No standing foot has ground under it, so nothing is known of them.", True)
    best, before = max(shares, key=shares.__getitem__), comparison.animated.measures.contact
    without = "" if math.isnan(before) else f", {percent(before)} without foot IK"
    measure = f"in {percent(shares[best])} of their frames{without}"
    if shares[best] <= before:
        return Finding(
            f"No system keeps standing feet on the ground better than the animation has them: "
            f"`{best}` {measure}.",
            bad=before < 1.0,
        )
    return Finding(f"`{best}` keeps standing feet on the ground best: {measure}.")


def _closeness(comparison: Comparison) -> Finding:
    distances = {name: of.ankle for name, of in comparison.accuracy.items()}
    before = distances.pop(ANIMATED)
    best, worst = (choose(distances, key=distances.__getitem__) for choose in (min, max))
    without = f"; without foot IK it is {100 * before:.1f} cm"
    if distances[best] >= before:
        return Finding(
            f"No system comes closer to the captured motion than the flat animation: the best, "
            f"`{best}`, has its ankles {100 * distances[best]:.1f} cm away (rms){without}.",
            bad=True,
        )
    furthest = f", furthest is `{worst}` with {100 * distances[worst]:.1f} cm"
    return Finding(
        f"Closest to the captured motion is `{best}`, whose ankles are "
        f"{100 * distances[best]:.1f} cm away (rms){furthest if len(distances) > 1 else ''}"
        f"{without}."
    )


def _reach(comparison: Comparison) -> Finding:
    shares = {name: comparison.motions[name].measures.reached for name in comparison.systems}
    shares = {name: share for name, share in shares.items() if not math.isnan(share)}
    if not shares:
        return Finding("No standing foot has a target, as there is no ground under any.", bad=True)
    best, least = (choose(shares, key=shares.__getitem__) for choose in (max, min))
    text = f"`{best}` reaches {percent(shares[best])} of the targets of its standing feet"
    if len(shares) > 1:
        text += f", the most of all, and `{least}` {percent(shares[least])}, the fewest"
    unknown = "how close that is to captured motion is not known, as there is none to compare with"
    return Finding(f"{text}; {unknown}.")


def live_clip(comparison: Comparison) -> LiveClip:
    """The clip as the page solves it again, with each system."""
    animation, rig = comparison.animation, comparison.animation.clip.rig
    carried = animation.carried is not None
    return LiveClip(
        animated=comparison.animated.clip,
        frames=animation.frames,
        rig=rig,
        terrain=moving(animation.terrain, 0) if carried else animation.terrain,
        observed=animation.clip.observed,
        systems={
            key(name): LiveSystem({"compared": ik}, sliders(ik, rig))
            for name, ik in comparison.solved_by.items()
        },
        has_tracks=bool(animation.tracks),
    )


def viewed_clip(
    comparison: Comparison,
    systems: tuple[str, ...],
    watched: str,
    live: LiveClip | None = None,
) -> ViewedClip:
    """What the view shows: colours are those of the plots.

    Args:
        comparison: with the motions.
        systems: names of all systems, which decide the colours.
        watched: the one that is watched at first, if it gave a motion.
        live: with which the page solves the clip again, if it is to.
    """
    flat = motion_data.ANIMATED._replace(colour=BEFORE)
    appearances = {ANIMATED: flat} | {
        name: Appearance(COLOURS[index % len(COLOURS)], THICKNESS)
        for index, name in enumerate(systems)
    }
    motions = {
        key(name): ViewedMotion(
            "flat animation" if name == ANIMATED else name,
            motion,
            appearances[name],
            visible=name != ANIMATED,
            worst=_window(comparison, name),
        )
        for name, motion in comparison.motions.items()
    }
    if comparison.captured is not None:
        motions[CAPTURE] = ViewedMotion(
            "captured", comparison.captured, motion_data.CAPTURED, visible=True
        )
    # Rays start above the highest motion, so that one inside a hill does not hide the hill.
    clips = [motion.clip for motion in comparison.motions.values()]
    highest = max(clips, key=lambda clip: float(clip.positions_ws[..., 1].max()))
    return ViewedClip(
        motions,
        comparison.animated.clip.stance_labels(),
        comparison.animation.own_speed,
        ground_path.around_path(highest, comparison.animation.terrain),
        watched=key(watched if watched in comparison.motions else ANIMATED),
        live=live,
    )


def key(name: str) -> str:
    """Of the motion of a system, or of the animation, in the view."""
    return f"motion {name}"


@in_float64
def compare(
    systems: Mapping[str, jaxik.FootIK],
    animation: animations.AnimationFiles,
    output: str | Path | None = None,
    *,
    rates: Sequence[float] = (),
) -> Comparison:
    """Runs several systems on a flat animation and measures them side by side; warns as `solve`.

    Args:
        systems: by name.
        animation: the clip, the terrain, and where the root is put for all systems.
        output: folder for the table, the numbers, the figure and the page.
        rates: Hz, at which each system runs too, to see how much its motion depends on them.

    Raises:
        ValueError: there is no system, a file cannot be read, a system does not fit the clip or
            gives poses that are not finite, a rate is above the clip's, or the folder cannot be
            made.
    """
    if not systems:
        raise ValueError("systems is empty; wanted one or more")
    with output_folder(output) as folder:
        systems = {name: with_floats(ik, np.float64) for name, ik in systems.items()}
        title = f"{Path(animation.clip).name} on {Path(animation.terrain).name}"
        loaded = animations.load_animation(animation)
        compared = run_systems(systems, loaded, title=title)
        compared = replace(compared, rates=animations.measure(systems, loaded, rates))
        publish(folder, document(compared))
        for name, cause in compared.causes.items():
            animations.warn(compared.motions[name].measures, loaded.bounds, cause, name)
        return compared
