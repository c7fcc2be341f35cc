"""What lean rules share: the slope under the feet, and how it is followed; a rule without lean."""

from abc import abstractmethod
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxik.maths import quat, smoothing, vec
from jaxik.maths.gate import HARD
from jaxik.maths.parameter_tree import Rule
from jaxik.maths.struct import struct
from jaxik.stages.inputs import Inputs, SensedMoment
from jaxik.world.frame import Contact, GroundHits, Slope, heading
from jaxik.world.skeleton import Rig


@struct
class Lean:
    """How the body leans."""

    rot_ws: Float[Array, "4"]
    """Rotation of the body about its pivot, world axes."""
    normal_ws: Float[Array, "3"]
    """Unit, the smoothed ground normal."""
    spine_ws: Float[Array, "4"] | None = None
    """Rotation of the spine about its base, after the body's, world axes; None if there is none."""
    head_ws: Float[Array, "4"] | None = None
    """Rotation of the head about its joint, after the spine's, likewise."""


class AbstractLean(Rule):
    """Leans the body on slopes."""

    per_leg: ClassVar[bool] = False

    def init(self, rig: Rig) -> PyTree:
        """Memory before the first frame; None for a rule that goes by each frame alone."""
        return None

    @abstractmethod
    def sense(self, inputs: Inputs, ground: GroundHits, contact: Contact, weight: Array) -> Slope:
        """The slope under the feet from this frame alone; `weight` (0..1) is that of each leg."""

    @abstractmethod
    def advance(self, now: SensedMoment, state: PyTree) -> tuple[PyTree, Lean]:
        """Memory after this frame, and the lean."""


class NoLean(AbstractLean):
    """The body does not lean."""

    def sense(self, inputs: Inputs, ground: GroundHits, contact: Contact, weight: Array) -> Slope:
        frame = inputs.frame
        level = jnp.zeros_like(frame.dt)
        return Slope(level, level, *heading(frame.world_from_model, inputs.terrain.up_ws))

    def advance(self, now: SensedMoment, state: None) -> tuple[None, Lean]:
        up_ws = now.sensed.up_ws
        return None, Lean(quat.identity(up_ws.dtype), up_ws)


@struct
class LeanState:
    """Smoothed slope and sliding weight."""

    forward: Float[Array, ""]
    """Radians."""
    side: Float[Array, ""]
    """Radians."""
    slide: Float[Array, ""]
    """0..1, smoothed `Frame.slide`."""
    forward_speed: Float[Array, ""]
    """rad/s; 0 unless it follows as a spring."""
    side_speed: Float[Array, ""]
    """rad/s, likewise."""

    @classmethod
    def level(cls, rig: Rig) -> "LeanState":
        """Level ground, not sliding."""
        zero = jnp.zeros((), rig.side.dtype)
        return cls(zero, zero, zero, zero, zero)


def standing_slope(inputs: Inputs, ground: GroundHits, contact: Contact, weight: Array) -> Slope:
    """The slope of the mean normal under the standing feet; level where none stands."""
    up_ws = inputs.terrain.up_ws
    forward_ws, right_ws = heading(inputs.frame.world_from_model, up_ws)
    stands = jnp.where(inputs.rig.present, contact.weight * ground.ankle.found, 0.0)
    stands = stands * inputs.bearing
    standing = stands * weight
    normal = vec.sum_vectors(vec.scale(ground.ankle.normal, standing))
    total = vec.sum_last(standing)
    normal = vec.scale(normal, vec.safe_divide(jnp.ones_like(total), total))
    most = HARD.maximum(stands, band=0.0)
    # Not as soon as a leg that stands has any weight at all.
    normal = smoothing.lerp(up_ws, normal, smoothing.clip_to_one(vec.safe_divide(total, most)))
    up = vec.dot(normal, up_ws)
    return Slope(
        vec.safe_arctan2(-vec.dot(normal, forward_ws), up),
        vec.safe_arctan2(-vec.dot(normal, right_ws), up),
        forward_ws,
        right_ws,
    )


def follow_slope(
    now: SensedMoment, state: LeanState, sliding: Array, fraction: Array, spring: Array
) -> LeanState:
    """Memory after the slope was followed by `fraction`, 0..1, of the gap, or as a spring."""
    slope, dt = now.sensed.slope, now.dt
    forward, forward_speed = smoothing.follow(
        smoothing.Motion(state.forward, state.forward_speed), slope.forward, fraction, dt, spring
    )
    side, side_speed = smoothing.follow(
        smoothing.Motion(state.side, state.side_speed), slope.side, fraction, dt, spring
    )
    return LeanState(forward, side, sliding, forward_speed, side_speed)


def lean_rotvec(slope: Slope, forward: Array, side: Array) -> Float[Array, "3"]:
    """Rotation vector, world axes, of a lean with the ground's rise ahead and to the right, rad."""
    return vec.scale(slope.right_ws, forward) - vec.scale(slope.forward_ws, side)


def ground_normal(now: SensedMoment, state: LeanState) -> Float[Array, "3"]:
    """Unit normal of ground with the smoothed slope."""
    return _normal(now.sensed.slope, now.sensed.up_ws, state.forward, state.side)


@vec.remat
def _normal(slope: Slope, up_ws: Array, forward: Array, side: Array) -> Array:
    """Unit normal of ground that rises by these angles ahead and to the right, rad."""
    forward_cos, forward_sin, side_cos, side_sin = vec.stacked_barrier(
        *vec.cos_sin(forward), *vec.cos_sin(side)
    )
    ahead = vec.scale(slope.forward_ws, forward_sin * side_cos)
    aside = vec.scale(slope.right_ws, forward_cos * side_sin)
    return vec.normalize(vec.scale(up_ws, forward_cos * side_cos) - ahead - aside, up_ws)
