"""What finished replicates under a wrong model say: is a fit worth keeping, its verdict true?

Nobody sees differences as small as `distances.UNSEEN`. So a verdict is true unless it is
contradicted by more: one that says "fits" where the motion without errors is further off than what
looks the same, or where the fit has made something worse; "worse" where the distance that it names
is not larger than the other one there; "does not fit", which is said of the capture, where this is
clearly within without its noise and jumps.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np

from fitting.analysis.goodness.distances import CLOSE, UNSEEN, Distances, Kinds, Motion, Part
from fitting.inference.calibration.proportions import Proportion, proportion

from .wrong_model import Judgement, WrongModelFit

LEVEL = 0.95  # of the bounds of shares
TRUE_VERDICTS = 0.95  # of all, at least
POSITIONS = "ankle", "knee", "pelvis"
WORSE = 0.002  # m rms, further off than the animation
WORDS = "fits", "does not fit", "worse"


@dataclasses.dataclass(frozen=True)
class WrongModelAssessment:
    """What was found, on frames that were held out unless a field says otherwise."""

    replicates: int
    kept_no_worse: Proportion
    """How often the kept system is no further from the capture than the flat animation: by the root
    mean square over ankles, knees and pelvis."""
    kept_no_worse_anywhere: Proportion
    """How often no kind of joint is, and the orientation of the feet neither."""
    kept_no_worse_noise_free: Proportion
    """The first again, against the motion without errors."""
    fitted_no_worse: Proportion
    """The first again, of the fitted system, kept or not."""
    verdicts: Proportion
    """How often the verdict is true."""
    verdicts_of: Mapping[str, Proportion]
    """The same, by what it says."""
    coverage_of: Mapping[str, Proportion]
    """How often the fit's 95 % intervals contain the value of the system that made the motion, by
    parameter that both have; nothing that they should."""
    medians: Mapping[str, Mapping[str, float]]
    """m or rad, of the distances from the motion without errors, by motion and kind of joint."""
    worse: tuple[int, ...]
    """Replicates whose kept system is worse than the animation, from 1."""
    false: tuple[int, ...]
    """Replicates whose verdict is not true."""
    unconverged: tuple[int, ...]

    @property
    def outside(self) -> list[str]:
        """The checks that failed, in words."""
        checks = {
            "the kept system against the animation": self.kept_no_worse.inside,
            "the share of true verdicts": self.verdicts.inside,
        }
        return [words for words, inside in checks.items() if not inside]

    @property
    def inside(self) -> bool:
        """Whether all checks passed."""
        return not self.outside


def assess(fits: Sequence[WrongModelFit]) -> WrongModelAssessment:
    """Judges all replicates of a calibration under a wrong model."""
    captured = [distances_of(fit["captured"]) for fit in fits]
    noise_free = [distances_of(fit["noise_free"]) for fit in fits]
    kept: list[Motion] = [distances.better for distances in captured]
    pairs = list(zip(captured, kept, strict=True))
    kept_no_worse = np.array([_no_worse(*pair) for pair in pairs])
    true = np.array([is_true(fit) for fit in fits])
    words = np.array([word(fit["captured"]) for fit in fits])
    return WrongModelAssessment(
        replicates=len(fits),
        kept_no_worse=_share(kept_no_worse, wanted=(1.0, 1.0)),
        kept_no_worse_anywhere=_share([_no_worse_anywhere(*pair) for pair in pairs]),
        kept_no_worse_noise_free=_share(
            [_no_worse(*pair) for pair in zip(noise_free, kept, strict=True)]
        ),
        fitted_no_worse=_share([_no_worse(distances, "fitted") for distances in captured]),
        verdicts=_share(true, wanted=(TRUE_VERDICTS, 1.0)),
        verdicts_of={said: _share(true[words == said]) for said in WORDS},
        coverage_of=_coverage(fits),
        medians=_medians(noise_free, kept),
        worse=_numbers(~kept_no_worse),
        false=_numbers(~true),
        unconverged=_numbers([not fit["converged"] for fit in fits]),
    )


def word(judgement: Judgement) -> str:
    """The verdict of a fit, one of `WORDS`."""
    if judgement["fits"]:
        return "fits"
    return "worse" if distances_of(judgement).setbacks else "does not fit"


def is_true(fit: WrongModelFit) -> bool:
    """Whether the motion and its capture, without noise, agree with what a fit says."""
    noise_free = distances_of(fit["noise_free"])
    if fit["captured"]["fits"]:
        return not _is_far(noise_free, 1.0) and not noise_free.setbacks
    if setbacks := distances_of(fit["captured"]).setbacks:
        part, kind, _, other, _ = setbacks[0]
        motions = noise_free.parts[part]
        return motions["fitted"][kind] > motions[other][kind]
    return not fit["lasting"]["fits"] or _is_far(distances_of(fit["lasting"]), -1.0)


def distances_of(judgement: Judgement) -> Distances:
    """The distances as they were before a file held them."""
    return Distances(cast(Mapping[Part, Mapping[Motion, Kinds]], judgement["distances"]))


def summarise(assessment: WrongModelAssessment) -> dict[str, Any]:
    """The numbers of an assessment as `calibration.json` holds them."""
    return {
        "inside": assessment.inside,
        "outside": assessment.outside,
        **dataclasses.asdict(assessment),
    }


def _no_worse(distances: Distances, motion: Motion) -> bool:
    """Whether the joints of a motion are not visibly further off than the animation's."""
    motions = distances.parts["held_out"]
    of_motion, of_animation = (
        math.sqrt(np.mean([motions[name][kind] ** 2 for kind in POSITIONS]))
        for name in (motion, "animation")
    )
    return of_motion <= of_animation + WORSE


