"""`jaxik bench`: how it measures, counts and reports; each benchmark runs at small sizes."""

import base64
import dataclasses
import json
import os
import subprocess
import time
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import Mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fitting.bench import baselines, benchmarks, measurement, processes, report, roofline, workloads
from fitting.bench.measurement import Benchmark, Figure, Measurement, Series
from fitting.bench.roofline import Work
from fitting.bench.workloads import Sizes
from fitting.cli import main
from fitting.clips.clip_frames import frames_from_clip
from fitting.codegen import toolchain
from fitting.codegen.crowd import NoKernelError
from fitting.inference.optimise.search import find_best_fit
from fitting.runtime import machine
from fitting.runtime.threads import usable_cores
from fitting.viewer import Tuning
from fitting.viewer.session import DEFAULT
from jaxik import presets
from jaxik.world.surfaces import Mesh
from support.clips import assert_close
from support.commands import refusal
from support.problems import problem_of
from support.quick import TARGETS, residuals_of_scenes


@pytest.fixture(autouse=True)
def short_samples(monkeypatch):
    monkeypatch.setattr(measurement, "SAMPLE", 0.0)


def test_a_figure_is_met_on_the_right_side_of_its_target_and_a_slope_is_a_power():
    def met(value, **target):
        return Figure("x", value, "s", **target).met

    assert met(2.0, at_most=2.0) and not met(2.1, at_most=2.0)
    assert met(3.0, at_least=3.0) and not met(2.9, at_least=3.0)
    assert met(1.0) is None
    sizes = [10, 100, 1000]
    for power in (0.5, 1.0, 2.0):
        curve = Series("size", sizes, {"a": [7.0, *(3.0 * size**power for size in sizes[1:])]})
        slopes = curve.slope("a", 2), curve.slope("a")
        assert slopes[0] == pytest.approx(power) and slopes[1] != pytest.approx(power)
    assert np.isnan(Series("size", [10], {"a": [1.0]}).slope("a"))


def test_calls_run_in_turns_in_random_order_and_compiling_is_timed_separately(monkeypatch):
    calls = []
    timings = Measurement("x", "x", 6)
    medians = timings.time_in_turns({name: lambda name=name: calls.append(name) for name in "ab"})
    timed = calls[4:]  # two of each warm up
    assert timed.count("a") == timed.count("b") == 6
    turns = {tuple(timed[i : i + 2]) for i in range(0, 12, 2)}
    assert turns == {("a", "b"), ("b", "a")}
    assert len(timings.samples["a"]) == 6
    assert medians == {name: np.median(samples) for name, samples in timings.samples.items()}
    calls.clear()

    def take_a_millisecond(call, count=1):
        for _ in range(count):
            call()
        return 1e-3, 1e-3

    monkeypatch.setattr(measurement, "SAMPLE", 0.1)
    monkeypatch.setattr(measurement, "time_calls", take_a_millisecond)
    Measurement("x", "x", 1).time_in_turns({"a": lambda: calls.append(0)})
    assert len(calls) == 2 + 100, "until its sample is long enough"
    timings = Measurement("x", "x", 1)
    call = timings.compile_call("twice", lambda x: 2 * x, jnp.arange(8.0, dtype=jnp.float32))
    np.testing.assert_array_equal(call(), 2 * np.arange(8.0))
    assert timings.compile_s["twice"] > 0 and timings.samples == {}
    assert timings.work["twice"].moved == 64.0 and timings.work["twice"].operations == 8.0


def test_peak_memory_counts_from_the_last_reset():
    if not machine.entry("self/status", "VmHWM"):
        pytest.skip("this system does not report peak memory, or not since a reset")
    large = np.ones(20_000_000)
    del large
    machine.reset_peak()
    before = measurement.peak_memory_mb()
    large = np.ones(10_000_000)
    assert measurement.peak_memory_mb() - before > 0.9 * large.nbytes / 1e6


