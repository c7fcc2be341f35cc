"""Terrain for the synthetic walks: meshes that rise and fall along z, about as wide as a street.

Each is built from profile points: the height of the ground along the path, and how far it tilts
sideways. Two points at the same z make a riser. The ground stays within 0.35 m of the floor y = 0,
so that foot IK on an animation made on that floor can see it with the default rays and follow it
within the default limits.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from fitting.ground.meshes import Mesh, grid_faces, join

HALF_WIDTH = 2.0  # m
STRIP_COLUMNS = 4  # cells across a strip
RUBBLE_CELL = 0.4  # m
STEP_HEIGHTS = (0.12, 0.18, 0.08, 0.14)  # m
TREAD = 0.62  # m
HOLD_SPACING = 0.125  # m, on a wall
HOLD_FRACTION = 0.3  # of the grid points of a wall that are holds
WALL_UP = (0.0, 0.0, -1.0)  # normal of the wall: a climber looks along +z
WALL_FROM_FLOOR = Rotation.from_matrix([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


class Point(NamedTuple):
    """A corner of a height profile."""

    z: float
    """Metres."""
    height: float
    """m, at x = 0."""
    tilt: float = 0.0
    """m per metre of x, to the character's left."""


def strip(profile: Sequence[Point]) -> Mesh:
    """Ground that is straight between the points of a profile, whose z must not decrease."""
    x = np.linspace(-HALF_WIDTH, HALF_WIDTH, STRIP_COLUMNS + 1)
    z, height, tilt = np.array([Point(*point) for point in profile]).T[:, :, None]
    y, x, z = np.broadcast_arrays(height + tilt * x, x, z)
    return Mesh(np.stack([x, y, z], axis=-1).reshape(-1, 3), grid_faces(*x.shape))


def rubble_patch(start: Point, end: Point, seed: int, size: float = 0.06) -> Mesh:
    """Irregular facets between two profile points.

    Args:
        start: where the rubble begins.
        end: where it ends.
        seed: of the irregularities.
        size: m, by which corners are above or below the line from `start` to `end`, at most.
    """
    rng = np.random.default_rng(seed)
    rows, columns = (
        round((end.z - start.z) / RUBBLE_CELL) + 1,
        round(2 * HALF_WIDTH / RUBBLE_CELL) + 1,
    )
    fraction, x = (
        np.linspace(0.0, 1.0, rows)[:, None],
        np.linspace(-HALF_WIDTH, HALF_WIDTH, columns),
    )
    height, tilt, z = (
        a + fraction * (b - a)
        for a, b in ((start.height, end.height), (start.tilt, end.tilt), (start.z, end.z))
    )
    x, y, z = (np.array(part) for part in np.broadcast_arrays(x, height + tilt * x, z))
    inner = slice(1, -1)
    shape = (rows - 2, columns)
    y[inner] += rng.uniform(-size, size, shape)
    z[inner] += rng.uniform(-0.3, 0.3, shape) * RUBBLE_CELL
    x[inner, inner] += rng.uniform(-0.3, 0.3, (rows - 2, columns - 2)) * RUBBLE_CELL
    return Mesh(np.stack([x, y, z], axis=-1).reshape(-1, 3), grid_faces(rows, columns))


def stairs(
    start: Point, rises: Sequence[float] = STEP_HEIGHTS, tread: float = TREAD
) -> list[Point]:
    """Profile of a flight of stairs that begins with a riser and ends with a whole tread.

    Args:
        start: where the flight begins; steps have no tilt.
        rises: m, of each step; negative for a step down.
        tread: m, depth of each step along z.
    """
    profile, z, height = [], start.z, start.height
    for rise in rises:
        height += rise
        profile += [Point(z, height), Point(z + tread, height)]
        z += tread
    return profile


def slope() -> Mesh:
    """Flat, then 2.5 m up at 12 degrees, tilted sideways, and flat again."""
    return strip([
        Point(-1.5, -0.25), Point(1.0, -0.25), Point(1.3, -0.2, 0.1),
        Point(3.3, 0.225, 0.1), Point(3.6, 0.28), Point(7.0, 0.28),
    ])  # fmt: skip


def steps() -> Mesh:
    """Flat, four irregular steps up, and flat again."""
    flight = stairs(Point(1.0, -0.25))
    return strip([Point(-1.5, -0.25), Point(1.0, -0.25), *flight, Point(7.0, flight[-1].height)])


