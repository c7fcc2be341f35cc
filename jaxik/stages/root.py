"""Stage 2: the height of the whole character."""

import dataclasses
from abc import abstractmethod
from math import inf
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxik.maths import parameter_tree, smoothing, vec
from jaxik.maths.parameter_tree import (
    Leaf,
    Rule,
    constant,
    half_life,
    option,
    speed,
    switch,
    threshold,
)
from jaxik.maths.struct import place, struct
from jaxik.world.frame import heading, rise_of
from jaxik.world.skeleton import Rig
from jaxik.world.terrain import Hit, cast

from .inputs import Inputs, Moment

HEIGHT_BAND = 0.01  # m
SPEED_BAND = 0.05  # m/s
WEIGHT_BAND = 0.1


class AbstractRoot(Rule):
    """Moves the whole character before its legs look for ground."""

    per_leg: ClassVar[bool] = False

    def init(self, rig: Rig) -> PyTree:
        """Memory before the first frame; None for a rule that goes by each frame alone."""
        return None

    @abstractmethod
    def sense(self, inputs: Inputs) -> PyTree:
        """What `advance` needs from this frame alone."""

    def advance(
        self, now: Moment, sensed: PyTree, state: PyTree
    ) -> tuple[PyTree, Float[Array, ""]]:
        """Memory after this frame, and how far the character moves along up in it, m."""
        return None, sensed


class KeepRoot(AbstractRoot):
    """The character stays where the game put it."""

    def sense(self, inputs: Inputs) -> Float[Array, ""]:
        return jnp.zeros_like(inputs.frame.dt)


@struct
class RootGround:
    """The ground that carries the character, as one frame shows it; heights along up."""

    origin: Float[Array, ""]
    """m, of the character's origin."""
    height: Float[Array, ""]
    """m, of the ground below it."""
    ahead: Float[Array, ""]
    """m, of the ground where it will be once its height has followed."""
    speed: Float[Array, ""]
    """m/s, at which it climbs from the one to the other."""
    rise: Float[Array, ""]
    """m, how far that ground has risen since the previous frame."""
    found: Float[Array, ""]
    """0 or 1; 0 in the air too."""


@struct
class RootState:
    """The height at which the character was put."""

    height: Float[Array, ""] = place("height")
    """m, along up."""
    velocity: Float[Array, ""]
    """m/s, over the ground."""
    offset: Float[Array, ""]
    """m, of that height above the character's origin."""


