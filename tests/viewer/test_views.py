"""A viewer: its sliders and files, the motion and cost that it shows, a fit while it goes on."""

import base64
import dataclasses
import http.client
import json
import zlib
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from fitting import viewer
from fitting.clips import load_clip, save_clip
from fitting.experiment import parameter_files, problems
from fitting.experiment.experiment_files import load_experiment
from fitting.experiment.problems import LoadedExperiment
from fitting.experiment.systems import Preset
from fitting.inference.optimise.solution import Progress, Report
from fitting.motion import playback
from fitting.problem.problem import Problem, rho
from fitting.problem.space import free_parameter
from fitting.report.sliders import sliders
from fitting.studies.animations import AnimationFiles, load_animation
from fitting.studies.fit.fit_motions import saved_clips
from fitting.viewer import Solver, Tuning, edits, server, views
from fitting.viewer.server import Address, Server
from fitting.viewer.solving import LAYERS
from fitting.viewer.views import FitWatch
from jaxik import presets, record
from jaxik.maths import parameter_tree
from support import runs
from support.commands import refusal
from support.experiments import ROOT
from support.watching import listening

FAITHFUL = Preset("record", faithful=True)


@pytest.fixture(scope="module")
def ik():
    return presets.record()


@pytest.fixture(scope="module")
def by_name(ik):
    return {slider.name: slider for slider in sliders(ik)}


def test_every_parameter_and_switch_has_a_slider_and_fitted_ones_their_own_range(ik, by_name):
    declared = set(parameter_tree.declarations(ik))
    switches = {slot.name for slot in parameter_tree.slots(ik) if slot.value.dtype == bool}
    assert {slider.leaf for slider in by_name.values()} == declared | switches
    toes = [name for name in by_name if name.startswith("probe.toe_ls")]
    assert toes == [f"probe.toe_ls[{i}]" for i in range(3)]
    free = [free_parameter(ik, "foot.max_pitch", low=0.1, high=0.2)]
    fitted = [slider for slider in sliders(ik, free=free) if slider.is_free]
    ranges = {slider.name: (slider.low, slider.high) for slider in fitted}
    assert ranges == {"foot.max_pitch": (0.1, 0.2)}
    for slider in by_name.values():
        assert 0 < slider.step <= (slider.high - slider.low) / 100


def test_a_value_changes_its_own_number_and_no_other(solver, by_name):
    moves = Tuning(solver.session)
    own = moves.numbers(moves.first)
    names = [slider.name for slider in moves.sliders]
    for name in ("pelvis.limit", "probe.toe_ls[2]", "lock.enabled"):
        values, at = own.copy(), names.index(name)
        values[at] = 1.0 - own[at] if by_name[name].is_switch else 0.37 * own[at] + 0.01
        np.testing.assert_array_equal(moves.numbers(moves.system(values)), values)
    for wrong, words in (
        (own[1:], f"got {len(own) - 1}, 0"),
        (own * np.nan, f"{len(own)} of them"),
    ):
        with pytest.raises(ValueError, match=f"wanted {len(own)} numbers.*{words}"):
            moves.system(wrong)


def test_sliders_know_the_order_of_two_numbers(ik, by_name):
    names = parameter_tree.declarations(ik)
    (upper, declared), *_ = [(n, d) for n, d in names.items() if d.above is not None]
    high, low = by_name[upper], by_name[f"{upper.rpartition('.')[0]}.{declared.above}"]
    assert high.above == low.leaf and low.below == (high.leaf,)


def test_what_is_saved_is_read_again_but_no_record_that_would_lose_something_is_written(tmp_path):
    ik = presets.record(faithful=True)
    slider = next(slider for slider in sliders(ik) if slider.name == "pelvis.limit")
    said = edits.save(tmp_path, parameter_tree.replace(ik, {"pelvis.limit": 0.123}), FAITHFUL)
    edits.save(tmp_path, ik, FAITHFUL)
    loaded, preset = parameter_files.load_system(tmp_path / "tuned.toml")
    content = (tmp_path / "tuned.bin").read_bytes()
    for read in (loaded, record.to_ik(record.from_bytes(content))):
        assert slider.read(read) == pytest.approx(0.123)
    assert preset == FAITHFUL and (tmp_path / "tuned_2.toml").exists()
    assert "knee" in said[-1]  # the bytes hold more than parameters
    ik = parameter_tree.replace(ik, {"leg.soften": 0.9})
    (_, refused) = edits.save(tmp_path, ik, FAITHFUL)
    assert "No record is written" in refused and "leg.soften = 0.9" in refused
    assert (tmp_path / "tuned_3.toml").exists() and not (tmp_path / "tuned_3.bin").exists()
    said = edits.save(tmp_path, ik, FAITHFUL, drop=True)
    assert any("leg.soften = 0.9" in line for line in said)
    assert (tmp_path / "tuned_4.bin").stat().st_size == 128
    (_, refused) = edits.save(tmp_path, presets.ozz(), Preset("ozz"))
    assert "only those of 'record' make one" in refused


