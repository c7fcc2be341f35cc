"""Flags of XLA and JAX: set where none are, and they do what they are there for."""

import os

import jax
import jax.numpy as jnp
import pytest

from fitting.runtime import xla


def test_flags_are_set_where_none_are(monkeypatch):
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    xla.configure_xla()
    assert os.environ["XLA_FLAGS"] == xla.XLA


def test_flags_of_the_user_stay(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")
    xla.configure_xla()
    assert os.environ["XLA_FLAGS"] == "--xla_cpu_enable_fast_math=false"


@pytest.mark.parametrize("user", [None, "true"])
def test_programs_run_where_they_are_called_unless_the_user_has_said(monkeypatch, user):
    monkeypatch.delenv(xla.ASYNC, raising=False)
    if user is not None:
        monkeypatch.setenv(xla.ASYNC, user)
    name = xla.ASYNC.lower()
    before = jax.config.values[name]
    jax.config.update(name, True)
    try:
        xla.configure_xla()
        assert jax.config.values[name] == (user is not None)
    finally:
        jax.config.update(name, before)


@pytest.mark.skipif(os.environ.get("XLA_FLAGS") != xla.XLA, reason="XLA has other flags")
@pytest.mark.skipif(jax.default_backend() != "cpu", reason="there is no such library on a GPU")
def test_sums_are_no_calls_of_a_library():
    told = jax.ShapeDtypeStruct((2048, 2048), jnp.float32)
    program = jax.jit(lambda x: jnp.sum(x, 0)).lower(told).compile().as_text()
    assert "ynn_fusion" not in program


@pytest.mark.skipif(os.environ.get("XLA_FLAGS") != xla.XLA, reason="XLA has other flags")
@pytest.mark.skipif(jax.default_backend() != "cpu", reason="there is no such loop on a GPU")
@pytest.mark.parametrize(("numbers", "one"), [(64, True), (100_000_000, False)])
def test_a_loop_that_moves_little_is_one_function(numbers, one):
    turns = jax.jit(lambda x: jax.lax.scan(lambda c, x: (c + jnp.sin(x), c * x), x[0], x))
    told = jax.ShapeDtypeStruct((3, numbers), jnp.float32)
    program = turns.lower(told).compile().as_text()
    assert ("xla_cpu_small_call" in program) == one
