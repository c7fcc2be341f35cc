"""The equations of a function traced for one, computed for many (`many.lanes`).

What is of many has them on its last axis. What all share stays as it is, and a primitive that has
no rule here goes through that of `jax.vmap`.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal
from jaxtyping import Array

# A value, and whether it is of many: then they are on its last axis.
Value: TypeAlias = tuple[Any, bool]

FEW = 8  # numbers that are added one by one

# Primitives that treat numbers one by one.
ONE_BY_ONE = frozenset(
    "abs acos acosh add add_any and asin asinh atan atan2 atanh bitcast_convert_type cbrt ceil"
    " clamp convert_element_type copy copy_p cos cosh div eq erf erf_inv erfc exp exp2 expm1 floor"
    " ge gt integer_pow is_finite le log log1p logistic lt max min mul ne neg nextafter not or pow"
    " reduce_precision rem round rsqrt select_n shift_left shift_right_arithmetic"
    " shift_right_logical sign sin sinh sqrt square stop_gradient sub tan tanh xor".split()
)
# Those along axes that are told, counted from the first: one more at the end does not matter.
ALONG = frozenset(
    "argmax argmin cumlogsumexp cummax cummin cumprod cumsum optimization_barrier reduce_and"
    " reduce_max reduce_min reduce_or reduce_prod rev split stack unstack".split()
)


def spread(x: Any, many: bool, size: int) -> Array:
    """A value of many, all the same if it was of one."""
    if many:
        return x
    shape = jnp.shape(x)
    return lax.broadcast_in_dim(x, (*shape, size), tuple(range(len(shape))))


def _is_bool(x: Any) -> bool:
    return jax.typeof(x).dtype == bool


def _is_value(x: Any) -> bool:
    return isinstance(x, tuple) and len(x) == 2 and isinstance(x[1], bool)


def _values(tree: Any) -> list[Value]:
    """The values in a tree of them."""
    return jax.tree.leaves(tree, is_leaf=_is_value)


def _alone(equation: JaxprEqn) -> Callable[..., list[Any]]:
    """What one equation computes."""
    primitive = equation.primitive

    def compute(*xs: Any) -> list[Any]:
        made = primitive.bind(*xs, **primitive.get_bind_params(equation.params))
        return list(made) if primitive.multiple_results else [made]

    return compute


class Many:
    """Computes equations for so many."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.jitted: dict[Any, tuple] = {}  # a function that is called often is traced once

    def evaluate(self, jaxpr: Jaxpr, consts: Sequence[Any], values: Sequence[Value]) -> list[Value]:
        """The results of a trace, for these arguments."""
        shared = [(const, False) for const in consts]
        known: dict[Any, Value] = dict(zip(jaxpr.constvars, shared, strict=True))
        known |= zip(jaxpr.invars, values, strict=True)

        def read(atom: Any) -> Value:
            return (atom.val, False) if isinstance(atom, Literal) else known[atom]

        for equation in jaxpr.eqns:
            made = self._equation(equation, [read(atom) for atom in equation.invars])
            known |= zip(equation.outvars, made, strict=True)
        return [read(atom) for atom in jaxpr.outvars]

    def _equation(self, equation: JaxprEqn, given: list[Value]) -> list[Value]:
        name = equation.primitive.name
        if not any(many for _, many in given):
            return [(x, False) for x in _alone(equation)(*(x for x, _ in given))]
        if name in RULES:
            return RULES[name](self, equation, given)
        xs = self._spread(given)
        if name in SHAPED:
            return [(SHAPED[name](xs, equation.params, self.size), True)]
        if name in ONE_BY_ONE | ALONG:
            if name in ONE_BY_ONE:  # one number may stand beside arrays, for each of theirs
                made: Any = equation.outvars[0].aval
                xs = [jnp.broadcast_to(x, (*made.shape, self.size)) for x in xs]
            return [(x, True) for x in _alone(equation)(*xs)]
        return self._vmapped(equation, given)

    def _spread(self, given: Sequence[Value]) -> list[Array]:
        return [spread(x, many, self.size) for x, many in given]

    def _vmapped(self, equation: JaxprEqn, given: list[Value]) -> list[Value]:
        """By JAX's own rule, for what has none here: loops of unknown length, products, sorting."""
        axes = tuple(-1 if many else None for _, many in given)
        made = jax.vmap(_alone(equation), in_axes=axes, out_axes=-1)(*(x for x, _ in given))
        return [(x, True) for x in made]

    def called(
        self, jaxpr: Jaxpr, consts: Sequence[Any], many: Sequence[bool]
    ) -> tuple[Callable[..., list[Any]], list[bool]]:
        """A trace as a function, and, once that is traced, which of its results are of many."""
        told: list[bool] = []

        def call(*xs: Any) -> list[Any]:
            made = self.evaluate(jaxpr, consts, list(zip(xs, many, strict=True)))
            told[:] = [many for _, many in made]
            return [x for x, _ in made]

        return call, told

    def _jit(self, equation: JaxprEqn, given: list[Value]) -> list[Value]:
        closed, many = equation.params["jaxpr"], tuple(many for _, many in given)
        if (id(closed), many) not in self.jitted:
            call, told = self.called(closed.jaxpr, closed.consts, many)
            call.__name__ = equation.params["name"]
            self.jitted[id(closed), many] = jax.jit(call), told, closed  # which keeps its id
        call, told, _ = self.jitted[id(closed), many]
        return list(zip(call(*(x for x, _ in given)), told, strict=True))

    def _inlined(self, equation: JaxprEqn, given: list[Value]) -> list[Value]:
        closed = equation.params["call_jaxpr"]
        return self.evaluate(closed.jaxpr, closed.consts, given)

    def _checkpoint(self, equation: JaxprEqn, given: list[Value]) -> list[Value]:
        params = equation.params
        call, told = self.called(params["jaxpr"], (), [many for _, many in given])
        again = jax.checkpoint(call, prevent_cse=params["prevent_cse"], policy=params["policy"])
        return list(zip(again(*(x for x, _ in given)), told, strict=True))

    def _custom_jvp(self, equation: JaxprEqn, given: list[Value]) -> list[Value]:
        """With the slopes that the function tells of itself."""
        avals: list[Any] = [atom.aval for atom in equation.invars]
        ones = [jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in avals]
        if not all(jnp.issubdtype(one.dtype, jnp.inexact) for one in ones):
            return self._vmapped(equation, given)
        closed = equation.params["call_jaxpr"]

        def of_many(closed: ClosedJaxpr, xs: Sequence[Array]) -> list[Array]:
            return self._spread(self.evaluate(closed.jaxpr, closed.consts, [(x, True) for x in xs]))

        @jax.custom_jvp
        def told(*xs: Array) -> list[Array]:
            return of_many(closed, xs)

        @told.defjvp
        def _(primals: tuple, tangents: tuple) -> tuple[list[Array], list[Array]]:
            pushed = jax.make_jaxpr(lambda x, dx: jax.jvp(_alone(equation), x, dx))(ones, ones)
            made = of_many(pushed, (*primals, *tangents))
            return made[: len(made) // 2], made[len(made) // 2 :]

        return [(x, True) for x in told(*self._spread(given))]

    def _custom_vmap(self, equation: JaxprEqn, given: list[Value]) -> list[Value]:
        """By its rule; or as it is, if that has it as `one_by_one`: numbers, but for the first."""
        params = equation.params
        function = getattr(params["rule"], "one_by_one", None)
        _, (first, *numbers) = jax.tree.unflatten(params["in_tree"], given)
        if function is None or any(many for _, many in _values(first)):
            return self._vmapped(equation, given)
        made = function(
            jax.tree.map(lambda one: one[0], first, is_leaf=_is_value),
            *(x if many else lax.expand_dims(x, (jnp.ndim(x),)) for x, many in numbers),
        )
        return [(x, True) for x in jax.tree.leaves(made)]

    def _gather(self, equation: JaxprEqn, given: list[Value]) -> list[Value]:
        """What is read from an array that all share: their places in it are many."""
        (operand, every), (places, _) = given
        params = equation.params
        if every:
            return self._vmapped(equation, given)
        made = lax.gather(
            operand,
            jnp.moveaxis(places, -1, -2),  # before the axis of a place's own numbers
            **{**params, "indices_are_sorted": False, "unique_indices": False},
        )
        return [(made, True)]

    def _scan(self, equation: JaxprEqn, given: list[Value]) -> list[Value]:
        params = equation.params
        closed, consts, carried = params["jaxpr"], params["num_consts"], params["num_carry"]
        # A condition that all share is a branch, one number at a time; an array of them is a mask.
        given = [(self._spread([one])[0], True) if _is_bool(one[0]) else one for one in given]
        first, after = given[:consts], given[consts + carried :]
        carry = given[consts : consts + carried]
        xs = [x for x, _ in after]
        told: list[bool] = []

        def turn(before: list[Any], now: list[Any]) -> tuple[list[Any], list[Any]]:
            old = list(zip(before, (many for _, many in carry), strict=True))
            new = list(zip(now, (many for _, many in after), strict=True))
            made = self.evaluate(closed.jaxpr, closed.consts, [*first, *old, *new])
            told[:] = [many for _, many in made]
            kept = [
                spread(x, many, self.size) if wide else x
                for (x, many), (_, wide) in zip(made[:carried], old, strict=True)
            ]
            return kept, [x for x, _ in made[carried:]]

        while True:  # what a turn makes differ is of many from the start
            each = [jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in xs]
            jax.eval_shape(turn, [x for x, _ in carry], each)
            before = [many for _, many in carry]
            grown = [new and not old for new, old in zip(told[:carried], before, strict=True)]
            if not any(grown):
                break
            carry = [
                (spread(x, many, self.size), True) if grows else (x, many)
                for (x, many), grows in zip(carry, grown, strict=True)
            ]
        how = {name: params[name] for name in ("length", "reverse", "unroll")}
        last, made = lax.scan(turn, [x for x, _ in carry], xs, **how)
        wide = [many for _, many in carry]
        return [*zip(last, wide, strict=True), *zip(made, told[carried:], strict=True)]


def _sum(x: Array, axes: Sequence[int]) -> Array:
    """The sum over some axes; few numbers are added one by one.

    A CPU's loop that computes what it sums takes the many one at a time.
    """
    for axis in sorted(axes, reverse=True):
        count = x.shape[axis]
        if 0 < count <= FEW:
            parts = lax.split(x, (1,) * count, axis)
            x = lax.squeeze(functools.reduce(lax.add, parts), (axis,))
        else:
            x = lax.reduce_sum(x, (axis,))
    return x


RULES = {
    "jit": Many._jit,
    "closed_call": Many._inlined,  # a turn of a scan that reverse mode computes again
    "remat2": Many._checkpoint,
    "custom_jvp_call": Many._custom_jvp,
    "custom_vmap_call": Many._custom_vmap,
    "gather": Many._gather,
    "scan": Many._scan,
}
# Those that are told a shape, which the last axis is added to.
SHAPED: dict[str, Callable[[list[Array], dict[str, Any], int], Array]] = {
    "broadcast_in_dim": lambda xs, told, size: lax.broadcast_in_dim(
        xs[0], (*told["shape"], size), (*told["broadcast_dimensions"], len(told["shape"]))
    ),
    "concatenate": lambda xs, told, size: lax.concatenate(xs, told["dimension"]),
    "reduce_sum": lambda xs, told, size: _sum(xs[0], told["axes"]),
    "reshape": lambda xs, told, size: lax.reshape(xs[0], (*told["new_sizes"], size)),
    "slice": lambda xs, told, size: lax.slice(
        xs[0],
        (*told["start_indices"], 0),
        (*told["limit_indices"], size),
        told["strides"] and (*told["strides"], 1),
    ),
    "squeeze": lambda xs, told, size: lax.squeeze(xs[0], told["dimensions"]),
    "transpose": lambda xs, told, size: lax.transpose(
        xs[0], (*told["permutation"], len(told["permutation"]))
    ),
}
