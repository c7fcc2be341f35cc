"""The pictures of a report within its page."""

import base64
import io
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from PIL import Image

MAX_BYTES = 2_500_000  # of all pictures of a page
SMALLER = 0.8  # of its width, as often as it takes


class Picture(NamedTuple):
    """A picture that is part of a page."""

    caption: str
    source: str
    """As a data URL."""
    width: int
    height: int
    size: int
    """Bytes, before base64."""
    kind: str = "picture"


def embed(folder: Path, captions: Mapping[str, str]) -> list[Picture]:
    """Pictures of a folder, those that are too large scaled down: all are `MAX_BYTES` at most.

    Args:
        folder: that has them, as PNG.
        captions: by file name; files that do not exist are left out.
    """
    paths = [folder / name for name in captions if (folder / name).is_file()]
    room = MAX_BYTES // max(len(paths), 1)
    return [_embed(path, captions[path.name], room) for path in paths]


def _embed(path: Path, caption: str, room: int) -> Picture:
    content = path.read_bytes()
    with Image.open(path) as original:
        size = original.size
        while len(content) > room:
            size = max(1, round(SMALLER * size[0])), max(1, round(SMALLER * size[1]))
            file = io.BytesIO()
            original.convert("RGB").resize(size, Image.Resampling.LANCZOS).save(file, "PNG")
            content = file.getvalue()
    encoded = base64.b64encode(content).decode("ascii")
    return Picture(caption, f"data:image/png;base64,{encoded}", *size, len(content))
