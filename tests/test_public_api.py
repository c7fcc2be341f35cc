"""What the packages offer, to Python, editors, type checkers and readers, and what they need."""

import ast
import os
import pydoc
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path
from types import ModuleType

import pytest
from hatchling.builders.wheel import WheelBuilder

import fitting
import house
import jaxik

ROOT = house.ROOT


def stub_names(package: ModuleType) -> list[str]:
    """Public names of a package, from the stub that type checkers read."""
    stub = Path(str(package.__file__)).with_suffix(".pyi")
    nodes = ast.walk(ast.parse(stub.read_text(encoding="utf-8")))
    imports = [node for node in nodes if isinstance(node, ast.ImportFrom)]
    return [alias.asname or alias.name for node in imports for alias in node.names]


@pytest.mark.parametrize("package", house.PACKAGES)
def test_importing_a_package_does_not_import_jax(package):
    code = f"import sys, {package}; print('equinox' in sys.modules, 'jax' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True, text=True
    )
    assert done.stdout.split() == ["False", "False"]


@pytest.mark.parametrize("package", [jaxik, fitting])
def test_every_name_in_the_stub_can_be_imported_and_completed(package):
    names = stub_names(package)
    assert len(names) > 5
    assert set(names) <= set(dir(package)) and set(names) <= set(package.__all__)
    for name in names:
        assert getattr(package, name) is not None


def test_an_unknown_name_is_an_error():
    with pytest.raises(AttributeError, match="No jaxik attribute wings"):
        jaxik.wings  # type: ignore[attr-defined]  # noqa: B018
    with pytest.raises(ImportError, match="cannot import name 'wings'"):
        from jaxik import wings  # type: ignore[attr-defined]  # noqa: F401


def test_the_wheel_carries_stubs_types_files_of_pages_and_examples_and_stays_small(tmp_path):
    (wheel,) = WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    for package in house.PACKAGES:
        assert {f"{package}/{name}" for name in ("py.typed", "__init__.pyi")} <= names
    page = ROOT / "fitting" / "report"
    files = [path for folder in ("templates", "assets") for path in (page / folder).iterdir()]
    assert files and {path.relative_to(ROOT).as_posix() for path in files} <= names
    shipped = {"experiments/uneven_walk.toml", "clips/uneven_walk.npz", "terrains/uneven_walk.ply"}
    assert {f"fitting/examples/{name}" for name in shipped} <= names
    assert Path(wheel).stat().st_size < 3e6


def test_help_on_the_package_lists_its_public_names():
    text = pydoc.render_doc(jaxik, renderer=pydoc.plaintext)  # type: ignore[attr-defined]
    assert "    class FootIK(" in text and "    run(ik: " in text


@pytest.mark.slow
def test_mypy_knows_the_type_of_every_public_name(tmp_path):
    names = [f"{p.__name__}.{name}" for p in (jaxik, fitting) for name in stub_names(p)]
    code = "\n".join(["import fitting, jaxik", *(f"reveal_type({name})" for name in names)])
    command = [sys.executable, "-m", "mypy", "--follow-imports=silent", f"--cache-dir={tmp_path}"]
    done = subprocess.run([*command, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    revealed = [line for line in done.stdout.splitlines() if "Revealed type is" in line]
    assert len(revealed) == len(names)
    unknown = ('"Any"', "JitWrapped")  # a compiled function must keep its signature
    assert [line for line in revealed if any(word in line for word in unknown)] == []


@pytest.mark.slow
def test_the_api_reference_has_a_page_for_every_module(tmp_path):
    command = [sys.executable, "-W", "error", "-m", "pdoc", "--docformat", "google"]
    command += ["--output-directory", str(tmp_path), *house.PACKAGES]
    # pdoc warns of a value that is also in the environment, where the tests put the flags.
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert not done.returncode, done.stderr
    assert (done.stdout, done.stderr) == ("", "")
    files = [path for name in house.PACKAGES for path in house.parsed(name).files]
    names = [path.parent if path.stem == "__init__" else path.with_suffix("") for path in files]
    pages = {path.relative_to(ROOT).with_suffix(".html").as_posix() for path in names}
    assert not {page for page in pages if not (tmp_path / page).is_file()}
    assert 'id="run"' in (tmp_path / "jaxik.html").read_text(encoding="utf-8")


def test_the_lowest_version_of_jax_is_the_one_on_which_all_tests_run_and_there_is_no_highest():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = (ROOT / ".ci" / "constraints.txt").read_text(encoding="utf-8").split()
    pinned = dict(line.split("==") for line in lines)
    wanted = {f"{name}>={pinned[name]}" for name in ("jax", "equinox", "optimistix", "lineax")}
    extra = project["optional-dependencies"]["fit"]
    assert wanted <= {*project["dependencies"], *extra}
