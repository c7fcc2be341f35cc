"""Words and options of the commands whose work is shared out to many processes."""

import argparse
from pathlib import Path

from .options import Commands, add_command, add_output, count


def add_fit_many(commands: Commands) -> None:
    """`jaxik fit-many`."""
    many = add_command(
        commands, "fit-many", "fit each clip of many experiments alone, on many cores or machines",
        """
        jaxik fit-many walks.toml runs.toml -o runs/all
        jaxik fit-many walks.toml --seeds 3 --workers 8 -o runs/walks
        jaxik fit-many walks.toml --scheduler tcp://10.0.0.1:8786 --no-reports -o /shared/walks

        Each fit is a run folder, DIR/runs/EXPERIMENT/CLIP/seed_N, as `jaxik fit` makes it; all are
        a row each of fits.csv and, with the extra `parquet`, of fits.parquet. The same command goes
        on after Ctrl-C (status 130), a kill, or failures, and repeats no finished fit. Needs the
        extra `dask` unless --workers is 0. Status 0: all fits converged. 3: at least one has not.
        6: at least one failed; the table says why. Whether a fit fits is in the table only.
        """,
    )  # fmt: skip
    many.add_argument(
        "experiments", type=Path, nargs="+", metavar="EXPERIMENT.toml",
        help="as `jaxik fit` takes them",
    )  # fmt: skip
    add_output(many, "DIR", "folder for all runs, the table and the report")
    many.add_argument(
        "--seeds", type=count(1, 10_000), default=1, metavar="N",
        help="fits of each clip, from the experiment's seed on (default: 1)",
    )  # fmt: skip
    many.add_argument(
        "--together", action="store_true",
        help="fit the clips of an experiment together, as `jaxik fit` does (default: each alone)",
    )  # fmt: skip
    many.add_argument(
        "--record-only", action="store_true",
        help="leave out what the game's record has no room for",
    )  # fmt: skip
    many.add_argument(
        "--no-reports", dest="reports", action="store_false",
        help="only the numbers and motions of each run: no tables, pictures and pages",
    )  # fmt: skip
    add_workers(many, None, "one for each core")


def add_workers(command: argparse.ArgumentParser, default: int | None, meaning: str) -> None:
    """Adds which processes compute."""
    command.add_argument(
        "--workers", type=count(0, 1024), default=default, metavar="N",
        help="compute in N other processes of this machine, with the extra `dask`; 0 computes in "
        f"this one (default: {meaning})",
    )  # fmt: skip
    command.add_argument(
        "--scheduler", metavar="ADDRESS", help="compute on the Dask cluster of this scheduler"
    )
