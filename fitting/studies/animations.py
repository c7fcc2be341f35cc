"""A flat animation on a terrain, and its motion by a system.

How much the motion of a system depends on the frame rate at which it runs.

Of an animation every second, third or so frame is played, as in a game that draws fewer frames, and
the motion is compared with that of all frames where both have one. What the animation says of
itself, its strides, contact labels and speeds, stays as it is at the animation's own rate: a game
stores it with the asset.
"""

import dataclasses
import json
import math
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float64

import jaxik
from fitting.clips import Clip, flight, load_clip, save_clip
from fitting.clips.clip_frames import clip_from_result, frames_from_clip, positions_by_role, raised
from fitting.clips.edit import at_speed, in_direction
from fitting.clips.formats.npz import holds_base
from fitting.clips.formats.saving import check_clip_file
from fitting.clips.joint_maps import Trunk, find_trunk
from fitting.clips.load import ClipOptions
from fitting.experiment import systems, track_files
from fitting.experiment.problems import ClipData
from fitting.ground import coverage, meshes
from fitting.ground.ground_path import AS_ANIMATED, Root, RootChoice, place_root
from fitting.ground.meshes import TerrainOptions, mesh_of
from fitting.motion import accuracy, measures
from fitting.motion.flat_animation import (
    flatten_clip,
    load_flat_animation,
    with_cut_off_swings,
    with_remark_if_uneven,
)
from fitting.motion.playback import stage_outputs
from fitting.report.formatting import aligned, figures_table, joined
from fitting.runtime import activity, program_cache
from fitting.runtime.precision import in_float64, with_floats
from fitting.runtime.validation import error_context
from jaxik.maths import parameter_tree, quat, vec
from jaxik.stages.probe import AbstractLimitedProbe, StrideProbe
from jaxik.world import body
from jaxik.world.terrain import Terrain, moving

from .fit import run_folder

# Of ground that a probe accepts, and by how much `_binding_limit` raises one until feet stand.
LIMITS_OF_GROUND = ("probe.max_step_up", "probe.max_step_down", "probe.max_slope")
RAISED = (1.25, 1.5, 2.0, 3.0)
BEFORE_POP = 0.2  # s, in which a foot that pops out of a step met it
UNMOVED = 1e-3  # m, from the animated ankle: a foot that foot IK leaves alone
NEAR = 0.005  # m, of an adult: a target that the ankle misses by less is reached


JOINTS = ("pelvis", "knee", "ankle", "ball")


@dataclass(frozen=True)
class AnimationFiles:
    """Where a flat animation and a terrain are read from."""

    clip: Path
    terrain: Path
    floor: float = 0.0
    """m, height of the floor on which the clip was animated."""
    root: Root = "auto"
    """Where the root is put; see `place_root`."""
    speed: float = 1.0
    """Of the root, as a multiple of the clip's; strides are scaled alike."""
    tracks: Path | None = None
    """What changes along the clip; see `experiment.track_files`."""
    clip_options: ClipOptions = ClipOptions()
    """How the clip is read."""
    terrain_options: TerrainOptions = TerrainOptions()
    """How the terrain is read."""
    direction: float = 0.0
    """rad, by which the root's way turns to the left of the clip's; feet are turned alike."""

    @cached_property
    def flat_clip(self) -> Clip:
        """The flat animation of the file."""
        with activity.announced(f"Reading {self.clip.name}"):
            return load_flat_animation(self.clip, self.floor, self.clip_options)

    def load_terrain(self, options: TerrainOptions | None = None) -> Terrain:
        """The terrain of the file, read by other options if any are given."""
        return (options or self.terrain_options).load(self.terrain)


