"""What clips can and cannot tell of foot IK, and how good their data are: said before any solving.

NumPy on the clips as they are loaded; nothing is compiled. Lengths are for an adult.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from fitting.datasets.clips import contacts
from fitting.datasets.relief import FLAT, relief
from fitting.datasets.terrain import mesh_files
from fitting.experiments.problems import ClipData
from jaxik.world import body

STEP = 0.10  # m: what a capture should climb
ON_FLAT_GROUND = (
    "the ground under all stances is flat (they differ by {:.0f} cm in height): this capture only "
    "tells that foot IK must leave the feet alone; to learn the rest, record the walk over steps "
    f"of {100 * STEP:.0f} cm or more"
)
MAX_GAP = 0.25  # s without a whole body, which no stance can be judged across
MAX_MISSING = 0.05  # of the frames
MAX_DRIFT = 0.015  # m of the floor along a clip
TREND = 3.0  # standard errors from which on a drift is one
MAX_SLIDE = 0.03  # m between the first and the last third of a stance
MIN_RATE = 25.0  # Hz: below it a foot moves by 15 cm and more from frame to frame
FEW_STANCES = 6  # of all feet


class Stances(NamedTuple):
    """The stances of a clip, of all feet."""

    frame: Int[np.ndarray, " stances"]
    """In the middle."""
    place: Float[np.ndarray, "stances 2"]
    """m, of the ball in the ground plane."""
    ground: Float[np.ndarray, " stances"]
    """m, height of the ground under the ball; NaN where there is none."""
    sole: Float[np.ndarray, " stances"]
    """m, height of the sole there, by the rig."""
    slide: Float[np.ndarray, " stances"]
    """m, horizontal way of the ball from the first to the last third."""


@dataclass(frozen=True)
class CaptureCheck:
    """What there is to say of the clips of an experiment."""

    lines: tuple[str, ...]
    """A sentence each."""
    flat: bool
    """Whether the ground is flat under all stances of all clips."""


def check(clips: Sequence[ClipData]) -> CaptureCheck:
    """What clips can tell, and how good their data are."""
    each = [stances_of(clip) for clip in clips]
    reliefs = [
        relief(*_known(stances)) / body.ratio(clip.reference.rig)
        for clip, stances in zip(clips, each, strict=True)
    ]
    flat = bool(reliefs) and max(reliefs) < FLAT
    lines = [ON_FLAT_GROUND.format(100 * max(reliefs))] if flat else []
    for clip, stances in zip(clips, each, strict=True):
        source = f"{clip.reference.source}: " if len(clips) > 1 else ""
        lines += [source + line for line in _quality(clip, stances)]
    return CaptureCheck(tuple(lines), flat)


def stances_of(data: ClipData) -> Stances:
    """The stances of a clip over its ground; none where no foot stands."""
    clip, height_under = data.reference, mesh_files.height_function(data.terrain)
    standing, balls = clip.observed_stances(), clip.joints_ws(3)
    places = [
        (first, last, leg)
        for leg in range(standing.shape[1])
        for first, last in contacts.runs(standing[:, leg])
    ]
    first, last, legs = np.array(places, int).reshape(-1, 3).T
    frames, third = (first + last) // 2, (last - first) // 3
    points = balls[frames, legs]
    way = balls[last - third, legs] - balls[first + third, legs]
    return Stances(
        frames,
        points[:, [0, 2]],
        height_under(points) if len(points) else np.zeros(0),
        points[:, 1] - np.asarray(clip.rig.ball_height)[legs],
        np.linalg.norm(way[:, [0, 2]], axis=-1),
    )


def _quality(data: ClipData, stances: Stances) -> Iterator[str]:
    """What is wrong with the data of a clip, a sentence each."""
    clip = data.reference
    size = body.ratio(clip.rig)
    if clip.fps < MIN_RATE:
        yield f"{clip.fps:g} Hz is too slow for feet; wanted {MIN_RATE:g} Hz or more"
    if gaps := contacts.runs(~clip.observed):
        share = float(np.mean(~clip.observed))
        longest = max(last - first + 1 for first, last in gaps) / clip.fps
        if share > MAX_MISSING or longest > MAX_GAP:
            yield f"{share:.0%} of the frames were not observed, up to {longest:.2f} s on end"
    count = len(stances.frame)
    if count < FEW_STANCES:
        yield f"feet stand {count} times; so few steps determine little: take a longer clip"
    if count and (slide := float(np.median(stances.slide))) > MAX_SLIDE * size:
        yield f"standing feet slide by {100 * slide:.1f} cm in a stance (median)"
    drift, error = _trend(stances.frame, stances.sole - stances.ground)
    drift, error = drift * clip.frame_count, error * clip.frame_count
    if abs(drift) > max(MAX_DRIFT * size, TREND * error):
        way = "rises" if drift > 0 else "sinks"
        yield (
            f"the floor drifts: from the first stance to the last the soles' height above the "
            f"ground {way} by {100 * abs(drift):.1f} cm; is the terrain that of this capture?"
        )


def _known(stances: Stances) -> tuple[np.ndarray, np.ndarray]:
    """Places and heights of the ground, where there is some."""
    known = ~np.isnan(stances.ground)
    return stances.place[known], stances.ground[known]


def _trend(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Slope of a line through points, and its standard error; 0 of too few."""
    known = ~np.isnan(y)
    x, y = x[known].astype(float), y[known]
    if len(x) < 4 or not np.ptp(x) > 0:
        return 0.0, np.inf
    centred = x - x.mean()
    slope = float(centred @ y / (centred @ centred))
    rest = y - y.mean() - slope * centred
    return slope, float(np.sqrt(rest @ rest / (len(x) - 2) / (centred @ centred)))
