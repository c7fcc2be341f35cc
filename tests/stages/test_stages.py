"""Effects of all parameters and switches of the record, and gradients through its stages."""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from jaxik import HARD, Smooth, presets
from jaxik import record as game
from jaxik.maths import parameter_tree
from reference import sample_poses
from support.cases import (
    ANKLE_DEEP,
    KINK,
    QUICK,
    RAMP_DOWN,
    RAMP_UP,
    RIG,
    Case,
    assert_effect,
    assert_slope,
    clip,
    has_slope,
    measured,
    posed,
    still,
    total,
)
from support.clips import FLAT, animate, at, planes, to_frames, to_ik, to_rig
from support.clips import to_terrain as to_ground

NO_LOCK = {"lock.enabled": False}
STIFF = {"pelvis.limit": 0.0}
LOOSE = {  # nothing releases a lock except what a case sets
    "lock.release_distance": 9.0,
    "lock.release_cone": 1.5,
    "lock.release_max_angle": 3.1415926536,
    "lock.release_min_angle": 0.0,
}


def toe(**changes: float) -> list[float]:
    return list(({"x": 0.0, "y": -0.07, "z": 0.20} | changes).values())


RECORD = (
    Case("contact.ground_height", "standing", FLAT, (0.0, 0.01), "target height", -1),
    Case(
        "target.min_ankle_height",
        "standing",
        planes((0, 0, -0.5)),
        (-0.3, -0.2),
        "target height",
        1,
    ),
    Case(
        "target.max_ankle_height",
        "standing",
        planes((0, 0, 0.45)),
        (0.4, 0.45),
        "target height",
        1,
        {"probe.ray_up": 0.6},
    ),
    Case(
        "leg.max_knee_angle", "standing", planes((0, 0, -0.3)), (2.6, 2.8), "knee angle", 1, STIFF
    ),
    Case(
        "leg.min_knee_angle",
        "standing",
        planes((0, 0, 0.5)),
        (0.9, 1.2),
        "knee angle",
        1,
        STIFF | {"probe.ray_up": 0.7, "target.max_ankle_height": 1.0},
    ),
    Case("contact.planted_height", "hovering", planes((0.2, 0, 0)), (0.10, 0.12), "pitch", 1),
    Case("contact.raised_height", "hovering", planes((0.2, 0, 0)), (0.16, 0.20), "pitch", 1),
    Case("probe.ray_up", "standing", ANKLE_DEEP, (0.1, 0.5), "pitch", 1, slope=False),
    Case("probe.ray_down", "standing", planes((0.2, 0, -0.5)), (0.3, 0.8), "pitch", 1, slope=False),
    Case(
        "probe.toe_ls[0]",
        "standing",
        planes((0, 0.4, 0)),
        (toe(x=-0.02), toe(x=0.02)),
        "left pitch",
        1,
    ),
    Case(
        "probe.toe_ls[1]",
        "toes up",
        KINK,
        (toe(y=-0.07, z=0.3), toe(y=0.03, z=0.3)),
        "pitch",
        -1,
        {"foot.max_pitch": 1.0},
    ),
    Case("probe.toe_ls[2]", "standing", KINK, (toe(z=0.25), toe(z=0.30)), "pitch", 1),
    Case("foot.max_pitch", "standing", planes((0.8, 0, 0)), (0.5, 0.7), "pitch", 1),
    Case("foot.min_pitch", "standing", planes((-0.8, 0, 0)), (-0.4, -0.2), "pitch", 1),
    Case("foot.max_roll", "standing", planes((0, 0.8, 0)), (0.2, 0.4), "left roll", 1),
    Case("foot.min_roll", "standing", planes((0, -0.8, 0)), (-0.4, -0.2), "left roll", 1),
    Case("pelvis.limit", "standing", planes((0, 0, -0.5)), (0.1, 0.2), "pelvis height", -1),
    Case("pelvis.on_gain", "goes forward", RAMP_UP, (0.1, 0.3), "pelvis height", 1, NO_LOCK),
    Case(
        "pelvis.off_gain", "lifts its feet", planes((0, 0, -0.2)), (0.05, 0.2), "pelvis height", 1
    ),
    Case("lean.forward_rate", "standing", planes((0.3, 0, 0)), (-0.3, 0.3), "lean forward", -1),
    Case("lean.side_rate", "standing", planes((0, -0.3, 0)), (-0.3, 0.3), "lean right", -1),
    Case("lean.forward_rate_slide", "sliding", planes((0.3, 0, 0)), (0, 0.8), "lean forward", -1),
    Case("lean.side_rate_slide", "sliding", planes((0, -0.3, 0)), (0, 0.8), "lean right", -1),
    Case(
        "lean.gain",
        "goes forward",
        RAMP_UP,
        (0.05, 0.3),
        "lean forward",
        -1,
        {"lean.forward_rate": 0.8},
    ),
    Case("lean.gain_slide", "slides forward", RAMP_UP, (0.05, 0.3), "lean forward", -1),
    Case(
        "lean.slide_on_gain",
        "begins to slide",
        planes((0.3, 0, 0)),
        (0.05, 0.3),
        "lean forward",
        -1,
    ),
    Case(
        "lean.slide_off_gain",
        "ceases to slide",
        planes((0.3, 0, 0)),
        (0.05, 0.3),
        "lean forward",
        1,
    ),
    Case("lock.release_min_angle", "sinks", FLAT, (1.2, 1.6), "locked", -1, LOOSE),
    Case("lock.release_max_angle", "drifts", FLAT, (2.5, 2.8), "locked", 1, LOOSE),
    Case("lock.release_cone", "drifts", FLAT, (0.1, 0.3), "locked", 1, LOOSE),
    Case(
        "lock.relock_threshold",
        "drifts",
        FLAT,
        (0.1, 0.5),
        "locked",
        1,
        {"lock.release_distance": 0.05},
    ),
    Case("lock.enabled", "drifts", FLAT, (False, True), "slip", -1),
    Case(
        "probe.use_toe", "standing", KINK, (False, True), "pitch", 1, {"probe.toe_ls": toe(z=0.3)}
    ),
    Case(
        "pelvis.vertical_only",
        "standing",
        planes((0.3, 0, -0.2)),
        (False, True),
        "pelvis forward",
        -1,
    ),
)
EXTRA = (
    Case("target.foot_height", "standing", planes((0.5, 0, 0)), (0.05, 0.1), "target height", 1),
    Case("target.max_slope", "standing", planes((1.0, 0, 0)), (0.3, 0.6), "target height", 1),
    Case(
        "target.rise_half_life", "goes forward", RAMP_UP, (0.05, 0.2), "target height", -1, NO_LOCK
    ),
    Case(
        "target.fall_half_life", "goes forward", RAMP_DOWN, (0.05, 0.2), "target height", 1, NO_LOCK
    ),
    Case("lock.lock_half_life", "drifts", FLAT, (0.02, 0.1), "offset", -1, LOOSE),
    Case(
        "lock.unlock_half_life",
        "drifts",
        FLAT,
        (0.05, 0.2),
        "offset",
        1,
        {"lock.release_distance": 0.05, "lock.relock_threshold": 0.0},
    ),
    Case("lock.release_distance", "drifts", FLAT, (0.05, 0.15), "locked", 1),
    Case(
        "lock.return_speed",
        "drifts",
        FLAT,
        (0.1, 0.4),
        "offset",
        -1,
        LOOSE
        | {
            "lock.release_distance": 0.1,
            "lock.relock_threshold": 0.0,
            "lock.unlock_half_life": 0.0,  # without a limit it would jump
        },
    ),
    Case("lock.max_speed", "drifts", FLAT, (0.2, 0.4), "locked", 1),
    Case("lock.release_heading", "turns", FLAT, (0.2, 0.5), "locked", 1, LOOSE),
    Case("lock.release_speed", "speeds up", FLAT, (0.2, 0.4), "locked", 1, LOOSE),
    Case("leg.soften", "standing", planes((0, 0, -0.3)), (0.85, 0.95), "knee angle", 1, STIFF),
    Case("leg.twist", "standing", FLAT, (0.0, 0.2), "knee left", -1),
    Case("leg.weight", "standing", planes((0, 0, 0.1)), (0.3, 0.8), "miss", -1, STIFF),
    Case("pelvis.tick_hz", "goes forward", RAMP_UP, (30.0, 60.0), "pelvis height", 1, NO_LOCK),
    Case(
        "lean.tick_hz",
        "goes forward",
        RAMP_UP,
        (30.0, 60.0),
        "lean forward",
        -1,
        {"lean.forward_rate": 0.8},
    ),
)
LATE = planes((0, 0, 0), (0.5, 0, -1.2))  # begins to rise where "goes forward" ends
RULES = (  # switches of our rules that the record lacks; off by default
    Case(
        "target.spring",
        "goes forward",
        RAMP_UP,
        (False, True),
        "target height",
        -1,
        NO_LOCK | {"target.rise_half_life": 0.2},
    ),
    Case(
        "target.follow_slopes",
        "goes forward",
        RAMP_UP,
        (False, True),
        "target height",
        1,
        NO_LOCK | {"target.rise_half_life": 0.2},
    ),
    Case(
        "lean.spring",
        "goes forward",
        LATE,
        (False, True),
        "lean forward",
        1,
        {"lean.forward_rate": 0.8},
    ),
    Case(
        "lock.hold_ball",  # feet that count as standing until their heels are well up
        "walks",
        FLAT,
        (False, True),
        "ball slip",
        -1,
        LOOSE
        | {
            "lock.lock_half_life": 0.005,
            "contact.planted_height": 0.15,
            "contact.raised_height": 0.2,
        },
    ),
    Case("leg.as_animated", "walks", FLAT, (False, True), "knee angle", 1),
    Case("pelvis.wait_to_rise", "walks", RAMP_DOWN, (False, True), "pelvis height", -1),
)
CASES = (*RECORD, *EXTRA, *RULES)
SLOPED = [case for case in CASES if has_slope(case, "record")]


