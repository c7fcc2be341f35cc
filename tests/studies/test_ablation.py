"""Ablation: variants, splits, rows, resuming, and the report."""

import csv
import dataclasses
import json
import signal
import struct
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from fitting.analysis.accuracy import Accuracy
from fitting.cli import main, progress
from fitting.datasets.clips import load_clip, save_clip
from fitting.experiments import problems
from fitting.experiments.ablations import COMPLETE, Ablation
from fitting.experiments.experiment import Experiment
from fitting.experiments.experiment_files import load_experiment
from fitting.experiments.problems import ClipData
from fitting.inference.noise.settings import NoiseOptions
from fitting.inference.optimisation.solution import Progress, Solution
from fitting.report import ablation_report
from fitting.report.labels import ACCURACY
from fitting.report.page.studies import ablation_page
from fitting.report.plots import ablation_plots
from fitting.studies import ablation, run_folder
from fitting.studies.ablation import Row
from fitting.studies.animations import Animation
from jaxik.maths import parameter_tree
from support import quick
from support.experiments import CLIP, write
from support.pages import Page

SIX = CLIP + "end = 6.0\n"  # seconds, of the embedded walk
WITHOUT = """
[[without]]
name = "pitch"
parameters = { foot.max_pitch = 0.2 }
[[without]]
name = "both"
parameters = { foot.max_pitch = 0.2, pelvis.on_gain = 0.6 }
"""
ALL, PITCH, BOTH = COMPLETE, "pitch", "both"
EVERYTHING = "everything"


def lift(animation, ik):
    """A result that needs no pipeline: everything is raised by the value of a gain, m."""
    base = animation.clip
    up = [0.0, float(parameter_tree.get(ik, "pelvis.on_gain")), 0.0]
    return None, base.with_motion(base.positions_ws + up, base.rotations_ws)


class Search:
    """A search that remembers its calls; the gain it finds is a thousandth of the frame count."""

    def __init__(self) -> None:
        self.calls: list = []
        self.stop_at: int | None = None

    def __call__(self, problem, experiment, progress):
        stopped = self.stop_at is not None and len(self.calls) >= self.stop_at
        self.calls.append((problem, experiment))
        if progress is not None:
            progress(Progress("polish", 0, 1, 2.0, 1.0, 0.5))
        names = problem.space.names
        frames = sum(int(scene.reference.observed.sum()) for scene in problem.data)
        best = {name: 0.3 if name != "pelvis.on_gain" else frames / 1000 for name in names}
        u = np.asarray(problem.space.pack(best))
        values = np.asarray(problem.space.values(jnp.asarray(u)))
        return problem, Solution(
            names, u, values, 9.0, 1.0, True, "Done.", np.zeros((1, len(names))), (), 1, 0.5,
            interrupted=stopped,
        )  # fmt: skip


@pytest.fixture
def search(monkeypatch) -> Search:
    counted = Search()
    monkeypatch.setattr(ablation, "search_with_noise", counted)
    without_pipeline(monkeypatch)
    return counted


SCENES: dict = {}  # by clip: making one takes longer than the test that uses it


def without_pipeline(monkeypatch) -> None:
    """Replaces the pipeline by `lift`, and makes each scene once for all tests."""
    make_scene = problems.make_scene

    def cached(data, sigmas, label):
        captured = data.reference
        mask = b"" if captured.mask is None else captured.mask.tobytes()
        key = captured.positions_ws.tobytes(), mask, tuple(sigmas.items())
        if key not in SCENES:
            SCENES[key] = make_scene(data, sigmas, label)
        return SCENES[key]

    monkeypatch.setattr(problems, "make_scene", cached)
    monkeypatch.setattr(Animation, "solve", lift)
    monkeypatch.setattr(Animation, "check_shapes", lambda *_: None)
    monkeypatch.setattr(ablation.jax, "clear_caches", lambda: None)


def load(folder: Path, rest: str = WITHOUT, clips: str = SIX, **parts: str) -> Experiment:
    return load_experiment(write(folder, rest=rest, clips=clips, **parts))


def load_clips(experiment: Experiment) -> list[ClipData]:
    return [problems.load_clip_data(entry, None) for entry in experiment.clips]


