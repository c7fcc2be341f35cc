"""Benchmarks of fits: the Jacobian, a warm and a cold fit, and the posterior, in 64 bits."""

import dataclasses
import functools
import itertools
import os
import statistics
import tempfile
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from fitting.inference.optimise.search import find_best_fit
from fitting.inference.optimise.solution import Solution
from fitting.inference.sample.blocks import SamplerSettings
from fitting.inference.sample.posterior import WalkerStart, sample_posterior
from fitting.problem.problem import Problem
from fitting.runtime.threads import usable_cores

from . import workloads
from .measurement import Call, Measurement, call_in_process, time_calls
from .workloads import Sizes

SCIPY = {"SciPy with our slopes": True, "SciPy with differences": False}  # our Jacobian or not
FULL_POSTERIOR = 64 * 1000  # log-probabilities for which there is a target; fewer have none


def _residuals(problem: Problem, u: jax.Array) -> jax.Array:
    return problem.residuals(u)


def residuals_and_jacobian(problem: Problem, u: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The residuals of a problem and their Jacobian."""
    return problem.residuals_and_jacobian(u)


def jacobian(measurement: Measurement, sizes: Sizes) -> None:
    """Residuals and their Jacobian for twenty parameters, against the residuals alone."""
    problem64 = workloads.problem(sizes.frames)
    calls = {}
    for floats in sizes.floats:
        problem = problem64 if floats == "float64" else workloads.single(problem64)
        u = problem.space.start
        rows, slopes = f"rows, {floats}", f"slopes, {floats}"
        calls[rows] = measurement.compile_call(rows, _residuals, problem, u)
        calls[slopes] = measurement.compile_call(slopes, residuals_and_jacobian, problem, u)
    measurement.time_in_turns(calls)
    for floats in sizes.floats:
        rows, slopes = f"rows, {floats}", f"slopes, {floats}"
        measurement.add_timing(rows, rows, "ms", floats=floats)
        what = f"rows and slopes, {floats}"
        measurement.add_timing(slopes, what, "ms", floats=floats, at_most=25.0)
        operations = measurement.work[slopes].operations / measurement.work[rows].operations
        what, note = f"in evaluations, {floats}", f"by operations {operations:.1f} times"
        measurement.add_ratio(slopes, rows, what, at_most=8.0, note=note)


def clips(measurement: Measurement, sizes: Sizes) -> None:
    """Residuals and their Jacobian of several clips, and what they take to compile, in one's."""
    calls = {}
    counts = 1, len(workloads.GROUNDS)
    frames = sizes.frames // len(workloads.GROUNDS)
    for count in counts:
        problem = workloads.problem(frames, clips=count)
        arguments = problem, problem.space.start
        calls[_clips(count)] = measurement.compile_call(
            _clips(count), residuals_and_jacobian, *arguments
        )
        measurement.samples[_compiling(count)] = [measurement.compile_s[_clips(count)]]
    measurement.time_in_turns(calls)
    for count in counts:
        measurement.add_timing(_clips(count), _clips(count), "ms")
        measurement.add_timing(_compiling(count), _compiling(count))
    one, several = map(_compiling, counts)
    measurement.add_ratio(several, one, f"compiling {counts[1]} clips in one's", at_most=1.5)


def _clips(count: int) -> str:
    return f"{count} {'clip' if count == 1 else 'clips'}"


def _compiling(count: int) -> str:
    return f"compiling {_clips(count)}"


def fit(measurement: Measurement, sizes: Sizes) -> None:
    """The whole search for twenty parameters: warm, cold, and SciPy's."""
    problem = workloads.problem(sizes.frames)
    solutions: list[Solution] = []
    descents: dict[str, OptimizeResult] = {}

    def ours() -> None:
        solution = find_best_fit(problem)
        if solution.interrupted:  # the search keeps Ctrl-C to itself; half a run is not a figure
            raise KeyboardInterrupt
        solutions.append(solution)

    def scipy(name: str) -> Call:
        descend = _least_squares_with_scipy(problem, our_jacobian=SCIPY[name])
        return lambda: descents.update({name: descend()})

    start = problem.space.start
    measurement.compile("rows and slopes", residuals_and_jacobian, problem, start)
    calls: dict[str, Call] = {"ours": ours}
    calls |= {name: scipy(name) for name in list(SCIPY)[: 2 if sizes.cold else 1]}
    measurement.time_in_turns(calls, sizes.fits)
    solution = solutions[-1]
    measurement.work["ours"] = measurement.work["rows and slopes"] * solution.steps
    note = f"{solution.steps} steps, of which the limit is; cost reached {solution.cost:.1f}"
    measurement.add_timing("ours", "warm", at_most=2.0, note=note)
    measurement.notes.append(f"seconds by stage: {_stages(solution)}; {solution.message}")
    for name, descent in descents.items():
        measurement.add_ratio(name, "ours", f"{name}: its time in ours")
        counts = f"{descent.nfev} evaluations and {descent.njev} Jacobians"
        measurement.add_timing(name, name, note=f"cost {descent.cost:.1f}; {counts}")
    if not sizes.cold:
        measurement.notes.append("cold fits, and SciPy with differences, are left out")
        return
    sample(measurement, sizes)
    for cache, target in (("empty", 20.0), ("persistent", 5.0)):
        search = statistics.median(measurement.samples[f"its search, {cache} cache"])
        note = f"a process of its own, imports and clip included; the search in it {search:.1f} s"
        name = f"cold, {cache} cache"
        measurement.add_timing(name, name, at_most=target, note=note)


def _least_squares_with_scipy(
    problem: Problem, *, our_jacobian: bool
) -> Callable[[], OptimizeResult]:
    """SciPy's `least_squares` from the space's start, with our Jacobian or finite differences.

    The residuals are ours and compiled in both cases. It stops at our solver's tolerance.
    """

    def compiled(function: Callable[[Problem, jax.Array], jax.Array]) -> Callable:
        program = jax.jit(function)
        return lambda u: np.asarray(program(problem, jnp.asarray(u)))

    jacobian = compiled(lambda problem, u: problem.jacobian(u)) if our_jacobian else "2-point"
    start = np.asarray(problem.space.start, float)
    return functools.partial(least_squares, compiled(_residuals), start, jac=jacobian, ftol=1e-6)


def _stages(solution: Solution) -> str:
    """Seconds that a fit spent in each stage, from its progress reports."""
    seconds: dict[str, float] = {}
    for before, after in itertools.pairwise(solution.history):
        seconds[after.stage] = seconds.get(after.stage, 0.0) + after.seconds - before.seconds
    return ", ".join(f"{stage} {spent:.2f}" for stage, spent in seconds.items())


def posterior(measurement: Measurement, sizes: Sizes) -> None:
    """The sampler around the best fit, for a fixed number of steps."""
    problem = workloads.problem(sizes.frames)
    centre = np.asarray(problem.space.pack(workloads.TRUTH))
    slopes = np.asarray(jax.jit(residuals_and_jacobian)(problem, jnp.asarray(centre))[1])
    sd = np.clip(np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes))), 1e-3, 0.5)

    def sample(steps: int) -> None:
        sampled = sample_posterior(
            problem, WalkerStart(centre, sd),
            SamplerSettings(walkers=sizes.walkers, max_steps=steps, stop_at=1e9),
        )  # fmt: skip
        if sampled.interrupted:
            raise KeyboardInterrupt

    start = time.perf_counter()
    sample(1)
    measurement.compile_s["log-probability, and one step"] = time.perf_counter() - start
    measurement.compile("rows", _residuals, problem, problem.space.start)
    calls = {"chain": lambda: sample(sizes.steps)}
    measurement.time_in_turns(calls, sizes.chains, warm_up=False)
    evaluations = sizes.steps * sizes.walkers
    work = measurement.work["rows"]  # all walkers of a step read the clip once
    measurement.work["chain"] = dataclasses.replace(
        work * evaluations, moved=work.moved * sizes.steps
    )
    milliseconds, cores = 1e3 * measurement.samples["chain"][0] / evaluations, usable_cores()
    measurement.add_timing(
        "chain", f"{sizes.walkers} walkers, {sizes.steps} steps", threads=cores,
        at_most=60.0 if evaluations >= FULL_POSTERIOR else None,
        note=f"{milliseconds:.2f} ms a log-probability; {cores} cores",
    )  # fmt: skip


