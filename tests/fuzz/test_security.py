"""Files that mean harm: nothing in them is run, and nothing is written where they say."""

import ast
import json
import os
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

import house
from fitting.cli import main
from fitting.clips import load_clip, save_clip
from fitting.clips.formats.npz import holds_base
from fitting.experiment.experiment import ClipEntry
from fitting.experiment.experiment_files import load_experiment, parse_experiment
from fitting.ground.meshes import load_terrain
from fitting.report import style
from fitting.studies.campaign import clip_names
from support import experiments
from support.sample_clips import BVH

ELSEWHERE = "../../elsewhere"


class Harmful:
    """Makes a folder when it is unpickled."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple:
        return os.mkdir, (str(self.target),)


@pytest.mark.parametrize("name", ["positions_ws", "heights", "base_pelvis", "format"])
def test_nothing_is_unpickled(name, tmp_path):
    path, target = tmp_path / "file.npz", tmp_path / "written"
    harmful = np.array([Harmful(target)], object)
    for write in (
        lambda: harmful.dump(path),  # a pickle under the name of an archive
        lambda: np.savez(path, **{name: harmful, "spacing": np.ones(2)}),
    ):
        write()
        for load in (load_clip, load_terrain):
            with pytest.raises(ValueError, match="file.npz: wanted a NumPy archive of plain arra"):
                load(path)
    holds_base(path)
    assert not target.exists()
    with np.load(path, allow_pickle=True) as archive:  # it would work
        archive[name]
    assert target.exists()


@pytest.mark.parametrize("package", house.PACKAGES)
def test_no_module_unpickles_or_runs_text(package):
    for path, tree in house.parsed(package).trees.items():
        for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
            name = ast.unparse(call.func)
            keywords = {word.arg: word.value for word in call.keywords}
            if name in ("np.load", "numpy.load"):
                assert ast.unparse(keywords["allow_pickle"]) == "False", path
            assert name not in ("eval", "exec", "compile", "os.system", "np.fromregex"), path
            assert "shell" not in keywords or name == "shtab.complete", path  # a kind of shell
            if name.endswith("pickle.loads"):  # between the processes of one call
                assert path == house.ROOT / "fitting" / "runtime" / "cluster.py"
            assert not name.endswith("pickle.load"), path


def test_names_of_joints_and_clips_are_no_paths(tmp_path, monkeypatch, capsys):
    inside = tmp_path / "a" / "b"
    inside.mkdir(parents=True)
    monkeypatch.chdir(inside)
    Path("walk.bvh").write_text(BVH.replace("JOINT LeftFoot", f"JOINT {ELSEWHERE}_LeftFoot"))
    clip = load_clip("walk.bvh")
    assert any(ELSEWHERE in name for name in clip.joint_names)
    save_clip("walk.npz", clip)
    assert load_clip("walk.npz").joint_names == clip.joint_names
    assert main.main(["inspect", "walk.npz", "--json"]) == 0
    assert ELSEWHERE in json.dumps(json.loads(capsys.readouterr().out))
    assert set(tmp_path.rglob("*")) == {inside.parent, inside, *inside.glob("walk.*")}
    references = ("../../etc/passwd.bvh", "/etc/walk.bvh", "/tmp/walk.bvh", "..npz", "a/...npz")
    entries = [ClipEntry(Path(name), Path("hill.ply")) for name in references]
    for name in clip_names(entries):
        assert "/" not in name and (Path("clips") / f"{name}.toml").parent == Path("clips")


def test_a_name_in_an_experiment_is_looked_up_in_a_table_and_a_parameter_is_no_attribute(tmp_path):
    for top in ('preset = "os"', 'rules.pelvis = "__class__"', 'body = "os"'):
        with pytest.raises(ValueError, match="experiment.toml"):
            load_experiment(experiments.write(tmp_path, top=top))
    for stage, leaf in (("__class__", "x"), ("leg", "__init__"), ("leg", "__dict__")):
        content = {"free": {"leg.soften": {}}, "parameters": {stage: {leaf: 1.0}}}
        content["clips"] = [dict.fromkeys(("reference", "terrain"), str(house.ROOT / "README.md"))]
        loaded = parse_experiment(content, tmp_path / "e.toml")
        with pytest.raises(ValueError, match="e.toml .parameters.: unknown key"):
            loaded.starting_system()


def test_a_plot_shows_a_name_that_looks_like_a_formula(tmp_path):
    for name in (r"$\frac{$", "$x^$", "a $ b", "$x$"):
        figure = Figure(layout="constrained")
        figure.subplots().set(title=name, yscale="log")
        style.save(tmp_path / "a.png", figure)
        assert (tmp_path / "a.png").stat().st_size > 1000
