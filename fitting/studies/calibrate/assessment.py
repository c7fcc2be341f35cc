"""What finished replicates say: is everything that a fit and a posterior claim true?

Each claim is checked against bounds that hold for all of them at once: a program whose claims are
true passes every check with a probability of 95 %.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fitting.inference.proportions import Proportion, RankTest, proportion

from .calibration import Calibration
from .replicates import DRAWS, LEVELS, LOG_PROBABILITY, SAME_VALLEY, ReplicateChain, ReplicateFit

FAMILY_LEVEL = 0.95  # of all checks together
FIT_LEVEL = 0.95  # of the fit's intervals
IN_VALLEY = 0.98  # of the fits, at least
NEAR = 0.05  # of its range: a parameter that is so near its truth has come back


@dataclasses.dataclass(frozen=True)
class Assessment:
    """All checks of a calibration, and what goes with them."""

    names: tuple[str, ...]
    """Of the parameters."""
    replicates: int
    level: float
    """Of each check, so that all hold with `FAMILY_LEVEL`."""
    fit_coverage: Proportion
    """How often the fit's intervals contain the truth."""
    fit_coverage_of: Mapping[str, Proportion]
    """The same, by parameter."""
    profile_coverage: Mapping[float, Proportion]
    """How often narrower intervals do, by level, that the profiles of smooth parameters give."""
    valley: Proportion
    """How often the fit ended in the truth's valley, or a deeper one."""
    recovery: Proportion
    """How often a parameter that was called determined came back."""
    recovery_of: Mapping[str, Proportion]
    wrong: tuple[int, ...]
    """Replicates that ended in another valley, from 1."""
    wrong_but_converged: tuple[int, ...]
    """Those of them that say that they converged."""
    unconverged: tuple[int, ...]
    ranks: Mapping[str, RankTest]
    """Of the parameters and the log-probability; none without chains."""
    chain_coverage: Mapping[float, Proportion]
    """How often the posterior's central intervals contain the truth, by level."""
    chain_coverage_of: Mapping[str, Mapping[float, Proportion]]
    """The same, by parameter; not checked, as their ranks are."""
    short_chains: tuple[int, ...]
    """Replicates whose chain did not converge, or has too few independent draws."""

    @property
    def outside(self) -> list[str]:
        """The checks that failed, in words."""
        checks = {"the fit's 95 % intervals": self.fit_coverage.inside}
        checks |= {
            f"the fit's 95 % intervals of {name}": cover.inside
            for name, cover in self.fit_coverage_of.items()
        }
        checks |= {
            f"the {_percent(level)} intervals of profiles": cover.inside
            for level, cover in self.profile_coverage.items()
        }
        checks["the share of fits in the right valley"] = self.valley.inside
        checks |= {
            f"the posterior's {_percent(level)} intervals": cover.inside
            for level, cover in self.chain_coverage.items()
        }
        checks |= {f"the ranks of {name}": test.inside for name, test in self.ranks.items()}
        return [words for words, inside in checks.items() if not inside]

    @property
    def inside(self) -> bool:
        """Whether all checks passed."""
        return not self.outside