@dataclass(frozen=True)
class Animation:
    """A flat animation on a terrain."""

    clip: Clip
    """On its floor, with bones of the rig's lengths, as `load_flat_animation` gives it."""
    terrain: Terrain
    floor: float = 0.0
    """m, height of the floor on which the clip was animated."""
    root: RootChoice = AS_ANIMATED
    is_synthetic: bool = False
    """Whether it has no noise, unlike a capture."""
    carried: Float64[np.ndarray, "frames 3"] | None = None
    """m, how far a vehicle has carried terrain and character; clips are in the vehicle's space."""
    speed: float = 1.0
    """Speed of the clip's root, as a multiple of that with which its feet step."""
    direction: float = 0.0
    """rad, of the way of the clip's root, to the left of that in which its feet step."""
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
        frames = frames_from_clip(
            self.clip,
            floor=self.floor,
            rise=self.root.rise,
            stride_scale=None if self.speed == 1.0 else self.speed,
            orientation=None if self.direction == 0.0 else self.direction,
        )
        if not has_other_path(self):
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
        terrain = self.terrain if self.carried is None else moving(self.terrain, 0)
        result = replace(self, terrain=terrain, given_frames=self.frames).run(ik)
        return result, clip_from_result(self.clip, result, floor=self.floor, rise=self.root.rise)

    def run(self, ik: jaxik.FootIK) -> jaxik.Result:
        """The result of a system on the terrain; NumPy arrays."""
        rig, terrain, frames, tracks = self._inputs
        result = program_cache.run(ik, rig, terrain, frames, tracks=tracks or None)
        count = len(self.frames.dt)
        return jax.tree.map(lambda x: x[:count], result)

    @cached_property
    def _inputs(self) -> tuple[jaxik.Rig, Terrain, jaxik.Frame, dict[str, Array]]:
        """What does not depend on the system; frames and tracks as long as they are played."""
        padded = program_cache.padded_frames((self.frames, dict(self.tracks)))
        return program_cache.committed((self.clip.rig, self.terrain, *padded))

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

    @cached_property
    def bounds(self) -> dict[str, float]:
        """The bounds of its motions, by measure; see `measures.bounds`."""
        animated = self.placed_clip
        bounds = measures.bounds(animated, self.soles(animated))
        return (
            bounds
            if self.is_synthetic
            else {k: v for k, v in bounds.items() if k not in measures.NOISY}
        )

    def place(self, solved: Clip, result: jaxik.Result | None = None) -> measures.PlacedMotion:
        """A motion on the ground, and what is measured of it.

        Args:
            solved: the motion.
            result: of the system that made it; None leaves unknown which targets are reached.
        """
        reached = None if result is None else self.reached(result)
        animated = self.placed_clip if result is None else self._warped(result)
        return measures.place(solved, animated, self.own_speed, self.terrain, self.floor, reached)

    def _warped(self, result: jaxik.Result) -> Clip:
        """The placed clip with its ankles where another speed or direction takes them."""
        clip = self.placed_clip
        if not has_other_path(self) or self.carried is not None:
            return clip
        sensed, positions_ws = stage_outputs(result).sensed, clip.positions_ws.copy()
        ankles = [joints[2] for joints in clip.rig.joints]
        positions_ws[:, ankles] = sensed.ankle_ws - np.asarray(sensed.root_ws)[:, None]
        return clip.with_motion(positions_ws, clip.rotations_ws)

    def cause(
        self, motion: measures.PlacedMotion, ik: jaxik.FootIK | None = None
    ) -> measures.Cause | None:
        """Why the feet of a motion are off their ground, or else pop; None where neither is known.

        Args:
            motion: on this terrain.
            ik: the system that made it, if one did.
        """
        if not motion.measures.misplaced:
            return None if ik is None else self._late(motion, ik)
        animated, files = self.placed_clip, self.files
        unit = 1.0 if files is None else files.terrain_options.terrain_scale or 1.0
        soles = self.soles(animated)
        cause = measures.likely_cause(soles, animated, unit=unit, trial=self._soles_without)
        if cause.kind == "unknown":
            cause = self._off_own_floor(motion) or cause
        if cause.kind == "unknown" and ik is not None:
            return self._binding_limit(motion, ik) or self._off(motion) or cause
        return cause

    def _off_own_floor(self, motion: measures.PlacedMotion) -> measures.Cause | None:
        """That most of the feet that stand off the ground are off the clip's own floor alike."""
        gap, off = motion.soles.gap, motion.stands_off
        own = measures.sole_points(self.clip)[..., 1].min(axis=-1) - self.floor
        kept = off & (np.abs(own - gap) < 0.5 * np.abs(gap))
        if kept.sum() <= 0.5 * off.sum():
            return None
        return measures.Cause("clip", float(np.abs(own[kept]).max()))

    def _late(self, motion: measures.PlacedMotion, ik: jaxik.FootIK) -> measures.Cause | None:
        """That a foot pops out of a step that it met inside, where the system does not look ahead.

        Its rays go down under the foot: at a wall they meet the top once the foot is in it.
        """
        measured, (_, frame, leg) = motion.measures, motion.measures.worst["pop"]
        if isinstance(ik.probe, StrideProbe) or not measured.pop > self.bounds["pop"]:
            return None
        first = max(0, frame - round(BEFORE_POP * motion.clip.fps))
        legs = [leg in (name, measures.PELVIS) for name in motion.clip.rig.names]
        before = slice(first, frame + 1), legs
        rise = np.nanmax(np.diff(motion.soles.ground[before], axis=0), initial=0.0)
        depth = float(np.nanmax(-motion.soles.gap[before], initial=0.0))
        return measures.Cause("late", depth) if min(rise, depth) > measured.visible else None

    def _off(self, motion: measures.PlacedMotion) -> measures.Cause | None:
        """That a system has left most of the feet that stand off the ground as animated."""
        off = motion.stands_off
        moved = motion.clip.joints_ws(2) - self.placed_clip.joints_ws(2)
        unmoved = off & (np.linalg.norm(moved, axis=-1) < UNMOVED)
        share = float(unmoved.sum() / max(int(off.sum()), 1))
        return measures.Cause("off", share) if share > 0.5 else None

    def _binding_limit(
        self, motion: measures.PlacedMotion, ik: jaxik.FootIK
    ) -> measures.Cause | None:
        """The limit of a system that refuses ground on which feet would stand, if one does."""
        if not (isinstance(ik.probe, AbstractLimitedProbe) and ik.probe.limited):
            return None

        def with_limit(name: str, factor: float) -> jaxik.FootIK:
            return parameter_tree.replace(ik, {name: factor * parameter_tree.get(ik, name)})

        def helps(name: str, factor: float) -> bool:
            try:
                _, solved = self.solve(with_limit(name, factor))  # by the same program
            except ValueError:  # poses that are not finite
                return False
            return measures.is_much_closer(self.soles(solved), motion.soles)

        for name in LIMITS_OF_GROUND:
            if helps(name, RAISED[-1]):
                factor = next(factor for factor in RAISED if helps(name, factor))
                accepting = parameter_tree.shown(with_limit(name, factor), name)
                return measures.Cause(
                    "limit", limit=(name, parameter_tree.shown(ik, name), accepting)
                )
        return None

    def _soles_without(self, cause: measures.Cause) -> measures.Soles | None:
        """The soles of the animation after the remedy for a cause; None where there is none."""
        try:
            if cause.kind == "root" and self.root.rise is None:
                _, choice = place_root(self.clip, self.terrain, "ground", self.floor)
                return self.soles(raised(self.clip, choice.rise))
            if cause.kind == "units" and self.files is not None:
                options = replace(self.files.terrain_options, terrain_scale=cause.amount)
                terrain = self.files.load_terrain(options)
                return measures.soles(self.placed_clip, self.own_speed, terrain, self.floor)
        except ValueError:  # no ground below the path, or a terrain beyond all bounds
            pass
        return None

    @cached_property
    def own_speed(self) -> Clip:
        """The animation at its own speed and in its own direction, which soles are judged by.

        With another root its standing feet skate, and measures must show that.
        """
        return at_speed(in_direction(self.clip, -self.direction), 1.0 / self.speed)

    def soles(self, solved: Clip) -> measures.Soles:
        """The soles of a motion over the ground."""
        return measures.soles(solved, self.own_speed, self.terrain, self.floor)


