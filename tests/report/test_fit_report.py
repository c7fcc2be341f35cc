"""Reports of fits and posteriors: numbers in texts and tables, and the plots that they link."""

import base64
import html
import json
import math
import re
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from xml.etree import ElementTree

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from fitting.experiment import experiment_files, problems
from fitting.experiment.experiment import ClipEntry, Experiment
from fitting.experiment.problems import ClipData, make_scene
from fitting.inference.identifiability import Identifiability
from fitting.inference.noise import NoiseOptions
from fitting.inference.optimise.solution import Progress, Solution
from fitting.inference.sample import blocks
from fitting.inference.sample.modes import Mode
from fitting.inference.sample.posterior import Posterior
from fitting.motion import goodness, playback
from fitting.problem import residuals
from fitting.problem.problem import Problem
from fitting.problem.space import ParameterPrior, Priors, Space, make_space
from fitting.report import document, pages
from fitting.report.document import Grid, Section, Text
from fitting.report.formatting import markdown
from fitting.runtime import display
from fitting.studies.fit import fit_report, fit_tables, run_folder
from fitting.studies.fit.capture_check import CaptureSigns, GroundOffset
from fitting.studies.fit.fit import Fit
from fitting.studies.sample import posterior_report, sample_jobs
from fitting.studies.sample.sample import SampledFit
from fitting.synthetic import walker
from jaxik.maths import parameter_tree
from jaxik.world import terrain
from support import runs, toy
from support.experiments import write
from support.pages import Page
from support.problems import posterior_of, problem_of
from support.profiles import parabolas

VALUES = {"contact.planted_height": 0.11, "pelvis.half_life": 0.3, "leg.soften": 0.95}
TRUTH = """
preset = "record"
faithful = true
contact.planted_height = 0.10
pelvis = { half_life = 0.5, vertical_only = true }
probe.toe_ls = [0.0, -0.07, 0.2]
noise.ankle = 0.01
"""
CLIP_PLOTS = ("motion", "side_view", "moments", "knees", "residuals", "locks", "noise")
SIGMAS = {"ankle": 0.02, "pelvis": 0.03, "foot": 0.1, "contact": 0.5, "smooth": 20.0}
SIGMAS |= {"knee": 0.03, "body": 0.2, "correlation": 0.4}


@pytest.fixture(scope="module")
def experiment(tmp_path_factory) -> Experiment:
    folder = tmp_path_factory.mktemp("experiment")
    (folder / "truth.toml").write_text(TRUTH)
    entry = ClipEntry(folder / "walk.npz", folder / "slope.ply", truth=folder / "truth.toml")
    path, free = folder / "hill.toml", {name: {} for name in VALUES}
    return Experiment(path, (replace(entry, truth=None), entry), free, name="hill", faithful=True)


@pytest.fixture(scope="module")
def fitted(experiment) -> Fit:
    """A two-second walk uphill with an invented fit; no search has run."""
    clip = walker.walk(seconds=2.0, fps=15.0)
    ground = terrain.plane(point=(0.0, 0.02, 0.0), normal=(0.1, 1.0, -0.3))
    ik = experiment.starting_system()
    space = make_space(ik, experiment.free_parameters(ik))
    scene = make_scene(ClipData(clip, clip, ground), SIGMAS)
    problem = Problem(space, (scene,), residuals.residuals_of_scenes)
    u = np.asarray(space.pack(VALUES))
    history = [Progress("start", 0, 0, 900.0, 900.0, 1.0)]
    history += [Progress("blocks", 0, i, 800.0 / i, 800.0 / i, 1.0 + i) for i in range(1, 9)]
    solution = Solution(
        names=space.names,
        u=u,
        values=np.asarray(space.values(jnp.asarray(u))),
        cost_before=900.0,
        cost=100.0,
        converged=False,
        message="Not converged: the 8 steps allowed for a start were used up.",
        jacobian=np.zeros((1, 3)),
        history=tuple(history),
        steps=8,
        seconds=9.0,
    )
    identifiability = Identifiability(
        names=space.names,
        contraction=np.array([0.99, 0.97, 0.1]),
        profiles=parabolas(space.parameters, [(0.10, 0.12), (0.2, 0.4), (0.85, 1.05)]),
        sd=np.array([np.nan, 0.1, 1.5]),
        at_bound=("", "", "high"),
        eigenvalues=np.array([0.1, 20.0]),
        weakest=("leg.soften",),
        correlated=(("pelvis.half_life", "leg.soften", -0.93),),
        ridges=(),
        best_u=u,
        best_cost=99.75,
        improvement=0.25,
    )
    known = problems.load_known_values(experiment)
    return Fit(experiment, problem, solution, identifiability, known)


