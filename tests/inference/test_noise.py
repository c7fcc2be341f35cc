"""Noise that is estimated with the parameters: against SciPy's optima, and against simulation."""

import dataclasses
import functools
import math
from typing import Any, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, linalg, optimize, stats

import fitting
import jaxik
from fitting.experiment import problems
from fitting.experiment.experiment import Experiment
from fitting.experiment.experiment_files import load_experiment
from fitting.inference import noise
from fitting.inference import noise as inference_noise
from fitting.inference.identifiability import assess_identifiability
from fitting.inference.noise import NoiseDensity, NoiseModel, NoiseOptions, noise_of, with_noise
from fitting.problem.problem import CAUCHY, HUBER, Loss, Problem, apply_loss
from fitting.problem.residuals import residuals_by_kind
from fitting.problem.scene import LEAST_SIGMAS, Scene
from fitting.problem.simulation import autoregression
from fitting.studies.fit import assess, run_folder
from fitting.studies.fit.assess import search_with_noise
from support.experiments import ROOT

BOTH = NoiseOptions("estimated", "whitened")
OZZ = ROOT / "data" / "experiments" / "ozz.toml"
KINDS = ("ankle", "knee", "pelvis", "foot", "body")


# The density that a loss stands for

DENSITIES: dict[Loss, Any] = {
    "squares": stats.norm(),
    "student": stats.t(3.5),
    # exp(-c²/2 log(1 + r²/c²)) is a t distribution with c² - 1 degrees of freedom.
    "cauchy": stats.t(CAUCHY**2 - 1, scale=CAUCHY / np.sqrt(CAUCHY**2 - 1)),
}


@pytest.mark.parametrize("loss", get_args(Loss))
def test_the_log_density_is_that_of_a_known_distribution_and_draws_have_it(loss):
    density = NoiseDensity(loss, 3.5)
    r = np.array([-30.0, -2.0, 0.0, 0.7, 4.0, 100.0])
    if loss in DENSITIES:
        expected = DENSITIES[loss].logpdf(r)
        np.testing.assert_allclose(density.log_density(r), expected, atol=1e-4)
    draws = density.draw(np.random.default_rng(0), (4000, 5)).ravel()
    for end in (-1.5, 0.4, 3.0, np.inf):
        below = integrate.quad(lambda r: np.exp(density.log_density(np.array(r))), -np.inf, end)[0]
        assert np.mean(draws < end) == pytest.approx(below, abs=4 * 0.5 / draws.size**0.5)
    assert below == pytest.approx(1.0, abs=1e-4)


# The errors of one kind


def test_sigma_and_correlation_are_those_of_the_exact_likelihood_unless_one_is_given():
    """Of multivariate normal runs, whose covariance is `sigma² rho^|i - j|`, with a gap."""
    random = np.random.default_rng(0)
    values = 0.3 * autoregression(random.normal(size=(120, 2)), 0.8)
    active = np.ones((120, 2), bool)
    active[40:50] = False
    errors = noise.Errors(np.where(active, values, 0.0), active)
    runs = [part for column in errors.values.T for part in (column[:40], column[50:])]

    def minus_log_likelihood(x: np.ndarray) -> float:
        sigma, rho = math.exp(x[0]), math.tanh(x[1])
        total = 0.0
        for run in runs:
            covariance = sigma**2 * linalg.toeplitz(rho ** np.arange(len(run)))
            joint = stats.multivariate_normal(cov=covariance)  # type: ignore[arg-type]
            total -= joint.logpdf(run)
        return total

    best = optimize.minimize(minus_log_likelihood, [0.0, 0.0], method="Nelder-Mead").x
    found = noise.likeliest([errors], "squares", 4.0, None)
    assert found.sigma == pytest.approx(math.exp(best[0]), rel=1e-3)
    assert found.correlation == pytest.approx(math.tanh(best[1]), abs=1e-3)
    given = noise.likeliest([errors], "squares", 4.0, 0.5)
    values = noise.innovations(errors, 0.5)
    assert given.correlation == 0.5 and values.size == errors.active.sum()
    assert given.sigma == pytest.approx(np.sqrt(np.mean(values**2)))


def test_scale_and_tails_are_those_of_scipys_t():
    for nu in (2.5, 6.0):
        values = 0.2 * np.asarray(stats.t.rvs(nu, size=4000, random_state=1))
        tails, sigma = 4.0, 1.0
        for _ in range(60):
            sigma = noise.scale(values, "student", tails)
            tails = noise.likeliest_tails(values / sigma)
        expected = stats.t.fit(values, floc=0)
        assert tails == pytest.approx(expected[0], rel=0.01)
        assert sigma == pytest.approx(expected[2], rel=0.01)