def named(cases: Any) -> Any:
    return pytest.mark.parametrize("case", cases, ids=lambda case: case.name)


def test_all_fields_of_the_record_and_all_parameters_have_a_case():
    assert [case.name for case in RECORD if case not in SLOPED] == [
        "lock.enabled",
        "probe.use_toe",
        "pelvis.vertical_only",
    ]
    switches = {ours for _, _, ours in game.FLAGS}
    assert {case.name for case in RECORD} == {ours for _, ours, _ in game.FLOATS} | switches
    assert not any(
        bool(parameter_tree.get(presets.record(faithful=True), case.leaf)) for case in RULES
    )
    switches |= {case.leaf for case in RULES}
    declared = set(parameter_tree.declarations(presets.record(faithful=True))) | {
        "lean.tick_hz",
        "pelvis.tick_hz",
    }
    # These clips tell no scale of strides, nothing fades and no ground is refused:
    # `test_stride_warp`, `test_fade`, `test_limits` and `test_narrow_ground` have those that do.
    own = ("warp.", "fade.", "probe.max_", "probe.min_support", "probe.support_radius")
    declared = {name for name in declared if not name.startswith(own)}
    assert {case.leaf for case in CASES} == declared | switches


@pytest.mark.slow
@named(CASES)
def test_a_parameter_has_the_expected_effect(case: Case):
    assert_effect(case, "record")


