"""The record pipeline against its independent NumPy reference."""

import numpy as np
import pytest

import jaxik
from reference import sample_poses
from reference.systems import record as reference
from support.clips import ODD, to_frames, to_ik, to_rig, to_terrain, wandering

POSITION = 1e-5  # m
ANGLE = 1e-4  # rad
FRAMES = 600
ADULT: dict = {}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "values", "legs"),
    [
        ("as it comes", ADULT, 2),
        ("adult", ADULT, 2),
        ("odd", ODD, 2),
        ("one ray", ADULT | {"probe.use_toe": False}, 2),
        ("unlocked", ODD | {"lock.enabled": False, "probe.use_toe": False}, 2),
        ("three legs", ODD | {"pelvis.limit": 0.3}, 3),
    ],
)
def test_600_frames_agree_with_the_reference(name, values, legs):
    rng = np.random.default_rng(len(name))
    rig = sample_poses.make_rig(rng, legs)
    frames = wandering(rig, rng, FRAMES)
    ground = sample_poses.rough(rng, cells=14, size=4.5)
    changes = {k: np.asarray(v) if isinstance(v, list) else v for k, v in values.items()}
    preset = "record as it comes" if name == "as it comes" else "record"
    defaults = reference.DEFAULTS
    if name == "as it comes":
        defaults = defaults | reference.STANDS_BY_SPEED
    expected = reference.run(
        reference.Parameters(changes, defaults),
        rig,
        ground,
        frames,
    )
    result = jaxik.run(to_ik(values, preset), to_rig(rig), to_terrain(ground), to_frames(frames))

    hits = np.asarray(result.trace.sensed.foothold.found)
    assert 0.2 < hits.mean() < 0.98, "the clip has both hits and misses"
    after = result.trace.advanced.state
    np.testing.assert_array_equal(np.asarray(after.lock.locked), expected["locked"])
    if values.get("lock.enabled", True):
        assert 0.1 < expected["locked"].mean() < 0.9
    pairs = {
        "offset_ws": result.trace.advanced.effector.target_ws
        - result.trace.advanced.foothold_ws
        - result.trace.sensed.contact.lift[..., None] * result.trace.sensed.up_ws[:, None],
        "target_ws": result.trace.advanced.effector.target_ws,
        "ground_height": after.target.height,
        "pelvis_offset_ws": after.pelvis.offset_ws,
        "slide_weight": after.lean.slide,
        "factor": after.lock.factor,
        "contact": result.trace.sensed.contact.weight,
        "body_pos": result.body.pos,
        "hip_pos": result.pose.hip.pos,
        "knee_pos": result.pose.knee.pos,
        "ankle_pos": result.pose.ankle.pos,
        "toe_pos": result.pose.toe.pos,
    }
    for key, ours in pairs.items():
        np.testing.assert_allclose(np.asarray(ours), expected[key], atol=POSITION, err_msg=key)
    slope = np.stack([after.lean.forward, after.lean.side], -1)
    np.testing.assert_allclose(slope, expected["slope"], atol=ANGLE)
    for joint in ("hip", "knee", "ankle", "toe"):
        ours = np.asarray(getattr(result.pose, joint).rot)
        assert sample_poses.rotation_angle(ours, expected[f"{joint}_rot"]) < ANGLE, joint
    assert sample_poses.rotation_angle(np.asarray(result.body.rot), expected["body_rot"]) < ANGLE
    np.testing.assert_array_equal(np.asarray(result.reached) > 0.5, expected["reached"] > 0.5)
