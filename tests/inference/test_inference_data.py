"""Posteriors as ArviZ takes them: its figures are ours, a file holds all, blocks are left out."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from fitting.inference.sample import blocks, inference_data
from fitting.inference.sample.blocks import BlockLogLikelihood, leave_one_out
from fitting.inference.sample.posterior import Posterior
from fitting.problem.space import ParameterPrior, Priors, Space
from support import toy
from support.problems import posterior_of, problem_of

pytestmark = pytest.mark.skipif(not blocks.is_available(), reason="needs ArviZ")
NAMES = ("foot.share", "foot.limit[0]", "lock.height_on")


@pytest.fixture(scope="module")
def space() -> Space:
    space = problem_of(toy.Toy(), NAMES, None, toy.residuals).space
    return space.with_prior(Priors(named={"foot.share": ParameterPrior("uniform")}))


@pytest.fixture(scope="module")
def posterior(space) -> Posterior:
    """Normal draws, with an isolated walker."""
    u = 0.4 + 0.3 * np.random.default_rng(0).normal(size=(300, 8, 3))
    u[:, 5] += 9.0
    values = np.asarray(space.values(u))
    how = {"thin_by": 2, "burn_in": 100, "autocorrelation_time": np.full(3, 4.0)}
    return posterior_of(NAMES, u, values, **how, isolated=[5], stuck=[5])


@pytest.fixture(scope="module")
def tree(posterior, space):
    return posterior.to_inference_data(space)


def test_the_summary_of_arviz_has_our_figures(posterior, tree):
    arviz_stats = pytest.importorskip("arviz_stats")
    tables = {
        level: arviz_stats.summary(
            tree, kind="stats", ci_prob=level / 100, ci_kind="eti", round_to="none"
        )
        for level in (68, 95)
    }
    medians = arviz_stats.summary(tree, kind="stats_median", round_to="none")["median"]
    r_hat = arviz_stats.rhat(tree, method="split")
    for row in posterior.summary:
        for level, table in tables.items():
            theirs = table.loc[row["name"]]
            ends = [theirs[f"eti{level}_lb"], theirs[f"eti{level}_ub"]]
            assert ends == pytest.approx([row[f"low{level}"], row[f"high{level}"]], rel=1e-9)
            assert theirs["mean"] == pytest.approx(row["mean"], rel=1e-9)
            assert theirs["sd"] == pytest.approx(row["sd"], rel=1e-3)
        assert row["ess"] == 200 * 7 / 2, "one step of two is stored"
        assert medians[row["name"]] == pytest.approx(row["median"], rel=1e-9)
        assert float(r_hat[row["name"]]) == pytest.approx(row["r_hat"], abs=0.01)


def test_a_young_chain_with_fewer_steps_than_walkers_warns_of_nothing(posterior, space):
    tree = replace(posterior, burn_in=296).to_inference_data(space)  # warnings are errors here
    assert dict(tree["posterior"].sizes) == {"chain": 7, "draw": 4}


def test_draws_have_their_walkers_steps_units_and_kinds(posterior, tree):
    draws = tree["posterior"]
    assert draws["chain"].values.tolist() == [0, 1, 2, 3, 4, 6, 7]
    assert draws["draw"].values[[0, -1]].tolist() == [202, 600]
    np.testing.assert_array_equal(draws["foot.limit[0]"].T, posterior.draws[..., 1])
    assert draws["foot.limit[0]"].attrs["units"] == "rad"
    assert draws["lock.height_on"].attrs["kind"] == "threshold"
    lp = tree["sample_stats"]["lp"]
    np.testing.assert_array_equal(lp.sel(chain=6), posterior.log_probability[100:, 6])
    share = tree["prior"]["foot.share"].values.ravel()
    assert stats.kstest(share, stats.uniform(0, 1.2).cdf).pvalue > 0.01


def test_a_file_holds_what_was_written(posterior, space, tree, tmp_path):
    import arviz_base
    import xarray

    inference_data.write_inference_data(tmp_path / "posterior.nc", posterior, space)
    read = xarray.open_datatree(tmp_path / "posterior.nc", engine="h5netcdf")
    for group in ("posterior", "sample_stats", "prior"):
        xarray.testing.assert_equal(read[group].to_dataset(), tree[group].to_dataset())
    assert read["posterior"]["foot.limit[0]"].attrs == {"units": "rad", "kind": "smooth"}
    assert read.attrs["message"] == "Converged."
    assert arviz_base.extract(read, group="prior").sizes["sample"] == inference_data.PRIOR_DRAWS


def test_the_log_likelihood_of_blocks_is_one_that_arviz_takes_and_a_file_gives_back(
    posterior, space, tmp_path
):
    arviz_stats = pytest.importorskip("arviz_stats")
    of_blocks = BlockLogLikelihood(
        values=0.1 * np.random.default_rng(0).normal(size=(200, 4)),
        clip=np.array([1, 1, 1, 2]),
        start=np.array([0.0, 1.0, 2.0, 0.0]),
        end=np.array([1.0, 2.0, 2.7, 1.2]),
        data="0123456789abcdef",
        efficiency=0.8,
    )
    with_blocks = replace(posterior, blocks=of_blocks)
    tree = with_blocks.to_inference_data(space)
    assert tree["log_likelihood"]["motion"].sizes == {"chain": 1, "draw": 200, "block": 4}
    ours = leave_one_out(of_blocks)
    theirs = arviz_stats.loo(tree, reff=0.8)
    assert ours is not None and theirs.elpd == pytest.approx(ours.elpd)
    inference_data.write_inference_data(tmp_path / "posterior.nc", with_blocks, space)
    read = inference_data.read_blocks(tmp_path / "posterior.nc")
    for name, value in vars(of_blocks).items():
        np.testing.assert_array_equal(getattr(read, name), value, err_msg=name)


def test_a_file_without_log_likelihood_and_a_missing_package_are_said(
    posterior, space, tmp_path, monkeypatch
):
    inference_data.write_inference_data(tmp_path / "posterior.nc", posterior, space)
    (tmp_path / "text.nc").write_text("no draws")
    for name in ("posterior.nc", "text.nc"):
        with pytest.raises(ValueError, match=f"{name}: no log-likelihood in it"):
            inference_data.read_blocks(tmp_path / name)
    monkeypatch.setattr(blocks, "PACKAGES", ("no_such_package",))
    with pytest.raises(ImportError, match=r'pip install "jaxik\[posterior\]"'):
        posterior.to_inference_data(space)


# Blocks of frames left out: against the exact answer, and what is said of unreliable figures

OBSERVED = np.random.default_rng(1).normal(0.4, 1.0, 40)
SPREAD = 3.0  # of the prior of the mean


def exact_mean(observed: np.ndarray) -> tuple[float, float]:
    """Mean and standard deviation of its posterior, for noise of one and a normal prior about 0."""
    variance = 1 / (len(observed) + 1 / SPREAD**2)
    return variance * observed.sum(), math.sqrt(variance)


def log_likelihood(observed: np.ndarray, draws: int = 2000) -> BlockLogLikelihood:
    """Of values as blocks, for exact draws of the posterior of their mean."""
    mean, sd = exact_mean(observed)
    means = np.random.default_rng(0).normal(mean, sd, draws)
    count = len(observed)
    return BlockLogLikelihood(
        values=stats.norm.logpdf(observed[None], means[:, None]),
        clip=np.repeat([1, 2], [count - 10, 10]),
        start=np.arange(count, dtype=float),
        end=np.arange(count) + 1.0,
        data="0123456789abcdef",
        efficiency=1.0,
    )


def test_blocks_left_out_get_their_exact_density_unless_the_fit_hangs_on_one():
    found = leave_one_out(log_likelihood(OBSERVED))
    assert found is not None
    exact = []
    for i in range(len(OBSERVED)):
        mean, sd = exact_mean(np.delete(OBSERVED, i))
        exact.append(stats.norm.logpdf(OBSERVED[i], mean, math.hypot(sd, 1.0)))
    np.testing.assert_allclose(found.elpd_of_block, exact, atol=0.03)
    assert found.elpd == pytest.approx(np.sum(exact), abs=0.05)
    assert found.error == pytest.approx(math.sqrt(len(exact)) * np.std(exact), rel=0.05)
    assert found.parameters == pytest.approx(1.0, abs=0.3)
    assert found.unreliable == 0
    assert abs(found.neighbours) < 0.5
    observed = OBSERVED.copy()
    observed[7] = 60.0
    found = leave_one_out(log_likelihood(observed))
    assert found is not None
    assert found.pareto_k[7] > found.max_k and found.unreliable >= 1


def test_neighbours_in_different_clips_are_no_neighbours():
    values = np.array([1.0, 1.1, 0.9, 1.0, 5.0, 5.1, 4.9, 5.0])
    assert blocks._neighbours(values, np.repeat([1, 2], 4)) > 0.9  # of all, about one mean
    assert math.isnan(blocks._neighbours(values, np.arange(8)))


def test_a_handful_of_draws_or_one_block_or_no_arviz_says_nothing(monkeypatch):
    whole = log_likelihood(OBSERVED)
    single = replace(whole, values=whole.values[:, :1], clip=whole.clip[:1])
    few = log_likelihood(OBSERVED, blocks.MIN_DRAWS - 1)
    assert leave_one_out(few) is leave_one_out(single) is None
    monkeypatch.setattr(blocks, "is_available", lambda: False)
    assert leave_one_out(whole) is None