# Variants


def test_an_ablation_fixes_its_parameters_and_leaves_the_rest_free(tmp_path):
    experiment = load(tmp_path)
    variant = ablation.without(experiment, experiment.without[0])
    assert variant.parameters == {"foot.max_pitch": 0.2}
    assert variant.free == {"pelvis.on_gain": {}} and variant.rules == {}
    assert ablation.without(experiment, experiment.without[1]).free == {}


def test_an_ablation_may_free_parameters_of_its_own_rules(tmp_path):
    rest = """
[[without]]
name = "reach"
rules = { pelvis = "SupportPelvis" }
free = { pelvis.lowest_share = { low = 0.1 } }
"""
    experiment = load(tmp_path, rest)
    variant = ablation.without(experiment, experiment.without[0])
    assert "pelvis.on_gain" not in variant.free  # it belongs to the rule that is replaced
    assert variant.free["pelvis.lowest_share"] == {"low": 0.1}
    with pytest.raises(ValueError, match="reach: free: unknown key 'pelvis.lowest_shore'"):
        load(tmp_path, rest.replace("lowest_share", "lowest_shore"))


def test_an_ablation_drops_parameters_that_its_rules_do_not_have_but_no_mistakes(tmp_path):
    rest = "[parameters]\npelvis.limit = 0.3\nlock.enabled = false\n"
    free = 'pelvis.on_gain = {}\nfoot."max_pitch[0]" = {}\npelvis.of_gain = {}\n'
    experiment = load(tmp_path, rest, free=free)
    variant = ablation.without(
        experiment, Ablation("p", {"pelvis": "CapsulePelvis"}, {"pelvis.speed": 4.0})
    )
    assert variant.rules == {"pelvis": "CapsulePelvis"}
    assert variant.parameters == {"lock.enabled": False, "pelvis.speed": 4.0}
    assert set(variant.free) == {"foot.max_pitch[0]", "pelvis.of_gain"}
    variant = ablation.without(experiment, Ablation("f", {}, {"foot.max_pitch": 0.2}))
    assert set(variant.free) == {"pelvis.on_gain", "pelvis.of_gain"}


# Splits


@pytest.mark.parametrize("folds", [2, 3])
def test_the_held_out_part_is_not_fitted_and_everything_else_is(tmp_path, folds):
    experiment = load(tmp_path)
    (data,) = load_clips(experiment)
    captured, base, *_ = data
    splits = list(ablation.split(experiment.clips, [data], folds))
    assert [split.name for split in splits[:-1]] == [
        f"part {i + 1} of {folds}" for i in range(folds)
    ]
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
    assert splits[-1].name == EVERYTHING
    assert splits[-1].fitted == [(experiment.clips[0], data)]
    assert splits[-1].measured == [(data, slice(None))]


def test_a_part_in_which_a_foot_never_stands_is_rejected_before_any_fit(tmp_path, search):
    with pytest.raises(ValueError, match=r"uneven_walk.npz: in part \d+ of 40, .* foot never stan"):
        ablation.ablate(load(tmp_path), tmp_path / "out", folds=40)
    assert not search.calls and not (tmp_path / "out").exists()


@pytest.mark.parametrize("folds", [1, 0, -2])
def test_fewer_than_two_folds_are_rejected(tmp_path, folds):
    with pytest.raises(ValueError, match=f"folds is {folds}; wanted 2 or more"):
        ablation.ablate(load(tmp_path), tmp_path / "out", folds=folds)


def test_an_impossible_variant_is_reported_by_name_before_any_fit(tmp_path, search):
    rest = '[[without]]\nname = "high"\nparameters = { contact.planted_height = 9.0 }\n'
    experiment = load(tmp_path, rest, free="contact.raised_height = {}")
    with pytest.raises(ValueError, match="high: .*contact.raised_height stays above"):
        ablation.ablate(experiment, tmp_path / "out")
    assert not search.calls


# Rows


