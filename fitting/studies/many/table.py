"""The table of many fits: a row for each, as CSV and, with pyarrow, as Parquet.

Parameters of different experiments share the table: what a fit has not is empty.
"""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

from fitting.runtime import files

from .rows import Row

CSV, PARQUET = "fits.csv", "fits.parquet"
MISSING = f"no {PARQUET}, as pyarrow is not installed: pip install 'jaxik[parquet]'"
Cells: TypeAlias = dict[str, Any]  # by column
OUTCOME = (
    "converged", "fits", "verdict", "cost_before", "cost", "starts", "agreeing", "steps",
    "search_seconds", "frames",
)  # fmt: skip
EFFORT = ("seconds", "waited", "cpu_seconds", "peak_mb", "host", "process")
WHAT = ("experiment", "clip", "seed", "run", "state", "error")


def columns(rows: Sequence[Row]) -> list[str]:
    """The names of all columns; those of parameters last, in the order in which they appear."""
    parameters = dict.fromkeys(
        name for row in rows if "outcome" in row for name in row["outcome"]["parameters"]
    )
    each = [f"{name}{ending}" for name in parameters for ending in ("", ".low", ".high", ".known")]
    return [*WHAT, "notes", *OUTCOME, *EFFORT, *each]


def cells(row: Row) -> Cells:
    """A row of the table; what it has not is left out.

    Of each parameter: its value under its name, both ends of its 95 % interval, and whether the
    clip determines it.
    """
    content: Cells = {key: row[key] for key in WHAT} | {"notes": "; ".join(row["notes"])}
    if "outcome" in row:
        outcome = row["outcome"]
        content |= {key: outcome[key] for key in OUTCOME}
        for name, fitted in outcome["parameters"].items():
            low, high = fitted["interval"]
            content |= {name: fitted["value"], f"{name}.low": low, f"{name}.high": high}
            content[f"{name}.known"] = fitted["determined"]
    if "effort" in row:
        content |= {key: row["effort"][key] for key in EFFORT}
    return content


def write(folder: Path, rows: Sequence[Row]) -> list[str]:
    """Writes the table; returns the names of its files, without that for which pyarrow is missing.

    Raises:
        ValueError: the folder cannot be written to.
    """
    names, content = columns(rows), [cells(row) for row in rows]
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(content)
    files.write_text(folder / CSV, text.getvalue())
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        return [CSV]
    table = pyarrow.table({name: [row.get(name) for row in content] for name in names})
    files.write(folder / PARQUET, lambda path: pyarrow.parquet.write_table(table, path))
    return [CSV, PARQUET]
