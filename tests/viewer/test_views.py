"""A viewer: its sliders and files, the motion and cost that it shows, a fit while it goes on."""

import dataclasses
import importlib.metadata
import importlib.util
import sys
import threading

import numpy as np
import pytest

from fitting import viewer
from fitting.clips import save_clip
from fitting.experiment import parameter_files
from fitting.experiment.problems import LoadedExperiment
from fitting.experiment.systems import Preset
from fitting.inference.optimise.solution import Progress, Report
from fitting.motion.measures import VISIBLE, Soles
from fitting.problem.space import free_parameter
from fitting.report.sliders import sliders
from fitting.studies.animations import AnimationFiles, load_animation
from fitting.studies.fit.fit_motions import saved_clips
from fitting.viewer import Solver, solving, tuning, views
from fitting.viewer.page import Latest
from fitting.viewer.session import Lines
from fitting.viewer.solving import IN_GROUND, FootFaults, foot_faults
from fitting.viewer.tuning import PAUSE, Tuning
from fitting.viewer.views import Address, FitWatch
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
        assert slider.low <= slider.clamped(ik) <= slider.high
        assert 0 < slider.step <= (slider.high - slider.low) / 100


def test_a_slider_changes_its_own_number_and_no_other(ik, by_name):
    for name in ("pelvis.limit", "probe.toe_ls[2]", "lock.enabled"):
        slider = by_name[name]
        value = (not slider.read(ik)) if slider.is_switch else 0.5 * (slider.low + slider.high)
        moved = slider.write(ik, value)
        assert slider.read(moved) == pytest.approx(value)
        others = [other for other in by_name.values() if other is not slider]
        assert [other.read(moved) for other in others] == [other.read(ik) for other in others]


def test_a_number_is_within_its_range_however_a_page_rounds_it_and_in_the_order_of_two(ik, by_name):
    knee, limit = by_name["leg.max_knee_angle"], by_name["pelvis.limit"]
    assert knee.read(knee.write(ik, 3.1415927)) == knee.high < 3.1415927
    with pytest.raises(ValueError, match="pelvis.limit is 99; wanted from"):
        limit.write(ik, 99.0)
    names = parameter_tree.declarations(ik)
    (upper, declared), *_ = [(n, d) for n, d in names.items() if d.above is not None]
    high, low = by_name[upper], by_name[f"{upper.rpartition('.')[0]}.{declared.above}"]
    assert high.above == low.leaf and low.below == (high.leaf,)
    assert high.read(high.write(ik, high.low)) == low.read(ik)
    assert low.read(low.write(ik, low.high)) == high.read(ik)


def test_undo_redo_and_reset(ik, by_name):
    slider, other = by_name["pelvis.limit"], by_name["foot.max_pitch"]
    tuning = Tuning({"fitted": ik, "default": presets.ozz()})
    for i, now in enumerate((0.0, 0.1, 0.2)):  # one drag
        tuning.change(slider.write(ik, 0.1 + 0.01 * i), slider.name, now)
    dragged = tuning.ik
    tuning.change(other.write(dragged, 0.2), other.name, 0.3)
    tuning.undo()
    assert tuning.ik is dragged
    tuning.undo()
    assert tuning.ik is ik
    tuning.undo()
    assert tuning.ik is ik, "there is no step before the first"
    tuning.redo()
    assert tuning.ik is dragged
    tuning.reset("default")
    assert tuning.ik is tuning.starts["default"]
    tuning.redo()
    assert tuning.ik is tuning.starts["default"], "a new step replaces those undone"
    tuning.undo()
    assert tuning.ik is dragged
    tuning = Tuning({"default": ik})  # a pause begins a new step
    tuning.change(dragged, slider.name, 0.0)
    tuning.change(slider.write(ik, 0.2), slider.name, 2 * PAUSE)
    tuning.undo()
    assert tuning.ik is dragged


def test_what_is_saved_is_read_again_but_no_record_that_would_lose_something_is_written(tmp_path):
    ik = presets.record(faithful=True)
    slider = next(slider for slider in sliders(ik) if slider.name == "pelvis.limit")
    said = tuning.save(tmp_path, slider.write(ik, 0.123), FAITHFUL)
    tuning.save(tmp_path, ik, FAITHFUL)
    loaded, preset = parameter_files.load_system(tmp_path / "tuned.toml")
    content = (tmp_path / "tuned.bin").read_bytes()
    for read in (loaded, record.to_ik(record.from_bytes(content))):
        assert slider.read(read) == pytest.approx(0.123)
    assert preset == FAITHFUL and (tmp_path / "tuned_2.toml").exists()
    assert "knee" in said[-1]  # the bytes hold more than parameters
    ik = parameter_tree.replace(ik, {"leg.soften": 0.9})
    (_, refused) = tuning.save(tmp_path, ik, FAITHFUL)
    assert "No record is written" in refused and "leg.soften = 0.9" in refused
    assert (tmp_path / "tuned_3.toml").exists() and not (tmp_path / "tuned_3.bin").exists()
    said = tuning.save(tmp_path, ik, FAITHFUL, drop=True)
    assert any("leg.soften = 0.9" in line for line in said)
    assert (tmp_path / "tuned_4.bin").stat().st_size == 128
    (_, refused) = tuning.save(tmp_path, presets.ozz(), Preset("ozz"))
    assert "only those of 'record' make one" in refused


