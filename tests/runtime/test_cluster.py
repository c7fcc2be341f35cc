"""Calls in other processes: their floats, their settings, and what goes wrong."""

import builtins
import functools
import os

import jax
import jax.numpy as jnp
import pytest

from fitting.runtime.parallel import cluster
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
