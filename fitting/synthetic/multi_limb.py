"""Synthetic motion on many limbs: a quadruped that walks and a climber on a wall.

A rigid trunk travels along a path at constant speed. Each limb stands on its foothold while the
trunk passes over it, for the same fraction of every stride, and swings to the next one. Knees and
elbows follow from the law of cosines, so bones keep their lengths exactly; the pelvis gives way
where a leg would not reach its foot. Motion is made over a floor with y up and z ahead; for the
climber the floor is then set upright.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from fitting.clips.assemble import JointMotion, clip_from_joints
from fitting.clips.clip import Clip
from fitting.clips.rigs import knee_positions, leg_rotations, rotation, unit

from . import terrain_meshes
from .footsteps import FootMotion, GroundPath, smoothstep

Point = tuple[float, float, float]  # left, up, ahead, m
ROLES = ("hip", "knee", "ankle", "toe")
UP = np.array([0.0, 1.0, 0.0])
MAX_REACH = 0.995  # of a limb's length, to which it may extend


@dataclass(frozen=True)
class Limb:
    """A two-bone limb with a foot or hand; points are relative to the floor below the trunk."""

    name: str
    root: Point
    """m, of the hip or shoulder."""
    home: tuple[float, float]
    """m, left and ahead: the ball of the foot in the middle of its stance."""
    pole: Point
    """Where the knee or elbow points."""
    bones: tuple[float, float]
    """m, upper and lower."""
    phase_offset: float
    """Of a stride, after the first limb."""


@dataclass(frozen=True)
class Body:
    """A trunk, its limbs, and how it moves."""

    name: str
    limbs: tuple[Limb, ...]
    height: float
    """m, of the trunk above the floor."""
    stride: float
    """Metres."""
    period: float
    """s, of a stride."""
    stance_fraction: float
    """Of a stride, in which a limb stands."""
    lift: float
    """m, of the ball in the middle of a swing."""
    toe_drop: float
    """rad, by which toes point down there."""
    bob: float
    """m, by which the trunk rises and falls, twice per stride."""
    ankle_to_ball: tuple[float, float]
    """m, down and ahead."""
    ball_height: float
    """m, above the sole."""


@dataclass(frozen=True)
class Route:
    """Where a body goes, and how regular its footholds are."""

    start: float = 0.0
    """m, position along the path at the start."""
    bend: float = 0.09
    """rad, about how far the path turns away from +z to either side."""
    jitter: float = 0.015
    """m, standard deviation of footholds, along the path and across."""


class _Travel(NamedTuple):
    """A body's way over the floor."""

    path: GroundPath
    route: Route
    phase: Float64[np.ndarray, " frames"]  # in strides


def _pair(left: Limb, right_phase: float) -> tuple[Limb, Limb]:
    """A left limb and its mirror image."""
    right = replace(
        left,
        name=f"{left.name}_right",
        root=(-left.root[0], *left.root[1:]),
        home=(-left.home[0], left.home[1]),
        pole=(-left.pole[0], *left.pole[1:]),
        phase_offset=right_phase,
    )
    return replace(left, name=f"{left.name}_left"), right


# A large dog or a pony. Lateral sequence: each hind foot is followed by the fore foot of its side.
QUADRUPED = Body(
    "quadruped",
    limbs=(
        *_pair(
            Limb("fore", root=(0.11, 0.68, 0.36), home=(0.10, 0.42), pole=(0.0, 0.0, -1.0),
                 bones=(0.35, 0.37), phase_offset=0.25),
            right_phase=0.75,
        ),
        *_pair(
            Limb("hind", root=(0.10, 0.68, -0.36), home=(0.11, -0.30), pole=(0.0, 0.0, 1.0),
                 bones=(0.37, 0.36), phase_offset=0.0),
            right_phase=0.5,
        ),
    ),
    height=0.72, stride=0.80, period=0.85, stance_fraction=0.62, lift=0.09, toe_drop=0.5, bob=0.008,
    ankle_to_ball=(0.05, 0.06), ball_height=0.03,
)  # fmt: skip

# An adult facing the wall, always on three limbs. Elbows hang, knees open sideways.
CLIMBER = Body(
    "climber",
    limbs=(
        *_pair(
            Limb("hand", root=(0.19, 0.30, 0.26), home=(0.28, 0.62), pole=(0.5, 0.4, -0.6),
                 bones=(0.30, 0.27), phase_offset=0.0),
            right_phase=0.5,
        ),
        *_pair(
            Limb("foot", root=(0.09, 0.30, -0.26), home=(0.26, -0.66), pole=(0.9, 0.3, 0.3),
                 bones=(0.43, 0.41), phase_offset=0.75),
            right_phase=0.25,
        ),
    ),
    height=0.32, stride=0.40, period=3.0, stance_fraction=0.75, lift=0.10, toe_drop=0.3, bob=0.0,
    ankle_to_ball=(0.04, 0.10), ball_height=0.03,
)  # fmt: skip


