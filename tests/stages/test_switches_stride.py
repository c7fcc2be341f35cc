"""Effects of all numbers, switches and masks of `stride` and of rules that can replace its own."""

from typing import Any

import jax
import pytest

from jaxik import HARD, Smooth
from support.cases import (
    KINK,
    RAMP_DOWN,
    RAMP_UP,
    Case,
    assert_effect,
    assert_slope,
    has_slope,
)
from support.clips import FLAT, planes, to_ik

pytestmark = pytest.mark.slow

NONE, ALL = 0xFFFFFFFE, 0xFFFFFFFF  # masks without and with the layer of the planes
LOCKS = {"lock.enabled": True}
LOOSE = LOCKS | {  # nothing releases a lock except what a case sets
    "lock.release_distance": 9.0,
    "lock.release_cone": 1.5,
    "lock.release_max_angle": 3.1415926536,
    "lock.release_min_angle": 0.0,
}
BENDS = {"leg.as_animated": False}
RIGID = {"effector.max_lift": 0.0}
WIDE = {"probe.way_slope": 0.5}  # ground beside an edge counts
EAGER = {
    "contact.planted_speed": 1.0,
    "contact.raised_speed": 1.5,
}  # a root that stands while the feet walk
ANIMATED = {"probe.swing_as_animated": True}
UPHILL = planes((0.4, 0, 0))
STEP_UP = planes((0, 0, 0), (1.0, 0, -0.25))  # rises 0.2 m ahead of the ankles
STEP_DOWN = planes((0, 0, 0), (-1.0, 0, 0.15))  # falls until 0.1 m ahead of the ankles
# Rise or fall by 0.2 m between one ray and the next on the way of a swinging foot.
STAIRS_UP, STAIRS_DOWN = planes((0, 0, 0), (2.0, 0, -0.8)), planes((0, 0, 0), (-2.0, 0, 0))
CLIMBS = {"probe.max_slope": 1.3}  # as steep as these are
TILTED, STEEP, WALL = (planes((0, left, 0)) for left in (0.4, 0.9, 4.0))  # the left foot higher
BESIDE = planes((0, 0, 0), (0, 1.0, 0))  # level to the right, steep to the left
BLOCK = planes((0, 0, 0), (2.0, 0, -1.1))  # too steep for a sole, under the toes that land
LOWERED, RAISED = planes((0, 0, -0.5)), planes((0, 0, 0.1))


def followed(**base: Any) -> tuple[Case, ...]:
    """Cases of how the pelvis follows its goal."""
    up, down = ("goes forward", RAMP_UP), ("goes forward", RAMP_DOWN)
    eased = base | {"pelvis.rise_half_life": 0.2}
    return (
        Case("pelvis.rise_half_life", *up, (0.05, 0.2), "pelvis height", -1, base),
        Case("pelvis.fall_half_life", *down, (0.05, 0.2), "pelvis height", 1, base),
        Case("pelvis.spring", *up, (False, True), "pelvis height", -1, eased),
    )


