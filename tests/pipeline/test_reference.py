"""The NumPy reference of `record` by itself: facts that hold whatever the JAX code does."""

import dataclasses
import math

import numpy as np
import pytest

from reference import maths
from reference.sample_poses import (
    ANKLE,
    STILL,
    make_frame,
    make_rig,
    plane,
    random_rot,
    rotation_angle,
    rough,
    standing,
    stepping,
)
from reference.systems.record import Frame, Parameters, Rig, Transform, run, step
from reference.terrain import Terrain

EXACT = 1e-9  # m and rad
UNLIMITED = {
    "foot.max_pitch": math.pi,
    "foot.min_pitch": -math.pi,
    "foot.max_roll": math.pi,
    "foot.min_roll": -math.pi,
    "target.max_ankle_height": 9.0,
    "target.min_ankle_height": -9.0,
}
NO_LEAN = {"lean.forward_rate": 0.0, "lean.side_rate": 0.0}
NO_LOCK = {"lock.enabled": False}


def assert_unchanged(output: dict[str, np.ndarray], frames: list[Frame]) -> None:
    for name in ("hip", "knee", "ankle", "toe"):
        animated = [getattr(frame, name) for frame in frames]
        assert np.allclose(output[f"{name}_pos"], [a.pos for a in animated], atol=EXACT)
        assert rotation_angle(output[f"{name}_rot"], np.array([a.rot for a in animated])) < EXACT


def test_flat_ground_leaves_a_standing_pose_unchanged():
    rig = make_rig(np.random.default_rng(0))
    frames = [make_frame(rig, standing())] * 5
    output = run(Parameters(), rig, plane(0.0, 0.0), frames)
    assert_unchanged(output, frames)
    assert output["reached"].all() and output["locked"].all()


def test_flat_ground_leaves_a_stepping_pose_unchanged_locks_included():
    rig = make_rig(np.random.default_rng(1))
    frames = stepping(rig)
    output = run(Parameters(UNLIMITED), rig, plane(0.0, 0.0), frames)
    assert_unchanged(output, frames)
    switches = np.diff(output["locked"].astype(int), axis=0)
    assert (switches == 1).any(axis=0).all() and (switches == -1).any(axis=0).all()


def test_the_ankle_arrives_at_a_reachable_target_and_no_bone_changes():
    rng = np.random.default_rng(2)
    arrived, missed = 0, 0
    for _ in range(60):
        rig = make_rig(rng, legs=3)
        ankles = standing((ANKLE, 0.15, 0.1)) + rng.uniform(-0.05, 0.05, size=(3, 3))
        root = Transform(
            rng.normal(size=3) * [1, 0, 1], maths.from_axis_angle(maths.Y, rng.uniform(-3, 3))
        )
        frame = make_frame(rig, ankles, 0.9, rng.uniform(-0.4, 0.4), world_from_model=root)
        # Tilt the hinge, so that it is no longer perpendicular to thigh and shin.
        frame.knee.rot[:] = [
            maths.multiply(maths.from_axis_angle(maths.Z, rng.uniform(-0.3, 0.3)), rot)
            for rot in frame.knee.rot
        ]
        changes = {"leg.max_knee_angle": math.pi, "leg.min_knee_angle": 0.0}
        ground = plane(*rng.uniform(-0.4, 0.4, size=2), height=rng.uniform(-0.25, 0.25))
        _, output = step(Parameters(UNLIMITED | changes), rig, ground, None, frame)
        ankle_ws = [maths.apply(root, pos) for pos in output["ankle_pos"]]
        gap = np.linalg.norm(ankle_ws - output["target_ws"], axis=-1)
        arrived += int(output["reached"].sum())
        missed += int((~output["reached"]).sum())
        assert (gap[output["reached"]] < EXACT).all()
        assert (gap[~output["reached"]] > EXACT).all()
        for one, other in (("hip", "knee"), ("knee", "ankle"), ("ankle", "toe")):
            after = np.linalg.norm(output[f"{one}_pos"] - output[f"{other}_pos"], axis=-1)
            before = np.linalg.norm(getattr(frame, one).pos - getattr(frame, other).pos, axis=-1)
            assert np.allclose(after, before, atol=EXACT)
    assert arrived > 50 and missed > 10


