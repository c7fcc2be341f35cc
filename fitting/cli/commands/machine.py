"""Commands about this machine."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from fitting.bench import report as bench_report
from fitting.bench import runner, suite
from fitting.bench.sizes import FULL, QUICK
from fitting.cli import progress
from fitting.runtime import cache_folder
from fitting.runtime.validation import in_one_line

from . import status


def bench(options: argparse.Namespace) -> int:
    """Measures speed on this machine; uses no cache of programs."""
    chosen = suite.choose(suite.BENCHMARKS, options.only, options.quick)
    plot = bench_report.check_output_files(options.json, options.plot)
    sizes = QUICK if options.quick else FULL
    with progress.ProgressLine(str) as line:
        report = runner.run_benchmarks(chosen, sizes, options.quick, progress.print_line, line)
    written = bench_report.write(report, options.json, plot)
    print(bench_report.text(report))
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
    print(f"place              {folder}")
    print(f"traced programs    {len(traced)} ({_megabytes(traced)})")
    print(f"compiled programs  {len(compiled)} ({_megabytes(compiled)})")
    try:
        cache_folder.traced()
        print("used               yes")
    except (cache_folder.SwitchedOffError, OSError) as error:
        print(f"used               no: {in_one_line(error)}")
    return 0


def _megabytes(paths: Sequence[Path]) -> str:
    return f"{sum(path.stat().st_size for path in paths) / 1e6:.1f} MB"
