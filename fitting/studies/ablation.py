"""Ablation: an experiment as it is and without each of its rules, cross-validated.

Every clip is cut into parts. A variant is fitted on all parts but one and measured on that one, for
each part in turn, at the clip's own rate; then it is fitted and measured on everything. The fit
does not see the part that is held out, but its animation is still played: so feet keep their
strides over the cuts, and all fits of a variant share their compiled programs. Each finished fit is
written at once to `contribution.json`, from which an interrupted call continues.
"""

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TypedDict

import jax
import numpy as np

import jaxik
from fitting.analysis.accuracy import Accuracy, Errors, clip_errors, summarise
from fitting.datasets.clips import Clip, edit
from fitting.datasets.ground_path import place_root
from fitting.experiments.ablations import COMPLETE, Ablation
from fitting.experiments.experiment import ClipEntry, Experiment
from fitting.experiments.experiment_files import experiment_to_toml
from fitting.experiments.problems import ClipData, load_clip_data, problem_from_clips
from fitting.experiments.systems import leaf_names
from fitting.inference.optimisation.solution import Progress
from fitting.inference.sampling.settings import SamplerSettings
from fitting.runtime import activity
from fitting.runtime.storage.declared_types import Finite, checked
from fitting.runtime.storage.json_files import JsonFile
from fitting.runtime.validation import error_context
from jaxik.world.similarity import similar

from .animations import Animation
from .assess import search_with_noise

NUMBERS = "contribution.json"


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
    converged: bool
    message: str
    """Of the fit."""
    seconds: float
    """Duration of the fit."""


class StoredRow(TypedDict):
    """What a row's file holds in a way of its own; the rest is as `Row` declares it."""

    agreement: dict[str, Finite | None]
    """None for NaN, which JSON does not have."""


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
    """Clips, and the frames of them that count."""


