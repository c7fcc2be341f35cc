"""What is viewed: clips on their ground, systems to begin with and to go back to, and a cost."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxik
from fitting.clips import Clip
from fitting.experiment import problems, systems
from fitting.experiment.experiment import Experiment
from fitting.experiment.problems import ClipData
from fitting.experiment.systems import Preset
from fitting.inference.noise import NoiseModel, with_noise
from fitting.motion.measures import with_soles_of
from fitting.problem.capture_system import alone, is_of_capture, system_and_scenes
from fitting.problem.problem import Problem
from fitting.problem.residuals import residuals_of_scenes
from fitting.problem.scene import Scene
from fitting.problem.space import FreeParameter, Vector
from fitting.runtime.precision import in_float64, with_floats
from fitting.runtime.program_cache import cached, committed
from fitting.studies.animations import Animation, AnimationFiles, load_animation
from fitting.studies.fit import run_folder

from .edits import ClipFile

DEFAULT, FITTED, GIVEN = "default", "fitted", "given"  # systems to go back to
Cost = Callable[[jaxik.FootIK], Float[Array, ""]]


@dataclass(frozen=True)
class SessionClip:
    """One clip on its ground."""

    name: str
    animation: Animation
    """On a terrain as the rays of the system need it."""
    size: Float[Array, ""] | None = None
    """Of the body over the one that the numbers are for; see `Scene`."""
    data: ClipData | None = None
    """The captured motion on its ground, where it is known."""
    files: tuple[ClipFile, ...] = ()
    """That have its stances; none where they cannot be put right."""

    @property
    def labelled(self) -> Clip:
        """The motion whose stances the page shows."""
        own = self.animation
        return own.clip if own.captured is None else own.captured


@dataclass(frozen=True)
class Session:
    """What a viewer shows, and what it can change."""

    title: str
    clips: tuple[SessionClip, ...]
    starts: Mapping[str, jaxik.FootIK]
    """The systems to go back to, by name; it begins with the first."""
    preset: Preset
    """Of which they differ."""
    free: tuple[FreeParameter, ...] = ()
    """What a fit has changed, with the ranges that it was given."""
    leg_length: float | None = None
    """m, of the body that the numbers are for; None if they fit any body as they are."""
    cost: Cost | None = None
    """How far a system's motion is from the captured one; None where there is none."""
    reload: "Callable[[], Session] | None" = None
    """Reads everything anew, after stances were put right; None where they cannot be."""

    @property
    def rig(self) -> jaxik.Rig:
        """The body on which the ranges of parameters depend."""
        return self.clips[0].animation.clip.rig


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
def session_of_run(run: Path) -> Session:
    """The clips of a run, its fitted system, and the cost of its fit.

    Raises:
        ValueError: the folder holds no finished fit, or its experiment does not fit its clips.
    """
    experiment, summary = run_folder.load_fit(run)
    clips = problems.load_clips(experiment)
    problem = problems.problem_from_clips(experiment, clips)
    if experiment.noise.moves_optimum and "noise" in summary:  # else the fit was without it
        problem = with_noise(problem, NoiseModel(**summary["noise"]))
    values = {row["name"]: row["u"] for row in summary["parameters"]}
    u = np.array([values[name] for name in problem.space.names])
    session = session_of_fit(experiment, problem, clips, u)
    session = with_start(session, FITTED, alone(problem.space.unpack(u)))
    if any(entry.loaded is not None for entry in experiment.clips):
        return session
    return replace(session, reload=partial(session_of_run, run))


@in_float64
def session_of_fit(
    experiment: Experiment,
    problem: Problem[jaxik.FootIK],
    clips: tuple[ClipData, ...],
    u: Vector | None = None,
) -> Session:
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
    session_clips = tuple(
        SessionClip(
            name=scene.reference.label if len(clips) == 1 else f"{number}: {clip.base.source}",
            animation=Animation(
                clip.base,
                scene.terrain,
                root=clip.root,
                tracks={name: np.asarray(track) for name, track in scene.tracks.items()},
                given_frames=scene.frames,
                captured=with_soles_of(clip.reference, clip.base),
            ),
            size=scene.size,
            data=clip,
            files=tuple(
                ClipFile(path, entry.of_file(path))
                for path in (entry.reference, entry.base)
                if path is not None
            ),
        )
        for number, (entry, clip, scene) in enumerate(
            zip(experiment.clips, clips, scenes, strict=True), 1
        )
    )
    cost = partial(cost_of_problem, committed(problem))
    if experiment.capture:  # then the problem is one of more than a system
        cost = partial(cost_of_scenes, scenes)
    return Session(
        title=experiment.name,
        clips=session_clips,
        starts={"before": alone(problem.space.system), DEFAULT: default},
        preset=Preset(experiment.preset, experiment.faithful),
        free=tuple(p for p in problem.space.parameters if not is_of_capture(p.name)),
        leg_length=experiment.leg_length(problem.data[0].rig),
        cost=cost,
    )


@in_float64
def session_of_animation(
    files: AnimationFiles, preset: Preset | None, start: jaxik.FootIK | None = None
) -> Session:
    """A flat animation on a terrain; its cost too, where the file has the captured motion.

    Args:
        files: the clip, the terrain, and where the root is put.
        preset: what the sliders go back to; None is the one that serves the clip best.
        start: the system to begin with; None is the preset.

    Raises:
        ValueError: a file cannot be read, or the system does not fit the clip.
    """
    loaded, requested = load_animation(files), preset
    preset = preset or systems.choose_preset([loaded.clip])
    names = {DEFAULT: preset.system(loaded.clip.rig)} | ({GIVEN: start} if start else {})
    starts = {name: with_floats(ik, np.float64) for name, ik in reversed(names.items())}
    if loaded.root.rise is not None:
        starts = {name: systems.without_own_root(ik) for name, ik in starts.items()}
    first = next(iter(starts.values()))
    loaded.check_shapes(first)
    captured, cost, data = loaded.captured, None, None
    if captured is not None:
        captured = with_soles_of(captured, loaded.clip)
        if files.floor == 0.0:  # a scene knows no other
            data = ClipData(captured, loaded.clip, loaded.terrain, loaded.root, loaded.tracks)
            cost = partial(cost_of_scenes, (problems.make_scene(data, {}),))
    prepared = replace(loaded, given_frames=loaded.frames, captured=captured)
    title = f"{files.clip.name} on {files.terrain.name}"
    own = (ClipFile(files.clip, files.clip_options.of_file(files.clip)),)
    clip = SessionClip(files.clip.name, prepared, data=data, files=own)
    again = partial(session_of_animation, replace(files), requested, start)
    return Session(title, (clip,), starts, preset, cost=cost, reload=again)


def with_start(session: Session, name: str, ik: jaxik.FootIK) -> Session:
    """The session with one more system to go back to, with which it begins."""
    return replace(session, starts={name: ik, **session.starts})
