"""How far many fits are, and what was found in the end."""

import dataclasses
from pathlib import Path

from .rows import Row


@dataclasses.dataclass(frozen=True)
class ManyProgress:
    """How far many fits are; reported with each that ends."""

    done: int
    """Those of earlier calls included."""
    total: int
    failed: int
    elapsed: float
    """s, of this call."""
    made: int
    """In this call."""

    @property
    def rate(self) -> float:
        """Fits a minute, in this call."""
        return 60.0 * self.made / max(self.elapsed, 1e-9)

    @property
    def remaining(self) -> float:
        """s, estimated; infinite before the first fit of this call is done."""
        return 60.0 * (self.total - self.done) / self.rate if self.made else float("inf")


@dataclasses.dataclass(frozen=True)
class ManyFits:
    """Many fits, each with its row, in the order in which they were planned."""

    rows: tuple[Row, ...]
    """None of fits that an interrupt has left out."""
    total: int
    folder: Path
    elapsed: float = 0.0
    """s, of this call."""
    made: int = 0
    """In this call."""
    interrupted: bool = False

    @property
    def finished(self) -> list[Row]:
        """The rows of fits that are whole."""
        return [row for row in self.rows if row["state"] == "finished"]

    @property
    def failed(self) -> list[Row]:
        """The rows of fits that could not be made."""
        return [row for row in self.rows if row["state"] == "failed"]

    @property
    def unconverged(self) -> list[Row]:
        """The rows of finished fits whose search has not converged."""
        return [
            row for row in self.finished if "outcome" in row and not row["outcome"]["converged"]
        ]
