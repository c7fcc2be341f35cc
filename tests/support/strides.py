"""Synthetic walks with known footholds, and terrain made of blocks."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from reference import maths, sample_poses
from reference.characters import Frame, Rig, Stride
from reference.maths import Transform
from reference.terrain import Terrain

WAYS = ("aside_ws", "last_ahead_ws", "next_ahead_ws")  # of strides, which may be None
HZ = 60.0
SPEED = 0.9  # m/s
CYCLE = 1.0  # s
STANCE = 0.6  # fraction of the cycle
HEEL_OFF = 0.6  # fraction of the stance after which the heel rises
HEEL_RISE = 0.7  # rad, pitch of the foot at the end of its stance
LANDED = 0.04  # fraction of the cycle that the ball rests before the foot counts as standing
SWING_HEIGHT = 0.12  # m
BALL_HEIGHT = 0.055  # m, of a standing foot's toe joint
BALL_AHEAD = 0.10  # m, ahead of the root in mid-stance
BALL_REACH = np.array(
    [0.0, BALL_HEIGHT - sample_poses.ANKLE, 0.15]
)  # m, from the ankle of a flat foot


class Step(NamedTuple):
    """One foot at one time; distances are those of its ball from where the walk began, m."""

    standing: float
    last: float
    next: float
    fraction: float
    height: float
    pitch: float  # rad, toes down

    @property
    def ahead(self) -> float:
        return maths.lerp(self.last, self.next, maths.smooth01(self.fraction))


def step_at(time: float, offset: float, speed: float) -> Step:
    """The foot that lands `offset` cycles after the walk began."""
    cycle, phase = divmod(time / CYCLE - offset, 1.0)
    last = speed * CYCLE * (cycle + offset + STANCE / 2) + BALL_AHEAD
    following = last + speed * CYCLE
    if phase < STANCE:
        heel_rise = maths.smooth01((phase / STANCE - HEEL_OFF) / (1.0 - HEEL_OFF))
        return Step(1.0, last, following, 0.0, BALL_HEIGHT, HEEL_RISE * heel_rise)
    fraction = min((phase - STANCE) / (1.0 - STANCE - LANDED), 1.0)
    height = BALL_HEIGHT + SWING_HEIGHT * np.sin(np.pi * fraction) ** 2
    heel_rise = 1.0 - maths.smooth01(fraction / 0.6)
    return Step(0.0, last, following, fraction, height, HEEL_RISE * heel_rise)


def walk(
    rig: Rig,
    count: int,
    *,
    hz: float = HZ,
    known: bool = True,
    speed: float = SPEED,
    heading: float = 0.0,
    start: Any = (0.0, 0.0, 0.0),
    hip_height: float = 0.915,
    **changes: Any,
) -> list[Frame]:
    """A walk on a flat floor with still balls of standing feet, rising heels and straight knees.

    Args:
        rig: joint spaces of the legs, which step in turn.
        count: frames.
        hz: frames per second.
        known: whether footholds are known; if not, only which feet stand.
        speed: of the walk, m/s.
        heading: of the walk about up, rad.
        start: of the root, m.
        hip_height: m.
        changes: fields that are the same in all frames.
    """
    heading_rot = maths.from_axis_angle(maths.Y, heading)
    legs = len(rig.side)
    frames = []
    for index in range(count):
        time = index / hz
        steps = [step_at(time, leg / legs, speed) for leg in range(legs)]
        root = Transform(
            np.asarray(start) + maths.rotate(heading_rot, speed * time * maths.Z), heading_rot
        )
        stride = Stride(
            standing=np.array([step.standing for step in steps]),
            last_ws=_balls_ws([step.last for step in steps], rig, heading_rot, start),
            next_ws=_balls_ws([step.next for step in steps], rig, heading_rot, start),
            fraction=np.array([step.fraction for step in steps]),
            known=np.full(legs, float(known)),
        )
        frames.append(_frame_of(rig, steps, speed * time, root, stride, hip_height, 1.0 / hz))
    return [dataclasses.replace(frame, **changes) for frame in sample_poses.with_speeds(frames)]


def _balls_ws(
    distances: Sequence[float], rig: Rig, heading_rot: np.ndarray, start: Any
) -> np.ndarray:
    """Balls of standing feet, (legs, 3), m, world space."""
    points = [
        [0.1 * side, BALL_HEIGHT, distance]
        for side, distance in zip(rig.side, distances, strict=True)
    ]
    return np.array([start + maths.rotate(heading_rot, np.array(point)) for point in points])


def _frame_of(
    rig: Rig,
    steps: list[Step],
    travelled: float,
    root: Transform,
    stride: Stride,
    hip_height: float,
    dt: float,
) -> Frame:
    """The frame with feet as in `steps`."""
    balls = np.array(
        [
            [0.1 * side, step.height, step.ahead - travelled]
            for side, step in zip(rig.side, steps, strict=True)
        ]
    )
    pitches = [maths.from_axis_angle(maths.X, step.pitch) for step in steps]
    ankles = balls - np.array([maths.rotate(pitch, BALL_REACH) for pitch in pitches])
    frame = sample_poses.make_frame(
        rig, ankles, hip_height=hip_height, world_from_model=root, stride=stride, dt=dt
    )
    rots = [maths.multiply(p, rot) for p, rot in zip(pitches, frame.ankle.rot, strict=True)]
    return dataclasses.replace(
        frame,
        ankle=frame.ankle._replace(rot=np.array(rots)),
        toe=Transform(balls, np.array(rots)),
    )


def blocks(
    rng: np.random.Generator,
    columns: int = 4,
    rows: int = 15,
    size: float = 0.45,
    max_height: float = 0.14,
    tilt: float = 0.15,
    irregular: bool = True,
) -> Terrain:
    """Tops of square blocks around the origin, each with its own height and tilt.

    Args:
        rng: random numbers for heights and tilts.
        columns: number of blocks sideways.
        rows: number of blocks forward.
        size: side of a block, m.
        max_height: largest height above or below the floor, m.
        tilt: largest tangent of a top's slope.
        irregular: make some blocks missing, far too high, or far too steep.
    """
    triangles = []
    for column in range(columns):
        for row in range(rows):
            height = rng.uniform(-max_height, max_height)
            slopes = rng.uniform(-tilt, tilt, size=2)
            kind = rng.uniform() if irregular else 1.0
            if kind < 0.05:
                continue
            if kind < 0.10:
                height = rng.uniform(0.55, 0.8)
            elif kind < 0.15:
                slopes = rng.uniform(1.2, 2.5, size=2)
            corner = size * np.array([column - columns / 2, 0.0, row - rows / 2])
            a, b, c, d = (
                corner + np.array([x, height + (x * slopes[0] + z * slopes[1]), z])
                for x in (0.0, size)
                for z in (0.0, size)
            )
            triangles += [[a, b, c], [b, d, c]]
    return Terrain(maths.Y, triangles=np.array(triangles))
