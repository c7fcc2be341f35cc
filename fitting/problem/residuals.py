"""How far a system's motion is from a reference clip, as rows in standard deviations."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

import jaxik
from jaxik.maths import quat, vec
from jaxik.world.skeleton import Transform
from jaxik.world.terrain import Terrain


class Sigmas(eqx.Module):
    """Standard deviations of the residuals; infinite leaves a kind of residual out."""

    ankle: Float[Array, ""]  # m
    knee: Float[Array, ""]  # m
    pelvis: Float[Array, ""]  # m
    foot: Float[Array, ""]  # rad, orientation of the ankle joint
    body: Float[Array, ""]  # rad, orientation of the pelvis
    contact: Float[Array, ""]  # of the contact weight, 0..1
    smooth: Float[Array, ""]  # m/s², of the ankle's acceleration
    correlation: Float[Array, ""]  # AR(1) coefficient from frame to frame, 0 for independent ones


class Reference(eqx.Module):
    """What the fitted motion is held against; world space, frames first."""

    pelvis: Transform  # frames
    knee_ws: Float[Array, "frames legs 3"]
    ankle: Transform  # frames legs
    contact: Float[Array, "frames legs"]  # 0 or 1
    seen: Bool[Array, " frames"]  # False where a marker popped or nothing was captured
    label: str = eqx.field(static=True, default="captured")  # what pictures call it


class Scene(eqx.Module):
    """One clip's share of the data."""

    rig: jaxik.Rig
    terrain: Terrain
    frames: jaxik.Frame
    pelvis: Transform  # frames, of the base animation, model space
    reference: Reference
    sigmas: Sigmas


def pelvis_ws(scene: Scene, result: jaxik.Result) -> Transform:
    """The base's pelvis as the body's move leaves it, (frames), world space."""
    return scene.frames.world_from_model @ (result.body @ scene.pelvis)


def rotation_between(a: Float[Array, "*b 4"], b: Float[Array, "*b 4"]) -> Float[Array, "*b 3"]:
    """Turn from `a` to `b`, rad, exact to third order: twice the sine of half its angle."""
    w, x, y, z = quat.components(quat.multiply(quat.conjugate(a), b))
    return 2.0 * vec.scale(vec.stack(x, y, z), jnp.where(w < 0, -1.0, 1.0))


def legs_ws(scene: Scene, result: jaxik.Result) -> jaxik.LegPose:
    """The solved legs, (frames legs), world space."""
    world = scene.frames.world_from_model
    return result.pose.transformed(Transform(world.pos[:, None], world.rot[:, None]))


def errors_by_kind(scene: Scene, result: jaxik.Result) -> dict[str, Array]:
    """How far a result is from the reference, by kind of residual, in the unit of its sigma."""
    reference, present = scene.reference, scene.rig.present[:, None]
    legs, pelvis = legs_ws(scene, result), pelvis_ws(scene, result)
    ankle = (legs.ankle.pos - reference.ankle.pos) * present
    step = scene.frames.dt[1:-1, None, None]
    standing = result.trace.sensed.contact.weight - reference.contact
    return {
        "ankle": ankle,
        "knee": (legs.knee.pos - reference.knee_ws) * present,
        "pelvis": pelvis.pos - reference.pelvis.pos,
        "foot": rotation_between(reference.ankle.rot, legs.ankle.rot) * present,
        "body": rotation_between(reference.pelvis.rot, pelvis.rot),
        "contact": standing * scene.rig.present,
        "smooth": (ankle[2:] - 2.0 * ankle[1:-1] + ankle[:-2]) / step**2,
    }


def residuals_by_kind(scene: Scene, errors: dict[str, Array]) -> dict[str, Array]:
    """Errors in standard deviations, whitened; 0 where the reference was not seen."""
    seen, sigmas = scene.reference.seen, scene.sigmas
    calm = seen[2:] & seen[1:-1] & seen[:-2]
    rows = {}
    for kind, error in errors.items():
        scaled = error / getattr(sigmas, kind)
        if kind == "smooth":  # an acceleration takes three frames
            rows[kind] = jnp.where(calm[:, None, None], scaled, 0.0)
        else:
            rows[kind] = whitened(scaled, seen, sigmas.correlation)
    return rows


def residuals_of_scene(ik: jaxik.FootIK, scene: Scene) -> Float[Array, " rows"]:
    """Residuals of one clip in standard deviations, one kind after another."""
    result = jaxik.run(ik, scene.rig, scene.terrain, scene.frames)
    rows = residuals_by_kind(scene, errors_by_kind(scene, result))
    return jnp.concatenate([row.ravel() for row in rows.values()])


def whitened(
    rows: Float[Array, " frames *r"], seen: Bool[Array, " frames"], correlation: Array
) -> Float[Array, " frames *r"]:
    """Rows of which each is what the frame before did not foretell, in its own deviations.

    `(r_t - rho r_{t-1}) / sqrt(1 - rho²)` where both frames were seen, `r_t` where only this one
    was, 0 where it was not: independent rows if the errors are a first-order autoregression.
    """
    wide = (slice(None),) + (None,) * (rows.ndim - 1)
    rows = jnp.where(seen[wide], rows, 0.0)
    before = jnp.concatenate([jnp.zeros_like(rows[:1]), rows[:-1]])
    both = jnp.concatenate([jnp.zeros_like(seen[:1]), seen[:-1] & seen[1:]])
    apart = (rows - correlation * before) / jnp.sqrt(1.0 - correlation**2)
    return jnp.where(both[wide], apart, rows)


def residuals_of_scenes(ik: jaxik.FootIK, scenes: tuple[Scene, ...]) -> Float[Array, " rows"]:
    """Residuals of several clips, one after another."""
    return jnp.concatenate([residuals_of_scene(ik, scene) for scene in scenes])
