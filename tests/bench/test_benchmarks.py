"""Every benchmark of `jaxik bench` runs at small sizes and measures what it says."""

import dataclasses
import subprocess
from pathlib import Path
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fitting.bench import host, measurement, report, runner, suite, workloads
from fitting.bench import sizes as bench_sizes
from fitting.bench.benchmarks import (
    baselines,
    ceilings,
    cold_fit,
    crowd,
    inference,
    kernels,
    live,
    many,
    scaling,
)
from fitting.bench.measurement import Figure, Measurement
from fitting.bench.sizes import Sizes
from fitting.inference.optimisation.search import find_best_fit
from fitting.problem.free_parameters import free_parameter
from fitting.problem.problem import Problem
from fitting.problem.space import make_space
from fitting.runtime import xla
from fitting.runtime.threads import usable_cores
from jaxik import presets
from support.clips import assert_close
from support.quick import TARGETS, residuals_of_scenes

SMALL = Sizes(
    repeats=2, legs=12, feet=12, characters=5, derived=3, frames=12, chunk=2,
    crowd_repeats=1, cells=8, rays=40, read=1 << 12, side=8, fits=1, walkers=40, steps=2,
    batches=(2, 8), lengths=(10, 20), grids=(3, 6), parameters=(2, 3), legs_each=(2, 3),
)  # fmt: skip
CALLS = "", ", program", ", Character"  # of a step


@pytest.fixture(autouse=True)
def short_samples(monkeypatch):
    """A sample is one call."""
    monkeypatch.setattr(measurement, "SAMPLE", 0.0)


@pytest.fixture(scope="module")
def legs():
    """Batches of legs are parts of this one, so that its pipeline is compiled once."""
    every = workloads.leg_batch(200)
    parts = every.rig, every.frame, every.sensed, every.target_ms

    def first(count: int) -> workloads.LegBatch:
        return workloads.LegBatch(every.ik, *jax.tree.map(lambda leaf: leaf[:count], parts))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(workloads, "leg_batch", first)
        yield every


def run_suite(name: str, sizes: Sizes = SMALL) -> runner.Report:
    """Runs the benchmark of the ceilings and this one."""
    benchmarks = suite.choose(suite.BENCHMARKS, name)
    return runner.run_benchmarks(benchmarks, sizes, True, lambda line: None)


def measure(name: str, **changes) -> Measurement:
    """Runs one benchmark at small sizes."""
    *_, timings = run_suite(name, dataclasses.replace(SMALL, **changes)).measurements
    assert timings.seconds > 0 and not timings.failures
    for figure in timings.figures:
        assert np.isfinite(figure.value), figure
        assert figure.limit is None or 0 < figure.limit < np.inf, figure
    return timings


def figures(timings: Measurement) -> dict[str, Figure]:
    """Figures of a measurement by what they are."""
    return {figure.what: figure for figure in timings.figures}


def test_the_ceilings_of_the_machine_are_its_best_runs():
    (timings,) = run_suite("machine").measurements
    assert set(timings.ceilings) == {"memory", "float32", "float64", "dispatch"}
    assert timings.ceilings["dispatch"] == min(timings.busy["dispatch"])
    assert timings.ceilings["float64"] == 2 * 8**3 * usable_cores() / min(timings.busy["float64"])


def test_import_times_do_not_include_that_of_jax(monkeypatch):
    commands = []
    monkeypatch.setattr(ceilings.subprocess, "run", lambda command, check: commands.append(command))
    timings = measure("start", repeats=1)
    seconds = {name: samples[0] for name, samples in timings.samples.items()}
    figure = figures(timings)["import jaxik, beyond jax's"]
    assert figure.value == seconds["jaxik"] - seconds["jax"] and figure.at_most == 0.3
    assert {command[-1] for command in commands} == {
        "import jax", "import jax, jaxik", "import jax, equinox", "import jax, jaxik; jaxik.run",
    }  # fmt: skip


