"""What each rule contributes: cuts, variants, what is kept, and what is told of it."""

import csv
import dataclasses
import json
import signal
import struct
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from fitting.analysis.accuracy import Accuracy
from fitting.cli import main, progress
from fitting.datasets.clips import load_clip, save_clip
from fitting.experiments import experiment
from fitting.experiments.ablations import WHOLE, Variant
from fitting.inference.optimisation.solution import Progress, Solution
from fitting.report import ablation_report
from fitting.report.labels import ACCURACY
from fitting.studies import ablation
from fitting.studies.ablation import Row
from jaxik.maths import parameter_tree
from support import quick
from support.experiments import CLIP, write

SIX = CLIP + "end = 6.0\n"  # seconds, of the embedded walk
WITHOUT = """
[[without]]
name = "pitch"
parameters = { foot.max_pitch = 0.2 }
[[without]]
name = "both"
parameters = { foot.max_pitch = 0.2, pelvis.on_gain = 0.6 }
"""
ALL, PITCH, BOTH = WHOLE, "pitch", "both"
EVERYTHING = "everything"


def lifted(ik, base, ground, motion, floor):
    """A result that needs no pipeline: everything is as high as a gain says."""
    up = [0.0, float(parameter_tree.get(ik, "pelvis.on_gain")), 0.0]
    return None, base.with_motion(base.positions_ws + up, base.rotations_ws)


class Search:
    """A search that counts, and finds a value that says what it has been given."""

    def __init__(self) -> None:
        self.asked: list = []
        self.stop_at: int | None = None

    def __call__(self, problem, asked, progress):
        stopped = self.stop_at is not None and len(self.asked) >= self.stop_at
        self.asked.append((problem, asked))
        if progress is not None:
            progress(Progress("polish", 0, 1, 2.0, 1.0, 0.5))
        names = problem.space.names
        frames = sum(int(scene.reference.observed.sum()) for scene in problem.data)
        found = {name: 0.3 if name != "pelvis.on_gain" else frames / 1000 for name in names}
        u = np.asarray(problem.space.pack(found))
        values = np.asarray(problem.space.values(jnp.asarray(u)))
        return Solution(
            names, u, values, 9.0, 1.0, True, "Done.", np.zeros((1, len(names))), (), 1, 0.5,
            interrupted=stopped,
        )  # fmt: skip


@pytest.fixture
def search(monkeypatch) -> Search:
    made = Search()
    monkeypatch.setattr(ablation.study, "search", made)
    without_pipeline(monkeypatch)
    return made


SCENES: dict = {}  # by clip: it takes longer to make one than to test what is done with it


def without_pipeline(monkeypatch) -> None:
    """Results of `lifted`, and of each scene one for all tests."""
    make = experiment.make_scene

    def made(captured, base, ground, sigmas, label):
        mask = b"" if captured.mask is None else captured.mask.tobytes()
        key = captured.positions_ws.tobytes(), mask, tuple(sigmas.items())
        if key not in SCENES:
            SCENES[key] = make(captured, base, ground, sigmas, label)
        return SCENES[key]

    monkeypatch.setattr(experiment, "make_scene", made)
    monkeypatch.setattr(ablation, "solve", lifted)
    monkeypatch.setattr(ablation, "check_shapes", lambda *_: None)
    monkeypatch.setattr(
        ablation, "clip_frames", SimpleNamespace(frames_from_clip=lambda base: None)
    )


def asked(folder: Path, rest: str = WITHOUT, clips: str = SIX, **parts: str):
    return experiment_files.load_experiment(write(folder, rest=rest, clips=clips, **parts))


def pairs_of(read: experiment.Experiment) -> list[ablation.Pair]:
    return [problems.load_clip_data(entry, None) for entry in read.clips]


# Variants


def test_a_variant_fixes_what_it_says_and_leaves_the_rest_free(tmp_path):
    read = asked(tmp_path)
    other = ablation.changed(read, read.without[0])
    assert other.parameters == {"foot.max_pitch": 0.2}
    assert other.free == {"pelvis.on_gain": {}} and other.rules == {}
    assert ablation.changed(read, read.without[1]).free == {}


