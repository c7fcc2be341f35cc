"""The command line, as its user sees it."""

import dataclasses
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import jax
import numpy as np
import pytest

from fitting.cli import commands, main, progress
from fitting.datasets.clips import load_clip
from fitting.experiments import problems
from fitting.inference.optimisation import search
from fitting.inference.sampling.chain import journal_path
from fitting.studies import run_folder
from jaxik import record
from support import quick
from support.experiments import CLIP, ROOT, write
from support.records import ADULT, packed
from support.sample_clips import BVH

DATA = ROOT / "data"
COMMANDS = [
    "fit", "contribution", "sample", "apply", "run", "compare", "translate", "inspect", "terrain",
    "bench", "record", "record show", "record to-toml", "record to-bytes",
]  # fmt: skip
BASE = str(DATA / "clips" / "uneven_walk_base.npz")
GROUND = str(DATA / "terrains" / "slope.ply")
SAMPLE = "[sample]\nwalkers = 8\nstop_at = 1e9\nmax_steps = 40"


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    """A folder for compiled programs, so that the commands use none of the user's.

    They are compiled in a hurry: these tests run each of them once or twice, on short clips.
    """
    folder = tmp_path_factory.mktemp("compiled")
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_disable_most_optimizations", True)
    yield folder
    jax.config.update("jax_disable_most_optimizations", False)
    jax.config.update("jax_compilation_cache_dir", None)


@pytest.fixture
def quickly(monkeypatch):
    """Fits and samplings of residuals that compile at once; reports play the real pipeline."""
    monkeypatch.setattr(problems, "residuals_of_scenes", quick.residuals_of_scenes)


@pytest.fixture(scope="module")
def asked(tmp_path_factory) -> Path:
    return write(
        tmp_path_factory.mktemp("asked"), "hill.toml", clips=CLIP, clip="start = 1.0\nend = 1.5",
        rest=SAMPLE,
    )  # fmt: skip


@pytest.fixture(scope="module")
def run(asked, tmp_path_factory) -> Path:
    """A finished fit; not to be written to."""
    folder = tmp_path_factory.mktemp("runs") / "hill"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(problems, "residuals_of_scenes", quick.residuals_of_scenes)
        assert main.main(["fit", str(asked), "-o", str(folder)]) == 0
    return folder


def tree(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def refused(capsys, *words: object) -> str:
    """What a command says that is refused: a line on stderr, with status 2."""
    assert main.main([str(word) for word in words]) == main.MISTAKE
    told = capsys.readouterr()
    assert told.out == "" and told.err.count("\n") == 1
    assert told.err.startswith(f"jaxik {words[0]}: ")
    return told.err


# Help


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_shows_an_example_that_it_takes(command, capsys):
    with pytest.raises(SystemExit, match="0"):
        main.main([*command.split(), "--help"])
    text = capsys.readouterr().out
    example = text.partition("example:\n")[2]
    found = re.findall(rf"^  jaxik ({command} .*?)(?:   .*| > .*)?$", example, re.MULTILINE)
    assert found
    for words in found:
        main.parser().parse_args(words.split())


def test_the_help_tells_all_commands_examples_and_statuses(capsys):
    with pytest.raises(SystemExit, match="0"):
        main.main(["--help"])
    text = capsys.readouterr().out
    assert all(f"jaxik {name}" in text for name in COMMANDS if " " not in name)
    assert "exit status: 0 when done, 2 for a mistake" in text and "130 when" in text


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "required: COMMAND"),
        (["fti"], "invalid choice: 'fti'"),
        (["fit"], "required: EXPERIMENT.toml, -o/--output"),
        (["run", BASE, "-o", "a.npz"], "required: --terrain"),
        (["run", BASE, "--terrain", GROUND, "-o", "a.npz", "--floor", "nan"], "finite number"),
        (["record", "show", "a", "--tick-hz", "x"], "'x'; wanted a finite number"),
    ],
)
def test_words_that_make_no_command_are_refused(words, said, capsys):
    with pytest.raises(SystemExit, match="2"):
        main.main(words)
    assert said in capsys.readouterr().err


# Fit and sample


def test_a_fit_leaves_a_run_with_numbers_tables_and_pictures(run):
    names = {run_folder.EXPERIMENT, run_folder.FIT, run_folder.PARAMETERS, run_folder.SUMMARY}
    assert names <= tree(run) and {"motion.png", "cost.png"} <= tree(run)
    told = json.loads((run / run_folder.FIT).read_text())
    assert told["converged"] and told["experiment"] == "hill"
    for row in told["parameters"]:
        assert row["value"] == pytest.approx(quick.TARGETS[row["name"]], abs=0.003)


