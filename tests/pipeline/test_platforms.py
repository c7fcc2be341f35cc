"""Platforms carry characters: whatever moves the ground under a walk leaves the walk as it is."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.typing import DTypeLike
from scipy.spatial.transform import Rotation

import jaxik
from jaxik.maths import parameter_tree
from jaxik.stages.root import GroundRoot
from jaxik.world import terrain
from jaxik.world.skeleton import Transform
from support.cases import QUICK
from support.clips import make_rig, to_frames, to_rig, to_terrain
from support.strides import blocks, walk

RIG, HZ, FRAMES = make_rig(), 60.0, 150
JOINTS = ("hip", "knee", "ankle", "toe")
EXACT = {np.float64: 1e-9, np.float32: 1e-3}  # m, and of quaternions
SMOOTHED: dict[str, dict[str, Any]] = {  # what remembers, switched on
    "record": {"target.rise_half_life": 0.1, "target.fall_half_life": 0.1},
    "ozz": {"pelvis.on_gain": 0.2},
    "unreal": {"contact.idle_speed": 10.0, "effector.latch": False},
    "mec": {},
    "stride": {
        "target.rise_half_life": 0.05,
        "target.fall_half_life": 0.05,
        "target.spring": True,
        "lock.enabled": True,
    },
}


def system(preset: str) -> jaxik.FootIK:
    """A preset on a root with memory; nothing of it is out of reach here."""
    ik = dataclasses.replace(getattr(jaxik.presets, preset)(), root=GroundRoot())
    return parameter_tree.replace(ik, SMOOTHED[preset])


@functools.cache
def clip() -> jaxik.Frame:
    """A walk over blocks, off the seams between them; its last footholds are not known."""
    frames = to_frames(walk(RIG, FRAMES, start=(0.13, 0.0, -3.03)))
    known = frames.stride.known * (np.arange(FRAMES) < 100)[:, None]
    return dataclasses.replace(frames, stride=dataclasses.replace(frames.stride, known=known))


def ground() -> terrain.Terrain:
    return to_terrain(blocks(np.random.default_rng(3), max_height=0.08, irregular=False))


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
    return moved.with_platforms(jax.tree.map(lambda leaf: leaf[:, None], platform))


def assert_same_motion(actual: jaxik.Result, expected: jaxik.Result, tolerance: float) -> None:
    """Asserts that two results agree in model space."""
    joints = [(getattr(actual.pose, name), getattr(expected.pose, name)) for name in JOINTS]
    for a, b in [(actual.body, expected.body), *joints]:
        np.testing.assert_allclose(a.pos, b.pos, rtol=0, atol=tolerance)
        alike = np.abs(np.sum(np.asarray(a.rot) * np.asarray(b.rot), axis=-1))
        np.testing.assert_allclose(alike, 1.0, rtol=0, atol=tolerance)


def cast_to(tree: Any, dtype: DTypeLike) -> Any:
    return jax.tree.map(
        lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree
    )


compiled = jax.jit(jax.vmap(jaxik.run, in_axes=(None, None, None, 0)), compiler_options=QUICK)


def run_each(
    ik: jaxik.FootIK, where: terrain.Terrain, clips: list[jaxik.Frame]
) -> list[jaxik.Result]:
    """Results of several clips by one program."""
    many = jax.tree.map(lambda *leaves: jnp.stack(leaves), *clips)
    results = compiled(ik, cast_to(to_rig(RIG), ik.leg.weight.dtype), where, many)
    return [jax.tree.map(lambda x: x[number], results) for number in range(len(clips))]  # noqa: B023


CASES = [  # between them, record and mec have all that remembers places
    ("record", np.float64),
    ("mec", np.float64),
    *(pytest.param(x, np.float64, marks=pytest.mark.slow) for x in ("ozz", "unreal", "stride")),
    pytest.param("record", np.float32, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("preset", "dtype"), CASES)
def test_a_walk_on_a_moving_platform_is_the_walk_on_one_that_stands(preset, dtype):
    ik, where = cast_to((system(preset), terrain.moving(ground(), 0)), dtype)
    clips = [cast_to(riding(clip(), motion), dtype) for motion in MOTIONS.values()]
    expected, *results = run_each(ik, where, clips)
    for result in results:
        assert (np.asarray(result.trace.sensed.ground.ankle.platform) == 0).mean() > 0.5
        assert_same_motion(result, expected, EXACT[dtype])


@pytest.mark.slow
def test_a_platform_that_stands_is_ground_like_any_other():
    ik = system("record")
    (expected,) = run_each(ik, ground(), [clip()])
    (result,) = run_each(ik, terrain.moving(ground(), 0), [riding(clip(), MOTIONS["stands"])])
    assert_same_motion(result, expected, EXACT[np.float64])


def strip_of(left: float, right: float, near: float, far: float) -> terrain.Terrain:
    """Level ground 4 cm high between these x and z, m, far longer than the belt moves."""
    size = jnp.array([right - left, far - near])
    return terrain.heightfield(jnp.full((2, 2), 0.04), size, (left, 0.0, near))


@pytest.mark.slow
def test_feet_on_a_belt_and_on_the_floor_do_not_know_which_of_them_moves():
    """By Galileo: the belt can move over the floor, or the floor under the belt."""
    moves, stands = track(line(x=0.1 * TIME, z=0.2 * TIME), 0 * TIME), MOTIONS["stands"]
    away = moves.inverse()
    belt_moves = clip().with_platforms(pair(moves, stands))
    floor_moves = riding(clip(), away).with_platforms(pair(stands, away))
    for belt in (strip_of(-1.0, 1.0, -2.2, -1.2), strip_of(0.0, 1.0, -9.0, 9.0)):
        both = terrain.combine(terrain.moving(belt, 0), terrain.moving(terrain.plane(), 1))
        one, other = run_each(system("record"), both, [belt_moves, floor_moves])
        platform = np.asarray(one.trace.sensed.ground.ankle.platform)
        assert set(platform.ravel()) >= {0, 1}, "feet stand on both"
        assert_same_motion(one, other, EXACT[np.float64])


def pair(first: Transform, second: Transform) -> Transform:
    """Poses of two platforms (frames, platforms)."""
    return jax.tree.map(lambda *x: jnp.stack(x, axis=1), first, second)
