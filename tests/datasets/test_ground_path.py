"""The ground along a path, and where the root of a clip is put over it."""

import dataclasses

import numpy as np
import pytest

from fitting.datasets import ground_path
from fitting.datasets.clip_frames import raised
from fitting.datasets.clips.clip import Clip
from fitting.datasets.synthetic import gait, walker
from jaxik.world import terrain
from support import bodies
from support.grounds import edges_between_footfalls, flight, hill, terrain_of

STRAIGHT = walker.WalkStyle(bend=0.0)


@pytest.fixture(scope="module")
def clip():
    return walker.walk(11.0, 60.0, style=STRAIGHT)


@pytest.fixture(scope="module")
def short():
    return walker.walk(4.0, 60.0, style=STRAIGHT)


def slab(z0: float, z1: float, height: float) -> terrain.Terrain:
    corners = [[-3.0, height, z0], [3.0, height, z0], [3.0, height, z1], [-3.0, height, z1]]
    return terrain.mesh(np.array(corners), np.array([[0, 2, 1], [0, 3, 2]]))


def path_of(clip: Clip, ground: terrain.Terrain, floor: float = 0.0) -> np.ndarray:
    heights = ground_path.path_heights(clip, ground, floor)
    assert heights is not None
    return heights


def pelvis_z(clip) -> np.ndarray:
    return clip.positions_ws[:, clip.rig.pelvis, 2]


# The path


def test_a_path_is_the_ground_below_the_pelvis(clip):
    inside = np.clip((pelvis_z(clip) - 1.0) / 14.0, 0.0, 1.0)
    heights = path_of(clip, terrain_of(hill()))
    np.testing.assert_allclose(heights, 1.0 - np.cos(2.0 * np.pi * inside), atol=1e-3)


def test_a_path_passes_under_ceilings_and_starts_on_the_ground_next_to_the_floor(short):
    house = terrain.combine(slab(-2.0, 9.0, 0.1), slab(-2.0, 9.0, 2.5))
    np.testing.assert_allclose(path_of(short, house), 0.1)
    np.testing.assert_allclose(path_of(short, house, floor=2.4), 2.5)
    # Ground far above the floor is found where there is no other.
    np.testing.assert_allclose(path_of(short, slab(-2.0, 9.0, 40.0)), 40.0)


@pytest.mark.parametrize("bottom", [[], [slab(-2.0, 9.0, -30.0)]])
def test_a_path_crosses_a_gap_near_the_height_of_its_edges(short, bottom):
    gap = terrain.combine(slab(-2.0, 2.0, 0.0), slab(2.4, 9.0, 0.2), *bottom)
    heights = path_of(short, gap)
    z = pelvis_z(short)
    np.testing.assert_allclose(heights[z < 2.0], 0.0, atol=1e-12)
    np.testing.assert_allclose(heights[z > 2.4], 0.2, atol=1e-12)
    assert heights.min() > -0.7


@pytest.mark.parametrize("size", [1.0, 0.5])
def test_a_path_falls_off_a_cliff_at_a_speed_that_is_limited_by_the_size_of_the_body(short, size):
    cliff = terrain.combine(slab(-2.0, 2.0 * size, 0.0), slab(2.0 * size, 9.0, -3.0 * size))
    heights = path_of(bodies.scaled(short, size), cliff)
    assert heights[-1] == pytest.approx(-3.0 * size)
    falling = heights[(heights < -0.01) & (heights > -1.9 * size)]
    speed = ground_path.FALL * size**0.5
    np.testing.assert_allclose(np.diff(falling), -speed / 60.0, rtol=1e-6)


def test_a_path_with_less_than_half_of_its_ground_is_none(short):
    length = pelvis_z(short)[-1]
    assert ground_path.path_heights(short, slab(-2.0, 0.4 * length, 0.0)) is None
    path_of(short, slab(-2.0, 0.6 * length, 0.0))


# Smoothing


