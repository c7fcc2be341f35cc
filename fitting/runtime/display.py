"""Results in notebooks: as HTML, and as tables of pandas.

pandas is optional; `pip install "jaxik[tables]"` brings it.
"""

import functools
import html as escaping
import importlib
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas


RENDERERS = "fitting.studies.notebook"


def data_frame(rows: Iterable[Mapping[str, object]], index: str) -> "pandas.DataFrame":
    """A table with a row for each mapping, and a column for each of their keys.

    Args:
        rows: by column.
        index: the column that names the rows.

    Raises:
        ImportError: pandas is not installed.
    """
    try:
        import pandas
    except ImportError:
        raise ImportError('this needs pandas: pip install "jaxik[tables]"') from None
    return pandas.DataFrame(list(rows)).set_index(index)


@functools.singledispatch
def html(result: object) -> str:
    """A result as HTML: its text, unless something else is registered for its type."""
    return f"<pre>{escaping.escape(repr(result))}</pre>"


class Displayable:
    """A result that notebooks show as tables and pictures."""

    def _repr_html_(self) -> str:
        importlib.import_module(RENDERERS)
        return html(self)
