"""Grounds to walk on: a hill and flights of stairs, as meshes."""

from collections.abc import Sequence

import numpy as np

from fitting.clips import Clip, contacts
from fitting.ground.meshes import Mesh
from fitting.synthetic.terrain_meshes import Point, strip
from jaxik.world import terrain
from jaxik.world.terrain import Terrain


def terrain_of(mesh: Mesh) -> Terrain:
    return terrain.mesh(mesh.vertices, mesh.faces)


def hill(height: float = 2.0, length: float = 14.0, rows: int = 321) -> Mesh:
    """Flat for 1 m of z, a hill of one cosine wave, and flat again."""
    z = np.linspace(-2.0, 30.0, rows)
    inside = np.clip((z - 1.0) / length, 0.0, 1.0)
    heights = 0.5 * height * (1.0 - np.cos(2.0 * np.pi * inside))
    return strip([Point(*point) for point in zip(z, heights, strict=True)])


def flight(edges: Sequence[float], rise: float = 0.15) -> Mesh:
    """Flat ground with a step up at each of these z, m."""
    profile = [Point(-2.0, 0.0)]
    for step, z in enumerate(edges):
        profile += [Point(z, step * rise), Point(z, (step + 1) * rise)]
    return strip([*profile, Point(30.0, len(edges) * rise)])


def edges_between_footfalls(clip: Clip, count: int, first: int = 2) -> list[float]:
    """The z of edges such that each footfall of a walk along +z is in the middle of a tread."""
    balls, stance = clip.joints_ws(3), clip.stance_labels()
    footfalls = sorted(
        float(np.median(balls[begin : end + 1, leg, 2]))
        for leg in range(stance.shape[1])
        for begin, end in contacts.runs(stance[:, leg])
    )
    # The ball is ahead of the middle of the foot.
    middles = np.array(footfalls[first : first + count + 1]) - 0.06
    return [float(z) for z in 0.5 * (middles[1:] + middles[:-1])]
