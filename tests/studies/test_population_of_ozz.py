"""Populations and bodies through the pipeline: short clips of `ozz` with known parameters."""

import dataclasses
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from fitting.datasets.clips import edit, load_clip, save_clip
from fitting.experiments.experiment import Experiment
from fitting.experiments.experiment_files import load_experiment
from fitting.experiments.problems import make_problem
from fitting.inference.optimisation.search import find_best_fit
from fitting.problem.problem import Problem
from fitting.problem.simulation import simulate
from fitting.studies.hierarchy.population import fit_clips_and_population
from support.bodies import scaled
from support.experiments import ROOT

BASE = ROOT / "data" / "clips" / "stop_and_go_base.npz"
TERRAIN = ROOT / "data" / "terrains" / "stop_and_go.ply"
SIZE = 1.3
SIGMAS = "[sigmas]\nankle = 0.002\nknee = 0.002\npelvis = 0.002\nfoot = 0.0087\n"


def clip_table(base: Path, cut: str = "", subject: str = "") -> str:
    files = f'reference = "{base}"\nbase = "{base}"\nterrain = "{TERRAIN}"\nroot = "animation"\n'
    return f'[[clips]]\n{files}{cut}subject = "{subject}"\n'


def load(folder: Path, clips: str, free: str, hierarchy: str) -> Experiment:
    top = 'preset = "ozz"\nbody = "adult"\n'
    path = folder / "ozz.toml"
    path.write_text(f"{top}{clips}[free]\n{free}\n{SIGMAS}[hierarchy]\n{hierarchy}")
    return load_experiment(path)


@pytest.mark.slow
def test_a_fit_across_two_bodies_needs_their_sizes(tmp_path):
    walk = edit.trim(load_clip(BASE), 1.0, 2.0)
    for name, size in (("one", 1.0), ("other", SIZE)):
        save_clip(tmp_path / f"{name}.npz", scaled(walk, size, froude=True))
    clips = clip_table(tmp_path / "one.npz") + clip_table(tmp_path / "other.npz")
    free = "target.foot_height = {}\nroot.half_life = {}\n"
    experiment = load(tmp_path, clips, free, "scale_with_body = true\n")
    problem = make_problem(experiment)
    sizes = [float(scene.size) for scene in problem.data]  # type: ignore[arg-type]
    assert sizes[1] / sizes[0] == pytest.approx(SIZE)
    truth = {"target.foot_height": 0.10, "root.half_life": 0.12}
    u = problem.space.pack(truth)
    simulated = simulate(problem, u)
    unsized = eqx.tree_at(
        lambda p: p.data, simulated,
        tuple(dataclasses.replace(scene, size=None) for scene in simulated.data),
    )  # fmt: skip
    with_sizes, without = (find_best_fit(p, starts=1) for p in (simulated, unsized))
    expected = np.array(list(truth.values()))
    np.testing.assert_allclose(with_sizes.values, expected, rtol=0.02)
    assert (np.abs(without.values / expected - 1) > 0.04).all()
    assert without.cost > 2 * with_sizes.cost


@pytest.mark.slow
def test_the_population_of_short_clips_is_recovered(tmp_path):
    """One body that stands differently in each clip; all else is the same."""
    clips = "".join(
        clip_table(BASE, f"start = {start}\nend = {start + 0.5}\n", f"walk at {start}")
        for start in (1.0, 4.0, 8.0)
    )
    free = "target.foot_height = {}\nleg.soften = {}\n"
    experiment = load(tmp_path, clips, free, 'per_clip = ["target.foot_height"]\n')
    heights = (0.07, 0.085, 0.10)
    made = make_problem(experiment)
    simulated = [
        _of_clip(made, c, {"target.foot_height": height, "leg.soften": 0.95})
        for c, height in enumerate(heights)
    ]
    problem = eqx.tree_at(lambda p: p.data, made, tuple(s.data[0] for s in simulated))
    fitted = fit_clips_and_population(experiment, problem)
    height, soften = fitted.parameters
    for estimate, truth in zip(height["clips"], heights, strict=True):
        low, high = estimate["interval"]  # type: ignore[misc]
        assert low - 0.001 < truth < high + 0.001
    low, high = height["centre"]["interval"]  # type: ignore[misc]
    assert low < 0.085 < high
    assert height["spread"]["interval"][0] > 0  # type: ignore[index]
    assert soften["centre"]["value"] == pytest.approx(0.95, abs=0.02)
    for row in fitted.errors:
        assert row.alone < 0.005 and row.population < 0.005
        assert row.left_out_population > 1.5 * row.alone
    assert fitted.fit.converged


def _of_clip(problem: Problem[jaxik.FootIK], clip: int, truth: dict[str, float]):
    """The problem of one clip, with motion that these values make."""
    single = eqx.tree_at(lambda p: p.data, problem, (problem.data[clip],))
    return simulate(single, jnp.asarray(single.space.pack(truth)), seed=clip)
