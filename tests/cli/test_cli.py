"""The command line, as its user sees it; what needs a fit is in `tests/test_jobs.py`."""

import io
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tomllib
import warnings
from contextlib import suppress
from pathlib import Path
from unittest.mock import Mock

import jsonschema
import numpy as np
import pytest

from fitting.cli import machine, main, start
from fitting.cli.parser import make_parser
from fitting.clips import formats, load_clip, save_clip
from fitting.clips.clip_frames import raised
from fitting.experiment import systems
from fitting.experiment.experiment_files import load_experiment
from fitting.experiment.schema import experiment_schema
from fitting.ground.coverage import GroundWarning
from fitting.ground.meshes import load_terrain, mesh_of, save_mesh
from fitting.inference.optimise.solution import Progress
from fitting.runtime import activity
from fitting.studies import exports
from fitting.studies.animations import Animation, AnimationFiles
from fitting.synthetic import walker
from jaxik.maths import parameter_tree
from support import gltf_files, grounds
from support.commands import commands, refusal, replace_call
from support.experiments import ROOT, write
from support.sample_clips import BVH
from support.watching import Recorder

DATA = ROOT / "data"
BASE, GROUND = DATA / "clips" / "uneven_walk_base.npz", DATA / "terrains" / "slope.ply"
FILES = {"DATA": DATA, "BASE": BASE, "GROUND": GROUND}
pytestmark = pytest.mark.filterwarnings(
    "ignore::fitting.ground.coverage.GroundWarning",
    "always::fitting.studies.animations.PlacementWarning",
)


def run(*words: object) -> None:
    assert main.main([str(word) for word in words]) == 0


def test_every_command_has_a_call_and_examples_that_it_accepts():
    for command, parser in commands().items():
        example = parser.format_help().partition("example:\n")[2]
        found = re.findall(rf"^  jaxik ({command}\b.*?)(?:   .*| > .*)?$", example, re.MULTILINE)
        assert found, command
        for words in found:
            assert callable(make_parser().parse_args(shlex.split(words)).call)


