"""Many fits and evaluations: what is computed, what is kept, and what failures do."""

import csv
import dataclasses
import shutil
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow.parquet
import pytest
from distributed import LocalCluster

import fitting
import jaxik
from fitting.cli import main
from fitting.clips.stances import contacts_path
from fitting.codegen import crowd, toolchain
from fitting.experiment.experiment_files import load_experiment
from fitting.experiment.problems import make_problem
from fitting.motion import playback
from fitting.motion.playback import Playback
from fitting.problem.scene import Scene
from fitting.runtime import cluster
from fitting.runtime.claimed_folder import claimed
from fitting.runtime.precision import with_floats
from fitting.studies.campaign import Campaign
from fitting.studies.fit import run_folder
from fitting.studies.many import evaluation
from fitting.studies.many import fit_many as many_fits
from fitting.studies.many.fit_many import plan
from jaxik.maths import parameter_tree
from jaxik.world import body
from jaxik.world.terrain import plane
from support import scenes, small_studies
from support.experiments import ROOT
from support.watching import listening


@pytest.fixture
def experiment_file(tmp_path, monkeypatch) -> Path:
    return small_studies.quick_many(tmp_path, monkeypatch)


def fit_many(experiment: Path | list[Path], folder: Path, **options: Any) -> fitting.ManyFits:
    """In this process, without pictures of each run."""
    return fitting.fit_many(experiment, folder, workers=0, report=False, **options)


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> fitting.ManyFits:
    """Both clips with two seeds; tests must not change the folder."""
    folder = tmp_path_factory.mktemp("finished")
    with pytest.MonkeyPatch.context() as patch:
        return fit_many(small_studies.quick_many(folder, patch), folder / "out", seeds=2)


@pytest.fixture
def out(finished, tmp_path, undrawn) -> Path:
    """A copy of its folder, in which fits may be missing."""
    return Path(shutil.copytree(finished.folder, tmp_path / "out"))


def read(path: Path) -> list[dict[str, str]]:
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def cells(fits: fitting.ManyFits) -> list[dict[str, Any]]:
    return [many_fits.cells(row) for row in fits.rows]


# What is fitted


def test_every_clip_is_fitted_with_every_seed_in_a_folder_of_its_own(experiment_file):
    experiment = load_experiment(experiment_file)
    alone = plan([experiment, experiment], seeds=2)
    runs = [task.run.as_posix() for task in alone]
    assert len(set(runs)) == len(alone) == 8
    assert runs[:2] == [f"runs/walks_1/uneven_walk_from_1_s/seed_{seed}" for seed in (0, 1)]
    assert [len(task.experiment.clips) for task in alone] == [1] * 8
    assert [task.experiment.seed for task in alone[:2]] == [0, 1]
    (together,) = plan([experiment], together=True)
    assert together.run == Path("runs/walks/seed_0") and len(together.experiment.clips) == 2


def test_a_fit_is_another_one_if_its_experiment_or_a_file_of_it_changes(experiment_file, tmp_path):
    experiment = load_experiment(experiment_file)
    clip = tmp_path / "clip.npz"
    shutil.copy(ROOT / "data/clips/uneven_walk.npz", clip)
    entry = dataclasses.replace(experiment.clips[0], reference=clip)
    (task, *_) = plan([dataclasses.replace(experiment, clips=(entry,))])
    identity = task.identity()
    assert task.identity() == identity
    other = dataclasses.replace(task.experiment, loss="cauchy")
    assert dataclasses.replace(task, experiment=other).identity() != identity
    contacts_path(clip).write_text("")
    with_contacts = task.identity()
    assert with_contacts != identity
    clip.write_bytes(clip.read_bytes() + b"more")
    assert task.identity() not in (identity, with_contacts)


# What is kept


@pytest.mark.slow
def test_a_fit_that_was_finished_as_the_interrupt_came_counts(out, experiment_file, monkeypatch):
    for kept in list(out.glob(f"runs/**/{many_fits.ROW}"))[1:]:
        kept.unlink()

    def interrupted(self, client):
        self.make(self.tasks[self.missing[0]])  # its row is written, and nobody hears of it
        raise KeyboardInterrupt
        yield

    monkeypatch.setattr(Campaign, "_calls", interrupted)
    lines: list[str] = []
    with listening(lines.append):
        fits = fit_many(experiment_file, out, seeds=2)
    assert fits.interrupted and len(fits.finished) == 2 and fits.made == 1
    rest = "2 of 4 fits are finished; the same command makes the 2 that are missing."
    assert any(rest in line for line in lines)
    assert "interrupted; writing the table of the finished fits" in lines


