"""The most likely cause of feet that are off their ground."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fitting.datasets import ground_path
from fitting.datasets.clips.clip import Clip
from jaxik.world import body
from jaxik.world.terrain import Terrain

from .placement import VISIBLE, Soles

UNITS = (0.01, 0.001, 0.0254, 0.3048)  # m: centimetre, millimetre, inch, foot; by how usual
FACTORS = [factor for unit in UNITS for factor in (unit, 1.0 / unit)]
FOUND = 0.8  # fraction of stances with ground under them, from which the terrain is in place
CLOSE = 0.1  # relative difference from a factor
CORRELATED = 0.8  # of heights, from which one counts as proportional to the other
CONSTANT = 0.25  # of the mean, deviation below which heights count as equal


class Cause(NamedTuple):
    """Why feet are off their ground; `likely_cause` explains the kinds."""

    kind: str
    amount: float = 0.0
    """`offset`: m. `units`: metres for each unit of the terrain."""


def likely_cause(
    feet: Soles, animated: Clip, terrain: Terrain, turned: Callable[[], Terrain] | None = None
) -> Cause:
    """The simplest cause that explains where the soles of standing feet are without foot IK.

    - `up`: there is ground under them only with the other axis of the terrain's file up.
    - `units`: there is ground only in another unit of length, or the feet follow the ground by the
      factor of one.
    - `aside`: the terrain lies elsewhere.
    - `offset`: all feet are too high or too low by the same amount.
    - `root`: the higher the ground, the deeper they are in it.
    - `unknown`: none of these.

    Args:
        feet: the soles of the animation.
        animated: the animation, with its root where the motion has it.
        terrain: y up.
        turned: makes the terrain with the other axis of its file up.
    """
    visible = VISIBLE * body.ratio(animated.rig)
    standing = feet.stance & ~np.isnan(feet.gap)
    if standing.sum() < FOUND * feet.stance.sum():
        return _cause_of_misses(animated.joints_ws(3)[feet.stance], terrain, turned)
    gap, ground = feet.gap[standing], np.fmax.reduce(feet.ground, axis=-1)[standing]
    if np.std(gap) <= CONSTANT * abs(np.mean(gap)) and abs(np.mean(gap)) > visible:
        return Cause("offset", float(np.mean(gap)))
    if np.std(ground) > visible:
        if np.std(gap + ground) > visible and _correlation(gap + ground, ground) > CORRELATED:
            followed = np.polyfit(ground, gap + ground, 1)[0]  # m for each metre of the ground
            for factor in FACTORS:
                if abs(followed / factor - 1.0) < CLOSE:
                    return Cause("units", factor)
        if _correlation(gap, ground) < -CORRELATED:
            return Cause("root")
    return Cause("unknown")


def _cause_of_misses(
    balls_ws: np.ndarray, terrain: Terrain, turned: Callable[[], Terrain] | None
) -> Cause:
    if turned is not None and _found(turned(), balls_ws) >= FOUND:
        return Cause("up")
    for factor in FACTORS:
        if _found(terrain, balls_ws / factor) >= FOUND:
            return Cause("units", factor)
    return Cause("aside")


def _found(terrain: Terrain, points_ws: np.ndarray) -> float:
    """Fraction of points with ground at any height."""
    return float(np.mean(~np.isnan(ground_path.heights_under(terrain, points_ws, ground_path.SKY))))


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(a, b)[0, 1]) if np.std(a) > 0 and np.std(b) > 0 else 0.0
