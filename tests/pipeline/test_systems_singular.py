"""Frames where the other systems' formulas are singular: values and gradients stay finite.

Each frame is repeated for a whole clip, which includes memory and lets all share one program.
"""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from jaxik import HARD, Smooth
from reference import sample_poses
from support.cases import QUICK, RIG, Inputs, measured, posed, read
from support.clips import FLAT, FRAMES, animate, padded, planes, to_frames, to_ik, to_rig
from support.clips import to_terrain as to_ground

pytestmark = pytest.mark.slow

PRESETS = ("ozz", "unreal", "mec")
STIFF = {"pelvis.enabled": False}
STRAIGHT = ([0, 0.9, 0], [0, 0.45, 0], [0, 0.02, 0])
FOLDED = ([0, 0.5, 0], [0, 0.05, 0], [0, 0.48, 0])
# Sums and differences without rounding: on the edge of a decision it would decide, and another way
# in each program.
BENT = ([0, 0.75, 0], [0, 0.375, 0.25], [0, 0, 0])
BAREFOOT: dict[str, dict] = {  # ankles go to ground height
    "ozz": {"target.foot_height": 0.0},
    "unreal": {},
    "mec": {"target.foot_height": 0.0},
}
HIGH_RAY = STIFF | {"root.enabled": False, "probe.ray_up": 2.0}


held = functools.partial(posed, count=FRAMES)


def standing(**changes: Any) -> jaxik.Frame:
    return to_frames(padded(animate(RIG, count=1, **changes)))


def rotated_root(*rot: float) -> jaxik.Frame:
    """A character with this rotation of its root, wxyz."""
    frames = standing()
    root = frames.world_from_model
    rots = jnp.broadcast_to(jnp.asarray(rot), root.rot.shape)
    return dataclasses.replace(frames, world_from_model=jaxik.Transform(root.pos, rots))


def hint(below: float) -> dict[str, Any]:
    """The offset that puts the hint of a standing left leg that far below its hip, m."""
    hip, knee, ankle, _ = (
        np.asarray(getattr(standing().pose, joint).pos[0, 0])
        for joint in ("hip", "knee", "ankle", "toe")
    )
    toe = ankle + np.array([0.0, -sample_poses.ANKLE, 0.20])
    down = (ankle - hip) / np.linalg.norm(ankle - hip)
    return {"mec": STIFF | {"leg.hint_offset": hip + below * down - toe - (knee - ankle)}}


# Frames, ground, values for all systems, and values for single systems.
SINGULAR: dict[str, tuple[jaxik.Frame, Any, dict[str, Any], dict[str, dict[str, Any]]]] = {
    "straight": (held(*STRAIGHT), FLAT, {}, {}),
    "straight and too far": (held(*STRAIGHT), planes((0, 0, -0.3)), STIFF, {}),
    "straight and at its length": (
        held([0, 0.88, 0], [0, sample_poses.SHIN, 0], [0, 0, 0]),
        FLAT,
        STIFF,
        BAREFOOT,
    ),
    "folded": (held(*FOLDED), FLAT, {}, {}),
    "folded and too near": (held(*FOLDED), planes((0, 0, 0.02)), HIGH_RAY, BAREFOOT),
    "target on the hip": (held(*BENT), planes((0, 0, 0.75)), HIGH_RAY, BAREFOOT),
    "target above the hip": (held(*BENT), planes((0, 0, 1.25)), HIGH_RAY, BAREFOOT),
    "no bones": (held([0, 0.5, 0], [0, 0.5, 0], [0, 0.5, 0]), FLAT, {}, {}),
    "no thigh": (held([0, 0.5, 0], [0, 0.5, 0], [0, 0.1, 0]), FLAT, {}, {}),
    "no shin": (held([0, 0.5, 0], [0, 0.1, 0], [0, 0.1, 0]), FLAT, {}, {}),
    "misses": (standing(), FLAT, {"probe.layers": 0, "root.layers": 0}, {}),
    "on the surface": (held(*BENT), FLAT, {}, {}),
    "no time": (dataclasses.replace(standing(), dt=0.0 * standing().dt), FLAT, {}, {}),
    "no weight": (standing(weight=0.0), FLAT, {}, {}),
    "half weight": (standing(weight=0.5), planes((0.2, 0, 0)), {}, {}),
    "looks straight up": (
        rotated_root(0.5**0.5, -(0.5**0.5), 0.0, 0.0),
        planes((0.1, 0, 0)),
        {},
        {},
    ),
    "stands on its head": (rotated_root(0.0, 0.0, 0.0, 1.0), FLAT, {}, {}),
    "plane on edge": (standing(), planes((1e6, 0, 0)), {}, {}),
    "feet point along up": (standing(foot=np.pi / 2), FLAT, {}, {}),
    "feet upside down": (standing(foot=np.pi), FLAT, {}, {}),
    "at once": (
        standing(),
        FLAT,
        {},
        {
            "ozz": {"pelvis.on_gain": 1.0, "pelvis.limit": np.inf, "probe.ray_down": np.inf},
            "unreal": {"pelvis.speed": 0.0, "effector.speed": 0.0, "effector.latch": False},
            "mec": {
                "pelvis.speed": 0.0,
                "effector.transition_time": 0.0,
                "lock.plant_speed": np.inf,
            },
        },
    ),
    "never": (
        standing(),
        planes((0, 0, 0.1)),
        {},
        {
            "ozz": {"pelvis.on_gain": 0.0, "pelvis.limit": 0.0},
            "unreal": {"effector.latch_distance": 0.0, "contact.idle_speed": np.inf},
            "mec": {"lock.plant_speed": 0.0, "lock.plant_weight": 0.0},
        },
    ),
    "no foot": (
        standing(),
        planes((0.2, 0, 0)),
        {},
        {
            "ozz": BAREFOOT["ozz"] | {"foot.weight": 0.0},
            "mec": {"probe.foot_length": 0.0, "probe.half_width": 0.0, "foot.max_tilt": 0.0},
        },
    ),
    "aims from beyond its target": (standing(), FLAT, {}, {"ozz": {"foot.offset": [3.0, 0, 0]}}),
    "aims from beside its target": (standing(), FLAT, {}, {"ozz": {"foot.offset": [1.0, 0, 0]}}),
    "hint on the hip": (standing(), FLAT, {}, hint(0.0)),
    "hint along the leg": (standing(), FLAT, {}, hint(0.4)),
}
BOTH = [
    (preset, name)
    for name, (*_, others) in SINGULAR.items()
    for preset in PRESETS
    if not others or preset in others
]


