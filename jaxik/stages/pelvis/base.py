"""What pelvis rules share: their memory, what they are given, and how high feet want the body."""

from abc import abstractmethod
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxik.maths import vec
from jaxik.maths.gate import HARD, AbstractGate
from jaxik.maths.parameter_tree import Rule
from jaxik.maths.struct import struct
from jaxik.stages.inputs import SensedMoment
from jaxik.stages.lean import Lean
from jaxik.world.frame import Sensed
from jaxik.world.skeleton import Rig, Transform

HEIGHT_BAND = 0.01  # m
FAR = 1e6  # m, beyond any leg
AWAY = 5.0  # m, by which the request of a leg that hardly counts is out of the way of others


@struct
class PelvisState:
    """The offset of the body from its animation."""

    height: Float[Array, ""]
    """Metres."""
    velocity: Float[Array, ""]
    """m/s; 0 unless it follows as a spring."""
    goal: Float[Array, ""]
    """m, where the height is going."""
    offset_ws: Float[Array, "3"]
    """Metres."""
    half_height: Float[Array, ""]
    """m, of the capsule; 0 where a rule has none."""
    ahead: Float[Array, ""]
    """m, along the character's heading; 0 where a rule does not shift the body."""

    @classmethod
    def level(cls, rig: Rig) -> "PelvisState":
        """No offset."""
        zero = jnp.zeros((), rig.side.dtype)
        return cls(zero, zero, zero, jnp.zeros(3, rig.side.dtype), zero, zero)

    @classmethod
    def at(cls, height: Array, goal: Array, up_ws: Array) -> "PelvisState":
        """An offset of `height`, m, along `up_ws`, at rest."""
        zero = jnp.zeros_like(height)
        return cls(height, zero, goal, vec.scale(up_ws, height), zero, zero)


@struct
class PelvisMoment(SensedMoment):
    """A moment, with what only the pelvis reads."""

    lean: Lean
    awake: Float[Array, ""]
    """0 while the body is to stay where it is, else 1."""


class AbstractPelvis(Rule):
    """Moves the body up and down, and perhaps forward and back."""

    per_leg: ClassVar[bool] = False

    def init(self, rig: Rig) -> PelvisState:
        """Memory before the first frame."""
        return PelvisState.level(rig)

    @abstractmethod
    def advance(self, now: PelvisMoment, target: Transform, state: PelvisState) -> PelvisState:
        """Memory after this frame, which holds the offset.

        Args:
            now: the sensed frame. With `now.awake` 0 the body is to stay where it is.
            target: where the ankles are to go (legs), world space.
            state: memory after the frame before.
        """


def mean_height(sensed: Sensed, requested: Array) -> Float[Array, ""]:
    """Mean of requested heights, m, weighted by the load of each leg; 0 if no leg counts."""
    mean = vec.safe_divide(vec.sum_last(sensed.load * requested), vec.sum_last(sensed.load))
    return mean * greatest_count(sensed)


def greatest_count(sensed: Sensed) -> Float[Array, ""]:
    """0..1, how far the leg counts that counts most."""
    return HARD.maximum(sensed.counted, band=0.0)


def lifted_out(sensed: Sensed, heights: Array, most: Array | float = 1.0) -> Float[Array, " legs"]:
    """Heights, m, so much higher that those of legs that count less than the `most` limit nothing.

    Without `most`, a leg that does not count in full limits less, even if none counts more.
    """
    away = heights + AWAY * (most - sensed.counted)
    return jnp.where(sensed.load > 0, away, FAR)


def lowest_of(gate: AbstractGate, sensed: Sensed, heights: Array) -> Float[Array, ""]:
    """The lowest of the heights of the legs that count most, m; `FAR` if none does."""
    return gate.minimum(lifted_out(sensed, heights, greatest_count(sensed)), band=HEIGHT_BAND)


def highest_of(gate: AbstractGate, sensed: Sensed, heights: Array) -> Float[Array, ""]:
    """The highest of the heights of the legs that count most, m; `-FAR` if none does."""
    return -lowest_of(gate, sensed, -heights)


def rise_to_length(
    sensed: Sensed, hip_ws: Array, ankle_ws: Array, length: Array
) -> Float[Array, " legs"]:
    """How far the body has to rise until each hip is `length` from its ankle, m.

    For an ankle further aside than that, the height at which it is nearest.
    """
    leg = ankle_ws - hip_ws
    height = vec.dot(leg, sensed.up_ws)
    aside2 = vec.dot(leg, leg) - height**2
    return height + vec.safe_sqrt(length**2 - aside2)


def requested_heights(sensed: Sensed, target_ws: Array) -> Float[Array, " legs"]:
    """Height from each animated ankle to its target along the leg's up, m."""
    return vec.dot(target_ws - sensed.ankle_ws, sensed.leg_up_ws)


def supported_heights(sensed: Sensed, target_ws: Array) -> Float[Array, " legs"]:
    """The same less what feet swing higher than animated: nobody rises with a lifted foot, m."""
    requested, lift = requested_heights(sensed, target_ws), sensed.ground.lift
    return requested if lift is None else requested - lift
