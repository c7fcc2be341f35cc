"""Stage 8: where each leg is sent once the body has moved, and how much of foot IK it gets."""

from abc import abstractmethod

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxik.maths import quat, smoothing, vec
from jaxik.maths.parameter_tree import Leaf, Rule, parameter, switch
from jaxik.maths.struct import struct
from jaxik.world.skeleton import Rig, Transform

from .inputs import SensedMoment
from .pelvis import PelvisState, requested_heights

HEIGHT_BAND = 0.01  # m
ANGLE_BAND = 0.035  # rad, 2 degrees


@struct
class Effector:
    """What the legs are solved for."""

    target_ws: Float[Array, "legs 3"]  # m, of the ankles
    rot_ws: Float[Array, "legs 4"]  # of the ankles, as the foot's rule takes it
    weight: Float[Array, " legs"]  # 0..1, share of foot IK


class AbstractEffector(Rule):
    """Follows the targets."""

    @abstractmethod
    def init(self, rig: Rig) -> PyTree:
        """Memory before the first frame."""

    @abstractmethod
    def awake(self, now: SensedMoment, state: PyTree) -> Float[Array, ""]:
        """0 while the body shall stay as it is, else 1."""

    @abstractmethod
    def advance(
        self, now: SensedMoment, target: Transform, pelvis: PelvisState, state: PyTree
    ) -> tuple[PyTree, Effector]:
        """Memory after this frame, and where the legs go."""


class AbstractInstantEffector(AbstractEffector):
    """Follows by the present frame alone."""

    def init(self, rig: Rig) -> None:
        return None

    def awake(self, now: SensedMoment, state: None) -> Float[Array, ""]:
        return jnp.ones_like(now.dt)


class DirectEffector(AbstractInstantEffector):
    """The targets as they are; a foot without ground goes where it was animated."""

    def advance(
        self, now: SensedMoment, target: Transform, pelvis: PelvisState, state: None
    ) -> tuple[None, Effector]:
        return None, Effector(target.pos, target.rot, now.sensed.weight)


class FoundEffector(AbstractInstantEffector):
    """The targets of feet that found ground; other legs stay as the body carries them (ozz)."""

    def advance(
        self, now: SensedMoment, target: Transform, pelvis: PelvisState, state: None
    ) -> tuple[None, Effector]:
        sensed = now.sensed
        return None, Effector(target.pos, target.rot, sensed.weight * sensed.foothold.found)


class HeelEffector(AbstractInstantEffector):
    """Lifts a heel where its leg would otherwise be too long, as a walker's trailing foot does.

    The foot turns about its ball, toes down, until the ankle is within `extension` of the leg's
    length of the hip, or within the animated distance where that is longer, by `max_lift` at most
    (as the heel lift of locomotion systems after Johansen, 2009).
    """

    extension: Leaf = parameter(
        0.98,
        unit="1",
        low=0.8,
        high=1.0,
        doc="Part of its length to which a leg stretches before the heel rises.",
    )
    max_lift: Leaf = parameter(
        0.60, unit="rad", low=0.0, high=1.2, doc="Largest angle by which the heel is lifted."
    )

    def advance(
        self, now: SensedMoment, target: Transform, pelvis: PelvisState, state: None
    ) -> tuple[None, Effector]:
        sensed = now.sensed
        turn = quat.multiply(target.rot, quat.conjugate(sensed.ankle_rot_ws))
        arm = quat.rotate(turn, sensed.ankle_ws - sensed.ball_ws)
        ball = target.pos - arm
        axis = vec.cross(sensed.ahead_ws, sensed.leg_up_ws)
        spare = vec.length(sensed.ankle_ws - sensed.hip_ws)
        longest = self.extension * (sensed.thigh + sensed.shin)
        longest = jnp.where(spare > longest, spare, longest)
        hip = sensed.hip_ws + pelvis.offset_ws
        angle = heel_angle(ball - hip, arm, axis, longest)
        level = jnp.zeros_like(angle)
        angle = now.gate.clip(angle, level, level + self.max_lift, band=ANGLE_BAND)
        lift = quat.from_axis_angle(axis, -angle)
        rot_ws = quat.multiply(lift, target.rot)
        return None, Effector(ball + quat.rotate(lift, arm), rot_ws, sensed.weight)


def heel_angle(to_ball: Array, arm: Array, axis: Array, length: Array) -> Float[Array, " legs"]:
    """Turn of `arm`, rad, toes down about `axis`, after which `to_ball + arm` is `length` long.

    Below 0 where it is shorter as it is; where it never gets so short, the turn that comes nearest;
    0 where it would only get longer. The squared length is `c + P cos + Q sin` of the turn.
    """
    along = vec.scale(axis, vec.dot(arm, axis))
    across = arm - along
    start = to_ball + along
    constant = vec.dot(start, start) + vec.dot(across, across)
    cos_part = 2.0 * vec.dot(start, across)
    sin_part = 2.0 * vec.dot(start, vec.cross(across, axis))
    size = vec.safe_sqrt(cos_part**2 + sin_part**2)
    helps = sin_part < 0
    cosine = vec.safe_divide(length**2 - constant, size)
    inside = (cosine > -1) & (cosine < 1)
    edge = jnp.where(cosine < 0, jnp.pi, 0.0)
    safe = jnp.where(inside, cosine, 0.0)
    turned = jnp.where(inside, vec.safe_arctan2(vec.safe_sqrt(1.0 - safe**2), safe), edge)
    phase = vec.safe_arctan2(jnp.where(helps, sin_part, -1.0), cos_part)
    return jnp.where(helps, turned + phase, 0.0)