@pytest.mark.slow
def test_each_variant_is_fitted_on_all_parts_but_one_and_measured_on_that_one(tmp_path, search):
    experiment = load(tmp_path, top="fps = 15.0")
    rows = ablation.ablate(experiment, tmp_path / "out")
    names = [(row.variant, row.part) for row in rows]
    assert names == [(name, part) for name in (ALL, PITCH, BOTH) for part in (1, 2, 0)]
    assert [list(row.values) for row in rows[::3]] == [
        ["pelvis.on_gain", "foot.max_pitch"], ["pelvis.on_gain"], []
    ]  # fmt: skip
    frames = [len(problem.data[0].frames.dt) for problem, _ in search.calls]
    assert frames == [91] * 6, "at the rate of the fit; no fit where nothing is free"
    observed = [problem.data[0].reference.observed for problem, _ in search.calls]
    assert not observed[0][:45].any() and not observed[1][46:].any()
    assert observed[0][46:].mean() > 0.9 and observed[1][:45].mean() > 0.9
    assert observed[2].mean() > 0.9
    (captured, base, *_) = load_clips(experiment)[0]
    difference = (base.positions_ws - captured.positions_ws)[:, captured.rig.pelvis, 1]
    gains = [float(frames.sum()) / 1000 for frames in observed] + [0.6] * 3
    for row, gain in zip(rows, gains, strict=True):
        part = {1: slice(0, 90), 2: slice(90, 181), 0: slice(0, 181)}[row.part]
        expected = np.sqrt(np.mean((difference[part] + gain) ** 2))
        assert row.agreement.pelvis == pytest.approx(expected, rel=1e-6), (row.variant, row.part)
    assert rows[6].message == "Nothing is free." and rows[6].converged
    assert rows[0].message == "Done." and rows[0].seconds == 0.5


def test_the_problem_of_a_variant_has_its_fixed_values_and_the_sigmas(tmp_path, search):
    rest = WITHOUT + "[sigmas]\nankle = 0.05\n"
    ablation.ablate(load(tmp_path, rest), tmp_path / "out")
    problem, variant = search.calls[3]
    assert float(parameter_tree.get(problem.space.system, "foot.max_pitch")) == 0.2
    assert float(problem.data[0].sigmas.ankle) == 0.05
    assert variant.free == {"pelvis.on_gain": {}}


def test_every_variant_estimates_the_noise_that_the_experiment_says(tmp_path, search):
    ablation.ablate(load(tmp_path, WITHOUT + '[noise]\nsigmas = "estimated"\n'))
    assert {variant.noise for _, variant in search.calls} == {NoiseOptions("estimated")}


def test_progress_says_what_is_being_fitted(tmp_path, search):
    stages: list[str] = []
    ablation.ablate(load(tmp_path), progress=lambda report: stages.append(report.stage))
    assert stages[0] == "all rules, part 1 of 2: polish"
    assert stages[-1] == "pitch, everything: polish"


# Resuming


def test_finished_fits_are_not_repeated(tmp_path, search, monkeypatch):
    new_rows, clearings = [], []
    monkeypatch.setattr(ablation.jax, "clear_caches", lambda: clearings.append(len(new_rows)))

    def ablate() -> list[Row]:
        return ablation.ablate(load(tmp_path), tmp_path / "out", on_row=new_rows.append)

    rows = ablate()
    assert new_rows == rows and len(search.calls) == 6
    assert clearings == [3, 6, 9], "after each variant its programs are dropped"
    assert ablate() == rows
    assert len(search.calls) == 6 and len(new_rows) == 9 and len(clearings) == 3


def test_without_a_folder_nothing_is_written(tmp_path, search, monkeypatch):
    experiment = load(tmp_path)
    before = set(tmp_path.iterdir())
    monkeypatch.chdir(tmp_path)
    assert len(ablation.ablate(experiment)) == 9
    assert set(tmp_path.iterdir()) == before


