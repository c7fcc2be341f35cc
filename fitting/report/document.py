"""The report of a study as a `Document`, which terminal, Markdown, HTML and notebooks render.

A study makes one of its result; `Document.write` draws its plots and writes it as Markdown and as
a page, `text` gives what the terminal shows. What has nothing to say (a list without lines, a table
without rows, a section of only such) is left out everywhere.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, TypedDict

from matplotlib.figure import Figure

from fitting.runtime import files
from fitting.runtime.json_files import JsonFile, write_json
from fitting.runtime.validation import Content, in_one_line

from . import formatting, motion_data, pages, style
from .formatting import JoinedText, Table, aligned, bullets, joined
from .motion_data import ViewedClip

STORED = "report.json"


class Text(NamedTuple):
    """A paragraph, in which `code` and **strong** are as in Markdown."""

    text: str
    brief: bool = False
    """Whether a terminal shows it."""


class Heading(NamedTuple):
    """A heading within a section."""

    text: str
    brief: bool = False
    """Whether a terminal shows it."""


class Points(NamedTuple):
    """A list of sentences."""

    lines: Sequence[str]
    brief: bool = False
    """Whether a terminal shows it."""


class Terms(NamedTuple):
    """Names and what they mean; no terminal shows them."""

    rows: Sequence[Sequence[str]]


class Grid(NamedTuple):
    """A table; a cell that ends with an exclamation mark is shown as a miss."""

    rows: Table
    label: str
    """A description, for screen readers."""
    brief: bool = True
    """Whether a terminal shows it."""


@dataclass(frozen=True)
class ParameterRow:
    """A parameter as the page shows it; fractions say how far up its range, on its scale."""

    name: str
    meaning: str
    value: str
    unit: str
    interval: str
    range: str
    verdict: str
    determined: bool
    at: float
    low: float
    high: float
    before: float | None
    truth: float | None
    description: str
    """A description of the interval plot, for screen readers."""


class Ranges(NamedTuple):
    """Parameters within their ranges, which the page draws; elsewhere a table says it."""

    rows: Sequence[ParameterRow]
    label: str
    """A description, for screen readers."""
    note: str
    """What the page draws."""
    table: Table


class Plot(NamedTuple):
    """A figure in a file beside the document; no terminal shows it."""

    name: str
    """Of the file."""
    caption: str
    draw: Callable[[], Figure] | None = None
    """None for one that is drawn already."""


class Jump(NamedTuple):
    """A button that shows the worst seconds of a motion in the page's view."""

    words: str
    clip: int
    """Its number among the clips of the view, from 0."""
    key: str = ""
    """Of the motion; the one that is watched at first if there is none."""


Block: TypeAlias = Text | Heading | Points | Terms | Grid | Ranges | Plot | Jump
BLOCKS = {kind.__name__: kind for kind in (Text, Heading, Points, Terms, Grid, Ranges, Plot, Jump)}


class Finding(NamedTuple):
    """A sentence that says what was found."""

    text: str
    bad: bool = False
    """Whether it is bad news."""


class Section(NamedTuple):
    """A heading, and what stands below it."""

    heading: str
    blocks: Sequence[Block]
    on_page: bool = True
    """Whether the page shows it, too; details may be left to Markdown."""


@dataclass(frozen=True)
class View:
    """The motion in 3-D, which only the page shows."""

    clips: Sequence[ViewedClip]
    names: Sequence[str]
    """Of the clips."""
    visible: str
    """From which depth on a sole in the ground is marked, with its unit."""
    stands: str = "animated"
    """The motion whose stances the timeline shows."""
    watched: str = "watched motion"
    """Whose soles are marked."""
    packed: Sequence[Content] = ()
    """Instead of `clips`, what a page holds of them: of a document that was stored."""

    def page(self, kind: str, title: str) -> str:
        """A page of the view alone, as HTML."""
        return pages.render(
            "view.html",
            self.packed or motion_data.pack(self.clips),
            kind=kind,
            title=title,
            names=self.names,
            visible=self.visible,
            stands=self.stands,
            watched=self.watched,
            layers={},
        )


