"""What is changed by hand on the page: values of sliders, and stances; and how both are saved.

Times of stances on the page count from the first frame that it shows; those of contacts files from
the first frame of the clip's file, of which the page may show a part, at another rate.
"""

import itertools
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

import jaxik
from fitting.clips import Clip, load_clip
from fitting.clips.load import ClipOptions
from fitting.clips.stances import (
    Stance,
    contacts_path,
    count,
    save_stances,
    stances_of,
    with_stances,
)
from fitting.experiment import parameter_files, record_files
from fitting.experiment.problems import ClipData
from fitting.experiment.systems import Preset
from fitting.report import live_data
from fitting.report.live_data import LiveSystem
from fitting.report.sliders import Slider, sliders
from fitting.runtime import files
from fitting.runtime.precision import in_float64
from fitting.runtime.validation import Content
from fitting.studies.fit import capture_check
from jaxik import record
from jaxik.maths import parameter_tree

if TYPE_CHECKING:
    from .session import Session

STEM = "tuned"
SOLVED = "solved"  # key of the motion that sliders change


class Tuning:
    """What the page's sliders change.

    Args:
        session: with the systems to go back to; values are those of systems like the first.
    """

    def __init__(self, session: "Session"):
        self._session = session
        self.first = next(iter(session.starts.values()))

    @cached_property
    def sliders(self) -> list[Slider]:
        """All, element by element of each array."""
        return sliders(self.first, self._session.rig, self._session.free)

    @cached_property
    def _own(self) -> Float64[np.ndarray, " sliders"]:
        return self.numbers(self.first)

    def numbers(self, ik: jaxik.FootIK) -> Float64[np.ndarray, " sliders"]:
        """The values of a system."""
        return np.array([slider.read(ik) for slider in self.sliders], np.float64)

    @in_float64
    def system(self, values: Float64[np.ndarray, " sliders"]) -> jaxik.FootIK:
        """The system with these values.

        Raises:
            ValueError: there are more or fewer values, or one that is not a number.
        """
        if values.shape != (len(self.sliders),) or np.isnan(values).any():
            wanted = f"wanted {len(self.sliders)} numbers, one for each slider"
            raise ValueError(f"{wanted}; got {values.size}, {np.isnan(values).sum()} of them NaN")
        arrays: dict[str, np.ndarray] = {}
        for number in np.flatnonzero(values != self._own):
            slider = self.sliders[number]
            if slider.leaf not in arrays:
                arrays[slider.leaf] = np.array(parameter_tree.get(self.first, slider.leaf))
            arrays[slider.leaf][slider.index] = values[number]
        return parameter_tree.replace(self.first, arrays)

    @in_float64
    def content(self) -> Content:
        """The sliders and the systems to go back to, as the page takes them."""
        place: dict[str, int] = {}
        for number, slider in enumerate(self.sliders):
            place.setdefault(slider.leaf, number)
        live = LiveSystem(self._session.starts, self.sliders)
        return {"systems": [live_data.pack_system(SOLVED, live, place, self.numbers)]}

    @in_float64
    def packed(self, ik: jaxik.FootIK) -> str:
        """The values of a system like the first, as the page takes them.

        Raises:
            ValueError: it has other parameters.
        """
        if not live_data.is_alike(ik, self.first):
            raise ValueError("the system has other parameters than the one that is shown")
        return live_data.packed(self.numbers(ik).astype("<f8"))


@in_float64
def save(
    folder: Path,
    ik: jaxik.FootIK,
    preset: Preset,
    leg_length: float | None = None,
    *,
    drop: bool = False,
) -> list[str]:
    """Writes a system under names that are not taken; returns what was written, and what was not.

    The record is read from the file of parameters, as `jaxik record to-bytes` does.

    Args:
        folder: where.
        ik: the system.
        preset: of which it differs.
        leg_length: m, of the body that its numbers are for; None if they fit any body as they are.
        drop: whether the record leaves out what it cannot hold, instead of not being written.

    Returns:
        Sentences.

    Raises:
        ValueError: the folder cannot be written to.
    """
    toml, binary = _free_names(folder)
    files.write_text(toml, parameter_files.system_to_toml(ik, preset, leg_length))
    messages = [f"Parameters are in {toml}."]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            (entry,) = record_files.read(toml, record.Reading(), None, drop=drop)
        except ValueError as error:
            reason = str(error).removeprefix(f"{toml}: ")
            return [*messages, f"No record is written: {reason.partition('. To leave')[0]}."]
    content = record.to_bytes(entry)
    files.write(binary, lambda path: path.write_bytes(content))
    notes = [f"Note: {warning.message}." for warning in caught]
    return [*messages, f"The record is in {binary}.", *notes]


