"""Writes a system as C: a header, its functions and, where asked for, a trace and its check."""

import functools
import re
from pathlib import Path
from typing import NamedTuple

import jax

import jaxik
from fitting.runtime import activity, files
from jaxik.world.terrain import LegTerrains, Terrain

from . import c_code, header, trace
from .program import Program, build

NAME = re.compile(r"[a-z][a-z0-9_]*")
CHECK, TRACE = "check.c", "trace.bin"
PRELUDE = """\
#include <math.h>

#include "@file.h"

#ifdef __FAST_MATH__
#error "compile without -ffast-math: numbers may be infinite"
#endif
#if defined(__GNUC__) && defined(__SSE__)
#include <xmmintrin.h>
#define @SSE
#endif
#ifdef __GNUC__
#define @APART __attribute__((noinline))
#else
#define @APART
#endif
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize("no-thread-jumps") /* or minima and maxima become branches */
#endif

"""


class GoldenTrace(NamedTuple):
    """A clip on its ground, of which a golden trace is to be written."""

    terrain: Terrain | LegTerrains
    frames: jaxik.Frame


def export_c(
    ik: jaxik.FootIK,
    rig: jaxik.Rig,
    folder: str | Path,
    *,
    name: str = "footik",
    terrain: Terrain | LegTerrains | None = None,
    frame: jaxik.Frame | None = None,
    golden: GoldenTrace | None = None,
) -> Program:
    """Writes a system as `NAME.h` and `NAME.c`: C99 that is also C++11, and needs `math.h` only.

    Its answers are those of `jaxik.step` with hard decisions in 32 bits, but for rounding. The
    engine casts the rays; the header says how. Parameters stay inputs.

    Args:
        ik: the system.
        rig: the legs. How many there are is fixed, their measures are inputs.
        folder: where the files go; it is made if missing.
        name: of the files, and prefix of all names in them.
        terrain: whose up directions and number of platforms are fixed; None is that of the trace
            or, without one, still ground under (0, 1, 0).
        frame: a single frame with the optional fields that the C frame is to have; None takes those
            of the trace or none, and a `restart`.
        golden: writes a golden trace of this clip, and `check.c`, which compares it.

    Returns:
        What has been written, as a graph.

    Raises:
        ValueError: the system has an operation without a rule, such as a loop, its arrays do not
            fit the legs, the name cannot stand in C, or a file cannot be written.
    """
    if not NAME.fullmatch(name):
        raise ValueError(f"name is {name!r}; wanted small letters, digits and underscores")
    folder = Path(folder)
    if golden is not None:
        golden = golden._replace(frames=trace.with_restart(golden.frames))
        terrain = golden.terrain if terrain is None else terrain
        if frame is None:
            frame = jax.tree.map(lambda leaf: leaf[0], golden.frames)
    with activity.announced("Generating C"):
        program = build(ik, rig, terrain, frame)
        sources = texts(program, name)
    folder.mkdir(parents=True, exist_ok=True)
    for file, text in sources.items():
        files.write_text(folder / file, text)
    if golden is not None:
        with activity.announced("Recording the golden trace"):
            content = trace.record(program, rig, *golden)
        files.write(folder / TRACE, lambda path: path.write_bytes(content))
        files.write_text(folder / CHECK, check(program, name))
    return program


def texts(program: Program, name: str) -> dict[str, str]:
    """The header and the functions, by the names of their files."""
    schedule = program.schedule()
    parts = [header.defaults(program), *c_code.functions(program, schedule)]
    contents = {
        f"{name}.h": header.text(program, schedule),
        f"{name}.c": PRELUDE + "\n\n".join(parts) + "\n",
    }
    return {file: filled(text, program, name) for file, text in contents.items()}


def check(program: Program, name: str) -> str:
    """A program in C that replays a trace of this one."""
    template = Path(__file__).with_name(CHECK).read_text(encoding="utf-8")
    return filled(template, program, name)


def filled(template: str, program: Program, name: str) -> str:
    """A text in C with the names of a program, and the calls of a frame, in it."""
    fillings = {
        "@CALLS": "\n".join(header.calls(program, "        ")),
        "@POINTED": "\n".join(header.calls(program, "        ", "")),
        "@NAME": name.upper(),
        "@file": name,
        "@": f"{name}_",
    }
    return functools.reduce(lambda text, pair: text.replace(*pair), fillings.items(), template)
