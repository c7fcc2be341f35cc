"""Experiment files, and the problems that are made of them."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import jaxik
from fitting.datasets.clips import load_clip, save_clip
from fitting.experiments import experiment_files, problems
from fitting.experiments.experiment import FitOptions
from fitting.inference.noise.settings import NoiseOptions
from fitting.inference.optimisation.settings import SearchSettings
from fitting.inference.sampling.settings import SamplerSettings
from fitting.problem.prior import ParameterPrior
from fitting.studies import ablation
from jaxik.maths import parameter_tree
from support.experiments import CLIP, ROOT, SECOND, UNEVEN_WALK, write

MISTAKES = [
    ({"top": "fobs = 3"}, "unknown key 'fobs'; nearest is 'fps' of"),
    ({"top": "fps = -1"}, "fps is -1; wanted a number of Hz from 1 to 1000"),
    ({"top": "fps = 'x'"}, "fps is 'x'; wanted a number of Hz from 1 to 1000"),
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
    ({"clips": CLIP, "clip": "start = 3.0\nend = 1.0"}, "end is 1.0; wanted more than start"),
    ({"free": ""}, "there is no .free."),
    ({"free": "pelvis.on_gain = 3"}, "pelvis.on_gain is 3; wanted a table"),
    ({"free": "pelvis.on_gain = { lo = 1 }"}, "unknown key 'lo'; nearest is 'low'"),
    ({"free": "pelvis.on_gain = { low = 'x' }"}, "low is 'x'; wanted a finite number"),
    ({"free": "pelvis.on_gain = { low = nan }"}, "low is nan; wanted a finite number"),
    ({"free": "pelvis.on_gain = { prior_sd = 1 }"}, r"prior_sd is no key .*.prior.*{ spread = 1 }"),
    ({"rest": "[prior]\nshpae = 'normal'"}, r"\[prior\]: unknown key 'shpae'; nearest is 'shape'"),
    ({"rest": "[prior]\nshape = 'flat'"}, "shape is 'flat'; wanted one of .'normal', 'uniform'."),
    ({"rest": "[prior]\nspread = 0"}, "spread is 0; wanted a number from 0.001 to 1000"),
    ({"rest": "[prior]\nshape = 'uniform'\nspread = 1"}, "prior.: spread is given, but a uniform"),
    ({"rest": "[prior.pelvis]\non_gian = {}"}, "'pelvis.on_gian'; nearest is 'pelvis.on_gain'"),
    ({"rest": "[prior.pelvis]\non_gain = 3"}, r"\[prior\] pelvis.on_gain is 3; wanted a table"),
    (
        {"rest": "[prior.pelvis]\non_gain = { center = 1 }"},
        "unknown key 'center'; nearest is 'centre'",
    ),
    (
        {"rest": "[prior.pelvis]\non_gain = { shape = 'uniform', centre = 0.1 }"},
        "prior. pelvis.on_gain: centre is given, but a uniform prior has none",
    ),
    ({"rest": "[start]\nfoot.max_ptich = 1"}, r"\[start\].*nearest is 'foot.max_pitch'"),
    ({"rest": "[start]\nfoot.max_pitch = 'x'"}, "foot.max_pitch is 'x'; wanted a finite number"),
    ({"rest": "[sigmas]\nankel = 1"}, "unknown key 'ankel'; nearest is 'ankle'"),
    (
        {"rest": "[sigmas]\nankle = nan"},
        "ankle is nan; wanted a number from 1e-09 to 1e.09, or inf",
    ),
    ({"rest": "[sigmas]\nankle = true"}, "ankle is True; wanted a number from 1e-09"),
    ({"rest": "[sigmas]\nankle = 0"}, "ankle is 0; wanted a number from 1e-09"),
    (
        {"rest": "[sigmas]\ncorrelation = 1.0"},
        "correlation is 1.0; wanted a number from 0 to 0.999",
    ),
    ({"rest": "[sigmas.correlation]\nankel = 0.1"}, "unknown key 'correlation.ankel'; nearest"),
    (
        {"rest": "[sigmas.correlation]\nankle = 1"},
        "correlation.ankle is 1; wanted a number from 0 to 0.999",
    ),
    ({"rest": "[noise]\nsigmas = true"}, r"sigmas is True; wanted one of \['given', 'estimated'\]"),
    ({"rest": "[noise]\ncorrelation = 'estimated'"}, "wanted one of .*whitened"),
    ({"rest": "[noise]\nsigma = 'given'"}, "unknown key 'sigma'; nearest is 'sigmas'"),
    (
        {"top": "independent_every = 1.0", "rest": "[noise]\ncorrelation = 'whitened'"},
        "would account for the same correlation twice",
    ),
    (
        {"top": "loss = 'cauchy'", "rest": "[noise]\nsigmas = 'estimated'"},
        "cannot be estimated under the loss 'cauchy'.*student",
    ),
    ({"rest": "[fit]\nstarts = 0"}, "starts is 0; wanted a whole number from 1 to 1000"),
    ({"rest": "[fit]\nstarts = 1.5"}, "starts is 1.5; wanted a whole number from 1 to 1000"),
    ({"rest": "[fit]\nmaxsteps = 1"}, "unknown key 'maxsteps'; nearest is 'max_steps'"),
    ({"rest": "[fit.search]\nelit = 3"}, r"\[fit.search\]: unknown key 'elit'; nearest is 'elite'"),
    ({"rest": "[fit.search]\nmax_steps = 3"}, r"\[fit.search\]: unknown key 'max_steps'"),
    ({"rest": "[fit.search]\nelite = 0"}, "elite is 0; wanted a whole number from 1"),
    ({"rest": "[fit.search]\nelite = 1.5"}, "elite is 1.5; wanted a whole number from 1"),
    ({"rest": "[fit.search]\nagreement = -1"}, "agreement is -1; wanted a number from 0"),
    ({"rest": "[fit.search]\npopulation = 8"}, r"\[fit.search\]: gauss_newton_children is 16"),
    ({"rest": "[sample]\nwalkers = 5"}, "walkers is 5, wanted an even number from 4"),
    ({"rest": "[sample]\nwalkers = 2"}, "walkers is 2, wanted an even number from 4"),
    ({"rest": "[sample]\nstop_at = 'x'"}, "stop_at is 'x'; wanted a number from 0"),
    ({"free": "pelvis.on_gain = { kind = 'rough' }"}, "kind is 'rough'; wanted one of"),
]
MISFITS = [  # noticed only when the problem is made
    ({"free": "pelvis.on_gian = {}"}, r"\[free\]: no parameter named 'pelvis.on_gian'; nearest is"),
    ({"free": "pelvis = {}"}, "no parameter named 'pelvis'; nearest is 'pelvis"),
    ({"free": "lock.enabled = {}"}, "no parameter named 'lock.enabled'"),
    ({"free": 'foot."max_pitch[7]" = {}'}, r"no element 'foot.max_pitch\[7\]'"),
    ({"free": "pelvis.on_gain = { low = 0.5, high = 0.1 }"}, "bounds are 0.5 to 0.1"),
    ({"free": "contact.raised_height = { high = 0.05 }"}, r"\[free\]: contact.raised_height stays"),
    (
        {"rest": "[prior.pelvis]\non_gain = { centre = 2 }"},
        r"\[prior\]: pelvis.on_gain: centre is 2",
    ),
    (
        {"rest": "[start]\npelvis.on_gain = 2"},
        r"\[start\]: pelvis.on_gain: start is 2, wanted from",
    ),
    ({"rest": "[parameters]\nlock.speed = 1.0"}, r"\[parameters\]: unknown key 'lock.speed'"),
    ({"rest": "[parameters]\nlean.gain = [0.1, 0.2]"}, r"lean.gain has shape \(2,\), wanted \(\)"),
    (
        {"rest": "[parameters]\nfoot.max_roll = [1, 2, 3]"},
        r"max_roll has shape \(3,\), .* \(2,\), one per leg",
    ),
    ({"clips": CLIP, "clip": "end = 100.0"}, "uneven_walk.npz: trim from 0.0 s to 100.0 s"),
]


def test_the_embedded_experiment_has_its_files_and_values():
    loaded = experiment_files.load_experiment(UNEVEN_WALK)
    assert (loaded.name, loaded.preset, loaded.loss, loaded.seed) == (
        "uneven walk",
        "record",
        "squares",
        0,
    )
    (clip,) = loaded.clips
    paths = (clip.reference, clip.base, clip.terrain, clip.truth)
    assert all(path is not None and path.is_absolute() and path.is_file() for path in paths)
    assert len(loaded.free) >= 12 and loaded.free["pelvis.on_gain"] == {}
    assert loaded.parameters["lean.gain_slide"] == 0.15
    assert loaded.sigmas["ankle"] == 0.002


def test_missing_keys_have_defaults_and_the_name_is_that_of_the_file(tmp_path):
    loaded = experiment_files.load_experiment(write(tmp_path, "hill.toml"))
    assert loaded.name == "hill" and loaded.fps is None and loaded.parameters == {}
    assert loaded.fit == FitOptions() and loaded.sample == SamplerSettings()
    assert loaded.free == {"pelvis.on_gain": {}, "foot.max_pitch": {"low": 0.1}}


@pytest.mark.parametrize(("parts", "message"), MISTAKES)
def test_a_mistake_in_the_file_is_reported_with_what_was_wanted(tmp_path, parts, message):
    with pytest.raises(ValueError, match=f"experiment.toml.*{message}"):
        experiment_files.load_experiment(write(tmp_path, **parts))


@pytest.mark.parametrize(("parts", "message"), MISFITS)
def test_a_parameter_or_clip_that_does_not_fit_is_reported(tmp_path, parts, message):
    loaded = experiment_files.load_experiment(write(tmp_path, **parts))
    with pytest.raises(ValueError, match=message):
        problems.make_problem(loaded)


@pytest.mark.parametrize("body", ["clip", "adult"])
@pytest.mark.parametrize(
    ("rest", "message"),
    [
        ("[prior.pelvis]\nlimit = { centre = 2 }", r"\[prior\]: pelvis.limit: centre is 2, wanted"),
        ("[start]\npelvis.limit = -1", r"\[start\]: pelvis.limit: start is -1, wanted from 0 to"),
    ],
)
def test_a_point_outside_the_range_is_refused_before_clips_are_prepared(
    tmp_path, monkeypatch, body, rest, message
):
    def fail(*_: object) -> None:
        raise AssertionError("called")

    monkeypatch.setattr(problems, "load_clip_data", fail)
    if body == "adult":
        monkeypatch.setattr(problems, "load_flat_animation", fail)
    path = write(tmp_path, top=f'body = "{body}"', free="pelvis.limit = {}", rest=rest)
    with pytest.raises(ValueError, match=message):
        problems.make_problem(experiment_files.load_experiment(path))


def test_a_missing_file_or_one_that_is_not_toml_is_rejected(tmp_path):
    with pytest.raises(ValueError, match="no.toml: no such file, wanted an experiment file"):
        experiment_files.load_experiment(tmp_path / "no.toml")
    with pytest.raises(ValueError, match="a folder, wanted an experiment file"):
        experiment_files.load_experiment(tmp_path)
    (tmp_path / "bad.toml").write_text("clips = [")
    with pytest.raises(ValueError, match="bad.toml: not TOML"):
        experiment_files.load_experiment(tmp_path / "bad.toml")


def test_paths_are_relative_to_the_file_and_not_to_the_working_folder(tmp_path, monkeypatch):
    for name in ("clips/uneven_walk.npz", "terrains/uneven_walk.ply"):
        (tmp_path / Path(name).name).symlink_to(ROOT / "data" / name)
    clips = '[[clips]]\nreference = "uneven_walk.npz"\nterrain = "uneven_walk.ply"\n'
    path = write(tmp_path, clips=clips)
    monkeypatch.chdir("/")
    (clip,) = experiment_files.load_experiment(path).clips
    assert clip.reference.is_absolute() and clip.base is None


def test_free_parameters_start_at_the_values_of_the_system_with_its_fixed_ones(tmp_path):
    parts = {"rest": "[parameters]\nlock.enabled = false\nfoot.max_pitch = [0.3, 0.5]"}
    problem = problems.make_problem(experiment_files.load_experiment(write(tmp_path, **parts)))
    base = problem.space.system
    assert not parameter_tree.get(base, "lock.enabled")
    np.testing.assert_array_equal(parameter_tree.get(base, "foot.max_pitch"), [0.3, 0.5])
    start = dict(zip(problem.space.names, problem.space.values(problem.space.start), strict=True))
    preset = jaxik.presets.record()
    assert float(start["pelvis.on_gain"]) == pytest.approx(
        float(parameter_tree.get(preset, "pelvis.on_gain"))
    )
    assert float(start["foot.max_pitch"]) == pytest.approx(0.4)


def test_reference_and_animation_are_cut_and_resampled_alike(tmp_path):
    loaded = experiment_files.load_experiment(write(tmp_path, top="fps = 15.0"))
    (scene,) = problems.make_problem(loaded).data
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


def test_a_frame_with_a_marker_pop_is_not_observed(tmp_path):
    clip = load_clip(ROOT / "data/clips/uneven_walk.npz")
    positions = clip.positions_ws.copy()
    positions[45, clip.rig.joints[0][2]] += 0.2
    save_clip(tmp_path / "popped.npz", dataclasses.replace(clip, positions_ws=positions))
    clips = CLIP.replace(f"{ROOT}/data/clips/uneven_walk.npz", "popped.npz") + SECOND
    loaded = experiment_files.load_experiment(write(tmp_path, clips=clips))
    (scene,) = problems.make_problem(loaded).data
    assert (
        not scene.reference.observed[15]
        and np.asarray(scene.reference.observed)[[0, 12, 18, 30]].all()
    )
    resampled = dataclasses.replace(loaded, fps=15.0)
    assert not problems.make_problem(resampled).data[0].reference.observed[7]


def test_contacts_count_only_where_the_clip_has_labels(tmp_path):
    clip = load_clip(ROOT / "data/clips/uneven_walk.npz")
    save_clip(tmp_path / "bare.npz", dataclasses.replace(clip, stance=None))
    clips = CLIP.replace(f"{ROOT}/data/clips/uneven_walk.npz", "bare.npz") + SECOND
    rest = "[sigmas]\ncontact = 0.5"
    with_labels = problems.make_problem(
        experiment_files.load_experiment(write(tmp_path, rest=rest))
    )
    loaded = experiment_files.load_experiment(write(tmp_path, rest=rest, clips=clips))
    assert float(with_labels.data[0].sigmas.contact) == 0.5
    assert np.isinf(problems.make_problem(loaded).data[0].sigmas.contact)


def test_a_missing_flat_animation_is_made_from_the_reference(tmp_path):
    clips = "\n".join(line for line in CLIP.splitlines() if not line.startswith("base")) + "\n"
    loaded = experiment_files.load_experiment(write(tmp_path, clips=clips + SECOND))
    reference, base, _, root, _ = problems.load_clip_data(loaded.clips[0], None)
    assert root.root == "animation"
    stands = base.stance_labels() & reference.stance_labels()
    assert np.abs(base.joints_ws(3)[..., 1][stands]).max() < 0.2
    assert np.ptp(base.positions_ws[:, base.rig.pelvis, 1]) < 1e-9
    assert base.frame_count == reference.frame_count


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": slice(0, 90)}, "has 90 frames at 30 Hz of the legs .*; the reference has 360"),
        ({"fps": 60.0}, "360 frames at 60 Hz .*; the reference has 360 frames at 30 Hz"),
    ],
)
def test_a_flat_animation_with_other_frames_is_rejected(tmp_path, change, message):
    clip = load_clip(ROOT / "data/clips/uneven_walk_base.npz")
    if "frames" in change:
        clip = clip.select(change["frames"])
    else:
        clip = dataclasses.replace(clip, fps=change["fps"])
    save_clip(tmp_path / "base.npz", clip)
    clips = CLIP.replace(f"{ROOT}/data/clips/uneven_walk_base.npz", "base.npz")
    loaded = experiment_files.load_experiment(write(tmp_path, clips=clips))
    with pytest.raises(ValueError, match=message):
        problems.make_problem(loaded)


@pytest.mark.parametrize("name", ["blocks", "blocks_walk", "blocks_causal"])
def test_the_blocks_experiments_make_a_problem(mocap, name):
    path = ROOT / "data" / "experiments" / f"{name}.toml"
    problem = problems.make_problem(experiment_files.load_experiment(path))
    (scene,) = problem.data
    assert scene.frames.dt.shape == (1141,)  # 38 s
    assert 0.9 < float(scene.reference.observed.mean()) < 1.0


def test_settings_of_the_search_and_the_sampler_can_be_overridden(tmp_path):
    rest = "[fit]\nstarts = 2\nmax_steps = 50\n[fit.search]\nelite = 4\nagreement = 1"
    path = write(tmp_path, rest=f"{rest}\n[sample]\nmax_steps = 300\ncheck_every = 30")
    loaded = experiment_files.load_experiment(path)
    search = SearchSettings(max_steps=50, elite=4, agreement=1.0)
    assert loaded.fit == FitOptions(2, search)
    assert loaded.sample == SamplerSettings(max_steps=300, check_every=30)
    again = tmp_path / "again.toml"
    again.write_text(experiment_files.experiment_to_toml(loaded))
    reloaded = experiment_files.load_experiment(again)
    assert (reloaded.fit, reloaded.sample) == (loaded.fit, loaded.sample)


PRIOR = """
[prior]
shape = "uniform"
[prior.pelvis]
on_gain = { shape = "normal", centre = 0.3, spread = 1.0 }
[start]
foot.max_pitch = 0.5
"""


def test_prior_and_start_are_those_of_the_file_and_are_written_back(tmp_path):
    loaded = experiment_files.load_experiment(write(tmp_path, rest=PRIOR))
    space = problems.make_problem(loaded).space
    np.testing.assert_array_equal(space.prior.uniform, [False, True])
    np.testing.assert_allclose(space.prior.spread, 1.0)
    assert float(space.values(space.prior.centre)[0]) == pytest.approx(0.3)
    preset = float(parameter_tree.get(jaxik.presets.record(), "pelvis.on_gain"))
    np.testing.assert_allclose(space.values(space.start), [preset, 0.5])
    again = tmp_path / "again.toml"
    again.write_text(experiment_files.experiment_to_toml(loaded))
    reloaded = experiment_files.load_experiment(again)
    assert (reloaded.prior, reloaded.start) == (loaded.prior, loaded.start)


def test_a_parameter_has_the_spread_of_the_table_unless_it_is_uniform(tmp_path):
    rest = "[prior]\nspread = 0.7\n[prior.pelvis]\non_gain = { shape = 'uniform' }"
    prior = experiment_files.load_experiment(write(tmp_path, rest=rest)).prior
    assert prior.of("foot.max_pitch") == ParameterPrior(spread=0.7)
    assert prior.of("pelvis.on_gain") == ParameterPrior("uniform")
    rest = "[prior]\nspread = 0.7\n[prior.pelvis]\non_gain = { centre = 0.1 }"
    prior = experiment_files.load_experiment(write(tmp_path, rest=rest)).prior
    assert prior.of("pelvis.on_gain") == ParameterPrior(centre=0.1, spread=0.7)


def test_a_parameter_that_only_a_variant_frees_may_have_a_prior(tmp_path):
    variant = "[[without]]\nname = 'x'\nfree = { pelvis.limit = {} }"
    rest = (
        f"{variant}\n[prior.pelvis]\nlimit = {{ shape = 'uniform' }}\n[start]\npelvis.limit = 0.2"
    )
    loaded = experiment_files.load_experiment(write(tmp_path, rest=rest))
    assert not problems.make_problem(loaded).space.prior.uniform.any()
    without = ablation.without(loaded, loaded.without[0])
    space = without.space(without.starting_system())
    limit = space.names.index("pelvis.limit")
    assert space.prior.uniform[limit]
    assert float(space.values(space.start)[limit]) == pytest.approx(0.2)


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_a_loss_that_is_no_distribution_has_no_estimated_sigmas_in_python_either(tmp_path, loss):
    loaded = experiment_files.load_experiment(write(tmp_path))
    with pytest.raises(ValueError, match=f"experiment.toml: .* under the loss '{loss}'.*student"):
        dataclasses.replace(loaded, loss=loss, noise=NoiseOptions("estimated"))


def test_only_settings_that_are_not_the_default_are_written(tmp_path):
    loaded = experiment_files.load_experiment(write(tmp_path))
    text = experiment_files.experiment_to_toml(loaded)
    assert "[fit]\nstarts = 6\nmax_steps = 1000\n" in text and "[fit.search]" not in text
    assert "[sample]\nmax_steps = 20000\nthin_by = 1\nstop_at = 50.0\n" in text
    assert "check_every" not in text
