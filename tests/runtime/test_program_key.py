"""Keys of programs: equal in every process, and different for whatever changes a program."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from fitting.runtime import files, plain_tree, program_key
from fitting.runtime.plain_tree import NotPlainError

CODE = """
import jax.numpy as jnp
from fitting.runtime.program_key import program_key
from fitting.runtime import files
print(program_key(files.write, ((jnp.ones((2, 3)), {"b": (1, None), "a": 0.5}), {})))
"""


def key(*args, **named):
    return program_key.program_key(files.write, (args, named))


def test_another_process_has_the_same_key():
    keys = {
        subprocess.run(
            [sys.executable, "-c", CODE],
            env=os.environ | {"PYTHONHASHSEED": seed, "JAX_ENABLE_X64": "1"},
            cwd=Path(__file__).parents[2],
            check=True,
            capture_output=True,
            text=True,
        ).stdout.strip()
        for seed in ("1", "2")
    }
    assert keys == {key(jnp.ones((2, 3)), {"a": 0.5, "b": (1, None)})}


def test_whatever_changes_a_program_changes_its_key():
    x = jnp.ones((2, 3))
    keys = [
        key(x),
        key(x[None]),
        key(x.astype("float32")),
        key(jnp.asarray(1.0)),
        key(1.0),
        key(x, None),
        key(None, x),
        key(x, by=1),
        key(x, by=True),
        program_key.program_key(files.write_text, ((x,), {})),
    ]
    with jax.default_matmul_precision("float32"):
        keys.append(key(x))
    with jax.enable_x64(False):
        keys.append(key(x))
    assert len(set(keys)) == len(keys)


def test_only_the_types_of_arrays_count():
    assert key(jnp.ones(3)) == key(jnp.zeros(3)) != key(jnp.zeros(4))


def test_the_source_of_both_packages_counts(monkeypatch):
    both = program_key.sources()
    monkeypatch.setattr(plain_tree, "PROJECT", ("jaxik",))
    assert program_key.sources.__wrapped__() != both


def test_the_versions_of_the_libraries_count(monkeypatch):
    before = key(1)
    monkeypatch.setattr(program_key, "versions", lambda: {"jax": "1.2.3"})
    assert key(1) != before


@pytest.mark.parametrize("function", [key, lambda: None])
def test_a_function_of_a_user_has_no_key(function):
    with pytest.raises(NotPlainError, match="no named function of this project"):
        program_key.program_key(function, ((), {}))


def test_a_closure_has_no_key(monkeypatch):
    def closure():
        return monkeypatch

    monkeypatch.setattr(closure, "__module__", "fitting.somewhere")
    with pytest.raises(NotPlainError, match="no named function of this project"):
        program_key.program_key(closure, ((), {}))
