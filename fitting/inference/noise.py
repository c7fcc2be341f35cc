"""The noise that a problem assumes, as plain numbers, and the likeliest one at a point.

Errors of a kind are a first-order autoregression of stationary standard deviation sigma, so that
the innovations `(e_t - rho e_{t-1}) / sqrt(1 - rho²)` are independent with the same sigma. Their
density is that of the loss: normal, Student's t, or the one whose logarithm a robust loss is.

Sigmas that a posterior leaves open are integrated out while sampling. With normal residuals the
integral is known, so that the sampler needs no dimension for it; given the parameters, the square
is a scaled inverse chi-square (Gelman et al., Bayesian Data Analysis, 3rd edition, 3.2), from which
it is drawn exactly.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy import integrate, optimize, special

import jaxik
from fitting.problem.capture_system import system_and_scenes
from fitting.problem.problem import Loss, Problem, rho, slope_of_rho
from fitting.problem.residuals import errors_by_kind
from fitting.problem.scene import LEAST_SIGMAS, MEASURED, WHITENED, Scene
from fitting.problem.shared_world import run_scenes
from fitting.problem.space import Vector
from fitting.runtime import activity
from fitting.runtime.declarations import Table, key
from fitting.runtime.json_files import FORMERLY
from fitting.runtime.precision import in_float64
from fitting.runtime.program_cache import cached
from jaxik import lanes

from .optimise.search import cost_before, refine
from .optimise.solution import DEFAULTS, SearchSettings, Solution

Sigmas = Literal["given", "estimated"]
Correlation = Literal["given", "whitened", "counted"]

MAX_CORRELATION = 0.999
TAIL_RANGE = (1.5, 100.0)  # degrees of freedom; from 100 on, Student's t is nearly normal
ITERATIONS = 100  # of the reweighting, at most
TOLERANCE = 1e-8  # relative change of a variance that ends it

STEP = 1e-4  # sigmas, for the slope of a residual's influence by differences
LEAST_SLOPE = 0.05  # on average; under Cauchy's loss that of far outliers is negative

FARTHEST = 20.0  # inverse hyperbolic sine of the residual, in sigmas, at which the tails end
POINTS = 8001

DRAWS = 1024  # of each sigma, at most
BATCH = 64  # of them at a time

MAX_ROUNDS = 20
JOINT_TOLERANCE = (
    1e-3  # relative change of the noise that ends the rounds; sampling moves it by 1e-2
)


@dataclasses.dataclass(frozen=True)
class NoiseOptions(Table):
    """Which properties of the noise are estimated from the residuals, kind by kind.

    By default the best point is where the residuals in units of the given sigmas are smallest, and
    estimates only decide how wide intervals are. Estimated sigmas and whitened residuals move the
    best point: right if the residuals are noise, and wrong for motion that the system cannot
    follow, which then counts as noise. The tails of the loss `student` are estimated together with
    the sigmas.

    Raises:
        ValueError: for an unknown word.
    """

    sigmas: Sigmas = key(
        "given",
        "Whether the standard deviations are as [sigmas] says, or are estimated from there on,"
        " which moves the best point: right where a system can follow all but the noise.",
    )
    correlation: Correlation = key(
        "counted",
        "Whether intervals are as wide as size and correlation of the residuals say (counted), or"
        " as [sigmas] says (given); or the correlation is taken out of the residuals (whitened),"
        " which moves the best point: right where a system can follow all but the noise.",
    )

    @property
    def moves_optimum(self) -> bool:
        """Whether the estimates decide where the best point is."""
        return self.sigmas == "estimated" or self.correlation == "whitened"

    @property
    def estimates_any(self) -> bool:
        """Whether anything is estimated."""
        return self.moves_optimum or self.correlation == "counted"


class Errors(NamedTuple):
    """Errors of one kind in one clip."""

    values: Float[np.ndarray, "frames columns"]
    """m, rad, ..."""
    active: Bool[np.ndarray, "frames columns"]
    """Which of them count."""


class Estimate(NamedTuple):
    """The likeliest noise of one kind."""

    sigma: float
    correlation: float
    log_likelihood: float
    """Up to a constant."""


def likeliest(
    clips: Sequence[Errors], loss: Loss, tails: float, correlation: float | None
) -> Estimate:
    """Sigma and correlation of the errors of one kind in all clips, of which one counts at least.

    `correlation` is None to estimate it, too.
    """

    def at(rho: float) -> Estimate:
        values = np.concatenate([innovations(errors, rho) for errors in clips])
        sigma = scale(values, loss, tails)
        following = sum(int(_follows(errors).sum()) for errors in clips)
        density = log_density(values / max(sigma, 1e-300), loss, tails).sum()
        density -= values.size * math.log(max(sigma, 1e-300))
        return Estimate(sigma, rho, float(density) - 0.5 * following * math.log(1 - rho**2))

    if correlation is not None:
        return at(correlation)
    optimum = optimize.minimize_scalar(
        lambda rho: -at(float(rho)).log_likelihood,
        bounds=(-MAX_CORRELATION, MAX_CORRELATION),
        method="bounded",
        options={"xatol": 1e-6},
    )
    return at(float(optimum.x))  # pyright: ignore[reportAttributeAccessIssue]


def likeliest_tails(values: Float[np.ndarray, " values"]) -> float:
    """Degrees of freedom of Student's t for independent values in units of their sigma."""
    optimum = optimize.minimize_scalar(
        lambda log_nu: -log_density(values, "student", math.exp(log_nu)).sum(),
        bounds=[math.log(nu) for nu in TAIL_RANGE],
        method="bounded",
    )
    return math.exp(float(optimum.x))  # pyright: ignore[reportAttributeAccessIssue]


