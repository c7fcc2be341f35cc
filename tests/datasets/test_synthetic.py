"""Synthetic motion: still feet, constant bone lengths, true labels, and the effect of events."""

import functools
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxik
from fitting.clips import Clip, clip_frames, contacts
from fitting.clips.clip import local_from_world
from fitting.ground import meshes
from fitting.synthetic import actions, footsteps, multi_limb, walker
from fitting.synthetic.terrain_meshes import WALL_FROM_FLOOR, WALL_UP, wall

FPS = 60.0
EXACT = 1e-9  # m
STRAIGHT = walker.WalkStyle(bend=0.0)
SPEED = footsteps.STRIDE / footsteps.PERIOD
BODIES = {"quadruped": multi_limb.QUADRUPED, "climber": multi_limb.CLIMBER}
STOPS = [walker.Stop(1.6, 3.7), walker.Stop(5.0, 7.2)]
WALKS = {
    **{f"walk {seed}": partial(walker.walk, 12.0, FPS, seed) for seed in range(3)},
    "stopping": partial(walker.walk, 9.0, FPS, 4, events=STOPS),
}
ACTIONS = {
    action.__name__: partial(action, 4.0, FPS)
    for action in (actions.run, actions.jump, actions.crouch, actions.turn)
}
CLIPS = {
    **WALKS,
    **ACTIONS,
    "quadruped": partial(multi_limb.locomotion, multi_limb.QUADRUPED, 5.0, FPS, 1),
    "climber": partial(multi_limb.climb, 6.0, FPS, 1),
}


@functools.cache
def clip_of(name: str) -> Clip:
    return CLIPS[name]()


def places(name: str) -> np.ndarray:
    """Joint positions, m, over a floor with y up and z ahead; the climber's wall is laid down."""
    positions_ws = clip_of(name).positions_ws
    return positions_ws @ WALL_FROM_FLOOR.as_matrix() if name == "climber" else positions_ws


def stances(clip, leg: int) -> list[tuple[int, int]]:
    """First and last frame of each whole stance."""
    runs = contacts.runs(clip.stance[:, leg])
    return [(first, last) for first, last in runs if first > 0 and last < clip.frame_count - 1]


def heel(clip, leg: int) -> np.ndarray:
    """The rear end of a sole, m."""
    ankle = clip.rig.joints[leg][2]
    rot = Rotation.from_quat(clip.rotations_ws[:, ankle], scalar_first=True)
    return clip.positions_ws[:, ankle] + rot.apply([0, -footsteps.ANKLE_HEIGHT, -footsteps.HEEL])


@pytest.mark.parametrize("name", CLIPS)
def test_standing_feet_do_not_move_on_the_ground_and_others_stay_above_it(name):
    clip, height = clip_of(name), places(name)[..., 1]
    ball_height, ankle_height = footsteps.BALL_HEIGHT, footsteps.ANKLE_HEIGHT  # of a flat foot
    if name in BODIES:
        ball_height = BODIES[name].ball_height
        ankle_height = ball_height + BODIES[name].ankle_to_ball[0]
    fewest = 9 if name.startswith("walk ") else 3 if name == "stopping" else 1
    for leg, (_, knee, ankle, toe) in enumerate(clip.rig.joints):
        standing = stances(clip, leg)
        if name not in WALKS:
            standing = contacts.runs(clip.stance_labels()[:, leg])
        assert len(standing) >= fewest
        joints = [toe, ankle] if name in BODIES else [toe]  # a foot of four limbs stays flat
        for first, last in standing:
            still = places(name)[first : last + 1, joints]
            assert np.ptp(still, axis=0).max() < EXACT
            expected = (ball_height, ankle_height)[: len(joints)]
            np.testing.assert_allclose(still[0, :, 1], expected, rtol=0, atol=EXACT)
        assert height[:, toe].min() > ball_height - EXACT
        if name in BODIES:
            assert height[:, [knee, ankle]].min() > 0.06
        elif name in ACTIONS:
            assert height[:, ankle].min() > ankle_height - 1e-6
        else:  # in the last frames of a swing; 0 for standing feet
            assert heel(clip, leg)[:, 1].min() > -0.002


