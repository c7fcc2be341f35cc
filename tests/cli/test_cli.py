"""The command line, as its user sees it; what needs a fit is in `tests/test_jobs.py`."""

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from fitting.cli import main, progress
from fitting.cli.parser import make_parser
from fitting.datasets.clips import formats, load_clip, save_clip
from fitting.datasets.coverage import GroundWarning
from fitting.datasets.synthetic import walker
from fitting.datasets.terrain.mesh_files import load_terrain, save_mesh
from fitting.datasets.terrain.meshes import mesh_of
from fitting.inference.optimisation.solution import Progress
from fitting.runtime import activity
from support import gltf_files, grounds, runs
from support.commands import commands
from support.experiments import CLIP, ROOT, write
from support.refusals import refusal
from support.sample_clips import BVH

DATA = ROOT / "data"
FILES = {
    "DATA": str(DATA),
    "BASE": str(DATA / "clips" / "uneven_walk_base.npz"),
    "GROUND": str(DATA / "terrains" / "slope.ply"),
}
BASE, GROUND = FILES["BASE"], FILES["GROUND"]
WANTED_CLIP = f"wanted a {', '.join(formats.READERS)} or .npz file"
SHOWN = "always::fitting.report.placement_report.PlacementWarning"
pytestmark = [
    pytest.mark.filterwarnings("ignore::fitting.datasets.coverage.GroundWarning"),
    pytest.mark.filterwarnings(SHOWN),
]


def run(*words: object) -> None:
    """Runs a command, which does what it is told."""
    assert main.main([str(word) for word in words]) == 0


# Help and wrong words


def test_every_command_has_examples_that_it_accepts():
    for command, parser in commands().items():
        example = parser.format_help().partition("example:\n")[2]
        found = re.findall(rf"^  jaxik ({command}\b.*?)(?:   .*| > .*)?$", example, re.MULTILINE)
        assert found, command
        for words in found:
            make_parser().parse_args(shlex.split(words))


def test_the_help_lists_all_commands_and_exit_statuses(capsys):
    with pytest.raises(SystemExit, match="0"):
        main.main(["--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert [name for name in commands() if f"jaxik {name}" not in text and " " not in name] == []
    for sentence in (
        "exit status: 0 when done, 1 when `doctor` finds a problem, 2 for a mistake",
        "3 when the search", "4 when `fit` has converged but does not fit",
        "5 when `calibrate` finds something outside its bounds",
        "6 when a fit of `fit-many` has failed", "130 when",
    ):  # fmt: skip
        assert sentence in text


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("", "required: COMMAND"),
        ("fti", "invalid choice: 'fti'"),
        ("fit", "required: EXPERIMENT.toml, -o/--output"),
        ("run walk.npz -o a.npz", "required: --terrain"),
        ("run walk.npz --terrain hill.ply -o a.npz --root x", "invalid choice: 'x'"),
    ],
)
def test_wrong_words_are_rejected(line, message, capsys):
    with pytest.raises(SystemExit, match="2"):
        main.main(line.split())
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1 and error.startswith("jaxik")


def test_the_old_word_for_ablate_still_works_and_says_the_new_one(tmp_path, capsys):
    words = ["contribution", str(tmp_path / "no.toml"), "-o", str(tmp_path / "out")]
    assert main.main(words) == main.MISTAKE == 2
    warning, error = capsys.readouterr().err.splitlines()
    assert warning.startswith("jaxik: `contribution` is now called `ablate`")
    assert error.startswith("jaxik ablate: ") and "no such file" in error


# Interrupts and closed pipes


def test_an_interrupt_swallowed_by_a_hook_is_raised_at_the_next_report():
    def show(_) -> str:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            pass
        return "going on"

    report = Progress("start", 0, 0, 1.0, 1.0, 0.0)
    with activity.announced("Searching") as work, progress.ProgressLine(show) as line:
        line(report)
        assert work.note == "going on"
        with pytest.raises(KeyboardInterrupt):
            line(report)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_closed_pipe_is_no_error(monkeypatch):
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as stdout:
        monkeypatch.setattr(sys, "stdout", stdout)
        run("inspect", BASE)


# Mistakes


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"top": "fobs = 30"}, "unknown key 'fobs'; nearest is 'fps'"),
        ({"free": "pelvis.on_gian = {}"}, "nearest is 'pelvis.on_gain'"),
        ({"clips": CLIP, "clip": "end = 100.0"}, "trim from 0.0 s to 100.0 s"),
        ({"clip": "truth = 'broken.toml'"}, "broken.toml: not TOML"),
        ({"clip": "truth = 'odd.toml'"}, "odd.toml: lock.max_speed is 'x'; wanted a number"),
        ({"clip": "truth = '.'"}, "truth '.': a folder"),
    ],
)
def test_a_wrong_experiment_writes_nothing(parts, message, tmp_path, capsys):
    (tmp_path / "broken.toml").write_text("lock = [[")
    (tmp_path / "odd.toml").write_text("[lock]\nmax_speed = 'x'")
    words = ["fit", write(tmp_path, **parts), "-o", tmp_path / "run"]
    line = refusal(words, tmp_path, capsys)
    assert line.startswith("jaxik fit: ") and message in line


