"""Swings that the start of a clip cuts off, against those of the whole clip."""

import dataclasses
import functools

import numpy as np
import pytest

import jaxik
from fitting.datasets.clip_frames import frames_from_clip
from fitting.datasets.clips import Clip, contacts
from fitting.datasets.cut_off_swings import with_cut_off_swings
from fitting.datasets.ground_path import SKY, heights_under, place_root
from fitting.datasets.synthetic import walker
from fitting.studies.animations import Animation
from jaxik.world.terrain import Terrain
from support.grounds import edges_between_footfalls, flight, terrain_of

FPS, LEG = 60.0, 1


@functools.cache
def walk() -> Clip:
    clip = walker.walk(8.0, FPS, style=walker.WalkStyle(bend=0.0))
    return dataclasses.replace(clip, stance=clip.stance_labels())


def swing() -> tuple[int, int]:
    """The last frame of a stance in the middle of the walk, and the first one of the next."""
    stances = contacts.runs(walk().stance_labels()[:, LEG])
    return stances[3][1], stances[4][0]


def cut(part: float) -> Clip:
    """The walk from where so much of a swing has passed."""
    leaving, landing = swing()
    return walk().select(np.arange(round(leaving + part * (landing - leaving)), walk().frame_count))


def ground(rise: float) -> Terrain:
    return terrain_of(flight(edges_between_footfalls(walk(), 12), rise))


@pytest.mark.parametrize("part", [0.05, 0.3, 0.6, 0.95])
def test_a_swing_begins_where_the_whole_clip_shows_it(part):
    clip, (leaving, landing) = cut(part), swing()
    first, last = contacts.runs(walk().stance_labels()[:, LEG])[3]
    expected = np.median(walk().joints_ws(3)[first : last + 1, LEG], axis=0)
    cut_off = contacts.cut_off_swing(clip.joints_ws(3)[:, LEG], clip.stance_labels()[:, LEG])
    assert cut_off is not None
    np.testing.assert_allclose(cut_off.last_ws[[0, 2]], expected[[0, 2]], atol=0.06)
    frames = np.arange(walk().frame_count - clip.frame_count, landing)
    fraction, frame = (frames - leaving) / (landing - leaving), 1 / (landing - leaving)
    np.testing.assert_allclose(cut_off.fraction, fraction, atol=2 * frame)


def test_a_clip_that_starts_standing_or_lands_once_has_none():
    clip = cut(0.5)
    balls_ws, stance = clip.joints_ws(3)[:, LEG], clip.stance_labels()[:, LEG]
    first, last = contacts.runs(stance)[0]
    for part in (slice(first, None), slice(last + 5), slice(first)):
        assert contacts.cut_off_swing(balls_ws[part], stance[part]) is None


@pytest.mark.parametrize(("rise", "changes"), [(-0.15, True), (0.0, False), (0.15, False)])
def test_only_higher_ground_counts(rise, changes):
    clip = cut(0.3)
    plain = frames_from_clip(clip)
    stride = with_cut_off_swings(plain, clip, ground(rise)).stride
    assert np.any(stride.last_ws != plain.stride.last_ws) == changes
    assert np.any(stride.fraction != plain.stride.fraction) == changes
    before = contacts.runs(clip.stance_labels()[:, LEG])[0][0]
    np.testing.assert_array_equal(stride.last_ws[before:], plain.stride.last_ws[before:])
    np.testing.assert_array_equal(stride.next_ws, plain.stride.next_ws)


def test_after_a_teleport_it_counts_too():
    clip = cut(0.3)
    both = walk().select(np.r_[np.arange(60), np.arange(walk().frame_count)[-clip.frame_count :]])
    assert both.cuts == (60,)
    stairs = ground(-0.15)
    alone, joined = (
        with_cut_off_swings(frames_from_clip(each), each, stairs).stride for each in (clip, both)
    )
    np.testing.assert_array_equal(joined.last_ws[60:], alone.last_ws)
    np.testing.assert_array_equal(joined.fraction[60:], alone.fraction)


def test_down_stairs_a_foot_swings_over_those_that_it_comes_from():
    clip, stairs = cut(0.1), ground(-0.15)
    placed, root = place_root(clip, stairs)
    animation = Animation(placed, stairs, root=root)
    plain = dataclasses.replace(animation, given_frames=frames_from_clip(placed, rise=root.rise))
    before = contacts.runs(clip.stance_labels()[:, LEG])[0][0]

    def lowest(animation: Animation) -> float:
        _, solved = animation.solve(jaxik.presets.stride())
        balls_ws = solved.joints_ws(3)[:before, LEG]
        return float(np.min(balls_ws[:, 1] - heights_under(stairs, balls_ws, SKY)))

    assert lowest(animation) > -0.01
    assert lowest(plain) < -0.05
