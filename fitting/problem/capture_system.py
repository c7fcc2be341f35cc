"""A system together with the errors of the captures that it is fitted to.

Ground may be higher than its file says, or tilted. A ray along -up keeps its place seen from above,
so it meets raised ground where a ray that starts as much lower meets the ground as it is: no mesh
is built anew, nor moved for each parameter.

A residual is the motion as the capture would record it, minus the capture. The other way round,
captured motion that is corrected, and so interpolated and scaled, would have less noise for some
numbers than for others, and the fit would choose those.
"""

import dataclasses
import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

import jaxik
from fitting.runtime.precision import in_float64
from jaxik.maths import quat, vec
from jaxik.world.skeleton import Transform
from jaxik.world.surfaces import AbstractSurface
from jaxik.world.terrain import Terrain

from .problem import Problem
from .scene import GROUND, Capture, Scene
from .space import Vector

PREFIX = "capture."  # of the names of errors of the capture


class CapturedSystem(jaxik.FootIK):
    """A system with one more part, so that a space of parameters is one of both."""

    capture: Capture = eqx.field(default_factory=Capture)
    """Of all clips, (clips)."""
    moves_ground: bool = eqx.field(static=True, default=False)
    """Whether errors of the ground are fitted: else rays are as without a capture."""


def with_capture(ik: jaxik.FootIK, clips: int, names: Sequence[str]) -> CapturedSystem:
    """A system with a capture of several clips without errors; the names are the fitted fields."""
    stages = {stage.name: getattr(ik, stage.name) for stage in dataclasses.fields(ik)}
    moves_ground = any(name in GROUND for name in names)
    return CapturedSystem(**stages, capture=Capture().for_clips(clips), moves_ground=moves_ground)


def is_of_capture(name: str) -> bool:
    """Whether a free parameter of this name belongs to the capture, and not to the system."""
    return name.startswith(PREFIX)


def alone(ik: jaxik.FootIK) -> jaxik.FootIK:
    """The system itself, if there is a capture beside it."""
    if not isinstance(ik, CapturedSystem):
        return ik
    stages = dataclasses.fields(jaxik.FootIK)
    return jaxik.FootIK(**{stage.name: getattr(ik, stage.name) for stage in stages})


def parted(ik: jaxik.FootIK, scenes: tuple[Scene, ...]) -> tuple[jaxik.FootIK, tuple[Scene, ...]]:
    """The system itself, and the clips with the capture beside it."""
    if not isinstance(ik, CapturedSystem):
        return ik, scenes
    return alone(ik), tuple(
        _with_capture(scene, ik.capture.of_clip(number), moves_ground=ik.moves_ground)
        for number, scene in enumerate(scenes)
    )


def _with_capture(scene: Scene, capture: Capture, *, moves_ground: bool) -> Scene:
    scene = dataclasses.replace(scene, capture=capture)
    if not moves_ground:
        return scene
    centre_ws = centre_of(scene.frames)
    tilts = capture.ground_tilt_x, capture.ground_tilt_z
    terrain = raised(scene.terrain, centre_ws, capture.ground_height, tilts)
    return dataclasses.replace(scene, terrain=terrain)


@in_float64
def system_and_scenes(
    problem: Problem[jaxik.FootIK], u: Vector
) -> tuple[jaxik.FootIK, tuple[Scene, ...]]:
    """The system at a point, and the clips of the problem with its capture there."""
    return parted(problem.space.unpack(u), problem.data)


def without_ends(scene: Scene, seconds: float) -> Scene:
    """The scene without the frames at its ends that a shift of this size may leave unknown."""
    reference = scene.reference
    observed, held_out = np.array(reference.observed), np.array(reference.held_out)
    count = math.ceil(seconds / float(scene.frames.dt[-1])) + 1
    for frames in (observed, held_out):
        frames[:count] = frames[-count:] = False
    return eqx.tree_at(
        lambda scene: (scene.reference.observed, scene.reference.held_out),
        scene,
        jax.device_put((observed, held_out)),
    )


def recorded(
    capture: Capture, rig: jaxik.Rig, frames: jaxik.Frame, legs: jaxik.LegPose, pelvis: Transform
) -> tuple[jaxik.LegPose, Transform]:
    """Legs, of which knee and ankle count, and pelvis as the capture of a clip would record them.

    Legs (frames legs) and pelvis (frames) are in world space.
    """
    centre_ws = centre_of(frames)

    def placed(joint: Transform) -> Transform:
        pos = centre_ws + capture.scale * (joint.pos - centre_ws)
        return _delayed(capture, frames, Transform(pos, joint.rot))

    legs = dataclasses.replace(
        legs, knee=placed(legs.knee), ankle=placed(_with_offsets(capture, rig, legs.ankle))
    )
    return legs, placed(pelvis)


def centre_of(frames: jaxik.Frame) -> Float[Array, "3"]:
    """The middle of a clip on its floor, m, about which ground is tilted and lengths are scaled."""
    return jnp.mean(frames.world_from_model.pos, axis=0)


def _with_offsets(capture: Capture, rig: jaxik.Rig, ankle: Transform) -> Transform:
    """The ankle where its capture is, turned by the angle by which the ball's turns the foot."""
    ankle_from_foot = Transform(jnp.zeros_like(rig.ankle_from_foot[..., 1:]), rig.ankle_from_foot)
    offset = _in_foot(rig, capture.ankle_outward, capture.ankle_up, capture.ankle_forward)
    drop = rig.ball_height - rig.ankle_height
    reach = jnp.sqrt(jnp.maximum(rig.foot**2 - drop**2, (0.1 * rig.foot) ** 2))
    ball = vec.stack(jnp.zeros_like(drop), drop, reach)
    captured = ball + _in_foot(rig, capture.ball_outward, capture.ball_up, 0.0)
    turn = quat.shortest_arc(_unit(ball), _unit(captured), jnp.eye(3, dtype=ball.dtype)[0])
    return Transform(
        ankle.pos + ankle.turn(ankle_from_foot.turn(offset)),
        ankle.apply_rot(ankle_from_foot.turn_rot(turn)),
    )


