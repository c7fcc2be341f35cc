"""First experiments of one's own clips: what `jaxik init` writes, and what it says of the clips."""

import dataclasses
import re
import tomllib

import numpy as np
import pytest

from fitting import jobs
from fitting.cli import main
from fitting.datasets.clips import load_clip, save_clip
from fitting.experiments import experiment_files
from fitting.experiments.experiment import DEFAULT_SIGMAS, ClipEntry
from fitting.experiments.problems import load_clip_data
from fitting.experiments.schema.experiment_schema import experiment_schema
from fitting.experiments.systems import Preset
from fitting.inference import choice
from fitting.problem.prior import SPREAD
from fitting.studies.drafts import assumptions, draft
from fitting.studies.drafts.draft import DraftRequest
from support.experiments import ROOT

WALK, BASE = ROOT / "data/clips/uneven_walk.npz", ROOT / "data/clips/uneven_walk_base.npz"
GROUND = ROOT / "data/terrains/uneven_walk.ply"


@pytest.fixture(scope="module")
def drafted(tmp_path_factory):
    """A draft of three seconds of the uneven walk, its folder, and what the command printed."""
    folder = tmp_path_factory.mktemp("clips")
    for source in (WALK, BASE):
        clip = load_clip(source)
        save_clip(folder / source.name, clip.select(slice(0, round(3 * clip.fps))))
    request = DraftRequest(
        clips=(folder / WALK.name,),
        terrains=(GROUND,),
        bases=(folder / BASE.name,),
        preset=Preset("record", faithful=True),
    )
    lines: list[str] = []
    jobs.init(request, folder / "draft", log=lines.append)
    return folder / "draft" / draft.EXPERIMENT, "\n".join(lines)


@pytest.mark.slow
def test_a_first_experiment_is_read_as_it_was_meant(drafted):
    path, _ = drafted
    experiment = experiment_files.load_experiment(path)
    (entry,) = experiment.clips
    assert (entry.terrain, entry.base) == (GROUND, path.parents[1] / BASE.name)
    assert experiment.faithful and experiment.noise.sigmas == "estimated"
    written_in, text = (str(path.parent), path.read_text())
    assert text.count(written_in) == text.count(str(path.parents[1])) == 1, "paths are relative"


@pytest.mark.slow
def test_parameters_are_free_that_move_the_clip_and_no_others(drafted):
    free = experiment_files.load_experiment(drafted[0]).free
    assert {"contact.planted_height", "pelvis.limit", "lock.release_distance"} <= free.keys()
    silent = {"warp.width", "probe.max_slope", "pelvis.off_gain", "lean.gain_slide"}
    assert not silent & free.keys(), "no warp, no refused ground, no flight, no slide"


@pytest.mark.slow
def test_every_key_of_an_experiment_is_there_with_its_meaning(drafted):
    lines = drafted[0].read_text().splitlines()
    schema = experiment_schema()["properties"]
    for table, entry in {**schema, "[[clips]]": schema["clips"]["items"]}.items():
        for key, value in entry.get("properties", {}).items():
            if table not in ("rules", "parameters", "free", "prior", "start") and (
                value.get("type") not in ("object", "array") or table == "[[clips]]"
            ):
                text = value["description"]
                assert any(re.match(rf"(# )?{key} =.*  # ", x) and text in x for x in lines), key


@pytest.mark.slow
def test_what_is_commented_out_is_what_the_reader_takes_in_its_place(drafted):
    path, _ = drafted
    shown = re.sub(r"^# ([\w.\"\[\]]+ = (?!\s))", r"\1", path.read_text(), flags=re.MULTILINE)
    (free,) = re.findall(r"^\[free\].*?(?=^\[prior\])", path.read_text(), re.MULTILINE | re.DOTALL)
    shown = re.sub(r"^\[free\].*?(?=^\[prior\])", free, shown, flags=re.MULTILINE | re.DOTALL)
    assert shown.count("\n# ") < path.read_text().count("\n# ") - 20
    as_it_is = experiment_files.load_experiment(path)
    whole = experiment_files.parse_experiment(tomllib.loads(shown), path)
    for field in dataclasses.fields(whole):
        if field.name not in ("sigmas", "prior"):
            assert getattr(whole, field.name) == getattr(as_it_is, field.name), field.name
    assert whole.prior.of("pelvis.limit").spread == SPREAD
    assert dict(whole.sigmas) == DEFAULT_SIGMAS


