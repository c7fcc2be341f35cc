"""Footsteps of the synthetic walk: where each foot stands, and how it moves from one to the next.

A standing foot is placed: it rolls over its heel, lies flat, and rises about a ball that does not
move. Between two stances the ball follows the measured curves of `gait`. The gap between those
curves and the placed feet is blended in.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial.transform import Rotation

from . import gait
from .trajectories import GroundPath, heading_vectors, hermite, smoothstep

SIDES = (1.0, -1.0)  # left, right
HALF_TRACK = 0.08  # m from the path to a foot
ALONG_SD, ASIDE_SD, LIFT_SD = 0.015, 0.008, 0.01  # m, of footholds and of the height of swings
HEEL_OFF, FULL_PITCH = 0.28, 0.40  # phases: the heel leaves the ground, the pitch is as measured
PHASE_STEP = 1e-5  # for slopes by central differences

BallCurve = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Position of the ball, m, (frames, 3), from stance index and phase within the stride."""


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
        swing = (phase - gait.BALL_OFF) / (gait.HEEL_ON - gait.BALL_OFF)
        swing = np.clip(swing, 0.0, 1.0)
        landed = (phase >= gait.HEEL_ON).astype(int)
        for frame in np.flatnonzero(landed[1:] & landed[:-1]) + 1:
            still[frame] = max(still[frame], still[frame - 1])  # once flat, it does not tilt again

        swinging_ball = self._swinging_ball(stance, phase, swing)
        placed_ball = self._placed_ball(stance + landed, phase - landed, still)
        swinging = (phase > gait.BALL_OFF) & (phase < gait.HEEL_ON)
        ball = np.where(swinging[:, None], swinging_ball, placed_ball)

        yaw, next_yaw = self._yaw(stance), self._yaw(stance + 1)
        yaw = yaw + smoothstep(swing) * (next_yaw - yaw)
        pitch = self._pitch(stance, phase, still)
        ankle = ball - gait.FOOT * _directions(yaw, pitch)
        heading = Rotation.from_rotvec(yaw[:, None] * [0.0, 1.0, 0.0])
        tilt = Rotation.from_rotvec((gait.FLAT - pitch)[:, None] * [1.0, 0.0, 0.0])
        stands = (phase < gait.BALL_OFF) | (still >= 1.0)  # rounding may lift `still` above 1
        return FootMotion(ball, ankle, (heading * tilt).as_quat(scalar_first=True), stands)

    def _swinging_ball(
        self, stance: np.ndarray, phase: np.ndarray, swing: np.ndarray
    ) -> np.ndarray:
        """The ball between two stances: the measured curve, joined smoothly to the placed foot.

        The difference between the two, in position and velocity, fades as a Hermite curve.
        """
        lift_off, landing = np.full_like(phase, gait.BALL_OFF), np.full_like(phase, gait.HEEL_ON)
        start = self._placed_ball(stance, lift_off)
        start_slope = self._slope(self._measured_ball, stance, gait.BALL_OFF)
        start_gap = start - self._measured_ball(stance, lift_off)
        end = self._placed_ball(stance + 1, np.full_like(phase, gait.HEEL_ON - 1.0))
        end_gap = end - self._measured_ball(stance, landing)
        end_slope = self._slope(self._placed_ball, stance + 1, gait.HEEL_ON - 1.0)
        end_slope = end_slope - self._slope(self._measured_ball, stance, gait.HEEL_ON)
        span = gait.HEEL_ON - gait.BALL_OFF
        ball = self._measured_ball(stance, phase)
        ball += hermite(swing, start_gap, -span * start_slope, end_gap, span * end_slope)
        ball[:, 1] += self.lift[stance + 1] * np.sin(np.pi * swing) ** 2
        return ball

    def _pitch(
        self, stance: np.ndarray, phase: np.ndarray, still: np.ndarray | float = 0.0
    ) -> np.ndarray:
        """Ankle to ball above horizontal, rad: flat in the stance, as measured in the swing."""
        free = smoothstep((phase - HEEL_OFF) / (FULL_PITCH - HEEL_OFF))
        free = free * smoothstep((1.0 - phase) / (1.0 - gait.HEEL_ON)) * (1.0 - still)
        swing = (phase - gait.BALL_OFF) / (gait.HEEL_ON - gait.BALL_OFF)
        change = self.pitch[stance + 1] * np.sin(np.pi * np.clip(swing, 0.0, 1.0)) ** 2
        measured = np.radians(gait.curve(gait.PITCH, phase))
        return gait.FLAT + free * (measured - gait.FLAT) + change

    def _yaw(self, stance: np.ndarray) -> np.ndarray:
        return self.path.yaw(self.along[stance + 1])

    def _placed_ball(
        self, stance: np.ndarray, phase: np.ndarray, still: np.ndarray | float = 0.0
    ) -> np.ndarray:
        """The ball of a standing foot; before phase 0 the foot rotates about its heel."""
        height = np.full(phase.shape, gait.BALL_HEIGHT)
        foothold = self.path.points(self.along[stance + 1], self.aside[stance + 1], height)
        tilt = np.where(phase < 0, self._pitch(stance, phase % 1.0, still) - gait.FLAT, 0.0)
        reach = gait.HEEL + gait.FOOT * np.cos(gait.FLAT)
        ahead = reach * (np.cos(tilt) - 1.0) - gait.BALL_HEIGHT * np.sin(tilt)
        above = reach * np.sin(tilt) + gait.BALL_HEIGHT * (np.cos(tilt) - 1.0)
        forward = heading_vectors(self._yaw(stance))
        return foothold + ahead[:, None] * forward + above[:, None] * [0.0, 1.0, 0.0]

    def _measured_ball(self, stance: np.ndarray, phase: np.ndarray) -> np.ndarray:
        """The ball as the measured curves alone place it."""
        ahead, height, outward = gait.ball(phase)
        ahead = ahead + gait.STRIDE * (stance + self.phase_offset + phase)
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
    phase = np.linspace(gait.HEEL_ON - 1.0, gait.BALL_OFF, 50)
    middle = np.mean(gait.ball(phase)[0] + gait.STRIDE * phase)
    stances = np.arange(-1, strides + 1)  # including the one before the first frame
    noise = variation * rng.normal(size=(4, len(stances)))
    offset, side = gait.PHASE_OFFSETS[leg], SIDES[leg]
    return Footsteps(
        offset,
        side,
        path,
        along=gait.STRIDE * (stances + offset) + middle + ALONG_SD * noise[0],
        aside=side * HALF_TRACK + ASIDE_SD * noise[1],
        lift=LIFT_SD * np.abs(noise[2]),
        pitch=gait.PITCH_SD * noise[3],
    )


def _directions(yaw: np.ndarray, pitch: np.ndarray) -> np.ndarray:
    """Unit vectors, (frames, 3), with this yaw and elevation, rad."""
    level = np.cos(pitch)[:, None] * heading_vectors(yaw)
    return level + np.sin(pitch)[:, None] * [0.0, 1.0, 0.0]
