"""A capture that shows motion later or earlier than the fitted system, from its ankles."""

import numpy as np

from fitting.analysis.playback import Playback

LONGEST = 0.2  # s, that is looked for
SHORTEST = 0.01  # s, and half a frame, from which a lag is named
BETTER = 0.8  # of the rms distance of ankles: what is left of it without the lag
FEWEST = 10  # frames that are compared


def measure(clip: Playback) -> float:
    """How long after the fitted motion the capture shows the same, s; 0 unless that is clear.

    Args:
        clip: with the fitted system.
    """
    dt, frames = float(clip.dt[-1]), len(clip.dt)
    reach = min(round(LONGEST / dt), (frames - FEWEST) // 2)
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
    if len(errors) < FEWEST:
        return float("nan")
    return float(np.mean((errors - errors.mean(axis=0)) ** 2))