@pytest.fixture(scope="module")
def twice(fitted) -> Fit:
    return replace(fitted, problem=replace(fitted.problem, data=fitted.problem.data * 2))


def line_of(text: str, name: str) -> str:
    return next(line for line in text.splitlines() if line.strip("| ").startswith(name))


def test_known_values_are_those_of_the_first_clip_that_has_any(experiment, tmp_path):
    values = {"contact.planted_height": 0.10, "pelvis.half_life": 0.5}
    values |= {"probe.toe_ls": pytest.approx(0.13 / 3)}
    values |= {"probe.toe_ls[0]": 0.0, "probe.toe_ls[1]": -0.07, "probe.toe_ls[2]": 0.2}
    assert problems.load_known_values(experiment) == values
    assert problems.load_known_values(replace(experiment, clips=experiment.clips[:1])) is None
    one_leg = replace(experiment, free={"pelvis.half_life[1]": {}})
    assert (problems.load_known_values(one_leg) or {})["pelvis.half_life[1]"] == 0.5
    (tmp_path / "broken.toml").write_text("contact = [")
    broken = replace(experiment.clips[0], truth=tmp_path / "broken.toml")
    with pytest.raises(ValueError, match=r"broken\.toml: not TOML"):
        problems.load_known_values(replace(experiment, clips=(broken,)))


def test_the_text_of_a_fit_has_values_truth_bounds_and_undetermined_parameters(fitted, experiment):
    text = fit_report.fit_text(fitted)
    assert text.startswith("Worse.\n") and fitted.verdict.sentence in text
    assert "Not converged: the 8 steps" in text
    assert "Cost 900 before, 100 after: 8 steps" in text
    distance = goodness.size("ankle", fitted.distances.parts["fitted"]["fitted"]["ankle"])
    assert re.split(r"\s{2,}", line_of(text, "ankles  "))[1::3] == ["fitted", distance]
    # 0.11 against 0.10 in a range from 0 to 0.4; 0.3 against 0.5 in one from 0.002 to 0.5.
    planted = line_of(text, "contact.planted_height")
    assert "0.11 " in planted and "2.5 % of range" in planted and "0.1 to 0.12" in planted
    assert "40.2 % of range" in line_of(text, "pelvis.half_life")
    soften = line_of(text, "leg.soften")
    assert "at least 0.85" in soften and "at its upper bound" in soften
    assert "unknown" in soften
    assert "\n1 of 2 determined parameters within 5 % of their range.\n" in text
    whitened = replace(experiment, noise=NoiseOptions(correlation="whitened"))
    text = fit_report.fit_text(replace(fitted, known_values=None, experiment=whitened))
    assert "100 after (both with the noise estimated here)" in text
    assert "truth" not in text and "determined parameters within" not in text


def test_what_the_fit_has_made_worse_is_the_first_sentence(fitted):
    text = fit_report.fit_text(fitted)
    assert ("Worse" in text) == bool(fitted.distances.setbacks) == fitted.is_worse
    worse, tolerated = replace(fitted), replace(fitted, has_noise=False)
    near, far = dict.fromkeys(goodness.CLOSE, 0.001), dict.fromkeys(goodness.CLOSE, 0.019)
    motions: Any = {"animation": near, "before": near, "fitted": far}
    for each in (worse, tolerated):
        vars(each)["distances"] = goodness.Distances({"held_out": motions})
    lines = fit_report.fit_text(worse).split("\n\n")
    assert lines[0] == "Worse."  # though it has not converged, either
    assert lines[1].startswith("- Worse: ") and "off the capture in held-out frames" in lines[1]
    assert "\n\n".join(lines).count("Worse: ") == 1
    assert "Worse" not in fit_report.fit_text(tolerated)


def test_the_table_of_priors_has_shape_centre_spread_and_both_intervals(fitted):
    named = {"leg.soften": ParameterPrior("uniform")}
    space = fitted.problem.space.with_prior(Priors(ParameterPrior(spread=0.5), named))
    problem = Problem(space, fitted.problem.data, residuals.residuals_of_scenes)
    rows = replace(fitted, problem=problem).summary["parameters"]
    planted = rows[0]
    centre = planted["prior"]["centre"]
    assert centre is not None and centre == pytest.approx(planted["before"])
    u = np.log(centre / (0.4 - centre)) + 0.98 * np.array([-1, 1])  # 1.96 spreads of 0.5
    np.testing.assert_allclose(planted["prior"]["interval"], 0.4 / (1 + np.exp(-u)), 1e-4)
    text = "\n".join(document.markdown([fit_tables.prior_section(rows)]))
    low, high = planted["prior"]["interval"]
    assert line_of(text, "contact.planted_height") == (
        f"| contact.planted_height | m | normal | {centre:.4g} | 0.5 | {low:.4g} to {high:.4g} "
        "| 0.1 to 0.12 |"
    )
    assert "| uniform |  |  | 0.805 to 0.995 |" in line_of(text, "leg.soften")  # of 0.8 to 1
    section = fit_tables.prior_section(fitted.summary["parameters"])
    text = "\n".join(document.markdown([section]))
    assert "| normal | 0.9667 (system: 1) | 1.6 |" in line_of(text, "leg.soften")
    assert "| normal | 0.1 | 1.6 |" in line_of(text, "contact.planted_height")


