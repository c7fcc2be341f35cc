"""The free parameters of a system as one unbounded vector `u`, for solvers and samplers.

Per parameter

    value = g⁻¹( g(floor) + (g(high) - g(floor)) sigmoid(u) )

with `g` the identity, the logarithm, or for a gain `log(-log(1 - gain))`, which is minus the
logarithm of its half-life up to a constant, so that the tick rate cancels. `floor` is the lower
bound, or, for a parameter declared above another one, the larger of that bound and the other one's
value: the order holds for every `u`.

`start` is where a search begins, and `prior` what is known of `u` before any data; both are at the
values of the system as it is, unless told otherwise. A value in the outer sixth of its range often
means that something is off, and not how it is when it is on: such a prior is centred a sixth
inside. A uniform prior of a parameter declared above another one is uniform between that one's
value and the upper bound, whatever that value is.
"""

import math
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any, Generic, TypeAlias, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from scipy import special

from fitting.runtime.precision import in_float64
from jaxik.maths import parameter_tree

from .free_parameters import (
    FreeParameter,
    check_inside,
    from_scale,
    library_of,
    present_value,
    to_scale,
)
from .prior import SPREAD, Prior, Priors

OWN_CENTRE_LIMIT = math.log(5)  # of u, for priors that are centred at the system's value: a sixth
CENTRE_LIMIT = 3.0  # of u, for given centres and for starts: at a bound u is infinite
EDGE = 1e-6  # fraction of the range that `pack` keeps from a bound, where u is infinite
INTERVAL = (0.025, 0.975)  # the probabilities at the ends of a 95 % interval
SILENT = np.errstate(all="ignore")  # NumPy about NaN and infinity, as programs are
DRAWS = 20_000  # from the prior, for the interval of a parameter that depends on another one

System = TypeVar("System", bound=eqx.Module)
Vector: TypeAlias = Float[Array | np.ndarray, " free"]
Rows = TypeVar("Rows", bound=Float[Array | np.ndarray, "*rows free"])


