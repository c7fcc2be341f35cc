"""Populations of clips and bodies: what is fitted, left out and reported, and the command."""

import dataclasses
import json
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fitting
import jaxik
from fitting.cli import main
from fitting.datasets.clips import edit, load_clip, save_clip
from fitting.experiments import parameter_files
from fitting.experiments.experiment import ClipEntry
from fitting.experiments.experiment_files import load_experiment
from fitting.experiments.problems import make_problem
from fitting.inference.hierarchy.grouping import Grouping
from fitting.inference.hierarchy.population_fit import PopulationFit, fit_population
from fitting.inference.noise.settings import NoiseOptions
from fitting.problem.problem import Problem
from fitting.problem.simulation import simulate
from fitting.report.hierarchy import population_plots, population_report, population_tables
from fitting.studies import run_folder
from fitting.studies.hierarchy import kept_searches
from fitting.studies.hierarchy.estimates import summarise
from fitting.studies.hierarchy.left_out import predict
from fitting.studies.hierarchy.population import Population, clip_names
from jaxik.maths import parameter_tree
from support import small_studies
from support.bodies import scaled
from support.experiments import ROOT
from support.pages import Page
from support.small_studies import MEASURED, SUBJECTS, VARYING, kept, write_population


class Made(NamedTuple):
    """What was made of three walks."""

    walks: Path
    folder: Path
    printed: str
    fitted: Population


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Made:
    """Tests must not change its folder."""
    folder, lines = tmp_path_factory.mktemp("population"), []
    with pytest.MonkeyPatch.context() as patch:
        walks, out = small_studies.quick_population(folder, patch), folder / "out"
        fitted = fitting.population(walks, out, log=lines.append)
    return Made(walks, out, "\n".join(lines), fitted)


@pytest.fixture
def fitted(made) -> Population:
    return made.fitted


# What is fitted


def test_clips_are_fitted_alone_pooled_and_as_a_population(fitted):
    gain, pitch = fitted.parameters
    assert (gain["level"], pitch["level"]) == ("clip", "shared")
    alone = [estimate["value"] for estimate in gain["alone"]]
    np.testing.assert_allclose(alone, [values[0] for values in MEASURED], atol=0.01)
    assert 0.2 < gain["pooled"]["value"] < 0.5 and gain["pooled"]["interval"] is not None
    within = [estimate["value"] for estimate in gain["clips"]]
    centre, spread = gain["centre"]["value"], gain["spread"]
    assert (np.abs(np.subtract(within, centre)) < np.abs(np.subtract(alone, centre))).all()
    np.testing.assert_allclose(within, alone, atol=0.03)
    assert spread is not None and spread["interval"] is not None
    assert spread["interval"][0] > 0 < spread["value"] < spread["interval"][1]
    assert {estimate["value"] for estimate in pitch["clips"]} == {pitch["centre"]["value"]}
    assert pitch["centre"]["value"] == pytest.approx(0.4, abs=0.01)
    assert fitted.converged and fitted.clips[0] == "uneven_walk from 0 s"
    assert fitted.subjects == SUBJECTS


def test_a_clip_that_is_left_out_is_predicted_by_the_others_alone(fitted):
    for c, row in enumerate(fitted.errors):
        others = np.delete(np.array(MEASURED), c, axis=0)
        far = float(np.linalg.norm(others.mean(axis=0) - MEASURED[c]))
        assert row.alone < row.population + 0.003 < row.pooled < row.left_out_pooled
        assert row.left_out_pooled == pytest.approx(far, abs=0.06)
        assert row.left_out_population == pytest.approx(far, abs=0.06)


def test_a_subject_that_others_show_is_expected_as_they_show_it(tmp_path, monkeypatch):
    measured, table = ((0.2, 0.4), (0.2, 0.4), (0.5, 0.4)), VARYING.replace("clip", "subject")
    fitted = fitting.population(
        small_studies.quick_population(tmp_path, monkeypatch, measured, table)
    )
    first, second, other = fitted.errors
    assert max(first.left_out_population, second.left_out_population) < 0.03
    assert min(first.left_out_pooled, second.left_out_pooled) > 0.08
    assert other.left_out_population == pytest.approx(0.3, abs=0.05)
    gain = fitted.parameters[0]
    assert gain["level"] == "subject"
    assert gain["clips"][0]["value"] == gain["clips"][1]["value"] < gain["clips"][2]["value"]


