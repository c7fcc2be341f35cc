"""A flat animation on a terrain, and what a system makes of it.

How much the motion of a system depends on the frame rate at which it runs.

Of an animation every second, third or so frame is played, as in a game that draws fewer frames, and
the motion is compared with that of all frames where both have one. What the animation says of
itself, its strides, contact labels and speeds, stays as it is at the animation's own rate: a game
keeps it with the asset.
"""

import dataclasses
import json
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

import jaxik
from fitting.clips import Clip, load_clip
from fitting.clips.clip_frames import clip_from_result, frames_from_clip, positions_by_role, raised
from fitting.clips.edit import at_speed
from fitting.clips.formats.npz import holds_base
from fitting.clips.joint_maps import find_trunk
from fitting.clips.load import ClipOptions
from fitting.experiment import systems, track_files
from fitting.ground import coverage
from fitting.ground.coverage import Coverage
from fitting.ground.ground_path import AS_ANIMATED, RootChoice, place_root
from fitting.ground.meshes import TerrainOptions, load_terrain
from fitting.motion import measures
from fitting.motion.flat_animation import (
    load_flat_animation,
    with_cut_off_swings,
    with_remark_if_uneven,
)
from fitting.motion.measures import (
    MISSING_LIMIT,
    POP_LIMIT,
    SLIDE_LIMIT,
    Cause,
    Extreme,
    Placement,
    Soles,
    likely_cause,
)
from fitting.motion.playback import stage_outputs
from fitting.report.formatting import Table, aligned, percent
from fitting.runtime import activity, program_cache
from fitting.runtime.precision import in_float64
from fitting.runtime.validation import error_context
from jaxik.maths import parameter_tree, quat, vec
from jaxik.world import body
from jaxik.world.terrain import Terrain, moving

NEAR = 0.005  # m, of an adult: a target that the ankle misses by less is reached


JOINTS = ("pelvis", "knee", "ankle", "ball")


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
    """What changes along the clip; see `experiment.track_files`."""
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
                return measures.soles(self.placed_clip, self._own_speed, terrain, self.floor)
        except ValueError:  # no ground below the path, or a terrain beyond all bounds
            pass
        return None

    def place(self, solved: Clip) -> tuple[Soles, Placement]:
        """The soles of a solved clip over the ground, and how its feet are placed."""
        soles = self._soles(solved)
        return soles, measures.assess(soles, solved, self.placed_clip, own_speed=self._own_speed)

    @property
    def _own_speed(self) -> Clip:
        """The animation at its own speed, by which soles and slides are judged.

        With a faster root its standing feet skate, which is to be measured and not to be excused.
        """
        return at_speed(self.clip, 1.0 / self.speed)

    def _soles(self, solved: Clip) -> Soles:
        return measures.soles(solved, self._own_speed, self.terrain, self.floor)


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

    It may hold both motions, or a clip that follows the terrain, from which the ground was taken
    out. At another speed neither goes where it was captured.
    """
    if files.speed != 1.0:
        return None
    if holds_base(files.clip):
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
) -> list[RateDifference]:
    """The differences of all systems at all rates, system by system.

    Args:
        systems: by name.
        animation: at the rate to which the others are compared.
        rates: Hz, of which whole multiples are the animation's.

    Raises:
        ValueError: for another rate, or a system that does not fit the animation.
    """
    steps = [_step(animation.clip.fps, fps) for fps in rates]
    differences = []
    for name, ik in systems.items():
        if not steps:
            break
        with error_context(name), activity.announced(f"Compiling and running {name}"):
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


class PlacementWarning(UserWarning):
    """Feet are visibly off their ground, slide or pop."""


CAUSES = {
    "missing": "the terrain does not lie below the whole path",
    "units": "the terrain is in another unit of length: one of its units is {0:.4g} m "
    "(--terrain-scale {0:.4g})",
    "offset": "all feet are {1:.0f} cm too {2}: check the clip's floor (--floor) and the height of "
    "the terrain (--terrain-offset)",
    "root": "the root stays on the animation's floor where the ground rises (use --root ground)",
    "unknown": "none of missing ground, units, root, floor and offset; look at these frames",
}


def table(placement: Placement) -> Table:
    """What a viewer sees, a row for each kind: how often or how far, and the largest with place."""
    return [
        [f"feet and ground, {_seen(placement)} or more", "frames", "largest"],
        ["standing feet in the ground", _share(placement.sunk), _place(placement.deepest)],
        ["standing feet above the ground", _share(placement.floating), _place(placement.highest)],
        ["moving feet in the ground", _share(placement.sunk_swing), ""],
        ["any foot in the ground", _share(placement.sunk_frames), ""],
        ["no ground under the sole", _share(placement.groundless), ""],
        ["slide in a stance, median", _cm(placement.slide), _place(placement.largest_slide)],
        ["pop in 1/60 s", "", _place(placement.pop)],
    ]


def text(placement: Placement) -> str:
    """The table for a terminal. Slides and pops are those beyond the animation's own."""
    return aligned(table(placement))


