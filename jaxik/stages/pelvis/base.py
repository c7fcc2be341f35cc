"""What pelvis rules share: their memory, what they are given, and how high feet want the body."""

import itertools
from abc import abstractmethod
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxik.maths import vec
from jaxik.maths.gate import HARD, AbstractGate
from jaxik.maths.parameter_tree import Rule
from jaxik.maths.struct import place, struct
from jaxik.stages.inputs import SensedMoment
from jaxik.stages.lean import Lean
from jaxik.world.frame import Sensed
from jaxik.world.skeleton import Rig, Transform

HEIGHT_BAND = 0.01  # m
FAR = 1e6  # m, beyond any leg


@struct
class Approach:
    """What tells, a frame later, how fast swings end and the root rises."""

    fraction: Float[Array, " legs"]
    """0..1, time of each swing that has passed."""
    speed: Float[Array, ""]
    """m/s, at which root and offset rose over the ground together."""
    root_height: Float[Array, ""] = place("height")
    """Metres."""


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
    approach: Approach | None = None
    """None where a rule does not look at where feet land."""

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
    return mean * greatest_load(sensed)


def greatest_load(sensed: Sensed) -> Float[Array, ""]:
    """0..1, the load of the leg that has most."""
    return HARD.maximum(sensed.load, band=0.0)


def limits_of(sensed: Sensed, heights: Array, free: Array) -> Float[Array, " legs"]:
    """Heights, m, as limits: the less load a leg has, the less is its limit below `free`, m."""
    below = jnp.where(heights < free, free - heights, 0.0)
    return jnp.where(sensed.load > 0, heights + (1.0 - sensed.load) * below, FAR)


def lowest_of(gate: AbstractGate, sensed: Sensed, heights: Array) -> Float[Array, ""]:
    """The lowest of the heights of legs, m; 0 if none has any load.

    It is the mean over all choices of some of the legs, each of which has its load as probability:
    so a change of a load by x moves it by at most x times what that leg moves it at all.
    """
    heights = jnp.where(sensed.load > 0, heights, 0.0)
    loads, each = vec.unstack(sensed.load), vec.unstack(heights)

    def is_lower(leg: int, other: int) -> Array:
        """1 if so, else 0; of two that are equal, the first is lower."""
        if leg > other:
            return 1.0 - is_lower(other, leg)
        return gate.below(each[leg], each[other], band=HEIGHT_BAND)

    shares = list(loads)
    for leg, other in itertools.permutations(range(len(loads)), 2):
        shares[leg] *= 1.0 - loads[other] * is_lower(other, leg)
    share = vec.stack(*shares)
    return vec.safe_divide(vec.sum_last(share * heights), vec.sum_last(share))


def highest_of(gate: AbstractGate, sensed: Sensed, heights: Array) -> Float[Array, ""]:
    """The highest of the heights of legs, m, likewise."""
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
