"""Calls spread over cores: all of them run, outputs are in order, none starts after a failure."""

import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fitting.runtime import threads


def use_cores(monkeypatch, count):
    monkeypatch.setattr(threads, "usable_cores", lambda: count)


@pytest.mark.parametrize("cores", [1, 2, 5])
def test_outputs_are_in_the_order_of_the_calls(monkeypatch, cores):
    use_cores(monkeypatch, cores)
    for count in (0, 1, 7):
        calls = [lambda number=number: jnp.asarray(number) for number in range(count)]
        assert [int(output) for output in threads.on_all_cores(calls)] == list(range(count))


@pytest.mark.parametrize("enabled", [False, True])
def test_two_calls_run_at_the_same_time_and_have_the_callers_types(monkeypatch, enabled):
    use_cores(monkeypatch, 2)
    meeting = threading.Barrier(2, timeout=30)  # breaks unless two threads wait at it together

    def new_floats() -> jax.Array:
        meeting.wait()
        return jnp.ones(())

    with jax.enable_x64(enabled):
        outputs = threads.on_all_cores([new_floats] * 2)
    assert [output.dtype for output in outputs] == [np.float64 if enabled else np.float32] * 2


@pytest.mark.parametrize("cores", [1, 2])
def test_no_call_starts_after_a_failure(monkeypatch, cores):
    use_cores(monkeypatch, cores)
    started = []

    def fail() -> None:
        started.append("fail")
        raise ValueError("as intended")

    def succeed() -> None:
        started.append("succeed")

    with pytest.raises(ValueError, match="as intended"):
        threads.on_all_cores([fail] * cores + [succeed] * 100)
    assert set(started) == {"fail"}


def test_a_failure_in_a_helper_thread_is_raised(monkeypatch):
    use_cores(monkeypatch, 2)
    caller, meeting = threading.get_ident(), threading.Barrier(2, timeout=30)

    def fail_in_helper() -> None:
        meeting.wait()
        if threading.get_ident() != caller:
            raise ValueError("as intended")

    with pytest.raises(ValueError, match="as intended"):
        threads.on_all_cores([fail_in_helper] * 2)
