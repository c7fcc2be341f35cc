"""Draws of a posterior run through their clips: likelihoods of blocks, predictive checks, bands."""

import dataclasses
import json

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

import jaxik
from fitting.analysis import playback
from fitting.experiments import experiment_files, problems
from fitting.inference.noise.model import noise_of, with_noise
from fitting.inference.sampling.blocks import LeaveOneOut
from fitting.inference.sampling.posterior import Posterior
from fitting.problem import residuals, simulation
from fitting.problem.loss import apply_loss
from fitting.problem.problem import Problem
from fitting.problem.scene import Scene, legs_ws, pelvis_ws
from fitting.report.uncertainty import band_plots, predictive
from fitting.studies.posterior import likelihoods
from fitting.studies.posterior.replay import Replay, replay
from fitting.studies.posterior.replay_summary import summarise_replay
from support.experiments import write

TRUTH = np.array([0.7, -1.2])
KINDS = ("ankle", "knee", "pelvis", "foot")


@pytest.fixture(scope="module")
def problem(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    """A second of the uneven walk with noise of a known truth."""
    path = write(tmp_path_factory.mktemp("replay"))
    loaded = problems.make_problem(experiment_files.load_experiment(path))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulation, "_motions", motions)
        return simulation.simulate(loaded, TRUTH, seed=3)


def motions(ik: jaxik.FootIK, scenes: tuple[Scene, ...]) -> list[simulation.Motion]:
    """As in a simulation, by the program that a replay needs as well."""
    ((scene, result),) = zip(scenes, playback.run_all(ik, scenes), strict=True)
    legs, contact = legs_ws(scene, result), playback.stage_outputs(result).sensed.contact
    return [(pelvis_ws(scene, result), legs.knee.pos, legs.ankle, contact.weight)]


