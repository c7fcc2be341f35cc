"""The preset `stride` on captured people, on uneven blocks and on flat floors."""

import numpy as np
import pytest

import jaxik
from fitting.datasets import clip_frames, flat_animation
from fitting.datasets.clips import Clip, load_clip
from fitting.datasets.clips.edit import resample
from fitting.datasets.terrain import mesh_files
from fitting.studies.animations import Animation
from jaxik.maths import parameter_tree
from jaxik.world import terrain
from support.benchmark import scoring_program

pytestmark = pytest.mark.slow

FLAT = ("cmu_asfamc/01_01.amc", "cmu_asfamc/02_01.amc", "cmu_asfamc/02_03.amc",
        "cmu_bvh_mb/cmu_12_01_walk.bvh", "cmu_bvh_max/131_01.bvh")  # fmt: skip
BALL_HEIGHT = 0.055  # m, of the ball joint above the floor
BOUNDS = {  # required by the benchmark
    "pelvis_height_cm": 2.4,
    "ankle_cm": 3.0,
    "knee_cm": 3.8,
    "knee_angle_deg": 9.5,
    "straight_percent": 1.0,
    "pop_max_cm_per_frame": 2.0,
    "bone_length_error_max_mm": 1e-3,
}
# Where the animation knows nothing of the ground: just above what is reached.
WALK_BOUNDS = BOUNDS | {"knee_cm": 4.05, "knee_angle_deg": 11.0, "pop_max_cm_per_frame": 3.0}
FRAMES = 400
CALIBRATION = 1.26  # cm, error of the terrain itself under the stances of 03_03


def solved(clip: Clip, ground: terrain.Terrain, as_animated: bool = False) -> Clip:
    # Both animations have the captured pelvis' way and turns, which hold what the blocks did.
    captured = {"pelvis.shift": 0.0, "lean.pelvis_rate": 0.0}
    values = captured | {"probe.swing_as_animated": as_animated}
    ik = parameter_tree.replace(jaxik.presets.stride(), values)
    return Animation(clip, ground).solve(ik)[1]


@pytest.mark.parametrize(
    ("file", "as_animated", "bounds"),
    [("03_03.npz", True, BOUNDS), ("03_03_walk.npz", False, WALK_BOUNDS)],
    ids=["swings of the capture", "swings of a flat floor"],
)
def test_the_preset_meets_the_benchmark_on_the_clip_it_was_developed_on(
    mocap, file, as_animated, bounds
):
    path = mocap / "blocks" / file
    after = solved(
        flat_animation.load_flat_animation(path),
        mesh_files.load_terrain(mocap / "blocks" / "terrain.ply"),
        as_animated,
    )
    clip = dict(np.load(path))
    score = scoring_program(mocap).score(clip, clip_frames.positions_by_role(after))
    assert not {name: score[name] for name, bound in bounds.items() if score[name] > bound}
    assert score["ankle_stance_cm"] <= CALIBRATION + 0.5
    # The flat animation slides as captured; foot IK adds less than 0.1 mm per frame.
    assert score["added_slip_stance_mm_per_frame"] < 0.1


def flat_floor(clip: Clip) -> np.ndarray:
    """The plane y = a x + b z + c nearest to the soles of standing feet, by absolute distance."""
    balls = clip.joints_ws(3)[clip.stance_labels()]
    coordinates = np.column_stack([balls[:, [0, 2]], np.ones(len(balls))])
    weight, plane = np.ones(len(balls)), np.zeros(3)
    for _ in range(20):
        plane = np.linalg.lstsq(coordinates * weight[:, None], balls[:, 1] * weight, rcond=None)[0]
        weight = 1.0 / np.sqrt(np.maximum(np.abs(coordinates @ plane - balls[:, 1]), 0.003))
    return plane - [0.0, 0.0, BALL_HEIGHT]


def levelled(clip: Clip, plane: np.ndarray) -> Clip:
    """The clip as an animation for a flat floor."""
    return flat_animation.flatten_clip(
        clip, lambda points: points[:, [0, 2]] @ plane[:2] + plane[2]
    )


@pytest.mark.parametrize("name", FLAT)
def test_no_joint_moves_on_the_floor_the_clip_was_animated_for(mocap, name):
    clip = load_clip(mocap / "clips" / name)
    level = levelled(clip, flat_floor(clip))
    # All clips share one shape, and so one program.
    level = resample(level, (FRAMES - 1) / level.seconds)
    after = solved(level, terrain.plane())
    for joint in (1, 2, 3):
        np.testing.assert_allclose(after.joints_ws(joint), level.joints_ws(joint), atol=1e-9)
    pelvis = level.rig.pelvis
    np.testing.assert_allclose(
        after.positions_ws[:, pelvis], level.positions_ws[:, pelvis], atol=1e-9
    )


def test_on_a_tilted_floor_standing_feet_rise_by_the_tilt_only(mocap):
    """The floor of 02_01 is tilted in the capture; here only the animation is levelled."""
    clip = load_clip(mocap / "clips" / "cmu_asfamc" / "02_01.amc")
    plane = flat_floor(clip)
    level = levelled(clip, plane)
    tilted = terrain.plane((0.0, float(plane[2]), 0.0), (-plane[0], 1.0, -plane[1]))
    after = solved(level, tilted)
    balls, stance = level.joints_ws(3), level.stance_labels()
    expected = balls[..., [0, 2]] @ plane[:2] + plane[2]
    rise = after.joints_ws(2)[..., 1] - level.joints_ws(2)[..., 1]
    assert np.abs(rise - expected)[stance].max() < 0.005
