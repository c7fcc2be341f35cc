"""The command `jaxik cache`, and what commands say when programs cannot be kept."""

import os
import re
import subprocess
import sys
import warnings

import jax
import pytest

from fitting.cli import main
from fitting.runtime import cache_folder
from support.experiments import ROOT

DIGEST = "0123456789abcdef" * 4


@pytest.fixture
def folder(tmp_path):
    """A cache folder with a traced program, a compiled one, and files of somebody else."""
    before = cache_folder.setting(cache_folder.FOLDER)
    cache_folder.WARNED.clear()
    (tmp_path / "traced").mkdir()
    (tmp_path / "traced" / f"run-{DIGEST}").write_bytes(bytes(2_000_000))
    (tmp_path / f"jit_run-{DIGEST}-cache").write_bytes(bytes(300_000))
    (tmp_path / "notes.txt").touch()
    (tmp_path / "traced" / "notes.txt").touch()
    jax.config.update(cache_folder.FOLDER, str(tmp_path))
    yield tmp_path
    jax.config.update(cache_folder.FOLDER, before)


def test_it_shows_place_and_size_and_whether_it_is_used(folder, capsys):
    assert main.main(["cache"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"place              {folder}",
        "traced programs    1 (2.0 MB)",
        "compiled programs  1 (0.3 MB)",
        "used               yes",
    ]


def test_it_says_why_a_folder_is_not_used(folder, capsys):
    (folder / "traced").chmod(0o777)
    assert main.main(["cache"]) == 0
    output = capsys.readouterr().out
    assert output.endswith(f"\nused               no: everybody may write to {folder}/traced\n")
    jax.config.update(cache_folder.ENABLED, False)
    assert main.main(["cache"]) == 0
    jax.config.update(cache_folder.ENABLED, True)
    assert capsys.readouterr().out.endswith(f"no: {cache_folder.ENABLED} is off\n")


def test_clear_removes_the_programs_and_nothing_else(folder, capsys):
    assert main.main(["cache", "--clear"]) == 0
    assert capsys.readouterr().out == f"removed 1 traced and 1 compiled, 2.3 MB, from {folder}\n"
    left = [path.relative_to(folder) for path in folder.rglob("*") if path.is_file()]
    assert sorted(map(str, left)) == ["notes.txt", "traced/notes.txt"]


def test_the_folder_of_the_user_is_the_default(tmp_path):
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith("JAX_")
    } | {"XDG_CACHE_HOME": str(tmp_path)}
    output = subprocess.run(
        [sys.executable, "-m", "fitting.cli.main", "cache"],
        env=environment, cwd=ROOT, check=True, capture_output=True, text=True,
    )  # fmt: skip
    assert re.match(rf"place +{tmp_path}/jaxik\ntraced programs +0 .0.0 MB.\n", output.stdout)
    assert all(line.startswith("Importing JAX") for line in output.stderr.splitlines())


@pytest.mark.filterwarnings("default")
def test_jax_says_once_that_it_cannot_keep_programs(monkeypatch, capsys):
    def warn(_):
        for name in ("jit_a", "jit_b"):
            warnings.warn(f"Error writing {main.JAX_CACHE} entry for '{name}': disk", stacklevel=1)
        return 0

    monkeypatch.setattr("fitting.cli.commands.COMMANDS", {"cache": warn})
    assert main.main(["cache"]) == 0
    expected = f"jaxik: Error writing {main.JAX_CACHE} entry for 'jit_a': disk\n"
    assert capsys.readouterr().err == expected


@pytest.mark.filterwarnings("default")
def test_a_folder_that_is_not_used_is_said_in_one_line(tmp_path, monkeypatch, capsys):
    (tmp_path / "jaxik").write_text("a file in its place")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    before = cache_folder.setting(cache_folder.FOLDER)
    jax.config.update(cache_folder.FOLDER, None)
    cache_folder.WARNED.clear()
    assert main.main(["cache"]) == 0
    jax.config.update(cache_folder.FOLDER, before)
    error = capsys.readouterr().err
    assert error.startswith("jaxik: programs are not kept between calls: ")
    assert error.count("\n") == 1 and str(tmp_path / "jaxik") in error
