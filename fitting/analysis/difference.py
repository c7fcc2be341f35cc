"""How far a system's motion is from its reference, and how much of the reference's way it goes.

The reference is what another system made of the same animation. What it changed of the animation
is its own correction; a system that reproduces a share of it leaves the rest.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

import jaxik
from fitting.problem.residuals import Scene, legs_ws, pelvis_ws, rotation_between
from fitting.report.tables import Table, number, share
from fitting.runtime import program_cache
from jaxik.world.skeleton import Transform

STANDING = 0.02  # m/s, speed of a character that stands
LEAST = 1e-4  # m, rad: a correction below it (rms) is none, and has no share
FAITHFUL = 0.95  # share of a correction from which on nothing is said of what is missing


@dataclass(frozen=True)
class Kind:
    """What is compared, in words and in the unit that is shown."""

    words: str
    unit: str
    factor: float  # from m or rad


KINDS = {
    "ankle": Kind("ankles", "mm", 1000.0),
    "knee": Kind("knees", "mm", 1000.0),
    "pelvis": Kind("pelvis", "mm", 1000.0),
    "foot": Kind("orientation of the feet", "°", 180.0 / np.pi),
    "body": Kind("orientation of the pelvis", "°", 180.0 / np.pi),
}


@dataclass(frozen=True)
class Difference:
    """Of one clip; a column a leg, or one of the body."""

    legs: tuple[str, ...]
    time: Float[np.ndarray, " frames"]  # s
    standing: Bool[np.ndarray, " frames"]  # of the character, not of a foot
    correction: Mapping[str, Float[np.ndarray, "frames columns"]]  # reference - animation, m or rad
    remaining: Mapping[str, Float[np.ndarray, "frames columns"]]  # reference - system, m or rad


def measure(ik: jaxik.FootIK, scene: Scene) -> Difference:
    """How far this system is from the scene's reference in each frame, and how far it had to go."""
    result = program_cache.run(ik, scene.rig, scene.terrain, scene.frames)
    present = np.asarray(scene.rig.present)
    dt = np.asarray(scene.frames.dt)
    return Difference(
        legs=tuple(n for n, here in zip(scene.rig.names, present, strict=True) if here),
        time=np.cumsum(dt) - dt[0],
        standing=np.asarray(scene.frames.speed) <= STANDING,
        correction=correction_of(scene),
        remaining=_apart(scene, pelvis_ws(scene, result), legs_ws(scene, result)),
    )


def correction_of(scene: Scene) -> dict[str, np.ndarray]:
    """How far the scene's reference is from its animation, by kind, m or rad."""
    world = scene.frames.world_from_model
    animated = scene.frames.pose.transformed(Transform(world.pos[:, None], world.rot[:, None]))
    return _apart(scene, world @ scene.pelvis, animated)


def _apart(scene: Scene, pelvis: Transform, legs: jaxik.LegPose) -> dict[str, np.ndarray]:
    """Distances of a motion from the scene's reference, m or rad."""
    reference, present = scene.reference, np.asarray(scene.rig.present)

    def length(apart: Any) -> np.ndarray:
        return np.linalg.norm(np.asarray(apart), axis=-1)

    def angle(a: Any, b: Any) -> np.ndarray:
        return 2.0 * np.arcsin(np.minimum(0.5 * length(rotation_between(a, b)), 1.0))

    return {
        "ankle": length(legs.ankle.pos - reference.ankle.pos)[:, present],
        "knee": length(legs.knee.pos - reference.knee_ws)[:, present],
        "pelvis": length(pelvis.pos - reference.pelvis.pos)[:, None],
        "foot": angle(reference.ankle.rot, legs.ankle.rot)[:, present],
        "body": angle(reference.pelvis.rot, pelvis.rot)[:, None],
    }


