"""`jaxik export` of code: files, a trace that a program replays, and mistakes in one line."""

import subprocess

import numpy as np
import pytest

from fitting.cli import main
from fitting.clips import load_clip, save_clip
from fitting.codegen import toolchain
from support import mono, node
from support.commands import refusal
from support.experiments import ROOT
from support.mono import needs_mono
from support.node import needs_node

BASE = ROOT / "data" / "clips" / "uneven_walk_base.npz"
GROUND = ROOT / "data" / "terrains" / "slope.ply"


@pytest.fixture
def parameters(tmp_path):
    path = tmp_path / "system.toml"
    path.write_text('preset = "unreal"\nfaithful = true\n[contact]\nidle_speed = 9.0\n')
    return path


@pytest.mark.slow
def test_a_trace_of_a_clip_is_replayed_by_a_program_in_c(tmp_path, parameters, capsys):
    folder, clip = tmp_path / "code", load_clip(BASE)
    save_clip(tmp_path / "walk.npz", clip.select(slice(0, 5)))
    words = ["export", parameters, "--as", "c", "-o", folder, "--name", "walker"]
    words += ["--trace", tmp_path / "walk.npz", "--terrain", GROUND]
    assert main.main([str(word) for word in words]) == 0
    assert f"written to {folder}" in capsys.readouterr().out
    files = {"walker.h", "walker.c", "check.c", "walk.c", "trace.bin"}
    assert {path.name for path in folder.iterdir()} == files
    assert len((folder / "check.c").read_text().splitlines()) < 60
    compiler = toolchain.compiler("c")
    if compiler is None:
        pytest.skip("needs a compiler of C: none in $CC, no cc")
    build = [compiler, "-Wall", "-Wextra", "-Werror", "walker.c", "check.c", "-lm", "-o", "check"]
    subprocess.run(build, cwd=folder, check=True)
    done = subprocess.run(["./check"], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.startswith("5 frames, largest difference ")
    build[-1], build[5] = "walk", "walk.c"
    subprocess.run(build, cwd=folder, check=True)
    done = subprocess.run(["./walk"], cwd=folder, capture_output=True, text=True, check=True)
    ankles = np.loadtxt(done.stdout.splitlines())
    assert ankles.shape == (5, 7) and 0.02 < ankles[:, [2, 5]].min()  # number, then two places
    damaged = bytearray((folder / "trace.bin").read_bytes())
    damaged[-40:-36] = b"\0\0\0\x42"  # a number of the last result
    (folder / "trace.bin").write_bytes(damaged)
    assert subprocess.run(["./check"], cwd=folder, capture_output=True).returncode == 1


@pytest.mark.slow
@needs_mono
def test_a_trace_of_a_clip_is_replayed_by_a_program_in_csharp(tmp_path, parameters):
    folder, clip = tmp_path / "code", load_clip(BASE)
    save_clip(tmp_path / "walk.npz", clip.select(slice(0, 5)))
    words = ["export", parameters, "--as", "cs", "-o", folder, "--name", "one_walker"]
    words += ["--trace", tmp_path / "walk.npz", "--terrain", GROUND]
    assert main.main([str(word) for word in words]) == 0
    assert {path.name for path in folder.iterdir()} == {"OneWalker.cs", "Check.cs", "trace.bin"}
    mono.compile_code(folder, "Check.exe", "OneWalker.cs", "Check.cs")
    done = mono.run(folder, "Check.exe")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("5 frames, largest difference ")
    damaged = bytearray((folder / "trace.bin").read_bytes())
    damaged[-40:-36] = b"\0\0\0\x42"  # a number of the last result
    (folder / "trace.bin").write_bytes(damaged)
    assert mono.run(folder, "Check.exe").returncode == 1


@pytest.mark.slow
@needs_node
def test_a_trace_of_a_clip_is_replayed_by_a_script(tmp_path, parameters):
    folder, clip = tmp_path / "code", load_clip(BASE)
    save_clip(tmp_path / "walk.npz", clip.select(slice(0, 5)))
    words = ["export", parameters, "--as", "js", "-o", folder]
    words += ["--trace", tmp_path / "walk.npz", "--terrain", GROUND]
    assert main.main([str(word) for word in words]) == 0
    assert {path.name for path in folder.iterdir()} == {"footik.mjs", "check.mjs", "trace.bin"}
    done = node.run(folder, "check.mjs")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("5 frames, largest difference ")
    module = (folder / "footik.mjs").read_text()
    assert "/* m/s, 0 to 3: Speed of the character up to" in module
    damaged = np.fromfile(folder / "trace.bin")
    damaged[-10] += 0.5  # a number of the last result
    damaged.tofile(folder / "trace.bin")
    assert node.run(folder, "check.mjs").returncode == 1


def test_parameters_have_units_ranges_and_meanings_beside_them(tmp_path, parameters):
    main.main(["export", str(parameters), "--as", "c", "-o", str(tmp_path), "--legs", "1"])
    header, code = ((tmp_path / f"footik.{kind}").read_text() for kind in "hc")
    assert "#define FOOTIK_LEGS 1\n" in header
    assert "Foot IK of 1 leg, made by jaxik" in header and "contact StandingContact" in header
    assert "/* m/s, 0 to 3: Speed of the character up to" in " ".join(header.split())
    assert "9.0f /* idle_speed */" in code
    assert "/* m, hip to knee. */\n    float thigh[1];" in header


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--legs", "2"], "--legs: only for code; wanted --as c as well"),
        (["--as", "c", "--drop"], "--drop: only for a record and for settings"),
        (["--as", "c", "--terrain", GROUND], "--terrain: the ground under a clip; wanted --trace"),
        (["--as", "c", "--trace", "none.npz"], "none.npz"),
        (["--as", "c", "--name", "check"], "name is 'check'; wanted small letters, digits and"),
        pytest.param(
            ["--as", "cs", "--name", "frame"],
            "name is 'frame'; wanted another one: code in C# has a Frame within",
            marks=pytest.mark.slow,
        ),
        (["--as", "js", "--axes", "unity"], "axes: only for C and C#"),
        (["--as", "c", "--name", "Walk!"], "name is 'Walk!'; wanted small letters, digits and"),
        (["--as", "c", "--trace", BASE, "--terrain", GROUND, "--legs", "3"], "--legs: a trace has"),
    ],
)
def test_mistakes_cost_a_line(words, message, tmp_path, parameters, capsys):
    line = refusal(["export", parameters, "-o", tmp_path / "code", *words], tmp_path, capsys)
    assert message in line
