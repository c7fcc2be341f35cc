"""Random states of a standing character: it sits, crouches, is pushed, turns, is in the air."""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float32

import jaxik
from jaxik.world import terrain
from support.cases import QUICK
from support.clips import animate, make_rig, to_frames, to_rig

FRAMES, HZ = 120, 60.0
KINDS = ("sit", "crouch", "push", "yaw", "airborne", "weights")
CELLS, SPACING, TERRACES = 48, 0.1, 6  # of the ground, m between heights, terraces on a side
PERIOD = 2.0  # s, of the slowest motion to and fro
SKY = 50.0  # m, height of a ceiling that nothing reaches


class State(NamedTuple):
    """A character in a state on terraces, perhaps under a ceiling."""

    kind: str
    frames: jaxik.Frame
    heights: Float32[Array, "cells cells"]
    """m, of the ground."""
    ceiling: float
    """m, its height."""


class Motion(NamedTuple):
    """What foot IK does to a state, at most in any frame of 1/60 s."""

    pop: float
    """m, by which an ankle's correction changes."""
    body: float
    """m, by which that of the body does."""
    far: float
    """m, of an ankle's correction."""


def sample(rng: np.random.Generator) -> State:
    """A random state of a random kind."""
    kind, motion = str(rng.choice(KINDS)), {}
    grounded = np.ones(FRAMES)
    match kind:
        case "sit":
            motion["hip_height"] = to_and_fro(rng, 0.90, rng.uniform(0.45, 0.55))
            grounded = 1.0 - np.clip(np.linspace(-2.0, 3.0, FRAMES), 0.0, 1.0)
        case "crouch":
            motion["hip_height"] = to_and_fro(rng, 0.90, rng.uniform(0.42, 0.7))
        case "push":
            away = rng.uniform(-0.4, 0.4, 2)
            motion["place"] = lambda time: np.array([away[0] * time, 0.0, away[1] * time])
        case "yaw":
            speed = rng.uniform(-2.0, 2.0)
            motion["heading"] = lambda time: speed * time
        case "airborne":
            height = to_and_fro(rng, 0.0, rng.uniform(0.1, 0.5))
            motion["place"] = lambda time: np.array([0.0, height(time), 0.0])
            grounded = np.array([float(height(n / HZ) < 0.02) for n in range(FRAMES)])
        case "weights":
            left, right = (to_and_fro(rng, *rng.permutation([0.0, 1.0])) for _ in range(2))
            motion["weight"] = lambda time: np.array([left(time), right(time)])
    frames = to_frames(animate(make_rig(), count=FRAMES, hz=HZ, **motion))
    frames = dataclasses.replace(frames, grounded=jnp.asarray(grounded, frames.grounded.dtype))
    steps = rng.choice([0.0, 0.05, 0.12], size=(TERRACES, TERRACES)) * (rng.uniform() < 0.8)
    heights = np.kron(steps, np.ones((CELLS // TERRACES, CELLS // TERRACES)))
    ceiling = rng.uniform(2.2, 8.0) if rng.uniform() < 0.5 else SKY
    return State(kind, frames, jnp.asarray(heights, jnp.float32), ceiling)


def to_and_fro(rng: np.random.Generator, first: float, other: float) -> Callable[[float], float]:
    """A smooth function of time, s, between two values."""
    period = rng.uniform(0.8, 1.0) * PERIOD
    return lambda time: first + (other - first) * 0.5 * (1.0 - np.cos(2.0 * np.pi * time / period))


@functools.partial(jax.jit, compiler_options=QUICK)
def solve(ik: jaxik.FootIK, state: tuple[jaxik.Frame, Array, Array]) -> jaxik.Result:
    """The frames on the heights of their ground, under a ceiling."""
    frames, heights, ceiling = state
    corner = -0.5 * CELLS * SPACING
    fields = (
        terrain.heightfield(height, (SPACING, SPACING), origin=(corner, 0.0, corner))
        for height in (heights, jnp.broadcast_to(ceiling, heights.shape))
    )
    return jaxik.run(ik, to_rig(make_rig()), terrain.combine(*fields), frames)


def motion_of(ik: jaxik.FootIK, state: State) -> Motion:
    """What a system does to a state; not a number if anything is not finite."""
    result = solve(ik, (state.frames, state.heights, jnp.float32(state.ceiling)))
    ankle, body = (np.asarray(x) for x in (result.pose.ankle.pos, result.body.pos))
    correction = ankle - np.asarray(state.frames.pose.ankle.pos)
    pop, moved = (np.linalg.norm(np.diff(x, axis=0), axis=-1).max() for x in (correction, body))
    return Motion(float(pop), float(moved), float(np.linalg.norm(correction, axis=-1).max()))
