"""Measures of motions that are made by hand, so that their answers are known."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fitting.analysis import measures
from fitting.analysis.measures import COLUMNS, Measures
from fitting.analysis.playback import Motion
from fitting.datasets.clips.clip import Clip
from support.sample_clips import walker


def flat(points: np.ndarray) -> np.ndarray:
    return np.zeros(len(points))


def standing(frames: int, legs: int = 2, knee: float = np.pi / 2) -> Motion:
    """Legs that stand still, their knees open by an angle, rad."""
    hip = np.array([0.0, 0.9, 0.0])
    shin = 0.4 * np.array([0.0, np.cos(knee), np.sin(knee)])
    still = [hip, hip, hip - [0.0, 0.4, 0.0], hip - [0.0, 0.4, 0.0] + shin, [0.0, 0.05, 0.1]]
    pelvis, *joints = (np.broadcast_to(np.asarray(at), (frames, 3)).copy() for at in still)
    return Motion(pelvis, *(np.repeat(joint[:, None], legs, axis=1) for joint in joints))


def moved(motion: Motion, part: str, by: np.ndarray) -> Motion:
    return dataclasses.replace(motion, **{part: getattr(motion, part) + by})


def measured(
    motion: Motion, animated: Motion | None = None, fps: float = 60.0, **given
) -> Measures:
    shape = motion.ankle.shape[:2]
    given = {
        "gap": np.zeros(shape),
        "stance": np.ones(shape, bool),
        "reached": np.ones(shape),
    } | given
    return measures.measure(motion, animated or motion, fps=fps, **given)


def test_every_measure_has_a_column_in_the_same_order():
    assert list(COLUMNS) == [field.name for field in dataclasses.fields(Measures)]


def test_words_are_in_the_unit_of_the_column():
    assert measures.worded("penetration_mean", 0.01234) == "1.23"
    assert measures.worded("reached", 0.875) == "87.5"
    assert measures.worded("pops", 12.0) == "12"
    assert measures.worded("slide", float("nan")) == "–"


# Soles and ground


def test_soles_are_as_far_below_the_joints_as_these_are_over_the_floor_in_a_flat_stance():
    walk = walker(flat)
    np.testing.assert_allclose(measures.sole_depths(walk), [[0.05, 0.0]] * 2, atol=1e-12)
    np.testing.assert_allclose(measures.sole_depths(walk, -0.02), [[0.07, 0.02]] * 2, atol=1e-12)


def test_soles_turn_with_the_foot():
    walk = walker(flat)
    tilt = Rotation.from_rotvec([0.3, 0.0, 0.0])
    rotations = walk.rotations_ws.copy()
    for joints in walk.rig.joints:
        foot = Rotation.from_quat(rotations[:, joints[2]], scalar_first=True)
        rotations[:, joints[2]] = (tilt * foot).as_quat(scalar_first=True)
    depths = np.array([[0.05, 0.01]] * 2)
    soles = measures.soles(walk.with_motion(walk.positions_ws, rotations), depths)
    up = tilt.apply([0.0, 1.0, 0.0])
    np.testing.assert_allclose(soles[:, :, 0], walk.joints_ws(2) - 0.05 * up, atol=1e-6)
    np.testing.assert_allclose(soles[:, :, 1], walk.joints_ws(3) - 0.01 * up, atol=1e-6)


def test_a_gap_is_that_of_the_lower_point_of_a_sole_over_the_ground_under_it():
    soles = np.zeros((1, 4, 2, 3))
    soles[0, :, :, 1] = [[0.10, 0.30], [0.10, 0.30], [0.10, 0.30], [0.10, 0.30]]
    ground = np.array([[[0.0, 0.0], [0.0, 0.35], [np.nan, 0.1], [np.nan, np.nan]]])
    np.testing.assert_allclose(measures.gaps(soles, ground), [[0.10, -0.05, 0.2, np.nan]])


def over_flat_ground(clip: Clip, walk: Clip) -> Measures:
    """A clip measured on the floor of the walk from which it comes."""
    soles = measures.soles(clip, measures.sole_depths(walk))
    still = standing(walk.frame_count)
    return measured(still, gap=measures.gaps(soles, 0 * soles[..., 1]), stance=walk.stance_labels())


def test_a_walk_on_its_own_floor_neither_sinks_nor_floats():
    walk = walker(flat)
    told = over_flat_ground(walk, walk)
    assert max(told.penetration_mean, told.penetration_max, told.clearance) < 1e-6


@pytest.mark.parametrize(("lift", "sunk", "air"), [(-0.02, 0.02, 0.0), (0.03, 0.0, 0.03)])
def test_a_lifted_walk_has_air_under_its_feet_and_a_lowered_one_is_in_the_ground(lift, sunk, air):
    walk = walker(flat)
    lifted = walk.with_motion(walk.positions_ws + [0.0, lift, 0.0], walk.rotations_ws)
    told = over_flat_ground(lifted, walk)
    assert told.penetration_max == pytest.approx(sunk, abs=1e-6)
    assert told.clearance == pytest.approx(air, abs=1e-6)


def test_penetration_counts_all_frames_and_clearance_those_of_stances():
    gap = np.array([[-0.04, 0.02], [0.0, 0.06], [np.nan, 0.5], [0.01, np.nan]])
    stance = np.array([[True, True], [True, True], [True, False], [False, True]])
    told = measured(standing(4), gap=gap, stance=stance)
    assert told.penetration_mean == pytest.approx(0.04 / 6)
    assert told.penetration_max == pytest.approx(0.04)
    assert told.clearance == pytest.approx((0.0 + 0.02 + 0.0 + 0.06) / 4)


# Slide


def test_slide_is_the_way_over_the_plan_and_not_how_far_a_foot_gets():
    ball = np.zeros((5, 1, 3))
    ball[:, 0, 0] = [0.0, 0.01, 0.0, 0.01, 0.0]  # to and fro
    ball[:, 0, 1] = [0.0, 0.3, 0.0, 0.3, 0.0]  # up and down does not count
    assert measures.slide_per_stance(ball, np.ones((5, 1), bool)) == pytest.approx(0.04)


def test_slide_is_the_median_over_the_stances_of_all_feet():
    stance = np.array([1, 1, 1, 0, 1, 1, 0, 1, 1], bool)
    ball = np.zeros((9, 2, 3))
    ball[:, 0, 2] = [0.0, 0.01, 0.02, 0.5, 1.0, 1.05, 1.5, 2.0, 2.01]  # 2, 5 and 1 cm in stances
    ball[:, 1, 0] = 0.03 * np.arange(9)
    both = np.stack([stance, np.arange(9) < 5], axis=1)  # the other foot: 12 cm
    assert measures.slide_per_stance(ball, both) == pytest.approx((0.02 + 0.05) / 2)


def test_a_stance_of_one_frame_has_no_slide():
    stance = np.array([[True], [False], [True]])
    assert np.isnan(measures.slide_per_stance(np.zeros((3, 1, 3)), stance))


# Pops


@pytest.mark.parametrize(
    ("fps", "seen"), [(60.0, 0.05), (120.0, 0.05), (240.0, 0.05), (30.0, 0.025)]
)
def test_a_jump_pops_once_at_every_rate(fps, seen):
    animated = standing(round(fps), legs=3)
    jump = np.zeros((round(fps), 3, 3))
    jump[round(fps) // 2 :, 1, 1] = 0.05
    told = measured(moved(animated, "ankle", jump), animated, fps)
    assert told.pops == 1 and told.pop_max == pytest.approx(seen)


@pytest.mark.parametrize("fps", [24.0, 30.0, 60.0, 90.0, 120.0])
@pytest.mark.parametrize(("speed", "pops"), [(1.5, 2), (1.0, 0)])
def test_a_correction_in_steady_motion_measures_the_same_at_every_rate(fps, speed, pops):
    frames = round(2 * fps)
    time = np.arange(frames) / fps
    animated = standing(frames)
    back_and_forth = np.interp(
        time, [0.0, 0.5, 1.0, 1.5, 2.0], [0.0, speed / 2, speed / 2, 0.0, 0.0]
    )
    by = np.zeros((frames, 2, 3))
    by[:, 0, 2] = back_and_forth
    told = measured(moved(animated, "ankle", by), animated, fps)
    assert told.pop_max == pytest.approx(speed / 60.0)
    assert told.pops == pops


def test_what_the_animation_does_is_no_pop():
    leaping = moved(standing(10), "ankle", np.arange(10.0)[:, None, None] * np.ones(3))
    told = measured(leaping)
    assert told.pop_max == 0.0 and told.pops == 0.0
    told = measured(moved(leaping, "ankle", np.array([0.0, 0.1, 0.0])), leaping)
    assert told.pop_max == pytest.approx(0.0, abs=1e-12)


# Jerk


@pytest.mark.parametrize("fps", [30.0, 120.0])
def test_the_jerk_of_a_cubic_is_its_third_derivative(fps):
    time = np.arange(20) / fps
    assert measures.jerk(0.5 * time**3 - time**2 + 2.0, fps) == pytest.approx(3.0, rel=1e-4)
    two = np.stack([0.5 * time**3, 0 * time], axis=1)
    assert measures.jerk(two, fps) == pytest.approx(3.0 / np.sqrt(2.0), rel=1e-4)


def test_the_jerk_of_three_frames_is_not_known():
    assert np.isnan(measures.jerk(np.zeros((3, 2)), 60.0))


def test_pelvis_jerk_is_of_its_height_only():
    time = np.arange(60) / 60.0
    by = np.stack([time**4, 0.1 * time**3, -(time**4)], axis=1)
    told = measured(moved(standing(60), "pelvis", by))
    assert told.pelvis_jerk == pytest.approx(0.6, rel=1e-6)
    assert told.knee_jerk == pytest.approx(0.0, abs=1e-6)


def test_knee_jerk_is_of_the_knee_angle():
    time = np.arange(600) / 600.0
    angle = 2.0 + 0.3 * np.sin(2 * np.pi * 2.0 * time)
    motion = standing(600)
    shin = 0.4 * np.stack([0 * angle, np.cos(angle), np.sin(angle)], axis=1)
    motion = dataclasses.replace(motion, ankle=motion.knee + shin[:, None])
    wanted = 0.3 * (4 * np.pi) ** 3 / np.sqrt(2.0)
    assert measured(motion, fps=600.0).knee_jerk == pytest.approx(wanted, rel=5e-3)


# Reach


def test_reach_is_the_share_of_known_targets():
    reached = np.array([[1.0, 0.0], [1.0, np.nan], [1.0, np.nan]])
    assert measured(standing(3), reached=reached).reached == pytest.approx(0.75)


@pytest.mark.parametrize(("degrees", "share"), [(174.9, 0.0), (175.1, 1.0), (180.0, 1.0)])
def test_a_knee_is_straight_above_175_degrees(degrees, share):
    assert measured(standing(4, knee=np.radians(degrees))).straight == share


def test_the_share_of_straight_knees_counts_all_legs_and_frames():
    bent, straight = (standing(4, legs=4, knee=knee) for knee in (2.0, np.pi))
    ankle = np.array(bent.ankle)
    ankle[:3, 2] = straight.ankle[:3, 2]
    assert measured(dataclasses.replace(bent, ankle=ankle)).straight == pytest.approx(3 / 16)


# Nothing to measure


def test_what_cannot_be_known_is_nan():
    nothing = np.full((1, 2), np.nan)
    told = measured(standing(1), gap=nothing, reached=nothing)
    unknown = {key for key, value in dataclasses.asdict(told).items() if np.isnan(value)}
    assert unknown == {
        "penetration_mean", "penetration_max", "clearance", "slide", "pop_max",
        "knee_jerk", "pelvis_jerk", "reached",
    }  # fmt: skip
    assert told.pops == 0.0 and told.straight == 0.0
