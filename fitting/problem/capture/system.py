"""A system together with what is not known of the captures that it is fitted to."""

import dataclasses
import math
from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np

import jaxik
from fitting.problem.problem import Problem
from fitting.problem.scene import Scene
from fitting.problem.space import Vector
from fitting.runtime.precision import in_float64

from . import ground, observation
from .parameters import GROUND, Capture

PREFIX = "capture."  # of the names of what is no parameter of the system


class CapturedSystem(jaxik.FootIK):
    """A system with one more part, so that a space of parameters is one of both."""

    capture: Capture = eqx.field(default_factory=Capture)
    """Of all clips, (clips)."""
    moves_ground: bool = eqx.field(static=True, default=False)
    """Whether anything of the ground is fitted: else rays are as without a capture."""

    @property
    def alone(self) -> jaxik.FootIK:
        """The system itself."""
        stages = dataclasses.fields(jaxik.FootIK)
        return jaxik.FootIK(**{stage.name: getattr(self, stage.name) for stage in stages})


def with_capture(ik: jaxik.FootIK, clips: int, names: Sequence[str]) -> CapturedSystem:
    """A system with a capture of which all is as it seems.

    Args:
        ik: the system.
        clips: how many there are.
        names: of the fields of `Capture` that are fitted.
    """
    stages = {stage.name: getattr(ik, stage.name) for stage in dataclasses.fields(ik)}
    moves_ground = any(name in GROUND for name in names)
    return CapturedSystem(**stages, capture=Capture().for_clips(clips), moves_ground=moves_ground)


def is_of_capture(name: str) -> bool:
    """Whether a free parameter of this name belongs to the capture, and not to the system."""
    return name.startswith(PREFIX)


def alone(ik: jaxik.FootIK) -> jaxik.FootIK:
    """The system itself, if there is a capture beside it."""
    return ik.alone if isinstance(ik, CapturedSystem) else ik


def parted(ik: jaxik.FootIK, scenes: tuple[Scene, ...]) -> tuple[jaxik.FootIK, tuple[Scene, ...]]:
    """The system itself, and the clips as the capture beside it takes them."""
    if not isinstance(ik, CapturedSystem):
        return ik, scenes
    return ik.alone, tuple(
        _as_captured(scene, ik.capture.of_clip(number), moves_ground=ik.moves_ground)
        for number, scene in enumerate(scenes)
    )


def _as_captured(scene: Scene, capture: Capture, *, moves_ground: bool) -> Scene:
    scene = dataclasses.replace(scene, capture=capture)
    if not moves_ground:
        return scene
    centre_ws = observation.centre_of(scene.frames)
    tilts = capture.ground_tilt_x, capture.ground_tilt_z
    terrain = ground.raised(scene.terrain, centre_ws, capture.ground_height, tilts)
    return dataclasses.replace(scene, terrain=terrain)


@in_float64
def system_and_scenes(
    problem: Problem[jaxik.FootIK], u: Vector
) -> tuple[jaxik.FootIK, tuple[Scene, ...]]:
    """The system at a point, and the clips of the problem as its capture takes them there."""
    return parted(problem.space.unpack(u), problem.data)


def without_ends(scene: Scene, seconds: float) -> Scene:
    """The scene without the frames at its ends for which nothing may be known after a shift.

    Args:
        scene: of one clip.
        seconds: by how much the capture may be shifted at most.
    """
    reference = scene.reference
    observed, held_out = np.array(reference.observed), np.array(reference.held_out)
    count = math.ceil(seconds / float(scene.frames.dt[-1])) + 1
    for frames in (observed, held_out):
        frames[:count] = frames[-count:] = False
    return eqx.tree_at(
        lambda scene: (scene.reference.observed, scene.reference.held_out),
        scene,
        jax.device_put((observed, held_out)),
    )
