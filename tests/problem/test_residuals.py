"""Residuals, and the slopes of the real pipeline's problem."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxik
from fitting.experiments import experiment
from fitting.experiments.known_values import load_known_values
from fitting.problem import residuals
from fitting.problem.problem import Problem
from fitting.problem.scene import Scene
from support.experiments import CLIP, UNEVEN_WALK, write

BESIDE = 0.1  # in u, away from where the clip was made
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
def embedded() -> Problem:
    """The embedded experiment."""
    return problems.make_problem(experiment_files.load_experiment(UNEVEN_WALK))


@pytest.fixture(scope="module")
def truth(embedded) -> jax.Array:
    """`u` of the parameters that made its clip; what their file leaves out is the preset's."""
    known = load_known_values(experiment_files.load_experiment(UNEVEN_WALK))
    assert known is not None
    names = embedded.space.names
    return embedded.space.pack({name: known[name] for name in names if name in known})


# Compiled in a hurry: what is only looked at, and not the slopes that a fit uses.
hurried = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})


@hurried
def rows_and_result(ik, scene):
    return residuals.residuals_of_scene(ik, scene), jaxik.run(
        ik, scene.rig, scene.terrain, scene.frames
    )


def rows_of(scene) -> np.ndarray:
    return np.asarray(rows_and_result(jaxik.presets.record(), scene)[0])


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    """Two thirds of a second with every kind of residual and a frame that was not seen."""
    path = write(
        tmp_path_factory.mktemp("scene"), clips=CLIP, clip="start = 2.0\nend = 2.67",
        rest=EVERY_KIND,
    )  # fmt: skip
    (made,) = problems.make_problem(experiment_files.load_experiment(path)).data
    seen = jnp.ones_like(made.reference.observed).at[9].set(False)
    return eqx.tree_at(lambda scene: scene.reference.observed, made, seen)


@pytest.fixture(scope="module")
def rows(scene) -> np.ndarray:
    return rows_of(scene)


def expected_rows(scene) -> dict[str, np.ndarray]:
    """The same by NumPy and SciPy, from the poses that the pipeline gives."""
    result = rows_and_result(jaxik.presets.record(), scene)[1]
    result, scene = jax.tree.map(np.array, (result, scene))  # copies: SciPy writes to none else
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
        for t in np.flatnonzero(reference.observed):
            follows = t > 0 and reference.observed[t - 1]
            told = rho * scaled[t - 1] if follows else 0.0
            made[t] = (scaled[t] - told) / (np.sqrt(1 - rho**2) if follows else 1.0)
        rows[kind] = made
    bend = np.diff(ankle, n=2, axis=0) / scene.frames.dt[1:-1, None, None] ** 2 / sigmas.smooth
    whole = np.convolve(reference.observed, [1, 1, 1], "valid") == 3
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
    frames = scene.reference.observed.size
    (ankle,) = np.split(rows[: frames * 6], 1)
    assert not ankle.reshape(frames, 6)[9].any() and ankle.reshape(frames, 6)[[8, 10]].all()
    smooth = rows[-(frames - 2) * 6 :].reshape(frames - 2, 6)
    np.testing.assert_array_equal(np.flatnonzero(~smooth.any(axis=1)), [7, 8, 9])
    lost = jnp.full_like(scene.reference.knee_ws[9], jnp.nan)
    gone = eqx.tree_at(
        lambda scene: scene.reference.knee_ws, scene, scene.reference.knee_ws.at[9].set(lost)
    )
    np.testing.assert_array_equal(rows_of(gone), rows)


def test_an_infinite_sigma_leaves_a_kind_out(scene, rows):
    sigmas = dataclasses.replace(scene.sigmas, ankle=jnp.full_like(scene.sigmas.ankle, jnp.inf))
    without = eqx.tree_at(lambda scene: scene.sigmas, scene, sigmas)
    found = rows_of(without)
    count = scene.reference.ankle.pos.size
    assert not found[:count].any() and found.size == rows.size
    np.testing.assert_array_equal(found[count:], rows[count:])


def test_a_leg_that_is_not_there_gives_no_rows(scene, rows):
    present = jnp.array([True, False])
    one = eqx.tree_at(lambda scene: scene.rig.present, scene, present)
    found = rows_of(one)
    ankles = found[: scene.reference.ankle.pos.size].reshape(-1, 2, 3)
    assert ankles[:, 0].any() and not ankles[:, 1].any()


