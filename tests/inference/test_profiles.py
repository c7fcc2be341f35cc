"""How well the data determine parameters: profiles against exact ones, intervals, verdicts."""

import dataclasses
import functools
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.stats

from fitting.inference.identifiability import Identifiability, assess_identifiability
from fitting.inference.optimise import evolution, search
from fitting.inference.optimise.evolution import Slopes
from fitting.inference.optimise.solution import SearchSettings, Solution
from fitting.inference.profiles.conditional import (
    Conditional,
    Points,
    Targets,
    slopes_of_thresholds,
)
from fitting.inference.profiles.profile import (
    RISE_OF_SMOOTH,
    RISE_OF_THRESHOLD,
    Curves,
    level_of,
    max_rise,
)
from fitting.inference.profiles.profiling import Profiling, cross_cliffs
from fitting.problem.problem import Problem
from fitting.problem.space import (
    SPREAD,
    ParameterPrior,
    Priors,
    free_parameter,
    from_fractions,
    make_space,
    to_fractions,
)
from fitting.runtime import threads
from support import toy
from support.curves import curve_problem
from support.problems import Fractions, parameter, problem_of, problem_of_fractions

NOISE = 0.035
TIME = jnp.linspace(0, 2, 200)
Assessed = tuple[Problem, Solution, Identifiability]


def residuals(ik, data: jax.Array) -> jax.Array:
    return ((ik.motion() - data) / NOISE).ravel()


def assessed(kind: type, truth: dict[str, float], seed: int) -> Assessed:
    """The profiles of a system with noisy data of the truth, from a search that begins there."""
    clean = kind(**{name: jnp.asarray(value) for name, value in truth.items()}).motion()
    data = clean + NOISE * np.random.default_rng(seed).normal(size=clean.shape)
    problem = problem_of(kind(), tuple(truth), jnp.asarray(data), residuals)
    first = np.asarray(problem.space.pack(truth))
    solution = search.find_best_fit(problem, starts=1, first=first)
    return problem, solution, assess_identifiability(problem, solution)


# Exact profiles


COUPLED = (
    "body.half_life",
    "body.drop",
    "body.rise",
    "foot.share",
    "foot.limit[0]",
    "foot.half_life",
)


@functools.cache
def coupled() -> Assessed:
    """Smooth parameters only, so that SciPy finds the exact profile."""
    problem = toy.make_problem(names=COUPLED)
    solution = search.find_best_fit(problem)
    return problem, solution, assess_identifiability(problem, solution)


@eqx.filter_jit
def residuals_and_jacobian(problem: Problem, u: jax.Array) -> tuple[jax.Array, jax.Array]:
    return problem.residuals(u), problem.jacobian(u)


def exact_rise(name: str, value: float) -> float:
    """Of the lowest cost with one parameter held, by SciPy from the solution."""
    problem, solution, _ = coupled()
    held = COUPLED.index(name)
    others = np.arange(len(COUPLED)) != held
    place = float(problem.space.pack({name: value})[held])

    def at(rest: np.ndarray, which: int) -> np.ndarray:
        u = jnp.asarray(np.insert(rest, held, place))
        return np.asarray(residuals_and_jacobian(problem, u)[which])

    found = scipy.optimize.least_squares(
        lambda rest: at(rest, 0),
        solution.u[others],
        jac=lambda rest: at(rest, 1)[:, others],  # type: ignore
        xtol=1e-12,
        ftol=1e-12,
    )
    return float(found.cost) - solution.cost


@pytest.mark.parametrize("name", COUPLED)
def test_a_profile_is_the_exact_one_where_the_cost_is_low_and_at_the_ends_of_its_interval(name):
    """Which are where it has risen by half of chi-square."""
    profile = coupled()[2].profiles[name]
    near = np.flatnonzero(profile.rises < 3 * profile.max_rise)
    assert len(near) >= 4
    for k in near:
        exact = exact_rise(name, profile.values[k])
        assert profile.rises[k] == pytest.approx(exact, abs=0.05), profile.values[k]
    assert profile.max_rise == pytest.approx(RISE_OF_SMOOTH, rel=0.1)
    for end in profile.interval:
        assert exact_rise(name, end) == pytest.approx(profile.max_rise, rel=0.05), end


# Heights of intervals: chi-square's, or higher beside a plateau that noise undercuts

HALF_LIFE = free_parameter(toy.Toy(), "body.half_life")
U = np.unique(np.concatenate([np.linspace(-6, 6, 241), np.linspace(-0.02, 0.02, 21)]))


