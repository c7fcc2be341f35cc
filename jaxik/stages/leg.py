"""Stage 11: two-bone legs that bring the ankles to their targets."""

# pyright: reportInvalidTypeVarUse=false

import dataclasses
from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxik.maths import quat, vec
from jaxik.maths.gate import AbstractGate
from jaxik.maths.parameter_tree import Declared, Leaf, Rule, angle, length, option, ratio, switch
from jaxik.maths.struct import struct
from jaxik.solvers.rotations import LENGTH_BAND, PoleTarget, local_correction
from jaxik.solvers.two_bone import (
    Limb,
    LimbBend,
    bend_to_pole,
    hinge_half_angle,
    soft_limit,
    stretch_to,
    swing_rotation,
    third_side,
)
from jaxik.world.frame import Sensed
from jaxik.world.skeleton import LegPose, Rig, Transform

from .inputs import Inputs

FULL = 0.999  # weight of a leg from which it gets foot IK in full


@struct
class SolvedLeg:
    """Legs after two-bone IK, their feet not yet turned."""

    pose: LegPose
    """Legs, model space."""
    hip: Float[Array, "legs 4"]
    """Local correction, right-multiplied."""
    knee: Float[Array, "legs 4"]
    """Local correction, right-multiplied."""
    reached: Float[Array, " legs"]
    """1 where the ankle is at its target, else 0."""
    stretch: Float[Array, " legs"] | None = None
    """Length of thigh and shin as a multiple of the animated one; None for 1."""


@struct
class LegGoal:
    """What the legs are solved for."""

    pose: LegPose
    """Legs, animated, on the moved body, model space."""
    target_ms: Float[Array, "legs 3"]
    """m, of the ankles."""
    weight: Float[Array, " legs"]
    """0..1, how much foot IK each leg gets."""


class AbstractLeg(Rule):
    """Solves the legs for their targets."""

    weight: eqx.AbstractVar[Array]
    """0..1, how much foot IK each leg gets."""

    @abstractmethod
    def pose(self, inputs: Inputs, sensed: Sensed, goal: LegGoal) -> SolvedLeg:
        """The legs with their ankles at their targets."""


class AbstractTwoBoneLeg(AbstractLeg):
    """Turns two bones; with `allow_stretch` on, it makes them longer where they are too short.

    A target further away than `soften` times the leg's reach is reached by longer bones, both by
    the same factor, up to `max_stretch`; the knee stays as bent as it is there. Mecanim has such a
    *Leg Stretch* for humanoids, whose formula is not published, and Unreal's two-bone IK too.
    """

    max_stretch: Leaf = ratio(
        1.05,
        1,
        1.3,
        "Longest bones of a stretched leg, as a multiple of the animated ones.",
    )
    allow_stretch: bool = option(
        False, "Whether bones of legs are stretched to targets out of reach."
    )

    @property
    def longest(self) -> Array | None:
        """How long bones may become, as a multiple of what they are; None leaves them."""
        return self.max_stretch if self.allow_stretch else None


def _soften_parameter(default: float, low: float) -> Declared:
    doc = "Part of its reach beyond which a leg slows down instead of snapping straight."
    return ratio(default, low, 1, doc)


def _twist_parameter() -> Declared:
    doc = "Turn of the leg about the line from hip to target."
    return angle(0, -1, 1, doc)


def _weight_parameter() -> Declared:
    doc = "How much of foot IK each leg takes, 0 to 1."
    return ratio(1, 0, 1, doc)


