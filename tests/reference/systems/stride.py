"""The `stride` system in plain NumPy float64: feet reach the ground where they will stand.

One character, one leg, one frame at a time, written from the description of the rules and not from
the code that is tested. Metres, radians, seconds; suffixes _ws world, _ms model.
Each foot has an up of its own, that of its terrain; the body has another.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from reference import characters, maths
from reference.characters import Followed, Foot, Frame, Ground, Hold, Parameters, Rig
from reference.maths import Array, Motion, Transform, apply, length, lerp
from reference.stages import contact_by_speed, ground, heel, limb, spine, stride_probe
from reference.stages.contact_by_speed import Standing
from reference.stages.swing import axis_of_pitch
from reference.systems import record
from reference.terrain import ALL_LAYERS

# The alternatives in the stages that have two rules.
CONTACTS: dict[str, dict[str, Any]] = {
    "label": {"contact.ground_height": 0.0},
    "speed": contact_by_speed.DEFAULTS,
}
PELVISES: dict[str, dict[str, Any]] = {
    "reach": {
        "pelvis.highest_share": 0.75,
        "pelvis.extension": 0.958,
        "pelvis.softness": 0.025,
        "pelvis.shift": 0.15,
        "pelvis.rise_half_life": 0.04,
        "pelvis.fall_half_life": 0.04,
        "pelvis.spring": True,
    },
    "support": {
        "pelvis.lowest_share": 0.3,
        "pelvis.rise_half_life": 0.1,
        "pelvis.fall_half_life": 0.1,
        "pelvis.spring": False,
    },
}


def defaults(contact: str = "label", pelvis: str = "reach") -> dict[str, Any]:
    """All parameters of the system with these rules."""
    kept = ("target.", "lock.", "leg.", "foot.")
    return {
        **{name: value for name, value in record.DEFAULTS.items() if name.startswith(kept)},
        **CONTACTS[contact],
        **PELVISES[pelvis],
        **spine.DEFAULTS,
        "probe.ray_up": 1.0,
        "probe.ray_down": 1.0,
        "probe.layers": ALL_LAYERS,
        "probe.rise_start": 0.0,
        "probe.rise_end": 1.0,
        "probe.steepness": 1.875,
        "probe.max_step_up": 0.6,
        "probe.max_step_down": 0.6,
        "probe.max_slope": 1.05,
        "probe.clearance": 0.0,
        "probe.way_slope": 1.5,
        "probe.heel_length": 0.07,
        "probe.ball_height": 0.055,
        "probe.toe_length": 0.04,
        "probe.held_lift": 0.6,
        "probe.toe_clearance": 0.03,
        "probe.lift_per_rise": 0.5,
        "probe.lift_per_fall": 0.35,
        "probe.lift_over": 1.7,
        "probe.toes_up": 0.1,
        "probe.toes_down": 0.3,
        "probe.toes_down_per_height": 0.9,
        "probe.toes_first": 0.5,
        "probe.min_sole": 0.65,
        "probe.max_slide": 0.1,
        "probe.swing_as_animated": False,
        "probe.use_strides": True,
        "probe.stance_time": 0.65,
        "probe.swing_time": 0.45,
        "target.max_ankle_height": 0.8,
        "lock.enabled": False,
        "lock.hold_ball": True,
        "effector.extension": 0.98,
        "effector.max_lift": 0.6,
        "leg.max_knee_angle": math.pi,
        "leg.soften": 0.985,
        "leg.as_animated": True,
        "foot.max_pitch": 0.8,
        "foot.min_pitch": -1.0,
        "foot.max_roll": 0.45,
        "foot.min_roll": -0.6,
    }


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


def step(
    parameters: Parameters,
    rig: Rig,
    terrain: Ground,
    state: State | None,
    frame: Frame,
    contact: str = "label",
    pelvis: str = "reach",
) -> tuple[State, dict[str, Array]]:
    """One frame. Without a state it is the first: smoothed values start on their goals."""
    legs = range(len(frame.weight))
    ups = [characters.under(terrain, leg).up for leg in legs]
    offset_before = np.zeros(3) if state is None else state.pelvis_offset_ws
    standing, feet, followed, holds, footholds, targets = [], [], [], [], [], []
    swings, turns, balls, probed, supports = [], [], [], frame, []
    for leg in legs:
        before = None if state is None else state.standing[leg]
        if contact == "speed":
            standing.append(contact_by_speed.stand(parameters, frame, leg, before))
        else:
            label = float(frame.stride.standing[leg])
            standing.append(Standing(label > 0.5, label))
        under = characters.under(terrain, leg)
        stride = stride_probe.swing(parameters, frame, leg, under.up, standing[leg].standing)
        stride, slide = stride_probe.slide_to_support(parameters, rig, under, frame, leg, stride)
        forward_ws = slide.forward * ground.heading(rig, frame, leg, under.up)
        probed = characters.with_moved_foot(probed, leg, forward_ws)
        supports.append(slide.support)
        balls.append(stride_probe.under_ball(parameters, under, probed, leg, stride))
    for leg, up in zip(legs, ups, strict=True):
        under = characters.under(terrain, leg)
        below = stride_probe.below_others(parameters, probed, leg, ups, balls)
        foot, swing = sense(
            parameters, rig, under, frame, probed, leg, standing[leg], balls[leg], below
        )

        memory = None if state is None else state.ground[leg]
        memory = ground.smooth_height(parameters, leg, foot, up, memory, frame)
        height = memory.height.value
        foothold, target = ground.clamped_target(parameters, leg, foot, up, height, frame)
        hold = None if state is None else state.holds[leg]
        hold, offset, turn = ground.lock(
            parameters, leg, foot, foothold, up, hold, offset_before, frame
        )
        feet.append(foot)
        swings.append(swing)
        followed.append(memory)
        holds.append(hold)
        pitch = maths.from_axis_angle(axis_of_pitch(rig, frame, leg, up), swing.pitch)
        turns.append(maths.multiply(turn, pitch))
        footholds.append(foothold)
        targets.append(target + offset)

    forward = ground.forward(frame.world_from_model.rot, terrain.up)
    leaning, tilt_ws = lean(parameters, terrain.up, feet, state, frame)
    hips = tilted_hips(frame, tilt_ws)
    goal, ahead_goal = pelvis_goal(
        parameters, pelvis, feet, targets, ups, terrain.up, hips, state, frame
    )
    eased = follow_goal(parameters, state, goal, frame.dt)
    ahead = ahead_goal
    if state is not None:
        rising = maths.fraction_of_half_life(parameters["pelvis.rise_half_life"], frame.dt)
        ahead = lerp(state.ahead, ahead_goal, rising)
    offset_ws = (terrain.up * eased.value + forward * ahead) * frame.grounded
    body = limb.body(frame, offset_ws, maths.nlerp(maths.IDENTITY, tilt_ws, frame.grounded))

    solved, reached, stretches, lifts, aims = [], [], [], [], []
    for leg, up in zip(legs, ups, strict=True):
        aim_ws, rot_ws, lift = heel.raised(
            parameters, frame, leg, feet[leg], targets[leg], turns[leg], offset_ws, up
        )
        aim_ms = maths.unapply(frame.world_from_model, aim_ws)
        hip, knee, ankle, arrived = limb.solve_leg(parameters, rig, leg, frame, body, aim_ms)
        rot = limb.foot(parameters, rig, leg, feet[leg], frame, knee, ankle, rot_ws, forward, up)
        ankle = Transform(ankle.pos, rot)
        solved.append((hip, knee, ankle, limb.toe(frame, leg, ankle)))
        reached.append(arrived)
        leg_of_animation = frame.ankle.pos[leg] - frame.hip.pos[leg]
        stretches.append(length(aim_ms - hip.pos) - length(leg_of_animation))
        lifts.append(lift)
        aims.append(aim_ws)

    output = {
        "body_pos": body.pos,
        "body_rot": body.rot,
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
        "before_heel_ws": np.array(targets),
        "pelvis_goal": np.array(goal),
        "pelvis_height": np.array(eased.value),
        "pelvis_velocity": np.array(eased.velocity),
        "pelvis_ahead": np.array(ahead),
        "heel_lift": np.array(lifts),
        "target_ws": np.array(aims),
        "reached": np.array(reached),
        "stretch": np.array(stretches),  # by how much the target is farther than animated
    }
    after = State(standing, followed, holds, leaning, eased, goal, ahead, offset_ws)
    return after, output | characters.joints(solved)


def run(
    parameters: Parameters,
    rig: Rig,
    terrain: Ground,
    frames: Sequence[Frame],
    contact: str = "label",
    pelvis: str = "reach",
) -> dict[str, Array]:
    """All outputs of `step` for a whole clip, stacked over the frames."""
    step_with_rules = functools.partial(step, contact=contact, pelvis=pelvis)
    return characters.run(step_with_rules, parameters, rig, terrain, frames)


def sense(
    parameters: Parameters,
    rig: Rig,
    terrain: Ground,
    frame: Frame,
    probed: Frame,
    leg: int,
    contact: Standing,
    ball: stride_probe.UnderBall,
    below: float,
) -> tuple[Foot, stride_probe.Swing]:
    """One leg in this frame, and where it is in its stride; in `probed` feet have slid."""
    ankle_ws = apply(frame.world_from_model, frame.ankle.pos[leg])
    lift = float(frame.ankle.pos[leg][1] - parameters.of_leg("contact.ground_height", leg))
    hit, swing = stride_probe.ground_of_stride(parameters, rig, terrain, probed, leg, ball, below)
    if hit.found:
        lift += swing.lift
    else:
        swing.lift = swing.pitch = 0.0
    foot = Foot(
        hip_ws=apply(frame.world_from_model, frame.hip.pos[leg]),
        ankle_ws=ankle_ws,
        ball_ws=apply(frame.world_from_model, frame.toe.pos[leg]),
        heading_ws=ground.heading(rig, frame, leg, terrain.up),
        lift=lift,
        contact=contact.weight,
        planted=contact.standing,
        lifted=not contact.standing,
        hit=hit,
        toe_hit=hit._replace(found=False),
        foothold_ws=ground.foothold(parameters, leg, hit, ankle_ws, lift, terrain.up),
        turns_in_swing=True,
        swing_lift=swing.lift,
    )
    return foot, swing


def lean(
    parameters: Parameters, up: Array, feet: list[Foot], state: State | None, frame: Frame
) -> tuple[spine.State, Array]:
    """Memory of the lean after this frame, and the tilt of the pelvis, world axes."""
    legs = np.array(ground.weights_of_legs(parameters, frame))
    found = np.array([float(foot.hit.found) for foot in feet])
    standing = legs * found * [foot.contact for foot in feet]
    points, normals = (
        np.array([getattr(foot.hit, name) for foot in feet]) for name in ("point", "normal")
    )
    before = None if state is None else state.lean
    root = frame.world_from_model
    after, _, _, tilt = spine.lean(
        parameters, root.rot, points - root.pos, normals, standing, frame.slide, frame.dt, before,
        up, legs * found,
    )  # fmt: skip
    return after, tilt


def tilted_hips(frame: Frame, tilt_ws: Array) -> list[Array]:
    """The hips after the pelvis has tilted about their middle, m, world space."""
    hips = [apply(frame.world_from_model, hip) for hip in frame.hip.pos]
    middle = np.mean(hips, axis=0)
    return [middle + maths.rotate(tilt_ws, hip - middle) for hip in hips]


def pelvis_goal(
    parameters: Parameters,
    pelvis: str,
    feet: list[Foot],
    targets: list[Array],
    ups: list[Array],
    up: Array,
    hips: list[Array],
    state: State | None,
    frame: Frame,
) -> tuple[float, float]:
    """How far up and ahead the body is to go, m, by the rule of that name."""
    leg_weights = ground.weights_of_legs(parameters, frame)
    requested = [
        float((target - foot.ankle_ws) @ leg_up) - foot.swing_lift  # none rises with a swing
        for foot, target, leg_up in zip(feet, targets, ups, strict=True)
    ]
    if pelvis == "reach":
        return reach_goal(parameters, feet, targets, leg_weights, requested, up, hips, frame)
    return support_goal(parameters, feet, leg_weights, requested, state), 0.0


def support_goal(
    parameters: Parameters,
    feet: list[Foot],
    leg_weights: list[float],
    requested: list[float],
    state: State | None,
) -> float:
    """Between the heights that the standing feet and the lowest foot request."""
    taking_part = [gap for gap, w in zip(requested, leg_weights, strict=True) if w > 0.0]
    weights = [foot.grounded * w for foot, w in zip(feet, leg_weights, strict=True)]
    if sum(weights) == 0.0:
        if state is not None:
            return state.pelvis_goal
        total = sum(w * gap for w, gap in zip(leg_weights, requested, strict=True))
        return total / sum(leg_weights) if taking_part else 0.0
    support = sum(w * gap for w, gap in zip(weights, requested, strict=True)) / sum(weights)
    return support + parameters["pelvis.lowest_share"] * (min(taking_part) - support)


def reach_goal(
    parameters: Parameters,
    feet: list[Foot],
    targets: list[Array],
    leg_weights: list[float],
    requested: list[float],
    up: Array,
    hips: list[Array],
    frame: Frame,
) -> tuple[float, float]:
    """Between the mean and the highest of the requested heights, within reach of all legs.

    Also how far ahead of the animation the body goes, towards the foot that limits it.
    """
    if sum(leg_weights) == 0.0:
        return 0.0, 0.0
    mean = sum(w * gap for w, gap in zip(leg_weights, requested, strict=True)) / sum(leg_weights)
    highest = max(gap for gap, w in zip(requested, leg_weights, strict=True) if w > 0.0)
    wanted = lerp(mean, highest, parameters["pelvis.highest_share"])
    softness = parameters["pelvis.softness"]
    legs = [leg for leg, weight in enumerate(leg_weights) if weight > 0.0]
    longest = {leg: parameters["pelvis.extension"] * heel.leg_length(frame, leg) for leg in legs}
    animated = {leg: feet[leg].ankle_ws - feet[leg].hip_ws for leg in legs}
    moved = {leg: targets[leg] - hips[leg] for leg in legs}
    forward = ground.forward(frame.world_from_model.rot, up)

    def limiting_ahead(to_foot: dict[int, Array]) -> float:
        """How far ahead of its hip the foot is that limits the height, blended softly, m."""
        heights = np.array([highest_hip(to_foot[leg], longest[leg], up) for leg in legs])
        shares = np.exp((heights.min() - heights) / softness)
        places = np.array([float(to_foot[leg] @ forward) for leg in legs])
        return float(shares @ places / shares.sum())

    ahead = parameters["pelvis.shift"] * (limiting_ahead(moved) - limiting_ahead(animated))
    shifted = [highest_hip(moved[leg] - ahead * forward, longest[leg], up) for leg in legs]
    untouched = [highest_hip(animated[leg], longest[leg], up) for leg in legs]
    height = soft_minimum([wanted, *shifted], softness) - soft_minimum([0.0, *untouched], softness)
    return height, ahead


def highest_hip(to_foot: Array, longest: float, up: Array) -> float:
    """How far the hip may rise, m, until the leg to that foot is `longest` m."""
    aside = maths.across(to_foot, up)
    return float(to_foot @ up) + math.sqrt(max(0.0, longest**2 - float(aside @ aside)))


def soft_minimum(values: list[float], softness: float) -> float:
    """A smooth lower bound of the values, m."""
    lowest = min(values)
    return lowest - softness * math.log(sum(math.exp((lowest - x) / softness) for x in values))


def follow_goal(parameters: Parameters, state: State | None, goal: float, dt: float) -> Motion:
    """The smoothed height of the body, m."""
    if state is None:
        return Motion(goal, 0.0)
    direction = "rise" if goal > state.pelvis.value else "fall"
    half_life = parameters[f"pelvis.{direction}_half_life"]
    return maths.follow(state.pelvis, goal, half_life, dt, parameters["pelvis.spring"])
