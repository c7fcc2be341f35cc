"""A glTF 2.0 or GLB file: its header, and the arrays in its buffers.

Every count and place in the header is held against the bytes that are there, so that reading takes
no more memory than the file has.
"""

import base64
import binascii
import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float64

from fitting.runtime.validation import why_unreadable

Item = Mapping[str, Any]

MAGIC = b"glTF"
JSON, BIN = 0x4E4F534A, 0x004E4942  # kinds of chunks
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
COMPONENT_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
LARGEST_COUNT = 2**53
BINARY = "glb"
DATA = "data:"  # begins a uri that holds the bytes itself


class RefusalError(ValueError):
    """Of a file that is glTF, but not in a way that is read."""


class Document:
    """A glTF file. Its methods raise ValueError, without the file's name, for what is not glTF."""

    def __init__(self, header: Item, binary: bytes | None, folder: Path, size: int):
        self.header = header
        self.binary = binary
        self.folder = folder
        self.size = size
        """Bytes of the file, and of the files beside it that were read."""
        self.items = cache(self._items)
        """A list of the header by its name, empty where there is none."""
        self._array = cache(self._read_array)
        self.buffer = cache(self._read_buffer)
        """The bytes of a buffer by its number."""

    @classmethod
    def read(cls, path: Path) -> "Document":
        """A file.

        Raises:
            ValueError: it is not glTF.
        """
        content = path.read_bytes()
        size, binary = len(content), None
        if path.suffix.lower() == f".{BINARY}":
            content, binary = _chunks(content)
        try:
            header = json.loads(content.decode("utf-8-sig"))
        except RecursionError:
            raise ValueError("its header is nested too deeply") from None
        except ValueError as error:
            raise ValueError(f"its header is not JSON: {error}") from None
        return cls(as_item(header, "the header"), binary, path.parent, size)

    def _items(self, name: str) -> list[Item]:
        items = as_list(self.header.get(name, []), name)
        return [as_item(item, f"{name} {index}") for index, item in enumerate(items)]

    def array(self, index: object) -> Float64[np.ndarray, "count width"]:
        """The values of an accessor; normalised integers have become fractions."""
        return self._array(as_index(index, len(self.items("accessors")), "accessors"))

    def _read_array(self, number: int) -> Float64[np.ndarray, "count width"]:
        accessor, where = self.items("accessors")[number], f"accessor {number}"
        check_accessor(number, accessor)
        component, kind = accessor.get("componentType"), accessor.get("type")
        if component not in tuple(COMPONENTS) or kind not in tuple(COMPONENT_WIDTHS):
            raise ValueError(
                f"{where} holds {kind!r} of {component!r}; wanted {list(COMPONENT_WIDTHS)}"
            )
        count = as_index(accessor.get("count"), LARGEST_COUNT, f"counts of {where}")
        view = self._view(accessor["bufferView"])
        dtype, width = np.dtype(COMPONENTS[component]), COMPONENT_WIDTHS[kind]
        start = as_index(accessor.get("byteOffset", 0), LARGEST_COUNT, f"offsets of {where}")
        item = width * dtype.itemsize
        stride = as_index(view[1] or item, LARGEST_COUNT, f"strides of {where}")
        if not count or stride < item or start + stride * (count - 1) + item > len(view[0]):
            raise ValueError(
                f"{where} has {count} values of {item} bytes in {len(view[0])} bytes; wanted at "
                "least one, and as many as there are bytes"
            )
        shape, strides = (count, width), (stride, dtype.itemsize)
        raw = np.ndarray(shape, dtype, buffer=view[0], offset=start, strides=strides)
        with np.errstate(all="ignore"):  # what is not finite is refused below
            array = raw.astype(np.float64)
        if accessor.get("normalized") is True and dtype.kind in "iu":
            array = np.maximum(array / np.iinfo(dtype).max, -1.0)
        if not np.isfinite(array).all():
            value = int(np.argmin(np.isfinite(array).all(axis=-1)))
            raise ValueError(
                f"value {value} of {where} is {array[value].tolist()}; wanted finite numbers"
            )
        return array

    def _view(self, index: object) -> tuple[memoryview, object]:
        """The bytes of a buffer view, and its stride."""
        views = self.items("bufferViews")
        number = as_index(index, len(views), "bufferViews")
        view, where = views[number], f"bufferView {number}"
        check_uncompressed(where, as_item(view.get("extensions", {}), where))
        content = self.buffer(as_index(view.get("buffer"), len(self.items("buffers")), "buffers"))
        start = as_index(view.get("byteOffset", 0), LARGEST_COUNT, f"offsets of {where}")
        length = as_index(view.get("byteLength"), LARGEST_COUNT, f"lengths of {where}")
        if start + length > len(content):
            raise ValueError(
                f"{where} ends at byte {start + length} of a buffer of {len(content)} bytes"
            )
        return memoryview(content)[start : start + length], view.get("byteStride")

    def _read_buffer(self, number: int) -> bytes:
        uri = self.items("buffers")[number].get("uri")
        if uri is None:
            if self.binary is None or number:
                raise ValueError(f"buffer {number} has neither a uri nor a binary part")
            return self.binary
        if not isinstance(uri, str):
            raise ValueError(f"the uri of buffer {number} is {uri!r}; wanted a text")
        if uri.startswith(DATA):
            head, _, text = uri.partition(",")
            try:
                return base64.b64decode(text if head.endswith(";base64") else "?", validate=True)
            except binascii.Error:
                raise ValueError(f"the uri of buffer {number} is not base64") from None
        content = buffer_path(self.folder, number, uri).read_bytes()
        self.size += len(content)
        return content


def _chunks(content: bytes) -> tuple[bytes, bytes | None]:
    """The header and the binary part of a GLB; none goes beyond the file."""
    if content[:4] != MAGIC or content[4:8] != (2).to_bytes(4, "little"):
        raise ValueError(f"wanted a GLB of version 2, which begins with {MAGIC!r} and 2")
    parts: dict[int, bytes] = {}
    start = 12
    while start + 8 <= len(content):
        length, kind = (int.from_bytes(content[at : at + 4], "little") for at in (start, start + 4))
        if start + 8 + length > len(content):
            raise ValueError(f"a part of {length} bytes begins at byte {start + 8} of "
                             f"{len(content)}: the file is not whole")  # fmt: skip
        parts.setdefault(kind, content[start + 8 : start + 8 + length])
        start += 8 + length
    if JSON not in parts:
        raise ValueError("a GLB without a header")
    return parts[JSON], parts.get(BIN)


def as_index(value: object, count: int, what: str) -> int:
    """The value if it is a whole number from 0 to `count` - 1; else ValueError names it."""
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < count:
        raise ValueError(f"{str(value)[:40]} among the {what}; wanted a whole number below {count}")
    return value


def as_item(value: object, what: str) -> Item:
    """The value if it is a JSON object; else ValueError names it."""
    if not isinstance(value, dict):
        raise ValueError(f"{what} is {str(value)[:40]!r}; wanted a JSON object")
    return value


def as_list(value: object, what: str) -> list[Any]:
    """The value if it is a JSON list; else ValueError names it."""
    if not isinstance(value, list):
        raise ValueError(f"{what} is {str(value)[:40]!r}; wanted a list")
    return value


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
