"""Evaluates a function traced for one example on a whole batch (the engine of `lanes`).

Batched values have the batch axis last. Values that all examples share keep their shape. A
primitive without a rule here goes through JAX's own batching rule.
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
from jaxtyping import Array, PyTree

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
    " reduce_max reduce_min reduce_or reduce_prod rev split stack unstack".split()
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


def _is_bool(x: ArrayLike) -> bool:
    return jax.typeof(x).dtype == bool


def _example(atom: Var | Literal) -> jax.ShapeDtypeStruct:
    """Shape and dtype that a value has for one example."""
    aval = cast(ShapedArray, atom.aval)
    return jax.ShapeDtypeStruct(aval.shape, aval.dtype)


def _is_value(x: object) -> bool:
    return isinstance(x, Value)


def _arrays(values: Sequence[Value]) -> list:
    return [value.array for value in values]


def _batched(values: Sequence[Value]) -> list[bool]:
    return [value.batched for value in values]


def _values(arrays: Sequence[ArrayLike], batched: Sequence[bool]) -> list[Value]:
    return [Value(*pair) for pair in zip(arrays, batched, strict=True)]


def _unbatched(equation: JaxprEqn) -> Function:
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
        # By identity of the jaxpr and what is batched: a jitted function called often is traced
        # once. The jaxpr is kept so that its identity stays taken.
        self.jitted: dict[tuple, tuple[Function, list[bool], ClosedJaxpr]] = {}

    def evaluate(
        self, jaxpr: Jaxpr, consts: Sequence[ArrayLike], values: Sequence[Value]
    ) -> list[Value]:
        """The results of a jaxpr for these arguments."""
        known: dict[Var, Value] = {}
        known |= zip(jaxpr.constvars, [Value(const, False) for const in consts], strict=True)
        known |= zip(jaxpr.invars, values, strict=True)

        def read(atom: Var | Literal) -> Value:
            return Value(atom.val, False) if isinstance(atom, Literal) else known[atom]

        for equation in jaxpr.eqns:
            results = self._equation(equation, [read(atom) for atom in equation.invars])
            known |= zip(equation.outvars, results, strict=True)
        return [read(atom) for atom in jaxpr.outvars]

    def as_function(
        self, jaxpr: Jaxpr, consts: Sequence[ArrayLike], batched: Sequence[bool]
    ) -> tuple[Function, list[bool]]:
        """A jaxpr as a function of arrays, and which of its results are batched.

        The list is filled in when the function is first traced.
        """
        results_batched: list[bool] = []

        def call(*xs: ArrayLike) -> list:
            results = self.evaluate(jaxpr, consts, _values(xs, batched))
            results_batched[:] = _batched(results)
            return _arrays(results)

        return call, results_batched

    def _equation(self, equation: JaxprEqn, values: list[Value]) -> list[Value]:
        name = equation.primitive.name
        if not any(_batched(values)):
            return [Value(x, False) for x in _unbatched(equation)(*_arrays(values))]
        if name in RULES:
            return RULES[name](self, equation, values)
        xs = self._broadcast(values)
        if name in SHAPED:
            return [Value(SHAPED[name](xs, equation.params, self.size), True)]
        if name in ELEMENTWISE | ALONG_AXES:
            if name in ELEMENTWISE:  # a scalar operand may stand beside arrays
                shape = (*_example(equation.outvars[0]).shape, self.size)
                xs = [jnp.broadcast_to(x, shape) for x in xs]
            return [Value(x, True) for x in _unbatched(equation)(*xs)]
        return self._vmap(equation, values)

    def _broadcast(self, values: Sequence[Value]) -> list[Array]:
        return [value.broadcast(self.size) for value in values]

    def _vmap(self, equation: JaxprEqn, values: list[Value]) -> list[Value]:
        """JAX's rule for primitives without one here: while loops, dot products, sorting."""
        axes = tuple(-1 if value.batched else None for value in values)
        results = jax.vmap(_unbatched(equation), in_axes=axes, out_axes=-1)(*_arrays(values))
        return [Value(x, True) for x in results]

    def _jit(self, equation: JaxprEqn, values: list[Value]) -> list[Value]:
        closed, batched = equation.params["jaxpr"], tuple(_batched(values))
        if (id(closed), batched) not in self.jitted:
            call, results_batched = self.as_function(closed.jaxpr, closed.consts, batched)
            call.__name__ = equation.params["name"]
            self.jitted[id(closed), batched] = jax.jit(call), results_batched, closed
        call, results_batched, _ = self.jitted[id(closed), batched]
        return _values(call(*_arrays(values)), results_batched)

    def _inline(self, equation: JaxprEqn, values: list[Value]) -> list[Value]:
        closed = equation.params["call_jaxpr"]
        return self.evaluate(closed.jaxpr, closed.consts, values)

    def _checkpoint(self, equation: JaxprEqn, values: list[Value]) -> list[Value]:
        params = equation.params
        call, results_batched = self.as_function(params["jaxpr"], (), _batched(values))
        remat = jax.checkpoint(call, prevent_cse=params["prevent_cse"], policy=params["policy"])
        return _values(remat(*_arrays(values)), results_batched)

    def _custom_jvp(self, equation: JaxprEqn, values: list[Value]) -> list[Value]:
        """Keeps the function's own derivative rule, evaluated for the batch as well."""
        examples = [_example(atom) for atom in equation.invars]
        if not all(jnp.issubdtype(example.dtype, jnp.inexact) for example in examples):
            return self._vmap(equation, values)
        primal = equation.params["call_jaxpr"]

        def evaluate(closed: ClosedJaxpr, xs: Sequence[Array]) -> list[Array]:
            batch = [Value(x, True) for x in xs]
            return self._broadcast(self.evaluate(closed.jaxpr, closed.consts, batch))

        @jax.custom_jvp
        def function(*xs: Array) -> list[Array]:
            return evaluate(primal, xs)

        @function.defjvp
        def _(primals: tuple, tangents: tuple) -> tuple[list[Array], list[Array]]:
            jvp = functools.partial(jax.jvp, _unbatched(equation))
            results = evaluate(jax.make_jaxpr(jvp)(examples, examples), (*primals, *tangents))
            return results[: len(results) // 2], results[len(results) // 2 :]

        return [Value(x, True) for x in function(*self._broadcast(values))]

    def _custom_vmap(self, equation: JaxprEqn, values: list[Value]) -> list[Value]:
        """The function's own batching rule, or its `elementwise` form.

        A rule may have an attribute `elementwise`: a function of an unbatched first argument and
        of numbers of any shape, treated one by one, which needs no axis moved.
        """
        params = equation.params
        elementwise = getattr(params["rule"], "elementwise", None)
        _, (first, *numbers) = jax.tree.unflatten(params["in_tree"], values)
        first_values = jax.tree.leaves(first, is_leaf=_is_value)
        if elementwise is None or any(_batched(first_values)):
            return self._vmap(equation, values)
        results = elementwise(
            jax.tree.map(lambda value: value.array, first, is_leaf=_is_value),
            *(x if batched else lax.expand_dims(x, (jnp.ndim(x),)) for x, batched in numbers),
        )
        return [Value(x, True) for x in jax.tree.leaves(results)]

    def _gather(self, equation: JaxprEqn, values: list[Value]) -> list[Value]:
        """Reads from an array that all examples share, at indices of their own."""
        operand, indices = values
        if operand.batched:
            return self._vmap(equation, values)
        params = {**equation.params, "indices_are_sorted": False, "unique_indices": False}
        # The last axis of the indices holds the coordinates of one place.
        result = lax.gather(operand.array, jnp.moveaxis(indices.array, -1, -2), **params)
        return [Value(result, True)]

    def _scan(self, equation: JaxprEqn, values: list[Value]) -> list[Value]:
        params = equation.params
        closed, consts, carried = params["jaxpr"], params["num_consts"], params["num_carry"]
        # A shared boolean would become a branch taken per number; a batched one becomes a mask.
        values = [
            Value(value.broadcast(self.size), True) if _is_bool(value.array) else value
            for value in values
        ]
        shared, inputs = values[:consts], values[consts + carried :]
        carry = values[consts : consts + carried]
        results_batched: list[bool] = []

        def body(before: list, xs: list) -> tuple[list, list]:
            old = _values(before, _batched(carry))
            new = _values(xs, _batched(inputs))
            results = self.evaluate(closed.jaxpr, closed.consts, [*shared, *old, *new])
            results_batched[:] = _batched(results)
            after = [
                value.broadcast(self.size) if wide else value.array
                for value, wide in zip(results[:carried], _batched(carry), strict=True)
            ]
            return after, _arrays(results[carried:])

        while True:  # a carry that the body makes batched has to start batched
            slices = [jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in _arrays(inputs)]
            jax.eval_shape(body, _arrays(carry), slices)
            grown = [
                new and not value.batched
                for new, value in zip(results_batched[:carried], carry, strict=True)
            ]
            if not any(grown):
                break
            carry = [
                Value(value.broadcast(self.size), True) if grows else value
                for value, grows in zip(carry, grown, strict=True)
            ]
        options = {name: params[name] for name in ("length", "reverse", "unroll")}
        last, outputs = lax.scan(body, _arrays(carry), _arrays(inputs), **options)
        return [*_values(last, _batched(carry)), *_values(outputs, results_batched[carried:])]


def _sum(x: Array, axes: Sequence[int]) -> Array:
    """The sum over some axes; short axes are added entry by entry.

    A CPU loop that computes its summands on the fly would take the batch one example at a time.
    """
    for axis in sorted(axes, reverse=True):
        count = x.shape[axis]
        if 0 < count <= UNROLLED_SUM:
            parts = lax.split(x, (1,) * count, axis)
            x = lax.squeeze(functools.reduce(lax.add, parts), (axis,))
        else:
            x = lax.reduce_sum(x, (axis,))
    return x


RULES: dict[str, Callable[[BatchEvaluator, JaxprEqn, list[Value]], list[Value]]] = {
    "jit": BatchEvaluator._jit,
    "closed_call": BatchEvaluator._inline,  # a step of a scan that reverse mode recomputes
    "remat2": BatchEvaluator._checkpoint,
    "custom_jvp_call": BatchEvaluator._custom_jvp,
    "custom_vmap_call": BatchEvaluator._custom_vmap,
    "gather": BatchEvaluator._gather,
    "scan": BatchEvaluator._scan,
}
# Primitives whose parameters state shapes, to which the batch axis is added.
SHAPED: dict[str, Callable[[list[Array], dict[str, PyTree], int], Array]] = {
    "broadcast_in_dim": lambda xs, params, size: lax.broadcast_in_dim(
        xs[0], (*params["shape"], size), (*params["broadcast_dimensions"], len(params["shape"]))
    ),
    "concatenate": lambda xs, params, size: lax.concatenate(xs, params["dimension"]),
    "reduce_sum": lambda xs, params, size: _sum(xs[0], params["axes"]),
    "reshape": lambda xs, params, size: lax.reshape(xs[0], (*params["new_sizes"], size)),
    "slice": lambda xs, params, size: lax.slice(
        xs[0],
        (*params["start_indices"], 0),
        (*params["limit_indices"], size),
        params["strides"] and (*params["strides"], 1),
    ),
    "squeeze": lambda xs, params, size: lax.squeeze(xs[0], params["dimensions"]),
    "transpose": lambda xs, params, size: lax.transpose(
        xs[0], (*params["permutation"], len(params["permutation"]))
    ),
}
