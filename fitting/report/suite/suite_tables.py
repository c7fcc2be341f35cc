"""The suite as tables and sentences; what misses its bound has an exclamation mark."""

import math

from fitting.analysis.placement import VISIBLE
from fitting.report.formatting import Table
from fitting.report.labels import Column
from fitting.studies.suite.bounds import REASONS, Cell
from fitting.studies.suite.suite import Scene, Suite

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


def count_text(suite: Suite) -> str:
    """How many cells are within their bounds, and which situations are missing."""
    within, count = suite.counts
    text = f"{within} of {count} cells are within their bounds"
    if suite.interrupted:
        text += (
            f"; interrupted after {len(suite.scenes)} of {len(suite.plan.situations)} situations"
        )
    return text


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
