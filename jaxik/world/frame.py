"""Data of one character and one frame: what goes into the pipeline and between its stages."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt

from jaxik.maths import quat, vec
from jaxik.maths.struct import struct

from .skeleton import LegPose, Transform
from .terrain import Hit

FORWARD = (0.0, 0.0, 1.0)  # model space
UP = (0.0, 1.0, 0.0)  # model space


@struct
class Stride:
    """Where each foot of the animation last stood and where it will stand next.

    Positions are those of the ball of the foot; their height is ignored. While a foot stands,
    `last_ws` is its present position.
    """

    standing: Float[Array, "*b legs"]
    """0..1, contact label of the animation."""
    last_ws: Float[Array, "*b legs 3"]
    """Metres."""
    next_ws: Float[Array, "*b legs 3"]
    """Metres."""
    fraction: Float[Array, "*b legs"]
    """0..1, time of the swing that has passed; 0 while standing."""
    known: Float[Array, "*b legs"]
    """1, or 0 where positions have to be predicted from velocity."""

    @classmethod
    def unknown(cls, like: Float[Array, "*b legs"]) -> "Stride":
        """An unknown stride of standing feet, with the shape and dtype of `like`."""
        zero, origin = jnp.zeros_like(like), jnp.zeros((*like.shape, 3), like.dtype)
        return cls(jnp.ones_like(like), origin, origin, zero, zero)


@struct
class Frame:
    """One frame of animation, before foot IK."""

    world_from_model: Transform
    pose: LegPose
    """Legs, model space."""
    weight: Float[Array, "*b legs"]
    """0..1, how much foot IK each leg gets."""
    grounded: Float[Array, "*b"]
    """0..1; 0 in the air, on a ladder or on a seat: then there is no foot IK at all."""
    slide: Float[Array, "*b"]
    """0..1; 1 while the character slides."""
    velocity_ws: Float[Array, "*b 3"]
    """m/s, of the character."""
    foot_speed: Float[Array, "*b legs"]
    """m/s, of the animated ankles, world space."""
    toe_speed: Float[Array, "*b legs"]
    """m/s, of the animated toes, world space."""
    stride: Stride
    dt: Float[Array, "*b"]
    """s, since the previous frame."""
    platform: Transform
    """`world_from_platform`: the ground's own motion."""

    @property
    def speed(self) -> Float[Array, "*b"]:
        """Speed of the character, m/s."""
        return vec.length(self.velocity_ws)

    def translated(self, offset_ws: Float[Array, "*b 3"]) -> "Frame":
        """The frame with the whole character moved by `offset_ws`, m."""
        world = Transform(self.world_from_model.pos + offset_ws, self.world_from_model.rot)
        return dataclasses.replace(self, world_from_model=world)


@struct
class Rays:
    """How far above and below a foothold the probe looks, and which layers it hits."""

    above: Float[Array, " legs"]
    """Metres."""
    below: Float[Array, " legs"]
    """Metres."""
    layers: UInt[Array, "*legs"]


@struct
class GroundHits:
    """The ground under each leg: what its rays hit."""

    ankle: Hit
    """Legs."""
    toe: Hit
    """Legs; `found` is 0 where no toe ray was cast."""
    corner: Hit
    """Legs, beside the ankle; `found` is 0 where no such ray was cast."""
    swing: Float[Array, " legs"]
    """0..1, how far swinging feet turn to the ground; standing feet do by their contact."""
    rays: Rays
    """For stages that cast further rays."""


@struct
class Contact:
    """Which feet stand, according to the animation."""

    lift: Float[Array, " legs"]
    """m, of the animated ankle above the animation's own ground."""
    weight: Float[Array, " legs"]
    """0..1, 1 for a standing foot."""
    planted: Float[Array, " legs"]
    """Decision: low enough to stand."""
    lifted: Float[Array, " legs"]
    """Decision: high enough to have left the ground."""