def inputs_of(preset: str, name: str) -> Inputs:
    frames, ground, values, others = SINGULAR[name]
    ik = to_ik(values | others.get(preset, {}), preset)
    return ik, frames, to_ground(ground), jaxik.init(ik, to_rig(RIG))


def tangents_of(inputs: Inputs) -> Any:
    rng = np.random.default_rng(0)
    floats = eqx.filter(inputs, eqx.is_inexact_array)
    return jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), floats)


@functools.partial(jax.jit, compiler_options=QUICK)
def reverse_gradients(inputs: Inputs, rig: jaxik.Rig) -> tuple[Any, Any]:
    """Gradients of a weighted sum of all outputs by all floats of the inputs and of the rig."""
    floats, rest = eqx.partition((inputs, rig), eqx.is_inexact_array)

    def everything(floats: Any) -> jax.Array:
        (inputs, rig), (others, rest_of_rig) = floats, rest
        return read(inputs, others, HARD, eqx.combine(rig, rest_of_rig))[0]["everything"]

    return jax.grad(everything)(floats)


@pytest.mark.parametrize(("preset", "name"), BOTH)
@pytest.mark.parametrize("gate", [HARD, Smooth(1.0)], ids=["hard", "smooth"])
def test_values_and_derivatives_are_finite(preset: str, name: str, gate: Any):
    inputs = inputs_of(preset, name)
    values, gradients, after = measured(inputs, tangents_of(inputs), gate)
    for numbers in (values, gradients):
        assert np.isfinite(list(numbers.values())).all(), numbers
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(after))


@pytest.mark.parametrize(("preset", "name"), BOTH)
def test_gradients_are_finite_and_equal_in_forward_and_reverse_mode(preset: str, name: str):
    inputs = inputs_of(preset, name)
    tangents = tangents_of(inputs)
    forward = measured(inputs, tangents, HARD)[1]["everything"]
    backward = jax.tree.map(np.asarray, reverse_gradients(inputs, to_rig(RIG))[0])
    for path, slope in jax.tree_util.tree_leaves_with_path(backward):
        assert np.isfinite(slope).all(), jax.tree_util.keystr(path)
    pairs = zip(jax.tree.leaves(backward), jax.tree.leaves(tangents), strict=True)
    parts = [np.sum(slope * np.asarray(tangent)) for slope, tangent in pairs]
    np.testing.assert_allclose(sum(parts), forward, rtol=1e-9, atol=1e-9 * np.abs(parts).max())
