"""`lanes` gives what `jax.vmap` gives, with the axis of many last in all that it computes."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.extend.core import jaxprs_in_params

import jaxik
from fitting.bench import setup
from jaxik import Smooth, lanes, presets
from jaxik.maths import quat, vec
from jaxik.world.terrain import plane
from support.cases import QUICK

MANY = 5


def numbers(*shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape))


def same(found, wanted, tolerance=1e-12):
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_allclose(one, other, rtol=tolerance, atol=tolerance)


@jax.custom_jvp
def bent(x, y):
    return jnp.abs(x) * y


@bent.defjvp
def _(primals, tangents):
    (x, y), (dx, dy) = primals, tangents
    return bent(x, y), 7.0 * dx + x * dy  # not the slope that JAX would find


@jax.custom_batching.custom_vmap
def ruled(x, y):
    return x * y


@ruled.def_vmap
def _(size, batched, x, y):
    x, y = (
        one if mapped else jnp.broadcast_to(one, (size, *one.shape))
        for one, mapped in zip((x, y), batched, strict=True)
    )
    return jax.vmap(jnp.multiply)(x, y), True


def carried(x):
    """A carry that starts the same for all, and one that stays so."""

    def turn(carry, now):
        place, count = carry
        return (place + x * now, count + 1), place[0] * count

    return lax.scan(turn, (jnp.zeros(3), 0), jnp.arange(4.0))


def started(x):
    """A condition that is the same for all, and one that all are told."""

    def turn(carry, now):
        begun, place = carry
        return (jnp.ones_like(begun), jnp.where(begun & now, 0.5 * place, place + x)), begun

    return lax.scan(turn, (jnp.zeros((), bool), x), jnp.arange(4) % 2 == 0)


CASES = {
    "vectors": lambda x: (vec.cross(x, x[::-1]), vec.normalize(x, jnp.ones(3)), vec.sum_last(x)),
    "rotations": lambda x: quat.rotate(vec_to_quat(x), x),
    "a number beside an array": lambda x: jnp.where(x[0] > 0, x, 2.0) + jnp.maximum(x, 0.1),
    "a bound for all": lambda x: lax.clamp(x[0], x, x[0] + 1.0),
    "shapes": lambda x: jnp.tile(x.reshape(3, 1), (2, 2)).T[1:, ::2].ravel(),
    "padding": lambda x: jnp.pad(x, (1, 2)),
    "sums and extremes": lambda x: (x.sum(), x.max(), x.argmin(), jnp.cumsum(x), jnp.any(x > 0)),
    "sums of few and of many": lambda x: (
        (cube := jnp.sin(jnp.arange(90.0).reshape(2, 15, 3) * x)).sum((0, 2)),
        cube.sum((1,)),
        cube.sum((0, 1)),
        cube[:0].sum(0),
        cube.astype(int).sum(0),
    ),
    "sorting": lambda x: jnp.sort(x),
    "products": lambda x: jnp.arange(12.0).reshape(4, 3) @ x,
    "what is looked up": lambda x: jnp.arange(10.0)[jnp.argmax(x)] + x[jnp.argmax(x)],
    "rows that are looked up": lambda x: jnp.arange(20.0).reshape(10, 2)[(9 * x).astype(int) % 10],
    "what is looked up and not there": lambda x: (
        jnp.arange(4.0).at[(3 * x).astype(int)].get(mode="fill", fill_value=-1.0) * x
    ),
    "a batch with a rule of its own": lambda x: ruled(x, x[0]),
    "a loop of its own length": lambda x: lax.while_loop(
        lambda s: s[0] < jnp.abs(x[0]) * 5, lambda s: (s[0] + 1.0, s[1] * x), (0.0, x)
    ),
    "a choice": lambda x: lax.cond(x[0] > 0, jnp.sin, jnp.cos, x),
    "a scan": carried,
    "a scan backwards": lambda x: lax.scan(
        lambda c, i: (c * x + i, c), x, jnp.arange(3.0), reverse=True
    ),
    "a scan with a condition": started,
    "slopes of a scan computed again": jax.grad(
        lambda x: jax.checkpoint(lambda x: carried(jnp.sin(x))[0][0])(x).sum()
    ),
    "one scan in another": lambda x: lax.scan(
        lambda c, _: (carried(c)[0][0], None), x, None, length=2
    )[0],
    "what is computed again": lambda x: jax.checkpoint(jnp.tanh)(x) * 2.0,
    "slopes told by hand": lambda x: bent(x, x[::-1]),
    "slopes": lambda x: jax.grad(lambda x: bent(vec.normalize(x, x), x[::-1]).sum())(x),
    "a jitted function": lambda x: jax.jit(vec.dot)(x, 2 * x) + vec.dot(jnp.ones(3), jnp.ones(3)),
    "what all share": lambda x: (jnp.arange(3), carried(jnp.ones(3)), x),
    "one within another": lambda x: lanes(lambda y: vec.cross(x, y))(jnp.eye(3)),
    "vmap within": lambda x: jax.vmap(lambda y: vec.cross(x, y))(jnp.eye(3)),
    "whole numbers": lambda x: jnp.right_shift((100 * x).astype(int), 1) % 7,
}


def vec_to_quat(x):
    return vec.stacked_barrier(*vec.components(x), jnp.ones(()))[3] * jnp.asarray([*[0.5] * 4])


@pytest.mark.parametrize("name", CASES)
def test_what_many_compute_is_what_each_computes(name):
    x = numbers(MANY, 3)
    wanted = jax.vmap(CASES[name])(x)
    same(lanes(CASES[name])(x), wanted)
    same(jax.jit(lanes(CASES[name]))(x), wanted)
    behind = lanes(CASES[name], in_axes=-1, out_axes=-1)(x.T)
    same(jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), behind), wanted)


@pytest.mark.parametrize("name", sorted(set(CASES) - {"a loop of its own length", "whole numbers"}))
def test_it_is_differentiated_as_vmap_is(name):
    x, along = numbers(MANY, 3), numbers(MANY, 3, seed=1)

    def total(batched):
        leaves = lambda x: jax.tree.leaves(batched(CASES[name])(x))  # noqa: E731
        floats = lambda x: [y for y in leaves(x) if jnp.issubdtype(y.dtype, jnp.floating)]  # noqa: E731
        return lambda x: sum(jnp.sum(jnp.sin(leaf)) for leaf in floats(x))

    same(jax.grad(total(lanes))(x), jax.grad(total(jax.vmap))(x), 1e-10)
    same(jax.jvp(total(lanes), (x,), (along,)), jax.jvp(total(jax.vmap), (x,), (along,)), 1e-10)


def test_a_function_that_goes_number_by_number_gets_all_of_them_as_they_are():
    seen = []

    @jax.custom_batching.custom_vmap
    def weighted(table, x, y):
        seen.append((table.shape, jnp.shape(x), jnp.shape(y)))
        return table[0] * x + y

    @weighted.def_vmap
    def by_many(size, batched, *given):
        return jax.vmap(weighted.fun, in_axes=[0 if mapped else None for mapped in batched])(
            *given
        ), True

    by_many.one_by_one = weighted
    x, table = numbers(MANY, 3), numbers(2)
    for of_one in (lambda x: weighted(table, x, x[0]), lambda x: weighted(table, x, 2.0)):
        seen.clear()
        found = lanes(of_one)(x)
        wide = seen[-1]
        same(found, jax.vmap(of_one)(x))
        assert wide[:2] == ((2,), (3, MANY)) and wide[2] in {(MANY,), (1,)}
    # What all were to share is of many: then it goes by its rule.
    same(*(batched(lambda x: weighted(x, x, x[0]))(x) for batched in (lanes, jax.vmap)))


@pytest.mark.parametrize("block", [1, 2, 3, 5, 9])
@pytest.mark.parametrize("name", ["vectors", "a scan", "what all share"])
def test_blocks_give_what_all_at_once_give(name, block):
    x = numbers(MANY, 3)
    wanted = jax.vmap(CASES[name])(x)
    same(lanes(CASES[name], block=block)(x), wanted)
    behind = lanes(CASES[name], in_axes=-1, out_axes=-1, block=block)(x.T)
    same(jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), behind), wanted)


def test_blocks_keep_what_is_the_same_for_all():
    found = lanes(lambda x: (x[0], jnp.arange(3)), out_axes=(0, None), block=2)(numbers(MANY, 3))
    assert found[0].shape == (MANY,) and found[1].tolist() == [0, 1, 2]


def test_reverse_mode_holds_one_block():
    def waves(x):
        for _ in range(40):  # each of which reverse mode keeps
            x = jnp.sin(jnp.cumsum(x))
        return x

    def loss(x, block):
        return jnp.sum(lanes(waves, block=block)(x) ** 2)

    x = numbers(20_000, 3)
    rooms = {}
    for block in (None, 100):
        compiled = jax.jit(jax.grad(loss), static_argnums=1).lower(x, block).compile()
        rooms[block] = compiled.memory_analysis().temp_size_in_bytes
        same(compiled(x), jax.grad(loss)(x, None), 1e-10)
    assert rooms[None] > 20 * x.nbytes
    assert rooms[100] < 5 * x.nbytes  # arguments, results and their slopes turned


@pytest.mark.parametrize("block", [0, -1])
def test_a_block_of_none_is_refused(block):
    with pytest.raises(ValueError, match=f"block is {block}, wanted 1 or more"):
        lanes(jnp.sin, block=block)


def test_axes_are_told_as_vmap_is_told():
    def function(shared, tree, z):
        return {"sum": shared + tree["a"] * z, "b": tree["b"]}

    tree = {"a": numbers(3, MANY), "b": numbers(2)}
    args = (numbers(3), tree, numbers(MANY))
    axes = {"in_axes": (None, {"a": 1, "b": None}, 0), "out_axes": {"sum": 1, "b": None}}
    same(lanes(function, **axes)(*args), jax.vmap(function, **axes)(*args))
    same(
        lanes(function, (None, {"a": -1, "b": None}, 0))(*args)["b"], jnp.tile(tree["b"], (MANY, 1))
    )


def test_it_batches_and_scans_itself():
    x = numbers(4, MANY, 3)
    same(jax.vmap(lanes(CASES["vectors"]))(x), jax.vmap(jax.vmap(CASES["vectors"]))(x))
    scanned = lax.scan(lambda c, x: (c, lanes(CASES["vectors"])(x)), 0, x)[1]
    same(scanned, jax.vmap(jax.vmap(CASES["vectors"]))(x))


def test_single_numbers_stay_single():
    x = numbers(MANY, 3).astype(jnp.float32)
    same(lanes(lambda x: x * 2.0 + 1)(x), x * 2.0 + 1)
    assert lanes(lambda x: x + jnp.float64(1))(x).dtype == jnp.float64


@pytest.mark.parametrize("name", ["vectors", "slopes of a scan computed again"])
def test_the_axis_of_many_is_last_in_all_that_is_computed(name):
    program = jax.make_jaxpr(lanes(CASES[name], in_axes=-1, out_axes=-1))(numbers(3, MANY))

    def shapes(jaxpr):
        for equation in jaxpr.eqns:
            for inner in jaxprs_in_params(equation.params):
                yield from shapes(inner)
            yield from (v.aval.shape for v in equation.outvars)

    found = list(shapes(program.jaxpr))
    assert len(found) > 20
    assert all(MANY not in shape[:-1] for shape in found)


@pytest.mark.parametrize(
    ("axes", "args", "told"),
    [
        (0, (numbers(3), numbers(4)), r"arguments of \[3, 4\], wanted equally many"),
        (None, (numbers(3), numbers(3)), "no argument with an axis of them"),
        ((0, 1), (numbers(3), numbers(3)), r"shape \(3,\), wanted one with axis 1"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(axes, args, told):
    with pytest.raises(ValueError, match=told):
        lanes(jnp.add, in_axes=axes)(*args)


def test_a_result_that_differs_cannot_be_the_same_for_all():
    with pytest.raises(ValueError, match=r"shape \(3,\) differs, wanted the same for all"):
        lanes(lambda x: x, out_axes=None)(numbers(MANY, 3))


@pytest.mark.parametrize(
    ("preset", "ground", "gate"),
    [
        ("record", "mesh", jaxik.HARD),
        ("mec", "plane", setup.single(Smooth(0.1))),
    ],
)
def test_a_crowd_does_what_its_members_do(preset, ground, gate):
    crowd = dataclasses.replace(setup.crowd(3, 8), drawn={})
    flat = setup.single(plane(normal=(0.1, 1.0, 0.05)))
    under = flat if ground == "plane" else setup.ground(setup.field(30))
    ik = setup.single(getattr(presets, preset)())

    def of_one(given):
        return jaxik.run(ik, crowd.rig, under, crowd.member(given)[1], gate, block=4)

    quick = functools.partial(jax.jit, compiler_options=QUICK)
    found, wanted = quick(lanes(of_one))(crowd.rows), quick(jax.vmap(of_one))(crowd.rows)
    same(found, wanted, 2e-5)
