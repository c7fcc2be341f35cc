"""Independent calls in other processes: of this machine, or of a Dask cluster.

Dask schedules them, notices workers that die, and gives their calls to others. Workers of this
machine are spawned, never forked: a fork of a process in which JAX has started may hang.

One process compiles what several need; the others of this machine wait until it is cached.

Processes that share a cache of programs would all compile the same ones if they began at once.
Which programs a process has cached is noted beside them, so that later ones need not wait. A lock
ends with its process, also a killed one.
"""

import functools
import importlib.util
import logging
import os
import platform
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from multiprocessing import resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, TypeVar

import jax

from . import cache_folder, machine, xla
from .claimed_folder import InUseError, claimed
from .precision import in_float64

if TYPE_CHECKING:
    from distributed import Client, Future


CONNECT_SECONDS = 10  # how long to wait for a scheduler
WAITING = 2  # calls that each core has or will have, so that none waits for the next one
DASHBOARD = "127.0.0.1:0"  # any free port, for this machine only
# Of memory, after which a worker drops its compiled programs: Linux ends a process that asks for
# more than 65,530, and each program takes some. They are read again from the cache.
MAX_MAPPINGS = 20_000
# Dask would look at every stack a hundred times a second: 7 % of a fit's CPU time.
UNPROFILED = {"DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False"}
# With this variable, Dask has its workers give freed memory back at once. Each larger array is then
# mapped, filled with zeros and unmapped again, which takes a fifth of a short fit's CPU time.
TRIMMED = "MALLOC_TRIM_THRESHOLD_"
Argument = TypeVar("Argument")

PATIENCE = 0.2  # s between looks at a lock


