"""The plan of the house: who imports whom, how long a file is, and that all of it is documented."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LONGEST = 350  # lines
ORDER = (
    "struct equations many vec quat gate ease rule skeleton limb aim cells grid terrain frame "
    "contact root probe stride target lean lock pelvis effector leg foot pipeline presets record"
).split()
LIBRARIES = {"jax", "equinox", "jaxtyping", "numpy"}
ONE_ROOM_EACH = {"trimesh": "scenes", "optimistix": "march", "emcee": "sampler"}

JAXIK = sorted((ROOT / "jaxik").rglob("*.py"))
FITTING = sorted((ROOT / "fitting").rglob("*.py"))
TREES = {path: ast.parse(path.read_text(encoding="utf-8")) for path in JAXIK + FITTING}


def each(paths: list[Path]) -> pytest.MarkDecorator:
    names = [path.relative_to(ROOT).as_posix() for path in paths]
    return pytest.mark.parametrize("path", paths, ids=names)


def packages(path: Path) -> set[str]:
    """Top-level packages that a module imports, its own relative imports left out."""
    found = set()
    for node in ast.walk(TREES[path]):
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            found.add(str(node.module).partition(".")[0])
    return found


def rooms(path: Path) -> set[str]:
    """Modules of its own package that a module imports."""
    found = set()
    for node in ast.walk(TREES[path]):
        if isinstance(node, ast.ImportFrom) and node.level:
            found |= {node.module} if node.module else {alias.name for alias in node.names}
    return found


def test_the_plan_names_every_room_of_jaxik_and_no_other():
    assert {path.stem for path in JAXIK} - {"__init__"} == set(ORDER)
    assert all(path.parent == ROOT / "jaxik" for path in JAXIK)


@each(JAXIK)
def test_jaxik_imports_its_four_libraries_and_the_standard_library_only(path):
    foreign = packages(path) - LIBRARIES - sys.stdlib_module_names
    assert not foreign, f"{path.name} imports {sorted(foreign)}"
    assert not packages(path) & {"os", "pathlib"}, "files and paths are the business of fitting"


@each([path for path in JAXIK if path.stem in ORDER])
def test_a_room_of_jaxik_imports_only_rooms_before_it(path):
    before = ORDER[: ORDER.index(path.stem)]
    late = rooms(path) - set(before)
    assert not late, f"{path.stem} may import {before}, and imports {sorted(late)}"


@pytest.mark.parametrize(("library", "room"), ONE_ROOM_EACH.items())
def test_a_heavy_library_is_seen_by_one_room_of_fitting_only(library, room):
    seen = {path for path in TREES if library in packages(path)}
    assert seen == {ROOT / "fitting" / f"{room}.py"}


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
