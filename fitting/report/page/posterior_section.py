"""The posterior on the page of its fit, which sampling adds and replaces."""

from collections.abc import Sequence
from pathlib import Path

from fitting.report.formatting import Table
from fitting.runtime import files

from . import rendering

START, END = "<!-- posterior -->", "<!-- /posterior -->"  # no text of a user can hold them


def insert(run: Path, warnings: Sequence[str], lines: Sequence[str], table: Table) -> None:
    """Shows a posterior on the page of a run, in place of an older one; not without a page.

    Args:
        run: the folder of the run.
        warnings: where the chain contradicts the fit, a sentence each.
        lines: how the sampling went, likewise.
        table: the posterior of the parameters.
    """
    path = run / rendering.PAGE
    if not path.is_file():
        return
    page = path.read_text(encoding="utf-8", errors="replace")  # what is damaged may stay
    before, start, rest = page.partition(START)
    _, end, after = rest.partition(END)
    if end:
        section = rendering.fragment(
            "posterior.html", warnings=warnings, lines=lines, posterior=table
        )
        files.write_text(path, f"{before}{start}\n{section}\n{end}{after}")