def _free_names(folder: Path) -> tuple[Path, Path]:
    """Paths of a parameter file and a record that do not exist yet."""
    stems = (STEM if number == 1 else f"{STEM}_{number}" for number in itertools.count(1))
    pairs = ((folder / f"{stem}.toml", folder / f"{stem}.bin") for stem in stems)
    return next(pair for pair in pairs if not any(path.exists() for path in pair))


@dataclass(frozen=True)
class ClipFile:
    """A file of a clip, beside which its contacts file lies."""

    path: Path
    options: ClipOptions = ClipOptions()
    """How it is read."""

    def load(self) -> Clip:
        """All of it, with its stances."""
        return load_clip(self.path, **self.options.given)


@in_float64
def pack_stances(clip: Clip, data: ClipData | None) -> Content:
    """The stances of each leg.

    Args:
        clip: that has them.
        data: the clip on its ground, where it follows it; else nothing is said of footholds.
    """
    footholds = iter(() if data is None else capture_check.footholds(data))
    return {
        "legs": [
            [_pack_stance(stance, clip.start, next(footholds, None)) for stance in stances]
            for stances in stances_of(clip).values()
        ]
    }


def _pack_stance(stance: Stance, start: float, foothold: capture_check.Foothold | None) -> Content:
    gap = None if foothold is None or foothold.gap != foothold.gap else 100.0 * foothold.gap
    return {
        "start": stance.start - start,
        "end": stance.end - start,
        "probability": stance.probability,
        "byHand": stance.by_hand,
        "leftOut": stance.left_out,
        "gap": gap,
        "disagrees": foothold is not None and foothold.disagrees,
    }


@in_float64
def save_contacts(files: Sequence[ClipFile], shown: Clip, legs: Sequence[Sequence[Content]]) -> str:
    """Writes the stances of a page into the contacts files of a clip; says which ones.

    Args:
        files: that have the clip's stances: of the captured motion, and of a flat animation.
        shown: the part of the clip that the page shows.
        legs: the stances of each leg, as the page has them.

    Raises:
        ValueError: a stance lacks something or is none, or a file cannot be read or written.
    """
    names = shown.rig.names
    if len(legs) != len(names):
        raise ValueError(f"stances of {len(legs)} legs; wanted {len(names)}")
    part = {
        name: [_stance(each, shown) for each in leg] for name, leg in zip(names, legs, strict=True)
    }
    labelled: dict[Path, Clip] = {}  # all are checked before any is written
    for file in files:
        whole = file.load()
        stances = _inserted(stances_of(whole), part, shown)
        labelled[contacts_path(file.path)] = with_stances(whole, stances)
    for path, clip in labelled.items():
        save_stances(path, clip)
    return " ".join(f"{path}: {count(clip)}." for path, clip in labelled.items())


def _stance(content: Content, shown: Clip) -> Stance:
    try:
        start, end = (float(content[name]) for name in ("start", "end"))
        known = None if content["byHand"] else content["probability"]
        left_out = bool(content["leftOut"])
    except (KeyError, TypeError) as error:
        raise ValueError(f"a stance without {error}") from None
    if not (start > -0.5 / shown.fps and end < shown.seconds + 0.5 / shown.fps):
        raise ValueError(
            f"a stance from {start:g} to {end:g} s is not within the clip, of which "
            f"{shown.seconds:g} s are shown"
        )
    return Stance(max(shown.start + start, 0.0), shown.start + end, known, left_out)


def _inserted(
    whole: Mapping[str, Sequence[Stance]], part: Mapping[str, Sequence[Stance]], shown: Clip
) -> dict[str, tuple[Stance, ...]]:
    """The stances of a whole clip, those of a part of it exchanged; what a cut parts is joined."""
    frame = 1.0 / shown.fps
    first, last = shown.start, shown.start + (shown.frame_count - 1) * frame
    joined: dict[str, tuple[Stance, ...]] = {}
    for name, stances in whole.items():
        inside = list(part[name])
        before = [each for each in stances if each.start < first - frame / 2]
        after = [each for each in stances if each.end > last + frame / 2]
        if before and before[-1].end >= first - frame / 2:  # the cut parts it
            cut = before.pop()
            if inside and inside[0].start < first + frame / 2:
                inside[0] = replace(inside[0], start=cut.start)
            else:
                before.append(replace(cut, end=first - frame))
        if after and after[0].start <= last + frame / 2:
            cut = after.pop(0)
            if inside and inside[-1].end > last - frame / 2:
                inside[-1] = replace(inside[-1], end=cut.end)
            else:
                after.insert(0, replace(cut, start=last + frame))
        joined[name] = (*before, *inside, *after)
    return joined
