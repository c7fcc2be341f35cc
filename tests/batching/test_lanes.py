"""`lanes` gives the results of `jax.vmap`, with the batch axis last in all it computes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.extend.core import jaxprs_in_params

from jaxik import lanes
from jaxik.maths import quat, vec

BATCH = 5


def numbers(*shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape))


def assert_same(actual, expected, tolerance=1e-12):
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    paths = jax.tree_util.tree_leaves_with_path(expected)
    for (path, y), x in zip(paths, jax.tree.leaves(actual), strict=True):
        name = jax.tree_util.keystr(path)
        assert x.dtype == y.dtype, name
        np.testing.assert_allclose(x, y, rtol=tolerance, atol=tolerance, err_msg=name)


@jax.custom_jvp
def with_own_derivative(x, y):
    return jnp.abs(x) * y


@with_own_derivative.defjvp
def _(primals, tangents):
    (x, y), (dx, dy) = primals, tangents
    return with_own_derivative(x, y), 7.0 * dx + x * dy  # not what JAX would derive


@jax.custom_batching.custom_vmap
def with_own_batching_rule(x, y):
    return x * y


@with_own_batching_rule.def_vmap
def _(size, batched, x, y):
    x, y = (
        z if mapped else jnp.broadcast_to(z, (size, *z.shape))
        for z, mapped in zip((x, y), batched, strict=True)
    )
    return jax.vmap(jnp.multiply)(x, y), True


def scan_with_growing_carry(x):
    """A scan with a carry that becomes batched on the way, and one that never does."""

    def body(carry, now):
        pos, count = carry
        return (pos + x * now, count + 1), pos[0] * count

    return lax.scan(body, (jnp.zeros(3), 0), jnp.arange(4.0))


def scan_with_conditions(x):
    """A scan with booleans that all examples share: one in the carry, one in the inputs."""

    def body(carry, now):
        started, pos = carry
        return (jnp.ones_like(started), jnp.where(started & now, 0.5 * pos, pos + x)), started

    return lax.scan(body, (jnp.zeros((), bool), x), jnp.arange(4) % 2 == 0)


CASES = {
    "vectors": lambda x: (vec.cross(x, x[::-1]), vec.normalize(x, jnp.ones(3)), vec.sum_last(x)),
    "rotations": lambda x: quat.rotate(vec_to_quat(x), x),
    "scalar operands": lambda x: jnp.where(x[0] > 0, x, 2.0) + jnp.maximum(x, 0.1),
    "a scalar bound": lambda x: lax.clamp(x[0], x, x[0] + 1.0),
    "shapes": lambda x: jnp.tile(x.reshape(3, 1), (2, 2)).T[1:, ::2].ravel(),
    "padding": lambda x: jnp.pad(x, (1, 2)),
    "sums and extremes": lambda x: (x.sum(), x.max(), x.argmin(), jnp.cumsum(x), jnp.any(x > 0)),
    "short and long sums": lambda x: (
        (cube := jnp.sin(jnp.arange(90.0).reshape(2, 15, 3) * x)).sum((0, 2)),
        cube.sum((1,)),
        cube.sum((0, 1)),
        cube[:0].sum(0),
        cube.astype(int).sum(0),
    ),
    "sorting": lambda x: jnp.sort(x),
    "a matrix product": lambda x: jnp.arange(12.0).reshape(4, 3) @ x,
    "a lookup": lambda x: jnp.arange(10.0)[jnp.argmax(x)] + x[jnp.argmax(x)],
    "a lookup of rows": lambda x: jnp.arange(20.0).reshape(10, 2)[(9 * x).astype(int) % 10],
    "a lookup out of bounds": lambda x: (
        jnp.arange(4.0).at[(3 * x).astype(int)].get(mode="fill", fill_value=-1.0) * x
    ),
    "a custom batching rule": lambda x: with_own_batching_rule(x, x[0]),
    "a while loop": lambda x: lax.while_loop(
        lambda s: s[0] < jnp.abs(x[0]) * 5, lambda s: (s[0] + 1.0, s[1] * x), (0.0, x)
    ),
    "a conditional": lambda x: lax.cond(x[0] > 0, jnp.sin, jnp.cos, x),
    "a scan": scan_with_growing_carry,
    "a reversed scan": lambda x: lax.scan(
        lambda c, i: (c * x + i, c), x, jnp.arange(3.0), reverse=True
    ),
    "a scan with a condition": scan_with_conditions,
    "the gradient of a checkpointed scan": jax.grad(
        lambda x: jax.checkpoint(lambda x: scan_with_growing_carry(jnp.sin(x))[0][0])(x).sum()
    ),
    "nested scans": lambda x: lax.scan(
        lambda c, _: (scan_with_growing_carry(c)[0][0], None), x, None, length=2
    )[0],
    "a checkpointed function": lambda x: jax.checkpoint(jnp.tanh)(x) * 2.0,
    "a custom derivative": lambda x: with_own_derivative(x, x[::-1]),
    "a gradient": lambda x: jax.grad(
        lambda x: with_own_derivative(vec.normalize(x, x), x[::-1]).sum()
    )(x),
    "a jitted function": lambda x: jax.jit(vec.dot)(x, 2 * x) + vec.dot(jnp.ones(3), jnp.ones(3)),
    "shared results": lambda x: (jnp.arange(3), scan_with_growing_carry(jnp.ones(3)), x),
    "nested lanes": lambda x: lanes(lambda y: vec.cross(x, y))(jnp.eye(3)),
    "a nested vmap": lambda x: jax.vmap(lambda y: vec.cross(x, y))(jnp.eye(3)),
    "integers": lambda x: jnp.right_shift((100 * x).astype(int), 1) % 7,
}


def vec_to_quat(x):
    return vec.stacked_barrier(*vec.components(x), jnp.ones(()))[3] * jnp.asarray([*[0.5] * 4])


def batch_last(function, block=None):
    """The function for a batch, mapped while the batch axis is last."""

    def batched(x):
        last = lanes(function, in_axes=-1, out_axes=-1, block=block)(x.T)
        return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), last)

    return batched


@jax.jit
def mapped(x):
    """The results of all cases, by each way of mapping: one program."""
    ways = (jax.vmap, lanes, batch_last)
    return [{name: way(case)(x) for name, case in CASES.items()} for way in ways]


@jax.jit
def derivatives(x, tangent):
    """Gradients and directional derivatives of all cases that have both, likewise."""

    def both(way, name):
        def total(x):
            leaves = jax.tree.leaves(way(CASES[name])(x))
            floats = [y for y in leaves if jnp.issubdtype(y.dtype, jnp.floating)]
            return sum(jnp.sum(jnp.sin(y)) for y in floats)

        return jax.grad(total)(x), jax.jvp(total, (x,), (tangent,))

    names = sorted(set(CASES) - {"a while loop", "integers"})
    return [{name: both(way, name) for name in names} for way in (jax.vmap, lanes)]


def test_the_results_are_those_of_vmap():
    expected, *results = mapped(numbers(BATCH, 3))
    for result in results:
        assert_same(result, expected)


@pytest.mark.slow
def test_the_derivatives_are_those_of_vmap():
    expected, result = derivatives(numbers(BATCH, 3), numbers(BATCH, 3, seed=1))
    assert_same(result, expected, 1e-10)


def test_a_member_that_is_not_a_number_does_not_touch_its_neighbours():
    x, others = numbers(BATCH, 3), np.array([0, 1, 3, 4])
    clean, spoilt = (mapped(each)[1] for each in (x, x.at[2].set(jnp.nan)))
    spoilt, clean = (jax.tree.map(lambda y: y[others], each) for each in (spoilt, clean))
    assert_same(spoilt, clean, 0.0)


def test_an_elementwise_function_gets_the_batch_without_moved_axes():
    shapes = []

    @jax.custom_batching.custom_vmap
    def weighted(table, x, y):
        shapes.append((table.shape, jnp.shape(x), jnp.shape(y)))
        return table[0] * x + y

    @weighted.def_vmap
    def rule(size, batched, *args):
        axes = [0 if mapped else None for mapped in batched]
        return jax.vmap(weighted.fun, in_axes=axes)(*args), True

    rule.elementwise = weighted
    x, table = numbers(BATCH, 3), numbers(2)
    for function in (lambda x: weighted(table, x, x[0]), lambda x: weighted(table, x, 2.0)):
        shapes.clear()
        actual = lanes(function)(x)
        table_shape, x_shape, y_shape = shapes[-1]
        assert_same(actual, jax.vmap(function)(x))
        assert table_shape == (2,) and x_shape == (3, BATCH) and y_shape in {(BATCH,), (1,)}
    # A batched first argument goes through the batching rule.
    assert_same(*(transform(lambda x: weighted(x, x, x[0]))(x) for transform in (lanes, jax.vmap)))


def test_blocks_give_the_same_results_and_keep_shared_ones():
    x, case = numbers(BATCH, 3), CASES["a scan"]
    for block in (1, 2, 3, 5, 9):
        for way in (lanes, batch_last):
            assert_same(jax.jit(way(case, block=block))(x), jax.vmap(case)(x))
    function = lanes(lambda x: (x[0], jnp.arange(3)), out_axes=(0, None), block=2)
    first, shared = function(x)
    assert first.shape == (BATCH,) and shared.tolist() == [0, 1, 2]


def test_reverse_mode_stores_one_block_at_a_time():
    def waves(x):
        for _ in range(40):  # reverse mode stores each of them
            x = jnp.sin(jnp.cumsum(x))
        return x

    def loss(x, block):
        return jnp.sum(lanes(waves, block=block)(x) ** 2)

    x = numbers(5000, 3)
    gradient = jax.jit(jax.grad(loss), static_argnums=1)
    whole, in_blocks = (gradient.lower(x, block).compile() for block in (None, 100))
    assert_same(in_blocks(x), whole(x), 1e-10)
    most, least = (each.memory_analysis().temp_size_in_bytes for each in (whole, in_blocks))
    # The least is for arguments, results and their gradients, transposed.
    assert most > 20 * x.nbytes and least < 5 * x.nbytes


def test_axes_are_given_as_to_vmap():
    def function(shared, tree, z):
        return {"sum": shared + tree["a"] * z, "b": tree["b"]}

    tree = {"a": numbers(3, BATCH), "b": numbers(2)}
    args = (numbers(3), tree, numbers(BATCH))
    axes = {"in_axes": (None, {"a": 1, "b": None}, 0), "out_axes": {"sum": 1, "b": None}}
    assert_same(lanes(function, **axes)(*args), jax.vmap(function, **axes)(*args))
    result = lanes(function, (None, {"a": -1, "b": None}, 0))(*args)
    assert_same(result["b"], jnp.tile(tree["b"], (BATCH, 1)))


def test_lanes_can_be_mapped_and_scanned():
    x = numbers(4, BATCH, 3)
    assert_same(jax.vmap(lanes(CASES["vectors"]))(x), jax.vmap(jax.vmap(CASES["vectors"]))(x))
    scanned = lax.scan(lambda c, x: (c, lanes(CASES["vectors"])(x)), 0, x)[1]
    assert_same(scanned, jax.vmap(jax.vmap(CASES["vectors"]))(x))


def test_precision_follows_the_arguments():
    x = numbers(BATCH, 3).astype(jnp.float32)
    assert_same(lanes(lambda x: x * 2.0 + 1)(x), x * 2.0 + 1)
    assert lanes(lambda x: x + jnp.float64(1))(x).dtype == jnp.float64


@pytest.mark.parametrize("name", ["vectors", "the gradient of a checkpointed scan"])
def test_the_batch_axis_is_last_in_all_that_is_computed(name):
    program = jax.make_jaxpr(lanes(CASES[name], in_axes=-1, out_axes=-1))(numbers(3, BATCH))

    def shapes(jaxpr):
        for equation in jaxpr.eqns:
            for inner in jaxprs_in_params(equation.params):
                yield from shapes(inner)
            yield from (v.aval.shape for v in equation.outvars)

    computed = list(shapes(program.jaxpr))
    assert len(computed) > 20
    assert all(BATCH not in shape[:-1] for shape in computed)


def test_what_does_not_fit_is_refused():
    three, four, batch = jnp.zeros(3), jnp.zeros(4), jnp.zeros((BATCH, 3))
    for mapped, args, message in (
        (lanes(jnp.add), (three, four), r"batch sizes differ between arguments: \[3, 4\]"),
        (lanes(jnp.add, in_axes=None), (three, three), "no argument has a batch axis"),
        (lanes(jnp.add, in_axes=(0, 1)), (three, three), r"shape \(3,\) has no batch axis 1"),
        (lanes(jnp.sin, out_axes=None), (batch,), r"\(3,\) depends on the example; out_axes has N"),
    ):
        with pytest.raises(ValueError, match=message):
            mapped(*args)
    for block in (0, -1):
        with pytest.raises(ValueError, match=f"block is {block}, wanted 1 or more"):
            lanes(jnp.sin, block=block)
