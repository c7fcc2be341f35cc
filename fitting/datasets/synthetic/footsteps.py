"""Where the feet of the made walk stand, on a path with gentle bends, and how they get there.

A standing foot is placed: it rolls over its heel, lies flat, and rises about a ball that does not
move. Between two stances the ball follows the curves of `gait`, the gap to the placed feet blended
in.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial.transform import Rotation

from . import gait
from .trajectories import hermite, smoothstep

HALF_TRACK = 0.08  # m from the path to a foot
ALONG_SD, ASIDE_SD, LIFT_SD = 0.015, 0.008, 0.01  # m, of steps and of the height of swings
HEEL_OFF, RISEN = 0.28, 0.40  # phases: the heel leaves the ground, the measured pitch is reached
DELTA = 1e-5  # of phase, for slopes
TURNS = (9.0, 5.3)  # m, wave lengths of the path's bends


@dataclass(frozen=True)
class Foot:
    """One foot over the frames."""

    ball: Float64[np.ndarray, "frames 3"]  # m
    ankle: Float64[np.ndarray, "frames 3"]  # m
    rot: Float64[np.ndarray, "frames 4"]  # wxyz
    stands: Bool[np.ndarray, " frames"]  # its ball is placed


@dataclass(frozen=True)
class Path:
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
        return on_path + np.asarray(left)[..., None] * forward_ws(self.yaw(z) + np.pi / 2)

    def _sum(self, z: np.ndarray, wave: Callable, power: int) -> np.ndarray:
        rates = [2.0 * np.pi / length for length in TURNS]
        waves = [wave(k * z + self.start) / k**power for k in rates]
        return 0.5 * self.turn * np.sum(waves, axis=0)


@dataclass(frozen=True)
class Steps:
    """Where one foot stands, stride by stride, and how it gets there."""

    late: float  # phase, of this foot after the other
    side: float  # +1 left, -1 right
    path: Path
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
        path: Path,
        variation: float,
        rng: np.random.Generator,
    ) -> "Steps":
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

    def foot(self, phase: np.ndarray, still: np.ndarray) -> Foot:
        """The foot at these phases of the walk; it lies flat by as much as the body is `still`."""
        phase, still = phase - self.late, still.copy()
        stance = np.floor(phase).astype(int)
        own = phase - stance
        share = np.clip((own - gait.BALL_OFF) / (gait.HEEL_ON - gait.BALL_OFF), 0.0, 1.0)
        landed = (own >= gait.HEEL_ON).astype(int)
        for frame in np.flatnonzero(landed[1:] & landed[:-1]) + 1:
            still[frame] = max(still[frame], still[frame - 1])  # lies flat, and does not rise again

        start = self._rolled(stance, np.full_like(own, gait.BALL_OFF))
        fast = self._slope(self._measured, stance, gait.BALL_OFF)
        gap = start - self._measured(stance, np.full_like(own, gait.BALL_OFF))
        end = self._rolled(stance + 1, np.full_like(own, gait.HEEL_ON - 1.0))
        end_gap = end - self._measured(stance, np.full_like(own, gait.HEEL_ON))
        end_fast = self._slope(self._rolled, stance + 1, gait.HEEL_ON - 1.0)
        end_fast = end_fast - self._slope(self._measured, stance, gait.HEEL_ON)
        span = gait.HEEL_ON - gait.BALL_OFF
        swung = self._measured(stance, own)
        swung += hermite(share, gap, -span * fast, end_gap, span * end_fast)
        swung[:, 1] += self.lift[stance + 1] * np.sin(np.pi * share) ** 2
        placed = self._rolled(stance + landed, own - landed, still)
        swings = (own > gait.BALL_OFF) & (own < gait.HEEL_ON)
        ball = np.where(swings[:, None], swung, placed)

        here, there = self._yaw(stance), self._yaw(stance + 1)
        yaw = here + smoothstep(share) * (there - here)
        pitch = self._pitch(stance, own, still)
        ankle = ball - gait.FOOT * _pitched(yaw, pitch)
        turned = Rotation.from_rotvec(yaw[:, None] * [0.0, 1.0, 0.0])
        tilted = Rotation.from_rotvec((gait.FLAT - pitch)[:, None] * [1.0, 0.0, 0.0])
        stands = (own < gait.BALL_OFF) | (still >= 1.0)  # rounding may lift it over 1
        return Foot(ball, ankle, (turned * tilted).as_quat(scalar_first=True), stands)

    def _pitch(
        self, stance: np.ndarray, own: np.ndarray, still: np.ndarray | float = 0.0
    ) -> np.ndarray:
        """Ankle to ball above horizontal, rad: flat in the stance, measured in the swing."""
        free = smoothstep((own - HEEL_OFF) / (RISEN - HEEL_OFF))
        free = free * smoothstep((1.0 - own) / (1.0 - gait.HEEL_ON)) * (1.0 - still)
        share = np.clip((own - gait.BALL_OFF) / (gait.HEEL_ON - gait.BALL_OFF), 0.0, 1.0)
        swing = self.pitch[stance + 1] * np.sin(np.pi * share) ** 2
        return gait.FLAT + free * (np.radians(gait.curve(gait.PITCH, own)) - gait.FLAT) + swing

    def _yaw(self, stance: np.ndarray) -> np.ndarray:
        return self.path.yaw(self.along[stance + 1])

    def _rolled(
        self, stance: np.ndarray, own: np.ndarray, still: np.ndarray | float = 0.0
    ) -> np.ndarray:
        """The ball of a placed foot; before its phase 0 the foot turns about its heel."""
        place = self.path.at(
            self.along[stance + 1], self.aside[stance + 1], np.full(own.shape, gait.BALL_HEIGHT)
        )
        tilt = np.where(own < 0, self._pitch(stance, own % 1.0, still) - gait.FLAT, 0.0)
        reach = gait.HEEL + gait.FOOT * np.cos(gait.FLAT)
        ahead = reach * (np.cos(tilt) - 1.0) - gait.BALL_HEIGHT * np.sin(tilt)
        above = reach * np.sin(tilt) + gait.BALL_HEIGHT * (np.cos(tilt) - 1.0)
        ahead_ws = forward_ws(self._yaw(stance))
        return place + ahead[:, None] * ahead_ws + above[:, None] * [0.0, 1.0, 0.0]

    def _measured(self, stance: np.ndarray, own: np.ndarray) -> np.ndarray:
        """The ball as the curves alone have it."""
        ahead, height, outward = gait.ball(own)
        ahead = ahead + gait.STRIDE * (stance + self.late + own)
        return self.path.at(ahead, self.side * (HALF_TRACK + outward), height)

    def _slope(self, ball: Callable, stance: np.ndarray, own: float) -> np.ndarray:
        """Metres per stride's phase at which a curve of the ball moves."""
        at = np.full(stance.shape, own)
        return (ball(stance, at + DELTA) - ball(stance, at - DELTA)) / (2.0 * DELTA)


def forward_ws(yaw: np.ndarray) -> np.ndarray:
    """Unit vectors, (..., 3), of these headings, rad; 0 looks along +z, pi/2 along +x."""
    return np.stack([np.sin(yaw), np.zeros_like(yaw), np.cos(yaw)], axis=-1)


def _pitched(yaw: np.ndarray, pitch: np.ndarray) -> np.ndarray:
    flat = np.cos(pitch)[:, None] * forward_ws(yaw)
    return flat + np.sin(pitch)[:, None] * [0.0, 1.0, 0.0]
