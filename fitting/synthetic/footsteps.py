"""Footsteps: where each foot stands, and how it moves from one foothold to the next.

In the walk a standing foot rolls over its heel, lies flat, and rises about a ball that does not
move. Between two stances the ball follows measured curves, and the gap between those
and the placed feet is blended in. The curves are one stride of an average adult, the mean of six
(CMU motion capture database, subject 02, trials 01 and 02, floor tilt removed), as Fourier series
over its phase 0..1. Phase 0 is the touchdown of the ball of the foot; the other foot is half a
stride later.

Feet with given footholds lie flat, rise about the ball, and swing as people move their
hands: along the path of minimum jerk, with an arc above it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial.transform import Rotation

WAVELENGTHS = (9.0, 5.3)  # m, of a path's bends

SIDES = (1.0, -1.0)  # left, right
HALF_TRACK = 0.08  # m from the path to a foot
ALONG_SD, ASIDE_SD, LIFT_SD = 0.015, 0.008, 0.01  # m, of footholds and of the height of swings
HEEL_OFF, FULL_PITCH = 0.28, 0.40  # phases: the heel leaves the ground, the pitch is as measured
PHASE_STEP = 1e-5  # for slopes by central differences

BallCurve = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Position of the ball, m, (frames, 3), from stance index and phase within the stride."""


HEEL_RISE = 0.12  # s, before the foot leaves the ground

THIGH, SHIN, FOOT = 0.43, 0.41, 0.126  # m; the foot is from ankle to ball
STRIDE, PERIOD = 1.47, 1.05  # m and s, of two steps
ANKLE_HEIGHT, BALL_HEIGHT = 0.085, 0.045  # m above the sole of a flat foot
HEEL = 0.05  # m behind the ankle
HALF_PELVIS, HIP_DROP = 0.09, 0.05  # m from pelvis to hip, sideways and down
FLAT = -np.arcsin((ANKLE_HEIGHT - BALL_HEIGHT) / FOOT)  # rad, ankle to ball, of a flat foot
BALL_OFF, HEEL_ON = 0.45, 0.88  # phases of ball lift-off and heel strike
PHASE_OFFSETS = (0.0, 0.5)  # of each foot, left first

# Mean, then cosine and sine coefficient of each harmonic.
HIP = (  # degrees, thigh forward of vertical
    12.086, (22.070, -13.118), (-4.958, 2.500), (2.033, -0.540), (0.426, 0.561), (0.210, 0.064)
)  # fmt: skip
ABDUCTION = (  # degrees, thigh outward
    -5.410, (-2.244, -2.275), (-0.565, 0.645), (0.222, -0.444), (-0.254, -0.046), (-0.070, -0.019)
)  # fmt: skip
KNEE = (  # degrees, 0 is straight
    37.680, (-1.385, -17.136), (-5.922, 17.120), (5.318, -0.832), (1.985, 1.240), (0.445, -0.259)
)  # fmt: skip
PITCH = (  # degrees, ankle to ball above horizontal
    -32.259, (30.848, 11.346), (-4.487, -20.753), (-4.462, 3.073), (-1.292, -2.621), (-2.124, 1.812)
)  # fmt: skip
HEIGHT = (0.925, (0.0, 0.0), (-0.012, 0.001), (-0.001, 0.0), (-0.003, 0.0))  # m, of the pelvis
PITCH_SD, HEIGHT_SD = np.radians(4.1), 0.01  # rad and m, standard deviation over strides


