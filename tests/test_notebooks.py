"""The notebooks run in a fresh kernel without warnings, and are stored without outputs."""

import os
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
NAMES = [path.stem for path in NOTEBOOKS]
FITS = {"3_fit_and_posterior"}
# What only makes a notebook's pictures fuller: the same cells run with less of it.
SMALLER = {
    "3_fit_and_posterior": {"end=5.0,  # s": "end=2.0,  # s"},
    "4_a_crowd": {"COUNT = 10_000": "COUNT = 1_000"},
    "6_a_rule_of_your_own": {"end=5.0,  # s": "end=2.0,  # s"},
}
CELL_TIMEOUT = 600  # s; on two idle cores a whole notebook takes less than a minute


def test_the_notebooks_are_numbered_in_reading_order_and_listed_on_their_page():
    page = (ROOT / "notebooks" / "README.md").read_text(encoding="utf-8")
    assert len(NAMES) >= 5
    assert [name.partition("_")[0] for name in NAMES] == [f"{n + 1}" for n in range(len(NAMES))]
    assert [name for name in NAMES if f"{name}.ipynb" not in page] == []


def test_notebooks_are_stored_without_outputs():
    for path in NOTEBOOKS:
        notebook = nbformat.read(path, as_version=4)
        nbformat.validate(notebook)
        code = [cell for cell in notebook.cells if cell.cell_type == "code"]
        assert code, path
        for cell in code:
            assert cell.outputs == [] and cell.execution_count is None, (path, cell.source)
            assert "execution" not in cell.metadata, (path, cell.source)


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # of nbclient; a notebook's own warnings are on stderr
@pytest.mark.parametrize("path", NOTEBOOKS, ids=NAMES)
def test_a_notebook_runs_without_errors_or_warnings(path):
    notebook = nbformat.read(path, as_version=4)
    for full, smaller in SMALLER.get(path.stem, {}).items():
        (cell,) = (cell for cell in notebook.cells if full in cell.source)
        cell.source = cell.source.replace(full, smaller)
    # The kernel starts as a reader's does: without the tests' flags, in the notebook's folder. Only
    # what computes for long is compiled with optimisations.
    ours = {"XLA_FLAGS"} | ({"JAX_DISABLE_MOST_OPTIMIZATIONS"} if path.stem in FITS else set())
    inherited = {name: value for name, value in os.environ.items() if name not in ours}
    environment = inherited | {"PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    place = {"metadata": {"path": str(path.parent)}}
    client = NotebookClient(notebook, timeout=CELL_TIMEOUT, kernel_name="python3", resources=place)
    client.execute(env=environment)  # raises CellExecutionError with the cell and its traceback
    shown = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    printed_errors = [output.text for output in shown if output.get("name") == "stderr"]
    assert printed_errors == []
    assert any("image/png" in output.get("data", {}) for output in shown)
