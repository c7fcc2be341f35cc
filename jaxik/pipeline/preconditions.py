"""What the pipeline takes for granted of its numbers, checked outside of it, where that is free."""

import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, PyTree

from jaxik.world.frame import Frame
from jaxik.world.skeleton import Rig
from jaxik.world.terrain import LegTerrains, Terrain

NOT_UNIT = 1e-3  # off a length of 1, at most
UNIT = ("rot", "knee_axis_ls", "ankle_from_foot", "up_ws")
FRACTIONS = ("weight", "grounded", "slide", "standing", "fraction", "known")
SIGNED_FRACTIONS = ("side",)
SIZES = ("foot_speed", "toe_speed", "thigh", "shin", "foot")
POSITIVE = ("dt", "stride_scale")
OF_FRAME = ("world_from_model", "velocity_ws", "grounded", "slide", *POSITIVE)
OF_FRAME += ("orientation", "restart")
PLATFORMS = ("platforms", "platforms_before")


def check(frame: Frame, rig: Rig, terrain: Terrain | LegTerrains) -> None:
    """Refuses numbers that the pipeline cannot use.

    `step` and `run` look at shapes while they are traced, and at numbers only as far as they are
    finite; the rest they take for granted: unit quaternions, axes and ups, fractions from 0 to 1,
    sizes that are not negative, time that passes. This looks at all of it, in NumPy, for a frame, a
    clip or a batch. What passes may be computed with `checked=True`. Clips that `fitting` loads
    have passed.

    Args:
        frame: one frame, or many with leading axes. Legs that are not there may hold anything.
        rig: the legs.
        terrain: of which the up vectors are looked at.

    Raises:
        ValueError: naming the array, the place, the number and what it may be.
        TypeError: inside a function that JAX traces, where numbers are not known.
    """
    present = _numbers("rig.present", rig.present)
    ups = {"terrain": terrain}
    if isinstance(terrain, LegTerrains):
        ups = {"terrain.body": terrain.body}
        ups |= {f"terrain.legs[{leg}]": ground for leg, ground in enumerate(terrain.legs)}
    for name, ground in ups.items():
        _check(f"{name}.up_ws", ground.up_ws, ground.up_ws.ndim - 1)
    for name, array in _arrays("rig", rig):
        _check(name, array, rig.side.ndim, present)
    for name, array in _arrays("frame", frame):
        field, rank = name.split(".")[1], frame.dt.ndim
        if field in PLATFORMS or field not in OF_FRAME:
            rank += 1
        _check(name, array, rank, present if field not in (*PLATFORMS, *OF_FRAME) else None)


def _arrays(name: str, tree: PyTree) -> list[tuple[str, Array]]:
    """The arrays of a tree by dotted name."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return [(name + jax.tree_util.keystr(path), leaf) for path, leaf in leaves]


def _numbers(name: str, array: Array) -> np.ndarray:
    if isinstance(array, Tracer):
        raise TypeError(f"{name} is being traced; jaxik.check needs numbers: call it outside jit")
    return np.asarray(array)


def _check(name: str, array: Array, rank: int, counts: np.ndarray | None = None) -> None:
    """Refuses an array with a number that is wrong, where it counts.

    Args:
        name: of the array.
        array: its last axis is that of a vector where it has one more than `rank`.
        rank: see there.
        counts: which legs do, on the last axis; None for all.
    """
    numbers = _numbers(name, array)
    if numbers.dtype.kind == "b":
        return
    wanted, right = _rule(name.rsplit(".")[-1], numbers)
    right &= np.isfinite(numbers) if right.ndim == numbers.ndim else True
    wrong = ~(right.all(axis=-1) if right.ndim > rank else right)
    places = np.argwhere(wrong if counts is None else wrong & counts)
    if not len(places):
        return
    place = tuple(places[0].tolist())
    index = f"[{', '.join(map(str, place))}]" if place else ""
    others = f"; {len(places) - 1} more are wrong" if len(places) > 1 else ""
    raise ValueError(f"{name}{index} is {numbers[place].tolist()}; wanted {wanted}{others}")


def _rule(field: str, numbers: np.ndarray) -> tuple[str, np.ndarray]:
    """What the numbers of a field may be, and where they are, by vector where it is one."""
    with np.errstate(invalid="ignore", over="ignore"):
        if field in UNIT:
            length = np.linalg.norm(numbers, axis=-1)
            return "a length of 1", np.asarray(np.abs(length - 1.0) <= NOT_UNIT)
        if field in FRACTIONS:
            return "0 to 1", np.asarray((numbers >= 0) & (numbers <= 1))
        if field in SIGNED_FRACTIONS:
            return "-1 to 1", np.asarray(np.abs(numbers) <= 1)
        if field in SIZES:
            return "0 or more, finite", np.asarray(numbers >= 0)
        if field in POSITIVE:
            return "more than 0, finite", np.asarray(numbers > 0)
    return "finite numbers", np.ones(numbers.shape, bool)