def test_legs_and_feet_have_their_targets(legs, monkeypatch):
    monkeypatch.setattr(xla, "vector_bits", lambda: 256)
    timings = measure("legs")
    assert figures(timings)["a leg and core"].at_most == 45.0
    ratio = np.median(timings.samples["NumPy"]) / np.median(timings.samples["ours"])
    assert figures(timings)["NumPy's time in ours"].value == pytest.approx(ratio)
    assert figures(measure("feet"))["a leg and core"].at_most == 110.0


def test_the_leg_in_numpy_is_the_same_as_ours(legs):
    corrections = kernels.leg_corrections(legs.ik, legs.lanes)
    ours = [np.asarray(rotations)[0].T for rotations in corrections]
    theirs = baselines.two_bone(*kernels.numpy_arguments(legs))
    for our_rot, their_rot in zip(ours, theirs, strict=True):
        assert_close(np.abs(np.sum(our_rot * their_rot, axis=-1)), np.ones(200), 1e-4)
        assert np.ptp(our_rot[:, 0]) > 1e-3  # the legs differ


def test_rays_are_compared_with_embree_where_it_is_installed(monkeypatch):
    timings = measure("rays")
    assert "100.000 % of the rays" in timings.notes[0]
    first = "Embree, which triangle"
    ratio = np.median(timings.samples[first]) / np.median(timings.samples["ours"])
    assert figures(timings)[f"{first}: its time in ours"].value == pytest.approx(ratio)
    monkeypatch.setattr(kernels.mesh_files, "embree_tracer", lambda vertices, faces: None)
    timings = measure("rays")
    assert list(timings.samples) == ["ours"] and "not installed" in timings.notes[0]


def test_a_crowd_in_chunks_is_the_whole_crowd():
    def places(crowd, ground, member):
        ik, frames = crowd.character(member)
        return frames.world_from_model.pos + ik.pelvis.limit * ground.up_ws

    with jax.enable_x64(False):
        people = workloads.crowd(5, 24)
        flat = workloads.single(kernels.plane())
        timings = Measurement("crowd", "crowd", 1)
        parts = crowd.in_chunks(timings, "plane", places, crowd.CrowdScene(people, flat, 2))()
        parts = [jnp.moveaxis(part, -1, 0) for part in parts]  # members are last
        whole = jax.vmap(lambda member: places(people, flat, member))(people.members)
    first, second, last = parts
    assert_close([first, second, last], [whole[:2], whole[2:4], whole[3:]], 1e-5)
    assert np.abs(np.asarray(whole[0] - whole[1])).max() > 1e-3  # they differ
    assert timings.work["plane"].operations >= 3 * 2 * 24 * 3  # of all three chunks


def test_the_whole_pipeline_is_measured_for_a_crowd_in_reverse_and_by_frames(monkeypatch):
    """With something else in its place, as its programs take long to compile."""

    def outputs(ik, crowd, ground, frames):
        return (ik.leg.soften * frames.pose.ankle.pos + ground.up_ws,)

    monkeypatch.setattr(crowd, "_outputs", outputs)
    of_crowd = figures(measure("crowd"))
    wider = 1.0 / host.time_in_width()
    assert of_crowd["plane, leg-frames a second"].at_least == pytest.approx(9.0 * wider)
    assert of_crowd["mesh, leg-frames a second"].at_least == pytest.approx(5.0 * wider)
    assert of_crowd["peak of memory"].value > 50.0
    timings = measure("gradient")
    ratio = timings.samples["reverse"][0] / timings.samples["forward"][0]
    assert figures(timings)["reverse in forward runs"].value == pytest.approx(ratio)

    character = SimpleNamespace(step=lambda frame: None)
    monkeypatch.setattr(kernels.jaxik, "step", lambda ik, rig, ground, state, frame: frame.weight)
    monkeypatch.setattr(kernels.jaxik, "Character", lambda ik, rig, ground: character)
    timings = measure("step")
    assert figures(timings)["Character on a plane"].at_most == 150.0
    calls = {f"{ground}{call}" for ground in ("plane", "mesh") for call in CALLS}
    assert set(timings.work) == set(timings.samples) == calls


