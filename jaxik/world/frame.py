"""Data of one character and one frame: what goes into the pipeline and between its stages."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt

from jaxik.maths import quat, vec
from jaxik.maths.smoothing import smoothstep
from jaxik.maths.struct import place, struct

from .skeleton import LegPose, Rig, Still, Transform
from .terrain import Hit

FORWARD = (0.0, 0.0, 1.0)  # model space
UP = (0.0, 1.0, 0.0)  # model space
# Cosines between the ups of a leg and of the body from which the leg bears, and bears in full.
LEAST_BEARING, FULL_BEARING = 0.3, 0.7


@struct
class Stride:
    """Where each foot of the animation last stood and where it will stand next.

    Positions are those of the ball of the foot; their height is ignored. While a foot stands,
    `last_ws` is its present position. Footholds on a platform are where they are now: the game
    moves them with it.
    """

    standing: Float[Array, "*b legs"]
    """0..1, contact label of the animation."""
    last_ws: Float[Array, "*b legs 3"] = place("point")
    """Metres."""
    next_ws: Float[Array, "*b legs 3"] = place("point")
    """Metres."""
    fraction: Float[Array, "*b legs"]
    """0..1, time of the swing that has passed; 0 while standing."""
    known: Float[Array, "*b legs"]
    """1, or 0 where positions have to be predicted from velocity."""
    aside_ws: Float[Array, "*b legs 3"] | None = None
    """m, by how far the middle of a swing is beside the straight way to the next foothold: round a
    corner of the ground, or round the other foot. An offset: it is the same wherever the world's
    origin is. None is 0."""
    last_ahead_ws: Float[Array, "*b legs 3"] | None = None
    """Where the foot points at its last foothold; any length. Its sole is supported there as it
    stood, however the foot turns or swings since. Zero, and None, is where it points now."""
    next_ahead_ws: Float[Array, "*b legs 3"] | None = None
    """Where it will point at its next foothold; as for the last."""

    @classmethod
    def unknown(cls, like: Float[Array, "*b legs"]) -> "Stride":
        """An unknown stride of standing feet, with the shape and dtype of `like`."""
        zero, origin = jnp.zeros_like(like), jnp.zeros((*like.shape, 3), like.dtype)
        return cls(jnp.ones_like(like), origin, origin, zero, zero)


@struct
class Frame:
    """One frame of animation, before foot IK."""

    world_from_model: Transform = place("point")
    pose: LegPose
    """Legs, model space."""
    weight: Float[Array, "*b legs"]
    """0..1, how much foot IK each leg gets."""
    grounded: Float[Array, "*b"]
    """0..1; 0 in the air, on a ladder or on a seat: then there is no foot IK at all."""
    slide: Float[Array, "*b"]
    """0..1; 1 while the character slides."""
    velocity_ws: Float[Array, "*b 3"]
    """m/s, of the character, over the ground: the motion of its platform does not count."""
    foot_speed: Float[Array, "*b legs"]
    """m/s, of the animated ankles, likewise."""
    toe_speed: Float[Array, "*b legs"]
    """m/s, of the animated toes, likewise."""
    stride: Stride
    dt: Float[Array, "*b"]
    """s, since the previous frame."""
    platforms: Transform = place("point")
    """`world_from_platform` of each moving terrain (platforms); there may be none."""
    platforms_before: Transform = place("point")
    """The same in the previous frame; on the first frame, the same as `platforms`."""
    stride_scale: Float[Array, "*b"] | None = None
    """Speed of the character over that of its animation, by which its strides are to be scaled.
    None leaves them as animated and costs nothing."""
    orientation: Float[Array, "*b"] | None = None
    """rad, from the direction in which the animation moves to that in which the character does,
    positive to its left. The lower body is turned by it. None turns nothing and costs nothing."""
    restart: Bool[Array, "*b"] | None = None
    """True where nothing leads here from the previous frame, as after a teleport: memory starts
    anew. Speeds and strides are then those after it. None never restarts and costs nothing."""
    rig: Rig | None = None
    """The legs of the body that this frame is of, as many as the call's rig has: for clips of
    several bodies in a row, with a `restart` where another begins. None takes the call's rig."""

    @property
    def speed(self) -> Float[Array, "*b"]:
        """Speed of the character, m/s."""
        return vec.length(self.velocity_ws)

    def translated(self, offset_ws: Float[Array, "*b 3"]) -> "Frame":
        """The frame with the whole character moved by `offset_ws`, m."""
        world = Transform(self.world_from_model.pos + offset_ws, self.world_from_model.rot)
        return dataclasses.replace(self, world_from_model=world)

    def with_moved_feet(self, offset_ws: Float[Array, "legs 3"]) -> "Frame":
        """The single frame with ankles and toes moved by `offset_ws`, m; knees stay."""
        pose = self.pose
        offset = quat.unrotate(self.world_from_model.rot, offset_ws)
        ankle, toe = (Transform(joint.pos + offset, joint.rot) for joint in (pose.ankle, pose.toe))
        return dataclasses.replace(self, pose=LegPose(pose.hip, pose.knee, ankle, toe))

    def with_platforms(self, tracks: Transform) -> "Frame":
        """The clip with moving terrains.

        Args:
            tracks: `world_from_platform` (frames, platforms), in the order of the numbers given to
                `jaxik.world.terrain.moving`.
        """
        before = (jnp.concatenate([x[:1], x[:-1]]) for x in (tracks.pos, tracks.rot))
        return dataclasses.replace(self, platforms=tracks, platforms_before=Transform(*before))

    def carry(self, hit: Hit) -> Transform | Still:
        """World motion, since the previous frame, of what rays hit; misses do not move."""
        if hit.platform is None:
            return Still()
        motions = self.platforms @ self.platforms_before.inverse()
        number = jnp.where(hit.platform < 0, 0, hit.platform)
        pos, rot = (x.at[number].get(mode="clip") for x in (motions.pos, motions.rot))
        static = (hit.platform < 0)[..., None]
        return Transform(
            jnp.where(static, 0.0, pos), jnp.where(static, quat.identity(rot.dtype), rot)
        )


