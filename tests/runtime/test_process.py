"""What a process uses: flags of XLA, freed memory, threads, other processes, and 64-bit floats."""

import functools
import os
import platform
import resource
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from unittest.mock import Mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fitting.cli import jax_start
from fitting.runtime import cluster, machine, threads, xla
from fitting.runtime.precision import for_other_thread, in_float64, with_floats
from support.experiments import ROOT

OF_USER = "--xla_cpu_enable_fast_math=false"
START = """
import os
from fitting.runtime import xla
xla.configure_xla()
import jax.numpy as jnp
print(float(jnp.ones(3).sum()), os.environ.get("XLA_FLAGS", ""))
"""
# Page faults of writing 16 MB ten times over: once each time, or once for all.
FAULTS = """
import resource
import numpy as np
from fitting.cli import jax_start
from fitting.runtime import xla as allocator
allocator.keep_freed_memory()
np.ones(4 << 20, np.float32)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(10):
    parts = [np.ones(1 << 20, np.float32) for _ in range(4)]
    del parts
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def printed(program: str, **environment: str) -> str:
    """What a process with these variables in its environment prints."""
    return subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, env=environment,
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip


def needs(flag: str) -> pytest.MarkDecorator:
    """Skips a test of what a flag does where this process does not have it."""
    absent = flag not in os.environ.get("XLA_FLAGS", "").split()
    return pytest.mark.skipif(
        absent or jax.default_backend() != "cpu", reason=f"needs a CPU and {flag}"
    )


def flags_with(of_user: str | None, monkeypatch, version: str = "0.12.0") -> str | None:
    """The variable with the flags after a start with what the user had set."""
    monkeypatch.setattr(xla, "jaxlib_version", lambda: version)
    monkeypatch.delenv(xla.VARIABLE, raising=False)
    if of_user is not None:
        monkeypatch.setenv(xla.VARIABLE, of_user)
    xla.configure_xla()
    return os.environ.get(xla.VARIABLE)


def test_known_versions_of_jaxlib_get_their_flags_before_those_of_the_user_and_others_none(
    monkeypatch,
):
    pinned = (ROOT / ".ci" / "constraints.txt").read_text(encoding="utf-8").splitlines()
    (version,) = (line.removeprefix("jaxlib==") for line in pinned if line.startswith("jaxlib=="))
    assert xla.FLAGS[version]
    for version, known in xla.FLAGS.items():
        flags = flags_with(None, monkeypatch, version)
        assert flags == " ".join(known) == xla.describe_flags(), version
    assert flags_with(None, monkeypatch, "99.0.0") is None
    assert xla.describe_flags().startswith("none; which flags jaxlib 99.0.0 knows")
    of_user = f"{OF_USER} --xla_cpu_prefer_vector_width=128"
    flags = flags_with(of_user, monkeypatch)
    assert flags == " ".join([*xla.FLAGS["0.12.0"], of_user])
    for unchanged in (flags, "", "flags.txt"):  # they are added once; and never to a file
        assert flags_with(unchanged, monkeypatch) == unchanged


def test_the_installed_jaxlib_starts_with_its_flags():
    words = printed(START, **os.environ | {"XLA_FLAGS": OF_USER}).split()
    assert words == ["3.0", *xla.FLAGS.get(xla.jaxlib_version(), ()), OF_USER]


@pytest.mark.parametrize("user_setting", [None, "true"])
def test_programs_run_in_the_calling_thread_unless_the_user_chose_otherwise(
    monkeypatch, user_setting
):
    monkeypatch.delenv(xla.ASYNC_DISPATCH, raising=False)
    if user_setting is not None:
        monkeypatch.setenv(xla.ASYNC_DISPATCH, user_setting)
    option = xla.ASYNC_DISPATCH.lower()
    before = jax.config.values[option]
    jax.config.update(option, True)
    try:
        xla.configure_xla()
        assert jax.config.values[option] == (user_setting is not None)
    finally:
        jax.config.update(option, before)


@needs(xla.REDUCTIONS)
def test_sums_do_not_call_a_library():
    shape = jax.ShapeDtypeStruct((2048, 2048), jnp.float32)
    program = str(jax.jit(lambda x: jnp.sum(x, 0)).lower(shape).compile().as_text())
    assert "ynn_fusion" not in program


@needs(xla.LOOPS)
def test_a_loop_that_moves_little_becomes_one_function():
    loop = jax.jit(lambda x: jax.lax.scan(lambda c, x: (c + jnp.sin(x), c * x), x[0], x))
    for numbers, one_function in ((64, True), (100_000_000, False)):
        shape = jax.ShapeDtypeStruct((3, numbers), jnp.float32)
        program = str(loop.lower(shape).compile().as_text())
        assert ("xla_cpu_small_call" in program) == one_function, numbers


@pytest.mark.skipif(not xla.keep_freed_memory(), reason="needs the GNU C library")
def test_arrays_reuse_the_memory_of_those_that_were_freed_unless_the_user_set_it(monkeypatch):
    for name in xla.OF_USER:
        with monkeypatch.context() as patch:
            patch.setenv(name, "")
            assert not xla.keep_freed_memory(), name
    pages = 4 * (4 << 20) // 4096
    small = {"NUMPY_MADVISE_HUGEPAGE": "0"}  # pages
    assert int(printed(FAULTS, **small)) < 2 * pages
    assert int(printed(FAULTS, **small, MALLOC_TRIM_THRESHOLD_="131072")) > 5 * pages


# Variables of the environment that JAX does not start with, or commands do not work under

TRY = """
from fitting.cli import jax_start
try:
    jax_start.start()
