"""Synthetic quadruped and climber: still feet, constant bone lengths, plausible speeds."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from fitting.datasets import clip_frames
from fitting.datasets.clips import contacts, load_clip, save_clip
from fitting.datasets.clips.kinematics import local_from_world
from fitting.datasets.synthetic import multi_limb, terrain_meshes
from fitting.datasets.terrain import mesh_files

EXACT = 1e-9  # m
WALL = (
    terrain_meshes.WALL_FROM_FLOOR.as_matrix()
)  # columns: a floor's left, up and ahead, on the wall
BODIES = {"quadruped": multi_limb.QUADRUPED, "climber": multi_limb.CLIMBER}


@pytest.fixture(scope="module", params=["quadruped", "climber"])
def name(request):
    return request.param


@pytest.fixture(scope="module")
def clip(name):
    if name == "climber":
        return multi_limb.climb(6.0, 60.0, 1)
    return multi_limb.locomotion(multi_limb.QUADRUPED, 5.0, 60.0, 1)


@pytest.fixture(scope="module")
def on_floor(name, clip):
    """Joint positions, m, over a floor with y up and z ahead; the climber's wall is laid down."""
    return clip.positions_ws @ WALL if name == "climber" else clip.positions_ws


def test_the_ball_of_a_standing_foot_lies_on_the_ground_and_does_not_move(name, clip, on_floor):
    for leg, (_, _, ankle, toe) in enumerate(clip.rig.joints):
        stances = contacts.runs(clip.stance[:, leg])
        assert len(stances) >= 2
        for first, last in stances:
            for joint, height in (
                (toe, BODIES[name].ball_height),
                (ankle, BODIES[name].ball_height + BODIES[name].ankle_to_ball[0]),
            ):
                positions = on_floor[first : last + 1, joint]
                assert np.ptp(positions, axis=0).max() < EXACT
                np.testing.assert_allclose(positions[:, 1], height, rtol=0, atol=EXACT)


def test_feet_stay_above_the_ground_and_knees_well_above_it(name, clip, on_floor):
    for _, knee, ankle, toe in clip.rig.joints:
        assert on_floor[:, toe, 1].min() > BODIES[name].ball_height - EXACT
        assert on_floor[:, [knee, ankle], 1].min() > 0.06


def test_bones_keep_their_lengths_and_limbs_are_rigid_on_the_trunk(name, clip):
    for limb, joints in zip(BODIES[name].limbs, clip.rig.joints, strict=True):
        positions = [clip.positions_ws[:, joint] for joint in joints]
        expected = (*limb.bones, np.hypot(*BODIES[name].ankle_to_ball))
        for a, b, length in zip(positions, positions[1:], expected, strict=False):
            distance = np.linalg.norm(b - a, axis=-1)
            np.testing.assert_allclose(distance, length, rtol=0, atol=EXACT)
    positions_ls, _ = local_from_world(clip.parents, clip.positions_ws, clip.rotations_ws)
    assert np.ptp(positions_ls[:, 1:], axis=0).max() < EXACT


def test_limbs_have_their_names_sides_flat_feet_and_flexing_hinges(name, clip):
    rig = clip.rig
    assert rig.names == tuple(limb.name for limb in BODIES[name].limbs)
    np.testing.assert_array_equal(rig.side, [1.0, -1.0, 1.0, -1.0])
    np.testing.assert_allclose(rig.knee_axis_ls, [[-1.0, 0.0, 0.0]] * 4, rtol=0, atol=1e-3)
    np.testing.assert_allclose(rig.ankle_from_foot, [[1.0, 0.0, 0.0, 0.0]] * 4, rtol=0, atol=0.03)


def test_limbs_stay_bent_towards_their_pole(name, clip, on_floor):
    for limb, (hip, knee, ankle, _) in zip(BODIES[name].limbs, clip.rig.joints, strict=True):
        a, b, c = (on_floor[:, joint] for joint in (hip, knee, ankle))
        stretch = np.linalg.norm(c - a, axis=-1) / sum(limb.bones)
        assert 0.3 < stretch.min() and stretch.max() < 0.96
        along = (c - a) / np.linalg.norm(c - a, axis=-1, keepdims=True)
        out = b - a - along * np.sum((b - a) * along, axis=-1, keepdims=True)
        assert (out @ np.array(limb.pole)).min() > 0.0


def test_the_quadruped_walks_in_lateral_sequence_on_two_feet_or_more():
    clip = multi_limb.locomotion(multi_limb.QUADRUPED, 5.0, 60.0, 1)
    assert clip.stance is not None
    landings = {
        name: [first for first, _ in contacts.runs(clip.stance[:, leg]) if first > 0]
        for leg, name in enumerate(clip.rig.names)
    }
    order = sorted((frame, name) for name, frames in landings.items() for frame in frames)
    names = [name for _, name in order]
    start = names.index("hind_left")
    expected = ["hind_left", "fore_left", "hind_right", "fore_right"] * 5
    assert names[start : start + 12] == expected[:12]
    assert clip.stance.sum(axis=1).min() >= 2
    speed = np.linalg.norm(np.diff(clip.positions_ws[:, 0], axis=0), axis=-1) * 60.0
    assert 0.8 < speed.min() and speed.max() < 1.3
    assert np.linalg.norm(np.diff(clip.positions_ws, axis=0), axis=-1).max() * 60.0 < 5.5