def test_a_timing_has_its_spread_its_cpu_time_and_its_limit_and_so_has_a_ratio():
    ceilings = {"memory": 100.0, "float32": 1.0, "float64": 0.5, "dispatch": 0.01}
    timings = Measurement("x", "x", 3, "float32", ceilings=ceilings)
    timings.samples, timings.busy = {"a": [2.0, 1.0, 4.0]}, {"a": [2.0, 3.0, 6.0]}
    timings.work = {"a": Work(operations=0.5, moved=20.0)}
    timings.add_timing("a", "time", "ms", threads=2)
    timings.add_timing("a", "rate", "M", items=8e6, floats="float64")
    time, rate = timings.figures
    assert (time.value, time.spread, time.busy) == (2000.0, (1000.0, 4000.0), 1500.0)
    assert (time.limit, time.bound, time.closeness) == (500.0, "arithmetic", 0.25)
    assert (rate.value, rate.spread) == (4.0, (2.0, 8.0))
    assert (rate.limit, rate.closeness) == (8.0, 0.5)
    timings.samples = {"slow": [4.0, 9.0, 6.0], "fast": [2.0, 3.0, 1.0]}
    timings.add_ratio("slow", "fast", "slow in fast", at_least=3.0)
    ratio = timings.figures[-1]  # of the medians; its spread is that of the turns
    assert (ratio.value, ratio.spread, ratio.met) == (3.0, (2.0, 6.0), True)
    ceilings = {"memory": 100.0, "float32": 2.0, "float64": 1.0, "dispatch": 0.5}
    for work, *bound in (  # what takes longest
        (Work(1.0, 1000.0), 10.0, "memory"),
        (Work(8.0, 100.0), 4.0, "arithmetic"),
        (Work(0.0, 0.0), 0.5, "dispatch"),
    ):
        assert roofline.lower_bound(work, ceilings, "float32") == tuple(bound)


def counted(function, *arguments, sparse=()) -> Work:
    traced = jax.jit(function).trace(*arguments)
    return roofline.work_of_program(traced, traced.lower().compile(), sparse)


def test_operations_and_bytes_count_as_far_as_results_depend_on_them():
    x = jnp.ones(10)
    matrix = jnp.ones((3, 4))

    def looped(x):
        jnp.sin(x)  # no result depends on it
        return jax.lax.scan(lambda c, _: (c * c + 1.0, None), x, None, length=7)[0]

    def branched(x):
        return jax.lax.cond(x[0] > 0, lambda x: x + x, lambda x: jnp.exp(x) * x, x)

    assert counted(looped, x).operations == 7 * 2 * 10
    assert counted(branched, x).operations == 2 * 10
    assert counted(lambda m: m @ m.T, matrix).operations == 2 * 3 * 3 * 4
    assert counted(lambda n: n + n, jnp.arange(10)).operations == 0  # only floats count
    assert counted(jax.vmap(jnp.sum), matrix).operations == 12
    # A failure names a function whose operations a new version of JAX calls otherwise.
    for function in (jnp.add, jnp.arctan2, jnp.maximum):
        assert counted(function, x, x).operations == 10, function
    for function in (jnp.sqrt, jnp.sin, jnp.arccos, jnp.square, jnp.exp, jnp.sum):
        assert counted(function, x).operations == 10, function

    @jax.jit
    def called(x, y):
        return jnp.sin(x), jnp.exp(y) * y

    work = counted(lambda x, y: called(x, y)[0], jnp.ones(10), jnp.ones(1000))
    assert work.operations == 10 and work.moved == 2 * jnp.ones(10).nbytes
    x, unused, table = jnp.ones(10), jnp.ones(1000), jnp.ones(5000)
    work = counted(lambda x, unused, table: x + table[3], x, unused, table, sparse=table)
    assert work.moved == 2 * x.nbytes
    assert (work * 3).moved == 6 * x.nbytes and (work * 3).workspace == work.workspace


