"""Ablation: variants, splits, rows, what is not fitted again, and the report."""

import csv
import dataclasses
import json
import struct
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from fitting.cli import main
from fitting.clips import load_clip, save_clip
from fitting.experiment import problems
from fitting.experiment.experiment import Experiment
from fitting.experiment.experiment_files import load_experiment
from fitting.experiment.file_tables import COMPLETE, Ablation
from fitting.experiment.problems import ClipData
from fitting.inference.noise import NoiseOptions
from fitting.inference.optimise.solution import Solution
from fitting.motion.accuracy import ACCURACY, Accuracy
from fitting.report import pages
from fitting.runtime import activity
from fitting.studies import ablation
from fitting.studies.ablation import Row
from fitting.studies.fit.fit import SearchRecord
from jaxik.maths import parameter_tree
from support import small_studies
from support.pages import Page
from support.small_studies import SIX_SECONDS, WITHOUT, write_ablation
from support.watching import Recorder, listening

ALL, PITCH, BOTH = COMPLETE, "pitch", "both"
EVERYTHING = "everything"


class Search:
    """A search that remembers its calls; it finds a thousandth of the frame count, in s."""

    def __init__(self) -> None:
        self.calls: list = []

    def __call__(self, problem, experiment):
        self.calls.append((problem, experiment))
        names = problem.space.names
        frames = sum(int(scene.reference.observed.sum()) for scene in problem.data)
        best = {name: 0.3 if name != "pelvis.half_life" else frames / 1000 for name in names}
        u = np.asarray(problem.space.pack(best))
        values = np.asarray(problem.space.values(jnp.asarray(u)))
        return problem, Solution(
            names, u, values, 9.0, 1.0, True, "Done.", np.zeros((1, len(names))), (), 1, 0.5
        )  # fmt: skip


@pytest.fixture
def search(monkeypatch) -> Search:
    counted = Search()
    monkeypatch.setattr(ablation, "search_with_noise", counted)
    small_studies.without_pipeline(monkeypatch)
    return counted


def load(folder: Path, rest: str = WITHOUT, **parts: str) -> Experiment:
    return load_experiment(write_ablation(folder, rest=rest, **parts))


def load_clip_data(experiment: Experiment) -> ClipData:
    (entry,) = experiment.clips
    return problems.load_clip_data(entry, None)


# Variants


def test_an_ablation_may_free_parameters_of_its_own_rules(tmp_path):
    rest = """
[[without]]
name = "reach"
rules = { pelvis = "SupportPelvis" }
free = { pelvis.lowest_share = { low = 0.1 } }
"""
    experiment = load(tmp_path, rest)
    variant = ablation.without(experiment, experiment.without[0])
    assert "pelvis.half_life" not in variant.free  # it belongs to the rule that is replaced
    assert variant.free["pelvis.lowest_share"] == {"low": 0.1}
    with pytest.raises(ValueError, match="reach: free: unknown key 'pelvis.lowest_shore'"):
        load(tmp_path, rest.replace("lowest_share", "lowest_shore"))


def test_an_ablation_drops_parameters_that_its_rules_do_not_have_but_no_mistakes(tmp_path):
    rest = "[parameters]\npelvis.limit = 0.3\nlock.enabled = false\n"
    free = 'pelvis.half_life = {}\nfoot."max_pitch[0]" = {}\npelvis.half_lif = {}\n'
    experiment = load(tmp_path, rest, free=free)
    variant = ablation.without(
        experiment, Ablation("p", {"pelvis": "CapsulePelvis"}, {"pelvis.speed": 4.0})
    )
    assert variant.rules == {"pelvis": "CapsulePelvis"}
    assert variant.parameters == {"lock.enabled": False, "pelvis.speed": 4.0}
    assert set(variant.free) == {"foot.max_pitch[0]", "pelvis.half_lif"}
    variant = ablation.without(experiment, Ablation("f", {}, {"foot.max_pitch": 0.2}))
    assert variant.parameters["foot.max_pitch"] == 0.2 and variant.rules == {}
    assert set(variant.free) == {"pelvis.half_life", "pelvis.half_lif"}


# Splits


