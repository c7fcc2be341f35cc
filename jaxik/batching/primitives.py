"""Evaluates a trace for a whole batch (the engine of `lanes`); all that reads JAX's traces is here.

Batched values have the batch axis last. Values that all examples share keep their shape.

JAX promises neither the names of the primitives in a trace nor their parameters. So a rule here
states which parameters it reads, and takes whatever it can from shapes. An equation without a rule,
or whose parameters are others than its rule reads, goes through `jax.vmap`: the result is the same,
only slower. `tests/batching/test_primitives.py` says which equations of the pipeline do.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias, cast

import jax
import jax.numpy as jnp
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var
from jax.typing import ArrayLike
from jaxtyping import Array

UNROLLED_SUM = 8  # a sum of at most this many entries is written out

ELEMENTWISE = frozenset(
    "abs acos acosh add add_any and asin asinh atan atan2 atanh bitcast_convert_type cbrt ceil"
    " clamp convert_element_type copy copy_p cos cosh div eq erf erf_inv erfc exp exp2 expm1 floor"
    " ge gt integer_pow is_finite le log log1p logistic lt max min mul ne neg nextafter not or pow"
    " reduce_precision rem round rsqrt select_n shift_left shift_right_arithmetic"
    " shift_right_logical sign sin sinh sqrt square stop_gradient sub tan tanh xor".split()
)
# Primitives whose parameters name axes counted from the first: one more axis at the end makes no
# difference to them.
ALONG_AXES = frozenset(
    "argmax argmin cumlogsumexp cummax cummin cumprod cumsum optimization_barrier reduce_and"
    " reduce_max reduce_min reduce_or reduce_prod rev split squeeze stack unstack".split()
)


class Value(NamedTuple):
    """A value of the trace."""

    array: Any
    """An array, a tracer or a literal."""
    batched: bool
    """Whether it has a batch axis, which is then the last."""

    def broadcast(self, size: int) -> Array:
        """The array with a batch axis of this size."""
        if self.batched:
            return self.array
        shape = jnp.shape(self.array)
        return lax.broadcast_in_dim(self.array, (*shape, size), tuple(range(len(shape))))


Function: TypeAlias = Callable[..., list]  # of arrays, to a list of arrays


def _arrays(values: Sequence[Value]) -> list:
    return [value.array for value in values]


def _batched(values: Sequence[Value]) -> list[bool]:
    return [value.batched for value in values]


def _values(arrays: Sequence[ArrayLike], batched: Sequence[bool]) -> list[Value]:
    return [Value(*pair) for pair in zip(arrays, batched, strict=True)]


def aval_of(atom: Var | Literal) -> ShapedArray:
    """The shape and type of a value."""
    return cast(ShapedArray, atom.aval)


def function_of(equation: JaxprEqn) -> Function:
    """One equation as a function."""
    primitive = equation.primitive

    def compute(*xs: ArrayLike) -> list[Array]:
        results = primitive.bind(*xs, **primitive.get_bind_params(equation.params))
        return list(results) if primitive.multiple_results else [results]

    return compute


class BatchEvaluator:
    """Evaluates the equations of a trace for a batch of `size`."""

    def __init__(self, size: int) -> None:
        self.size = size
        # A jitted function called often is traced once. The trace is kept with it, so that its
        # identity stays taken.
        self.jitted: dict[tuple, tuple[Function, list[bool], Jaxpr]] = {}

    def evaluate(self, traced: ClosedJaxpr | Jaxpr, values: Sequence[Value]) -> list[Value]:
        """The results of a trace for these arguments."""
        # A `Jaxpr` has no constants up to JAX 0.10, and its own from 0.12 on.
        jaxpr, consts = getattr(traced, "jaxpr", traced), getattr(traced, "consts", ())
        values = [*(Value(const, False) for const in consts), *values]
        known = dict(zip((*jaxpr.constvars, *jaxpr.invars), values, strict=True))

        def read(atom: Var | Literal) -> Value:
            return Value(atom.val, False) if isinstance(atom, Literal) else known[atom]

        for equation in jaxpr.eqns:
            results = self._equation(equation, [read(atom) for atom in equation.invars])
            known |= zip(equation.outvars, results, strict=True)
        return [read(atom) for atom in jaxpr.outvars]

    def as_function(
        self, traced: ClosedJaxpr | Jaxpr, batched: Sequence[bool]
    ) -> tuple[Function, list[bool]]:
        """A trace as a function of arrays, and which of its results are batched.

        The list is filled in when the function is first traced.
        """
        results_batched: list[bool] = []

        def call(*xs: ArrayLike) -> list:
            results = self.evaluate(traced, _values(xs, batched))
            results_batched[:] = _batched(results)
            return _arrays(results)

        return call, results_batched

    def _equation(self, equation: JaxprEqn, values: list[Value]) -> list[Value]:
        name = equation.primitive.name
        if not any(_batched(values)):
            return [Value(x, False) for x in function_of(equation)(*_arrays(values))]
        reads, rule = RULES.get(name, ("", BatchEvaluator._vmap))
        known = set(reads.split()) <= equation.params.keys()
        return rule(self, equation, values) if known else self._vmap(equation, values)

    def _vmap(self, equation: JaxprEqn, values: list[Value]) -> list[Value]:
        """JAX's own rule: while loops, dot products, sorting, and what is not known here."""
        axes = tuple(-1 if value.batched else None for value in values)
        results = jax.vmap(function_of(equation), in_axes=axes, out_axes=-1)(*_arrays(values))
        return [Value(x, True) for x in results]

    def _broadcast(self, values: Sequence[Value]) -> list[Array]:
        return [value.broadcast(self.size) for value in values]

    def _widen(self, values: Sequence[Value], chosen: Sequence[bool]) -> list[Value]:
        """The values, of which the chosen have a batch axis for certain."""
        return [
            Value(value.broadcast(self.size), True) if batch else value
            for value, batch in zip(values, chosen, strict=True)
        ]

    def _elementwise(self, equation: JaxprEqn, values: list[Value]) -> list[Value]:
        shape = (*aval_of(equation.outvars[0]).shape, self.size)
        # A scalar operand may stand beside arrays.
        xs = [jnp.broadcast_to(x, shape) for x in self._broadcast(values)]
        return [Value(x, True) for x in function_of(equation)(*xs)]

    def _along_axes(self, equation: JaxprEqn, values: list[Value]) -> list[Value]:
        return [Value(x, True) for x in function_of(equation)(*self._broadcast(values))]

    def _broadcast_in_dim(self, equation: JaxprEqn, values: list[Value]) -> list[Value]:
        shape = aval_of(equation.outvars[0]).shape
        axes = (*equation.params["broadcast_dimensions"], len(shape))
        return [Value(lax.broadcast_in_dim(values[0].array, (*shape, self.size), axes), True)]

    def _concatenate(self, equation: JaxprEqn, values: list[Value]) -> list[Value]:
        axis = equation.params["dimension"]
        return [Value(lax.concatenate(self._broadcast(values), axis), True)]

    def _reshape(self, equation: JaxprEqn, values: list[Value]) -> list[Value]:
        shape = aval_of(equation.outvars[0]).shape
        return [Value(lax.reshape(values[0].array, (*shape, self.size)), True)]

    def _transpose(self, equation: JaxprEqn, values: list[Value]) -> list[Value]:
        axes = equation.params["permutation"]
        return [Value(lax.transpose(values[0].array, (*axes, len(axes))), True)]

    def _sum(self, equation: JaxprEqn, values: list[Value]) -> list[Value]:
        """The sum over some axes; short axes are added entry by entry.

        A CPU loop that computes its summands on the fly would take the batch one example at a time.
        """
        x = values[0].array
        for axis in sorted(equation.params["axes"], reverse=True):
            count = x.shape[axis]
            if 0 < count <= UNROLLED_SUM:
                parts = lax.split(x, (1,) * count, axis)
                x = lax.squeeze(functools.reduce(lax.add, parts), (axis,))
            else:
                x = lax.reduce_sum(x, (axis,))
        return [Value(x, True)]

    def _gather(self, equation: JaxprEqn, values: list[Value]) -> list[Value]:
        """Reads from an array that all examples share, at indices of their own."""
        operand, indices = values
        if operand.batched:
            return self._vmap(equation, values)
        params = {**equation.params, "indices_are_sorted": False, "unique_indices": False}
        # The last axis of the indices holds the coordinates of one place.
        result = lax.gather(operand.array, jnp.moveaxis(indices.array, -1, -2), **params)
        return [Value(result, True)]

    def _inline(self, equation: JaxprEqn, values: list[Value]) -> list[Value]:
        return self.evaluate(equation.params["call_jaxpr"], values)

    def _jit(self, equation: JaxprEqn, values: list[Value]) -> list[Value]:
        traced, batched = equation.params["jaxpr"], tuple(_batched(values))
        if (id(traced), batched) not in self.jitted:
            call, results_batched = self.as_function(traced, batched)
            call.__name__ = equation.params["name"]
            self.jitted[id(traced), batched] = jax.jit(call), results_batched, traced
        call, results_batched, _ = self.jitted[id(traced), batched]
        return _values(call(*_arrays(values)), results_batched)

    def _checkpoint(self, equation: JaxprEqn, values: list[Value]) -> list[Value]:
        params = equation.params
        call, results_batched = self.as_function(params["jaxpr"], _batched(values))
        remat = jax.checkpoint(call, prevent_cse=params["prevent_cse"], policy=params["policy"])
        return _values(remat(*_arrays(values)), results_batched)

    def _custom_jvp(self, equation: JaxprEqn, values: list[Value]) -> list[Value]:
        """Keeps the function's own derivative rule, evaluated for the batch as well."""
        avals = [aval_of(atom) for atom in equation.invars]
        if not all(jnp.issubdtype(aval.dtype, jnp.inexact) for aval in avals):
            return self._vmap(equation, values)
        examples = [jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in avals]
        primal = equation.params["call_jaxpr"]

        def evaluate(traced: ClosedJaxpr, xs: Sequence[Array]) -> list[Array]:
            return self._broadcast(self.evaluate(traced, [Value(x, True) for x in xs]))

        @jax.custom_jvp
        def function(*xs: Array) -> list[Array]:
            return evaluate(primal, xs)

        @function.defjvp
        def _(primals: tuple, tangents: tuple) -> tuple[list[Array], list[Array]]:
            jvp = functools.partial(jax.jvp, function_of(equation))
            results = evaluate(jax.make_jaxpr(jvp)(examples, examples), (*primals, *tangents))
            return results[: len(results) // 2], results[len(results) // 2 :]

        return [Value(x, True) for x in function(*self._broadcast(values))]

    def _custom_vmap(self, equation: JaxprEqn, values: list[Value]) -> list[Value]:
        """The function's own batching rule, or its `elementwise` form.

        A rule may have an attribute `elementwise`: a function of an unbatched first argument and
        of numbers of any shape, treated one by one, which needs no axis moved.
        """
        elementwise = getattr(equation.params["rule"], "elementwise", None)
        _, (first, *numbers) = jax.tree.unflatten(equation.params["in_tree"], values)
        shared, structure = jax.tree.flatten(first, is_leaf=lambda x: isinstance(x, Value))
        if elementwise is None or any(_batched(shared)):
            return self._vmap(equation, values)
        results = elementwise(
            jax.tree.unflatten(structure, _arrays(shared)),
            *(x if batched else lax.expand_dims(x, (jnp.ndim(x),)) for x, batched in numbers),
        )
        return [Value(x, True) for x in jax.tree.leaves(results)]

    def _scan(self, equation: JaxprEqn, values: list[Value]) -> list[Value]:
        traced = equation.params["jaxpr"]
        # What is carried has the same rank inside the body; inputs and outputs have one axis less.
        inputs_count = _count_sliced(equation.invars, traced.in_avals)
        carried = len(equation.outvars) - _count_sliced(equation.outvars, traced.out_avals)
        consts = len(values) - inputs_count - carried
        # A shared boolean would become a branch taken per number; a batched one becomes a mask.
        is_bool = [jax.typeof(value.array).dtype == bool for value in values]
        values = self._widen(values, is_bool)
        shared, inputs = values[:consts], values[consts + carried :]
        carry = values[consts : consts + carried]
        results_batched: list[bool] = []

        def body(before: list, xs: list) -> tuple[list, list]:
            old = _values(before, _batched(carry))
            results = self.evaluate(traced, [*shared, *old, *_values(xs, _batched(inputs))])
            results_batched[:] = _batched(results)
            after = self._widen(results[:carried], _batched(carry))
            return _arrays(after), _arrays(results[carried:])

        while True:  # a carry that the body makes batched has to start batched
            slices = [jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in _arrays(inputs)]
            jax.eval_shape(body, _arrays(carry), slices)
            grown = [
                new and not value.batched
                for new, value in zip(results_batched[:carried], carry, strict=True)
            ]
            if not any(grown):
                break
            carry = self._widen(carry, grown)
        options = {name: equation.params[name] for name in ("length", "reverse", "unroll")}
        last, outputs = lax.scan(body, _arrays(carry), _arrays(inputs), **options)
        return [*_values(last, _batched(carry)), *_values(outputs, results_batched[carried:])]


def _count_sliced(outer: Sequence[Var | Literal], inner: Sequence[ShapedArray]) -> int:
    """How many values of a scan its body sees one slice of."""
    pairs = zip(outer, inner, strict=True)
    return sum(len(aval_of(whole).shape) > len(part.shape) for whole, part in pairs)


Rule: TypeAlias = Callable[[BatchEvaluator, JaxprEqn, list[Value]], list[Value]]
# By the name of the primitive: the parameters that the rule reads, and the rule.
RULES: dict[str, tuple[str, Rule]] = {
    **dict.fromkeys(ELEMENTWISE, ("", BatchEvaluator._elementwise)),
    **dict.fromkeys(ALONG_AXES, ("", BatchEvaluator._along_axes)),
    "broadcast_in_dim": ("broadcast_dimensions", BatchEvaluator._broadcast_in_dim),
    "closed_call": ("call_jaxpr", BatchEvaluator._inline),  # what reverse mode recomputes
    "concatenate": ("dimension", BatchEvaluator._concatenate),
    "custom_jvp_call": ("call_jaxpr", BatchEvaluator._custom_jvp),
    "custom_vmap_call": ("rule in_tree", BatchEvaluator._custom_vmap),
    "eval_jaxpr": ("call_jaxpr", BatchEvaluator._inline),  # the same from JAX 0.12 on
    "gather": ("indices_are_sorted unique_indices", BatchEvaluator._gather),
    "jit": ("jaxpr name", BatchEvaluator._jit),
    "reduce_sum": ("axes", BatchEvaluator._sum),
    "remat2": ("jaxpr prevent_cse policy", BatchEvaluator._checkpoint),
    "reshape": ("", BatchEvaluator._reshape),
    "scan": ("jaxpr length reverse unroll", BatchEvaluator._scan),
    "transpose": ("permutation", BatchEvaluator._transpose),
}
