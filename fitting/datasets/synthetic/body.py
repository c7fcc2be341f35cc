"""A synthetic body: a pelvis on two legs whose bones keep their lengths, over given feet.

The pelvis gives way where a leg would not reach its foot, and knees follow from the law of cosines.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import convolve1d, maximum_filter1d
from scipy.spatial.transform import Rotation

from fitting.datasets.clips.assemble import JointMotion, clip_from_joints
from fitting.datasets.clips.clip import Clip
from fitting.datasets.clips.leg_geometry import knee_positions, leg_rotations, unit

from . import gait
from .footsteps import SIDES, FootMotion
from .trajectories import heading_vectors

MAX_REACH = 0.992  # of a leg's length, to which it extends: the knee keeps 15 degrees
SETTLE = 0.1  # s, before and after the pelvis gives way to a leg
JOINTS = ("pelvis", "left_hip", "left_knee", "left_ankle", "left_toe",
          "right_hip", "right_knee", "right_ankle", "right_toe")  # fmt: skip
PARENTS = (-1, 0, 1, 2, 3, 0, 5, 6, 7)


@dataclass(frozen=True)
class Body:
    """Pelvis and feet over the frames, an adult's."""

    pelvis: Float64[np.ndarray, "frames 3"]
    """m, before it gives way."""
    yaw: Float64[np.ndarray, " frames"]
    """rad, heading of the pelvis; 0 faces +z, pi/2 faces +x."""
    feet: tuple[FootMotion, FootMotion]
    """Left and right."""
    fps: float
    knees: float = 1.0
    """1 bends the knees forward, as people do, -1 backward, as birds seem to."""

    @cached_property
    def heading(self) -> Rotation:
        """Rotation of the pelvis."""
        return Rotation.from_rotvec(self.yaw[:, None] * [0.0, 1.0, 0.0])

    @cached_property
    def hips(self) -> list[Float64[np.ndarray, "frames 3"]]:
        """Positions of the hips, m, before the pelvis gives way."""
        offsets = [[side * gait.HALF_PELVIS, -gait.HIP_DROP, 0.0] for side in SIDES]
        return [self.pelvis + self.heading.apply(offset) for offset in offsets]

    def sinking(self) -> Float64[np.ndarray, " frames"]:
        """How far the body sinks, m, smoothly, so that both legs reach their feet."""
        missing = np.zeros(len(self.pelvis))
        max_length = MAX_REACH * (gait.THIGH + gait.SHIN)
        for hip, foot in zip(self.hips, self.feet, strict=True):
            leg = hip - foot.ankle
            highest = np.sqrt(max_length**2 - leg[:, 0] ** 2 - leg[:, 2] ** 2)
            missing = np.maximum(missing, leg[:, 1] - highest)
        # A mean of maxima over the same window is nowhere below what is needed.
        kernel = np.hanning(2 * round(SETTLE * self.fps) + 3)[1:-1]
        upper = maximum_filter1d(missing, len(kernel), mode="nearest")
        return convolve1d(upper, kernel / kernel.sum(), mode="nearest")

    def clip(self, source: str, sinking: np.ndarray, drifted: np.ndarray | float = 0.0) -> Clip:
        """The body as a clip with contact labels.

        Args:
            source: name of the clip.
            sinking: how far the body sinks, m, (frames,); see `sinking`.
            drifted: how far it has drifted, feet included, m, (frames, 3).
        """
        lowered = sinking[:, None] * [0.0, 1.0, 0.0]
        left_ws = heading_vectors(self.yaw + np.pi / 2)
        positions = [self.pelvis - lowered]
        rotations = [self.heading.as_quat(scalar_first=True)]
        for hip, foot in zip(self.hips, self.feet, strict=True):
            hip = hip - lowered
            forward = self.knees * unit(np.cross(unit(foot.ankle - hip), left_ws))
            knee = knee_positions(hip, foot.ankle, forward, (gait.THIGH, gait.SHIN))
            positions += [hip, knee, foot.ankle, foot.ball]
            rotations += [*leg_rotations(hip, knee, foot.ankle, left_ws), foot.rot, foot.rot]
        drift = np.broadcast_to(drifted, self.pelvis.shape)
        motion = JointMotion(
            JOINTS, PARENTS, np.stack(positions, axis=1) + drift[:, None],
            np.stack(rotations, axis=1), np.stack([foot.stance for foot in self.feet], axis=-1),
            float(self.fps),
        )  # fmt: skip
        return clip_from_joints(motion, source)
