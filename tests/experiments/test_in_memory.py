"""Experiments of objects in memory: the same problems as those of files, with rules of any kind."""

import dataclasses
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest

import fitting
import jaxik
from fitting.datasets.terrain.meshes import mesh_of
from fitting.experiments import experiment_files, problems, systems
from fitting.experiments.ablations import Ablation
from fitting.experiments.experiment import Experiment
from fitting.experiments.in_memory.making import clip_entry, make_experiment
from fitting.experiments.in_memory.saving import with_files
from fitting.experiments.in_memory.selectors import free_table
from fitting.problem.digest import digest
from fitting.studies.ablation import without
from jaxik.maths import parameter_tree
from jaxik.maths.parameter_tree import Leaf, parameter
from jaxik.stages.pelvis import LowestPelvis, ReachPelvis
from jaxik.world import terrain as terrains
from support.experiments import ROOT, write

NAMES = ("pelvis.on_gain", "foot.max_pitch")


class MemoryPelvis(LowestPelvis):
    """A rule that no file knows."""

    extra: Leaf = parameter(0.3, unit="1", low=0.0, high=1.0, doc="Of no effect.")


@pytest.fixture(scope="module")
def objects() -> dict:
    """The captured walk, its flat animation and its ground, as a notebook has loaded them."""
    with jax.enable_x64(True):
        return {
            "reference": fitting.load_clip(ROOT / "data/clips/uneven_walk.npz"),
            "base": fitting.load_clip(ROOT / "data/clips/uneven_walk_base.npz"),
            "terrain": fitting.load_terrain(ROOT / "data/terrains/uneven_walk.ply"),
        }


@pytest.fixture(scope="module")
def second(objects):
    return clip_entry(**objects, start=1.0, end=2.0)


def of_own_rule(entry) -> Experiment:
    ik = dataclasses.replace(jaxik.presets.record(), pelvis=MemoryPelvis(limit=0.2))
    return make_experiment(entry, free=[lambda ik: ik.pelvis.extra], system=ik)


def test_objects_make_the_problem_that_their_files_make(second, tmp_path):
    path = write(tmp_path, free="pelvis.on_gain = {}\nfoot.max_pitch = {}")
    of_files = problems.make_problem(experiment_files.load_experiment(path))
    free = ["pelvis.on_gain", lambda ik: ik.foot.max_pitch]
    assert digest(problems.make_problem(make_experiment(second, free=free))) == digest(of_files)


def test_free_parameters_are_named_or_picked_by_their_leaf():
    ik = jaxik.presets.record()
    assert free_table("pelvis.limit", ik) == {"pelvis.limit": {}}
    both = free_table(lambda ik: (ik.pelvis.limit, ik.foot.max_pitch[0]), ik)
    assert both == {"pelvis.limit": {}, "foot.max_pitch[0]": {}}
    ranged = free_table({lambda ik: ik.pelvis.limit: {"low": 0.1}, "foot.max_pitch": {}}, ik)
    assert ranged == {"pelvis.limit": {"low": 0.1}, "foot.max_pitch": {}}


def test_what_picks_no_parameter_costs_one_sentence(second):
    for free, message in (
        ([], "names no parameter"),
        ([lambda ik: ik.pelvis.hight], "no attribute 'hight'; wanted a function that picks leaves"),
        ([lambda ik: 0.5], "a function picks .0.5.; wanted"),
        (["pelvis.hight"], "no parameter named 'pelvis.hight'; nearest is 'pelvis.limit'"),
        ([lambda ik: ik.lock.enabled], "no parameter named 'lock.enabled'"),
    ):
        with pytest.raises(ValueError, match=message):
            make_experiment(second, free=free)


def test_a_rule_that_no_file_knows_is_fitted_from_memory_and_written_once_it_is_registered(
    second, tmp_path, monkeypatch
):
    experiment = of_own_rule(second)
    assert (experiment.preset, experiment.faithful) == ("record", False)
    space = problems.make_problem(experiment).space
    assert space.names == ("pelvis.extra",) and isinstance(space.system.pelvis, MemoryPelvis)
    assert float(space.system.pelvis.limit) == pytest.approx(0.2)
    with pytest.raises(ValueError, match="a file can name only after fitting.register_rule"):
        with_files(experiment, tmp_path)
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setitem(systems.STAGES["pelvis"], "MemoryPelvis", MemoryPelvis)
    saved = with_files(experiment, tmp_path)
    text = experiment_files.experiment_to_toml(saved, tmp_path)
    (tmp_path / "experiment.toml").write_text(text)
    moved = tmp_path.rename(tmp_path.with_name("moved"))
    again = experiment_files.load_experiment(moved / "experiment.toml")
    (clip,) = again.clips
    assert clip.reference == moved / "captured.npz" and clip.terrain == moved / "terrain.ply"
    written = problems.make_problem(again).space
    assert isinstance(written.system.pelvis, MemoryPelvis)
    assert written.parameters == space.parameters
    moved.rename(tmp_path)  # where pytest looks for it


def test_clips_of_one_source_keep_their_own_ground(objects, tmp_path):
    low, high = terrain_at(0.0), terrain_at(0.5)
    entries = [clip_entry(**objects | {"terrain": ground}) for ground in (low, high)]
    saved = with_files(make_experiment(*entries, free=NAMES), tmp_path)
    meshes = [mesh_of(fitting.load_terrain(entry.terrain)) for entry in saved.clips]
    heights = [mesh.vertices[:, 1].max() for mesh in meshes]
    assert heights == pytest.approx([0.0, 0.5])


def terrain_at(height: float) -> terrains.Terrain:
    corners = np.array([[-9.0, height, -9.0], [9.0, height, -9.0], [0.0, height, 9.0]])
    return terrains.mesh(corners, np.array([[0, 2, 1]]))


def test_a_rule_is_left_out_of_a_system_in_memory(second):
    ablation = Ablation("another pelvis", rules={"pelvis": "ReachPelvis"})
    experiment = make_experiment(
        second, free="leg.soften", system=jaxik.presets.record(), without=(ablation,)
    )
    left = without(experiment, ablation).starting_system()
    assert isinstance(left.pelvis, ReachPelvis)


@pytest.mark.parametrize("own", [False, True])
def test_files_of_what_is_in_memory_mean_the_same(second, own, tmp_path):
    ik = parameter_tree.replace(jaxik.presets.ozz(), {"root.enabled": own})
    experiment = make_experiment(second, free="pelvis.limit", system=ik)
    saved = with_files(experiment, tmp_path)
    roots = [[clip.root for clip in each.placed_clips()] for each in (experiment, saved)]
    assert roots[0] == roots[1]
    assert eqx.tree_equal(experiment.starting_system(), saved.starting_system())


def test_a_terrain_that_is_no_mesh_is_fitted_from_memory_but_not_saved(objects, tmp_path):
    entry = clip_entry(objects["reference"], terrains.plane(), objects["base"], root="animation")
    experiment = make_experiment(entry, free="pelvis.limit")
    assert with_files(experiment, None) is experiment
    with pytest.raises(ValueError, match="its terrain cannot be saved; fit without an output: a"):
        with_files(experiment, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_what_a_clip_in_memory_cannot_have_costs_one_sentence(objects):
    with pytest.raises(ValueError, match="'scale'.*say how files are read"):
        clip_entry(**objects, scale=0.01)
    with pytest.raises(ValueError, match="no clip; wanted one at least"):
        make_experiment(free=NAMES)
    late = make_experiment(clip_entry(**objects, start=900.0), free=NAMES)
    with pytest.raises(ValueError, match=Path(objects["reference"].source).name):
        problems.make_problem(late)
