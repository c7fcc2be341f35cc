"""The lock of the record: an offset that cancels the motion of a standing foot."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxik.maths import smoothing, vec
from jaxik.maths.parameter_tree import Leaf, half_life_parameter, parameter, switch
from jaxik.maths.struct import struct
from jaxik.stages.inputs import SensedMoment
from jaxik.world.skeleton import Rig

from .base import AbstractLock, Hold

DISTANCE_BAND = 0.01  # m
COSINE_BAND = 0.03  # about 2 degrees at a right angle
SPEED_BAND = 0.05  # m/s
FACTOR_BAND = 0.05


@struct
class LockState:
    """Which feet are locked, and how far that holds them from their footholds."""

    locked: Float[Array, " legs"]
    """0 or 1."""
    factor: Float[Array, " legs"]
    """0..1, rises while locked, decays after release."""
    offset: Float[Array, "legs 3"]
    """m, world axes."""
    foothold: Float[Array, "legs 3"]
    """m, of the frame before, world space."""
    ball: Float[Array, "legs 3"]
    """m, likewise."""
    ahead: Float[Array, "legs 3"]
    """Unit, foot direction when it locked, turned with its ground since then; world axes."""


class OffsetLock(AbstractLock):
    """Cancels the motion of the foothold while its foot is locked (the record).

    The target is the foothold plus an offset. While the foot is locked, the foothold's motion since
    the frame before, over ground that may itself move, is subtracted from the offset: the foot
    stays but its lift still follows the animation. After release the offset decays, so that neither
    locks nor releases jump. With `hold_ball` on, the motion of the ball along the ground is
    cancelled instead, so that the ball stays while the heel rises.

    A foot locks when its contact is planted and it moves slower than `max_speed`. It is released
    when its contact is lifted, or earlier for any of these reasons:

    - Staying would bend or open the knee too far (`release_min_angle`, `release_max_angle`).
    - The leg would leave its animated direction by more than `release_cone`.
    - The offset would exceed `release_distance`.
    - The animated foot points away by more than `release_heading`.
    - The foothold moves faster than `release_speed`.

    A released foot can lock again once `factor` has decayed to `relock_threshold`.
    """

    enabled: Leaf = switch(True, doc="Whether planted feet are locked in place.")
    hold_ball: Leaf = switch(
        False, doc="Whether a lock holds the ball only, so that the heel can rise.", per_leg=False
    )
    release_min_angle: Leaf = parameter(
        0.8726646260,
        unit="rad",
        low=0.0,
        high=1.8,
        kind="threshold",
        doc="A lock lets go if it would bend the knee below this interior angle.",
    )
    release_max_angle: Leaf = parameter(
        3.0019663134,
        unit="rad",
        low=2.0,
        high=3.1415926536,
        kind="threshold",
        doc="A lock lets go if it would open the knee beyond this interior angle.",
    )
    release_cone: Leaf = parameter(
        0.4363323130,
        unit="rad",
        low=0.0,
        high=1.5,
        kind="threshold",
        doc="A lock lets go if the leg would leave its animated direction by this angle.",
    )
    release_distance: Leaf = parameter(
        0.20,
        unit="m",
        low=0.0,
        high=0.5,
        kind="threshold",
        doc="A lock lets go if the foot would be this far from its foothold.",
    )
    release_heading: Leaf = parameter(
        3.1415926536,
        unit="rad",
        low=0.1,
        high=3.1415926536,
        kind="threshold",
        doc="A lock lets go if the animated foot points away by this angle.",
    )
    release_speed: Leaf = parameter(
        float("inf"),
        unit="m/s",
        low=0.0,
        high=3.0,
        kind="threshold",
        doc="A lock lets go if the foot would otherwise move faster than this.",
    )
    relock_threshold: Leaf = parameter(
        0.20,
        unit="1",
        low=0.0,
        high=1.0,
        kind="threshold",
        doc="A released foot can lock again once its lock has faded to this weight.",
    )
    max_speed: Leaf = parameter(
        float("inf"),
        unit="m/s",
        low=0.0,
        high=3.0,
        kind="threshold",
        doc="A foot locks only while it is slower than this.",
    )
    lock_half_life: Leaf = half_life_parameter(
        0.05, doc="Time in which a new lock reaches half its hold."
    )
    unlock_half_life: Leaf = half_life_parameter(
        0.10, doc="Time in which a released foot covers half its way back to the foothold."
    )

    def init(self, rig: Rig) -> LockState:
        zero, zeros = jnp.zeros_like(rig.side), jnp.zeros_like(rig.knee_axis_ls)
        return LockState(zero, zero, zeros, zeros, zeros, zeros)

    def advance(
        self, now: SensedMoment, foothold_ws: Array, hip_ws: Array, state: LockState
    ) -> tuple[LockState, Hold]:
        sensed, gate = now.sensed, now.gate
        up, carry = sensed.leg_up_ws, sensed.carry
        moved = foothold_ws - carry.apply(state.foothold)
        ball_moved = vec.reject(sensed.ball_ws - carry.apply(state.ball), up)
        ball_moved += vec.scale(up, vec.dot(moved, up))
        moved = jnp.where(now.started, jnp.where(self.hold_ball, ball_moved, moved), 0.0)
        before, locked_ahead = carry.turn(state.offset), carry.turn(state.ahead)
        locked_ahead = gate.choose(state.locked[..., None], locked_ahead, sensed.ahead_ws)
        stays = self._may_stay(now, foothold_ws, hip_ws, before - moved)
        stays = stays * self._follows_animation(now, moved, locked_ahead)
        starts = stays * self._may_start(now, moved, state.factor)

        ones, zeros = jnp.ones_like(state.locked), jnp.zeros_like(state.locked)
        locked = gate.choose(starts, ones, state.locked)
        locked = gate.choose(stays, locked, zeros)

        lock_fraction = smoothing.fraction_of_half_life(self.lock_half_life, now.dt)
        unlock_fraction = smoothing.fraction_of_half_life(self.unlock_half_life, now.dt)
        risen = smoothing.lerp(state.factor, ones, lock_fraction)
        factor = gate.choose(locked, risen, smoothing.lerp(state.factor, zeros, unlock_fraction))
        kept = before - vec.scale(moved, risen)
        decayed = vec.scale(before, 1.0 - unlock_fraction)
        offset_ws = gate.choose(locked[..., None], kept, decayed)
        after = LockState(locked, factor, offset_ws, foothold_ws, sensed.ball_ws, locked_ahead)
        return after, Hold(offset_ws, sensed.rot_ws, locked)

    def _may_start(self, now: SensedMoment, moved: Array, factor: Array) -> Array:
        """1 where a foot that is free may lock."""
        sensed, gate = now.sensed, now.gate
        speed = vec.safe_divide(vec.length(moved), now.dt)
        calm = gate.below(speed, self.max_speed, band=SPEED_BAND)
        recovered = gate.below(factor, self.relock_threshold, band=FACTOR_BAND)
        return sensed.contact.planted * calm * recovered * sensed.foothold.found

    def _may_stay(
        self, now: SensedMoment, foothold_ws: Array, hip_ws: Array, offset_ws: Array
    ) -> Array:
        """1 where a foot may keep its place as far as contact, knee and offset are concerned."""
        sensed, gate = now.sensed, now.gate
        ankle_ws = foothold_ws + offset_ws + vec.scale(sensed.leg_up_ws, sensed.foothold.lift)
        leg = ankle_ws - hip_ws
        squares = sensed.thigh**2 + sensed.shin**2
        cosine = vec.safe_divide(squares - vec.dot(leg, leg), 2.0 * sensed.thigh * sensed.shin)
        cosine = gate.clip(cosine, -jnp.ones_like(cosine), jnp.ones_like(cosine), band=COSINE_BAND)
        not_folded = gate.below(cosine, jnp.cos(self.release_min_angle), band=COSINE_BAND)
        not_straight = gate.above(cosine, jnp.cos(self.release_max_angle), band=COSINE_BAND)

        animated = sensed.ankle_ws - sensed.hip_ws
        lengths = vec.length(leg) * vec.length(animated)
        alignment = vec.safe_divide(vec.dot(leg, animated), lengths, otherwise=1.0)
        aligned = gate.above(alignment, jnp.cos(self.release_cone), band=COSINE_BAND)

        near = gate.below(vec.length(offset_ws), self.release_distance, band=DISTANCE_BAND)
        enabled = jnp.where(self.enabled & (sensed.weight > 0), 1.0, 0.0)
        return not_folded * not_straight * aligned * near * enabled * (1.0 - sensed.contact.lifted)

    def _follows_animation(self, now: SensedMoment, moved: Array, locked_ahead: Array) -> Array:
        """1 where the animated foot has not turned away and does not move too fast."""
        sensed, gate = now.sensed, now.gate
        alignment = vec.dot(locked_ahead, sensed.ahead_ws)
        aligned = gate.above(alignment, jnp.cos(self.release_heading), band=COSINE_BAND)
        # No foot points away by more than half a turn.
        aligned = jnp.where(self.release_heading < jnp.pi, aligned, 1.0)
        speed = vec.safe_divide(vec.length(moved), now.dt)
        return aligned * gate.below(speed, self.release_speed, band=SPEED_BAND)
