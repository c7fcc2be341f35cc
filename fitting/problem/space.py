"""The free parameters of a system as one unbounded vector `u`, for solvers and samplers.

Per parameter

    value = g⁻¹( g(floor) + (g(high) - g(floor)) sigmoid(u) )

with `g` the identity, the logarithm, or for a gain `log(-log(1 - gain))`, which is minus the
logarithm of its half-life up to a constant, so that the tick rate cancels. `floor` is the lower
bound, or, for a parameter declared above another one, the larger of that bound and the other one's
value: the order holds for every `u`.

The prior is a normal in `u`, not in the value: the solver's prior residuals and the sampler's
log-probability are then the same function, and no Jacobian of the transform enters. With its
default width and centre it is nearly flat over the range (within a factor of two between 7 % and
93 % of it).
"""

from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any, Generic, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from fitting.runtime.precision import in_float64
from fitting.runtime.program_cache import cached
from jaxik.maths import parameter_tree

from .free_parameters import FreeParameter

CENTRE_LIMIT = 3.0  # of u: a prior centred at a bound would hide the rest of the range
EDGE = 1e-6  # fraction of the range that `pack` keeps from a bound, where u is infinite

System = TypeVar("System", bound=eqx.Module)
Vector: TypeAlias = Float[Array | np.ndarray, " free"]


class Space(eqx.Module, Generic[System]):
    """The free parameters of a system as one unbounded vector `u`; `make_space` builds it."""

    system: System
    """What is not free keeps the values it has here."""
    u0: Float[Array, " free"]
    """Centre of the prior, and where a fit starts."""
    prior_sd: Float[Array, " free"]
    """In u."""
    low: Float[Array, " free"]
    """In the parameters' units, like high."""
    high: Float[Array, " free"]
    parameters: tuple[FreeParameter, ...] = eqx.field(static=True)
    order: tuple[int, ...] = eqx.field(static=True)
    """a parameter comes after the one it is above."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters, in the order of `u`."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def size(self) -> int:
        """Number of free parameters."""
        return len(self.parameters)

    @property
    def smooth(self) -> tuple[bool, ...]:
        """Which parameters have a derivative."""
        return tuple(parameter.kind == "smooth" for parameter in self.parameters)

    @property
    def thresholds(self) -> tuple[bool, ...]:
        """Which parameters only move hard decisions, so that their derivative is zero."""
        return tuple(parameter.kind == "threshold" for parameter in self.parameters)

    @in_float64
    def unpack(self, u: Vector) -> System:
        """The system with the parameters that `u` stands for."""
        return parameter_tree.replace(self.system, self._leaves_and_values(jnp.asarray(u))[0])

    @in_float64
    @eqx.filter_jit
    def values(self, u: Vector) -> Float[Array, " free"]:
        """The free parameters in their own units."""
        return self._leaves_and_values(jnp.asarray(u))[1]

    @in_float64
    def pack(self, source: System | Mapping[str, ArrayLike]) -> Float[Array, " free"]:
        """`u` of a system, or of values by name; names left out keep this system's values.

        Values outside their bounds are clipped. Where the legs of a leaf differ but share one free
        parameter, it takes their mean.

        Raises:
            ValueError: for a name that is not free.
        """
        if not isinstance(source, Mapping):
            return self._pack(source, {})
        if unknown := sorted(set(source) - set(self.names)):
            raise ValueError(f"not free: {unknown}; free are {list(self.names)}")
        return self._pack(self.system, {k: jnp.asarray(value) for k, value in source.items()})

    @cached  # one program; otherwise every operation would be one
    def _pack(self, system: eqx.Module, values: Mapping[str, Array]) -> Array:
        leaves = self._leaves(system)
        u = [jnp.zeros(())] * self.size
        for i in self.order:
            parameter = self.parameters[i]
            leaf = leaves[parameter.leaf]
            present = jnp.mean(leaf if parameter.leg is None else leaf[parameter.leg])
            value = jnp.asarray(values.get(parameter.name, present), leaf.dtype)
            bounds = jnp.stack([self._floor(i, leaves), self.high[i]])
            start, end = _to_scale(bounds, parameter.scale)
            coordinate = _to_scale(jnp.clip(value, *bounds), parameter.scale)
            fraction = jnp.clip((coordinate - start) / (end - start), EDGE, 1 - EDGE)
            u[i] = jnp.log(fraction) - jnp.log1p(-fraction)
            leaves[parameter.leaf] = _with_value(leaf, parameter.leg, value)
        return jnp.stack(u)

    @in_float64
    def prior_residuals(self, u: Vector) -> Float[Array, " free"]:
        """Distance from the prior's centre in prior standard deviations."""
        return (jnp.asarray(u) - self.u0) / self.prior_sd

    def _leaves(self, system: eqx.Module) -> dict[str, Array]:
        """The leaves that are free, and those that a free one stays above."""
        names = [parameter.leaf for parameter in self.parameters]
        names += [parameter.above for parameter in self.parameters if parameter.above]
        return {name: parameter_tree.get(system, name) for name in names}

    def _floor(self, i: int, leaves: dict[str, Array]) -> Array:
        """Minimum of the i-th parameter, which depends on the leaf that it stays above."""
        parameter = self.parameters[i]
        if parameter.above is None:
            return self.low[i]
        below = leaves[parameter.above]
        if below.ndim and parameter.leg is not None:
            below = below[parameter.leg]
        elif below.ndim:
            below = below[jnp.argmax(below)]
        return jnp.where(below > self.low[i], below, self.low[i])

    def _leaves_and_values(self, u: Array) -> tuple[dict[str, Array], Array]:
        """The system's leaves with the free values in them, and those values."""
        leaves = self._leaves(self.system)
        values = [u[0]] * self.size
        for i in self.order:
            parameter = self.parameters[i]
            start = _to_scale(self._floor(i, leaves), parameter.scale)
            end = _to_scale(self.high[i], parameter.scale)
            coordinate = start + (end - start) * jax.nn.sigmoid(u[i])
            values[i] = _from_scale(coordinate, parameter.scale)
            leaves[parameter.leaf] = _with_value(leaves[parameter.leaf], parameter.leg, values[i])
        return leaves, jnp.stack(values)


