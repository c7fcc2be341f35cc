"""The report of the suite: a table with its explanation, the numbers, and a page of pictures."""

import math
from collections import Counter
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from fitting.ground import ground_path
from fitting.motion.measures import VISIBLE
from fitting.report.document import (
    Document,
    Finding,
    Grid,
    Plot,
    Points,
    Section,
    Terms,
    Text,
    View,
)
from fitting.report.formatting import Column, Table, meanings
from fitting.report.style import BEFORE, EARTH, GROUND, STAGES, earth, legend, styled
from fitting.runtime.precision import in_float64

from . import comparison, comparison_report
from .animations import numbers as placement_numbers
from .fit.sentences import listed
from .suite import REASONS, Cell, Outcome, Scene, Suite

TABLE, NUMBERS, PAGE = "suite.md", "suite.json", "suite.png"

MISS = "!"
BOUND = "bound"
_SEEN = f"{100 * VISIBLE:.0f} cm or more"

MEASURES = {
    "penetration": Column(
        "in the ground", "% of frames", 100.0, 1,
        f"Frames in which any foot is {_SEEN} in the ground.",
    ),
    "float": Column(
        "above it", "% of stances", 100.0, 1,
        f"Frames of standing feet in which they are {_SEEN} above the ground.",
    ),
    "slide": Column(
        "slide", "cm a stance", 100.0, 2,
        "Horizontal path of the ball of the foot in a stance beyond the animated one; median.",
    ),
    "pop": Column(
        "pop", "cm in 1/60 s", 100.0, 1,
        "Largest change of an ankle's correction, relative to the pelvis.",
    ),
    "jerk": Column(
        "jerk", "m/s³", 1.0, 0,
        "Third derivative of the height of the pelvis, root mean square.",
    ),
    "reach": Column(
        "reached", "%", 100.0, 1,
        "Ankle targets of standing feet that the system reports as reached.",
    ),
}  # fmt: skip

RED = "#CC0000"
OFF = f"sole off its ground by {100 * VISIBLE:.0f} cm"
SOLES = STAGES[0], STAGES[1]
NARROWEST = 1.5  # m along the path
PANEL = 2.6, 1.45  # inches
ENTRY = 2.3, 0.32  # inches, an entry of the legend
ENTRIES = 6
MARGIN = 0.3  # m, around what is shown
JUMP = 1.0  # m in a frame, from which a line is interrupted
HEAD = 0.5, 1.45  # place of a column's heading, in heights of a panel
SAMPLES = 600  # of the ground


def missed(suite: Suite) -> list[str]:
    """What is beyond its bound, a line each."""
    return [
        f"{scene.situation.name}, {system}: {miss}"
        for scene in suite.scenes
        for system in suite.systems
        for miss in misses(scene, system)
    ]


def _numbers(suite: Suite) -> dict[str, Any]:
    """The content of suite.json: SI units and fractions of 1; null for NaN."""
    within, count = suite.counts
    return {
        "seconds": suite.plan.seconds,
        "interrupted": suite.interrupted,
        "cells": count,
        "within": within,
        "situations": [_scene_numbers(scene) for scene in suite.scenes],
    }


def _scene_numbers(scene: Scene) -> dict[str, Any]:
    systems: dict[str, Any] = {
        name: {
            "cells": {
                key: {"value": _null(cell.value), "within": cell.is_within}
                for key, cell in outcome.cells.items()
            },
            "placement": placement_numbers(outcome.placement),
            "cause": None if outcome.cause is None else outcome.cause.kind,
        }
        for name, outcome in scene.outcomes.items()
    }
    systems |= {name: {"failure": failure} for name, failure in scene.failures.items()}
    return {
        "name": scene.situation.name,
        "root": scene.animation.root.reason,
        "bounds": dict(scene.bounds),
        "systems": systems,
    }


def _null(value: float) -> float | None:
    return None if math.isnan(value) else value