def test_the_help_lists_all_commands_and_exit_statuses(capsys):
    with pytest.raises(SystemExit, match="0"):
        main.main(["--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert [name for name in commands() if f"jaxik {name}" not in text and " " not in name] == []
    statuses = "0 when done, 1 when `doctor` finds a problem, 2 for a mistake.* 3 when the search.*"
    statuses += " 4 when `fit` has converged but does not fit.* 5 when `calibrate` finds something "
    statuses += "outside its bounds.* 6 when a fit of `fit-many` has failed.* 130 when"
    assert re.search(f"exit status: {statuses}", text)


def test_wrong_words_are_rejected_and_an_old_one_still_works_and_says_the_new_one(tmp_path, capsys):
    for line, message in (
        ("", "required: COMMAND"),
        ("fti", "invalid choice: 'fti'"),
        ("fit", "required: EXPERIMENT.toml, -o/--output"),
        ("run walk.npz -o a.npz", "required: --terrain"),
        ("run walk.npz --terrain hill.ply -o a.npz --root x", "invalid choice: 'x'"),
    ):
        with pytest.raises(SystemExit, match="2"):
            main.main(line.split())
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1 and error.startswith("jaxik")
    words = ["contribution", str(tmp_path / "no.toml"), "-o", str(tmp_path / "out")]
    assert main.main(words) == main.MISTAKE == 2
    warning, error = capsys.readouterr().err.splitlines()
    assert warning.startswith("jaxik: `contribution` is now called `ablate`")
    assert error.startswith("jaxik ablate: ") and "no such file" in error


# Ctrl-C, as the command begins, at work, and as it ends
COMMAND = """
import dataclasses, signal, sys, time
from fitting.cli import start

class Hook:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)  # where no error can be raised

def work(options):
    Hook()
    for _ in range(1000):
        time.sleep(0.01)

if sys.argv[1] == "example":
    from fitting.cli import main, parser
    main._import_jax = lambda: None
    parser.COMMANDS = [dataclasses.replace(command, call=work) for command in parser.COMMANDS]
signal.signal(signal.SIGINT, signal.default_int_handler)
if status := start.main():
    sys.exit(status)
signal.raise_signal(signal.SIGINT)
"""
# An import that is interrupted, as modules of C report it.
IMPORTED = """
import signal
from contextlib import suppress
try:
    signal.raise_signal(signal.SIGINT)
except KeyboardInterrupt:
    raise ImportError("while initializing the extension")
"""


@pytest.mark.parametrize("words", [["parameters"], ["example"], ["completion", "bash"]])
def test_an_interrupt_at_any_moment_is_a_line_and_its_status(words, tmp_path):
    (tmp_path / "jax.py").write_text(IMPORTED, encoding="utf-8")
    search_path = os.pathsep.join([str(tmp_path), str(ROOT)])
    done = subprocess.run(
        [sys.executable, "-c", COMMAND, *words],
        env=os.environ | {"PYTHONPATH": search_path}, capture_output=True, text=True, timeout=15,
    )  # fmt: skip
    assert done.returncode == start.INTERRUPTED == 130
    assert done.stderr == f"\njaxik {words[0]}: interrupted\n"


def test_a_warning_of_another_library_comes_under_its_name(monkeypatch, capsys):
    def work(_) -> int:
        for place in ("arviz_base/a.py", "odd.py", "fitting/b.py", "jaxik/c.py"):
            file = f"/env/lib/python3.11/site-packages/{place}"
            warnings.warn_explicit(f"of {place}", UserWarning, file, 1)
        warnings.warn_explicit("of a checkout", UserWarning, "/home/checkout/fitting/b.py", 1)
        return 0

    replace_call(monkeypatch, machine.doctor, work)
    with warnings.catch_warnings(action="always"):
        run("doctor")
    assert capsys.readouterr().err.splitlines() == [
        "jaxik: arviz_base says: of arviz_base/a.py", "jaxik: odd says: of odd.py",
        "jaxik: of fitting/b.py", "jaxik: of jaxik/c.py", "jaxik: of a checkout",
    ]  # fmt: skip


def test_an_interrupt_swallowed_by_a_hook_is_raised_later_and_a_second_one_ends_the_process(
    monkeypatch, capfd
):
    ended = Mock()
    monkeypatch.setattr(start, "end", ended)

    report = Progress("start", 0, 0, 1.0, 1.0, 0.0)
    with start.interruptible():
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        assert "Ctrl-C again stops at once" in capfd.readouterr().err
        with pytest.raises(KeyboardInterrupt):
            activity.report(report)
        assert not ended.called
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        assert ended.called
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("mistake", [False, True])
def test_work_goes_on_when_nobody_reads_what_is_printed(mistake, monkeypatch, tmp_path):
    def work(_) -> int:
        if mistake:
            raise ValueError("which is the first line")
        for stream in 2 * (sys.stdout, sys.stderr):
            print("a line", file=stream, flush=True)
        (tmp_path / "result").touch()
        return 3

    replace_call(monkeypatch, machine.doctor, work)
    (reader, out), (other, err) = os.pipe(), os.pipe()
    with os.fdopen(out, "w") as stdout, os.fdopen(err, "w", buffering=1) as stderr:
        monkeypatch.setattr(sys, "stdout", stdout)
        monkeypatch.setattr(sys, "stderr", stderr)
        os.close(reader)
        os.close(other)
        assert main.main(["doctor"]) == (main.MISTAKE if mistake else 3)
    assert (tmp_path / "result").exists() != mistake


@pytest.mark.parametrize("command", ["parameters stride", "schema", "schema --format json"])
def test_characters_that_a_stream_lacks_are_replaced(command, monkeypatch, capsys):
    run(*command.split())
    printed = capsys.readouterr().out
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", stream)
    run(*command.split())
    assert stream.buffer.getvalue().decode() == printed.encode("ascii", "replace").decode()
    assert not printed.isascii()


ORIGINAL = 'preset = "record"\nfaithful = true\n'  # compiles sooner than the preset


def test_a_mistake_is_reported_and_nothing_written(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    files = {"m.ply": "hi", "p.obj": "v 0 0 0\nv 1 0 0\nv 0 0 1\n", "t.toml": ""}
    files |= {"bad.bvh": "hi", "bad.npz": "hi", "legs.toml": "foot.max_roll = [1, 2, 3]"}
    files |= {"step.bvh": BVH, "mad.toml": f"{ORIGINAL}lean.forward_rate = inf\n"}
    files |= {"broken.toml": "lock = [[", "odd.toml": "lock.max_speed = 'x'"}
    files["legless.bvh"] = BVH.replace("Left", "A").replace("Right", "B")
    for name, text in files.items():
        Path(name).write_text(text)
    write(tmp_path, "hill.toml")
    for truth in ("broken.toml", "odd.toml"):
        write(tmp_path, f"of_{truth}", clip=f"truth = '{truth}'")
    shutil.copy(BASE, "walk.npz")
    Path("d.npz").mkdir()
    for line, message in (
        ("run DATA --terrain GROUND -o a.npz", f"data: wanted a {', '.join(formats.READERS)} or"),
        ("run bad.bvh --terrain GROUND -o a.npz", "bad.bvh:1: wanted HIERARCHY"),
        ("run bad.npz --terrain GROUND -o a.npz", "bad.npz: wanted a NumPy archive"),
        ("run legless.bvh --terrain GROUND -o a.npz", "legless.bvh: no pair of legs recognised"),
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
        ("run walk.npz --terrain GROUND -o walk.npz", "is the clip that is read; name another"),
        ("fit hill.toml -o m.ply", "is a file"),
        ("parameters walker", "no preset named 'walker'; there are ['mec', "),
        ("parameters stride --faithful", "no other original"),
        ("parameters --search elbow", "no parameter of record mentions 'elbow'"),
        ("example uneven", "nearest is 'uneven_walk' of ["),
        ("example -o walk", "needs the NAME"),
        ("fit of_broken.toml -o out", "broken.toml: not TOML"),
        ("fit of_odd.toml -o out", "odd.toml: lock.max_speed is 'x'; wanted a number"),
        ("sample d.npz", "there is nothing; `jaxik fit` makes"),
        ("apply d.npz BASE --terrain GROUND -o a.npz", "there is nothing; `jaxik fit` makes"),
    ):
        error = refusal([FILES.get(word, word) for word in line.split()], tmp_path, capsys)
        assert error.startswith(f"jaxik {line.split()[0]}: ") and message in error


def test_run_writes_the_motion_on_the_skeleton_that_came_in(tmp_path, capsys):
    (tmp_path / "step.bvh").write_text(BVH)
    (tmp_path / "original.toml").write_text(ORIGINAL)
    words = ["run", tmp_path / "step.bvh", "--terrain", GROUND]
    words += ["--parameters", tmp_path / "original.toml", "-o"]
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


@pytest.fixture(scope="module")
def on_hill(tmp_path_factory) -> list:
    """Runs a flat walk on a hill of 2 m."""
    folder = tmp_path_factory.mktemp("hill")
    save_clip(folder / "walk.npz", walker.walk(5.0, 25.0))
    save_mesh(folder / "hill.ply", *grounds.hill(rows=61))  # of less than 512 triangles
    return ["run", folder / "walk.npz", "--terrain", folder / "hill.ply", "-o"]


@pytest.mark.slow
def test_run_puts_the_root_on_a_hill_and_shows_where_the_feet_are(on_hill, tmp_path, capsys):
    run(*on_hill, tmp_path / "out.npz", "--preset", "record")  # compiles sooner than `stride`
    output = capsys.readouterr()
    assert re.search(r"^root: on the ground below it, 0 to \d+ cm above its", output.out, re.M)
    assert re.search(
        r"^penetration of standing feet, % of frames +[0-4]\.\d$", output.out, re.MULTILINE
    )
    assert "--root ground" not in output.err
    with np.load(tmp_path / "out.npz") as archive:
        placement = json.loads(str(archive["placement"]))
    assert placement["penetration_stance"] < 0.05 and placement["groundless"] == 0.0
    assert load_clip(tmp_path / "out.npz").positions_ws[..., 1].max() > 2.5


@pytest.mark.slow
def test_apply_says_how_far_it_puts_a_clip_that_follows_its_ground_from_the_captured_one(
    on_hill, tmp_path, capsys
):
    walk, out = walker.walk(5.0, 25.0), tmp_path / "out.npz"
    along = np.clip((walk.positions_ws[:, 0, 2] - 1.0) / 14.0, 0.0, 1.0)  # the hill
    captured = raised(walk, 1.0 - np.cos(2.0 * np.pi * along))
    save_clip(tmp_path / "up.npz", captured)
    (tmp_path / "run").mkdir()
    # Of the preset that runs on the hill elsewhere, so that there is a program.
    (tmp_path / "run" / "parameters.toml").write_text('preset = "record"\n')
    run("apply", tmp_path / "run", tmp_path / "up.npz", *on_hill[2:], out)
    figures = capsys.readouterr().out.partition("difference from the captured motion")[2]
    solved = load_clip(out)
    apart = solved.positions_ws[:, 0, 1] - captured.positions_ws[:, 0, 1]
    rms = 100.0 * float(np.sqrt(np.mean(apart**2)))  # cm
    (pelvis,) = re.findall(r"^pelvis\b.* (\S+)$", figures, re.MULTILINE)
    assert float(pelvis) == pytest.approx(rms, abs=0.006)
    with np.load(out) as archive:
        np.testing.assert_array_equal(archive["knee"], solved.joints_ws(1))
        np.testing.assert_array_equal(archive["pelvis"], solved.positions_ws[:, 0])


def test_run_warns_of_a_root_that_stays_below_a_hill_and_names_frames(on_hill, tmp_path, capsys):
    run(*on_hill, tmp_path / "out.npz", "--root", "animation", "--preset", "record")
    output = capsys.readouterr()
    assert "\nroot: as animated\n" in output.out
    first, *_, cause = output.err.splitlines()
    place = r"worst 1\d\d\.\d cm, (left|right), frame \d+"
    assert re.match(r"jaxik: penetration \d\d\.\d % of frames \(≤ 5\.0\), " + place, first)
    assert cause == (
        "jaxik: likely cause of feet off the ground: the root stays on the animation's floor "
        "where the ground rises (use --root ground)"
    )


def test_run_names_the_other_up_axis(on_hill, tmp_path, capsys, monkeypatch):
    """By clip and ground alone: the ground's shapes would need a program of their own."""
    result = Mock(corrections=Mock(twist=None, spine=None))
    monkeypatch.setattr(Animation, "solve", lambda animation, ik: (result, animation.clip))
    monkeypatch.setattr(Animation, "reached", lambda *_: np.full((125, 2), np.nan))
    warnings.filterwarnings("always", category=GroundWarning)  # the module's mark comes first
    run(*on_hill, tmp_path / "out.npz", "--file-up", "z")
    output = capsys.readouterr()
    assert "preset stride, as all feet stand in turn; --preset takes another\n" in output.out
    assert "root: as animated: there is no ground below most of its path" in output.out
    assert "ground under 0.0 % of its standing feet: the feet are at x " in output.err
    assert "; the terrain is at x " in output.err
    assert output.err.splitlines()[0].endswith("; likely remedy: --file-up y")
    words = [*on_hill, tmp_path / "other.npz", "--file-up", "z", "--root", "ground"]
    assert refusal(words, tmp_path, capsys).endswith("m; likely remedy: --file-up y")


def test_inspect_describes_a_clip_in_words_and_as_json_and_asks_for_one_of_several_animations(
    tmp_path, capsys
):
    run("inspect", BASE)
    assert capsys.readouterr().out.startswith("walker seed 2: 360 frames, 11.97 s at 30 Hz")
    run("inspect", BASE, "--json")
    description = json.loads(capsys.readouterr().out)
    assert description["fps"] == 30.0 and set(description["legs"]) == {"left", "right"}
    path = tmp_path / "walk.gltf"
    file = gltf_files.walker()
    keys = {(1, "translation"): ([0.0, 0.1], [[0, 0, 90], [0, 0, 80]], "LINEAR")}
    path.write_text(file.animate("Run", keys).text())
    line = refusal(["inspect", path], tmp_path, capsys)
    assert "2 animations: 'Walk', 'Run'; choose one" in line
    run("inspect", path, "--animation", "Run")
    assert "2 frames" in capsys.readouterr().out


def test_the_reading_of_a_clip_is_announced(monkeypatch):
    recorder = Recorder()
    monkeypatch.setattr(main, "watched", lambda: activity.watched_by(recorder))
    run("inspect", BASE)
    assert recorder.titles[-1] == f"Reading {BASE.name}"
    recorder = Recorder()
    with activity.watched_by(recorder):
        AnimationFiles(BASE, GROUND).flat_clip  # noqa: B018  # as `run` and others do
    assert recorder.titles == [f"Reading {BASE.name}"]


# Numbers among the options: both ends of a range are accepted, nothing beyond is

OF_CLIPS = {"--scale": ("1e-9", "1e6"), "--sole": ("0", "10")}
OF_TERRAINS = {"--terrain-scale": ("1e-9", "1e6"), "--terrain-cell": ("0.001", "1e4")}
OF_TERRAINS |= {"--terrain-offset": ("-1e6", "1e6")}
OF_ANIMATIONS = (
    {"--floor": ("-1e6", "1e6"), "--speed": ("0.01", "100"), "--direction": ("-90", "90")}
    | OF_CLIPS
    | OF_TERRAINS
)
OF_PAGES = {"--port": ("0", "65535")}
OF_RECORDS = {"--tick-hz": ("1", "1000")}
RANGES = {  # by command, with other words that it needs
    "init walk.bvh -o out": OF_CLIPS | OF_TERRAINS,
    "ablate e.toml -o out": {"--folds": ("2", "1000")},
    "calibrate e.toml -o out": {
        "--replicates": ("1", "100000"), "--workers": ("0", "1024"),
        "--noise-factor": ("0.001", "1000"),
    },
    "fit-many e.toml -o out": {"--seeds": ("1", "10000"), "--workers": ("0", "1024")},
    "sample run": {"--max-steps": ("1", "1000000000")},
    "apply run walk.bvh --terrain hill.ply -o out": OF_ANIMATIONS,
    "fit e.toml -o out": OF_PAGES,
    "run walk.bvh --terrain hill.ply -o out": OF_ANIMATIONS,
    "view walk.bvh --terrain hill.ply -o out": OF_ANIMATIONS | OF_PAGES,
    "compare walk.bvh --terrain hill.ply -o out": OF_ANIMATIONS | {"--rates": ("1", "1000")},
    "translate --from mec --to record --clip a --terrain b -o out":
        {"--fps": ("1", "1000")} | OF_CLIPS | OF_TERRAINS,
    "inspect walk.bvh": OF_CLIPS,
    "export run -o out": {"--legs": ("1", "64")},
    "terrain walk.bvh -o hill.ply": {"--margin": ("0", "100")} | OF_CLIPS,
    "record show footik.bin": OF_RECORDS,
    "record to-toml footik.bin -o out": OF_RECORDS,
    "record to-bytes footik.toml -o out": OF_RECORDS,
}  # fmt: skip
ODD = ("", "x", "nan", "inf", "-inf", "1e300", "-1e300", "1" * 5000, "10" * 20, "0x10", "1;2", "\0")


def command_of(line: str) -> str:
    """The words of a line that name its command."""
    return max((name for name in commands() if f"{line} ".startswith(f"{name} ")), key=len)


def beyond(end: str, *, up: bool) -> str:
    """A number just outside a range."""
    if "." in end or "e" in end:
        return repr(float(end) * (1.001 if up == (float(end) > 0) else 0.999))
    return str(int(end) + (1 if up else -1))


def words(option: str, value: str) -> list[str]:
    """An option with its value, as a user types it."""
    return [option, "0", value, "0"] if option == "--terrain-offset" else [f"{option}={value}"]


@pytest.mark.parametrize("line", RANGES)
def test_a_number_is_accepted_up_to_the_ends_of_its_range(line, capsys):
    command, parser = command_of(line), make_parser()
    for option, (low, high) in RANGES[line].items():
        for value in (low, high):
            parser.parse_args([*line.split(), *words(option, value)])
        for value in (beyond(low, up=False), beyond(high, up=True), *ODD):
            with pytest.raises(SystemExit, match="2"):
                parser.parse_args([*line.split(), *words(option, value)])
            error = capsys.readouterr().err
            assert error.count("\n") == 1 and len(error) < 1100 and error[:-1].isprintable()
            assert error.startswith(f"jaxik {command}: argument ") and option in error
            assert "; wanted a" in error and "--help" in error


def test_every_number_among_the_options_has_a_range_here():
    numbers = {}
    for command, parser in commands().items():
        for action in parser._actions:
            if not action.option_strings or action.choices is not None or action.type is None:
                continue
            if getattr(action.type, "__module__", "").endswith("cli.options"):
                numbers.setdefault(command, set()).add(action.option_strings[-1])
            else:  # a path, or a converter of other texts
                assert action.type not in (int, float), action
    assert numbers == {command_of(line): set(options) for line, options in RANGES.items()}


# Commands that explain: `parameters`, `schema`, `example`, `completion`


def test_parameters_lists_every_one_with_its_declaration(capsys):
    for preset in systems.preset_names():
        assert main.main(["parameters", preset, "--format", "json"]) == 0
        rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)}
        ik = systems.preset_system(preset)
        assert list(rows) == [*parameter_tree.docs(ik)]
        for name, declared in parameter_tree.declarations(ik).items():
            shown = {key: rows[name][key] for key in ("low", "high", "unit", "kind")}
            assert shown == {key: getattr(declared, key) for key in shown}
            assert rows[name]["meaning"] == declared.doc
    main.main(["parameters", "ozz", "--search", "Pelvis.LIMIT"])
    assert "pelvis.limit  inf m    0 to 0.6  Furthest that" in capsys.readouterr().out
    main.main(["parameters", "record", "--faithful", "--format", "markdown"])
    assert "| contact.planted_height |" in capsys.readouterr().out


def test_schema_is_written_as_json_and_lists_every_key(tmp_path, capsys):
    path = tmp_path / "experiment.schema.json"
    assert main.main(["schema", "--format", "json", "-o", str(path)]) == 0
    assert json.loads(path.read_text(encoding="utf-8")) == experiment_schema()
    capsys.readouterr()
    assert main.main(["schema", "--format", "markdown"]) == 0
    rows = capsys.readouterr().out
    for key in ("fps", "clips.mask_pops", "fit.search.population", "rules.pelvis", "prior.spread"):
        assert f"| {key} | " in rows
    assert "| true, false | true | Whether frames in which a captured marker jumps" in rows


@pytest.mark.parametrize("name", ["uneven_walk", "calibration/ozz_noise"])
def test_a_copied_example_is_whole_and_names_its_schema(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    # Their clips are not in the repository.
    elsewhere = {"blocks", "blocks_walk", "blocks_causal", "climb", "two_grounds"}
    assert len(exports.names().keys() - elsewhere) == 15
    assert main.main(["example", name, "-o", "copy"]) == 0
    path = tmp_path / "copy" / f"{Path(name).name}.toml"
    loaded, original = load_experiment(path), load_experiment(exports.path_of(name))
    for part in ("free", "prior", "sigmas"):
        assert getattr(loaded, part) == getattr(original, part)
    for clip, source in zip(loaded.clips, original.clips, strict=True):
        assert clip.reference.is_relative_to(tmp_path)
        assert clip.reference.read_bytes() == source.reference.read_bytes()
        assert clip.terrain.read_bytes() == source.terrain.read_bytes()
    text = path.read_text(encoding="utf-8")
    schema = path.parent / text.splitlines()[0].removeprefix("#:schema ")
    validator = jsonschema.Draft202012Validator(json.loads(schema.read_text(encoding="utf-8")))
    validator.validate(tomllib.loads(text))
    assert main.main(["example", name, "-o", "copy"]) == main.MISTAKE
    assert "is already there" in capsys.readouterr().err


SCRIPT = """
source jaxik.bash
function=$(complete -p jaxik | sed 's/.*-F \\([^ ]*\\).*/\\1/')
cd "$1"
while IFS='|' read -ra COMP_WORDS; do
    COMP_CWORD=$((${#COMP_WORDS[@]} - 1)); COMPREPLY=()
    $function
    echo "${COMPREPLY[@]}"
done
"""
COMPLETED = {
    "jaxik para": {"parameters"},
    "jaxik parameters --format ": {"text", "markdown", "json"},
    "jaxik record to-": {"to-toml", "to-bytes"},
    "jaxik fit uneven": {"uneven_walk.toml"},
    "jaxik completion ": set(machine.SHELLS),
}


def test_bash_completes_commands_options_choices_and_files(tmp_path, capsys):
    pytest.importorskip("shtab")
    assert main.main(["completion", "bash"]) == 0
    (tmp_path / "jaxik.bash").write_text(capsys.readouterr().out)
    words = [line.replace(" ", "|") + "|\n" for line in COMPLETED]  # an empty last word counts
    command = ["bash", "-c", SCRIPT, "bash", str(exports.REPOSITORY / "experiments")]
    said = subprocess.check_output(
        command, env={"PATH": "/usr/bin:/bin"}, cwd=tmp_path, input="".join(words), text=True
    )
    offered = [set(line.split()) for line in said.splitlines()]
    assert dict(zip(COMPLETED, offered, strict=True)) == COMPLETED


def test_without_what_fits_need_the_command_says_what_to_install():
    program = "import sys; sys.modules['scipy'] = None\nfrom fitting.cli.start import main; main()"
    command = [sys.executable, "-c", program, "inspect", "no.bvh"]
    said = subprocess.run(command, capture_output=True, text=True)
    assert 'jaxik inspect: needs scipy: pip install "jaxik[fit]"' in said.stderr
    assert "Traceback" not in said.stderr


def test_there_is_a_script_for_each_shell_and_without_shtab_a_word_on_what_to_install(
    monkeypatch, capsys
):
    assert set(machine.SHELLS) == set(pytest.importorskip("shtab").SUPPORTED_SHELLS)
    for shell in machine.SHELLS:
        assert main.main(["completion", shell]) == 0
        assert "calibrate" in capsys.readouterr().out, shell
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert main.main(["completion", "bash"]) == main.MISTAKE
    said = 'jaxik completion: needs shtab: pip install "jaxik[completion]"\n'
    assert capsys.readouterr().err == said