class Space(eqx.Module, Generic[System]):
    """The free parameters of a system as one unbounded vector `u`; `make_space` builds it."""

    system: System
    """What is not free keeps the values it has here."""
    prior: Prior
    """Of u."""
    start: Float[Array, " free"]
    """Where a search begins, in u."""
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

    @property
    def dependent(self) -> tuple[int, ...]:
        """Indices of the parameters that stay above another free one."""
        leaves = {parameter.leaf for parameter in self.parameters}
        return tuple(i for i, p in enumerate(self.parameters) if p.above in leaves)

    @in_float64
    def unpack(self, u: Vector) -> System:
        """The system with the parameters that `u` stands for."""
        return parameter_tree.replace(self.system, self._leaves_and_values(u)[0])

    @in_float64
    def values(self, u: Rows) -> Rows:
        """The free parameters in their own units, of any number of `u`; NumPy's for NumPy's."""
        values = _free_last(self._leaves_and_values(u)[1])
        return cast(Rows, values if isinstance(u, np.ndarray) else jnp.asarray(values))

    @in_float64
    def pack(self, source: System | Mapping[str, ArrayLike]) -> Float[Array, "*rows free"]:
        """`u` of a system, or of values by name; names left out keep this system's values.

        Values outside their bounds are clipped. Where the legs of a leaf differ but share one free
        parameter, it takes their mean.

        Args:
            source: a system, or values; of each name one, or as many as there are rows.

        Raises:
            ValueError: for a name that is not free.
        """
        if not isinstance(source, Mapping):
            return jnp.asarray(self._pack(source, {}))
        if unknown := sorted(set(source) - set(self.names)):
            raise ValueError(f"not free: {unknown}; free are {list(self.names)}")
        return jnp.asarray(self._pack(self.system, source))

    def pack_values(
        self, values: Float[np.ndarray, "*rows free"]
    ) -> Float[np.ndarray, "*rows free"]:
        """`u` of any number of values, in the order of `names`; inverse of `values`."""
        columns = np.moveaxis(np.asarray(values, self.start.dtype), -1, 0)
        return np.asarray(self._pack(self.system, dict(zip(self.names, columns, strict=True))))

    @SILENT
    def _pack(self, system: eqx.Module, values: Mapping[str, ArrayLike]) -> Any:
        leaves = self._leaves(system)
        library = library_of(self.low, *leaves.values(), *values.values())
        leaves = {name: library.asarray(leaf) for name, leaf in leaves.items()}
        low, high = library.asarray(self.low), library.asarray(self.high)
        u = [library.zeros(())] * self.size
        for i in self.order:
            parameter = self.parameters[i]
            leaf = leaves[parameter.leaf]
            if parameter.leg is None:
                present = library.mean(leaf, axis=tuple(range(len(_shape(self, parameter.leaf)))))
            else:
                present = leaf[parameter.leg]
            value = library.asarray(values.get(parameter.name, present), leaf.dtype)
            floor = _floor(self, i, leaves, low, library)
            start = to_scale(floor, parameter.scale, library)
            end = to_scale(high[i], parameter.scale, library)
            inside = library.clip(value, floor, high[i])
            coordinate = to_scale(inside, parameter.scale, library)
            fraction = library.clip((coordinate - start) / (end - start), EDGE, 1 - EDGE)
            u[i] = library.log(fraction) - library.log1p(-fraction)
            leaves[parameter.leaf] = _with_value(self, i, leaf, value, library)
        columns = library.broadcast_arrays(*u)
        return _free_last(library.stack(columns) if u else library.zeros((0,)))

    @in_float64
    def prior_residuals(self, u: Rows) -> Rows:
        """Half of their squares' sum is minus the log density of the prior, up to a constant."""
        return self.prior.residuals(u)

    def prior_costs(self, u: Float[np.ndarray, "*rows free"]) -> Float[np.ndarray, "*rows free"]:
        """The part of the cost that the prior of each parameter contributes."""
        return 0.5 * np.square(self.prior.residuals(np.asarray(u, self.start.dtype)))

    @in_float64
    def prior_interval(self) -> Float[np.ndarray, "free 2"]:
        """The central 95 % of the prior, in the parameters' units.

        Exact, except for a parameter that stays above another free one: its prior is a mixture over
        the values of that one, of which many are drawn. Its ends are right to 0.3 % of the range.
        """
        dependent = list(self.dependent)
        ends = self.prior.quantile(np.array(INTERVAL)[:, None])
        draws = self.prior.draw(np.random.default_rng(0), DRAWS if dependent else 1)
        values = self.values(np.concatenate([ends, draws]))
        interval = values[:2].T.copy()
        interval[dependent] = np.quantile(values[2:, dependent], INTERVAL, axis=0).T
        return interval

    @in_float64
    def with_prior(self, priors: Priors) -> "Space[System]":
        """The space with these priors of its parameters.

        Raises:
            ValueError: for a centre outside the bounds of its parameter.
        """
        chosen = {name: priors.of(name) for name in self.names}
        given = {name: p.centre for name, p in chosen.items() if p.centre is not None}
        uniform = np.array([p.shape == "uniform" for p in chosen.values()])
        spread = [SPREAD if p.spread is None else p.spread for p in chosen.values()]
        dtype = self.start.dtype
        prior = Prior(
            centre=jax.device_put(np.where(uniform, 0, self._centre(given))),
            spread=jax.device_put(np.where(uniform, 1, np.asarray(spread)).astype(dtype)),
            uniform=jax.device_put(uniform),
        )
        return eqx.tree_at(lambda space: space.prior, self, prior)

    @in_float64
    def with_start(self, values: Mapping[str, float]) -> "Space[System]":
        """The space with a start at these values, and at the system's where they are left out.

        Raises:
            ValueError: for a name that is not free, or a value outside the bounds.
        """
        start = jax.device_put(self._inside("start", values))
        return eqx.tree_at(lambda space: space.start, self, start)

    def _centre(self, given: Mapping[str, float]) -> Float[np.ndarray, " free"]:
        """`u` of the centres of normal priors; the system's own are not too far out."""
        centre, is_given = self._inside("centre", given), [name in given for name in self.names]
        return np.where(is_given, centre, np.clip(centre, -OWN_CENTRE_LIMIT, OWN_CENTRE_LIMIT))

    def _inside(self, what: str, values: Mapping[str, float]) -> Float[np.ndarray, " free"]:
        """`u` of values, the system's where left out, and not at a bound."""
        present = {}
        for p in self.parameters:
            if p.name in values:
                check_inside(p, what, values[p.name])
            present[p.name] = min(max(present_value(self.system, p.name), p.low), p.high)
        return np.clip(np.asarray(self.pack({**present, **values})), -CENTRE_LIMIT, CENTRE_LIMIT)

    def _leaves(self, system: eqx.Module) -> dict[str, Array]:
        """The leaves that are free, and those that a free one stays above."""
        names = [parameter.leaf for parameter in self.parameters]
        names += [parameter.above for parameter in self.parameters if parameter.above]
        return {name: parameter_tree.get(system, name) for name in names}

    @SILENT
    def _leaves_and_values(self, u: Any) -> tuple[dict[str, Any], Any]:
        """The system's leaves with the free values in them, (*legs, *rows), and (free, *rows)."""
        leaves = self._leaves(self.system)
        library = library_of(u, self.low, *leaves.values())
        if library is np:
            u = np.asarray(u, self.start.dtype)  # a program has done so already
        sigmoid = special.expit if library is np else jax.nn.sigmoid
        leaves = {name: library.asarray(leaf) for name, leaf in leaves.items()}
        low, high = library.asarray(self.low), library.asarray(self.high)
        fractions = sigmoid(library.moveaxis(u, -1, 0))
        values = list(fractions)
        for i in self.order:
            parameter = self.parameters[i]
            start = to_scale(_floor(self, i, leaves, low, library), parameter.scale, library)
            end = to_scale(high[i], parameter.scale, library)
            coordinate = start + (end - start) * fractions[i]
            values[i] = from_scale(coordinate, parameter.scale, library)
            leaf = leaves[parameter.leaf]
            leaves[parameter.leaf] = _with_value(self, i, leaf, values[i], library)
        return leaves, library.stack(values) if values else fractions


