"""Calls in other processes: their floats, their settings, and what goes wrong."""

import builtins
import functools
import os
import platform
import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest

from fitting.runtime.parallel import cluster, effort
from fitting.runtime.precision import in_float64


def describe(numbers: jax.Array, factor: float) -> tuple[str, float, str, int]:
    total = jnp.sum(numbers) * factor
    return str(total.dtype), float(total), os.environ.get("XLA_FLAGS", ""), os.getpid()


def fail(number: int) -> None:
    raise ValueError(f"no {number}")


@in_float64
def test_other_processes_compute_with_the_same_floats_and_settings():
    with cluster.connect(workers=1) as client:
        assert client is not None
        assert cluster.hosts(client) == ["127.0.0.1"]
        function = functools.partial(describe, jnp.asarray([1.0, 1e-12]))
        computed = dict(cluster.compute(client, function, [1.0, 2.0]))
        results = [computed[index].result() for index in range(2)]
        [(_, failed)] = cluster.compute(client, fail, [3])
        with pytest.raises(ValueError, match="no 3"):
            failed.result()
    assert [(floats, total) for floats, total, *_ in results] == [
        ("float64", 1.0 + 1e-12),
        ("float64", 2 * (1.0 + 1e-12)),
    ]
    for _, _, flags, process in results:
        assert flags == os.environ["XLA_FLAGS"] and process != os.getpid()


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
    real = builtins.__import__

    def without_dask(name, *rest, **named):
        if name == "distributed":
            raise ModuleNotFoundError("No module named 'distributed'")
        return real(name, *rest, **named)

    monkeypatch.setattr(builtins, "__import__", without_dask)
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


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="of glibc only")
def test_a_worker_keeps_the_memory_that_it_has_freed():
    faults = (
        "import resource, numpy as np\n"
        "from fitting.runtime.parallel import cluster\n"
        "def faults():\n"
        "    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt\n"
        "    for _ in range(8):\n"
        "        np.empty(4_000_000, np.uint8).fill(1)\n"
        "    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before\n"
        "faults()\n"
        "first = faults()\n"
        "cluster._prepare()\n"
        "faults()\n"
        "print(first, faults())\n"
    )

    environment = os.environ | {"MALLOC_TRIM_THRESHOLD_": "65536", "NUMPY_MADVISE_HUGEPAGE": "0"}
    printed = subprocess.run(
        [sys.executable, "-c", faults],
        env=environment, capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    as_started, changed = map(int, printed.split())
    assert as_started > 10 * max(changed, 1)
