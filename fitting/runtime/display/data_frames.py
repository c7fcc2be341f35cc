"""Rows of results as pandas tables, for those who go on with them there.

pandas is optional; `pip install "jaxik[tables]"` brings it.
"""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas


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
