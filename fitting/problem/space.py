"""What a fit may change, as one unbounded vector.

`u` is the vector of the free parameters in coordinates without bounds. Per parameter

    value = g⁻¹( g(floor) + (g(high) - g(floor)) sigmoid(u) )

with `g` the identity, the logarithm, or for a gain `log(-log(1 - gain))`, which is minus the
logarithm of its half-life but for a constant, so that the tick rate cancels. `floor` is the lower
bound, or, for a parameter declared above another one, the larger of that bound and the other one's
value: the order holds for every `u`.

The prior is a normal in `u`, not in the value: the solver's prior rows and the sampler's
log-probability are then the same function and no Jacobian of the transform enters. With its default
width and centre it is nearly flat over the range (within a factor of two between 7 % and 93 %).
"""

import dataclasses
import difflib
import math
from collections.abc import Mapping, Sequence
from typing import Any, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.runtime.program_cache import cached
from jaxik.maths import parameter_tree

PRIOR_SD = 1.6  # of u: the logistic of a normal this wide is nearly uniform
CENTRE_LIMIT = 3.0  # of u: a prior centred at a bound would hide the rest of the range
EDGE = 1e-6  # share of the range that `pack` keeps from a bound, where u is infinite


@dataclasses.dataclass(frozen=True)
class FreeParameter:
    """One free parameter: a leaf of the system, or one leg's element of it."""

    name: str  # dotted, with [leg] for one element
    low: float
    high: float
    prior_mean: float  # value
    prior_sd: float  # in u
    kind: parameter_tree.Kind
    scale: parameter_tree.Scale
    above: str | None  # dotted name of the leaf that the value stays above

    @property
    def leaf(self) -> str:
        """Dotted name without the leg."""
        return self.name.partition("[")[0]

    @property
    def leg(self) -> int | None:
        """Which leg's element, or None for the whole leaf."""
        index = self.name.partition("[")[2]
        return int(index[:-1]) if index else None


def free_parameter(ik: eqx.Module, name: str, **overrides: Any) -> FreeParameter:
    """The parameter of this name, made free as its rule declares it.

    A name like `foot.max_pitch[0]` frees one leg's element; the bare name of a leaf with one value
    per leg frees one value that all legs share. The prior is centred at the present value, taken
    into the bounds.

    Args:
        ik: tree of rules.
        name: dotted name.
        overrides: any of `low`, `high`, `prior_mean`, `prior_sd`, `kind`, `scale`.

    Raises:
        ValueError: for an unknown name or override, a leg that is not there, or impossible bounds.
    """
    leaf, bracket, rest = name.partition("[")
    declared = parameter_tree.declarations(ik)
    if leaf not in declared:
        nearest = difflib.get_close_matches(leaf, declared, n=1, cutoff=0.0)
        hint = f"; nearest is {nearest[0]!r}" if nearest else ""
        raise ValueError(f"no parameter named {leaf!r}{hint}; there are {sorted(declared)}")
    known = {"low", "high", "prior_mean", "prior_sd", "kind", "scale"}
    if unknown := sorted(set(overrides) - known):
        raise ValueError(f"{name}: unknown {unknown}; a free parameter takes {sorted(known)}")
    value = parameter_tree.get(ik, leaf)
    if bracket:
        legs = [f"{leaf}[{i}]" for i in range(value.shape[0])] if value.ndim else []
        if name not in legs:
            there = f"there are {legs}" if legs else "it is shared by the legs"
            raise ValueError(f"no element {name!r}: {there}")
        value = value[int(rest[:-1])]
    declaration = declared[leaf]
    above = declaration.above
    if above is not None and "." in leaf:
        above = f"{leaf.rpartition('.')[0]}.{above}"
    low = float(overrides.get("low", declaration.low))
    high = float(overrides.get("high", declaration.high))
    made = FreeParameter(
        name=name,
        low=low,
        high=high,
        prior_mean=float(
            overrides.get("prior_mean", min(max(float(np.asarray(value).mean()), low), high))
        ),
        prior_sd=float(overrides.get("prior_sd", PRIOR_SD)),
        kind=_one_of(name, "kind", overrides.get("kind", declaration.kind), parameter_tree.Kind),
        scale=_one_of(
            name, "scale", overrides.get("scale", declaration.scale), parameter_tree.Scale
        ),
        above=above,
    )
    _check(made)
    return made