class TwoBone(AbstractTwoBoneLeg):
    """Turns the knee about its hinge until the ankle is as far as the target, then swings the hip.

    This is exact for hinges that are not perpendicular to the leg: lengths are split into parts
    along and across the hinge, and the triangle is closed across it. The half-angle algebra follows
    ozz-animation's two-bone job. Knee limits and softening act on the distance from hip to ankle,
    not on the angle: beyond `soften` times the longest reach, the leg approaches that reach
    exponentially. With `as_animated` on, a leg that the animation holds straighter or more bent may
    stay so.

    Beyond reach the leg points at the target. With the target on the hip it keeps its direction. A
    leg with a bone of no length, or along its hinge, does not bend.
    """

    max_knee_angle: Leaf = angle(
        3.0000531803, 2, 3.1415926536, "Largest interior angle of the knee; pi is a straight leg."
    )
    min_knee_angle: Leaf = angle(0.6982008392, 0, 1.8, "Smallest interior angle of the knee.")
    soften: Leaf = _soften_parameter(0.98, low=0.8)
    as_animated: Leaf = switch(
        False, "Whether a leg may stay as straight or bent as animated, beyond the limits."
    )
    twist: Leaf = _twist_parameter()
    weight: Leaf = _weight_parameter()

    def pose(self, inputs: Inputs, sensed: Sensed, goal: LegGoal) -> SolvedLeg:
        return self.solve(inputs.rig, goal, inputs.gate)

    def solve(self, rig: Rig, goal: LegGoal, gate: AbstractGate) -> SolvedLeg:
        """The legs by themselves, without the rest of the pipeline."""
        pose, target_ms = goal.pose, goal.target_ms
        limb = limb_of(rig, pose)
        to_target = vec.subtract(target_ms, pose.hip.pos)
        reach, reached, stretch = self._reach(limb, to_target, gate)
        reach, reached = vec.stacked_barrier(reach, reached)
        half_cos, half_sin = hinge_half_angle(limb, reach)
        knee_rot = quat.from_half_angle(limb.hinge, half_cos, half_sin)
        bent = quat.rotate(knee_rot, limb.to_ankle) - limb.to_hip
        swing = swing_rotation(bent, to_target, limb.hinge, self.twist)
        return bend_leg(rig, goal, LimbBend(swing, half_cos, half_sin, reached, stretch))

    def _reach(
        self, limb: Limb, to_target: Array, gate: AbstractGate
    ) -> tuple[Array, Array, Array | None]:
        """Distance from hip to ankle before bones stretch, m; 1 where the target is in reach; and
        by how much they stretch."""
        to_hip, to_ankle = limb.to_hip, limb.to_ankle
        animated, distance = vec.length(to_ankle - to_hip), vec.length(to_target)
        thigh2, shin2 = vec.dot(to_hip, to_hip), vec.dot(to_ankle, to_ankle)
        thigh2, shin2, animated, distance = vec.stacked_barrier(thigh2, shin2, animated, distance)
        product = vec.safe_sqrt(thigh2 * shin2)
        # Behind a barrier, or every leg's loop would call the C library for the cosines again.
        cos_max, cos_min = vec.stacked_barrier(
            jnp.cos(self.max_knee_angle), jnp.cos(self.min_knee_angle)
        )
        longest = third_side(thigh2, shin2, product, cos_max)
        shortest = third_side(thigh2, shin2, product, cos_min)
        free = self.soften * longest
        longest = jnp.where(self.as_animated & (animated > longest), animated, longest)
        free = jnp.where(self.as_animated & (animated > free), animated, free)
        shortest = jnp.where(self.as_animated & (animated < shortest), animated, shortest)
        farthest, nearer, stretch = free, distance, None
        if self.longest is not None:
            stretch = stretch_to(distance, free, self.longest, gate)
            # The angles of a longer limb are those of the limb as it is with a nearer target.
            farthest, nearer = free * self.longest, distance / stretch
        allowed = gate.clip(soft_limit(nearer, free, longest), shortest, longest, band=LENGTH_BAND)
        inside = gate.above(distance, shortest, band=LENGTH_BAND)
        return allowed, inside * gate.below(distance, farthest, band=LENGTH_BAND), stretch


