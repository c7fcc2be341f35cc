"""Contact detection: when each foot stands, from the motion of its ball alone.

A foot stands while its ball is slow, provided that it was put down: a ball that rises into a slow
spell and falls out of it hangs at the top of a swing or a jump. Heights are not compared with a
floor, since the ground may be at any height. Balls that noise shakes are smoothed for speeds, and
stand for as long as they stay within the noise of their place. Noise is seen in fourth differences,
of which a low quantile shows noise alone: a standing foot moves too smoothly to have any.

Limits are for an adult. A body twice as large moves twice as fast if it plays the same animation,
and the root of two times as fast at an equal Froude number. Its limit of speed lies between them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.ndimage import gaussian_filter1d
from scipy.special import ndtr

from jaxik.world.frame import UP

MAX_SPEED = 0.25  # m/s: the ball of a standing foot is slower, even a runner's
SPEED_POWER = 0.7  # of a body's size, with which the limit of speed grows
SPEED_NOISE = 0.33  # of that limit, along an axis: what smoothing leaves of noise in speeds
REACH = 2.0  # deviations of the noise, within which a noisy ball is where it stands
HALF_WINDOW = 0.025  # s, on each side of a frame, for measuring speed
MAX_GAP = 0.05  # s: shorter interruptions of a stance are marker noise
MIN_STANCE = 0.06  # s: shorter slow spells are not stances; runners stand for 0.075 s
HANG_WINDOW = 0.2  # s before and after a slow spell, in which a hanging foot shows
HANG_HEIGHT = 0.03  # m by which a hanging foot is higher than before and after
SHORTEST_WAY = 0.05  # m between footholds, below which nothing is beside it

# Deviations of the logarithm of the right limits from the above, and of the height, m.
SPEED_DOUBT, DURATION_DOUBT, HANG_DOUBT = 0.5, 0.5, 0.015
LEAST_PROBABILITY = 0.01

ORDER = 4  # of the differences
GAIN = 70.0**0.5  # of the noise in them: root of the sum of the squares of 1, 4, 6, 4, 1
QUANTILE, CHI = 0.25, 1.101  # and that quantile of the length of three normal deviates
# Variance of the slope of a Gaussian-smoothed series, times the cube of the Gaussian's width.
SLOPE = 1.0 / (4.0 * np.pi**0.5)
LEAST = 1.1  # frames: noise that needs no wider Gaussian does not show in speeds over 50 ms


def detect_stances(
    ball_ws: Float64[np.ndarray, "frames legs 3"],
    fps: float,
    size: float = 1.0,
    slack: float = 0.0,
) -> Bool[np.ndarray, "frames legs"]:
    """True where a foot stands.

    Args:
        ball_ws: position of the ball of each foot, m, y up.
        fps: frames per second.
        size: length of the legs relative to an adult's.
        slack: m/s, by which balls of standing feet may be faster than they are as a rule.
    """
    smooth_ws = steadied(ball_ws, fps, size)
    slow = speeds(smooth_ws, fps) < speed_limit(size) + slack
    stance = np.zeros_like(slow)
    for leg in range(slow.shape[1]):
        for first, last in merge_runs(runs(slow[:, leg]), round(MAX_GAP * fps)):
            long_enough = last - first + 1 >= MIN_STANCE * fps
            hang = _hang(smooth_ws[:, leg, 1] / size, first, last, round(HANG_WINDOW * fps))
            if long_enough and not hang > HANG_HEIGHT:
                if smooth_ws is not ball_ws:
                    reach = REACH * amplitude(ball_ws)
                    first, last = _whole(ball_ws[:, leg], first, last, reach)
                stance[first : last + 1, leg] = True
    return stance


def stance_probability(
    ball_ws: Float64[np.ndarray, "frames legs 3"],
    stance: Bool[np.ndarray, "frames legs"],
    fps: float,
    size: float = 1.0,
) -> Float64[np.ndarray, "frames legs"]:
    """How probable each detected stance is, in each of its frames; 0 in swings.

    It is the probability that the right limits of speed, duration and hanging height, which are
    known to within a factor or so, let it pass, as if they were independent. How long a stance is
    that the clip cuts off is not known. When it begins and ends is not judged.

    Args:
        ball_ws: position of the ball of each foot, m, y up.
        stance: as `detect_stances` finds them.
        fps: frames per second.
        size: length of the legs relative to an adult's.
    """
    smooth_ws = steadied(ball_ws, fps, size)
    speed, window = speeds(smooth_ws, fps), round(HANG_WINDOW * fps)
    probability = np.zeros(stance.shape)
    for leg in range(stance.shape[1]):
        for first, last in runs(stance[:, leg]):
            frames = slice(first, last + 1)
            slowness = speed_limit(size) / max(float(np.median(speed[frames, leg])), 1e-9)
            is_cut = first == 0 or last == len(stance) - 1
            duration = np.inf if is_cut else (last - first + 1) / (fps * MIN_STANCE)
            hang = _hang(smooth_ws[:, leg, 1] / size, first, last, window)
            deviations = (
                np.log(slowness) / SPEED_DOUBT,
                np.log(duration) / DURATION_DOUBT,
                (HANG_HEIGHT - hang) / HANG_DOUBT,
            )
            whole = float(np.prod(ndtr(deviations)))
            probability[frames, leg] = max(round(whole, 2), LEAST_PROBABILITY)
    return probability


def speed_limit(size: float) -> float:
    """Speed of the ball below which a foot stands, m/s, by the length of the legs as above."""
    return MAX_SPEED * size**SPEED_POWER


def steadied(
    ball_ws: Float64[np.ndarray, "frames legs 3"], fps: float, size: float
) -> Float64[np.ndarray, "frames legs 3"]:
    """The balls without the noise that hides which of them are slow; as they are without it."""
    left = SPEED_NOISE * speed_limit(size)
    return smoothed(ball_ws, amplitude(ball_ws), left, fps)


def speeds(points_ws: Float64[np.ndarray, "frames *b 3"], fps: float) -> np.ndarray:
    """Speed of each point, m/s, of shape (frames, ...), over 50 ms around each frame."""
    reach = max(1, round(HALF_WINDOW * fps))
    frames = np.arange(len(points_ws))
    before, after = np.maximum(frames - reach, 0), np.minimum(frames + reach, len(frames) - 1)
    seconds = np.maximum(after - before, 1).reshape(-1, *[1] * (points_ws.ndim - 2)) / fps
    return np.linalg.norm(points_ws[after] - points_ws[before], axis=-1) / seconds


def runs(labels: Bool[np.ndarray, " frames"]) -> list[tuple[int, int]]:
    """First and last frame of each run of consecutive True values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], labels.astype(np.int8), [0]])))
    return [(int(first), int(end) - 1) for first, end in edges.reshape(-1, 2)]


