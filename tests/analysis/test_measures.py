"""Measures of simple motions, and how feet are placed on their ground, and why."""

import dataclasses
import functools
from itertools import product
from unittest.mock import ANY

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fitting.clips.clip import Clip
from fitting.clips.clip_frames import raised
from fitting.motion import measures
from fitting.motion.measures import FootStates, Measures, Soles, likely_cause
from fitting.motion.playback import Motion
from fitting.synthetic import footsteps, walker
from jaxik.world import terrain
from support.grounds import flight, hill, terrain_of
from support.sample_clips import seen_within

UP = np.array([0.0, 1.0, 0.0])


def standing(frames: int, legs: int = 2, knee: float = np.pi / 2) -> Motion:
    """Legs that stand still with this knee angle, rad."""
    hip = np.array([0.0, 0.9, 0.0])
    shin = 0.4 * np.array([0.0, np.cos(knee), np.sin(knee)])
    knee_pos = hip - [0.0, 0.4, 0.0]
    positions = [hip, hip, knee_pos, knee_pos + shin, np.array([0.0, 0.05, 0.1])]
    pelvis, *joints = (np.broadcast_to(pos, (frames, 3)).copy() for pos in positions)
    return Motion(pelvis, *(np.repeat(joint[:, None], legs, axis=1) for joint in joints))


def shifted(motion: Motion, joint: str, offset: np.ndarray) -> Motion:
    return dataclasses.replace(motion, **{joint: getattr(motion, joint) + offset})


def measure(
    motion: Motion, animated: Motion | None = None, fps: float = 60.0, **feet: np.ndarray
) -> Measures:
    """Measures of a motion; its feet stand on the ground and reach their targets by default."""
    shape = motion.ankle.shape[:2]
    states = FootStates(np.zeros(shape), np.ones(shape, bool), np.ones(shape))
    return measures.measure(motion, animated or motion, dataclasses.replace(states, **feet), fps)


# Ground


def test_the_gap_of_a_sole_is_that_of_its_lower_point():
    soles = np.zeros((1, 4, 2, 3))
    soles[..., 1] = [0.10, 0.30]
    ground = np.array([[[0.0, 0.0], [0.0, 0.35], [np.nan, 0.1], [np.nan, np.nan]]])
    np.testing.assert_allclose(measures.gaps(soles, ground), [[0.10, -0.05, 0.2, np.nan]])


def test_penetration_counts_all_frames_and_clearance_those_of_stances():
    gap = np.array([[-0.04, 0.02], [0.0, 0.06], [np.nan, 0.5], [0.01, np.nan]])
    stance = np.array([[True, True], [True, True], [True, False], [False, True]])
    result = measure(standing(4), gap=gap, stance=stance)
    assert result.penetration_mean == pytest.approx(0.04 / 6)
    assert result.penetration_max == pytest.approx(0.04)
    assert result.clearance == pytest.approx((0.0 + 0.02 + 0.0 + 0.06) / 4)


# Slide


def test_slide_is_the_length_of_the_horizontal_path_and_not_the_displacement():
    ball = np.zeros((5, 1, 3))
    ball[:, 0, 0] = [0.0, 0.01, 0.0, 0.01, 0.0]  # back and forth
    ball[:, 0, 1] = [0.0, 0.3, 0.0, 0.3, 0.0]  # up and down does not count
    assert measures.slide_per_stance(ball, np.ones((5, 1), bool)) == pytest.approx(0.04)
    single_frames = np.array([[True], [False], [True], [False], [False]])
    assert np.isnan(measures.slide_per_stance(ball, single_frames))


def test_slide_is_the_median_over_the_stances_of_all_feet():
    stance = np.array([1, 1, 1, 0, 1, 1, 0, 1, 1], bool)
    ball = np.zeros((9, 2, 3))
    ball[:, 0, 2] = [0.0, 0.01, 0.02, 0.5, 1.0, 1.05, 1.5, 2.0, 2.01]  # 2, 5 and 1 cm in stances
    ball[:, 1, 0] = 0.03 * np.arange(9)
    stances = np.stack([stance, np.arange(9) < 5], axis=1)  # the other foot: 12 cm
    assert measures.slide_per_stance(ball, stances) == pytest.approx((0.02 + 0.05) / 2)


