"""Whether the packages that jaxik needs, and those of its extras, are there and can be imported."""

import importlib
import platform
import sys
import warnings
from collections.abc import Iterator
from importlib import metadata
from importlib.machinery import PathFinder
from pathlib import Path

from packaging.requirements import Requirement

from fitting.cli import jax_start
from fitting.runtime import activity
from fitting.runtime.validation import in_one_line

from .findings import Finding

PACKAGES = ("jaxik", "fitting")
FOR_DEVELOPERS = {"test", "dev", "docs", "mutation"}  # extras that no command needs


def examine() -> Iterator[Finding]:
    """Python, jaxik, the packages it needs, its extras, and what hides its name."""
    yield Finding("Python", f"{platform.python_version()}, {sys.executable}")
    try:
        yield Finding("jaxik", f"{metadata.version('jaxik')}, {Path(__file__).parents[3]}")
        requirements = [Requirement(text) for text in metadata.requires("jaxik") or ()]
    except metadata.PackageNotFoundError:
        problem = "jaxik is not installed, only its source is on the path"
        yield Finding("jaxik", str(Path(__file__).parents[3]), problem, "pip install jaxik")
        return
    needed = [requirement for requirement in requirements if requirement.marker is None]
    yield _packages("packages", needed, "pip install --upgrade jaxik")
    for extra in metadata.metadata("jaxik").get_all("Provides-Extra") or ():
        if extra not in FOR_DEVELOPERS:
            yield _extra(extra, [r for r in requirements if _is_of(r, extra)])
    yield from _names_in(Path.cwd())


def _is_of(requirement: Requirement, extra: str) -> bool:
    """Whether it is needed for this extra, and not without it."""
    marker = requirement.marker
    if marker is None or marker.evaluate({"extra": ""}):
        return False
    return marker.evaluate({"extra": extra})


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
        installed = Path(__file__).parents[3] / name
        if spec is None or spec.origin is None or Path(spec.origin).parent == installed:
            continue
        problem = f"{spec.origin} hides the package {name} from Python that runs in this folder"
        yield Finding("names", str(folder), problem, "rename it, or work in another folder")
