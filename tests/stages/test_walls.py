"""Hands on walls: a limb whose ground is a wall is planted there, and leaves the body alone."""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from jaxik.world import terrain
from jaxik.world.frame import bearing
from reference import maths, sample_poses
from reference.characters import JOINTS
from reference.maths import Transform
from support.cases import QUICK, stacked
from support.clips import make_rig, to_frames, to_rig

PRESETS = ["record", "ozz", "unreal", "mec", "stride"]
WALKS = 0.6  # m/s
HAND = 1  # number of this limb
SHOULDER, HEIGHT, AHEAD = 1.45, 1.2, 0.45  # m, of the hand over the floor, and ahead of the body
SOLE = 0.085  # m, from the palm to the wrist, and from the sole to the ankle
PALM = maths.from_axis_angle(maths.X, -np.pi / 2)  # of a hand on a wall ahead, fingers up


class Scene(NamedTuple):
    """A wall ahead of a body that stands on a floor."""

    short: float = 0.0
    """m, from the animated palm to the wall."""
    turn: float = 0.0
    """rad, of the wall, to the left."""
    lean: float = 0.0
    """rad, of the wall, away from the body."""
    floor: float = 0.0
    """m, how much higher it is than in the animation."""
    scale: float = 1.0
    """Of the strides of a body that walks; one with a scale of 1 stands."""


STANDS = [
    Scene(),
    Scene(short=0.2),
    Scene(short=-0.1),
    Scene(short=0.1, turn=0.4),
    Scene(short=0.1, lean=0.25),
    Scene(short=0.1, floor=-0.1),
]
SCENES = [*STANDS, Scene(scale=1.3)]


def limbs() -> tuple[jaxik.Rig, jaxik.Frame]:
    """A foot that stands and a hand that reaches ahead."""
    rig = make_rig()
    wrist = np.array([0.1, HEIGHT, AHEAD])
    leg = sample_poses.make_frame(rig, sample_poses.standing((SOLE, SOLE)), hip_height=0.86)
    arm = sample_poses.make_frame(rig, np.array([wrist, wrist]), hip_height=SHOULDER)
    palm = maths.multiply(PALM, maths.inverse(rig.ankle_from_foot[HAND]))
    knuckles = wrist + maths.rotate(PALM, np.array([0.0, 0.02 - SOLE, 0.1]))
    hand = {
        "hip": Transform(*(part[HAND] for part in arm.hip)),
        "knee": Transform(*(part[HAND] for part in arm.knee)),
        "ankle": Transform(wrist, palm),
        "toe": Transform(knuckles, palm),
    }
    joints = {
        name: Transform(
            *(np.stack([x[0], y]) for x, y in zip(getattr(leg, name), hand[name], strict=True))
        )
        for name in JOINTS
    }
    return to_rig(rig), jax.tree.map(
        lambda leaf: leaf[0], to_frames([dataclasses.replace(leg, **joints)])
    )


def wall(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """A point of it, m, and its normal, towards the body."""
    turn = maths.from_axis_angle(maths.Y, scene.turn)
    turn = maths.multiply(turn, maths.from_axis_angle(maths.X, scene.lean))
    normal = maths.rotate(turn, -maths.Z)
    palm = np.array([0.1, HEIGHT, AHEAD + SOLE])
    return palm - scene.short * normal, normal


def ground(scene: Scene) -> terrain.LegTerrains:
    """The floor, and for the hand the wall, with its normal as up."""
    floor = terrain.plane((0.0, scene.floor, 0.0))
    point, normal = wall(scene)
    return terrain.LegTerrains(floor, (floor, terrain.plane(point, normal, up=normal)))


def in_scene(frame: jaxik.Frame, scene: Scene, weight: float) -> jaxik.Frame:
    """The frame with this weight of the hand."""
    return dataclasses.replace(
        frame,
        weight=jnp.array([1.0, weight]),
        velocity_ws=jnp.array([WALKS if scene.scale > 1 else 0.0, 0.0, 0.0]),
        stride_scale=jnp.asarray(scene.scale),
    )


class Solved(NamedTuple):
    """What a preset makes of each scene, with a hand on the wall and with one without foot IK."""

    wrist_ws: Any
    """m, where the hand is to go (2, scenes, 3)."""
    weight: Any
    """0..1, how far it goes there (2, scenes)."""
    offset_ws: Any
    """m, of the body (2, scenes, 3)."""
    rot_ws: Any
    """Of the body (2, scenes, 4)."""


@functools.cache
def solve(preset: str) -> Solved:
    rig, frame = limbs()
    ik = getattr(jaxik.presets, preset)(rig)
    rows = [(ground(scene), in_scene(frame, scene, x)) for x in (1.0, 0.0) for scene in SCENES]

    def first(ground: terrain.LegTerrains, frame: jaxik.Frame) -> Solved:
        state = jaxik.init(ik, rig)
        result = jaxik.step(ik, rig, ground, state, frame, trace=True, checked=True)[1]
        solved = result.trace.advanced
        effector, pelvis, lean = solved.effector, solved.state.pelvis, solved.lean
        return Solved(
            effector.target_ws[HAND], effector.weight[HAND], pelvis.offset_ws, lean.rot_ws
        )

    return jax.tree.map(
        lambda x: np.asarray(x).reshape(2, len(SCENES), *x.shape[1:]),
        jax.jit(jax.vmap(first), compiler_options=QUICK)(*stacked(rows)),
    )


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
def test_a_hand_on_a_wall_neither_sinks_nor_raises_nor_turns_the_body(preset: str):
    solved = solve(preset)
    np.testing.assert_allclose(solved.offset_ws[0], solved.offset_ws[1], atol=1e-4)
    np.testing.assert_allclose(solved.rot_ws[0], solved.rot_ws[1], atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
def test_a_hand_is_planted_on_a_wall_however_high_it_is(preset: str):
    solved = solve(preset)
    for scene, wrist, weight in zip(SCENES, solved.wrist_ws[0], solved.weight[0], strict=True):
        if scene in STANDS:
            point, normal = wall(scene)
            assert (wrist - point) @ normal == pytest.approx(SOLE, abs=2e-3), scene
            assert weight == pytest.approx(1.0), scene


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
def test_longer_strides_do_not_lift_a_hand_off_its_place(preset: str):
    assert solve(preset).wrist_ws[0, -1, 1] == pytest.approx(HEIGHT, abs=2e-3)


def test_limbs_bear_less_and_less_the_further_their_up_is_from_that_of_the_body():
    angles = np.radians(np.arange(181))
    ups = np.stack([np.sin(angles), np.cos(angles), np.zeros_like(angles)], axis=-1)
    shares = np.asarray(bearing(jnp.asarray(ups), jnp.array(maths.Y)))
    assert (shares[:46] == 1).all() and (shares[73:] == 0).all()
    steps = np.diff(shares)
    assert steps.max() <= 0 and steps.min() > -0.06
    assert bearing(jnp.array(maths.Y), jnp.array(maths.Y)) == 1