@pytest.mark.slow
def test_a_run_gets_a_summary_and_every_plot_that_it_links(fitted, tmp_path, monkeypatch):
    sizes = []

    def savefig(figure: Figure, path: Path, **_: object) -> None:  # drawing takes long
        sizes.append(100 * figure.get_size_inches())  # pixels
        path.write_bytes(b"")

    monkeypatch.setattr(Figure, "savefig", savefig)
    opening, details = (Section(name, [Text("Text.")]) for name in ("Opening", "Details"))
    fit_report.write_fit(tmp_path, fitted, [opening], [details])
    text = (tmp_path / run_folder.SUMMARY).read_text()
    for name, following in (("Opening", "Goodness of fit"), ("Details", "Pictures")):
        assert f"\n## {name}\n\nText.\n\n## {following}\n" in text
    names = [line.rpartition("(")[2].rstrip(")") for line in text.splitlines() if line[:2] == "!["]
    plots = {*CLIP_PLOTS, "cost", "worst", "profiles"}
    assert set(names) == {f"{plot}.png" for plot in plots}
    assert {path.name for path in tmp_path.iterdir()} == {
        *names, run_folder.SUMMARY, pages.PAGE, document.STORED,
    }  # fmt: skip
    assert len(sizes) == len(plots)
    assert all(1000 < width < 2000 and 400 < height < 2500 for width, height in sizes)
    assert "| contact.planted_height | 0.11 | m |" in text
    assert "| contact.planted_height | m | normal | " in text.split("## Priors")[1]
    assert "Not determined: `leg.soften`." in text
    assert fitted.verdict.sentence in text.split("## Opening")[0]
    assert "`pelvis.half_life` and `leg.soften`: -0.930" in text
    assert "| leg.soften | smooth | at least 0.85 | 0.85 to 1 | 0.100 |" in text
    nudges = playback.nudge_thresholds(fitted.problem, fitted.solution.u)
    down, up = nudges["contact.planted_height"]
    nudged = line_of(text.split("threshold moves")[1], "contact.planted_height")
    for nudge in (down, up):
        assert f"| {100 * nudge.flipped:.2f} % | {nudge.rise:+.1f} |" in nudged
    (activity,) = playback.measure_activity(fitted.ik, fitted.problem.data, fitted.results)
    fraction = f"{100 * activity.limits['pelvis.limit']:.1f} %"
    assert line_of(text, "pelvis.limit") == f"| pelvis.limit | {fraction} |"


def test_the_goodness_of_fit_has_a_row_for_each_kind_and_clip(fitted, twice):
    text = fit_report.fit_text(fitted)
    assert fitted.verdict.sentence in text
    group = next(group for group in fitted.groups if group.kind == "knee")
    cells = re.split(r"\s{2,}", line_of(text, "Knee position"))
    assert cells[1] == str(30 * 2 * 3) and cells[5] == "3 cm"
    assert float(cells[3]) == pytest.approx(group.left.mean_square, rel=1e-3)
    assert float(cells[6].removesuffix(" cm")) == pytest.approx(3 * group.plain.scale, rel=1e-3)
    assert re.split(r"\s{2,}", line_of(text, "Ankle acceleration"))[4] == "–", "is not tested"
    rows = fit_report.fit_text(twice).splitlines()
    assert sum("Knee position" in row and row[:1] in "12" for row in rows) == 2
    goodness = json.loads(json.dumps(fitted.summary["goodness"], allow_nan=False))
    assert goodness["sentence"] == fitted.verdict.sentence
    by_kind = {row["kind"]: row for row in goodness["groups"]}
    assert set(by_kind) == set(playback.RESIDUAL_KINDS)
    assert by_kind["ankle"]["correlation"] == 0.4 and by_kind["contact"]["p"] is None
    # What a translation leaves is measured in tolerances.
    of_source = replace(fitted, has_noise=False)
    assert of_source.verdict.sentence.startswith(("Not the same motion: ", "The same motion"))
    *_, tolerances = fit_tables.goodness_blocks(of_source)
    assert isinstance(tolerances, Grid) and "error, rms" in tolerances.rows[0]


