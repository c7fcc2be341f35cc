"""64 bits for the calls that need them, while the caller's setting of JAX stays as it is."""

from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fitting.runtime.precision import for_other_thread, in_float64, with_floats


def new_floats() -> np.dtype:
    return jnp.ones(()).dtype


@pytest.mark.parametrize("enabled", [False, True])
def test_a_call_has_64_bits_and_its_caller_what_it_had(enabled):
    with jax.enable_x64(enabled):
        before = new_floats()
        assert in_float64(new_floats)() == np.float64
        assert in_float64(in_float64(new_floats))() == np.float64
        assert new_floats() == before == (np.float64 if enabled else np.float32)


def test_the_callers_setting_survives_an_error():
    @in_float64
    def fail() -> None:
        raise ValueError("as intended")

    with jax.enable_x64(False):
        with pytest.raises(ValueError, match="as intended"):
            fail()
        assert new_floats() == np.float32


def test_arrays_keep_their_types():
    single, double = jnp.ones(3, np.float32), jnp.ones(3, np.float64)
    with jax.enable_x64(False):
        doubled = [in_float64(lambda x: 2 * x)(array) for array in (single, double)]
    assert [array.dtype for array in doubled] == [np.float32, np.float64]


@pytest.mark.parametrize("enabled", [False, True])
def test_another_thread_has_the_callers_types(enabled):
    with jax.enable_x64(enabled), ThreadPoolExecutor(1) as pool:
        assert pool.submit(for_other_thread(new_floats)).result() == new_floats()


def test_only_floats_take_another_type():
    tree = {"float": jnp.ones(2), "integer": jnp.arange(2), "switch": jnp.array(True), "name": "x"}
    single = with_floats(tree, np.float32)
    assert single["float"].dtype == np.float32
    assert single["integer"].dtype == tree["integer"].dtype
    assert single["switch"].dtype == bool and single["name"] == "x"
