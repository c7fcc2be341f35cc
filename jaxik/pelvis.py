"""Stage 6: how far the body sinks or rises so that the legs can reach."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from . import ease, vec
from .frame import Sensed
from .gate import AbstractGate
from .lean import Lean
from .rule import constant, parameter, switch

HEIGHT_BAND = 0.01  # m
FAR = 1e6  # m, beyond any leg


class PelvisState(eqx.Module):
    """The body's offset."""

    height: Float[Array, ""]  # m
    offset_ws: Float[Array, "3"]  # m


class AbstractPelvis(eqx.Module):
    """Moves the body."""

    def init(self, dtype: Any) -> PelvisState:
        """Memory before the first frame."""
        return PelvisState(jnp.zeros((), dtype), jnp.zeros(3, dtype))

    @abstractmethod
    def advance(
        self,
        sensed: Sensed,
        target_ws: Array,
        lean: Lean,
        state: PelvisState,
        started: Array,
        gate: AbstractGate,
    ) -> PelvisState:
        """The offset after this frame."""


class LowestPelvis(AbstractPelvis):
    """Follows the standing foot that asks for the lowest body (the record's "height offset").

    Each foot asks for the height from its animated ankle to its target. A foot that does not stand
    counts, by its contact weight, as the highest of those that take part; with no foot standing the
    goal is 0.
    """

    limit: Array = parameter(0.30, unit="m", low=0.0, high=0.6)
    on_gain: Array = parameter(0.225, unit="1/tick", low=0.01, high=0.95, scale="gain")
    off_gain: Array = parameter(0.116, unit="1/tick", low=0.01, high=0.95, scale="gain")
    vertical_only: Array = switch(True)
    tick_hz: Array = constant(30.0)

    def advance(
        self,
        sensed: Sensed,
        target_ws: Array,
        lean: Lean,
        state: PelvisState,
        started: Bool[Array, ""],
        gate: AbstractGate,
    ) -> PelvisState:
        asked = vec.dot(target_ws - sensed.ankle_ws, sensed.up_ws)
        weight = sensed.contact.weight * sensed.foothold.found * sensed.weight
        taking_part = sensed.weight > 0
        top = gate.largest(jnp.where(taking_part, asked, -FAR), band=HEIGHT_BAND)
        asked = jnp.where(taking_part, ease.approach(top, asked, weight), top)
        lowest = gate.least(asked, band=HEIGHT_BAND)
        standing = gate.largest(weight, band=0.1)
        goal = standing * gate.clip(lowest, -self.limit, self.limit, band=HEIGHT_BAND)
        share = ease.approach(
            ease.share_of_gain(self.off_gain, sensed.dt, self.tick_hz),
            ease.share_of_gain(self.on_gain, sensed.dt, self.tick_hz),
            standing,
        )
        height = ease.approach(state.height, goal, jnp.where(started, share, 1.0))
        along = jnp.where(self.vertical_only, sensed.up_ws, lean.normal_ws)
        return PelvisState(height, vec.scale(along, height))
