"""The unit of length of a file that does not state it, and doubts about one that is stated.

Both go by the length of the legs, from hip to ankle, which is half of the body's height. Legs of
adults are 0.6 to 1.1 m, those of children 0.4 m at three years.
"""

import numpy as np

from fitting.datasets.clips.recording import INCH
from jaxik.world.body import LEG

UNITS = {
    "metres": 1.0,
    "centimetres": 0.01,
    "millimetres": 0.001,
    "inches": INCH,
    "feet": 12 * INCH,
    "ASF units": INCH / 0.45,
}
ADULTS, PEOPLE = (0.6, 1.1), (0.4, 1.1)  # m, legs of adults, and of children too
ADVICE = "give --scale (scale=... in Python) if you know better"
EXPECTED = f"people's are {ADULTS[0]:g} to {ADULTS[1]:g} m, children's from {PEOPLE[0]:g} m"


def guess(leg: float) -> tuple[float, str]:
    """Metres per unit of the file, and a remark that says how sure that is.

    Args:
        leg: length of the legs in units of the file, above 0.
    """
    unit = min(UNITS, key=lambda name: _unlikeness(leg * UNITS[name]))
    metres = leg * UNITS[unit]
    if not ADULTS[0] <= metres <= ADULTS[1]:
        sureness = f"doubtful, as {EXPECTED}; {remedy(leg, UNITS[unit])}"
    elif other := _other_unit(leg, UNITS[unit]):
        sureness = f"not sure, as in {other} they are {leg * UNITS[other]:.3f} m, a child's"
    else:
        sureness = "sure, as in no other usual unit are they a person's"
    text = f"scale guessed: legs of {leg:.4g} units, taken as {unit}, are {metres:.3f} m"
    return UNITS[unit], f"{text}; {sureness}"


def doubt(leg: float, scale: float) -> str:
    """A remark on a scale that a file states and that makes no person of the body; "" for others.

    Args:
        leg: length of the legs in units of the file.
        scale: metres per unit.
    """
    if PEOPLE[0] <= leg * scale <= PEOPLE[1]:
        return ""
    return (
        f"the legs are {leg * scale:.4g} m long by the scale that the file states; doubtful, as "
        f"{EXPECTED}; {remedy(leg, scale)}"
    )


def likelier(leg: float, scale: float) -> float | None:
    """Metres per unit that make legs a person's; None if these do, or if no usual unit does."""
    other = None if PEOPLE[0] <= leg * scale <= PEOPLE[1] else _other_unit(leg, scale)
    return None if other is None else UNITS[other]


def remedy(leg: float, scale: float) -> str:
    """Which scale to give instead of this one, m per unit, for legs of so many units."""
    fitted = f"{LEG / leg:.3g} makes them an adult's, {LEG:g} m"
    if other := _other_unit(leg, scale):
        metres = leg * UNITS[other]
        fitted = f"{UNITS[other]:.4g}, for {other}, makes them {metres:.3f} m" + (
            "" if ADULTS[0] <= metres else f", and {fitted}"
        )
    return f"{ADVICE}: {fitted}"


def _other_unit(leg: float, scale: float) -> str | None:
    """The unit other than this one, m, in which legs so long are most like an adult's.

    None if they are not a person's in any.
    """
    lengths = {name: leg * metres for name, metres in UNITS.items() if metres != scale}
    people = [name for name, metres in lengths.items() if PEOPLE[0] <= metres <= PEOPLE[1]]
    return min(people, key=lambda name: _unlikeness(lengths[name]), default=None)


def _unlikeness(metres: float) -> float:
    return abs(float(np.log(metres / LEG)))
