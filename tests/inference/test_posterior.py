"""The sampler: known posteriors, runs that are killed, and chains that must not be trusted."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import emcee
import equinox as eqx
import h5py
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from fitting.inference.sampling import diagnostics, posterior, sampler
from fitting.inference.sampling.chain import Chain, Identity, journal_path
from fitting.inference.sampling.posterior import Posterior, WalkerStart
from fitting.inference.sampling.settings import SamplerSettings
from fitting.problem.free_parameters import PRIOR_SD, free_parameter
from fitting.problem.problem import Problem
from fitting.problem.space import make_space
from jaxik.maths import parameter_tree

ROOT = Path(__file__).resolve().parents[2]
TRACES = []  # one entry for each time that JAX traces the residuals


class Toy(eqx.Module):
    """As many parameters as wanted, each between 0 and 1."""

    x: Float[Array, " legs"] = parameter_tree.parameter(
        (0.5,), unit="", low=0.0, high=1.0, doc="X of the test rule."
    )


class Step(eqx.Module):
    """A height that counts from a moment on."""

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


def step_minus_seen(ik, data):
    time, seen = data
    return (jnp.where(time > ik.moment, ik.height, 0.0) - seen) / 0.3


def nan_above(ik, data):
    """NaN in the upper half of the range."""
    return jnp.where(ik.x < data, ik.x, jnp.nan)


def two_islands(ik, data):
    """A minimum at u = 0 and one at u = 8, worse by `data`, too far for a proposal."""
    u = jnp.log(ik.x) - jnp.log1p(-ik.x)
    island = u.mean() > 4
    return jnp.append(jnp.where(island, u - 8, u), jnp.where(island, jnp.sqrt(2 * data), 0.0))


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
    covariance = np.linalg.inv(factor.T @ factor + np.eye(size) / PRIOR_SD**2)
    mean = covariance @ factor.T @ factor @ centre
    return toy(size, linear_in_u, (jnp.asarray(factor), jnp.asarray(centre))), mean, covariance


def autocorrelated(share, shape, seed=0):
    """Normal series of unit variance in which each step keeps this share of the one before."""
    noise = np.random.default_rng(seed).normal(size=shape)
    series = noise.copy()
    for i in range(1, len(series)):
        series[i] = share * series[i - 1] + np.sqrt(1 - share**2) * noise[i]
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


@pytest.mark.parametrize(("size", "stop_at"), [(10, 50.0), (20, 25.0)])
def test_a_known_normal_is_found_with_its_variances(size, stop_at):
    problem, mean, covariance = normal(size)
    found = sample(problem, mean, np.sqrt(np.diag(covariance)), stop_at=stop_at)
    assert found.converged, found.message
    centred = (found.u[found.burn_in :] - mean) @ np.linalg.inv(np.linalg.cholesky(covariance)).T
    count = centred.shape[0] * centred.shape[1]
    # Standard error of each mean, and of each variance from the times of the squares.
    error_mean = np.sqrt(diagnostics.autocorrelation_time(centred) / count)
    error_variance = np.sqrt(2 * diagnostics.autocorrelation_time(centred**2) / count)
    assert np.all(np.abs(centred.mean(axis=(0, 1))) < 4 * error_mean)
    variances = (centred**2).mean(axis=(0, 1))
    assert np.all(np.abs(variances - 1) < 4 * error_variance)
    # The snooker move of emcee 3.1.6 gives 0.88 in 10 dimensions, 0.81 in 20.
    assert abs(variances.mean() - 1) < 0.03
    assert error_variance.max() < 0.05  # long enough to tell


def test_the_moves_are_differential_evolution_only():
    kinds = [(type(one).__name__, vars(one)["gamma0"], share) for one, share in sampler.moves()]
    assert kinds == [("DEMove", None, 0.9), ("DEMove", 1.0, 0.1)]


def test_intervals_cover_the_truth_as_often_as_they_say():
    size, runs = 3, 20
    problem, _, covariance = normal(size)
    factor = problem.data[0]
    random = np.random.default_rng(1)
    inside = {68: 0, 95: 0}
    for seed in range(runs):
        truth = PRIOR_SD * random.normal(size=size)
        seen = truth + np.linalg.solve(factor, random.normal(size=size))
        one = eqx.tree_at(lambda p: p.data[1], problem, jnp.asarray(seen))
        mean = covariance @ factor.T @ factor @ seen
        sd = np.sqrt(np.diag(covariance))
        found = sample(one, mean, sd, seed=seed, max_steps=350, stop_at=1e9)
        values = np.asarray(one.space.values(jnp.asarray(truth)))
        exact = np.asarray(one.space.values(jnp.asarray(mean)))
        for row, value, median in zip(found.summary, values, exact, strict=True):
            assert abs(row["median"] - median) < 5 * row["sd"] / np.sqrt(row["ess"])
            for level in inside:
                inside[level] += row[f"low{level}"] < value < row[f"high{level}"]
    trials = size * runs
    for level, count in inside.items():
        share = level / 100
        assert abs(count / trials - share) < 3 * np.sqrt(share * (1 - share) / trials)


def test_a_threshold_is_sampled_as_integrated_on_a_grid():
    ik = Step()
    random = np.random.default_rng(3)
    moments = jnp.linspace(0.02, 0.98, 25)
    seen = jnp.where(moments > 0.43, 0.7, 0.0) + 0.3 * random.normal(size=25)
    space = make_space(ik, [free_parameter(ik, "height"), free_parameter(ik, "moment")])
    problem = Problem(space, (moments, seen), step_minus_seen)
    start = space.pack({"height": 0.7, "moment": 0.43})
    found = sample(problem, start, np.array([0.3, 0.05]), walkers=32)
    assert found.converged, found.message

    axis = jnp.linspace(-7, 7, 281)
    grid = jnp.stack(jnp.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    weight = np.exp(np.asarray(sampler._log_probabilities(problem, grid)))
    values = np.asarray(posterior._values(problem, grid))
    mean = np.average(values, axis=0, weights=weight)
    sd = np.sqrt(np.average((values - mean) ** 2, axis=0, weights=weight))
    for i, row in enumerate(found.summary):
        assert abs(row["mean"] - mean[i]) < 4 * sd[i] / np.sqrt(row["ess"])
        assert row["sd"] == pytest.approx(sd[i], rel=0.1)


def test_a_step_into_nan_is_never_taken():
    problem = toy(2, nan_above, jnp.asarray(0.55))
    found = sample(problem, np.zeros(2), np.ones(2), max_steps=300)
    assert np.isfinite(found.log_probability).all()
    assert 0.5 < found.values.max() < 0.55


def test_a_start_without_a_finite_log_probability_is_an_error():
    problem = toy(2, nan_above, jnp.asarray(0.5))
    with pytest.raises(ValueError, match="only 0 of 8 walkers have a finite log-probability"):
        sample(problem, np.full(2, 3.0), np.full(2, 0.01))


# What a run does


def test_a_run_is_decided_by_its_seed():
    problem, mean, covariance = normal(3)
    sd = np.sqrt(np.diag(covariance))
    first, again, other = (sample(problem, mean, sd, seed=seed, max_steps=50) for seed in (1, 1, 2))
    assert np.array_equal(first.u, again.u)
    assert not np.array_equal(first.u[0], other.u[0])


def test_a_run_stops_at_fifty_steady_autocorrelation_times():
    problem, mean, covariance = normal(2)
    found = sample(problem, mean, np.sqrt(np.diag(covariance)))
    steps = len(found.u)
    slowest = found.autocorrelation_time.max()
    assert found.converged and found.message.startswith("Converged: ")
    assert 50 * slowest <= steps < 20_000
    assert found.burn_in >= 5 * slowest
    assert found.u.shape == found.values.shape == (steps, 8, 2)
    assert np.allclose(found.values[-1, 0], problem.space.values(jnp.asarray(found.u[-1, 0])))
    assert 0.1 < found.acceptance.min() and found.stuck == []
    assert [row["name"] for row in found.summary] == ["x[0]", "x[1]"]
    assert all(row["r_hat"] < 1.05 and row["ess"] > 8 * 0.8 * 50 for row in found.summary)


def test_a_run_that_is_too_short_says_so():
    problem, mean, covariance = normal(5)
    found = sample(problem, mean, np.sqrt(np.diag(covariance)), max_steps=200)
    assert not found.converged
    assert "too short: 200 steps" in found.message


def test_thinning_keeps_every_so_manyth_step():
    problem, mean, covariance = normal(2)
    sd = np.sqrt(np.diag(covariance))
    every = sample(problem, mean, sd, max_steps=60, stop_at=1e9)
    third = sample(problem, mean, sd, max_steps=60, stop_at=1e9, thin_by=3)
    assert np.array_equal(third.u, every.u[2::3])


def test_progress_is_reported_and_nothing_compiles_between_checks():
    problem, mean, covariance = normal(7)
    sd = np.sqrt(np.diag(covariance))
    seen = []
    TRACES.clear()
    sample(problem, mean, sd, max_steps=200, check_every=20, progress=seen.append)
    assert len(TRACES) == 1  # half of the walkers at a time, at the start too
    sample(normal(7, seed=1)[0], mean, sd, seed=1, max_steps=40)
    assert len(TRACES) == 1
    assert [one.step for one in seen] == list(range(20, 201, 20))
    assert seen[0].max_steps == 200 and 0 < seen[0].elapsed < seen[-1].elapsed
    assert 0 < seen[-1].acceptance < 1 and seen[-1].autocorrelation_time > 1


@pytest.mark.parametrize(
    ("changes", "complaint"),
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
def test_impossible_arguments_are_answered_at_the_door(changes, complaint):
    arguments = {"start_u": np.zeros(3), "start_sd": np.ones(3)} | changes
    with pytest.raises(ValueError, match=complaint):
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
    assert [one.name for one in tmp_path.iterdir()] == ["chain.h5"]


def test_an_interrupt_before_the_first_step_is_passed_on_quietly(monkeypatch, capfd):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(sampler, "_log_probabilities", interrupted)
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
    longer = sample(problem, **run, stop_at=100.0)
    assert longer.converged and len(longer.u) > len(first.u)
    assert np.array_equal(longer.u[: len(first.u)], first.u)


def test_emcee_reads_the_file(tmp_path):
    problem, mean, covariance = normal(2)
    path = tmp_path / "chain.h5"
    found = sample(problem, mean, np.sqrt(np.diag(covariance)), path=path, max_steps=40)
    backend: Any = emcee.backends.HDFBackend(str(path), read_only=True)
    assert np.array_equal(backend.get_chain(), found.u)
    assert np.array_equal(backend.get_log_prob(), found.log_probability)
    assert np.array_equal(backend.accepted / 40, found.acceptance)


def test_a_kill_loses_no_finished_step_wherever_it_tears_the_journal(tmp_path):
    problem, mean, covariance = normal(3)
    run = {"start_u": mean, "start_sd": np.sqrt(np.diag(covariance))}
    run |= {"max_steps": 120, "check_every": 1, "stop_at": 1e9}
    random = np.random.default_rng(0)
    left = []  # what a kill at that moment leaves, with some bytes of the last record missing

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
        left.append((copy, report.step - bool(torn)))

    path = tmp_path / "chain.h5"
    whole = sample(problem, **run, path=path, progress=snapshot)
    assert len(left) == 7
    for copy, finished in left:
        identity = Identity(problem.space.names, 12, 0, 1, posterior.digest(problem))
        with Chain(identity, copy) as chain:
            assert len(chain) >= finished
        resumed = sample(problem, **run, path=copy)
        assert np.array_equal(resumed.u, whole.u)
        assert np.array_equal(resumed.log_probability, whole.log_probability)
        assert np.array_equal(resumed.acceptance, whole.acceptance)


def deadly_run(path, death):
    """The run of the next test, in a process of its own, which dies in the way asked for."""
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
            self.file.write(record[: len(record) // 2] if not self.left else record)
            if not self.left:
                die()

    if death == "writing a record":
        opened = Chain.__enter__

        def open_half(self):
            self._journal = HalfWriter(self._journal)
            return opened(self)

        Chain.__enter__ = open_half
    if death == "before the exchange of the file":
        exchanges = iter(range(3))
        exchange = os.replace
        os.replace = lambda *names: exchange(*names) if next(exchanges) < 2 else die()
    return sample(
        problem,
        mean,
        np.sqrt(np.diag(covariance)),
        path=path,
        max_steps=800,
        check_every=50,
        stop_at=1e9,
        thin_by=2,
        progress=lambda report: time.sleep(0.2 if death == "by the hand of another" else 0),
    )


@pytest.mark.slow
def test_runs_killed_again_and_again_make_the_chain_of_an_unbroken_run(tmp_path):
    path = tmp_path / "chain.h5"
    journal = journal_path(path)
    rooms = os.pathsep.join([str(ROOT), str(ROOT / "tests"), str(Path(__file__).parent)])
    environment = os.environ | {"PYTHONPATH": rooms, "JAX_ENABLE_X64": "1"}
    lengths = []
    deaths = ["by the hand of another", "writing a record", "before the exchange of the file"]
    for death in deaths:
        run = f"from test_posterior import *; deadly_run(Path({str(path)!r}), {death!r})"
        child = subprocess.Popen([sys.executable, "-c", run], env=environment)
        if death == "by the hand of another":
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
    assert lengths[1] - lengths[0] == 59  # and the torn one is dropped
    resumed = deadly_run(path, "of old age")
    unbroken = deadly_run(None, "of old age")
    assert np.array_equal(resumed.u, unbroken.u)
    assert np.array_equal(resumed.log_probability, unbroken.log_probability)
    assert np.array_equal(resumed.acceptance, unbroken.acceptance)


# Files of others


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
def test_a_file_that_is_no_chain_of_ours_is_refused(tmp_path, kind):
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
    with pytest.raises(ValueError, match="is not a chain of this sampler"):
        sample(normal(2)[0], np.zeros(2), np.ones(2), path=path)


def test_the_journal_of_a_deleted_or_exchanged_chain_is_ignored(tmp_path):
    path = tmp_path / "chain.h5"
    problem = normal(2)[0]
    with Chain(Identity(problem.space.names, 8, 5, 1, posterior.digest(problem)), path) as other:
        state = tuple(np.random.RandomState(0).get_state())
        other.append(np.zeros((8, 2)), np.zeros(8), np.ones(8, bool), state)
        stale = journal_path(path).read_bytes()
    assert len(stale) > 0
    path.unlink()
    whole = sample(problem, np.zeros(2), np.ones(2), max_steps=20)
    journal_path(path).write_bytes(stale)
    found = sample(problem, np.zeros(2), np.ones(2), path=path, max_steps=10)
    journal_path(path).write_bytes(stale)
    found = sample(problem, np.zeros(2), np.ones(2), path=path, max_steps=20)
    assert np.array_equal(found.u, whole.u)


def test_steps_in_both_files_count_once_and_steps_after_a_gap_not_at_all(tmp_path):
    path = tmp_path / "chain.h5"
    identity = Identity(("a",), 4, 0, 1, "0" * 64)
    state = tuple(np.random.RandomState(0).get_state())
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
    journal_path(path).write_bytes(journals[1])  # the steps before these are nowhere
    with Chain(identity, path) as chain:
        assert len(chain) == 0


def test_the_digest_follows_the_data_the_prior_and_the_loss():
    problem, _, _ = normal(2)
    others = [
        normal(2, seed=1)[0],
        eqx.tree_at(lambda p: p.space.u0, problem, problem.space.u0 + 1e-12),
        Problem(problem.space, problem.data, linear_in_u, "cauchy"),
        Problem(problem.space, problem.data, nan_above),
    ]
    assert posterior.digest(problem) == posterior.digest(normal(2)[0])
    assert len({posterior.digest(one) for one in [problem, *others]}) == 5


# Chains that must not be trusted


def test_a_walker_on_an_island_is_named_and_left_out(monkeypatch):
    problem = toy(6, two_islands, jnp.asarray(20.0))
    begin = sampler._start

    def with_a_castaway(identity, evaluate, start_u, start_sd):
        last = begin(identity, evaluate, start_u, start_sd)
        last.u[3] = 8.0 + 0.1 * last.u[3]
        return last._replace(log_probability=evaluate(last.u))

    monkeypatch.setattr(sampler, "_start", with_a_castaway)
    found = sample(problem, np.zeros(6), np.ones(6))
    assert found.isolated == [3] and 3 in found.stuck
    assert "left out: 1 of 24 walkers" in found.message
    assert found.converged, found.message
    assert found.kept.shape[1] == 23 and found.kept.max() < 0.999
    assert all(abs(row["mean"] - 0.5) < 5 * row["sd"] / row["ess"] ** 0.5 for row in found.summary)


def test_too_many_walkers_apart_are_no_convergence():
    log_probability = np.random.default_rng(0).normal(size=(1000, 20))
    log_probability[:, :3] -= 50
    seen = diagnostics.check(np.random.default_rng(1).normal(size=(1000, 20, 2)), log_probability)
    assert seen.isolated.nonzero()[0].tolist() == [0, 1, 2]
    converged, message = diagnostics.verdict(seen, seen, ("a", "b"), 1, 50.0)
    assert not converged and "too many walkers are isolated" in message


def test_a_walker_that_hardly_moves_is_named():
    acceptance = np.array([0.3, 0.25, 0.01, 0.28])
    assert diagnostics.lazy_walkers(acceptance).tolist() == [False, False, True, False]


def test_the_autocorrelation_time_of_a_known_series_is_found():
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
    seen = diagnostics.check(chain, np.zeros((500, 8)))
    assert np.isinf(seen.slowest) and seen.burn_in == 250
    assert not diagnostics.verdict(seen, seen, ("a", "b"), 1, 50.0)[0]


def test_an_autocorrelation_time_that_still_changes_is_no_convergence():
    chain = autocorrelated(0.5, (1000, 8, 1))
    latest = diagnostics.check(chain, np.zeros((1000, 8)))
    before = diagnostics.Check(900, latest.times * 1.06, latest.isolated)
    steady = diagnostics.Check(900, latest.times * 1.04, latest.isolated)
    assert "still changes" in diagnostics.verdict(before, latest, ("a",), 1, 50.0)[1]
    assert "still changes" in diagnostics.verdict(None, latest, ("a",), 1, 50.0)[1]
    assert diagnostics.verdict(steady, latest, ("a",), 1, 50.0)[0]


def test_split_r_hat_sees_walkers_that_disagree_and_walkers_that_drift():
    chain = np.random.default_rng(0).normal(size=(1000, 10, 3))
    chain[:, :5, 1] += 2
    chain[..., 2] += np.linspace(0, 3, 1000)[:, None]
    r_hat = diagnostics.split_r_hat(chain)
    assert r_hat[0] < 1.01 and r_hat[1] > 1.2 and r_hat[2] > 1.2
    assert np.isnan(diagnostics.split_r_hat(chain[:3])).all()
    assert np.isinf(diagnostics.split_r_hat(np.zeros((8, 2, 1)))).all()


@pytest.mark.parametrize("stored", [0, 1, 99, 100, 640, 999, 1000])
def test_a_resumed_run_checks_where_an_unbroken_one_does(stored):
    unbroken = diagnostics.check_lengths(0, 50, 1000)
    resumed = diagnostics.check_lengths(stored, 50, 1000)
    assert unbroken[-1] == 1000 and min(np.diff(unbroken)) >= 50
    assert resumed == unbroken[-len(resumed) :]
    assert sum(length <= stored for length in resumed) == min(
        2, sum(length <= stored for length in unbroken)
    )
