"""Pages as HTML: one file each, with styles, scripts and pictures in it."""

import base64
import io
import json
import re
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import metadata, resources
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape
from PIL import Image

from fitting.experiment.experiment import ClipEntry, Experiment

from . import style
from .formatting import Table

PACKAGE = "fitting.report"
PAGE = "report.html"  # in the folder of a run
STYLES = ("page.css", "viewer.css")
SCRIPTS = ("theme.js",)
VIEWER_SCRIPTS = (  # in the order in which they use each other
    "matrices.js",
    "skeletons.js",
    "skins.js",
    "bodies.js",
    "shaders.js",
    "stage.js",
    "camera.js",
    "figures.js",
    "timeline.js",
    "curves.js",
    "layers.js",
    "worker.js",
    "live.js",
    "player.js",
)
PROGRAM_SCRIPTS = ("contacts.js", "program.js")  # of a page that a program serves

COLOURS = {  # of the plots, as variables of the style sheet
    "captured": style.CAPTURED,
    "fitted": style.AFTER,
    "before": style.BEFORE,
    "determined": style.PRIOR,
}

MAX_BYTES = 2_500_000  # of all pictures of a page
SMALLER = 0.8  # of its width, as often as it takes


def render(
    template: str,
    clips: Sequence[Mapping[str, Any] | None],
    *,
    is_remote: bool = False,
    **content: Any,
) -> str:
    """A page as HTML. What is not marked as HTML is escaped.

    Args:
        template: name of its file.
        clips: what the view shows, as `motion_data.pack` gives it; none for a page without a view.
        is_remote: whether a program serves the page, which solves its clips, and has those that are
            None.
        content: the template's variables.
    """
    viewer = (*VIEWER_SCRIPTS, *(PROGRAM_SCRIPTS if is_remote else ()), "page.js")
    scripts = (*SCRIPTS, *viewer) if clips else SCRIPTS
    return (
        _environment()
        .get_template(template)
        .render(
            **content,
            data=as_json({"clips": clips}),
            is_remote=is_remote,
            is_live=any(clip.get("live") for clip in clips if clip),
            colours=COLOURS,
            version=metadata.version("jaxik"),
            style=Markup(_assets(STYLES)),
            script=Markup(_assets(scripts)),
        )
    )


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
    environment.filters["kind"] = lambda block: type(block).__name__
    return environment


def _assets(names: tuple[str, ...]) -> str:
    folder = resources.files(PACKAGE) / "assets"
    return "\n".join((folder / name).read_text(encoding="utf-8") for name in names)


class Picture(NamedTuple):
    """A picture that is part of a page."""

    caption: str
    source: str
    """As a data URL."""
    width: int
    height: int
    size: int
    """Bytes, before base64."""


def embed(folder: Path, captions: Mapping[str, str]) -> dict[str, Picture]:
    """Pictures of a folder, those that are too large scaled down: all are `MAX_BYTES` at most.

    Args:
        folder: that has them, as PNG.
        captions: by file name.
    """
    room = MAX_BYTES // max(len(captions), 1)
    return {name: _embed(folder / name, caption, room) for name, caption in captions.items()}


def _embed(path: Path, caption: str, room: int) -> Picture:
    content = path.read_bytes()
    with Image.open(path) as original:
        size = original.size
        while len(content) > room:
            size = max(1, round(SMALLER * size[0])), max(1, round(SMALLER * size[1]))
            file = io.BytesIO()
            original.convert("RGB").resize(size, Image.Resampling.LANCZOS).save(file, "PNG")
            content = file.getvalue()
    encoded = base64.b64encode(content).decode("ascii")
    return Picture(caption, f"data:image/png;base64,{encoded}", *size, len(content))


def system(experiment: Experiment) -> str:
    """Its preset, with rules that are not the preset's."""
    rules = [f"{stage} by {rule}" for stage, rule in experiment.rules.items()]
    preset = experiment.preset + (", faithful to its original" if experiment.faithful else "")
    return ", ".join([preset, *rules])


def loss_and_seed(experiment: Experiment) -> list[str]:
    """A row with the loss and the seed."""
    return ["Loss and seed", f"{experiment.loss}, {experiment.seed}"]


def rows(experiment: Experiment) -> Table:
    """A name and a text each: the system, what is free, the clips, the loss."""
    free = ", ".join(f"`{name}`" for name in experiment.free) or "none"
    table = [
        ["System", system(experiment)],
        [f"Free parameters ({len(experiment.free)})", free],
    ]
    if experiment.capture:
        of_capture = ", ".join(f"`{name}`" for name in experiment.capture)
        table.append([f"Of the captures ({len(experiment.capture)})", of_capture])
    for number, entry in enumerate(experiment.clips, 1):
        heading = f"Clip {number}" if len(experiment.clips) > 1 else "Clip"
        table.append([heading, _clip(entry)])
    return [*table, loss_and_seed(experiment)]


def _clip(entry: ClipEntry) -> str:
    text = f"{entry.reference.name} on {entry.terrain.name}"
    if entry.start or entry.end is not None:
        end = "the end" if entry.end is None else f"{entry.end:g} s"
        text += f", from {entry.start:g} s to {end}"
    base = "made from it" if entry.base is None else entry.base.name
    subject = "" if entry.subject is None else f"; subject {entry.subject}"
    return f"{text}; flat animation {base}{subject}"