def test_noise_is_estimated_in_each_clip_alone(tmp_path, monkeypatch, undrawn):
    estimated: list[int] = []
    search = kept_searches.search_with_noise

    def watched(problem, experiment, progress, kept):
        estimated.append(len(problem.data) if experiment.noise.estimates_any else 0)
        quiet = dataclasses.replace(experiment, noise=NoiseOptions())
        return search(problem, quiet, progress, kept)

    monkeypatch.setattr(kept_searches, "search_with_noise", watched)
    rest, out = VARYING + '[noise]\nsigmas = "estimated"\n', tmp_path / "out"
    path = small_studies.quick_population(tmp_path, monkeypatch, rest=rest)
    fitted = fitting.population(path, out)
    assert estimated == [1, 1, 1, 0, 0, 0, 0]
    searches = {found["name"]: found for found in kept(out / "searches").values()}
    assert all("noise" in searches[name] for name in fitted.clips)
    assert "noise" not in searches["all clips"]


def test_clips_of_one_file_are_told_apart():
    def entry(name: str, start: float = 0.0) -> ClipEntry:
        return ClipEntry(Path(f"{name}.npz"), Path("ground.ply"), start=start)

    names = clip_names([entry("a"), entry("b"), entry("b", 2.5), entry("c", 1.0), entry("c", 1.0)])
    assert names == ("a", "b from 0 s", "b from 2.5 s", "c from 1 s (4)", "c from 1 s (5)")


def test_other_settings_are_searched_anew(made, tmp_path, monkeypatch, undrawn):
    small_studies.quick_population(tmp_path, monkeypatch)
    out, searched = tmp_path / "out", []
    shutil.copytree(made.folder / "searches", out / "searches")

    def watched(searches, name, *_):
        searched.append(name)
        raise KeyboardInterrupt

    monkeypatch.setattr(kept_searches.KeptSearches, "_search", watched)
    fitting.population(made.walks, out)
    assert searched == []
    with pytest.raises(KeyboardInterrupt):
        fitting.population(write_population(tmp_path, top="seed = 1"), out)
    assert searched == ["uneven_walk from 0 s"]


# Report and command


def test_the_folder_has_a_report_and_parameters(made):
    out, printed = made.folder, made.printed
    assert "fitting 2 parameters of record to 3 clips, 1 of them varying" in printed
    assert "uneven_walk from 1 s: cost" in printed and f"read {out / 'summary.md'}" in printed
    summary = (out / "summary.md").read_text()
    assert summary.startswith("# walks: clips and their population\n\n- `pelvis.on_gain` differs ")
    assert "from 3 clips only." in summary and "A clip that is left out is predicted to" in summary
    assert "(population.png)" in summary and (out / "population.png").stat().st_size > 10_000
    page = Page(out / run_folder.PAGE)
    assert "too few to say much of spreads: pelvis.on_gain differs between them." in page.text
    assert "All 7 searches and the fit of the population converged." in page.text
    assert page.elements.count("img") == 1 and "uneven_walk from 1 s (ann)" in page.text
    numbers = json.loads((out / "population.json").read_text())
    assert numbers["converged"] and numbers["subjects"] == list(SUBJECTS)
    assert [row["name"] for row in numbers["parameters"]] == ["pelvis.on_gain", "foot.max_pitch"]
    assert load_experiment(out / "experiment.toml").hierarchy.per_clip == ("pelvis.on_gain",)
    for name, expected in (
        ("parameters.toml", numbers["parameters"][0]["centre"]["value"]),
        ("clips/uneven_walk from 1 s.toml", numbers["parameters"][0]["clips"][1]["value"]),
    ):
        ik, preset = parameter_files.load_system(out / name)
        assert float(parameter_tree.get(ik, "pelvis.on_gain")) == pytest.approx(expected)
        assert preset.name == "record"


