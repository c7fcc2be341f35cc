"""Where a swinging foot will land, from its own motion so far: for animations without footholds."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxik.maths import quat, smoothing, vec
from jaxik.maths.gate import HARD, AbstractGate
from jaxik.maths.struct import place, struct
from jaxik.stages.inputs import GRAVITY, Inputs, Moment
from jaxik.world.frame import FORWARD, Contact, Frame, Stride, animated_ankles
from jaxik.world.skeleton import Rig

from .base import foot_heading

TIME_BAND = 0.02  # s
# How far a swing is when its toes point down most, and when its sole is level again before it
# lands: measured on people who walk.
TOES_DOWN, LEVEL = 0.25, 0.7
TURN = 0.05  # rad, by which a sole must have turned back before its toes count as down most
WAITS = 0.2  # of its lowest pitch, up to which a sole that is nearly level may wait for the ground
PITCHED = 0.5  # rad, of a sole, from which its pitch tells how far the swing is
# Squared speed over gravity and length of the legs (Froude number), up to which people walk and
# from which they run (Alexander 1989: from one to the other at 0.5).
WALKS, RUNS = 0.4, 0.7
BACK = 0.1  # root of that number from which one walks backwards
LAST = 0.98  # of a swing, where it waits for a foot that lands late
CORRECTION = 0.035  # s, half-life with which the fraction of a swing goes to what the pitch says
SINKING = 0.02  # s, half-life with which it goes to what the height of the sole says
LONGER = 1.25  # times the rest of a swing by its height and motion, where its pitch tells, too
SETTLED = 0.3  # s, half-life with which a foothold follows a standing ball that slides
NEAR = 0.04  # m, from the last foothold, up to which a foot has not left it
STEADY = 0.1  # s, half-life with which the character's velocity is smoothed
EARLY, LATE = 0.3, 0.7  # of a swing, between which the foot's own motion takes over from the hip's
UNSURE, SURE = 0.7, 0.88  # of a swing, between which a foot chooses where it will land
EARLIER = 0.24  # of a swing, by how much earlier it chooses if the swing goes as foreseen
# Of its way: where it leads has changed by less since it began, or by more.
AS_FORESEEN, OTHERWISE = 0.08, 0.2
NOWHERE = 0.9  # of its way, from which a step that lands as far from it tells nothing of the next
BY_MOTION = 0.6  # how far the motion of the ball counts, beside time and pitch of the sole
FARTHEST = 0.15  # of a swing, by which it may differ from these
FRACTION_BAND = 0.02  # of a swing
SHORTEST, LONGEST = 0.5, 2.0  # duration of a swing, over the usual one
LEARNT = 0.7  # of a step, that counts for the next one of its foot
AHEAD = 0.5  # of the length of its leg, how far ahead of its hip a ball lands at most


@struct
class Feet:
    """What one frame shows of the feet and of what carries them."""

    up_ws: Float[Array, "*legs 3"]
    velocity_ws: Float[Array, "3"]
    """m/s, of the character over the ground."""
    facing_ws: Float[Array, "3"]
    """Unit, where the character faces."""
    from_root_ws: Float[Array, "legs 3"]
    """m, from the character's root to each animated ball."""
    ball_ws: Float[Array, "legs 3"] = place("point")
    """Metres."""
    hip_ws: Float[Array, "legs 3"] = place("point")
    """Metres."""
    ahead: Float[Array, " legs"]
    """s, in which the hip arrives over the ankle at its velocity now."""
    pitch: Float[Array, " legs"]
    """rad, of the animated sole, toes up."""
    height: Float[Array, " legs"]
    """m, of its lowest point over the animation's floor."""
    planted: Float[Array, " legs"]
    ahead_ws: Float[Array, "legs 3"]
    """Unit, horizontal direction of each animated foot."""
    foot_height: Float[Array, "*legs"]
    """m, of the ankles over the soles."""
    frame: Frame
    rig: Rig


