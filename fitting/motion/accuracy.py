"""How far a solved motion is from the captured one, or from that of another system.

The definitions of `Accuracy` are those of a benchmark's scoring script, against which the tests
check them, so that figures compare. NumPy; world space, y up.

A `Difference` is between two systems on the same animation: the change that the reference system
makes to the animation is its correction, and the part that the other does not reproduce remains.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import jaxik
from fitting.clips.clip import Clip
from fitting.clips.clip_frames import positions_by_role
from fitting.problem.residuals import errors_by_kind, over_frames, rotation_between
from fitting.problem.scene import Scene, animated_legs_ws, legs_ws, pelvis_ws
from fitting.problem.shared_world import run_scene
from fitting.runtime.precision import in_float64
from fitting.runtime.program_cache import cached
from jaxik.world.skeleton import Transform

from .measures import MEASURES, Figures, declared, horizontal_steps, knee_angle, straight

_IN_STANCE = "The same over the frames in which the foot stands."
JOINTS = ("pelvis", "hip", "knee", "ankle")

STANDING_SPEED = 0.02  # m/s; a slower character stands
NEGLIGIBLE = 1e-4  # m or rad, rms; a smaller correction counts as none
QUANTITIES = ("ankle", "knee", "pelvis", "foot", "body")  # positions, then orientations

FITTED_JOINTS = ("pelvis", "knee", "ankle")


@dataclass(frozen=True)
class Accuracy(Figures):
    """How far a solved motion is from the captured one; NaN where no frame counts."""

    pelvis: float = declared(
        "pelvis", "cm", 2,
        "Difference in height between the solved and the captured pelvis; rms over frames.",
    )  # fmt: skip
    ankle: float = declared(
        "ankle", "cm", 2, "Distance between solved and captured ankles; rms over frames and legs."
    )
    ankle_stance: float = declared("ankle in stance", "cm", 2, _IN_STANCE)
    knee: float = declared(
        "knee", "cm", 2, "Distance between solved and captured knees; rms over frames and legs."
    )
    knee_stance: float = declared("knee in stance", "cm", 2, _IN_STANCE)
    knee_angle: float = declared(
        "knee angle", "°", 2,
        "Difference between solved and captured knee angles; rms over frames and legs.",
    )  # fmt: skip
    knee_angle_stance: float = declared("knee angle in stance", "°", 2, _IN_STANCE)
    straight: float = declared("straight legs", "%", 2, MEASURES["straight"].meaning)
    lift_change: float = declared(
        "lift", "cm a frame", 2,
        "Largest change, from one frame to the next, of an ankle's height over the animated "
        "ankle. It grows with the duration of a frame.",
        formerly="pop",
    )  # fmt: skip
    added_slip: float = declared(
        "added slip", "mm a frame", 3,
        "How much further a standing ankle moves horizontally, from one frame to the next, than "
        "the captured one; mean, where frames in which it moves less count as 0.",
    )  # fmt: skip
    bone_length: float = declared(
        "bone length", "mm", 3, "Largest error in the length of a thigh or a shin."
    )  # fmt: skip


ACCURACY = Accuracy.measures()
IN_BRIEF = ("pelvis", "ankle", "ankle_stance", "knee", "knee_angle", "straight", "lift_change")


@dataclass(frozen=True)
class Errors:
    """The errors behind `Accuracy`, frame by frame; `changes` are between consecutive frames."""

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
    our_steps, their_steps = (horizontal_steps(joints["ankle"]) for joints in (ours, theirs))
    thigh, shin = ours["knee"] - ours["hip"], ours["ankle"] - ours["knee"]
    our_angle, their_angle = (
        knee_angle(joints["hip"], joints["knee"], joints["ankle"]) for joints in (ours, theirs)
    )
    return Errors(
        pelvis=ours["pelvis"][:, 1] - theirs["pelvis"][:, 1],
        ankle=np.linalg.norm(ours["ankle"] - theirs["ankle"], axis=-1),
        knee=np.linalg.norm(ours["knee"] - theirs["knee"], axis=-1),
        knee_angle=our_angle - their_angle,
        stance=stance,
        straight=straight(ours["hip"], ours["ankle"], lengths),
        lift=np.diff((ours["ankle"] - animated_ankle_ws)[..., 1], axis=0),
        slip=(our_steps - their_steps)[stance[1:] & stance[:-1]],
        bones=np.linalg.norm(np.stack([thigh, shin], axis=2), axis=-1) - lengths,
    )


def clip_errors(solved: Clip, captured: Clip, animation: Clip) -> Errors:
    """Differences between a solved clip and the captured one, over the same frames.

    The captured clip says when a foot stands, by its contact labels or else by its motion. The flat
    animation's bones have the lengths of its rig.
    """
    rig = animation.rig
    return errors(
        positions_by_role(solved),
        positions_by_role(captured),
        animation.joints_ws(2),
        captured.stance_labels(),
        np.stack([np.asarray(rig.thigh), np.asarray(rig.shin)], axis=-1),
    )


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
        lift_change=_largest(joined["lift"]),
        added_slip=_mean(np.maximum(joined["slip"], 0.0)),
        bone_length=_largest(joined["bones"]),
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if values.size else float("nan")


def _largest(values: np.ndarray) -> float:
    return float(np.abs(values).max()) if values.size else float("nan")


@dataclass(frozen=True)
class Difference:
    """Differences in one clip, by quantity; a column for each leg, or one for the body."""

    legs: tuple[str, ...]
    time: Float[np.ndarray, " frames"]
    """Seconds."""
    standing: Bool[np.ndarray, " frames"]
    """Of the character, not of a foot."""
    correction: Mapping[str, Float[np.ndarray, "frames columns"]]
    """Reference - animation, m or rad."""
    remaining: Mapping[str, Float[np.ndarray, "frames columns"]]
    """Reference - system, m or rad."""


@dataclass(frozen=True)
class Remainder:
    """The remainder of the correction of one quantity, m or rad."""

    correction: float
    """Rms."""
    rms: float
    p95: float
    """95th percentile."""
    max: float

    @property
    def reproduced(self) -> float | None:
        """1 - rms / correction: 1 for the same motion, 0 for one no better than the animation.

        None where the reference corrects nothing.
        """
        return 1.0 - self.rms / self.correction if self.correction > NEGLIGIBLE else None


def measure_difference(scene: Scene, result: jaxik.Result) -> Difference:
    """How far a system's result is from the scene's reference in each frame."""
    present = np.asarray(scene.rig.present)
    dt = np.asarray(scene.frames.dt)
    return Difference(
        legs=tuple(n for n, here in zip(scene.rig.names, present, strict=True) if here),
        time=np.cumsum(dt) - dt[0],
        standing=np.asarray(scene.frames.speed) <= STANDING_SPEED,
        correction=correction(scene),
        remaining=_distances(scene, pelvis_ws(scene, result), legs_ws(scene, result)),
    )


def correction(scene: Scene) -> dict[str, Float[np.ndarray, "frames columns"]]:
    """How far the scene's reference is from its animation, by quantity, m or rad."""
    pelvis = scene.frames.world_from_model @ scene.pelvis
    return _distances(scene, pelvis, animated_legs_ws(scene))


