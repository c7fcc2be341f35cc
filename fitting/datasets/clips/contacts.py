"""When a foot stands: contact labels from the motion of the ball of the foot alone.

A foot stands while its ball is slow, and it was put down: a ball that came up into its slow spell
and leaves it downwards hangs at the top of a swing or a jump. The ground may lie at any height, so
no height is compared with a floor.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

SLOW = 0.25  # m/s: the ball of a standing foot is slower; a runner's too
WINDOW = 0.025  # s, to each side of a frame, over which speed is taken
GAP = 0.05  # s: shorter breaks of a stance are marker noise
SHORTEST = 0.06  # s: shorter stances are none; running has 0.075 s
AROUND = 0.2  # s before and after a slow spell, in which a hanging foot shows
HANG = 0.03  # m by which a hanging foot is above both its sides


def stance_labels(
    ball_ws: Float64[np.ndarray, "frames legs 3"], fps: float
) -> Bool[np.ndarray, "frames legs"]:
    """True where a foot stands.

    Args:
        ball_ws: the ball of each foot, m, y up.
        fps: frames per second.
    """
    slow = speeds(ball_ws, fps) < SLOW
    stance = np.zeros_like(slow)
    for leg in range(slow.shape[1]):
        spells = merge_runs(runs(slow[:, leg]), round(GAP * fps))
        for first, last in spells:
            long = last - first + 1 >= SHORTEST * fps
            if long and not _hangs(ball_ws[:, leg, 1], first, last, round(AROUND * fps)):
                stance[first : last + 1, leg] = True
    return stance


def speeds(points_ws: Float64[np.ndarray, "frames *b 3"], fps: float) -> np.ndarray:
    """Speed of each point, m/s, over 50 ms around each frame, of shape (frames, ...)."""
    reach = max(1, round(WINDOW * fps))
    frames = np.arange(len(points_ws))
    before, after = np.maximum(frames - reach, 0), np.minimum(frames + reach, len(frames) - 1)
    seconds = np.maximum(after - before, 1).reshape(-1, *[1] * (points_ws.ndim - 2)) / fps
    return np.linalg.norm(points_ws[after] - points_ws[before], axis=-1) / seconds


def runs(labels: Bool[np.ndarray, " frames"]) -> list[tuple[int, int]]:
    """First and last frame of each spell of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], labels.astype(np.int8), [0]])))
    return [(int(first), int(end) - 1) for first, end in edges.reshape(-1, 2)]


def merge_runs(spells: list[tuple[int, int]], gap: int) -> list[tuple[int, int]]:
    """The spells with breaks of at most `gap` frames closed."""
    joined: list[tuple[int, int]] = []
    for first, last in spells:
        if joined and first - joined[-1][1] - 1 <= gap:
            joined[-1] = (joined[-1][0], last)
        else:
            joined.append((first, last))
    return joined


@dataclass(frozen=True)
class Footfalls:
    """Where one foot stands, and between which stances it is in each frame."""

    places_ws: Float64[np.ndarray, "stances 3"]  # m, the median place of the ball
    last: Int64[np.ndarray, " frames"]  # the stance that it is in or comes from
    next: Int64[
        np.ndarray, " frames"
    ]  # the one after; before the first and after the last the same
    share: Float64[np.ndarray, " frames"]  # 0..1, of the swing's time that has passed


def footfalls(
    ball_ws: Float64[np.ndarray, "frames 3"], stance: Bool[np.ndarray, " frames"]
) -> Footfalls:
    """The footfalls of one foot that stands at least once.

    Args:
        ball_ws: its ball, m.
        stance: when it stands.
    """
    spells = runs(stance)
    frames = np.arange(len(stance))
    firsts, lasts = np.array(spells).T
    last = np.maximum(np.searchsorted(firsts, frames, side="right") - 1, 0)
    next_ = np.where(frames < firsts[0], 0, np.minimum(last + 1, len(spells) - 1))
    leaving, arriving = lasts[last], firsts[next_]
    swinging = (frames > leaving) & (next_ > last)
    share = np.where(swinging, (frames - leaving) / np.maximum(arriving - leaving, 1), 0.0)
    places = np.array([np.median(ball_ws[a : b + 1], axis=0) for a, b in spells])
    return Footfalls(places, last, next_, share)


def _hangs(height: Float64[np.ndarray, " frames"], first: int, last: int, around: int) -> bool:
    """Whether the foot comes up into this spell and leaves it downwards."""
    before, after = height[max(first - around, 0) : first], height[last + 1 : last + 1 + around]
    if not len(before) or not len(after):
        return False
    lowest = max(before.min(), after.min())
    return bool(np.median(height[first : last + 1]) - lowest > HANG)
