"""What a made walk has above its pelvis: a trunk that turns against it, a head, arms that swing.

Lengths are those of Drillis and Contini (1966), as Winter (Biomechanics and Motor Control of Human
Movement, 2009, figure 4.1) gives them, for a body with the walk's legs.
Arms swing as Murray, Sepic and Barnard (1967, Physical Therapy 47:272) filmed them in men who
walked at their free speed: at the shoulder by 32 degrees, three quarters of it backward, and at the
elbow by 30. Each arm goes with the leg of the other side. The chest turns against the pelvis by
as much as in Stokes, Andersson and Forssberg (1989, J. Biomech. 22:43), about four degrees to
either side. The pelvis itself does not turn with the steps.
"""

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from .footsteps import PHASE_OFFSETS, SIDES

JOINTS = ("spine", "chest", "neck", "head",
          "left_shoulder", "left_elbow", "left_wrist",
          "right_shoulder", "right_elbow", "right_wrist")  # fmt: skip
PARENTS = ("pelvis", "spine", "chest", "neck",
           "chest", "left_shoulder", "left_elbow",
           "chest", "right_shoulder", "right_elbow")  # fmt: skip
# m, up and ahead, from the joint before.
SPINE, CHEST, NECK, HEAD = (0.07, -0.015), (0.19, 0.0), (0.23, 0.0), (0.10, 0.02)
SHOULDER, HALF_WIDTH = 0.18, 0.175  # m, above the chest's joint and beside it
UPPER_ARM, FOREARM = 0.318, 0.25  # m
SHOULDER_REST, SHOULDER_SWING = -8.0, 16.0  # degrees forward
ELBOW_REST, ELBOW_SWING = 30.0, 15.0  # degrees of flexion
HANGING, HANGING_ELBOW = 2.0, 14.0  # degrees, of an arm that does not swing
ABDUCTION = 7.0  # degrees
LEAN = 2.0  # degrees, of the chest, forward
TURN = 4.0  # degrees, of the chest, to either side
FOREMOST = -0.085  # phase of a leg, in which its thigh is furthest forward
ELBOW_LAG = 0.06  # of a stride, after the shoulder

X, Y, Z = np.eye(3)


def motion(
    pelvis: Float64[np.ndarray, "frames 3"],
    heading: Rotation,
    phase: Float64[np.ndarray, " frames"],
    strength: Float64[np.ndarray, " frames"],
) -> tuple[Float64[np.ndarray, "frames joints 3"], Float64[np.ndarray, "frames joints 4"]]:
    """Positions, m, and rotations, wxyz, of `JOINTS` over a pelvis.

    Args:
        pelvis: its position, m.
        heading: its rotation.
        phase: of the walk, in strides.
        strength: of arm swing and turn, 1 as measured; at 0 arms hang.
    """
    # The left leg is in front at the phase 0: the chest then faces left, with the right arm.
    turn = np.radians(TURN) * strength * np.cos(2.0 * np.pi * (phase - FOREMOST))
    spine_rot = heading * _about(Y, 0.5 * turn)
    chest_rot = heading * _about(Y, turn) * _about(X, np.full_like(turn, np.radians(LEAN)))
    spine = pelvis + heading.apply(_offset(SPINE))
    chest = spine + spine_rot.apply(_offset(CHEST))
    neck = chest + chest_rot.apply(_offset(NECK))
    head = neck + heading.apply(_offset(HEAD))
    positions, rotations = [spine, chest, neck, head], [spine_rot, chest_rot, heading, heading]
    for side, offset in zip(SIDES, PHASE_OFFSETS, strict=True):
        own = phase - offset - FOREMOST
        forward = -np.cos(2.0 * np.pi * own)  # against the leg of its side
        late = -np.cos(2.0 * np.pi * (own - ELBOW_LAG))
        shoulder_angle = _blend(HANGING, SHOULDER_REST + SHOULDER_SWING * forward, strength)
        elbow_angle = _blend(HANGING_ELBOW, ELBOW_REST + ELBOW_SWING * late, strength)
        outward = _about(Z, np.full_like(turn, np.radians(side * ABDUCTION)))
        upper_rot = chest_rot * outward * _about(X, -shoulder_angle)
        fore_rot = upper_rot * _about(X, -elbow_angle)
        shoulder = chest + chest_rot.apply([side * HALF_WIDTH, SHOULDER, 0.0])
        elbow = shoulder + upper_rot.apply([0.0, -UPPER_ARM, 0.0])
        wrist = elbow + fore_rot.apply([0.0, -FOREARM, 0.0])
        positions += [shoulder, elbow, wrist]
        rotations += [upper_rot, fore_rot, fore_rot]
    quats = [rotation.as_quat(scalar_first=True) for rotation in rotations]
    return np.stack(positions, axis=1), np.stack(quats, axis=1)


def _offset(up_and_ahead: tuple[float, float]) -> list[float]:
    up, ahead = up_and_ahead
    return [0.0, up, ahead]


def _about(axis: np.ndarray, angle: np.ndarray) -> Rotation:
    return Rotation.from_rotvec(angle[:, None] * axis)


def _blend(rest: float, moving: np.ndarray, strength: np.ndarray) -> np.ndarray:
    """An angle, rad, between one at rest and one that swings, both in degrees."""
    return np.radians(rest + strength * (moving - rest))