@pytest.fixture
def trivial_suite(monkeypatch):
    """Benchmarks that take no time: one measures, Ctrl-C interrupts one, and two fail."""

    def quick(timings: Measurement, sizes: Sizes) -> None:
        timings.time_in_turns({"ours": lambda: None, "theirs": lambda: None})
        timings.add_timing("ours", "ours", at_most=1.0)
        timings.add("a ratio", 2.0, "times", at_least=3.0, note="of nothing")
        timings.series.append(Series("size", [1, 10], {"ours": [1.0, 10.0]}))

    def stopped(timings: Measurement, sizes: Sizes) -> None:
        timings.add("before", 1.0, "s")
        raise KeyboardInterrupt

    child = measurement.subprocess.CalledProcessError(
        1, "python", stderr="Traceback\nKeyError: 'a'\n"
    )
    rows = {
        "full": Benchmark("a row that fails", "", Mock(side_effect=MemoryError)),
        "child": Benchmark("a row whose process fails", "", Mock(side_effect=child)),
        "quick": Benchmark("a quick row", "float32", quick),
        "stopped": Benchmark("a row that is stopped", "float64", stopped, True),
        "never": Benchmark("a row after that", "float32", quick),
    }
    monkeypatch.setattr(benchmarks, "BENCHMARKS", rows)


def test_the_command_prints_a_table_with_the_hardware_and_its_json_is_complete(
    trivial_suite, tmp_path, capsys
):
    assert main.main(["bench", "--quick", "--only", "quick"]) == 0
    output = capsys.readouterr()
    assert f"JAX {jax.__version__}" in output.out and "threads used" in output.out
    assert "load average" in output.out and "XLA flags: " in output.out
    assert "Quick: smaller sizes" in output.out
    ours, ratio = (line for line in output.out.splitlines() if line.startswith("quick "))
    assert ours.endswith("yes") and "≤ 1" in ours and " to " in ours
    assert ratio.split() == ["quick", "a", "ratio", "2", "times", "≥", "3", "no"]
    assert "quick: a ratio: of nothing" in output.out
    assert "[1/1] quick: a quick row" in output.err
    numbers = tmp_path / "bench.json"
    assert main.main(["bench", "--only", "quick", "--json", str(numbers)]) == 0
    assert str(numbers) in capsys.readouterr().out and (tmp_path / "bench.png").is_file()
    content = json.loads(numbers.read_text())
    assert not content["quick"] and not content["interrupted"]
    assert set(content["machine"]) == {*measurement.hardware(), "load"}
    assert len(content["machine"]["load"]) == 2  # at the start and at the end
    assert (None in content["machine"]["load"]) != hasattr(os, "getloadavg")
    (row,) = content["rows"]
    assert row["name"] == "quick" and row["floats"] == "float32"
    assert [figure["met"] for figure in row["figures"]] == [True, False]
    samples = row["samples"]
    assert set(samples) == {"ours", "theirs"} and len(samples["ours"]) == workloads.FULL.repeats
    assert row["medians"] == {name: np.median(each) for name, each in samples.items()}
    assert row["series"][0]["slopes"] == {"ours": pytest.approx(1.0)}
    timings = Measurement("x", "x", 1, load=np.nan)  # what is not finite is null
    timings.add("memory", np.nan, "MB", limit=np.inf)
    (row,) = json.loads(report.to_json(measurement.Report(False, [timings])))["rows"]
    assert row["figures"][0]["value"] is row["figures"][0]["limit"] is row["load"] is None


def test_failures_are_told_and_an_interrupt_prints_and_writes_what_was_measured(
    trivial_suite, tmp_path, capsys
):
    numbers = tmp_path / "bench.json"
    assert main.main(["bench", "--json", str(numbers)]) == main.INTERRUPTED
    output = capsys.readouterr()
    assert "Interrupted: this is what" in output.out and "before" in output.out
    content = json.loads(numbers.read_text())
    assert content["interrupted"]
    assert [row["name"] for row in content["rows"]] == ["full", "child", "quick", "stopped"]
    for row, message in (("full", "failed: MemoryError"), ("child", "KeyError: 'a'")):
        note = next(line for line in output.out.splitlines() if line.startswith(f"{row}: failed"))
        assert message in note and message in output.err


