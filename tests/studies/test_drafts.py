"""First experiments of one's own clips: what `jaxik init` writes, and what it says of the clips."""

import dataclasses
import re
import tomllib
from pathlib import Path
from unittest.mock import Mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from fitting import jobs
from fitting.cli import main
from fitting.clips import Clip, load_clip, save_clip
from fitting.experiment import experiment_files, problems, systems
from fitting.experiment.experiment import DEFAULT_SIGMAS, ClipEntry
from fitting.experiment.problems import load_clip_data
from fitting.experiment.schema import experiment_schema
from fitting.experiment.systems import Preset
from fitting.inference import sensitivity
from fitting.inference.noise import NoiseOptions
from fitting.problem.space import SPREAD, free_parameter, make_space
from fitting.studies import draft
from fitting.studies.draft import DraftRequest
from jaxik.maths import parameter_tree
from support import quick
from support.experiments import ROOT, write
from support.sample_clips import flat_floor, stair_walk
from support.small_studies import HALF_SECOND
from support.watching import listening

WALK, BASE = ROOT / "data/clips/uneven_walk.npz", ROOT / "data/clips/uneven_walk_base.npz"
GROUND = ROOT / "data/terrains/uneven_walk.ply"


def choose_few(ik, candidates, scenes):
    """A forecast that needs no pipeline."""
    return [sensitivity.Forecast(name, name == "pelvis.limit", 1.0, 0.9) for name in candidates]


def first_seconds(path: Path) -> Clip:
    """Three of them."""
    clip = load_clip(path)
    return clip.select(slice(0, round(3 * clip.fps)))


@pytest.fixture(scope="module")
def drafted(tmp_path_factory) -> tuple[Path, str]:
    """A draft of three seconds of the uneven walk, and what the command printed."""
    folder = tmp_path_factory.mktemp("clips")
    for source in (WALK, BASE):
        save_clip(folder / source.name, first_seconds(source))
    preset = Preset("record", faithful=True)
    request = DraftRequest((folder / WALK.name,), (GROUND,), (folder / BASE.name,), preset)
    lines: list[str] = []
    with pytest.MonkeyPatch.context() as patch, listening(lines.append):
        patch.setattr(draft, "choose_free", choose_few)
        patch.setattr(problems, "load_clip", Mock(side_effect=AssertionError("read twice")))
        jobs.init(request, folder / "draft")
    return folder / "draft" / draft.EXPERIMENT, "\n".join(lines)


def test_a_first_experiment_is_read_as_it_was_meant(drafted):
    path, _ = drafted
    experiment = experiment_files.load_experiment(path)
    (entry,) = experiment.clips
    assert (entry.terrain, entry.base) == (GROUND, path.parents[1] / BASE.name)
    assert experiment.faithful and experiment.noise == NoiseOptions("given", "counted")
    assert (experiment.loss, experiment.holdout) == ("huber", 1 / 3)
    written_in, text = (str(path.parent), path.read_text())
    assert text.count(written_in) == text.count(str(path.parents[1])) == 1, "paths are relative"


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


def test_the_command_says_what_it_assumes(drafted):
    text = drafted[1]
    assert "legs 0.8" in text and "the left knee bends by" in text
    assert re.search(r"ground +below 100% of the stances; soles stand", text)
    assert "free: 1 of 62 parameters" in text and "now: jaxik fit" in text


