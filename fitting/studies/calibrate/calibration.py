"""Calibration: fits of simulated motion whose truth is known, and whether what they say is true.

Each claim of fits and posteriors is checked against bounds that hold for all of them at once: a
program whose claims are true passes every check with a probability of 95 %.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy import special

import jaxik
from fitting.experiment.experiment import Experiment
from fitting.experiment.in_memory import with_files
from fitting.experiment.problems import make_problem
from fitting.inference.proportions import Proportion, RankTest, proportion
from fitting.problem.problem import Problem
from fitting.report import pages
from fitting.report.document import Document, Finding, Grid, Plot, Points, Section, Text
from fitting.report.formatting import Table, counted, listed, percent
from fitting.report.style import AFTER, BEFORE, CAPTURED, area_key, legend, line_key, panels, styled
from fitting.runtime import activity, cluster
from fitting.runtime.json_files import JsonFile
from fitting.runtime.precision import in_float64
from fitting.studies.output import as_experiment, output_folder, publish

from .replicates import (
    ADVICE,
    DRAWS,
    LEVELS,
    LOG_PROBABILITY,
    SAME_MINIMUM,
    WRITER,
    Judgement,
    Kind,
    ReplicateChain,
    ReplicateFit,
    chain_line,
    claim,
    fit_line,
    fit_replicate,
    make_replicates,
    numbers,
    sample_replicate,
)

if TYPE_CHECKING:
    from distributed import Client

FITS = Kind("fits", "fits", JsonFile(ReplicateFit, WRITER, ADVICE), fit_line)
CHAINS = Kind("chains", "chains", JsonFile(ReplicateChain, WRITER, ADVICE), chain_line)

FAMILY_LEVEL = 0.95  # of all checks together
FIT_LEVEL = 0.95  # of the fit's intervals
IN_MINIMUM = 0.98  # of the fits, at least
NEAR = 0.05  # of its range: a parameter that is so near its truth has come back

NUMBERS, SUMMARY = "calibration.json", "summary.md"
RANKS, RECOVERY = "ranks.png", "recovery.png"
LISTED = 20  # replicates, at most, where some are named
CAME_BACK = (
    f"A parameter came back if its fitted value is within {percent(NEAR, 0)} of its range from the "
    "truth; counted where the fit called it determined, which promises less, so that this is not "
    "checked."
)
RANKED = (
    f"The number of {DRAWS} independent draws of the posterior that are below the truth. All ranks "
    "are equally likely where the posterior is right. A hump means a posterior that is too wide, a "
    "trough one that is too narrow, a slope one that is shifted."
)

PAIRS_PER_ROW, PANELS_PER_ROW = 2, 4
BINS = {100: 20, 0: 10}  # of a histogram, by the least number of replicates
BAND = "#dddddd"

WIDE = 0.2  # of bounds, from which being inside them proves little


@dataclasses.dataclass(frozen=True)
class Calibration:
    """Finished replicates, in the order of their numbers."""

    fits: list[ReplicateFit]
    chains: list[ReplicateChain]
    """Empty, or one for each fit."""


@dataclasses.dataclass(frozen=True)
class Assessment(Judgement):
    """All checks of a calibration, with their numbers."""

    names: tuple[str, ...]
    """Of the parameters."""
    level: float
    """Of each check, so that all hold with `FAMILY_LEVEL`."""
    fit_coverage: Proportion
    """How often the fit's intervals contain the truth."""
    fit_coverage_of: Mapping[str, Proportion]
    """The same, by parameter."""
    profile_coverage: Mapping[float, Proportion]
    """How often narrower intervals of smooth parameters, from their profiles, do, by level."""
    minimum: Proportion
    """How often the fit ended in the truth's minimum, or a lower one."""
    recovery: Proportion
    """How often a parameter that was called determined came back."""
    recovery_of: Mapping[str, Proportion]
    wrong: tuple[int, ...]
    """Replicates that ended in another minimum, from 1."""
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
    def checks(self) -> Mapping[str, Proportion | RankTest]:
        """All claims that are checked."""
        fits, posterior = "the fit's 95 % intervals", "the posterior's"
        return {
            fits: self.fit_coverage,
            **{f"{fits} of {name}": cover for name, cover in self.fit_coverage_of.items()},
            **{
                f"the {percent(level, 0)} intervals of profiles": cover
                for level, cover in self.profile_coverage.items()
            },
            "the share of fits in the right minimum": self.minimum,
            **{
                f"{posterior} {percent(level, 0)} intervals": cover
                for level, cover in self.chain_coverage.items()
            },
            **{f"the ranks of {name}": test for name, test in self.ranks.items()},
        }


