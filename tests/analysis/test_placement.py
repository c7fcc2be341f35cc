"""How feet are placed on their ground, and why: by hand and against a plain NumPy reference."""

import functools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fitting.analysis import placement
from fitting.analysis.misplacement import Cause, likely_cause
from fitting.analysis.placement import Soles
from fitting.datasets.clip_frames import raised
from fitting.datasets.clips.clip import Clip
from fitting.datasets.synthetic import gait, walker
from fitting.datasets.terrain.meshes import Mesh
from jaxik.world import terrain
from jaxik.world.terrain import Terrain
from support.grounds import flight, hill, terrain_of

FLOOR = terrain.plane()
rotation = functools.partial(Rotation.from_quat, scalar_first=True)


@pytest.fixture(scope="module")
def walk() -> Clip:
    return walker.walk(8.0, 60.0, style=walker.WalkStyle(bend=0.0))


def moved(clip: Clip, joint: int, offset: np.ndarray) -> Clip:
    """The clip with one joint of the left leg moved, m."""
    positions = clip.positions_ws.copy()
    positions[:, clip.rig.joints[0][joint]] += offset
    return clip.with_motion(positions, clip.rotations_ws)


def assess(gap: np.ndarray, stance: np.ndarray, clip: Clip) -> placement.Placement:
    """Of the first frames of a clip, whose two points of each sole have the same height."""
    height = np.repeat(np.asarray(gap, float)[..., None], 2, axis=-1)
    cut = clip.select(slice(0, len(gap)))
    return placement.assess(
        Soles(height, np.where(np.isnan(height), np.nan, 0.0), stance), cut, cut
    )


# Heights of soles


def test_soles_are_as_high_as_a_reference_of_rotations_and_interpolation_says(walk):
    """Points below ankle and ball along the foot's up; the ground by interpolation over z."""
    profile_z = np.linspace(-2.0, 30.0, 321)
    profile = 1.0 - np.cos(2.0 * np.pi * np.clip((profile_z - 1.0) / 14.0, 0.0, 1.0))
    lifted = raised(walk, np.linspace(0.0, 0.4, walk.frame_count))
    feet = placement.soles(lifted, walk, terrain_of(hill()))
    for leg in range(2):
        ankle_rot = lifted.rotations_ws[:, lifted.rig.joints[leg][2]]
        foot_rot = np.asarray(lifted.rig.ankle_from_foot)[leg]
        up = rotation(ankle_rot).apply(rotation(foot_rot).apply([0.0, 1.0, 0.0]))
        for point, depth in enumerate((gait.ANKLE_HEIGHT, gait.BALL_HEIGHT)):
            sole = lifted.joints_ws(2 + point)[:, leg] - depth * up
            ground = np.interp(sole[:, 2], profile_z, profile)
            np.testing.assert_allclose(feet.ground[:, leg, point], ground, atol=1e-5)
            np.testing.assert_allclose(feet.height[:, leg, point], sole[:, 1] - ground, atol=1e-5)


def test_the_ground_is_found_above_a_sole_deep_in_it_and_below_a_roof(walk):
    for height in (0.8, -0.5):
        mesh = terrain.combine(terrain.plane((0.0, height, 0.0)), terrain.plane((0.0, 5.0, 0.0)))
        np.testing.assert_allclose(placement.soles(walk, walk, mesh).ground, height)


def test_a_walk_on_its_floor_stands_on_it(walk):
    placed = placement.assess(placement.soles(walk, walk, FLOOR), walk, walk)
    assert placed.sunk == placed.floating == placed.sunk_frames == placed.groundless == 0.0
    assert placed.slide == placed.largest_slide.value == placed.pop.value == 0.0
    assert not placed.misplaced


# Shares