def test_students_slopes_tell_less_than_they_say():
    """Against draws: the score's square, over the slope's of the transformed residual."""
    slopes = jax.jit(
        jax.vmap(jax.grad(lambda r, nu: apply_loss(r[None], "student", nu)[0]), (0, None))
    )
    for nu in (2.0, 5.0):
        draws = stats.t.rvs(nu, size=200_000, random_state=2)
        score = (nu + 1) * draws / (nu + draws**2)
        ratio = np.mean(score**2) / np.mean(np.asarray(slopes(jnp.asarray(draws), nu)) ** 2)
        assert noise.information_of_slopes("student", nu) == pytest.approx(ratio, rel=0.01)
    assert noise.information_of_slopes("squares", 2.0) == 1.0


# A problem without a pipeline: two parameters shift the errors of each frame

FootProblem = Problem[jaxik.FootIK]


def errors_by_kind(ik: Any, scenes: tuple[Scene, ...]) -> list[dict[str, jax.Array]]:
    """What the parameters add to the noise, which is in the place of the tracks."""
    (scene,) = scenes
    time = jnp.arange(scene.reference.observed.size, dtype=ik.foot.weight.dtype) / 20
    shift = ik.target.foot_height * jnp.sin(time) + 0.1 * ik.foot.weight * jnp.cos(2 * time)
    tracks = scene.tracks.items()
    return [{kind: x + shift.reshape(-1, *[1] * (x.ndim - 1)) for kind, x in tracks}]


def residuals(ik: jaxik.FootIK, scenes: tuple[Scene, ...]) -> jax.Array:
    (errors,), (scene,) = errors_by_kind(ik, scenes), scenes
    contact, smooth = jnp.zeros_like(scene.reference.contact), jnp.zeros_like(errors["ankle"][2:])
    by_kind = residuals_by_kind(scene, errors | {"contact": contact, "smooth": smooth})
    return jnp.concatenate([of_kind.ravel() for of_kind in by_kind.values()])


def simulated(
    problem: FootProblem, u: np.ndarray | jax.Array, rho: float, seed: int, outliers: float = 0.0
) -> FootProblem:
    """Whose errors at `u` are the noise, correlated, this fraction of it ten sigmas off."""
    random = np.random.default_rng(seed)
    (scene,), sigmas = problem.data, noise_of(problem).sigmas
    noise = {}
    for kind in KINDS:
        legs = () if kind in ("pelvis", "body") else (2,)
        shape = (scene.reference.observed.size, *legs, 3)
        far = 10 * random.normal(size=shape) * (random.random(shape) < outliers)
        errors = autoregression(random.normal(size=shape), rho) + far
        noise[kind] = jnp.asarray(sigmas[kind] * errors)
    scene = dataclasses.replace(scene, tracks=noise)
    (found,) = errors_by_kind(problem.space.unpack(jnp.asarray(u)), (scene,))
    tracks = {kind: 2 * noise[kind] - found[kind] for kind in KINDS}
    return dataclasses.replace(problem, data=(dataclasses.replace(scene, tracks=tracks),))


def walk(options: NoiseOptions, loss: str = "squares") -> tuple[Experiment, FootProblem]:
    """Six seconds of the walk of `ozz`, with two free parameters."""
    experiment = load_experiment(OZZ)
    clip = dataclasses.replace(experiment.clips[0], start=2.0, end=8.0)
    free = {name: {} for name in ("target.foot_height", "foot.weight")}
    changed = {"clips": (clip,), "free": free, "noise": options, "loss": loss}
    experiment = dataclasses.replace(experiment, **changed)
    problem = problems.make_problem(experiment)
    return experiment, dataclasses.replace(problem, residual_function=residuals)


@pytest.fixture
def no_pipeline(monkeypatch) -> None:
    """The errors are those of the problem's own residuals."""
    monkeypatch.setattr(inference_noise, "_errors_by_kind", errors_by_kind)
    monkeypatch.setattr(assess, "played_errors", lambda problem, u: None)  # as above


@pytest.fixture(scope="module")
def correlated() -> FootProblem:
    _, problem = walk(BOTH)
    return simulated(problem, problem.space.start, 0.6, seed=3)