def test_a_variant_may_free_what_its_own_rules_have(tmp_path):
    rest = """
[[without]]
name = "reach"
rules = { pelvis = "SupportPelvis" }
free = { pelvis.lowest_share = { low = 0.1 } }
"""
    read = asked(tmp_path, rest)
    other = ablation.changed(read, read.without[0])
    assert "pelvis.on_gain" not in other.free  # it belongs to the rule that is exchanged
    assert other.free["pelvis.lowest_share"] == {"low": 0.1}
    with pytest.raises(ValueError, match="reach: free: unknown key 'pelvis.lowest_shore'"):
        asked(tmp_path, rest.replace("lowest_share", "lowest_shore"))


def test_a_variant_drops_what_its_rules_do_not_have_and_no_mistake(tmp_path):
    rest = "[parameters]\npelvis.limit = 0.3\nlock.enabled = false\n"
    free = 'pelvis.on_gain = {}\nfoot."max_pitch[0]" = {}\npelvis.of_gain = {}\n'
    read = asked(tmp_path, rest, free=free)
    other = ablation.changed(read, Variant("p", {"pelvis": "CapsulePelvis"}, {"pelvis.speed": 4.0}))
    assert other.rules == {"pelvis": "CapsulePelvis"}
    assert other.parameters == {"lock.enabled": False, "pelvis.speed": 4.0}
    assert set(other.free) == {"foot.max_pitch[0]", "pelvis.of_gain"}
    other = ablation.changed(read, Variant("f", {}, {"foot.max_pitch": 0.2}))
    assert set(other.free) == {"pelvis.on_gain", "pelvis.of_gain"}


# Cuts


@pytest.mark.parametrize("folds", [2, 3])
def test_what_is_held_out_is_not_fitted_and_all_else_is(tmp_path, folds):
    read = asked(tmp_path)
    (pair,) = pairs_of(read)
    captured, base, _ = pair
    splits = list(ablation.split(read.clips, [pair], folds))
    assert [one.name for one in splits[:-1]] == [f"part {i + 1} of {folds}" for i in range(folds)]
    seen = captured.mask if captured.mask is not None else np.ones(captured.frame_count, bool)
    counted = np.zeros(captured.frame_count, int)
    for one in splits[:-1]:
        ((measured, part),) = one.measured
        assert measured is pair
        held = np.zeros(captured.frame_count, bool)
        held[part] = True
        counted += held
        ((entry, (fitted, below, _)),) = one.fitted
        assert entry is read.clips[0] and below is base, "the animation is played as a whole"
        np.testing.assert_array_equal(fitted.mask, seen & ~held)
        np.testing.assert_array_equal(fitted.positions_ws, captured.positions_ws)
        assert held.sum() == pytest.approx(captured.frame_count / folds, abs=1.0)
    np.testing.assert_array_equal(counted, 1)
    assert splits[-1].name == EVERYTHING
    assert splits[-1].fitted == [(read.clips[0], pair)]
    assert splits[-1].measured == [(pair, slice(None))]


def test_a_part_in_which_a_foot_never_stands_is_refused_before_anything_is_fitted(tmp_path, search):
    with pytest.raises(ValueError, match=r"uneven_walk.npz: in part \d+ of 40, .* foot never stan"):
        ablation.contribution(asked(tmp_path), 40, tmp_path / "out")
    assert not search.asked and not (tmp_path / "out").exists()


@pytest.mark.parametrize("folds", [1, 0, -2])
def test_fewer_than_two_parts_are_refused(tmp_path, folds):
    with pytest.raises(ValueError, match=f"folds is {folds}; wanted 2 or more"):
        ablation.contribution(asked(tmp_path), folds, tmp_path / "out")


