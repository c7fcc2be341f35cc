"""Settings of XLA and JAX: set unless the user has set them, and with the effect they promise."""

import os

import jax
import jax.numpy as jnp
import pytest

from fitting.runtime import xla

our_flags = pytest.mark.skipif(
    os.environ.get("XLA_FLAGS") != xla.FLAGS, reason="XLA has other flags"
)
on_cpu = pytest.mark.skipif(jax.default_backend() != "cpu", reason="these flags are for a CPU")


def test_flags_are_set_where_there_are_none(monkeypatch):
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    xla.configure_xla()
    assert os.environ["XLA_FLAGS"] == xla.FLAGS


def test_flags_of_the_user_are_left_alone(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")
    xla.configure_xla()
    assert os.environ["XLA_FLAGS"] == "--xla_cpu_enable_fast_math=false"


@pytest.mark.parametrize("user_setting", [None, "true"])
def test_programs_run_in_the_calling_thread_unless_the_user_chose_otherwise(
    monkeypatch, user_setting
):
    monkeypatch.delenv(xla.ASYNC_DISPATCH, raising=False)
    if user_setting is not None:
        monkeypatch.setenv(xla.ASYNC_DISPATCH, user_setting)
    option = xla.ASYNC_DISPATCH.lower()
    before = jax.config.values[option]
    jax.config.update(option, True)
    try:
        xla.configure_xla()
        assert jax.config.values[option] == (user_setting is not None)
    finally:
        jax.config.update(option, before)


@our_flags
@on_cpu
def test_sums_do_not_call_a_library():
    shape = jax.ShapeDtypeStruct((2048, 2048), jnp.float32)
    program = str(jax.jit(lambda x: jnp.sum(x, 0)).lower(shape).compile().as_text())
    assert "ynn_fusion" not in program


@our_flags
@on_cpu
@pytest.mark.parametrize(("numbers", "one_function"), [(64, True), (100_000_000, False)])
def test_a_loop_that_moves_little_becomes_one_function(numbers, one_function):
    loop = jax.jit(lambda x: jax.lax.scan(lambda c, x: (c + jnp.sin(x), c * x), x[0], x))
    shape = jax.ShapeDtypeStruct((3, numbers), jnp.float32)
    program = str(loop.lower(shape).compile().as_text())
    assert ("xla_cpu_small_call" in program) == one_function
