"""The command `jaxik cache`, and what commands say when programs cannot be kept."""

import warnings

import jax
import pytest

from fitting.cli import main
from fitting.runtime import cache_folder
from fitting.runtime.cache_folder import ENABLED, FOLDER, setting

DIGEST = "0123456789abcdef" * 4


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A cache folder with a traced program, a compiled one, and files of somebody else."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    before = setting(FOLDER)
    cache_folder.WARNED.clear()
    folder = tmp_path / "jaxik"
    (folder / "traced").mkdir(parents=True, mode=0o700)
    (folder / "traced" / f"run-{DIGEST}").write_bytes(bytes(2_000_000))
    (folder / f"jit_run-{DIGEST}-cache").write_bytes(bytes(300_000))
    (folder / "notes.txt").touch()
    (folder / "traced" / "notes.txt").touch()
    jax.config.update(FOLDER, str(folder))
    yield folder
    jax.config.update(FOLDER, before)


def test_it_shows_place_and_size_and_whether_it_is_used(folder, capsys):
    shown = [
        f"place              {folder}",
        "traced programs    1 (2.0 MB)",
        "compiled programs  1 (0.3 MB)",
        "used               yes",
    ]
    for chosen in (str(folder), None):  # it is that of the user by default
        jax.config.update(FOLDER, chosen)
        assert main.main(["cache"]) == 0
        assert capsys.readouterr().out.splitlines() == shown


def test_it_says_why_a_folder_is_not_used(folder, capsys):
    (folder / "traced").chmod(0o777)
    assert main.main(["cache"]) == 0
    output = capsys.readouterr().out
    assert output.endswith(f"\nused               no: everybody may write to {folder}/traced\n")
    jax.config.update(ENABLED, False)
    assert main.main(["cache"]) == 0
    jax.config.update(ENABLED, True)
    assert capsys.readouterr().out.endswith(f"no: {ENABLED} is off\n")


def test_clear_removes_the_programs_and_nothing_else(folder, capsys):
    assert main.main(["cache", "--clear"]) == 0
    assert capsys.readouterr().out == f"removed 1 traced and 1 compiled, 2.3 MB, from {folder}\n"
    left = [path.relative_to(folder) for path in folder.rglob("*") if path.is_file()]
    assert sorted(map(str, left)) == ["notes.txt", "traced/notes.txt"]


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
def test_a_folder_that_is_not_used_is_said_in_one_line(folder, capsys):
    folder.chmod(0o777)
    jax.config.update(FOLDER, None)
    assert main.main(["cache"]) == 0
    expected = f"jaxik: programs are not kept between calls: everybody may write to {folder}\n"
    assert capsys.readouterr().err == expected