def test_the_second_of_two_clips_has_its_own_plots(fitted, twice, tmp_path, undrawn):
    (after,) = fitted.playbacks
    plots = fit_report._draw_clip(tmp_path, twice, 1, after, after)
    captions = {plot.name: plot.caption for plot in plots}
    assert set(captions) == {f"{name}_2.png" for name in (*CLIP_PLOTS, "worst")}
    assert all(caption.startswith("hill, clip 2: ") for caption in captions.values())
    assert captions["worst_2.png"] == "hill, clip 2: the worst 1.9 seconds"


@pytest.mark.slow
def test_a_playback_has_the_residuals_of_the_fit_and_rebuilds_captured_joints(fitted):
    (scene,), (played,) = fitted.problem.data, fitted.playbacks
    assert played.fitted_kinds == list(playback.RESIDUAL_KINDS)
    shown = np.concatenate([np.ravel(played.residuals[kind]) for kind in playback.RESIDUAL_KINDS])
    expected = fitted.problem.residuals(jnp.asarray(fitted.solution.u))[:-3]  # without priors
    np.testing.assert_allclose(shown, expected, atol=1e-9)
    legs = walker.walk(seconds=2.0, fps=15.0).leg_pose_ws()
    np.testing.assert_allclose(played.captured.hip, legs.hip.pos, atol=1e-6)
    np.testing.assert_allclose(played.captured.toe, legs.toe.pos, atol=1e-6)
    span = np.linalg.norm(np.asarray(legs.hip.pos - legs.ankle.pos), axis=-1)
    thigh, shin = np.asarray(scene.rig.thigh), np.asarray(scene.rig.shin)
    cosine = (thigh**2 + shin**2 - span**2) / (2 * thigh * shin)
    np.testing.assert_allclose(np.cos(played.captured.knee_angle), cosine, atol=1e-6)


@pytest.mark.slow
def test_activity_counts_locks_releases_ground_and_limits_where_they_are_tight(fitted):
    (scene,) = fitted.problem.data

    def active(changed):
        ik = parameter_tree.replace(fitted.ik, changed)
        return playback.active_limits(ik, (scene,), (playback.run(ik, scene),))[0]

    values = {"pelvis.limit": 0.6, "leg.max_knee_angle": np.pi, "leg.min_knee_angle": 0.0}
    ends = active(values)
    assert [ends[name] for name in values] == [0.0, 0.0, 0.0]
    tight = active({"pelvis.limit": 0.0})
    assert tight["pelvis.limit"] > 0.7
    assert set(tight) >= {"foot.max_pitch", "foot.min_roll", "target.max_ankle_height"}
    assert not {"lock.max_speed", "pelvis.half_life"} & set(tight)
    (activity,) = playback.measure_activity(fitted.ik, fitted.problem.data, fitted.results)
    (result,) = fitted.results
    locked = np.asarray(playback.stage_outputs(result).advanced.state.lock.locked)
    assert activity.frames == 30 and activity.seconds == pytest.approx(2.0)
    assert activity.locks == tuple(int(n) for n in (np.diff(locked, axis=0) == 1).sum(axis=0))
    assert sum(activity.locks) > 0 and sum(activity.releases) > 0
    np.testing.assert_allclose(activity.locked, locked.mean(axis=0))
    ankle = np.asarray(walker.walk(seconds=2.0, fps=15.0).leg_pose_ws().ankle.pos)
    below = ankle[..., 1] + 0.5 - (0.02 - 0.1 * ankle[..., 0] + 0.3 * ankle[..., 2])
    np.testing.assert_allclose(activity.grounded, ((0 <= below) & (below <= 1.3)).mean(axis=0))
    assert activity.grounded.max() < 1.0, "the hill rises out of reach of the rays"


@pytest.mark.slow
def test_decisions_flip_where_ankles_are_between_the_thresholds(fitted):
    scene, space = fitted.problem.data[0], fitted.problem.space
    base = parameter_tree.replace(space.system, {"lock.enabled": False})
    unlocked = make_space(base, space.parameters)
    problem = Problem(unlocked, (scene,), residuals.residuals_of_scenes)
    u = np.asarray(unlocked.pack(VALUES))
    down, up = playback.nudge_thresholds(problem, u)["contact.planted_height"]
    lift = np.asarray(scene.frames.pose.ankle.pos[..., 1])
    # Of the four decisions per foot and frame, only `planted` depends on the threshold.
    assert down.flipped == pytest.approx(np.mean((0.07 < lift) & (lift <= 0.11)) / 4)
    assert up.flipped == pytest.approx(np.mean((0.11 < lift) & (lift <= 0.15)) / 4)
    assert down.flipped > 0 and up.flipped > 0
    lower = np.asarray(unlocked.pack(VALUES | {"contact.planted_height": 0.07}))
    wanted = float(problem.cost(lower) - problem.cost(u))  # ours has 32-bit floats
    assert down.rise == pytest.approx(wanted, rel=1e-5)


