"""Clips on several devices, or in several processes: the same numbers as on one."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fitting.inference.sharding import over_devices
from fitting.problem import stacking
from support import on_devices
from support.experiments import ROOT

TOLERANCE = 1e-12  # relative: sums in another order


@pytest.fixture(scope="module")
def evaluations() -> dict[str, np.ndarray]:
    """On one device."""
    return on_devices.evaluations()


def start(path: Path, devices: int, *process: str) -> subprocess.Popen:
    """A process with simulated devices that writes its numbers to a file."""
    paths = os.pathsep.join(map(str, [ROOT, ROOT / "tests"]))
    return subprocess.Popen(
        [sys.executable, "-m", "support.on_devices", str(path), str(devices), *process],
        env=os.environ | {"PYTHONPATH": paths}, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def assert_alike(path: Path, expected: dict[str, np.ndarray]) -> None:
    with np.load(path) as archive:
        assert set(archive) == set(expected)
        for name, values in expected.items():
            assert np.isfinite(values).all() and np.ptp(values) > 0
            np.testing.assert_allclose(archive[name], values, rtol=TOLERANCE, err_msg=name)


def test_eight_devices_find_what_one_finds(evaluations, tmp_path):
    process = start(tmp_path / "eight.npz", 8)
    _, errors = process.communicate(timeout=500)
    assert process.returncode == 0, errors[-2000:]
    assert_alike(tmp_path / "eight.npz", evaluations | on_devices.log_probabilities())


@pytest.mark.slow
def test_two_processes_find_what_one_finds(evaluations, tmp_path):
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{listener.getsockname()[1]}"
    paths = [tmp_path / f"{number}.npz" for number in range(2)]
    processes = [start(path, 2, address, "2", str(number)) for number, path in enumerate(paths)]
    errors = [process.communicate(timeout=500)[1] for process in processes]
    assert [process.returncode for process in processes] == [0, 0], errors
    of_systems = {name: values for name, values in evaluations.items() if "systems" in name}
    for path in paths:
        assert_alike(path, of_systems)


def test_one_device_changes_nothing():
    problem = on_devices.make_problem()
    assert over_devices(problem) is problem


def test_a_clip_cannot_be_made_shorter():
    scene = on_devices.make_problem().data[0]
    frames = stacking.frame_count(scene)
    with pytest.raises(ValueError, match=f"has {frames} frames; wanted at most 3"):
        stacking.padded(scene, 3)


def test_lengths_are_rounded_up_to_a_few_by_a_quarter_at_most():
    lengths = range(1, 5000)
    rounded = [stacking.rounded_up(length) for length in lengths]
    assert all(length <= longer for length, longer in zip(lengths, rounded, strict=True))
    assert max(b / max(a, 32) for a, b in zip(lengths, rounded, strict=True)) <= 1.26
    assert len(set(rounded)) < 30 and rounded == sorted(rounded)


def test_clips_on_one_ground_are_one_stack_and_keep_their_order():
    problem = on_devices.make_problem()
    (stack,) = stacking.stack(problem.data)
    assert stack.members == (0, 1, 2) and stack.shares_terrain
    for number, scene in enumerate(problem.data):
        observed = np.asarray(stack.one(number).reference.observed)
        assert observed.sum() == np.asarray(scene.reference.observed).sum()
