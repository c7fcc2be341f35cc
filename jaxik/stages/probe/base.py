"""The abstract probe, and what the probes share."""

import dataclasses
from abc import abstractmethod

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxik.maths import quat, vec
from jaxik.maths.parameter_tree import Rule
from jaxik.maths.smoothing import lerp, smoothstep
from jaxik.stages.inputs import GroundMoment, Inputs
from jaxik.world.frame import (
    FORWARD,
    Contact,
    Frame,
    GroundHits,
    Rays,
    Stride,
    animated_ankles,
    heading,
)
from jaxik.world.skeleton import Rig
from jaxik.world.terrain import Hit, Terrain

SAME_STEP, SAME_FADE = 0.05, 0.03  # m, between hits under one sole, and over which it fades


class AbstractProbe(Rule):
    """Finds the ground under the feet."""

    def init(self, rig: Rig) -> PyTree:
        """Memory before the first frame; None for a probe that goes by each frame alone."""
        return None

    def watch(self, inputs: Inputs, contact: Contact, foot_height: Array) -> PyTree:
        """What memory advances with, from this frame alone."""
        return None

    def advance(
        self, now: GroundMoment, watched: PyTree, state: PyTree
    ) -> tuple[PyTree, Stride | None]:
        """Memory after this frame, and the stride that `sense` finds in the frame.

        It runs before `sense`. None leaves the animation's stride.
        """
        return None, None

    def ground(self, inputs: Inputs, contact: Contact, foot_height: Array) -> GroundHits:
        """The ground that counts, as `sense` finds it."""
        return self.sense(inputs, contact, foot_height)

    @abstractmethod
    def sense(self, inputs: Inputs, contact: Contact, foot_height: Array) -> GroundHits:
        """The ground under each leg in this frame; `foot_height` is from sole to ankle, m."""


def level_origin(inputs: Inputs) -> Float[Array, "*#legs 3"]:
    """Where the level of each leg is, m, world space, from which steps of its ground count.

    That of legs is the character's root. One that bears nothing, such as a hand on a wall, has no
    level but its own animated place.
    """
    root_ws = inputs.frame.world_from_model.pos
    if isinstance(inputs.terrain, Terrain):
        return root_ws
    return lerp(root_ws, animated_ankles(inputs.frame).pos, 1.0 - inputs.bearing[:, None])


def separate(hits: Hit) -> list[Hit]:
    """Hits along their first axis."""
    return [jax.tree.map(lambda x: x[i], hits) for i in range(len(hits.found))]  # noqa: B023


def toe_point(rig: Rig, frame: Frame, toe_ls: Array) -> Array:
    """Toe of each leg, m, model space.

    `toe_ls` is the toe of a left foot relative to its ankle, in foot axes; right feet mirror it.
    """
    x, y, z = vec.components(toe_ls)
    foot = quat.multiply(frame.pose.ankle.rot, rig.ankle_from_foot)
    return frame.pose.ankle.pos + quat.rotate(foot, vec.stack(rig.side * x, y, z))


def foot_heading(inputs: Inputs) -> tuple[Array, Array]:
    """Forward and right of each animated foot, unit, perpendicular to its up, world space.

    A foot that points along up gets those of the character.
    """
    if inputs.foot_heading_ws is not None:
        return inputs.foot_heading_ws
    frame, up_ws = inputs.frame, inputs.terrain.leg_up_ws
    foot = quat.multiply(animated_ankles(frame).rot, inputs.rig.ankle_from_foot)
    sole = quat.rotate(foot, vec.constant(FORWARD, up_ws))
    ahead = vec.across(sole, up_ws, heading(frame.world_from_model, up_ws)[0])
    return ahead, vec.cross(ahead, up_ws)


def with_weight(hit: Hit, found: Array) -> Hit:
    """The hit with another weight `found`."""
    return dataclasses.replace(hit, found=found)


def mixed(hit: Hit, other: Hit, up_ws: Array) -> Hit:
    """Both hits, each by how far it is found; these weights add up to at most 1."""
    found = hit.found + other.found
    found, share = vec.stacked_barrier(found, vec.safe_divide(other.found, found))
    platform = None
    if hit.platform is not None and other.platform is not None:
        platform = jnp.where(share > 0.5, other.platform, hit.platform)
    return Hit(
        vec.add(hit.point, vec.scale(other.point - hit.point, share)),
        vec.normalize(lerp(hit.normal, other.normal, share[..., None]), up_ws),
        lerp(hit.distance, other.distance, share),
        found,
        platform,
    )


def no_hit(like: Hit) -> Hit:
    """Misses, for rays that were not cast."""
    return with_weight(like, jnp.zeros_like(like.found))


def or_level(hit: Hit, found: Array, level_ws: Array) -> Hit:
    """The hit where its foot was `found` too; else a miss at `level_ws`, level with the foot."""
    weight = hit.found * found
    point = lerp(level_ws, hit.point, weight[..., None])
    return Hit(point, hit.normal, hit.distance, weight, hit.platform)


def on_same_ground(hit: Hit, foot: Hit, up_ws: Array) -> Hit:
    """A hit beside that of its foot, less found the higher the step is between them.

    A toe over a ledge is not to pitch its foot into it, nor one before a riser onto it.
    """
    way = hit.point - foot.point
    # Off the foot's ground along its normal, and so along up.
    step = vec.safe_divide(vec.dot(way, foot.normal), vec.dot(foot.normal, up_ws))
    same = 1.0 - smoothstep((jnp.abs(step) - SAME_STEP) / SAME_FADE)
    return with_weight(hit, hit.found * jnp.where(foot.found > 0, same, 1.0))


def make_rays(like: Hit, above: Array, below: Array, layers: Array) -> Rays:
    """One ray per hit in `like`, all of the same reach, m."""
    shape = like.found.shape
    return Rays(jnp.broadcast_to(above, shape), jnp.broadcast_to(below, shape), layers)