def test_noise_is_replaced_without_a_new_program(correlated):
    noise = NoiseModel(dict.fromkeys(KINDS, 0.1), dict.fromkeys(KINDS, 0.3), 7.0, 0.5)
    changed = with_noise(correlated, noise)
    assert noise_of(changed) == noise
    before, after = (
        jax.tree.map(jax.typeof, eqx.filter(p, eqx.is_array)) for p in (correlated, changed)
    )
    assert jax.tree.structure(before) == jax.tree.structure(after)
    assert jax.tree.leaves(before) == jax.tree.leaves(after)
    assert changed.data[0].sigmas.contact == correlated.data[0].sigmas.contact


@pytest.mark.slow
def test_the_fit_with_noise_is_the_joint_optimum(correlated, no_pipeline):
    """Against a quasi-Newton search over parameters, log-sigmas and correlations together."""
    space = correlated.space
    problem, solution = search_with_noise(correlated, walk(BOTH)[0])
    found = noise_of(problem)
    before = float(problem.cost(space.pack({})))  # with the noise that was estimated
    assert solution.cost_before == pytest.approx(before) and solution.cost < before

    @jax.jit
    def errors_and_prior(u: jax.Array) -> tuple[dict[str, jax.Array], jax.Array]:
        return errors_by_kind(space.unpack(u), correlated.data)[0], space.prior_residuals(u)

    def objective(x: np.ndarray) -> float:
        sigmas, rhos = np.exp(x[2:7]), np.tanh(x[7:])
        by_kind, of_prior = errors_and_prior(jnp.asarray(x[:2]))
        errors = inference_noise._counted(correlated.data[0], by_kind)
        total = 0.5 * float(np.sum(np.asarray(of_prior) ** 2))
        for kind, sigma, rho in zip(KINDS, sigmas, rhos, strict=True):
            values = errors[kind].values
            innovations = values[1:] - rho * values[:-1]
            variance = sigma**2 * (1 - rho**2)
            total -= stats.norm.logpdf(values[0], scale=sigma).sum()
            total -= stats.norm.logpdf(innovations, scale=math.sqrt(variance)).sum()
        return total

    logs, atanhs = np.log([*found.sigmas.values()]), np.arctanh([*found.correlations.values()])
    ours = np.concatenate([solution.u, logs, atanhs])
    start = ours + np.random.default_rng(0).normal(0, 0.05, ours.size)
    best = optimize.minimize(objective, start, method="BFGS")
    assert objective(ours) < best.fun + 1e-3
    np.testing.assert_allclose(ours, best.x, atol=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rho", "outliers", "loss", "options"),
    [
        (0.95, 0.0, "squares", BOTH),
        pytest.param(0.0, 0.03, "student", NoiseOptions("estimated"), marks=pytest.mark.slow),
    ],
)
def test_intervals_with_estimated_noise_cover_the_truth(no_pipeline, rho, outliers, loss, options):
    """Of four truths and two parameters, assumed with twice their sigmas; 6 of 8 or more have a
    probability of 99.4 %."""
    experiment, problem = walk(options, loss)
    space, true = problem.space, noise_of(problem)
    assumed = {kind: 2 * sigma for kind, sigma in true.sigmas.items()}
    covered = 0
    for seed in range(4):
        draw = np.random.default_rng(seed).normal(size=space.size)
        u = space.start + 0.5 * space.prior.sd * jnp.asarray(draw)
        captured = simulated(problem, u, rho, seed, outliers)
        captured = with_noise(captured, dataclasses.replace(true, sigmas=assumed))
        fitted, solution = search_with_noise(captured, experiment)
        found = noise_of(fitted)
        if loss == "squares":
            ratios = [found.sigmas[kind] / true.sigmas[kind] for kind in KINDS]
            np.testing.assert_allclose(ratios, 1.0, atol=0.45)
            np.testing.assert_allclose(list(found.correlations.values()), rho, atol=0.05)
        else:
            assert found.tails < 10
        low, high = assess_identifiability(fitted, solution).interval.T
        values = np.asarray(space.values(u))
        covered += int(np.sum((low <= values) & (values <= high)))
    assert covered >= 6


def test_noise_that_no_capture_has_is_refused(correlated, no_pipeline):
    u = correlated.space.start
    tiny = resized(simulated(resized(correlated, 0.01), u, 0.0, seed=5), 100.0)
    message = 'ankle has collapsed: its likeliest sigma is 2e-05, .*correlation = "counted" in'
    with pytest.raises(inference_noise.NoiseCollapse, match=message):
        inference_noise.likeliest_noise(tiny, u, NoiseOptions("estimated"))
    whitened = inference_noise.likeliest_noise(tiny, u, NoiseOptions(correlation="whitened"))
    assert whitened.sigmas == noise_of(tiny).sigmas


# The weight, which counts residuals for intervals and moves no optimum

