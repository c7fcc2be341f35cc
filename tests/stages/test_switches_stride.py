"""Effects of all numbers, switches and masks of `stride` and of rules that can replace its own."""

import functools

import jax
import pytest
from test_stages import FEET, LOCKED, LOCKS, LOOSE, TARGETS

from support import singular
from support.cases import (
    ALL,
    KINK,
    NONE,
    RAMP_DOWN,
    RAMP_UP,
    Case,
    outcomes_of,
    system,
    tilted,
)

BENDS = {"leg.as_animated": False, "effector.max_lift": 0.0}
WIDE = {"probe.way_slope": 0.5}  # ground beside an edge counts
EAGER = {  # a root that stands while the feet walk
    "contact.planted_speed": 1.0,
    "contact.raised_speed": 1.5,
}
ANIMATED = {"probe.swing_as_animated": True}
STEP_UP = tilted((0, 0, 0), (1.0, 0, -0.25))  # rises 0.2 m ahead of the ankles
STEP_DOWN = tilted((0, 0, 0), (-1.0, 0, 0.15))  # falls until 0.1 m ahead of the ankles
# Rise or fall by 0.2 m between one ray and the next on the way of a swinging foot.
STAIRS_UP, STAIRS_DOWN = tilted((0, 0, 0), (2.0, 0, -0.8)), tilted((0, 0, 0), (-2.0, 0, 0))
CLIMBS, LOW_STEPS = {"probe.max_slope": 1.3}, {"probe.max_step_up": 0.12}
# The left foot higher.
TILTED, STEEP, WALL = tilted((0, 0.4, 0)), tilted((0, 0.9, 0)), tilted((0, 4.0, 0))
BESIDE = tilted((0, 0, 0), (0, 1.0, 0))  # level to the right, steep to the left
BLOCK = tilted((0, 0, 0), (2.0, 0, -1.1))  # too steep for a sole, under the toes that land
LOWERED, RAISED = tilted((0, 0, -0.5)), tilted((0, 0, 0.1))
PREDICTED = "swings, footholds unknown"
LANDS = functools.partial(Case, clip="comes down")
LIFTS = functools.partial(Case, clip="lifts off")
WALKS = functools.partial(Case, clip="goes forward")


def followed(**base: float) -> tuple[Case, ...]:
    """Cases of how the pelvis follows its goal."""
    eased = base | {"pelvis.rise_half_life": 0.2}
    return (
        WALKS("pelvis.rise_half_life", (0.05, 0.2), "- pelvis height", RAMP_UP, base),
        WALKS("pelvis.fall_half_life", (0.05, 0.2), "+ pelvis height", RAMP_DOWN, base),
        WALKS("pelvis.spring", (False, True), "- pelvis height", RAMP_UP, eased),
    )


