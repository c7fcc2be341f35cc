"""What a rule is made of: parameters that know their meaning, unit and range, and switches.

A stage's rule is a `Rule` whose fields are declared with `parameter` (or, for short, `length`,
`angle` and so on), `constant`, `switch` and `layers`. The declaration is the only place where a
number's meaning, default, unit and range stand: presets, fits and reports read it there.
"""

# pyright: reportInvalidTypeVarUse=false

import dataclasses
import functools
import inspect
import operator
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar, Literal, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from .outline import ALL_LAYERS, outline, table, value_text

Tree = TypeVar("Tree", bound=eqx.Module)
Declared = TypeVar("Declared")  # whatever type a field is annotated with
ParameterKind = Literal["smooth", "threshold"]
Scale = Literal["linear", "log"]
Follows = Literal[
    "nothing", "leg length", "speed", "time",
    "ankle height", "ball height", "over ankle height", "over ball height",
]  # fmt: skip
BY_UNIT: dict[str, Follows] = {"m": "leg length", "m/s": "speed"}  # what follows the body at once


if TYPE_CHECKING:

    class Leaf:
        """Type of a field that reads as an array and may be given as a Python number."""

        def __get__(self, rule: object, owner: type | None = None) -> Array: ...
        def __set__(self, rule: object, value: ArrayLike | Sequence) -> None: ...

else:
    Leaf = jax.Array


class Rule(eqx.Module):
    """One implementation of a stage. Printed, it lists its parameters with their units."""

    per_leg: ClassVar[bool] = True
    """Whether parameters and switches may be one per leg where they do not say themselves."""

    def __init_subclass__(cls, **options: object) -> None:
        """Lists the declared fields in the docstring, for `help` and the API reference."""
        super().__init_subclass__(**options)
        lines = [
            f"    {name}: {_meaning(field)}"
            for name, field in vars(cls).items()
            if isinstance(field, dataclasses.Field) and "doc" in field.metadata
        ]
        if lines:
            summary = inspect.cleandoc(cls.__doc__ or "")
            cls.__doc__ = "\n".join([summary, "", "Attributes:", *lines])

    def __repr__(self) -> str:
        return outline(self)

    def _repr_html_(self) -> str:
        """What notebooks show."""
        return table(self)


@dataclasses.dataclass(frozen=True)
class Declaration:
    """What is known of a parameter before any data."""

    unit: str
    low: float
    """a fit stays between low and high."""
    high: float
    kind: ParameterKind
    """a threshold moves a hard decision: its derivative there is zero."""
    scale: Scale
    above: str | None
    """Name of the field of the same rule that this one stays above."""
    doc: str
    """One sentence: what the parameter does."""
    follows: Follows = "nothing"
    """What of a body it changes with."""


class Slot(NamedTuple):
    """A declared field of a rule."""

    name: str
    """Dotted."""
    value: Array
    shape: tuple[int, ...]
    """Of one value for all legs."""
    per_leg: bool
    """Whether it may be one value a leg."""
    follows: Follows
    """What of a body it changes with."""
    unit: str
    """"1" for a plain number and for a switch."""


def _meaning(field: dataclasses.Field) -> str:
    """What a field is for, with its unit and range."""
    unit = field.metadata.get("unit", "1")
    parts = [field.metadata["doc"], *([] if unit == "1" else [f"Unit {unit}."])]
    if (declaration := field.metadata.get("declaration")) is not None:
        parts.append(f"Range {declaration.low:g} to {declaration.high:g}.")
    return " ".join(parts)


def as_float_array(x: ArrayLike | Sequence) -> Array:
    """Python numbers and sequences as float arrays; arrays and tracers stay as they are."""
    return x if isinstance(x, jax.Array) else jnp.asarray(x, jnp.result_type(float))


def as_switch(x: ArrayLike) -> Array:
    """Python booleans as 0-d arrays, so that a switch is data and needs no new program."""
    return x if isinstance(x, jax.Array) else jnp.asarray(x, bool)


def as_layers(x: ArrayLike) -> Array:
    """Python integers as 0-d masks of layers."""
    return x if isinstance(x, jax.Array) else jnp.asarray(x, jnp.uint32)


def parameter(
    default: int | float | tuple[int | float, ...],
    low: int | float,
    high: int | float,
    doc: str,
    *,
    unit: str,
    kind: ParameterKind = "smooth",
    scale: Scale = "linear",
    above: str | None = None,
    follows: Follows | None = None,
    per_leg: bool | None = None,
) -> Declared:
    """Declares a float field of a rule: one number for all legs, or one a leg.

    `length`, `angle`, `speed`, `duration`, `rate` and `ratio` are this with their unit, and
    `threshold` is one that moves a hard decision.

    Args:
        default: its value in a rule made without it.
        low: a fit goes no lower.
        high: a fit goes no higher.
        doc: one sentence, for users, that says what the parameter does.
        unit: such as "m", "rad" or "1/s"; "1" for a plain number.
        kind: "threshold" if it moves a hard decision, so that its derivative there is zero.
        scale: how a fit steps: "linear", or by factors ("log").
        above: the field of the same rule that it stays above, if any.
        follows: what of a body it changes with, see `jaxik.world.body`; None takes that from the
            unit: lengths follow that of the legs, speeds its root, all else nothing.
        per_leg: whether it may be one number a leg; None leaves that to the rule's `per_leg`, which
            is False in stages that move the whole body.
    """
    low, high = float(low), float(high)
    follows = BY_UNIT.get(unit, "nothing") if follows is None else follows
    declaration = Declaration(unit, low, high, kind, scale, above, doc, follows)
    metadata = {"declaration": declaration, "unit": unit, "doc": doc, "per_leg": per_leg}
    metadata["follows"] = follows
    return _field(default, as_float_array, metadata)


