"""Where `phases.solve` gets its frames: one at a time with `OneFrame`, a clip with `Clip`.

They know all that the algorithm does not: scans over a clip, frames that are faulty, starts and
restarts, tracks of parameters, and the centre about which places are exact.
"""

import dataclasses
import difflib
import functools
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jaxik.maths import parameter_tree
from jaxik.maths.struct import struct
from jaxik.stages.inputs import GroundMoment, Inputs, Moment, SensedMoment
from jaxik.world import places
from jaxik.world.frame import Frame, Sensed
from jaxik.world.skeleton import Rig
from jaxik.world.terrain import LegTerrains, Terrain

from .faults import Faults, per_leg, remembered
from .shapes import BATCHES
from .system import Advanced, FootIK, State, fresh_memory, restarted

Tracks: TypeAlias = Mapping[str, Array]
"""By dotted name of a parameter what it is in each frame, as by the states of an animation."""
OfFrame: TypeAlias = Callable[..., Any]
"""A function of the system, the inputs and then whatever else a frame has."""
Step: TypeAlias = Callable[..., tuple[Any, Any]]
Keep: TypeAlias = Callable[[Any], Any]
Advance: TypeAlias = Callable[[FootIK, SensedMoment, State, PyTree], Advanced]


class Ahead(NamedTuple):
    """A stage that has advanced before the frame is sensed."""

    state: PyTree
    """Its memory after the frame."""
    output: PyTree


@struct
class _MemoryAhead:
    """Memory of a stage that runs before everything else."""

    started: Bool[Array, ""]
    centre_ws: Float[Array, "3"]
    memory: PyTree


Memory = TypeVar("Memory", State, _MemoryAhead)


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


class OneFrame(AbstractFrames):
    """A single frame, with the memory of those before."""

    @classmethod
    def after(cls, ik: FootIK, inputs: Inputs, state: State, faults: Faults | None) -> "OneFrame":
        """The frame that follows one with this memory."""
        state = restarted(state, fresh_memory(ik, inputs.rig), inputs.frame.restart)
        inputs = inputs.at(inputs.frame, faults and faults.legs)
        return cls(ik, inputs, recentred(state, inputs.centre_ws, inputs.terrain, faults), faults)

    def each(self, function: OfFrame, *others: PyTree) -> Any:
        return function(self.ik, self.inputs, *others)

    def ahead(self, stage: str, sense: OfFrame, *others: PyTree) -> Ahead:
        inputs = self.inputs
        now = GroundMoment(inputs.frame.dt, self.state.started, inputs.gate, inputs.terrain)
        with jax.named_scope(stage):
            sensed = sense(self.ik, inputs, *others)
            return Ahead(*getattr(self.ik, stage).advance(now, sensed, getattr(self.state, stage)))

    def advance(self, advance: Advance, sensed: Sensed, ahead: PyTree) -> tuple[State, Advanced]:
        before, inputs = self.state, self.inputs
        now = SensedMoment(inputs.frame.dt, before.started, inputs.gate, sensed, inputs.terrain)
        advanced = advance(self.ik, now, before, ahead)
        of_legs = self.faults and per_leg(functools.partial(fresh_memory, self.ik), inputs.rig)
        after = remembered(now, before, advanced.state, of_legs, self.faults)
        return after, dataclasses.replace(advanced, state=after)


