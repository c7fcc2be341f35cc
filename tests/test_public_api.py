"""What `import jaxik` gives: little at once, all of it when asked for."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import fitting
import jaxik

FACE = Path(jaxik.__file__)


def test_importing_jaxik_waits_with_what_it_names():
    code = "import sys, jaxik; print('equinox' in sys.modules, 'jax' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=FACE.parents[1],
        check=True,
        capture_output=True,
        text=True,
    )
    assert done.stdout.split() == ["False", "False"]


@pytest.mark.parametrize("package", [jaxik, fitting])
def test_every_name_that_type_checkers_see_is_there(package):
    stub = Path(package.__file__).with_suffix(".pyi")
    names = [
        alias.asname or alias.name
        for node in ast.walk(ast.parse(stub.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    ]
    assert len(names) > 5
    assert set(names) <= set(dir(package)) and set(names) <= set(package.__all__)
    for name in names:
        assert getattr(package, name) is not None


def test_a_name_that_there_is_not_is_told():
    with pytest.raises(AttributeError, match="No jaxik attribute wings"):
        jaxik.wings  # type: ignore[attr-defined]  # noqa: B018
    with pytest.raises(ImportError, match="cannot import name 'wings'"):
        from jaxik import wings  # type: ignore[attr-defined]  # noqa: F401
