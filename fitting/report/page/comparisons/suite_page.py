"""The page of the suite: every system in every situation, against stated bounds."""

from collections import Counter
from pathlib import Path

from fitting.analysis.placement import VISIBLE
from fitting.report.formatting import Table
from fitting.report.labels import meanings
from fitting.report.page import pictures
from fitting.report.page.sentences import listed
from fitting.report.page.study_page import (
    Finding,
    Grid,
    Points,
    Section,
    StudyPage,
    Terms,
    Text,
    View,
)
from fitting.report.suite import suite_report, suite_tables
from fitting.report.suite.suite_tables import MEASURES
from fitting.runtime.precision import in_float64
from fitting.studies.motions import comparison_motions
from fitting.studies.suite.suite import Suite

from . import shown_motions

FILES = {
    suite_report.TABLE: "the tables",
    suite_report.NUMBERS: "all numbers",
    suite_report.PAGE: "the pictures",
}


@in_float64
def write(folder: Path, suite: Suite) -> None:
    """Writes the page into the folder of a suite, whose pictures are there."""
    within, count = suite.counts
    StudyPage(
        kind="Foot IK systems in made situations",
        title="Suite of situations",
        verdict=f"{within} of {count} within bounds",
        good=within == count and not suite.interrupted,
        findings=findings(suite),
        sections=[_cells(folder, suite), _bounds(), _missed(suite), _limits(suite)],
        asked=_asked(suite),
        files={name: words for name, words in FILES.items() if (folder / name).is_file()},
        view=_view(suite) if suite.scenes else None,
    ).write(folder)


def findings(suite: Suite) -> list[Finding]:
    """How many cells miss their bounds and whose, where that is worst, where all is well."""
    if not suite.scenes:
        return [Finding("No situation was finished, so nothing was found.", bad=True)]
    within, count = suite.counts
    text = f"{count - within} of {count} cells are beyond their bounds"
    of_system = _counts(suite)
    worst, best = (choose(of_system, key=of_system.__getitem__) for choose in (max, min))
    if within < count and len(of_system) > 1:
        text += f", most of them of `{worst}` ({of_system[worst]}), fewest of `{best}`"
        text += f" ({of_system[best]})"
    if suite.interrupted:
        text += (
            f", and {len(suite.plan.situations) - len(suite.scenes)} situations are missing, as "
            "the suite was interrupted"
        )
    first = Finding(f"{text}.", bad=within < count or suite.interrupted)
    return [first, _hardest(suite), _easy(suite)]


def _counts(suite: Suite) -> Counter[str]:
    """How many cells of each system miss their bounds."""
    counts = Counter({system: 0 for system in suite.systems})
    for scene in suite.scenes:
        for system in suite.systems:
            counts[system] += _count(scene, system)
    return counts


def _count(scene: suite_tables.Scene, system: str) -> int:
    return sum(cell.endswith(suite_tables.MISS) for cell in suite_tables.cells_text(scene, system))


def _hardest(suite: Suite) -> Finding:
    counts = [sum(_count(scene, system) for system in suite.systems) for scene in suite.scenes]
    most = max(counts)
    if not most:
        return Finding("No situation makes any system miss a bound.")
    scene = suite.scenes[counts.index(most)]
    cells = len(suite.systems) * len(MEASURES)
    text = f"Hardest is `{scene.situation.name}`, with {most} of {cells} cells beyond their bounds"
    if scene.failures:
        text += f"; {listed([f'`{name}`' for name in scene.failures])} gave no motion there"
    return Finding(f"{text}.", bad=True)


def _easy(suite: Suite) -> Finding:
    names = [
        f"`{scene.situation.name}`"
        for scene in suite.scenes
        if not any(_count(scene, system) for system in suite.systems)
    ]
    if not names:
        return Finding("In no situation are all systems within all bounds.", bad=True)
    return Finding(f"All systems are within all bounds in {listed(names)}.")


def _view(suite: Suite) -> View:
    counts = _counts(suite)
    worst = max(counts, key=counts.__getitem__)
    clips = [
        shown_motions.shown(comparison_motions.of_scene(scene), suite.systems, watched=worst)
        for scene in suite.scenes
    ]
    names = [scene.situation.name for scene in suite.scenes]
    return View(clips, names, f"{100 * VISIBLE:.2g} cm (of an adult)")


def _cells(folder: Path, suite: Suite) -> Section:
    caption = "Each system in each situation, from the side"
    return Section(
        "All situations",
        [
            Text(
                "What is marked is beyond its bound, which stands in the first row of a situation."
            ),
            Grid(suite_tables.table(suite), "Measures of all systems in all situations"),
            *pictures.embed(folder, {suite_report.PAGE: caption}),
            Terms(meanings(MEASURES)),
        ],
    )


def _bounds() -> Section:
    return Section("Bounds", [Points(suite_tables.reasons())])


def _missed(suite: Suite) -> Section:
    return Section("Beyond their bounds", [Points(suite_report.missed(suite) or ["Nothing."])])


def _limits(suite: Suite) -> Section:
    lines = [
        "Animations and grounds are made, not captured: the suite says whether feet stand, slide "
        "and pop, not whether people would move like this.",
        "Every system has its defaults or the parameters of its file; fitted to a situation, it "
        "may do better there.",
        "On vehicles the view shows the character as the vehicle's passengers see it.",
    ]
    roots = dict.fromkeys(scene.animation.root.reason for scene in suite.scenes)
    if roots:
        lines.append(f"Roots: {'; '.join(roots)}.")
    return Section("Limits of the data", [Points(lines)])


def _asked(suite: Suite) -> Table:
    return [
        ["Systems", ", ".join(f"`{name}`" for name in suite.systems) or "none was run"],
        ["Situations", ", ".join(entry.name for entry in suite.plan.situations)],
        ["Length of each", f"{suite.plan.seconds:g} s"],
    ]
