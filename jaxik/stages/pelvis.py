"""Stage 9: how far the body sinks or rises so that its legs can reach the ground.

After what all rules share come those of games: the lowest foot, a capsule that shrinks, limits on
leg length. Last are those modelled on people, who ride on their support and reach as far as their
legs go. To write a rule, start with `AbstractPelvis`, or with `AbstractFollowingPelvis`, which only
needs a goal.
"""

import dataclasses
import itertools
from abc import abstractmethod
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxik.maths import quat, smoothing, vec
from jaxik.maths.gate import HARD, AbstractGate
from jaxik.maths.parameter_tree import (
    Leaf,
    Rule,
    constant,
    duration,
    half_life,
    length,
    rate,
    ratio,
    speed,
    switch,
)
from jaxik.maths.struct import place, struct
from jaxik.stages.inputs import GRAVITY, STAIRS, SensedMoment
from jaxik.stages.lean import Lean
from jaxik.world.frame import Landing, Sensed
from jaxik.world.skeleton import Rig, Transform, mean_position

HEIGHT_BAND = 0.01  # m
FAR = 1e6  # m, beyond any leg
EARLIEST = 10.0  # landing times before a landing; its share is then less than numbers resolve
FASTEST = 2.0  # m/s, of a root that climbs; one that is faster has jumped


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


@struct
class Goal:
    """Where the body is to go from its animation."""

    height: Float[Array, ""]
    """Metres."""
    ahead: Float[Array, ""]
    """m, along the character's heading."""


class AbstractFollowingPelvis(AbstractPelvis):
    """Follows a goal, with one half-life up and one down, as an exponential or a spring.

    A rule of this kind only has to say where to go: the three fields and `goal`. Forward and back
    it moves as an exponential with the half-life of rising.
    """

    rise_half_life: eqx.AbstractVar[Array]
    fall_half_life: eqx.AbstractVar[Array]
    spring: eqx.AbstractVar[Array]

    @abstractmethod
    def goal(
        self, now: PelvisMoment, target: Transform, state: PelvisState, resting: Array
    ) -> Goal:
        """Where to go; to the height `resting`, m, if no foot requests one."""

    def rise_bounds(self, now: PelvisMoment, state: PelvisState) -> tuple[Array, Array] | None:
        """How far the body rises over its animation in this frame, m, at least and at most.

        Below 0 it sinks; None is without bounds.
        """
        return None

    def advance(self, now: PelvisMoment, target: Transform, state: PelvisState) -> PelvisState:
        sensed, gate = now.sensed, now.gate
        requested = supported_heights(sensed, target.pos)
        resting = jnp.where(now.started, state.goal, mean_height(sensed, requested))
        goal = self.goal(now, target, state, resting)
        gap = goal.height - state.height
        rising, falling = (
            smoothing.fraction_of_half_life(half_life, now.dt)
            for half_life in (self.rise_half_life, self.fall_half_life)
        )
        rises = gate.above(gap, jnp.zeros_like(gap), band=HEIGHT_BAND)
        height, velocity = smoothing.follow(
            smoothing.Motion(state.height, state.velocity),
            goal.height,
            now.progress(gate.choose(rises, rising, falling)),
            now.dt,
            self.spring,
        )
        bounds = self.rise_bounds(now, state)
        if bounds is not None:
            risen, (least, most) = height - state.height, bounds
            bounded = jnp.where(risen > most, most, jnp.where(risen < least, least, risen))
            outside = now.started & ((risen > most) | (risen < least))
            velocity = jnp.where(outside, vec.safe_divide(bounded, now.dt), velocity)
            height = jnp.where(outside, state.height + bounded, height)
        height = smoothing.lerp(state.height, height, now.awake)
        ahead = smoothing.lerp(state.ahead, goal.ahead, now.awake * now.progress(rising))
        after = PelvisState.at(height, goal.height, sensed.up_ws)
        offset_ws = after.offset_ws + vec.scale(sensed.slope.forward_ws, ahead)
        return dataclasses.replace(
            after, velocity=now.awake * velocity, offset_ws=offset_ws, ahead=ahead
        )


