"""Parameters, rigs, frames and memory of the characters that the references move."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from reference import maths
from reference.maths import Array, Motion, Transform
from reference.terrain import ALL_LAYERS, Hit, LegTerrains

# Defaults of the `record` system for a 1.8 m adult; gains per tick of 30 Hz.
DEFAULTS: dict[str, Any] = {
    "contact.ground_height": 0.0,
    "contact.planted_height": 0.10,
    "contact.raised_height": 0.16,
    "probe.ray_up": 0.50,
    "probe.ray_down": 0.80,
    "probe.toe_ls": np.array([0.0, -0.07, 0.20]),
    "probe.use_toe": True,
    "target.min_ankle_height": -0.30,
    "target.max_ankle_height": 0.55,
    "target.foot_height": 0.08,
    "target.max_slope": math.radians(60.0),
    "target.rise_half_life": 0.0,
    "target.fall_half_life": 0.0,
    "target.spring": False,
    "target.follow_slopes": False,
    "lean.forward_rate": -0.30,
    "lean.side_rate": -0.10,
    "lean.forward_rate_slide": 0.80,
    "lean.side_rate_slide": 0.60,
    "lean.gain": 0.19,
    "lean.gain_slide": 0.294,
    "lean.slide_on_gain": 0.226,
    "lean.slide_off_gain": 0.135,
    "lean.tick_hz": 30.0,
    "lean.spring": False,
    "lock.enabled": True,
    "lock.release_min_angle": math.radians(50.0),
    "lock.release_max_angle": math.radians(172.0),
    "lock.release_cone": math.radians(25.0),
    "lock.relock_threshold": 0.20,
    "lock.lock_half_life": 0.05,
    "lock.unlock_half_life": 0.10,
    "lock.release_distance": 0.20,
    "lock.max_speed": math.inf,
    "lock.hold_ball": False,
    "lock.release_heading": math.pi,
    "lock.release_speed": math.inf,
    "lock.return_speed": math.inf,
    "pelvis.limit": 0.30,
    "pelvis.on_gain": 0.225,
    "pelvis.off_gain": 0.116,
    "pelvis.vertical_only": True,
    "pelvis.wait_to_rise": False,
    "pelvis.tick_hz": 30.0,
    "leg.max_knee_angle": math.acos(-0.990),
    "leg.min_knee_angle": math.acos(0.766),
    "leg.soften": 0.98,
    "leg.twist": 0.0,
    "leg.as_animated": False,
    "leg.weight": 1.0,
    "foot.max_pitch": 0.52,
    "foot.min_pitch": -0.79,
    "foot.max_roll": 0.26,
    "foot.min_roll": -0.52,
}


class Ground(Protocol):
    """Something that rays can be cast onto."""

    @property
    def up(self) -> Array: ...

    def cast(self, origin: Array, reach: float, mask: int = ALL_LAYERS) -> Hit: ...

    def at(self, platforms: Sequence[Transform]) -> "Ground": ...


def under(terrain: Ground, leg: int) -> Ground:
    """The ground as the rays of `leg` hit it."""
    return terrain.legs[leg] if isinstance(terrain, LegTerrains) else terrain


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
        self.defaults = defaults
        self.values = {**defaults, **(changes or {})}

    def __getitem__(self, name: str) -> Any:
        return self.values[name]

    def of_leg(self, name: str, leg: int) -> Any:
        """The value for `leg`."""
        value = np.asarray(self.values[name])
        return value[leg] if value.ndim > np.ndim(self.defaults[name]) else self.values[name]


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
    beside the straight way; None is 0.
    """

    standing: Array
    last_ws: Array
    next_ws: Array
    fraction: Array
    known: Array
    aside_ws: Array | None = None

    @classmethod
    def unknown(cls, legs: int) -> "Stride":
        """The stride of an animation without labels."""
        origin = np.zeros((legs, 3))
        return cls(np.ones(legs), origin, origin, np.zeros(legs), np.zeros(legs))


