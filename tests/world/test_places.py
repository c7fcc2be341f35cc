"""Places: what moves with the world's origin, and surfaces about another one."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxik.maths.struct import place, struct
from jaxik.world import places, terrain
from jaxik.world.skeleton import Still, Transform
from jaxik.world.terrain import LegTerrains, Terrain
from support.clips import assert_close
from support.meshes import UP, cast, lattice

FAR = np.array([1e5, 2e3, -7e4])  # m, a multiple of the lattice: exact in 32 bits
FAR -= FAR % places.LATTICE
ROUNDING = 4e-6  # m, of 32 bits at 8 m

RNG = np.random.default_rng(3)
# Multiples of 1/64 m, which stay exact far away.
HEIGHTS = np.round(RNG.uniform(0, 64, (17, 17))).astype(np.float32) / 64
VERTICES, TRIANGLES = lattice(HEIGHTS, 0.5, (-4.0, 0.0, -4.0))
STARTS = jnp.asarray(RNG.uniform((-3.9, 1.5, -3.9), (3.9, 2.5, 3.9), (200, 3)), jnp.float32)

GROUNDS: dict[str, Callable[[np.ndarray], Terrain]] = {
    "level plane": lambda by: terrain.plane(by, dtype=np.float32),
    "slanted plane": lambda by: terrain.plane(by, (0.1, 1.0, -0.1), dtype=np.float32),
    "mesh": lambda by: terrain.mesh((VERTICES + by).astype(np.float32), TRIANGLES),
    "heightfield": lambda by: terrain.heightfield(HEIGHTS, 0.5, by + np.array([-4.0, 0.0, -4.0])),
}


def about(ground: Any, by: np.ndarray) -> Any:
    return ground.moved(jnp.asarray(-by, jnp.float32))


@pytest.mark.parametrize("kind", GROUNDS)
def test_rays_meet_ground_far_away_as_exactly_as_near(kind):
    near, far = GROUNDS[kind](np.zeros(3)), about(GROUNDS[kind](FAR), FAR)
    ray, far_ray = (cast(ground, STARTS) for ground in (near, far))
    assert np.asarray(ray.found).all()
    assert_close(far_ray, ray, ROUNDING)


def test_a_slanted_plane_whose_point_is_far_away_is_rounded_in_the_same_way_for_all_rays():
    """Or feet that stand on it would tremble by what numbers at 100 km are rounded by."""
    ground = terrain.plane(normal=(0.1, 1.0, -0.1), dtype=np.float32)
    normal, starts = (np.asarray(x, np.float64) for x in (ground.surfaces[0].normal_ws, STARTS))  # type: ignore[attr-defined]
    over = FAR @ normal / normal[1]  # m, of that place over the plane
    place_ws = FAR - (over - over % places.LATTICE) * UP
    hits = terrain.cast(about(ground, place_ws), STARTS, 100.0)
    errors = np.asarray(hits.distance) - (starts + place_ws) @ normal / normal[1]
    assert np.asarray(hits.found).all()
    assert np.ptp(errors) < 2 * ROUNDING


def test_moved_functions_and_meshes_with_moved_vertices_stay_moved():
    ground = terrain.function(lambda x, z: 0.1 * x - 0.2 * z, dtype=np.float32)
    by = jnp.asarray((16.0, 32.0, -48.0), jnp.float32)
    here, moved = cast(ground, STARTS + by), cast(ground.moved(-by), STARTS)
    np.testing.assert_allclose(moved.point, here.point - by, rtol=0, atol=2e-5)
    ground = GROUNDS["mesh"](np.zeros(3)).moved(jnp.float32(UP))
    raised = ground.with_vertices(jnp.asarray(VERTICES + UP, jnp.float32))
    low, high = (cast(x, STARTS + 2 * jnp.float32(UP)).point for x in (ground, raised))
    np.testing.assert_allclose(high, low + UP, rtol=0, atol=ROUNDING)


def test_platforms_and_grounds_of_legs_are_moved_where_they_are():
    moving = terrain.moving(GROUNDS["mesh"](np.zeros(3)), 0)
    turned = jnp.asarray([[0.8, 0.0, 0.6, 0.0]], jnp.float32)
    at_origin, ship = (
        moving.at(Transform(jnp.asarray(by[None], jnp.float32), turned)) for by in (0 * FAR, FAR)
    )
    starts = 0.7 * STARTS + jnp.float32(UP)
    near, far = (cast(x, starts) for x in (at_origin, about(ship, FAR)))
    np.testing.assert_allclose(far.point, near.point, rtol=0, atol=ROUNDING)
    legs = about(LegTerrains(ship, (ship, ship)), FAR)
    far = terrain.cast(legs, jnp.stack([starts, starts], axis=1), jnp.inf)
    for leg in range(2):
        np.testing.assert_allclose(far.point[:, leg], near.point, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(cast(legs.body, starts).point, near.point, rtol=0, atol=ROUNDING)


def test_the_centre_is_on_a_lattice_absent_with_64_bits_and_no_way_of_derivatives():
    pos = RNG.uniform(-1e5, 1e5, (100, 3)).astype(np.float32)
    centre = np.asarray(places.centre_about(jnp.asarray(pos)))
    assert (np.abs(pos - centre) <= places.LATTICE / 2).all()
    np.testing.assert_array_equal(centre % places.LATTICE, 0.0)
    assert places.centre_about(jnp.asarray(pos, jnp.float64)) is None

    # The height of slanted ground rises with the place as the ground does, about any centre.
    def height(pos: jax.Array, tilt: jax.Array) -> jax.Array:
        ground = terrain.plane(normal=jnp.stack([tilt, 1.0, 0.0]), dtype=np.float32)
        centre = places.centre_about(pos)
        assert centre is not None
        return terrain.cast(ground.moved(-centre), pos - centre, 100.0).point[1] + centre[1]

    pos = jnp.asarray((20.0, 3.0, 30.0), jnp.float32)
    by_pos, by_tilt = jax.grad(height, (0, 1))(pos, jnp.float32(-0.1))
    np.testing.assert_allclose(by_pos, (0.1, 0.0, 0.0), atol=1e-6)
    np.testing.assert_allclose(by_tilt, -20.0, rtol=1e-5)


@struct
class Memory:
    point: Any = place("point")
    height: Any = place("height")
    heights: Any = place("leg height")
    motion: Any = place("motion")
    still: Any = place("motion")
    pose: Any = place("point")
    length: Any
    inner: Any


class Pair(NamedTuple):
    inner: Any
    length: float


def test_declared_places_move_and_nothing_else():
    by, up = jnp.array([1.0, 2.0, 4.0]), jnp.array([0.0, 0.6, 0.8])
    legs_up = jnp.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    quarter = jnp.array([np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0])  # about y
    motion, point = Transform(jnp.array([0.5, 0.0, 0.0]), quarter), jnp.array([3.0, 1.0, 2.0])
    inner = Memory(point, 0.0, jnp.zeros(2), motion, Still(), motion, 7.0, None)
    memory = Memory(point, 1.0, jnp.ones(2), motion, Still(), motion, 5.0, (inner, None))
    after = places.moved(memory, by, up, legs_up)
    np.testing.assert_allclose(after.point, point + by)
    np.testing.assert_allclose(after.height, 1.0 + 0.6 * 2.0 + 0.8 * 4.0)
    np.testing.assert_allclose(after.heights, [3.0, 2.0])
    np.testing.assert_allclose(after.pose.pos, motion.pos + by)
    assert after.length == 5.0
    assert isinstance(after.still, Still)
    # What the motion does to the moved point is what it did to the point, moved.
    np.testing.assert_allclose(after.motion.apply(point + by), motion.apply(point) + by, atol=1e-12)
    np.testing.assert_allclose(after.inner[0].point, point + by)
    assert after.inner[0].length == 7.0
    assert after.inner[1] is None
    for part in (Pair(inner, 2.0), [inner, 2.0], {"inner": inner, "length": 2.0}):
        moved = places.moved(part, by, up, legs_up)
        assert type(moved) is type(part)
        place, length = jax.tree.leaves(moved, is_leaf=lambda value: isinstance(value, Memory))
        np.testing.assert_allclose(place.point, point + by)
        assert length == 2.0
