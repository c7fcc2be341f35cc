"""Pelvis rules modelled on people, who ride on their support and reach as far as their legs go."""

import dataclasses
from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxik.maths import smoothing, vec
from jaxik.maths.parameter_tree import (
    Leaf,
    half_life_parameter,
    parameter,
    switch,
)
from jaxik.world.skeleton import Transform

from .base import (
    FAR,
    HEIGHT_BAND,
    AbstractPelvis,
    PelvisMoment,
    PelvisState,
    mean_height,
    rise_to_length,
    supported_heights,
)


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
        requested = supported_heights(sensed, target.pos)
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
        requested = supported_heights(sensed, target.pos)
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
        per_leg=True,
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
        requested = supported_heights(sensed, target.pos)
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

        animated = reachable_height(sensed.unscaled_ankle_ws, jnp.zeros_like(wanted))
        return reachable_height(target.pos, wanted) - animated