def _one_of(name: str, what: str, given: Any, words: Any) -> Any:
    if given not in get_args(words):
        raise ValueError(f"{name}: {what} is {given!r}, wanted one of {get_args(words)}")
    return given


def _check(one: FreeParameter) -> None:
    """Raises ValueError where bounds or prior make no sense."""
    allowed = {"linear": (-math.inf, math.inf), "log": (0.0, math.inf), "gain": (0.0, 1.0)}
    least, most = allowed[one.scale]
    if not least < one.low < one.high < most:
        raise ValueError(
            f"{one.name}: bounds are {one.low} to {one.high}, wanted low < high"
            f" strictly between {least} and {most} for the scale {one.scale!r}"
        )
    if not one.low <= one.prior_mean <= one.high:
        raise ValueError(
            f"{one.name}: prior_mean is {one.prior_mean}, wanted from {one.low} to {one.high}"
        )
    if not 0 < one.prior_sd < math.inf:
        raise ValueError(f"{one.name}: prior_sd is {one.prior_sd}, wanted more than 0")


def _straighten(value: Array, scale: parameter_tree.Scale) -> Array:
    """The coordinate in which a range is divided evenly."""
    match scale:
        case "log":
            return jnp.log(value)
        case "gain":
            return jnp.log(-jnp.log1p(-value))
        case _:
            return value


def _bend(straight: Array, scale: parameter_tree.Scale) -> Array:
    """Inverse of `_straighten`."""
    match scale:
        case "log":
            return jnp.exp(straight)
        case "gain":
            return -jnp.expm1(-jnp.exp(straight))
        case _:
            return straight


class Space(eqx.Module):
    """The free parameters of a system as one unbounded vector `u`."""

    base: eqx.Module  # the system; what is not free keeps its values
    u0: Float[Array, " free"]  # centre of the prior, and where a fit starts
    prior_sd: Float[Array, " free"]  # in u
    low: Float[Array, " free"]
    high: Float[Array, " free"]
    frees: tuple[FreeParameter, ...] = eqx.field(static=True)
    order: tuple[int, ...] = eqx.field(static=True)  # what is above another comes after it

    @property
    def names(self) -> tuple[str, ...]:
        """Of the free parameters, in the order of `u`."""
        return tuple(one.name for one in self.parameters)

    @property
    def size(self) -> int:
        """How many are free."""
        return len(self.parameters)

    @property
    def smooth(self) -> tuple[bool, ...]:
        """Which parameters have a slope."""
        return tuple(one.kind == "smooth" for one in self.parameters)

    @property
    def thresholds(self) -> tuple[bool, ...]:
        """Which parameters only move hard decisions."""
        return tuple(one.kind == "threshold" for one in self.parameters)

    def unpack(self, u: Float[Array, " free"]) -> Any:
        """The system with these free parameters."""
        return parameter_tree.replace(self.base, self._write(u)[0])  # type: ignore[type-var]

    @eqx.filter_jit
    def values(self, u: Float[Array, " free"]) -> Float[Array, " free"]:
        """The free parameters in their own units."""
        return self._write(u)[1]

    def pack(self, given: Any) -> Float[Array, " free"]:
        """`u` of a system, or of values by name; names left out keep the base's values.

        A value outside its bounds is taken to the nearest one. Of a leaf that holds one value per
        leg but is freed as one, the legs' mean counts.

        Raises:
            ValueError: for a name that is not free.
        """
        named = dict(given) if isinstance(given, Mapping) else {}
        if unknown := sorted(set(named) - set(self.names)):
            raise ValueError(f"not free: {unknown}; free are {list(self.names)}")
        tree = self.base if isinstance(given, Mapping) else given
        return self._pack(tree, {name: jnp.asarray(value) for name, value in named.items()})

    @cached  # apart, every line would be a program
    def _pack(self, tree: Any, named: dict[str, Array]) -> Array:
        leaves = self._leaves(tree)
        u = [jnp.zeros(())] * self.size
        for i in self.order:
            one = self.parameters[i]
            leaf = leaves[one.leaf]
            present = jnp.mean(leaf if one.leg is None else leaf[one.leg])
            value = jnp.asarray(named.get(one.name, present), leaf.dtype)
            ends = jnp.stack([self._floor(i, leaves), self.high[i]])
            start, end = _straighten(ends, one.scale)
            share = (_straighten(jnp.clip(value, *ends), one.scale) - start) / (end - start)
            share = jnp.clip(share, EDGE, 1 - EDGE)
            u[i] = jnp.log(share) - jnp.log1p(-share)
            leaves[one.leaf] = _put(leaf, one.leg, value)
        return jnp.stack(u)

    def prior_residuals(self, u: Float[Array, " free"]) -> Float[Array, " free"]:
        """Distance from the prior's centre in prior standard deviations."""
        return (u - self.u0) / self.prior_sd

    def _leaves(self, tree: eqx.Module) -> dict[str, Array]:
        """The leaves that are free or that a free one stays above."""
        wanted = [one.leaf for one in self.parameters] + [
            one.above for one in self.parameters if one.above
        ]
        return {name: parameter_tree.get(tree, name) for name in wanted}

    def _floor(self, i: int, leaves: dict[str, Array]) -> Array:
        """Least value of the i-th parameter, given the leaf that it stays above."""
        one = self.parameters[i]
        if one.above is None:
            return self.low[i]
        partner = leaves[one.above]
        if partner.ndim and one.leg is not None:
            partner = partner[one.leg]
        elif partner.ndim:
            partner = partner[jnp.argmax(partner)]
        return jnp.where(partner > self.low[i], partner, self.low[i])

    def _write(self, u: Array) -> tuple[dict[str, Array], Array]:
        """The leaves with the free values in them, and those values."""
        leaves = self._leaves(self.base)
        values = [u[0]] * self.size
        for i in self.order:
            one = self.parameters[i]
            start = _straighten(self._floor(i, leaves), one.scale)
            end = _straighten(self.high[i], one.scale)
            values[i] = _bend(start + (end - start) * jax.nn.sigmoid(u[i]), one.scale)
            leaves[one.leaf] = _put(leaves[one.leaf], one.leg, values[i])
        return leaves, jnp.stack(values)


