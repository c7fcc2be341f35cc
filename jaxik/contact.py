"""Stage 3: how far each foot of the animation stands."""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from . import vec
from .frame import Contact, Frame
from .gate import AbstractGate
from .rule import parameter

HEIGHT_BAND = 0.01  # m over which a softened height decision turns
SPEED_BAND = 0.05  # m/s, likewise


class AbstractContact(eqx.Module):
    """Reads contact from the animation."""

    @abstractmethod
    def sense(self, frame: Frame, gate: AbstractGate) -> Contact:
        """Lift and contact of each foot in this frame."""


class HeightContact(AbstractContact):
    """By the ankle's height: 1 below `planted_height`, 0 above `raised_height`, linear between."""

    ground_height: Array = parameter(0.0, unit="m", low=-0.5, high=0.5)
    planted_height: Array = parameter(0.10, unit="m", low=0.0, high=0.4, kind="threshold")
    raised_height: Array = parameter(
        0.16, unit="m", low=0.0, high=0.6, kind="threshold", above="planted_height"
    )

    def sense(self, frame: Frame, gate: AbstractGate) -> Contact:
        lift = frame.pose.ankle.pos[..., 1] - self.ground_height
        planted = gate.below(lift, self.planted_height, band=HEIGHT_BAND)
        lifted = gate.above(lift, self.raised_height, band=HEIGHT_BAND)
        span = self.raised_height - self.planted_height
        share = vec.safe_divide(self.raised_height - lift, span)
        zero, one = jnp.zeros_like(lift), jnp.ones_like(lift)
        ramp = gate.clip(share, zero, one, band=0.1)
        return Contact(lift, jnp.where(span > 0, ramp, planted), planted, lifted)


class StandingContact(AbstractContact):
    """Every foot always stands: where there is ground, foot IK works (ozz and Mec)."""

    def sense(self, frame: Frame, gate: AbstractGate) -> Contact:
        lift = frame.pose.ankle.pos[..., 1]
        one, zero = jnp.ones_like(lift), jnp.zeros_like(lift)
        return Contact(lift, one, one, zero)


class IdleContact(AbstractContact):
    """All feet stand while the character does, none while it moves (Unreal, seed 001)."""

    idle_speed: Array = parameter(0.0, unit="m/s", low=0.0, high=3.0, kind="threshold")

    def sense(self, frame: Frame, gate: AbstractGate) -> Contact:
        lift = frame.pose.ankle.pos[..., 1]
        idle = gate.below(frame.speed, self.idle_speed, band=SPEED_BAND)
        idle = jnp.broadcast_to(idle, lift.shape)
        return Contact(lift, idle, idle, 1.0 - idle)
