"""Bodies: systems whose numbers were chosen for an adult, for legs of any size.

The defaults of rules are those of an adult of 1.8 m: `LEG`, `ANKLE` and `BALL` say what that means.
Each declaration says what of a body its number follows, and `scale` makes it follow:

leg length            by the ratio r of the legs' length to the adult's
speed, time           by the root of r: bodies of equal shape move alike at equal Froude numbers
                      v² / (g l) (Alexander and Jayes 1983)
ankle height          the height of the ankle over the sole itself; `ball height` likewise
over ankle height     as far over the ankle of a flat foot as the adult's number is, by the ratio of
                      the feet's length: a heel rises by the length of its foot, whatever the leg;
                      `over ball height` likewise

Half-lives, angles and parts of a length follow nothing.

Of a body of the same shape, with legs r times as long, `similar` knows all numbers by their units,
half-lives too: lengths are r, times and speeds root r times as large, and rates the inverse of
that.
"""

import dataclasses
import re
from types import ModuleType
from typing import NamedTuple, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxik.maths import parameter_tree
from jaxik.maths.parameter_tree import Declaration, Follows

from .skeleton import Rig

LEG = 0.84  # m, thigh and shin of the adult
ANKLE = 0.085  # m, over the sole of a flat foot
BALL = 0.055  # m, likewise
FOOT = 0.12  # m, from ankle to ball
FOOT_RANGE = 2.0  # factor by which feet may be larger or smaller than their legs say
NOTICEABLE = 0.05  # of their mean, from which legs get values of their own
DIMENSIONS = {"m": 1.0, "s": 0.5, "Hz": -0.5, "rad": 0.0, "1": 0.0}  # powers of r
POWERS = {"": 1, "²": 2, "³": 3}

Tree = TypeVar("Tree", bound=eqx.Module)
Numbers: TypeAlias = Array | np.ndarray | float
"""One a leg, or one for all."""


class Size(NamedTuple):
    """What numbers follow."""

    ratio: Numbers
    """Of the leg's length to the adult's."""
    ankle: Numbers
    """m, height over the sole."""
    ball: Numbers
    """m, likewise."""
    foot: Numbers
    """Ratio of the foot's length to the adult's."""


def pitch_rate(rig: Rig | None, of_people: float) -> Array | float:
    """How far a body pitches with a slope: that of four legs and more lies along it."""
    if rig is None:
        return of_people
    rate = jnp.where(jnp.sum(rig.present, axis=-1) > 3, 1.0, of_people)
    return rate.astype(float)  # no weak type, with which every program would compile once more


def scale(system: Tree, rig: Rig | None) -> Tree:
    """A system for the adult, with every number as this body needs it.

    It takes any tree of rules, with values of any kind; so do not scale a system twice. Legs share
    a number unless it differs noticeably between them and may be one a leg. While it is traced, for
    instance for a batch of rigs, numbers that may be one a leg always are.

    Args:
        system: with the numbers of an adult.
        rig: of one character; None returns the system as it is.
    """
    if rig is None:
        return system
    traced = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((system, rig)))
    numbers = jnp if traced else np
    size = _size(rig, numbers)
    values = {}
    for slot in parameter_tree.slots(system):
        if slot.follows == "nothing":
            continue
        axes = len(slot.shape)
        columns = Size(*(numbers.reshape(entry, (-1, *(1,) * axes)) for entry in size))
        value = numbers.asarray(slot.value)
        finite = numbers.isfinite(value)  # what is unlimited stays so, also in derivatives
        followed = _follow(numbers.where(finite, value, 0.0), slot.follows, columns)
        each = numbers.where(finite, followed, value)
        mean = each.mean(axis=0)
        alike = not traced and np.allclose(each, mean, rtol=NOTICEABLE, atol=0.0)
        shared = not slot.per_leg or (alike and value.ndim == axes)
        values[slot.name] = mean if shared else each
    return parameter_tree.replace(system, values)


