"""Posteriors as ArviZ takes them: its figures are ours, and a file holds all of it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from fitting.inference.sampling import inference_data
from fitting.inference.sampling.blocks import BlockLogLikelihood, leave_one_out
from fitting.inference.sampling.posterior import Posterior
from fitting.problem.prior import ParameterPrior, Priors
from fitting.problem.space import Space
from support import toy
from support.problems import posterior_of, problem_of

pytestmark = pytest.mark.skipif(not inference_data.is_available(), reason="needs ArviZ")
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


def test_the_summary_of_arviz_has_our_figures(posterior, space):
    arviz_stats = pytest.importorskip("arviz_stats")
    tree = posterior.to_inference_data(space)
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


def test_draws_have_their_walkers_steps_units_and_kinds(posterior, space):
    tree = posterior.to_inference_data(space)
    draws = tree["posterior"]
    assert draws["chain"].values.tolist() == [0, 1, 2, 3, 4, 6, 7]
    assert draws["draw"].values[[0, -1]].tolist() == [202, 600]
    np.testing.assert_array_equal(draws["foot.limit[0]"].T, posterior.kept[..., 1])
    assert draws["foot.limit[0]"].attrs["units"] == "rad"
    assert draws["lock.height_on"].attrs["kind"] == "threshold"
    lp = tree["sample_stats"]["lp"]
    np.testing.assert_array_equal(lp.sel(chain=6), posterior.log_probability[100:, 6])


def test_draws_of_the_prior_have_its_distribution(posterior, space):
    share = posterior.to_inference_data(space)["prior"]["foot.share"].values.ravel()
    assert stats.kstest(share, stats.uniform(0, 1.2).cdf).pvalue > 0.01


def test_a_file_holds_what_was_written(posterior, space, tmp_path):
    import arviz_base
    import xarray

    inference_data.write_inference_data(tmp_path / "posterior.nc", posterior, space)
    read = xarray.open_datatree(tmp_path / "posterior.nc", engine="h5netcdf")
    written = posterior.to_inference_data(space)
    for group in ("posterior", "sample_stats", "prior"):
        xarray.testing.assert_equal(read[group].to_dataset(), written[group].to_dataset())
    assert read["posterior"]["foot.limit[0]"].attrs == {"units": "rad", "kind": "smooth"}
    assert read.attrs["message"] == "Converged."
    assert arviz_base.extract(read, group="prior").sizes["sample"] == inference_data.PRIOR_DRAWS


def test_the_log_likelihood_of_blocks_is_one_that_arviz_takes(posterior, space, tmp_path):
    arviz_stats = pytest.importorskip("arviz_stats")
    random = np.random.default_rng(0)
    given = BlockLogLikelihood(
        values=0.1 * random.normal(size=(200, 4)),
        clip=np.array([1, 1, 1, 2]),
        start=np.array([0.0, 1.0, 2.0, 0.0]),
        end=np.array([1.0, 2.0, 2.7, 1.2]),
        data="0123456789abcdef",
        efficiency=0.8,
    )
    with_blocks = replace(posterior, blocks=given)
    tree = with_blocks.to_inference_data(space)
    assert tree["log_likelihood"]["motion"].sizes == {"chain": 1, "draw": 200, "block": 4}
    assert tree["log_likelihood"]["clip"].values.tolist() == [1, 1, 1, 2]
    ours = leave_one_out(given)
    theirs = arviz_stats.loo(tree, reff=0.8)
    assert ours is not None and theirs.elpd == pytest.approx(ours.elpd)
    inference_data.write_inference_data(tmp_path / "posterior.nc", with_blocks, space)
    read = inference_data.read_blocks(tmp_path / "posterior.nc")
    np.testing.assert_array_equal(read.values, given.values)
    np.testing.assert_array_equal(read.end, given.end)
    assert (read.data, read.efficiency) == ("0123456789abcdef", 0.8)


def test_a_file_without_log_likelihood_is_refused(posterior, space, tmp_path):
    inference_data.write_inference_data(tmp_path / "posterior.nc", posterior, space)
    (tmp_path / "text.nc").write_text("no draws")
    for name in ("posterior.nc", "text.nc"):
        with pytest.raises(ValueError, match=f"{name}: no log-likelihood in it"):
            inference_data.read_blocks(tmp_path / name)


def test_without_arviz_the_error_says_how_to_install_it(posterior, space, monkeypatch):
    monkeypatch.setattr(inference_data, "PACKAGES", ("no_such_package",))
    with pytest.raises(ImportError, match=r'pip install "jaxik\[posterior\]"'):
        posterior.to_inference_data(space)
