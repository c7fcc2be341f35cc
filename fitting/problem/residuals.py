"""How far a system's motion is from the reference, as residuals in standard deviations."""

from collections.abc import Sequence
from typing import TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Shaped

import jaxik
from jaxik.maths import quat, vec
from jaxik.world.skeleton import Transform

from . import capture_system
from .capture_system import parted
from .scene import Scene, legs_ws, pelvis_ws
from .shared_world import groups, run_row, run_scene, scene_in_a_row, split

Values = TypeVar("Values", Array, np.ndarray)


def residuals_of_scenes(ik: jaxik.FootIK, scenes: tuple[Scene, ...]) -> Float[Array, " residuals"]:
    """Residuals of several clips in standard deviations, one clip after another."""
    ik, scenes = parted(ik, scenes)
    residuals: dict[int, Array] = {}
    for numbers in groups(scenes):
        members = [scenes[number] for number in numbers]
        residuals |= zip(numbers, _residuals_of_row(ik, members), strict=True)
    return jnp.concatenate([residuals[number] for number in range(len(scenes))])


def residuals_of_scene(ik: jaxik.FootIK, scene: Scene) -> Float[Array, " residuals"]:
    """Residuals of one clip, which runs alone, one kind after another."""
    errors = errors_by_kind(scene, run_scene(ik, scene))
    return jnp.concatenate(
        [of_kind.ravel() for of_kind in residuals_by_kind(scene, errors).values()]
    )


def _residuals_of_row(ik: jaxik.FootIK, scenes: Sequence[Scene]) -> list[Array]:
    """Residuals of one clip, or of each of several that share a world, computed together."""
    if len(scenes) == 1:
        return [residuals_of_scene(ik, scenes[0])]
    row = scene_in_a_row(scenes)
    errors = errors_by_kind(row, run_row(ik, scenes))
    begins = np.concatenate([np.arange(len(scene.frames.dt)) == 0 for scene in scenes])
    by_kind = residuals_by_kind(row, errors, begins)
    by_clip = {kind: split(r, scenes, r.shape[0]) for kind, r in by_kind.items()}
    return [
        jnp.concatenate([parts[number].ravel() for parts in by_clip.values()])
        for number in range(len(scenes))
    ]


def errors_by_kind(scene: Scene, result: jaxik.Result) -> dict[str, Array]:
    """Result minus reference, by kind of residual, in the unit of its sigma."""
    assert result.trace is not None  # `jaxik.run` always has one
    errors = errors_of_pose(scene, legs_ws(scene, result), pelvis_ws(scene, result))
    contact = result.trace.sensed.contact.weight
    if scene.capture is not None:
        contact = capture_system.delayed(scene.capture, scene.frames, contact)
    contact = contact - scene.reference.contact
    ankle, dt = errors["ankle"], scene.frames.dt[1:-1, None, None]
    return errors | {
        "contact": contact * scene.rig.present,
        "smooth": (ankle[2:] - 2.0 * ankle[1:-1] + ankle[:-2]) / dt**2,
    }


def errors_of_pose(scene: Scene, legs: jaxik.LegPose, pelvis: Transform) -> dict[str, Array]:
    """A motion minus the reference, by kind of residual that measures something, m and rad.

    Legs (frames legs) and pelvis (frames) are in world space.
    """
    reference, present = scene.reference, scene.rig.present[..., None]
    if scene.capture is not None:
        legs, pelvis = capture_system.recorded(scene.capture, scene.rig, scene.frames, legs, pelvis)
    return {
        "ankle": (legs.ankle.pos - reference.ankle.pos) * present,
        "knee": (legs.knee.pos - reference.knee_ws) * present,
        "pelvis": pelvis.pos - reference.pelvis.pos,
        "foot": rotation_between(reference.ankle.rot, legs.ankle.rot) * present,
        "body": rotation_between(reference.pelvis.rot, pelvis.rot),
    }


def residuals_by_kind(
    scene: Scene, errors: dict[str, Array], begins: Bool[np.ndarray, " frames"] | None = None
) -> dict[str, Array]:
    """Errors divided by their sigmas and whitened; 0 where the reference was not observed.

    Where several clips run in a row, `begins` says which frames are the first of one.
    """
    sigmas, residuals = scene.sigmas, {}
    for kind, error in errors.items():
        sigma, observed = getattr(sigmas, kind), scene.reference.fitted(kind)
        if kind == "smooth":  # an acceleration takes three frames
            follows = _follows(observed, begins)
            counts = follows[:-1] & follows[1:]
            scaled = error / over_frames(sigma[1:-1] if sigma.ndim else sigma, error)
            residuals[kind] = jnp.where(over_frames(counts, error), scaled, 0.0)
        else:
            scaled, rho = error / over_frames(sigma, error), sigmas.correlation_of(kind)
            residuals[kind] = whitened(scaled, observed, over_frames(rho, error), begins)
    return residuals


def _follows(
    observed: Bool[Array, " frames *legs"], begins: Bool[np.ndarray, " frames"] | None
) -> Bool[Array, " frames_but_one *legs"]:
    """Which frames but the first are observed, and follow one of their clip that is, too."""
    both = observed[:-1] & observed[1:]
    return both if begins is None else both & over_frames(~begins[1:], both)


def over_frames(values: Values, errors: Shaped[Array, " frames *r"]) -> Values:
    """A value of all frames, or of each, or of each leg in each, as errors combine with it.

    Args:
        values: of shape (), (frames,) or (frames, legs).
        errors: of frames, and then maybe of legs.
    """
    return values.reshape(*values.shape, *(1,) * (errors.ndim - values.ndim))


def rotation_between(a: Float[Array, "*b 4"], b: Float[Array, "*b 4"]) -> Float[Array, "*b 3"]:
    """Rotation vector from `a` to `b`, rad, in the space of `a`.

    Its length is twice the sine of half the angle: the angle itself to third order.
    """
    w, x, y, z = quat.components(quat.multiply(quat.conjugate(a), b))
    return 2.0 * vec.scale(vec.stack(x, y, z), jnp.where(w < 0, -1.0, 1.0))


def whitened(
    residuals: Float[Array, " frames *r"],
    observed: Bool[Array, " frames *legs"],
    correlation: Float[Array, "*#frames"],
    begins: Bool[np.ndarray, " frames"] | None = None,
) -> Float[Array, " frames *r"]:
    """Residuals less their prediction by the previous frame, in sigmas of the remainder.

    `(r_t - rho r_{t-1}) / sqrt(1 - rho²)` where both frames were observed, `r_t` where only this
    one was, 0 where it was not. They are independent if the errors are a first-order
    autoregression. `begins` is as for `residuals_by_kind`.
    """
    residuals = jnp.where(over_frames(observed, residuals), residuals, 0.0)
    previous = jnp.concatenate([jnp.zeros_like(residuals[:1]), residuals[:-1]])
    follows = _follows(observed, begins)
    follows = jnp.concatenate([jnp.zeros_like(observed[:1]), follows])
    innovation = (residuals - correlation * previous) / jnp.sqrt(1.0 - correlation**2)
    return jnp.where(over_frames(follows, residuals), innovation, residuals)
