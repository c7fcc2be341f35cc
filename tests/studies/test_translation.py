"""Translation: the parameters of one system from the motion of another, and what remains."""

import json
import math
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

import jaxik
from fitting import clips
from fitting.cli import main
from fitting.clips import load_clip, save_clip
from fitting.experiment import parameter_files, problems, systems
from fitting.ground import meshes
from fitting.inference import sensitivity
from fitting.motion import accuracy
from fitting.motion.flat_animation import load_flat_animation
from fitting.motion.playback import ClipActivity
from fitting.report.formatting import DIFFERENCES
from fitting.studies import translation
from fitting.studies.animations import Animation
from fitting.studies.fit import fit_report, run_folder
from jaxik import presets
from jaxik.maths import parameter_tree
from jaxik.world.skeleton import Transform
from support import quick, runs, small_studies
from support.commands import refusal
from support.experiments import ROOT
from support.pages import save_pixel

GROUND = ROOT / "data" / "terrains" / "uneven_walk.ply"
TRUTH = {"pelvis.half_life": 0.45, "pelvis.limit": 0.17}
SOFT = {"leg.soften": 0.96}  # of the source, but not free, so that a difference remains
STILL = {"leg.weight": 0.0, "lock.enabled": False, "pelvis.limit": 0.0}
QUANTITIES = ("ankle", "knee", "pelvis", "foot", "body")
ONES = np.ones(2)
# Of limits, which would be measured by a program of their own.
ACTIVITY = ClipActivity(("left", "right"), 45, 1.5, ONES, ONES, ONES, ONES, (1, 1), (1, 1), {})


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Path:
    """One and a half seconds of the uneven walk, up the first steps."""
    whole = load_clip(ROOT / "data" / "clips" / "uneven_walk_base.npz")
    path = tmp_path_factory.mktemp("clips") / "short.npz"
    save_clip(path, whole.select(slice(90, 135)))
    return path


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    return write_record(tmp_path_factory.mktemp("source") / "mine.toml", TRUTH | SOFT)


def write_record(path: Path, values: Mapping[str, Any]) -> Path:
    """A parameter file of `record` with other values."""
    ik = parameter_tree.replace(presets.record(), values)
    path.write_text(parameter_files.system_to_toml(ik))
    return path


def command(clip: Path, out: Path, source: Path) -> list[str]:
    words = ["translate", "--from", source, "--to", "record", "--free", ",".join(quick.TARGETS)]
    return [*map(str, [*words, "--clip", clip, "--terrain", GROUND, "-o", out])]


@pytest.fixture(scope="module")
def run(source, clip, tmp_path_factory) -> Path:
    """A finished translation, of residuals that compile at once; tests must not change it."""
    folder = tmp_path_factory.mktemp("runs") / "mine"
    with pytest.MonkeyPatch.context() as patch:
        small_studies.quick_fits(patch)
        patch.setattr(Figure, "savefig", save_pixel)
        patch.setattr(fit_report.playback, "measure_activity", lambda *_: [ACTIVITY])
        assert main.main(command(clip, folder, source)) == 0
    return folder


def test_the_reported_differences_agree_with_an_independent_calculation(run, clip):
    base, reference = load_flat_animation(clip), load_clip(run / "source.npz")
    animation = Animation(base, meshes.load_terrain(GROUND))
    (_, solved), (_, of_source) = (
        animation.solve(parameter_files.load_system(run / name)[0])
        for name in ("record.toml", "source.toml")
    )
    np.testing.assert_allclose(of_source.positions_ws, reference.positions_ws, atol=1e-6)

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
        if name in ("foot", "body"):  # the source does not rotate them in this clip
            assert numbers[name]["reproduced"] is None
            continue
        assert numbers[name]["reproduced"] == pytest.approx(1 - rms / correction, abs=1e-6)
        percentage = f"{100 * (1 - rms / correction):.1f} %"
        assert f"{percentage} of that of the {DIFFERENCES[name].name}" in summary


def test_the_folder_is_a_run_with_the_same_problem(run, clip, monkeypatch):
    small_studies.quick_fits(monkeypatch)
    experiment, summary = run_folder.load_fit(run)
    assert set(experiment.free) == set(quick.TARGETS) and summary["converged"]
    sentence = summary["goodness"]["sentence"]  # of tolerances, not of noise
    assert sentence.startswith(("The same motion", "Not the same motion"))
    assert sentence in (run / "summary.md").read_text()
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
    (line,) = (line for line in table if line.startswith("| `pelvis.half_life`"))
    assert line.startswith("| `pelvis.half_life` | s | 0.45 | 0.") and line.endswith("fitted |")
    unchanged = text.partition("kept their values, as requested:")[2].splitlines()[0]
    assert "`lean.half_life_slide`" in unchanged and (run / "difference.png").is_file()
    assert "of 2 determined parameters within 5 % of their range" in text
    assert parameter_files.load_system(run / "record.toml")[1] == systems.DEFAULT_PRESET


