"""Commands about this machine."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from fitting.bench import measurement, suite
from fitting.bench import report as bench_report
from fitting.bench.workloads import FULL, QUICK
from fitting.cli import progress
from fitting.cli.terminal import show
from fitting.report.formatting import wrapped
from fitting.runtime import activity, cache_folder
from fitting.runtime.validation import in_one_line

from . import status


def bench(options: argparse.Namespace) -> int:
    """Measures speed on this machine; uses no cache of programs."""
    chosen = suite.choose(suite.BENCHMARKS, options.only, options.quick)
    plot = bench_report.check_output_files(options.json, options.plot)
    sizes = QUICK if options.quick else FULL
    title = f"Running {len(chosen)} benchmarks"
    with activity.announced(title), progress.ProgressLine(str) as line:
        report = measurement.run_benchmarks(chosen, sizes, options.quick, _print_line, line)
    written = bench_report.write(report, options.json, plot)
    show(bench_report.text(report))
    for path in written:
        print(f"written to {path}")
    return status.of_job(interrupted=report.interrupted)


def cache(options: argparse.Namespace) -> int:
    """Shows where programs are kept between calls, or removes them."""
    cache_folder.use_default()
    folder = Path(str(cache_folder.setting(cache_folder.FOLDER) or cache_folder.default()))
    traced, compiled = cache_folder.kept_programs(folder)
    if options.clear:
        size = _megabytes([*traced, *compiled])
        for path in (*traced, *compiled):
            path.unlink(missing_ok=True)
        print(f"removed {len(traced)} traced and {len(compiled)} compiled, {size}, from {folder}")
        return 0
    try:
        cache_folder.traced()
        used = "yes"
    except (cache_folder.SwitchedOffError, OSError) as error:
        used = f"no: {in_one_line(error)}"
    rows = [
        ["place", f"{folder}"],
        ["traced programs", f"{len(traced)} ({_megabytes(traced)})"],
        ["compiled programs", f"{len(compiled)} ({_megabytes(compiled)})"],
        ["used", used],
    ]
    show(wrapped(rows, max(len(cell) for row in rows for cell in row) + 100))
    return 0


def _print_line(line: str) -> None:
    """Prints a line on stderr that stays."""
    print(line, file=sys.stderr, flush=True)


def _megabytes(paths: Sequence[Path]) -> str:
    return f"{sum(path.stat().st_size for path in paths) / 1e6:.1f} MB"
