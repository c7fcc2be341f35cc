"""What the panel says of a solution: its cost, and how its feet stand."""

import math
import re
from collections.abc import Mapping

from fitting.analysis.placement import Placement
from fitting.report.formatting import markdown, percent
from fitting.viewer.solving import Solved, Solver

MARKS = re.compile(r"([\\`*_{}\[\]<>()#+.!|~&-])")
HEADING = ["", "in the ground", "deepest", "slide", "largest"]


def literal(text: str) -> str:
    """Somebody's text in Markdown, where it stays text: viser would run a script in it."""
    return MARKS.sub(r"\\\1", text)


def cost_text(solver: Solver, solved: Solved, costs: Mapping[str, float]) -> str:
    """The cost, and how the feet of each motion stand, in Markdown.

    Args:
        solver: of the clip.
        solved: what the system makes of it.
        costs: of systems to compare with, by name.
    """
    motions = {"before": solver.before, "after": solved.motion, "captured": solver.captured}
    rows = [[name, *_row(drawn.placement)] for name, drawn in motions.items() if drawn is not None]
    table = markdown([HEADING, *rows])
    return "\n\n".join([_cost(solved, costs), table])


def _cost(solved: Solved, costs: Mapping[str, float]) -> str:
    took = f"solved in {1000 * solved.seconds:.0f} ms"
    if solved.cost is None:
        return took[0].upper() + took[1:]
    others = ", ".join(f"{name} {cost:.6g}" for name, cost in costs.items())
    return f"**Cost {solved.cost:.6g}**{f' ({others})' if others else ''}, {took}"


def _row(placed: Placement) -> list[str]:
    lengths = (placed.deepest.value, placed.slide, placed.largest_slide.value)
    return [_percent(placed.sunk), *map(_centimetres, lengths)]


def _percent(share: float) -> str:
    return "–" if math.isnan(share) else percent(share)


def _centimetres(length: float) -> str:
    return "–" if math.isnan(length) else f"{100 * max(length, 0.0):.1f} cm"
