"""Programs kept between processes: they give the same output, and are traced once."""

import functools
import os
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fitting.runtime import activity, cache_folder, files, program_cache, program_key
from jaxik.maths import vec

TRACED = []


def stretch(scale, points, *, by=1.0):
    """A stand-in for a function of the project; counts how often it is traced."""
    TRACED.append(points.shape)
    return {
        "longer": scale * by * points / jnp.linalg.norm(points, axis=-1, keepdims=True),
        "name": "stretched",
        "half": (points / 2, None),
    }


def by_function(change, points):
    """A stand-in for a function of the project that takes another function."""
    TRACED.append(points.shape)
    return change(points)


def stretch_known(points):
    """A stand-in for a function of the project that calls a cached one with constants."""
    return points + STRETCH_KNOWN(2.0, KNOWN)["longer"]


def as_set(points):
    """A stand-in for a function of the project whose output holds more than can be kept."""
    TRACED.append(points.shape)
    return points, frozenset({"one"})


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A JAX cache for this test alone; the functions above pass for the project's."""
    before = cache_folder.setting(cache_folder.FOLDER)
    jax.config.update(cache_folder.FOLDER, str(tmp_path))
    for function in (stretch, by_function, stretch_known, as_set):
        monkeypatch.setattr(function, "__module__", "fitting.somewhere")
    cache_folder.WARNED.clear()
    TRACED.clear()
    yield tmp_path / cache_folder.TRACED
    jax.config.update(cache_folder.FOLDER, before)


def points(count=4, dtype=float):
    return jnp.asarray(np.random.default_rng(0).normal(size=(count, 3)), dtype)


def mine(points):
    """A function of a user's module."""
    return 2 * points


KNOWN, STRETCH_KNOWN = points(), program_cache.cached(stretch)


def assert_same(output, expected):
    assert jax.tree.structure(output) == jax.tree.structure(expected)
    assert output["name"] == expected["name"] == "stretched"
    np.testing.assert_array_equal(output["longer"], expected["longer"])
    np.testing.assert_array_equal(output["half"][0], expected["half"][0])


def fresh():
    """The cached function as a new process would have it."""
    return program_cache.cached(stretch)


def kept(folder):
    return list(folder.iterdir()) if folder.exists() else []


# What is kept


def test_a_cached_function_gives_the_same_output_and_is_traced_once(folder):
    expected = eqx.filter_jit(stretch)(2.0, points(), by=3.0)
    TRACED.clear()
    for _ in range(2):
        assert_same(fresh()(2.0, points(), by=3.0), expected)
    assert TRACED == [(4, 3)] and len(kept(folder)) == 1


def test_each_shape_type_and_constant_gets_its_own_program(folder):
    calls = [
        ((2.0, points()), {}),
        ((2.0, points(5)), {}),
        ((2.0, points(dtype=jnp.float32)), {}),
        ((3.0, points()), {}),
        ((2.0, points()), {"by": 2.0}),
        ((jnp.asarray(2.0), points()), {}),
    ]
    for times in (1, 2):
        for args, named in calls:
            output = fresh()(*args, **named)
            np.testing.assert_allclose(
                jnp.linalg.norm(output["longer"], axis=-1),
                float(args[0]) * named.get("by", 1.0),
                rtol=1e-6,
            )
            assert output["longer"].dtype == args[1].dtype
        assert len(TRACED) == len(kept(folder)) == len(calls), times


def test_a_change_of_the_source_makes_a_new_program(folder, monkeypatch):
    fresh()(2.0, points())
    monkeypatch.setattr(program_key, "sources", lambda: "changed")
    fresh()(2.0, points())
    assert len(TRACED) == len(kept(folder)) == 2


@pytest.mark.parametrize("change", [vec.sum_last, jnp.sort])
def test_functions_of_the_project_and_its_libraries_are_identified_by_name(folder, change):
    for _ in range(2):
        output = program_cache.cached(by_function)(change, points())
        np.testing.assert_array_equal(output, change(points()))
    assert len(TRACED) == len(kept(folder)) == 1