CASES: dict[str, tuple[Case, ...]] = {
    "stride": (
        Case("contact.ground_height", "standing", FLAT, (0.0, 0.01), "target height", -1),
        Case(
            "probe.ray_up",
            "standing",
            planes((0, 0, 0.4)),
            (0.2, 0.6),
            "target height",
            1,
            slope=False,
        ),
        Case("probe.ray_down", "standing", LOWERED, (0.3, 0.8), "target height", -1, slope=False),
        Case("probe.layers", "standing", RAISED, (NONE, ALL), "target height", 1),
        Case("probe.rise_start", "comes down", STEP_UP, (0.0, 0.3), "target height", -1),
        Case("probe.rise_end", "comes down", STEP_UP, (0.8, 1.0), "target height", -1),
        Case("probe.steepness", "comes down", STEP_UP, (1.0, 2.0), "target height", 1),
        Case(
            "probe.max_step_up", "comes down", STAIRS_UP, (0.12, 0.18), "target height", 1, CLIMBS
        ),
        Case(
            "probe.max_step_down",
            "comes down",
            STAIRS_DOWN,
            (0.12, 0.18),
            "target height",
            -1,
            CLIMBS,
        ),
        Case(
            "probe.step_fade",
            "comes down",
            STAIRS_UP,
            (0.1, 0.2),
            "target height",
            1,
            CLIMBS | {"probe.max_step_up": 0.12},
        ),
        Case("probe.max_slope", "comes down", UPHILL, (0.3, 0.36), "target height", 1),
        Case("probe.clearance", "lifts off", STEP_UP, (0.0, 0.05), "target height", 1, WIDE),
        Case("probe.way_slope", "lifts off", STEP_UP, (0.5, 1.0), "target height", -1),
        Case(
            "probe.heel_length", "comes down", STEP_DOWN, (0.05, 0.09), "target height", 1, ANIMATED
        ),
        Case(
            "probe.toe_length",
            "lifts off",
            STEP_UP,
            (0.03, 0.06),
            "target height",
            1,
            ANIMATED | WIDE,
        ),
        Case("probe.held_lift", "lifts off", STEP_DOWN, (0.3, 0.6), "target height", -1),
        Case("probe.toe_clearance", "comes down", STEP_UP, (0.02, 0.04), "target height", 1),
        Case("probe.lift_per_rise", "comes down", STEP_UP, (0.3, 0.5), "target height", 1),
        Case("probe.lift_per_fall", "lifts off", STEP_DOWN, (0.3, 0.5), "target height", 1),
        Case("probe.toes_up", "lifts off", STEP_DOWN, (0.1, 0.2), "target height", -1),
        Case("probe.toes_down", "comes down", STEP_UP, (0.1, 0.2), "target height", 1),
        Case("probe.toes_down_per_height", "comes down", STEP_UP, (0.5, 0.9), "target height", 1),
        Case("probe.toes_first", "toes up", BESIDE, (0.4, 0.8), "pitch", -1),
        Case("probe.min_sole", "comes down", BLOCK, (0.4, 0.8), "target forward", -1),
        Case("probe.max_slide", "comes down", BLOCK, (0.08, 0.12), "target forward", -1),
        Case("probe.swing_as_animated", "comes down", STEP_UP, (False, True), "target height", -1),
        Case("probe.use_strides", "comes down", STEP_UP, (False, True), "target height", 1),
        Case("probe.ball_height", "lifts off", STEP_UP, (0.03, 0.06), "target height", 1, WIDE),
        Case(
            "probe.stance_time", "swings, footholds unknown", KINK, (0.5, 0.7), "target height", 1
        ),
        Case("probe.swing_time", "swings, footholds unknown", KINK, (0.3, 0.5), "target height", 1),
        Case("target.min_ankle_height", "standing", LOWERED, (-0.3, -0.2), "target height", 1),
        Case(
            "target.max_ankle_height",
            "standing",
            planes((0, 0, 0.45)),
            (0.4, 0.45),
            "target height",
            1,
        ),
        Case(
            "target.foot_height", "standing", planes((0.5, 0, 0)), (0.05, 0.1), "target height", 1
        ),
        Case("target.max_slope", "standing", planes((1.0, 0, 0)), (0.3, 0.6), "target height", 1),
        Case(
            "target.rise_half_life",
            "goes forward",
            RAMP_UP,
            (0.05, 0.2),
            "target height",
            -1,
        ),
        Case(
            "target.fall_half_life",
            "goes forward",
            RAMP_DOWN,
            (0.05, 0.2),
            "target height",
            1,
        ),
        Case(
            "target.spring",
            "goes forward",
            RAMP_UP,
            (False, True),
            "target height",
            -1,
            {"target.rise_half_life": 0.2},
        ),
        Case(
            "target.follow_slopes",
            "goes forward",
            RAMP_UP,
            (False, True),
            "target height",
            1,
            {"target.rise_half_life": 0.2},
        ),
        Case("lock.enabled", "drifts", FLAT, (False, True), "slip", -1),
        Case("lock.hold_ball", "walks", FLAT, (False, True), "ball slip", -1, LOCKS),
        Case("lock.release_min_angle", "sinks", FLAT, (1.2, 1.6), "locked", -1, LOOSE),
        Case("lock.release_max_angle", "drifts", FLAT, (2.5, 2.8), "locked", 1, LOOSE),
        Case("lock.release_cone", "drifts", FLAT, (0.1, 0.3), "locked", 1, LOOSE),
        Case("lock.release_distance", "drifts", FLAT, (0.05, 0.15), "locked", 1, LOCKS),
        Case("lock.release_heading", "turns", FLAT, (0.2, 0.5), "locked", 1, LOOSE),
        Case("lock.release_speed", "speeds up", FLAT, (0.2, 0.4), "locked", 1, LOOSE),
        Case(
            "lock.relock_threshold",
            "drifts",
            FLAT,
            (0.1, 0.5),
            "locked",
            1,
            LOCKS | {"lock.release_distance": 0.05},
        ),
        Case("lock.max_speed", "drifts", FLAT, (0.2, 0.4), "locked", 1, LOCKS),
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
        Case("lock.lock_half_life", "drifts", FLAT, (0.02, 0.1), "offset", -1, LOOSE),
        Case(
            "lock.unlock_half_life",
            "drifts",
            FLAT,
            (0.05, 0.2),
            "offset",
            1,
            LOCKS | {"lock.release_distance": 0.05, "lock.relock_threshold": 0.0},
        ),
        Case("pelvis.highest_share", "standing", TILTED, (0.3, 0.8), "pelvis height", 1),
        Case("pelvis.extension", "standing", TILTED, (0.92, 0.95), "pelvis height", 1),
        Case("pelvis.shift", "walks", STEP_UP, (0.1, 0.3), "pelvis forward", -1),
        Case("pelvis.softness", "standing", TILTED, (0.01, 0.05), "pelvis height", 1),
        *followed(),
        Case("effector.by_contact", "lifts off", TILTED, (False, True), "miss", 1),
        Case("effector.extension", "standing", STEEP, (0.92, 0.95), "pitch", 1),
        Case(
            "effector.max_lift",
            "standing",
            STEEP,
            (0.05, 0.15),
            "pitch",
            -1,
            {"effector.extension": 0.92},
        ),
        Case("leg.max_knee_angle", "standing", STEEP, (2.6, 2.8), "knee angle", 1, BENDS | RIGID),
        Case("leg.min_knee_angle", "standing", WALL, (0.9, 1.2), "knee angle", 1),
        Case("leg.soften", "standing", STEEP, (0.85, 0.95), "knee angle", 1, BENDS | RIGID),
        Case("leg.as_animated", "walks", FLAT, (False, True), "knee angle", 1),
        Case("leg.twist", "standing", FLAT, (0.0, 0.2), "knee left", -1),
        Case("leg.weight", "standing", TILTED, (0.3, 0.8), "miss", -1),
        Case("foot.max_pitch", "standing", planes((0.8, 0, 0)), (0.5, 0.7), "pitch", 1),
        Case("foot.min_pitch", "standing", planes((-0.8, 0, 0)), (-0.4, -0.2), "pitch", 1),
        Case("foot.max_roll", "standing", planes((0, 0.8, 0)), (0.2, 0.4), "left roll", 1),
        Case("foot.min_roll", "standing", planes((0, -0.8, 0)), (-0.4, -0.2), "left roll", 1),
    ),
    "by speed": (
        Case("contact.ground_height", "standing", FLAT, (0.0, 0.01), "target height", -1),
        Case("contact.planted_height", "hovering", FLAT, (0.05, 0.08), "locked", 1, LOOSE),
        Case(
            "contact.raised_height", "lifts its feet slowly", FLAT, (0.08, 0.11), "locked", 1, LOOSE
        ),
        Case("contact.planted_speed", "drifts", FLAT, (0.2, 0.45), "locked", 1, LOOSE),
        Case("contact.raised_speed", "speeds up", FLAT, (0.3, 0.6), "locked", 1, LOOSE),
        Case("contact.half_life", "speeds up", FLAT, (0.05, 0.2), "contact", 1),
        Case("pelvis.lowest_share", "standing", TILTED, (0.2, 0.8), "pelvis height", -1),
        *followed(**EAGER),
    ),
}


