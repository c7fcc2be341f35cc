"""Translation: the parameters of one system from the motion of another, and what remains."""

import json
import math
import os
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

import jaxik
from fitting.analysis import difference, playback
from fitting.cli import main
from fitting.datasets import clip_frames, clips
from fitting.datasets.clips import load_clip, save_clip
from fitting.datasets.flat_animation import load_flat_animation
from fitting.datasets.terrain import mesh_files
from fitting.experiments import parameter_files, problems, systems
from fitting.inference import sensitivity
from fitting.jobs import fits
from fitting.report import difference_report, translation_report
from fitting.report.labels import DIFFERENCES
from fitting.studies import run_folder, translation
from jaxik import presets
from jaxik.maths import parameter_tree
from support import quick, runs, small_studies
from support.experiments import ROOT
from support.refusals import refusal
from support.small_studies import save_pixel

GROUND = ROOT / "data" / "terrains" / "uneven_walk.ply"
TRUTH = {"pelvis.on_gain": 0.45, "pelvis.limit": 0.17}
SOFT = {"leg.soften": 0.96}  # of the source, but not free, so that a difference remains
STILL = {"leg.weight": 0.0, "lock.enabled": False, "pelvis.limit": 0.0}
QUANTITIES = ("ankle", "knee", "pelvis", "foot", "body")


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Path:
    """One and a half seconds of the uneven walk, up the first steps."""
    whole = load_clip(ROOT / "data" / "clips" / "uneven_walk_base.npz")
    path = tmp_path_factory.mktemp("clips") / "short.npz"
    save_clip(path, whole.select(slice(90, 135)))
    return path


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    """A parameter file of `record` with other values."""
    path = tmp_path_factory.mktemp("source") / "mine.toml"
    path.write_text(
        parameter_files.system_to_toml(parameter_tree.replace(presets.record(), TRUTH | SOFT))
    )
    return path


def command(clip: Path, out: Path, source: Path, free=quick.TARGETS) -> list[str]:
    words = ["translate", "--from", source, "--to", "record", "--free", ",".join(free)]
    return [*map(str, [*words, "--clip", clip, "--terrain", GROUND, "-o", out])]


@pytest.fixture(scope="module")
def run(source, clip, tmp_path_factory) -> Path:
    """A finished translation, of residuals that compile at once; tests must not change it."""
    folder = tmp_path_factory.mktemp("runs") / "mine"
    with pytest.MonkeyPatch.context() as patch:
        small_studies.quick_fits(patch)
        patch.setattr(Figure, "savefig", save_pixel)
        assert main.main(command(clip, folder, source)) == 0
    return folder


@pytest.mark.slow
def test_the_parameters_of_the_source_are_recovered(source, clip, tmp_path):
    run = tmp_path / "mine"
    assert main.main(command(clip, run, source, TRUTH)) == 0
    fitted, _ = parameter_files.load_system(run / "record.toml")
    for name, value in TRUTH.items():
        declared = parameter_tree.declarations(fitted)[name]
        tolerance = 0.05 * (declared.high - declared.low)
        assert float(parameter_tree.get(fitted, name)) == pytest.approx(value, abs=tolerance)
    text = (run / "summary.md").read_text()
    assert "2 of 2 determined parameters within 5 % of their range" in text
    numbers = json.loads((run / "translation.json").read_text())["reproduced"]["all frames"]
    assert 0.9 < numbers["ankle"]["reproduced"] < 0.999
    assert (run / "difference.png").stat().st_size > 10_000


