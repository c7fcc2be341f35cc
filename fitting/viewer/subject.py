"""What is viewed: clips on their ground, systems to begin with and to go back to, and a cost."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxik
from fitting.datasets.clip_frames import raised
from fitting.datasets.clips import Clip, load_clip
from fitting.datasets.clips.edit import at_speed
from fitting.datasets.clips.formats.npz import is_blocks_file
from fitting.datasets.ground_path import AS_ANIMATED, RootChoice
from fitting.experiments import problems, systems
from fitting.experiments.experiment import Experiment
from fitting.experiments.problems import ClipData
from fitting.experiments.systems import Preset
from fitting.inference.noise.model import NoiseModel, with_noise
from fitting.problem.capture.system import alone, is_of_capture, system_and_scenes
from fitting.problem.free_parameters import FreeParameter
from fitting.problem.problem import Problem
from fitting.problem.residuals import residuals_of_scenes
from fitting.problem.scene import Scene
from fitting.problem.space import Vector
from fitting.runtime.precision import in_float64, with_floats
from fitting.runtime.program_cache import cached
from fitting.studies import run_folder
from fitting.studies.animations import AnimationFiles, load_animation
from fitting.studies.motions.placed_motion import with_soles_of
from jaxik.world.terrain import Terrain

DEFAULT, FITTED, GIVEN = "default", "fitted", "given"  # systems to go back to
Cost = Callable[[jaxik.FootIK], Float[Array, ""]]


@dataclass(frozen=True)
class Take:
    """One clip on its ground."""

    name: str
    base: Clip
    """The flat animation, on its floor."""
    terrain: Terrain
    """As the rays of the system need it."""
    frames: jaxik.Frame
    root: RootChoice = AS_ANIMATED
    floor: float = 0.0
    """m, height of the floor on which the clip was animated."""
    speed: float = 1.0
    """Of the clip's root over that with which its feet step."""
    tracks: Mapping[str, Array] = field(default_factory=dict)
    """Parameters that change along the clip."""
    size: Float[Array, ""] | None = None
    """Of the body over the one that the numbers are for; see `Scene`."""
    captured: Clip | None = None

    @cached_property
    def animated(self) -> Clip:
        """The flat animation with its root where foot IK gets it."""
        return raised(self.base, self.root.rise)

    @cached_property
    def own_speed(self) -> Clip:
        """The flat animation at the speed at which its feet step, whose slides do not count."""
        return self.base if self.speed == 1.0 else at_speed(self.base, 1.0 / self.speed)


@dataclass(frozen=True)
class Subject:
    """What a viewer is about."""

    title: str
    takes: tuple[Take, ...]
    starts: Mapping[str, jaxik.FootIK]
    """The systems to go back to, by name; the first is shown at first."""
    preset: Preset
    """Of which they differ."""
    free: tuple[FreeParameter, ...] = ()
    """What a fit has changed, with the ranges that it was given."""
    leg_length: float | None = None
    """m, of the body that the numbers are for; None if they fit any body as they are."""
    cost: Cost | None = None
    """How far a system's motion is from the captured one; None where there is none."""

    @property
    def rig(self) -> jaxik.Rig:
        """The body on which the ranges of parameters depend."""
        return self.takes[0].base.rig


@cached
def cost_of_problem(problem: Problem[jaxik.FootIK], ik: jaxik.FootIK) -> Float[Array, ""]:
    """What a fit minimises, at a system of which any parameter may differ from the problem's."""
    here = eqx.tree_at(lambda problem: problem.space.system, problem, ik)
    return here.cost(here.space.pack(ik))


@cached
def cost_of_scenes(scenes: tuple[Scene, ...], ik: jaxik.FootIK) -> Float[Array, ""]:
    """Half the sum of a system's squared residuals, without any prior."""
    return 0.5 * jnp.sum(residuals_of_scenes(ik, scenes) ** 2)


