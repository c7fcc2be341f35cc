"""Tables of a calibration, as text: all checks, and what was found for each parameter."""

from fitting.inference.calibration.proportions import Proportion
from fitting.report.formatting import Table, percent
from fitting.studies.calibration.assessment import FIT_LEVEL, IN_VALLEY, Assessment


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
