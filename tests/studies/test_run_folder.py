"""Run folders: what they hold, where they may be, those of earlier releases, and damaged ones.

`tests/support/released` has a run of each release, written by its own code: two parameters fitted
with the residuals of `support.quick`, and four steps of a chain.
"""

import dataclasses
import json
import math
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import h5py
import jax
import numpy as np
import pytest

from fitting.experiment import experiment_files, parameter_files, problems, systems
from fitting.inference.noise import NoiseOptions
from fitting.inference.sample.chain import Chain, Identity
from fitting.inference.sample.posterior import digest
from fitting.motion.goodness import CLOSE, Distances, Kinds, Motion
from fitting.runtime.claimed_folder import LOCK, claimed
from fitting.studies.fit import assess, run_folder
from fitting.studies.fit.assess import search
from fitting.studies.fit.fit import MAX_START_SD, THRESHOLD_SD, Fit
from fitting.studies.sample.sample import walker_start
from fuzz import stored_files
from jaxik.maths import parameter_tree
from jaxik.record.parameters import half_life_of_gain
from support import quick, small_studies
from support.commands import refusal
from support.experiments import ROOT, write
from support.runs import NAMES, invented_fit, save
from support.small_studies import HALF_SECOND

RELEASED = sorted((ROOT / "tests" / "support" / "released").iterdir())
DATA = ROOT / "data"
WALK = [DATA / "clips/uneven_walk_base.npz", "--terrain", DATA / "terrains/uneven_walk.ply"]


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> Fit:
    """A fit with invented numbers; no search has run, and no part of it takes the pipeline."""
    with pytest.MonkeyPatch.context() as patch:
        small_studies.quick_fits(patch)
        sampling = "[sample]\nwalkers = 8\nstop_at = 1e9\nmax_steps = 6"
        return invented_fit(tmp_path_factory.mktemp("experiment"), sampling)


@pytest.fixture(scope="module")
def sampled(fitted, tmp_path_factory) -> Path:
    """Its run, with a chain."""
    run = tmp_path_factory.mktemp("sampled") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Fit, "groups", [])
        patch.setattr(Fit, "distances", Distances({}))
        save(run, fitted)
    seed, thin_by = fitted.experiment.seed, fitted.experiment.sample.thin_by
    make_chain(run / run_folder.CHAIN, Identity(NAMES, 8, seed, thin_by, digest(fitted.problem)))
    return run


@pytest.fixture
def run(sampled, tmp_path, monkeypatch) -> Path:
    """A copy, to be damaged."""
    small_studies.quick_fits(monkeypatch)
    return shutil.copytree(sampled, tmp_path / "run")


def make_chain(path: Path, identity: Identity) -> None:
    """Six steps of a chain."""
    with Chain(identity, path) as chain:
        extend(chain, 6)


def extend(chain: Chain, steps: int) -> None:
    state: Any = np.random.RandomState(0).get_state()
    for _ in range(steps):
        chain.append(np.full((8, 2), len(chain)), np.zeros(8), np.ones(8, bool), state)


# What a fit says and a run holds


def test_a_run_holds_the_experiment_the_system_and_the_numbers(fitted, sampled):
    experiment, summary = run_folder.load_fit(sampled)
    rows = summary["parameters"]
    assert [row["name"] for row in rows] == list(NAMES)
    assert [row["u"] for row in rows] == [0.3, -0.2]
    assert [row["start_sd"] for row in rows] == [0.01, THRESHOLD_SD]
    assert {(row["prior"]["shape"], row["prior"]["spread"]) for row in rows} == {("normal", 1.6)}
    assert [row["determined"] for row in rows] == [True, False]
    assert [row["at_bound"] for row in rows] == ["", "high"]
    assert summary["correlated"] == [[*NAMES, 0.95]] and summary["history"][0]["stage"] == "start"
    assert summary["cost_before"] == 90.0 and summary["converged"] is True
    json.dumps(summary, allow_nan=False)
    ik, preset = parameter_files.load_system(sampled / run_folder.PARAMETERS)
    original = systems.Preset("record", faithful=True)
    assert preset == original and not parameter_tree.get(ik, "lock.enabled")
    values = [float(parameter_tree.get(ik, name)) for name in NAMES]
    np.testing.assert_allclose(values, fitted.solution.values, rtol=1e-12)
    assert (experiment.free, experiment.clips) == (fitted.experiment.free, fitted.experiment.clips)