def test_a_mistake_in_the_options_is_reported_before_anything_is_measured(
    capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    for options, message in (
        ("--only legs,wings", "no rows named ['wings']; there are ['machine', 'start', 'legs'"),
        ("--only ,", "wanted names of rows"),
        ("--plot curves.svg", "curves.svg: wanted a name that ends in .png"),
        ("--json nowhere/bench.json", "there is no folder nowhere"),
    ):
        assert message in refusal(["bench", *options.split()], tmp_path, capsys)


def test_a_quick_run_has_smaller_sizes_and_no_long_benchmarks_unless_they_are_named():
    for field in dataclasses.fields(Sizes):
        quick, full = (getattr(values, field.name) for values in (workloads.QUICK, workloads.FULL))
        if isinstance(full, tuple):
            quick, full = sorted(quick), sorted(full)
        assert quick <= full or quick[-1] <= full[-1], field.name
    rows = benchmarks.BENCHMARKS
    left_out = set(rows) - set(benchmarks.choose(rows, None, quick=True))
    assert left_out == {"clips", "first", "fit", "many", "scaling"}
    assert list(benchmarks.choose(rows, "fit", quick=True)) == ["machine", "fit"]
    assert list(benchmarks.choose(rows, None)) == list(rows)


# Each benchmark at small sizes

SMALL = Sizes(
    repeats=2, legs=12, feet=12, characters=5, derived=3, frames=12, chunk=2,
    crowd_repeats=1, cells=8, rays=40, read=1 << 12, side=8, fits=1, walkers=40, steps=2,
    batches=(2, 8), lengths=(10, 20), grids=(3, 6), parameters=(2, 3), legs_each=(2, 3),
)  # fmt: skip
CALLS = "", ", program", ", Character"  # of a step


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


def run_suite(name: str, sizes: Sizes = SMALL) -> measurement.Report:
    """Runs the benchmark of the ceilings and this one."""
    rows = benchmarks.choose(benchmarks.BENCHMARKS, name)
    return measurement.run_benchmarks(rows, sizes, True, lambda line: None)


def measure(name: str, **changes) -> Measurement:
    *_, timings = run_suite(name, dataclasses.replace(SMALL, **changes)).measurements
    assert timings.seconds > 0 and not timings.failures
    for figure in timings.figures:
        assert np.isfinite(figure.value), figure
        assert figure.limit is None or 0 < figure.limit < np.inf, figure
    return timings


def figures(timings: Measurement) -> dict[str, Figure]:
    return {figure.what: figure for figure in timings.figures}


def test_the_ceilings_of_the_machine_are_its_best_runs():
    (timings,) = run_suite("machine").measurements
    assert set(timings.ceilings) == {"memory", "float32", "float64", "dispatch"}
    assert timings.ceilings["dispatch"] == min(timings.busy["dispatch"])
    assert timings.ceilings["float64"] == 2 * 8**3 * usable_cores() / min(timings.busy["float64"])


def test_import_times_do_not_include_that_of_jax(monkeypatch):
    commands = []
    monkeypatch.setattr(
        benchmarks.subprocess, "run", lambda command, check: commands.append(command)
    )
    timings = measure("start", repeats=1)
    seconds = {name: samples[0] for name, samples in timings.samples.items()}
    figure = figures(timings)["import jaxik, beyond jax's"]
    assert figure.value == seconds["jaxik"] - seconds["jax"] and figure.at_most == 0.3
    assert {command[-1] for command in commands} == {
        "import jax", "import jax, jaxik", "import jax, equinox", "import jax, jaxik; jaxik.run",
    }  # fmt: skip


@pytest.mark.slow
def test_legs_and_feet_have_their_targets_and_the_leg_in_numpy_is_the_same(legs, monkeypatch):
    monkeypatch.setattr(machine, "vector_bits", lambda: 256)
    timings = measure("legs")
    assert figures(timings)["a leg and core"].at_most == 45.0
    ratio = np.median(timings.samples["NumPy"]) / np.median(timings.samples["ours"])
    assert figures(timings)["NumPy's time in ours"].value == pytest.approx(ratio)
    assert figures(measure("feet"))["a leg and core"].at_most == 110.0
    corrections = benchmarks.leg_corrections(legs.ik, legs.lanes)
    ours = [np.asarray(rotations)[0].T for rotations in corrections]
    theirs = baselines.two_bone(*baselines.numpy_arguments(legs))
    for our_rot, their_rot in zip(ours, theirs, strict=True):
        assert_close(np.abs(np.sum(our_rot * their_rot, axis=-1)), np.ones(200), 1e-4)
        assert np.ptp(our_rot[:, 0]) > 1e-3  # the legs differ


@pytest.mark.slow
def test_exported_systems_have_their_time_their_size_and_their_targets(monkeypatch):
    monkeypatch.setattr(toolchain, "FLAGS", ("-O0",))
    if toolchain.compiler() is None:
        pytest.skip("needs a compiler of C: none in $CC, no cc")
    timings = measure("export", exported=("unreal",))
    rows = figures(timings)
    assert list(rows) == [f"unreal: {what}" for what in (
        "generate", "compile", "machine code", "a frame",
    )]  # fmt: skip
    assert (
        rows["unreal: machine code"].at_most == 300.0
        and "rays of each round: 12, 12" in rows["unreal: a frame"].note
    )
    monkeypatch.setattr(toolchain, "compiler", lambda: None)
    timings = measure("export")
    assert not timings.figures and "no C compiler" in timings.notes[0]


def test_rays_are_compared_with_embree_where_it_is_installed(monkeypatch):
    timings = measure("rays")
    assert "100.000 % of the rays" in timings.notes[0]
    first = "Embree, which triangle"
    ratio = np.median(timings.samples[first]) / np.median(timings.samples["ours"])
    assert figures(timings)[f"{first}: its time in ours"].value == pytest.approx(ratio)
    monkeypatch.setattr(benchmarks.meshes, "embree_tracer", lambda vertices, faces: None)
    timings = measure("rays")
    assert list(timings.samples) == ["ours"] and "not installed" in timings.notes[0]


def test_legs_of_a_character_are_repeated_in_its_rig_and_in_its_frames():
    clip = workloads.walk(4)
    rig, motion = workloads.with_legs(clip.rig, frames_from_clip(clip), 5)
    assert rig.side.tolist() == [1.0, -1.0, 1.0, -1.0, 1.0] and len(set(rig.names)) == 5
    ankles = np.asarray(motion.pose.ankle.pos)
    assert ankles.shape == (4, 5, 3) and motion.dt.shape == (4,)
    np.testing.assert_array_equal(ankles[:, 2:], ankles[:, :3])


def test_a_crowd_in_chunks_is_the_whole_crowd():
    def places(crowd, ground, member):
        ik, frames = crowd.character(member)
        return frames.world_from_model.pos + ik.pelvis.limit * ground.up_ws

    with jax.enable_x64(False):
        people = workloads.crowd(5, 24)
        flat = workloads.single(benchmarks.plane())
        timings = Measurement("crowd", "crowd", 1)
        parts = benchmarks.in_chunks(timings, "plane", places, people, flat, 2)()
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

    def by_kernel(crowd, ground, size):
        if isinstance(ground.surfaces[0], Mesh):
            raise NoKernelError("the system has a loop")
        return (lambda: time.sleep(1e-4)), "C, 8 lanes"

    monkeypatch.setattr(benchmarks, "_outputs", outputs)
    monkeypatch.setattr(benchmarks.baselines, "by_kernel", by_kernel)
    timings = measure("crowd")
    of_crowd = figures(timings)
    assert of_crowd["heights by C, 8 lanes: leg-frames a second"].value > 0.0
    assert of_crowd["plane: JAX's CPU time in that of C"].at_least == 3.0
    assert "mesh by JAX only: the system has a loop" in timings.notes
    wider = 1.0 / measurement.time_in_width()
    assert of_crowd["plane, leg-frames a second"].at_least == pytest.approx(9.0 * wider)
    assert of_crowd["mesh, leg-frames a second"].at_least == pytest.approx(5.0 * wider)
    assert of_crowd["peak of memory"].value > 50.0
    timings = measure("gradient")
    ratio = timings.samples["reverse"][0] / timings.samples["forward"][0]
    assert figures(timings)["reverse in forward runs"].value == pytest.approx(ratio)

    character = SimpleNamespace(step=lambda frame: None)
    monkeypatch.setattr(
        benchmarks.jaxik, "step", lambda ik, rig, ground, state, frame: frame.weight
    )
    monkeypatch.setattr(benchmarks.jaxik, "Character", lambda ik, rig, ground: character)
    timings = measure("step")
    assert figures(timings)["Character on a plane"].at_most == 150.0
    calls = {f"{ground}{call}" for ground in ("plane", "mesh") for call in CALLS}
    assert set(timings.work) == set(timings.samples) == calls


@pytest.mark.slow
@pytest.mark.parametrize("name", ["crowd", "step", "view"])
def test_a_benchmark_runs_with_the_whole_pipeline(name):
    assert measure(name).figures


@pytest.mark.slow
def test_the_fit_has_twenty_smooth_parameters_as_has_the_view():
    session = benchmarks.viewed_walk(12)
    (clip,), (system,) = session.clips, session.starts.values()
    assert clip.animation.clip.fps == benchmarks.RATE and clip.animation.clip.frame_count == 6
    assert system.leg is not None and session.cost is not None
    problem = workloads.problem(16)
    assert problem.space.size == 20 and all(problem.space.smooth)
    count = max(workloads.FULL.parameters)
    names = workloads.parameter_names(count)
    assert len(set(names)) == len(names) == count and set(problem.space.names) < set(names)


@pytest.fixture
def small_problem(monkeypatch):
    """A problem of two parameters, whose residuals compile at once."""

    def problem(frame_count: int, names: tuple[str, ...] = ()):
        return problem_of(presets.record(), list(TARGETS), (), residuals_of_scenes)

    monkeypatch.setattr(workloads, "TRUTH", TARGETS)
    monkeypatch.setattr(workloads, "problem", problem)


@pytest.mark.slow
def test_a_fit_is_measured_warm_and_in_processes_of_its_own_unless_it_is_interrupted(
    small_problem, monkeypatch
):
    commands = []

    def run(command, env, **options):
        commands.append((command[1:], env["JAX_COMPILATION_CACHE_DIR"], env["JAX_ENABLE_X64"]))
        (folder,) = json.loads(command[-1])
        assert workloads.load_recording(folder).reference.frame_count == 12
        return subprocess.CompletedProcess(command, 0, "\n1.00\n")

    monkeypatch.setattr(subprocess, "run", run)
    timings = measure("fit")
    of_fit = figures(timings)
    assert of_fit["warm"].at_most == 2.0
    assert of_fit["cold, empty cache"].at_most == 20.0
    assert of_fit["cold, persistent cache"].at_most == 5.0
    (empty, empty_cache, x64), (full, full_cache, _) = commands
    assert empty == full and processes.__name__ in empty[1]
    assert empty_cache == full_cache and x64 == "1"
    assert sum("cost" in figure.note for figure in timings.figures) == 3
    assert timings.samples["its search, empty cache"] == [1.0]
    assert set(measure("fit", cold=False).samples) == {"ours", "SciPy with our slopes"}

    def interrupted(problem):
        return dataclasses.replace(find_best_fit(problem), interrupted=True)

    monkeypatch.setattr(benchmarks, "find_best_fit", interrupted)
    stopped = run_suite("fit")
    assert stopped.interrupted and stopped.measurements[-1].figures == []


def test_the_jacobian_is_measured_in_evaluations_and_a_posterior_for_all_its_steps(small_problem):
    timings = measure("jacobian")
    for floats in ("float64", "float32"):
        rows, slopes = (
            np.median(timings.samples[f"{what}, {floats}"]) for what in ("rows", "slopes")
        )
        assert figures(timings)[f"in evaluations, {floats}"].value == pytest.approx(slopes / rows)
    timings = measure("posterior")
    (figure,) = timings.figures
    assert figure.met is None and figure.what == "40 walkers, 2 steps"
    assert figure.value == timings.samples["chain"][0]


def test_a_drag_is_measured_without_its_compilation_and_pages_by_their_size(monkeypatch):
    requests = []
    ik, clip = presets.record(), workloads.walk(12)
    animation = SimpleNamespace(clip=clip)
    session = SimpleNamespace(
        starts={DEFAULT: ik}, rig=clip.rig, free=(), clips=[SimpleNamespace(animation=animation)]
    )
    viewer = SimpleNamespace(
        tuning=Tuning(cast(Any, session)),
        clip=int,
        solve=requests.append,
        page=lambda wait: "a" * 2_000_000,
    )
    monkeypatch.setattr(benchmarks, "viewed_walk", lambda frame_count: session)
    monkeypatch.setattr(benchmarks, "Viewer", lambda session, folder: viewer)
    timings = measure("view")
    figure, *pages = timings.figures
    assert figure.at_most == 50.0 and figure.unit == "ms"
    assert figure.value == pytest.approx(1e3 * np.median(timings.samples["drag"]))
    assert [page.value for page in pages] == [2.0, 2.0] and pages[0].at_most == 8.0
    assert timings.compile_s["solve"] > 0 and len(requests) == 2 + SMALL.repeats
    own = viewer.tuning.numbers(ik)
    for request in requests:
        moved = np.frombuffer(base64.b64decode(request["values"]))
        assert (moved != own).sum() == 1


@pytest.mark.slow
def test_scaling_has_a_curve_and_a_slope_for_each_size(small_problem, legs, tmp_path, monkeypatch):
    monkeypatch.setattr(
        benchmarks, "run_character", lambda ik, rig, ground, motion: 2 * motion.weight
    )
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


def measured(what: str, count: int) -> dict[str, float]:
    """In place of a process of its own."""
    if (what, count) == ("clips", 20):
        raise subprocess.CalledProcessError(1, "many", stderr="Trace\nMemoryError: full")
    if (what, count) == ("clips", 40):
        raise KeyboardInterrupt
    return {"seconds": float(count), "cpu_seconds": 2.0 * count, "peak_mb": 300.0}


def test_many_leaves_out_what_takes_long_and_what_only_shares_cores(monkeypatch):
    monkeypatch.setattr(benchmarks, "_measured", measured)
    monkeypatch.setattr(benchmarks, "usable_cores", lambda: 2)
    sizes = dataclasses.replace(SMALL, devices=(1, 4, 5, 8), clips=(10, 20, 30), workers=(1, 2))
    benchmarks.many(timings := Measurement("many", "", 1), sizes)
    assert timings.notes[:2] == [
        "left out: 5, 8 devices, as two share each core already",
        "left out: 30 clips, as 20 failed",
    ]
    assert timings.failures == ["20 clips: MemoryError: full"]
    assert [series.sizes for series in timings.series] == [[1, 4], [10], [1, 2]]
    assert figures(timings)["8 fits, 2 workers: CPU time"].value == 4.0

    monkeypatch.setattr(benchmarks, "LONGEST", -1.0)
    benchmarks.many(slow := Measurement("many", "", 1), sizes)
    assert [series.sizes for series in slow.series] == [[1], [10], [1]]
    assert slow.notes[0] == "left out: 4, 5, 8 devices, as 1 took 0 s"


def test_many_keeps_what_was_measured_before_an_interrupt(monkeypatch, tmp_path):
    monkeypatch.setattr(benchmarks, "_measured", measured)
    monkeypatch.setattr(benchmarks, "usable_cores", lambda: 2)
    timings = run_suite("many", dataclasses.replace(SMALL, devices=(1, 2), clips=(40,)))
    assert timings.interrupted
    numbers, curves = tmp_path / "bench.json", tmp_path / "bench.png"
    assert report.write(timings, numbers, curves) == [numbers, curves]
    assert "4096 systems, 2 devices: peak of memory" in numbers.read_text()
