"""What each rule contributes: an experiment as it is, and without each of its rules.

Every clip is cut into parts. A variant is fitted on all parts but one and measured on that one, for
each part in turn, at the clip's own rate; then it is fitted and measured on everything. The part
that is held out is not seen by the fit, but its animation is played: feet keep their strides over
the cuts, and all fits of a variant share their compiled programs. Each finished fit is kept at once
in `contribution.json`, from which an interrupted call goes on.
"""

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np

import jaxik
from fitting.analysis.accuracy import Accuracy, Errors, clip_errors, summarise
from fitting.datasets import clip_frames
from fitting.datasets.clips import edit
from fitting.datasets.clips.clip import Clip
from fitting.experiments.ablations import WHOLE, Variant
from fitting.experiments.experiment import (
    ClipEntry,
    Experiment,
    SampleOptions,
    bare_system,
    check_shapes,
    free_parameters,
    load_pair,
    problem_of,
    system,
)
from fitting.experiments.systems import leaf_names
from fitting.inference.optimisation.solution import Progress
from fitting.problem.space import make_space
from fitting.runtime import files, validation
from jaxik.world.terrain import Terrain

from . import run_folder, study
from .comparison import solve

NUMBERS = "contribution.json"
Pair: TypeAlias = tuple[Clip, Clip, Terrain]  # captured, base, ground, over the same frames


@dataclass(frozen=True)
class Row:
    """A variant, fitted and measured."""

    key: str  # of all that it follows from
    variant: str
    part: int  # that was held out, from 1; 0 where everything was fitted and measured
    agreement: Accuracy
    values: Mapping[str, float]  # fitted, by name
    converged: bool
    message: str  # of the fit
    seconds: float  # that it took


@dataclass(frozen=True)
class Split:
    """What is fitted and what is measured, by the clips' entries."""

    name: str
    fitted: Sequence[tuple[ClipEntry, Pair]]
    measured: Sequence[tuple[Pair, slice]]  # clips, and the frames of them that count


def contribution(
    experiment: Experiment,
    folds: int,
    folder: Path,
    *,
    progress: Callable[[Progress], None] | None = None,
    told: Callable[[Row], None] | None = None,
    between: Callable[[], object] | None = None,
) -> list[Row]:
    """All variants, the whole one first, each with every part held out and then with everything.

    An interrupt (Ctrl-C) loses the fit that runs and no other.

    Args:
        experiment: with its variants.
        folds: parts into which each clip is cut.
        folder: that keeps the numbers. What it has of this experiment, its files and these parts is
            not fitted again; what it has of others is dropped.
        progress: called as a fit goes on, its stage naming the variant and the part.
        told: called with each new row.
        between: called after each variant that was fitted; `jax.clear_caches` drops its programs,
            which no other variant can use.

    Raises:
        ValueError: for fewer than two folds, a part in which a foot never stands, a variant that
            does not fit the clips, or a folder with something else in its `contribution.json`.
    """
    if folds < 2:
        raise ValueError(f"folds is {folds}; wanted 2 or more parts, of which one is held out")
    variants = {WHOLE: experiment} | {
        one.name: changed(experiment, one) for one in experiment.without
    }
    for name, variant in variants.items():
        with validation.error_context(name):
            if frees := free_parameters(variant, system(variant)):
                make_space(system(variant), frees)
    kept = {row.key: row for row in read(folder)}
    pairs = [load_pair(entry, None) for entry in experiment.clips]
    splits = list(split(experiment.clips, pairs, folds))
    seen = _digest(experiment.clips)
    rows: list[Row] = []
    for name, variant in variants.items():
        fitted = False
        for part, one in enumerate(splits, 1):
            key = _key(variant, one.name, seen)
            row = kept.pop(key, None)
            if row is None:
                fitted = True
                with validation.error_context(f"{name}, {one.name}"):
                    row = _fit(variant, one, _named(progress, f"{name}, {one.name}"))
                row = replace(row, key=key, variant=name, part=part % len(splits))
                _write(folder, [*rows, row, *kept.values()])
                if told is not None:
                    told(row)
            rows.append(replace(row, variant=name))  # it may have been renamed
        if between is not None and fitted:
            between()
    _write(folder, rows)
    return rows


def changed(experiment: Experiment, variant: Variant) -> Experiment:
    """The experiment as this variant has it.

    FreeParameter and fixed parameters whose leaf its rules do not have are left out, and so are free ones
    that the variant fixes; its own free ones are added.
    """
    rules = {**experiment.rules, **variant.rules}
    other = replace(experiment, rules=rules)
    leaves = leaf_names(bare_system(other))
    gone = set(leaf_names(bare_system(experiment))) - set(leaves)  # an unknown name stays a mistake
    fixed = {name: value for name, value in experiment.parameters.items() if name not in gone}
    free = {
        name: options
        for name, options in experiment.free.items()
        if name.partition("[")[0] not in gone | set(variant.parameters)
    }
    free |= variant.free
    return replace(other, parameters={**fixed, **variant.parameters}, free=free)


