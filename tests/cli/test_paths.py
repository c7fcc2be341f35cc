"""Every path that a command takes: what is not a file to read costs a line, and writes nothing."""

import os
import re
from collections.abc import Sequence
from pathlib import Path

import pytest

from fitting.cli import main
from support import experiments
from support.commands import commands
from support.sample_clips import BVH

DATA = experiments.ROOT / "data"
FILES = {
    "BASE": str(DATA / "clips" / "uneven_walk_base.npz"),
    "GROUND": str(DATA / "terrains" / "uneven_walk.ply"),
}
# The suffix of PATH is that of the files which are read or written there.
OF_FITS = ["fit", "ablate", "calibrate", "population", "fit-many"]
INPUTS = [f"{command} PATH.toml -o out" for command in OF_FITS]
INPUTS += [f"run PATH.{of} --terrain GROUND -o a.npz" for of in ("bvh", "npz", "glb", "gltf")]
INPUTS += [f"run BASE --terrain PATH.{of} -o a.npz" for of in ("ply", "npz", "npy")]
INPUTS += [f"record show PATH.{of}" for of in ("bin", "csv", "toml")]
INPUTS += [f"export PATH{of} -o a.toml" for of in ("", ".toml", ".json", ".csv", ".bin")]
INPUTS += """
init PATH.bvh --terrain GROUND -o out
init BASE --terrain PATH.ply -o out
init BASE --terrain GROUND --base PATH.npz -o out
sample PATH
apply PATH BASE --terrain GROUND -o a.npz
run walk.bvh --joints PATH.toml --terrain GROUND -o a.npz
run BASE --terrain GROUND --parameters PATH.toml -o a.npz
run BASE --terrain GROUND --tracks PATH.toml -o a.npz
view PATH
view PATH.bvh --terrain GROUND
view BASE --terrain GROUND --parameters PATH.toml
compare BASE --terrain GROUND --parameters PATH.toml -o out
compare --runs PATH,other -o out
translate --from PATH.toml --to record --clip BASE --terrain GROUND -o out
translate --from mec --to record --clip PATH.amc --terrain GROUND -o out
translate --from mec --to record --clip whole.amc --asf PATH.asf --terrain GROUND -o out
translate --from mec --to record --clip BASE --terrain GROUND --free PATH.toml -o out
inspect PATH.amc
inspect whole.amc --asf PATH.asf
inspect walk.bvh --joints PATH.toml
terrain PATH.bvh -o a.ply
terrain walk.bvh --joints PATH.toml -o a.ply
record to-toml PATH.bin -o a.toml
record to-bytes whole.toml --base PATH.bin -o a.bin
""".strip().splitlines()
OUTPUTS = [f"{command} walk.toml -o PATH" for command in OF_FITS]
OUTPUTS += """
init BASE --terrain GROUND -o PATH
run BASE --terrain GROUND -o PATH.npz
run BASE --terrain GROUND -o PATH.bvh
view BASE --terrain GROUND -o PATH
compare BASE --terrain GROUND --presets record -o PATH
translate --from mec --to record --clip BASE --terrain GROUND -o PATH
terrain BASE -o PATH.ply
record to-toml whole.bin -o PATH.toml
export whole.bin -o PATH.toml
export whole.bin --as mec -o PATH.csv
bench --quick --only legs --json PATH.json
parameters -o PATH.md
schema -o PATH.json
example uneven_walk -o PATH
""".strip().splitlines()
WAYS = (
    "missing", "folder", "null", "long", "binary", "empty", "pipe", "unreadable", "below a file",
)  # fmt: skip


def broken_path(way: str, suffix: str) -> str:
    """A path in this folder that is not a file of a kind that a command reads."""
    path = Path(f"broken{suffix}")
    match way:
        case "folder":
            path.mkdir(exist_ok=True)
        case "null":
            return f"bro\0ken{suffix}"
        case "long":
            return "x" * 300 + suffix
        case "binary":
            path.write_bytes(bytes(range(128, 228)))
        case "empty":
            path.touch()
        case "pipe" if not path.exists():
            os.mkfifo(path)
        case "unreadable" if not path.exists():
            path.write_text("x")
            path.chmod(0)
            if os.access(path, os.R_OK):
                pytest.skip("this user may read everything")
        case "below a file":
            path.write_text("x")
            return f"{path}/broken{suffix}"
    return str(path)


def check_refusals(lines: Sequence[str], way: str, capsys, *, named: bool = True) -> None:
    """Checks that each of these commands, with a broken path, prints one line and does nothing."""
    for line in lines:
        (place,) = re.findall(r"PATH[.a-z]*", line)
        path = broken_path(way, place.removeprefix("PATH"))
        before = sorted(Path().rglob("*"))
        words = [FILES.get(word, word.replace(place, path)) for word in line.split()]
        status = main.main(words)
        output = capsys.readouterr()
        case = f"{line}: {output}"
        assert (status, output.out, output.err.count("\n")) == (main.MISTAKE, "", 1), case
        assert output.err[:-1].isprintable(), case
        assert not named or "ken" in output.err or "x" * 300 in output.err, case
        assert not named or way != "missing" or "no such" in output.err, case
        assert sorted(Path().rglob("*")) == before, case


@pytest.mark.parametrize("way", WAYS)
def test_a_path_without_a_file_of_its_kind_costs_one_line(way, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("whole.toml").write_text('preset = "record"\nfaithful = true\n')
    Path("whole.amc").write_text(":FULLY-SPECIFIED\n:DEGREES\n1\nroot 0 0 0 0 0 0\n")
    Path("walk.bvh").write_text(BVH)
    lines = INPUTS
    if way == "empty":  # such a TOML file is a whole one, but no experiment
        lines = [line for line in INPUTS if "PATH.toml" not in line or line.split()[0] in OF_FITS]
    check_refusals(lines, way, capsys)


@pytest.mark.parametrize("way", ["null", "long", "below a file"])
def test_a_path_that_cannot_be_written_costs_one_line_before_anything_runs(
    way, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    Path("whole.bin").write_bytes(bytes(128))
    experiments.write(tmp_path, "walk.toml")
    check_refusals(OUTPUTS, way, capsys, named=False)


def test_every_command_that_takes_a_path_is_here():
    for command, parser in commands().items():
        if any(action.type is Path for action in parser._actions):
            assert any(line.startswith(f"{command} ") for line in [*INPUTS, *OUTPUTS]), command
