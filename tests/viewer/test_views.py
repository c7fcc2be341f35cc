"""A fit is watched while it goes on, and what cannot be shown costs one line."""

import dataclasses
import importlib.metadata
import sys

import numpy as np
import pytest

from fitting import viewer
from fitting.inference.optimisation.solution import Progress, Report
from fitting.jobs import views
from fitting.jobs.views import Address, FitWatch
from fitting.studies.fit import Fit
from support import runs
from support.experiments import ROOT
from support.refusals import refusal

pytest.importorskip("viser", reason='needs `pip install "jaxik[view]"`')
BASE = str(ROOT / "data" / "clips" / "uneven_walk_base.npz")
ON_GROUND = [BASE, "--terrain", str(ROOT / "data" / "terrains" / "uneven_walk.ply")]


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
        watch(report(5.0, -u))  # no other best point
        assert watch.viewer.tuning.ik is shown
        watch(report(6.0, -u))  # with another noise
        assert watch.viewer.tuning.ik is not shown
    assert len(heard) == 4


def test_without_viser_one_line_names_the_extra(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "viser", None)
    line = refusal(["view", *ON_GROUND], tmp_path, capsys)
    assert line == 'jaxik view: needs viser: pip install "jaxik[view]"'


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ([BASE], "a clip needs --terrain"),
        (["runs/walk", "--speed", "2"], "--speed is 2.0; a run has its own clips"),
        ([*ON_GROUND, "-o", "nowhere"], "nowhere: no such folder"),
    ],
)
def test_a_mistake_costs_one_line(words, sentence, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert sentence in refusal(["view", *words], tmp_path, capsys)


def test_another_clip_is_shown_while_the_first_one_plays(fitted, tmp_path):
    subject = viewer.subject_of_fit(fitted.experiment, fitted.problem, fitted.clips)
    (take,) = subject.takes
    takes = (take, dataclasses.replace(take, name="again"))
    subject = dataclasses.replace(subject, title="<img src=x onerror=run()>", takes=takes)
    with views.opened(subject, tmp_path, Address(port=0)) as shown:
        assert shown.wait(300)
        first = shown.solver
        shown._player.play(True)
        shown._choose(1)
        assert shown.wait(300) and shown.solver is not first
        shown.reset("default")
        assert shown.wait(300) and shown._player._thread.is_alive()


def test_pages_of_other_origins_cannot_connect(fitted):
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect
    from websockets.typing import Origin, Subprotocol

    from fitting.viewer.page import open_server, stop

    server = open_server("127.0.0.1", 0, "test")
    try:
        address = f"127.0.0.1:{server.get_port()}"
        protocol = Subprotocol(f"viser-v{importlib.metadata.version('viser')}")
        own, other = Origin(f"http://{address}"), Origin("http://elsewhere.example")
        with connect(f"ws://{address}", origin=own, subprotocols=[protocol]):
            pass
        with pytest.raises(InvalidStatus, match="403"):
            connect(f"ws://{address}", origin=other, subprotocols=[protocol])
    finally:
        stop(server)


def test_a_title_is_no_script():
    from fitting.viewer.page.words import literal

    assert literal("<img src=x>") == r"\<img src=x\>" and literal("walk 2") == "walk 2"


def test_an_address_of_another_machine_is_refused():
    from fitting.viewer.page import open_server

    with pytest.raises(ValueError, match="--host 192.0.2.1: no address of this machine"):
        open_server("192.0.2.1", 0, "test")
