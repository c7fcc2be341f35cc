"""How `--help` looks: with colours on a terminal, plain elsewhere."""

import argparse
import sys

from .terminal import can_draw


def help_formatter() -> type[argparse.HelpFormatter]:
    """The class that lays out the help of a command; descriptions and examples stay as they are."""
    if not can_draw(sys.stdout):
        return argparse.RawDescriptionHelpFormatter
    try:
        from rich_argparse import RawDescriptionRichHelpFormatter
    except ImportError:  # `jaxik doctor` says so, and must be able to
        return argparse.RawDescriptionHelpFormatter

    class HelpFormatter(RawDescriptionRichHelpFormatter):
        text_markup = help_markup = False  # brackets are those of TOML

    return HelpFormatter
