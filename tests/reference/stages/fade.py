"""How foot IK fades in and out, in plain NumPy: one character, one frame at a time.

It takes what the other stages want in a frame, and says what the body and the legs get. Everything
is in world space.
"""

import math
from dataclasses import dataclass

import numpy as np

from reference import maths
from reference.maths import Array, length, multiply, rotate

FADING = 0.1  # of a weight
SETTLED = 0.005  # m


@dataclass
class Wish:
    """What the other stages want in this frame, and what limits depend on; legs first."""

    dt: float
    up: Array
    weights: Array
    hips: Array
    ankles: Array
    ankle_rots: Array
    balls: Array
    targets: Array
    target_rots: Array
    tilts: Array  # how far each foot turns to the ground, as the length of the normal less up
    reach: Array  # thigh and shin, m
    lift: Array  # offset of the root, m
    offset: Array  # of the body, m
    rot: Array  # of the body


@dataclass
class Memory:
    """What has faded in so far."""

    weights: Array
    offset: Array
    rot: Array
    lag: float
    hip_height: float
    fall: float


def step(speed: float, wish: Wish, before: Memory | None) -> Memory:
    """Memory after one frame: `weights`, `offset` and `rot` are what legs and body get."""
    hip_height = float(np.mean(wish.hips - wish.lift, axis=0) @ wish.up)
    offset, rot = wish.offset, wish.rot
    if before is None:
        return Memory(wish.weights, offset, rot, 0.0, hip_height, 0.0)
    unfaded = max(abs(wish.weights - before.weights))
    falling = max((before.hip_height - hip_height) / wish.dt, 0.0)
    landing = before.fall * min(unfaded / FADING + before.lag / SETTLED, 1.0)
    fall = max(falling * (1.0 - max(wish.weights)), landing)
    limit = max(speed, fall - falling) * wish.dt

    body_limit = limit * (1.0 - 0.5 * min(unfaded / FADING, 1.0))
    reach = float(np.max(wish.reach))
    gap = length(offset - before.offset) + reach * angle_of(
        multiply(rot, maths.inverse(before.rot))
    )
    lag = min(max(gap - body_limit, 0.0), max(reach * unfaded, before.lag - body_limit))
    if lag > 0:
        offset = before.offset + (offset - before.offset) * (1.0 - lag / gap)
        rot = maths.nlerp(before.rot, rot, 1.0 - lag / gap)

    weights = []
    for leg, weight in enumerate(before.weights):
        budget = limit - (1.0 - weight) * min(gap, body_limit) / 2.0
        size = correction(wish, leg, offset, rot, weight)
        largest = budget / size if size > 1e-6 else 1.0
        weights.append(maths.move_towards(weight, wish.weights[leg], largest))
    return Memory(np.array(weights), offset, rot, lag, hip_height, fall)


def angle_of(rot: Array) -> float:
    """Of a rotation by at most pi."""
    return 2.0 * math.atan2(length(rot[1:]), abs(rot[0]))


def correction(wish: Wish, leg: int, offset: Array, rot: Array, weight: float) -> float:
    """How far ankle and ball of a leg move per unit of its weight, m, at most."""
    pivot, reach = np.mean(wish.hips, axis=0), wish.reach[leg]
    hip, ankle = (
        pivot + offset + rotate(rot, point - pivot) for point in (wish.hips[leg], wish.ankles[leg])
    )
    to_target = wish.targets[leg] - hip
    if length(to_target) > reach:
        to_target = to_target * reach / length(to_target)
    way = length(hip + to_target - ankle)
    from_middle = abs(2.0 * weight - 1.0)
    turn = multiply(wish.target_rots[leg], maths.inverse(multiply(rot, wish.ankle_rots[leg])))
    leg_turn = way / reach + math.sqrt(2.0 * way / reach)
    arm = length(wish.balls[leg] - wish.ankles[leg])
    foot_turn = angle_of(turn) + wish.tilts[leg]
    return way * (1.0 + from_middle) + arm * (from_middle * leg_turn + foot_turn)
