"""The time of the page: it plays a clip at its own speed, as often as the page can be drawn."""

import threading
import time
from collections.abc import Callable

RATE = 30.0  # Hz, at which frames are drawn at most


class Player:
    """Counts time while it plays, from the end to the beginning again.

    Args:
        seconds: length of what is played.
        draw: called with the time, s.
    """

    def __init__(self, seconds: float, draw: Callable[[float], object]):
        self.seconds, self.speed = seconds, 1.0
        self._draw = draw
        self._time = 0.0
        self._playing, self._closed = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="jaxik view: player", daemon=True)
        self._thread.start()

    @property
    def playing(self) -> bool:
        """Whether time goes on."""
        return self._playing.is_set()

    def play(self, on: bool) -> None:
        """Goes on, or stops."""
        (self._playing.set if on else self._playing.clear)()

    def seek(self, seconds: float) -> None:
        """Goes to a time, s, and draws it."""
        self._time = min(max(seconds, 0.0), self.seconds)
        self._draw(self._time)

    def close(self) -> None:
        """Ends its thread."""
        self._closed.set()
        self._playing.set()
        self._thread.join()

    def _run(self) -> None:
        before = time.monotonic()
        while not self._closed.is_set():
            if not self.playing:
                self._playing.wait()
                before = time.monotonic()
            self._closed.wait(1.0 / RATE)
            now = time.monotonic()
            if self.playing and not self._closed.is_set():
                later = self._time + self.speed * (now - before)
                self.seek(later if later <= self.seconds else 0.0)
            before = now