def test_smoothing_keeps_a_ramp_and_spreads_a_step_over_a_window_ahead_and_back():
    ramp = np.linspace(0.0, 2.0, 200)
    smoothed = ground_path.smooth(ramp, 60.0)
    np.testing.assert_allclose(smoothed[31:-31], ramp[31:-31], atol=1e-12)
    np.testing.assert_allclose(ground_path.smooth(np.full(50, 0.3), 20.0), 0.3)
    step = np.where(np.arange(201) > 100, 0.15, 0.0)
    smoothed = ground_path.smooth(step, 60.0)
    np.testing.assert_allclose(smoothed + smoothed[::-1], 0.15, atol=0.01)
    assert smoothed[70] == 0.0 and smoothed[131] == pytest.approx(0.15)
    hann = np.hanning(61)
    np.testing.assert_allclose(np.diff(smoothed).max(), 0.15 * hann.max() / hann.sum(), rtol=1e-9)


def test_a_stride_lasts_from_touchdown_to_touchdown(clip):
    assert ground_path.stride_seconds(clip) == pytest.approx(gait.PERIOD, rel=0.03)
    standing = dataclasses.replace(clip, stance=np.ones((clip.frame_count, 2), bool))
    assert ground_path.stride_seconds(standing) == ground_path.USUAL_STRIDE


@pytest.mark.parametrize("tread", [0.3, 0.62])
def test_the_root_climbs_eight_steps_of_15_cm_by_less_than_2_cm_a_frame(clip, tread):
    ground = terrain_of(flight([3.0 + tread * step for step in range(8)]))
    _, choice = ground_path.place_root(clip, ground)
    assert np.asarray(choice.rise)[-1] == pytest.approx(1.2)
    assert np.abs(np.diff(np.asarray(choice.rise))).max() < 0.02


# Where the root is put


def test_a_root_goes_on_a_hill_and_on_stairs(clip):
    for mesh in (hill(), flight(edges_between_footfalls(clip, 4))):
        ground = terrain_of(mesh)
        assert ground_path.place_root(clip, ground, "animation") == (clip, ground_path.AS_ANIMATED)
        flat, choice = ground_path.place_root(clip, ground)
        assert flat is clip and choice.root == "ground"
        assert choice.reason.startswith("on the ground below it, 0 to ")
        path = path_of(clip, ground)
        window = ground_path.stride_seconds(clip) * clip.fps
        np.testing.assert_array_equal(choice.rise, ground_path.smooth(path, window))


def test_a_root_is_put_on_the_ground_relative_to_the_floor(short):
    lifted = raised(short, np.full(short.frame_count, 0.3))
    _, choice = ground_path.place_root(lifted, slab(-2.0, 9.0, 2.3), "ground", floor=0.3)
    np.testing.assert_allclose(np.asarray(choice.rise), 2.0)
    _, choice = ground_path.place_root(short, slab(-2.0, 9.0, 0.1), "ground")
    np.testing.assert_allclose(np.asarray(choice.rise), 0.1)


@pytest.mark.parametrize(("height", "root"), [(0.0, "animation"), (0.39, "animation"),
                                              (-0.39, "animation"), (0.41, "ground")])  # fmt: skip
def test_a_root_stays_as_animated_where_foot_ik_reaches_the_ground(short, height, root):
    flat, choice = ground_path.place_root(short, slab(-2.0, 9.0, height))
    assert flat is short and choice.root == root
    if root == "animation":
        assert choice.reason.startswith("as animated: the ground is ")


def test_the_ground_is_taken_out_from_under_a_clip_that_follows_it(clip):
    ground = terrain_of(hill())
    _, choice = ground_path.place_root(clip, ground)
    following = raised(clip, choice.rise)
    flat, again = ground_path.place_root(following, ground)
    assert again.reason == "as animated: the clip follows this terrain already"
    np.testing.assert_allclose(raised(flat, again.rise).positions_ws, following.positions_ws)
    np.testing.assert_allclose(flat.positions_ws, clip.positions_ws, atol=1e-9)


def test_without_ground_below_its_path_a_root_stays_as_animated(short):
    aside = slab(-99.0, -90.0, 0.0)
    flat, choice = ground_path.place_root(short, aside)
    assert flat is short and choice.rise is None and "no ground below" in choice.reason
    with pytest.raises(ValueError, match="walker seed 0: there is no ground below most of its"):
        ground_path.place_root(short, aside, "ground")
    with pytest.raises(ValueError, match="root is 'floor'; wanted one of auto, animation, ground"):
        ground_path.place_root(short, aside, "floor")
