"""Stage 5: the foothold of each foot, with the height of the ground smoothed over time."""

from abc import abstractmethod
from math import inf

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxik.maths import smoothing, vec
from jaxik.maths.gate import AbstractGate
from jaxik.maths.parameter_tree import (
    Leaf,
    Rule,
    angle,
    constant,
    half_life,
    length,
    option,
    switch,
)
from jaxik.maths.struct import place, struct
from jaxik.world.frame import Contact, Foothold, GroundHits, animated_ankles, foothold
from jaxik.world.skeleton import Rig

from .inputs import Inputs, SensedMoment

HEIGHT_BAND = 0.01  # m
FOLLOWED = 0.01  # s, half-life with which a foothold's velocity follows its height
SOONEST, LATEST = 0.12, 0.25  # s, in which a foot makes up for a jump of its foothold


class AbstractTarget(Rule):
    """Places each foot's foothold."""

    foot_height: eqx.AbstractVar[Array]
    """m, sole to ankle."""

    def init(self, rig: Rig) -> PyTree:
        """Memory before the first frame; None for a rule that goes by each frame alone."""
        return None

    @abstractmethod
    def sense(self, inputs: Inputs, ground: GroundHits, contact: Contact) -> Foothold:
        """The foothold from this frame alone."""

    def advance(self, now: SensedMoment, state: PyTree) -> tuple[PyTree, Float[Array, " legs"]]:
        """Memory after this frame, and how far it and limits move each foothold along up, m."""
        return None, jnp.zeros_like(now.sensed.foothold.lift)


@struct
class TargetState:
    """Smoothed height of each foothold."""

    height: Float[Array, " legs"] = place("leg height")
    """m, along up, with what a swing adds to the animated lift."""
    velocity: Float[Array, " legs"]
    """m/s, over the ground; 0 unless it follows as a spring."""
    point_ws: Float[Array, "legs 3"] = place("point")
    """m, the foothold before smoothing."""
    jumps: "Jumps | None" = None
    """None unless jumps are absorbed."""


@struct
class Jumps:
    """How the heights of footholds would go on, and what is left of their jumps."""

    goal: Float[Array, " legs"] = place("leg height")
    """m, the height in this frame, before smoothing."""
    goal_velocity: Float[Array, " legs"]
    """m/s, of that over the ground, without its jumps."""
    left: smoothing.Deviation
    """m, m/s and m/s² (legs)."""


