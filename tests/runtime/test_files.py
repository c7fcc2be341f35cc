"""Files are written whole and read as declared; folders are filled by one process at a time."""

import dataclasses
import json
import os
import signal
import stat
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NotRequired, TypedDict
from unittest.mock import Mock

import pytest

from fitting.runtime import claimed_folder, files
from fitting.runtime.claimed_folder import LOCK, claimed
from fitting.runtime.declarations import number
from fitting.runtime.json_files import Finite, JsonFile, checked, length


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_file_replaces_the_one_before_and_a_failure_leaves_that_and_nothing_else(tmp_path, error):
    path = tmp_path / "clip.npz"
    mask = os.umask(0o027)
    for text in ("first", "half-life 0.2 s, π"):
        files.write_text(path, text)
        assert path.read_text(encoding="utf-8") == text
    os.umask(mask)
    assert stat.S_IMODE(path.stat().st_mode) == 0o640, "the permissions of any new file"

    def fill(temporary):
        temporary.write_text("ha")
        assert temporary.parent == tmp_path and temporary.suffix == ".npz"
        raise error

    with pytest.raises(error):
        files.write(path, fill)
    assert path.read_text(encoding="utf-8") == text and names(tmp_path) == ["clip.npz"]


def test_what_a_link_leads_to_is_written_and_the_link_stays(tmp_path):
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    for link, target in (("a.txt", folder / "b.dat"), ("b.txt", Path("a.txt"))):  # the last by both
        (tmp_path / link).symlink_to(target)
        for text in ("first", "second"):
            files.write_text(tmp_path / link, text)
            assert (tmp_path / link).is_symlink() and names(folder) == ["b.dat"]
            assert (folder / "b.dat").read_text() == text
    suffixes: list[str] = []
    files.write(tmp_path / "a.txt", lambda temporary: suffixes.append(temporary.suffix))
    assert suffixes == [".txt"], "by which writers know the format"
    (tmp_path / "astray").symlink_to(tmp_path / "no" / "a.txt")
    with pytest.raises(ValueError, match="astray: cannot be written: there is no folder .*no"):
        files.check_output_file(tmp_path / "astray")
    with pytest.raises(ValueError, match="null: cannot be written: it is not a regular file"):
        files.write_text(Path(os.devnull), "text")


def test_a_path_that_cannot_be_written_is_refused_before_anything_is_computed(
    tmp_path, monkeypatch
):
    (tmp_path / "run").mkdir()
    fill = Mock(side_effect=AssertionError("called"))
    with pytest.raises(ValueError, match="run: cannot be written: it is a folder"):
        files.write(tmp_path / "run", fill)
    with pytest.raises(ValueError, match=r"a\.npz: cannot be written: there is no folder .*no"):
        files.write(tmp_path / "no" / "a.npz", fill)
    refuse = Mock(side_effect=PermissionError(13, "Permission denied"))
    monkeypatch.setattr(files.tempfile, "mkstemp", refuse)
    with pytest.raises(ValueError, match=r"a\.txt: cannot be written: Permission denied"):
        files.write(tmp_path / "a.txt", fill)
    assert names(tmp_path) == ["run"]


def test_the_content_is_on_the_disk_before_the_name_and_the_name_before_the_return(
    tmp_path, monkeypatch
):
    calls = []

    def record(name):
        call = getattr(os, name)
        monkeypatch.setattr(os, name, lambda *words: (calls.append(name), call(*words))[1])

    record("fsync")
    record("replace")
    files.write_text(tmp_path / "a.txt", "x")
    assert calls == ["fsync", "replace", "fsync"]


# What killed processes leave

WRITE = """
import os, signal, sys
from pathlib import Path
from fitting.runtime import files

def fill(path):
    path.write_text("half")
    print(path.name, flush=True)
    if sys.argv[2] == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    sys.stdin.read()

files.write(Path(sys.argv[1]), fill)
"""


def writer(path, end):
    words = [sys.executable, "-c", WRITE, str(path), end]
    return subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def test_what_a_killed_process_was_writing_goes_with_the_next_file(tmp_path):
    killed, alive = writer(tmp_path / "knees.png", "die"), writer(tmp_path / "locks.png", "live")
    with killed, alive:
        assert killed.stdout is not None and alive.stdout is not None
        half, growing = killed.stdout.readline().strip(), alive.stdout.readline().strip()
        assert killed.wait() == -signal.SIGKILL
        others = [".knees.png", ".knees.jaxik-elsewhere-1-abc.png", ".knees3kd82hf0.png"]
        for name in others:
            (tmp_path / name).write_text("x")
        assert half.endswith(".png") and names(tmp_path) == sorted([half, growing, *others])
        files.write_text(tmp_path / "fit.json", "{}")
        assert names(tmp_path) == sorted([growing, "fit.json", *others])
        alive.communicate("")
        assert names(tmp_path) == sorted(["locks.png", "fit.json", *others])


def test_what_0_1_0_was_writing_goes_when_the_same_file_is_written_again(tmp_path):
    old = ".knees3kd82hf0.png"  # tempfile.mkstemp(prefix=f".{path.stem}", suffix=path.suffix)
    recent, readable = ".knees_a8dk20f.png", ".knees9ab2cd3e.png"
    longer, capital = ".knees3kd82hf01.png", ".kneesBACKUP_1.png"
    others = [recent, readable, longer, capital, ".locks3kd82hf0.png", ".knees3kd82hf0.txt"]
    for name in (old, *others):
        path = tmp_path / name
        path.write_text("half")
        path.chmod(0o644 if name == readable else 0o600)
        if name != recent:
            os.utime(path, (0, 0))
    files.write_text(tmp_path / "fit.json", "{}")
    assert names(tmp_path) == sorted([old, "fit.json", *others])
    files.write_text(tmp_path / "knees.png", "whole")
    assert names(tmp_path) == sorted(["fit.json", "knees.png", *others])


