"""Contact of the `stride` and `record` references by height and speed, with hysteresis."""

from dataclasses import dataclass
from typing import Any

from reference import maths
from reference.characters import Frame, Parameters
from reference.maths import lerp

DEFAULTS: dict[str, Any] = {
    "contact.ground_height": 0.0,
    "contact.planted_height": 0.075,
    "contact.raised_height": 0.10,
    "contact.planted_speed": 0.25,
    "contact.raised_speed": 0.50,
    "contact.half_life": 0.0,
}


@dataclass
class Standing:
    """Contact of one foot: whether it stands, and the smoothed weight of that."""

    standing: bool
    weight: float


def stand(parameters: Parameters, frame: Frame, leg: int, before: Standing | None) -> Standing:
    """A foot stands once its toe is low and slow, until it is high or fast."""
    height = frame.toe.pos[leg][1] - parameters.of_leg("contact.ground_height", leg)
    speed = frame.toe_speed[leg]
    is_planted = height <= parameters.of_leg(
        "contact.planted_height", leg
    ) and speed <= parameters.of_leg("contact.planted_speed", leg)
    is_lifted = height > parameters.of_leg(
        "contact.raised_height", leg
    ) or speed > parameters.of_leg("contact.raised_speed", leg)
    if is_lifted:
        stands = False
    elif is_planted or before is None:
        stands = is_planted
    else:
        stands = before.standing
    if before is None:
        return Standing(stands, float(stands))
    fraction = maths.fraction_of_half_life(parameters.of_leg("contact.half_life", leg), frame.dt)
    return Standing(stands, lerp(before.weight, float(stands), fraction))
