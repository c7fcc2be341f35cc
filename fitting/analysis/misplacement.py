"""The most likely cause of feet that are off their ground."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fitting.datasets.clips.clip import Clip
from fitting.datasets.coverage import ENOUGH, FACTORS
from jaxik.world import body

from .placement import VISIBLE, Soles

CLOSE = 0.1  # relative difference from a factor
CORRELATED = 0.8  # of heights, from which one counts as proportional to the other
CONSTANT = 0.25  # of the mean, deviation below which heights count as equal
HELPED = 0.5  # of the gaps that a remedy leaves at most, on average


class Cause(NamedTuple):
    """Why feet are off their ground; `likely_cause` explains the kinds."""

    kind: str
    amount: float = 0.0
    """`offset`: m. `units`: metres for each unit of the terrain."""


Trial = Callable[[Cause], Soles | None]
"""Where the soles are after the remedy for a cause; None where there is no remedy to try."""


def likely_cause(
    feet: Soles, animated: Clip, *, unit: float = 1.0, trial: Trial | None = None
) -> Cause:
    """The simplest cause that explains where the soles of standing feet are without foot IK.

    Of `units` and `root` the remedy must help, too: it leaves half of the gaps at most.

    - `missing`: there is no ground under many of them; `datasets.coverage` finds out why.
    - `units`: the feet follow the ground by the factor of a unit of length.
    - `offset`: all feet are too high or too low by the same amount.
    - `root`: the higher the ground, the deeper they are in it.
    - `unknown`: none of these.

    Args:
        feet: the soles of the animation.
        animated: the animation, with its root where the motion has it.
        unit: of the terrain, as it was read, m.
        trial: tries their remedies; None takes them to help.
    """
    visible = VISIBLE * body.ratio(animated.rig)
    standing = feet.stance & ~np.isnan(feet.gap)
    if standing.sum() < ENOUGH * feet.stance.sum():
        return Cause("missing")
    gap, ground = feet.gap[standing], np.fmax.reduce(feet.ground, axis=-1)[standing]

    def helps(cause: Cause) -> bool:
        if trial is None:
            return True
        if (tried := trial(cause)) is None:
            return False
        left = np.abs(tried.gap[feet.stance & ~np.isnan(tried.gap)])
        covered = len(left) >= ENOUGH * feet.stance.sum()
        return covered and bool(left.mean() <= HELPED * np.abs(gap).mean())

    if np.std(gap) <= CONSTANT * abs(np.mean(gap)) and abs(np.mean(gap)) > visible:
        return Cause("offset", float(np.mean(gap)))
    if np.std(ground) > visible:
        if np.std(gap + ground) > visible and _correlation(gap + ground, ground) > CORRELATED:
            followed = np.polyfit(ground, gap + ground, 1)[0]  # m for each metre of the ground
            for factor in FACTORS:
                units = Cause("units", unit * factor)
                if abs(followed / factor - 1.0) < CLOSE and helps(units):
                    return units
        if _correlation(gap, ground) < -CORRELATED and helps(Cause("root")):
            return Cause("root")
    return Cause("unknown")


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(a, b)[0, 1]) if np.std(a) > 0 and np.std(b) > 0 else 0.0
