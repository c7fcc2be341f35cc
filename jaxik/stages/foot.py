"""Stage 10: ankles that lay the soles on the ground."""

from abc import abstractmethod

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxik.maths import quat, vec
from jaxik.maths.gate import AbstractGate
from jaxik.maths.parameter_tree import Leaf, Rule, parameter, switch
from jaxik.maths.struct import struct
from jaxik.solvers.aim import aim_rotation
from jaxik.solvers.pole import PoleTarget
from jaxik.solvers.rotations import rotation_about
from jaxik.world.frame import FORWARD, UP, Frame, GroundHits, Sensed, animated_ankles
from jaxik.world.skeleton import LegPose, Transform
from jaxik.world.terrain import Hit

from .effector import Effector
from .inputs import Inputs
from .leg import SolvedLeg
from .probe import foot_heading

ANGLE_BAND = 0.035  # rad, 2 degrees
SHARE_BAND = 0.05  # of a turn's angle
LEAST_SHARE = 0.01  # a turn below this share of its limit counts as that
SAME_ANGLE = 1e-6  # rad, within which a limit did nothing
SHORTEST_SOLE = 0.01  # m, horizontal distance under which two hits give no pitch
LEFT = (1.0, 0.0, 0.0)  # foot axes


@struct
class SolvedFoot:
    """A leg with its foot turned."""

    pose: LegPose  # legs, model space
    ankle: Float[Array, "legs 4"]  # correction, on the right of the ankle's rotation
    reached: Float[Array, " legs"]  # 1 where the foot is turned as the ground asks, else 0


class AbstractFoot(Rule):
    """Turns feet."""

    @abstractmethod
    def sense(self, inputs: Inputs, ground: GroundHits) -> Float[Array, "legs 4"]:
        """The ankles' rotation in the world that memory may keep, before the legs are solved."""

    @abstractmethod
    def pose(
        self, inputs: Inputs, sensed: Sensed, effector: Effector, bend: SolvedLeg
    ) -> SolvedFoot:
        """The solved legs with their feet turned."""


class AbstractAnimatedFoot(AbstractFoot):
    """Turns feet from where the animation has them."""

    def sense(self, inputs: Inputs, ground: GroundHits) -> Float[Array, "legs 4"]:
        return animated_ankles(inputs.frame).rot


class PitchRollFoot(AbstractAnimatedFoot):
    """Pitches and rolls the animated foot onto the ground, its heading kept.

    The pitch comes from the two hits where there is a toe ray, else, like the roll, from the
    normal; both count by the foot's contact. Pitch, then roll, lays the sole on the normal exactly.
    Limits are joint angles against the shin: 0 is a foot at right angles to it, a positive pitch
    lifts the toes, a positive roll lifts the outer edge (so one pair of roll limits serves both
    sides, A16). They limit what the ground adds: an animation beyond its limits stays as it is.
    """

    max_pitch: Leaf = parameter(
        0.52,
        unit="rad",
        low=0.0,
        high=1.4,
        doc="Largest pitch against the shin, toes up, to which the ground turns a foot.",
    )
    min_pitch: Leaf = parameter(
        -0.79,
        unit="rad",
        low=-1.4,
        high=0.0,
        doc="Largest pitch against the shin, toes down, as a negative angle.",
    )
    max_roll: Leaf = parameter(
        0.26,
        unit="rad",
        low=0.0,
        high=1.0,
        doc="Largest roll against the shin, outer edge up, to which the ground turns a foot.",
    )
    min_roll: Leaf = parameter(
        -0.52,
        unit="rad",
        low=-1.0,
        high=0.0,
        doc="Largest roll against the shin, outer edge down, as a negative angle.",
    )

    def pose(
        self, inputs: Inputs, sensed: Sensed, effector: Effector, bend: SolvedLeg
    ) -> SolvedFoot:
        rig, frame, gate = inputs.rig, inputs.frame, inputs.gate
        up = sensed.leg_up_ws
        left, _, sole = quat.axes(quat.multiply(effector.rot_ws, rig.ankle_from_foot))
        outer = vec.scale(left, rig.side)
        ahead = vec.normalize(vec.reject(sole, up), sensed.slope.forward_ws)
        right = vec.cross(ahead, up)

        pitch, roll = vec.stacked_barrier(*ground_angles(sensed, ahead, right, rig.side))
        shin = vec.normalize(
            bend.pose.ankle.pos - bend.pose.knee.pos, vec.constant((0.0, -1.0, 0.0), up)
        )
        shin = quat.rotate(frame.world_from_model.rot, shin)
        free_pitch, free_roll = pitch, roll
        pitch = limited(pitch, joint_angle(sole, shin), self.min_pitch, self.max_pitch, gate)
        roll = limited(roll, joint_angle(outer, shin), self.min_roll, self.max_roll, gate)

        pitch, roll = vec.stacked_barrier(pitch, roll)
        # Rolled about the level axis and then pitched: as pitched, then rolled about the pitched.
        tilt = quat.multiply(
            quat.from_axis_angle(right, pitch), quat.from_axis_angle(ahead, roll * rig.side)
        )
        cut = jnp.abs(pitch - free_pitch) + jnp.abs(roll - free_roll)
        kept = gate.below(cut, jnp.full_like(cut, SAME_ANGLE), band=ANGLE_BAND)
        return turned(frame, effector, bend, quat.multiply(tilt, effector.rot_ws), kept)


