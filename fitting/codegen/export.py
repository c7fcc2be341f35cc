"""Writes a system in another language, with a trace and its check where asked for."""

# pyright: reportArgumentType=false

import dataclasses
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

import jaxik
from fitting.runtime import activity, files
from fitting.runtime.precision import with_floats
from jaxik.pipeline import step_and_rays
from jaxik.world.terrain import LegTerrains, Terrain

from . import c_code, cs_code, js_code
from .axes import ENGINES
from .memory import doubles, rows
from .program import Program, build

# Golden traces: frames of a clip with what the rays hit, and the results of a system in JAX.

Pack: TypeAlias = Callable[[PyTree], np.ndarray]
"""Makes structs, a row each, of a tree whose leaves have one more axis in front."""


def with_restart(frames: jaxik.Frame) -> jaxik.Frame:
    """The frames with a `restart`, which a program made for them then has."""
    if frames.restart is not None:
        return frames
    return dataclasses.replace(frames, restart=jnp.zeros(frames.dt.shape, bool))


def record(
    program: Program,
    rig: jaxik.Rig,
    terrain: Terrain | LegTerrains,
    frames: jaxik.Frame,
    *,
    wide: bool = False,
) -> bytes:
    """The trace of a clip: parameters and rig, then of each frame all that a check compares.

    Those are the frame, its rays, their hits and the result, as the structs of the program are in
    memory.

    Args:
        program: of the system.
        rig: the legs of the clip.
        terrain: onto which the rays are cast.
        frames: the clip, with the fields of the program's frames.
        wide: whether JAX computes in 64 bits, and each number is one of them; else in 32.
    """
    with jax.enable_x64(wide):
        setup = with_floats((program.ik, rig), jnp.float32)  # as they are in the program
        trees = setup, with_floats((terrain, frames), jnp.float32)
        (ik, rig), (terrain, frames) = with_floats(trees, jnp.float64) if wide else trees
        pack = doubles if wide else rows
        return _struct(pack, (ik, rig)) + b"".join(_frames(program, pack, ik, rig, terrain, frames))


def _frames(
    program: Program,
    pack: Pack,
    ik: jaxik.FootIK,
    rig: jaxik.Rig,
    terrain: Terrain | LegTerrains,
    frames: jaxik.Frame,
) -> Iterator[bytes]:
    state = jaxik.init(ik, rig)
    for number in range(len(frames.dt)):
        frame = jax.tree.map(lambda leaf, i=number: leaf[i], frames)
        state, result, rays, hits = step_and_rays(ik, rig, terrain, state, frame)
        yield _struct(pack, frame)
        for parts in (
            (rays.origins_ws, -rays.up_ws, rays.length, rays.layers),
            (hits.point, hits.normal, hits.found, hits.platform),
        ):
            yield pack(jax.tree.map(lambda leaf: np.asarray(leaf)[program.order], parts)).tobytes()
        yield _struct(pack, result)


def _struct(pack: Pack, tree: PyTree) -> bytes:
    return pack(jax.tree.map(lambda leaf: np.asarray(leaf)[None], tree)).tobytes()


NAME = re.compile(r"[a-z][a-z0-9_]*")
TAKEN = ("check", "walk")  # by the programs that come with a trace
TRACE = "trace.bin"


class Language(NamedTuple):
    """What writes the files of a program: their texts by their names."""

    sources: Callable[[Program, str, str | None], dict[str, str]]
    """Of a program, the prefix of all names, and the engine whose axes it converts."""
    check: Callable[[Program, str], dict[str, str]]
    """What replays a golden trace."""
    wide: bool
    """Whether its floats, and those of the trace, have 64 bits."""


LANGUAGES = {
    "c": Language(c_code.sources, c_code.check, wide=False),
    "cs": Language(cs_code.sources, cs_code.check, wide=False),
    "js": Language(js_code.sources, js_code.check, wide=True),
}


class GoldenTrace(NamedTuple):
    """A clip on its ground, of which a golden trace is to be written."""

    terrain: Terrain | LegTerrains
    frames: jaxik.Frame


def export_system(
    ik: jaxik.FootIK,
    rig: jaxik.Rig,
    folder: str | Path,
    *,
    language: str = "c",
    name: str = "footik",
    axes: str | None = None,
    terrain: Terrain | LegTerrains | None = None,
    frame: jaxik.Frame | None = None,
    golden: GoldenTrace | None = None,
) -> Program:
    """Writes a system in another language.

    "c", `NAME.h` and `NAME.c`, is C99 that is also C++11; "cs", `Name.cs`, is C# 7.2 for Unity;
    "js", `NAME.mjs`, is a module of JavaScript for browsers and node, whose floats have 64 bits.
    Its answers are those of `jaxik.step` with hard decisions in 32 bits, but for rounding. The
    engine casts the rays; the comments say how. Parameters stay inputs.

    Args:
        ik: the system.
        rig: the legs. How many there are is fixed, their measures are inputs.
        folder: where the files go; it is made if missing.
        language: one of `LANGUAGES`.
        name: of the files, and prefix of all names in them.
        axes: one of `axes.ENGINES`, for conversions from and to its axes; None writes none.
        terrain: whose up directions and number of platforms are fixed; None is that of the trace
            or, without one, still ground under (0, 1, 0).
        frame: a single frame with the optional fields that the written frame is to have; None takes
            those of the trace or none, and a `restart`.
        golden: writes a golden trace of this clip, and a program that compares it.

    Returns:
        What has been written, as a graph.

    Raises:
        ValueError: the system has an operation without a rule, such as a loop, its arrays do not
            fit the legs, the name cannot stand in code, or a file cannot be written.
    """
    if language not in LANGUAGES:
        raise ValueError(f"language is {language!r}; wanted one of {list(LANGUAGES)}")
    if not NAME.fullmatch(name) or name in TAKEN:
        raise ValueError(
            f"name is {name!r}; wanted small letters, digits and underscores, but not "
            f"{' or '.join(TAKEN)}"
        )
    if axes is not None and axes not in ENGINES:
        raise ValueError(f"axes is {axes!r}; wanted one of {list(ENGINES)}")
    folder = Path(folder)
    if golden is not None:
        golden = golden._replace(frames=with_restart(golden.frames))
        terrain = golden.terrain if terrain is None else terrain
        if frame is None:
            frame = jax.tree.map(lambda leaf: leaf[0], golden.frames)
    with activity.announced("Generating code"):
        program = build(ik, rig, terrain, frame)
        texts = LANGUAGES[language].sources(program, name, axes)
    folder.mkdir(parents=True, exist_ok=True)
    if golden is not None:
        texts |= LANGUAGES[language].check(program, name)
        with activity.announced("Recording the golden trace"):
            content = record(program, rig, *golden, wide=LANGUAGES[language].wide)
        files.write(folder / TRACE, lambda path: path.write_bytes(content))
    for file, text in texts.items():
        files.write_text(folder / file, text)
    return program


def export_c(ik: jaxik.FootIK, rig: jaxik.Rig, folder: str | Path, **options: Any) -> Program:
    """`export_system` in C."""
    return export_system(ik, rig, folder, language="c", **options)