class GroundRoot(AbstractRoot):
    """Puts the character's origin on the ground below it (ozz's "auto character height").

    The height follows the ground as a critically damped spring, no faster than `max_speed`. On a
    ramp that is late by `half_life / ln 2`; the ground is therefore looked up where the character,
    at its present velocity, will be by then: it climbs a ramp on the ramp, and stairs almost as
    evenly. Ground there that is higher or lower than here by more than `max_step` and a slope of 45
    degrees is a wall or a ledge and does not count yet. A half-life of 0 jumps, as ozz does, and
    looks straight down.

    A roof over the character, or the bench on which it sits, is ground too, but none that carries
    it: of the highest ground and the highest that is at most `max_step` above where the game has
    the character, that counts which is nearer to where the character was, at the start to where the
    game has it; ahead, that which is nearer to the ground here. With a half-life of 0, as in ozz,
    the highest counts.

    With `cross_gaps` on it stands on what carries its width: over a gap narrower than `max_gap` on
    the lower of both sides, except with a half-life of 0.

    Without ground, in the air, or with `enabled` off, the character stays as far from where the
    game has it as it was.
    """

    enabled: Leaf = switch(True, "Whether the character is placed on the ground.")
    ray_up: Leaf = threshold(
        10, 0, 20, "Height above the character's origin at which the rays start.", unit="m"
    )
    ray_down: Leaf = threshold(
        inf, 0, 20, "Depth below the character's origin to which the rays look.", unit="m"
    )
    layers: Leaf = parameter_tree.layers()
    half_life: Leaf = half_life(
        0.2, "Time in which the character covers half its way to the height of the ground."
    )
    max_speed: Leaf = speed(
        4, 0.5, 10, "Fastest that the character rises or sinks over the ground that carries it."
    )
    max_step: Leaf = threshold(
        0.4,
        0.1,
        1,
        "Step beyond which ground ahead does not count yet and ground above may be a roof.",
        unit="m",
    )

    max_gap: Leaf = constant(0.15, "Width of the widest gap that it crosses.", unit="m")
    cross_gaps: bool = option(
        True, "Whether it crosses gaps, which takes three times as many rays."
    )

    def init(self, rig: Rig) -> RootState:
        zero = jnp.zeros((), rig.side.dtype)
        return RootState(zero, zero, zero)

    def sense(self, inputs: Inputs) -> tuple[RootGround, RootGround]:
        frame, up = inputs.frame, inputs.terrain.up_ws
        origin = frame.world_from_model.pos
        # Of a critically damped spring behind a ramp, s; each frame moves to its own end.
        lag = self.half_life / smoothing.LN2 - 0.5 * frame.dt
        lag = jnp.where(lag > 0, lag, 0.0)
        travel = vec.scale(vec.reject(frame.velocity_ws, up), lag)
        lower = jnp.where(self.max_step < self.ray_up, self.max_step, self.ray_up)
        starts = jnp.stack([self.ray_up, lower])[:, None]
        points = jnp.stack([origin, origin + travel])
        points += vec.scale(up, starts)
        if self.cross_gaps:
            away = jnp.where(self.half_life > 0, self.max_gap, 0.0)
            forward_ws, right_ws = heading(frame.world_from_model, up)
            side = vec.scale(forward_ws + right_ws, away)  # for gaps along its way and across
            points += jnp.stack([0.0 * side, side, -side])[:, None, None]
        reaches = starts + self.ray_down + jnp.zeros_like(points[..., 0])
        hits = cast(inputs.terrain.body, points, reaches, self.layers)
        if self.cross_gaps:
            hits = _over_gaps(hits, up)
        ahead = jax.tree.map(lambda leaf: leaf[:, 1], hits)

        def below(ray: int) -> RootGround:
            here = jax.tree.map(lambda leaf: leaf[ray, 0], hits)
            return self._ground(inputs, here, ahead, travel, lag)

        return below(0), below(1)

    def _ground(
        self, inputs: Inputs, hit: Hit, ahead: Hit, travel: Array, lag: Array
    ) -> RootGround:
        """The ground at a hit below the character, which goes on at the nearer of those ahead."""
        frame, gate, up = inputs.frame, inputs.gate, inputs.terrain.up_ws
        height, heights = vec.dot(hit.point, up), vec.dot(ahead.point, up)
        away = jnp.abs(heights - height)
        nearer = ahead.found[1] * gate.below(away[1], away[0] - HEIGHT_BAND, band=HEIGHT_BAND)
        there, found = (gate.choose(nearer, x[1], x[0]) for x in (heights, ahead.found))
        step = jnp.abs(there - height) - vec.length(travel)
        counts = found * gate.below(step, self.max_step, band=HEIGHT_BAND)
        there = gate.choose(counts, there, height)
        speed = vec.safe_divide(there - height, lag)
        on_ground = gate.above(frame.grounded, jnp.full_like(height, 0.5), band=WEIGHT_BAND)
        found = jnp.where(self.enabled, hit.found * on_ground, 0.0)
        rise = rise_of(frame.carry(hit), hit.point, up)
        origin = vec.dot(frame.world_from_model.pos, up)
        return RootGround(origin, height, there, speed, rise, found)

    def advance(
        self, now: Moment, sensed: tuple[RootGround, RootGround], state: RootState
    ) -> tuple[RootState, Float[Array, ""]]:
        return self._follow(now, self._carrying(now, *sensed, state), state)

    def _carrying(
        self, now: Moment, highest: RootGround, lower: RootGround, state: RootState
    ) -> RootGround:
        """The ground that carries the character."""

        def away(ground: RootGround) -> Array:
            before = jnp.where(now.started, state.height + ground.rise, ground.origin)
            return jnp.abs(ground.height - before)

        # The same ground counts as the highest: rays from there see more of what is ahead.
        nearer = now.gate.below(away(lower), away(highest) - HEIGHT_BAND, band=HEIGHT_BAND)
        nearer *= lower.found * jnp.where(self.half_life > 0, 1.0, 0.0)
        return jax.tree.map(lambda low, high: now.gate.choose(nearer, low, high), lower, highest)

    def _follow(
        self, now: Moment, sensed: RootGround, state: RootState
    ) -> tuple[RootState, Float[Array, ""]]:
        gate, before = now.gate, state.height + sensed.rise
        motion = smoothing.spring(
            smoothing.Motion(before, state.velocity), sensed.ahead, self.half_life, now.dt
        )
        limit = jnp.where(self.half_life > 0, self.max_speed, jnp.inf)
        longest = jnp.where(self.half_life > 0, self.max_speed * now.dt, jnp.inf)
        moved = gate.clip(motion.value - before, -longest, longest, band=HEIGHT_BAND)
        height = jnp.where(now.started, before + moved, sensed.height)
        velocity = jnp.where(now.started, motion.velocity, sensed.speed)
        velocity = gate.clip(velocity, -limit, limit, band=SPEED_BAND)
        height = gate.choose(sensed.found, height, sensed.origin + state.offset)
        velocity = gate.choose(sensed.found, velocity, jnp.zeros_like(velocity))
        offset = height - sensed.origin
        return RootState(height, velocity, offset), offset


def _over_gaps(hits: Hit, up: Array) -> Hit:
    """Hits below a place, the first, and beside it: that place as high as the lower side."""
    here, left, right = (jax.tree.map(lambda leaf: leaf[i], hits) for i in range(3))  # noqa: B023
    sides = left.found * right.found
    height, *others = vec.dot(hits.point, up)
    lower = jnp.where(others[0] < others[1], *others)
    depth = jnp.where(lower > height, sides * (lower - height), 0.0)
    return dataclasses.replace(here, point=here.point + vec.scale(up, depth))
