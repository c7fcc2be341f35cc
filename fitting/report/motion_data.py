"""Motions and ground as the page's scripts read them: small integers in base64.

Joints are relative to the pelvis of their own motion, in steps of less than a tenth of a
millimetre for a body of 2 m; the pelvis itself has 32-bit floats, relative to a corner near the
path. Ground is in steps of a 65,534th of its range.
"""

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

from fitting.clips import Clip
from fitting.clips.clip import Model
from fitting.ground.ground_path import GroundPatch
from fitting.motion import measures
from fitting.motion.measures import PlacedMotion, Soles
from jaxik.world import body

from . import bodies, live_data, style
from .bodies import Skin
from .live_data import LiveClip

MAX_RATE = 60.0  # frames per second that are shown
MAX_BYTES = 5_500_000  # of all motions, grounds and pictures, before base64 adds a third
MAX_GROUND_BYTES = 900_000  # of these, of the grounds
LARGEST = 32_767  # of a 16-bit integer
HOLE = 65_535  # in place of a height, where there is no ground
TENTH = 1e-4  # m, in steps of which gaps are rounded
NO_GAP = -32_768  # in place of a gap, where there is no ground below a sole
FORMAT = 2  # of what is packed, which scripts of another version cannot read


class Appearance(NamedTuple):
    """How a skeleton is drawn."""

    colour: str
    """As `#rrggbb`."""
    thickness: float = 1.0
    """Of its body."""
    opacity: float = 1.0
    """Below 1 it is a shell of glass."""


ANIMATED = Appearance(style.SLIDING, 0.9, 0.25)
BEFORE = Appearance(style.BEFORE, 0.9)
CAPTURED = Appearance(style.CAPTURED, 1.12, 0.1)  # around what should be inside it
FITTED = Appearance(style.AFTER)


@dataclass(frozen=True)
class ViewedMotion:
    """A motion as the page shows it."""

    label: str
    motion: PlacedMotion
    appearance: Appearance
    visible: bool = False
    """At first; the legend shows and hides it."""
    worst: tuple[int, int] | None = None
    """First and last frame of its worst seconds; None for one that cannot be watched."""


@dataclass(frozen=True)
class ViewedClip:
    """What the page shows of one clip."""

    motions: Mapping[str, ViewedMotion]
    """By a key that is the same in all clips."""
    stance: Bool[np.ndarray, "frames legs"]
    flat: Clip
    """The animation at its own speed, beyond which a standing foot slides."""
    ground: GroundPatch
    watched: str
    """Key of the motion that is watched at first."""
    live: LiveClip | None = None
    """With which the page solves the clip again; None for one that stays as it is."""

    @property
    def reference(self) -> PlacedMotion:
        """The motion that gives frame rate, body and direction: the first one, as it was played."""
        return next(iter(self.motions.values())).motion


def pack(clips: Sequence[ViewedClip], spent: int = 0) -> list[dict[str, Any]]:
    """All clips of a page, with so few frames and so coarse a ground that it stays small.

    Args:
        clips: what is shown.
        spent: bytes of the page's pictures.
    """
    grounds = coarse_grounds([clip.ground for clip in clips])
    corners = [_corner(*pair) for pair in zip(clips, grounds, strict=True)]
    lives, spent_on_lives = live_data.pack([clip.live for clip in clips], corners)
    skins = [_skins(clip) for clip in clips]
    spent += sum(skin.size for each in skins for skin in each.values())
    room = MAX_BYTES - spent - spent_on_lives - sum(map(_ground_bytes, grounds))
    steps = steps_between_frames(clips, room)
    packed = zip(clips, grounds, corners, lives, steps, skins, strict=True)
    return [_pack_clip(*each) for each in packed]


def _skins(clip: ViewedClip) -> dict[Model, Skin]:
    """The meshes of the characters of a clip's motions."""
    clips = {each.motion.clip.model: each.motion.clip for each in clip.motions.values()}
    skins = {model: bodies.pack_skin(of) for model, of in clips.items() if model is not None}
    return {model: skin for model, skin in skins.items() if skin is not None}


