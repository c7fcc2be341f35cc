"""Files of traced programs.

    jaxik program 1                  format and its version, in a line
    {"key": ..., "versions": ...}    header, JSON in a line
    ...                              `jax.export`'s own serialisation of the program

The header holds `key`, which stands for all that the program is traced from; `versions` of Python
and of the libraries; `output`, the structure of the output as `plain_tree` writes it, with a `Slot`
for each array; `sha256` of what follows the header. A file is read only if all of them are as
expected, and if it belongs to the user who runs the program.
"""

import dataclasses
import hashlib
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import jax
from jax import export
from jaxtyping import PyTree

from . import cache_folder, files, plain_tree

MAGIC = b"jaxik program 1\n"
# How JAX names calls from a program back into Python; no program of this project has one.
CALLBACK = re.compile(rb"python_\w*callback")


@dataclasses.dataclass(frozen=True)
class Slot:
    """The place of an array in an output."""

    index: int


class Program(NamedTuple):
    """A traced program."""

    exported: export.Exported
    output: PyTree
    """Its output, with a `Slot` in place of each array."""

    def call(self, arrays: list[jax.Array]) -> PyTree:
        """The output for these arrays."""
        outputs = self.exported.call(*arrays)
        return jax.tree.map(
            lambda leaf: outputs[leaf.index] if isinstance(leaf, Slot) else leaf, self.output
        )


def write(path: Path, program: Program, key: str, versions: Mapping[str, str]) -> None:
    """Writes a program.

    Raises:
        NotPlainError: its output holds more than arrays, plain values and dataclasses.
        OSError: the disk is full, or the like.
        ValueError: the folder may not be written to.
    """
    body = bytes(program.exported.serialize())
    header = {
        "key": key,
        "versions": versions,
        "output": plain_tree.describe(program.output),
        "sha256": hashlib.sha256(body).hexdigest(),
    }
    content = MAGIC + json.dumps(header).encode() + b"\n" + body
    files.write(path, lambda temporary: temporary.write_bytes(content))


def read(path: Path, key: str, versions: Mapping[str, str]) -> Program | None:
    """The program in a file; None if there is no file.

    Raises:
        OSError: the file cannot be read, or is somebody else's.
        ValueError: it is damaged, or another program than expected.
    """
    try:
        with path.open("rb") as file:
            cache_folder.check_own(path, os.fstat(file.fileno()))
            content = file.read()
    except FileNotFoundError:
        return None
    try:
        return _decode(content, key, versions)
    except Exception as error:  # the many errors with which parsers meet damage
        raise ValueError(f"{path} is damaged: {error}") from error


def _decode(content: bytes, key: str, versions: Mapping[str, str]) -> Program:
    if not content.startswith(MAGIC):
        raise ValueError(f"it begins with {content[: len(MAGIC)]!r}; wanted {MAGIC!r}")
    line, _, body = content[len(MAGIC) :].partition(b"\n")
    header = json.loads(line)
    expected = {"key": key, "versions": versions, "sha256": hashlib.sha256(body).hexdigest()}
    for name, value in expected.items():
        if header[name] != value:
            raise ValueError(f"its {name} is {header[name]!r}; wanted {value!r}")
    if CALLBACK.search(body):
        raise ValueError("the program calls Python")
    return Program(export.deserialize(bytearray(body)), plain_tree.rebuild(header["output"]))
