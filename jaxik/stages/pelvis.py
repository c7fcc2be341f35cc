"""Stage 7: how far the body sinks or rises so that its legs can reach the ground."""

import dataclasses
from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxik.maths import smoothing, vec
from jaxik.maths.parameter_tree import (
    Leaf,
    Rule,
    constant,
    gain_parameter,
    half_life_parameter,
    parameter,
    switch,
)
from jaxik.maths.struct import struct
from jaxik.world.frame import Sensed
from jaxik.world.skeleton import Rig, Transform

from .inputs import SensedMoment
from .lean import Lean

HEIGHT_BAND = 0.01  # m
FAR = 1e6  # m, beyond any leg


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

    @classmethod
    def level(cls, rig: Rig) -> "PelvisState":
        """No offset."""
        zero = jnp.zeros((), rig.side.dtype)
        return cls(zero, zero, zero, jnp.zeros(3, rig.side.dtype), zero)

    @classmethod
    def at(cls, height: Array, goal: Array, up_ws: Array) -> "PelvisState":
        """An offset of `height`, m, along `up_ws`, at rest."""
        zero = jnp.zeros_like(height)
        return cls(height, zero, goal, vec.scale(up_ws, height), zero)


@struct
class PelvisMoment(SensedMoment):
    """A moment, with what only the pelvis reads."""

    lean: Lean
    awake: Float[Array, ""]
    """0 while the body is to stay where it is, else 1."""


class AbstractPelvis(Rule):
    """Moves the body up and down."""

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


class LowestPelvis(AbstractPelvis):
    """Follows the standing foot that requests the lowest body (the record's "height offset").

    Each foot requests the height from its animated ankle to its target. A foot that does not stand
    is blended, by its contact weight, into the highest request of all. With no foot standing the
    goal is 0. Without a limit and with gains of 1 this is ozz's pelvis correction.
    """

    enabled: Leaf = switch(True, doc="Whether the pelvis moves.")
    limit: Leaf = parameter(
        0.30, unit="m", low=0.0, high=0.6, doc="Furthest that the pelvis moves up or down."
    )
    on_gain: Leaf = gain_parameter(
        0.225, doc="Part of the gap that the pelvis closes in each tick while a foot stands."
    )
    off_gain: Leaf = gain_parameter(
        0.116, doc="Part of the gap that the pelvis closes in each tick while no foot stands."
    )
    vertical_only: Leaf = switch(
        True, doc="Whether the pelvis moves along up, or along the ground's normal."
    )
    tick_hz: Leaf = constant(30.0, unit="Hz", doc="Ticks per second that the gains refer to.")

    def advance(self, now: PelvisMoment, target: Transform, state: PelvisState) -> PelvisState:
        sensed, gate = now.sensed, now.gate
        requested = requested_heights(sensed, target.pos)
        weight = sensed.contact.weight * sensed.foothold.found * sensed.weight
        active = sensed.weight > 0
        highest = gate.maximum(jnp.where(active, requested, -FAR), band=HEIGHT_BAND)
        requested = jnp.where(active, smoothing.lerp(highest, requested, weight), highest)
        lowest = gate.minimum(requested, band=HEIGHT_BAND)
        standing = gate.maximum(weight, band=0.1)
        goal = standing * gate.clip(lowest, -self.limit, self.limit, band=HEIGHT_BAND)
        goal = jnp.where(self.enabled, goal, 0.0)
        fraction = smoothing.lerp(
            smoothing.fraction_of_gain(self.off_gain, now.dt, self.tick_hz),
            smoothing.fraction_of_gain(self.on_gain, now.dt, self.tick_hz),
            standing,
        )
        fraction = now.awake * now.progress(fraction)
        height = smoothing.lerp(state.height, goal, fraction)
        direction_ws = jnp.where(self.vertical_only, sensed.up_ws, now.lean.normal_ws)
        return PelvisState.at(height, goal, direction_ws)


class CapsulePelvis(AbstractPelvis):
    """Sinks to the lowest foot and never rises, and shrinks the capsule (Unreal).

    The goal is the lowest height that a foot requests, or 0 if that is above 0. The capsule's
    half-height goes to its full value less half of that depth. Both follow by the clamped-speed law
    of Unreal's interp-to. With `enabled` off both go back.
    """

    enabled: Leaf = switch(True, doc="Whether the pelvis sinks.")
    speed: Leaf = parameter(
        15.0,
        unit="1/s",
        low=0.5,
        high=30.0,
        scale="log",
        doc="Rate at which pelvis and capsule follow their goals.",
    )
    half_height: Leaf = parameter(
        0.90, unit="m", low=0.3, high=2.0, doc="Half the height of the character's capsule at rest."
    )

    def advance(self, now: PelvisMoment, target: Transform, state: PelvisState) -> PelvisState:
        sensed, gate = now.sensed, now.gate
        requested = jnp.where(sensed.weight > 0, requested_heights(sensed, target.pos), 0.0)
        lowest = gate.minimum(requested, band=HEIGHT_BAND)
        zero = jnp.zeros_like(lowest)
        sunk = gate.clip(lowest, zero - jnp.inf, zero, band=HEIGHT_BAND)
        goal = jnp.where(self.enabled, sunk, 0.0)

        def follow(value: Array, goal: Array) -> Array:
            fraction = smoothing.fraction_of_speed(self.speed, now.dt, goal - value)
            return smoothing.lerp(value, goal, now.awake * now.progress(fraction))

        height = follow(state.height, goal)
        half_height = follow(state.half_height, self.half_height - 0.5 * jnp.abs(goal))
        after = PelvisState.at(height, goal, sensed.up_ws)
        return dataclasses.replace(after, half_height=half_height)


