"""`jaxik bench`: what it counts and what it tells."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fitting.bench import limits, measure, report
from fitting.bench import tasks as bench_tasks
from fitting.bench.setup import Sizes
from fitting.cli import main


def test_a_median_is_the_middle_run_of_each():
    assert measure.medians({"a": [3.0, 1.0, 2.0], "b": [1.0, 9.0]}) == {"a": 2.0, "b": 5.0}


def test_a_figure_is_met_on_the_right_side_of_its_reach():
    def met(value, **reach):
        return measure.Figure("x", value, "s", **reach).met

    assert met(2.0, at_most=2.0) and not met(2.1, at_most=2.0)
    assert met(3.0, at_least=3.0) and not met(2.9, at_least=3.0)
    assert met(1.0) is None


@pytest.mark.parametrize("power", [0.5, 1.0, 2.0])
def test_a_slope_is_the_power_with_which_time_grows(power):
    sizes = [10, 100, 1000]
    curve = measure.Series("size", sizes, {"a": [7.0, *(3.0 * size**power for size in sizes[1:])]})
    assert curve.slope("a", 2) == pytest.approx(power) and curve.slope("a") != pytest.approx(power)
    assert np.isnan(measure.Series("size", [10], {"a": [1.0]}).slope("a"))


def test_what_races_runs_as_often_as_asked_in_an_order_that_changes(monkeypatch):
    monkeypatch.setattr(measure, "SAMPLE", 0.0)
    ran = []
    row = measure.Row("x", "x", 6)
    took = row.race({name: lambda name=name: ran.append(name) for name in "ab"})
    timed = ran[4:]  # two of each warm up
    assert timed.count("a") == timed.count("b") == 6
    turns = {tuple(timed[i : i + 2]) for i in range(0, 12, 2)}
    assert turns == {("a", "b"), ("b", "a")}
    assert took == measure.medians(row.samples) and len(row.samples["a"]) == 6


def test_a_quick_call_is_made_often_enough_for_the_clock():
    calls = []
    measure.Row("x", "x", 1).race({"a": lambda: calls.append(0)})
    assert len(calls) > 100


def test_compiling_is_timed_apart_from_running():
    row = measure.Row("x", "x", 1)
    call = row.compiled("twice", lambda x: 2 * x, jnp.arange(8.0, dtype=jnp.float32))
    np.testing.assert_array_equal(call(), 2 * np.arange(8.0))
    assert row.compile_s["twice"] > 0 and row.samples == {}
    assert row.work["twice"].moved == 64.0 and row.work["twice"].operations == 8.0


def test_the_peak_of_memory_is_that_since_it_was_forgotten():
    if np.isnan(measure.peak_mb()):
        pytest.skip("this system does not tell")
    large = np.ones(40_000_000)
    del large
    measure.reset_peak()
    before = measure.peak_mb()
    large = np.ones(20_000_000)
    assert measure.peak_mb() - before > 0.9 * large.nbytes / 1e6


def test_a_figure_tells_its_spread_its_time_of_cpu_and_its_limit():
    ceilings = {"memory": 100.0, "float32": 1.0, "float64": 0.5, "dispatch": 0.01}
    row = measure.Row("x", "x", 3, "float32", ceilings=ceilings)
    row.samples, row.busy = {"a": [2.0, 1.0, 4.0]}, {"a": [2.0, 3.0, 6.0]}
    row.work = {"a": limits.Work(operations=0.5, moved=20.0)}
    row.timed("time", "a", "ms", 1e3, threads=2)
    row.timed("rate", "a", "M", 8.0, rate=True, floats="float64")
    time, rate = row.figures
    assert (time.value, time.spread, time.busy) == (2000.0, (1000.0, 4000.0), 1500.0)
    assert (time.limit, time.bound, time.closeness) == (500.0, "arithmetic", 0.25)
    assert (rate.value, rate.spread) == (4.0, (2.0, 8.0))
    assert (rate.limit, rate.closeness) == (8.0, 0.5)


def test_a_ratio_is_that_of_medians_and_its_spread_that_of_the_turns():
    row = measure.Row("x", "x", 3)
    row.samples = {"slow": [4.0, 9.0, 6.0], "fast": [2.0, 3.0, 1.0]}
    row.ratio("slow in fast", "slow", "fast", at_least=3.0)
    (figure,) = row.figures
    assert (figure.value, figure.spread, figure.met) == (3.0, (2.0, 6.0), True)


@pytest.mark.parametrize(
    ("work", "seconds", "bound"),
    [
        (limits.Work(1.0, 1000.0), 10.0, "memory"),
        (limits.Work(8.0, 100.0), 4.0, "arithmetic"),
        (limits.Work(0.0, 0.0), 0.5, "dispatch"),
    ],
)
def test_what_binds_is_what_takes_longest(work, seconds, bound):
    ceilings = {"memory": 100.0, "float32": 2.0, "float64": 1.0, "dispatch": 0.5}
    assert limits.least(work, ceilings, "float32") == (seconds, bound)


def counted(function, *given, sparse=()) -> limits.Work:
    traced = jax.jit(function).trace(*given)
    return limits.work(traced, traced.lower().compile(), sparse)


def test_operations_are_counted_through_loops_and_branches_and_no_further_than_they_matter():
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
    assert counted(lambda n: n + n, jnp.arange(10)).operations == 0  # floats count
    assert counted(jax.vmap(jnp.sum), matrix).operations == 12


def test_bytes_are_those_that_a_run_must_read_and_write():
    x, unused, table = jnp.ones(10), jnp.ones(1000), jnp.ones(5000)
    work = counted(lambda x, unused, table: x + table[3], x, unused, table, sparse=table)
    assert work.moved == 2 * x.nbytes
    assert (work * 3).moved == 6 * x.nbytes and (work * 3).workspace == work.workspace


@pytest.fixture
def few(monkeypatch):
    """Rows that take no time: one that measures, and one in which Ctrl-C comes half way."""

    def quick(row: measure.Row, sizes: Sizes) -> None:
        row.race({"ours": lambda: None, "theirs": lambda: None})
        row.timed("ours", "ours", "s", at_most=1.0)
        row.add("a ratio", 2.0, "times", at_least=3.0, note="of nothing")
        row.series.append(measure.Series("size", [1, 10], {"ours": [1.0, 10.0]}))

    def stopped(row: measure.Row, sizes: Sizes) -> None:
        row.add("before", 1.0, "s")
        raise KeyboardInterrupt

    tasks = {
        "quick": measure.Task("a quick row", "float32", quick),
        "stopped": measure.Task("a row that is stopped", "float64", stopped, True),
        "never": measure.Task("a row after that", "float32", quick),
    }
    monkeypatch.setattr(bench_tasks, "TASKS", tasks)


def test_the_command_prints_a_table_with_the_hardware(few, capsys):
    assert main.main(["bench", "--quick", "--only", "quick"]) == 0
    told = capsys.readouterr()
    assert f"JAX {jax.__version__}" in told.out and "threads used" in told.out
    assert "load average" in told.out
    assert "Quick: smaller sizes" in told.out
    ours, ratio = (line for line in told.out.splitlines() if line.startswith("quick "))
    assert ours.endswith("yes") and "≤ 1" in ours and " to " in ours
    assert ratio.split() == ["quick", "a", "ratio", "2", "times", "≥", "3", "no"]
    assert "quick: a ratio: of nothing" in told.out
    assert "[1/1] quick: a quick row" in told.err


def test_the_json_is_complete(few, tmp_path, capsys):
    place = tmp_path / "bench.json"
    assert main.main(["bench", "--only", "quick", "--json", str(place)]) == 0
    whole = json.loads(place.read_text())
    assert not whole["quick"] and not whole["interrupted"]
    assert set(whole["machine"]) == {
        "cpu", "cores", "threads", "memory_gb", "device", "jax", "python", "xla_flags", "load",
    }  # fmt: skip
    assert len(whole["machine"]["load"]) == 2  # as it began, and at the end
    (row,) = whole["rows"]
    assert row["name"] == "quick" and row["floats"] == "float32"
    assert [one["met"] for one in row["figures"]] == [True, False]
    repeats = bench_tasks.FULL.repeats
    assert {name: len(drawn) for name, drawn in row["samples"].items()} == {
        "ours": repeats, "theirs": repeats,
    }  # fmt: skip
    assert row["medians"] == measure.medians(row["samples"])
    assert row["series"][0]["slopes"] == {"ours": pytest.approx(1.0)}
    assert (tmp_path / "bench.png").is_file()
    assert str(place) in capsys.readouterr().out


def test_an_interrupt_prints_and_writes_what_was_measured(few, tmp_path, capsys):
    place = tmp_path / "bench.json"
    assert main.main(["bench", "--json", str(place)]) == main.INTERRUPTED
    told = capsys.readouterr().out
    assert "Interrupted: this is what" in told and "before" in told
    whole = json.loads(place.read_text())
    assert whole["interrupted"] and [row["name"] for row in whole["rows"]] == ["quick", "stopped"]


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (
            ["--only", "legs,wings"],
            "no rows named ['wings']; there are ['machine', 'start', 'legs'",
        ),
        (["--only", " ,"], "wanted names of rows"),
        (["--plot", "curves.svg"], "curves.svg: wanted a name that ends in .png"),
        (["--json", "nowhere/bench.json"], "there is no folder nowhere"),
    ],
)
def test_a_mistake_in_the_options_is_told_before_anything_is_measured(
    options, told, capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert main.main(["bench", *options]) == main.MISTAKE
    out = capsys.readouterr()
    assert told in out.err and "[1/" not in out.err and not list(tmp_path.iterdir())


def test_quick_sizes_are_no_larger_than_the_full_ones():
    for field in dataclasses.fields(Sizes):
        quick, full = (getattr(s, field.name) for s in (bench_tasks.QUICK, bench_tasks.FULL))
        if isinstance(full, tuple):
            quick, full = sorted(quick), sorted(full)
        assert quick <= full or quick[-1] <= full[-1], field.name


def test_a_quick_measurement_leaves_out_what_is_long_unless_it_is_named():
    tasks = bench_tasks.TASKS
    assert set(tasks) - set(measure.choose(tasks, None, quick=True)) == {"fit", "scaling"}
    assert list(measure.choose(tasks, "fit", quick=True)) == ["machine", "fit"]
    assert list(measure.choose(tasks, None)) == list(tasks)


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (MemoryError(), "failed: MemoryError"),
        (
            measure.subprocess.CalledProcessError(1, "python", stderr="Traceback\nKeyError: 'a'\n"),
            "KeyError: 'a'",
        ),
    ],
)
def test_a_row_that_fails_says_so_and_the_others_go_on(few, error, told, monkeypatch, capsys):
    def failing(row: measure.Row, sizes: Sizes) -> None:
        raise error

    tasks = {"failing": measure.Task("a row that fails", "", failing), **bench_tasks.TASKS}
    monkeypatch.setattr(bench_tasks, "TASKS", tasks)
    assert main.main(["bench", "--only", "failing,quick"]) == 0
    out = capsys.readouterr()
    note = next(line for line in out.out.splitlines() if line.startswith("failing: failed"))
    assert told in note and told in out.err and "a ratio" in out.out


def test_numbers_that_are_none_become_null_in_the_json():
    row = measure.Row("x", "x", 1, load=float("nan"))
    row.add("memory", float("nan"), "MB", limit=float("inf"))
    kept = json.loads(report.to_json(measure.Report(False, [row])))
    (figure,) = kept["rows"][0]["figures"]
    assert figure["value"] is None and figure["limit"] is None and kept["rows"][0]["load"] is None
