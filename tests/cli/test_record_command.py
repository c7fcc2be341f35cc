"""The command `jaxik record`: shows the game's record, and converts it without losing a byte."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

from fitting.cli import main
from jaxik import record
from support.commands import refusal
from support.records import ADULT, packed


def record_command(*words: object) -> int:
    return main.main(["record", *map(str, words)])


@pytest.fixture
def binary(tmp_path) -> Path:
    content = dataclasses.replace(
        packed(cosineMaxKneeAngle=-0.987654), knee_axis_type=4, flags=0b10101_101,
        padding=b"\x12\x34", tail=b"tail",
    )  # fmt: skip
    path = tmp_path / "footik.bin"
    path.write_bytes(record.to_bytes(content))
    return path


@pytest.mark.filterwarnings("default")
def test_a_record_goes_to_toml_and_back_to_the_byte_where_it_is_the_base(binary, capsys):
    toml, back = binary.with_suffix(".toml"), binary.with_name("back.bin")
    for more in (["--knee", "flexion", "--lean-sign", "-1", "--tick-hz", "60"], []):
        assert record_command("to-toml", binary, "-o", toml, *more) == 0
        assert capsys.readouterr().err == (
            "jaxik: kneeAxisType 4 (-Y), padding (bits 0x15, bytes 1234), a tail of 4 bytes: no "
            f"parameters, so not in {toml}; `record to-bytes` takes them from --base {binary}\n"
        )
        assert record_command("to-bytes", toml, "--base", binary, "-o", back, *more) == 0
        assert capsys.readouterr().err == ""
        assert back.read_bytes() == binary.read_bytes()
    assert record_command("to-bytes", toml, "-o", back) == 0
    assert capsys.readouterr().err == (
        "jaxik: parameters do not tell the knee's axis: kneeAxisType 2 (+Z), zero padding and no "
        "tail are written, as no base record was given\n"
    )
    expected = bytearray(binary.read_bytes())[: record.SIZE]
    expected[0], expected[1], expected[2:4] = 2, expected[1] & 0b111, b"\0\0"
    written = back.read_bytes()
    floats = np.frombuffer(written[4:], "<f4"), np.frombuffer(bytes(expected[4:]), "<f4")
    assert written[:4] == expected[:4]
    np.testing.assert_allclose(*floats, rtol=1e-5)


@pytest.mark.filterwarnings("default")
def test_parameters_without_a_slot_in_the_record_are_named_when_written(binary, capsys):
    toml, back = binary.with_suffix(".toml"), binary.with_name("back.bin")
    toml.write_text(
        "faithful = true\n[target]\nrise_half_life = 0.1\n"
        "[lock]\nmax_speed = 0.9\nrelease_cone = 0.3\n"
    )
    words = ["to-bytes", toml, "--base", binary, "-o", back]
    lost = (
        "the record cannot hold target.rise_half_life = 0.1 s (0 s), lock.max_speed = 0.9 m/s "
        "(inf m/s); its reader takes the values in brackets"
    )
    assert record_command(*words) == main.MISTAKE
    assert capsys.readouterr().err.startswith(f"jaxik record: {toml}: {lost}. To leave them out")
    assert not back.exists()
    assert record_command(*words, "--drop") == 0
    assert capsys.readouterr().err == f"jaxik: {lost}\n"
    assert back.stat().st_size == record.SIZE + len(b"tail")


@pytest.mark.filterwarnings("default")
def test_show_prints_both_names_and_units_and_a_csv_which_is_the_same_to_the_byte(binary, capsys):
    assert record_command("show", binary) == 0
    text = capsys.readouterr().out
    assert re.search(r"kneeAxisType +4 \(-Y\)", text)
    assert re.search(r"useFootEndRay +off +probe.use_toe", text)
    assert re.search(r"lockedDisableMaxAngle +172 +lock.release_max_angle = 3.00197 rad", text)
    assert all(name in text for name in ADULT)
    path = binary.with_name("cm.bin")
    content = packed(raycastDistanceUp=50.0, raycastDistanceDown=80.0)
    path.write_bytes(record.to_bytes(content))
    assert record_command("show", path) == 0
    output = capsys.readouterr()
    assert "jaxik: raycastDistanceUp = 50.0 is read as centimetres\n" in output.err
    assert re.search(r"raycastDistanceUp +50 +probe.ray_up = 0.5 m", output.out)
    assert record_command("show", binary, "--csv") == 0
    path, back = binary.with_suffix(".csv"), binary.with_name("back.bin")
    path.write_text(capsys.readouterr().out)
    assert record_command("to-bytes", path, "-o", back) == 0
    assert back.read_bytes() == binary.read_bytes()


def test_a_wrong_record_is_reported_and_writes_nothing(binary, capsys, monkeypatch):
    monkeypatch.chdir(binary.parent)
    rows = record.to_csv([packed(), packed()])
    for name, text in {
        "bad.csv": "a,b\n1,2\n",
        "none.csv": rows.splitlines()[0] + "\n",
        "two.csv": rows,
        "bad.toml": "[lok]\nx = 1",
        "one.toml": "faithful = true\nlock.enabled = false",
        "new.toml": "lock.enabled = false",
        "ozz.toml": 'preset = "ozz"\n',
    }.items():
        Path(name).write_text(text)
    Path("nan.bin").write_bytes(record.to_bytes(packed(originalGroundHeightMS=np.nan)))
    wrong_axis = dataclasses.replace(packed(), knee_axis_type=9)
    Path("axis.bin").write_bytes(record.to_bytes(wrong_axis))
    Path("short.bin").write_bytes(b"abc")
    Path("binary.csv").write_bytes(b"\xff\xfe")
    for line, message in (
        ("show short.bin", "short.bin: a foot-IK record has at least 128 bytes; these are 3"),
        ("show bad.csv", "bad.csv: the CSV has no column"),
        ("show binary.csv", "binary.csv: 'utf-8' codec can't decode"),
        ("show none.csv", "none.csv: the CSV has no row"),
        ("show bad.toml", "bad.toml: unknown key 'lok'; nearest is 'lock'"),
        ("show nan.bin", "nan.bin: originalGroundHeightMS is nan"),
        ("show axis.bin", "axis.bin: kneeAxisType is 9"),
        ("to-toml nan.bin -o a.toml", "nan.bin: originalGroundHeightMS is nan"),
        ("to-toml two.csv -o a.toml", "two.csv has 2 rows"),
        ("to-bytes one.toml --base footik.bin -o .", "cannot be written: it is a"),
        ("to-bytes new.toml -o a.bin", "only those of 'record' with faithful = true"),
        ("to-bytes ozz.toml -o a.bin", "parameters of 'ozz'; only those of 'record' make one"),
        ("to-bytes two.csv --base footik.bin -o a.bin", "a base completes"),
    ):
        assert message in refusal(["record", *line.split()], Path(), capsys)
