"""Stage 12: ankle rotations that align the feet with the ground."""

import dataclasses
from abc import abstractmethod

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxik.maths import quat, vec
from jaxik.maths.gate import AbstractGate
from jaxik.maths.parameter_tree import Leaf, Rule, angle, length, option, ratio, switch
from jaxik.maths.smoothing import smoothstep
from jaxik.maths.struct import struct
from jaxik.solvers.rotations import PoleTarget, aim_rotation, local_correction, rotation_about
from jaxik.world.frame import FORWARD, UP, Frame, GroundHits, Sensed, animated_ankles
from jaxik.world.skeleton import LegPose, Transform
from jaxik.world.terrain import Hit, cast

from .effector import Effector
from .inputs import Inputs
from .leg import SolvedLeg, is_full
from .probe import climb, foot_heading

ANGLE_BAND = 0.035  # rad, 2 degrees
FRACTION_BAND = 0.05  # width of softened limits, as a fraction of the angle
MIN_FRACTION = 0.01  # smaller angles count as this fraction of their limit
SAME_ANGLE = 1e-6  # rad, below which a limit counts as inactive
MIN_SOLE = 0.01  # m, horizontal distance of two hits that give a pitch
LEFT = (1.0, 0.0, 0.0)  # foot axes
# Of the length of the toes: the highest ball over its sole that counts; a step under their tips
# that they bend to in full, and over how much more they bend to it less; how far their rays look.
HIGHEST_BALL, SAME_STEP, STEP_FADE, RAY = 0.9, 0.7, 0.4, 4.0


@struct
class SolvedFoot:
    """Legs with their feet turned."""

    pose: LegPose
    """Legs, model space."""
    ankle: Float[Array, "legs 4"]
    """Local correction, right-multiplied."""
    reached: Float[Array, " legs"]
    """1 where the foot has the rotation its rule wants, else 0."""
    toe: Float[Array, "legs 4"] | None = None
    """Local correction, likewise; None where toes do not bend."""


class AbstractFoot(Rule):
    """Turns the feet to the ground and, with `bend_toes` on, the toes.

    Toes then turn about their joint, the ball, across the foot, as far as their foot stands: they
    keep the angle to the ground that they have to the floor of their animation, whatever pitch
    their foot gets, as where its heel rises. The ground is where a ray meets it `toe_length` ahead
    of the ball. A step there, up or down, bends them to it; where it is higher than they are long,
    as over an edge, the ground counts as going on as it is under the foot.
    """

    toe_length: Leaf = length(0.07, 0.02, 0.15, "Distance from the ball to the tip of the toes.")
    max_toe_up: Leaf = angle(1, 0, 1.4, "Largest angle by which toes bend up from their foot.")
    max_toe_down: Leaf = angle(0.5, 0, 1, "Largest angle by which toes bend down from their foot.")
    bend_toes: bool = option(
        False, "Whether toes turn about their joint so that they stay on the ground."
    )

    @abstractmethod
    def sense(self, inputs: Inputs, ground: GroundHits) -> Float[Array, "legs 4"]:
        """Wanted ankle rotations, world space, before memory; locks may keep them."""

    @abstractmethod
    def pose(
        self, inputs: Inputs, sensed: Sensed, effector: Effector, leg: SolvedLeg
    ) -> SolvedFoot:
        """The solved legs with their feet turned."""

    def with_toes(
        self, inputs: Inputs, sensed: Sensed, weight: Array, foot: SolvedFoot
    ) -> SolvedFoot:
        """The feet with their toes on the ground, as far as they stand and have foot IK, 0..1."""
        world, up, ahead = inputs.frame.world_from_model, sensed.leg_up_ws, sensed.ahead_ws
        ankle_rot_ws = world.apply_rot(foot.pose.ankle.rot)
        from_animated = quat.multiply(ankle_rot_ws, quat.conjugate(sensed.ankle_rot_ws))
        sole, hinge = (quat.rotate(from_animated, x) for x in (ahead, vec.cross(ahead, up)))
        rise = vec.dot(sole, up)
        pitch = vec.safe_arctan2(rise, vec.length(sole - vec.scale(up, rise)))
        way = vec.scale(vec.across(sole, up, ahead), self.toe_length)
        slope = self._slope_under_toes(inputs, sensed, world.apply(foot.pose.toe.pos), way)
        bend = inputs.gate.clip(slope - pitch, -self.max_toe_down, self.max_toe_up, band=ANGLE_BAND)
        bend *= weight * sensed.contact.weight * sensed.ground.ankle.found
        turn = world.inverse().turn_rot(quat.from_axis_angle(hinge, bend))
        toe = foot.pose.toe
        pose = dataclasses.replace(foot.pose, toe=Transform(toe.pos, quat.multiply(turn, toe.rot)))
        return dataclasses.replace(foot, pose=pose, toe=local_correction(toe.rot, turn))

    def _slope_under_toes(
        self, inputs: Inputs, sensed: Sensed, ball_ws: Array, way: Array
    ) -> Array:
        """Angle at which toes rise that lie on the ground, rad; `way` leads to their tips, m."""
        up, size = sensed.leg_up_ws, self.toe_length
        height = sensed.contact.lift - vec.dot(sensed.ankle_ws - sensed.ball_ws, up)
        sole = jnp.where(height > 0, height, 0.0)
        sole = jnp.where(sole > HIGHEST_BALL * size, HIGHEST_BALL * size, sole)
        start = ball_ws + way + vec.scale(up, size)
        hit = cast(inputs.terrain, start, RAY * size + sole, sensed.ground.rays.layers)
        # Of a sole as far below the ball as in the animation.
        even = climb(sensed.ground.ankle.normal, way, up)
        even -= sole * jnp.sqrt(1.0 + vec.safe_divide(even, size) ** 2)
        step = vec.dot(hit.point - ball_ws, up) + height - sole - even
        excess = jnp.abs(step) - SAME_STEP * size
        same = 1.0 - smoothstep(vec.safe_divide(excess, STEP_FADE * size))
        rise = even + hit.found * same * step
        across = vec.safe_sqrt(size * size + rise * rise - sole * sole)
        return vec.safe_arctan2(rise, size) + vec.safe_arctan2(sole, across)


