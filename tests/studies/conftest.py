"""Pictures of studies take long to draw."""

import pytest
from matplotlib.figure import Figure

from support.small_studies import save_pixel


@pytest.fixture
def undrawn(monkeypatch) -> None:
    """Figures are made, and files hold a pixel of them, for tests of something else."""
    monkeypatch.setattr(Figure, "savefig", save_pixel)