def test_inside_another_program_it_becomes_part_of_it(folder):
    stretched = fresh()

    def whole(p):
        return jax.vmap(lambda each: stretched(2.0, each)["longer"])(p[None])[0].sum()

    gradient = jax.jit(jax.grad(whole))(points())
    assert gradient.shape == (4, 3)
    assert np.isfinite(gradient).all() and np.any(gradient != 0)
    assert not kept(folder)


def test_a_cached_call_with_constant_arguments_inside_a_trace_does_not_deadlock(folder):
    output = program_cache.cached(stretch_known)(points())
    np.testing.assert_allclose(output, points() + stretch(2.0, points())["longer"])
    assert len(kept(folder)) == 2


# What is not kept


@pytest.mark.parametrize(
    "change",
    [lambda points: points + 1, functools.partial(vec.sum_last), mine],
    ids=["lambda", "partial", "user's module"],
)
def test_a_user_function_as_an_argument_is_called_but_not_kept(folder, change):
    for _ in range(2):
        output = program_cache.cached(by_function)(change, points())
        np.testing.assert_array_equal(output, change(points()))
    assert len(TRACED) == 2 and not kept(folder)


def test_a_program_of_a_user_function_is_not_kept(folder, monkeypatch):
    monkeypatch.setattr(stretch, "__module__", "mine")
    np.testing.assert_allclose(fresh()(2.0, points())["half"][0], points() / 2)
    assert not kept(folder)


@pytest.mark.parametrize(
    ("setting", "value"),
    [(cache_folder.ENABLED, False), (cache_folder.FOLDER, ""), (cache_folder.FOLDER, None)],
)
def test_nothing_is_kept_where_jax_keeps_nothing(folder, setting, value):
    before = cache_folder.setting(setting)
    jax.config.update(setting, value)
    fresh()(2.0, points())
    jax.config.update(setting, before)
    assert not folder.exists()


def test_a_mistake_in_a_call_raises_the_usual_error(folder):
    with pytest.raises(ValueError, match="Incompatible shapes"):
        fresh()(jnp.zeros(2), points())
    assert not kept(folder)


# Failures are said once, and the call goes on


def test_a_damaged_file_is_replaced(folder):
    expected = fresh()(2.0, points())
    (file,) = kept(folder)
    intact = file.read_bytes()
    file.write_bytes(intact[:-1])
    with pytest.warns(RuntimeWarning, match=f"traced anew: {file} is damaged: its sha256"):
        assert_same(fresh()(2.0, points()), expected)
    assert len(TRACED) == 2 and file.read_bytes() == intact


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owner here")
def test_a_file_that_others_may_write_is_replaced(folder):
    fresh()(2.0, points())
    (file,) = kept(folder)
    file.chmod(0o666)
    with pytest.warns(RuntimeWarning, match=f"traced anew: everybody may write to {file}"):
        fresh()(2.0, points())
    assert len(TRACED) == 2 and not file.stat().st_mode & 0o002


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owner here")
def test_a_folder_of_another_user_is_neither_read_nor_written(folder, monkeypatch):
    fresh()(2.0, points())
    monkeypatch.setattr(os, "getuid", lambda: 1_000_001)
    with pytest.warns(RuntimeWarning, match="not kept: .*traced belongs to another user") as said:
        for count in (4, 5):
            fresh()(2.0, points(count))
    assert len(said) == 1, "once, not for each program"
    assert len(TRACED) == 3 and len(kept(folder)) == 1


def test_a_file_in_the_place_of_the_folder_stays(folder):
    folder.write_text("a file in its place")
    with pytest.warns(RuntimeWarning, match="traced programs are not kept: .*File exists"):
        assert_same(fresh()(2.0, points()), fresh()(2.0, points()))
    assert folder.read_text() == "a file in its place"


def test_a_full_disk_is_said_once(folder, monkeypatch):
    mkstemp = files.tempfile.mkstemp

    def fail(*, dir, **named):
        if dir == folder:
            raise OSError(28, "No space left on device")
        return mkstemp(dir=dir, **named)  # JAX's own files

    expected = eqx.filter_jit(stretch)(2.0, points())
    monkeypatch.setattr(files.tempfile, "mkstemp", fail)
    with pytest.warns(RuntimeWarning, match="not kept: .*No space left on device") as said:
        assert_same(fresh()(2.0, points()), expected)
        fresh()(2.0, points(5))
    assert len(said) == 1 and not kept(folder)


