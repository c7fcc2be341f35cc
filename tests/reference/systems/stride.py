"""The `stride` system: feet reach the ground where they will stand."""

import functools
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from reference import characters, maths
from reference.characters import Frame, Ground, Leg, Parameters, Rig, named
from reference.maths import Array, Motion, length, lerp
from reference.stages import ground, limb, spine, stride_probe
from reference.stages.ground import Followed, Foot, Hold, Standing
from reference.terrain import ALL_LAYERS

FASTEST = 2.0  # m/s, of a root that climbs

# The alternatives in the stages that have two rules.
CONTACTS = {"label": {"contact.ground_height": 0.0}, "speed": ground.BY_SPEED}
PELVISES = {
    "reach": named("pelvis", highest_share=0.75, extension=0.958, softness=0.04, shift=0.15)
    | named("pelvis", rise_half_life=0.08, fall_half_life=0.041, spring=True, landing_time=0.2)
    | named("pelvis", rise_speed=0.3, most_shift=0.04),
    "support": named("pelvis", lowest_share=0.3, rise_half_life=0.1, fall_half_life=0.1)
    | {"pelvis.spring": False},
}


def defaults(contact: str = "label", pelvis: str = "reach") -> dict[str, Any]:
    """All parameters of the system with these rules."""
    kept = ("target.", "lock.", "leg.", "foot.")
    of_record = {name: x for name, x in characters.DEFAULTS.items() if name.startswith(kept)}
    return (
        {**of_record, **CONTACTS[contact], **PELVISES[pelvis], **spine.DEFAULTS}
        | named("probe", ray_up=1.0, ray_down=1.0, layers=ALL_LAYERS, clearance=0.0)
        | named("probe", rise_start=0.0, rise_end=1.0, steepness=1.55)
        | named("probe", max_step_up=0.6, max_step_down=0.6, max_slope=1.05)
        | named("probe", heel_length=0.07, ball_height=0.055, toe_length=0.04, toe_clearance=0.03)
        | named("probe", held_lift=0.6, lift_per_rise=0.5, lift_ahead=0.85, lift_per_fall=0.35)
        | named("probe", lift_over=1.7)
        | named("probe", toes_up=0.1, toes_down=0.3, toes_down_per_height=0.9, toes_first=0.5)
        | named("probe", min_sole=0.65, max_slide=0.1, swing_as_animated=False, use_strides=True)
        | named("probe", stance_time=0.65, swing_time=0.55)
        | {"target.max_ankle_height": 0.8, "lock.enabled": False, "lock.hold_ball": True}
        | named("effector", extension=0.98, max_lift=0.6)
        | named("leg", max_knee_angle=math.pi, soften=0.985, as_animated=True)
        | named("foot", max_pitch=1.0, min_pitch=-1.0, max_roll=0.45, min_roll=-0.6)
    )


@dataclass
class State:
    """Memory between frames; lists have one entry per leg."""

    standing: list[Standing]
    ground: list[Followed]
    holds: list[Hold]
    lean: spine.State
    pelvis: Motion
    pelvis_goal: float
    ahead: float
    pelvis_offset_ws: Array
    fractions: list[float]
    root_height: float
    rise: float
    """m/s, at which the body rose over the ground, with its root."""


