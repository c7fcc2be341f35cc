"""What a clip demands of a system: how often limits act, feet lock and decisions change."""

import dataclasses
from collections.abc import Sequence
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import jaxik
from fitting.inference.optimisation import population
from fitting.problem.capture.system import system_and_scenes
from fitting.problem.problem import Problem
from fitting.problem.scene import Scene, own_system
from fitting.problem.shared_world import groups, in_a_row, moved_out, row_of, split
from fitting.runtime import program_cache
from jaxik.maths import parameter_tree

from .playback import run_all, stage_outputs

NUDGE = 0.1  # fraction of its range by which a threshold is moved to see what changes
Poses: TypeAlias = tuple[Array, ...]  # of body and legs, (frames, ...) each
ROUNDING = 1e-7  # m, and in quaternions: smaller changes of a pose are rounding


@dataclasses.dataclass(frozen=True)
class ClipActivity:
    """What one clip demands of a system; fractions are of the clip's frames."""

    legs: tuple[str, ...]
    frames: int
    seconds: float
    grounded: Float[np.ndarray, " legs"]
    """Fraction with ground under the foot."""
    in_contact: Float[np.ndarray, " legs"]
    """Fraction with a contact weight above 0."""
    reached: Float[np.ndarray, " legs"]
    """Fraction with the ankle at its target."""
    locked: Float[np.ndarray, " legs"]
    """Fraction."""
    locks: tuple[int, ...]
    """How often each foot locks."""
    releases: tuple[int, ...]
    limits: dict[str, float]
    """Fraction in which a limit changes the pose, by parameter name."""


def measure(
    ik: jaxik.FootIK, scenes: Sequence[Scene], results: Sequence[jaxik.Result]
) -> list[ClipActivity]:
    """What the clip of each scene demands of a system.

    Args:
        ik: the system.
        scenes: the clips with their terrains.
        results: of this system on these scenes, such as `playback.run_all` gives.
    """
    limits = active_limits(ik, scenes, results)
    return [_measured(*clip) for clip in zip(scenes, results, limits, strict=True)]


def _measured(scene: Scene, result: jaxik.Result, limits: dict[str, float]) -> ClipActivity:
    trace, present = stage_outputs(result), np.asarray(scene.rig.present)
    locked = np.asarray(trace.advanced.hold.locked)[:, present] > 0.5
    switches = np.diff(locked.astype(int), axis=0)

    def fraction(weights: Array) -> np.ndarray:
        return (np.asarray(weights)[:, present] > 0).mean(axis=0)

    return ClipActivity(
        legs=tuple(n for n, here in zip(scene.rig.names, present, strict=True) if here),
        frames=len(locked),
        seconds=float(np.sum(scene.frames.dt)),
        grounded=fraction(trace.sensed.foothold.found),
        in_contact=fraction(trace.sensed.contact.weight),
        reached=fraction(result.reached),
        locked=fraction(trace.advanced.hold.locked),
        locks=tuple(int(n) for n in (switches > 0).sum(axis=0)),
        releases=tuple(int(n) for n in (switches < 0).sum(axis=0)),
        limits=limits,
    )


def active_limits(
    ik: jaxik.FootIK, scenes: Sequence[Scene], results: Sequence[jaxik.Result]
) -> list[dict[str, float]]:
    """Fraction of each clip's frames that would differ with a limit at the end of its range.

    Each frame is stepped from the state in which the system was before it, so that only what the
    limit does in this frame counts. Limits are the smooth parameters named `limit`, `max_…` or
    `min_…`.
    """
    pairs = zip(scenes, results, strict=True)
    before = [_states_before(ik, scene, result) for scene, result in pairs]
    limited = _step_all(ik, scenes, before)
    fractions: list[dict[str, float]] = [{} for _ in scenes]
    for name, declared in parameter_tree.declarations(ik).items():
        leaf = name.rpartition(".")[2]
        if declared.kind == "threshold" or not (leaf == "limit" or leaf[:4] in ("max_", "min_")):
            continue
        value = parameter_tree.get(ik, name)
        lowest, highest = jnp.minimum(value, declared.low), jnp.maximum(value, declared.high)
        end = lowest if leaf[:4] == "min_" else highest
        unlimited = _step_all(parameter_tree.replace(ik, {name: end}), scenes, before)
        for of_clip, *poses in zip(fractions, limited, unlimited, strict=True):
            of_clip[name] = float(np.mean(_differ(*poses)))
    return fractions