class AbstractAnimatedFoot(AbstractFoot):
    """Turns feet from their animated rotation, pitched as the probe wants them to swing."""

    def sense(self, inputs: Inputs, ground: GroundHits) -> Float[Array, "legs 4"]:
        rot_ws = animated_ankles(inputs.frame).rot
        if ground.pitch is None:
            return rot_ws
        _, right = foot_heading(inputs)
        return quat.multiply(quat.from_axis_angle(right, ground.pitch), rot_ws)


class PitchRollFoot(AbstractAnimatedFoot):
    """Pitches and rolls the animated foot onto the ground and keeps its heading (the record).

    The pitch comes from the hits of ankle and toe, or from the normal if there is no toe ray; the
    roll comes from the normal. Both are scaled by contact, unless the probe says that swinging feet
    turn too. Pitch, then roll, aligns the sole with the normal exactly.

    Limits are joint angles against the shin: 0 is a foot perpendicular to it, a positive pitch
    lifts the toes and a positive roll the outer edge, so that one pair of roll limits serves both
    sides; a foot in the middle rolls as a left one. They limit what the ground adds: an animation
    beyond its limits stays as it is.
    """

    max_pitch: Leaf = angle(
        0.52, 0, 1.4, "Largest pitch against the shin, toes up, to which the ground turns a foot."
    )
    min_pitch: Leaf = angle(
        -0.79, -1.4, 0, "Largest pitch against the shin, toes down, as a negative angle."
    )
    max_roll: Leaf = angle(
        0.26,
        0,
        1,
        "Largest roll against the shin, outer edge up, to which the ground turns a foot.",
    )
    min_roll: Leaf = angle(
        -0.52, -1, 0, "Largest roll against the shin, outer edge down, as a negative angle."
    )

    def pose(
        self, inputs: Inputs, sensed: Sensed, effector: Effector, leg: SolvedLeg
    ) -> SolvedFoot:
        rig, frame, gate = inputs.rig, inputs.frame, inputs.gate
        up = sensed.leg_up_ws
        left, _, sole = quat.axes(quat.multiply(effector.rot_ws, rig.ankle_from_foot))
        side = jnp.where(jnp.abs(rig.side) < 0.5, 1.0, rig.side)
        outer = vec.scale(left, side)
        ahead = vec.across(sole, up, sensed.slope.forward_ws)
        right = vec.cross(ahead, up)

        pitch, roll = vec.stacked_barrier(*ground_angles(sensed, ahead, right, side))
        shin = vec.normalize(
            leg.pose.ankle.pos - leg.pose.knee.pos, vec.constant((0.0, -1.0, 0.0), up)
        )
        shin = quat.rotate(frame.world_from_model.rot, shin)
        wanted_pitch, wanted_roll = pitch, roll
        pitch = limit_tilt(pitch, joint_angle(sole, shin), self.min_pitch, self.max_pitch, gate)
        roll = limit_tilt(roll, joint_angle(outer, shin), self.min_roll, self.max_roll, gate)

        pitch, roll = vec.stacked_barrier(pitch, roll)
        # A roll about the level axis before the pitch is a roll about the pitched axis after it.
        tilt = quat.multiply(
            quat.from_axis_angle(right, pitch), quat.from_axis_angle(ahead, roll * side)
        )
        lost = jnp.abs(pitch - wanted_pitch) + jnp.abs(roll - wanted_roll)
        unlimited = gate.below(lost, jnp.full_like(lost, SAME_ANGLE), band=ANGLE_BAND)
        return turn_feet(frame, effector, leg, quat.multiply(tilt, effector.rot_ws), unlimited)