def test_joint_rotations_carry_their_bones():
    rng = np.random.default_rng(3)
    rig = make_rig(rng)
    frame = make_frame(rig, standing((ANKLE, 0.14)))
    _, output = step(Parameters({"leg.twist": 0.3}), rig, plane(0.3, -0.2, 0.1), None, frame)
    for one, other in (("hip", "knee"), ("knee", "ankle"), ("ankle", "toe")):
        for leg in range(2):
            joint, child = getattr(frame, one), getattr(frame, other)
            local = maths.unapply(Transform(joint.pos[leg], joint.rot[leg]), child.pos[leg])
            carried = Transform(output[f"{one}_pos"][leg], output[f"{one}_rot"][leg])
            assert np.allclose(maths.apply(carried, local), output[f"{other}_pos"][leg], atol=EXACT)
            assert not np.allclose(child.pos[leg], output[f"{other}_pos"][leg], atol=1e-3)


def test_the_knee_limit_keeps_the_leg_from_straightening():
    rig = make_rig(np.random.default_rng(4))
    limit = math.radians(150)
    changes = NO_LEAN | NO_LOCK | {"leg.max_knee_angle": limit, "pelvis.limit": 0.0}
    far = plane(0.0, 0.0, height=-0.6)
    _, output = step(
        Parameters(changes | {"target.min_ankle_height": -9.0}),
        rig,
        far,
        None,
        make_frame(rig, standing()),
    )
    thigh = output["hip_pos"] - output["knee_pos"]
    shin = output["ankle_pos"] - output["knee_pos"]
    angles = [maths.angle_between(a, b) for a, b in zip(thigh, shin, strict=True)]
    assert not output["reached"].any()
    assert angles == pytest.approx([limit, limit], abs=1e-6)


@pytest.mark.parametrize("use_toe", [False, True])
def test_the_sole_takes_the_slope_of_the_ground_when_limits_are_wide(use_toe):
    rng = np.random.default_rng(5)
    for _ in range(20):
        rig = make_rig(rng)
        rises = rng.uniform(-0.5, 0.5, size=2)
        ground = plane(*rises)
        root = Transform(np.zeros(3), maths.from_axis_angle(maths.Y, rng.uniform(-3, 3)))
        frame = make_frame(rig, standing(), world_from_model=root)
        _, output = step(
            Parameters(UNLIMITED | {"probe.use_toe": use_toe}), rig, ground, None, frame
        )
        normal = maths.unit(np.array([-rises[1], 1.0, -rises[0]]), maths.Y)
        for leg in range(2):
            foot = maths.multiply(output["ankle_rot"][leg], rig.ankle_from_foot[leg])
            sole = maths.rotate(root.rot, maths.rotate(foot, maths.Y))
            ahead = maths.rotate(root.rot, maths.rotate(foot, maths.Z))
            heading = maths.rotate(root.rot, maths.Z)
            assert np.allclose(sole, normal, atol=EXACT)
            assert abs(maths.signed_angle(heading, ahead, maths.Y)) < EXACT


