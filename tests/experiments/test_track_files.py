"""Track files: what changes along a clip, read from TOML."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from fitting.analysis import playback
from fitting.datasets.clip_frames import frames_from_clip
from fitting.datasets.clips import Clip, flight, load_clip, save_clip
from fitting.experiments import problems, track_files
from fitting.experiments.experiment import Experiment
from fitting.experiments.experiment_files import load_experiment
from fitting.problem.problem import Problem
from fitting.problem.scene import legs_ws, pelvis_ws
from fitting.studies.fit import search
from support import experiments

TEXT = """
[grounded]
times = [0.0, 0.2, 0.4]
values = [1, 1, 0]
[weight.left]
times = [0.0, 0.3]
values = [1, 0.5]
stepped = true
[pelvis.limit]
times = [0.1, 0.3]
values = [0.3, 0.1]
[foot.max_pitch]
times = [0.0]
values = [[0.5, 0.4]]
"""


@pytest.fixture(scope="module")
def clip() -> Clip:
    return load_clip("data/clips/uneven_walk_base.npz").select(slice(0, 30))


def test_tracks_are_linear_or_stepped_between_their_times(clip, tmp_path):
    path = tmp_path / "tracks.toml"
    path.write_text(TEXT)
    tracked, values = track_files.along(clip, path)
    seconds = np.arange(30) / clip.fps
    assert tracked.grounded is not None and tracked.weight is not None
    expected = np.interp(seconds, [0.0, 0.2, 0.4], [1.0, 1.0, 0.0])
    np.testing.assert_allclose(tracked.grounded, expected)
    left = list(clip.rig.names).index("left")
    np.testing.assert_array_equal(tracked.weight[:, left], np.where(seconds < 0.3 - 1e-9, 1, 0.5))
    assert (tracked.weight[:, 1 - left] == 1.0).all()
    np.testing.assert_allclose(values["pelvis.limit"], np.interp(seconds, [0.1, 0.3], [0.3, 0.1]))
    np.testing.assert_array_equal(values["foot.max_pitch"], np.tile([0.5, 0.4], (30, 1)))
    frames = frames_from_clip(tracked)
    np.testing.assert_allclose(frames.grounded, tracked.grounded, atol=1e-7)
    np.testing.assert_allclose(frames.weight, tracked.weight)
    later = track_files.along(clip, path, start=0.2)[1]["pelvis.limit"]
    assert later[0] == pytest.approx(0.2), "times count from the start of the file"


def test_a_wrong_track_file_is_refused_with_its_place(clip, tmp_path):
    path = tmp_path / "tracks.toml"
    for text, message in (
        ("[weight.middle]\ntimes=[0]\nvalues=[1]", r"unknown key 'middle'; nearest is .*'left'"),
        ("[grounded]\ntimes=[0]\nvalues=[2]", r"\[grounded\]: values are outside 0 to 1"),
        ("[grounded]\ntimes=[0, 1]\nvalues=[1]", "2 times and 1 values; wanted as many"),
        ("[grounded]\ntimes=[1, 0]\nvalues=[1, 1]", "wanted them ascending"),
        ("[grounded]\ntime=[1, 0]\nvalues=[1, 1]", "unknown key 'time'; nearest is 'times'"),
        ("[grounded]\ntimes=[1]", "there are no values"),
        ("grounded = 1", r"\[grounded\] is 1; wanted a table"),
        ("[pelvis.limit]\ntimes=['a']\nvalues=[1]", "wanted numbers"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=message):
            track_files.along(clip, path)


def jump(height: float, seconds: float) -> Clip:
    """A standing clip whose body is in the air for some time, on a parabola."""
    clip = load_clip("data/clips/stop_and_go_base.npz").select(np.zeros(180, int))
    time = np.clip((np.arange(180) / clip.fps - 1.0) / seconds, 0.0, 1.0)
    positions = clip.positions_ws.copy()
    positions[..., 1] += (4.0 * height * time * (1.0 - time))[:, None]
    return clip.with_motion(positions, clip.rotations_ws)


def test_a_jump_is_found_and_a_runners_flight_is_not():
    clip = jump(0.3, 0.5)
    grounded = flight.grounded_track(dataclasses.replace(clip, stance=None))
    in_the_air = np.flatnonzero(grounded == 0.0) / clip.fps
    assert 1.0 < in_the_air[0] < 1.1 and 1.3 < in_the_air[-1] < 1.5
    assert "1.0" in flight.describe(dataclasses.replace(clip, stance=None))
    run = dataclasses.replace(jump(0.12, 0.2), stance=None)
    assert (flight.grounded_track(run) == 1.0).all() and flight.describe(run) == ""


def test_tracks_of_a_clip_survive_its_file_and_its_edits(clip, tmp_path):
    grounded, weight = np.linspace(0.0, 1.0, 30), np.full((30, 2), 0.5)
    path = tmp_path / "clip.npz"
    save_clip(path, dataclasses.replace(clip, grounded=grounded, weight=weight))
    loaded = load_clip(path)
    np.testing.assert_array_equal(loaded.grounded, grounded)
    np.testing.assert_array_equal(loaded.select(slice(3, 9)).weight, weight[3:9])
    whole = dict(np.load(path))
    for change, message in (
        (
            {"weight": weight[:, :1]},
            r"weight is \(30, 1\); wanted \(frames, legs\), here \(30, 2",
        ),
        ({"grounded": grounded + 0.1}, r"grounded has 1\.\d+ at \[\d+\]; wanted 0 to 1"),
    ):
        arrays: dict[str, Any] = whole | change
        np.savez(path, **arrays)
        with pytest.raises(ValueError, match=message):
            load_clip(path)


def test_a_free_parameter_on_a_track_is_refused(tmp_path):
    (tmp_path / "tracks.toml").write_text("[pelvis.on_gain]\ntimes = [0.0]\nvalues = [0.2]\n")
    path = experiments.write(tmp_path, clip='tracks = "tracks.toml"\n')
    with pytest.raises(ValueError, match=r"\['pelvis.on_gain'\] cannot be free: a track of"):
        problems.make_problem(load_experiment(path))


TRUTH = 0.35


@pytest.fixture(scope="module")
def tracked(tmp_path_factory) -> tuple[Experiment, Problem]:
    """A second in which a track limits the pelvis, which moves with a known gain."""
    folder = tmp_path_factory.mktemp("tracked")
    text = "[pelvis.limit]\ntimes = [1.0, 1.4, 1.8]\nvalues = [0.3, 0.02, 0.3]\n"
    (folder / "tracks.toml").write_text(text)
    path = experiments.write(
        folder,
        top="faithful = true",  # its pelvis follows ankles far enough for the limit to act
        clip='tracks = "tracks.toml"\nmask_pops = false\n',
        free="pelvis.on_gain = {}\n",
    )
    experiment = load_experiment(path)
    problem = problems.make_problem(experiment)
    (scene,) = problem.data
    ik = problem.space.unpack(problem.space.pack({"pelvis.on_gain": TRUTH}))
    result = playback.run(ik, scene)
    moved, legs = pelvis_ws(scene, result), legs_ws(scene, result)
    reference = dataclasses.replace(
        scene.reference, pelvis=moved, knee_ws=legs.knee.pos, ankle=legs.ankle
    )
    scene = dataclasses.replace(scene, reference=reference)
    return experiment, dataclasses.replace(problem, data=(scene,))


def test_the_cost_follows_the_track(tracked):
    _, problem = tracked
    truth = problem.space.pack({"pelvis.on_gain": TRUTH})
    assert problem.cost(truth) < 0.05, "only the prior's part is left"
    tracks = {"pelvis.limit": np.full_like(problem.data[0].tracks["pelvis.limit"], 0.3)}
    constant = dataclasses.replace(problem.data[0], tracks=tracks)
    assert dataclasses.replace(problem, data=(constant,)).cost(truth) > 1.0


@pytest.mark.slow
def test_a_fit_with_a_track_recovers_a_known_truth(tracked):
    experiment, problem = tracked
    solution = search(problem, experiment)
    assert problem.space.values(solution.u)[0] == pytest.approx(TRUTH, abs=5e-3)