class AimFoot(AbstractAnimatedFoot):
    """ozz's aim job: the foot's up axis aims at a point one metre above the ground on its normal.

    It starts from the foot after the leg was solved. The axis out of the sole, from `offset` in
    foot axes, aims at the ankle's target plus the normal. The foot's forward axis is kept as close
    as possible, then turned by `twist`. A leg without ground, or with `enabled` off, keeps the
    foot that the solved leg gives it.
    """

    enabled: Leaf = switch(True, "Whether feet are turned to the ground.")
    offset: Leaf = length(
        (0, 0, 0), -0.2, 0.2, "Where the axis out of the sole starts, from the ankle, in foot axes."
    )
    twist: Leaf = angle(0, -1, 1, "Turn of the foot about its aim.")
    weight: Leaf = ratio(1, 0, 1, "How far feet are turned to the ground, 0 to 1.")

    def pose(
        self, inputs: Inputs, sensed: Sensed, effector: Effector, leg: SolvedLeg
    ) -> SolvedFoot:
        rig, frame = inputs.rig, inputs.frame
        carried = leg.pose.ankle
        model_from_world = frame.world_from_model.inverse()
        foot = quat.multiply(carried.rot, rig.ankle_from_foot)
        aim = model_from_world.apply(effector.target_ws + sensed.ground.ankle.normal) - carried.pos
        upward, ahead = (quat.rotate(foot, vec.constant(axis, aim)) for axis in (UP, FORWARD))
        start = quat.rotate(foot, self.offset)
        aim_rot, reached = aim_rotation(
            PoleTarget(aim, ahead, self.twist), upward, start, ahead, inputs.gate
        )
        weight = jnp.where(self.enabled, effector.weight * sensed.foothold.found, 0.0)
        aim_rot = quat.nlerp(quat.identity(aim_rot.dtype), aim_rot, weight * self.weight)
        turned = quat.multiply(aim_rot, carried.rot)
        return with_ankle(frame, leg, turned, reached * is_full(weight * self.weight))


class FlatFoot(AbstractFoot):
    """Lays the foot flat on its three hits and keeps the animated heading (Mec).

    The pitch is that from foot to toe, the roll that from foot to corner; each is 0 where its ray
    missed. Both tilt a level foot, together by at most `max_tilt`.
    """

    max_tilt: Leaf = angle(0.7853981634, 0, 1.5, "Largest angle by which a foot is tilted.")

    def sense(self, inputs: Inputs, ground: GroundHits) -> Float[Array, "legs 4"]:
        up_ws = inputs.terrain.leg_up_ws
        ahead, right = foot_heading(inputs)
        pitch = rise_angle(ground.ankle, ground.toe, ahead, up_ws)
        roll = rise_angle(ground.ankle, ground.corner, right, up_ws)
        tilt = quat.multiply(quat.from_axis_angle(right, pitch), quat.from_axis_angle(ahead, -roll))
        level = quat.multiply(level_foot(ahead, up_ws), quat.conjugate(inputs.rig.ankle_from_foot))
        flat = quat.multiply(limit_angle(tilt, self.max_tilt, inputs.gate), level)
        return quat.nlerp(animated_ankles(inputs.frame).rot, flat, ground.ankle.found)

    def pose(
        self, inputs: Inputs, sensed: Sensed, effector: Effector, leg: SolvedLeg
    ) -> SolvedFoot:
        return turn_feet(inputs.frame, effector, leg, effector.rot_ws, sensed.ground.ankle.found)


class KeepFoot(AbstractAnimatedFoot):
    """Feet keep their animated rotation in the world (Unreal)."""

    def pose(
        self, inputs: Inputs, sensed: Sensed, effector: Effector, leg: SolvedLeg
    ) -> SolvedFoot:
        return turn_feet(
            inputs.frame, effector, leg, effector.rot_ws, jnp.ones_like(effector.weight)
        )


def turn_feet(
    frame: Frame, effector: Effector, leg: SolvedLeg, rot_ws: Array, reached: Array
) -> SolvedFoot:
    """The legs with ankle rotations `rot_ws`, world space, each by its weight of foot IK."""
    rot_ms = quat.multiply(quat.conjugate(frame.world_from_model.rot), rot_ws)
    rot = quat.nlerp(leg.pose.ankle.rot, rot_ms, effector.weight)
    return with_ankle(frame, leg, rot, reached * is_full(effector.weight))


