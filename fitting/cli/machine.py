"""Commands about this machine, and about what is installed on it."""

import argparse
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

from fitting.runtime import activity

from . import status
from .options import argument, command, flag
from .start import interruptible
from .terminal import show

SHELLS = ("bash", "zsh", "tcsh", "fish", "powershell")  # that shtab knows


@command(
    flag("--quick", "smaller sizes, fewer runs and rows"),
    argument("--only", metavar="NAME,...", help="these rows (default: all of them)"),
    argument("--json", type=Path, metavar="FILE", help="all numbers, of every run"),
    argument("--plot", type=Path, metavar="FILE.png", help="curves of time against size"),
)  # fmt: skip
def bench(options: argparse.Namespace) -> int:
    """Measure the speed of everything on this machine.

    jaxik bench                          everything, in half an hour
    jaxik bench --quick                  smaller sizes, and neither fit nor curves
    jaxik bench --only legs,rays --json bench.json

    Ctrl-C prints, and writes, what has been measured so far, with status 130.
    """
    from fitting.bench import benchmarks, measurement, report
    from fitting.bench.workloads import FULL, QUICK

    chosen = benchmarks.choose(benchmarks.BENCHMARKS, options.only, options.quick)
    plot = report.check_output_files(options.json, options.plot)
    sizes = QUICK if options.quick else FULL
    title = f"Running {len(chosen)} benchmarks"
    with activity.announced(title), interruptible():
        measured = measurement.run_benchmarks(chosen, sizes, options.quick, _print_line)
    written = report.write(measured, options.json, plot)
    show(report.text(measured))
    for path in written:
        print(f"written to {path}")
    return status.of_job(interrupted=measured.interrupted)


def _print_line(line: str) -> None:
    """Prints a line on stderr that stays."""
    print(line, file=sys.stderr, flush=True)


@command(
    flag("--clear", "remove the programs"),
)  # fmt: skip
def cache(options: argparse.Namespace) -> int:
    """Show where compiled programs are cached between calls, or remove them.

    jaxik cache
    jaxik cache --clear     other files in that folder stay
    """
    from fitting.report.formatting import wrapped
    from fitting.runtime import cache_folder

    cache_folder.use_default()
    folder = cache_folder.used_folder()
    traced, compiled = cache_folder.cached_programs(folder)
    if options.clear:
        size = _megabytes([*traced, *compiled])
        for path in (*traced, *compiled):
            path.unlink(missing_ok=True)
        print(f"removed {len(traced)} traced and {len(compiled)} compiled, {size}, from {folder}")
        return 0
    reason = cache_folder.why_not_cached()
    rows = [
        ["place", f"{folder}"],
        ["traced programs", f"{len(traced)} ({_megabytes(traced)})"],
        ["compiled programs", f"{len(compiled)} ({_megabytes(compiled)})"],
        ["used", f"no: {reason}" if reason else "yes"],
    ]
    show(wrapped(rows, max(len(cell) for row in rows for cell in row) + 100))
    return 0


def _megabytes(paths: Sequence[Path]) -> str:
    return f"{sum(path.stat().st_size for path in paths) / 1e6:.1f} MB"


@command(flag("--quick", "leave the self-test out"), needs_jax=False)
def doctor(options: argparse.Namespace) -> int:
    """Check this installation, and say what to do about what is wrong.

    jaxik doctor
    jaxik doctor --quick        without the self-test, which takes up to half a minute

    The exit status is 0 if all is well, and 1 if there is a problem.
    """
    from . import examination

    width = shutil.get_terminal_size((100, 24)).columns
    problems = examination.print_findings(examination.examine(quick=options.quick), width)
    return status.PROBLEMS_FOUND if problems else 0


@command(argument("shell", choices=SHELLS), needs_jax=False)
def completion(options: argparse.Namespace) -> int:
    """Print what lets a shell complete words of jaxik.

    jaxik completion bash > ~/.local/share/bash-completion/completions/jaxik
    jaxik completion zsh > ~/.zfunc/_jaxik      a folder of fpath
    jaxik completion fish > ~/.config/fish/completions/jaxik.fish
    jaxik completion powershell > jaxik.ps1     for your profile

    Needs the extra `completion`: pip install "jaxik[completion]".
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
