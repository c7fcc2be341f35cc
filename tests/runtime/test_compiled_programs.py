"""JAX's files of compiled programs are complete or missing, and damaged ones are replaced."""

import errno
import os
from pathlib import Path

import jax
import pytest
from jax._src import compilation_cache
from jax._src.lru_cache import LRUCache

from fitting.runtime.cache_folder import FOLDER, setting
from fitting.runtime.storage import compiled_programs

KEY, PROGRAM = "jit_walk-" + "0123456789abcdef" * 4, b"the whole program"
NAME = f"{KEY}-cache"


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


@pytest.fixture
def of_jax(tmp_path):
    """The folder of JAX's own cache for one test."""
    before = setting(FOLDER)
    compiled_programs.write_complete_files()
    jax.config.update(FOLDER, str(tmp_path))
    compilation_cache.reset_cache()
    yield tmp_path
    jax.config.update(FOLDER, before)
    compilation_cache.reset_cache()
    jax.jit(lambda x: x - 1)(1.0)  # has JAX go back to it at once


def test_a_damaged_program_is_compiled_once_more_and_replaced(of_jax):
    def compile_anew() -> None:
        assert jax.jit(lambda x: x + 1)(1.0) == 2.0

    compile_anew()
    (file,) = of_jax.glob("jit__lambda*-cache")
    whole = file.read_bytes()
    file.write_bytes(whole[:50])
    with pytest.warns(UserWarning, match="Error reading persistent compilation cache entry"):
        compile_anew()
    assert len(file.read_bytes()) > 50
    compile_anew()  # without a warning
