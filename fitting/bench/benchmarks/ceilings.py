"""Benchmarks of the machine itself, and of importing jaxik."""

import math
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np

from fitting.bench.measurement import Call, Figure, FigureSpec, Measurement
from fitting.bench.sizes import Sizes
from fitting.runtime.threads import usable_cores


def machine(measurement: Measurement, sizes: Sizes) -> None:
    """The most that memory, arithmetic and dispatch allow: the ceilings of the other benchmarks."""
    cores = usable_cores()
    floats = jnp.ones(sizes.read, jnp.float32)
    calls = {
        # Only reading: a result is new pages of memory, which cost more than filling them.
        "memory": measurement.compile_call("memory", _sum_of_rows, floats),
        "dispatch": measurement.compile_call(
            "dispatch", lambda x: x + 1.0, jnp.ones((), jnp.float32)
        ),
    }
    for dtype in ("float32", "float64"):
        with jax.enable_x64(True):
            square = jnp.ones((sizes.side, sizes.side), dtype)
            calls[dtype] = measurement.compile_call(dtype, _product, square)
    measurement.time_in_turns(calls)
    moved, operations = float(floats.nbytes), 2.0 * sizes.side**3
    measurement.add_timing(
        "memory",
        FigureSpec(what="memory, read", unit="GB/s", scale=1e-9 * moved, rate=True, threads=cores),
    )
    for dtype in ("float32", "float64"):
        measurement.add_timing(
            dtype,
            FigureSpec(
                what=f"{dtype}, matrix product", unit="GFLOP/s", scale=1e-9 * operations,
                rate=True, threads=cores, floats=dtype,
            ),
        )  # fmt: skip
    measurement.add_timing(
        "dispatch", FigureSpec(what="a program that does nothing", unit="µs", scale=1e6)
    )
    # On a CPU by CPU time, so that another process does not lower a ceiling.
    threads = {"memory": cores, "float32": cores, "float64": cores, "dispatch": 1}
    best = {
        name: min(measurement.busy[name]) / count
        if jax.default_backend() == "cpu"
        else min(measurement.samples[name])
        for name, count in threads.items()
    }
    measurement.ceilings.update(
        memory=moved / best["memory"], float32=operations / best["float32"],
        float64=operations / best["float64"], dispatch=best["dispatch"],
    )  # fmt: skip


def _sum_of_rows(floats: jax.Array) -> jax.Array:
    # By a matrix product, whose library reads as fast as memory allows; XLA's own sums do not.
    rows = floats.reshape(-1, math.gcd(floats.size, 4096))
    return jnp.matmul(rows, jnp.ones(rows.shape[1], floats.dtype))


def _product(square: jax.Array) -> jax.Array:
    # In full precision: a GPU would round to fewer bits.
    return jnp.matmul(square, square, precision=jax.lax.Precision.HIGHEST)


def start(measurement: Measurement, sizes: Sizes) -> None:
    """Import times, in processes of their own."""

    def run(code: str) -> Call:
        return lambda: subprocess.run([sys.executable, "-c", code], check=True)

    codes = {
        "jax": "import jax",
        "jaxik": "import jax, jaxik",
        "equinox": "import jax, equinox",
        "used": "import jax, jaxik; jaxik.run",  # its names are imported when first used
    }
    measurement.time_in_turns({name: run(code) for name, code in codes.items()})
    measurement.add_timing("jax", FigureSpec(what="import jax", unit="s"))
    for what, name, target in (
        ("import jaxik, beyond jax's", "jaxik", 0.3),
        ("and the first use of it", "used", None),
        ("of which equinox", "equinox", None),
    ):
        seconds, cpu_seconds = (
            [total - jax_only for total, jax_only in zip(times[name], times["jax"], strict=True)]
            for times in (measurement.samples, measurement.busy)
        )
        measurement.add(
            Figure(
                what, float(np.median(seconds)), "s", target,
                spread=(min(seconds), max(seconds)), busy=float(np.median(cpu_seconds)),
            )
        )  # fmt: skip