def ablate(
    experiment: Experiment,
    folder: Path | None = None,
    *,
    folds: int = 2,
    progress: Callable[[Progress], None] | None = None,
    on_row: Callable[[Row], None] | None = None,
) -> list[Row]:
    """Fits and measures all variants, the complete one first, each on all splits of the clips.

    An interrupt (Ctrl-C) loses the fit that is running and no other.

    Args:
        experiment: an experiment with ablations.
        folder: where finished fits are kept. Those that it has of this experiment, its files and
            these folds are not repeated; those of others are dropped. None keeps them in memory.
        folds: number of parts into which each clip is cut.
        progress: called as a fit goes on; its stage names the variant and the part.
        on_row: called with each new row.

    Raises:
        ValueError: there are fewer than two folds, or a foot never stands in one of the parts; a
            variant does not fit the clips; the folder's `contribution.json` is something else.
    """
    if folds < 2:
        raise ValueError(f"folds is {folds}; wanted 2 or more parts, of which one is held out")
    variants = {COMPLETE: experiment}
    variants |= {ablation.name: without(experiment, ablation) for ablation in experiment.without}
    for name, variant in variants.items():
        with error_context(name):
            _check(variant)
    finished = {} if folder is None else {row.key: row for row in read(folder)}
    with activity.announced("Reading the clips"):
        data = [load_clip_data(entry, None) for entry in experiment.placed_clips()]
    splits = list(split(experiment.clips, data, folds))
    content = "" if folder is None else _digest(experiment.clips)
    rows: list[Row] = []
    count = len(variants) * len(splits)
    with activity.announced(f"Fitting {len(variants)} variants", count) as fitting:
        for name, variant in variants.items():
            any_new = False
            for part, one_split in enumerate(splits, 1):
                key = _key(variant, one_split.name, content)
                row = finished.pop(key, None)
                if row is None:
                    any_new = True
                    label = f"{name}, {one_split.name}"
                    with error_context(label):
                        row = _fit(variant, one_split, labelled(progress, label))
                    row = replace(row, key=key, variant=name, part=part % len(splits))
                    _write(folder, [*rows, row, *finished.values()])
                    if on_row is not None:
                        on_row(row)
                # The variant may have another name by now.
                rows.append(replace(row, variant=name, part=part % len(splits)))
                fitting.advance()
            if any_new:
                jax.clear_caches()  # no other variant can use these programs
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
    # Names that neither system has stay, and are reported as mistakes later.
    gone = set(leaf_names(experiment.preset_system())) - set(leaf_names(changed.preset_system()))
    fixed = {name: value for name, value in experiment.parameters.items() if name not in gone}
    free = {
        name: overrides
        for name, overrides in experiment.free.items()
        if name.partition("[")[0] not in gone | set(ablation.parameters)
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


def _fit(variant: Experiment, data: Split, progress: Callable[[Progress], None] | None) -> Row:
    """The row of a variant on a split, without its key and its name."""
    values, converged, message, seconds = {}, True, "Nothing is free.", 0.0
    ik = variant.starting_system(data.measured[0][0].base.rig)
    if variant.free:
        fitted = replace(variant, clips=tuple(entry for entry, _ in data.fitted))
        resampled = (_at_rate(clip, variant.fps) for _, clip in data.fitted)
        problem = problem_from_clips(fitted, resampled)
        problem, solution = search_with_noise(problem, variant, progress)
        if solution.interrupted:
            raise KeyboardInterrupt
        ik = problem.space.unpack(solution.u)
        values = dict(zip(solution.names, map(float, solution.values), strict=True))
        converged, message, seconds = solution.converged, solution.message, solution.seconds
    first = data.measured[0][0].base.rig
    with activity.announced("Measuring how far it is from the capture"):
        accuracy = summarise(
            [
                _errors(_for_body(ik, variant.size(clip.base.rig, first)), clip, frames)
                for clip, frames in data.measured
            ]
        )
    return Row("", "", 0, accuracy, values, converged, message, seconds)


def _for_body(ik: jaxik.FootIK, size: float | None) -> jaxik.FootIK:
    return ik if size is None else similar(ik, size)


def _at_rate(data: ClipData, fps: float | None) -> ClipData:
    if fps is None:
        return data
    reference, base = edit.resample(data.reference, fps), edit.resample(data.base, fps)
    base, root = place_root(base, data.terrain, data.root.root)
    nearest = np.round(np.arange(base.frame_count) * data.base.fps / fps).astype(int)
    tracks = {name: values[nearest] for name, values in data.tracks.items()}
    return ClipData(reference, base, data.terrain, root, tracks)


def _errors(ik: jaxik.FootIK, data: ClipData, frames: slice) -> Errors:
    """Errors of the system in these frames, at the clip's own rate."""
    animation = Animation(data.base, data.terrain, root=data.root, tracks=data.tracks)
    animation.check_shapes(ik)
    _, solved = animation.solve(ik)
    compared = (solved, data.reference, animation.placed_clip)
    return clip_errors(*(clip.select(frames) for clip in compared))


def labelled(
    progress: Callable[[Progress], None] | None, label: str
) -> Callable[[Progress], None] | None:
    """Progress whose stage also says what is being fitted."""
    if progress is None:
        return None
    return lambda report: progress(replace(report, stage=f"{label}: {report.stage}"))


def _digest(entries: Sequence[ClipEntry]) -> str:
    """A digest of all files that a fit reads."""
    digest = hashlib.sha256()
    for entry in entries:
        joints = entry.joints if isinstance(entry.joints, Path) else None
        paths = (entry.reference, entry.base, entry.terrain, entry.tracks, joints, entry.asf)
        for path in paths:
            digest.update(b"" if path is None else hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def _placeless(entry: ClipEntry) -> ClipEntry:
    """The entry with every path replaced by the same one."""
    paths = [field.name for field in fields(entry) if isinstance(getattr(entry, field.name), Path)]
    return replace(entry, **dict.fromkeys(paths, Path("/")))


def _key(variant: Experiment, split_name: str, content: str) -> str:
    """A digest of everything that a row follows from, except the program itself.

    Of files it is their content that counts, and not where they are.
    """
    clips = tuple(_placeless(entry) for entry in variant.clips)
    plain = replace(variant, name="", without=(), sample=SamplerSettings(), clips=clips)
    text = "\n".join([experiment_to_toml(plain), split_name, content])
    return hashlib.sha256(text.encode()).hexdigest()


def read(folder: Path) -> list[Row]:
    """The rows that a folder holds; none if it has no `contribution.json`.

    Raises:
        ValueError: the file is something else.
    """
    path = folder / NUMBERS
    if not path.exists():
        return []
    stored = ROWS_FILE.read(path)["rows"]
    with error_context(f"{path}: not {ROWS_FILE.description}"):
        return [_row(fields) for fields in stored]


def _row(stored: StoredRow) -> Row:
    figures = {key: math.nan if v is None else v for key, v in stored["agreement"].items()}
    fields = checked({**stored, "agreement": figures}, Row)
    return Row(**{**fields, "agreement": Accuracy(**figures)})


def _write(folder: Path | None, rows: Sequence[Row]) -> None:
    if folder is None:
        return
    content = [asdict(row) for row in rows]
    for row in content:  # JSON has no NaN
        row["agreement"] = {k: None if math.isnan(v) else v for k, v in row["agreement"].items()}
    folder.mkdir(parents=True, exist_ok=True)
    ROWS_FILE.write(folder / NUMBERS, {"rows": content})