def smoothstep(x: np.ndarray) -> np.ndarray:
    """Quintic from 0 to 1 as x goes from 0 to 1, with zero slope and curvature at both ends."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10.0 + x * (6.0 * x - 15.0))


def hermite(
    x: np.ndarray, start: np.ndarray, slope: np.ndarray, end: np.ndarray, end_slope: np.ndarray
) -> np.ndarray:
    """Cubic Hermite curve at `x` in 0..1, with these end values and slopes (per unit of x)."""
    x = x[:, None]
    first = (1.0 - x) ** 2 * ((1.0 + 2.0 * x) * start + x * slope)
    return first + x**2 * ((3.0 - 2.0 * x) * end + (x - 1.0) * end_slope)


def heading_vectors(yaw: np.ndarray) -> np.ndarray:
    """Unit vectors, (..., 3), of headings in rad: 0 faces +z, pi/2 faces +x."""
    return np.stack([np.sin(yaw), np.zeros_like(yaw), np.cos(yaw)], axis=-1)


@dataclass(frozen=True)
class GroundPath:
    """A gently bending line over the floor, through x = 0 at z = 0, as a function of z, m."""

    bend: float
    """rad, about how far the path turns away from +z to either side."""
    phase: float
    """rad, of the bends at z = 0."""

    def yaw(self, z: np.ndarray) -> np.ndarray:
        """Heading, rad; 0 faces +z."""
        return np.arctan(self._sum_of_waves(z, np.cos, 0))

    def points(self, z: np.ndarray, left: np.ndarray | float, height: np.ndarray) -> np.ndarray:
        """Points to the left of the path by `left`, m, at heights above the floor, m."""
        x = self._sum_of_waves(z, np.sin, 1) - self._sum_of_waves(np.zeros(1), np.sin, 1)
        on_path = np.stack([x, height, z], axis=-1)
        return on_path + np.asarray(left)[..., None] * heading_vectors(self.yaw(z) + np.pi / 2)

    def _sum_of_waves(
        self, z: np.ndarray, wave: Callable[[np.ndarray], np.ndarray], power: int
    ) -> np.ndarray:
        """The waves divided by their wave numbers to a power: 1 integrates them."""
        wave_numbers = [2.0 * np.pi / length for length in WAVELENGTHS]
        waves = [wave(k * z + self.phase) / k**power for k in wave_numbers]
        return 0.5 * self.bend * np.sum(waves, axis=0)


@dataclass(frozen=True)
class FootMotion:
    """One foot over the frames."""

    ball: Float64[np.ndarray, "frames 3"]
    """Metres."""
    ankle: Float64[np.ndarray, "frames 3"]
    """Metres."""
    rot: Float64[np.ndarray, "frames 4"]
    """Unit quaternions, wxyz."""
    stance: Bool[np.ndarray, " frames"]
    """True while its ball is placed."""


@dataclass(frozen=True)
class Footsteps:
    """The footholds of one foot, one per stride, and the differences between its swings.

    Arrays begin with the foothold before the first frame, so stance i is at index i + 1.
    """

    phase_offset: float
    """Of this foot."""
    side: float
    """1 left, -1 right."""
    path: GroundPath
    along: Float64[np.ndarray, " strides"]
    """m, position of the ball along the path."""
    aside: Float64[np.ndarray, " strides"]
    """m, to the left of the path."""
    lift: Float64[np.ndarray, " strides"]
    """m, added to the height of the following swing."""
    pitch: Float64[np.ndarray, " strides"]
    """rad, added to its pitch."""

    def motion(self, phase: np.ndarray, still: np.ndarray) -> FootMotion:
        """The foot over the frames.

        Args:
            phase: of the walk, in strides, (frames,).
            still: 0..1, (frames,); as it rises to 1 the foot settles flat.
        """
        phase, still = phase - self.phase_offset, still.copy()
        stance = np.floor(phase).astype(int)
        phase = phase - stance
        swing = (phase - BALL_OFF) / (HEEL_ON - BALL_OFF)
        swing = np.clip(swing, 0.0, 1.0)
        landed = (phase >= HEEL_ON).astype(int)
        for frame in np.flatnonzero(landed[1:] & landed[:-1]) + 1:
            still[frame] = max(still[frame], still[frame - 1])  # once flat, it does not tilt again

        swinging_ball = self._swinging_ball(stance, phase, swing)
        placed_ball = self._placed_ball(stance + landed, phase - landed, still)
        swinging = (phase > BALL_OFF) & (phase < HEEL_ON)
        ball = np.where(swinging[:, None], swinging_ball, placed_ball)

        yaw, next_yaw = self._yaw(stance), self._yaw(stance + 1)
        yaw = yaw + smoothstep(swing) * (next_yaw - yaw)
        pitch = self._pitch(stance, phase, still)
        stands = (phase < BALL_OFF) | (still >= 1.0)  # rounding may lift `still` above 1
        return _foot_motion(ball, yaw, pitch, stands)

    def _swinging_ball(
        self, stance: np.ndarray, phase: np.ndarray, swing: np.ndarray
    ) -> np.ndarray:
        """The ball between two stances: the measured curve, joined smoothly to the placed foot.

        The difference between the two, in position and velocity, fades as a Hermite curve.
        """
        lift_off, landing = np.full_like(phase, BALL_OFF), np.full_like(phase, HEEL_ON)
        start = self._placed_ball(stance, lift_off)
        start_slope = self._slope(self._measured_ball, stance, BALL_OFF)
        start_gap = start - self._measured_ball(stance, lift_off)
        end = self._placed_ball(stance + 1, np.full_like(phase, HEEL_ON - 1.0))
        end_gap = end - self._measured_ball(stance, landing)
        end_slope = self._slope(self._placed_ball, stance + 1, HEEL_ON - 1.0)
        end_slope = end_slope - self._slope(self._measured_ball, stance, HEEL_ON)
        span = HEEL_ON - BALL_OFF
        ball = self._measured_ball(stance, phase)
        ball += hermite(swing, start_gap, -span * start_slope, end_gap, span * end_slope)
        ball[:, 1] += self.lift[stance + 1] * np.sin(np.pi * swing) ** 2
        return ball

    def _pitch(
        self, stance: np.ndarray, phase: np.ndarray, still: np.ndarray | float = 0.0
    ) -> np.ndarray:
        """Ankle to ball above horizontal, rad: flat in the stance, as measured in the swing."""
        free = smoothstep((phase - HEEL_OFF) / (FULL_PITCH - HEEL_OFF))
        free = free * smoothstep((1.0 - phase) / (1.0 - HEEL_ON)) * (1.0 - still)
        swing = (phase - BALL_OFF) / (HEEL_ON - BALL_OFF)
        change = self.pitch[stance + 1] * np.sin(np.pi * np.clip(swing, 0.0, 1.0)) ** 2
        measured = np.radians(curve(PITCH, phase))
        return FLAT + free * (measured - FLAT) + change

    def _yaw(self, stance: np.ndarray) -> np.ndarray:
        return self.path.yaw(self.along[stance + 1])

    def _placed_ball(
        self, stance: np.ndarray, phase: np.ndarray, still: np.ndarray | float = 0.0
    ) -> np.ndarray:
        """The ball of a standing foot; before phase 0 the foot rotates about its heel."""
        height = np.full(phase.shape, BALL_HEIGHT)
        foothold = self.path.points(self.along[stance + 1], self.aside[stance + 1], height)
        tilt = np.where(phase < 0, self._pitch(stance, phase % 1.0, still) - FLAT, 0.0)
        reach = HEEL + FOOT * np.cos(FLAT)
        ahead = reach * (np.cos(tilt) - 1.0) - BALL_HEIGHT * np.sin(tilt)
        above = reach * np.sin(tilt) + BALL_HEIGHT * (np.cos(tilt) - 1.0)
        forward = heading_vectors(self._yaw(stance))
        return foothold + ahead[:, None] * forward + above[:, None] * [0.0, 1.0, 0.0]

    def _measured_ball(self, stance: np.ndarray, phase: np.ndarray) -> np.ndarray:
        """The ball as the measured curves alone place it."""
        ahead, height, outward = ball(phase)
        ahead = ahead + STRIDE * (stance + self.phase_offset + phase)
        return self.path.points(ahead, self.side * (HALF_TRACK + outward), height)

    def _slope(self, ball: BallCurve, stance: np.ndarray, phase: float) -> np.ndarray:
        """Derivative of a curve of the ball, m per stride."""
        at = np.full(stance.shape, phase)
        return (ball(stance, at + PHASE_STEP) - ball(stance, at - PHASE_STEP)) / (2.0 * PHASE_STEP)


def sample_footsteps(
    leg: int, strides: int, path: GroundPath, variation: float, rng: np.random.Generator
) -> Footsteps:
    """Footsteps along a path, with random differences between strides.

    The ball stands in the middle of its drift in the measured curves.

    Args:
        leg: 0 left, 1 right.
        strides: how many.
        path: which the walk follows.
        variation: 0 makes all strides alike, 1 varies them as measured.
        rng: source of the differences.
    """
    phase = np.linspace(HEEL_ON - 1.0, BALL_OFF, 50)
    middle = np.mean(ball(phase)[0] + STRIDE * phase)
    stances = np.arange(-1, strides + 1)  # including the one before the first frame
    noise = variation * rng.normal(size=(4, len(stances)))
    offset, side = PHASE_OFFSETS[leg], SIDES[leg]
    return Footsteps(
        offset,
        side,
        path,
        along=STRIDE * (stances + offset) + middle + ALONG_SD * noise[0],
        aside=side * HALF_TRACK + ASIDE_SD * noise[1],
        lift=LIFT_SD * np.abs(noise[2]),
        pitch=PITCH_SD * noise[3],
    )


def _foot_motion(
    ball: np.ndarray, yaw: np.ndarray, pitch: np.ndarray, stance: np.ndarray
) -> FootMotion:
    """A foot by its ball, m, its heading, and its elevation from ankle to ball, rad."""
    level = np.cos(pitch)[:, None] * heading_vectors(yaw)
    ankle = ball - FOOT * (level + np.sin(pitch)[:, None] * [0.0, 1.0, 0.0])
    heading = Rotation.from_rotvec(yaw[:, None] * [0.0, 1.0, 0.0])
    tilt = Rotation.from_rotvec((FLAT - pitch)[:, None] * [1.0, 0.0, 0.0])
    return FootMotion(ball, ankle, (heading * tilt).as_quat(scalar_first=True), stance)


class Foothold(NamedTuple):
    """Where and how long a foot stands."""

    start: float
    """Seconds."""
    end: float
    """Seconds."""
    x: float
    """m, of the ball."""
    z: float
    """m, of the ball."""
    yaw: float = 0.0
    """rad; 0 faces +z, pi/2 faces +x."""


class Swing(NamedTuple):
    """How feet move between two footholds."""

    lift: float
    """m, height of the arc of the ball."""
    toe_off: float
    """rad, by which the heel has risen when the ball leaves the ground."""


def stepping_foot(time: np.ndarray, footholds: Sequence[Foothold], swing: Swing) -> FootMotion:
    """A foot over the frames.

    Args:
        time: of each frame, s.
        footholds: in order of time; the first begins before the first frame, and the last ends
            after the last.
        swing: how it moves between them.
    """
    holds = np.array(footholds, np.float64)
    start, end, place = holds[:, 0], holds[:, 1], holds[:, 2:4]
    last = np.searchsorted(start, time, side="right") - 1
    following = np.minimum(last + 1, len(holds) - 1)
    stance = time <= end[last]
    duration = np.where(stance, 1.0, start[following] - end[last])
    phase = np.where(stance, 0.0, (time - end[last]) / duration)
    moved = smoothstep(phase)[:, None]
    arc = np.sin(np.pi * phase) ** 2
    at = place[last] + moved * (place[following] - place[last])
    ball = np.insert(at, 1, BALL_HEIGHT + swing.lift * arc, axis=1)
    yaw = holds[last, 4] + moved[:, 0] * (holds[following, 4] - holds[last, 4])
    risen = smoothstep((time - end[last] + HEEL_RISE) / HEEL_RISE)
    risen = np.where(stance, risen, 1.0 - smoothstep(phase / 0.8)) * (following > last)
    pitch = FLAT - swing.toe_off * risen
    return _foot_motion(ball, yaw, pitch, stance)


def curve(series: tuple, phase: np.ndarray) -> np.ndarray:
    """A measured curve, in its table's unit, at phases of any stride."""
    mean, *harmonics = series
    angle = 2.0 * np.pi * phase
    return mean + sum(
        a * np.cos(j * angle) + b * np.sin(j * angle) for j, (a, b) in enumerate(harmonics, 1)
    )


def ball(phase: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The ball of the foot, m: ahead of the pelvis, above the floor, and outward of its stance."""
    hip, knee, pitch = (np.radians(curve(series, phase)) for series in (HIP, KNEE, PITCH))
    ahead = THIGH * np.sin(hip) + SHIN * np.sin(hip - knee) + FOOT * np.cos(pitch)
    below = THIGH * np.cos(hip) + SHIN * np.cos(hip - knee) - FOOT * np.sin(pitch)
    outward = np.sin(np.radians(curve(ABDUCTION, phase) - curve(ABDUCTION, np.full(1, 0.2))))
    return ahead, curve(HEIGHT, phase) - HIP_DROP - below, (THIGH + SHIN) * outward