@struct
class Swings:
    """How far each foot is in its swing, and from where."""

    planted: Float[Array, " legs"]
    time: Float[Array, " legs"]
    """s, since it last stood."""
    fraction: Float[Array, " legs"]
    """0..1, how far the swing is; 0 while it stands."""
    further: Float[Array, " legs"]
    """By how much further the swing is where the motion of the ball counts, too."""
    whole: Float[Array, " legs"]
    """1 if the swing has been seen from its start, or the foot stands."""
    lowest: Float[Array, " legs"]
    """rad, the lowest pitch of the sole in this swing."""
    travelled_ws: Float[Array, "legs 3"]
    """m, horizontal, from its last foothold to the ball; in a stance, by how far it slides."""
    first_way_ws: Float[Array, "legs 3"]
    """m, horizontal, from its last foothold to the next, as foreseen when it last stood."""
    from_root_ws: Float[Array, "legs 3"]
    """m, from the character's root to each animated ball, in the frame before."""
    velocity_ws: Float[Array, "3"]
    """m/s, of the character over the ground, smoothed."""
    facing_ws: Float[Array, "3"]
    """Unit, where the character faced in the frame before."""
    turning_ws: Float[Array, "3"]
    """rad/s, of the character, smoothed."""
    swing_time: Float[Array, " legs"]
    """s, how long each foot swings, as its last steps did."""
    lead: Float[Array, " legs"]
    """s, from when it lands until its hip is over its ball, as in its last steps."""
    missed: Float[Array, " legs"]
    """0..1 of the way of its last step, how far from where it was expected each foot landed."""


def no_swings(rig: Rig) -> Swings:
    """Memory before the first frame."""
    zero = jnp.zeros_like(rig.side)
    offset = jnp.zeros((*zero.shape, 3), zero.dtype)
    still, one = offset[0], jnp.ones_like(zero)
    numbers = zero, zero, zero, zero, zero, zero
    return Swings(*numbers, offset, offset, offset, still, still, still, zero, zero, one)


@struct
class Plan:
    """The ground on which each foot will land, and how far it goes aside for that."""

    last_ws: Float[Array, "legs 3"]
    """m, from where the animated foot stood to its last foothold."""
    slide: Float[Array, " legs"]
    """m, ahead, from where the animated foot will stand to the next."""
    left: smoothing.Deviation
    """m, m/s and m/s² (legs), what is left of the jumps of that; of `last_ws` in a stance."""
    moved_ws: Float[Array, "legs 3"]
    """m, of the foot in this frame from the animated foot."""
    height: Float[Array, " legs"] = place("leg height")
    """m, of the tread."""
    share: Float[Array, " legs"]
    """0..1, of the sole that the tread supports."""
    last_share: Float[Array, " legs"]
    """The same of the last foothold."""


def no_plan(rig: Rig) -> Plan:
    """Memory before the first frame."""
    zero = jnp.zeros_like(rig.side)
    offset = jnp.zeros((*zero.shape, 3), zero.dtype)
    return Plan(offset, zero, smoothing.Deviation(zero, zero, zero), offset, zero, zero, zero)


@struct
class Foresight:
    """Memory of swings and of where they lead."""

    swings: Swings
    plan: Plan


@struct
class PlannedStride(Stride):
    """A stride of feet that were sent to ground that holds them."""

    moved_ws: Float[Array, "legs 3"] | None = None
    """m, of each foot from the animated one; 0 where the stride is known."""
    support: Float[Array, " legs"] | None = None
    """0..1, share of the sole that is supported."""
    sure: Float[Array, " legs"] | None = None
    """0..1, how sure the next foothold is."""
    until: Float[Array, " legs"] | None = None
    """s, until the foot lands; 0 while it stands."""


