"""A fit is watched while it goes on, and what cannot be shown costs one line."""

import builtins
import dataclasses
import importlib.metadata
import importlib.util
from pathlib import Path

import numpy as np
import pytest

from fitting import viewer
from fitting.cli import main
from fitting.inference.optimisation.solution import Progress, Report
from fitting.jobs import views
from fitting.jobs.views import Address, FitWatch
from fitting.studies.fit import Fit
from support import runs
from support.experiments import ROOT

needs_viser = pytest.mark.skipif(
    importlib.util.find_spec("viser") is None, reason='needs `pip install "jaxik[view]"`'
)
CLIP = [
    str(ROOT / "data" / "clips" / "uneven_walk_base.npz"), "--terrain",
    str(ROOT / "data" / "terrains" / "uneven_walk.ply"),
]  # fmt: skip


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> Fit:
    return runs.with_clips(runs.invented_fit(tmp_path_factory.mktemp("experiment")))


def report(best: float, u: np.ndarray) -> Report:
    return Report("descent", 0, 1, best, best, 1.0, best_u=u)


@needs_viser
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
        pytest.param(
            ["view", *CLIP, "-o", "nowhere"], "nowhere: no such folder", marks=needs_viser
        ),
    ],
)
def test_a_mistake_costs_one_line(words, sentence, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main.main(words) == main.MISTAKE
    error = capsys.readouterr().err
    assert sentence in error and error.count("\n") == 1


def subject_of_two_clips(fitted: Fit) -> viewer.Subject:
    subject = viewer.subject_of_fit(fitted.experiment, fitted.problem, fitted.clips)
    (take,) = subject.takes
    other = dataclasses.replace(take, name="again")
    return dataclasses.replace(subject, title="<img src=x onerror=run()>", takes=(take, other))


@needs_viser
def test_another_clip_is_shown_while_the_first_one_plays(fitted, tmp_path):
    subject = subject_of_two_clips(fitted)
    with views.opened(subject, tmp_path, Address(port=0)) as shown:
        assert shown.wait(300)
        first = shown.solver
        shown._player.play(True)
        shown._choose(1)
        assert shown.wait(300) and shown.solver is not first
        shown.reset("default")
        assert shown.wait(300) and shown._player._thread.is_alive()


@needs_viser
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


@needs_viser
def test_a_title_is_no_script():
    from fitting.viewer.page.words import literal

    assert literal("<img src=x>") == r"\<img src=x\>" and literal("walk 2") == "walk 2"


@needs_viser
def test_an_address_of_another_machine_is_refused(fitted):
    from fitting.viewer.page import open_server

    with pytest.raises(ValueError, match="--host 192.0.2.1: no address of this machine"):
        open_server("192.0.2.1", 0, Path(fitted.experiment.name).name)