def _distances(scene: Scene, pelvis: Transform, legs: jaxik.LegPose) -> dict[str, np.ndarray]:
    """Distances of a motion from the scene's reference, m or rad."""
    reference, present = scene.reference, np.asarray(scene.rig.present)

    def length(vectors: Array) -> np.ndarray:
        return np.linalg.norm(np.asarray(vectors), axis=-1)

    def angle(a: Array, b: Array) -> np.ndarray:
        return 2.0 * np.arcsin(np.minimum(0.5 * length(rotation_between(a, b)), 1.0))

    return {
        "ankle": length(legs.ankle.pos - reference.ankle.pos)[:, present],
        "knee": length(legs.knee.pos - reference.knee_ws)[:, present],
        "pelvis": length(pelvis.pos - reference.pelvis.pos)[:, None],
        "foot": angle(reference.ankle.rot, legs.ankle.rot)[:, present],
        "body": angle(reference.pelvis.rot, pelvis.rot)[:, None],
    }


def summarise_differences(clips: Sequence[Difference]) -> dict[str, dict[str, Remainder]]:
    """The remainder of each quantity, by phase: "all frames" of all clips.

    Where the character stands in some frames and moves in others, these are also the phases
    "standing" and "moving".
    """
    phases = {"all frames": _remainders(clips, [np.ones_like(clip.standing) for clip in clips])}
    standing = [clip.standing for clip in clips]
    if any(frames.any() for frames in standing) and not all(frames.all() for frames in standing):
        phases["standing"] = _remainders(clips, standing)
        phases["moving"] = _remainders(clips, [~frames for frames in standing])
    return phases


def _remainders(
    clips: Sequence[Difference], chosen: Sequence[Bool[np.ndarray, " frames"]]
) -> dict[str, Remainder]:
    """The remainder of each quantity over the chosen frames of each clip."""

    def over_clips(series: Sequence[np.ndarray]) -> np.ndarray:
        pairs = zip(series, chosen, strict=True)
        return np.concatenate([values[frames].ravel() for values, frames in pairs])

    remainders = {}
    for quantity in QUANTITIES:
        before = over_clips([clip.correction[quantity] for clip in clips])
        after = over_clips([clip.remaining[quantity] for clip in clips])
        remainders[quantity] = Remainder(
            correction=float(np.sqrt(np.mean(before**2))),
            rms=float(np.sqrt(np.mean(after**2))),
            p95=float(np.percentile(after, 95)),
            max=float(after.max()),
        )
    return remainders


@in_float64
def position_error(ik: jaxik.FootIK, scene: Scene) -> float:
    """Distance of pelvis, knees and ankles from the captured ones, m, rms over joints and frames.

    Frames that were not observed, and legs that the rig only has in name, do not count; NaN if
    nothing is left.
    """
    squares, count = _squares(ik, scene)
    return float(np.sqrt(squares / count)) if count else float("nan")


@cached
def _squares(ik: jaxik.FootIK, scene: Scene) -> tuple[Array, Array]:
    """Sum of the squared distances, m², and their number."""
    errors = errors_by_kind(scene, run_scene(ik, scene))
    total, count = jnp.zeros(len(scene.frames.dt)), jnp.zeros((), int)
    for joint in FITTED_JOINTS:
        counts = scene.counts(joint)
        squares = jnp.where(over_frames(counts, errors[joint]), errors[joint] ** 2, 0.0)
        total = total + jnp.sum(squares.reshape(len(total), -1), axis=1)
        count = count + jnp.sum(counts)
    return jnp.sum(total), count
