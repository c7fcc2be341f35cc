"""The state of the code in figures, beside their limits: `python tests/house.py`.

Exits with status 1 if a figure misses its limit, which an exclamation mark then shows. Functions
include methods and nested functions, arguments include `self`, lines include blank ones.
"""

import ast
import functools
import math
import resource
import statistics
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("jaxik", "fitting")
MANY_ARGUMENTS = 6
FEW_MODULES = 3
SUBJECTS = (  # words in the paths of the modules of a study
    "ablat", "calibrat", "compar", "draft", "many", "population", "sampl", "suite", "terrain",
    "translat",
)  # fmt: skip
LIMITS = {  # of packages
    "fitting": {"modules": (0, 190), "folders": (0, 28), "modules with one importer": (0, 60)},
}
NO_LIMITS = (-math.inf, math.inf)
HELP = "from fitting.cli.main import main; main(['--help'])"

Function = ast.FunctionDef | ast.AsyncFunctionDef
Definition = ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True)
class Figure:
    """A number, and the range in which it should lie."""

    name: str
    value: float
    limits: tuple[float, float] = NO_LIMITS
    place: str = ""  # the file, folder or function that has this value

    @property
    def is_within_limits(self) -> bool:
        """Whether the number lies in its range."""
        return self.limits[0] <= self.value <= self.limits[1]

    def __str__(self) -> str:
        low, high = self.limits
        limits = f"{low:g} to {high:g}" if math.isfinite(high) else ""
        mark = " " if self.is_within_limits else "!"
        return f"{mark} {self.name:40} {self.value:8.5g}   {limits:14} {self.place}".rstrip()


class Package:
    """The source of a package, parsed."""

    def __init__(self, name: str):
        # Not what runs in other programs, such as Blender, and is no package here.
        files = (ROOT / name).rglob("*.py")
        self.files = sorted(path for path in files if (path.parent / "__init__.py").exists())
        self.trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in self.files}
        self.modules = [path for path in self.files if path.stem != "__init__"]
        self.nodes = [node for tree in self.trees.values() for node in ast.walk(tree)]
        self.functions = [node for node in self.nodes if isinstance(node, Function)]
        self.classes = {node.name: node for node in self.nodes if isinstance(node, ast.ClassDef)}

    def public(self, path: Path) -> list[tuple[str, Definition]]:
        """Public classes, functions and methods of a file; not overridden methods."""
        return list(self._public(self.trees[path].body, None))

    def undocumented(self, path: Path) -> list[str]:
        """Public classes, functions and methods of a file that have no docstring."""
        return [
            f"{name} (line {node.lineno})"
            for name, node in self.public(path)
            if not ast.get_docstring(node)
        ]

    def _public(
        self, body: list[ast.stmt], owner: ast.ClassDef | None
    ) -> Iterator[tuple[str, Definition]]:
        for node in body:
            if not isinstance(node, Definition) or node.name.startswith("_"):
                continue
            if owner is None or not self._overrides(owner, node.name):
                yield f"{owner.name}.{node.name}" if owner else node.name, node
            if isinstance(node, ast.ClassDef):
                yield from self._public(node.body, node)

    def _overrides(self, owner: ast.ClassDef, method: str) -> bool:
        """Whether a base class in this package has, and so documents, the method."""
        names = [base.id for base in owner.bases if isinstance(base, ast.Name)]
        bases = [self.classes[name] for name in names if name in self.classes]
        own = {node.name for base in bases for node in base.body if isinstance(node, Function)}
        return method in own or any(self._overrides(base, method) for base in bases)


@functools.cache
def parsed(name: str) -> Package:
    """A package, parsed once."""
    return Package(name)


def line_count(path: Path) -> int:
    """Number of lines of a file."""
    return len(path.read_text(encoding="utf-8").splitlines())


def argument_count(function: Function) -> int:
    """Number of arguments of a function, `self`, `*args` and `**kwargs` included."""
    spec = function.args
    named = [*spec.posonlyargs, *spec.args, *spec.kwonlyargs]
    return len(named) + (spec.vararg is not None) + (spec.kwarg is not None)


def names_any(node: ast.AST) -> bool:
    """Whether a node is the word `Any`; imports count."""
    return "Any" in (getattr(node, key, None) for key in ("id", "attr", "name"))


def importers(package: Package) -> dict[Path, set[Path]]:
    """The modules of a package, each with those files of the package that import it."""
    by_name = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in package.files
    }
    by_name = {name.removesuffix(".__init__"): path for name, path in by_name.items()}
    users: dict[Path, set[Path]] = {path: set() for path in package.modules}
    for path, tree in package.trees.items():
        for name in imported_names(path, tree):
            parent = name.rpartition(".")[0]
            imported = by_name.get(name) or by_name.get(parent)
            if imported in users and imported != path:
                users[imported].add(path)
    return users


