"""A small system with the structure of foot IK: a scan over frames and two legs, with hysteresis.

A foot is locked while it is near the ground and slow. Its anchor follows it while it is free and
freezes when it locks. Offsets, pelvis and pitch are smoothed and clamped. Metres, seconds, radians.
"""

import dataclasses
import functools
from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.inference.optimise import search
from fitting.inference.optimise.solution import Solution
from fitting.problem.problem import Problem
from jaxik.maths import smoothing
from jaxik.maths.gate import HARD

from .problems import parameter, problem_of

SIGMAS = (0.002, 0.002, 0.02)  # m of positions and pelvis, rad of pitches
SEED = 5  # of a clip that determines every threshold
FRAMES = 400


class Lock(eqx.Module):
    height_on: Array = parameter(0.06, "m", 0.01, 0.12, kind="threshold")
    height_off: Array = parameter(0.10, "m", 0.02, 0.2, kind="threshold", above="height_on")
    speed_on: Array = parameter(0.6, "m/s", 0.1, 1.5, kind="threshold")
    speed_off: Array = parameter(1.2, "m/s", 0.2, 2.5, kind="threshold", above="speed_on")
    half_life: Array = parameter(0.06, "s", 0.01, 0.3, scale="log")
    release: Array = parameter(0.1, "s", 0.01, 0.5, scale="log")


class Body(eqx.Module):
    half_life: Array = parameter(0.065, "s", 0.01, 1.2, scale="log")
    drop: Array = parameter(0.15, "m", 0.0, 0.4)
    rise: Array = parameter(0.05, "m", 0.0, 0.2)


class Foot(eqx.Module):
    share: Array = parameter(0.6, "1", 0.0, 1.2)
    limit: Array = parameter((0.4, 0.4), "rad", 0.1, 0.8)
    half_life: Array = parameter(0.08, "s", 0.01, 0.4, scale="log")
    idle: Array = parameter(0.5, "1", 0.0, 1.0)  # does nothing


class Toy(eqx.Module):
    lock: Lock = eqx.field(default_factory=Lock)
    body: Body = eqx.field(default_factory=Body)
    foot: Foot = eqx.field(default_factory=Foot)


class Data(eqx.Module):
    """Animation and ground, per frame and leg, and the motion that was observed."""

    pos: Float[Array, "frames legs"]  # m, along the way
    height: Float[Array, "frames legs"]  # m, above the ground
    ground: Float[Array, "frames legs"]  # m
    slope: Float[Array, "frames legs"]  # rad
    dt: Float[Array, ""]  # s
    observed: tuple[Array, ...] = ()  # pos, pelvis, pitch


TRUTH = {
    "lock.height_on": 0.042,
    "lock.height_off": 0.078,
    "lock.speed_on": 0.42,
    "lock.speed_off": 0.95,
    "lock.half_life": 0.04,
    "lock.release": 0.15,
    "body.half_life": 0.124,
    "body.drop": 0.11,
    "body.rise": 0.03,
    "foot.share": 0.85,
    "foot.limit[0]": 0.28,
    "foot.limit[1]": 0.36,
    "foot.half_life": 0.05,
}
NAMES = (*TRUTH, "foot.idle")