def test_a_run_keeps_the_better_parameters_and_the_fitted_ones_beside_them(
    fitted, tmp_path, monkeypatch
):
    monkeypatch.setattr(Fit, "groups", [])
    near, far = (dict.fromkeys(CLOSE, size) for size in (0.01, 0.05))
    motions: dict[Motion, Kinds] = {"animation": far, "before": near, "fitted": far}
    values = [dict(zip(NAMES, fitted.solution.values, strict=True))]
    space = fitted.problem.space
    values.append(dict(zip(NAMES, space.values(space.pack({})), strict=True)))

    def kept(name: str) -> dict[str, Any]:
        ik, _ = parameter_files.load_system(tmp_path / name)
        return {name: pytest.approx(float(parameter_tree.get(ik, name))) for name in NAMES}

    monkeypatch.setattr(Fit, "distances", Distances({"held_out": motions}))
    save(tmp_path, fitted := dataclasses.replace(fitted))
    assert [kept(run_folder.FITTED_PARAMETERS), kept(run_folder.PARAMETERS)] == values
    _, summary = run_folder.load_fit(tmp_path)
    assert summary["distances"]["kept"] == "before"  # type: ignore[typeddict-item]
    assert len(summary["distances"]["setbacks"]) == len(CLOSE)  # type: ignore[typeddict-item]
    monkeypatch.setattr(Fit, "distances", Distances({}))
    save(tmp_path, dataclasses.replace(fitted))
    assert kept(run_folder.PARAMETERS) == values[0]
    assert not (tmp_path / run_folder.FITTED_PARAMETERS).exists()


def test_the_experiment_in_a_run_does_not_need_its_original_file(fitted, tmp_path):
    sigmas = {"ankle": 0.01, "body": math.inf, "correlation.ankle": 0.9, "correlation.foot": 0.5}
    noise = NoiseOptions("estimated", "whitened")
    changes = {"sigmas": sigmas, "noise": noise, "loss": "squares", "holdout": 0.25}
    changed = dataclasses.replace(fitted.experiment, **changes)
    (tmp_path / "again.toml").write_text(experiment_files.experiment_to_toml(changed))
    again = experiment_files.load_experiment(tmp_path / "again.toml")
    for field in (
        "clips",
        "free",
        "preset",
        "name",
        "fps",
        "loss",
        "holdout",
        "seed",
        "parameters",
        "fit",
    ):
        assert getattr(again, field) == getattr(changed, field), field
    assert (again.sample, again.sigmas, again.noise) == (changed.sample, sigmas, noise)
    (scene,) = problems.make_problem(again).data
    of_kinds = {
        kind: float(scene.sigmas.correlation_of(kind)) for kind in ("ankle", "knee", "foot")
    }
    assert of_kinds == {"ankle": 0.9, "knee": 0.0, "foot": 0.5}


def test_a_fitted_system_needs_neither_experiment_nor_clips_but_a_finished_fit(fitted, run):
    (run / run_folder.EXPERIMENT).unlink()
    moved = run.parent / "moved"
    moved.mkdir()
    shutil.copy(run / run_folder.PARAMETERS, moved)
    for folder in (run, moved):
        ik = run_folder.load_fitted_system(folder)
        assert float(parameter_tree.get(ik, NAMES[0])) == pytest.approx(fitted.solution.values[0])
    (moved / run_folder.SEARCH).write_text("{}")
    with pytest.raises(ValueError, match="no fit.json yet: its fit is going on, or was stopped"):
        run_folder.load_fitted_system(moved)
    run_folder.save_solution(run, fitted.experiment, fitted.problem, fitted.solution)
    with pytest.raises(ValueError, match="no fit.json; there is .*parameters.toml"):
        run_folder.load_fit(run)


def test_walkers_start_near_thresholds_and_neither_too_near_nor_too_far(fitted):
    known = dataclasses.replace(fitted.identifiability, sd=np.array([np.nan, 9.0]))
    wide = dataclasses.replace(fitted, identifiability=known)
    np.testing.assert_array_equal(wide.start_sd, [THRESHOLD_SD, MAX_START_SD])


@pytest.fixture
def solved(tmp_path, monkeypatch):
    """An experiment, its problem and solution, and how well the data determine it."""
    small_studies.quick_fits(monkeypatch)
    experiment = experiment_files.load_experiment(write(tmp_path, clips=HALF_SECOND))
    with jax.enable_x64(True):
        problem = problems.make_problem(experiment)
        solution = search(problem, experiment)
        known = assess.assess_identifiability(problem, solution)
    return experiment, problem, solution, known


