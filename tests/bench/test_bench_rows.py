"""Every row of `jaxik bench` runs at small sizes, and says what it measures."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fitting.bench import crowd, fits, measure, peers, rows, scaling, setup
from fitting.bench import report as bench_report
from fitting.bench import tasks as bench_tasks
from fitting.bench.setup import Sizes
from fitting.inference.optimisation.search import find_best_fit
from fitting.problem.free_parameters import free_parameter
from fitting.problem.problem import Problem
from fitting.problem.space import make_space
from fitting.runtime.threads import usable_cores
from jaxik import presets
from support.clips import assert_close
from support.quick import TARGETS, residuals_of_scenes

pytestmark = pytest.mark.slow

SMALL = Sizes(
    repeats=2, legs=12, feet=12, characters=5, derived=3, frames=24, chunk=2,
    crowd_repeats=1, cells=8, rays=40, read=1 << 12, side=8, fits=1, walkers=40, steps=2,
    batches=(2, 8), lengths=(10, 20), grids=(3, 6), parameters=(2, 3), legs_each=(2, 3),
)  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def in_a_hurry():
    """Programs that compile soon: they run twice."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


def measured(name: str, **changes) -> measure.Row:
    """One row at small sizes."""
    tasks = measure.choose(bench_tasks.TASKS, name)
    sizes = dataclasses.replace(SMALL, **changes)
    *_, row = measure.measure(tasks, sizes, True, lambda line: None).rows
    assert row.seconds > 0 and not row.failures
    for one in row.figures:
        assert np.isfinite(one.value), one
        assert one.limit is None or 0 < one.limit < np.inf, one
    return row


def named(row: measure.Row) -> dict[str, measure.Figure]:
    return {one.what: one for one in row.figures}


def test_the_machines_ceilings_are_its_best_runs():
    tasks = measure.choose(bench_tasks.TASKS, "machine")
    (row,) = measure.measure(tasks, SMALL, True, lambda line: None).rows
    assert set(row.ceilings) == {"memory", "float32", "float64", "dispatch"}
    assert row.ceilings["dispatch"] == min(row.busy["dispatch"])
    assert row.ceilings["float64"] == 2 * 8**3 * usable_cores() / min(row.busy["float64"])


def test_imports_are_counted_beyond_jaxs_own(monkeypatch):
    begun = []
    monkeypatch.setattr(measure, "SAMPLE", 0.0)
    monkeypatch.setattr(rows.subprocess, "run", lambda command, check: begun.append(command))
    row = measured("start", repeats=1)
    only = {name: drawn[0] for name, drawn in row.samples.items()}
    figure = named(row)["import jaxik, beyond jax's"]
    assert figure.value == only["jaxik"] - only["jax"] and figure.at_most == 0.3
    assert {command[-1] for command in begun} == {
        "import jax", "import jax, jaxik", "import jax, equinox", "import jax, jaxik; jaxik.run",
    }  # fmt: skip


def test_legs_and_feet_are_held_against_what_is_to_be_reached():
    row = measured("legs")
    assert named(row)["a leg and core"].at_most == 30.0
    ratio = np.median(row.samples["NumPy"]) / np.median(row.samples["ours"])
    assert named(row)["NumPy's time in ours"].value == pytest.approx(ratio)
    assert named(measured("feet"))["a leg and core"].at_most == 80.0


def test_numpys_leg_is_ours():
    with jax.enable_x64(True):
        batch = setup.batch(200)
        ours = [np.asarray(x)[0].T for x in rows.corrections(*batch.in_lanes())]
        theirs = peers.two_bone(*rows.plain_legs(batch))
    for our, their in zip(ours, theirs, strict=True):
        assert_close(np.abs(np.sum(our * their, axis=-1)), np.ones(200), 1e-4)
        assert np.ptp(our[:, 0]) > 1e-3  # legs that differ


def test_rays_are_held_against_embree_where_it_is_installed(monkeypatch):
    row = measured("rays")
    assert "100.000 % of the rays" in row.notes[0]
    first = "Embree, which triangle"
    ratio = np.median(row.samples[first]) / np.median(row.samples["ours"])
    assert named(row)[f"{first}: its time in ours"].value == pytest.approx(ratio)
    monkeypatch.setattr(rows.mesh_files, "embree", lambda vertices, faces: None)
    row = measured("rays")
    assert list(row.samples) == ["ours"] and "not installed" in row.notes[0]


def test_a_crowd_in_chunks_is_the_crowd_whole():
    def places(crowd, ground, given):
        ik, frames = crowd.member(given)
        return frames.world_from_model.pos + ik.pelvis.limit * ground.up_ws

    with jax.enable_x64(False):
        people = setup.crowd(5, 24)
        flat = setup.single(rows.plane())
        row = measure.Row("crowd", "crowd", 1)
        parts = crowd.chunked(row, "plane", places, people, flat, 2)()
        parts = [jnp.moveaxis(part, -1, 0) for part in parts]  # members are last
        whole = jax.vmap(lambda given: places(people, flat, given))(people.rows)
    first, second, last = parts
    assert_close([first, second, last], [whole[:2], whole[2:4], whole[3:]], 1e-5)
    assert np.abs(np.asarray(whole[0] - whole[1])).max() > 1e-3  # no two alike
    assert row.work["plane"].operations >= 3 * 2 * 24 * 3  # of all three chunks


