"""Translation: one system's parameters from another's motion, and what is said of the rest."""

import json
import math
import signal
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxik
from fitting.analysis import difference, playback
from fitting.cli import main, progress
from fitting.datasets import clip_frames
from fitting.datasets.clips import load_clip, save_clip
from fitting.datasets.flat_animation import load_flat_animation
from fitting.datasets.terrain import mesh_files
from fitting.experiments import parameter_files, problems
from fitting.inference import sensitivity
from fitting.report import difference_report
from fitting.report.labels import DIFFERENCES
from fitting.studies import run_folder, translation
from jaxik import presets
from jaxik.maths import parameter_tree
from support import quick
from support.experiments import ROOT

pytestmark = pytest.mark.slow

GROUND = ROOT / "data" / "terrains" / "uneven_walk.ply"
TRUTH = {"pelvis.on_gain": 0.45, "pelvis.limit": 0.17}
SOFT = {"leg.soften": 0.96}  # in the source, and not free: something remains
FREE = ",".join(TRUTH)
WORDS = ("ankle", "knee", "pelvis", "foot", "body")


@pytest.fixture(scope="module", autouse=True)
def hurried(tmp_path_factory):
    """Programs compiled in a hurry, as each runs a few times on a short clip."""
    jax.config.update("jax_compilation_cache_dir", str(tmp_path_factory.mktemp("compiled")))
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)
    jax.config.update("jax_compilation_cache_dir", None)


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Path:
    """One and a half seconds of the embedded walk, up the first steps."""
    whole = load_clip(ROOT / "data" / "clips" / "uneven_walk_base.npz")
    path = tmp_path_factory.mktemp("clips") / "short.npz"
    save_clip(path, whole.select(slice(90, 135)))
    return path


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    """A `record` with other values."""
    path = tmp_path_factory.mktemp("source") / "mine.toml"
    path.write_text(
        parameter_files.system_to_toml(parameter_tree.replace(presets.record(), TRUTH | SOFT))
    )
    return path


@pytest.fixture(scope="module")
def run(source, clip, tmp_path_factory) -> Path:
    """A finished translation; not to be written to."""
    folder = tmp_path_factory.mktemp("runs") / "mine"
    words = ["translate", "--from", source, "--to", "record", "--free", FREE]
    words += ["--clip", clip, "--terrain", GROUND, "-o", folder]
    assert main.main([str(word) for word in words]) == 0
    return folder


@pytest.fixture
def quickly(monkeypatch):
    """Fits of residuals that compile at once."""
    monkeypatch.setattr(problems, "residuals_of_scenes", quick.residuals_of_scenes)


def refused(capsys, *words: object) -> str:
    assert main.main(["translate", *(str(word) for word in words)]) == main.MISTAKE
    told = capsys.readouterr()
    assert told.out == "" and told.err.count("\n") == 1
    return told.err


def test_the_parameters_behind_a_motion_are_found_again(run):
    fitted, preset = parameter_files.load_system(run / "record.toml")
    assert preset == "record"
    for name, value in TRUTH.items():
        one = parameter_tree.declarations(fitted)[name]
        near = 0.05 * (one.high - one.low)
        assert float(parameter_tree.get(fitted, name)) == pytest.approx(value, abs=near)
    text = (run / "summary.md").read_text()
    assert "2 of 2 determined parameters within 5 % of their range" in text


def test_what_is_said_to_be_reproduced_is_so_by_another_count(run, clip):
    base, reference = load_flat_animation(clip), load_clip(run / "source.npz")
    ik, _ = parameter_files.load_system(run / "record.toml")
    ground = mesh_files.load_terrain(GROUND)
    solved = clip_frames.clip_from_result(
        base, jaxik.run(ik, base.rig, ground, clip_frames.frames_from_clip(base))
    )

    def places(one, joints):
        apart = one.positions_ws[:, joints] - reference.positions_ws[:, joints]
        return np.sqrt(np.sum(apart**2, axis=-1))

    def angles(one, joints):
        a, b = (each.rotations_ws[:, joints] for each in (one, reference))
        turn = rotation(a).inv() * rotation(b)
        return turn.magnitude().reshape(a.shape[:2])

    def rotation(wxyz):
        return Rotation.from_quat(wxyz.reshape(-1, 4), scalar_first=True)

    def distances(one):
        _, knee, ankle, _ = np.transpose(one.rig.joints)
        found = {"ankle": places(one, ankle), "knee": places(one, knee)}
        found |= {"pelvis": places(one, [one.rig.pelvis]), "foot": angles(one, ankle)}
        return found | {"body": angles(one, [one.rig.pelvis])}

    told = json.loads((run / "translation.json").read_text())["reproduced"]["all frames"]
    summary = (run / "summary.md").read_text()
    left, had = distances(solved), distances(base)
    for kind in WORDS:
        rms, correction = (np.sqrt(np.mean(one[kind] ** 2)) for one in (left, had))
        factor = 1000 if kind in WORDS[:3] else np.degrees(1)
        assert told[kind]["rms"] == pytest.approx(factor * rms, abs=1e-6)
        assert told[kind]["correction"] == pytest.approx(factor * correction, abs=1e-6)
        assert told[kind]["max"] == pytest.approx(factor * left[kind].max(), abs=1e-6)
        if kind == "body":  # the clip turns it by nothing
            assert told[kind]["reproduced"] is None
            continue
        assert told[kind]["reproduced"] == pytest.approx(1 - rms / correction, abs=1e-6)
        share = f"{100 * (1 - rms / correction):.1f} %"
        assert f"{share} of that of the {DIFFERENCES[kind].name}" in summary
    assert 0.9 < told["ankle"]["reproduced"] < 0.999