def step(
    parameters: Parameters, rig: Rig, terrain: Ground, state: State | None, frame: Frame
) -> tuple[State, dict[str, Array]]:
    """One frame. Without a state it is the first: smoothed values start on their goals."""
    legs = characters.legs_of(parameters, rig, terrain, frame)
    standing, probed, balls, supports = [], [], [], []
    for leg in legs:
        if "contact.planted_speed" in parameters.values:
            stands = ground.stand(leg, state.standing[leg.index] if state else None)
        else:
            label = float(frame.stride.standing[leg.index])
            stands = Standing(label > 0.5, label)
        stride = stride_probe.swing(leg, stands.standing)
        stride, slide = stride_probe.slide_to_support(leg, stride)
        slid = leg.with_foot_moved(slide.way)
        standing.append(stands)
        probed.append(slid)
        balls.append(stride_probe.under_ball(slid, stride))
        supports.append(slide.support)

    feet, swings, followed, holds, footholds, targets, turns = [], [], [], [], [], [], []
    landings = []
    offset_before = state.pelvis_offset_ws if state else np.zeros(3)
    for leg, slid, stands, ball in zip(legs, probed, standing, balls, strict=True):
        below = stride_probe.below_others(slid, probed, balls)
        above = stride_probe.above_others(slid, balls)
        hit, swing = stride_probe.ground_of_stride(slid, ball, below, above)
        foot = with_contact(leg, stands, hit, swing)
        memory = ground.smooth_height(foot, state.ground[leg.index] if state else None)
        foothold, target = ground.clamped_target(foot, memory.height.value)
        hold = state.holds[leg.index] if state else None
        hold, offset, turn = ground.lock(foot, foothold, hold, offset_before)
        pitch = maths.from_axis_angle(stride_probe.axis_of_pitch(leg), swing.pitch)
        feet.append(foot)
        swings.append(swing)
        landings.append(stride_probe.landing(slid, ball, hit))
        followed.append(memory)
        holds.append(hold)
        footholds.append(foothold)
        targets.append(target + offset)
        turns.append(maths.multiply(turn, pitch))

    forward = characters.forward(frame.world_from_model.rot, terrain.up)
    leaning, tilt_ws = lean(parameters, terrain.up, feet, state, frame)
    requested = [
        float((target - foot.pos_ws("ankle")) @ foot.up) - foot.swing_lift  # none rises with it
        for foot, target in zip(feet, targets, strict=True)
    ]
    if "pelvis.highest_share" in parameters.values:
        hips = np.array([foot.pos_ws("hip") for foot in feet])
        middle = np.mean(hips, axis=0)  # about which the pelvis has tilted
        hips = [middle + maths.rotate(tilt_ws, hip - middle) for hip in hips]
        ends = [
            end_of_swing(foot, landing, foothold, terrain.up, state)
            for foot, landing, foothold in zip(feet, landings, footholds, strict=True)
        ]
        goal, ahead = reach_goal(
            parameters, feet, targets, requested, terrain.up, forward, hips, ends
        )
    else:
        goal, ahead = support_goal(parameters, feet, requested, state), 0.0
    eased = ground.ease(parameters, "pelvis", state.pelvis if state else None, goal, frame.dt)
    if state is not None and "pelvis.rise_speed" in parameters.values:
        eased = pushed(parameters, eased, state, feet, footholds, terrain.up)
    rise = 0.0
    if state is not None:
        rise = (eased.value - state.pelvis.value) / frame.dt
        rise += max(root_speeds(feet, footholds, terrain.up, state))
        rising = maths.fraction_of_half_life(parameters["pelvis.rise_half_life"], frame.dt)
        ahead = lerp(state.ahead, ahead, rising)
    offset_ws = (terrain.up * eased.value + forward * ahead) * frame.grounded
    body = limb.body(frame, offset_ws, maths.nlerp(maths.IDENTITY, tilt_ws, frame.grounded))

    solved, stretches, lifts, aims = [], [], [], []
    for foot, target, turn in zip(feet, targets, turns, strict=True):
        aim_ws, rot_ws, lift = limb.raise_heel(foot, target, turn, offset_ws)
        aim_ms = maths.unapply(frame.world_from_model, aim_ws)
        leg = limb.solve_leg(foot, body, aim_ms)
        rot = limb.turn_foot(foot, leg, rot_ws, forward)
        solved.append(limb.with_foot(foot, leg, rot))
        animated = foot.joint("ankle").pos - foot.joint("hip").pos
        stretches.append(length(aim_ms - leg.hip.pos) - length(animated))
        lifts.append(lift)
        aims.append(aim_ws)

    output = characters.solution(body, solved) | {
        "contact": np.array([foot.weight for foot in standing]),
        "standing": np.array([foot.standing for foot in standing]),
        "found": np.array([foot.hit.found for foot in feet]),
        "fraction": np.array([swing.fraction for swing in swings]),
        "hit_ws": np.array([foot.hit.point for foot in feet]),
        "normal": np.array([foot.hit.normal for foot in feet]),
        "support": np.array(supports),
        "ground_height": np.array([memory.height.value for memory in followed]),
        "ground_velocity": np.array([memory.height.velocity for memory in followed]),
        "foothold_ws": np.array(footholds),
        "locked": np.array([hold.locked for hold in holds]),
        "factor": np.array([hold.factor for hold in holds]),
        "pelvis_goal": np.array(goal),
        "pelvis_height": np.array(eased.value),
        "pelvis_velocity": np.array(eased.velocity),
        "pelvis_ahead": np.array(ahead),
        "heel_lift": np.array(lifts),
        "target_ws": np.array(aims),
        "stretch": np.array(stretches),  # by how much the target is farther than animated
    }
    fractions = [landing.fraction for landing in landings]
    root_height = float(frame.world_from_model.pos @ terrain.up)
    pelvis = eased, goal, ahead, offset_ws, fractions, root_height, rise
    return State(standing, followed, holds, leaning, *pelvis), output


