"""What goes into the pipeline, and what its stages hand on. One character, one frame."""

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
    """Where each foot of the animation stood last and where it will stand next.

    Places are those of the ball; how high they lie does not count. While a foot stands, its last
    place is where it is.
    """

    standing: Float[Array, "*b legs"]  # 0..1, the animation's own contact label
    last_ws: Float[Array, "*b legs 3"]  # m
    next_ws: Float[Array, "*b legs 3"]  # m
    fraction: Float[
        Array, "*b legs"
    ]  # 0..1, of the swing's time that has passed; 0 while it stands
    known: Float[Array, "*b legs"]  # 1, or 0 where nobody tells and places follow from velocity

    @classmethod
    def unknown(cls, like: Float[Array, "*b legs"]) -> "Stride":
        """Nothing told of feet that stand, as many as `like` and of its dtype."""
        zero, nowhere = jnp.zeros_like(like), jnp.zeros((*like.shape, 3), like.dtype)
        return cls(jnp.ones_like(like), nowhere, nowhere, zero, zero)


@struct
class Frame:
    """The animation's frame, before foot IK."""

    world_from_model: Transform
    pose: LegPose  # legs, model space
    weight: Float[Array, "*b legs"]  # 0..1, share of foot IK in each leg
    slide: Float[Array, "*b"]  # 0..1, 1 while the character slides
    velocity_ws: Float[Array, "*b 3"]  # m/s, of the character
    foot_speed: Float[Array, "*b legs"]  # m/s, of the animated ankles in the world
    toe_speed: Float[Array, "*b legs"]  # m/s, of the animated toes in the world
    stride: Stride
    dt: Float[Array, "*b"]  # s, since the frame before
    platform: Transform  # world_from_platform: the ground's own motion

    @property
    def speed(self) -> Float[Array, "*b"]:
        """Of the character, m/s."""
        return vec.length(self.velocity_ws)

    def translated(self, offset_ws: Float[Array, "*b 3"]) -> "Frame":
        """The frame with the whole character moved, m."""
        world = Transform(self.world_from_model.pos + offset_ws, self.world_from_model.rot)
        return dataclasses.replace(self, world_from_model=world)


@struct
class Rays:
    """How far over and under a foothold the probe looks, and at what."""

    above: Float[Array, " legs"]  # m
    below: Float[Array, " legs"]  # m
    layers: UInt[Array, "*legs"]


@struct
class GroundHits:
    """What the rays of each leg saw."""

    ankle: Hit  # legs
    toe: Hit  # legs; `found` is 0 where no toe ray was cast
    corner: Hit  # legs, beside the ankle; `found` is 0 where no such ray was cast
    rays: Rays  # for a stage that looks under a place of its own


@struct
class Contact:
    """How far each foot stands."""

    lift: Float[Array, " legs"]  # m, animated ankle over the animation's own ground
    weight: Float[Array, " legs"]  # 0..1
    planted: Float[Array, " legs"]  # decision: low enough to stand
    lifted: Float[Array, " legs"]  # decision: high enough to have left


@struct
class Foothold:
    """Where each foot would stand; the ankle is `lift` above it along up."""

    point_ws: Float[Array, "legs 3"]  # m
    lift: Float[Array, " legs"]  # m
    height: Float[Array, " legs"]  # m, of the point, along up
    ankle_height_ms: Float[Array, " legs"]  # m, of the ankle over it, in model space
    climb: Float[Array, "*legs"]  # model-space height gained per metre along up
    found: Float[Array, " legs"]  # 0..1


@struct
class Slope:
    """Slope of the ground under the feet, positive where it rises ahead and to the right."""

    forward: Float[Array, ""]  # rad
    side: Float[Array, ""]  # rad
    forward_ws: Float[Array, "3"]  # unit, horizontal
    right_ws: Float[Array, "3"]  # unit


@struct
class Sensed:
    """All that one frame shows without memory."""

    up_ws: Float[Array, "3"]  # of the body
    leg_up_ws: Float[Array, "*legs 3"]  # of each leg, or one for all
    dt: Float[Array, ""]
    slide: Float[Array, ""]
    platform: Transform
    present: Bool[Array, " legs"]
    weight: Float[Array, " legs"]  # 0..1, share of foot IK in each leg
    root_ws: Float[Array, "3"]  # m, the move that brought the character to its ground
    hip_ws: Float[Array, "legs 3"]  # animated and moved by it
    ankle_ws: Float[Array, "legs 3"]  # likewise
    ankle_rot_ws: Float[Array, "legs 4"]  # animated
    ball_ws: Float[Array, "legs 3"]  # m, animated toes, moved likewise
    ahead_ws: Float[Array, "legs 3"]  # unit, where each animated foot points, level
    rot_ws: Float[Array, "legs 4"]  # of the ankles, as the foot's rule wants them
    thigh: Float[Array, " legs"]  # m, in this frame
    shin: Float[Array, " legs"]  # m
    ground: GroundHits
    contact: Contact
    foothold: Foothold
    slope: Slope


def animated_ankles(frame: Frame) -> Transform:
    """The animated ankles, (legs), world space."""
    return Transform(
        frame.world_from_model.apply(frame.pose.ankle.pos),
        frame.world_from_model.apply_rot(frame.pose.ankle.rot),
    )


def foothold(frame: Frame, up_ws: Array, point_ws: Array, lift: Array, found: Array) -> Foothold:
    """The foothold at a point, m, with the ankle `lift` above it, m."""
    model_up = quat.rotate(frame.world_from_model.rot, vec.constant(UP, up_ws))
    climb = vec.dot(model_up, up_ws)
    base = vec.dot(point_ws - frame.world_from_model.pos, model_up)
    return Foothold(point_ws, lift, vec.dot(point_ws, up_ws), base + lift * climb, climb, found)


def heading(world_from_model: Transform, up_ws: Float[Array, "*legs 3"]) -> tuple[Array, Array]:
    """The character's forward and right, unit, at right angles to up, world space.

    Where the character looks along up, forward is its own up (a body lying on its back or front).
    """
    forward = quat.rotate(world_from_model.rot, vec.constant(FORWARD, up_ws))
    upright = quat.rotate(world_from_model.rot, vec.constant(UP, up_ws))
    forward_ws = vec.normalize(vec.reject(forward, up_ws), upright)
    return forward_ws, vec.cross(forward_ws, up_ws)