def test_the_reported_differences_agree_with_an_independent_calculation(run, clip):
    base, reference = load_flat_animation(clip), load_clip(run / "source.npz")
    ik, _ = parameter_files.load_system(run / "record.toml")
    ground = mesh_files.load_terrain(GROUND)
    solved = clip_frames.clip_from_result(
        base, jaxik.run(ik, base.rig, ground, clip_frames.frames_from_clip(base))
    )

    def differences(clip_):
        _, knee, ankle, _ = np.transpose(clip_.rig.joints)
        pelvis = [clip_.rig.pelvis]
        offsets = np.linalg.norm(clip_.positions_ws - reference.positions_ws, axis=-1)
        flat = (each.rotations_ws.reshape(-1, 4) for each in (clip_, reference))
        a, b = (Rotation.from_quat(each, scalar_first=True) for each in flat)
        angles = (a.inv() * b).magnitude().reshape(offsets.shape)
        of_joints = {"ankle": ankle, "knee": knee, "pelvis": pelvis}
        turned = {"foot": angles[:, ankle], "body": angles[:, pelvis]}
        return {name: offsets[:, joints] for name, joints in of_joints.items()} | turned

    numbers = json.loads((run / "translation.json").read_text())["reproduced"]["all frames"]
    summary = (run / "summary.md").read_text()
    after, before = differences(solved), differences(base)
    for name in QUANTITIES:
        rms, correction = (np.sqrt(np.mean(each[name] ** 2)) for each in (after, before))
        factor = 1000 if name in QUANTITIES[:3] else np.degrees(1)
        assert numbers[name]["rms"] == pytest.approx(factor * rms, abs=1e-6)
        assert numbers[name]["correction"] == pytest.approx(factor * correction, abs=1e-6)
        assert numbers[name]["max"] == pytest.approx(factor * after[name].max(), abs=1e-6)
        if name == "body":  # the source does not rotate it in this clip
            assert numbers[name]["reproduced"] is None
            continue
        assert numbers[name]["reproduced"] == pytest.approx(1 - rms / correction, abs=1e-6)
        percentage = f"{100 * (1 - rms / correction):.1f} %"
        assert f"{percentage} of that of the {DIFFERENCES[name].name}" in summary


def test_the_folder_is_a_run_with_the_same_problem(run, clip, monkeypatch):
    small_studies.quick_fits(monkeypatch)
    experiment, summary = run_folder.load_fit(run)
    assert set(experiment.free) == set(quick.TARGETS) and summary["converged"]
    text = (run / "experiment.toml").read_text()
    base = Path(os.path.relpath(clip, run)).as_posix()
    assert 'reference = "source.npz"' in text and f'base = "{base}"' in text
    ik, _ = parameter_files.load_system(run / "parameters.toml")
    problem = problems.make_problem(experiment)
    u = problem.space.pack(ik)
    assert float(problem.cost(u)) == pytest.approx(summary["cost"], rel=1e-6)


def test_the_summary_shows_both_systems_side_by_side(run):
    text = (run / "summary.md").read_text()
    assert text.startswith("# mine to record\n")
    assert "## How much of `mine` `record` reproduces" in text and "difference.png" in text
    table = text.partition("## Parameters of both systems")[2].splitlines()
    (line,) = (line for line in table if line.startswith("| `pelvis.on_gain`"))
    assert line.startswith("| `pelvis.on_gain` | 1/tick | 0.45 | 0.") and line.endswith("fitted |")
    assert (
        "`lean.gain_slide`" in text.partition("kept their values, as requested:")[2].splitlines()[0]
    )
    assert (run / "source.toml").is_file() and (run / "difference.png").is_file()
    assert parameter_files.load_system(run / "record.toml")[1] == systems.DEFAULT_PRESET


def test_a_target_that_does_not_follow_is_reported_with_its_worst_place(run):
    (scene,) = problems.make_problem(run_folder.load_fit(run)[0]).data
    still = parameter_tree.replace(presets.record(), STILL)
    measured = difference.measure(scene, playback.run(still, scene))
    numbers = difference_report.numbers([measured])["all frames"]
    reproduced = numbers["ankle"]["reproduced"]
    assert reproduced is not None and reproduced < 0.3
    sentence, *_ = difference_report.shortcomings([measured], "a", "b")
    assert sentence.startswith("Ankles: ") and "(rms) remain of" in sentence
    worst = 1000 * measured.remaining["ankle"].max()
    assert f"at most {worst:.4g} mm" in sentence


def test_standing_and_moving_frames_are_counted_separately():
    frames = np.arange(4)
    zeros, ones = np.zeros((4, 2)), np.ones((4, 2))
    late = np.stack([np.array([0.0, 0.0, 1.0, 1.0])] * 2, axis=1)
    correction: dict[str, np.ndarray] = dict.fromkeys(difference.QUANTITIES, ones)
    remaining = correction | {"ankle": late, "knee": zeros}
    half = difference.Difference(("left", "right"), frames * 0.1, frames < 2, correction, remaining)
    numbers = difference_report.numbers([half])
    assert numbers["standing"]["ankle"]["reproduced"] == 1.0
    assert numbers["moving"]["ankle"]["reproduced"] == 0.0
    assert numbers["all frames"]["ankle"]["rms"] == pytest.approx(1000 * math.sqrt(0.5))
    assert numbers["all frames"]["knee"]["reproduced"] == 1.0
    never = difference.Difference(half.legs, half.time, frames < 0, correction, correction)
    assert set(difference_report.numbers([never])) == {"all frames"}


