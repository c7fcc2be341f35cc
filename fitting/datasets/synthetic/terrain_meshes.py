"""Terrain made for the walks: meshes that rise and fall along z, about as wide as a street.

A `Profile` says how high the ground is along the way and how far it tilts sideways; two entries at
one z make a riser. The ground stays within 0.35 m of the floor y = 0, so that an animation on that
floor finds it with the record's rays and follows it within the record's limits.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

HALF_WIDTH = 2.0  # m
COLUMNS = 4  # of quads across a strip
CELL = 0.4  # m, of rubble
STEP_HEIGHTS = (0.12, 0.18, 0.08, 0.14)  # m
TREAD = 0.62  # m
HOLD, HOLDS = 0.125, 0.3  # m from hold to hold on a wall, and the share that stands out
WALL_UP = (0.0, 0.0, -1.0)  # normal of the wall: a climber looks along +z
WALL_FROM_FLOOR = Rotation.from_matrix([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


class Mesh(NamedTuple):
    """Triangles over vertices, m, world space, y up."""

    vertices: Float64[np.ndarray, "vertices 3"]
    faces: Int64[np.ndarray, "faces 3"]


class Knot(NamedTuple):
    """Where a profile bends."""

    z: float  # m
    height: float  # m, at x = 0
    tilt: float = 0.0  # m per metre of x, to the character's left


def strip(profile: Sequence[Knot]) -> Mesh:
    """Ground that runs straight between the knots; their z never falls."""
    x = np.linspace(-HALF_WIDTH, HALF_WIDTH, COLUMNS + 1)
    z, height, tilt = np.array([Knot(*knot) for knot in profile]).T[:, :, None]
    y, x, z = np.broadcast_arrays(height + tilt * x, x, z)
    return Mesh(np.stack([x, y, z], axis=-1).reshape(-1, 3), quads(*x.shape))


def rubble(start: Knot, end: Knot, seed: int, size: float = 0.06) -> Mesh:
    """Tilted facets between two knots, each corner up to `size`, m, above or below the line."""
    rng = np.random.default_rng(seed)
    rows, columns = round((end.z - start.z) / CELL) + 1, round(2 * HALF_WIDTH / CELL) + 1
    share, x = np.linspace(0.0, 1.0, rows)[:, None], np.linspace(-HALF_WIDTH, HALF_WIDTH, columns)
    height, tilt, z = (
        a + share * (b - a)
        for a, b in ((start.height, end.height), (start.tilt, end.tilt), (start.z, end.z))
    )
    x, y, z = (np.array(part) for part in np.broadcast_arrays(x, height + tilt * x, z))
    inner = slice(1, -1)
    shape = (rows - 2, columns)
    y[inner] += rng.uniform(-size, size, shape)
    z[inner] += rng.uniform(-0.3, 0.3, shape) * CELL
    x[inner, inner] += rng.uniform(-0.3, 0.3, (rows - 2, columns - 2)) * CELL
    return Mesh(np.stack([x, y, z], axis=-1).reshape(-1, 3), quads(rows, columns))


def stairs(start: Knot, rises: Sequence[float] = STEP_HEIGHTS, tread: float = TREAD) -> list[Knot]:
    """Knots of a flight that begins with a riser at `start` and ends with a whole tread.

    Args:
        start: where the flight begins; steps have no tilt.
        rises: m, of each step; below 0 it goes down.
        tread: m, along z.
    """
    knots, z, height = [], start.z, start.height
    for rise in rises:
        height += rise
        knots += [Knot(z, height), Knot(z + tread, height)]
        z += tread
    return knots


def join(*meshes: Mesh) -> Mesh:
    """The meshes as one."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def slope() -> Mesh:
    """Flat, then 2.5 m up at 12 degrees, tilted sideways, and flat again."""
    return strip([
        Knot(-1.5, -0.25), Knot(1.0, -0.25), Knot(1.3, -0.2, 0.1),
        Knot(3.3, 0.225, 0.1), Knot(3.6, 0.28), Knot(7.0, 0.28),
    ])  # fmt: skip


def steps() -> Mesh:
    """Flat, four irregular steps up, and flat again."""
    flight = stairs(Knot(1.0, -0.25))
    return strip([Knot(-1.5, -0.25), Knot(1.0, -0.25), *flight, Knot(7.0, flight[-1].height)])


