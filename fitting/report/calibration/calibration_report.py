"""The report of a calibration: what is true of the fits' and the posteriors' claims."""

from collections.abc import Mapping
from pathlib import Path

from fitting.experiments.experiment import Experiment
from fitting.report.formatting import aligned, bullets, joined, markdown, percent
from fitting.report.plots import calibration_plots, style
from fitting.runtime import files
from fitting.runtime.storage.json_files import write_json
from fitting.studies.calibration.assessment import (
    FAMILY_LEVEL,
    IN_VALLEY,
    NEAR,
    SAME_VALLEY,
    Assessment,
    summarise,
)
from fitting.studies.calibration.calibration import Calibration
from fitting.studies.calibration.replicates import DRAWS, ReplicateChain, ReplicateFit

from .calibration_tables import checks_table, parameter_table

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


def fit_line(fitted: ReplicateFit) -> str:
    """A finished fit in one line, for the terminal."""
    gap = fitted["cost"] - fitted["truth_valley_cost"]
    found = "the truth's valley" if gap <= SAME_VALLEY else f"a valley {gap:.1f} above the truth's"
    return (
        f"replicate {fitted['number'] + 1}: {found}, {fitted['agreeing']} of {fitted['starts']} "
        f"starts agree{'' if fitted['converged'] else ', not converged'}; {fitted['seconds']:.1f} s"
    )


def chain_line(chain: ReplicateChain) -> str:
    """A finished chain in one line, for the terminal."""
    return (
        f"replicate {chain['number'] + 1}: chain with {chain['draws']} independent draws"
        f"{'' if chain['converged'] else ', not converged'}; {chain['seconds']:.0f} s"
    )


def sentence(assessment: Assessment) -> str:
    """What was found, in two sentences."""
    count = assessment.replicates
    made = f"{count} simulated motion{'s' * (count != 1)}"
    cover = assessment.fit_coverage
    coverage = (
        f"The fit's 95 % intervals contain {percent(cover.fraction, 0)} of the true values "
        f"({percent(cover.low, 0)} to {percent(cover.high, 0)})."
    )
    if assessment.inside:
        return f"Calibrated: on {made} everything is inside its bounds. {coverage}"
    outside = _listed(assessment.outside)
    return f"Not calibrated: on {made}, outside their bounds: {outside}. {coverage}"


def explanation(assessment: Assessment) -> str:
    """What was done, and what the bounds are."""
    return (
        "Truths were drawn from the prior, motion was simulated from them with the noise that the "
        "experiment assumes, and each was fitted as `jaxik fit` does. Bounds are those of the "
        f"probability behind a share, at {percent(assessment.level, 2)} each, so that with "
        f"{percent(FAMILY_LEVEL, 0)} a program whose claims are true is inside all of them."
    )


def calibration_text(assessment: Assessment) -> str:
    """The result of a calibration, for the terminal."""
    tables = [aligned(checks_table(assessment)), aligned(parameter_table(assessment))]
    return joined([sentence(assessment), *tables, *_listed_remarks(assessment)], apart=True)


def write(
    folder: Path, experiment: Experiment, calibration: Calibration, assessment: Assessment
) -> None:
    """Writes calibration.json, summary.md and the pictures into an existing folder."""
    numbers = {"experiment": experiment.name, **summarise(assessment)}
    write_json(folder / NUMBERS, numbers)
    title = f"{experiment.name}: fitted against true values"
    style.save(folder / RECOVERY, calibration_plots.recovery(calibration.fits, title))
    parts = [
        f"# {experiment.name}: calibration",
        sentence(assessment),
        explanation(assessment),
        markdown(checks_table(assessment)),
        *_listed_remarks(assessment),
        "## Parameters",
        markdown(parameter_table(assessment)),
        CAME_BACK,
        f"![Fitted against true values]({RECOVERY})",
    ]
    if assessment.ranks:
        title = f"{experiment.name}: ranks of the truths among {DRAWS} draws"
        style.save(folder / RANKS, calibration_plots.ranks(assessment.ranks, title))
        parts += [
            "## Ranks",
            RANKED,
            f"![Ranks]({RANKS})",
        ]
    files.write_text(folder / SUMMARY, "\n\n".join(parts) + "\n")


def _listed_remarks(assessment: Assessment) -> list[str]:
    lines = remarks(assessment)
    return [bullets(lines)] if lines else []


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


def _listed(words: list[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
