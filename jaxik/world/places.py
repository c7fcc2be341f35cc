"""Coordinates about the character: 32 bits are then as exact far from the world's origin as at it.

At 100 km, neighbouring numbers of 32 bits are 8 mm apart. What comes in is rounded to that already,
but differences of such numbers are exact, and from there on everything is near 0. The centre of the
coordinates is a point of a coarse lattice, the same for as long as the character stays about it. So
coordinates seldom change, numbers about the world's origin stay as they are, and moving the centre
is exact as well. Numbers of 64 bits need nothing of this.
"""

import dataclasses
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxik.maths import vec

from .skeleton import Still, Transform

Tree = TypeVar("Tree")

LATTICE = 16.0  # m, a power of two, so that its points are exact


def centre_about(pos_ws: Float[Array, "*b 3"]) -> Float[Array, "*b 3"] | None:
    """The point of the lattice that is nearest to these, m; None where numbers have 64 bits.

    No gradient passes through it: what is computed does not depend on it.
    """
    if jnp.finfo(pos_ws.dtype).bits > 32:
        return None
    return LATTICE * jnp.round(jax.lax.stop_gradient(pos_ws) * (1.0 / LATTICE))


def moved(
    tree: Tree,
    by_ws: Float[Array, "3"],
    up_ws: Float[Array, "3"],
    leg_up_ws: Float[Array, "*legs 3"],
) -> Tree:
    """A struct with all its places, those of the structs inside too, moved by `by_ws`, m.

    Args:
        tree: of any depth; of a struct, the fields declared by `place` are moved.
        by_ws: how far, world axes.
        up_ws: unit, up of the body, for heights along it.
        leg_up_ws: unit, up of each leg, or one for all, for heights along it.
    """

    def moved_place(kind: str, value: Array | Transform | Still) -> Array | Transform | Still:
        if isinstance(value, Still):
            return value
        if isinstance(value, Transform):
            way = jnp.broadcast_to(by_ws, value.pos.shape)
            way = way - value.turn(way) if kind == "motion" else way
            return Transform(value.pos + way, value.rot)
        match kind:
            case "height":
                return value + vec.dot(by_ws, up_ws)
            case "leg height":
                return value + vec.dot(by_ws, leg_up_ws)
        return value + by_ws

    def moved_struct(value: Any) -> Any:
        if not dataclasses.is_dataclass(value) or isinstance(value, type):
            parts = jax.tree.leaves(value, is_leaf=dataclasses.is_dataclass)
            if not any(map(dataclasses.is_dataclass, parts)):
                return value
            return jax.tree.map(
                lambda part: moved_struct(part) if dataclasses.is_dataclass(part) else part,
                value,
                is_leaf=dataclasses.is_dataclass,
            )
        changes = {}
        for field in dataclasses.fields(value):
            inner, kind = getattr(value, field.name), field.metadata.get("place")
            if inner is None or field.metadata.get("static", False):
                continue
            changed = moved_struct(inner) if kind is None else moved_place(kind, inner)
            if changed is not inner:
                changes[field.name] = changed
        return dataclasses.replace(value, **changes) if changes else value

    return moved_struct(tree)
