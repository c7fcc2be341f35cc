"""The command line, as its user sees it."""

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import h5py
import jax
import numpy as np
import pytest

from fitting.cli import main, progress
from fitting.cli.parser import make_parser
from fitting.datasets.clips import formats, load_clip, save_clip
from fitting.datasets.coverage import GroundWarning
from fitting.datasets.synthetic import walker
from fitting.datasets.terrain.mesh_files import load_terrain, save_mesh
from fitting.datasets.terrain.meshes import mesh_of
from fitting.experiments import problems
from fitting.inference.optimisation.solution import Progress
from fitting.inference.sampling.chain import journal_path
from fitting.jobs import fits
from fitting.runtime import activity
from fitting.studies import assess, run_folder
from support import gltf_files, grounds, quick
from support.experiments import CLIP, ROOT, write
from support.sample_clips import BVH

DATA = ROOT / "data"
COMMANDS = [
    "init", "fit", "ablate", "calibrate", "population", "fit-many", "sample", "apply", "run",
    "view", "compare", "translate",
    "inspect", "terrain", "bench", "cache", "record", "record show", "record to-toml",
    "record to-bytes", "export",
]  # fmt: skip
BASE = str(DATA / "clips" / "uneven_walk_base.npz")
GROUND = str(DATA / "terrains" / "slope.ply")
WANTED_CLIP = f"wanted a {', '.join(formats.READERS)} or .npz file"
SHOWN = "always::fitting.report.placement_report.PlacementWarning"
pytestmark = pytest.mark.filterwarnings("ignore::fitting.datasets.coverage.GroundWarning")
ELSEWHERE = r"../../elsewhere $\frac{$"  # no path, and no formula that Matplotlib could draw
SAMPLE = "[sample]\nwalkers = 8\nstop_at = 1e9\nmax_steps = 40"


@pytest.fixture(scope="module", autouse=True)
def fresh():
    """Forgets what other tests compiled, which rounds differently from a child process."""
    jax.clear_caches()


@pytest.fixture
def quick_residuals(monkeypatch):
    """Fits and samples residuals that compile at once; reports still play the real pipeline."""
    monkeypatch.setattr(problems, "residuals_of_scenes", quick.residuals_of_scenes)


@pytest.fixture(scope="module")
def experiment_file(tmp_path_factory) -> Path:
    return write(
        tmp_path_factory.mktemp("files"), "hill.toml",
        top=f"name = '{ELSEWHERE}'", clips=CLIP, rest=SAMPLE,
        clip=f"start = 1.0\nend = 1.5\nlabel = '{ELSEWHERE}'\nsubject = '{ELSEWHERE}'",
    )  # fmt: skip


@pytest.fixture(scope="module")
def run(experiment_file, tmp_path_factory) -> Path:
    """A finished fit; tests must not change it."""
    folder = tmp_path_factory.mktemp("runs") / "hill"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(problems, "residuals_of_scenes", quick.residuals_of_scenes)
        assert main.main(["fit", str(experiment_file), "-o", str(folder)]) == 0
    return folder


def tree(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def error_of(capsys, *words: object) -> str:
    """Runs a command that must fail with status 2 and one line on stderr; returns that line."""
    assert main.main([str(word) for word in words]) == main.MISTAKE
    output = capsys.readouterr()
    assert output.out == "" and output.err.count("\n") == 1
    assert output.err.startswith(f"jaxik {words[0]}: ")
    return output.err


# Help


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_examples_that_it_accepts(command, capsys):
    with pytest.raises(SystemExit, match="0"):
        main.main([*command.split(), "--help"])
    text = capsys.readouterr().out
    example = text.partition("example:\n")[2]
    examples = re.findall(rf"^  jaxik ({command} .*?)(?:   .*| > .*)?$", example, re.MULTILINE)
    assert examples
    for words in examples:
        make_parser().parse_args(shlex.split(words))


def test_the_help_lists_all_commands_and_exit_statuses(capsys):
    with pytest.raises(SystemExit, match="0"):
        main.main(["--help"])
    text = capsys.readouterr().out
    assert all(f"jaxik {name}" in text for name in COMMANDS if " " not in name)
    text = " ".join(text.split())
    assert "exit status: 0 when done, 1 when `doctor` finds a problem, 2 for a mistake" in text
    assert "3 when the search" in text and "4 when `fit` has converged but does not fit" in text
    assert "5 when `calibrate` finds something outside its bounds" in text and "130 when" in text
    assert "6 when a fit of `fit-many` has failed" in text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "required: COMMAND"),
        (["fti"], "invalid choice: 'fti'"),
        (["fit"], "required: EXPERIMENT.toml, -o/--output"),
        (["run", BASE, "-o", "a.npz"], "required: --terrain"),
        (["run", BASE, "--terrain", GROUND, "-o", "a.npz", "--root", "x"], "invalid choice: 'x'"),
    ],
)
def test_wrong_words_are_rejected(words, message, capsys):
    with pytest.raises(SystemExit, match="2"):
        main.main(words)
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1 and error.startswith("jaxik")


