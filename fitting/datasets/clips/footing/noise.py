"""Noise of captured points, and how much smoothing takes it out of their speeds.

Noise is seen in fourth differences: a body moves too smoothly to have any at the rates of captures,
least of all while a foot stands, so that a low quantile of them shows noise alone.
"""

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import gaussian_filter1d

ORDER = 4  # of the differences
GAIN = 70.0**0.5  # of the noise in them: root of the sum of the squares of 1, 4, 6, 4, 1
QUANTILE, CHI = 0.25, 1.101  # and that quantile of the length of three normal deviates
# Variance of the slope of a Gaussian-smoothed series, times the cube of the Gaussian's width.
SLOPE = 1.0 / (4.0 * np.pi**0.5)
LEAST = 1.1  # frames: noise that needs no wider Gaussian does not show in speeds over 50 ms


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