def test_a_variant_that_leaves_no_room_is_told_by_its_name_before_anything_is_fitted(
    tmp_path, search
):
    rest = '[[without]]\nname = "high"\nparameters = { contact.planted_height = 9.0 }\n'
    read = asked(tmp_path, rest, free="contact.raised_height = {}")
    with pytest.raises(ValueError, match="high: .*contact.raised_height stays above"):
        ablation.contribution(read, 2, tmp_path / "out")
    assert not search.asked


# Rows


def test_each_variant_is_fitted_on_all_parts_but_one_and_measured_on_that_one(tmp_path, search):
    read = asked(tmp_path, top="fps = 15.0")
    rows = ablation.contribution(read, 2, tmp_path / "out")
    names = [(row.variant, row.part) for row in rows]
    assert names == [(name, part) for name in (ALL, PITCH, BOTH) for part in (1, 2, 0)]
    assert [list(row.values) for row in rows[::3]] == [
        ["pelvis.on_gain", "foot.max_pitch"], ["pelvis.on_gain"], []
    ]  # fmt: skip
    frames = [len(problem.data[0].frames.dt) for problem, _ in search.asked]
    assert frames == [91] * 6, "at the rate of the fit, and not where nothing is free"
    seen = [problem.data[0].reference.observed for problem, _ in search.asked]
    assert not seen[0][:45].any() and not seen[1][46:].any()
    assert seen[0][46:].mean() > 0.9 and seen[1][:45].mean() > 0.9 and seen[2].mean() > 0.9
    (captured, base, _) = pairs_of(read)[0]
    apart = (base.positions_ws - captured.positions_ws)[:, captured.rig.pelvis, 1]
    gains = [float(one.sum()) / 1000 for one in seen] + [0.6] * 3
    for row, gain in zip(rows, gains, strict=True):
        part = {1: slice(0, 90), 2: slice(90, 181), 0: slice(0, 181)}[row.part]
        expected = np.sqrt(np.mean((apart[part] + gain) ** 2))
        assert row.agreement.pelvis == pytest.approx(expected, rel=1e-6), (row.variant, row.part)
    assert rows[6].message == "Nothing is free." and rows[6].converged
    assert rows[0].message == "Done." and rows[0].seconds == 0.5


def test_the_problem_of_a_variant_has_its_fixed_values_and_the_sigmas(tmp_path, search):
    rest = WITHOUT + "[sigmas]\nankle = 0.05\n"
    ablation.contribution(asked(tmp_path, rest), 2, tmp_path / "out")
    problem, other = search.asked[3]
    assert float(parameter_tree.get(problem.space.system, "foot.max_pitch")) == 0.2
    assert float(problem.data[0].sigmas.ankle) == 0.05
    assert other.free == {"pelvis.on_gain": {}}


def test_progress_says_what_is_being_fitted(tmp_path, search):
    seen: list[str] = []
    ablation.contribution(
        asked(tmp_path), 2, tmp_path / "out", progress=lambda one: seen.append(one.stage)
    )
    assert seen[0] == "all rules, part 1 of 2: polish"
    assert seen[-1] == "pitch, everything: polish"


# What is kept


def test_what_is_there_is_not_fitted_again(tmp_path, search):
    told, ends = [], []

    def again() -> list[Row]:
        return ablation.contribution(
            asked(tmp_path), 2, tmp_path / "out",
            told=told.append, between=lambda: ends.append(len(told)),
        )  # fmt: skip

    rows = again()
    assert told == rows and len(search.asked) == 6 and ends == [3, 6, 9]
    assert again() == rows
    assert len(search.asked) == 6 and len(told) == 9 and len(ends) == 3