class AimFoot(AbstractAnimatedFoot):
    """ozz's aim job: the ankle's up looks at a point one metre off the ground, along its normal.

    From the pose after the leg's turn: the axis out of the sole, from `offset` (m, foot axes), aims
    at the ankle's target plus the normal; the foot's forward axis is pulled to where it was, then
    turned by `twist`. A leg without ground, or with `enabled` off, keeps its foot as carried.
    """

    enabled: Leaf = switch(True, doc="Whether feet are turned to the ground.")
    offset: Leaf = parameter(
        (0.0, 0.0, 0.0),
        unit="m",
        low=-0.2,
        high=0.2,
        doc="Where the axis out of the sole starts, from the ankle, in foot axes.",
    )
    twist: Leaf = parameter(
        0.0, unit="rad", low=-1.0, high=1.0, doc="Turn of the foot about its aim."
    )
    weight: Leaf = parameter(
        1.0, unit="1", low=0.0, high=1.0, doc="How far feet are turned to the ground, 0 to 1."
    )

    def pose(
        self, inputs: Inputs, sensed: Sensed, effector: Effector, bend: SolvedLeg
    ) -> SolvedFoot:
        rig, frame = inputs.rig, inputs.frame
        carried = bend.pose.ankle
        into_model = frame.world_from_model.inverse()
        foot = quat.multiply(carried.rot, rig.ankle_from_foot)
        aim = into_model.apply(effector.target_ws + sensed.ground.ankle.normal) - carried.pos
        upward, ahead = (quat.rotate(foot, vec.constant(axis, aim)) for axis in (UP, FORWARD))
        start = quat.rotate(foot, self.offset)
        turn, reached = aim_rotation(
            PoleTarget(aim, ahead, self.twist), upward, start, ahead, inputs.gate
        )
        weight = jnp.where(self.enabled, effector.weight * sensed.foothold.found, 0.0)
        turn = quat.nlerp(quat.identity(turn.dtype), turn, weight * self.weight)
        full = jnp.where(weight * self.weight >= 1, 1.0, 0.0)
        return with_ankle(frame, bend, quat.multiply(turn, carried.rot), reached * full)


class FlatFoot(AbstractFoot):
    """Lays the foot flat on three hits, its heading the animation's (Mec).

    The pitch is that from foot to toe, the roll that from foot to corner; where a ray missed it is
    zero. Both tilt a foot that stands upright along its up, by `max_tilt` at most.
    """

    max_tilt: Leaf = parameter(
        0.7853981634, unit="rad", low=0.0, high=1.5, doc="Largest angle by which a foot is tilted."
    )

    def sense(self, inputs: Inputs, ground: GroundHits) -> Float[Array, "legs 4"]:
        up_ws = inputs.terrain.leg_up_ws
        ahead, right = foot_heading(inputs, up_ws)
        pitch = rise_angle(ground.ankle, ground.toe, ahead, up_ws)
        roll = rise_angle(ground.ankle, ground.corner, right, up_ws)
        tilt = quat.multiply(quat.from_axis_angle(right, pitch), quat.from_axis_angle(ahead, -roll))
        level = quat.multiply(upright(ahead, up_ws), quat.conjugate(inputs.rig.ankle_from_foot))
        flat = quat.multiply(at_most(tilt, self.max_tilt, inputs.gate), level)
        return quat.nlerp(animated_ankles(inputs.frame).rot, flat, ground.ankle.found)

    def pose(
        self, inputs: Inputs, sensed: Sensed, effector: Effector, bend: SolvedLeg
    ) -> SolvedFoot:
        return turned(inputs.frame, effector, bend, effector.rot_ws, sensed.ground.ankle.found)


class KeepFoot(AbstractAnimatedFoot):
    """Feet keep their animated rotation in the world (Unreal, seed 001)."""

    def pose(
        self, inputs: Inputs, sensed: Sensed, effector: Effector, bend: SolvedLeg
    ) -> SolvedFoot:
        return turned(inputs.frame, effector, bend, effector.rot_ws, jnp.ones_like(effector.weight))


