"""Pages and docstrings are true: their snippets run, and what they link to or name exists.

In a page, Python snippets share one namespace and run in order, in a scratch folder that looks like
the repository's root. Commands are checked by the command line's own parser, and executed where
`<!-- run -->` stands before them. TOML snippets are tables of an experiment file. A snippet after
`<!-- skip: next "reason" -->` is left out. In a docstring, the lines after `>>>` run.
"""

import contextlib
import importlib.util
import io
import os
import pkgutil
import re
import shlex
import subprocess
import sys
import tempfile
import tomllib
import unittest
from collections.abc import Mapping
from pathlib import Path

import pytest
from sybil import Example, Sybil
from sybil.document import Document
from sybil.parsers import markdown, rest

from fitting.cli.parser import make_parser
from fitting.datasets.clips import load_clip
from fitting.experiments import experiment_files, track_files

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("jaxik", "fitting", "data", "tests", "notebooks")
PAGES = sorted([*ROOT.glob("*.md"), *(p for name in FOLDERS for p in (ROOT / name).rglob("*.md"))])
PYTHON_FILES = sorted(path for name in FOLDERS for path in (ROOT / name).rglob("*.py"))
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
TOOLS = {"bash", "git", "pip", "pre-commit", "pyright", "pytest", "ruff"}
WRITTEN_PAGES = {
    "summary.md",
    "table.md",
    "compare.md",
    "runs.md",
    "suite.md",
    "notes.md",
}  # by commands and by tests
EXPERIMENT = ROOT / "data/experiments/uneven_walk.toml"


def each_file(paths: list[Path]) -> pytest.MarkDecorator:
    names = [path.relative_to(ROOT).as_posix() for path in paths]
    return pytest.mark.parametrize("path", paths, ids=names)


@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with links to what is in the repository's root."""
    for path in ROOT.iterdir():
        if path.name not in ("runs", "build"):
            (tmp_path / path.name).symlink_to(path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    return tmp_path


def check_command(line: str) -> None:
    """Raises AssertionError where a tool, a sub-command, an option or a script does not exist."""
    words = shlex.split(line, comments=True)
    if ">" in words:
        words = words[: words.index(">")]
    if not words:
        return
    tool = Path(words[0]).name
    if tool == "jaxik":
        errors = io.StringIO()
        try:
            with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
                make_parser().parse_args(words[1:])
        except SystemExit as status:
            assert status.code == 0, f"{line}: {errors.getvalue()}"
    elif tool.startswith("python"):
        if words[1] == "-m":
            assert importlib.util.find_spec(words[2]), f"{line}: no module {words[2]}"
        else:
            assert (ROOT / words[1]).is_file(), f"{line}: no file {words[1]}"
    else:
        assert tool in TOOLS, f"{line}: unknown tool"


def evaluate_commands(example: Example) -> None:
    script = str(example.parsed)
    for line in script.replace("\\\n", " ").splitlines():
        check_command(line)
    before = example.document.text[: example.region.start]
    if before.rstrip().endswith("<!-- run -->"):
        subprocess.run(["bash", "-euo", "pipefail", "-c", script], check=True)


def merged(table: Mapping[str, object], changes: Mapping[str, object]) -> dict[str, object]:
    """A table with changes, sub-tables merged as well."""
    result = dict(table)
    for key, value in changes.items():
        if isinstance(old := result.get(key), Mapping) and isinstance(value, Mapping):
            value = merged(old, value)
        result[key] = value
    return result


def evaluate_experiment(example: Example) -> None:
    """Reads a part of an experiment, or a track file, which begins with what no experiment has."""
    snippet = tomllib.loads(str(example.parsed))
    if "grounded" in snippet:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "tracks.toml")
            path.write_text(str(example.parsed), encoding="utf-8")
            base = load_clip(EXPERIMENT.parents[1] / "clips" / "uneven_walk_base.npz")
            track_files.along(base, path)
        return
    complete = tomllib.loads(EXPERIMENT.read_text(encoding="utf-8"))
    experiment_files.parse_experiment(merged(complete, snippet), EXPERIMENT)


PAGE_PARSERS = [
    markdown.PythonCodeBlockParser(),
    markdown.CodeBlockParser("sh", evaluate_commands),
    markdown.CodeBlockParser("toml", evaluate_experiment),
    markdown.SkipParser(),
]


def run_examples(document: Document) -> None:
    for example in document.examples():
        with contextlib.suppress(unittest.SkipTest):
            example.evaluate()


@pytest.mark.slow
@each_file(PAGES)
def test_the_snippets_of_a_page_run(path, scratch):
    run_examples(Sybil(PAGE_PARSERS).parse(path))


@each_file(
    [
        path
        for path in PYTHON_FILES
        if path.parent != ROOT / "tests" and ">>> " in path.read_text(encoding="utf-8")
    ]
)
def test_the_examples_of_docstrings_run(path, scratch):
    run_examples(Sybil([rest.DocTestParser()]).parse(path))


def test_the_examples_in_the_help_are_commands_that_exist():
    parser = make_parser()
    (commands,) = (action for action in parser._actions if action.dest == "command")
    pages = [
        parser.format_help(),
        *(p.format_help() for p in dict(commands.choices or {}).values()),
    ]
    lines = re.findall(r"^  (jaxik .*?)(?:  .*)?$", "\n".join(pages), re.MULTILINE)
    assert len(lines) > 20
    for line in lines:
        check_command(line)


@each_file(PAGES)
def test_a_skipped_snippet_gives_a_reason_and_every_snippet_a_language(path):
    text = path.read_text(encoding="utf-8")
    assert not re.findall(r"<!--+ *skip: *(?:start|next(?! +\"[^\"]{8,}\"))", text)
    fences = re.findall(r"^ *```(.*)$", text, re.MULTILINE)
    assert len(fences) % 2 == 0 and all(fences[::2])
    for source in re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        if not source.startswith(">>>"):
            compile(source, str(path), "exec")


def anchors(path: Path) -> set[str]:
    """What a link into a page may name: its headings in lower case, with hyphens."""
    headings = re.findall(r"^#+ +(.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@each_file(PAGES)
def test_the_links_of_a_page_lead_somewhere(path):
    links = re.findall(r"\]\(([^)\s]+)\)", path.read_text(encoding="utf-8"))
    for link in links:
        if re.match(r"[a-z]+:", link):
            continue
        file, _, anchor = link.partition("#")
        target = (path.parent / file).resolve() if file else path
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


@each_file([path for path in PAGES if path.name != "CHANGELOG.md"])
def test_the_files_and_names_in_a_page_exist(path):
    quoted = re.findall(r"`([^`\n]+)`", path.read_text(encoding="utf-8"))
    for text in quoted:
        if re.fullmatch(rf"(?:{'|'.join(FOLDERS)})/[\w./*-]*", text):
            assert list(ROOT.glob(text.rstrip("/"))), text
        elif name := re.match(r"(?:jaxik|fitting)(?:\.\w+)+", text):
            pkgutil.resolve_name(name[0])


@each_file([*PAGES, *PYTHON_FILES, *NOTEBOOKS])
def test_a_file_cites_no_page_that_is_not_in_the_repository(path):
    text = path.read_text(encoding="utf-8")
    names = {page.name for page in PAGES} | WRITTEN_PAGES
    assert set(re.findall(r"[\w-]+\.md\b", text)) - names == set()
    private = re.findall(r"\bseed 0\d\d\b|\.\./shared", text)
    assert private == [] or path.parent == ROOT / "tests"
