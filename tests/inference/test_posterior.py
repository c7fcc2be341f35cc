"""The sampler: known posteriors, killed runs, chains that must not be trusted, other priors."""

import shutil
from typing import Any, NamedTuple, cast

import emcee
import equinox as eqx
import h5py
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from scipy import special, stats

from fitting.inference.sample import diagnostics, posterior, prior_sensitivity, sampler
from fitting.inference.sample.blocks import SamplerSettings
from fitting.inference.sample.chain import Chain, Identity, RandomState, journal_path
from fitting.inference.sample.posterior import Posterior, WalkerStart
from fitting.problem.problem import Problem
from fitting.problem.simulation import autoregression
from fitting.problem.space import SPREAD, Prior
from support.problems import parameter, posterior_of, problem_of, problem_of_fractions
from support.watching import listening

TRACES = []  # one entry for each time that JAX traces the residuals
STATE = cast(RandomState, np.random.RandomState(0).get_state())


class Step(eqx.Module):
    """A height that applies from a moment on."""

    height: Array = parameter(0.5, "m", 0.0, 1.0)
    moment: Array = parameter(0.5, "s", 0.0, 1.0, kind="threshold")


def linear_in_u(ik, data):
    """Residuals `factor @ (u - centre)`, so that the posterior in `u` is a normal."""
    TRACES.append(ik)
    factor, centre = data
    return factor @ (jnp.log(ik.x) - jnp.log1p(-ik.x) - centre)


def step_residuals(ik, data):
    time, observed = data
    return (jnp.where(time > ik.moment, ik.height, 0.0) - observed) / 0.3


def nan_above(ik, data):
    """NaN in the upper half of the range."""
    return jnp.where(ik.x < data, ik.x, jnp.nan)


class Normal(NamedTuple):
    """A problem with a correlated normal posterior."""

    problem: Problem
    mean: np.ndarray
    covariance: np.ndarray

    @property
    def sd(self) -> np.ndarray:
        return np.sqrt(np.diag(self.covariance))

    def sample(self, **options: Any) -> Posterior:
        """From around the mean."""
        return sample(self.problem, self.mean, self.sd, **options)


def normal(size: int, seed: int = 0) -> Normal:
    random = np.random.default_rng(seed)
    factor = random.normal(size=(size, size)) / np.sqrt(size) + np.diag(random.uniform(1, 3, size))
    centre = random.normal(size=size)
    covariance = np.linalg.inv(factor.T @ factor + np.eye(size) / SPREAD**2)
    mean = covariance @ factor.T @ factor @ centre
    data = jnp.asarray(factor), jnp.asarray(centre)
    return Normal(problem_of_fractions(size, data, linear_in_u), mean, covariance)


def sample(problem, start_u, start_sd, *, seed=0, path=None, **settings) -> Posterior:
    """The posterior with these settings of the sampler."""
    start = WalkerStart(np.asarray(start_u), np.asarray(start_sd))
    return posterior.sample_posterior(
        problem, start, SamplerSettings(**settings), seed=seed, path=path
    )


# Known posteriors


def test_a_known_normal_is_sampled_with_its_moments_and_intervals():
    known = normal(10)
    sampled = known.sample()
    assert sampled.converged, sampled.message
    centred = (sampled.u[sampled.burn_in :] - known.mean) @ np.linalg.inv(
        np.linalg.cholesky(known.covariance)
    ).T
    count = centred.shape[0] * centred.shape[1]
    # Standard error of each mean, and of each variance from the times of the squares.
    error_mean = np.sqrt(diagnostics.autocorrelation_time(centred) / count)
    error_variance = np.sqrt(2 * diagnostics.autocorrelation_time(centred**2) / count)
    assert np.all(np.abs(centred.mean(axis=(0, 1))) < 4 * error_mean)
    variances = (centred**2).mean(axis=(0, 1))
    assert np.all(np.abs(variances - 1) < 4 * error_variance)
    # The snooker move of emcee 3.1.6 gives 0.88.
    assert abs(variances.mean() - 1) < 0.03
    assert error_variance.max() < 0.05  # long enough to distinguish them
    levels = {"low95": 0.025, "low68": 0.16, "median": 0.5, "high68": 0.84, "high95": 0.975}
    for row, mean, sd in zip(sampled.summary, known.mean, known.sd, strict=True):
        for name, level in levels.items():
            below = stats.norm(mean, sd).cdf(special.logit(row[name]))
            error = np.sqrt(level * (1 - level) / row["ess"])
            assert abs(below - level) < 4 * error < 0.06, (row["name"], name)