@in_float64
def calibrate(
    experiment: Experiment | str | Path,
    output: str | Path | None = None,
    *,
    replicates: int = 200,
    chains: bool = False,
    noise_factor: float = 1.0,
    workers: int = 0,
    scheduler: str | None = None,
) -> Assessment:
    """Fits an experiment to motion simulated from random truths, and judges what the fits say.

    Truths are drawn from the experiment's prior; each is simulated with the experiment's noise and
    fitted as `fit` does. Each finished fit or chain is written at once, and a call with the same
    folder continues where an interrupted one ended, also with more replicates or with chains.

    Args:
        experiment: an experiment, or the path of its file.
        output: folder for the replicates and the report.
        replicates: number of truths.
        chains: whether to sample each posterior as `sample` does; a chain takes much longer than a
            fit.
        noise_factor: how much larger the simulated noise is than the experiment says: whether fits
            notice, or estimate it.
        workers: processes on this machine that compute; 0 computes in this process.
        scheduler: address of the scheduler of a Dask cluster that computes instead.

    Raises:
        ValueError: the experiment is wrong or does not fit its clips; it is one whose noise cannot
            be simulated; the folder holds another calibration; there is not one replicate; there
            is no such cluster.
    """
    experiment = as_experiment(experiment)
    with output_folder(output) as folder:
        experiment = dataclasses.replace(with_files(experiment, folder), holdout=0.0)
        problem = make_problem(experiment)
        activity.log(
            f"{replicates} truths of {problem.space.size} parameters of {experiment.preset}"
        )
        with cluster.connect(workers, scheduler) as client:
            calibration = make_fits_and_chains(
                experiment, problem, folder, replicates,
                chains=chains, noise_factor=noise_factor, client=client,
            )  # fmt: skip
        assessment = assess(calibration)
        publish(folder, document(experiment, calibration, assessment))
        return assessment


def make_fits_and_chains(
    experiment: Experiment,
    problem: Problem[jaxik.FootIK],
    folder: Path | None,
    replicates: int,
    *,
    chains: bool = False,
    noise_factor: float = 1.0,
    client: "Client | None" = None,
) -> Calibration:
    """The replicates of a calibration: first all fits, then all chains.

    Raises:
        ValueError: as `claim`, or a replicate cannot be made.
    """
    claim(folder, replicates, experiment, problem, noise_factor)
    names = problem.space.names
    fit = functools.partial(fit_replicate, problem, experiment, noise_factor=noise_factor)
    fits = make_replicates(FITS, folder, names, fit, range(replicates), client)
    sample = functools.partial(sample_replicate, problem, experiment, noise_factor=noise_factor)
    sampled = make_replicates(CHAINS, folder, names, sample, fits, client) if chains else []
    return Calibration(fits, sampled)


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
    right = gaps <= SAME_MINIMUM
    converged = np.asarray([fitted["converged"] for fitted in fits])
    determined = _of_parameters(fits, "determined")
    width = _of_parameters(fits, "high") - _of_parameters(fits, "low")
    near = np.abs(_of_parameters(fits, "value") - truth) <= NEAR * width
    # A threshold's interval ends with a plateau of the cost: it may cover more than it promises.
    most = np.where(smooth, FIT_LEVEL, 1.0)
    share = functools.partial(proportion, level=level)
    chain_coverage, chain_coverage_of = _chain_coverage(chains, names, truth, level)
    return Assessment(
        names=names,
        replicates=len(fits),
        level=level,
        fit_coverage=share(covered, wanted=(FIT_LEVEL, float(most.mean()))),
        fit_coverage_of={
            name: share(covered[:, [i]], wanted=(FIT_LEVEL, float(most[i])))
            for i, name in enumerate(names)
        },
        profile_coverage={
            nominal: share(levels <= nominal, wanted=(nominal, nominal)) for nominal in inner
        },
        minimum=share(right[:, None], wanted=(IN_MINIMUM, 1.0)),
        recovery=share(near, determined),
        recovery_of={name: share(near[:, [i]], determined[:, [i]]) for i, name in enumerate(names)},
        wrong=numbers(~right),
        wrong_but_converged=numbers(~right & converged),
        unconverged=numbers(~converged),
        ranks={
            name: RankTest(np.asarray([chain["ranks"][name] for chain in chains]), DRAWS, level)
            for name in ([*names, LOG_PROBABILITY] if chains else [])
        },
        chain_coverage=chain_coverage,
        chain_coverage_of=chain_coverage_of,
        short_chains=numbers(
            [not chain["converged"] or chain["draws"] < DRAWS for chain in chains]
        ),
    )


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

    def shares(hits: np.ndarray) -> dict[float, Proportion]:
        return {
            nominal: proportion(hits[..., k], level=level, wanted=(nominal, nominal))
            for k, nominal in enumerate(LEVELS)
        }

    return shares(covered), {name: shares(covered[:, [i]]) for i, name in enumerate(names)}


