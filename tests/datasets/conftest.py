"""Fixtures that shorten the search for block grids."""

import numpy as np
import pytest

from fitting.datasets.terrain import block_grids


@pytest.fixture
def coarse_search(monkeypatch):
    """Searches in large steps, for tests that do not need the grid."""
    monkeypatch.setattr(block_grids, "PITCH_STEP", 0.15)
    monkeypatch.setattr(block_grids, "HEADING_STEP", np.radians(15.0))
    monkeypatch.setattr(block_grids, "LATTICE", (-1, 0, 1))


@pytest.fixture
def narrow_search(monkeypatch):
    """Searches a smaller range of pitches, and fewer neighbourhoods."""
    monkeypatch.setattr(block_grids, "PITCHES", (0.35, 1.0))
    monkeypatch.setattr(block_grids, "COARSE_KEPT", 8)
