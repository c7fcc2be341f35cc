"""Synthetic actions besides walking: a run, a jump, a crouch, sitting, an idle, a turn in place.

Each is on the floor y = 0 and begins at the origin, facing +z, with its true contact labels. Feet
stand still exactly; the pelvis moves smoothly, and falls freely while no foot stands.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import BPoly

from fitting.clips.clip import Clip

from . import footsteps
from .footsteps import SIDES, Foothold, Swing, smoothstep, stepping_foot
from .walker import Body

GRAVITY = 9.81  # m/s²
STANDING = 0.90  # m, height of the pelvis
BALL_AHEAD = float(footsteps.FOOT * np.cos(footsteps.FLAT))  # m, of the ankle, in a flat foot
SPEED, STEP, CONTACT = 3.0, 0.36, 0.25  # m/s, s and s: of a run
CARRIAGE = 0.828  # m, mean height of the pelvis in a run
RUN_TRACK, TRACK = 0.05, 0.10  # m from the path to a foot
FLIGHT, LENGTH = 0.46, 0.6  # s and m, of a jump
COUNTERMOVEMENT = 0.24  # m, by which the pelvis sinks before a jump and after it
BENT = 0.06  # m, by which it is lower when the feet leave the ground: their toes come up slowly
DEPTH = 0.33  # m, of a crouch
SQUAT, SQUAT_BACK = 0.52, 0.28  # m, by which the pelvis goes down and back in a squat
SEAT, SEAT_BACK = 0.34, 0.36  # m, by which the pelvis goes down and back onto a bench
SWAY, SWAY_SECONDS = 0.005, 3.0  # m to either side and s, of an idle
STEP_ANGLE, STEP_SECONDS = np.radians(45.0), 0.4  # of a turn, for each step of a foot

Knot = tuple[float, ...]  # s, then the height, m, and what is known of its derivatives


def run(seconds: float, fps: float = 60.0) -> Clip:
    """A straight run at 3 m/s; both feet are in the air between two steps."""
    time = _times(seconds, fps)
    count = int(seconds / STEP) + 4
    feet = []
    for leg, side in enumerate(SIDES):
        middles = np.arange(leg - 2, count, 2) * STEP
        footholds = [
            Foothold(m - CONTACT / 2, m + CONTACT / 2, side * RUN_TRACK, SPEED * m + BALL_AHEAD / 2)
            for m in middles
        ]
        feet.append(stepping_foot(time, footholds, Swing(lift=0.22, toe_off=np.radians(40.0))))
    bounce = GRAVITY * (STEP / (2 * np.pi)) ** 2  # m; at its highest point the body falls freely
    height = CARRIAGE - bounce * np.cos(2 * np.pi * time / STEP)
    pelvis = np.stack([np.zeros_like(time), height, SPEED * time], axis=1)
    return _clip("run", Body(pelvis, np.zeros_like(time), (feet[0], feet[1]), fps))


def jump(seconds: float, fps: float = 60.0) -> Clip:
    """A standing jump forward by 0.6 m, with its take-off in the middle of the clip."""
    time, off = _times(seconds, fps), 0.45 * seconds
    on, rise = off + FLIGHT, GRAVITY * FLIGHT / 2
    feet = [
        stepping_foot(
            time,
            [
                Foothold(-1.0, off, side * TRACK, BALL_AHEAD),
                Foothold(on, seconds + 1.0, side * TRACK, BALL_AHEAD + LENGTH),
            ],
            Swing(lift=0.30, toe_off=np.radians(55.0)),
        )
        for side in SIDES
    ]
    low, top = STANDING - COUNTERMOVEMENT, STANDING - BENT
    knots = [
        (-1.0, STANDING, 0.0, 0.0), (off - 0.75, STANDING, 0.0, 0.0), (off - 0.3, low, 0.0),
        (off, top, rise, -GRAVITY), (on, top, -rise, -GRAVITY), (on + 0.3, low, 0.0),
        (on + 0.9, STANDING, 0.0, 0.0), (seconds + 1.0, STANDING, 0.0, 0.0),
    ]  # fmt: skip
    moved = LENGTH * smoothstep((time - off + 0.25) / (FLIGHT + 0.5))
    pelvis = np.stack([np.zeros_like(time), _through(knots, time), moved], axis=1)
    return _clip("jump", Body(pelvis, np.zeros_like(time), (feet[0], feet[1]), fps))


def crouch(seconds: float, fps: float = 60.0) -> Clip:
    """Down into a crouch, and up again; the feet stand flat all the time."""
    return _on_flat_feet("crouch", _down_and_up(seconds, fps)[:, None] * [0.0, -DEPTH, 0.0], fps)


def squat(seconds: float, fps: float = 60.0) -> Clip:
    """Down until the legs hardly fold further, the pelvis behind the heels, and up again."""
    way = _down_and_up(seconds, fps)[:, None] * [0.0, -SQUAT, -SQUAT_BACK]
    return _on_flat_feet("squat", way, fps)


def sit(seconds: float, fps: float = 60.0) -> Clip:
    """Down onto a bench behind the feet, and up again."""
    way = _down_and_up(seconds, fps)[:, None] * [0.0, -SEAT, -SEAT_BACK]
    return _on_flat_feet("sit", way, fps)


def idle(seconds: float, fps: float = 60.0) -> Clip:
    """Standing still, but for a sway of the pelvis from side to side."""
    sway = SWAY * np.sin(2.0 * np.pi * _times(seconds, fps) / SWAY_SECONDS)
    return _on_flat_feet("idle", sway[:, None] * [1.0, 0.0, 0.0], fps)


def _down_and_up(seconds: float, fps: float) -> Float64[np.ndarray, " frames"]:
    """0..1, from standing to as low as it goes, and back."""
    part = _times(seconds, fps) / seconds
    return smoothstep((part - 0.15) / 0.25) - smoothstep((part - 0.6) / 0.25)


def _on_flat_feet(name: str, moved: Float64[np.ndarray, "frames 3"], fps: float) -> Clip:
    """A body whose feet stand, and whose pelvis moves by so much, m."""
    time = np.arange(len(moved)) / fps
    still = [Foothold(-1.0, time[-1] + 1.0, side * TRACK, BALL_AHEAD) for side in SIDES]
    left, right = (stepping_foot(time, [foothold], Swing(0.0, 0.0)) for foothold in still)
    pelvis = moved + [0.0, STANDING, 0.0]
    return _clip(name, Body(pelvis, np.zeros_like(time), (left, right), fps))


def turn(seconds: float, fps: float = 60.0) -> Clip:
    """A turn to the left in place, 45 degrees with each step of either foot."""
    time = _times(seconds, fps)
    steps = int((seconds - 0.4) / STEP_SECONDS)
    feet = []
    for leg, side in enumerate(SIDES):
        begins = 0.2 + STEP_SECONDS * np.arange(leg, steps, 2)
        starts = np.concatenate([[-1.0], begins + 0.8 * STEP_SECONDS])
        ends = np.concatenate([begins, [seconds + 1.0]])
        yaws = STEP_ANGLE * np.arange(len(starts))
        footholds = [
            Foothold(start, end, *_beside(yaw, side * TRACK), yaw)
            for start, end, yaw in zip(starts, ends, yaws, strict=True)
        ]
        feet.append(stepping_foot(time, footholds, Swing(lift=0.07, toe_off=np.radians(15.0))))
    turned = np.sum(
        [smoothstep((time - 0.2) / STEP_SECONDS - step - 0.1) for step in range(steps)], axis=0
    )
    yaw = STEP_ANGLE / 2 * turned
    height = np.full_like(time, STANDING)
    pelvis = np.stack([np.zeros_like(time), height, np.zeros_like(time)], axis=1)
    return _clip("turn", Body(pelvis, yaw, (feet[0], feet[1]), fps))


def _times(seconds: float, fps: float) -> np.ndarray:
    return np.arange(round(seconds * fps)) / fps


def _beside(yaw: float, aside: float) -> tuple[float, float]:
    """x and z, m, of the ball of a foot that stands beside the origin, under a body with a yaw."""
    return (
        float(aside * np.cos(yaw) + BALL_AHEAD * np.sin(yaw)),
        float(-aside * np.sin(yaw) + BALL_AHEAD * np.cos(yaw)),
    )


def _through(knots: Sequence[Knot], time: np.ndarray) -> np.ndarray:
    """The polynomial pieces through knots, with their derivatives."""
    curve = BPoly.from_derivatives([knot[0] for knot in knots], [list(knot[1:]) for knot in knots])
    return curve(time)


def _clip(name: str, body: Body) -> Clip:
    return body.clip(name, body.sinking())