def sureness(feet: Feet, swings: Swings, next_ws: Array) -> Float[Array, " legs"]:
    """0..1, how sure it is where swings lead: late in them, earlier if that has hardly changed.

    Of people on uneven ground, feet land 15 to 20 cm from where half of their swing leads; on a
    walk that goes on as it is, 3 cm, and it has led there all the time. Where all feet have landed
    as foreseen, a swing is sure from its start.

    Args:
        feet: what the frame shows.
        swings: how far the feet are.
        next_ws: where each will stand next, m, world space.
    """
    goes_as_foreseen = _as_foreseen(_changed(_way(feet, swings, next_ws), swings))
    fraction = swings.fraction + EARLIER * swings.whole * goes_as_foreseen
    sure = smoothing.smoothstep((fraction - UNSURE) / (SURE - UNSURE))
    from_start = goes_as_foreseen * _regularity(swings, feet.rig)
    return smoothing.lerp(sure, jnp.ones_like(sure), from_start)


def _regularity(swings: Swings, rig: Rig) -> Float[Array, " legs"]:
    """0..1, how far each foot's swing is one of a gait in which all feet land as foreseen."""
    landed = jnp.where(rig.present, _as_foreseen(swings.missed), 1.0)
    return swings.whole * HARD.minimum(landed, band=0.0)


def _as_foreseen(changed: Array) -> Array:
    """0..1, how far what has changed by a part of its way is as it was foreseen."""
    return 1.0 - smoothing.smoothstep((changed - AS_FORESEEN) / (OTHERWISE - AS_FORESEEN))


def _changed(way_ws: Array, swings: Swings) -> Float[Array, " legs"]:
    """Of its way, by how much each differs from what was foreseen as the swing began."""
    return vec.safe_divide(vec.length(way_ws - swings.first_way_ws), vec.length(way_ws))


def _way(feet: Feet, swings: Swings, next_ws: Array) -> Float[Array, "legs 3"]:
    """From the last foothold of each foot to the next, m, horizontal."""
    return vec.reject(next_ws - feet.ball_ws, feet.up_ws) + swings.travelled_ws


def watch(inputs: Inputs, contact: Contact, foot_height: Array) -> Feet:
    """What this frame shows of the feet."""
    frame, up = inputs.frame, inputs.terrain.leg_up_ws
    world, ankle = frame.world_from_model, animated_ankles(frame)
    hip, ball = world.apply(frame.pose.hip.pos), world.apply(frame.pose.toe.pos)
    sole = quat.rotate(
        quat.multiply(ankle.rot, inputs.rig.ankle_from_foot), vec.constant(FORWARD, ball)
    )
    rises = vec.dot(sole, up)
    ball_height = vec.dot(ball - world.pos, up) - inputs.rig.ball_height
    heel_height = ball_height - rises * inputs.rig.foot
    height = jnp.where(heel_height < ball_height, heel_height, ball_height)
    return Feet(
        up_ws=up,
        velocity_ws=frame.velocity_ws,
        facing_ws=quat.rotate(world.rot, vec.constant(FORWARD, world.pos)),
        from_root_ws=ball - world.pos,
        ball_ws=ball,
        hip_ws=hip,
        ahead=time_ahead(vec.reject(frame.velocity_ws, up), ankle.pos - hip),
        pitch=vec.safe_arctan2(rises, vec.length(vec.reject(sole, up))),
        height=jnp.where(height > 0, height, 0.0),
        planted=contact.planted,
        ahead_ws=foot_heading(inputs)[0],
        foot_height=foot_height,
        frame=frame,
        rig=inputs.rig,
    )


def time_ahead(velocity_ws: Array, way_ws: Array) -> Float[Array, "*legs"]:
    """s, in which something at this horizontal velocity, m/s, covers a way, m; 0 if it stands."""
    return vec.safe_divide(vec.dot(way_ws, velocity_ws), vec.dot(velocity_ws, velocity_ws))


@struct
class Instant:
    """Where feet are in their strides, if they pass their hips in the middle of both phases."""

    fraction: Float[Array, "*legs"]
    """0..1, time of the swing that has passed; 0 while standing."""
    since_last: Float[Array, "*legs"]
    """s, since the ball was at its last foothold, if it moved with the character."""
    until_next: Float[Array, "*legs"]
    """s, until it is at its next, likewise."""