@pytest.mark.slow
def test_the_posterior_of_a_threshold_agrees_with_integration_on_a_grid():
    random = np.random.default_rng(3)
    moments = jnp.linspace(0.02, 0.98, 25)
    observed = jnp.where(moments > 0.43, 0.7, 0.0) + 0.3 * random.normal(size=25)
    problem = problem_of(Step(), ("height", "moment"), (moments, observed), step_residuals)
    start = problem.space.pack({"height": 0.7, "moment": 0.43})
    sampled = sample(problem, start, np.array([0.3, 0.05]), walkers=32, stop_at=75.0)
    assert sampled.converged, sampled.message

    axes = jnp.linspace(-7, 7, 141), jnp.linspace(-7, 7, 1401)  # cliffs need the finer one
    grid = jnp.stack(jnp.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    weight = np.exp(np.asarray(sampler.log_probabilities(problem, grid)))
    values = np.asarray(problem.space.values(grid))
    mean = np.average(values, axis=0, weights=weight)
    sd = np.sqrt(np.average((values - mean) ** 2, axis=0, weights=weight))
    for i, row in enumerate(sampled.summary):
        assert abs(row["mean"] - mean[i]) < 4 * sd[i] / np.sqrt(row["ess"])
        assert row["sd"] == pytest.approx(sd[i], rel=0.1)


def test_a_step_into_nan_is_never_taken_and_a_start_there_is_refused():
    problem = problem_of_fractions(2, jnp.asarray(0.55), nan_above)
    sampled = sample(problem, np.zeros(2), np.ones(2), max_steps=300)
    assert np.isfinite(sampled.log_probability).all()
    assert 0.5 < sampled.values.max() < 0.55
    with pytest.raises(ValueError, match="only 0 of 8 walkers have a finite log-probability"):
        sample(problem, np.full(2, 3.0), np.full(2, 0.01))


# What a run does


@pytest.mark.slow
def test_a_run_stops_at_fifty_steady_autocorrelation_times_and_a_longer_one_continues_it(tmp_path):
    known, path = normal(2), tmp_path / "a.h5"
    sampled = known.sample(path=path)
    steps = len(sampled.u)
    slowest = sampled.autocorrelation_time.max()
    assert sampled.converged and sampled.message.startswith("Converged: ")
    assert 50 * slowest <= steps < 20_000
    assert sampled.burn_in >= 5 * slowest
    assert sampled.u.shape == sampled.values.shape == (steps, 8, 2)
    last = known.problem.space.values(jnp.asarray(sampled.u[-1, 0]))
    assert np.allclose(sampled.values[-1, 0], last)
    assert 0.1 < sampled.acceptance.min() and sampled.stuck == []
    assert [row["name"] for row in sampled.summary] == ["x[0]", "x[1]"]
    assert all(row["r_hat"] < 1.05 and row["ess"] > 8 * 0.8 * 50 for row in sampled.summary)
    before = path.read_bytes()
    again = known.sample(path=path)
    assert np.array_equal(sampled.u, again.u) and again.message == sampled.message
    assert path.read_bytes() == before
    longer = known.sample(path=path, stop_at=300.0)
    assert longer.converged and len(longer.u) > steps
    assert np.array_equal(longer.u[:steps], sampled.u)
    backend: Any = emcee.backends.HDFBackend(str(path), read_only=True)
    assert np.array_equal(backend.get_chain(), longer.u)
    assert np.array_equal(backend.get_log_prob(), longer.log_probability)
    assert np.array_equal(backend.accepted / len(longer.u), longer.acceptance)


def test_what_a_chain_gains_over_its_start_is_known():
    problem, mean, _ = known = normal(3)
    lowest = float(problem.cost(jnp.asarray(mean)))
    for start, gain in ((mean, 0.0), (mean + 3 * known.sd, None)):
        sampled = sample(problem, start, known.sd, max_steps=300)
        expected = float(problem.cost(jnp.asarray(start))) - lowest if gain is None else gain
        assert sampled.start_minus_cost == pytest.approx(-expected - lowest)
        assert expected - 1.0 < sampled.improvement <= expected
        values = problem.space.values(jnp.asarray(problem.space.pack(sampled.best_values)))
        assert list(sampled.best_values.values()) == pytest.approx(values.tolist())


def test_thinning_stores_one_step_in_so_many_and_a_short_run_says_that_it_is():
    every, third = (normal(2).sample(max_steps=60, thin_by=thin_by) for thin_by in (1, 3))
    assert np.array_equal(third.u, every.u[2::3])
    assert not third.converged and "too short: 60 steps" in third.message


def test_a_run_that_has_converged_goes_on_to_the_least_steps_it_is_asked_for():
    soon, later = (normal(2).sample(thin_by=2, min_steps=least) for least in (0, 1500))
    assert soon.converged and 2 * len(soon.u) < 1500 <= 2 * len(later.u) < 2200


def test_progress_is_reported_and_nothing_compiles_between_checks():
    reports = []
    TRACES.clear()
    with listening(reported=reports.append):
        normal(7).sample(max_steps=200, check_every=20)
    assert len(TRACES) == 1  # half of the walkers at a time, at the start too
    normal(7, seed=1).sample(seed=1, max_steps=40)
    assert len(TRACES) == 1
    first, last = reports[0], reports[-1]
    assert [report.step for report in reports] == list(range(20, 201, 20))
    assert first.max_steps == 200 and 0 < first.elapsed < last.elapsed
    assert 0 < last.acceptance < 1 and last.autocorrelation_time > 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"start_u": np.zeros(2)}, "start.u is .* wanted 3 finite numbers"),
        ({"start_u": np.array([0, np.nan, 0])}, "start.u is .* wanted 3 finite numbers"),
        ({"start_sd": np.array([1.0, 0.0, 1.0])}, "start.sd is .* wanted more than 0"),
        ({"walkers": 7}, "walkers is 7, wanted an even number from 6 on"),
        ({"walkers": 4}, "walkers is 4, wanted an even number from 6 on"),
        ({"max_steps": 5, "thin_by": 10}, "max_steps is 5, wanted at least thin_by"),
    ],
)
def test_impossible_arguments_are_refused_with_what_is_wanted(changes, message):
    arguments = {"start_u": np.zeros(3), "start_sd": np.ones(3)} | changes
    with pytest.raises(ValueError, match=message):
        sample(normal(3).problem, **arguments)


