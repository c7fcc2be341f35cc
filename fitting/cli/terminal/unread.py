"""Streams whose reader may go, as that of `jaxik fit … | head` does, while the work goes on."""

import io
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


class _Stream:
    """A stream that falls silent when nobody reads it any more, instead of failing."""

    def __init__(self, stream: io.TextIOBase) -> None:
        self._stream = stream

    def write(self, text: str, /) -> int:
        return self._try(lambda: self._stream.write(text)) or len(text)

    def flush(self) -> None:
        self._try(self._stream.flush)

    def isatty(self) -> bool:
        return self._stream.isatty()

    def _try(self, call: Callable[[], int | None]) -> int | None:
        try:
            return call()
        except BrokenPipeError:  # what else is written, by other processes too, goes nowhere
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)
            return None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def work_goes_on() -> Iterator[None]:
    """Within this context nothing fails because stdout or stderr lost their reader."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (stream and _Stream(stream) for stream in before)  # pyright: ignore
    try:
        yield
    finally:
        if sys.stdout is not None:  # a closed one
            sys.stdout.flush()
        sys.stdout, sys.stderr = before