# Folders that are claimed

HOLD = """
import sys, time
from pathlib import Path
from fitting.runtime.claimed_folder import claimed

with claimed(Path(sys.argv[1])):
    print("claimed", flush=True)
    time.sleep(60)
"""


def test_a_second_process_is_told_who_is_at_work_and_a_kill_ends_it(tmp_path):
    folder = tmp_path / "run"
    words = [sys.executable, "-c", HOLD, str(folder)]
    with subprocess.Popen(words, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline() == b"claimed\n"
        with pytest.raises(ValueError, match="in use by process") as refusal, claimed(folder):
            pass
        os.kill(process.pid, signal.SIGKILL)
    message = str(refusal.value)
    assert message.startswith(f"{folder}: in use by process {process.pid} on ")
    assert f"`-c {folder}`" in message and "since 20" in message
    assert message.endswith("wait until it has ended, or name another folder")
    assert (folder / LOCK).exists()
    with claimed(folder):
        pass
    assert not (folder / LOCK).exists()


def test_the_same_process_claims_a_folder_once_and_leaves_nothing_that_it_made_empty(tmp_path):
    for _ in range(2):
        with claimed(tmp_path), pytest.raises(ValueError, match=f"process {os.getpid()}"):
            with claimed(tmp_path):
                pass
        assert not list(tmp_path.iterdir())
    for error in (ValueError, KeyboardInterrupt):
        with pytest.raises(error), claimed(tmp_path / "a" / "b"):
            raise error
        assert not list(tmp_path.iterdir())
    with claimed(tmp_path / "a" / "b"):
        (tmp_path / "a" / "c").write_text("x")
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["c"]


class Windows:
    """What Python's msvcrt does to a byte of a file."""

    LK_NBLCK = 2

    def __init__(self):
        self.locked: set[tuple[int, int]] = set()  # the file, and the place of the byte

    def locking(self, handle: int, mode: int, count: int) -> None:
        assert (mode, count) == (self.LK_NBLCK, 1)
        byte = (os.fstat(handle).st_ino, os.lseek(handle, 0, os.SEEK_CUR))
        if byte in self.locked:
            raise PermissionError(13, "Permission denied")
        self.locked.add(byte)


def test_windows_locks_a_byte_beyond_the_text_that_others_read(tmp_path, monkeypatch):
    windows = Windows()
    monkeypatch.setitem(sys.modules, "msvcrt", windows)  # type: ignore[arg-type]
    monkeypatch.setattr(sys, "platform", "win32")
    for _ in range(2):
        with claimed(tmp_path):
            ((_, place),) = windows.locked
            assert place > claimed_folder.LONGEST_COMMAND + 1000
            with pytest.raises(ValueError, match=f"in use by process {os.getpid()} on "):
                with claimed(tmp_path):
                    pass
            assert (tmp_path / LOCK).is_file()
        assert not list(tmp_path.iterdir())
        windows.locked.clear()  # as its file is closed


def test_a_lock_file_with_anything_in_it_is_nobodys_and_one_that_cannot_be_locked_is_said(
    tmp_path, monkeypatch
):
    (tmp_path / LOCK).write_bytes(bytes(range(256)))
    with claimed(tmp_path):
        assert f"process {os.getpid()}" in (tmp_path / LOCK).read_text()
    refuse = Mock(side_effect=OSError(95, "Operation not supported"))
    monkeypatch.setattr(claimed_folder, "_lock", refuse)
    with pytest.warns(RuntimeWarning, match="nothing keeps another process out of it: Operation"):
        with claimed(tmp_path):
            pass


# Values of files against the types that are declared for them


@dataclasses.dataclass(frozen=True)
class Size:
    height: float
    names: Mapping[str, float]


class Row(TypedDict):
    name: str
    u: Annotated[float, number(-40.0, 40.0)]
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


def test_anything_else_is_refused_with_its_place():
    for change, message in (
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
    ):
        with pytest.raises(ValueError, match=message):
            checked({"rows": [{**ROW, **change}]}, Table)


def test_a_file_is_read_as_it_was_written_and_says_its_version(tmp_path):
    path = tmp_path / "a.json"
    FILE.write(path, {"rows": [ROW]})
    assert json.loads(path.read_text()) == {"format": 2, "rows": [ROW]}
    assert FILE.read(path) == {"rows": [ROW]}
    # That of a release without versions may lack what is not essential.
    path.write_text('{"rows": [{"name": "x", "u": 3}]}')
    assert FILE.read(path) == {"rows": [{"name": "x", "u": 3.0}]}
    path.write_text('{"format": 1, "rows": [{"name": "x", "u": 3}]}')
    with pytest.raises(ValueError, match=r"a table: rows\[0\] has no determined, .*; make it anew"):
        FILE.read(path)


def test_an_unknown_version_and_what_is_no_such_file_are_refused_in_one_line(tmp_path):
    path = tmp_path / "a.json"
    for version in (3, -1, 1.5, "2", None, True, [2]):
        path.write_text(json.dumps({"format": version, "rows": []}))
        with pytest.raises(ValueError, match=r"a\.json: its format is .*; this release .* to 2"):
            FILE.read(path)
    for content in (b"", b"{", b"[" * 10**5, b"\xff\xfe\x00", b"[]", b"3", b"null"):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"a\.json: not a table: .*; make it anew") as refusal:
            FILE.read(path)
        assert "\n" not in str(refusal.value)
    with pytest.raises(ValueError, match=r"not a table: not JSON \(Is a directory\)"):
        FILE.read(tmp_path)
