"""Residuals, and the slopes of the real pipeline's problem."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from experiments import CLIP, UNEVEN_WALK, write
from scipy.spatial.transform import Rotation

import jaxik
from fitting import experiment, residuals
from fitting.report import truth_of
from fitting.space import Problem

STEP = 1e-6  # of u, to either side
SLOPE = 1e-5  # of a column's largest slope
EVERY_KIND = """[sigmas]
ankle = 0.02
knee = 0.03
pelvis = 0.01
foot = 0.1
body = 0.2
contact = 0.5
smooth = 20.0
correlation = 0.4
"""


@pytest.fixture(scope="module")
def embedded() -> tuple[experiment.Experiment, Problem]:
    asked = experiment.load_experiment(UNEVEN_WALK)
    return asked, experiment.make_problem(asked)


@pytest.fixture(scope="module")
def at_truth(embedded) -> np.ndarray:
    """Residuals of the embedded experiment at the parameters that made its clip."""
    asked, problem = embedded
    rows = eqx.filter_jit(Problem.rows)(problem, true_u(asked, problem))
    return np.asarray(rows)[: -problem.space.size]


def true_u(asked: experiment.Experiment, problem: Problem) -> jax.Array:
    """`u` at the truth; what its file leaves out is the preset's."""
    truth = truth_of(asked)
    assert truth is not None
    return problem.space.pack({name: truth[name] for name in problem.space.names if name in truth})


def test_at_the_truth_residuals_are_one_standard_deviation(at_truth):
    active = at_truth[at_truth != 0.0]
    assert active.size > 10_000
    assert np.mean(active**2) == pytest.approx(1.0, rel=0.05)
    assert abs(np.mean(active)) < 0.05


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> residuals.Scene:
    """Two thirds of a second with every kind of residual and a frame that was not seen."""
    path = write(
        tmp_path_factory.mktemp("scene"), clips=CLIP, clip="start = 2.0\nend = 2.67",
        rest=EVERY_KIND,
    )  # fmt: skip
    (made,) = experiment.make_problem(experiment.load_experiment(path)).data
    seen = jnp.ones_like(made.reference.seen).at[9].set(False)
    return eqx.tree_at(lambda scene: scene.reference.seen, made, seen)


@pytest.fixture(scope="module")
def rows(scene) -> np.ndarray:
    return np.asarray(eqx.filter_jit(residuals.rows_of_scene)(jaxik.presets.record(), scene))


def expected_rows(scene) -> dict[str, np.ndarray]:
    """The same by NumPy and SciPy, from the poses that the pipeline gives."""
    result = jaxik.run(jaxik.presets.record(), scene.rig, scene.terrain, scene.frames)
    result, scene = jax.tree.map(np.asarray, (result, scene))
    world, reference, sigmas = scene.frames.world_from_model, scene.reference, scene.sigmas
    heading = rotation(world.rot)

    def to_world(points):
        legs = [heading.apply(points[:, leg]) + world.pos for leg in range(points.shape[1])]
        return np.stack(legs, axis=1)

    ankle = to_world(result.pose.ankle.pos) - reference.ankle.pos
    knee = to_world(result.pose.knee.pos) - reference.knee_ws
    body = rotation(result.body.rot)
    pelvis = heading.apply(body.apply(scene.pelvis.pos) + result.body.pos) + world.pos
    turned = heading * body * rotation(scene.pelvis.rot)
    foot = np.stack(
        [
            sine_turn(
                rotation(reference.ankle.rot[:, leg]),
                heading * rotation(result.pose.ankle.rot[:, leg]),
            )
            for leg in range(2)
        ],
        axis=1,
    )
    errors = {
        "ankle": ankle,
        "knee": knee,
        "pelvis": pelvis - reference.pelvis.pos,
        "foot": foot,
        "body": sine_turn(rotation(reference.pelvis.rot), turned),
        "contact": result.trace.sensed.contact.weight - reference.contact,
    }
    rho = sigmas.correlation
    rows = {}
    for kind, error in errors.items():
        scaled = error / getattr(sigmas, kind)
        made = np.zeros_like(scaled)
        for t in np.flatnonzero(reference.seen):
            follows = t > 0 and reference.seen[t - 1]
            told = rho * scaled[t - 1] if follows else 0.0
            made[t] = (scaled[t] - told) / (np.sqrt(1 - rho**2) if follows else 1.0)
        rows[kind] = made
    bend = np.diff(ankle, n=2, axis=0) / scene.frames.dt[1:-1, None, None] ** 2 / sigmas.smooth
    whole = np.convolve(reference.seen, [1, 1, 1], "valid") == 3
    rows["smooth"] = np.where(whole[:, None, None], bend, 0.0)
    return rows


