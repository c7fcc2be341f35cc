"""Where a swinging foot will land, in plain NumPy: one foot, one frame at a time.

Written from the description of the rule. Metres, radians, seconds, world space.
"""

import math
from dataclasses import dataclass

import numpy as np

from reference import maths
from reference.characters import Frame, Rig
from reference.maths import Array, apply, length, lerp

TOES_DOWN, LEVEL, LAST = 0.25, 0.7, 0.98


@dataclass
class Swing:
    """Memory of one foot."""

    planted: bool
    time: float
    fraction: float
    lowest: float
    travelled: Array
    ball_from_root: Array
    velocity: Array


def ramp(x: float) -> float:
    x = min(max(x, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)


def share(half_life: float, dt: float) -> float:
    return 1.0 - 0.5 ** (dt / half_life)


def level(v: Array, up: Array) -> Array:
    return v - up * (v @ up)


def duration(time: float, fraction: float, usual: float) -> float:
    so_far = min(max(time / max(fraction, TOES_DOWN), 0.5 * usual), 2.0 * usual)
    return lerp(usual, so_far, ramp((fraction - TOES_DOWN) / 0.1))


def follow(
    parameters: dict[str, float],
    rig: Rig,
    frame: Frame,
    leg: int,
    planted: bool,
    up: Array,
    before: Swing | None,
) -> tuple[Swing, Array, Array]:
    """Memory after the frame, and where the foot last stood and will stand."""
    stance, usual = parameters["probe.stance_time"], parameters["probe.swing_time"]
    world, dt = frame.world_from_model, float(frame.dt)
    ball, hip, ankle = (apply(world, x.pos[leg]) for x in (frame.toe, frame.hip, frame.ankle))
    rot = maths.multiply(frame.ankle.rot[leg], rig.ankle_from_foot[leg])
    sole = maths.rotate(world.rot, maths.rotate(rot, maths.Z))
    pitch = math.asin(min(max(float(sole @ up), -1.0), 1.0))
    velocity, from_root = np.asarray(frame.travel_ws), ball - world.pos

    if before is None:
        flat = level(velocity, up)
        ahead = float((ankle - hip) @ flat / (flat @ flat)) if flat @ flat > 0 else 0.0
        ahead = min(max(ahead, -0.5 * stance), 0.5 * stance)
        fraction = 0.5 + ahead / stance
        if pitch > 0:
            fraction = max(fraction, LEVEL)
        since_last = 0.5 * stance + ahead + fraction * usual
        time, lowest, moved = dt + fraction * usual, pitch, level(velocity * dt, up)
        travelled, smooth, landed = since_last * flat, velocity, False
    else:
        moved = level(from_root - before.ball_from_root + velocity * dt, up)
        travelled = before.travelled + moved
        smooth = before.velocity + share(0.1, dt) * (velocity - before.velocity)
        time, lowest, landed = before.time + dt, min(before.lowest, pitch), not before.planted
        fraction = turned(before, dt, pitch, lowest, usual)
    if planted:
        # Only a foot that comes from elsewhere has a new foothold.
        stays = 1.0 - ramp((length(travelled) - 0.04) / 0.04) if landed or before is None else 1.0
        travelled = travelled * stays * (1.0 - share(0.3, dt))
        if before is None:
            travelled = np.zeros(3)
        time, fraction, lowest = 0.0, 0.0, pitch
    swing = Swing(planted, time, fraction, lowest, travelled, from_root, smooth)
    lasts = duration(time, fraction, usual)
    by_hip = hip + smooth * ((1.0 - fraction) * lasts + 0.5 * stance)
    x = max(fraction, 0.3)
    covered = 10 * x**3 - 15 * x**4 + 6 * x**5
    speed = 30 * x**2 * (1 - x) ** 2  # of a minimum-jerk motion over the unit way in unit time
    by_ball = ball + moved / dt * lasts * (1.0 - covered) / speed
    return swing, ball - travelled, by_hip + ramp((fraction - 0.3) / 0.4) * (by_ball - by_hip)


def turned(before: Swing, dt: float, pitch: float, lowest: float, usual: float) -> float:
    """How far the swing is, by time and by the pitch of the sole."""
    pitched = min(max(-lowest / 0.5, 0.0), 1.0)
    back = ramp((pitch - lowest) / 0.05)
    latest = LAST - pitched * (1.0 - back) * (LAST - TOES_DOWN)
    lasts = duration(before.time, before.fraction, usual)
    fraction = min(before.fraction + dt / lasts, latest)
    if pitch < 0:
        level_by = min(max(pitch / lowest, 0.0), 1.0)
        by_pitch = LEVEL - (LEVEL - TOES_DOWN) * level_by
        weight = back * pitched * ramp(level_by / 0.2)
        fraction = lerp(fraction, by_pitch, weight * share(0.035, dt))
    return max(fraction, before.fraction)
