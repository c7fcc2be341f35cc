"""What notebooks show of an experiment: its clips and what is free."""

import base64
import io
from collections.abc import Sequence

from markupsafe import Markup, escape
from matplotlib.figure import Figure

import jaxik
from fitting.experiment.experiment import Experiment
from fitting.inference.sample.posterior import Posterior
from fitting.report.document import Document, Grid, Plot, View, blocks_of
from fitting.report.formatting import Table, interval, number
from fitting.runtime import display
from jaxik.maths import parameter_tree

from .comparison import Comparison, document
from .fit import fit_plots, fit_report, fit_tables
from .fit.fit import Fit
from .sample import posterior_report

LEFT = Markup(' style="text-align: left"')
VIEW = Markup('<iframe title="{}" style="{}" srcdoc="{}"></iframe>')
WIDE = "width: 100%; height: 800px; border: 0"
PICTURE = Markup('<img style="max-width: 100%" alt="{}" src="data:image/png;base64,{}">')
MOST_PIXELS = 1200  # of a picture's width


@display.html.register
def experiment_html(experiment: Experiment) -> str:
    """Tables of the clips, and of the free parameters with their ranges."""
    preset = f"{experiment.preset}{' (faithful)' if experiment.faithful else ''}"
    system = f"preset {preset}" if experiment.system is None else "a system in memory"
    rules = [f"{stage} by {rule}" for stage, rule in experiment.rules.items()]
    lines = [", ".join([system, *rules]) + "."]
    if _rig(experiment) is None and experiment.system is None and experiment.body == "clip":
        lines.append("Numbers are for an adult; a fit scales them to the body of its first clip.")
    return page(
        f"Experiment: {experiment.name}",
        sentences(lines),
        table(_clips(experiment)),
        table(_free(experiment)),
    )


def _clips(experiment: Experiment) -> Table:
    rows = [["captured motion", "flat animation", "terrain", "from", "to"]]
    for entry in experiment.clips:
        base = "made of the captured motion" if entry.base is None else entry.base.name
        end = "its end" if entry.end is None else f"{number(entry.end)} s"
        rows.append(
            [entry.reference.name, base, entry.terrain.name, f"{number(entry.start)} s", end]
        )
    return rows


def _rig(experiment: Experiment) -> jaxik.Rig | None:
    """Of the first clip, if that is in memory."""
    loaded = experiment.clips[0].loaded
    return None if loaded is None else loaded.reference.rig


def _free(experiment: Experiment) -> Table:
    rig = _rig(experiment)
    ik = experiment.starting_system(rig)
    system = experiment.with_capture(ik)
    declared = parameter_tree.declarations(system)
    rows = [["free parameter", "value", "unit", "range", "meaning"]]
    for free in experiment.free_parameters(ik, rig):
        meaning = declared[free.leaf]
        value = parameter_tree.shown(system, free.leaf)
        rows.append([free.name, value, meaning.unit, interval(free.low, free.high), meaning.doc])
    return rows


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


def motion(view: View | None, kind: str, title: str) -> Markup:
    """A view in 3-D inside the page; nothing where there is none."""
    return (
        Markup("")
        if view is None
        else VIEW.format(f"{kind}: {title}", WIDE, view.page(kind, title))
    )


def _row(tag: str, cells: Sequence[str]) -> Markup:
    marked = [Markup(f"<{tag}{LEFT}>") + escape(cell) + Markup(f"</{tag}>") for cell in cells]
    return Markup("<tr>") + Markup("").join(marked) + Markup("</tr>")


@display.html.register
def fit_html(fitted: Fit) -> str:
    """Whether it fits, the parameters with their intervals, and their profiles."""
    parameters = {parameter.name: parameter for parameter in fitted.problem.space.parameters}
    units = {row["name"]: row["unit"] for row in fitted.parameters}
    title = f"{fitted.experiment.name}: lowest cost by each parameter"
    profiles = fitted.identifiability.profiles
    figure = fit_plots.profiles(parameters, profiles, units, fitted.known_values, title)
    return page(
        f"Fit: {fitted.experiment.name}",
        sentences([fitted.solution.message, fitted.verdict.sentence]),
        table(fit_tables.parameter_table(fitted.parameters, fitted.known_values)),
        motion(fit_report.fit_view(fitted), "Fit", fitted.experiment.name),
        picture(figure, title),
    )


@display.html.register
def posterior_html(posterior: Posterior) -> str:
    """How the sampling went, the parameters with their intervals, and the corner plot."""
    title = "posterior of the parameters"
    figure = posterior_report.corner(posterior, posterior.names, {}, None, title)
    return page(
        "Posterior",
        sentences([posterior.message]),
        table(posterior_report.posterior_table(posterior, None, {})),
        motion(_draws(posterior), "Posterior", "motions of draws"),
        picture(figure, title),
    )


def _draws(posterior: Posterior) -> View | None:
    if posterior.source is None:
        return None
    problem, clips = posterior.source
    return posterior_report.draws_view(posterior, problem, clips) if clips else None


@display.html.register
def comparison_html(comparison: Comparison) -> str:
    """What it found, the measures of each system, and its motion."""
    return document_html(document(comparison))


def document_html(document: Document) -> str:
    """The document in brief, with its view and its plots."""
    parts = [motion(document.view, document.kind, document.title)]
    for block in blocks_of(document.sections):
        if isinstance(block, Grid) and block.brief:
            parts.append(table(block.rows))
        elif isinstance(block, Plot) and block.draw is not None:
            parts.append(picture(block.draw(), block.caption))
    lines = [f"{document.verdict}.", *document.sentences]
    return page(f"{document.kind}: {document.title}", sentences(lines), *parts)
