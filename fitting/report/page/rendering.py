"""Fills a page's template; styles, scripts and data become part of the one file."""

import json
import re
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import metadata, resources
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from fitting.report.plots import style
from fitting.runtime import files

PACKAGE = "fitting.report"
PAGE = "report.html"  # in the folder of a run
STYLES = ("page.css", "viewer.css")
SCRIPTS = ("theme.js",)
VIEWER_SCRIPTS = (  # in the order in which they use each other
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
    "determined": style.PRIOR,
}


def render(template: str, clips: Sequence[Mapping[str, Any]], **content: Any) -> str:
    """A page as HTML. What is not marked as HTML is escaped.

    Args:
        template: name of the file in `templates`.
        clips: what the view shows, as `motion_data.pack` gives it; none for a page without a view.
        content: the template's variables.
    """
    scripts = (*SCRIPTS, *VIEWER_SCRIPTS) if clips else SCRIPTS
    return fragment(
        template,
        **content,
        data=as_json({"clips": clips}),
        colours=COLOURS,
        version=metadata.version("jaxik"),
        style=Markup(_assets(STYLES)),
        script=Markup(_assets(scripts)),
    )


def fragment(template: str, **content: Any) -> str:
    """A part of a page as HTML. What is not marked as HTML is escaped."""
    return _environment().get_template(template).render(**content)


def write(path: Path, template: str, clips: Sequence[Mapping[str, Any]], **content: Any) -> None:
    """Writes a page; see `render`."""
    files.write_text(path, render(template, clips, **content))


def prose(text: str) -> Markup:
    """A sentence or a cell as HTML: what Markdown marks as code or as strong is so."""
    html = str(escape(text))
    html = re.sub(r"`([^`]+)`", r"<code>\1</code>", html)
    return Markup(re.sub(r"\*\*([^*]+)\*\*", r"<strong>\1</strong>", html))


def as_json(data: Any) -> Markup:
    """JSON that can stand in a script element: no text in it can end the element."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c").replace("&", "\\u0026"))


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader(PACKAGE),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["prose"] = prose
    return environment


def _assets(names: tuple[str, ...]) -> str:
    folder = resources.files(PACKAGE) / "assets"
    return "\n".join((folder / name).read_text(encoding="utf-8") for name in names)