assert MEASURES.keys() == REASONS.keys()


def table(suite: Suite) -> Table:
    """The measures: for each situation a row with its bounds and a row for each system."""
    headings = [f"{column.heading}, {column.unit}" for column in MEASURES.values()]
    rows = [["situation", "system", *headings]]
    for scene in suite.scenes:
        limits = [_limit(key, bound) for key, bound in scene.bounds.items()]
        rows.append([scene.situation.name, BOUND, *limits])
        for system in suite.systems:
            rows.append(["", system, *cells_text(scene, system)])
    return rows


def cells_text(scene: Scene, system: str) -> list[str]:
    """The cells of a system in a situation, with marks."""
    if system in scene.failures:
        return [f"none{MISS}"] * len(MEASURES)
    cells = scene.outcomes[system].cells
    return [MEASURES[key].format(cells[key].value) + mark(cells[key]) for key in MEASURES]


def mark(cell: Cell) -> str:
    """An exclamation mark for a cell beyond its bound."""
    return "" if cell.is_within else MISS


def misses(scene: Scene, system: str) -> list[str]:
    """What misses its bound, a phrase each, with where it is worst and the likely cause."""
    if system in scene.failures:
        return [f"no motion: {scene.failures[system]}"]
    outcome = scene.outcomes[system]
    return [
        _miss(key, cell, cause="" if outcome.cause is None else outcome.cause.kind)
        for key, cell in outcome.cells.items()
        if not cell.is_within
    ]


def reasons() -> list[str]:
    """Each bound and its reason, a sentence each."""
    return [f"{MEASURES[key].heading}: {reason}" for key, reason in REASONS.items()]


def _limit(key: str, bound: float) -> str:
    return ("≥ " if key == "reach" else "≤ ") + MEASURES[key].format(bound)


def _miss(key: str, cell: Cell, cause: str) -> str:
    column = MEASURES[key]
    text = f"{column.heading} {column.format(cell.value)} {column.unit} ({_limit(key, cell.bound)})"
    if cell.worst is not None and not math.isnan(cell.worst.value):
        text += (
            f", worst {100 * cell.worst.value:.1f} cm, {cell.worst.leg}, frame {cell.worst.frame}"
        )
    if cause not in ("", "unknown") and key in ("penetration", "float"):
        text += f", likely cause: {cause}"
    return text