def rotation(wxyz: np.ndarray) -> Rotation:
    return Rotation.from_quat(wxyz, scalar_first=True)


def sine_turn(a: Rotation, b: Rotation) -> np.ndarray:
    """Twice the sine of half the turn from `a` to `b`, along its axis in the space of `a`."""
    turn = (a.inv() * b).as_rotvec()
    angle = np.linalg.norm(turn, axis=-1, keepdims=True)
    return turn * np.sinc(angle / 2 / np.pi)


def test_rows_are_what_numpy_makes_of_the_poses(scene, rows):
    expected = expected_rows(scene)
    flat = np.concatenate([part.ravel() for part in expected.values()])
    np.testing.assert_allclose(rows, flat, rtol=0, atol=1e-7 * np.abs(flat).max())
    for kind, part in expected.items():
        assert np.abs(part).max() > 0.01, kind


def test_a_frame_that_was_not_seen_gives_no_row_and_spoils_none(scene, rows):
    frames = scene.reference.seen.size
    (ankle,) = np.split(rows[: frames * 6], 1)
    assert not ankle.reshape(frames, 6)[9].any() and ankle.reshape(frames, 6)[[8, 10]].all()
    smooth = rows[-(frames - 2) * 6 :].reshape(frames - 2, 6)
    np.testing.assert_array_equal(np.flatnonzero(~smooth.any(axis=1)), [7, 8, 9])
    lost = jnp.full_like(scene.reference.knee_ws[9], jnp.nan)
    gone = eqx.tree_at(
        lambda scene: scene.reference.knee_ws, scene, scene.reference.knee_ws.at[9].set(lost)
    )
    again = eqx.filter_jit(residuals.rows_of_scene)(jaxik.presets.record(), gone)
    np.testing.assert_array_equal(np.asarray(again), rows)


def test_an_infinite_sigma_leaves_a_kind_out(scene, rows):
    sigmas = dataclasses.replace(scene.sigmas, ankle=jnp.asarray(jnp.inf))
    without = eqx.tree_at(lambda scene: scene.sigmas, scene, sigmas)
    found = np.asarray(eqx.filter_jit(residuals.rows_of_scene)(jaxik.presets.record(), without))
    count = scene.reference.ankle.pos.size
    assert not found[:count].any() and found.size == rows.size
    np.testing.assert_array_equal(found[count:], rows[count:])


def test_a_leg_that_is_not_there_gives_no_rows(scene, rows):
    present = jnp.array([True, False])
    one = eqx.tree_at(lambda scene: scene.rig.present, scene, present)
    found = np.asarray(eqx.filter_jit(residuals.rows_of_scene)(jaxik.presets.record(), one))
    ankles = found[: scene.reference.ankle.pos.size].reshape(-1, 2, 3)
    assert ankles[:, 0].any() and not ankles[:, 1].any()


def test_several_clips_follow_one_another(scene, rows):
    both = eqx.filter_jit(residuals.rows_of_scenes)(jaxik.presets.record(), (scene, scene))
    np.testing.assert_allclose(both, np.concatenate([rows, rows]), rtol=0, atol=1e-9)


def test_whitening_makes_independent_rows_of_autoregressive_noise():
    rng, rho = np.random.default_rng(0), 0.9
    fresh = rng.normal(size=(20_000, 2))
    noise = np.empty_like(fresh)
    noise[0] = fresh[0]
    for t in range(1, len(fresh)):
        noise[t] = rho * noise[t - 1] + np.sqrt(1 - rho**2) * fresh[t]
    assert np.corrcoef(noise[1:, 0], noise[:-1, 0])[0, 1] == pytest.approx(rho, abs=0.01)
    seen = jnp.ones(len(fresh), bool)
    found = residuals.whitened(jnp.asarray(noise), seen, jnp.asarray(rho))
    np.testing.assert_allclose(found, fresh, rtol=0, atol=1e-12)