# Fit and sample


@pytest.mark.slow
def test_the_names_in_an_experiment_are_no_paths(run, experiment_file):
    assert {path.name for path in run.parent.iterdir()} == {"hill"}
    assert {path.name for path in experiment_file.parent.iterdir()} == {"hill.toml"}
    assert f"# {ELSEWHERE}" in (run / run_folder.SUMMARY).read_text()


@pytest.mark.slow
def test_a_fit_writes_numbers_tables_and_plots(run):
    names = {run_folder.EXPERIMENT, run_folder.FIT, run_folder.PARAMETERS, run_folder.SUMMARY}
    assert names <= tree(run) and {"motion.png", "cost.png"} <= tree(run)
    assert {run_folder.PAGE, "base.npz", "fitted.npz"} <= tree(run)
    numbers = json.loads((run / run_folder.FIT).read_text())
    assert numbers["converged"] and numbers["experiment"] == ELSEWHERE
    for row in numbers["parameters"]:
        assert row["value"] == pytest.approx(quick.TARGETS[row["name"]], abs=0.003)


@pytest.mark.slow
def test_sampling_continues_its_chain(quick_residuals, undrawn, run, tmp_path, capsys):
    once, twice = (Path(shutil.copytree(run, tmp_path / name)) for name in ("once", "twice"))
    assert main.main(["sample", str(once)]) == 0
    text = capsys.readouterr().out
    assert "8 walkers, 40 steps" in text and f"read {once / run_folder.SUMMARY}" in text
    assert {run_folder.CHAIN, run_folder.POSTERIOR, "corner.png"} <= tree(once)
    assert json.loads((once / run_folder.POSTERIOR).read_text())["steps"] == 40
    assert "## Posterior" in (once / run_folder.SUMMARY).read_text()
    assert main.main(["sample", str(twice), "--max-steps", "25"]) == 0
    assert main.main(["sample", str(twice)]) == 0
    np.testing.assert_array_equal(chain_of(once), chain_of(twice))


def chain_of(run: Path) -> np.ndarray:
    with h5py.File(run / run_folder.CHAIN) as file:
        return np.asarray(file["mcmc/chain"])


@pytest.mark.slow
def test_a_sampling_that_was_killed_ends_with_the_chain_of_an_unbroken_one(
    quick_residuals, undrawn, run, tmp_path
):
    killed, whole = (Path(shutil.copytree(run, tmp_path / name)) for name in ("killed", "whole"))
    paths = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    process = subprocess.Popen(
        [sys.executable, "-m", "support.quick", "sample", str(killed)]
        + ["--max-steps", "1000000"],
        env=os.environ | {"PYTHONPATH": paths},
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    journal = journal_path(killed / run_folder.CHAIN)
    began = time.monotonic()
    while not journal.is_file() or journal.stat().st_size < 60_000:  # some twenty steps
        assert process.poll() is None and time.monotonic() - began < 120
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert journal.is_file()
    assert main.main(["sample", str(killed), "--max-steps", "1"]) == 0
    assert not journal.is_file()
    steps = str(len(chain_of(killed)) + 30)
    assert len(chain_of(killed)) >= 15
    assert main.main(["sample", str(killed), "--max-steps", steps]) == 0
    assert main.main(["sample", str(whole), "--max-steps", steps]) == 0
    np.testing.assert_array_equal(chain_of(killed), chain_of(whole))


@pytest.mark.slow
def test_an_interrupted_fit_writes_its_best_point(
    quick_residuals, undrawn, experiment_file, tmp_path, monkeypatch, capsys
):
    def interrupt(report: Progress) -> str:
        signal.raise_signal(signal.SIGINT)
        return ""

    monkeypatch.setattr(progress, "fit_line", interrupt)
    status = main.main(["fit", str(experiment_file), "-o", str(tmp_path / "run")])
    assert status == main.INTERRUPTED == 130
    numbers = json.loads((tmp_path / "run" / run_folder.FIT).read_text())
    assert numbers["message"].startswith("Interrupted after 0 steps") and not numbers["converged"]
    assert np.isfinite(numbers["cost"]) and numbers["message"] in capsys.readouterr().out
    assert run_folder.SUMMARY in tree(tmp_path / "run")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rest", "status", "sentence"),
    [
        ("[fit]\nmax_steps = 1", 3, "Not converged: the 1 steps"),
        ("[sigmas]\nknee = 0.0001", 4, "Does not fit: knees "),
    ],
)
def test_the_exit_status_says_what_is_wrong_with_a_fit(
    quick_residuals, undrawn, tmp_path, capsys, rest, status, sentence
):
    path = write(tmp_path, clips=CLIP, clip="start = 1.0\nend = 1.5", rest=rest)
    assert main.main(["fit", str(path), "-o", str(tmp_path / "run")]) == status
    assert sentence in capsys.readouterr().out
    assert sentence in (tmp_path / "run" / run_folder.SUMMARY).read_text()
    numbers = json.loads((tmp_path / "run" / run_folder.FIT).read_text())
    assert numbers["converged"] == (status != 3)
    assert status == 3 or numbers["goodness"]["fits"] is False


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


