"""Free parameters as a vector: transforms, order, priors and mistakes of users."""

import dataclasses
from typing import get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fitting.problem.free_parameters import free_parameter
from fitting.problem.loss import Loss, rho
from fitting.problem.prior import ParameterPrior, Priors
from fitting.problem.problem import Problem
from fitting.problem.space import CENTRE_LIMIT, OWN_CENTRE_LIMIT, Space, make_space
from jaxik.maths import smoothing
from support import toy

NAMES = ("lock.height_off", "lock.height_on", "body.gain", "foot.limit[1]", "lock.release")
TOLERANCE = 1e-9


def make(*names: str, **overrides) -> Space:
    return make_space(toy.Toy(), [free_parameter(toy.Toy(), n, **overrides) for n in names])


def test_values_stay_in_their_bounds_and_order_and_packing_gives_u_again():
    space = make(*NAMES)

    @jax.jit
    @jax.vmap
    def unpack_and_pack(u: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Values, and `u` again from the system and from the values."""
        values = space.values(u)
        named = dict(zip(space.names, values, strict=True))
        return values, space.pack(space.unpack(u)), space.pack(named)

    u = np.random.default_rng(0).uniform(-12, 12, (2000, len(NAMES)))
    u[:1000] /= 2
    u[0] = 0.0
    values, *again = map(np.asarray, unpack_and_pack(jnp.asarray(u)))
    assert (values >= np.asarray(space.low) - 1e-12).all()
    assert (values <= np.asarray(space.high) + 1e-12).all()
    assert (values[:, 0] >= values[:, 1]).all()
    for packed in again:
        np.testing.assert_allclose(packed[:1000], u[:1000], atol=1e-6)


def test_the_middle_of_a_gain_or_a_logarithmic_range_is_a_geometric_one():
    space = make("body.gain")
    gain = space.values(jnp.zeros(1))[0]
    ends = smoothing.half_life_of_gain(jnp.asarray([0.02, 0.9]), jnp.asarray(30.0))
    middle = smoothing.half_life_of_gain(gain, jnp.asarray(30.0))
    np.testing.assert_allclose(middle, jnp.sqrt(ends[0] * ends[1]), rtol=TOLERANCE)
    value = make("lock.release").values(jnp.zeros(1))[0]
    np.testing.assert_allclose(value, np.sqrt(0.01 * 0.5), rtol=TOLERANCE)


@pytest.mark.parametrize(
    ("name", "limits"), [("foot.limit[1]", [0.4, 0.45]), ("foot.limit", [0.45, 0.45])]
)
def test_one_leg_can_be_free_while_the_other_keeps_its_value_or_one_value_is_of_all(name, limits):
    space = make(name)
    assert space.size == 1
    np.testing.assert_allclose(space.unpack(jnp.zeros(1)).foot.limit, limits, rtol=TOLERANCE)


def test_a_value_stays_above_one_that_is_fixed():
    space = make("lock.height_off")
    assert space.values(jnp.full(1, -30.0))[0] == pytest.approx(0.06)


def test_start_and_prior_are_at_the_present_values():
    space = make(*NAMES)
    np.testing.assert_allclose(space.pack({}), space.start, rtol=TOLERANCE)
    np.testing.assert_array_equal(space.prior_residuals(space.start), 0)
    np.testing.assert_allclose(space.prior_residuals(space.start + 1.6), 1, rtol=TOLERANCE)


def test_the_start_is_apart_from_the_centre_of_the_prior():
    space = make("body.rise", "foot.share").with_start({"foot.share": 0.3})
    named = {"body.rise": ParameterPrior(centre=0.12)}
    space = space.with_prior(Priors(ParameterPrior(spread=0.5), named))
    np.testing.assert_allclose(space.values(space.start), [0.05, 0.3], rtol=TOLERANCE)
    np.testing.assert_allclose(space.values(space.prior.centre), [0.12, 0.6], rtol=TOLERANCE)
    np.testing.assert_allclose(space.prior.spread, [1.6, 0.5])


def test_a_centre_or_start_at_a_bound_is_moved_inside_where_u_is_finite():
    space = make("body.rise").with_start({"body.rise": 0.2})
    space = space.with_prior(Priors(named={"body.rise": ParameterPrior(centre=0.0)}))
    assert (space.prior.centre[0], space.start[0]) == (-CENTRE_LIMIT, CENTRE_LIMIT)


def test_a_present_value_outside_the_bounds_is_clipped():
    space = make("body.rise", low=0.1)
    assert (space.start[0], space.prior.centre[0]) == (-CENTRE_LIMIT, -OWN_CENTRE_LIMIT)


def test_a_centre_or_start_outside_the_bounds_is_refused():
    space = make("foot.share")
    with pytest.raises(ValueError, match="foot.share: centre is 1.5, wanted from 0 to 1.2"):
        space.with_prior(Priors(named={"foot.share": ParameterPrior(centre=1.5)}))
    with pytest.raises(ValueError, match="foot.share: start is -1, wanted from 0 to 1.2"):
        space.with_start({"foot.share": -1.0})
    with pytest.raises(ValueError, match=r"not free: \['body.rise'\]; free are \['foot.share'\]"):
        space.with_start({"body.rise": 0.1})


def test_a_parameter_is_either_smooth_or_a_threshold():
    space = make("lock.height_on", "body.rise")
    assert space.smooth == (False, True)
    assert space.thresholds == (True, False)


@pytest.mark.parametrize(
    ("name", "overrides", "message"),
    [
        ("lock.hight_on", {}, "nearest is 'lock.height_on'.*there are"),
        ("foot.limit[2]", {}, r"there are \['foot.limit\[0\]', 'foot.limit\[1\]'\]"),
        ("foot.limit[-1]", {}, "no element"),
        ("foot.share[0]", {}, "shared by the legs"),
        ("foot.share", {"lower": 0}, "unknown.*lower.*takes"),
        ("foot.share", {"low": 2.0}, "bounds are 2.0 to 1.2"),
        ("foot.share", {"low": float("nan")}, "bounds are nan"),
        ("lock.release", {"low": 0.0}, "strictly between 0.0"),
        ("body.gain", {"high": 1.0}, "and 0.999999999 for the scale 'gain'"),
        ("foot.share", {"prior_sd": 1.0}, "unknown.*prior_sd.*takes"),
        ("foot.share", {"scale": "square"}, "scale is 'square'"),
        ("foot.share", {"kind": "soft"}, "kind is 'soft'"),
    ],
)
def test_a_mistake_in_a_free_parameter_is_answered_with_what_is_allowed(name, overrides, message):
    with pytest.raises(ValueError, match=message):
        free_parameter(toy.Toy(), name, **overrides)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ((), "nothing is free"),
        (("foot.share", "foot.share"), "free twice"),
        (("foot.limit", "foot.limit[0]"), "free twice"),
    ],
)
def test_a_space_without_parameters_or_with_duplicates_is_refused(names, message):
    with pytest.raises(ValueError, match=message):
        make(*names)


@pytest.mark.parametrize(
    ("on", "off", "message"),
    [
        ({}, {"high": 0.11}, "stays above lock.height_on, which reaches 0.12"),
        ({"above": "lock.height_off", "high": 0.3}, {"high": 0.4}, "above"),
    ],
    ids=["no room above", "above each other"],
)
def test_parameters_without_room_above_each_other_are_refused(on, off, message):
    ik = toy.Toy()
    parameters = [
        dataclasses.replace(free_parameter(ik, name), **changes)
        for name, changes in (("lock.height_on", on), ("lock.height_off", off))
    ]
    with pytest.raises(ValueError, match=message):
        make_space(ik, parameters)


def test_packing_a_name_that_is_not_free_is_refused():
    with pytest.raises(ValueError, match=r"not free: \['foot.share'\]; free are \['body.rise'\]"):
        make("body.rise").pack({"foot.share": 0.5})


def residuals(ik: toy.Toy, data: jax.Array) -> jax.Array:
    return jnp.sqrt(ik.foot.share - data)


@pytest.mark.parametrize("loss", get_args(Loss))
def test_the_log_probability_is_minus_half_the_losses_and_prior(loss):
    problem = Problem(make("foot.share"), jnp.asarray([-9.0, 0.1]), residuals, loss)
    u = jnp.asarray([0.7])
    z = np.asarray(problem.space.values(u)[0] - problem.data)
    prior = float(problem.space.prior_residuals(u)[0])
    expected = -0.5 * (rho(z, loss, library=np).sum() + prior**2)
    np.testing.assert_allclose(problem.log_probability(u), expected, rtol=TOLERANCE)
    np.testing.assert_allclose(problem.cost(u), -expected, rtol=TOLERANCE)


def test_the_log_probability_of_residuals_that_are_not_finite_is_minus_infinity():
    problem = Problem(make("foot.share"), jnp.asarray([0.9]), residuals)
    assert problem.log_probability(jnp.asarray([-3.0])) == -jnp.inf


def test_other_data_bounds_starts_and_priors_do_not_compile_again():
    traces = []

    @eqx.filter_jit
    def cost(problem: Problem, u: jax.Array) -> jax.Array:
        traces.append(1)
        return problem.cost(u)

    for value, prior in ((0.1, ParameterPrior(spread=0.5)), (0.2, ParameterPrior("uniform"))):
        space = make("foot.share").with_start({"foot.share": value})
        space = space.with_prior(Priors(prior))
        space = eqx.tree_at(lambda s: s.low, space, space.low - value)
        cost(Problem(space, jnp.asarray([value]), residuals), jnp.asarray([value]))
    assert len(traces) == 1
