"""Effects of all numbers, switches and masks of the other systems, and their derivatives."""

from typing import Any

import jax
import pytest

from jaxik import HARD, Smooth
from support.cases import (
    ANKLE_DEEP,
    DESCENT,
    KINK,
    RAMP_UP,
    Case,
    assert_effect,
    assert_slope,
    has_slope,
    run_case,
)
from support.clips import FLAT, planes, to_ik

NONE, ALL = 0xFFFFFFFE, 0xFFFFFFFF  # masks without and with the layer of the planes
KEPT = {"root.enabled": False}
STIFF = {"pelvis.enabled": False}
FREE = {"lock.plant": False}
FIXED = {"probe.by_height": False}
IDLE = {"contact.idle_speed": 1.0}  # at a walk
FOLLOWS = IDLE | {"effector.latch": False}
RAISED, LOWERED = planes((0, 0, 0.1)), planes((0, 0, -0.3))
HIGH, LOW, LOWER = planes((0, 0, 0.4)), planes((0, 0, -0.22)), planes((0, 0, -0.5))
CLIFF = planes((0, 0, 0), (9.0, 0, -9.0))  # from 1 m ahead
RIGHT_KINK = planes((0, 0, 0), (0, -0.5, -0.065))  # rises 0.03 m to the right of the right ankle


def roots(**base: Any) -> tuple[Case, ...]:
    """A character put on its ground; whether a ray hits has no derivative."""
    return (
        Case("root.enabled", "standing", RAISED, (False, True), "root height", 1),
        Case(
            "root.ray_up",
            "standing",
            planes((0, 0, 0.5)),
            (0.3, 0.8),
            "root height",
            1,
            base,
            slope=False,
        ),
        Case("root.ray_down", "standing", LOWER, (0.3, 0.8), "root height", -1, base, slope=False),
        Case("root.layers", "standing", RAISED, (NONE, ALL), "root height", 1, base),
        # Nearer to a bend, the smoother root begins to rise.
        Case("root.half_life", "goes forward", RAMP_UP, (0.3, 0.8), "root height", 1, base),
        Case("root.max_speed", "goes forward", RAMP_UP, (0.05, 0.1), "root height", 1, base),
        Case("root.max_step", "goes forward", CLIFF, (0.1, 0.6), "root height", 1, base),
    )


def limits() -> tuple[Case, ...]:
    """Ground that is a little beyond what the probe accepts."""
    base = KEPT | {"probe.limited": True}
    low = base | {"probe.max_step_up": 0.1}
    up, down = ("standing", planes((0, 0, 0.18))), ("standing", planes((0, 0, -0.18)))
    return (
        Case("probe.max_step_up", *up, (0.1, 0.16), "found", 1, base),
        Case("probe.max_step_down", *down, (0.1, 0.16), "found", 1, base),
        Case("probe.max_slope", "standing", planes((0.4, 0, 0)), (0.3, 0.36), "found", 1, base),
        Case("probe.step_fade", *up, (0.1, 0.2), "found", 1, low),
    )


def legs(low: Any, **base: Any) -> tuple[Case, ...]:
    """Cases of all two-bone legs; `low` is ground out of their reach."""
    base = STIFF | base
    return (
        Case("leg.soften", "standing", low, (0.85, 0.95), "knee angle", 1, base),
        Case("leg.twist", "standing", FLAT, (0.0, 0.2), "knee left", -1, base),
        Case("leg.weight", "standing", RAISED, (0.3, 0.8), "miss", -1, base),
    )


# The leg's aim leans forward: the height of the hint counts once the hint is aside.
ASIDE = (0.1, 0.0, 0.0)