def instant(
    ahead: Array, planted: Array, stance_time: Array, swing_time: Array, gate: AbstractGate
) -> Instant:
    """Where feet are in their strides by a single frame (Raibert 1986).

    Args:
        ahead: s, in which the hip arrives over the ankle.
        planted: whether the foot stands.
        stance_time: s, how long it stands, from as far ahead of the hip to as far behind it.
        swing_time: s, how long it swings.
        gate: how it is decided.
    """
    half = 0.5 * stance_time
    ahead = gate.clip(ahead, -half, half, band=TIME_BAND)
    fraction = 0.5 + ahead / stance_time
    zero = jnp.zeros_like(fraction)
    fraction = gate.choose(planted, zero, fraction)
    since_last = gate.choose(planted, zero, half + ahead + fraction * swing_time)
    until_next = half - ahead + (1.0 - fraction) * swing_time
    until_next = gate.choose(planted, zero + stance_time + swing_time, until_next)
    return Instant(fraction, since_last, until_next)


def follow_swings(
    now: Moment, feet: Feet, before: Swings, stance_time: Array, swing_time: Array
) -> tuple[Swings, Float[Array, "legs 3"]]:
    """Memory after this frame, and where each foot will stand next, m, world space.

    A swing goes on with time. Once the toes of one who walks have pointed down most, the pitch of
    the sole says how far it is, since the sole turns evenly until it is level again; from then on
    the swing goes on at the pace that it had. Toes of one who runs or walks backwards point down
    most at other times, and some soles stay level; there the height of the sole, once it sinks,
    says when it lands. Where the pitch tells, too, a swing is taken to be further than that only if
    both the height of the sole and the speed of the ball say so.

    At first a foot is expected as far ahead of its hip as it will be when it lands, later where its
    own motion takes it, which slows down as a minimum-jerk motion does (Flash and Hogan 1985). For
    how far it still goes, its pace counts as well as its pitch.

    How long a foot swings, and how early it lands before its hip is over it, are the usual times at
    first, then those of another foot that has made a step, then more and more those of its own
    steps. Where all feet landed as foreseen in their last steps, a swing goes by that time, as far
    as it is learnt, rather than by its pitch.

    Args:
        now: the frame.
        feet: what it shows.
        before: memory.
        stance_time: s, how long a foot usually stands.
        swing_time: s, how long it usually swings.
    """
    gate, dt = now.gate, now.dt
    guess = _first_guess(feet, stance_time, swing_time, gate)
    steady = now.progress(smoothing.fraction_of_half_life(jnp.asarray(STEADY, dt.dtype), dt))
    velocity = smoothing.lerp(before.velocity_ws, feet.velocity_ws, steady)
    turn = vec.cross(before.facing_ws, feet.facing_ws)
    turning = jnp.where(now.started, vec.safe_divide(turn, dt), 0.0)
    turning = smoothing.lerp(before.turning_ws, turning, steady)
    moved = jnp.where(now.started, feet.from_root_ws - before.from_root_ws, 0.0)
    moved = vec.reject(moved + vec.scale(feet.velocity_ws, dt), feet.up_ws)

    time = before.time + dt
    time = jnp.where(now.started, time, dt + guess.fraction * swing_time)
    lowest = jnp.where(feet.pitch < before.lowest, feet.pitch, before.lowest)
    lowest = jnp.where(now.started, lowest, feet.pitch)
    start_ws = vec.scale(vec.reject(feet.velocity_ws, feet.up_ws), guess.since_last)
    travelled = jnp.where(now.started, before.travelled_ws + moved, start_ws)
    # A foot that is put down where it stood keeps its foothold: contact may flicker.
    same = 1.0 - (1.0 - before.planted) * smoothing.smoothstep(
        (vec.length(travelled) - NEAR) / NEAR
    )
    landed = jnp.where(now.started, feet.planted * before.whole * (1.0 - same), 0.0)
    swing_time, lead = _learnt(now, feet, before, velocity, landed, stance_time, swing_time)
    missed = jnp.where(now.started, before.missed, jnp.ones_like(time))
    missed = smoothing.lerp(missed, smoothing.clip_to_one(_changed(travelled, before)), landed)
    settled = smoothing.fraction_of_half_life(jnp.asarray(SETTLED, dt.dtype), dt)
    in_stance = vec.scale(travelled, same * (1.0 - settled))
    pace = 1.0 / _duration(before.time, before.fraction, swing_time)
    walks = _walks(feet, velocity)
    by_time = before.fraction + dt * pace
    pitched = walks * smoothing.clip_to_one(-lowest / PITCHED)
    pitch_counts = pitched * (1.0 - LEARNT * _regularity(before, feet.rig))
    fraction = _turned(before.fraction, by_time, feet.pitch, lowest, pitch_counts, dt)
    duration = _duration(time, fraction, swing_time)
    by_motion = _fraction_of_motion(time, travelled, moved, dt)
    fraction = _sunk(feet, before, fraction, duration, by_motion, pitched, dt)
    fraction = jnp.where(now.started, fraction, guess.fraction)
    by_motion -= fraction
    farthest = jnp.asarray(FARTHEST, dt.dtype)
    by_motion = gate.clip(by_motion, -farthest, farthest, band=FRACTION_BAND)
    counts = before.whole * smoothing.smoothstep((fraction - EARLY) / (0.5 * EARLY))
    correction = smoothing.fraction_of_half_life(jnp.asarray(CORRECTION, dt.dtype), dt)
    further = smoothing.lerp(before.further, BY_MOTION * counts * by_motion, correction)
    zero = jnp.zeros_like(time)
    swings = Swings(
        feet.planted,
        gate.choose(feet.planted, zero, time),
        gate.choose(feet.planted, zero, fraction),
        gate.choose(feet.planted, zero, further),
        gate.choose(feet.planted, jnp.ones_like(time), before.whole),
        gate.choose(feet.planted, feet.pitch, lowest),
        gate.choose(feet.planted[:, None], in_stance, travelled),
        before.first_way_ws,
        feet.from_root_ws,
        velocity,
        feet.facing_ws,
        turning,
        swing_time,
        lead,
        missed,
    )
    foot_velocity = vec.scale(moved, vec.safe_divide(jnp.ones_like(dt), dt))
    next_ws = _landing(feet, swings, foot_velocity)
    way = gate.choose(feet.planted[:, None], _way(feet, swings, next_ws), before.first_way_ws)
    landed = jnp.where(feet.rig.present, landed, 0.0)
    return _with_first_steps(dataclasses.replace(swings, first_way_ws=way), landed), next_ws