def test_each_fit_is_a_run_and_a_row(finished):
    assert [row["state"] for row in finished.rows] == ["finished"] * 4 and not finished.interrupted
    for row in finished.rows:
        experiment, summary = run_folder.load_fit(finished.folder / row["run"])
        assert len(experiment.clips) == 1 and experiment.seed == row["seed"]
        assert "fit" in row and {**summary, "history": []} == row["fit"]
    present = read(finished.folder / many_fits.CSV)
    assert [row["run"] for row in present] == [row["run"] for row in finished.rows]
    assert float(present[0]["pelvis.half_life"]) == pytest.approx(0.3, abs=0.02)
    parquet = pyarrow.parquet.read_table(finished.folder / many_fits.PARQUET).to_pylist()
    assert [row["cost"] for row in parquet] == [row["cost"] for row in cells(finished)]
    files = {path.name for path in finished.folder.iterdir()}
    assert {"fits.png", "summary.md", "report.html"} <= files


def test_only_what_is_not_whole_is_fitted_again(finished, out, experiment_file, monkeypatch):
    lines: list[str] = []
    (out / finished.rows[0]["run"] / many_fits.ROW).unlink()
    with listening(lines.append):
        assert fit_many(experiment_file, out, seeds=2).made == 1
    assert "4 fits of 1 experiment, 2 seeds for each clip; 3 are there already" in lines
    monkeypatch.setattr(many_fits, "fit", None)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    (out / many_fits.PARQUET).unlink()
    with listening(lines.append):
        again = fit_many(experiment_file, out, seeds=2)
    assert again.rows[1:] == finished.rows[1:] and again.made == 0
    assert "no fits.parquet, as pyarrow is not installed: pip install 'jaxik[parquet]'" in lines
    assert (out / many_fits.CSV).is_file() and not (out / many_fits.PARQUET).exists()


@pytest.mark.slow
def test_workers_of_a_scheduler_at_an_address_make_the_same_fits(
    finished, experiment_file, tmp_path, undrawn
):
    options: dict[str, Any] = {"threads_per_worker": 1, "dashboard_address": None}
    with LocalCluster(n_workers=2, processes=False, **options) as workers:
        address: str = workers.scheduler_address  # pyright: ignore[reportAttributeAccessIssue]
        out = tmp_path / "there"
        there = fitting.fit_many(experiment_file, out, seeds=2, scheduler=address, report=False)
        again = fitting.fit_many(experiment_file, out, seeds=2, scheduler=address, report=False)
    numbers = [[row[name] for name in ("run", "cost", "state")] for row in cells(finished)]
    assert [[row[name] for name in ("run", "cost", "state")] for row in cells(there)] == numbers
    assert (there.made, again.made) == (4, 0) and again.rows == there.rows
    for row in there.rows:
        run_folder.load_fit(out / row["run"])


def test_the_run_of_another_experiment_is_not_taken_for_ones_own(out, experiment_file):
    experiment_file.write_text(f'loss = "cauchy"\n{experiment_file.read_text()}')
    with pytest.raises(
        ValueError, match=r"seed_0/row.json: has the fit of another experiment, or of one"
    ):
        fit_many(experiment_file, out)


def test_a_fit_that_fails_tells_why_stops_nothing_and_is_tried_again(
    experiment_file, tmp_path, monkeypatch, undrawn
):
    out, real = tmp_path / "out", many_fits.fit

    def fails_first(experiment, *args, **named):
        if experiment.clips[0].start == 1.0:
            raise RuntimeError("no\nluck")
        return real(experiment, *args, **named)

    with monkeypatch.context() as patch:
        patch.setattr(many_fits, "fit", fails_first)
        words = ["fit-many", str(experiment_file), "-o", str(out), "--workers", "0"]
        assert main.main([*words, "--no-reports"]) == 6
    first, second = read(out / many_fits.CSV)
    assert (first["state"], first["error"]) == ("failed", "no luck") and not first["cost"]
    assert second["state"] == "finished" and second["cost"]
    trace = out / first["run"] / many_fits.ERROR
    assert "RuntimeError: no\nluck" in trace.read_text()
    assert "no luck" in (out / "report.html").read_text()
    assert not fit_many(experiment_file, out).failed
    assert not trace.exists()


