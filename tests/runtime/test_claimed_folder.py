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


def test_the_same_process_claims_a_folder_once(tmp_path):
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


def test_a_folder_that_was_there_stays(tmp_path):
    with claimed(tmp_path):
        pass
    assert tmp_path.is_dir()


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
