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


def flags_with(of_user: str | None, monkeypatch, version: str = "0.12.0") -> str | None:
    """The variable with the flags after a start with what the user had set."""
    monkeypatch.setattr(xla, "jaxlib_version", lambda: version)
    monkeypatch.delenv(xla.VARIABLE, raising=False)
    if of_user is not None:
        monkeypatch.setenv(xla.VARIABLE, of_user)
    xla.configure_xla()
    return os.environ.get(xla.VARIABLE)


def test_an_untried_jaxlib_gets_no_flags_and_says_so(monkeypatch):
    assert flags_with(None, monkeypatch, "99.0.0") is None
    assert xla.describe_flags().startswith("none; which flags jaxlib 99.0.0 knows")


def test_flags_are_set_where_there_are_none(monkeypatch):
    for version, known in xla.FLAGS.items():
        flags = flags_with(None, monkeypatch, version)
        assert flags == " ".join(known) == xla.describe_flags(), version


def test_flags_of_the_user_stay_and_take_precedence_as_the_later_ones(monkeypatch):
    of_user = f"{OF_USER} --xla_cpu_prefer_vector_width=128"
    flags = flags_with(of_user, monkeypatch)
    assert flags == " ".join([*xla.FLAGS["0.12.0"], of_user])
    assert flags_with(flags, monkeypatch) == flags  # and are added once


@pytest.mark.parametrize("of_user", ["", "flags.txt"])
def test_nothing_is_added_to_an_empty_value_or_a_file(monkeypatch, of_user):
    assert flags_with(of_user, monkeypatch) == of_user


def test_the_installed_jaxlib_starts_with_its_flags():
    done = subprocess.run(
        [sys.executable, "-c", START], cwd=ROOT, env=os.environ | {"XLA_FLAGS": OF_USER},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout.split() == ["3.0", *xla.FLAGS.get(xla.jaxlib_version(), ()), OF_USER]


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
