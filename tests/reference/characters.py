"""Parameters, rigs, frames and legs of the characters that the references move."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from reference import maths
from reference.maths import Array, Transform, across, apply, length, multiply, rotate, unit
from reference.terrain import Hit, LegTerrains, Terrain

JOINTS = ("hip", "knee", "ankle", "toe")
Ground = Terrain | LegTerrains


def named(stage: str, **values: Any) -> dict[str, Any]:
    """Values of a stage's parameters by dotted name."""
    return {f"{stage}.{name}": value for name, value in values.items()}


# Defaults of the `record` system for a 1.8 m adult; half-lives are those of gains per tick of
# 30 Hz: lean 0.19, slide 0.294, on 0.226, off 0.135; pelvis 0.225, airborne 0.116.
DEFAULTS = (
    named("contact", ground_height=0.0, planted_height=0.10, raised_height=0.16)
    | named("probe", ray_up=0.50, ray_down=0.80, use_toe=True, toe_ls=np.array([0.0, -0.07, 0.20]))
    | named("target", min_ankle_height=-0.30, max_ankle_height=0.55, foot_height=0.08)
    | named("target", max_slope=math.radians(60.0), rise_half_life=0.0, fall_half_life=0.0)
    | named("target", spring=False, follow_slopes=False, max_penetration=math.inf)
    | named("lean", forward_rate=-0.30, side_rate=-0.10, half_life=0.1096, spring=False)
    | named("lean", forward_rate_slide=0.80, side_rate_slide=0.60)
    | named("lean", half_life_slide=0.06637, slide_on_half_life=0.09019)
    | named("lean", slide_off_half_life=0.1593)
    | named("lock", enabled=True, lock_half_life=0.05, unlock_half_life=0.10, max_speed=math.inf)
    | named("lock", release_min_angle=math.radians(50.0), release_max_angle=math.radians(172.0))
    | named("lock", release_cone=math.radians(25.0), release_distance=0.20, relock_threshold=0.20)
    | named("lock", release_heading=math.pi, release_speed=math.inf, return_speed=math.inf)
    | named("lock", hold_ball=False)
    | named("pelvis", half_life=0.09065, airborne_half_life=0.1874)
    | named("pelvis", limit=0.30, vertical_only=True, wait_to_rise=False, min_extension=0.0)
    | named("leg", max_knee_angle=math.acos(-0.990), min_knee_angle=math.acos(0.766))
    | named("leg", soften=1.0, twist=0.0, weight=1.0, as_animated=False)
    | named("foot", max_pitch=0.52, min_pitch=-0.79, max_roll=0.26, min_roll=-0.52)
)


class Parameters:
    """Values by dotted name; a value is shared by the legs, or has one row per leg.

    Args:
        changes: values other than the default.
        defaults: those of one system, `record` by default.

    Raises:
        ValueError: a name that the system does not have.
    """

    def __init__(
        self, changes: Mapping[str, Any] | None = None, defaults: Mapping[str, Any] = DEFAULTS
    ) -> None:
        unknown = set(changes or {}) - set(defaults)
        if unknown:
            raise ValueError(f"no parameters {sorted(unknown)}; there are {sorted(defaults)}")
        self.values = {**defaults, **(changes or {})}
        self.per_leg = {x for x in self.values if np.ndim(self.values[x]) > np.ndim(defaults[x])}

    def __getitem__(self, name: str) -> Any:
        return self.values[name]

    def of_leg(self, name: str, leg: int) -> Any:
        """The value for `leg`."""
        value = self.values[name]
        return value[leg] if name in self.per_leg else value


@dataclass
class Rig:
    """Constants of a character: knee_axis_ls (legs 3), ankle_from_foot (legs 4), side (legs).

    `foot` is from an ankle to its ball, m.
    """

    knee_axis_ls: Array
    ankle_from_foot: Array
    side: Array
    foot: float = 0.15


@dataclass
class Stride:
    """Where each leg is in its stride, according to the labels of the animation.

    `standing` (legs) is 0..1. `last_ws` and `next_ws` (legs 3), m, are where the ball of the foot
    last stood and will stand next; while it stands, `last_ws` is its present position. `fraction`
    (legs) is the part of the swing's time that has passed, 0 while standing. Where `known` (legs)
    is 0, only `standing` is valid. `aside_ws` (legs 3), m, is how far the middle of the swing is
    beside the straight way; None is 0. `last_ahead_ws` and `next_ahead_ws` (legs 3) are where feet
    point at their footholds; None, or what points along up, is where they point now.
    """

    standing: Array
    last_ws: Array
    next_ws: Array
    fraction: Array
    known: Array
    aside_ws: Array | None = None
    last_ahead_ws: Array | None = None
    next_ahead_ws: Array | None = None


@dataclass
class Frame:
    """One animated frame: joints are Transforms of (legs 3) and (legs 4) in model space.

    `grounded` is 0..1, 0 in the air. `speed` is that of the character, `foot_speed` (legs) that of
    the animated ankles and `toe_speed` (legs) that of the toes, m/s, over the ground; all default
    to 0. Without `velocity_ws` (3), m/s, the character moves forward. `platforms` are
    world_from_platform. Without labels of the animation no stride is known.
    """

    world_from_model: Transform
    hip: Transform
    knee: Transform
    ankle: Transform
    toe: Transform
    weight: Array
    slide: float
    dt: float
    platforms: Sequence[Transform] = ()
    platforms_before: Sequence[Transform] = ()
    speed: float = 0.0
    foot_speed: Array = field(default_factory=lambda: np.zeros(0))
    velocity_ws: Array | None = None
    toe_speed: Array = field(default_factory=lambda: np.zeros(0))
    stride: Stride | None = None
    grounded: float = 1.0

    def __post_init__(self) -> None:
        none, origin = np.zeros(len(self.weight)), np.zeros((len(self.weight), 3))
        self.foot_speed = self.foot_speed if len(self.foot_speed) else none
        self.toe_speed = self.toe_speed if len(self.toe_speed) else none
        self.stride = self.stride or Stride(1.0 + none, origin, origin, none, none)

    @property
    def travel_ws(self) -> Array:
        """The character's velocity, m/s."""
        if self.velocity_ws is not None:
            return self.velocity_ws
        return self.speed * rotate(self.world_from_model.rot, maths.Z)


