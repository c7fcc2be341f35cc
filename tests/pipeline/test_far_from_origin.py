"""Far from the world's origin, 32 bits are as exact as at it.

What is expected comes from the same walk at the origin. All its places are multiples of 1/128 m,
which 32 bits hold exactly at 100 km, too. So the numbers that go in are the same in both places.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from fitting.clips.clip_frames import frames_from_clip
from fitting.synthetic import walker
from jaxik import presets
from jaxik.world import terrain
from jaxik.world.places import LATTICE
from jaxik.world.skeleton import Transform
from support import grounds
from support.cases import QUICK
from support.clips import assert_close, at

EXACT = 5e-5  # m, and of quaternions; an almost straight knee turns by the root of an error
FPS = 30.0
FURTHEST = 1e5  # m
BORDER = np.array([0.0, 0.0, 0.5 * LATTICE - 1.0])
HILL = grounds.hill()
# And whether the hill is a ship; `ozz` and `unreal` have no memory that these have not.
PRESETS = [("record", False), ("mec", True), ("stride", False)]
pytestmark = pytest.mark.slow

compiled = jax.jit(jaxik.run, compiler_options=QUICK)


def rounded(places: Any) -> np.ndarray:
    """m, as exact as places are with 32 bits at 100 km."""
    return np.round(128.0 * np.asarray(places)) / 128.0


def single(tree: Any) -> Any:
    return jax.tree.map(
        lambda x: jnp.asarray(x, jnp.float32) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree
    )


@functools.cache
def walk() -> tuple[jaxik.Rig, jaxik.Frame]:
    clip = walker.walk(3.0, FPS, seed=4)
    return clip.rig, frames_from_clip(clip)


def offset(away: float) -> np.ndarray:
    """m, far to two sides and up, and then 1 m short of where the centre of coordinates moves."""
    if away == 0.0:
        return np.zeros(3)
    return LATTICE * np.round(np.array([away, 0.05 * away, -0.7 * away]) / LATTICE) + BORDER


def shifted(frames: jaxik.Frame, by: np.ndarray) -> jaxik.Frame:
    """By one offset, or one a frame."""
    world, stride = frames.world_from_model, frames.stride
    names, each = ("last_ws", "next_ws"), by[..., None, :]
    feet = {name: rounded(getattr(stride, name)) + each for name in names}
    return dataclasses.replace(
        frames,
        world_from_model=Transform(jnp.asarray(rounded(world.pos) + by), world.rot),
        stride=dataclasses.replace(stride, **feet),
    )


def far_walk(preset: str, away: float, sails: bool = False) -> tuple[Any, ...]:
    """System, rig, ground and clip, in 32 bits; the ground sails away with its walker, or not."""
    rig, frames = walk()
    way, vertices = offset(away), rounded(HILL.vertices)
    if sails:
        time = np.arange(len(frames.dt)) / FPS
        way = rounded(np.stack([3.0 * time, 0.2 * np.sin(time), -2.0 * time], axis=-1)) + way
        rot = np.broadcast_to(np.array([1.0, 0.0, 0.0, 0.0]), (len(time), 4))
        track = Transform(jnp.asarray(way)[:, None], jnp.asarray(rot)[:, None])
        frames = frames.with_platforms(track)
    else:
        vertices = vertices + way
    ground = terrain.mesh(vertices.astype(np.float32), HILL.faces)
    ik, rig, clip = single((getattr(presets, preset)(), rig, shifted(frames, way)))
    return ik, rig, terrain.moving(ground, 0) if sails else ground, clip


def centres(result: jaxik.Result) -> np.ndarray:
    return np.asarray(result.trace.advanced.state.centre_ws)


@pytest.mark.parametrize(("preset", "sails"), PRESETS)
def test_a_walk_far_away_is_the_walk_at_the_origin(preset: str, sails: bool):
    expected = compiled(*far_walk(preset, 0.0, sails))
    assert sails or not centres(expected).any()
    for away in (1e3, 1e4, FURTHEST):
        result = compiled(*far_walk(preset, away, sails))
        assert len(np.unique(centres(result), axis=0)) > 1
        assert result.pose.ankle.pos.dtype == np.float32
        if sails:
            assert (np.asarray(result.trace.sensed.ground.ankle.platform) == 0).mean() > 0.5
        # Almost straight legs turn by a root of how far their targets are, and mec stretches them.
        angles = 10.0 * EXACT if preset == "mec" else EXACT
        for part, tolerance in (("pose", angles), ("body", EXACT), ("corrections", angles)):
            assert_close(getattr(result, part), getattr(expected, part), tolerance)


def test_a_trace_is_in_world_space_and_memory_about_its_centre():
    trace, near = (compiled(*far_walk("record", away)).trace for away in (1e3, 0.0))
    by, rounding = offset(1e3), 4 * float(np.spacing(np.float32(1e3)))
    for places in ("hip_ws", "ankle_ws", "ball_ws"):
        actual, expected = (np.asarray(getattr(of.sensed, places)) for of in (trace, near))
        np.testing.assert_allclose(actual, expected + by, rtol=0, atol=rounding)
    for part in ("slope", "rot_ws", "foot_speed"):
        assert_close(getattr(trace.sensed, part), getattr(near.sensed, part), EXACT)
    feet, expected = (np.asarray(of.advanced.foothold_ws) for of in (trace, near))
    np.testing.assert_allclose(feet, expected + by, rtol=0, atol=rounding)
    targets, expected = (np.asarray(of.advanced.effector.target_ws) for of in (trace, near))
    np.testing.assert_allclose(targets, expected + by, rtol=0, atol=rounding)
    for part in ("hold", "lean"):
        assert_close(getattr(trace.advanced, part), getattr(near.advanced, part), EXACT)
    memory, wanted = trace.advanced.state, near.advanced.state
    about = np.asarray(memory.centre_ws, np.float64) - by
    footholds = np.asarray(memory.lock.foothold, np.float64) + about[:, None]
    np.testing.assert_allclose(footholds, wanted.lock.foothold, rtol=0, atol=EXACT)
    heights = np.asarray(memory.target.height, np.float64) + about[:, None, 1]
    np.testing.assert_allclose(heights, wanted.target.height, rtol=0, atol=EXACT)


def with_bad_frame(clip: jaxik.Frame, bad: int) -> jaxik.Frame:
    """The clip with a frame that cannot be used, and a pause after it."""
    pos = clip.world_from_model.pos.at[bad, 0].set(jnp.nan)
    broken = Transform(pos, clip.world_from_model.rot)
    return dataclasses.replace(clip, world_from_model=broken, dt=clip.dt.at[bad + 1].set(0.0))


@pytest.mark.slow
def test_the_centre_stays_in_a_bad_frame_and_moves_in_the_next():
    ik, rig, ground, clip = far_walk("record", FURTHEST)
    places = centres(compiled(ik, rig, ground, clip))
    bad = int(np.argmax((places[1:] != places[:-1]).any(axis=1))) + 1
    result = compiled(ik, rig, ground, with_bad_frame(clip, bad))
    memory = result.trace.advanced.state
    for old, new in zip(*(jax.tree.leaves(at(memory, n)) for n in (bad - 1, bad)), strict=True):
        np.testing.assert_array_equal(old, new)
    *scene, clip = far_walk("record", 0.0)
    expected = compiled(*scene, with_bad_frame(clip, bad))
    np.testing.assert_array_equal(result.faulty, expected.faulty)
    assert_close(result.pose, expected.pose, EXACT)


def test_steps_far_away_are_the_run():
    ik, rig, ground, clip = far_walk("record", FURTHEST)
    result, step = compiled(ik, rig, ground, clip), jax.jit(jaxik.step, compiler_options=QUICK)
    assert len(np.unique(centres(result), axis=0)) > 1
    state = jaxik.init(ik, rig)
    for number in range(len(clip.dt)):
        state, live = step(ik, rig, ground, state, at(clip, number))
        assert_close(live.pose, at(result.pose, number), EXACT)