@dataclass(frozen=True)
class Document:
    """The report of a study."""

    file: str
    """Name of its Markdown file; empty for what has no text and no page in a folder."""
    kind: str
    """What was done, in a few words."""
    title: str
    verdict: str
    """In two or three words."""
    good: bool
    """Whether the verdict is good news."""
    findings: Sequence[Finding]
    """Every rendering begins with those that are bad."""
    sections: Sequence[Section]
    setup: Table
    """What was run, and how: a name and a text each."""
    numbers: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """The content of the JSON files that have all numbers, by file name."""
    files: Mapping[str, str] = field(default_factory=dict)
    """What is in which other file beside it, by file name; `write` does not write these."""
    view: View | None = None
    note: str = ""
    """Further remarks on the findings."""

    @property
    def sentences(self) -> list[str]:
        """The findings, bad ones first."""
        return [finding.text for finding in sorted(self.findings, key=lambda f: not f.bad)]

    @property
    def beside(self) -> dict[str, str]:
        """What is in which file, by file name."""
        plots = {plot.name: "a figure" for plot in _plots(self.sections) if plot.draw}
        numbers = dict.fromkeys(self.numbers, "all numbers")
        return {self.file: "the text", **numbers, **self.files, **plots}

    @property
    def whole(self) -> list[Section]:
        """All sections, the setup last."""
        return [*self.sections, Section("Setup", [Terms(self.setup)])]

    def write(self, folder: Path, *, stored: bool = False) -> None:
        """Draws the plots, and writes the numbers, and the document as Markdown and as a page.

        Args:
            folder: where to; it is made if needed.
            stored: whether `load` finds the document there, to be written again with more sections.
        """
        folder.mkdir(parents=True, exist_ok=True)
        for path, content in self.numbers.items():
            write_json(folder / path, content)
        for plot in _plots(self.sections):
            if plot.draw is not None:
                style.save(folder / plot.name, plot.draw())
        if not self.file:
            return
        files.write_text(folder / self.file, _as_markdown(self))
        sections = [section for section in _filled(self.whole) if section.on_page]
        pictures = pages.embed(folder, {plot.name: plot.caption for plot in _plots(sections)})
        spent = sum(picture.size for picture in pictures.values())
        clips: Sequence[Content] = ()
        if self.view is not None:
            clips = self.view.packed or motion_data.pack(self.view.clips, spent)
        html = pages.render(
            "document.html", clips, document=self, sections=sections, pictures=pictures
        )
        files.write_text(folder / pages.PAGE, html)
        if stored:
            STORED_FILE.write(folder / STORED, _stored(self, clips))


class StoredDocument(TypedDict):
    """A document as JSON holds it; blocks begin with the name of their kind."""

    document: Content
    """What is plain."""
    findings: list[list]
    sections: list[list]
    view: Content | None


STORED_FILE = JsonFile(StoredDocument, "a report", "delete it to go without", indent=None)
PLAIN = ("file", "kind", "title", "verdict", "good", "files", "note")


def load(folder: Path) -> Document | None:
    """The document that is stored in a folder, with its plots as they are drawn there, if any is.

    Raises:
        ValueError: its file is damaged.
    """
    path = folder / STORED
    return _restored(STORED_FILE.read(path, _restored)) if path.is_file() else None


def _stored(document: Document, clips: Sequence[Content]) -> StoredDocument:
    view = document.view
    return {
        "document": {name: getattr(document, name) for name in PLAIN} | {"asked": document.setup},
        "findings": [list(finding) for finding in document.findings],
        "sections": [
            [section.heading, list(map(_stored_block, section.blocks)), section.on_page]
            for section in document.sections
        ],
        "view": None if view is None else {**vars(view), "clips": [], "packed": clips},
    }


def _stored_block(block: Block) -> list:
    kind = type(block).__name__
    match block:
        case Plot():
            return [kind, block.name, block.caption]
        case Ranges():
            return [kind, *block._replace(rows=[vars(row) for row in block.rows])]
        case _:
            return [kind, *block]