def test_standing_and_moving_frames_are_counted_separately():
    frames = np.arange(4)
    zeros, ones = np.zeros((4, 2)), np.ones((4, 2))
    late = np.stack([np.array([0.0, 0.0, 1.0, 1.0])] * 2, axis=1)
    correction: dict[str, np.ndarray] = dict.fromkeys(accuracy.QUANTITIES, ones)
    remaining = correction | {"ankle": late, "knee": zeros}
    half = accuracy.Difference(("left", "right"), frames * 0.1, frames < 2, correction, remaining)
    numbers = translation.numbers([half])
    assert numbers["standing"]["ankle"]["reproduced"] == 1.0
    assert numbers["moving"]["ankle"]["reproduced"] == 0.0
    assert numbers["all frames"]["ankle"]["rms"] == pytest.approx(1000 * math.sqrt(0.5))
    assert numbers["all frames"]["knee"]["reproduced"] == 1.0
    sentence, *_ = translation.shortcomings([half], "a", "b")
    assert sentence == (
        "Ankles: 707.1 mm (rms) remain of 1000 mm, at most 1000 mm at 0.20 s (left)."
    )
    never = accuracy.Difference(half.legs, half.time, frames < 0, correction, correction)
    assert set(translation.numbers([never])) == {"all frames"}


def test_a_character_stands_below_2_centimetres_a_second(run):
    (scene,) = problems.make_problem(run_folder.load_fit(run)[0]).data
    velocity = np.linspace([-0.03, 0.0, 0.0], [0.03, 0.0, 0.0], len(scene.frames.dt))
    scene = replace(scene, frames=replace(scene.frames, velocity_ws=jnp.asarray(velocity)))
    unmoved = Mock(spec=jaxik.Result, body=Transform.identity(), pose=scene.frames.pose)
    slow = np.abs(velocity[:, 0]) < 0.02
    np.testing.assert_array_equal(accuracy.measure_difference(scene, unmoved).standing, slow)


def test_a_quantity_that_the_source_does_not_correct_has_no_fraction():
    correction: dict[str, np.ndarray] = dict.fromkeys(accuracy.QUANTITIES, np.zeros((3, 1)))
    remaining = correction | {"foot": np.full((3, 1), 0.02)}
    rotated = accuracy.Difference(
        ("left",), np.arange(3.0), np.zeros(3, bool), correction, remaining
    )
    numbers = translation.numbers([rotated])["all frames"]
    assert numbers["foot"]["reproduced"] is None
    assert numbers["foot"]["rms"] == pytest.approx(np.degrees(0.02))
    (text,) = translation.shortcomings([rotated], "a", "b")
    assert text.startswith("a leaves the orientation of the feet as animated; b is 1.146 ° (rms)")
    table = translation.table(accuracy.summarise_differences([rotated])["all frames"], "a")
    assert table[4][-1] == "–"


@pytest.mark.slow
def test_only_parameters_that_move_the_clip_are_free_by_default(run):
    (scene,) = problems.make_problem(run_folder.load_fit(run)[0]).data
    named = sensitivity.all_parameters(presets.record())
    assert {"probe.toe_ls[0]", "probe.toe_ls[2]", "pelvis.limit"} <= set(named)
    assert named["lock.max_speed"] == {"high": 12.0}  # it is infinite: that must be within reach
    tried = ("pelvis.limit", "lean.half_life_slide", "leg.max_knee_angle")
    few = {name: named[name] for name in tried}
    ik = presets.record(faithful=True)  # compiles sooner
    moving = sensitivity.measure_sensitivity(ik, few, (scene,))
    assert set(moving) == {"pelvis.limit", "leg.max_knee_angle"}  # nothing slides in this clip
    assert moving["pelvis.limit"] > 5.0


@pytest.mark.parametrize(
    ("module", "name"),
    [(clips, "save_clip"), (translation, "assess_solution")],
    ids=["before its source", "before its profiles"],
)
def test_a_translation_that_dies_after_its_search_goes_on_in_its_folder(
    run, clip, source, tmp_path, monkeypatch, module, name, capsys
):
    small_studies.quick_fits(monkeypatch)
    monkeypatch.setattr(translation, "write", lambda *_: None)
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
    path = write_record(tmp_path / "still.toml", still)
    line = refusal(command(clip, tmp_path / "run", path), tmp_path, capsys)
    assert "still moves nothing in these clips" in line


def test_a_file_of_free_parameters_may_have_ranges(tmp_path):
    path = tmp_path / "free.toml"
    path.write_text("[free]\npelvis.limit = { high = 0.4 }\n")
    assert translation.read_free(str(path), presets.record()) == {"pelvis.limit": {"high": 0.4}}
