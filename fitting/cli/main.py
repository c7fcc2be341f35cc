"""The command `jaxik`: runs one command and turns its errors into one line and an exit status."""

import argparse
import atexit
import gc
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path

from fitting.runtime import activity
from fitting.runtime.validation import in_one_line

from . import jax_start, start, terminal
from .parser import make_parser
from .terminal import watched

JAX_CACHE = "persistent compilation cache"  # in warnings of JAX
MISTAKE, INTERRUPTED = start.MISTAKE, start.INTERRUPTED  # exit statuses
# Allocations between searches for dead cycles of objects. Imports and traces leave hundreds of
# thousands of objects that live on; by Python's own numbers a first fit spends 3 s looking at them.
COLLECTIONS = (200_000, 10, 10)
LIBRARIES = ("site-packages", "dist-packages")  # folders
OWN = ("jaxik", "fitting", "jaxtyping", "beartype")  # and what may wrap functions of ours
RENAMED = {"contribution": "ablate"}  # old commands, which still work in this release


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command and returns its exit status; a user's mistake prints one line on stderr."""
    with terminal.work_goes_on():
        words = _with_new_command(list(sys.argv[1:] if arguments is None else arguments))
        if null := [word for word in words if "\0" in word]:  # no path, but not every command tries
            print(f"jaxik: a word with a null byte: {null[0]!r}", file=sys.stderr)
            return MISTAKE
        options = make_parser().parse_args(words)
        try:
            with warnings.catch_warnings():
                warnings.showwarning = _show_warning
                with watched():
                    return _run(options)
        except (ValueError, OSError) as error:
            print(f"jaxik {options.command}: {in_one_line(error)}", file=sys.stderr)
            return MISTAKE
        except KeyboardInterrupt:
            print(f"\njaxik {options.command}: interrupted", file=sys.stderr)
            return INTERRUPTED


def _run(options: argparse.Namespace) -> int:
    """Runs a command; one that runs without JAX may import at any moment."""
    if not options.needs_jax:
        return options.call(options)
    _import_jax()
    with start.interrupts_raised():
        return options.call(options)


def _import_jax() -> None:
    """Imports JAX and what uses it, which takes seconds."""
    gc.set_threshold(*COLLECTIONS)
    atexit.register(gc.freeze)  # or Python, as it ends, looks at all of them several times more
    with activity.announced("Importing JAX"):
        jax_start.start()
        from fitting import jobs  # noqa: F401  # while Ctrl-C still ends the process


def _with_new_command(words: list[str]) -> list[str]:
    """The words with an old command replaced by its new name, after a warning."""
    if words and words[0] in RENAMED:
        old, new = words[0], RENAMED[words[0]]
        print(
            f"jaxik: `{old}` is now called `{new}`; the old name will be removed in the next "
            "release",
            file=sys.stderr,
        )
        return [new, *words[1:]]
    return words


def _show_warning(
    message: Warning | str, category: type[Warning], filename: str, *_: object, **__: object
) -> None:
    print(f"jaxik: {_library(filename)}{message}", file=sys.stderr)
    if JAX_CACHE in str(message):  # JAX would repeat it for each program
        warnings.filterwarnings("ignore", message=f".*{JAX_CACHE}")


def _library(filename: str) -> str:
    """The library of another in which this file lies, as the beginning of a line; empty of ours."""
    parts = Path(filename).parts
    name = next((parts[i + 1] for i, part in enumerate(parts[:-1]) if part in LIBRARIES), "")
    return f"{name.removesuffix('.py')} says: " if name and name not in OWN else ""


if __name__ == "__main__":
    sys.exit(main())