def _learnt(
    now: Moment,
    feet: Feet,
    before: Swings,
    velocity_ws: Array,
    landed: Array,
    stance_time: Array,
    swing_time: Array,
) -> tuple[Float[Array, " legs"], Float[Array, " legs"]]:
    """How long feet swing, s, and how long before their hips are over them they land, s.

    Args:
        now: the frame.
        feet: what it shows.
        before: memory.
        velocity_ws: m/s, of the character, smoothed.
        landed: 0..1, whether each foot has landed after a swing that was seen from its start.
        stance_time: s, how long a foot usually stands.
        swing_time: s, how long it usually swings.
    """
    shortest, longest = SHORTEST * swing_time, LONGEST * swing_time
    swung = now.gate.clip(before.time + now.dt, shortest, longest, band=TIME_BAND)
    velocity_ws = vec.reject(velocity_ws, feet.up_ws)
    lead = time_ahead(velocity_ws, feet.ball_ws - feet.hip_ws)
    lead = now.gate.clip(lead, jnp.zeros_like(stance_time), stance_time, band=TIME_BAND)
    usual_swing = jnp.where(now.started, before.swing_time, swing_time)
    usual_lead = jnp.where(now.started, before.lead, 0.5 * stance_time)
    learnt = LEARNT * landed
    return smoothing.lerp(usual_swing, swung, learnt), smoothing.lerp(usual_lead, lead, learnt)


