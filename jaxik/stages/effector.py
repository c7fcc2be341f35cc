"""Stage 10: where each leg goes once the body has moved, and how much foot IK it gets."""

from abc import abstractmethod

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxik.maths import quat, smoothing, vec
from jaxik.maths.parameter_tree import (
    Leaf,
    Rule,
    angle,
    duration,
    rate,
    ratio,
    switch,
    threshold,
)
from jaxik.maths.struct import place, struct
from jaxik.world.frame import Sensed
from jaxik.world.skeleton import Rig, Transform

from .inputs import SensedMoment
from .pelvis import PelvisState, requested_heights

HEIGHT_BAND = 0.01  # m
ANGLE_BAND = 0.035  # rad, 2 degrees
# Sine of the angle by which a leg points ahead, up to which its heel rises and from which it stays.
RISES, STAYS = 0.0, 0.3
AWAITED = 0.1  # weight of a leg, from which the latch waits for its foot
SHORTENS = 0.3  # of the most that a rising heel can shorten a leg, from which it counts in full


@struct
class Effector:
    """What the legs are solved for."""

    target_ws: Float[Array, "legs 3"] = place("point")
    """m, of the ankles."""
    rot_ws: Float[Array, "legs 4"]
    """Of the ankles, for the foot rule."""
    weight: Float[Array, " legs"]
    """0..1, how much of its weight each leg gets."""


class AbstractEffector(Rule):
    """Turns the targets of the feet into those of the legs."""

    by_contact: Leaf = switch(
        False,
        "Whether a foot gets as much foot IK as its contact, so that it swings as animated.",
    )

    def init(self, rig: Rig) -> PyTree:
        """Memory before the first frame; None for a rule that goes by each frame alone."""
        return None

    def awake(self, now: SensedMoment, state: PyTree) -> Float[Array, ""]:
        """0 while the body is to stay where it is, else 1."""
        return jnp.ones_like(now.dt)

    @abstractmethod
    def advance(
        self, now: SensedMoment, target: Transform, pelvis: PelvisState, state: PyTree
    ) -> tuple[PyTree, Effector]:
        """Memory after this frame, and where the legs go.

        Args:
            now: the sensed frame.
            target: where the ankles are to go (legs), world space.
            pelvis: the body's offset in this frame.
            state: memory after the frame before.
        """


class DirectEffector(AbstractEffector):
    """The targets themselves; a foot without ground goes to its animated place.

    With `if_found` on, the leg of a foot without ground moves with the body instead (ozz).
    """

    if_found: Leaf = switch(False, "Whether only feet that found ground get foot IK.")

    def advance(
        self, now: SensedMoment, target: Transform, pelvis: PelvisState, state: None
    ) -> tuple[None, Effector]:
        weight = jnp.where(self.if_found, now.sensed.foothold.found, 1.0)
        return None, Effector(target.pos, target.rot, weight)


class HeelEffector(AbstractEffector):
    """Lifts the heel of a leg that would be over-stretched, as the trailing foot of a walker.

    The foot, tilted as the ground, turns about its ball, toes down, until the distance from hip to
    ankle is `extension` times the length of the leg, or the animated distance if that is longer. It
    turns by at most `max_lift`. Locomotion systems after Johansen (2009) lift heels in this way.

    Where a leg points far ahead of its hip, its heel stays: to rise brings the ankle up but also
    forward, away from the hip, so that a foot about to land would flick its toes down to gain
    little.
    """

    extension: Leaf = ratio(
        0.98, 0.8, 1, "Part of its length to which a leg stretches before the heel rises."
    )
    max_lift: Leaf = angle(0.6, 0, 1.2, "Largest angle by which the heel is lifted.")

    def advance(
        self, now: SensedMoment, target: Transform, pelvis: PelvisState, state: None
    ) -> tuple[None, Effector]:
        sensed = now.sensed
        from_animated = quat.multiply(target.rot, quat.conjugate(sensed.ankle_rot_ws))
        tilt = foot_tilt(sensed)
        arm = quat.rotate(from_animated, sensed.ankle_ws - sensed.ball_ws)
        arm = quat.rotate(tilt, arm)
        ball = target.pos - arm
        axis = vec.cross(sensed.ahead_ws, sensed.leg_up_ws)
        tilted_axis = quat.rotate(tilt, axis)
        animated = vec.length(sensed.unscaled_ankle_ws - sensed.hip_ws)
        longest = self.extension * (sensed.thigh + sensed.shin)
        longest = jnp.where(animated > longest, animated, longest)
        hip = sensed.hip_ws + pelvis.offset_ws
        angle = heel_angle(ball - hip, arm, tilted_axis, longest)
        zero = jnp.zeros_like(angle)
        angle = now.gate.clip(angle, zero, zero + self.max_lift, band=ANGLE_BAND)
        to_ankle = target.pos - hip
        ahead = vec.safe_divide(vec.dot(to_ankle, sensed.ahead_ws), vec.length(to_ankle))
        angle *= 1.0 - smoothing.smoothstep((ahead - RISES) / (STAYS - RISES))
        (angle,) = vec.stacked_barrier(angle)
        raised = quat.rotate(quat.from_axis_angle(tilted_axis, -angle), arm)
        # The foot rule tilts the foot once it is raised.
        rot_ws = quat.multiply(quat.from_axis_angle(axis, -angle), target.rot)
        return None, Effector(ball + raised, rot_ws, jnp.ones_like(angle))


