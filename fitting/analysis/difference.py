"""How far a system's motion is from its reference, and how much of the reference it reproduces.

The reference is what another system made of the same animation. What that system changed in the
animation is its correction; what the fitted system does not reproduce of it remains.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Array, Bool, Float

import jaxik
from fitting.problem.residuals import rotation_between
from fitting.problem.scene import Scene, legs_ws, pelvis_ws
from jaxik.world.skeleton import Transform

STANDING_SPEED = 0.02  # m/s; a slower character stands
NEGLIGIBLE = 1e-4  # m or rad, rms; a smaller correction counts as none
QUANTITIES = ("ankle", "knee", "pelvis", "foot", "body")  # positions, then orientations


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
    """What remains of the correction of one quantity, m or rad."""

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


def measure(scene: Scene, result: jaxik.Result) -> Difference:
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
    world = scene.frames.world_from_model
    legs = scene.frames.pose.transformed(Transform(world.pos[:, None], world.rot[:, None]))
    return _distances(scene, world @ scene.pelvis, legs)


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


def summarise(clips: Sequence[Difference]) -> dict[str, dict[str, Remainder]]:
    """What remains of each quantity, by phase: "all frames" of all clips.

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
    """What remains of each quantity over the chosen frames of each clip."""

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
