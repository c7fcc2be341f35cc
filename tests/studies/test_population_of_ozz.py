"""Populations and bodies through the pipeline: short clips of `ozz` with known parameters.

All clips have one shape, and so one program.
"""

from collections.abc import Mapping
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from fitting.datasets.clips import edit, load_clip, save_clip
from fitting.experiments.experiment_files import load_experiment
from fitting.experiments.problems import make_problem
from fitting.inference.hierarchy.grouping import Grouping
from fitting.inference.hierarchy.population_fit import fit_population
from fitting.problem.problem import Problem
from fitting.problem.simulation import simulate
from fitting.studies.hierarchy.estimates import summarise
from fitting.studies.hierarchy.left_out import predict
from support.bodies import scaled
from support.experiments import ROOT

pytestmark = pytest.mark.slow

BASE = ROOT / "data" / "clips" / "stop_and_go_base.npz"
TERRAIN = ROOT / "data" / "terrains" / "stop_and_go.ply"
SIZE = 1.3
STARTS = (1.0, 4.0, 8.0)  # s, of clips of half a second
TRUTH = {"target.foot_height": 0.10, "pelvis.on_gain": 0.2, "leg.soften": 0.95}
HEADER = """
preset = "ozz"
faithful = true
body = "adult"
[free]
target.foot_height = {}
pelvis.on_gain = {}
leg.soften = {}
[sigmas]
ankle = 0.002
knee = 0.002
pelvis = 0.002
foot = 0.0087
[hierarchy]
scale_with_body = true
"""


@pytest.fixture(scope="module")
def problems(tmp_path_factory) -> list[Problem[jaxik.FootIK]]:
    """Problems of one clip each: three of one body, and the second again of a larger one."""
    folder, walk = tmp_path_factory.mktemp("ozz"), load_clip(BASE)
    clips = [edit.trim(walk, start, start + 0.5) for start in STARTS]
    clips.append(scaled(clips[1], SIZE, froude=True))
    tables = []
    for number, clip in enumerate(clips):
        path: Path = folder / f"{number}.npz"
        save_clip(path, clip)
        files = f'reference = "{path}"\nbase = "{path}"\nterrain = "{TERRAIN}"\n'
        tables.append(f'[[clips]]\n{files}root = "animation"\n')
    (folder / "ozz.toml").write_text(HEADER + "".join(tables))
    with jax.enable_x64(True):
        problem = make_problem(load_experiment(folder / "ozz.toml"))
    return [eqx.tree_at(lambda p: p.data, problem, (scene,)) for scene in problem.data]


def made(problem: Problem, values: Mapping[str, float], seed: int) -> Problem:
    """The problem with motion that these values make, plus noise."""
    return simulate(problem, jnp.asarray(problem.space.pack(values)), seed)


def test_a_fit_across_two_bodies_needs_their_sizes(problems):
    both = [made(problems[c], TRUTH, c) for c in (1, 3)]
    sizes = [float(problem.data[0].size) for problem in both]
    assert sizes[1] / sizes[0] == pytest.approx(SIZE)
    unsized = [eqx.tree_at(lambda p: p.data[0].size, problem, jnp.ones(())) for problem in both]
    space = problems[0].space
    start = np.tile(np.asarray(space.start), (2, 1))
    grouping = Grouping.pooled(2, space.size)
    with_sizes, without = (fit_population(p, grouping, [start]) for p in (both, unsized))
    fitted, other = (np.asarray(space.values(fit.centre)) for fit in (with_sizes, without))
    expected = np.array(list(TRUTH.values()))
    np.testing.assert_allclose(fitted, expected, rtol=0.03)
    assert with_sizes.converged and np.abs(other / expected - 1).max() > 0.1
    assert without.cost > 2 * with_sizes.cost


def test_the_population_of_short_clips_is_recovered(problems):
    """One body whose ankles stand at another height in each clip; all else is the same."""
    heights = (0.07, 0.085, 0.10)
    clips = [
        made(problem, TRUTH | {"target.foot_height": height}, c)
        for c, (problem, height) in enumerate(zip(problems[:3], heights, strict=True))
    ]
    space = clips[0].space
    grouping = Grouping.of_labels([["a", "b", "c"], None, None])
    starts = [np.tile(np.asarray(space.start), (3, 1))]
    fit = fit_population(clips, grouping, starts)
    assert fit.converged
    levels = ("clip", "shared", "shared")
    rows = summarise(clips, fit.clips, fit.centre, fit, levels)
    for estimate, truth in zip(rows[0]["clips"], heights, strict=True):
        assert estimate["value"] == pytest.approx(truth, abs=0.002)
    low, high = rows[0]["centre"]["interval"]  # type: ignore[misc]
    assert low < 0.085 < high
    assert rows[0]["spread"]["interval"][0] > 0  # type: ignore[index]
    assert rows[2]["centre"]["value"] == pytest.approx(0.95, abs=0.02)
    expected = predict(clips, grouping, fit, fit.centre, 0, lambda rounds, cost: None)
    assert expected[0] > fit.clips[0, 0] + 0.1, "the others' ankles are higher"


def test_clips_that_are_alike_have_a_spread_near_0(problems):
    clips = [made(problem, TRUTH, 10 + c) for c, problem in enumerate(problems[:3])]
    grouping = Grouping.of_labels([["a", "b", "c"], None, None])
    starts = [np.tile(np.asarray(clips[0].space.start), (3, 1))]
    fit = fit_population(clips, grouping, starts)
    heights = [float(np.asarray(clips[0].space.values(u))[0]) for u in fit.clips]
    assert fit.converged and fit.spread[0] < 0.05
    np.testing.assert_allclose(heights, TRUTH["target.foot_height"], atol=0.002)
