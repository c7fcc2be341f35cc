"""Problems: free parameters as a vector, their priors, losses, probabilities, mistakes of users."""

import inspect
from dataclasses import replace
from typing import Any, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special, stats

from fitting.experiment import systems
from fitting.problem.problem import (
    CAUCHY,
    HUBER,
    TAILS,
    Loss,
    _factor_and_slope,
    apply_loss,
    rho,
    slope_of_rho,
)
from fitting.problem.space import (
    CENTRE_LIMIT,
    INTERVAL,
    LOGISTIC_SD,
    OWN_CENTRE_LIMIT,
    SPREAD,
    ParameterPrior,
    Prior,
    Priors,
    Space,
    free_parameter,
    make_space,
    prior_probability,
)
from jaxik.maths import parameter_tree
from support import toy
from support.problems import Fractions, problem_of

TOLERANCE = 1e-9
UNIFORM = ParameterPrior("uniform")
SHARE = ParameterPrior(centre=0.3, spread=0.4)  # of `foot.share`, which is from 0 to 1.2
U_OF_SHARE = np.log(0.25 / 0.75)


def make(*names: str, priors: Priors | None = None, **overrides) -> Space:
    ik = toy.Toy()
    space = make_space(ik, [free_parameter(ik, name, **overrides) for name in names])
    return space.with_prior(Priors() if priors is None else priors)


# Values and u


