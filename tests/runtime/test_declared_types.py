"""Values of files against the types that are declared for them, and versions of formats."""

import dataclasses
import json
from collections.abc import Mapping
from typing import Annotated, Any, Literal, NotRequired, TypedDict

import pytest

from fitting.runtime.storage.declared_types import Finite, between, checked, length
from fitting.runtime.storage.json_files import JsonFile


@dataclasses.dataclass(frozen=True)
class Size:
    height: float
    names: Mapping[str, float]


class Row(TypedDict):
    name: str
    u: Annotated[float, between(-40.0, 40.0)]
    interval: Annotated[list[Finite], length(2)]
    kind: Literal["smooth", "threshold"]
    steps: int
    determined: bool
    note: NotRequired[str | None]
    size: NotRequired[Annotated[dict[str, Any], Size]]


class Table(TypedDict):
    rows: list[Row]


ROW = {"name": "x", "u": 1, "interval": [0.0, 2], "kind": "smooth", "steps": 3}
ROW["determined"] = True
FILE = JsonFile(Table, "a table", "make it anew", version=2, essential={"rows", "name"})


def test_what_is_declared_is_accepted_and_whole_numbers_become_floats():
    size = {"height": 2, "names": {"a": 1}}
    row = {**ROW, "note": None, "size": size, "from a later release": 3}
    accepted = checked({"rows": [row]}, Table)
    assert accepted == {"rows": [row]}
    (read,) = accepted["rows"]
    numbers = [read["u"], *read["interval"], read["size"]["height"], read["size"]["names"]["a"]]
    assert all(type(number) is float for number in numbers) and type(read["steps"]) is int


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"name": 3}, r"rows\[0\].name is 3; wanted a text"),
        ({"u": "1"}, r"rows\[0\].u is '1'; wanted a number"),
        ({"u": True}, "u is True; wanted a number"),
        ({"u": 1e9}, "u is 1000000000.0; wanted a number from -40 to 40"),
        ({"u": float("nan")}, "u is nan; wanted a number from -40 to 40"),
        ({"u": 10**400}, "wanted a number"),
        ({"u": None}, "u is None; wanted a number"),
        ({"interval": [1.0]}, r"interval is \[1.0\]; wanted a list of 2"),
        ({"interval": [1.0, float("inf")]}, r"interval\[1\] is inf; wanted a finite number"),
        ({"interval": {}}, "interval is {}; wanted a list"),
        ({"kind": "other"}, "kind is 'other'; wanted one of"),
        ({"kind": ["smooth"]}, "kind is .* wanted one of"),
        ({"steps": 3.5}, "steps is 3.5; wanted a whole number"),
        ({"steps": True}, "steps is True; wanted a whole number"),
        ({"determined": 1}, "determined is 1; wanted true or false"),
        ({"note": 3}, "note is 3; wanted a text"),
        ({"size": []}, r"size is \[\]; wanted a table"),
        ({"size": {"height": 1.0}}, "size has no names"),
        ({"size": {"height": 1.0, "names": {}, "more": 1}}, "size has an unknown more"),
        ({"size": {"height": 1.0, "names": {"a": "b"}}}, "size.names.a is 'b'; wanted a number"),
    ],
)
def test_anything_else_is_refused_with_its_place(change, message):
    with pytest.raises(ValueError, match=message):
        checked({"rows": [{**ROW, **change}]}, Table)


def test_a_file_is_read_as_it_was_written_and_says_its_version(tmp_path):
    FILE.write(tmp_path / "a.json", {"rows": [ROW]})
    assert json.loads((tmp_path / "a.json").read_text()) == {"format": 2, "rows": [ROW]}
    assert FILE.read(tmp_path / "a.json") == {"rows": [ROW]}


def test_a_file_of_a_release_without_versions_may_lack_what_is_not_essential(tmp_path):
    path = tmp_path / "a.json"
    path.write_text('{"rows": [{"name": "x", "u": 3}]}')
    assert FILE.read(path) == {"rows": [{"name": "x", "u": 3.0}]}
    path.write_text('{"format": 1, "rows": [{"name": "x", "u": 3}]}')
    with pytest.raises(ValueError, match=r"a table: rows\[0\] has no determined, .*; make it anew"):
        FILE.read(path)


@pytest.mark.parametrize("version", [3, -1, 1.5, "2", None, True, [2]])
def test_an_unknown_version_is_refused_with_those_that_are_known(tmp_path, version):
    path = tmp_path / "a.json"
    path.write_text(json.dumps({"format": version, "rows": []}))
    with pytest.raises(ValueError, match=r"a\.json: its format is .*; this release reads .* to 2"):
        FILE.read(path)


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[" * 10**5, b"\xff\xfe\x00", b"[]", b"3", b"null"]
)
def test_what_is_no_such_file_is_refused_in_one_line(tmp_path, content):
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.json: not a table: .*; make it anew") as refusal:
        FILE.read(tmp_path / "a.json")
    assert "\n" not in str(refusal.value)


def test_a_folder_in_place_of_a_file_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"not a table: not JSON \(Is a directory\)"):
        FILE.read(tmp_path)
