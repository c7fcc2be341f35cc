"""Platforms carry characters: whatever moves the ground under a walk leaves the walk as it is."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxik
from jaxik.maths import parameter_tree
from jaxik.stages.root import GroundRoot
from jaxik.world import terrain
from jaxik.world.skeleton import Transform
from support.cases import QUICK, stacked
from support.clips import at, make_rig, to_frames, to_rig, to_terrain
from support.strides import blocks, walk

RIG, HZ, FRAMES = make_rig(), 60.0, 150
JOINTS = ("hip", "knee", "ankle", "toe")
EXACT = 1e-9  # m, and of quaternions
SMOOTHED = {"target.rise_half_life": 0.1, "target.fall_half_life": 0.1}  # more to remember
SYSTEMS: dict[str, Any] = {  # between them, they have all that remembers places
    "record": parameter_tree.replace(
        dataclasses.replace(jaxik.presets.record(), root=GroundRoot()), SMOOTHED
    ),
    "mec": dataclasses.replace(jaxik.presets.mec(), root=GroundRoot()),
}


@functools.cache
def clip() -> jaxik.Frame:
    """A walk over blocks, off the seams between them; its last footholds are not known."""
    frames = to_frames(walk(RIG, FRAMES, start=(0.13, 0.0, -3.03)))
    known = frames.stride.known * (np.arange(FRAMES) < 100)[:, None]
    return dataclasses.replace(frames, stride=dataclasses.replace(frames.stride, known=known))


def ground() -> terrain.Terrain:
    """Blocks under the left foot alone ride on a platform, and the floor on another."""
    belt = blocks(np.random.default_rng(3), 2, max_height=0.08, irregular=False)
    belt = dataclasses.replace(belt, triangles=belt.triangles + [0.6, 0.0, 0.0])  # from x = 0.15
    floor = terrain.moving(terrain.plane((0.0, -0.06, 0.0)), 1)
    return terrain.combine(terrain.moving(to_terrain(belt), 0), floor)


def track(places: np.ndarray, angles: np.ndarray) -> Transform:
    """Poses (frames) at these places, m, turned about up, rad."""
    rot = Rotation.from_rotvec(np.stack([0 * angles, angles, 0 * angles], -1))
    return Transform(jnp.asarray(places), jnp.asarray(rot.as_quat(scalar_first=True)))


def line(x: Any = 0.0, y: Any = 0.0, z: Any = 0.0) -> np.ndarray:
    return np.stack(np.broadcast_arrays(x, y, z, np.zeros(FRAMES))[:3], axis=-1)


TIME = np.arange(FRAMES) / HZ
MOTIONS: dict[str, Transform] = {
    "stands": track(line(), 0 * TIME),
    "elevator": track(line(y=2.0 * TIME), 0 * TIME),
    "elevator that starts and stops": track(line(y=np.cos(3 * TIME)), 0 * TIME),
    "train": track(line(z=15.0 * TIME + 2.0 * np.sin(TIME), x=-4.0 * TIME), 0 * TIME + 0.4),
    "turntable": track(line(x=2.0, z=0.5 * TIME), 1.5 * TIME),
}


def riding(frames: jaxik.Frame, platform: Transform) -> jaxik.Frame:
    """The clip on a platform (frames), moved along with it as by a game."""
    per_leg = jax.vmap(lambda pose, points: pose.apply(points))
    stride = dataclasses.replace(
        frames.stride,
        last_ws=per_leg(platform, frames.stride.last_ws),
        next_ws=per_leg(platform, frames.stride.next_ws),
    )
    moved = dataclasses.replace(
        frames,
        world_from_model=platform @ frames.world_from_model,
        velocity_ws=platform.turn(frames.velocity_ws),
        stride=stride,
    )
    return moved.with_platforms(pair(platform, platform))


def assert_same_motion(actual: jaxik.Result, expected: jaxik.Result, case: str) -> None:
    """Asserts that two results agree in model space."""
    joints = [(getattr(actual.pose, name), getattr(expected.pose, name)) for name in JOINTS]
    for a, b in [(actual.body, expected.body), *joints]:
        np.testing.assert_allclose(a.pos, b.pos, rtol=0, atol=EXACT, err_msg=case)
        alike = np.abs(np.sum(np.asarray(a.rot) * np.asarray(b.rot), axis=-1))
        np.testing.assert_allclose(alike, 1.0, rtol=0, atol=EXACT, err_msg=case)


def pair(first: Transform, second: Transform) -> Transform:
    """Poses of two platforms (frames, platforms)."""
    return jax.tree.map(lambda *x: jnp.stack(x, axis=1), first, second)


@pytest.mark.slow
@pytest.mark.parametrize("preset", SYSTEMS)
def test_a_walk_on_moving_ground_is_the_walk_on_ground_that_stands(preset: str):
    """By Galileo, feet on a belt and on the floor do not know, either, which of them moves."""
    stands, belt = MOTIONS["stands"], track(line(x=0.04 * TIME, z=0.2 * TIME), 0 * TIME)
    away = belt.inverse()
    clips = {name: riding(clip(), motion) for name, motion in MOTIONS.items()}
    clips["belt moves"] = clip().with_platforms(pair(belt, stands))
    clips["floor moves"] = riding(clip(), away).with_platforms(pair(stands, away))
    run = jax.jit(jax.vmap(jaxik.run, in_axes=(None, None, None, 0)), compiler_options=QUICK)
    many = run(SYSTEMS[preset], to_rig(RIG), ground(), stacked(list(clips.values())))
    results = {name: at(jax.device_get(many), index) for index, name in enumerate(clips)}
    for name, result in results.items():
        platforms = result.trace.sensed.ground.ankle.platform
        shares = [(platforms == number).mean() for number in (0, 1)]
        assert min(shares) > 0.2, f"{name}: feet stand on both, {shares}"
        if name != "belt moves":
            expected = "belt moves" if name == "floor moves" else "stands"
            assert_same_motion(result, results[expected], name)