def test_only_changed_variants_are_fitted_again(tmp_path, search):
    out = tmp_path / "out"
    first = ablation.ablate(load(tmp_path), out)
    renamed = ablation.ablate(load(tmp_path, WITHOUT.replace('pitch"', 'tilt"')), out)
    assert len(search.calls) == 6 and renamed[3].variant == "tilt"
    assert [dataclasses.replace(row, variant="") for row in renamed] == [
        dataclasses.replace(row, variant="") for row in first
    ]
    other = WITHOUT.replace("max_pitch = 0.2 }", "max_pitch = 0.25 }")
    ablation.ablate(load(tmp_path, other), out)
    assert len(search.calls) == 9, "pitch, on two parts and on everything"
    ablation.ablate(load(tmp_path, other), out, folds=3)
    assert len(search.calls) == 15, "both that are free, on three parts"
    ablation.ablate(load(tmp_path, other, top="seed = 1"), out, folds=3)
    assert len(search.calls) == 23
    kept = json.loads((out / ablation.NUMBERS).read_text())["rows"]
    assert len(kept) == 12, "rows of other variants and folds are dropped"


def test_a_changed_clip_is_fitted_again(tmp_path, search):
    paths = [line.split('"')[1] for line in SIX.splitlines() if '"' in line]
    clip = load_clip(paths[0])
    save_clip(tmp_path / "walk.npz", clip)
    clips = SIX.replace(paths[0], "walk.npz")
    ablation.ablate(load(tmp_path, "", clips), tmp_path / "out")
    moved = clip.with_motion(clip.positions_ws + [0.0, 0.001, 0.0], clip.rotations_ws)
    save_clip(tmp_path / "walk.npz", moved)
    ablation.ablate(load(tmp_path, "", clips), tmp_path / "out")
    assert len(search.calls) == 6


def test_an_interrupted_ablation_continues(tmp_path, search):
    complete = ablation.ablate(load(tmp_path), tmp_path / "complete")
    search.calls.clear()
    search.stop_at = 4
    with pytest.raises(KeyboardInterrupt):
        ablation.ablate(load(tmp_path), tmp_path / "out")
    kept = ablation.read(tmp_path / "out")
    assert kept == complete[:4], "the interrupted fit is not kept"
    search.stop_at = None
    assert ablation.ablate(load(tmp_path), tmp_path / "out") == complete
    assert len(search.calls) == 7


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"rows": [3]}', '{"rows": [{"key": "x"}]}'])
def test_a_file_of_something_else_is_rejected(tmp_path, text, search):
    (tmp_path / ablation.NUMBERS).write_text(text)
    with pytest.raises(ValueError, match="contribution.json: not written by `jaxik ablate`"):
        ablation.ablate(load(tmp_path), tmp_path)
    assert (tmp_path / ablation.NUMBERS).read_text() == text


# The report


def row(variant: str, part: int, **figures: float) -> Row:
    all_figures = dict.fromkeys(ACCURACY, 0.02) | figures
    values = {"pelvis.on_gain": 0.3} | ({} if variant == PITCH else {"foot.max_pitch": 0.4})
    return Row("key", variant, part, Accuracy(**all_figures), values, part != 2, "Far off.", 1.5)


ROWS = [
    row(ALL, 1, ankle=0.030), row(ALL, 2, ankle=0.032), row(ALL, 0, ankle=0.025),
    row(PITCH, 1, ankle=0.041), row(PITCH, 2, ankle=0.029), row(PITCH, 0, added_slip=np.nan),
]  # fmt: skip


def test_a_table_shows_how_much_a_figure_rises_without_a_rule():
    heading, complete, ablated = ablation_report.group(ROWS, 1)
    ankle = heading.index("ankle, cm")
    assert (complete[0], complete[ankle]) == ("all rules", "3.00")
    assert (ablated[0], ablated[ankle]) == ("without pitch", "4.10 (+1.10)")
    assert ablation_report.group(ROWS, 2)[2][ankle] == "2.90 (-0.30)"
    slip = heading.index("added slip, mm a frame")
    assert ablation_report.group(ROWS, 0)[2][slip] == "–"


def test_all_figures_are_in_the_csv_in_the_units_of_their_columns():
    lines = list(csv.DictReader(ablation_report.cells(ROWS).splitlines()))
    assert [(line["variant"], line["held out"]) for line in lines[:3]] == [
        ("all rules", "1"), ("all rules", "2"), ("all rules", "nothing")
    ]  # fmt: skip
    for key, column in ACCURACY.items():
        cell = float(lines[3][f"{key} [{column.unit}]"])
        assert cell == pytest.approx(column.factor * getattr(ROWS[3].agreement, key), rel=1e-5)
    assert lines[3]["fitted"] == "1" and lines[1]["converged"] == "False"


