"""How feet are placed on their ground, in words: what every run ends with, and its warnings."""

import json
import math
import warnings
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

import jaxik
from fitting.clips.clip import Clip
from fitting.clips.clip_frames import positions_by_role
from fitting.clips.joint_maps import find_trunk
from fitting.motion.measures import MISSING_LIMIT, POP_LIMIT, SLIDE_LIMIT, Cause, Extreme, Placement
from fitting.report.formatting import Table, aligned, percent


class PlacementWarning(UserWarning):
    """Feet are visibly off their ground, slide or pop."""


CAUSES = {
    "missing": "the terrain does not lie below the whole path",
    "units": "the terrain is in another unit of length: one of its units is {0:.4g} m "
    "(--terrain-scale {0:.4g})",
    "offset": "all feet are {1:.0f} cm too {2}: check the clip's floor (--floor) and the height of "
    "the terrain (--terrain-offset)",
    "root": "the root stays on the animation's floor where the ground rises (use --root ground)",
    "unknown": "none of missing ground, units, root, floor and offset; look at these frames",
}


def table(placement: Placement) -> Table:
    """What a viewer sees, a row for each kind: how often or how far, and the largest with place."""
    return [
        [f"feet and ground, {_seen(placement)} or more", "frames", "largest"],
        ["standing feet in the ground", _share(placement.sunk), _place(placement.deepest)],
        ["standing feet above the ground", _share(placement.floating), _place(placement.highest)],
        ["moving feet in the ground", _share(placement.sunk_swing), ""],
        ["any foot in the ground", _share(placement.sunk_frames), ""],
        ["no ground under the sole", _share(placement.groundless), ""],
        ["slide in a stance, median", _cm(placement.slide), _place(placement.largest_slide)],
        ["pop in 1/60 s", "", _place(placement.pop)],
    ]


def text(placement: Placement) -> str:
    """The table for a terminal. Slides and pops are those beyond the animation's own."""
    return aligned(table(placement))


def solved_text(
    reached: Float64[np.ndarray, "frames legs"], seconds: float, path: Path | None
) -> str:
    """How long a clip took, how much ground it found and reached, and where it is written.

    Args:
        reached: as `Animation.reached` gives it.
        seconds: which it took.
        path: of the solved clip; None if it was not written.
    """
    found = ~np.isnan(reached)
    share = f"{np.mean(reached[found]):.1%}" if found.any() else "none"
    return (
        f"{len(reached)} frames in {seconds:.1f} s: ground under {np.mean(found):.1%} of "
        f"the feet, {share} of the targets reached"
        + ("" if path is None else f"; written to {path}")
    )


def trunk_text(result: jaxik.Result, clip: Clip) -> str:
    """How far spine and head of the clip lean; "" for a system that does not bend the spine."""
    spine = result.corrections.spine
    if spine is None:
        return ""
    trunk = find_trunk(clip.joint_names, clip.parents, clip.rig.pelvis)
    angle = np.degrees(2.0 * np.arctan2(np.linalg.norm(spine[:, 1:], axis=1), np.abs(spine[:, 0])))
    text = f"spine: leans by up to {angle.max():.1f}°"
    if trunk.spine is None:
        return f"{text}, not applied: the clip has no spine joint between pelvis and head"
    text += f", applied to {clip.joint_names[trunk.spine]}"
    if trunk.head is None:
        return f"{text}; the clip has no joint named head that turns back"
    return f"{text}; {clip.joint_names[trunk.head]} turns back"


def arrays(solved: Clip, placement: Placement) -> dict[str, np.ndarray]:
    """What is written beside a solved clip: positions by role, and `placement` as JSON."""
    described = np.array(json.dumps(numbers(placement)))
    return positions_by_role(solved) | {"placement": described}


def numbers(placement: Placement) -> dict[str, Any]:
    """The placement as JSON holds it: m and fractions of 1, null for NaN."""
    return _without_nan(asdict(placement))


def warn(placement: Placement, cause: Cause | None, name: str = "") -> None:
    """Warns of all that is beyond its limit; see `warning_texts`. The name precedes each text."""
    for text in warning_texts(placement, cause):
        text = f"{name}: {text}" if name else text
        warnings.warn(text, PlacementWarning, stacklevel=3)


def warning_texts(placement: Placement, cause: Cause | None) -> list[str]:
    """What is beyond its limit, a sentence for each.

    Args:
        placement: of a motion.
        cause: of feet off their ground; None where they are not.
    """
    texts = []
    if cause is not None:
        amount = cause.amount
        reason = CAUSES[cause.kind].format(
            amount, abs(100 * amount), "high" if amount > 0 else "low"
        )
        texts.append(f"{_off_ground(placement)}; likely cause: {reason}")
    elif math.isnan(placement.sunk):
        texts.append("no foot of the animation ever stands; see its contacts with `jaxik inspect`")
    if placement.slide > SLIDE_LIMIT * placement.size:
        texts.append(
            f"standing feet slide by {_cm(placement.slide)} a stance more than animated (most: "
            f"{_place(placement.largest_slide)})"
        )
    if placement.pop.value > POP_LIMIT * placement.size:
        texts.append(f"feet pop in 1/60 s (most: {_place(placement.pop)})")
    return texts


def _off_ground(placement: Placement) -> str:
    if placement.groundless > MISSING_LIMIT:
        return f"there is no ground under {_share(placement.groundless)} of the soles"
    return (
        f"standing feet are {_seen(placement)} or more in the ground in {_share(placement.sunk)} "
        f"of their frames (deepest: {_place(placement.deepest)}) and above it in "
        f"{_share(placement.floating)} (highest: {_place(placement.highest)})"
    )


def _seen(placement: Placement) -> str:
    return f"{100 * placement.visible:.2g} cm"


def _share(fraction: float) -> str:
    return "–" if math.isnan(fraction) else percent(fraction)


def _cm(length: float) -> str:
    return "–" if math.isnan(length) else f"{100 * length:z.1f} cm"


def _place(extreme: Extreme) -> str:
    if math.isnan(extreme.value):
        return "–"
    return f"{_cm(extreme.value)}, {extreme.leg}, frame {extreme.frame}"


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(entry) for key, entry in value.items()}
    return None if isinstance(value, float) and math.isnan(value) else value
