"""A fit is watched while it goes on, and what cannot be shown costs one line."""

import builtins
from pathlib import Path

import numpy as np
import pytest

from fitting.cli import main
from fitting.inference.optimisation.solution import Progress, Report
from fitting.jobs import views
from fitting.jobs.views import Address, FitWatch
from fitting.studies.fit import Fit
from support import runs
from support.experiments import ROOT

CLIP = [
    str(ROOT / "data" / "clips" / "uneven_walk_base.npz"), "--terrain",
    str(ROOT / "data" / "terrains" / "uneven_walk.ply"),
]  # fmt: skip


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> Fit:
    return runs.with_clips(runs.invented_fit(tmp_path_factory.mktemp("experiment")))


def report(best: float, u: np.ndarray) -> Report:
    return Report("descent", 0, 1, best, best, 1.0, best_u=u)


def test_a_fit_in_progress_shows_its_best_point(fitted, tmp_path, monkeypatch):
    monkeypatch.setattr(views, "EVERY", 0.0)
    heard: list[Progress] = []
    lines: list[str] = []
    with FitWatch(tmp_path, Address(port=0), heard.append, lines.append) as watch:
        watch(Progress("start", 0, 0, 9.0, 9.0, 0.0))  # before there is a page
        watch.load(fitted.experiment, fitted.problem, fitted.clips)
        assert "open http://127.0.0.1:" in lines[0] and watch.viewer.wait(300)
        u = np.array([0.1, 0.2])
        watch(report(5.0, u))
        assert watch.viewer.wait(300)
        shown = watch.viewer.tuning.ik
        assert watch.viewer.solved.cost == pytest.approx(float(fitted.problem.cost(u)))
        watch(report(6.0, -u))  # not better
        assert watch.viewer.tuning.ik is shown
    assert len(heard) == 3


def test_without_viser_one_line_names_the_extra(monkeypatch, capsys):
    imported = builtins.__import__

    def without_viser(name: str, *rest, **named):
        if name == "viser":
            raise ImportError(name)
        return imported(name, *rest, **named)

    monkeypatch.setattr(builtins, "__import__", without_viser)
    assert main.main(["view", *CLIP]) == main.MISTAKE
    assert capsys.readouterr().err == 'jaxik view: needs viser: pip install "jaxik[view]"\n'


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["view", CLIP[0]], "a clip needs --terrain"),
        (["view", "runs/walk", "--speed", "2"], "--speed is 2.0; a run has its own clips"),
        (["view", *CLIP, "-o", "nowhere"], "nowhere: no such folder"),
    ],
)
def test_a_mistake_costs_one_line(words, sentence, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main.main(words) == main.MISTAKE
    error = capsys.readouterr().err
    assert sentence in error and error.count("\n") == 1


def test_an_address_of_another_machine_is_refused(fitted):
    from fitting.viewer.page import open_server

    with pytest.raises(ValueError, match="--host 192.0.2.1: no address of this machine"):
        open_server("192.0.2.1", 0, Path(fitted.experiment.name).name)