def _to_scale(value: Any, scale: parameter_tree.Scale, library: ModuleType = jnp) -> Any:
    """The coordinate in which a range is divided evenly: `g` of the module's docstring."""
    match scale:
        case "log":
            return library.log(value)
        case "gain":
            return library.log(-library.log1p(-value))
        case _:
            return value


def _from_scale(coordinate: Any, scale: parameter_tree.Scale, library: ModuleType = jnp) -> Any:
    """Inverse of `_to_scale`."""
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
        np.diff(_to_scale(np.array([parameter.low, parameter.high]), parameter.scale, np))[0]
    )


def to_fractions(
    parameter: FreeParameter, values: Float[np.ndarray, "*n"]
) -> Float[np.ndarray, "*n"]:
    """Where values lie in a parameter's range, 0..1, evenly on its scale."""
    start, end = _to_scale(np.array([parameter.low, parameter.high]), parameter.scale, np)
    return (_to_scale(np.asarray(values), parameter.scale, np) - start) / (end - start)


def from_fractions(
    parameter: FreeParameter, fractions: Float[np.ndarray, "*n"]
) -> Float[np.ndarray, "*n"]:
    """Inverse of `to_fractions`."""
    start, end = _to_scale(np.array([parameter.low, parameter.high]), parameter.scale, np)
    return _from_scale(start + (end - start) * np.asarray(fractions), parameter.scale, np)


def _with_value(leaf: Array, leg: int | None, value: Array) -> Array:
    """The leaf with this value for one leg, or for all."""
    value = value.astype(leaf.dtype)
    return jnp.broadcast_to(value, leaf.shape) if leg is None else leaf.at[leg].set(value)


def make_space(ik: System, parameters: Sequence[FreeParameter]) -> Space[System]:
    """The space of these free parameters of a system.

    Raises:
        ValueError: for no parameter, one named twice, or one that has no room left above another.
    """
    if not parameters:
        raise ValueError("nothing is free; name at least one parameter")
    for parameter in parameters:
        _check_free_once(parameter, parameters)
        _check_room(ik, parameter, parameters)
    dtype = parameter_tree.get(ik, parameters[0].leaf).dtype
    space = Space(
        system=ik,
        u0=jax.device_put(np.zeros(len(parameters), dtype)),
        prior_sd=jax.device_put(np.asarray([p.prior_sd for p in parameters], dtype)),
        low=jax.device_put(np.asarray([p.low for p in parameters], dtype)),
        high=jax.device_put(np.asarray([p.high for p in parameters], dtype)),
        parameters=tuple(parameters),
        order=_order(parameters),
    )
    centre = np.asarray(space.pack({p.name: p.prior_mean for p in parameters}))
    limited = jax.device_put(np.clip(centre, -CENTRE_LIMIT, CENTRE_LIMIT))
    return eqx.tree_at(lambda space: space.u0, space, limited)


def _check_free_once(parameter: FreeParameter, parameters: Sequence[FreeParameter]) -> None:
    """Raises ValueError where another parameter is the same leaf, or an element of it."""
    others = [p for p in parameters if p.leaf == parameter.leaf and p is not parameter]
    if any(p.leg is None or parameter.leg is None or p.leg == parameter.leg for p in others):
        names = [p.name for p in (parameter, *others)]
        raise ValueError(f"{parameter.name!r} is free twice: {names}")


def _check_room(
    ik: eqx.Module, parameter: FreeParameter, parameters: Sequence[FreeParameter]
) -> None:
    """Raises ValueError where the leaf that a parameter stays above may exceed its upper bound."""
    if parameter.above is None:
        return
    free = [p for p in parameters if p.leaf == parameter.above]
    reached = [p.high for p in free]
    if all(p.leg is not None for p in free):  # some of its elements keep their values
        reached.append(float(parameter_tree.get(ik, parameter.above).max()))
    if not max(reached) < parameter.high:
        raise ValueError(
            f"{parameter.name} stays above {parameter.above}, which reaches {max(reached)},"
            f" but its own upper bound is {parameter.high}"
        )


def _order(parameters: Sequence[FreeParameter]) -> tuple[int, ...]:
    """Indices sorted so that each parameter comes after the one it stays above."""
    done: list[int] = []
    while len(done) < len(parameters):
        waiting = [i for i in range(len(parameters)) if i not in done]
        leaves = {parameters[i].leaf for i in waiting}
        ready = [i for i in waiting if parameters[i].above not in leaves]
        if not ready:
            names = [parameters[i].name for i in waiting]
            raise ValueError(f"these stay above one another: {names}")
        done += ready
    return tuple(done)
