"""Conversion of clips to frames of the pipeline, and of its results to clips."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxik
from fitting.clips import Clip, clip_frames, contacts
from fitting.ground.ground_path import place_root
from fitting.motion.flat_animation import with_cut_off_swings
from fitting.studies import animations
from fitting.studies.animations import Animation
from fitting.synthetic import footsteps, walker
from jaxik.maths import parameter_tree
from jaxik.world import terrain
from support.clips import legs_alone
from support.grounds import edges_between_footfalls, flight, terrain_of

FPS = 60.0


@pytest.fixture(scope="module")
def clip():
    return legs_alone(walker.walk(2.0, FPS, events=[walker.Slide(1.0, 1.5)]))


@pytest.fixture(scope="module")
def result(clip):
    ground = terrain.plane(normal=(0.0, 1.0, -0.15))
    ik = parameter_tree.replace(jaxik.presets.record(faithful=True), {"lean.forward_rate": 0.5})
    return jaxik.run(ik, clip.rig, ground, clip_frames.frames_from_clip(clip))


def rotation(wxyz) -> Rotation:
    return Rotation.from_quat(np.asarray(wxyz), scalar_first=True)


def placed(world, pose: jaxik.LegPose) -> np.ndarray:
    """Joints of a pose in model space, m, in world space, (frames, legs, roles, 3)."""
    joints = np.stack([part.pos for part in (pose.hip, pose.knee, pose.ankle, pose.toe)], axis=2)
    turned = np.einsum("fij,flrj->flri", rotation(world.rot).as_matrix(), joints)
    return turned + np.asarray(world.pos)[:, None, None]


def test_frames_hold_the_clip_in_model_space_above_the_floor(clip):
    frames = clip_frames.frames_from_clip(clip, floor=-0.1)
    joints = clip.positions_ws[:, np.array(clip.rig.joints)]
    found = placed(frames.world_from_model, frames.pose)
    np.testing.assert_allclose(found, joints, rtol=0, atol=1e-9)
    pose = frames.pose
    assert float(pose.ankle.pos[..., 1].min()) == pytest.approx(footsteps.ANKLE_HEIGHT + 0.1)
    assert frames.weight.shape == (clip.frame_count, 2)
    np.testing.assert_allclose(frames.dt, 1 / FPS)
    np.testing.assert_array_equal(frames.slide, clip.slide)
    np.testing.assert_allclose(frames.speed, footsteps.STRIDE / footsteps.PERIOD, rtol=0.02)
    steps = np.linalg.norm(np.diff(clip.joints_ws(3), axis=0), axis=-1) * FPS
    np.testing.assert_allclose(frames.toe_speed[1:], steps, rtol=1e-9)
    alone = dataclasses.replace(clip, slide=None).select(slice(0, 1))
    frame = clip_frames.frames_from_clip(alone)
    np.testing.assert_array_equal([frame.speed, frame.slide], [[0.0], [0.0]])


def with_joints(clip, joints):
    """The clip with further joints: name, parent, and offset in the parent's space, m."""
    for name, parent, offset in joints:
        rotations = clip.rotations_ws[:, parent]
        turned = rotation(rotations).apply(offset)
        positions = clip.positions_ws[:, parent] + turned
        clip = dataclasses.replace(
            clip,
            joint_names=(*clip.joint_names, name),
            parents=(*clip.parents, parent),
            offsets_ls=np.concatenate([clip.offsets_ls, [offset]]),
            positions_ws=np.concatenate([clip.positions_ws, positions[:, None]], axis=1),
            rotations_ws=np.concatenate([clip.rotations_ws, rotations[:, None]], axis=1),
        )
    return clip


