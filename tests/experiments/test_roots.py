"""Where experiments put the roots of their clips."""

import dataclasses

import numpy as np
import pytest

from fitting.datasets import ground_path
from fitting.datasets.clip_frames import raised
from fitting.datasets.clips import save_clip
from fitting.datasets.synthetic import walker
from fitting.datasets.terrain.mesh_files import save_mesh
from fitting.experiments import experiment_files, problems
from fitting.experiments.experiment import Experiment
from jaxik.maths import parameter_tree
from support.experiments import write
from support.grounds import hill

CLIP = """
[[clips]]
reference = "reference.npz"
base = "base.npz"
terrain = "hill.ply"
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A flat walk, and the same raised onto a hill as its reference."""
    path = tmp_path_factory.mktemp("hill")
    base = walker.walk(8.0, 30.0)
    rise = np.linspace(0.0, 2.0, base.frame_count)
    save_clip(path / "base.npz", base)
    save_clip(path / "reference.npz", raised(base, rise))
    save_mesh(path / "hill.ply", *hill())
    return path


def load(folder, **parts: str) -> Experiment:
    return experiment_files.load_experiment(write(folder, clips=CLIP, **parts))


def test_by_default_the_root_follows_a_hill_and_the_log_says_so(folder):
    loaded, lines = load(folder), []
    (scene,) = problems.make_problem(loaded, lines.append).data
    assert lines[0].startswith("root of walker seed 0: on the ground below it, 0 to ")
    data = problems.load_clip_data(loaded.clips[0], None)
    assert data.root.rise is not None
    np.testing.assert_allclose(scene.frames.world_from_model.pos[:, 1], data.root.rise)
    pelvis = np.asarray((scene.frames.world_from_model @ scene.pelvis).pos)
    placed = raised(data.base, data.root.rise)
    np.testing.assert_allclose(pelvis, placed.positions_ws[:, 0], atol=1e-9)


def test_the_root_can_stay_as_animated(folder):
    (scene,) = problems.make_problem(load(folder, clip='root = "animation"')).data
    np.testing.assert_array_equal(scene.frames.world_from_model.pos[:, 1], 0.0)


def test_a_system_does_not_put_itself_on_the_ground_once_more(folder):
    for root, own in (("ground", False), ("animation", True)):
        loaded = load(
            folder, top='preset = "ozz"', clip=f'root = "{root}"', free="pelvis.limit = {}"
        )
        system = problems.make_problem(loaded).space.system
        assert bool(parameter_tree.get(system, "root.enabled")) == own


def test_a_system_that_is_told_to_put_itself_on_the_ground_does_so_alone(folder):
    loaded = load(
        folder, top='preset = "mec"', free="probe.stable_height = {}",
        rest="[parameters]\nroot.enabled = true",
    )  # fmt: skip
    assert [entry.root for entry in loaded.placed_clips()] == ["animation"]
    chosen = dataclasses.replace(loaded.clips[0], root="ground")
    assert dataclasses.replace(loaded, clips=(chosen,)).placed_clips() == (chosen,)


def test_an_unknown_root_is_rejected(folder):
    with pytest.raises(ValueError, match=r"root is 'floor'; wanted one of \['auto', 'animation'"):
        load(folder, clip='root = "floor"')
    assert ground_path.ROOTS == ("auto", "animation", "ground")


def test_the_root_is_written_with_the_clip(folder):
    loaded = load(folder, clip='root = "ground"')
    assert 'root = "ground"' in experiment_files.experiment_to_toml(loaded)
