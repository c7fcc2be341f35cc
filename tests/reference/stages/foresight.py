"""Where a swinging foot will land, in plain NumPy: one foot, one frame at a time.

Written from the description of the rule. Metres, radians, seconds, world space.
"""

import math
from dataclasses import dataclass

import numpy as np

from reference import maths
from reference.characters import Frame, Rig
from reference.maths import Array, across, apply, clip, length, lerp, smooth01

TOES_DOWN, LEVEL, LAST = 0.25, 0.7, 0.98
GRAVITY = 9.81


@dataclass
class Swing:
    """Memory of one foot."""

    planted: bool
    time: float
    fraction: float
    lowest: float
    further: float
    whole: bool
    travelled: Array
    first_way: Array
    ball_from_root: Array
    velocity: Array
    facing: Array
    turning: Array
    """Angular velocity."""
    usual: float
    """Of its swings."""
    lead: float
    """From landing until the hip is over the ball."""
    missed: float = 1.0
    """By what part of its way its last step landed elsewhere than foreseen as it began."""
    landed: float = 0.0
    """How far it has landed in this frame, after a swing that was seen from its start."""


def duration(time: float, fraction: float, usual: float) -> float:
    so_far = clip(time / max(fraction, TOES_DOWN), 0.5 * usual, 2.0 * usual)
    return lerp(usual, so_far, smooth01((fraction - TOES_DOWN) / 0.1))


def as_foreseen(changed: float) -> float:
    return 1.0 - smooth01((changed - 0.08) / 0.12)


def regularity(swings: list[Swing]) -> float:
    """How far all feet last landed as foreseen."""
    return min(as_foreseen(swing.missed) for swing in swings)


def take_first_steps(swings: list[Swing]) -> None:
    """Feet that know nothing from steps of their own take the times of those that land now."""
    landed = sum(swing.landed for swing in swings)
    if landed == 0.0:
        return
    usual = sum(swing.landed * swing.usual for swing in swings) / landed
    lead = sum(swing.landed * swing.lead for swing in swings) / landed
    for swing in swings:
        share = smooth01((swing.missed - 0.9) / 0.1) * (1.0 - swing.landed) * min(landed, 1.0)
        swing.usual, swing.lead = lerp(swing.usual, usual, share), lerp(swing.lead, lead, share)