def explanation(assessment: Assessment) -> str:
    """The method, and what the bounds are."""
    return (
        "Truths were drawn from the prior, motion was simulated from them with the noise that the "
        "experiment assumes, and each was fitted as `jaxik fit` does. Bounds are those of the "
        f"probability behind a share, at {percent(assessment.level, 2)} each, so that with "
        f"{percent(FAMILY_LEVEL, 0)} a program whose claims are true is inside all of them."
    )


def document(experiment: Experiment, calibration: Calibration, assessment: Assessment) -> Document:
    """What a calibration says."""
    name = experiment.name
    fitted_title, ranks_title = (
        f"{name}: fitted against true values",
        f"{name}: ranks of the truths among {DRAWS} draws",
    )
    sections = [
        Section(
            "Checks",
            [
                Text(explanation(assessment)),
                Grid(checks_table(assessment), "All checks"),
                Points(remarks(assessment), brief=True),
            ],
        ),
        Section(
            "Parameters",
            [
                Grid(parameter_table(assessment), "What was found for each parameter"),
                Text(CAME_BACK),
                Plot(RECOVERY, fitted_title, lambda: recovery(calibration.fits, fitted_title)),
            ],
        ),
    ]
    if assessment.ranks:
        plot = Plot(RANKS, ranks_title, lambda: ranks(assessment.ranks, ranks_title))
        sections.append(Section("Ranks", [Text(RANKED), plot]))
    return Document(
        file=SUMMARY,
        kind="Fits of simulated motion whose truth is known",
        title=name,
        verdict="Calibrated" if assessment.inside else "Not calibrated",
        good=assessment.inside,
        findings=findings(assessment),
        sections=[*sections, _limits(assessment)],
        setup=[*pages.rows(experiment), ["Simulated motions", f"{assessment.replicates}"]],
        numbers={NUMBERS: {"experiment": name, **assessment.summary}},
    )


def remarks(assessment: Assessment) -> list[str]:
    """Replicates that need attention, a sentence for each kind that occurs."""
    sentences = {
        f"A fit is in the right minimum if its cost is at most {SAME_MINIMUM:g} above where a "
        f"descent from the truth ends; {percent(IN_MINIMUM, 0)} should be. Replicates in another "
        "minimum": (assessment.wrong),
        "In another minimum, but said to have converged": assessment.wrong_but_converged,
        "Fits that did not converge": assessment.unconverged,
        f"Chains that did not converge, or have fewer than {DRAWS} independent draws": (
            assessment.short_chains
        ),
    }
    return listed_replicates(sentences)


def listed_replicates(sentences: Mapping[str, tuple[int, ...]]) -> list[str]:
    """A sentence for each kind of replicates of which there are any, with their numbers."""
    return [f"{words}: {_some_of(numbers)}." for words, numbers in sentences.items() if numbers]


def _some_of(replicates: tuple[int, ...]) -> str:
    first = ", ".join(map(str, replicates[:LISTED]))
    return f"{first}{' and others' if len(replicates) > LISTED else ''} ({len(replicates)} in all)"


def checks_table(assessment: Assessment) -> Table:
    """A row for each claim about all parameters together."""
    sentences = {
        "the fit's {} intervals contain the truth": {FIT_LEVEL: assessment.fit_coverage},
        "{} intervals by the profiles of smooth parameters contain it": assessment.profile_coverage,
        "the posterior's {} intervals contain the truth": assessment.chain_coverage,
    }
    rows = [
        share_row(sentence.format(percent(level, 0)), cover, percent(level, 0))
        for sentence, covers in sentences.items()
        for level, cover in covers.items()
    ]
    minimum = f"{percent(IN_MINIMUM, 0)} or more"
    rows.append(share_row("fits in the right minimum", assessment.minimum, minimum))
    rows.append([*share_row("determined parameters came back", assessment.recovery, "")[:-1], ""])
    return [["", "found", "share", "bounds", "wanted", "inside"], *rows]


