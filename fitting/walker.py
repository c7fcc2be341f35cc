"""A walk made from measured curves: feet placed exactly, swings and pelvis as an average adult's.

Put straight through forward kinematics, the curves of `gait` leave feet sliding by centimetres. So
a standing foot is placed: it rolls over its heel, lies flat, and rises about a ball that does not
move. Between two stances the ball follows the curves, the gap to the placed feet blended in. The
pelvis follows its curve as far as both legs reach their feet; legs are closed by the cosine law, so
that bones keep their lengths exactly.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import convolve1d, maximum_filter1d
from scipy.spatial.transform import Rotation

from . import gait
from .clips.clip import Clip
from .clips.npz import leg_rotations, positions_clip
from .clips.rigs import unit

HALF_TRACK = 0.08  # m from the path to a foot
ALONG_SD, ASIDE_SD, LIFT_SD = 0.015, 0.008, 0.01  # m, of steps and of the height of swings
HEEL_OFF, RISEN = 0.28, 0.40  # phases: the heel leaves the ground, the measured pitch is reached
GLIDE = 0.43  # phase of the rear foot, the heel of the front one just down, in which a walk freezes
REACH = 0.992  # share of a leg's length to which it stretches: its knee keeps 15 degrees
SETTLE = 0.1  # s, before and after the pelvis gives way to a leg
EASE = 0.4  # s, shortest change between walking and gliding, and of a slip
DELTA = 1e-5  # of phase, for slopes
TURNS = (9.0, 5.3)  # m, wave lengths of the path's bends
JOINTS = ("pelvis", "left_hip", "left_knee", "left_ankle", "left_toe",
          "right_hip", "right_knee", "right_ankle", "right_toe")  # fmt: skip
PARENTS = (-1, 0, 1, 2, 3, 0, 5, 6, 7)


@dataclass(frozen=True)
class Slip:
    """Seconds in which the root travels at another speed than the feet step, as game roots do."""

    start: float  # s
    end: float
    share: float  # of the walking speed, added; below 0 the root lags


@dataclass(frozen=True)
class Slide:
    """Seconds in which the walk freezes and the whole body glides on at walking speed."""

    start: float  # s
    end: float


def walk(
    seconds: float = 12.0,
    fps: float = 60.0,
    seed: int = 0,
    *,
    turn: float = 0.09,
    variation: float = 1.0,
    slips: Sequence[Slip] = (),
    slides: Sequence[Slide] = (),
) -> Clip:
    """A walk over the floor y = 0, from the origin along +z, with its contact labels.

    A foot is labelled as standing while its ball is placed. It then does not move, but for slips
    and slides: they carry the whole body along, standing feet included.

    Args:
        seconds: length of the clip.
        fps: frames per second.
        seed: of the differences between strides.
        turn: rad, how far the path turns away from +z to either side, about.
        variation: of strides, as a share of the measured one; 0 makes all alike.
        slips: spells in which the root runs ahead of the feet or lags behind.
        slides: spells of sliding, apart by 2 s or more; `Clip.slide` is 1 in them.

    Raises:
        ValueError: for a length or a rate that is not above 0, a spell that does not lie in the
            clip.
    """
    if not (seconds > 0 and fps > 0):
        raise ValueError(f"wanted seconds and fps above 0, got {seconds} s at {fps} fps")
    for spell in (*slips, *slides):
        if not 0 <= spell.start < spell.end <= seconds:
            raise ValueError(f"{spell} does not lie in the clip's {seconds} s")
    frames = round(seconds * fps)
    cadence, drift, slide = _pace(np.arange(frames) / fps, fps, slips, slides)
    phase = np.concatenate([[0.0], np.cumsum(cadence[:-1])]) / (fps * gait.PERIOD)
    strides = int(phase[-1]) + 3
    rng = np.random.default_rng(seed)
    path = _Path(turn, rng.uniform(0.0, 2.0 * np.pi))

    along = gait.STRIDE * phase
    yaw = path.yaw(along)
    travel = drift[:, None] * _forward(yaw)
    carried = np.concatenate([np.zeros((1, 3)), np.cumsum(travel[:-1], axis=0)]) / fps
    bob = _smooth_noise(phase, strides, rng) * gait.HEIGHT_SD * variation
    pelvis = path.at(along, 0.0, gait.curve(gait.HEIGHT, phase) + bob)
    left_ws = _forward(yaw + np.pi / 2)
    heading = Rotation.from_rotvec(yaw[:, None] * [0.0, 1.0, 0.0])
    sides = np.array([1.0, -1.0])
    hips = [
        pelvis + heading.apply([side * gait.HALF_PELVIS, -gait.HIP_DROP, 0.0]) for side in sides
    ]
    feet = [
        _Steps.draw(strides, side, late, path, variation, rng).foot(phase)
        for side, late in zip(sides, gait.LATE, strict=True)
    ]
    sunk = _sunk(hips, [foot.ankle for foot in feet], round(SETTLE * fps))

    positions, turns = [pelvis - sunk], [heading.as_quat(scalar_first=True)]
    for hip, foot in zip(hips, feet, strict=True):
        hip = hip - sunk
        knee = bent_knee(hip, foot.ankle, left_ws)
        positions += [hip, knee, foot.ankle, foot.ball]
        turns += [*leg_rotations(hip, knee, foot.ankle, left_ws), foot.rot, foot.rot]
    clip = positions_clip(
        JOINTS,
        PARENTS,
        np.stack(positions, axis=1) + carried[:, None],
        np.stack(turns, axis=1),
        float(fps),
        f"walker seed {seed}",
        (phase[:, None] - gait.LATE) % 1.0 < gait.BALL_OFF,
    )
    return replace(clip, slide=slide if len(slides) else None)


def bent_knee(hip: np.ndarray, ankle: np.ndarray, left_ws: np.ndarray) -> np.ndarray:
    """Knees, m, (frames, 3), that bend forward about the body's left; a leg reaches its ankle."""
    leg = ankle - hip
    distance = np.linalg.norm(leg, axis=-1, keepdims=True)
    along = leg / distance
    forth = (gait.THIGH**2 - gait.SHIN**2 + distance**2) / (2.0 * distance)
    return hip + along * forth - unit(np.cross(along, left_ws)) * np.sqrt(gait.THIGH**2 - forth**2)