run = functools.partial(characters.run, step)


def with_contact(
    leg: Leg, contact: Standing, hit: characters.Hit, swing: stride_probe.Swing
) -> Foot:
    """The foot of a leg that stands or swings over the ground under it."""
    lift = float(leg.joint("ankle").pos[1] - leg["contact.ground_height"])
    return Foot(
        **vars(leg),
        lift=lift + swing.lift,
        contact=contact.weight,
        planted=contact.standing,
        lifted=not contact.standing,
        hit=hit,
        toe_hit=hit._replace(found=False),
        turns_in_swing=True,
        swing_lift=swing.lift,
    )


def lean(
    parameters: Parameters, up: Array, feet: list[Foot], state: State | None, frame: Frame
) -> tuple[spine.State, Array]:
    """Memory of the lean after this frame, and the tilt of the pelvis, world axes."""
    weights, found = np.array([(foot.weight, foot.hit.found) for foot in feet]).T
    standing = found * [foot.contact for foot in feet]
    root = frame.world_from_model
    points = np.array([foot.hit.point - root.pos for foot in feet])
    normals = np.array([foot.hit.normal for foot in feet])
    before = state.lean if state else None
    ground_under = (root.rot, points, normals, standing, frame.slide)
    after, _, _, tilt = spine.lean(parameters, *ground_under, frame.dt, before, up, found, weights)
    return after, tilt


def support_goal(
    parameters: Parameters, feet: list[Foot], requested: list[float], state: State | None
) -> float:
    """Between the heights that the standing feet and the lowest foot request."""
    leg_weights = [foot.weight for foot in feet]
    weights = [foot.grounded * foot.weight for foot in feet]
    resting = float(np.average(requested, weights=leg_weights)) if any(leg_weights) else 0.0
    if state is not None:
        resting = state.pelvis_goal
    if sum(weights) == 0.0:
        return resting
    support = float(np.average(requested, weights=weights))
    lowest = ground.over_choices(min, requested, leg_weights)
    goal = support + parameters["pelvis.lowest_share"] * (lowest - support)
    return lerp(resting, goal, min(sum(weights), 1.0))


class EndOfSwing(NamedTuple):
    """How a swing ends, as seen from the body then.

    `share`, 0..1, is how far its leg is there already, `certain`, 0..1, how far that counts, and
    `lateness` by how many softnesses the limit there is higher yet. `way` and `rise`, m, lead there
    from where the foot is.
    """

    share: float
    certain: float
    lateness: float
    way: Array
    rise: float


def end_of_swing(
    foot: Foot,
    landing: stride_probe.Landing,
    foothold: Array,
    up: Array,
    state: State | None,
) -> EndOfSwing:
    """The end of the swing of a foot whose foothold is there now (3)."""
    step = landing.fraction - state.fractions[foot.index] if state else 0.0
    if state is None or step <= 0.0 or foot["pelvis.landing_time"] == 0.0:
        return EndOfSwing(0.0, 0.0, 0.0, np.zeros(3), 0.0)
    frame = foot.frame
    time = frame.dt * (1.0 - landing.fraction) / step
    climbed = root_speed(foot, foothold, up, state) * time
    lateness = (time / foot["pelvis.landing_time"]) ** 2
    return EndOfSwing(
        landing.certain * math.exp(-lateness),
        landing.certain,
        lateness,
        landing.way - maths.across(frame.travel_ws, foot.up) * time,
        landing.rise - foot.swing_lift - climbed,
    )


def pushed(
    parameters: Parameters,
    pelvis: Motion,
    state: State,
    feet: list[Foot],
    footholds: list[Array],
    up: Array,
) -> Motion:
    """The body no higher than legs push it in a frame, with its root, nor lower than it falls."""
    frame = feet[0].frame
    walking = length(maths.across(frame.travel_ws, feet[0].up))
    speed = parameters["pelvis.rise_speed"] + stride_probe.STAIRS * walking
    climbs = root_speeds(feet, footholds, up, state)
    highest = state.pelvis.value + max(speed - min(climbs), 0.0) * frame.dt
    fall = min(state.rise, 0.0) - 9.81 * frame.dt
    lowest = state.pelvis.value + (fall - max(climbs)) * frame.dt
    if lowest <= pelvis.value <= highest:
        return pelvis
    height = maths.clip(pelvis.value, lowest, highest)
    return Motion(height, (height - state.pelvis.value) / frame.dt)