def steps_between_frames(clips: Sequence[ViewedClip], room: int = MAX_BYTES) -> list[int]:
    """How many frames of each clip make one on the page; all motions then fit into `room` bytes."""
    frames = [len(clip.stance) for clip in clips]
    steps = [max(1, math.ceil(clip.reference.clip.fps / MAX_RATE - 0.01)) for clip in clips]
    sizes = [sum(_motion_bytes(each.motion) for each in clip.motions.values()) for clip in clips]
    while sum(size / step for size, step in zip(sizes, steps, strict=True)) > room:
        if all(step >= count for step, count in zip(steps, frames, strict=True)):
            break  # one frame is left of each
        steps = [2 * step for step in steps]
    return steps


def coarse_grounds(grounds: Sequence[GroundPatch]) -> list[GroundPatch]:
    """The grounds, all with so few heights that together they take `MAX_GROUND_BYTES` at most."""
    every = 1
    while sum(map(_ground_bytes, grounds)) > MAX_GROUND_BYTES * every**2:
        every += 1
    return [
        GroundPatch(ground.corner, every * ground.spacing, ground.heights[::every, ::every])
        for ground in grounds
    ]


def _ground_bytes(ground: GroundPatch) -> int:
    return 2 * ground.heights.size


def _motion_bytes(motion: PlacedMotion) -> int:
    frames, legs = motion.in_ground.shape
    turns = 0 if motion.clip.model is None else 8 * len(motion.clip.parents)
    return 2 * _points(motion.clip, motion.soles).size + frames * (12 + 2 * legs + turns)


def _corner(clip: ViewedClip, ground: GroundPatch) -> np.ndarray:
    """What places of a clip are relative to, m."""
    return np.append(ground.corner, _lowest(ground, clip.reference))[[0, 2, 1]]


def _pack_clip(
    clip: ViewedClip,
    ground: GroundPatch,
    corner: np.ndarray,
    live: dict[str, Any] | None,
    step: int,
    skins: Mapping[Model, Skin],
) -> dict[str, Any]:
    firsts: dict[Model, str] = {}  # the first motion that has a mesh brings it
    for key, viewed in clip.motions.items():
        model = viewed.motion.clip.model
        if model is not None and model in skins:
            firsts.setdefault(model, key)
    reference = clip.reference.clip
    return {
        "format": FORMAT,
        "rate": reference.fps / step,
        "frames": len(range(0, reference.frame_count, step)),
        "size": float(body.ratio(reference.rig)),
        "legs": list(reference.rig.names),
        "forward": _travel(reference.positions_ws[:, reference.rig.pelvis]),
        "stance": _bytes(_any_of(clip.stance, step)),
        "flatPath": _base64(_path(clip.flat, step).astype("<f4")),
        "watched": clip.watched,
        "corner": corner.tolist(),
        "step": step,
        "visibleDepth": float(clip.reference.measures.visible),
        "skeletons": [
            {
                "key": key,
                **_pack_appearance(viewed, step),
                **_pack_motion(viewed.motion, step, corner),
                **_pack_skin(viewed.motion.clip, step, skins, firsts, key),
            }
            for key, viewed in clip.motions.items()
        ],
        "ground": _pack_ground(ground, corner),
        "live": live and live | {"step": step},
    }