def test_several_clips_follow_one_another(scene, monkeypatch):
    monkeypatch.setattr(residuals, "residuals_of_scene", lambda ik, scene: scene.rig.shin)
    other = eqx.tree_at(lambda scene: scene.rig.shin, scene, jnp.array([3.0]))
    found = residuals.residuals_of_scenes(jaxik.presets.record(), (other, scene))
    np.testing.assert_array_equal(found, [3.0, *scene.rig.shin])


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
        np.testing.assert_allclose(residuals.rotation_between(start, sign * end), step, atol=1e-5)


@jax.jit
def residuals_and_jacobian(problem, u):
    return problem.residuals_and_jacobian(u)


@hurried
def rows_at(problem, points):
    return jax.vmap(problem.residuals)(points)


@hurried
def reverse_mode(problem, u, weights):
    return jax.vjp(problem.residuals, u)[1](weights)[0]


@pytest.fixture(scope="module")
def jacobian(embedded, truth) -> np.ndarray:
    """Slopes beside the truth."""
    return np.asarray(residuals_and_jacobian(embedded, truth + BESIDE)[1])


@pytest.fixture(scope="module")
def around(embedded, truth) -> np.ndarray:
    """Rows at the truth, then a step ahead of and a step behind the point beside it, by column."""
    moves = STEP * jnp.eye(truth.size)
    beside = truth + BESIDE
    return np.asarray(rows_at(embedded, jnp.stack([truth, *(beside + moves), *(beside - moves)])))


def test_at_the_truth_residuals_are_one_standard_deviation(embedded, around):
    rows = around[0, : -embedded.space.size]
    active = rows[rows != 0.0]
    assert active.size > 8_000
    assert np.mean(active**2) == pytest.approx(1.0, rel=0.05)
    assert abs(np.mean(active)) < 0.05


def test_the_jacobian_agrees_with_finite_differences_column_by_column(embedded, jacobian, around):
    space = embedded.space
    ahead, behind = around[1:].reshape(2, space.size, -1)
    told = 0
    for i, (name, smooth) in enumerate(zip(space.names, space.smooth, strict=True)):
        if smooth:
            expected = (ahead[i] - behind[i]) / (2 * STEP)
            scale = np.abs(expected).max()
            atol = SLOPE * max(1.0, scale)
            np.testing.assert_allclose(jacobian[:, i], expected, rtol=0, atol=atol, err_msg=name)
            told += scale > 1.0
    assert told >= 0.8 * sum(space.smooth), "the clip tells more of most columns than the prior"


def test_reverse_mode_gives_the_slopes_of_forward_mode(embedded, truth, jacobian):
    weights = np.random.default_rng(0).normal(size=len(jacobian))
    found = reverse_mode(embedded, truth + BESIDE, jnp.asarray(weights))
    scale = np.linalg.norm(jacobian, axis=0)
    np.testing.assert_allclose(found / scale, weights @ jacobian / scale, rtol=0, atol=1e-8)


def test_another_clip_of_the_same_shape_compiles_nothing(embedded, truth, jacobian):
    (scene,) = embedded.data
    pelvis, ankle = (
        eqx.tree_at(lambda part: part.pos, part, part.pos + 0.01)
        for part in (scene.reference.pelvis, scene.reference.ankle)
    )
    reference = dataclasses.replace(scene.reference, pelvis=pelvis, ankle=ankle)
    frames = eqx.tree_at(lambda frames: frames.slide, scene.frames, 1 - scene.frames.slide)
    other = dataclasses.replace(scene, reference=reference, frames=frames)
    again = problems.make_problem(experiment_files.load_experiment(UNEVEN_WALK))
    again = dataclasses.replace(again, data=(other,))
    compiled = []

    def listen(event: str, duration_secs: float, **_) -> None:
        if "backend_compile" in event:
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        found = np.asarray(residuals_and_jacobian(again, truth)[1])
        assert not compiled
        assert np.isfinite(found).all() and np.abs(found - jacobian).max() > 1.0
        jax.jit(lambda x: x + 2)(1.0)  # the listener does hear a compilation
        assert compiled
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