def _sunk(hips: list[np.ndarray], ankles: list[np.ndarray], around: int) -> np.ndarray:
    """How far the body sinks, m, (frames, 3), smoothly, so that both legs reach."""
    short = np.zeros(len(hips[0]))
    for hip, ankle in zip(hips, ankles, strict=True):
        leg = hip - ankle
        highest = np.sqrt((REACH * (gait.THIGH + gait.SHIN)) ** 2 - leg[:, 0] ** 2 - leg[:, 2] ** 2)
        short = np.maximum(short, leg[:, 1] - highest)
    # A mean of maxima over the same window is nowhere below what is needed.
    window = np.hanning(2 * around + 3)[1:-1]
    widest = maximum_filter1d(short, len(window), mode="nearest")
    sunk = convolve1d(widest, window / window.sum(), mode="nearest")
    return sunk[:, None] * [0.0, 1.0, 0.0]


@dataclass(frozen=True)
class _Foot:
    """One foot over the frames."""

    ball: Float64[np.ndarray, "frames 3"]  # m
    ankle: Float64[np.ndarray, "frames 3"]  # m
    rot: Float64[np.ndarray, "frames 4"]  # wxyz


@dataclass(frozen=True)
class _Path:
    """A line over the floor, by its z, m, with gentle bends."""

    turn: float  # rad
    start: float  # rad, phase of the bends

    def yaw(self, z: np.ndarray) -> np.ndarray:
        """Heading, rad; 0 looks along +z."""
        return np.arctan(self._sum(z, np.cos, 0))

    def at(self, z: np.ndarray, left: np.ndarray | float, height: np.ndarray) -> np.ndarray:
        """The points `left` of the path, m, over z and at a height."""
        x = self._sum(z, np.sin, 1) - self._sum(np.zeros(1), np.sin, 1)
        on_path = np.stack([x, height, z], axis=-1)
        return on_path + np.asarray(left)[..., None] * _forward(self.yaw(z) + np.pi / 2)

    def _sum(self, z: np.ndarray, wave: Callable, power: int) -> np.ndarray:
        rates = [2.0 * np.pi / length for length in TURNS]
        waves = [wave(k * z + self.start) / k**power for k in rates]
        return 0.5 * self.turn * np.sum(waves, axis=0)


