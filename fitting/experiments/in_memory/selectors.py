"""Free parameters by the leaf that a function picks: `lambda ik: ik.pelvis.limit`."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeAlias

import jax

import jaxik
from fitting.inference.sensitivity import FreeTable

Selector: TypeAlias = Callable[[Any], object]  # of a system; its rules have leaves of their own
Choice: TypeAlias = str | Selector
Free: TypeAlias = Choice | Iterable[Choice] | Mapping[Choice, Mapping[str, float | str]]
"""A name or a selector, or several; a mapping has what overrides the declaration of each."""


class _Name(str):
    """The dotted name of a leaf, in its place in a system; an index names the value of one leg."""

    def __getitem__(self, leg: object) -> "_Name":
        return _Name(f"{self}[{leg}]")


def free_table(free: Free, ik: jaxik.FootIK) -> FreeTable:
    """Free parameters by dotted name, with overrides of their declaration.

    Args:
        free: names, functions that pick one or several leaves of a system, or both.
        ik: the system.

    Raises:
        ValueError: nothing is named, or a function picks something else.
    """
    if isinstance(free, str) or callable(free):
        free = [free]
    entries = free.items() if isinstance(free, Mapping) else ((entry, {}) for entry in free)
    table = {name: dict(keys) for entry, keys in entries for name in _names(entry, ik)}
    if not table:
        raise ValueError("free: names no parameter; wanted one at least")
    return table


def _names(entry: Choice, ik: jaxik.FootIK) -> list[str]:
    """The dotted names of what an entry picks."""
    if isinstance(entry, str):
        return [entry]
    leaves, structure = jax.tree_util.tree_flatten_with_path(ik)
    names = [_Name(jax.tree_util.keystr(path).removeprefix(".")) for path, _ in leaves]
    wanted = "wanted a function that picks leaves, as lambda ik: ik.pelvis.limit"
    try:
        picked = jax.tree.leaves(entry(jax.tree_util.tree_unflatten(structure, names)))
    except (AttributeError, TypeError) as error:
        raise ValueError(f"free: {error}; {wanted}") from None
    if not picked or not all(isinstance(name, _Name) for name in picked):
        raise ValueError(f"free: a function picks {picked}; {wanted}")
    return [str(name) for name in picked]
