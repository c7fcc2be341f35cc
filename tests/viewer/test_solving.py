"""What a viewer shows: the motion that commands write, its cost, and what its feet do wrong."""

import dataclasses

import numpy as np
import pytest

from fitting.analysis.placement import SLIDE_LIMIT, VISIBLE, Soles
from fitting.datasets.clips import save_clip
from fitting.experiments.systems import Preset
from fitting.studies.animations import AnimationFiles, load_animation
from fitting.studies.fit import Fit
from fitting.studies.motions.fit_motions import saved_clips
from fitting.viewer import Solver, Subject, knobs, solving, subject_of_animation, subject_of_run
from fitting.viewer.feet import IN_GROUND, Sight, seen
from fitting.viewer.lines import Lines
from jaxik.maths import parameter_tree
from support import runs
from support.experiments import ROOT


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> Fit:
    return runs.with_clips(runs.invented_fit(tmp_path_factory.mktemp("experiment")))


@pytest.fixture(scope="module")
def subject(fitted, tmp_path_factory) -> Subject:
    run = tmp_path_factory.mktemp("run")
    runs.save(run, fitted)
    return subject_of_run(run)


@pytest.fixture(scope="module")
def solver(subject) -> Solver:
    return Solver(subject)


def ends(lines: Lines) -> np.ndarray:
    return lines.points.reshape(len(lines.points), -1, 3)


def test_a_run_begins_with_its_fit_and_goes_back_to_defaults(fitted, subject):
    assert list(subject.starts) == ["fitted", "before", "default"]
    for name in ("pelvis.on_gain", "foot.max_pitch"):
        shown = parameter_tree.get(subject.starts["fitted"], name)
        assert float(shown) == pytest.approx(float(parameter_tree.get(fitted.ik, name)))
    assert bool(parameter_tree.get(subject.starts["default"], "lock.enabled"))


def test_the_shown_motion_is_the_one_that_the_fit_has_kept(fitted, subject, solver):
    shown = ends(solver.solve(subject.starts["fitted"]).motion.bones)
    joints = saved_clips(fitted)["fitted.npz"].positions_ws
    gaps = np.linalg.norm(shown[:, :, None] - joints[:, None], axis=-1).min(axis=2)
    assert gaps.max() < 1e-9


def test_the_cost_is_what_the_fit_minimises(fitted, subject, solver):
    for name in ("fitted", "before"):
        u = fitted.problem.space.pack(subject.starts[name])
        expected = float(fitted.problem.cost(u))
        assert solver.solve(subject.starts[name]).cost == pytest.approx(expected, rel=1e-9)


def test_any_parameter_moves_the_feet_and_the_cost(subject, solver):
    ik = subject.starts["fitted"]
    (knob,) = [knob for knob in knobs(ik, subject.rig) if knob.name == "probe.ray_down"]
    before, after = solver.solve(ik), solver.solve(knob.write(ik, 0.0))
    assert np.abs(ends(after.motion.feet) - ends(before.motion.feet)).max() > 0.01
    assert after.cost != before.cost


def test_rays_end_where_the_ground_is_and_targets_where_ankles_are(subject, solver):
    solved = solver.solve(subject.starts["fitted"])
    rays = solved.overlays["rays"].points
    assert np.all(rays[..., 0, 1] >= rays[..., 1, 1])
    np.testing.assert_array_equal(rays[..., 0, [0, 2]], rays[..., 1, [0, 2]])
    centres = solved.overlays["targets"].points.mean(axis=2)
    ankles = solved.motion.feet.points[:, :2, 0]  # the first lines begin there
    assert np.linalg.norm(centres[:, ::3] - ankles, axis=-1).max() < 0.1
    for lines in (*solved.overlays.values(), solved.motion.bones):
        assert np.isfinite(lines.points).all() and lines.colours.dtype == np.uint8


def test_poses_that_are_not_finite_are_one_sentence(subject, solver, monkeypatch):
    def broken(clip, result, **placed):
        return clip.with_motion(clip.positions_ws * np.nan, clip.rotations_ws)

    monkeypatch.setattr(solving, "clip_from_result", broken)
    ik = subject.starts["fitted"]
    with pytest.raises(ValueError, match="not finite"):
        solver.solve(ik)


def test_deep_feet_are_red_and_sliding_ones_purple():
    sight = Sight(np.array([[0.0, VISIBLE, 0.0]]), np.array([[0.0, 0.0, SLIDE_LIMIT]]))
    plain, deep, slid = sight.colours((10, 20, 30))[0].tolist()
    assert plain == [10, 20, 30] and deep == list(IN_GROUND) and slid[0] > 200 < slid[2]


def test_a_slide_counts_from_the_beginning_of_its_stance(solver):
    clip = solver.take.animated
    stance = np.zeros((clip.frame_count, 2), bool)
    stance[1:4, 0] = True
    drift = np.arange(clip.frame_count)[:, None, None] * np.array([0.01, 0.0, 0.0])
    still = dataclasses.replace(clip, positions_ws=np.repeat(clip.positions_ws[:1], 7, axis=0))
    moved = dataclasses.replace(still, positions_ws=still.positions_ws + drift)
    soles = Soles(np.full((7, 2, 2), -0.03), np.zeros((7, 2, 2)), stance)
    sight = seen(soles, moved, still)
    np.testing.assert_allclose(sight.slide[:, 0], [0, 0, 0.01, 0.02, 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(sight.depth, 0.03)
    assert not sight.slide[:, 1].any()


def test_a_clip_is_shown_as_jaxik_run_solves_it(fitted, tmp_path):
    path = tmp_path / "flat.npz"
    save_clip(path, fitted.clips[0].base)
    files = AnimationFiles(path, ROOT / "data" / "terrains" / "uneven_walk.ply")
    subject = subject_of_animation(files, Preset("record"))
    assert list(subject.starts) == ["default"] and subject.cost is None
    shown = Solver(subject).solve(subject.starts["default"])
    _, solved = load_animation(files).solve(subject.starts["default"])
    np.testing.assert_allclose(shown.motion.feet.points[:, :2, 0], solved.joints_ws(2), atol=1e-9)
    assert shown.cost is None