@functools.cache
def imported_names(path: Path, tree: ast.Module) -> set[str]:
    """Absolute dotted names of everything that a module imports."""
    folders = path.relative_to(ROOT).parent.parts
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parents = folders[: len(folders) - node.level + 1] if node.level else ()
            base = ".".join([*parents, *([node.module] if node.module else [])])
            names |= {f"{base}.{alias.name}" for alias in node.names}
    return names


def import_lines(tree: ast.Module) -> int:
    """Number of lines that import statements take."""
    statements = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
    return sum((node.end_lineno or node.lineno) - node.lineno + 1 for node in statements)


def scattered_subjects(package: Package) -> list[str]:
    """Studies whose modules lie in more than two folders."""
    homes = {word: set() for word in SUBJECTS}
    for path in package.modules:
        for word in SUBJECTS:
            if word in path.relative_to(ROOT).as_posix():
                homes[word].add(path.parent)
    return [word for word, folders in homes.items() if len(folders) > 2]


def package_figures(name: str) -> list[Figure]:
    """What follows from the source of a package alone."""
    package = parsed(name)
    lines = sum(map(line_count, package.files))
    folders = Counter(path.parent for path in package.modules)
    small = [folder.name for folder, count in folders.items() if count <= FEW_MODULES]
    alone = [path for path, users in importers(package).items() if len(users) == 1]
    scattered = scattered_subjects(package)
    modules = sorted(package.modules, key=line_count)
    lengths = {node: (node.end_lineno or 0) - node.lineno + 1 for node in package.functions}
    longest = max(lengths, key=lengths.__getitem__)
    crowded = [node for node in package.functions if argument_count(node) >= MANY_ARGUMENTS]
    public = [definition for path in package.files for definition in package.public(path)]
    undocumented = [name for path in package.files for name in package.undocumented(path)]
    percent_crowded = 100 * len(crowded) / len(lengths)
    percent_documented = 100 * (1 - len(undocumented) / len(public))
    any_per_thousand = 1000 * sum(map(names_any, package.nodes)) / lines
    percent_imports = 100 * sum(map(import_lines, package.trees.values())) / lines
    limits = LIMITS.get(name, {})

    def extreme(path: Path) -> tuple[int, tuple[float, float], str]:
        return line_count(path), NO_LIMITS, path.relative_to(ROOT).as_posix()

    def limited(figure: str, value: int, place: str = "") -> Figure:
        return Figure(figure, value, limits.get(figure, NO_LIMITS), place)

    return [
        limited("modules", len(modules)),
        limited("folders", len(folders)),
        Figure(f"folders of {FEW_MODULES} modules or fewer", len(small), place=" ".join(small)),
        limited("modules with one importer", len(alone)),
        Figure("subjects in more than two folders", len(scattered), place=" ".join(scattered)),
        Figure("lines", lines),
        Figure("% of lines that import", percent_imports),
        Figure("lines of the shortest module", *extreme(modules[0])),
        Figure("lines of the longest module", *extreme(modules[-1])),
        Figure("lines of a function, median", statistics.median(lengths.values())),
        Figure("lines of a function, 90 %", statistics.quantiles(lengths.values(), n=10)[-1]),
        Figure("lines of a function, longest", lengths[longest], place=longest.name),
        Figure(f"% of functions with {MANY_ARGUMENTS} arguments or more", percent_crowded, (0, 7)),
        Figure("`Any` per thousand lines", any_per_thousand, (0, 5)),
        Figure("% of public names with a docstring", percent_documented, (100, 100)),
    ]


def folder_figures(name: str) -> list[Figure]:
    """The lines of each folder of a package."""
    lines: Counter[Path] = Counter()
    for path in parsed(name).files:
        lines[path.parent] += line_count(path)
    return [Figure(f"lines of {folder.relative_to(ROOT)}", n) for folder, n in lines.items()]


def readme_figure() -> Figure:
    """Length of the first page that a reader sees, its code included."""
    return Figure("words in README.md", len((ROOT / "README.md").read_text().split()), (400, 600))


def help_figure() -> Figure:
    """CPU time of `jaxik --help`, the least of five calls, with modules already compiled."""
    seconds = []
    for _ in range(5):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        command = [sys.executable, "-c", HELP]
        subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return Figure("seconds of CPU for `jaxik --help`", min(seconds), (0, 0.3))


def main() -> int:
    """Prints all figures; gives 1 if one misses its limit, else 0."""
    sections = {name: package_figures(name) + folder_figures(name) for name in PACKAGES}
    sections["for the user"] = [readme_figure(), help_figure()]
    for title, figures in sections.items():
        print(title, *figures, "", sep="\n")
    missed = [f.name for figures in sections.values() for f in figures if not f.is_within_limits]
    print(f"Missed: {', '.join(missed)}." if missed else "All figures are within their limits.")
    return int(bool(missed))


if __name__ == "__main__":
    sys.exit(main())
