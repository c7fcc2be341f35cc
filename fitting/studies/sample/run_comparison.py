"""Fits of several systems to the same motion, compared by what they predict of it."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from fitting.inference.sample import blocks, inference_data
from fitting.inference.sample.blocks import SECONDS, BlockLogLikelihood, LeaveOneOut
from fitting.report.document import Document, Finding, Grid, Points, Section, Text
from fitting.report.formatting import Table, listed
from fitting.runtime import activity, files
from fitting.studies.fit import run_folder
from fitting.studies.output import output_folder, publish

TABLE, NUMBERS = "runs.md", "runs.json"

CLEAR = 2.0  # standard errors, from which a difference says something
COLUMNS = (
    "elpd is the expected log predictive density of the captured motion: blocks of "
    f"{SECONDS:g} s, each predicted from the others by Pareto-smoothed importance sampling. "
    "Larger is better. A difference of less than twice its standard error (±) says little, and "
    "unreliable blocks make it worse. Parameters is their effective number."
)
LIMITS = [
    "The order is that of these runs on this motion: the best of them may still not fit it, which "
    "the page of its run says.",
    "Blocks of one motion depend on each other a little; errors may be larger than they are said "
    "to be.",
]


@dataclass(frozen=True)
class ComparedRun:
    """One of several runs that were fitted to the same motion."""

    name: str
    elpd: float
    """Expected log predictive density of blocks of frames, each left out in turn."""
    error: float
    """Its standard error."""
    behind: float
    """Below the best run's; 0 for the best."""
    behind_error: float
    """Standard error of this difference, block by block."""
    parameters: float
    """Effective number of them."""
    unreliable: int
    """Blocks whose figure is unreliable."""
    clips: Mapping[int, float]
    """The part of each clip, from 1, in the expected log predictive density."""


def compare_posteriors(folders: Sequence[Path]) -> list[ComparedRun]:
    """Compares sampled runs, the best one first.

    Raises:
        ImportError: ArviZ is not installed.
        ValueError: there are fewer than two, one has no log-likelihood, or they were not fitted
            to the same motion.
    """
    if len(set(folders)) < max(2, len(folders)):
        raise ValueError(f"runs are {[str(f) for f in folders]}; wanted two or more different ones")
    read = {str(folder): _read(folder) for folder in folders}
    first, *others = read
    for name in others:
        if read[name].data != read[first].data:
            raise ValueError(
                f"{first} and {name} were fitted to different motion, or count different kinds of "
                "residuals; wanted the same clips, frames and kinds, so that predictions of the "
                "same motion are compared"
            )
    left_out = {name: _leave_one_out(name, each) for name, each in read.items()}
    best = max(left_out, key=lambda name: left_out[name].elpd)
    order = sorted(left_out, key=lambda name: -left_out[name].elpd)
    return [_compare(name, left_out[name], left_out[best], read[name]) for name in order]


def _read(folder: Path) -> BlockLogLikelihood:
    run_folder.load_fit(folder)
    path = folder / run_folder.INFERENCE_DATA
    if not path.is_file():
        raise ValueError(
            f"{folder}: no {path.name}; `jaxik sample {folder}` makes it, with the packages of pip "
            'install "jaxik[posterior]"'
        )
    return inference_data.read_blocks(path)


def _leave_one_out(name: str, read: BlockLogLikelihood) -> LeaveOneOut:
    left_out = blocks.leave_one_out(read)
    if left_out is None:
        raise ValueError(
            f"{name}: {len(read.values)} draws of {len(read.clip)} blocks of {blocks.SECONDS:g} s; "
            f"wanted {blocks.MIN_DRAWS} draws and two blocks or more; sample longer"
        )
    return left_out


def _compare(
    name: str, left_out: LeaveOneOut, best: LeaveOneOut, read: BlockLogLikelihood
) -> ComparedRun:
    below = best.elpd_of_block - left_out.elpd_of_block
    return ComparedRun(
        name=name,
        elpd=left_out.elpd,
        error=left_out.error,
        behind=float(below.sum()),
        behind_error=float(math.sqrt(below.size) * below.std(ddof=1)),
        parameters=left_out.parameters,
        unreliable=left_out.unreliable,
        clips={
            int(clip): float(left_out.elpd_of_block[read.clip == clip].sum())
            for clip in np.unique(read.clip)
        },
    )


