"""What a posterior predicts: draws run through their clips, and runs compared by likelihoods."""

import dataclasses
import json
import re
from pathlib import Path

import equinox as eqx
import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

import jaxik
from fitting.cli import main
from fitting.experiment import experiment_files, problems
from fitting.inference.noise import noise_of, with_noise
from fitting.inference.sample import blocks
from fitting.inference.sample.blocks import BlockLogLikelihood, LeaveOneOut
from fitting.inference.sample.posterior import Posterior
from fitting.motion import playback
from fitting.problem import residuals, simulation
from fitting.problem.problem import Problem, apply_loss
from fitting.problem.scene import Scene, legs_ws, pelvis_ws
from fitting.report import pages
from fitting.studies.fit import run_folder
from fitting.studies.sample import posterior_report
from fitting.studies.sample import replay as sample_replay
from fitting.studies.sample.replay import Replay, replay
from fitting.studies.sample.sample_jobs import compare_posteriors, summarise_replay
from support.commands import refusal
from support.experiments import write
from support.pages import Page
from support.problems import posterior_of
from support.small_studies import HALF_SECOND

TRUTH = np.array([0.7, -1.2])
KINDS = ("ankle", "knee", "pelvis", "foot")


@pytest.fixture(scope="module")
def problem(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    """Half a second of the uneven walk with noise of a known truth."""
    path = write(tmp_path_factory.mktemp("replay"), top='loss = "squares"', clips=HALF_SECOND)
    loaded = problems.make_problem(experiment_files.load_experiment(path))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulation, "_motions", motions)
        return simulation.simulate(loaded, TRUTH, seed=3)


def motions(ik: jaxik.FootIK, scenes: tuple[Scene, ...]) -> list[simulation.Motion]:
    """As in a simulation, by the program that a replay needs as well."""
    ((scene, result),) = zip(scenes, playback.run_all(ik, scenes), strict=True)
    legs, contact = legs_ws(scene, result), playback.stage_outputs(result).sensed.contact
    return [(pelvis_ws(scene, result), legs.knee.pos, legs.ankle, contact.weight)]


