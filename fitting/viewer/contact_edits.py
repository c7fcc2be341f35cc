"""The stances of a clip as the page shows them, and as it sends them back, put right by hand.

Times on the page count from the first frame that it shows; those of contacts files from the first
frame of the clip's file, of which the page may show a part, at another rate.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

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
from fitting.experiment.problems import ClipData
from fitting.runtime.precision import in_float64
from fitting.runtime.validation import Content
from fitting.studies.fit import capture_check


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
def pack(clip: Clip, data: ClipData | None) -> Content:
    """The stances of each leg.

    Args:
        clip: that has them.
        data: the clip on its ground, where it follows it; else nothing is said of footholds.
    """
    footholds = iter(() if data is None else capture_check.footholds(data))
    return {
        "legs": [
            [_pack(stance, clip.start, next(footholds, None)) for stance in stances]
            for stances in stances_of(clip).values()
        ]
    }


def _pack(stance: Stance, start: float, foothold: capture_check.Foothold | None) -> Content:
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
def save(files: Sequence[ClipFile], shown: Clip, legs: Sequence[Sequence[Content]]) -> str:
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
    sentences = []
    for file in files:
        whole = file.load()
        path = contacts_path(file.path)
        labelled = with_stances(whole, _inserted(stances_of(whole), part, shown))
        save_stances(path, labelled)
        sentences.append(f"{path}: {count(labelled)}.")
    return " ".join(sentences)


def _stance(content: Content, shown: Clip) -> Stance:
    try:
        start, end = (float(content[name]) for name in ("start", "end"))
        known = None if content["byHand"] else content["probability"]
        left_out = bool(content["leftOut"])
    except (KeyError, TypeError) as error:
        raise ValueError(f"a stance without {error}") from None
    if not (start > -0.5 / shown.fps and end < shown.seconds + 0.5 / shown.fps):
        raise ValueError(
            f"a stance from {start:g} to {end:g} s is not within the clip, which is shown from 0 to "
            f"{shown.seconds:g} s"
        )
    return Stance(max(shown.start + start, 0.0), shown.start + end, known, left_out)


def _inserted(
    whole: Mapping[str, Sequence[Stance]], part: Mapping[str, Sequence[Stance]], shown: Clip
) -> dict[str, tuple[Stance, ...]]:
    """The stances of a whole clip, those of a part of it exchanged; what a cut parts is joined."""
    frame = 1.0 / shown.fps
    first, last = shown.start, shown.start + (shown.frame_count - 1) * frame
    joined: dict[str, Any] = {}
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
