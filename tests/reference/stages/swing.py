"""The swing of the `stride` reference: how people lift and pitch a foot over uneven ground."""

import numpy as np

from reference import maths
from reference.characters import Frame, Parameters, Rig, world_from_foot
from reference.maths import Array, across, apply, cross, rotate, smooth01, unit

SHARPNESS = 7.0
UNEVEN = 0.05  # m
HIGHEST = 0.3  # m, of the steps that people were captured on
ON_HEEL = 0.08  # rad
HELD, CLEAR, RISE, FALL, OVER, TOES_UP, TOES_DOWN = 0.28, 0.55, 0.52, 0.31, 0.455, 0.23, 0.75


def bump(x: float, peak: float) -> float:
    """1 at the peak, 0 at both ends of the swing."""
    if x <= 0.0 or x >= 1.0:
        return 0.0
    return ((x / peak) ** peak * ((1.0 - x) / (1.0 - peak)) ** (1.0 - peak)) ** SHARPNESS


def axis_of_pitch(rig: Rig, frame: Frame, leg: int, up: Array) -> Array:
    """The level axis, unit, about which a positive angle lifts the toes."""
    forward = rotate(world_from_foot(rig, frame, leg), np.array([0.0, 0.0, 1.0]))
    spare = across(rotate(frame.world_from_model.rot, np.array([0.0, 0.0, 1.0])), up)
    return cross(unit(across(forward, up), unit(spare, up)), up)


def beyond_animation(
    parameters: Parameters,
    rig: Rig,
    frame: Frame,
    leg: int,
    up: Array,
    fraction: float,
    step: float,
    over: float,
    sure: float,
    below: float,
) -> tuple[float, float]:
    """How much higher the ankle is, m, and how much further the toes are up, rad.

    `step` is how much higher the next foothold is than the last, without the slope, `over` how far
    the ground between them is over both, m; `sure` is 0..1. `below` is how far the ground of this
    foot is below that of another, m.
    """
    get = {
        name: parameters.of_leg(f"probe.{name}", leg)
        for name in (
            "held_lift", "toe_clearance", "lift_per_rise", "lift_per_fall", "lift_over",
            "toes_up", "toes_down", "toes_down_per_height", "toes_first", "ball_height",
        )
    }  # fmt: skip
    if parameters.of_leg("probe.swing_as_animated", leg):
        return 0.0, 0.0
    ball = apply(frame.world_from_model, frame.toe.pos[leg])
    ankle = apply(frame.world_from_model, frame.ankle.pos[leg])
    animated = max(float((ball - frame.world_from_model.pos) @ up) - get["ball_height"], 0.0)
    step = float(np.clip(step, -HIGHEST, HIGHEST))
    effort = abs(step) + over
    uneven = smooth01(effort / UNEVEN)
    lift = uneven * get["toe_clearance"] * bump(fraction, CLEAR)
    lift -= uneven * get["held_lift"] * animated * bump(fraction, HELD)
    lift += get["lift_per_rise"] * max(step, 0.0) * bump(fraction, RISE)
    lift += get["lift_per_fall"] * max(-step, 0.0) * bump(fraction, FALL)
    lift += get["lift_over"] * over * bump(fraction, OVER)
    down = uneven * get["toes_down"] + effort * get["toes_down_per_height"]
    pitch = uneven * get["toes_up"] * bump(fraction, TOES_UP) - down * bump(fraction, TOES_DOWN)
    forward = rotate(world_from_foot(rig, frame, leg), np.array([0.0, 0.0, 1.0]))
    animated_pitch = float(np.arcsin(np.clip(forward @ up, -1.0, 1.0)))
    pitch = sure * pitch - get["toes_first"] * below * smooth01(animated_pitch / ON_HEEL)
    axis = axis_of_pitch(rig, frame, leg, up)
    turned = rotate(maths.from_axis_angle(axis, pitch), ankle - ball)
    return sure * lift + float((turned - (ankle - ball)) @ up), pitch
