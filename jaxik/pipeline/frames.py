"""Where `phases.solve` gets its frames: one at a time with `OneFrame`, a clip with `Clip`.

They know all that the algorithm does not: scans over a clip, frames that are faulty, starts and
restarts, tracks of parameters, and the centre about which places are exact.
"""

import dataclasses
import functools
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxik.maths.struct import struct
from jaxik.stages.inputs import Inputs, Moment, SensedMoment
from jaxik.world.frame import Frame, Sensed
from jaxik.world.places import centre_about
from jaxik.world.skeleton import Rig

from .centring import recentred
from .faults import Faults, per_leg, remembered
from .system import Advanced, FootIK, State, fresh_memory, restarted
from .tracks import Tracks, system_at

OfFrame: TypeAlias = Callable[..., Any]
"""A function of the system, the inputs and then whatever else a frame has."""
Advance: TypeAlias = Callable[[FootIK, SensedMoment, State, PyTree], Advanced]


class Ahead(NamedTuple):
    """A stage that has advanced before the frame is sensed."""

    state: PyTree
    """Its memory after the frame."""
    output: PyTree


@dataclasses.dataclass(frozen=True)
class AbstractFrames(ABC):
    """A frame, or all frames of a clip."""

    ik: FootIK
    inputs: Inputs
    state: State
    """Memory before the first of them."""
    faults: Faults | None
    """None takes the frames as they are."""

    @abstractmethod
    def each(self, function: OfFrame, *others: PyTree) -> Any:
        """What a function gives for each frame; `others` have a value for each, too."""

    @abstractmethod
    def ahead(self, stage: str, sense: OfFrame, *others: PyTree) -> Ahead:
        """A stage whose memory advances before all else, by what `sense` gives for each frame."""

    @abstractmethod
    def advance(self, advance: Advance, sensed: Sensed, ahead: PyTree) -> tuple[State, Advanced]:
        """All other stages with memory: after the last frame, and after each.

        Args:
            advance: of one frame.
            sensed: the frames.
            ahead: memory of the stages that have advanced already.
        """

    def of_legs(self) -> PyTree:
        """Which memory belongs to single legs, for frames in which one of them is faulty."""
        return self.faults and per_leg(functools.partial(fresh_memory, self.ik), self.inputs.rig)


class OneFrame(AbstractFrames):
    """A single frame, with the memory of those before."""

    @classmethod
    def after(
        cls, ik: FootIK, inputs: Inputs, state: State, faults: Faults | None, fresh: State
    ) -> "OneFrame":
        """The frame that follows one with this memory; `fresh` is that before any frame."""
        state = restarted(state, fresh, inputs.frame.restart)
        inputs = inputs.at(inputs.frame, faults and faults.legs)
        return cls(ik, inputs, recentred(state, inputs.centre_ws, inputs.terrain, faults), faults)

    def each(self, function: OfFrame, *others: PyTree) -> Any:
        return function(self.ik, self.inputs, *others)

    def ahead(self, stage: str, sense: OfFrame, *others: PyTree) -> Ahead:
        now = Moment(self.inputs.frame.dt, self.state.started, self.inputs.gate)
        with jax.named_scope(stage):
            sensed = sense(self.ik, self.inputs, *others)
            return Ahead(*getattr(self.ik, stage).advance(now, sensed, getattr(self.state, stage)))

    def advance(self, advance: Advance, sensed: Sensed, ahead: PyTree) -> tuple[State, Advanced]:
        before, inputs = self.state, self.inputs
        now = SensedMoment(sensed.dt, before.started, inputs.gate, sensed, inputs.terrain)
        advanced = advance(self.ik, now, before, ahead)
        after = remembered(now, before, advanced.state, self.of_legs(), self.faults)
        return after, dataclasses.replace(advanced, state=after)


@struct
class _MemoryAhead:
    """Memory of a stage that runs before everything else."""

    started: Bool[Array, ""]
    centre_ws: Float[Array, "3"]
    memory: PyTree


