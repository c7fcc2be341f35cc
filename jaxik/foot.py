"""Stage 8: ankles that lay the soles on the ground."""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from . import quat, vec
from .frame import FORWARD, Frame, Sensed
from .gate import AbstractGate
from .leg import Bend, local
from .rule import parameter
from .skeleton import LegPose, Rig, Transform

ANGLE_BAND = 0.035  # rad, 2 degrees
SHORTEST_SOLE = 0.01  # m, horizontal distance under which two hits give no pitch
LEFT = (1.0, 0.0, 0.0)  # foot axes


class Planted(eqx.Module):
    """A leg with its foot turned."""

    pose: LegPose  # legs, model space
    ankle: Float[Array, "legs 4"]  # correction, on the right of the ankle's rotation


class AbstractFoot(eqx.Module):
    """Turns feet."""

    @abstractmethod
    def pose(
        self, rig: Rig, frame: Frame, sensed: Sensed, bend: Bend, gate: AbstractGate
    ) -> Planted:
        """The solved legs with their feet turned."""


class PitchRollFoot(AbstractFoot):
    """Pitches and rolls the animated foot onto the ground, its heading kept.

    The pitch comes from the two hits where there is a toe ray, else, like the roll, from the
    normal; both count by the foot's contact. Pitch, then roll, lays the sole on the normal exactly.
    Limits are joint angles against the shin: 0 is a foot at right angles to it, a positive pitch
    lifts the toes, a positive roll lifts the outer edge (so one pair of roll limits serves both
    sides, A16). They limit what the ground adds: an animation beyond its limits stays as it is.
    """

    max_pitch: Array = parameter(0.52, unit="rad", low=0.0, high=1.4)
    min_pitch: Array = parameter(-0.79, unit="rad", low=-1.4, high=0.0)
    max_roll: Array = parameter(0.26, unit="rad", low=0.0, high=1.0)
    min_roll: Array = parameter(-0.52, unit="rad", low=-1.0, high=0.0)

    def pose(
        self, rig: Rig, frame: Frame, sensed: Sensed, bend: Bend, gate: AbstractGate
    ) -> Planted:
        world = frame.world_from_model
        up = sensed.up_ws
        foot = world.turn(quat.multiply(frame.pose.ankle.rot, rig.ankle_from_foot))
        sole = quat.rotate(foot, vec.constant(FORWARD, up))
        outer = vec.scale(quat.rotate(foot, vec.constant(LEFT, up)), rig.side)
        ahead = vec.unit(vec.reject(sole, up), sensed.slope.forward_ws)
        right = vec.cross(ahead, up)

        pitch, roll = ground_angles(sensed, ahead, right, rig.side)
        shin = vec.unit(
            bend.pose.ankle.pos - bend.pose.knee.pos, vec.constant((0.0, -1.0, 0.0), up)
        )
        shin = quat.rotate(world.rot, shin)
        pitch = limited(pitch, joint_angle(sole, shin), self.min_pitch, self.max_pitch, gate)
        roll = limited(roll, joint_angle(outer, shin), self.min_roll, self.max_roll, gate)

        pitched = vec.scale(ahead, jnp.cos(pitch)) + vec.scale(up, jnp.sin(pitch))
        tilt = quat.multiply(
            quat.from_axis_angle(pitched, roll * rig.side), quat.from_axis_angle(right, pitch)
        )
        tilt_ms = local(world.rot, tilt)
        carried = bend.pose.ankle
        wanted = quat.multiply(tilt_ms, frame.pose.ankle.rot)
        ankle = Transform(carried.pos, quat.nlerp(carried.rot, wanted, sensed.weight))
        toe = ankle @ (frame.pose.ankle.inverse() @ frame.pose.toe)
        pose = LegPose(bend.pose.hip, bend.pose.knee, ankle, toe)
        return Planted(pose, quat.multiply(quat.conjugate(carried.rot), ankle.rot))


def ground_angles(sensed: Sensed, ahead: Array, right: Array, side: Array) -> tuple[Array, Array]:
    """Pitch and roll, rad, that lay a level sole on the ground, each times the foot's contact."""
    up, ankle, toe = sensed.up_ws, sensed.ground.ankle, sensed.ground.toe
    across = toe.point - ankle.point
    run = vec.dot(across, ahead)
    two = (toe.found * ankle.found > 0) & (run > SHORTEST_SOLE)
    slope = jnp.arctan2(vec.dot(across, up), jnp.where(two, run, 1.0))
    facing, rising = vec.dot(ankle.normal, up), -vec.dot(ankle.normal, ahead)
    pitch = jnp.where(two, slope, vec.safe_arctan2(rising, facing))
    pitched_up = vec.scale(up, jnp.cos(pitch)) - vec.scale(ahead, jnp.sin(pitch))
    outward = side * vec.dot(ankle.normal, right)
    roll = vec.safe_arctan2(outward, vec.dot(ankle.normal, pitched_up))
    standing = sensed.contact.weight * ankle.found
    return pitch * standing, roll * standing


def joint_angle(axis: Array, shin: Array) -> Array:
    """Angle, rad, by which `axis` of the foot rises from the plane at right angles to the shin."""
    along = vec.dot(axis, shin)
    return vec.safe_arctan2(-along, vec.length(axis - vec.scale(shin, along)))


def limited(tilt: Array, joint: Array, low: Array, high: Array, gate: AbstractGate) -> Array:
    """`tilt` shortened so that it takes the joint angle it adds to no further than a limit."""
    least = jnp.where(joint < low, joint, low)
    most = jnp.where(joint > high, joint, high)
    return gate.clip(joint + tilt, least, most, band=ANGLE_BAND) - joint