def _shape(space: Space, name: str) -> tuple[int, ...]:  # no method: binding one takes 0.3 ms
    """That of a leaf in the system: empty, or a value for each leg."""
    return parameter_tree.get(space.system, name).shape


def _floor(space: Space, i: int, leaves: Mapping[str, Any], low: Any, library: ModuleType) -> Any:
    """Minimum of the i-th parameter, which depends on the leaf that it stays above."""
    parameter = space.parameters[i]
    if parameter.above is None:
        return low[i]
    below = leaves[parameter.above]
    if _shape(space, parameter.above):
        highest = library.argmax(below, axis=0)[None]
        of_legs = library.take_along_axis(below, highest, axis=0)[0]
        below = of_legs if parameter.leg is None else below[parameter.leg]
    return library.where(below > low[i], below, low[i])


def _with_value(space: Space, i: int, leaf: Any, value: Any, library: ModuleType) -> Any:
    """The i-th parameter's leaf with this value for one leg, or for all, (*legs, *rows)."""
    parameter = space.parameters[i]
    value = value.astype(leaf.dtype)
    if parameter.leg is None:
        return library.broadcast_to(value, (*_shape(space, parameter.leaf), *value.shape))
    legs = [value if leg == parameter.leg else leaf[leg] for leg in range(len(leaf))]
    return library.stack(library.broadcast_arrays(*legs))


def _free_last(columns: Any) -> Any:
    """(free, *rows) as (*rows, free)."""
    return library_of(columns).moveaxis(columns, 0, -1)


def make_space(ik: System, parameters: Sequence[FreeParameter]) -> Space[System]:
    """The space of these free parameters of a system, if any, with the default prior and start.

    Raises:
        ValueError: for one named twice, or one that has no room left above another.
    """
    for parameter in parameters:
        _check_free_once(parameter, parameters)
        _check_room(ik, parameter, parameters)
    leaves = [parameter_tree.get(ik, parameter.leaf) for parameter in parameters]
    dtype = leaves[0].dtype if leaves else jnp.result_type(float)
    zeros = jax.device_put(np.zeros(len(parameters), dtype))
    space = Space(
        system=ik,
        prior=Prior(zeros, zeros, jax.device_put(np.zeros(len(parameters), bool))),
        start=zeros,
        low=jax.device_put(np.asarray([p.low for p in parameters], dtype)),
        high=jax.device_put(np.asarray([p.high for p in parameters], dtype)),
        parameters=tuple(parameters),
        order=_order(parameters),
    )
    return space.with_prior(Priors()).with_start({})


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