def test_only_what_has_changed_is_fitted_again(tmp_path, search):
    out = tmp_path / "out"
    first = ablation.contribution(asked(tmp_path), 2, out)
    renamed = ablation.contribution(asked(tmp_path, WITHOUT.replace('pitch"', 'tilt"')), 2, out)
    assert len(search.asked) == 6 and renamed[3].variant == "tilt"
    assert [dataclasses.replace(row, variant="") for row in renamed] == [
        dataclasses.replace(row, variant="") for row in first
    ]
    other = WITHOUT.replace("max_pitch = 0.2 }", "max_pitch = 0.25 }")
    ablation.contribution(asked(tmp_path, other), 2, out)
    assert len(search.asked) == 9, "pitch, on two parts and on everything"
    ablation.contribution(asked(tmp_path, other), 3, out)
    assert len(search.asked) == 15, "both that are free, on three parts"
    ablation.contribution(asked(tmp_path, other, top="seed = 1"), 3, out)
    assert len(search.asked) == 23
    kept = json.loads((out / ablation.NUMBERS).read_text())["rows"]
    assert len(kept) == 12, "what belongs to other questions is dropped"


def test_another_clip_under_the_same_name_is_fitted_again(tmp_path, search):
    paths = [line.split('"')[1] for line in SIX.splitlines() if '"' in line]
    clip = load_clip(paths[0])
    save_clip(tmp_path / "walk.npz", clip)
    clips = SIX.replace(paths[0], "walk.npz")
    ablation.contribution(asked(tmp_path, "", clips), 2, tmp_path / "out")
    moved = clip.with_motion(clip.positions_ws + [0.0, 0.001, 0.0], clip.rotations_ws)
    save_clip(tmp_path / "walk.npz", moved)
    ablation.contribution(asked(tmp_path, "", clips), 2, tmp_path / "out")
    assert len(search.asked) == 6


def test_an_interrupted_call_goes_on_where_it_was(tmp_path, search):
    whole = ablation.contribution(asked(tmp_path), 2, tmp_path / "whole")
    search.asked.clear()
    search.stop_at = 4
    with pytest.raises(KeyboardInterrupt):
        ablation.contribution(asked(tmp_path), 2, tmp_path / "out")
    kept = ablation.read(tmp_path / "out")
    assert kept == whole[:4], "the fit that was stopped is not kept"
    search.stop_at = None
    assert ablation.contribution(asked(tmp_path), 2, tmp_path / "out") == whole
    assert len(search.asked) == 7


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"rows": [3]}', '{"rows": [{"key": "x"}]}'])
def test_a_file_of_something_else_is_refused(tmp_path, text, search):
    (tmp_path / ablation.NUMBERS).write_text(text)
    with pytest.raises(ValueError, match="contribution.json: not what `jaxik contribution` keeps"):
        ablation.contribution(asked(tmp_path), 2, tmp_path)
    assert (tmp_path / ablation.NUMBERS).read_text() == text


# What is told


def row(variant: str, part: int, **figures: float) -> Row:
    given = dict.fromkeys(ACCURACY, 0.02) | figures
    values = {"pelvis.on_gain": 0.3} | ({} if variant == PITCH else {"foot.max_pitch": 0.4})
    return Row("key", variant, part, Accuracy(**given), values, part != 2, "Far off.", 1.5)


ROWS = [
    row(ALL, 1, ankle=0.030), row(ALL, 2, ankle=0.032), row(ALL, 0, ankle=0.025),
    row(PITCH, 1, ankle=0.041), row(PITCH, 2, ankle=0.029), row(PITCH, 0, added_slip=np.nan),
]  # fmt: skip


def test_a_table_tells_by_how_much_a_figure_rises_without_a_rule():
    head, whole, other = ablation_report.group(ROWS, 1)
    at = head.index("ankle, cm")
    assert (whole[0], whole[at]) == ("all rules", "3.00")
    assert (other[0], other[at]) == ("without pitch", "4.10 (+1.10)")
    assert ablation_report.group(ROWS, 2)[2][at] == "2.90 (-0.30)"
    slip = head.index("added slip, mm a frame")
    assert ablation_report.group(ROWS, 0)[2][slip] == "–"


