"""The notebooks run from a fresh kernel, and are kept without what they showed."""

import os
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
NAMES = [path.stem for path in NOTEBOOKS]
LIMIT = 600  # s, for one cell; on two idle cores a whole notebook takes less than a minute


def test_the_five_notebooks_are_there():
    assert NAMES == [
        "1_one_leg",
        "2_stage_by_stage",
        "3_fit_and_posterior",
        "4_a_crowd",
        "5_other_systems",
    ]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=NAMES)
def test_a_notebook_is_kept_without_outputs(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert code
    for cell in code:
        assert cell.outputs == [] and cell.execution_count is None, cell.source
        assert "execution" not in cell.metadata, cell.source


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # the machinery's; what a notebook warns of is looked at
@pytest.mark.parametrize("path", NOTEBOOKS, ids=NAMES)
def test_a_notebook_runs_without_errors_or_warnings(path):
    notebook = nbformat.read(path, as_version=4)
    # A kernel of its own, as a reader's: with the notebook's own flags, in the notebook's folder.
    inherited = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    environment = inherited | {"PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    client = NotebookClient(
        notebook,
        timeout=LIMIT,
        kernel_name="python3",
        resources={"metadata": {"path": str(path.parent)}},
    )
    client.execute(env=environment)  # raises CellExecutionError with the cell and its traceback
    shown = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    complaints = [output.text for output in shown if output.get("name") == "stderr"]
    assert complaints == []
    assert any("image/png" in output.get("data", {}) for output in shown)