def _put(leaf: Array, leg: int | None, value: Array) -> Array:
    """The leaf with this value at one leg or at all."""
    value = value.astype(leaf.dtype)
    return jnp.broadcast_to(value, leaf.shape) if leg is None else leaf.at[leg].set(value)


def make_space(ik: eqx.Module, frees: Sequence[FreeParameter]) -> Space:
    """The space of these free parameters around a system.

    Raises:
        ValueError: for none, one named twice, or one whose partner leaves it no room.
    """
    if not frees:
        raise ValueError("nothing is free; name at least one parameter")
    for one in frees:
        same = [other for other in frees if other.leaf == one.leaf and other is not one]
        if any(other.leg is None or one.leg is None or other.leg == one.leg for other in same):
            raise ValueError(f"{one.name!r} is free twice: {[o.name for o in [one, *same]]}")
        if one.above is None:
            continue
        partners = [other for other in frees if other.leaf == one.above]
        fixed = (
            []
            if any(other.leg is None for other in partners)
            else [parameter_tree.get(ik, one.above)]
        )
        most = max([other.high for other in partners] + [float(leaf.max()) for leaf in fixed])
        if not most < one.high:
            raise ValueError(
                f"{one.name} stays above {one.above}, which reaches {most},"
                f" but its own upper bound is {one.high}"
            )
    dtype = parameter_tree.get(ik, frees[0].leaf).dtype
    space = Space(
        base=ik,
        u0=jax.device_put(np.zeros(len(frees), dtype)),
        prior_sd=jax.device_put(np.asarray([one.prior_sd for one in frees], dtype)),
        low=jax.device_put(np.asarray([one.low for one in frees], dtype)),
        high=jax.device_put(np.asarray([one.high for one in frees], dtype)),
        frees=tuple(frees),
        order=_order(frees),
    )
    centre = np.asarray(space.pack({one.name: one.prior_mean for one in frees}))
    middle = jax.device_put(np.clip(centre, -CENTRE_LIMIT, CENTRE_LIMIT))
    return eqx.tree_at(lambda s: s.u0, space, middle)


def _order(frees: Sequence[FreeParameter]) -> tuple[int, ...]:
    """Indices such that what a parameter stays above comes before it."""
    done: list[int] = []
    while len(done) < len(frees):
        waiting = [i for i in range(len(frees)) if i not in done]
        leaves = {frees[i].leaf for i in waiting}
        ready = [i for i in waiting if frees[i].above not in leaves]
        if not ready:
            raise ValueError(f"these stay above one another: {[frees[i].name for i in waiting]}")
        done += ready
    return tuple(done)
