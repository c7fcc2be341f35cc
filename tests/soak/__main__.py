"""The soak test: `PYTHONPATH=tests python -m soak --frames 1000000`.

Prints, for each system, what characters have shown that lived through so many frames with random
faults. The exit status is 1 if a number was not finite, a bone changed its length, or memory grew.
"""

import argparse
import itertools
import sys
import time
from pathlib import Path

import jax

import jaxik
from fitting.runtime import xla
from jaxik.maths import parameter_tree
from soak.live import PRESETS, Findings, grounds, living, newborn, summarised

CHARACTERS, STEPS = 64, 50
BONE_ERROR = 2e-6  # of rounding, in 32 bits
GROWTH = 64.0  # MiB


def resident_mib() -> float:
    """Memory of this process, MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20


def soak(preset: str, frames: int, seed: int) -> tuple[list[Findings], float]:
    """The findings of a system on each ground in turn, and the growth of memory, MiB."""
    ik = getattr(jaxik.presets, preset)()
    if getattr(ik.leg, "allow_stretch", False):  # `mec` makes legs longer that are too short
        ik = parameter_tree.with_option(ik, "leg.allow_stretch", False)
    stretch, life = living(ik, STEPS), newborn(ik, CHARACTERS, seed)
    findings, before = [], 0.0
    for number, ground in enumerate(itertools.cycle(grounds())):
        if number * CHARACTERS * STEPS >= frames:
            break
        if number == 2 * len(grounds()):  # everything has been compiled and run
            before = resident_mib()
        life, shown = stretch(life, ground)
        findings.append(summarised(shown))
    return findings, resident_mib() - before if before else 0.0


def main() -> int:
    """Runs all systems, or those that are named; gives the exit status."""
    parser = argparse.ArgumentParser(prog="soak", description="Lives through random faults.")
    parser.add_argument("--frames", type=int, default=1_000_000, help="of all systems together")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", default=list(PRESETS), choices=PRESETS)
    options = parser.parse_args()
    xla.configure_xla()
    failed = False
    for preset in options.only:
        begin = time.process_time()
        findings, growth = soak(preset, options.frames // len(options.only), options.seed)
        jax.clear_caches()
        *counts, errors = zip(*findings, strict=True)
        frames, faulty, not_finite = map(sum, counts)
        failed |= bool(not_finite) or max(errors) > BONE_ERROR or growth > GROWTH
        seconds = time.process_time() - begin
        row = f"{preset} | {frames} | {faulty} | {not_finite} | {max(errors):.1g}"
        print(f"| {row} | {growth:.1f} MiB | {seconds:.0f} s |", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