@pytest.mark.slow
@named(SLOPED)
@pytest.mark.parametrize("gate", [HARD, Smooth(1.0)], ids=["hard", "smooth"])
def test_the_derivative_of_a_parameter_is_its_difference_quotient(case: Case, gate: Any):
    assert_slope(case, "record", gate)


@pytest.mark.slow
@pytest.mark.parametrize("gate", [HARD, Smooth(1.0)], ids=["hard", "smooth"])
@pytest.mark.parametrize("name", ["limps", "limps on its toes"])
def test_gradients_of_animation_and_terrain_are_difference_quotients(name, gate):
    uneven = planes((0.05, 0.11, 0.0), (0.21, -0.1, -0.1))
    ik = to_ik({"pelvis.vertical_only": False})
    inputs = (ik, clip(name), to_ground(uneven), jaxik.init(ik, to_rig(RIG)))
    rng = np.random.default_rng(0)
    zero = still(inputs)
    pose, root = inputs[1].pose, inputs[1].world_from_model
    jitter = lambda x: jnp.asarray(0.1 * rng.normal(size=x.shape))  # noqa: E731
    shifted = eqx.tree_at(
        lambda f: (f.pose.hip.pos, f.pose.ankle.pos, f.pose.toe.pos, f.world_from_model.pos),
        zero[1],
        tuple(map(jitter, (pose.hip.pos, pose.ankle.pos, pose.toe.pos, root.pos))),
    )
    raised = eqx.tree_at(
        lambda g: [plane.point_ws for plane in g.surfaces], zero[2], [jnp.full(3, 0.1, float)] * 3
    )
    tangents = (zero[0], shifted, raised, zero[3])

    def numbers(measures: dict[str, jax.Array]) -> np.ndarray:
        return np.array(list(measures.values()))

    def along(step: float) -> np.ndarray:
        floats, rest = eqx.partition(inputs, eqx.is_inexact_array)
        floats = jax.tree.map(lambda x, t: x + step * t, floats, tangents)
        return numbers(measured(eqx.combine(floats, rest), zero, gate)[0])

    derivatives = numbers(measured(inputs, tangents, gate)[1])
    quotients = (along(1e-6) - along(-1e-6)) / 2e-6
    assert np.abs(derivatives).max() > 1e-2
    np.testing.assert_allclose(derivatives, quotients, rtol=1e-4, atol=1e-6)