def _restored(stored: StoredDocument) -> Document:
    plain = dict(stored["document"])
    try:
        return Document(
            setup=plain.pop("asked"),
            **plain,
            findings=[Finding(*finding) for finding in stored["findings"]],
            sections=[
                Section(heading, [_block(*block) for block in blocks], on_page)
                for heading, blocks, on_page in stored["sections"]
            ],
            view=_restored_view(stored["view"]),
        )
    except (TypeError, KeyError) as error:
        raise ValueError(in_one_line(error)) from None


def _restored_view(stored: Content | None) -> View | None:
    """A view; None for one that another version has packed, which no script can read now."""
    if stored is None:
        return None
    view = View(**stored)
    is_ours = all(clip.get("format") == motion_data.FORMAT for clip in view.packed)
    return view if is_ours else None


def _block(kind: str, *fields: Any) -> Block:
    if kind == Ranges.__name__:
        rows, *others = fields
        return Ranges([ParameterRow(**row) for row in rows], *others)
    return BLOCKS[kind](*fields)


def _filled(sections: Sequence[Section]) -> list[Section]:
    """The sections that say something, with the blocks that do."""
    filled = [of._replace(blocks=list(filter(_says_something, of.blocks))) for of in sections]
    return [section for section in filled if section.blocks]


def blocks_of(sections: Sequence[Section]) -> Iterator[Block]:
    """The blocks of all sections that say something."""
    return (block for section in _filled(sections) for block in section.blocks)


def _plots(sections: Sequence[Section]) -> list[Plot]:
    return [block for block in blocks_of(sections) if isinstance(block, Plot)]


def _says_something(block: Block) -> bool:
    match block:
        case Text(text=text):
            return bool(text)
        case Points(lines=lines):
            return bool(lines)
        case Grid(rows=rows):
            return len(rows) > 1
        case Ranges(rows=rows):
            return bool(rows)
        case _:
            return True


def text(document: Document) -> JoinedText:
    """The document in brief, for a terminal: verdict, findings, tables."""
    parts = [f"{document.verdict}.", bullets(document.sentences), document.note]
    return joined([*filter(None, parts), brief(document.sections)], apart=True)


def brief(sections: Sequence[Section]) -> JoinedText:
    """What a terminal shows of sections."""
    parts: list[str] = []
    for block in blocks_of(sections):
        match block:
            case Text(text=words, brief=True):
                parts.append(words)
            case Heading(text=words, brief=True):
                parts.append(f"{words}:")
            case Points(lines=lines, brief=True):
                parts.append(bullets(lines))
            case Grid(rows=rows, brief=True) | Ranges(table=rows):
                parts.append(aligned(rows))
            case _:
                pass
    return joined(parts, apart=True)


def _as_markdown(document: Document) -> str:
    """The whole document in Markdown, but for the view."""
    others = (f"[{name}]({name}) has {words}" for name, words in document.beside.items())
    parts = [
        f"# {document.title}",
        f"{document.kind}: **{document.verdict}**.",
        bullets(document.sentences),
        *filter(None, [document.note]),
        *markdown(document.whole),
        f"More in this folder: {', '.join(islice(others, 1, None))}.",
    ]
    return "\n\n".join(parts) + "\n"


def markdown(sections: Sequence[Section]) -> Iterator[str]:
    """The paragraphs of sections in Markdown."""
    for section in _filled(sections):
        yield f"## {section.heading}"
        for block in section.blocks:
            match block:
                case Text():
                    yield block.text
                case Heading():
                    yield f"### {block.text}"
                case Points():
                    yield bullets(block.lines)
                case Terms():
                    yield bullets([f"**{name}**: {words}" for name, words in block.rows])
                case Grid(rows=rows) | Ranges(table=rows):
                    yield formatting.markdown([[_red(cell) for cell in row] for row in rows])
                case Plot():
                    yield f"![{block.caption}]({block.name})"
                case Jump():
                    pass


def _red(cell: str) -> str:
    return f'<span style="color:red">**{cell}**</span>' if cell.endswith("!") else cell
