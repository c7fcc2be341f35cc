"""What goes into the pipeline, and what its stages hand on. One character, one frame."""

import equinox as eqx
from jaxtyping import Array, Bool, Float

from . import quat, vec
from .skeleton import LegPose, Transform
from .terrain import Hit

FORWARD = (0.0, 0.0, 1.0)  # model space
UP = (0.0, 1.0, 0.0)  # model space


class Frame(eqx.Module):
    """The animation's frame, before foot IK."""

    world_from_model: Transform
    pose: LegPose  # legs, model space
    weight: Float[Array, "*b legs"]  # 0..1, share of foot IK in each leg
    slide: Float[Array, "*b"]  # 0..1, 1 while the character slides
    speed: Float[Array, "*b"]  # m/s, of the character; rules that idle or move read it
    dt: Float[Array, "*b"]  # s, since the frame before
    platform: Transform  # world_from_platform: the ground's own motion


class Ground(eqx.Module):
    """What the rays of each leg saw."""

    ankle: Hit  # legs
    toe: Hit  # legs; `found` is 0 where no toe ray was cast


class Contact(eqx.Module):
    """How far each foot stands."""

    lift: Float[Array, " legs"]  # m, animated ankle over the animation's own ground
    weight: Float[Array, " legs"]  # 0..1
    planted: Float[Array, " legs"]  # decision: low enough to stand
    lifted: Float[Array, " legs"]  # decision: high enough to have left


class Foothold(eqx.Module):
    """Where each foot would stand; the ankle is `lift` above it along up."""

    point_ws: Float[Array, "legs 3"]  # m
    height: Float[Array, " legs"]  # m, along up
    ankle_height_ms: Float[Array, " legs"]  # m, of the ankle over it, in model space
    climb: Float[Array, ""]  # model-space height gained per metre along up
    found: Float[Array, " legs"]  # 0..1


class Slope(eqx.Module):
    """Slope of the ground under the feet, positive where it rises ahead and to the right."""

    forward: Float[Array, ""]  # rad
    side: Float[Array, ""]  # rad
    forward_ws: Float[Array, "3"]  # unit, horizontal
    right_ws: Float[Array, "3"]  # unit


class Sensed(eqx.Module):
    """All that one frame shows without memory."""

    up_ws: Float[Array, "3"]
    dt: Float[Array, ""]
    slide: Float[Array, ""]
    platform: Transform
    present: Bool[Array, " legs"]
    weight: Float[Array, " legs"]  # 0..1, share of foot IK in each leg
    hip_ws: Float[Array, "legs 3"]
    ankle_ws: Float[Array, "legs 3"]
    thigh: Float[Array, " legs"]  # m, in this frame
    shin: Float[Array, " legs"]  # m
    ground: Ground
    contact: Contact
    foothold: Foothold
    slope: Slope


def heading(world_from_model: Transform, up_ws: Float[Array, "3"]) -> tuple[Array, Array]:
    """The character's forward and right, unit, at right angles to up, world space.

    Where the character looks along up, forward is its own up (a body lying on its back or front).
    """
    forward = quat.rotate(world_from_model.rot, vec.constant(FORWARD, up_ws))
    upright = quat.rotate(world_from_model.rot, vec.constant(UP, up_ws))
    forward_ws = vec.unit(vec.reject(forward, up_ws), upright)
    return forward_ws, vec.cross(forward_ws, up_ws)