# Inputs where gradients could become NaN or infinite. Clips of one frame each.

THIGH, SHIN = sample_poses.THIGH, sample_poses.SHIN
ON_HIP = {"probe.ray_up": 2.0, "target.max_ankle_height": 2.0, "pelvis.limit": 0.0}
SINGULAR: dict[str, tuple[dict[str, Any], jaxik.Frame, Any]] = {
    "straight": ({}, posed([0, 0.9, 0], [0, 0.45, 0], [0, 0.02, 0]), FLAT),
    "straight and too far": (
        STIFF,
        posed([0, 0.9, 0], [0, 0.45, 0], [0, 0.02, 0]),
        planes((0, 0, -0.3)),
    ),
    "straight without softening": (
        STIFF | {"leg.soften": 1.0, "leg.max_knee_angle": np.pi},
        posed([0, 0.88, 0], [0, SHIN, 0], [0, 0, 0]),
        FLAT,
    ),
    "folded": ({}, posed([0, 0.5, 0], [0, 0.05, 0], [0, 0.48, 0]), FLAT),
    "folded without a limit": (
        ON_HIP | {"leg.min_knee_angle": 0.0},
        posed([0, 0.5, 0], [0, 0.05, 0], [0, 0.48, 0]),
        planes((0, 0, 0.02)),
    ),
    "target on the hip": (
        ON_HIP,
        posed([0, 0.8, 0], [0, 0.4, 0.2], [0, 0, 0]),
        planes((0, 0, 0.8)),
    ),
    "target above the hip": (
        ON_HIP,
        posed([0, 0.8, 0], [0, 0.4, 0.2], [0, 0, 0]),
        planes((0, 0, 1.6)),
    ),
    "no bones": ({}, posed([0, 0.5, 0], [0, 0.5, 0], [0, 0.5, 0]), FLAT),
    "no thigh": ({}, posed([0, 0.5, 0], [0, 0.5, 0], [0, 0.1, 0]), FLAT),
    "no shin": ({}, posed([0, 0.5, 0], [0, 0.1, 0], [0, 0.1, 0]), FLAT),
    "misses": ({}, to_frames(animate(RIG, count=1)), planes((0, 0, -5.0))),
    "on the surface": ({}, posed([0, 0.8, 0], [0, 0.4, 0.2], [0, 0, 0]), FLAT),
    "no time": ({}, dataclasses.replace(to_frames(animate(RIG, count=1)), dt=jnp.zeros(1)), FLAT),
    "no weight": ({}, to_frames(animate(RIG, count=1, weight=0.0)), FLAT),
    "no gap between planted and raised": (
        {"contact.planted_height": 0.1, "contact.raised_height": 0.1},
        to_frames(animate(RIG, count=1)),
        FLAT,
    ),
    "looks straight up": (
        {},
        dataclasses.replace(
            to_frames(animate(RIG, count=1)),
            world_from_model=jaxik.Transform(
                jnp.zeros((1, 3)), jnp.array([[0.5**0.5, -(0.5**0.5), 0, 0]])
            ),
        ),
        planes((0.1, 0, 0)),
    ),
    "plane on edge": ({}, to_frames(animate(RIG, count=1)), planes((1e6, 0, 0))),
}