def information_of_slopes(loss: Loss, tails: float) -> float:
    """The information in a residual over its squared slope after the loss.

    1 for squares. Student's residual has the Fisher information `(nu + 1) / (nu + 3)` (Lange,
    Little and Taylor 1989), while the mean squared slope of its transformed one is larger. Losses
    that are not a distribution count as 1.
    """
    if loss != "student":
        return 1.0

    def squared_slope(residual: float) -> float:
        transformed = (tails + 1) * math.log1p(residual**2 / tails)
        slope = (tails + 1) * residual / (tails + residual**2)
        density = math.exp(log_density(np.array(residual), loss, tails))
        return 2 * density * slope**2 / transformed if transformed > 0 else 0.0

    mean, _ = integrate.quad(squared_slope, 0.0, np.inf)
    return (tails + 1) / (tails + 3) / mean


def innovations(errors: Errors, correlation: float) -> Float[np.ndarray, " values"]:
    """The part of the errors that count that the previous frame does not predict, in their unit."""
    return whitened(errors, correlation).values[errors.active]


def whitened(errors: Errors, correlation: float) -> Errors:
    """Errors less their prediction by the previous frame, where there is one that counts."""
    values, follows = errors.values, _follows(errors)
    previous = np.concatenate([np.zeros_like(values[:1]), values[:-1]])
    innovation = (values - correlation * previous) / math.sqrt(1 - correlation**2)
    return errors._replace(values=np.where(follows, innovation, values))


def scale(values: Float[np.ndarray, " values"], loss: Loss, tails: float) -> float:
    """The likeliest sigma of independent values: `sigma² = mean(weight * value²)`.

    Iteratively reweighted; a weight is the slope of the loss at the value in sigmas.
    """
    variance = float(np.mean(values**2))
    for _ in range(ITERATIONS if loss != "squares" else 0):
        if not variance > 0:
            break
        before, squares = variance, values**2
        weights = slope_of_rho(squares / variance, loss, tails)
        variance = float(np.mean(weights * squares))
        if abs(variance - before) <= TOLERANCE * before:
            break
    return math.sqrt(variance)


def log_density(
    residuals: Float[np.ndarray, "*values"], loss: Loss, tails: float
) -> Float[np.ndarray, "*values"]:
    """Log-density of residuals in sigmas; up to a constant, except for Student's t."""
    constant = 0.0
    if loss == "student":
        constant = special.gammaln((tails + 1) / 2) - special.gammaln(tails / 2)
        constant -= 0.5 * math.log(math.pi * tails)
    return np.asarray(constant - 0.5 * rho(residuals**2, loss, tails))


