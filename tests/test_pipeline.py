"""The record pipeline against its independent NumPy reference, and what every pipeline must keep."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference import maths, poses
from reference import record as reference

import jaxik
from jaxik import rule, terrain

POSITION = 1e-5  # m
ANGLE = 1e-4  # rad
FRAMES = 600


def to_transform(t) -> jaxik.Transform:
    return jaxik.Transform(jnp.asarray(t.pos), jnp.asarray(t.rot))


def to_rig(rig) -> jaxik.Rig:
    legs = len(rig.side)
    ones = jnp.ones(legs)
    return jaxik.Rig(
        knee_axis_ls=jnp.asarray(rig.knee_axis_ls),
        ankle_from_foot=jnp.asarray(rig.ankle_from_foot),
        thigh=ones * poses.THIGH,
        shin=ones * poses.SHIN,
        foot=ones * 0.15,
        side=jnp.asarray(rig.side, float),
        present=jnp.ones(legs, bool),
        names=tuple(f"leg {leg}" for leg in range(legs)),
        joints=tuple((4 * leg, 4 * leg + 1, 4 * leg + 2, 4 * leg + 3) for leg in range(legs)),
        pelvis=4 * legs,
    )


def to_frames(frames) -> jaxik.Frame:
    def one(f) -> jaxik.Frame:
        return jaxik.Frame(
            world_from_model=to_transform(f.world_from_model),
            pose=jaxik.LegPose(*(to_transform(t) for t in (f.hip, f.knee, f.ankle, f.toe))),
            weight=jnp.asarray(f.weight),
            slide=jnp.asarray(float(f.slide)),
            speed=jnp.zeros(()),
            dt=jnp.asarray(f.dt),
            platform=to_transform(f.platform),
        )

    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *[one(f) for f in frames])


def to_ik(values: dict) -> jaxik.FootIK:
    return rule.replace(jaxik.presets.record(), values)


def to_terrain(ground) -> terrain.Terrain:
    surfaces = [terrain.plane(point, normal, up=ground.up) for point, normal in ground.planes]
    if len(ground.triangles):
        vertices = np.asarray(ground.triangles).reshape(-1, 3)
        triangles = np.arange(len(vertices)).reshape(-1, 3)
        surfaces.append(terrain.mesh(vertices, triangles, up=ground.up))
    return terrain.combine(*surfaces)


def wandering(rig, rng, count: int = FRAMES) -> list:
    """A clip that meets everything: steps, drifting feet, slides, half-weighted legs, odd frame times,
    a turning root, swinging hips, and ground that is missing under part of the way."""
    legs = len(rig.side)
    frames = []
    heading, place, phase = 0.3, np.array([-2.2, 0.0, -2.4]), 0.0
    for index in range(count):
        dt = 1 / 60 if index % 97 else 1 / 30
        phase += dt / 1.05
        heading += 0.25 * dt * np.sin(phase)
        turned = maths.turn(maths.Y, heading)
        place = place + dt * 0.6 * np.array([np.sin(heading), 0.0, np.cos(heading)])
        ankles = []
        for leg in range(legs):
            cycle = (phase + leg / legs) % 1.0
            swing = np.sin(np.pi * np.clip((cycle - 0.55) / 0.4, 0.0, 1.0))
            x = 0.1 * rig.side[leg] + 0.01 * np.sin(3.1 * phase)
            ankles.append([x, 0.08 + 0.12 * swing, 0.18 * np.cos(2 * np.pi * cycle)])
        weight = np.ones(legs)
        if 400 < index < 440:
            weight[0] = 0.5
        if 460 < index < 470:
            weight[-1] = 0.0
        frame = poses.make_frame(
            rig,
            np.array(ankles),
            hip_height=0.86 + 0.02 * np.sin(4 * np.pi * phase),
            hinge_yaw=0.2 * np.sin(phase),
            world_from_model=reference.Transform(place.copy(), turned),
            weight=weight,
            slide=float(180 < index < 300),
            dt=dt,
        )
        axis = rng.normal(size=3)
        tilt = maths.turn(axis / np.linalg.norm(axis), rng.uniform(0.0, 0.2))
        rot = np.array([maths.multiply(tilt, r) for r in frame.ankle.rot])
        frames.append(dataclasses.replace(frame, ankle=frame.ankle._replace(rot=rot)))
    return frames


ADULT: dict = {}
ODD = {  # every parameter away from its default
    "contact.ground_height": 0.01,
    "contact.planted_height": 0.095,
    "contact.raised_height": 0.15,
    "probe.ray_up": 0.4,
    "probe.ray_down": 0.42,
    "probe.toe_ls": [0.02, -0.05, 0.18],
    "target.min_ankle_height": 0.05,
    "target.max_ankle_height": 0.24,
    "target.foot_height": 0.07,
    "target.max_slope": 0.3,
    "target.rise_half_life": 0.03,
    "target.fall_half_life": 0.06,
    "lean.forward_rate": 0.5,
    "lean.side_rate": -0.4,
    "lean.forward_rate_slide": -0.6,
    "lean.side_rate_slide": 0.7,
    "lean.gain": 0.3,
    "lean.gain_slide": 0.5,
    "lean.slide_on_gain": 0.3,
    "lean.slide_off_gain": 0.2,
    "lock.release_min_angle": 1.2,
    "lock.release_max_angle": 2.9,
    "lock.release_cone": 0.2,
    "lock.release_distance": 0.12,
    "lock.relock_threshold": 0.4,
    "lock.max_speed": 0.9,
    "lock.lock_half_life": 0.02,
    "lock.unlock_half_life": 0.07,
    "pelvis.limit": 0.05,
    "pelvis.on_gain": 0.3,
    "pelvis.off_gain": 0.15,
    "pelvis.vertical_only": False,
    "leg.max_knee_angle": 2.8,
    "leg.min_knee_angle": 1.6,
    "leg.soften": 0.94,
    "leg.twist": 0.1,
    "leg.weight": 0.9,
    "foot.max_pitch": 0.1,
    "foot.min_pitch": -0.15,
    "foot.max_roll": 0.08,
    "foot.min_roll": -0.1,
}


@pytest.mark.parametrize(
    ("name", "values", "legs"),
    [
        ("adult", ADULT, 2),
        ("odd", ODD, 2),
        ("one ray", ADULT | {"probe.use_toe": False}, 2),
        ("unlocked", ODD | {"lock.enabled": False, "probe.use_toe": False}, 2),
        ("three legs", ODD | {"pelvis.limit": 0.3}, 3),
    ],
)
def test_600_frames_agree_with_the_reference(name, values, legs):
    rng = np.random.default_rng(len(name))
    rig = poses.make_rig(rng, legs)
    frames = wandering(rig, rng)
    ground = poses.rough(rng, cells=14, size=4.5)
    expected = reference.run(
        reference.Parameters({k: np.asarray(v) if isinstance(v, list) else v for k, v in values.items()}),
        rig, ground, frames,
    )
    result = jaxik.run(to_ik(values), to_rig(rig), to_terrain(ground), to_frames(frames))

    found = np.asarray(result.trace.sensed.foothold.found)
    assert 0.2 < found.mean() < 0.98, "the clip meets both ground and misses"
    after = result.trace.advanced.state
    np.testing.assert_array_equal(np.asarray(after.lock.locked), expected["locked"])
    if values.get("lock.enabled", True):
        assert 0.1 < expected["locked"].mean() < 0.9
    pairs = {
        "offset_ws": result.trace.advanced.target_ws - result.trace.advanced.foothold_ws
        - result.trace.sensed.contact.lift[..., None] * result.trace.sensed.up_ws[:, None],
        "target_ws": result.trace.advanced.target_ws,
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
        assert poses.turn_angle(ours, expected[f"{joint}_rot"]) < ANGLE, joint
    assert poses.turn_angle(np.asarray(result.body.rot), expected["body_rot"]) < ANGLE
    np.testing.assert_array_equal(np.asarray(result.reached) > 0.5, expected["reached"] > 0.5)