def half_lives(u: np.ndarray) -> np.ndarray:
    return from_fractions(HALF_LIFE, 1 / (1 + np.exp(-u)))


def test_heights_and_levels_of_a_parabola_are_those_of_chi_square():
    for sd, step in itertools.product((0.05, 0.3, 1.6), (0.3, 1.0)):
        u = 0.4 + sd * np.arange(-5, 5.1, step)  # few points suffice
        height = max_rise(HALF_LIFE, half_lives(u), 0.5 * ((u - 0.4) / sd) ** 2)
        assert RISE_OF_SMOOTH <= height < 1.1 * RISE_OF_SMOOTH, (sd, step)
    u = np.linspace(-3, 3, 31)
    for rise in (0.1, 0.5, 1.92, 4.0):
        level = level_of(HALF_LIFE, half_lives(u), 0.5 * (u / 0.5) ** 2, rise)
        assert level == pytest.approx(scipy.stats.chi2(1).cdf(2 * rise), abs=0.02)
    assert max_rise(HALF_LIFE, half_lives(np.zeros(1)), np.zeros(1)) == RISE_OF_SMOOTH


def test_a_narrow_minimum_does_not_exclude_a_wide_plateau_but_for_one_out_of_reach():
    narrow, prior = 0.5 * (U / 0.005) ** 2, 0.5 * (U / 1.6) ** 2
    height = max_rise(HALF_LIFE, half_lives(U), np.minimum(3.0 + prior, narrow))
    share_of_plateau = np.exp(-3) * 1.6 / (np.exp(-3) * 1.6 + 0.005)
    assert share_of_plateau > 0.9
    inside = scipy.stats.norm(scale=1.6).cdf(np.sqrt(2 * (height - 3)) * 1.6)
    level = share_of_plateau * (2 * inside - 1) + 1 - share_of_plateau
    assert level == pytest.approx(0.95, abs=0.01)
    height = max_rise(HALF_LIFE, half_lives(U), np.minimum(12.0 + prior, narrow))
    assert height == pytest.approx(RISE_OF_SMOOTH, rel=0.1)


# Verdicts


class Bumps(eqx.Module):
    """Two thresholds of which only the sum matters, one without effect, a square, a clamp."""

    first: jax.Array = parameter(0.5, "s", 0.0, 1.0, kind="threshold")
    second: jax.Array = parameter(0.5, "s", 0.0, 1.0, kind="threshold")
    lonely: jax.Array = parameter(0.5, "s", 0.0, 1.0, kind="threshold")
    square: jax.Array = parameter(0.6, "1", -1.0, 1.0)
    limit: jax.Array = parameter(0.5, "1", 0.0, 2.0)

    def motion(self) -> jax.Array:
        jump = jnp.where(TIME < self.first + self.second, 0.0, 0.3)
        clamped = jnp.minimum(TIME / 2, self.limit)  # up to 1
        return jnp.stack([jump, self.square**2 * TIME, clamped])


@functools.cache
def bumps(limit: float = 1.2) -> Assessed:
    truth = {"first": 0.4, "second": 0.7, "lonely": 0.5, "square": 0.6, "limit": limit}
    return assessed(Bumps, truth, 1)


@pytest.mark.slow
def test_profiles_are_the_same_on_another_number_of_cores(monkeypatch):
    problem, solution, before = bumps()
    cores = 3 if threads.usable_cores() == 1 else 1
    monkeypatch.setattr(threads, "usable_cores", lambda: cores)
    again = assess_identifiability(problem, solution)
    for name, profile in before.profiles.items():
        np.testing.assert_array_equal(again.profiles[name].values, profile.values)
        np.testing.assert_array_equal(again.profiles[name].rises, profile.rises)


@pytest.mark.slow
def test_every_parameter_has_a_profile_over_its_whole_range():
    problem, _, report = bumps()
    for free in problem.space.parameters:
        curve = report.profiles[free.name]
        places = to_fractions(free, curve.values)
        assert places[0] < 0.01 and places[-1] > 0.99
        assert 0 < np.diff(places).min() and np.diff(places).max() < 0.06
        assert curve.rises.min() == 0


@pytest.mark.slow
def test_a_clamp_is_two_sided_if_it_is_reached_and_one_sided_if_it_is_never():
    report = bumps()[2]
    limit = report.profiles["limit"]
    assert limit.verdict == "at least"
    assert limit.interval[0] == pytest.approx(1.0, abs=0.1)
    assert limit.interval[1] > 1.6  # the prior's doing
    assert "limit" in report.undetermined
    reached = bumps(limit=0.6)[2]
    assert reached.profiles["limit"].verdict == "two-sided"
    assert "limit" in reached.determined
    assert reached.interval[-1] == pytest.approx([0.6, 0.6], abs=0.03)


