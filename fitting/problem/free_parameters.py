"""Which numbers of a system a fit may change: range, kind and scale of each.

Arrays are JAX's, or NumPy's where `library` says so.
"""

import dataclasses
import difflib
import math
from types import ModuleType
from typing import Any, cast, get_args

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Float

from jaxik.maths import parameter_tree, smoothing
from jaxik.world.body import scaled_declarations
from jaxik.world.skeleton import Rig

DOMAINS = {"linear": (-math.inf, math.inf), "log": (0.0, math.inf), "gain": (1e-9, 1.0 - 1e-9)}
NARROWEST, WIDEST = 1e-6, 1e6  # of a range, times the one that the rule declares
LARGEST_RATIO = 1e12  # of the bounds of a logarithmic range
TICK_RATES = (30.0, 60.0)  # Hz, at which a gain per tick is reported
OVERRIDES = ("low", "high", "kind", "scale")


@dataclasses.dataclass(frozen=True)
class FreeParameter:
    """One free parameter: a leaf of the system, or one leg's element of it."""

    name: str
    """Dotted, with [leg] for one element."""
    low: float
    high: float
    kind: parameter_tree.ParameterKind
    scale: parameter_tree.Scale
    above: str | None
    """Dotted name of the leaf that the value stays above."""

    @property
    def leaf(self) -> str:
        """Dotted name without the leg."""
        return self.name.partition("[")[0]

    @property
    def leg(self) -> int | None:
        """Index of the leg whose element is free, or None for the whole leaf."""
        index = self.name.partition("[")[2]
        return int(index[:-1]) if index else None


def free_parameter(
    ik: eqx.Module, name: str, rig: Rig | None = None, **overrides: float | int | str
) -> FreeParameter:
    """The parameter of this name as its rule declares it, with overrides.

    A name like `foot.max_pitch[0]` frees one leg's element; the bare name of a leaf with one value
    per leg frees a single value that all legs share.

    Args:
        ik: system, a tree of rules.
        name: dotted name.
        rig: whose body the declared range is for; None is the adult.
        overrides: any of `low`, `high`, `kind`, `scale`.

    Raises:
        ValueError: for an unknown name or override, a leg that does not exist, or bounds that are
            out of order or outside the scale's domain.
    """
    declared = scaled_declarations(ik, rig)
    leaf = name.partition("[")[0]
    if leaf not in declared:
        nearest = difflib.get_close_matches(leaf, declared, n=1, cutoff=0.0)
        hint = f"; nearest is {nearest[0]!r}" if nearest else ""
        raise ValueError(f"no parameter named {leaf!r}{hint}; there are {sorted(declared)}")
    if unknown := sorted(set(overrides) - set(OVERRIDES)):
        raise ValueError(f"{name}: unknown {unknown}; a free parameter takes {sorted(OVERRIDES)}")
    declaration = declared[leaf]
    kind = overrides.get("kind", declaration.kind)
    scale = overrides.get("scale", declaration.scale)
    _check_choice(name, "kind", kind, get_args(parameter_tree.ParameterKind))
    _check_choice(name, "scale", scale, get_args(parameter_tree.Scale))
    present_value(ik, name)  # raises for a leg that does not exist
    parameter = FreeParameter(
        name=name,
        low=float(overrides.get("low", declaration.low)),
        high=float(overrides.get("high", declaration.high)),
        kind=cast(parameter_tree.ParameterKind, kind),
        scale=cast(parameter_tree.Scale, scale),
        above=_absolute(declaration.above, leaf),
    )
    _check(parameter, declaration)
    return parameter


def check_inside(parameter: FreeParameter, what: str, value: float) -> None:
    """Checks that a value is one that the parameter can take.

    Args:
        parameter: whose bounds count.
        what: the value is, for the error message.
        value: in the parameter's unit.

    Raises:
        ValueError: it is outside the bounds.
    """
    if not parameter.low <= value <= parameter.high:
        raise ValueError(
            f"{parameter.name}: {what} is {value:g}, wanted from {parameter.low:g} to"
            f" {parameter.high:g}"
        )


