"""The preset `stride` on captured people: real uneven ground, and flat floors."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import jaxik
from fitting.datasets import clip_frames, flat_animation
from fitting.datasets.clips import Clip, load_clip
from fitting.datasets.clips.edit import resample
from fitting.datasets.terrain import mesh_files
from fitting.studies import comparison
from jaxik.world import terrain

pytestmark = pytest.mark.slow

FLAT = ("cmu_asfamc/01_01.amc", "cmu_asfamc/02_01.amc", "cmu_asfamc/02_03.amc",
        "cmu_bvh_mb/cmu_12_01_walk.bvh", "cmu_bvh_max/131_01.bvh")  # fmt: skip
BALL_HEIGHT = 0.055  # m, of the ball joint over the floor
BOUNDS = {  # what the benchmark asks for, cm, degrees and percent
    "pelvis_height_cm": 2.4,
    "ankle_cm": 3.0,
    "knee_cm": 3.8,
    "knee_angle_deg": 9.5,
    "straight_percent": 1.0,
    "pop_max_cm_per_frame": 2.0,
    "bone_length_error_max_mm": 1e-3,
}
FRAMES = 400
CALIBRATION = 1.26  # cm, what the terrain itself is off under the stances of 03_03


@pytest.fixture(scope="module")
def scoring(mocap: Path) -> ModuleType:
    """The benchmark's own program."""
    spec = importlib.util.spec_from_file_location("score", mocap / "blocks" / "score.py")
    assert spec is not None and spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


def solved(clip: Clip, ground: terrain.Terrain) -> Clip:
    return comparison.solve(
        jaxik.presets.stride(), clip, ground, clip_frames.frames_from_clip(clip), 0.0
    )[1]


def test_the_preset_meets_the_benchmark_on_the_clip_that_it_was_found_on(mocap, scoring):
    path = mocap / "blocks" / "03_03.npz"
    after = solved(
        flat_animation.load_flat_animation(path),
        mesh_files.load_terrain(mocap / "blocks" / "terrain.ply"),
    )
    clip = dict(np.load(path))
    score = scoring.score(clip, clip_frames.positions_by_role(after))
    assert not {name: score[name] for name, most in BOUNDS.items() if score[name] > most}
    assert score["ankle_stance_cm"] <= CALIBRATION + 0.5
    # The base itself slides as captured: foot IK adds less than a tenth of a millimetre a frame.
    assert score["added_slip_stance_mm_per_frame"] < 0.1


def flat_floor(clip: Clip) -> np.ndarray:
    """The plane, y = a x + b z + c, through the soles of standing feet: least absolute distance."""
    balls = clip.joints_ws(3)[clip.stance_labels()]
    known = np.column_stack([balls[:, [0, 2]], np.ones(len(balls))])
    weight = np.ones(len(balls))
    for _ in range(20):
        plane = np.linalg.lstsq(known * weight[:, None], balls[:, 1] * weight, rcond=None)[0]
        weight = 1.0 / np.sqrt(np.maximum(np.abs(known @ plane - balls[:, 1]), 0.003))
    return plane - [0.0, 0.0, BALL_HEIGHT]


@pytest.mark.parametrize("name", FLAT)
def test_on_the_floor_for_which_it_was_animated_no_foot_moves(mocap, name):
    clip = load_clip(mocap / "clips" / name)
    plane = flat_floor(clip)
    level = flat_animation.flatten_clip(
        clip, lambda points: points[:, [0, 2]] @ plane[:2] + plane[2]
    )
    level = resample(level, (FRAMES - 1) / level.seconds)  # one shape compiles once
    after = solved(level, terrain.plane())
    for joint in (1, 2, 3):
        np.testing.assert_allclose(after.joints_ws(joint), level.joints_ws(joint), atol=1e-9)
    np.testing.assert_allclose(
        after.positions_ws[:, after.rig.pelvis], level.positions_ws[:, level.rig.pelvis], atol=1e-9
    )


def test_a_floor_that_is_tilted_as_captured_moves_no_stance_by_more_than_its_own_tilt(mocap):
    """02_01 walks on a floor that the capture tilted: the base is level, the terrain is not."""
    clip = load_clip(mocap / "clips" / "cmu_asfamc" / "02_01.amc")
    plane = flat_floor(clip)
    level = flat_animation.flatten_clip(
        clip, lambda points: points[:, [0, 2]] @ plane[:2] + plane[2]
    )
    tilted = terrain.plane((0.0, float(plane[2]), 0.0), (-plane[0], 1.0, -plane[1]))
    after = solved(level, tilted)
    balls, stance = level.joints_ws(3), level.stance_labels()
    wanted = balls[..., [0, 2]] @ plane[:2] + plane[2]
    risen = after.joints_ws(2)[..., 1] - level.joints_ws(2)[..., 1]
    assert np.abs(risen - wanted)[stance].max() < 0.005
