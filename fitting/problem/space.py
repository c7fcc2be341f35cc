"""The free parameters of a system as one unbounded vector `u`, for solvers and samplers.

Per parameter, whose range, kind and scale its declaration says,

    value = g⁻¹( g(floor) + (g(high) - g(floor)) sigmoid(u) )

with `g` the identity or the logarithm. `floor` is the lower bound, or, for a parameter declared
above another one, the larger of that bound and the other one's value: the order holds for every
`u`. `start` is where a search begins.

`prior` is the knowledge before any data, of each parameter independently, in one of two shapes:

    normal     log density = -½ ((u - centre) / spread)²          up to a constant
    uniform    log density = -2 log cosh(u / 2)                   up to a constant

Both it and `start` are at the system's values, unless specified otherwise. A value in the
outer sixth of its range often means that something is off, and not how it is when it is on: such a
prior is centred a sixth inside. The uniform prior is the logistic distribution, whose image under
the sigmoid is uniform: the value is anywhere in its range with equal density, on the parameter's
scale; of a parameter declared above another one, between that one's value and the upper bound. The
solver needs residuals, half of whose squares' sum is minus the log density; the sampler takes the
same function, and since both see densities of `u`, no Jacobian of the transform enters.

Arrays are JAX's, or NumPy's where `library` says so.
"""

import dataclasses
import difflib
import math
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any, Generic, Literal, TypeAlias, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float
from scipy import special

from fitting.runtime.declarations import Table, check_table, key, keys
from fitting.runtime.precision import in_float64
from jaxik.maths import parameter_tree
from jaxik.world.body import scaled_declarations
from jaxik.world.skeleton import Rig

DOMAINS = {"linear": (-math.inf, math.inf), "log": (0.0, math.inf)}
NARROWEST, WIDEST = 1e-6, 1e6  # of a range, times the one that the rule declares
LARGEST_RATIO = 1e12  # of the bounds of a logarithmic range

Points = TypeVar("Points", bound=Float[Array | np.ndarray, "*points free"])
Shape = Literal["normal", "uniform"]

SPREAD = 1.6  # of u: the logistic of a normal this wide is nearly uniform
LOGISTIC_SD = math.pi / math.sqrt(3)  # of the logistic distribution

OWN_CENTRE_LIMIT = math.log(5)  # of u, for priors that are centred at the system's value: a sixth
CENTRE_LIMIT = 3.0  # of u, for centres that a user sets and for starts: at a bound u is infinite
EDGE = 1e-6  # fraction of the range that `pack` keeps from a bound, where u is infinite
INTERVAL = (0.025, 0.975)  # the probabilities at the ends of a 95 % interval
SILENT = np.errstate(all="ignore")  # NumPy about NaN and infinity, as programs are
DRAWS = 20_000  # from the prior, for the interval of a parameter that depends on another one

System = TypeVar("System", bound=eqx.Module)
Vector: TypeAlias = Float[Array | np.ndarray, " free"]
Rows = TypeVar("Rows", bound=Float[Array | np.ndarray, "*rows free"])

MIXTURE = 200  # draws of the others, where a parameter stays above another free one


@dataclasses.dataclass(frozen=True)
class Override:
    """Where a table [free] differs from the declaration of a parameter."""

    low: float | None = key(None, "The fit goes no lower; in the parameter's unit.")
    high: float | None = key(None, "The fit goes no higher; in the parameter's unit.")
    kind: parameter_tree.ParameterKind | None = key(
        None, "A threshold moves a hard decision, so that its derivative is 0."
    )
    scale: parameter_tree.Scale | None = key(None, "How the fit steps: evenly, or by factors.")


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
    declaration = declared[leaf]
    bounds = {"low": float(declaration.low), "high": float(declaration.high)}
    usual = bounds | {"kind": declaration.kind, "scale": declaration.scale}
    values: Any = usual | check_table(overrides, keys(Override), name)
    present_value(ik, name)  # raises for a leg that does not exist
    above = declaration.above  # a field of the same rule
    if above is not None and "." in leaf:
        above = f"{leaf.rpartition('.')[0]}.{above}"
    parameter = FreeParameter(name=name, above=above, **values)
    _check(parameter, declaration)
    return parameter


