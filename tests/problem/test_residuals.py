"""Residuals of the real pipeline, and their Jacobian."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxik
from fitting.experiments import experiment_files, problems
from fitting.experiments.known_values import load_known_values
from fitting.problem import residuals
from fitting.problem.problem import Problem
from fitting.problem.scene import Scene
from fitting.problem.shared_world import share_world
from support.experiments import CLIP, UNEVEN_WALK, write

pytestmark = pytest.mark.slow

BESIDE = 0.1  # in u, away from where the clip was made
STEP = 1e-6  # of u, to either side
TOLERANCE = 1e-5  # of a column's largest derivative
EVERY_KIND = """[sigmas]
ankle = 0.02
knee = 0.03
pelvis = 0.01
foot = 0.1
body = 0.2
contact = 0.5
smooth = 20.0
correlation = { ankle = 0.4, knee = 0.3, pelvis = 0.9, foot = 0.2, body = 0.1 }
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


# Compiled without optimisation, for what is not the Jacobian that a fit uses.
quick_jit = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})


@quick_jit
def residuals_and_result(ik, scene):
    return residuals.residuals_of_scenes(ik, (scene,)), jaxik.run(
        ik, scene.rig, scene.terrain, scene.frames
    )


def compute_residuals(scene) -> np.ndarray:
    return np.asarray(residuals_and_result(jaxik.presets.record(), scene)[0])


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    """Two thirds of a second with every kind of residual and an unobserved frame."""
    path = write(
        tmp_path_factory.mktemp("scene"), clips=CLIP, clip="start = 2.0\nend = 2.67",
        rest=EVERY_KIND,
    )  # fmt: skip
    (scene,) = problems.make_problem(experiment_files.load_experiment(path)).data
    observed = jnp.ones_like(scene.reference.observed).at[9].set(False)
    return eqx.tree_at(lambda scene: scene.reference.observed, scene, observed)


@pytest.fixture(scope="module")
def scene_residuals(scene) -> np.ndarray:
    return compute_residuals(scene)