@pytest.mark.slow
def test_an_interrupted_sampling_keeps_its_chain(
    quick_residuals, undrawn, run, tmp_path, monkeypatch, capsys
):
    copy = Path(shutil.copytree(run, tmp_path / "run"))

    def interrupt(report) -> str:
        signal.raise_signal(signal.SIGINT)
        return ""

    monkeypatch.setattr(progress, "sample_line", interrupt)
    assert main.main(["sample", str(copy), "--max-steps", "300"]) == main.INTERRUPTED
    assert "Interrupted, the chain is kept" in capsys.readouterr().out
    assert len(chain_of(copy)) == 100


@pytest.mark.slow
def test_an_interrupt_before_the_search_writes_nothing(
    quick_residuals, experiment_file, tmp_path, monkeypatch, capsys
):
    def interrupt(*_):
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(fits, "load_clips", interrupt)
    assert main.main(["fit", str(experiment_file), "-o", str(tmp_path / "run")]) == main.INTERRUPTED
    assert capsys.readouterr().err == "\njaxik fit: interrupted\n" and not tree(tmp_path)


@pytest.mark.slow
def test_the_parameters_are_written_before_anything_can_fail_after_the_search(
    quick_residuals, experiment_file, tmp_path, monkeypatch, capsys
):
    def fail(*_):
        raise ValueError("no slopes")

    monkeypatch.setattr(assess, "assess_identifiability", fail)
    assert "no slopes" in last_error_of(capsys, "fit", experiment_file, "-o", tmp_path / "run")
    kept = {run_folder.EXPERIMENT, run_folder.PARAMETERS, run_folder.SEARCH}
    assert tree(tmp_path / "run") == kept


def last_error_of(capsys, *words: object) -> str:
    assert main.main([str(word) for word in words]) == main.MISTAKE
    return capsys.readouterr().err.splitlines()[-1]


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
    path = write(tmp_path, **parts)
    before = tree(tmp_path)
    assert message in error_of(capsys, "fit", path, "-o", tmp_path / "run")
    assert tree(tmp_path) == before


def test_the_clip_that_is_read_is_not_written_over(tmp_path, capsys):
    path = tmp_path / "walk.npz"
    shutil.copy(BASE, path)
    before = path.read_bytes()
    message = error_of(capsys, "run", path, "--terrain", GROUND, "-o", path)
    assert "is the clip that is read; name another file" in message
    assert path.read_bytes() == before


def test_a_file_in_place_of_the_run_folder_is_rejected(experiment_file, tmp_path, capsys):
    (tmp_path / "file").write_text("kept")
    assert "is a file" in error_of(capsys, "fit", experiment_file, "-o", tmp_path / "file")
    assert (tmp_path / "file").read_text() == "kept"


