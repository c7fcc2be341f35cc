"""Checks of glTF files before they are read as terrain, and what of them is none."""

import json
from collections.abc import Mapping
from typing import Any

BINARY = "glb"
KINDS = (BINARY, "gltf")
JSON_START = 20  # bytes, in the binary form


def checked(kind: str, content: bytes) -> bytes:
    """The content without its characters, whose meshes hang on skeletons.

    Rejects accessors without a buffer view, which stand for any number of zeros.

    Args:
        kind: of the file: others than `KINDS` are left as they are.
        content: of the file.

    Raises:
        ValueError: for such an accessor, or a header that is not JSON.
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
    """ValueError for an accessor that has no bytes in the file."""
    if "bufferView" not in accessor:
        raise ValueError(f"accessor {number} has {accessor.get('count')} values but no bytes")