def test_what_has_not_converged_is_said_and_ends_with_status_3(
    tmp_path, monkeypatch, undrawn, capsys
):
    rest = VARYING + "[fit]\nstarts = 1\n[fit.search]\ndescents = 1\n"
    path = small_studies.quick_population(tmp_path, monkeypatch, rest=rest)
    assert main.main(["population", str(path), "-o", str(tmp_path / "out")]) == 3
    assert "**Not converged**: all clips: Not converged: stopped" in capsys.readouterr().out
    page = Page(tmp_path / "out" / run_folder.PAGE)
    assert re.search(r"walks \d not converged ◐ \d of the searches did not converge", page.text)


def changed(fitted: Population, **spread: object) -> Population:
    gain = {**fitted.parameters[0], "spread": spread}
    return dataclasses.replace(fitted, parameters=[gain, fitted.parameters[1]])  # type: ignore[list-item]


def test_the_summary_says_whether_clips_differ_as_far_as_that_is_known(fitted):
    def first(population: Population) -> str:
        return population_report.population_text(population).rpartition("\n\n- ")[2]

    assert "`pelvis.on_gain` differs between clips: spread " in first(fitted)
    assert "spread 0.2, at most 1.5, from 3 clips only." in first(
        changed(fitted, value=0.2, interval=[0.0, 1.5])
    )
    assert "is alike in all clips as far as they tell: spread at most 0.7" in first(
        changed(fitted, value=0.0, interval=[0.0, 0.7])
    )


def test_tables_have_each_clip_pooled_and_the_population(fitted):
    table = population_tables.parameter_table(fitted)
    assert [row[1] for row in table[1:7]] == [
        "uneven_walk from 0 s (ann)", "uneven_walk from 1 s (ann)", "uneven_walk from 2 s (ben)",
        "pooled", "population", "spread, of u",
    ]  # fmt: skip
    assert table[1][0] == "`pelvis.on_gain`, 1/tick, per clip" and table[7][1] == "95 % of clips"
    assert table[8][0] == "`foot.max_pitch`, rad, shared" and len(table) == 13
    assert table[8][3] == "" != table[12][3]
    errors = population_tables.error_table(fitted)
    assert len(errors) == 5 and errors[-1][0] == "all"
    squares = [row.alone**2 for row in fitted.errors]
    assert errors[-1][1] == f"{100 * np.sqrt(np.mean(squares)):.2f}"


def test_the_picture_has_a_panel_for_each_parameter_that_varies(fitted):
    figure = population_plots.overview(fitted, "title")
    titles = [axes.get_title("left") for axes in figure.axes]
    assert titles == ["pelvis.on_gain", "Error"]


# Through the pipeline: short clips of `ozz` with known parameters, of one shape and so one program

STOP_AND_GO = ROOT / "data" / "clips" / "stop_and_go_base.npz"
TERRAIN = ROOT / "data" / "terrains" / "stop_and_go.ply"
SIZE = 1.3
STARTS = (1.0, 4.0, 8.0)  # s, of clips of half a second
TRUTH = {"target.foot_height": 0.10, "pelvis.on_gain": 0.2, "leg.soften": 0.95}
HEADER = """
preset = "ozz"
faithful = true
body = "adult"
[free]
target.foot_height = {}
pelvis.on_gain = {}
leg.soften = {}
[sigmas]
ankle = 0.002
knee = 0.002
pelvis = 0.002
foot = 0.0087
[hierarchy]
scale_with_body = true
"""


@pytest.fixture(scope="module")
def walks(tmp_path_factory) -> list[Problem[jaxik.FootIK]]:
    """Problems of one clip each: three of one body, and the second again of a larger one."""
    folder, walk = tmp_path_factory.mktemp("ozz"), load_clip(STOP_AND_GO)
    clips = [edit.trim(walk, start, start + 0.5) for start in STARTS]
    clips.append(scaled(clips[1], SIZE, froude=True))
    tables = []
    for number, clip in enumerate(clips):
        path: Path = folder / f"{number}.npz"
        save_clip(path, clip)
        files = f'reference = "{path}"\nbase = "{path}"\nterrain = "{TERRAIN}"\n'
        tables.append(f'[[clips]]\n{files}root = "animation"\n')
    (folder / "ozz.toml").write_text(HEADER + "".join(tables))
    with jax.enable_x64(True):
        problem = make_problem(load_experiment(folder / "ozz.toml"))
    return [eqx.tree_at(lambda p: p.data, problem, (scene,)) for scene in problem.data]