def table(runs: Sequence[ComparedRun]) -> Table:
    """A row for each run, the best first; a column for each clip if there are several."""
    clips = list(runs[0].clips)
    listed_clips = clips if len(clips) > 1 else []
    heading = ["run", "elpd", "±", "below the best", "±", "parameters", "unreliable blocks"]
    rows = [heading + [f"elpd of clip {clip}" for clip in listed_clips]]
    for run in runs:
        cells = [run.name, f"{run.elpd:.1f}", f"{run.error:.1f}", f"{run.behind:.1f}"]
        cells += [f"{run.behind_error:.1f}", f"{run.parameters:.1f}", str(run.unreliable)]
        rows.append([*cells, *(f"{run.clips[clip]:.1f}" for clip in listed_clips)])
    return rows


def document(runs: Sequence[ComparedRun]) -> Document:
    """What a comparison of runs says, the best run first."""
    tied = undecided(runs)
    return Document(
        file=TABLE,
        kind="Sampled fits to the same motion, by what they predict",
        title="Runs compared",
        verdict="Undecided" if tied else "Decided",
        good=not tied,
        findings=findings(runs),
        sections=[
            Section(
                "What the runs predict", [Grid(table(runs), "Runs"), Text(COLUMNS, brief=True)]
            ),
            Section("Limits of the data", [Points(LIMITS)]),
        ],
        setup=[["Runs", ", ".join(f"`{run.name}`" for run in runs)]],
        files={NUMBERS: "all numbers"},
    )


def undecided(runs: Sequence[ComparedRun]) -> list[ComparedRun]:
    """Runs whose predictions do not differ clearly from those of the best one."""
    return [run for run in runs[1:] if run.behind < CLEAR * run.behind_error]


def findings(runs: Sequence[ComparedRun]) -> list[Finding]:
    """Whether the figures are reliable, which run is best and by how much, and which is last."""
    best, second, last = runs[0], runs[1], runs[-1]
    reliable = Finding("All blocks are predicted reliably from the others.")
    if shaky := [f"`{run.name}` ({run.unreliable})" for run in runs if run.unreliable]:
        reliable = Finding(
            f"The figures are not fully reliable: there are blocks that the others do not predict "
            f"reliably, of {listed(shaky)}.",
            bad=True,
        )
    behind = f"{second.behind:.1f} ± {second.behind_error:.1f}"
    order = Finding(f"`{best.name}` predicts best; `{second.name}` is {behind} below.")
    if tied := [f"`{run.name}`" for run in undecided(runs)]:
        order = Finding(
            f"The motion does not tell `{best.name}`, which predicts best, from {listed(tied)}: "
            f"`{second.name}` is {behind} below, less than {CLEAR:g} standard errors.",
            bad=True,
        )
    furthest = (
        f"`{last.name}` predicts worst, {last.behind:.1f} ± {last.behind_error:.1f} below"
        if len(runs) > 2
        else f"The expected log predictive density of `{best.name}` is {best.elpd:.1f} ± "
        f"{best.error:.1f}"
    )
    numbers = [run.parameters for run in runs]
    used = f"the runs use {min(numbers):.1f} to {max(numbers):.1f} effective parameters"
    return [reliable, order, Finding(f"{furthest}; {used}.")]


def compare_runs(runs: Sequence[str | Path], output: str | Path | None = None) -> list[ComparedRun]:
    """Compares sampled runs of several systems by what they predict of the same motion.

    Args:
        runs: folders that `fit` and `sample` have filled.
        output: folder for the table, the numbers and the page.

    Raises:
        ValueError: as `compare_posteriors`, or the folder cannot be made.
    """
    with output_folder(output) as folder:
        with activity.announced(f"Comparing {len(runs)} runs"):
            compared = compare_posteriors([Path(run) for run in runs])
        if folder is not None:
            numbers = json.dumps([asdict(run) for run in compared], indent=2)
            files.write_text(folder / NUMBERS, numbers + "\n")
        publish(folder, document(compared))
        return compared