# Posteriors


def invented_posterior(stuck: list[int] | None = None) -> Posterior:
    """Normal draws around known values."""
    u = np.random.default_rng(0).normal(size=(120, 12, 3))
    values = np.array([0.105, 0.3, 0.9]) + u * np.array([0.005, 0.01, 0.02])
    chain = {"thin_by": 2, "burn_in": 20, "autocorrelation_time": np.array([2.0, 3.0, 4.0])}
    acceptance = np.full(12, 0.25)
    posterior = posterior_of(tuple(VALUES), u, values, stuck=stuck or [], **chain)
    return replace(posterior, acceptance=acceptance, message="Converged: the chain is long enough.")


def sampled_fit(fitted: Fit, posterior: Posterior, known: Any) -> SampledFit:
    rows, space = fitted.summary["parameters"], fitted.problem.space
    return SampledFit(fitted.experiment, space, rows, posterior, known)


def write_posterior(run: Path, fitted: Fit, posterior: Posterior) -> tuple[str, dict[str, Any]]:
    sampled = sampled_fit(fitted, posterior, fitted.known_values)
    sample_jobs.save_posterior(run, sampled)
    written = run / posterior_report.write_posterior(run, sampled)
    return written.read_text(), json.loads((run / run_folder.POSTERIOR).read_text())


def test_the_text_of_a_posterior_has_intervals_and_the_state_of_the_walkers(fitted):
    posterior = invented_posterior(stuck=[3])
    known = {"contact.planted_height": 0.106, "leg.soften": 0.8}
    text = posterior_report.posterior_text(sampled_fit(fitted, posterior, known))
    first = posterior.summary[0]
    line = line_of(text, "contact.planted_height")
    assert f"{first['median']:.4g}" in line and f"{first['low95']:.4g} to" in line
    assert line.endswith("yes")
    assert line_of(text, "leg.soften").endswith("no")
    assert f"{first['ess']:.0f}" in line and "2 steps" in line
    assert "12 walkers, 240 steps, the first 40 left out" in text
    assert "Mean acceptance 25.0 %" in text and "Stuck walkers: 3." in text
    assert "Converged: the chain is long enough." in text
    assert "The 95 % intervals contain the true values of 1 of 2 parameters; among" in text
    assert "truth" not in posterior_report.posterior_text(sampled_fit(fitted, posterior, None))


def test_a_posterior_is_written_after_the_fit_and_only_once(fitted, tmp_path, undrawn):
    fit_report.fit_document(fitted).write(tmp_path, stored=True)
    of_fit = (tmp_path / run_folder.SUMMARY).read_text().partition("\n## Setup\n")[0]
    text, _ = write_posterior(tmp_path, fitted, invented_posterior())
    assert write_posterior(tmp_path, fitted, invented_posterior())[0] == text
    assert text.startswith(f"{of_fit}\n## Posterior\n")
    covered = "of 1 of 2 parameters; among those that the fit calls determined, of 1 of 2."
    assert f"contain the true values {covered}" in text
    assert "| pelvis.half_life | s |" in text
    assert "(corner.png)" in text and "(chain.png)" in text


def test_a_posterior_stands_beside_its_prior(fitted, tmp_path, undrawn):
    posterior = invented_posterior()
    text, numbers = write_posterior(tmp_path, replace(fitted, known_values=None), posterior)
    assert text.startswith("# hill\n\nThe posterior around a fit: **") and "true val" not in text
    assert (tmp_path / run_folder.INFERENCE_DATA).exists() == blocks.is_available()
    text, rows = text.split("### Prior and posterior")[1], numbers["parameters"]
    for row, summary in zip(rows, posterior.summary, strict=True):
        low, high = row["prior"]["interval"]
        both = f"| normal | {low:.4g} to {high:.4g} | {summary['low95']:.4g} to "
        assert both in line_of(text, row["name"])
        half, twice = row["prior_sensitivity"]
        assert (half["factor"], twice["factor"]) == (0.5, 2.0)
        assert f"| {half['median']:.4g}, " in line_of(text, row["name"])
    moved = [row["name"] for row in rows if row["prior_sensitivity"][0]["sensitive"]]
    assert moved
    assert f"`{moved[0]}`" in text.split("Sensitive to their prior")[1]