def _no_worse_anywhere(distances: Distances, motion: Motion) -> bool:
    """Whether no kind of joint is visibly further off, and the orientation of the feet neither."""
    motions = distances.parts["held_out"]
    return all(
        motions[motion][kind] <= motions["animation"][kind] + UNSEEN[kind] for kind in UNSEEN
    )


def _is_far(distances: Distances, margin: float) -> bool:
    """Whether the fitted motion is off by more than looks the same, and so many `UNSEEN`."""
    return any(
        motions["fitted"][kind] > CLOSE[kind] + margin * UNSEEN[kind]
        for motions in distances.parts.values()
        for kind in CLOSE
    )


def _share(hits: Any, wanted: tuple[float, float] = (0.0, 1.0)) -> Proportion:
    return proportion(np.asarray(hits, bool)[:, None], level=LEVEL, wanted=wanted)


def _coverage(fits: Sequence[WrongModelFit]) -> dict[str, Proportion]:
    """By parameter that both systems have."""
    hits: dict[str, list[bool]] = {}
    for fit in fits:
        for row in fit["parameters"]:
            if (truth := fit["truth_values"].get(row["name"])) is not None:
                low, high = row["interval"]
                hits.setdefault(row["name"], []).append(low <= truth <= high)
    return {name: _share(covered) for name, covered in hits.items()}


def _medians(distances: Sequence[Distances], kept: Sequence[Motion]) -> dict[str, dict[str, float]]:
    parts = [each.parts["held_out"] for each in distances]
    names: list[Motion] = ["animation", "before", "fitted"]
    motions = {name: [part[name] for part in parts] for name in names}
    motions |= {"kept": [part[name] for part, name in zip(parts, kept, strict=True)]}  # type: ignore[dict-item]
    return {
        name: {kind: float(np.median([each[kind] for each in kinds])) for kind in CLOSE}
        for name, kinds in motions.items()
    }


def _numbers(where: Any) -> tuple[int, ...]:
    """Replicates, counted from 1."""
    return tuple(int(i) + 1 for i in np.flatnonzero(where))
