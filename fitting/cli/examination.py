"""The examination as a whole, and how it is printed."""

import importlib
import json
import os
import platform
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from importlib.machinery import PathFinder
from pathlib import Path

from packaging.requirements import Requirement

from fitting.report.formatting import wrapped
from fitting.runtime import activity, machine
from fitting.runtime.validation import in_one_line

from . import jax_start
from .terminal import show

LONGEST = 300.0  # s, for what needs JAX; it takes half a minute on two slow cores
WITH_JAX = "fitting.cli.with_jax"

PACKAGES = ("jaxik", "fitting")
COMMANDS = "fit"  # the extra that brings what every command needs
FOR_DEVELOPERS = {"test", "dev", "docs", "mutation"}  # extras that no command needs

NEEDED_GB = 1.0  # the self-test, which fits one parameter to 12 s of motion, takes 0.6


@dataclass(frozen=True)
class Finding:
    """One line of the examination."""

    subject: str
    fact: str
    problem: str = ""
    """What is wrong, in a line; empty if nothing is."""
    remedy: str = ""
    """What to do about it."""

    def to_json(self) -> str:
        """One line, for another process."""
        return json.dumps(asdict(self))


def from_json(line: str) -> Finding | None:
    """The finding that another process printed; None for any other line."""
    try:
        return Finding(**json.loads(line))
    except (ValueError, TypeError):
        return None


def examine(*, quick: bool) -> Iterator[Finding]:
    """Everything that there is to find; `quick` leaves the self-test out."""
    yield from _guarded("packages", lambda: examine_installation())
    yield from _guarded("machine", examine_machine)
    yield from _guarded("JAX", lambda: _in_other_process(["--quick"] if quick else []))


def print_findings(findings: Iterator[Finding], width: int) -> int:
    """Prints each finding at once, and at the end all problems, of which it returns the number.

    Lines have at most `width` characters.
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


def _guarded(subject: str, examine: Callable[[], Iterator[Finding]]) -> Iterator[Finding]:
    """The findings; one more where the examination itself fails."""
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


def examine_installation() -> Iterator[Finding]:
    """Python, jaxik, the packages it needs, its extras, and what hides its name."""
    yield Finding("Python", f"{platform.python_version()}, {sys.executable}")
    try:
        yield Finding("jaxik", f"{metadata.version('jaxik')}, {Path(__file__).parents[2]}")
        requirements = [Requirement(text) for text in metadata.requires("jaxik") or ()]
    except metadata.PackageNotFoundError:
        problem = "jaxik is not installed, only its source is on the path"
        yield Finding("jaxik", str(Path(__file__).parents[2]), problem, "pip install jaxik")
        return
    needed = [requirement for requirement in requirements if _is_of(requirement, COMMANDS)]
    yield _packages("packages", needed, 'pip install --upgrade "jaxik[fit]"')
    names = {requirement.name for requirement in needed}
    for extra in metadata.metadata("jaxik").get_all("Provides-Extra") or ():
        if extra not in (COMMANDS, *FOR_DEVELOPERS):
            others = [r for r in requirements if _is_of(r, extra) and r.name not in names]
            yield _extra(extra, others)
    yield from _names_in(Path.cwd())


def _is_of(requirement: Requirement, extra: str) -> bool:
    """Whether it is needed with this extra."""
    return requirement.marker is None or requirement.marker.evaluate({"extra": extra})


def _extra(extra: str, requirements: list[Requirement]) -> Finding:
    """An extra that is installed, in part or not at all; only one that is broken is a problem."""
    missing = [r.name for r in requirements if _version(r.name) is None]
    if missing:
        fact = f'not installed: {", ".join(missing)}; pip install "jaxik[{extra}]"'
        return Finding(f"extra {extra}", fact)
    return _packages(f"extra {extra}", requirements, f'pip install --upgrade "jaxik[{extra}]"')


def _packages(subject: str, requirements: list[Requirement], remedy: str) -> Finding:
    """The versions of packages; a problem where one is missing, too old or cannot be imported."""
    versions = {requirement.name: _version(requirement.name) for requirement in requirements}
    fact = ", ".join(f"{name} {version or 'missing'}" for name, version in versions.items())
    with activity.announced(f"Importing {subject}"):
        problems = [_problem(entry, versions[entry.name]) for entry in requirements]
    return Finding(subject, fact, "; ".join(filter(None, problems)), remedy)


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _problem(requirement: Requirement, version: str | None) -> str:
    """What is wrong with a package; empty if nothing is."""
    if version is None:
        return f"{requirement.name} is missing"
    if not requirement.specifier.contains(version, prereleases=True):
        return f"{requirement.name} is {version}, wanted {requirement.specifier}"
    for module in _modules(requirement.name):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                importlib.import_module(module)
        except Exception as error:  # whatever a broken installation may raise
            if refusal := jax_start.about_variable(error):
                raise refusal from None
            return f"{module} cannot be imported: {in_one_line(error, 200)}"
    return ""


def _modules(name: str) -> list[str]:
    """The modules of an installed package that carry its name."""
    own = name.replace("-", "_").lower()
    files = metadata.files(name) or ()
    tops = {file.parts[0].removesuffix(".py") for file in files if file.suffix == ".py"}
    return [top for top in sorted(tops) if top.lower() == own]


def _names_in(folder: Path) -> Iterator[Finding]:
    """Files of a folder that hide our packages from Python scripts there."""
    for name in PACKAGES:
        spec = PathFinder.find_spec(name, [str(folder)])
        installed = Path(__file__).parents[2] / name
        if spec is None or spec.origin is None or Path(spec.origin).parent == installed:
            continue
        problem = f"{spec.origin} hides the package {name} from Python that runs in this folder"
        yield Finding("names", str(folder), problem, "rename it, or work in another folder")


def examine_machine() -> Iterator[Finding]:
    """Processor and memory."""
    width = machine.vector_bits()
    vectors = f", vectors of {width} bits" if width else ""
    yield Finding("processor", f"{machine.processor()}, {os.cpu_count()} cores{vectors}")
    total, free = (machine.memory_gb(key) for key in ("MemTotal", "MemAvailable"))
    if total is None or free is None:
        return
    problem = f"only {free:.1f} GB of memory are free" if free < NEEDED_GB else ""
    remedy = "close other programs; a fit takes about a gigabyte"
    yield Finding("memory", f"{total:.1f} GB, {free:.1f} GB of them free", problem, remedy)