def merge_runs(separate: list[tuple[int, int]], gap: int) -> list[tuple[int, int]]:
    """The runs, joined where at most `gap` frames lie between them."""
    joined: list[tuple[int, int]] = []
    for first, last in separate:
        if joined and first - joined[-1][1] - 1 <= gap:
            joined[-1] = (joined[-1][0], last)
        else:
            joined.append((first, last))
    return joined


@dataclass(frozen=True)
class Footfalls:
    """Where one foot stands, and between which two stances it is in each frame."""

    positions_ws: Float64[np.ndarray, "stances 3"]
    """m, median position of the ball."""
    last: Int64[np.ndarray, " frames"]
    """Index of the current stance, or of the one it has left."""
    next: Int64[np.ndarray, " frames"]
    """Index of the following one; at both ends of a clip `last`."""
    swing_fraction: Float64[np.ndarray, " frames"]
    """0..1, of the swing's duration that has passed."""
    aside_ws: Float64[np.ndarray, "stances 3"]
    """m, by how far the middle of the swing after each stance is beside the straight way."""


def footfalls(
    ball_ws: Float64[np.ndarray, "frames 3"],
    stance: Bool[np.ndarray, " frames"],
    up_ws: Sequence[float] | np.ndarray = UP,
) -> Footfalls:
    """The footfalls of one foot that stands at least once.

    Args:
        ball_ws: position of its ball, m.
        stance: True where it stands.
        up_ws: unit, of the floor.
    """
    stances = runs(stance)
    frames = np.arange(len(stance))
    firsts, lasts = np.array(stances).T
    last = np.maximum(np.searchsorted(firsts, frames, side="right") - 1, 0)
    next_ = np.where(frames < firsts[0], 0, np.minimum(last + 1, len(stances) - 1))
    leaving, arriving = lasts[last], firsts[next_]
    swinging = (frames > leaving) & (next_ > last)
    fraction = np.where(swinging, (frames - leaving) / np.maximum(arriving - leaving, 1), 0.0)
    positions = np.array([np.median(ball_ws[a : b + 1], axis=0) for a, b in stances])
    level_ws, ends = _level(ball_ws, up_ws), _level(positions, up_ws)
    aside = np.zeros(positions.shape)
    for index in range(len(stances) - 1):
        swing = level_ws[lasts[index] + 1 : firsts[index + 1]]
        aside[index] = _aside(swing, ends[index], ends[index + 1])
    return Footfalls(positions, last, next_, fraction, aside)


@dataclass(frozen=True)
class CutOffSwing:
    """A swing of which a clip shows only the end."""

    last_ws: Float64[np.ndarray, "3"]
    """m, of the foothold that it left; its height is that of the next one."""
    next_ws: Float64[np.ndarray, "3"]
    """m, median position of the ball at the next foothold."""
    fraction: Float64[np.ndarray, " before"]
    """0..1, of its duration that has passed, in each frame before the foot stands."""


