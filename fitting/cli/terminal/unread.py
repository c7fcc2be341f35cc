"""Streams whose reader may go, as in `jaxik fit … | head`, or that lack characters, as in ASCII."""

import io
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


class _Stream:
    """A stream that does not fail: it falls silent when nobody reads it any more.

    It replaces characters that its encoding lacks.
    """

    def __init__(self, stream: io.TextIOBase) -> None:
        self._stream = stream

    def write(self, text: str, /) -> int:
        encoding = self._stream.encoding or "utf-8"
        known = text.encode(encoding, "replace").decode(encoding)
        return self._try(lambda: self._stream.write(known)) or len(text)

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
    """Within this context nothing fails because of stdout or stderr."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (stream and _Stream(stream) for stream in before)  # pyright: ignore
    try:
        yield
    finally:
        if sys.stdout is not None:  # a closed one
            sys.stdout.flush()
        sys.stdout, sys.stderr = before
