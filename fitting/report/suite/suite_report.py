"""The report of the suite: a table with its explanation, the numbers, and a page of pictures."""

import math
from pathlib import Path
from typing import Any

from fitting.report.formatting import aligned, bullets, joined, markdown
from fitting.report.labels import explanations
from fitting.report.placement_report import numbers as placement_numbers
from fitting.report.plots import style, suite_plots
from fitting.runtime import files
from fitting.runtime.storage.json_files import write_json
from fitting.studies.suite.suite import Scene, Suite

from . import suite_tables
from .suite_tables import BOUND, MEASURES, MISS

TABLE, NUMBERS, PAGE = "suite.md", "suite.json", "suite.png"


def write(folder: Path, suite: Suite) -> None:
    """Writes suite.md, suite.json and suite.png into a folder, which is made if needed."""
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / NUMBERS, _numbers(suite))
    files.write_text(folder / TABLE, _summary(suite))
    if suite.scenes:
        style.save(folder / PAGE, suite_plots.page(suite))


def text(suite: Suite) -> str:
    """The table, the bounds, and how many cells are within them, for a terminal."""
    parts: list[str] = [aligned(suite_tables.table(suite))] if suite.scenes else []
    parts.append("\n".join([f"bounds ({MISS} is beyond them):", *suite_tables.reasons()]))
    parts.append(suite_tables.count_text(suite))
    return joined(parts, apart=True)


def missed(suite: Suite) -> list[str]:
    """What is beyond its bound, a line each."""
    return [
        f"{scene.situation.name}, {system}: {miss}"
        for scene in suite.scenes
        for system in suite.systems
        for miss in suite_tables.misses(scene, system)
    ]


def _summary(suite: Suite) -> str:
    rows = [[_red(cell) for cell in row] for row in suite_tables.table(suite)]
    lines = missed(suite)
    parts = [
        "# Suite of situations",
        f"{suite_tables.count_text(suite).capitalize()}. Animations of "
        f"{suite.plan.seconds:g} s on made grounds, every system with its defaults, the root "
        "where `jaxik run` puts it.",
        markdown(rows),
        f"A mark ({MISS}) and red are beyond the bound in the row `{BOUND}`.",
        f"![Each system in each situation, from the side]({PAGE})" if suite.scenes else "",
        "## What the columns mean",
        explanations(MEASURES),
        "## Bounds",
        bullets(suite_tables.reasons()),
        "## Beyond their bounds",
        bullets(lines) if lines else "Nothing.",
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _red(cell: str) -> str:
    return f'<span style="color:red">**{cell}**</span>' if cell.endswith(MISS) else cell


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