def test_two_minima_are_listed_with_their_intervals_and_heights():
    report = bumps()[2]
    square = report.profiles["square"]
    assert square.verdict == "several valleys"
    left, right = square.minima
    assert left.value == pytest.approx(-0.6, abs=0.03)
    assert right.value == pytest.approx(0.6, abs=0.03)
    assert right.rise == 0 < left.rise < RISE_OF_SMOOTH
    for minimum in square.minima:
        assert minimum.interval[0] < minimum.value < minimum.interval[1] < minimum.interval[0] + 0.1
    assert "square" in report.undetermined


def test_an_exact_ridge_leaves_two_thresholds_undetermined_and_one_without_effect_is_flat():
    problem, _, report = bumps()
    lonely = report.profiles["lonely"]
    assert lonely.verdict == "flat" and lonely.data_rises == pytest.approx(0, abs=0.2)
    assert report.contraction[2] == pytest.approx(0, abs=0.1)
    for name in ("first", "second"):
        curve = report.profiles[name]
        assert name in report.undetermined
        low = curve.data_rises < RISE_OF_THRESHOLD
        along = curve.path[low]
        assert np.ptp(curve.values[low]) > 0.7
        assert along[:, 0] + along[:, 1] == pytest.approx(1.1, abs=0.05)
    (ridge,) = report.ridges
    assert ridge.names == ("first", "second")
    assert ridge.coefficients == pytest.approx((1, 1), rel=0.1)
    assert ridge.describe({p.name: p for p in problem.space.parameters}) == "`first` + `second`"


# Cliffs


class LettingGo(eqx.Module):
    """What a foot remembers fades; at a threshold, at a whole frame, it lets go."""

    half_life: jax.Array = parameter(0.4, "s", 0.1, 1.0)
    release: jax.Array = parameter(0.3, "m", 0.0, 0.9, kind="threshold")

    def motion(self) -> jax.Array:
        remaining = 0.5 ** (TIME / self.half_life)
        return jnp.stack([0.3 * remaining, jnp.where(remaining > self.release, 1.0, 0.0)])


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 3])
def test_intervals_go_on_beyond_cliffs_along_which_parameters_move_together(seed):
    truth = {"half_life": 0.4, "release": 0.2 + 0.1 * seed}
    problem, _, report = assessed(LettingGo, truth, seed)
    fading, holding = np.asarray(problem.data)
    half_lives, releases = np.linspace(0.35, 0.45, 201), np.linspace(0, 0.9, 1801)
    remaining = 0.5 ** (np.asarray(TIME) / half_lives[:, None])
    of_fading = np.sum((0.3 * remaining - fading) ** 2, axis=1)
    # Of `held` frames, by their number: those are the first ones.
    of_holding = np.concatenate([[0.0], np.cumsum((1 - holding) ** 2 - holding**2)])
    held = np.array(
        [len(TIME) - np.searchsorted(row[::-1], releases, "right") for row in remaining]
    )
    exact = 0.5 * (of_fading[:, None] + of_holding[held]) / NOISE**2
    low = exact - exact.min() < RISE_OF_SMOOTH
    alone = half_lives[low[:, np.argmin(exact.min(axis=0))]]
    ends = half_lives[low.any(axis=1)][[0, -1]]
    assert np.ptp(ends) > 1.5 * np.ptp(alone)  # along the cliff, the release has to follow
    assert report.profiles["half_life"].interval == pytest.approx(ends, abs=0.15 * np.ptp(ends))


def test_cliffs_on_either_side_of_a_minimum_are_crossed_alike(monkeypatch):
    """Of a curve that is the same from left to right and from right to left."""
    problem = problem_of_fractions(1, None, distances)
    tried: list[float] = []

    def lowest(_: Conditional, targets: Targets, starts: list[Points]) -> Points:
        tried.extend(targets.value)
        return points[np.zeros(len(starts), int)]

    monkeypatch.setattr(Conditional, "lowest", lowest)
    matrix = np.zeros((1, 1))
    conditional = Conditional(
        problem, np.zeros(1), Slopes.of(matrix), matrix, np.random.default_rng(0)
    )
    values = np.linspace(0.05, 0.95, 19)[:, None]  # 0.4 to 0.6 is low
    cost = np.where(np.abs(values[:, 0] - 0.5) < 0.11, 0.0, 500.0)
    points = Points(problem.space.pack_values(values), values, cost)
    curves = Curves(problem, points)
    assert not cross_cliffs(Profiling(conditional, points[9:10], curves, points[:0]))
    np.testing.assert_allclose(np.sort(tried), 1 - np.sort(tried)[::-1])
    assert max(value for value in tried if value < 0.5) == pytest.approx(0.35)


