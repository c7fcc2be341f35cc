"""Programs that are kept between processes: the same answers, and traced once."""

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

from fitting.runtime import program_cache
from jaxik.maths import vec

TRACED = []


def stretch(scale, points, *, by=1.0):
    """Stands for a function of the project, whose tracing is counted."""
    TRACED.append(points.shape)
    return {
        "longer": scale * by * points / jnp.linalg.norm(points, axis=-1, keepdims=True),
        "name": "stretched",
        "half": (points / 2, None),
    }


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A cache of JAX's of its own, and `stretch` counted as the project's."""
    config: Any = jax.config
    before = config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    monkeypatch.setattr(stretch, "__module__", "fitting.somewhere")
    TRACED.clear()
    yield tmp_path / program_cache.FOLDER
    jax.config.update("jax_compilation_cache_dir", before)


def points(count=4, dtype=float):
    return jnp.asarray(np.random.default_rng(0).normal(size=(count, 3)), dtype)


def same(found, wanted):
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    assert found["name"] == wanted["name"] == "stretched"
    np.testing.assert_array_equal(found["longer"], wanted["longer"])
    np.testing.assert_array_equal(found["half"][0], wanted["half"][0])


def again():
    """What another process would have."""
    return program_cache.cached(stretch)


def test_what_is_kept_answers_like_the_function_and_is_traced_once(folder):
    wanted = eqx.filter_jit(stretch)(2.0, points(), by=3.0)
    TRACED.clear()
    for _ in range(2):
        same(again()(2.0, points(), by=3.0), wanted)
    assert TRACED == [(4, 3)] and len(list(folder.iterdir())) == 1


def test_each_shape_type_and_constant_has_a_program_of_its_own(folder):
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
            found = again()(*args, **named)
            np.testing.assert_allclose(
                jnp.linalg.norm(found["longer"], axis=-1),
                float(args[0]) * named.get("by", 1.0),
                rtol=1e-6,
            )
            assert found["longer"].dtype == args[1].dtype
        assert len(TRACED) == len(list(folder.iterdir())) == len(calls), times


def test_a_change_of_the_source_is_seen(folder, monkeypatch):
    again()(2.0, points())
    sources = program_cache._sources()
    monkeypatch.setattr(program_cache, "_sources", lambda: sources + b"changed")
    again()(2.0, points())
    assert len(TRACED) == 2


def test_the_source_is_that_of_both_packages(tmp_path, monkeypatch):
    monkeypatch.setattr(program_cache, "OWN", ("jaxik",))
    program_cache._sources.cache_clear()
    alone = program_cache._sources()
    monkeypatch.undo()
    program_cache._sources.cache_clear()
    assert program_cache._sources() != alone


def by_function(change, at):
    """Stands for a function of the project that takes another one."""
    TRACED.append(at.shape)
    return change(at)


def test_what_is_static_is_kept_by_its_name_where_its_source_is_known(folder, monkeypatch):
    monkeypatch.setattr(by_function, "__module__", "fitting.somewhere")
    for _ in range(2):
        found = program_cache.cached(by_function)(vec.sum_last, points())
        np.testing.assert_array_equal(found, vec.sum_last(points()))
    assert len(TRACED) == len(list(folder.iterdir())) == 1


@pytest.mark.parametrize("change", [lambda at: at + 1, stretch], ids=["lambda", "another's module"])
def test_a_function_of_the_users_is_called_and_not_kept(folder, monkeypatch, change):
    monkeypatch.setattr(by_function, "__module__", "fitting.somewhere")
    if change is stretch:
        monkeypatch.setattr(stretch, "__module__", "mine")
        change = functools.partial(stretch, 1.0)
    for _ in range(2):
        found = program_cache.cached(by_function)(change, points())
    assert jax.tree.leaves(found)[0].shape == (4, 3)
    assert len(TRACED) >= 2 and not folder.exists()


def test_a_program_of_a_function_of_the_users_is_not_kept(folder, monkeypatch):
    monkeypatch.setattr(stretch, "__module__", "mine")
    np.testing.assert_allclose(again()(2.0, points())["half"][0], points() / 2)
    assert not folder.exists()


def test_inside_another_program_it_is_part_of_that(folder):
    stretched = again()

    def whole(p):
        return jax.vmap(lambda each: stretched(2.0, each)["longer"])(p[None])[0].sum()

    slope = jax.jit(jax.grad(whole))(points())
    assert slope.shape == (4, 3) and np.isfinite(slope).all() and np.any(slope != 0)
    assert not folder.exists()


def test_one_within_another_that_knows_all_its_arguments_waits_for_nobody(folder, monkeypatch):
    inner, known = again(), points()

    def outer(p):
        return p + inner(2.0, known)["longer"]  # nothing of the inner call is traced

    monkeypatch.setattr(outer, "__module__", "fitting.somewhere")
    found = program_cache.cached(outer)(points())
    np.testing.assert_allclose(found, points() + stretch(2.0, points())["longer"])


@pytest.mark.parametrize(
    "left", [b"", b"damaged", pickle.dumps(None), pickle.dumps((b"no program", 0, None))]
)
def test_a_damaged_file_is_made_anew(folder, left):
    wanted = again()(2.0, points())
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    file.write_bytes(left)
    same(again()(2.0, points()), wanted)
    assert len(TRACED) == 2 and file.read_bytes() == whole


def test_a_folder_that_cannot_be_written_is_no_hindrance(folder):
    folder.write_text("a file in its place")
    same(again()(2.0, points()), again()(2.0, points()))
    assert folder.read_text() == "a file in its place"


def test_nothing_is_kept_where_jax_keeps_nothing(folder, monkeypatch):
    jax.config.update("jax_enable_compilation_cache", False)
    again()(2.0, points())
    jax.config.update("jax_enable_compilation_cache", True)
    assert not folder.exists()


def test_a_mistake_in_a_call_is_told_as_ever(folder):
    with pytest.raises(ValueError, match="Incompatible shapes"):
        again()(jnp.zeros(2), points())
    assert not folder.exists()


def test_a_fit_in_another_process_traces_nothing_large(tmp_path):
    """Two processes, whose hashes differ, find the same programs."""
    code = """
import sys, jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
from fitting.bench import setup
from fitting.runtime import program_cache
from fitting.inference.optimisation.levenberg_marquardt import evaluated
from fitting.inference.optimisation.jacobian import hard
traced = []
real = program_cache._trace
program_cache._trace = lambda *args: traced.append(args[0].__name__) or real(*args)
problem = setup.problem(60)
at = evaluated(hard, problem.space.u0, (problem, problem.space.u0))
print(float(at.cost), *traced)
"""
    told = [
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
    assert told[0][0] == told[1][0]
    assert {"begin", "step"} <= set(told[0][1:]) and told[1][1:] == []
