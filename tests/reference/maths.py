"""Vectors and wxyz quaternions in float64, with ordinary trigonometry and if/else.

Vectors are arrays of shape (3,), quaternions (4,) in the order w x y z, unit, active. Angles in
radians. Nothing here is batched.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DIRECTIONLESS = 1e-9  # length of a vector, in its own unit, that has no direction
JUMP = 1e-6  # m, below which the clamped-speed law closes a gap at once
IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
X, Y, Z = np.eye(3)


class Transform(NamedTuple):
    """A rigid transform, pos (3) in m and rot (4); or one per leg, (legs, 3) and (legs, 4)."""

    pos: Array
    rot: Array


class Motion(NamedTuple):
    """A smoothed number and its velocity, per second, which is 0 except for springs."""

    value: float
    velocity: float


def length(v: Array) -> float:
    """Euclidean length."""
    return math.sqrt(float(v @ v))


def unit(v: Array, fallback: Array) -> Array:
    """`v` scaled to length one; `fallback` where `v` has no direction."""
    size = length(v)
    return fallback if size < DIRECTIONLESS else v / size


def cross(a: Array, b: Array) -> Array:
    """Right-handed cross product."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def across(v: Array, direction: Array) -> Array:
    """The part of `v` at right angles to the unit `direction`."""
    return v - direction * (v @ direction)


def angle_between(a: Array, b: Array) -> float:
    """Unsigned angle in 0..pi; 0 where either has no direction."""
    if length(a) < DIRECTIONLESS or length(b) < DIRECTIONLESS:
        return 0.0
    return math.atan2(length(cross(a, b)), float(a @ b))


def signed_angle(a: Array, b: Array, axis: Array) -> float:
    """Angle in -pi..pi of the rotation about the unit `axis` from `a` to `b` in projection."""
    a, b = across(a, axis), across(b, axis)
    if length(a) < DIRECTIONLESS or length(b) < DIRECTIONLESS:
        return 0.0
    return math.atan2(float(axis @ cross(a, b)), float(a @ b))


def interior_angle(a: float, b: float, distance_squared: float) -> float:
    """Angle between the sides `a` and `b` of a triangle; pi where a side has no length."""
    if 2.0 * a * b < DIRECTIONLESS**2:
        return math.pi
    return math.acos(clip((a * a + b * b - distance_squared) / (2.0 * a * b), -1.0, 1.0))


def multiply(a: Array, b: Array) -> Array:
    """Hamilton product: the rotation `b` first, then `a`."""
    (aw, ax, ay, az), (bw, bx, by, bz) = a.tolist(), b.tolist()
    return np.array(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )


def inverse(q: Array) -> Array:
    """The inverse of a unit quaternion."""
    return np.array([q[0], -q[1], -q[2], -q[3]])


def rotate(q: Array, v: Array) -> Array:
    """`v` rotated by `q`."""
    w, xyz = q[0], q[1:]
    twice = 2.0 * cross(xyz, v)
    return v + w * twice + cross(xyz, twice)


def conjugate(q: Array, by: Array) -> Array:
    """`by` q `by`^-1: the rotation `q`, expressed in the space that `by` leads to."""
    return multiply(multiply(by, q), inverse(by))


def from_axis_angle(axis: Array, angle: float) -> Array:
    """Rotation by `angle` about the unit `axis`."""
    return np.concatenate([[math.cos(angle / 2)], math.sin(angle / 2) * axis])


def from_rotvec(vector: Array) -> Array:
    """Rotation about `vector` by its length in radians."""
    angle = length(vector)
    return IDENTITY if angle == 0.0 else from_axis_angle(vector / angle, angle)


def shortest_arc(a: Array, b: Array, spare_axis: Array) -> Array:
    """Shortest rotation from unit `a` to unit `b`; opposite ones rotate about `spare_axis`.

    Of `spare_axis` the part at right angles to `a` is used; if it has none, any such axis.
    """
    axis = cross(a, b)
    if length(axis) >= DIRECTIONLESS:
        return from_axis_angle(axis / length(axis), angle_between(a, b))
    if a @ b > 0.0:
        return IDENTITY
    square = across(spare_axis, a)
    if length(square) < DIRECTIONLESS:
        square = across(np.eye(3)[np.argmin(np.abs(a))], a)
    return from_axis_angle(square / length(square), math.pi)


def nlerp(a: Array, b: Array, weight: float) -> Array:
    """Normalized linear interpolation from `a` to `b`, the shorter way."""
    if a @ b < 0.0:
        b = -b
    blend = a + weight * (b - a)
    return blend / math.sqrt(float(blend @ blend))


def lerp(a: float, b: float, weight: float) -> float:
    """`a` at weight 0, `b` at weight 1."""
    return a + weight * (b - a)


def clip(value: float, low: float, high: float) -> float:
    """`value` limited to [low, high]; where the limits cross, the upper one wins."""
    return min(max(value, low), high)


def fraction_of_half_life(half_life: float, dt: float) -> float:
    """Fraction of the gap closed in `dt` s; a half-life <= 0 s jumps, an infinite one stays."""
    return 1.0 if half_life <= 0.0 else 1.0 - 2.0 ** (-dt / half_life)


def move_by_speed(value: float, goal: float, speed: float, dt: float) -> float:
    """The clamped-speed law: `value` moved by `dt * speed`, at most 1, of the way to `goal`.

    A speed <= 0 jumps, and so does a gap below `JUMP` m.
    """
    if speed <= 0.0 or abs(goal - value) < JUMP:
        return goal
    return value + clip(dt * speed, 0.0, 1.0) * (goal - value)


def half_life_of_gain(gain: float, tick_hz: float) -> float:
    """Half-life in s of a gain per tick; 0 for a gain of 1 or more, infinite for 0."""
    if gain >= 1.0:
        return 0.0
    if gain == 0.0:
        return math.inf
    return math.log(0.5) / math.log(1.0 - gain) / tick_hz


def follow(before: Motion | None, goal: float, half_life: float, dt: float, spring: bool) -> Motion:
    """The number after `dt` s: an exponential, or a critically damped spring to a fixed goal.

    The spring is `goal + (a + b t) e^(-w t)` with `w = 2 ln 2 / half_life`. Without a number
    before, it starts on the goal at rest. A half-life <= 0 s jumps.
    """
    if before is None or half_life <= 0.0:
        return Motion(goal, 0.0)
    if not spring:
        return Motion(lerp(before.value, goal, fraction_of_half_life(half_life, dt)), 0.0)
    w = 2.0 * math.log(2.0) / half_life
    a = before.value - goal
    b = before.velocity + w * a
    left = math.exp(-w * dt)
    return Motion(goal + (a + b * dt) * left, (b - w * (a + b * dt)) * left)


def smooth01(x: float) -> float:
    """The smoothstep cubic from 0 at 0 to 1 at 1, constant beyond."""
    x = clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def move_towards(value: float, goal: float, step: float) -> float:
    """`value` moved towards `goal` by at most `step`."""
    return clip(goal, value - step, value + step)


def apply(transform: Transform, point: Array) -> Array:
    """`point` taken from the inner to the outer space of `transform`."""
    return transform.pos + rotate(transform.rot, point)


def unapply(transform: Transform, point: Array) -> Array:
    """`point` taken from the outer to the inner space of `transform`."""
    return rotate(inverse(transform.rot), point - transform.pos)