def _follows(errors: Errors) -> Bool[np.ndarray, "frames columns"]:
    """Which errors count and have one before them that counts."""
    active = errors.active
    return np.concatenate([np.zeros_like(active[:1]), active[1:] & active[:-1]])


class NoiseCollapse(ValueError):
    """Estimated noise has shrunk to less than any capture has."""


@dataclasses.dataclass(frozen=True)
class NoiseModel:
    """The noise of each kind of residual that measures something."""

    sigmas: Mapping[str, float]
    """m, rad, ...; of the kinds that are not left out."""
    correlations: Mapping[str, float]
    """From one frame to the next."""
    tails: float
    """Degrees of freedom of Student's t, under the loss `student`."""
    weight: float = dataclasses.field(metadata={FORMERLY: "independent_fraction"})
    """Of the log-likelihood, for intervals and posterior."""

    def __post_init__(self) -> None:
        numbers = [*self.sigmas.values(), self.tails, self.weight]
        unknown = {*self.sigmas, *self.correlations} - set(MEASURED)
        if unknown or not all(0 < number < math.inf for number in numbers):
            raise ValueError(f"{self}; wanted positive numbers, for kinds of {list(MEASURED)}")
        if not all(-1 < correlation < 1 for correlation in self.correlations.values()):
            raise ValueError(f"{self}; wanted correlations between -1 and 1")

    def change_from(self, other: "NoiseModel") -> float:
        """The largest change: relative for sigmas, over 1 less its square for a correlation."""
        changes = [abs(math.log(self.sigmas[kind] / other.sigmas[kind])) for kind in self.sigmas]
        changes += [
            abs(rho - other.correlations[kind]) / (1 - rho**2)
            for kind, rho in self.correlations.items()
        ]
        changes.append(abs(1 / self.tails - 1 / other.tails))
        return max(changes)


def noise_of(problem: Problem[jaxik.FootIK]) -> NoiseModel:
    """The noise that a problem assumes."""
    sigmas = problem.data[0].sigmas
    kinds = [kind for kind in MEASURED if np.isfinite(getattr(sigmas, kind))]
    return NoiseModel(
        sigmas={kind: float(getattr(sigmas, kind)) for kind in kinds},
        correlations={kind: float(sigmas.correlation_of(kind)) for kind in kinds},
        tails=float(problem.tails),
        weight=float(problem.weight),
    )


@in_float64
def with_noise(problem: Problem[jaxik.FootIK], noise: NoiseModel) -> Problem[jaxik.FootIK]:
    """The problem with this noise; kinds that it does not name keep theirs. Nothing recompiles."""
    scenes = tuple(_with_noise(scene, noise) for scene in problem.data)
    numbers = (jnp.asarray(noise.weight), jnp.asarray(noise.tails))
    return eqx.tree_at(lambda p: (p.data, p.weight, p.tails), problem, (scenes, *numbers))


def _with_noise(scene: Scene, noise: NoiseModel) -> Scene:
    sigmas = scene.sigmas
    correlations = {kind: float(sigmas.correlation_of(kind)) for kind in WHITENED}
    correlations |= noise.correlations
    correlation = np.array([correlations[kind] for kind in WHITENED])
    changed = {kind: jax.device_put(np.float64(sigma)) for kind, sigma in noise.sigmas.items()}
    sigmas = dataclasses.replace(sigmas, **changed, correlation=jax.device_put(correlation))
    return dataclasses.replace(scene, sigmas=sigmas)


