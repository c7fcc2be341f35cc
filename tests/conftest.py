"""Shared fixtures: 64-bit floats, and the reference material beside the project."""

import os
from pathlib import Path

# Before jax is imported: the tests compile more than they compute, and XLA's older way of emitting
# fused loops on a CPU compiles a pipeline in about half the time.
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false")

import jax  # noqa: E402
import pytest  # noqa: E402

jax.config.update("jax_enable_x64", True)

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of reference material beside the checkout."""
    path = ROOT.parent / "shared"
    if not (path / "mocap" / "README.md").exists():
        pytest.skip(f"needs the reference material in {path}, which is not there")
    return path


@pytest.fixture(scope="session")
def mocap(shared: Path) -> Path:
    """Captured clips and the benchmark on blocks."""
    return shared / "mocap"