@pytest.mark.parametrize("folds", [2, 3])
def test_the_held_out_part_is_not_fitted_and_everything_else_is(tmp_path, folds):
    experiment = load(tmp_path)
    data = load_clip_data(experiment)
    captured, base, *_ = data
    splits = list(ablation.split(experiment.clips, [data], folds))
    names = [f"part {i + 1} of {folds}" for i in range(folds)]
    assert [split.name for split in splits] == [*names, EVERYTHING]
    observed = captured.mask if captured.mask is not None else np.ones(captured.frame_count, bool)
    times_held_out = np.zeros(captured.frame_count, int)
    for split in splits[:-1]:
        ((measured, part),) = split.measured
        assert measured is data
        held_out = np.zeros(captured.frame_count, bool)
        held_out[part] = True
        times_held_out += held_out
        ((entry, (fitted, animation, *_)),) = split.fitted
        assert entry is experiment.clips[0]
        assert animation is base, "the animation is played as a whole"
        np.testing.assert_array_equal(fitted.mask, observed & ~held_out)
        np.testing.assert_array_equal(fitted.positions_ws, captured.positions_ws)
        assert held_out.sum() == pytest.approx(captured.frame_count / folds, abs=1.0)
    np.testing.assert_array_equal(times_held_out, 1)
    assert splits[-1].fitted == [(experiment.clips[0], data)]
    assert splits[-1].measured == [(data, slice(None))]


def test_an_impossible_variant_is_reported_by_name_before_any_fit(tmp_path, search):
    rest = '[[without]]\nname = "high"\nparameters = { contact.planted_height = 9.0 }\n'
    experiment = load(tmp_path, rest, free="contact.raised_height = {}")
    with pytest.raises(ValueError, match="high: .*contact.raised_height stays above"):
        ablation.fit_variants(experiment, tmp_path / "out")
    assert not search.calls


# Rows


def test_each_variant_is_fitted_on_all_parts_but_one_and_measured_on_that_one(tmp_path, search):
    rest = WITHOUT + '[sigmas]\nankle = 0.05\n[noise]\nsigmas = "estimated"\n'
    experiment = load(tmp_path, rest, top='fps = 15.0\nloss = "squares"\nholdout = 0.0')
    rows = ablation.fit_variants(experiment, tmp_path / "out")
    names = [(row.variant, row.part) for row in rows]
    assert names == [(name, part) for name in (ALL, PITCH, BOTH) for part in (1, 2, 0)]
    assert [list(row.values) for row in rows[::3]] == [
        ["pelvis.half_life", "foot.max_pitch"], ["pelvis.half_life"], []
    ]  # fmt: skip
    frames = [len(problem.data[0].frames.dt) for problem, _ in search.calls]
    assert frames == [91] * 6, "at the rate of the fit; no fit where nothing is free"
    observed = [problem.data[0].reference.observed for problem, _ in search.calls]
    assert not observed[0][:45].any() and not observed[1][46:].any()
    assert observed[0][46:].mean() > 0.9 and observed[1][:45].mean() > 0.9
    assert observed[2].mean() > 0.9
    captured, base, *_ = load_clip_data(experiment)
    difference = (base.positions_ws - captured.positions_ws)[:, captured.rig.pelvis, 1]
    half_lives = [float(frames.sum()) / 1000 for frames in observed] + [0.6] * 3
    for row, half_life in zip(rows, half_lives, strict=True):
        part = {1: slice(0, 90), 2: slice(90, 181), 0: slice(0, 181)}[row.part]
        expected = np.sqrt(np.mean((difference[part] + half_life) ** 2))
        assert row.agreement.pelvis == pytest.approx(expected, rel=1e-6), (row.variant, row.part)
    assert rows[6].message == "Nothing is free." and rows[6].converged
    assert rows[0].message == "Done." and rows[0].seconds == 0.5
    problem, variant = search.calls[3]
    assert float(parameter_tree.get(problem.space.system, "foot.max_pitch")) == 0.2
    assert float(problem.data[0].sigmas.ankle) == 0.05
    assert variant.free == {"pelvis.half_life": {}}
    assert {variant.noise for _, variant in search.calls} == {NoiseOptions("estimated")}


def test_without_a_folder_nothing_is_written_and_progress_says_what_is_fitted(
    tmp_path, search, monkeypatch
):
    experiment, recorder = load(tmp_path), Recorder()
    before = set(tmp_path.iterdir())
    monkeypatch.chdir(tmp_path)
    with activity.watched_by(recorder):
        rows = ablation.fit_variants(experiment)
    assert len(rows) == 9 and set(tmp_path.iterdir()) == before
    fits = [title for title in recorder.titles if title.startswith("Fitting ")]
    assert fits[:2] == ["Fitting 3 variants", "Fitting all rules, part 1 of 2"]
    assert fits[-1] == "Fitting pitch, everything"


