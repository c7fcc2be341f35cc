"""`jaxik bench`: how it measures, counts operations and reports."""

import dataclasses
import json
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fitting.bench import host, measurement, report, roofline, runner, sizes, suite
from fitting.bench.measurement import Figure, FigureSpec, Measurement, Series
from fitting.bench.roofline import Work
from fitting.bench.runner import Benchmark
from fitting.bench.sizes import Sizes
from fitting.cli import main


def test_a_figure_is_met_on_the_right_side_of_its_target():
    def met(value, **target):
        return Figure("x", value, "s", **target).met

    assert met(2.0, at_most=2.0) and not met(2.1, at_most=2.0)
    assert met(3.0, at_least=3.0) and not met(2.9, at_least=3.0)
    assert met(1.0) is None


@pytest.mark.parametrize("power", [0.5, 1.0, 2.0])
def test_a_slope_is_the_power_with_which_time_grows(power):
    sizes = [10, 100, 1000]
    curve = Series("size", sizes, {"a": [7.0, *(3.0 * size**power for size in sizes[1:])]})
    assert curve.slope("a", 2) == pytest.approx(power) and curve.slope("a") != pytest.approx(power)
    assert np.isnan(Series("size", [10], {"a": [1.0]}).slope("a"))


def test_calls_run_in_turns_in_random_order(monkeypatch):
    monkeypatch.setattr(measurement, "SAMPLE", 0.0)
    calls = []
    timings = Measurement("x", "x", 6)
    medians = timings.time_in_turns({name: lambda name=name: calls.append(name) for name in "ab"})
    timed = calls[4:]  # two of each warm up
    assert timed.count("a") == timed.count("b") == 6
    turns = {tuple(timed[i : i + 2]) for i in range(0, 12, 2)}
    assert turns == {("a", "b"), ("b", "a")}
    assert len(timings.samples["a"]) == 6
    assert medians == {name: np.median(samples) for name, samples in timings.samples.items()}


def test_a_fast_call_is_repeated_until_its_sample_is_long_enough():
    calls = []
    Measurement("x", "x", 1).time_in_turns({"a": lambda: calls.append(0)})
    assert len(calls) > 100


def test_compiling_is_timed_separately_from_running():
    timings = Measurement("x", "x", 1)
    call = timings.compile_call("twice", lambda x: 2 * x, jnp.arange(8.0, dtype=jnp.float32))
    np.testing.assert_array_equal(call(), 2 * np.arange(8.0))
    assert timings.compile_s["twice"] > 0 and timings.samples == {}
    assert timings.work["twice"].moved == 64.0 and timings.work["twice"].operations == 8.0


def test_peak_memory_counts_from_the_last_reset():
    if np.isnan(host.peak_memory_mb()):
        pytest.skip("this system does not report peak memory")
    large = np.ones(20_000_000)
    del large
    host.reset_peak_memory()
    before = host.peak_memory_mb()
    large = np.ones(10_000_000)
    assert host.peak_memory_mb() - before > 0.9 * large.nbytes / 1e6


def test_a_timing_has_its_spread_its_cpu_time_and_its_limit():
    ceilings = {"memory": 100.0, "float32": 1.0, "float64": 0.5, "dispatch": 0.01}
    timings = Measurement("x", "x", 3, "float32", ceilings=ceilings)
    timings.samples, timings.busy = {"a": [2.0, 1.0, 4.0]}, {"a": [2.0, 3.0, 6.0]}
    timings.work = {"a": Work(operations=0.5, moved=20.0)}
    timings.add_timing("a", FigureSpec(what="time", unit="ms", scale=1e3, threads=2))
    timings.add_timing(
        "a", FigureSpec(what="rate", unit="M", scale=8.0, rate=True, floats="float64")
    )
    time, rate = timings.figures
    assert (time.value, time.spread, time.busy) == (2000.0, (1000.0, 4000.0), 1500.0)
    assert (time.limit, time.bound, time.closeness) == (500.0, "arithmetic", 0.25)
    assert (rate.value, rate.spread) == (4.0, (2.0, 8.0))
    assert (rate.limit, rate.closeness) == (8.0, 0.5)


def test_a_ratio_is_that_of_the_medians_and_its_spread_that_of_the_turns():
    timings = Measurement("x", "x", 3)
    timings.samples = {"slow": [4.0, 9.0, 6.0], "fast": [2.0, 3.0, 1.0]}
    timings.add_ratio("slow", "fast", FigureSpec(what="slow in fast", at_least=3.0))
    (figure,) = timings.figures
    assert (figure.value, figure.spread, figure.met) == (3.0, (2.0, 6.0), True)


def test_the_bound_is_what_takes_longest():
    ceilings = {"memory": 100.0, "float32": 2.0, "float64": 1.0, "dispatch": 0.5}
    for work, *expected in (
        (Work(1.0, 1000.0), 10.0, "memory"),
        (Work(8.0, 100.0), 4.0, "arithmetic"),
        (Work(0.0, 0.0), 0.5, "dispatch"),
    ):
        assert roofline.lower_bound(work, ceilings, "float32") == tuple(expected)


def counted(function, *arguments, sparse=()) -> Work:
    traced = jax.jit(function).trace(*arguments)
    return roofline.work_of_program(traced, traced.lower().compile(), sparse)


def test_operations_count_in_loops_and_branches_unless_no_result_depends_on_them():
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