def run(ik: Toy, data: Data) -> tuple[Array, Array, Array]:
    """Foot positions, pelvis height and foot pitches over the frames."""
    lock, body, foot, dt = ik.lock, ik.body, ik.foot, data.dt

    def step(state: tuple[Array, ...], frame: tuple[Array, ...]):
        before, anchor, offset, locked, pelvis, pitch = state
        pos, height, ground, slope = frame
        speed = jnp.abs(pos - before) / dt
        near = HARD.below(height, HARD.choose(locked, lock.height_off, lock.height_on), band=0.01)
        slow = HARD.below(speed, HARD.choose(locked, lock.speed_off, lock.speed_on), band=0.1)
        locked = near * slow
        anchor = HARD.choose(locked, anchor, pos)
        half_life = HARD.choose(locked, lock.half_life, lock.release)
        share = smoothing.fraction_of_half_life(half_life, dt)
        offset = smoothing.lerp(offset, locked * (anchor - pos), share)
        goal = HARD.clip(HARD.minimum(ground, band=0.01), -body.drop, body.rise, band=0.01)
        pelvis = smoothing.lerp(pelvis, goal, smoothing.fraction_of_half_life(body.half_life, dt))
        tilt = HARD.clip(foot.share * slope, -foot.limit, foot.limit, band=0.03)
        pitch = smoothing.lerp(pitch, tilt, smoothing.fraction_of_half_life(foot.half_life, dt))
        return (pos, anchor, offset, locked, pelvis, pitch), (pos + offset, pelvis, pitch)

    first = data.pos[0]
    zero = jnp.zeros_like(first)
    start = (first, first, zero, zero, zero[0], zero)
    frames = (data.pos, data.height, data.ground, data.slope)
    return jax.lax.scan(step, start, frames)[1]


def residuals(ik: Toy, data: Data) -> Array:
    """Residuals in sigmas."""
    parts = zip(run(ik, data), data.observed, SIGMAS, strict=True)
    return jnp.concatenate(
        [((modelled - observed) / sigma).ravel() for modelled, observed, sigma in parts]
    )


def make_clip(seed: int) -> Data:
    """A walk of changing stride, speed and lift over rough ground."""
    random = np.random.default_rng(seed)
    fps = 60.0
    time = np.arange(FRAMES) / fps
    phase = 2 * np.pi * np.cumsum(1.0 + 0.3 * np.sin(0.9 * time + random.uniform(0, 6))) / fps
    legs = np.stack([phase, phase + np.pi], axis=1)
    wander = np.sin(0.7 * time + random.uniform(0, 6))[:, None]
    drift = 0.25 * (1.2 + wander) * (1.0 + 0.5 * np.sin(5.3 * time + random.uniform(0, 6)))[:, None]
    swing = np.clip(np.sin(legs), 0, None)
    speed = drift + 2.2 * swing**2 + random.normal(0, 0.12, (FRAMES, 2))
    height = (
        0.03 * (1 + 0.6 * np.sin(3.1 * legs)) + 0.16 * swing + random.normal(0, 0.008, (FRAMES, 2))
    )
    waves = [
        random.uniform(0.04, 0.1) * np.sin(rate * time[:, None] + random.uniform(0, 6, 2))
        for rate in (0.8, 1.7, 3.1)
    ]
    slopes = [0.3 * np.sin(rate * time[:, None] + random.uniform(0, 6, 2)) for rate in (1.1, 2.9)]
    return Data(
        pos=jnp.asarray(np.cumsum(speed, axis=0) / fps),
        height=jnp.asarray(height),
        ground=jnp.asarray(sum(waves)),
        slope=jnp.asarray(sum(slopes)),
        dt=jnp.asarray(1.0 / fps),
    )


def make_problem(
    seed: int = SEED, names: tuple[str, ...] = NAMES, truth: Mapping[str, float] = TRUTH
) -> Problem:
    """A problem that starts at the defaults; its motion is that of the truth, with noise."""
    clip, random = make_clip(seed), np.random.default_rng(seed + 1000)
    known = problem_of(Toy(), tuple(TRUTH), None, residuals).space
    motion = zip(run(known.unpack(known.pack(truth)), clip), SIGMAS, strict=True)
    observed = tuple(clean + random.normal(0, sigma, clean.shape) for clean, sigma in motion)
    return problem_of(Toy(), names, dataclasses.replace(clip, observed=observed), residuals)


@functools.cache
def solved() -> tuple[Problem, Solution]:
    """A problem and its solution, computed once for all tests."""
    problem = make_problem()
    return problem, search.find_best_fit(problem)