# What is shown

BASE = ROOT / "data" / "clips" / "uneven_walk_base.npz"
GROUND = ROOT / "data" / "terrains" / "uneven_walk.ply"


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    return runs.with_clips(runs.invented_fit(tmp_path_factory.mktemp("experiment")))


@pytest.fixture(scope="module")
def solver(fitted, tmp_path_factory) -> Solver:
    run = tmp_path_factory.mktemp("run")
    runs.save(run, fitted)
    return Solver(viewer.session_of_run(run))


def cost_of_motion(problem: Problem, u) -> float:
    """The cost from the played clip, for which there is a program already."""
    (scene,), u = problem.data, jnp.asarray(u)
    played = playback.play(scene, playback.run(problem.space.unpack(u), scene))
    residuals = np.concatenate([each.ravel() for each in played.residuals.values()])
    squares = np.sum(rho(residuals**2, problem.loss, problem.tails))
    squares += np.sum(problem.space.prior_residuals(u) ** 2)
    return 0.5 * float(problem.weight) * float(squares)


@pytest.mark.slow
def test_a_run_begins_with_the_motion_and_cost_of_its_fit_with_rays_and_targets(fitted, solver):
    session = solver.session
    assert list(session.starts) == ["fitted", "before", "default"]
    for name in ("pelvis.half_life", "foot.max_pitch"):
        value = parameter_tree.get(session.starts["fitted"], name)
        assert float(value) == pytest.approx(float(parameter_tree.get(fitted.ik, name)))
    assert bool(parameter_tree.get(session.starts["default"], "lock.enabled"))
    solved = {
        name: solver.solve(session.starts[name], list(LAYERS)) for name in ("fitted", "before")
    }
    joints = saved_clips(fitted)["fitted.npz"].positions_ws
    np.testing.assert_allclose(solved["fitted"].clip.positions_ws, joints, atol=1e-9)
    for name, shown in solved.items():
        u = fitted.problem.space.pack(session.starts[name])
        assert shown.cost == pytest.approx(cost_of_motion(fitted.problem, u), rel=1e-9)
    overlays, motion = solved["fitted"].layers, solved["fitted"]
    assert list(overlays) == list(LAYERS)
    rays = overlays["rays"].points  # which end on the ground, as targets are where ankles are
    assert np.all(rays[..., 0, 1] >= rays[..., 1, 1])
    np.testing.assert_array_equal(rays[..., 0, [0, 2]], rays[..., 1, [0, 2]])
    centres = overlays["targets"].points.mean(axis=2)
    ankles = motion.clip.joints_ws(2)
    assert np.linalg.norm(centres[:, ::3] - ankles, axis=-1).max() < 0.1
    for lines in overlays.values():
        assert np.isfinite(lines.points).all() and lines.colours.dtype == np.uint8


def test_any_parameter_moves_the_feet_and_the_cost_and_poses_are_finite_or_refused(solver):
    ik = solver.session.starts["fitted"]
    moved = parameter_tree.replace(ik, {"probe.ray_down": 0.0})
    before, after = solver.solve(ik), solver.solve(moved)
    ankles = [solved.clip.joints_ws(2) for solved in (before, after)]
    assert np.abs(ankles[1] - ankles[0]).max() > 0.01 and after.cost != before.cost
    with pytest.raises(ValueError, match="not finite"):
        solver.solve(parameter_tree.replace(ik, {"lean.forward_rate": np.inf}))


def test_a_clip_is_shown_as_jaxik_run_solves_it(fitted, tmp_path):
    files = AnimationFiles(tmp_path / "flat.npz", GROUND)
    save_clip(files.clip, fitted.clips[0].base)
    session = viewer.session_of_animation(files, Preset("record"))
    assert list(session.starts) == ["default"] and session.cost is None
    shown = Solver(session).solve(session.starts["default"])
    _, solved = load_animation(files).solve(session.starts["default"])
    np.testing.assert_allclose(shown.clip.positions_ws, solved.positions_ws, atol=1e-9)
    assert shown.cost is None


# While a fit goes on, and in a browser


def report(best: float, u: np.ndarray) -> Report:
    return Report("descent", 0, 1, best, best, 1.0, best_u=u)


