"""Files are written completely or not at all."""

import os
import signal
import stat
import subprocess
import sys

import pytest

from fitting.runtime import files


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_text_replaces_the_one_before(tmp_path):
    path = tmp_path / "notes.md"
    files.write_text(path, "first")
    files.write_text(path, "half-life 0.2 s, π")
    assert path.read_text(encoding="utf-8") == "half-life 0.2 s, π"
    assert names(tmp_path) == ["notes.md"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_failure_while_writing_leaves_the_old_file_and_nothing_else(tmp_path, error):
    path = tmp_path / "clip.npz"
    files.write_text(path, "intact")

    def fill(temporary):
        temporary.write_text("ha")
        assert temporary.parent == tmp_path and temporary.suffix == ".npz"
        raise error

    with pytest.raises(error):
        files.write(path, fill)
    assert path.read_text() == "intact" and names(tmp_path) == ["clip.npz"]


def test_a_file_has_the_permissions_of_any_new_file(tmp_path):
    mask = os.umask(0o027)
    try:
        files.write_text(tmp_path / "shared.txt", "x")
    finally:
        os.umask(mask)
    assert stat.S_IMODE((tmp_path / "shared.txt").stat().st_mode) == 0o640


def test_an_impossible_path_is_rejected_before_anything_is_computed(tmp_path):
    (tmp_path / "run").mkdir()

    def fill(path):
        raise AssertionError("called")

    with pytest.raises(ValueError, match="run: cannot be written: it is a folder"):
        files.write(tmp_path / "run", fill)
    with pytest.raises(ValueError, match=r"a\.npz: cannot be written: there is no folder .*no"):
        files.write(tmp_path / "no" / "a.npz", fill)
    assert names(tmp_path) == ["run"]


def test_an_error_of_the_system_is_reported_with_the_file(tmp_path, monkeypatch):
    def refuse(**_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(files.tempfile, "mkstemp", refuse)
    with pytest.raises(ValueError, match=r"a\.txt: cannot be written: Permission denied"):
        files.write_text(tmp_path / "a.txt", "x")


def test_the_content_is_on_the_disk_before_the_name_and_the_name_before_the_return(
    tmp_path, monkeypatch
):
    calls = []

    def record(name):
        call = getattr(os, name)
        monkeypatch.setattr(os, name, lambda *words: (calls.append(name), call(*words))[1])

    for name in ("fsync", "replace"):
        record(name)
    files.write_text(tmp_path / "a.txt", "x")
    assert calls == ["fsync", "replace", "fsync"]


# What killed processes leave

KILLED_WHILE_WRITING = """
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
    words = [sys.executable, "-c", KILLED_WHILE_WRITING, str(path), end]
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
    others = {
        "recent": ".knees_a8dk20f.png",
        "readable": ".knees9ab2cd3e.png",
        "longer": ".knees3kd82hf01.png",
        "capital": ".kneesBACKUP_1.png",
        "another's": ".locks3kd82hf0.png",
        "text": ".knees3kd82hf0.txt",
    }
    for name in (old, *others.values()):
        path = tmp_path / name
        path.write_text("half")
        path.chmod(0o644 if name == others["readable"] else 0o600)
        if name != others["recent"]:
            os.utime(path, (0, 0))
    files.write_text(tmp_path / "fit.json", "{}")
    assert names(tmp_path) == sorted([old, "fit.json", *others.values()])
    files.write_text(tmp_path / "knees.png", "whole")
    assert names(tmp_path) == sorted(["fit.json", "knees.png", *others.values()])
