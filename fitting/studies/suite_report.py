"""The report of the suite: a table with its explanation, the numbers, and a page of pictures."""

import textwrap
from collections import Counter
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from fitting.ground import ground_path
from fitting.motion.measures import BOUNDED, MEASURES, VISIBLE, PlacedMotion
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
from fitting.report.formatting import Table, listed, meanings
from fitting.report.style import BEFORE, EARTH, GROUND, STAGES, earth, legend, styled
from fitting.runtime.precision import in_float64

from . import comparison_report
from .comparison import ANIMATED
from .comparison_report import BOUND, MARKED, MISS
from .suite import Scene, Suite

TABLE, NUMBERS, PAGE = "suite.md", "suite.json", "suite.png"

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
TITLE = 42  # characters over a panel, in a line


def missed(suite: Suite) -> list[str]:
    """What is beyond its bound, a line each."""
    return [
        f"{scene.situation.name}, {system}: {words}"
        for scene in suite.scenes
        for system in suite.systems
        for words in misses(scene, system)
    ]


def misses(scene: Scene, system: str) -> list[str]:
    """What is beyond its bound, a phrase each, and the likely cause of feet off the ground."""
    compared = scene.comparison
    if system in compared.failures:
        return [f"no motion: {compared.failures[system]}"]
    cause = compared.causes[system]
    known = [] if cause is None or cause.kind == "unknown" else [f"likely cause: {cause.kind}"]
    return [*(bounded.words for bounded in scene.beyond(system)), *known]


def _numbers(suite: Suite) -> dict[str, Any]:
    """The content of suite.json: SI units and fractions of 1; null for NaN."""
    within, count = suite.counts
    return {
        "seconds": suite.plan.seconds,
        "interrupted": suite.interrupted,
        "measures": count,
        "within": within,
        "situations": [comparison_report.numbers(scene.comparison) for scene in suite.scenes],
    }


def table(suite: Suite) -> Table:
    """The measures: for each situation a row with its bounds and a row for each system."""
    rows = [["situation", "system", *(measure.title for measure in BOUNDED.values())]]
    for scene in suite.scenes:
        of_system = {name: cells for name, *cells in _rows(scene)}
        rows.append([scene.situation.name, BOUND, *of_system[BOUND]])
        rows += [["", system, *of_system[system]] for system in suite.systems]
    return rows


def _rows(scene: Scene) -> Table:
    return comparison_report.rows(scene.comparison, list(BOUNDED))


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
            _panel(axes, scene, system)
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


def _panel(axes: Axes, scene: Scene, system: str) -> None:
    axes.tick_params(labelsize=8)
    if system in scene.comparison.failures:
        _title(axes, ["no motion"])
        return
    motion = scene.comparison.motions[system]
    clip, soles, visible = motion.clip, motion.soles, motion.measures.visible
    pelvis, balls = clip.positions_ws[:, clip.rig.pelvis], clip.joints_ws(3)
    _line(axes, pelvis, color="black", linewidth=1.2)
    for leg, ankle in enumerate(np.moveaxis(clip.joints_ws(2), 1, 0)):
        _line(axes, ankle, color=BEFORE, linewidth=0.6)
        sole = balls[:, leg].copy()
        sole[:, 1] = soles.height[:, leg, 1] + soles.ground[:, leg, 1]
        _line(axes, sole, color=SOLES[leg % len(SOLES)], linewidth=1.0)
        gap = soles.gap[:, leg]
        off = (gap < -visible) | (soles.stance[:, leg] & (gap > visible))
        axes.plot(sole[off, 2], sole[off, 1], ".", color=RED, markersize=3)
    middle = (balls[..., 2].min() + balls[..., 2].max()) / 2
    reach = max(NARROWEST / 2, np.ptp(balls[..., 2]) / 2 + MARGIN)
    points = np.zeros((SAMPLES, 3))
    points[:, 2] = middle + np.linspace(-reach, reach, SAMPLES)
    axes.set_xlim(points[0, 2], points[-1, 2])
    ground = ground_path.heights_under(scene.comparison.animation.terrain, points, ground_path.SKY)
    earth(axes, points[:, 2], ground)
    _title(axes, [_short(motion, bounded.name) for bounded in scene.beyond(system)])