# Pops


def test_a_jump_is_one_pop_at_every_frame_rate():
    for fps, size in ((60, 0.05), (120, 0.05), (240, 0.05), (30, 0.025)):
        animated, jump = standing(fps, legs=3), np.zeros((fps, 3, 3))
        jump[fps // 2 :, 1, 1] = 0.05
        result = measure(shifted(animated, "ankle", jump), animated, float(fps))
        assert result.pops == 1 and result.pop_max == pytest.approx(size), fps


def test_a_correction_that_changes_steadily_measures_the_same_at_every_frame_rate():
    for fps, (speed, pops) in product((24.0, 30.0, 60.0, 90.0, 120.0), ((1.5, 2), (1.0, 0))):
        animated = standing(frames := round(2 * fps))
        times = [0.0, 0.5, 1.0, 1.5]
        back_and_forth = np.interp(np.arange(frames) / fps, times, [0.0, 1.0, 1.0, 0.0])
        offset = np.zeros((frames, 2, 3))
        offset[:, 0, 2] = 0.5 * speed * back_and_forth
        result = measure(shifted(animated, "ankle", offset), animated, fps)
        assert result.pop_max == pytest.approx(speed / 60.0), (fps, speed)
        assert result.pops == pops, (fps, speed)


def test_motion_of_the_animation_itself_is_no_pop():
    leaping = shifted(standing(10), "ankle", np.arange(10.0)[:, None, None] * np.ones(3))
    for motion in (leaping, shifted(leaping, "ankle", 0.1 * UP)):
        result = measure(motion, leaping)
        assert result.pop_max == pytest.approx(0.0, abs=1e-12) and result.pops == 0.0


# Jerk


def test_the_jerk_of_a_cubic_is_its_third_derivative_and_of_three_frames_unknown():
    for fps in (30.0, 120.0):
        time = np.arange(20) / fps
        assert measures.jerk(0.5 * time**3 - time**2 + 2.0, fps) == pytest.approx(3.0, rel=1e-4)
        cubic_and_zero = np.stack([0.5 * time**3, 0 * time], axis=1)
        jerk = measures.jerk(cubic_and_zero, fps)
        assert jerk == pytest.approx(3.0 / np.sqrt(2.0), rel=1e-4)
        assert np.isnan(measures.jerk(cubic_and_zero[:3], fps))


def test_jerk_is_that_of_the_height_of_the_pelvis_and_of_the_angle_of_the_knee():
    time = np.arange(60) / 60.0
    offset = np.stack([time**4, 0.1 * time**3, -(time**4)], axis=1)
    result = measure(shifted(standing(60), "pelvis", offset))
    assert result.pelvis_jerk == pytest.approx(0.6, rel=1e-6)
    assert result.knee_jerk == pytest.approx(0.0, abs=1e-6)
    time = np.arange(600) / 600.0
    angle = 2.0 + 0.3 * np.sin(2 * np.pi * 2.0 * time)
    motion = standing(600)
    shin = 0.4 * np.stack([0 * angle, np.cos(angle), np.sin(angle)], axis=1)
    motion = dataclasses.replace(motion, ankle=motion.knee + shin[:, None])
    expected = 0.3 * (4 * np.pi) ** 3 / np.sqrt(2.0)
    assert measure(motion, fps=600.0).knee_jerk == pytest.approx(expected, rel=5e-3)


# Reach


def test_targets_reached_and_knees_straighter_than_175_degrees_are_fractions():
    reached = np.array([[1.0, 0.0], [1.0, np.nan], [1.0, np.nan]])
    assert measure(standing(3), reached=reached).reached == pytest.approx(0.75)
    for degrees, fraction in ((174.9, 0.0), (175.1, 1.0), (180.0, 1.0)):
        assert measure(standing(4, knee=np.radians(degrees))).straight == fraction, degrees
    bent, straight = (standing(4, legs=4, knee=knee) for knee in (2.0, np.pi))
    ankle = np.array(bent.ankle)
    ankle[:3, 2] = straight.ankle[:3, 2]
    assert measure(dataclasses.replace(bent, ankle=ankle)).straight == pytest.approx(3 / 16)


def test_what_cannot_be_known_is_nan():
    nothing = np.full((1, 2), np.nan)
    result = measure(standing(1), gap=nothing, reached=nothing)
    known = {key: value for key, value in vars(result).items() if not np.isnan(value)}
    assert known == {"pops": 0.0, "straight": 0.0}


# How feet are placed

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


def assess(gap: np.ndarray, stance: np.ndarray, clip: Clip) -> measures.Placement:
    """Of the first frames of a clip, whose two points of each sole have the same height."""
    height = np.repeat(np.asarray(gap, float)[..., None], 2, axis=-1)
    cut = clip.select(slice(0, len(gap)))
    return measures.assess(Soles(height, np.where(np.isnan(height), np.nan, 0.0), stance), cut, cut)


def hill_height(z: np.ndarray) -> np.ndarray:
    """Of the ground of `hill`, m."""
    edges = np.linspace(-2.0, 30.0, 321)
    inside = np.clip((edges - 1.0) / 14.0, 0.0, 1.0)
    return np.interp(z, edges, 1.0 - np.cos(2.0 * np.pi * inside))


def test_soles_are_as_high_as_a_reference_of_rotations_and_interpolation_says(walk):
    """Points below ankle and ball along the foot's up; the ground by interpolation over z."""
    lifted = raised(walk, np.linspace(0.0, 0.4, walk.frame_count))
    feet = measures.soles(lifted, walk, terrain_of(hill()))
    for leg in range(2):
        ankle_rot = lifted.rotations_ws[:, lifted.rig.joints[leg][2]]
        foot_rot = np.asarray(lifted.rig.ankle_from_foot)[leg]
        up = rotation(ankle_rot).apply(rotation(foot_rot).apply([0.0, 1.0, 0.0]))
        for point, depth in enumerate((footsteps.ANKLE_HEIGHT, footsteps.BALL_HEIGHT)):
            sole = lifted.joints_ws(2 + point)[:, leg] - depth * up
            ground = hill_height(sole[:, 2])
            np.testing.assert_allclose(feet.ground[:, leg, point], ground, atol=1e-5)
            np.testing.assert_allclose(feet.height[:, leg, point], sole[:, 1] - ground, atol=1e-5)


def test_the_ground_is_found_above_a_sole_deep_in_it_and_below_a_roof(walk):
    for height in (0.8, -0.5):
        mesh = terrain.combine(terrain.plane((0.0, height, 0.0)), terrain.plane((0.0, 5.0, 0.0)))
        np.testing.assert_allclose(measures.soles(walk, walk, mesh).ground, height)
    stairs = measures.soles(walk, walk, terrain_of(flight([1.0, 2.0, 3.0], rise=0.5)))
    assert stairs.height.min() == pytest.approx(-1.5, abs=0.05), "from the tread above"


def test_shares_count_frames_of_standing_and_of_moving_feet_by_their_lower_point(walk):
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
    height = np.array([[[0.10, -0.02], [np.nan, 0.03]], [[np.nan, np.nan], [0.2, 0.1]]])
    lower = Soles(height, height, stance[:2]).gap
    np.testing.assert_array_equal(lower, [[-0.02, 0.03], [np.nan, 0.1]])


def test_feet_are_misplaced_where_over_five_per_cent_are_visibly_off_or_without_ground(walk):
    stance = np.ones((100, 2), bool)
    for gap, misplaced in ((0.0, False), (-0.019, False), (-0.021, True), (0.021, True)):
        heights = np.zeros((100, 2))
        heights[:6] = gap
        assert assess(heights, stance, walk).misplaced == misplaced, gap
        heights[:2] = 0.0
        assert not assess(heights, stance, walk).misplaced, gap
    placed = assess(np.full((100, 2), np.nan), stance, walk)
    assert placed.misplaced and placed.groundless == 1.0
    assert np.isnan([placed.sunk, placed.floating, placed.deepest.value]).all()


def test_a_slide_is_the_path_of_the_ball_beyond_the_animated_one(walk):
    x = 0.001 * np.arange(walk.frame_count)
    sliding = moved(walk, 3, x[:, None] * [1.0, 0.0, 0.0])
    placed = measures.assess(measures.soles(walk, walk, FLOOR), sliding, walk)
    lengths = []
    for stance, ball in zip(walk.stance_labels().T, sliding.joints_ws(3)[..., 0].T, strict=True):
        cuts = np.flatnonzero(np.diff(stance)) + 1
        parts = zip(np.split(stance, cuts), np.split(ball, cuts), strict=True)
        lengths += [np.abs(np.diff(path)).sum() for stands, path in parts if stands[0]]
    assert placed.largest_slide.leg == "left"
    assert placed.largest_slide.value == pytest.approx(max(lengths))
    assert placed.slide == pytest.approx(np.median(lengths), abs=1e-6)


def test_a_walk_stands_on_its_floor_and_a_pop_is_a_jump_of_an_ankle_from_the_pelvis(walk):
    soles = measures.soles(walk, walk, FLOOR)
    placed = measures.assess(soles, walk, walk)
    assert placed.slide == placed.largest_slide.value == placed.pop.value == 0.0
    assert placed.sunk == placed.floating == placed.sunk_frames == placed.groundless == 0.0
    assert not placed.misplaced
    step = np.where(np.arange(walk.frame_count) >= 77, 0.06, 0.0)[:, None] * [0.0, 1.0, 0.0]
    pop = measures.assess(soles, moved(walk, 2, step), walk).pop
    assert (pop.value, pop.frame, pop.leg) == (pytest.approx(0.06), 77, "left")
    whole = walk.with_motion(walk.positions_ws + step[:, None], walk.rotations_ws)
    assert measures.assess(soles, whole, walk).pop.value == pytest.approx(0.0, abs=1e-12)
    still = walk.select(slice(0, 1))
    placed = measures.assess(measures.soles(still, still, FLOOR), still, still)
    assert np.isnan([placed.slide, placed.pop.value]).all(), "of one frame"


def test_feet_are_not_measured_in_masked_frames(walk):
    clip = seen_within(dataclasses.replace(walk, stance=walk.stance_labels()), 100, 300)
    lifted = raised(clip, np.where(clip.observed, 0.0, 0.05))
    placed = measures.assess(measures.soles(lifted, clip, FLOOR), lifted, clip)
    assert placed.floating == placed.sunk == placed.groundless == 0.0
    assert placed.highest.value < 0.01


def test_the_cause_of_misplaced_feet_is_named_with_its_size(walk):
    mesh = hill()
    ground, aside = (terrain.mesh(mesh.vertices + [x, 0.0, 0.0], mesh.faces) for x in (0.0, 9e5))
    heights = hill_height(walk.positions_ws[:, walk.rig.pelvis, 2])
    rows = [
        (0.0 * heights, ground, ("root", 0.0)),
        (heights + 0.5, ground, ("offset", ANY)),
        (0.0 * heights, aside, ("missing", 0.0)),
        (0.0 * heights, FLOOR, ("unknown", 0.0)),
    ]
    for offset in (0.5, -0.3, 0.05):
        expected = ("offset", pytest.approx(offset, abs=0.005))
        rows.append((0.0 * heights + offset, FLOOR, expected))
    for unit in (0.3048, 1 / 0.3048, 1 / 0.0254):
        rows.append((unit * heights, ground, ("units", pytest.approx(unit))))
    for height, below, expected in rows:
        clip = raised(walk, height)
        assert likely_cause(measures.soles(clip, walk, below), clip) == expected
