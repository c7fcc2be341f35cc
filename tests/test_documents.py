"""Pages are true: their snippets run, and what they link to or name exists.

In a page, Python snippets share one namespace and run in order, in a scratch folder that looks like
the repository's root. Commands are checked by the command line's own parser, and executed where
`<!-- run -->` stands before them. TOML snippets are tables of an experiment file. A snippet after
`<!-- skip: next "reason" -->` is left out.
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
from sybil.parsers import markdown

from fitting.cli.parser import make_parser
from fitting.clips import load_clip
from fitting.experiment import experiment_files, track_files

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("jaxik", "fitting", "data", "tests", "notebooks")
PAGES = sorted([*ROOT.glob("*.md"), *(p for name in FOLDERS for p in (ROOT / name).rglob("*.md"))])
PYTHON_FILES = sorted(path for name in FOLDERS for path in (ROOT / name).rglob("*.py"))
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
TOOLS = {"bash", "git", "pip", "pre-commit", "pyright", "pytest", "ruff"}
# By commands.
WRITTEN_PAGES = {
    f"{name}.md" for name in "summary table compare runs suite notes PATH posterior".split()
}
EXPERIMENT = ROOT / "data/experiments/uneven_walk.toml"
TEXTS = {path: path.read_text(encoding="utf-8") for path in [*PAGES, *PYTHON_FILES, *NOTEBOOKS]}


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


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
    words = shlex.split(line.partition(" > ")[0], comments=True)
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
        is_module = words[1] == "-m"
        known = importlib.util.find_spec(words[2]) if is_module else (ROOT / words[1]).is_file()
        assert known, f"{line}: no such module or file"
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


LONG = ("jaxik/README.md", "jaxik/stages/README.md")  # these compile whole systems
CASES = [
    pytest.param(path, id=name_of(path), marks=[pytest.mark.slow] * (name_of(path) in LONG))
    for path in PAGES
]


@pytest.mark.parametrize("path", CASES)
def test_the_snippets_of_a_page_run(path, scratch):
    for example in Sybil(PAGE_PARSERS).parse(path).examples():
        with contextlib.suppress(unittest.SkipTest):
            example.evaluate()


def test_the_examples_in_the_help_are_commands_that_exist():
    parser = make_parser()
    (commands,) = (action for action in parser._actions if action.dest == "command")
    pages = [each.format_help() for each in (parser, *dict(commands.choices or {}).values())]
    lines = re.findall(r"^  (jaxik .*?)(?:  .*)?$", "\n".join(pages), re.MULTILINE)
    assert len(lines) > 20
    for line in lines:
        check_command(line)


def test_a_skipped_snippet_gives_a_reason_and_every_snippet_a_language():
    for path in PAGES:
        reasonless = re.findall(r"<!--+ *skip: *(?:start|next(?! +\"[^\"]{8,}\"))", TEXTS[path])
        assert not reasonless, path
        fences = re.findall(r"^ *```(.*)$", TEXTS[path], re.MULTILINE)
        assert len(fences) % 2 == 0 and all(fences[::2]), path
        for source in re.findall(r"^```python\n(.*?)^```", TEXTS[path], re.MULTILINE | re.DOTALL):
            compile(source, str(path), "exec")


def anchors(path: Path) -> set[str]:
    """What a link into a page may name: its headings in lower case, with hyphens."""
    headings = re.findall(r"^#+ +(.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_the_links_of_all_pages_lead_somewhere():
    broken = []
    for path in PAGES:
        for link in re.findall(r"\]\(([^)\s]+)\)", TEXTS[path]):
            file, _, anchor = link.partition("#")
            target = (path.parent / file).resolve() if file else path
            leads = target.exists() and (not anchor or anchor in anchors(target))
            if not leads and not re.match(r"[a-z]+:", link):
                broken.append((name_of(path), link))
    assert not broken


def test_the_files_and_names_in_all_pages_exist():
    missing = []
    for path in PAGES:
        for text in re.findall(r"`([^`\n]+)`", TEXTS[path] * (path.name != "CHANGELOG.md")):
            if re.fullmatch(rf"(?:{'|'.join(FOLDERS)})/[\w./*-]*", text):
                missing += [] if list(ROOT.glob(text.rstrip("/"))) else [(name_of(path), text)]
            elif name := re.match(r"(?:jaxik|fitting)(?:\.\w+)+", text):
                try:
                    pkgutil.resolve_name(name[0])
                except (AttributeError, ImportError):
                    missing.append((name_of(path), text))
    assert not missing


def test_pages_are_short_and_begin_with_a_picture_or_an_example():
    texts = {name_of(path): text for path, text in TEXTS.items() if path in PAGES}
    del texts["CHANGELOG.md"]
    words = {name: len(text.split()) for name, text in texts.items()}
    assert not {name: count for name, count in words.items() if count > 2500}
    assert sum(words.values()) <= 20_000, words
    begins = re.compile(r"# .*\n\n(?:!\[|```)")
    assert not [name for name, text in texts.items() if not begins.match(text)]


def test_no_file_cites_a_page_that_is_not_in_the_repository():
    pages = {page.name for page in PAGES} | WRITTEN_PAGES
    cited = {path: set(re.findall(r"[\w-]+\.md\b", text)) - pages for path, text in TEXTS.items()}
    assert not {name_of(path): names for path, names in cited.items() if names}
    private = re.compile(r"\bseed 0\d\d\b|\.\./shared")
    texts = {path: text for path, text in TEXTS.items() if path.parent != ROOT / "tests"}
    assert not [name_of(path) for path, text in texts.items() if private.search(text)]
