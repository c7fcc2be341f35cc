"""Fills a page's template; styles, scripts and data become part of the one file."""

import json
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from fitting.report.plots import style
from fitting.runtime import files

PACKAGE = "fitting.report.page"
STYLES = ("page.css", "viewer.css")
SCRIPTS = (  # in the order in which they use each other
    "matrices.js",
    "skeletons.js",
    "shaders.js",
    "stage.js",
    "camera.js",
    "timeline.js",
    "player.js",
)
COLOURS = {  # of the plots, as variables of the style sheet
    "captured": style.CAPTURED,
    "fitted": style.AFTER,
    "before": style.BEFORE,
    "animated": style.SLIDING,
    "determined": style.PRIOR,
}


def render(template: str, data: Any, **content: Any) -> str:
    """A page as HTML. What is not marked as HTML is escaped.

    Args:
        template: name of the file in `templates`.
        data: for the scripts, as JSON holds it.
        content: the template's variables.
    """
    return fragment(
        template,
        **content,
        data=as_json(data),
        colours=COLOURS,
        style=Markup(_assets(STYLES)),
        script=Markup(_assets(SCRIPTS)),
    )


def fragment(template: str, **content: Any) -> str:
    """A part of a page as HTML. What is not marked as HTML is escaped."""
    return _environment().get_template(template).render(**content)


def write(path: Path, template: str, data: Any, **content: Any) -> None:
    """Writes a page; see `render`."""
    files.write_text(path, render(template, data, **content))


def as_json(data: Any) -> Markup:
    """JSON that can stand in a script element: no text in it can end the element."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c").replace("&", "\\u0026"))


@cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader(PACKAGE),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _assets(names: tuple[str, ...]) -> str:
    folder = resources.files(PACKAGE) / "assets"
    return "\n".join((folder / name).read_text(encoding="utf-8") for name in names)
