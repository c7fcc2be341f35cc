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
from fitting.motion.measures import MEASURES, Measures, Soles, likely_cause
from fitting.synthetic import footsteps, walker
from jaxik.world import terrain
from support.grounds import flight, hill, terrain_of
from support.sample_clips import seen_within

UP = np.array([0.0, 1.0, 0.0])
HIP, KNEE, ANKLE, BALL = range(4)
FLOOR = terrain.plane()
rotation = functools.partial(Rotation.from_quat, scalar_first=True)


@pytest.fixture(scope="module")
def walk() -> Clip:
    return walker.walk(8.0, 60.0, style=walker.WalkStyle(bend=0.0))


def standing(walk: Clip, frames: int, fps: float = 60.0) -> Clip:
    """Both feet stand still, with bent knees."""
    positions, rotations = (
        np.repeat(values[:1], frames, axis=0) for values in (walk.positions_ws, walk.rotations_ws)
    )
    clip = dataclasses.replace(walk, stance=np.ones((frames, 2), bool), fps=fps)
    return clip.with_motion(positions, rotations)


def moved(clip: Clip, joint: int, offset: np.ndarray, leg: int = 0) -> Clip:
    """The clip with one joint of a leg, by default the left one, moved, m."""
    positions = clip.positions_ws.copy()
    positions[:, clip.rig.joints[leg][joint]] += offset
    return clip.with_motion(positions, clip.rotations_ws)


def measure(
    clip: Clip,
    animated: Clip | None = None,
    *,
    gap: np.ndarray | None = None,
    stance: np.ndarray | None = None,
    reached: np.ndarray | None = None,
) -> Measures:
    """Measures of a motion whose soles are all on the ground, unless they have other gaps."""
    shape = (clip.frame_count, 2)
    stance = np.ones(shape, bool) if stance is None else stance
    gap = np.zeros(shape) if gap is None else gap
    height = np.repeat(np.asarray(gap, float)[..., None], 2, axis=-1)
    points = np.zeros((*shape, 2, 3))
    feet = Soles(points, height, np.where(np.isnan(height), np.nan, 0.0), stance)
    animated = animated or clip
    return measures.measure(feet, clip, animated, animated, reached)


# Ground


def test_depth_counts_all_frames_and_height_and_contact_those_of_stances(walk):
    gap = np.array([[-0.04, 0.015], [0.0, 0.06], [np.nan, 0.5], [0.01, np.nan]])
    stance = np.array([[True, True], [True, True], [True, False], [False, True]])
    result = measure(standing(walk, 4), gap=gap, stance=stance)
    assert result.penetration_depth == pytest.approx(0.04 / 6)
    assert result.worst["penetration"].value == pytest.approx(0.04)
    assert result.floating_height == pytest.approx((0.0 + 0.015 + 0.0 + 0.06) / 4)
    assert result.contact == pytest.approx(2 / 4), "one is too deep and one too high"


# Slide


def test_slide_is_the_length_of_the_horizontal_path_and_not_the_displacement(walk):
    still, path = standing(walk, 5), np.zeros((5, 3))
    path[:, 0] = [0.0, 0.01, 0.0, 0.01, 0.0]  # back and forth
    path[:, 1] = [0.0, 0.3, 0.0, 0.3, 0.0]  # up and down does not count
    both = moved(moved(still, BALL, path), BALL, path, leg=1)
    assert measure(both, still).slide == pytest.approx(0.04)
    single_frames = np.repeat(np.array([[True], [False], [True], [False], [False]]), 2, axis=1)
    assert np.isnan(measure(both, still, stance=single_frames).slide)


def test_slide_is_the_median_over_the_stances_of_all_feet(walk):
    stance = np.array([1, 1, 1, 0, 1, 1, 0, 1, 1], bool)
    left, right = np.zeros((2, 9, 3))
    left[:, 2] = [0.0, 0.01, 0.02, 0.5, 1.0, 1.05, 1.5, 2.0, 2.01]  # 2, 5 and 1 cm in stances
    right[:, 0] = 0.03 * np.arange(9)
    stances = np.stack([stance, np.arange(9) < 5], axis=1)  # the other foot: 12 cm
    still = standing(walk, 9)
    sliding = moved(moved(still, BALL, left), BALL, right, leg=1)
    assert measure(sliding, still, stance=stances).slide == pytest.approx((0.02 + 0.05) / 2)


# Foot skating


