"""What a clip demands of a system: how often limits act, feet lock and decisions change."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import jaxik
from fitting.inference.optimisation import population
from fitting.problem.problem import Problem
from fitting.problem.scene import Scene, own_system
from fitting.runtime import program_cache
from jaxik.maths import parameter_tree

from .playback import run, stage_outputs

NUDGE = 0.1  # fraction of its range by which a threshold is moved to see what changes
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


def measure(ik: jaxik.FootIK, scene: Scene, result: jaxik.Result) -> ClipActivity:
    """What the scene's clip demands of a system.

    Args:
        ik: the system.
        scene: the clip with its terrain.
        result: of this system on this scene, such as `playback.run` gives.
    """
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
        limits=active_limits(ik, scene, result),
    )


def active_limits(ik: jaxik.FootIK, scene: Scene, result: jaxik.Result) -> dict[str, float]:
    """Fraction of frames that would look different with a limit moved to the end of its range.

    Each frame is stepped from the state in which the system was before it, so that only what the
    limit does in this frame counts. Limits are the smooth parameters named `limit`, `max_…` or
    `min_…`.
    """
    first = jaxik.init(own_system(ik, scene), scene.rig)
    states = stage_outputs(result).advanced.state
    before = jax.tree.map(
        lambda start, rest: jnp.concatenate([start[None], rest[:-1]]), first, states
    )
    limited = _step_each(ik, scene, before)
    fractions = {}
    for name, declared in parameter_tree.declarations(ik).items():
        leaf = name.rpartition(".")[2]
        if declared.kind == "threshold" or not (leaf == "limit" or leaf[:4] in ("max_", "min_")):
            continue
        value = parameter_tree.get(ik, name)
        lowest, highest = jnp.minimum(value, declared.low), jnp.maximum(value, declared.high)
        end = lowest if leaf[:4] == "min_" else highest
        unlimited = _step_each(parameter_tree.replace(ik, {name: end}), scene, before)
        fractions[name] = float(np.mean(_differ(limited, unlimited)))
    return fractions


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
        results = [run(space.unpack(packed), scene) for scene in problem.data]
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


@program_cache.cached
def _step_each(ik: jaxik.FootIK, scene: Scene, before: jaxik.State) -> tuple[Array, ...]:
    """Body and legs of every frame, each stepped from its own state."""
    own = own_system(ik, scene)

    def step(state: jaxik.State, frame: jaxik.Frame, values: dict[str, Array]) -> tuple[Array, ...]:
        at = parameter_tree.replace(own, values) if values else own
        result = jaxik.step(at, scene.rig, scene.terrain, state, frame)[1]
        ankle, body = result.pose.ankle, result.body
        return body.pos, body.rot, ankle.pos, ankle.rot, result.pose.knee.pos

    return jax.vmap(step)(before, scene.frames, scene.tracks)


def _differ(a: tuple[Array, ...], b: tuple[Array, ...]) -> Bool[np.ndarray, " frames"]:
    """Frames in which anything differs."""
    changes = [
        np.abs(np.asarray(x - y)).reshape(len(x), -1).max(axis=1) for x, y in zip(a, b, strict=True)
    ]
    return np.max(changes, axis=0) > ROUNDING
