"""The report of a calibration: what is true of the fits' and the posteriors' claims."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from scipy import special

from fitting.experiment.experiment import Experiment
from fitting.inference.proportions import Proportion, RankTest
from fitting.report import pages
from fitting.report.document import Document, Finding, Grid, Plot, Points, Section, Text
from fitting.report.formatting import Table, percent
from fitting.report.style import AFTER, BEFORE, CAPTURED, legend, styled
from fitting.studies.fit.sentences import listed

from .assessment import FAMILY_LEVEL, FIT_LEVEL, IN_VALLEY, NEAR, Assessment, summarise
from .calibration import Calibration
from .replicates import DRAWS, SAME_VALLEY, ReplicateFit

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
BINS = {100: 20, 0: 10}  # of a histogram, from so many replicates on
BAND = "#dddddd"

WIDE = 0.2  # of bounds, from which being inside them proves little


def explanation(assessment: Assessment) -> str:
    """What was done, and what the bounds are."""
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
        asked=[*pages.rows(experiment), ["Simulated motions", f"{assessment.replicates}"]],
        numbers={NUMBERS: {"experiment": name, **summarise(assessment)}},
    )


def remarks(assessment: Assessment) -> list[str]:
    """What the tables do not say, a sentence each; nothing if there is nothing to say."""
    sentences = {
        f"A fit is in the right valley if its cost is at most {SAME_VALLEY:g} above where a descent"
        f" from the truth ends; {percent(IN_VALLEY, 0)} should be. Replicates in another valley": (
            assessment.wrong
        ),
        "In another valley, but said to have converged": assessment.wrong_but_converged,
        "Fits that did not converge": assessment.unconverged,
        f"Chains that did not converge, or have fewer than {DRAWS} independent draws": (
            assessment.short_chains
        ),
    }
    return listed_replicates(sentences)


def listed_replicates(sentences: Mapping[str, tuple[int, ...]]) -> list[str]:
    """A sentence for each kind of replicates of which there are any, with their numbers."""
    return [f"{words}: {_numbers(found)}." for words, found in sentences.items() if found]


def _numbers(found: tuple[int, ...]) -> str:
    shown = ", ".join(map(str, found[:LISTED]))
    return f"{shown}{' and others' if len(found) > LISTED else ''} ({len(found)} in all)"


def checks_table(assessment: Assessment) -> Table:
    """A row for each claim about all parameters together."""
    table = [["", "found", "share", "bounds", "wanted", "inside"]]
    claimed = f"{FIT_LEVEL:.0%}".replace("%", " %")
    cover = assessment.fit_coverage
    table.append(share_row(f"the fit's {claimed} intervals contain the truth", cover, claimed))
    for level, cover in assessment.profile_coverage.items():
        claimed = percent(level, 0)
        words = f"{claimed} intervals by the profiles of smooth parameters contain it"
        table.append(share_row(words, cover, claimed))
    for level, cover in assessment.chain_coverage.items():
        claimed = percent(level, 0)
        words = f"the posterior's {claimed} intervals contain the truth"
        table.append(share_row(words, cover, claimed))
    valley = f"{percent(IN_VALLEY, 0)} or more"
    table.append(share_row("fits in the right valley", assessment.valley, valley))
    back = "determined parameters came back"
    table.append([*share_row(back, assessment.recovery, "")[:-1], ""])
    return table


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
        row = [name, back, f"{percent(cover.fraction, 0)} ({_bounds(cover)})", _verdict(cover)]
        row += [percent(assessment.chain_coverage_of[name][level].fraction, 0) for level in levels]
        table.append(row)
    if assessment.ranks:
        for row in table[1:]:
            row.append("yes" if assessment.ranks[row[0]].inside else "**no**")
        for name in assessment.ranks.keys() - set(assessment.names):
            inside = "yes" if assessment.ranks[name].inside else "**no**"
            table.append([name, *([""] * (len(heading) - 2)), inside])
    return table


def share_row(words: str, share: Proportion, wanted: str) -> list[str]:
    """Cells of a claim: what was found, its share and bounds, what is wanted, whether it is so."""
    found = f"{share.hits} of {share.total}"
    fraction = percent(share.fraction) if share.total else "–"
    return [words, found, fraction, _bounds(share), wanted, _verdict(share)]


def _bounds(share: Proportion) -> str:
    return f"{percent(share.low, 0)} to {percent(share.high, 0)}"


def _verdict(share: Proportion) -> str:
    """Whether a share may be what it should be, and how it differs if not."""
    if share.inside:
        return "yes"
    return "**no**, too few" if share.high < share.wanted_low else "**no**, too many"


@styled
def ranks(tests: Mapping[str, RankTest], title: str) -> Figure:
    """Of each quantity: the histogram of its ranks, and its ECDF less that of uniform ranks."""
    rows = -(-len(tests) // PAIRS_PER_ROW)
    figure = Figure(figsize=(17, 2.6 * rows + 1.8), layout="constrained")
    figure.suptitle(title)
    grid = figure.subplots(rows, 2 * PAIRS_PER_ROW, squeeze=False).reshape(-1, 2)
    for (histogram, difference), (name, test) in zip(grid, tests.items(), strict=False):
        _histogram(histogram, test)
        _difference(difference, test)
        histogram.set_title(name)
        if not test.inside:
            difference.set_title("outside its band", color=CAPTURED)
    for axes in grid[len(tests) :].ravel():
        axes.set_axis_off()
    for histogram, difference in grid[: len(tests)][-PAIRS_PER_ROW:]:
        histogram.set_xlabel("rank")
        difference.set_xlabel("rank, as a fraction")
    (test, *_) = tests.values()
    legend(
        figure,
        Patch(color=AFTER, label="left: replicates by the rank of their truth"),
        Line2D([], [], color=AFTER, label="right: ECDF of the ranks less the uniform one"),
        Patch(color=BAND, label=f"95 % of each bar; {100 * test.level:.2f} % of whole curves"),
    )
    return figure


@styled
def recovery(fits: Sequence[ReplicateFit], title: str) -> Figure:
    """Of each parameter: fitted against true values, with intervals that miss the truth marked."""
    rows = fits[0]["parameters"]
    lines = -(-len(rows) // PANELS_PER_ROW)
    figure = Figure(figsize=(17, 4.0 * lines + 1.4), layout="constrained")
    figure.suptitle(title)
    grid = figure.subplots(lines, PANELS_PER_ROW, squeeze=False)
    for i, axes in enumerate(grid.flat):
        if i >= len(rows):
            axes.set_axis_off()
            continue
        _recovered(axes, fits, i)
    legend(
        figure,
        Line2D([], [], marker="o", color=AFTER, label="fitted, 95 % interval"),
        Line2D([], [], marker="o", color=CAPTURED, label="the interval misses the truth"),
        Line2D([], [], marker="o", linestyle="", mfc="none", color=BEFORE, label="undetermined"),
        Line2D([], [], color="black", linewidth=0.8, label="fitted = true"),
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
    """Whether intervals are true, whether fits find the right valley, and what comes back."""
    return [_intervals(assessment), _valleys(assessment), _recovery(assessment)]


def _intervals(assessment: Assessment) -> Finding:
    cover = assessment.fit_coverage
    count = assessment.replicates
    motions = f"{count} simulated motion{'s' * (count != 1)}"
    bounds = f"{percent(cover.low, 0)} to {percent(cover.high, 0)}"
    share = percent(cover.fraction, 0)
    coverage = f"the fit's 95 % intervals contain {share} of the true values ({bounds})"
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


def _valleys(assessment: Assessment) -> Finding:
    valley = assessment.valley
    text = f"{valley.hits} of {valley.total} fits end where a descent from the truth does"
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
