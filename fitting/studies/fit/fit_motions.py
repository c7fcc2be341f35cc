"""The motions that a fit is about, as whole skeletons on their ground, for the report's page.

The run folder has two of them, the flat animation and the fitted motion.

The system before a fit plays the clips in another thread, while the search goes on.

The report shows these motions. Playing them compiles, on a core that the search leaves idle, all
that the report computes of the fitted system as well: a third of a first run's time.
"""

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool

import jaxik
from fitting.clips import Clip
from fitting.clips.clip_frames import clip_from_result, raised
from fitting.experiment import systems
from fitting.experiment.problems import ClipData
from fitting.ground import ground_path
from fitting.ground.ground_path import GroundPatch
from fitting.motion import accuracy, playback
from fitting.motion.accuracy import Accuracy, Errors
from fitting.motion.measures import PlacedMotion, place, with_soles_of
from fitting.problem.capture_system import alone, is_of_capture, system_and_scenes
from fitting.problem.problem import Problem
from fitting.problem.scene import own_system
from fitting.report import live_data
from fitting.report.live_data import LiveClip, LiveSystem
from fitting.report.sliders import sliders
from fitting.runtime import activity
from fitting.runtime.precision import in_float64, with_floats

from .fit import Fit


@dataclass(frozen=True)
class ClipMotions:
    """One clip of a fit."""

    animated: PlacedMotion
    """The flat animation, with its root where foot IK gets it."""
    before: PlacedMotion
    """By the system as it was before the fit."""
    fitted: PlacedMotion
    captured: PlacedMotion
    stance: Bool[np.ndarray, "frames legs"]
    """Where the captured foot stands, by the clip's labels or else by its motion."""
    flat: Clip
    """The animation, as its file has it."""
    ground: GroundPatch
    errors: dict[str, Errors]
    """Of `before` and `fitted`, against the captured motion."""


@in_float64
def fitted_clip(data: ClipData, result: jaxik.Result) -> Clip:
    """A clip as a system leaves it."""
    return clip_from_result(data.base, result, rise=data.root.rise)


@in_float64
def clip_motions(data: ClipData, before: jaxik.Result, fitted: jaxik.Result) -> ClipMotions:
    """The motions of one clip, measured on its ground."""
    animated = raised(data.base, data.root.rise)
    captured = with_soles_of(data.reference, data.base)
    solved = {"before": fitted_clip(data, before), "fitted": fitted_clip(data, fitted)}
    placed = {
        name: place(clip, animated, data.base, data.terrain)
        for name, clip in {"animated": animated, **solved, "captured": captured}.items()
    }
    return ClipMotions(
        **placed,
        stance=data.reference.stance_labels(),
        flat=data.base,
        ground=ground_path.around_path(data.reference, data.terrain),
        errors={
            name: accuracy.clip_errors(clip, data.reference, animated)
            for name, clip in solved.items()
        },
    )


@in_float64
def live_clip(fitted: Fit, number: int, motions: ClipMotions) -> LiveClip:
    """One clip of a fit, by its number, as its page solves it again."""
    scene, experiment, space = fitted.scenes[number], fitted.experiment, fitted.problem.space
    preset = with_floats(experiment.preset_system(fitted.clips[0].base.rig), np.float64)
    if any(clip.root.rise is not None for clip in fitted.clips):
        preset = systems.without_own_root(preset)
    starts = {"fitted": fitted.ik, "before the fit": alone(space.system), "preset": preset}
    free = [parameter for parameter in space.parameters if not is_of_capture(parameter.name)]
    own = sliders(fitted.ik, fitted.clips[0].base.rig, free)
    if scene.size is not None:
        own = [slider.scaled(float(scene.size)) for slider in own]
    return LiveClip(
        animated=motions.animated.clip,
        frames=scene.frames,
        rig=scene.rig,
        terrain=scene.terrain,
        observed=fitted.clips[number].base.observed,
        systems={
            "fitted": LiveSystem({name: own_system(ik, scene) for name, ik in starts.items()}, own)
        },
        has_tracks=bool(scene.tracks),
    )


def summarised(motions: Sequence[ClipMotions]) -> dict[str, Accuracy]:
    """How far the motions `before` and `fitted` are from the captured ones, over all clips."""
    return {
        name: accuracy.summarise([clip.errors[name] for clip in motions])
        for name in ("before", "fitted")
    }


def saved_clips(fitted: Fit) -> dict[str, Clip]:
    """The motions in the run folder, by file name; numbered for several clips."""
    clips: dict[str, Clip] = {}
    for number, (data, result) in enumerate(zip(fitted.clips, fitted.results, strict=False), 1):
        ending = f"_{number}.npz" if len(fitted.clips) > 1 else ".npz"
        clips[f"base{ending}"] = data.base
        clips[f"fitted{ending}"] = fitted_clip(data, result)
    return clips


class WarmUp(activity.Watcher):
    """Plays the clips of a problem once, from a search's first report or when results are wanted.

    Until then the programs of the search are compiled. Its thread has no context, so that its
    programs are not listed as those for which the search waits.
    """

    def __init__(self, problem: Problem[jaxik.FootIK]):
        self._problem = problem

    def reported(self, result: object) -> None:
        """Begins to play, unless it has begun."""
        _ = self._future

    def results(self) -> tuple[jaxik.Result, ...]:
        """The motion of each clip by the system before the fit; waits until it is played."""
        return self._future.result()

    @cached_property
    def _future(self) -> Future[tuple[jaxik.Result, ...]]:
        thread = ThreadPoolExecutor(1)
        future = thread.submit(_play, self._problem)
        thread.shutdown(wait=False)
        return future


@in_float64
def _play(problem: Problem[jaxik.FootIK]) -> tuple[jaxik.Result, ...]:
    system, scenes = system_and_scenes(problem, problem.space.pack({}))
    results = playback.run_all(system, scenes)
    for scene, result in zip(scenes, results, strict=True):
        playback.play(scene, result)
    playback.measure_activity(system, scenes, results)
    for scene in scenes:
        live_data.prepare(system, scene)
    return results
