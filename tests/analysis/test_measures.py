"""Measures of simple motions for which the right values are known."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fitting.analysis import measures
from fitting.analysis.measures import FootStates, Measures
from fitting.analysis.playback import Motion
from support.sample_clips import stair_walk

UP = np.array([0.0, 1.0, 0.0])


def flat(points: np.ndarray) -> np.ndarray:
    return np.zeros(len(points))


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


# Soles and ground


def test_soles_rotate_with_the_foot():
    walk = stair_walk(flat)
    tilt = Rotation.from_rotvec([0.3, 0.0, 0.0])
    rotations = walk.rotations_ws.copy()
    for joints in walk.rig.joints:
        foot = Rotation.from_quat(rotations[:, joints[2]], scalar_first=True)
        rotations[:, joints[2]] = (tilt * foot).as_quat(scalar_first=True)
    rig = dataclasses.replace(walk.rig, ball_height=jnp.full(2, 0.01))
    walk = dataclasses.replace(walk, measured_rig=rig)
    soles = measures.soles(walk.with_motion(walk.positions_ws, rotations))
    up = tilt.apply(UP)
    np.testing.assert_allclose(soles[:, :, 0], walk.joints_ws(2) - 0.05 * up, atol=1e-6)
    np.testing.assert_allclose(soles[:, :, 1], walk.joints_ws(3) - 0.01 * up, atol=1e-6)


def test_the_gap_of_a_sole_is_that_of_its_lower_point():
    soles = np.zeros((1, 4, 2, 3))
    soles[..., 1] = [0.10, 0.30]
    ground = np.array([[[0.0, 0.0], [0.0, 0.35], [np.nan, 0.1], [np.nan, np.nan]]])
    np.testing.assert_allclose(measures.gaps(soles, ground), [[0.10, -0.05, 0.2, np.nan]])


@pytest.mark.parametrize(
    ("lift", "depth", "clearance"), [(0.0, 0.0, 0.0), (-0.02, 0.02, 0.0), (0.03, 0.0, 0.03)]
)
def test_a_raised_walk_has_clearance_and_a_lowered_one_penetrates(lift, depth, clearance):
    walk = stair_walk(flat)
    soles = measures.soles(walk.with_motion(walk.positions_ws + lift * UP, walk.rotations_ws))
    gap = measures.gaps(soles, 0 * soles[..., 1])
    result = measure(standing(walk.frame_count), gap=gap, stance=walk.stance_labels())
    assert result.penetration_max == pytest.approx(depth, abs=1e-6)
    assert result.clearance == pytest.approx(clearance, abs=1e-6)


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


def test_slide_is_the_median_over_the_stances_of_all_feet():
    stance = np.array([1, 1, 1, 0, 1, 1, 0, 1, 1], bool)
    ball = np.zeros((9, 2, 3))
    ball[:, 0, 2] = [0.0, 0.01, 0.02, 0.5, 1.0, 1.05, 1.5, 2.0, 2.01]  # 2, 5 and 1 cm in stances
    ball[:, 1, 0] = 0.03 * np.arange(9)
    stances = np.stack([stance, np.arange(9) < 5], axis=1)  # the other foot: 12 cm
    assert measures.slide_per_stance(ball, stances) == pytest.approx((0.02 + 0.05) / 2)


def test_a_stance_of_one_frame_has_no_slide():
    stance = np.array([[True], [False], [True]])
    assert np.isnan(measures.slide_per_stance(np.zeros((3, 1, 3)), stance))


# Pops


@pytest.mark.parametrize(("fps", "size"), [(60, 0.05), (120, 0.05), (240, 0.05), (30, 0.025)])
def test_a_jump_is_one_pop_at_every_frame_rate(fps, size):
    animated, jump = standing(fps, legs=3), np.zeros((fps, 3, 3))
    jump[fps // 2 :, 1, 1] = 0.05
    result = measure(shifted(animated, "ankle", jump), animated, float(fps))
    assert result.pops == 1 and result.pop_max == pytest.approx(size)


@pytest.mark.parametrize("fps", [24.0, 30.0, 60.0, 90.0, 120.0])
@pytest.mark.parametrize(("speed", "pops"), [(1.5, 2), (1.0, 0)])
def test_a_correction_that_changes_steadily_measures_the_same_at_every_frame_rate(fps, speed, pops):
    animated = standing(frames := round(2 * fps))
    back_and_forth = np.interp(np.arange(frames) / fps, [0.0, 0.5, 1.0, 1.5], [0.0, 1.0, 1.0, 0.0])
    offset = np.zeros((frames, 2, 3))
    offset[:, 0, 2] = 0.5 * speed * back_and_forth
    result = measure(shifted(animated, "ankle", offset), animated, fps)
    assert result.pop_max == pytest.approx(speed / 60.0)
    assert result.pops == pops


def test_motion_of_the_animation_itself_is_no_pop():
    leaping = shifted(standing(10), "ankle", np.arange(10.0)[:, None, None] * np.ones(3))
    for motion in (leaping, shifted(leaping, "ankle", 0.1 * UP)):
        result = measure(motion, leaping)
        assert result.pop_max == pytest.approx(0.0, abs=1e-12) and result.pops == 0.0


# Jerk


@pytest.mark.parametrize("fps", [30.0, 120.0])
def test_the_jerk_of_a_cubic_is_its_third_derivative(fps):
    time = np.arange(20) / fps
    assert measures.jerk(0.5 * time**3 - time**2 + 2.0, fps) == pytest.approx(3.0, rel=1e-4)
    cubic_and_zero = np.stack([0.5 * time**3, 0 * time], axis=1)
    assert measures.jerk(cubic_and_zero, fps) == pytest.approx(3.0 / np.sqrt(2.0), rel=1e-4)


def test_the_jerk_of_three_frames_is_unknown():
    assert np.isnan(measures.jerk(np.zeros((3, 2)), 60.0))


def test_pelvis_jerk_counts_its_height_only():
    time = np.arange(60) / 60.0
    offset = np.stack([time**4, 0.1 * time**3, -(time**4)], axis=1)
    result = measure(shifted(standing(60), "pelvis", offset))
    assert result.pelvis_jerk == pytest.approx(0.6, rel=1e-6)
    assert result.knee_jerk == pytest.approx(0.0, abs=1e-6)


def test_knee_jerk_is_that_of_the_knee_angle():
    time = np.arange(600) / 600.0
    angle = 2.0 + 0.3 * np.sin(2 * np.pi * 2.0 * time)
    motion = standing(600)
    shin = 0.4 * np.stack([0 * angle, np.cos(angle), np.sin(angle)], axis=1)
    motion = dataclasses.replace(motion, ankle=motion.knee + shin[:, None])
    expected = 0.3 * (4 * np.pi) ** 3 / np.sqrt(2.0)
    assert measure(motion, fps=600.0).knee_jerk == pytest.approx(expected, rel=5e-3)


# Reach


def test_reached_is_the_fraction_of_known_targets():
    reached = np.array([[1.0, 0.0], [1.0, np.nan], [1.0, np.nan]])
    assert measure(standing(3), reached=reached).reached == pytest.approx(0.75)


@pytest.mark.parametrize(("degrees", "fraction"), [(174.9, 0.0), (175.1, 1.0), (180.0, 1.0)])
def test_a_knee_is_straight_above_175_degrees(degrees, fraction):
    assert measure(standing(4, knee=np.radians(degrees))).straight == fraction


def test_the_fraction_of_straight_knees_counts_all_legs_and_frames():
    bent, straight = (standing(4, legs=4, knee=knee) for knee in (2.0, np.pi))
    ankle = np.array(bent.ankle)
    ankle[:3, 2] = straight.ankle[:3, 2]
    assert measure(dataclasses.replace(bent, ankle=ankle)).straight == pytest.approx(3 / 16)


# Nothing to measure


def test_what_cannot_be_known_is_nan():
    nothing = np.full((1, 2), np.nan)
    result = measure(standing(1), gap=nothing, reached=nothing)
    unknown = {key for key, value in dataclasses.asdict(result).items() if np.isnan(value)}
    assert unknown == {
        "penetration_mean", "penetration_max", "clearance", "slide", "pop_max",
        "knee_jerk", "pelvis_jerk", "reached",
    }  # fmt: skip
    assert result.pops == 0.0 and result.straight == 0.0