@pytest.mark.parametrize("fps", [20.0, 60.0, 120.0])
def test_foot_skating_is_the_share_of_frames_in_which_a_foot_in_contact_skids(walk, fps):
    frames = 41  # 40 steps
    still = standing(walk, frames, fps)
    size, path = measure(still).size, np.zeros((2, frames, 3))
    for speed, ratio in ((0.49, 0.0), (0.51, 1.0)):  # m/s, of an adult
        path[0, :, 2] = size * speed * np.arange(frames) / fps
        assert measure(moved(still, BALL, path[0])).foot_skating == ratio, "either foot"
    path[0, 21:] = path[0, 20]
    path[1, 31:, 0] = 0.1  # in one step, which the other foot has not
    path[1, :, 1] = np.arange(frames)  # up and down does not count
    both = moved(moved(still, BALL, path[0]), BALL, path[1], leg=1)
    assert measure(both).foot_skating == pytest.approx(21 / 40)
    gap, stance = np.zeros((frames, 2)), np.ones((frames, 2), bool)
    gap[:5, 0] = 0.051 * size  # not in contact at the beginning of 5 steps
    assert measure(both, gap=gap).foot_skating == pytest.approx(16 / 40)
    stance[30, 1] = False
    assert measure(both, gap=gap, stance=stance).foot_skating == pytest.approx(15 / 40)
    gap[:11] = np.nan  # nothing is known of 11 steps
    assert measure(both, gap=gap, stance=stance).foot_skating == pytest.approx(9 / 29)


# Pops


