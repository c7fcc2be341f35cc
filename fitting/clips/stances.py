"""When each foot stands, as a list that a person can correct: contacts files.

A contacts file is TOML beside a clip, `walk.contacts.toml` beside `walk.bvh`. `load_clip` reads it,
so whatever reads the clip gets its stances. Times are seconds from the first frame of the clip's
file, both ends of a stance included, whatever part of the clip is used and at which rate:

frames = 360
fps = 30.0

[legs]
left = [
    { start = 0.4, end = 1.033333, probability = 0.98 },    # as the program found it
    { start = 1.5, end = 2.1 },                             # by hand
    { start = 2.6, end = 3.2, left_out = true },            # by hand, and not fitted
]
right = []
"""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import tomli_w
from jaxtyping import Bool, Float64

from fitting.runtime import files, validation
from fitting.runtime.declarations import (
    NEEDED,
    TABLE,
    Key,
    Table,
    changed,
    check_table,
    key,
    list_of,
    read,
)
from fitting.runtime.validation import error_context

from . import contacts
from .clip import FASTEST, SLOWEST, Clip

SUFFIX = ".contacts.toml"
TOPIC = "contacts from "
DIGITS = 6  # of seconds in a file: a microsecond, a tenth of the shortest frame
HEAD = """\
# When the feet of {source} stand: start and end in seconds from its first frame, both included.
# A stance with a probability is as the program found it; leave that out of one that you change.
# left_out = true keeps a leg out of the fit from the middle of the swing before the stance to the
# middle of the one after it. Every command that reads the clip reads this file beside it.
"""


@dataclass(frozen=True)
class Stance(Table):
    """A time for which a foot stands."""

    start: float = key(NEEDED, "First time at which the foot stands.", "s", 0, 1e6)
    end: float = key(NEEDED, "Last time at which it stands.", "s", 0, 1e6)
    probability: float | None = key(
        None,
        "That the foot stands, where the program found it; left out, it is by hand.",
        "",
        contacts.LEAST_PROBABILITY,
        1,
    )
    left_out: bool = key(False, "Whether the fit leaves the leg out around it.")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.end < self.start:
            raise ValueError(
                f"a stance from {self.start:g} to {self.end:g} s ends before it starts"
            )

    @property
    def by_hand(self) -> bool:
        """Whether a person has decided it."""
        return self.probability is None

    @property
    def text(self) -> str:
        """Its times, for messages."""
        return f"{self.start:g} to {self.end:g} s"


Stances: TypeAlias = Mapping[str, tuple[Stance, ...]]
"""The stances of each leg by its name, in order."""


@dataclass(frozen=True)
class ContactsFile:
    """The contents of a contacts file."""

    frames: int = key(NEEDED, "Number of frames of the clip.", "", 1, 10**9)
    fps: float = key(NEEDED, "Rate of the clip.", "Hz", SLOWEST, FASTEST)
    legs: Mapping[str, list] = key(NEEDED, "The stances of each leg, by its name.")


def contacts_path(clip: Path) -> Path:
    """Where the contacts file of a clip's file is, if there is one."""
    return clip.with_suffix(SUFFIX)


def stances_of(clip: Clip) -> dict[str, tuple[Stance, ...]]:
    """The stances of each leg, in seconds from the first frame of the clip's file.

    Those that came with the file have a probability of 1, those found in the motion the program's,
    and those by hand none.

    Raises:
        ValueError: the clip has no legs.
    """
    labels, probability = clip.stance_labels(), _probability(clip)
    left_out = np.zeros_like(labels) if clip.left_out is None else clip.left_out

    def stance(leg: int, first: int, last: int) -> Stance:
        known = float(probability[first, leg])
        return Stance(
            round(clip.start + first / clip.fps, DIGITS),
            round(clip.start + last / clip.fps, DIGITS),
            None if known == 0.0 else known,
            bool(left_out[first, leg]),
        )

    return {
        name: tuple(stance(leg, *run) for run in contacts.runs(labels[:, leg]))
        for leg, name in enumerate(clip.rig.names)
    }


def _probability(clip: Clip) -> Float64[np.ndarray, "frames legs"]:
    """Of the stance of each foot in each frame; 0 where it is by hand."""
    if clip.stance is None:
        return clip.stance_probability()
    return np.ones(clip.stance.shape) if clip.probability is None else clip.probability


