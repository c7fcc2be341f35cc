"""Programs kept between processes: they give the same output, and are traced once."""

import functools
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fitting.runtime import files, program_cache
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


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A JAX cache for this test alone; `stretch` passes for one of the project's functions."""
    config: Any = jax.config
    before = config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    monkeypatch.setattr(stretch, "__module__", "fitting.somewhere")
    TRACED.clear()
    yield tmp_path / program_cache.FOLDER
    jax.config.update("jax_compilation_cache_dir", before)


def points(count=4, dtype=float):
    return jnp.asarray(np.random.default_rng(0).normal(size=(count, 3)), dtype)


def assert_same(output, expected):
    assert jax.tree.structure(output) == jax.tree.structure(expected)
    assert output["name"] == expected["name"] == "stretched"
    np.testing.assert_array_equal(output["longer"], expected["longer"])
    np.testing.assert_array_equal(output["half"][0], expected["half"][0])


def fresh():
    """The cached function as a new process would have it."""
    return program_cache.cached(stretch)


def test_a_cached_function_gives_the_same_output_and_is_traced_once(folder):
    expected = eqx.filter_jit(stretch)(2.0, points(), by=3.0)
    TRACED.clear()
    for _ in range(2):
        assert_same(fresh()(2.0, points(), by=3.0), expected)
    assert TRACED == [(4, 3)] and len(list(folder.iterdir())) == 1


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
        assert len(TRACED) == len(list(folder.iterdir())) == len(calls), times


def test_a_change_of_the_source_makes_a_new_program(folder, monkeypatch):
    fresh()(2.0, points())
    sources = program_cache._sources()
    monkeypatch.setattr(program_cache, "_sources", lambda: sources + b"changed")
    fresh()(2.0, points())
    assert len(TRACED) == 2


def test_the_source_of_both_packages_counts(tmp_path, monkeypatch):
    monkeypatch.setattr(program_cache, "PROJECT", ("jaxik",))
    program_cache._sources.cache_clear()
    alone = program_cache._sources()
    monkeypatch.undo()
    program_cache._sources.cache_clear()
    assert program_cache._sources() != alone


def by_function(change, at):
    """A stand-in for a function of the project that takes another function."""
    TRACED.append(at.shape)
    return change(at)


def test_static_arguments_from_the_project_are_identified_by_name(folder, monkeypatch):
    monkeypatch.setattr(by_function, "__module__", "fitting.somewhere")
    for _ in range(2):
        output = program_cache.cached(by_function)(vec.sum_last, points())
        np.testing.assert_array_equal(output, vec.sum_last(points()))
    assert len(TRACED) == len(list(folder.iterdir())) == 1


@pytest.mark.parametrize("change", [lambda at: at + 1, stretch], ids=["lambda", "user's module"])
def test_a_user_function_as_an_argument_is_called_but_not_kept(folder, monkeypatch, change):
    monkeypatch.setattr(by_function, "__module__", "fitting.somewhere")
    if change is stretch:
        monkeypatch.setattr(stretch, "__module__", "mine")
        change = functools.partial(stretch, 1.0)
    for _ in range(2):
        output = program_cache.cached(by_function)(change, points())
    assert jax.tree.leaves(output)[0].shape == (4, 3)
    assert len(TRACED) >= 2 and not folder.exists()


def test_a_program_of_a_user_function_is_not_kept(folder, monkeypatch):
    monkeypatch.setattr(stretch, "__module__", "mine")
    np.testing.assert_allclose(fresh()(2.0, points())["half"][0], points() / 2)
    assert not folder.exists()


def test_inside_another_program_it_becomes_part_of_it(folder):
    stretched = fresh()

    def whole(p):
        return jax.vmap(lambda each: stretched(2.0, each)["longer"])(p[None])[0].sum()

    gradient = jax.jit(jax.grad(whole))(points())
    assert gradient.shape == (4, 3)
    assert np.isfinite(gradient).all() and np.any(gradient != 0)
    assert not folder.exists()


def test_a_cached_call_with_constant_arguments_inside_a_trace_does_not_deadlock(
    folder, monkeypatch
):
    inner, known = fresh(), points()

    def outer(p):
        return p + inner(2.0, known)["longer"]  # the arguments of the inner call are not traced

    monkeypatch.setattr(outer, "__module__", "fitting.somewhere")
    output = program_cache.cached(outer)(points())
    np.testing.assert_allclose(output, points() + stretch(2.0, points())["longer"])


@pytest.mark.parametrize(
    "content", [b"", b"damaged", pickle.dumps(None), pickle.dumps((b"no program", 0, None))]
)
def test_a_damaged_file_is_replaced(folder, content):
    expected = fresh()(2.0, points())
    (file,) = folder.iterdir()
    intact = file.read_bytes()
    file.write_bytes(content)
    assert_same(fresh()(2.0, points()), expected)
    assert len(TRACED) == 2 and file.read_bytes() == intact


class Hostile:
    """Runs code when it is unpickled."""

    def __init__(self, mark: Path):
        self.mark = mark

    def __reduce__(self):
        return os.mkdir, (str(self.mark),)


class Deferred:
    """Calls a function of the project that writes files, when it is unpickled."""

    def __init__(self, mark: Path):
        self.mark = mark

    def __reduce__(self):
        return files.write_text, (self.mark, "")


@pytest.mark.parametrize("payload", [Hostile, Deferred])
def test_a_hostile_file_runs_no_code(folder, payload):
    expected = fresh()(2.0, points())
    (file,) = folder.iterdir()
    mark = folder.parent / "mark"
    file.write_bytes(pickle.dumps((payload(mark), 0, None)))
    assert_same(fresh()(2.0, points()), expected)
    assert not mark.exists() and len(TRACED) == 2


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owner here")
def test_a_file_that_others_may_write_is_not_read(folder):
    fresh()(2.0, points())
    (file,) = folder.iterdir()
    file.chmod(0o666)
    fresh()(2.0, points())
    assert len(TRACED) == 2
    assert not file.stat().st_mode & 0o002, "the file was replaced by a new one"


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owner here")
def test_a_file_of_another_user_is_not_read(folder, monkeypatch):
    fresh()(2.0, points())
    monkeypatch.setattr(os, "getuid", lambda: 1_000_001)
    fresh()(2.0, points())
    assert len(TRACED) == 2


def test_a_folder_that_cannot_be_written_to_does_no_harm(folder):
    folder.write_text("a file in its place")
    assert_same(fresh()(2.0, points()), fresh()(2.0, points()))
    assert folder.read_text() == "a file in its place"


def test_nothing_is_kept_where_jax_keeps_nothing(folder, monkeypatch):
    jax.config.update("jax_enable_compilation_cache", False)
    fresh()(2.0, points())
    jax.config.update("jax_enable_compilation_cache", True)
    assert not folder.exists()


def test_a_mistake_in_a_call_raises_the_usual_error(folder):
    with pytest.raises(ValueError, match="Incompatible shapes"):
        fresh()(jnp.zeros(2), points())
    assert not folder.exists()


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
at = evaluate(HardModel(problem, problem.space.u0), problem.space.u0)
print(float(at.cost), *traced)
"""
    outputs = [
        subprocess.run(
            [sys.executable, "-c", code, str(tmp_path)],
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
