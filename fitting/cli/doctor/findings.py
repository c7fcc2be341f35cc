"""What an examination finds: a fact, or a problem and what to do about it."""

import json
from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class Finding:
    """One line of the examination."""

    subject: str
    fact: str
    problem: str = ""
    """What is wrong, in a line; empty if nothing is."""
    remedy: str = ""
    """What to do about it."""

    def to_json(self) -> str:
        """One line, for another process."""
        return json.dumps(asdict(self))


def from_json(line: str) -> Finding | None:
    """The finding that another process printed; None for any other line."""
    try:
        return Finding(**json.loads(line))
    except (ValueError, TypeError):
        return None
