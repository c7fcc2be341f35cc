"""Residuals of the real pipeline and their Jacobian, and references that are simulated."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

import jaxik
from fitting.experiment import experiment_files, problems
from fitting.experiment.problems import load_known_values
from fitting.motion import playback
from fitting.problem import residuals
from fitting.problem.problem import Problem, digest
from fitting.problem.scene import PER_LEG
from fitting.problem.simulation import autoregression, simulate
from fitting.runtime.program_cache import committed
from jaxik.maths import parameter_tree
from support.experiments import CLIP, EVERY_KIND, UNEVEN_WALK, write

BESIDE = 0.1  # in u, away from where the clip was made
STEP = 1e-6  # of u, to either side
TOLERANCE = 1e-5  # of a column's largest derivative
MASKED = 9  # a frame that was not observed

rotation = functools.partial(Rotation.from_quat, scalar_first=True)


class Evaluated(NamedTuple):
    """One program for all tests: what a problem of one clip says at a point."""

    residuals: np.ndarray
    """Of the data."""
    jacobian: np.ndarray
    """Of them."""
    result: jaxik.Result

    def by_kind(self) -> dict[str, np.ndarray]:
        """Residuals, frame by frame."""
        frames = len(self.result.body.pos)
        widths = {"ankle": 6, "knee": 6, "pelvis": 3, "foot": 6, "body": 3, "contact": 2}
        ends = np.cumsum([frames * width for width in widths.values()])
        *parts, smooth = np.split(self.residuals, ends)
        whole = {kind: x.reshape(frames, -1) for kind, x in zip(widths, parts, strict=True)}
        return whole | {"smooth": smooth.reshape(frames - 2, 6)}


@jax.jit
def evaluation(problem: Problem, u: jax.Array):
    return problem.residuals_and_jacobian(u)


def evaluate(problem: Problem, u: np.ndarray | jax.Array) -> Evaluated:
    prior, result = problem.space.size, playback.run(problem.space.unpack(u), *problem.data)
    of_all, jacobian = evaluation(*committed((problem, jnp.asarray(u))))
    return Evaluated(np.asarray(of_all[:-prior]), np.asarray(jacobian[:-prior]), result)


def changed(
    problem: Problem, sigmas: dict[str, float] | None = None, reference: dict | None = None, **other
) -> Problem:
    """The problem with other parts of its scene, of the same types, so that nothing recompiles."""
    (scene,) = problem.data
    alike = {k: jnp.full_like(getattr(scene.sigmas, k), x) for k, x in (sigmas or {}).items()}
    other["sigmas"] = dataclasses.replace(scene.sigmas, **alike)
    other["reference"] = dataclasses.replace(scene.reference, **(reference or {}))
    return dataclasses.replace(problem, data=(dataclasses.replace(scene, **other),))


@pytest.fixture(scope="module")
def problem(tmp_path_factory) -> Problem:
    """Two seconds with every kind of residual and an unobserved frame, made for an adult."""
    top = 'preset = "record"\nfaithful = true\nbody = "adult"\nloss = "squares"'
    folder = tmp_path_factory.mktemp("scene")
    path = write(folder, top=top, clips=CLIP, clip="end = 2.0", rest=EVERY_KIND)
    problem = problems.make_problem(experiment_files.load_experiment(path))
    observed = jnp.ones_like(problem.data[0].reference.observed).at[MASKED].set(False)
    return changed(problem, reference={"observed": observed})


@pytest.fixture(scope="module")
def start(problem) -> Evaluated:
    return evaluate(problem, problem.space.start)


def rotation_vector(a: Rotation, b: Rotation) -> np.ndarray:
    """Axis of the rotation from `a` to `b`, in the space of `a`, times `2 sin(angle / 2)`."""
    vector = (a.inv() * b).as_rotvec()
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    return vector * np.sinc(angle / 2 / np.pi)


def expected_residuals(result: Any, scene: Any) -> dict[str, np.ndarray]:
    """Computed with NumPy and SciPy from the poses of the pipeline."""
    result, scene = jax.tree.map(np.array, (result, scene))  # copies, which SciPy may write to
    world, reference, sigmas = scene.frames.world_from_model, scene.reference, scene.sigmas
    heading, body = rotation(world.rot), rotation(result.body.rot)

    def of_legs(leg: Callable[[int], np.ndarray]) -> np.ndarray:
        return np.stack([leg(0), leg(1)], axis=1)

    def in_world(points: np.ndarray) -> np.ndarray:
        return of_legs(lambda leg: heading.apply(points[:, leg]) + world.pos)

    def foot(leg: int) -> np.ndarray:
        solved = heading * rotation(result.pose.ankle.rot[:, leg])
        return rotation_vector(rotation(reference.ankle.rot[:, leg]), solved)

    ankle = in_world(result.pose.ankle.pos) - reference.ankle.pos
    pelvis = heading.apply(body.apply(scene.pelvis.pos) + result.body.pos) + world.pos
    pelvis_rot = heading * body * rotation(scene.pelvis.rot)
    errors = {
        "ankle": ankle,
        "knee": in_world(result.pose.knee.pos) - reference.knee_ws,
        "pelvis": pelvis - reference.pelvis.pos,
        "foot": of_legs(foot),
        "body": rotation_vector(rotation(reference.pelvis.rot), pelvis_rot),
        "contact": result.trace.sensed.contact.weight - reference.contact,
    }
    expected = {}
    for kind, error in errors.items():
        scaled, rho = error / getattr(sigmas, kind), sigmas.correlation_of(kind)
        expected[kind] = np.zeros_like(scaled)
        for t in np.flatnonzero(reference.observed):
            follows = t > 0 and reference.observed[t - 1]
            predicted = rho * scaled[t - 1] if follows else 0.0
            remaining = np.sqrt(1 - rho**2) if follows else 1.0
            expected[kind][t] = (scaled[t] - predicted) / remaining
    dt = scene.frames.dt[1:-1, None, None]
    acceleration = np.diff(ankle, n=2, axis=0) / dt**2 / sigmas.smooth
    three_observed = np.convolve(reference.observed, [1, 1, 1], "valid") == 3
    expected["smooth"] = np.where(three_observed[:, None, None], acceleration, 0.0)
    return expected


def test_residuals_agree_with_numpy(problem, start):
    expected = expected_residuals(start.result, problem.data[0])
    flat = np.concatenate([part.ravel() for part in expected.values()])
    np.testing.assert_allclose(start.residuals, flat, rtol=0, atol=1e-7 * np.abs(flat).max())
    for kind, part in expected.items():
        assert np.abs(part).max() > 0.01, kind


def test_frames_unobserved_kinds_switched_off_and_legs_absent_have_no_residuals(problem, start):
    """And affect no other."""
    masked = {kind: np.flatnonzero(~x.any(axis=1)).tolist() for kind, x in start.by_kind().items()}
    assert masked["ankle"] == [MASKED]
    assert masked["smooth"] == [MASKED - 2, MASKED - 1, MASKED]
    knee_ws = problem.data[0].reference.knee_ws.at[MASKED].set(jnp.nan)
    again = evaluate(changed(problem, reference={"knee_ws": knee_ws}), problem.space.start)
    np.testing.assert_array_equal(again.residuals, start.residuals)
    off = evaluate(changed(problem, {"ankle": np.inf}), problem.space.start).by_kind()
    for kind, expected in start.by_kind().items():
        np.testing.assert_array_equal(off[kind], 0 if kind == "ankle" else expected)
    rig = dataclasses.replace(problem.data[0].rig, present=jnp.array([True, False]))
    absent = evaluate(changed(problem, rig=rig), problem.space.start).by_kind()
    for kind in ("ankle", "knee", "foot", "contact", "smooth"):
        first, second = np.split(absent[kind], 2, axis=1)
        assert first.any() and not second.any(), kind


@pytest.mark.slow
def test_a_leg_that_is_left_out_has_no_residuals_and_affects_no_other(problem, start):
    """Where it comes back, its residuals are as in a first frame."""
    (scene,) = problem.data
    out = np.zeros((len(scene.frames.dt), 2), bool)
    out[20:30, 0] = True
    left_out = changed(problem, reference={"left_out": jnp.asarray(out)})
    (without,) = left_out.data
    unknown = jnp.where(out[..., None], jnp.nan, scene.reference.knee_ws)
    reference = dataclasses.replace(without.reference, knee_ws=unknown)
    without = dataclasses.replace(without, reference=reference)
    whole, part = (
        residuals.residuals_by_kind(each, residuals.errors_by_kind(each, start.result))
        for each in (scene, without)
    )
    for kind in whole:
        before, after = np.array(whole[kind]), np.array(part[kind])
        if kind in PER_LEG:
            first = 18 if kind == "smooth" else 20  # of an acceleration, which takes three frames
            assert before[first:30, 0].any() and not after[first:30, 0].any()
            if kind == "smooth":
                before[first:30, 0] = 0.0
            else:
                error = residuals.errors_by_kind(scene, start.result)[kind][30, 0]
                np.testing.assert_array_equal(after[30, 0], error / getattr(scene.sigmas, kind))
                before[first:31, 0] = after[first:31, 0]
        np.testing.assert_array_equal(after, before, err_msg=kind)
    counts = np.asarray(without.counts("ankle"))
    np.testing.assert_array_equal(counts, ~out & np.asarray(scene.reference.observed)[:, None])
    digests = {digest(each) for each in (problem, left_out)}
    assert len(digests) == 2, "a fit would go on with what it knows of other data"


def test_an_autoregression_is_stationary():
    """Its variance and its correlation after one and two steps, against their formulas."""
    noise = autoregression(np.random.default_rng(0).normal(size=(100, 20_000)), 0.8)
    assert np.allclose(noise.var(axis=1), 1, atol=0.06)
    for lag in (1, 2):
        assert np.mean(noise[lag:] * noise[:-lag]) == pytest.approx(0.8**lag, abs=0.01)


def test_the_rotation_between_two_quaternions_does_not_depend_on_their_signs():
    a = Rotation.from_rotvec([0.3, -0.2, 0.9])
    step = np.array([0.02, -0.01, 0.03])
    b = a * Rotation.from_rotvec(step)
    start, end = (jnp.asarray(rot.as_quat(scalar_first=True)) for rot in (a, b))
    for sign in (1.0, -1.0):
        np.testing.assert_allclose(residuals.rotation_between(start, sign * end), step, atol=1e-5)


def test_at_the_truth_of_the_embedded_experiment_residuals_are_one_standard_deviation(problem):
    """What its truth leaves out is as in the experiment."""
    experiment = experiment_files.load_experiment(UNEVEN_WALK)
    known = load_known_values(experiment)
    assert known is not None
    truth = {**experiment.parameters, **known}
    system = parameter_tree.replace(problem.space.system, truth)
    space = dataclasses.replace(problem.space, system=system)
    off = dict.fromkeys(("contact", "smooth"), np.inf) | {"correlation": 0.0}
    embedded = changed(dataclasses.replace(problem, space=space), {**experiment.sigmas, **off})
    at_truth = evaluate(embedded, space.pack(system)).residuals
    active = at_truth[at_truth != 0.0]
    assert active.size > 500
    assert np.mean(active**2) == pytest.approx(1.0, abs=4 * np.sqrt(2 / active.size))
    assert abs(np.mean(active)) < 4 / np.sqrt(active.size)


def test_the_jacobian_agrees_with_finite_differences_column_by_column(problem):
    u = np.asarray(problem.space.start) + BESIDE
    jacobian, scales = evaluate(problem, u).jacobian, []
    for i, move in enumerate(STEP * np.eye(u.size)):
        ahead, behind = (evaluate(problem, u + sign * move).residuals for sign in (1, -1))
        expected = (ahead - behind) / (2 * STEP)
        scales.append(np.abs(expected).max())
        atol = TOLERANCE * max(1.0, scales[i])
        np.testing.assert_allclose(
            jacobian[:, i], expected, rtol=0, atol=atol, err_msg=problem.space.names[i]
        )
    assert max(scales) > 1.0  # a limit that is not reached has no effect


# Simulated references


@pytest.fixture(scope="module")
def measured(problem) -> Problem:
    """With independent residuals of every kind that can be simulated, in all frames."""
    observed = jnp.ones_like(problem.data[0].reference.observed)
    return changed(problem, {"smooth": np.inf, "correlation": 0.0}, {"observed": observed})


@pytest.mark.slow
@pytest.mark.parametrize(("correlation", "fraction"), [(0.0, 1.0), (0.9, 1.0), (0.0, 0.1)])
def test_residuals_at_the_truth_are_the_noise_that_is_assumed(measured, correlation, fraction):
    """Standard normal, and as correlated as the fraction of independent ones says."""
    noisy = changed(measured, {"correlation": correlation}).with_weight(fraction)
    u, drawn = np.asarray([0.7, -1.2]), []
    same = {"label": measured.data[0].reference.label}  # for which there is a program
    for seed in range(8):
        drawn.append(evaluate(changed(simulate(noisy, u, seed), reference=same), u).by_kind())
    rho = (1 - fraction) / (1 + fraction)
    for kind in drawn[0].keys() - {"smooth"}:
        series = np.concatenate([draw[kind] for draw in drawn], axis=1) / np.sqrt(fraction)
        count = series.size * (1 - rho) / (1 + rho)
        assert abs(series.mean()) < 4 / np.sqrt(count), kind
        assert abs(series.var() - 1) < 6 / np.sqrt(count), kind
        lag = np.sum(series[1:] * series[:-1]) / np.sum(series**2)
        assert abs(lag - rho) < 5 / np.sqrt(count), kind
        if rho == 0:
            assert stats.kstest(series.ravel(), "norm").pvalue > 1e-4, kind


@pytest.mark.slow
def test_seeds_give_noise_but_for_kinds_that_are_off_and_accelerations_have_none(problem, measured):
    u = np.zeros(2)
    first, again, other = (simulate(measured, u, seed) for seed in (3, 3, 4))
    knees = [p.data[0].reference.knee_ws for p in (first, again, other)]
    assert np.array_equal(knees[0], knees[1])
    assert not np.array_equal(knees[0], knees[2])
    observed = problem.data[0].reference.observed
    masked = changed(measured, {"ankle": np.inf}, {"observed": observed})
    (scene,) = simulate(masked, u).data
    assert np.flatnonzero(~scene.reference.observed).tolist() == [MASKED]
    errors = residuals.errors_by_kind(scene, evaluate(masked, u).result)
    assert np.max(np.abs(errors["ankle"])) < 1e-12
    with pytest.raises(ValueError, match=r"sigmas.smooth is 20: .*wanted inf"):
        simulate(problem, u)
