"""Random staircases: `PYTHONPATH=tests python -m stairs --count 500`.

Walks over random flights of stairs by `stride`, and prints what is wrong with them. The exit status
is 1 if anything is.
"""

import argparse
import dataclasses
import sys
import time
from collections.abc import Sequence

import numpy as np

import jaxik
from fitting.runtime import xla
from stairs.flights import Flight, sample
from stairs.walks import Verdict, walked

BOUNDS = Verdict(off=0.02, pop=0.03, dip=0.01, bend=0.06, sunk=np.inf)
"""Metres."""


def summary(verdicts: Sequence[tuple[Flight, Verdict]]) -> list[str]:
    """How many walks are beyond each bound, by kind of riser, and the worst."""
    lines = ["walks | flights | " + " | ".join(Verdict._fields) + " | worst, cm"]
    kinds = sorted({(flight.riser, flight.field, flight.down) for flight, _ in verdicts})
    for riser, field, down in kinds:
        part = np.array(
            [v for f, v in verdicts if (f.riser, f.field, f.down) == (riser, field, down)]
        )
        name = f"{riser} {'field' if field else 'mesh'} {'down' if down else 'up'}"
        lines.append(row(name, part))
    lines.append(row("all", np.array([verdict for _, verdict in verdicts])))
    return lines


def row(name: str, part: np.ndarray) -> str:
    beyond = (part > np.array(BOUNDS)).sum(0)
    worst = " ".join(f"{100 * x:.1f}" for x in part.max(0))
    return f"{name} | {len(part)} | " + " | ".join(map(str, beyond)) + f" | {worst}"


def main() -> int:
    """Walks over all flights; gives the exit status."""
    parser = argparse.ArgumentParser(prog="stairs", description="Walks over random stairs.")
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--unknown", action="store_true", help="without known footholds")
    parser.add_argument("--worst", type=int, default=0, help="flights to list")
    options = parser.parse_args()
    xla.configure_xla()
    rng = np.random.default_rng(options.seed)
    chosen = [sample(rng, field=number % 2 == 1) for number in range(options.count)]
    begin = time.process_time()
    ik = jaxik.presets.stride(foretold=not options.unknown)
    verdicts = walked(ik, chosen, known=not options.unknown)
    print("\n".join(summary(verdicts)), flush=True)
    excess = [max(np.array(verdict) / np.array(BOUNDS)) for _, verdict in verdicts]
    for index in np.argsort(excess)[::-1][: options.worst]:
        flight, verdict = verdicts[index]
        print({k: v for k, v in dataclasses.asdict(flight).items()})
        print("   ", " ".join(f"{n} {100 * x:.1f}" for n, x in verdict._asdict().items()))
    print(f"{time.process_time() - begin:.0f} s")
    return int(any(np.any(np.array(verdict) > BOUNDS) for _, verdict in verdicts))


if __name__ == "__main__":
    sys.exit(main())