def locomotion(
    body: Body, seconds: float, fps: float = 30.0, seed: int = 0, route: Route = Route()
) -> Clip:
    """A body moving over the floor y = 0, along +z, with its contact labels.

    A limb is labelled as standing while its ball is placed; its foot then lies flat and does not
    move.

    Args:
        body: what moves.
        seconds: length of the clip.
        fps: frames per second.
        seed: of the differences between steps.
        route: where it goes.

    Raises:
        ValueError: a length or rate that is not above 0, or a limb that cannot reach its foothold.
    """
    if not (seconds > 0 and fps > 0):
        raise ValueError(f"wanted seconds and fps above 0, got {seconds} s at {fps} fps")
    phase = np.arange(round(seconds * fps)) / (fps * body.period)
    rng = np.random.default_rng(seed)
    path = GroundPath(route.bend, rng.uniform(0.0, 2.0 * np.pi))
    along = route.start + body.stride * phase
    height = body.height + body.bob * np.cos(4.0 * np.pi * phase)
    trunk, yaw = path.points(along, 0.0, height), path.yaw(along)
    heading = Rotation.from_rotvec(yaw[:, None] * UP)
    names, parents = ["trunk"], [-1]
    positions, rotations, stance = [trunk], [heading.as_quat(scalar_first=True)], []
    for limb in body.limbs:
        hip = trunk + heading.apply(np.array(limb.root) - [0.0, body.height, 0.0])
        foot = _foot_motion(body, limb, _Travel(path, route, phase), rng)
        if np.linalg.norm(foot.ankle - hip, axis=-1).max() > MAX_REACH * sum(limb.bones):
            raise ValueError(f"the {limb.name} limb of the {body.name} does not reach its foothold")
        hinge = unit(np.cross(foot.ankle - hip, heading.apply(limb.pole)))
        pole = -unit(np.cross(unit(foot.ankle - hip), hinge))
        knee = knee_positions(hip, foot.ankle, pole, limb.bones)
        names += [f"{limb.name}_{role}" for role in ROLES]
        parents += [0, len(names) - 4, len(names) - 3, len(names) - 2]
        positions += [hip, knee, foot.ankle, foot.ball]
        rotations += [*leg_rotations(hip, knee, foot.ankle, hinge), foot.rot, foot.rot]
        stance.append(foot.stance)
    motion = JointMotion(
        tuple(names), tuple(parents), np.stack(positions, axis=1), np.stack(rotations, axis=1),
        np.stack(stance, axis=-1), float(fps),
    )  # fmt: skip
    roles = {f"{role}_{limb.name}": f"{limb.name}_{role}" for limb in body.limbs for role in ROLES}
    return clip_from_joints(motion, f"{body.name} seed {seed}", {"pelvis": "trunk"} | roles)


def climb(seconds: float = 6.0, fps: float = 30.0, seed: int = 0, *, start: float = 1.3) -> Clip:
    """A climber on the wall z = 0, going straight up, with contact labels.

    The wall's normal is `terrain_meshes.WALL_UP`; pass it as `up_ws` to
    `clip_frames.frames_from_clip` and to `Clip.world_from_model`.

    Args:
        seconds: length of the clip.
        fps: frames per second.
        seed: of the differences between steps.
        start: m, height of the trunk at the start.

    Raises:
        ValueError: as `locomotion`.
    """
    flat = locomotion(CLIMBER, seconds, fps, seed, Route(start, bend=0.0))
    wall = terrain_meshes.WALL_FROM_FLOOR
    rotations = wall * rotation(flat.rotations_ws)
    rotations_ws = rotations.as_quat(scalar_first=True).reshape(flat.rotations_ws.shape)
    return flat.with_motion(flat.positions_ws @ wall.as_matrix().T, rotations_ws)


def _foot_motion(body: Body, limb: Limb, travel: _Travel, rng: np.random.Generator) -> FootMotion:
    """A limb's foot over the frames, on footholds with random jitter."""
    path, route, phase = travel
    phase = phase - limb.phase_offset
    step = np.floor(phase).astype(int)  # a stance begins at each whole number
    swing = (phase - step - body.stance_fraction) / (1.0 - body.stance_fraction)
    swing = np.clip(swing, 0.0, 1.0)
    arc = np.sin(np.pi * swing) ** 2
    steps = np.arange(-1, step[-1] + 2)
    along = steps + limb.phase_offset + 0.5 * body.stance_fraction
    along = route.start + body.stride * along + limb.home[1]
    along = along + route.jitter * rng.normal(size=len(steps))
    aside = limb.home[0] + route.jitter * rng.normal(size=len(steps))
    footholds = path.points(along, aside, np.full(len(steps), body.ball_height))
    yaws = path.yaw(along)

    ease = smoothstep(swing)
    last, next_ = step + 1, step + 2
    ball = footholds[last] + ease[:, None] * (footholds[next_] - footholds[last])
    ball[:, 1] += body.lift * arc
    yaw = yaws[last] + ease * (yaws[next_] - yaws[last])
    heading = Rotation.from_rotvec(yaw[:, None] * UP)
    tilt = Rotation.from_rotvec((body.toe_drop * arc)[:, None] * [1.0, 0.0, 0.0])
    rot = heading * tilt
    down, ahead = body.ankle_to_ball
    ankle = ball - rot.apply([0.0, -down, ahead])
    return FootMotion(ball, ankle, rot.as_quat(scalar_first=True), swing == 0.0)
