"""A flat animation on a terrain, and what a system makes of it."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

import jaxik
from fitting.analysis import placement
from fitting.analysis.misplacement import Cause, likely_cause
from fitting.analysis.placement import Placement, Soles
from fitting.analysis.playback import stage_outputs
from fitting.datasets import coverage
from fitting.datasets.clip_frames import clip_from_result, frames_from_clip, raised
from fitting.datasets.clips import Clip, load_clip
from fitting.datasets.clips.edit import at_speed
from fitting.datasets.clips.formats.npz import is_blocks_file
from fitting.datasets.clips.load import ClipOptions
from fitting.datasets.coverage import Coverage
from fitting.datasets.cut_off_swings import with_cut_off_swings
from fitting.datasets.flat_animation import load_flat_animation, with_remark_if_uneven
from fitting.datasets.ground_path import AS_ANIMATED, RootChoice, place_root
from fitting.datasets.terrain.mesh_files import TerrainOptions, load_terrain
from fitting.experiments import systems, track_files
from fitting.runtime import activity, program_cache
from jaxik.maths import parameter_tree, quat, vec
from jaxik.world import body
from jaxik.world.terrain import Terrain, moving

NEAR = 0.005  # m, of an adult: a target that the ankle misses by less is reached


@dataclass(frozen=True)
class AnimationFiles:
    """Where a flat animation and a terrain are read from."""

    clip: Path
    terrain: Path
    floor: float = 0.0
    """m, height of the floor on which the clip was animated."""
    root: str = "auto"
    """Where the root is put; see `place_root`."""
    speed: float = 1.0
    """Of the root, as a multiple of the clip's; strides are scaled alike."""
    tracks: Path | None = None
    """What changes along the clip; see `experiments.track_files`."""
    clip_options: ClipOptions = ClipOptions()
    """How the clip is read."""
    terrain_options: TerrainOptions = TerrainOptions()
    """How the terrain is read."""

    @cached_property
    def flat_clip(self) -> Clip:
        """The flat animation of the file."""
        with activity.announced(f"Reading {self.clip.name}"):
            return load_flat_animation(self.clip, self.floor, self.clip_options)

    def load_terrain(self) -> Terrain:
        """The terrain of the file."""
        return self._load_terrain(self.terrain_options)

    def load_terrain_in(self, unit: float) -> Terrain:
        """The terrain of the file in another unit, m."""
        return self._load_terrain(replace(self.terrain_options, scale=unit))

    def coverage(self, terrain: Terrain) -> Coverage:
        """How much of it is under the feet of the clip."""
        return coverage.measure(
            self.flat_clip, terrain, self.terrain_options, reload=self._load_terrain
        )

    def _load_terrain(self, options: TerrainOptions) -> Terrain:
        return load_terrain(self.terrain, **vars(options))


