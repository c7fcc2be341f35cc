"""The ground around a character's path as heights on a regular grid, for pictures."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial import KDTree

from fitting.clips.clip import Clip
from jaxik.world import body
from jaxik.world.terrain import Terrain

from .ground_path import heights_under

MARGIN = 1.5  # m around the path, for an adult
FINEST = 0.025  # m between heights, for an adult
MAX_HEIGHTS = 40_000  # within the margin
MAX_CELLS = 200_000  # of the grid, which also covers what is further away
HEADROOM = 0.3  # m above the highest joint, where rays start: below a ceiling
CHUNK = 8_192  # rays that are cast at a time, so that one program serves all patches


@dataclass(frozen=True)
class GroundPatch:
    """Heights of the ground on a grid that is aligned with x and z."""

    corner: Float64[np.ndarray, "2"]
    """x and z of the first height, m."""
    spacing: float
    """m, in both directions."""
    heights: Float64[np.ndarray, "rows columns"]
    """m; rows follow z, columns x. NaN where there is no ground, and further from the path."""


def around_path(clip: Clip, terrain: Terrain) -> GroundPatch:
    """The ground around the path of a clip's pelvis.

    Rays start a little above the character, so that a roof is not ground.

    Args:
        clip: y up, of one frame or more.
        terrain: y up.
    """
    size = body.ratio(clip.rig)
    path = clip.positions_ws[:, clip.rig.pelvis][:, [0, 2]]
    tops = clip.positions_ws[..., 1].max(axis=1) + HEADROOM * size
    tree, margin = KDTree(path), MARGIN * size
    low, high = path.min(axis=0) - margin, path.max(axis=0) + margin
    extent = high - low
    spacing = max(FINEST * size, float(np.sqrt(extent[0] * extent[1] / MAX_CELLS)))
    points, near = _grid(low, high, spacing, tree, margin)
    if near.sum() > MAX_HEIGHTS:
        spacing *= float(np.sqrt(near.sum() / MAX_HEIGHTS))
        points, near = _grid(low, high, spacing, tree, margin)
    nearest = tree.query(points[near])[1]
    heights = np.full(points.shape[:2], np.nan)
    heights[near] = _heights(terrain, points[near], tops[nearest])
    return GroundPatch(low, spacing, heights)


def _grid(
    low: np.ndarray, high: np.ndarray, spacing: float, tree: KDTree, margin: float
) -> tuple[Float64[np.ndarray, "rows columns 2"], Bool[np.ndarray, "rows columns"]]:
    """Points x, z of a grid, and which of them are near the path."""
    x, z = (np.arange(a, b + spacing, spacing) for a, b in zip(low, high, strict=True))
    points = np.stack(np.meshgrid(x, z), axis=-1)
    distance = tree.query(points, distance_upper_bound=margin)[0]
    return points, np.isfinite(distance)


def _heights(
    terrain: Terrain,
    points: Float64[np.ndarray, "points 2"],
    starts: Float64[np.ndarray, " points"],
) -> Float64[np.ndarray, " points"]:
    count = len(points)
    padding = -count % CHUNK
    x, z, starts = (np.pad(a, (0, padding), mode="edge") for a in (*points.T, starts))
    rays = np.stack([x, np.zeros_like(x), z], axis=-1).reshape(-1, CHUNK, 3)
    chunks = zip(rays, starts.reshape(-1, CHUNK), strict=True)
    return np.concatenate([heights_under(terrain, *chunk) for chunk in chunks])[:count]