def foot_tilt(sensed: Sensed) -> Float[Array, "legs 4"]:
    """Rotation of a level foot onto the ground under it, as far as it turns."""
    up = jnp.broadcast_to(sensed.leg_up_ws, sensed.ahead_ws.shape)
    tilt = quat.shortest_arc(up, sensed.ground.ankle.normal, sensed.ahead_ws)
    return quat.nlerp(quat.identity(tilt.dtype), tilt, sensed.turned)


def heel_angle(to_ball: Array, arm: Array, axis: Array, length: Array) -> Float[Array, " legs"]:
    """Angle by which the heel has to rise for the leg to have a given length, rad.

    It turns `arm` about `axis`, toes down, so that `to_ball + arm` has the length `length`. It is
    negative if the leg is shorter already. If the leg cannot become so short, it is the angle that
    comes nearest. The less a first small rise shortens the leg, the smaller the angle; where it
    would lengthen it, it is 0. The squared length is `c + P cos + Q sin` of the angle.

    Args:
        to_ball: from hip to ball, m.
        arm: from ball to ankle, m.
        axis: unit.
        length: wanted from hip to ankle, m.
    """
    along = vec.scale(axis, vec.dot(arm, axis))
    across = arm - along
    start = to_ball + along
    constant = vec.dot(start, start) + vec.dot(across, across)
    cos_part = 2.0 * vec.dot(start, across)
    sin_part = 2.0 * vec.dot(start, vec.cross(across, axis))
    constant, cos_part, sin_part = vec.stacked_barrier(constant, cos_part, sin_part)
    size = vec.safe_sqrt(cos_part**2 + sin_part**2)
    shortens = sin_part < 0
    cosine = vec.safe_divide(length**2 - constant, size)
    inside = (cosine > -1) & (cosine < 1)
    limit = jnp.where(cosine < 0, jnp.pi, 0.0)
    safe = jnp.where(inside, cosine, 0.0)
    angle = jnp.where(inside, vec.safe_arctan2(vec.safe_sqrt(1.0 - safe**2), safe), limit)
    phase = vec.safe_arctan2(jnp.where(shortens, sin_part, -1.0), cos_part)
    return (angle + phase) * smoothing.smoothstep(-vec.safe_divide(sin_part, size) / SHORTENS)


@struct
class BodyState:
    """Heights of the feet relative to the body."""

    height: Float[Array, " legs"]
    """m, of the ankles above their animation on the moved body."""
    asleep: Float[Array, ""]
    """0 or 1."""


