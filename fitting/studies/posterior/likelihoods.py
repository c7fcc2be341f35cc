"""The log-likelihood of each frame for one draw, and how frames make blocks."""

import hashlib
from collections.abc import Mapping

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

import jaxik
from fitting.analysis.goodness import groups
from fitting.analysis.playback import RESIDUAL_KINDS, Playback
from fitting.inference.noise.density import NoiseDensity
from fitting.inference.sampling.blocks import SECONDS
from fitting.problem.problem import Problem
from fitting.problem.scene import Scene

ROUNDING = 1e-6  # of a block, by which a frame may begin too early


def of_frames(
    playback: Playback, scene: Scene, density: NoiseDensity, ratios: Mapping[str, float]
) -> Float[np.ndarray, " frames"]:
    """Log-likelihood of each frame given the one before it.

    Args:
        playback: the clip with the system of a draw.
        scene: the clip.
        density: of independent residuals.
        ratios: sigmas of the draw in units of the scene's, by kind; 1 for those left out.
    """
    total = np.zeros(len(playback.dt))
    for kind in playback.fitted_kinds:
        _, residuals, active = groups.series(playback, kind)
        ratio = ratios.get(kind, 1.0)
        log_density = density.log_density(residuals / ratio)
        log_density -= np.log(ratio * float(getattr(scene.sigmas, kind)))
        if kind == "smooth":  # an acceleration takes three frames; it counts for the one between
            total[1:-1] += np.where(active, log_density, 0.0).sum(axis=1)
            continue
        follows = np.concatenate([np.zeros_like(active[:1]), active[1:] & active[:-1]])
        correlation = float(scene.sigmas.correlation_of(kind))
        log_density -= 0.5 * np.log1p(-(correlation**2)) * follows
        total += np.where(active, log_density, 0.0).sum(axis=1)
    return total


def block_of_frames(playback: Playback) -> Int[np.ndarray, " frames"]:
    """The block of each frame, from 0; a short rest at the end belongs to the last one."""
    time = playback.time
    blocks = max(1, round(float(time[-1]) / SECONDS))
    return np.minimum((time / SECONDS + ROUNDING).astype(int), blocks - 1)


def digest(problem: Problem[jaxik.FootIK]) -> str:
    """16 characters that change with the captured motion, and with what of it counts."""
    digested = hashlib.sha256()
    for scene in problem.data:
        counts = [kind for kind in RESIDUAL_KINDS if np.isfinite(getattr(scene.sigmas, kind))]
        digested.update(repr(counts).encode())
        for leaf in jax.tree.leaves(eqx.filter((scene.reference, scene.frames.dt), eqx.is_array)):
            digested.update(np.asarray(leaf, np.float64).tobytes())
    return digested.hexdigest()[:16]