def test_limits_mirror_and_stop_the_outer_edge():
    rig = make_rig(np.random.default_rng(6))
    changes = {"foot.max_roll": 0.1, "foot.min_roll": -0.3, "probe.use_toe": False}
    _, output = step(
        Parameters(UNLIMITED | changes | NO_LEAN),
        rig,
        plane(0.0, 0.5),
        None,
        make_frame(rig, standing()),
    )
    tilts = []
    for leg in range(2):
        shin = maths.unit(output["ankle_pos"][leg] - output["knee_pos"][leg], -maths.Y)
        foot = maths.multiply(output["ankle_rot"][leg], rig.ankle_from_foot[leg])
        # Limits apply to the angle between foot and shin.
        joint = -math.asin(float(rig.side[leg] * maths.X @ shin))
        up = maths.rotate(foot, maths.Y)
        tilts.append(joint + math.atan2(-rig.side[leg] * up[0], up[1]))
    # Ground rising to the left lifts the left foot's outer edge and lowers the right one's.
    assert tilts == pytest.approx([0.1, -0.3], abs=EXACT)


def test_the_ankle_stays_one_foot_height_above_a_slope():
    rig = make_rig(np.random.default_rng(7))
    slope = 0.4
    _, output = step(
        Parameters(UNLIMITED | NO_LEAN), rig, plane(slope, 0.0), None, make_frame(rig, standing())
    )
    normal = maths.unit(np.array([0.0, 1.0, -slope]), maths.Y)
    assert np.allclose(output["target_ws"] @ normal, ANKLE, atol=EXACT)


def test_a_full_lock_keeps_the_foothold_exactly():
    rig = make_rig(np.random.default_rng(8))
    frames = [make_frame(rig, standing(forward=0.05 + 0.001 * i)) for i in range(40)]
    dragged = run(Parameters({"lock.lock_half_life": 0.0}), rig, plane(0.2, 0.1), frames)
    assert dragged["locked"].all() and (dragged["factor"] == 1.0).all()
    assert np.ptp(dragged["target_ws"], axis=0).max() < EXACT
    free = run(Parameters(NO_LOCK), rig, plane(0.2, 0.1), frames)
    assert np.ptp(free["target_ws"][:, :, 2], axis=0).min() > 0.038


def test_a_lock_moves_with_its_platform():
    rig = make_rig(np.random.default_rng(9))
    frames = [
        make_frame(
            rig,
            standing(),
            platforms=[Transform(np.array([0.002 * i, 0.0, 0.0]), STILL.rot)],
            platforms_before=[Transform(np.array([0.002 * (i - 1), 0.0, 0.0]), STILL.rot)],
        )
        for i in range(20)
    ]
    ground = dataclasses.replace(plane(0.0, 0.0), platform=0)
    output = run(Parameters({"lock.lock_half_life": 0.0}), rig, ground, frames)
    assert output["locked"].all()
    assert np.allclose(np.diff(output["target_ws"], axis=0), [0.002, 0.0, 0.0], atol=EXACT)


@pytest.mark.parametrize("hz", [30.0, 60.0, 120.0])
def test_a_released_offset_halves_each_half_life(hz):
    rig = make_rig(np.random.default_rng(10))
    half_life, dt = 0.1, 1.0 / hz
    dragged = [make_frame(rig, standing(forward=0.02 * i), dt=dt) for i in range(3)]
    lifted = [make_frame(rig, standing((0.2, 0.2)), dt=dt)] * (1 + int(hz * half_life))
    changes = {"lock.lock_half_life": 0.0, "lock.unlock_half_life": half_life}
    output = run(Parameters(changes), rig, plane(0.0, 0.0), dragged + lifted)
    offset, locked = output["offset_ws"], output["locked"]
    assert locked[:3].all() and not locked[3:].any()
    assert np.allclose(offset[2], [0.0, 0.0, -0.04], atol=EXACT)
    assert np.allclose(offset[3], offset[2] * 2 ** (-dt / half_life), atol=EXACT)
    assert np.allclose(offset[-1], offset[3] / 2.0, atol=EXACT)


