"""Rows of `jaxik bench` that fit: the Jacobian, a fit warm and cold, its posterior, in 64 bits.

`python -m fitting.bench.fits FOLDER` fits the clip in a folder and prints the seconds that the
search took: what a cold fit is, started in a process of its own.
"""

import dataclasses
import itertools
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fitting.datasets.clips import load_clip, save_clip
from fitting.datasets.terrain.mesh_files import load_terrain, save_mesh
from fitting.inference.optimisation.search import find_best_fit
from fitting.inference.optimisation.solution import Solution
from fitting.inference.sampling.posterior import WalkerStart, sample_posterior
from fitting.inference.sampling.settings import SamplerSettings
from fitting.problem.problem import Problem
from fitting.runtime.threads import usable_cores

from . import peers, setup
from .measure import Row, clocked
from .setup import Sizes

SCIPY = {"SciPy with our slopes": True, "SciPy with differences": False}
CALLS = 64 * 1000  # log-probabilities of the posterior that is to be reached
CLIPS, GROUND = ("reference.npz", "base.npz"), "ground.ply"  # of a cold fit


def _rows(problem: Problem, u: jax.Array) -> jax.Array:
    return problem.residuals(u)


def slopes_of(problem: Problem, u: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Rows and slopes."""
    return problem.residuals_and_jacobian(u)


def jacobian(row: Row, sizes: Sizes) -> None:
    """Rows and their slopes for twenty parameters, against the rows alone."""
    wide = setup.problem(sizes.frames)
    calls = {}
    for floats in sizes.floats:
        problem = wide if floats == "float64" else setup.single(wide)
        u = problem.space.u0
        calls[f"rows, {floats}"] = row.compiled(f"rows, {floats}", _rows, problem, u)
        calls[f"slopes, {floats}"] = row.compiled(f"slopes, {floats}", slopes_of, problem, u)
    row.race(calls)
    for floats in sizes.floats:
        rows, slopes = f"rows, {floats}", f"slopes, {floats}"
        row.timed(f"rows, {floats}", rows, "ms", 1e3, floats=floats)
        row.timed(f"rows and slopes, {floats}", slopes, "ms", 1e3, floats=floats, at_most=25.0)
        operations = row.work[slopes].operations / row.work[rows].operations
        note = f"by operations {operations:.1f} times"
        row.ratio(f"in evaluations, {floats}", slopes, rows, at_most=8.0, note=note)


def fit(row: Row, sizes: Sizes) -> None:
    """The whole search for twenty parameters: again, with nothing compiled, and SciPy's."""
    problem = setup.problem(sizes.frames)
    found: dict[str, Any] = {}

    def ours() -> None:
        found["ours"] = find_best_fit(problem, progress=lambda now: row.tell(f"fit: {now.stage}"))
        if found["ours"].interrupted:  # the solver keeps Ctrl-C to itself; half a run is no figure
            raise KeyboardInterrupt

    row.program("rows and slopes", slopes_of, problem, problem.space.u0)
    calls: dict[str, Callable[[], Any]] = {"ours": ours}
    for name, slopes in list(SCIPY.items())[: 2 if sizes.cold else 1]:
        peer = peers.with_scipy(problem, our_slopes=slopes)
        calls[name] = lambda name=name, peer=peer: found.update({name: peer()})
    row.race(calls, sizes.fits)
    solution: Solution = found["ours"]
    row.work["ours"] = row.work["rows and slopes"] * solution.steps
    note = f"{solution.steps} steps, of which the limit is; cost reached {solution.cost:.1f}"
    row.timed("warm", "ours", "s", at_most=2.0, note=note)
    row.notes.append(f"seconds by stage: {_stages(solution)}; {solution.message}")
    for name in list(calls)[1:]:
        end: peers.Descent = found[name]
        counted = f"{end.evaluations} evaluations and {end.jacobians} Jacobians"
        row.ratio(f"{name}: its time in ours", name, "ours")
        row.timed(name, name, "s", note=f"cost {end.cost:.1f}; {counted}")
    if not sizes.cold:
        row.notes.append("cold fits, and SciPy with differences, are left out")
        return
    _cold(row, sizes)
    for cache, reach in (("empty", 20.0), ("persistent", 5.0)):
        inside = statistics.median(row.samples[f"its search, {cache} cache"])
        note = f"a process of its own, imports and clip included; the search in it {inside:.1f} s"
        name = f"cold, {cache} cache"
        row.timed(name, name, "s", at_most=reach, note=note)


def _stages(solution: Solution) -> str:
    """Seconds that a fit spent in each stage, from its reports."""
    spent: dict[str, float] = {}
    for before, now in itertools.pairwise(solution.history):
        spent[now.stage] = spent.get(now.stage, 0.0) + now.seconds - before.seconds
    return ", ".join(f"{stage} {seconds:.2f}" for stage, seconds in spent.items())


def _cold(row: Row, sizes: Sizes) -> None:
    """Samples of whole processes that fit, each first with an empty cache and then with a full."""
    told: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        reference, base, ground = setup.recording(sizes.frames)
        for name, clip in zip(CLIPS, (reference, base), strict=True):
            save_clip(Path(folder, name), clip)
        save_mesh(Path(folder, GROUND), ground.vertices, ground.faces)
        for number in range(sizes.fits):
            with tempfile.TemporaryDirectory() as cache:
                settings = {
                    "JAX_ENABLE_X64": "1",
                    "JAX_ENABLE_COMPILATION_CACHE": "1",
                    "JAX_COMPILATION_CACHE_DIR": cache,
                    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",  # as in the commands
                }
                for name in ("empty", "persistent"):
                    row.tell(f"fit: cold, {name} cache, run {number + 1} of {sizes.fits}")
                    took, busy = clocked(lambda: told.append(_fit_apart(folder, settings)))  # noqa: B023
                    row.samples.setdefault(f"cold, {name} cache", []).append(took)
                    row.busy.setdefault(f"cold, {name} cache", []).append(busy)
                    row.samples.setdefault(f"its search, {name} cache", []).append(told[-1])


def _fit_apart(folder: str, settings: Mapping[str, str]) -> float:
    """Seconds of a search in a process of its own, to which imports and the clip come."""
    command = [sys.executable, "-m", "fitting.bench.fits", folder]
    done = subprocess.run(
        command, env=os.environ | settings, check=True, capture_output=True, text=True
    )
    return float(done.stdout)


def posterior(row: Row, sizes: Sizes) -> None:
    """The sampler around the fit, as many steps as asked."""
    problem = setup.problem(sizes.frames)
    centre = np.asarray(problem.space.pack(setup.TRUTH))
    slopes = np.asarray(jax.jit(slopes_of)(problem, jnp.asarray(centre))[1])
    sd = np.clip(np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes))), 1e-3, 0.5)

    def sampled(steps: int) -> None:
        made = sample_posterior(
            problem, WalkerStart(centre, sd),
            SamplerSettings(walkers=sizes.walkers, max_steps=steps, stop_at=1e9),
            progress=lambda now: row.tell(f"posterior: step {now.step} of {now.max_steps}"),
        )  # fmt: skip
        if made.interrupted:
            raise KeyboardInterrupt

    began = time.perf_counter()
    sampled(1)
    row.compile_s["log-probability, and one step"] = time.perf_counter() - began
    row.program("rows", _rows, problem, problem.space.u0)
    row.race({"chain": lambda: sampled(sizes.steps)}, sizes.chains, warm=True)
    calls = sizes.steps * sizes.walkers
    one = row.work["rows"]  # all walkers of a step read the clip once
    row.work["chain"] = dataclasses.replace(one * calls, moved=one.moved * sizes.steps)
    a_call = 1e3 * row.samples["chain"][0] / calls
    note = f"{a_call:.2f} ms a log-probability; {usable_cores()} cores"
    reach: dict[str, Any] = {"at_most": 60.0} if calls >= CALLS else {}  # fewer are no proof
    what = f"{sizes.walkers} walkers, {sizes.steps} steps"
    row.timed(what, "chain", "s", threads=usable_cores(), note=note, **reach)


def main() -> None:
    """One fit; prints its seconds."""
    folder = Path(sys.argv[1])
    reference, base = (load_clip(folder / name) for name in CLIPS)
    problem = setup.problem_of(reference, base, load_terrain(folder / GROUND))
    print(f"{find_best_fit(problem).seconds:.2f}")


if __name__ == "__main__":
    main()