def parameter_table(assessment: Assessment) -> Table:
    """A row for each parameter, and for the log-probability where there are chains."""
    heading = ["parameter", "came back", "the fit's 95 % intervals", "inside"]
    levels = list(assessment.chain_coverage)
    heading += [f"posterior's {percent(level, 0)}" for level in levels]
    heading += ["ranks inside"] if assessment.ranks else []
    table = [heading]
    for name in assessment.names:
        cover = assessment.fit_coverage_of[name]
        recovery = assessment.recovery_of[name]
        back = f"{recovery.hits} of {recovery.total}"
        row = [name, back, f"{percent(cover.fraction, 0)} ({bounds_text(cover)})", _verdict(cover)]
        row += [percent(assessment.chain_coverage_of[name][level].fraction, 0) for level in levels]
        table.append(row)
    if assessment.ranks:
        table.append([LOG_PROBABILITY, *([""] * (len(heading) - 2))])
        for row in table[1:]:
            row.append("yes" if assessment.ranks[row[0]].inside else "**no**")
    return table


def share_row(words: str, share: Proportion, wanted: str) -> list[str]:
    """Cells of a claim: count, share and bounds, the wanted share, and whether it is inside."""
    hits = f"{share.hits} of {share.total}"
    fraction = percent(share.fraction) if share.total else "–"
    return [words, hits, fraction, bounds_text(share), wanted, _verdict(share)]


def bounds_text(share: Proportion) -> str:
    """Between which shares the probability behind a share lies."""
    return f"{percent(share.low, 0)} to {percent(share.high, 0)}"


def _verdict(share: Proportion) -> str:
    """Whether a share may be what it should be, and how it differs if not."""
    if share.inside:
        return "yes"
    return "**no**, too few" if share.high < share.wanted_low else "**no**, too many"


@styled
def ranks(tests: Mapping[str, RankTest], title: str) -> Figure:
    """Of each quantity: the histogram of its ranks, and its ECDF less that of uniform ranks."""
    figure, axes = panels(2 * len(tests), 2 * PAIRS_PER_ROW, title, 2.6, 1.8)
    pairs = list(zip(axes[::2], axes[1::2], strict=True))
    for (histogram, difference), (name, test) in zip(pairs, tests.items(), strict=True):
        _histogram(histogram, test)
        _difference(difference, test)
        histogram.set_title(name)
        if not test.inside:
            difference.set_title("outside its band", color=CAPTURED)
    for histogram, difference in pairs[-PAIRS_PER_ROW:]:
        histogram.set_xlabel("rank")
        difference.set_xlabel("rank, as a fraction")
    (test, *_) = tests.values()
    legend(
        figure,
        area_key("left: replicates by the rank of their truth", AFTER),
        line_key("right: ECDF of the ranks less the uniform one", AFTER),
        area_key(f"95 % of each bar; {100 * test.level:.2f} % of whole curves", BAND),
    )
    return figure


@styled
def recovery(fits: Sequence[ReplicateFit], title: str) -> Figure:
    """Of each parameter: fitted against true values, with intervals that miss the truth marked."""
    rows = fits[0]["parameters"]
    figure, grid = panels(len(rows), PANELS_PER_ROW, title, 4.0, 1.4)
    for i, axes in enumerate(grid):
        _recovered(axes, fits, i)
    legend(
        figure,
        line_key("fitted, 95 % interval", AFTER, marker="o"),
        line_key("the interval misses the truth", CAPTURED, marker="o"),
        line_key("undetermined", BEFORE, marker="o", linestyle="", mfc="none"),
        line_key("fitted = true", linewidth=0.8),
    )
    return figure


def _histogram(axes: Axes, test: RankTest) -> None:
    bins = next(count for least, count in BINS.items() if len(test.ranks) >= least)
    edges = np.linspace(0, test.draws + 1, bins + 1)
    counts = np.arange(len(test.ranks) + 1)
    below = special.bdtr(counts, len(test.ranks), 1 / bins)
    low, high = np.searchsorted(below, [0.025, 0.975])
    axes.axhspan(low, high, color=BAND)
    axes.stairs(test.histogram(bins), edges, color=AFTER, fill=True, alpha=0.7)
    axes.axhline(len(test.ranks) / bins, color="black", linewidth=0.8)
    axes.set_xlim(0, test.draws + 1)
    axes.grid(False)