def test_only_the_first_process_compiles_while_others_wait(tmp_path, monkeypatch):
    monkeypatch.setattr(cluster.cache_folder, "traced", lambda: tmp_path)
    monkeypatch.setattr(cluster, "PATIENCE", 0.0)
    key, looks = "0" * 64, []

    def look(seconds: float) -> None:
        looks.append(seconds)
        if len(looks) == 3:
            held.__exit__(None, None, None)

    monkeypatch.setattr(cluster.time, "sleep", look)
    held = claimed(tmp_path / f"first-{key}")
    held.__enter__()
    with cluster.first_alone(key):
        assert len(looks) == 3
    with claimed(tmp_path / f"first-{key}"), cluster.first_alone(key):
        assert len(looks) == 3  # they are kept by now, and nobody waits


# Many systems on many clips: the numbers of each, in chunks, by one program

HALF_LIVES = np.linspace(0.05, 0.9, 5)
COST = "cost"


@pytest.fixture(scope="module")
def problem():
    return make_problem(scenes.experiment())


@pytest.fixture(scope="module")
def ik(problem):
    return problem.space.unpack(problem.space.start)


def unscaled(scene: Scene) -> Scene:
    """The clip, saying that its body has the size which numbers are for: one program for all."""
    return dataclasses.replace(scene, size=jnp.asarray(1.0))


def run_alone(ik: jaxik.FootIK, scene: Scene) -> Playback:
    """The motion of a clip alone, with its errors and residuals."""
    return playback.play(scene, playback.run(ik, scene))