def forward(rot: Array, up: Array) -> Array:
    """The model's forward at right angles to up; made of its own up where it looks along up."""
    return unit(across(rotate(rot, maths.Z), up), unit(across(rotate(rot, maths.Y), up), up))


@dataclass(frozen=True)
class Footing:
    """The parameters of a leg, by name, and the ground as its rays hit it."""

    index: int
    parameters: Parameters
    terrain: Ground

    def __getitem__(self, name: str) -> Any:
        return self.parameters.of_leg(name, self.index)

    @property
    def up(self) -> Array:
        """Up of this leg (3)."""
        return self.terrain.up


@dataclass(frozen=True)
class Leg(Footing):
    """A leg in a frame."""

    rig: Rig
    frame: Frame

    @property
    def weight(self) -> float:
        """How much foot IK the leg gets, 0..1."""
        return float(self.frame.grounded * self.frame.weight[self.index] * self["leg.weight"])

    @property
    def length(self) -> float:
        """Thigh and shin together, m."""
        hip, knee, ankle, _ = (self.joint(name).pos for name in JOINTS)
        return length(hip - knee) + length(knee - ankle)

    def joint(self, name: str) -> Transform:
        """A joint as animated, model space."""
        pos, rot = getattr(self.frame, name)
        return Transform(pos[self.index], rot[self.index])

    def pos_ws(self, joint: str) -> Array:
        """Where a joint is as animated, m."""
        return apply(self.frame.world_from_model, self.joint(joint).pos)

    @property
    def ankle_rot_ws(self) -> Array:
        """Rotation of the animated ankle (4)."""
        return multiply(self.frame.world_from_model.rot, self.joint("ankle").rot)

    @property
    def world_from_foot(self) -> Array:
        """Rotation from the axes of the animated foot (x left, y up, z forward) to the world's."""
        return multiply(self.ankle_rot_ws, self.rig.ankle_from_foot[self.index])

    @property
    def forward_ws(self) -> Array:
        """The model's forward at right angles to up."""
        return forward(self.frame.world_from_model.rot, self.up)

    @property
    def heading_ws(self) -> Array:
        """The foot's forward at right angles to up; the model's where the foot is along up."""
        return unit(across(rotate(self.world_from_foot, maths.Z), self.up), self.forward_ws)

    def with_foot_moved(self, offset_ws: Array) -> "Leg":
        """The leg with its ankle and toe moved, m; its knee stays."""
        moved = {}
        for name in ("ankle", "toe"):
            joint = getattr(self.frame, name)
            pos = np.array(joint.pos)
            pos[self.index] += rotate(maths.inverse(self.frame.world_from_model.rot), offset_ws)
            moved[name] = joint._replace(pos=pos)
        return replace(self, frame=replace(self.frame, **moved))


def legs_of(parameters: Parameters, rig: Rig, terrain: Ground, frame: Frame) -> list[Leg]:
    """All legs of a character."""
    count = len(frame.weight)
    grounds = terrain.legs if isinstance(terrain, LegTerrains) else [terrain] * count
    return [Leg(index, parameters, grounds[index], rig, frame) for index in range(count)]


def carried(frame: Frame, hit: Hit, point: Array) -> Array:
    """A point that was there in the previous frame, moved as the ground that was hit has moved."""
    if hit.platform < 0:
        return point
    before, now = frame.platforms_before[hit.platform], frame.platforms[hit.platform]
    return apply(now, maths.unapply(before, point))


def turned(frame: Frame, hit: Hit, rot: Array) -> Array:
    """A rotation (4) of the previous frame, turned as the ground that was hit has turned."""
    if hit.platform < 0:
        return rot
    before, now = frame.platforms_before[hit.platform], frame.platforms[hit.platform]
    return multiply(now.rot, multiply(maths.inverse(before.rot), rot))


def solution(body: Transform, legs: Sequence[tuple[Any, ...]]) -> dict[str, Array]:
    """Output of the motion of the body, and of each leg's joints and whether it reaches."""
    output = {"body_pos": body.pos, "body_rot": body.rot}
    *joints, reached = zip(*legs, strict=True)
    for name, each in zip(JOINTS, joints, strict=True):
        output[f"{name}_pos"] = np.array([joint.pos for joint in each])
        output[f"{name}_rot"] = np.array([joint.rot for joint in each])
    return output | {"reached": np.array(reached)}


def run(
    step: Callable[..., tuple[Any, dict[str, Array]]],
    parameters: Parameters,
    rig: Rig,
    terrain: Ground,
    frames: Sequence[Frame],
) -> dict[str, Array]:
    """All outputs of `step` for a whole clip, stacked over the frames."""
    state, outputs = None, []
    for frame in frames:
        state, output = step(parameters, rig, terrain.at(frame.platforms), state, frame)
        outputs.append(output)
    return {name: np.stack([output[name] for output in outputs]) for name in outputs[0]}
