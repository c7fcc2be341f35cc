"""Sigmas that a posterior leaves open: integrated out while sampling, and drawn afterwards.

With normal residuals the integral over a sigma is known, so that the sampler needs no dimension
for it; given the parameters, its square is a scaled inverse chi-square (Gelman et al., Bayesian
Data Analysis, 3rd edition, 3.2), from which it is drawn exactly.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxik
from fitting.problem.problem import Problem
from fitting.problem.scene import WHITENED, Scene
from fitting.runtime.precision import in_float64
from fitting.runtime.program_cache import cached
from jaxik import lanes

from .model import noise_of

DRAWS = 1024  # of each sigma, at most
BATCH = 64  # of them at a time


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
    seen, present = np.asarray(scene.reference.observed), np.asarray(scene.rig.present)
    each = {name: np.zeros(seen.size * size) for name, size in _sizes(present.size).items()}
    each["smooth"] = np.zeros((seen.size - 2) * present.size * 3)
    if kind in kinds:
        legs = np.ones(1, bool) if kind in ("pelvis", "body") else present
        active = seen[:, None, None] & legs[:, None] & np.ones(3, bool)
        each[kind] = active.astype(float).ravel()
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
    """Draws of the sigmas that a problem leaves open, by kind, one for each of `thinned(u)`.

    Args:
        problem: with open sigmas.
        u: samples of the posterior.
        seed: of the draws.
    """
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
