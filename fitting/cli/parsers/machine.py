"""Words and options of the commands about this machine."""

from pathlib import Path

from .options import Commands, add_command


def add_bench(commands: Commands) -> None:
    """`jaxik bench`."""
    bench = add_command(
        commands, "bench", "measure the speed of everything on this machine",
        """
        jaxik bench                          everything, in half an hour
        jaxik bench --quick                  smaller sizes, and neither fit nor curves
        jaxik bench --only legs,rays --json bench.json

        Ctrl-C prints, and writes, what has been measured so far, with status 130.
        """,
    )  # fmt: skip
    bench.add_argument("--quick", action="store_true", help="smaller sizes, fewer runs and rows")
    bench.add_argument("--only", metavar="NAME,...", help="these rows (default: all of them)")
    bench.add_argument("--json", type=Path, metavar="FILE", help="all numbers, of every run")
    bench.add_argument("--plot", type=Path, metavar="FILE.png", help="curves of time against size")


def add_cache(commands: Commands) -> None:
    """`jaxik cache`."""
    cache = add_command(
        commands, "cache", "show where compiled programs are kept between calls, or remove them",
        """
        jaxik cache
        jaxik cache --clear     other files in that folder stay
        """,
    )  # fmt: skip
    cache.add_argument("--clear", action="store_true", help="remove the programs")
