"""Mutants: small changes of the source, made by cosmic-ray's operators one at a time."""

import ast
import functools
import random
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cosmic_ray.ast
from cosmic_ray.mutating import MutationVisitor
from cosmic_ray.operators.provider import OperatorProvider

# What an operator becomes. Cosmic-ray also knows what floats refuse, such as `x << y`, and what
# nobody would write, such as `x is y`: such mutants are caught at once and only raise the score.
BINARY = "Add_Sub Sub_Add Mul_Div Div_Mul FloorDiv_Mul Mod_Mul Pow_Mul BitAnd_BitOr BitOr_BitAnd"
SHIFTS = "RShift_LShift LShift_RShift"
COMPARISONS = "Lt_LtE Lt_Gt LtE_Lt LtE_GtE Gt_GtE Gt_Lt GtE_Gt GtE_LtE Eq_NotEq NotEq_Eq"
IDENTITIES = "Is_IsNot IsNot_Is"
UNARY = "Delete_USub Delete_Invert Delete_Not"
OPERATORS = [
    *(f"ReplaceBinaryOperator_{names}" for names in f"{BINARY} {SHIFTS}".split()),
    *(f"ReplaceComparisonOperator_{names}" for names in f"{COMPARISONS} {IDENTITIES}".split()),
    *(f"ReplaceUnaryOperator_{names}" for names in UNARY.split()),
    *"AddNot ReplaceTrueWithFalse ReplaceFalseWithTrue ReplaceAndWithOr ReplaceOrWithAnd".split(),
    *"ReplaceBreakWithContinue ReplaceContinueWithBreak ZeroIterationForLoop".split(),
    *"ExceptionReplacer NumberReplacer RemoveDecorator".split(),
]
UNMUTATED_DECORATORS = {"abstractmethod", "overload", "override"}  # for readers and type checkers


@dataclass(frozen=True)
class Mutant:
    """A module with one change."""

    path: str  # of the module, from the root of the checkout
    operator: str
    occurrence: int  # among the places of the module that the operator changes
    line: int

    def source(self, root: Path) -> str:
        """The changed module."""
        operator = _operators()[self.operator]
        source = (root / self.path).read_text(encoding="utf-8")
        changed = MutationVisitor.mutate_code(source, operator, self.occurrence)
        assert changed is not None, self
        return changed


@functools.cache
def diff(mutant: Mutant, root: Path) -> tuple[str, str]:
    """What stood in the lines that a mutant changes and what stands there now, unindented."""
    before = (root / mutant.path).read_text(encoding="utf-8").splitlines()
    after = mutant.source(root).splitlines()
    start = next(i for i, pair in enumerate(zip(before, after, strict=False)) if len({*pair}) > 1)
    pairs = zip(reversed(before[start:]), reversed(after[start:]), strict=False)
    end = next((i for i, pair in enumerate(pairs) if len({*pair}) > 1), len(after) - start)
    old, new = before[start : len(before) - end], after[start : len(after) - end]
    return " ".join(" ".join(old).split()), " ".join(" ".join(new).split())


@functools.cache
def _operators() -> dict[str, Any]:
    provider: Any = OperatorProvider()
    return {name: provider[name]() for name in OPERATORS}


def mutants_of(root: Path, path: str) -> list[Mutant]:
    """All mutants of a module whose change can matter when it runs."""
    source = (root / path).read_text(encoding="utf-8")
    tree, lines = cosmic_ray.ast.get_ast(source), source.splitlines()
    unmutated = [
        ((node.lineno, node.col_offset), (node.end_lineno or 0, node.end_col_offset or 0))
        for node in _unmutated(ast.parse(source))
    ]
    occurrences: dict[str, int] = defaultdict(int)
    mutants = []
    for node in cosmic_ray.ast.ast_nodes(tree):
        for name, operator in _operators().items():
            for begin, _ in operator.mutation_positions(node):
                place = begin[0], len(lines[begin[0] - 1][: begin[1]].encode())
                if not any(first <= place < last for first, last in unmutated):
                    mutants.append(Mutant(path, name, occurrences[name], begin[0]))
                occurrences[name] += 1
    return mutants


def _unmutated(tree: ast.Module) -> Iterator[ast.expr | ast.stmt]:
    """What says something to readers and type checkers only: annotations, what errors tell."""
    for node in ast.walk(tree):
        if isinstance(node, ast.arg | ast.AnnAssign) and node.annotation:
            yield node.annotation
        if isinstance(node, ast.AnnAssign) and "TypeAlias" in ast.unparse(node.annotation):
            yield node
        if isinstance(node, ast.FunctionDef):
            yield from [node.returns] if node.returns else []
            for decorator in node.decorator_list:
                if ast.unparse(decorator).rpartition(".")[2] in UNMUTATED_DECORATORS:
                    decorator.col_offset -= 1  # with its at sign
                    yield decorator
        if isinstance(node, ast.Raise):
            yield node
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            yield node


def modules_of(root: Path, folder: str) -> list[str]:
    """The modules below a folder, or the folder if it is a module; `__init__.py` only imports."""
    place = root / folder
    paths = [place] if place.is_file() else sorted(place.rglob("*.py"))
    return [path.relative_to(root).as_posix() for path in paths if path.stem != "__init__"]


def sample(mutants: list[Mutant], count: int, seed: int) -> list[Mutant]:
    """A random sample to which each module contributes by its number of mutants, or all.

    The mutants of each module are shuffled, then every n-th of all is taken from a random start.
    The sample is in random order, so that its first part is a sample too.
    """
    if count >= len(mutants):
        return mutants
    randomness = random.Random(seed)
    modules: dict[str, list[Mutant]] = defaultdict(list)
    for mutant in mutants:
        modules[mutant.path].append(mutant)
    for members in modules.values():
        randomness.shuffle(members)
    ordered = [mutant for path in sorted(modules) for mutant in modules[path]]
    step = len(ordered) / count
    start = randomness.random() * step
    chosen = [ordered[min(int(start + i * step), len(ordered) - 1)] for i in range(count)]
    randomness.shuffle(chosen)
    return chosen