CASES: dict[str, tuple[Case, ...]] = {
    "stride": (
        *TARGETS,
        *LOCKS,
        *FEET,
        *followed(),
        Case("contact.ground_height", (0.0, 0.01), "- target height"),
        Case("probe.ray_up", (0.2, 0.6), "+ target height", tilted((0, 0, 0.4)), slope=False),
        Case("probe.ray_down", (0.3, 0.8), "- target height", LOWERED, slope=False),
        Case("probe.layers", (NONE, ALL), "+ target height", RAISED),
        LANDS("probe.rise_start", (0.0, 0.3), "- target height", STEP_UP),
        LANDS("probe.rise_end", (0.8, 1.0), "- target height", STEP_UP),
        LANDS("probe.steepness", (1.0, 2.0), "+ target height", STEP_UP),
        LANDS("probe.max_step_up", (0.12, 0.18), "+ target height", STAIRS_UP, CLIMBS),
        LANDS("probe.max_step_down", (0.12, 0.18), "- target height", STAIRS_DOWN, CLIMBS),
        LANDS("probe.step_fade", (0.1, 0.2), "+ target height", STAIRS_UP, CLIMBS | LOW_STEPS),
        LANDS("probe.max_slope", (0.3, 0.36), "+ target height", tilted((0.4, 0, 0))),
        LIFTS("probe.clearance", (0.0, 0.05), "+ target height", STEP_UP, WIDE),
        LIFTS("probe.way_slope", (0.5, 1.0), "- target height", STEP_UP),
        LANDS("probe.heel_length", (0.05, 0.09), "+ target height", STEP_DOWN, ANIMATED),
        LIFTS("probe.toe_length", (0.03, 0.06), "+ target height", STEP_UP, ANIMATED | WIDE),
        LIFTS("probe.held_lift", (0.3, 0.6), "- target height", STEP_DOWN),
        LANDS("probe.toe_clearance", (0.02, 0.04), "+ target height", STEP_UP),
        LANDS("probe.lift_per_rise", (0.3, 0.5), "+ target height", STEP_UP),
        LIFTS("probe.lift_per_fall", (0.3, 0.5), "+ target height", STEP_DOWN),
        LIFTS("probe.toes_up", (0.1, 0.2), "- target height", STEP_DOWN),
        LANDS("probe.toes_down", (0.1, 0.2), "+ target height", STEP_UP),
        LANDS("probe.toes_down_per_height", (0.5, 0.9), "+ target height", STEP_UP),
        Case("probe.toes_first", (0.4, 0.8), "- pitch", BESIDE, clip="toes up"),
        LANDS("probe.min_sole", (0.4, 0.8), "- target forward", BLOCK),
        LANDS("probe.max_slide", (0.08, 0.12), "- target forward", BLOCK),
        LANDS("probe.swing_as_animated", (False, True), "- target height", STEP_UP),
        LANDS("probe.use_strides", (False, True), "+ target height", STEP_UP),
        LIFTS("probe.ball_height", (0.03, 0.06), "+ target height", STEP_UP, WIDE),
        Case("probe.stance_time", (0.5, 0.7), "+ target height", KINK, clip=PREDICTED),
        Case("probe.swing_time", (0.3, 0.5), "+ target height", KINK, clip=PREDICTED),
        Case("lock.hold_ball", (False, True), "- ball slip", base=LOCKED, clip="walks"),
        Case("pelvis.highest_share", (0.3, 0.8), "+ pelvis height", TILTED),
        Case("pelvis.extension", (0.92, 0.95), "+ pelvis height", TILTED),
        Case("pelvis.shift", (0.1, 0.3), "- pelvis forward", STEP_UP, clip="walks"),
        Case("pelvis.softness", (0.01, 0.05), "+ pelvis height", TILTED),
        LIFTS("effector.by_contact", (False, True), "+ miss", TILTED),
        Case("effector.extension", (0.92, 0.95), "+ pitch", STEEP),
        Case("effector.max_lift", (0.05, 0.15), "- pitch", STEEP, {"effector.extension": 0.92}),
        Case("leg.max_knee_angle", (2.6, 2.8), "+ knee angle", STEEP, BENDS),
        Case("leg.min_knee_angle", (0.9, 1.2), "+ knee angle", WALL),
        Case("leg.soften", (0.85, 0.95), "+ knee angle", STEEP, BENDS),
        Case("leg.as_animated", (False, True), "+ knee angle", clip="walks"),
        Case("leg.twist", (0.0, 0.2), "- knee left"),
        Case("leg.weight", (0.3, 0.8), "- miss", TILTED),
    ),
    "by speed": (
        *followed(**EAGER),
        Case("contact.ground_height", (0.0, 0.01), "- target height"),
        Case("contact.planted_height", (0.05, 0.08), "+ locked", base=LOOSE, clip="hovering"),
        Case("contact.raised_height", (0.08, 0.11), "+ locked", base=LOOSE, clip="rises slowly"),
        Case("contact.planted_speed", (0.2, 0.45), "+ locked", base=LOOSE, clip="drifts"),
        Case("contact.raised_speed", (0.3, 0.6), "+ locked", base=LOOSE, clip="speeds up"),
        Case("contact.half_life", (0.05, 0.2), "+ contact", clip="speeds up"),
        Case("pelvis.lowest_share", (0.2, 0.8), "- pelvis height", TILTED),
    ),
}
# Stages whose numbers have tests of their own, as in `test_switches`; `test_spine_lean` is another.
WIDTHS = ("probe.min_support", "probe.support_radius")  # in `test_limits`
OVER = "probe.lift_over"  # in `test_stride_probe`, as planes make no hurdle
CONSTANTS = ("probe.uneven_height", "probe.highest_step")
IN_OWN_TESTS = ("warp.", "lean.", "separation.", "fade.", *WIDTHS, OVER, *CONSTANTS)


@functools.cache
def outcomes(name: str):
    return outcomes_of(CASES[name], system(name))


@pytest.mark.parametrize(
    ("name", "stages"),
    [("stride", ("",)), ("by speed", ("contact.", "pelvis."))],
    ids=["stride", "the other contact and pelvis"],
)
def test_all_numbers_switches_and_masks_have_a_case(name: str, stages: tuple[str, ...]):
    paths = jax.tree_util.tree_leaves_with_path(system(name))
    leaves = {jax.tree_util.keystr(path).removeprefix(".") for path, _ in paths}
    leaves = {leaf for leaf in leaves if not leaf.startswith(IN_OWN_TESTS)}
    expected = {leaf for leaf in leaves if leaf.startswith(stages)}
    assert {case.leaf for case in CASES[name]} == expected


@pytest.mark.parametrize("name", CASES)
def test_each_leaf_has_the_expected_effect(name: str):
    assert not outcomes_of(CASES[name], system(name), sloped=False).without_effect()


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_the_derivative_of_each_number_is_its_difference_quotient(name: str):
    assert not outcomes(name).with_wrong_slope()


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_values_and_derivatives_are_finite_where_formulas_are_singular(name: str):
    singular.assert_sound(name)
