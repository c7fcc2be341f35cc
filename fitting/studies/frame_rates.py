"""How much the motion of a system depends on the frame rate at which it runs.

An animation is played at other rates than its own, as games play it, and the motions are compared
where their frames coincide or, for rates that are no divisor of the clip's, between its frames.
What the animation says of itself, such as its contact labels, is made at its own rate, as a game
keeps it with the asset; speeds are those between the frames that are played.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace

import numpy as np

import jaxik
from fitting.datasets.clip_frames import positions_by_role
from fitting.datasets.clips import Clip, edit
from fitting.datasets.clips.flight import grounded_track
from fitting.runtime.precision import in_float64
from fitting.runtime.validation import error_context

from .animations import Animation

JOINTS = ("pelvis", "knee", "ankle", "ball")


@dataclass(frozen=True)
class RateDifference:
    """How far the motion of a system at one rate is from that at the clip's own."""

    system: str
    fps: float
    rms: Mapping[str, float]
    """m, over frames and legs, of each of `JOINTS`."""
    largest: Mapping[str, float]
    """m, likewise."""


@in_float64
def measure(
    systems: Mapping[str, jaxik.FootIK],
    animation: Animation,
    rates: Sequence[float],
    during: Callable[[str], AbstractContextManager] = nullcontext,
) -> list[RateDifference]:
    """The differences of all systems at all rates, system by system.

    Args:
        systems: by name.
        animation: at the rate to which the others are compared.
        rates: Hz, above 0 and not above the animation's.
        during: makes a context for the runs of each system, from its name.

    Raises:
        ValueError: for a rate outside that range, or a system that does not fit the animation.
    """
    own = animation.clip.fps
    if wrong := [fps for fps in rates if not 0 < fps <= own]:
        raise ValueError(
            f"the rate {wrong[0]:g} Hz; wanted rates above 0 and up to the clip's, {own:g} Hz"
        )
    played = [at_rate(animation, fps) for fps in rates]
    differences = []
    for name, ik in systems.items():
        with error_context(name), during(name):
            animation.check_shapes(ik)
            _, reference = animation.solve(ik)
            for slower in played:
                _, solved = slower.solve(ik)
                differences.append(_difference(name, solved, edit.resample(reference, solved.fps)))
    return differences


def at_rate(animation: Animation, fps: float) -> Animation:
    """The animation at another rate, with the labels and the root that it has at its own."""
    clip = animation.clip
    baked = replace(clip, stance=clip.stance_labels(), grounded=grounded_track(clip))
    played = edit.resample(baked, fps)
    frame = np.minimum(np.arange(played.frame_count) * (clip.fps / fps), clip.frame_count - 1)
    nearest = np.round(frame).astype(int)
    rise = animation.root.rise
    if rise is not None:
        rise = np.interp(frame, np.arange(clip.frame_count), rise)
    return replace(
        animation,
        clip=played,
        root=replace(animation.root, rise=rise),
        tracks={name: values[nearest] for name, values in animation.tracks.items()},
    )


def _difference(system: str, solved: Clip, reference: Clip) -> RateDifference:
    before, after = positions_by_role(reference), positions_by_role(solved)
    distance = {
        joint: np.linalg.norm(after[joint] - before[joint], axis=-1).ravel() for joint in JOINTS
    }
    return RateDifference(
        system,
        solved.fps,
        rms={joint: float(np.sqrt(np.mean(values**2))) for joint, values in distance.items()},
        largest={joint: float(values.max()) for joint, values in distance.items()},
    )