# Interrupted and killed


def test_an_interrupt_returns_the_chain_and_the_run_can_go_on(tmp_path, monkeypatch, capfd):
    def interrupt(report):
        if report.step == 35:
            raise KeyboardInterrupt

    whole, other = (normal(3).sample(max_steps=90, seed=seed) for seed in (0, 1))
    assert not np.array_equal(other.u[0], whole.u[0])
    path = tmp_path / "chain.h5"
    with listening(reported=interrupt):
        part = normal(3).sample(max_steps=90, path=path, check_every=5)
    assert part.message.startswith("Interrupted, the chain is saved.") and not part.converged
    assert np.array_equal(part.u, whole.u[:35])
    rest = normal(3).sample(max_steps=90, path=path)
    assert np.array_equal(rest.u, whole.u)
    assert np.array_equal(rest.acceptance, whole.acceptance)
    assert [file.name for file in tmp_path.iterdir()] == ["chain.h5"]

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(sampler, "log_probabilities", interrupted)
    with pytest.raises(KeyboardInterrupt):
        normal(2).sample()  # not begun
    assert capfd.readouterr().out == ""


def test_a_kill_loses_no_finished_step_wherever_it_tears_the_journal(tmp_path):
    """Neither before the first jumps, nor between two lessons of them."""
    known = normal(3)
    run = {"max_steps": 240, "thin_by": 2, "check_every": 2, "stop_at": 1e9}
    random = np.random.default_rng(0)
    copies = []  # what a kill at that moment leaves, with some bytes of the last record missing

    def snapshot(report):
        stored = report.step // 2
        if stored % 17:
            return
        for file in (path, journal_path(path)):
            shutil.copy(file, tmp_path / f"{stored}-{file.name}")
        copy = tmp_path / f"{stored}-{path.name}"
        journal = journal_path(copy)
        content = journal.read_bytes()
        torn = int(random.integers(0, 2)) * int(random.integers(1, 400))
        journal.write_bytes(content[: max(0, len(content) - torn)])
        copies.append((copy, stored - bool(torn)))

    path = tmp_path / "chain.h5"
    with listening(reported=snapshot):
        whole = known.sample(**run, path=path)
    assert len(copies) == 7
    for copy, finished in copies:
        with Chain(identity_of(known.problem, walkers=12, thin_by=2), copy) as chain:
            assert len(chain) >= finished
        resumed = known.sample(**run, path=copy)
        assert np.array_equal(resumed.u, whole.u)
        assert np.array_equal(resumed.log_probability, whole.log_probability)
        assert np.array_equal(resumed.acceptance, whole.acceptance)


