"""A folder that one process fills while others keep out."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from fitting.runtime.storage import claimed_folder
from fitting.runtime.storage.claimed_folder import LOCK, claimed

HOLD = """
import sys, time
from pathlib import Path
from fitting.runtime.storage.claimed_folder import claimed

with claimed(Path(sys.argv[1])):
    print("claimed", flush=True)
    time.sleep(60)
"""


@contextmanager
def holder(folder: Path) -> Iterator[subprocess.Popen]:
    """Another process that holds the folder."""
    words = [sys.executable, "-c", HOLD, str(folder)]
    with subprocess.Popen(words, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline() == b"claimed\n"
        try:
            yield process
        finally:
            process.kill()


def test_a_second_process_is_told_who_is_at_work_and_a_kill_ends_it(tmp_path):
    folder = tmp_path / "run"
    with holder(folder) as process:
        with pytest.raises(ValueError, match="in use by process") as refusal, claimed(folder):
            pass
        message = str(refusal.value)
        assert message.startswith(f"{folder}: in use by process {process.pid} on ")
        assert f"`-c {folder}`" in message and "since 20" in message
        assert message.endswith("wait until it has ended, or name another folder")
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    assert (folder / LOCK).exists()
    with claimed(folder):
        pass
    assert not (folder / LOCK).exists()


def test_the_same_process_claims_a_folder_once_and_leaves_it_empty(tmp_path):
    with claimed(tmp_path), pytest.raises(ValueError, match=f"process {os.getpid()}"):
        with claimed(tmp_path):
            pass
    with claimed(tmp_path):
        pass
    assert not list(tmp_path.iterdir())


def test_folders_that_were_made_and_are_empty_are_removed(tmp_path):
    for error in (ValueError, KeyboardInterrupt):
        with pytest.raises(error), claimed(tmp_path / "a" / "b"):
            raise error
        assert not list(tmp_path.iterdir())
    with claimed(tmp_path / "a" / "b"):
        (tmp_path / "a" / "c").write_text("x")
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["c"]


class Windows:
    """What Python's msvcrt does to a byte of a file that is locked, until its owner closes it."""

    LK_NBLCK = 2

    def __init__(self):
        self.owners: dict[int, tuple[int, int]] = {}
        """Handle: the file, and the place of the byte."""

    def locking(self, handle: int, mode: int, count: int) -> None:
        assert (mode, count) == (self.LK_NBLCK, 1)
        byte = (os.fstat(handle).st_ino, os.lseek(handle, 0, os.SEEK_CUR))
        owners = [owner for owner, owned in self.owners.items() if owned == byte]
        if any(owner != handle and self.is_open(owner, byte[0]) for owner in owners):
            raise PermissionError(13, "Permission denied")
        self.owners[handle] = byte

    def is_open(self, handle: int, file: int) -> bool:
        try:
            return os.fstat(handle).st_ino == file
        except OSError:
            return False


def test_windows_locks_a_byte_beyond_the_text_that_others_read(tmp_path, monkeypatch):
    windows = Windows()
    monkeypatch.setitem(sys.modules, "msvcrt", windows)  # type: ignore[arg-type]
    monkeypatch.setattr(sys, "platform", "win32")
    for _ in range(2):
        with claimed(tmp_path):
            ((_, place),) = windows.owners.values()
            assert place > claimed_folder.LONGEST_COMMAND + 1000
            with pytest.raises(ValueError, match=f"in use by process {os.getpid()} on "):
                with claimed(tmp_path):
                    pass
            assert (tmp_path / LOCK).is_file()
        assert not list(tmp_path.iterdir())
        windows.owners.clear()


def test_a_lock_file_with_anything_in_it_is_nobodys(tmp_path):
    (tmp_path / LOCK).write_bytes(bytes(range(256)))
    with claimed(tmp_path):
        assert f"process {os.getpid()}" in (tmp_path / LOCK).read_text()


def test_a_file_system_without_locks_is_said(tmp_path, monkeypatch):
    def refuse(file):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(claimed_folder, "_lock", refuse)
    with pytest.warns(RuntimeWarning, match="nothing keeps another process out of it: Operation"):
        with claimed(tmp_path):
            pass