@struct
class BodyState:
    """Feet relative to the body."""

    height: Float[Array, " legs"]  # m, of the ankles over the moved body's animation
    asleep: Float[Array, ""]  # 0 or 1


class BodyEffector(AbstractEffector):
    """Smooths each foot's height relative to the body, after the body has moved (Unreal, seed 001).

    The height goes to the asked one less the pelvis' goal by the clamped-speed law, and the foot
    moves with the pelvis. With `latch` on everything stops once all feet are within
    `latch_distance` of their goals, until the character moves: a pelvis slower than the feet then
    freezes short of its goal, which is the original's trap. Off is recommended.
    """

    speed: Leaf = parameter(
        15.0,
        unit="1/s",
        low=0.5,
        high=30.0,
        scale="log",
        doc="Rate at which feet follow their heights relative to the body.",
    )
    latch: Leaf = switch(
        False, doc="Whether everything stops once the feet have arrived, until the character moves."
    )
    latch_distance: Leaf = parameter(
        0.01,
        unit="m",
        low=0.0,
        high=0.05,
        kind="threshold",
        doc="Distance from its goal within which a foot counts as arrived.",
    )
    mesh_scale: Leaf = parameter(
        1.0,
        unit="1",
        low=0.5,
        high=2.0,
        doc="Scale of the character's mesh, by which heights of feet are divided.",
    )

    def init(self, rig: Rig) -> BodyState:
        return BodyState(jnp.zeros_like(rig.side), jnp.zeros((), rig.side.dtype))

    def awake(self, now: SensedMoment, state: BodyState) -> Float[Array, ""]:
        return 1.0 - state.asleep * self._still(now)

    def advance(
        self, now: SensedMoment, target: Transform, pelvis: PelvisState, state: BodyState
    ) -> tuple[BodyState, Effector]:
        sensed = now.sensed
        awake = self.awake(now, state)
        asked = requested_heights(sensed, target.pos)
        goal = asked - pelvis.goal
        share = smoothing.fraction_of_speed(self.speed, now.dt, goal - state.height)
        share = awake * now.progress(share)
        height = smoothing.lerp(state.height, goal, share)

        near = now.gate.below(jnp.abs(goal - height), self.latch_distance, band=HEIGHT_BAND)
        arrived = jnp.prod(jnp.where(sensed.weight > 0, near, 1.0))
        falls = jnp.where(self.latch, self._still(now), 0.0)
        asleep = falls * (1.0 - awake * (1.0 - arrived))

        moved = vec.scale(sensed.leg_up_ws, height / self.mesh_scale - asked) + pelvis.offset_ws
        effector = Effector(target.pos + moved, target.rot, sensed.weight)
        return BodyState(height, asleep), effector

    def _still(self, now: SensedMoment) -> Float[Array, ""]:
        """1 while all feet stand."""
        sensed = now.sensed
        standing = jnp.where(sensed.weight > 0, sensed.contact.planted, 1.0)
        return now.gate.minimum(standing, band=0.1)


@struct
class FadeState:
    """How far each leg has come, and what its last ground asked of it."""

    share: Float[Array, " legs"]  # 0..1
    offset_ws: Float[Array, "legs 3"]  # m, from the animated ankle to the target
    turn_ws: Float[Array, "legs 4"]  # from the animated ankle's rotation to the wanted one


class FadeEffector(AbstractEffector):
    """Fades each leg in while it finds ground and out while it does not, at one pace (Mec).

    On the way out the leg keeps what the last ground asked of it: the same offset from its
    animation, and the same turn.
    """

    transition_time: Leaf = parameter(
        0.20, unit="s", low=0.0, high=1.0, doc="Time in which foot IK of a leg fades in or out."
    )

    def init(self, rig: Rig) -> FadeState:
        upright = jnp.broadcast_to(quat.identity(rig.side.dtype), (*rig.side.shape, 4))
        return FadeState(jnp.zeros_like(rig.side), jnp.zeros_like(rig.knee_axis_ls), upright)

    def awake(self, now: SensedMoment, state: FadeState) -> Float[Array, ""]:
        return jnp.ones_like(now.dt)

    def advance(
        self, now: SensedMoment, target: Transform, pelvis: PelvisState, state: FadeState
    ) -> tuple[FadeState, Effector]:
        sensed = now.sensed
        found = sensed.foothold.found
        step = now.progress(smoothing.step_of_time(self.transition_time, now.dt))
        share = smoothing.move_towards(state.share, found, step)
        asked = target.pos - sensed.ankle_ws
        offset_ws = now.gate.choose(found[..., None], asked, state.offset_ws)
        turn = quat.multiply(target.rot, quat.conjugate(sensed.ankle_rot_ws))
        turn_ws = quat.nlerp(state.turn_ws, turn, found)
        effector = Effector(
            sensed.ankle_ws + offset_ws,
            quat.multiply(turn_ws, sensed.ankle_rot_ws),
            sensed.weight * share,
        )
        return FadeState(share, offset_ws, turn_ws), effector