# Files of other runs and programs


def identity_of(problem: Problem, /, **other: Any) -> Identity:
    """Of a run of two parameters, unless it is said otherwise."""
    own: dict[str, Any] = {"parameters": problem.space.names, "walkers": 8, "seed": 0, "thin_by": 1}
    own["problem"] = posterior.digest(problem)
    return Identity(**own | other)


def test_a_file_that_is_no_chain_of_this_run_is_refused_and_stays_as_it_is(tmp_path):
    problem = normal(2).problem
    others: dict[str, Any] = {"walkers": 10, "seed": 1, "thin_by": 2, "problem": "0" * 64}
    others["parameters"] = ("x[1]", "x[0]")
    messages = {"format": "its format is 99"}
    messages |= {field: f"chain of another run: its {field} is" for field in others}
    for name in messages:
        changes = {name: others[name]} if name in others else {}
        with Chain(identity_of(problem, **changes), tmp_path / f"{name}.h5"):
            pass
    with h5py.File(tmp_path / "format.h5", "a") as file:
        file["mcmc"].attrs["format"] = 99
    (tmp_path / "text.h5").write_text("no chain")
    h5py.File(tmp_path / "empty.h5", "w").close()
    emcee.backends.HDFBackend(str(tmp_path / "of emcee.h5")).reset(8, 2)
    for name in ("text", "empty", "of emcee"):
        messages[name] = f"{name}.h5 is not a chain of this sampler"
    for name, message in messages.items():
        path = tmp_path / f"{name}.h5"
        before = path.read_bytes()
        with pytest.raises(ValueError, match=message):
            normal(2).sample(path=path)
        assert path.read_bytes() == before


def test_the_journal_of_a_deleted_or_replaced_chain_is_ignored(tmp_path):
    path = tmp_path / "chain.h5"
    known = normal(2)
    with Chain(identity_of(known.problem, seed=5), path) as other:
        other.append(np.zeros((8, 2)), np.zeros(8), np.ones(8, bool), STATE)
        stale = journal_path(path).read_bytes()
    assert len(stale) > 0
    path.unlink()
    whole = known.sample(max_steps=20)
    for steps in (10, 20):
        journal_path(path).write_bytes(stale)
        sampled = known.sample(path=path, max_steps=steps)
    assert np.array_equal(sampled.u, whole.u)


