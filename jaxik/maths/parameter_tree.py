"""What a rule is made of: parameters that know their unit, range and kind, and switches.

A stage's rule is an `eqx.Module` whose float fields are declared with `parameter`. The declaration
is the only place where a number's default, unit and range stand: presets, the fit, the reports and
the error messages read it from there.
"""

import dataclasses
import operator
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

Rule = TypeVar("Rule", bound=eqx.Module)
Kind = Literal["smooth", "threshold"]
Scale = Literal["linear", "log", "gain"]


if TYPE_CHECKING:

    class Leaf:
        """Type of a field that reads as an array and may be given as a Python number."""

        def __get__(self, rule: object, owner: type | None = None) -> Array: ...
        def __set__(self, rule: object, value: ArrayLike | Sequence[float]) -> None: ...

else:
    Leaf = jax.Array


@dataclasses.dataclass(frozen=True)
class Declaration:
    """What is known of a parameter before any data."""

    unit: str
    low: float  # a fit stays between low and high
    high: float
    kind: Kind  # a threshold moves a hard decision: its derivative there is zero
    scale: Scale  # a gain is fitted as its half-life
    above: str | None  # name of the field of the same rule that this one stays above


def as_float_array(x: Any) -> Any:
    """Python numbers and sequences become float arrays; arrays and tracers stay as they are."""
    return x if isinstance(x, jax.Array) else jnp.asarray(x, jnp.result_type(float))


def as_switch(x: Any) -> Any:
    """Python booleans become 0-d arrays, so that a switch is data and never a new program."""
    return x if isinstance(x, jax.Array) else jnp.asarray(x, bool)


def parameter(
    default: float | tuple[float, ...],
    *,
    unit: str,
    low: float,
    high: float,
    kind: Kind = "smooth",
    scale: Scale = "linear",
    above: str | None = None,
) -> Any:
    """A float leaf of a rule, `()` shared by the legs or `(legs,)` one each."""
    declaration = Declaration(unit, low, high, kind, scale, above)
    return eqx.field(
        default_factory=lambda: as_float_array(default),
        converter=as_float_array,
        metadata={"declaration": declaration},
    )


def constant(default: float) -> Any:
    """A float leaf of a rule that is a convention, such as a tick rate: never fitted."""
    return eqx.field(default_factory=lambda: as_float_array(default), converter=as_float_array)


def switch(default: bool) -> Any:
    """A boolean leaf of a rule."""
    return eqx.field(default_factory=lambda: as_switch(default), converter=as_switch)


def layers(default: int = 0xFFFFFFFF) -> Any:
    """A mask of the layers that a rule's rays see, one bit a layer (`terrain.layer_mask`)."""
    return eqx.field(
        default_factory=lambda: jnp.asarray(default, jnp.uint32),
        converter=lambda x: x if isinstance(x, jax.Array) else jnp.asarray(x, jnp.uint32),
    )


def declarations(module: eqx.Module, path: str = "") -> dict[str, Declaration]:
    """Every declared parameter of a rule or of a tree of rules, by dotted name."""
    found: dict[str, Declaration] = {}
    for field in dataclasses.fields(module):
        name = f"{path}{field.name}"
        if "declaration" in field.metadata:
            found[name] = field.metadata["declaration"]
        elif isinstance(child := getattr(module, field.name), eqx.Module):
            found |= declarations(child, f"{name}.")
    return found


def get(module: eqx.Module, name: str) -> jax.Array:
    """The leaf with this dotted name."""
    return operator.attrgetter(name)(module)


def replace(module: Rule, values: dict[str, Any]) -> Rule:
    """The tree with the leaves of these dotted names exchanged.

    Raises:
        ValueError: for a name that the tree does not have.
    """
    getters = [operator.attrgetter(name) for name in values]
    leaves = []
    for getter, (name, value) in zip(getters, values.items(), strict=True):
        try:
            leaves.append(jnp.asarray(value, getter(module).dtype))
        except AttributeError:
            there_are = list(declarations(module))
            raise ValueError(f"no parameter named {name!r}; there are {there_are}") from None
    return eqx.tree_at(lambda tree: [getter(tree) for getter in getters], module, leaves)
