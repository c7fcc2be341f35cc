"""From an experiment to the problem that is minimised: loads clips, makes flat animations, checks.

A clip's reference, flat animation and terrain are cut and resampled alike, so that frame by frame
they belong together.
"""

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool

import jaxik
from fitting.clips import Clip, edit, flight, load_clip
from fitting.clips.clip_frames import frames_from_clip, raised
from fitting.clips.stances import left_out_frames
from fitting.ground import coverage, meshes
from fitting.ground.ground_path import AS_ANIMATED, RootChoice, place_root
from fitting.ground.meshes import TerrainOptions
from fitting.motion import flat_animation
from fitting.problem.capture_system import alone
from fitting.problem.problem import Problem
from fitting.problem.residuals import residuals_of_scenes
from fitting.problem.scene import WHITENED, Reference, Scene, Sigmas
from fitting.problem.shared_world import share_world
from fitting.runtime import activity, program_cache
from fitting.runtime.precision import in_float64, with_floats
from fitting.runtime.validation import error_context, read_toml
from jaxik.maths import parameter_tree
from jaxik.world.skeleton import Transform
from jaxik.world.terrain import Terrain

from . import file_tables, track_files
from .experiment import DEFAULT_SIGMAS, ClipEntry, Experiment
from .systems import read_parameters, with_parameters, without_own_root

SHORTEST_WITH_HOLDOUT = 3.0  # s: of a shorter clip, hardly a stride would be left to fit


class ClipData(NamedTuple):
    """The files of an entry of an experiment, over the same frames."""

    reference: Clip
    base: Clip
    """The flat animation."""
    terrain: Terrain
    root: RootChoice = AS_ANIMATED
    tracks: Mapping[str, np.ndarray] = MappingProxyType({})
    """Parameters that change along the base, (frames, ...) by dotted name."""


class LoadedExperiment(NamedTuple):
    """An experiment with all that its files hold."""

    experiment: Experiment
    clips: tuple[ClipData, ...]
    problem: Problem[jaxik.FootIK]
    known_values: Mapping[str, float] | None
    """The parameters of a synthetic reference, by dotted name."""


@in_float64
def load(experiment: Experiment) -> LoadedExperiment:
    """Loads the clips of an experiment, builds its problem, and reads which values are known.

    Raises:
        ValueError: something in the experiment does not fit its clips or its preset.
    """
    clips = load_clips(experiment)
    problem = problem_from_clips(experiment, clips)
    known_values = load_known_values(experiment, alone(problem.space.system))
    return LoadedExperiment(experiment, clips, problem, known_values)


def make_problem(experiment: Experiment) -> Problem[jaxik.FootIK]:
    """The problem of an experiment; as `load`."""
    return load(experiment).problem


@in_float64
def load_clips(experiment: Experiment) -> tuple[ClipData, ...]:
    """Loads the clips of an experiment, in the order of its entries.

    Raises:
        ValueError: a file cannot be read, or does not fit the others of its clip.
    """
    if experiment.has_points:
        adult = experiment.body == "adult"
        experiment.check_points(None if adult else _load_rig(experiment.clips[0]))
    data = []
    count = len(experiment.clips)
    title = "Reading the clip and its ground" if count == 1 else f"Reading {count} clips"
    with activity.announced(title, count) as reading:
        for entry in experiment.placed_clips():
            data.append(load_clip_data(entry, experiment.fps))
            reading.advance()
    return tuple(data)


def remarks(clips: Iterable[ClipData]) -> Iterator[str]:
    """Lines on each clip: where its root is, jumps, guesses and oddities."""
    for clip in clips:
        yield f"root of {clip.base.source}: {clip.root.reason}"
        if in_the_air := flight.describe(clip.base):
            yield f"{clip.base.source}: {in_the_air}"
        both = (clip.reference, clip.base)
        notes = dict.fromkeys((file.source, remark) for file in both for remark in file.remarks)
        for source, remark in notes:
            yield f"note on {source}: {remark}"