def _with_first_steps(swings: Swings, landed: Array) -> Swings:
    """Feet to which their own steps have told nothing take the times of those that land, 0..1."""
    count = vec.sum_last(landed)
    unknown = smoothing.smoothstep((swings.missed - NOWHERE) / (1.0 - NOWHERE)) * (1.0 - landed)
    share = unknown * smoothing.clip_to_one(count)

    def taken(own: Array) -> Array:
        return smoothing.lerp(own, vec.safe_divide(vec.sum_last(landed * own), count), share)

    return dataclasses.replace(swings, swing_time=taken(swings.swing_time), lead=taken(swings.lead))


def _first_guess(feet: Feet, stance_time: Array, swing_time: Array, gate: AbstractGate) -> Instant:
    """Where feet are in their strides in a first frame; toes that are up in a swing will land."""
    guess = instant(feet.ahead, feet.planted, stance_time, swing_time, gate)
    landing = (feet.planted < 1) & (feet.pitch > 0) & (guess.fraction < LEVEL)
    fraction = jnp.where(landing, LEVEL, guess.fraction)
    since_last = guess.since_last + (fraction - guess.fraction) * swing_time
    return Instant(fraction, since_last, guess.until_next)


def time_left(swings: Swings) -> Float[Array, " legs"]:
    """s, until each foot lands; 0 while it stands."""
    duration = _duration(swings.time, swings.fraction, swings.swing_time)
    return jnp.where(swings.planted > 0.5, 0.0, (1.0 - swings.fraction) * duration)


def _duration(time: Array, fraction: Array, swing_time: Array) -> Array:
    """s, of each swing: the usual one at first, then that of its pace so far."""
    pace_known = smoothing.smoothstep((fraction - TOES_DOWN) / 0.1)
    so_far = time / jnp.where(fraction > TOES_DOWN, fraction, TOES_DOWN)
    shortest, longest = SHORTEST * swing_time, LONGEST * swing_time
    so_far = jnp.where(so_far < shortest, shortest, jnp.where(so_far > longest, longest, so_far))
    return smoothing.lerp(swing_time + jnp.zeros_like(so_far), so_far, pace_known)


def _walks(feet: Feet, velocity_ws: Array) -> Float[Array, " legs"]:
    """0..1, how far a character at this velocity walks, and not backwards."""
    velocity_ws = vec.reject(velocity_ws, feet.up_ws)
    falls = GRAVITY * (feet.rig.thigh + feet.rig.shin)  # m²/s²
    froude = vec.dot(velocity_ws, velocity_ws) / falls
    back = -vec.dot(velocity_ws, feet.ahead_ws) / vec.safe_sqrt(falls)
    forward = 1.0 - smoothing.smoothstep(back / BACK)
    return forward * (1.0 - smoothing.smoothstep((froude - WALKS) / (RUNS - WALKS)))


def _turned(
    before: Array, by_time: Array, pitch: Array, lowest: Array, pitched: Array, dt: Array
) -> Array:
    """How far each swing is, by time and by the pitch of its sole; it never goes back."""
    turned = smoothing.smoothstep((pitch - lowest) / TURN)
    latest = LAST - pitched * (1.0 - turned) * (LAST - TOES_DOWN)
    fraction = jnp.where(by_time < latest, by_time, latest)
    level = smoothing.clip_to_one(vec.safe_divide(pitch, lowest))  # 1 where lowest, 0 where level
    by_pitch = TOES_DOWN + (LEVEL - TOES_DOWN) * (1.0 - level)
    # Near the level the pitch says nothing more: a foot may wait there until it lands.
    weight = turned * pitched * smoothing.smoothstep(level / WAITS)
    weight *= smoothing.fraction_of_half_life(jnp.asarray(CORRECTION, dt.dtype), dt)
    fraction = smoothing.lerp(fraction, by_pitch, weight)
    return jnp.where(fraction > before, fraction, before)


