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

from .formats import FORMATS
from .trial import OUTCOMES, run_trials

KEPT = Path("build") / "fuzz"


def main() -> int:
    """Runs all formats, or those that are named; gives the exit status."""
    parser = argparse.ArgumentParser(prog="fuzz", description="Damages files and loads them.")
    parser.add_argument("--count", type=int, default=2000, help="files of each format")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", default=list(FORMATS), choices=list(FORMATS))
    options = parser.parse_args()
    KEPT.mkdir(parents=True, exist_ok=True)
    warnings.simplefilter("error")
    wrong = 0
    for name in options.only:
        begin, form = time.process_time(), FORMATS[name]
        outcomes: Counter[str] = Counter()
        with tempfile.TemporaryDirectory() as folder:
            for number, outcome in run_trials(form, Path(folder), options.seed, options.count):
                if outcome not in OUTCOMES and not outcomes[outcome]:  # each once
                    kept = KEPT / f"{options.seed}_{number}_{Path(form.file).name}"
                    shutil.copy(Path(folder) / form.file, kept)
                    print(f"{name}, {kept}: {outcome}", flush=True)
                outcomes[outcome] += 1
        counts = [outcomes[key] for key in OUTCOMES]
        wrong += (others := outcomes.total() - sum(counts))
        row = name, *counts, others, f"{time.process_time() - begin:.0f} s"
        print("| " + " | ".join(map(str, row)) + " |", flush=True)
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