def problem_from_clips(experiment: Experiment, clips: Iterable[ClipData]) -> Problem[jaxik.FootIK]:
    """The problem of an experiment whose clips are loaded already, in the order of its entries.

    Raises:
        ValueError: as `make_problem`.
    """
    data = list(clips)
    rig = data[0].base.rig
    ik = experiment.starting_system(rig)
    if any(clip.root.rise is not None for clip in data):
        ik = without_own_root(ik)
    space = experiment.space(ik, rig)
    scenes = []
    for clip in data:
        if both := sorted({p.name for p in space.parameters if p.leaf in clip.tracks}):
            raise ValueError(
                f"{experiment.path} [free]: {both} cannot be free: a track of {clip.base.source} "
                "sets it in every frame"
            )
    with activity.announced("Preparing the comparison"):
        for entry, clip in zip(experiment.clips, data, strict=True):
            held_out = _held_out(clip.reference, experiment, entry)
            scene = make_scene(clip, experiment.sigmas, entry.label, held_out)
            if (size := experiment.size(scene.rig, rig)) is not None:
                scene = dataclasses.replace(scene, size=jax.device_put(np.float64(size)))
            with error_context(f"{experiment.path} [parameters]"):
                parameter_tree.check_shapes(ik, len(scene.rig.side))
            scenes.append(scene)
        if experiment.capture:
            scenes = file_tables.prepare(scenes, space, f"{experiment.path} [capture]")
        else:
            scenes = share_world(scenes)
    dt = np.concatenate([np.asarray(scene.frames.dt) for scene in scenes])
    weight = min(1.0, float(dt.mean()) / max(experiment.independent_every, 1e-9))
    problem = Problem(space, tuple(scenes), residuals_of_scenes, experiment.loss, weight)
    return program_cache.committed(problem)


def _load_rig(entry: ClipEntry) -> jaxik.Rig:
    """The body of a clip, on which the ranges of parameters depend."""
    return (_load_reference(entry) if entry.base is None else _load_base(entry.base, entry)).rig


def _load_reference(entry: ClipEntry) -> Clip:
    if entry.loaded is not None:
        return entry.loaded.reference
    return load_clip(entry.reference, **entry.of_file(entry.reference).given)


def _load_base(base: Path, entry: ClipEntry) -> Clip:
    if entry.loaded is not None and entry.loaded.base is not None:
        with error_context(base):
            return flat_animation.as_flat_animation(entry.loaded.base)
    return flat_animation.load_flat_animation(base, options=entry.of_file(base))


def load_clip_data(
    entry: ClipEntry, fps: float | None, *, has_file: bool = True, captured: Clip | None = None
) -> ClipData:
    """Loads one clip of an experiment.

    Warns where there is little ground under the feet.

    Args:
        entry: of the experiment.
        fps: Hz, to which it is resampled; None keeps its rate.
        has_file: whether remedies are spelled as keys of a file, and not as options of a command.
        captured: the reference, where it has been read before.

    Raises:
        ValueError: a file cannot be read, the base does not belong to the reference, or there is
            hardly any ground under the feet.
    """

    def load_ground(options: TerrainOptions) -> Terrain:
        if entry.loaded is not None:
            return with_floats(entry.loaded.terrain, np.float64)
        return options.load(entry.terrain)

    def check_ground(clip: Clip) -> None:
        measured = coverage.measure(clip, terrain, entry, load_ground)
        coverage.require(measured, as_keys=has_file)

    terrain = load_ground(entry)
    if captured is None:
        captured = _load_reference(entry)
    if entry.mask_pops:
        with error_context(entry.reference):
            captured = edit.mask_marker_jumps(
                captured
            )  # before resampling, which would smear a jump
    reference = _cut(captured, entry.reference, entry, fps)
    if entry.base is None:
        check_ground(reference)
        base = flat_animation.flatten_clip(
            reference,
            meshes.height_function(terrain),
            normal_under=meshes.normal_function(terrain),
        )
        base, root = place_root(base, terrain, entry.root)
        base, tracks = track_files.along(base, entry.tracks, entry.start)
        return ClipData(reference, base, terrain, root, tracks)
    base = _cut(_load_base(entry.base, entry), entry.base, entry, fps)
    if _outline(base) != _outline(reference):
        raise ValueError(
            f"{entry.base}: the base has {_outline(base)}; the reference has {_outline(reference)}"
        )
    check_ground(base)
    placed, root = place_root(base, terrain, entry.root)
    base = flat_animation.with_remark_if_uneven(base) if placed is base else placed
    base, tracks = track_files.along(base, entry.tracks, entry.start)
    return ClipData(reference, base, terrain, root, tracks)


def _outline(clip: Clip) -> str:
    return f"{clip.frame_count} frames at {clip.fps:g} Hz of the legs {list(clip.rig.names)}"


def _cut(clip: Clip, path: Path, entry: ClipEntry, fps: float | None) -> Clip:
    with error_context(path):
        clip = edit.trim(clip, entry.start, entry.end)
    return clip if fps is None else edit.resample(clip, fps)


