"""Frozen dataclasses as pytrees, for the data that stages hand to each other."""

import dataclasses
from collections.abc import Callable, Iterable
from operator import attrgetter
from typing import Any, Literal, TypeAlias, TypeVar, cast, dataclass_transform

import equinox as eqx
import jax

Data = TypeVar("Data")
Place: TypeAlias = Literal["point", "height", "leg height", "motion"]


def place(kind: Place) -> Any:
    """A field with what depends on where the world's origin is: `jaxik.world.places` moves it.

    Args:
        kind: "point" for positions, m, or a `Transform` to world space; "height" for heights, m,
            along the up of the body; "leg height" along that of each leg; "motion" for a
            `Transform` that moves things about in the world.
    """
    return dataclasses.field(metadata={"place": kind})


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(eqx.field, place))
def struct(cls: type[Data]) -> type[Data]:
    """Turns a class of fields into a frozen dataclass that JAX flattens quickly.

    Flattening and rebuilding `eqx.Module`s took two thirds as long as the program for one frame of
    one character; a struct takes half as long as a module. Fields with `static=True` belong to the
    structure. Unlike a dataclass registered by JAX's own decorator, but like a module, a struct is
    rebuilt without calling its constructor: while JAX transforms a function, a field may hold
    something other than its declared type.
    """
    data = dataclasses.dataclass(frozen=True, eq=False, repr=False)(cls)
    data.__repr__ = lambda self: eqx.tree_pformat(self)
    fields = dataclasses.fields(cast(type, data))
    static_names = tuple(field.name for field in fields if field.metadata.get("static", False))
    leaf_names = tuple(field.name for field in fields if field.name not in static_names)
    names = (*leaf_names, *static_names)
    leaves, static = _getter(leaf_names), _getter(static_names)
    keys = [jax.tree_util.GetAttrKey(name) for name in leaf_names]

    def flatten(value: Data) -> tuple[tuple, tuple]:
        return leaves(value), static(value)

    def flatten_with_keys(value: Data) -> tuple[list, tuple]:
        return list(zip(keys, leaves(value), strict=True)), static(value)

    def unflatten(static_values: tuple, leaf_values: Iterable) -> Data:
        value = object.__new__(data)
        value.__dict__.update(zip(names, (*leaf_values, *static_values), strict=True))
        return value

    jax.tree_util.register_pytree_with_keys(data, flatten_with_keys, unflatten, flatten)
    return data


def _getter(names: tuple[str, ...]) -> Callable[[object], tuple]:
    """A function that returns the values of these fields as a tuple."""
    if len(names) > 1:
        return attrgetter(*names)  # with a single name it would not return a tuple
    return (lambda value: (getattr(value, names[0]),)) if names else (lambda value: ())