def _states_before(ik: jaxik.FootIK, scene: Scene, result: jaxik.Result) -> jaxik.State:
    """The memory before each frame."""
    first = jaxik.init(own_system(ik, scene), scene.rig)
    states = stage_outputs(result).advanced.state
    return jax.tree.map(
        lambda start, rest: jnp.concatenate([start[None], rest[:-1]]), first, states
    )


@dataclasses.dataclass(frozen=True)
class Nudge:
    """What changes when one threshold moves by a tenth of its range."""

    flipped: float
    """Fraction of the feet's decisions."""
    rise: float
    """Of the cost."""


def nudge_thresholds(
    problem: Problem, u: Float[np.ndarray, " free"]
) -> dict[str, tuple[Nudge, Nudge]]:
    """What changes when a threshold moves down and up, by name.

    Each threshold moves by a tenth of its range, but not beyond it, and the other parameters keep
    their values. The decisions are those of every foot in every frame: planted, lifted, locked, and
    whether ground was found.
    """
    space = problem.space
    values = dict(zip(space.names, np.asarray(space.values(jnp.asarray(u))), strict=True))

    def decisions(packed: Array) -> Bool[np.ndarray, " decisions"]:
        results = run_all(*system_and_scenes(problem, packed))
        return np.concatenate([_decisions(result) for result in results])

    def nudge(name: str, value: float) -> Nudge:
        moved = space.pack(values | {name: value})
        flipped = float(np.mean(decisions(moved) != unmoved))
        both = population.evaluate(problem, np.stack([u, np.asarray(moved)])).cost
        return Nudge(flipped, float(both[1] - both[0]))

    unmoved, nudges = decisions(space.pack(values)), {}
    for parameter in space.parameters:
        if parameter.kind == "threshold":
            distance = NUDGE * (parameter.high - parameter.low)
            ends = values[parameter.name] + np.array([-distance, distance])
            down, up = np.clip(ends, parameter.low, parameter.high)
            nudges[parameter.name] = nudge(parameter.name, down), nudge(parameter.name, up)
    return nudges


def _decisions(result: jaxik.Result) -> Bool[np.ndarray, " decisions"]:
    trace = stage_outputs(result)
    sensed, held = trace.sensed, trace.advanced.hold
    weights = (sensed.contact.planted, sensed.contact.lifted, held.locked, sensed.foothold.found)
    return np.stack([np.asarray(weight) > 0.5 for weight in weights], axis=-1).ravel()


def _step_all(
    ik: jaxik.FootIK, scenes: Sequence[Scene], before: Sequence[jaxik.State]
) -> list[Poses]:
    """Body and legs of every frame of each clip, each stepped from its own state."""
    poses: dict[int, Poses] = {}
    for numbers in groups(scenes):
        members = tuple(scenes[number] for number in numbers)
        states = tuple(before[number] for number in numbers)
        poses |= zip(numbers, _step_each(ik, members, states), strict=True)
    return [poses[number] for number in range(len(scenes))]


@program_cache.cached
def _step_each(
    ik: jaxik.FootIK, scenes: tuple[Scene, ...], before: tuple[jaxik.State, ...]
) -> list[Poses]:
    """The same for one clip, or for several that share a world."""
    row = row_of(ik, scenes)

    def step(state: jaxik.State, frame: jaxik.Frame, values: dict[str, Array]) -> Poses:
        at = parameter_tree.replace(row.ik, values) if values else row.ik
        result = jaxik.step(at, row.rig, row.terrain, state, frame)[1]
        ankle, body = result.pose.ankle, result.body
        return body.pos, body.rot, ankle.pos, ankle.rot, result.pose.knee.pos

    if len(scenes) > 1:
        before = tuple(map(moved_out, before, scenes))
    return split(jax.vmap(step)(in_a_row(before), row.frames, row.tracks), scenes)


def _differ(a: Poses, b: Poses) -> Bool[np.ndarray, " frames"]:
    """Frames in which anything differs."""
    changes = [
        np.abs(np.asarray(x - y)).reshape(len(x), -1).max(axis=1) for x, y in zip(a, b, strict=True)
    ]
    return np.max(changes, axis=0) > ROUNDING
