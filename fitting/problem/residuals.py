"""How far a system's motion is from the reference, as residuals in standard deviations."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

import jaxik
from jaxik.maths import quat, vec

from .scene import Scene, legs_ws, pelvis_ws
from .shared_world import run_scene, run_scenes


def residuals_of_scenes(ik: jaxik.FootIK, scenes: tuple[Scene, ...]) -> Float[Array, " residuals"]:
    """Residuals of several clips in standard deviations, one clip after another."""
    pairs = zip(scenes, run_scenes(ik, scenes), strict=True)
    return jnp.concatenate([residuals_of_result(scene, result) for scene, result in pairs])


def residuals_of_scene(ik: jaxik.FootIK, scene: Scene) -> Float[Array, " residuals"]:
    """Residuals of one clip, which runs alone."""
    return residuals_of_result(scene, run_scene(ik, scene))


def residuals_of_result(scene: Scene, result: jaxik.Result) -> Float[Array, " residuals"]:
    """Residuals of one clip in standard deviations, one kind after another."""
    residuals = residuals_by_kind(scene, errors_by_kind(scene, result))
    return jnp.concatenate([of_kind.ravel() for of_kind in residuals.values()])


def errors_by_kind(scene: Scene, result: jaxik.Result) -> dict[str, Array]:
    """Result minus reference, by kind of residual, in the unit of its sigma."""
    assert result.trace is not None  # `jaxik.run` always has one
    reference, present = scene.reference, scene.rig.present[:, None]
    legs, pelvis = legs_ws(scene, result), pelvis_ws(scene, result)
    ankle = (legs.ankle.pos - reference.ankle.pos) * present
    dt = scene.frames.dt[1:-1, None, None]
    contact = result.trace.sensed.contact.weight - reference.contact
    return {
        "ankle": ankle,
        "knee": (legs.knee.pos - reference.knee_ws) * present,
        "pelvis": pelvis.pos - reference.pelvis.pos,
        "foot": rotation_between(reference.ankle.rot, legs.ankle.rot) * present,
        "body": rotation_between(reference.pelvis.rot, pelvis.rot),
        "contact": contact * scene.rig.present,
        "smooth": (ankle[2:] - 2.0 * ankle[1:-1] + ankle[:-2]) / dt**2,
    }


def residuals_by_kind(scene: Scene, errors: dict[str, Array]) -> dict[str, Array]:
    """Errors divided by their sigmas and whitened; 0 where the reference was not observed."""
    observed, sigmas = scene.reference.observed, scene.sigmas
    three_observed = observed[2:] & observed[1:-1] & observed[:-2]
    residuals = {}
    for kind, error in errors.items():
        scaled = error / getattr(sigmas, kind)
        if kind == "smooth":  # an acceleration takes three frames
            residuals[kind] = jnp.where(three_observed[:, None, None], scaled, 0.0)
        else:
            residuals[kind] = whitened(scaled, observed, sigmas.correlation_of(kind))
    return residuals


def rotation_between(a: Float[Array, "*b 4"], b: Float[Array, "*b 4"]) -> Float[Array, "*b 3"]:
    """Rotation vector from `a` to `b`, rad, in the space of `a`.

    Its length is twice the sine of half the angle: the angle itself to third order.
    """
    w, x, y, z = quat.components(quat.multiply(quat.conjugate(a), b))
    return 2.0 * vec.scale(vec.stack(x, y, z), jnp.where(w < 0, -1.0, 1.0))


def whitened(
    residuals: Float[Array, " frames *r"], observed: Bool[Array, " frames"], correlation: Array
) -> Float[Array, " frames *r"]:
    """Residuals minus what the previous frame predicts of them, in units of what remains.

    `(r_t - rho r_{t-1}) / sqrt(1 - rho²)` where both frames were observed, `r_t` where only this
    one was, 0 where it was not. They are independent if the errors are a first-order
    autoregression.
    """
    per_frame = (slice(None),) + (None,) * (residuals.ndim - 1)
    residuals = jnp.where(observed[per_frame], residuals, 0.0)
    previous = jnp.concatenate([jnp.zeros_like(residuals[:1]), residuals[:-1]])
    follows = jnp.concatenate([jnp.zeros_like(observed[:1]), observed[:-1] & observed[1:]])
    innovation = (residuals - correlation * previous) / jnp.sqrt(1.0 - correlation**2)
    return jnp.where(follows[per_frame], innovation, residuals)
