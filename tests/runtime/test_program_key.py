"""Keys of programs: different for whatever changes a program; equal keys in another process are
checked with the programs that are kept."""

import jax
import jax.numpy as jnp
import pytest

from fitting.runtime import files, plain_tree, program_key
from fitting.runtime.plain_tree import NotPlainError


def key(*args, **named):
    return program_key.program_key(files.write, (args, named))


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


def test_the_source_of_both_packages_and_the_versions_of_the_libraries_count(monkeypatch):
    before, both = key(1), program_key.sources()
    for part, changed in {"versions": {"jax": "1.2.3"}, "sources": "changed"}.items():
        with monkeypatch.context() as patch:
            patch.setattr(program_key, part, lambda changed=changed: changed)
            assert key(1) != before, part
    monkeypatch.setattr(plain_tree, "PROJECT", ("jaxik",))
    assert program_key.sources.__wrapped__() != both


def test_a_function_of_a_user_and_a_closure_have_no_key(monkeypatch):
    def closure():
        return monkeypatch

    monkeypatch.setattr(closure, "__module__", "fitting.somewhere")
    for function in (key, lambda: None, closure):
        with pytest.raises(NotPlainError, match="no named function of this project"):
            program_key.program_key(function, ((), {}))
