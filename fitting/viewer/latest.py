"""Work that is only worth doing for the newest request, in a thread of its own."""

import threading
import traceback
from collections.abc import Callable


class Latest:
    """Does some work whenever it was asked for since it last began; requests do not queue up.

    Args:
        work: what to do; it looks up by itself what is newest.
    """

    def __init__(self, work: Callable[[], object]):
        self.work = work
        self._asked = self._closed = self._busy = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="jaxik view: solver", daemon=True)
        self._thread.start()

    def ask(self) -> None:
        """Asks for the work to be done, and returns at once."""
        with self._changed:
            self._asked = True
            self._changed.notify_all()

    def wait(self, seconds: float | None = None) -> bool:
        """Waits until all that was asked for is done; False if that takes longer."""
        with self._changed:
            return self._changed.wait_for(lambda: not (self._asked or self._busy), seconds)

    def close(self) -> None:
        """Ends the thread, after the work that it is doing."""
        with self._changed:
            self._closed, self._asked = True, False
            self._changed.notify_all()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._asked or self._closed)
                if self._closed:
                    return
                self._asked, self._busy = False, True
            try:
                self.work()
            except Exception:  # the next request may do better
                traceback.print_exc()
            finally:
                with self._changed:
                    self._busy = False
                    self._changed.notify_all()
