"""The folder of cached programs: where it is, whose it must be, what counts as a program, and what
commands say of it."""

import os
import sys
import warnings
from pathlib import Path
from unittest.mock import Mock

import jax
import pytest

from fitting.cli import machine, main
from fitting.runtime import cache_folder
from fitting.runtime.cache_folder import (
    ENABLED,
    FOLDER,
    KERNELS,
    MIN_SECONDS,
    TRACED,
    SwitchedOffError,
    setting,
)
from support.commands import replace_call

DIGEST = "0123456789abcdef" * 4


@pytest.fixture(autouse=True)
def caches(monkeypatch, tmp_path):
    """Where the user has caches; JAX is without settings of its own, which come back at the end."""
    before = {name: setting(name) for name in (FOLDER, ENABLED, MIN_SECONDS)}
    jax.config.update(FOLDER, None)
    cache_folder.WARNED.clear()
    for variable in (FOLDER.upper(), MIN_SECONDS.upper()):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    yield tmp_path / "caches"
    for name, value in before.items():
        jax.config.update(name, value)


def test_programs_are_kept_where_the_platform_or_the_environment_says(tmp_path, monkeypatch):
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    for platform, variables, expected in (
        ("linux", {}, "home/.cache/jaxik"),
        ("linux", {"XDG_CACHE_HOME": "relative"}, "home/.cache/jaxik"),
        ("linux", {"XDG_CACHE_HOME": f"{tmp_path}/xdg"}, "xdg/jaxik"),
        ("darwin", {}, "home/Library/Caches/jaxik"),
        ("win32", {"LOCALAPPDATA": f"{tmp_path}/local"}, "local/jaxik/Cache"),
    ):
        monkeypatch.setattr(sys, "platform", platform)
        for name in ("XDG_CACHE_HOME", "LOCALAPPDATA"):
            monkeypatch.setenv(name, variables.get(name, ""))
        assert cache_folder.default() == tmp_path / expected, platform


def test_the_default_folder_is_made_and_private_unless_the_user_has_chosen(caches, monkeypatch):
    called = []
    monkeypatch.setattr(cache_folder, "write_complete_files", lambda: called.append(True))
    jax.config.update(MIN_SECONDS, 3.0)
    for chosen in ("elsewhere", ""):
        jax.config.update(FOLDER, chosen)
        cache_folder.use_default()
        assert setting(FOLDER) == chosen and setting(MIN_SECONDS) == 3.0
        assert not caches.exists()
    for name, seconds in ((MIN_SECONDS.upper(), 3.0), ("another setting", 0.0)):
        jax.config.update(FOLDER, None)
        with monkeypatch.context() as patch:
            patch.setenv(name, "3")
            cache_folder.use_default()
        assert setting(FOLDER) == str(caches / "jaxik") and setting(MIN_SECONDS) == seconds
    assert (caches / "jaxik").stat().st_mode & 0o077 == 0
    assert cache_folder.traced() == caches / "jaxik" / TRACED
    assert called


@pytest.mark.skipif(os.name != "posix", reason="no such permissions")
def test_a_default_folder_that_is_not_safe_is_not_used_by_jax_either(caches, monkeypatch):
    folder = caches / "jaxik"

    def assert_unused(reason: str) -> None:
        cache_folder.WARNED.clear()
        with pytest.warns(RuntimeWarning, match=f"programs are not cached between calls: {reason}"):
            cache_folder.use_default()
        assert setting(FOLDER) is None

    caches.mkdir()
    folder.write_text("a file in its place")
    assert_unused(".*: File exists")
    folder.unlink()
    folder.mkdir()
    folder.chmod(0o777)
    assert_unused(f"everybody may write to {folder}")
    folder.chmod(0o700)
    monkeypatch.setattr(os, "getuid", lambda: 1_000_001)
    assert_unused(f"{folder} belongs to another user")
    monkeypatch.delenv("XDG_CACHE_HOME")
    no_home = Mock(side_effect=RuntimeError("Could not determine home directory."))
    monkeypatch.setattr(Path, "home", no_home)
    assert_unused("Could not determine home")