@pytest.mark.slow
def test_the_solved_clip_has_the_solved_legs_and_the_rest_moves_with_the_body(clip, result):
    solved = clip_frames.clip_from_result(clip, result)
    joints = solved.positions_ws[:, np.array(clip.rig.joints)]
    np.testing.assert_allclose(joints, placed(clip.world_from_model(), result.pose), atol=1e-9)
    lengths = [
        np.linalg.norm(c.positions_ws[:, 1] - c.positions_ws[:, 0], axis=-1) for c in (clip, solved)
    ]
    np.testing.assert_allclose(*lengths, rtol=0, atol=1e-9)
    assert rotation(solved.rotations_ws[100, 0]).magnitude() > 0.03
    assert solved.rig.joints == clip.rig.joints
    # Joints above the pelvis and below a foot stay rigid on their parents.
    added = [("tip", 4, [0.01, -0.02, 0.05]), ("head", 0, [0.0, 0.6, 0.0])]
    solved = clip_frames.clip_from_result(with_joints(clip, added), result)
    for joint, (_, parent, offset) in enumerate(added, 9):
        turned = rotation(solved.rotations_ws[:, parent]).apply(offset)
        attached = solved.positions_ws[:, parent] + turned
        np.testing.assert_allclose(solved.positions_ws[:, joint], attached, rtol=0, atol=1e-9)
        cosine = np.abs(np.sum(solved.rotations_ws[:, joint] * solved.rotations_ws[:, parent], -1))
        np.testing.assert_allclose(cosine, 1.0, atol=1e-12)


@pytest.mark.slow
def test_spine_and_head_lean_as_the_system_says(clip, result):
    joints = [("spine", 0, [0.0, 0.1, 0.0]), ("neck", 9, [0.0, 0.4, 0.0])]
    joints += [("arm", 10, [0.2, 0.0, 0.0]), ("head", 10, [0.0, 0.1, 0.0])]
    taller = with_joints(clip, [*joints, ("crown", 12, [0.0, 0.2, 0.0])])
    bend = Rotation.from_rotvec(np.outer(np.linspace(0.0, 0.3, clip.frame_count), [1.0, 0.0, 0.2]))
    corrections = dataclasses.replace(
        result.corrections,
        spine=jnp.asarray(bend.as_quat(scalar_first=True)),
        head=jnp.asarray(bend.inv().as_quat(scalar_first=True)),
    )
    plain = clip_frames.clip_from_result(taller, result)
    leaning = dataclasses.replace(result, corrections=corrections)
    leant = clip_frames.clip_from_result(taller, leaning)
    np.testing.assert_array_equal(leant.positions_ws[:, :10], plain.positions_ws[:, :10])
    root = rotation(clip.world_from_model().rot)
    turn = root * bend * root.inv()  # world axes
    for joint, pivot in ((10, 9), (11, 9), (12, 9)):
        arm = plain.positions_ws[:, joint] - plain.positions_ws[:, pivot]
        expected = plain.positions_ws[:, pivot] + turn.apply(arm)
        np.testing.assert_allclose(leant.positions_ws[:, joint], expected, atol=1e-12)
    crown, before = (c.positions_ws[:, 13] - c.positions_ws[:, 12] for c in (leant, plain))
    np.testing.assert_allclose(crown, before, atol=1e-12)  # the head turned back
    text = animations.trunk_text(leaning, taller)
    most = np.degrees(bend.magnitude().max())
    assert text == f"spine: leans by up to {most:.1f}°, applied to spine; head turns back"
    legs_only = clip_frames.clip_from_result(clip, leaning)
    np.testing.assert_array_equal(legs_only.positions_ws, plain.positions_ws[:, :9])