def check_inside(parameter: FreeParameter, what: str, value: float) -> None:
    """Checks that a value is one that the parameter can have; `what` it is goes into the message.

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
    return library.log(value) if scale == "log" else value


def from_scale(coordinate: Any, scale: parameter_tree.Scale, library: ModuleType) -> Any:
    """Inverse of `to_scale`."""
    return library.exp(coordinate) if scale == "log" else coordinate


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


@dataclasses.dataclass(frozen=True)
class ParameterPrior(Table):
    """The prior of one parameter, as an experiment states it.

    Raises:
        ValueError: for an unknown shape, a spread out of its range, or a uniform prior with a
            centre or a spread.
    """

    shape: Shape = key(
        "normal",
        "Distribution of u, the free parameter on its scale; a uniform one has no centre and no"
        " spread.",
    )
    centre: float | None = key(
        None, "Median, in the parameter's unit; left out, the system's value."
    )
    spread: float | None = key(None, "Standard deviation of u.", "", 1e-3, 1e3)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("centre", "spread"):
            if self.shape == "uniform" and getattr(self, name) is not None:
                raise ValueError(f"{name} is given, but a uniform prior has none: it is the range")


@dataclasses.dataclass(frozen=True)
class Priors:
    """The priors of an experiment's free parameters."""

    default: ParameterPrior = ParameterPrior()
    """Of all parameters that have none of their own; without a centre."""
    named: Mapping[str, ParameterPrior] = dataclasses.field(default_factory=dict)
    """By dotted name."""

    def of(self, name: str) -> ParameterPrior:
        """The prior of the parameter with this name."""
        return self.named.get(name, self.default)


class Prior(eqx.Module):
    """The joint prior of `u`; the parameters are independent."""

    centre: Float[Array, " free"]
    """Of u; 0 where uniform."""
    spread: Float[Array, " free"]
    """Of u: a normal's standard deviation, or the scale of a logistic, 1 where uniform."""
    uniform: Bool[Array, " free"]
    """Where the prior is not a normal."""

    @property
    def sd(self) -> Float[Array, " free"]:
        """Standard deviation of u."""
        return self.spread * jnp.where(self.uniform, LOGISTIC_SD, 1.0).astype(self.spread.dtype)

    def residuals(self, u: Points) -> Points:
        """Half of each square is minus the log density, above its minimum.

        For a normal prior that is the distance from its centre in standard deviations.
        """
        library = library_of(u, self.centre)
        centre, spread = library.asarray(self.centre), library.asarray(self.spread)
        z = (u - centre) / spread
        return library.where(self.uniform, _logistic_residual(z, library), z)

    def quantile(self, probability: Float[np.ndarray, "*points #free"]) -> np.ndarray:
        """The `u` below which each parameter lies with this probability, (*points, free)."""
        normal, logistic = special.ndtri(probability), special.logit(probability)
        z = np.where(np.asarray(self.uniform), logistic, normal)
        return np.asarray(self.centre) + np.asarray(self.spread) * z

    def cumulative(self, u: Float[np.ndarray, "*points free"]) -> np.ndarray:
        """The probability that each parameter lies below its `u`, (*points, free)."""
        z = (u - np.asarray(self.centre)) / np.asarray(self.spread)
        return np.where(np.asarray(self.uniform), special.expit(z), special.ndtr(z))

    def widened(self, factor: float) -> "Prior":
        """The prior with all spreads multiplied; a uniform one does not stay uniform."""
        return eqx.tree_at(lambda prior: prior.spread, self, factor * self.spread)

    def draw(self, random: np.random.Generator, count: int) -> Float[np.ndarray, "count free"]:
        """Independent draws of `u`."""
        return self.quantile(random.random((count, self.centre.size)))

    def ends(self, rise: float | Float[np.ndarray, " free"]) -> Float[np.ndarray, "2 free"]:
        """The `u` on either side at which minus the log density exceeds its minimum by `rise`."""
        normal, logistic = np.sqrt(2 * rise), 2 * np.arccosh(np.exp(0.5 * rise))
        z = np.where(np.asarray(self.uniform), logistic, normal) * np.array([[-1.0], [1.0]])
        return np.asarray(self.centre) + np.asarray(self.spread) * z