def test_sampling_goes_on_where_it_was(quickly, run, tmp_path, capsys):
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


def test_a_sampling_that_was_killed_goes_on_to_the_chain_of_an_unbroken_one(
    quickly, run, tmp_path, cache
):
    killed, whole = (Path(shutil.copytree(run, tmp_path / name)) for name in ("killed", "whole"))
    paths = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    process = subprocess.Popen(
        [sys.executable, "-m", "support.quick", "sample", str(killed)]
        + ["--max-steps", "1000000"],
        env=os.environ
        | {"PYTHONPATH": paths, "JAX_COMPILATION_CACHE_DIR": str(cache)}
        | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"},
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


def test_an_interrupted_fit_is_written_with_its_best_point(
    quickly, asked, tmp_path, monkeypatch, capsys
):
    def interrupt(progress: search.Progress) -> str:
        signal.raise_signal(signal.SIGINT)
        return ""

    monkeypatch.setattr(progress, "fit_line", interrupt)
    status = main.main(["fit", str(asked), "-o", str(tmp_path / "run")])
    assert status == main.INTERRUPTED == 130
    told = json.loads((tmp_path / "run" / run_folder.FIT).read_text())
    assert told["message"].startswith("Interrupted after 0 steps") and not told["converged"]
    assert np.isfinite(told["cost"]) and told["message"] in capsys.readouterr().out
    assert run_folder.SUMMARY in tree(tmp_path / "run")


def test_an_interrupt_that_another_hook_swallows_is_raised_at_the_next_report(capsys):
    def show(_) -> str:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            pass
        return "going on"

    told = search.Progress("start", 0, 0, 1.0, 1.0, 0.0)
    with progress.Line(show) as line:
        line(told)
        assert capsys.readouterr().err == "going on\n"
        with pytest.raises(KeyboardInterrupt):
            line(told)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_interrupted_sampling_keeps_its_chain(quickly, run, tmp_path, monkeypatch, capsys):
    copy = Path(shutil.copytree(run, tmp_path / "run"))

    def interrupt(progress) -> str:
        signal.raise_signal(signal.SIGINT)
        return ""

    monkeypatch.setattr(progress, "sample_line", interrupt)
    assert main.main(["sample", str(copy), "--max-steps", "300"]) == main.INTERRUPTED
    assert "Interrupted, the chain is kept" in capsys.readouterr().out
    assert len(chain_of(copy)) == 100


def test_an_interrupt_before_there_is_anything_leaves_nothing(
    quickly, asked, tmp_path, monkeypatch, capsys
):
    def interrupt(*_):
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(experiment, "make_problem", interrupt)
    assert main.main(["fit", str(asked), "-o", str(tmp_path / "run")]) == main.INTERRUPTED
    assert capsys.readouterr().err == "\njaxik fit: interrupted\n" and not tree(tmp_path)


def test_the_parameters_are_kept_if_anything_fails_after_the_search(
    quickly, asked, tmp_path, monkeypatch, capsys
):
    def fail(*_):
        raise ValueError("no slopes")

    monkeypatch.setattr(commands, "assess_identifiability", fail)
    assert "no slopes" in refused_after_progress(capsys, "fit", asked, "-o", tmp_path / "run")
    assert tree(tmp_path / "run") == {run_folder.EXPERIMENT, run_folder.PARAMETERS}


def refused_after_progress(capsys, *words: object) -> str:
    assert main.main([str(word) for word in words]) == main.MISTAKE
    return capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(
    ("parts", "said"),
    [
        ({"top": "fobs = 30"}, "unknown key 'fobs'; nearest is 'fps'"),
        ({"free": "pelvis.on_gian = {}"}, "nearest is 'pelvis.on_gain'"),
        ({"clips": CLIP, "clip": "end = 100.0"}, "trim from 0.0 s to 100.0 s"),
        ({"clip": "truth = 'broken.toml'"}, "broken.toml: not TOML"),
        ({"clip": "truth = 'odd.toml'"}, "odd.toml: lock.max_speed is 'x'; wanted a number"),
        ({"clip": "truth = '.'"}, "truth '.': a folder"),
    ],
)
def test_a_wrong_experiment_leaves_nothing(parts, said, tmp_path, capsys):
    (tmp_path / "broken.toml").write_text("lock = [[")
    (tmp_path / "odd.toml").write_text("[lock]\nmax_speed = 'x'")
    path = write(tmp_path, **parts)
    before = tree(tmp_path)
    assert said in refused(capsys, "fit", path, "-o", tmp_path / "run")
    assert tree(tmp_path) == before


def test_a_run_where_a_file_is_is_refused(asked, tmp_path, capsys):
    (tmp_path / "file").write_text("kept")
    assert "is a file" in refused(capsys, "fit", asked, "-o", tmp_path / "file")
    assert (tmp_path / "file").read_text() == "kept"


@pytest.mark.parametrize("words", [["sample"], ["apply", BASE, "--terrain", GROUND, "-o", "a.npz"]])
def test_a_folder_without_a_fit_is_refused(words, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    line = [words[0], tmp_path, *words[1:]]
    assert "no experiment.toml; there is nothing; `jaxik fit` makes" in refused(capsys, *line)
    line[1] = tmp_path / "no"
    assert "no such folder" in refused(capsys, *line)
    assert not tree(tmp_path)


def test_a_run_of_other_parameters_than_its_experiment_is_refused(run, tmp_path, capsys):
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    told = json.loads((copy / run_folder.FIT).read_text())
    told["parameters"].reverse()
    (copy / run_folder.FIT).write_text(json.dumps(told))
    assert "fit.json has" in refused(capsys, "sample", copy)
    assert run_folder.CHAIN not in tree(copy)


def test_more_steps_than_none_are_wanted(run, tmp_path, capsys):
    copy = shutil.copytree(run, tmp_path / "run")
    assert "max-steps is 0" in refused(capsys, "sample", copy, "--max-steps", "0")


# Run and apply


def test_apply_writes_what_the_benchmark_scores(run, mocap, tmp_path, capsys):
    whole = dict(np.load(mocap / "blocks" / "03_03.npz"))
    frames = len(whole["pelvis"])
    cut = {k: v[:60] if np.ndim(v) and len(v) == frames else v for k, v in whole.items()}
    np.savez(tmp_path / "blocks.npz", **cut)
    out = tmp_path / "out.npz"
    words = ["apply", run, tmp_path / "blocks.npz", "--terrain", mocap / "blocks" / "terrain.ply"]
    assert main.main([*map(str, words), "-o", str(out)]) == 0
    said = capsys.readouterr().out
    assert "60 frames in" in said
    score = [sys.executable, str(mocap / "blocks" / "score.py"), "blocks.npz", "out.npz"]
    done = subprocess.run(score, cwd=tmp_path, capture_output=True, text=True, check=True)
    told = json.loads(done.stdout)
    assert told["bone_length_error_max_mm"] < 1.0 and told["ankle_cm"] < 15.0
    figures = [float(line.split()[-1]) for line in said.splitlines()[-len(told) :]]
    np.testing.assert_allclose(figures, list(told.values()), atol=0.011)
    clip, captured = load_clip(out), load_clip(tmp_path / "blocks.npz")
    assert clip.positions_ws.shape == captured.positions_ws.shape
    with np.load(out) as archive:
        np.testing.assert_array_equal(archive["knee"], clip.joints_ws(1))
        np.testing.assert_array_equal(archive["pelvis"], clip.positions_ws[:, 0])


def test_run_takes_a_bvh_and_a_parameter_file(tmp_path, capsys):
    (tmp_path / "step.bvh").write_text(BVH)
    (tmp_path / "still.toml").write_text("lock.enabled = false\n[leg]\nweight = 0.0\n")
    words = ["run", tmp_path / "step.bvh", "--terrain", GROUND, "-o", tmp_path / "out.npz"]
    words += ["--parameters", tmp_path / "still.toml"]
    assert main.main([*map(str, words)]) == 0
    said = capsys.readouterr().out
    assert "3 frames in" in said and "captured" not in said
    solved, clip = load_clip(tmp_path / "out.npz"), load_clip(tmp_path / "step.bvh")
    assert solved.joint_names == clip.joint_names and solved.fps == clip.fps
    assert np.isfinite(solved.positions_ws).all()


def test_parameters_that_give_no_finite_pose_write_nothing(tmp_path, capsys):
    (tmp_path / "step.bvh").write_text(BVH)
    (tmp_path / "mad.toml").write_text("pelvis.tick_hz = -inf\nleg.soften = inf\n")
    words = ["run", tmp_path / "step.bvh", "--terrain", GROUND, "-o", tmp_path / "out.npz"]
    assert "not finite" in refused(capsys, *words, "--parameters", tmp_path / "mad.toml")
    assert not (tmp_path / "out.npz").exists()


MESHES = {"m.ply": "hi", "p.obj": "v 0 0 0\nv 1 0 0\nv 0 0 1\n", "t.toml": ""}


@pytest.mark.parametrize(
    ("clip", "ground", "out", "more", "said"),
    [
        ("no.bvh", GROUND, "a.npz", [], "no.bvh: no such file"),
        (str(DATA), GROUND, "a.npz", [], "data: wanted a .bvh, .amc or .npz file"),
        ("bad.bvh", GROUND, "a.npz", [], "bad.bvh:1: wanted HIERARCHY"),
        ("bad.npz", GROUND, "a.npz", [], "bad.npz: wanted a NumPy archive"),
        ("legless.bvh", GROUND, "a.npz", [], "legless.bvh: no pair of legs recognised"),
        (BASE, "no.ply", "a.npz", [], "no.ply: there is no such file"),
        (BASE, str(DATA), "a.npz", [], "data: there is no such file"),
        (BASE, "m.ply", "a.npz", [], "m.ply: trimesh cannot read it"),
        (BASE, "p.obj", "a.npz", [], "p.obj: terrain needs triangles"),
        (BASE, "t.toml", "a.npz", [], "t.toml: trimesh reads"),
        (BASE, GROUND, "a", [], "a: wanted a name that ends in .npz"),
        (BASE, GROUND, "d.npz", [], "d.npz: cannot be written: it is a folder"),
        (BASE, GROUND, "no/a.npz", [], "there is no folder no"),
        (BASE, GROUND, "a.npz", ["--preset", "recrod"], "no preset named 'recrod'"),
        (BASE, GROUND, "a.npz", ["--parameters", "no.toml"], "no.toml: no such file"),
        (BASE, GROUND, "a.npz", ["--parameters", "legs.toml"], "foot.max_roll has 3 values"),
    ],
)
def test_what_cannot_be_run_is_told_and_nothing_written(
    clip, ground, out, more, said, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    files = MESHES | {"bad.bvh": "hi", "bad.npz": "hi", "legs.toml": "foot.max_roll = [1, 2, 3]"}
    files["legless.bvh"] = BVH.replace("Left", "A").replace("Right", "B")
    for name, text in files.items():
        Path(name).write_text(text)
    Path("d.npz").mkdir()
    before = tree(tmp_path)
    assert said in refused(capsys, "run", clip, "--terrain", ground, "-o", out, *more)
    assert tree(tmp_path) == before


# Inspect


def test_inspect_tells_of_a_clip_in_words_and_as_json(capsys):
    assert main.main(["inspect", BASE]) == 0
    assert capsys.readouterr().out.startswith("walker seed 2: 360 frames, 11.97 s at 30 Hz")
    assert main.main(["inspect", BASE, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["fps"] == 30.0 and set(told["legs"]) == {"left", "right"}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["no.bvh"], "no.bvh: no such file"),
        ([str(DATA)], "wanted a .bvh, .amc or .npz file"),
        (["step.bvh", "--scale", "nan"], "scale is nan; wanted a number above 0"),
        (["step.amc", "--asf", "no.asf"], "no.asf: No such file"),
    ],
)
def test_inspect_refuses_what_it_cannot_read(words, said, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("step.bvh").write_text(BVH)
    Path("step.amc").write_text(":FULLY-SPECIFIED\n:DEGREES\n1\nroot 0 0 0 0 0 0\n")
    assert said in refused(capsys, "inspect", *words)


def test_a_reader_that_has_enough_is_no_error(tmp_path):
    script = f"import sys; from fitting import cli; sys.exit(cli.main(['inspect', {BASE!r}]))"
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, "-c", script], stdout=writer, stderr=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, "")


# Record


@pytest.fixture
def binary(tmp_path) -> Path:
    made = dataclasses.replace(
        packed(cosineMaxKneeAngle=-0.987654), knee_axis_type=4, flags=0b10101_101,
        padding=b"\x12\x34", tail=b"tail",
    )  # fmt: skip
    path = tmp_path / "footik.bin"
    path.write_bytes(record.to_bytes(made))
    return path


@pytest.mark.parametrize(
    "more", [[], ["--knee", "flexion", "--lean-sign", "-1", "--tick-hz", "60"]]
)
def test_a_record_turned_to_toml_and_back_is_the_same_to_the_byte(binary, more, capsys):
    toml, back = binary.with_suffix(".toml"), binary.with_name("back.bin")
    assert main.main(["record", "to-toml", str(binary), "-o", str(toml), *more]) == 0
    words = ["record", "to-bytes", str(toml), "--base", str(binary), "-o", str(back), *more]
    assert main.main(words) == 0
    assert back.read_bytes() == binary.read_bytes()


def test_show_tells_both_names_and_both_units(binary, capsys):
    assert main.main(["record", "show", str(binary)]) == 0
    text = capsys.readouterr().out
    assert re.search(r"kneeAxisType +4 \(-Y\)", text)
    assert re.search(r"useFootEndRay +off +probe.use_toe", text)
    assert re.search(r"lockedDisableMaxAngle +172 +lock.release_max_angle = 3.00197 rad", text)
    assert all(name in text for name in ADULT)


def test_a_record_goes_through_csv_to_the_byte(binary, capsys):
    assert main.main(["record", "show", str(binary), "--csv"]) == 0
    path, back = binary.with_suffix(".csv"), binary.with_name("back.bin")
    path.write_text(capsys.readouterr().out)
    assert main.main(["record", "to-bytes", str(path), "-o", str(back)]) == 0
    assert back.read_bytes() == binary.read_bytes()


@pytest.mark.filterwarnings("default")
def test_lengths_in_centimetres_are_remarked_in_a_line(tmp_path, capsys):
    path = tmp_path / "cm.bin"
    made = packed(raycastDistanceUp=50.0, raycastDistanceDown=80.0)
    path.write_bytes(record.to_bytes(made))
    assert main.main(["record", "show", str(path)]) == 0
    told = capsys.readouterr()
    assert "jaxik: raycastDistanceUp = 50.0 is read as centimetres\n" in told.err
    assert re.search(r"raycastDistanceUp +50 +probe.ray_up = 0.5 m", told.out)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["show", "no.bin"], "no.bin: no such file, wanted a record"),
        (["show", "."], "a folder, wanted a record"),
        (["show", "short.bin"], "short.bin: a foot-IK record has at least 128 bytes; these are 3"),
        (["show", "bad.csv"], "bad.csv: the CSV has no column"),
        (["show", "binary.csv"], "binary.csv: 'utf-8' codec can't decode"),
        (["show", "none.csv"], "none.csv: the CSV has no row"),
        (["show", "no.toml"], "no.toml: no such file, wanted a parameter file"),
        (["show", "bad.toml"], "bad.toml: unknown key 'lok'; nearest is 'lock'"),
        (["show", "nan.bin"], "nan.bin: originalGroundHeightMS is nan"),
        (["show", "axis.bin"], "axis.bin: kneeAxisType is 9"),
        (["show", "footik.bin", "--tick-hz", "0"], "tick_hz is 0.0"),
        (["to-toml", "nan.bin", "-o", "a.toml"], "nan.bin: originalGroundHeightMS is nan"),
        (["to-toml", "two.csv", "-o", "a.toml"], "two.csv has 2 rows"),
        (["to-toml", "footik.bin", "-o", "no/a.toml"], "there is no folder no"),
        (["to-bytes", "one.toml", "-o", "."], "cannot be written: it is a folder"),
        (["to-bytes", "one.toml", "--base", "no.bin", "-o", "a.bin"], "no.bin: no such file"),
        (["to-bytes", "two.csv", "--base", "footik.bin", "-o", "a.bin"], "a base completes"),
    ],
)
def test_what_is_no_record_is_refused(words, said, binary, capsys, monkeypatch):
    monkeypatch.chdir(binary.parent)
    rows = record.to_csv([packed(), packed()])
    texts = {"bad.csv": "a,b\n1,2\n", "none.csv": rows.splitlines()[0] + "\n", "two.csv": rows}
    texts |= {"bad.toml": "[lok]\nx = 1", "one.toml": "lock.enabled = false"}
    for name, text in texts.items():
        Path(name).write_text(text)
    made = {"nan.bin": packed(originalGroundHeightMS=np.nan)}
    made["axis.bin"] = dataclasses.replace(packed(), knee_axis_type=9)
    for name, one in made.items():
        Path(name).write_bytes(record.to_bytes(one))
    Path("short.bin").write_bytes(b"abc")
    Path("binary.csv").write_bytes(b"\xff\xfe")
    before = tree(binary.parent)
    assert said in refused(capsys, "record", *words)
    assert tree(binary.parent) == before


def test_parameters_of_another_system_make_no_record(tmp_path, capsys):
    given = tmp_path / "ozz.toml"
    given.write_text('preset = "ozz"\n')
    words = ["record", "to-bytes", str(given), "-o", str(tmp_path / "footik.bin")]
    assert main.main(words) == main.MISTAKE
    told = capsys.readouterr().err
    assert told.endswith("parameters of 'ozz'; only those of 'record' make one\n")
    assert not (tmp_path / "footik.bin").exists()
