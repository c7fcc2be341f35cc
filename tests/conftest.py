"""Shared fixtures: 64-bit floats, and the reference material beside the project.

Programs are compiled without optimisations, which take longer than the programs run; set
JAX_DISABLE_MOST_OPTIMIZATIONS=0 to compile them as for users, as notebooks do in any case. All
processes of a run, and the next run, find compiled programs in one folder.
"""

import contextlib
import ctypes
import gc
import os
import resource
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest
from matplotlib.figure import Figure

from fitting.cli import terminal
from fitting.runtime import beside, cache_folder, xla
from support.pages import save_pixel

xla.configure_xla()  # as the commands do
jax.config.update("jax_enable_x64", True)
UNOPTIMIZED = os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")  # for child processes
jax.config.update("jax_disable_most_optimizations", UNOPTIMIZED != "0")
# Notes in programs of where they come from, which take a tenth of the time to compile.
jax.config.update("jax_traceback_in_locations_limit", 0)
ROOT = Path(__file__).resolve().parents[1]
PROGRAMS = "JAX_COMPILATION_CACHE_DIR"
KEPT_PROGRAMS = ROOT / ".pytest_cache" / "programs"  # `--cache-clear` empties it
os.environ.setdefault(PROGRAMS, str(KEPT_PROGRAMS))
jax.config.update(PROGRAMS.lower(), os.environ[PROGRAMS])
SHORTEST = "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"  # of programs that are kept
jax.config.update(SHORTEST.lower(), float(os.environ.setdefault(SHORTEST, "0.1")))
cache_folder.write_complete_files()  # what one process writes another may read

# Some tests send themselves what Ctrl-C does, which shells have jobs in the background ignore.
signal.signal(signal.SIGINT, signal.default_int_handler)

# What commands print must not depend on how fast they are.
terminal.PATIENCE = terminal.INTERVAL = terminal.SILENCE = float("inf")

# Each test process would start others to draw in, only to draw small pictures.
beside.cpu_count = lambda: 1

# Tracing makes many objects that live for long; looking for dead cycles among them takes a tenth.
gc.set_threshold(200_000, 50, 100)

MAX_KEPT = 1e9  # bytes of programs, of old sources most of them
MAX_MAPPINGS = 40_000  # of memory; Linux ends a process that asks for more than 65,530
MAX_RESIDENT = 2.5e9  # bytes of one test process after a file,
MAX_SHARE = 1 / 5  # or this part of the machine's memory, where that is more
LONGEST = ("test_notebooks.py", "test_documents.py", "test_jobs.py")
PEAKS: list[int] = []  # bytes of memory of each test process


def pytest_configure(config: pytest.Config) -> None:
    """Lets workers take files in their order, not those with most tests first."""
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False
    if not hasattr(config, "workerinput"):  # before there are workers
        kept = [path.stat().st_size for path in KEPT_PROGRAMS.glob("*")]
        if sum(kept) > MAX_KEPT:
            shutil.rmtree(KEPT_PROGRAMS)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begins with the longest files, so that at the end no worker waits for one of them."""
    items.sort(key=lambda item: item.path.name not in LONGEST)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Tells the process that started this one how much memory it took, and lets pytest end soon."""
    gc.freeze()  # pytest collects five times as it ends
    peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    getattr(session.config, "workeroutput", {})["peak"] = peak
    PEAKS.append(peak)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node) -> None:
    """Takes down the memory of a worker that has ended."""
    PEAKS.append(getattr(node, "workeroutput", {}).get("peak", 0))  # none where it crashed


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Says how much memory the largest process took."""
    terminalreporter.write_line(f"largest test process: {max(PEAKS) / 1e9:.1f} GB")


@pytest.fixture(scope="module", autouse=True)
def bounded_memory() -> Iterator[None]:
    """Drops all compiled programs after a file if they take much memory, or many mappings of it."""
    yield
    mappings, sizes = Path("/proc/self/maps"), Path("/proc/self/statm")  # on Linux only
    if not mappings.exists():
        return
    resident, physical = int(sizes.read_text().split()[1]), os.sysconf("SC_PHYS_PAGES")  # pages
    most = max(MAX_RESIDENT / os.sysconf("SC_PAGESIZE"), MAX_SHARE * physical)
    if resident > most or mappings.read_bytes().count(b"\n") > MAX_MAPPINGS:
        jax.clear_caches()
        gc.collect()
        with contextlib.suppress(AttributeError):  # of the GNU C library, which keeps what is freed
            ctypes.CDLL(None).malloc_trim(0)


@pytest.fixture(scope="module")
def optimised() -> Iterator[None]:
    """Compiles as for users: for whole fits, which compute for longer than that takes."""
    jax.clear_caches()
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", UNOPTIMIZED != "0")
    jax.clear_caches()


@pytest.fixture
def undrawn(monkeypatch) -> None:
    """Files hold a pixel of a figure, for tests of something else: drawing takes long."""
    monkeypatch.setattr(Figure, "savefig", save_pixel)


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of reference material beside the checkout."""
    path = ROOT.parent / "shared"
    if not (path / "mocap" / "README.md").exists():
        pytest.skip(f"needs the reference material in {path}, which is not there")
    return path


@pytest.fixture(scope="session")
def mocap(shared: Path) -> Path:
    """Captured clips and the benchmark on blocks."""
    return shared / "mocap"