@in_float64
def subject_of_run(run: Path) -> Subject:
    """The clips of a run, its fitted system, and the cost of its fit.

    Raises:
        ValueError: the folder holds no finished fit, or its experiment does not fit its clips.
    """
    experiment, summary = run_folder.load_fit(run)
    clips = problems.load_clips(experiment)
    problem = problems.problem_from_clips(experiment, clips)
    if "noise" in summary:
        problem = with_noise(problem, NoiseModel(**summary["noise"]))
    values = {row["name"]: row["u"] for row in summary["parameters"]}
    u = np.array([values[name] for name in problem.space.names])
    subject = subject_of_fit(experiment, problem, clips, u)
    return with_start(subject, FITTED, alone(problem.space.unpack(u)))


@in_float64
def subject_of_fit(
    experiment: Experiment,
    problem: Problem[jaxik.FootIK],
    clips: tuple[ClipData, ...],
    u: Vector | None = None,
) -> Subject:
    """The clips of an experiment, and its system as it is before the fit.

    Args:
        experiment: what is fitted to what.
        problem: of the experiment.
        clips: of the problem.
        u: where the captures are taken from, if they are fitted, too; None takes them as they seem.
    """
    scenes = system_and_scenes(problem, problem.space.pack({}) if u is None else u)[1]
    rig = clips[0].base.rig
    default = with_floats(experiment.preset_system(rig), np.float64)
    if any(clip.root.rise is not None for clip in clips):
        default = systems.without_own_root(default)
    takes = tuple(
        Take(
            name=scene.reference.label if len(clips) == 1 else f"{number}: {clip.base.source}",
            base=clip.base,
            terrain=scene.terrain,
            frames=scene.frames,
            root=clip.root,
            tracks=scene.tracks,
            size=scene.size,
            captured=with_soles_of(clip.reference, clip.base),
        )
        for number, (clip, scene) in enumerate(zip(clips, scenes, strict=True), 1)
    )
    cost = partial(cost_of_problem, problem)
    if experiment.capture:  # then the problem is one of more than a system
        cost = partial(cost_of_scenes, scenes)
    return Subject(
        title=experiment.name,
        takes=takes,
        starts={"before": alone(problem.space.system), DEFAULT: default},
        preset=Preset(experiment.preset, experiment.faithful),
        free=tuple(p for p in problem.space.parameters if not is_of_capture(p.name)),
        leg_length=experiment.leg_length(problem.data[0].rig),
        cost=cost,
    )


@in_float64
def subject_of_animation(
    files: AnimationFiles, preset: Preset, given: jaxik.FootIK | None = None
) -> Subject:
    """A flat animation on a terrain; its cost too, where the file has the captured motion.

    Args:
        files: the clip, the terrain, and where the root is put.
        preset: what the sliders go back to.
        given: the system to begin with; None is the preset.

    Raises:
        ValueError: a file cannot be read, or the system does not fit the clip.
    """
    loaded = load_animation(files)
    names = {DEFAULT: preset.system(loaded.clip.rig)} | ({GIVEN: given} if given else {})
    starts = {name: with_floats(ik, np.float64) for name, ik in reversed(names.items())}
    if loaded.root.rise is not None:
        starts = {name: systems.without_own_root(ik) for name, ik in starts.items()}
    first = next(iter(starts.values()))
    loaded.check_shapes(first)
    terrain = first.probe.prepare(loaded.terrain)
    tracks = {name: jnp.asarray(values) for name, values in loaded.tracks.items()}
    captured = cost = None
    if is_blocks_file(files.clip) and files.speed == 1.0:
        captured = with_soles_of(load_clip(files.clip), loaded.clip)
        if files.floor == 0.0:  # a scene knows no other
            data = ClipData(captured, loaded.clip, terrain, loaded.root, loaded.tracks)
            cost = partial(cost_of_scenes, (problems.make_scene(data, {}),))
    take = Take(
        name=Path(files.clip).name,
        base=loaded.clip,
        terrain=terrain,
        frames=loaded.frames,
        root=loaded.root,
        floor=loaded.floor,
        speed=loaded.speed,
        tracks=tracks,
        captured=captured,
    )
    title = f"{Path(files.clip).name} on {Path(files.terrain).name}"
    return Subject(title, (take,), starts, preset, cost=cost)


def with_start(subject: Subject, name: str, ik: jaxik.FootIK) -> Subject:
    """The subject with one more system to go back to, which is shown at first."""
    return replace(subject, starts={name: ik, **subject.starts})