def test_the_climber_moves_one_limb_at_a_time_and_goes_straight_up_the_wall():
    clip = multi_limb.climb(6.0, 60.0, 1)
    assert clip.stance is not None
    assert clip.stance.sum(axis=1).min() == 3
    moved = clip.positions_ws[-1, 0] - clip.positions_ws[0, 0]
    np.testing.assert_allclose(moved[[0, 2]], 0.0, rtol=0, atol=EXACT)
    assert 0.5 < moved[1] < 1.2
    assert clip.positions_ws[..., 2].max() < 0.0  # in front of the wall z = 0
    assert np.linalg.norm(np.diff(clip.positions_ws, axis=0), axis=-1).max() * 60.0 < 2.0


def test_on_a_wall_the_root_lies_on_it_with_the_normal_as_its_up():
    clip = multi_limb.climb(2.0, 30.0)
    frames = clip_frames.frames_from_clip(clip, up_ws=terrain_meshes.WALL_UP)
    root = frames.world_from_model
    trunk = clip.positions_ws[:, 0]
    np.testing.assert_allclose(root.pos, trunk * [1.0, 1.0, 0.0], rtol=0, atol=1e-12)
    for axis, expected in ((0, (1, 0, 0)), (1, terrain_meshes.WALL_UP), (2, (0, 1, 0))):
        ends = root.apply(jnp.eye(3)[axis]) - root.pos
        np.testing.assert_allclose(ends, np.tile(expected, (60, 1)), rtol=0, atol=1e-12)
    speed = multi_limb.CLIMBER.stride / multi_limb.CLIMBER.period
    np.testing.assert_allclose(frames.speed, speed, rtol=1e-9)


def test_a_seed_gives_the_same_steps_and_a_route_may_start_elsewhere():
    first, same, other = (
        multi_limb.locomotion(multi_limb.QUADRUPED, 2.0, 30.0, s) for s in (4, 4, 5)
    )
    np.testing.assert_array_equal(first.positions_ws, same.positions_ws)
    assert np.abs(first.positions_ws - other.positions_ws).max() > 0.005
    ahead = multi_limb.locomotion(multi_limb.QUADRUPED, 2.0, 30.0, 4, multi_limb.Route(start=3.0))
    assert ahead.positions_ws[0, 0, 2] == pytest.approx(3.0)


def test_a_clip_with_four_legs_is_loaded_as_it_was_saved(tmp_path, clip):
    save_clip(tmp_path / "clip.npz", clip)
    loaded = load_clip(tmp_path / "clip.npz")
    np.testing.assert_array_equal(loaded.positions_ws, clip.positions_ws)
    assert loaded.rig.names == clip.rig.names and loaded.rig.joints == clip.rig.joints


@pytest.mark.slow
@pytest.mark.parametrize(("body", "mesh"), [("quadruped", "meadow"), ("climber", "wall")])
def test_foot_ik_moves_four_limbs_over_their_terrain(tmp_path, body, mesh):
    up = terrain_meshes.WALL_UP if body == "climber" else (0.0, 1.0, 0.0)
    clips = {
        "quadruped": multi_limb.locomotion(multi_limb.QUADRUPED, 1.0),
        "climber": multi_limb.climb(1.0),
    }
    clip = clips[body]
    mesh_files.save_mesh(tmp_path / "ground.ply", *getattr(terrain_meshes, mesh)())
    ground = mesh_files.load_terrain(tmp_path / "ground.ply", up=up)
    frames = clip_frames.frames_from_clip(clip, up_ws=up)
    result = jaxik.run(jaxik.presets.record(), clip.rig, ground, frames)
    assert np.asarray(result.trace.sensed.ground.ankle.found).min() == 1.0
    assert np.asarray(result.reached).mean() > 0.95
    solved = clip_frames.clip_from_result(clip, result, up_ws=up)
    assert np.isfinite(solved.positions_ws).all()
    raised = (solved.positions_ws - clip.positions_ws) @ np.array(up)
    assert 0.01 < np.abs(raised).max() < 0.25


@pytest.mark.parametrize(
    "body, seconds, message",
    [
        (multi_limb.QUADRUPED, 0.0, "above 0, got 0.0 s"),
        (
            replace(multi_limb.QUADRUPED, stride=3.0),
            2.0,
            "fore_left limb of the quadruped does not",
        ),
    ],
)
def test_impossible_locomotion_is_refused(body, seconds, message):
    with pytest.raises(ValueError, match=message):
        multi_limb.locomotion(body, seconds)
