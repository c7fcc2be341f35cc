"""A ground that is off by a height or a tilt, from where captured feet stand."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from fitting.datasets.clips.contacts import runs

VISIBLE = 0.015  # m, from which an offset is named
CLEAR = 2.0  # times its scatter
FEWEST = 4  # stances for a height
FEWEST_FOR_TILT = 8
EXPLAINED = 0.8  # of the variance of heights between stances, by a tilt


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


def measure(
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
    if len(heights) < FEWEST:
        return GroundOffset(0.0, float("nan"), len(heights))
    tilts = _tilts(heights, where)
    level = heights - (where - where.mean(axis=0)) @ np.tan(tilts)
    height = float(np.median(level))
    scatter = 1.4826 * float(np.median(np.abs(level - height)))
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
