"""The commands of `jaxik`: all that its parser knows, and what they do when they refuse."""

import argparse
import dataclasses
from collections.abc import Iterable
from pathlib import Path

import pytest

from fitting.cli import main, parser
from fitting.cli.options import Call, Command
from fitting.cli.parser import make_parser


def commands() -> dict[str, argparse.ArgumentParser]:
    """The parser of each command by its words, `record` and `record show` among them."""
    return dict(_below(make_parser(), ""))


def replace_call(monkeypatch: pytest.MonkeyPatch, command: Command, call: Call) -> None:
    """Has a command do something else."""
    replaced = {command: dataclasses.replace(command, call=call)}
    monkeypatch.setattr(parser, "COMMANDS", [replaced.get(c, c) for c in parser.COMMANDS])


def _below(parser: argparse.ArgumentParser, words: str):
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, child in action.choices.items():
                command = f"{words} {name}".strip()
                yield command, child
                yield from _below(child, command)


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
