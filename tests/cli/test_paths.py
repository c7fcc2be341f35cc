"""Every path that a command takes: what is no file to read costs one line, and writes nothing."""

import argparse
import os
import stat
from pathlib import Path

import pytest

from fitting.cli import main
from fitting.cli.parser import make_parser
from support import experiments
from support.sample_clips import BVH

BASE = experiments.ROOT / "data" / "clips" / "uneven_walk_base.npz"
GROUND = experiments.ROOT / "data" / "terrains" / "uneven_walk.ply"
ANIMATION = [str(BASE), "--terrain", str(GROUND)]
FROM_TO = ["--from", "mec", "--to", "record"]
PLACES: dict[str, tuple[list[str], str]] = {  # words with a place for a path, and its suffix
    "init": (["init", "{}", "--terrain", str(GROUND), "-o", "out"], ".bvh"),
    "init --terrain": (["init", str(BASE), "--terrain", "{}", "-o", "out"], ".ply"),
    "init --base": (["init", *ANIMATION, "--base", "{}", "-o", "out"], ".npz"),
    "fit": (["fit", "{}", "-o", "out"], ".toml"),
    "ablate": (["ablate", "{}", "-o", "out"], ".toml"),
    "calibrate": (["calibrate", "{}", "-o", "out"], ".toml"),
    "population": (["population", "{}", "-o", "out"], ".toml"),
    "fit-many": (["fit-many", "{}", "-o", "out"], ".toml"),
    "sample": (["sample", "{}"], ""),
    "apply": (["apply", "{}", *ANIMATION, "-o", "a.npz"], ""),
    "run clip": (["run", "{}", "--terrain", str(GROUND), "-o", "a.npz"], ".bvh"),
    "run clip npz": (["run", "{}", "--terrain", str(GROUND), "-o", "a.npz"], ".npz"),
    "run clip glb": (["run", "{}", "--terrain", str(GROUND), "-o", "a.npz"], ".glb"),
    "run clip gltf": (["run", "{}", "--terrain", str(GROUND), "-o", "a.npz"], ".gltf"),
    "run --terrain": (["run", str(BASE), "--terrain", "{}", "-o", "a.npz"], ".ply"),
    "run --terrain npz": (["run", str(BASE), "--terrain", "{}", "-o", "a.npz"], ".npz"),
    "run --terrain npy": (["run", str(BASE), "--terrain", "{}", "-o", "a.npz"], ".npy"),
    "run --joints": (
        ["run", "walk.bvh", "--joints", "{}", "--terrain", str(GROUND), "-o", "a.npz"],
        ".toml",
    ),
    "inspect --joints": (["inspect", "walk.bvh", "--joints", "{}"], ".toml"),
    "terrain --joints": (["terrain", "walk.bvh", "--joints", "{}", "-o", "a.ply"], ".toml"),
    "translate --asf": (
        ["translate", *FROM_TO, "--clip", "whole.amc", "--asf", "{}", *ANIMATION[1:], "-o", "out"],
        ".asf",
    ),
    "run --parameters": (["run", *ANIMATION, "--parameters", "{}", "-o", "a.npz"], ".toml"),
    "run --tracks": (["run", *ANIMATION, "--tracks", "{}", "-o", "a.npz"], ".toml"),
    "view run": (["view", "{}"], ""),
    "view clip": (["view", "{}", "--terrain", str(GROUND)], ".bvh"),
    "view --parameters": (["view", *ANIMATION, "--parameters", "{}"], ".toml"),
    "compare --parameters": (["compare", *ANIMATION, "--parameters", "{}", "-o", "out"], ".toml"),
    "compare --runs": (["compare", "--runs", "{}", "-o", "out"], ""),
    "translate --from": (
        ["translate", "--from", "{}", *FROM_TO[2:], "--clip", *ANIMATION, "-o", "out"],
        ".toml",
    ),
    "translate --clip": (
        ["translate", *FROM_TO, "--clip", "{}", "--terrain", str(GROUND), "-o", "out"],
        ".amc",
    ),
    "translate --free": (
        ["translate", *FROM_TO, "--clip", *ANIMATION, "--free", "{}", "-o", "out"],
        ".toml",
    ),
    "inspect": (["inspect", "{}"], ".amc"),
    "inspect --asf": (["inspect", "whole.amc", "--asf", "{}"], ".asf"),
    "terrain": (["terrain", "{}", "-o", "a.ply"], ".bvh"),
    "record show": (["record", "show", "{}"], ".bin"),
    "record show csv": (["record", "show", "{}"], ".csv"),
    "record show toml": (["record", "show", "{}"], ".toml"),
    "record to-toml": (["record", "to-toml", "{}", "-o", "a.toml"], ".bin"),
    **{
        f"export {suffix}": (["export", "{}", "-o", "a.toml"], suffix)
        for suffix in (".toml", ".json", ".csv", ".bin", "")
    },
    "record to-bytes --base": (
        ["record", "to-bytes", "whole.toml", "--base", "{}", "-o", "a.bin"],
        ".bin",
    ),
}
WAYS = (
    "missing",
    "folder",
    "null",
    "long",
    "binary",
    "empty",
    "pipe",
    "unreadable",
    "below a file",
)


