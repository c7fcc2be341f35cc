"""Checks of glTF files, as clips or as terrain, and what of a file is no terrain."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from fitting.runtime.validation import why_unreadable

BINARY = "glb"
KINDS = (BINARY, "gltf")
DATA = "data:"  # begins a uri that holds the bytes itself
JSON_START = 20  # bytes, in the binary form


class RefusalError(ValueError):
    """Of a file that is glTF, but not in a way that is read."""


def checked(kind: str, content: bytes, folder: Path) -> bytes:
    """The content without its characters, whose meshes hang on skeletons.

    Args:
        kind: of the file: others than `KINDS` are left as they are.
        content: of the file.
        folder: in which it is.

    Raises:
        RefusalError: a mesh or an array is compressed, sparse or without bytes, or a file with
            bytes is missing.
        ValueError: a header that is not JSON.
    """
    if kind not in KINDS:
        return content
    text, rest = content, b""
    if kind == BINARY:
        end = JSON_START + int.from_bytes(content[12:16], "little")
        text, rest = content[JSON_START:end], content[end:]
    header = json.loads(text.decode("utf-8"))
    if not isinstance(header, dict):
        return content
    for number, buffer in enumerate(header.get("buffers", [])):
        if not (uri := buffer.get("uri", DATA)).startswith(DATA):
            buffer_path(folder, number, uri)
    for number, mesh in enumerate(header.get("meshes", [])):
        for primitive in mesh["primitives"]:
            check_uncompressed(f"mesh {number}", primitive.get("extensions", {}))
    for number, view in enumerate(header.get("bufferViews", [])):
        check_uncompressed(f"bufferView {number}", view.get("extensions", {}))
    for number, accessor in enumerate(header.get("accessors", [])):
        check_accessor(number, accessor)
    characters = [node for node in header.get("nodes", []) if "skin" in node and "mesh" in node]
    if not characters:
        return content
    for node in characters:
        del node["mesh"]
    text = json.dumps(header).encode()
    if kind != BINARY:
        return text
    text += b" " * (-len(text) % 4)
    size = JSON_START + len(text) + len(rest)
    head = content[:8] + size.to_bytes(4, "little") + len(text).to_bytes(4, "little")
    return head + content[16:JSON_START] + text + rest


def check_accessor(number: int, accessor: Mapping[str, Any]) -> None:
    """RefusalError for an accessor whose values are not all in a buffer view."""
    if "sparse" in accessor:
        raise RefusalError(
            f"accessor {number} is sparse, which is not supported; export it in full"
        )
    if "bufferView" not in accessor:  # which would stand for any number of zeros
        raise RefusalError(f"accessor {number} has {accessor.get('count')} values but no bytes")


def check_uncompressed(what: str, extensions: Mapping[str, Any]) -> None:
    """RefusalError for a part of a file that has one of the extensions that compress it."""
    if compressing := [name for name in extensions if "compression" in name]:
        raise RefusalError(
            f"{what} is compressed ({compressing[0]}); export it without compression"
        )


def buffer_path(folder: Path, number: int, uri: str) -> Path:
    """The file in which a buffer is.

    Args:
        folder: of the glTF file.
        number: of the buffer.
        uri: as the file has it.

    Raises:
        RefusalError: it is elsewhere than beside the glTF file, or cannot be read.
    """
    name = unquote(uri)
    if not name or "\0" in name or Path(name).is_absolute() or ".." in Path(name).parts:
        raise RefusalError(f"buffer {number} is in {uri!r}; wanted a file beside this one")
    path = folder / name
    if reason := why_unreadable(path):
        raise RefusalError(
            f"buffer {number} is in {uri!r}: {reason}; put that file beside this one, or export "
            "a .glb, which has all in one file"
        )
    return path