def turned(
    frame: Frame, effector: Effector, bend: SolvedLeg, rot_ws: Array, reached: Array
) -> SolvedFoot:
    """The legs with their ankles turned to `rot_ws` in the world, each by its share of foot IK."""
    wanted = quat.multiply(quat.conjugate(frame.world_from_model.rot), rot_ws)
    rot = quat.nlerp(bend.pose.ankle.rot, wanted, effector.weight)
    full = jnp.where(effector.weight >= 1, 1.0, 0.0)
    return with_ankle(frame, bend, rot, reached * full)


def with_ankle(frame: Frame, bend: SolvedLeg, rot: Array, reached: Array) -> SolvedFoot:
    """The legs with this rotation of their ankles, model space; the toe goes with it."""
    carried = bend.pose.ankle
    ankle, toe = frame.pose.ankle, frame.pose.toe
    turn = quat.multiply(rot, quat.conjugate(ankle.rot))
    ball = quat.rotate(turn, toe.pos - ankle.pos)
    toe = Transform(carried.pos + ball, quat.multiply(turn, toe.rot))
    pose = LegPose(bend.pose.hip, bend.pose.knee, Transform(carried.pos, rot), toe)
    return SolvedFoot(pose, quat.multiply(quat.conjugate(carried.rot), rot), reached)


def rise_angle(low: Hit, high: Hit, along: Array, up_ws: Array) -> Array:
    """Angle, rad, by which the ground rises from one hit to another along a level direction."""
    across = high.point - low.point
    return high.found * vec.safe_arctan2(vec.dot(across, up_ws), vec.dot(across, along))


def upright(ahead: Array, up_ws: Array) -> Array:
    """Rotation of a foot with its y along up and its z along `ahead`, unit and at right angles."""
    raised = quat.shortest_arc(vec.constant(UP, ahead), up_ws, vec.constant(LEFT, ahead))
    return quat.multiply(
        rotation_about(up_ws, quat.rotate(raised, vec.constant(FORWARD, ahead)), ahead), raised
    )


def at_most(rot: Array, limit: Array, gate: AbstractGate) -> Array:
    """The rotation with its angle limited, rad; its axis stays."""
    w, x, y, z = quat.components(jnp.where(rot[..., :1] < 0, -rot, rot))
    sin = vec.safe_sqrt(x * x + y * y + z * z)
    angle = 2.0 * vec.safe_arctan2(sin, w)
    # As a share, so that a softened limit leaves small turns alone; a far limit stays a number.
    wide = angle > LEAST_SHARE * limit
    share = vec.safe_divide(limit, jnp.where(wide, angle, LEAST_SHARE * limit), otherwise=0.0)
    share = gate.clip(share, jnp.zeros_like(share), jnp.ones_like(share), band=SHARE_BAND)
    turning = sin > jnp.finfo(sin.dtype).eps
    length = jnp.where(turning, angle / jnp.where(turning, sin, 1.0), 2.0)
    return quat.from_rotvec(vec.scale(vec.stack(x, y, z), length * share))


def ground_angles(sensed: Sensed, ahead: Array, right: Array, side: Array) -> tuple[Array, Array]:
    """Pitch and roll, rad, that lay a level sole on the ground, each times the foot's contact."""
    up, ankle, toe = sensed.leg_up_ws, sensed.ground.ankle, sensed.ground.toe
    across = toe.point - ankle.point
    run = vec.dot(across, ahead)
    facing, rising = vec.dot(ankle.normal, up), -vec.dot(ankle.normal, ahead)
    two = (toe.found * ankle.found > 0) & (run > SHORTEST_SOLE)
    rise, run = jnp.where(two, vec.dot(across, up), rising), jnp.where(two, run, facing)
    rise, run, facing, rising = vec.stacked_barrier(rise, run, facing, rising)
    pitch = vec.safe_arctan2(rise, run)
    # Of the normal, the part along the up of a foot so pitched.
    upward = vec.safe_divide(run * facing + rise * rising, vec.safe_sqrt(run * run + rise * rise))
    roll = vec.safe_arctan2(side * vec.dot(ankle.normal, right), upward)
    standing = sensed.contact.weight * ankle.found
    return pitch * standing, roll * standing


def joint_angle(axis: Array, shin: Array) -> Array:
    """Angle, rad, by which `axis` of the foot rises from the plane at right angles to the shin."""
    along = vec.dot(axis, shin)
    along, across = vec.stacked_barrier(along, vec.length(axis - vec.scale(shin, along)))
    return vec.safe_arctan2(-along, across)


def limited(tilt: Array, joint: Array, low: Array, high: Array, gate: AbstractGate) -> Array:
    """`tilt` shortened so that it takes the joint angle it adds to no further than a limit."""
    least = jnp.where(joint < low, joint, low)
    most = jnp.where(joint > high, joint, high)
    return gate.clip(joint + tilt, least, most, band=ANGLE_BAND) - joint
