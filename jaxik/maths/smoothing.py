"""Smoothing laws: how far a value moves towards its goal in `dt` seconds.

A law gives the `fraction` 0..1 of the gap that it closes, and `lerp` closes it. The exponential,
told by its half-life, is exact at any `dt`. Unreal's clamped speed depends on the frame rate and is
kept that way. The critically damped spring is exact and also has a velocity. A weight that moves at
constant speed closes its gap in steps (`move_towards`). What goes from 0 to 1 with something else
than time follows `smoothstep`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from . import vec

LN2 = 0.6931471805599453
JUMP_GAP = 1e-6  # m: the clamped speed closes smaller gaps at once
ARRIVED = 1e-5  # of a weight: what rounding may leave of a gap that a whole number of steps closes


class Motion(NamedTuple):
    """A smoothed value and its velocity."""

    value: Float[Array, "*b"]
    velocity: Float[Array, "*#b"]
    """Per second."""


def lerp(value: Array, goal: Array, fraction: Array) -> Array:
    """`value` moved by `fraction` (0..1) of the way to `goal`."""
    return value + fraction * (goal - value)


@jax.jit
def smoothstep(x: Array) -> Array:
    """`3x² - 2x³` for x in 0..1, a ramp from 0 to 1 without a kink; constant outside."""
    x = clip_to_one(x)
    return x * x * (3.0 - 2.0 * x)


@jax.jit
def clip_to_one(x: Array) -> Array:
    """`x` limited to 0..1, with zero gradient outside."""
    return jnp.where(x < 0, 0.0, jnp.where(x > 1, 1.0, x))


@vec.remat
def fraction_of_half_life(half_life: Array, dt: Array) -> Array:
    """Fraction of the gap closed in `dt` s if half of it takes `half_life` s; 0 or less jumps."""
    damped = half_life > 0
    return jnp.where(damped, -jnp.expm1(-LN2 * dt / jnp.where(damped, half_life, 1.0)), 1.0)


def fraction_of_speed(speed: Array, dt: Array, gap: Array) -> Array:
    """Fraction of the gap closed in `dt` s by Unreal's `FInterpTo`: `clamp(dt speed, 0, 1)`.

    Jumps at a speed of 0 or less and over gaps below 1 µm. Depends on the frame rate: the
    half-life is -ln 2 dt / ln(1 - dt speed).
    """
    fraction = jnp.clip(dt * speed, 0.0, 1.0)
    return jnp.where((speed > 0) & (jnp.abs(gap) > JUMP_GAP), fraction, 1.0)


def move_towards(value: Array, goal: Array, step: Array) -> Array:
    """A weight moved towards `goal` by `step` (0 or more), but not past it.

    The step with which it arrives may be longer by `ARRIVED`. So it is the same step, with the
    same derivative, whichever way the steps before it were rounded.
    """
    gap = goal - value
    longest = step + jnp.where(step > 0, ARRIVED, 0.0)
    return value + jnp.where(gap > longest, step, jnp.where(gap < -longest, -step, gap))


def step_of_time(time: Array, dt: Array) -> Array:
    """Step in `dt` s of a weight that goes from 0 to 1 in `time` s; 1 where `time` is 0 or less."""
    gradual = time > 0
    return jnp.where(gradual, dt / jnp.where(gradual, time, 1.0), 1.0)


def step_of_speed(speed: Array, dt: Array) -> Array:
    """Step in `dt` s of a weight that moves by `speed` per second; 1 at an infinite speed."""
    finite = jnp.isfinite(speed)
    return jnp.where(finite, jnp.where(finite, speed, 0.0) * dt, 1.0)


def spring(before: Motion, goal: Array, half_life: Array, dt: Array) -> Motion:
    """Critically damped spring towards a fixed goal, after `dt` s.

    `x'' = -w² (x - goal) - 2 w x'` solved exactly, with `w = 2 ln 2 / half_life`. A half-life of
    0 or less jumps to the goal and stops there.
    """
    return _spring(before, goal, fraction_of_half_life(half_life, dt), dt)


class Deviation(NamedTuple):
    """A value that is to become 0, with its velocity and acceleration."""

    value: Float[Array, "*b"]
    velocity: Float[Array, "*b"]
    """Per second."""
    acceleration: Float[Array, "*b"]
    """Per second squared."""


def settle(before: Deviation, time: Array, dt: Array) -> Deviation:
    """A deviation after `dt` s on its way of minimum jerk to rest at 0 in `time` s, above 0.

    Called in each frame with the time that is left, it arrives smoothly wherever it was moved
    meanwhile (Hoff and Arbib 1993); with the same time in each frame it never quite arrives.
    """
    x = clip_to_one(dt / time)
    slope, curve = before.velocity * time, before.acceleration * time * time
    third = -10.0 * before.value - 6.0 * slope - 1.5 * curve
    fourth = 15.0 * before.value + 8.0 * slope + 1.5 * curve
    fifth = -6.0 * before.value - 3.0 * slope - 0.5 * curve
    value = before.value + x * (slope + x * (0.5 * curve + x * (third + x * (fourth + x * fifth))))
    velocity = slope + x * (curve + x * (3.0 * third + x * (4.0 * fourth + x * 5.0 * fifth)))
    acceleration = curve + x * (6.0 * third + x * (12.0 * fourth + x * 20.0 * fifth))
    return Deviation(value, velocity / time, acceleration / (time * time))


@vec.remat
def follow(before: Motion, goal: Array, fraction: Array, dt: Array, use_spring: Array) -> Motion:
    """Exponential or, where `use_spring`, spring towards a goal, after `dt` s.

    The exponential closes `fraction` of the gap and has no velocity; the spring has the half-life
    of that exponential. A fraction of 1 jumps to the goal and stops there.
    """
    sprung = _spring(before, goal, fraction, dt)
    eased = lerp(before.value, goal, fraction)
    return Motion(
        jnp.where(use_spring, sprung.value, eased),
        jnp.where(use_spring, sprung.velocity, jnp.zeros_like(sprung.velocity)),
    )


def _spring(before: Motion, goal: Array, fraction: Array, dt: Array) -> Motion:
    """The spring whose exponential closes `fraction` of a gap in `dt` s.

    Its phase is `w dt = -2 ln(1 - fraction)`.
    """
    damped = fraction < 1
    phase = -2.0 * jnp.log1p(-jnp.where(damped, fraction, 0.0))
    advancing = dt > 0
    rate = jnp.where(advancing, phase, 0.0) / jnp.where(advancing, dt, 1.0)
    gap = before.value - goal
    pushed = before.velocity * dt + phase * gap
    decay = jnp.exp(-phase)
    value = goal + decay * (gap + pushed)
    velocity = decay * (before.velocity - rate * pushed)
    return Motion(jnp.where(damped, value, goal), jnp.where(damped, velocity, 0.0))