@pytest.mark.parametrize(("gain", "searches"), [(0.2, 0), (9000.0, 1)])
def test_the_search_begins_anew_at_a_point_that_is_much_lower(solved, monkeypatch, gain, searches):
    experiment, problem, solution, known = solved
    reports = [dataclasses.replace(known, improvement=value) for value in (5.0, 0.0)]
    near, far = (dataclasses.replace(solution, cost=solution.cost - x * gain) for x in (1, 2))
    search_again = Mock(return_value=far)
    monkeypatch.setattr(assess, "assess_identifiability", Mock(side_effect=reports))
    monkeypatch.setattr(assess, "refine", lambda *_: near)
    monkeypatch.setattr(assess, "search", search_again)
    fitted = assess.assess_solution(experiment, problem, solution)
    assert search_again.call_count == searches and fitted.left == (solution.cost,)
    assert fitted.solution.cost == (far if searches else near).cost


@pytest.mark.parametrize("interrupted", [False, True])
def test_a_point_that_is_lower_with_32_bits_only_changes_nothing(solved, monkeypatch, interrupted):
    experiment, problem, solution, known = solved
    tempting = dataclasses.replace(known, improvement=5.0, best_u=solution.u + 1.0)
    behind = dataclasses.replace(
        solution, u=solution.u + 1.0, cost=solution.cost + 9000.0, interrupted=interrupted
    )
    monkeypatch.setattr(assess, "assess_identifiability", lambda *_: tempting)
    monkeypatch.setattr(assess, "refine", lambda *_: behind)
    monkeypatch.setattr(assess, "search", lambda *_: behind)
    fitted = assess.assess_solution(experiment, problem, solution)
    assert fitted.solution.cost == solution.cost and fitted.left == ()
    np.testing.assert_array_equal(fitted.solution.u, solution.u)
    assert fitted.solution.interrupted == interrupted


# Where a run may be


def project(folder: Path) -> Path:
    """An experiment beside files for its clip, and a run of it, in `folder`; returns the run."""
    (folder / "data").mkdir(parents=True)
    for name in ("walk.npz", "steps.ply"):
        (folder / "data" / name).touch()
    clip = 'reference = "data/walk.npz"\nterrain = "data/steps.ply"\n'
    path = write(folder, clips=f"[[clips]]\n{clip}")
    experiment, run = experiment_files.load_experiment(path), folder / "runs" / "walk"
    run.mkdir(parents=True)
    text = experiment_files.experiment_to_toml(experiment, run)
    (run / run_folder.EXPERIMENT).write_text(text, encoding="utf-8")
    return run


def terrain_of(run: Path) -> Path:
    (clip,) = experiment_files.load_experiment(run / run_folder.EXPERIMENT).clips
    return clip.terrain


def test_a_run_may_be_moved_with_its_data_or_alone(tmp_path):
    run = project(tmp_path / "first")
    assert 'terrain = "../../data/steps.ply"' in (run / run_folder.EXPERIMENT).read_text()
    shutil.copytree(tmp_path / "first", tmp_path / "copy")
    beside = tmp_path / "copy/data/steps.ply"
    assert terrain_of(tmp_path / "copy/runs/walk") == beside, "and not the old one"
    moved, old = run.rename(tmp_path / "alone"), tmp_path / "first/data/steps.ply"
    assert terrain_of(moved) == old
    old.unlink()
    with pytest.raises(ValueError) as refused:
        terrain_of(moved)
    places = [tmp_path.parent / "data/steps.ply", old]
    assert all(str(place) in str(refused.value) for place in places)


def test_paths_to_another_drive_are_whole(tmp_path, monkeypatch):
    def no_path(*_: object) -> str:
        raise ValueError("path is on mount 'D:', start on mount 'C:'")

    monkeypatch.setattr(os.path, "relpath", no_path)
    run = project(tmp_path / "first")
    whole = (tmp_path / "first/data/steps.ply").as_posix()
    assert f'terrain = "{whole}"' in (run / run_folder.EXPERIMENT).read_text()
    assert terrain_of(run.rename(tmp_path / "alone")) == Path(whole)