class SlopeTarget(AbstractTarget):
    """Keeps the animated lift above the ground, and the sole flat on slopes.

    The ankle goes to `I + u (l + h (1/(n·u) - 1))`, where I is the hit, u up, n the ground's
    normal, h `foot_height` and l the animated lift. This is ozz's construction, a flat sole has its
    ankle `h / (n·u)` above the hit, plus the lift. The height follows the ground with one half-life
    up and one down, as an exponential or, with `spring` on, as a critically damped spring. A sole
    that would be deeper than `max_penetration` in the ground meanwhile is pushed out. The ankle
    then stays between two heights in model space. Without ground the foothold is that of the
    animation. A limb that bears nothing, such as a hand on a wall, has no animated lift: its sole
    lies on the ground where it stands, and where it does not it stays as animated.

    With `absorb_jumps` on, a foothold whose height changes by more than `max_acceleration` allows
    does not take its foot along: the foot goes on as it did and makes up for the difference with
    minimum jerk, by the time it lands (inertialisation, Bollo 2018).
    """

    min_ankle_height: Leaf = length(-0.3, -1, 0.5, "Lowest height of the ankle in model space.")
    max_ankle_height: Leaf = length(0.55, 0, 1.5, "Highest height of the ankle in model space.")
    foot_height: Leaf = length(
        0.08, 0, 0.2, "Height of the ankle above the sole.", follows="ankle height"
    )
    max_slope: Leaf = angle(
        1.0471975512,
        0.1,
        1.5,
        "Steepest slope that is compensated; steeper ground counts as this steep.",
    )
    rise_half_life: Leaf = half_life(
        0, "Time in which a foothold covers half its way up to higher ground."
    )
    fall_half_life: Leaf = half_life(
        0, "Time in which a foothold covers half its way down to lower ground."
    )
    spring: Leaf = switch(
        False, "Whether footholds follow the ground as a critically damped spring."
    )
    follow_slopes: Leaf = switch(
        False, "Whether footholds keep up with a slope on which they move, without delay."
    )
    max_acceleration: Leaf = constant(
        40.0, "Acceleration of a foothold's height from which its changes are jumps.", unit="m/s²"
    )
    max_penetration: Leaf = length(
        inf,
        0,
        0.2,
        "Depth to which a level sole may be in the ground while its foothold rises to it.",
    )

    absorb_jumps: bool = option(
        False, "Whether a foot goes on smoothly where its foothold jumps: a prediction changed."
    )

    def init(self, rig: Rig) -> TargetState:
        zero = jnp.zeros_like(rig.side)
        point = jnp.zeros((*zero.shape, 3), zero.dtype)
        left = smoothing.Deviation(zero, zero, zero)
        jumps = Jumps(zero, zero, left) if self.absorb_jumps else None
        return TargetState(zero, zero, point, jumps)

    def sense(self, inputs: Inputs, ground: GroundHits, contact: Contact) -> Foothold:
        hit, up_ws = ground.ankle, inputs.terrain.leg_up_ws
        frame, gate = inputs.frame, inputs.gate
        ankle_height = slope_height(self.foot_height, self.max_slope, hit.normal, up_ws, gate)
        standing = hit.point + vec.scale(up_ws, ankle_height - self.foot_height)
        ankle_ws = animated_ankles(frame).pos
        away = vec.dot(ankle_ws - standing, up_ws)
        away = jnp.where(away > self.foot_height, away, self.foot_height)
        on_wall = smoothing.lerp(away, self.foot_height, contact.weight)
        lift = smoothing.lerp(contact.lift, on_wall, 1.0 - inputs.bearing)
        without_ground = _below(ankle_ws, up_ws, lift)
        point_ws = smoothing.lerp(without_ground, standing, hit.found[..., None])
        lift = lift if ground.lift is None else lift + ground.lift
        return foothold(frame, up_ws, point_ws, lift, hit.found)

    def advance(
        self, now: SensedMoment, state: TargetState
    ) -> tuple[TargetState, Float[Array, " legs"]]:
        foothold, gate, dt = now.sensed.foothold, now.gate, now.dt
        climb = jnp.where(self.follow_slopes, self._climb(now, state), 0.0)
        before = state.height + now.sensed.ground_rise + climb
        swing_lift = now.sensed.ground.lift
        ground = vec.dot(foothold.point_ws, now.sensed.leg_up_ws)
        goal = ground if swing_lift is None else ground + swing_lift
        sensed_height, jumps = goal, None
        if state.jumps is not None:
            jumps = self._absorbed(now, goal, state.jumps)
            goal += jumps.left.value
        gap = goal - before
        rising = gate.above(gap, jnp.zeros_like(gap), band=HEIGHT_BAND)
        fraction = gate.choose(
            rising,
            smoothing.fraction_of_half_life(self.rise_half_life, dt),
            smoothing.fraction_of_half_life(self.fall_half_life, dt),
        )
        height, velocity = smoothing.follow(
            smoothing.Motion(before, state.velocity),
            goal,
            now.progress(fraction),
            dt,
            self.spring,
        )
        # Animated lift over that of a foot that stands keeps a sole out of the ground as well.
        lift = foothold.lift if swing_lift is None else foothold.lift - swing_lift
        over_sole = lift - self.foot_height
        over_sole = jnp.where(over_sole > 0, over_sole, 0.0)
        deepest = ground - over_sole - self.max_penetration
        height = gate.clip(height, deepest, jnp.full_like(height, jnp.inf), band=HEIGHT_BAND)
        rise = height - sensed_height
        ankle = foothold.ankle_height_ms + rise * foothold.climb
        kept = gate.clip(ankle, self.min_ankle_height, self.max_ankle_height, band=HEIGHT_BAND)
        limited = now.sensed.bearing * (kept - ankle)
        return TargetState(height, velocity, foothold.point_ws, jumps), rise + limited

    def _absorbed(self, now: SensedMoment, goal: Array, before: Jumps) -> Jumps:
        """What is left of the jumps of a height, m, after this frame."""
        dt, until = now.dt, now.sensed.ground.until
        expected = before.goal + now.sensed.ground_rise + before.goal_velocity * dt
        change = goal - expected
        followed = smoothing.fraction_of_half_life(jnp.asarray(FOLLOWED, dt.dtype), dt) * change
        most = self.max_acceleration * dt * dt
        followed = jnp.where(followed > most, most, jnp.where(followed < -most, -most, followed))
        followed = jnp.where(now.started, followed, 0.0)
        jump = jnp.where(now.started, before.left.value - (change - followed), 0.0)
        time = jnp.full_like(jump, LATEST)
        if until is not None:
            time = jnp.where(until > LATEST, LATEST, jnp.where(until < SOONEST, SOONEST, until))
        left = smoothing.settle(before.left._replace(value=jump), time, dt)
        return Jumps(goal, before.goal_velocity + vec.safe_divide(followed, dt), left)

    def _climb(self, now: SensedMoment, state: TargetState) -> Float[Array, " legs"]:
        """m, by which the slope rises over each foothold's way since the previous frame."""
        sensed, up_ws = now.sensed, now.sensed.leg_up_ws
        normal = sensed.ground.ankle.normal
        way_ws = sensed.foothold.point_ws - sensed.carry.apply(state.point_ws)
        level_ws = way_ws - vec.scale(up_ws, vec.dot(way_ws, up_ws))
        climb = -vec.dot(normal, level_ws) / slope_cosine(self.max_slope, normal, up_ws, now.gate)
        return jnp.where(now.started, climb, 0.0)


