"""The report of a comparison of runs: a table, with its explanation in Markdown."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from fitting.inference.sampling.blocks import SECONDS
from fitting.report.formatting import Table, markdown
from fitting.runtime import files
from fitting.studies.posterior.run_comparison import ComparedRun

TABLE, NUMBERS = "runs.md", "runs.json"


def write(folder: Path, runs: Sequence[ComparedRun]) -> None:
    """Writes runs.md and runs.json into a folder, which is made if needed."""
    folder.mkdir(parents=True, exist_ok=True)
    numbers = json.dumps([asdict(run) for run in runs], indent=2)
    files.write_text(folder / NUMBERS, numbers + "\n")
    parts = ["# Runs compared", markdown(table(runs)), explanation()]
    files.write_text(folder / TABLE, "\n\n".join(parts) + "\n")


def table(runs: Sequence[ComparedRun]) -> Table:
    """A row for each run, the best first; a column for each clip if there are several."""
    clips = list(runs[0].clips)
    shown = clips if len(clips) > 1 else []
    heading = ["run", "elpd", "±", "below the best", "±", "parameters", "unreliable blocks"]
    rows = [heading + [f"elpd of clip {clip}" for clip in shown]]
    for run in runs:
        cells = [run.name, f"{run.elpd:.1f}", f"{run.error:.1f}", f"{run.behind:.1f}"]
        cells += [f"{run.behind_error:.1f}", f"{run.parameters:.1f}", str(run.unreliable)]
        rows.append([*cells, *(f"{run.clips[clip]:.1f}" for clip in shown)])
    return rows


def explanation() -> str:
    """What the columns mean."""
    return (
        "elpd is the expected log predictive density of the captured motion: blocks of "
        f"{SECONDS:g} s, each predicted from the others by Pareto-smoothed importance sampling. "
        "Larger is better. A difference of less than twice its standard error (±) says little, and "
        "unreliable blocks make it worse. Parameters is their effective number."
    )
