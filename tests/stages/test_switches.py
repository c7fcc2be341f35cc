"""Effects of all numbers, switches and masks of the other systems, and their derivatives."""

import functools
from typing import Any

import jax
import pytest

from support import cases, singular
from support.cases import ALL, ANKLE_DEEP, DESCENT, FLAT, KINK, NONE, RAMP_UP, Case, tilted

KEPT = {"root.enabled": False}
SLOW = KEPT | {"pelvis.half_life": 0.2}
IN_PART = SLOW | {"leg.weight": 0.5}
UNSTABLE = {"probe.stable_height": 0.0}
STIFF = {"pelvis.enabled": False}
BENT = {"leg.max_knee_angle": 2.2}
FREE = {"lock.plant": False}
FIXED = {"probe.by_height": False}
BY_SPEED, LOW_SPEED = {"probe.by_speed": True}, {"probe.stable_speed": 0.3}
IDLE = {"contact.idle_speed": 1.0}  # at a walk
STILL, SLOWLY = {"contact.idle_speed": 0.1}, {"contact.idle_speed": 0.4}
FOLLOWS = IDLE | {"effector.latch": False}
RAISED, STAIR, LOWERED = tilted((0, 0, 0.1)), tilted((0, 0, 0.3)), tilted((0, 0, -0.3))
HIGH, HIGHER = tilted((0, 0, 0.4)), tilted((0, 0, 0.5))
LOW, BELOW, LOWER = tilted((0, 0, -0.22)), tilted((0, 0, -0.4)), tilted((0, 0, -0.5))
CLIFF = tilted((0, 0, 0), (9.0, 0, -9.0))  # from 1 m ahead
RIGHT_KINK = tilted((0, 0, 0), (0, -0.5, -0.065))  # rises 0.03 m to the right of the right ankle
UPHILL = tilted((0.3, 0, 0))


def roots(**base: Any) -> tuple[Case, ...]:
    """A character put on its ground; whether a ray hits has no derivative."""
    forward = functools.partial(Case, clip="goes forward", base=base)
    return (
        Case("root.enabled", (False, True), "+ root height", RAISED),
        Case("root.ray_up", (0.3, 0.8), "+ root height", HIGHER, base, slope=False),
        Case("root.ray_down", (0.3, 0.8), "- root height", LOWER, base, slope=False),
        Case("root.layers", (NONE, ALL), "+ root height", RAISED, base),
        # Nearer to a bend, the smoother root begins to rise.
        forward("root.half_life", (0.3, 0.8), "+ root height", RAMP_UP),
        forward("root.max_speed", (0.05, 0.1), "+ root height", RAMP_UP),
        forward("root.max_step", (0.1, 0.3), "+ root height", CLIFF, slope=False),
    )


def limits() -> tuple[Case, ...]:
    """Ground that is a little beyond what the probe accepts."""
    up, down = tilted((0, 0, 0.18)), tilted((0, 0, -0.18))
    low = KEPT | {"probe.max_step_up": 0.1}
    return (
        Case("probe.max_step_up", (0.1, 0.16), "+ found", up, KEPT),
        Case("probe.max_step_down", (0.1, 0.16), "+ found", down, KEPT),
        Case("probe.max_slope", (0.3, 0.36), "+ found", tilted((0.4, 0, 0)), KEPT),
        Case("probe.step_fade", (0.1, 0.2), "+ found", up, low),
    )


def legs(low: Any, **base: Any) -> tuple[Case, ...]:
    """Cases of all two-bone legs; `low` is ground out of their reach."""
    base = STIFF | base
    return (
        Case("leg.soften", (0.85, 0.95), "+ knee angle", low, base),
        Case("leg.twist", (0.0, 0.2), "- knee left", FLAT, base),
        Case("leg.weight", (0.3, 0.8), "- miss", RAISED, base),
    )


def rays(**base: Any) -> tuple[Case, ...]:
    """Ground that longer rays hit, above and below."""
    return (
        Case("probe.ray_up", (0.2, 0.6), "+ target height", HIGH, base, slope=False),
        Case("probe.ray_down", (0.2, 0.6), "- target height", BELOW, base, slope=False),
        Case("probe.layers", (NONE, ALL), "+ target height", RAISED, base),
    )