@dataclass
class Frame:
    """One animated frame: joints are Transforms of (legs 3) and (legs 4) in model space.

    `grounded` is 0..1, 0 in the air. `speed` is that of the character, `foot_speed` (legs) that of
    the animated ankles and `toe_speed` (legs) that of the toes, m/s, over the ground; all default
    to 0. Without `velocity_ws` (3), m/s, the character moves forward. `platforms` are
    world_from_platform.
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
        legs = len(self.weight)
        if len(self.foot_speed) == 0:
            self.foot_speed = np.zeros(legs)
        if len(self.toe_speed) == 0:
            self.toe_speed = np.zeros(legs)
        if self.stride is None:
            self.stride = Stride.unknown(legs)

    @property
    def travel_ws(self) -> Array:
        """The character's velocity, m/s."""
        if self.velocity_ws is not None:
            return self.velocity_ws
        return self.speed * maths.rotate(self.world_from_model.rot, maths.Z)


@dataclass
class Hold:
    """Memory of one foot's lock, in the world."""

    locked: bool
    factor: float
    offset: Array
    turn: float  # rad about up, from the animated heading to the one it keeps
    foothold: Array
    ball: Array
    heading: Array


@dataclass
class Followed:
    """Height of the ground as a foothold follows it, and the foothold where the ground is."""

    height: Motion
    foothold_ws: Array


@dataclass
class State:
    """Memory of the `record` system; lists have one entry per leg."""

    ground: list[Followed]
    slope: list[Motion]  # ahead and to the right
    slide_weight: float
    pelvis_height: float
    pelvis_offset_ws: Array
    holds: list[Hold]
    standing: list[Any]  # where feet stand by speed


@dataclass
class Foot:
    """One leg in this frame: animated joints, contact, hits and foothold, world space.

    `ball_ws` is the toe joint; `heading_ws` is the unit forward of the foot at right angles to up.
    `swing_lift`, m, is the part of `lift` that is not animated.
    """

    hip_ws: Array
    ankle_ws: Array
    ball_ws: Array
    heading_ws: Array
    lift: float
    contact: float
    planted: bool
    lifted: bool
    hit: Hit
    toe_hit: Hit
    foothold_ws: Array
    turns_in_swing: bool = False
    swing_lift: float = 0.0

    @property
    def turned(self) -> float:
        """0..1, how far the foot turns to the ground under it."""
        return float(self.hit.found) if self.turns_in_swing else self.grounded

    @property
    def grounded(self) -> float:
        """Contact weight of a foot with ground under it, else 0."""
        return self.contact if self.hit.found else 0.0


def carried(frame: Frame, hit: Hit, point: Array) -> Array:
    """A point that was there in the previous frame, moved as the ground that was hit has moved."""
    if hit.platform < 0:
        return point
    before, now = frame.platforms_before[hit.platform], frame.platforms[hit.platform]
    return maths.apply(now, maths.unapply(before, point))


def turned(frame: Frame, hit: Hit, rot: Array) -> Array:
    """A rotation (4) of the previous frame, turned as the ground that was hit has turned."""
    if hit.platform < 0:
        return rot
    before, now = frame.platforms_before[hit.platform], frame.platforms[hit.platform]
    return maths.multiply(now.rot, maths.multiply(maths.inverse(before.rot), rot))


def world_from_foot(rig: Rig, frame: Frame, leg: int) -> Array:
    """Rotation from the axes of the animated foot (x left, y up, z forward) to the world's."""
    world_from_ankle = maths.multiply(frame.world_from_model.rot, frame.ankle.rot[leg])
    return maths.multiply(world_from_ankle, rig.ankle_from_foot[leg])


def with_moved_foot(frame: Frame, leg: int, offset_ws: Array) -> Frame:
    """The frame with the ankle and toe of a leg moved, m; its knee stays."""
    moved = {}
    for name in ("ankle", "toe"):
        joint = getattr(frame, name)
        pos = np.array(joint.pos)
        pos[leg] += maths.rotate(maths.inverse(frame.world_from_model.rot), offset_ws)
        moved[name] = joint._replace(pos=pos)
    return replace(frame, **moved)


def joints(legs: Sequence[Sequence[Transform]]) -> dict[str, Array]:
    """Output of the solved joints: hip, knee, ankle and toe of each leg, model space."""
    output = {}
    for index, name in enumerate(("hip", "knee", "ankle", "toe")):
        output[f"{name}_pos"] = np.array([leg[index].pos for leg in legs])
        output[f"{name}_rot"] = np.array([leg[index].rot for leg in legs])
    return output


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