@in_float64
def likeliest_noise(problem: Problem[jaxik.FootIK], u: Vector, options: NoiseOptions) -> NoiseModel:
    """The noise that makes the errors at `u` likeliest; properties not estimated stay.

    Raises:
        NoiseCollapse: the likeliest sigma of a kind is less than any capture has.
    """
    model, by_clip = noise_of(problem), _errors_of_clips(problem, u)
    tails = float(problem.tails)
    estimates = {
        kind: likeliest(
            [errors[kind] for errors in by_clip],
            problem.loss,
            tails,
            None if options.correlation == "whitened" else correlation,
        )
        for kind, correlation in model.correlations.items()
        if any(errors[kind].active.any() for errors in by_clip)
    }
    if options.sigmas == "estimated":
        sigmas = {kind: estimate.sigma for kind, estimate in estimates.items()}
        _check_noise(sigmas)
        model = dataclasses.replace(model, sigmas={**model.sigmas, **sigmas})
    if options.correlation == "whitened":
        correlations = {kind: estimate.correlation for kind, estimate in estimates.items()}
        model = dataclasses.replace(model, correlations={**model.correlations, **correlations})
    if problem.loss == "student" and options.sigmas == "estimated":
        values = [
            innovations(errors[kind], model.correlations[kind]) / model.sigmas[kind]
            for errors in by_clip
            for kind in model.sigmas
        ]
        tails = likeliest_tails(np.concatenate(values))
        model = dataclasses.replace(model, tails=tails)
    return model


def _check_noise(sigmas: Mapping[str, float]) -> None:
    """Raises NoiseCollapse for a sigma that no capture has."""
    for kind, sigma in sigmas.items():
        if sigma < (least := LEAST_SIGMAS[kind]):
            raise NoiseCollapse(
                f"the noise of {kind} has collapsed: its likeliest sigma is {sigma:.2g}, and no "
                f"capture is known to less than {least:g} (m, rad); motion that the system cannot "
                'follow passed for correlated noise, or nothing is left: set sigmas = "given" and '
                'correlation = "counted" in [noise]'
            )


@in_float64
def measured(problem: Problem[jaxik.FootIK], u: Vector) -> Problem[jaxik.FootIK]:
    """The problem with the noise of its residuals at `u`, from which replicates are predicted."""
    noise, by_clip = noise_of(problem), _errors_of_clips(problem, u)
    estimates = {
        kind: likeliest([e[kind] for e in by_clip], problem.loss, noise.tails, None)
        for kind in noise.sigmas
        if any(errors[kind].active.any() for errors in by_clip)
    }
    sigmas = {kind: max(own.sigma, LEAST_SIGMAS[kind]) for kind, own in estimates.items()}
    correlations = {kind: estimate.correlation for kind, estimate in estimates.items()}
    residual_noise = NoiseModel(
        {**noise.sigmas, **sigmas}, {**noise.correlations, **correlations}, noise.tails, weight=1.0
    )
    return with_noise(problem, residual_noise)


@in_float64
def counted(
    problem: Problem[jaxik.FootIK], u: Vector, errors: Sequence[Mapping[str, Any]] | None = None
) -> Problem[jaxik.FootIK]:
    """The problem at its solution with the weight of `likelihood_weight`."""
    weight = likelihood_weight(problem, u, errors)
    return with_noise(problem, dataclasses.replace(noise_of(problem), weight=weight))


@in_float64
def likelihood_weight(
    problem: Problem[jaxik.FootIK], u: Vector, errors: Sequence[Mapping[str, Any]] | None = None
) -> float:
    """Weight of the log-likelihood at which intervals are as wide as the residuals say.

    Of kinds of residuals, each a first-order autoregression, the variance of the score over the
    curvature, both summed (Pauli, Racugno and Ventura 2011): `(1 + rho) / (1 - rho)` frames are
    worth one, and residuals of twice their sigma a quarter. No residual counts as smaller than the
    least sigma that a capture has. The errors at `u`, by kind, clip by clip, may be known already.
    """
    noise = noise_of(problem)
    if errors is None:
        by_clip = _errors_of_clips(problem, u)
    else:
        by_clip = [_counted(*pair) for pair in zip(problem.data, errors, strict=True)]
    curvature = variance = 0.0
    for kind, sigma in noise.sigmas.items():
        for of_clip in by_clip:
            in_sigmas = of_clip[kind]._replace(values=of_clip[kind].values / sigma)
            residuals = whitened(in_sigmas, noise.correlations[kind])
            scores = residuals._replace(values=_influence(problem, residuals.values))
            if not scores.active.any():
                continue
            values, count = residuals.values[scores.active], int(scores.active.sum())
            steps = _influence(problem, values + STEP) - _influence(problem, values - STEP)
            curvature += count * max(float(steps.mean()) / (2 * STEP), LEAST_SLOPE)
            # Not of the scores, which a robust loss makes less like an autoregression.
            rho = likeliest([residuals], problem.loss, noise.tails, None).correlation
            frames = min((1 + rho) / (1 - rho), len(scores.values))
            squares = max(
                float(np.mean(scores.values[scores.active] ** 2)), (LEAST_SIGMAS[kind] / sigma) ** 2
            )
            variance += count * squares * frames
    return curvature / variance if variance else 1.0


