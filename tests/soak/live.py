"""Characters that live through everything that goes wrong in a game, checked in every frame."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import fitting
import jaxik
from jaxik.maths import vec
from jaxik.maths.struct import struct
from jaxik.world import terrain
from jaxik.world.terrain import Terrain

DATA = Path(__file__).parents[2] / "data"
PRESETS = ("record", "ozz", "unreal", "mec", "stride")
RARELY = 1 / 300  # of a teleport, or of a leg that goes or comes, a frame
OFTEN = 1 / 50  # of a lost frame, of numbers that are not finite, of a strange dt
SPREAD = 0.05  # of the numbers of a damaged frame that are damaged
DISTANCES = (1.0, 50.0, 1e5)  # m, of teleports
STRANGE = (np.nan, np.inf, -np.inf, 1e30, 1e38)
STRANGE_DT = (0.0, -1.0, 1e-9, 10.0, 1e6, np.nan)


@struct
class Life:
    """What a character goes through the frames with."""

    state: jaxik.State
    key: Array
    index: Array
    """Of the frame, in the clip that is played again and again."""
    offset_ws: Array
    """m, by which it has been teleported."""
    present: Array
    """The legs that are there."""


class Findings(NamedTuple):
    """What a stretch of life has shown."""

    frames: int
    faulty: int
    """Legs of frames that could not be used."""
    not_finite: int
    """Frames after which a result or the memory was not finite."""
    bone_error: float
    """By which a bone was longer or shorter than in the animation, at most: m, for each metre, from
    1 on, between a joint and the model's origin, since that is what numbers are rounded by."""


@functools.cache
def animation() -> tuple[jaxik.Rig, jaxik.Frame]:
    """A walk of twelve seconds over uneven ground, with all that a frame may have."""
    clip = fitting.load_clip(DATA / "clips" / "uneven_walk_base.npz")
    frames = fitting.frames_from_clip(clip)
    still = jnp.zeros(frames.dt.shape, bool)
    return clip.rig, dataclasses.replace(frames, restart=still)


@functools.cache
def grounds() -> tuple[Terrain, ...]:
    """The grounds that characters are put on in turn."""
    heights = 0.1 * jnp.sin(jnp.arange(60.0))[:, None] * jnp.ones(60)
    holed = heights.at[20:25, 20:25].set(jnp.nan)
    field = terrain.heightfield(holed, 0.25, origin=(-5.0, -1.0, -5.0))
    mesh = fitting.load_terrain(DATA / "terrains" / "uneven_walk.ply")
    return (terrain.combine(mesh, field), terrain.plane(), terrain.plane((0.0, -500.0, 0.0)))


def newborn(ik: jaxik.FootIK, count: int, seed: int) -> Life:
    """Characters before their first frame, each with a life of its own."""
    rig, frames = animation()
    keys = jax.random.split(jax.random.key(seed, impl="unsafe_rbg"), count)
    state = jaxik.init(ik, rig)

    def born(key: Array) -> Life:
        start = jax.random.randint(key, (), 0, frames.dt.shape[0])
        return Life(state, key, start, jnp.zeros(3, frames.dt.dtype), jnp.ones_like(rig.present))

    return jax.vmap(born)(keys)


def living(ik: jaxik.FootIK, steps: int) -> Callable[[Life, Terrain], tuple]:
    """A stretch of life of many characters on one ground, compiled once for each kind of it."""
    rig, frames = animation()

    def live(ground: Terrain, life: Life, _: None) -> tuple[Life, tuple[Array, ...]]:
        life, frame = _next_frame(life, frames)
        own_rig = dataclasses.replace(rig, present=life.present)
        state, result = jaxik.step(ik, own_rig, ground, life.state, frame)
        finite = [jnp.isfinite(x).all() for x in jax.tree.leaves((state, result))]
        sound = life.present & ~result.faulty
        error = jnp.where(sound, _bone_error(result.pose, frame.pose), 0.0).max()
        after = dataclasses.replace(life, state=state)
        return after, (result.faulty.sum(), ~jnp.stack(finite).all(), error)

    def stretch(life: Life, ground: Terrain) -> tuple:
        return jax.lax.scan(functools.partial(live, ground), life, None, steps)

    return jax.jit(jax.vmap(stretch, in_axes=(0, None)))


def summarised(shown: tuple[Array, ...]) -> Findings:
    """What `living` has shown, over all characters and frames."""
    faulty, not_finite, error = (np.asarray(x) for x in shown)
    return Findings(faulty.size, int(faulty.sum()), int(not_finite.sum()), float(error.max()))


def _next_frame(life: Life, frames: jaxik.Frame) -> tuple[Life, jaxik.Frame]:
    """The next frame of the clip, after whatever has happened to it on its way."""
    key, *keys = jax.random.split(life.key, 9)
    lost = jax.random.bernoulli(keys[0], OFTEN) * jax.random.randint(keys[1], (), 1, 30)
    index = (life.index + 1 + lost) % frames.dt.shape[0]
    frame = jax.tree.map(lambda x: x[index], frames)

    teleported = jax.random.bernoulli(keys[2], RARELY)
    distance = jax.random.choice(keys[3], jnp.asarray(DISTANCES))
    place = distance * jax.random.uniform(keys[4], (3,), minval=-1.0, maxval=1.0)
    offset_ws = jnp.where(teleported, place, life.offset_ws)
    toggled = jax.random.bernoulli(keys[5], RARELY, life.present.shape)
    present = life.present ^ toggled

    frame = frame.translated(offset_ws)
    announced = teleported & jax.random.bernoulli(keys[6])
    frame = dataclasses.replace(frame, dt=frame.dt * (1 + lost), restart=announced)
    frame = _damaged(keys[7], frame)
    life = dataclasses.replace(life, key=key, index=index, offset_ws=offset_ws, present=present)
    return life, frame


def _damaged(key: Array, frame: jaxik.Frame) -> jaxik.Frame:
    """The frame, now and then with numbers or a time that no frame should have."""
    first, second, third, *keys = jax.random.split(key, 3 + len(jax.tree.leaves(frame)))
    strange = jax.random.choice(first, jnp.asarray(STRANGE, frame.dt.dtype))
    happens = jax.random.bernoulli(second, OFTEN)

    def damage(leaf: Array, key: Array) -> Array:
        if leaf.dtype == bool or not leaf.size:
            return leaf
        return jnp.where(happens & jax.random.bernoulli(key, SPREAD, leaf.shape), strange, leaf)

    leaves, structure = jax.tree.flatten(frame)
    frame = jax.tree.unflatten(structure, list(map(damage, leaves, keys)))
    at, which = jax.random.split(third)
    dt = jax.random.choice(which, jnp.asarray(STRANGE_DT, frame.dt.dtype))
    return dataclasses.replace(frame, dt=jnp.where(jax.random.bernoulli(at, OFTEN), dt, frame.dt))


def _bone_error(solved: jaxik.LegPose, animated: jaxik.LegPose) -> Array:
    """How much bones of each leg differ in length from the animation's; see `Findings`."""
    after, before = (
        jnp.stack([pose.hip.pos, pose.knee.pos, pose.ankle.pos, pose.toe.pos])
        for pose in (solved, animated)
    )
    lengths, expected = (vec.length(joints[1:] - joints[:-1]) for joints in (after, before))
    far = jnp.abs(after).max(axis=(0, 2))
    return jnp.abs(lengths - expected).max(axis=0) / jnp.maximum(far, 1.0)
