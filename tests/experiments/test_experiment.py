"""Experiment files, and the problems they make."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import jaxik
from fitting.datasets.clips import load_clip, save_clip
from fitting.experiments import experiment, experiment_files, problems
from jaxik.maths import parameter_tree
from support.experiments import CLIP, ROOT, SECOND, UNEVEN_WALK, write

MISTAKES = [
    ({"top": "fobs = 3"}, "unknown key 'fobs'; nearest is 'fps' of"),
    ({"top": "fps = -1"}, "fps is -1; wanted a finite number above 0"),
    ({"top": "fps = 'x'"}, "fps is 'x'; wanted a finite number above 0"),
    ({"top": "seed = 1.5"}, "seed is 1.5; wanted a whole number from 0"),
    ({"top": "seed = -1"}, "seed is -1; wanted a whole number from 0"),
    ({"top": "name = 3"}, "name is 3; wanted a text"),
    ({"top": "loss = 'l2'"}, "loss is 'l2'; wanted one of .'squares', 'huber', 'cauchy'."),
    ({"top": "preset = 'recrod'"}, r"no preset named 'recrod'; there are \['mec', 'ozz', 'rec"),
    ({"top": "sigmas = 3"}, "sigmas is 3; wanted a table"),
    ({"clips": ""}, "there is no .clips."),
    ({"clips": "clips = 3\n"}, r"clips is 3; wanted \[\[clips\]\]"),
    ({"clips": "[clips]\nterrain = 'x'\n"}, r"clips is .*; wanted \[\[clips\]\]"),
    ({"clips": "clips = [1]\n"}, r"\[\[clips\]\] is 1; wanted a table"),
    ({"clips": "[[clips]]\nterrain = 'x'\n"}, "there is no reference"),
    ({"clips": "[[clips]]\nterrain = 'x'\nreference = 'y'\n"}, "reference 'y': no such file"),
    ({"clips": "[[clips]]\nterrain = 'x'\nreference = '.'\n"}, "reference '.': a folder"),
    ({"clip": "bse = 'x'"}, "unknown key 'bse'; nearest is 'base' of"),
    ({"clip": "truth = 'no.toml'"}, "truth 'no.toml': no such file"),
    ({"clip": "file_up = 'x'"}, "file_up is 'x'; wanted one of .'y', 'z'."),
    ({"clips": CLIP, "clip": "start = 'x'"}, "start is 'x'; wanted a number of seconds"),
    ({"clips": CLIP, "clip": "start = -1"}, "start is -1; wanted a number of seconds"),
    ({"free": ""}, "there is no .free."),
    ({"free": "pelvis.on_gain = 3"}, "pelvis.on_gain is 3; wanted a table"),
    ({"free": "pelvis.on_gain = { lo = 1 }"}, "unknown key 'lo'; nearest is 'low'"),
    ({"free": "pelvis.on_gain = { low = 'x' }"}, "low is 'x'; wanted a number"),
    ({"free": "pelvis.on_gain = { low = nan }"}, "low is nan; wanted a number"),
    ({"free": "pelvis.on_gain = { prior_sd = 0 }"}, "prior_sd is 0; wanted a number above 0"),
    ({"rest": "[sigmas]\nankel = 1"}, "unknown key 'ankel'; nearest is 'ankle'"),
    ({"rest": "[sigmas]\nankle = nan"}, "ankle is nan; wanted a number above 0"),
    ({"rest": "[sigmas]\nankle = true"}, "ankle is True; wanted a number above 0"),
    ({"rest": "[sigmas]\nankle = 0"}, "ankle is 0; wanted a number above 0"),
    ({"rest": "[sigmas]\ncorrelation = 1.0"}, "correlation is 1.0; wanted .* below 1"),
    ({"rest": "[fit]\nstarts = 0"}, "starts is 0; wanted a whole number above 0"),
    ({"rest": "[fit]\nstarts = 1.5"}, "starts is 1.5; wanted a whole number above 0"),
    ({"rest": "[fit]\nmaxsteps = 1"}, "unknown key 'maxsteps'; nearest is 'max_steps'"),
    ({"rest": "[sample]\nwalkers = 5"}, "walkers is 5, wanted an even number from 4"),
    ({"rest": "[sample]\nwalkers = 2"}, "walkers is 2, wanted an even number from 4"),
    ({"rest": "[sample]\nstop_at = 'x'"}, "stop_at is 'x'; wanted a number above 0"),
]
MISFITS = [  # found when the problem is made
    ({"free": "pelvis.on_gian = {}"}, r"\[free\]: no parameter named 'pelvis.on_gian'; nearest is"),
    ({"free": "pelvis = {}"}, "no parameter named 'pelvis'; nearest is 'pelvis"),
    ({"free": "lock.enabled = {}"}, "no parameter named 'lock.enabled'"),
    ({"free": 'foot."max_pitch[7]" = {}'}, r"no element 'foot.max_pitch\[7\]'"),
    ({"free": "pelvis.on_gain = { kind = 'rough' }"}, "kind is 'rough', wanted one of"),
    ({"free": "pelvis.on_gain = { low = 0.5, high = 0.1 }"}, "bounds are 0.5 to 0.1"),
    ({"free": "contact.raised_height = { high = 0.05 }"}, r"\[free\]: contact.raised_height stays"),
    ({"rest": "[parameters]\nlock.speed = 1.0"}, r"\[parameters\]: unknown key 'lock.speed'"),
    ({"rest": "[parameters]\nlean.gain = [0.1, 0.2]"}, "lean.gain has 2 values; wanted one for"),
    (
        {"rest": "[parameters]\nfoot.max_roll = [1, 2, 3]"},
        "max_roll has 3 values; .* 2 for",
    ),
    ({"clips": CLIP, "clip": "start = 3.0\nend = 1.0"}, "uneven_walk.npz: trim from 3.0 s to 1.0"),
    ({"clips": CLIP, "clip": "end = 100.0"}, "uneven_walk.npz: trim from 0.0 s to 100.0 s"),
]


def test_the_embedded_experiment_is_read_as_it_stands():
    read = experiment_files.load_experiment(UNEVEN_WALK)
    assert (read.name, read.preset, read.loss, read.seed) == ("uneven walk", "record", "squares", 0)
    (clip,) = read.clips
    paths = (clip.reference, clip.base, clip.terrain, clip.truth)
    assert all(path is not None and path.is_absolute() and path.is_file() for path in paths)
    assert len(read.free) >= 12 and read.free["pelvis.on_gain"] == {}
    assert read.parameters["lean.gain_slide"] == 0.15
    assert read.sigmas["ankle"] == 0.002


def test_what_a_file_leaves_out_has_defaults_and_its_name_is_the_file_s(tmp_path):
    read = experiment_files.load_experiment(write(tmp_path, "hill.toml"))
    assert read.name == "hill" and read.fps is None and read.parameters == {}
    assert read.fit == experiment.FitOptions() and read.sample == experiment.SampleOptions()
    assert read.free == {"pelvis.on_gain": {}, "foot.max_pitch": {"low": 0.1}}


@pytest.mark.parametrize(("parts", "said"), MISTAKES)
def test_a_mistake_in_the_file_is_told_with_what_was_wanted(tmp_path, parts, said):
    with pytest.raises(ValueError, match=f"experiment.toml.*{said}"):
        experiment_files.load_experiment(write(tmp_path, **parts))


@pytest.mark.parametrize(("parts", "said"), MISFITS)
def test_what_does_not_fit_the_preset_or_the_clips_is_told(tmp_path, parts, said):
    read = experiment_files.load_experiment(write(tmp_path, **parts))
    with pytest.raises(ValueError, match=said):
        problems.make_problem(read)


def test_a_file_that_is_not_there_or_no_toml_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no.toml: no such file, wanted an experiment file"):
        experiment_files.load_experiment(tmp_path / "no.toml")
    with pytest.raises(ValueError, match="a folder, wanted an experiment file"):
        experiment_files.load_experiment(tmp_path)
    (tmp_path / "bad.toml").write_text("clips = [")
    with pytest.raises(ValueError, match="bad.toml: not TOML"):
        experiment_files.load_experiment(tmp_path / "bad.toml")


def test_paths_are_meant_from_beside_the_file_wherever_it_is_called_from(tmp_path, monkeypatch):
    for name in ("clips/uneven_walk.npz", "terrains/uneven_walk.ply"):
        (tmp_path / Path(name).name).symlink_to(ROOT / "data" / name)
    clips = '[[clips]]\nreference = "uneven_walk.npz"\nterrain = "uneven_walk.ply"\n'
    path = write(tmp_path, clips=clips)
    monkeypatch.chdir("/")
    (clip,) = experiment_files.load_experiment(path).clips
    assert clip.reference.is_absolute() and clip.base is None


def test_the_fixed_parameters_are_in_the_system_and_the_free_ones_start_at_its_values(tmp_path):
    parts = {"rest": "[parameters]\nlock.enabled = false\nfoot.max_pitch = [0.3, 0.5]"}
    problem = problems.make_problem(experiment_files.load_experiment(write(tmp_path, **parts)))
    base = problem.space.system
    assert not parameter_tree.get(base, "lock.enabled")
    np.testing.assert_array_equal(parameter_tree.get(base, "foot.max_pitch"), [0.3, 0.5])
    start = dict(zip(problem.space.names, problem.space.values(problem.space.u0), strict=True))
    preset = jaxik.presets.record()
    assert float(start["pelvis.on_gain"]) == pytest.approx(
        float(parameter_tree.get(preset, "pelvis.on_gain"))
    )
    assert float(start["foot.max_pitch"]) == pytest.approx(0.4)


def test_a_scene_holds_the_clips_cut_and_resampled_alike(tmp_path):
    read = experiment_files.load_experiment(write(tmp_path, top="fps = 15.0"))
    (scene,) = problems.make_problem(read).data
    assert scene.frames.dt.shape == (16,) and float(scene.frames.dt[0]) == pytest.approx(1 / 15)
    reference = load_clip(ROOT / "data/clips/uneven_walk.npz")
    base = load_clip(ROOT / "data/clips/uneven_walk_base.npz")
    frames = slice(30, 61, 2)
    ankles = reference.joints_ws(2)[frames]
    np.testing.assert_allclose(scene.reference.ankle.pos, ankles, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(scene.reference.contact, reference.stance_labels()[frames])
    world = scene.frames.world_from_model
    np.testing.assert_allclose(
        (world @ scene.pelvis).pos, base.positions_ws[frames, base.rig.pelvis], atol=1e-9
    )
    assert scene.reference.observed.all()


def test_a_marker_pop_is_not_seen(tmp_path):
    clip = load_clip(ROOT / "data/clips/uneven_walk.npz")
    positions = clip.positions_ws.copy()
    positions[45, clip.rig.joints[0][2]] += 0.2
    save_clip(tmp_path / "popped.npz", dataclasses.replace(clip, positions_ws=positions))
    clips = CLIP.replace(f"{ROOT}/data/clips/uneven_walk.npz", "popped.npz") + SECOND
    read = experiment_files.load_experiment(write(tmp_path, clips=clips))
    (scene,) = problems.make_problem(read).data
    assert (
        not scene.reference.observed[15]
        and np.asarray(scene.reference.observed)[[0, 12, 18, 30]].all()
    )
    resampled = dataclasses.replace(read, fps=15.0)
    assert not problems.make_problem(resampled).data[0].reference.observed[7]


def test_contacts_are_held_against_labels_only(tmp_path):
    clip = load_clip(ROOT / "data/clips/uneven_walk.npz")
    save_clip(tmp_path / "bare.npz", dataclasses.replace(clip, stance=None))
    clips = CLIP.replace(f"{ROOT}/data/clips/uneven_walk.npz", "bare.npz") + SECOND
    rest = "[sigmas]\ncontact = 0.5"
    with_labels = problems.make_problem(
        experiment_files.load_experiment(write(tmp_path, rest=rest))
    )
    read = experiment_files.load_experiment(write(tmp_path, rest=rest, clips=clips))
    assert float(with_labels.data[0].sigmas.contact) == 0.5
    assert np.isinf(problems.make_problem(read).data[0].sigmas.contact)


def test_without_a_base_a_flat_one_is_made(tmp_path):
    clips = "\n".join(line for line in CLIP.splitlines() if not line.startswith("base")) + "\n"
    read = experiment_files.load_experiment(write(tmp_path, clips=clips + SECOND))
    reference, base, _ = problems.load_clip_data(read.clips[0], None)
    stands = base.stance_labels() & reference.stance_labels()
    assert np.abs(base.joints_ws(3)[..., 1][stands]).max() < 0.2
    assert np.ptp(base.positions_ws[:, base.rig.pelvis, 1]) < 1e-9
    assert base.frame_count == reference.frame_count


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"frames": slice(0, 90)}, "has 90 frames at 30 Hz of the legs .*; the reference has 360"),
        ({"fps": 60.0}, "360 frames at 60 Hz .*; the reference has 360 frames at 30 Hz"),
    ],
)
def test_a_base_of_other_frames_is_refused(tmp_path, change, said):
    clip = load_clip(ROOT / "data/clips/uneven_walk_base.npz")
    if "frames" in change:
        clip = clip.select(change["frames"])
    else:
        clip = dataclasses.replace(clip, fps=change["fps"])
    save_clip(tmp_path / "base.npz", clip)
    clips = CLIP.replace(f"{ROOT}/data/clips/uneven_walk_base.npz", "base.npz")
    read = experiment_files.load_experiment(write(tmp_path, clips=clips))
    with pytest.raises(ValueError, match=said):
        problems.make_problem(read)


def test_more_steps_are_one_or_more(tmp_path):
    read = experiment_files.load_experiment(write(tmp_path))
    assert experiment.with_max_steps(read, 7).sample.max_steps == 7
    with pytest.raises(ValueError, match="max-steps is 0; wanted 1 or more"):
        experiment.with_max_steps(read, 0)


def test_the_blocks_experiment_makes_a_problem(mocap):
    path = ROOT / "data" / "experiments" / "blocks.toml"
    problem = problems.make_problem(experiment_files.load_experiment(path))
    (scene,) = problem.data
    assert scene.frames.dt.shape == (1141,)  # 38 s
    assert 0.9 < float(scene.reference.observed.mean()) < 1.0
