"""Fits of several systems to the same motion, compared by what they predict of it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fitting.inference.sampling import blocks, inference_data
from fitting.inference.sampling.blocks import BlockLogLikelihood, LeaveOneOut
from fitting.studies import run_folder


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


def compare_runs(folders: Sequence[Path]) -> list[ComparedRun]:
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
    found = {name: _leave_one_out(name, each) for name, each in read.items()}
    best = max(found, key=lambda name: found[name].elpd)
    order = sorted(found, key=lambda name: -found[name].elpd)
    return [_compare(name, found[name], found[best], read[name]) for name in order]


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
    found = blocks.leave_one_out(read)
    if found is None:
        raise ValueError(
            f"{name}: {len(read.values)} draws of {len(read.clip)} blocks of {blocks.SECONDS:g} s; "
            f"wanted {blocks.MIN_DRAWS} draws and two blocks or more; sample longer"
        )
    return found


def _compare(
    name: str, found: LeaveOneOut, best: LeaveOneOut, read: BlockLogLikelihood
) -> ComparedRun:
    below = best.elpd_of_block - found.elpd_of_block
    return ComparedRun(
        name=name,
        elpd=found.elpd,
        error=found.error,
        behind=float(below.sum()),
        behind_error=float(math.sqrt(below.size) * below.std(ddof=1)),
        parameters=found.parameters,
        unreliable=found.unreliable,
        clips={
            int(clip): float(found.elpd_of_block[read.clip == clip].sum())
            for clip in np.unique(read.clip)
        },
    )
