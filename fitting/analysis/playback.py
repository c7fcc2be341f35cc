"""A clip played under given parameters, as the numbers that reports count and pictures draw."""

from collections.abc import Mapping
from functools import cached_property
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import jaxik
from fitting.problem.residuals import errors_by_kind, residuals_by_kind
from fitting.problem.scene import Scene, legs_ws, pelvis_ws
from fitting.runtime.program_cache import cached
from jaxik.maths import vec
from jaxik.world import frame
from jaxik.world.skeleton import Transform
from jaxik.world.terrain import cast

ABOVE, REACH = 1.0, 3.0  # m, where the rays that look for the ground start, and their length

KINDS = ("ankle", "knee", "pelvis", "foot", "body", "contact", "smooth")  # in the rows' order

Series: TypeAlias = Array | np.ndarray  # NumPy once a playback is made


class Motion(eqx.Module):
    """Where legs and pelvis are; world space, m, frames first."""

    pelvis: Float[Series, "frames 3"]
    hip: Float[Series, "frames legs 3"]
    knee: Float[Series, "frames legs 3"]
    ankle: Float[Series, "frames legs 3"]
    toe: Float[Series, "frames legs 3"]

    @property
    def knee_angle(self) -> Float[np.ndarray, "frames legs"]:
        """Angle between thigh and shin, rad; pi for a straight leg."""
        thigh, shin = np.asarray(self.hip - self.knee), np.asarray(self.ankle - self.knee)
        across = np.linalg.norm(np.cross(thigh, shin), axis=-1)
        return np.arctan2(across, np.sum(thigh * shin, axis=-1))


class Playback(eqx.Module):
    """One clip before and after foot IK, and as captured."""

    before: Motion  # the animation on its flat floor
    after: Motion
    captured: Motion
    up_ws: Float[Series, "3"]
    forward_ws: Float[Series, "frames 3"]
    ground_ws: Float[Series, "frames legs 3"]  # under the captured ankles
    grounded: Float[Series, "frames legs"]  # 1 where there is ground under them
    ball_ground_ws: Float[Series, "frames legs 3"]  # under the captured toes
    ball_grounded: Float[Series, "frames legs"]  # 1 where there is ground under them
    floor: Float[Series, " frames"]  # m, height of the floor of the animation
    dt: Float[Series, " frames"]
    contact: Float[Series, "frames legs"]  # weight that the system gives each foot
    locked: Float[Series, "frames legs"]
    reached: Float[Series, "frames legs"]  # 1 where the ankle is at its target
    stance: Float[Series, "frames legs"]  # captured contact labels; all 0 where there are none
    slide: Float[Series, " frames"]
    seen: Bool[Series, " frames"]
    errors: Mapping[str, Float[Series, "rows ..."]]  # of `after`, by kind of residual, in its unit
    rows: Mapping[str, Float[Series, "rows ..."]]  # the same as the fit sees them, in sigmas
    sigmas: Mapping[str, Float[Series, ""]]
    label: str = eqx.field(static=True)  # what pictures call the captured motion

    @cached_property
    def time(self) -> Float[np.ndarray, " frames"]:
        """Seconds since the first frame."""
        return np.cumsum(self.dt) - self.dt[0]

    @cached_property
    def travelled(self) -> Float[np.ndarray, " frames"]:
        """Distance that the captured pelvis has come forward, m; less when it walks backwards."""
        steps = np.diff(np.asarray(self.captured.pelvis), axis=0, prepend=self.captured.pelvis[:1])
        return np.cumsum(np.sum(steps * self.forward_ws, axis=-1))

    @property
    def used(self) -> list[str]:
        """Kinds of residuals that the fit looks at: those whose sigma is finite."""
        return [kind for kind in KINDS if np.isfinite(self.sigmas[kind])]

    def height(self, points_ws: Float[Series, "*b 3"]) -> Float[np.ndarray, "*b"]:
        """Heights along up, m."""
        return np.asarray(points_ws) @ np.asarray(self.up_ws)

    def ground_height(self) -> Float[np.ndarray, "frames legs"]:
        """Height of the ground under the captured ankles, m; NaN where there is none."""
        return np.where(np.asarray(self.grounded) > 0, self.height(self.ground_ws), np.nan)

    def along(self, points_ws: Float[Series, "frames ... 3"]) -> Float[np.ndarray, "frames ..."]:
        """How far forward points are on the way that the character comes, m."""
        wide = (slice(None),) + (None,) * (points_ws.ndim - 2)
        off = np.asarray(points_ws) - self.captured.pelvis[wide]
        return self.travelled[wide] + np.sum(off * self.forward_ws[wide], axis=-1)


def play(ik: jaxik.FootIK, scene: Scene) -> Playback:
    """The scene's clip under these parameters, as NumPy arrays."""
    return jax.tree.map(np.asarray, _watch(ik, scene))


@cached
def _watch(ik: jaxik.FootIK, scene: Scene) -> Playback:
    result = jaxik.run(ik, scene.rig, scene.terrain, scene.frames)
    world, reference, up = scene.frames.world_from_model, scene.reference, scene.terrain.up_ws
    animated, solved = scene.frames.pose.transformed(_per_leg(world)), legs_ws(scene, result)
    base, carried = world @ scene.pelvis, pelvis_ws(scene, result)
    # The reference knows no hips and toes: they hang on the pelvis and the ankles as in the base.
    hips = _per_leg(reference.pelvis).apply(_per_leg(base).inverse().apply(animated.hip.pos))
    toes = reference.ankle.apply(animated.ankle.inverse().apply(animated.toe.pos))
    under, under_ball = (
        cast(scene.terrain, joints + vec.scale(up, jnp.asarray(ABOVE)), REACH)
        for joints in (reference.ankle.pos, toes)
    )
    errors = errors_by_kind(scene, result)
    return Playback(
        before=Motion(base.pos, *_positions(animated)),
        after=Motion(carried.pos, *_positions(solved)),
        captured=Motion(reference.pelvis.pos, hips, reference.knee_ws, reference.ankle.pos, toes),
        up_ws=up,
        forward_ws=jax.vmap(lambda one: frame.heading(one, up)[0])(world),
        ground_ws=under.point,
        grounded=under.found,
        ball_ground_ws=under_ball.point,
        ball_grounded=under_ball.found,
        floor=vec.dot(world.pos, up),
        dt=scene.frames.dt,
        contact=result.trace.sensed.contact.weight,
        locked=result.trace.advanced.held.locked,
        reached=result.reached,
        stance=reference.contact,
        slide=scene.frames.slide,
        seen=reference.observed,
        errors=errors,
        rows=residuals_by_kind(scene, errors),
        sigmas={kind: getattr(scene.sigmas, kind) for kind in errors},
        label=reference.label,
    )


def _per_leg(each: Transform) -> Transform:
    return Transform(each.pos[:, None], each.rot[:, None])


def _positions(legs: jaxik.LegPose) -> tuple[Array, Array, Array, Array]:
    return legs.hip.pos, legs.knee.pos, legs.ankle.pos, legs.toe.pos