class SupportPelvis(AbstractFollowingPelvis):
    """Follows the mean of the standing feet, pulled towards the lowest foot.

    The goal is the mean of what standing feet request, weighted by contact, blended by
    `lowest_share` with the lowest request of all. With no foot standing the goal stays. Of the
    pelvis rules that do not consider reach it comes nearest to captured people on uneven blocks.
    """

    lowest_share: Leaf = ratio(
        0.3, 0, 1, "Weight of the lowest foot against the mean of those that stand, 0 to 1."
    )
    rise_half_life: Leaf = half_life(0.1, "Time in which the pelvis covers half its way up.")
    fall_half_life: Leaf = half_life(0.1, "Time in which the pelvis covers half its way down.")
    spring: Leaf = switch(False, "Whether the pelvis moves as a critically damped spring.")

    def goal(
        self, now: PelvisMoment, target: Transform, state: PelvisState, resting: Array
    ) -> Goal:
        sensed, gate = now.sensed, now.gate
        requested = supported_heights(sensed, target.pos)
        weight = sensed.contact.weight * sensed.foothold.found * sensed.load
        total = vec.sum_last(weight)
        lowest = lowest_of(gate, sensed, requested)
        support = vec.safe_divide(vec.sum_last(weight * requested), total)
        height = smoothing.lerp(support, lowest, self.lowest_share)
        height = smoothing.lerp(resting, height, smoothing.clip_to_one(total))
        return Goal(height, jnp.zeros_like(resting))