def test_steps_in_both_files_count_once_and_steps_after_a_gap_do_not_count(tmp_path):
    path = tmp_path / "chain.h5"
    identity = Identity(("a",), 4, 0, 1, "0" * 64)
    with Chain(identity, path) as chain:
        empty = path.read_bytes()
        journals = []
        for start in (0, 3):
            for step in range(start, start + 3):
                chain.append(np.full((4, 1), float(step)), np.zeros(4), np.ones(4, bool), STATE)
            journals.append(journal_path(path).read_bytes())
            chain.save()
    journal_path(path).write_bytes(journals[1])  # killed before the journal was emptied
    with Chain(identity, path) as chain:
        assert chain.u[:, 0, 0].tolist() == [0, 1, 2, 3, 4, 5]
        assert chain.accepted.tolist() == [6] * 4
    path.write_bytes(empty)
    journal_path(path).write_bytes(journals[1])  # the steps before these are missing
    with Chain(identity, path) as chain:
        assert len(chain) == 0


def test_the_digest_changes_with_the_data_the_prior_the_loss_and_the_residuals():
    problem = normal(2).problem
    others = [
        normal(2, seed=1).problem,
        eqx.tree_at(lambda p: p.space.prior.centre, problem, problem.space.start + 1e-12),
        Problem(problem.space, problem.data, linear_in_u, "cauchy"),
        Problem(problem.space, problem.data, nan_above),
    ]
    elsewhere = eqx.tree_at(lambda p: p.space.start, problem, problem.space.start + 1.0)
    assert posterior.digest(problem) == posterior.digest(normal(2).problem)
    assert posterior.digest(problem) == posterior.digest(elsewhere)
    assert len({posterior.digest(each) for each in [problem, *others]}) == 5


# Chains that must not be trusted


def autocorrelated(correlation, shape):
    """Normal series of unit variance with this correlation from step to step."""
    return autoregression(np.random.default_rng(0).normal(size=shape), correlation)


def verdict(before, latest):
    return diagnostics.verdict(before, latest, ("a", "b"), 1, 50.0)


def test_a_chain_with_isolated_walkers_or_one_that_never_moves_or_unsteady_has_not_converged():
    chain = autocorrelated(0.5, (1000, 20, 2))
    log_probability = np.random.default_rng(0).normal(size=(1000, 20))
    latest = diagnostics.check(chain, log_probability)
    for growth, message in ((1.06, "still changes"), (1.04, "Converged: ")):
        before = diagnostics.Check(900, latest.times * growth, latest.isolated)
        assert message in verdict(before, latest)[1]
    assert "still changes" in verdict(None, latest)[1]
    assert verdict(latest, latest)[0]
    log_probability[:, :3] -= 50
    check = diagnostics.check(chain, log_probability)
    assert check.isolated.nonzero()[0].tolist() == [0, 1, 2]
    converged, message = verdict(check, check)
    assert not converged and "too many walkers are isolated" in message
    chain[..., 1] = 2.0
    check = diagnostics.check(chain, np.zeros((1000, 20)))
    assert np.isinf(check.slowest) and check.burn_in == 500
    assert not verdict(check, check)[0]
    lazy = diagnostics.lazy_walkers(np.array([0.3, 0.25, 0.01, 0.28]))
    assert lazy.tolist() == [False, False, True, False]


def test_the_autocorrelation_time_is_that_of_a_known_series_and_longer_for_a_frozen_walker():
    time = diagnostics.autocorrelation_time
    assert time(autocorrelated(0.9, (20_000, 10, 1)))[0] == pytest.approx(19, rel=0.1)
    assert time(autocorrelated(0, (2000, 10, 1)))[0] < 1.2
    chain = autocorrelated(0.5, (4000, 20, 1))
    healthy = time(chain)[0]
    chain[:, 0] = 3.0
    assert 50 * healthy < len(chain) < 50 * time(chain)[0]


def test_split_r_hat_detects_walkers_that_disagree_and_walkers_that_drift():
    chain = np.random.default_rng(0).normal(size=(1000, 10, 3))
    chain[:, :5, 1] += 2
    chain[..., 2] += np.linspace(0, 3, 1000)[:, None]
    r_hat = diagnostics.split_r_hat(chain)
    assert r_hat[0] < 1.01 and r_hat[1] > 1.2 and r_hat[2] > 1.2
    assert np.isnan(diagnostics.split_r_hat(chain[:3])).all()
    assert np.isinf(diagnostics.split_r_hat(np.zeros((8, 2, 1)))).all()