INFLUENCES: dict[Loss, Any] = {  # derivatives of half the losses
    "squares": lambda r: r,
    "huber": lambda r: np.clip(r, -HUBER, HUBER),
    "cauchy": lambda r: r / (1 + (r / CAUCHY) ** 2),
}


def resized(problem: FootProblem, factor: float) -> FootProblem:
    """The problem with its sigmas times a factor."""
    noise = noise_of(problem)
    sigmas = {kind: factor * sigma for kind, sigma in noise.sigmas.items()}
    return with_noise(problem, dataclasses.replace(noise, sigmas=sigmas))


@pytest.mark.parametrize("loss", INFLUENCES)
@pytest.mark.parametrize(("rho", "scale"), [(0.0, 1.0), (0.6, 1.0), (0.0, 2.0)])
def test_the_weight_is_the_curvature_over_the_variance_of_the_score(
    correlated, no_pipeline, loss, rho, scale
):
    """Against integrals over the normal distribution, where 4 frames of the correlated are worth 1;
    of squares the weights are 1, 1/4 and 1/4."""
    problem, u = dataclasses.replace(correlated, loss=loss), correlated.space.start
    captured = resized(simulated(resized(problem, scale), u, rho, seed=5), 1 / scale)
    r = np.linspace(-40, 40, 80_001)
    density = stats.norm.pdf(r / scale) / scale * (r[1] - r[0])
    influence = INFLUENCES[loss](r)
    expected = density @ np.gradient(influence, r) / (density @ influence**2)
    expected *= (1 - rho) / (1 + rho)
    counted = inference_noise.counted(captured, u)
    assert float(counted.weight) == pytest.approx(expected, rel=0.1)
    assert noise_of(counted).sigmas == noise_of(captured).sigmas
    assert noise_of(counted).correlations == noise_of(captured).correlations


def test_no_residual_counts_as_smaller_than_the_least_sigma(correlated, no_pipeline):
    u = correlated.space.start
    exact = resized(simulated(resized(correlated, 1e-6), u, 0.0, seed=5), 1e6)
    counts = {kind: 2.0 if kind in ("ankle", "knee", "foot") else 1.0 for kind in KINDS}
    squares = {
        kind: (LEAST_SIGMAS[kind] / sigma) ** 2 for kind, sigma in noise_of(exact).sigmas.items()
    }
    expected = sum(counts.values()) / sum(counts[kind] * squares[kind] for kind in KINDS)
    assert inference_noise.likelihood_weight(exact, u) == pytest.approx(expected, rel=0.1)


def test_a_weight_does_not_move_the_best_fit(correlated, no_pipeline):
    plain = dataclasses.replace(walk(BOTH)[0], noise=NoiseOptions())
    given = dataclasses.replace(plain, noise=NoiseOptions(correlation="given"))
    every = dataclasses.replace(plain, independent_every=0.3)
    pairs = ((correlated, given), (correlated, plain), (correlated.with_weight(0.1), every))
    fits = [search_with_noise(*pair) for pair in pairs]
    weights = [float(problem.weight) for problem, _ in fits]
    np.testing.assert_allclose(weights, [1.0, 0.4 / 1.6, 0.1], rtol=0.15)
    for _, solution in fits[1:]:
        np.testing.assert_array_equal(solution.u, fits[0][1].u)
        assert solution.cost == fits[0][1].cost


@pytest.mark.slow
def test_intervals_contain_the_truth_under_correlated_noise_of_another_size(
    correlated, no_pipeline
):
    """The region of both parameters, of 120 draws of noise twice as large as its sigma."""
    problem = dataclasses.replace(only_ankles(correlated), loss="huber")
    (scene,), truth = problem.data, problem.space.start
    (errors,) = errors_by_kind(problem.space.unpack(truth), (scene,))
    shift = errors["ankle"] - scene.tracks["ankle"]
    sigma = 2 * noise_of(problem).sigmas["ankle"]
    random, inside = np.random.default_rng(0), []

    @jax.jit
    def evaluate(u: jax.Array, ankle: jax.Array) -> tuple[jax.Array, jax.Array]:
        own = dataclasses.replace(scene, tracks={**scene.tracks, "ankle": ankle})
        of_own = dataclasses.replace(problem, data=(own,))
        return of_own.residuals(u), jax.jacfwd(of_own.residuals)(u)

    for _ in range(120):
        noise = sigma * autoregression(random.normal(size=errors["ankle"].shape), 0.6)
        ankle = jnp.asarray(noise) - shift

        @functools.cache
        def both(*u: float, ankle: jax.Array = ankle) -> list[np.ndarray]:
            return [np.asarray(part) for part in evaluate(jnp.asarray(u), ankle)]

        def at(u: Any, part: int = 0, both: Any = both) -> np.ndarray:
            return both(*np.asarray(u))[part]

        jacobian: Any = functools.partial(at, part=1)
        best = optimize.least_squares(at, truth, jac=jacobian)
        own = dataclasses.replace(scene, tracks={**scene.tracks, "ankle": ankle})
        weight = inference_noise.likelihood_weight(
            dataclasses.replace(problem, data=(own,)), best.x
        )
        rise = 0.5 * float(np.sum(at(truth) ** 2)) - best.cost
        inside.append(weight * rise <= 0.5 * stats.chi2.ppf(0.95, 2))
    assert 0.91 < np.mean(inside) < 0.985


