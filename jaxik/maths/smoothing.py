"""Smoothing laws: how far a value moves move_towards its goal in `dt` seconds.

A law gives a `share` 0..1 of the gap, and `lerp` goes that share of the way. Gain and half-life
are the same exponential in two notations and exact at any `dt`; the clamped speed is not, and is
kept as its engine has it; the critically damped spring is exact and also carries a velocity. A
weight that moves at one pace (`move_towards`) closes its gap in steps.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from . import vec

LN2 = 0.6931471805599453
JUMP_GAP = 1e-4  # m: gaps below it are closed at once by the clamped speed


def lerp(value: Array, goal: Array, share: Array) -> Array:
    """`value` moved by `share` (0..1) of the way to `goal`."""
    return value + share * (goal - value)


@vec.remat
def fraction_of_gain(gain: Array, dt: Array, tick_hz: Array) -> Array:
    """Share of the gap that a gain per tick of 1/`tick_hz` s closes in `dt` s; gain 1 jumps.

    `1 - (1 - gain)^(dt tick_hz)`; at gain 1 the slope with respect to the gain is zero.
    """
    damped = gain < 1
    return jnp.where(damped, -jnp.expm1(dt * tick_hz * jnp.log1p(-jnp.where(damped, gain, 0))), 1.0)


@vec.remat
def fraction_of_half_life(half_life: Array, dt: Array) -> Array:
    """Share of the gap closed in `dt` s when half of it takes `half_life` s; 0 or less jumps."""
    damped = half_life > 0
    return jnp.where(damped, -jnp.expm1(-LN2 * dt / jnp.where(damped, half_life, 1.0)), 1.0)


def fraction_of_speed(speed: Array, dt: Array, gap: Array) -> Array:
    """Unreal's interp-to: `clamp(dt speed, 0, 1)`; jumps at speed 0 or less, or a gap under 0.1 mm.

    Depends on the frame rate: its half-life is -ln 2 dt / ln(1 - dt speed).
    """
    share = jnp.clip(dt * speed, 0.0, 1.0)
    return jnp.where((speed > 0) & (jnp.abs(gap) > JUMP_GAP), share, 1.0)


def move_towards(value: Array, goal: Array, step: Array) -> Array:
    """`value` moved move_towards `goal` by `step` (0 or more), or as far as the goal."""
    gap = goal - value
    return value + jnp.where(gap > step, step, jnp.where(gap < -step, -step, gap))


def step_of_time(time: Array, dt: Array) -> Array:
    """Step in `dt` s of a weight that goes from 0 to 1 in `time` s; all of it at 0 or less."""
    lasting = time > 0
    return jnp.where(lasting, dt / jnp.where(lasting, time, 1.0), 1.0)


def step_of_speed(speed: Array, dt: Array) -> Array:
    """Step in `dt` s of a weight that moves by `speed` a second; all of it at an endless speed."""
    endless = jnp.isinf(speed)
    return jnp.where(endless, 1.0, jnp.where(endless, 0.0, speed) * dt)


def spring(
    value: Float[Array, "*b"],
    velocity: Float[Array, "*b"],
    goal: Array,
    half_life: Array,
    dt: Array,
) -> tuple[Array, Array]:
    """Value and velocity after `dt` s of a critically damped spring move_towards a still `goal`.

    `x'' = -w² (x - goal) - 2 w x'` solved exactly, with `w = 2 ln 2 / half_life`; a half-life of
    0 or less jumps and stops.
    """
    return _sprung(value, velocity, goal, fraction_of_half_life(half_life, dt), dt)


@vec.remat
def follow(
    value: Array, velocity: Array, goal: Array, share: Array, dt: Array, springy: Array
) -> tuple[Array, Array]:
    """Value and velocity after `dt` s on the way to `goal`, by an exponential or a `spring`.

    The exponential closes `share` of the gap and has no velocity; the spring, where `springy`, has
    the half-life of that exponential. A share of 1 jumps and stops.
    """
    sprung, speed = _sprung(value, velocity, goal, share, dt)
    eased = lerp(value, goal, share)
    return jnp.where(springy, sprung, eased), jnp.where(springy, speed, jnp.zeros_like(speed))


def _sprung(
    value: Array, velocity: Array, goal: Array, share: Array, dt: Array
) -> tuple[Array, Array]:
    """The spring whose exponential closes `share` of a gap in `dt` s: `w dt = -2 ln(1 - share)`."""
    damped = share < 1
    turned = -2.0 * jnp.log1p(-jnp.where(damped, share, 0.0))
    lasting = dt > 0
    rate = jnp.where(lasting, turned, 0.0) / jnp.where(lasting, dt, 1.0)
    gap = value - goal
    pushed = velocity * dt + turned * gap
    decay = jnp.exp(-turned)
    moved = goal + decay * (gap + pushed)
    speed = decay * (velocity - rate * pushed)
    return jnp.where(damped, moved, goal), jnp.where(damped, speed, 0.0)


def half_life_of_gain(gain: Array, tick_hz: Array) -> Array:
    """Half-life, s, of a gain per tick; 0, with zero slope, for gain 1; infinite for gain 0."""
    damped = gain < 1
    safe = -LN2 / (tick_hz * jnp.log1p(-jnp.where(damped, gain, 0.5)))
    return jnp.where(damped, safe, 0.0)


def gain_of_half_life(half_life: Array, tick_hz: Array) -> Array:
    """Gain per tick of 1/`tick_hz` s with this half-life, s; 0 or less gives 1."""
    return fraction_of_half_life(half_life, 1.0 / tick_hz)


def half_life_of_speed(speed: Array, dt: Array) -> Array:
    """Half-life, s, that Unreal's interp-to has at this frame time; 0 where it jumps."""
    share = jnp.clip(dt * speed, 0.0, 1.0)
    damped = (share > 0) & (share < 1)
    safe = -LN2 * dt / jnp.log1p(-jnp.where(damped, share, 0.5))
    return jnp.where(damped, safe, 0.0)