def follow(
    parameters: dict[str, float],
    rig: Rig,
    frame: Frame,
    leg: int,
    planted: bool,
    up: Array,
    ball_height: float,
    before: Swing | None,
    regular: float,
) -> tuple[Swing, Array, Array]:
    """Memory after the frame, and where the foot last stood and will stand.

    `ball_height` is that of the ball of a foot that stands flat, `regular` the feet's `regularity`
    in the frame before.
    """
    stance, usual = parameters["probe.stance_time"], parameters["probe.swing_time"]
    bounds = 0.5 * usual, 2.0 * usual
    world, dt = frame.world_from_model, float(frame.dt)
    ball, hip, ankle = (apply(world, x.pos[leg]) for x in (frame.toe, frame.hip, frame.ankle))
    rot = maths.multiply(frame.ankle.rot[leg], rig.ankle_from_foot[leg])
    sole = maths.rotate(world.rot, maths.rotate(rot, maths.Z))
    pitch = math.asin(clip(float(sole @ up), -1.0, 1.0))
    velocity, from_root = np.asarray(frame.travel_ws), ball - world.pos
    facing = maths.rotate(world.rot, maths.Z)
    at_hip, at_knee, at_ankle = (x.pos[leg] for x in (frame.hip, frame.knee, frame.ankle))
    leg_length = length(at_knee - at_hip) + length(at_ankle - at_knee)

    if before is None:
        flat = across(velocity, up)
        ahead = float((ankle - hip) @ flat / (flat @ flat)) if flat @ flat > 0 else 0.0
        ahead = clip(ahead, -0.5 * stance, 0.5 * stance)
        fraction = 0.5 + ahead / stance
        if pitch > 0:
            fraction = max(fraction, LEVEL)
        since_last = 0.5 * stance + ahead + fraction * usual
        time, lowest, moved = dt + fraction * usual, pitch, across(velocity * dt, up)
        travelled, smooth = since_last * flat, velocity
        further, whole, missed = 0.0, False, 1.0
        turning, lead = np.zeros(3), 0.5 * stance
    else:
        usual, lead, missed = before.usual, before.lead, before.missed
        moved = across(from_root - before.ball_from_root + velocity * dt, up)
        travelled = before.travelled + moved
        smoothing = maths.fraction_of_half_life(0.1, dt)
        smooth = before.velocity + smoothing * (velocity - before.velocity)
        turn = np.cross(before.facing, facing) / dt
        turning = before.turning + smoothing * (turn - before.turning)
        time, lowest = before.time + dt, min(before.lowest, pitch)
        flat = across(smooth, up)
        runs = smooth01((float(flat @ flat) / (GRAVITY * leg_length) - 0.4) / 0.3)
        ahead = maths.unit(across(sole, up), facing)
        back = smooth01(-float(flat @ ahead) / math.sqrt(GRAVITY * leg_length) / 0.1)
        walks = (1.0 - runs) * (1.0 - back)
        pitched = clip(-lowest / 0.5, 0.0, 1.0) * walks
        by_time = 0.7 * regular if before.whole else 0.0
        fraction = turned(before, dt, pitch, lowest, usual, pitched * (1.0 - by_time))
        at_speed = by_motion(time, travelled, moved, dt)
        over_floor = float(from_root @ up) - ball_height
        lowest_point = max(min(over_floor, over_floor - math.sin(pitch) * rig.foot), 0.0)
        sinking = float((before.ball_from_root - from_root) @ up) / dt
        if sinking > 0:
            rest = 1.5 * lowest_point / sinking / duration(time, fraction, usual)
            sunk = max(LAST * (1.0 - rest), 0.0)
            both = 1.0 - 1.25 * (1.0 - min(sunk, at_speed))
            share = smooth01((fraction - 0.3) / 0.15) * maths.fraction_of_half_life(0.02, dt)
            fraction += share * max(lerp(sunk, both, pitched) - fraction, 0.0)
        beyond = clip(at_speed - fraction, -0.15, 0.15)
        beyond *= 0.6 * before.whole * smooth01((fraction - 0.3) / 0.15)
        correction = maths.fraction_of_half_life(0.035, dt)
        further, whole = lerp(before.further, beyond, correction), before.whole
    landed = 0.0
    if planted:
        if before is None:
            travelled = np.zeros(3)
        elif not before.planted:  # only a foot that comes from elsewhere has a new foothold
            away = smooth01((length(travelled) - 0.04) / 0.04)
            miss = length(travelled - before.first_way)
            if away > 0.0 and before.whole:
                missed = lerp(missed, min(miss / length(travelled), 1.0), away)
            travelled = travelled * (1.0 - away)
            if before.whole:  # 70 % of a step count for the next
                landed = away
                flat = across(smooth, up)
                last_lead = float((ball - hip) @ flat / (flat @ flat)) if flat @ flat > 0 else 0.0
                lead = lerp(lead, clip(last_lead, 0.0, stance), 0.7 * away)
                usual = lerp(usual, clip(time, *bounds), 0.7 * away)
        travelled = travelled * (1.0 - maths.fraction_of_half_life(0.3, dt))
        time, fraction, lowest, further, whole = 0.0, 0.0, pitch, 0.0, True
    swing = Swing(
        planted,
        time,
        fraction,
        lowest,
        further,
        whole,
        travelled,
        np.zeros(3),
        from_root,
        smooth,
        facing,
        turning,
        usual,
        lead,
        missed,
        landed,
    )
    fraction = clip(fraction + further, 0.0, LAST)
    lasts = duration(time, fraction, usual)
    until = (1.0 - fraction) * lasts
    speed = length(across(smooth, up))
    until += lead if speed * lead < 0.5 * leg_length else 0.5 * leg_length / speed
    ahead_ws = max(float(smooth @ facing), 0.0) * facing
    angle = turning * until
    bend = np.cross(angle, ahead_ws * until) / (2.0 + float(angle @ angle) / 6.0)
    by_hip = hip + smooth * until + bend
    x = max(fraction, 0.3)
    covered = 10 * x**3 - 15 * x**4 + 6 * x**5
    pace = 30 * x**2 * (1 - x) ** 2  # of a minimum-jerk motion over the unit way in unit time
    by_ball = ball + moved / dt * lasts * (1.0 - covered) / pace
    last = ball - travelled
    following = by_hip + smooth01((fraction - 0.3) / 0.4) * (by_ball - by_hip)
    if planted:
        swing.first_way = across(following - last, up)
    elif before is not None:
        swing.first_way = before.first_way
    return swing, last, following


def sureness(swing: Swing, way: Array, regular: float) -> float:
    """How sure a swing is to lead there, level from its last foothold, at this `regularity`."""
    as_before = as_foreseen(length(way - swing.first_way) / length(way)) if way @ way else 1.0
    as_before *= swing.whole
    sure = smooth01((swing.fraction + 0.24 * as_before - 0.7) / 0.18)
    return 1.0 - (1.0 - sure) * (1.0 - as_before * regular)


def by_motion(time: float, travelled: Array, moved: Array, dt: float) -> float:
    """How far a swing of minimum jerk is that has this speed, by bisection."""
    middle, since = travelled - 0.5 * moved, time - 0.5 * dt
    if not middle @ middle > 0.0:
        return 1.0 * time / since  # 30 (1 - x)^2 is 0
    wanted = clip(float(moved @ middle) / dt * since / float(middle @ middle), 0.0, 3.0)
    low, high = 0.0, 1.0
    for _ in range(60):
        x = 0.5 * (low + high)
        if 30 * (1 - x) ** 2 > wanted * (10 - 15 * x + 6 * x**2):
            low = x
        else:
            high = x
    return low * time / since


def turned(
    before: Swing, dt: float, pitch: float, lowest: float, usual: float, pitched: float
) -> float:
    """How far the swing is, by time and, so far as it counts, by the pitch of the sole."""
    back = smooth01((pitch - lowest) / 0.05)
    latest = LAST - pitched * (1.0 - back) * (LAST - TOES_DOWN)
    lasts = duration(before.time, before.fraction, usual)
    fraction = min(before.fraction + dt / lasts, latest)
    if pitch < 0:
        level_by = clip(pitch / lowest, 0.0, 1.0)
        by_pitch = LEVEL - (LEVEL - TOES_DOWN) * level_by
        weight = back * pitched * smooth01(level_by / 0.2)
        fraction = lerp(fraction, by_pitch, weight * maths.fraction_of_half_life(0.035, dt))
    return max(fraction, before.fraction)
