"""The motions of several systems on one animation, as whole skeletons on their ground."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from fitting.analysis import accuracy
from fitting.analysis.accuracy import Accuracy
from fitting.analysis.placement import Placement, Soles
from fitting.analysis.worst_window import SECONDS
from fitting.datasets import ground_patch
from fitting.datasets.clips import Clip
from fitting.datasets.ground_patch import GroundPatch
from fitting.runtime.precision import in_float64
from fitting.studies.animations import Animation
from fitting.studies.comparison import ANIMATED, Comparison
from fitting.studies.suite.suite import Scene

from .placed_motion import PlacedMotion, place, with_soles_of


@dataclass(frozen=True)
class ComparedMotions:
    """What several systems make of one animation."""

    motions: Mapping[str, PlacedMotion]
    """By name; the animation itself comes first, with its root where foot IK gets it."""
    worst: Mapping[str, tuple[int, int]]
    """First and last frame of the `SECONDS` in which the feet of each are furthest off."""
    captured: PlacedMotion | None
    """Where it is known."""
    accuracy: Mapping[str, Accuracy]
    """How far each is from the captured motion; of none where that is unknown."""
    stance: Bool[np.ndarray, "frames legs"]
    """Where the animation says that a foot stands."""
    ground: GroundPatch


@in_float64
def of_comparison(comparison: Comparison) -> ComparedMotions:
    """The motions of a comparison."""
    animation = comparison.animation
    measured = {name: animation.place(clip) for name, clip in comparison.clips.items()}
    return _compared(animation, comparison.clips, measured)


@in_float64
def of_scene(scene: Scene) -> ComparedMotions:
    """The motions of a situation of the suite, without systems that gave none."""
    animation = scene.animation
    clips = {name: outcome.clip for name, outcome in scene.outcomes.items()}
    measured = {name: (own.soles, own.placement) for name, own in scene.outcomes.items()}
    flat = animation.placed_clip
    first = {ANIMATED: flat}, {ANIMATED: animation.place(flat)}
    return _compared(animation, first[0] | clips, first[1] | measured)


def worst_seconds(feet: Soles, fps: float) -> tuple[int, int]:
    """First and last frame of the `SECONDS` in which feet are furthest off their ground.

    What counts is the depth of any foot in the ground and the height of standing ones above it,
    summed over feet and frames. A foot without ground counts for nothing.

    Args:
        feet: soles over the ground.
        fps: frames per second.
    """
    gap = np.nan_to_num(feet.gap)
    off = np.sum(np.maximum(-gap, 0.0) + np.where(feet.stance, np.maximum(gap, 0.0), 0.0), axis=1)
    frames = min(len(off), round(SECONDS * fps) + 1)
    sums = np.convolve(off, np.ones(frames), mode="valid")
    start = int(np.argmax(sums))
    return start, start + frames - 1


def _compared(
    animation: Animation,
    clips: Mapping[str, Clip],
    measured: Mapping[str, tuple[Soles, Placement]],
) -> ComparedMotions:
    flat, captured = animation.placed_clip, animation.captured
    if captured is not None:
        captured = with_soles_of(captured, animation.clip)
    # Rays start above the highest motion, so that one inside a hill does not hide the hill.
    highest = max(clips.values(), key=lambda clip: float(clip.positions_ws[..., 1].max()))
    return ComparedMotions(
        motions={name: place(clip, *measured[name]) for name, clip in clips.items()},
        worst={name: worst_seconds(feet, flat.fps) for name, (feet, _) in measured.items()},
        captured=None if captured is None else place(captured, *animation.place(captured)),
        accuracy={
            name: accuracy.summarise([accuracy.clip_errors(clip, captured, flat)])
            for name, clip in clips.items()
        }
        if captured is not None
        else {},
        stance=flat.stance_labels(),
        ground=ground_patch.around_path(highest, animation.terrain),
    )
