"""Stage 7: how far the body sinks or rises so that the legs can reach."""

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
    """The body's offset."""

    height: Float[Array, ""]  # m
    velocity: Float[Array, ""]  # m/s, of a spring; 0 where a rule has none
    goal: Float[Array, ""]  # m, that the height follows
    offset_ws: Float[Array, "3"]  # m
    half_height: Float[Array, ""]  # m, of the character's capsule; 0 where a rule has none

    @classmethod
    def level(cls, rig: Rig) -> "PelvisState":
        """Nothing moved."""
        zero = jnp.zeros((), rig.side.dtype)
        return cls(zero, zero, zero, jnp.zeros(3, rig.side.dtype), zero)

    @classmethod
    def at(cls, height: Array, goal: Array, up_ws: Array) -> "PelvisState":
        """At a height along up, without memory of anything else."""
        zero = jnp.zeros_like(height)
        return cls(height, zero, goal, vec.scale(up_ws, height), zero)


@struct
class PelvisMoment(SensedMoment):
    """A moment, with what only the pelvis reads."""

    lean: Lean
    awake: Float[Array, ""]  # 0 while the body is to stay where it is, else 1


class AbstractPelvis(Rule):
    """Moves the body."""

    def init(self, rig: Rig) -> PelvisState:
        """Memory before the first frame."""
        return PelvisState.level(rig)

    @abstractmethod
    def advance(self, now: PelvisMoment, target: Transform, state: PelvisState) -> PelvisState:
        """The offset after this frame, for ankles that are to go to `target`."""


class LowestPelvis(AbstractPelvis):
    """Follows the standing foot that asks for the lowest body (the record's "height offset").

    Each foot asks for the height from its animated ankle to its target. A foot that does not stand
    counts, by its contact weight, as the highest of those that take part; with no foot standing the
    goal is 0. Without a limit and with gains of 1 it is ozz's pelvis correction.
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
        asked = requested_heights(sensed, target.pos)
        weight = sensed.contact.weight * sensed.foothold.found * sensed.weight
        taking_part = sensed.weight > 0
        top = gate.maximum(jnp.where(taking_part, asked, -FAR), band=HEIGHT_BAND)
        asked = jnp.where(taking_part, smoothing.lerp(top, asked, weight), top)
        lowest = gate.minimum(asked, band=HEIGHT_BAND)
        standing = gate.maximum(weight, band=0.1)
        goal = standing * gate.clip(lowest, -self.limit, self.limit, band=HEIGHT_BAND)
        goal = jnp.where(self.enabled, goal, 0.0)
        share = smoothing.lerp(
            smoothing.fraction_of_gain(self.off_gain, now.dt, self.tick_hz),
            smoothing.fraction_of_gain(self.on_gain, now.dt, self.tick_hz),
            standing,
        )
        share = now.awake * now.progress(share)
        height = smoothing.lerp(state.height, goal, share)
        along = jnp.where(self.vertical_only, sensed.up_ws, now.lean.normal_ws)
        return PelvisState.at(height, goal, along)


class CapsulePelvis(AbstractPelvis):
    """Sinks to the lowest foot and never rises; the character's capsule shrinks (Unreal, seed 001).

    The offset follows the lowest height that a foot asks for, or 0 if that is above it, and the
    capsule's half-height goes to its full one less half of that depth, both by the clamped-speed
    law. With `enabled` off both go back.
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
        asked = jnp.where(sensed.weight > 0, requested_heights(sensed, target.pos), 0.0)
        lowest = gate.minimum(asked, band=HEIGHT_BAND)
        zero = jnp.zeros_like(lowest)
        sunk = gate.clip(lowest, zero - jnp.inf, zero, band=HEIGHT_BAND)
        goal = jnp.where(self.enabled, sunk, 0.0)

        def follow(value: Array, goal: Array) -> Array:
            share = smoothing.fraction_of_speed(self.speed, now.dt, goal - value)
            return smoothing.lerp(value, goal, now.awake * now.progress(share))

        height = follow(state.height, goal)
        half_height = follow(state.half_height, self.half_height - 0.5 * jnp.abs(goal))
        level = PelvisState.at(height, goal, sensed.up_ws)
        return dataclasses.replace(level, half_height=half_height)


