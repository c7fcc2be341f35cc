"""Effects of all numbers, switches and masks of the record and of `stride`, and derivatives.

Those of rules that can replace rules of `stride`, too.
"""

import functools

import jax
import pytest

from support import cases, singular
from support.cases import ALL, ANKLE_DEEP, KINK, NONE, RAMP_DOWN, RAMP_UP, Case, tilted

NO_LOCK, LOCKED = {"lock.enabled": False}, {"lock.enabled": True}
FREE = {"foot.max_pitch": 1.0}
STIFF = {"pelvis.limit": 0.0}
LOOSE = LOCKED | {  # nothing releases a lock except what a case sets
    "lock.release_distance": 9.0,
    "lock.release_cone": 1.5,
    "lock.release_max_angle": 3.1415926536,
    "lock.release_min_angle": 0.0,
}
HEEL_UP = {  # feet that count as standing until their heels are well up
    "lock.lock_half_life": 0.005,
    "contact.planted_height": 0.15,
    "contact.raised_height": 0.2,
}
RELEASED = LOCKED | {"lock.release_distance": 0.05, "lock.relock_threshold": 0.0}
RETURNS = LOOSE | {
    "lock.release_distance": 0.1,
    "lock.unlock_half_life": 0.0,  # without a limit of its speed an offset would jump
}
REACHES_UP = {"probe.ray_up": 0.7, "target.max_ankle_height": 1.0}
EASED = NO_LOCK | {"target.rise_half_life": 0.2}
LEANS = {"lean.forward_rate": 0.8}
AHEAD, ASIDE = tilted((0.3, 0, 0)), tilted((0, -0.3, 0))  # rise ahead and to the right
DEEP, HIGH = tilted((0, 0, -0.5)), tilted((0, 0, 0.5))
BELOW = tilted((0, 0, -0.3))
LATE = tilted((0, 0, 0), (0.5, 0, -1.2))  # begins to rise where "goes forward" ends
HOVERS = functools.partial(Case, ground=tilted((0.2, 0, 0)), clip="hovering")
WALKS = functools.partial(Case, clip="goes forward")
DRIFTS = functools.partial(Case, clip="drifts")
SOFT = {"leg.soften": 0.98}
BENDS = {"leg.as_animated": False, "effector.max_lift": 0.0}
# A root that stands while the feet walk.
EAGER = {"contact.planted_speed": 1.0, "contact.raised_speed": 1.5}
ANIMATED = {"probe.swing_as_animated": True}
STEP_UP = tilted((0, 0, 0), (1.0, 0, -0.25))  # rises 0.2 m ahead of the ankles
STEP_BESIDE = tilted((0, 0.9, 0), (1.0, 0.9, -0.25))  # where the left foot is higher than both
STEP_DOWN = tilted((0, 0, 0), (-1.0, 0, 0.15))  # falls until 0.1 m ahead of the ankles
# Rise or fall by 0.2 m between one ray and the next on the way of a swinging foot.
STAIRS_UP, STAIRS_DOWN = tilted((0, 0, 0), (2.0, 0, -0.8)), tilted((0, 0, 0), (-2.0, 0, 0))
CLIMBS, LOW_STEPS = {"probe.max_slope": 1.3}, {"probe.max_step_up": 0.12}
# The left foot higher.
TILTED, STEEP, WALL = tilted((0, 0.4, 0)), tilted((0, 0.9, 0)), tilted((0, 4.0, 0))
BESIDE = tilted((0, 0, 0), (0, 1.0, 0))  # level to the right, steep to the left
BLOCK = tilted((0, 0, 0), (2.0, 0, -1.1))  # too steep for a sole, under the toes that land
RAISED = tilted((0, 0, 0.1))
PREDICTED = "swings, footholds unknown"
LANDS = functools.partial(Case, clip="comes down")
LIFTS = functools.partial(Case, clip="lifts off")


def toe(x: float = 0.0, y: float = -0.07, z: float = 0.20) -> tuple[float, float, float]:
    return x, y, z


def followed(**base: float) -> tuple[Case, ...]:
    """Cases of how the pelvis follows its goal."""
    eased = base | {"pelvis.rise_half_life": 0.2}
    return (
        WALKS("pelvis.rise_half_life", (0.05, 0.2), "- pelvis height", RAMP_UP, base),
        WALKS("pelvis.fall_half_life", (0.05, 0.2), "+ pelvis height", RAMP_DOWN, base),
        WALKS("pelvis.spring", (False, True), "- pelvis height", RAMP_UP, eased),
    )