def expected_residuals(scene) -> dict[str, np.ndarray]:
    """Computed with NumPy and SciPy from the poses of the pipeline."""
    result = residuals_and_result(jaxik.presets.record(), scene)[1]
    result, scene = jax.tree.map(np.array, (result, scene))  # copies, which SciPy may write to
    world, reference, sigmas = scene.frames.world_from_model, scene.reference, scene.sigmas
    heading = rotation(world.rot)

    def to_world(points):
        legs = [heading.apply(points[:, leg]) + world.pos for leg in range(points.shape[1])]
        return np.stack(legs, axis=1)

    ankle = to_world(result.pose.ankle.pos) - reference.ankle.pos
    knee = to_world(result.pose.knee.pos) - reference.knee_ws
    body = rotation(result.body.rot)
    pelvis = heading.apply(body.apply(scene.pelvis.pos) + result.body.pos) + world.pos
    pelvis_rot = heading * body * rotation(scene.pelvis.rot)
    foot = np.stack(
        [
            rotation_vector(
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
        "body": rotation_vector(rotation(reference.pelvis.rot), pelvis_rot),
        "contact": result.trace.sensed.contact.weight - reference.contact,
    }
    expected = {}
    for kind, error in errors.items():
        scaled, rho = error / getattr(sigmas, kind), sigmas.correlation_of(kind)
        whitened = np.zeros_like(scaled)
        for t in np.flatnonzero(reference.observed):
            follows = t > 0 and reference.observed[t - 1]
            predicted = rho * scaled[t - 1] if follows else 0.0
            whitened[t] = (scaled[t] - predicted) / (np.sqrt(1 - rho**2) if follows else 1.0)
        expected[kind] = whitened
    acceleration = (
        np.diff(ankle, n=2, axis=0) / scene.frames.dt[1:-1, None, None] ** 2 / sigmas.smooth
    )
    three_observed = np.convolve(reference.observed, [1, 1, 1], "valid") == 3
    expected["smooth"] = np.where(three_observed[:, None, None], acceleration, 0.0)
    return expected


def rotation(wxyz: np.ndarray) -> Rotation:
    return Rotation.from_quat(wxyz, scalar_first=True)


def rotation_vector(a: Rotation, b: Rotation) -> np.ndarray:
    """Axis of the rotation from `a` to `b`, in the space of `a`, times `2 sin(angle / 2)`."""
    vector = (a.inv() * b).as_rotvec()
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    return vector * np.sinc(angle / 2 / np.pi)


def test_residuals_agree_with_numpy(scene, scene_residuals):
    expected = expected_residuals(scene)
    flat = np.concatenate([part.ravel() for part in expected.values()])
    np.testing.assert_allclose(scene_residuals, flat, rtol=0, atol=1e-7 * np.abs(flat).max())
    for kind, part in expected.items():
        assert np.abs(part).max() > 0.01, kind


def test_an_unobserved_frame_has_zero_residuals_and_affects_no_other(scene, scene_residuals):
    frames = scene.reference.observed.size
    ankle = scene_residuals[: frames * 6].reshape(frames, 6)
    assert not ankle[9].any() and ankle[[8, 10]].all()
    smooth = scene_residuals[-(frames - 2) * 6 :].reshape(frames - 2, 6)
    np.testing.assert_array_equal(np.flatnonzero(~smooth.any(axis=1)), [7, 8, 9])
    knee = scene.reference.knee_ws
    with_nan = eqx.tree_at(
        lambda scene: scene.reference.knee_ws,
        scene,
        knee.at[9].set(jnp.full_like(knee[9], jnp.nan)),
    )
    np.testing.assert_array_equal(compute_residuals(with_nan), scene_residuals)


def test_an_infinite_sigma_switches_a_kind_off(scene, scene_residuals):
    sigmas = dataclasses.replace(scene.sigmas, ankle=jnp.full_like(scene.sigmas.ankle, jnp.inf))
    without = eqx.tree_at(lambda scene: scene.sigmas, scene, sigmas)
    without_ankle = compute_residuals(without)
    count = scene.reference.ankle.pos.size
    assert not without_ankle[:count].any() and without_ankle.size == scene_residuals.size
    np.testing.assert_array_equal(without_ankle[count:], scene_residuals[count:])


def test_an_absent_leg_has_zero_residuals(scene):
    present = jnp.array([True, False])
    one_legged = eqx.tree_at(lambda scene: scene.rig.present, scene, present)
    ankles = compute_residuals(one_legged)[: scene.reference.ankle.pos.size].reshape(-1, 2, 3)
    assert ankles[:, 0].any() and not ankles[:, 1].any()


def test_several_clips_follow_one_another(scene, scene_residuals):
    """Other clips change nothing: neither the first residuals of a clip nor its accelerations."""
    motion = (scene.frames, scene.pelvis, scene.reference)
    start = jax.tree.map(lambda x: x[:12], motion)
    frames, pelvis, reference = start
    short = dataclasses.replace(scene, frames=frames, pelvis=pelvis, reference=reference)
    parts = [short, scene]
    sigmas = dataclasses.replace(scene.sigmas, ankle=jnp.asarray(0.05), smooth=jnp.asarray(3.0))
    parts[0] = dataclasses.replace(parts[0], sigmas=sigmas)
    assert np.isfinite(scene.sigmas.smooth)
    shared = tuple(share_world(parts, jaxik.presets.record().probe))
    assert all(part.place is not None for part in shared)
    ik = jaxik.presets.record()
    together = quick_jit(residuals.residuals_of_scenes)(ik, shared)
    apart = [compute_residuals(part) for part in parts]
    np.testing.assert_allclose(together, np.concatenate(apart), atol=1e-6)
    assert apart[1].size == scene_residuals.size


def test_whitening_recovers_the_innovations_of_autoregressive_noise():
    rng, rho = np.random.default_rng(0), 0.9
    innovations = rng.normal(size=(20_000, 2))
    noise = np.empty_like(innovations)
    noise[0] = innovations[0]
    for t in range(1, len(innovations)):
        noise[t] = rho * noise[t - 1] + np.sqrt(1 - rho**2) * innovations[t]
    assert np.corrcoef(noise[1:, 0], noise[:-1, 0])[0, 1] == pytest.approx(rho, abs=0.01)
    observed = jnp.ones(len(innovations), bool)
    whitened = residuals.whitened(jnp.asarray(noise), observed, jnp.asarray(rho))
    np.testing.assert_allclose(whitened, innovations, rtol=0, atol=1e-12)


def test_whitening_starts_again_after_a_gap():
    observed = jnp.array([True, True, False, True, True, True])
    whitened = residuals.whitened(jnp.arange(1.0, 7.0), observed, jnp.asarray(0.6))
    np.testing.assert_allclose(whitened, [1.0, 1.75, 0.0, 4.0, 3.25, 3.75])


def test_the_rotation_between_two_quaternions_does_not_depend_on_their_signs():
    a = Rotation.from_rotvec([0.3, -0.2, 0.9])
    step = np.array([0.02, -0.01, 0.03])
    b = a * Rotation.from_rotvec(step)
    start, end = (jnp.asarray(rot.as_quat(scalar_first=True)) for rot in (a, b))
    for sign in (1.0, -1.0):
        np.testing.assert_allclose(residuals.rotation_between(start, sign * end), step, atol=1e-5)


@jax.jit
def residuals_and_jacobian(problem, u):
    return problem.residuals_and_jacobian(u)


@quick_jit
def residuals_at(problem, points):
    return jax.vmap(problem.residuals)(points)


@pytest.fixture(scope="module")
def jacobian(embedded, truth) -> np.ndarray:
    """The Jacobian beside the truth."""
    return np.asarray(residuals_and_jacobian(embedded, truth + BESIDE)[1])


@pytest.fixture(scope="module")
def around(embedded, truth) -> np.ndarray:
    """Residuals at the truth, then a step ahead of and behind the point beside it, by column."""
    moves = STEP * jnp.eye(truth.size)
    beside = truth + BESIDE
    return np.asarray(
        residuals_at(embedded, jnp.stack([truth, *(beside + moves), *(beside - moves)]))
    )


def test_at_the_truth_residuals_are_one_standard_deviation(embedded, around):
    at_truth = around[0, : -embedded.space.size]
    active = at_truth[at_truth != 0.0]
    assert active.size > 8_000
    assert np.mean(active**2) == pytest.approx(1.0, rel=0.05)
    assert abs(np.mean(active)) < 0.05


def test_the_jacobian_agrees_with_finite_differences_column_by_column(embedded, jacobian, around):
    space = embedded.space
    ahead, behind = around[1:].reshape(2, space.size, -1)
    above_prior = 0
    for i, (name, smooth) in enumerate(zip(space.names, space.smooth, strict=True)):
        if smooth:
            expected = (ahead[i] - behind[i]) / (2 * STEP)
            scale = np.abs(expected).max()
            atol = TOLERANCE * max(1.0, scale)
            np.testing.assert_allclose(jacobian[:, i], expected, rtol=0, atol=atol, err_msg=name)
            above_prior += scale > 1.0
    assert above_prior >= 0.8 * sum(space.smooth), "the clip outweighs the prior in most columns"


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
        shifted = np.asarray(residuals_and_jacobian(again, truth)[1])
        assert not compiled
        assert np.isfinite(shifted).all() and np.abs(shifted - jacobian).max() > 1.0
        jax.jit(lambda x: x + 2)(1.0)  # the listener does hear a compilation
        assert compiled
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
