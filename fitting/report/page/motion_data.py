"""Motions and ground as the page's scripts read them: small integers in base64.

Joints are relative to the pelvis of their own motion, in steps of less than a tenth of a
millimetre for a body of 2 m; the pelvis itself has 32-bit floats, relative to a corner near the
path. Ground is in steps of a 65,534th of its range.
"""

import base64
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fitting.datasets.ground_patch import GroundPatch
from fitting.studies.motions.fit_motions import ClipMotions, PlacedMotion
from jaxik.world import body

MAX_RATE = 60.0  # frames per second that are shown
MAX_BYTES = 4_000_000  # of all motions of a page, before base64 makes them a third longer
LARGEST = 32_767  # of a 16-bit integer
HOLE = 65_535  # in place of a height, where there is no ground


def steps_between_frames(clips: Sequence[ClipMotions]) -> list[int]:
    """How many frames of each clip make one on the page, for a page that is small enough."""
    steps = [max(1, int(np.ceil(clip.captured.clip.fps / MAX_RATE - 0.01))) for clip in clips]
    sizes = [sum(2 * _points(motion).size for motion in shown(clip).values()) for clip in clips]
    while sum(size / step for size, step in zip(sizes, steps, strict=True)) > MAX_BYTES:
        steps = [2 * step for step in steps]
    return steps


def shown(clip: ClipMotions) -> dict[str, PlacedMotion]:
    """The motions by the names under which the page has them, the most important one last."""
    return {
        "animated": clip.animated,
        "before": clip.before,
        "captured": clip.captured,
        "fitted": clip.fitted,
    }


def pack(clip: ClipMotions, step: int, labels: Mapping[str, str]) -> dict[str, Any]:
    """One clip with every `step`-th frame; `labels` are what the page calls the motions."""
    captured = clip.captured.clip
    corner = np.append(clip.ground.corner, _lowest(clip))[[0, 2, 1]]
    return {
        "rate": captured.fps / step,
        "frames": len(range(0, captured.frame_count, step)),
        "size": float(body.ratio(captured.rig)),
        "legs": list(captured.rig.names),
        "forward": _travel(captured.positions_ws[:, captured.rig.pelvis]),
        "stance": _bytes(_any_of(clip.stance, step)),
        "skeletons": [
            {"key": key, "label": labels[key], **_pack_motion(motion, step, corner)}
            for key, motion in shown(clip).items()
        ],
        "ground": _pack_ground(clip.ground, corner),
    }


def _pack_motion(motion: PlacedMotion, step: int, corner: np.ndarray) -> dict[str, Any]:
    clip = motion.clip
    points = _points(motion)[::step]
    root = points[:, clip.rig.pelvis].copy()
    offsets = points - root[:, None]
    quantum = max(float(np.abs(offsets).max()), 1e-6) / LARGEST
    joints = len(clip.joint_names)
    soles = [[joints + 2 * leg, joints + 2 * leg + 1] for leg in range(len(clip.rig.names))]
    return {
        "points": points.shape[1],
        "bones": [[parent, j] for j, parent in enumerate(clip.parents) if parent >= 0],
        "pelvis": clip.rig.pelvis,
        "legs": [list(map(int, leg)) for leg in clip.rig.joints],
        "soles": soles,
        "quantum": quantum,
        "root": _base64((root - corner).astype("<f4")),
        "offsets": _base64(np.round(offsets / quantum).astype("<i2")),
        "inGround": _bytes(_any_of(motion.in_ground, step)),
    }


def _points(motion: PlacedMotion) -> np.ndarray:
    """Joints and, after them, both points of each sole, m: (frames, points, 3)."""
    frames = len(motion.soles_ws)
    return np.concatenate([motion.clip.positions_ws, motion.soles_ws.reshape(frames, -1, 3)], 1)


def _pack_ground(ground: GroundPatch, corner: np.ndarray) -> dict[str, Any]:
    known = np.isfinite(ground.heights)
    low = float(np.min(ground.heights, where=known, initial=np.inf)) if known.any() else 0.0
    high = float(np.max(ground.heights, where=known, initial=-np.inf)) if known.any() else 0.0
    quantum = max(high - low, 1e-6) / (HOLE - 1)
    steps = np.where(known, np.round((np.nan_to_num(ground.heights) - low) / quantum), HOLE)
    return {
        "rows": len(steps),
        "columns": len(steps[0]),
        "spacing": ground.spacing,
        "low": low - float(corner[1]),
        "quantum": quantum,
        "heights": _base64(steps.astype("<u2")),
    }


def _lowest(clip: ClipMotions) -> float:
    """Height of the lowest known ground, m, or else of the lowest captured joint."""
    heights = clip.ground.heights
    return float(np.nanmin(heights if np.isfinite(heights).any() else clip.captured.soles_ws))


def _travel(pelvis: np.ndarray) -> list[float]:
    """The direction in x and z in which a pelvis gets furthest; z where it stays in place."""
    offsets = (pelvis - pelvis[0])[:, [0, 2]]
    furthest = offsets[int(np.argmax(np.linalg.norm(offsets, axis=1)))]
    distance = float(np.linalg.norm(furthest))
    return [0.0, 1.0] if distance < 0.2 else (furthest / distance).tolist()


def _any_of(marks: np.ndarray, step: int) -> np.ndarray:
    """Marks of every `step`-th frame; one between two that are shown counts for the first."""
    marks = np.pad(marks, [(0, -len(marks) % step), (0, 0)])
    return np.any(marks.reshape(-1, step, marks.shape[1]), axis=1)


def _bytes(marks: np.ndarray) -> str:
    return _base64(marks.astype(np.uint8))


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")
