"""Calls in other processes: their floats, their settings, and what goes wrong."""

import functools
import os
import platform
import resource
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fitting.runtime.parallel import cluster, effort


@pytest.fixture(scope="module")
def client():
    """One worker, whose system gives it memory page by page."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NUMPY_MADVISE_HUGEPAGE", "0")
        with cluster.connect(workers=1) as client:
            yield client


def describe(numbers: jax.Array, factor: float) -> tuple[str, float, str, int]:
    total = jnp.sum(numbers) * factor
    return str(total.dtype), float(total), os.environ.get("XLA_FLAGS", ""), os.getpid()


def fail(number: int) -> None:
    raise ValueError(f"no {number}")


def page_faults(megabytes: int) -> int:
    """Of writing so much eight times, after the first times."""

    def write() -> int:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        for _ in range(8):
            np.empty(megabytes << 20, np.uint8).fill(1)
        return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

    write()
    return write()


def test_other_processes_compute_with_the_same_floats_and_settings(client):
    assert cluster.hosts(client) == ["127.0.0.1"]
    function = functools.partial(describe, jnp.asarray([1.0, 1e-12]))
    computed = dict(cluster.compute(client, function, [1.0, 2.0]))
    for index, factor in enumerate([1.0, 2.0]):
        floats, total, flags, process = computed[index].result()
        assert (floats, total) == ("float64", factor * (1.0 + 1e-12))
        assert flags == os.environ["XLA_FLAGS"] and process != os.getpid()


def test_an_error_in_another_process_is_raised_by_its_result(client):
    [(_, failed)] = cluster.compute(client, fail, [3])
    with pytest.raises(ValueError, match="no 3"):
        failed.result()


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="of glibc only")
def test_a_worker_keeps_the_memory_that_it_has_freed(client):
    [(_, faults)] = cluster.compute(client, page_faults, [4])
    assert faults.result() < 8 * (4 << 20) // 4096 / 10


def test_no_cluster_is_this_process():
    with cluster.connect() as client:
        assert client is None


@pytest.mark.parametrize(
    ("workers", "scheduler", "words"),
    [
        (-1, None, "workers is -1; wanted 0"),
        (2, "tcp://127.0.0.1:1", "not both"),
        (0, "tcp://127.0.0.1:1", "no Dask scheduler answers at 'tcp://127.0.0.1:1'"),
        (0, "nonsense://x", "no Dask scheduler answers at 'nonsense://x'"),
    ],
)
def test_a_cluster_that_cannot_be_is_refused(monkeypatch, workers, scheduler, words):
    monkeypatch.setattr(cluster, "CONNECT_SECONDS", 0.5)
    with pytest.raises(ValueError, match=words), cluster.connect(workers, scheduler):
        pass


def test_a_missing_library_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ValueError, match=r"pip install 'jaxik\[dask\]'"), cluster.connect(2):
        pass


def test_the_peak_of_a_process_does_not_begin_with_that_of_its_parent():
    # Of resident memory: what the parent has touched counts.
    taken = b"1" * 600_000_000
    words = "from fitting.runtime.parallel.effort import peak_mb; print(peak_mb())"
    child = subprocess.run(
        [sys.executable, "-c", words], capture_output=True, text=True, check=True
    )
    own = effort.peak_mb()
    assert own is not None and own > len(taken) / 1e6
    assert 1.0 < float(child.stdout) < 300.0