@dataclass(frozen=True)
class Animation:
    """A flat animation on a terrain."""

    clip: Clip
    """On its floor, with bones of the rig's lengths, as `load_flat_animation` gives it."""
    terrain: Terrain
    floor: float = 0.0
    """m, height of the floor on which the clip was animated."""
    root: RootChoice = AS_ANIMATED
    carried: Float64[np.ndarray, "frames 3"] | None = None
    """m, how far a vehicle has carried terrain and character; clips are in the vehicle's space."""
    speed: float = 1.0
    """Of the clip's root over that with which its feet step."""
    tracks: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Parameters that change along the clip, (frames, ...) by dotted name."""
    given_frames: jaxik.Frame | None = None
    """The clip as the pipeline's input, where that does not follow from the clip alone."""
    captured: Clip | None = None
    """The motion over this terrain from which the flat animation was made, where it is known."""
    files: AnimationFiles | None = None
    """From which it was read, if it was."""

    @cached_property
    def frames(self) -> jaxik.Frame:
        """The clip as the pipeline's input."""
        if self.given_frames is not None:
            return self.given_frames
        stride_scale = None if self.speed == 1.0 else self.speed
        frames = frames_from_clip(
            self.clip, floor=self.floor, rise=self.root.rise, stride_scale=stride_scale
        )
        if stride_scale is None:
            frames = with_cut_off_swings(frames, self.clip, self.terrain)
        return frames if self.carried is None else carried_frames(frames, self.carried)

    @cached_property
    def placed_clip(self) -> Clip:
        """The clip with its root where foot IK gets it."""
        return raised(self.clip, self.root.rise)

    def check_shapes(self, ik: jaxik.FootIK) -> None:
        """Raises ValueError if a parameter of the system has too many values for the rig."""
        parameter_tree.check_shapes(ik, len(self.clip.rig.side))

    def solve(self, ik: jaxik.FootIK) -> tuple[jaxik.Result, Clip]:
        """The result of a system, and the clip as the system leaves it.

        Where the clip's root follows the ground, a root rule of the system is off.

        Raises:
            ValueError: the poses are not finite.
        """
        if self.root.rise is not None:
            ik = systems.without_own_root(ik)
        terrain = ik.probe.prepare(self.terrain)
        terrain = terrain if self.carried is None else moving(terrain, 0)
        tracks = {name: jnp.asarray(values) for name, values in self.tracks.items()}
        result = program_cache.run(ik, self.clip.rig, terrain, self.frames, tracks=tracks or None)
        solved = clip_from_result(self.clip, result, floor=self.floor, rise=self.root.rise)
        if not np.isfinite(solved.positions_ws).all():
            raise ValueError("these parameters give poses that are not finite; nothing was written")
        return result, solved

    def reached(self, result: jaxik.Result) -> Float64[np.ndarray, "frames legs"]:
        """Which ankles are where the system wants them, 1 or 0; NaN without ground under the foot.

        A foot may be there with part of its weight: `Result.reached` is about whole ones.
        """
        trace, root = stage_outputs(result), self.frames.world_from_model
        offset_ws = trace.advanced.effector.target_ws - root.pos[:, None]
        target_ms = quat.unrotate(root.rot[:, None], offset_ws)
        distance = vec.length(result.pose.ankle.pos - target_ms)
        near = np.asarray(distance) < NEAR * body.ratio(self.clip.rig)
        grounded = np.asarray(trace.sensed.foothold.found) > 0
        return np.where(grounded, near.astype(np.float64), np.nan)

    def assess(self, solved: Clip) -> tuple[Placement, Cause | None]:
        """How the feet of a solved clip are placed; why, if they are off the ground."""
        _, placed = self.place(solved)
        if not placed.misplaced:
            return placed, None
        animated, files = self.placed_clip, self.files
        unit = 1.0 if files is None else files.terrain_options.scale or 1.0
        soles = self._soles(animated)
        return placed, likely_cause(soles, animated, unit=unit, trial=self._soles_without)

    def _soles_without(self, cause: Cause) -> Soles | None:
        """The soles of the animation after the remedy for a cause; None where that is no remedy."""
        try:
            if cause.kind == "root" and self.root.rise is None:
                _, choice = place_root(self.clip, self.terrain, "ground", self.floor)
                return self._soles(raised(self.clip, choice.rise))
            if cause.kind == "units" and self.files is not None:
                terrain = self.files.load_terrain_in(cause.amount)
                return placement.soles(self.placed_clip, self._own_speed, terrain, self.floor)
        except ValueError:  # no ground below the path, or a terrain beyond all bounds
            pass
        return None

    def place(self, solved: Clip) -> tuple[Soles, Placement]:
        """The soles of a solved clip over the ground, and how its feet are placed."""
        soles = self._soles(solved)
        return soles, placement.assess(soles, solved, self.placed_clip, own_speed=self._own_speed)

    @property
    def _own_speed(self) -> Clip:
        """The animation at its own speed, by which soles and slides are judged.

        With a faster root its standing feet skate, which is to be measured and not to be excused.
        """
        return at_speed(self.clip, 1.0 / self.speed)

    def _soles(self, solved: Clip) -> Soles:
        return placement.soles(solved, self._own_speed, self.terrain, self.floor)


def load_animation(files: AnimationFiles, *, to_fit: bool = False) -> Animation:
    """Reads a flat animation and its terrain, and chooses where to put the root.

    Warns where there is little ground under the feet.

    Args:
        files: where they are.
        to_fit: whether hardly any ground is an error instead, as it is for a root that follows it.

    Raises:
        ValueError: a file does not exist or cannot be read, or the root cannot be put there.
    """
    with activity.announced(f"Reading {files.clip.name} and {files.terrain.name}"):
        terrain = files.load_terrain()
        clip = files.flat_clip
        covered = files.coverage(terrain)
    if (to_fit or files.root == "ground") and covered.share < coverage.LITTLE:
        raise ValueError(covered.text())
    coverage.warn(covered)
    if files.speed != 1.0:
        clip = at_speed(clip, files.speed)
    placed, root = place_root(clip, terrain, files.root, files.floor)
    # Where the clip follows this terrain, its ground has been taken out.
    clip = with_remark_if_uneven(clip) if placed is clip else placed
    captured = _captured(files, placed)
    clip, tracks = track_files.along(clip, files.tracks)
    return Animation(
        clip, terrain, files.floor, root, speed=files.speed, tracks=tracks, captured=captured,
        files=files,
    )  # fmt: skip


def _captured(files: AnimationFiles, placed: Clip) -> Clip | None:
    """The captured motion of an animation, where the file of the clip has it.

    A file of the blocks benchmark does, and so does a clip that follows the terrain, from which the
    ground was taken out. At another speed neither goes where it was captured.
    """
    if files.speed != 1.0:
        return None
    if is_blocks_file(files.clip):
        return load_clip(files.clip)
    return None if placed is files.flat_clip else files.flat_clip


def carried_frames(frames: jaxik.Frame, carried: Float64[np.ndarray, "frames 3"]) -> jaxik.Frame:
    """The frames of a character on a vehicle, which is platform 0 and only shifts.

    Args:
        frames: in the vehicle's space.
        carried: how far the vehicle has moved in each frame, m.
    """
    offsets = jnp.asarray(carried, frames.dt.dtype)
    upright = jnp.zeros((len(carried), 1, 4), frames.dt.dtype).at[..., 0].set(1.0)
    stride = replace(
        frames.stride,
        last_ws=frames.stride.last_ws + offsets[:, None],
        next_ws=frames.stride.next_ws + offsets[:, None],
    )
    moved = replace(frames.translated(offsets), stride=stride)
    return moved.with_platforms(jaxik.Transform(offsets[:, None], upright))
