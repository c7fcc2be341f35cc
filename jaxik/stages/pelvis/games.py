"""Pelvis rules of games: the lowest foot, a capsule that shrinks, limits on leg length."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxik.maths import smoothing, vec
from jaxik.maths.parameter_tree import Leaf, half_life, length, rate, ratio, switch
from jaxik.world.frame import Sensed
from jaxik.world.skeleton import Transform

from .base import (
    FAR,
    HEIGHT_BAND,
    AbstractPelvis,
    PelvisMoment,
    PelvisState,
    highest_of,
    limits_of,
    lowest_of,
    requested_heights,
    rise_to_length,
)


class LowestPelvis(AbstractPelvis):
    """Follows the standing foot that requests the lowest body (the record's "height offset").

    Each foot requests the height from its animated ankle to its target. A foot that does not stand
    is blended, by its contact weight, into the highest request of all. With no foot standing the
    goal is 0. Without a limit and with half-lives of 0 this is ozz's pelvis correction.

    Down a slope a walker stands on the foot behind, which is higher, and swings the other towards
    lower ground. With `wait_to_rise` the body does not climb onto that foot first and drop then. It
    also stays where it is while no foot stands.

    A squatter's leg cannot fold much further. With `min_extension` above 0 the body rises with a
    standing foot that would fold it more, unless the animation does.
    """

    enabled: Leaf = switch(True, "Whether the pelvis moves.")
    limit: Leaf = length(0.3, 0, 0.6, "Furthest that the pelvis moves up or down.")
    airborne_half_life: Leaf = half_life(
        0.1874, "Time in which the pelvis covers half its way while no foot stands."
    )
    half_life: Leaf = half_life(
        0.09065, "Time in which the pelvis covers half its way while a foot stands."
    )
    vertical_only: Leaf = switch(
        True, "Whether the pelvis moves along up, or along the ground's normal."
    )
    wait_to_rise: Leaf = switch(
        False, "Whether the pelvis rises only as far as feet that swing ask for as well."
    )
    min_extension: Leaf = ratio(
        0,
        0,
        0.8,
        "Part of its length to which a standing leg may be folded; 0 folds it to any.",
        per_leg=True,
    )

    def advance(self, now: PelvisMoment, target: Transform, state: PelvisState) -> PelvisState:
        sensed, gate = now.sensed, now.gate
        requested = requested_heights(sensed, target.pos)
        weight = sensed.contact.weight * sensed.foothold.found * sensed.load
        highest = highest_of(gate, sensed, requested)
        of_standing = smoothing.lerp(highest, requested, weight)
        lowest = gate.minimum(of_standing, band=HEIGHT_BAND)
        of_all = lowest_of(gate, sensed, requested)
        zero = jnp.zeros_like(lowest)
        rise = gate.clip(of_all, zero, zero + jnp.inf, band=HEIGHT_BAND)
        waiting = gate.clip(lowest, zero - jnp.inf, rise, band=HEIGHT_BAND)
        lowest = jnp.where(self.wait_to_rise, waiting, lowest)
        least = jnp.where(weight > 0, self._least_heights(sensed, target), lowest)
        unfolded = jnp.where(least > lowest, smoothing.lerp(lowest, least, weight), lowest)
        lowest = gate.maximum(unfolded, band=HEIGHT_BAND)
        standing = gate.maximum(weight, band=0.1)
        resting = jnp.where(self.wait_to_rise, state.height, 0.0)
        lowest = gate.clip(lowest, -self.limit, self.limit, band=HEIGHT_BAND)
        goal = jnp.where(self.enabled, smoothing.lerp(resting, lowest, standing), 0.0)
        fraction = smoothing.lerp(
            smoothing.fraction_of_half_life(self.airborne_half_life, now.dt),
            smoothing.fraction_of_half_life(self.half_life, now.dt),
            standing,
        )
        fraction = now.awake * now.progress(fraction)
        height = smoothing.lerp(state.height, goal, fraction)
        direction_ws = jnp.where(self.vertical_only, sensed.up_ws, now.lean.normal_ws)
        return PelvisState.at(height, goal, direction_ws)

    def _least_heights(self, sensed: Sensed, target: Transform) -> Float[Array, " legs"]:
        """The heights of the body up to which each leg is folded too far, m."""
        animated = vec.length(sensed.ankle_ws - sensed.hip_ws)
        shortest = self.min_extension * (sensed.thigh + sensed.shin)
        shortest = jnp.where(animated < shortest, animated, shortest)
        # A folded leg whose foot is far aside is long enough at any height.
        least = rise_to_length(sensed, sensed.hip_ws, target.pos, shortest)
        return jnp.where(self.min_extension > 0, least, -FAR)


class CapsulePelvis(AbstractPelvis):
    """Sinks to the lowest foot and never rises, and shrinks the capsule (Unreal).

    The goal is the lowest height that a foot requests, or 0 if that is above 0. The capsule's
    half-height goes to its full value less half of that depth. Both follow by the clamped-speed law
    of Unreal's interp-to. With `enabled` off both go back.
    """

    enabled: Leaf = switch(True, "Whether the pelvis sinks.")
    speed: Leaf = rate(15, 0.5, 30, "Rate at which pelvis and capsule follow their goals.")
    half_height: Leaf = length(0.9, 0.3, 2, "Half the height of the character's capsule at rest.")

    def advance(self, now: PelvisMoment, target: Transform, state: PelvisState) -> PelvisState:
        sensed, gate = now.sensed, now.gate
        requested = sensed.load * requested_heights(sensed, target.pos)
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
    """Keeps the distance from each hip to its ankle's target within the leg's limits (Mec).

    Of all heights that do, it takes the one nearest to the animation. Where one leg needs the body
    higher and another needs it lower, it takes the lower, so that no leg is over-stretched. A foot
    too far aside to be reached requests the height that comes nearest. With `damp` on the offset
    follows by the clamped-speed law of Unreal's interp-to.

    Mec measures to the position that it found for the foot, which is its height above the contact
    with the ground, not to the contact itself: a leg that is as long as from hip to ankle then
    leaves a body alone that stands on flat ground.
    """

    enabled: Leaf = switch(True, "Whether the pelvis moves.")
    min_length: Leaf = length(
        0.5, 0, 1, "Shortest distance from hip to ankle that the pelvis allows.", per_leg=True
    )
    max_length: Leaf = length(
        0.88,
        0.2,
        1.5,
        "Longest distance from hip to ankle that the pelvis allows.",
        above="min_length",
        per_leg=True,
    )
    damp: Leaf = switch(
        True, "Whether the pelvis follows its goal smoothly; if not, it jumps there."
    )
    speed: Leaf = rate(10, 0.5, 30, "Rate at which the pelvis follows its goal.")

    def advance(self, now: PelvisMoment, target: Transform, state: PelvisState) -> PelvisState:
        sensed, gate = now.sensed, now.gate
        lowest = rise_to_length(sensed, sensed.hip_ws, target.pos, self.min_length)
        highest = rise_to_length(sensed, sensed.hip_ws, target.pos, self.max_length)
        found = sensed.foothold.found > 0
        zero = jnp.zeros_like(lowest[:1])
        floors = jnp.where(found, limits_of(sensed, -lowest, jnp.zeros_like(lowest)), FAR)
        floor = -gate.minimum(jnp.concatenate([floors, zero]), band=HEIGHT_BAND)
        ceilings = jnp.where(found, limits_of(sensed, highest, floor), FAR)
        ceilings = jnp.concatenate([ceilings, floor[None]])
        goal = jnp.where(self.enabled, gate.minimum(ceilings, band=HEIGHT_BAND), 0.0)

        fraction = smoothing.fraction_of_speed(self.speed, now.dt, goal - state.height)
        fraction = now.awake * jnp.where(now.started & self.damp, fraction, 1.0)
        height = smoothing.lerp(state.height, goal, fraction)
        return PelvisState.at(height, goal, sensed.up_ws)
