"""What a run found: a result per mutant, kept as it comes, and the tables made of all results."""

import json
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypeAlias

from scipy import stats

CAUGHT, SURVIVED, EXPLAINED = "caught", "survived", "explained"
OUTCOMES = (CAUGHT, SURVIVED, EXPLAINED)
CONFIDENCE = 0.95

Key: TypeAlias = tuple[str, int, str, str]  # the module, the line, and it before and after


@dataclass(frozen=True)
class Result:
    """A mutant and what became of it."""

    path: str
    line: int
    before: str
    after: str
    outcome: str
    by: str = ""  # the test that caught it, or the reason that explains it
    status: int = 0  # of pytest, or minus the signal that ended it
    seconds: float = 0.0  # that it took
    complete: bool = True  # whether all tests have been asked about it

    @property
    def key(self) -> Key:
        """What tells it from other mutants."""
        return self.path, self.line, self.before, self.after

    def __str__(self) -> str:
        return f"{self.path}:{self.line}\n  - {self.before}\n  + {self.after}"


def load_results(path: Path) -> list[Result]:
    """The results of earlier runs; a line that was cut off is left out."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return [Result(**json.loads(line)) for line in lines if line.endswith("}")]


def keep_result(path: Path, result: Result) -> None:
    """Adds a result to those of earlier runs."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(asdict(result)) + "\n")


def score(results: list[Result]) -> tuple[float, float, float]:
    """The caught part of all that are not explained, and its 95 % interval after Wilson."""
    outcomes = Counter(result.outcome for result in results)
    tested = outcomes[CAUGHT] + outcomes[SURVIVED]
    if not tested:
        return 1.0, 0.0, 1.0
    test = stats.binomtest(outcomes[CAUGHT], tested)
    interval = test.proportion_ci(CONFIDENCE, method="wilson")
    return outcomes[CAUGHT] / tested, float(interval.low), float(interval.high)


def table(results: list[Result]) -> str:
    """By module and for all: how many mutants, and what became of them."""
    counts = Counter((result.path, result.outcome) for result in results)
    rows = {
        path: [counts[path, outcome] for outcome in OUTCOMES]
        for path in sorted({result.path for result in results})
    }
    rows["all"] = [sum(column) for column in zip(*rows.values(), strict=True)]
    lines = [" | ".join(map(str, (path, sum(row), *row))) for path, row in rows.items()]
    head = [" | ".join(("module", "mutants", *OUTCOMES)), "|".join(["---"] * (2 + len(OUTCOMES)))]
    return "\n".join(f"| {line} |" for line in (*head, *lines))


def summary(results: list[Result]) -> str:
    """The table, the score, and all survivors."""
    survivors = [str(result) for result in results if result.outcome == SURVIVED]
    hasty = sum(not result.complete for result in results)
    part, low, high = score(results)
    sentence = f"Caught: {part:.1%}, with 95 % confidence {low:.1%} to {high:.1%}."
    minutes = sum(result.seconds for result in results) / 60
    sentence += f" It took {minutes:.0f} minutes."
    if hasty:
        sentence += f" {hasty} of the survivors have survived the likeliest tests only."
    return "\n".join([table(results), "", sentence, *survivors])