def numbers(clips: Sequence[Difference]) -> dict[str, dict[str, dict[str, Any]]]:
    """Figures of each kind over all frames of all clips, and apart where both occur, over those in
    which the character stands and in which it moves.

    `correction` (rms), `rms`, `p95` and `max` of what remains in the kind's unit, and `reproduced`,
    1 - rms / correction: 1 is the same motion, 0 no better than the animation; None where the
    reference corrects nothing.
    """
    found = {"all frames": _numbers(clips, [np.ones_like(one.standing) for one in clips])}
    standing = [one.standing for one in clips]
    if any(one.any() for one in standing) and not all(one.all() for one in standing):
        found["standing"] = _numbers(clips, standing)
        found["moving"] = _numbers(clips, [~one for one in standing])
    return found


def _numbers(clips: Sequence[Difference], chosen: Sequence[np.ndarray]) -> dict[str, Any]:
    found = {}
    for name, kind in KINDS.items():
        pairs = list(zip(clips, chosen, strict=True))
        correction = np.concatenate([one.correction[name][some].ravel() for one, some in pairs])
        remaining = np.concatenate([one.remaining[name][some].ravel() for one, some in pairs])
        had, left = (float(np.sqrt(np.mean(one**2))) for one in (correction, remaining))
        found[name] = {
            "correction": kind.factor * had,
            "rms": kind.factor * left,
            "p95": kind.factor * float(np.percentile(remaining, 95)),
            "max": kind.factor * float(remaining.max()),
            "reproduced": 1.0 - left / had if had > LEAST else None,
        }
    return found


def table(phase: Mapping[str, Mapping[str, Any]], source: str) -> Table:
    """One of the tables of `numbers`."""
    rows = [["", f"correction by {source}, rms", "remaining, rms", "95 %", "max", "reproduced"]]
    for name, row in phase.items():
        kind, reproduced = KINDS[name], row["reproduced"]
        shown = [f"{row[key]:.2f} {kind.unit}" for key in ("correction", "rms", "p95", "max")]
        rows.append([kind.words, *shown, "–" if reproduced is None else share(reproduced)])
    return rows


def headline(phase: Mapping[str, Mapping[str, Any]], source: str, target: str) -> str:
    """How much of the source's correction the target reproduces, in a sentence."""
    parts = [
        f"{share(row['reproduced'])} of that of the {KINDS[name].words}"
        for name, row in phase.items()
        if row["reproduced"] is not None
    ]
    return f"Of the correction that {source} makes, {target} reproduces {', '.join(parts)}."


def shortcomings(clips: Sequence[Difference], source: str, target: str) -> list[str]:
    """What the target does not do as the source does, a sentence each, with where it is worst."""
    said = []
    for name, row in numbers(clips)["all frames"].items():
        kind, reproduced = KINDS[name], row["reproduced"]
        left = f"{number(row['rms'])} {kind.unit}"
        if reproduced is None:
            if row["rms"] > kind.factor * LEAST:
                said.append(
                    f"{source} leaves the {kind.words} as animated; {target} is {left} (rms) off, "
                    f"{_worst(clips, name)}."
                )
        elif reproduced < FAITHFUL:
            had = f"{number(row['correction'])} {kind.unit}"
            said.append(
                f"{kind.words.capitalize()}: {left} (rms) remain of {had}, {_worst(clips, name)}."
            )
    return said


def _worst(clips: Sequence[Difference], name: str) -> str:
    """Where what remains of a kind is largest."""
    kind = KINDS[name]
    i = int(np.argmax([one.remaining[name].max() for one in clips]))
    clip = clips[i]
    frame, column = np.unravel_index(np.argmax(clip.remaining[name]), clip.remaining[name].shape)
    side = f" ({clip.legs[column]})" if clip.remaining[name].shape[1] > 1 else ""
    where = f" of clip {i + 1}" if len(clips) > 1 else ""
    largest = number(kind.factor * float(clip.remaining[name][frame, column]))
    return f"at most {largest} {kind.unit} at {clip.time[frame]:.2f} s{where}{side}"