@dataclasses.dataclass(frozen=True)
class Clip(AbstractFrames):
    """A clip: leaves of frames have a leading axis.

    What has no memory is computed for all frames at once, and so are stages whose rule has none.
    Each of the stages ahead has a scan of its own, all others have one together.
    """

    fresh: State
    """Memory before any frame."""
    tracks: Tracks
    """Parameters that change along the clip."""

    def each(self, function: OfFrame, *others: PyTree) -> Any:
        def of_frame(frame: Frame, faults: Faults | None, at: Tracks, *others: PyTree) -> PyTree:
            inputs = self.inputs.at(frame, faults and faults.legs)
            return function(system_at(self.ik, at), inputs, *others)

        return jax.vmap(of_frame)(self.inputs.frame, self.faults, self.tracks, *others)

    def ahead(self, stage: str, sense: OfFrame, *others: PyTree) -> Ahead:
        with jax.named_scope(stage):
            return self._ahead(stage, self.each(sense, *others))

    def _ahead(self, stage: str, sensed: PyTree) -> Ahead:
        frames, state, gate = self.inputs.frame, self.state, self.inputs.gate
        memory = getattr(state, stage)

        def advance(now: Moment, sensed: PyTree, memory: PyTree, at: Tracks) -> Ahead:
            return Ahead(*getattr(system_at(self.ik, at), stage).advance(now, sensed, memory))

        if not jax.tree.leaves(memory):

            def instant(dt: Array, sensed: PyTree, at: Tracks) -> PyTree:
                return advance(Moment(dt, state.started, gate), sensed, memory, at).output

            return Ahead(memory, jax.vmap(instant)(frames.dt, sensed, self.tracks))

        def scanned(before: _MemoryAhead, frame: tuple) -> tuple[_MemoryAhead, Ahead]:
            sensed, dt, centre_ws, faults, at, restart = frame
            before = restarted(before, fresh, restart)
            before = recentred(before, centre_ws, self.inputs.terrain, faults)
            now = Moment(dt, before.started, gate)
            after, output = advance(now, sensed, before.memory, at)
            after = _MemoryAhead(jnp.ones_like(before.started), before.centre_ws, after)
            after = remembered(now, before, after, of_legs, faults)
            return after, Ahead(after.memory, output)

        def begin(rig: Rig) -> _MemoryAhead:
            started, centre_ws = (jnp.zeros_like(x) for x in (state.started, state.centre_ws))
            return _MemoryAhead(started, centre_ws, getattr(self.ik, stage).init(rig))

        rig = self.inputs.rig
        fresh, of_legs = begin(rig), self.faults and per_leg(begin, rig)
        before = _MemoryAhead(state.started, state.centre_ws, memory)
        return jax.lax.scan(scanned, before, self._with(sensed))[1]

    def advance(self, advance: Advance, sensed: Sensed, ahead: PyTree) -> tuple[State, Advanced]:
        inputs, of_legs = self.inputs, self.of_legs()

        def scanned(state: State, frame: tuple) -> tuple[State, Advanced]:
            (sensed, ahead, platforms), dt, centre_ws, faults, at, restart = frame
            state = restarted(state, self.fresh, restart)
            state = recentred(state, centre_ws, inputs.terrain, faults)
            ground = inputs.ground(platforms, centre_ws)
            now = SensedMoment(dt, state.started, inputs.gate, sensed, ground)
            advanced = advance(system_at(self.ik, at), now, state, ahead)
            after = remembered(now, state, advanced.state, of_legs, faults)
            return after, dataclasses.replace(advanced, state=after)

        clip = self._with((sensed, ahead, inputs.frame.platforms))
        return jax.lax.scan(scanned, self.state, clip)

    def _with(self, values: PyTree) -> tuple:
        """What a scan takes: values of each frame, and what each has besides."""
        frames = self.inputs.frame
        centres = centre_about(frames.world_from_model.pos)
        return values, frames.dt, centres, self.faults, self.tracks, frames.restart