class ReachPelvis(AbstractFollowingPelvis):
    """Goes where the feet want it, as far as the legs reach: people on uneven ground.

    The feet want a blend of the mean and the highest of their requests. No leg is to become longer
    than `extension` times its length. So the goal is the soft minimum `-k log Σ exp(-x / k)`, with
    `k = softness`, of the wanted height and the heights at which each leg has that length. The same
    soft minimum of the animation is subtracted, so that nothing moves on ground like that of the
    animation, however straight its legs are. On captured people on uneven blocks, reach explains
    most of the pelvis height.

    A foot that will land lower needs the body lower as soon as it does. So within about
    `landing_time` a swinging leg's limit passes to that at its next foothold, where the body will
    be then: the limit there, higher by `k (t / landing_time)^2`, `t` before. The time that is left
    follows from how much of the swing passes in a frame, so footholds have to be known. Where the
    body will be follows from how fast it goes: if it is to speed up first, it seems to stay too far
    behind, and a drop counts only as far as the animated leg is seen to reach.

    The body also moves forward or back towards the foot whose leg limits it, the lower of two: by
    `shift` of how much further ahead of its hip that foot is than in the animation. People stay
    behind as they step up and go ahead as they step down. Where the animated pelvis knew the phase
    of the gait alone, this brought its place ahead or back from 3.3 to 2.9 and from 3.5 to 3.0 cm
    of the captured (rms) in the halves of a walk over blocks (`tests/phase_pelvis`). Aside, the
    ground explains nothing of where it is.

    Once a trailing leg has left the ground, it limits the body no more, but a person is not up at
    once: the upper leg pushes. A captured climb of 45 cm takes 0.6 s, at a nearly constant speed.
    So body and root together rise no faster than `rise_speed` and 0.75, the steepness of steep
    stairs, of the speed of the character, as long as the root does not by itself. Nor do they fall
    over the ground faster than freely: the captured pelvis of a walk over blocks accelerates down
    by less than 0.9 g in 99.9 % of its frames.
    """

    highest_share: Leaf = ratio(
        0.75, 0, 1.2, "Weight of the highest foot against the mean of all, 0 to 1."
    )
    extension: Leaf = ratio(
        0.958, 0.85, 1, "Part of its length to which a leg may be stretched.", per_leg=True
    )
    softness: Leaf = length(
        0.025,
        0.002,
        0.1,
        "Height over which the limits of the legs blend into each other.",
        scale="log",
    )
    shift: Leaf = ratio(
        0.15,
        0,
        1,
        "Part of the way to the foot whose leg limits it that the pelvis moves ahead or back.",
    )
    most_shift: Leaf = constant(0.04, "How far the pelvis moves ahead or back at most.", unit="m")
    landing_time: Leaf = duration(
        0,
        0.02,
        0.3,
        "How long before a foot lands its leg's length there limits the pelvis; 0 is not before.",
        scale="log",
        follows="time",
    )
    rise_half_life: Leaf = half_life(0, "Time in which the pelvis covers half its way up.")
    fall_half_life: Leaf = half_life(0, "Time in which the pelvis covers half its way down.")
    spring: Leaf = switch(False, "Whether the pelvis moves as a critically damped spring.")
    rise_speed: Leaf = speed(
        0.3,
        0.05,
        3,
        "How fast legs push the body up, beyond 0.75 of the speed with which it goes.",
        scale="log",
    )

    def rise_bounds(self, now: PelvisMoment, state: PelvisState) -> tuple[Array, Array] | None:
        landing, before = now.sensed.ground.landing, state.approach
        if landing is None or before is None:
            return None
        climbed = _climbed(now, landing, before)
        pushed = (self.rise_speed + STAIRS * vec.length(landing.velocity_ws[0])) * now.dt
        most = pushed - HARD.minimum(climbed, band=0.0)
        sinking = jnp.where(before.speed < 0, before.speed, 0.0)
        least = (sinking - GRAVITY * now.dt) * now.dt - HARD.maximum(climbed, band=0.0)
        return least, jnp.where(most > 0, most, 0.0)

    def init(self, rig: Rig) -> PelvisState:
        zero = jnp.zeros_like(rig.side)
        return dataclasses.replace(super().init(rig), approach=Approach(zero, zero[0], zero[0]))

    def advance(self, now: PelvisMoment, target: Transform, state: PelvisState) -> PelvisState:
        after, before = super().advance(now, target, state), state.approach
        landing = now.sensed.ground.landing
        if landing is None or before is None:
            return dataclasses.replace(after, approach=before)
        climbed = HARD.maximum(_climbed(now, landing, before), band=0.0)
        speed = vec.safe_divide(after.height - state.height + climbed, now.dt)
        speed = jnp.where(now.started & (now.dt > 0), speed, before.speed)
        approach = Approach(landing.fraction, speed, landing.root_height)
        return dataclasses.replace(after, approach=approach)

    def goal(
        self, now: PelvisMoment, target: Transform, state: PelvisState, resting: Array
    ) -> Goal:
        sensed, gate = now.sensed, now.gate
        requested = supported_heights(sensed, target.pos)
        load, mean = greatest_load(sensed), mean_height(sensed, requested)
        highest = load * highest_of(gate, sensed, requested)
        wanted = smoothing.lerp(mean, highest, self.highest_share)
        longest = self.extension * (sensed.thigh + sensed.shin)
        forward_ws, hip_ws = sensed.slope.forward_ws, _tilted_hips(now)

        def limiting_ahead(hip_ws: Array, ankle_ws: Array) -> Array:
            """How far ahead of its hip the foot is whose leg limits the height, m."""
            heights = rise_to_length(sensed, hip_ws, ankle_ws, longest)
            top = HARD.maximum(jnp.where(sensed.present, heights, -FAR), band=0.0)
            _, shares = self._lowest(limits_of(sensed, heights, top), sensed.load)
            reach = shares * vec.dot(ankle_ws - hip_ws, forward_ws)
            return load * vec.safe_divide(vec.sum_last(reach), vec.sum_last(shares))

        ends = _ends_of_swings(now, state.approach, self.landing_time)
        weights = vec.stack(
            *vec.unstack(sensed.load * (1.0 - ends.share)),
            *vec.unstack(sensed.load * ends.certain),
            jnp.ones_like(load),
        )

        def limits(hip_ws: Array, ankle_ws: Array, wanted: Array) -> Array:
            return limits_of(sensed, rise_to_length(sensed, hip_ws, ankle_ws, longest), wanted)

        def reachable_height(
            hip_ws: Array, ankle_ws: Array, landing_ws: Array, wanted: Array
        ) -> Array:
            later = limits(hip_ws, landing_ws, wanted) + self.softness * ends.lateness
            heights = limits(hip_ws, ankle_ws, wanted)
            heights = vec.barrier(vec.stack(*vec.unstack(heights), *vec.unstack(later), wanted))
            lowest, shares = self._lowest(heights, weights)
            return lowest - self.softness * jnp.log(vec.sum_last(shares))

        animated_ws = sensed.unscaled_ankle_ws
        ahead = limiting_ahead(hip_ws, target.pos) - limiting_ahead(sensed.hip_ws, animated_ws)
        ahead *= self.shift
        ahead *= vec.safe_divide(self.most_shift, vec.safe_sqrt(self.most_shift**2 + ahead**2))
        ahead, wanted = vec.stacked_barrier(ahead, wanted)
        shifted_ws = hip_ws + vec.scale(forward_ws, ahead)
        level_ws = animated_ws + ends.way_ws
        # Without this, the body of one who starts to walk down would drop at once.
        straight = rise_to_length(sensed, sensed.hip_ws, level_ws, sensed.thigh + sensed.shin)
        missed = jnp.where(straight < 0, -straight, 0.0)
        below = jnp.where(ends.rise < -missed, ends.rise + missed, 0.0)
        rise = jnp.where(ends.rise < 0, below, ends.rise)
        landing_ws = target.pos + ends.way_ws + vec.scale(sensed.leg_up_ws, rise)
        animated = reachable_height(sensed.hip_ws, animated_ws, level_ws, jnp.zeros_like(wanted))
        moved = reachable_height(shifted_ws, target.pos, landing_ws, wanted)
        return Goal(*vec.stacked_barrier(moved - animated, ahead))

    def _lowest(self, limits: Array, weights: Array) -> tuple[Array, Array]:
        """The lowest of limits, m, and how far each of them, of these weights, is the lowest."""
        lowest = HARD.minimum(limits, band=0.0)
        return lowest, weights * jnp.exp((lowest - limits) / self.softness)