def test_a_chain_that_meets_a_lower_point_hands_it_back(fitted, tmp_path, undrawn):
    posterior = replace(invented_posterior(), start_minus_cost=-8.0)
    best = posterior.best_values
    assert posterior.improvement == pytest.approx(8.0, abs=0.1)
    text, numbers = write_posterior(tmp_path, fitted, posterior)
    assert f"whose log-probability is {posterior.improvement:.3g} higher" in text
    command = f"`jaxik fit {tmp_path / run_folder.LOWER_POINT} -o {tmp_path}-lower`"
    assert command in text.split("## Posterior\n")[1].split("\n- ")[0]  # first of all
    table = tomllib.loads((tmp_path / run_folder.LOWER_POINT).read_text())["start"]
    assert table["contact"]["planted_height"] == best["contact.planted_height"]
    assert numbers["lower_point"] == {"gain": posterior.improvement, "values": best}
    posterior = replace(posterior, start_minus_cost=0.0)
    assert write_posterior(tmp_path, fitted, posterior)[1]["lower_point"] is None
    assert not (tmp_path / run_folder.LOWER_POINT).exists()


def test_parameters_of_which_chain_and_fit_disagree_are_named(fitted, tmp_path):
    posterior = invented_posterior()
    values = posterior.values.copy()
    values[..., 0] = 0.105 + 0.3 * (values[..., 0] - 0.105)  # the fit has a two-sided 0.11
    values[..., 1] += 2.0
    values[..., 2] = 0.9  # never moves, and can be drawn
    text, numbers = write_posterior(tmp_path, fitted, replace(posterior, values=values))
    assert "the 95 % interval of pelvis.half_life" in text and "leaves out the fitted value" in text
    reasons = {row["name"]: row["reason"] for row in numbers["disagreements"]}
    assert reasons["pelvis.half_life"] == "leaves out the fit"
    for name in ("corner.png", "chain.png"):
        with Image.open(tmp_path / name) as picture:
            assert min(picture.size) > 400


NAMES = ("foot.share", "foot.idle")


def space_of(names: tuple[str, ...]) -> Space:
    return problem_of(toy.Toy(), names, None, toy.residuals).space


def toy_posterior(names: tuple[str, ...] = NAMES, **other: Any) -> Posterior:
    u = 0.3 * np.random.default_rng(0).normal(size=(100, 8, len(names)))
    return replace(posterior_of(names, u, 0.6 + 0.2 * u, burn_in=10), **other)


def around_fit(posterior: Posterior, kind: str = "smooth") -> SampledFit:
    """As far as texts need it: a posterior around a fit with these rows."""
    row = {"kind": kind, "value": 0.6, "interval": [0.5, 0.7], "unit": "1", "determined": True}
    rows: Any = [{"name": name} | row for name in posterior.names]
    return SampledFit(
        cast(Any, SimpleNamespace(name="toy")), space_of(posterior.names), rows, posterior
    )


def text_of(**other: Any) -> str:
    return posterior_report.posterior_text(around_fit(toy_posterior(**other)))


def mode(weight: float, exchanges: int, u: float) -> Mode:
    error = 0.012 if exchanges >= 20 else math.nan
    return Mode(np.full(2, u), weight, error, exchanges, 4, -12.5)


def first_coordinates(axes) -> tuple[set[float], set[float]]:
    """x and y of where the lines of a panel begin."""
    starts = [np.asarray(line.get_data(), float)[:, 0] for line in axes.lines]
    return {float(x) for x, _ in starts}, {float(y) for _, y in starts}


def test_the_lines_of_known_values_cross_in_every_panel_of_their_parameters_or_in_the_only_one():
    values, known = {"foot.share": 0.61, "foot.idle": 0.5}, {"foot.idle": 0.4}
    figure = posterior_report.corner(toy_posterior(), NAMES, values, known, "two")
    marks = [first_coordinates(axes) for axes in figure.axes]
    assert 0.61 in marks[0][0] and 0.61 in marks[2][0]
    assert {0.5, 0.4} <= marks[2][1] and {0.5, 0.4} <= marks[3][0]
    (name,) = names = NAMES[:1]
    figure = posterior_report.corner(
        toy_posterior(names), names, {name: 0.61}, {name: 0.55}, "one", space_of(names)
    )
    (axes,) = figure.axes
    assert {0.61, 0.55} <= first_coordinates(axes)[0]


def test_contours_hold_the_parts_of_the_samples_that_the_legend_says():
    u = np.random.default_rng(0).normal(size=(500, 40, 2)) @ np.array([[1.0, 0.8], [0.0, 0.3]])
    posterior = posterior_of(NAMES, u, u, burn_in=0)
    figure = posterior_report.corner(posterior, NAMES, {}, None, "two")
    contours = figure.axes[2].collections[-1]
    inside = [path.contains_points(u.reshape(-1, 2)).mean() for path in contours.get_paths()]
    assert inside == pytest.approx([0.86, 0.39], abs=0.04)
    ends = first_coordinates(figure.axes[0])[0]
    assert ends >= {*np.quantile(u[..., 0], (0.025, 0.975))}


