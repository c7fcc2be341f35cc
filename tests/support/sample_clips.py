"""Small motion files and clips for the tests of loaders and edits."""

import numpy as np

from fitting.datasets.clips.assemble import JointMotion, clip_from_joints
from fitting.datasets.clips.clip import Clip
from fitting.datasets.clips.leg_geometry import leg_rotations

FPS = 60.0
STEP, LIFT, STANDS, SWINGS = 0.6, 0.12, 30, 24  # m, m, frames, frames

BVH = """HIERARCHY
ROOT Hips
{
  OFFSET 0 90 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT LeftUpLeg
  {
    OFFSET 10 0 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT LeftLeg
    {
      OFFSET 0 -42 0
      CHANNELS 3 Xrotation Yrotation Zrotation
      JOINT LeftFoot
      {
        OFFSET 0 -40 0
        CHANNELS 3 Zrotation Xrotation Yrotation
        End Site
        {
          OFFSET 0 -5 12
        }
      }
    }
  }
  JOINT RightUpLeg
  {
    OFFSET -10 0 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT RightLeg
    {
      OFFSET 0 -42 0
      CHANNELS 3 Xrotation Yrotation Zrotation
      JOINT RightFoot
      {
        OFFSET 0 -40 0
        CHANNELS 3 Zrotation Xrotation Yrotation
        End Site
        {
          OFFSET 0 -5 12
        }
      }
    }
  }
}
MOTION
Frames: 3
Frame Time: 0.0083333
0 87 0 0 0 0  0 -20 0 40 0 0 0 0 0  0 10 0 5 0 0 0 0 0
0 87 1 0 0 5  0 -25 0 50 0 0 0 0 0  0 15 0 9 0 0 0 0 0
0 87 2 0 0 9  0 -30 0 60 0 0 0 0 0  0 20 0 3 0 0 0 0 0
"""


def stairs(points: np.ndarray) -> np.ndarray:
    """Ground height, m, under points: a step of 8 cm up every 30 cm of z, and down after 2 m."""
    return 0.08 * np.floor(np.abs(np.abs(points[:, 2]) - 2.0) / 0.3)


def walker(height_under=stairs, strides: int = 3) -> Clip:
    """A walk along +z on level treads: feet placed exactly, balls on the ground, 60 Hz."""
    period = STANDS + SWINGS
    frames = np.arange(period * strides)
    names, parents = ["pelvis"], [-1]
    pelvis = np.zeros((len(frames), 3))
    pelvis[:, 2] = frames * STEP / period - 0.15
    balls = []
    for leg, x in enumerate((0.1, -0.1)):
        late = frames + leg * period // 2
        share = np.clip((late % period - STANDS) / SWINGS, 0.0, 1.0)
        ease = share**3 * (10 - 15 * share + 6 * share**2)
        z = STEP * (late // period + ease) - leg * STEP / 2
        old, new = (STEP * (late // period + more) - leg * STEP / 2 for more in (0, 1))
        low, high = (height_under(np.stack([0 * z, 0 * z, at], -1)) for at in (old, new))
        y = low + (high - low) * ease + LIFT * np.sin(np.pi * share) ** 2
        balls.append(np.stack([np.full_like(z, x), y, z], axis=-1))
    pelvis[:, 1] = 0.8 + np.mean([ball[:, 1] for ball in balls], axis=0)
    left = np.tile([1.0, 0.0, 0.0], (len(frames), 1))
    still = np.tile([1.0, 0.0, 0.0, 0.0], (len(frames), 1))
    positions, rotations, stance = [pelvis], [still], []
    for leg, side in enumerate(("left", "right")):
        hip = pelvis + [(0.1, -0.1)[leg], 0.0, 0.0]
        ankle = balls[leg] + [0.0, 0.05, -0.1]
        line = ankle - hip
        distance = np.linalg.norm(line, axis=-1, keepdims=True)
        along = line / distance
        forth = (0.5**2 - 0.48**2 + distance**2) / (2 * distance)
        pole = np.cross(along, left)
        knee = hip + along * forth + pole * np.sqrt(0.5**2 - forth**2)
        names += [f"{side}_{part}" for part in ("hip", "knee", "ankle", "toe")]
        parents += [0, len(names) - 4, len(names) - 3, len(names) - 2]
        positions += [hip, knee, ankle, balls[leg]]
        rotations += [*leg_rotations(hip, knee, ankle, left), still, still]
        stance.append((frames + leg * period // 2) % period <= STANDS)
    motion = JointMotion(
        tuple(names), tuple(parents), np.stack(positions, 1), np.stack(rotations, 1),
        np.stack(stance, axis=-1), FPS,
    )  # fmt: skip
    return clip_from_joints(motion, "walker")