@pytest.mark.slow
@pytest.mark.parametrize("name", ["crowd", "step", "view"])
def test_a_benchmark_runs_with_the_whole_pipeline(name):
    assert measure(name).figures


def test_the_jacobian_is_measured_in_evaluations(small_problem):
    timings = measure("jacobian")
    for floats in ("float64", "float32"):
        rows, slopes = (
            np.median(timings.samples[f"{what}, {floats}"]) for what in ("rows", "slopes")
        )
        assert figures(timings)[f"in evaluations, {floats}"].value == pytest.approx(slopes / rows)


def test_the_fit_has_twenty_smooth_parameters_as_has_the_view():
    subject = live.subject(12)
    (take,), (system,) = subject.takes, subject.starts.values()
    assert take.base.fps == live.RATE and take.base.frame_count == 6
    assert system.leg is not None and subject.cost is not None
    problem = workloads.problem(12)
    assert problem.space.size == 20 and all(problem.space.smooth)
    count = max(bench_sizes.FULL.parameters)
    names = workloads.parameter_names(count)
    assert len(set(names)) == len(names) == count and set(problem.space.names) < set(names)


@pytest.fixture
def small_problem(monkeypatch):
    """A problem of two parameters, whose residuals compile at once."""

    def problem(frame_count: int, names: tuple[str, ...] = ()) -> Problem:
        ik = presets.record()
        return Problem(
            make_space(ik, [free_parameter(ik, n) for n in TARGETS]), (), residuals_of_scenes
        )

    monkeypatch.setattr(workloads, "TRUTH", TARGETS)
    monkeypatch.setattr(workloads, "problem", problem)


def test_a_fit_is_measured_warm_and_in_processes_of_its_own(small_problem, monkeypatch):
    processes = []

    def run(command, env, **options):
        processes.append((command[1:], env["JAX_COMPILATION_CACHE_DIR"], env["JAX_ENABLE_X64"]))
        assert cold_fit.load_clip(Path(command[-1], cold_fit.CLIPS[0])).frame_count == 12
        return cold_fit.subprocess.CompletedProcess(command, 0, "1.00\n")

    monkeypatch.setattr(cold_fit.subprocess, "run", run)
    timings = measure("fit")
    of_fit = figures(timings)
    assert of_fit["warm"].at_most == 2.0
    assert of_fit["cold, empty cache"].at_most == 20.0
    assert of_fit["cold, persistent cache"].at_most == 5.0
    (empty, empty_cache, x64), (full, full_cache, _) = processes
    assert empty == full and empty[:2] == ["-m", cold_fit.__name__]
    assert empty_cache == full_cache and x64 == "1"
    assert sum("cost" in figure.note for figure in timings.figures) == 3
    assert timings.samples["its search, empty cache"] == [1.0]


def test_a_posterior_is_sampled_for_all_its_steps(small_problem):
    timings = measure("posterior")
    (figure,) = timings.figures
    assert figure.met is None and figure.what == "40 walkers, 2 steps"
    assert figure.value == timings.samples["chain"][0]


def test_a_drag_is_measured_without_its_compilation(monkeypatch):
    systems = []
    ik, clip = presets.record(), workloads.walk(12)
    subject = SimpleNamespace(starts={live.DEFAULT: ik}, rig=clip.rig)
    solver = SimpleNamespace(solve=systems.append, take=SimpleNamespace(base=clip))
    monkeypatch.setattr(live, "subject", lambda frame_count: subject)
    monkeypatch.setattr(live, "Solver", lambda subject: solver)
    timings = measure("view")
    (figure,) = timings.figures
    assert figure.at_most == 100.0 and figure.unit == "ms"
    assert figure.value == pytest.approx(1e3 * np.median(timings.samples["drag"]))
    assert timings.compile_s["solve"] > 0
    first, *dragged = systems
    assert first is ik and len(dragged) == 2 + SMALL.repeats
    assert not any(eqx.tree_equal(ik, other) for other in dragged)