@pytest.mark.parametrize(
    "changes, released",
    [
        ({}, False),
        ({"lock.release_cone": math.radians(2.0)}, True),
        ({"lock.release_distance": 0.05}, True),
        ({"lock.release_max_angle": math.radians(130.0)}, True),
        ({"lock.release_min_angle": math.radians(170.0)}, True),
        ({"lock.enabled": False}, True),
        ({"leg.weight": 0.0}, True),
    ],
)
def test_each_release_condition_alone_frees_a_locked_foot(changes, released):
    rig = make_rig(np.random.default_rng(11))
    frames = [make_frame(rig, standing(forward=0.06 * i)) for i in range(2)]
    ground = plane(0.0, 0.0)
    state, output = step(Parameters(), rig, ground, None, frames[0])
    assert output["locked"].all()
    _, output = step(Parameters(changes), rig, ground, state, frames[1])
    assert (output["locked"] == (not released)).all()


def test_a_foot_locks_again_only_below_the_threshold():
    rig = make_rig(np.random.default_rng(12))
    ground = plane(0.0, 0.0)
    frames = [make_frame(rig, standing())] + [make_frame(rig, standing((0.2, 0.2)))] * 3
    frames += [make_frame(rig, standing())] * 20
    changes = {"lock.lock_half_life": 0.0, "lock.unlock_half_life": 0.1}
    output = run(Parameters(changes | {"lock.relock_threshold": 0.3}), rig, ground, frames)
    first = 4 + int(np.argmax(output["locked"][4:, 0]))
    # Free since frame 1 with a factor of 2^(-frames / 6).
    assert 2 ** (-(first - 1) / 6) <= 0.3 < 2 ** (-(first - 2) / 6)
    assert not output["locked"][1:first].any() and output["locked"][first:].all()


def test_a_fast_foot_does_not_lock():
    rig = make_rig(np.random.default_rng(13))
    frames = [make_frame(rig, standing((0.2, 0.2)))]
    frames += [make_frame(rig, standing(forward=0.06 + 0.01 * i)) for i in range(2)]
    for max_speed, locks in ((0.59, False), (0.61, True)):
        changes = {"lock.max_speed": max_speed}
        output = run(Parameters(changes), rig, plane(0.0, 0.0), frames)
        assert (output["locked"][2] == locks).all()


