"""JAX's files of compiled programs are complete or missing, and damaged ones are replaced."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest
from jax._src.lru_cache import LRUCache

from fitting.runtime.storage import compiled_programs

KEY, PROGRAM = "jit_walk-" + "0123456789abcdef" * 4, b"the whole program"
NAME = f"{KEY}-cache"

COMPILES = """
import sys, jax
from fitting.runtime import cache_folder
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
cache_folder.use_default()
jax.jit(lambda x: x + 1)(1.0)
"""


@pytest.fixture
def cache(tmp_path):
    """JAX's cache in an empty folder."""
    compiled_programs.write_complete_files()
    return LRUCache(str(tmp_path), max_size=-1)


def test_a_program_is_read_as_it_was_written(cache, tmp_path):
    cache.put(KEY, PROGRAM)
    assert cache.get(KEY) == PROGRAM and os.listdir(tmp_path) == [NAME]


def test_a_write_that_ends_half_way_leaves_nothing(cache, tmp_path, monkeypatch):
    def fill_the_disk(path, content):
        with open(path, "wb") as file:
            file.write(content[:5])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", fill_the_disk)
    with pytest.raises(ValueError, match=f"{NAME}: cannot be written: No space left on device"):
        cache.put(KEY, PROGRAM)
    assert not os.listdir(tmp_path)


def test_no_process_sees_a_file_that_is_being_written(cache, monkeypatch):
    whole, seen = Path.write_bytes, []

    def look_half_way(path, content):
        whole(path, content[:5])
        seen.append(cache.get(KEY))
        whole(path, content)

    monkeypatch.setattr(Path, "write_bytes", look_half_way)
    cache.put(KEY, PROGRAM)
    assert seen == [None] and cache.get(KEY) == PROGRAM


def test_a_folder_that_jax_locks_is_left_to_it(tmp_path):
    compiled_programs.write_complete_files()
    bounded = LRUCache(str(tmp_path), max_size=1000)
    bounded.put(KEY, PROGRAM)
    assert bounded.get(KEY) == PROGRAM and f"{KEY}-atime" in os.listdir(tmp_path)


@pytest.mark.slow
def test_a_damaged_program_is_compiled_once_more_and_replaced(tmp_path):
    def errors() -> str:
        process = subprocess.run(
            [sys.executable, "-c", COMPILES, str(tmp_path)],
            env=os.environ | {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"},
            cwd=Path(__file__).parents[2],
            check=True,
            capture_output=True,
            text=True,
        )
        return process.stderr

    assert errors() == ""
    (file,) = tmp_path.glob("*-cache")
    file.write_bytes(file.read_bytes()[:50])
    assert "Error reading persistent compilation cache entry" in errors()
    assert errors() == ""
