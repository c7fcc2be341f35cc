"""What a clip would have to show to determine a parameter, in words."""

import math

from fitting.inference.profiles.profile import Profile
from fitting.problem.free_parameters import FreeParameter

LIMITS = ("max_", "min_")
AT_BOUNDS = {  # what goes beyond the values at which a limit does not act yet
    "foot.max_pitch": "a slope steeper than {} that a foot points up",
    "foot.min_pitch": "a slope steeper than {} that a foot points down",
    "foot.max_roll": "a slope across a foot that is steeper than {}",
    "foot.min_roll": "a slope across a foot that is steeper than {}, the other way",
    "foot.max_angle": "a slope steeper than {}",
    "pelvis.limit": "steps or drops that move the pelvis by more than {}",
    "pelvis.max_length": "a leg stretched to more than {}, as on a step down",
    "pelvis.min_length": "a leg shorter than {}, as in a crouch or on a high step",
    "leg.max_knee_angle": "a leg stretched beyond a knee angle of {}, as on a step down",
    "leg.min_knee_angle": "a knee bent beyond {}, as on a high step",
    "lock.release_distance": "a locked foot that its animation carries away by more than {}",
    "lock.max_speed": "feet near the ground at speeds around {}",
    "probe.max_step_up": "steps up higher than {}",
    "probe.max_step_down": "steps down deeper than {}",
    "probe.max_slope": "ground steeper than {}",
}
WITHOUT_BOUND = {  # what must happen at all
    "pelvis.off_gain": "a jump, or anything else without a foot on the ground",
    "lock.lock_half_life": "feet that lock while they are not where they should stand",
    "lock.unlock_half_life": "locked feet that are released away from their animation",
    "target.rise_half_life": "steps up: ground that suddenly is higher",
    "target.fall_half_life": "steps down: ground that suddenly is lower",
    "lean.forward_rate": "a slope along the way",
    "lean.side_rate": "a slope across the way",
    "contact.planted_height": "feet that come down slowly, so that planting late shows",
    "contact.raised_height": "feet that are lifted slowly, so that lifting late shows",
}


def describe_missing_motion(
    parameter: FreeParameter, unit: str, doc: str, profile: Profile, active: float | None
) -> str:
    """What a clip would have to show, with the figure that must be exceeded where there is one.

    Args:
        parameter: one that is not determined.
        unit: of it.
        doc: its declared meaning.
        profile: of it.
        active: for a limit, the fraction of frames in which it changes the pose.
    """
    leaf = parameter.leaf
    low, high = profile.interval
    if profile.verdict == "several valleys":
        places = " or ".join(_with_unit(v.value, unit) for v in profile.valleys)
        return f"motion that differs between {places}; which one is not known"
    if leaf in AT_BOUNDS:
        # The limit acts once motion goes beyond it: what it is at least, motion has not passed.
        upper = not leaf.rpartition(".")[2].startswith("min_")
        beyond = low if upper else high
        if profile.verdict == "flat":
            beyond = parameter.low if upper else parameter.high
        elif profile.verdict == "at most":
            beyond = high
        return AT_BOUNDS[leaf].format(_with_unit(beyond, unit))
    if leaf in WITHOUT_BOUND:
        return WITHOUT_BOUND[leaf]
    if active is not None:
        frames = f"it acts in {100 * active:.1f} % of the frames"
        return f"motion that reaches this limit ({frames}): {doc}"
    return f"not known; what it does: {doc}"


def _with_unit(value: float, unit: str) -> str:
    if unit == "rad":
        return f"{math.degrees(value):.0f}°"
    return f"{value:.3g}" + ("" if unit == "1" else f" {unit}")
