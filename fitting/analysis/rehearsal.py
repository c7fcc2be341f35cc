"""The system before a fit plays the clips in another thread, while the search goes on.

The report shows these motions. Playing them compiles, on a core that the search leaves idle, all
that the report computes of the fitted system as well: a third of a first run's time.
"""

from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property

import jaxik
from fitting.problem.capture.system import system_and_scenes
from fitting.problem.problem import Problem
from fitting.runtime.precision import in_float64

from . import limit_activity, playback


class Rehearsal:
    """Plays the clips of a problem once, from when it is started or its results are wanted."""

    def __init__(self, problem: Problem[jaxik.FootIK]):
        self._problem = problem

    def start(self) -> None:
        """Begins to play, unless it has begun."""
        _ = self._future

    def results(self) -> tuple[jaxik.Result, ...]:
        """What the system before the fit makes of each clip; waits until it is played."""
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
    limit_activity.measure(system, scenes, results)
    return results