def test_checking_an_output_folder_makes_nothing(tmp_path, monkeypatch):
    run_folder.check_output_folder(tmp_path / "runs" / "walk")
    run_folder.check_output_folder(tmp_path)
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("x")
    with pytest.raises(ValueError, match="no folder can be made here, as .*file is a file"):
        run_folder.check_output_folder(tmp_path / "file" / "run")
    monkeypatch.setattr(os, "access", lambda *_: False)  # the tests may run as root
    with pytest.raises(ValueError, match="is read-only"):
        run_folder.check_output_folder(tmp_path / "run")


def test_a_folder_in_which_a_search_was_killed_counts_as_new(tmp_path):
    for name in (LOCK, run_folder.SEARCH):
        (tmp_path / name).write_text("x")
        run_folder.check_new_folder(tmp_path)
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(ValueError, match=r"something in it already: \['notes.txt'\]"):
        run_folder.check_new_folder(tmp_path)


def test_commands_say_of_a_folder_in_which_a_search_goes_on_that_it_is_not_finished(
    tmp_path, capsys
):
    run = tmp_path / "run"
    run.mkdir()
    on_ground = [ROOT / "data/clips/uneven_walk_base.npz", "--terrain"]
    on_ground += [ROOT / "data/terrains/slope.ply", "-o", tmp_path / "out.npz"]
    for name in (LOCK, run_folder.SEARCH):
        (run / name).touch()
        for words in (
            ["sample", run],
            ["view", run],
            ["apply", run, *on_ground],
            ["export", run, "-o", tmp_path / "out.toml"],
            ["compare", "--runs", f"{run},{tmp_path}", "-o", tmp_path / "out"],
        ):
            error = refusal(words, tmp_path, capsys)
            assert "toml yet: its fit is going on, or was stopped" in error
        (run / name).unlink()


# Of earlier releases


@pytest.mark.parametrize("release", RELEASED, ids=lambda folder: folder.name)
def test_a_released_fit_is_read_and_applied_but_its_chain_is_refused(
    release, tmp_path, monkeypatch, capsys
):
    run = Path(shutil.copytree(release, tmp_path / "run"))
    path = run / run_folder.EXPERIMENT
    path.write_text(path.read_text().replace("{data}", str(DATA)))
    experiment, summary = run_folder.load_fit(run)
    values = {row["name"]: row["value"] for row in summary["parameters"]}
    # It was a gain of 0.3 per tick of 30 Hz.
    targets = quick.TARGETS | {"pelvis.half_life": half_life_of_gain(0.3, 30.0)}
    assert values == pytest.approx(targets, abs=0.001)
    assert (experiment.loss, experiment.holdout) == ("squares", 0.0), "as it was fitted"
    assert experiment.noise == NoiseOptions(correlation="given")
    space = problems.make_problem(experiment).space
    start = walker_start(summary["parameters"], space)
    started = dict(zip(space.names, space.values(start.u).tolist(), strict=True))
    assert started == pytest.approx(values, rel=1e-6)
    ik = run_folder.load_fitted_system(run)
    applied = {name: float(parameter_tree.get(ik, name)) for name in values}
    assert applied == pytest.approx(values, abs=0.001)
    small_studies.quick_fits(monkeypatch)
    line = refusal(["sample", run], run, capsys)
    assert "chain.h5 holds the chain of another run" in line and "delete the file" in line
    numbers = json.loads((run / run_folder.FIT).read_text())
    noise = {"sigmas": {"ankle": 0.02}, "correlations": {"ankle": 0.9}, "tails": 4.0}
    numbers["noise"] = noise | {"independent_fraction": 0.2}  # as before 0.2.0 was released
    (run / run_folder.FIT).write_text(json.dumps(numbers))
    assert run_folder.load_fit(run)[1].get("noise") == noise | {"weight": 0.2}


# Damaged: one sentence names what is, and nothing that was whole is changed


def sampling_refused(run: Path, capsys) -> str:
    return refusal(["sample", run], run, capsys)


def applying_refused(run: Path, capsys) -> str:
    return refusal(["apply", run, *WALK, "-o", run.parent / "out.npz"], run.parent, capsys)


WHOLE_FILES = {
    "cut in half": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "empty": lambda path: path.write_bytes(b""),
    "garbage": lambda path: path.write_bytes(bytes(range(256)) * 8),
    "a folder": lambda path: (path.unlink(), path.mkdir()),
    "missing": Path.unlink,
}
GOES_ON = {("chain.h5", "missing"), ("fit.json", "missing")}  # a new chain; parameters alone


