"""The page of a comparison of systems on one clip."""

from pathlib import Path

from fitting.datasets.clips import flight
from fitting.report import comparison_report
from fitting.report.formatting import Table, percent, transposed
from fitting.report.labels import MEASURES, meanings
from fitting.report.page import figures, pictures
from fitting.report.page.motion_data import MAX_RATE
from fitting.report.page.study_page import (
    Block,
    Grid,
    Jump,
    Points,
    Section,
    StudyPage,
    Terms,
    Text,
    View,
)
from fitting.runtime.precision import in_float64
from fitting.studies.comparison import ANIMATED, Comparison
from fitting.studies.motions import comparison_motions
from fitting.studies.motions.comparison_motions import ComparedMotions

from . import compare_sentences, shown_motions

FILES = {
    comparison_report.TABLE: "the tables",
    comparison_report.NUMBERS: "all numbers",
    comparison_report.FIGURE: "the figure",
}


@in_float64
def write(folder: Path, comparison: Comparison) -> None:
    """Writes the page into the folder of a comparison, whose figure is there."""
    compared = comparison_motions.of_comparison(comparison)
    systems = tuple(comparison.placements)
    placements = {name: compared.motions[name].placement for name in systems}
    beyond = compare_sentences.beyond(placements)
    worst = max(systems, key=lambda name: compare_sentences.faults(placements[name])[0].excess)
    visible = compared.motions[ANIMATED].placement.visible
    StudyPage(
        kind="Foot IK systems compared on one clip",
        title=comparison.title,
        verdict=f"{len(beyond)} of {len(systems)} beyond a limit"
        if beyond
        else "All within limits",
        good=not beyond,
        findings=compare_sentences.findings(comparison, compared),
        sections=[
            _placement(compared),
            *_accuracy(compared),
            _measures(folder, comparison),
            *_rates(comparison),
            _worst(comparison, compared),
            _limits(comparison, compared),
        ],
        asked=_asked(comparison),
        files=FILES,
        view=View(
            [shown_motions.shown(compared, systems, watched=worst)],
            [comparison.title],
            f"{100 * visible:.2g} cm",
        ),
    ).write(folder)


def _placement(compared: ComparedMotions) -> Section:
    placements = {name: motion.placement for name, motion in compared.motions.items()}
    if compared.captured is not None:
        placements["captured"] = compared.captured.placement
    table = figures.placement_table(placements)
    text = (
        "Share of the frames and, after the dot, the largest with its foot and frame. A slide or a "
        "pop counts by how far it exceeds that of the flat animation; frames count from 0."
    )
    return Section("Feet on the ground", [Grid(table, "How feet are placed"), Text(text)])


def _accuracy(compared: ComparedMotions) -> list[Section]:
    if not compared.accuracy:
        return []
    table = figures.accuracy_table(compared.accuracy)
    text = "Distances and angles are root mean squares."
    return [Section("Beside the captured motion", [Grid(table, "Accuracy"), Text(text)])]


def _measures(folder: Path, comparison: Comparison) -> Section:
    table = transposed(comparison_report.table(comparison))
    caption = "Feet and pelvis over the ground, and the measures"
    return Section(
        "Measures",
        [
            Grid(table, "Measures of all systems"),
            *pictures.embed(folder, {comparison_report.FIGURE: caption}),
            Terms(meanings(MEASURES)),
        ],
    )


def _rates(comparison: Comparison) -> list[Section]:
    if not comparison.rates:
        return []
    table = comparison_report.rate_table(comparison)
    grid = Grid(table, "Motion at other frame rates")
    return [Section("At other frame rates", [Text(comparison_report.RATES), grid])]


def _worst(comparison: Comparison, compared: ComparedMotions) -> Section:
    blocks: list[Block] = []
    for name in comparison.placements:
        start, end = compared.worst[name]
        fault, *_ = compare_sentences.faults(compared.motions[name].placement)
        times = f"{start / comparison.fps:.2f} to {end / comparison.fps:.2f} s"
        text = f"`{name}`, {times}. What passes least in the whole clip: {fault.words}."
        blocks += [Text(text), Jump(f"Show {name} in the view", 0, shown_motions.key(name))]
    return Section("The worst two seconds of each system", blocks)


def _limits(comparison: Comparison, compared: ComparedMotions) -> Section:
    animation, clip = comparison.animation, comparison.animation.clip
    lines = [
        "The systems are compared on this clip and this ground alone; on others they may stand "
        "differently."
    ]
    if compared.captured is None:
        lines.append(
            "The captured motion is not known: figures say how feet stand on the ground, not "
            "whether people would move like this."
        )
    lines.append(f"Root: {animation.root.reason}.")
    if clip.stance is None:
        lines.append("The clip has no contact labels; stances are found by its motion.")
    if comparison.groundless:
        lines.append(
            f"{percent(comparison.groundless)} of the soles' points have no ground under them and "
            "are left out."
        )
    if in_the_air := flight.describe(animation.clip):
        lines.append(f"{in_the_air.capitalize()}.")
    if clip.fps > MAX_RATE:
        lines.append(
            f"The view shows {MAX_RATE:g} frames a second or fewer; all figures are of all frames, "
            f"at {clip.fps:g} Hz."
        )
    return Section("Limits of the data", [Points([*lines, *clip.remarks])])


def _asked(comparison: Comparison) -> Table:
    animation = comparison.animation
    count = len(comparison.ground)
    seconds = (count - 1) / comparison.fps
    rows = [
        ["Clip and ground", comparison.title],
        ["Frames", f"{count}, {seconds:.2f} s at {comparison.fps:g} Hz"],
        ["Systems", ", ".join(f"`{name}`" for name in comparison.placements)],
        ["Root", animation.root.root],
    ]
    if animation.speed != 1.0:
        rows.append(["Speed", f"{animation.speed:g} times that of the clip"])
    if animation.tracks:
        rows.append(["Tracks", ", ".join(f"`{name}`" for name in animation.tracks)])
    if comparison.rates:
        rates = dict.fromkeys(f"{row.fps:g} Hz" for row in comparison.rates)
        rows.append(["Other frame rates", ", ".join(rates)])
    return rows
