"""What clips can and cannot tell of foot IK, and how good their data are, before any solving.

NumPy on the clips as they are loaded; nothing is compiled. Lengths are for an adult.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, Int

from fitting.clips import contacts
from fitting.clips.contacts import runs
from fitting.clips.stances import Stance, stances_of
from fitting.experiment.problems import ClipData
from fitting.ground import meshes
from fitting.ground.coverage import FLAT, relief
from fitting.motion import measures
from fitting.motion.measures import with_soles_of
from fitting.motion.playback import Playback
from fitting.runtime.precision import in_float64
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

VISIBLE = 0.015  # m, from which an offset is named
CLEAR = 2.0  # times its scatter
OUTLIER = 3.0  # times the scatter of stances: one of 50 is 2 times off by chance
FEWEST_STANCES = 4  # stances for a height
FEWEST_FOR_TILT = 8
MOST_NAMED = 5  # footholds that a sentence names
EXPLAINED = 0.8  # of the variance of heights between stances, by a tilt

LONGEST = 0.2  # s, that is looked for
SHORTEST = 0.01  # s, and half a frame, from which a lag is named
BETTER = 0.8  # of the rms distance of ankles: what is left of it without the lag
FEWEST_FRAMES = 10  # frames that are compared


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
    """Remarks on the clips of an experiment."""

    lines: tuple[str, ...]
    """A sentence each."""
    flat: bool
    """Whether the ground is flat under all stances of all clips."""


def check(clips: Sequence[ClipData]) -> CaptureCheck:
    """What clips can tell, and how good their data are."""
    each = [measure_stances(clip) for clip in clips]
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


def measure_stances(data: ClipData) -> Stances:
    """The stances of a clip over its ground that are fitted; none where no foot stands."""
    clip, height_under = data.reference, meshes.height_function(data.terrain)
    standing, balls = clip.observed_stances() & clip.fitted_stances(), clip.joints_ws(3)
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
    yield from _disagreements(data)


class Foothold(NamedTuple):
    """A stance of a clip over its ground."""

    leg: str
    stance: Stance
    gap: float
    """m, of the lower point of the sole over the ground, median; NaN where there is none."""
    disagrees: bool
    """Whether the gap is clearly another one than that of most stances, or unknown."""

    @property
    def text(self) -> str:
        """Which one it is, and what is wrong with it."""
        if np.isnan(self.gap):
            where = "has no ground below it"
        else:
            where = f"is {100 * abs(self.gap):.1f} cm {'over' if self.gap > 0 else 'in'} it"
        return f"{self.leg} from {self.stance.text} {where}"


@in_float64
def footholds(data: ClipData) -> tuple[Foothold, ...]:
    """The stances of a captured clip over its ground, leg by leg, as `stances_of` lists them.

    An offset that all have in common is no disagreement: see `measure_ground`. Stances that the fit
    leaves out are judged by the others.
    """
    captured = with_soles_of(data.reference, data.base)
    gap = measures.soles(captured, data.base, data.terrain).gap
    listed = [(leg, stance) for leg, of in stances_of(captured).items() for stance in of]
    labels = captured.stance_labels()
    gaps = np.array(
        [
            _median(gap[first : last + 1, leg])
            for leg in range(labels.shape[1])
            for first, last in runs(labels[:, leg])
        ]
    )
    fitted = np.array([not stance.left_out for _, stance in listed], bool)
    judges = gaps[np.isfinite(gaps) & fitted]
    typical, scatter = _middle(judges) if len(judges) >= FEWEST_STANCES else (0.0, 0.0)
    differs = ~(np.abs(gaps - typical) <= max(VISIBLE, OUTLIER * scatter))  # true for NaN
    return tuple(
        Foothold(*each, float(gap), bool(disagrees))
        for each, gap, disagrees in zip(listed, gaps, differs, strict=True)
    )


def _median(gap: Float64[np.ndarray, " frames"]) -> float:
    """Of what is known; NaN where nothing is."""
    known = gap[np.isfinite(gap)]
    return float(np.median(known)) if len(known) else float("nan")


def _middle(heights: Float64[np.ndarray, " stances"]) -> tuple[float, float]:
    """Median, and standard deviation from it as the median deviation shows it."""
    height = float(np.median(heights))
    return height, 1.4826 * float(np.median(np.abs(heights - height)))


def _disagreements(data: ClipData) -> Iterator[str]:
    """A sentence on the footholds that do not agree with the ground, if there are any."""
    all_of_clip = footholds(data)
    wrong = [each for each in all_of_clip if each.disagrees and not each.stance.left_out]
    if wrong:
        named = [each.text for each in sorted(wrong, key=lambda each: -abs(each.gap))[:MOST_NAMED]]
        rest = f", and {len(wrong) - len(named)} more" if len(wrong) > len(named) else ""
        yield (
            f"{len(wrong)} of {len(all_of_clip)} footholds do not agree with the ground: "
            f"{', '.join(named)}{rest}; put them right or leave them out in the contacts file of "
            "the clip (`jaxik inspect --contacts` shows it), or put the terrain right"
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


@dataclass(frozen=True)
class GroundOffset:
    """How far over its ground a capture stands; a tilt of 0 is none that is clear."""

    height: float
    """m, of standing soles above the ground, median of the stances; 0 where it is not clear."""
    scatter: float
    """m, standard deviation between stances, from their median."""
    stances: int
    tilt_x: float = 0.0
    """rad, by which soles rise over the ground along x."""
    tilt_z: float = 0.0


def measure_ground(
    gap: Float64[np.ndarray, "frames legs"],
    places: Float64[np.ndarray, "frames legs 2"],
    stance: Bool[np.ndarray, "frames legs"],
) -> GroundOffset:
    """The offset of a capture from its ground.

    Args:
        gap: m, of the lower point of each sole over the ground; NaN where there is none.
        places: m, x and z of the soles.
        stance: where a foot stands.
    """
    heights, where = _of_stances(gap, places, stance)
    if len(heights) < FEWEST_STANCES:
        return GroundOffset(0.0, float("nan"), len(heights))
    tilts = _tilts(heights, where)
    level = heights - (where - where.mean(axis=0)) @ np.tan(tilts)
    height, scatter = _middle(level)
    is_clear = abs(height) > max(VISIBLE, CLEAR * scatter)
    return GroundOffset(height if is_clear else 0.0, scatter, len(heights), *map(float, tilts))


def _of_stances(
    gap: np.ndarray, places: np.ndarray, stance: np.ndarray
) -> tuple[Float64[np.ndarray, " stances"], Float64[np.ndarray, "stances 2"]]:
    """Median height over the ground of each stance, m, and its place."""
    heights, where = [], []
    for leg in range(gap.shape[1]):
        for first, last in runs(stance[:, leg] & np.isfinite(gap[:, leg])):
            heights.append(np.median(gap[first : last + 1, leg]))
            where.append(np.median(places[first : last + 1, leg], axis=0))
    return np.array(heights), np.array(where).reshape(-1, 2)


def _tilts(heights: np.ndarray, where: np.ndarray) -> Float64[np.ndarray, "2"]:
    """The angles along x and z of the plane through stances, rad; 0 unless it is clear."""
    none = np.zeros(2)
    if len(heights) < FEWEST_FOR_TILT:
        return none
    offsets, centred = where - where.mean(axis=0), heights - heights.mean()
    slopes = np.linalg.lstsq(offsets, centred, rcond=0.1)[0]  # across a straight way: none
    rises = offsets @ slopes
    left = float(np.sum((centred - rises) ** 2))
    is_large = np.ptp(rises) > 2 * VISIBLE
    is_clear = left < (1 - EXPLAINED) * float(np.sum(centred**2))
    return np.arctan(slopes) if is_large and is_clear else none


class CaptureSigns(NamedTuple):
    """Signs of an offset or a lag in one clip."""

    ground: GroundOffset
    """Of the captured soles from the ground, as its file has it."""
    lag: float
    """s, by which the capture is later than the fitted motion; 0 where that is not clear."""


def find(clips: Sequence[ClipData], playbacks: Sequence[Playback]) -> list[CaptureSigns]:
    """The signs of each clip that has a whole skeleton."""
    return [
        CaptureSigns(_of_ground(clip), measure_lag(play))
        for clip, play in zip(clips, playbacks, strict=False)
    ]


def _of_ground(clip: ClipData) -> GroundOffset:
    captured = with_soles_of(clip.reference, clip.base)
    feet = measures.soles(captured, clip.base, clip.terrain)
    places = feet.points_ws.mean(axis=2)[..., [0, 2]]
    return measure_ground(feet.gap, places, clip.reference.fitted_stances())


def measure_lag(clip: Playback) -> float:
    """How long after the fitted motion the capture shows the same, s; 0 unless that is clear."""
    dt, frames = float(clip.dt[-1]), len(clip.dt)
    reach = min(round(LONGEST / dt), (frames - FEWEST_FRAMES) // 2)
    if reach < 1:
        return 0.0
    steps = range(-reach, reach + 1)
    squares = np.array([_mean_square(clip, step, reach) for step in steps])
    if not np.all(np.isfinite(squares)):
        return 0.0
    best = int(np.argmin(squares))
    if best in (0, len(steps) - 1):  # no minimum within reach
        return 0.0
    before, here, after = squares[best - 1 : best + 2]
    curvature = before - 2 * here + after
    between = 0.5 * (before - after) / curvature if curvature > 0 else 0.0
    lag = (steps[best] + between) * dt
    least = here - 0.25 * (before - after) * between
    is_clear = least < BETTER**2 * squares[reach]
    return float(lag) if is_clear and abs(lag) >= max(SHORTEST, 0.5 * dt) else 0.0


def _mean_square(clip: Playback, step: int, reach: int) -> float:
    """Mean square of the distance of ankles, less a constant one, with a shift of some frames."""
    middle = slice(reach, len(clip.dt) - reach)
    shifted = slice(reach - step, len(clip.dt) - reach - step)
    captured, fitted = np.asarray(clip.captured.ankle), np.asarray(clip.after.ankle)
    compared = np.asarray(clip.seen | clip.held_out)[middle]
    errors = (fitted[shifted] - captured[middle])[compared][:, np.asarray(clip.present) > 0]
    if len(errors) < FEWEST_FRAMES:
        return float("nan")
    return float(np.mean((errors - errors.mean(axis=0)) ** 2))
