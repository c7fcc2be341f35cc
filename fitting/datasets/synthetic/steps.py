"""Feet that stand where they are told to, and swing from each foothold to the next.

A standing foot lies flat, and rises about a ball that does not move before it leaves the ground. It
swings as people move their hands: along the path of minimum jerk, with an arc above it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from . import gait
from .footsteps import FootMotion
from .trajectories import heading_vectors, smoothstep

HEEL_RISE = 0.12  # s, before the foot leaves the ground


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
    ball = np.insert(at, 1, gait.BALL_HEIGHT + swing.lift * arc, axis=1)
    yaw = holds[last, 4] + moved[:, 0] * (holds[following, 4] - holds[last, 4])
    risen = smoothstep((time - end[last] + HEEL_RISE) / HEEL_RISE)
    risen = np.where(stance, risen, 1.0 - smoothstep(phase / 0.8)) * (following > last)
    pitch = gait.FLAT - swing.toe_off * risen
    along = np.cos(pitch)[:, None] * heading_vectors(yaw)
    ankle = ball - gait.FOOT * (along + np.sin(pitch)[:, None] * [0.0, 1.0, 0.0])
    heading = Rotation.from_rotvec(yaw[:, None] * [0.0, 1.0, 0.0])
    tilt = Rotation.from_rotvec((gait.FLAT - pitch)[:, None] * [1.0, 0.0, 0.0])
    return FootMotion(ball, ankle, (heading * tilt).as_quat(scalar_first=True), stance)
