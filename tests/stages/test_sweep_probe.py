"""The probe that is as wide as a foot: slopes as with rays, cracks as if they were not there."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import jaxik
from jaxik.stages.probe import AbstractProbe, FootProbe, SweepProbe
from jaxik.world import terrain
from support.cases import RIG
from support.clips import animate, planes, to_frames, to_terrain
from support.probing import ground_under


def hits(probe: AbstractProbe, ground: terrain.Terrain) -> list[np.ndarray]:
    """Heights, m, normals and weights of what a probe finds under the left foot, up to 0.3 m on."""
    frames = to_frames(animate(RIG, count=1) * 61)
    along = jnp.linspace(0.0, 0.3, 61)[:, None] * jnp.asarray([0.0, 0.0, 1.0])
    ik = dataclasses.replace(jaxik.presets.ozz(), probe=probe)
    hit = ground_under(ik, ground, frames.translated(along)).ankle
    return [np.asarray(x)[:, 0] for x in (hit.point[..., 1], hit.normal, hit.found)]


def grating() -> terrain.Terrain:
    """Bars 10 cm wide with gaps of 5 cm between them, 0.3 m over a floor."""
    bars = []
    for place in np.arange(-4, 9) * 0.15:
        bar = trimesh.creation.box((4.0, 0.1, 0.1))
        bar.apply_translation((0.0, -0.05, place))
        bars.append(bar)
    mesh = trimesh.util.concatenate(bars)
    assert isinstance(mesh, trimesh.Trimesh)
    level = terrain.mesh(np.array(mesh.vertices), np.array(mesh.faces))
    return terrain.combine(level, terrain.plane((0.0, -0.3, 0.0)))


def test_on_slopes_it_finds_what_rays_find():
    slope = to_terrain(planes((0.5, -0.3, 0.0)))
    swept, cast = hits(SweepProbe(), slope), hits(FootProbe(use_toe=False), slope)
    for ours, theirs in zip(swept, cast, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9)


def test_a_foot_does_not_fall_through_a_grating():
    ground = grating()
    height, normal, found = hits(SweepProbe(), SweepProbe().prepare(ground))
    np.testing.assert_allclose(height, 0.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(normal, np.tile([0.0, 1.0, 0.0], (61, 1)), rtol=0, atol=1e-9)
    assert (found == 1).all()
    cast, _, _ = hits(FootProbe(use_toe=False), ground)
    assert np.ptp(cast) == pytest.approx(0.3), "rays do"


def test_a_mesh_that_was_not_prepared_is_refused():
    with pytest.raises(ValueError, match="sweepable"):
        hits(SweepProbe(), grating())
