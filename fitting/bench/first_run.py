"""What a newcomer waits for: a first fit, a first posterior, the first cells of a notebook.

Each is done in the example in a folder, as a command or a notebook would, in a process of its own.
"""

import os
import shutil
import tempfile
import time
from pathlib import Path

from fitting.runtime import activity

from .measurement import Measurement, call_in_process
from .workloads import Sizes

EXAMPLE, RUN = "uneven_walk", "run"  # the main job of the README, and the folder of its run
ENDS = {"empty": 50.0, "full": 15.0}  # s, aims of the whole job by what the cache holds
WAITS = {
    "notebook": "a notebook's first heights of feet",
    "fit": "`jaxik fit`, its first cost",
    "sample": "`jaxik sample`, its first state of the chain",
}


def first_run(measurement: Measurement, sizes: Sizes) -> None:
    """Processes that begin with an empty cache and with a full one."""
    from fitting.studies import exports

    for number in range(sizes.fits):
        with tempfile.TemporaryDirectory() as parent:
            exports.copy(EXAMPLE, folder := Path(parent, EXAMPLE), "{}")
            for state in ENDS:
                for kind in WAITS:
                    name = f"{kind}, {state} cache"
                    measurement.progress(f"first: {name}, run {number + 1} of {sizes.fits}")
                    seconds = _in_process(kind, folder, {"XDG_CACHE_HOME": f"{parent}/{kind}"})
                    measurement.samples.setdefault(name, []).append(seconds["first"])
                    if kind == "fit":
                        measurement.samples.setdefault(f"whole {name}", []).append(seconds["end"])
    for state, at_most in ENDS.items():
        for kind, what in WAITS.items():
            measurement.add_timing(f"{kind}, {state} cache", f"{what}, {state} cache")
        what = f"… the whole fit, {state} cache"
        measurement.add_timing(f"whole fit, {state} cache", what, at_most=at_most)


def _in_process(kind: str, folder: Path, variables: dict[str, str]) -> dict[str, float]:
    """Seconds of a new process until its first number and its end, imports included."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")} | variables
    start = time.time()
    first = call_in_process(wait, kind, str(folder), environment=environment)
    return {"first": first - start, "end": time.time() - start}


def fit(folder: Path) -> None:
    """The whole job; its first number is a cost."""
    import fitting

    shutil.rmtree(folder / RUN, ignore_errors=True)
    fitting.fit(folder / f"{EXAMPLE}.toml", folder / RUN)


def sample(folder: Path) -> None:
    """Steps around the fit that is there until the first report on the chain."""
    import fitting
    from fitting.inference.sample.blocks import SamplerSettings

    fitting.sample(folder / RUN, max_steps=SamplerSettings().check_every)


def notebook(folder: Path) -> None:
    """What a notebook begins with: a clip on its ground, a preset, how high the feet are."""
    import jaxik
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
    from fitting.runtime import cache_folder, xla

    xla.configure_xla()
    cache_folder.use_default()
    jobs = {"fit": fit, "sample": sample, "notebook": notebook}
    with activity.watched_by(clock := _Clock()):
        jobs[kind](Path(folder))
    return clock.times[0]
