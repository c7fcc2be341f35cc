"""Programs cached between processes: the same output, traced once; JAX's own files are whole."""

import errno
import functools
import json
import os
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax._src import compilation_cache, xla_bridge
from jax._src.lru_cache import LRUCache

from fitting.experiment.experiment_files import load_experiment
from fitting.experiment.problems import make_problem
from fitting.runtime import activity, cache_folder, files, program_cache
from jaxik.maths import vec
from support.experiments import ROOT, write

# Stand-ins for functions of the project count here how often they are traced.
TRACED = []


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


def test_a_cached_function_gives_the_same_output_and_each_kind_of_call_is_traced_once(folder):
    expected = eqx.filter_jit(stretch)(2.0, points(), by=3.0)
    TRACED.clear()
    calls = [
        ((2.0, points()), {"by": 3.0}),
        ((2.0, points()), {}),
        ((2.0, points(5)), {}),
        ((2.0, points(dtype=jnp.float32)), {}),
        ((3.0, points()), {}),
        ((jnp.asarray(2.0), points()), {}),
    ]
    for times in (1, 2):
        assert_same(fresh()(2.0, points(), by=3.0), expected)
        for args, named in calls:
            longer = fresh()(*args, **named)["longer"]
            length = float(args[0]) * named.get("by", 1.0)
            np.testing.assert_allclose(jnp.linalg.norm(longer, axis=-1), length, rtol=1e-6)
            assert longer.dtype == args[1].dtype
        assert len(TRACED) == len(kept(folder)) == len(calls), times


def test_programs_with_functions_that_no_source_of_a_user_defines_are_kept(folder):
    for change, programs in (
        (vec.sum_last, 1),
        (jnp.sort, 1),
        (lambda points: points + 1, 0),
        (functools.partial(vec.sum_last), 0),
        (mine, 0),
    ):
        TRACED.clear()
        before = len(kept(folder))
        for _ in range(2):
            output = program_cache.cached(by_function)(change, points())
            np.testing.assert_array_equal(output, change(points()))
        assert len(TRACED) == 2 - programs and len(kept(folder)) - before == programs, change


def test_inside_another_program_it_becomes_part_of_it_and_constants_do_not_deadlock(folder):
    stretched = fresh()

    def whole(p):
        return jax.vmap(lambda each: stretched(2.0, each)["longer"])(p[None])[0].sum()

    gradient = jax.jit(jax.grad(whole))(points())
    assert gradient.shape == (4, 3)
    assert np.isfinite(gradient).all() and np.any(gradient != 0)
    assert not kept(folder)
    output = program_cache.cached(stretch_known)(points())
    np.testing.assert_allclose(output, points() + stretch(2.0, points())["longer"])
    assert len(kept(folder)) == 2


IN_ANOTHER_PROCESS = """
import json, sys
import jax, jax.numpy as jnp
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
from fitting.experiment.experiment_files import load_experiment
from fitting.experiment.problems import make_problem
from fitting.runtime import program_cache
from fitting.runtime.program_cache import program_key
from jaxik.maths import vec
kept = program_cache.cached(vec.sum_last)(jnp.arange(6.0).reshape(2, 3))
problem = make_problem(load_experiment(sys.argv[2]))
print(json.dumps([kept.tolist(), program_key(make_problem, ((problem,), {}))]))
"""


@pytest.mark.slow
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
    assert key == program_cache.program_key(make_problem, ((problem,), {}))
    monkeypatch.setattr(program_cache, "_trace", None)
    numbers = jnp.arange(6.0).reshape(2, 3)
    assert program_cache.cached(vec.sum_last)(numbers).tolist() == output == [3.0, 12.0]


def test_nothing_is_kept_where_jax_keeps_nothing_or_of_a_call_that_fails(folder):
    off = [(cache_folder.ENABLED, False), (cache_folder.FOLDER, ""), (cache_folder.FOLDER, None)]
    for setting, value in off:
        before = cache_folder.setting(setting)
        jax.config.update(setting, value)
        fresh()(2.0, points())
        jax.config.update(setting, before)
        assert not folder.exists(), (setting, value)
    with pytest.raises(ValueError, match="Incompatible shapes"):
        fresh()(jnp.zeros(2), points())
    assert not kept(folder)


@pytest.mark.skipif(os.name != "posix", reason="no such permissions")
def test_a_damaged_file_and_one_that_others_may_write_are_replaced(folder):
    expected = fresh()(2.0, points())
    (file,) = kept(folder)
    intact = file.read_bytes()

    def assert_replaced(reason: str) -> None:
        TRACED.clear()
        with pytest.warns(RuntimeWarning, match=f"traced anew: {reason}"):
            assert_same(fresh()(2.0, points()), expected)
        assert len(TRACED) == 1 and file.read_bytes() == intact
        assert not file.stat().st_mode & 0o002
        cache_folder.WARNED.clear()

    file.write_bytes(intact[:-1])
    assert_replaced(f"{file} is damaged: its sha256")
    file.chmod(0o666)
    assert_replaced(f"everybody may write to {file}")


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owner here")
def test_a_folder_of_another_user_is_neither_read_nor_written_which_is_said_once(
    folder, monkeypatch
):
    fresh()(2.0, points())
    monkeypatch.setattr(os, "getuid", lambda: 1_000_001)
    with pytest.warns(RuntimeWarning, match="not cached: .*traced belongs to another user") as said:
        for count in (4, 5):
            fresh()(2.0, points(count))
    assert len(said) == 1
    assert len(TRACED) == 3 and len(kept(folder)) == 1