def test_a_fit_in_progress_shows_its_best_point(fitted, tmp_path, monkeypatch):
    monkeypatch.setattr(views, "EVERY", 0.0)
    lines: list[str] = []
    with listening(lines.append), FitWatch(tmp_path, Address(port=0)) as watch:
        watch.reported(Progress("start", 0, 0, 9.0, 9.0, 0.0))  # before there is a page
        watch.reported(LoadedExperiment(fitted.experiment, fitted.clips, fitted.problem, None))
        assert "open http://127.0.0.1:" in lines[0]
        shown = watch.server.viewer
        u = np.array([0.1, 0.2])
        watch.reported(report(5.0, u))
        news = shown.news(0)
        assert news.number == 1 and "best cost 5" in news.note
        request = {"clip": 0, "layers": [], "values": doubles(news.values)}
        cost = json.loads(split(shown.solve(request))[0])["cost"]
        assert cost == pytest.approx(cost_of_motion(fitted.problem, u))
        watch.reported(report(5.0, -u))  # no other best point
        monkeypatch.setattr(server, "PATIENCE", 0.01)
        assert shown.news(1) is news
        watch.reported(report(6.0, -u))  # with another noise
        assert shown.news(1).number == 2


def doubles(packed: str) -> str:
    """Numbers that a page gets, as it sends them."""
    return base64.b64encode(zlib.decompress(base64.b64decode(packed))).decode()


def split(answer: bytes) -> tuple[bytes, bytes]:
    """The text and the arrays of a solution."""
    length = int(np.frombuffer(answer[:4], "<u4")[0])
    return answer[4 : 4 + length], answer[4 + length :]