def test_a_jump_is_one_pop_at_every_frame_rate(walk):
    for fps, size in ((60, 0.05), (120, 0.05), (240, 0.05), (30, 0.025)):
        animated, jump = standing(walk, fps, fps), np.zeros((fps, 3))
        jump[fps // 2 :, 1] = 0.05
        result = measure(moved(animated, ANKLE, jump), animated)
        assert result.pops == 1 and result.pop == pytest.approx(size), fps


def test_a_correction_that_changes_steadily_measures_the_same_at_every_frame_rate(walk):
    size = measure(walk).size
    for fps, (speed, pops) in product((24.0, 30.0, 60.0, 90.0, 120.0), ((1.5, 2), (1.0, 0))):
        animated = standing(walk, frames := round(2 * fps), fps)
        times = [0.0, 0.5, 1.0, 1.5]
        back_and_forth = np.interp(np.arange(frames) / fps, times, [0.0, 1.0, 1.0, 0.0])
        offset = np.zeros((frames, 3))
        offset[:, 2] = 0.5 * size * speed * back_and_forth
        result = measure(moved(animated, ANKLE, offset), animated)
        assert result.pop == pytest.approx(size * speed / 60.0), (fps, speed)
        assert result.pops == pops, (fps, speed)


def test_motion_of_the_animation_itself_and_of_the_whole_body_over_the_ground_is_no_pop(walk):
    leaping = moved(standing(walk, 10), ANKLE, np.arange(10.0)[:, None] * np.ones(3))
    leap = np.arange(10.0)[:, None, None] * [1.0, 0.0, 1.0]
    whole = leaping.with_motion(leaping.positions_ws + leap, leaping.rotations_ws)
    for motion in (leaping, moved(leaping, ANKLE, 0.1 * UP), whole):
        result = measure(motion, leaping)
        assert result.pop == pytest.approx(0.0, abs=1e-9) and result.pops == 0.0


@pytest.mark.parametrize("height", [0.1, 0.6])  # m; half of a leg and more is a cut in a clip
def test_a_body_that_jumps_up_pops_unless_the_animation_jumps_with_it(walk, height):
    animated, jump = standing(walk, 60), np.zeros((60, 1, 3))
    jump[30:, 0, 1] = height
    jumping = animated.with_motion(animated.positions_ws + jump, animated.rotations_ws)
    result = measure(jumping, animated)
    assert result.pops == 1 and result.worst["pop"] == (pytest.approx(height), 30, "pelvis")
    assert measure(jumping, jumping).pop == pytest.approx(0.0, abs=1e-9)


# Jerk


def test_the_jerk_of_a_cubic_is_its_third_derivative_and_of_three_frames_unknown():
    for fps in (30.0, 120.0):
        time = np.arange(20) / fps
        assert measures.jerk(0.5 * time**3 - time**2 + 2.0, fps) == pytest.approx(3.0, rel=1e-4)
        cubic_and_zero = np.stack([0.5 * time**3, 0 * time], axis=1)
        jerk = measures.jerk(cubic_and_zero, fps)
        assert jerk == pytest.approx(3.0 / np.sqrt(2.0), rel=1e-4)
        assert np.isnan(measures.jerk(cubic_and_zero[:3], fps))


def test_jerk_is_that_of_the_height_of_the_pelvis_and_of_the_angle_of_the_knee(walk):
    still = standing(walk, 60)
    time = np.arange(60) / 60.0
    positions = still.positions_ws.copy()
    offset = np.stack([time**4, 0.1 * time**3, -(time**4)], axis=1)
    positions[:, still.rig.pelvis] += offset
    result = measure(still.with_motion(positions, still.rotations_ws), still)
    assert result.pelvis_jerk == pytest.approx(0.6, rel=1e-6)
    assert result.knee_jerk == pytest.approx(0.0, abs=1e-6)
    still = standing(walk, 600, 600.0)
    time = np.arange(600) / 600.0
    angle = 2.0 + 0.3 * np.sin(2 * np.pi * 2.0 * time)
    positions = still.positions_ws.copy()
    for hip, knee, ankle, _ in still.rig.joints:
        positions[:, hip] = positions[:, knee] + [0.0, 0.4, 0.0]
        shin = 0.4 * np.stack([0 * angle, np.cos(angle), np.sin(angle)], axis=1)
        positions[:, ankle] = positions[:, knee] + shin
    result = measure(still.with_motion(positions, still.rotations_ws))
    assert result.knee_jerk == pytest.approx(0.3 * (4 * np.pi) ** 3 / np.sqrt(2.0), rel=5e-3)


# Reach


def test_targets_that_standing_feet_reach_and_straight_legs_are_fractions(walk):
    reached = np.array([[1.0, 0.0], [1.0, np.nan], [1.0, 0.0]])
    stance = np.array([[True, True], [True, True], [True, False]])
    result = measure(standing(walk, 3), reached=reached, stance=stance)
    assert result.reached == pytest.approx(0.75)
    still = standing(walk, 4)
    hip, _, ankle = (still.joints_ws(joint)[:, 0] for joint in range(3))
    along = (ankle - hip) / np.linalg.norm(ankle - hip, axis=-1, keepdims=True)
    length = float(still.rig.thigh[0] + still.rig.shin[0])
    for reach, fraction in ((0.9985, 0.0), (0.9995, 0.5)):
        stretched = moved(still, ANKLE, hip + reach * length * along - ankle)
        assert measure(stretched).straight == fraction, reach


def test_feet_that_swing_on_the_ground_lose_their_clearance(walk):
    stance = np.ones((6, 2), bool)
    stance[1:3, 0] = stance[4, 0] = stance[2:5, 1] = False
    lift = np.array([[0.0, 0.0], [0.1, 0.0], [0.16, 0.1], [0.0, 0.2], [0.04, 0.1], [0.0, 0.0]])
    up = lift[..., None] * UP
    clip = standing(walk, 6)
    animated = moved(clip, ANKLE, up[:, 0])
    for joint, leg in ((BALL, 0), (ANKLE, 1), (BALL, 1)):
        animated = moved(animated, joint, up[:, leg], leg)
    glued = measure(clip, animated, stance=stance)
    assert glued.lost_clearance == pytest.approx(0.16)
    assert glued.worst["lost_clearance"].value == pytest.approx(0.20)
    higher = measure(clip, animated, gap=lift + 0.05 * ~stance, stance=stance)
    assert higher.lost_clearance == pytest.approx(-0.05)


def test_what_cannot_be_known_is_nan(walk):
    result = measure(standing(walk, 1), gap=np.full((1, 2), np.nan))
    known = {key: getattr(result, key) for key in MEASURES}
    known = {key: value for key, value in known.items() if not np.isnan(value)}
    assert known == {"pops": 0.0, "straight": 0.0, "groundless": 1.0}


# Bounds


def test_every_bound_says_what_is_beyond_it_and_why_and_what_is_unknown_is_within():
    measure, limits = MEASURES["contact"], {"contact": 0.95, "pop": 0.02}
    assert not measure.excess(0.95, 0.95) > 1.0 and measure.excess(0.94, 0.95) > 1.0
    unknown = Measures(**dict.fromkeys(MEASURES, np.nan), worst={})
    worst = {"pop": measures.Extreme(0.08, 45, "left")}
    (pop,) = dataclasses.replace(unknown, pop=0.08, worst=worst).against(limits)
    assert pop.is_beyond and pop.excess == pytest.approx(4.0)
    assert pop.words == "pop 8.0 cm in 1/60 s (≤ 2.0), worst 8.0 cm, left, frame 45"
    (contact,) = dataclasses.replace(unknown, contact=0.5).against(limits)
    assert contact.words == "contact preservation 50.0 % of frames (≥ 95.0)"
    for known in measures.BOUNDED.values():
        assert known.reason and known.bound > 0.0


# How feet are placed


def assess(gap: np.ndarray, stance: np.ndarray, clip: Clip) -> Measures:
    """Of the first frames of a clip, whose two points of each sole have the same height."""
    return measure(clip.select(slice(0, len(gap))), gap=gap, stance=stance)


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


def test_the_ground_stays_above_a_body_that_falls_into_it_where_there_is_more_below(walk):
    z, edges = walk.positions_ws[:, walk.rig.pelvis, 2], np.arange(0.5, 2.7, 0.3)
    stairs, above = flight(list(edges), rise=0.3), z > edges[-1] + 0.3
    ground = terrain.combine(terrain_of(stairs), terrain.plane((0.0, -0.1, 0.0)))
    heights = 0.3 * np.searchsorted(edges, z) - np.where(above, 2.0, 0.0)
    falling = walk.with_motion(walk.positions_ws + heights[:, None, None] * UP, walk.rotations_ws)
    assert falling.cuts == (int(np.argmax(above)),) and not walk.cuts
    assert (measures.soles(falling, walk, ground).ground[above] > 2.0).all()


def test_shares_count_frames_of_standing_and_of_moving_feet_by_their_lower_point(walk):
    gap = np.array([[-0.03, 0.0], [0.03, -0.05], [-0.01, 0.2], [np.nan, -0.021]])
    stance = np.array([[True, True], [True, False], [True, False], [True, False]])
    placed = assess(gap, stance, walk)
    assert placed.penetration_stance == pytest.approx(
        1 / 4
    )  # of the four standing feet over ground
    assert placed.floating == pytest.approx(1 / 4)
    assert placed.penetration_swing == pytest.approx(2 / 3)
    assert placed.penetration == pytest.approx(3 / 4)
    assert placed.groundless == pytest.approx(1 / 8)
    assert placed.contact == pytest.approx(1 / 2)
    assert placed.worst["penetration"] == (0.05, 1, "right")
    assert placed.worst["floating"] == (0.03, 1, "left")
    height = np.array([[[0.10, -0.02], [np.nan, 0.03]], [[np.nan, np.nan], [0.2, 0.1]]])
    lower = Soles(np.zeros((2, 2, 2, 3)), height, height, stance[:2]).gap
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
    assert np.isnan([placed.contact, placed.floating, placed.worst["penetration"].value]).all()


def test_a_slide_is_the_path_of_the_ball_beyond_the_animated_one(walk):
    x = 0.001 * np.arange(walk.frame_count)
    sliding = moved(walk, BALL, x[:, None] * [1.0, 0.0, 0.0])
    placed = measures.measure(measures.soles(walk, walk, FLOOR), sliding, walk, walk)
    lengths = []
    for stance, ball in zip(walk.stance_labels().T, sliding.joints_ws(3)[..., 0].T, strict=True):
        cuts = np.flatnonzero(np.diff(stance)) + 1
        parts = zip(np.split(stance, cuts), np.split(ball, cuts), strict=True)
        lengths += [np.abs(np.diff(path)).sum() for stands, path in parts if stands[0]]
    assert placed.worst["slide"].leg == "left"
    assert placed.worst["slide"].value == pytest.approx(max(lengths))
    assert placed.slide == pytest.approx(np.median(lengths), abs=1e-6)


def test_a_walk_stands_on_its_floor_and_a_pop_is_a_jump_of_an_ankle_or_of_the_body(walk):
    placed = measures.place(walk, walk, walk, FLOOR).measures
    assert placed.slide == placed.worst["slide"].value == placed.foot_skating == placed.pop == 0.0
    assert placed.floating == placed.penetration == placed.groundless == 0.0
    assert not placed.misplaced
    step = np.where(np.arange(walk.frame_count) >= 77, 0.06, 0.0)[:, None] * [0.0, 1.0, 0.0]
    pop = measures.place(moved(walk, ANKLE, step), walk, walk, FLOOR).measures.worst["pop"]
    assert pop == (pytest.approx(0.06), 77, "left")
    whole = walk.with_motion(walk.positions_ws + step[:, None], walk.rotations_ws)
    pop = measures.place(whole, walk, walk, FLOOR).measures.worst["pop"]
    assert pop == (pytest.approx(0.06), 77, "pelvis")
    still = walk.select(slice(0, 1))
    placed = measures.place(still, still, still, FLOOR).measures
    assert np.isnan([placed.slide, placed.foot_skating, placed.pop]).all(), "of one frame"


def test_feet_are_not_measured_in_masked_frames(walk):
    clip = seen_within(dataclasses.replace(walk, stance=walk.stance_labels()), 100, 300)
    lifted = raised(clip, np.where(clip.observed, 0.0, 0.05))
    placed = measures.place(lifted, clip, clip, FLOOR).measures
    assert placed.floating == placed.penetration == placed.groundless == 0.0
    assert placed.worst["floating"].value < 0.01


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
        assert likely_cause(measures.soles(clip, walk, below), clip)[:2] == expected
