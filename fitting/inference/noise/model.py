"""The noise that a problem assumes, as plain numbers, and the likeliest one at a point."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxik
from fitting.problem.capture.system import system_and_scenes
from fitting.problem.problem import Problem
from fitting.problem.residuals import errors_by_kind
from fitting.problem.scene import LEAST_SIGMAS, MEASURED, WHITENED, Scene
from fitting.problem.shared_world import run_scenes
from fitting.problem.space import Vector
from fitting.runtime.precision import in_float64
from fitting.runtime.program_cache import cached
from fitting.runtime.storage.declared_types import FORMERLY

from . import series
from .series import Errors
from .settings import NoiseOptions

STEP = 1e-4  # sigmas, over which the slope of a residual's influence is taken
LEAST_SLOPE = 0.05  # on average; under Cauchy's loss that of far outliers is negative


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
        """The largest change: relative of a sigma, of a correlation relative to what is left."""
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
    given = {kind: float(sigmas.correlation_of(kind)) for kind in WHITENED}
    correlation = np.array([(given | dict(noise.correlations))[kind] for kind in WHITENED])
    changed = {kind: jax.device_put(np.float64(sigma)) for kind, sigma in noise.sigmas.items()}
    sigmas = dataclasses.replace(sigmas, **changed, correlation=jax.device_put(correlation))
    return dataclasses.replace(scene, sigmas=sigmas)


@in_float64
def likeliest_noise(problem: Problem[jaxik.FootIK], u: Vector, options: NoiseOptions) -> NoiseModel:
    """The noise that makes the errors at `u` likeliest; what is not estimated stays as it is.

    Raises:
        NoiseCollapse: the likeliest sigma of a kind is less than any capture has.
    """
    model, by_clip = noise_of(problem), _errors_of_clips(problem, u)
    tails = float(problem.tails)
    estimates = {
        kind: series.likeliest(
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
            series.innovations(errors[kind], model.correlations[kind]) / model.sigmas[kind]
            for errors in by_clip
            for kind in model.sigmas
        ]
        tails = series.likeliest_tails(np.concatenate(values))
        model = dataclasses.replace(model, tails=tails)
    return model


def _check_noise(sigmas: Mapping[str, float]) -> None:
    """Raises NoiseCollapse for a sigma that no capture has."""
    for kind, sigma in sigmas.items():
        if sigma < (least := LEAST_SIGMAS[kind]):
            raise NoiseCollapse(
                f"the noise of {kind} has collapsed: its likeliest sigma is {sigma:.2g}, and no "
                f"capture is known to less than {least:g} (m, rad); what the system cannot follow "
                'was taken for correlated noise, or nothing is left: take sigmas = "given" and '
                'correlation = "counted" in [noise]'
            )


@in_float64
def measured(problem: Problem[jaxik.FootIK], u: Vector) -> Problem[jaxik.FootIK]:
    """The problem with the noise that its residuals at `u` show, for what is predicted of them."""
    noise, by_clip = noise_of(problem), _errors_of_clips(problem, u)
    estimates = {
        kind: series.likeliest([e[kind] for e in by_clip], problem.loss, noise.tails, None)
        for kind in noise.sigmas
        if any(errors[kind].active.any() for errors in by_clip)
    }
    sigmas = {kind: max(own.sigma, LEAST_SIGMAS[kind]) for kind, own in estimates.items()}
    correlations = {kind: estimate.correlation for kind, estimate in estimates.items()}
    shown = NoiseModel(
        {**noise.sigmas, **sigmas}, {**noise.correlations, **correlations}, noise.tails, weight=1.0
    )
    return with_noise(problem, shown)


@in_float64
def counted(
    problem: Problem[jaxik.FootIK], u: Vector, errors: Sequence[Mapping[str, Any]] | None = None
) -> Problem[jaxik.FootIK]:
    """The problem with the weight that its residuals at `u` say; see `likelihood_weight`.

    Args:
        problem: at its solution.
        u: of the solution.
        errors: of its motion, by kind, clip by clip, where they are known already.
    """
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
    least sigma that a capture has.
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
            residuals = series.whitened(in_sigmas, noise.correlations[kind])
            scores = residuals._replace(values=_influence(problem, residuals.values))
            if not scores.active.any():
                continue
            values, count = residuals.values[scores.active], int(scores.active.sum())
            steps = _influence(problem, values + STEP) - _influence(problem, values - STEP)
            curvature += count * max(float(steps.mean()) / (2 * STEP), LEAST_SLOPE)
            # Not of the scores, which a robust loss makes less like an autoregression.
            rho = series.likeliest([residuals], problem.loss, noise.tails, None).correlation
            frames = min((1 + rho) / (1 - rho), len(scores.values))
            squares = max(
                float(np.mean(scores.values[scores.active] ** 2)), (LEAST_SIGMAS[kind] / sigma) ** 2
            )
            variance += count * squares * frames
    return curvature / variance if variance else 1.0


def _influence(problem: Problem[jaxik.FootIK], residuals: np.ndarray) -> np.ndarray:
    return series.influence(residuals, problem.loss, float(problem.tails))


def _errors_of_clips(problem: Problem[jaxik.FootIK], u: Vector) -> list[dict[str, Errors]]:
    ik, scenes = system_and_scenes(problem, jnp.asarray(u))
    pairs = zip(scenes, _errors_by_kind(ik, scenes), strict=True)
    return [_counted(scene, values) for scene, values in pairs]


def _counted(scene: Scene, by_kind: Mapping[str, Array]) -> dict[str, Errors]:
    """Errors of each measured kind in one clip, and which of them count."""
    seen, present = np.asarray(scene.reference.observed), np.asarray(scene.rig.present, bool)
    errors = {}
    for kind, values in by_kind.items():
        array = np.asarray(values, np.float64)
        legs = present if array.ndim == 3 else np.ones(1, bool)
        counts = np.repeat(seen[:, None] & legs, array[0].size // len(legs), axis=1)
        errors[kind] = Errors(np.where(counts, array.reshape(counts.shape), 0.0), counts)
    return errors


@cached
def _errors_by_kind(ik: jaxik.FootIK, scenes: tuple[Scene, ...]) -> list[dict[str, Array]]:
    """Errors of each measured kind, clip by clip."""
    pairs = zip(scenes, run_scenes(ik, scenes), strict=True)
    by_clip = (errors_by_kind(scene, result) for scene, result in pairs)
    return [{kind: errors[kind] for kind in MEASURED} for errors in by_clip]
