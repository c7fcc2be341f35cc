"""The two seconds of a clip in which the fit is worst."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from fitting.problem.scene import PER_LEG

from .playback import Playback, Series

SECONDS = 2.0
POSITIONS = ("ankle", "knee", "pelvis")  # kinds that are a distance in the world
TIE = 1e-9  # relative difference below which two windows count as equally bad
MIN_SEEN = 0.5  # fraction of the window's frames that must have been seen


@dataclass(frozen=True)
class SoleGap:
    """Height of captured soles above the ground while they stand, m; negative in the ground."""

    mean: float
    rms: float
    frames: int
    """How many standing feet, counted frame by frame."""
    largest: float
    """The one with the largest magnitude."""
    frame: int
    """Where that is."""
    leg: int


@dataclass(frozen=True)
class WorstWindow:
    """The window with the largest residuals, and their composition."""

    start: int
    """Frame."""
    end: int
    """Frame, the last of the window."""
    rms: float
    """Of the residuals in the window, sigmas."""
    clip_rms: float
    """Of the residuals of the whole clip, sigmas."""
    fractions: Mapping[str, float]
    """Of the squared residuals, by kind, the largest first."""
    leg_fractions: Float[np.ndarray, " legs"]
    """Of the legs' squared residuals."""
    frame: int
    """Where the error of the largest kind is largest."""
    leg: int | None
    """Whose error that is; None for a kind that belongs to the body."""
    size: float
    """Of that error, in the unit of its sigma."""
    offset: Float[np.ndarray, "3"] | None
    """m up, forward, left of captured; None for other kinds."""
    out_of_reach: float
    """Fraction of the window's frames and legs."""
    pelvis: float
    """m, mean height above the captured pelvis; NaN where nothing was seen."""
    sole_gap: SoleGap | None
    """None where no captured foot stands above ground."""

    @property
    def kind(self) -> str:
        """The kind of residual with the largest part of the squares."""
        return next(iter(self.fractions))


def find_worst_window(playback: Playback) -> WorstWindow:
    """The two seconds with the largest root mean square of the residuals that the fit uses.

    Frames that were not seen do not count, and at least half of the window must have been seen. The
    window of a shorter clip is the whole clip.
    """
    squares = {kind: _squares(playback, kind) for kind in playback.fitted_kinds}
    per_frame = np.sum([values.sum(axis=1) for values in squares.values()], axis=0)
    seen = np.asarray(playback.seen)
    start, frames, mean_square = _worst_start(playback, per_frame)
    inside = slice(start, start + frames)
    totals = {kind: float(values[inside].sum()) for kind, values in squares.items()}
    kinds = sorted(totals, key=lambda kind: -totals[kind])
    per_leg = [squares[kind][inside].sum(axis=0) for kind in kinds if kind in PER_LEG]
    legs = np.broadcast_to(sum(per_leg, np.zeros(())), playback.stance.shape[1:])
    of_worst = sizes(playback, kinds[0], playback.seen)[inside]
    offset_frame, column = np.unravel_index(int(np.argmax(of_worst)), of_worst.shape)
    frame, leg = start + int(offset_frame), int(column) if kinds[0] in PER_LEG else None
    seen_inside = np.zeros_like(seen)
    seen_inside[inside] = seen[inside]
    pelvis = playback.height(playback.after.pelvis) - playback.height(playback.captured.pelvis)
    return WorstWindow(
        start=start,
        end=start + frames - 1,
        rms=float(np.sqrt(max(mean_square, 0.0))),
        clip_rms=float(
            np.sqrt(per_frame.sum() / (_per_frame_count(playback) * max(int(seen.sum()), 1)))
        ),
        fractions={kind: totals[kind] / max(sum(totals.values()), 1e-300) for kind in kinds},
        leg_fractions=legs / max(float(legs.sum()), 1e-300),
        frame=frame,
        leg=leg,
        size=float(of_worst[offset_frame, column]),
        offset=_offset(playback, kinds[0], frame, leg),
        out_of_reach=float(np.mean(np.asarray(playback.reached)[inside] < 0.5)),
        pelvis=float(pelvis[seen_inside].mean()) if seen_inside.any() else np.nan,
        sole_gap=_sole_gap(playback, seen_inside),
    )


