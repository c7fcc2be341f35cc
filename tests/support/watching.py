"""Who watches long work in tests, and writes down what it is told."""

from fitting.runtime.activity import Work


class Recorder:
    """Writes down events; others may write into the same list."""

    def __init__(self) -> None:
        self.events: list[str] = []
        self._note = ""

    @property
    def titles(self) -> list[str]:
        """What was announced, in order."""
        starts = (event.partition("began ") for event in self.events)
        return [title for before, began, title in starts if began and not before]

    def began(self, work: Work) -> None:
        self.events.append(f"began {work.title}")

    def changed(self, work: Work) -> None:
        if work.note and work.note != self._note:
            self._note = work.note
            self.events.append(f"noted {work.note}")
        else:
            self.events.append(f"{work.title} {work.done} of {work.total}")

    def ended(self, work: Work) -> None:
        self.events.append(f"ended {work.title}")