@styled
def page(suite: Suite) -> Figure:
    """Ground, soles, ankles and pelvis of every system in every situation."""
    rows, columns = len(suite.scenes), len(suite.systems)
    width = PANEL[0] * columns + 1.0
    across = max(1, min(ENTRIES, int(width / ENTRY[0])))  # entries of the legend side by side
    height = PANEL[1] * rows + 1.0 + ENTRY[1] * -(-ENTRIES // across)
    figure = Figure(figsize=(width, height), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharex="row", sharey="row")
    for scene, row in zip(suite.scenes, panels, strict=True):
        row[0].set_ylim(_heights(scene))
        for system, axes in zip(suite.systems, row, strict=True):
            _panel(axes, scene, scene.outcomes.get(system))
        row[0].set_ylabel(f"{scene.situation.name}\nheight, m", fontsize=10)
    for system, axes in zip(suite.systems, panels[0], strict=True):
        axes.annotate(system, HEAD, xycoords="axes fraction", ha="center", fontsize=15)
    panels[-1, 0].set_xlabel("along the path, m", fontsize=9)
    legend(
        figure,
        Patch(facecolor=EARTH, edgecolor=GROUND, label="ground below the path"),
        Line2D([], [], color=SOLES[0], label="left sole"),
        Line2D([], [], color=SOLES[1], label="right sole"),
        Line2D([], [], color=BEFORE, label="ankles"),
        Line2D([], [], color="black", label="pelvis"),
        Line2D([], [], color=RED, marker=".", linestyle="", label=OFF),
        columns=across,
    )  # fmt: skip
    return figure


def _panel(axes: Axes, scene: Scene, outcome: Outcome | None) -> None:
    axes.tick_params(labelsize=8)
    if outcome is None:
        _title(axes, ["no motion"])
        return
    clip, soles = outcome.clip, outcome.soles
    pelvis, balls = clip.positions_ws[:, clip.rig.pelvis], clip.joints_ws(3)
    _line(axes, pelvis, color="black", linewidth=1.2)
    for leg, ankle in enumerate(np.moveaxis(clip.joints_ws(2), 1, 0)):
        _line(axes, ankle, color=BEFORE, linewidth=0.6)
        sole = balls[:, leg].copy()
        sole[:, 1] = soles.height[:, leg, 1] + soles.ground[:, leg, 1]
        _line(axes, sole, color=SOLES[leg % len(SOLES)], linewidth=1.0)
        gap = soles.gap[:, leg]
        off = (gap < -VISIBLE) | (soles.stance[:, leg] & (gap > VISIBLE))
        axes.plot(sole[off, 2], sole[off, 1], ".", color=RED, markersize=3)
    middle = (balls[..., 2].min() + balls[..., 2].max()) / 2
    reach = max(NARROWEST / 2, np.ptp(balls[..., 2]) / 2 + MARGIN)
    points = np.zeros((SAMPLES, 3))
    points[:, 2] = middle + np.linspace(-reach, reach, SAMPLES)
    axes.set_xlim(points[0, 2], points[-1, 2])
    ground = ground_path.heights_under(scene.animation.terrain, points, ground_path.SKY)
    earth(axes, points[:, 2], ground)
    missed = [key for key, cell in outcome.cells.items() if not cell.is_within]
    _title(
        axes,
        [
            f"{MEASURES[key].heading} {MEASURES[key].format(outcome.cells[key].value)}{MISS}"
            for key in missed
        ],
    )


def _line(axes: Axes, points: np.ndarray, **look: Any) -> None:
    """A path from the side, interrupted where it jumps."""
    jumps = np.linalg.norm(np.diff(points, axis=0), axis=1) > JUMP
    broken = np.insert(points, np.flatnonzero(jumps) + 1, np.nan, axis=0)
    axes.plot(broken[:, 2], broken[:, 1], **look)


def _heights(scene: Scene) -> tuple[float, float]:
    """The range of heights of a row, m."""
    clips = [outcome.clip for outcome in scene.outcomes.values()] or [scene.animation.placed_clip]
    highest = max(float(clip.positions_ws[:, clip.rig.pelvis, 1].max()) for clip in clips)
    lowest = min(float(clip.joints_ws(3)[..., 1].min()) for clip in clips)
    return lowest - MARGIN, highest + MARGIN / 2


def _title(axes: Axes, missed: list[str]) -> None:
    """Says what misses its bound, in red, with a red frame."""
    middle = (len(missed) + 1) // 2
    lines = [part for part in (missed[:middle], missed[middle:]) if part]
    axes.set_title("\n".join(", ".join(line) for line in lines), fontsize=7, color=RED)
    for spine in axes.spines.values() if missed else ():
        spine.set(visible=True, color=RED)


@in_float64
def document(suite: Suite) -> Document:
    """What a suite says."""
    within, count = suite.counts
    plots = [Plot(PAGE, "Each system in each situation, from the side", lambda: page(suite))]
    return Document(
        file=TABLE,
        kind="Foot IK systems in made situations",
        title="Suite of situations",
        verdict=f"{within} of {count} within bounds",
        good=within == count and not suite.interrupted,
        findings=findings(suite),
        sections=[
            Section(
                "All situations",
                [
                    Text(
                        f"What is marked ({MISS}) is beyond its bound, which stands in the first "
                        "row of a situation."
                    ),
                    Grid(table(suite), "Measures of all systems in all situations"),
                    *(plots if suite.scenes else []),
                    Terms(meanings(MEASURES)),
                ],
            ),
            Section("Bounds", [Points(reasons(), brief=True)]),
            Section("Beyond their bounds", [Points(missed(suite) or ["Nothing."])]),
            _limits(suite),
        ],
        asked=_asked(suite),
        numbers={NUMBERS: _numbers(suite)},
        view=_view(suite) if suite.scenes else None,
    )


def findings(suite: Suite) -> list[Finding]:
    """How many cells miss their bounds and whose, where that is worst, where all is well."""
    if not suite.scenes:
        return [Finding("No situation was finished, so nothing was found.", bad=True)]
    within, count = suite.counts
    text = f"{count - within} of {count} cells are beyond their bounds"
    of_system = _counts(suite)
    worst, best = (choose(of_system, key=of_system.__getitem__) for choose in (max, min))
    if within < count and len(of_system) > 1:
        text += f", most of them of `{worst}` ({of_system[worst]}), fewest of `{best}`"
        text += f" ({of_system[best]})"
    if suite.interrupted:
        text += (
            f", and {len(suite.plan.situations) - len(suite.scenes)} situations are missing, as "
            "the suite was interrupted"
        )
    first = Finding(f"{text}.", bad=within < count or suite.interrupted)
    return [first, _hardest(suite), _easy(suite)]


def _counts(suite: Suite) -> Counter[str]:
    """How many cells of each system miss their bounds."""
    counts = Counter({system: 0 for system in suite.systems})
    for scene in suite.scenes:
        for system in suite.systems:
            counts[system] += _count(scene, system)
    return counts


def _count(scene: Scene, system: str) -> int:
    return sum(cell.endswith(MISS) for cell in cells_text(scene, system))


def _hardest(suite: Suite) -> Finding:
    counts = [sum(_count(scene, system) for system in suite.systems) for scene in suite.scenes]
    most = max(counts)
    if not most:
        return Finding("No situation makes any system miss a bound.")
    scene = suite.scenes[counts.index(most)]
    cells = len(suite.systems) * len(MEASURES)
    text = f"Hardest is `{scene.situation.name}`, with {most} of {cells} cells beyond their bounds"
    if scene.failures:
        text += f"; {listed([f'`{name}`' for name in scene.failures])} gave no motion there"
    return Finding(f"{text}.", bad=True)


def _easy(suite: Suite) -> Finding:
    names = [
        f"`{scene.situation.name}`"
        for scene in suite.scenes
        if not any(_count(scene, system) for system in suite.systems)
    ]
    if not names:
        return Finding("In no situation are all systems within all bounds.", bad=True)
    return Finding(f"All systems are within all bounds in {listed(names)}.")


def _view(suite: Suite) -> View:
    counts = _counts(suite)
    worst = max(counts, key=counts.__getitem__)
    clips = [
        comparison_report.shown(comparison.of_scene(scene), suite.systems, watched=worst)
        for scene in suite.scenes
    ]
    names = [scene.situation.name for scene in suite.scenes]
    return View(clips, names, f"{100 * VISIBLE:.2g} cm (of an adult)")


def _limits(suite: Suite) -> Section:
    lines = [
        "Animations and grounds are made, not captured: the suite says whether feet stand, slide "
        "and pop, not whether people would move like this.",
        "Every system has its defaults or the parameters of its file; fitted to a situation, it "
        "may do better there.",
        "On vehicles the view shows the character as the vehicle's passengers see it.",
    ]
    roots = dict.fromkeys(scene.animation.root.reason for scene in suite.scenes)
    if roots:
        lines.append(f"Roots: {'; '.join(roots)}.")
    return Section("Limits of the data", [Points(lines)])


def _asked(suite: Suite) -> Table:
    return [
        ["Systems", ", ".join(f"`{name}`" for name in suite.systems) or "none was run"],
        ["Situations", ", ".join(entry.name for entry in suite.plan.situations)],
        ["Length of each", f"{suite.plan.seconds:g} s"],
    ]
