"""Independent calls in other processes: of this machine, or of a Dask cluster.

Dask schedules them, notices workers that die, and gives their calls to others.
"""

import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

from . import cache_folder, xla
from .precision import in_float64

if TYPE_CHECKING:
    from distributed import Client, Future

CONNECT_SECONDS = 10  # how long to wait for a scheduler
Argument = TypeVar("Argument")


@contextmanager
def connect(workers: int = 0, scheduler: str | None = None) -> "Iterator[Client | None]":
    """A client of a cluster, or None where calls are to be made in this process.

    Args:
        workers: number of processes to start on this machine, one core each.
        scheduler: address of a running Dask scheduler. Its workers need this package.

    Raises:
        ValueError: workers below 0; both workers and a scheduler; Dask is not installed; there is
            no scheduler at the address.
    """
    if workers < 0:
        raise ValueError(f"workers is {workers}; wanted 0 (this process) or more")
    if workers and scheduler is not None:
        raise ValueError(f"wanted {workers} workers or the scheduler at {scheduler}, not both")
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
        options: dict[str, Any] = {"threads_per_worker": 1, "dashboard_address": None}
        with LocalCluster(n_workers=workers, **options) as local, Client(local) as client:
            yield client
        return
    try:
        client = Client(scheduler, timeout=CONNECT_SECONDS)
    except (OSError, ValueError) as error:
        raise ValueError(f"no Dask scheduler answers at {scheduler!r}: {error}") from None
    with client:
        yield client


def compute(
    client: "Client", function: Callable[[Argument], Any], arguments: Sequence[Argument]
) -> "Iterator[tuple[int, Future]]":
    """The index of each argument and the function's finished future for it, as they finish.

    The function travels to each worker once, with all that it holds; its arrays keep their 64 bits.
    A call's error is raised by `result()` of its future.
    """
    import cloudpickle
    from distributed import as_completed

    shared = client.scatter(cloudpickle.dumps(function))
    futures = {
        client.submit(_call, shared, argument, pure=False): index
        for index, argument in enumerate(arguments)
    }
    for future in as_completed(futures):
        yield futures[future], future


@in_float64
def _call(function: bytes, argument: Any) -> Any:
    _prepare()
    return _loaded(function)(argument)


@functools.cache
def _prepare() -> None:
    """Has a worker compute as this process does; nothing of JAX has run there before."""
    xla.configure_xla()
    cache_folder.use_default()


@functools.lru_cache(maxsize=1)
def _loaded(function: bytes) -> Callable[[Any], Any]:
    """The function, read once: Dask would read its arrays outside `in_float64`, as 32 bits."""
    import cloudpickle

    return cloudpickle.loads(function)
