"""Synthetic actions besides walking: a run, a jump, a crouch, a turn in place.

Each is on the floor y = 0 and begins at the origin, facing +z, with its true contact labels. Feet
stand still exactly; the pelvis moves smoothly, and falls freely while no foot stands.
"""

from collections.abc import Sequence

import numpy as np
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
    time, sink = _times(seconds, fps), 0.25 * seconds
    down = smoothstep((time - 0.15 * seconds) / sink)
    up = smoothstep((time - 0.6 * seconds) / sink)
    height = STANDING - DEPTH * (down - up)
    pelvis = np.stack([np.zeros_like(time), height, np.zeros_like(time)], axis=1)
    feet = [
        stepping_foot(time, [Foothold(-1.0, seconds + 1.0, s * TRACK, BALL_AHEAD)], Swing(0, 0))
        for s in SIDES
    ]
    return _clip("crouch", Body(pelvis, np.zeros_like(time), (feet[0], feet[1]), fps))


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