@struct
class Rays:
    """How far above and below a foothold the probe looks, and which layers it hits."""

    above: Float[Array, " legs"]
    """Metres."""
    below: Float[Array, " legs"]
    """Metres."""
    layers: UInt[Array, "*legs"]


@struct
class Landing:
    """Where the swing of each foot ends."""

    way_ws: Float[Array, "legs 3"]
    """m, from the ground under the ankle to that below it at the next foothold."""
    velocity_ws: Float[Array, "legs 3"]
    """m/s, of the body, across the up of each leg."""
    fraction: Float[Array, " legs"]
    """0..1, time of the swing that has passed; 0 while standing."""
    certain: Float[Array, " legs"]
    """0..1, how sure it is that the foot lands there."""
    root_height: Float[Array, ""] = place("height")
    """Metres."""


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
    lift: Float[Array, " legs"] | None = None
    """m, how much higher than animated each ankle swings over its ground; None is 0."""
    pitch: Float[Array, " legs"] | None = None
    """rad, how much further than animated each foot's toes are up; None is 0."""
    support: Float[Array, " legs"] | None = None
    """0..1, share of each sole that the ground of its foothold supports; None if not looked for."""
    until: Float[Array, " legs"] | None = None
    """s, until each foot lands; 0 while it stands. None if that is not known."""
    landing: Landing | None = None
    """None if not looked for."""


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

    point_ws: Float[Array, "legs 3"] = place("point")
    """Metres."""
    lift: Float[Array, " legs"]
    """Metres."""
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
class Turn:
    """By how much a body is turned about its root's up, positive to the left."""

    pelvis: Float[Array, ""]
    """rad."""
    feet: Float[Array, ""]
    """rad, all in all."""


