"""One process compiles what several need; the others of this machine wait until it is kept.

Processes that share a cache of programs would all compile the same ones if they began at once.
Which programs a process has kept is noted beside them, so that later ones need not wait. A lock
ends with its process, also a killed one.
"""

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from fitting.runtime import cache_folder
from fitting.runtime.storage.claimed_folder import InUseError, claimed

PATIENCE = 0.2  # s between looks at a lock


@contextmanager
def first_alone(key: str) -> Iterator[None]:
    """Keeps other processes of this machine waiting as long as the first one with this key is here.

    Nobody waits where programs are not kept.

    Args:
        key: 64 hexadecimal digits, the same for processes that need the same programs.
    """
    try:
        folder = cache_folder.traced()
    except (cache_folder.SwitchedOffError, OSError):
        yield
        return
    kept = folder / f"kept-{key}"
    with ExitStack() as stack:
        if not kept.exists():
            stack.enter_context(waiting_for(folder / f"first-{key}"))
        if kept.exists():
            stack.close()  # another process has kept them meanwhile
        yield
        kept.touch()


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
