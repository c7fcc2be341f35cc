"""Ablation: an experiment as it is and without each of its rules, cross-validated.

Every clip is cut into parts. A variant is fitted on all parts but one and measured on that one, for
each part in turn, at the clip's own rate; then it is fitted and measured on everything. The fit
does not see the part that is held out, but its animation is still played, so that feet have their
strides over the cuts and all fits of a variant share their compiled programs. Each finished fit is
written at once to `contribution.json`, from which an interrupted call continues.
"""

import csv
import hashlib
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, replace
from pathlib import Path
from typing import NamedTuple, NotRequired, TypedDict

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fitting.clips import Clip, edit
from fitting.experiment import file_tables
from fitting.experiment.experiment import ClipEntry, Experiment
from fitting.experiment.experiment_files import experiment_to_toml
from fitting.experiment.file_tables import COMPLETE, Ablation
from fitting.experiment.in_memory import with_files
from fitting.experiment.problems import ClipData, load_clip_data, problem_from_clips
from fitting.experiment.systems import leaf_names
from fitting.ground.ground_path import place_root
from fitting.inference.sample.blocks import SamplerSettings
from fitting.motion.accuracy import ACCURACY, IN_BRIEF, Accuracy, summarise
from fitting.report import pages, style
from fitting.report.document import (
    Block,
    Document,
    Finding,
    Grid,
    Heading,
    Plot,
    Points,
    Section,
    Terms,
    Text,
)
from fitting.report.formatting import Table, listed, meanings, number, transposed
from fitting.report.style import AFTER, CAPTURED, STAGES
from fitting.runtime import activity, files
from fitting.runtime.json_files import Finite, JsonFile, Store, checked
from fitting.runtime.precision import in_float64
from fitting.runtime.validation import Content, error_context

from .animations import capture_errors
from .campaign import Campaign
from .fit.assess import search_with_noise
from .fit.fit import SearchRecord, record_search
from .output import as_experiment, output_folder, publish

NUMBERS = "contribution.json"

TABLE, CELLS, FIGURE = "table.md", "table.csv", "contribution.png"

JOINTS = "pelvis, knees and ankles"
MARGIN = 5e-5  # m: what tables of cm with two digits round to 0

PANELS_PER_ROW = 4
ABLATED = STAGES[1]


@dataclass(frozen=True)
class Row:
    """A variant, fitted and measured."""

    key: str
    """Digest of everything the row follows from."""
    variant: str
    part: int
    """The part that was held out, from 1; 0 where everything was fitted and measured."""
    agreement: Accuracy
    values: Mapping[str, float]
    """Fitted, by name."""
    search: SearchRecord | None
    """None where nothing was free."""

    @property
    def converged(self) -> bool:
        """Whether its search has, if there was one."""
        return self.search is None or self.search["converged"]

    @property
    def message(self) -> str:
        """What the search says of its end."""
        return "Nothing is free." if self.search is None else self.search["message"]

    @property
    def seconds(self) -> float:
        """Duration of the search."""
        return 0.0 if self.search is None else self.search["seconds"]


class StoredRow(TypedDict):
    """The fields of a row that its file holds in another form than `Row`."""

    agreement: dict[str, Finite | None]
    """None for NaN, which JSON lacks."""
    search: NotRequired[Content | None]
    """Rows of earlier versions lack it."""


class Rows(TypedDict):
    """The content of `contribution.json`."""

    rows: list[StoredRow]


ROWS_FILE = JsonFile(
    Rows, "written by `jaxik ablate`", "delete it to begin anew, or name another folder"
)


@dataclass(frozen=True)
class Split:
    """What is fitted and what is measured."""

    name: str
    fitted: Sequence[tuple[ClipEntry, ClipData]]
    measured: Sequence[tuple[ClipData, slice]]
    """Clips, and the frames of them that are measured."""


class Task(NamedTuple):
    """A variant that is fitted and measured on a split."""

    key: str
    """That of its row."""
    name: str
    """Of the variant."""
    variant: Experiment
    part: int
    """That of its row."""
    split: Split

    def __str__(self) -> str:
        return f"{self.name}, {self.split.name}"


