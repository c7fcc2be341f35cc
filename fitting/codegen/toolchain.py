"""Compiles a generated program on this machine, and runs frames through it."""

# pyright: reportArgumentType=false

import ctypes
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxik
from jaxik.pipeline.requests import Request
from jaxik.world.terrain import Hit

from .c_code import filled
from .memory import rows, tree_of
from .program import Program, fields_of

FLAGS = ("-O2",)
LOOP_FILE = "loop.c"
RAY = 8  # words
LOOP = """\
#include "@file.h"

#ifdef __cplusplus
extern "C"
#endif
void @loop(
    const @parameters *parameters, const @rig *rig, const @frame *frame, const @hit *hits,
    const @state *starts, int count, int tracked, @state *states, @ray *rays, @result *result
) {
    @state memory, *state = &memory;
    @work space, *work = &space;
    int i;
    @init(parameters, rig, state);
    for (i = 0; i < count; i++, frame++, hits += @NAME_RAYS, rays += @NAME_RAYS, result++) {
        if (starts) *state = starts[i];
@POINTED
        states[i] = *state;
        parameters += tracked;
    }
}
"""


class Outputs(NamedTuple):
    """What frames give, with a leading axis of frames."""

    states: jaxik.State
    """Memory after each."""
    rays: Request
    """In the order of the program."""
    results: jaxik.Result


def compiler(language: str = "c") -> str | None:
    """The C or C++ compiler of this machine: $CC or $CXX, cc or c++; None if there is none."""
    variable, usual = {"c": ("CC", "cc"), "c++": ("CXX", "c++")}[language]
    return shutil.which(os.environ.get(variable) or usual)


class Compiled:
    """A generated program, compiled and loaded."""

    def __init__(self, program: Program, folder: Path, name: str, command: Sequence[str]) -> None:
        """Compiles the program that `export_c` has written.

        Args:
            program: what `export_c` has returned.
            folder: of its files.
            name: of these.
            command: the compiler and its flags.

        Raises:
            subprocess.CalledProcessError: it has a mistake in C; `stderr` says which.
        """
        self.program = program
        (folder / LOOP_FILE).write_text(filled(LOOP, program, name), encoding="utf-8")
        # Another name each time: a library that is loaded already would be the same one.
        handle, library = tempfile.mkstemp(".so", name, folder)
        os.close(handle)
        files = [f"{name}.c", LOOP_FILE, "-shared", "-fPIC", "-o", library, "-lm"]
        subprocess.run([*command, *files], cwd=folder, check=True, capture_output=True, text=True)
        self.loop = getattr(ctypes.CDLL(library), f"{name}_loop")


class Playback:
    """Frames that a compiled program is to compute, one after another."""

    def __init__(
        self,
        compiled: Compiled,
        setup: tuple[jaxik.FootIK, jaxik.Rig],
        frames: jaxik.Frame,
        hits: Hit,
        starts: jaxik.State | None = None,
        *,
        tracked: bool = False,
    ) -> None:
        """Prepares the frames.

        Args:
            compiled: the program.
            setup: parameters and legs.
            frames: (frames), with the fields of the program's.
            hits: (frames, rays), in the order of `jaxik.step`.
            starts: memory before each frame; None takes that after the frame before.
            tracked: whether the parameters are (frames), since they change.

        Raises:
            ValueError: the frames have other fields than those of the program.
        """
        program, count = compiled.program, len(jax.tree.leaves(frames)[0])
        if jax.tree.structure(frames) != jax.tree.structure(program.trees["frame"]):
            raise ValueError(
                f"frames have the fields {_names(frames)}; wanted those of the program: "
                f"{_names(program.trees['frame'])}"
            )
        parts = (hits.point, hits.normal, hits.found, hits.platform)
        flat = [
            np.asarray(part)[:, program.order].reshape(-1, *part.shape[2:])
            for part in parts
            if part is not None
        ]
        ik, rig = (jax.tree.map(lambda leaf: np.asarray(leaf)[None], tree) for tree in setup)
        ik = setup[0] if tracked else ik
        self._inputs = [rows(tree) for tree in (ik, rig, frames, flat)]
        self._inputs += [] if starts is None else [rows(starts)]
        sizes = [len(program.places["state"]), RAY * program.ray_count]
        sizes.append(len(program.places["result"]))
        self._outputs = [np.zeros((count, size), np.uint32) for size in sizes]
        pointers = [x.ctypes.data_as(ctypes.c_void_p) for x in (*self._inputs, *self._outputs)]
        missing = [None] if starts is None else []
        counts = ctypes.c_int(count), ctypes.c_int(tracked)
        self._arguments = [*pointers[:-3], *missing, *counts, *pointers[-3:]]
        self._compiled = compiled
        self.program = program

    def __call__(self) -> None:
        """Computes all frames."""
        self._compiled.loop(*self._arguments)

    def outputs(self) -> Outputs:
        """What the last call has computed."""
        trees = self.program.trees
        states, words, results = self._outputs
        words = words.reshape(len(words), -1, RAY)
        floats = words.view(np.float32)
        parts = (floats[..., :3], -floats[..., 3:6], floats[..., 6], words[..., 7])
        rays = Request(*map(jnp.asarray, parts))
        return Outputs(tree_of(states, trees["state"]), rays, tree_of(results, trees["result"]))


def _names(frames: jaxik.Frame) -> list[str]:
    return [".".join(field.path) for field in fields_of(frames)]


def code_size(compiler: str, folder: Path, name: str) -> int:
    """Bytes of the machine code of a program, with its constants, at `FLAGS`.

    Raises:
        subprocess.CalledProcessError: it has a mistake in C.
    """
    object_file = folder / f"{name}.o"
    command = [compiler, *FLAGS, "-c", f"{name}.c", "-o", object_file.name]
    subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True)
    sizes = subprocess.run(
        ["size", object_file.name], cwd=folder, check=True, capture_output=True, text=True
    )
    return int(sizes.stdout.split("\n")[1].split()[0])
