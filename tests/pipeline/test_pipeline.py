"""The systems that exist elsewhere against their independent NumPy references.

All cases have three legs, so that those of a system share one program.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from jaxik.maths import parameter_tree
from jaxik.maths.parameter_tree import slots
from jaxik.stages.pelvis import ReachPelvis
from reference import maths, sample_poses
from reference.characters import Frame, Parameters
from reference.systems import mec, ozz, record, unreal
from reference.terrain import LegTerrains, Terrain
from support import clips
from support.agreement import assert_agreement
from support.cases import QUICK
from support.clips import ODD, at, named, to_ik

LEGS, HZ, FRAMES = 3, 12, 120
STANDS = (0.05, 0.2, 0.3, 0.45, 0.6, 0.7, 0.8, 0.95)  # start, end, ..., fractions of the clip
REFERENCES: dict[str, Any] = {"record": record, "ozz": ozz, "unreal": unreal, "mec": mec}
CASES: dict[str, dict[str, dict[str, Any]]] = {
    "record as it comes": {"as it is": {}},
    "record": {
        "adult": {},
        "odd": ODD | {"pelvis.limit": 0.3},
        "one ray": {"probe.use_toe": False},
        "unlocked": ODD | {"lock.enabled": False, "probe.use_toe": False},
    },
    "ozz": {
        "as it is": {},
        "as the original": {"root.half_life": 0.0},
        "only its pelvis": {"root.enabled": False, "leg.enabled": False},
        "only its legs": {"pelvis.enabled": False, "foot.enabled": False},
        "odd": named("root", ray_up=0.02, half_life=0.06, max_speed=0.5, max_step=0.05)
        | named("probe", ray_up=0.3, ray_down=0.08)
        | named("target", foot_height=0.09, max_slope=0.05)
        | named("leg", soften=0.9, twist=0.2, weight=0.8)
        | named("foot", offset=[0.02, 0.03, -0.04], twist=-0.3, weight=0.7),
    },
    "unreal": {
        "as it is": {},
        "without the latch": {"effector.latch": False},
        "odd": named("probe", ray_up=0.7, ray_down=0.01)
        | {"contact.idle_speed": 0.1, "target.adjust": 0.02, "leg.weight": 0.9}
        | named("pelvis", speed=3.0, half_height=0.8)
        | named("effector", speed=9.0, latch_distance=0.003),
        "without its pelvis": {"pelvis.enabled": False, "contact.idle_speed": np.inf},
    },
    "mec": {
        "as it is": {},
        "never planted": {"lock.plant": False, "probe.by_speed": False},
        "stretched": {"pelvis.enabled": False, "leg.max_stretch": 1.03, "leg.soften": 0.9},
        "odd": named("probe", ray_up=0.3, foot_length=0.16, half_width=0.06, stable_height=0.13)
        | named("probe", extra_min=0.01, extra_max=0.06)
        | {"target.foot_height": 0.085, "lock.plant_weight": 0.6, "foot.max_tilt": 0.1}
        | named("pelvis", min_length=0.86, max_length=0.89, speed=4.0)
        | {"effector.transition_time": 0.11}
        | named("leg", hint_offset=[0.1, -0.05, 0.2], soften=0.95, twist=-0.1, weight=0.9),
        "one idle foot, fixed rays, undamped": {"pelvis.damp": False}
        | named("probe", active=[True, False, True], by_height=False, by_speed=False, extra=0.02)
        | {"effector.transition_time": 0.0},
    },
    "mec as it comes": {"slow and low feet": {}},
}
# A turn of the world, up too, and a shift, m.
MOVE = maths.Transform(
    np.array([1.7, -2.2, 0.4]), sample_poses.random_rot(np.random.default_rng(14))
)
TILTS = [maths.from_axis_angle(axis, 0.25) for axis in (maths.X, -maths.Z, maths.Z)]
compiled = jax.jit(jaxik.run, compiler_options=QUICK)


def outputs_of(preset: str, result: jaxik.Result, expected: dict[str, Any]) -> dict[str, Any]:
    """Our outputs by the names of the reference, those of single systems included."""
    sensed, advanced = result.trace.sensed, result.trace.advanced
    after = advanced.state
    legs = expected["reached"].shape[1]
    target_ws = advanced.effector.target_ws[:, :legs]
    if "weight" in expected:  # legs that are not solved have no target
        solved = (expected["weight"] > 0)[..., None]
        target_ws = np.where(solved, target_ws, expected["target_ws"])
    outputs = {"target_ws": target_ws, "reached": result.reached}
    shared = {
        "found": sensed.foothold.found,
        "weight": advanced.effector.weight,
        "body_offset_ws": sensed.root_ws + after.pelvis.offset_ws,
        "pelvis_height": after.pelvis.height,
    }
    match preset:
        case "record":
            lift = sensed.contact.lift[..., None] * sensed.up_ws[:, None]
            return outputs | {
                "offset_ws": advanced.effector.target_ws - advanced.foothold_ws - lift,
                "ground_height": after.target.height,
                "pelvis_offset_ws": after.pelvis.offset_ws,
                "slide_weight": after.lean.slide,
                "slope": np.stack([after.lean.forward, after.lean.side], axis=-1),
                "locked": after.lock.locked,
                "factor": after.lock.factor,
                "contact": sensed.contact.weight,
            }
        case "ozz":
            lift = np.sum(np.asarray(sensed.root_ws) * sensed.up_ws, axis=-1)
            own = {"lift": lift, "foot_reached": result.aimed}
        case "unreal":
            own = {
                "half_height": after.pelvis.half_height,
                "effector": after.effector.height,
                "asleep": after.effector.asleep,
                "idle": sensed.contact.planted[:, 0],
            }
        case _:
            own = {
                "extra": sensed.ground.rays.below,
                "stretch": result.corrections.stretch,
                "planted": advanced.hold.locked,
                "plant_weight": after.lock.weight,
                "fade": after.effector.weight,
            }
    return outputs | shared | own


def moved(frame: Frame, by: maths.Transform) -> Frame:
    """The frame in a world that is moved as a whole."""
    root, stride = frame.world_from_model, frame.stride
    assert stride is not None
    footholds = {
        name: np.array([maths.apply(by, foot) for foot in getattr(stride, name)])
        for name in ("last_ws", "next_ws")
    }
    return dataclasses.replace(
        frame,
        world_from_model=maths.Transform(
            maths.apply(by, root.pos), maths.multiply(by.rot, root.rot)
        ),
        velocity_ws=maths.rotate(by.rot, frame.travel_ws),
        stride=dataclasses.replace(stride, **footholds),
    )


@functools.cache
def scene(stands: bool, moves: bool = False, legs: int = LEGS) -> tuple[Any, Terrain, list[Frame]]:
    """A rig, rough ground, and a clip that wanders over it and beyond, and may stand at times."""
    rng = np.random.default_rng(7)
    rig, ground = sample_poses.make_rig(rng, legs), sample_poses.rough(rng, cells=14, size=4.5)
    frames = clips.wandering(rig, rng, FRAMES, STANDS if stands else (), hz=HZ)
    if moves:
        corners = [maths.apply(MOVE, corner) for corner in ground.triangles.reshape(-1, 3)]
        ground = Terrain(maths.rotate(MOVE.rot, maths.Y), triangles=np.reshape(corners, (-1, 3, 3)))
        frames = [moved(frame, MOVE) for frame in frames]
    return rig, ground, frames


def with_numbers_a_leg(ik: Any) -> Any:
    """The system with a number a leg wherever it may have that: all cases share a program."""
    shared = {x.name: x.value for x in slots(ik) if x.per_leg and x.value.shape == x.shape}
    return parameter_tree.replace(ik, {name: [value] * LEGS for name, value in shared.items()})


def padded_leg(tree, legs: int, axis: int):
    """The tree with a padding leg: no position, no bones."""

    def widen(leaf):
        missing = legs - leaf.shape[axis]
        return jnp.pad(leaf, [(0, missing if a == axis else 0) for a in range(leaf.ndim)])

    return jax.tree.map(widen, tree)


def three_legged(rig: jaxik.Rig, frames: jaxik.Frame) -> tuple[jaxik.Rig, jaxik.Frame]:
    """A rig and its clip with one padding leg, whose weight is 1 all the same."""
    wide = padded_leg(rig, 3, axis=0)
    third = clips.to_rig(clips.make_rig(legs=3))
    wide = dataclasses.replace(wide, names=third.names, joints=third.joints, pelvis=12)
    pose = padded_leg(frames.pose, 3, axis=1)
    weight = jnp.concatenate([frames.weight, jnp.ones((len(frames.weight), 1))], axis=1)
    stride_and_speeds = {
        name: padded_leg(getattr(frames, name), 3, axis=1)
        for name in ("foot_speed", "toe_speed", "stride")
    }
    return wide, dataclasses.replace(frames, pose=pose, weight=weight, **stride_and_speeds)


def compare(name: str, values: dict[str, Any], scene: Any, ups: Any = None) -> dict[str, Any]:
    """Asserts that all outputs of a clip agree with the reference, and returns its outputs.

    Legs that the scene lacks are padding. `mec` has a terrain for each leg, with its own up.
    """
    preset, *as_it_comes = name.split(" ", 1)
    rig, ground, frames = scene
    reference = REFERENCES[preset]
    defaults = reference.DEFAULTS
    if as_it_comes:
        defaults = (defaults if preset == "record" else {}) | reference.STANDS_BY_SPEED
    arrays = {key: np.asarray(x) if isinstance(x, list) else x for key, x in values.items()}
    plain, ours = ground, clips.to_terrain(ground)
    if name == "mec":
        feet = [Terrain(up, triangles=ground.triangles) for up in ups or [ground.up] * LEGS]
        plain = LegTerrains(ground, feet)
        ours = clips.to_leg_terrains(plain)
    expected = reference.run(Parameters(arrays, defaults), rig, plain, frames)
    character, legs = (clips.to_rig(rig), clips.to_frames(frames)), len(rig.side)
    if legs < LEGS:
        character = three_legged(*character)
    ik, (our_rig, our_frames) = with_numbers_a_leg(to_ik(values, name)), character
    result = compiled(ik, our_rig, ours, our_frames)
    result = dataclasses.replace(result, pose=at(result.pose, (slice(None), slice(legs))))
    outputs = {
        key: np.asarray(x)[tuple(map(slice, expected[key].shape))]
        for key, x in outputs_of(preset, result, expected).items()
    }
    if not values.get("leg.enabled", True):
        del outputs["weight"]  # the reference reports legs only, ours also feet
    assert_agreement(result, expected, outputs)
    hits = np.asarray(result.trace.sensed.foothold.found)
    assert 0.1 < hits.mean() < 0.98, "the clip has both hits and misses"
    return expected


@pytest.mark.parametrize("name", REFERENCES)
def test_the_defaults_are_those_of_the_reference(name):
    ik, expected = to_ik({}, name), REFERENCES[name].DEFAULTS
    for key in set(expected) - {"probe.forward"}:  # ours takes it from the rig's foot axes
        stage, _, leaf = key.partition(".")
        actual = np.asarray(getattr(getattr(ik, stage), leaf))
        np.testing.assert_allclose(actual, expected[key], rtol=1e-6, err_msg=key)


# Programs of their own for rules of contacts; `stride` has the better part of them.
AT_LENGTH = ("mec as it comes", "record as it comes")
NAMES = [
    pytest.param(name, how, marks=pytest.mark.slow if name in AT_LENGTH else ())
    for name, each in CASES.items()
    for how in each
]


@pytest.mark.parametrize("name, how", NAMES)
def test_a_clip_agrees_with_the_reference(name, how):
    """The odd ones in a world that is turned, up too, so that the answer turns with it."""
    values = CASES[name][how]
    expected = compare(name, values, scene(not name.startswith("record"), moves=how == "odd"))
    if name.startswith("record") and values.get("lock.enabled", True):
        assert 0.1 < expected["locked"].mean() < 0.9
    if values.get("leg.max_stretch"):
        assert 0.01 < (expected["stretch"] > 1.001).mean() < 0.5
    if name == "unreal" and not values:
        switches = np.abs(np.diff(expected["asleep"].astype(int)))
        assert switches.sum() >= 6, "the latch sleeps and wakes"


@pytest.mark.parametrize("name", REFERENCES)
def test_a_leg_that_only_pads_a_batch_changes_nothing(name):
    compare(name, CASES[name]["odd"], scene(name != "record", legs=2))


@pytest.mark.parametrize("values", [{}, {"pelvis.enabled": False, "lock.plant_weight": 0.5}])
def test_feet_with_different_ups_agree_with_the_reference(values):
    ups = [maths.rotate(tilt, maths.Y) for tilt in TILTS]
    compare("mec", values, scene(stands=True), ups)


def test_a_pelvis_that_heeds_landings_serves_probes_that_foresee_none():
    rig = clips.make_rig()
    frames = clips.to_frames(clips.wandering(rig, np.random.default_rng(0), 20))
    ik = dataclasses.replace(jaxik.presets.record(), pelvis=ReachPelvis())
    run = jax.jit(jaxik.run, compiler_options=QUICK)
    result = run(ik, clips.to_rig(rig), clips.to_terrain(clips.BROKEN), frames)
    assert np.abs(result.body.pos[:, 1]).max() > 0.01
    np.testing.assert_array_equal(result.trace.advanced.state.pelvis.approach.fraction, 0.0)