def fit_variants(
    experiment: Experiment, folder: Path | None = None, *, folds: int = 2
) -> list[Row]:
    """Fits and measures all variants, the complete one first, each on all splits of the clips.

    Rows in the folder are not repeated; those of other experiments, files and folds are dropped.

    Raises:
        ValueError: as `ablate`.
    """
    if folds < 2:
        raise ValueError(f"folds is {folds}; wanted 2 or more parts, of which one is held out")
    variants = {COMPLETE: experiment}
    variants |= {ablation.name: without(experiment, ablation) for ablation in experiment.without}
    for name, variant in variants.items():
        with error_context(name):
            _check(variant)
    stored = {row.key: row for row in read(folder)}
    with activity.announced("Reading the clips"):
        data = [load_clip_data(entry, None) for entry in experiment.placed_clips()]
    splits = list(split(experiment.clips, data, folds))
    content = "" if folder is None else _digest(experiment.clips)
    tasks = [
        Task(_key(variant, part.name, content), name, variant, number % len(splits), part)
        for name, variant in variants.items()
        for number, part in enumerate(splits, 1)
    ]

    def read_row(task: Task) -> Row | None:
        row = stored.pop(task.key, None)
        # The variant may have another name by now.
        return row and replace(row, variant=task.name, part=task.part)

    def write_row(task: Task, row: Row) -> None:
        _write(folder, [*campaign.finished(), row, *stored.values()])
        if sum(tasks[index].name == task.name for index in campaign.missing) == 1:
            jax.clear_caches()  # no other variant can use its programs

    title = f"Fitting {len(variants)} variants"
    campaign = Campaign(title, tasks, _fit, read_row, write_row, row_text)
    rows = campaign.run()
    _write(folder, rows)
    return rows


def _check(variant: Experiment) -> None:
    """Raises ValueError where a variant does not fit its preset."""
    ik = variant.starting_system()
    if variant.free:
        variant.space(ik)


def without(experiment: Experiment, ablation: Ablation) -> Experiment:
    """The experiment as an ablation changes it.

    Parameters that its rules do not have are dropped, and so are free ones that it fixes; free ones
    of its own are added.
    """
    changed = replace(experiment, rules={**experiment.rules, **ablation.rules})
    # Names that neither system has stay: they are reported as mistakes later.
    missing = set(leaf_names(experiment.preset_system())) - set(leaf_names(changed.preset_system()))
    fixed = {name: value for name, value in experiment.parameters.items() if name not in missing}
    free = {
        name: overrides
        for name, overrides in experiment.free.items()
        if name.partition("[")[0] not in missing | set(ablation.parameters)
    }
    return replace(
        changed, parameters={**fixed, **ablation.parameters}, free={**free, **ablation.free}
    )


def split(entries: Sequence[ClipEntry], data: Sequence[ClipData], folds: int) -> Iterator[Split]:
    """Each part held out in turn, then everything.

    Raises:
        ValueError: a foot never stands in one of the parts.
    """
    loaded = list(zip(entries, data, strict=True))
    for entry, clip in loaded:
        for part in range(folds):
            _check_stances(entry, clip.reference, part, folds)
    for part in range(folds):
        held_out = [_part(clip.reference, part, folds) for clip in data]
        fitted = [
            (entry, _hide(clip, frames))
            for (entry, clip), frames in zip(loaded, held_out, strict=True)
        ]
        measured = list(zip(data, held_out, strict=True))
        yield Split(f"part {part + 1} of {folds}", fitted, measured)
    yield Split("everything", loaded, [(clip, slice(None)) for clip in data])


def _check_stances(entry: ClipEntry, captured: Clip, part: int, folds: int) -> None:
    frames = _part(captured, part, folds)
    stands = captured.select(frames).stance_labels().any(axis=0)
    if not stands.all():
        foot = captured.rig.names[int(np.argmin(stands))]
        start, end = (frame / captured.fps for frame in (frames.start, frames.stop))
        raise ValueError(
            f"{entry.reference}: in part {part + 1} of {folds}, {start:.2f} s to {end:.2f} s, the "
            f"{foot} foot never stands; take fewer folds"
        )


