"""Far from the world's origin, 32 bits are as exact as at it.

What is expected comes from the same numbers in 64 bits, where nothing is moved about the character.
The numbers that go in are rounded to 32 bits before, in both: at 100 km they are 8 mm apart.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from fitting.datasets.clip_frames import frames_from_clip
from fitting.datasets.synthetic import walker
from jaxik import presets
from jaxik.world import terrain
from jaxik.world.places import LATTICE
from jaxik.world.skeleton import Transform
from support import grounds
from support.cases import QUICK
from support.clips import assert_close

EXACT = 5e-5  # m, and of quaternions; an almost straight knee turns by the root of an error
FPS = 30.0
FURTHEST = 1e5  # m
BORDER = np.array([0.0, 0.0, 0.5 * LATTICE - 1.0])
AWAY = (1e3, 1e4, FURTHEST)
HILL = grounds.hill()
PRESETS = ("record", "stride", "ozz", "mec")  # `unreal` has no memory that these do not have

compiled = jax.jit(jaxik.run, compiler_options=QUICK)


def single(tree: Any) -> Any:
    return _with_floats(tree, jnp.float32)


def double(tree: Any) -> Any:
    return _with_floats(tree, jnp.float64)


def _with_floats(tree: Any, dtype: Any) -> Any:
    return jax.tree.map(
        lambda x: jnp.asarray(x, dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree
    )


@functools.cache
def walk() -> tuple[jaxik.Rig, jaxik.Frame]:
    clip = walker.walk(3.0, FPS, seed=4)
    return clip.rig, frames_from_clip(clip)


def offset(away: float) -> np.ndarray:
    """m, far to two sides and up, and then 1 m short of where the centre of coordinates moves."""
    return LATTICE * np.round(np.array([away, 0.05 * away, -0.7 * away]) / LATTICE) + BORDER


def shifted(frames: jaxik.Frame, by: np.ndarray) -> jaxik.Frame:
    """By one offset, or one a frame."""
    world, stride = frames.world_from_model, frames.stride
    feet = {name: getattr(stride, name) + by[..., None, :] for name in ("last_ws", "next_ws")}
    return dataclasses.replace(
        frames,
        world_from_model=Transform(world.pos + by, world.rot),
        stride=dataclasses.replace(stride, **feet),
    )


def hill(by: np.ndarray) -> terrain.Terrain:
    """With coordinates of 32 bits."""
    return terrain.mesh((HILL.vertices + by).astype(np.float32), HILL.faces)


def in_64_bits(ground: terrain.Terrain) -> terrain.Terrain:
    """The same mesh, with a grid of its own."""
    mesh: Any = ground.surfaces[0]
    return terrain.mesh(np.asarray(mesh.vertices_ws, np.float64), np.asarray(mesh.triangles))


def far_walk(preset: str, away: float) -> tuple[Any, ...]:
    """System, rig, ground and clip, in 32 bits."""
    rig, frames = walk()
    by = offset(away)
    ik, rig, clip = single((getattr(presets, preset)(), rig, shifted(frames, by)))
    return ik, rig, hill(by), clip


def run_in_64_bits(ik: Any, rig: Any, ground: Any, clip: Any) -> jaxik.Result:
    return compiled(*double((ik, rig)), in_64_bits(ground), double(clip))


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
def test_a_walk_far_away_is_as_exact_as_with_64_bits(preset):
    for away in AWAY:
        scene = far_walk(preset, away)
        result, expected = compiled(*scene), run_in_64_bits(*scene)
        assert len(np.unique(result.trace.advanced.state.centre_ws, axis=0)) > 1
        assert result.pose.ankle.pos.dtype == np.float32
        for part in ("pose", "body", "corrections"):
            assert_close(getattr(result, part), getattr(expected, part), EXACT)


@pytest.mark.slow
def test_a_trace_is_in_world_space_and_memory_about_its_centre():
    scene = far_walk("record", 1e3)
    trace, expected = compiled(*scene).trace, run_in_64_bits(*scene).trace
    rounding = 4 * float(np.spacing(np.float32(1e3)))
    assert_close(trace.sensed, expected.sensed, rounding)
    for part in ("foothold_ws", "hold", "lean", "effector"):
        actual, wanted = (getattr(of.advanced, part) for of in (trace, expected))
        assert_close(actual, wanted, rounding)
    memory, wanted = trace.advanced.state, expected.advanced.state
    assert len(np.unique(memory.centre_ws, axis=0)) > 1
    assert not np.asarray(wanted.centre_ws).any()
    feet = np.asarray(memory.lock.foothold, np.float64) + np.asarray(memory.centre_ws)[:, None]
    np.testing.assert_allclose(feet, wanted.lock.foothold, rtol=0, atol=EXACT)
    heights = np.asarray(memory.target.height, np.float64) + memory.centre_ws[:, None, 1]
    np.testing.assert_allclose(heights, wanted.target.height, rtol=0, atol=EXACT)


@pytest.mark.slow
def test_steps_far_away_are_the_run_also_after_a_bad_frame():
    """The centre of the coordinates moves in the bad frame; a pause follows."""
    ik, rig, ground, clip = far_walk("record", FURTHEST)
    centres = np.asarray(compiled(ik, rig, ground, clip).trace.advanced.state.centre_ws)
    moves = np.flatnonzero((centres[1:] != centres[:-1]).any(axis=1)) + 1
    assert len(moves), "the centre of the coordinates has to move on the way"
    bad = int(moves[0])
    pos, dt = clip.world_from_model.pos, clip.dt
    broken = Transform(pos.at[bad, 0].set(jnp.nan), clip.world_from_model.rot)
    clip = dataclasses.replace(clip, world_from_model=broken, dt=dt.at[bad + 1].set(0.0))
    result = compiled(ik, rig, ground, clip)
    step = jax.jit(jaxik.step, compiler_options=QUICK)
    state = jaxik.init(ik, rig)
    for number in range(bad + 20):
        before = state
        state, live = step(ik, rig, ground, state, jax.tree.map(lambda x: x[number], clip))  # noqa: B023
        assert bool(live.faulty.all()) == (number == bad)
        if number == bad:
            for old, new in zip(jax.tree.leaves(before), jax.tree.leaves(state), strict=True):
                np.testing.assert_array_equal(old, new)
        assert_close(live.pose, jax.tree.map(lambda x: x[number], result.pose), EXACT)  # noqa: B023


@pytest.mark.slow
def test_a_ship_far_away_carries_its_walker_as_exactly():
    ik, rig, ground, clip = far_walk("record", 0.0)
    ship, by = terrain.moving(ground, 0), offset(FURTHEST)
    time = np.arange(len(clip.dt)) / FPS
    way = by + np.stack([3.0 * time, 0.2 * np.sin(time), -2.0 * time], axis=-1)
    way = way.astype(np.float32)
    rot = np.broadcast_to(np.array([1.0, 0.0, 0.0, 0.0]), (len(time), 4))
    track = Transform(jnp.asarray(way)[:, None], jnp.asarray(rot)[:, None])
    sailing = single(shifted(clip, way).with_platforms(track))
    result = compiled(ik, rig, ship, sailing)
    still = terrain.moving(in_64_bits(ground), 0)
    expected = compiled(*double((ik, rig)), still, double(sailing))
    assert (np.asarray(result.trace.sensed.ground.ankle.platform) == 0).mean() > 0.5
    assert_close(result.pose, expected.pose, EXACT)
