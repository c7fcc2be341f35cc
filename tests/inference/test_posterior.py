"""The sampler: known posteriors, killed runs, and chains that must not be trusted."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, cast

import emcee
import equinox as eqx
import h5py
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from scipy import stats

from fitting.inference.sampling import diagnostics, posterior, sampler
from fitting.inference.sampling.chain import Chain, journal_path
from fitting.inference.sampling.chain_file import Identity, RandomState
from fitting.inference.sampling.posterior import Posterior, WalkerStart
from fitting.inference.sampling.settings import SamplerSettings
from fitting.problem.free_parameters import free_parameter
from fitting.problem.prior import SPREAD, ParameterPrior, Priors
from fitting.problem.problem import Problem
from fitting.problem.space import make_space
from jaxik.maths import parameter_tree

ROOT = Path(__file__).resolve().parents[2]
TRACES = []  # one entry for each time that JAX traces the residuals


class Toy(eqx.Module):
    """Any number of parameters, each between 0 and 1."""

    x: Float[Array, " legs"] = parameter_tree.parameter(
        (0.5,), unit="", low=0.0, high=1.0, doc="X of the test rule."
    )


class Step(eqx.Module):
    """A height that applies from a moment on."""

    height: Array = parameter_tree.parameter(
        0.5, unit="m", low=0.0, high=1.0, doc="Height of the test rule."
    )
    moment: Array = parameter_tree.parameter(
        0.5, unit="s", low=0.0, high=1.0, kind="threshold", doc="Moment of the test rule."
    )


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


def toy(size, residuals, data):
    ik = Toy(x=jnp.full(size, 0.5))
    return Problem(
        make_space(ik, [free_parameter(ik, f"x[{i}]") for i in range(size)]), data, residuals
    )


def normal(size, seed=0):
    """A problem with a correlated normal posterior, and its mean and covariance."""
    random = np.random.default_rng(seed)
    factor = random.normal(size=(size, size)) / np.sqrt(size) + np.diag(random.uniform(1, 3, size))
    centre = random.normal(size=size)
    covariance = np.linalg.inv(factor.T @ factor + np.eye(size) / SPREAD**2)
    mean = covariance @ factor.T @ factor @ centre
    return toy(size, linear_in_u, (jnp.asarray(factor), jnp.asarray(centre))), mean, covariance


def autocorrelated(correlation, shape, seed=0):
    """Normal series of unit variance with this correlation from step to step."""
    noise = np.random.default_rng(seed).normal(size=shape)
    series = noise.copy()
    for i in range(1, len(series)):
        series[i] = correlation * series[i - 1] + np.sqrt(1 - correlation**2) * noise[i]
    return series


def sample(
    problem, start_u, start_sd, *, seed=0, path=None, progress=None, **settings
) -> Posterior:
    """The posterior with these settings of the sampler."""
    start = WalkerStart(np.asarray(start_u), np.asarray(start_sd))
    return posterior.sample_posterior(
        problem, start, SamplerSettings(**settings), seed=seed, path=path, progress=progress
    )


# Known posteriors


@pytest.mark.slow
@pytest.mark.parametrize(("size", "stop_at"), [(10, 50.0), (20, 25.0)])
def test_a_known_normal_is_sampled_with_its_variances(size, stop_at):
    problem, mean, covariance = normal(size)
    sampled = sample(problem, mean, np.sqrt(np.diag(covariance)), stop_at=stop_at)
    assert sampled.converged, sampled.message
    centred = (sampled.u[sampled.burn_in :] - mean) @ np.linalg.inv(
        np.linalg.cholesky(covariance)
    ).T
    count = centred.shape[0] * centred.shape[1]
    # Standard error of each mean, and of each variance from the times of the squares.
    error_mean = np.sqrt(diagnostics.autocorrelation_time(centred) / count)
    error_variance = np.sqrt(2 * diagnostics.autocorrelation_time(centred**2) / count)
    assert np.all(np.abs(centred.mean(axis=(0, 1))) < 4 * error_mean)
    variances = (centred**2).mean(axis=(0, 1))
    assert np.all(np.abs(variances - 1) < 4 * error_variance)
    # The snooker move of emcee 3.1.6 gives 0.88 in 10 dimensions, 0.81 in 20.
    assert abs(variances.mean() - 1) < 0.03
    assert error_variance.max() < 0.05  # long enough to distinguish them


def test_the_moves_are_differential_evolution_and_jumps():
    with Chain(Identity(("a",), 4, 0, 1, "0" * 64)) as chain:
        moves = [(type(move).__name__, fraction) for move, fraction in sampler.moves(chain)]
    assert moves == [("DEMove", 1 - sampler.JUMPS), ("JumpMove", sampler.JUMPS)]


@pytest.mark.slow
def test_intervals_have_their_nominal_coverage():
    size, runs = 3, 20
    problem, _, covariance = normal(size)
    factor = problem.data[0]
    random = np.random.default_rng(1)
    inside = {68: 0, 95: 0}
    for seed in range(runs):
        truth = SPREAD * random.normal(size=size)
        observed = truth + np.linalg.solve(factor, random.normal(size=size))
        replica = eqx.tree_at(lambda p: p.data[1], problem, jnp.asarray(observed))
        mean = covariance @ factor.T @ factor @ observed
        sd = np.sqrt(np.diag(covariance))
        sampled = sample(replica, mean, sd, seed=seed, max_steps=350, stop_at=1e9)
        values = np.asarray(replica.space.values(jnp.asarray(truth)))
        exact = np.asarray(replica.space.values(jnp.asarray(mean)))
        for row, value, median in zip(sampled.summary, values, exact, strict=True):
            assert abs(row["median"] - median) < 5 * row["sd"] / np.sqrt(row["ess"])
            for level in inside:
                inside[level] += row[f"low{level}"] < value < row[f"high{level}"]
    trials = size * runs
    for level, count in inside.items():
        nominal = level / 100
        assert abs(count / trials - nominal) < 3 * np.sqrt(nominal * (1 - nominal) / trials)


def test_the_posterior_of_a_threshold_agrees_with_integration_on_a_grid():
    ik = Step()
    random = np.random.default_rng(3)
    moments = jnp.linspace(0.02, 0.98, 25)
    observed = jnp.where(moments > 0.43, 0.7, 0.0) + 0.3 * random.normal(size=25)
    space = make_space(ik, [free_parameter(ik, "height"), free_parameter(ik, "moment")])
    problem = Problem(space, (moments, observed), step_residuals)
    start = space.pack({"height": 0.7, "moment": 0.43})
    sampled = sample(problem, start, np.array([0.3, 0.05]), walkers=32, stop_at=150.0)
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


def no_residuals(ik, data):
    return jnp.zeros(1, ik.x.dtype) * data


def test_without_data_a_uniform_prior_gives_uniform_values():
    problem = toy(2, no_residuals, jnp.asarray(0.0))
    space = problem.space.with_prior(Priors(ParameterPrior("uniform")))
    problem = eqx.tree_at(lambda p: p.space, problem, space)
    sampled = sample(problem, np.zeros(2), np.full(2, 1.5), walkers=64, max_steps=4000, stop_at=1e9)
    spacing = 2 * int(np.ceil(sampled.autocorrelation_time.max()))  # nearly independent
    for i in range(2):
        values = sampled.kept[::spacing, :, i].ravel()
        assert values.size > 2000
        assert stats.kstest(values, stats.uniform(0, 1).cdf).pvalue > 0.01


def test_a_step_into_nan_is_never_taken():
    problem = toy(2, nan_above, jnp.asarray(0.55))
    sampled = sample(problem, np.zeros(2), np.ones(2), max_steps=300)
    assert np.isfinite(sampled.log_probability).all()
    assert 0.5 < sampled.values.max() < 0.55


def test_a_start_without_a_finite_log_probability_is_refused():
    problem = toy(2, nan_above, jnp.asarray(0.5))
    with pytest.raises(ValueError, match="only 0 of 8 walkers have a finite log-probability"):
        sample(problem, np.full(2, 3.0), np.full(2, 0.01))


# What a run does


def test_the_same_seed_gives_the_same_chain():
    problem, mean, covariance = normal(3)
    sd = np.sqrt(np.diag(covariance))
    first, again, other = (sample(problem, mean, sd, seed=seed, max_steps=50) for seed in (1, 1, 2))
    assert np.array_equal(first.u, again.u)
    assert not np.array_equal(first.u[0], other.u[0])


def test_a_run_stops_at_fifty_steady_autocorrelation_times():
    problem, mean, covariance = normal(2)
    sampled = sample(problem, mean, np.sqrt(np.diag(covariance)))
    steps = len(sampled.u)
    slowest = sampled.autocorrelation_time.max()
    assert sampled.converged and sampled.message.startswith("Converged: ")
    assert 50 * slowest <= steps < 20_000
    assert sampled.burn_in >= 5 * slowest
    assert sampled.u.shape == sampled.values.shape == (steps, 8, 2)
    assert np.allclose(sampled.values[-1, 0], problem.space.values(jnp.asarray(sampled.u[-1, 0])))
    assert 0.1 < sampled.acceptance.min() and sampled.stuck == []
    assert [row["name"] for row in sampled.summary] == ["x[0]", "x[1]"]
    assert all(row["r_hat"] < 1.05 and row["ess"] > 8 * 0.8 * 50 for row in sampled.summary)


def test_what_a_chain_gains_over_its_start_is_known():
    problem, mean, covariance = normal(3)
    sd = np.sqrt(np.diag(covariance))
    lowest = float(problem.cost(jnp.asarray(mean)))
    for start, gain in ((mean, 0.0), (mean + 3 * sd, None)):
        sampled = sample(problem, start, sd, max_steps=300)
        expected = float(problem.cost(jnp.asarray(start))) - lowest if gain is None else gain
        assert sampled.start_log_probability == pytest.approx(-expected - lowest)
        assert expected - 1.0 < sampled.improvement <= expected
        values = problem.space.values(jnp.asarray(problem.space.pack(sampled.best_values)))
        assert list(sampled.best_values.values()) == pytest.approx(values.tolist())


def test_a_run_that_is_too_short_says_so():
    problem, mean, covariance = normal(5)
    sampled = sample(problem, mean, np.sqrt(np.diag(covariance)), max_steps=200)
    assert not sampled.converged
    assert "too short: 200 steps" in sampled.message


def test_thinning_stores_one_step_in_so_many():
    problem, mean, covariance = normal(2)
    sd = np.sqrt(np.diag(covariance))
    every = sample(problem, mean, sd, max_steps=60, stop_at=1e9)
    third = sample(problem, mean, sd, max_steps=60, stop_at=1e9, thin_by=3)
    assert np.array_equal(third.u, every.u[2::3])


def test_progress_is_reported_and_nothing_compiles_between_checks():
    problem, mean, covariance = normal(7)
    sd = np.sqrt(np.diag(covariance))
    reports = []
    TRACES.clear()
    sample(problem, mean, sd, max_steps=200, check_every=20, progress=reports.append)
    assert len(TRACES) == 1  # half of the walkers at a time, at the start too
    sample(normal(7, seed=1)[0], mean, sd, seed=1, max_steps=40)
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
        ({"thin_by": 0}, "thin_by is 0"),
        ({"max_steps": 5, "thin_by": 10}, "max_steps is 5, wanted at least thin_by"),
    ],
)
def test_impossible_arguments_are_refused_with_what_is_wanted(changes, message):
    arguments = {"start_u": np.zeros(3), "start_sd": np.ones(3)} | changes
    with pytest.raises(ValueError, match=message):
        sample(normal(3)[0], **arguments)


# Interrupted and killed


def interrupt_at(step):
    def progress(report):
        if report.step == step:
            raise KeyboardInterrupt

    return progress


def test_an_interrupt_returns_the_chain_and_the_run_can_go_on(tmp_path):
    problem, mean, covariance = normal(3)
    run = {"start_u": mean, "start_sd": np.sqrt(np.diag(covariance)), "max_steps": 90}
    whole = sample(problem, **run)
    path = tmp_path / "chain.h5"
    part = sample(problem, **run, path=path, check_every=5, progress=interrupt_at(35))
    assert part.message.startswith("Interrupted, the chain is kept.") and not part.converged
    assert np.array_equal(part.u, whole.u[:35])
    rest = sample(problem, **run, path=path)
    assert np.array_equal(rest.u, whole.u)
    assert np.array_equal(rest.acceptance, whole.acceptance)
    assert [file.name for file in tmp_path.iterdir()] == ["chain.h5"]


def test_an_interrupt_before_the_first_step_is_raised_without_output(monkeypatch, capfd):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(sampler, "log_probabilities", interrupted)
    with pytest.raises(KeyboardInterrupt):
        sample(normal(2)[0], np.zeros(2), np.ones(2))
    assert capfd.readouterr().out == ""


def test_a_finished_run_is_returned_and_a_longer_one_continues_it(tmp_path):
    problem, mean, covariance = normal(2)
    run = {"start_u": mean, "start_sd": np.sqrt(np.diag(covariance)), "path": tmp_path / "a.h5"}
    first = sample(problem, **run)
    before = run["path"].read_bytes()
    again = sample(problem, **run)
    assert np.array_equal(first.u, again.u) and again.message == first.message
    assert run["path"].read_bytes() == before
    longer = sample(problem, **run, stop_at=1000.0)
    assert longer.converged and len(longer.u) > len(first.u)
    assert np.array_equal(longer.u[: len(first.u)], first.u)


def test_emcee_reads_the_file(tmp_path):
    problem, mean, covariance = normal(2)
    path = tmp_path / "chain.h5"
    sampled = sample(problem, mean, np.sqrt(np.diag(covariance)), path=path, max_steps=40)
    backend: Any = emcee.backends.HDFBackend(str(path), read_only=True)
    assert np.array_equal(backend.get_chain(), sampled.u)
    assert np.array_equal(backend.get_log_prob(), sampled.log_probability)
    assert np.array_equal(backend.accepted / 40, sampled.acceptance)


def test_a_kill_loses_no_finished_step_wherever_it_tears_the_journal(tmp_path):
    problem, mean, covariance = normal(3)
    run = {"start_u": mean, "start_sd": np.sqrt(np.diag(covariance))}
    run |= {"max_steps": 120, "check_every": 1, "stop_at": 1e9}
    random = np.random.default_rng(0)
    copies = []  # what a kill at that moment leaves, with some bytes of the last record missing

    def snapshot(report):
        if report.step % 17:
            return
        for file in (path, journal_path(path)):
            shutil.copy(file, tmp_path / f"{report.step}-{file.name}")
        copy = tmp_path / f"{report.step}-{path.name}"
        journal = journal_path(copy)
        content = journal.read_bytes()
        torn = int(random.integers(0, 2)) * int(random.integers(1, 400))
        journal.write_bytes(content[: max(0, len(content) - torn)])
        copies.append((copy, report.step - bool(torn)))

    path = tmp_path / "chain.h5"
    whole = sample(problem, **run, path=path, progress=snapshot)
    assert len(copies) == 7
    for copy, finished in copies:
        identity = Identity(problem.space.names, 12, 0, 1, posterior.digest(problem))
        with Chain(identity, copy) as chain:
            assert len(chain) >= finished
        resumed = sample(problem, **run, path=copy)
        assert np.array_equal(resumed.u, whole.u)
        assert np.array_equal(resumed.log_probability, whole.log_probability)
        assert np.array_equal(resumed.acceptance, whole.acceptance)


def deadly_run(path, death):
    """The run of the next test, in a process of its own, which is killed in one of three ways."""
    problem, mean, covariance = normal(4)

    def die():
        os.kill(os.getpid(), signal.SIGKILL)

    class HalfWriter:
        """A journal whose 60th record is cut in the middle by the kill."""

        def __init__(self, file):
            self.file, self.left = file, 60

        def __getattr__(self, name):
            return getattr(self.file, name)

        def write(self, record):
            self.left -= 1
            written = self.file.write(record[: len(record) // 2] if not self.left else record)
            if not self.left:
                die()
            return written

    if death == "writing a record":
        opened = Chain.__enter__

        def open_half(self):
            self._journal = HalfWriter(self._journal)
            return opened(self)

        Chain.__enter__ = open_half
    if death == "before the file is replaced":
        calls = iter(range(3))
        replace = os.replace
        os.replace = lambda *names: replace(*names) if next(calls) < 2 else die()
    return sample(
        problem,
        mean,
        np.sqrt(np.diag(covariance)),
        path=path,
        max_steps=800,
        check_every=50,
        stop_at=1e9,
        thin_by=2,
        progress=lambda report: time.sleep(0.2 if death == "from outside" else 0),
    )


@pytest.mark.slow
def test_a_run_killed_three_times_makes_the_chain_of_an_uninterrupted_run(tmp_path):
    path = tmp_path / "chain.h5"
    journal = journal_path(path)
    folders = os.pathsep.join([str(ROOT), str(ROOT / "tests"), str(Path(__file__).parent)])
    environment = os.environ | {"PYTHONPATH": folders, "JAX_ENABLE_X64": "1"}
    lengths = []
    deaths = ["from outside", "writing a record", "before the file is replaced"]
    for death in deaths:
        run = f"from test_posterior import *; deadly_run(Path({str(path)!r}), {death!r})"
        child = subprocess.Popen([sys.executable, "-c", run], env=environment)
        if death == "from outside":
            while child.poll() is None and not (journal.exists() and journal.stat().st_size > 3e4):
                time.sleep(0.01)
            child.kill()
        assert child.wait(timeout=120) == -signal.SIGKILL
        problem = normal(4)[0]
        copy = tmp_path / "copy.h5"
        shutil.copy(path, copy)
        shutil.copy(journal, journal_path(copy))
        identity = Identity(problem.space.names, 16, 0, 2, posterior.digest(problem))
        with Chain(identity, copy) as chain:
            lengths.append(len(chain))
    assert 0 < lengths[0] < lengths[1] < lengths[2] < 400
    assert lengths[1] - lengths[0] == 59  # the torn record is dropped
    resumed = deadly_run(path, "never")
    uninterrupted = deadly_run(None, "never")
    assert np.array_equal(resumed.u, uninterrupted.u)
    assert np.array_equal(resumed.log_probability, uninterrupted.log_probability)
    assert np.array_equal(resumed.acceptance, uninterrupted.acceptance)


# Files of other runs and programs


@pytest.mark.parametrize(
    ("field", "other"),
    [
        ("parameters", ("x[1]", "x[0]")),
        ("walkers", 10),
        ("seed", 1),
        ("thin_by", 2),
        ("problem", "0" * 64),
    ],
)
def test_the_chain_of_another_run_is_refused(tmp_path, field, other):
    path = tmp_path / "chain.h5"
    own = {"parameters": ("x[0]", "x[1]"), "walkers": 8, "seed": 0, "thin_by": 1}
    own |= {"problem": posterior.digest(normal(2)[0])}
    with Chain(Identity(**own | {field: other}), path):
        pass
    before = path.read_bytes()
    with pytest.raises(ValueError, match=f"chain of another run: its {field} is"):
        sample(normal(2)[0], np.zeros(2), np.ones(2), path=path)
    assert path.read_bytes() == before


@pytest.mark.parametrize("kind", ["text", "empty HDF5", "emcee's own", "another format"])
def test_a_file_that_is_not_a_chain_of_this_sampler_is_refused(tmp_path, kind):
    path = tmp_path / "chain.h5"
    if kind == "text":
        path.write_text("no chain")
    elif kind == "empty HDF5":
        h5py.File(path, "w").close()
    elif kind == "emcee's own":
        emcee.backends.HDFBackend(str(path)).reset(8, 2)
    else:
        sample(normal(2)[0], np.zeros(2), np.ones(2), path=path, max_steps=1)
        with h5py.File(path, "a") as file:
            file["mcmc"].attrs["format"] = 99
    with pytest.raises(ValueError, match="is not a chain of this sampler|its format is 99"):
        sample(normal(2)[0], np.zeros(2), np.ones(2), path=path)


def test_the_journal_of_a_deleted_or_replaced_chain_is_ignored(tmp_path):
    path = tmp_path / "chain.h5"
    problem = normal(2)[0]
    with Chain(Identity(problem.space.names, 8, 5, 1, posterior.digest(problem)), path) as other:
        state = cast(RandomState, np.random.RandomState(0).get_state())
        other.append(np.zeros((8, 2)), np.zeros(8), np.ones(8, bool), state)
        stale = journal_path(path).read_bytes()
    assert len(stale) > 0
    path.unlink()
    whole = sample(problem, np.zeros(2), np.ones(2), max_steps=20)
    journal_path(path).write_bytes(stale)
    sampled = sample(problem, np.zeros(2), np.ones(2), path=path, max_steps=10)
    journal_path(path).write_bytes(stale)
    sampled = sample(problem, np.zeros(2), np.ones(2), path=path, max_steps=20)
    assert np.array_equal(sampled.u, whole.u)


def test_steps_in_both_files_count_once_and_steps_after_a_gap_do_not_count(tmp_path):
    path = tmp_path / "chain.h5"
    identity = Identity(("a",), 4, 0, 1, "0" * 64)
    state = cast(RandomState, np.random.RandomState(0).get_state())
    with Chain(identity, path) as chain:
        empty = path.read_bytes()
        journals = []
        for start in (0, 3):
            for step in range(start, start + 3):
                chain.append(np.full((4, 1), float(step)), np.zeros(4), np.ones(4, bool), state)
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
    problem, _, _ = normal(2)
    others = [
        normal(2, seed=1)[0],
        eqx.tree_at(lambda p: p.space.prior.centre, problem, problem.space.start + 1e-12),
        Problem(problem.space, problem.data, linear_in_u, "cauchy"),
        Problem(problem.space, problem.data, nan_above),
    ]
    elsewhere = eqx.tree_at(lambda p: p.space.start, problem, problem.space.start + 1.0)
    assert posterior.digest(problem) == posterior.digest(normal(2)[0])
    assert posterior.digest(problem) == posterior.digest(elsewhere)
    assert len({posterior.digest(each) for each in [problem, *others]}) == 5


# Chains that must not be trusted


def test_a_chain_with_many_isolated_walkers_has_not_converged():
    log_probability = np.random.default_rng(0).normal(size=(1000, 20))
    log_probability[:, :3] -= 50
    check = diagnostics.check(np.random.default_rng(1).normal(size=(1000, 20, 2)), log_probability)
    assert check.isolated.nonzero()[0].tolist() == [0, 1, 2]
    converged, message = diagnostics.verdict(check, check, ("a", "b"), 1, 50.0)
    assert not converged and "too many walkers are isolated" in message


def test_a_walker_that_hardly_moves_is_named():
    acceptance = np.array([0.3, 0.25, 0.01, 0.28])
    assert diagnostics.lazy_walkers(acceptance).tolist() == [False, False, True, False]


def test_the_autocorrelation_time_of_a_known_series_is_estimated():
    chain = autocorrelated(0.9, (20_000, 10, 1))
    assert diagnostics.autocorrelation_time(chain)[0] == pytest.approx(19, rel=0.1)
    assert diagnostics.autocorrelation_time(autocorrelated(0, (2000, 10, 1)))[0] < 1.2


def test_a_walker_that_never_moves_lengthens_the_autocorrelation_time():
    chain = autocorrelated(0.5, (4000, 20, 1))
    healthy = diagnostics.autocorrelation_time(chain)[0]
    chain[:, 0] = 3.0
    frozen = diagnostics.autocorrelation_time(chain)[0]
    assert len(chain) > 50 * healthy and len(chain) < 50 * frozen


def test_a_parameter_that_never_moves_never_converges():
    chain = np.random.default_rng(0).normal(size=(500, 8, 2))
    chain[..., 1] = 2.0
    check = diagnostics.check(chain, np.zeros((500, 8)))
    assert np.isinf(check.slowest) and check.burn_in == 250
    assert not diagnostics.verdict(check, check, ("a", "b"), 1, 50.0)[0]


def test_a_chain_whose_autocorrelation_time_still_changes_has_not_converged():
    chain = autocorrelated(0.5, (1000, 8, 1))
    latest = diagnostics.check(chain, np.zeros((1000, 8)))
    before = diagnostics.Check(900, latest.times * 1.06, latest.isolated)
    steady = diagnostics.Check(900, latest.times * 1.04, latest.isolated)
    assert "still changes" in diagnostics.verdict(before, latest, ("a",), 1, 50.0)[1]
    assert "still changes" in diagnostics.verdict(None, latest, ("a",), 1, 50.0)[1]
    assert diagnostics.verdict(steady, latest, ("a",), 1, 50.0)[0]


def test_split_r_hat_detects_walkers_that_disagree_and_walkers_that_drift():
    chain = np.random.default_rng(0).normal(size=(1000, 10, 3))
    chain[:, :5, 1] += 2
    chain[..., 2] += np.linspace(0, 3, 1000)[:, None]
    r_hat = diagnostics.split_r_hat(chain)
    assert r_hat[0] < 1.01 and r_hat[1] > 1.2 and r_hat[2] > 1.2
    assert np.isnan(diagnostics.split_r_hat(chain[:3])).all()
    assert np.isinf(diagnostics.split_r_hat(np.zeros((8, 2, 1)))).all()


@pytest.mark.parametrize("stored", [0, 1, 99, 100, 640, 999, 1000])
def test_a_resumed_run_checks_where_an_uninterrupted_one_does(stored):
    uninterrupted = diagnostics.check_lengths(0, 50, 1000)
    resumed = diagnostics.check_lengths(stored, 50, 1000)
    assert uninterrupted[-1] == 1000 and min(np.diff(uninterrupted)) >= 50
    assert resumed == uninterrupted[-len(resumed) :]
    assert sum(length <= stored for length in resumed) == min(
        2, sum(length <= stored for length in uninterrupted)
    )
