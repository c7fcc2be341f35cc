"""Runs systems through situations, and measures what comes out against its bounds."""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

import jaxik
from fitting.analysis import placement
from fitting.analysis.misplacement import Cause
from fitting.analysis.placement import Placement, Soles
from fitting.datasets.clips.clip import Clip
from fitting.studies.animations import Animation

from .bounds import Cell, bounds_of, cells, pelvis_jerk
from .situations import Plan, Situation

SystemsOf: TypeAlias = Callable[[jaxik.Rig], Mapping[str, jaxik.FootIK]]
"""Makes systems for the body of a rig, by name."""


@dataclass(frozen=True)
class Outcome:
    """What a system made of a situation."""

    clip: Clip
    """The solved motion."""
    soles: Soles
    placement: Placement
    cause: Cause | None
    """Why feet are off their ground; None where they are not."""
    cells: Mapping[str, Cell]
    """By measure."""


@dataclass(frozen=True)
class Scene:
    """A situation, what it asks, and what the systems made of it."""

    situation: Situation
    animation: Animation
    systems: tuple[str, ...]
    """Names, in their order."""
    bounds: Mapping[str, float]
    """By measure."""
    outcomes: dict[str, Outcome] = field(default_factory=dict)
    """By system."""
    failures: dict[str, str] = field(default_factory=dict)
    """What went wrong, of systems that gave no motion."""


@dataclass(frozen=True)
class Suite:
    """All scenes that are finished, in order."""

    plan: Plan
    scenes: tuple[Scene, ...]
    interrupted: bool = False

    @property
    def systems(self) -> tuple[str, ...]:
        """Names of the systems, in their order; none before the first scene is finished."""
        return self.scenes[0].systems if self.scenes else ()

    @property
    def counts(self) -> tuple[int, int]:
        """How many cells are within their bounds, and how many there are."""
        outcomes = [outcome for scene in self.scenes for outcome in scene.outcomes.values()]
        every = [cell for outcome in outcomes for cell in outcome.cells.values()]
        failed = sum(len(scene.failures) * len(scene.bounds) for scene in self.scenes)
        return sum(bool(cell.is_within) for cell in every), len(every) + failed


def run_suite(
    systems_of: SystemsOf,
    plan: Plan,
    *,
    during: Callable[[str], AbstractContextManager] = nullcontext,
) -> Suite:
    """Runs systems through the situations of a plan.

    KeyboardInterrupt (Ctrl-C) ends the suite; the finished situations are returned with
    `interrupted` set. A system that gives no motion is noted, and the others go on.

    Args:
        systems_of: makes the systems for a body.
        plan: which situations, and how long they are.
        during: makes a context for each situation, from its name.
    """
    scenes: list[Scene] = []
    try:
        for situation in plan.situations:
            with during(situation.name):
                scenes.append(_run(situation, systems_of, plan.seconds))
    except KeyboardInterrupt:
        return Suite(plan, tuple(scenes), interrupted=True)
    return Suite(plan, tuple(scenes))


def _run(situation: Situation, systems_of: SystemsOf, seconds: float) -> Scene:
    animation = situation.animation(seconds)
    systems = systems_of(animation.clip.rig)
    bounds = bounds_of(animation, is_flat=situation.is_flat)
    scene = Scene(situation, animation, tuple(systems), bounds)
    for name, ik in systems.items():
        try:
            scene.outcomes[name] = _outcome(animation, ik, bounds)
        except ValueError as error:
            scene.failures[name] = str(error)
    return scene


def _outcome(animation: Animation, ik: jaxik.FootIK, bounds: Mapping[str, float]) -> Outcome:
    animation.check_shapes(ik)
    result, solved = animation.solve(ik)
    placed, cause = animation.assess(solved)
    soles = placement.soles(solved, animation.clip, animation.terrain, animation.floor)
    reached = animation.reached(result)[animation.clip.stance_labels()]
    share = float(np.nanmean(reached)) if not np.isnan(reached).all() else float("nan")
    measured = cells(placed, pelvis_jerk(solved), share, bounds)
    return Outcome(solved, soles, placed, cause, measured)