@pytest.mark.slow
def test_without_ground_it_is_reconstructed_where_the_feet_stand(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(draft, "choose_free", choose_few)
    clip = first_seconds(WALK)
    save_clip(tmp_path / WALK.name, clip)
    words = ["init", str(tmp_path / WALK.name), "--record-only", "-o", str(tmp_path / "walk")]
    assert main.main(words) == 0
    text = capsys.readouterr().out
    assert text.startswith("no --terrain: the ground is reconstructed")
    assert re.search(r"reconstructed from \d+ stances \(.*a scan of the ground", text)
    experiment = experiment_files.load_experiment(tmp_path / "walk" / draft.EXPERIMENT)
    (entry,) = experiment.clips
    assert entry.terrain == tmp_path / "walk" / "ground_uneven_walk.ply" and entry.base is None
    feet = clip.joints_ws(3)[clip.stance_labels()][:, [0, 2]]
    reach = trimesh.load_mesh(entry.terrain, process=False).bounds[:, [0, 2]]
    np.testing.assert_allclose(reach, [feet.min(axis=0) - 2.0, feet.max(axis=0) + 2.0], atol=0.3)
    assert experiment.record_only and list(experiment.free) == ["pelvis.limit"]
    assert experiment.fps == (30.0 if clip.fps > 45 else None)
    assert main.main(words) == 2
    assert "experiment.toml: is there already; name another folder" in capsys.readouterr().err


def test_legs_that_walk_get_stride_and_those_that_never_stand_record():
    clip, lines = load_clip(BASE), []
    stance = clip.stance_labels().copy()
    stance[:, 1] = False
    rides = dataclasses.replace(clip, stance=stance)
    with listening(lines.append):
        chosen = [systems.choose_preset(clips) for clips in ([clip], [rides], [clip, rides])]
    assert [preset.name for preset in chosen] == ["stride", "record", "record"]
    assert lines[0] == "preset stride, as all feet stand in turn; --preset takes another"
    assert lines[1] == lines[2] == "preset record, as a foot never stands; --preset takes another"
    named = DraftRequest((WALK,), preset=Preset("ozz"))
    assert named.preset_for([clip]).name == "ozz"
    assert DraftRequest((WALK,)).preset_for([clip]).name == "stride"
    only = dataclasses.replace(named, preset=None, record_only=True)
    assert only.preset_for([clip]) == Preset("record", faithful=True)


def test_of_two_parameters_that_do_the_same_only_one_is_free():
    slopes = np.array([[1.0, 2.0, 0.0], [1.0, 2.0, 1e-3], [0.0, 0.0, 3.0], [0.0, 0.01, 0.0]])
    free, rivals = sensitivity._narrowed_down(slopes @ slopes.T)
    assert 2 in free and 3 not in free
    assert len({0, 1} & set(free)) == 1
    (left_out,) = {0, 1} - set(free)
    assert rivals[left_out] == 1 - left_out


@pytest.fixture
def candidates(tmp_path, monkeypatch):
    """Parameters and a clip; two move it alone, a third only where another has another value."""
    problem = problems.make_problem(
        experiment_files.load_experiment(write(tmp_path, clips=HALF_SECOND))
    )
    limit = parameter_tree.get(problem.space.system, "pelvis.limit")

    def residuals(ik, scenes):
        hidden = ik.lean.half_life_slide * (ik.pelvis.limit - limit)
        return jnp.append(quick.residuals_of_scenes(ik, scenes), 100.0 * hidden)

    def residuals_of_batch(space, scenes, candidates):
        return jax.vmap(lambda u: residuals(space.unpack(u), scenes))(candidates)

    monkeypatch.setattr(sensitivity, "_residuals_of_batch", residuals_of_batch)
    names = [*quick.TARGETS, "lean.half_life_slide", "probe.max_slope"]
    return problem.space.system, dict.fromkeys(names, {}), problem.data


def slopes(ik, free, scenes) -> dict[str, tuple[float, float]]:
    """How far each parameter moves a residual over its range, and its mean squared slope."""
    space = make_space(ik, [free_parameter(ik, n, scenes[0].rig) for n in free])
    fractions = (np.arange(6)[:, None] + 0.5) / 6
    u = np.log(fractions / (1 - fractions)) * np.ones(space.size)
    reach, squares = np.zeros(space.size), np.zeros(space.size)
    points = sensitivity.sweep_points(space)
    for start in points:
        changes = (np.asarray(space.values(u)) - np.asarray(space.values(start))) / 0.01
        steps = u - start
        squares += ((steps * changes).sum(axis=0) / (steps**2).sum(axis=0)) ** 2 / len(points)
        reach = np.maximum(reach, np.abs(changes).max(axis=0))
    each = zip(space.names, zip(reach, squares, strict=True), strict=True)
    return {name: numbers for name, numbers in each if name in quick.TARGETS}


def test_what_moves_the_clip_is_expected_to_be_determined(candidates):
    ik, free, scenes = candidates
    forecasts = {forecast.name: forecast for forecast in sensitivity.choose_free(ik, free, scenes)}
    for name, (reach, squared_slope) in slopes(ik, free, scenes).items():
        information = (1 / 30) / 0.5 * squared_slope  # residuals of half a second tell one thing
        contraction = 1 - 1 / (1 + SPREAD**2 * information)
        forecast = forecasts.pop(name)
        assert forecast.is_free and forecast.moves and forecast.rival == ""
        assert forecast.reach == pytest.approx(reach)
        assert forecast.contraction == pytest.approx(contraction)
    assert [(f.is_free, f.moves, f.contraction) for f in forecasts.values()] == [
        (False, False, 0.0)
    ] * 2


def test_what_moves_the_clip_with_other_values_counts_as_moving(candidates):
    ik, free, scenes = candidates
    free = {**free, "pelvis.limit": {}}
    moving = sensitivity.measure_sensitivity(ik, free, scenes)
    assert moving.keys() == free.keys() - {"probe.max_slope"}
    for name, (reach, _) in slopes(ik, free, scenes).items():
        declared = parameter_tree.declarations(ik)[name]
        assert reach <= moving[name] * (1 + 1e-9) < 100 * (declared.high - declared.low)


def test_ground_of_another_clip_is_doubted():
    data = load_clip_data(ClipEntry(WALK, GROUND, BASE), None)
    moved = data.reference.positions_ws + np.array([0.0, 0.0, 0.7])
    other = data._replace(reference=data.reference.with_motion(moved, data.reference.rotations_ws))
    advice = [
        assumption.advice
        for each in (data, other)
        for assumption in draft.of_clip(each, None, base_is_own=True)
        if assumption.topic == "ground"
    ]
    assert advice == ["", "does this ground belong to this clip?"]


def test_soles_are_measured_estimated_or_given_and_it_is_said_which():
    data = load_clip_data(ClipEntry(WALK, GROUND, BASE), None)
    level = data._replace(reference=stair_walk(flat_floor))
    for each, is_given, words, is_doubted in (
        (level, False, "over their soles, measured over the level floor", False),
        (data, False, "over their soles, estimated from the feet's length", True),
        (data, True, "over their soles, as was given", False),
    ):
        (soles,) = (
            assumption
            for assumption in draft.of_clip(each, None, base_is_own=True, sole_is_given=is_given)
            if assumption.topic == "soles"
        )
        assert words in soles.text and ("--sole" in soles.advice) == is_doubted, soles