def weighted_sum(floats: Any, rest: Any) -> jax.Array:
    """A weighted sum of positions, rotations, offsets and slopes."""
    ik, frames, ground, gate = eqx.combine(floats, rest)
    result = jaxik.run(ik, to_rig(RIG), ground, frames, gate)
    state = result.trace.advanced.state
    return total((result.pose, result.body, state.lock.offset, state.lean))


@functools.partial(jax.jit, compiler_options=QUICK)
@jax.vmap
def forward_derivative(floats: Any, rest: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
    return jax.jvp(lambda floats: weighted_sum(floats, rest), (floats,), (tangents,))


reverse_gradients = jax.jit(jax.vmap(jax.grad(weighted_sum)), compiler_options=QUICK)


def singular_inputs(gate: Any) -> tuple[Any, Any, Any]:
    """Floats, other leaves, and a random tangent of the floats, for all of `SINGULAR`."""
    members = [
        (to_ik(values), frames, to_ground(ground), gate)
        for values, frames, ground in SINGULAR.values()
    ]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *members)
    floats, rest = eqx.partition(batch, eqx.is_inexact_array)
    rng = np.random.default_rng(0)
    return floats, rest, jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), floats)


@functools.cache
def hard_gradients() -> tuple[Any, ...]:
    floats, rest, tangents = singular_inputs(HARD)
    return *forward_derivative(floats, rest, tangents), reverse_gradients(floats, rest), tangents


@functools.cache
def smooth_derivatives() -> tuple[jax.Array, jax.Array]:
    return forward_derivative(*singular_inputs(Smooth(1.0)))


@pytest.mark.slow
@pytest.mark.parametrize("name", SINGULAR)
def test_gradients_are_finite_and_equal_in_forward_and_reverse_mode(name):
    value, forward, gradients, tangents = at(hard_gradients(), list(SINGULAR).index(name))
    for path, gradient in jax.tree_util.tree_leaves_with_path(gradients):
        assert np.isfinite(gradient).all(), jax.tree_util.keystr(path)
    assert np.isfinite(value) and np.isfinite(forward)
    pairs = zip(jax.tree.leaves(gradients), jax.tree.leaves(tangents), strict=True)
    reverse = [np.sum(np.asarray(gradient) * np.asarray(tangent)) for gradient, tangent in pairs]
    np.testing.assert_allclose(sum(reverse), forward, rtol=1e-9, atol=1e-9 * np.abs(reverse).max())


@pytest.mark.slow
@pytest.mark.parametrize("name", SINGULAR)
def test_derivatives_through_softened_decisions_are_finite(name):
    assert np.isfinite(at(smooth_derivatives(), list(SINGULAR).index(name))).all()
