"""The likely cause of feet off their ground: each mistake is made, and must be named."""

import numpy as np
import pytest

from fitting.analysis import placement
from fitting.analysis.misplacement import Cause, likely_cause
from fitting.datasets.clip_frames import raised
from fitting.datasets.clips.clip import Clip
from fitting.datasets.synthetic import walker
from fitting.datasets.terrain.meshes import Mesh
from jaxik.world import terrain
from jaxik.world.terrain import Terrain
from support.grounds import hill, terrain_of


@pytest.fixture(scope="module")
def walk() -> Clip:
    return walker.walk(8.0, 30.0, style=walker.WalkStyle(bend=0.0))


def following(clip: Clip, ground: Mesh, factor: float = 1.0) -> Clip:
    """The clip raised by the ground below its pelvis, times a factor."""
    z = clip.positions_ws[:, clip.rig.pelvis, 2]
    order = np.argsort(ground.vertices[:, 2], kind="stable")
    return raised(clip, factor * np.interp(z, *ground.vertices[order][:, [2, 1]].T))


def cause(clip: Clip, flat: Clip, ground: Terrain) -> Cause:
    return likely_cause(placement.soles(clip, flat, ground), clip)


def test_a_root_that_stays_on_its_floor_is_named(walk):
    assert cause(walk, walk, terrain_of(hill())).kind == "root"


@pytest.mark.parametrize("offset", [0.5, -0.3, 0.05])
def test_an_offset_is_named_with_its_size(walk, offset):
    lifted = raised(walk, np.full(walk.frame_count, offset))
    found = cause(lifted, walk, terrain.plane())
    assert found.kind == "offset" and found.amount == pytest.approx(offset, abs=0.005)


def test_an_offset_over_a_hill_is_named(walk):
    lifted = raised(following(walk, hill()), np.full(walk.frame_count, 0.5))
    assert cause(lifted, walk, terrain_of(hill())).kind == "offset"


@pytest.mark.parametrize("unit", [0.3048, 1 / 0.3048, 1 / 0.0254])
def test_feet_that_follow_the_ground_by_the_factor_of_a_unit_name_it(walk, unit):
    found = cause(following(walk, hill(), unit), walk, terrain_of(hill()))
    assert found.kind == "units" and found.amount == pytest.approx(unit)


def test_missing_ground_is_named(walk):
    mesh = hill()
    aside = terrain.mesh(mesh.vertices + [9e5, 0.0, 0.0], mesh.faces)
    assert cause(walk, walk, aside).kind == "missing"


def test_feet_on_their_ground_have_no_cause(walk):
    assert cause(walk, walk, terrain.plane()).kind == "unknown"
