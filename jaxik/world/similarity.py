"""Dynamically similar bodies: the same motion, larger and slower.

Two bodies of equal shape move alike under the same gravity if their Froude numbers v² / (g l) are
equal (Alexander and Jayes 1983). With legs r times as long, lengths are then r times, and times
root r times as large; what any other number becomes follows from its unit:

    m                   r
    s                   r^½
    m/s                 r^½
    1/s, Hz             r^-½
    1, rad, 1/tick      1: a gain per tick keeps its half-life in ticks, which are longer

`jaxik.world.body` is about defaults for a body of any shape. It knows the height of its ankles
apart from its legs, and leaves half-lives alone.
"""

import re
from typing import TypeVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxik.maths import parameter_tree

DIMENSIONS = {"m": 1.0, "s": 0.5, "Hz": -0.5, "rad": 0.0, "tick": 0.0, "1": 0.0}  # powers of r
POWERS = {"": 1, "²": 2, "³": 3}

Tree = TypeVar("Tree", bound=eqx.Module)


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