length = functools.partial(parameter, unit="m")
angle = functools.partial(parameter, unit="rad")
speed = functools.partial(parameter, unit="m/s")
duration = functools.partial(parameter, unit="s")
rate = functools.partial(parameter, unit="1/s", scale="log")
ratio = functools.partial(parameter, unit="1")
threshold = functools.partial(parameter, kind="threshold")


def half_life(default: int | float, doc: str) -> Declared:
    """Declares a half-life, s: fitted by factors from 2 ms to 0.5 s; at 0 memory jumps."""
    return parameter(default, 0.002, 0.5, doc, unit="s", scale="log")


def constant(default: int | float, doc: str, *, unit: str) -> Declared:
    """Declares a float field of a rule that is a convention, such as a tick rate: never fitted."""
    metadata = {"unit": unit, "doc": doc, "follows": BY_UNIT.get(unit, "nothing")}
    return _field(default, as_float_array, metadata)


def switch(default: bool, doc: str, *, per_leg: bool | None = None) -> Declared:
    """Declares a boolean field of a rule; for `per_leg` see `parameter`."""
    return _field(default, as_switch, {"doc": doc, "per_leg": per_leg})


def option(default: bool, doc: str) -> Declared:
    """Declares what is switched when a program is compiled, not while it runs."""
    return eqx.field(default=default, static=True, kw_only=True, metadata={"doc": doc})


def layers(doc: str = "Layers of the terrain that the rays see, one bit each.") -> Declared:
    """Declares a mask of the layers that a rule's rays see, one bit a layer (`layer_mask`)."""
    return _field(ALL_LAYERS, as_layers, {"doc": doc})


def _field(default, converter, metadata: dict):
    return eqx.field(
        default_factory=lambda: converter(default),
        converter=converter,
        metadata=metadata | {"shape": np.shape(default)},
    )


def declarations(module: eqx.Module) -> dict[str, Declaration]:
    """Every declared parameter of a rule or of a tree of rules, by dotted name."""
    return {
        name: field.metadata["declaration"]
        for name, _, field in _fields(module)
        if "declaration" in field.metadata
    }


def docs(module: eqx.Module) -> dict[str, str]:
    """The sentence of meaning of each parameter, constant, switch and option, by dotted name."""
    return {
        name: field.metadata["doc"] for name, _, field in _fields(module) if "doc" in field.metadata
    }


def check_shapes(module: eqx.Module, legs: int) -> None:
    """Refuses a declared field that is neither one value nor, where it may be, one per leg.

    Raises:
        ValueError: naming the field, its shape, and the shapes that it may have.
    """
    for slot in slots(module):
        shape, single = np.shape(slot.value), slot.shape
        if shape == single or (slot.per_leg and shape == (legs, *single)):
            continue
        wanted = f"{single}, the same for all legs"
        if slot.per_leg:
            wanted += f", or {(legs, *single)}, one per leg"
        raise ValueError(f"{slot.name} has shape {shape}, wanted {wanted}")


def slots(module: eqx.Module) -> Iterator[Slot]:
    """Every declared field of a rule or of a tree of rules."""
    for name, owner, field in _fields(module):
        if "shape" not in field.metadata:  # a field that was not declared by the functions above
            continue
        per_leg = field.metadata.get("per_leg")
        if per_leg is None:
            per_leg = getattr(owner, "per_leg", True)
        follows = field.metadata.get("follows", "nothing")
        unit = field.metadata.get("unit", "1")
        shape = field.metadata["shape"]
        yield Slot(name, getattr(owner, field.name), shape, per_leg, follows, unit)


def _fields(
    module: eqx.Module, path: str = ""
) -> Iterator[tuple[str, eqx.Module, dataclasses.Field]]:
    """The fields of a tree that are not modules themselves, with their owners, by dotted name."""
    for field in dataclasses.fields(module):
        name = f"{path}{field.name}"
        if isinstance(child := getattr(module, field.name), eqx.Module):
            yield from _fields(child, f"{name}.")
        else:
            yield name, module, field


def options(module: eqx.Module) -> dict[str, bool]:
    """What is switched when a program is compiled, not while it runs, by dotted name."""
    return {
        name: getattr(owner, field.name)
        for name, owner, field in _fields(module)
        if field.metadata.get("static") and isinstance(getattr(owner, field.name), bool)
    }


def with_option(module: Tree, name: str, on: bool) -> Tree:
    """The tree with one of its `options` switched."""
    child, _, rest = name.partition(".")
    value = with_option(getattr(module, child), rest, on) if rest else on
    return dataclasses.replace(module, **{child: value})


def get(module: eqx.Module, name: str) -> Array:
    """The leaf with this dotted name; options are not leaves."""
    return operator.attrgetter(name)(module)


def replace(module: Tree, values: Mapping[str, ArrayLike | Sequence]) -> Tree:
    """The tree with other leaves under these dotted names.

    Raises:
        ValueError: for a name that the tree does not have.
    """
    getters = [operator.attrgetter(name) for name in values]
    leaves = []
    for getter, (name, value) in zip(getters, values.items(), strict=True):
        try:
            leaves.append(jnp.asarray(value, getter(module).dtype))
        except AttributeError:
            known = list(declarations(module))
            raise ValueError(f"no parameter named {name!r}; there are {known}") from None
    return eqx.tree_at(lambda tree: [getter(tree) for getter in getters], module, leaves)


def shown(module: eqx.Module, name: str) -> str:
    """The leaf or option with this dotted name as `outline` prints it: value and unit."""
    units = {path: field.metadata.get("unit", "") for path, _, field in _fields(module)}
    return value_text(operator.attrgetter(name)(module), units[name])