def test_scaling_has_a_curve_and_a_slope_for_each_size(small_problem, legs, tmp_path, monkeypatch):
    monkeypatch.setattr(scaling, "run", lambda ik, rig, ground, motion: 2 * motion.weight)
    measured = run_suite("scaling")
    timings = measured.measurements[-1]
    assert [series.size for series in timings.series] == [
        "legs in a batch", "frames", "legs of a character", "free parameters", "triangles",
    ]  # fmt: skip
    for series in timings.series:
        for name, seconds in series.seconds.items():
            assert len(seconds) == len(series.sizes) == 2
            figure = figures(timings)[f"{name} against {series.size}"]
            assert figure.value == pytest.approx(series.slope(name))
    numbers, curves = tmp_path / "bench.json", tmp_path / "bench.png"
    assert report.write(measured, numbers, curves) == [numbers, curves]
    assert curves.read_bytes().startswith(b"\x89PNG")


def test_an_interrupted_fit_adds_no_figure(small_problem, monkeypatch):
    def interrupted(problem, progress):
        return dataclasses.replace(find_best_fit(problem), interrupted=True)

    monkeypatch.setattr(inference, "find_best_fit", interrupted)
    measured = run_suite("fit")
    assert measured.interrupted and measured.measurements[-1].figures == []


def measured(what: str, count: int) -> dict[str, float]:
    """In place of a process of its own."""
    if (what, count) == ("clips", 20):
        raise subprocess.CalledProcessError(1, "many", stderr="Trace\nMemoryError: full")
    if (what, count) == ("clips", 40):
        raise KeyboardInterrupt
    return {"seconds": float(count), "cpu_seconds": 2.0 * count, "peak_mb": 300.0}


def test_many_leaves_out_what_takes_long_and_what_only_shares_cores(monkeypatch):
    monkeypatch.setattr(many, "_measured", measured)
    monkeypatch.setattr(many, "usable_cores", lambda: 2)
    sizes = dataclasses.replace(SMALL, devices=(1, 4, 5, 8), clips=(10, 20, 30), workers=(1, 2))
    many.many(timings := Measurement("many", "", 1), sizes)
    assert timings.notes[:2] == [
        "left out: 5, 8 devices, as two share each core already",
        "left out: 30 clips, as 20 failed",
    ]
    assert timings.failures == ["20 clips: MemoryError: full"]
    assert [series.sizes for series in timings.series] == [[1, 4], [10], [1, 2]]
    assert figures(timings)["8 fits, 2 workers: CPU time"].value == 4.0

    monkeypatch.setattr(many, "LONGEST", -1.0)
    many.many(slow := Measurement("many", "", 1), sizes)
    assert [series.sizes for series in slow.series] == [[1], [10], [1]]
    assert slow.notes[0] == "left out: 4, 5, 8 devices, as 1 took 0 s"


def test_many_keeps_what_was_measured_before_an_interrupt(monkeypatch, tmp_path):
    monkeypatch.setattr(many, "_measured", measured)
    monkeypatch.setattr(many, "usable_cores", lambda: 2)
    timings = run_suite("many", dataclasses.replace(SMALL, devices=(1, 2), clips=(40,)))
    assert timings.interrupted
    numbers, curves = tmp_path / "bench.json", tmp_path / "bench.png"
    assert report.write(timings, numbers, curves) == [numbers, curves]
    assert "4096 systems, 2 devices: peak of memory" in numbers.read_text()