def with_ankle(frame: Frame, leg: SolvedLeg, rot: Array, reached: Array) -> SolvedFoot:
    """The legs with ankle rotations `rot`, model space; toes move with their ankles."""
    carried = leg.pose.ankle
    ankle, toe = frame.pose.ankle, frame.pose.toe
    from_animated = quat.multiply(rot, quat.conjugate(ankle.rot))
    ball = quat.rotate(from_animated, toe.pos - ankle.pos)
    toe = Transform(carried.pos + ball, quat.multiply(from_animated, toe.rot))
    pose = LegPose(leg.pose.hip, leg.pose.knee, Transform(carried.pos, rot), toe)
    return SolvedFoot(pose, quat.multiply(quat.conjugate(carried.rot), rot), reached)


def rise_angle(low: Hit, high: Hit, along: Array, up_ws: Array) -> Array:
    """Angle at which the ground rises from one hit to another along a level direction, rad."""
    across = high.point - low.point
    return high.found * vec.safe_arctan2(vec.dot(across, up_ws), vec.dot(across, along))


def level_foot(ahead: Array, up_ws: Array) -> Array:
    """Rotation of a foot with y along `up_ws` and z along `ahead`, unit and perpendicular."""
    raised = quat.shortest_arc(vec.constant(UP, ahead), up_ws, vec.constant(LEFT, ahead))
    return quat.multiply(
        rotation_about(up_ws, quat.rotate(raised, vec.constant(FORWARD, ahead)), ahead), raised
    )


def limit_angle(rot: Array, limit: Array, gate: AbstractGate) -> Array:
    """The rotation about the same axis, by an angle of at most `limit`, rad."""
    w, x, y, z = quat.components(jnp.where(rot[..., :1] < 0, -rot, rot))
    sin = vec.safe_sqrt(x * x + y * y + z * z)
    angle = 2.0 * vec.safe_arctan2(sin, w)
    # As a fraction, so that a softened limit does not change small angles; stays finite for 0.
    wide = angle > MIN_FRACTION * limit
    fraction = vec.safe_divide(limit, jnp.where(wide, angle, MIN_FRACTION * limit), otherwise=0.0)
    fraction = gate.clip(
        fraction, jnp.zeros_like(fraction), jnp.ones_like(fraction), band=FRACTION_BAND
    )
    turning = sin > jnp.finfo(sin.dtype).eps
    length = jnp.where(turning, angle / jnp.where(turning, sin, 1.0), 2.0)
    return quat.from_rotvec(vec.scale(vec.stack(x, y, z), length * fraction))


def ground_angles(sensed: Sensed, ahead: Array, right: Array, side: Array) -> tuple[Array, Array]:
    """Pitch and roll that align a level sole with the ground, rad, by how far it is turned."""
    up, ankle, toe = sensed.leg_up_ws, sensed.ground.ankle, sensed.ground.toe
    across = toe.point - ankle.point
    run = vec.dot(across, ahead)
    facing, rising = vec.dot(ankle.normal, up), -vec.dot(ankle.normal, ahead)
    both_hit = (toe.found * ankle.found > 0) & (run > MIN_SOLE)
    as_normal = vec.safe_divide(run * rising, facing)
    between = as_normal + toe.found * (vec.dot(across, up) - as_normal)
    rise, run = jnp.where(both_hit, between, rising), jnp.where(both_hit, run, facing)
    rise, run, facing, rising = vec.stacked_barrier(rise, run, facing, rising)
    pitch = vec.safe_arctan2(rise, run)
    # The part of the normal along the up axis of the pitched foot.
    upward = vec.safe_divide(run * facing + rise * rising, vec.safe_sqrt(run * run + rise * rise))
    roll = vec.safe_arctan2(side * vec.dot(ankle.normal, right), upward)
    return pitch * sensed.turned, roll * sensed.turned


def joint_angle(axis: Array, shin: Array) -> Array:
    """Angle by which `axis` of the foot rises from the plane perpendicular to the shin, rad."""
    along = vec.dot(axis, shin)
    along, across = vec.stacked_barrier(along, vec.length(axis - vec.scale(shin, along)))
    return vec.safe_arctan2(-along, across)


def limit_tilt(tilt: Array, joint: Array, low: Array, high: Array, gate: AbstractGate) -> Array:
    """`tilt` shortened so that `joint + tilt` stays within its limits, or where `joint` is."""
    low = jnp.where(joint < low, joint, low)
    high = jnp.where(joint > high, joint, high)
    return gate.clip(joint + tilt, low, high, band=ANGLE_BAND) - joint
