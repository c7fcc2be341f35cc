"""Populations of clips: what is fitted, left out and reported, and the command."""

import dataclasses
import json
import re
import shutil
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

import fitting
import jaxik
from fitting.cli import main
from fitting.experiment import parameter_files
from fitting.experiment.experiment import ClipEntry
from fitting.experiment.experiment_files import load_experiment
from fitting.inference.noise import NoiseOptions
from fitting.report import document, pages
from fitting.studies import population
from fitting.studies.campaign import clip_names
from fitting.studies.population import Population
from jaxik.maths import parameter_tree
from support import small_studies
from support.pages import Page
from support.small_studies import GIVEN, MEASURED, SUBJECTS, VARYING, kept, write_population
from support.watching import listening


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
    with pytest.MonkeyPatch.context() as patch, listening(lines.append):
        walks, out = small_studies.quick_population(folder, patch), folder / "out"
        fitted = fitting.population(walks, out)
    return Made(walks, out, "\n".join(lines), fitted)


@pytest.fixture
def fitted(made) -> Population:
    return made.fitted


# What is fitted


def test_clips_are_fitted_alone_pooled_and_as_a_population(fitted):
    half_life, pitch = fitted.parameters
    assert (half_life["level"], pitch["level"]) == ("clip", "shared")
    alone = [estimate["value"] for estimate in half_life["alone"]]
    np.testing.assert_allclose(alone, [values[0] for values in MEASURED], atol=0.01)
    assert 0.2 < half_life["pooled"]["value"] < 0.45 and half_life["pooled"]["interval"] is not None
    within = [estimate["value"] for estimate in half_life["clips"]]
    centre, spread = half_life["centre"]["value"], half_life["spread"]
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
    measured, table = ((0.2, 0.4), (0.2, 0.4), (0.45, 0.4)), VARYING.replace("clip", "subject")
    fitted = fitting.population(
        small_studies.quick_population(tmp_path, monkeypatch, measured, table)
    )
    first, second, other = fitted.errors
    assert max(first.left_out_population, second.left_out_population) < 0.03
    assert min(first.left_out_pooled, second.left_out_pooled) > 0.08
    assert other.left_out_population == pytest.approx(0.25, abs=0.05)
    half_life = fitted.parameters[0]
    assert half_life["level"] == "subject"
    assert (
        half_life["clips"][0]["value"]
        == half_life["clips"][1]["value"]
        < half_life["clips"][2]["value"]
    )


def test_a_subject_is_crossed_with_others_and_with_its_own_other_clips():
    rows = {
        (subject, fitted_on): [sorted(clips) for clips in fits.values()]
        for subject, fitted_on, fits in population.crossings("abbb")
    }
    assert rows == {
        ("a", population.NOTHING): [[]],
        ("a", population.OTHERS): [[1, 2, 3]],
        ("b", population.NOTHING): [[], [], []],
        ("b", population.OWN): [[2, 3], [1, 3], [1, 2]],
        ("b", population.OTHERS): [[0], [0], [0]],
        ("b", population.ALL): [[0, 2, 3], [0, 1, 3], [0, 1, 2]],
    }
    assert population.crossings("bbb") == []


def test_subjects_are_measured_with_parameters_that_others_gave(fitted):
    own = float(parameter_tree.get(jaxik.presets.record(), "pelvis.half_life"))
    half_lives = np.array(MEASURED)[:, 0]
    expected = {  # the clips are raised by the half_life, and captured near to the animation
        ("ann", population.NOTHING): [own, own],
        ("ann", population.OWN): half_lives[[1, 0]],
        ("ann", population.OTHERS): half_lives[[2, 2]],
        ("ann", population.ALL): [half_lives[1:].mean(), half_lives[[0, 2]].mean()],
        ("ben", population.NOTHING): [own],
        ("ben", population.OTHERS): [half_lives[:2].mean()],
    }
    rows = {(row.subject, row.fitted_on): row.accuracy.pelvis for row in fitted.crossed}
    assert rows.keys() == expected.keys()
    below = rows["ben", population.OTHERS] - half_lives[:2].mean()  # the capture of the last clip
    for key, raised in expected.items():
        near = below if key[0] == "ben" else 0.0
        rms = np.sqrt(np.mean(np.square(np.asarray(raised) + near)))
        assert rows[key] == pytest.approx(rms, abs=0.01)


