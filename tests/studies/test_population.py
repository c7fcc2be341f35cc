"""Populations of clips: what is fitted, kept, left out and reported, and the command."""

import dataclasses
import json
import re
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fitting
from fitting.cli import main
from fitting.experiments import parameter_files, problems
from fitting.experiments.experiment import ClipEntry
from fitting.experiments.experiment_files import load_experiment
from fitting.inference.optimisation.solution import Progress
from fitting.jobs import populations
from fitting.problem.problem import Problem
from fitting.report.hierarchy import population_plots, population_report, population_tables
from fitting.studies import run_folder
from fitting.studies.hierarchy import kept_searches, population
from fitting.studies.hierarchy.population import Population, clip_names
from jaxik.maths import parameter_tree
from support.experiments import CLIP, write
from support.pages import Page

SIGMA = 0.02
FREE = "pelvis.on_gain = {}\nfoot.max_pitch = { low = 0.1 }\n"
MEASURED = ((0.2, 0.41), (0.5, 0.39), (0.3, 0.4))  # of each clip, in the order of FREE
SUBJECTS = ("ann", "ann", "ben")
TABLE = '[hierarchy]\nper_clip = ["pelvis.on_gain"]\n'


def values_of(ik) -> jax.Array:
    return jnp.stack([ik.pelvis.on_gain, ik.foot.max_pitch])


def residuals_of_scenes(ik, scenes):
    """Two parameters against the two numbers that stand in each reference."""
    each = []
    for scene in scenes:
        measured, seen = scene.reference.pelvis.pos[0, :2], scene.reference.observed[0]
        residuals = (values_of(ik) - measured) / jnp.asarray(SIGMA, measured.dtype)
        each.append(jnp.where(seen, residuals, 0.0))
    return jnp.concatenate(each)


def error_at(problem: Problem, u: np.ndarray) -> float:
    (scene,) = problem.data
    measured = np.asarray(scene.reference.pelvis.pos[0, :2])
    return float(np.linalg.norm(np.asarray(problem.space.values(jnp.asarray(u))) - measured))


def with_measured(problem: Problem, measured=MEASURED) -> Problem:
    for c, values in enumerate(measured):
        pos = problem.data[c].reference.pelvis.pos
        problem = eqx.tree_at(
            lambda p, c=c: p.data[c].reference.pelvis.pos,
            problem,
            pos.at[0, :2].set(jnp.asarray(values)),
        )
    return problem


@pytest.fixture
def quick(monkeypatch) -> None:
    """Residuals, references and errors that compile at once."""
    make = problems.make_problem
    monkeypatch.setattr(problems, "residuals_of_scenes", residuals_of_scenes)
    monkeypatch.setattr(populations, "make_problem", lambda e: with_measured(make(e)))
    monkeypatch.setattr(population, "error_at", error_at)


def write_walks(folder: Path, rest: str = TABLE, top: str = "", free: str = FREE) -> Path:
    """Three clips of a tenth of a second."""
    clips = "".join(
        f'{CLIP}start = {c}.0\nend = {c}.1\nsubject = "{subject}"\n'
        for c, subject in enumerate(SUBJECTS)
    )
    return write(folder, "walks.toml", top=top, clips=clips, free=free, rest=rest)


@pytest.fixture
def walks(quick, tmp_path) -> Path:
    return write_walks(tmp_path)


def kept(folder: Path) -> dict[str, dict]:
    """All searches on disk without how long they took, by what was fitted."""
    paths = (folder / "searches").glob("*.json")
    found = [json.loads(path.read_text()) | {"seconds": 0} for path in paths]
    return {search["name"]: search for search in found}


# What is fitted


def test_clips_are_fitted_alone_pooled_and_as_a_population(walks):
    fitted = fitting.population(walks)
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


def test_a_clip_that_is_left_out_is_predicted_by_the_others_alone(walks):
    fitted = fitting.population(walks)
    for c, row in enumerate(fitted.errors):
        others = np.delete(np.array(MEASURED), c, axis=0)
        far = float(np.linalg.norm(others.mean(axis=0) - MEASURED[c]))
        assert row.alone < row.population + 0.003 < row.pooled < row.left_out_pooled
        assert row.left_out_pooled == pytest.approx(far, abs=0.06)
        assert row.left_out_population == pytest.approx(far, abs=0.06)


def test_a_subject_that_others_show_is_expected_as_they_show_it(quick, tmp_path, monkeypatch):
    make = problems.make_problem
    measured = ((0.2, 0.4), (0.2, 0.4), (0.5, 0.4))
    monkeypatch.setattr(populations, "make_problem", lambda e: with_measured(make(e), measured))
    fitted = fitting.population(write_walks(tmp_path, TABLE.replace("per_clip", "per_subject")))
    first, second, other = fitted.errors
    assert max(first.left_out_population, second.left_out_population) < 0.03
    assert min(first.left_out_pooled, second.left_out_pooled) > 0.08
    assert other.left_out_population == pytest.approx(0.3, abs=0.05)
    gain = fitted.parameters[0]
    assert gain["level"] == "subject"
    assert gain["clips"][0]["value"] == gain["clips"][1]["value"] < gain["clips"][2]["value"]


