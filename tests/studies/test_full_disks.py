"""A disk without room: one sentence names the file, and what was whole stays so."""

import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest

from fitting.cli import main
from fitting.experiments import problems
from fitting.inference.sampling.chain import Chain
from fitting.inference.sampling.chain_file import Identity
from fitting.runtime import files
from support import quick
from support.experiments import CLIP, write

FULL = "cannot be written: No space left on device"
STATE: Any = np.random.RandomState(0).get_state()
IDENTITY = Identity(("a", "b"), walkers=8, seed=0, thin_by=1, problem="x" * 64)


@pytest.fixture
def disk(tmp_path) -> Iterator[Path]:
    """A file system of 64 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(folder)]
    try:
        mounted = subprocess.run(words, capture_output=True).returncode == 0
    except FileNotFoundError:
        mounted = False
    if not mounted:
        pytest.skip("only root may mount a disk")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_file_without_room_is_named_and_the_old_one_stays(disk):
    figure, axes = plt.subplots()
    axes.imshow(np.random.default_rng(0).random((300, 300)))
    fills = {
        "notes.txt": lambda path: path.write_text("x" * 100_000),
        "clip.npz": lambda path: np.savez(path, a=np.zeros(20_000)),
        "plot.png": lambda path: figure.savefig(path, dpi=200),
    }
    for name, fill in fills.items():
        files.write_text(disk / name, "old")
        with pytest.raises(ValueError, match=f"{name}: {FULL}"):
            files.write(disk / name, fill)
        assert (disk / name).read_text() == "old"
    plt.close(figure)
    assert names(disk) == sorted(fills)


def extend(chain: Chain, steps: int) -> None:
    for _ in range(steps):
        u = np.full((8, 2), float(len(chain)))
        chain.append(u, np.zeros(8), np.ones(8, bool), STATE)


def test_a_chain_without_room_keeps_the_steps_that_had_some(disk):
    path = disk / "chain.h5"
    with pytest.raises(ValueError, match=f"chain.h5: {FULL}"), Chain(IDENTITY, path) as chain:
        extend(chain, 1000)
    assert names(disk) == ["chain.h5", "chain.h5.journal"]
    with pytest.raises(ValueError, match=f"chain.h5: {FULL}"), Chain(IDENTITY, path):
        pass
    subprocess.run(["mount", "-o", "remount,size=1m", str(disk)], check=True)
    with Chain(IDENTITY, path) as chain:
        assert 10 < len(chain) < 1000
        assert (chain.u[:, 0, 0] == np.arange(len(chain))).all()
        extend(chain, 1)
    assert names(disk) == ["chain.h5"]


def test_a_fit_without_room_leaves_no_folder(disk, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(problems, "residuals_of_scenes", quick.residuals_of_scenes)
    path = write(tmp_path, clips=CLIP, clip="start = 1.0\nend = 1.5")
    (disk / "full").write_bytes(bytes(60_000))
    assert main.main(["fit", str(path), "-o", str(disk / "runs" / "walk")]) == main.MISTAKE
    *_, line = capsys.readouterr().err.splitlines()
    assert line.startswith(f"jaxik fit: {disk}/runs/walk/") and line.endswith(FULL)
    assert names(disk) == ["full"]