# What is not fitted again


@pytest.mark.slow
def test_only_changed_variants_are_fitted_again(tmp_path, search, monkeypatch):
    out, new, clearings = tmp_path / "out", [], []
    monkeypatch.setattr(ablation.jax, "clear_caches", lambda: clearings.append(len(new)))

    def ablate(rest: str = WITHOUT, top: str = "", folds: int = 2) -> list[Row]:
        with listening(reported=new.append):
            return ablation.fit_variants(load(tmp_path, rest, top=top), out, folds=folds)

    first = ablate()
    assert new == first and len(search.calls) == 6
    assert clearings == [2, 5, 8], "with the last row of each variant its programs are dropped"
    renamed = ablate(WITHOUT.replace('pitch"', 'tilt"'))
    assert len(search.calls) == 6 and len(new) == 9 and len(clearings) == 3
    assert renamed[3].variant == "tilt"
    for row, before in zip(renamed, first, strict=True):
        assert dataclasses.replace(row, variant="") == dataclasses.replace(before, variant="")
    other = WITHOUT.replace("max_pitch = 0.2 }", "max_pitch = 0.25 }")
    ablate(other)
    assert len(search.calls) == 9, "pitch, on two parts and on everything"
    ablate(other, folds=3)
    assert len(search.calls) == 15, "both that are free, on three parts"
    ablate(other, "seed = 1", folds=3)
    assert len(search.calls) == 23
    kept = json.loads((out / ablation.NUMBERS).read_text())["rows"]
    assert len(kept) == 12, "rows of other variants and folds are dropped"


def test_a_changed_clip_is_fitted_again(tmp_path, search):
    paths = [line.split('"')[1] for line in SIX_SECONDS.splitlines() if '"' in line]
    clip = load_clip(paths[0])
    save_clip(tmp_path / "walk.npz", clip)
    clips = SIX_SECONDS.replace(paths[0], "walk.npz")
    ablation.fit_variants(load(tmp_path, "", clips=clips), tmp_path / "out")
    moved = clip.with_motion(clip.positions_ws + [0.0, 0.001, 0.0], clip.rotations_ws)
    save_clip(tmp_path / "walk.npz", moved)
    ablation.fit_variants(load(tmp_path, "", clips=clips), tmp_path / "out")
    assert len(search.calls) == 6


# The report


SEARCH: SearchRecord = {
    "converged": True, "message": "Far off.", "cost_before": 9.0, "cost": 1.0, "steps": 1,
    "starts": 1, "agreeing": 1, "seconds": 1.5,
}  # fmt: skip


def row(variant: str, part: int, **figures: float) -> Row:
    joints = dict.fromkeys(("pelvis", "knee"), figures.get("ankle", 0.02))
    all_figures = dict.fromkeys(ACCURACY, 0.02) | joints | figures
    values = {"pelvis.half_life": 0.3} | ({} if variant == PITCH else {"foot.max_pitch": 0.4})
    return Row(
        "key", variant, part, Accuracy(**all_figures), values, {**SEARCH, "converged": part != 2}
    )


ROWS = [
    row(ALL, 1, ankle=0.030), row(ALL, 2, ankle=0.032), row(ALL, 0, ankle=0.025),
    row(PITCH, 1, ankle=0.041), row(PITCH, 2, ankle=0.029), row(PITCH, 0, added_slip=np.nan),
]  # fmt: skip


def test_a_table_shows_how_much_a_figure_rises_without_a_rule():
    heading, complete, ablated = ablation.group(ROWS, 1)
    ankle = heading.index("ankle, cm")
    assert (complete[0], complete[ankle]) == ("all rules", "3.00")
    assert (ablated[0], ablated[ankle]) == ("without pitch", "4.10 (+1.10)")
    assert ablation.group(ROWS, 2)[2][ankle] == "2.90 (-0.30)"
    slip = heading.index("added slip, mm a frame")
    assert ablation.group(ROWS, 0)[2][slip] == "–"