def only_ankles(problem: FootProblem) -> FootProblem:
    (scene,) = problem.data
    off = {kind: jnp.asarray(jnp.inf) for kind in KINDS[1:]}
    scene = dataclasses.replace(scene, sigmas=dataclasses.replace(scene.sigmas, **off))
    return dataclasses.replace(problem, data=(scene,))


def test_open_sigmas_are_integrated_out(correlated):
    """Against a sum over a grid of log-sigmas, of which one is open."""
    problem = only_ankles(correlated).with_weight(0.5)
    opened = noise.with_unknown_sigmas(problem)
    assert opened.unknown_sigmas is not None and opened.unknown_sigmas.shape[0] == 1
    points = np.asarray(problem.space.start) + np.array([[0.0, 0.0], [0.2, -0.1]])
    log_sigmas = np.linspace(-4, 4, 4001)
    expected = []
    for u in points:
        residuals = np.asarray(problem.residuals(jnp.asarray(u)))
        squares, prior = np.sum(residuals[:-2] ** 2), np.sum(residuals[-2:] ** 2) / 0.5
        count = 0.5 * float(opened.unknown_sigmas.sum())
        logs = -count * log_sigmas - 0.5 * squares * np.exp(-2 * log_sigmas)
        expected.append(np.logaddexp.reduce(logs) - 0.5 * prior)
    ours = [float(opened.log_probability(jnp.asarray(u))) for u in points]
    assert ours[1] - ours[0] == pytest.approx(expected[1] - expected[0], rel=1e-6)
    with pytest.raises(ValueError, match="loss is 'student'; only with squares"):
        noise.with_unknown_sigmas(dataclasses.replace(problem, loss="student"))


def test_open_sigmas_are_drawn_around_the_residuals_own(correlated):
    opened = noise.with_unknown_sigmas(correlated)
    u = np.tile(np.asarray(correlated.space.start), (50, 30, 1))
    draws = noise.draw_sigmas(opened, u, seed=0)
    residuals = np.asarray(correlated.residuals(correlated.space.start))[:-2]
    assert tuple(draws) == KINDS
    for kind, row in zip(KINDS, np.asarray(opened.unknown_sigmas), strict=True):
        squares, count = row @ residuals**2, row.sum()
        sigma = getattr(correlated.data[0].sigmas, kind) * np.sqrt(squares / count)
        assert np.median(draws[kind]) == pytest.approx(float(sigma), rel=0.02)
        assert np.std(draws[kind]) / sigma == pytest.approx(1 / np.sqrt(2 * count), rel=0.15)


@pytest.mark.slow
def test_a_run_is_sampled_with_the_noise_that_its_fit_found(undrawn, tmp_path):
    experiment = load_experiment(OZZ)
    clip = dataclasses.replace(experiment.clips[0], start=2.0, end=3.0)
    sampled = dataclasses.replace(experiment.sample, max_steps=20, walkers=8)
    experiment = dataclasses.replace(
        experiment,
        clips=(clip,),
        free={"foot.weight": {}, "foot.twist": {}},
        loss="squares",
        noise=BOTH,
        sample=sampled,
    )
    fitted = fitting.fit(experiment, tmp_path / "run")
    first = fitting.sample(fitted)
    assert set(first.sigmas) == set(KINDS)
    _, summary = run_folder.load_fit(tmp_path / "run")
    assert NoiseModel(**summary["noise"]) == fitted.noise  # type: ignore[typeddict-item]
    continued = fitting.sample(tmp_path / "run", max_steps=30)
    assert (continued.u[:20] == first.u).all() and len(continued.u) == 30
    text = (tmp_path / "run" / run_folder.SUMMARY).read_text()
    assert "### Noise\n" in text
    assert "Sigmas of the noise, which were sampled along:" in text
