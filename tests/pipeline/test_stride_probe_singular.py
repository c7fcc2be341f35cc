"""Frames where the formulas of a stride are singular: values and gradients stay finite."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_systems_singular import (
    BENT,
    FOLDED,
    STRAIGHT,
    held,
    reverse_gradients,
    rotated_root,
    standing,
    tangents_of,
)

import jaxik
from jaxik import HARD, Smooth
from support.cases import RIG, Inputs, measured, swinging
from support.clips import FLAT, planes, to_frames, to_ik, to_rig
from support.clips import to_terrain as to_ground

pytestmark = pytest.mark.slow

UPHILL, STEEP = planes((0.4, 0, 0)), planes((0, 0.9, 0))
AT_WORK = {  # everything that is off by default
    "lock.enabled": True,
    "target.rise_half_life": 0.1,
    "target.fall_half_life": 0.05,
    "target.spring": True,
    "pelvis.rise_half_life": 0.1,
    "pelvis.fall_half_life": 0.05,
    "pelvis.spring": True,
}


def known_stride(fraction: float, **changes: Any) -> jaxik.Frame:
    """Feet half way of their stride in plan, after this fraction of its time."""
    frames = to_frames(swinging(fraction))
    return dataclasses.replace(frames, stride=dataclasses.replace(frames.stride, **changes))


def unknown_stride(velocity: float) -> jaxik.Frame:
    """Feet half way of a stride predicted from the character's forward speed, m/s."""
    frames = to_frames(swinging(0.5, known=False))
    return dataclasses.replace(frames, velocity_ws=frames.velocity_ws * (velocity / 0.8))


def nowhere() -> jaxik.Frame:
    """A stride that ends where it starts."""
    frames = known_stride(0.5)
    return dataclasses.replace(
        frames, stride=dataclasses.replace(frames.stride, next_ws=frames.stride.last_ws)
    )


SINGULAR: dict[str, tuple[jaxik.Frame, Any, dict[str, Any]]] = {
    "fraction 0": (known_stride(0.0), UPHILL, {}),
    "fraction 1": (known_stride(1.0), UPHILL, {}),
    "fraction at the end of the rise": (known_stride(0.75), UPHILL, {"probe.rise_end": 0.75}),
    "no time to rise": (
        known_stride(0.5),
        UPHILL,
        {"probe.rise_start": 0.5, "probe.rise_end": 0.5},
    ),
    "last is next": (nowhere(), UPHILL, {}),
    "no velocity": (unknown_stride(0.0), UPHILL, {}),
    "hardly any velocity": (unknown_stride(1e-12), UPHILL, {}),
    "no ground": (known_stride(0.5), FLAT, {"probe.layers": 0}),
    "no ground, unknown": (unknown_stride(0.8), FLAT, {"probe.layers": 0}),
    "ground out of reach": (known_stride(0.5), planes((0, 0, -0.9)), {}),
    "one leg out of reach": (standing(), planes((0, 4.0, 0)), {}),
    "a wall": (known_stride(0.5), planes((1e6, 0, 0)), {}),
    "no weight": (standing(weight=0.0), UPHILL, {}),
    "half weight": (standing(weight=0.5), UPHILL, {}),
    "no time": (dataclasses.replace(standing(), dt=0.0 * standing().dt), UPHILL, {}),
    "on the surface": (standing(), FLAT, {"probe.clearance": 0.0}),
    "straight": (held(*STRAIGHT), FLAT, {}),
    "straight and too far": (held(*STRAIGHT), planes((0, 0, -0.3)), {}),
    "folded": (held(*FOLDED), FLAT, {}),
    "target on the hip": (held(*BENT), planes((0, 0, 0.75)), {}),
    "no bones": (held([0, 0.5, 0], [0, 0.5, 0], [0, 0.5, 0]), FLAT, {}),
    "no thigh": (held([0, 0.5, 0], [0, 0.5, 0], [0, 0.1, 0]), FLAT, {}),
    "no foot": (held([0, 0.9, 0], [0, 0.5, 0.1], [0.0, 0.1, 0]), STEEP, {}),
    "no rise of the heel": (standing(), STEEP, {"effector.max_lift": 0.0}),
    "looks straight up": (rotated_root(0.5**0.5, -(0.5**0.5), 0.0, 0.0), UPHILL, {}),
    "stands on its head": (rotated_root(0.0, 0.0, 0.0, 1.0), FLAT, {}),
    "feet point along up": (standing(foot=np.pi / 2), FLAT, {}),
    "at once": (standing(), UPHILL, {name: 0.0 for name in AT_WORK if "half_life" in name}),
    "never": (standing(), UPHILL, {name: np.inf for name in AT_WORK if "half_life" in name}),
}


def inputs_of(preset: str, name: str) -> Inputs:
    frames, ground, values = SINGULAR[name]
    ik = to_ik(AT_WORK | values, preset)
    return ik, frames, to_ground(ground), jaxik.init(ik, to_rig(RIG))


@pytest.mark.parametrize("name", SINGULAR)
@pytest.mark.parametrize("gate", [HARD, Smooth(1.0)], ids=["hard", "smooth"])
def test_values_and_derivatives_are_finite(name: str, gate: Any):
    inputs = inputs_of("stride", name)
    values, gradients, after = measured(inputs, tangents_of(inputs), gate)
    for numbers in (values, gradients):
        assert np.isfinite(list(numbers.values())).all(), numbers
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(after))


@pytest.mark.parametrize("name", SINGULAR)
def test_gradients_are_finite_and_equal_in_forward_and_reverse_mode(name: str):
    inputs = inputs_of("by speed", name)
    tangents = tangents_of(inputs)
    forward = measured(inputs, tangents, HARD)[1]["everything"]
    backward = jax.tree.map(np.asarray, reverse_gradients(inputs, to_rig(RIG))[0])
    for path, slope in jax.tree_util.tree_leaves_with_path(backward):
        assert np.isfinite(slope).all(), jax.tree_util.keystr(path)
    pairs = zip(jax.tree.leaves(backward), jax.tree.leaves(tangents), strict=True)
    parts = [np.sum(slope * np.asarray(tangent)) for slope, tangent in pairs]
    np.testing.assert_allclose(sum(parts), forward, rtol=1e-9, atol=1e-9 * np.abs(parts).max())


@pytest.mark.parametrize("present", [[True, False], [False, False]], ids=["one", "both"])
def test_gradients_are_finite_with_an_absent_leg(present: list[bool]):
    """The leg has no position, no bones and no stride."""
    here = np.asarray(present)[:, None]
    frames = known_stride(0.5)
    kept = jax.tree.map(
        lambda leaf: leaf * here if leaf.ndim == 3 else leaf * here[:, 0],
        (frames.pose, frames.stride, frames.foot_speed, frames.toe_speed),
    )
    names = ("pose", "stride", "foot_speed", "toe_speed")
    frames = dataclasses.replace(frames, **dict(zip(names, kept, strict=True)))
    rig = dataclasses.replace(to_rig(RIG), present=jnp.asarray(present))
    ik = to_ik(AT_WORK, "by speed")
    gradients = reverse_gradients((ik, frames, to_ground(UPHILL), jaxik.init(ik, rig)), rig)
    for path, slope in jax.tree_util.tree_leaves_with_path(gradients):
        assert np.isfinite(slope).all(), jax.tree_util.keystr(path)
