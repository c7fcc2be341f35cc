"""Mutants tested one after the other, first by the likeliest tests and then by all others."""

import itertools
import math
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from .explained import reason_for
from .ledger import Ledger
from .mutants import Mutant, diff
from .ranking import Group, first_part, groups_of, importers, ranked
from .report import CAUGHT, EXPLAINED, SURVIVED, Key, Result, keep_result, load_results
from .trial import OUTPUT, run_groups, run_test
from .workplace import Workplace

# Of the results so far, the seconds that the round will still take, and the last result.
Progress = Callable[[list[Result], float, Result], None]


class Run:
    """Tests mutants, keeping what becomes of each as soon as that is known."""

    def __init__(
        self, workplace: Workplace, folder: Path, name: str, slow_too: bool = True
    ) -> None:
        """A run that goes on where an earlier one with this name stopped.

        Args:
            workplace: where mutants are tested.
            folder: of what is kept: results, and which tests are known to pass.
            name: of the file of results.
            slow_too: whether tests marked as slow are asked, too.
        """
        self.workplace, self.kept, self.slow_too = workplace, folder / f"{name}.jsonl", slow_too
        self.ledger = Ledger(folder / "tests.json", workplace.checkout)
        self.results = {result.key: result for result in load_results(self.kept)}

    def forget_survivors(self) -> None:
        """Has mutants tested again that survived or were explained."""
        self.results = {key: x for key, x in self.results.items() if x.outcome == CAUGHT}

    def round(self, mutants: list[Mutant], budget: float, progress: Progress) -> None:
        """Tests those mutants of which it is not known what becomes of them.

        Args:
            mutants: each is only tested once.
            budget: CPU seconds of tests for each; those that survive wait for an unlimited round.
            progress: called after each mutant.
        """
        places = {self._key(mutant): mutant for mutant in mutants}
        waiting = [mutant for key, mutant in places.items() if not self._is_known(key, budget)]
        begin = time.monotonic()
        for number, mutant in enumerate(waiting, 1):
            result = self._test(mutant, budget)
            pace = (time.monotonic() - begin) / number
            progress(self.results_of(mutants), pace * (len(waiting) - number), result)

    def results_of(self, mutants: list[Mutant]) -> list[Result]:
        """What is known of these mutants."""
        keys = dict.fromkeys(self._key(mutant) for mutant in mutants)
        return [self.results[key] for key in keys if key in self.results]

    def _test(self, mutant: Mutant, budget: float) -> Result:
        key, earlier = self._key(mutant), self.results.get(self._key(mutant))
        if reason := reason_for(mutant.path, *key[2:]):
            return self._keep(Result(*key, EXPLAINED, reason))
        seconds, checkout = self.ledger.seconds(), self.workplace.checkout
        groups = ranked(
            mutant.path,
            [x for x in groups_of(checkout, mutant.path) if self.slow_too or not x.slow],
            seconds,
            self._catches(key),
            importers(checkout, mutant.path),
        )
        near, far = first_part(groups, seconds, budget)
        begin = time.monotonic()
        with self.workplace.mutated(mutant):
            outcome = run_groups(checkout, groups if earlier else near, budget)
        last = outcome.last.partition("::")[0]
        before = itertools.takewhile(lambda group: group.file != last, groups)
        self.ledger.add(outcome.passed, before if last else ())
        spent = round(time.monotonic() - begin + (earlier.seconds if earlier else 0.0), 1)
        if outcome.none_failed:
            complete = bool(earlier) or not far
            return self._keep(Result(*key, SURVIVED, seconds=spent, complete=complete))
        self._confirm(outcome.last, groups if earlier else near)
        caught = outcome.last, outcome.slow, outcome.status, spent
        return self._keep(Result(*key, CAUGHT, *caught))

    def _confirm(self, test: str, groups: list[Group]) -> None:
        """Ends the run if a test fails without any change too, or some cannot be imported."""
        checkout = self.workplace.checkout
        if test in self.ledger:
            return
        outcome = run_test(checkout, test) if test else run_groups(checkout, groups, budget=0.0)
        self.ledger.add(outcome.passed)
        if not outcome.none_failed:
            print((checkout.parent / OUTPUT).read_text())
            raise SystemExit(f"Without any change of the source, {test or groups} fails.")

    def _catches(self, key: Key) -> Counter[Group]:
        """How many mutants of a module each group of tests has caught."""
        own = [x for x in self.results.values() if x.outcome == CAUGHT and x.path == key[0]]
        return Counter(Group(x.by.partition("::")[0], x.slow) for x in own)

    def _is_known(self, key: Key, budget: float) -> bool:
        return key in self.results and (self.results[key].complete or math.isfinite(budget))

    def _key(self, mutant: Mutant) -> Key:
        return mutant.path, mutant.line, *diff(mutant, self.workplace.root)

    def _keep(self, result: Result) -> Result:
        self.results[result.key] = result
        keep_result(self.kept, result)
        return result