@pytest.mark.slow
def test_the_command_says_what_it_assumes(drafted):
    text = drafted[1]
    assert "legs 0.8" in text and "the left knee bends by" in text
    assert re.search(r"ground +below 100% of the stances; soles stand", text)
    assert re.search(r"free: \d+ of 53 parameters", text) and "now: jaxik fit" in text


def test_without_ground_it_is_reconstructed_where_the_feet_stand(tmp_path, monkeypatch, capsys):
    def choose_free(ik, candidates, scenes):
        return [choice.Forecast(name, name == "pelvis.limit", 1.0, 0.9) for name in candidates]

    monkeypatch.setattr(draft, "choose_free", choose_free)
    words = ["init", str(WALK), "--record-only", "-o", str(tmp_path / "walk")]
    assert main.main(words) == 0
    text = capsys.readouterr().out
    assert text.startswith("no --terrain: the ground is reconstructed")
    assert re.search(r"reconstructed from \d+ stances \(.*a scan of the ground", text)
    experiment = experiment_files.load_experiment(tmp_path / "walk" / draft.EXPERIMENT)
    (entry,) = experiment.clips
    assert entry.terrain == tmp_path / "walk" / "ground_uneven_walk.ply" and entry.base is None
    assert experiment.record_only and list(experiment.free) == ["pelvis.limit"]
    assert experiment.fps == (30.0 if load_clip(WALK).fps > 45 else None)
    assert main.main(words) == 2
    assert "experiment.toml: is there already; name another folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["a.npz", "b.npz", "c.npz", "--terrain", "a", "b"], "3 clip(s) and 2 terrains; wanted"),
        (["a.npz", "b.npz", "--base", "a"], "2 clip(s) and 1 base(s); wanted none, or one"),
        (["a.npz", "--preset", "ozz", "--record-only"], "made of the preset 'record', not 'ozz'"),
        (["a.npz", "--preset", "nobody"], "no preset named 'nobody'"),
        (["a.npz"], "a.npz: no such file"),
        (
            ["a.bvh", "--terrain-scale", "0.01"],
            "no --terrain that the options of terrains could be",
        ),
        (["a.npz", "--scale", "0.01"], "the clips: scale is of no use: an .npz states"),
    ],
)
def test_what_no_experiment_can_be_made_of_is_refused(
    words, message, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert main.main(["init", *words, "-o", "new"]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_of_two_parameters_that_do_the_same_only_one_is_free():
    slopes = np.array([[1.0, 2.0, 0.0], [1.0, 2.0, 1e-3], [0.0, 0.0, 3.0], [0.0, 0.01, 0.0]])
    free, rivals = choice._narrowed_down(slopes @ slopes.T)
    assert 2 in free and 3 not in free
    assert len({0, 1} & set(free)) == 1
    (left_out,) = {0, 1} - set(free)
    assert rivals[left_out] == 1 - left_out


def test_ground_of_another_clip_is_doubted():
    entry = ClipEntry(WALK, GROUND, BASE)
    data = load_clip_data(entry, None)
    assert not ground_of(data).advice
    moved = data.reference.positions_ws + np.array([0.0, 0.0, 0.7])
    other = data._replace(reference=data.reference.with_motion(moved, data.reference.rotations_ws))
    assert ground_of(other).advice == "does this ground belong to this clip?"


def ground_of(data):
    """What is assumed of the ground of a clip."""
    assumed = assumptions.of_clip(data, None, base_is_own=True)
    (ground,) = (assumption for assumption in assumed if assumption.topic == "ground")
    return ground