def _logistic_residual(z: Any, library: ModuleType) -> Any:
    """`2 sign(z) sqrt(log cosh(z / 2))`, without the root of 0 and without overflow."""
    half = 0.5 * z
    near = library.abs(half) < 1
    sinh = library.sinh(library.where(near, half, 0.0))
    square = sinh**2  # log cosh² = log1p(sinh²)
    nonzero = square > library.finfo(z.dtype).eps  # below it the factor rounds to 1
    safe = library.where(nonzero, square, 1.0)
    at_near = sinh * library.sqrt(2.0 * library.where(nonzero, library.log1p(safe) / safe, 1.0))
    size = library.where(near, 1.0, library.abs(half))
    log_cosh = size + library.log1p(library.exp(-2.0 * size)) - math.log(2)
    return library.where(near, at_near, 2.0 * library.sign(z) * library.sqrt(log_cosh))


class Space(eqx.Module, Generic[System]):
    """The free parameters of a system as one unbounded vector `u`; `make_space` builds it."""

    system: System
    """With the values of all that is not free."""
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
        """`u` of a system, or of values by name, one or as many as there are rows.

        Names left out have this system's values. Values outside their bounds are clipped. Where the
        legs of a leaf differ but share one free parameter, it has their mean.

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
        centres = {name: p.centre for name, p in chosen.items() if p.centre is not None}
        uniform = np.array([p.shape == "uniform" for p in chosen.values()])
        spread = [SPREAD if p.spread is None else p.spread for p in chosen.values()]
        dtype = self.start.dtype
        prior = Prior(
            centre=jax.device_put(np.where(uniform, 0, self._centre(centres))),
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

    def _centre(self, values: Mapping[str, float]) -> Float[np.ndarray, " free"]:
        """`u` of the centres of normal priors; the system's own are not too far out."""
        centre, is_set = self._inside("centre", values), [name in values for name in self.names]
        return np.where(is_set, centre, np.clip(centre, -OWN_CENTRE_LIMIT, OWN_CENTRE_LIMIT))

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
    """The shape of a leaf in the system: empty, or a value for each leg."""
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


@in_float64
def prior_probability(
    space: Space, values: Float[np.ndarray, "points free"]
) -> Float[np.ndarray, "points free"]:
    """The probability, by the prior alone, that each parameter is at most each of these values.

    Exact, except for a parameter that stays above another free one: the mean over draws of that
    one. Values outside the bounds have probability 0 or 1.
    """
    probability = _probability(space, values)
    for i in space.dependent:
        draws = space.prior.draw(np.random.default_rng(0), MIXTURE)
        rows = np.asarray(space.values(draws))
        table = np.repeat(rows[:, None], len(values), axis=1)
        table[..., i] = values[:, i]
        mixed = _probability(space, table.reshape(-1, space.size))[:, i]
        probability[:, i] = mixed.reshape(MIXTURE, -1).mean(axis=0)
    return probability


def _probability(space: Space, rows: np.ndarray) -> np.ndarray:
    """Of the last moved parameter given the others of its row, (rows, free)."""
    u = space.pack_values(rows)
    below, above = rows <= np.asarray(space.low), rows >= np.asarray(space.high)
    return np.where(below, 0.0, np.where(above, 1.0, space.prior.cumulative(u)))
