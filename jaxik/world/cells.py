"""Builds the cells of a grid and the lists of triangles that touch them; NumPy, on the host."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

CELLS = 2.0  # cells per triangle at most: fewer mean longer lists, more only take memory
ENTRIES = 12  # list entries per triangle, on average, above which cells grow, or split no more
CROWD = 16  # a cell with more triangles is split
SPLIT = 4  # into this many parts along each side
DEPTH = 6  # at most this many times
CHUNK = 1 << 20  # pairs tested at a time; bounds the memory of a build

# Centres of a cell's parts, in half sides from its own centre, in the order of `Grid.look_up`.
_OFFSETS = (2 * np.indices((SPLIT, SPLIT)).reshape(2, -1).T + 1) / SPLIT - 1.0


class CellLists(NamedTuple):
    """The discrete part of a `Grid`; the fields are described there."""

    corner: np.ndarray
    pitch: float
    first: np.ndarray
    children: np.ndarray
    members: np.ndarray
    shape: tuple[int, int]
    depth: int


class _Layout(NamedTuple):
    """A regular grid of unsplit cells."""

    shape: tuple[int, int]  # cells along both sides
    corner: np.ndarray  # (2) m, of the first cell
    pitch: float  # m, side of a cell


class _Level(NamedTuple):
    """Cells of one size, and the pairs of a cell and a triangle that touch."""

    centres: np.ndarray  # (cells, 2) m
    half_side: float  # m
    cell: np.ndarray  # (pairs) index into `centres`
    triangle: np.ndarray  # (pairs)


def build(
    plan: Float[np.ndarray, "triangles 3 2"], listed: Bool[np.ndarray, " triangles"], pad: float
) -> CellLists:
    """The cells over triangles in the plane.

    Args:
        plan: corners, m.
        listed: which triangles are to be found.
        pad: distance, m, up to which a triangle beside a cell counts as touching it.
    """
    numbers = np.flatnonzero(listed)
    corners = plan[numbers]
    layout = _lay_out(corners, pad)
    level = _first_level(corners, layout, pad)
    children, settled = [], []
    base, depth = 0, 0  # base: number of this level's first cell
    while True:
        cells = len(level.centres)
        crowded = np.bincount(level.cell, minlength=cells) > CROWD
        # Triangles that lie on each other, or long ones side by side, would fill all parts.
        entries = int(crowded[level.cell].sum())
        if depth < DEPTH and 0 < entries <= _most_entries(len(corners)):
            split, finer = _split(corners, level, crowded, pad)
        else:
            split, finer = np.zeros(0, np.int64), level
        first_parts = np.full(cells, -1)
        first_parts[split] = base + cells + SPLIT**2 * np.arange(len(split))
        stays = first_parts[level.cell] < 0
        settled.append((base + level.cell[stays], level.triangle[stays]))
        children.append(first_parts)
        base += cells
        if not len(split):
            break
        level, depth = finer, depth + 1

    cell, triangle = (np.concatenate(parts) for parts in zip(*settled, strict=True))
    order = np.argsort(cell, kind="stable")
    counts = np.bincount(cell, minlength=base)
    return CellLists(
        corner=layout.corner,
        pitch=layout.pitch,
        first=np.concatenate([[0], np.cumsum(counts)]),
        children=np.concatenate(children),
        # At least one entry, for rays that have nothing to hit but read one all the same.
        members=numbers[triangle[order]] if len(triangle) else np.zeros(1, np.int64),
        shape=layout.shape,
        depth=depth,
    )


def _most_entries(triangles: int) -> int:
    """How long the lists of this many triangles may be together, before cells are split."""
    return ENTRIES * triangles + 64


def _lay_out(corners: np.ndarray, pad: float) -> _Layout:
    """The unsplit cells over these triangles, as many as `CELLS` and `ENTRIES` allow."""
    if not len(corners):
        return _Layout((1, 1), np.zeros(2), 1.0)
    low, high = corners.min(axis=1) - pad, corners.max(axis=1) + pad
    origin, size = low.min(axis=0), high.max(axis=0) - low.min(axis=0)
    wanted = CELLS * len(corners)
    pitch = max(np.sqrt(size[0] * size[1] / wanted), size.max() / wanted) or 1.0
    while True:
        spans = np.floor((high - origin) / pitch) - np.floor((low - origin) / pitch) + 1
        if spans.prod(axis=1).sum() <= _most_entries(len(corners)):
            break
        pitch *= 1.25
    # The shift keeps the lines of the grid off those of a mesh that is a regular grid itself.
    across, along = np.floor(size / pitch + 0.37).astype(int) + 1
    return _Layout((int(across), int(along)), origin - 0.37 * pitch, float(pitch))


def _first_level(corners: np.ndarray, layout: _Layout, pad: float) -> _Level:
    """The unsplit cells with the triangles that touch them."""
    shape, corner, pitch = layout
    last = np.array(shape) - 1
    low = np.clip(np.floor((corners.min(axis=1) - pad - corner) / pitch).astype(int), 0, last)
    high = np.clip(np.floor((corners.max(axis=1) + pad - corner) / pitch).astype(int), 0, last)
    spans = high - low + 1
    counts = spans.prod(axis=1)
    # First all pairs whose bounding boxes overlap.
    triangle = np.repeat(np.arange(len(corners)), counts)
    step = np.arange(len(triangle)) - np.repeat(np.cumsum(counts) - counts, counts)
    row = low[triangle, 0] + step // spans[triangle, 1]
    column = low[triangle, 1] + step % spans[triangle, 1]
    cell = row * shape[1] + column
    centres = corner + pitch * (np.indices(shape).reshape(2, -1).T + 0.5)
    touching = _touching(corners, triangle, centres[cell], pitch / 2 + pad)
    return _Level(centres, pitch / 2, cell[touching], triangle[touching])


def _split(
    corners: np.ndarray, level: _Level, crowded: np.ndarray, pad: float
) -> tuple[np.ndarray, _Level]:
    """The crowded cells that are worth splitting, and the level of their parts.

    Not worth it are cells whose triangles lie on top of each other: they would fill every part as
    they fill the whole.
    """
    inside = crowded[level.cell]
    parts = SPLIT**2
    cell, triangle = np.repeat(level.cell[inside], parts), np.repeat(level.triangle[inside], parts)
    part = np.tile(np.arange(parts), int(inside.sum()))
    centres = level.centres[cell] + level.half_side * _OFFSETS[part]
    half_side = level.half_side / SPLIT
    touching = _touching(corners, triangle, centres, half_side + pad)
    cell, triangle, part = cell[touching], triangle[touching], part[touching]
    before = np.bincount(level.cell, minlength=len(level.centres))
    after = np.bincount(cell, minlength=len(level.centres))
    worthwhile = crowded & (after <= before * parts / 2)
    rank = np.cumsum(worthwhile) - 1
    kept = worthwhile[cell]
    split = np.flatnonzero(worthwhile)
    return split, _Level(
        (level.centres[split][:, None] + level.half_side * _OFFSETS).reshape(-1, 2),
        half_side,
        rank[cell[kept]] * parts + part[kept],
        triangle[kept],
    )


def _touching(
    corners: np.ndarray, triangle: np.ndarray, centres: np.ndarray, half_side: float
) -> Bool[np.ndarray, " pairs"]:
    """Whether each square of this half side about a centre touches its triangle.

    By separating axes: the two sides of the square and the normals of the triangle's edges.
    """
    x, z = corners[..., 0].T, corners[..., 1].T
    edges_x, edges_z = np.roll(x, -1, axis=0) - x, np.roll(z, -1, axis=0) - z
    ones = np.ones_like(x[:1])
    axes_x = np.concatenate([-edges_z, ones, 0 * ones])
    axes_z = np.concatenate([edges_x, 0 * ones, ones])
    touching = np.ones(len(triangle), bool)
    for axis_x, axis_z in zip(axes_x, axes_z, strict=True):
        projected = axis_x * x + axis_z * z
        margin = half_side * (np.abs(axis_x) + np.abs(axis_z))
        low, high = projected.min(axis=0) - margin, projected.max(axis=0) + margin
        for begin in range(0, len(triangle), CHUNK):
            pairs = slice(begin, begin + CHUNK)
            member, centre = triangle[pairs], centres[pairs]
            projection = axis_x[member] * centre[:, 0] + axis_z[member] * centre[:, 1]
            touching[pairs] &= (low[member] <= projection) & (projection <= high[member])
    return touching