class PoleLeg(AbstractTwoBoneLeg):
    """ozz's two-bone job: the leg's plane contains a pole, here that of the animated knee.

    That pole is perpendicular to hinge and shin: the knee's y axis in a rig whose x axis points
    along the bone and whose z axis is the hinge. With `to_hint` on, the pole points from the hip to
    a hint in front of the shin (Mec): the toe's hit on the ground, plus the animated vector from
    ankle to knee, plus `hint_offset` in character axes. With `enabled` off legs move with the body.
    """

    enabled: Leaf = switch(True, "Whether legs are solved.")
    to_hint: Leaf = switch(False, "Whether knees turn to hints over the toes.")
    hint_offset: Leaf = length(
        (0, 0, 0),
        -0.5,
        0.5,
        "Offset of the knee's aim in character axes (x left, y up, z forward).",
    )
    soften: Leaf = _soften_parameter(1.0, low=0.1)
    twist: Leaf = _twist_parameter()
    weight: Leaf = _weight_parameter()

    def pose(self, inputs: Inputs, sensed: Sensed, goal: LegGoal) -> SolvedLeg:
        limb, frame = limb_of(inputs.rig, goal.pose), inputs.frame
        toe = frame.world_from_model.inverse().apply(sensed.ground.toe.point)
        hint = toe + frame.pose.knee.pos - frame.pose.ankle.pos + self.hint_offset
        own_pole = vec.cross(limb.hinge, limb.to_ankle)
        to_hint = jnp.expand_dims(self.to_hint, -1)
        pole = jnp.where(to_hint, hint - goal.pose.hip.pos, own_pole)
        target = PoleTarget(goal.target_ms - goal.pose.hip.pos, pole, self.twist)
        goal = dataclasses.replace(goal, weight=jnp.where(self.enabled, goal.weight, 0.0))
        bend = bend_to_pole(limb, target, self.soften, inputs.gate, self.longest)
        return bend_leg(inputs.rig, goal, bend)


def is_full(weight: Array) -> Array:
    """1 where so much foot IK brings a leg to its goal, else 0."""
    return jnp.where(weight > FULL, 1.0, 0.0)


def limb_of(rig: Rig, pose: LegPose) -> Limb:
    """The legs as limbs, model space."""
    to_hip = vec.subtract(pose.hip.pos, pose.knee.pos)
    to_ankle = vec.subtract(pose.ankle.pos, pose.knee.pos)
    return Limb(to_hip, to_ankle, quat.rotate(pose.knee.rot, rig.knee_axis_ls))


def bend_leg(rig: Rig, goal: LegGoal, bend: LimbBend) -> SolvedLeg:
    """The legs with knees, hips and bones as `bend` says, each by the goal's weight."""
    pose, weight = goal.pose, goal.weight
    limb = limb_of(rig, pose)
    thigh, shin, stretch = -limb.to_hip, limb.to_ankle, bend.stretch
    if stretch is not None:
        stretch = 1.0 + weight * (stretch - 1.0)
        thigh, shin = vec.scale(thigh, stretch), vec.scale(shin, stretch)
    half_cos, half_sin = quat.nlerp_half(bend.half_cos, bend.half_sin, weight)
    knee_rot = quat.from_half_angle(limb.hinge, half_cos, half_sin)
    swing = quat.nlerp_identity(bend.swing, weight)

    knee_pos = vec.add(pose.hip.pos, quat.rotate(swing, thigh))
    shin_rot = quat.multiply(swing, knee_rot)
    ankle_pos = vec.add(knee_pos, quat.rotate(shin_rot, shin))
    ankle = Transform(ankle_pos, quat.multiply(shin_rot, pose.ankle.rot))
    solved = LegPose(
        Transform(pose.hip.pos, quat.multiply(swing, pose.hip.rot)),
        Transform(knee_pos, quat.multiply(shin_rot, pose.knee.rot)),
        ankle,
        Transform(
            vec.add(ankle_pos, quat.rotate(shin_rot, pose.toe.pos - pose.ankle.pos)),
            quat.multiply(shin_rot, pose.toe.rot),
        ),
    )
    return SolvedLeg(
        solved,
        local_correction(pose.hip.rot, swing),
        quat.from_half_angle(rig.knee_axis_ls, half_cos, half_sin),
        bend.reached * is_full(weight),
        stretch,
    )
