"""How much the motion of a system depends on the frame rate at which it runs.

Of an animation every second, third or so frame is played, as in a game that draws fewer frames, and
the motion is compared with that of all frames where both have one. What the animation says of
itself, its strides, contact labels and speeds, stays as it is at the animation's own rate: a game
keeps it with the asset.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import jax
import numpy as np

import jaxik
from fitting.datasets.clip_frames import positions_by_role
from fitting.datasets.clips import Clip
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
        rates: Hz, of which whole multiples are the animation's.
        during: makes a context for the runs of each system, from its name.

    Raises:
        ValueError: for another rate, or a system that does not fit the animation.
    """
    steps = [_step(animation.clip.fps, fps) for fps in rates]
    differences = []
    for name, ik in systems.items():
        if not steps:
            break
        with error_context(name), during(name):
            animation.check_shapes(ik)
            _, reference = animation.solve(ik)
            for step in steps:
                _, solved = every_frame(animation, step).solve(ik)
                differences.append(_difference(name, solved, reference, step))
    return differences


def every_frame(animation: Animation, step: int) -> Animation:
    """The animation of which only every so manyth frame is played."""
    played, clip = slice(None, None, step), animation.clip
    own = jax.tree.map(lambda leaf: leaf[played], animation.frames)
    frames = dataclasses.replace(own, dt=own.dt * step)
    if own.restart is not None:  # also where it was between the frames that are played
        restarts = np.flatnonzero(np.asarray(animation.frames.restart))
        at = np.isin(np.arange(len(own.dt)), -(-restarts // step))
        frames = dataclasses.replace(frames, restart=jax.device_put(at))
    rise = animation.root.rise
    return dataclasses.replace(
        animation,
        clip=dataclasses.replace(clip.select(played), fps=clip.fps / step),
        root=dataclasses.replace(animation.root, rise=None if rise is None else rise[played]),
        tracks={name: values[played] for name, values in animation.tracks.items()},
        given_frames=frames,
    )


def _step(own: float, fps: float) -> int:
    step = round(own / fps)
    if step < 1 or abs(step * fps - own) > 1e-6 * own:
        possible = ", ".join(f"{own / n:g}" for n in (1, 2, 3, 4))
        raise ValueError(f"{fps:g} Hz; wanted a part of the clip's rate: {possible}, ... Hz")
    return step


def _difference(system: str, solved: Clip, reference: Clip, step: int) -> RateDifference:
    after, before = positions_by_role(solved), positions_by_role(reference)
    distance = {
        joint: np.linalg.norm(after[joint] - before[joint][::step], axis=-1) for joint in JOINTS
    }
    return RateDifference(
        system,
        solved.fps,
        rms={joint: float(np.sqrt(np.mean(values**2))) for joint, values in distance.items()},
        largest={joint: float(values.max()) for joint, values in distance.items()},
    )
