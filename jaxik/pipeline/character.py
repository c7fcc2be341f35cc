"""A character in a game loop, which hands frames over faster than `step`."""

import jax
import numpy as np

from jaxik.maths.gate import HARD, AbstractGate
from jaxik.world.frame import Frame
from jaxik.world.skeleton import Rig
from jaxik.world.terrain import LegTerrains, Terrain

from .packing import Layout, Packed, layout_of, pack
from .simulation import step
from .system import FootIK, Result, State, init


class Character:
    """One character with its memory, live: call `step` with each frame.

    The results are those of `jaxik.step`. What does not change is handed over once, memory stays
    where it is, and a frame and its result are one vector each, so that a call takes half of the
    time. Characters of the same rules, number of legs and kind of terrain share one compiled
    program. For many characters at once use `jaxik.lanes`.
    """

    def __init__(
        self,
        ik: FootIK,
        rig: Rig,
        terrain: Terrain | LegTerrains,
        gate: AbstractGate = HARD,
        *,
        state: State | None = None,
    ) -> None:
        """Prepares a character.

        Args:
            ik: the system.
            rig: the legs. Frames are computed with its type of floats.
            terrain: the terrain, world space. For another, make another character with the `state`
                of this one.
            gate: how decisions are taken.
            state: memory to go on with; None starts anew.

        Raises:
            ValueError: as `jaxik.init`.
        """
        state = init(ik, rig) if state is None else state
        self._setup, self._state = jax.device_put((pack((ik, rig, terrain, gate)), pack(state)))
        self._floats = rig.side.dtype
        self._layout: Layout | None = None

    @property
    def state(self) -> State:
        """Memory after the last frame."""
        return self._state.unpack()

    def step(self, frame: Frame) -> Result:
        """The next frame, solved.

        Args:
            frame: the animation, preferably as NumPy arrays. The first frame compiles, and so does
                one with arrays of other shapes.

        Returns:
            The result as NumPy arrays, which are read-only; its `trace` is None.

        Raises:
            ValueError: as `jaxik.step`.
        """
        leaves, structure = jax.tree.flatten(frame)
        arrays = [np.asarray(leaf) for leaf in leaves]
        if self._layout is None or not self._layout.fits(arrays, structure):
            self._layout = layout_of(frame, self._floats)
        self._state, result = _step(self._setup, self._state, self._layout.pack(arrays))
        return Packed(tuple(map(np.asarray, result.vectors)), result.layout).unpack()


@jax.jit
def _step(setup: Packed, state: Packed, frame: Packed) -> tuple[Packed, Packed]:
    """`step` of packed arguments. The setup is system, rig, terrain and gate."""
    ik, rig, terrain, gate = setup.unpack()
    after, result = step(ik, rig, terrain, state.unpack(), frame.unpack(), gate)
    return pack(after), pack(result)
