"""Settings of XLA and JAX: only known flags, with the user's, and with the promised effect."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest

from fitting.runtime import xla
from support.experiments import ROOT

OF_USER = "--xla_cpu_enable_fast_math=false"
START = """
import os
from fitting.runtime import xla
xla.configure_xla()
import jax.numpy as jnp
print(float(jnp.ones(3).sum()), os.environ.get("XLA_FLAGS", ""))
"""


def needs(flag: str) -> pytest.MarkDecorator:
    """Skips a test of what a flag does where this process does not have it."""
    absent = flag not in os.environ.get("XLA_FLAGS", "").split()
    return pytest.mark.skipif(
        absent or jax.default_backend() != "cpu", reason=f"needs a CPU and {flag}"
    )


def test_the_pinned_jaxlib_has_flags():
    pinned = (ROOT / ".ci" / "constraints.txt").read_text(encoding="utf-8").splitlines()
    (version,) = (line.removeprefix("jaxlib==") for line in pinned if line.startswith("jaxlib=="))
    assert xla.FLAGS[version]


def test_an_untried_jaxlib_gets_no_flags_and_says_so(monkeypatch):
    monkeypatch.setattr(xla, "jaxlib_version", lambda: "99.0.0")
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    xla.configure_xla()
    assert "XLA_FLAGS" not in os.environ
    assert xla.describe_flags().startswith("none; which flags jaxlib 99.0.0 knows")


@pytest.mark.parametrize("version", xla.FLAGS)
def test_flags_are_set_where_there_are_none(monkeypatch, version):
    monkeypatch.setattr(xla, "jaxlib_version", lambda: version)
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    xla.configure_xla()
    flags = os.environ["XLA_FLAGS"]
    assert flags.split() == list(xla.FLAGS[version])
    assert xla.describe_flags() == flags


def test_flags_of_the_user_stay_and_take_precedence(monkeypatch):
    monkeypatch.setattr(xla, "jaxlib_version", lambda: "0.12.0")
    monkeypatch.setenv("XLA_FLAGS", f"{OF_USER} --xla_cpu_prefer_vector_width=128")
    xla.configure_xla()
    first, *_, last_but_one, last = os.environ["XLA_FLAGS"].split()
    assert first == xla.VECTORS
    # XLA takes the later of two values for one flag.
    assert [last_but_one, last] == [OF_USER, "--xla_cpu_prefer_vector_width=128"]


def test_flags_are_added_once(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", OF_USER)
    xla.configure_xla()
    once = os.environ["XLA_FLAGS"]
    xla.configure_xla()
    assert os.environ["XLA_FLAGS"] == once


@pytest.mark.parametrize("of_user", ["", "flags.txt"])
def test_nothing_is_added_to_an_empty_value_or_a_file(monkeypatch, of_user):
    monkeypatch.setenv("XLA_FLAGS", of_user)
    xla.configure_xla()
    assert os.environ["XLA_FLAGS"] == of_user


@pytest.mark.parametrize("of_user", [None, OF_USER])
def test_the_installed_jaxlib_starts_with_its_flags(of_user):
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    if of_user is not None:
        environment["XLA_FLAGS"] = of_user
    command = [sys.executable, "-c", START]
    started = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True
    )
    flags = [*xla.FLAGS.get(xla.jaxlib_version(), ()), *(of_user or "").split()]
    assert started.stdout.split() == ["3.0", *flags]


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


@needs(xla.REDUCTIONS)
def test_sums_do_not_call_a_library():
    shape = jax.ShapeDtypeStruct((2048, 2048), jnp.float32)
    program = str(jax.jit(lambda x: jnp.sum(x, 0)).lower(shape).compile().as_text())
    assert "ynn_fusion" not in program


@needs(xla.LOOPS)
@pytest.mark.parametrize(("numbers", "one_function"), [(64, True), (100_000_000, False)])
def test_a_loop_that_moves_little_becomes_one_function(numbers, one_function):
    loop = jax.jit(lambda x: jax.lax.scan(lambda c, x: (c + jnp.sin(x), c * x), x[0], x))
    shape = jax.ShapeDtypeStruct((3, numbers), jnp.float32)
    program = str(loop.lower(shape).compile().as_text())
    assert ("xla_cpu_small_call" in program) == one_function