def _part(clip: Clip, part: int, folds: int) -> slice:
    """The frames of a part; lengths of parts differ by one frame at most."""
    return slice(clip.frame_count * part // folds, clip.frame_count * (part + 1) // folds)


def _hide(data: ClipData, frames: slice) -> ClipData:
    """The clip with some frames of its reference masked."""
    reference = data.reference
    mask = reference.observed.copy()
    mask[frames] = False
    return data._replace(reference=replace(reference, mask=mask))


def _fit(task: Task) -> Row:
    """The row of a task."""
    _, _, variant, _, data = task
    values, record = {}, None
    first = data.measured[0][0].base.rig
    ik = variant.starting_system(first)
    if variant.free:
        with activity.announced(f"Fitting {task}"):
            fitted = replace(variant, clips=tuple(entry for entry, _ in data.fitted))
            resampled = (_at_rate(clip, variant.fps) for _, clip in data.fitted)
            problem = problem_from_clips(fitted, resampled)
            problem, solution = search_with_noise(problem, variant)
        if solution.interrupted:
            raise KeyboardInterrupt
        ik = problem.space.unpack(solution.u)
        values = dict(zip(solution.names, map(float, solution.values), strict=True))
        record = record_search(variant, problem, solution)
    with activity.announced("Measuring how far it is from the capture"):
        accuracy = summarise(
            [
                capture_errors(ik, clip, variant.size(clip.base.rig, first), frames)
                for clip, frames in data.measured
            ]
        )
    return Row(task.key, task.name, task.part, accuracy, values, record)


def _at_rate(data: ClipData, fps: float | None) -> ClipData:
    if fps is None:
        return data
    reference, base = edit.resample(data.reference, fps), edit.resample(data.base, fps)
    base, root = place_root(base, data.terrain, data.root.root)
    nearest = np.round(np.arange(base.frame_count) * data.base.fps / fps).astype(int)
    tracks = {name: values[nearest] for name, values in data.tracks.items()}
    return ClipData(reference, base, data.terrain, root, tracks)


def _digest(entries: Sequence[ClipEntry]) -> str:
    """A digest of all files that a fit reads."""
    digest = hashlib.sha256()
    for entry in entries:
        joints = entry.joints if isinstance(entry.joints, Path) else None
        paths = (entry.reference, entry.base, entry.terrain, entry.tracks, joints, entry.asf)
        for path in (*paths, *entry.contacts_files):
            digest.update(b"" if path is None else hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def _key(variant: Experiment, split_name: str, content: str) -> str:
    """A digest of everything that a row follows from, except the program itself.

    Of files it is their content that counts, and not where they are.
    """
    clips = tuple(entry.with_paths(lambda _: Path("/")) for entry in variant.clips)
    plain = replace(variant, name="", without=(), sample=SamplerSettings(), clips=clips)
    text = "\n".join([experiment_to_toml(plain), split_name, content])
    return hashlib.sha256(text.encode()).hexdigest()


def read(folder: Path | None) -> list[Row]:
    """The rows in a folder; none if it has no `contribution.json`.

    Raises:
        ValueError: the file is something else.
    """
    stored = Store(ROWS_FILE, folder, check=_rows).read(NUMBERS)
    return [] if stored is None else _rows(stored)


def _rows(stored: Rows) -> list[Row]:
    return [_row(fields) for fields in stored["rows"] if "search" in fields]


def _row(stored: StoredRow) -> Row:
    figures = {key: math.nan if v is None else v for key, v in stored["agreement"].items()}
    fields = checked({**stored, "agreement": figures}, Row)
    return Row(**{**fields, "agreement": Accuracy(**fields["agreement"])})


def _write(folder: Path | None, rows: Sequence[Row]) -> None:
    content = [asdict(row) for row in rows]
    for row in content:  # JSON has no NaN
        row["agreement"] = {k: None if math.isnan(v) else v for k, v in row["agreement"].items()}
    Store(ROWS_FILE, folder).write(NUMBERS, {"rows": content})


def row_text(row: Row) -> str:
    """A finished row in one line, for the terminal."""
    figures = ", ".join(f"{ACCURACY[key].heading} {row.agreement.text(key)}" for key in IN_BRIEF)
    return f"{row_name(row)}: {figures}; {row.seconds:.0f} s"


def titles(rows: Sequence[Row]) -> dict[int, str]:
    """The title of each group of rows, by the part that was held out."""
    parts = sorted({row.part for row in rows} - {0})
    held_out = {
        part: f"Part {part} of {len(parts)} held out: fitted on all else, measured on it"
        for part in parts
    }
    return held_out | {0: "Everything fitted, everything measured"}


def group(rows: Sequence[Row], part: int) -> Table:
    """A row for each variant; in brackets, how much each figure rises without the rule."""
    members = [row for row in rows if row.part == part]
    complete = members[0].agreement
    table = [["", *(column.title for column in ACCURACY.values())]]
    for row in members:
        figures = []
        for key, column in ACCURACY.items():
            value, before = getattr(row.agreement, key), getattr(complete, key)
            figures.append(column.format(value) + _rise(key, value - before))
        table.append([variant_name(row.variant), *figures])
    return table


def cells(rows: Sequence[Row]) -> str:
    """All figures as CSV, in the units of their columns."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    columns = [f"{key} [{column.unit}]" for key, column in ACCURACY.items()]
    writer.writerow(["variant", "held out", *columns, "fitted", "converged", "seconds"])
    for row in rows:
        figures = [
            f"{column.factor * value:.6g}"
            for column, value in zip(ACCURACY.values(), astuple(row.agreement), strict=True)
        ]
        fit = [len(row.values), row.converged, f"{row.seconds:.1f}"]
        writer.writerow([row.variant, row.part or "nothing", *figures, *fit])
    return text.getvalue()


def changes(experiment: Experiment) -> list[str]:
    """What each variant changes, a line each."""
    lines = []
    for ablation in experiment.without:
        changes = [f"`{stage}` is `{name}`" for stage, name in ablation.rules.items()]
        changes += [f"`{name}` = {value}" for name, value in ablation.parameters.items()]
        lines.append(f"**{ablation.name}**: {', '.join(changes)}")
    return lines or ["Nothing."]


def values(rows: Sequence[Row]) -> Table:
    """A row for each parameter, a column for each variant; a dash where it is not free."""
    everything = [row for row in rows if not row.part]
    names = list(dict.fromkeys(name for row in everything for name in row.values))
    table = [["parameter", *(variant_name(row.variant) for row in everything)]]
    for name in names:
        fitted = [row.values.get(name) for row in everything]
        table.append([f"`{name}`", *("–" if v is None else number(v) for v in fitted)])
    return table


def row_name(row: Row) -> str:
    """A variant, and what was held out."""
    split = f"part {row.part} held out" if row.part else "everything"
    return f"{variant_name(row.variant)}, {split}"


def _rise(key: str, rise: float) -> str:
    """A rise in brackets; nothing where it is unknown or rounds to 0."""
    column = ACCURACY[key]
    text = f"{column.factor * rise:+.{column.digits}f}"
    return "" if np.isnan(rise) or float(text) == 0.0 else f" ({text})"


class Rise(NamedTuple):
    """How much further joints are from the captured ones without a rule, on held-out parts."""

    variant: str
    mean: float
    """Metres."""
    everywhere: bool
    """Whether they are further in every part."""


def document(experiment: Experiment, rows: Sequence[Row]) -> Document:
    """What an ablation says."""
    unconverged = [row for row in rows if not row.converged]
    return Document(
        file=TABLE,
        kind="An experiment without each of its rules",
        title=experiment.name,
        verdict=f"{len(unconverged)} fits not converged" if unconverged else "All fits converged",
        good=not unconverged,
        findings=findings(rows),
        sections=[
            _figures(experiment, rows),
            Section("What is left out", [Points(changes(experiment))]),
            Section(
                "Fitted values, on everything",
                [Grid(values(rows), "Fitted values of all variants", brief=False)],
            ),
            _limits(rows, unconverged),
        ],
        setup=[*pages.rows(experiment), ["Parts of each clip", f"{_parts(rows)}"]],
        files={CELLS: "all figures", NUMBERS: "all fits"},
    )


def rises(rows: Sequence[Row]) -> list[Rise]:
    """The rise of each variant whose rise is known, the largest first."""
    held_out = {(row.variant, row.part): _distance(row) for row in rows if row.part}
    parts = sorted({part for _, part in held_out})
    findings = []
    for variant in dict.fromkeys(row.variant for row in rows if row.variant != COMPLETE):
        each = [held_out[variant, part] - held_out[COMPLETE, part] for part in parts]
        mean = sum(each) / len(each)
        if not math.isnan(mean):
            findings.append(Rise(variant, mean, all(rise > 0.0 for rise in each)))
    return sorted(findings, key=lambda rise: -rise.mean)


def findings(rows: Sequence[Row]) -> list[Finding]:
    """Whether all fits converged and hold elsewhere, which rules matter, which could go."""
    return [_soundness(rows), *_rules(rises(rows))]


def _distance(row: Row) -> float:
    """Of pelvis, knees and ankles from the captured ones, m, rms over the three."""
    of = row.agreement
    return math.sqrt((of.pelvis**2 + of.knee**2 + of.ankle**2) / 3.0)


def _parts(rows: Sequence[Row]) -> int:
    return max(row.part for row in rows)


def _soundness(rows: Sequence[Row]) -> Finding:
    complete = [row for row in rows if row.variant == COMPLETE]
    held_out = [_distance(row) for row in complete if row.part]
    seen = next(_distance(row) for row in complete if not row.part)
    distance = (
        f"with all rules {JOINTS} are {100 * sum(held_out) / len(held_out):.2f} cm from the "
        f"captured ones (rms) on parts that were held out, {100 * seen:.2f} cm where everything "
        "was fitted"
    )
    count = sum(not row.converged for row in rows)
    if count:
        return Finding(
            f"{count} of {len(rows)} fits did not converge, so that differences between them may "
            f"be those of the search; {distance}.",
            bad=True,
        )
    return Finding(f"All {len(rows)} fits converged; {distance}.")


def _rules(rises: Sequence[Rise]) -> list[Finding]:
    if not rises:
        nothing = "No variant could be measured, so nothing is known of single rules."
        return [Finding(nothing, bad=True)]
    first = rises[0]
    size = f"{100 * first.mean:.2f} cm"
    if first.mean <= MARGIN:
        most = Finding(
            f"No rule is needed: without any one of them, {JOINTS} of held-out parts are no "
            "further from the captured ones.",
            bad=True,
        )
    else:
        where = "in every part" if first.everywhere else "on average, though not in every part"
        most = Finding(
            f"Without `{first.variant}` {JOINTS} of held-out parts are {size} further off, the "
            f"most of all, {where}."
        )
    idle = [f"`{rise.variant}`" for rise in rises if rise.mean <= MARGIN]
    if idle:
        return [
            most,
            Finding(
                f"{listed(idle)} {'earns' if len(idle) == 1 else 'earn'} nothing here: without "
                f"{'it' if len(idle) == 1 else 'any of them'} {JOINTS} of held-out parts are as "
                f"close, or closer by up to {max(0.0, -100 * rises[-1].mean):.2f} cm.",
                bad=True,
            ),
        ]
    if len(rises) == 1:
        return [most, Finding("Nothing else is left out, so nothing is known of other rules.")]
    last = rises[-1]
    return [
        most,
        Finding(
            f"Each of the {len(rises)} variants is worse than the whole; least is missed "
            f"`{last.variant}`, with {100 * last.mean:.2f} cm."
        ),
    ]


def _figures(experiment: Experiment, rows: Sequence[Row]) -> Section:
    explanation = Text(
        "Each column is a fit. In brackets: how much a figure rises without the rule. Measured at "
        "the rate of the clips."
    )
    grids: list[Block] = []
    for part, title in titles(rows).items():
        grids += [Heading(title, brief=True), Grid(transposed(group(rows, part)), title)]
    title = f"{experiment.name}: without each of its rules"
    plot = Plot(FIGURE, title, lambda: overview(rows, title))
    return Section(
        "With and without each rule", [explanation, *grids, plot, Terms(meanings(ACCURACY))]
    )


def _limits(rows: Sequence[Row], unconverged: Sequence[Row]) -> Section:
    lines = [
        f"Clips are cut into {_parts(rows)} parts; differences that are not the same in all of "
        "them may be chance.",
        "Parts of one clip show the same person on the same ground: on others a rule may be worth "
        "more or less.",
        *(f"Not converged: {row_name(row)}: {row.message}" for row in unconverged),
    ]
    return Section("Limits of the data", [Points(lines)])


def variant_name(variant: str) -> str:
    """A variant as tables and axes call it."""
    return variant if variant == COMPLETE else f"without {variant}"


@style.styled
def overview(rows: Sequence[Row], title: str) -> Figure:
    """Each figure of all variants: on parts held out, and where everything was fitted."""
    variants = list(dict.fromkeys(row.variant for row in rows))
    height = 0.45 * len(variants) + 1.2
    figure, grid = style.panels(len(ACCURACY), PANELS_PER_ROW, title, height, 1.8, sharey=True)
    for axes, key in zip(grid, ACCURACY, strict=True):
        _bars(axes, key, rows, variants)
    style.legend(
        figure,
        style.area_key(f"{COMPLETE}: mean of the parts held out", AFTER),
        style.area_key("without this rule: mean of the parts held out", ABLATED),
        style.line_key("each part held out", marker="o", linestyle=""),
        style.line_key("fitted on everything", CAPTURED, marker="D", linestyle=""),
    )
    return figure


def _bars(axes: Axes, key: str, rows: Sequence[Row], variants: Sequence[str]) -> None:
    """One figure of all variants."""
    column, largest = ACCURACY[key], 0.0
    for place, variant in enumerate(variants):
        own = [row for row in rows if row.variant == variant]
        held_out = [getattr(row.agreement, key) for row in own if row.part]
        everything = [getattr(row.agreement, key) for row in own if not row.part]
        mean = float(np.mean(held_out))
        values = column.factor * np.array([*held_out, *everything])
        end = float(np.nan_to_num(values).max())
        largest = max(largest, end)
        colour = AFTER if variant == COMPLETE else ABLATED
        axes.barh(place, column.factor * np.nan_to_num(mean), color=colour, height=0.7)
        parts = len(held_out)
        axes.plot(values[:parts], [place] * parts, "o", color="black", markersize=5)
        axes.plot(values[parts:], [place], "D", color=CAPTURED, markersize=6)
        style.write_beside(axes, column.format(mean), end, place, 8)
        if variant == COMPLETE and not np.isnan(mean):
            axes.axvline(column.factor * mean, color=AFTER, linestyle="--", linewidth=1.2)
    axes.locator_params(axis="x", nbins=4)
    axes.set_xlim(0.0, 1.3 * max(largest, 10.0 ** (1 - column.digits)))
    style.name_rows(axes, list(map(variant_name, variants)))
    axes.grid(False, axis="y")
    axes.set_title(column.title.capitalize())


@in_float64
def ablate(
    experiment: Experiment | str | Path, output: str | Path | None = None, *, folds: int = 2
) -> list[Row]:
    """Fits an experiment as it is and without each of its rules, cross-validated.

    What is left out stands in the experiment's [[without]] tables. Each finished fit is written at
    once, and a call with the same folder continues where an interrupted one ended.

    Args:
        experiment: an experiment, or the path of its file.
        output: folder for the fits and the report.
        folds: number of parts into which each clip is cut.

    Raises:
        ValueError: there are fewer than two folds, or a foot never stands in one of the parts; a
            variant does not fit the clips; the experiment fits a capture, too; the folder cannot
            be made, or its `contribution.json` is something else.
    """
    experiment = as_experiment(experiment)
    file_tables.refuse(experiment.capture, str(experiment.path), "ablate")
    with output_folder(output) as folder:
        experiment = replace(with_files(experiment, folder), holdout=0.0)
        rows = fit_variants(experiment, folder, folds=folds)
        if folder is not None:
            files.write_text(folder / CELLS, cells(rows))
        publish(folder, document(experiment, rows))
        return rows