@pytest.mark.parametrize("name", CLIPS)
def test_limbs_have_their_names_sides_bones_flat_feet_and_flexing_hinges(name):
    clip = clip_of(name)
    names, lengths = ["left", "right"], [(footsteps.THIGH, footsteps.SHIN, footsteps.FOOT)] * 2
    if name in BODIES:
        limbs, foot = BODIES[name].limbs, float(np.hypot(*BODIES[name].ankle_to_ball))
        names, lengths = [limb.name for limb in limbs], [(*limb.bones, foot) for limb in limbs]
    assert clip.rig.names == tuple(names)
    np.testing.assert_array_equal(clip.rig.side, [1.0, -1.0] * (len(names) // 2))
    legs = clip.positions_ws[:, np.array(clip.rig.joints)]
    bones = np.linalg.norm(np.diff(legs, axis=2), axis=-1)
    np.testing.assert_allclose(bones, np.broadcast_to(lengths, bones.shape), rtol=0, atol=EXACT)
    positions_ls, _ = local_from_world(clip.parents, clip.positions_ws, clip.rotations_ws)
    assert np.ptp(positions_ls[:, 1:], axis=0).max() < EXACT, "joints are rigid on their parents"
    if name in ACTIONS:
        return
    axis_error, foot_error = (1e-3, 0.03) if name in BODIES else (0.02, 0.02)
    axes, feet = ([row] * len(names) for row in ([-1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(clip.rig.knee_axis_ls, axes, rtol=0, atol=axis_error)
    np.testing.assert_allclose(clip.rig.ankle_from_foot, feet, rtol=0, atol=foot_error)


@pytest.mark.parametrize("name", [*WALKS, *ACTIONS])
def test_motion_is_smooth_where_a_foot_lifts_off_and_lands(name):
    clip = clip_of(name)
    joints = [joint for leg in clip.rig.joints for joint in leg[2 if name in WALKS else 1 :]]
    velocities = np.diff(clip.positions_ws[:, [clip.rig.pelvis, *joints]], axis=0) * FPS
    if name in WALKS:
        speeds = np.linalg.norm(velocities[:, 1:], axis=-1)
        assert speeds.max() < 6.0 and np.abs(np.diff(speeds, axis=0)).max() * FPS < 120.0
    else:  # m/s²; a foot that pops by 2 cm has 1200
        assert np.linalg.norm(np.diff(velocities, axis=0), axis=-1).max() * FPS < 150.0


@pytest.mark.parametrize("seed", range(2))
def test_arms_swing_against_the_legs_and_hang_in_a_stop(seed):
    clip = walker.walk(9.0, FPS, seed, STOPS, STRAIGHT)
    ahead = {
        name: clip.positions_ws[:, clip.joint_names.index(name), 2] - clip.positions_ws[:, 0, 2]
        for name in ("left_wrist", "right_wrist", "left_ankle", "right_ankle", "left_shoulder")
    }
    walking = slice(0, int(1.6 * FPS))
    for side in ("left", "right"):
        wrist, ankle = ahead[f"{side}_wrist"][walking], ahead[f"{side}_ankle"][walking]
        assert np.corrcoef(wrist, ankle)[0, 1] < -0.8
        assert 0.25 < np.ptp(wrist) < 0.6  # m
    # The chest turns with the arms: with the right leg, and against the left one.
    assert np.corrcoef(ahead["left_shoulder"][walking], ahead["left_ankle"][walking])[0, 1] < -0.8
    still = slice(int(3.2 * FPS), int(3.7 * FPS))
    assert np.ptp(ahead["left_wrist"][still]) < 0.005
    assert abs(ahead["left_wrist"][still] - ahead["right_wrist"][still]).max() < 0.005
    wrists = [clip.joint_names.index(f"{side}_wrist") for side in ("left", "right")]
    accelerations = np.diff(clip.positions_ws[:, wrists], 2, axis=0) * FPS**2
    assert np.linalg.norm(accelerations, axis=-1).max() < 25.0  # m/s²


def test_impossible_motion_is_refused():
    slip, slide, stop = walker.Slip, walker.Slide, walker.Stop
    four_legged, long_legged = multi_limb.QUADRUPED, replace(multi_limb.QUADRUPED, stride=3.0)
    for make, message in (
        (partial(walker.walk, 0.0), "above 0, got 0.0 s"),
        (partial(walker.walk, 5.0, -60.0), "-60.0 fps"),
        (partial(walker.walk, 5.0, events=[slip(1.0, 9.0, 0.1)]), r"Slip\(start=1.0, end=9.0.*5.0"),
        (partial(walker.walk, 5.0, events=[slide(3.0, 2.0)]), r"Slide\(start=3.0, end=2.0\)"),
        (partial(walker.walk, 5.0, events=[stop(-1.0, 2.0)]), r"Stop\(start=-1.0, end=2.0\)"),
        (partial(multi_limb.locomotion, four_legged, 0.0), "above 0, got 0.0 s"),
        (partial(multi_limb.locomotion, long_legged, 2.0), "fore_left limb of the quadruped does"),
    ):
        with pytest.raises(ValueError, match=message):
            make()


def test_a_seed_determines_the_steps_and_a_route_may_start_elsewhere():
    four_legged = partial(multi_limb.locomotion, multi_limb.QUADRUPED, 2.0, 30.0)
    for make, change in ((partial(walker.walk, 3.0, FPS), 0.01), (four_legged, 0.005)):
        first, same, other = (make(seed) for seed in (4, 4, 5))
        np.testing.assert_array_equal(first.positions_ws, same.positions_ws)
        assert np.abs(first.positions_ws - other.positions_ws).max() > change
    ahead = four_legged(4, multi_limb.Route(start=3.0))
    assert ahead.positions_ws[0, 0, 2] == pytest.approx(3.0)


def test_a_foot_rolls_over_its_heel_lies_flat_and_rises_about_its_ball():
    for seed in range(3):
        clip = clip_of(f"walk {seed}")
        for leg in range(2):
            height, rear = clip.joints_ws(2)[:, leg, 1] - footsteps.ANKLE_HEIGHT, heel(clip, leg)
            for first, last in stances(clip, leg)[1:]:
                assert np.ptp(rear[first - 6 : first + 1], axis=0).max() < EXACT
                assert np.abs(height[first : first + 16]).max() < EXACT and height[last] > 0.03


def test_stride_cadence_and_pelvis_height_are_those_of_the_measured_walk():
    clip = walker.walk(12.6, FPS, style=walker.WalkStyle(bend=0.0, variation=0.0))
    pelvis = clip.positions_ws[:, 0]
    np.testing.assert_allclose(np.diff(pelvis[:, 2]), SPEED / FPS, rtol=0, atol=EXACT)
    again = round(footsteps.PERIOD * FPS)
    one, next_one = (clip.positions_ws[n * again : (n + 1) * again] for n in (1, 2))
    np.testing.assert_allclose(one + [0.0, 0.0, footsteps.STRIDE], next_one, rtol=0, atol=EXACT)
    assert abs(pelvis[:, 1].mean() - footsteps.HEIGHT[0]) < 0.03
    assert 0.2 < clip.positions_ws[:, clip.rig.joints[0][2], 1].max() < 0.3


def test_a_slip_moves_standing_feet_and_a_slide_freezes_the_walk_on_both_at_its_speed():
    change, start, end = 0.06, 2.0, 5.0
    slip = walker.Slip(start, end, change)
    slipping, still = (
        walker.walk(8.0, FPS, events=events, style=STRAIGHT) for events in ([slip], [])
    )
    moved = slipping.positions_ws - still.positions_ws
    together = np.broadcast_to(moved[:, :1], moved.shape)
    np.testing.assert_allclose(moved, together, rtol=0, atol=EXACT)
    assert np.abs(moved[: round(start * FPS)]).max() < EXACT
    full = (end - start - walker.EASE) * change * SPEED
    assert moved[-1, 0, 2] == pytest.approx(full, rel=0.01)
    clip = walker.walk(8.0, FPS, events=[walker.Slide(3.0, 5.0)])
    assert clip.slide is not None
    np.testing.assert_array_equal(np.flatnonzero(clip.slide), np.arange(180, 300))
    frozen = slice(round(4.5 * FPS), round(4.85 * FPS))
    about = clip.positions_ws[frozen] - clip.positions_ws[frozen, :1]
    assert np.ptp(about, axis=0).max() < 1e-6
    for _, _, ankle, _ in clip.rig.joints:
        assert clip.positions_ws[frozen, ankle, 1].max() < footsteps.ANKLE_HEIGHT + 0.04
    travel = np.linalg.norm(np.diff(clip.positions_ws[:, 0, [0, 2]], axis=0), axis=-1) * FPS
    np.testing.assert_allclose(travel, SPEED, rtol=0.01)
    trimmed = clip.select(slice(0, 200)).slide
    assert trimmed is not None and trimmed.sum() == 20
    assert walker.walk(1.0, FPS).slide is None


def test_in_a_stop_the_walk_breathes_on_two_flat_feet_and_its_front_foot_stays_flat():
    """It stands from 2.5 s to 3.7 s and from 5.8 s to 7.2 s."""
    clip = clip_of("stopping")
    speed, stance = np.asarray(clip_frames.frames_from_clip(clip).speed), clip.stance_labels()
    stands = contacts.runs(speed == 0.0)
    assert len(stands) == 2
    for (first, last), end in zip(stands, (3.7, 7.2), strict=True):
        assert 1.0 <= (last - first) / FPS <= 1.5
        assert last == pytest.approx(end * FPS, abs=2)
        still = slice(first + 3, last - 2)
        assert stance[still].all()
        assert all(len(contacts.runs(stance[first:last, leg])) == 1 for leg in (0, 1))
        for role, height in ((2, footsteps.ANKLE_HEIGHT), (3, footsteps.BALL_HEIGHT)):
            positions = clip.joints_ws(role)[still]
            assert np.ptp(positions, axis=0).max() < 1e-6
            np.testing.assert_allclose(positions[..., 1], height, rtol=0, atol=1e-6)
        resumed = slice(round(end * FPS), round((end + 0.4) * FPS))
        ahead = int(np.argmax(clip.joints_ws(3)[resumed.start, :, 2]))
        assert stance[resumed, ahead].all()
        ankle = clip.joints_ws(2)[resumed, ahead, 1]
        np.testing.assert_allclose(ankle, footsteps.ANKLE_HEIGHT, rtol=0, atol=1e-6)
        breath = np.ptp(clip.positions_ws[first : last + 1, 0], axis=0)
        assert breath[0] == breath[2] == 0.0 and 0.0005 < breath[1] < 0.004
    np.testing.assert_allclose(speed[-30:], SPEED, rtol=0.02)


def test_a_walk_and_its_standing_feet_face_along_its_path():
    clip = walker.walk(12.0, FPS, style=walker.WalkStyle(bend=0.6))
    pelvis_ws = clip.positions_ws[:, clip.rig.pelvis]
    travel = np.gradient(pelvis_ws[:, [0, 2]], axis=0)
    yaw = np.arctan2(travel[:, 0], travel[:, 1])
    assert yaw.min() < -0.3 and yaw.max() > 0.3, "the path is too straight to tell"
    facing = Rotation.from_quat(clip.rotations_ws[:, clip.rig.pelvis], scalar_first=True)
    ahead = facing.apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(np.arctan2(ahead[:, 0], ahead[:, 2])[1:-1], yaw[1:-1], atol=1e-4)
    for leg, (_, _, ankle, toe) in enumerate(clip.rig.joints):
        foot = clip.positions_ws[:, toe] - clip.positions_ws[:, ankle]
        foot_yaw = np.arctan2(foot[:, 0], foot[:, 2])
        rot = Rotation.from_quat(clip.rotations_ws[:, ankle], scalar_first=True)
        left = rot.apply([1.0, 0.0, 0.0])
        turned = np.arctan2(-left[:, 2], left[:, 0])
        for first, last in stances(clip, leg):
            ball = clip.positions_ws[first, toe]
            nearest = np.argmin(np.linalg.norm((pelvis_ws - ball)[:, [0, 2]], axis=-1))
            np.testing.assert_allclose(foot_yaw[first:last], yaw[nearest], atol=0.01)
            np.testing.assert_allclose(turned[first:last], foot_yaw[first:last], atol=1e-9)
        np.testing.assert_allclose(left[:, 1], 0.0, atol=1e-9)
        assert np.abs(np.diff(turned)).max() < 0.05, "a foot turns with a jerk"


def test_a_foot_without_a_label_is_on_its_way_and_knees_point_forward():
    for clip in map(clip_of, ACTIONS):
        stance = clip.stance_labels()
        moving = ~(stance[1:-1] | stance[:-2] | stance[2:])
        speeds = np.linalg.norm(np.diff(clip.joints_ws(3), axis=0), axis=-1)[1:] * FPS
        assert (speeds[moving] > 0.02).all(), clip.source
        hip, knee, ankle = (clip.joints_ws(role) for role in range(3))
        forward = np.cross(clip.left_ws()[:, None], [0.0, 1.0, 0.0])
        ahead = np.sum((knee - (hip + ankle) / 2) * forward, axis=-1)
        assert (ahead > 0.0).all(), clip.source


def test_a_jump_falls_freely_a_run_flies_a_turn_turns_and_a_crouch_goes_down_and_up():
    clip = clip_of("jump")
    flying = ~clip.stance_labels().any(axis=1)
    middle = flying & np.roll(flying, 8) & np.roll(flying, -8)
    fall = np.diff(clip.positions_ws[:, clip.rig.pelvis, 1], n=2) * FPS**2
    np.testing.assert_allclose(fall[middle[1:-1]], -actions.GRAVITY, rtol=0.02)
    assert middle.sum() > 5
    stance = clip_of("run").stance_labels()
    assert 0.2 < np.mean(~stance.any(axis=1)) < 0.4 and not stance.all(axis=1).any()
    y, w = clip_of("turn").rotations_ws[:, 0, [2, 0]].T
    turned = np.unwrap(2 * np.arctan2(y, w))
    assert turned[-1] - turned[0] > np.radians(150.0)
    height = clip_of("crouch").positions_ws[:, 0, 1]
    assert height[0] == pytest.approx(height[-1]) == pytest.approx(height.min() + actions.DEPTH)


def test_four_limbs_stay_bent_towards_their_pole_and_walk_in_lateral_sequence():
    clip = clip_of("quadruped")
    landings = [
        (first, name)
        for leg, name in enumerate(clip.rig.names)
        for first, _ in contacts.runs(clip.stance_labels()[:, leg])
        if first > 0
    ]
    names = [name for _, name in sorted(landings)]
    start = names.index("hind_left")
    expected = ["hind_left", "fore_left", "hind_right", "fore_right"] * 3
    assert names[start : start + 12] == expected
    assert clip.stance_labels().sum(axis=1).min() >= 2
    speeds = np.linalg.norm(np.diff(clip.positions_ws, axis=0), axis=-1) * FPS
    assert 0.8 < speeds[:, 0].min() and speeds[:, 0].max() < 1.3 and speeds.max() < 5.5
    for name, body in BODIES.items():
        for limb, joints in zip(body.limbs, clip_of(name).rig.joints, strict=True):
            a, b, c = (places(name)[:, joint] for joint in joints[:3])
            length = np.linalg.norm(c - a, axis=-1, keepdims=True)
            stretch = length / sum(limb.bones)
            assert 0.3 < stretch.min() and stretch.max() < 0.96, limb
            along = (c - a) / length
            out = b - a - along * np.sum((b - a) * along, axis=-1, keepdims=True)
            assert (out @ np.array(limb.pole)).min() > 0.0, limb


def test_the_climber_moves_one_limb_at_a_time_and_goes_straight_up_the_wall():
    clip = clip_of("climber")
    assert clip.stance_labels().sum(axis=1).min() == 3
    moved = clip.positions_ws[-1, 0] - clip.positions_ws[0, 0]
    np.testing.assert_allclose(moved[[0, 2]], 0.0, rtol=0, atol=EXACT)
    assert 0.5 < moved[1] < 1.2
    assert clip.positions_ws[..., 2].max() < 0.0  # in front of the wall z = 0
    assert np.linalg.norm(np.diff(clip.positions_ws, axis=0), axis=-1).max() * FPS < 2.0


@pytest.mark.slow
def test_on_a_wall_the_root_lies_on_it_and_foot_ik_moves_four_limbs_over_it(tmp_path):
    clip = multi_limb.climb(1.0, 30.0)
    frames = clip_frames.frames_from_clip(clip, up_ws=WALL_UP)
    root, below = frames.world_from_model, clip.positions_ws[:, 0] * [1.0, 1.0, 0.0]
    np.testing.assert_allclose(root.pos, below, rtol=0, atol=1e-12)
    rot = Rotation.from_quat(np.asarray(root.rot), scalar_first=True)
    for axis, expected in zip(np.eye(3), ([1, 0, 0], WALL_UP, [0, 1, 0]), strict=True):
        np.testing.assert_allclose(rot.apply(axis), np.tile(expected, (30, 1)), atol=1e-12)
    speed = multi_limb.CLIMBER.stride / multi_limb.CLIMBER.period
    np.testing.assert_allclose(frames.speed, speed, rtol=1e-9)
    meshes.save_mesh(tmp_path / "ground.ply", *wall())
    ground = meshes.load_terrain(tmp_path / "ground.ply", up=WALL_UP)
    result = jaxik.run(jaxik.presets.ozz(faithful=True), clip.rig, ground, frames)
    assert np.asarray(result.trace.sensed.ground.ankle.found).min() == 1.0
    assert np.asarray(result.reached).mean() > 0.95
    solved = clip_frames.clip_from_result(clip, result, up_ws=WALL_UP)
    assert np.isfinite(solved.positions_ws).all()
    lifted = (solved.positions_ws - clip.positions_ws) @ np.array(WALL_UP)
    assert 0.01 < np.abs(lifted).max() < 0.25