def _short(motion: PlacedMotion, name: str) -> str:
    measure = MEASURES[name]
    return f"{measure.heading} {measure.format(getattr(motion.measures, name))}{MISS}"


def _line(axes: Axes, points: np.ndarray, **look: Any) -> None:
    """A path from the side, interrupted where it jumps."""
    jumps = np.linalg.norm(np.diff(points, axis=0), axis=1) > JUMP
    broken = np.insert(points, np.flatnonzero(jumps) + 1, np.nan, axis=0)
    axes.plot(broken[:, 2], broken[:, 1], **look)


def _heights(scene: Scene) -> tuple[float, float]:
    """The range of heights of a row, m."""
    motions = scene.comparison.motions
    clips = [motions[name].clip for name in scene.comparison.systems or [ANIMATED]]
    highest = max(float(clip.positions_ws[:, clip.rig.pelvis, 1].max()) for clip in clips)
    lowest = min(float(clip.joints_ws(3)[..., 1].min()) for clip in clips)
    return lowest - MARGIN, highest + MARGIN / 2


def _title(axes: Axes, missed: list[str]) -> None:
    """Says what misses its bound, in red, with a red frame."""
    whole = ", ".join(part.replace(" ", "\xa0") for part in missed)  # no part is broken
    axes.set_title(textwrap.fill(whole, TITLE), fontsize=7, color=RED)
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
                    Text(f"{MARKED} Bounds stand in the first row of a situation."),
                    Grid(table(suite), "Measures of all systems in all situations"),
                    *(plots if suite.scenes else []),
                    Terms(meanings(BOUNDED)),
                ],
            ),
            Section("Bounds", [Points(comparison_report.reasons(), brief=True)]),
            Section("Beyond their bounds", [Points(missed(suite) or ["Nothing."])]),
            _limits(suite),
        ],
        asked=_asked(suite),
        numbers={NUMBERS: _numbers(suite)},
        view=_view(suite) if suite.scenes else None,
    )


def findings(suite: Suite) -> list[Finding]:
    """How many measures miss their bounds and whose, where that is worst, where all is well."""
    if not suite.scenes:
        return [Finding("No situation was finished, so nothing was found.", bad=True)]
    within, count = suite.counts
    text = f"{count - within} of {count} measures are beyond their bounds"
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
    """How many measures of each system miss their bounds."""
    return Counter(
        {name: sum(scene.count(name) for scene in suite.scenes) for name in suite.systems}
    )


def _hardest(suite: Suite) -> Finding:
    counts = [sum(map(scene.count, suite.systems)) for scene in suite.scenes]
    most = max(counts)
    if not most:
        return Finding("No situation makes any system miss a bound.")
    scene = suite.scenes[counts.index(most)]
    count = len(suite.systems) * len(BOUNDED)
    text = f"Hardest is `{scene.situation.name}`, with {most} of {count} measures beyond bounds"
    if failures := scene.comparison.failures:
        text += f"; {listed([f'`{name}`' for name in failures])} gave no motion there"
    return Finding(f"{text}.", bad=True)


def _easy(suite: Suite) -> Finding:
    names = [
        f"`{scene.situation.name}`"
        for scene in suite.scenes
        if not any(map(scene.count, suite.systems))
    ]
    if not names:
        return Finding("In no situation are all systems within all bounds.", bad=True)
    return Finding(f"All systems are within all bounds in {listed(names)}.")


def _view(suite: Suite) -> View:
    counts = _counts(suite)
    worst = max(counts, key=counts.__getitem__)
    clips = [
        comparison_report.shown(scene.comparison, suite.systems, watched=worst)
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
    roots = dict.fromkeys(scene.comparison.animation.root.reason for scene in suite.scenes)
    if roots:
        lines.append(f"Roots: {'; '.join(roots)}.")
    return Section("Limits of the data", [Points(lines)])


def _asked(suite: Suite) -> Table:
    return [
        ["Systems", ", ".join(f"`{name}`" for name in suite.systems) or "none was run"],
        ["Situations", ", ".join(entry.name for entry in suite.plan.situations)],
        ["Length of each", f"{suite.plan.seconds:g} s"],
    ]
