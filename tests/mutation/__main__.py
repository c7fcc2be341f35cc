"""Mutation testing: `PYTHONPATH=tests python -m mutation --count 200 --seed 1`.

Changes a line of the source, in a copy of the checkout, and runs the tests that execute it until
one fails; then the next. Which tests do is shown by a run of the suite, the first time. Prints how
many changes the tests caught and lists those that survived. Results are kept in `build/mutation`:
the same command goes on where it was interrupted. The exit status is 1 if less than the goal,
95 %, was caught.
"""

import argparse
import math
import os
import signal
import sys
import tempfile
from pathlib import Path

from .mutants import modules_of, mutants_of, sample
from .report import OUTCOMES, Result, score, summary
from .run import Run
from .survey import DIGESTS, EVERYTHING, Survey, make
from .trial import Workplace

ROOT = Path(__file__).resolve().parents[2]
KEPT = ROOT / "build" / "mutation"
PACKAGES = ("jaxik", "fitting")
BUDGET = 45.0  # CPU seconds of tests for each mutant in the first round; the second has no limit
# A changed program is another program, so that mutants may share what is compiled.
ENVIRONMENT = {
    "JAX_COMPILATION_CACHE_DIR": str(KEPT / "programs"),
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
}


def print_progress(results: list[Result], seconds: float, last: Result) -> None:
    """Prints how far the run is, and how long this round will still take."""
    outcomes = [result.outcome for result in results]
    counts = ", ".join(f"{outcomes.count(word)} {word}" for word in OUTCOMES)
    print(
        f"{len(results)}: {counts}; {seconds / 60:.0f} minutes left"
        f" ({last.outcome} in {last.seconds:.0f} s: {last.path}:{last.line} {last.by})",
        flush=True,
    )


def main() -> int:
    """Tests a sample of mutants, or all of some modules; gives the exit status."""
    parser = argparse.ArgumentParser(prog="mutation", description="Changes code, and tests it.")
    parser.add_argument("--count", type=int, default=200, help="mutants, of all modules together")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", default=[*PACKAGES], help="folders or modules")
    parser.add_argument("--goal", type=float, default=0.95, help="the part to be caught, 0..1")
    parser.add_argument("--report", type=Path, help="a file for what is printed at the end")
    parser.add_argument("--retry", action="store_true", help="test survivors again")
    parser.add_argument("--budget", type=float, help="only so many CPU seconds of tests for each")
    parser.add_argument("--all", action="store_true", help="ask tests marked as slow, too")
    parser.add_argument("--survey", action="store_true", help="find out anew which test runs what")
    options = parser.parse_args()
    KEPT.mkdir(parents=True, exist_ok=True)
    os.environ.update(ENVIRONMENT)
    for number in (signal.SIGTERM, signal.SIGINT):  # shells have jobs in the background ignore it
        signal.signal(number, signal.default_int_handler)
    modules = [path for folder in options.only for path in modules_of(ROOT, folder)]
    mutants = [mutant for path in modules for mutant in mutants_of(ROOT, path)]
    chosen = sample(mutants, options.count, options.seed)
    print(f"{len(chosen)} of {len(mutants)} mutants in {len(modules)} modules", flush=True)
    folder = KEPT / ("all" if options.all else "default")
    if options.survey or not (folder / DIGESTS).exists():
        make(ROOT, folder, EVERYTHING if options.all else "not slow")
    with tempfile.TemporaryDirectory(prefix="mutation-") as copy:
        workplace = Workplace(ROOT, Path(copy))
        run = Run(workplace, Survey(ROOT, folder), folder / f"{options.seed}.jsonl")
        if options.retry:
            run.forget_survivors()
        try:
            for budget in (options.budget,) if options.budget else (BUDGET, math.inf):
                run.round(chosen, budget, print_progress)
        except KeyboardInterrupt:
            print("Interrupted: the same command goes on from here.")
        results = run.results_of(chosen)
    text = summary(results)
    print(text)
    if options.report:
        options.report.write_text(text + "\n", encoding="utf-8")
    return int(score(results)[0] < options.goal)


if __name__ == "__main__":
    sys.exit(main())