def test_the_reason_for_keeping_nothing_names_the_setting(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, value, reason in (
        (FOLDER, None, f"{FOLDER} names no folder"),
        (FOLDER, "", f"{FOLDER} names no folder"),
        (FOLDER, "gs://bucket/cache", "on this machine only"),
        (ENABLED, False, f"{ENABLED} is off"),
    ):
        jax.config.update(FOLDER, str(tmp_path / "cache"))
        jax.config.update(name, value)
        with pytest.raises(SwitchedOffError, match=reason):
            cache_folder.traced()
        assert not list(tmp_path.iterdir()), reason
    jax.config.update(ENABLED, True)
    monkeypatch.setattr(jax, "device_count", lambda: 2)
    with pytest.raises(SwitchedOffError, match="there are 2 devices"):
        cache_folder.traced()


def test_only_cached_programs_of_this_user_count_as_such(tmp_path, monkeypatch):
    kept, half = f"jit_step-{DIGEST}", ".jaxik-vm-7-x_1ab"  # half-written, as is x_1ab
    names = [f"run-{DIGEST}", f"_evaluate-{DIGEST}", f".run-{DIGEST}x_1ab", f".run-{DIGEST}{half}"]
    traced = [tmp_path / TRACED / name for name in names]
    names = [f"{kept}-atime", f"{kept}-cache", f".{kept}-cache{half}"]
    names += [f"{KERNELS}/crowd-{DIGEST}.so"]
    compiled = [tmp_path / name for name in names]
    names = ["notes.txt", kept, "jit_step-0123-cache", f"other/{kept}-cache"]
    names += [f"{KERNELS}/crowd.so", f"{TRACED}/notes.txt", f"{TRACED}/deeper/run-{DIGEST}"]
    others = [tmp_path / name for name in names]
    for path in (*traced, *compiled, *others):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    (tmp_path / TRACED / f"link-{DIGEST}").symlink_to(others[0])
    compiled = [*sorted(compiled[:-1]), compiled[-1]]
    assert cache_folder.cached_programs(tmp_path) == (sorted(traced), compiled)
    assert cache_folder.cached_programs(tmp_path / "none") == ([], [])
    monkeypatch.setattr(os, "getuid", lambda: 1_000_001)
    assert cache_folder.cached_programs(tmp_path) == ([], [])


# What commands say


@pytest.fixture
def folder(caches):
    """The user's folder with a traced program, a compiled one, and files of somebody else."""
    folder = caches / "jaxik"
    (folder / TRACED).mkdir(parents=True, mode=0o700)
    (folder / TRACED / f"run-{DIGEST}").write_bytes(bytes(2_000_000))
    (folder / f"jit_run-{DIGEST}-cache").write_bytes(bytes(300_000))
    (folder / "notes.txt").touch()
    (folder / TRACED / "notes.txt").touch()
    return folder


def test_the_command_shows_place_and_size_and_why_a_folder_is_not_used(folder, capsys):
    def shown() -> list[str]:
        assert main.main(["cache"]) == 0
        return capsys.readouterr().out.splitlines()

    whole = [
        f"place              {folder}",
        "traced programs    1 (2.0 MB)",
        "compiled programs  1 (0.3 MB)",
        "used               yes",
    ]
    for chosen in (None, str(folder)):  # it is that of the user by default
        jax.config.update(FOLDER, chosen)
        assert shown() == whole
    (folder / TRACED).chmod(0o777)
    assert shown()[-1] == f"used               no: everybody may write to {folder}/traced"
    jax.config.update(ENABLED, False)
    assert shown()[-1].endswith(f"no: {ENABLED} is off")


def test_clear_removes_the_programs_and_nothing_else(folder, capsys):
    assert main.main(["cache", "--clear"]) == 0
    assert capsys.readouterr().out == f"removed 1 traced and 1 compiled, 2.3 MB, from {folder}\n"
    left = [path.relative_to(folder) for path in folder.rglob("*") if path.is_file()]
    assert sorted(map(str, left)) == ["notes.txt", "traced/notes.txt"]


@pytest.mark.filterwarnings("default")
def test_what_cannot_be_kept_is_said_once_and_in_one_line(folder, monkeypatch, capsys):
    folder.chmod(0o777)
    assert main.main(["cache"]) == 0
    expected = f"jaxik: programs are not cached between calls: everybody may write to {folder}\n"
    assert capsys.readouterr().err == expected

    def warn(_):
        for name in ("jit_a", "jit_b"):
            warnings.warn(f"Error writing {main.JAX_CACHE} entry for '{name}': disk", stacklevel=1)
        return 0

    replace_call(monkeypatch, machine.cache, warn)
    jax.config.update(FOLDER, str(folder))
    assert main.main(["cache"]) == 0
    expected = f"jaxik: Error writing {main.JAX_CACHE} entry for 'jit_a': disk\n"
    assert capsys.readouterr().err == expected

    with pytest.warns(RuntimeWarning) as said:
        for problem, reason in (("nothing kept", "no space"), ("nothing kept", "x"), ("anew", "")):
            cache_folder.warn_once(problem, reason)
    assert [str(warning.message) for warning in said] == ["nothing kept: no space", "anew: "]