def test_only_the_newest_request_is_worked_on():
    began, go_on = threading.Event(), threading.Event()
    newest, done = [0], []

    def work() -> None:
        value = newest[0]
        began.set()
        go_on.wait(10)
        done.append(value)

    latest = Latest(work)
    latest.request()
    assert began.wait(10)
    for value in range(1, 50):
        newest[0] = value
        latest.request()
    go_on.set()
    assert latest.wait(10)
    latest.close()
    assert done == [0, 49]


# What is shown

BASE = ROOT / "data" / "clips" / "uneven_walk_base.npz"
GROUND = ROOT / "data" / "terrains" / "uneven_walk.ply"
needs_viser = pytest.mark.skipif(
    importlib.util.find_spec("viser") is None, reason='needs `pip install "jaxik[view]"`'
)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    return runs.with_clips(runs.invented_fit(tmp_path_factory.mktemp("experiment")))


@pytest.fixture(scope="module")
def solver(fitted, tmp_path_factory) -> Solver:
    run = tmp_path_factory.mktemp("run")
    runs.save(run, fitted)
    return Solver(viewer.session_of_run(run))


def ends(lines: Lines) -> np.ndarray:
    return lines.points.reshape(len(lines.points), -1, 3)


def test_a_run_begins_with_the_motion_and_cost_of_its_fit_with_rays_and_targets(fitted, solver):
    session = solver.session
    assert list(session.starts) == ["fitted", "before", "default"]
    for name in ("pelvis.on_gain", "foot.max_pitch"):
        value = parameter_tree.get(session.starts["fitted"], name)
        assert float(value) == pytest.approx(float(parameter_tree.get(fitted.ik, name)))
    assert bool(parameter_tree.get(session.starts["default"], "lock.enabled"))
    solved = {name: solver.solve(session.starts[name]) for name in ("fitted", "before")}
    joints = saved_clips(fitted)["fitted.npz"].positions_ws
    shown = ends(solved["fitted"].motion.bones)
    gaps = np.linalg.norm(shown[:, :, None] - joints[:, None], axis=-1).min(axis=2)
    assert gaps.max() < 1e-9
    for name, shown in solved.items():
        u = fitted.problem.space.pack(session.starts[name])
        assert shown.cost == pytest.approx(float(fitted.problem.cost(u)), rel=1e-9)
    overlays, motion = solved["fitted"].overlays, solved["fitted"].motion
    rays = overlays["rays"].points  # which end on the ground, as targets are where ankles are
    assert np.all(rays[..., 0, 1] >= rays[..., 1, 1])
    np.testing.assert_array_equal(rays[..., 0, [0, 2]], rays[..., 1, [0, 2]])
    centres = overlays["targets"].points.mean(axis=2)
    ankles = motion.feet.points[:, :2, 0]  # the first lines begin there
    assert np.linalg.norm(centres[:, ::3] - ankles, axis=-1).max() < 0.1
    for lines in (*overlays.values(), motion.bones):
        assert np.isfinite(lines.points).all() and lines.colours.dtype == np.uint8


def test_any_parameter_moves_the_feet_and_the_cost_and_poses_are_finite_or_refused(
    solver, monkeypatch
):
    ik = solver.session.starts["fitted"]
    by_name = {slider.name: slider for slider in sliders(ik, solver.session.rig)}
    slider = by_name["probe.ray_down"]
    before, after = solver.solve(ik), solver.solve(slider.write(ik, 0.0))
    assert np.abs(ends(after.motion.feet) - ends(before.motion.feet)).max() > 0.01
    assert after.cost != before.cost

    def broken(clip, result, **placed):
        return clip.with_motion(clip.positions_ws * np.nan, clip.rotations_ws)

    monkeypatch.setattr(solving, "clip_from_result", broken)
    with pytest.raises(ValueError, match="not finite"):
        solver.solve(ik)