@pytest.fixture
def flat(monkeypatch):
    """Meshes that are planes: no second program."""
    monkeypatch.setattr(setup, "ground", lambda mesh: setup.single(rows.plane()))


def test_the_crowd_is_measured_on_a_plane_and_on_a_mesh(flat):
    found = named(measured("crowd"))
    assert found["plane, leg-frames a second"].at_least == 12.0
    assert found["mesh, leg-frames a second"].at_least == 5.0
    assert found["peak of memory"].value > 50.0


def test_the_gradient_is_counted_in_forward_runs(monkeypatch):
    # In place of the pipeline, whose slopes are shown elsewhere and take a minute to compile.
    easy = lambda ik, crowd, ground, frames: (ik.leg.soften * frames.pose.ankle.pos,)  # noqa: E731
    monkeypatch.setattr(crowd, "_taken", easy)
    row = measured("gradient")
    ratio = row.samples["reverse"][0] / row.samples["forward"][0]
    assert named(row)["reverse in forward runs"].value == pytest.approx(ratio)


def test_a_step_is_measured_with_its_dispatch(flat):
    row = measured("step")
    found = named(row)
    assert found["on a plane"].at_most == 150.0
    assert set(row.work) == set(row.samples) == {
        "plane", "mesh", "plane, program", "mesh, program",
    }  # fmt: skip


def test_slopes_are_counted_in_evaluations(quickly):
    row = measured("jacobian")
    for floats in ("float64", "float32"):
        rows, slopes = (np.median(row.samples[f"{what}, {floats}"]) for what in ("rows", "slopes"))
        assert named(row)[f"in evaluations, {floats}"].value == pytest.approx(slopes / rows)


def test_the_fit_is_of_twenty_parameters_with_slopes():
    problem = setup.problem(24)
    assert problem.space.size == 20 and all(problem.space.smooth)
    names = *problem.space.names, *setup.others()
    assert len(set(names)) == len(names) >= max(bench_tasks.FULL.parameters)


@pytest.fixture
def quickly(monkeypatch):
    """Two parameters, and residuals that compile at once."""

    def problem(count: int, names: tuple[str, ...] = ()) -> Problem:
        ik = presets.record()
        return Problem(
            make_space(ik, [free_parameter(ik, n) for n in TARGETS]), (), residuals_of_scenes
        )

    monkeypatch.setattr(setup, "TRUTH", TARGETS)
    monkeypatch.setattr(setup, "problem", problem)


def test_a_fit_is_measured_warm_and_in_processes_of_its_own(quickly, monkeypatch):
    begun = []

    def run(command, env, **options):
        begun.append((command[1:], env["JAX_COMPILATION_CACHE_DIR"], env["JAX_ENABLE_X64"]))
        assert fits.load_clip(Path(command[-1], fits.CLIPS[0])).frames == 12
        return fits.subprocess.CompletedProcess(command, 0, "1.00\n")

    monkeypatch.setattr(fits.subprocess, "run", run)
    row = measured("fit", frames=12)
    found = named(row)
    assert found["warm"].at_most == 2.0
    assert found["cold, empty cache"].at_most == 20.0
    assert found["cold, persistent cache"].at_most == 5.0
    (first, cache, x64), (second, same, _) = begun
    assert first == second and first[:2] == ["-m", "fitting.bench.fits"]
    assert cache == same and x64 == "1"
    assert sum("cost" in one.note for one in row.figures) == 3
    assert row.samples["its search, empty cache"] == [1.0]


def test_a_posterior_is_sampled_step_for_step(quickly):
    row = measured("posterior")
    (figure,) = row.figures
    assert figure.met is None and figure.what == "40 walkers, 2 steps"
    assert figure.value == row.samples["chain"][0]


def test_scaling_has_a_curve_and_a_slope_for_each_size(quickly, tmp_path, monkeypatch):
    monkeypatch.setattr(scaling, "ran", lambda ik, rig, ground, motion: 2 * motion.weight)
    report = measure.measure(
        measure.choose(bench_tasks.TASKS, "scaling"), SMALL, True, lambda line: None
    )
    row = report.rows[-1]
    assert [one.size for one in row.series] == [
        "legs in a batch", "frames", "legs of a character", "free parameters", "triangles",
    ]  # fmt: skip
    for one in row.series:
        for name, seconds in one.seconds.items():
            assert len(seconds) == len(one.sizes) == 2
            figure = named(row)[f"{name} against {one.size}"]
            assert figure.value == pytest.approx(one.slope(name))
    numbers, drawn = tmp_path / "bench.json", tmp_path / "bench.png"
    assert bench_report.write(report, numbers, drawn) == [numbers, drawn]
    assert drawn.read_bytes().startswith(b"\x89PNG")


def test_a_fit_that_was_interrupted_is_no_figure(quickly, monkeypatch):
    def interrupted(problem, progress):
        return dataclasses.replace(find_best_fit(problem), interrupted=True)

    monkeypatch.setattr(fits, "find_best_fit", interrupted)
    tasks = measure.choose(bench_tasks.TASKS, "fit")
    report = measure.measure(tasks, SMALL, True, lambda line: None)
    assert report.interrupted and report.rows[-1].figures == []
