"""What a fit says of the captures: numbers that were fitted, and offsets that are seen."""

import math
from collections.abc import Sequence

from fitting.report.fit_tables import Truth, parameter_table
from fitting.report.formatting import bullets, markdown
from fitting.studies.fit import Fit, FittedParameter
from fitting.studies.motions.capture_signs import CaptureSigns

HEADING = "The capture"


def of_system(rows: Sequence[FittedParameter]) -> list[FittedParameter]:
    """The rows of parameters of the system."""
    return [row for row in rows if row.get("of") != "capture"]


def of_capture(rows: Sequence[FittedParameter]) -> list[FittedParameter]:
    """The rows of what is not known of captures."""
    return [row for row in rows if row.get("of") == "capture"]


def section(fitted: Fit, truth: Truth) -> list[str]:
    """Paragraphs of Markdown; none where nothing of a capture was fitted or is seen."""
    rows, seen = of_capture(fitted.summary["parameters"]), sentences(fitted)
    if not rows and not seen:
        return []
    parts = [f"## {HEADING}"]
    if rows:
        parts.append("What is not known of the captures, fitted along; no part of the system:")
        parts.append(markdown(parameter_table(rows, truth)))
    return [*parts, bullets(seen)] if seen else parts


def sentences(fitted: Fit) -> list[str]:
    """Offsets that the clips show and that were not fitted, one each, with the remedy."""
    signs = fitted.capture_signs
    return [
        f"Clip {number}: {text}" if len(signs) > 1 else f"{text[0].upper()}{text[1:]}"
        for number, of_clip in enumerate(signs, 1)
        for name, text in _of_clip(of_clip)
        if name not in fitted.experiment.capture
    ]


def _of_clip(signs: CaptureSigns) -> list[tuple[str, str]]:
    """What one clip shows: the key of [capture] that fits it, and a sentence."""
    ground, found = signs.ground, []
    if ground.height:
        side = "over" if ground.height > 0 else "in"
        text = (
            f"standing feet are {_cm(ground.height)} {side} the ground in the median of "
            f"{ground.stances} stances, which scatter by {_cm(ground.scatter)}: a floor offset?"
        )
        found.append(("ground_height", text))
    for axis, tilt in (("x", ground.tilt_x), ("z", ground.tilt_z)):
        if abs(tilt) >= math.radians(0.1):
            text = (
                f"standing feet {'rise over' if tilt > 0 else 'sink into'} the ground by "
                f"{math.degrees(abs(tilt)):.1f}° along {axis}: a tilted floor?"
            )
            found.append((f"ground_tilt_{axis}", text))
    if signs.lag:
        order = "after" if signs.lag > 0 else "before"
        text = (
            f"the captured ankles move {1000 * abs(signs.lag):.0f} ms {order} the fitted ones: a "
            "time shift?"
        )
        found.append(("time_shift", text))
    return [(name, f"{text} `[capture] {name} = {{}}` fits it along.") for name, text in found]


def _cm(metres: float) -> str:
    return f"{100 * abs(metres):.1f} cm"