def test_the_names_that_jax_does_not_promise_are_still_these():
    """A failure names a function whose operations a new version of JAX calls otherwise."""
    x = jnp.ones(10)
    for function in (jnp.add, jnp.arctan2, jnp.maximum):
        assert counted(function, x, x).operations == 10, function
    for function in (jnp.sqrt, jnp.sin, jnp.arccos, jnp.square, jnp.exp, jnp.sum):
        assert counted(function, x).operations == 10, function


def test_a_called_program_counts_as_far_as_its_results_are_used():
    @jax.jit
    def called(x, y):
        return jnp.sin(x), jnp.exp(y) * y

    work = counted(lambda x, y: called(x, y)[0], jnp.ones(10), jnp.ones(1000))
    assert work.operations == 10
    assert work.moved == 2 * jnp.ones(10).nbytes


def test_bytes_are_those_that_a_run_has_to_read_and_write():
    x, unused, table = jnp.ones(10), jnp.ones(1000), jnp.ones(5000)
    work = counted(lambda x, unused, table: x + table[3], x, unused, table, sparse=table)
    assert work.moved == 2 * x.nbytes
    assert (work * 3).moved == 6 * x.nbytes and (work * 3).workspace == work.workspace


@pytest.fixture
def trivial_suite(monkeypatch):
    """Benchmarks that take no time: one measures, Ctrl-C interrupts one, and two fail."""

    def quick(timings: Measurement, sizes: Sizes) -> None:
        timings.time_in_turns({"ours": lambda: None, "theirs": lambda: None})
        timings.add_timing("ours", FigureSpec(what="ours", unit="s", at_most=1.0))
        timings.add(Figure("a ratio", 2.0, "times", at_least=3.0, note="of nothing"))
        timings.series.append(Series("size", [1, 10], {"ours": [1.0, 10.0]}))

    def stopped(timings: Measurement, sizes: Sizes) -> None:
        timings.add(Figure("before", 1.0, "s"))
        raise KeyboardInterrupt

    def failing(error: Exception) -> Callable[[Measurement, Sizes], None]:
        def fail(timings: Measurement, sizes: Sizes) -> None:
            raise error

        return fail

    child = runner.subprocess.CalledProcessError(1, "python", stderr="Traceback\nKeyError: 'a'\n")
    benchmarks = {
        "full": Benchmark("a row that fails", "", failing(MemoryError())),
        "child": Benchmark("a row whose process fails", "", failing(child)),
        "quick": Benchmark("a quick row", "float32", quick),
        "stopped": Benchmark("a row that is stopped", "float64", stopped, True),
        "never": Benchmark("a row after that", "float32", quick),
    }
    monkeypatch.setattr(suite, "BENCHMARKS", benchmarks)
    monkeypatch.setattr(measurement, "SAMPLE", 0.0)


def test_the_command_prints_a_table_with_the_hardware(trivial_suite, capsys):
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


def test_the_json_is_complete(trivial_suite, tmp_path, capsys):
    numbers = tmp_path / "bench.json"
    assert main.main(["bench", "--only", "quick", "--json", str(numbers)]) == 0
    content = json.loads(numbers.read_text())
    assert not content["quick"] and not content["interrupted"]
    assert set(content["machine"]) == {*host.Hardware.__annotations__, "load"}
    assert len(content["machine"]["load"]) == 2  # at the start and at the end
    (row,) = content["rows"]
    assert row["name"] == "quick" and row["floats"] == "float32"
    assert [figure["met"] for figure in row["figures"]] == [True, False]
    samples = row["samples"]
    assert set(samples) == {"ours", "theirs"} and len(samples["ours"]) == sizes.FULL.repeats
    assert row["medians"] == {name: np.median(each) for name, each in samples.items()}
    assert row["series"][0]["slopes"] == {"ours": pytest.approx(1.0)}
    assert (tmp_path / "bench.png").is_file()
    assert str(numbers) in capsys.readouterr().out


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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--only legs,wings", "no rows named ['wings']; there are ['machine', 'start', 'legs'"),
        ("--only ,", "wanted names of rows"),
        ("--plot curves.svg", "curves.svg: wanted a name that ends in .png"),
        ("--json nowhere/bench.json", "there is no folder nowhere"),
    ],
)
def test_a_mistake_in_the_options_is_reported_before_anything_is_measured(
    options, message, capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert main.main(["bench", *options.split()]) == main.MISTAKE
    output = capsys.readouterr()
    assert message in output.err and "[1/" not in output.err and not list(tmp_path.iterdir())


def test_quick_sizes_are_no_larger_than_the_full_ones():
    for field in dataclasses.fields(Sizes):
        quick, full = (getattr(values, field.name) for values in (sizes.QUICK, sizes.FULL))
        if isinstance(full, tuple):
            quick, full = sorted(quick), sorted(full)
        assert quick <= full or quick[-1] <= full[-1], field.name


def test_a_quick_run_leaves_out_long_benchmarks_unless_they_are_named():
    benchmarks = suite.BENCHMARKS
    left_out = set(benchmarks) - set(suite.choose(benchmarks, None, quick=True))
    assert left_out == {"clips", "first", "fit", "many", "scaling"}
    assert list(suite.choose(benchmarks, "fit", quick=True)) == ["machine", "fit"]
    assert list(suite.choose(benchmarks, None)) == list(benchmarks)


def test_numbers_that_are_not_finite_become_null_in_the_json():
    timings = Measurement("x", "x", 1, load=float("nan"))
    timings.add(Figure("memory", float("nan"), "MB", limit=float("inf")))
    content = json.loads(report.to_json(runner.Report(False, [timings])))
    (row,) = content["rows"]
    assert row["figures"][0]["value"] is None and row["figures"][0]["limit"] is None
    assert row["load"] is None
