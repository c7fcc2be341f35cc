"""What the stages read: `Inputs` for a frame by itself, a `Moment` where memory advances."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxik.maths.gate import AbstractGate
from jaxik.maths.struct import struct
from jaxik.world import places
from jaxik.world.frame import Frame, Sensed, bearing
from jaxik.world.skeleton import Rig, Transform
from jaxik.world.terrain import LegTerrains, Terrain

GRAVITY = 9.81  # m/s²
STAIRS = 0.75  # rise over run of the steepest stairs


@struct
class Inputs:
    """One frame of one character: what every `sense` and `pose` reads."""

    rig: Rig
    terrain: Terrain | LegTerrains
    frame: Frame
    gate: AbstractGate
    centre_ws: Float[Array, "3"] | None = None
    """m, where world space has its origin now; None where that has not changed."""
    foot_heading_ws: tuple[Float[Array, "legs 3"], Float[Array, "legs 3"]] | None = None
    """`jaxik.stages.probe.foot_heading`, for all stages at once; None where each computes it.

    Without it, programs of `stride` take a seventh longer to compile.
    """

    @property
    def bearing(self) -> Float[Array, "*legs"]:
        """0..1, how far each leg bears the body; see `jaxik.world.frame.bearing`."""
        return bearing(self.terrain.leg_up_ws, self.terrain.up_ws)

    def at(self, frame: Frame, faulty: Bool[Array, " legs"] | None = None) -> "Inputs":
        """The inputs of one frame, with what moves of the terrain where it then is.

        World space has its origin at `places.centre_about` the character from here on.

        Args:
            frame: the animation, where numbers that are not finite have been replaced.
            faulty: legs that had some, and so count as legs that are not there.
        """
        rig = self.rig if frame.rig is None else frame.rig
        if faulty is not None:
            rig = dataclasses.replace(rig, present=rig.present & ~faulty)
        centre_ws = places.centre_about(frame.world_from_model.pos)
        ground = self.ground(frame.platforms, centre_ws)
        if centre_ws is not None:
            frame = places.moved(frame, -centre_ws, ground.up_ws, ground.leg_up_ws)
        return Inputs(rig, ground, frame, self.gate, centre_ws)

    def ground(
        self, platforms: Transform, centre_ws: Float[Array, "3"] | None
    ) -> Terrain | LegTerrains:
        """The terrain where the platforms are, in world space with its origin at the centre."""
        ground = self.terrain.at(platforms)
        return ground if centre_ws is None else ground.moved(-centre_ws)


@struct
class Moment:
    """What every `advance` reads, whatever its stage remembers."""

    dt: Float[Array, ""]
    """s, since the frame before."""
    started: Bool[Array, ""]
    """False on the first frame, where memory jumps to its goals."""
    gate: AbstractGate

    def progress(self, fraction: Array) -> Array:
        """How far memory moves towards its goal: `fraction`, 0..1, or all the way at the start."""
        return jnp.where(self.started, fraction, 1.0)


@struct
class GroundMoment(Moment):
    """A moment in which the ground can be looked for: what the stages before the sensing read."""

    terrain: Terrain | LegTerrains


@struct
class SensedMoment(Moment):
    """A moment whose frame has been sensed: what the stages after the contact read."""

    sensed: Sensed
    terrain: Terrain | LegTerrains