class EndsOfSwings(NamedTuple):
    """How swings end, as seen from the body as it will then be."""

    share: Float[Array, " legs"]
    """0..1, how far a leg is where it lands already."""
    certain: Float[Array, " legs"]
    """0..1, how far the limits there count at all."""
    lateness: Float[Array, " legs"]
    """How many softnesses higher they are as long as the foot swings."""
    way_ws: Float[Array, "legs 3"]
    """m, how far ankles have to go, across the up of each leg."""
    rise: Float[Array, " legs"]
    """m, how far they have to rise."""


def _ends_of_swings(
    now: PelvisMoment, before: Approach | None, landing_time: Array
) -> EndsOfSwings:
    """Where feet land; the time until then follows from how much of a swing passes in a frame."""
    sensed = now.sensed
    landing, none = sensed.ground.landing, jnp.zeros_like(sensed.load)
    if landing is None or before is None:
        return EndsOfSwings(none, none, none + FAR, jnp.zeros_like(sensed.hip_ws), none)
    step, rest = landing.fraction - before.fraction, 1.0 - landing.fraction
    near = now.started & (step > 0) & (landing.certain > 0)
    near &= rest * now.dt < EARLIEST * landing_time * step
    remaining = jnp.where(near, rest / jnp.where(near, step, 1.0), 0.0)
    time = remaining * now.dt
    lateness = (time / jnp.where(landing_time > 0, landing_time, 1.0)) ** 2
    climbed = _climbed(now, landing, before)
    lift = 0.0 if sensed.ground.lift is None else sensed.ground.lift
    return EndsOfSwings(
        share=jnp.where(near, landing.certain * jnp.exp(-lateness), 0.0),
        certain=jnp.where(near, landing.certain, 0.0),
        lateness=jnp.where(near, lateness, FAR),
        way_ws=vec.reject(landing.way_ws, sensed.leg_up_ws) - vec.scale(landing.velocity_ws, time),
        rise=vec.dot(landing.way_ws, sensed.leg_up_ws) - lift - climbed * remaining,
    )


def _climbed(now: PelvisMoment, landing: Landing, before: Approach) -> Float[Array, " legs"]:
    """How far the root has risen over the ground under each foot since the frame before, m."""
    climbed = landing.root_height - before.root_height - now.sensed.ground_rise
    highest = FASTEST * now.dt
    return jnp.where(jnp.abs(climbed) < highest, climbed, jnp.sign(climbed) * highest)


def _tilted_hips(now: PelvisMoment) -> Float[Array, "legs 3"]:
    """The hips after the pelvis has tilted about their mean, m, world space."""
    hip_ws = now.sensed.hip_ws
    pivot = mean_position(hip_ws, now.sensed.present)
    return pivot + quat.rotate(now.lean.rot_ws, hip_ws - pivot)