def scaled_declarations(system: eqx.Module, rig: Rig | None) -> dict[str, Declaration]:
    """The declarations of a system's parameters, their ranges as `scale` changes its values.

    Args:
        system: any tree of rules.
        rig: of one character; None returns the declarations for the adult.
    """
    declarations = parameter_tree.declarations(system)
    if rig is None:
        return declarations
    size = Size(*(float(np.mean(entry)) for entry in _size(rig, np)))
    return {
        name: dataclasses.replace(
            declared,
            low=float(_follow_range(declared.low, declared.follows, size)),
            high=float(_follow_range(declared.high, declared.follows, size)),
        )
        for name, declared in declarations.items()
    }


def ratio(rig: Rig) -> float:
    """Mean length of the legs, relative to the adult's; 1 without a leg that has a length."""
    return float(np.mean(_size(rig, np).ratio))


def leg_length(rig: Rig) -> float:
    """Mean length of the legs, m; the adult's without a leg that has a length."""
    return LEG * ratio(rig)


def _size(rig: Rig, numbers: ModuleType) -> Size:
    """What numbers follow; a leg that is absent or has no length counts as the mean of the others.

    Args:
        rig: of one character.
        numbers: NumPy, or JAX's, where the rig is traced.
    """
    length = numbers.asarray(rig.thigh) + numbers.asarray(rig.shin)
    known = numbers.asarray(rig.present) & (length > 0)
    count = known.sum()

    def filled(entry: Numbers, without: float) -> Numbers:
        mean = numbers.where(known, entry, 0.0).sum() / numbers.maximum(count, 1)
        return numbers.where(known, entry, numbers.where(count > 0, mean, without))

    leg = filled(length, LEG) / LEG
    ankle, ball, foot = (
        filled(numbers.asarray(entry), adult)
        for entry, adult in ((rig.ankle_height, ANKLE), (rig.ball_height, BALL), (rig.foot, FOOT))
    )
    return Size(leg, ankle, ball, numbers.clip(foot / FOOT, leg / FOOT_RANGE, leg * FOOT_RANGE))


def _follow(value: Numbers, follows: Follows, size: Size) -> Numbers:
    """The number of this body for one of the adult."""
    match follows:
        case "leg length":
            return value * size.ratio
        case "speed" | "time":
            return value * size.ratio**0.5
        case "ankle height":
            return size.ankle + 0.0 * value
        case "ball height":
            return size.ball + 0.0 * value
        case "over ankle height":
            return size.ankle + (value - ANKLE) * size.foot
        case "over ball height":
            return size.ball + (value - BALL) * size.foot
        case _:
            return value


def _follow_range(end: float, follows: Follows, size: Size) -> Numbers:
    """An end of a range; that of a height itself widens with the body and with its feet."""
    match follows:
        case "ankle height":
            return end * np.maximum(size.ratio, size.ankle / ANKLE)
        case "ball height":
            return end * np.maximum(size.ratio, size.ball / BALL)
        case _:
            return _follow(end, follows, size)


def exponent(unit: str) -> float:
    """The power of the ratio of leg lengths by which a number with this unit changes.

    Args:
        unit: such as "m", "rad", "1/s" or "m/s²".

    Raises:
        ValueError: the unit is made of others than these.
    """
    total = 0.0
    for sign, part in zip((1, -1), unit.split("/", 1), strict=False):
        found = re.fullmatch(r"(\w+?)([²³]?)", part)
        if found is None or found[1] not in DIMENSIONS:
            raise ValueError(f"the unit {unit!r} is not made of {list(DIMENSIONS)}")
        total += sign * DIMENSIONS[found[1]] * POWERS[found[2]]
    return total


def similar(system: Tree, ratio: Float[Array, ""] | float) -> Tree:
    """The system for a dynamically similar body.

    It takes any tree of rules; all declared parameters and constants change, none else.

    Args:
        system: with the numbers of the first body.
        ratio: leg length of the second body over that of the first.
    """
    values = {}
    for slot in parameter_tree.slots(system):
        if power := exponent(slot.unit):
            values[slot.name] = slot.value * jnp.asarray(ratio, slot.value.dtype) ** power
    return parameter_tree.replace(system, values)