@pytest.mark.parametrize("name", ["experiment.toml", "fit.json", "parameters.toml", "chain.h5"])
def test_a_file_that_is_damaged_as_a_whole_is_named(run, name, capsys):
    applied = name in ("fit.json", "parameters.toml")  # all that `apply` reads
    refused = applying_refused if applied else sampling_refused
    for kind, damage in WHOLE_FILES.items():
        if (name, kind) not in GOES_ON:
            folder = Path(shutil.copytree(run, run.parent / kind))
            damage(folder / name)
            assert name in refused(folder, capsys).replace(str(folder), ""), kind


def row(**changes: object) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """A change of the first parameter of a fit."""
    return lambda fit: {"parameters": [fit["parameters"][0] | changes, fit["parameters"][1]]}


NUMBERS = [
    (row(u=1e9), "parameters[0].u is 1000000000.0; wanted a number from -40 to 40"),
    (row(start_sd=0.0), "parameters[0].start_sd is 0.0; wanted"),
    (row(kind="cubic"), "parameters[0].kind is 'cubic'"),
    (row(interval=[1.0]), "parameters[0].interval is [1.0]; wanted a list of 2"),
    (row(valleys=[{"value": 1.0}]), "parameters[0].valleys[0] has no interval"),
    (row(name="foot.max_pitch"), "wanted each once"),
    (row(name="pelvis.limit"), "the fit has the parameters"),
    (lambda fit: {"parameters": []}, "the fit has the parameters []"),
    (lambda fit: {"noise": {"sigmas": {}}}, "noise has no correlations"),
    (lambda fit: {"format": 9}, "its format is 9; this release reads"),
]


def test_a_wrong_number_of_a_fit_is_named(run, capsys):
    path = run / run_folder.FIT
    whole = json.loads(path.read_text())
    for change, message in NUMBERS:
        path.write_text(json.dumps(whole | change(whole)))
        assert message in sampling_refused(run, capsys), message
    path.write_text(json.dumps(whole | row(colour="red")(whole)))  # of a later release
    assert run_folder.load_fit(run)[1]["parameters"][0]["name"] == NAMES[0]


def test_a_toml_file_of_a_newer_format_or_another_system_is_refused(run, capsys):
    for name, refused in (
        (run_folder.EXPERIMENT, sampling_refused),
        (run_folder.PARAMETERS, applying_refused),
    ):
        text = (run / name).read_text()
        assert text.startswith("# jaxik run, format 1\n")
        (run / name).write_text(text.replace("format 1", "format 9", 1))
        line = refused(run, capsys)
        assert f"{name}: its format is 9; this release reads formats up to 1" in line
    (run / run_folder.PARAMETERS).write_text('preset = "record"\n')
    line = applying_refused(run, capsys)
    assert "no foot.max_pitch, pelvis.half_life; `jaxik fit` makes a run" in line


def test_a_run_that_another_process_samples_is_left_alone(run, capsys):
    with claimed(run):
        line = sampling_refused(run, capsys)
    assert f"{run}: in use by process" in line


# A damaged chain

IDENTITY = Identity(("a", "b"), walkers=8, seed=0, thin_by=1, problem="x" * 64)


@pytest.fixture
def chain_file(tmp_path) -> Path:
    path = tmp_path / run_folder.CHAIN
    make_chain(path, IDENTITY)
    return path


def array(name: str, values: np.ndarray) -> Callable[[Any], object]:
    """Other values of an array of a chain."""
    return lambda group: (group.pop(name), group.create_dataset(name, data=values))


def attribute(name: str, value: object) -> Callable[[Any], object]:
    return lambda group: group.attrs.create(name, value)


CHAINS = [
    (array("chain", np.zeros((6, 8, 3))), "chain is float64 (6, 8, 3)"),
    (array("chain", np.zeros(6)), "chain is float64 (6,); wanted numbers"),
    (array("chain", np.full((6, 8, 2), b"x")), "chain is |S1 (6, 8, 2)"),
    (array("chain", np.full((6, 8, 2), np.nan)), "chain has numbers that are not finite"),
    (array("log_prob", np.zeros((5, 8))), "log_prob is float64 (5, 8)"),
    (array("accepted", np.zeros(9)), "accepted is float64 (9,)"),
    (lambda group: group.attrs.pop("random_state_1"), "no random_state_1"),
    (attribute("random_state_1", np.zeros(3, int)), "state of 3 keys"),
    (attribute("walkers", "many"), "invalid literal"),
    (attribute("parameters", 3), "its parameters is ('3',)"),
    (attribute("seed", [1, 2]), "is not a chain"),
    (attribute("format", 9), "its format is 9; this release"),
    (lambda group: group.pop("log_prob"), "log_prob"),
    (lambda group: (group.pop("chain"), group.create_group("chain")), "is not a chain"),
]