def with_stances(clip: Clip, stances: Stances) -> Clip:
    """The clip with these stances as its contact labels.

    Args:
        clip: with legs.
        stances: of each of its legs, in any order. Times count to the nearest frame.

    Raises:
        ValueError: a leg is unknown or missing; a stance is not within the clip, or another one of
            its foot begins before a frame of swing has passed.
    """
    names = clip.rig.names
    validation.check_keys(stances, names, "stances")
    if missing := [name for name in names if name not in stances]:
        raise ValueError(f"{missing[0]} is missing; wanted the stances of {' and '.join(names)}")
    shape = (clip.frame_count, len(names))
    labels, left_out, probability = np.zeros(shape, bool), np.zeros(shape, bool), np.zeros(shape)
    for leg, name in enumerate(names):
        before = None
        for stance in sorted(stances[name], key=lambda stance: stance.start):
            first = round((stance.start - clip.start) * clip.fps)
            last = round((stance.end - clip.start) * clip.fps)
            if first < 0 or last >= clip.frame_count:
                raise ValueError(
                    f"{name}: the stance from {stance.text} is not within the clip, which goes "
                    f"from {clip.start:g} to {clip.start + clip.seconds:g} s"
                )
            if before is not None and labels[max(first - 1, 0), leg]:
                raise ValueError(
                    f"{name}: the stances from {before.text} and from {stance.text} overlap or "
                    f"touch; wanted a frame of swing between them, {1 / clip.fps:.3g} s"
                )
            before, frames = stance, slice(first, last + 1)
            labels[frames, leg] = True
            left_out[frames, leg] = stance.left_out
            probability[frames, leg] = stance.probability or 0.0
    return replace(
        clip,
        stance=labels,
        probability=probability,
        left_out=left_out if left_out.any() else None,
    )


def load_stances(path: Path, clip: Clip) -> Clip:
    """The clip with the stances of a contacts file, and a remark that says so.

    Args:
        path: the file.
        clip: all of the clip that it was written for.

    Raises:
        ValueError: no such file, not TOML, not a contacts file or one of another clip, or as
            `with_stances`.
    """
    content = read(validation.read_toml(path, "a contacts"), ContactsFile, f"{path}")
    if (content.frames, content.fps) != (clip.frame_count, clip.fps):
        raise ValueError(
            f"{path}: the contacts of a clip of {content.frames} frames at {content.fps:g} Hz; "
            f"{clip.source} has {clip.frame_count} at {clip.fps:g} Hz; correct or remove the file"
        )
    known = dict.fromkeys(content.legs, Key(list_of(TABLE), "Stances.", inner=Stance))
    legs = check_table(content.legs, known, f"{path} [legs]")
    with error_context(f"{path} [legs]"):
        clip = with_stances(clip, legs)
    others = (remark for remark in clip.remarks if not remark.startswith(TOPIC))
    return replace(clip, remarks=(*others, f"{TOPIC}{path.name}: {count(clip)}"))


def count(clip: Clip) -> str:
    """How many stances there are, by hand and left out, in words."""
    stances = [stance for leg in stances_of(clip).values() for stance in leg]
    by_hand = sum(stance.by_hand for stance in stances)
    left_out = sum(stance.left_out for stance in stances)
    return f"{len(stances)} stances, {by_hand} by hand, {left_out} left out of the fit"


def save_stances(path: Path, clip: Clip) -> None:
    """Writes the stances of a clip as its contacts file.

    Args:
        path: the file; where `load_clip` finds it, it is `contacts_path`.
        clip: all of the clip of a file, with its stances as they are to be read.

    Raises:
        ValueError: the clip has no legs, or the file cannot be written.
    """
    files.write_text(path, to_toml(clip))


def to_toml(clip: Clip) -> str:
    """The contacts file of a clip; see `save_stances`."""
    stances = stances_of(clip).items()
    legs = {name: [changed(stance) for stance in of_leg] for name, of_leg in stances}
    table = {"frames": clip.frame_count, "fps": clip.fps, "legs": legs}
    source = clip.source if clip.source.isprintable() else ascii(clip.source)
    return f"{HEAD.format(source=source)}\n{tomli_w.dumps(table)}"


def left_out_frames(clip: Clip) -> Bool[np.ndarray, "frames legs"] | None:
    """Where the fit leaves a leg out: around stances, with half of each swing beside them.

    A foot in a swing leaves one foothold and seeks another, so that the half which is nearer to a
    wrong foothold is as wrong. None where nothing is left out.
    """
    if clip.left_out is None or not clip.left_out.any():
        return None
    stance = clip.stance_labels()
    around = np.zeros_like(stance)
    for leg in range(stance.shape[1]):
        runs = contacts.runs(stance[:, leg])
        middles = [(last + first + 1) // 2 for (_, last), (first, _) in itertools.pairwise(runs)]
        parts = itertools.pairwise([0, *middles, len(stance)])
        for (first, last), (begin, end) in zip(runs, parts, strict=False):  # no stance, one part
            around[begin:end, leg] = clip.left_out[first : last + 1, leg].any()
    return around
