"""The report of a comparison: a table with its explanation, the numbers, and a figure."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any, Literal, NamedTuple, TypeAlias, TypedDict

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from fitting.clips import flight
from fitting.motion.measures import (
    MISSING_LIMIT,
    POP_LIMIT,
    SHARE_LIMIT,
    SLIDE_LIMIT,
    Measures,
    Placement,
)
from fitting.report import motion_data
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
from fitting.report.formatting import MEASURES, Table, headings, meanings, percent, transposed
from fitting.report.motion_data import MAX_RATE, Look, ShownClip, ShownMotion
from fitting.report.style import (
    BEFORE,
    CAPTURED,
    EARTH,
    GROUND,
    STAGES,
    earth,
    legend,
    styled,
    whole_and_part,
)
from fitting.runtime.precision import in_float64

from .animations import JOINTS
from .comparison import ANIMATED, ComparedMotions, Comparison, of_comparison
from .fit import fit_figures
from .fit.sentences import listed

TABLE, NUMBERS, FIGURE = "compare.md", "compare.json", "compare.png"
RATES = (
    "How far joints are from where they are at the clip's own rate: rms over frames and legs, and "
    "the largest distance. Labels, strides, speeds and root stay those at the clip's own rate, as "
    "a game keeps them with the animation. Pelvis and feet of `unreal` and the pelvis of `mec` "
    "follow by the engine's interp-to, whose half-life depends on the frame rate, as in the "
    "originals: at a speed of 15 it is 33 ms at 30 Hz and 40 ms at 60 Hz."
)

COLOURS = (*STAGES, CAPTURED)
Dashes: TypeAlias = Literal["-", "--", ":"]
DASHES: tuple[Dashes, ...] = ("-", "--", ":")  # for more systems than colours
BAR_PANELS = 5  # in a row

RADIUS = 0.018  # m, of the bones of a system
CAPTURE = "captured"  # key of the captured motion, which no system has


def table(comparison: Comparison) -> Table:
    """The measures, a row for each system."""
    rows = [
        [name, *(MEASURES[key].format(value) for key, value in asdict(measures).items())]
        for name, measures in comparison.measures.items()
    ]
    return [["system", *headings(MEASURES)], *rows]


def rate_table(comparison: Comparison) -> Table:
    """How far each system is from its motion at the clip's rate, rms and largest, in mm."""
    heading = [f"mm from {comparison.fps:g} Hz", "at", *JOINTS, "largest"]
    return [heading] + [
        [row.system, f"{row.fps:g} Hz"]
        + [f"{1000 * row.rms[joint]:.1f}" for joint in JOINTS]
        + [f"{1000 * max(row.largest.values()):.1f}"]
        for row in comparison.rates
    ]


def _numbers(comparison: Comparison) -> dict[str, Any]:
    """The content of compare.json: SI units, radians and fractions of 1; null for NaN."""
    return {
        "title": comparison.title,
        "frames": len(comparison.ground),
        "fps": comparison.fps,
        "soles_without_ground": comparison.groundless,
        "systems": [
            {"name": name}
            | {key: None if np.isnan(value) else value for key, value in asdict(measures).items()}
            for name, measures in comparison.measures.items()
        ],
        "rates": [asdict(row) for row in comparison.rates],
    }


class LineStyle(TypedDict):
    """How a system is drawn, as keywords of `Axes.plot`."""

    color: str
    linestyle: Dashes
    linewidth: float


