"""Effects of all parameters and switches of the record, and their derivatives."""

import functools

from jaxik import presets
from jaxik import record as game
from jaxik.maths import parameter_tree
from support import singular
from support.cases import ANKLE_DEEP, KINK, RAMP_DOWN, RAMP_UP, Case, outcomes_of, tilted
from support.clips import to_ik

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


def toe(x: float = 0.0, y: float = -0.07, z: float = 0.20) -> tuple[float, float, float]:
    return x, y, z


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
CASES = (
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
    WALKS("lean.gain", (0.05, 0.3), "- lean forward", RAMP_UP, LEANS),
    Case("lean.gain_slide", (0.05, 0.3), "- lean forward", RAMP_UP, clip="slides forward"),
    Case("lean.slide_on_gain", (0.05, 0.3), "- lean forward", AHEAD, clip="begins to slide"),
    Case("lean.slide_off_gain", (0.05, 0.3), "+ lean forward", AHEAD, clip="ceases to slide"),
    WALKS("lean.tick_hz", (30.0, 60.0), "- lean forward", RAMP_UP, LEANS),
    WALKS("lean.spring", (False, True), "+ lean forward", LATE, LEANS),
    Case("lock.hold_ball", (False, True), "- ball slip", base=LOOSE | HEEL_UP, clip="walks"),
    Case("pelvis.limit", (0.1, 0.2), "- pelvis height", DEEP),
    WALKS("pelvis.on_gain", (0.1, 0.3), "+ pelvis height", RAMP_UP, NO_LOCK),
    Case("pelvis.off_gain", (0.05, 0.2), "+ pelvis height", BELOW, clip="lifts its feet"),
    WALKS("pelvis.tick_hz", (30.0, 60.0), "+ pelvis height", RAMP_UP, NO_LOCK),
    Case("pelvis.vertical_only", (False, True), "- pelvis forward", tilted((0.3, 0, -0.2))),
    Case("pelvis.wait_to_rise", (False, True), "- pelvis height", RAMP_DOWN, clip="walks"),
    Case("leg.max_knee_angle", (2.6, 2.8), "+ knee angle", BELOW, STIFF),
    Case("leg.min_knee_angle", (0.9, 1.2), "+ knee angle", HIGH, STIFF | REACHES_UP),
    Case("leg.soften", (0.85, 0.95), "+ knee angle", BELOW, STIFF),
    Case("leg.twist", (0.0, 0.2), "- knee left"),
    Case("leg.weight", (0.3, 0.8), "- miss", tilted((0, 0, 0.1)), STIFF),
    Case("leg.as_animated", (False, True), "+ knee angle", clip="walks"),
)


@functools.cache
def outcomes():
    return outcomes_of(CASES, to_ik({}))


def test_all_fields_of_the_record_and_all_parameters_have_a_case():
    ik = presets.record(faithful=True)
    fields = {ours for _, _, ours in game.FLAGS}
    assert {case.name for case in CASES} >= {ours for _, ours, _ in game.FLOATS} | fields
    rules = {case.leaf for case in CASES if not case.is_sloped(ik)} - fields
    assert not any(bool(parameter_tree.get(ik, rule)) for rule in rules), "off by default"
    # These clips tell no scale of strides, nothing fades and no ground is refused:
    # `test_stride_warp`, `test_fade` and `test_limits` have those that do.
    own = ("warp.", "fade.", "probe.max_", "probe.min_support", "probe.support_radius")
    declared = {name for name in parameter_tree.declarations(ik) if not name.startswith(own)}
    declared |= {"lean.tick_hz", "pelvis.tick_hz"}
    assert {case.leaf for case in CASES} == declared | fields | rules


def test_each_parameter_has_the_expected_effect():
    assert not outcomes().without_effect()


def test_the_derivative_of_each_parameter_is_its_difference_quotient():
    assert not outcomes().with_wrong_slope()


def test_derivatives_of_animation_and_terrain_are_right_and_finite_where_formulas_are_singular():
    singular.assert_sound("record", limps=True)
