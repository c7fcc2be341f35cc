"""The folder of kept programs: where it is, whose it must be, and what counts as a program."""

import os
import sys
from pathlib import Path

import jax
import pytest

from fitting.runtime import cache_folder
from fitting.runtime.cache_folder import (
    ENABLED,
    FOLDER,
    MIN_SECONDS,
    TRACED,
    SwitchedOffError,
    setting,
)
from fitting.runtime.storage import compiled_programs

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


# Where


@pytest.mark.parametrize(
    ("platform", "variables", "expected"),
    [
        ("linux", {}, "home/.cache/jaxik"),
        ("linux", {"XDG_CACHE_HOME": "relative"}, "home/.cache/jaxik"),
        ("linux", {"XDG_CACHE_HOME": "TMP/xdg"}, "xdg/jaxik"),
        ("darwin", {}, "home/Library/Caches/jaxik"),
        ("win32", {"LOCALAPPDATA": "TMP/local"}, "local/jaxik/Cache"),
    ],
)
def test_programs_are_kept_where_the_platform_or_the_environment_says(
    platform, variables, expected, tmp_path, monkeypatch
):
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.setenv(name, variables.get(name, "").replace("TMP", str(tmp_path)))
    assert cache_folder.default() == tmp_path / expected


@pytest.mark.parametrize(("chosen", "seconds"), [(None, 0.0), ("3", 3.0)])
def test_the_default_folder_is_made_and_private_and_its_files_are_complete(
    chosen, seconds, caches, monkeypatch
):
    called = []
    monkeypatch.setattr(compiled_programs, "write_complete_files", lambda: called.append(True))
    if chosen is not None:
        monkeypatch.setenv(MIN_SECONDS.upper(), chosen)
    jax.config.update(MIN_SECONDS, 3.0)
    cache_folder.use_default()
    folder = caches / "jaxik"
    assert setting(FOLDER) == str(folder) and setting(MIN_SECONDS) == seconds
    assert folder.stat().st_mode & 0o077 == 0
    assert cache_folder.traced() == folder / TRACED
    assert called


@pytest.mark.parametrize("chosen", ["elsewhere", ""])
def test_a_choice_of_the_user_stays(chosen, caches):
    jax.config.update(FOLDER, chosen)
    jax.config.update(MIN_SECONDS, 3.0)
    cache_folder.use_default()
    assert setting(FOLDER) == chosen and setting(MIN_SECONDS) == 3.0
    assert not caches.exists()


# Whose


def others(caches, monkeypatch):
    (caches / "jaxik").mkdir(parents=True)
    monkeypatch.setattr(os, "getuid", lambda: 1_000_001)


def open_to_all(caches, monkeypatch):
    (caches / "jaxik").mkdir(parents=True)
    (caches / "jaxik").chmod(0o777)


def no_folder(caches, monkeypatch):
    caches.mkdir()
    (caches / "jaxik").write_text("a file in its place")


def no_home(caches, monkeypatch):
    def fail():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", fail)


@pytest.mark.skipif(os.name != "posix", reason="no such permissions")
@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (others, "{folder} belongs to another user"),
        (open_to_all, "everybody may write to {folder}"),
        (no_folder, ".*: File exists"),
        (no_home, "Could not determine home"),
    ],
)
def test_a_default_folder_that_is_not_safe_is_not_used_by_jax_either(
    spoil, reason, caches, monkeypatch
):
    spoil(caches, monkeypatch)
    message = f"programs are not kept between calls: {reason.format(folder=caches / 'jaxik')}"
    with pytest.warns(RuntimeWarning, match=message):
        cache_folder.use_default()
    assert setting(FOLDER) is None


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        (FOLDER, None, f"{FOLDER} names no folder"),
        (FOLDER, "", f"{FOLDER} names no folder"),
        (FOLDER, "gs://bucket/cache", "on this machine only"),
        (ENABLED, False, f"{ENABLED} is off"),
    ],
)
def test_the_reason_for_keeping_nothing_names_the_setting(
    name, value, reason, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    jax.config.update(FOLDER, str(tmp_path / "cache"))
    jax.config.update(name, value)
    with pytest.raises(SwitchedOffError, match=reason):
        cache_folder.traced()
    assert not list(tmp_path.iterdir())


def test_with_several_devices_nothing_is_kept(tmp_path, monkeypatch):
    jax.config.update(FOLDER, str(tmp_path))
    monkeypatch.setattr(jax, "device_count", lambda: 2)
    with pytest.raises(SwitchedOffError, match="there are 2 devices"):
        cache_folder.traced()


# What

# The last two are half-written.
TRACED_FILES = [("run", ""), ("_evaluate", ""), (".run", "x_1ab"), (".run", ".jaxik-vm-7-x_1ab")]


def test_only_kept_programs_of_this_user_count_as_such(tmp_path, monkeypatch):
    traced = [tmp_path / TRACED / f"{name}-{DIGEST}{end}" for name, end in TRACED_FILES]
    compiled = [tmp_path / f"jit_step-{DIGEST}-{end}" for end in ("atime", "cache")]
    compiled.append(tmp_path / f".jit_step-{DIGEST}-cache.jaxik-vm-7-x_1ab")  # half-written
    others = [
        tmp_path / "notes.txt",
        tmp_path / f"jit_step-{DIGEST}",
        tmp_path / "jit_step-0123-cache",
        tmp_path / TRACED / "notes.txt",
        tmp_path / TRACED / "deeper" / f"run-{DIGEST}",
        tmp_path / "other" / f"jit_step-{DIGEST}-cache",
    ]
    for path in (*traced, *compiled, *others):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    (tmp_path / TRACED / f"link-{DIGEST}").symlink_to(others[0])
    assert cache_folder.kept_programs(tmp_path) == (sorted(traced), sorted(compiled))
    assert cache_folder.kept_programs(tmp_path / "none") == ([], [])
    monkeypatch.setattr(os, "getuid", lambda: 1_000_001)
    assert cache_folder.kept_programs(tmp_path) == ([], [])


def test_a_problem_is_said_once():
    with pytest.warns(RuntimeWarning) as said:
        for problem, reason in (("nothing kept", "no space"), ("nothing kept", "x"), ("anew", "")):
            cache_folder.warn_once(problem, reason)
    assert [str(warning.message) for warning in said] == ["nothing kept: no space", "anew: "]
