"""Tables and pictures as HTML that stands in a page of somebody else."""

import base64
import io
from collections.abc import Sequence

from markupsafe import Markup, escape
from matplotlib.figure import Figure

from fitting.report.formatting import Table

LEFT = Markup(' style="text-align: left"')
PICTURE = Markup('<img style="max-width: 100%" alt="{}" src="data:image/png;base64,{}">')
MOST_PIXELS = 1200  # of a picture's width


def page(title: str, *parts: str) -> str:
    """A title and what follows it."""
    return Markup("<div><strong>{}</strong>{}</div>").format(title, Markup("").join(parts))


def sentences(lines: Sequence[str]) -> Markup:
    """A paragraph of sentences."""
    return Markup("<p>{}</p>").format(" ".join(lines)) if lines else Markup("")


def table(rows: Table) -> Markup:
    """A table, the heading first."""
    heading, *body = rows
    lines = [_row("th", heading), *(_row("td", row) for row in body)]
    return Markup("<table>{}</table>").format(Markup("").join(lines))


def picture(figure: Figure, description: str) -> Markup:
    """A figure as a picture inside the page."""
    out = io.BytesIO()
    dots = min(100.0, MOST_PIXELS / figure.get_size_inches()[0])
    figure.savefig(out, format="png", dpi=dots, bbox_inches="tight", facecolor="white")
    return PICTURE.format(description, base64.b64encode(out.getvalue()).decode())


def _row(tag: str, cells: Sequence[str]) -> Markup:
    marked = [Markup(f"<{tag}{LEFT}>") + escape(cell) + Markup(f"</{tag}>") for cell in cells]
    return Markup("<tr>") + Markup("").join(marked) + Markup("</tr>")
