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

DIGEST = "0123456789abcdef" * 4


@pytest.fixture(autouse=True)
def untouched(monkeypatch):
    """JAX as it is without settings of its own, which come back after the test."""
    before = {name: setting(name) for name in (FOLDER, ENABLED, MIN_SECONDS)}
    jax.config.update(FOLDER, None)
    cache_folder.WARNED.clear()
    for variable in ("XDG_CACHE_HOME", FOLDER.upper(), MIN_SECONDS.upper()):
        monkeypatch.delenv(variable, raising=False)
    yield
    for name, value in before.items():
        jax.config.update(name, value)


# Where


@pytest.mark.parametrize(
    ("platform", "expected"),
    [("linux", "home/.cache/jaxik"), ("darwin", "home/Library/Caches/jaxik")],
)
def test_programs_are_kept_where_the_platform_keeps_caches(
    platform, expected, tmp_path, monkeypatch
):
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    assert cache_folder.default() == tmp_path / expected


def test_on_windows_programs_are_kept_in_the_local_application_data(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path))
    assert cache_folder.default() == tmp_path / "jaxik" / "Cache"


def test_the_environment_may_name_another_place(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder.default() == tmp_path / "jaxik"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert cache_folder.default() == Path.home() / ".cache" / "jaxik"


def test_the_default_folder_is_made_and_private(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "new"))
    cache_folder.use_default()
    folder = tmp_path / "new" / "jaxik"
    assert setting(FOLDER) == str(folder) and setting(MIN_SECONDS) == 0
    assert folder.stat().st_mode & 0o077 == 0
    assert cache_folder.traced() == folder / TRACED


@pytest.mark.parametrize("chosen", ["elsewhere", ""])
def test_a_choice_of_the_user_stays(chosen, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    jax.config.update(FOLDER, chosen)
    jax.config.update(MIN_SECONDS, 3.0)
    cache_folder.use_default()
    assert setting(FOLDER) == chosen and setting(MIN_SECONDS) == 3.0
    assert not list(tmp_path.iterdir())


def test_a_choice_of_what_is_worth_keeping_stays(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv(MIN_SECONDS.upper(), "3")
    jax.config.update(MIN_SECONDS, 3.0)
    cache_folder.use_default()
    assert setting(MIN_SECONDS) == 3.0


# Whose


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owner here")
def test_a_default_folder_of_somebody_else_is_not_used_by_jax_either(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (tmp_path / "jaxik").mkdir()
    monkeypatch.setattr(os, "getuid", lambda: 1_000_001)
    with pytest.warns(RuntimeWarning, match="not kept between calls: .*belongs to another user"):
        cache_folder.use_default()
    assert setting(FOLDER) is None


@pytest.mark.skipif(os.name != "posix", reason="no such permissions")
def test_a_default_folder_that_everybody_may_write_to_is_not_used(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (tmp_path / "jaxik").mkdir()
    (tmp_path / "jaxik").chmod(0o777)
    with pytest.warns(RuntimeWarning, match=f"everybody may write to {tmp_path}"):
        cache_folder.use_default()
    assert setting(FOLDER) is None


def test_a_default_folder_that_cannot_be_made_is_not_used(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (tmp_path / "jaxik").write_text("a file in its place")
    with pytest.warns(RuntimeWarning, match="not kept between calls: .*: File exists"):
        cache_folder.use_default()
    assert setting(FOLDER) is None


def test_without_a_home_nothing_is_kept(monkeypatch):
    def fail():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", fail)
    with pytest.warns(RuntimeWarning, match="not kept between calls: Could not determine home"):
        cache_folder.use_default()


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


def test_only_kept_programs_count_as_such(tmp_path):
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


# The last two are half-written.
TRACED_FILES = [("run", ""), ("_evaluate", ""), (".run", "x_1ab"), (".run", ".jaxik-vm-7-x_1ab")]


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owner here")
def test_programs_of_others_do_not_count(tmp_path, monkeypatch):
    (tmp_path / f"jit_step-{DIGEST}-cache").touch()
    monkeypatch.setattr(os, "getuid", lambda: 1_000_001)
    assert cache_folder.kept_programs(tmp_path) == ([], [])


def test_a_problem_is_said_once():
    problems = [
        ("nothing is kept", "no space"),
        ("nothing is kept", "no folder"),
        ("read anew", ""),
    ]
    with pytest.warns(RuntimeWarning) as said:
        for problem, reason in problems:
            cache_folder.warn_once(problem, reason)
    assert [str(warning.message) for warning in said] == [
        "nothing is kept: no space",
        "read anew: ",
    ]
