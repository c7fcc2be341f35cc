"""Starts JAX for a command, whatever variables of the environment say.

JAX fails at some values long after it was imported, and XLA ends the process at others: those are
refused here, in a line. Settings for debugging under which no command can work are switched off.
"""

import functools
import os
import re
import subprocess
import sys

from fitting.runtime import xla
from fitting.runtime.validation import in_one_line

PARSED = "from jaxlib import xla_client; xla_client.CompileOptions()"  # reads the flags
REASON = re.compile(r"^[EF]\d{4} [^]]*\] (.*)", re.MULTILINE)  # in what XLA prints as it ends
OF_DEVICES = (*xla.PLATFORMS, "JAX_NUM_CPU_DEVICES")


class StartError(ValueError):
    """JAX cannot start; the message ends with what to do about it."""

    def __init__(self, problem: str, remedy: str):
        super().__init__(f"{problem}; {remedy}")
        self.problem = problem
        self.remedy = remedy


def start() -> None:
    """Imports JAX, sets what suits these programs, and lets it find its devices: the CPU's.

    `JAX_PLATFORMS` names other ones.

    Raises:
        StartError: a variable of the environment has a value that JAX or XLA refuses, or there is
            no device.
    """
    if flags := os.environ.get(xla.VARIABLE):
        _check_flags(flags)
    try:
        xla.configure_xla()
        import jax
    except ValueError as error:
        raise about_variable(error) or error from None
    xla.ignore_debugging()
    names = [name for name in OF_DEVICES if name in os.environ]
    xla.prefer_cpu()
    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:  # JAX asserts that there is any
        values = "".join(f" with {name}={os.environ[name]}" for name in names)
        reason = in_one_line(error).partition(" (")[0] if str(error) else "there is none like that"
        remedy = f"unset {' and '.join(names)}, or set" if names else "set"
        raise StartError(
            f"JAX finds no device{values}: {reason}", f"{remedy} JAX_PLATFORMS=cpu"
        ) from None


def about_variable(error: Exception) -> StartError | None:
    """What to say of an error of JAX about a variable of the environment; None of another one."""
    for name in re.findall(r"jax_\w+", str(error), re.IGNORECASE):
        if (variable := name.upper()) in os.environ:
            return StartError(in_one_line(error), f"correct or unset {variable}")
    return None


@functools.cache  # a process may run many commands
def _check_flags(flags: str) -> None:
    """Raises StartError for flags at which XLA would end the process; another one tries them."""
    command = [sys.executable, "-P", "-c", PARSED]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode and (reason := REASON.search(done.stderr)):
        raise StartError(
            f"XLA refuses XLA_FLAGS={flags}: {reason[1]}",
            "unset XLA_FLAGS, or correct it",
        )