def cut_off_swing(
    balls_ws: Float64[np.ndarray, "frames legs 3"],
    stance: Bool[np.ndarray, "frames legs"],
    leg: int,
    up_ws: Sequence[float] | np.ndarray = UP,
) -> CutOffSwing | None:
    """The swing of a foot that the start of a clip cuts off, as long and far as its next one.

    If a foot stands only once, the first whole swing of another foot counts. None if there is none,
    or nothing is cut off. That of the clip reversed is the one that its end cuts off, with its
    footholds exchanged.

    Args:
        balls_ws: position of the ball of each foot, m.
        stance: True where they stand.
        leg: number of the foot.
        up_ws: unit, of the floor.
    """
    stances = [runs(of_foot) for of_foot in stance.T]
    if not stances[leg] or stances[leg][0][0] == 0:
        return None
    swings = [(other != leg, of[0][1], other) for other, of in enumerate(stances) if len(of) > 1]
    if not swings:
        return None
    landing, (_, leaving, example) = stances[leg][0][0], min(swings)
    arriving = stances[example][1][0]

    def place(foot: int, index: int) -> Float64[np.ndarray, "3"]:
        first, last = stances[foot][index]
        return np.median(balls_ws[first : last + 1, foot], axis=0)

    next_ws, example_ws = place(leg, 0), place(example, 1) - place(example, 0)
    remaining, way = _level(np.stack([next_ws - balls_ws[0, leg], example_ws]), up_ws)
    lengths = np.linalg.norm([remaining, way], axis=1)
    # What little is seen of a swing that is nearly all cut off tells its direction badly.
    hidden = max(0.0, 1.0 - lengths[0] / max(lengths[1], SHORTEST_WAY))
    ahead = remaining + hidden * way
    back = ahead / max(float(np.linalg.norm(ahead)), 1e-9) * lengths.max()
    fraction = 1.0 - (landing - np.arange(landing)) / (arriving - leaving)
    return CutOffSwing(next_ws - back, next_ws, np.maximum(fraction, 0.0))


def _level(
    points_ws: Float64[np.ndarray, "n 3"], up_ws: Sequence[float] | np.ndarray
) -> Float64[np.ndarray, "n 3"]:
    """The points without their height."""
    up = np.asarray(up_ws, np.float64)
    return points_ws - (points_ws @ up)[:, None] * up


def _aside(
    swing_ws: Float64[np.ndarray, "frames 3"], last_ws: np.ndarray, next_ws: np.ndarray
) -> Float64[np.ndarray, "3"]:
    """By how far the middle of a swing is beside the straight way, m; points have no height.

    It is that of a parabola through both footholds and through the first frame in which the ball
    has covered half of the way.
    """
    way = next_ws - last_ws
    length2 = way @ way
    if not len(swing_ws) or length2 < SHORTEST_WAY**2:
        return np.zeros(3)
    covered = (swing_ws - last_ws) @ way / length2
    middle = int(np.argmax(covered >= 0.5))
    part = covered[middle]
    if not 0.5 <= part <= 0.75:
        return np.zeros(3)
    beside = swing_ws[middle] - last_ws - part * way
    return beside / (4.0 * part * (1.0 - part))


def _whole(
    ball_ws: Float64[np.ndarray, "frames 3"], first: int, last: int, reach: float
) -> tuple[int, int]:
    """First and last frame of a stance whose ends smoothing has blurred.

    It lasts as long as the ball is within `reach`, m, of where it stands.
    """
    away = np.linalg.norm(ball_ws - np.median(ball_ws[first : last + 1], axis=0), axis=-1) > reach
    before, after = np.flatnonzero(away[:first]), np.flatnonzero(away[last + 1 :])
    first = int(before[-1]) + 1 if len(before) else 0
    return first, last + int(after[0]) if len(after) else len(ball_ws) - 1


def _hang(height: Float64[np.ndarray, " frames"], first: int, last: int, window: int) -> float:
    """How far a foot has risen into this run of frames and falls out of it, with adult heights, m.

    0 where the clip does not show what is before or after.
    """
    before, after = height[max(first - window, 0) : first], height[last + 1 : last + 1 + window]
    if not len(before) or not len(after):
        return 0.0
    lowest = max(before.min(), after.min())
    return float(np.median(height[first : last + 1]) - lowest)


def amplitude(points_ws: Float64[np.ndarray, "frames *b 3"]) -> float:
    """Standard deviation of the noise of points along an axis, m; 0 in a clip too short to say."""
    if len(points_ws) <= ORDER:
        return 0.0
    differences = np.linalg.norm(np.diff(points_ws, ORDER, axis=0), axis=-1)
    return float(np.quantile(differences, QUANTILE)) / (GAIN * CHI)


def smoothed(
    points_ws: Float64[np.ndarray, "frames *b 3"], noise: float, speed_noise: float, fps: float
) -> Float64[np.ndarray, "frames *b 3"]:
    """The points, smoothed by a Gaussian just wide enough for a given noise of their speeds.

    Args:
        points_ws: m.
        noise: m, as `amplitude` gives it.
        speed_noise: m/s along an axis, to which the noise of speeds is brought.
        fps: frames per second.
    """
    width = (SLOPE * (noise * fps / speed_noise) ** 2) ** (1 / 3)
    if width < LEAST:
        return points_ws
    return gaussian_filter1d(points_ws, width, axis=0, mode="nearest")