def _in_foot(
    rig: jaxik.Rig, outward: Array | float, up: Array | float, forward: Array | float
) -> Float[Array, "legs 3"]:
    """An offset along the axes of each foot: x is left, y up and z forward."""
    return jnp.stack([rig.side * outward, 0.0 * rig.side + up, 0.0 * rig.side + forward], axis=-1)


def _unit(vectors: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    return vec.scale(vectors, 1.0 / vec.length(vectors))


def delayed(
    capture: Capture, frames: jaxik.Frame, values: Float[Array, " frames *shape"]
) -> Float[Array, " frames *shape"]:
    """Numbers of each frame as they were the capture's time shift before.

    Cubic between frames (Catmull and Rom 1974), so that derivatives have no jumps; before and after
    a clip the numbers are those at its ends.
    """
    places, weights = _taps(capture, frames)
    return _mixed([values[place] for place in places], weights)


def _delayed(capture: Capture, frames: jaxik.Frame, joint: Transform) -> Transform:
    """The same of a joint; quaternions of which one is the other way round are turned first."""
    places, weights = _taps(capture, frames)
    near, rots = joint.rot[places[1]], [joint.rot[place] for place in places]
    alike = [jnp.where(quat.dot(rot, near)[..., None] < 0, -rot, rot) for rot in rots]
    return Transform(
        _mixed([joint.pos[place] for place in places], weights),
        quat.normalize(_mixed(alike, weights)),
    )


def _taps(
    capture: Capture, frames: jaxik.Frame
) -> tuple[list[Int[Array, " frames"]], list[Float[Array, ""]]]:
    """The four frames about what each frame shows, and their weights."""
    place = -capture.time_shift / frames.dt[-1]
    whole = jnp.floor(jax.lax.stop_gradient(place))
    f = place - whole
    count = len(frames.dt)
    first = jnp.arange(count) + whole.astype(jnp.int32)
    return [jnp.clip(first + step, 0, count - 1) for step in (-1, 0, 1, 2)], [
        f * (-0.5 + f * (1.0 - 0.5 * f)),
        1.0 + f**2 * (1.5 * f - 2.5),
        f * (0.5 + f * (2.0 - 1.5 * f)),
        f**2 * (0.5 * f - 0.5),
    ]


def _mixed(values: Sequence[Array], weights: Sequence[Array]) -> Array:
    first, *others = (weight * value for weight, value in zip(weights, values, strict=True))
    return sum(others, first)


class RaisedSurface(AbstractSurface):
    """A surface raised along up by a height that is linear in the place."""

    surface: AbstractSurface
    centre_ws: Float[Array, "3"]
    """m, where it is raised by `height`."""
    height: Float[Array, ""]
    """Metres."""
    slope_ws: Float[Array, "3"]
    """m/m, at right angles to up: the gain in height along each axis of the world."""

    @property
    def platform(self) -> int:
        """That of the surface."""
        return self.surface.platform

    def at(self, platforms: Transform) -> "RaisedSurface":
        """The surface where the platforms are, raised as before."""
        return dataclasses.replace(self, surface=self.surface.at(platforms))

    def moved(self, by_ws: Float[Array, "3"]) -> "RaisedSurface":
        """The raised surface moved by `by_ws`, m."""
        surface, centre_ws = self.surface.moved(by_ws), self.centre_ws + by_ws
        return dataclasses.replace(self, surface=surface, centre_ws=centre_ws)

    def intersect(
        self, origins_ws: Float[Array, "*b 3"], up_ws: Float[Array, "3"], mask: UInt[Array, "*#b"]
    ) -> tuple[Float[Array, "*b"], Float[Array, "*b 3"], Bool[Array, "*b"]]:
        """Intersects rays with the raised surface; see `AbstractSurface.intersect`."""
        rise = self.height + vec.dot(origins_ws - self.centre_ws, self.slope_ws)
        lowered = origins_ws - vec.scale(up_ws, rise)
        distance, normal, hit = self.surface.intersect(lowered, up_ws, mask)
        sheared = normal - vec.scale(self.slope_ws, vec.dot(normal, up_ws))
        return distance, vec.scale(sheared, 1.0 / vec.length(sheared)), hit


def raised(
    terrain: Terrain,
    centre_ws: Float[Array, "3"],
    height: Float[Array, ""],
    tilts: tuple[Float[Array, ""], Float[Array, ""]],
) -> Terrain:
    """The terrain, raised and tilted along up.

    Args:
        terrain: the terrain.
        centre_ws: m, about which it is tilted.
        height: m, by which it is raised there.
        tilts: rad, by which it rises along the world's x and z.
    """
    along_x, along_z = map(jnp.tan, tilts)
    slope_ws = vec.stack(along_x, jnp.zeros_like(along_x), along_z)
    slope_ws = slope_ws - vec.scale(terrain.up_ws, vec.dot(slope_ws, terrain.up_ws))
    surfaces = (RaisedSurface(surface, centre_ws, height, slope_ws) for surface in terrain.surfaces)
    return Terrain(terrain.up_ws, tuple(surfaces))
