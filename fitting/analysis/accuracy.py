"""How far a solved motion is from the captured one, in the figures of the blocks benchmark.

The definitions are those of the benchmark's own scoring script, against which the tests check
them. NumPy; world space, y up.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float

from fitting.datasets.clip_frames import positions_by_role
from fitting.datasets.clips.clip import Clip

STRAIGHT_REACH = 0.999  # hip to ankle over leg length, from which a leg counts as straight
JOINTS = ("pelvis", "hip", "knee", "ankle")


@dataclass(frozen=True)
class Accuracy:
    """How far a solved motion is from the captured one; NaN where no frame counts."""

    pelvis: float
    """m, height, rms."""
    ankle: float
    """m, rms."""
    ankle_stance: float
    """m, rms over the frames in which the captured foot stands."""
    knee: float
    """m, rms."""
    knee_stance: float
    """m, likewise."""
    knee_angle: float
    """rad, rms."""
    knee_angle_stance: float
    """rad, likewise."""
    straight: float
    """Fraction of frames and legs."""
    pop: float
    """m per frame, largest."""
    added_slip: float
    """m per frame, mean."""
    bone_length: float
    """m, largest error."""


@dataclass(frozen=True)
class Errors:
    """Frame by frame what `Accuracy` summarises; `changes` run from one frame to the next."""

    pelvis: Float[np.ndarray, " frames"]
    """m, height."""
    ankle: Float[np.ndarray, "frames legs"]
    """Metres."""
    knee: Float[np.ndarray, "frames legs"]
    """Metres."""
    knee_angle: Float[np.ndarray, "frames legs"]
    """Radians."""
    stance: Bool[np.ndarray, "frames legs"]
    straight: Bool[np.ndarray, "frames legs"]
    lift: Float[np.ndarray, "changes legs"]
    """m, change of the ankle's height over the animated one."""
    slip: Float[np.ndarray, " standing"]
    """m, horizontal, beyond the captured, of standing feet."""
    bones: Float[np.ndarray, "frames legs 2"]
    """m, of thigh and shin."""


def errors(
    solved: Mapping[str, np.ndarray],
    captured: Mapping[str, np.ndarray],
    animated_ankle_ws: Float[np.ndarray, "frames legs 3"],
    stance: Bool[np.ndarray, "frames legs"],
    lengths: Float[np.ndarray, "legs 2"],
) -> Errors:
    """Differences between two motions over the same frames.

    Args:
        solved: `pelvis` (frames, 3); `hip`, `knee` and `ankle` (frames, legs, 3), m.
        captured: the same joints.
        animated_ankle_ws: of the flat animation from which the solved motion was made, m.
        stance: where a captured foot stands.
        lengths: of thigh and shin, m.
    """
    ours, theirs = (
        {name: joints[name].astype(np.float64) for name in JOINTS} for joints in (solved, captured)
    )
    our_steps, their_steps = (
        np.linalg.norm(np.diff(joints["ankle"][..., [0, 2]], axis=0), axis=-1)
        for joints in (ours, theirs)
    )
    thigh, shin = ours["knee"] - ours["hip"], ours["ankle"] - ours["knee"]
    reach = np.linalg.norm(ours["ankle"] - ours["hip"], axis=-1)
    return Errors(
        pelvis=ours["pelvis"][:, 1] - theirs["pelvis"][:, 1],
        ankle=np.linalg.norm(ours["ankle"] - theirs["ankle"], axis=-1),
        knee=np.linalg.norm(ours["knee"] - theirs["knee"], axis=-1),
        knee_angle=knee_angle(ours) - knee_angle(theirs),
        stance=stance,
        straight=reach / np.sum(lengths, axis=-1) >= STRAIGHT_REACH,
        lift=np.diff((ours["ankle"] - animated_ankle_ws)[..., 1], axis=0),
        slip=(our_steps - their_steps)[stance[1:] & stance[:-1]],
        bones=np.linalg.norm(np.stack([thigh, shin], axis=2), axis=-1) - lengths,
    )


def clip_errors(solved: Clip, captured: Clip, animation: Clip) -> Errors:
    """Differences between a solved clip and the captured one, over the same frames.

    Args:
        solved: what foot IK made of the animation.
        captured: says when a foot stands, by its contact labels or else by its motion.
        animation: the flat animation, whose bones have the lengths of its rig.
    """
    rig = animation.rig
    return errors(
        positions_by_role(solved),
        positions_by_role(captured),
        animation.joints_ws(2),
        captured.stance_labels(),
        np.stack([np.asarray(rig.thigh), np.asarray(rig.shin)], axis=-1),
    )


def knee_angle(joints: Mapping[str, np.ndarray]) -> Float[np.ndarray, "frames legs"]:
    """Angle between thigh and shin, rad; pi for a straight leg."""
    thigh, shin = joints["hip"] - joints["knee"], joints["ankle"] - joints["knee"]
    across = np.linalg.norm(np.cross(thigh, shin), axis=-1)
    return np.arctan2(across, np.sum(thigh * shin, axis=-1))


def summarise(clips: Sequence[Errors]) -> Accuracy:
    """The figures over all frames of all clips; no change is taken across a cut."""
    joined = {
        field.name: np.concatenate([getattr(clip, field.name).ravel() for clip in clips])
        for field in fields(Errors)
    }
    stance = joined["stance"]
    return Accuracy(
        pelvis=_rms(joined["pelvis"]),
        ankle=_rms(joined["ankle"]),
        ankle_stance=_rms(joined["ankle"][stance]),
        knee=_rms(joined["knee"]),
        knee_stance=_rms(joined["knee"][stance]),
        knee_angle=_rms(joined["knee_angle"]),
        knee_angle_stance=_rms(joined["knee_angle"][stance]),
        straight=_mean(joined["straight"]),
        pop=_largest(joined["lift"]),
        added_slip=_mean(np.maximum(joined["slip"], 0.0)),
        bone_length=_largest(joined["bones"]),
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if values.size else float("nan")


def _largest(values: np.ndarray) -> float:
    return float(np.abs(values).max()) if values.size else float("nan")