class LegLengthPelvis(AbstractPelvis):
    """Keeps the distance from each hip to its foot's goal within what a leg has (Mec).

    Of the heights that do so the one nearest to the animation; where one leg would have to be
    longer and another shorter, none is over-stretched. A foot too far aside to be reached from any
    height asks for the one that comes nearest. Damped, the offset follows by the clamped-speed law.
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
        asks = (sensed.foothold.found > 0) & (sensed.weight > 0)
        zero = jnp.zeros_like(lowest[:1])
        lifted = jnp.concatenate([jnp.where(asks, lowest, -FAR), zero])
        lift = gate.maximum(lifted, band=HEIGHT_BAND)
        bounds = jnp.concatenate([jnp.where(asks, highest, FAR), lift[None]])
        goal = jnp.where(self.enabled, gate.minimum(bounds, band=HEIGHT_BAND), 0.0)

        share = smoothing.fraction_of_speed(self.speed, now.dt, goal - state.height)
        share = now.awake * jnp.where(now.started & self.damp, share, 1.0)
        height = smoothing.lerp(state.height, goal, share)
        return PelvisState.at(height, goal, sensed.up_ws)


class AbstractFollowingPelvis(AbstractPelvis):
    """Follows a goal by one half-life up and one down, as an exponential or a spring."""

    rise_half_life: eqx.AbstractVar[Array]
    fall_half_life: eqx.AbstractVar[Array]
    spring: eqx.AbstractVar[Array]

    @abstractmethod
    def goal(self, now: PelvisMoment, target: Transform, resting: Array) -> Array:
        """Height over the animation to go to, m; `resting` where no foot asks for one."""

    def advance(self, now: PelvisMoment, target: Transform, state: PelvisState) -> PelvisState:
        sensed, gate = now.sensed, now.gate
        asked = requested_heights(sensed, target.pos)
        resting = jnp.where(now.started, state.goal, mean_height(sensed, asked))
        goal = self.goal(now, target, resting)
        gap = goal - state.height
        share = gate.choose(
            gate.above(gap, jnp.zeros_like(gap), band=HEIGHT_BAND),
            smoothing.fraction_of_half_life(self.rise_half_life, now.dt),
            smoothing.fraction_of_half_life(self.fall_half_life, now.dt),
        )
        share = now.progress(share)
        height, velocity = smoothing.follow(
            smoothing.Motion(state.height, state.velocity), goal, share, now.dt, self.spring
        )
        height = smoothing.lerp(state.height, height, now.awake)
        after = PelvisState.at(height, goal, sensed.up_ws)
        return dataclasses.replace(after, velocity=now.awake * velocity)


class SupportPelvis(AbstractFollowingPelvis):
    """Follows the feet that stand, with a share of the lowest foot.

    The goal is the mean of what the standing feet ask, by their contact weights, pulled by
    `lowest_share` towards the lowest of all. With no foot standing it stays where it was. The
    human pelvis rides on its support: of the pelvis rules of games this one was nearest to capture
    before reach was thought of (the blocks benchmark's table).
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
        asked = requested_heights(sensed, target.pos)
        weight = sensed.contact.weight * sensed.foothold.found * sensed.weight
        total = vec.sum_last(weight)
        taking_part = sensed.weight > 0
        lowest = gate.minimum(jnp.where(taking_part, asked, FAR), band=HEIGHT_BAND)
        support = vec.safe_divide(vec.sum_last(weight * asked), total)
        return jnp.where(total > 0, smoothing.lerp(support, lowest, self.lowest_share), resting)


class ReachPelvis(AbstractFollowingPelvis):
    """Goes where the feet want it, as far as the legs reach: human pelvis height on uneven ground.

    The feet want a mix of the mean and the highest of what they ask. No leg is to become longer
    than `extension` times its length: of the wanted height and those at which each leg is that long
    a soft least is taken, `-k log Σ exp(-x / k)` with `k = softness`. The same of the animation is
    taken away, so that on the ground for which it was made nothing moves, whatever its legs do.
    Found on the blocks benchmark, where reach explains most of a walker's pelvis height.
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
        asked = requested_heights(sensed, target.pos)
        taking_part = sensed.weight > 0
        mean = mean_height(sensed, asked)
        highest = gate.maximum(jnp.where(taking_part, asked, -FAR), band=HEIGHT_BAND)
        highest = jnp.where(jnp.any(taking_part), highest, mean)
        wanted = smoothing.lerp(mean, highest, self.highest_share)
        longest = self.extension * (sensed.thigh + sensed.shin)

        def reachable(ankle_ws: Array, wanted: Array) -> Array:
            rises = jnp.where(taking_part, rise_to_length(sensed, ankle_ws, longest), FAR)
            rises = jnp.concatenate([rises, wanted[None]])
            return -self.softness * jax.nn.logsumexp(-rises / self.softness)

        animated = reachable(sensed.ankle_ws, jnp.zeros_like(wanted))
        return reachable(target.pos, wanted) - animated


def mean_height(sensed: Sensed, asked: Array) -> Float[Array, ""]:
    """Mean of what legs ask for, m, by their share of foot IK; 0 where none takes part."""
    return vec.safe_divide(vec.sum_last(sensed.weight * asked), vec.sum_last(sensed.weight))


def rise_to_length(sensed: Sensed, ankle_ws: Array, length: Array) -> Float[Array, " legs"]:
    """How far the body would rise until each hip is `length`, m, from its ankle.

    Where an ankle is further aside than that, the height at which it is nearest.
    """
    leg = ankle_ws - sensed.hip_ws
    along = vec.dot(leg, sensed.up_ws)
    across2 = vec.dot(leg, leg) - along**2
    return along + vec.safe_sqrt(length**2 - across2)


def requested_heights(sensed: Sensed, target_ws: Array) -> Float[Array, " legs"]:
    """Height from each animated ankle to its target along the leg's up, m."""
    return vec.dot(target_ws - sensed.ankle_ws, sensed.leg_up_ws)
