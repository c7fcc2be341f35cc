"""The axes of engines, and their conversion to ours: x left, y up, z forward, m, right-handed.

Model space and world space are converted alike. A point keeps its place in the world and a rotation
its effect: with M the matrix of an engine's axes, a point p is M p here, and a rotation R is
M R M^T, whose quaternion has the vector part det(M) M v.
"""

from typing import NamedTuple

import numpy as np


class Axes(NamedTuple):
    """The axes of an engine, whose quaternions are x y z w."""

    meaning: str
    ours: tuple[tuple[int, int], tuple[int, int], tuple[int, int]]
    """For each of our axes: the engine's axis along it, and 1, or -1 if that points backwards."""
    unit: float
    """m, the engine's unit of length."""

    @property
    def handedness(self) -> int:
        """1 if right-handed as ours, -1 if left-handed."""
        matrix = np.zeros((3, 3))
        for row, (axis, sign) in enumerate(self.ours):
            matrix[row, axis] = sign
        return round(np.linalg.det(matrix))

    @property
    def theirs(self) -> list[tuple[int, int]]:
        """As `ours`, for each of the engine's axes."""
        return [
            next((ours, sign) for ours, (theirs, sign) in enumerate(self.ours) if theirs == axis)
            for axis in range(3)
        ]


ENGINES = {
    "unreal": Axes("x forward, y right, z up, cm, left-handed", ((1, -1), (2, 1), (0, 1)), 0.01),
    "unity": Axes("x right, y up, z forward, m, left-handed", ((0, -1), (1, 1), (2, 1)), 1.0),
    "godot": Axes("as ours: models face z; m, right-handed", ((0, 1), (1, 1), (2, 1)), 1.0),
}


class Conversion(NamedTuple):
    """A function that makes an array of another one."""

    name: str
    source: str
    """"theirs", if it is the engine's, or "ours"."""
    parts: list[tuple[int, float]]
    """Of each number: which one of the source it is, and by what that is multiplied."""


def conversions(engine: str) -> list[Conversion]:
    """Points, directions and rotations from an engine's axes and to them."""
    axes = ENGINES[engine]
    ways = ("from", "theirs", axes.ours, axes.unit), ("to", "ours", axes.theirs, 1.0 / axes.unit)
    listed = []
    for way, source, rows, unit in ways:
        points = [(i, sign * unit) for i, sign in rows]
        directions = [(i, float(sign)) for i, sign in rows]
        turns = [(i, float(sign * axes.handedness)) for i, sign in rows]
        if source == "ours":
            rotations = [*((1 + i, sign) for i, sign in turns), (0, 1.0)]
        else:
            rotations = [(3, 1.0), *turns]
        parts = {"point": points, "direction": directions, "rotation": rotations}
        listed += [Conversion(f"{kind}_{way}_{engine}", source, parts[kind]) for kind in parts]
    return listed