def moved(problem: Problem, values: Mapping[str, float], seed: int) -> Problem:
    """The problem with motion that these values make, plus noise."""
    return simulate(problem, jnp.asarray(problem.space.pack(values)), seed)


def without_size(problem: Problem) -> Problem:
    """The problem of a body that is taken for the first one."""
    return eqx.tree_at(lambda p: p.data[0].size, problem, jnp.ones(()))


def test_what_made_the_motion_explains_it_on_a_body_of_another_size(walks):
    adult, larger = (moved(walks[c], TRUTH, c) for c in (1, 3))
    assert float(larger.data[0].size / adult.data[0].size) == pytest.approx(SIZE)
    u = adult.space.pack(TRUTH)
    costs = [float(each.cost(u)) for each in (adult, larger, without_size(larger))]
    assert costs[1] == pytest.approx(costs[0], rel=0.2) and costs[2] > 3 * costs[1]


@pytest.mark.slow
def test_a_fit_across_two_bodies_needs_their_sizes(walks):
    both = [moved(walks[c], TRUTH, c) for c in (1, 3)]
    unsized = [without_size(problem) for problem in both]
    space = walks[0].space
    start = np.tile(np.asarray(space.start), (2, 1))
    grouping = Grouping.pooled(2, space.size)
    with_sizes, without = (fit_population(p, grouping, [start]) for p in (both, unsized))
    fitted, other = (np.asarray(space.values(fit.centre)) for fit in (with_sizes, without))
    expected = np.array(list(TRUTH.values()))
    np.testing.assert_allclose(fitted, expected, rtol=0.03)
    assert with_sizes.converged and np.abs(other / expected - 1).max() > 0.1
    assert without.cost > 2 * with_sizes.cost


HEIGHT_OF_EACH = Grouping.of_labels([["a", "b", "c"], None, None])


def fit_heights(clips: list[Problem]) -> PopulationFit:
    """Three clips that may differ in the first parameter."""
    starts = [np.tile(np.asarray(clips[0].space.start), (3, 1))]
    fit = fit_population(clips, HEIGHT_OF_EACH, starts)
    assert fit.converged
    return fit


@pytest.mark.slow
def test_the_population_of_short_clips_is_recovered(walks):
    """One body whose ankles stand at another height in each clip; all else is the same."""
    heights = (0.07, 0.085, 0.10)
    clips = [
        moved(problem, TRUTH | {"target.foot_height": height}, c)
        for c, (problem, height) in enumerate(zip(walks[:3], heights, strict=True))
    ]
    fit = fit_heights(clips)
    rows = summarise(clips, fit.clips, fit.centre, fit, ("clip", "shared", "shared"))
    for estimate, truth in zip(rows[0]["clips"], heights, strict=True):
        assert estimate["value"] == pytest.approx(truth, abs=0.002)
    low, high = rows[0]["centre"]["interval"]  # type: ignore[misc]
    assert low < 0.085 < high
    assert rows[0]["spread"]["interval"][0] > 0  # type: ignore[index]
    assert rows[2]["centre"]["value"] == pytest.approx(0.95, abs=0.02)
    expected = predict(clips, HEIGHT_OF_EACH, fit, fit.centre, 0, lambda rounds, cost: None)
    assert expected[0] > fit.clips[0, 0] + 0.1, "the others' ankles are higher"


@pytest.mark.slow
def test_clips_that_are_alike_have_a_spread_near_0(walks):
    clips = [moved(problem, TRUTH, 10 + c) for c, problem in enumerate(walks[:3])]
    fit = fit_heights(clips)
    heights = [float(np.asarray(clips[0].space.values(u))[0]) for u in fit.clips]
    assert fit.spread[0] < 0.05
    np.testing.assert_allclose(heights, TRUTH["target.foot_height"], atol=0.002)