# Slopes of thresholds: of a gradual effect its derivative, of a sudden one none

HEIGHT = jnp.linspace(0.0, 0.3, 300)  # m


class Fade(eqx.Module):
    """A weight that fades between two heights, and a jump."""

    low: jax.Array = parameter(0.1, "m", 0.05, 0.15, kind="threshold")  # full weight below
    high: jax.Array = parameter(0.2, "m", 0.15, 0.25, kind="threshold")  # no weight above
    jump: jax.Array = parameter(0.15, "m", 0.0, 0.3, kind="threshold")
    gain: jax.Array = parameter(1.0, "1", 0.5, 1.5)

    def motion(self) -> jax.Array:
        weight = jnp.clip((self.high - HEIGHT) / (self.high - self.low), 0.0, 1.0)
        return jnp.stack([self.gain * weight, jnp.where(HEIGHT < self.jump, 1.0, 0.0)])


@functools.cache
def fade() -> Problem:
    clean = Fade().motion()
    data = clean + NOISE * np.random.default_rng(0).normal(size=clean.shape)
    return problem_of(Fade(), ("low", "high", "jump", "gain"), data, residuals)


def test_a_gradual_effect_has_its_derivative_and_a_sudden_one_none():
    start = fade().space.start
    slopes = slopes_of_thresholds(fade(), np.asarray(start))
    exact = np.asarray(jax.jacfwd(fade().residuals)(start))
    assert (slopes[:, 2:] == 0).all()
    for i in (0, 1):
        assert np.linalg.norm(slopes[:, i] - exact[:, i]) < 0.1 * np.linalg.norm(exact[:, i])


def test_thresholds_that_fade_a_weight_follow_each_other():
    """Along the ridge on which the middle of the fade stays, the cost rises much less."""
    solution = search.find_best_fit(fade(), starts=1)
    conditional = Conditional.around(fade(), solution)
    start = conditional.points(np.asarray(solution.u)[None])
    targets = Targets(np.asarray([0]), start.values[:, 0] - 0.004)
    alone = conditional.points(
        conditional.move(start, np.zeros((1, 4)), targets, np.zeros((1, 4), bool))
    )
    following = conditional.lowest(targets, [start])
    assert following.cost[0] - start.cost[0] < 0.6 * (alone.cost[0] - start.cost[0])
    assert following.values[0, 1] > start.values[0, 1] + 0.001


# A report of a system like foot IK

UNINFORMATIVE = 2  # seed of a clip in which the foot is always lifted before it is fast
TRUTH = np.asarray([toy.TRUTH.get(name, np.nan) for name in toy.NAMES])


@pytest.fixture(scope="module")
def report() -> Identifiability:
    return assess_identifiability(*toy.solved())


def test_a_parameter_without_effect_is_undetermined_and_others_have_the_truth_inside(report):
    assert report.undetermined == report.weakest == ("foot.idle",)
    idle = report.names.index("foot.idle")
    assert report.contraction[idle] == pytest.approx(0, abs=0.01)
    assert report.sd[idle] == pytest.approx(SPREAD)
    assert report.eigenvalues[0] == pytest.approx(0, abs=1e-6)
    assert report.improvement < 0.5 and set(report.at_bound) == {""}
    known, (low, high) = np.isfinite(TRUTH), report.interval.T
    assert (low <= high).all()
    assert ((low <= TRUTH) & (TRUTH <= high))[known].sum() >= known.sum() - 1, "nearly all"


