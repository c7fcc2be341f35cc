"""The programs that make sense at length only, each for a few minutes, with seeds that stay."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
COMMANDS = [
    "fuzz --count 300 --seed 12",
    "soak --frames 500000",
    "stairs --count 500",
    # Of mutants that nobody has seen 63 % are caught; one in thirty such samples misses this goal.
    "mutation --count 12 --seed 5 --budget 45 --goal 0.4",
]


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.split()[0])
def test_a_long_run_meets_its_goal(command):
    """Its exit status says so."""
    words, path = [sys.executable, "-m", *command.split()], {"PYTHONPATH": str(ROOT / "tests")}
    done = subprocess.run(words, cwd=ROOT, env=os.environ | path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