@dataclass(frozen=True)
class _Steps:
    """Where one foot stands, stride by stride, and how it gets there."""

    late: float  # phase, of this foot after the other
    side: float  # +1 left, -1 right
    path: _Path
    along: Float64[np.ndarray, " strides"]  # m, of the ball over the path
    aside: Float64[np.ndarray, " strides"]  # m, to the left of the path
    lift: Float64[np.ndarray, " strides"]  # m, added to the swing after
    pitch: Float64[np.ndarray, " strides"]  # rad, added to it

    @classmethod
    def draw(
        cls,
        strides: int,
        side: float,
        late: float,
        path: _Path,
        variation: float,
        rng: np.random.Generator,
    ) -> "_Steps":
        """Steps with measured differences; the ball stands amid its measured drift."""
        phase = np.linspace(gait.HEEL_ON - 1.0, gait.BALL_OFF, 50)
        middle = np.mean(gait.ball(phase)[0] + gait.STRIDE * phase)
        stances = np.arange(-1, strides + 1)  # those before the first frame, too
        jitter = variation * rng.normal(size=(4, len(stances)))
        return cls(
            late,
            side,
            path,
            gait.STRIDE * (stances + late) + middle + ALONG_SD * jitter[0],
            side * HALF_TRACK + ASIDE_SD * jitter[1],
            LIFT_SD * np.abs(jitter[2]),
            gait.PITCH_SD * jitter[3],
        )

    def foot(self, phase: np.ndarray) -> _Foot:
        """The foot at these phases of the walk."""
        phase = phase - self.late
        stance = np.floor(phase).astype(int)
        own = phase - stance
        share = np.clip((own - gait.BALL_OFF) / (gait.HEEL_ON - gait.BALL_OFF), 0.0, 1.0)
        landed = (own >= gait.HEEL_ON).astype(int)

        start = self._rolled(stance, np.full_like(own, gait.BALL_OFF))
        fast = self._slope(self._measured, stance, gait.BALL_OFF)
        gap = start - self._measured(stance, np.full_like(own, gait.BALL_OFF))
        end = self._rolled(stance + 1, np.full_like(own, gait.HEEL_ON - 1.0))
        end_gap = end - self._measured(stance, np.full_like(own, gait.HEEL_ON))
        end_fast = self._slope(self._rolled, stance + 1, gait.HEEL_ON - 1.0)
        end_fast = end_fast - self._slope(self._measured, stance, gait.HEEL_ON)
        span = gait.HEEL_ON - gait.BALL_OFF
        swung = self._measured(stance, own)
        swung += _hermite(share, gap, -span * fast, end_gap, span * end_fast)
        swung[:, 1] += self.lift[stance + 1] * np.sin(np.pi * share) ** 2
        placed = self._rolled(stance + landed, own - landed)
        swings = (own > gait.BALL_OFF) & (own < gait.HEEL_ON)
        ball = np.where(swings[:, None], swung, placed)

        here, there = self._yaw(stance), self._yaw(stance + 1)
        yaw = here + smoothstep(share) * (there - here)
        pitch = self._pitch(stance, own)
        ankle = ball - gait.FOOT * _pitched(yaw, pitch)
        turned = Rotation.from_rotvec(yaw[:, None] * [0.0, 1.0, 0.0])
        tilted = Rotation.from_rotvec((gait.FLAT - pitch)[:, None] * [1.0, 0.0, 0.0])
        return _Foot(ball, ankle, (turned * tilted).as_quat(scalar_first=True))

    def _pitch(self, stance: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Ankle to ball above horizontal, rad: flat in the stance, measured in the swing."""
        free = smoothstep((own - HEEL_OFF) / (RISEN - HEEL_OFF))
        free = free * smoothstep((1.0 - own) / (1.0 - gait.HEEL_ON))
        share = np.clip((own - gait.BALL_OFF) / (gait.HEEL_ON - gait.BALL_OFF), 0.0, 1.0)
        swing = self.pitch[stance + 1] * np.sin(np.pi * share) ** 2
        return gait.FLAT + free * (np.radians(gait.curve(gait.PITCH, own)) - gait.FLAT) + swing

    def _yaw(self, stance: np.ndarray) -> np.ndarray:
        return self.path.yaw(self.along[stance + 1])

    def _rolled(self, stance: np.ndarray, own: np.ndarray) -> np.ndarray:
        """The ball of a placed foot; before its phase 0 the foot turns about its heel."""
        place = self.path.at(
            self.along[stance + 1], self.aside[stance + 1], np.full(own.shape, gait.BALL_HEIGHT)
        )
        tilt = np.where(own < 0, self._pitch(stance, own % 1.0) - gait.FLAT, 0.0)
        reach = gait.HEEL + gait.FOOT * np.cos(gait.FLAT)
        ahead = reach * (np.cos(tilt) - 1.0) - gait.BALL_HEIGHT * np.sin(tilt)
        above = reach * np.sin(tilt) + gait.BALL_HEIGHT * (np.cos(tilt) - 1.0)
        forward = _forward(self._yaw(stance))
        return place + ahead[:, None] * forward + above[:, None] * [0.0, 1.0, 0.0]

    def _measured(self, stance: np.ndarray, own: np.ndarray) -> np.ndarray:
        """The ball as the curves alone have it."""
        ahead, height, outward = gait.ball(own)
        ahead = ahead + gait.STRIDE * (stance + self.late + own)
        return self.path.at(ahead, self.side * (HALF_TRACK + outward), height)

    def _slope(self, ball: Callable, stance: np.ndarray, own: float) -> np.ndarray:
        """Metres per stride's phase at which a curve of the ball moves."""
        at = np.full(stance.shape, own)
        return (ball(stance, at + DELTA) - ball(stance, at - DELTA)) / (2.0 * DELTA)


def _pace(
    time: np.ndarray, fps: float, slips: Sequence[Slip], slides: Sequence[Slide]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cadence as a share of the walk's, added speed of the whole body, m/s, and the slide input.

    A walk slows down so that it freezes with both feet down.
    """
    speed = gait.STRIDE / gait.PERIOD
    cadence, slide = np.ones_like(time), np.zeros_like(time)
    for one in sorted(slides, key=lambda one: one.start):
        begun = cadence[time < one.start].sum() / (fps * gait.PERIOD)
        left = (GLIDE - begun - 0.2) % 0.5 + 0.2  # of a stride, until the walk freezes
        down = smoothstep((time - one.start) / (2.0 * gait.PERIOD * left))
        up = smoothstep((time - one.end) / EASE)
        cadence *= 1.0 - np.minimum(down, 1.0 - up)
        slide[(time >= one.start) & (time < one.end)] = 1.0
    drift = speed * (1.0 - cadence)
    for one in slips:
        edges = smoothstep((time - one.start) / EASE) * smoothstep((one.end - time) / EASE)
        drift = drift + one.share * speed * edges * cadence
    return cadence, drift, slide


def smoothstep(share: np.ndarray) -> np.ndarray:
    """0 to 1 over a share of 0 to 1, level to the second order at both ends."""
    x = np.clip(share, 0.0, 1.0)
    return x**3 * (10.0 + x * (6.0 * x - 15.0))


def _hermite(
    share: np.ndarray, start: np.ndarray, rise: np.ndarray, end: np.ndarray, end_rise: np.ndarray
) -> np.ndarray:
    """The cubic with these ends and slopes, the slopes per whole share."""
    x = share[:, None]
    turn = (1.0 - x) ** 2 * ((1.0 + 2.0 * x) * start + x * rise)
    return turn + x**2 * ((3.0 - 2.0 * x) * end + (x - 1.0) * end_rise)


def _smooth_noise(phase: np.ndarray, strides: int, rng: np.random.Generator) -> np.ndarray:
    """A curve through a normal draw a stride."""
    knots = rng.normal(size=strides + 1)
    stride = np.floor(phase).astype(int)
    return knots[stride] + smoothstep(phase - stride) * (knots[stride + 1] - knots[stride])


def _forward(yaw: np.ndarray) -> np.ndarray:
    return np.stack([np.sin(yaw), np.zeros_like(yaw), np.cos(yaw)], axis=-1)


def _pitched(yaw: np.ndarray, pitch: np.ndarray) -> np.ndarray:
    flat = np.cos(pitch)[:, None] * _forward(yaw)
    return flat + np.sin(pitch)[:, None] * [0.0, 1.0, 0.0]
