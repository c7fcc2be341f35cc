"""A flat walk on a hill and on stairs, with the defaults: what a viewer sees of its feet."""

import numpy as np
import pytest

from fitting.datasets.clips.clip import Clip
from fitting.datasets.ground_path import AS_ANIMATED, place_root
from fitting.datasets.synthetic import walker
from fitting.datasets.terrain.meshes import Mesh
from fitting.experiments.systems import preset_system
from fitting.studies.animations import Animation
from support.grounds import edges_between_footfalls, flight, hill, terrain_of

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def walk() -> Clip:
    return walker.walk(10.0, 60.0, style=walker.WalkStyle(bend=0.0))


@pytest.fixture(scope="module")
def grounds(walk) -> dict[str, Mesh]:
    edges = edges_between_footfalls(walk, 8)
    return {"hill": hill(), "four steps": flight(edges[:4]), "eight steps": flight(edges)}


@pytest.mark.parametrize("ground", ["hill", "eight steps"])
@pytest.mark.parametrize("preset", ["record", "stride"])
def test_standing_feet_are_on_the_ground(walk, grounds, preset, ground):
    surface = terrain_of(grounds[ground])
    clip, root = place_root(walk, surface)
    animation = Animation(clip, surface, root=root)
    _, solved = animation.solve(preset_system(preset))
    placed, cause = animation.assess(solved)
    assert root.root == "ground" and placed.groundless == 0.0 and cause is None
    assert placed.sunk <= 0.01 and placed.floating < 0.05


@pytest.mark.parametrize("ground", ["four steps", "eight steps"])
def test_neither_root_nor_pelvis_pops_on_stairs(walk, grounds, ground):
    surface = terrain_of(grounds[ground])
    clip, root = place_root(walk, surface)
    _, solved = Animation(clip, surface, root=root).solve(preset_system("record"))
    pelvis = solved.positions_ws[:, solved.rig.pelvis, 1]
    assert root.rise is not None and np.abs(np.diff(root.rise)).max() < 0.02
    assert np.abs(np.diff(pelvis)).max() < 0.02


@pytest.mark.parametrize(
    ("preset", "ground"), [("record", "hill"), ("record", "four steps"), ("stride", "hill")]
)
def test_a_root_left_on_its_floor_is_named_as_the_cause(walk, grounds, preset, ground):
    animation = Animation(walk, terrain_of(grounds[ground]), root=AS_ANIMATED)
    _, solved = animation.solve(preset_system(preset))
    placed, cause = animation.assess(solved)
    assert placed.misplaced and placed.sunk > 0.5
    assert cause is not None and cause.kind == "root"


def test_a_system_with_a_root_rule_of_its_own_is_raised_once(walk, grounds):
    surface = terrain_of(grounds["hill"])
    clip, root = place_root(walk, surface)
    _, solved = Animation(clip, surface, root=root).solve(preset_system("ozz"))
    feet = solved.joints_ws(2)[..., 1]
    assert feet.max() < 2.4 and feet.max() > 2.0