CASES: dict[str, tuple[Case, ...]] = {
    "ozz": (
        *roots(),
        *limits(),
        Case("probe.ray_up", "standing", HIGH, (0.2, 0.6), "target height", 1, KEPT, slope=False),
        Case(
            "probe.ray_down", "standing", LOWER, (0.3, 0.8), "target height", -1, KEPT, slope=False
        ),
        Case("probe.layers", "standing", RAISED, (NONE, ALL), "target height", 1, KEPT),
        Case("target.foot_height", "standing", FLAT, (0.05, 0.1), "target height", 1),
        Case("target.max_slope", "standing", planes((1.0, 0, 0)), (0.3, 0.6), "target height", 1),
        Case("pelvis.enabled", "standing", LOWERED, (False, True), "pelvis height", -1, KEPT),
        Case("pelvis.limit", "standing", LOWER, (0.1, 0.2), "pelvis height", -1, KEPT),
        Case("pelvis.on_gain", "goes forward", RAMP_UP, (0.1, 0.3), "pelvis height", 1, KEPT),
        Case(
            "pelvis.off_gain",  # counts as far as no foot stands
            "goes forward",
            RAMP_UP,
            (0.05, 0.2),
            "pelvis height",
            1,
            KEPT | {"leg.weight": 0.5, "pelvis.on_gain": 0.1},
        ),
        Case(
            "pelvis.tick_hz",
            "goes forward",
            RAMP_UP,
            (30.0, 60.0),
            "pelvis height",
            1,
            KEPT | {"pelvis.on_gain": 0.1},
        ),
        *legs(LOWERED, **KEPT),
        Case("leg.enabled", "standing", RAISED, (False, True), "miss", -1, KEPT | STIFF),
        Case("foot.enabled", "standing", planes((0.3, 0, 0)), (False, True), "pitch", 1),
        # The rotated foot moves the start of the axis back to the side that the offset left.
        Case("foot.offset[0]", "standing", FLAT, ((0, 0, 0), (0.1, 0, 0)), "left roll", 1),
        Case("foot.offset[2]", "standing", FLAT, ((0, 0, 0), (0, 0, 0.1)), "pitch", 1),
        Case("foot.twist", "standing", FLAT, (0.0, 0.2), "yaw", 1),
        Case("foot.weight", "standing", planes((0.3, 0, 0)), (0.3, 0.8), "pitch", 1),
    ),
    "unreal": (
        *roots(**{"root.enabled": True}),
        *limits(),
        Case("probe.ray_up", "standing", HIGH, (0.2, 0.6), "target height", 1, slope=False),
        Case(
            "probe.ray_down",
            "standing",
            planes((0, 0, -0.4)),
            (0.2, 0.6),
            "target height",
            -1,
            slope=False,
        ),
        Case("probe.layers", "standing", RAISED, (NONE, ALL), "target height", 1),
        Case("contact.idle_speed", "goes forward", RAISED, (0.4, 0.8), "target height", 1),
        Case("target.adjust", "standing", FLAT, (0.0, 0.05), "target height", 1),
        Case("pelvis.enabled", "standing", LOWERED, (False, True), "pelvis height", -1),
        Case("pelvis.speed", "goes forward", DESCENT, (2.0, 6.0), "pelvis height", -1, FOLLOWS),
        Case("pelvis.half_height", "standing", LOWERED, (0.8, 1.0), "half height", 1),
        Case("effector.speed", "goes forward", RAMP_UP, (2.0, 6.0), "target height", 1, FOLLOWS),
        Case("effector.latch", "goes forward", RAMP_UP, (False, True), "target height", -1, IDLE),
        Case(
            "effector.latch_distance",  # stops this far short of rising ground
            "stops",
            planes((0, 0, 0.3)),
            (0.005, 0.05),
            "target height",
            -1,
            {"contact.idle_speed": 0.1},
        ),
        # As the character sets off, its feet go back to their animation gradually or at once.
        Case(
            "effector.by_contact",
            "speeds up",
            RAISED,
            (False, True),
            "miss",
            1,
            {"contact.idle_speed": 0.4},
        ),
        Case("leg.max_knee_angle", "standing", LOWERED, (2.6, 2.8), "knee angle", 1, STIFF),
        Case("leg.min_knee_angle", "standing", planes((0, 0, 0.5)), (0.9, 1.2), "knee angle", 1),
        Case(
            "leg.as_animated",
            "standing",
            FLAT,
            (False, True),
            "knee angle",
            1,
            STIFF | {"leg.max_knee_angle": 2.2},
        ),
        *legs(LOWERED),
    ),
    "mec": (
        *roots(**{"root.enabled": True}),
        *limits(),
        Case("probe.active", "standing", RAISED, (False, True), "target height", 1),
        Case(
            "probe.ray_up",
            "standing",
            planes((0, 0, 0.3)),
            (0.1, 0.5),
            "target height",
            1,
            slope=False,
        ),
        Case("probe.extra", "standing", LOW, (0.1, 0.3), "target height", -1, FIXED),
        Case("probe.extra_max", "standing", LOW, (0.1, 0.3), "target height", -1),
        Case(
            "probe.extra_min",
            "standing",
            LOW,
            (0.1, 0.3),
            "target height",
            -1,
            {"probe.stable_height": 0.0},
        ),
        Case("probe.stable_height", "standing", LOW, (0.05, 0.12), "target height", -1),
        Case(
            "probe.stable_speed",
            "goes forward",
            LOW,
            (0.4, 0.8),
            "target height",
            -1,
            FIXED | {"probe.by_speed": True},
        ),
        Case(
            "probe.by_height",  # the rays of an unstable foot are shorter and lose the ground
            "standing",
            LOW,
            (False, True),
            "target height",
            1,
            {"probe.stable_height": 0.0},
        ),
        Case(
            "probe.by_speed",
            "goes forward",
            LOW,
            (False, True),
            "target height",
            1,
            FIXED | {"probe.stable_speed": 0.3},
        ),
        Case("probe.layers", "standing", RAISED, (NONE, ALL), "target height", 1),
        Case("probe.foot_length", "standing", KINK, (0.25, 0.35), "pitch", 1),
        Case("probe.half_width", "standing", RIGHT_KINK, (0.04, 0.06), "roll", -1),
        Case("target.foot_height", "standing", FLAT, (0.08, 0.12), "target height", 1),
        Case("lock.plant", "drifts slowly", FLAT, (False, True), "slip", -1),
        Case("lock.plant_weight", "drifts slowly", FLAT, (0.2, 0.8), "slip", -1),
        Case(
            "lock.plant_speed",  # planting that was off takes hold sooner
            "drifts slowly",
            FLAT,
            (0.5, 2.0),
            "target left",
            -1,
            before={"lock.plant_weight": 0.0},
        ),
        Case("pelvis.enabled", "standing", LOW, (False, True), "pelvis height", -1),
        Case("pelvis.min_length", "standing", HIGH, (0.45, 0.55), "pelvis height", 1),
        Case("pelvis.max_length", "standing", LOW, (0.8, 0.85), "pelvis height", 1),
        Case("pelvis.damp", "goes forward", DESCENT, (False, True), "pelvis height", 1, FREE),
        Case("pelvis.speed", "goes forward", DESCENT, (2.0, 6.0), "pelvis height", -1, FREE),
        Case("effector.transition_time", "lifts its feet", FLAT, (0.2, 0.6), "weight", 1),
        Case("leg.hint_offset[0]", "standing", FLAT, ((0, 0, 0), ASIDE), "knee left", 1),
        Case("leg.hint_offset[1]", "standing", FLAT, (ASIDE, (0.1, 0.2, 0)), "knee left", -1),
        Case("leg.hint_offset[2]", "standing", FLAT, (ASIDE, (0.1, 0, 0.2)), "knee left", -1),
        *legs(LOW),
        Case("foot.max_tilt", "standing", planes((0.8, 0, 0)), (0.3, 0.5), "pitch", 1),
    ),
}
# Stages whose numbers have tests of their own: `test_stride_warp`, `test_separation`, `test_fade`.
WIDTHS = ("probe.min_support", "probe.support_radius")  # in `test_narrow_ground`
IN_OWN_TESTS = ("warp.", "separation.", "fade.", *WIDTHS)
# Parameters that no other rule of the system reads; their cases are those of the record.
ALWAYS_STANDING = Case(  # the feet of this contact
    "effector.by_contact", "lifts its feet", RAISED, (False, True), "everything", 0
)
INERT: dict[str, tuple[Case, ...]] = {
    "ozz": (
        Case("probe.use_toe", "standing", KINK, (False, True), "everything", 0),
        Case(
            "probe.toe_ls",
            "standing",
            KINK,
            ((0, -0.07, 0.2), (0, -0.07, 0.3)),
            "everything",
            0,
            {"probe.use_toe": True},
        ),
        Case("pelvis.vertical_only", "standing", ANKLE_DEEP, (False, True), "everything", 0),
        # All feet always stand.
        Case("pelvis.wait_to_rise", "standing", ANKLE_DEEP, (False, True), "everything", 0),
        # Along the ray.
        Case("foot.offset[1]", "standing", KINK, ((0, 0, 0), (0, 0.1, 0)), "everything", 0),
        ALWAYS_STANDING,
    ),
    "unreal": (),
    "mec": (ALWAYS_STANDING,),
}