def test_an_output_that_cannot_be_kept_is_returned_all_the_same(folder):
    with pytest.warns(RuntimeWarning, match="not kept: frozenset is neither"):
        output = program_cache.cached(as_set)(points())
    assert output[1] == {"one"} and TRACED == [(4, 3)] and not kept(folder)


def test_a_program_that_jax_does_not_export_is_run_all_the_same(folder, monkeypatch):
    def refuse(*_, **__):
        raise ValueError("Cannot serialize\nthis call")

    monkeypatch.setattr(program_cache.export, "export", refuse)
    with pytest.warns(RuntimeWarning, match="of stretch is not kept: Cannot serialize$"):
        output = fresh()(2.0, points())
    np.testing.assert_allclose(output["half"][0], points() / 2)


@pytest.mark.slow
def test_a_fit_in_another_process_traces_nothing_large(tmp_path):
    """Two processes with different hash seeds find the same programs."""
    code = """
import sys, jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
from fitting.bench import workloads
from fitting.runtime import program_cache
from fitting.inference.optimisation.levenberg_marquardt import evaluate
from fitting.inference.optimisation.models import HardModel
traced = []
real = program_cache._trace
program_cache._trace = lambda *args: traced.append(args[0].__name__) or real(*args)
problem = workloads.problem(60)
at = evaluate(HardModel(problem, problem.space.start), problem.space.start)
print(float(at.cost), *traced)
"""
    outputs = [
        subprocess.run(
            [sys.executable, "-W", "error::RuntimeWarning", "-c", code, str(tmp_path)],
            env=os.environ | {"PYTHONHASHSEED": seed},
            cwd=Path(__file__).parents[2],
            check=True,
            capture_output=True,
            text=True,
        ).stdout.split()
        for seed in ("1", "2")
    ]
    assert outputs[0][0] == outputs[1][0]
    assert {"begin", "step"} <= set(outputs[0][1:]) and outputs[1][1:] == []


def test_arrays_are_compiled_for_once_wherever_they_come_from(folder):
    """Those that come out of a kept program are committed to a device, unlike fresh ones."""
    compiled = []

    def count(event: str, duration_secs: float, **named: object) -> None:
        if event.endswith("backend_compile_duration") and named.get("fun_name") == "jit(stretch)":
            compiled.append(duration_secs)

    call, points = program_cache.cached(stretch), jnp.ones((4, 3))
    jax.monitoring.register_event_duration_secs_listener(count)
    try:
        first = call(jnp.asarray(2.0), points)["longer"]
        call(jnp.asarray(2.0), first)
        call(*program_cache.committed((jnp.asarray(2.0), points)))
    finally:
        jax.monitoring.unregister_event_duration_listener(count)
    assert first.committed and not points.committed
    assert len(compiled) == 1


def test_what_is_committed_already_or_lies_on_no_device_stays_as_it_is():
    tree = {"points": jnp.ones(3), "name": "here", "count": 3, "host": np.ones(2)}
    bound = program_cache.committed(tree)
    assert bound["points"].committed and not tree["points"].committed
    assert (bound["name"], bound["count"], bound["host"]) == ("here", 3, tree["host"])
    assert program_cache.committed(bound) is bound


def test_work_says_what_is_compiled_for_it_and_for_how_long():
    said = []

    @program_cache.cached
    def _long_sum(x: jax.Array) -> jax.Array:
        said.append(work.compiling)
        return jnp.sum(x)

    with activity.announced("Adding up") as work:
        for size in (3, 3, 4):
            _long_sum(jnp.ones(size))
            assert work.compiling == ""
    assert said == ["compiling long sum (0 s)"] * 2
    with pytest.raises(TypeError), activity.announced("Failing") as work:
        _long_sum("no numbers")  # type: ignore[arg-type]
    assert work.compiling == ""