def rubble() -> Mesh:
    """Flat, 4 m of rubble, and flat again."""
    start, end = Point(1.0, 0.0), Point(5.0, 0.0)
    return join(
        strip([Point(-1.5, 0.0), start]),
        rubble_patch(start, end, seed=3),
        strip([end, Point(7.0, 0.0)]),
    )


def uneven_walk() -> Mesh:
    """The course of the experiment `uneven_walk`, 20 m long.

    Flat; a tilted slope up; irregular steps down; rubble; irregular steps up; a tilted slope down,
    on which the walk slides; flat; a slope up.
    """
    down = stairs(Point(4.6, 0.32), (-0.08, -0.18, -0.10, -0.14))
    bottom = down[-1]
    rubble_end = Point(bottom.z + 2.8, -0.08)
    up = stairs(Point(rubble_end.z + 0.5, -0.08), (0.09, 0.16, 0.13))
    top = up[-1]
    return join(
        strip([
            Point(-1.5, 0.0), Point(1.6, 0.0), Point(1.9, 0.05, -0.12), Point(3.2, 0.32, -0.12),
            Point(3.6, 0.32), Point(4.6, 0.32), *down,
        ]),
        rubble_patch(bottom, rubble_end, seed=5),
        strip([
            rubble_end, Point(rubble_end.z + 0.5, -0.08), *up, Point(top.z + 0.3, top.height),
            Point(top.z + 0.8, 0.23, 0.14), Point(top.z + 1.5, 0.09, 0.14),
            Point(top.z + 2.1, -0.01, -0.12), Point(top.z + 3.4, -0.25, -0.12),
            Point(top.z + 3.8, -0.28), Point(top.z + 4.3, -0.28),
            Point(top.z + 6.0, 0.05, -0.08), Point(top.z + 8.0, 0.05, -0.08),
        ]),
    )  # fmt: skip


def stop_and_go() -> Mesh:
    """The course of the experiments `ozz`, `unreal` and `mec`, in which a walk stops, 11 m long.

    It stops half-way up a tilted slope, with one foot on each side of a riser, and on rubble.
    """
    down = stairs(Point(3.9, 0.25), (-0.12, -0.20, -0.08), tread=1.0)
    bottom = Point(6.4, down[-1].height)
    rubble_end = Point(8.4, -0.10)
    return join(
        strip([
            Point(-1.5, 0.0), Point(1.4, 0.0), Point(1.7, 0.03, 0.1), Point(3.4, 0.25, 0.1),
            Point(3.9, 0.25), *down[:-1], bottom,
        ]),
        rubble_patch(bottom, rubble_end, seed=7),
        strip([rubble_end, Point(9.0, 0.0, -0.1), Point(11.0, 0.0, -0.1)]),
    )  # fmt: skip


def terraces() -> Mesh:
    """The course of the experiment `stride`, 11 m long: terraces, and a ramp of 17 degrees."""
    up = stairs(Point(1.1, 0.0), (0.10, 0.15), tread=0.9)
    down = stairs(up[-1], (-0.15, 0.09, -0.21), tread=0.8)
    bottom = down[-1]
    ramp = Point(bottom.z + 1.3, bottom.height + 0.34, 0.08)
    return strip([
        Point(-1.5, 0.0), Point(1.1, 0.0), *up, *down, Point(bottom.z + 0.2, bottom.height, 0.08),
        ramp, Point(ramp.z + 0.2, ramp.height), Point(9.5, ramp.height),
    ])  # fmt: skip


def meadow() -> Mesh:
    """Tussocks on gently rolling ground, 8 m long."""
    profile = Point(-1.5, 0.0), Point(1.5, 0.08, 0.06), Point(4.0, -0.08, -0.05), Point(6.5, 0.05)
    pieces = zip(profile, profile[1:], strict=False)
    return join(
        *(rubble_patch(*ends, seed=13 + piece, size=0.04) for piece, ends in enumerate(pieces))
    )


def wall() -> Mesh:
    """A wall 3.5 m high and 2 m wide in the plane z = 0, with holds that stand out by 2 to 6 cm."""
    rng = np.random.default_rng(17)
    x, up = np.meshgrid(np.arange(-1.0, 1.01, HOLD_SPACING), np.arange(0.0, 3.51, HOLD_SPACING))
    protrusion = np.where(
        rng.uniform(size=x.shape) < HOLD_FRACTION, rng.uniform(0.02, 0.06, x.shape), 0.0
    )
    floor = np.stack([x, protrusion, up], axis=-1).reshape(-1, 3)
    return Mesh(floor @ WALL_FROM_FLOOR.as_matrix().T, grid_faces(*x.shape))