# The leg's aim leans forward: the height of the hint counts once the hint is aside.
ASIDE = (0.1, 0.0, 0.0)
WALKS = functools.partial(Case, clip="goes forward")
DRIFTS = functools.partial(Case, clip="drifts slowly")
TOES = ((0, -0.07, 0.2), (0, -0.07, 0.3))
# All feet do, by this contact.
STANDING = Case("effector.by_contact", (False, True), "= everything", RAISED, clip="lifts its feet")
CASES: dict[str, tuple[Case, ...]] = {
    "ozz": (
        *roots(),
        *limits(),
        *rays(**KEPT),
        Case("target.foot_height", (0.05, 0.1), "+ target height"),
        Case("target.max_slope", (0.3, 0.6), "+ target height", tilted((1.0, 0, 0))),
        Case("pelvis.enabled", (False, True), "- pelvis height", LOWERED, KEPT),
        Case("pelvis.limit", (0.1, 0.2), "- pelvis height", LOWER, KEPT),
        WALKS("pelvis.half_life", (0.06, 0.2), "- pelvis height", RAMP_UP, KEPT),
        # Counts as far as no foot stands.
        WALKS("pelvis.airborne_half_life", (0.1, 0.4), "- pelvis height", RAMP_UP, IN_PART),
        *legs(LOWERED, **KEPT),
        Case("leg.enabled", (False, True), "- miss", RAISED, KEPT | STIFF),
        Case("leg.to_hint", (False, True), "+ knee left", FLAT, {"leg.hint_offset": ASIDE}),
        *(Case(f"leg.hint_offset[{i}]", ((0, 0, 0), ASIDE), "= everything") for i in range(3)),
        WALKS("contact.idle_speed", (0.4, 0.8), "+ contact"),
        Case("effector.if_found", (False, True), "- weight", FLAT, {"probe.layers": NONE}),
        Case("foot.enabled", (False, True), "+ pitch", UPHILL),
        # The rotated foot moves the start of the axis back to the side that the offset left.
        Case("foot.offset[0]", ((0, 0, 0), (0.1, 0, 0)), "+ left roll"),
        Case("foot.offset[2]", ((0, 0, 0), (0, 0, 0.1)), "+ pitch"),
        Case("foot.twist", (0.0, 0.2), "+ yaw"),
        Case("foot.weight", (0.3, 0.8), "+ pitch", UPHILL),
        # What no other rule of the system reads; where it counts shows the record.
        Case("probe.use_toe", (False, True), "= everything", KINK),
        Case("probe.toe_ls", TOES, "= everything", KINK, {"probe.use_toe": True}),
        Case("pelvis.vertical_only", (False, True), "= everything", ANKLE_DEEP),
        STANDING,
        Case("pelvis.wait_to_rise", (False, True), "= everything", ANKLE_DEEP),
        Case("pelvis.min_extension", (0.0, 0.36), "= everything", ANKLE_DEEP),
        # Along the ray.
        Case("foot.offset[1]", ((0, 0, 0), (0, 0.1, 0)), "= everything", KINK),
    ),
    "unreal": (
        *roots(**{"root.enabled": True}),
        *limits(),
        *rays(),
        WALKS("contact.idle_speed", (0.4, 0.8), "+ target height", RAISED),
        Case("target.adjust", (0.0, 0.05), "+ target height"),
        Case("pelvis.enabled", (False, True), "- pelvis height", LOWERED),
        WALKS("pelvis.speed", (2.0, 6.0), "- pelvis height", DESCENT, FOLLOWS),
        Case("pelvis.half_height", (0.8, 1.0), "+ half height", LOWERED),
        WALKS("effector.speed", (2.0, 6.0), "+ target height", RAMP_UP, FOLLOWS),
        WALKS("effector.latch", (False, True), "- target height", RAMP_UP, IDLE),
        # The latch stops this far short of rising ground.
        Case("effector.latch_distance", (0.005, 0.05), "- target height", STAIR, STILL, "stops"),
        # As the character sets off, its feet go back to their animation gradually or at once.
        Case("effector.by_contact", (False, True), "+ miss", RAISED, SLOWLY, "speeds up"),
        Case("leg.max_knee_angle", (2.6, 2.8), "+ knee angle", LOWERED, STIFF),
        Case("leg.min_knee_angle", (0.9, 1.2), "+ knee angle", HIGHER),
        Case("leg.as_animated", (False, True), "+ knee angle", base=STIFF | BENT),
        *legs(LOWERED),
    ),
    "mec": (
        *roots(**{"root.enabled": True}),
        *limits(),
        Case("probe.active", (False, True), "+ target height", RAISED),
        Case("probe.ray_up", (0.1, 0.5), "+ target height", STAIR, slope=False),
        Case("probe.extra", (0.1, 0.3), "- target height", LOW, FIXED),
        Case("probe.extra_max", (0.1, 0.3), "- target height", LOW),
        Case("probe.extra_min", (0.1, 0.3), "- target height", LOW, UNSTABLE),
        Case("probe.stable_height", (0.05, 0.12), "- target height", LOW),
        WALKS("probe.stable_speed", (0.4, 0.8), "- target height", LOW, FIXED | BY_SPEED),
        # The rays of an unstable foot are shorter and lose the ground.
        Case("probe.by_height", (False, True), "+ target height", LOW, UNSTABLE),
        WALKS("probe.by_speed", (False, True), "+ target height", LOW, FIXED | LOW_SPEED),
        Case("probe.layers", (NONE, ALL), "+ target height", RAISED),
        Case("probe.foot_length", (0.22, 0.28), "+ pitch", KINK),
        Case("probe.half_width", (0.04, 0.06), "- roll", RIGHT_KINK),
        WALKS("contact.idle_speed", (0.4, 0.8), "+ contact"),
        Case("target.foot_height", (0.08, 0.12), "+ target height"),
        Case("target.max_slope", (0.3, 0.6), "+ target height", tilted((1.0, 0, 0))),
        DRIFTS("lock.plant", (False, True), "- slip"),
        DRIFTS("lock.plant_weight", (0.2, 0.8), "- slip"),
        DRIFTS("lock.plant_speed", (0.5, 2.0), "- target left", started=True),
        Case("pelvis.enabled", (False, True), "- pelvis height", LOW),
        Case("pelvis.min_length", (0.45, 0.55), "+ pelvis height", HIGH),
        Case("pelvis.max_length", (0.8, 0.85), "+ pelvis height", LOW),
        WALKS("pelvis.damp", (False, True), "+ pelvis height", DESCENT, FREE),
        WALKS("pelvis.speed", (2.0, 6.0), "- pelvis height", DESCENT, FREE),
        Case("effector.transition_time", (0.2, 0.6), "+ weight", clip="lifts its feet"),
        Case("leg.hint_offset[0]", ((0, 0, 0), ASIDE), "+ knee left"),
        Case("leg.hint_offset[1]", (ASIDE, (0.1, 0.2, 0)), "- knee left"),
        Case("leg.hint_offset[2]", (ASIDE, (0.1, 0, 0.2)), "- knee left"),
        *legs(LOW),
        Case("leg.enabled", (False, True), "- miss", RAISED, STIFF),
        Case("leg.to_hint", (False, True), "+ knee left", FLAT, {"leg.hint_offset": ASIDE}),
        Case("foot.max_tilt", (0.3, 0.5), "+ pitch", tilted((0.8, 0, 0))),
        STANDING,
    ),
}
# In `test_own_rules`, `test_limits`, `test_foot_placement` and `tests/pipeline/test_situations.py`.
IN_OWN_TESTS = ("warp.", "probe.min_support", "probe.support_radius", "lock.release_")
IN_OWN_TESTS += ("leg.max_stretch", "foot.toe_length", "foot.max_toe_", "probe.flight_layers")
IN_OWN_TESTS += ("root.max_gap",)


@pytest.mark.parametrize("preset", CASES)
def test_all_numbers_switches_and_masks_of_a_system_have_a_case(preset: str):
    paths = jax.tree_util.tree_leaves_with_path(cases.system(preset))
    leaves = {jax.tree_util.keystr(path).removeprefix(".") for path, _ in paths}
    leaves = {leaf for leaf in leaves if not leaf.startswith(IN_OWN_TESTS)}
    assert {case.leaf for case in CASES[preset]} == leaves


@pytest.mark.slow  # the references in `tests/pipeline` have the same numbers
@pytest.mark.parametrize("preset", CASES)
def test_each_leaf_has_the_expected_effect_or_none(preset: str):
    by_value = cases.outcomes_of(CASES[preset], cases.system(preset), sloped=False)
    assert not by_value.without_effect()


@pytest.mark.slow
@pytest.mark.parametrize("preset", CASES)
def test_the_derivative_of_each_number_is_its_difference_quotient(preset: str):
    assert not cases.outcomes_of(CASES[preset], cases.system(preset)).with_wrong_slope()


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["unreal", "ozz"])
def test_values_and_derivatives_are_finite_where_formulas_are_singular(preset: str):
    singular.assert_sound(preset)
