"""What a clip asks of a system: how often limits act, feet lock and decisions change."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxik
from fitting.inference.identifiability import NUDGE
from fitting.problem.problem import Problem
from fitting.problem.residuals import Scene
from fitting.runtime import program_cache
from jaxik.maths import parameter_tree

CHANGED = 1e-7  # m, and of quaternions: a smaller difference is rounding


@dataclasses.dataclass(frozen=True)
class Exercise:
    """What one clip asks of a system; shares are 0..1."""

    legs: tuple[str, ...]
    frames: int
    seconds: float
    found: Float[np.ndarray, " legs"]  # share of frames with ground under the foot
    standing: Float[np.ndarray, " legs"]  # share of frames with any contact
    reached: Float[np.ndarray, " legs"]  # share of frames with the ankle at its target
    locked: Float[np.ndarray, " legs"]  # share of frames
    locks: tuple[int, ...]  # how often each foot locks
    releases: tuple[int, ...]
    limits: dict[str, float]  # share of frames in which a limit changes the pose, by name


def exercise(ik: jaxik.FootIK, scene: Scene) -> Exercise:
    """What the scene's clip asks of this system."""
    result = program_cache.run(ik, scene.rig, scene.terrain, scene.frames)
    present = np.asarray(scene.rig.present)
    locked = np.asarray(result.trace.advanced.held.locked)[:, present] > 0.5
    turns = np.diff(locked.astype(int), axis=0)

    def share(flags: Array) -> np.ndarray:
        return (np.asarray(flags)[:, present] > 0).mean(axis=0)

    return Exercise(
        legs=tuple(n for n, here in zip(scene.rig.names, present, strict=True) if here),
        frames=len(locked),
        seconds=float(np.sum(scene.frames.dt)),
        found=share(result.trace.sensed.foothold.found),
        standing=share(result.trace.sensed.contact.weight),
        reached=share(result.reached),
        locked=share(result.trace.advanced.held.locked),
        locks=tuple(int(n) for n in (turns > 0).sum(axis=0)),
        releases=tuple(int(n) for n in (turns < 0).sum(axis=0)),
        limits=active_limits(ik, scene, result),
    )


def active_limits(ik: jaxik.FootIK, scene: Scene, result: jaxik.Result) -> dict[str, float]:
    """Share of frames that would look different if a limit were moved to the end of its range.

    Each frame is stepped from the memory that it really had, so that it counts only for what the
    limit does in it. Limits are the smooth parameters named `limit`, `max_…` or `min_…`.
    """
    init, states = jaxik.init(ik, scene.rig), result.trace.advanced.state
    before = jax.tree.map(
        lambda first, rest: jnp.concatenate([first[None], rest[:-1]]), init, states
    )
    as_is = _step_each(ik, scene, before)
    found = {}
    for name, declared in parameter_tree.declarations(ik).items():
        leaf = name.rpartition(".")[2]
        if declared.kind == "threshold" or not (leaf == "limit" or leaf[:4] in ("max_", "min_")):
            continue
        value = parameter_tree.get(ik, name)
        lowest, highest = jnp.minimum(value, declared.low), jnp.maximum(value, declared.high)
        free = lowest if leaf[:4] == "min_" else highest
        without = _step_each(parameter_tree.replace(ik, {name: free}), scene, before)
        found[name] = float(np.mean(_differ(as_is, without)))
    return found


def flipped_decisions(
    problem: Problem, u: Float[np.ndarray, " free"]
) -> dict[str, tuple[float, float]]:
    """By threshold: share of the feet's decisions that change when it moves down and up.

    It moves by a tenth of its range, but not beyond it, the other values being kept. Decisions are
    those of every foot in every frame: planted, lifted, locked, and whether it has found ground.
    """
    space = problem.space
    values = dict(zip(space.names, np.asarray(space.values(jnp.asarray(u))), strict=True))

    def decisions(moved: dict) -> np.ndarray:
        ik = space.unpack(space.pack(values | moved))
        return np.concatenate(
            [
                _decisions(program_cache.run(ik, scene.rig, scene.terrain, scene.frames))
                for scene in problem.data
            ]
        )

    here, found = decisions({}), {}
    for one in space.parameters:
        if one.kind == "threshold":
            sides = values[one.name] + np.array([-NUDGE, NUDGE]) * (one.high - one.low)
            down, up = (
                float(np.mean(decisions({one.name: side}) != here))
                for side in np.clip(sides, one.low, one.high)
            )
            found[one.name] = down, up
    return found


def _decisions(result: jaxik.Result) -> np.ndarray:
    sensed, held = result.trace.sensed, result.trace.advanced.held
    every = (
        sensed.contact.planted,
        sensed.contact.lifted,
        held.locked,
        sensed.foothold.found,
    )
    return np.stack([np.asarray(one) > 0.5 for one in every], axis=-1).ravel()


@program_cache.cached
def _step_each(ik: jaxik.FootIK, scene: Scene, before: jaxik.State) -> tuple[Array, ...]:
    """Body and legs of every frame, each stepped from its own memory."""

    def one(state: jaxik.State, frame: jaxik.Frame) -> tuple[Array, ...]:
        result = jaxik.step(ik, scene.rig, scene.terrain, state, frame)[1]
        ankle, body = result.pose.ankle, result.body
        return body.pos, body.rot, ankle.pos, ankle.rot, result.pose.knee.pos

    return jax.vmap(one)(before, scene.frames)


def _differ(a: tuple[Array, ...], b: tuple[Array, ...]) -> np.ndarray:
    """Frames in which anything differs."""
    apart = [
        np.abs(np.asarray(x - y)).reshape(len(x), -1).max(axis=1) for x, y in zip(a, b, strict=True)
    ]
    return np.max(apart, axis=0) > CHANGED