def present_value(ik: eqx.Module, name: str) -> float:
    """The value that a system has now: of one leg's element, or the mean over a leaf's elements.

    Raises:
        ValueError: for an element that does not exist.
    """
    leaf, bracket, rest = name.partition("[")
    value = np.asarray(parameter_tree.get(ik, leaf))
    if not bracket:
        return float(value.mean())
    elements = [f"{leaf}[{i}]" for i in range(value.shape[0])] if value.ndim else []
    if name not in elements:
        hint = f"there are {elements}" if elements else "it is shared by the legs"
        raise ValueError(f"no element {name!r}: {hint}")
    return float(value[int(rest[:-1])])


def _absolute(above: str | None, leaf: str) -> str | None:
    """Dotted name of a field that is declared by its name within the rule of `leaf`."""
    if above is None or "." not in leaf:
        return above
    return f"{leaf.rpartition('.')[0]}.{above}"


def _check_choice(name: str, key: str, value: float | str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ValueError(f"{name}: {key} is {value!r}, wanted one of {choices}")


def _check(parameter: FreeParameter, declaration: parameter_tree.Declaration) -> None:
    """Raises ValueError for bounds that make no sense."""
    low, high = parameter.low, parameter.high
    bounds = f"{parameter.name}: bounds are {low} to {high}"
    minimum, maximum = DOMAINS[parameter.scale]
    if not minimum < low < high < maximum:
        raise ValueError(
            f"{bounds}, wanted low < high"
            f" strictly between {minimum} and {maximum} for the scale {parameter.scale!r}"
        )
    usual = declaration.high - declaration.low
    narrowest, widest = NARROWEST * max(usual, abs(low), abs(high)), WIDEST * usual
    if not narrowest <= high - low <= widest:
        raise ValueError(
            f"{bounds}, {high - low:g} apart, wanted {narrowest:g} to {widest:g};"
            f" its rule has {declaration.low:g} to {declaration.high:g}"
        )
    if parameter.scale == "log" and high / low > LARGEST_RATIO:
        raise ValueError(
            f"{bounds}, wanted at most {LARGEST_RATIO:g} times the lower one for the scale 'log'"
        )


def library_of(*arrays: object) -> ModuleType:
    """JAX if any of these is traced, else NumPy, which takes no time to compile or to call."""
    return jnp if any(isinstance(array, Tracer) for array in arrays) else np


def to_scale(value: Any, scale: parameter_tree.Scale, library: ModuleType) -> Any:
    """The coordinate in which a range is divided evenly: `g` of `space`'s docstring."""
    match scale:
        case "log":
            return library.log(value)
        case "gain":
            return library.log(-library.log1p(-value))
        case _:
            return value


def from_scale(coordinate: Any, scale: parameter_tree.Scale, library: ModuleType) -> Any:
    """Inverse of `to_scale`."""
    match scale:
        case "log":
            return library.exp(coordinate)
        case "gain":
            return -library.expm1(-library.exp(coordinate))
        case _:
            return coordinate


def scale_width(parameter: FreeParameter) -> float:
    """Width of a parameter's range on its scale."""
    return float(
        np.diff(to_scale(np.array([parameter.low, parameter.high]), parameter.scale, np))[0]
    )


def to_fractions(
    parameter: FreeParameter, values: Float[np.ndarray, "*n"]
) -> Float[np.ndarray, "*n"]:
    """Where values lie in a parameter's range, 0..1, evenly on its scale."""
    start, end = to_scale(np.array([parameter.low, parameter.high]), parameter.scale, np)
    return (to_scale(np.asarray(values), parameter.scale, np) - start) / (end - start)


def from_fractions(
    parameter: FreeParameter, fractions: Float[np.ndarray, "*n"]
) -> Float[np.ndarray, "*n"]:
    """Inverse of `to_fractions`."""
    start, end = to_scale(np.array([parameter.low, parameter.high]), parameter.scale, np)
    return from_scale(start + (end - start) * np.asarray(fractions), parameter.scale, np)


def gain_readings(gain: float, tick_hz: float = 30.0) -> dict[str, float]:
    """The half-life, s, of a gain per tick, and the gains with the same half-life at other rates.

    Args:
        gain: fraction of the distance to its target that a value moves in each tick.
        tick_hz: ticks per second.
    """
    per_tick, rate = jnp.asarray(gain), jnp.asarray(tick_hz)
    readings = {"half_life": float(smoothing.half_life_of_gain(per_tick, rate))}
    for hz in TICK_RATES:
        fraction = smoothing.fraction_of_gain(per_tick, jnp.asarray(1.0 / hz), rate)
        readings[f"gain_at_{hz:.0f}_hz"] = float(fraction)
    return readings