class SoleTarget(AbstractTarget):
    """Puts the sole on the ground whatever the animated lift: `ankle = I + u h / (n·u)` (ozz).

    I is the hit, u up, n the ground's normal and h `foot_height`. With a `max_slope` of 0 the ankle
    is h above the ground on slopes too (Mec). Without ground the foothold is that of the animation.
    """

    foot_height: Leaf = length(
        0.12, 0, 0.2, "Height of the ankle above the sole.", follows="ankle height"
    )
    max_slope: Leaf = angle(
        1.5, 0.1, 1.5, "Steepest slope that is compensated; steeper ground counts as this steep."
    )

    def sense(self, inputs: Inputs, ground: GroundHits, contact: Contact) -> Foothold:
        frame, gate, up_ws = inputs.frame, inputs.gate, inputs.terrain.leg_up_ws
        hit = ground.ankle
        lift = slope_height(self.foot_height, self.max_slope, hit.normal, up_ws, gate)
        without_ground = _below(animated_ankles(frame).pos, up_ws, lift)
        point_ws = smoothing.lerp(without_ground, hit.point, hit.found[..., None])
        return foothold(frame, up_ws, point_ws, lift, hit.found)


class RootTarget(AbstractTarget):
    """Moves a standing foot by the ground's height above the root, plus `adjust` (Unreal).

    The animated height above the root is kept: the animation was made for ground at root height. A
    foot that finds no ground or does not stand keeps its place. A limb that bears nothing, such as
    a hand on a wall, stands with its sole on the ground.
    """

    adjust: Leaf = length(0, -0.1, 0.1, "Height added to every foot that stands.")

    @property
    def foot_height(self) -> Array:
        """0: ankles, not soles, are placed."""
        return jnp.zeros_like(self.adjust)

    def sense(self, inputs: Inputs, ground: GroundHits, contact: Contact) -> Foothold:
        frame, up_ws = inputs.frame, inputs.terrain.leg_up_ws
        hit, ankle_ws = ground.ankle, animated_ankles(frame).pos
        height_above_root = vec.dot(ankle_ws - frame.world_from_model.pos, up_ws)
        height = smoothing.lerp(height_above_root, inputs.rig.ankle_height, 1.0 - inputs.bearing)
        standing = contact.weight * hit.found
        lift = height + standing * self.adjust
        without_ground = _below(ankle_ws, up_ws, height)
        point_ws = smoothing.lerp(without_ground, hit.point, standing[..., None])
        return foothold(frame, up_ws, point_ws, lift, hit.found)


def slope_height(
    foot_height: Array, max_slope: Array, normal: Array, up_ws: Array, gate: AbstractGate
) -> Array:
    """Height of the ankle above ground along up, m, if the sole is flat on a slope: `h / (n·u)`.

    Slopes steeper than `max_slope`, rad, count as that steep. ozz-animation's foot IK sample gets
    the same height from similar triangles.
    """
    return foot_height / slope_cosine(max_slope, normal, up_ws, gate)


def slope_cosine(max_slope: Array, normal: Array, up_ws: Array, gate: AbstractGate) -> Array:
    """Cosine of a slope's angle; slopes steeper than `max_slope`, rad, count as that steep."""
    steepest = jnp.cos(max_slope)
    return gate.clip(vec.dot(normal, up_ws), steepest, jnp.ones_like(steepest), band=0.01)


def _below(ankle_ws: Array, up_ws: Array, lift: Array) -> Array:
    """The point `lift` below an animated ankle, m."""
    return ankle_ws - vec.scale(up_ws, lift)