MESHES = {"m.ply": "hi", "p.obj": "v 0 0 0\nv 1 0 0\nv 0 0 1\n", "t.toml": ""}


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("run DATA --terrain GROUND -o a.npz", f"data: {WANTED_CLIP}"),
        ("run bad.bvh --terrain GROUND -o a.npz", "bad.bvh:1: wanted HIERARCHY"),
        ("run bad.npz --terrain GROUND -o a.npz", "bad.npz: wanted a NumPy archive"),
        ("run legless.bvh --terrain GROUND -o a.npz", "legless.bvh: no pair of legs recognised"),
        ("run BASE --terrain DATA -o a.npz", "data: a folder"),
        ("run BASE --terrain m.ply -o a.npz", "m.ply: trimesh cannot read it"),
        ("run BASE --terrain p.obj -o a.npz", "p.obj: terrain needs triangles"),
        ("run BASE --terrain t.toml -o a.npz", "trimesh reads"),
        ("run BASE --terrain GROUND -o a", "a: wanted a name that ends in .npz"),
        ("run BASE --terrain GROUND -o a.fbx", "wanted a name that ends in .npz, .bvh, .glb, .csv"),
        ("run BASE --terrain GROUND -o a.bvh --with-terrain", "only a .glb can hold the terrain"),
        ("run BASE --terrain GROUND -o a.bvh --animation Run", "do not apply to .npz clips"),
        ("run BASE --terrain GROUND -o d.npz", "d.npz: cannot be written: it is a folder"),
        ("run BASE --terrain GROUND -o no/a.npz", "there is no folder no"),
        ("run BASE --terrain GROUND -o a.npz --preset recrod", "no preset named 'recrod'"),
        ("run BASE --terrain GROUND -o a.npz --parameters legs.toml", "foot.max_roll has shape"),
        ("run step.bvh --terrain GROUND -o a.npz --parameters mad.toml", "not finite"),
        (
            "run walk.npz --terrain GROUND -o walk.npz",
            "is the clip that is read; name another",
        ),
        ("inspect DATA", WANTED_CLIP),
        ("fit hill.toml -o m.ply", "is a file"),
        ("sample d.npz", "there is nothing; `jaxik fit` makes"),
        ("apply d.npz BASE --terrain GROUND -o a.npz", "there is nothing; `jaxik fit` makes"),
    ],
)
def test_a_mistake_is_reported_and_nothing_written(line, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    files = MESHES | {"bad.bvh": "hi", "bad.npz": "hi", "legs.toml": "foot.max_roll = [1, 2, 3]"}
    files |= {"step.bvh": BVH, "mad.toml": "pelvis.tick_hz = -inf\nleg.soften = inf\n"}
    files["legless.bvh"] = BVH.replace("Left", "A").replace("Right", "B")
    for name, text in files.items():
        Path(name).write_text(text)
    write(tmp_path, "hill.toml")
    shutil.copy(BASE, "walk.npz")
    Path("d.npz").mkdir()
    error = refusal([FILES.get(word, word) for word in line.split()], tmp_path, capsys)
    assert error.startswith(f"jaxik {line.split()[0]}: ") and message in error


# Run and apply


@pytest.fixture
def words(tmp_path) -> list:
    """Runs three frames on a slope; what is wanted where is to be added."""
    (tmp_path / "step.bvh").write_text(BVH)
    return ["run", tmp_path / "step.bvh", "--terrain", GROUND, "-o"]


def test_run_writes_the_motion_on_the_skeleton_that_came_in(words, tmp_path, capsys):
    outputs = {suffix: tmp_path / f"out{suffix}" for suffix in (".npz", ".bvh", ".csv")}
    for path in outputs.values():
        run(*words, path)
        text = capsys.readouterr().out
        assert f"written to {path}" in text and "3 frames in" in text and "captured" not in text
    run(*words, tmp_path / "out.glb", "--with-terrain")
    solved, before = load_clip(outputs[".npz"]), load_clip(tmp_path / "step.bvh")
    assert np.abs(solved.positions_ws - before.positions_ws).max() > 0.01
    assert (solved.joint_names, solved.fps) == (before.joint_names, before.fps)
    bvh = load_clip(outputs[".bvh"], scale=before.scale, up="y")
    assert (bvh.channels, bvh.raw_frame_time) == (before.channels, before.raw_frame_time)
    for clip in (bvh, load_clip(tmp_path / "out.glb")):
        assert clip.joint_names == before.joint_names
        np.testing.assert_allclose(clip.positions_ws, solved.positions_ws, atol=1e-4)
    written, read = (mesh_of(load_terrain(path)) for path in (tmp_path / "out.glb", GROUND))
    assert written.faces.shape == read.faces.shape
    assert len(outputs[".csv"].read_text().splitlines()) == 1 + before.frame_count


@pytest.mark.slow
def test_apply_writes_a_clip_that_the_benchmark_can_score(mocap, tmp_path, capsys):
    runs.save(tmp_path / "run", runs.invented_fit(tmp_path))
    whole = dict(np.load(mocap / "blocks" / "03_03.npz"))
    frames = len(whole["pelvis"])
    cut = {k: v[:60] if np.ndim(v) and len(v) == frames else v for k, v in whole.items()}
    np.savez(tmp_path / "blocks.npz", **cut)
    blocks, out = mocap / "blocks", tmp_path / "out.npz"
    run("apply", tmp_path / "run", tmp_path / "blocks.npz", "--terrain", blocks / "terrain.ply",
        "-o", out)  # fmt: skip
    text = capsys.readouterr().out
    assert "60 frames in" in text
    score = [sys.executable, str(blocks / "score.py"), "blocks.npz", "out.npz"]
    done = subprocess.run(score, cwd=tmp_path, capture_output=True, text=True, check=True)
    scores = json.loads(done.stdout)
    assert scores["bone_length_error_max_mm"] < 1.0 and scores["ankle_cm"] < 15.0
    figures = [float(line.split()[-1]) for line in text.splitlines()[-len(scores) :]]
    np.testing.assert_allclose(figures, list(scores.values()), atol=0.011)
    clip, captured = load_clip(out), load_clip(tmp_path / "blocks.npz")
    assert clip.positions_ws.shape == captured.positions_ws.shape
    with np.load(out) as archive:
        np.testing.assert_array_equal(archive["knee"], clip.joints_ws(1))
        np.testing.assert_array_equal(archive["pelvis"], clip.positions_ws[:, 0])


@pytest.fixture(scope="module")
def on_hill(tmp_path_factory) -> list:
    """Runs a flat walk on a hill of 2 m."""
    folder = tmp_path_factory.mktemp("hill")
    save_clip(folder / "walk.npz", walker.walk(6.0, 30.0))
    save_mesh(folder / "hill.ply", *grounds.hill())
    return ["run", folder / "walk.npz", "--terrain", folder / "hill.ply", "-o"]


def test_run_puts_the_root_on_a_hill_and_shows_where_the_feet_are(on_hill, tmp_path, capsys):
    run(*on_hill, tmp_path / "out.npz")
    output = capsys.readouterr()
    assert re.search(r"^root: on the ground below it, 0 to \d+ cm above its", output.out, re.M)
    assert re.search(r"^standing feet in the ground +[01]\.\d % ", output.out, re.MULTILINE)
    assert "--root ground" not in output.err
    with np.load(tmp_path / "out.npz") as archive:
        placement = json.loads(str(archive["placement"]))
    assert placement["sunk"] < 0.02 and placement["groundless"] == 0.0
    assert load_clip(tmp_path / "out.npz").positions_ws[..., 1].max() > 2.5


def test_run_warns_of_a_root_that_stays_below_a_hill_and_names_frames(on_hill, tmp_path, capsys):
    run(*on_hill, tmp_path / "out.npz", "--root", "animation")
    output = capsys.readouterr()
    assert "\nroot: as animated\n" in output.out
    warning = output.err.splitlines()[0]
    assert warning.startswith("jaxik: standing feet are 2 cm or more in the ground in ")
    assert re.search(r"deepest: 1\d\d\.\d cm, (left|right), frame \d+", warning)
    assert warning.endswith("likely cause: the root stays on the animation's floor where the "
                            "ground rises (use --root ground)")  # fmt: skip


def test_run_names_the_other_up_axis(on_hill, tmp_path, capsys):
    warnings.filterwarnings("always", category=GroundWarning)  # the module's mark comes first
    run(*on_hill, tmp_path / "out.npz", "--file-up", "z")
    output = capsys.readouterr()
    assert "root: as animated: there is no ground below most of its path" in output.out
    assert "ground under 0.0 % of its standing feet: the feet are at x " in output.err
    assert "; the terrain is at x " in output.err
    assert output.err.splitlines()[0].endswith("; likely remedy: --file-up y")
    words = [*on_hill, tmp_path / "other.npz", "--file-up", "z", "--root", "ground"]
    assert refusal(words, tmp_path, capsys).endswith("m; likely remedy: --file-up y")


# Inspect


def test_inspect_describes_a_clip_in_words_and_as_json(capsys):
    run("inspect", BASE)
    assert capsys.readouterr().out.startswith("walker seed 2: 360 frames, 11.97 s at 30 Hz")
    run("inspect", BASE, "--json")
    description = json.loads(capsys.readouterr().out)
    assert description["fps"] == 30.0 and set(description["legs"]) == {"left", "right"}


def test_inspect_asks_for_one_of_several_animations(tmp_path, capsys):
    path = tmp_path / "walk.gltf"
    file = gltf_files.walker()
    keys = {(1, "translation"): ([0.0, 0.1], [[0, 0, 90], [0, 0, 80]], "LINEAR")}
    path.write_text(file.animate("Run", keys).text())
    line = refusal(["inspect", path], tmp_path, capsys)
    assert "2 animations: 'Walk', 'Run'; choose one" in line
    run("inspect", path, "--animation", "Run")
    assert "2 frames" in capsys.readouterr().out