def assess(calibration: Calibration) -> Assessment:
    """Judges all replicates of a calibration."""
    fits, chains = calibration.fits, calibration.chains
    names = tuple(row["name"] for row in fits[0]["parameters"])
    smooth = np.asarray([row["kind"] == "smooth" for row in fits[0]["parameters"]])
    inner = [nominal for nominal in LEVELS if nominal < FIT_LEVEL and smooth.any()]
    checks = len(names) + 2 + len(inner) + (len(names) + 1 + len(LEVELS) if chains else 0)
    level = 1 - (1 - FAMILY_LEVEL) / checks
    levels = np.asarray([fitted["truth_levels"] for fitted in fits])[:, smooth]
    truth = np.asarray([fitted["truth"] for fitted in fits])
    intervals = _of_parameters(fits, "interval")
    covered = (intervals[..., 0] <= truth) & (truth <= intervals[..., 1])
    gaps = np.asarray([fitted["cost"] - fitted["truth_valley_cost"] for fitted in fits])
    right = gaps <= SAME_VALLEY
    converged = np.asarray([fitted["converged"] for fitted in fits])
    determined = _of_parameters(fits, "determined")
    width = _of_parameters(fits, "high") - _of_parameters(fits, "low")
    near = np.abs(_of_parameters(fits, "value") - truth) <= NEAR * width
    wanted = (FIT_LEVEL, FIT_LEVEL)
    at_least = (FIT_LEVEL, 1.0)  # of a threshold, whose interval ends with a plateau of the cost
    together = (FIT_LEVEL, float(np.where(smooth, FIT_LEVEL, 1.0).mean()))
    chain_coverage, chain_coverage_of = _chain_coverage(chains, names, truth, level)
    return Assessment(
        names=names,
        replicates=len(fits),
        level=level,
        fit_coverage=proportion(covered, level=level, wanted=together),
        fit_coverage_of={
            name: proportion(covered[:, [i]], level=level, wanted=wanted if smooth[i] else at_least)
            for i, name in enumerate(names)
        },
        profile_coverage={
            nominal: proportion(levels <= nominal, level=level, wanted=(nominal, nominal))
            for nominal in inner
        },
        valley=proportion(right[:, None], level=level, wanted=(IN_VALLEY, 1.0)),
        recovery=proportion(near, determined, level=level),
        recovery_of={
            name: proportion(near[:, [i]], determined[:, [i]], level=level)
            for i, name in enumerate(names)
        },
        wrong=_numbers(~right),
        wrong_but_converged=_numbers(~right & converged),
        unconverged=_numbers(~converged),
        ranks={
            name: RankTest(np.asarray([chain["ranks"][name] for chain in chains]), DRAWS, level)
            for name in ([*names, LOG_PROBABILITY] if chains else [])
        },
        chain_coverage=chain_coverage,
        chain_coverage_of=chain_coverage_of,
        short_chains=_numbers(
            np.asarray([not chain["converged"] or chain["draws"] < DRAWS for chain in chains], bool)
        ),
    )


def summarise(assessment: Assessment) -> dict[str, Any]:
    """The numbers of an assessment as `calibration.json` holds them."""
    fields = {
        field.name: getattr(assessment, field.name)
        for field in dataclasses.fields(assessment)
        if field.name != "ranks"
    }
    ranks = {
        name: {
            "ranks": test.ranks.tolist(),
            "draws": test.draws,
            "inside": test.inside,
        }
        for name, test in assessment.ranks.items()
    }
    return {
        "inside": assessment.inside,
        "outside": assessment.outside,
        **{name: _plain(value) for name, value in fields.items()},
        "ranks": ranks,
    }


def _plain(value: Any) -> Any:
    if isinstance(value, Proportion):
        return {**dataclasses.asdict(value), "inside": value.inside}
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    return value


def _of_parameters(fits: Sequence[ReplicateFit], key: str) -> np.ndarray:
    """One number of each parameter in each replicate, (replicates, free, ...)."""
    return np.asarray([[row[key] for row in fitted["parameters"]] for fitted in fits])  # type: ignore[literal-required]


def _chain_coverage(
    chains: Sequence[ReplicateChain], names: Sequence[str], truth: np.ndarray, level: float
) -> tuple[dict[float, Proportion], dict[str, dict[float, Proportion]]]:
    """Of the posterior's central intervals: of all parameters together, and of each."""
    if not chains:
        return {}, {}
    intervals = np.asarray([[chain["intervals"][name] for name in names] for chain in chains])
    low, high = np.moveaxis(intervals, -1, 0)
    covered = (low <= truth[..., None]) & (truth[..., None] <= high)
    pooled = {
        nominal: proportion(covered[..., k], level=level, wanted=(nominal, nominal))
        for k, nominal in enumerate(LEVELS)
    }
    each = {
        name: {
            nominal: proportion(covered[:, [i], k], level=level, wanted=(nominal, nominal))
            for k, nominal in enumerate(LEVELS)
        }
        for i, name in enumerate(names)
    }
    return pooled, each


def _percent(level: float) -> str:
    return f"{100 * level:.0f} %"


def _numbers(where: np.ndarray) -> tuple[int, ...]:
    """Replicates, counted from 1."""
    return tuple(int(i) + 1 for i in np.flatnonzero(where))