def test_the_legend_of_a_chain_says_how_many_of_its_walkers_are_drawn():
    figure = posterior_report.chain(invented_posterior(), list(VALUES), None, "chain")
    assert [len(axes.lines) for axes in figure.axes] == [12] * (1 + len(VALUES))
    (legend,) = figure.legends
    labels = [text.get_text() for text in legend.texts]
    assert labels == ["walkers (12 of 12 shown)", "burn-in, discarded"]


def test_modes_are_shown_with_weights_exchanges_and_medians():
    found = (mode(0.81, 250, 0.0), mode(0.19, 250, 1.5))
    assert "2 modes: 81.0 % ± 1.2 %, 19.0 % ± 1.2 %" in text_of(modes=found)
    space = space_of(NAMES)
    sampled = around_fit(toy_posterior(modes=found))
    text = "\n".join(document.markdown(posterior_report.sections(sampled, None)))
    assert "| 1 | 81.0 % ± 1.2 % | 250 | 4 | -12.5 |" in text
    first, second = (np.asarray(space.values(jnp.full(2, u))) for u in (0.0, 1.5))
    assert f"| foot.share | 1 | {first[0]:.4g} | {second[0]:.4g} |" in text
    assert "out of reach" not in text
    found = (mode(0.75, 3, 0.0), mode(0.25, 3, 1.5))  # hardly any exchanges
    text = text_of(modes=found)
    assert "out of reach (75.0 % of the draws), out of reach (25.0 % of the draws)" in text
    table = markdown(posterior_report.mode_table(found))
    assert "| 2 | out of reach (25.0 % of the draws) | 3 |" in table


def test_walkers_left_out_a_better_point_and_an_interval_that_contradicts_the_fit_are_said():
    text = text_of(isolated=[2, 5], isolated_mass=0.0071)
    assert "Left out are walkers 2, 5" in text and "about 0.71 % of the posterior" in text
    top = float(toy_posterior().log_probability.max())
    text = text_of(start_minus_cost=top - 3.25)
    assert "log-probability is 3.25 higher" in text and "`Posterior.best_values`" in text
    assert "contradicts" not in text_of(start_minus_cost=top - 0.05)
    for value, width, kind, reason in (
        (0.6, 0.2, "smooth", None),
        (0.75, 0.2, "smooth", "leaves out the fit"),
        (0.6, 0.08, "smooth", "narrower"),
        (0.6, 0.08, "threshold", None),
        (0.6, 0.03, "threshold", "narrower"),
        (0.6, 0.5, "threshold", "wider"),
    ):
        draws = toy_posterior(NAMES[:1])  # of which 95 % shall lie in an interval of this width
        draws = replace(draws, values=value + width / 3.92 * draws.u / draws.u.std())
        sampled = around_fit(draws, kind)
        reasons = [row["reason"] for row in sampled.disagreements]
        assert reasons == ([] if reason is None else [reason]), (value, width, kind)
        text = posterior_report.posterior_text(sampled)
        assert ("The chain contradicts its fit" in text) == (reason is not None)
        assert around_fit(replace(draws, converged=False)).disagreements == []


# What notebooks show of results, and the tables that pandas takes


def tables(text: str) -> list[list[list[str]]]:
    """The cells of all tables of a page."""
    page = ElementTree.fromstring(re.sub(r"(<img [^>]*)>", r"\1/>", text))
    rows_of = [list(table.iter("tr")) for table in page.iter("table")]
    return [[[cell.text or "" for cell in row] for row in rows] for rows in rows_of]


def pictures(text: str) -> list[bytes]:
    sources = re.findall(r'src="data:image/png;base64,([^"]+)"', text)
    return [base64.b64decode(source) for source in sources]


def test_a_notebook_shows_the_clips_and_the_free_parameters_of_an_experiment(tmp_path):
    experiment = experiment_files.load_experiment(write(tmp_path, top='name = "a <b> & c"'))
    text = experiment._repr_html_()
    clips, free = tables(text)
    assert "a &lt;b&gt; &amp; c" in text and "Numbers are for an adult" in text
    files = ["uneven_walk.npz", "uneven_walk_base.npz", "uneven_walk.ply"]
    assert clips[1] == [*files, "1 s", "2 s"]
    assert [row[0] for row in free[1:]] == ["pelvis.half_life", "foot.max_pitch"]
    assert free[2][3] == "0.1 to 1.4"
    assert display.html("a < b") == "<pre>&#x27;a &lt; b&#x27;</pre>", "as is anything else"