def test_each_set_of_clips_is_fitted_once(tmp_path, monkeypatch):
    searched: list[list[str]] = []

    def watched(title, tasks, folder):
        searched.append([task.name for task in tasks])
        if len(searched) == 2:
            raise KeyboardInterrupt
        return [{"name": task.name, "u": [0.0, 0.0]} for task in tasks]

    monkeypatch.setattr(population, "_search_all", watched)
    path = small_studies.quick_population(tmp_path, monkeypatch, [(0.2, 0.4)] * 4, subjects="abbb")
    with pytest.raises(KeyboardInterrupt):
        fitting.population(path)
    alone, pooled = searched
    assert pooled[:5] == ["all clips", *(f"all clips but {name}" for name in alone)]
    assert pooled[5:] == [f"all clips of b but {name}" for name in alone[1:]]


def test_noise_is_estimated_in_each_clip_alone(tmp_path, monkeypatch, undrawn):
    estimated: list[int] = []
    search = population.search_with_noise

    def watched(problem, experiment):
        estimated.append(len(problem.data) if experiment.noise.estimates_any else 0)
        quiet = dataclasses.replace(experiment, noise=NoiseOptions(correlation="given"))
        return search(problem, quiet)

    monkeypatch.setattr(population, "search_with_noise", watched)
    rest, out = VARYING.replace(GIVEN, '[noise]\nsigmas = "estimated"\n'), tmp_path / "out"
    path = small_studies.quick_population(tmp_path, monkeypatch, rest=rest)
    fitted = fitting.population(path, out)
    assert estimated == [1, 1, 1, 0, 0, 0, 0]
    searches = {search["name"]: search for search in kept(out / "searches").values()}
    assert all("noise" in searches[name] for name in fitted.clips)
    assert "noise" not in searches["all clips"]


def test_clips_of_one_file_are_told_apart():
    def entry(name: str, start: float = 0.0) -> ClipEntry:
        return ClipEntry(Path(f"{name}.npz"), Path("ground.ply"), start=start)

    names = clip_names([entry("a"), entry("b"), entry("b", 2.5), entry("c", 1.0), entry("c", 1.0)])
    assert names == ("a", "b from 0 s", "b from 2.5 s", "c from 1 s (4)", "c from 1 s (5)")


def test_only_other_settings_are_searched_anew(made, tmp_path, monkeypatch, undrawn):
    small_studies.quick_population(tmp_path, monkeypatch)
    out, searched = tmp_path / "out", []
    shutil.copytree(made.folder / "searches", out / "searches")

    def watched(task):
        searched.append(task.name)
        raise KeyboardInterrupt

    monkeypatch.setattr(population, "_search", watched)
    with pytest.raises(KeyboardInterrupt):
        fitting.population(write_population(tmp_path, top="seed = 1"), out)
    assert searched == ["uneven_walk from 0 s"]


def test_finished_fits_are_recalled_to_the_last_bit(made, tmp_path, monkeypatch, undrawn):
    out = tmp_path / "out"
    for name in (population.SEARCHES, population.FITS):
        shutil.copytree(made.folder / name, out / name)
    fits = sorted((out / population.FITS).iterdir())
    assert len(fits) == 4  # all, and all but each
    path = small_studies.quick_population(tmp_path, monkeypatch)
    monkeypatch.setattr(population, "fit_population", None)
    again, before = fitting.population(path, out).fit, made.fitted.fit
    for name in ("centre", "clips", "spread"):
        np.testing.assert_array_equal(getattr(again, name), getattr(before, name))
    np.testing.assert_array_equal(again.model.prior_vector, before.model.prior_vector)
    fits[0].write_text(json.dumps(json.loads(fits[0].read_text()) | {"spread": [0.0]}))
    with pytest.raises(ValueError, match=r"spread has shape \(1,\); wanted \(2,\).*; delete it"):
        fitting.population(path, out)


# Report and command


