"""How far a solved clip is from a captured one, in the figures of the blocks benchmark.

The definitions are those of the benchmark's `score.py`. NumPy; world space, y up.
"""

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, fields

import numpy as np
from jaxtyping import Bool, Float

from fitting.datasets.clips.clip import Clip
from fitting.datasets.frames import named_joints
from fitting.report.tables import Table

from .measures import Column

STRAIGHT = 0.999  # share of a leg's length between hip and ankle from which on it is straight
JOINTS = ("pelvis", "hip", "knee", "ankle")


@dataclass(frozen=True)
class Agreement:
    """A solved motion against a captured one, as `COLUMNS` explains; NaN without such frames."""

    pelvis: float  # m
    ankle: float  # m
    ankle_stance: float  # m
    knee: float  # m
    knee_stance: float  # m
    knee_angle: float  # rad
    knee_angle_stance: float  # rad
    straight: float  # share of 1
    pop: float  # m a frame
    added_slip: float  # m a frame
    bone_length: float  # m


COLUMNS = {
    "pelvis": Column(
        "pelvis", "cm", 100.0, 2, "Height of the pelvis against the captured one; rms over frames."
    ),
    "ankle": Column(
        "ankle", "cm", 100.0, 2, "Distance of the ankles from the captured ones; rms."
    ),
    "ankle_stance": Column(
        "ankle in stance", "cm", 100.0, 2, "The same over the frames in which the foot stands."
    ),
    "knee": Column("knee", "cm", 100.0, 2, "Distance of the knees from the captured ones; rms."),
    "knee_stance": Column(
        "knee in stance", "cm", 100.0, 2, "The same over the frames in which the foot stands."
    ),
    "knee_angle": Column(
        "knee angle", "°", np.degrees(1.0), 2, "Difference of the angles at the knees; rms."
    ),
    "knee_angle_stance": Column(
        "knee angle in stance", "°", np.degrees(1.0), 2,
        "The same over the frames in which the foot stands.",
    ),
    "straight": Column(
        "straight", "%", 100.0, 2,
        "Share of frames and legs with at least 99.9 % of the leg's length from hip to ankle.",
    ),
    "pop": Column(
        "pop", "cm a frame", 100.0, 2,
        "The largest change from a frame to the next of how far an ankle is over where the "
        "animation has it. It grows with the length of a frame.",
    ),
    "added_slip": Column(
        "added slip", "mm a frame", 1000.0, 3,
        "How much further over the ground plan than the captured one a standing ankle comes from a "
        "frame to the next; mean, and 0 where it comes less far.",
    ),
    "bone_length": Column(
        "bone length", "mm", 1000.0, 3, "The largest error of the length of a thigh or a shin."
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Errors:
    """What `Agreement` is the summary of; frames, or changes from one to the next, first."""

    pelvis: Float[np.ndarray, " frames"]  # m
    ankle: Float[np.ndarray, "frames legs"]  # m
    knee: Float[np.ndarray, "frames legs"]  # m
    knee_angle: Float[np.ndarray, "frames legs"]  # rad
    stance: Bool[np.ndarray, "frames legs"]
    straight: Bool[np.ndarray, "frames legs"]
    lift: Float[np.ndarray, "changes legs"]  # m, of the ankle's height over the animated one
    slip: Float[np.ndarray, " standing"]  # m, further than captured, of feet that go on standing
    bones: Float[np.ndarray, "frames legs 2"]  # m, of thigh and shin


def errors(
    solved: Mapping[str, np.ndarray],
    captured: Mapping[str, np.ndarray],
    base_ankle_ws: Float[np.ndarray, "frames legs 3"],
    stance: Bool[np.ndarray, "frames legs"],
    lengths: Float[np.ndarray, "legs 2"],
) -> Errors:
    """Differences of two motions over the same frames.

    Args:
        solved: `pelvis` (frames, 3); `hip`, `knee` and `ankle` (frames, legs, 3), m.
        captured: the same joints.
        base_ankle_ws: of the animation from which the solved motion was made, m.
        stance: where a captured foot stands.
        lengths: of thigh and shin, m.
    """
    made, real = (
        {name: one[name].astype(np.float64) for name in JOINTS} for one in (solved, captured)
    )
    ways = [np.diff(one["ankle"][..., [0, 2]], axis=0) for one in (made, real)]
    further = np.linalg.norm(ways[0], axis=-1) - np.linalg.norm(ways[1], axis=-1)
    thigh, shin = made["knee"] - made["hip"], made["ankle"] - made["knee"]
    reach = np.linalg.norm(made["ankle"] - made["hip"], axis=-1)
    return Errors(
        pelvis=made["pelvis"][:, 1] - real["pelvis"][:, 1],
        ankle=np.linalg.norm(made["ankle"] - real["ankle"], axis=-1),
        knee=np.linalg.norm(made["knee"] - real["knee"], axis=-1),
        knee_angle=knee_angle(made) - knee_angle(real),
        stance=stance,
        straight=reach / np.sum(lengths, axis=-1) >= STRAIGHT,
        lift=np.diff((made["ankle"] - base_ankle_ws)[..., 1], axis=0),
        slip=further[stance[1:] & stance[:-1]],
        bones=np.linalg.norm(np.stack([thigh, shin], axis=2), axis=-1) - lengths,
    )


def errors_of_clips(solved: Clip, captured: Clip, base: Clip) -> Errors:
    """Differences of a solved clip from a captured one, over the same frames.

    Args:
        solved: what foot IK made of `base`.
        captured: its contact labels, or those found from its motion, say when a foot stands.
        base: the animation, whose bones have the lengths of its rig.
    """
    rig = base.rig
    return errors(
        named_joints(solved),
        named_joints(captured),
        base.joints_ws(2),
        captured.standing(),
        np.stack([np.asarray(rig.thigh), np.asarray(rig.shin)], axis=-1),
    )


def knee_angle(joints: Mapping[str, np.ndarray]) -> Float[np.ndarray, "frames legs"]:
    """Angle between thigh and shin, rad; pi for a straight leg."""
    thigh, shin = joints["hip"] - joints["knee"], joints["ankle"] - joints["knee"]
    across = np.linalg.norm(np.cross(thigh, shin), axis=-1)
    return np.arctan2(across, np.sum(thigh * shin, axis=-1))


def agreement(clips: Sequence[Errors]) -> Agreement:
    """The figures over all frames of all clips."""
    joined = {
        one.name: np.concatenate([getattr(clip, one.name).ravel() for clip in clips])
        for one in fields(Errors)
    }
    stance = joined["stance"]
    return Agreement(
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


def worded(key: str, value: float) -> str:
    """A figure in the unit of its column; a dash where there is none."""
    column = COLUMNS[key]
    return "–" if np.isnan(value) else f"{column.factor * value:.{column.digits}f}"


def heads() -> list[str]:
    """Figures with their units, in the order of the columns."""
    return [f"{column.head}, {column.unit}" for column in COLUMNS.values()]


def table(found: Agreement) -> Table:
    """A row a figure."""
    cells = [worded(key, value) for key, value in zip(COLUMNS, astuple(found), strict=True)]
    return [["against the captured motion", ""], *map(list, zip(heads(), cells, strict=True))]


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if values.size else float("nan")


def _largest(values: np.ndarray) -> float:
    return float(np.abs(values).max()) if values.size else float("nan")