def test_all_figures_are_in_the_csv_in_the_units_of_their_columns():
    lines = list(csv.DictReader(ablation_report.cells(ROWS).splitlines()))
    assert [(one["variant"], one["held out"]) for one in lines[:3]] == [
        ("all rules", "1"), ("all rules", "2"), ("all rules", "nothing")
    ]  # fmt: skip
    for key, column in ACCURACY.items():
        cell = float(lines[3][f"{key} [{column.unit}]"])
        assert cell == pytest.approx(column.factor * getattr(ROWS[3].agreement, key), rel=1e-5)
    assert lines[3]["fitted"] == "1" and lines[1]["converged"] == "False"


def test_the_summary_has_every_group_what_is_left_out_and_what_did_not_converge(tmp_path):
    ablation_report.write(tmp_path, asked(tmp_path), ROWS)
    text = (tmp_path / ablation_report.TABLE).read_text()
    assert text.count("\n| without pitch |") == 3 and "Part 1 of 2 held out" in text
    assert "- **pitch**: `foot.max_pitch` = 0.2\n" in text
    assert "| `foot.max_pitch` | 0.4 | – |" in text
    assert "- without pitch, part 2 held out: Far off." in text
    assert all(f"- **{column.heading}** ({column.unit})" in text for column in ACCURACY.values())
    head = (tmp_path / ablation_report.FIGURE).read_bytes()[:24]
    wide, high = struct.unpack(">II", head[16:24])
    assert 1000 < wide < 2000 and 400 < high < 2000


def test_the_picture_has_a_bar_a_variant_and_a_point_a_part():
    figure = ablation_report.bars(ROWS, "hill")
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    panels = [axes for axes, title in zip(figure.axes, titles, strict=True) if title]
    heads = [title.partition(",")[0].lower() for title in titles if title]
    assert heads == [column.heading for column in ACCURACY.values()]
    ankle = panels[list(ACCURACY).index("ankle")]
    ends = [bar.get_window_extent().x1 for bar in ankle.patches]
    wide = [ankle.transData.inverted().transform((end, 0.0))[0] for end in ends]
    np.testing.assert_allclose(wide, [3.1, 3.5])
    points = [np.asarray(line.get_xdata()) for line in ankle.lines if line.get_marker() == "o"]
    np.testing.assert_allclose(points, [[3.0, 3.2], [4.1, 2.9]])


# The command


def test_the_command_goes_on_after_an_interrupt_and_then_leaves_its_tables(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(problems, "residuals_of_scenes", quick.residuals_of_scenes)
    without_pipeline(monkeypatch)
    path = write(tmp_path, rest=WITHOUT, clips=SIX)
    words = ["contribution", str(path), "-o", str(tmp_path / "out")]

    def interrupt(told: Progress) -> str:
        if told.stage.startswith("all rules, part 2"):
            signal.raise_signal(signal.SIGINT)
        return told.stage

    with monkeypatch.context() as patch:
        patch.setattr(progress, "fit_line", interrupt)
        patch.setattr(progress.time, "monotonic", iter(range(0, 10**9, 20)).__next__)
        assert main.main(words) == main.INTERRUPTED
    assert {one.name for one in (tmp_path / "out").iterdir()} == {ablation.NUMBERS}
    assert len(ablation.read(tmp_path / "out")) == 1
    said = capsys.readouterr().out
    assert said.startswith("all rules, part 1 held out: pelvis ") and said.count("\n") == 1
    assert main.main(words) == 0
    said = capsys.readouterr().out
    assert "without both" in said and f"read {tmp_path / 'out' / 'table.md'}" in said
    rows = ablation.read(tmp_path / "out")
    assert len(rows) == 9
    assert rows[0].values == pytest.approx(quick.TARGETS, abs=0.003)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--folds", "1"], "folds is 1; wanted 2"),
        (["--folds", "30"], "foot never stands; take few"),
    ],
)
def test_the_command_refuses_parts_that_cannot_be(more, said, tmp_path, capsys):
    path = write(tmp_path, clips=SIX)
    assert (
        main.main(["contribution", str(path), "-o", str(tmp_path / "out"), *more]) == main.MISTAKE
    )
    told = capsys.readouterr()
    assert said in told.err and told.err.count("\n") == 1 and not (tmp_path / "out").exists()
