"""How far a system's joints are from the captured ones: one number for a clip."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxik
from fitting.problem.residuals import errors_by_kind
from fitting.problem.scene import Scene
from fitting.problem.shared_world import run_scene
from fitting.runtime.precision import in_float64
from fitting.runtime.program_cache import cached

JOINTS = ("pelvis", "knee", "ankle")


@in_float64
def position_error(ik: jaxik.FootIK, scene: Scene) -> float:
    """Distance of pelvis, knees and ankles from the captured ones, m, rms over joints and frames.

    Frames that were not observed, and legs that the rig only has in name, do not count; NaN if
    nothing is left.
    """
    squares, count = _squares(ik, scene)
    return float(np.sqrt(squares / count)) if count else float("nan")


@cached
def _squares(ik: jaxik.FootIK, scene: Scene) -> tuple[Array, Array]:
    """Sum of the squared distances, m², and their number."""
    errors = errors_by_kind(scene, run_scene(ik, scene))
    observed, legs = scene.reference.observed, jnp.sum(scene.rig.present)
    each = [jnp.sum(errors[joint].reshape(len(observed), -1) ** 2, axis=1) for joint in JOINTS]
    total = jnp.sum(jnp.where(observed, sum(each), 0.0))
    return total, jnp.sum(observed) * (1 + 2 * legs)
