"""The examination as a whole, and how it is printed."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence

from fitting.cli import jax_start
from fitting.cli.terminal import show
from fitting.report.guides.layout import wrapped
from fitting.runtime import activity
from fitting.runtime.validation import in_one_line

from . import machine
from .findings import Finding, from_json

LONGEST = 300.0  # s, for what needs JAX; it takes half a minute on two slow cores
WITH_JAX = "fitting.cli.doctor.with_jax"


def examine(*, quick: bool) -> Iterator[Finding]:
    """Everything that there is to find; `quick` leaves the self-test out."""
    yield from _guarded("packages", _installation)
    yield from _guarded("machine", machine.examine)
    yield from _guarded("JAX", lambda: _in_other_process(["--quick"] if quick else []))


def print_findings(findings: Iterator[Finding], width: int) -> int:
    """Prints each finding at once, and at the end all problems with their remedies.

    Args:
        findings: of an examination.
        width: characters in a line.

    Returns:
        The number of problems.
    """
    problems = []
    for finding in findings:
        mark = "!" if finding.problem else " "
        show(wrapped([[f"{mark} {finding.subject:<18}", finding.fact]], width))
        if finding.problem:
            problems.append(finding)
    print()
    for finding in problems:
        print(f"! {finding.subject}: {finding.problem}\n  do: {finding.remedy}")
    print(f"{len(problems)} to mend" if problems else "all is well")
    return len(problems)


def _installation() -> Iterator[Finding]:
    from . import installation  # needs a package that may be broken, too

    return installation.examine()


def _guarded(subject: str, examine: Callable[[], Iterator[Finding]]) -> Iterator[Finding]:
    """The findings; one more where looking itself fails."""
    try:
        yield from examine()
    except jax_start.StartError as error:
        yield Finding(subject, "could not be examined", error.problem, error.remedy)
    except Exception as error:  # a broken installation may raise anything
        problem = f"{type(error).__name__}: {in_one_line(error, 300)}"
        yield Finding(subject, "could not be examined", problem, "pip install --upgrade jaxik")


def _in_other_process(options: Sequence[str]) -> Iterator[Finding]:
    """What a process that uses JAX finds; a problem where it fails.

    The process does not take packages from the folder in which the command runs.
    """
    command = [sys.executable, "-P", "-m", WITH_JAX, *options]
    environment = os.environ | {"PYTHONWARNINGS": "ignore"}
    title = "Importing JAX" if "--quick" in options else "Self-test, up to half a minute"
    try:
        with activity.announced(title):
            done = subprocess.run(
                command, env=environment, capture_output=True, text=True, timeout=LONGEST,
                check=False,
            )  # fmt: skip
    except subprocess.TimeoutExpired:
        problem = f"no result after {LONGEST:g} s"
        yield Finding("JAX", "too slow", problem, "close other programs, or try --quick")
        return
    yield from filter(None, map(from_json, done.stdout.splitlines()))
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if line.strip()]
        last = lines[-1][:300] if lines else ""
        problem = f"{_ending(done.returncode)}: {last}"
        yield Finding("JAX", "stopped", problem, "pip install --force-reinstall jaxik jax jaxlib")


def _ending(status: int) -> str:
    return f"ended by {signal.Signals(-status).name}" if status < 0 else f"ended with {status}"
