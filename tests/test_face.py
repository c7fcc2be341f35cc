"""What `import jaxik` gives: little at once, all of it when asked for."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import jaxik

FACE = Path(jaxik.__file__)


def test_importing_jaxik_waits_with_what_it_names():
    code = "import sys, jaxik; print('equinox' in sys.modules, 'jax' in sys.modules)"
    told = subprocess.run(
        [sys.executable, "-c", code],
        cwd=FACE.parents[1],
        check=True,
        capture_output=True,
        text=True,
    )
    assert told.stdout.split() == ["False", "False"]


def test_every_name_that_type_checkers_see_is_there_and_is_the_rooms_own():
    seen = [
        (node.module, alias.name)
        for node in ast.walk(ast.parse(FACE.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and node.level
        for alias in node.names
    ]
    assert len(seen) > 10
    for room, name in seen:
        jaxik.__dict__.pop(name, None)
        found = getattr(jaxik, name)
        assert found is (
            getattr(getattr(jaxik, room), name) if room else sys.modules[f"jaxik.{name}"]
        )
        assert name in dir(jaxik)


def test_a_name_that_there_is_not_is_told():
    with pytest.raises(AttributeError, match="module 'jaxik' has no attribute 'wings'"):
        jaxik.wings  # type: ignore[attr-defined]  # noqa: B018
    with pytest.raises(ImportError, match="cannot import name 'wings'"):
        from jaxik import wings  # type: ignore[attr-defined]  # noqa: F401


def test_a_room_that_lacks_a_library_says_which(monkeypatch):
    def lacking(room, package):
        raise ModuleNotFoundError("No module named 'equinox'", name="equinox")

    monkeypatch.setattr(jaxik, "import_module", lacking)
    monkeypatch.delitem(jaxik.__dict__, "record", raising=False)
    with pytest.raises(ModuleNotFoundError, match="No module named 'equinox'"):
        jaxik.record  # noqa: B018