def test_the_joints_of_the_spine_share_a_twist_up_to_where_the_arms_branch_off(clip, result):
    joints = [("spine", 0, [0.0, 0.1, 0.0]), ("chest", 9, [0.0, 0.2, 0.1])]
    joints += [("arm", 10, [0.2, 0.0, 0.0]), ("neck", 10, [0.0, 0.1, 0.0])]
    taller = with_joints(clip, [*joints, ("head", 12, [0.0, 0.1, 0.0])])
    twist = Rotation.from_rotvec(np.outer(np.linspace(0.0, 0.8, clip.frame_count), [0.0, 1.0, 0.1]))
    corrections = dataclasses.replace(
        result.corrections, twist=jnp.asarray(twist.as_quat(scalar_first=True))
    )
    plain = clip_frames.clip_from_result(taller, result)
    twisted = dataclasses.replace(result, corrections=corrections)
    solved = clip_frames.clip_from_result(taller, twisted)
    root = rotation(clip.world_from_model().rot)
    for joint, share in ((0, 0.0), (9, 0.5), (10, 1.0), (11, 1.0), (12, 1.0), (13, 1.0)):
        turn = (
            rotation(solved.rotations_ws[:, joint]) * rotation(plain.rotations_ws[:, joint]).inv()
        )
        expected = root * Rotation.from_rotvec(share * twist.as_rotvec()) * root.inv()
        np.testing.assert_allclose((turn * expected.inv()).magnitude(), 0.0, atol=1e-9)
    text = "spine: twists by up to 46.1° against the pelvis, "
    assert animations.trunk_text(twisted, taller) == f"{text}shared by spine, chest"
    assert animations.trunk_text(twisted, clip).startswith(f"{text}not applied: the clip has no")
    for low, high in ((0, 9), (9, 10), (10, 11), (12, 13)):
        bones = (c.positions_ws[:, high] - c.positions_ws[:, low] for c in (plain, solved))
        turns = (rotation(c.rotations_ws[:, low]).inv() for c in (plain, solved))
        before, after = (turn.apply(bone) for turn, bone in zip(turns, bones, strict=True))
        np.testing.assert_allclose(after, before, atol=1e-9)


def test_a_raised_character_has_the_pose_speeds_and_contact_labels_of_its_floor(clip):
    rise = 0.5 * np.arange(clip.frame_count) / clip.frame_count
    frames, flat = (clip_frames.frames_from_clip(clip, rise=height) for height in (rise, None))
    moved = np.asarray(frames.world_from_model.pos - flat.world_from_model.pos)
    np.testing.assert_allclose(moved, rise[:, None] * [0.0, 1.0, 0.0], atol=1e-12)
    same = dataclasses.replace(frames, world_from_model=flat.world_from_model)
    jax.tree.map(np.testing.assert_array_equal, same, flat)
    # Foot IK that changes nothing gives the raised clip.
    nothing = {"lock.enabled": jnp.array(False), "leg.weight": jnp.array(0.0)}
    ik = parameter_tree.replace(jaxik.presets.record(faithful=True), nothing)  # as above
    result = jaxik.run(ik, clip.rig, terrain.plane((0.0, -9.0, 0.0)), frames)
    solved = clip_frames.clip_from_result(clip, result, rise=rise)
    raised = clip_frames.raised(clip, rise)
    np.testing.assert_allclose(solved.positions_ws, raised.positions_ws, rtol=0, atol=1e-9)
    unlabelled = dataclasses.replace(clip, stance=None)
    raised = clip_frames.raised(unlabelled, np.linspace(0.0, 2.0, clip.frame_count))
    np.testing.assert_array_equal(raised.stance_labels(), unlabelled.stance_labels())
    assert clip_frames.raised(clip, None) is clip


# Strides


def test_strides_go_from_stance_to_stance_and_are_unknown_of_a_foot_that_never_stands(clip):
    stride = jax.tree.map(np.asarray, clip_frames.frames_from_clip(clip).stride)
    stance = clip.stance_labels()
    np.testing.assert_array_equal(stride.standing, stance)
    assert stride.aside_ws is not None
    balls = clip.joints_ws(3)
    for leg in range(2):
        stances = contacts.runs(stance[:, leg])
        np.testing.assert_array_equal(stride.known[:, leg], 1.0)
        middles = [np.median(balls[a : b + 1, leg], axis=0) for a, b in stances]
        for n, ((first, last), (landing, _)) in enumerate(itertools.pairwise(stances)):
            here = slice(first, landing)
            assert (stride.last_ws[here, leg] == middles[n]).all()
            assert (stride.next_ws[here, leg] == middles[n + 1]).all()
            aside_ws = np.asarray(stride.aside_ws[here, leg])
            assert np.all(aside_ws == aside_ws[0]) and aside_ws[0, 1] == 0.0 < np.ptp(aside_ws)
            np.testing.assert_array_equal(stride.fraction[first : last + 1, leg], 0.0)
            steps = np.diff(stride.fraction[last:landing, leg])
            np.testing.assert_allclose(steps, 1 / (landing - last), rtol=1e-9)
    hopping = dataclasses.replace(clip, stance=stance & np.array([True, False]))
    stride = clip_frames.frames_from_clip(hopping).stride
    np.testing.assert_array_equal(stride.known[:, 1], 0.0)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(stride))
    # They bend as a ball on a parabola does, 0.12 m beside the straight way in the middle.
    part = np.clip((np.arange(40) - 10) / 20, 0.0, 1.0)[:, None]
    arc = 4.0 * part * (1.0 - part)
    for up in np.eye(3)[1:]:
        ahead = np.roll(up, 1)
        right = np.cross(up, ahead)
        ball_ws = [0.3, 0.2, -0.4] + 0.7 * part * ahead + arc * (0.1 * up + 0.12 * right)
        stance = (part[:, 0] == 0.0) | (part[:, 0] == 1.0)
        aside_ws = contacts.footfalls(ball_ws, stance, tuple(up)).aside_ws
        np.testing.assert_allclose(aside_ws, [0.12 * right, np.zeros(3)], rtol=0, atol=1e-12)