# Of `SlopeTarget`, `OffsetLock` and `PitchRollFoot`, which `stride` has too.
TARGETS = (
    Case("target.min_ankle_height", (-0.3, -0.2), "+ target height", DEEP),
    Case("target.max_ankle_height", (0.4, 0.45), "+ target height", HIGH, {"probe.ray_up": 0.6}),
    Case("target.foot_height", (0.05, 0.1), "+ target height", tilted((0.5, 0, 0))),
    Case("target.max_slope", (0.3, 0.6), "+ target height", tilted((1.0, 0, 0))),
    WALKS("target.rise_half_life", (0.05, 0.2), "- target height", RAMP_UP, NO_LOCK),
    WALKS("target.fall_half_life", (0.05, 0.2), "+ target height", RAMP_DOWN, NO_LOCK),
    WALKS("target.spring", (False, True), "- target height", RAMP_UP, EASED),
    WALKS("target.follow_slopes", (False, True), "+ target height", RAMP_UP, EASED),
    WALKS("target.max_penetration", (0.02, 0.0), "+ target height", RAMP_UP, EASED),
)
LOCKS = (
    DRIFTS("lock.enabled", (False, True), "- slip"),
    Case("lock.release_min_angle", (1.2, 1.6), "- locked", base=LOOSE, clip="sinks"),
    DRIFTS("lock.release_max_angle", (2.5, 2.8), "+ locked", base=LOOSE),
    DRIFTS("lock.release_cone", (0.1, 0.3), "+ locked", base=LOOSE),
    DRIFTS("lock.release_distance", (0.05, 0.15), "+ locked", base=LOCKED),
    Case("lock.release_heading", (0.2, 0.5), "+ locked", base=LOOSE, clip="turns"),
    Case("lock.release_speed", (0.2, 0.4), "+ locked", base=LOOSE, clip="speeds up"),
    DRIFTS("lock.relock_threshold", (0.1, 0.5), "+ locked", base=RELEASED),
    DRIFTS("lock.max_speed", (0.2, 0.4), "+ locked", base=LOCKED),
    DRIFTS("lock.return_speed", (0.02, 0.1), "- offset", base=RELEASED | RETURNS),
    DRIFTS("lock.lock_half_life", (0.02, 0.1), "- offset", base=LOOSE),
    DRIFTS("lock.unlock_half_life", (0.05, 0.2), "+ offset", base=RELEASED),
)
FEET = (
    Case("foot.max_pitch", (0.5, 0.7), "+ pitch", tilted((0.8, 0, 0))),
    Case("foot.min_pitch", (-0.4, -0.2), "+ pitch", tilted((-0.8, 0, 0))),
    Case("foot.max_roll", (0.2, 0.4), "+ left roll", tilted((0, 0.8, 0))),
    Case("foot.min_roll", (-0.4, -0.2), "+ left roll", tilted((0, -0.8, 0))),
)
CASES: dict[str, tuple[Case, ...]] = {
    "record": (
        *TARGETS,
        *LOCKS,
        *FEET,
        Case("contact.ground_height", (0.0, 0.01), "- target height"),
        HOVERS("contact.planted_height", (0.10, 0.12), "+ pitch"),
        HOVERS("contact.raised_height", (0.16, 0.20), "+ pitch"),
        Case("probe.ray_up", (0.1, 0.5), "+ pitch", ANKLE_DEEP, slope=False),
        Case("probe.ray_down", (0.3, 0.8), "+ pitch", tilted((0.2, 0, -0.5)), slope=False),
        Case("probe.toe_ls[0]", (toe(x=-0.02), toe(x=0.02)), "+ left pitch", tilted((0, 0.4, 0))),
        Case("probe.toe_ls[1]", (toe(z=0.3), toe(y=0.03, z=0.3)), "- pitch", KINK, FREE, "toes up"),
        Case("probe.toe_ls[2]", (toe(z=0.25), toe(z=0.30)), "+ pitch", KINK),
        Case("probe.use_toe", (False, True), "+ pitch", KINK, {"probe.toe_ls": toe(z=0.3)}),
        Case("lean.forward_rate", (-0.3, 0.3), "- lean forward", AHEAD),
        Case("lean.side_rate", (-0.3, 0.3), "- lean right", ASIDE),
        Case("lean.forward_rate_slide", (0, 0.8), "- lean forward", AHEAD, clip="sliding"),
        Case("lean.side_rate_slide", (0, 0.8), "- lean right", ASIDE, clip="sliding"),
        WALKS("lean.half_life", (0.06, 0.4), "+ lean forward", RAMP_UP, LEANS),
        Case("lean.half_life_slide", (0.06, 0.4), "+ lean forward", RAMP_UP, clip="slides forward"),
        Case(
            "lean.slide_on_half_life", (0.06, 0.4), "+ lean forward", AHEAD, clip="begins to slide"
        ),
        Case(
            "lean.slide_off_half_life", (0.06, 0.4), "- lean forward", AHEAD, clip="ceases to slide"
        ),
        WALKS("lean.spring", (False, True), "+ lean forward", LATE, LEANS),
        Case("lock.hold_ball", (False, True), "- ball slip", base=LOOSE | HEEL_UP, clip="walks"),
        Case("pelvis.limit", (0.1, 0.2), "- pelvis height", DEEP),
        WALKS("pelvis.half_life", (0.06, 0.2), "- pelvis height", RAMP_UP, NO_LOCK),
        Case(
            "pelvis.airborne_half_life", (0.1, 0.4), "- pelvis height", BELOW, clip="lifts its feet"
        ),
        Case("pelvis.vertical_only", (False, True), "- pelvis forward", tilted((0.3, 0, -0.2))),
        Case("pelvis.wait_to_rise", (False, True), "- pelvis height", RAMP_DOWN, clip="walks"),
        Case("pelvis.min_extension", (0.77, 0.8), "+ pelvis height", STEEP),
        Case("leg.max_knee_angle", (2.6, 2.8), "+ knee angle", BELOW, STIFF),
        Case("leg.min_knee_angle", (0.9, 1.2), "+ knee angle", HIGH, STIFF | REACHES_UP),
        Case("leg.soften", (0.85, 0.95), "+ knee angle", BELOW, STIFF),
        Case("leg.twist", (0.0, 0.2), "- knee left"),
        Case("leg.weight", (0.3, 0.8), "- miss", tilted((0, 0, 0.1)), STIFF),
        Case(
            "leg.as_animated", (False, True), "+ knee angle", tilted((0, 0, 0)), SOFT, clip="walks"
        ),
    ),
    "stride": (
        *TARGETS,
        *LOCKS,
        *FEET,
        *followed(),
        Case("contact.ground_height", (0.0, 0.01), "- target height"),
        Case("probe.ray_up", (0.2, 0.6), "+ target height", tilted((0, 0, 0.4)), slope=False),
        Case("probe.ray_down", (0.3, 0.8), "- target height", DEEP, slope=False),
        Case("probe.layers", (NONE, ALL), "+ target height", RAISED),
        LANDS("probe.rise_start", (0.0, 0.3), "- target height", STEP_UP),
        LANDS("probe.rise_end", (0.8, 1.0), "- target height", STEP_UP),
        LANDS("probe.steepness", (1.0, 2.0), "+ target height", STEP_UP),
        LANDS("probe.max_step_up", (0.12, 0.18), "+ target height", STAIRS_UP, CLIMBS),
        LANDS("probe.max_step_down", (0.12, 0.18), "- target height", STAIRS_DOWN, CLIMBS),
        LANDS("probe.step_fade", (0.1, 0.2), "+ target height", STAIRS_UP, CLIMBS | LOW_STEPS),
        LIFTS("probe.max_slope", (0.33, 0.37), "+ target height", tilted((0.4, 0, 0))),
        LIFTS("probe.held_lift", (0.3, 0.6), "- target height", STEP_DOWN),
        LANDS("probe.toe_clearance", (0.02, 0.04), "+ target height", STEP_UP),
        LANDS("probe.lift_per_rise", (0.3, 0.5), "+ target height", STEP_BESIDE),
        LANDS("probe.lift_ahead", (0.3, 0.8), "+ target height", STEP_UP),
        LIFTS("probe.lift_per_fall", (0.3, 0.5), "+ target height", STEP_DOWN),
        LIFTS("probe.toes_up", (0.1, 0.2), "- target height", STEP_DOWN),
        LANDS("probe.toes_down", (0.1, 0.2), "+ target height", STEP_UP),
        LANDS("probe.toes_down_per_height", (0.5, 0.9), "+ target height", STEP_UP),
        Case("probe.toes_first", (0.4, 0.8), "- pitch", BESIDE, clip="toes up"),
        LANDS("probe.min_sole", (0.4, 0.8), "- target forward", BLOCK),
        LANDS("probe.max_slide", (0.08, 0.12), "- target forward", BLOCK),
        LANDS("probe.swing_as_animated", (False, True), "- target height", STEP_UP),
        LANDS("probe.use_strides", (False, True), "+ target height", STEP_UP),
        LIFTS("probe.ball_height", (0.03, 0.06), "+ target height", STEP_UP),
        Case("probe.stance_time", (0.5, 0.7), "+ target height", KINK, clip=PREDICTED),
        Case("probe.swing_time", (0.3, 0.5), "+ target height", KINK, clip=PREDICTED),
        Case("lock.hold_ball", (False, True), "- ball slip", base=LOCKED, clip="walks"),
        Case("pelvis.highest_share", (0.3, 0.8), "+ pelvis height", TILTED),
        Case("pelvis.extension", (0.92, 0.95), "+ pelvis height", TILTED),
        Case("pelvis.shift", (0.1, 0.3), "- pelvis forward", STEP_UP, clip="walks"),
        Case("pelvis.softness", (0.01, 0.05), "+ pelvis height", TILTED),
        Case("pelvis.rise_speed", (0.05, 0.4), "+ pelvis height", STEP_BESIDE, clip="walks"),
        Case("pelvis.landing_time", (0.1, 0.2), "- pelvis height", RAMP_DOWN, clip="walks"),
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
# In `test_own_rules`, `test_limits`, and `test_switches`, where `ozz` has the record's probe.
WIDTHS = ("probe.min_support", "probe.support_radius")
OVER = "probe.lift_over"  # in `test_stride`, as planes make no hurdle
SOLES = ("probe.clearance", "probe.heel_length", "probe.toe_length")  # likewise
SWITCHES = ("pelvis.enabled", "effector.by_contact", "effector.if_found")  # of `ozz`, too
CONSTANTS = ("probe.uneven_height", "probe.highest_step", "probe.highest_over", "pelvis.most_shift")
OPTIONAL = ("warp.", "leg.max_stretch", "foot.toe_length", "foot.max_toe_", "probe.flight_layers")
OPTIONAL += ("target.max_acceleration",)
IN_OWN_TESTS = {
    "record": (*OPTIONAL, "probe.max_", "probe.step_fade", "probe.layers", *WIDTHS, *SWITCHES),
    "stride": (*OPTIONAL, "lean.", "separation.", *WIDTHS, OVER, *SOLES, *CONSTANTS),
}
STRIDE, SPEED = (pytest.param(name, marks=pytest.mark.slow) for name in ("stride", "by speed"))


@functools.cache
def outcomes(name: str) -> cases.Outcomes:
    return cases.outcomes_of(CASES[name], cases.system(name))


@pytest.mark.parametrize("name", CASES)
def test_all_numbers_switches_and_masks_have_a_case(name: str):
    paths = jax.tree_util.tree_leaves_with_path(cases.system(name))
    leaves = {jax.tree_util.keystr(path).removeprefix(".") for path, _ in paths}
    if name == "by speed":
        expected = {leaf for leaf in leaves if leaf.startswith(("contact.", "pelvis."))}
    else:
        expected = {leaf for leaf in leaves if not leaf.startswith(IN_OWN_TESTS[name])}
    assert {case.leaf for case in CASES[name]} == expected


@pytest.mark.parametrize("name", [pytest.param("record", marks=pytest.mark.slow), STRIDE, SPEED])
def test_each_leaf_has_the_expected_effect(name: str):
    by_value = cases.outcomes_of(CASES[name], cases.system(name), sloped=False)
    assert not by_value.without_effect()


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_the_derivative_of_each_number_is_its_difference_quotient(name: str):
    assert not outcomes(name).with_wrong_slope()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["record", "by speed"])
def test_values_and_derivatives_are_finite_where_formulas_are_singular(name: str):
    singular.assert_sound(name, limps=name == "record")