def capture_errors(
    ik: jaxik.FootIK, data: ClipData, size: float | None, frames: slice = slice(None)
) -> accuracy.Errors:
    """Errors of a system on a clip of an experiment, in these frames, at the clip's own rate.

    Args:
        ik: the system, for the body that the experiment's numbers are for.
        data: the clip, at its own rate.
        size: of its body; see `Experiment.size`.
        frames: that count; all are played.

    Raises:
        ValueError: a parameter has too many values for the rig, or the poses are not finite.
    """
    animation = Animation(data.base, data.terrain, root=data.root, tracks=data.tracks)
    animation.check_shapes(ik)
    _, solved = animation.solve(ik if size is None else body.similar(ik, size))
    compared = (solved, data.reference, animation.placed_clip)
    return accuracy.clip_errors(*(clip.select(frames) for clip in compared))


def has_other_path(animation: AnimationFiles | Animation) -> bool:
    """Whether the root goes faster, slower or elsewhere than in the clip's file."""
    return animation.speed != 1.0 or animation.direction != 0.0


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
        covered = coverage.measure(clip, terrain, files.terrain_options, reload=files.load_terrain)
    if (to_fit or files.root == "ground") and covered.share < coverage.LITTLE:
        raise ValueError(covered.text())
    coverage.warn(covered)
    if has_other_path(files):
        clip = in_direction(at_speed(clip, files.speed), files.direction)
    placed, root = place_root(clip, terrain, files.root, files.floor)
    floor, follows = files.floor, placed is not clip
    if follows:
        heights, normals = meshes.height_function(terrain), meshes.normal_function(terrain)
        clip, floor = flatten_clip(clip, heights, normal_under=normals), 0.0
        clip, root = place_root(clip, terrain, files.root)
        taken_out = "the ground was taken out of the clip, which follows it"
        root = replace(root, reason=f"{root.reason}; {taken_out}")
    else:
        clip = with_remark_if_uneven(clip)
    captured = _captured(files, follows)
    clip, tracks = track_files.along(clip, files.tracks)
    return Animation(
        clip, terrain, floor, root, speed=files.speed, direction=files.direction,
        tracks=tracks, captured=captured, files=files,
    )  # fmt: skip


