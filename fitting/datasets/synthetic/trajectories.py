"""Smooth ways from one value to another, for made motion."""

import numpy as np


def smoothstep(share: np.ndarray) -> np.ndarray:
    """0 to 1 over a share of 0 to 1, level to the second order at both ends."""
    x = np.clip(share, 0.0, 1.0)
    return x**3 * (10.0 + x * (6.0 * x - 15.0))


def hermite(
    share: np.ndarray, start: np.ndarray, rise: np.ndarray, end: np.ndarray, end_rise: np.ndarray
) -> np.ndarray:
    """The cubic with these ends and slopes, the slopes per whole share."""
    x = share[:, None]
    turn = (1.0 - x) ** 2 * ((1.0 + 2.0 * x) * start + x * rise)
    return turn + x**2 * ((3.0 - 2.0 * x) * end + (x - 1.0) * end_rise)