def test_a_full_disk_and_a_file_in_the_place_of_the_folder_are_said_once(folder, monkeypatch):
    mkstemp = files.tempfile.mkstemp

    def fail(*, dir, **named):
        if dir == folder:
            raise OSError(28, "No space left on device")
        return mkstemp(dir=dir, **named)  # JAX's own files

    expected = eqx.filter_jit(stretch)(2.0, points())
    with monkeypatch.context() as patch:
        patch.setattr(files.tempfile, "mkstemp", fail)
        with pytest.warns(RuntimeWarning, match="not cached: .*No space left on device") as said:
            assert_same(fresh()(2.0, points()), expected)
            fresh()(2.0, points(5))
    assert len(said) == 1 and not kept(folder)
    folder.rmdir()
    cache_folder.WARNED.clear()
    folder.write_text("a file in its place")
    with pytest.warns(RuntimeWarning, match="traced programs are not cached: .*File exists"):
        assert_same(fresh()(2.0, points()), expected)
    assert folder.read_text() == "a file in its place"


def test_what_cannot_be_kept_or_exported_is_returned_all_the_same(folder, monkeypatch):
    with pytest.warns(RuntimeWarning, match="not cached: frozenset is neither"):
        output = program_cache.cached(as_set)(points())
    assert output[1] == {"one"} and TRACED == [(4, 3)] and not kept(folder)
    refuse = Mock(side_effect=ValueError("Cannot serialize\nthis call"))
    monkeypatch.setattr(program_cache.export, "export", refuse)
    with pytest.warns(RuntimeWarning, match="of stretch is not cached: Cannot serialize$"):
        output = fresh()(2.0, points())
    np.testing.assert_allclose(output["half"][0], points() / 2)


def test_arrays_are_compiled_for_once_wherever_they_come_from(folder):
    """Those that come out of a kept program are committed to a device, unlike fresh ones."""
    tree = {"points": jnp.ones(3), "name": "here", "count": 3, "host": np.ones(2)}
    bound = program_cache.committed(tree)
    assert bound["points"].committed and not tree["points"].committed
    assert (bound["name"], bound["count"], bound["host"]) == ("here", 3, tree["host"])
    assert program_cache.committed(bound) is bound
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


@pytest.mark.parametrize("beside", ["cpu", "tpu"])
def test_a_program_is_kept_for_the_device_its_arrays_are_on(folder, monkeypatch, beside):
    """Not for JAX's default, which may be an accelerator beside the CPU that computes."""
    array = points()
    monkeypatch.setattr(xla_bridge, "default_backend", lambda: beside)
    monkeypatch.setattr(jax, "default_backend", lambda: beside)
    for _ in range(2):
        np.testing.assert_allclose(fresh()(2.0, array)["half"][0], array / 2)
    assert len(TRACED) == len(kept(folder)) == 1


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


# JAX's own files of compiled programs

KEY, PROGRAM = "jit_walk-" + "0123456789abcdef" * 4, b"the whole program"
NAME = f"{KEY}-cache"


def test_jax_writes_whole_files_or_none_unless_it_locks_their_folder(tmp_path, monkeypatch):
    cache_folder.write_complete_files()
    bounded = LRUCache(str(tmp_path / "bounded"), max_size=1000)  # left to JAX
    bounded.put(KEY, PROGRAM)
    assert bounded.get(KEY) == PROGRAM and f"{KEY}-atime" in os.listdir(tmp_path / "bounded")
    folder = tmp_path / "unbounded"
    cache, whole, seen = LRUCache(str(folder), max_size=-1), Path.write_bytes, []

    def fill_the_disk(path, content):
        whole(path, content[:5])
        raise OSError(errno.ENOSPC, "No space left on device")

    def look_half_way(path, content):
        whole(path, content[:5])
        seen.append(cache.get(KEY))
        whole(path, content)

    monkeypatch.setattr(Path, "write_bytes", fill_the_disk)
    with pytest.raises(ValueError, match=f"{NAME}: cannot be written: No space left on device"):
        cache.put(KEY, PROGRAM)
    assert not os.listdir(folder)
    monkeypatch.setattr(Path, "write_bytes", look_half_way)
    cache.put(KEY, PROGRAM)
    assert seen == [None] and cache.get(KEY) == PROGRAM and os.listdir(folder) == [NAME]


def test_a_damaged_program_is_compiled_once_more_and_replaced(tmp_path):
    def compile_anew() -> None:
        assert jax.jit(lambda x: x + 1)(1.0) == 2.0

    names = (cache_folder.FOLDER, cache_folder.MIN_SECONDS)
    before = [cache_folder.setting(name) for name in names]
    cache_folder.write_complete_files()
    for name, value in zip(names, (str(tmp_path), 0.0), strict=True):
        jax.config.update(name, value)
    compilation_cache.reset_cache()
    try:
        compile_anew()
        (file,) = tmp_path.glob("jit__lambda*-cache")
        whole = file.read_bytes()
        file.write_bytes(whole[:50])
        with pytest.warns(UserWarning, match="Error reading persistent compilation cache entry"):
            compile_anew()
        assert len(file.read_bytes()) > 50
        compile_anew()  # without a warning
    finally:
        for name, value in zip(names, before, strict=True):
            jax.config.update(name, value)
        compilation_cache.reset_cache()
        jax.jit(lambda x: x - 1)(1.0)  # has JAX go back to it at once
