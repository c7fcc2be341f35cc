"""Mutants tested one after the other, first by the likeliest tests and then by all others."""

import math
import time
from collections.abc import Callable
from pathlib import Path

from .explained import reason_for
from .mutants import Mutant, diff
from .report import CAUGHT, EXPLAINED, SURVIVED, Key, Result, keep_result, load_results
from .survey import Survey
from .trial import OUTPUT, Workplace, run_tests

# Of the results so far, the seconds that the round will still take, and the last result.
Progress = Callable[[list[Result], float, Result], None]


class Run:
    """Tests mutants, keeping what becomes of each as soon as that is known."""

    def __init__(self, workplace: Workplace, survey: Survey, kept: Path) -> None:
        """A run that goes on where an earlier one with the same file of results stopped."""
        self.workplace, self.survey, self.kept = workplace, survey, kept
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
        checkout = self.workplace.checkout
        asked = self.survey.asked(self.workplace.root, mutant.path, mutant.line)
        part = asked if earlier else self.survey.first_part(asked, budget)
        if not part:  # no test executes the module
            return self._keep(Result(*key, SURVIVED))
        begin = time.monotonic()
        with self.workplace.mutated(mutant):
            outcome = run_tests(checkout, part, budget)
        spent = round(time.monotonic() - begin + (earlier.seconds if earlier else 0.0), 1)
        if outcome.none_failed:
            complete = bool(earlier) or (part == asked and not outcome.stopped)
            return self._keep(Result(*key, SURVIVED, seconds=spent, complete=complete))
        self._confirm(outcome.last, part)
        return self._keep(Result(*key, CAUGHT, outcome.last, outcome.status, spent))

    def _confirm(self, test: str, asked: list[str]) -> None:
        """Ends the run if a test fails without any change too, or some cannot be imported."""
        if self.survey.passes(test):
            return
        checkout = self.workplace.checkout
        outcome = run_tests(checkout, [test] if test else asked, math.inf if test else 0.0)
        if not outcome.none_failed:
            print((checkout.parent / OUTPUT).read_text())
            raise SystemExit(f"Without any change of the source, {test or asked} fails.")

    def _is_known(self, key: Key, budget: float) -> bool:
        return key in self.results and (self.results[key].complete or math.isfinite(budget))

    def _key(self, mutant: Mutant) -> Key:
        return mutant.path, mutant.line, *diff(mutant, self.workplace.root)

    def _keep(self, result: Result) -> Result:
        self.results[result.key] = result
        keep_result(self.kept, result)
        return result
