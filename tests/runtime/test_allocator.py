"""Freed memory is kept for new arrays, unless the user chose otherwise."""

import subprocess
import sys

import pytest

from fitting.runtime import allocator

# Page faults of writing 16 MB ten times over: once each time, or once for all.
FAULTS = """
import resource
import numpy as np
from fitting.runtime import allocator
allocator.keep_freed_memory()
np.ones(4 << 20, np.float32)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(10):
    parts = [np.ones(1 << 20, np.float32) for _ in range(4)]
    del parts
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(**environment: str) -> int:
    """Page faults of a process with these variables in its environment."""
    run = subprocess.run(
        [sys.executable, "-c", FAULTS], env=environment, capture_output=True, text=True, check=True
    )
    return int(run.stdout)


@pytest.mark.skipif(not allocator.keep_freed_memory(), reason="needs the GNU C library")
def test_arrays_reuse_the_memory_of_those_that_were_freed():
    pages = 4 * (4 << 20) // 4096
    assert faults() < 2 * pages
    assert faults(MALLOC_TRIM_THRESHOLD_="131072") > 5 * pages


@pytest.mark.parametrize("name", allocator.OF_USER)
def test_a_setting_of_the_user_stays(monkeypatch, name):
    monkeypatch.setenv(name, "")
    assert not allocator.keep_freed_memory()
