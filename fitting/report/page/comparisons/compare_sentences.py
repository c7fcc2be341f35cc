"""What a comparison of systems found, in three sentences."""

import math
from collections.abc import Mapping
from typing import NamedTuple

from fitting.analysis.placement import (
    MISSING_LIMIT,
    POP_LIMIT,
    SHARE_LIMIT,
    SLIDE_LIMIT,
    Placement,
)
from fitting.report.formatting import percent
from fitting.report.page.sentences import listed
from fitting.report.page.study_page import Finding
from fitting.studies.comparison import ANIMATED, Comparison
from fitting.studies.motions.comparison_motions import ComparedMotions


class Fault(NamedTuple):
    """Something that a viewer may notice of a motion."""

    excess: float
    """Over the limit of what passes; above 1 it does not."""
    words: str


def findings(comparison: Comparison, compared: ComparedMotions) -> list[Finding]:
    """What is worst, which system stands best, and which is closest to the captured motion.

    Where that is not known, the last one says which system reaches its targets.
    """
    placements = {name: compared.motions[name].placement for name in comparison.placements}
    animated = compared.motions[ANIMATED].placement
    last = _closeness(compared) if compared.accuracy else _reach(comparison)
    return [_worst(placements), _standing(placements, animated), last]


def off_ground(placement: Placement) -> float:
    """Fraction of the frames of standing feet in which one is visibly off the ground."""
    return placement.sunk + placement.floating


def faults(placement: Placement) -> list[Fault]:
    """All that is measured against a limit, the worst first."""
    visible = f"{100 * placement.visible:.2g} cm"
    deepest, highest = placement.deepest, placement.highest
    pop, slide = placement.pop, placement.largest_slide
    place, furthest = ("above", highest) if highest.value > deepest.value else ("in", deepest)
    size = placement.size
    every = [
        Fault(
            placement.groundless / MISSING_LIMIT,
            f"there is no ground under {percent(placement.groundless)} of its soles",
        ),
        Fault(
            off_ground(placement) / SHARE_LIMIT,
            f"its standing feet are {visible} or more off the ground in "
            f"{percent(off_ground(placement))} of their frames (furthest "
            f"{100 * furthest.value:.1f} cm {place} it, {furthest.leg}, frame {furthest.frame})",
        ),
        Fault(
            placement.slide / (SLIDE_LIMIT * size),
            f"its standing feet slide by {100 * placement.slide:.1f} cm a stance more than "
            f"animated (most {100 * slide.value:.1f} cm, {slide.leg}, frame {slide.frame})",
        ),
        Fault(
            pop.value / (POP_LIMIT * size),
            f"its feet pop by up to {100 * pop.value:.1f} cm in 1/60 s ({pop.leg}, frame "
            f"{pop.frame})",
        ),
    ]
    known = [fault for fault in every if not math.isnan(fault.excess)]
    return sorted(known, key=lambda fault: -fault.excess)


def beyond(placements: Mapping[str, Placement]) -> list[str]:
    """Names of motions of which something is beyond its limit."""
    return [name for name, placed in placements.items() if faults(placed)[0].excess > 1.0]


def _worst(placements: Mapping[str, Placement]) -> Finding:
    failing = beyond(placements)
    name = max(placements, key=lambda name: faults(placements[name])[0].excess)
    excess, words = faults(placements[name])[0]
    times = f"{excess:.2g} times what passes unnoticed"
    if not failing:
        whole = "The system stays" if len(placements) == 1 else "All systems stay"
        return Finding(
            f"{whole} within the limits of feet off the ground, slides and pops; nearest to one "
            f"comes `{name}`, as {words}, {times}."
        )
    others = [f"`{other}`" for other in failing if other != name]
    also = ""
    if others:
        also = f"; {listed(others)} {'goes' if len(others) == 1 else 'go'} beyond a limit, too"
    return Finding(f"Worst is `{name}`: {words}, {times}{also}.", bad=True)


def _standing(placements: Mapping[str, Placement], animated: Placement) -> Finding:
    shares = {name: off_ground(placed) for name, placed in placements.items()}
    shares = {name: share for name, share in shares.items() if not math.isnan(share)}
    visible = f"{100 * animated.visible:.2g} cm"
    if not shares:
        return Finding("No standing foot has ground under it, so nothing is known of them.", True)
    best, before = min(shares, key=shares.__getitem__), off_ground(animated)
    without = "" if math.isnan(before) else f", {percent(before)} without foot IK"
    measure = f"{visible} or more off the ground in {percent(shares[best])} of their frames"
    if shares[best] >= before:
        return Finding(
            f"No system brings standing feet closer to the ground than the animation has them: "
            f"with `{best}` they are {measure}{without}.",
            bad=before > 0.0,
        )
    if len(shares) == 1:
        return Finding(f"Its standing feet are {measure}{without}.")
    return Finding(f"`{best}` places standing feet best: they are {measure}{without}.")


def _closeness(compared: ComparedMotions) -> Finding:
    distances = {name: of.ankle for name, of in compared.accuracy.items()}
    before = distances.pop(ANIMATED)
    best, worst = (choose(distances, key=distances.__getitem__) for choose in (min, max))
    without = f"; without foot IK it is {100 * before:.1f} cm"
    if distances[best] >= before:
        return Finding(
            f"No system comes closer to the captured motion than the flat animation: the best, "
            f"`{best}`, has its ankles {100 * distances[best]:.1f} cm away (rms){without}.",
            bad=True,
        )
    furthest = f", furthest is `{worst}` with {100 * distances[worst]:.1f} cm"
    return Finding(
        f"Closest to the captured motion is `{best}`, whose ankles are "
        f"{100 * distances[best]:.1f} cm away (rms){furthest if len(distances) > 1 else ''}"
        f"{without}."
    )


def _reach(comparison: Comparison) -> Finding:
    shares = {name: comparison.measures[name].reached for name in comparison.placements}
    shares = {name: share for name, share in shares.items() if not math.isnan(share)}
    if not shares:
        return Finding("No foot has a target, as there is no ground under any.", bad=True)
    best, least = (choose(shares, key=shares.__getitem__) for choose in (max, min))
    text = f"`{best}` reaches {percent(shares[best])} of the targets of its ankles"
    if len(shares) > 1:
        text += f", the most of all, and `{least}` {percent(shares[least])}, the fewest"
    unknown = "how close that is to captured motion is not known, as there is none to compare with"
    return Finding(f"{text}; {unknown}.")
