"""Roots that put the character on its ground: without pops, late or early nowhere."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fitting
import jaxik
from fitting.ground import ground_path
from fitting.synthetic import walker
from jaxik.pipeline.frames import Clip
from jaxik.stages.inputs import Inputs
from jaxik.stages.root import AbstractRoot, GroundRoot, KeepRoot
from jaxik.world import terrain
from support.clips import at
from support.gradients import finite_jacobian
from support.grounds import edges_between_footfalls, flight, hill

HZ = 60.0
WIDTH = 20.0  # m between two grounds of `GROUNDS`, side by side along x


@functools.cache
def walk() -> fitting.Clip:
    return walker.walk(7.0, HZ)


@functools.cache
def frames() -> jaxik.Frame:
    return fitting.frames_from_clip(walk())


@jax.jit
def heights(ground: terrain.Terrain, clip: jaxik.Frame, rule: AbstractRoot) -> jax.Array:
    """How far the rule moves the root in each frame, m."""
    rig, ik = walk().rig, dataclasses.replace(jaxik.presets.record(), root=rule)
    inputs = Inputs(rig, ground, clip, jaxik.HARD)
    state = jaxik.init(ik, rig)
    clip_frames = Clip(ik, inputs, state, None, {})
    return clip_frames.ahead("root", lambda ik, inputs: ik.root.sense(inputs)).output


@functools.cache
def grounds() -> tuple[list[str], terrain.Terrain]:
    """Names of grounds, and all of them side by side: one mesh, and so one program for all."""
    edges = edges_between_footfalls(walk(), 8)
    meshes = {
        "hill": hill(),
        "four steps up": flight(edges[:4]),
        "eight steps up": flight(edges),
        "eight steps down": flight(edges, -0.15),
        "curb": flight(edges[3:4]),
    }
    vertices, faces, count = [], [], 0
    for number, mesh in enumerate(meshes.values()):
        vertices.append(np.asarray(mesh.vertices) + [WIDTH * number, 0.0, 0.0])
        faces.append(np.asarray(mesh.faces) + count)
        count += len(mesh.vertices)
    return list(meshes), terrain.mesh(np.concatenate(vertices), np.concatenate(faces))


@pytest.mark.parametrize(
    "name", ["hill", "four steps up", "eight steps up", "eight steps down", "curb"]
)
def test_the_root_takes_hills_and_steps_evenly_and_is_late_nowhere(name):
    names, ground = grounds()
    shift = np.array([WIDTH * names.index(name), 0.0, 0.0])
    lifted = heights(ground, frames().translated(jnp.asarray(shift)), GroundRoot())
    assert np.ptp(lifted) > 0.1
    if name != "hill":  # which rises by 1 cm a frame itself
        assert np.abs(np.diff(lifted)).max() < 0.01, "m in a frame"
    pelvis = walk().positions_ws[:, walk().rig.pelvis, 1]
    jerks = [np.abs(np.diff(x, 3)).max() for x in (lifted, pelvis)]
    assert jerks[0] < 1.1 * jerks[1]
    clip = walk().with_motion(walk().positions_ws + shift, walk().rotations_ws)
    path = ground_path.path_heights(clip, ground)
    assert path is not None
    # The average over a stride in both directions of time, which no game could compute.
    ideal = ground_path.smooth(path, 1.05 * HZ)
    limit = 0.06 if name == "hill" else 0.03  # the stride's average cuts the top of the hill
    assert np.abs(lifted - ideal).max() < limit


def test_a_half_life_of_0_puts_the_root_on_the_ground_at_once():
    names, ground = grounds()
    shift = jnp.array([WIDTH * names.index("eight steps up"), 0.0, 0.0])
    clip = frames().translated(shift)
    hit = terrain.cast(ground, clip.world_from_model.pos + jnp.array([0.0, 10.0, 0.0]), jnp.inf)
    lifted = heights(ground, clip, GroundRoot(half_life=0.0))
    np.testing.assert_allclose(lifted, hit.point[:, 1], atol=1e-12)
    assert np.diff(lifted).max() == pytest.approx(0.15)


@functools.cache
def glide() -> jaxik.Frame:
    """A character that moves along +z through x = 0 without moving its legs."""
    many = jax.tree.map(lambda leaf: jnp.repeat(leaf[:1], 180, axis=0), frames())
    way = np.array([0.0, 0.0, 1.4])  # m/s
    place = jnp.asarray(np.outer(np.arange(180) / HZ, way))
    root = jaxik.Transform(place, many.world_from_model.rot)
    return dataclasses.replace(many, world_from_model=root, velocity_ws=jnp.tile(way, (180, 1)))


def ground_of(behind: Any, near: Any, ahead: Any) -> terrain.Terrain:
    """Ground up to z = 1, to 2 and on from there, each by a height or that of both ends, m.

    There is none where the height is NaN. All share a program.
    """
    parts = zip((behind, near, ahead), (-39.0, 1.0, 2.0), (40.0, 1.0, 40.0), strict=True)
    fields = []
    for ends, start, length in parts:
        here = np.isfinite(ends).all()  # else far away
        rows = np.reshape(np.where(here, ends, 0.0), (-1, 1))
        heights = jnp.asarray(np.broadcast_to(rows, (2, 2)))
        corner = (-10.0 if here else 500.0, 0.0, start)
        field = terrain.heightfield(heights, (20.0, length), corner, interpolation="triangulated")
        fields.append(field)
    return terrain.combine(*fields)


def step(height: float) -> terrain.Terrain:
    return ground_of(0.0, 0.0, height)


RAMP = ground_of((-15.6, 0.4), (0.4, 0.8), (0.8, 16.8))


@pytest.mark.parametrize("half_life", [0.1, 0.2, 0.4])
def test_on_a_ramp_the_root_is_on_the_ramp(half_life):
    clip = glide()
    lifted = heights(RAMP, clip, GroundRoot(half_life=half_life))
    np.testing.assert_allclose(lifted, 0.4 * clip.world_from_model.pos[:, 2], atol=1e-4)


@pytest.mark.parametrize("height", [-2.0, 1.5])
def test_a_ledge_or_a_wall_ahead_does_not_count_before_it_is_below_the_character(height):
    clip = glide()
    lifted = heights(step(height), clip, GroundRoot())
    before = np.asarray(clip.world_from_model.pos[:, 2]) < 2.0
    np.testing.assert_allclose(lifted[before], 0.0, atol=1e-6)
    assert abs(lifted[-1] - height) < 0.02


@pytest.mark.parametrize("height", [0.45, 2.4])
def test_nothing_lifts_a_character_that_goes_below_a_bench_or_a_roof(height):
    fields = [
        terrain.heightfield(jnp.full((2, 2), level), (20.0, length), (-10.0, 0.0, start),
                            interpolation="triangulated")
        for level, start, length in ((0.0, -39.0, 80.0), (height, 1.0, 0.5), (height, 2.0, 0.5))
    ]  # fmt: skip
    lifted = heights(terrain.combine(*fields), glide(), GroundRoot())
    np.testing.assert_allclose(lifted, 0.0, atol=1e-6)


def test_the_root_crosses_gaps_narrower_than_itself():
    fields = [
        terrain.heightfield(jnp.full((2, 2), level), (20.0, length), (-10.0, 0.0, start),
                            interpolation="triangulated")
        for level, start, length in ((-0.3, -39.0, 80.0), (0.0, -39.0, 40.0), (0.0, 1.14, 40.0))
    ]  # fmt: skip
    ground = terrain.combine(*fields)
    np.testing.assert_allclose(heights(ground, glide(), GroundRoot()), 0.0, atol=1e-6)
    assert heights(ground, glide(), GroundRoot(max_gap=0.1)).min() < -0.01


def test_the_root_moves_no_faster_than_its_limit():
    lifted = heights(step(-2.0), glide(), GroundRoot(max_speed=1.0))
    speed = np.abs(np.diff(lifted)) * HZ
    assert speed.max() == pytest.approx(1.0, abs=1e-4) and (speed > 0.99).sum() > 60


def test_in_the_air_the_root_waits_for_the_landing():
    clip = glide()
    time = np.arange(180)
    grounded = jnp.asarray(1.0 - ((time > 60) & (time < 120)))
    lifted = heights(step(0.3), dataclasses.replace(clip, grounded=grounded), GroundRoot())
    np.testing.assert_allclose(lifted[61:120], lifted[60], atol=1e-6)
    assert np.abs(np.diff(lifted)).max() < 0.02 and lifted[-1] == pytest.approx(0.3, abs=0.02)


def test_a_root_starts_settled_and_keeps_its_height_over_a_hole_and_where_the_ground_ends():
    short = 0.2  # m, less than a step: the root does not sink to the end of its ray
    cases = ((0.2, np.nan, 0.2), np.inf), ((0.0, 0.0, np.nan), short), ((0.7,) * 3, np.inf)
    for ends, ray_down in cases:
        lifted = heights(ground_of(*ends), glide(), GroundRoot(ray_down=ray_down))
        np.testing.assert_allclose(lifted, ends[0], atol=1e-6, err_msg=f"{ends}")


def test_without_ground_or_switched_off_the_root_stays_where_the_game_has_it():
    nothing = ground_of(np.nan, np.nan, np.nan)
    np.testing.assert_array_equal(heights(nothing, glide(), GroundRoot()), 0.0)
    np.testing.assert_array_equal(heights(step(0.3), glide(), GroundRoot(enabled=False)), 0.0)


def test_a_root_without_memory_costs_no_scan():
    for rule, scans in ((KeepRoot(), False), (GroundRoot(), True)):
        program = jax.make_jaxpr(lambda clip: heights(step(0.1), clip, rule))(glide())  # noqa: B023
        assert ("scan[" in str(program)) == scans


def last_height(half_life: jax.Array, max_speed: jax.Array, speed: jax.Array) -> jax.Array:
    """Where the rule puts a character that goes up the ramp at this speed."""
    clip = at(glide(), slice(0, 40))
    moving = dataclasses.replace(clip, velocity_ws=clip.velocity_ws * speed)
    return heights(RAMP, moving, GroundRoot(half_life=half_life, max_speed=max_speed))[-1:]


@pytest.mark.slow
@pytest.mark.parametrize(
    "numbers", [(0.2, 4.0, 1.0), (0.2, 4.0, 0.0), (0.0, 4.0, 1.0), (0.2, 0.5, 1.0)]
)
def test_the_root_has_finite_derivatives_on_the_spot_too(numbers):
    finite_jacobian(last_height, *numbers)