def test_a_fit_is_shown_as_a_table_and_a_picture_and_is_a_table_of_pandas(fitted):
    text = fitted._repr_html_()
    assert "<iframe" not in text  # it has no clips
    (parameters,) = tables(text)
    assert [row[0] for row in parameters[1:]] == list(VALUES)
    (picture,) = pictures(text)
    assert picture.startswith(b"\x89PNG") and len(picture) > 10_000
    table = fitted.table()
    kinds = ["threshold", "smooth", "smooth"]
    assert list(table.index) == list(VALUES) and list(table["kind"]) == kinds
    np.testing.assert_array_equal(table["value"], fitted.solution.values)
    intervals = [row["interval"] for row in fitted.parameters]
    np.testing.assert_array_equal(table[["low95", "high95"]], intervals)


@pytest.mark.slow
def test_a_notebook_shows_the_motion_of_a_fit_and_of_draws_of_a_posterior(tmp_path, monkeypatch):
    monkeypatch.setattr(playback, "measure_activity", lambda *_: [])  # which is not shown
    fitted = runs.with_clips(runs.invented_fit(tmp_path))
    frame = view_of(fitted._repr_html_(), tmp_path)
    labels = [skeleton["label"] for skeleton in frame.data["clips"][0]["skeletons"]]
    assert labels == ["flat animation", "before the fit", "captured", "fitted"]
    posterior = replace(toy_posterior(), source=(fitted.problem, fitted.clips))
    frame = view_of(posterior._repr_html_(), tmp_path)
    labels = [skeleton["label"] for skeleton in frame.data["clips"][0]["skeletons"]]
    assert labels == ["flat animation", "captured", *(f"draw {n}" for n in range(1, 6))]


def view_of(text: str, folder: Path) -> Page:
    """The page of a view inside that of a notebook."""
    (source,) = re.findall(r'srcdoc="([^"]+)"', text)
    path = folder / "view.html"
    path.write_text(html.unescape(source))
    return Page(path)


@pytest.mark.slow
def test_a_posterior_is_shown_and_is_a_table_if_there_is_pandas(monkeypatch):
    posterior = toy_posterior()
    text = posterior._repr_html_()
    assert "Converged." in text and len(pictures(text)) == 1
    assert [row[0] for row in tables(text)[0][1:]] == list(NAMES)
    table = posterior.table()
    assert list(table.index) == list(NAMES)
    np.testing.assert_allclose(table["mean"], posterior.values[10:].mean(axis=(0, 1)))
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match=r'this needs pandas: pip install "jaxik\[tables\]"'):
        posterior.table()


# The capture


@pytest.mark.slow
def test_numbers_of_a_capture_and_offsets_that_are_seen_stand_apart_from_the_system(fitted):
    shown = replace(fitted)
    rows = fitted.summary["parameters"]
    of_capture = {**rows[0], "of": "capture"}
    vars(shown)["summary"] = {**fitted.summary, "parameters": [*rows[1:], of_capture]}
    seen = GroundOffset(-0.029, 0.004, 14, tilt_z=math.radians(1.2))
    vars(shown)["capture_signs"] = [CaptureSigns(seen, -0.031)]
    text = fit_report.fit_text(shown)
    system, _, capture = text.partition("What is not known of the captures")
    assert "contact.planted_height" in capture and "contact.planted_height" not in system
    sentences = fit_tables.sentences(shown)
    assert [line in text for line in sentences] == [True] * 3
    assert sentences[0] == (
        "Standing feet are 2.9 cm in the ground in the median of 14 stances, which scatter by "
        "0.4 cm: a floor offset? `[capture] ground_height = {}` fits it along."
    )
    assert "1.2° along z: a tilted floor? `[capture] ground_tilt_z = {}`" in sentences[1]
    assert "31 ms before the fitted ones: a time shift? `[capture] time_shift" in sentences[2]
    section = "\n".join(document.markdown([fit_report._capture(shown)]))
    assert section.startswith("## The capture") and "contact.planted_height" in section
    freed = replace(shown, experiment=replace(shown.experiment, capture={"time_shift": {}}))
    vars(freed)["capture_signs"] = vars(shown)["capture_signs"]
    assert len(fit_tables.sentences(freed)) == 2  # what is fitted needs no remedy
    vars(freed)["capture_signs"] = [CaptureSigns(GroundOffset(0.0, 0.01, 14), 0.0)] * 2
    assert fit_tables.sentences(freed) == []
    assert list(document.markdown([fit_report._capture(fitted)])) == []
