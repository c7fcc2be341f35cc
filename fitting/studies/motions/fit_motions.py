"""The motions that a fit is about, as whole skeletons on their ground, for the report's page.

The run folder keeps two of them, the flat animation and the fitted motion.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64

import jaxik
from fitting.analysis import accuracy, measures, placement
from fitting.analysis.accuracy import Accuracy, Errors
from fitting.analysis.placement import Placement
from fitting.datasets import ground_patch
from fitting.datasets.clip_frames import clip_from_result, raised
from fitting.datasets.clips import Clip
from fitting.datasets.ground_patch import GroundPatch
from fitting.experiments.problems import ClipData
from fitting.runtime.precision import in_float64
from fitting.studies.fit import Fit

SOLES = ("ankle_height", "ball_height", "ankle_from_foot")  # of a rig: where the soles are


@dataclass(frozen=True)
class PlacedMotion:
    """A motion, and how its feet are placed on the ground."""

    clip: Clip
    soles_ws: Float64[np.ndarray, "frames legs 2 3"]
    """m, below ankles and balls."""
    in_ground: Bool[np.ndarray, "frames legs"]
    """Where a sole is visibly in the ground, as `placement` counts it."""
    placement: Placement


@dataclass(frozen=True)
class ClipMotions:
    """One clip of a fit."""

    animated: PlacedMotion
    """The flat animation, with its root where foot IK gets it."""
    before: PlacedMotion
    """By the system as it was before the fit."""
    fitted: PlacedMotion
    captured: PlacedMotion
    stance: Bool[np.ndarray, "frames legs"]
    """Where the captured foot stands, by the clip's labels or else by its motion."""
    ground: GroundPatch
    errors: dict[str, Errors]
    """Of `before` and `fitted`, against the captured motion."""


@in_float64
def fitted_clip(data: ClipData, result: jaxik.Result) -> Clip:
    """A clip as a system leaves it.

    Args:
        data: the clip, over the frames of the result.
        result: of the system on this clip.
    """
    return clip_from_result(data.base, result, rise=data.root.rise)


@in_float64
def clip_motions(data: ClipData, before: jaxik.Result, fitted: jaxik.Result) -> ClipMotions:
    """The motions of one clip, measured on its ground.

    Args:
        data: the clip.
        before: what the system made of it before the fit.
        fitted: what the fitted system makes of it.
    """
    animated = raised(data.base, data.root.rise)
    solved = {"before": fitted_clip(data, before), "fitted": fitted_clip(data, fitted)}
    captured = with_soles_of(data.reference, data.base)
    placed = {
        name: _placed(clip, animated, data)
        for name, clip in {"animated": animated, **solved, "captured": captured}.items()
    }
    return ClipMotions(
        **placed,
        stance=data.reference.stance_labels(),
        ground=ground_patch.around_path(data.reference, data.terrain),
        errors={
            name: accuracy.clip_errors(clip, data.reference, animated)
            for name, clip in solved.items()
        },
    )


def with_soles_of(captured: Clip, flat: Clip) -> Clip:
    """The captured clip with the soles of the flat animation.

    Its own are measured as if it stood on a floor; on uneven ground they are not where they seem.
    """
    own, rig = captured.measured_rig, flat.measured_rig
    if own is None or rig is None:
        return captured
    soles = {name: getattr(rig, name) for name in SOLES}
    return replace(captured, measured_rig=replace(own, **soles))


def _placed(clip: Clip, animated: Clip, data: ClipData) -> PlacedMotion:
    feet = placement.soles(clip, data.base, data.terrain)
    placed = placement.assess(feet, clip, animated)
    return PlacedMotion(clip, measures.soles(clip), feet.gap < -placed.visible, placed)


def summarised(motions: Sequence[ClipMotions]) -> dict[str, Accuracy]:
    """How far the motions `before` and `fitted` are from the captured ones, over all clips."""
    return {
        name: accuracy.summarise([clip.errors[name] for clip in motions])
        for name in ("before", "fitted")
    }


def saved_clips(fitted: Fit) -> dict[str, Clip]:
    """What the run folder keeps of the motions, by file name; numbered for several clips."""
    clips: dict[str, Clip] = {}
    for number, (data, result) in enumerate(zip(fitted.clips, fitted.results, strict=False), 1):
        ending = f"_{number}.npz" if len(fitted.clips) > 1 else ".npz"
        clips[f"base{ending}"] = data.base
        clips[f"fitted{ending}"] = fitted_clip(data, result)
    return clips
