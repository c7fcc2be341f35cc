"""The structure of the two packages: who imports whom, and what every file must have."""

import ast
import re
import sys
import tomllib
from pathlib import Path

import pytest

import house
from house import parsed

ROOT = house.ROOT
WINGS = {  # in import order: a wing may import those before it
    "jaxik": ["batching", "maths", "world", "solvers", "stages", "pipeline", "presets", "record"],
    "fitting": [
        "runtime", "codegen", "clips", "ground", "synthetic", "problem", "inference", "motion",
        "experiment", "report", "studies", "viewer", "jobs", "bench", "cli",
    ],
}  # fmt: skip
STAGES = ["inputs", "contact", "root", "warp", "probe", "target", "lean", "lock", "separation"]
STAGES += ["pelvis", "effector", "fade", "leg", "foot"]
LIBRARIES_OF_JAXIK = {"jax", "equinox", "jaxtyping", "numpy", "lazy_loader"}
ONLY_IMPORTED_BY = {
    "trimesh": "fitting/ground/meshes.py",
    "optimistix": "fitting/inference/optimise/levenberg_marquardt.py",
    "emcee": "fitting/inference/sample/sampler.py",
}


def trees() -> dict[Path, ast.Module]:
    """Of all modules of both packages."""
    return {path: tree for name in WINGS for path, tree in parsed(name).trees.items()}


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def imports(path: Path) -> set[str]:
    """Absolute dotted names of everything that a module imports."""
    return house.imported_names(path, trees()[path])


def imported_packages(path: Path) -> set[str]:
    """Top-level packages that a module imports."""
    return {name.partition(".")[0] for name in imports(path)}


def imported_below(path: Path, folder: str) -> set[str]:
    """Names of what lies in a folder and is imported by a module."""
    below = [name for name in imports(path) if name.startswith(f"{folder}.")]
    return {name.removeprefix(f"{folder}.").partition(".")[0] for name in below}


def package_and_wing(path: Path) -> tuple[str, str]:
    """The package of a file and its wing in it."""
    home, wing, *_ = path.relative_to(ROOT).with_suffix("").parts
    return home, wing


@pytest.mark.parametrize("name", WINGS)
def test_every_wing_has_its_place_in_the_import_order(name):
    wings = {package_and_wing(path)[1] for path in parsed(name).files}
    assert wings - {"__init__"} == set(WINGS[name])


def test_a_wing_imports_only_wings_before_it():
    offenders = {}
    for path in trees():
        home, own = package_and_wing(path)
        if own != "__init__":
            allowed = {own, *WINGS[home][: WINGS[home].index(own)]}
            offenders[name_of(path)] = imported_below(path, home) - allowed
    assert not {path: sorted(later) for path, later in offenders.items() if later}, WINGS


def test_a_stage_imports_only_stages_before_it():
    folder, offenders, met = ROOT / "jaxik" / "stages", {}, set()
    for path in parsed("jaxik").files:
        if folder in path.parents:
            stage = path.relative_to(folder).with_suffix("").parts[0]
            if stage in STAGES:
                met.add(stage)
                allowed = {stage, *STAGES[: STAGES.index(stage)]}
                offenders[name_of(path)] = imported_below(path, "jaxik.stages") - allowed
    assert met == set(STAGES)
    assert not {path: sorted(later) for path, later in offenders.items() if later}, STAGES


def test_jaxik_imports_nothing_but_its_libraries_and_touches_no_files():
    allowed = {*LIBRARIES_OF_JAXIK, *sys.stdlib_module_names, "jaxik"} - {"os", "pathlib"}
    foreign = {name_of(path): imported_packages(path) - allowed for path in parsed("jaxik").files}
    assert not {path: names for path, names in foreign.items() if names}


def test_jaxik_alone_requires_its_libraries_and_no_more():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    required = {re.split("[>=<]", text)[0].replace("-", "_") for text in project["dependencies"]}
    assert required == LIBRARIES_OF_JAXIK
    assert "trimesh>=4.5" in project["optional-dependencies"]["fit"]


@pytest.mark.parametrize(("library", "module"), ONLY_IMPORTED_BY.items())
def test_a_heavy_library_is_imported_by_one_module_only(library, module):
    assert {name_of(path) for path in trees() if library in imported_packages(path)} == {module}


def test_everything_public_has_a_docstring():
    bare = [name_of(path) for path, tree in trees().items() if not ast.get_docstring(tree)]
    assert bare == [], "modules without a docstring"
    missing = {path: parsed(package_and_wing(path)[0]).undocumented(path) for path in trees()}
    assert not {name_of(path): names for path, names in missing.items() if names}


@pytest.mark.parametrize("name", house.PACKAGES)
def test_the_figures_of_a_package_are_within_their_limits(name):
    missed = [str(figure) for figure in house.package_figures(name) if not figure.is_within_limits]
    assert not missed, "\n".join(missed)


def test_the_figures_of_the_readme_are_within_their_limits():
    assert house.readme_figure().is_within_limits