class LegLengthPelvis(AbstractPelvis):
    """Keeps the distance from each hip to its foot within the leg's limits (Mec).

    Of all heights that do, it takes the one nearest to the animation. Where one leg needs the body
    higher and another needs it lower, it takes the lower, so that no leg is over-stretched. A foot
    too far aside to be reached requests the height that comes nearest. With `damp` on the offset
    follows by the clamped-speed law of Unreal's interp-to.
    """

    enabled: Leaf = switch(True, doc="Whether the pelvis moves.")
    min_length: Leaf = parameter(
        0.50,
        unit="m",
        low=0.0,
        high=1.0,
        doc="Shortest distance from hip to ankle that the pelvis allows.",
    )
    max_length: Leaf = parameter(
        0.88,
        unit="m",
        low=0.2,
        high=1.5,
        above="min_length",
        doc="Longest distance from hip to ankle that the pelvis allows.",
    )
    damp: Leaf = switch(
        True, doc="Whether the pelvis follows its goal smoothly; if not, it jumps there."
    )
    speed: Leaf = parameter(
        10.0,
        unit="1/s",
        low=0.5,
        high=30.0,
        scale="log",
        doc="Rate at which the pelvis follows its goal.",
    )

    def advance(self, now: PelvisMoment, target: Transform, state: PelvisState) -> PelvisState:
        sensed, gate = now.sensed, now.gate
        lowest = rise_to_length(sensed, target.pos, self.min_length)
        highest = rise_to_length(sensed, target.pos, self.max_length)
        active = (sensed.foothold.found > 0) & (sensed.weight > 0)
        zero = jnp.zeros_like(lowest[:1])
        floors = jnp.concatenate([jnp.where(active, lowest, -FAR), zero])
        floor = gate.maximum(floors, band=HEIGHT_BAND)
        ceilings = jnp.concatenate([jnp.where(active, highest, FAR), floor[None]])
        goal = jnp.where(self.enabled, gate.minimum(ceilings, band=HEIGHT_BAND), 0.0)

        fraction = smoothing.fraction_of_speed(self.speed, now.dt, goal - state.height)
        fraction = now.awake * jnp.where(now.started & self.damp, fraction, 1.0)
        height = smoothing.lerp(state.height, goal, fraction)
        return PelvisState.at(height, goal, sensed.up_ws)


class AbstractFollowingPelvis(AbstractPelvis):
    """Follows a goal, with one half-life up and one down, as an exponential or a spring.

    A rule of this kind only has to say where to go: the three fields and `goal`.
    """

    rise_half_life: eqx.AbstractVar[Array]
    fall_half_life: eqx.AbstractVar[Array]
    spring: eqx.AbstractVar[Array]

    @abstractmethod
    def goal(self, now: PelvisMoment, target: Transform, resting: Array) -> Array:
        """The height above the animation to go to, m; `resting` if no foot requests one."""

    def advance(self, now: PelvisMoment, target: Transform, state: PelvisState) -> PelvisState:
        sensed, gate = now.sensed, now.gate
        requested = requested_heights(sensed, target.pos)
        resting = jnp.where(now.started, state.goal, mean_height(sensed, requested))
        goal = self.goal(now, target, resting)
        gap = goal - state.height
        fraction = gate.choose(
            gate.above(gap, jnp.zeros_like(gap), band=HEIGHT_BAND),
            smoothing.fraction_of_half_life(self.rise_half_life, now.dt),
            smoothing.fraction_of_half_life(self.fall_half_life, now.dt),
        )
        fraction = now.progress(fraction)
        height, velocity = smoothing.follow(
            smoothing.Motion(state.height, state.velocity), goal, fraction, now.dt, self.spring
        )
        height = smoothing.lerp(state.height, height, now.awake)
        after = PelvisState.at(height, goal, sensed.up_ws)
        return dataclasses.replace(after, velocity=now.awake * velocity)


