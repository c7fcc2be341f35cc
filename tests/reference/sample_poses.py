"""Rigs, poses, short clips and terrains on which the references and `jaxik` are compared."""

import dataclasses
import math

import numpy as np

from reference import maths
from reference.characters import Frame, Rig
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
    columns = {name: ([], []) for name in ("hip", "knee", "ankle", "toe")}
    for leg, ankle in enumerate(np.asarray(ankles, dtype=float)):
        hip = np.array([0.1 * rig.side[leg], hip_height, 0.0])
        reach = ankle - hip
        distance = np.linalg.norm(reach)
        down = reach / distance
        hinge = maths.rotate(maths.from_axis_angle(maths.Y, hinge_yaw), -maths.X)
        hinge = maths.unit(maths.across(hinge, down), hinge)
        bend = math.acos((THIGH**2 + distance**2 - SHIN**2) / (2 * THIGH * distance))
        knee = hip + maths.rotate(maths.from_axis_angle(hinge, bend), down * THIGH)
        knee_rot = maths.shortest_arc(rig.knee_axis_ls[leg], hinge, maths.Y)
        ankle_rot = maths.inverse(rig.ankle_from_foot[leg])
        toe = ankle + np.array([0.0, 0.02 - ANKLE, 0.15])
        placed = {"hip": (hip, maths.IDENTITY), "knee": (knee, knee_rot)}
        placed |= {"ankle": (ankle, ankle_rot), "toe": (toe, ankle_rot)}
        for name, (pos, rot) in placed.items():
            columns[name][0].append(pos)
            columns[name][1].append(rot)
    joints = {name: Transform(np.array(pos), np.array(rot)) for name, (pos, rot) in columns.items()}
    frame = Frame(
        world_from_model=STILL,
        hip=joints["hip"],
        knee=joints["knee"],
        ankle=joints["ankle"],
        toe=joints["toe"],
        weight=np.ones(len(ankles)),
        slide=0.0,
        dt=1 / 60,
    )
    return dataclasses.replace(frame, **changes)


def with_speeds(frames: list[Frame]) -> list[Frame]:
    """The clip with speeds from the differences to the previous frame.

    The first frame gets the speeds of the second.
    """
    roots = [frame.world_from_model.pos for frame in frames]
    ankles, toes = (
        [
            np.array(
                [maths.apply(frame.world_from_model, pos) for pos in getattr(frame, joint).pos]
            )
            for frame in frames
        ]
        for joint in ("ankle", "toe")
    )
    timed = []
    for index, frame in enumerate(frames):
        now = max(index, min(1, len(frames) - 1))
        before, dt = max(now - 1, 0), frames[now].dt
        velocity = (roots[now] - roots[before]) / dt
        motion = {
            "speed": float(np.linalg.norm(velocity)),
            "velocity_ws": velocity,
            "foot_speed": np.linalg.norm(ankles[now] - ankles[before], axis=-1) / dt,
            "toe_speed": np.linalg.norm(toes[now] - toes[before], axis=-1) / dt,
        }
        timed.append(dataclasses.replace(frame, **motion))
    return timed


def standing(heights: tuple[float, ...] = (ANKLE, ANKLE), forward: float = 0.05) -> np.ndarray:
    """Ankles (legs, 3) under the hips at the given heights."""
    sides = (0.1, -0.1, 0.0)
    return np.array([[x, y, forward] for x, y in zip(sides, heights, strict=False)])


def stepping(rig: Rig, count: int = 60) -> list[Frame]:
    """A walk, rotated in the world: each foot rises vertically, swings, and comes down.

    While an ankle is below the raised height it does not move horizontally.
    """
    frames = []
    heading = maths.from_axis_angle(maths.Y, 0.7)
    for index in range(count):
        ankles = []
        for leg in range(2):
            cycle, phase = divmod(index / 30 + 0.5 * leg, 1.0)
            swing = min(max((phase - 0.65) / 0.2, 0.0), 1.0)
            height = ANKLE + 0.12 * min(max((phase - 0.5) / 0.15, 0.0), 1.0, (1.0 - phase) / 0.15)
            stride = 0.3 * (cycle + swing - 0.5 * leg)
            ankles.append([0.1 - 0.2 * leg, height, stride - 0.3 * index / 30 + 0.05])
        root = maths.rotate(heading, np.array([0.3, 0.0, 0.3 * index / 30]))
        frames.append(make_frame(rig, np.array(ankles), world_from_model=Transform(root, heading)))
    return with_speeds(frames)


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