@struct
class Sensed:
    """What the stages derive from one frame without memory of earlier ones."""

    up_ws: Float[Array, "3"]
    """Up of the body."""
    leg_up_ws: Float[Array, "*legs 3"]
    """Up of each leg, or one for all."""
    slide: Float[Array, ""]
    carry: Transform | Still = place("motion")
    """World motion, since the previous frame, of the ground under each foot."""
    present: Bool[Array, " legs"]
    side: Float[Array, " legs"]
    """+1 left, -1 right, 0 in the middle."""
    weight: Float[Array, " legs"]
    """0..1, `Frame.weight` by `Frame.grounded` by `leg.weight`; `phases.advance` has the rest."""
    grounded: Float[Array, ""]
    """0..1, how much of its motion the body gets; the weights have it as a factor."""
    root_ws: Float[Array, "3"]
    """m, offset that put the character on its ground."""
    hip_ws: Float[Array, "legs 3"] = place("point")
    """m, animated, with that offset."""
    ankle_ws: Float[Array, "legs 3"] = place("point")
    """m, likewise."""
    ankle_rot_ws: Float[Array, "legs 4"]
    """Animated."""
    foot_speed: Float[Array, " legs"]
    """m/s, of the animated ankles."""
    ball_ws: Float[Array, "legs 3"] = place("point")
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
    warp_ws: Float[Array, "legs 3"] | None = None
    """m, by which scaled and turned strides move the ankles from the animation on the turned
    pelvis; they have moved already. None for none."""
    turn: Turn | None = None
    """Of a character that moves in another direction than its animation."""

    @property
    def bearing(self) -> Float[Array, "*legs"]:
        """0..1, see `bearing`."""
        return bearing(self.leg_up_ws, self.up_ws)

    @property
    def load(self) -> Float[Array, " legs"]:
        """0..1, the weight with which each leg moves the body: that of a hand on a wall is 0."""
        return self.weight * self.bearing

    @property
    def unscaled_ankle_ws(self) -> Float[Array, "legs 3"]:
        """m, the animated ankles before strides are scaled and turned."""
        return self.ankle_ws if self.warp_ws is None else self.ankle_ws - self.warp_ws

    @property
    def ground_rise(self) -> Float[Array, " legs"]:
        """m, how far the place under each foot has risen along up since the previous frame."""
        return rise_of(self.carry, self.foothold.point_ws, self.leg_up_ws)

    @property
    def turned(self) -> Float[Array, " legs"]:
        """0..1, how far each foot turns to the ground under it."""
        standing = self.contact.weight
        return self.ground.ankle.found * (standing + self.ground.swing * (1.0 - standing))


def bearing(leg_up_ws: Float[Array, "*legs 3"], up_ws: Float[Array, "3"]) -> Float[Array, "*legs"]:
    """0..1, how far each leg bears the body; 1 for all where they share its up.

    A limb whose up is far from the body's, such as a hand on a wall or on a ceiling, bears nothing:
    its ground says nothing of how high the body is or how it leans, nor does its height over the
    animation's floor say whether it stands.
    """
    if leg_up_ws.ndim == up_ws.ndim:
        return jnp.ones_like(up_ws[..., 0])
    cosine = vec.dot(leg_up_ws, up_ws)
    return smoothstep((cosine - LEAST_BEARING) / (FULL_BEARING - LEAST_BEARING))


def rise_of(
    carry: Transform | Still, points_ws: Float[Array, "*b 3"], up_ws: Float[Array, "*#b 3"]
) -> Float[Array, "*b"]:
    """m, how far places that are at these points now have risen along up since the last frame."""
    if isinstance(carry, Still):
        return jnp.zeros_like(points_ws[..., 0])
    return vec.dot(points_ws - carry.inverse().apply(points_ws), up_ws)


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
    return Foothold(point_ws, lift, base + lift * climb, climb, found)


def heading(world_from_model: Transform, up_ws: Float[Array, "*legs 3"]) -> tuple[Array, Array]:
    """Unit forward and right of the character at right angles to `up_ws`, world space.

    Where the character's forward is along up (a body lying on its back or front), its own up is
    used instead.
    """
    forward = quat.rotate(world_from_model.rot, vec.constant(FORWARD, up_ws))
    upright = quat.rotate(world_from_model.rot, vec.constant(UP, up_ws))
    forward_ws = vec.across(forward, up_ws, upright)
    return forward_ws, vec.cross(forward_ws, up_ws)
