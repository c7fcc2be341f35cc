"""Shared fixtures: 64-bit floats, and the reference material beside the project."""

from pathlib import Path

import jax
import pytest

from fitting.runtime import xla

xla.configure_xla()  # as the commands do
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