def solved_text(
    reached: Float64[np.ndarray, "frames legs"], seconds: float, path: Path | None
) -> str:
    """How long a clip took, how much ground it found and reached, and where it is written.

    Args:
        reached: as `Animation.reached` gives it.
        seconds: which it took.
        path: of the solved clip; None if it was not written.
    """
    found = ~np.isnan(reached)
    share = f"{np.mean(reached[found]):.1%}" if found.any() else "none"
    return (
        f"{len(reached)} frames in {seconds:.1f} s: ground under {np.mean(found):.1%} of "
        f"the feet, {share} of the targets reached"
        + ("" if path is None else f"; written to {path}")
    )


def trunk_text(result: jaxik.Result, clip: Clip) -> str:
    """How far spine and head of the clip lean; "" for a system that does not bend the spine."""
    spine = result.corrections.spine
    if spine is None:
        return ""
    trunk = find_trunk(clip.joint_names, clip.parents, clip.rig.pelvis)
    angle = np.degrees(2.0 * np.arctan2(np.linalg.norm(spine[:, 1:], axis=1), np.abs(spine[:, 0])))
    text = f"spine: leans by up to {angle.max():.1f}°"
    if trunk.spine is None:
        return f"{text}, not applied: the clip has no spine joint between pelvis and head"
    text += f", applied to {clip.joint_names[trunk.spine]}"
    if trunk.head is None:
        return f"{text}; the clip has no joint named head that turns back"
    return f"{text}; {clip.joint_names[trunk.head]} turns back"


def arrays(solved: Clip, placement: Placement) -> dict[str, np.ndarray]:
    """What is written beside a solved clip: positions by role, and `placement` as JSON."""
    described = np.array(json.dumps(numbers(placement)))
    return positions_by_role(solved) | {"placement": described}


def numbers(placement: Placement) -> dict[str, Any]:
    """The placement as JSON holds it: m and fractions of 1, null for NaN."""
    return _without_nan(asdict(placement))


def warn(placement: Placement, cause: Cause | None, name: str = "") -> None:
    """Warns of all that is beyond its limit; see `warning_texts`. The name precedes each text."""
    for text in warning_texts(placement, cause):
        text = f"{name}: {text}" if name else text
        warnings.warn(text, PlacementWarning, stacklevel=3)


def warning_texts(placement: Placement, cause: Cause | None) -> list[str]:
    """What is beyond its limit, a sentence for each.

    Args:
        placement: of a motion.
        cause: of feet off their ground; None where they are not.
    """
    texts = []
    if cause is not None:
        amount = cause.amount
        reason = CAUSES[cause.kind].format(
            amount, abs(100 * amount), "high" if amount > 0 else "low"
        )
        texts.append(f"{_off_ground(placement)}; likely cause: {reason}")
    elif math.isnan(placement.sunk):
        texts.append("no foot of the animation ever stands; see its contacts with `jaxik inspect`")
    if placement.slide > SLIDE_LIMIT * placement.size:
        texts.append(
            f"standing feet slide by {_cm(placement.slide)} a stance more than animated (most: "
            f"{_place(placement.largest_slide)})"
        )
    if placement.pop.value > POP_LIMIT * placement.size:
        texts.append(f"feet pop in 1/60 s (most: {_place(placement.pop)})")
    return texts


def _off_ground(placement: Placement) -> str:
    if placement.groundless > MISSING_LIMIT:
        return f"there is no ground under {_share(placement.groundless)} of the soles"
    return (
        f"standing feet are {_seen(placement)} or more in the ground in {_share(placement.sunk)} "
        f"of their frames (deepest: {_place(placement.deepest)}) and above it in "
        f"{_share(placement.floating)} (highest: {_place(placement.highest)})"
    )


def _seen(placement: Placement) -> str:
    return f"{100 * placement.visible:.2g} cm"


def _share(fraction: float) -> str:
    return "–" if math.isnan(fraction) else percent(fraction)


def _cm(length: float) -> str:
    return "–" if math.isnan(length) else f"{100 * length:z.1f} cm"


def _place(extreme: Extreme) -> str:
    if math.isnan(extreme.value):
        return "–"
    return f"{_cm(extreme.value)}, {extreme.leg}, frame {extreme.frame}"


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(entry) for key, entry in value.items()}
    return None if isinstance(value, float) and math.isnan(value) else value
