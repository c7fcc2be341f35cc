"""Experiments, of files and of objects in memory, and the problems that are made of them."""

import dataclasses
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
import pytest

import jaxik
from fitting.clips import load_clip, save_clip
from fitting.clips.clip_frames import raised
from fitting.experiment import experiment_files, problems, systems
from fitting.experiment.experiment import ClipEntry, Experiment, FitOptions
from fitting.experiment.file_tables import Ablation
from fitting.experiment.in_memory import clip_entry, free_table, make_experiment, with_files
from fitting.ground.meshes import load_terrain, mesh_of, save_mesh
from fitting.inference.optimise.solution import SearchSettings
from fitting.inference.sample.blocks import SamplerSettings
from fitting.motion import flat_animation
from fitting.problem.problem import digest
from fitting.problem.space import ParameterPrior
from fitting.studies import ablation
from fitting.synthetic import walker
from jaxik.maths import parameter_tree
from jaxik.stages.pelvis import LowestPelvis, ReachPelvis
from jaxik.world import terrain as terrains
from support.experiments import CLIP, ROOT, SECOND, write
from support.grounds import hill
from support.problems import parameter


@pytest.fixture(scope="module")
def objects() -> dict[str, Any]:
    """The captured walk, its flat animation and its ground, as a notebook has loaded them."""
    return {
        "reference": load_clip(ROOT / "data/clips/uneven_walk.npz"),
        "base": load_clip(ROOT / "data/clips/uneven_walk_base.npz"),
        "terrain": load_terrain(ROOT / "data/terrains/uneven_walk.ply"),
    }


def instead_of(name: str, other: str) -> str:
    """The uneven walk with another file."""
    return CLIP.replace(f"{ROOT}/data/clips/{name}.npz", other)


def load(folder: Path, **parts: str) -> Experiment:
    return experiment_files.load_experiment(write(folder, **parts))


def test_missing_keys_have_defaults_which_are_not_written_and_paths_are_relative_to_the_file(
    tmp_path, monkeypatch
):
    loaded = load(tmp_path, name="hill.toml")
    assert loaded.name == "hill" and loaded.fps is None and loaded.parameters == {}
    assert loaded.fit == FitOptions() and loaded.sample == SamplerSettings()
    assert loaded.free == {"pelvis.half_life": {}, "foot.max_pitch": {"low": 0.1}}
    text = experiment_files.experiment_to_toml(loaded)
    assert "[fit]\nstarts = 6\nmax_steps = 1000\n" in text and "[fit.search]" not in text
    assert "[sample]\nmax_steps = 20000\nthin_by = 1\nstop_at = 50.0\n" in text
    assert "check_every" not in text
    for name in ("clips/uneven_walk.npz", "terrains/uneven_walk.ply"):
        (tmp_path / Path(name).name).symlink_to(ROOT / "data" / name)
    clips = '[[clips]]\nreference = "uneven_walk.npz"\nterrain = "uneven_walk.ply"\n'
    path = write(tmp_path, clips=clips)
    monkeypatch.chdir("/")
    (clip,) = experiment_files.load_experiment(path).clips
    assert clip.reference.is_absolute() and clip.base is None


def test_what_does_not_fit_the_clip_or_the_system_makes_no_problem(tmp_path):
    for rest, message in (
        ("lean.half_life = [0.1, 0.2]", r"lean.half_life has shape \(2,\), wanted \(\)"),
        ("foot.max_roll = [1, 2, 3]", r"max_roll has shape \(3,\), .* \(2,\), one per leg"),
    ):
        with pytest.raises(ValueError, match=message):
            problems.make_problem(load(tmp_path, rest=f"[parameters]\n{rest}"))
    with pytest.raises(ValueError, match="uneven_walk.npz: trim from 0.0 s to 100.0 s"):
        problems.make_problem(load(tmp_path, clips=CLIP, clip="end = 100.0"))