class SupportPelvis(AbstractFollowingPelvis):
    """Follows the mean of the standing feet, pulled towards the lowest foot.

    The goal is the mean of what standing feet request, weighted by contact, blended by
    `lowest_share` with the lowest request of all. With no foot standing the goal stays. Of the
    pelvis rules that do not consider reach it comes nearest to captured people on uneven blocks.
    """

    lowest_share: Leaf = parameter(
        0.30,
        unit="1",
        low=0.0,
        high=1.0,
        doc="Weight of the lowest foot against the mean of those that stand, 0 to 1.",
    )
    rise_half_life: Leaf = half_life_parameter(
        0.10, doc="Time in which the pelvis covers half its way up."
    )
    fall_half_life: Leaf = half_life_parameter(
        0.10, doc="Time in which the pelvis covers half its way down."
    )
    spring: Leaf = switch(False, doc="Whether the pelvis moves as a critically damped spring.")

    def goal(self, now: PelvisMoment, target: Transform, resting: Array) -> Array:
        sensed, gate = now.sensed, now.gate
        requested = requested_heights(sensed, target.pos)
        weight = sensed.contact.weight * sensed.foothold.found * sensed.weight
        total = vec.sum_last(weight)
        active = sensed.weight > 0
        lowest = gate.minimum(jnp.where(active, requested, FAR), band=HEIGHT_BAND)
        support = vec.safe_divide(vec.sum_last(weight * requested), total)
        return jnp.where(total > 0, smoothing.lerp(support, lowest, self.lowest_share), resting)


class ReachPelvis(AbstractFollowingPelvis):
    """Goes where the feet want it, as far as the legs reach: people on uneven ground.

    The feet want a blend of the mean and the highest of their requests. No leg is to become longer
    than `extension` times its length. So the goal is the soft minimum `-k log Σ exp(-x / k)`, with
    `k = softness`, of the wanted height and the heights at which each leg has that length. The same
    soft minimum of the animation is subtracted, so that nothing moves on ground like that of the
    animation, however straight its legs are. On captured people on uneven blocks, reach explains
    most of the pelvis height.
    """

    highest_share: Leaf = parameter(
        0.75,
        unit="1",
        low=0.0,
        high=1.2,
        doc="Weight of the highest foot against the mean of all, 0 to 1.",
    )
    extension: Leaf = parameter(
        0.958,
        unit="1",
        low=0.85,
        high=1.0,
        doc="Part of its length to which a leg may be stretched.",
    )
    softness: Leaf = parameter(
        0.025,
        unit="m",
        low=0.002,
        high=0.1,
        scale="log",
        doc="Height over which the limits of the legs blend into each other.",
    )
    rise_half_life: Leaf = half_life_parameter(
        0.0, doc="Time in which the pelvis covers half its way up."
    )
    fall_half_life: Leaf = half_life_parameter(
        0.0, doc="Time in which the pelvis covers half its way down."
    )
    spring: Leaf = switch(False, doc="Whether the pelvis moves as a critically damped spring.")

    def goal(self, now: PelvisMoment, target: Transform, resting: Array) -> Array:
        sensed, gate = now.sensed, now.gate
        requested = requested_heights(sensed, target.pos)
        active = sensed.weight > 0
        mean = mean_height(sensed, requested)
        highest = gate.maximum(jnp.where(active, requested, -FAR), band=HEIGHT_BAND)
        highest = jnp.where(jnp.any(active), highest, mean)
        wanted = smoothing.lerp(mean, highest, self.highest_share)
        longest = self.extension * (sensed.thigh + sensed.shin)

        def reachable_height(ankle_ws: Array, wanted: Array) -> Array:
            heights = jnp.where(active, rise_to_length(sensed, ankle_ws, longest), FAR)
            heights = jnp.concatenate([heights, wanted[None]])
            return -self.softness * jax.nn.logsumexp(-heights / self.softness)

        animated = reachable_height(sensed.ankle_ws, jnp.zeros_like(wanted))
        return reachable_height(target.pos, wanted) - animated


def mean_height(sensed: Sensed, requested: Array) -> Float[Array, ""]:
    """Mean of requested heights, m, weighted by foot IK of each leg; 0 if all weights are 0."""
    return vec.safe_divide(vec.sum_last(sensed.weight * requested), vec.sum_last(sensed.weight))


def rise_to_length(sensed: Sensed, ankle_ws: Array, length: Array) -> Float[Array, " legs"]:
    """How far the body has to rise until each hip is `length` from its ankle, m.

    For an ankle further aside than that, the height at which it is nearest.
    """
    leg = ankle_ws - sensed.hip_ws
    height = vec.dot(leg, sensed.up_ws)
    aside2 = vec.dot(leg, leg) - height**2
    return height + vec.safe_sqrt(length**2 - aside2)


def requested_heights(sensed: Sensed, target_ws: Array) -> Float[Array, " legs"]:
    """Height from each animated ankle to its target along the leg's up, m."""
    return vec.dot(target_ws - sensed.ankle_ws, sensed.leg_up_ws)
