"""Small files of motion and a walk over stairs, for the tests of loaders, edits and terrain."""

from dataclasses import replace

import numpy as np

from fitting.clips.assemble import JointMotion, clip_from_joints
from fitting.clips.clip import Clip
from fitting.clips.rigs import knee_positions, leg_rotations, unit
from fitting.motion.flat_animation import HeightFunction

FPS = 60.0
STRIDE, LIFT = 0.6, 0.12  # m
STANCE_FRAMES, SWING_FRAMES = 30, 24

LEG = """\
  JOINT {side}UpLeg
  {{
    OFFSET {x} 0 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT {side}Leg
    {{
      OFFSET 0 -42 0
      CHANNELS 3 Xrotation Yrotation Zrotation
      JOINT {side}Foot
      {{
        OFFSET 0 -40 0
        CHANNELS 3 Zrotation Xrotation Yrotation
        End Site
        {{
          OFFSET 0 -5 12
        }}
      }}
    }}
  }}
"""
BVH = f"""HIERARCHY
ROOT Hips
{{
  OFFSET 0 90 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
{LEG.format(side="Left", x=10)}{LEG.format(side="Right", x=-10)}}}
MOTION
Frames: 3
Frame Time: 0.0083333
0 87 0 0 0 0  0 -20 0 40 0 0 0 0 0  0 10 0 5 0 0 0 0 0
0 87 1 0 0 5  0 -25 0 50 0 0 0 0 0  0 15 0 9 0 0 0 0 0
0 87 2 0 0 9  0 -30 0 60 0 0 0 0 0  0 20 0 3 0 0 0 0 0
"""

ASF = """# comment
:version 1.10
:units
  length 0.45
  angle deg
:root
  order TX TY TZ RX RY RZ
  axis XYZ
  position 0 1 0
  orientation 0 0 0
:bonedata
  begin
    id 1
    name lfemur
    direction 0 -1 0
    length 7
    axis 10 20 30 XYZ
    dof rx ry rz
    limits (-160.0 20.0)
           (-70.0 70.0)
           (-60.0 70.0)
  end
  begin
    name ltibia
    direction 0 -1 0
    length 8
    axis 0 0 20 XYZ
    dof rx
    limits (-10.0 170.0)
  end
  begin
    name lfoot
    direction 0 0 1
    length 2
    axis 0 0 0 XYZ
  end
:hierarchy
  begin
    root lfemur
    ltibia lfoot
    lfemur ltibia
  end
"""
AMC = """#!OML:ASF somewhere
:FULLY-SPECIFIED
:DEGREES
1
root 1 2 3 10 20 30
lfemur 5 6 7
ltibia 40
2
root 1 2 4 10 20 30
ltibia 50
lfemur 5 6 8
"""


def stairs(points: np.ndarray) -> np.ndarray:
    """Ground height, m, below points: a step of 8 cm up every 30 cm of z, and down after 2 m."""
    return 0.08 * np.floor(np.abs(np.abs(points[:, 2]) - 2.0) / 0.3)


def flat_floor(points: np.ndarray) -> np.ndarray:
    return np.zeros(len(points))


def stair_walk(height_under: HeightFunction = stairs, strides: int = 3) -> Clip:
    """A walk along +z on level treads at 60 Hz, with the balls placed exactly on the ground."""
    period = STANCE_FRAMES + SWING_FRAMES
    frames = np.arange(period * strides)
    names, parents = ["pelvis"], [-1]
    pelvis = np.zeros((len(frames), 3))
    pelvis[:, 2] = frames * STRIDE / period - 0.15
    balls = []
    for leg, x in enumerate((0.1, -0.1)):
        own_frames = frames + leg * period // 2
        swing = np.clip((own_frames % period - STANCE_FRAMES) / SWING_FRAMES, 0.0, 1.0)
        ease = swing**3 * (10 - 15 * swing + 6 * swing**2)
        start_z = STRIDE * (own_frames // period - leg / 2)
        z = start_z + STRIDE * ease
        start_y, end_y = (
            height_under(np.stack([0 * z, 0 * z, foothold_z], -1))
            for foothold_z in (start_z, start_z + STRIDE)
        )
        y = start_y + (end_y - start_y) * ease + LIFT * np.sin(np.pi * swing) ** 2
        balls.append(np.stack([np.full_like(z, x), y, z], axis=-1))
    pelvis[:, 1] = 0.8 + np.mean([ball[:, 1] for ball in balls], axis=0)
    left_ws = np.tile([1.0, 0.0, 0.0], (len(frames), 1))
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (len(frames), 1))
    positions, rotations, stance = [pelvis], [upright], []
    for leg, side in enumerate(("left", "right")):
        hip = pelvis + [(0.1, -0.1)[leg], 0.0, 0.0]
        ankle = balls[leg] + [0.0, 0.05, -0.1]
        forward = np.cross(unit(ankle - hip), left_ws)
        knee = knee_positions(hip, ankle, forward, (0.5, 0.48))
        names += [f"{side}_{role}" for role in ("hip", "knee", "ankle", "toe")]
        parents += [0, len(names) - 4, len(names) - 3, len(names) - 2]
        positions += [hip, knee, ankle, balls[leg]]
        rotations += [*leg_rotations(hip, knee, ankle, left_ws), upright, upright]
        stance.append((frames + leg * period // 2) % period <= STANCE_FRAMES)
    motion = JointMotion(
        tuple(names), tuple(parents), np.stack(positions, 1), np.stack(rotations, 1),
        np.stack(stance, axis=-1), FPS,
    )  # fmt: skip
    return clip_from_joints(motion, "stair walk")


def seen_within(clip: Clip, first: int, last: int) -> Clip:
    """The clip with the frames before and after these masked, and held as those of markers are."""
    frames = np.arange(clip.frame_count)
    within = np.clip(frames, first, last)
    return replace(clip.select(within), mask=frames == within)


# Clips of several dialects whose joints are known, in the folder of shared motion.
AMC_FILES = [f"cmu_asfamc/{name}.amc" for name in ("01_01", "02_01", "02_03", "03_01", "03_03")]
BVH_FILES = [
    *("cmu_bvh_max/131_01.bvh", "cmu_bvh_max/scaled_131_01.bvh", "cmu_bvh_mb/cmu_12_01_walk.bvh"),
    *("cmu_bvh_poser/03_01.bvh", "mit/pybvh_test1_zup.bvh", "mit/full_precision_frame_time.bvh"),
]