def _worst_start(
    playback: Playback, squares: Float[np.ndarray, " frames"]
) -> tuple[int, int, float]:
    """First frame of the worst window, its length in frames, and its mean squared residual."""
    seen = np.asarray(playback.seen)
    frames = min(len(seen), 1 + round(SECONDS / float(np.median(playback.dt))))
    count = window_sums(seen.astype(float), frames)
    mean_square = np.where(
        count >= min(MIN_SEEN * frames, count.max()),
        window_sums(squares, frames) / (_per_frame_count(playback) * np.maximum(count, 1.0)),
        -1.0,
    )
    tied = np.flatnonzero(mean_square >= mean_square.max() * (1 - TIE))
    start = int(tied[len(tied) // 2])  # so that a single error is in the middle of the window
    return start, frames, float(mean_square[start])


def _per_frame_count(playback: Playback) -> int:
    """How many residuals a frame has."""
    shapes = [np.shape(playback.residuals[kind])[1:] for kind in playback.fitted_kinds]
    return sum(int(np.prod(shape)) for shape in shapes)


def _by_frame(values: np.ndarray, kind: str) -> Float[np.ndarray, "frames columns components"]:
    """Values of a kind, a column for each leg or one for the body.

    An acceleration belongs to the middle of its three frames; the first and last have none.
    """
    if kind == "smooth":
        values = np.pad(values, [(1, 1), (0, 0), (0, 0)])
    columns = values.shape[1] if kind in PER_LEG else 1
    return values.reshape(len(values), columns, -1)


def _squares(playback: Playback, kind: str) -> Float[np.ndarray, "frames columns"]:
    """Squared residuals of a kind; 0 in frames that were not seen."""
    squares = np.square(np.asarray(playback.residuals[kind], np.float64))
    return _by_frame(squares, kind).sum(axis=-1)


def sizes(
    playback: Playback, kind: str, frames: Bool[Series, " frames"]
) -> Float[np.ndarray, "frames columns"]:
    """Length of the error of a kind, in the unit of its sigma; 0 where it does not count.

    A column for each leg, or one for the body. Of the frames only these count.
    """
    errors = np.abs(np.asarray(playback.errors[kind], np.float64))
    lengths = np.linalg.norm(_by_frame(errors, kind), axis=-1)
    return np.where(playback.counts(kind, frames), lengths, 0.0)


def window_sums(series: Float[np.ndarray, " frames"], length: int) -> Float[np.ndarray, " windows"]:
    """Sums over all windows of `length` frames, by their first frame."""
    sums = np.concatenate([[0.0], np.cumsum(series)])
    return sums[length:] - sums[:-length]


def _offset(
    playback: Playback, kind: str, frame: int, leg: int | None
) -> Float[np.ndarray, "3"] | None:
    """How far up, forward and left of the captured joint the solved one is, m."""
    if kind not in POSITIONS:
        return None
    error = np.asarray(playback.errors[kind], np.float64)[frame]
    error = error if leg is None else error[leg]
    up, forward = np.asarray(playback.up_ws), np.asarray(playback.forward_ws)[frame]
    return np.array([error @ up, error @ forward, error @ np.cross(up, forward)])


def _sole_gap(playback: Playback, frames: Bool[np.ndarray, " frames"]) -> SoleGap | None:
    """Height of captured soles above the ground under the balls of the feet.

    The sole is as far below the ball as the animation's ball is above its floor while the foot
    stands, taken as the median over the clip.
    """
    stands = np.asarray(playback.stance) > 0.5
    above_floor = playback.height(playback.before.toe) - np.asarray(playback.floor)[:, None]
    depth = np.array(
        [
            np.median(above_floor[standing, leg]) if standing.any() else 0.0
            for leg, standing in enumerate(stands.T)
        ]
    )
    gap = playback.height(playback.captured.toe) - depth - playback.height(playback.ball_ground_ws)
    counted = frames[:, None] & stands & (np.asarray(playback.ball_grounded) > 0)
    if not counted.any():
        return None
    frame, leg = np.unravel_index(int(np.argmax(np.where(counted, np.abs(gap), -1.0))), gap.shape)
    return SoleGap(
        mean=float(gap[counted].mean()),
        rms=float(np.sqrt(np.mean(gap[counted] ** 2))),
        frames=int(counted.sum()),
        largest=float(gap[frame, leg]),
        frame=int(frame),
        leg=int(leg),
    )
