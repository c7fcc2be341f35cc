"""The page of a job other than a fit: sections of sentences, tables and pictures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, TypeAlias

from fitting.report.formatting import Table

from . import motion_data, rendering
from .motion_data import ShownClip
from .pictures import Picture


class Text(NamedTuple):
    """A paragraph; what is `code` or **strong** in Markdown is so."""

    text: str
    kind: str = "text"


class Points(NamedTuple):
    """A list of sentences."""

    lines: Sequence[str]
    kind: str = "points"


class Terms(NamedTuple):
    """Names and what they mean."""

    rows: Sequence[Sequence[str]]
    kind: str = "terms"


class Grid(NamedTuple):
    """A table; a cell that ends with an exclamation mark is shown as a miss."""

    rows: Table
    label: str
    """For those who do not see it."""
    title: str = ""
    kind: str = "grid"


class Jump(NamedTuple):
    """A button that shows the worst seconds of a motion in the view."""

    words: str
    clip: int
    """Its number among the clips of the view, from 0."""
    key: str
    """Of the motion."""
    kind: str = "jump"


Block: TypeAlias = Text | Points | Terms | Grid | Jump | Picture


class Finding(NamedTuple):
    """A sentence that says what was found."""

    text: str
    bad: bool = False
    """Whether it says what went badly."""


class Section(NamedTuple):
    """A heading, and what stands below it."""

    heading: str
    blocks: Sequence[Block]


@dataclass(frozen=True)
class View:
    """The motion in 3-D."""

    clips: Sequence[ShownClip]
    names: Sequence[str]
    """Of the clips."""
    visible: str
    """From which depth on a sole in the ground is marked, with its unit."""


@dataclass(frozen=True)
class StudyPage:
    """All that a page says."""

    kind: str
    """What was done, in a few words."""
    title: str
    verdict: str
    """In two or three words."""
    good: bool
    """Whether the verdict is good news."""
    findings: Sequence[Finding]
    """Three; the page begins with those that say what went badly."""
    sections: Sequence[Section]
    asked: Table
    """What was asked, a name and a text each."""
    files: Mapping[str, str] = field(default_factory=dict)
    """What is in which file beside the page, by file name."""
    view: View | None = None

    def write(self, folder: Path) -> None:
        """Writes the page into a folder."""
        pictures = [
            block
            for section in self.sections
            for block in section.blocks
            if isinstance(block, Picture)
        ]
        spent = sum(picture.size for picture in pictures)
        clips = [] if self.view is None else motion_data.pack(self.view.clips, spent)
        rendering.write(
            folder / rendering.PAGE,
            "study.html",
            clips,
            page=self,
            title=self.title,
            findings=[f.text for f in sorted(self.findings, key=lambda f: not f.bad)],
        )
