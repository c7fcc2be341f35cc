"""Parts of an experiment: hierarchies of clips, tracks, fits of what the game's record holds."""

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from fitting.cli import main
from fitting.clips import Clip, flight, load_clip, save_clip
from fitting.clips.clip_frames import frames_from_clip
from fitting.experiment import parameter_files, record_files, track_files
from fitting.experiment.experiment_files import experiment_to_toml, load_experiment
from fitting.experiment.file_tables import Hierarchy
from fitting.experiment.problems import load_clip_data, make_problem
from fitting.experiment.systems import Preset
from fitting.motion import playback
from fitting.problem.scene import legs_ws, pelvis_ws
from fitting.problem.shared_world import run_scene
from fitting.report.document import Grid, Text
from fitting.runtime.program_cache import committed
from fitting.studies import ablation, animations
from fitting.studies.animations import AnimationFiles
from fitting.studies.fit import fit_jobs
from fitting.studies.fit.fit import Fit
from jaxik import presets, record
from jaxik.maths import parameter_tree
from jaxik.world import body
from support.bodies import scaled
from support.experiments import CLIP, ROOT, write
from support.watching import listening

# Frames that are held out

PARTS = {"first": f"{CLIP}end = 4.0\n", "second": f"{CLIP}start = 5.0\nend = 7.0\n"}


@pytest.mark.parametrize(
    ("top", "more", "fitted"),
    [
        ("holdout = 0.25", "", (0.75, 1.0)),
        ("", "", (2 / 3, 1.0)),
        ("", "held_out = true\n", (1, 0)),
    ],
)
def test_the_end_of_a_long_clip_is_held_out_or_a_whole_clip(tmp_path, top, more, fitted):
    clips = "".join(PARTS.values()) + more
    experiment = load_experiment(write(tmp_path, top=f"fps = 15\n{top}", clips=clips))
    for scene, share in zip(make_problem(experiment).data, fitted, strict=True):
        frames = np.arange(scene.frames.dt.size)
        np.testing.assert_array_equal(scene.reference.observed, frames < share * frames.size - 0.5)
        np.testing.assert_array_equal(scene.reference.held_out, ~scene.reference.observed)