def test_the_summary_shows_groups_ablations_and_fits_that_did_not_converge(tmp_path):
    ablation_report.write(tmp_path, load(tmp_path), ROWS)
    text = (tmp_path / ablation_report.TABLE).read_text()
    assert text.count("\n| without pitch |") == 3 and "Part 1 of 2 held out" in text
    assert "- **pitch**: `foot.max_pitch` = 0.2\n" in text
    assert "| `foot.max_pitch` | 0.4 | – |" in text
    assert "- without pitch, part 2 held out: Far off." in text
    assert all(f"- **{column.heading}** ({column.unit})" in text for column in ACCURACY.values())
    head = (tmp_path / ablation_report.FIGURE).read_bytes()[:24]
    wide, high = struct.unpack(">II", head[16:24])
    assert 1000 < wide < 2000 and 400 < high < 2000


def test_the_page_begins_with_fits_that_did_not_converge(tmp_path):
    experiment = load(tmp_path)
    ablation_report.write(tmp_path, experiment, ROWS)
    ablation_page.write(tmp_path, experiment, ROWS)
    page = Page(tmp_path / run_folder.PAGE)
    assert "2 fits not converged ◐ 2 of 6 fits did not converge" in page.text
    assert "3.10 cm from the captured ones (rms) on parts that were held out, 2.50 cm" in page.text
    assert "Not converged: without pitch, part 2 held out: Far off." in page.text
    assert page.elements.count("img") == 1 and "With and without each rule" in page.text


@pytest.mark.parametrize(
    ("ankles", "sentence", "bad"),
    [
        ((0.041, 0.035), "Without `pitch` the ankles of held-out parts are 0.70 cm further", False),
        ((0.041, 0.029), "0.40 cm further off, the most of all, on average, though not", False),
        ((0.025, 0.031), "No rule is needed: without any one", True),
    ],
)
def test_the_page_says_what_a_rule_is_worth_where_it_was_not_fitted(ankles, sentence, bad):
    rows = [*ROWS[:3], row(PITCH, 1, ankle=ankles[0]), row(PITCH, 2, ankle=ankles[1])]
    _, rule, _ = ablation_page.findings([*rows, row(PITCH, 0)])
    assert sentence in rule.text and rule.bad is bad


def test_the_figure_has_a_bar_per_variant_and_a_point_per_part():
    figure = ablation_plots.overview(ROWS, "hill")
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


# The command


@pytest.mark.slow
def test_the_command_continues_after_an_interrupt_and_writes_its_tables(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(problems, "residuals_of_scenes", quick.residuals_of_scenes)
    without_pipeline(monkeypatch)
    path = write(tmp_path, rest=WITHOUT, clips=SIX)
    words = ["ablate", str(path), "-o", str(tmp_path / "out")]

    def interrupt(report: Progress) -> str:
        if report.stage.startswith("all rules, part 2"):
            signal.raise_signal(signal.SIGINT)
        return report.stage

    with monkeypatch.context() as patch:
        patch.setattr(progress, "fit_line", interrupt)
        assert main.main(words) == main.INTERRUPTED
    assert {path.name for path in (tmp_path / "out").iterdir()} == {ablation.NUMBERS}
    assert len(ablation.read(tmp_path / "out")) == 1
    text = capsys.readouterr().out
    assert text.startswith("all rules, part 1 held out: pelvis ") and text.count("\n") == 1
    assert main.main(words) == 0
    text = capsys.readouterr().out
    assert "without both" in text and f"read {tmp_path / 'out' / 'table.md'}" in text
    rows = ablation.read(tmp_path / "out")
    assert len(rows) == 9
    assert rows[0].values == pytest.approx(quick.TARGETS, abs=0.003)


def test_the_command_rejects_more_folds_than_feet_stand_in(tmp_path, capsys):
    path, out = write(tmp_path, clips=SIX), str(tmp_path / "out")
    assert main.main(["ablate", str(path), "-o", out, "--folds", "30"]) == main.MISTAKE
    error = capsys.readouterr().err
    assert (
        "foot never stands; take few" in error
        and error.count("\n") == 1
        and not (tmp_path / "out").exists()
    )
