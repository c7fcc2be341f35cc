"""Which clip, and which part of it, determines a parameter."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Literal

import jax.numpy as jnp
import numpy as np

import jaxik
from fitting.inference.profiles.profile import Profile
from fitting.problem.capture_system import system_and_scenes
from fitting.problem.problem import Problem, rho
from fitting.problem.space import FreeParameter
from fitting.runtime.precision import in_float64

from .playback import Playback, play_all

Side = Literal["below", "above"]
SPAN = 1.0  # s, length of the most informative part of a clip

# Motion beyond a limit; in brackets by how much, where the clip shows up to which value the limit
# has no effect. Angles of feet are against their shins, which lean like the ground.
AT_LIMITS = {
    "foot.max_pitch": "a foot turned toes up[ beyond {}] against its shin, as on a slope up",
    "foot.min_pitch": "a foot turned toes down[ beyond {}] against its shin, as on a way down",
    "foot.max_roll": "a foot turned outer edge up[ beyond {}], as on a slope across the way",
    "foot.min_roll": "a foot turned outer edge down[ beyond {}], as on a slope across the way",
    "foot.max_tilt": "ground[ steeper than {}] under a foot",
    "pelvis.limit": "steps or slopes that move the pelvis up or down[ by more than {}]",
    "pelvis.max_length": "a leg stretched[ beyond {}] from hip to ankle, as on a step down",
    "pelvis.min_length": "a leg shortened[ below {}] from hip to ankle, as in a crouch",
    "leg.max_knee_angle": "a leg stretched[ beyond a knee angle of {}], as at the end of a stride",
    "leg.min_knee_angle": "a knee bent[ below {}], as on a high step or in a crouch",
    "lock.release_distance": "a locked foot that its animation carries away[ by more than {}]",
    "lock.max_speed": "a foot that comes down[ faster than {}]",
    "probe.max_step_up": "steps up[ higher than {}]",
    "probe.max_step_down": "steps down[ deeper than {}]",
    "probe.max_slope": "slopes[ steeper than {}]",
}
EVENTS = {  # motion without which a parameter has no effect
    "pelvis.airborne_half_life": "a run: moments without a foot on the ground",
    "lock.lock_half_life": "steps: feet that still move when they lock",
    "lock.unlock_half_life": "steps: locked feet that are released away from their animation",
    "target.rise_half_life": "steps or slopes up: ground that becomes higher",
    "target.fall_half_life": "steps or slopes down: ground that becomes lower",
    "lean.forward_rate": "a slope along the way",
    "lean.side_rate": "a slope across the way",
    "contact.planted_height": "steps: feet that come down to the ground",
    "contact.raised_height": "steps: feet that leave the ground",
}


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
    """The frames that bound a parameter's interval below and above, where the data do.

    The solution is the clips with the fitted system.
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
    weight, tails = float(problem.weight), float(problem.tails)

    def costs(frames: int, residuals: np.ndarray) -> np.ndarray:
        squares = residuals.reshape(len(residuals), -1) ** 2
        of_loss = rho(squares, problem.loss, tails)
        missing = frames - len(residuals)  # an acceleration has no first and no last frame
        sides = missing // 2, missing - missing // 2
        return weight * np.pad(0.5 * of_loss.sum(axis=1), sides)

    return [
        {kind: costs(len(playback.dt), np.asarray(r)) for kind, r in playback.residuals.items()}
        for playback in playbacks
    ]


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


def describe_missing_motion(
    parameter: FreeParameter, unit: str, doc: str, profile: Profile, active: float | None
) -> str:
    """The motion that a clip lacks, with the figure to exceed where there is one.

    The parameter is not determined; `doc` is its declared meaning. For a limit, `active` is the
    fraction of frames in which it changes the pose.
    """
    leaf = parameter.leaf
    low, high = profile.interval
    if profile.verdict == "several valleys":
        places = " or ".join(_with_unit(v.value, unit) for v in profile.minima)
        return f"motion that differs between {places}; which one is not known"
    if leaf in AT_LIMITS:
        is_lowest = leaf.rpartition(".")[2].startswith("min_")
        unpassed, unbounded = (high, "at most") if is_lowest else (low, "at least")
        reached = profile.verdict == unbounded
        return _filled(AT_LIMITS[leaf], _with_unit(abs(unpassed), unit) if reached else None)
    if leaf in EVENTS:
        return EVENTS[leaf]
    if active is not None:
        frames = f"it acts in {100 * active:.1f} % of the frames"
        return f"motion that reaches this limit ({frames}): {doc}"
    return f"not known; its effect: {doc}"


def _filled(phrase: str, figure: str | None) -> str:
    """The phrase with the figure in its brackets, or without them."""
    before, _, rest = phrase.partition("[")
    bound, _, after = rest.partition("]")
    return before + ("" if figure is None else bound.format(figure)) + after


def _with_unit(value: float, unit: str) -> str:
    if unit == "rad":
        return f"{math.degrees(value):.0f}°"
    return f"{value:.3g}" + ("" if unit == "1" else f" {unit}")