def test_a_quantity_that_the_source_does_not_correct_has_no_fraction():
    correction: dict[str, np.ndarray] = dict.fromkeys(difference.QUANTITIES, np.zeros((3, 1)))
    remaining = correction | {"foot": np.full((3, 1), 0.02)}
    rotated = difference.Difference(
        ("left",), np.arange(3.0), np.zeros(3, bool), correction, remaining
    )
    numbers = difference_report.numbers([rotated])["all frames"]
    assert numbers["foot"]["reproduced"] is None
    assert numbers["foot"]["rms"] == pytest.approx(np.degrees(0.02))
    (text,) = difference_report.shortcomings([rotated], "a", "b")
    assert text.startswith("a leaves the orientation of the feet as animated; b is 1.146 ° (rms)")
    table = difference_report.table(difference.summarise([rotated])["all frames"], "a")
    assert table[4][-1] == "–"


def test_only_parameters_that_move_the_clip_are_free_by_default(run):
    (scene,) = problems.make_problem(run_folder.load_fit(run)[0]).data
    named = sensitivity.all_parameters(presets.record())
    assert {"probe.toe_ls[0]", "probe.toe_ls[2]", "pelvis.limit"} <= set(named)
    assert named["lock.max_speed"] == {"high": 12.0}  # it is infinite: that must be within reach
    tried = ("pelvis.limit", "lean.gain_slide", "leg.max_knee_angle")
    few = {name: named[name] for name in tried}
    moving = sensitivity.measure_sensitivity(presets.record(), few, (scene,))
    assert set(moving) == {"pelvis.limit", "leg.max_knee_angle"}  # nothing slides in this clip
    assert moving["pelvis.limit"] > 5.0


def test_an_interrupted_translation_writes_its_best_point(
    undrawn, source, clip, tmp_path, monkeypatch
):
    search = fits.search

    def interrupt(_: object) -> None:
        raise KeyboardInterrupt

    def interrupted(problem, experiment, progress, *rest):
        return search(problem, experiment, interrupt, *rest)

    small_studies.quick_fits(monkeypatch)
    monkeypatch.setattr(fits, "search", interrupted)
    assert main.main(command(clip, tmp_path / "run", source)) == main.INTERRUPTED
    numbers = json.loads((tmp_path / "run" / run_folder.FIT).read_text())
    assert numbers["message"].startswith("Interrupted after 0 steps")
    assert "Interrupted after 0 steps" in (tmp_path / "run" / run_folder.SUMMARY).read_text()
    assert (tmp_path / "run" / "source.npz").is_file()


@pytest.mark.parametrize(
    ("module", "name"),
    [(clips, "save_clip"), (fits, "load_known_values"), (fits, "assess_solution")],
    ids=["before its source", "before its fit", "before its profiles"],
)
def test_a_translation_that_dies_after_its_search_goes_on_in_its_folder(
    run, clip, source, tmp_path, monkeypatch, module, name, capsys
):
    small_studies.quick_fits(monkeypatch)
    monkeypatch.setattr(translation_report, "write", lambda *_: None)
    out = tmp_path / "run"
    with monkeypatch.context() as patch, pytest.raises(ZeroDivisionError):
        patch.setattr(module, name, lambda *_, **__: 1 / 0)
        main.main(command(clip, out, source))
    assert (out / run_folder.SEARCH).is_file()
    assert main.main(command(clip, out, source)) == 0
    assert "goes on after" in capsys.readouterr().out
    assert runs.placeless(out) == runs.placeless(run)
    for file in (run_folder.PARAMETERS, translation.SOURCE, "source.npz"):
        assert (out / file).read_bytes() == (run / file).read_bytes()


def test_a_source_that_moves_nothing_is_refused(clip, tmp_path, capsys):
    still = STILL | {f"lean.{side}_rate": 0.0 for side in ("forward", "side")}
    path = tmp_path / "still.toml"
    path.write_text(parameter_files.system_to_toml(parameter_tree.replace(presets.record(), still)))
    line = refusal(command(clip, tmp_path / "run", path), tmp_path, capsys)
    assert "still moves nothing in these clips" in line


def test_a_file_of_free_parameters_may_have_ranges(tmp_path):
    path = tmp_path / "free.toml"
    path.write_text("[free]\npelvis.limit = { high = 0.4 }\n")
    assert translation.read_free(str(path), presets.record()) == {"pelvis.limit": {"high": 0.4}}