def test_a_teleport_restarts_with_the_speeds_and_strides_that_follow(clip):
    positions = clip.positions_ws.copy()
    positions[70:, :, 0] += 8.0
    jumped = clip.with_motion(positions, clip.rotations_ws)
    assert (clip.cuts, jumped.cuts) == ((), (70,))
    frames = clip_frames.frames_from_clip(jumped)
    np.testing.assert_array_equal(np.flatnonzero(np.asarray(frames.restart)), [70])
    assert clip_frames.frames_from_clip(clip).restart is None
    parts = [clip_frames.frames_from_clip(jumped.select(piece)) for piece in jumped.pieces]
    for name in ("velocity_ws", "foot_speed", "toe_speed"):
        expected = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_allclose(getattr(frames, name), expected, atol=1e-6)
    leaves = (jax.tree.leaves(each.stride) for each in (frames, *parts))
    for found, *each in zip(*leaves, strict=True):
        np.testing.assert_allclose(found, np.concatenate(each), atol=1e-6)
    for fps in (10.0, 60.0):  # neither a sprint nor a stray frame is a teleport
        clip = walker.walk(2.0, fps)
        ahead = np.arange(clip.frame_count)[:, None, None] / fps * [0, 0, 12.0]
        assert clip.with_motion(clip.positions_ws + ahead, clip.rotations_ws).cuts == (), fps
        stray = clip.positions_ws.copy()
        stray[clip.frame_count // 2] += [5.0, 0.0, 0.0]
        assert clip.with_motion(stray, clip.rotations_ws).cuts == (), fps


# Swings that the start or the end of a clip cuts off, against those of the whole clip

LEG = 1


@pytest.fixture(scope="module")
def walk() -> Clip:
    walk = walker.walk(8.0, FPS, style=walker.WalkStyle(bend=0.0))
    return dataclasses.replace(walk, stance=walk.stance_labels())


def swing_of(walk: Clip) -> tuple[int, int]:
    """The last frame of a stance in the middle of the walk, and the first one of the next."""
    stances = contacts.runs(walk.stance_labels()[:, LEG])
    return stances[3][1], stances[4][0]


def cut(walk: Clip, part: float) -> Clip:
    """The walk from where so much of a swing has passed."""
    leaving, landing = swing_of(walk)
    return walk.select(np.arange(round(leaving + part * (landing - leaving)), walk.frame_count))


def stairs(walk: Clip, rise: float) -> terrain.Terrain:
    return terrain_of(flight(edges_between_footfalls(walk, 12), rise))


def test_a_swing_that_is_cut_off_begins_where_the_whole_clip_shows_it(walk):
    leaving, landing = swing_of(walk)
    first, last = contacts.runs(walk.stance_labels()[:, LEG])[3]
    expected = np.median(walk.joints_ws(3)[first : last + 1, LEG], axis=0)
    for part in (0.05, 0.3, 0.6, 0.95):
        clip = cut(walk, part)
        cut_off = contacts.cut_off_swing(clip.joints_ws(3), clip.stance_labels(), LEG)
        assert cut_off is not None, part
        np.testing.assert_allclose(cut_off.last_ws[[0, 2]], expected[[0, 2]], atol=0.06)
        frames = np.arange(walk.frame_count - clip.frame_count, landing)
        fraction, frame = (frames - leaving) / (landing - leaving), 1 / (landing - leaving)
        np.testing.assert_allclose(cut_off.fraction, fraction, atol=2 * frame)
    clip = cut(walk, 0.5)
    balls_ws, stance = clip.joints_ws(3), clip.stance_labels()
    first, last = contacts.runs(stance[:, LEG])[0]
    for frames in (slice(first, None), slice(last), slice(first)):
        # It starts standing, or no foot has a whole swing, or it never lands.
        assert contacts.cut_off_swing(balls_ws[frames], stance[frames], LEG) is None


@pytest.mark.slow
def test_a_swing_that_the_end_cuts_off_goes_on_as_in_the_whole_clip(walk):
    leaving, landing = swing_of(walk)
    whole = clip_frames.frames_from_clip(walk).stride
    # In a clip that starts here the foot stands once, and the other one has the whole swing.
    once = contacts.runs(walk.stance_labels()[:, LEG])[3][0] - 5
    for start, part in ((0, 0.05), (0, 0.3), (0, 0.6), (0, 0.95), (once, 0.2), (once, 0.95)):
        end = round(leaving + part * (landing - leaving)) + 1
        stride = clip_frames.frames_from_clip(walk.select(np.arange(start, end))).stride
        np.testing.assert_array_equal(stride.known[:, LEG], 1.0)
        for name, near in (
            ("last_ws", 0.0),
            ("next_ws", 0.06),
            ("fraction", 2 / (landing - leaving)),
        ):
            expected = getattr(whole, name)[leaving - 5 : end, LEG]
            actual = getattr(stride, name)[leaving - 5 - start :, LEG]
            np.testing.assert_allclose(actual, expected, rtol=0, atol=near + 1e-9, err_msg=name)
        expected = whole.next_ws[start : start + 5, LEG]  # also of a swing that the start cuts off
        np.testing.assert_array_equal(stride.next_ws[:5, LEG], expected)
    first, last = contacts.runs(walk.stance_labels()[:, LEG])[0]
    for frames, known in ((np.arange(last + 2), last), (np.arange(first), -1)):
        # No whole swing says how long and far one goes, or the foot never stands.
        stride = clip_frames.frames_from_clip(walk.select(frames)).stride
        np.testing.assert_array_equal(stride.known[:, LEG], frames <= known)


def test_only_higher_ground_under_a_swing_that_is_cut_off_counts_also_after_a_teleport(walk):
    clip = cut(walk, 0.3)
    plain = clip_frames.frames_from_clip(clip)
    before = contacts.runs(clip.stance_labels()[:, LEG])[0][0]
    for rise in (0.15, 0.0, -0.15):
        stride = with_cut_off_swings(plain, clip, stairs(walk, rise)).stride
        assert np.any(stride.last_ws != plain.stride.last_ws) == (rise < 0), rise
        assert np.any(stride.fraction != plain.stride.fraction) == (rise < 0), rise
        np.testing.assert_array_equal(stride.last_ws[before:], plain.stride.last_ws[before:])
        np.testing.assert_array_equal(stride.next_ws, plain.stride.next_ws)
    both = walk.select(np.r_[np.arange(60), np.arange(walk.frame_count)[-clip.frame_count :]])
    assert both.cuts == (60,)
    frames = clip_frames.frames_from_clip(both)
    joined = with_cut_off_swings(frames, both, stairs(walk, -0.15)).stride
    np.testing.assert_array_equal(joined.last_ws[60:], stride.last_ws)
    np.testing.assert_array_equal(joined.fraction[60:], stride.fraction)
    # An animation's frames know of it.
    down = stairs(walk, -0.15)
    clip, root = place_root(cut(walk, 0.1), down)
    frames = clip_frames.frames_from_clip(clip, rise=root.rise)
    expected = with_cut_off_swings(frames, clip, down)
    assert np.any(expected.stride.last_ws != frames.stride.last_ws)
    jax.tree.map(np.testing.assert_array_equal, Animation(clip, down, root=root).frames, expected)
