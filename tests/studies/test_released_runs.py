"""Runs that earlier releases have written: read, or refused in one sentence.

`tests/support/released` has a run of each, written by its own code: two parameters fitted with the
residuals of `support.quick`, and four steps of a chain.
"""

import shutil
from pathlib import Path

import pytest

from fitting.cli import main
from fitting.experiments import problems
from fitting.studies import run_folder
from fitting.studies.sample import walker_start
from jaxik.maths import parameter_tree
from support import quick
from support.experiments import ROOT

RELEASED = sorted((ROOT / "tests" / "support" / "released").iterdir())


@pytest.fixture(params=RELEASED, ids=lambda folder: folder.name)
def run(request, tmp_path) -> Path:
    run = Path(shutil.copytree(request.param, tmp_path / "run"))
    experiment = run / run_folder.EXPERIMENT
    experiment.write_text(experiment.read_text().replace("{data}", str(ROOT / "data")))
    return run


def test_its_fit_is_read_and_can_be_sampled_from(run):
    experiment, summary = run_folder.load_fit(run)
    values = {row["name"]: row["value"] for row in summary["parameters"]}
    assert values == pytest.approx(quick.TARGETS, abs=0.001)
    space = problems.make_problem(experiment).space
    start = walker_start(summary["parameters"], space)
    assert dict(zip(space.names, space.values(start.u).tolist(), strict=True)) == pytest.approx(
        values, rel=1e-6
    )


def test_its_system_is_applied(run):
    ik = run_folder.load_fitted_system(run)
    for name, value in quick.TARGETS.items():
        assert float(parameter_tree.get(ik, name)) == pytest.approx(value, abs=0.001)


def test_its_chain_is_refused_in_one_sentence(run, monkeypatch, capsys):
    monkeypatch.setattr(problems, "residuals_of_scenes", quick.residuals_of_scenes)
    before = (run / run_folder.CHAIN).read_bytes()
    assert main.main(["sample", str(run)]) == main.MISTAKE
    (line,) = capsys.readouterr().err.splitlines()
    assert "chain.h5 holds the chain of another run" in line and "delete the file" in line
    assert (run / run_folder.CHAIN).read_bytes() == before