def posterior_of(problem: Problem, draws: int = 60) -> Posterior:
    """Normal draws close to the truth."""
    u = TRUTH + 0.01 * np.random.default_rng(0).normal(size=(draws // 4, 4, 2))
    values = [np.asarray(problem.space.values(jnp.asarray(row))) for row in u.reshape(-1, 2)]
    return Posterior(
        names=problem.space.names,
        u=u,
        log_probability=np.zeros(u.shape[:2]),
        values=np.reshape(values, u.shape),
        thin_by=1,
        burn_in=0,
        autocorrelation_time=np.ones(2),
        acceptance=np.full(4, 0.3),
        isolated=[],
        stuck=[],
        converged=True,
        message="Converged.",
        seconds=1.0,
    )


@pytest.fixture(scope="module", autouse=True)
def half_seconds():
    """Two blocks in a clip of a second."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(likelihoods, "SECONDS", 0.5)
        yield


def plain_residuals(problem: Problem, u: Array) -> Array:
    """Before the loss, one kind after another."""
    (scene,) = problem.data
    errors = residuals.errors_by_kind(scene, playback.run(problem.space.unpack(u), scene))
    of_kinds = residuals.residuals_by_kind(scene, errors).values()
    return jnp.concatenate([of_kind.ravel() for of_kind in of_kinds])


@pytest.fixture(scope="module")
def replayed(problem: Problem) -> Replay:
    return replay(problem, posterior_of(problem), seed=0)


def surprises(problem: Problem, **noise) -> dict[str, list[str]]:
    """What of the problem's capture is unlike replicates, perhaps with another noise, by kind."""
    problem = with_noise(problem, dataclasses.replace(noise_of(problem), **noise))
    checks = replay(problem, posterior_of(problem), seed=0).checks
    return {check.kind: check.surprises for check in checks}


def test_a_capture_with_the_assumed_noise_is_like_its_replicates(replayed):
    assert [check.kind for check in replayed.checks] == list(KINDS)
    assert [check.surprises for check in replayed.checks] == [[]] * len(KINDS)
    for check in replayed.checks:
        assert 0.8 < check.rms.median < 1.2
    assert "is like the posterior's replicates" in predictive.sentence(replayed.checks)


def test_other_noise_is_found_out_kind_by_kind(problem):
    sigmas = noise_of(problem).sigmas
    found = surprises(problem, sigmas={**sigmas, "knee": 3 * sigmas["knee"]})
    assert "size" in found["knee"] and found["pelvis"] == []
    correlated = surprises(problem, correlations={kind: 0.9 for kind in sigmas})
    assert all("autocorrelation" in names for names in correlated.values())


def test_an_outlier_is_found_out(problem):
    knees = problem.data[0].reference.knee_ws.at[20, 0, 1].add(0.4)
    spoilt = eqx.tree_at(lambda p: p.data[0].reference.knee_ws, problem, knees)
    checks = replay(spoilt, posterior_of(problem), seed=0).checks
    found = {check.kind: check for check in checks}
    assert found["knee"].surprises[-1] == "largest residual"
    assert found["ankle"].surprises == []
    text = predictive.sentence(checks)
    assert text.startswith("The captured motion is unlike") and "knee position" in text
    heavy = dataclasses.replace(spoilt, loss="student", tails=jnp.asarray(4.0))
    assert "largest residual" not in surprises(heavy)["knee"]


@pytest.mark.parametrize("loss", ["squares", "student"])
@pytest.mark.parametrize(("correlation", "fraction"), [(0.0, 1.0), (0.6, 1.0), (0.0, 0.2)])
def test_blocks_have_the_likelihood_that_the_fit_has(problem, loss, correlation, fraction):
    """The sum over blocks is minus the cost without the prior, up to a constant."""
    problem = dataclasses.replace(problem, loss=loss)
    problem = eqx.tree_at(
        lambda p: (p.data[0].sigmas.correlation, p.independent_fraction),
        problem,
        (jnp.asarray(correlation), jnp.asarray(fraction)),
    )
    posterior = posterior_of(problem, draws=8)
    blocks = replay(problem, posterior, seed=0).blocks
    rows = jnp.asarray(posterior.kept_u.reshape(-1, 2))
    plain = [plain_residuals(problem, row) for row in rows]
    squares = [float(jnp.sum(apply_loss(each, loss, problem.tails) ** 2)) for each in plain]
    costs = 0.5 * fraction * np.array(squares)
    constants = blocks.values.sum(axis=1) + costs
    np.testing.assert_allclose(constants, constants[0], rtol=1e-9)
    if (loss, correlation, fraction) == ("squares", 0.0, 1.0):
        (scene,) = problem.data
        frames, legs = scene.reference.knee_ws.shape[:2]
        counts = {"ankle": 3 * legs, "knee": 3 * legs, "pelvis": 3, "foot": 3 * legs}
        each = [
            -count * (np.log(float(getattr(scene.sigmas, kind))) + 0.5 * np.log(2 * np.pi))
            for kind, count in counts.items()
        ]
        assert constants[0] == pytest.approx(frames * sum(each))


def test_sigmas_of_the_draws_count_in_the_likelihood(problem, replayed):
    posterior = posterior_of(problem)
    count = posterior.kept_u.shape[0] * posterior.kept_u.shape[1]
    doubled = {kind: np.full(count, 2 * sigma) for kind, sigma in noise_of(problem).sigmas.items()}
    other = replay(problem, dataclasses.replace(posterior, sigmas=doubled), seed=0)
    assert other.blocks.values.sum() < replayed.blocks.values.sum()
    for check, before in zip(other.checks, replayed.checks, strict=True):
        assert check.rms.median == pytest.approx(0.5 * before.rms.median)
        assert "size" in check.surprises


def test_blocks_last_their_time_and_say_when(replayed):
    blocks = replayed.blocks
    assert blocks.values.shape == (60, 2) and blocks.clip.tolist() == [1, 1]
    assert blocks.start.tolist() == pytest.approx([0.0, 0.5])
    assert blocks.end.tolist() == pytest.approx([0.5, 1.0])


def test_blocks_without_any_observed_frame_are_left_out(problem):
    observed = problem.data[0].reference.observed.at[15:].set(False)
    masked = eqx.tree_at(lambda p: p.data[0].reference.observed, problem, observed)
    found = replay(masked, posterior_of(problem, draws=8), seed=0)
    assert found.blocks.values.shape[1] == 1
    assert np.isnan(found.bands[0].captured[15:]).all()


def test_the_digest_is_that_of_the_captured_motion(problem):
    wider = eqx.tree_at(lambda p: p.data[0].sigmas.knee, problem, jnp.asarray(0.5))
    without = eqx.tree_at(lambda p: p.data[0].sigmas.knee, problem, jnp.asarray(np.inf))
    other = eqx.tree_at(lambda p: p.data[0].reference.knee_ws, problem, replace_fn=lambda x: x + 1)
    digests = [likelihoods.digest(each) for each in (problem, wider, without, other)]
    assert digests[0] == digests[1]
    assert len(set(digests)) == 3


def test_bands_hold_the_capture_and_are_drawn(replayed):
    channels = ["left, upwards", "left, upwards", "upwards"]
    assert [band.channel for band in replayed.bands[:3]] == channels
    assert all(band.outside < 0.15 for band in replayed.bands)
    figure = band_plots.bands(replayed.bands, "bands")
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles[2].startswith("pelvis position, upwards: ") and len(titles) == len(KINDS)


def test_the_summary_is_plain_json(replayed):
    of_blocks = {"elpd_of_block": np.array([-1.0, -2.0]), "pareto_k": np.array([0.1, np.inf])}
    left_out = LeaveOneOut(-3.0, 0.5, 1.2, max_k=0.6, neighbours=np.nan, **of_blocks)
    text = json.dumps(summarise_replay(replayed, left_out), allow_nan=False)
    numbers = json.loads(text)
    assert [row["pareto_k"] for row in numbers["leave_one_out"]["blocks"]] == [0.1, None]
    assert left_out.unreliable == 1
    assert [row["kind"] for row in numbers["predictive_checks"]] == list(KINDS)
    assert 0 <= numbers["predictive_checks"][0]["rms"]["p"] <= 1
    assert summarise_replay(None, None) == {"predictive_checks": None, "leave_one_out": None}