def _held_out(clip: Clip, experiment: Experiment, entry: ClipEntry) -> Bool[np.ndarray, " frames"]:
    """Which frames are held out: all of a clip, or its end if it is long enough."""
    if any(other.held_out for other in experiment.clips):
        return np.full(clip.frame_count, entry.held_out)
    share = experiment.holdout if clip.seconds >= SHORTEST_WITH_HOLDOUT else 0.0
    return np.arange(clip.frame_count) >= round((1 - share) * clip.frame_count)


def make_scene(
    data: ClipData,
    sigmas: Mapping[str, float],
    label: str = "captured",
    held_out: Bool[np.ndarray, " frames"] | None = None,
) -> Scene:
    """One clip as residuals need it, with sigmas that override the defaults.

    The label is that of the reference in plots; frames that are `held_out` are not fitted.
    """
    reference, base, terrain, root, tracks = data
    frames = flat_animation.with_cut_off_swings(
        frames_from_clip(base, rise=root.rise), base, terrain
    )
    placed = raised(base, root.rise)
    legs = reference.leg_pose_ws()
    stance = reference.stance
    labels = np.zeros(legs.ankle.pos.shape[:2]) if stance is None else stance.astype(float)
    observed = reference.observed
    held_out = np.zeros_like(observed) if held_out is None else held_out
    left_out = left_out_frames(reference)
    all_sigmas = DEFAULT_SIGMAS | dict(sigmas)
    if stance is None:
        all_sigmas["contact"] = float("inf")
    return Scene(
        rig=base.rig,
        terrain=terrain,
        frames=frames,
        pelvis=_into(frames.world_from_model, _joint_ws(placed, base.rig.pelvis)),
        reference=Reference(
            pelvis=_joint_ws(reference, reference.rig.pelvis),
            knee_ws=legs.knee.pos,
            ankle=legs.ankle,
            contact=jax.device_put(labels),
            observed=jax.device_put(observed & ~held_out),
            held_out=jax.device_put(observed & held_out),
            label=label,
            left_out=None if left_out is None else jax.device_put(left_out),
        ),
        sigmas=_sigmas(all_sigmas),
        tracks={name: jax.device_put(values) for name, values in tracks.items()},
    )


def _sigmas(values: Mapping[str, float]) -> Sigmas:
    """Sigmas with a correlation for each kind: its own, or else that of all."""
    every = values["correlation"]
    each = [values.get(f"correlation.{kind}", every) for kind in WHITENED]
    sigmas = {
        kind: np.float64(value) for kind, value in values.items() if "correlation" not in kind
    }
    return Sigmas(**jax.device_put(sigmas), correlation=jax.device_put(np.array(each)))


def _joint_ws(clip: Clip, joint: int) -> Transform:
    return Transform(*jax.device_put((clip.positions_ws[:, joint], clip.rotations_ws[:, joint])))


@jax.jit  # without jit this compiles twelve programs instead of one
def _into(space: Transform, joint: Transform) -> Transform:
    return space.inverse() @ joint


def load_known_values(
    experiment: Experiment, ik: jaxik.FootIK | None = None
) -> Mapping[str, float] | None:
    """Known parameters by dotted name, from the first clip that names a truth file.

    Tables in the file that belong to no stage are ignored, and so are switches. A leaf with several
    values has each of them under its name with `[index]`, and their mean under its own name.

    Args:
        experiment: whose clips may name a truth file.
        ik: its system; None makes it.

    Returns:
        The values; None if no clip names a truth file.

    Raises:
        ValueError: the file is not TOML, a name is unknown, a value is not a number.
    """
    path = next((clip.truth for clip in experiment.clips if clip.truth is not None), None)
    if path is None:
        return None
    ik = experiment.preset_system() if ik is None else ik
    content = read_toml(path, "a truth")
    stages = {stage: table for stage, table in content.items() if stage in vars(ik)}
    leaves = read_parameters(stages, ik)
    with_parameters(ik, leaves, str(path))
    known: dict[str, float] = {}
    for name, value in leaves.items():
        if not isinstance(value, bool):
            elements = value if isinstance(value, list) else []
            known |= {f"{name}[{i}]": float(element) for i, element in enumerate(elements)}
            known[name] = float(np.mean(value))
    for name in experiment.free:  # one leg's element of a leaf for which the file has one value
        leaf = name.partition("[")[0]
        if leaf in known:
            known.setdefault(name, known[leaf])
    return known