def test_a_resumed_run_checks_where_an_uninterrupted_one_does():
    uninterrupted = diagnostics.check_lengths(0, 50, 1000)
    assert uninterrupted[-1] == 1000 and min(np.diff(uninterrupted)) >= 50
    for stored in (0, 1, 99, 100, 640, 999, 1000):
        resumed = diagnostics.check_lengths(stored, 50, 1000)
        assert resumed == uninterrupted[-len(resumed) :], stored
        behind = [
            sum(length <= stored for length in lengths) for lengths in (resumed, uninterrupted)
        ]
        assert behind[0] == min(2, behind[1]), stored


# Other priors, by weighting draws, against the answers in closed form

DRAWS = (4000, 10)


def sensitivity(u: np.ndarray, prior: Prior) -> list[list[dict[str, Any]]]:
    """Of each parameter, for independent draws, (steps, walkers, free), whose values are `u`."""
    names = tuple(f"p{i}" for i in range(u.shape[-1]))
    rows = prior_sensitivity.prior_sensitivity(posterior_of(names, u, u), prior)
    return [cast(Any, rows[name]) for name in names]


def product(centre: float, spread: float, observed: float, error: float) -> Any:
    """The posterior of a normal prior and a normal likelihood."""
    precision = 1 / spread**2 + 1 / error**2
    mean = (centre / spread**2 + observed / error**2) / precision
    return stats.norm(mean, precision**-0.5)


def test_weighted_draws_have_the_posterior_of_another_prior_unless_a_few_would_decide():
    centre, spread, observed, error = 0.5, 1.6, 1.8, 1.0
    random = np.random.default_rng(0)
    u = product(centre, spread, observed, error).rvs((*DRAWS, 1), random_state=random)
    prior = Prior(jnp.asarray([centre]), jnp.asarray([spread]), jnp.asarray([False]))
    (rows,) = sensitivity(u, prior)
    assert [row["factor"] for row in rows] == [0.5, 2.0]
    for row in rows:
        exact = product(centre, row["factor"] * spread, observed, error)
        assert row["median"] == pytest.approx(exact.median(), abs=0.03)
        np.testing.assert_allclose(row["interval"], exact.ppf([0.025, 0.975]), atol=0.08)
        assert row["pareto_k"] < prior_sensitivity.MAX_K
    assert [row["sensitive"] for row in rows] == [True, False]
    ((half, twice),) = sensitivity(random.normal(13.3, 1.6, (*DRAWS, 1)), prior)
    assert half["pareto_k"] > prior_sensitivity.MAX_K
    assert half["median"] is half["interval"] is half["sensitive"] is None
    assert twice["factor"] == 2.0


def test_a_parameter_that_the_clips_determine_is_not_sensitive_and_one_without_effect_is():
    random = np.random.default_rng(1)
    u = np.stack([random.normal(0.3, 0.1, DRAWS), random.logistic(size=DRAWS)], axis=-1)
    prior = Prior(jnp.zeros(2), jnp.asarray([1.6, 1.0]), jnp.asarray([False, True]))
    determined, idle = sensitivity(u, prior)
    assert [row["sensitive"] for row in determined] == [False, False]
    for row in idle:  # the posterior is the prior, a logistic of the scale that it is given
        expected = stats.logistic(scale=row["factor"]).ppf([0.025, 0.975])
        np.testing.assert_allclose(row["interval"], expected, rtol=0.1)
        assert row["sensitive"]


def test_the_pareto_shape_of_weights_is_found_except_of_a_handful():
    for shape in (-0.5, 0.3, 0.9):
        weights = stats.genpareto(shape).rvs(40_000, random_state=3)
        k = prior_sensitivity.pareto_k(weights, 40_000.0)
        assert k == pytest.approx(shape, abs=0.15), shape
    assert prior_sensitivity.pareto_k(np.ones(1000), 1000.0) == -np.inf
    assert prior_sensitivity.pareto_k(np.arange(10.0), 10.0) == np.inf