def test_all_figures_are_in_the_csv_in_the_units_of_their_columns():
    lines = list(csv.DictReader(ablation.cells(ROWS).splitlines()))
    assert [(line["variant"], line["held out"]) for line in lines[:3]] == [
        ("all rules", "1"), ("all rules", "2"), ("all rules", "nothing")
    ]  # fmt: skip
    for key, column in ACCURACY.items():
        cell = float(lines[3][f"{key} [{column.unit}]"])
        assert cell == pytest.approx(column.factor * getattr(ROWS[3].agreement, key), rel=1e-5)
    assert lines[3]["fitted"] == "1" and lines[1]["converged"] == "False"


def test_summary_and_page_show_groups_ablations_and_fits_that_did_not_converge(tmp_path):
    experiment = load(tmp_path)
    ablation.document(experiment, ROWS).write(tmp_path)
    text = (tmp_path / ablation.TABLE).read_text()
    assert text.count("|  | all rules | without pitch |") == 3 and "Part 1 of 2 held out" in text
    assert "- **pitch**: `foot.max_pitch` = 0.2\n" in text
    assert "| `foot.max_pitch` | 0.4 | – |" in text
    assert "- Not converged: without pitch, part 2 held out: Far off." in text
    assert all(f"- **{column.heading} ({column.unit})**" in text for column in ACCURACY.values())
    head = (tmp_path / ablation.FIGURE).read_bytes()[:24]
    wide, high = struct.unpack(">II", head[16:24])
    assert 1000 < wide < 2000 and 400 < high < 2000
    page = Page(tmp_path / pages.PAGE)
    assert "2 fits not converged ◐ 2 of 6 fits did not converge" in page.text
    assert "3.10 cm from the captured ones (rms) on parts that were held out, 2.50 cm" in page.text
    assert "Not converged: without pitch, part 2 held out: Far off." in page.text
    assert page.elements.count("img") == 1 and "With and without each rule" in page.text


def test_the_page_says_what_a_rule_is_worth_where_it_was_not_fitted():
    for first, second, sentence, bad in (
        (
            0.041,
            0.035,
            "Without `pitch` pelvis, knees and ankles of held-out parts are 0.70",
            False,
        ),
        (0.041, 0.029, "0.40 cm further off, the most of all, on average, though not", False),
        (0.025, 0.031, "No rule is needed: without any one", True),
    ):
        held_out = [row(PITCH, 1, ankle=first), row(PITCH, 2, ankle=second)]
        _, rule, _ = ablation.findings([*ROWS[:3], *held_out, row(PITCH, 0)])
        assert sentence in rule.text and rule.bad is bad


def test_a_rule_that_moves_the_pelvis_alone_earns_something():
    held_out = [row(PITCH, part, ankle=0.03, pelvis=0.05) for part in (1, 2)]
    whole = [row(ALL, part, ankle=0.03, pelvis=0.02) for part in (0, 1, 2)]
    _, rule, _ = ablation.findings([*whole, *held_out, row(PITCH, 0)])
    assert "held-out parts are 1.08 cm further off, the most of all, in every part" in rule.text


def test_the_figure_has_a_bar_per_variant_and_a_point_per_part():
    figure = ablation.overview(ROWS, "hill")
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    panels = [axes for axes, title in zip(figure.axes, titles, strict=True) if title]
    headings = [title.partition(",")[0].lower() for title in titles if title]
    assert headings == [column.heading for column in ACCURACY.values()]
    ankle = panels[list(ACCURACY).index("ankle")]
    ends = [bar.get_window_extent().x1 for bar in ankle.patches]
    lengths = [ankle.transData.inverted().transform((end, 0.0))[0] for end in ends]
    np.testing.assert_allclose(lengths, [3.1, 3.5])
    points = [np.asarray(line.get_xdata()) for line in ankle.lines if line.get_marker() == "o"]
    np.testing.assert_allclose(points, [[3.0, 3.2], [4.1, 2.9]])


def test_the_command_prints_each_row_and_the_tables(tmp_path, search, undrawn, capsys):
    path, out = write_ablation(tmp_path), tmp_path / "out"
    assert main.main(["ablate", str(path), "-o", str(out)]) == 0
    text = capsys.readouterr().out
    assert text.startswith("all rules, part 1 held out: pelvis ")
    assert "\nwithout both, everything: pelvis " in text and f"read {out / 'table.md'}" in text
    assert len(ablation.read(out)) == 9