def chain_refused(path: Path) -> str:
    """Why a chain is not gone on with; the file stays as it is."""
    before = path.read_bytes()
    with pytest.raises(ValueError) as refused:
        Chain(IDENTITY, path)
    assert path.read_bytes() == before and str(refused.value).startswith(str(path))
    return str(refused.value)


def test_a_damaged_chain_is_named_and_stays(chain_file):
    whole = chain_file.read_bytes()
    for change, message in CHAINS:
        chain_file.write_bytes(whole)
        with h5py.File(chain_file, "a") as file:
            change(file["mcmc"])
        assert message in chain_refused(chain_file)


def test_a_chain_with_a_few_other_bytes_is_named_before_hdf5_reads_it(chain_file):
    random, whole = np.random.default_rng(0), np.frombuffer(chain_file.read_bytes(), np.uint8)
    for place in random.integers(len(whole) - 20, size=6):
        damaged = whole.copy()
        damaged[place] ^= 1 << random.integers(8)
        chain_file.write_bytes(damaged.tobytes())
        reason = chain_refused(chain_file)
        assert "is not a chain of this sampler: its bytes are not those that" in reason


# What studies keep; `tests/runtime/test_files.py` damages any such file

KEPT = {
    "contribution.json": (stored_files.rows_text(), stored_files.load_rows, "ablate"),
    "searches/0123.json": (stored_files.found_text(), stored_files.load_found, "population"),
    **{
        f"{kind}/0000.json": (stored_files.text_of(whole), stored_files.load_replicate, "calibrate")
        for kind, whole in stored_files.REPLICATES.items()
    },
}
CHANGED = [
    ("contribution.json", {"rows": [3]}, "rows[0] is 3"),
    ("searches/0123.json", {"u": [0.0]}, "u has 1 numbers; wanted 2"),
    ("searches/0123.json", {"u": [0.0, float("nan")]}, "u[1] is nan; wanted a finite number"),
    ("searches/0123.json", {"noise": {"sigmas": {}}}, "noise has no correlations"),
    ("fits/0000.json", {"number": 3}, "it is of replicate 3"),
    ("fits/0000.json", {"truth": [0.1, 0.2]}, "its lists have different lengths"),
    ("fits/0000.json", {"parameters": []}, "parameters has []; wanted"),
    ("chains/0000.json", {"ranks": {"lean.half_life": 3}}, "ranks has "),
    ("chains/0000.json", {"intervals": {}}, "intervals has []; wanted"),
]


def test_a_kept_result_that_is_damaged_is_named_and_stays(tmp_path):
    for name, change, message in CHANGED:
        whole, load, command = KEPT[name]
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(whole)
        load(path)
        text = json.dumps(json.loads(whole) | change)
        path.write_text(text)
        with pytest.raises(ValueError) as refused:
            load(path)
        assert str(refused.value).startswith(f"{path}: ") and message in str(refused.value)
        assert f"`jaxik {command}`" in str(refused.value), message
        assert path.read_text() == text


# A full disk


@pytest.fixture
def disk(tmp_path) -> Iterator[Path]:
    """A file system of 64 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(words, capture_output=True).returncode:
        pytest.skip("only root may mount a disk")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_a_chain_without_room_keeps_the_steps_that_had_some(disk):
    path, full = disk / run_folder.CHAIN, "chain.h5: cannot be written: No space left on device"
    with pytest.raises(ValueError, match=full), Chain(IDENTITY, path) as chain:
        extend(chain, 1000)
    assert {file.name for file in disk.iterdir()} == {"chain.h5", "chain.h5.journal"}
    with pytest.raises(ValueError, match=full), Chain(IDENTITY, path):
        pass
    subprocess.run(["mount", "-o", "remount,size=1m", str(disk)], check=True)
    with Chain(IDENTITY, path) as chain:
        assert 10 < len(chain) < 1000
        assert (chain.u[:, 0, 0] == np.arange(len(chain))).all()
        extend(chain, 1)
    assert [file.name for file in disk.iterdir()] == ["chain.h5"]
