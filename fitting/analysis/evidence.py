"""Which clip, and which part of it, determines a parameter."""

import dataclasses
from collections.abc import Sequence
from typing import Literal

import jax.numpy as jnp
import numpy as np

import jaxik
from fitting.inference.profiles.profile import Profile
from fitting.problem.capture.system import system_and_scenes
from fitting.problem.loss import rho
from fitting.problem.problem import Problem
from fitting.runtime.precision import in_float64

from .playback import Playback, play_all

Side = Literal["below", "above"]
SPAN = 1.0  # s, length of the part of a clip that tells most


@dataclasses.dataclass(frozen=True)
class Evidence:
    """Where the cost rises when a parameter leaves its interval on one side."""

    side: Side
    value: float
    """To which the parameter moves, the others following; in its unit."""
    rises: tuple[float, ...]
    """Of the cost, clip by clip."""
    clip: int
    """In which it rises most."""
    start: float
    """s, of the second in which it rises most there."""
    share: float
    """Part of the clip's rise in that second."""
    kind: str
    """Of the residuals that rise most in it."""


@in_float64
def find_evidence(
    problem: Problem[jaxik.FootIK], solution: Sequence[Playback], profile: Profile
) -> tuple[Evidence, ...]:
    """What keeps a parameter from going below and above its interval, where the data do.

    Args:
        problem: with its clips.
        solution: the clips with the fitted system.
        profile: of the parameter.
    """
    names, evidence = problem.space.names, []
    before = _frame_costs(problem, solution)
    low, high = profile.interval
    below = np.flatnonzero((profile.values <= low) & (profile.data_rises > profile.max_rise))
    above = np.flatnonzero((profile.values >= high) & (profile.data_rises > profile.max_rise))
    sides: tuple[tuple[Side, np.ndarray], ...] = (("below", below[-1:]), ("above", above[:1]))
    for side, outside in sides:
        for k in outside:
            u = problem.space.pack(dict(zip(names, profile.path[k], strict=True)))
            moved = play_all(*system_and_scenes(problem, jnp.asarray(u)))
            after = _frame_costs(problem, moved)
            evidence.append(_evidence(problem, side, float(profile.values[k]), before, after))
    return tuple(evidence)


def _frame_costs(
    problem: Problem[jaxik.FootIK], playbacks: Sequence[Playback]
) -> list[dict[str, np.ndarray]]:
    """The cost of every frame, (frames), by kind of residual, clip by clip."""
    return [_frame_costs_of_clip(problem, playback) for playback in playbacks]


def _frame_costs_of_clip(
    problem: Problem[jaxik.FootIK], playback: Playback
) -> dict[str, np.ndarray]:
    frames, costs = len(playback.dt), {}
    fraction, tails = float(problem.weight), float(problem.tails)
    for kind, residuals in playback.residuals.items():
        squares = np.asarray(residuals).reshape(len(residuals), -1) ** 2
        of_loss = rho(squares, problem.loss, tails, np)
        missing = frames - len(residuals)  # an acceleration has no first and no last frame
        sides = missing // 2, missing - missing // 2
        costs[kind] = fraction * np.pad(0.5 * of_loss.sum(axis=1), sides)
    return costs


def _evidence(
    problem: Problem[jaxik.FootIK],
    side: Side,
    value: float,
    before: list[dict[str, np.ndarray]],
    after: list[dict[str, np.ndarray]],
) -> Evidence:
    rises = [
        {kind: moved[kind] - present[kind] for kind in present}
        for present, moved in zip(before, after, strict=True)
    ]
    total = [sum(by_kind.values()) for by_kind in rises]
    clip = int(np.argmax([np.sum(rise) for rise in total]))
    dt = np.asarray(problem.data[clip].frames.dt)
    time = np.cumsum(dt) - dt[0]
    ends = np.searchsorted(time, time + SPAN)
    running = np.concatenate([[0.0], np.cumsum(total[clip])])
    begin = int(np.argmax(running[ends] - running[:-1]))
    window = slice(begin, int(ends[begin]))
    positive = np.clip(total[clip], 0, None)
    return Evidence(
        side=side,
        value=value,
        rises=tuple(float(np.sum(rise)) for rise in total),
        clip=clip,
        start=float(time[begin]),
        share=float(positive[window].sum() / max(positive.sum(), 1e-12)),
        kind=max(rises[clip], key=lambda kind: float(rises[clip][kind][window].sum())),
    )