def test_the_body_sinks_to_the_lower_foot_and_gains_mean_the_same_at_any_rate():
    rig = make_rig(np.random.default_rng(14))
    left_low = Terrain(
        maths.Y,
        triangles=np.array(
            [
                [[0.0, -0.1, -9.0], [9.0, -0.1, 0.0], [0.0, -0.1, 9.0]],
                [[0.0, 0.0, -9.0], [-9.0, 0.0, 0.0], [0.0, 0.0, 9.0]],
            ]
        ),
    )
    parameters = Parameters(NO_LEAN)
    _, output = step(parameters, rig, left_low, None, make_frame(rig, standing()))
    assert output["pelvis_height"] == pytest.approx(-0.1, abs=EXACT)
    assert np.allclose(output["body_pos"], [0.0, -0.1, 0.0], atol=EXACT)
    for hz in (30, 60, 120):
        frames = [make_frame(rig, standing((0.2, 0.2)), dt=1 / hz)]
        frames += [make_frame(rig, standing(), dt=1 / hz)] * (hz // 10)
        output = run(parameters, rig, left_low, frames)
        expected = -0.1 * (1.0 - (1.0 - 0.225) ** 3)
        assert output["pelvis_height"][-1] == pytest.approx(expected, abs=EXACT)


def test_a_lean_rate_of_one_aligns_the_body_with_the_normal():
    rig = make_rig(np.random.default_rng(15))
    rates = {f"lean.{name}_rate": 1.0 for name in ("forward", "side")}
    for rises in ((0.3, 0.0), (0.0, 0.3)):
        _, output = step(Parameters(rates), rig, plane(*rises), None, make_frame(rig, standing()))
        normal = maths.unit(np.array([-rises[1], 1.0, -rises[0]]), maths.Y)
        assert np.allclose(maths.rotate(output["body_rot"], maths.Y), normal, atol=EXACT)


def test_ground_heights_rise_and_fall_by_their_half_lives():
    rig = make_rig(np.random.default_rng(16))
    parameters = Parameters({"target.rise_half_life": 1 / 60, "target.fall_half_life": 1 / 30})
    frame = make_frame(rig, standing())
    state, _ = step(parameters, rig, plane(0.0, 0.0), None, frame)
    _, rising = step(parameters, rig, plane(0.0, 0.0, 0.1), state, frame)
    _, falling = step(parameters, rig, plane(0.0, 0.0, -0.1), state, frame)
    assert np.allclose(rising["ground_height"], 0.05, atol=EXACT)
    assert np.allclose(falling["ground_height"], -0.1 * (1 - math.sqrt(0.5)), atol=EXACT)


def test_without_ground_the_pose_is_as_animated():
    rig = make_rig(np.random.default_rng(17))
    frames = stepping(rig, 30)
    output = run(Parameters(UNLIMITED), rig, plane(0.0, 0.0, -5.0), frames)
    assert_unchanged(output, frames)
    assert not output["locked"].any()


def test_rotating_the_world_changes_nothing_in_model_space():
    rng = np.random.default_rng(18)
    rig = make_rig(rng)
    ground = rough(rng)
    frames = stepping(rig)
    for index, frame in enumerate(frames):
        frame.slide = float(index > 20)
    changes = {"pelvis.vertical_only": False}
    plain = run(Parameters(changes), rig, ground, frames)
    turned = Transform(rng.normal(size=3), random_rot(rng))
    up = maths.rotate(turned.rot, maths.Y)
    corners = ground.triangles.reshape(-1, 3)
    moved_ground = Terrain(
        up, triangles=np.array([maths.apply(turned, c) for c in corners]).reshape(-1, 3, 3)
    )
    moved_frames = [
        dataclasses.replace(
            frame,
            world_from_model=Transform(
                maths.apply(turned, frame.world_from_model.pos),
                maths.multiply(turned.rot, frame.world_from_model.rot),
            ),
        )
        for frame in frames
    ]
    moved = run(Parameters(changes), rig, moved_ground, moved_frames)
    assert np.abs(plain["ankle_pos"] - [f.ankle.pos for f in frames]).max() > 0.02
    for name in ("hip", "knee", "ankle", "toe"):
        assert np.allclose(plain[f"{name}_pos"], moved[f"{name}_pos"], atol=EXACT)
        assert rotation_angle(plain[f"{name}_rot"], moved[f"{name}_rot"]) < 1e-8
    offsets = [maths.rotate(turned.rot, o) for o in plain["offset_ws"].reshape(-1, 3)]
    assert np.allclose(offsets, moved["offset_ws"].reshape(-1, 3), atol=EXACT)


def test_mirroring_the_world_mirrors_the_result():
    rng = np.random.default_rng(19)
    rig = make_rig(rng)
    flip, flip_rot = np.array([-1.0, 1.0, 1.0]), np.array([1.0, 1.0, -1.0, -1.0])
    mirror_rig = Rig(
        # A rotation axis is a pseudovector; the legs swap places.
        knee_axis_ls=(rig.knee_axis_ls * -flip)[::-1],
        ankle_from_foot=(rig.ankle_from_foot * flip_rot)[::-1],
        side=rig.side,
    )
    ground = rough(rng)
    mirror_ground = Terrain(maths.Y, triangles=ground.triangles * flip)
    frames = stepping(rig)

    def mirrored(transform: Transform, legs: bool = True) -> Transform:
        pos, rot = transform.pos * flip, transform.rot * flip_rot
        return Transform(pos[::-1], rot[::-1]) if legs else Transform(pos, rot)

    mirror_frames = [
        dataclasses.replace(
            frame,
            world_from_model=mirrored(frame.world_from_model, legs=False),
            hip=mirrored(frame.hip),
            knee=mirrored(frame.knee),
            ankle=mirrored(frame.ankle),
            toe=mirrored(frame.toe),
        )
        for frame in frames
    ]
    changes = {
        "lean.side_rate": 0.5,
        "probe.toe_ls": np.array([0.02, -0.07, 0.2]),
    }
    plain = run(Parameters(changes), rig, ground, frames)
    mirror = run(Parameters(changes), mirror_rig, mirror_ground, mirror_frames)
    for name in ("hip", "knee", "ankle", "toe"):
        assert np.allclose(plain[f"{name}_pos"] * flip, mirror[f"{name}_pos"][:, ::-1], atol=EXACT)
        rot = plain[f"{name}_rot"] * flip_rot
        assert rotation_angle(rot, np.ascontiguousarray(mirror[f"{name}_rot"][:, ::-1])) < 1e-8
    assert (plain["locked"] == mirror["locked"][:, ::-1]).all()


def test_half_weight_moves_legs_less_and_no_weight_moves_only_the_body():
    rig = make_rig(np.random.default_rng(20))
    moves = []
    for weight in (0.0, 0.5, 1.0):
        frame = make_frame(rig, standing())
        changes = {"leg.weight": weight, "pelvis.limit": 0.0}
        _, output = step(Parameters(changes | NO_LEAN), rig, plane(0.0, 0.0, 0.1), None, frame)
        moves.append(output["ankle_pos"][:, 1] - ANKLE)
        assert output["reached"].all() == (weight == 1.0)
    assert np.allclose(moves[0], 0.0, atol=EXACT) and np.allclose(moves[2], 0.1, atol=EXACT)
    assert (moves[1] > 0.02).all() and (moves[1] < 0.08).all()


@pytest.mark.parametrize("twist", [0.0, 0.4])
def test_only_twist_turns_the_hinge_about_the_leg(twist):
    rng = np.random.default_rng(24)
    rig = make_rig(rng)
    frame = make_frame(rig, standing((ANKLE, 0.14)), hinge_yaw=0.5)
    changes = NO_LOCK | NO_LEAN | {"leg.twist": twist, "pelvis.limit": 0.0}
    _, output = step(Parameters(changes), rig, plane(0.4, -0.5, 0.1), None, frame)
    for leg in range(2):
        leg_direction = maths.unit(output["ankle_pos"][leg] - output["hip_pos"][leg], -maths.Y)
        before = maths.rotate(frame.knee.rot[leg], rig.knee_axis_ls[leg])
        after = maths.rotate(output["knee_rot"][leg], rig.knee_axis_ls[leg])
        turned = maths.signed_angle(before, after, leg_direction)
        assert turned == pytest.approx(twist, abs=EXACT)


def test_a_leg_bent_backwards_is_bent_the_right_way():
    rig = make_rig(np.random.default_rng(25))
    frame = make_frame(rig, standing())
    rig.knee_axis_ls *= -1.0
    _, output = step(Parameters(NO_LEAN), rig, plane(0.0, 0.0), None, frame)
    assert output["reached"].all()
    assert np.allclose(output["ankle_pos"], frame.ankle.pos, atol=EXACT)
    # The knee was in front of the line from hip to ankle and is now behind it.
    assert (frame.knee.pos[:, 2] > 0.1).all() and (output["knee_pos"][:, 2] < -0.1).all()


def test_a_raised_foot_takes_only_its_height_from_the_ground():
    rig = make_rig(np.random.default_rng(26))
    frame = make_frame(rig, standing((0.2, 0.2)))
    _, output = step(Parameters(UNLIMITED), rig, plane(0.3, 0.3), None, frame)
    assert (output["contact"] == 0.0).all()
    assert rotation_angle(output["ankle_rot"], frame.ankle.rot) < EXACT
    assert rotation_angle(output["body_rot"], maths.IDENTITY) < EXACT
    assert output["pelvis_height"] == 0.0
    assert (np.abs(output["ankle_pos"] - frame.ankle.pos)[:, 1] > 0.005).all()


def test_the_body_leans_about_its_hips_and_can_sink_along_the_normal():
    rig = make_rig(np.random.default_rng(27))
    frame = make_frame(rig, standing())
    normal = maths.unit(np.array([-0.2, 1.0, -0.3]), maths.Y)
    for vertical_only, direction in ((True, maths.Y), (False, normal)):
        changes = {"pelvis.vertical_only": vertical_only, "lean.forward_rate": 0.7}
        _, output = step(Parameters(changes), rig, plane(0.3, 0.2, -0.1), None, frame)
        assert output["pelvis_height"] < -0.05
        assert rotation_angle(output["body_rot"], maths.IDENTITY) > 0.1
        moved = np.mean(output["hip_pos"] - frame.hip.pos, axis=0)
        assert np.allclose(moved, output["pelvis_height"] * direction, atol=EXACT)


def test_a_lock_waits_until_the_pelvis_brings_the_leg_within_reach():
    rig = make_rig(np.random.default_rng(28))
    frames = [make_frame(rig, standing())] * 2
    output = run(Parameters(), rig, plane(0.0, 0.0, -0.1), frames)
    assert output["locked"].tolist() == [[False, False], [True, True]]


@pytest.mark.parametrize("height", [0.0, -0.1])
def test_the_release_cone_is_measured_from_the_lowered_hip(height):
    rig = make_rig(np.random.default_rng(29))
    places = [0.1 + 0.03 * i for i in range(5)]
    # The pelvis settles in the first frame, so the hip is as far from the sole as animated.
    frames = [make_frame(rig, standing(forward=place)) for place in [places[0], *places]]
    cone = math.radians(4.5)
    changes = {"lock.lock_half_life": 0.0, "lock.release_cone": cone}
    output = run(Parameters(changes), rig, plane(0.0, 0.0, height), frames)
    angles = [math.atan2(place, 0.9 - ANKLE) for place in places]
    inside = [angle - angles[0] <= cone for angle in angles]
    assert inside == [True, True, True, False, False]
    assert output["locked"][1:].T.tolist() == [inside, inside]


def test_rays_meet_a_mesh_where_they_meet_its_planes():
    rng = np.random.default_rng(21)
    up = maths.rotate(random_rot(rng), maths.Y)
    corners = rng.normal(size=(40, 3, 3))
    terrain = Terrain(up, triangles=corners)
    hits = 0
    for _ in range(120):
        origin = rng.normal(size=3) + 3.0 * up
        hit = terrain.cast(origin, 6.0)
        assert hit.normal @ up > 0.0
        # An independent method: solve for barycentric coordinates, triangle by triangle.
        distances = []
        for a, b, c in corners:
            u, v, t = np.linalg.solve(np.stack([b - a, c - a, up], axis=-1), origin - a)
            if min(u, v, 1.0 - u - v) >= 0.0 and 0.0 <= t <= 6.0:
                distances.append(t)
        assert hit.found == bool(distances)
        if distances:
            hits += 1
            assert np.allclose(hit.point, origin - up * min(distances), atol=1e-8)
    assert hits > 40


def test_rays_through_corners_and_edges_of_a_closed_surface_never_fall_through():
    rng = np.random.default_rng(22)
    terrain = rough(rng)
    corners = terrain.triangles.reshape(-1, 3)
    inner = corners[np.abs(corners[:, [0, 2]]).max(axis=-1) < 2.9]
    edges = 0.5 * (terrain.triangles[:, 0] + terrain.triangles[:, 1])
    for point in np.concatenate([inner[::7], edges[::5]]):
        hit = terrain.cast(point + maths.Y, 2.0)
        assert hit.found and np.allclose(hit.point, point, atol=EXACT)


def test_an_unknown_parameter_is_an_error_that_names_it():
    with pytest.raises(ValueError, match="lock.speed"):
        Parameters({"lock.speed": 1.0})
