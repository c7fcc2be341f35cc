"""Stage 5: feet that keep their place in the world while they stand."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from . import ease, quat, vec
from .frame import Sensed
from .gate import AbstractGate
from .rule import parameter, switch
from .skeleton import Rig

DISTANCE_BAND = 0.01  # m
COSINE_BAND = 0.03  # about 2 degrees at a right angle
SPEED_BAND = 0.05  # m/s
FACTOR_BAND = 0.05


class AbstractLock(eqx.Module):
    """Keeps feet in place."""

    @abstractmethod
    def init(self, rig: Rig, dtype: Any) -> Any:
        """Memory before the first frame."""

    @abstractmethod
    def advance(
        self,
        sensed: Sensed,
        foothold_ws: Array,
        hip_ws: Array,
        state: Any,
        started: Array,
        gate: AbstractGate,
    ) -> tuple[Any, Array]:
        """Memory after this frame, and the offset that each foot keeps from its foothold, m."""


class LockState(eqx.Module):
    """Which feet are locked, and how far from the animation that holds them."""

    locked: Float[Array, " legs"]  # 0 or 1
    factor: Float[Array, " legs"]  # 0..1, rises while locked, decays after release
    offset: Float[Array, "legs 3"]  # m, along the platform's axes
    foothold: Float[Array, "legs 3"]  # m, of the frame before, in the platform's space


class OffsetLock(AbstractLock):
    """Takes the foothold's own displacement out of the target while the foot is locked.

    The target is the foothold plus an offset. Locked, the offset loses the foothold's displacement
    since the frame before (as seen from a moving platform), so the foot stays while its lift still
    follows the animation; released, the offset decays. Neither edge pops. A foot locks when the
    contact says planted and it is slower than `max_speed`; it is released when the contact says
    lifted, or early: when staying would bend or straighten the knee too far, when hip to place
    leaves hip to animated ankle by more than `release_cone`, or when the offset grows beyond
    `release_distance`. A released foot locks again once its factor is at most `relock_threshold`.
    """

    enabled: Array = switch(True)
    release_min_angle: Array = parameter(
        0.8726646260, unit="rad", low=0.0, high=1.8, kind="threshold"
    )
    release_max_angle: Array = parameter(
        3.0019663134, unit="rad", low=2.0, high=3.1415926536, kind="threshold"
    )
    release_cone: Array = parameter(0.4363323130, unit="rad", low=0.0, high=1.5, kind="threshold")
    release_distance: Array = parameter(0.20, unit="m", low=0.0, high=0.5, kind="threshold")
    relock_threshold: Array = parameter(0.20, unit="1", low=0.0, high=1.0, kind="threshold")
    max_speed: Array = parameter(float("inf"), unit="m/s", low=0.0, high=3.0, kind="threshold")
    lock_half_life: Array = parameter(0.05, unit="s", low=0.002, high=0.5, scale="log")
    unlock_half_life: Array = parameter(0.10, unit="s", low=0.002, high=0.5, scale="log")

    def init(self, rig: Rig, dtype: Any) -> LockState:
        each = jnp.zeros(rig.side.shape, dtype)
        spread = jnp.zeros((*rig.side.shape, 3), dtype)
        return LockState(each, each, spread, spread)

    def advance(
        self,
        sensed: Sensed,
        foothold_ws: Array,
        hip_ws: Array,
        state: LockState,
        started: Bool[Array, ""],
        gate: AbstractGate,
    ) -> tuple[LockState, Array]:
        moved = foothold_ws - sensed.platform.apply(state.foothold)
        moved = jnp.where(started, moved, 0.0)
        before = quat.rotate(sensed.platform.rot, state.offset)
        stays = self._may_stay(sensed, foothold_ws, hip_ws, before - moved, gate)
        starts = stays * self._may_start(sensed, moved, state.factor, gate)

        one, zero = jnp.ones_like(state.locked), jnp.zeros_like(state.locked)
        locked = gate.choose(starts, one, state.locked)
        locked = gate.choose(stays, locked, zero)

        on = ease.share_of_half_life(self.lock_half_life, sensed.dt)
        off = ease.share_of_half_life(self.unlock_half_life, sensed.dt)
        risen = ease.approach(state.factor, one, on)
        factor = gate.choose(locked, risen, ease.approach(state.factor, zero, off))
        held = before - vec.scale(moved, risen)
        decayed = vec.scale(before, 1.0 - off)
        offset_ws = gate.choose(locked[..., None], held, decayed)
        into_platform = sensed.platform.inverse()
        offset = quat.rotate(into_platform.rot, offset_ws)
        after = LockState(locked, factor, offset, into_platform.apply(foothold_ws))
        return after, offset_ws

    def _may_start(self, sensed: Sensed, moved: Array, factor: Array, gate: AbstractGate) -> Array:
        speed = vec.safe_divide(vec.length(moved), sensed.dt)
        calm = gate.below(speed, self.max_speed, band=SPEED_BAND)
        recovered = gate.below(factor, self.relock_threshold, band=FACTOR_BAND)
        return sensed.contact.planted * calm * recovered * sensed.foothold.found

    def _may_stay(
        self,
        sensed: Sensed,
        foothold_ws: Array,
        hip_ws: Array,
        offset_ws: Array,
        gate: AbstractGate,
    ) -> Array:
        """1 where nothing releases a foot that would keep its place."""
        place = foothold_ws + offset_ws + vec.scale(sensed.up_ws, sensed.contact.lift)
        leg = place - hip_ws
        squares = sensed.thigh**2 + sensed.shin**2
        cosine = vec.safe_divide(squares - vec.dot(leg, leg), 2.0 * sensed.thigh * sensed.shin)
        cosine = gate.clip(cosine, -jnp.ones_like(cosine), jnp.ones_like(cosine), band=COSINE_BAND)
        bent = gate.below(cosine, jnp.cos(self.release_min_angle), band=COSINE_BAND)
        short = gate.above(cosine, jnp.cos(self.release_max_angle), band=COSINE_BAND)

        animated = sensed.ankle_ws - sensed.hip_ws
        spans = vec.length(leg) * vec.length(animated)
        alignment = vec.safe_divide(vec.dot(leg, animated), spans, otherwise=1.0)
        ahead = gate.above(alignment, jnp.cos(self.release_cone), band=COSINE_BAND)

        near = gate.below(vec.length(offset_ws), self.release_distance, band=DISTANCE_BAND)
        works = jnp.where(self.enabled & (sensed.weight > 0), 1.0, 0.0)
        return bent * short * ahead * near * works * (1.0 - sensed.contact.lifted)
