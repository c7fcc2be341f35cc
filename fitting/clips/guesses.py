"""What a file does not state: its unit of length, doubts about a stated one, and balls of feet.

The unit follows from the length of the legs, from hip to ankle, which is half of the body's height.
Legs of adults are 0.6 to 1.1 m, those of children 0.4 m at three years.

Where feet end at the ankle, the ball is put where that of a person's foot is. The two proportions
are about the means of ten feet of five captured people: in these the ball is 0.13 to 0.16 of the
leg's length from the ankle, and 0.16 to 0.44 of that distance below it while the foot lies flat.
"""

from dataclasses import replace

import numpy as np

from jaxik.world.body import LEG

from . import contacts, rigs
from .clip import INCH, Recording, world_from_local
from .joint_maps import Roles
from .rigs import USUAL_FOOT, left_directions, leg_motion, relative_size

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

USUAL_DROP = 0.3  # of a foot's length, from ankle to ball, that the ball is below the ankle


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


def with_balls(
    recording: Recording, roles: Roles, fps: float
) -> tuple[Recording, Roles, tuple[str, ...]]:
    """The recording with a joint at the ball of each foot that ends at the ankle, and remarks.

    The joint is named as an end of a bone, `<ankle>_end`. While the foot stands, it points where
    the pelvis does.

    Args:
        recording: m, y up.
        roles: which joint is which.
        fps: frames per second.
    """
    legs, remarks = [], []
    for leg in roles.legs:
        if leg.ends_at_ankle:
            ball_ls, length = _ball(recording, roles, len(legs), fps)
            hip, knee, ankle, _ = leg.joints
            name = recording.names[ankle]
            leg = replace(leg, joints=(hip, knee, ankle, len(recording.names)))
            recording = _with_end(recording, ankle, ball_ls)
            remarks.append(
                f"the {leg.name} foot ends at {name}; its ball is taken to be {length:.3f} m from "
                f"it, {100 * USUAL_FOOT:.0f} % of the leg (people's are 13 to 16 %), where the "
                "pelvis points: a rough guess, so export the toe if there is one"
            )
        legs.append(leg)
    return recording, replace(roles, legs=tuple(legs)), tuple(remarks)


def _ball(recording: Recording, roles: Roles, index: int, fps: float) -> tuple[np.ndarray, float]:
    """Where the ball of a foot is, m, in the space of its ankle, and how far from it, m."""
    positions_ws, rotations_ws = world_from_local(
        recording.parents, recording.positions_ls, recording.rotations_ls
    )
    legs = [leg.joints for leg in roles.legs]
    left_ws = left_directions(
        positions_ws[:, [joints[0] for joints in legs]],
        np.array([leg.side for leg in roles.legs]),
        rotations_ws[:, roles.pelvis],
    )
    leg = leg_motion(roles.legs[index], left_ws, positions_ws, rotations_ws)
    size = relative_size(positions_ws, legs)
    stance = contacts.detect_stances(leg.ankle[:, None], fps, size)[:, 0]
    ankle_from_foot = rigs.foot_axes(leg, rigs.flat_frames(leg.ankle, leg.ankle, stance))
    bones = ((leg.hip, leg.knee), (leg.knee, leg.ankle))
    length = USUAL_FOOT * sum(
        float(np.median(np.linalg.norm(end - start, axis=-1))) for start, end in bones
    )
    ahead = [0.0, -USUAL_DROP, np.sqrt(1.0 - USUAL_DROP**2)]
    return length * rigs.rotation(ankle_from_foot).apply(ahead), length


def _with_end(recording: Recording, joint: int, offset_ls: np.ndarray) -> Recording:
    """The recording with one more joint, rigidly below another one."""
    name = f"{recording.names[joint]}_end"
    while name in recording.names:
        name += "_"
    frames, still = len(recording.positions_ls), [1.0, 0.0, 0.0, 0.0]
    rest, channels = recording.rest_rotations_ls, recording.channels
    return replace(
        recording,
        names=(*recording.names, name),
        parents=(*recording.parents, joint),
        offsets_ls=np.concatenate([recording.offsets_ls, [offset_ls]]),
        positions_ls=np.concatenate(
            [recording.positions_ls, np.tile(offset_ls, (frames, 1, 1))], axis=1
        ),
        rotations_ls=np.concatenate(
            [recording.rotations_ls, np.tile(still, (frames, 1, 1))], axis=1
        ),
        rest_rotations_ls=None if rest is None else np.concatenate([rest, [still]]),
        channels=None if channels is None else (*channels, ""),
    )
