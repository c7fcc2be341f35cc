"""One frame with `step`, a whole clip with `run`, part of a clip with `resume`."""

import dataclasses
import functools
from collections.abc import Callable
from typing import TypeVar, cast

import jax
import jax.numpy as jnp

from jaxik.maths.gate import HARD, AbstractGate
from jaxik.stages.inputs import Inputs
from jaxik.world.frame import Frame
from jaxik.world.skeleton import Rig
from jaxik.world.terrain import GivenHits, Hit, LegTerrains, Terrain

from .faults import Faults, clean
from .frames import Clip, OneFrame, Tracks, read_tracks
from .phases import solve
from .requests import OpenProgram, Request, casting, joined, open_terrain, reading
from .shapes import check_inputs, check_state, with_floats_of
from .system import FootIK, Result, State, init

Function = TypeVar("Function", bound=Callable[..., object])


def _jit(**options: str | tuple[str, ...]) -> Callable[[Function], Function]:
    """`jax.jit`, but editors and type checkers still see the function's own signature."""
    return cast(Callable[[Function], Function], functools.partial(jax.jit, **options))


@_jit(static_argnames=("trace", "checked"))
def step(
    ik: FootIK,
    rig: Rig,
    terrain: Terrain | LegTerrains,
    state: State,
    frame: Frame,
    gate: AbstractGate = HARD,
    *,
    trace: bool = False,
    checked: bool = False,
) -> tuple[State, Result]:
    """One frame of one character, for use in a game loop.

    Args:
        ik: the system; its float leaves are its parameters.
        rig: the legs.
        terrain: the terrain, world space; `LegTerrains` where legs differ in their up, and
            `jaxik.world.terrain.from_hits` where somebody else casts the rays.
        state: memory, from `init` or from the previous step.
        frame: the animation. A leg or a frame with numbers that are not finite stays as animated,
            is `faulty` in the result, and leaves no trace in the memory. A `dt` of 0 or less is a
            pause, in which memory stays as it is.
        gate: `Hard` decides as a game does; `Smooth` lets gradients through decisions.
        trace: whether the result contains every stage's output. Handing these out, one buffer per
            leaf, takes a third of a call's time.
        checked: a promise that the frame is finite and its `dt` above 0, as `jaxik.check` finds
            out. Nothing is looked at or held back then, which saves a tenth of the time.

    Returns:
        Memory after the frame, for the next step, and the result.

    Raises:
        ValueError: if an array has a shape that does not fit the legs of the rig, or is that of
            several characters, or the memory is that of another system, or there are hits of other
            rays than the system casts; it says which.
    """
    inputs = Inputs(rig, terrain, frame, gate)
    check_inputs(ik, inputs, clip=False)
    if isinstance(terrain.body, GivenHits):
        program = open_step(ik, inputs, state, checked=checked)
        hits = program.checked(terrain.body.hits)
        after, result = program(reading(hits), ik, inputs, state)
    else:
        after, result = _solve(ik, inputs, state, checked)
    return after, result if trace else dataclasses.replace(result, trace=None)


@_jit()
def step_and_rays(
    ik: FootIK,
    rig: Rig,
    terrain: Terrain | LegTerrains,
    state: State,
    frame: Frame,
    gate: AbstractGate = HARD,
) -> tuple[State, Result, Request, Hit]:
    """`step`, and its rays with what they hit, as `jaxik.world.terrain.from_hits` wants it.

    For the arguments see `step`; the terrain has to cast its rays itself.

    Returns:
        Memory after the frame, the result, all rays (rays) in order, and their hits.

    Raises:
        ValueError: as `step`.
    """
    inputs = Inputs(rig, open_terrain(terrain), frame, gate)
    check_inputs(ik, inputs, clip=False)
    program = open_step(ik, inputs, state)
    cast, rays = casting(terrain.at(frame.platforms)), []

    def answer(request: Request, number: int) -> Hit:
        rays.append((request, cast(request, number)))
        return rays[-1][1]

    after, result = program(answer, ik, inputs, state)
    return after, dataclasses.replace(result, trace=None), *joined(rays)


def open_step(ik: FootIK, inputs: Inputs, state: State, *, checked: bool = False) -> OpenProgram:
    """`step` of these arguments, whose terrain is `GivenHits`, traced: it returns its trace, too.

    Others answer its requests of rays when it is called, with the system, inputs and memory.
    """
    return OpenProgram(functools.partial(_solve, checked=checked), ik, inputs, state)


