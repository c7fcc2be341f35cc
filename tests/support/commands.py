"""The commands of `jaxik` as its parser knows them."""

import argparse

from fitting.cli.parser import make_parser


def commands() -> dict[str, argparse.ArgumentParser]:
    """The parser of each command by its words, `record` and `record show` among them."""
    return dict(_below(make_parser(), ""))


def _below(parser: argparse.ArgumentParser, words: str):
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, child in action.choices.items():
                command = f"{words} {name}".strip()
                yield command, child
                yield from _below(child, command)
