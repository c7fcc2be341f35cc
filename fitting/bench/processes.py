"""What benchmarks run in processes of their own: cold fits, a newcomer's first steps, points.

Imports are part of what is measured, so functions import what they alone need.
"""

import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

import fitting
import jaxik
from fitting.runtime import activity, cache_folder, xla

from . import workloads

EXAMPLE, RUN = "uneven_walk", "run"  # the main job of the README, and the folder of its run

FRAMES = 60
LENGTHS = 33, 50  # frames of the shortest and of the longest of many clips
SYSTEMS = 4096  # shared out among devices
FITS = 8  # shared out among workers
EXPERIMENT = """
preset = "record"
faithful = true
[[clips]]
reference = "reference.npz"
base = "base.npz"
terrain = "ground.ply"
[free]
pelvis.half_life = {}
foot.max_pitch = { low = 0.1 }
[fit]
starts = 1
"""


def fit_once(folder: str) -> float:
    """Reads the clip and fits it, for a process of its own; the seconds of the search."""
    from fitting.inference.optimise.search import find_best_fit

    clip_data = workloads.load_recording(folder)
    return find_best_fit(workloads.problem_from_clips([clip_data])).seconds


def fit(folder: Path) -> None:
    """The whole job; its first number is a cost."""
    shutil.rmtree(folder / RUN, ignore_errors=True)
    fitting.fit(folder / f"{EXAMPLE}.toml", folder / RUN)


def sample(folder: Path) -> None:
    """Steps around the fit that is there until the first report on the chain."""
    from fitting.inference.sample.blocks import SamplerSettings

    fitting.sample(folder / RUN, max_steps=SamplerSettings().check_every)


def notebook(folder: Path) -> None:
    """What a notebook begins with: a clip on its ground, a preset, how high the feet are."""
    from fitting.experiment.experiment_files import load_experiment
    from fitting.experiment.problems import make_problem
    from fitting.motion import playback

    problem = make_problem(load_experiment(folder / f"{EXAMPLE}.toml"))
    (scene,) = problem.data
    result = playback.run(jaxik.presets.record(), scene)
    activity.report(float(result.pose.ankle.pos[..., 1].mean()))


class _Clock(activity.Watcher):
    """Notes when numbers come, in seconds since 1970."""

    def __init__(self) -> None:
        self.times: list[float] = []

    def reported(self, result: object) -> None:
        if not isinstance(result, tuple):  # the experiment, before the search
            self.times.append(time.time())


def wait(kind: str, folder: str) -> float:
    """Does one of the jobs; the time of its first number, in seconds since 1970."""
    xla.configure_xla()
    cache_folder.use_default()
    jobs = {"fit": fit, "sample": sample, "notebook": notebook}
    with activity.watched_by(clock := _Clock()):
        jobs[kind](Path(folder))
    return clock.times[0]


def of_devices(count: int) -> dict[str, float]:
    """Many systems on a clip, on so many devices."""
    problem = workloads.problem(FRAMES)
    ik = problem.space.unpack(problem.space.start)
    batch = fitting.vary(ik, {"pelvis.half_life": np.linspace(0.05, 0.9, SYSTEMS)})
    devices = jax.local_devices()[:count]
    return _second_time(lambda: fitting.evaluate_many(batch, problem.data, devices=devices))


def of_clips(count: int) -> dict[str, float]:
    """A system on so many clips of different length on one ground."""
    problem = workloads.problem(max(LENGTHS))
    ik = problem.space.unpack(problem.space.start)
    lengths = np.linspace(*LENGTHS, count).astype(int)
    clips = [workloads.first_frames(problem.data[0], length) for length in lengths]
    single = fitting.vary(ik, {"pelvis.half_life": [0.2]})
    return _second_time(lambda: fitting.evaluate_many(single, clips))


def of_workers(count: int) -> dict[str, float]:
    """Fits of a clip with several seeds, on so many workers of this machine."""
    cache_folder.use_default()
    with tempfile.TemporaryDirectory() as folder:
        workloads.save_recording(folder, FRAMES)
        path = Path(folder, "walk.toml")
        path.write_text(EXPERIMENT, encoding="utf-8")
        fitting.fit_many(path, Path(folder, "first"), workers=1, report=False)  # compiles
        began = time.monotonic()
        many_fits = fitting.fit_many(
            path, Path(folder, "fits"), seeds=FITS, workers=count, report=False
        )
        efforts = many_fits.efforts
        return {
            "seconds": time.monotonic() - began,
            "cpu_seconds": sum(effort["cpu_seconds"] for effort in efforts),
            "peak_mb": max(effort["peak_mb"] or float("nan") for effort in efforts),
        }


def _second_time(call: Callable[[], object]) -> dict[str, float]:
    """What a call takes after one that compiles; the peak is that of both."""
    from fitting.runtime.cluster import Stopwatch

    call()
    watch = Stopwatch()
    call()
    effort = watch.read()
    peak = effort["peak_mb"] or float("nan")
    return {**{key: effort[key] for key in ("seconds", "cpu_seconds")}, "peak_mb": peak}


def measure_point(what: str, count: int) -> dict[str, float]:
    """The numbers of a point, in its process."""
    xla.configure_xla()
    points = {"devices": of_devices, "clips": of_clips, "workers": of_workers}
    return points[what](count)
