"""Programs kept between processes: they give the same output, and are traced once."""

import functools
import json
import os
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fitting.experiments.experiment_files import load_experiment
from fitting.experiments.problems import make_problem
from fitting.runtime import activity, cache_folder, files, program_cache, program_key
from jaxik.maths import vec
from support.experiments import ROOT, write

TRACED = []


# Stand-ins for functions of the project, which count how often they are traced


def stretch(scale, points, *, by=1.0):
    TRACED.append(points.shape)
    return {
        "longer": scale * by * points / jnp.linalg.norm(points, axis=-1, keepdims=True),
        "name": "stretched",
        "half": (points / 2, None),
    }


def by_function(change, points):
    TRACED.append(points.shape)
    return change(points)


def stretch_known(points):
    """Calls a cached function with constants."""
    return points + STRETCH_KNOWN(2.0, KNOWN)["longer"]


def as_set(points):
    """Its output holds more than can be kept."""
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


# What is kept, and what is not


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
            longer = fresh()(*args, **named)["longer"]
            length = float(args[0]) * named.get("by", 1.0)
            np.testing.assert_allclose(jnp.linalg.norm(longer, axis=-1), length, rtol=1e-6)
            assert longer.dtype == args[1].dtype
        assert len(TRACED) == len(kept(folder)) == len(calls), times


@pytest.mark.parametrize(
    ("change", "programs"),
    [
        (vec.sum_last, 1),
        (jnp.sort, 1),
        (lambda points: points + 1, 0),
        (functools.partial(vec.sum_last), 0),
        (mine, 0),
    ],
)
def test_programs_with_functions_that_no_source_of_a_user_defines_are_kept(
    folder, change, programs
):
    for _ in range(2):
        output = program_cache.cached(by_function)(change, points())
        np.testing.assert_array_equal(output, change(points()))
    assert len(TRACED) == 2 - programs and len(kept(folder)) == programs


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


IN_ANOTHER_PROCESS = """
import json, sys
import jax, jax.numpy as jnp
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
from fitting.experiments.experiment_files import load_experiment
from fitting.experiments.problems import make_problem
from fitting.runtime import program_cache
from fitting.runtime.program_key import program_key
from jaxik.maths import vec
kept = program_cache.cached(vec.sum_last)(jnp.arange(6.0).reshape(2, 3))
problem = make_problem(load_experiment(sys.argv[2]))
print(json.dumps([kept.tolist(), program_key(make_problem, ((problem,), {}))]))
"""


def test_another_process_has_the_same_keys_and_its_programs_are_not_traced_again(
    folder, tmp_path, monkeypatch
):
    """Also one whose sets and dictionaries have another order."""
    experiment = write(tmp_path, clip="")
    seed = "1" if os.environ.get("PYTHONHASHSEED") != "1" else "2"
    done = subprocess.run(
        [sys.executable, "-W", "error::RuntimeWarning", "-c", IN_ANOTHER_PROCESS,
         str(tmp_path), str(experiment)],
        env=os.environ | {"PYTHONHASHSEED": seed, "JAX_ENABLE_X64": "1"},
        cwd=ROOT, check=True, capture_output=True, text=True,
    )  # fmt: skip
    output, key = json.loads(done.stdout)
    problem = make_problem(load_experiment(experiment))
    assert key == program_key.program_key(make_problem, ((problem,), {}))
    monkeypatch.setattr(program_cache, "_trace", None)
    numbers = jnp.arange(6.0).reshape(2, 3)
    assert program_cache.cached(vec.sum_last)(numbers).tolist() == output == [3.0, 12.0]


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


@pytest.mark.skipif(os.name != "posix", reason="no such permissions")
@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda file: file.write_bytes(file.read_bytes()[:-1]), "{file} is damaged: its sha256"),
        (lambda file: file.chmod(0o666), "everybody may write to {file}"),
    ],
)
def test_a_damaged_file_and_one_that_others_may_write_are_replaced(folder, spoil, reason):
    expected = fresh()(2.0, points())
    (file,) = kept(folder)
    intact = file.read_bytes()
    spoil(file)
    with pytest.warns(RuntimeWarning, match=f"traced anew: {reason.format(file=file)}"):
        assert_same(fresh()(2.0, points()), expected)
    assert len(TRACED) == 2 and file.read_bytes() == intact
    assert not file.stat().st_mode & 0o002


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


# Arrays that are committed to a device


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