def _difference(axes: Axes, test: RankTest) -> None:
    low, high = test.band - test.places
    axes.fill_between(test.places, low, high, step="post", color=BAND, linewidth=0)
    axes.step(test.places, test.ecdf - test.places, where="post", color=AFTER)
    axes.axhline(0.0, color="black", linewidth=0.8)
    axes.set_xlim(0, 1)


def _recovered(axes: Axes, fits: Sequence[ReplicateFit], i: int) -> None:
    """One parameter in all replicates."""
    first = fits[0]["parameters"][i]
    for fitted in fits:
        row, truth = fitted["parameters"][i], fitted["truth"][i]
        low, high = row["interval"]
        colour = AFTER if low <= truth <= high else CAPTURED
        axes.plot([truth, truth], [low, high], color=colour, linewidth=0.9, alpha=0.6)
        face = colour if row["determined"] else "none"
        axes.plot(truth, row["value"], "o", color=colour, markersize=4, markerfacecolor=face)
    ends = [first["low"], first["high"]]
    axes.plot(ends, ends, color="black", linewidth=0.8)
    unit = "" if first["unit"] == "1" else f", {first['unit']}"
    axes.set_title(f"{first['name']}{unit}")
    axes.locator_params(nbins=5)


def findings(assessment: Assessment) -> list[Finding]:
    """Whether intervals are true, whether fits find the right minimum, and what comes back."""
    return [_intervals(assessment), _minima(assessment), _recovery(assessment)]


def _intervals(assessment: Assessment) -> Finding:
    cover = assessment.fit_coverage
    motions = counted(assessment.replicates, "simulated motion")
    share = f"{percent(cover.fraction, 0)} of the true values ({bounds_text(cover)})"
    coverage = f"the fit's 95 % intervals contain {share}"
    if not assessment.inside:
        return Finding(
            f"Of {motions}, outside their bounds: {listed(assessment.outside)}; {coverage}.",
            bad=True,
        )
    if cover.high - cover.low > WIDE:
        return Finding(
            f"Everything is inside its bounds, but {motions} prove little, as these bounds are "
            f"wide: {coverage}.",
            bad=True,
        )
    return Finding(f"On {motions} everything is inside its bounds: {coverage}.")


def _minima(assessment: Assessment) -> Finding:
    minimum = assessment.minimum
    text = f"{minimum.hits} of {minimum.total} fits end where a descent from the truth does"
    wrong, unconverged = len(assessment.wrong_but_converged), len(assessment.unconverged)
    short = len(assessment.short_chains)
    faults = [
        f"{wrong} of the others say that they converged" if wrong else "",
        f"{unconverged} did not converge" if unconverged else "",
        f"{short} of the chains did not converge, or are too short" if short else "",
    ]
    details = "; ".join(filter(None, [text, *faults]))
    return Finding(f"{details}.", bad=any(faults))


def _recovery(assessment: Assessment) -> Finding:
    back = assessment.recovery
    if not back.total:
        return Finding("No fit called a parameter determined.", bad=True)
    text = (
        f"Of the parameters that fits called determined, {percent(back.fraction, 0)} came back "
        f"within {percent(NEAR, 0)} of their range"
    )
    each = {name: of for name, of in assessment.recovery_of.items() if of.total}
    least = min(each, key=lambda name: each[name].fraction)
    if each[least].fraction < back.fraction:
        text += f", fewest of `{least}` ({each[least].hits} of {each[least].total})"
    never = [f"`{name}`" for name in assessment.names if not assessment.recovery_of[name].total]
    if never:
        text += f"; {listed(never)} {'was' if len(never) == 1 else 'were'} never determined"
    return Finding(f"{text}.")


def _limits(assessment: Assessment) -> Section:
    lines = [
        "Motion is simulated by the system itself with the noise that the experiment assumes: that "
        "intervals are true here does not say that the system can move as people do.",
    ]
    if not assessment.ranks:
        lines.append("No posterior was sampled (`--chains`), so only fits are judged.")
    return Section("Limits of the data", [Points(lines)])
