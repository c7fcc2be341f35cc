"""Work shared out to cores: all of it, in order, and none after a failure."""

import threading

import jax.numpy as jnp
import pytest

from fitting.runtime import threads


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("count", [0, 1, 7])
def test_results_come_in_order(monkeypatch, threads, count):
    monkeypatch.setattr(threads, "cores", lambda: threads)
    calls = [lambda number=number: jnp.asarray(number) for number in range(count)]
    assert [int(one) for one in threads.on_all_cores(calls)] == list(range(count))


def test_two_calls_run_at_once(monkeypatch):
    monkeypatch.setattr(threads, "cores", lambda: 2)
    both = threading.Barrier(2, timeout=30)  # breaks unless another thread comes to it too
    threads.on_all_cores([lambda: jnp.asarray(both.wait())] * 2)


@pytest.mark.parametrize("threads", [1, 2])
def test_none_is_begun_after_a_failure(monkeypatch, threads):
    monkeypatch.setattr(threads, "cores", lambda: threads)
    begun = []

    def fails() -> None:
        begun.append("fails")
        raise ValueError("as told")

    def works() -> None:
        begun.append("works")

    with pytest.raises(ValueError, match="as told"):
        threads.on_all_cores([fails] * threads + [works] * 100)
    assert set(begun) == {"fails"}


def test_a_failure_in_a_helping_thread_is_told(monkeypatch):
    monkeypatch.setattr(threads, "cores", lambda: 2)
    asking, both = threading.get_ident(), threading.Barrier(2, timeout=30)

    def fails_elsewhere() -> None:
        both.wait()
        if threading.get_ident() != asking:
            raise ValueError("as told")

    with pytest.raises(ValueError, match="as told"):
        threads.on_all_cores([fails_elsewhere] * 2)