def broken_path(way: str, suffix: str) -> str:
    """A path in this folder that is no file of a kind that a command reads."""
    path = Path(f"broken{suffix}")
    match way:
        case "folder":
            path.mkdir()
        case "null":
            return f"bro\0ken{suffix}"
        case "long":
            return "x" * 300 + suffix
        case "binary":
            path.write_bytes(bytes(range(128, 228)))
        case "empty":
            path.touch()
        case "pipe":
            os.mkfifo(path)
        case "unreadable":
            path.write_text("x")
            path.chmod(0)
            if os.access(path, os.R_OK):
                pytest.skip("this user may read everything")
        case "below a file":
            path.write_text("x")
            return f"{path}/broken{suffix}"
    return str(path)


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("way", WAYS)
def test_a_path_without_a_file_of_its_kind_costs_one_line(
    place, way, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    Path("whole.toml").write_text('preset = "record"\nfaithful = true\n')
    Path("whole.amc").write_text(":FULLY-SPECIFIED\n:DEGREES\n1\nroot 0 0 0 0 0 0\n")
    Path("walk.bvh").write_text(BVH)
    words, suffix = PLACES[place]
    if (
        way == "empty"
        and suffix == ".toml"
        and place
        not in (
            "fit",
            "ablate",
            "calibrate",
            "fit-many",
        )
    ):
        pytest.skip("an empty TOML file is a whole one")
    path = broken_path(way, suffix)
    before = sorted(Path().rglob("*"))
    assert main.main([path if word == "{}" else word for word in words]) == main.MISTAKE
    output = capsys.readouterr()
    assert output.out == "" and output.err.count("\n") == 1 and output.err[:-1].isprintable()
    assert "ken" in output.err or "x" * 300 in output.err
    assert sorted(Path().rglob("*")) == before


OUTPUTS: dict[str, tuple[list[str], str]] = {
    "init": (["init", *ANIMATION, "-o", "{}"], ""),
    "fit": (["fit", "{experiment}", "-o", "{}"], ""),
    "run": (["run", *ANIMATION, "-o", "{}"], ".npz"),
    "run bvh": (["run", *ANIMATION, "-o", "{}"], ".bvh"),
    "view": (["view", *ANIMATION, "-o", "{}"], ""),
    "compare": (["compare", *ANIMATION, "--presets", "record", "-o", "{}"], ""),
    "translate": (["translate", *FROM_TO, "--clip", *ANIMATION, "-o", "{}"], ""),
    "terrain": (["terrain", str(BASE), "-o", "{}"], ".ply"),
    "record to-toml": (["record", "to-toml", "whole.bin", "-o", "{}"], ".toml"),
    "export": (["export", "whole.bin", "-o", "{}"], ".toml"),
    "export --as": (["export", "whole.bin", "--as", "mec", "-o", "{}"], ".csv"),
    "bench --json": (["bench", "--quick", "--only", "legs", "--json", "{}"], ".json"),
    "ablate": (["ablate", "{experiment}", "-o", "{}"], ""),
    "calibrate": (["calibrate", "{experiment}", "-o", "{}"], ""),
    "population": (["population", "{experiment}", "-o", "{}"], ""),
    "fit-many": (["fit-many", "{experiment}", "-o", "{}"], ""),
    "parameters": (["parameters", "-o", "{}"], ".md"),
    "schema": (["schema", "-o", "{}"], ".json"),
    "example": (["example", "uneven_walk", "-o", "{}"], ""),
}


@pytest.mark.parametrize("place", OUTPUTS)
@pytest.mark.parametrize("way", ["null", "long", "below a file"])
def test_a_path_that_cannot_be_written_costs_one_line_before_anything_runs(
    place, way, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    Path("whole.bin").write_bytes(bytes(128))
    experiment = experiments.write(tmp_path)
    words, suffix = OUTPUTS[place]
    path = broken_path(way, suffix)
    before = sorted(Path().rglob("*"))
    filled = [word.replace("{experiment}", str(experiment)).replace("{}", path) for word in words]
    assert main.main(filled) == main.MISTAKE
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and error[:-1].isprintable()
    assert sorted(Path().rglob("*")) == before


def paths_of(parser: argparse.ArgumentParser, command: str = "") -> set[str]:
    """The commands that take a path."""
    commands = set()
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, child in action.choices.items():
                commands |= paths_of(child, f"{command} {name}".strip())
        elif action.type is Path:
            commands.add(command)
    return commands


def test_every_command_that_takes_a_path_is_here():
    listed = {*PLACES, *OUTPUTS}
    for command in paths_of(make_parser()):
        assert any(place.startswith(command) for place in listed), command


def test_the_broken_paths_are_what_they_should_be(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert stat.S_ISFIFO(Path(broken_path("pipe", ".toml")).stat().st_mode)
    with pytest.raises(OSError, match="too long"):
        Path(broken_path("long", ".toml")).read_bytes()