class BodyEffector(AbstractEffector):
    """Smooths each foot's height relative to the body, after the body has moved (Unreal).

    The height goes to the requested height less the pelvis' goal, by the clamped-speed law of
    Unreal's interp-to, and the foot moves with the pelvis. With `latch` on, as in the original,
    everything stops once all feet are within `latch_distance` of their goals, until the character
    moves. A pelvis slower than the feet then freezes short of its goal, so better leave it off.

    The original divides these heights by the vertical scale of the mesh, because they go into the
    space of the mesh, from which the engine brings them back by the same factor. Here poses and
    heights are in metres of the world, whatever the scale of the mesh, so there is none.
    """

    speed: Leaf = rate(15, 0.5, 30, "Rate at which feet follow their heights relative to the body.")
    latch: Leaf = switch(
        False,
        "Whether everything stops once the feet have arrived, until the character moves.",
        per_leg=False,
    )
    latch_distance: Leaf = threshold(
        0.01, 0, 0.05, "Distance from its goal within which a foot counts as arrived.", unit="m"
    )

    def init(self, rig: Rig) -> BodyState:
        return BodyState(jnp.zeros_like(rig.side), jnp.zeros((), rig.side.dtype))

    def awake(self, now: SensedMoment, state: BodyState) -> Float[Array, ""]:
        return 1.0 - state.asleep * self._stands(now)

    def advance(
        self, now: SensedMoment, target: Transform, pelvis: PelvisState, state: BodyState
    ) -> tuple[BodyState, Effector]:
        sensed = now.sensed
        awake = self.awake(now, state)
        requested = requested_heights(sensed, target.pos)
        goal = requested - sensed.bearing * pelvis.goal
        fraction = smoothing.fraction_of_speed(self.speed, now.dt, goal - state.height)
        fraction = awake * now.progress(fraction)
        height = smoothing.lerp(state.height, goal, fraction)

        near = now.gate.below(jnp.abs(goal - height), self.latch_distance, band=HEIGHT_BAND)
        arrived = jnp.prod(1.0 - _awaited(sensed) * (1.0 - near))
        may_sleep = jnp.where(self.latch, self._stands(now), 0.0)
        asleep = may_sleep * (1.0 - awake * (1.0 - arrived))

        # What does not bear the body does not move with it either.
        carried_ws = vec.scale(pelvis.offset_ws, sensed.bearing)
        offset_ws = vec.scale(sensed.leg_up_ws, height - requested) + carried_ws
        effector = Effector(target.pos + offset_ws, target.rot, jnp.ones_like(height))
        return BodyState(height, asleep), effector

    def _stands(self, now: SensedMoment) -> Float[Array, ""]:
        """1 while all feet with foot IK stand."""
        sensed = now.sensed
        standing = 1.0 - _awaited(sensed) * (1.0 - sensed.contact.planted)
        return now.gate.minimum(standing, band=0.1)


def _awaited(sensed: Sensed) -> Float[Array, " legs"]:
    """0..1, how far the latch waits for each foot: a decision about when, not about how far."""
    return smoothing.clip_to_one(sensed.weight / AWAITED)


@struct
class FadeState:
    """How far each leg has faded in, and where its last ground put it."""

    weight: Float[Array, " legs"]
    """From 0 to 1."""
    offset_ws: Float[Array, "legs 3"]
    """m, from the animated ankle to the target."""
    rot_ws: Float[Array, "legs 4"]
    """From the animated rotation of the ankle to the target."""


class FadeEffector(AbstractEffector):
    """Fades each leg in while it finds ground and out while it does not, linearly (Mec).

    While it fades out, a leg keeps the offset and the rotation, relative to the animation, that the
    last ground gave it.
    """

    transition_time: Leaf = duration(0.2, 0, 1, "Time in which foot IK of a leg fades in or out.")

    def init(self, rig: Rig) -> FadeState:
        identity = jnp.broadcast_to(quat.identity(rig.side.dtype), (*rig.side.shape, 4))
        return FadeState(jnp.zeros_like(rig.side), jnp.zeros_like(rig.knee_axis_ls), identity)

    def advance(
        self, now: SensedMoment, target: Transform, pelvis: PelvisState, state: FadeState
    ) -> tuple[FadeState, Effector]:
        sensed = now.sensed
        found = sensed.foothold.found
        step = now.progress(smoothing.step_of_time(self.transition_time, now.dt))
        weight = smoothing.move_towards(state.weight, found, step)
        offset_ws = target.pos - sensed.ankle_ws
        kept_ws = sensed.carry.turn(state.offset_ws)
        offset_ws = now.gate.choose(found[..., None], offset_ws, kept_ws)
        rot_ws = quat.multiply(target.rot, quat.conjugate(sensed.ankle_rot_ws))
        rot_ws = quat.nlerp(sensed.carry.turn_rot(state.rot_ws), rot_ws, found)
        effector = Effector(
            sensed.ankle_ws + offset_ws, quat.multiply(rot_ws, sensed.ankle_rot_ws), weight
        )
        return FadeState(weight, offset_ws, rot_ws), effector