def _solve(ik: FootIK, inputs: Inputs, state: State, checked: bool) -> tuple[State, Result]:
    """One frame, of arguments whose shapes are right."""
    return solve(OneFrame.after(*_start(ik, inputs, state, checked)))


@_jit(static_argnames="checked")
def resume(
    ik: FootIK,
    rig: Rig,
    terrain: Terrain | LegTerrains,
    state: State,
    frames: Frame,
    gate: AbstractGate = HARD,
    *,
    tracks: Tracks | None = None,
    checked: bool = False,
) -> tuple[State, Result]:
    """A clip, or a part of one, that starts with the memory of what came before.

    Gives what `step` gives for each frame in turn. For the arguments see `step`; the leaves of
    `frames` and of the result have a leading axis of frames.

    Args:
        tracks: parameters that change along the clip, as in `run`.
        checked: a promise that all frames are sound, as in `step`.

    Returns:
        Memory after the last frame, so that the rest can follow, and the result.

    Raises:
        ValueError: as `run`.
    """
    inputs = Inputs(rig, terrain, frames, gate)
    check_inputs(ik, inputs, clip=True)
    values = read_tracks(ik, tracks, frames.dt.shape[0], rig.side.shape[0])
    return solve(Clip(*_start(ik, inputs, state, checked), values))


def _start(
    ik: FootIK, inputs: Inputs, state: State, checked: bool
) -> tuple[FootIK, Inputs, State, Faults | None]:
    """All in the rig's floats, and with sound frames where these were not."""
    check_state(state, init(ik, inputs.rig))
    ik, inputs, state = with_floats_of(inputs.rig, (ik, inputs, state))
    if checked:
        return ik, inputs, state, None
    frame, faults = clean(inputs.frame, inputs.rig.present)
    return ik, dataclasses.replace(inputs, frame=frame), state, faults


@_jit(static_argnames=("block", "checked"))
def run(
    ik: FootIK,
    rig: Rig,
    terrain: Terrain | LegTerrains,
    frames: Frame,
    gate: AbstractGate = HARD,
    *,
    block: int | None = None,
    tracks: Tracks | None = None,
    checked: bool = False,
) -> Result:
    """A clip of one character, from a fresh start.

    It can be jitted, vmapped and differentiated with respect to any argument. For the arguments see
    `step`; the leaves of `frames` and of the result have a leading axis of frames.

    Args:
        block: how many frames to compute at a time, for long clips; None computes all at once. The
            result is the same, but besides arguments and results only one block has to be in
            memory, in reverse mode one block and the state before each.
        tracks: parameters that change along the clip, by dotted name: an array (frames, ...) of
            what the leaf would be in each frame, as `{"pelvis.limit": limits}`. A value that `ik`
            has under that name does nothing. `step` takes another system instead.
        checked: a promise that all frames are sound, as in `step`.

    Raises:
        ValueError: if `block` is less than 1, an array has a wrong shape, as in `step`, or a track
            has an unknown name or another shape; it says which there may be.
    """
    if block is not None and block < 1:
        raise ValueError(
            f"block must be at least 1 frame, or None for all frames at once; got {block}"
        )
    check_inputs(ik, Inputs(rig, terrain, frames, gate), clip=True)
    start, count = init(ik, rig), frames.dt.shape[0]
    if block is None or block >= count:
        return resume(ik, rig, terrain, start, frames, gate, tracks=tracks, checked=checked)[1]
    blocks = count // block
    clip = (frames, read_tracks(ik, tracks, count, rig.side.shape[0]))

    def resume_block(state: State, clip: tuple[Frame, Tracks]) -> tuple[State, Result]:
        frames, values = clip
        return resume(ik, rig, terrain, state, frames, gate, tracks=values, checked=checked)

    split = jax.tree.map(lambda x: x[: blocks * block].reshape(blocks, block, *x.shape[1:]), clip)
    state, results = jax.lax.scan(jax.checkpoint(resume_block), start, split)
    joined = jax.tree.map(lambda x: x.reshape(blocks * block, *x.shape[2:]), results)
    if blocks * block == count:
        return joined
    remainder = resume_block(state, jax.tree.map(lambda x: x[blocks * block :], clip))[1]
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), joined, remainder)
