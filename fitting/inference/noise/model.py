"""The noise that a problem assumes, as plain numbers, and the likeliest one at a point."""

import dataclasses
import math
from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxik
from fitting.problem.problem import Problem
from fitting.problem.residuals import errors_by_kind
from fitting.problem.scene import MEASURED, WHITENED, Scene
from fitting.problem.shared_world import run_scenes
from fitting.problem.space import Vector
from fitting.runtime.precision import in_float64
from fitting.runtime.program_cache import cached

from . import series
from .series import Errors, Estimate
from .settings import NoiseOptions

SMALLEST = 1e-4  # of the given sigma; below it, a kind has no noise to speak of


@dataclasses.dataclass(frozen=True)
class NoiseModel:
    """The noise of each kind of residual that measures something."""

    sigmas: Mapping[str, float]
    """m, rad, ...; of the kinds that are not left out."""
    correlations: Mapping[str, float]
    """From one frame to the next."""
    tails: float
    """Degrees of freedom of Student's t, under the loss `student`."""
    independent_fraction: float
    """Of the residuals."""

    def __post_init__(self) -> None:
        numbers = [*self.sigmas.values(), self.tails, self.independent_fraction]
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
        independent_fraction=float(problem.independent_fraction),
    )


@in_float64
def with_noise(problem: Problem[jaxik.FootIK], noise: NoiseModel) -> Problem[jaxik.FootIK]:
    """The problem with this noise; kinds that it does not name keep theirs. Nothing recompiles."""
    scenes = tuple(_with_noise(scene, noise) for scene in problem.data)
    numbers = (jnp.asarray(noise.independent_fraction), jnp.asarray(noise.tails))
    return eqx.tree_at(
        lambda p: (p.data, p.independent_fraction, p.tails), problem, (scenes, *numbers)
    )


def _with_noise(scene: Scene, noise: NoiseModel) -> Scene:
    sigmas = scene.sigmas
    given = {kind: float(sigmas.correlation_of(kind)) for kind in WHITENED}
    correlation = np.array([(given | dict(noise.correlations))[kind] for kind in WHITENED])
    changed = {kind: jax.device_put(np.float64(sigma)) for kind, sigma in noise.sigmas.items()}
    sigmas = dataclasses.replace(sigmas, **changed, correlation=jax.device_put(correlation))
    return dataclasses.replace(scene, sigmas=sigmas)


@in_float64
def likeliest_noise(problem: Problem[jaxik.FootIK], u: Vector, options: NoiseOptions) -> NoiseModel:
    """The noise that makes the errors at `u` likeliest; what is not estimated stays as it is."""
    assumed, ik = noise_of(problem), problem.space.unpack(jnp.asarray(u))
    pairs = zip(problem.data, _errors_by_kind(ik, problem.data), strict=True)
    by_clip = [_counted(scene, values) for scene, values in pairs]
    found = {
        kind: _likeliest(
            [errors[kind] for errors in by_clip], problem, options, assumed.correlations[kind]
        )
        for kind in assumed.sigmas
    }
    model = assumed
    if options.sigmas == "estimated":
        floors = {kind: SMALLEST * sigma for kind, sigma in assumed.sigmas.items()}
        sigmas = {kind: max(found[kind].sigma, floors[kind]) for kind in found}
        model = dataclasses.replace(model, sigmas=sigmas)
    correlations = {kind: found[kind].correlation for kind in found}
    if options.correlation == "whitened":
        model = dataclasses.replace(model, correlations=correlations)
    elif options.correlation == "counted":
        fraction = _independent_fraction(by_clip, correlations)
        model = dataclasses.replace(model, independent_fraction=fraction)
    if problem.loss == "student" and options.sigmas == "estimated":
        values = [
            series.innovations(errors[kind], model.correlations[kind]) / model.sigmas[kind]
            for errors in by_clip
            for kind in model.sigmas
        ]
        tails = series.likeliest_tails(np.concatenate(values))
        model = dataclasses.replace(model, tails=tails)
    return model


def _likeliest(
    clips: list[Errors], problem: Problem, options: NoiseOptions, given: float
) -> Estimate:
    """Of one kind, with its correlation as given, or estimated and taken out."""
    if not any(errors.active.any() for errors in clips):
        return Estimate(0.0, given, 0.0)
    tails = float(problem.tails)
    whitened = options.correlation == "whitened"
    found = series.likeliest(clips, problem.loss, tails, None if whitened else given)
    if options.correlation != "counted":
        return found
    autoregression = series.likeliest(clips, problem.loss, tails, None)
    return found._replace(correlation=autoregression.correlation)


def _independent_fraction(
    by_clip: list[dict[str, Errors]], correlations: Mapping[str, float]
) -> float:
    """Fraction of the residuals that counts as independent, all kinds together.

    `(1 + rho) / (1 - rho)` frames of a kind are worth one. Kinds are averaged as a composite
    likelihood's score is, by their counts (Pauli, Racugno and Ventura 2011).
    """
    frames, count = 0.0, 0
    for errors in by_clip:
        for kind, rho in correlations.items():
            active = int(errors[kind].active.sum())
            frames += active * (1 + rho) / (1 - rho)
            count += active
    return min(1.0, count / max(frames, 1e-300))


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