@dataclasses.dataclass(frozen=True)
class Clip(AbstractFrames):
    """A clip: leaves of frames have a leading axis.

    What has no memory is computed for all frames at once, and so are stages whose rule has none.
    Each of the stages ahead has a scan of its own, all others have one together.
    """

    tracks: Tracks
    """Parameters that change along the clip."""

    @property
    def _centres(self) -> Float[Array, "frames 3"] | None:
        """m, about which the places of each frame are."""
        return places.centre_about(self.inputs.frame.world_from_model.pos)

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

            def instant(dt: Array, sensed: PyTree, at: Tracks, *whereabouts: Any) -> PyTree:
                now = GroundMoment(dt, state.started, gate, self.inputs.ground(*whereabouts))
                return advance(now, sensed, memory, at).output

            whereabouts = frames.platforms, self._centres
            return Ahead(memory, jax.vmap(instant)(frames.dt, sensed, self.tracks, *whereabouts))

        if not jax.tree.leaves(sensed):  # a frame without what the stage goes by costs nothing
            count = len(frames.dt)
            return Ahead(
                jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), memory), None
            )

        def begin(rig: Rig) -> _MemoryAhead:
            started, centre_ws = (jnp.zeros_like(x) for x in (state.started, state.centre_ws))
            return _MemoryAhead(started, centre_ws, getattr(self.ik, stage).init(rig))

        def step(
            at: Tracks, now: Moment, before: _MemoryAhead, frame: tuple, keep: Keep
        ) -> tuple[_MemoryAhead, Ahead]:
            sensed, *whereabouts = frame
            ground = self.inputs.ground(*whereabouts)
            ground_now = GroundMoment(now.dt, now.started, now.gate, ground)
            after, output = advance(ground_now, sensed, before.memory, at)
            after = keep(_MemoryAhead(jnp.ones_like(now.started), before.centre_ws, after))
            return after, Ahead(after.memory, output)

        before = _MemoryAhead(state.started, state.centre_ws, memory)
        return self._scan(step, begin, before, (sensed, frames.platforms, self._centres))[1]

    def advance(self, advance: Advance, sensed: Sensed, ahead: PyTree) -> tuple[State, Advanced]:
        def step(
            at: Tracks, now: Moment, before: State, frame: tuple, keep: Keep
        ) -> tuple[State, Advanced]:
            sensed, ahead, *whereabouts = frame
            ground = self.inputs.ground(*whereabouts)
            sensed_now = SensedMoment(now.dt, now.started, now.gate, sensed, ground)
            advanced = advance(system_at(self.ik, at), sensed_now, before, ahead)
            after = keep(advanced.state)
            return after, dataclasses.replace(advanced, state=after)

        begin = functools.partial(fresh_memory, self.ik)
        frames = sensed, ahead, self.inputs.frame.platforms, self._centres
        return self._scan(step, begin, self.state, frames)

    def _scan(
        self, step: Step, begin: Callable[[Rig], Memory], memory: Memory, values: PyTree
    ) -> tuple[Memory, Any]:
        """Memory after the last frame, and what `step` puts out for each.

        Args:
            step: memory after a frame, and an output, by the frame's tracks, its moment, memory
                before it, its values, and what keeps that memory where the frame is of no use.
            begin: memory before any frame.
            memory: before the clip.
            values: of each frame.
        """
        inputs, frames = self.inputs, self.inputs.frame
        fresh, of_legs = begin(inputs.rig), self.faults and per_leg(begin, inputs.rig)

        def scanned(before: Memory, frame: tuple) -> tuple[Memory, Any]:
            values, dt, centre_ws, faults, at, restart = frame
            before = restarted(before, fresh, restart)
            before = recentred(before, centre_ws, inputs.terrain, faults)
            now = Moment(dt, before.started, inputs.gate)
            keep = functools.partial(remembered, now, before, of_legs=of_legs, faults=faults)
            return step(at, now, before, values, keep)

        clip = values, frames.dt, self._centres, self.faults, self.tracks, frames.restart
        return jax.lax.scan(scanned, memory, clip)


def recentred(
    memory: Memory,
    centre_ws: Float[Array, "3"] | None,
    terrain: Terrain | LegTerrains,
    faults: Faults | None,
) -> Memory:
    """Memory with its places about the centre of a frame, m; None leaves it as it is.

    A frame that is of no use has no place either: the memory stays where it is.
    """
    if centre_ws is None:
        return memory
    if faults is not None:
        centre_ws = jnp.where(faults.frame, memory.centre_ws, centre_ws)
    # Before the first frame memory is 0, which is better near the goals that it then jumps to.
    by_ws = jnp.where(memory.started, memory.centre_ws - centre_ws, 0.0)
    memory = places.moved(memory, by_ws, terrain.up_ws, terrain.leg_up_ws)
    return dataclasses.replace(memory, centre_ws=centre_ws)


def read_tracks(ik: FootIK, tracks: Tracks | None, frames: int, legs: int) -> dict[str, Array]:
    """The tracks as arrays.

    Args:
        ik: the system.
        tracks: by dotted name an array (frames, ...) of values that the leaf may have; None has no
            effect.
        frames: number of frames in the clip.
        legs: number of legs of the rig.

    Raises:
        ValueError: a name that the system does not have, or an array of another shape; it says
            which names or shapes there may be.
    """
    slots = {slot.name: slot for slot in parameter_tree.slots(ik)}
    arrays: dict[str, Array] = {}
    for name, values in (tracks or {}).items():
        if name not in slots:
            nearest = difflib.get_close_matches(name, slots, n=1, cutoff=0.0)
            raise ValueError(
                f"tracks: no parameter named {name!r}; nearest is {nearest[0]!r}; "
                f"there are {sorted(slots)}"
            )
        slot, shape = slots[name], np.shape(values)
        shapes = [(frames, *slot.shape)]
        if slot.per_leg:
            shapes.append((frames, legs, *slot.shape))
        if shape not in shapes:
            wanted = " or ".join(map(str, shapes))
            raise ValueError(
                f"tracks[{name!r}] has shape {shape}, wanted {wanted}: {frames} frames in "
                f"frames.dt, {legs} legs in rig.side; {BATCHES}"
            )
        arrays[name] = jnp.asarray(values)
    return arrays


def system_at(ik: FootIK, values: Tracks) -> FootIK:
    """The system with the values that its tracks have in one frame."""
    return parameter_tree.replace(ik, values) if values else ik