def test_what_cannot_be_shown_costs_one_line(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    on_ground = [BASE, "--terrain", GROUND]
    for words, sentence in (
        ([BASE], "a clip needs --terrain"),
        (["runs/walk", "--speed", "2"], "--speed is 2.0; a run has its own clips"),
        ([*on_ground, "-o", "nowhere"], "nowhere: no such folder"),
    ):
        assert sentence in refusal(["view", *words], tmp_path, capsys)


# What the page asks for


@pytest.fixture(scope="module")
def served(fitted, tmp_path_factory) -> Iterator[Server]:
    session = viewer.session_of_fit(fitted.experiment, fitted.problem, fitted.clips)
    (clip,) = session.clips
    clips = (clip, dataclasses.replace(clip, name="again"))
    session = dataclasses.replace(session, title="<img src=x onerror=run()>", clips=clips)
    with views.opened(session, tmp_path_factory.mktemp("saved"), Address(port=0)) as server:
        yield server


def ask(server: Server, path: str, content: object = None, **headers: str) -> tuple[int, bytes]:
    """Status and content of an answer."""
    body = None if content is None else json.dumps(content)
    host, port = server.url.removeprefix("http://").split(":")
    with closing(http.client.HTTPConnection(host, int(port))) as connection:
        connection.request("GET" if body is None else "POST", path, body, headers)
        answer = connection.getresponse()
        return answer.status, answer.read()


def test_the_page_gets_clips_and_motions_and_its_title_is_no_script(served):
    status, page = ask(served, "/")
    assert status == 200 and b"&lt;img src=x onerror=run()&gt;" in page and b"<img" not in page
    status, clip = ask(served, "/clip/1")
    clip = json.loads(clip)
    assert status == 200 and [each["key"] for each in clip["skeletons"]][1] == "solved"
    values = doubles(next(iter(clip["live"]["systems"][0]["starts"].values())))
    request = {"clip": 1, "layers": ["rays", "unknown"], "values": values}
    status, answer = ask(served, "/solve", request)
    text, arrays = split(answer)
    listed = json.loads(text)["arrays"]
    assert status == 200 and [name for name, *_ in listed] == [
        "points", "gap", "rays points", "rays colours"
    ]  # fmt: skip
    points = np.frombuffer(arrays, "<f4", listed[0][2]).reshape(clip["frames"], -1, 3)
    solver = Solver(served.viewer.session, 1)
    own = solver.solve(served.viewer.tuning.first).clip.positions_ws
    joints = own.shape[1]
    np.testing.assert_allclose(points[:, :joints] + clip["corner"], own, atol=1e-5)


@pytest.mark.parametrize(
    ("path", "content", "status", "words"),
    [
        ("/elsewhere", None, 404, "no such page"),
        ("/clip/7", None, 400, "clip 7; wanted 0 to 1"),
        ("/elsewhere", {}, 404, "no such action"),
        ("/solve", [], 400, "not a JSON object"),
        ("/solve", {"clip": 0, "layers": [], "values": "AAAA"}, 400, ""),
        ("/solve", {"clip": 0, "layers": []}, 400, "values is None; wanted str"),
        ("/save", {"values": "", "drop": False}, 400, "numbers, one for each slider"),
    ],
)
def test_requests_that_make_no_sense_are_refused_in_words(served, path, content, status, words):
    answer = ask(served, path, content)
    assert answer[0] == status and words in answer[1].decode(), answer


def test_only_its_own_pages_on_this_machine_can_ask(served):
    host, port = served.server_address[:2]
    assert served.url == f"http://{host}:{port}" and host == "127.0.0.1"
    own = {"Origin": served.url}
    assert ask(served, "/news/-1", {})[0] == 404
    assert ask(served, "/save", {"values": "", "drop": False}, **own)[0] == 400
    elsewhere = {"Origin": "http://elsewhere.example"}
    for path, content in (("/", None), ("/save", {"values": "", "drop": False})):
        assert ask(served, path, content, **elsewhere)[0] == 403
        assert ask(served, path, content, Host=f"elsewhere.example:{port}")[0] == 403
    assert ask(served, "/clip/0", Host=f"localhost:{port}")[0] == 200


def test_a_port_in_use_is_passed_over_and_an_address_elsewhere_refused(served):
    port = served.server_address[1]
    with closing(Server(served.viewer, Address(port=port))) as second:
        assert port < second.server_address[1] <= port + 100
    for address, words in (
        (Address("192.0.2.1"), "--host 192.0.2.1: no address of this machine"),
        (Address(port=70_000), "--port 70000"),
    ):
        with pytest.raises(ValueError, match=words):
            Server(served.viewer, address)
    assert Address("::1").is_local and not Address("0.0.0.0").is_local


@pytest.fixture(scope="module")
def labelled(tmp_path_factory) -> Iterator[tuple[Server, Path]]:
    """A server of half a second of a walk, and the folder with the files of its clips."""
    folder = tmp_path_factory.mktemp("labelled")
    runs.save(folder, runs.with_own_files(folder))
    with views.opened(viewer.session_of_run(folder), folder, Address(port=0)) as server:
        yield server, folder


@pytest.mark.slow
def test_stances_put_right_on_the_page_are_read_wherever_the_clip_is(labelled):
    server, folder = labelled
    names = "uneven_walk.npz", "uneven_walk_base.npz"
    before = [load_clip(folder / name) for name in names]
    status, content = ask(server, "/clip/0")
    legs = json.loads(content)["contacts"]["legs"]
    number, (stance, *_) = next((number, leg) for number, leg in enumerate(legs) if leg)
    legs[number] = [stance | {"start": 0.3, "end": 0.4, "byHand": True, "leftOut": True}]
    status, answer = ask(server, "/contacts", {"clip": 0, "legs": legs})
    answer = json.loads(answer)
    assert status == 200 and "uneven_walk_base.contacts.toml: " in answer["message"]
    (shown,) = answer["clip"]["contacts"]["legs"][number]
    assert shown["byHand"] and shown["leftOut"] and shown["start"] == pytest.approx(0.3)
    (data,) = problems.load_clips(load_experiment(folder / "experiment.toml"))
    part = slice(30, 46)
    for name, clip, read in zip(names, before, (data.reference, data.base), strict=True):
        after = load_clip(folder / name)
        changed = np.any(after.stance_labels() != clip.stance_labels(), axis=1)
        assert changed[part].any() and not changed[:30].any() and not changed[46:].any()
        np.testing.assert_array_equal(read.stance, after.stance_labels()[part])
    assert data.reference.left_out.any()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"start": 9.0, "end": 9.5}, "is not within the clip"),
        ({"start": 0.4, "end": 0.1}, "ends before it starts"),
        ({"start": None}, "a stance without"),
        ({"byHand": False, "probability": 3}, "probability"),
    ],
)
def test_stances_that_are_none_are_refused_and_nothing_is_written(labelled, change, words):
    server, folder = labelled
    files = {path: path.read_bytes() for path in folder.glob("*.contacts.toml")}
    legs = json.loads(ask(server, "/clip/0")[1])["contacts"]["legs"]
    leg = next(leg for leg in legs if leg)
    leg[0] |= {"byHand": True} | change
    status, answer = ask(server, "/contacts", {"clip": 0, "legs": legs})
    assert status == 400 and words in answer.decode()
    assert ask(server, "/contacts", {"clip": 0, "legs": legs[:1]})[0] == 400
    assert files == {path: path.read_bytes() for path in folder.glob("*.contacts.toml")}