def draws_near_the_truth(problem: Problem, draws: int = 60) -> Posterior:
    u = TRUTH + 0.01 * np.random.default_rng(0).normal(size=(draws // 4, 4, 2))
    values = [np.asarray(problem.space.values(jnp.asarray(row))) for row in u.reshape(-1, 2)]
    return posterior_of(problem.space.names, u, np.reshape(values, u.shape))


@pytest.fixture(scope="module", autouse=True)
def short_blocks():
    """Two blocks in a clip of half a second."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sample_replay, "SECONDS", 0.25)
        yield


@pytest.fixture(scope="module")
def replayed(problem: Problem) -> Replay:
    return replay(problem, draws_near_the_truth(problem), seed=0)


def surprises(problem: Problem, **noise) -> dict[str, list[str]]:
    """What of the problem's capture is unlike replicates, perhaps with another noise, by kind."""
    problem = with_noise(problem, dataclasses.replace(noise_of(problem), **noise))
    checks = replay(problem, draws_near_the_truth(problem), seed=0).checks
    return {check.kind: check.surprises for check in checks}


# Predictive checks


@pytest.mark.slow
def test_a_capture_with_the_assumed_noise_is_like_its_replicates(replayed):
    assert [check.kind for check in replayed.checks] == list(KINDS)
    assert [check.surprises for check in replayed.checks] == [[]] * len(KINDS)
    for check in replayed.checks:
        assert 0.8 < check.rms.median < 1.2
    assert "is like the posterior's replicates" in posterior_report.predictive_sentence(
        replayed.checks
    )


@pytest.mark.slow
def test_other_noise_is_found_out_kind_by_kind(problem):
    sigmas = noise_of(problem).sigmas
    of_kinds = surprises(problem, sigmas={**sigmas, "knee": 3 * sigmas["knee"]})
    assert "size" in of_kinds["knee"] and of_kinds["pelvis"] == []
    correlated = surprises(problem, correlations={kind: 0.9 for kind in sigmas})
    assert all("autocorrelation" in names for names in correlated.values())


@pytest.mark.slow
def test_an_outlier_is_found_out(problem):
    knees = problem.data[0].reference.knee_ws.at[10, 0, 1].add(0.2)
    spoilt = eqx.tree_at(lambda p: p.data[0].reference.knee_ws, problem, knees)
    checks = replay(spoilt, draws_near_the_truth(problem), seed=0).checks
    of_kinds = {check.kind: check.surprises for check in checks}
    assert of_kinds["knee"][-1] == "largest residual" and of_kinds["ankle"] == []
    text = posterior_report.predictive_sentence(checks)
    assert text.startswith("The captured motion is unlike") and "knee position" in text
    of_two = [*checks, *(dataclasses.replace(check, clip=1) for check in checks)]
    assert (
        "knee position of clip 2 (" in posterior_report.predictive_sentence(of_two)
        and " of clip " not in text
    )
    heavy = dataclasses.replace(spoilt, loss="student", tails=jnp.asarray(4.0))
    assert "largest residual" not in surprises(heavy)["knee"]


@pytest.mark.slow
def test_bands_hold_the_capture_and_are_drawn(replayed):
    channels = ["left, upwards", "left, upwards", "upwards"]
    assert [band.channel for band in replayed.bands[:3]] == channels
    assert all(band.outside < 0.15 for band in replayed.bands)
    figure = posterior_report.bands(replayed.bands, "bands")
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles[2].startswith("pelvis position, upwards: ") and len(titles) == len(KINDS)


# Likelihoods of blocks


def plain_residuals(problem: Problem, u: Array) -> Array:
    """Before the loss, one kind after another."""
    (scene,) = problem.data
    return plain_residuals_of(scene, playback.run(problem.space.unpack(u), scene))


@jax.jit
def plain_residuals_of(scene: Scene, result: jaxik.Result) -> Array:
    of_kinds = residuals.residuals_by_kind(scene, residuals.errors_by_kind(scene, result))
    return jnp.concatenate([of_kind.ravel() for of_kind in of_kinds.values()])


@pytest.mark.parametrize("loss", ["squares", "student"])
@pytest.mark.parametrize(("correlation", "fraction"), [(0.0, 1.0), (0.6, 1.0), (0.0, 0.2)])
def test_blocks_have_the_likelihood_that_the_fit_has(problem, loss, correlation, fraction):
    """The sum over blocks is minus the cost without the prior, up to a constant."""
    problem = dataclasses.replace(problem, loss=loss)
    problem = eqx.tree_at(
        lambda p: (p.data[0].sigmas.correlation, p.weight),
        problem,
        (jnp.full(6, correlation), jnp.asarray(fraction)),
    )
    posterior = draws_near_the_truth(problem, draws=8)
    values = replay(problem, posterior, seed=0).blocks.values
    plain = [plain_residuals(problem, row) for row in jnp.asarray(posterior.draws_u.reshape(-1, 2))]
    squares = [float(jnp.sum(apply_loss(each, loss, problem.tails) ** 2)) for each in plain]
    constants = values.sum(axis=1) + 0.5 * fraction * np.array(squares)
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


@pytest.mark.slow
def test_sigmas_of_the_draws_count_in_the_likelihood(problem, replayed):
    posterior = draws_near_the_truth(problem)
    count = posterior.draws_u.shape[0] * posterior.draws_u.shape[1]
    doubled = {kind: np.full(count, 2 * sigma) for kind, sigma in noise_of(problem).sigmas.items()}
    other = replay(problem, dataclasses.replace(posterior, sigmas=doubled), seed=0)
    assert other.blocks.values.sum() < replayed.blocks.values.sum()
    for check, before in zip(other.checks, replayed.checks, strict=True):
        assert check.rms.median == pytest.approx(0.5 * before.rms.median)
        assert "size" in check.surprises


def test_blocks_last_their_time_and_those_without_any_observed_frame_are_left_out(
    problem, replayed
):
    of_blocks = replayed.blocks
    assert of_blocks.values.shape == (60, 2) and of_blocks.clip.tolist() == [1, 1]
    assert of_blocks.start.tolist() == pytest.approx([0.0, 0.25], abs=1 / 30)
    assert of_blocks.end.tolist() == pytest.approx([0.25, 0.5], abs=1 / 30)
    observed = problem.data[0].reference.observed.at[7:].set(False)
    masked = eqx.tree_at(lambda p: p.data[0].reference.observed, problem, observed)
    half = replay(masked, draws_near_the_truth(problem, draws=8), seed=0)
    assert half.blocks.values.shape[1] == 1
    assert np.isnan(half.bands[0].captured[7:]).all()


def test_the_digest_is_that_of_the_captured_motion(problem):
    wider = eqx.tree_at(lambda p: p.data[0].sigmas.knee, problem, jnp.asarray(0.5))
    without = eqx.tree_at(lambda p: p.data[0].sigmas.knee, problem, jnp.asarray(np.inf))
    other = eqx.tree_at(lambda p: p.data[0].reference.knee_ws, problem, replace_fn=lambda x: x + 1)
    digests = [sample_replay.digest(each) for each in (problem, wider, without, other)]
    assert digests[0] == digests[1]
    assert len(set(digests)) == 3


def test_the_summary_is_plain_json(replayed):
    of_blocks = {"elpd_of_block": np.array([-1.0, -2.0]), "pareto_k": np.array([0.1, np.inf])}
    left_out = LeaveOneOut(-3.0, 0.5, 1.2, max_k=0.6, neighbours=np.nan, **of_blocks)
    numbers = json.loads(json.dumps(summarise_replay(replayed, left_out), allow_nan=False))
    assert [row["pareto_k"] for row in numbers["leave_one_out"]["blocks"]] == [0.1, None]
    assert left_out.unreliable == 1
    assert [row["kind"] for row in numbers["predictive_checks"]] == list(KINDS)
    assert 0 <= numbers["predictive_checks"][0]["rms"]["p"] <= 1
    assert summarise_replay(None, None) == {"predictive_checks": None, "leave_one_out": None}


# Runs compared by what they predict of the same motion

GOOD = np.array([-3.0, -2.0, -4.0, -3.5, -2.5, -3.0])
LOSS = np.array([1.0, 1.5, 0.5, 1.2, 0.8, 1.0])  # of the other system, block by block
NANS = np.full((1, 200, 6), np.nan)  # in place of the log-likelihoods of draws and blocks


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """Runs without a fit; b predicts better than a."""
    pytest.importorskip("arviz_stats")
    monkeypatch.setattr(run_folder, "load_fit", lambda folder: None)
    monkeypatch.chdir(tmp_path)
    write_run(Path("a"), GOOD - LOSS)
    write_run(Path("b"), GOOD)
    return tmp_path


def write_run(folder: Path, level: np.ndarray, data: str = "aaaa", draws: int = 200) -> None:
    """A sampled run whose blocks have this log-likelihood, within 0.1."""
    folder.mkdir()
    values = level + 0.1 * np.random.default_rng(0).normal(size=(draws, len(level)))
    clip = np.array([1, 1, 1, 1, 2, 2])
    start = np.array([0.0, 1.0, 2.0, 3.0, 0.0, 1.0])
    of_run = BlockLogLikelihood(values, clip, start, start + 1.0, data, 1.0)
    blocks.to_tree(of_run).to_netcdf(folder / run_folder.INFERENCE_DATA, engine="h5netcdf")


def test_the_run_that_predicts_better_comes_first_with_the_difference(folder):
    first, second = compare_posteriors([Path("a"), Path("b")])
    assert (first.name, second.name) == ("b", "a")
    assert first.elpd == pytest.approx(GOOD.sum(), abs=0.1)
    assert (first.behind, first.behind_error) == (0.0, 0.0)
    assert second.behind == pytest.approx(LOSS.sum(), abs=0.01)
    assert second.behind_error == pytest.approx(np.sqrt(6) * LOSS.std(ddof=1), rel=0.01)
    assert second.error > second.behind_error  # what blocks share does not count
    assert sum(first.clips.values()) == pytest.approx(first.elpd)
    assert first.clips[2] == pytest.approx(GOOD[4:].sum(), abs=0.1)


def test_the_command_prints_and_writes_the_table(folder, capsys):
    assert main.main(["compare", "--runs", "a,b", "-o", "compared"]) == 0
    lines = capsys.readouterr().out.splitlines()
    (heading,) = (number for number, line in enumerate(lines) if line.startswith("run "))
    assert "elpd of clip 2" in lines[heading]
    assert lines[heading + 2].startswith("b ") and lines[heading + 3].startswith("a ")
    text = Path("compared/runs.md").read_text()
    assert "| a | " in text and "expected log predictive density" in text
    page = Page(Path("compared") / pages.PAGE)
    assert "b predicts best; a is 6.0 ± 0.8 below." in page.text
    rows = json.loads(Path("compared/runs.json").read_text())
    assert [row["name"] for row in rows] == ["b", "a"]
    assert main.main(["compare", "--runs", "a,b"]) == 0
    assert "written" not in capsys.readouterr().out


def test_runs_that_cannot_be_compared_are_refused(folder, capsys):
    write_run(Path("other"), GOOD, data="bbbb")
    write_run(Path("few"), GOOD, draws=50)
    Path("none").mkdir()
    for words, message in (
        ("--runs a", "wanted two or more different ones"),
        ("--runs a,a", "wanted two or more different ones"),
        ("--runs a,other", "a and other were fitted to different motion"),
        ("--runs a,few", "few: 50 draws of 6 blocks"),
        ("--runs a,none", "none: no posterior.nc; `jaxik sample none` makes it"),
        ("--runs a,b --presets ozz", "--presets and --runs exclude each other"),
        ("walk.bvh --runs a,b", "CLIP is walk.bvh; runs are compared on the clips of"),
        ("--runs a,b --suite", "--runs and --suite exclude each other"),
    ):
        assert message in refusal(["compare", *words.split()], folder, capsys)


def test_a_damaged_log_likelihood_is_named(folder, capsys):
    path = folder / "b" / run_folder.INFERENCE_DATA
    whole = path.read_bytes()

    def check(message: str) -> None:
        line = refusal(["compare", "--runs", "a,b"], folder, capsys)
        assert "b/posterior.nc" in line and re.search(message, line), line

    for content in (b"", bytes(range(256)) * 8, whole[:-999]):
        path.write_bytes(content)
        check("no log-likelihood in it")
    for change, message in (
        (lambda file: file.pop("log_likelihood"), "Could not find node"),
        (lambda file: file["log_likelihood"].pop("clip"), "in it: .*clip"),
        (lambda file: file["log_likelihood/motion"].write_direct(NANS), "that are not finite"),
        (lambda file: file.attrs.create("format", 9), "format is 9"),
        (lambda file: file.attrs.create("format", "x"), "in it"),
    ):
        path.write_bytes(whole)
        with h5py.File(path, "a") as file:
            change(file)
        check(message)
