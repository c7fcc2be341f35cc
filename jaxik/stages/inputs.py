"""What the stages read: `Inputs` for a frame by itself, a `Moment` where memory advances."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxik.maths.gate import AbstractGate
from jaxik.maths.struct import struct
from jaxik.world.frame import Frame, Sensed
from jaxik.world.skeleton import Rig
from jaxik.world.terrain import LegTerrains, Terrain


@struct
class Inputs:
    """One frame of one character: what every `sense` and `pose` reads."""

    rig: Rig
    terrain: Terrain | LegTerrains
    frame: Frame
    gate: AbstractGate

    def at(self, frame: Frame, faulty: Bool[Array, " legs"] | None = None) -> "Inputs":
        """The inputs of one frame, with what moves of the terrain where it then is.

        Args:
            frame: the animation, where numbers that are not finite have been replaced.
            faulty: legs that had some, and so count as legs that are not there.
        """
        rig = self.rig
        if faulty is not None:
            rig = dataclasses.replace(rig, present=rig.present & ~faulty)
        return Inputs(rig, self.terrain.at(frame.platforms), frame, self.gate)


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
class SensedMoment(Moment):
    """A moment whose frame has been sensed: what the stages after the contact read."""

    sensed: Sensed
    terrain: Terrain | LegTerrains