def _influence(problem: Problem[jaxik.FootIK], residuals: np.ndarray) -> np.ndarray:
    """Derivative of half the loss by a residual, both in sigmas."""
    return residuals * slope_of_rho(residuals**2, problem.loss, float(problem.tails))


def _errors_of_clips(problem: Problem[jaxik.FootIK], u: Vector) -> list[dict[str, Errors]]:
    ik, scenes = system_and_scenes(problem, jnp.asarray(u))
    pairs = zip(scenes, _errors_by_kind(ik, scenes), strict=True)
    return [_counted(scene, values) for scene, values in pairs]


def _counted(scene: Scene, by_kind: Mapping[str, Array]) -> dict[str, Errors]:
    """Errors of each measured kind in one clip, and which of them count."""
    errors = {}
    for kind, values in by_kind.items():
        array = np.asarray(values, np.float64)
        active = np.asarray(scene.counts(kind))
        counts = np.repeat(active, array[0].size // active.shape[1], axis=1)
        errors[kind] = Errors(np.where(counts, array.reshape(counts.shape), 0.0), counts)
    return errors


@cached
def _errors_by_kind(ik: jaxik.FootIK, scenes: tuple[Scene, ...]) -> list[dict[str, Array]]:
    """Errors of each measured kind, clip by clip."""
    pairs = zip(scenes, run_scenes(ik, scenes), strict=True)
    by_clip = (errors_by_kind(scene, result) for scene, result in pairs)
    return [{kind: errors[kind] for kind in MEASURED} for errors in by_clip]


@dataclasses.dataclass(frozen=True)
class NoiseDensity:
    """The distribution of one independent residual, in sigmas."""

    loss: Loss
    tails: float
    """Degrees of freedom of Student's t, under this loss."""

    @cached_property
    def _cumulative(self) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
        """Integrals of the unnormalised density up to the hyperbolic sines of the second array.

        These are fine in the middle and coarse in the tails.
        """
        t = np.linspace(-FARTHEST, FARTHEST, POINTS)
        density = np.exp(log_density(np.sinh(t), self.loss, self.tails)) * np.cosh(t)
        steps = 0.5 * (density[1:] + density[:-1]) * np.diff(t)
        return np.concatenate([[0.0], np.cumsum(steps)]), t

    def log_density(self, residuals: Float[np.ndarray, "*values"]) -> Float[np.ndarray, "*values"]:
        """Log-density of residuals in sigmas, constants included."""
        return log_density(residuals, self.loss, self.tails) - np.log(self._cumulative[0][-1])

    def draw(
        self, random: np.random.Generator, shape: tuple[int, ...]
    ) -> Float[np.ndarray, "*values"]:
        """Independent residuals, in sigmas."""
        if self.loss == "squares":
            return random.normal(size=shape)
        integrals, t = self._cumulative
        return np.sinh(np.interp(integrals[-1] * random.random(shape), integrals, t))


@in_float64
def with_unknown_sigmas(problem: Problem[jaxik.FootIK]) -> Problem[jaxik.FootIK]:
    """The problem with the sigmas of all measured kinds left open; its loss must be squares.

    Raises:
        ValueError: for another loss.
    """
    if problem.loss != "squares":
        raise ValueError(f"loss is {problem.loss!r}; only with squares can sigmas be left open")
    kinds = list(noise_of(problem).sigmas)
    rows = [[_of_kind(scene, kind, kinds) for scene in problem.data] for kind in kinds]
    unknown = np.stack([np.concatenate(row) for row in rows])
    return dataclasses.replace(problem, unknown_sigmas=jnp.asarray(unknown))


def _of_kind(scene: Scene, kind: str, kinds: list[str]) -> Float[np.ndarray, " residuals"]:
    """1 at the active residuals of a kind, 0 at others; ordered as by `residuals_of_scene`."""
    frames, legs = len(scene.frames.dt), len(scene.rig.side)
    each = {name: np.zeros(frames * size) for name, size in _sizes(legs).items()}
    each["smooth"] = np.zeros((frames - 2) * legs * 3)
    if kind in kinds:
        each[kind] = np.repeat(np.asarray(scene.counts(kind), float), 3, axis=1).ravel()
    return np.concatenate([each[name] for name in (*WHITENED, "smooth")])


def _sizes(legs: int) -> dict[str, int]:
    """Residuals of each whitened kind in a frame."""
    return {"ankle": 3 * legs, "knee": 3 * legs, "pelvis": 3, "foot": 3 * legs, "body": 3} | {
        "contact": legs
    }


@in_float64
def draw_sigmas(
    problem: Problem[jaxik.FootIK], u: Float[np.ndarray, "steps walkers free"], seed: int
) -> dict[str, Float[np.ndarray, " draws"]]:
    """Draws of the open sigmas of a problem, by kind, one for each of the samples `thinned(u)`."""
    assert problem.unknown_sigmas is not None
    random = np.random.default_rng(seed)
    chosen = thinned(u)
    filled = np.resize(chosen, (-(-len(chosen) // BATCH) * BATCH, chosen.shape[1]))
    batches = jnp.asarray(filled, problem.space.start.dtype).reshape(-1, BATCH, chosen.shape[1])
    sums = np.concatenate([_sums(problem, batch) for batch in batches])[: len(chosen)]
    counts = float(problem.weight) * np.asarray(problem.unknown_sigmas).sum(axis=1)
    ratios = np.sqrt(sums / random.chisquare(counts, sums.shape))
    sigmas = noise_of(problem).sigmas
    return {kind: sigma * ratios[:, i] for i, (kind, sigma) in enumerate(sigmas.items())}


def thinned(u: Float[np.ndarray, "steps walkers free"]) -> Float[np.ndarray, "draws free"]:
    """Up to `DRAWS` samples, spread over the chain; each has its draw of the sigmas."""
    flat = u.reshape(-1, u.shape[-1])
    return flat[np.unique(np.linspace(0, len(flat) - 1, DRAWS).astype(int))]


@cached
def _sums(problem: Problem, u: Float[Array, "batch free"]) -> Float[Array, "batch sigmas"]:
    """Squares of the residuals of each open sigma, in units of the one assumed."""
    residuals = lanes(problem.residuals)(u)[:, : -problem.space.size]
    assert problem.unknown_sigmas is not None
    return residuals**2 @ problem.unknown_sigmas.T


def fit_with_noise(
    problem: Problem[jaxik.FootIK],
    options: NoiseOptions,
    solution: Solution,
    settings: SearchSettings = DEFAULTS,
) -> tuple[Problem[jaxik.FootIK], Solution]:
    """The best fit with the noise that is likeliest there, and the problem with this noise.

    In turn, the noise is found for the parameters and the parameters for the noise: each raises
    the joint likelihood, which all of it together maximises where neither moves any more. The
    solution's history and effort are those of all rounds; its cost before the fit is with the
    noise of the last.

    Args:
        problem: with the noise to begin with.
        options: which properties are estimated; without any the solution stays as it is.
        solution: of the problem.
        settings: of the descents.
    """
    if not options.moves_optimum:
        return problem, solution
    for _ in range(MAX_ROUNDS):
        if solution.interrupted:
            break
        with activity.announced("Estimating the noise"):
            noise = likeliest_noise(problem, solution.u, options)
        if noise.change_from(noise_of(problem)) < JOINT_TOLERANCE:
            break
        problem = with_noise(problem, noise)
        solution = refine(problem, solution, solution.u, settings)
        solution = dataclasses.replace(solution, cost_before=cost_before(problem))
    return problem, solution
