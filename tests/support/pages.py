"""HTML pages as tests read them: text, headings, what they would load, and their data."""

import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from PIL import Image

LOADING = ("src", "href", "srcset", "poster", "action", "data")  # attributes that name a file
INLINE = {"code", "strong", "a", "span"}  # within a sentence
EMPTY = {"meta", "link", "br", "img", "input", "line", "rect", "circle"}  # never closed


def save_pixel(figure: Figure, path: str | Path, **look: object) -> None:
    """In place of `Figure.savefig`: a file that pages can embed."""
    Image.new("RGB", (1, 1)).save(path, format="PNG")


class Page(HTMLParser):
    """A page of a run."""

    def __init__(self, path: Path):
        super().__init__()
        self.html = path.read_text(encoding="utf-8")
        self.open: list[str] = []
        self.loads: list[str] = []
        self.headings: list[str] = []
        self.texts: list[str] = []
        self.elements: list[str] = []
        self.feed(self.html)
        self.close()

    @property
    def text(self) -> str:
        """All that is read, without styles and scripts."""
        return re.sub(r"\s+", " ", "".join(self.texts))

    @property
    def data(self) -> Any:
        """The data of the scripts."""
        match = re.search(r'<script type="application/json" id="data">(.*?)</script>', self.html)
        assert match
        return json.loads(match[1])

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append(tag)
        self.separate(tag)
        self.loads += [value or "" for name, value in attrs if name in LOADING]
        if tag not in EMPTY:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        self.separate(tag)
        if tag not in EMPTY:
            assert self.open.pop() == tag, f"</{tag}> closes something else"

    def separate(self, tag: str) -> None:
        """Puts a space between the texts of two elements, if they are not parts of a sentence."""
        if tag not in INLINE:
            self.texts.append(" ")

    def handle_data(self, data: str) -> None:
        if "style" in self.open or "script" in self.open:
            return
        self.texts.append(data)
        if self.open and re.fullmatch(r"h\d", self.open[-1]):
            self.headings.append(f"{self.open[-1]} {data.strip()}")