def split(entries: Sequence[ClipEntry], pairs: Sequence[Pair], folds: int) -> Iterator[Split]:
    """Each part held out in turn, then everything.

    Raises:
        ValueError: for a part in which a foot never stands.
    """
    each = list(zip(entries, pairs, strict=True))
    for entry, (captured, _, _) in each:
        for part in range(folds):
            held = _part(captured, part, folds)
            stands = captured.at(held).stance_labels().any(axis=0)
            if not stands.all():
                foot = captured.rig.names[int(np.argmin(stands))]
                start, end = (frame / captured.fps for frame in (held.start, held.stop))
                raise ValueError(
                    f"{entry.reference}: in part {part + 1} of {folds}, {start:.2f} s to "
                    f"{end:.2f} s, the {foot} foot never stands; take fewer folds"
                )
    for part in range(folds):
        held = [_part(captured, part, folds) for captured, _, _ in pairs]
        fitted = [
            (entry, _without(pair, one)) for (entry, pair), one in zip(each, held, strict=True)
        ]
        yield Split(f"part {part + 1} of {folds}", fitted, list(zip(pairs, held, strict=True)))
    yield Split("everything", each, [(pair, slice(None)) for pair in pairs])


def _part(clip: Clip, part: int, folds: int) -> slice:
    """Frames of a part; parts are as long as one another but for a frame."""
    return slice(*(clip.frame_count * one // folds for one in (part, part + 1)))


def _without(pair: Pair, held: slice) -> Pair:
    """The clips with a part of what was captured out of sight."""
    captured, base, ground = pair
    mask = np.ones(captured.frame_count, bool) if captured.mask is None else captured.mask.copy()
    mask[held] = False
    return replace(captured, mask=mask), base, ground


def _fit(experiment: Experiment, one: Split, progress: Callable[[Progress], None] | None) -> Row:
    """The row of a variant, which has no name yet."""
    values, converged, message, seconds = {}, True, "Nothing is free.", 0.0
    ik = system(experiment)
    if experiment.free:
        asked = replace(experiment, clips=tuple(entry for entry, _ in one.fitted))
        problem = problem_of(asked, (_at_rate(pair, experiment.fps) for _, pair in one.fitted))
        solution = study.search(problem, experiment, progress)
        if solution.interrupted:
            raise KeyboardInterrupt
        ik = problem.space.unpack(jnp.asarray(solution.u))
        values = dict(zip(solution.names, map(float, solution.values), strict=True))
        converged, message, seconds = solution.converged, solution.message, solution.seconds
    found = summarise([_errors(ik, pair, part) for pair, part in one.measured])
    return Row("", "", 0, found, values, converged, message, seconds)


def _at_rate(pair: Pair, fps: float | None) -> Pair:
    if fps is None:
        return pair
    captured, base, ground = pair
    return edit.resample(captured, fps), edit.resample(base, fps), ground


def _errors(ik: jaxik.FootIK, pair: Pair, part: slice) -> Errors:
    """How far the system is from the captured motion in these frames, at the rate of the clip."""
    captured, base, ground = pair
    motion = clip_frames.frames_from_clip(base)
    check_shapes(ik, base.rig, ground, motion)
    _, solved = solve(ik, base, ground, motion, 0.0)
    return clip_errors(*(clip.at(part) for clip in (solved, captured, base)))


def _named(
    progress: Callable[[Progress], None] | None, name: str
) -> Callable[[Progress], None] | None:
    """Progress whose stage says what is being fitted."""
    if progress is None:
        return None
    return lambda one: progress(replace(one, stage=f"{name}: {one.stage}"))


def _digest(entries: Sequence[ClipEntry]) -> str:
    """Of the bytes of all files that a fit reads."""
    told = hashlib.sha256()
    for entry in entries:
        for path in (entry.reference, entry.base, entry.terrain):
            told.update(b"" if path is None else hashlib.sha256(path.read_bytes()).digest())
    return told.hexdigest()


def _key(variant: Experiment, part: str, seen: str) -> str:
    """Of all that a row follows from, but for the program itself."""
    plain = replace(variant, name="", without=(), sample=SampleOptions())
    return hashlib.sha256("\n".join([run_folder.resolved(plain), part, seen]).encode()).hexdigest()


def read(folder: Path) -> list[Row]:
    """The rows that a folder keeps; none where it keeps none.

    Raises:
        ValueError: for a file of something else.
    """
    path = folder / NUMBERS
    if not path.exists():
        return []
    try:
        return [_row(told) for told in json.loads(path.read_text(encoding="utf-8"))["rows"]]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: not what `jaxik contribution` keeps: {error!r}") from None


def _row(told: Mapping[str, Any]) -> Row:
    found = {key: math.nan if value is None else value for key, value in told["agreement"].items()}
    return Row(**{**told, "agreement": Accuracy(**found)})


def _write(folder: Path, rows: Sequence[Row]) -> None:
    told = [asdict(row) for row in rows]
    for one in told:
        one["agreement"] = {k: None if math.isnan(v) else v for k, v in one["agreement"].items()}
    folder.mkdir(parents=True, exist_ok=True)
    files.write_text(folder / NUMBERS, json.dumps({"rows": told}, indent=2) + "\n")