@pytest.mark.parametrize("words", [["sample"], ["apply", BASE, "--terrain", GROUND, "-o", "a.npz"]])
def test_a_folder_without_a_fit_is_rejected(words, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    line = [words[0], tmp_path, *words[1:]]
    assert re.search(r"no \S+; there is nothing; `jaxik fit` makes", error_of(capsys, *line))
    line[1] = tmp_path / "no"
    assert "no such folder" in error_of(capsys, *line)
    assert not tree(tmp_path)


@pytest.mark.slow
def test_a_fit_with_other_parameters_than_its_experiment_is_rejected(run, tmp_path, capsys):
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    numbers = json.loads((copy / run_folder.FIT).read_text())
    numbers["parameters"].reverse()
    (copy / run_folder.FIT).write_text(json.dumps(numbers))
    assert "the fit has the parameters" in error_of(capsys, "sample", copy)
    assert run_folder.CHAIN not in tree(copy)


# Run and apply


@pytest.mark.slow
@pytest.mark.filterwarnings(SHOWN)
def test_apply_writes_a_clip_that_the_benchmark_can_score(run, mocap, tmp_path, capsys):
    whole = dict(np.load(mocap / "blocks" / "03_03.npz"))
    frames = len(whole["pelvis"])
    cut = {k: v[:60] if np.ndim(v) and len(v) == frames else v for k, v in whole.items()}
    np.savez(tmp_path / "blocks.npz", **cut)
    out = tmp_path / "out.npz"
    words = ["apply", run, tmp_path / "blocks.npz", "--terrain", mocap / "blocks" / "terrain.ply"]
    assert main.main([*map(str, words), "-o", str(out)]) == 0
    text = capsys.readouterr().out
    assert "60 frames in" in text
    score = [sys.executable, str(mocap / "blocks" / "score.py"), "blocks.npz", "out.npz"]
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


@pytest.mark.slow
@pytest.mark.filterwarnings(SHOWN)
def test_run_accepts_a_bvh_and_a_parameter_file(tmp_path, capsys):
    (tmp_path / "step.bvh").write_text(BVH)
    (tmp_path / "still.toml").write_text("lock.enabled = false\n[leg]\nweight = 0.0\n")
    words = ["run", tmp_path / "step.bvh", "--terrain", GROUND, "-o", tmp_path / "out.npz"]
    words += ["--parameters", tmp_path / "still.toml"]
    assert main.main([*map(str, words)]) == 0
    text = capsys.readouterr().out
    assert "3 frames in" in text and "captured" not in text
    solved, clip = load_clip(tmp_path / "out.npz"), load_clip(tmp_path / "step.bvh")
    assert solved.joint_names == clip.joint_names and solved.fps == clip.fps
    assert np.isfinite(solved.positions_ws).all()


@pytest.mark.slow
@pytest.mark.filterwarnings(SHOWN)
def test_run_writes_the_motion_on_the_skeleton_that_came_in(tmp_path, capsys):
    (tmp_path / "step.bvh").write_text(BVH)
    words = ["run", str(tmp_path / "step.bvh"), "--terrain", GROUND, "-o"]
    outputs = {suffix: tmp_path / f"out{suffix}" for suffix in (".npz", ".bvh", ".csv")}
    for path in outputs.values():
        assert main.main([*words, str(path)]) == 0
        assert f"written to {path}" in capsys.readouterr().out
    assert main.main([*words, str(tmp_path / "out.glb"), "--with-terrain"]) == 0
    solved, before = load_clip(outputs[".npz"]), load_clip(tmp_path / "step.bvh")
    assert np.abs(solved.positions_ws - before.positions_ws).max() > 0.01
    bvh = load_clip(outputs[".bvh"], scale=before.scale, up="y")
    assert (bvh.channels, bvh.raw_frame_time) == (before.channels, before.raw_frame_time)
    for clip in (bvh, load_clip(tmp_path / "out.glb")):
        assert clip.joint_names == before.joint_names
        np.testing.assert_allclose(clip.positions_ws, solved.positions_ws, atol=1e-4)
    written, read = (mesh_of(load_terrain(path)) for path in (tmp_path / "out.glb", GROUND))
    assert written.faces.shape == read.faces.shape
    assert len(outputs[".csv"].read_text().splitlines()) == 1 + before.frame_count


def test_inspect_asks_for_one_of_several_animations(tmp_path, capsys):
    path = tmp_path / "walk.gltf"
    file = gltf_files.walker()
    keys = {(1, "translation"): ([0.0, 0.1], [[0, 0, 90], [0, 0, 80]], "LINEAR")}
    path.write_text(file.animate("Run", keys).text())
    assert "2 animations: 'Walk', 'Run'; choose one" in error_of(capsys, "inspect", path)
    assert main.main(["inspect", str(path), "--animation", "Run"]) == 0
    assert "2 frames" in capsys.readouterr().out


def test_poses_that_are_not_finite_are_not_written(tmp_path, capsys):
    (tmp_path / "step.bvh").write_text(BVH)
    (tmp_path / "mad.toml").write_text("pelvis.tick_hz = -inf\nleg.soften = inf\n")
    words = ["run", tmp_path / "step.bvh", "--terrain", GROUND, "-o", tmp_path / "out.npz"]
    assert "not finite" in error_of(capsys, *words, "--parameters", tmp_path / "mad.toml")
    assert not (tmp_path / "out.npz").exists()


@pytest.fixture(scope="module")
def hill_files(tmp_path_factory) -> Path:
    """A flat walk and a hill of 2 m."""
    folder = tmp_path_factory.mktemp("hill")
    save_clip(folder / "walk.npz", walker.walk(6.0, 30.0))
    save_mesh(folder / "hill.ply", *grounds.hill())
    return folder


@pytest.mark.slow
@pytest.mark.filterwarnings(SHOWN)
def test_run_puts_the_root_on_a_hill_and_shows_where_the_feet_are(hill_files, tmp_path, capsys):
    words = ["run", hill_files / "walk.npz", "--terrain", hill_files / "hill.ply"]
    words += ["-o", tmp_path / "out.npz"]
    assert main.main([*map(str, words)]) == 0
    output = capsys.readouterr()
    assert re.search(r"^root: on the ground below it, 0 to \d+ cm above its", output.out, re.M)
    assert re.search(r"^standing feet in the ground +[01]\.\d % ", output.out, re.MULTILINE)
    assert "--root ground" not in output.err
    with np.load(tmp_path / "out.npz") as archive:
        placement = json.loads(str(archive["placement"]))
    assert placement["sunk"] < 0.02 and placement["groundless"] == 0.0
    assert load_clip(tmp_path / "out.npz").positions_ws[..., 1].max() > 2.5


@pytest.mark.slow
@pytest.mark.filterwarnings(SHOWN)
def test_run_warns_of_a_root_that_stays_below_a_hill_and_names_frames(hill_files, tmp_path, capsys):
    words = ["run", hill_files / "walk.npz", "--terrain", hill_files / "hill.ply"]
    words += ["-o", tmp_path / "out.npz", "--root", "animation"]
    assert main.main([*map(str, words)]) == 0
    output = capsys.readouterr()
    assert "\nroot: as animated\n" in output.out
    warning = output.err.splitlines()[0]
    assert warning.startswith("jaxik: standing feet are 2 cm or more in the ground in ")
    assert re.search(r"deepest: 1\d\d\.\d cm, (left|right), frame \d+", warning)
    assert warning.endswith("likely cause: the root stays on the animation's floor where the "
                            "ground rises (use --root ground)")  # fmt: skip


@pytest.mark.slow
@pytest.mark.filterwarnings(SHOWN)
def test_run_names_the_other_up_axis(hill_files, tmp_path, capsys):
    warnings.filterwarnings("always", category=GroundWarning)  # the module's mark comes first
    words = ["run", hill_files / "walk.npz", "--terrain", hill_files / "hill.ply"]
    words += ["-o", tmp_path / "out.npz", "--file-up", "z"]
    assert main.main([*map(str, words)]) == 0
    output = capsys.readouterr()
    assert "root: as animated: there is no ground below most of its path" in output.out
    assert "ground under 0.0 % of its standing feet: the feet are at x " in output.err
    assert "; the terrain is at x " in output.err
    assert output.err.splitlines()[0].endswith("; likely remedy: --file-up y")


def test_run_rejects_a_root_without_ground(hill_files, tmp_path, capsys):
    words = ["run", hill_files / "walk.npz", "--terrain", hill_files / "hill.ply"]
    words += ["-o", tmp_path / "out.npz", "--file-up", "z", "--root", "ground"]
    assert error_of(capsys, *words).endswith("m; likely remedy: --file-up y\n")
    assert not tree(tmp_path)


MESHES = {"m.ply": "hi", "p.obj": "v 0 0 0\nv 1 0 0\nv 0 0 1\n", "t.toml": ""}


@pytest.mark.parametrize(
    ("clip", "ground", "out", "more", "message"),
    [
        ("no.bvh", GROUND, "a.npz", [], "no.bvh: no such file"),
        (str(DATA), GROUND, "a.npz", [], f"data: {WANTED_CLIP}"),
        ("bad.bvh", GROUND, "a.npz", [], "bad.bvh:1: wanted HIERARCHY"),
        ("bad.npz", GROUND, "a.npz", [], "bad.npz: wanted a NumPy archive"),
        ("legless.bvh", GROUND, "a.npz", [], "legless.bvh: no pair of legs recognised"),
        (BASE, "no.ply", "a.npz", [], "no.ply: no such file"),
        (BASE, str(DATA), "a.npz", [], "data: a folder"),
        (BASE, "m.ply", "a.npz", [], "m.ply: trimesh cannot read it"),
        (BASE, "p.obj", "a.npz", [], "p.obj: terrain needs triangles"),
        (BASE, "t.toml", "a.npz", [], "trimesh reads"),
        (BASE, GROUND, "a", [], "a: wanted a name that ends in .npz"),
        (BASE, GROUND, "a.fbx", [], "a.fbx: wanted a name that ends in .npz, .bvh, .glb, .csv"),
        (BASE, GROUND, "a.bvh", ["--with-terrain"], "a.bvh: only a .glb can hold the terrain"),
        (BASE, GROUND, "a.bvh", ["--animation", "Run"], "['animation'] do not apply to .npz clips"),
        (BASE, GROUND, "d.npz", [], "d.npz: cannot be written: it is a folder"),
        (BASE, GROUND, "no/a.npz", [], "there is no folder no"),
        (BASE, GROUND, "a.npz", ["--preset", "recrod"], "no preset named 'recrod'"),
        (BASE, GROUND, "a.npz", ["--parameters", "no.toml"], "no.toml: no such file"),
        (BASE, GROUND, "a.npz", ["--parameters", "legs.toml"], "foot.max_roll has shape (3,)"),
    ],
)
def test_wrong_input_to_run_is_reported_and_nothing_written(
    clip, ground, out, more, message, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    files = MESHES | {"bad.bvh": "hi", "bad.npz": "hi", "legs.toml": "foot.max_roll = [1, 2, 3]"}
    files["legless.bvh"] = BVH.replace("Left", "A").replace("Right", "B")
    for name, text in files.items():
        Path(name).write_text(text)
    Path("d.npz").mkdir()
    before = tree(tmp_path)
    assert message in error_of(capsys, "run", clip, "--terrain", ground, "-o", out, *more)
    assert tree(tmp_path) == before


# Inspect


def test_inspect_describes_a_clip_in_words_and_as_json(capsys):
    assert main.main(["inspect", BASE]) == 0
    assert capsys.readouterr().out.startswith("walker seed 2: 360 frames, 11.97 s at 30 Hz")
    assert main.main(["inspect", BASE, "--json"]) == 0
    description = json.loads(capsys.readouterr().out)
    assert description["fps"] == 30.0 and set(description["legs"]) == {"left", "right"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["no.bvh"], "no.bvh: no such file"),
        ([str(DATA)], WANTED_CLIP),
        (["step.amc", "--asf", "no.asf"], "no.asf: no such file"),
    ],
)
def test_inspect_rejects_a_file_that_it_cannot_read(words, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("step.bvh").write_text(BVH)
    Path("step.amc").write_text(":FULLY-SPECIFIED\n:DEGREES\n1\nroot 0 0 0 0 0 0\n")
    assert message in error_of(capsys, "inspect", *words)


@pytest.mark.slow
def test_a_closed_pipe_is_no_error(tmp_path):
    script = f"import sys; from fitting.cli import main; sys.exit(main.main(['inspect', {BASE!r}]))"
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, "-c", script], stdout=writer, stderr=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    os.close(writer)
    assert done.returncode == 0
    assert all(line.startswith("Importing JAX") for line in done.stderr.splitlines())


# Old words


def test_the_old_word_for_ablate_still_works_and_says_the_new_one(tmp_path, capsys):
    words = ["contribution", str(tmp_path / "no.toml"), "-o", str(tmp_path / "out")]
    assert main.main(words) == main.MISTAKE
    warning, error = capsys.readouterr().err.splitlines()
    assert warning.startswith("jaxik: `contribution` is now called `ablate`")
    assert error.startswith("jaxik ablate: ") and "no such file" in error