def test_the_folder_is_a_run_with_the_same_problem(run, clip):
    asked, told = run_folder.load_fit(run)
    assert set(asked.free) == set(TRUTH) and told["converged"]
    text = (run / "experiment.toml").read_text()
    assert 'reference = "source.npz"' in text and f'base = "{clip}"' in text
    ik, _ = parameter_files.load_system(run / "parameters.toml")
    problem = problems.make_problem(asked)
    u = problem.space.pack(ik)
    assert float(problem.cost(u)) == pytest.approx(told["cost"], rel=1e-6)


def test_the_summary_puts_both_systems_side_by_side(run):
    text = (run / "summary.md").read_text()
    assert text.startswith("# mine to record\n")
    assert "## How much of `mine` `record` reproduces" in text and "difference.png" in text
    table = text.partition("## Parameters of both systems")[2]
    (line,) = (line for line in table.splitlines() if line.startswith("| `pelvis.limit`"))
    assert line.startswith("| `pelvis.limit` | m | 0.17 | 0.") and line.endswith("| fitted |")
    assert "`lean.gain_slide`" in text.partition("kept their values, as asked:")[2].splitlines()[0]
    assert (run / "source.toml").is_file() and (run / "difference.png").stat().st_size > 10_000


def test_a_source_that_another_system_cannot_follow_is_told_honestly(run):
    (scene,) = problems.make_problem(run_folder.load_fit(run)[0]).data
    still = parameter_tree.replace(presets.record(), {"leg.weight": 0.0, "lock.enabled": False})
    found = difference.measure(scene, playback.run(still, scene))
    told = difference_report.numbers([found])["all frames"]
    assert told["ankle"]["reproduced"] < 0.3
    said = difference_report.shortcomings([found], "a", "b")
    assert said[0].startswith("Ankles: ") and "(rms) remain of" in said[0]
    worst = 1000 * found.remaining["ankle"].max()
    assert f"at most {worst:.4g} mm" in said[0]


def test_frames_in_which_the_character_stands_are_counted_apart():
    frames = np.arange(4)
    zero, one = np.zeros((4, 2)), np.ones((4, 2))
    left = np.stack([np.array([0.0, 0.0, 1.0, 1.0])] * 2, axis=1)
    kinds = dict.fromkeys(difference.QUANTITIES, one)
    made = difference.Difference(
        ("left", "right"), frames * 0.1, frames < 2, kinds, kinds | {"ankle": left, "knee": zero}
    )
    told = difference_report.numbers([made])
    assert told["standing"]["ankle"]["reproduced"] == 1.0
    assert told["moving"]["ankle"]["reproduced"] == 0.0
    assert told["all frames"]["ankle"]["rms"] == pytest.approx(1000 * math.sqrt(0.5))
    assert told["all frames"]["knee"]["reproduced"] == 1.0
    never = difference.Difference(made.legs, made.time, frames < 0, kinds, kinds)
    assert set(difference_report.numbers([never])) == {"all frames"}


def test_what_the_source_leaves_alone_has_no_share():
    zero, some = np.zeros((3, 1)), np.full((3, 1), 0.02)
    kinds = dict.fromkeys(difference.QUANTITIES, zero)
    made = difference.Difference(
        ("left",), np.arange(3.0), np.zeros(3, bool), kinds, kinds | {"foot": some}
    )
    told = difference_report.numbers([made])["all frames"]
    assert told["foot"]["reproduced"] is None
    assert told["foot"]["rms"] == pytest.approx(np.degrees(0.02))
    (said,) = difference_report.shortcomings([made], "a", "b")
    assert said.startswith("a leaves the orientation of the feet as animated; b is 1.146 ° (rms)")
    assert difference_report.table(difference.summarise([made])["all frames"], "a")[4][-1] == "–"