def listed(cases: dict[str, tuple[Case, ...]]) -> Any:
    each = [(preset, case) for preset in cases for case in cases[preset]]
    names = [f"{preset} {case.name}" for preset, case in each]
    return pytest.mark.parametrize(("preset", "case"), each, ids=names)


# Stages whose numbers have tests of their own, as in `test_switches`; `test_spine_lean` is another.
WIDTHS = ("probe.min_support", "probe.support_radius")  # in `test_narrow_ground`
OVER = "probe.lift_over"  # in `test_swing`, since planes make no hurdle
CONSTANTS = ("probe.uneven_height", "probe.highest_step")
IN_OWN_TESTS = ("warp.", "lean.", "separation.", "fade.", *WIDTHS, OVER, *CONSTANTS)
SLOPED = {
    preset: tuple(case for case in cases if has_slope(case, preset))
    for preset, cases in CASES.items()
}


@pytest.mark.parametrize(
    ("preset", "stages"),
    [("stride", ("",)), ("by speed", ("contact.", "pelvis."))],
    ids=["stride", "the other contact and pelvis"],
)
def test_all_numbers_switches_and_masks_have_a_case(preset: str, stages: tuple[str, ...]):
    paths = jax.tree_util.tree_leaves_with_path(to_ik({}, preset))
    leaves = {jax.tree_util.keystr(path).removeprefix(".") for path, _ in paths}
    leaves = {leaf for leaf in leaves if not leaf.startswith(IN_OWN_TESTS)}
    expected = {leaf for leaf in leaves if leaf.startswith(stages)}
    assert {case.leaf for case in CASES[preset]} == expected


@listed(CASES)
def test_a_leaf_has_the_expected_effect(preset: str, case: Case):
    assert_effect(case, preset)


@listed(SLOPED)
@pytest.mark.parametrize("gate", [HARD, Smooth(1.0)], ids=["hard", "smooth"])
def test_the_derivative_of_a_number_is_its_difference_quotient(preset: str, case: Case, gate: Any):
    assert_slope(case, preset, gate)