def stones() -> Mesh:
    """Flat, 4 m of rubble, and flat again."""
    start, end = Knot(1.0, 0.0), Knot(5.0, 0.0)
    return join(
        strip([Knot(-1.5, 0.0), start]), rubble(start, end, seed=3), strip([end, Knot(7.0, 0.0)])
    )


def uneven() -> Mesh:
    """The course of the experiment "uneven walk", 20 m long.

    Flat; a tilted slope up; irregular steps down; rubble; irregular steps up; a tilted slope down,
    where the walk slides; flat; a slope up.
    """
    down = stairs(Knot(4.6, 0.32), (-0.08, -0.18, -0.10, -0.14))
    foot = down[-1]
    stones = Knot(foot.z + 2.8, -0.08)
    up = stairs(Knot(stones.z + 0.5, -0.08), (0.09, 0.16, 0.13))
    top = up[-1]
    return join(
        strip([
            Knot(-1.5, 0.0), Knot(1.6, 0.0), Knot(1.9, 0.05, -0.12), Knot(3.2, 0.32, -0.12),
            Knot(3.6, 0.32), Knot(4.6, 0.32), *down,
        ]),
        rubble(foot, stones, seed=5),
        strip([
            stones, Knot(stones.z + 0.5, -0.08), *up, Knot(top.z + 0.3, top.height),
            Knot(top.z + 0.8, 0.23, 0.14), Knot(top.z + 1.5, 0.09, 0.14),
            Knot(top.z + 2.1, -0.01, -0.12), Knot(top.z + 3.4, -0.25, -0.12),
            Knot(top.z + 3.8, -0.28), Knot(top.z + 4.3, -0.28),
            Knot(top.z + 6.0, 0.05, -0.08), Knot(top.z + 8.0, 0.05, -0.08),
        ]),
    )  # fmt: skip


def stop_and_go() -> Mesh:
    """The course of the experiments in which a walk stops, 11 m long.

    The stands are half way up a tilted slope, with a foot on either side of a riser, and on rubble.
    """
    down = stairs(Knot(3.9, 0.25), (-0.12, -0.20, -0.08), tread=1.0)
    foot = Knot(6.4, down[-1].height)
    stones = Knot(8.4, -0.10)
    return join(
        strip([
            Knot(-1.5, 0.0), Knot(1.4, 0.0), Knot(1.7, 0.03, 0.1), Knot(3.4, 0.25, 0.1),
            Knot(3.9, 0.25), *down[:-1], foot,
        ]),
        rubble(foot, stones, seed=7),
        strip([stones, Knot(9.0, 0.0, -0.1), Knot(11.0, 0.0, -0.1)]),
    )  # fmt: skip


def meadow() -> Mesh:
    """Tussocks on gently rolling ground, 8 m long."""
    knots = Knot(-1.5, 0.0), Knot(1.5, 0.08, 0.06), Knot(4.0, -0.08, -0.05), Knot(6.5, 0.05)
    pieces = zip(knots, knots[1:], strict=False)
    return join(*(rubble(*ends, seed=13 + piece, size=0.04) for piece, ends in enumerate(pieces)))


def wall() -> Mesh:
    """A wall 3.5 m high and 2 m wide in the plane z = 0, with holds 2 to 6 cm proud of it."""
    rng = np.random.default_rng(17)
    x, up = np.meshgrid(np.arange(-1.0, 1.01, HOLD), np.arange(0.0, 3.51, HOLD))
    proud = np.where(rng.uniform(size=x.shape) < HOLDS, rng.uniform(0.02, 0.06, x.shape), 0.0)
    floor = np.stack([x, proud, up], axis=-1).reshape(-1, 3)
    return Mesh(floor @ WALL_FROM_FLOOR.as_matrix().T, quads(*x.shape))


def quads(rows: int, columns: int) -> Int64[np.ndarray, "faces 3"]:
    """Two triangles for each cell of a grid of vertices, facing up where rows go along z."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1)
    near, far = corner, corner + columns
    first = np.stack([near, far, far + 1], axis=-1)
    second = np.stack([near, far + 1, near + 1], axis=-1)
    return np.concatenate([first, second]).astype(np.int64)
