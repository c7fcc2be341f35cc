"""Walks that know their footholds, and ground of blocks for them to meet."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from reference import maths, sample_poses
from reference.characters import Frame, Rig, Stride
from reference.maths import Transform
from reference.terrain import Terrain

HZ = 60.0
SPEED = 0.9  # m/s
CYCLE = 1.0  # s
STANCE = 0.6  # share of the cycle
HEEL_OFF = 0.6  # share of the stance after which the heel rises
HEEL_RISE = 0.7  # rad, by which it has risen at its end
LANDED = 0.04  # of the cycle for which the ball already rests before the foot counts as standing
SWING_HEIGHT = 0.12  # m
BALL_HEIGHT = 0.055  # m, of a standing foot's toe joint
BALL_AHEAD = 0.10  # m, of the root in the middle of a stance
BALL_REACH = np.array(
    [0.0, BALL_HEIGHT - sample_poses.ANKLE, 0.15]
)  # m, from the ankle of a flat foot


class Step(NamedTuple):
    """One foot at one time: its ball ahead of where the walk began, m, and the foot's pitch."""

    standing: float
    last: float
    next: float
    share: float
    height: float
    pitch: float  # rad, toes down

    @property
    def ahead(self) -> float:
        return maths.lerp(self.last, self.next, maths.smooth01(self.share))


def step_at(time: float, turn: float, speed: float) -> Step:
    """Of the foot that comes down `turn` of a cycle after the walk began."""
    cycle, phase = divmod(time / CYCLE - turn, 1.0)
    last = speed * CYCLE * (cycle + turn + STANCE / 2) + BALL_AHEAD
    following = last + speed * CYCLE
    if phase < STANCE:
        risen = maths.smooth01((phase / STANCE - HEEL_OFF) / (1.0 - HEEL_OFF))
        return Step(1.0, last, following, 0.0, BALL_HEIGHT, HEEL_RISE * risen)
    share = min((phase - STANCE) / (1.0 - STANCE - LANDED), 1.0)
    height = BALL_HEIGHT + SWING_HEIGHT * np.sin(np.pi * share) ** 2
    left = 1.0 - maths.smooth01(share / 0.6)
    return Step(0.0, last, following, share, height, HEEL_RISE * left)


def walk(
    rig: Rig,
    count: int,
    *,
    hz: float = HZ,
    told: bool = True,
    speed: float = SPEED,
    heading: float = 0.0,
    start: Any = (0.0, 0.0, 0.0),
    hip_height: float = 0.915,
    **changes: Any,
) -> list[Frame]:
    """A walk on a flat floor: balls that stand still, heels that rise about them, straight knees.

    Args:
        rig: joint spaces of legs that take turns.
        count: frames.
        hz: frames a second.
        told: whether the stride is, and not just which feet stand.
        speed: m/s.
        heading: of the walk about up, rad.
        start: of the root, m.
        hip_height: m.
        changes: of every frame.
    """
    turned = maths.from_axis_angle(maths.Y, heading)
    legs = len(rig.side)
    frames = []
    for index in range(count):
        time = index / hz
        steps = [step_at(time, leg / legs, speed) for leg in range(legs)]
        root = Transform(np.asarray(start) + maths.rotate(turned, speed * time * maths.Z), turned)
        stride = Stride(
            standing=np.array([step.standing for step in steps]),
            last_ws=_places([step.last for step in steps], rig, turned, start),
            next_ws=_places([step.next for step in steps], rig, turned, start),
            fraction=np.array([step.share for step in steps]),
            known=np.full(legs, float(told)),
        )
        frames.append(_posed(rig, steps, speed * time, root, stride, hip_height, 1.0 / hz))
    return [dataclasses.replace(frame, **changes) for frame in sample_poses.with_speeds(frames)]


def _places(aheads: Sequence[float], rig: Rig, turned: np.ndarray, start: Any) -> np.ndarray:
    """Balls (legs, 3) of feet that stand, world, m."""
    places = [
        [0.1 * side, BALL_HEIGHT, ahead] for side, ahead in zip(rig.side, aheads, strict=True)
    ]
    return np.array([start + maths.rotate(turned, np.array(place)) for place in places])


def _posed(
    rig: Rig,
    steps: list[Step],
    travelled: float,
    root: Transform,
    stride: Stride,
    hip_height: float,
    dt: float,
) -> Frame:
    """The frame of these steps."""
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
    most: float = 0.14,
    tilt: float = 0.15,
    odd: bool = True,
) -> Terrain:
    """Square tops of blocks around the origin, each at a height and tilt of its own.

    Args:
        rng: draws them.
        columns: of blocks, sideways.
        rows: likewise, forward.
        size: of a block, m.
        most: height over or under the floor, m.
        tilt: largest tangent of a top's slope.
        odd: some blocks are missing, some far too high, some far too steep.
    """
    triangles = []
    for column in range(columns):
        for row in range(rows):
            height = rng.uniform(-most, most)
            slopes = rng.uniform(-tilt, tilt, size=2)
            kind = rng.uniform() if odd else 1.0
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
