"""Tracks: parameters that change along a clip, as by the states of an animation."""

import difflib
from collections.abc import Mapping
from typing import TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxik.maths import parameter_tree

from .shapes import BATCHES
from .system import FootIK

Tracks: TypeAlias = Mapping[str, Array]  # by dotted name of a parameter, with a value a frame


def read_tracks(ik: FootIK, tracks: Tracks | None, frames: int, legs: int) -> dict[str, Array]:
    """The tracks as arrays.

    Args:
        ik: the system.
        tracks: by dotted name an array (frames, ...) of values that the leaf may have; None has no
            effect.
        frames: number of frames in the clip.
        legs: number of legs of the rig.

    Raises:
        ValueError: a name that the system does not have, or an array of another shape; it says
            which names or shapes there may be.
    """
    slots = {slot.name: slot for slot in parameter_tree.slots(ik)}
    arrays: dict[str, Array] = {}
    for name, values in (tracks or {}).items():
        if name not in slots:
            nearest = difflib.get_close_matches(name, slots, n=1, cutoff=0.0)
            raise ValueError(
                f"tracks: no parameter named {name!r}; nearest is {nearest[0]!r}; "
                f"there are {sorted(slots)}"
            )
        slot, shape = slots[name], np.shape(values)
        shapes = [(frames, *slot.shape)]
        if slot.per_leg:
            shapes.append((frames, legs, *slot.shape))
        if shape not in shapes:
            wanted = " or ".join(map(str, shapes))
            raise ValueError(
                f"tracks[{name!r}] has shape {shape}, wanted {wanted}: {frames} frames in "
                f"frames.dt, {legs} legs in rig.side; {BATCHES}"
            )
        arrays[name] = jnp.asarray(values)
    return arrays


def system_at(ik: FootIK, values: Tracks) -> FootIK:
    """The system with the values that its tracks have in one frame."""
    return parameter_tree.replace(ik, values) if values else ik