def test_whitening_begins_anew_after_a_gap():
    rows = jnp.arange(1.0, 7.0)
    seen = jnp.array([True, True, False, True, True, True])
    found = residuals.whitened(rows, seen, jnp.asarray(0.6))
    np.testing.assert_allclose(found, [1.0, 1.75, 0.0, 4.0, 3.25, 3.75])


def test_the_turn_between_rotations_is_that_of_the_nearer_sign():
    a = Rotation.from_rotvec([0.3, -0.2, 0.9])
    step = np.array([0.02, -0.01, 0.03])
    both = (a, a * Rotation.from_rotvec(step))
    start, end = (jnp.asarray(one.as_quat(scalar_first=True)) for one in both)
    for sign in (1.0, -1.0):
        np.testing.assert_allclose(residuals.turn_between(start, sign * end), step, atol=1e-5)


@pytest.fixture(scope="module")
def short(embedded) -> Problem:
    """Two seconds of the embedded experiment."""
    asked = embedded[0]
    (entry,) = asked.clips
    cut = dataclasses.replace(entry, start=1.6, end=3.6)
    return experiment.make_problem(dataclasses.replace(asked, clips=(cut,)))


@eqx.filter_jit
def slopes_both_ways(problem, u, directions, weights):
    """The Jacobian, one column from `jax.jvp`, one row from reverse mode, and rows around `u`."""
    rows, jacobian = problem.rows_and_jacobian(u)
    _, column = jax.jvp(problem.rows, (u,), (directions,))
    (row,) = jax.vjp(problem.rows, u)[1](weights)
    return rows, jacobian, column, row


@eqx.filter_jit
def rows_at(problem, points):
    return jax.vmap(problem.rows)(points)


@pytest.fixture(scope="module")
def slopes(embedded, short):
    problem = short
    u = true_u(embedded[0], problem) + 0.1
    rng = np.random.default_rng(0)
    rows = jax.eval_shape(problem.rows, u).shape
    directions, weights = jnp.asarray(rng.normal(size=u.size)), jnp.asarray(rng.normal(size=rows))
    found = slopes_both_ways(problem, u, directions, weights)
    return u, directions, weights, tuple(map(np.asarray, found))


def test_the_jacobian_agrees_with_finite_differences_column_by_column(short, slopes):
    u, _, _, (_, jacobian, _, _) = slopes
    moves = STEP * jnp.eye(u.size)
    ahead, behind = np.asarray(rows_at(short, jnp.concatenate([u + moves, u - moves]))).reshape(
        2, u.size, -1
    )
    moved = 0
    for i, (name, smooth) in enumerate(zip(short.space.names, short.space.smooth, strict=True)):
        if not smooth:
            continue
        expected = (ahead[i] - behind[i]) / (2 * STEP)
        scale = np.abs(expected).max()
        np.testing.assert_allclose(
            jacobian[:, i], expected, rtol=0, atol=SLOPE * max(1.0, scale), err_msg=name
        )
        moved += scale > 1.0
    assert moved >= 8, "most of the columns are more than the prior's"


def test_forward_and_reverse_mode_give_the_same_slopes(slopes):
    _, directions, weights, (_, jacobian, column, row) = slopes
    scale = np.abs(jacobian).max()
    np.testing.assert_allclose(jacobian @ directions, column, rtol=0, atol=1e-9 * scale)
    np.testing.assert_allclose(weights @ jacobian, row, rtol=1e-9, atol=1e-8 * scale)


def test_a_threshold_has_no_slope_but_that_of_its_prior(short, slopes):
    jacobian = slopes[3][1]
    thresholds = np.asarray(short.space.thresholds)
    assert thresholds.any()
    assert not jacobian[: -short.space.size, thresholds].any()


def test_another_clip_of_the_same_shape_compiles_nothing(embedded, short, slopes):
    (entry,) = embedded[0].clips
    cut = dataclasses.replace(entry, start=5.0, end=7.0)
    other = experiment.make_problem(dataclasses.replace(embedded[0], clips=(cut,)))
    u = other.space.u0
    compiled = []

    def listen(event: str, duration_secs: float, **_) -> None:
        if "backend_compile" in event:
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        found = slopes_both_ways(other, u, slopes[1], slopes[2])
        assert not compiled
        assert np.isfinite(found[1]).all() and np.abs(found[0] - slopes[3][0]).max() > 1.0
        jax.jit(lambda x: x + 2)(1.0)  # the listener does hear a compilation
        assert compiled
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