def _captured(files: AnimationFiles, follows: bool) -> Clip | None:
    """The captured motion of an animation, where the file of the clip has it.

    It may hold both motions, or a clip that follows the terrain. On another path, neither has the
    captured one.
    """
    if has_other_path(files):
        return None
    if holds_base(files.clip):
        return load_clip(files.clip)
    return files.flat_clip if follows else None


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
    """m, of each of `JOINTS`."""


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
    """The animation with every `step`-th frame only."""
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
    """What a viewer sees of a motion on its ground is beyond a bound."""


def trunk_text(result: jaxik.Result, clip: Clip) -> str:
    """How far spine and head of the clip lean, and the spine twists; "" where neither happens."""
    trunk = find_trunk(clip.joint_names, clip.parents, clip.rig.pelvis)
    twist = _twist_text(result, clip, trunk)
    return "; ".join(filter(None, (_lean_text(result, clip, trunk), twist)))


def _twist_text(result: jaxik.Result, clip: Clip, trunk: Trunk) -> str:
    twist = result.corrections.twist
    if twist is None:
        return ""
    text = f"spine: twists by up to {_largest_angle(twist):.1f}° against the pelvis"
    if not trunk.twisted:
        return f"{text}, not applied: the clip has no spine joint between pelvis and head"
    return f"{text}, shared by {', '.join(clip.joint_names[joint] for joint in trunk.twisted)}"


def _lean_text(result: jaxik.Result, clip: Clip, trunk: Trunk) -> str:
    spine = result.corrections.spine
    if spine is None:
        return ""
    text = f"spine: leans by up to {_largest_angle(spine):.1f}°"
    if trunk.spine is None:
        return f"{text}, not applied: the clip has no spine joint between pelvis and head"
    text += f", applied to {clip.joint_names[trunk.spine]}"
    if trunk.head is None:
        return f"{text}; the clip has no joint named head that turns back"
    return f"{text}; {clip.joint_names[trunk.head]} turns back"


def _largest_angle(rots: Array | np.ndarray) -> float:
    """The angle of the largest of these rotations, degrees."""
    rots = np.asarray(rots)
    sines, cosines = np.linalg.norm(rots[:, 1:], axis=1), np.abs(rots[:, 0])
    return float(np.degrees(2.0 * np.arctan2(sines, cosines)).max())


def arrays(motion: measures.PlacedMotion, animated: Clip) -> dict[str, np.ndarray]:
    """The arrays beside a solved clip in its file.

    They are positions by role; `contact`, (frames, legs), 1 where the foot of the animation stands;
    and `placement` as JSON.
    """
    described = np.array(json.dumps(motion.measures.numbers()))
    contact = animated.stance_labels().astype(np.float64)
    return positions_by_role(motion.clip) | {"contact": contact, "placement": described}