@pytest.mark.parametrize("body", ["clip", "adult"])
def test_a_point_outside_the_range_is_refused_before_clips_are_prepared(
    tmp_path, monkeypatch, body
):
    monkeypatch.setattr(problems, "load_clip_data", pytest.fail)
    if body == "adult":
        monkeypatch.setattr(flat_animation, "load_flat_animation", pytest.fail)
    for rest, message in (
        ("[prior.pelvis]\nlimit = { centre = 2 }", r"\[prior\]: pelvis.limit: centre is 2, wan"),
        ("[start]\npelvis.limit = -1", r"\[start\]: pelvis.limit: start is -1, wanted from 0 to"),
    ):
        loaded = load(tmp_path, top=f'body = "{body}"', free="pelvis.limit = {}", rest=rest)
        with pytest.raises(ValueError, match=message):
            problems.make_problem(loaded)


def test_a_problem_has_the_clips_cut_and_resampled_alike_and_starts_at_the_values_of_its_system(
    tmp_path, objects
):
    reference, base = objects["reference"], objects["base"]
    rest = "[parameters]\nlock.enabled = false\nfoot.max_pitch = [0.3, 0.5]"
    problem = problems.make_problem(load(tmp_path, top="fps = 15.0", rest=rest))
    space, (scene,) = problem.space, problem.data
    assert not parameter_tree.get(space.system, "lock.enabled")
    np.testing.assert_array_equal(parameter_tree.get(space.system, "foot.max_pitch"), [0.3, 0.5])
    half_life = float(parameter_tree.get(jaxik.presets.record(), "pelvis.half_life"))
    assert space.names == ("pelvis.half_life", "foot.max_pitch")
    np.testing.assert_allclose(space.values(space.start), [half_life, 0.4], rtol=1e-6)
    assert scene.frames.dt.shape == (16,) and float(scene.frames.dt[0]) == pytest.approx(1 / 15)
    frames = slice(30, 61, 2)
    ankles = reference.joints_ws(2)[frames]
    np.testing.assert_allclose(scene.reference.ankle.pos, ankles, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(scene.reference.contact, reference.stance_labels()[frames])
    pelvis = (scene.frames.world_from_model @ scene.pelvis).pos
    np.testing.assert_allclose(pelvis, base.positions_ws[frames, base.rig.pelvis], atol=1e-9)
    assert scene.reference.observed.all()


def test_a_frame_with_a_marker_pop_is_not_observed_and_contacts_count_where_there_are_labels(
    tmp_path, objects
):
    reference = objects["reference"]
    positions = reference.positions_ws.copy()
    positions[45, reference.rig.joints[0][2]] += 0.2
    bare = dataclasses.replace(reference, positions_ws=positions, stance=None)
    save_clip(tmp_path / "popped.npz", bare)
    clips, rest = instead_of("uneven_walk", "popped.npz") + SECOND, "[sigmas]\ncontact = 0.5"
    loaded = load(tmp_path, clips=clips, rest=rest)
    (scene,) = problems.make_problem(loaded).data
    observed = np.asarray(scene.reference.observed)
    assert not observed[15] and observed[[0, 12, 18, 30]].all()
    assert scene.sigmas.contact == np.inf
    assert problems.make_problem(load(tmp_path, rest=rest)).data[0].sigmas.contact == 0.5
    resampled = dataclasses.replace(loaded, fps=15.0)
    assert not problems.make_problem(resampled).data[0].reference.observed[7]


def test_a_missing_flat_animation_is_made_from_the_reference_and_one_with_other_frames_refused(
    tmp_path, objects
):
    clips = "".join(line for line in CLIP.splitlines(True) if not line.startswith("base"))
    loaded = load(tmp_path, clips=clips + SECOND)
    reference, base, _, root, _ = problems.load_clip_data(loaded.clips[0], None)
    assert root.root == "animation"
    stands = base.stance_labels() & reference.stance_labels()
    assert np.abs(base.joints_ws(3)[..., 1][stands]).max() < 0.2
    assert np.ptp(base.positions_ws[:, base.rig.pelvis, 1]) < 1e-9
    assert base.frame_count == reference.frame_count
    base, wanted = objects["base"], "the reference has 360"
    for clip, message in (
        (base.select(slice(0, 90)), f"has 90 frames at 30 Hz of the legs .*; {wanted}"),
        (dataclasses.replace(base, fps=60.0), f"360 frames at 60 Hz .*; {wanted} frames at 30 Hz"),
    ):
        save_clip(tmp_path / "base.npz", clip)
        loaded = load(tmp_path, clips=instead_of("uneven_walk_base", "base.npz"))
        with pytest.raises(ValueError, match=message):
            problems.make_problem(loaded)


BLOCKS, CLIMB = (1141,), (120, 107, 126, 128)  # frames of each clip: 38 s, and 4 s each


@pytest.mark.parametrize(
    ("name", "lengths"),
    [
        ("blocks", BLOCKS),
        pytest.param("blocks_walk", BLOCKS, marks=pytest.mark.slow),
        pytest.param("blocks_causal", BLOCKS, marks=pytest.mark.slow),
        ("climb", CLIMB),
        pytest.param("two_grounds", (622, 520, *CLIMB), marks=pytest.mark.slow),
    ],
)
def test_the_experiments_on_captured_ground_make_a_problem(mocap, name, lengths):
    path = ROOT / "data" / "experiments" / f"{name}.toml"
    problem = problems.make_problem(experiment_files.load_experiment(path))
    assert tuple(len(scene.frames.dt) for scene in problem.data) == lengths
    for scene in problem.data:
        assert 0.9 < float(scene.reference.observed.mean()) <= 1.0


SETTINGS = """
fit = { starts = 2, max_steps = 50, search = { elite = 4, agreement = 1 } }
sample = { max_steps = 300, check_every = 30 }
prior.shape = "uniform"
prior.pelvis.half_life = { shape = "normal", centre = 0.3, spread = 1.0 }
start.foot.max_pitch = 0.5
"""


def test_settings_priors_and_start_are_those_of_the_file_and_are_written_back(tmp_path):
    loaded = load(tmp_path, top=SETTINGS)
    assert loaded.fit == FitOptions(2, SearchSettings(max_steps=50, elite=4, agreement=1.0))
    assert loaded.sample == SamplerSettings(max_steps=300, check_every=30)
    space = problems.make_problem(loaded).space
    np.testing.assert_array_equal(space.prior.uniform, [False, True])
    np.testing.assert_allclose(space.prior.spread, 1.0)
    assert float(space.values(space.prior.centre)[0]) == pytest.approx(0.3)
    preset = float(parameter_tree.get(jaxik.presets.record(), "pelvis.half_life"))
    np.testing.assert_allclose(space.values(space.start), [preset, 0.5])
    path = tmp_path / "again.toml"
    path.write_text(experiment_files.experiment_to_toml(loaded))
    reloaded = experiment_files.load_experiment(path)
    for field in ("fit", "sample", "prior", "start"):
        assert getattr(reloaded, field) == getattr(loaded, field)
    for table, expected in (
        ("shape = 'uniform'", ParameterPrior("uniform")),
        ("centre = 0.1", ParameterPrior(centre=0.1, spread=0.7)),
    ):
        rest = f"[prior]\nspread = 0.7\n[prior.pelvis]\nhalf_life = {{ {table} }}"
        prior = load(tmp_path, rest=rest).prior
        assert prior.of("foot.max_pitch") == ParameterPrior(spread=0.7)
        assert prior.of("pelvis.half_life") == expected
    # Also one that only a variant frees.
    variant = "[[without]]\nname = 'x'\nfree = { pelvis.limit = {} }"
    prior = "[prior.pelvis]\nlimit = { shape = 'uniform' }\n[start]\npelvis.limit = 0.2"
    loaded = load(tmp_path, rest=f"{variant}\n{prior}")
    assert not problems.make_problem(loaded).space.prior.uniform.any()
    without = ablation.without(loaded, loaded.without[0])
    space = without.space(without.starting_system())
    limit = space.names.index("pelvis.limit")
    assert space.prior.uniform[limit]
    assert float(space.values(space.start)[limit]) == pytest.approx(0.2)


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


def test_the_root_follows_a_hill_unless_it_stays_as_animated_or_its_system_puts_it_there(
    hill_folder,
):
    loaded = load(hill_folder, clips=HILL)
    clips = problems.load_clips(loaded)
    (scene,) = problems.problem_from_clips(loaded, clips).data
    line = next(problems.remarks(clips))
    assert line.startswith("root of walker seed 0: on the ground below it, 0 to ")
    data = problems.load_clip_data(loaded.clips[0], None)
    assert data.root.rise is not None
    np.testing.assert_allclose(scene.frames.world_from_model.pos[:, 1], data.root.rise)
    pelvis = np.asarray((scene.frames.world_from_model @ scene.pelvis).pos)
    placed = raised(data.base, data.root.rise)
    np.testing.assert_allclose(pelvis, placed.positions_ws[:, 0], atol=1e-9)
    (scene,) = problems.make_problem(load(hill_folder, clips=HILL, clip='root = "animation"')).data
    np.testing.assert_array_equal(scene.frames.world_from_model.pos[:, 1], 0.0)
    for root, own in (("ground", False), ("animation", True)):
        parts = {"top": 'preset = "ozz"', "clip": f'root = "{root}"', "free": "pelvis.limit = {}"}
        loaded = load(hill_folder, clips=HILL, **parts)
        system = problems.make_problem(loaded).space.system
        assert bool(parameter_tree.get(system, "root.enabled")) == own
        assert parts["clip"] in experiment_files.experiment_to_toml(loaded)
    rest, free = "[parameters]\nroot.enabled = true", "probe.stable_height = {}"
    loaded = load(hill_folder, top='preset = "mec"', free=free, rest=rest)
    assert [entry.root for entry in loaded.placed_clips()] == ["animation"]
    chosen = dataclasses.replace(loaded.clips[0], root="ground")
    assert dataclasses.replace(loaded, clips=(chosen,)).placed_clips() == (chosen,)


# In memory

NAMES = ("pelvis.half_life", "foot.max_pitch")


class MemoryPelvis(LowestPelvis):
    """A rule that no file knows."""

    extra: parameter_tree.Leaf = parameter(0.3, "1", 0.0, 1.0)


@pytest.fixture(scope="module")
def second(objects) -> ClipEntry:
    return clip_entry(**objects, start=1.0, end=2.0)


def test_objects_make_the_problem_that_their_files_make(second, tmp_path):
    path = write(tmp_path, free="pelvis.half_life = {}\nfoot.max_pitch = {}")
    of_files = problems.make_problem(experiment_files.load_experiment(path))
    free = ["pelvis.half_life", lambda ik: ik.foot.max_pitch]
    assert digest(problems.make_problem(make_experiment(second, free=free))) == digest(of_files)


def test_free_parameters_are_named_or_picked_by_their_leaf_or_cost_one_sentence(objects, second):
    ik = jaxik.presets.record()
    assert free_table("pelvis.limit", ik) == {"pelvis.limit": {}}
    both = free_table(lambda ik: (ik.pelvis.limit, ik.foot.max_pitch[0]), ik)
    assert both == {"pelvis.limit": {}, "foot.max_pitch[0]": {}}
    ranged = free_table({lambda ik: ik.pelvis.limit: {"low": 0.1}, "foot.max_pitch": {}}, ik)
    assert ranged == {"pelvis.limit": {"low": 0.1}, "foot.max_pitch": {}}
    for free, message in (
        ([], "names no parameter"),
        ([lambda ik: ik.pelvis.hight], "no attribute 'hight'; wanted a function that picks leaves"),
        ([lambda ik: 0.5], "a function picks .0.5.; wanted"),
        (["pelvis.hight"], "no parameter named 'pelvis.hight'; nearest is 'pelvis.limit'"),
        ([lambda ik: ik.lock.enabled], "no parameter named 'lock.enabled'"),
    ):
        with pytest.raises(ValueError, match=message):
            make_experiment(second, free=free)
    with pytest.raises(ValueError, match="'scale'.*say how files are read"):
        clip_entry(**objects, scale=0.01)
    with pytest.raises(ValueError, match="no clip; wanted one at least"):
        make_experiment(free=NAMES)
    late = make_experiment(clip_entry(**objects, start=900.0), free=NAMES)
    with pytest.raises(ValueError, match=Path(objects["reference"].source).name):
        problems.make_problem(late)


def test_a_rule_that_no_file_knows_is_fitted_from_memory_and_written_once_it_is_registered(
    second, tmp_path, monkeypatch
):
    ik = dataclasses.replace(jaxik.presets.record(), pelvis=MemoryPelvis(limit=0.2))
    experiment = make_experiment(second, free=[lambda ik: ik.pelvis.extra], system=ik)
    assert (experiment.preset, experiment.faithful) == ("record", False)
    space = problems.make_problem(experiment).space
    assert space.names == ("pelvis.extra",) and isinstance(space.system.pelvis, MemoryPelvis)
    assert float(space.system.pelvis.limit) == pytest.approx(0.2)
    with pytest.raises(ValueError, match="a file can name only after fitting.register_rule"):
        with_files(experiment, tmp_path)
    assert not list(tmp_path.iterdir())
    monkeypatch.setitem(systems.STAGES["pelvis"], "MemoryPelvis", MemoryPelvis)
    saved = with_files(experiment, tmp_path)
    (tmp_path / "experiment.toml").write_text(experiment_files.experiment_to_toml(saved, tmp_path))
    moved = tmp_path.rename(tmp_path.with_name("moved"))
    again = experiment_files.load_experiment(moved / "experiment.toml")
    (clip,) = again.clips
    assert clip.reference == moved / "captured.npz" and clip.terrain == moved / "terrain.ply"
    written = problems.make_problem(again).space
    assert isinstance(written.system.pelvis, MemoryPelvis)
    assert written.parameters == space.parameters
    moved.rename(tmp_path)  # where pytest looks for it


def test_clips_of_one_source_keep_their_own_ground(objects, tmp_path):
    heights, entries = [0.0, 0.5], []
    for height in heights:
        corners = np.array([[-9.0, height, -9.0], [9.0, height, -9.0], [0.0, height, 9.0]])
        ground = terrains.mesh(corners, np.array([[0, 2, 1]]))
        entries.append(clip_entry(**objects | {"terrain": ground}))
    saved = with_files(make_experiment(*entries, free=NAMES), tmp_path)
    meshes = [mesh_of(load_terrain(entry.terrain)) for entry in saved.clips]
    assert [mesh.vertices[:, 1].max() for mesh in meshes] == pytest.approx(heights)


def test_a_system_in_memory_means_the_same_in_files_and_can_lose_a_rule(second, tmp_path):
    variant = Ablation("another pelvis", rules={"pelvis": "ReachPelvis"})
    for own in (False, True):
        ik = parameter_tree.replace(jaxik.presets.ozz(), {"root.enabled": own})
        experiment = make_experiment(second, free="pelvis.limit", system=ik, without=(variant,))
        saved = with_files(experiment, tmp_path)
        roots = [[clip.root for clip in each.placed_clips()] for each in (experiment, saved)]
        assert roots[0] == roots[1]
        assert eqx.tree_equal(experiment.starting_system(), saved.starting_system())
    left = ablation.without(experiment, variant).starting_system()
    assert isinstance(left.pelvis, ReachPelvis)


def test_a_terrain_that_is_no_mesh_is_fitted_from_memory_but_not_saved(objects, tmp_path):
    entry = clip_entry(objects["reference"], terrains.plane(), objects["base"], root="animation")
    experiment = make_experiment(entry, free="pelvis.limit")
    assert with_files(experiment, None) is experiment
    with pytest.raises(ValueError, match="its terrain cannot be saved; fit without an output: a"):
        with_files(experiment, tmp_path)
    assert list(tmp_path.iterdir()) == []
