"""Commands that run without JAX, because it may be broken, or because they do not need it."""

import argparse
import shutil
from collections.abc import Callable
from pathlib import Path

from . import examination

PROBLEMS_FOUND = 1  # exit status


def doctor(options: argparse.Namespace) -> int:
    """Examines this installation, and says what to do about what is wrong."""
    width = shutil.get_terminal_size((100, 24)).columns
    problems = examination.print_findings(examination.examine(quick=options.quick), width)
    return PROBLEMS_FOUND if problems else 0


def completion(options: argparse.Namespace) -> int:
    """Prints what lets a shell complete words of `jaxik`.

    Raises:
        ValueError: shtab is not installed.
    """
    try:
        import shtab
    except ImportError:
        raise ValueError('needs shtab: pip install "jaxik[completion]"') from None
    from .parser import make_parser

    parser = make_parser()
    for action in _actions(parser):
        if action.type is Path:
            action.complete = shtab.FILE  # type: ignore[attr-defined]  # as shtab wants it
    print(shtab.complete(parser, shell=options.shell), end="")
    return 0


def _actions(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    """The arguments of a parser and of those of its commands."""
    actions = []
    for action in parser._actions:
        actions.append(action)
        if isinstance(action, argparse._SubParsersAction):
            for child in dict.fromkeys(action.choices.values()):
                actions += _actions(child)
    return actions


COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {
    "doctor": doctor,
    "completion": completion,
}