def test_noise_is_estimated_in_each_clip_alone(quick, tmp_path, monkeypatch):
    estimated: list[int] = []
    search = kept_searches.search_with_noise

    def watched(problem, experiment, progress, kept):
        estimated.append(len(problem.data) if experiment.noise.estimates_any else 0)
        return search(problem, dataclasses.replace(experiment, noise=no_noise), progress, kept)

    no_noise = load_experiment(write_walks(tmp_path)).noise
    monkeypatch.setattr(kept_searches, "search_with_noise", watched)
    rest = TABLE + '[noise]\nsigmas = "estimated"\n'
    fitted = fitting.population(write_walks(tmp_path, rest), tmp_path / "out")
    assert estimated == [1, 1, 1, 0, 0, 0, 0]
    searches = kept(tmp_path / "out")
    assert all("noise" in searches[name] for name in fitted.clips)
    assert "noise" not in searches["all clips"]


def test_clips_of_one_file_are_told_apart():
    def entry(name: str, start: float = 0.0) -> ClipEntry:
        return ClipEntry(Path(f"{name}.npz"), Path("ground.ply"), start=start)

    names = clip_names([entry("a"), entry("b"), entry("b", 2.5), entry("c", 1.0), entry("c", 1.0)])
    assert names == ("a", "b from 0 s", "b from 2.5 s", "c from 1 s (4)", "c from 1 s (5)")


# Searches that are kept


def test_an_interrupted_population_continues_and_repeats_nothing(walks, tmp_path, monkeypatch):
    out, whole = tmp_path / "out", tmp_path / "whole"
    fitting.population(walks, whole)

    def stop(report: Progress) -> None:
        if report.stage == "all clips but uneven_walk from 1 s: polish":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fitting.population(walks, out, progress=stop)
    assert len(kept(out)) == 5 and not (out / "population.json").exists()
    (part,) = (out / "searches").glob("*.part")
    (stages,) = json.loads(part.read_text())["searches"].values()
    assert [stage["name"] for stage in stages[:2]] == ["descent", "descent"]
    searched: list[str] = []
    search = kept_searches.search_with_noise

    def watched(*arguments):
        searched.append("search")
        return search(*arguments)

    monkeypatch.setattr(kept_searches, "search_with_noise", watched)
    fitting.population(walks, out)
    assert len(searched) == 2 and kept(out) == kept(whole) and not part.exists()
    for name in ("population.json", "summary.md"):
        assert (out / name).read_text() == (whole / name).read_text()


def test_other_settings_are_searched_anew(walks, tmp_path):
    out = tmp_path / "out"
    fitting.population(walks, out)
    fitting.population(write_walks(tmp_path, top="seed = 1"), out)
    assert len(list((out / "searches").iterdir())) == 14


def test_a_search_that_is_damaged_is_refused(walks, tmp_path):
    out = tmp_path / "out"
    fitting.population(walks, out)
    path = next((out / "searches").iterdir())
    whole = json.loads(path.read_text())
    damaged = [
        ("{", "not JSON"),
        ("[]", "wanted a table"),
        ("{}", "it has no converged, cost"),
        (json.dumps(whole | {"u": [0.0]}), "u has 1 numbers; wanted 2"),
        (json.dumps(whole | {"u": [0.0, float("nan")]}), r"u\[1\] is nan; wanted a finite number"),
        (json.dumps(whole | {"cost": "low"}), "cost is 'low'; wanted a number"),
        (json.dumps(whole | {"noise": {"sigmas": {}}}), "noise has no correlations"),
    ]
    for text, message in damaged:
        path.write_text(text)
        with pytest.raises(
            ValueError, match=rf"\.json: not written by `jaxik population`: .*{message}"
        ):
            fitting.population(walks, out)
    path.write_text(json.dumps(whole | {"format": 9}))
    with pytest.raises(ValueError, match=r"\.json: its format is 9"):
        fitting.population(walks, out)


# Mistakes


@pytest.mark.parametrize(
    ("rest", "free", "message"),
    [
        ("", FREE, "nothing varies between the clips; name free parameters in the table [hier"),
        (
            '[hierarchy]\nper_clip = ["contact.planted_height"]\n',
            FREE + "contact.planted_height = {}\n",
            "contact.planted_height is a threshold: residuals jump with it",
        ),
    ],
)
def test_a_mistake_is_one_line_before_anything_is_searched(
    quick, tmp_path, capsys, rest, free, message
):
    path, out = write_walks(tmp_path, rest, free=free), tmp_path / "out"
    assert main.main(["population", str(path), "-o", str(out)]) == main.MISTAKE
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not out.exists()


# Report and command


def test_the_command_writes_a_report_and_parameters(walks, tmp_path, capsys):
    out = tmp_path / "out"
    assert main.main(["population", str(walks), "-o", str(out)]) == 0
    printed = capsys.readouterr().out
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


def test_what_has_not_converged_is_said_and_ends_with_status_3(quick, tmp_path, capsys):
    path = write_walks(tmp_path, TABLE + "[fit]\nstarts = 1\n[fit.search]\ndescents = 1\n")
    assert main.main(["population", str(path), "-o", str(tmp_path / "out")]) == 3
    assert "**Not converged**: all clips: Not converged: stopped" in capsys.readouterr().out
    page = Page(tmp_path / "out" / run_folder.PAGE)
    assert re.search(r"walks \d not converged ◐ \d of the searches did not converge", page.text)


@pytest.fixture
def fitted(walks) -> Population:
    return fitting.population(walks)


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
