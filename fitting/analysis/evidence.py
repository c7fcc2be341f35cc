"""Which clip, and which part of it, determines a parameter."""

import dataclasses
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxik
from fitting.inference.profiles.profile import Profile
from fitting.problem.loss import Loss, apply_loss
from fitting.problem.problem import Problem
from fitting.problem.residuals import errors_by_kind, residuals_by_kind
from fitting.problem.scene import Scene
from fitting.problem.shared_world import run_scenes
from fitting.runtime.precision import in_float64
from fitting.runtime.program_cache import cached

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
    problem: Problem[jaxik.FootIK], u: Float[np.ndarray, " free"], profile: Profile
) -> tuple[Evidence, ...]:
    """What keeps a parameter from going below and above its interval, where the data do.

    Args:
        problem: with its clips.
        u: the solution.
        profile: of the parameter.
    """
    names, evidence = problem.space.names, []
    before = _costs(problem, u)
    low, high = profile.interval
    below = np.flatnonzero((profile.values <= low) & (profile.data_rises > profile.max_rise))
    above = np.flatnonzero((profile.values >= high) & (profile.data_rises > profile.max_rise))
    sides: tuple[tuple[Side, np.ndarray], ...] = (("below", below[-1:]), ("above", above[:1]))
    for side, outside in sides:
        for k in outside:
            moved = problem.space.pack(dict(zip(names, profile.path[k], strict=True)))
            evidence.append(
                _evidence(problem, side, float(profile.values[k]), before, _costs(problem, moved))
            )
    return tuple(evidence)


def _costs(problem: Problem[jaxik.FootIK], u: Array | np.ndarray) -> list[dict[str, np.ndarray]]:
    """The cost of every frame by kind of residual, clip by clip."""
    ik, fraction = problem.space.unpack(jnp.asarray(u)), float(problem.independent_fraction)
    return [
        {kind: fraction * np.asarray(cost) for kind, cost in costs.items()}
        for costs in _frame_costs(ik, problem.data, problem.loss, problem.tails)
    ]


@cached
def _frame_costs(
    ik: jaxik.FootIK, scenes: tuple[Scene, ...], loss: Loss, tails: Float[Array, ""]
) -> list[dict[str, Array]]:
    """The cost of every frame, (frames), by kind of residual, clip by clip."""
    pairs = zip(scenes, run_scenes(ik, scenes), strict=True)
    return [_costs_of_result(scene, result, loss, tails) for scene, result in pairs]


def _costs_of_result(
    scene: Scene, result: jaxik.Result, loss: Loss, tails: Float[Array, ""]
) -> dict[str, Array]:
    frames, costs = len(scene.frames.dt), {}
    for kind, residuals in residuals_by_kind(scene, errors_by_kind(scene, result)).items():
        squares = apply_loss(residuals.ravel(), loss, tails).reshape(len(residuals), -1) ** 2
        missing = frames - len(residuals)  # an acceleration has no first and no last frame
        costs[kind] = jnp.pad(0.5 * squares.sum(axis=1), (missing // 2, missing - missing // 2))
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