@contextmanager
def connect(
    workers: int = 0, scheduler: str | None = None, *, dashboard: bool = False
) -> "Iterator[Client | None]":
    """A client of a cluster, or None where calls are to be made in this process.

    Args:
        workers: number of processes to start on this machine, one core each.
        scheduler: address of a running Dask scheduler. Its workers need this package.
        dashboard: whether processes on this machine have Dask's page that shows them at work.

    Raises:
        ValueError: workers below 0; both workers and a scheduler; Dask is not installed; there is
            no scheduler at the address.
    """
    if workers < 0:
        raise ValueError(f"workers is {workers}; wanted 0 (this process) or more")
    if workers and scheduler is not None:
        raise ValueError(
            f"wanted workers on this machine ({workers}) or the scheduler at {scheduler}, not both"
        )
    if not workers and scheduler is None:
        yield None
        return
    try:
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise ValueError(
            f"other processes need Dask ({error}); install it with: pip install 'jaxik[dask]'"
        ) from None
    if scheduler is None:
        options: dict[str, Any] = {
            "threads_per_worker": 1,
            "dashboard_address": DASHBOARD if dashboard and has_dashboard() else None,
            "silence_logs": logging.ERROR,  # the job reports a worker that dies
            "env": _environment(),
        }
        with _workers_without_interrupts():
            local = LocalCluster(n_workers=workers, **options)
        with local, Client(local, set_as_default=False) as client:
            yield client
        return
    try:
        client = Client(scheduler, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ValueError(f"no Dask scheduler answers at {scheduler!r}: {error}") from None
    with client:
        yield client


@contextmanager
def _workers_without_interrupts() -> Iterator[None]:
    """Has processes that are started now, and by threads that are, leave Ctrl-C to this one.

    A terminal sends it to all of them, and workers would print where it met them. What this process
    gets meanwhile, it gets at the end.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # which would let interrupts through when it is started
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def has_dashboard() -> bool:
    """Whether what Dask draws its page with is installed."""
    return importlib.util.find_spec("bokeh") is not None


def hosts(client: "Client") -> list[str]:
    """The machine of each worker."""
    workers: Any = client.scheduler_info(n_workers=-1)["workers"]
    return [worker["host"] for worker in workers.values()]


def compute(
    client: "Client", function: Callable[[Argument], Any], arguments: Sequence[Argument]
) -> "Iterator[tuple[int, Future]]":
    """The index of each argument and the function's finished future for it, as they finish.

    The function travels to each worker once, with all that it holds; its arrays stay at 64 bits.
    A call's error is raised by `result()` of its future. Calls of a worker that dies are made by
    others; after the fourth death at one call, its error is `KilledWorker`. However many arguments
    there are, the scheduler gets no more calls than its workers need to stay busy.
    """
    import cloudpickle
    from distributed import as_completed

    # A task and no `scatter`: what is lost with a worker is made again from the scheduler's copy.
    shared = client.submit(bytes, cloudpickle.dumps(function), pure=False)
    indices: dict[Future, int] = {}
    completed = as_completed(loop=client.loop)
    waiting = iter(enumerate(arguments))

    def submit_more() -> None:
        room = WAITING * max(sum(_cores(client)), 1) - len(indices)
        for _ in range(room):
            if (item := next(waiting, None)) is None:
                return
            index, argument = item
            future = client.submit(_call, shared, argument, pure=False)
            indices[future] = index
            completed.add(future)

    submit_more()
    while indices:
        future = next(completed)
        index = indices.pop(future)
        submit_more()
        yield index, future


def _cores(client: "Client") -> list[int]:
    """Of each worker."""
    cores: Any = client.ncores()  # a client of another kind would have to be waited for
    return list(cores.values())


def _environment() -> dict[str, str]:
    """Variables with which workers of this machine compute, and cache programs, as this process."""
    names = (cache_folder.FOLDER, cache_folder.ENABLED, cache_folder.MIN_SECONDS)
    settings = {name.upper(): cache_folder.setting(name) for name in names}
    return (
        {
            name: str(int(value) if isinstance(value, bool) else value)
            for name, value in settings.items()
            if value is not None
        }
        | {name: os.environ[name] for name in (xla.VARIABLE,) if name in os.environ}
        | UNPROFILED
    )


@in_float64
def _call(function: bytes, argument: Any) -> Any:
    _prepare()
    try:
        return _loaded(function)(argument)
    finally:
        drop_programs_of_too_many()


@functools.cache
def _prepare() -> None:
    """Has a worker compute as this process does; nothing of JAX has run there before."""
    os.environ.pop(TRIMMED, None)
    xla.configure_xla()
    xla.prefer_cpu()
    xla.ignore_debugging()
    cache_folder.use_default()


@functools.lru_cache(maxsize=1)
def _loaded(function: bytes) -> Callable[[Any], Any]:
    """The function, read once: Dask would read its arrays outside `in_float64`, as 32 bits."""
    import cloudpickle

    return cloudpickle.loads(function)


def drop_programs_of_too_many() -> None:
    """Forgets this process's compiled programs where they take many mappings of memory."""
    if machine.mappings() > MAX_MAPPINGS:
        jax.clear_caches()


class Effort(TypedDict):
    """The cost of a piece of work, and where it was done."""

    seconds: float
    """Without those for which it waited."""
    waited: float
    """s, for other processes that compiled what it needs."""
    cpu_seconds: float
    """Of all threads of the process."""
    peak_mb: float | None
    """Resident memory of the process at its highest so far; None where that is not known."""
    host: str
    process: int


class Stopwatch:
    """Measures work from the moment it is made."""

    def __init__(self) -> None:
        self._began = time.monotonic(), time.process_time()
        self._waited = 0.0

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Does not count what is done within."""
        began = time.monotonic()
        try:
            yield
        finally:
            self._waited += time.monotonic() - began

    def read(self) -> Effort:
        """The effort so far."""
        began, cpu_began = self._began
        return {
            "seconds": time.monotonic() - began - self._waited,
            "waited": self._waited,
            "cpu_seconds": time.process_time() - cpu_began,
            "peak_mb": machine.peak_mb(),
            "host": platform.node(),
            "process": os.getpid(),
        }


@contextmanager
def first_alone(key: str) -> Iterator[None]:
    """Keeps other processes of this machine waiting as long as the first one with this key is here.

    Nobody waits where programs are not cached.

    Args:
        key: 64 hexadecimal digits, the same for processes that need the same programs.
    """
    try:
        folder = cache_folder.traced()
    except (cache_folder.SwitchedOffError, OSError):
        yield
        return
    finished = folder / f"kept-{key}"
    with ExitStack() as stack:
        if not finished.exists():
            stack.enter_context(waiting_for(folder / f"first-{key}"))
        if finished.exists():
            stack.close()  # another process has cached them meanwhile
        yield
        finished.touch()


@contextmanager
def waiting_for(folder: Path) -> Iterator[None]:
    """Claims a folder, after any other process that has claimed it."""
    with ExitStack() as stack:
        while True:
            try:
                stack.enter_context(claimed(folder))
                break
            except InUseError:
                time.sleep(PATIENCE)
        yield
