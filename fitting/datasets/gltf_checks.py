"""Checks of glTF files before they are read: what a header claims without bytes to show for it."""

import json
from collections.abc import Mapping
from typing import Any

BINARY = "glb"
KINDS = (BINARY, "gltf")
JSON_START = 20  # bytes, in the binary form


def check_claims(kind: str, content: bytes) -> None:
    """Rejects accessors without a buffer view, which stand for any number of zeros.

    Args:
        kind: of the file: of others than `KINDS`, nothing is checked.
        content: of the file.

    Raises:
        ValueError: for such an accessor, or a header that is not JSON.
    """
    if kind not in KINDS:
        return
    if kind == BINARY:
        length = int.from_bytes(content[12:16], "little")
        content = content[JSON_START : JSON_START + length]
    header = json.loads(content.decode("utf-8"))
    accessors = header.get("accessors", []) if isinstance(header, dict) else []
    for number, accessor in enumerate(accessors):
        check_accessor(number, accessor)


def check_accessor(number: int, accessor: Mapping[str, Any]) -> None:
    """ValueError for an accessor that has no bytes in the file."""
    if "bufferView" not in accessor:
        raise ValueError(f"accessor {number} has {accessor.get('count')} values but no bytes")
