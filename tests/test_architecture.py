"""The plan of the house: who imports whom, how long a file is, and that all of it is documented."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LONGEST = 380  # lines
FULLEST = 12  # modules in a folder
ENGINE = "batching maths world solvers stages pipeline presets record".split()
FITTING_WINGS = (
    "runtime datasets problem inference analysis experiments studies report bench cli"
).split()
STAGES = ("contact root probe stride_probe target lean lock pelvis effector leg foot").split()
LIBRARIES = {"jax", "equinox", "jaxtyping", "numpy", "lazy_loader"}
UNMENDED = {  # arrows that still run back up
    "analysis/accuracy.py": {"report"},
    "analysis/difference.py": {"report"},
    "analysis/worst_window.py": {"report"},
    "studies/comparison.py": {"report"},
}
ONE_ROOM_EACH = {
    "trimesh": "datasets/terrain/mesh_files",
    "optimistix": "inference/optimisation/levenberg_marquardt",
    "emcee": "inference/sampling/sampler",
}

JAXIK = sorted((ROOT / "jaxik").rglob("*.py"))
FITTING = sorted((ROOT / "fitting").rglob("*.py"))
TREES = {path: ast.parse(path.read_text(encoding="utf-8")) for path in JAXIK + FITTING}


def each(paths: list[Path]) -> pytest.MarkDecorator:
    names = [path.relative_to(ROOT).as_posix() for path in paths]
    return pytest.mark.parametrize("path", paths, ids=names)


def imports(path: Path) -> set[str]:
    """Absolute dotted names of everything that a module imports."""
    package = path.relative_to(ROOT).parent.parts
    names = set()
    for node in ast.walk(TREES[path]):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            base = ".".join([*above, *([node.module] if node.module else [])])
            names |= {f"{base}.{alias.name}" for alias in node.names}
    return names


def packages(path: Path) -> set[str]:
    """Top-level packages that a module imports."""
    return {name.partition(".")[0] for name in imports(path)}


def wings(path: Path, package: str) -> set[str]:
    """Wings of a package that a module imports, its own left out."""
    parts = [name.split(".") for name in imports(path)]
    own = path.relative_to(ROOT / package).with_suffix("").parts[0]
    return {names[1] for names in parts if names[0] == package and len(names) > 1} - {own}


def inner(package: str, order: list[str]) -> list[Path]:
    """Modules of the wings of a package."""
    files = [path for path in TREES if path.is_relative_to(ROOT / package)]
    return [p for p in files if p.relative_to(ROOT / package).with_suffix("").parts[0] in order]


def test_the_plan_names_every_wing_and_no_other():
    for package, order in (("jaxik", ENGINE), ("fitting", FITTING_WINGS)):
        tops = {
            path.relative_to(ROOT / package).parts[0] for path in (ROOT / package).rglob("*.py")
        }
        assert {Path(top).stem for top in tops} - {"__init__"} == set(order)


@each(JAXIK)
def test_jaxik_imports_its_libraries_and_the_standard_library_only(path):
    foreign = packages(path) - LIBRARIES - sys.stdlib_module_names - {"jaxik"}
    assert not foreign, f"{path.name} imports {sorted(foreign)}"
    assert not packages(path) & {"os", "pathlib"}, "files and paths are the business of fitting"


@each(inner("jaxik", ENGINE))
def test_a_wing_of_jaxik_imports_only_wings_before_it(path):
    own = path.relative_to(ROOT / "jaxik").with_suffix("").parts[0]
    late = wings(path, "jaxik") - set(ENGINE[: ENGINE.index(own)])
    assert not late, f"{own} comes before {sorted(late)} in {ENGINE}"


@each([path for path in JAXIK if path.stem in STAGES])
def test_a_stage_imports_only_stages_before_it(path):
    before = STAGES[: STAGES.index(path.stem)]
    names = [name.split(".") for name in imports(path) if name.startswith("jaxik.stages.")]
    late = {parts[2] for parts in names} - set(before)
    assert not late, f"{path.stem} comes before {sorted(late)} in {STAGES}"


@each(inner("fitting", FITTING_WINGS))
def test_a_wing_of_fitting_imports_only_wings_before_it(path):
    own = path.relative_to(ROOT / "fitting").with_suffix("").parts[0]
    late = wings(path, "fitting") - set(FITTING_WINGS[: FITTING_WINGS.index(own)])
    late -= UNMENDED.get(path.relative_to(ROOT / "fitting").as_posix(), set())
    assert not late, f"{own} comes before {sorted(late)} in {FITTING_WINGS}"


@pytest.mark.parametrize(("library", "room"), ONE_ROOM_EACH.items())
def test_a_heavy_library_is_seen_by_one_module_of_fitting_only(library, room):
    seen = {path for path in TREES if library in packages(path)}
    assert seen == {ROOT / "fitting" / f"{room}.py"}


def test_no_folder_is_crowded():
    folders = {path.parent for path in TREES}
    count = {
        folder: len([p for p in folder.glob("*.py") if p.stem != "__init__"]) for folder in folders
    }
    assert not {folder: n for folder, n in count.items() if n > FULLEST}


@each(JAXIK + FITTING)
def test_a_file_says_what_it_is_for_and_is_not_too_long(path):
    assert ast.get_docstring(TREES[path]), "the module has no docstring"
    lines = len(path.read_text(encoding="utf-8").splitlines())
    assert lines <= LONGEST, f"{lines} lines; {LONGEST} at most"


CLASSES = {
    node.name: node
    for tree in TREES.values()
    for node in ast.walk(tree)
    if isinstance(node, ast.ClassDef)
}


def inherits(owner: ast.ClassDef, method: str) -> bool:
    """Whether a base class of ours has, and so documents, this method."""
    names = [base.id for base in owner.bases if isinstance(base, ast.Name)]
    bases = [CLASSES[name] for name in names if name in CLASSES]
    own = {node.name for base in bases for node in base.body if isinstance(node, ast.FunctionDef)}
    return method in own or any(inherits(base, method) for base in bases)


def undocumented(body: list[ast.stmt], owner: ast.ClassDef | None = None) -> Iterator[str]:
    """Public classes, functions and methods without a docstring, by name and line."""
    for node in body:
        if not isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if node.name.startswith("_") or (owner is not None and inherits(owner, node.name)):
            continue
        if not ast.get_docstring(node):
            yield f"{owner.name + '.' if owner else ''}{node.name} (line {node.lineno})"
        if isinstance(node, ast.ClassDef):
            yield from undocumented(node.body, node)


@each(JAXIK + FITTING)
def test_everything_public_says_what_it_does(path):
    missing = list(undocumented(TREES[path].body))
    assert not missing, f"no docstring: {missing}"