def test_only_what_moves_the_clip_is_free_unless_it_is_named(run):
    (scene,) = problems.make_problem(run_folder.load_fit(run)[0]).data
    named = sensitivity.all_parameters(presets.record())
    assert {"probe.toe_ls[0]", "probe.toe_ls[2]", "pelvis.limit"} <= set(named)
    assert named["lock.max_speed"] == {"high": 12.0}  # it is infinite: that must be within reach
    some = {one: named[one] for one in ("pelvis.limit", "lean.gain_slide", "leg.max_knee_angle")}
    moving = sensitivity.measure_sensitivity(presets.record(), some, (scene,))
    assert set(moving) == {"pelvis.limit", "leg.max_knee_angle"}  # nothing slides in this clip
    assert moving["pelvis.limit"] > 5.0


def test_an_interrupted_translation_is_written_with_its_best_point(
    quickly, source, clip, tmp_path, monkeypatch, capsys
):
    def interrupt(_) -> str:
        signal.raise_signal(signal.SIGINT)
        return ""

    monkeypatch.setattr(progress, "fit_line", interrupt)
    words = ["--from", source, "--to", "record", "--free", ",".join(quick.TARGETS)]
    words += ["--clip", clip, "--terrain", GROUND, "-o", tmp_path / "run"]
    assert main.main(["translate", *map(str, words)]) == main.INTERRUPTED
    told = json.loads((tmp_path / "run" / run_folder.FIT).read_text())
    assert told["message"].startswith("Interrupted after 0 steps")
    assert "Interrupted after 0 steps" in (tmp_path / "run" / run_folder.SUMMARY).read_text()
    assert (tmp_path / "run" / "source.npz").is_file()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"--from": "recrod"}, "--from takes a preset or a parameter .toml: no preset named"),
        ({"--to": "recrod"}, "--to takes a preset or a parameter .toml: no preset named 'recrod'"),
        ({"--to": "no.toml"}, "no.toml: no such file, wanted a parameter file"),
        ({"--to": "liar.toml"}, "liar.toml: unknown key 'pelvis.speed'; nearest is"),
        ({"--terrain": None}, "1 clip(s) and 2 terrain(s); wanted a terrain for each clip"),
        ({"--free": "pelvis.limti"}, "--free: no parameter named 'pelvis.limti'; nearest is"),
        ({"--free": ","}, "--free ,: names no parameter"),
        ({"--free": "free.toml"}, "free.toml [free] pelvis.limit: unknown key 'hihg'"),
        ({"--free": "none.toml"}, "none.toml: unknown key 'fre'; nearest is 'free'"),
        ({"-o": "full"}, "full: there is something in it already: ['kept']"),
        ({"-o": "liar.toml"}, "is a file"),
        ({"--from": "still.toml"}, "still moves nothing in these clips"),
        ({"--fps": "0"}, "fps is 0.0; wanted a number above 0"),
    ],
)
def test_what_cannot_be_translated_is_told_and_nothing_written(
    change, said, clip, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    Path("full").mkdir()
    texts = {"full/kept": "", "liar.toml": 'preset = "record"\npelvis.speed = 3.0\n'}
    texts |= {"free.toml": "[free]\npelvis.limit = { hihg = 1.0 }\n", "none.toml": "[fre]\nx = 1\n"}
    still = {"leg.weight": 0.0, "lock.enabled": False, "pelvis.limit": 0.0}
    still |= {f"lean.{side}_rate": 0.0 for side in ("forward", "side")}
    texts["still.toml"] = parameter_files.system_to_toml(
        parameter_tree.replace(presets.record(), still)
    )
    for name, text in texts.items():
        Path(name).write_text(text)
    given = {"--from": "record", "--to": "record", "--clip": clip, "--terrain": GROUND, "-o": "run"}
    again = ["--terrain", GROUND] if change == {"--terrain": None} else []
    given |= {key: value for key, value in change.items() if value is not None}
    before = sorted(tmp_path.rglob("*"))
    words = [word for pair in given.items() for word in pair]
    assert said in refused(capsys, *words, *again)
    assert sorted(tmp_path.rglob("*")) == before


def test_free_parameters_may_come_with_ranges(tmp_path):
    path = tmp_path / "free.toml"
    path.write_text("[free]\npelvis.limit = { high = 0.4 }\n")
    assert translation.read_free(str(path), presets.record()) == {"pelvis.limit": {"high": 0.4}}