def test_the_folder_has_a_report_and_parameters(made):
    out, printed = made.folder, made.printed
    assert "fitting 2 parameters of record to 3 clips, 1 of them varying" in printed
    assert "uneven_walk from 1 s: cost" in printed and f"read {out / 'summary.md'}" in printed
    summary = (out / "summary.md").read_text()
    assert summary.startswith("# walks\n\nClips fitted alone, pooled and as a population: **Conv")
    assert "- `pelvis.half_life` differs " in summary and "from 3 clips only." in summary
    assert "A clip that is left out is predicted to" in summary
    assert "(population.png)" in summary and (out / "population.png").stat().st_size > 10_000
    page = Page(out / pages.PAGE)
    assert "too few to say much of spreads: pelvis.half_life differs between them." in page.text
    assert "All 7 searches and the fit of the population converged." in page.text
    assert re.search(r"ann other subjects (29\.[5-9]|30\.[0-5])", page.text)  # cm: of ben
    assert re.search(r"all clips \d+\.\d+ 2 of 2 ", page.text)
    assert page.elements.count("img") == 1 and "uneven_walk from 1 s (ann)" in page.text
    numbers = json.loads((out / "population.json").read_text())
    assert numbers["crossed"][2]["fitted_on"] == population.OTHERS
    assert numbers["crossed"][2]["pelvis"] == pytest.approx(0.3, abs=0.01)
    assert numbers["converged"] and numbers["subjects"] == list(SUBJECTS)
    assert [row["name"] for row in numbers["parameters"]] == ["pelvis.half_life", "foot.max_pitch"]
    assert load_experiment(out / "experiment.toml").hierarchy.per_clip == ("pelvis.half_life",)
    for name, expected in (
        ("parameters.toml", numbers["parameters"][0]["centre"]["value"]),
        ("clips/uneven_walk from 1 s.toml", numbers["parameters"][0]["clips"][1]["value"]),
    ):
        ik, preset = parameter_files.load_system(out / name)
        assert float(parameter_tree.get(ik, "pelvis.half_life")) == pytest.approx(expected)
        assert preset.name == "record"


@pytest.mark.slow
def test_what_has_not_converged_is_said_and_ends_with_status_3(
    tmp_path, monkeypatch, undrawn, capsys
):
    rest = VARYING + "[fit]\nstarts = 1\n[fit.search]\ndescents = 1\n"
    path = small_studies.quick_population(tmp_path, monkeypatch, rest=rest)
    assert main.main(["population", str(path), "-o", str(tmp_path / "out")]) == 3
    assert "**Not converged**: all clips: Not converged: stopped" in capsys.readouterr().out
    page = Page(tmp_path / "out" / pages.PAGE)
    assert re.search(r"walks \d not converged ◐ \d of the searches did not converge", page.text)


def test_the_summary_says_whether_clips_differ_as_far_as_that_is_known(fitted):
    half_life, pitch = fitted.parameters
    for spread, text in (
        (half_life["spread"], "`pelvis.half_life` differs between clips: spread "),
        ({"value": 0.2, "interval": [0.0, 1.5]}, "spread 0.2, at most 1.5, from 3 clips only."),
        (
            {"value": 0.0, "interval": [0.0, 0.7]},
            "is alike in all clips as far as they tell: spread at most 0.7",
        ),
    ):
        changed = dataclasses.replace(fitted, parameters=[{**half_life, "spread": spread}, pitch])
        brief = document.text(population.document(changed))
        assert text in brief.rpartition("\n\n- ")[2]


def test_tables_and_picture_have_each_clip_pooled_and_the_population(fitted):
    table = population.parameter_table(fitted)
    assert [row[1] for row in table[1:7]] == [
        "uneven_walk from 0 s (ann)", "uneven_walk from 1 s (ann)", "uneven_walk from 2 s (ben)",
        "pooled", "population", "spread, of u",
    ]  # fmt: skip
    assert table[1][0] == "`pelvis.half_life`, s, per clip" and table[7][1] == "95 % of clips"
    assert table[8][0] == "`foot.max_pitch`, rad, shared" and len(table) == 13
    assert table[8][3] == "" != table[12][3]
    errors = population.error_table(fitted)
    assert len(errors) == 5 and errors[-1][0] == "all"
    squares = [row.alone**2 for row in fitted.errors]
    assert errors[-1][1] == f"{100 * np.sqrt(np.mean(squares)):.2f}"
    figure = population.overview(fitted, "title")
    titles = [axes.get_title("left") for axes in figure.axes]
    assert titles == ["pelvis.half_life", "Error"]
