"""The long run of the fuzzer: `PYTHONPATH=tests python -m fuzz --count 2000 --seed 1`.

Prints what became of the damaged files of each format. Files that were neither loaded nor refused
as they should be are kept in `build/fuzz`; the exit status is then 1.
"""

import argparse
import shutil
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path

from .formats import FORMATS, Format
from .trial import OUTCOMES, run_trials

KEPT = Path("build") / "fuzz"


def run_format(name: str, form: Format, seed: int, count: int) -> Counter[str]:
    """The outcomes of one format, each finding printed once and its file kept."""
    outcomes: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for number, outcome in run_trials(form, Path(folder), seed, count):
            if outcome not in OUTCOMES:
                if not outcomes[outcome]:
                    kept = KEPT / f"{seed}_{number}_{Path(form.file).name}"
                    shutil.copy(Path(folder) / form.file, kept)
                    print(f"{name}, {kept}: {outcome}", flush=True)
            outcomes[outcome] += 1
    return outcomes


def main() -> int:
    """Runs all formats, or those that are named; gives the exit status."""
    parser = argparse.ArgumentParser(prog="fuzz", description="Damages files and loads them.")
    parser.add_argument("--count", type=int, default=2000, help="files of each format")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", default=list(FORMATS), choices=list(FORMATS))
    options = parser.parse_args()
    KEPT.mkdir(parents=True, exist_ok=True)
    warnings.simplefilter("error")
    rows, wrong = [], 0
    for name in options.only:
        begin = time.process_time()
        outcomes = run_format(name, FORMATS[name], options.seed, options.count)
        wrong += (others := outcomes.total() - sum(outcomes[key] for key in OUTCOMES))
        counts = [outcomes[key] for key in OUTCOMES]
        rows.append((name, *counts, others, f"{time.process_time() - begin:.0f} s"))
        print("| " + " | ".join(map(str, rows[-1])) + " |", flush=True)
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
