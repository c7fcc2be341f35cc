"""The table [hierarchy] and `leg_length` in files: what is read, written and refused."""

import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from fitting.datasets.clips import load_clip, save_clip
from fitting.experiments import parameter_files
from fitting.experiments.experiment_files import experiment_to_toml, load_experiment
from fitting.experiments.hierarchies import Hierarchy
from fitting.experiments.problems import load_clip_data, make_problem
from fitting.experiments.systems import Preset
from fitting.jobs import animations
from fitting.studies import ablation
from fitting.studies.animations import AnimationFiles
from jaxik import presets
from jaxik.maths import parameter_tree
from jaxik.world import body
from support.bodies import scaled
from support.experiments import CLIP, ROOT, write

BASE = ROOT / "data" / "clips" / "uneven_walk_base.npz"


def clips(*subjects: str | None) -> str:
    """As many clips of a tenth of a second."""
    tables = []
    for number, subject in enumerate(subjects):
        cut = f"start = {number}.0\nend = {number}.1\n"
        tables.append(CLIP + cut + (f'subject = "{subject}"\n' if subject else ""))
    return "".join(tables)


def load(tmp_path, table: str, *subjects: str | None, top: str = ""):
    parts = {"clips": clips(*subjects), "rest": f"[hierarchy]\n{table}", "top": top}
    return load_experiment(write(tmp_path, **parts))


def test_a_hierarchy_is_read_and_written_again(tmp_path):
    table = 'per_subject = ["foot.max_pitch"]\nper_clip = ["pelvis.on_gain"]\n'
    experiment = load(tmp_path, table + "scale_with_body = true", "ann", "ben", "ann")
    assert experiment.hierarchy == Hierarchy(("foot.max_pitch",), ("pelvis.on_gain",), True)
    (tmp_path / "again.toml").write_text(experiment_to_toml(experiment))
    again = load_experiment(tmp_path / "again.toml")
    assert again.hierarchy == experiment.hierarchy and again.clips == experiment.clips
    names = ("pelvis.on_gain", "leg.soften", "foot.max_pitch")
    grouping = experiment.hierarchy.grouping(names, ("x", "y", "z"), ("ann", "ben", "ann"))
    np.testing.assert_array_equal(grouping.group, [[0, -1, 0], [1, -1, 1], [2, -1, 0]])
    assert Hierarchy().grouping(names, ("x", "y"), ("x", "y")).varying == ()


def test_an_experiment_without_a_hierarchy_writes_none_and_scales_nothing(tmp_path):
    experiment = load(tmp_path, "", None)
    assert experiment.hierarchy == Hierarchy() and "per_clip" not in experiment_to_toml(experiment)
    assert make_problem(experiment).data[0].size is None


BOTH = 'per_clip = ["foot.max_pitch"]\nper_subject = ["foot.max_pitch"]'


@pytest.mark.parametrize(
    ("table", "subjects", "message"),
    [
        ("per_clips = []", ("ann",), "unknown key 'per_clips'; nearest is 'per_clip'"),
        ('per_clip = "foot.max_pitch"', ("ann", "ben"), "wanted a list of names"),
        ('per_clip = ["foot.max_roll"]', ("ann", "ben"), "'foot.max_roll' is not free; free are"),
        (BOTH, ("ann", "ben"), "'foot.max_pitch' stands twice; wanted it per clip or per subject"),
        ('per_clip = ["foot.max_pitch"]', ("ann",), "per_clip needs two clips or more"),
        ('per_subject = ["foot.max_pitch"]', ("ann", None), r"in each of \[\[clips\]\]; clip 2 h"),
        ('per_subject = ["foot.max_pitch"]', ("ann", "ann"), "all clips are of 'ann'"),
        ("scale_with_body = 1", ("ann",), "scale_with_body is 1; wanted true or false"),
    ],
)
def test_a_wrong_hierarchy_is_refused(tmp_path, table, subjects, message):
    with pytest.raises(ValueError, match=rf"\[hierarchy\].*{message}"):
        load(tmp_path, table, *subjects)


@pytest.mark.parametrize("meant_for", ["clip", "adult"])
def test_each_clip_has_the_size_of_its_body_over_the_one_that_numbers_are_for(tmp_path, meant_for):
    experiment = load(tmp_path, "scale_with_body = true", None, top=f'body = "{meant_for}"')
    rig = make_problem(experiment).data[0].rig
    giant = scaled(load_clip(BASE), 2.0).rig
    expected = 2.0 if meant_for == "clip" else 2.0 * body.ratio(rig)
    assert experiment.size(giant, rig) == pytest.approx(expected)
    size = make_problem(experiment).data[0].size
    assert size is not None and float(size) == pytest.approx(expected / 2)
    leg_length = body.leg_length(rig) if meant_for == "clip" else body.LEG
    assert experiment.leg_length(rig) == pytest.approx(leg_length)


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
    expected = [0.1 * ratio, 0.2 * ratio**0.5]
    found = [parameter_tree.get(other, name) for name in ("target.foot_height", "root.half_life")]
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    assert jnp.isinf(parameter_tree.get(other, "pelvis.limit"))
    path.write_text('preset = "ozz"\nleg_length = 0.0\n')
    with pytest.raises(ValueError, match="leg_length is 0.0; wanted a number of metres from"):
        parameter_files.load_system(path)


def test_a_run_is_applied_to_the_body_of_the_animation(tmp_path, monkeypatch):
    ik = parameter_tree.replace(presets.ozz(), {"target.foot_height": 0.1})
    (tmp_path / "parameters.toml").write_text(
        parameter_files.system_to_toml(ik, Preset("ozz"), 0.84)
    )
    row = {"name": "target.foot_height", "unit": "m", "u": 0.0, "start_sd": 1.0, "value": 0.1}
    fit = {"parameters": [row | {"determined": True}]}
    (tmp_path / "fit.json").write_text(json.dumps(fit))
    save_clip(tmp_path / "giant.npz", scaled(load_clip(BASE), 2.0))
    applied = []
    monkeypatch.setattr(animations, "solve", lambda ik, *_, **__: applied.append(ik))
    files = AnimationFiles(tmp_path / "giant.npz", tmp_path / "unused.ply")
    animations.apply(tmp_path, files)
    ratio = body.leg_length(files.flat_clip.rig) / 0.84
    height = float(parameter_tree.get(applied[0], "target.foot_height"))
    assert height == pytest.approx(0.1 * ratio) and ratio > 1.9


def test_an_ablation_measures_each_clip_with_its_body(tmp_path, monkeypatch):
    experiment = load(tmp_path, "scale_with_body = true", None)
    experiment = replace(experiment, free={})
    clip = load_clip_data(experiment.clips[0], None)
    giant = clip._replace(base=scaled(clip.base, 2.0))
    rays = []

    def errors(ik, data, frames):
        rays.append(float(parameter_tree.get(ik, "probe.ray_up")))

    monkeypatch.setattr(ablation, "_errors", errors)
    monkeypatch.setattr(ablation, "summarise", lambda errors: None)
    measured = [(clip, slice(None)), (giant, slice(None))]
    ablation._fit(experiment, ablation.Split("", [], measured), None)
    assert rays[1] == pytest.approx(2.0 * rays[0], rel=1e-4)