def sample(measurement: Measurement, sizes: Sizes) -> None:
    """Adds samples of processes that fit, each with an empty cache first and then with a full one.

    The samples are named "cold, empty cache" and "cold, persistent cache"; the time of the search
    within the process "its search, ...".
    """
    searches: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        workloads.save_recording(folder, sizes.frames)
        for number in range(sizes.fits):
            with tempfile.TemporaryDirectory() as cache:
                environment = os.environ | {
                    "JAX_ENABLE_X64": "1",
                    "JAX_ENABLE_COMPILATION_CACHE": "1",
                    "JAX_COMPILATION_CACHE_DIR": cache,
                    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",  # as in the commands
                }
                for state in ("empty", "persistent"):
                    name = f"cold, {state} cache"
                    measurement.progress(f"fit: {name}, run {number + 1} of {sizes.fits}")
                    fit = functools.partial(
                        call_in_process, fit_once, folder, environment=environment
                    )
                    seconds, cpu_seconds = time_calls(lambda: searches.append(fit()))  # noqa: B023
                    measurement.samples.setdefault(name, []).append(seconds)
                    measurement.busy.setdefault(name, []).append(cpu_seconds)
                    search = f"its search, {state} cache"
                    measurement.samples.setdefault(search, []).append(searches[-1])


def fit_once(folder: str) -> float:
    """Reads the clip and fits it, for a process of its own; the seconds of the search."""
    clip_data = workloads.load_recording(folder)
    return find_best_fit(workloads.problem_from_clips([clip_data])).seconds
