"""What a clip would have to show to determine a parameter, in words."""

import math

from fitting.inference.profiles.profile import Profile
from fitting.problem.free_parameters import FreeParameter

# What goes beyond a limit; in brackets by how much, where the clip shows to which value the limit
# does not act yet. Angles of feet are against their shins, which lean as well as the ground.
AT_LIMITS = {
    "foot.max_pitch": "a foot turned toes up[ beyond {}] against its shin, as on a slope up",
    "foot.min_pitch": "a foot turned toes down[ beyond {}] against its shin, as on a way down",
    "foot.max_roll": "a foot turned outer edge up[ beyond {}], as on a slope across the way",
    "foot.min_roll": "a foot turned outer edge down[ beyond {}], as on a slope across the way",
    "foot.max_tilt": "ground[ steeper than {}] under a foot",
    "pelvis.limit": "steps or slopes that move the pelvis up or down[ by more than {}]",
    "pelvis.max_length": "a leg stretched[ beyond {}] from hip to ankle, as on a step down",
    "pelvis.min_length": "a leg shortened[ below {}] from hip to ankle, as in a crouch",
    "leg.max_knee_angle": "a leg stretched[ beyond a knee angle of {}], as at the end of a stride",
    "leg.min_knee_angle": "a knee bent[ below {}], as on a high step or in a crouch",
    "lock.release_distance": "a locked foot that its animation carries away[ by more than {}]",
    "lock.max_speed": "a foot that comes down[ faster than {}]",
    "probe.max_step_up": "steps up[ higher than {}]",
    "probe.max_step_down": "steps down[ deeper than {}]",
    "probe.max_slope": "slopes[ steeper than {}]",
}
EVENTS = {  # what must happen at all
    "pelvis.off_gain": "a run: moments without a foot on the ground",
    "lock.lock_half_life": "steps: feet that still move when they lock",
    "lock.unlock_half_life": "steps: locked feet that are released away from their animation",
    "target.rise_half_life": "steps or slopes up: ground that becomes higher",
    "target.fall_half_life": "steps or slopes down: ground that becomes lower",
    "lean.forward_rate": "a slope along the way",
    "lean.side_rate": "a slope across the way",
    "contact.planted_height": "steps: feet that come down to the ground",
    "contact.raised_height": "steps: feet that leave the ground",
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
    if leaf in AT_LIMITS:
        is_lowest = leaf.rpartition(".")[2].startswith("min_")
        unpassed, unbounded = (high, "at most") if is_lowest else (low, "at least")
        reached = profile.verdict == unbounded
        return _filled(AT_LIMITS[leaf], _with_unit(abs(unpassed), unit) if reached else None)
    if leaf in EVENTS:
        return EVENTS[leaf]
    if active is not None:
        frames = f"it acts in {100 * active:.1f} % of the frames"
        return f"motion that reaches this limit ({frames}): {doc}"
    return f"not known; what it does: {doc}"


def _filled(phrase: str, figure: str | None) -> str:
    """The phrase with the figure in its brackets, or without them."""
    before, _, rest = phrase.partition("[")
    bound, _, after = rest.partition("]")
    return before + ("" if figure is None else bound.format(figure)) + after


def _with_unit(value: float, unit: str) -> str:
    if unit == "rad":
        return f"{math.degrees(value):.0f}°"
    return f"{value:.3g}" + ("" if unit == "1" else f" {unit}")