def listed(cases: dict[str, tuple[Case, ...]]) -> Any:
    each = [(preset, case) for preset in cases for case in cases[preset]]
    names = [f"{preset} {case.name}" for preset, case in each]
    return pytest.mark.parametrize(("preset", "case"), each, ids=names)


SLOPED = {  # limits are alike in all, and each would be a program of its own
    preset: tuple(
        case
        for case in cases
        if has_slope(case, preset) and (preset == "unreal" or "probe.limited" not in case.base)
    )
    for preset, cases in CASES.items()
}


@pytest.mark.parametrize("preset", CASES)
def test_all_numbers_switches_and_masks_of_a_system_have_a_case(preset: str):
    paths = jax.tree_util.tree_leaves_with_path(to_ik({}, preset))
    leaves = {jax.tree_util.keystr(path).removeprefix(".") for path, _ in paths}
    leaves = {leaf for leaf in leaves if not leaf.startswith(IN_OWN_TESTS)}
    assert {case.leaf for case in CASES[preset] + INERT[preset]} == leaves


@pytest.mark.slow
@listed(CASES)
def test_a_leaf_has_the_expected_effect(preset: str, case: Case):
    assert_effect(case, preset)


@pytest.mark.slow
@listed(INERT)
def test_a_leaf_that_no_rule_reads_changes_nothing(preset: str, case: Case):
    before, after = (run_case(case, value, preset)[0] for value in case.values)
    assert after == pytest.approx(before, abs=1e-9)


@pytest.mark.slow
@listed(SLOPED)
@pytest.mark.parametrize("gate", [HARD, Smooth(1.0)], ids=["hard", "smooth"])
def test_the_derivative_of_a_number_is_its_difference_quotient(preset: str, case: Case, gate: Any):
    assert_slope(case, preset, gate)