@styled
def overview(comparison: Comparison) -> Figure:
    """Heights of ankles and pelvis under every system, with the ground, and bars of measures."""
    styles = _line_styles(comparison.motions)
    bar_rows = -(-len(MEASURES) // BAR_PANELS)
    heights = 3.4 * (len(comparison.legs) + 1) + 0.6, bar_rows * (0.42 * len(styles) + 1.0)
    figure = Figure(figsize=(17, sum(heights) + 1.6), layout="constrained")
    figure.suptitle(comparison.title)
    (upper,), (lower,) = figure.subfigures(2, 1, squeeze=False, height_ratios=heights)
    _draw_heights(upper, comparison, styles)
    grid = lower.subplots(bar_rows, BAR_PANELS, squeeze=False, sharey=True)
    for axes, key in zip(grid.flat, MEASURES, strict=False):
        _bars(axes, key, comparison.measures, styles)
    lines = [Line2D([], [], label=name, **style) for name, style in styles.items()]
    legend(figure, *lines, Patch(facecolor=EARTH, edgecolor=GROUND, label="ground"), columns=6)
    return figure


def _draw_heights(
    figure: FigureBase, comparison: Comparison, styles: Mapping[str, LineStyle]
) -> None:
    """Heights over time, a panel for each leg and one for the pelvis."""
    ground, motions = comparison.ground, comparison.motions
    time = np.arange(len(ground)) / comparison.fps
    pelvis = np.mean([motion.pelvis[:, 1] for motion in motions.values()], axis=0)
    columns = whole_and_part(figure, time, pelvis, len(comparison.legs) + 1)
    for panels in columns:
        for leg, (axes, name) in enumerate(zip(panels, comparison.legs, strict=False)):
            for system, motion in motions.items():
                axes.plot(time, 100 * motion.ankle[:, leg, 1], **styles[system])
            earth(axes, time, 100 * ground[:, leg])
            axes.set_title(f"{_title(name)} ankle, with the ground under the animated one")
        for system, motion in motions.items():
            panels[-1].plot(time, 100 * motion.pelvis[:, 1], **styles[system])
        earth(panels[-1], time, 100 * ground.mean(axis=1))
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
    widths = MEASURES[key].factor * np.nan_to_num(values)
    rows = np.arange(len(values))
    axes.barh(rows, widths, color=[styles[name]["color"] for name in measures], height=0.7)
    for row, width, value in zip(rows, widths, values, strict=True):
        axes.annotate(
            MEASURES[key].format(value),
            (width, row),
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
        )
    smallest = 10.0 ** (
        1 - MEASURES[key].digits
    )  # smallest axis: a value that rounds to 0 looks like 0
    axes.set_xlim(0.0, 1.35 * max(*widths, smallest))
    axes.xaxis.set_visible(False)  # the values are at the bars
    axes.spines["bottom"].set_visible(False)
    axes.set_ylim(len(values) - 0.4, -0.6)
    axes.set_yticks(rows, list(measures))
    axes.tick_params(axis="y", length=0)
    axes.grid(False)
    axes.set_title(f"{MEASURES[key].heading.capitalize()}, {MEASURES[key].unit}")


@in_float64
def document(comparison: Comparison) -> Document:
    """What a comparison says."""
    compared = of_comparison(comparison)
    systems = tuple(comparison.placements)
    placements = {name: compared.motions[name].placement for name in systems}
    failing = beyond(placements)
    worst = max(systems, key=lambda name: faults(placements[name])[0].excess)
    visible = compared.motions[ANIMATED].placement.visible
    return Document(
        file=TABLE,
        kind="Foot IK systems compared on one clip",
        title=comparison.title,
        verdict=f"{len(failing)} of {len(systems)} beyond a limit"
        if failing
        else "All within limits",
        good=not failing,
        findings=findings(comparison, compared),
        sections=[
            _placement(compared),
            Section(
                "Beside the captured motion",
                [
                    Grid(fit_figures.accuracy_table(compared.accuracy), "Accuracy", brief=False),
                    Text("Distances and angles are root mean squares."),
                ]
                if compared.accuracy
                else [],
            ),
            _measures(comparison),
            Section(
                "At other frame rates",
                [Text(RATES), Grid(rate_table(comparison), "Motion at other frame rates")]
                if comparison.rates
                else [],
            ),
            _worst(comparison, compared),
            _limits(comparison, compared),
        ],
        asked=_asked(comparison),
        numbers={NUMBERS: _numbers(comparison)},
        view=View(
            [shown(compared, systems, watched=worst)],
            [comparison.title],
            f"{100 * visible:.2g} cm",
        ),
    )


def _placement(compared: ComparedMotions) -> Section:
    placements = {name: motion.placement for name, motion in compared.motions.items()}
    if compared.captured is not None:
        placements["captured"] = compared.captured.placement
    grid = Grid(fit_figures.placement_table(placements), "How feet are placed", brief=False)
    text = (
        "Share of the frames and, after the dot, the largest with its foot and frame. A slide or a "
        "pop counts by how far it exceeds that of the flat animation; frames count from 0."
    )
    return Section("Feet on the ground", [grid, Text(text)])


def _measures(comparison: Comparison) -> Section:
    caption = "Feet and pelvis over the ground, and the measures"
    return Section(
        "Measures",
        [
            Grid(transposed(table(comparison)), "Measures of all systems"),
            Plot(FIGURE, caption, lambda: overview(comparison)),
            Terms(meanings(MEASURES)),
            Text(
                f"`{ANIMATED}` is the animation without foot IK, on its flat floor. A foot stands "
                "where the animation says so: by its contact labels or, without them, by its "
                "motion. The ground under a point is what a ray from above meets first."
            ),
        ],
    )


def _worst(comparison: Comparison, compared: ComparedMotions) -> Section:
    blocks: list[Block] = []
    for name in comparison.placements:
        start, end = compared.worst[name]
        fault, *_ = faults(compared.motions[name].placement)
        times = f"{start / comparison.fps:.2f} to {end / comparison.fps:.2f} s"
        text = f"`{name}`, {times}. What passes least in the whole clip: {fault.words}."
        blocks += [Text(text), Jump(f"Show {name} in the view", 0, key(name))]
    return Section("The worst two seconds of each system", blocks)


def _limits(comparison: Comparison, compared: ComparedMotions) -> Section:
    animation, clip = comparison.animation, comparison.animation.clip
    lines = [
        "The systems are compared on this clip and this ground alone; on others they may stand "
        "differently."
    ]
    if compared.captured is None:
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
    if comparison.groundless:
        lines.append(
            f"{percent(comparison.groundless)} of the soles' points have no ground under them and "
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


def _asked(comparison: Comparison) -> Table:
    animation = comparison.animation
    count = len(comparison.ground)
    seconds = (count - 1) / comparison.fps
    rows = [
        ["Clip and ground", comparison.title],
        ["Frames", f"{count}, {seconds:.2f} s at {comparison.fps:g} Hz"],
        ["Systems", ", ".join(f"`{name}`" for name in comparison.placements)],
        ["Root", animation.root.root],
    ]
    if animation.speed != 1.0:
        rows.append(["Speed", f"{animation.speed:g} times that of the clip"])
    if animation.tracks:
        rows.append(["Tracks", ", ".join(f"`{name}`" for name in animation.tracks)])
    if comparison.rates:
        rates = dict.fromkeys(f"{row.fps:g} Hz" for row in comparison.rates)
        rows.append(["Other frame rates", ", ".join(rates)])
    return rows


class Fault(NamedTuple):
    """Something that a viewer may notice of a motion."""

    excess: float
    """Over the limit of what passes; above 1 it does not."""
    words: str


def findings(comparison: Comparison, compared: ComparedMotions) -> list[Finding]:
    """What is worst, which system stands best, and which is closest to the captured motion.

    Where that is not known, the last one says which system reaches its targets.
    """
    placements = {name: compared.motions[name].placement for name in comparison.placements}
    animated = compared.motions[ANIMATED].placement
    last = _closeness(compared) if compared.accuracy else _reach(comparison)
    return [_worst_finding(placements), _standing(placements, animated), last]


def off_ground(placement: Placement) -> float:
    """Fraction of the frames of standing feet in which one is visibly off the ground."""
    return placement.sunk + placement.floating


def faults(placement: Placement) -> list[Fault]:
    """All that is measured against a limit, the worst first."""
    visible = f"{100 * placement.visible:.2g} cm"
    deepest, highest = placement.deepest, placement.highest
    pop, slide = placement.pop, placement.largest_slide
    place, furthest = ("above", highest) if highest.value > deepest.value else ("in", deepest)
    size = placement.size
    every = [
        Fault(
            placement.groundless / MISSING_LIMIT,
            f"there is no ground under {percent(placement.groundless)} of its soles",
        ),
        Fault(
            off_ground(placement) / SHARE_LIMIT,
            f"its standing feet are {visible} or more off the ground in "
            f"{percent(off_ground(placement))} of their frames (furthest "
            f"{100 * furthest.value:.1f} cm {place} it, {furthest.leg}, frame {furthest.frame})",
        ),
        Fault(
            placement.slide / (SLIDE_LIMIT * size),
            f"its standing feet slide by {100 * placement.slide:.1f} cm a stance more than "
            f"animated (most {100 * slide.value:.1f} cm, {slide.leg}, frame {slide.frame})",
        ),
        Fault(
            pop.value / (POP_LIMIT * size),
            f"its feet pop by up to {100 * pop.value:.1f} cm in 1/60 s ({pop.leg}, frame "
            f"{pop.frame})",
        ),
    ]
    known = [fault for fault in every if not math.isnan(fault.excess)]
    return sorted(known, key=lambda fault: -fault.excess)


def beyond(placements: Mapping[str, Placement]) -> list[str]:
    """Names of motions of which something is beyond its limit."""
    return [name for name, placed in placements.items() if faults(placed)[0].excess > 1.0]


def _worst_finding(placements: Mapping[str, Placement]) -> Finding:
    failing = beyond(placements)
    name = max(placements, key=lambda name: faults(placements[name])[0].excess)
    excess, words = faults(placements[name])[0]
    times = f"{excess:.2g} times what passes unnoticed"
    if not failing:
        whole = "The system stays" if len(placements) == 1 else "All systems stay"
        return Finding(
            f"{whole} within the limits of feet off the ground, slides and pops; nearest to one "
            f"comes `{name}`, as {words}, {times}."
        )
    others = [f"`{other}`" for other in failing if other != name]
    also = ""
    if others:
        also = f"; {listed(others)} {'goes' if len(others) == 1 else 'go'} beyond a limit, too"
    return Finding(f"Worst is `{name}`: {words}, {times}{also}.", bad=True)


def _standing(placements: Mapping[str, Placement], animated: Placement) -> Finding:
    shares = {name: off_ground(placed) for name, placed in placements.items()}
    shares = {name: share for name, share in shares.items() if not math.isnan(share)}
    visible = f"{100 * animated.visible:.2g} cm"
    if not shares:
        return Finding("No standing foot has ground under it, so nothing is known of them.", True)
    best, before = min(shares, key=shares.__getitem__), off_ground(animated)
    without = "" if math.isnan(before) else f", {percent(before)} without foot IK"
    measure = f"{visible} or more off the ground in {percent(shares[best])} of their frames"
    if shares[best] >= before:
        return Finding(
            f"No system brings standing feet closer to the ground than the animation has them: "
            f"with `{best}` they are {measure}{without}.",
            bad=before > 0.0,
        )
    if len(shares) == 1:
        return Finding(f"Its standing feet are {measure}{without}.")
    return Finding(f"`{best}` places standing feet best: they are {measure}{without}.")


def _closeness(compared: ComparedMotions) -> Finding:
    distances = {name: of.ankle for name, of in compared.accuracy.items()}
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
    shares = {name: comparison.measures[name].reached for name in comparison.placements}
    shares = {name: share for name, share in shares.items() if not math.isnan(share)}
    if not shares:
        return Finding("No foot has a target, as there is no ground under any.", bad=True)
    best, least = (choose(shares, key=shares.__getitem__) for choose in (max, min))
    text = f"`{best}` reaches {percent(shares[best])} of the targets of its ankles"
    if len(shares) > 1:
        text += f", the most of all, and `{least}` {percent(shares[least])}, the fewest"
    unknown = "how close that is to captured motion is not known, as there is none to compare with"
    return Finding(f"{text}; {unknown}.")


def shown(compared: ComparedMotions, systems: tuple[str, ...], watched: str) -> ShownClip:
    """What the view shows: colours are those of the plots.

    Args:
        compared: the motions.
        systems: names of all systems, which decide the colours.
        watched: the one that is watched at first, if it gave a motion.
    """
    flat = motion_data.ANIMATED._replace(colour=BEFORE)
    looks = {ANIMATED: flat} | {
        name: Look(COLOURS[index % len(COLOURS)], RADIUS) for index, name in enumerate(systems)
    }
    motions = {
        key(name): ShownMotion(
            "flat animation" if name == ANIMATED else name,
            motion,
            looks[name],
            visible=name != ANIMATED,
            worst=compared.worst[name],
        )
        for name, motion in compared.motions.items()
    }
    if compared.captured is not None:
        motions[CAPTURE] = ShownMotion(
            "captured", compared.captured, motion_data.CAPTURED, visible=True
        )
    return ShownClip(
        motions,
        compared.stance,
        compared.ground,
        watched=key(watched if watched in compared.motions else ANIMATED),
    )


def key(name: str) -> str:
    """Of the motion of a system, or of the animation, in the view."""
    return f"motion {name}"