def test_deep_feet_are_red_and_sliding_ones_purple_counted_from_the_beginning_of_a_stance(solver):
    faults = FootFaults(np.array([[0.0, VISIBLE, 0.0]]), np.array([[0.0, 0.0, VISIBLE]]))
    plain, deep, slid = faults.colours((10, 20, 30))[0].tolist()
    assert plain == [10, 20, 30] and deep == list(IN_GROUND) and slid[0] > 200 < slid[2]
    clip = solver.animation.placed_clip
    count = clip.frame_count
    stance = np.zeros((count, 2), bool)
    stance[1:4, 0] = True
    drift = np.arange(count)[:, None, None] * np.array([0.01, 0.0, 0.0])
    still = dataclasses.replace(clip, positions_ws=np.repeat(clip.positions_ws[:1], count, axis=0))
    moved = dataclasses.replace(still, positions_ws=still.positions_ws + drift)
    shape = (count, 2, 2)
    soles = Soles(np.zeros((*shape, 3)), np.full(shape, -0.03), np.zeros(shape), stance)
    faults = foot_faults(soles, moved, still)
    np.testing.assert_allclose(faults.slide[:4, 0], [0, 0, 0.01, 0.02], atol=1e-12)
    assert not faults.slide[4:, 0].any()
    np.testing.assert_allclose(faults.depth, 0.03)
    assert not faults.slide[:, 1].any()


def test_a_clip_is_shown_as_jaxik_run_solves_it(fitted, tmp_path):
    files = AnimationFiles(tmp_path / "flat.npz", GROUND)
    save_clip(files.clip, fitted.clips[0].base)
    session = viewer.session_of_animation(files, Preset("record"))
    assert list(session.starts) == ["default"] and session.cost is None
    shown = Solver(session).solve(session.starts["default"])
    _, solved = load_animation(files).solve(session.starts["default"])
    np.testing.assert_allclose(shown.motion.feet.points[:, :2, 0], solved.joints_ws(2), atol=1e-9)
    assert shown.cost is None


# While a fit goes on, and in a browser


def report(best: float, u: np.ndarray) -> Report:
    return Report("descent", 0, 1, best, best, 1.0, best_u=u)


@needs_viser
def test_a_fit_in_progress_shows_its_best_point(fitted, tmp_path, monkeypatch):
    monkeypatch.setattr(views, "EVERY", 0.0)
    lines: list[str] = []
    with listening(lines.append), FitWatch(tmp_path, Address(port=0)) as watch:
        watch.reported(Progress("start", 0, 0, 9.0, 9.0, 0.0))  # before there is a page
        watch.reported(LoadedExperiment(fitted.experiment, fitted.clips, fitted.problem, None))
        assert "open http://127.0.0.1:" in lines[0] and watch.viewer.wait(300)
        u = np.array([0.1, 0.2])
        watch.reported(report(5.0, u))
        assert watch.viewer.wait(300)
        shown = watch.viewer.tuning.ik
        assert watch.viewer.solved.cost == pytest.approx(float(fitted.problem.cost(u)))
        watch.reported(report(5.0, -u))  # no other best point
        assert watch.viewer.tuning.ik is shown
        watch.reported(report(6.0, -u))  # with another noise
        assert watch.viewer.tuning.ik is not shown


def test_what_cannot_be_shown_costs_one_line(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    on_ground = [BASE, "--terrain", GROUND]
    for words, sentence in (
        ([BASE], "a clip needs --terrain"),
        (["runs/walk", "--speed", "2"], "--speed is 2.0; a run has its own clips"),
        ([*on_ground, "-o", "nowhere"], "nowhere: no such folder"),
    ):
        assert sentence in refusal(["view", *words], tmp_path, capsys)
    monkeypatch.setitem(sys.modules, "viser", None)
    line = refusal(["view", *on_ground], tmp_path, capsys)
    assert line == 'jaxik view: needs viser: pip install "jaxik[view]"'


@needs_viser
def test_another_clip_is_shown_while_the_first_one_plays(fitted, tmp_path):
    session = viewer.session_of_fit(fitted.experiment, fitted.problem, fitted.clips)
    (clip,) = session.clips
    clips = (clip, dataclasses.replace(clip, name="again"))
    session = dataclasses.replace(session, title="<img src=x onerror=run()>", clips=clips)
    with views.opened(session, tmp_path, Address(port=0)) as shown:
        assert shown.wait(300)
        first = shown.solver
        shown._player.play(True)
        shown._choose(1)
        assert shown.wait(300) and shown.solver is not first
        shown.reset("default")
        assert shown.wait(300) and shown._player._thread.is_alive()


@needs_viser
def test_only_pages_of_its_own_address_on_this_machine_can_connect_and_titles_are_no_scripts():
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect
    from websockets.typing import Origin, Subprotocol

    from fitting.viewer.page import literal, open_server, stop

    server = open_server("127.0.0.1", 0)
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
    with pytest.raises(ValueError, match="--host 192.0.2.1: no address of this machine"):
        open_server("192.0.2.1", 0)
    assert literal("<img src=x>") == r"\<img src=x\>" and literal("walk 2") == "walk 2"