def test_values_stay_in_their_bounds_and_order_and_packing_gives_u_again():
    space = make(
        "lock.height_off", "lock.height_on", "body.half_life", "foot.limit[1]", "lock.release"
    )

    @jax.jit
    @jax.vmap
    def unpack_and_pack(u: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Values, and `u` again from the system and from the values."""
        values = space.values(u)
        named = dict(zip(space.names, values, strict=True))
        return values, space.pack(space.unpack(u)), space.pack(named)

    u = np.random.default_rng(0).uniform(-12, 12, (2000, space.size))
    u[:1000] /= 2
    u[0] = 0.0
    values, *again = map(np.asarray, unpack_and_pack(jnp.asarray(u)))
    assert (values >= np.asarray(space.low) - 1e-12).all()
    assert (values <= np.asarray(space.high) + 1e-12).all()
    assert (values[:, 0] >= values[:, 1]).all()
    for packed in again:
        np.testing.assert_allclose(packed[:1000], u[:1000], atol=1e-6)
    np.testing.assert_allclose(space.pack({}), space.start, rtol=TOLERANCE)
    above_fixed = make("lock.height_off").values(jnp.full(1, -30.0))
    assert above_fixed[0] == pytest.approx(0.06)


def test_the_middle_of_a_logarithmic_range_is_a_geometric_one():
    value = make("lock.release").values(jnp.zeros(1))[0]
    np.testing.assert_allclose(value, np.sqrt(0.01 * 0.5), rtol=TOLERANCE)


def test_one_leg_can_be_free_while_the_other_keeps_its_value_or_one_value_is_of_all():
    for name, limits in (("foot.limit[1]", [0.4, 0.45]), ("foot.limit", [0.45, 0.45])):
        space = make(name)
        assert space.size == 1
        np.testing.assert_allclose(space.unpack(jnp.zeros(1)).foot.limit, limits, rtol=TOLERANCE)
    space = problem_of(Fractions(jnp.full(12, 0.1)), ["x[11]"], None, min).space
    np.testing.assert_allclose(space.unpack(jnp.zeros(1)).x, [0.1] * 11 + [0.5])


def test_start_and_prior_are_at_the_present_values_or_where_they_are_put():
    space = make("body.rise", "foot.share")
    np.testing.assert_array_equal(space.prior_residuals(space.start), 0)
    np.testing.assert_allclose(space.prior_residuals(space.start + SPREAD), 1, rtol=TOLERANCE)
    priors = Priors(ParameterPrior(spread=0.5), {"body.rise": ParameterPrior(centre=0.12)})
    space = space.with_start({"foot.share": 0.3}).with_prior(priors)
    np.testing.assert_allclose(space.values(space.start), [0.05, 0.3], rtol=TOLERANCE)
    np.testing.assert_allclose(space.values(space.prior.centre), [0.12, 0.6], rtol=TOLERANCE)
    np.testing.assert_allclose(space.prior.spread, [SPREAD, 0.5])
    space = space.with_prior(Priors(named={"body.rise": UNIFORM}))
    np.testing.assert_array_equal(space.prior.uniform, [True, False])
    np.testing.assert_allclose(space.prior.spread, [1.0, SPREAD])
    np.testing.assert_allclose(space.values(space.prior.centre), [0.1, 0.6])


def test_a_centre_or_start_at_a_bound_is_moved_inside_where_u_is_finite():
    space = make("body.rise").with_start({"body.rise": 0.2})
    space = space.with_prior(Priors(named={"body.rise": ParameterPrior(centre=0.0)}))
    assert (space.prior.centre[0], space.start[0]) == (-CENTRE_LIMIT, CENTRE_LIMIT)
    outside = make("body.rise", low=0.1)  # the present value is less
    assert (outside.start[0], outside.prior.centre[0]) == (-CENTRE_LIMIT, -OWN_CENTRE_LIMIT)


# Priors

PRIOR = Prior(jnp.asarray([0.7, 0.0]), jnp.asarray([1.3, 1.0]), jnp.asarray([False, True]))
DISTRIBUTIONS: tuple[Any, ...] = (stats.norm(0.7, 1.3), stats.logistic())
POINTS = np.array([-700.0, -40, -3, -2, -1.9, -1e-3, -1e-9, 0, 1e-200, 1e-5, 0.1, 1, 2.1, 30, 700])


def test_half_the_square_of_a_residual_is_minus_the_log_density():
    both = jnp.asarray(np.stack([POINTS] * 2, axis=1))
    residuals = np.asarray(jax.vmap(PRIOR.residuals)(both))
    for i, distribution in enumerate(DISTRIBUTIONS):
        expected = distribution.logpdf(distribution.median()) - distribution.logpdf(POINTS)
        np.testing.assert_allclose(0.5 * residuals[:, i] ** 2, expected, rtol=1e-12, atol=1e-14)
    np.testing.assert_array_equal(np.sign(residuals[:, 1]), np.sign(POINTS))
    ends = PRIOR.ends(1.92)
    np.testing.assert_allclose(0.5 * np.asarray(PRIOR.residuals(jnp.asarray(ends))) ** 2, 1.92)
    assert (ends[0] < ends[1]).all()


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_residuals_and_their_slopes_are_finite_and_smooth_everywhere(dtype):
    points = np.concatenate([np.linspace(-5, 5, 1001), POINTS]).astype(dtype)
    prior = jax.tree.map(lambda x: x.astype(dtype) if x.dtype != bool else x, PRIOR)
    derivative = jax.vmap(jax.jacfwd(prior.residuals))
    slopes = np.asarray(derivative(jnp.asarray(np.stack([points] * 2, axis=1))))
    assert slopes.dtype == dtype
    assert np.isfinite(slopes).all()
    logistic = slopes[:, 1, 1]
    assert logistic.min() > 0
    assert logistic[points == 0] == pytest.approx(np.sqrt(0.5), rel=1e-6)
    assert np.abs(np.diff(logistic[:1001])).max() < 2e-3, "no step where one form takes over"


def test_quantiles_draws_and_the_standard_deviation_are_those_of_the_distributions():
    probability = np.array([0.001, 0.4, 0.975])
    draws = PRIOR.draw(np.random.default_rng(0), 20_000)
    for i, distribution in enumerate(DISTRIBUTIONS):
        quantile = PRIOR.quantile(probability[:, None])[:, i]
        np.testing.assert_allclose(quantile, distribution.ppf(probability))
        assert float(PRIOR.sd[i]) == pytest.approx(distribution.std())
        assert stats.kstest(draws[:, i], distribution.cdf).pvalue > 0.01
    assert pytest.approx(stats.logistic.std()) == LOGISTIC_SD


def test_intervals_leave_out_a_fortieth_of_the_prior_on_either_side():
    names = ("foot.share", "lock.release", "foot.idle")
    priors = Priors(UNIFORM, {"foot.share": SHARE})
    share, release, idle = make(*names, priors=priors).prior_interval()
    fortieths = np.array([0.025, 0.975])
    u = U_OF_SHARE + 0.4 * stats.norm.ppf(fortieths)
    np.testing.assert_allclose(share, 1.2 * special.expit(u))
    np.testing.assert_allclose(release, 0.01 * 50**fortieths)
    np.testing.assert_allclose(idle, fortieths)


def test_the_prior_of_every_parameter_of_every_preset_allows_most_of_its_range():
    """On its scale, and also where the preset's value is at a bound, as a half-life of 0 is."""
    originals = [("record", True), ("mec", True)]
    for preset, faithful in [*((name, False) for name in systems.preset_names()), *originals]:
        ik = systems.preset_system(preset, faithful=faithful)
        parameters = [free_parameter(ik, name) for name in parameter_tree.declarations(ik)]
        prior = make_space(ik, [replace(parameter, above=None) for parameter in parameters]).prior
        low, high = special.expit(prior.quantile(np.array(INTERVAL)[:, None]))
        for name, fraction in zip((p.name for p in parameters), high - low, strict=True):
            assert fraction > 0.8, (preset, name)


def test_a_parameter_above_a_free_one_has_the_interval_and_probability_of_the_mixture():
    priors = Priors(UNIFORM, {"foot.share": SHARE})
    space = make("lock.height_off", "lock.height_on", "foot.share", priors=priors)
    random = np.random.default_rng(1)
    off = random.uniform(np.maximum(random.uniform(0.01, 0.12, 200_000), 0.02), 0.2)
    expected = np.quantile(off, [0.025, 0.975])
    np.testing.assert_allclose(space.prior_interval()[0], expected, atol=0.003 * 0.18)
    np.testing.assert_allclose(space.prior_interval()[1], [0.01275, 0.11725])
    values = np.array([[0.0, 0.0, -1.0], [0.05, 0.065, 0.3], [0.15, 0.1, 0.5], [0.3, 0.2, 2.0]])
    probability = prior_probability(space, values)
    expected = (off[:, None] <= values[:, 0]).mean(axis=0)
    np.testing.assert_allclose(probability[:, 0], expected, atol=0.02)
    np.testing.assert_allclose(probability[:, 1], [0, 0.5, 9 / 11, 1], atol=1e-6)
    share = stats.norm(U_OF_SHARE, 0.4).cdf(special.logit(values[1:3, 2] / 1.2))
    np.testing.assert_allclose(probability[:, 2], [0, *share, 1], atol=1e-6)


# Losses

LOSSES = {
    "squares": lambda z: z,
    "huber": lambda z: np.where(z > HUBER**2, 2 * HUBER * np.sqrt(z) - HUBER**2, z),
    "cauchy": lambda z: CAUCHY**2 * np.log1p(z / CAUCHY**2),
    "student": lambda z: (TAILS + 1) * np.log1p(z / TAILS),
}
RESIDUALS = jnp.asarray(
    [0.0, 1e-200, 1e-30, 1e-9, 1e-3, 0.5, 1.0, 1.345, 3.0, 1e3, 1e9, -1e-9, -2.0]
)


@pytest.mark.parametrize("loss", get_args(Loss))
def test_the_square_of_a_robust_residual_is_the_loss_and_its_weight_the_slope(loss):
    robust = apply_loss(RESIDUALS, loss)
    np.testing.assert_allclose(robust**2, LOSSES[loss](np.asarray(RESIDUALS) ** 2), rtol=1e-9)
    np.testing.assert_array_equal(jnp.sign(robust), jnp.sign(RESIDUALS))
    squares = np.asarray(RESIDUALS)[3:] ** 2
    slopes = jax.vmap(jax.grad(lambda z: rho(z, loss)))(jnp.asarray(squares))
    np.testing.assert_allclose(slope_of_rho(squares, loss), slopes, rtol=1e-9)
    np.testing.assert_allclose(rho(squares, loss), LOSSES[loss](squares), rtol=1e-9)


@pytest.mark.parametrize("loss", get_args(Loss))
def test_the_derivative_of_a_robust_residual_at_zero_is_known_and_finite_everywhere(loss):
    derivative = jax.vmap(jax.grad(lambda residual: apply_loss(residual[None], loss)[0]))
    for dtype in ("float32", "float64"):
        derivatives = derivative(RESIDUALS.astype(dtype))
        assert derivatives.dtype == dtype
        assert jnp.isfinite(derivatives).all()
        steepest = np.sqrt((TAILS + 1) / TAILS) if loss == "student" else 1
        np.testing.assert_allclose(derivatives[:4], steepest, rtol=1e-6)


def test_an_unknown_loss_is_refused():
    with pytest.raises(ValueError, match="loss is 'absolute', wanted one of"):
        # before any check of types
        inspect.unwrap(_factor_and_slope)(RESIDUALS**2, "absolute", TAILS, jnp)


# Probabilities


def roots(ik: toy.Toy, data: jax.Array) -> jax.Array:
    """Not finite where the share is less than the data."""
    return jnp.sqrt(ik.foot.share - data)


@pytest.mark.parametrize("loss", get_args(Loss))
def test_a_weight_scales_the_whole_cost_and_of_the_probability_only_the_likelihood(loss):
    data = jnp.asarray([-9.0, 0.1])
    problem = problem_of(toy.Toy(), ["foot.share"], data, roots, loss).with_weight(0.3)
    u = jnp.asarray([0.7])
    losses = LOSSES[loss](np.asarray(problem.space.values(u)[0] - data)).sum()
    prior = float(problem.space.prior_residuals(u)[0]) ** 2
    log_probability = -0.5 * (0.3 * losses + prior)
    np.testing.assert_allclose(problem.log_probability(u), log_probability, rtol=TOLERANCE)
    np.testing.assert_allclose(problem.cost(u), 0.15 * (losses + prior), rtol=TOLERANCE)
    np.testing.assert_allclose(problem.prior_costs(np.asarray(u)), [0.15 * prior], rtol=TOLERANCE)
    beyond = replace(problem, data=jnp.asarray([0.9, 0.1]))
    assert beyond.log_probability(jnp.asarray([-3.0])) == -jnp.inf


def test_other_data_bounds_starts_priors_and_weights_do_not_compile_again():
    traces = []

    @eqx.filter_jit
    def cost(problem, u: jax.Array) -> jax.Array:
        traces.append(1)
        return problem.cost(u)

    problem = problem_of(toy.Toy(), ["foot.share"], jnp.zeros(1), roots)
    cost(problem, jnp.zeros(1))
    for value, prior in ((0.1, ParameterPrior(spread=0.5)), (0.2, ParameterPrior("uniform"))):
        space = problem.space.with_start({"foot.share": value}).with_prior(Priors(prior))
        space = eqx.tree_at(lambda s: s.low, space, space.low - value)
        data = jnp.asarray([value])
        cost(replace(problem, space=space, data=data).with_weight(value), data)
    assert len(traces) == 1


# Mistakes


@pytest.mark.parametrize(
    ("names", "overrides", "message"),
    [
        ("lock.hight_on", {}, "nearest is 'lock.height_on'.*there are"),
        ("foot.limit[2]", {}, r"there are \['foot.limit\[0\]', 'foot.limit\[1\]'\]"),
        ("foot.limit[-1]", {}, "no element"),
        ("foot.share[0]", {}, "shared by the legs"),
        ("foot.share", {"lower": 0}, "unknown key .lower.; nearest is"),
        ("foot.share", {"low": 2.0}, "bounds are 2.0 to 1.2"),
        ("foot.share", {"low": float("nan")}, "low is nan; wanted a finite number"),
        ("lock.release", {"low": 0.0}, "strictly between 0.0"),
        ("foot.share", {"prior_sd": 1.0}, "unknown key .prior_sd.; nearest is"),
        ("foot.share", {"scale": "square"}, "scale is 'square'"),
        ("foot.share", {"kind": "soft"}, "kind is 'soft'"),
        ("foot.share foot.share", {}, "free twice"),
        ("foot.limit foot.limit[0]", {}, "free twice"),
        ("lock.height_on lock.height_off", {"high": 0.11}, "above lock.height_on, which reaches"),
    ],
)
def test_a_mistake_in_free_parameters_is_answered_with_what_is_allowed(names, overrides, message):
    with pytest.raises(ValueError, match=message):
        make(*names.split(), **overrides)


def test_values_that_are_not_free_or_outside_their_bounds_are_refused():
    space = make("foot.share")
    for name, value, message in (
        ("body.rise", 0.1, r"not free: \['body.rise'\]; free are \['foot.share'\]"),
        ("foot.share", -1.0, "foot.share: start is -1, wanted from 0 to 1.2"),
    ):
        with pytest.raises(ValueError, match=message):
            space.with_start({name: value})
    with pytest.raises(ValueError, match="foot.share: centre is 1.5, wanted from 0 to 1.2"):
        space.with_prior(Priors(named={"foot.share": ParameterPrior(centre=1.5)}))


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"spread": 0.0}, "spread is 0.0, wanted a number from 0.001 to 1000"),
        ({"spread": np.inf}, "spread is inf, wanted a number from 0.001 to 1000"),
        ({"shape": "uniform", "centre": 0.5}, "centre is given, but a uniform prior has none"),
        ({"shape": "uniform", "spread": 0.5}, "spread is given, but a uniform prior has none"),
        ({"shape": "flat"}, r"'flat', wanted one of .'normal', 'uniform'."),
    ],
)
def test_a_prior_that_makes_no_sense_is_refused(entry, message):
    prior = ParameterPrior()
    for name, value in entry.items():
        object.__setattr__(prior, name, value)  # before any check of types
    with pytest.raises(ValueError, match=message):
        prior.__post_init__()
