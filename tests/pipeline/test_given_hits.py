"""Hits that somebody else gives: they replay a motion, and the wrong ones are refused."""

# pyright: reportArgumentType=false

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from jaxik.maths import quat
from jaxik.pipeline import step_and_rays
from jaxik.pipeline.requests import (
    OpenProgram,
    Request,
    casting,
    joined,
    open_terrain,
    reading,
)
from jaxik.world import terrain
from jaxik.world.skeleton import Transform
from jaxik.world.terrain import Hit
from support.cases import QUICK
from support.clips import (
    BROKEN,
    assert_close,
    at,
    make_rig,
    to_frames,
    to_rig,
    to_terrain,
    wandering,
)

COUNT = 40
RIG = to_rig(make_rig())
IK = jaxik.presets.mec()  # its rays depend on hits, twice, and on what it remembers
EXACT = 1e-9  # m, and of quaternions


@functools.cache
def clip() -> jaxik.Frame:
    """A clip over a platform that rises and turns."""
    frames = to_frames(wandering(make_rig(), np.random.default_rng(0), COUNT))
    time = np.arange(COUNT) / 30.0
    pos = jnp.asarray(np.stack([0.1 * time, 0.02 * np.sin(5.0 * time), 0.0 * time], -1))
    rot = jnp.asarray(np.stack([np.cos(0.1 * time), 0 * time, np.sin(0.1 * time), 0 * time], -1))
    return frames.with_platforms(Transform(pos[:, None], rot[:, None]))


def ground() -> terrain.LegTerrains:
    """Broken ground under the left leg and the body, which rides on a platform under the right."""
    still, moving = to_terrain(BROKEN), terrain.moving(to_terrain(BROKEN), 0)
    return terrain.LegTerrains(still, (still, moving))


@functools.partial(jax.jit, compiler_options=QUICK)
def recorded(ik: jaxik.FootIK, frames: jaxik.Frame) -> tuple[jaxik.Result, Hit, jaxik.Result]:
    """The motion by rays, what they hit, and the motion by these hits."""
    ups = {"up": (0.0, 1.0, 0.0), "leg_ups": [(0.0, 1.0, 0.0)] * 2, "platforms": 1}

    def advance(states: tuple, frame: jaxik.Frame) -> tuple:
        state, result, _, hits = step_and_rays(ik, RIG, ground(), states[0], frame)
        replay = terrain.from_hits(hits, **ups)
        replayed, again = jaxik.step(ik, RIG, replay, states[1], frame)
        return (state, replayed), (result, hits, again)

    state = jaxik.init(ik, RIG)
    return jax.lax.scan(advance, (state, state), frames)[1]


@pytest.mark.slow
def test_hits_of_rays_replay_the_motion_of_run():
    frames = clip()
    result, hits, again = recorded(IK, frames)
    expected = jax.jit(jaxik.run, compiler_options=QUICK)(IK, RIG, ground(), frames)
    assert_close(result, dataclasses.replace(expected, trace=None), EXACT)
    assert_close(again, result, EXACT)
    assert 0.3 < np.mean(hits.found) < 1.0, "some miss"
    assert {-1, 0} <= set(np.asarray(hits.platform).ravel().tolist())


@pytest.mark.slow
def test_hits_of_rays_replay_a_frame_as_it_is_on_the_terrain():
    ik, frame = jaxik.presets.unreal(faithful=True), at(clip(), 0)
    still = dataclasses.replace(frame, velocity_ws=jnp.zeros(3))
    slope = terrain.moving(terrain.plane((0.0, -0.05, 0.0), (0.2, 1.0, -0.3)), 0)

    @functools.partial(jax.jit, compiler_options=QUICK)
    def three_ways(ik: jaxik.FootIK, frame: jaxik.Frame) -> tuple:
        state = jaxik.init(ik, RIG)
        after, result, rays, hits = step_and_rays(ik, RIG, slope, state, frame)
        replay = terrain.from_hits(hits, platforms=1)
        ways = [jaxik.step(ik, RIG, ground, state, frame) for ground in (slope, replay)]
        return [*ways, (after, result)], rays, hits

    (expected, *others), rays, hits = three_ways(ik, still)
    assert rays.origins_ws.shape == (6, 3) and np.all(hits.found == 1.0)
    for motion in others:
        assert_close(motion, expected, EXACT)
    corrections = expected[1].corrections.knee
    assert np.max(np.abs(corrections - quat.identity())) > 0.01, "the ground moves the legs"