def _pack_appearance(viewed: ViewedMotion, step: int) -> dict[str, Any]:
    worst = viewed.worst
    return {
        "label": viewed.label,
        **viewed.appearance._asdict(),
        "visible": viewed.visible,
        "worst": None if worst is None else {"start": worst[0] // step, "end": worst[1] // step},
    }


def _pack_motion(motion: PlacedMotion, step: int, corner: np.ndarray) -> dict[str, Any]:
    clip = motion.clip
    points = _points(motion.clip, motion.soles)[::step]
    root = points[:, clip.rig.pelvis].copy()
    offsets = points - root[:, None]
    quantum = max(float(np.abs(offsets).max()), 1e-6) / LARGEST
    joints = len(clip.joint_names)
    soles = [[joints + 2 * leg, joints + 2 * leg + 1] for leg in range(len(clip.rig.names))]
    return {
        "points": points.shape[1],
        "shape": bodies.pack(clip),
        "pelvis": clip.rig.pelvis,
        "legs": [list(map(int, leg)) for leg in clip.rig.joints],
        "soles": soles,
        "quantum": quantum,
        "root": _base64((root - corner).astype("<f4")),
        "offsets": _base64(np.round(offsets / quantum).astype("<i2")),
        "gap": _base64(_rounded(_lowest_gaps(motion.soles, step))),
    }


def _pack_skin(
    clip: Clip, step: int, skins: Mapping[Model, Skin], firsts: Mapping[Model, str], key: str
) -> dict[str, Any]:
    """The mesh of a motion's character, or which motion brings it, and its joints' rotations."""
    if clip.model is None or clip.model not in skins:
        return {}
    skin, first = skins[clip.model], firsts[clip.model]
    rotations_ws = clip.rotations_ws[::step][:, list(skin.joints)]
    turns = {"skinned": first, "turns": bodies.pack_rotations(rotations_ws)}
    return turns | ({"skin": skin.content} if key == first else {})


def _points(clip: Clip, soles: Soles) -> np.ndarray:
    """Joints and, after them, both points of each sole, m: (frames, points, 3)."""
    soles_ws = soles.points_ws
    return np.concatenate([clip.positions_ws, soles_ws.reshape(len(soles_ws), -1, 3)], 1)


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


def _lowest(ground: GroundPatch, motion: PlacedMotion) -> float:
    """Height of the lowest known ground, m, or else of the lowest sole of a motion."""
    known = np.isfinite(ground.heights)
    return float(np.nanmin(ground.heights if known.any() else motion.soles.points_ws))


def _travel(pelvis: np.ndarray) -> list[float]:
    """The direction in x and z in which a pelvis gets furthest; z where it stays in place."""
    offsets = (pelvis - pelvis[0])[:, [0, 2]]
    furthest = offsets[int(np.argmax(np.linalg.norm(offsets, axis=1)))]
    distance = float(np.linalg.norm(furthest))
    return [0.0, 1.0] if distance < 0.2 else (furthest / distance).tolist()


def solution(clip: Clip, soles: Soles, shown: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Another motion of a clip as its page shows one that it has solved: points and gaps, m.

    Where the character has a mesh, rotations of its joints are there, too.

    Args:
        clip: over all frames.
        soles: of the clip.
        shown: the clip as the page has it.
    """
    step = shown["step"]
    points = (_points(clip, soles)[::step] - np.array(shown["corner"])).astype("<f4")
    arrays = {"points": points, "gap": _lowest_gaps(soles, step).astype("<f4")}
    for skeleton in shown["skeletons"]:
        if "skin" in skeleton:
            rotations_ws = clip.rotations_ws[::step][:, skeleton["skin"]["joints"]]
            arrays["turns"] = bodies.rounded_rotations(rotations_ws)
    return arrays


def _lowest_gaps(soles: Soles, step: int) -> np.ndarray:
    """Gaps of every `step`-th frame, m; of those up to the next one the lowest counts."""
    gap = soles.gap
    gap = np.pad(gap, [(0, -len(gap) % step), (0, 0)], constant_values=np.nan)
    return np.fmin.reduce(gap.reshape(-1, step, gap.shape[1]), axis=1)


def _rounded(gap: np.ndarray) -> np.ndarray:
    """Gaps as integers."""
    tenths = np.clip(np.round(gap / TENTH), -LARGEST, LARGEST)
    return np.where(np.isnan(tenths), NO_GAP, np.nan_to_num(tenths)).astype("<i2")


def _path(clip: Clip, step: int) -> np.ndarray:
    """How far each ball has gone over the ground since the clip began, m, in every `step`-th frame.

    The page takes the paths of other motions from the same frames.
    """
    steps = measures.horizontal_steps(clip.joints_ws(3)[::step])
    return np.concatenate([np.zeros((1, steps.shape[1])), np.cumsum(steps, axis=0)])


def _any_of(marks: np.ndarray, step: int) -> np.ndarray:
    """Marks of every `step`-th frame; one between two that are shown counts for the first."""
    marks = np.pad(marks, [(0, -len(marks) % step), (0, 0)])
    return np.any(marks.reshape(-1, step, marks.shape[1]), axis=1)


def _bytes(marks: np.ndarray) -> str:
    return _base64(marks.astype(np.uint8))


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")