def root_speeds(feet: list[Foot], footholds: list[Array], up: Array, state: State) -> list[float]:
    """How fast the root rises over the ground under each foot, m/s."""
    pairs = zip(feet, footholds, strict=True)
    return [root_speed(foot, foothold, up, state) for foot, foothold in pairs]


def root_speed(foot: Foot, foothold: Array, up: Array, state: State) -> float:
    """How fast the root rises over the ground under a foot, m/s."""
    frame = foot.frame
    carried_rise = float((foothold - previous_place(frame, foot.hit, foothold)) @ foot.up)
    root_height = float(frame.world_from_model.pos @ up)
    return maths.clip(
        (root_height - state.root_height - carried_rise) / frame.dt, -FASTEST, FASTEST
    )


def previous_place(frame: Frame, hit: characters.Hit, point: Array) -> Array:
    """Where a point of the ground that was hit was in the previous frame."""
    if hit.platform < 0:
        return point
    before, now = frame.platforms_before[hit.platform], frame.platforms[hit.platform]
    return maths.apply(before, maths.unapply(now, point))


def reach_goal(
    parameters: Parameters,
    feet: list[Foot],
    targets: list[Array],
    requested: list[float],
    up: Array,
    forward: Array,
    hips: list[Array],
    ends: list[EndOfSwing],
) -> tuple[float, float]:
    """Between the mean and the highest of the requested heights, within reach of all legs.

    Also how far ahead of the animation the body goes, towards the foot that limits it.
    """
    loads = np.array([foot.weight for foot in feet])
    if not loads.any():
        return 0.0, 0.0
    mean = float(np.average(requested, weights=loads))
    highest = ground.over_choices(max, requested, list(loads))
    wanted = float(loads.max()) * lerp(mean, highest, parameters["pelvis.highest_share"])
    softness = parameters["pelvis.softness"]
    longest = [parameters["pelvis.extension"] * foot.length for foot in feet]
    animated = [foot.pos_ws("ankle") - foot.pos_ws("hip") for foot in feet]
    moved = [target - hip for target, hip in zip(targets, hips, strict=True)]

    def highest_hips(to_feet: list[Array], longest: list[float] = longest) -> Array:
        """How far each hip may rise, m, until its leg is as long as it may be."""
        rises = (
            float(way @ up)
            + math.sqrt(max(0.0, limit**2 - float(maths.across(way, up) @ maths.across(way, up))))
            for way, limit in zip(to_feet, longest, strict=True)
        )
        return np.array(list(rises))

    def eased(heights: Array, free: float) -> Array:
        """Limits, m, of which legs of little weight are no further below `free` than that."""
        return heights + (1.0 - loads) * np.maximum(free - heights, 0.0)

    def limiting_ahead(to_feet: list[Array]) -> float:
        """How far ahead of its hip the foot is that limits the height, blended softly, m."""
        heights = highest_hips(to_feet)
        heights = eased(heights, heights.max())
        shares = loads * np.exp((heights.min() - heights) / softness)
        return float(loads.max() * (shares @ np.array(to_feet) @ forward) / shares.sum())

    shares, certain, lateness = (
        np.array([getattr(end, name) for end in ends]) for name in ("share", "certain", "lateness")
    )

    def reachable(heights: Array, landed: Array, free: float) -> float:
        """A smooth lower bound of the height wanted and what the legs reach, m."""
        parts = (loads * (1.0 - shares)) @ np.exp((free - eased(heights, free)) / softness)
        parts += (loads * certain) @ np.exp((free - eased(landed, free)) / softness - lateness)
        return free - softness * math.log(1.0 + parts)

    ahead = parameters["pelvis.shift"] * (limiting_ahead(moved) - limiting_ahead(animated))
    ahead /= math.hypot(1.0, ahead / parameters["pelvis.most_shift"])
    shifted = [way - ahead * forward for way in moved]
    level = [way + end.way for way, end in zip(animated, ends, strict=True)]
    missed = np.maximum(0.0, -highest_hips(level, [foot.length for foot in feet]))
    landed = [
        way + end.way + max(end.rise, min(end.rise + miss, 0.0)) * foot.up
        for way, end, foot, miss in zip(shifted, ends, feet, missed, strict=True)
    ]
    height = reachable(highest_hips(shifted), highest_hips(landed), wanted)
    return height - reachable(highest_hips(animated), highest_hips(level), 0.0), ahead
