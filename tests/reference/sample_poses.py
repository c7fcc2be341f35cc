"""Rigs, poses, short clips and terrains on which the references and `jaxik` are compared."""

import dataclasses
import math
from typing import Any

import numpy as np

from reference import maths
from reference.characters import JOINTS, Frame, Rig
from reference.maths import Transform
from reference.terrain import Terrain

THIGH, SHIN, ANKLE = 0.45, 0.43, 0.08  # m; ANKLE is the height over the sole
STILL = Transform(np.zeros(3), maths.IDENTITY)


def random_rot(rng: np.random.Generator) -> np.ndarray:
    """A uniformly distributed unit quaternion."""
    q = rng.normal(size=4)
    return q / np.linalg.norm(q)


def make_rig(rng: np.random.Generator, legs: int = 2) -> Rig:
    """Random joint spaces; left and right legs, and a third one in the middle."""
    axis = rng.normal(size=(legs, 3))
    side = np.array([1.0, -1.0, 0.0][:legs])
    return Rig(
        knee_axis_ls=axis / np.linalg.norm(axis, axis=-1, keepdims=True),
        ankle_from_foot=np.array([random_rot(rng) for _ in range(legs)]),
        side=side,
    )


def make_frame(
    rig: Rig,
    ankles: np.ndarray,
    hip_height: float = 0.90,
    hinge_yaw: float = 0.0,
    **changes,
) -> Frame:
    """Legs bent about a sideways hinge to the given ankles (legs, 3, model space), with flat feet.

    In knee space the rig's knee axis is the hinge; in ankle space the foot is flat and points
    along model forward.
    """
    columns = {name: ([], []) for name in JOINTS}
    for leg, ankle in enumerate(np.asarray(ankles, dtype=float)):
        hip = np.array([0.1 * rig.side[leg], hip_height, 0.0])
        distance = np.linalg.norm(ankle - hip)
        down = (ankle - hip) / distance
        hinge = maths.rotate(maths.from_axis_angle(maths.Y, hinge_yaw), -maths.X)
        hinge = maths.unit(maths.across(hinge, down), hinge)
        bend = math.acos((THIGH**2 + distance**2 - SHIN**2) / (2 * THIGH * distance))
        knee = hip + maths.rotate(maths.from_axis_angle(hinge, bend), down * THIGH)
        knee_rot = maths.shortest_arc(rig.knee_axis_ls[leg], hinge, maths.Y)
        ankle_rot = maths.inverse(rig.ankle_from_foot[leg])
        toe = ankle + np.array([0.0, 0.02 - ANKLE, 0.15])
        rots = (maths.IDENTITY, knee_rot, ankle_rot, ankle_rot)
        for name, pos, rot in zip(JOINTS, (hip, knee, ankle, toe), rots, strict=True):
            columns[name][0].append(pos)
            columns[name][1].append(rot)
    joints = {name: Transform(np.array(pos), np.array(rot)) for name, (pos, rot) in columns.items()}
    rest = {"world_from_model": STILL, "weight": np.ones(len(ankles)), "slide": 0.0, "dt": 1 / 60}
    fields: dict[str, Any] = joints | rest | changes
    return Frame(**fields)


def with_speeds(frames: list[Frame]) -> list[Frame]:
    """The clip with speeds from the differences to the previous frame.

    The first frame gets the speeds of the second.
    """

    def places(frame: Frame, joint: str) -> np.ndarray:
        return np.array([maths.apply(frame.world_from_model, x) for x in getattr(frame, joint).pos])

    timed = []
    for index, frame in enumerate(frames):
        now = max(index, min(1, len(frames) - 1))
        after, before = frames[now], frames[max(now - 1, 0)]
        velocity = (after.world_from_model.pos - before.world_from_model.pos) / after.dt
        foot_speed, toe_speed = (
            np.linalg.norm(places(after, joint) - places(before, joint), axis=-1) / after.dt
            for joint in ("ankle", "toe")
        )
        speeds = {"velocity_ws": velocity, "speed": float(np.linalg.norm(velocity))}
        speeds |= {"foot_speed": foot_speed, "toe_speed": toe_speed}
        timed.append(dataclasses.replace(frame, **speeds))
    return timed


def standing(heights: tuple[float, ...] = (ANKLE, ANKLE), forward: float = 0.05) -> np.ndarray:
    """Ankles (legs, 3) under the hips at the given heights."""
    sides = (0.1, -0.1, 0.0)
    return np.array([[x, y, forward] for x, y in zip(sides, heights, strict=False)])


def plane(slope_forward: float, slope_left: float, height: float = 0.0) -> Terrain:
    """A plane that rises forward and to the left with the given tangents."""
    normal = np.array([-slope_left, 1.0, -slope_forward])
    return Terrain(maths.Y, planes=[(np.array([0.0, height, 0.0]), normal)])


def rough(rng: np.random.Generator, cells: int = 23, size: float = 6.0) -> Terrain:
    """A height field of about a thousand triangles around the origin."""
    heights = rng.uniform(-0.06, 0.06, size=(cells + 1, cells + 1))
    line = np.linspace(-size / 2, size / 2, cells + 1)
    x, z = np.meshgrid(line, line, indexing="ij")
    grid = np.stack([x, heights, z], axis=-1)
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[:-1, 1:], grid[1:, 1:]
    triangles = np.concatenate([np.stack([a, c, b], -2), np.stack([b, c, d], -2)])
    return Terrain(maths.Y, triangles=triangles.reshape(-1, 3, 3))


def rotation_angle(a: np.ndarray, b: np.ndarray) -> float:
    """Largest angle between rotations of equal shape (..., 4)."""
    a, b = a.reshape(-1, 4), b.reshape(-1, 4)
    apart = np.minimum(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))
    return float(np.max(4.0 * np.arcsin(np.minimum(apart / 2.0, 1.0))))
