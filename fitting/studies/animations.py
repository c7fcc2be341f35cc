"""A flat animation on a terrain, and what a system makes of it."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

import jaxik
from fitting.datasets.clip_frames import clip_from_result, frames_from_clip
from fitting.datasets.clips import Clip
from fitting.datasets.flat_animation import load_flat_animation
from fitting.datasets.terrain.mesh_files import load_terrain
from fitting.experiments import problems
from fitting.runtime import program_cache
from jaxik.world.terrain import Terrain


@dataclass(frozen=True)
class AnimationFiles:
    """Where a flat animation and a terrain are read from."""

    clip: Path
    terrain: Path
    file_up: str = "y"
    """Up axis of the terrain's file."""
    floor: float = 0.0
    """m, height of the floor on which the clip was animated."""


@dataclass(frozen=True)
class Animation:
    """A flat animation on a terrain."""

    clip: Clip
    """With bones of the rig's lengths, as `load_flat_animation` gives it."""
    terrain: Terrain
    floor: float = 0.0
    """m, height of the floor on which the clip was animated."""

    @cached_property
    def frames(self) -> jaxik.Frame:
        """The clip as the pipeline's input."""
        return frames_from_clip(self.clip, floor=self.floor)

    def check_shapes(self, ik: jaxik.FootIK) -> None:
        """Raises ValueError if a parameter of the system has too many values for the rig."""
        problems.check_shapes(ik, self.clip.rig, self.terrain, self.frames)

    def solve(self, ik: jaxik.FootIK) -> tuple[jaxik.Result, Clip]:
        """The result of a system, and the clip as the system leaves it.

        Raises:
            ValueError: the poses are not finite.
        """
        result = program_cache.run(ik, self.clip.rig, self.terrain, self.frames)
        solved = clip_from_result(self.clip, result, floor=self.floor)
        if not np.isfinite(solved.positions_ws).all():
            raise ValueError("these parameters give poses that are not finite; nothing was written")
        return result, solved


def load_animation(files: AnimationFiles) -> Animation:
    """Reads a flat animation and its terrain.

    Raises:
        ValueError: a file does not exist or cannot be read.
    """
    return Animation(
        load_flat_animation(files.clip),
        load_terrain(files.terrain, file_up=files.file_up),
        files.floor,
    )