def test_shares_count_frames_of_standing_and_of_moving_feet(walk):
    gap = np.array([[-0.03, 0.0], [0.03, -0.05], [-0.01, 0.2], [np.nan, -0.021]])
    stance = np.array([[True, True], [True, False], [True, False], [True, False]])
    placed = assess(gap, stance, walk)
    assert placed.sunk == pytest.approx(1 / 4)  # of the four standing feet over ground
    assert placed.floating == pytest.approx(1 / 4)
    assert placed.sunk_swing == pytest.approx(2 / 3)
    assert placed.sunk_frames == pytest.approx(3 / 4)
    assert placed.groundless == pytest.approx(1 / 8)
    assert (placed.deepest.value, placed.deepest.frame, placed.deepest.leg) == (0.05, 1, "right")
    assert (placed.highest.value, placed.highest.frame, placed.highest.leg) == (0.03, 1, "left")


def test_the_height_of_a_foot_is_that_of_its_lower_point():
    height = np.array([[[0.10, -0.02], [np.nan, 0.03]], [[np.nan, np.nan], [0.2, 0.1]]])
    gap = Soles(height, height, np.ones((2, 2), bool)).gap
    np.testing.assert_array_equal(gap, [[-0.02, 0.03], [np.nan, 0.1]])


@pytest.mark.parametrize(
    ("gap", "misplaced"), [(0.0, False), (-0.019, False), (-0.021, True), (0.021, True)]
)
def test_feet_are_misplaced_where_more_than_five_per_cent_are_visibly_off(walk, gap, misplaced):
    heights = np.zeros((100, 2))
    heights[:6] = gap
    stance = np.ones((100, 2), bool)
    assert assess(heights, stance, walk).misplaced == misplaced
    heights[:2] = 0.0
    assert not assess(heights, stance, walk).misplaced


def test_feet_without_ground_are_misplaced(walk):
    placed = assess(np.full((10, 2), np.nan), np.ones((10, 2), bool), walk)
    assert placed.misplaced and placed.groundless == 1.0
    assert np.isnan([placed.sunk, placed.floating, placed.deepest.value]).all()


# Slides and pops


def test_a_slide_is_the_path_of_the_ball_beyond_the_animated_one(walk):
    x = 0.001 * np.arange(walk.frame_count)
    sliding = moved(walk, 3, x[:, None] * [1.0, 0.0, 0.0])
    placed = placement.assess(placement.soles(walk, walk, FLOOR), sliding, walk)
    lengths = []
    for stance, ball in zip(walk.stance_labels().T, sliding.joints_ws(3)[..., 0].T, strict=True):
        cuts = np.flatnonzero(np.diff(stance)) + 1
        parts = zip(np.split(stance, cuts), np.split(ball, cuts), strict=True)
        lengths += [np.abs(np.diff(path)).sum() for stands, path in parts if stands[0]]
    assert placed.largest_slide.leg == "left"
    assert placed.largest_slide.value == pytest.approx(max(lengths))
    assert placed.slide == pytest.approx(np.median(lengths), abs=1e-6)


def test_a_pop_is_a_jump_of_the_ankle_relative_to_the_pelvis(walk):
    step = np.where(np.arange(walk.frame_count) >= 77, 0.06, 0.0)[:, None] * [0.0, 1.0, 0.0]
    soles = placement.soles(walk, walk, FLOOR)
    pop = placement.assess(soles, moved(walk, 2, step), walk).pop
    assert (pop.value, pop.frame, pop.leg) == (pytest.approx(0.06), 77, "left")
    whole = walk.with_motion(walk.positions_ws + step[:, None], walk.rotations_ws)
    assert placement.assess(soles, whole, walk).pop.value == pytest.approx(0.0, abs=1e-12)


def test_a_clip_of_one_frame_has_neither_slides_nor_pops(walk):
    still = walk.select(slice(0, 1))
    placed = placement.assess(placement.soles(still, walk.select(slice(0, 1)), FLOOR), still, still)
    assert np.isnan([placed.slide, placed.pop.value]).all()


def test_soles_deep_in_stairs_are_measured_from_the_tread_above(walk):
    feet = placement.soles(walk, walk, terrain_of(flight([1.0, 2.0, 3.0], rise=0.5)))
    assert feet.height.min() == pytest.approx(-1.5, abs=0.05)


# The likely cause of feet off their ground: each mistake is made, and must be named.


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
    found = cause(lifted, walk, FLOOR)
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
    assert cause(walk, walk, FLOOR).kind == "unknown"