except jax_start.StartError as error:
    print(error)
"""


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("JAX_PLATFORMS", "x", "no device with JAX_PLATFORMS=x: Unable to initialize backend 'x'"),
        ("JAX_NUM_CPU_DEVICES", "x", 'Invalid value "x" for JAX flag jax_num_cpu_devices'),
    ],
)
def test_a_variable_that_jax_does_not_start_with_is_a_line_with_a_remedy(name, value, said):
    line = printed(TRY, **os.environ | {name: value})
    assert said in line and line.count("\n") == 1 and f"unset {name}" in line


def test_commands_compute_on_the_cpu_unless_a_variable_says_where(monkeypatch):
    chosen = []
    monkeypatch.setattr(jax.config, "update", lambda *pair: chosen.append(pair))
    for name in xla.PLATFORMS:
        for other in xla.PLATFORMS:
            monkeypatch.setenv(other, "cuda")
            monkeypatch.delenv(other)
        monkeypatch.setenv(name, "cuda")
        xla.prefer_cpu()
        assert not chosen and [os.environ.get(other) for other in xla.PLATFORMS].count(None) == 1
    monkeypatch.delenv(name)
    xla.prefer_cpu()
    assert chosen == [("jax_platforms", "cpu")] and os.environ["JAX_PLATFORMS"] == "cpu"


def test_a_platform_that_is_not_here_is_refused_where_jax_only_asserts_that_it_is(monkeypatch):
    monkeypatch.setattr(jax, "devices", Mock(side_effect=AssertionError))
    for values, said in (
        ({"JAX_PLATFORMS": "cuda"}, " with JAX_PLATFORMS=cuda: there is none like that; unset "),
        ({}, ": there is none like that; set JAX_PLATFORMS=cpu"),
    ):
        for name in jax_start.OF_DEVICES:
            monkeypatch.delenv(name, raising=False)
        for name, value in values.items():
            monkeypatch.setenv(name, value)
        with pytest.raises(jax_start.StartError, match=f"JAX finds no device{said}"):
            jax_start.start()


def test_flags_that_would_end_the_process_are_refused(monkeypatch):
    for flags, reason in (
        ("--x=1", "Unknown flag in XLA_FLAGS: --x=1"),
        ("--xla_cpu_prefer_vector_width=x", "Couldn't interpret value x for flag"),
        ("no_file", 'Could not open file "no_file"'),
    ):
        monkeypatch.setenv(xla.VARIABLE, flags)
        with pytest.raises(jax_start.StartError, match=f"XLA_FLAGS={flags}: {reason}.*; unset XLA"):
            jax_start.start()


def test_settings_for_debugging_under_which_no_command_works_are_ignored(monkeypatch):
    wrong = {"jax_debug_nans": True, "jax_debug_infs": True, "jax_disable_jit": True,
             "jax_numpy_rank_promotion": "raise", "jax_numpy_dtype_promotion": "strict",
             "jax_check_tracer_leaks": True, "jax_transfer_guard": "disallow"}  # fmt: skip
    assert xla.NEEDED.keys() == wrong.keys()
    before = {name: getattr(jax.config, name) for name in wrong}
    try:
        for name, value in wrong.items():
            jax.config.update(name, value)
            xla.ignore_debugging()  # in Python, whoever set it keeps it
            assert getattr(jax.config, name) == value
            monkeypatch.setenv(name.upper(), str(value))
            with pytest.warns(RuntimeWarning, match=f"{name.upper()} is ignored: "):
                xla.ignore_debugging()
            assert getattr(jax.config, name) == xla.NEEDED[name][0]
    finally:
        for name, value in before.items():
            jax.config.update(name, value)


# Calls in threads

FLOATS = {False: np.float32, True: np.float64}  # with JAX's setting off and on


def new_floats() -> np.dtype:
    return jnp.ones(()).dtype


def fail(number: int = 0) -> None:
    raise ValueError(f"as intended: {number}")


@pytest.mark.parametrize("cores", [1, 2, 5])
def test_outputs_are_in_the_order_of_the_calls_and_no_call_starts_after_a_failure(
    monkeypatch, cores
):
    monkeypatch.setattr(threads, "usable_cores", lambda: cores)
    for count in (0, 1, 7):
        calls = [lambda number=number: jnp.asarray(number) for number in range(count)]
        assert [int(output) for output in threads.on_all_cores(calls)] == list(range(count))
    succeeded = []
    with pytest.raises(ValueError, match="as intended"):
        threads.on_all_cores([fail] * cores + [lambda: succeeded.append(True)] * 100)
    assert not succeeded


@pytest.mark.parametrize("enabled", FLOATS)
def test_two_calls_run_at_the_same_time_and_have_the_callers_types(monkeypatch, enabled):
    monkeypatch.setattr(threads, "usable_cores", lambda: 2)
    meeting = threading.Barrier(2, timeout=30)  # breaks unless two threads wait at it together

    def meet() -> jax.Array:
        meeting.wait()
        return jnp.ones(())

    with jax.enable_x64(enabled), ThreadPoolExecutor(1) as pool:
        outputs = threads.on_all_cores([meet] * 2)
        assert pool.submit(for_other_thread(new_floats)).result() == FLOATS[enabled]
    assert [output.dtype for output in outputs] == [FLOATS[enabled]] * 2


def test_a_failure_in_a_helper_thread_is_raised(monkeypatch):
    monkeypatch.setattr(threads, "usable_cores", lambda: 2)
    caller, meeting = threading.get_ident(), threading.Barrier(2, timeout=30)

    def fail_in_helper() -> None:
        meeting.wait()
        if threading.get_ident() != caller:
            fail()

    with pytest.raises(ValueError, match="as intended"):
        threads.on_all_cores([fail_in_helper] * 2)


@pytest.mark.parametrize("enabled", FLOATS)
def test_a_call_has_64_bits_and_its_caller_what_it_had_and_arrays_keep_their_types(enabled):
    single, double = jnp.ones(3, np.float32), jnp.ones(3, np.float64)
    with jax.enable_x64(enabled):
        assert in_float64(new_floats)() == np.float64
        assert in_float64(in_float64(new_floats))() == np.float64
        assert new_floats() == FLOATS[enabled]
        with pytest.raises(ValueError, match="as intended"):
            in_float64(fail)()
        assert new_floats() == FLOATS[enabled]
        doubled = [in_float64(lambda x: 2 * x)(array) for array in (single, double)]
    assert [array.dtype for array in doubled] == [np.float32, np.float64]
    tree = {"float": double, "integer": jnp.arange(2), "switch": jnp.array(True), "name": "x"}
    changed = with_floats(tree, np.float32)  # only floats
    assert changed["float"].dtype == np.float32
    assert changed["integer"].dtype == tree["integer"].dtype
    assert changed["switch"].dtype == bool and changed["name"] == "x"


# In other processes


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


def page_faults(megabytes: int) -> int:
    """Of writing so much eight times, after the first times."""
    counts = []
    for _ in range(3):
        counts.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt)
        for _ in range(8):
            np.empty(megabytes << 20, np.uint8).fill(1)
    return counts[2] - counts[1]


def test_other_processes_have_the_same_floats_and_settings_and_hand_back_errors(client):
    assert cluster.hosts(client) == ["127.0.0.1"]
    function = functools.partial(describe, jnp.asarray([1.0, 1e-12]))
    computed = dict(cluster.compute(client, function, [1.0, 2.0]))
    for index, factor in enumerate([1.0, 2.0]):
        floats, total, flags, process = computed[index].result()
        assert (floats, total) == ("float64", factor * (1.0 + 1e-12))
        assert flags == os.environ["XLA_FLAGS"] and process != os.getpid()
    [(_, failed)] = cluster.compute(client, fail, [3])
    with pytest.raises(ValueError, match="as intended: 3"):
        failed.result()


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="of glibc only")
def test_a_worker_keeps_the_memory_that_it_has_freed(client):
    [(_, faults)] = cluster.compute(client, page_faults, [4])
    assert faults.result() < 8 * (4 << 20) // 4096 / 10


def test_a_cluster_that_cannot_be_is_refused_and_none_is_this_process(monkeypatch):
    with cluster.connect() as client:
        assert client is None
    monkeypatch.setattr(cluster, "CONNECT_SECONDS", 0.5)
    for workers, scheduler, words in (
        (-1, None, "workers is -1; wanted 0"),
        (2, "tcp://127.0.0.1:1", "not both"),
        (0, "tcp://127.0.0.1:1", "no Dask scheduler answers at 'tcp://127.0.0.1:1'"),
        (0, "nonsense://x", "no Dask scheduler answers at 'nonsense://x'"),
    ):
        with pytest.raises(ValueError, match=words), cluster.connect(workers, scheduler):
            pass
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ValueError, match=r"pip install 'jaxik\[dask\]'"), cluster.connect(2):
        pass


def test_the_peak_of_a_process_does_not_begin_with_that_of_its_parent():
    # Of resident memory: what the parent has touched counts.
    taken = b"1" * 600_000_000
    words = "from fitting.runtime.machine import peak_mb; print(peak_mb())"
    own = machine.peak_mb()
    assert own is not None and own > len(taken) / 1e6
    assert 1.0 < float(printed(words, **os.environ)) < 300.0