@struct
class Foothold:
    """Where each foot would stand. The ankle is `lift` above that point along up."""

    point_ws: Float[Array, "legs 3"]
    """Metres."""
    lift: Float[Array, " legs"]
    """Metres."""
    height: Float[Array, " legs"]
    """m, of the point along up."""
    ankle_height_ms: Float[Array, " legs"]
    """m, of the ankle above it, model space."""
    climb: Float[Array, "*legs"]
    """Model-space height gained per metre along up."""
    found: Float[Array, " legs"]
    """From 0 to 1."""


@struct
class Slope:
    """Slope of the ground under the feet; positive where it rises ahead and to the right."""

    forward: Float[Array, ""]
    """Radians."""
    side: Float[Array, ""]
    """Radians."""
    forward_ws: Float[Array, "3"]
    """Unit, horizontal."""
    right_ws: Float[Array, "3"]
    """Unit."""


@struct
class Sensed:
    """What the stages derive from one frame without memory of earlier ones."""

    up_ws: Float[Array, "3"]
    """Up of the body."""
    leg_up_ws: Float[Array, "*legs 3"]
    """Up of each leg, or one for all."""
    dt: Float[Array, ""]
    slide: Float[Array, ""]
    platform: Transform
    present: Bool[Array, " legs"]
    weight: Float[Array, " legs"]
    """0..1, how much foot IK each leg gets."""
    grounded: Float[Array, ""]
    """0..1, how much of its motion the body gets; the weights have it as a factor."""
    root_ws: Float[Array, "3"]
    """m, offset that put the character on its ground."""
    hip_ws: Float[Array, "legs 3"]
    """m, animated, with that offset."""
    ankle_ws: Float[Array, "legs 3"]
    """m, likewise."""
    ankle_rot_ws: Float[Array, "legs 4"]
    """Animated."""
    ball_ws: Float[Array, "legs 3"]
    """m, animated toes, likewise."""
    ahead_ws: Float[Array, "legs 3"]
    """Unit, horizontal direction of each animated foot."""
    rot_ws: Float[Array, "legs 4"]
    """Ankle rotations that the foot rule wants."""
    thigh: Float[Array, " legs"]
    """m, in this frame."""
    shin: Float[Array, " legs"]
    """Metres."""
    ground: GroundHits
    contact: Contact
    foothold: Foothold
    slope: Slope

    @property
    def turned(self) -> Float[Array, " legs"]:
        """0..1, how far each foot turns to the ground under it."""
        standing = self.contact.weight
        return self.ground.ankle.found * (standing + self.ground.swing * (1.0 - standing))


def animated_ankles(frame: Frame) -> Transform:
    """The animated ankles (legs), world space."""
    return Transform(
        frame.world_from_model.apply(frame.pose.ankle.pos),
        frame.world_from_model.apply_rot(frame.pose.ankle.rot),
    )


def foothold(frame: Frame, up_ws: Array, point_ws: Array, lift: Array, found: Array) -> Foothold:
    """The foothold at a point, m, with the ankle `lift`, m, above it."""
    model_up = quat.rotate(frame.world_from_model.rot, vec.constant(UP, up_ws))
    climb = vec.dot(model_up, up_ws)
    base = vec.dot(point_ws - frame.world_from_model.pos, model_up)
    return Foothold(point_ws, lift, vec.dot(point_ws, up_ws), base + lift * climb, climb, found)


def heading(world_from_model: Transform, up_ws: Float[Array, "*legs 3"]) -> tuple[Array, Array]:
    """Unit forward and right of the character at right angles to `up_ws`, world space.

    Where the character's forward is along up (a body lying on its back or front), its own up is
    used instead.
    """
    forward = quat.rotate(world_from_model.rot, vec.constant(FORWARD, up_ws))
    upright = quat.rotate(world_from_model.rot, vec.constant(UP, up_ws))
    forward_ws = vec.normalize(vec.reject(forward, up_ws), upright)
    return forward_ws, vec.cross(forward_ws, up_ws)