def test_a_threshold_has_the_interval_of_its_profile_and_others_the_sd_of_least_squares(report):
    problem, solution = toy.solved()
    thresholds = np.asarray(problem.space.thresholds)
    np.testing.assert_array_equal(np.isnan(report.sd), thresholds)
    for i, name in enumerate(report.names):
        profile = report.profiles[name]
        low, high = profile.interval
        assert tuple(report.interval[i]) == (low, high)
        assert low <= solution.values[i] <= high
        if thresholds[i]:
            assert 0 < high - low < 0.2 * float(problem.space.high[i] - problem.space.low[i])
            outside = (profile.values < low) | (profile.values > high)
            assert (profile.rises[outside] > profile.max_rise).all()
    jacobian = solution.jacobian[:, ~thresholds]
    expected = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    np.testing.assert_allclose(report.sd[~thresholds], expected, rtol=1e-6)
    broken = dataclasses.replace(solution, jacobian=solution.jacobian * np.nan)
    with pytest.raises(ValueError, match="the Jacobian at the solution is not finite"):
        assess_identifiability(problem, broken)


# Contraction, correlation and bounds


def assess_quickly(problem: Problem) -> Identifiability:
    solution = search.find_best_fit(problem, SearchSettings(max_steps=24), starts=1)
    return assess_identifiability(problem, solution)


def distances(ik: Fractions, effects: jax.Array) -> jax.Array:
    return effects @ (ik.x - 0.4) / 0.02


def of_two_fractions(*effects: float) -> Problem:
    """A problem with one residual, on which two fractions have these effects."""
    return problem_of_fractions(2, jnp.asarray([effects]), distances)


@pytest.mark.parametrize("kind", ["smooth", "threshold"])
def test_a_parameter_without_effect_has_contraction_0_whatever_its_prior(kind):
    problem = of_two_fractions(0.0, 1.0)
    ik = problem.space.system
    space = make_space(ik, [free_parameter(ik, "x[0]", kind=kind), free_parameter(ik, "x[1]")])
    for prior in (
        ParameterPrior("uniform"),
        ParameterPrior(),
        ParameterPrior(centre=0.2, spread=0.3),
        ParameterPrior(centre=0.9, spread=3.0),
    ):
        own = space.with_prior(Priors(named={"x[0]": prior}))
        report = assess_quickly(dataclasses.replace(problem, space=own))
        assert report.contraction[0] == pytest.approx(0, abs=0.01), prior
        assert report.undetermined == ("x[0]",), prior
        assert report.contraction[1] > 0.9, prior
        # At 0.4 a fraction rises by 0.24 for each unit of `u`, whose prior has the usual spread.
        information = (0.24 / 0.02 * SPREAD) ** 2
        assert report.eigenvalues[-1] == pytest.approx(information, rel=0.01), prior


def test_parameters_with_the_same_effect_are_named_as_a_pair(report):
    ((first, second, correlation),) = assess_quickly(of_two_fractions(1.0, 1.0)).correlated
    assert {first, second} == {"x[0]", "x[1]"} and -1 < correlation < -0.98
    assert report.correlated == assess_quickly(of_two_fractions(0.0, 1.0)).correlated == ()


def test_values_at_bounds_and_a_threshold_that_the_clip_never_reaches_are_flagged():
    """The search takes a few steps since it starts at the truth."""
    truth = toy.TRUTH | {"body.rise": 0.0, "foot.limit[1]": 0.1}
    problem = toy.make_problem(UNINFORMATIVE, truth=truth)
    start = np.clip(np.asarray(problem.space.pack(truth)), -5, 5)
    solution = search.find_best_fit(problem, SearchSettings(max_steps=24), starts=1, first=start)
    flagged = assess_identifiability(problem, solution)
    named = {name: flag for name, flag in zip(toy.NAMES, flagged.at_bound, strict=True) if flag}
    assert named == {"body.rise": "low", "foot.limit[1]": "low"}
    low, high = flagged.profiles["lock.speed_off"].interval
    assert high - low > 0.5 * 2.3
    assert low <= truth["lock.speed_off"] <= high
    assert "lock.speed_off" in flagged.undetermined


def test_a_fit_off_its_minimum_gets_a_lower_point_from_its_profiles():
    problem = curve_problem(("height", "rate", "turn"))
    solution = search.find_best_fit(problem, starts=1)
    values = dict(zip(solution.names, solution.values, strict=True)) | {"turn": 0.6}
    u = np.asarray(problem.space.pack(values))
    cost = float(evolution.evaluate(problem, u[None]).cost[0])
    moved = dataclasses.replace(
        solution, u=u, values=np.asarray(problem.space.values(jnp.asarray(u))), cost=cost
    )
    lower = assess_identifiability(problem, moved)
    assert lower.improvement > 0.9 * (cost - solution.cost) > 100
    assert lower.best_cost == pytest.approx(cost - lower.improvement)
    again = evolution.evaluate(problem, lower.best_u[None]).cost[0]
    assert again == pytest.approx(lower.best_cost)