def _sunk(
    feet: Feet,
    before: Swings,
    fraction: Array,
    duration: Array,
    by_motion: Array,
    pitched: Array,
    dt: Array,
) -> Array:
    """How far each swing is, also by how fast its sole sinks to the animation's floor.

    It is taken to need half as long again as at that speed: soles that slow down evenly need twice
    as long, those of people hardly slow down before they land. As far as its pitch tells of the
    swing, the sign that says less counts, height or motion, with a quarter more time left.
    """
    left = 1.5 * dt * feet.height
    sunk = duration * vec.dot(before.from_root_ws - feet.from_root_ws, feet.up_ws)
    by_height = jnp.where(sunk > left, LAST - LAST * vec.safe_divide(left, sunk), 0.0)
    both = jnp.where(by_height < by_motion, by_height, by_motion)
    by_height = smoothing.lerp(by_height, 1.0 - LONGER * (1.0 - both), pitched)
    counts = smoothing.smoothstep((fraction - EARLY) / (0.5 * EARLY))
    counts *= smoothing.fraction_of_half_life(jnp.asarray(SINKING, dt.dtype), dt)
    further = by_height - fraction
    return fraction + counts * jnp.where(further > 0, further, 0.0)


def _fraction_of_motion(time: Array, travelled_ws: Array, moved_ws: Array, dt: Array) -> Array:
    """How far each swing is, by the speed of its ball over the mean speed so far.

    At the fraction x of a minimum-jerk motion that ratio is `30 (1 - x)^2 / (10 - 15 x + 6 x^2)`,
    which falls from 3 to 0; x is solved for.
    """
    middle_ws, since = travelled_ws - 0.5 * moved_ws, time - 0.5 * dt
    speed = vec.safe_divide(vec.dot(moved_ws, middle_ws), dt)
    ratio = 3.0 * smoothing.clip_to_one(
        vec.safe_divide(speed * since, 3.0 * vec.dot(middle_ws, middle_ws))
    )
    root = vec.safe_sqrt(15.0 * ratio * (8.0 - ratio))
    fraction = (60.0 - 15.0 * ratio - root) / (60.0 - 12.0 * ratio)
    return fraction * vec.safe_divide(time, since)


def _landing(feet: Feet, swings: Swings, foot_velocity: Array) -> Float[Array, "legs 3"]:
    """Where the balls will stand next, m, world space; their height says nothing.

    A character that turns while it walks the way it faces goes on in an arc: turning by an angle a,
    it comes aside by `(1 - cos a) / a` of its way, nearly `a / 2 / (1 + a^2 / 12)`, which does not
    come back to 0 where it turns in a single frame.
    """
    fraction = LAST * smoothing.clip_to_one((swings.fraction + swings.further) / LAST)
    duration = _duration(swings.time, fraction, swings.swing_time)
    speed = vec.length(vec.reject(swings.velocity_ws, feet.up_ws))
    most = AHEAD * (feet.rig.thigh + feet.rig.shin)
    lead = jnp.where(speed * swings.lead < most, swings.lead, vec.safe_divide(most, speed))
    until = (1.0 - fraction) * duration + lead
    forward = vec.dot(swings.velocity_ws, feet.facing_ws)
    forward_ws = vec.scale(feet.facing_ws, jnp.where(forward > 0, forward, 0.0))
    by_hip = feet.hip_ws + vec.scale(swings.velocity_ws, until)
    angle_ws, way_ws = vec.scale(swings.turning_ws, until), vec.scale(forward_ws, until)
    aside = 0.5 / (1.0 + vec.dot(angle_ws, angle_ws) / 12.0)
    by_hip += vec.scale(vec.cross(angle_ws, way_ws), aside)
    # Of a minimum-jerk motion, the way that is left over the speed and the duration.
    x = jnp.where(fraction > EARLY, fraction, EARLY)
    left = 1.0 - x
    left *= (10.0 - 15.0 * left + 6.0 * left * left) / (30.0 * x * x)
    by_ball = feet.ball_ws + vec.scale(foot_velocity, duration * left)
    own = smoothing.smoothstep((fraction - EARLY) / (LATE - EARLY))
    return smoothing.lerp(by_hip, by_ball, own[:, None])
