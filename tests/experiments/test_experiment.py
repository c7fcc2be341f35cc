"""Experiment files, and the problems that are made of them."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import jaxik
from fitting.datasets.clip_frames import raised
from fitting.datasets.clips import Clip, load_clip, save_clip
from fitting.datasets.synthetic import walker
from fitting.datasets.terrain.mesh_files import save_mesh
from fitting.experiments import experiment_files, problems
from fitting.experiments.experiment import Experiment, FitOptions
from fitting.inference.noise.settings import NoiseOptions
from fitting.inference.optimisation.settings import SearchSettings
from fitting.inference.sampling.settings import SamplerSettings
from fitting.problem.prior import ParameterPrior
from fitting.studies import ablation
from jaxik.maths import parameter_tree
from support.experiments import CLIP, ROOT, SECOND, UNEVEN_WALK, write
from support.grounds import hill


@pytest.fixture(scope="module")
def reference() -> Clip:
    return load_clip(ROOT / "data/clips/uneven_walk.npz")


@pytest.fixture(scope="module")
def base() -> Clip:
    return load_clip(ROOT / "data/clips/uneven_walk_base.npz")


def instead_of(name: str, other: str) -> str:
    """The uneven walk with another file."""
    return CLIP.replace(f"{ROOT}/data/clips/{name}.npz", other)


def load(folder: Path, **parts: str) -> Experiment:
    return experiment_files.load_experiment(write(folder, **parts))


def again(folder: Path, experiment: Experiment) -> Experiment:
    """The experiment, written and read."""
    path = folder / "again.toml"
    path.write_text(experiment_files.experiment_to_toml(experiment))
    return experiment_files.load_experiment(path)


def test_the_embedded_experiment_has_its_files_and_values():
    loaded = experiment_files.load_experiment(UNEVEN_WALK)
    values = loaded.name, loaded.preset, loaded.loss, loaded.seed
    assert values == ("uneven walk", "record", "squares", 0)
    (clip,) = loaded.clips
    paths = (clip.reference, clip.base, clip.terrain, clip.truth)
    assert all(path is not None and path.is_absolute() and path.is_file() for path in paths)
    assert len(loaded.free) >= 12 and loaded.free["pelvis.on_gain"] == {}
    assert loaded.parameters["lean.gain_slide"] == 0.15
    assert loaded.sigmas["ankle"] == 0.002


def test_missing_keys_have_defaults_which_are_not_written(tmp_path):
    loaded = load(tmp_path, name="hill.toml")
    assert loaded.name == "hill" and loaded.fps is None and loaded.parameters == {}
    assert loaded.fit == FitOptions() and loaded.sample == SamplerSettings()
    assert loaded.free == {"pelvis.on_gain": {}, "foot.max_pitch": {"low": 0.1}}
    text = experiment_files.experiment_to_toml(loaded)
    assert "[fit]\nstarts = 6\nmax_steps = 1000\n" in text and "[fit.search]" not in text
    assert "[sample]\nmax_steps = 20000\nthin_by = 1\nstop_at = 50.0\n" in text
    assert "check_every" not in text


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"free": "pelvis.on_gian = {}"}, r"\[free\]: no parameter named 'pelvis.on_gian'"),
        ({"rest": "[parameters]\nlean.gain = [0.1, 0.2]"}, r"gain has shape \(2,\), wanted \(\)"),
        (
            {"rest": "[parameters]\nfoot.max_roll = [1, 2, 3]"},
            r"max_roll has shape \(3,\), .* \(2,\), one per leg",
        ),
        ({"clips": CLIP, "clip": "end = 100.0"}, "uneven_walk.npz: trim from 0.0 s to 100.0 s"),
    ],
)
def test_what_does_not_fit_the_clip_or_the_system_makes_no_problem(tmp_path, parts, message):
    with pytest.raises(ValueError, match=message):
        problems.make_problem(load(tmp_path, **parts))


@pytest.mark.parametrize("body", ["clip", "adult"])
def test_a_point_outside_the_range_is_refused_before_clips_are_prepared(
    tmp_path, monkeypatch, body
):
    def fail(*_: object) -> None:
        raise AssertionError("called")

    monkeypatch.setattr(problems, "load_clip_data", fail)
    if body == "adult":
        monkeypatch.setattr(problems, "load_flat_animation", fail)
    for rest, message in (
        ("[prior.pelvis]\nlimit = { centre = 2 }", r"\[prior\]: pelvis.limit: centre is 2, wan"),
        ("[start]\npelvis.limit = -1", r"\[start\]: pelvis.limit: start is -1, wanted from 0 to"),
    ):
        loaded = load(tmp_path, top=f'body = "{body}"', free="pelvis.limit = {}", rest=rest)
        with pytest.raises(ValueError, match=message):
            problems.make_problem(loaded)


def test_a_missing_file_or_one_that_is_not_toml_is_rejected(tmp_path):
    (tmp_path / "bad.toml").write_text("clips = [")
    for name, message in (
        ("no.toml", "no.toml: no such file, wanted an experiment file"),
        (".", "a folder, wanted an experiment file"),
        ("bad.toml", "bad.toml: not TOML"),
    ):
        with pytest.raises(ValueError, match=message):
            experiment_files.load_experiment(tmp_path / name)


def test_paths_are_relative_to_the_file_and_not_to_the_working_folder(tmp_path, monkeypatch):
    for name in ("clips/uneven_walk.npz", "terrains/uneven_walk.ply"):
        (tmp_path / Path(name).name).symlink_to(ROOT / "data" / name)
    clips = '[[clips]]\nreference = "uneven_walk.npz"\nterrain = "uneven_walk.ply"\n'
    path = write(tmp_path, clips=clips)
    monkeypatch.chdir("/")
    (clip,) = experiment_files.load_experiment(path).clips
    assert clip.reference.is_absolute() and clip.base is None


def test_free_parameters_start_at_the_values_of_the_system_with_its_fixed_ones(tmp_path):
    rest = "[parameters]\nlock.enabled = false\nfoot.max_pitch = [0.3, 0.5]"
    space = problems.make_problem(load(tmp_path, rest=rest)).space
    assert not parameter_tree.get(space.system, "lock.enabled")
    np.testing.assert_array_equal(parameter_tree.get(space.system, "foot.max_pitch"), [0.3, 0.5])
    gain = float(parameter_tree.get(jaxik.presets.record(), "pelvis.on_gain"))
    assert space.names == ("pelvis.on_gain", "foot.max_pitch")
    np.testing.assert_allclose(space.values(space.start), [gain, 0.4], rtol=1e-6)


def test_reference_and_animation_are_cut_and_resampled_alike(tmp_path, reference, base):
    (scene,) = problems.make_problem(load(tmp_path, top="fps = 15.0")).data
    assert scene.frames.dt.shape == (16,) and float(scene.frames.dt[0]) == pytest.approx(1 / 15)
    frames = slice(30, 61, 2)
    ankles = reference.joints_ws(2)[frames]
    np.testing.assert_allclose(scene.reference.ankle.pos, ankles, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(scene.reference.contact, reference.stance_labels()[frames])
    pelvis = (scene.frames.world_from_model @ scene.pelvis).pos
    np.testing.assert_allclose(pelvis, base.positions_ws[frames, base.rig.pelvis], atol=1e-9)
    assert scene.reference.observed.all()


def test_a_frame_with_a_marker_pop_is_not_observed(tmp_path, reference):
    positions = reference.positions_ws.copy()
    positions[45, reference.rig.joints[0][2]] += 0.2
    save_clip(tmp_path / "popped.npz", dataclasses.replace(reference, positions_ws=positions))
    loaded = load(tmp_path, clips=instead_of("uneven_walk", "popped.npz") + SECOND)
    (scene,) = problems.make_problem(loaded).data
    observed = np.asarray(scene.reference.observed)
    assert not observed[15] and observed[[0, 12, 18, 30]].all()
    resampled = dataclasses.replace(loaded, fps=15.0)
    assert not problems.make_problem(resampled).data[0].reference.observed[7]


def test_contacts_count_only_where_the_clip_has_labels(tmp_path, reference):
    save_clip(tmp_path / "bare.npz", dataclasses.replace(reference, stance=None))
    for clips, sigma in ((CLIP, 0.5), (instead_of("uneven_walk", "bare.npz"), np.inf)):
        loaded = load(tmp_path, rest="[sigmas]\ncontact = 0.5", clips=clips + SECOND)
        assert float(problems.make_problem(loaded).data[0].sigmas.contact) == sigma, clips


def test_a_missing_flat_animation_is_made_from_the_reference(tmp_path):
    clips = "".join(line for line in CLIP.splitlines(True) if not line.startswith("base"))
    loaded = load(tmp_path, clips=clips + SECOND)
    reference, base, _, root, _ = problems.load_clip_data(loaded.clips[0], None)
    assert root.root == "animation"
    stands = base.stance_labels() & reference.stance_labels()
    assert np.abs(base.joints_ws(3)[..., 1][stands]).max() < 0.2
    assert np.ptp(base.positions_ws[:, base.rig.pelvis, 1]) < 1e-9
    assert base.frame_count == reference.frame_count


def test_a_flat_animation_with_other_frames_is_rejected(tmp_path, base):
    wanted = "the reference has 360"
    for clip, message in (
        (base.select(slice(0, 90)), f"has 90 frames at 30 Hz of the legs .*; {wanted}"),
        (dataclasses.replace(base, fps=60.0), f"360 frames at 60 Hz .*; {wanted} frames at 30 Hz"),
    ):
        save_clip(tmp_path / "base.npz", clip)
        loaded = load(tmp_path, clips=instead_of("uneven_walk_base", "base.npz"))
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
    loaded = load(tmp_path, rest=f"{rest}\n[sample]\nmax_steps = 300\ncheck_every = 30")
    for experiment in (loaded, again(tmp_path, loaded)):
        search = SearchSettings(max_steps=50, elite=4, agreement=1.0)
        assert experiment.fit == FitOptions(2, search)
        assert experiment.sample == SamplerSettings(max_steps=300, check_every=30)


PRIOR = """
[prior]
shape = "uniform"
[prior.pelvis]
on_gain = { shape = "normal", centre = 0.3, spread = 1.0 }
[start]
foot.max_pitch = 0.5
"""


def test_prior_and_start_are_those_of_the_file_and_are_written_back(tmp_path):
    loaded = load(tmp_path, rest=PRIOR)
    space = problems.make_problem(loaded).space
    np.testing.assert_array_equal(space.prior.uniform, [False, True])
    np.testing.assert_allclose(space.prior.spread, 1.0)
    assert float(space.values(space.prior.centre)[0]) == pytest.approx(0.3)
    preset = float(parameter_tree.get(jaxik.presets.record(), "pelvis.on_gain"))
    np.testing.assert_allclose(space.values(space.start), [preset, 0.5])
    reloaded = again(tmp_path, loaded)
    assert (reloaded.prior, reloaded.start) == (loaded.prior, loaded.start)


def test_a_parameter_has_the_spread_of_the_table_unless_it_is_uniform(tmp_path):
    for table, expected in (
        ("shape = 'uniform'", ParameterPrior("uniform")),
        ("centre = 0.1", ParameterPrior(centre=0.1, spread=0.7)),
    ):
        rest = f"[prior]\nspread = 0.7\n[prior.pelvis]\non_gain = {{ {table} }}"
        prior = load(tmp_path, rest=rest).prior
        assert prior.of("foot.max_pitch") == ParameterPrior(spread=0.7)
        assert prior.of("pelvis.on_gain") == expected


def test_a_parameter_that_only_a_variant_frees_may_have_a_prior(tmp_path):
    variant = "[[without]]\nname = 'x'\nfree = { pelvis.limit = {} }"
    prior = "[prior.pelvis]\nlimit = { shape = 'uniform' }\n[start]\npelvis.limit = 0.2"
    loaded = load(tmp_path, rest=f"{variant}\n{prior}")
    assert not problems.make_problem(loaded).space.prior.uniform.any()
    without = ablation.without(loaded, loaded.without[0])
    space = without.space(without.starting_system())
    limit = space.names.index("pelvis.limit")
    assert space.prior.uniform[limit]
    assert float(space.values(space.start)[limit]) == pytest.approx(0.2)


def test_a_loss_that_is_no_distribution_has_no_estimated_sigmas_in_python_either(tmp_path):
    loaded = load(tmp_path)
    for loss in ("huber", "cauchy"):
        with pytest.raises(ValueError, match=f"xperiment.toml: .* the loss '{loss}'.*student"):
            dataclasses.replace(loaded, loss=loss, noise=NoiseOptions("estimated"))


HILL = '[[clips]]\nreference = "reference.npz"\nbase = "base.npz"\nterrain = "hill.ply"\n'


@pytest.fixture(scope="module")
def hill_folder(tmp_path_factory):
    """A flat walk, and the same raised onto a hill as its reference."""
    path = tmp_path_factory.mktemp("hill")
    base = walker.walk(8.0, 30.0)
    rise = np.linspace(0.0, 2.0, base.frame_count)
    save_clip(path / "base.npz", base)
    save_clip(path / "reference.npz", raised(base, rise))
    save_mesh(path / "hill.ply", *hill())
    return path


def test_by_default_the_root_follows_a_hill_and_the_log_says_so(hill_folder):
    loaded, lines = load(hill_folder, clips=HILL), []
    (scene,) = problems.make_problem(loaded, lines.append).data
    assert lines[0].startswith("root of walker seed 0: on the ground below it, 0 to ")
    data = problems.load_clip_data(loaded.clips[0], None)
    assert data.root.rise is not None
    np.testing.assert_allclose(scene.frames.world_from_model.pos[:, 1], data.root.rise)
    pelvis = np.asarray((scene.frames.world_from_model @ scene.pelvis).pos)
    placed = raised(data.base, data.root.rise)
    np.testing.assert_allclose(pelvis, placed.positions_ws[:, 0], atol=1e-9)


def test_the_root_can_stay_as_animated(hill_folder):
    (scene,) = problems.make_problem(load(hill_folder, clips=HILL, clip='root = "animation"')).data
    np.testing.assert_array_equal(scene.frames.world_from_model.pos[:, 1], 0.0)


def test_a_system_does_not_put_itself_on_the_ground_once_more(hill_folder):
    for root, own in (("ground", False), ("animation", True)):
        parts = {"top": 'preset = "ozz"', "clip": f'root = "{root}"', "free": "pelvis.limit = {}"}
        loaded = load(hill_folder, clips=HILL, **parts)
        system = problems.make_problem(loaded).space.system
        assert bool(parameter_tree.get(system, "root.enabled")) == own
        assert parts["clip"] in experiment_files.experiment_to_toml(loaded)


def test_a_system_that_is_told_to_put_itself_on_the_ground_does_so_alone(tmp_path):
    rest, free = "[parameters]\nroot.enabled = true", "probe.stable_height = {}"
    loaded = load(tmp_path, top='preset = "mec"', free=free, rest=rest)
    assert [entry.root for entry in loaded.placed_clips()] == ["animation"]
    chosen = dataclasses.replace(loaded.clips[0], root="ground")
    assert dataclasses.replace(loaded, clips=(chosen,)).placed_clips() == (chosen,)
