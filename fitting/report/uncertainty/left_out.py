"""How well blocks of frames are predicted from the others: a sentence, and a section."""

import math

import numpy as np

from fitting.inference.sampling.blocks import SECONDS, BlockLogLikelihood, LeaveOneOut
from fitting.report.formatting import Table, markdown

SHOWN = 5  # blocks in the table
CORRELATED = 0.3  # between neighbouring blocks, from which the standard error is too small


def sentence(found: LeaveOneOut) -> str:
    """The figure, and how far it can be trusted."""
    count = len(found.pareto_k)
    text = (
        f"Log predictive density of {count} blocks of {SECONDS:g} s, each left out in turn: "
        f"{found.elpd:.1f} ± {found.error:.1f}; effective number of parameters "
        f"{found.parameters:.1f}."
    )
    if found.unreliable:
        text += (
            f" Unreliable for {found.unreliable} of them, whose Pareto k is above {found.max_k:.2g}"
            ": the fit hangs on them."
        )
    if found.neighbours > CORRELATED:
        text += (
            f" Neighbouring blocks correlate by {found.neighbours:.2f}, so that the standard error "
            "is too small."
        )
    return text


def section(found: LeaveOneOut, blocks: BlockLogLikelihood) -> list[str]:
    """Paragraphs of Markdown."""
    correlation = "unknown" if math.isnan(found.neighbours) else f"{found.neighbours:.2f}"
    return [
        "### Blocks of frames left out",
        sentence(found),
        f"By Pareto-smoothed importance sampling, without another fit. Blocks last {SECONDS:g} s, "
        "two steps of a walk, because what one frame misses its neighbours give away; the "
        f"correlation of neighbouring blocks is {correlation}. With "
        "`jaxik compare --runs`, fits of several systems to the same clips are compared by this "
        "figure. The blocks that are predicted worst:",
        markdown(worst_blocks(found, blocks)),
    ]


def worst_blocks(found: LeaveOneOut, blocks: BlockLogLikelihood) -> Table:
    """The blocks with the lowest predictive density for each second."""
    table = [["clip", "from", "to", "log predictive density per s", "Pareto k"]]
    seconds = np.maximum(blocks.end - blocks.start, 1e-9)
    for i in np.argsort(found.elpd_of_block / seconds)[:SHOWN]:
        mark = "" if found.pareto_k[i] <= found.max_k else "!"
        table.append(
            [
                str(blocks.clip[i]),
                f"{blocks.start[i]:.1f} s",
                f"{blocks.end[i]:.1f} s",
                f"{found.elpd_of_block[i] / seconds[i]:.1f}",
                f"{found.pareto_k[i]:.2f}{mark}",
            ]
        )
    return table