def warn(
    measured: measures.Measures,
    bounds: Mapping[str, float],
    cause: measures.Cause | None,
    name: str = "",
) -> None:
    """Warns of all that is beyond its bound; see `warning_texts`. The name precedes each text."""
    for text in warning_texts(measured, bounds, cause):
        text = f"{name}: {text}" if name else text
        warnings.warn(text, PlacementWarning, stacklevel=3)


def warning_texts(
    measured: measures.Measures, bounds: Mapping[str, float], cause: measures.Cause | None
) -> list[str]:
    """What is beyond its bound, a sentence for each, the worst first.

    Args:
        measured: of a motion.
        bounds: by measure.
        cause: of feet off their ground, or of the pop; None where neither is known.
    """
    texts = [bounded.words for bounded in measured.against(bounds) if bounded.is_beyond]
    if cause is not None:
        texts.append(cause.sentence)
    elif math.isnan(measured.contact):
        texts.append("no foot of the animation ever stands; see its contacts with `jaxik inspect`")
    return texts


@in_float64
def apply(
    run: str | Path,
    animation: AnimationFiles,
    output: str | Path | None = None,
    *,
    with_terrain: bool = False,
) -> Clip:
    """Solves a flat animation with the fitted system of a run; see `solve`.

    Raises:
        ValueError: as `solve`, or the folder holds no finished fit.
    """
    ik = run_folder.load_fitted_system(Path(run), animation.flat_clip.rig)
    return solve(ik, animation, output, with_terrain=with_terrain)


@in_float64
def solve(
    ik: jaxik.FootIK | None,
    animation: AnimationFiles,
    output: str | Path | None = None,
    *,
    with_terrain: bool = False,
) -> Clip:
    """Solves a flat animation, and measures how its feet are placed on the ground.

    Where a captured motion is known, the log also shows the difference. What is beyond its bound is
    a warning, with the most likely cause of feet off the ground.

    Args:
        ik: the system; None is the preset that serves the clip best.
        animation: the clip, the terrain, and where the root is put.
        output: .npz, .bvh, .glb or .csv file for the solved clip; see `save_clip`.
        with_terrain: whether a .glb gets the terrain beside the skeleton.

    Raises:
        ValueError: a file cannot be read or written, or the system does not fit the clip or gives
            poses that are not finite.
    """
    path = None if output is None else Path(output)
    if path is not None:
        check_clip_file(path, with_ground=with_terrain)
        if path.exists() and path.samefile(animation.clip):
            raise ValueError(f"{path}: is the clip that is read; name another file")
    loaded = load_animation(animation)
    if path is not None:
        check_clip_file(path, loaded.clip)
    ik = ik or systems.choose_preset([loaded.clip]).system(loaded.clip.rig)
    ik = with_floats(ik, np.float64)
    loaded.check_shapes(ik)
    began = time.perf_counter()
    with activity.announced("Compiling and running the system"):
        result, solved = loaded.solve(ik)
    seconds = time.perf_counter() - began
    with activity.announced("Measuring how the feet are placed"):
        motion = loaded.place(solved, result)
        cause = loaded.cause(motion, ik)
    if path is not None:
        joints = arrays(motion, loaded.clip)
        ground = mesh_of(loaded.terrain) if with_terrain else None
        save_clip(path, solved, joints=joints, ground=ground)
    written = "" if path is None else f"; written to {path}"
    activity.log(f"{solved.frame_count} frames in {seconds:.1f} s{written}")
    where = [
        f"root: {loaded.root.reason}",
        flight.describe(loaded.clip),
        trunk_text(result, solved),
        *(f"note: {remark}" for remark in loaded.clip.remarks),
    ]
    table = figures_table("feet on the ground", {"solved": motion.measures})
    activity.log(joined([*filter(None, where), "", aligned(table)]))
    if loaded.captured is not None:
        errors = accuracy.clip_errors(solved, loaded.captured, loaded.placed_clip)
        accuracies = {"solved": accuracy.summarise([errors])}
        table = figures_table("difference from the captured motion", accuracies)
        activity.log(joined(["", aligned(table)]))
    warn(motion.measures, loaded.bounds, cause)
    return solved