@pytest.mark.slow
def test_each_system_and_clip_has_the_cost_of_its_residuals(problem, ik):
    batch = fitting.vary(ik, {"pelvis.half_life": HALF_LIVES})
    with jax.enable_x64(False):  # as it is for users
        numbers = fitting.evaluate_many(batch, problem.data, chunk=2)
    assert {values.shape for values in numbers.values()} == {(5, 3)}
    scene = unscaled(problem.data[1])
    played = run_alone(parameter_tree.replace(ik, {"pelvis.half_life": HALF_LIVES[3]}), scene)
    cost = 0.5 * sum(np.sum(np.square(of_kind)) for of_kind in played.residuals.values())
    assert numbers[COST][3, 1] == pytest.approx(cost, rel=1e-10)
    expected = np.sqrt(np.mean(played.errors["pelvis"][played.seen] ** 2, axis=0).sum())
    assert numbers["pelvis"][3, 1] == pytest.approx(expected, rel=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize(("systems", "clips"), [(5, 1), (1, 3)])
def test_data_of_32_bits_are_evaluated_by_c_code_alike(problem, ik, systems, clips, monkeypatch):
    calls: list[bool] = []  # of C code

    def by_kernel(*arguments: Any) -> Any:
        calls.append(True)
        return run(*arguments)

    run = evaluation._Calls._by_kernel
    monkeypatch.setattr(evaluation._Calls, "_by_kernel", by_kernel)
    flat = [dataclasses.replace(s, terrain=plane(normal=(0.1, 1.0, 0.0))) for s in problem.data]
    data = with_floats(flat[:clips], jnp.float32)
    batch = fitting.vary(ik, {"pelvis.half_life": HALF_LIVES[:systems]})
    fitting.evaluate_many(batch, data, chunk=3)
    assert not calls  # too little for code to pay
    monkeypatch.setattr(evaluation, "WORTH", 0)
    ours = fitting.evaluate_many(batch, data, chunk=3)
    count = len(calls)
    assert count or toolchain.compiler("c") is None
    monkeypatch.setenv(crowd.SWITCH, "0")
    theirs = fitting.evaluate_many(batch, data, chunk=3)
    assert len(calls) == count and ours.keys() == theirs.keys()
    for name, values in theirs.items():
        np.testing.assert_allclose(ours[name], values, rtol=1e-3, atol=1e-5, err_msg=name)


@pytest.mark.slow
def test_a_clip_of_another_body_is_run_by_a_system_that_is_similar(problem, ik):
    scene, size = unscaled(problem.data[1]), jnp.asarray(1.3)
    sized = dataclasses.replace(scene, size=size)
    knees, expected, plain = (
        run_alone(system, clip).after.knee
        for system, clip in ((ik, sized), (body.similar(ik, size), scene), (ik, scene))
    )
    np.testing.assert_allclose(knees, expected, rtol=1e-9)
    assert np.abs(knees - plain).max() > 0.001


def test_no_chunk_and_no_second_call_compiles_anew(problem, ik):
    programs = evaluation._along._cache_size  # pyright: ignore[reportAttributeAccessIssue]
    batch = fitting.vary(ik, {"pelvis.half_life": HALF_LIVES})
    fitting.evaluate_many(batch, problem.data, chunk=2)
    before = programs()
    assert before >= 1
    more = fitting.vary(ik, {"pelvis.half_life": np.linspace(0.1, 0.8, 7)})
    numbers = fitting.evaluate_many(more, problem.data, chunk=2)
    assert programs() == before and numbers[COST].shape == (7, 3)


def calls_of(ik, scenes, systems: int, chunk: int | None, memory: float) -> evaluation._Calls:
    """What evaluates so many systems on clips of one length."""
    batch = fitting.vary(ik, {"pelvis.half_life": np.linspace(0.1, 0.8, systems)})
    mesh = jax.sharding.Mesh(np.array(jax.local_devices()), (evaluation.BATCH,))
    (stack,) = evaluation.shared_world.stack(scenes)
    arrays, measure = jax.tree.map(np.asarray, batch), evaluation.errors_and_cost
    return evaluation._Calls(arrays, systems, stack, measure, mesh, chunk, memory)


def test_a_chunk_follows_from_the_memory_that_it_may_take(problem, ik, monkeypatch):
    monkeypatch.setattr(evaluation, "usable_cores", lambda: 2)

    def size(chunk: int | None, memory: float) -> int:
        return calls_of(ik, problem.data, 1000, chunk, memory)._size()

    assert size(None, 0.0) == 1 and size(None, 1e15) == evaluation.CACHED
    assert 1 < size(None, 1e7) < size(None, 5e7) <= evaluation.CACHED
    assert size(10, 0.0) == 10 and size(5000, 0.0) == 1000


@pytest.mark.slow
@pytest.mark.usefixtures("optimised")
@pytest.mark.parametrize(("systems", "clips"), [(16, 1), (1, 16)])
def test_a_chunk_takes_no_more_memory_than_reckoned(problem, ik, systems, clips):
    calls = calls_of(ik, problem.data * clips, systems, 16, 1.0)
    memory = evaluation._along.lower(*calls.arguments(0, 0, 16)).compile().memory_analysis()
    assert memory is not None
    taken = memory.temp_size_in_bytes + memory.argument_size_in_bytes + memory.output_size_in_bytes
    assert 0.1 * 16 * calls._bytes_each() < taken < 16 * calls._bytes_each()


def test_what_cannot_be_evaluated_is_refused(problem, ik):
    batch = fitting.vary(ik, {"pelvis.half_life": HALF_LIVES})
    for systems, clips, chunk, message in (
        (ik, problem.data, None, "an array of the systems has no axis for them"),
        (batch, (), None, "no clips; wanted one or more"),
        (batch, problem.data, 0, "chunk is 0; wanted 1 or more"),
    ):
        with pytest.raises(ValueError, match=message):
            fitting.evaluate_many(systems, clips, chunk=chunk)
    for values, message in (
        (
            {"pelvis.half_life": HALF_LIVES, "pelvis.limit": HALF_LIVES[:3]},
            "wanted the same number of each",
        ),
        ({"pelvis.wings": HALF_LIVES}, "no parameter named 'pelvis.wings'"),
    ):
        with pytest.raises(ValueError, match=message):
            fitting.vary(ik, values)
