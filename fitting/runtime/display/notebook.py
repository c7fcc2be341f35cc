"""How results show themselves in a notebook.

A result says that it does by deriving from `Shown`; what it shows is registered with `html`, in
`fitting.report.notebook`, which may use the tables and plots of reports. That package is imported
when something is shown, and not before.
"""

import functools
import html as escaping
import importlib

RENDERERS = "fitting.report.notebook"


@functools.singledispatch
def html(result: object) -> str:
    """A result as HTML: its text, unless something else is registered for its type."""
    return f"<pre>{escaping.escape(repr(result))}</pre>"


class Shown:
    """A result that notebooks show as tables and pictures."""

    def _repr_html_(self) -> str:
        importlib.import_module(RENDERERS)
        return html(self)