def answered(function: Callable, ground: terrain.Terrain | terrain.LegTerrains, x: jax.Array):
    """What a function of a ground and x gives there and by its hits, and how many there are."""
    program = OpenProgram(functools.partial(function, open_terrain(ground)), x)
    cast, rays = casting(ground), []

    def answer(request: Request, number: int) -> Hit:
        rays.append((request, cast(request, number)))
        return rays[-1][1]

    program(answer, x)
    hits = joined(rays)[1]
    return function(ground, x), program(reading(hits), x), program.ray_count


def test_hits_answer_casts_one_by_one_of_each_leg_and_in_batches():
    moving = terrain.moving(terrain.plane(normal=(0.0, 1.0, 0.4)), 0)
    side = terrain.plane((1.0, 0.0, 0.0), (1.0, 0.1, 0.0), up=(1.0, 0.0, 0.0))
    ground = terrain.LegTerrains(moving, (moving, side))
    origins = jnp.asarray(np.random.default_rng(0).normal(size=(5, 2, 3)))

    def function(ground: terrain.LegTerrains, x: jax.Array) -> list[Hit]:
        body = terrain.cast(ground.body, x[:, 0], 1.0)
        legs = terrain.cast(ground, x + body.point[:, None], jnp.array([3.0, 0.5]))
        single = terrain.cast(ground, x[0], 3.0)
        rows = jax.vmap(lambda row: terrain.cast(ground, row[None], 2.0))(x)
        return [body, legs, rows, single]

    quick = functools.partial(jax.jit, compiler_options=QUICK, static_argnums=0)
    on_ground, by_hits, count = quick(answered)(function, ground, origins)
    assert count == 5 + 10 + 10 + 2
    assert_close(by_hits, on_ground, EXACT)
    shares = np.concatenate([hit.found.ravel() for hit in on_ground])
    assert 0.2 < shares.mean() < 0.9 and np.any(on_ground[1].platform == 0)


def test_derivatives_take_the_ground_around_a_hit_as_its_plane():
    slope, start = terrain.plane(normal=(0.2, 1.0, -0.3)), jnp.array([0.3, 1.0, 0.2])

    def height(ground: terrain.Terrain, x: jax.Array) -> jax.Array:
        return terrain.cast(ground, x, 3.0).point[1]

    hit = terrain.cast(slope, start[None], 3.0)
    program = OpenProgram(functools.partial(height, terrain.from_hits(None)), start)
    ours = jax.grad(lambda x: program(reading(hit), x))(start)
    np.testing.assert_allclose(ours, jax.grad(functools.partial(height, slope))(start), atol=EXACT)
    np.testing.assert_allclose(ours, [-0.2, 0.0, 0.3], atol=EXACT)


def test_hits_of_other_rays_and_hits_without_a_step_are_refused():
    state, none = jaxik.init(IK, RIG), Transform(jnp.zeros((0, 3)), jnp.zeros((0, 4)))
    frame = dataclasses.replace(at(clip(), 0), platforms=none, platforms_before=none)
    zeros = {size: jnp.zeros((3, *size)) for size in ((), (3,))}
    few = Hit(zeros[3,], zeros[3,], zeros[()], zeros[()])

    def refused(hits: Hit | None) -> str:
        with pytest.raises(ValueError) as error:
            jaxik.step(IK, RIG, terrain.from_hits(hits), state, frame)
        return str(error.value)

    assert "the hits of 3 rays, and the system casts 26 in a frame" in refused(few)
    assert "terrain has no hits, and the system casts 26 in a frame" in refused(None)
    for use in (
        lambda: terrain.cast(terrain.from_hits(few), jnp.zeros((4, 3)), 1.0),
        lambda: jaxik.run(IK, RIG, terrain.from_hits(few), jax.tree.map(lambda x: x[None], frame)),
    ):
        with pytest.raises(ValueError, match="only jaxik.step reads hits that are given"):
            use()
    with pytest.raises(ValueError, match="hits.platform is None; wanted a number for each hit"):
        terrain.from_hits(few, platforms=1)