def test_what_cannot_be_fitted_is_refused(tmp_path):
    experiment = load_experiment(write(tmp_path))
    alone = replace(experiment.clips[0], held_out=True)
    for changed, message in (
        ({"clips": (alone,)}, "all clips are held out; wanted one that is not"),
        (
            {"sigmas": {"foot": 0.001}},
            r"\[sigmas\]: foot is 0.001; wanted 0.00175 or more \(m, rad",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            replace(experiment, **changed)


# Hierarchies, and parameters that follow the body

BASE = ROOT / "data" / "clips" / "uneven_walk_base.npz"


def load(tmp_path, table: str, *subjects: str | None, top: str = ""):
    """An experiment with as many clips of a tenth of a second."""
    clips = ""
    for number, subject in enumerate(subjects):
        clips += f"{CLIP}start = {number}.0\nend = {number}.1\n"
        clips += f'subject = "{subject}"\n' if subject else ""
    return load_experiment(write(tmp_path, clips=clips, rest=f"[hierarchy]\n{table}", top=top))


def test_a_hierarchy_is_read_and_written_again_and_without_one_nothing_is_scaled(tmp_path):
    table = 'per_subject = ["foot.max_pitch"]\nper_clip = ["pelvis.half_life"]\n'
    experiment = load(tmp_path, table + "scale_with_body = true", "ann", "ben", "ann")
    assert experiment.hierarchy == Hierarchy(("foot.max_pitch",), ("pelvis.half_life",), True)
    (tmp_path / "again.toml").write_text(experiment_to_toml(experiment))
    again = load_experiment(tmp_path / "again.toml")
    assert again.hierarchy == experiment.hierarchy and again.clips == experiment.clips
    names = ("pelvis.half_life", "leg.soften", "foot.max_pitch")
    grouping = experiment.hierarchy.grouping(names, ("x", "y", "z"), ("ann", "ben", "ann"))
    np.testing.assert_array_equal(grouping.group, [[0, -1, 0], [1, -1, 1], [2, -1, 0]])
    without = load(tmp_path, "", None)
    assert without.hierarchy == Hierarchy() and "per_clip" not in experiment_to_toml(without)
    assert Hierarchy().grouping(names, ("x", "y"), ("x", "y")).varying == ()
    assert make_problem(without).data[0].size is None


def test_a_wrong_hierarchy_is_refused(tmp_path):
    both = 'per_clip = ["foot.max_pitch"]\nper_subject = ["foot.max_pitch"]'
    subject = 'per_subject = ["foot.max_pitch"]'
    for table, subjects, message in (
        ("per_clips = []", ("ann",), "unknown key 'per_clips'; nearest is 'per_clip'"),
        ('per_clip = "foot.max_pitch"', ("ann", "ben"), "wanted a list of names"),
        ('per_clip = ["foot.max_roll"]', ("ann", "ben"), "'foot.max_roll' is not free; free are"),
        (both, ("ann", "ben"), "'foot.max_pitch' stands twice; wanted it per clip or per subject"),
        ('per_clip = ["foot.max_pitch"]', ("ann",), "per_clip needs two clips or more"),
        (subject, ("ann", None), r"in each of \[\[clips\]\]; clip 2 h"),
        (subject, ("ann", "ann"), "all clips are of 'ann'"),
        ("scale_with_body = 1", ("ann",), "scale_with_body is 1; wanted true or false"),
    ):
        with pytest.raises(ValueError, match=rf"\[hierarchy\].*{message}"):
            load(tmp_path, table, *subjects)


@pytest.mark.parametrize("meant_for", ["clip", "adult"])
def test_each_clip_has_the_size_of_its_body_over_the_one_that_numbers_are_for(tmp_path, meant_for):
    experiment = load(tmp_path, "scale_with_body = true", None, top=f'body = "{meant_for}"')
    (scene,) = make_problem(experiment).data
    ratio, length = 1.0, body.leg_length(scene.rig)
    if meant_for == "adult":
        ratio, length = body.ratio(scene.rig), body.LEG
    giant = scaled(load_clip(BASE), 2.0).rig
    assert experiment.size(giant, scene.rig) == pytest.approx(2.0 * ratio)
    assert scene.size is not None and float(scene.size) == pytest.approx(ratio)
    assert experiment.leg_length(scene.rig) == pytest.approx(length)


def test_a_parameter_file_with_a_leg_length_follows_the_body_that_it_is_read_for(tmp_path):
    ik = parameter_tree.replace(presets.ozz(), {"target.foot_height": 0.1, "root.half_life": 0.2})
    path = tmp_path / "ozz.toml"
    path.write_text(parameter_files.system_to_toml(ik, Preset("ozz"), 0.84))
    assert "leg_length = 0.84" in path.read_text()
    same, _ = parameter_files.load_system(path)
    assert float(parameter_tree.get(same, "target.foot_height")) == pytest.approx(0.1)
    giant = scaled(load_clip(BASE), 4.0).rig
    other, _ = parameter_files.load_system(path, giant)
    ratio = body.leg_length(giant) / 0.84
    expected = {"target.foot_height": 0.1 * ratio, "root.half_life": 0.2 * ratio**0.5}
    for name, value in expected.items():
        assert float(parameter_tree.get(other, name)) == pytest.approx(value)
    assert jnp.isinf(parameter_tree.get(other, "pelvis.limit"))
    path.write_text('preset = "ozz"\nleg_length = 0.0\n')
    with pytest.raises(ValueError, match="leg_length is 0.0; wanted a number of metres from"):
        parameter_files.load_system(path)


def test_a_run_is_applied_to_the_body_of_the_animation(tmp_path, monkeypatch):
    ik = parameter_tree.replace(presets.ozz(), {"target.foot_height": 0.1})
    text = parameter_files.system_to_toml(ik, Preset("ozz"), 0.84)
    (tmp_path / "parameters.toml").write_text(text)
    row = {"name": "target.foot_height", "unit": "m", "u": 0.0, "start_sd": 1.0, "value": 0.1}
    rows = [row | {"determined": True}]
    (tmp_path / "fit.json").write_text(json.dumps({"parameters": rows}))
    save_clip(tmp_path / "giant.npz", scaled(load_clip(BASE), 2.0))
    applied = []
    monkeypatch.setattr(animations, "solve", lambda ik, *_, **__: applied.append(ik))
    files = AnimationFiles(tmp_path / "giant.npz", tmp_path / "unused.ply")
    animations.apply(tmp_path, files)
    ratio = body.leg_length(files.flat_clip.rig) / 0.84
    height = float(parameter_tree.get(applied[0], "target.foot_height"))
    assert height == pytest.approx(0.1 * ratio) and ratio > 1.9


def test_an_ablation_measures_each_clip_with_its_body(tmp_path, monkeypatch):
    experiment = replace(load(tmp_path, "scale_with_body = true", None), free={})
    clip = load_clip_data(experiment.clips[0], None)
    giant = clip._replace(base=scaled(clip.base, 2.0))
    rays = []

    def solve(animation, ik):
        rays.append(float(parameter_tree.get(ik, "probe.ray_up")))
        return None, animation.clip

    monkeypatch.setattr(animations.Animation, "solve", solve)
    measured = [(clip, slice(None)), (giant, slice(None))]
    split = ablation.Split("", [], measured)
    ablation._fit(ablation.Task("", "", experiment, 0, split))
    assert rays[1] == pytest.approx(2.0 * rays[0], rel=1e-4)


# Tracks: what changes along a clip

TEXT = """
grounded = { times = [0.0, 0.2, 0.4], values = [1, 1, 0] }
weight.left = { times = [0.0, 0.3], values = [1, 0.5], stepped = true }
pelvis.limit = { times = [0.1, 0.3], values = [0.3, 0.1] }
foot.max_pitch = { times = [0.0], values = [[0.5, 0.4]] }
"""


@pytest.fixture(scope="module")
def clip() -> Clip:
    return load_clip(BASE).select(slice(0, 30))


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


def test_a_wrong_track_file_and_a_free_parameter_on_a_track_are_refused(clip, tmp_path):
    path = tmp_path / "tracks.toml"
    for text, message in (
        ("[weight.middle]\ntimes=[0]\nvalues=[1]", r"unknown key 'middle'; nearest is .*'left'"),
        ("[grounded]\ntimes=[0]\nvalues=[2]", r"\[grounded\]: values are outside 0 to 1"),
        ("[grounded]\ntimes=[0, 1]\nvalues=[1]", "2 times and 1 values; wanted as many"),
        ("[grounded]\ntimes=[1, 0]\nvalues=[1, 1]", "wanted them ascending"),
        ("[grounded]\ntime=[1, 0]\nvalues=[1, 1]", "unknown key 'time'; nearest is 'times'"),
        ("[grounded]\ntimes=[1]", "values is missing; it needs times and values"),
        ("grounded = 1", r"\[grounded\] is 1; wanted a table"),
        ("[pelvis.limit]\ntimes=['a']\nvalues=[1]", "wanted numbers"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=message):
            track_files.along(clip, path)
    path.write_text("[pelvis.half_life]\ntimes = [0.0]\nvalues = [0.2]\n")
    experiment = load_experiment(write(tmp_path, clip='tracks = "tracks.toml"\n'))
    with pytest.raises(ValueError, match=r"\['pelvis.half_life'\] cannot be free: a track of"):
        make_problem(experiment)


def jump(height: float, seconds: float) -> Clip:
    """A standing clip whose body is in the air for some time, on a parabola."""
    clip = load_clip("data/clips/stop_and_go_base.npz").select(np.zeros(180, int))
    time = np.clip((np.arange(180) / clip.fps - 1.0) / seconds, 0.0, 1.0)
    positions = clip.positions_ws.copy()
    positions[..., 1] += (4.0 * height * time * (1.0 - time))[:, None]
    return clip.with_motion(positions, clip.rotations_ws)


def test_a_jump_is_found_and_a_runners_flight_is_not():
    leap, run = (replace(jump(*way), stance=None) for way in ((0.3, 0.5), (0.12, 0.2)))
    in_the_air = np.flatnonzero(flight.grounded_track(leap) == 0.0) / leap.fps
    assert 1.0 < in_the_air[0] < 1.1 and 1.3 < in_the_air[-1] < 1.5
    assert "1.0" in flight.describe(leap)
    assert (flight.grounded_track(run) == 1.0).all() and flight.describe(run) == ""


def test_tracks_of_a_clip_survive_its_file_and_its_edits(clip, tmp_path):
    grounded, weight = np.linspace(0.0, 1.0, 30), np.full((30, 2), 0.5)
    path = tmp_path / "clip.npz"
    save_clip(path, replace(clip, grounded=grounded, weight=weight))
    loaded = load_clip(path)
    np.testing.assert_array_equal(loaded.grounded, grounded)
    np.testing.assert_array_equal(loaded.select(slice(3, 9)).weight, weight[3:9])
    whole = dict(np.load(path))
    for change, message in (
        ({"weight": weight[:, :1]}, r"is \(30, 1\); wanted \(frames, legs\), here \(30, 2"),
        ({"grounded": grounded + 0.1}, r"grounded has 1\.\d+ at \[\d+\] of .frames.; wanted 0 to"),
    ):
        changed: dict[str, Any] = whole | change
        np.savez(path, **changed)
        with pytest.raises(ValueError, match=message):
            load_clip(path)


@pytest.mark.slow
def test_the_cost_follows_the_track(tmp_path):
    """Of a second in which a track limits the pelvis, which moves with a known half-life."""
    text = "[pelvis.limit]\ntimes = [1.0, 1.4, 1.8]\nvalues = [0.3, 0.02, 0.3]\n"
    (tmp_path / "tracks.toml").write_text(text)
    path = write(
        tmp_path,
        top="faithful = true",  # its pelvis follows ankles far enough for the limit to act
        clip='tracks = "tracks.toml"\nmask_pops = false\n',
        free="pelvis.half_life = {}\n",
    )
    problem = make_problem(load_experiment(path))
    (scene,) = problem.data
    truth = problem.space.pack({"pelvis.half_life": 0.35})

    @jax.jit
    def motion_and_cost(problem):
        """Of one run: it takes long to compile."""
        (scene,) = problem.data
        result = run_scene(problem.space.unpack(truth), scene)
        with mock.patch.object(jaxik, "run", return_value=result):
            return pelvis_ws(scene, result), legs_ws(scene, result), problem.cost(truth)

    moved, legs, _ = motion_and_cost(problem)
    reference = replace(scene.reference, pelvis=moved, knee_ws=legs.knee.pos, ankle=legs.ankle)
    scene = replace(scene, reference=reference)
    tracks = {"pelvis.limit": jnp.full_like(scene.tracks["pelvis.limit"], 0.3)}
    both = committed([replace(problem, data=(s,)) for s in (scene, replace(scene, tracks=tracks))])
    costs = [motion_and_cost(each)[2] for each in both]
    assert costs[0] < 0.05, "only the prior's part is left"
    assert costs[1] > 1.0


# Fits of the record alone: nothing is lost between the fit and the bytes

TOP = 'preset = "record"\nfaithful = true\nbody = "adult"\n'
FREE = 'foot.max_pitch = {}\nlock.max_speed = {}\n"probe.toe_ls[1]" = {}\n'


def restricted(tmp_path, **parts):
    parts = {"top": f"{TOP}record_only = true", "free": FREE} | parts
    return load_experiment(write(tmp_path, **parts))


def test_what_the_record_has_no_room_for_is_not_free_but_what_its_reader_assumes(
    tmp_path, monkeypatch
):
    other = "[parameters]\nlock.lock_half_life = 0.02\nprobe.limited = true\nfoot.max_roll = 0.2"
    experiment = restricted(tmp_path, rest=other)
    assert list(experiment.free) == ["foot.max_pitch", "probe.toe_ls[1]"]
    assert record_files.left_out(experiment) == ["lock.max_speed"]
    ik = experiment.starting_system()
    assert record.dropped(ik) == {}
    assert float(parameter_tree.get(ik, "foot.max_roll")) == pytest.approx(0.2)
    aside = record_files.set_aside(experiment)
    assert aside["lock.lock_half_life"] == ("0.02 s", "0.05 s") and "probe.limited" in aside
    fitted = []
    monkeypatch.setattr("fitting.jobs.fit", lambda entry, *_, **__: fitted.append(entry))
    monkeypatch.setattr("fitting.cli.status.of_fit", lambda _: 0)
    words = ["fit", str(write(tmp_path, top=TOP, free=FREE)), "-o", str(tmp_path)]
    assert main.main([*words, "--record-only"]) == main.main(words) == 0
    assert [experiment.record_only for experiment in fitted] == [True, False]


def test_a_restricted_experiment_is_the_same_when_read_again_or_refused_if_it_could_be_no_record(
    tmp_path,
):
    of_both = "foot.max_pitch = {0}\nlock.max_speed = {0}\n"
    rest = f"[prior]\n{of_both.format('{ spread = 1.0 }')}[start]\n{of_both.format(0.4)}"
    experiment = restricted(tmp_path, rest=rest)
    assert list(experiment.start) == list(experiment.prior.named) == ["foot.max_pitch"]
    again = tmp_path / "again.toml"
    again.write_text(experiment_to_toml(experiment))
    loaded = load_experiment(again)
    for field in ("free", "parameters", "start", "prior"):
        assert getattr(loaded, field) == getattr(experiment, field)
    assert record_files.left_out(loaded) == []
    for parts, message in (
        ({"top": "record_only = true"}, "preset = 'record' with faithful = false;"),
        ({"top": 'preset = "ozz"\nrecord_only = true'}, "preset = 'ozz' with faithful = false;"),
        ({"rest": '[rules]\npelvis = "SupportPelvis"'}, "others: {'pelvis': 'SupportPelvis'}"),
        ({"rest": "[hierarchy]\nscale_with_body = true"}, "same for every body"),
        ({"free": "lock.max_speed = {}"}, r"no room for any of \['lock.max_speed'\]; it has for"),
        ({"rest": "[parameters]\nfoot.max_roll = [0.1, 0.2]"}, "one value for all legs"),
    ):
        with pytest.raises(ValueError, match=rf"experiment.toml: .*{message}"):
            restricted(tmp_path, **parts)


@pytest.mark.slow
def test_the_price_is_that_of_one_search_with_all_that_was_free(tmp_path, monkeypatch):
    rest = "[start]\nfoot.max_pitch = 0.5\ntarget.rise_half_life = 0.1"
    clip = "end = 2.97"  # as long as one that tests/studies/test_drafts.py runs: one program
    free = 'foot.max_pitch = {}\n"probe.toe_ls[1]" = {}\ntarget.rise_half_life = {}\n'
    experiment = restricted(tmp_path, rest=rest, free=free, clips=CLIP + clip)
    problem = make_problem(experiment)
    (scene,), names, values = problem.data, problem.space.names, np.array([0.4, -0.05])
    solution: Any = SimpleNamespace(names=names, values=values, cost=3.0, interrupted=False)
    solution.u = problem.space.pack(dict(zip(names, values, strict=True)))
    fitted = Fit(experiment, problem, solution, cast(Any, None))
    searches, lines = [], []

    def search(problem, settings, start) -> Any:
        searches.append((settings.fit.starts, *problem.space.values(start)))
        return SimpleNamespace(u=start + [0.0, 0.0, 2.0], cost=2.0, interrupted=False)

    monkeypatch.setattr(fit_jobs, "search", search)
    price = fit_jobs.measure_record_price(fitted)
    assert price is not None and searches == [pytest.approx((1, 0.4, -0.05, 0.1))]
    assert (price.left_out, price.cost, price.whole_cost) == (("target.rise_half_life",), 3.0, 2.0)
    play = playback.play(scene, playback.run(fitted.ik, scene))
    ankle = np.sqrt(np.mean(play.errors["ankle"] ** 2))
    assert price.errors["ankle"][0] == pytest.approx(ankle)
    assert price.errors["ankle"][1] != pytest.approx(ankle)
    with listening(lines.append):
        (section,) = fit_jobs._price_of_record(fitted)
    sentence, table = section.blocks
    assert isinstance(sentence, Text) and isinstance(table, Grid)
    assert lines == ["what the record costs: a search in which target.rise_half_life are free, too"]
    said = "The cost is 3; with these free, too, a search from there ends at 2."
    assert said in sentence.text and "not target.rise_half_life: " in sentence.text
    assert table.rows[1][:2] == ["Ankle position", f"{100 * ankle:.4g} cm"]
