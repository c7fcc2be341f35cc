"""Commands that refuse: one line, and nothing changes."""

from collections.abc import Iterable
from pathlib import Path

from fitting.cli import main


def refusal(words: Iterable[object], folder: Path, capsys, *, silent: bool = True) -> str:
    """The one line that a command prints of a mistake, while nothing in this folder changes.

    Args:
        words: of the command.
        folder: what it must leave as it is.
        capsys: pytest's.
        silent: whether it prints nothing before.
    """
    before = _content(folder)
    assert main.main([str(word) for word in words]) == main.MISTAKE
    output = capsys.readouterr()
    (line,) = output.err.splitlines()
    assert not (silent and output.out) and _content(folder) == before
    return line


def _content(folder: Path) -> dict[Path, bytes]:
    """All that is in a folder; of folders, that they are there."""
    return {path: path.read_bytes() if path.is_file() else b"" for path in folder.rglob("*")}
