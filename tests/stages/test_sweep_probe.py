"""The probe that is as wide as a foot: slopes as with rays, cracks as if they were not there."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import jaxik
from jaxik import HARD
from jaxik.stages.inputs import Inputs
from jaxik.stages.probe import FootProbe, SweepProbe
from jaxik.world import terrain
from support.cases import QUICK, RIG
from support.clips import animate, planes, to_frames, to_rig, to_terrain

FRAME = jax.tree.map(lambda x: x[0], to_frames(animate(RIG, count=1)))
ALONG = np.linspace(0.0, 0.3, 61)  # m, places of the character


@functools.partial(jax.jit, compiler_options=QUICK)
def ground_under(probe: Any, ground: Any, places: jax.Array) -> Any:
    """What a probe finds under the left foot of a character at these places, m forward."""

    def sense(place: jax.Array) -> Any:
        root = dataclasses.replace(
            FRAME.world_from_model, pos=jnp.stack([0.0 * place, 0.0 * place, place])
        )
        frame = dataclasses.replace(FRAME, world_from_model=root)
        inputs = Inputs(to_rig(RIG), ground, frame, HARD)
        contact = jaxik.presets.ozz().contact.sense(inputs)
        hit = probe.sense(inputs, contact, jnp.asarray(0.08)).ankle
        return hit.point[0, 1], hit.normal[0], hit.found[0]

    return jax.vmap(sense)(places)


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
    swept = ground_under(SweepProbe(), slope, ALONG)
    cast = ground_under(FootProbe(use_toe=False), slope, ALONG)
    for ours, theirs in zip(swept, cast, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9)


def test_a_foot_does_not_fall_through_a_grating():
    ground = grating()
    height, normal, found = ground_under(SweepProbe(), SweepProbe().prepare(ground), ALONG)
    np.testing.assert_allclose(height, 0.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(normal, np.tile([0.0, 1.0, 0.0], (61, 1)), rtol=0, atol=1e-9)
    assert (np.asarray(found) == 1).all()
    cast, _, _ = ground_under(FootProbe(use_toe=False), ground, ALONG)
    assert np.ptp(cast) == pytest.approx(0.3), "rays do"


def test_a_mesh_that_was_not_prepared_is_refused():
    with pytest.raises(ValueError, match="sweepable"):
        ground_under(SweepProbe(), grating(), ALONG)
