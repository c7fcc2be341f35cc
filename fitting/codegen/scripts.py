"""Programs as scripts that pages run, which are cached beside compiled programs."""

import json
import os
from collections.abc import Callable, Hashable, Mapping
from contextlib import suppress
from typing import NamedTuple

import jax

import jaxik
from fitting.runtime import cache_folder, files, program_cache
from fitting.runtime.plain_tree import NotPlainError
from jaxik.world.terrain import LegTerrains, Terrain

from . import js_code
from .program import blank_rig, build

_scripts: dict[Hashable, "Script"] = {}  # in this process


class Script(NamedTuple):
    """A system whose numbers are inputs."""

    code: str
    """Of an object `system`; see `js_code.script`."""
    places: Mapping[str, Mapping[str, int]]
    """At which number of its struct a field begins, by struct and by dotted name."""


def script(
    ik: jaxik.FootIK, legs: int, terrain: Terrain | LegTerrains, frame: jaxik.Frame
) -> Script:
    """The script of a system; it is written anew only if none of its kind is cached.

    Args:
        ik: the system, whose numbers do not matter.
        legs: how many a character has.
        terrain: whose up directions are fixed, and which says how many platforms there are.
        frame: a single one with the fields that there are to be.

    Raises:
        ValueError: the system cannot be exported; see `program.build`.
    """
    ups = [ground.up_ws.tolist() for ground in (terrain, *getattr(terrain, "legs", ()))]
    rest = legs, terrain.platform_count, json.dumps(ups)
    shapes = tuple((leaf.shape, leaf.dtype) for leaf in jax.tree.leaves((ik, frame)))
    here = jax.tree.structure((ik, frame)), shapes, rest
    if here not in _scripts:
        try:
            key = program_cache.program_key(script, ((ik, frame, rest), {}))
            _scripts[here] = _cached(key, lambda: _make(ik, legs, terrain, frame))
        except NotPlainError:  # a rule of the user's own, which may change
            _scripts[here] = _make(ik, legs, terrain, frame)
    return _scripts[here]


def _cached(key: str, make: Callable[[], Script]) -> Script:
    """The script with this key on disk, or a new one, which is then written there."""
    try:
        path = cache_folder.traced() / f"script-{key}"
    except (cache_folder.SwitchedOffError, OSError):
        return make()
    try:
        with path.open(encoding="utf-8") as file:
            cache_folder.check_own(path, os.fstat(file.fileno()))
            return Script(**json.load(file))
    except (OSError, ValueError, TypeError):  # there is none, or it is damaged
        new = make()
        with suppress(OSError, ValueError):  # the disk is full, or the like
            files.write_text(path, json.dumps(new._asdict()))
        return new


def _make(
    ik: jaxik.FootIK, legs: int, terrain: Terrain | LegTerrains, frame: jaxik.Frame
) -> Script:
    program = build(ik, blank_rig(legs), terrain, frame)
    places = {
        struct: {".".join(path): start for path, start in js_code.starts(program, struct).items()}
        for struct in program.trees
    }
    return Script(js_code.script(program), places)
