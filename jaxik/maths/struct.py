"""What stages hand to each other: data and no rules, so dataclasses and no modules."""

import dataclasses
from collections.abc import Callable
from operator import attrgetter
from typing import Any, TypeVar, dataclass_transform

import equinox as eqx
import jax

Data = TypeVar("Data")


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(eqx.field,))
def struct(cls: type[Data]) -> type[Data]:
    """A class of fields as a frozen dataclass that JAX takes apart in half a module's time.

    To take modules apart and put them together took two thirds as long as the program of one frame
    of one character. Fields with `static=True` are part of the structure. JAX puts one together
    past its constructor, as it does a module (but no dataclass registered by JAX's own decorator):
    what JAX puts in a field while it transforms need not be what the field is declared to hold.
    """
    made: Any = dataclasses.dataclass(frozen=True, eq=False, repr=False)(cls)
    made.__repr__ = eqx.tree_pformat
    static = {field.name: field.metadata.get("static", False) for field in dataclasses.fields(made)}
    leaves = tuple(name for name in static if not static[name])
    rest = tuple(name for name in static if static[name])
    names, leaves_of, rest_of = (*leaves, *rest), _values(leaves), _values(rest)
    keys = [jax.tree_util.GetAttrKey(name) for name in leaves]

    def flat(value: Any) -> tuple[tuple, tuple]:
        return leaves_of(value), rest_of(value)

    def flat_with_keys(value: Any) -> tuple[list, tuple]:
        return list(zip(keys, leaves_of(value), strict=True)), rest_of(value)

    def whole(rest_values: tuple, leaf_values: Any) -> Any:
        value = object.__new__(made)
        value.__dict__.update(zip(names, (*leaf_values, *rest_values), strict=True))
        return value

    jax.tree_util.register_pytree_with_keys(made, flat_with_keys, whole, flat)
    return made


def _values(names: tuple[str, ...]) -> Callable[[Any], tuple]:
    """What tells the values of these fields."""
    if len(names) > 1:
        return attrgetter(*names)  # of one alone it would tell no tuple
    return (lambda value: (getattr(value, names[0]),)) if names else (lambda value: ())
