"""The report of a comparison: a table with its explanation, the numbers, and a figure."""

from dataclasses import asdict
from pathlib import Path

import numpy as np

from fitting.runtime import files
from fitting.runtime.storage.json_files import write_json
from fitting.studies.comparison import ANIMATED, Comparison
from fitting.studies.frame_rates import JOINTS

from .formatting import Table, markdown, percent
from .labels import MEASURES, explanations, headings
from .plots import comparison_plots, style

TABLE, NUMBERS, FIGURE = "compare.md", "compare.json", "compare.png"


RATES = (
    "How far joints are from where they are at the clip's own rate: rms over frames and legs, and "
    "the largest distance. Labels, strides, speeds and root stay those at the clip's own rate, as "
    "a game keeps them with the animation. Pelvis and feet of `unreal` and the pelvis of `mec` "
    "follow by the engine's interp-to, whose half-life depends on the frame rate, as in the "
    "originals: at a speed of 15 it is 33 ms at 30 Hz and 40 ms at 60 Hz."
)


def write(folder: Path, comparison: Comparison) -> None:
    """Writes compare.md, compare.json and compare.png into a folder, which is made if needed."""
    folder.mkdir(parents=True, exist_ok=True)
    style.save(folder / FIGURE, comparison_plots.overview(comparison))
    write_json(folder / NUMBERS, _numbers(comparison))
    files.write_text(folder / TABLE, _summary(comparison))


def table(comparison: Comparison) -> Table:
    """The measures, a row for each system."""
    rows = [
        [name, *(MEASURES[key].format(value) for key, value in asdict(measures).items())]
        for name, measures in comparison.measures.items()
    ]
    return [["system", *headings(MEASURES)], *rows]


def rate_table(comparison: Comparison) -> Table:
    """How far each system is from its motion at the clip's rate, rms and largest, in mm."""
    heading = [f"mm from {comparison.fps:g} Hz", "at", *JOINTS, "largest"]
    return [heading] + [
        [row.system, f"{row.fps:g} Hz"]
        + [f"{1000 * row.rms[joint]:.1f}" for joint in JOINTS]
        + [f"{1000 * max(row.largest.values()):.1f}"]
        for row in comparison.rates
    ]


def _numbers(comparison: Comparison) -> dict[str, object]:
    """The content of compare.json: SI units, radians and fractions of 1; null for NaN."""
    return {
        "title": comparison.title,
        "frames": len(comparison.ground),
        "fps": comparison.fps,
        "soles_without_ground": comparison.groundless,
        "systems": [
            {"name": name}
            | {key: None if np.isnan(value) else value for key, value in asdict(measures).items()}
            for name, measures in comparison.measures.items()
        ],
        "rates": [asdict(row) for row in comparison.rates],
    }


def _summary(comparison: Comparison) -> str:
    count = len(comparison.ground)
    parts = [
        f"# {comparison.title}",
        f"{count} frames, {(count - 1) / comparison.fps:.2f} s at {comparison.fps:g} Hz. "
        f"`{ANIMATED}` is the animation without foot IK, on its flat floor.",
        markdown(table(comparison)),
        f"![Feet and pelvis over the ground, and the measures]({FIGURE})",
        "## What the columns mean",
        explanations(MEASURES),
        "Presets that leave the character's height to their game (`unreal`, `mec`) have the root "
        "on the ground below it, unless `--root animation` was given.",
        "A foot stands where the animation says so: by its contact labels or, without them, by its "
        "motion. The ground under a point is what a ray from above meets first.",
    ]
    if comparison.rates:
        parts += ["## At other frame rates", RATES, markdown(rate_table(comparison))]
    if comparison.groundless:
        fraction = percent(comparison.groundless)
        parts.append(f"{fraction} of the soles' points have no ground under them and are left out.")
    return "\n\n".join(parts) + "\n"
