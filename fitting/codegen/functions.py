"""The functions of a program, as far as languages have them in common."""

import abc
import functools
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from string import ascii_lowercase
from typing import NamedTuple

from .graph import BOOL, FLOAT, INT, TABLES, UNSIGNED, Node, Number, needed
from .program import Place, Program
from .repeats import Cone, Repeats
from .routines import Routine
from .schedule import Part, Schedule, Target, is_free

WIDTH = 110  # letters
LETTERS = {FLOAT: "f", INT: "i", UNSIGNED: "u", BOOL: "b", **dict.fromkeys(TABLES.values(), "t")}


class Language(abc.ABC):
    """How a language writes numbers, operations, structs and functions.

    An @ in any text becomes the prefix of all names.
    """

    name: str
    expressions: Mapping[tuple[str, str], str]
    """By operation and type of the operands, of which {0} is the first."""
    helpers: Mapping[str, str]
    """Functions that expressions call, by their names without the prefix."""
    width: int = WIDTH
    """Of an expression, from which it gets a name of its own."""

    @abc.abstractmethod
    def literal(self, value: Number) -> str:
        """A constant."""

    @abc.abstractmethod
    def local(self, kind: str, name: str, text: str) -> str:
        """The line that gives the value of an expression a name."""

    @abc.abstractmethod
    def work(self, kind: str, place: int) -> str:
        """What one part leaves for later ones."""

    @abc.abstractmethod
    def input(self, place: Place) -> str:
        """An expression for an input."""

    @abc.abstractmethod
    def output(self, target: Target, place: Place | None) -> str:
        """What a number is assigned to; a ray has no place in a struct."""

    @abc.abstractmethod
    def part(self, name: str, lines: Sequence[str]) -> tuple[str, list[str]]:
        """A function without a result, and the arguments that it has to be given."""

    @abc.abstractmethod
    def shared(
        self, name: str, kind: str, arguments: Sequence[tuple[str, str]], lines: Sequence[str]
    ) -> str:
        """A function with a result of a type and arguments, each a type and a name."""


class Parts(NamedTuple):
    """The functions of all phases."""

    texts: list[str]
    calls: list[list[tuple[str, list[str]]]]
    """Of each phase: the names of its functions, with what each has to be given."""


def parts_of(program: Program, schedule: Schedule, language: Language) -> Parts:
    """The functions of a program in a language, in an order in which each is there when called.

    Raises:
        ValueError: an operation on a type for which there is no expression.
    """
    texts, calls, number, repeats = [], [], 0, schedule.repeats
    for cone in repeats.functions:
        texts.append(_shared(program, language, cone, len(texts)))
    for phase in schedule.phases:
        calls.append([])
        for part in phase:
            lines = _Function(program, language, part, repeats).write()
            text, arguments = language.part(f"@part_{number}", lines)
            texts.append(text)
            calls[-1].append((f"@part_{number}", arguments))
            number += 1
    return Parts(texts, calls)


def helpers_in(language: Language, text: str) -> list[str]:
    """The helpers that this code calls."""
    return [body for name, body in language.helpers.items() if f"@{name}(" in text]


def phase_name(phase: int, rounds: int) -> str:
    """The name of the function of a phase."""
    return "init" if phase == 0 else "step" if phase > rounds else f"rays_{phase}"


def inputs_of(phase: int, rounds: int) -> list[str]:
    """The names of what the function of a phase is given, and of what it hands out."""
    if phase == 0:
        return ["parameters", "rig", "state"]
    hits = ["hits"] if phase > 1 else []
    handed = "rays" if phase <= rounds else "result"
    return ["parameters", "rig", "state", "frame", *hits, "work", handed]


def calls_of(
    program: Program, call: Callable[[int, int], str], *, casts: bool = False
) -> Iterator[str]:
    """The lines of a frame.

    Args:
        program: what is called.
        call: of a phase, with the number of rounds.
        casts: whether a call `cast(first, end)` follows the rays of each round.
    """
    rounds, first = len(program.rounds), 0
    for phase, rays in enumerate(program.rounds, 1):
        yield call(phase, rounds)
        if casts:
            yield f"cast({first}, {first + len(rays)});"
        first += len(rays)
    yield call(rounds + 1, rounds)


def fill(template: str, fillings: Mapping[str, str]) -> str:
    """A text with each of these words, in this order, replaced."""
    return functools.reduce(lambda text, pair: text.replace(*pair), fillings.items(), template)


def routine_lines(routine: Routine, language: Language) -> list[str]:
    """The lines of a routine.

    Raises:
        ValueError: an operation on a type for which there is no expression.
    """
    graph = routine.graph
    nodes = sorted(needed(graph, [node for _, node in routine.targets]))
    part = Part([node for node in nodes if not is_free(graph, node)], routine.targets)
    return _Function(routine, language, part, Repeats([], {})).write()


def body_of(lines: Sequence[str]) -> str:
    """The lines of a function, indented."""
    return "\n".join(f"    {line}" for line in lines)


class _Function:
    """The lines of one part."""

    def __init__(
        self, program: Program | Routine, language: Language, part: Part, repeats: Repeats
    ) -> None:
        self.program, self.graph, self.part, self.repeats = program, program.graph, part, repeats
        self.language = language
        self.uses = Counter(node for node in part.writes)
        for node in part.nodes:
            operands = repeats.operands(self.graph, node)
            twice = self._expression(node).count("{0}") > 1
            self.uses.update(operands * (2 if twice else 1))
        self.uses.update(node for _, node in part.targets)
        self.texts: dict[Node, str] = {}
        self.lines: list[str] = []

    def write(self) -> list[str]:
        """All lines."""
        self.compute()
        for target, node in self.part.targets:
            self.lines.append(f"{self._output(target)} = {bare(self._text(node))};")
        for node, place in self.part.writes.items():
            target = self.language.work(self.graph.types[node], place)
            self.lines.append(f"{target} = {self.texts[node]};")
        return self.lines

    def compute(self) -> None:
        """Writes what computes all nodes, but for the expressions of those that are used once."""
        for node in self.part.nodes:
            operands = map(self._text, self.repeats.operands(self.graph, node))
            text = self._expression(node).format(*operands)
            single = self.uses[node] == 1 and node not in self.part.writes
            self.texts[node] = (
                text if single and len(text) < self.language.width else self._local(node, text)
            )

    def _expression(self, node: Node) -> str:
        if node in self.repeats.calls:
            number, arguments = self.repeats.calls[node]
            places = ", ".join(f"{{{place}}}" for place in range(len(arguments)))
            return f"@shared_{number}({places})"
        operation, operands = self.graph.operations[node], self.graph.operands[node]
        key = operation, self.graph.types[operands[-1]]
        if key not in self.language.expressions:
            raise ValueError(
                f"{self.language.name} has no rule for the operation {key[0]!r} on numbers of "
                f"type {key[1]}"
            )
        return self.language.expressions[key]

    def _text(self, node: Node) -> str:
        """An expression for a node that is there."""
        if node not in self.texts:
            if (value := self.graph.values[node]) is not None:
                self.texts[node] = self.language.literal(value)
            else:
                if node in self.graph.inputs:
                    text = self.language.input(self.program.inputs[self.graph.inputs[node]])
                else:
                    text = self.language.work(self.graph.types[node], self.part.reads[node])
                self.texts[node] = self._local(node, text) if self.uses[node] > 1 else text
        return self.texts[node]

    def _local(self, node: Node, text: str) -> str:
        kind = self.graph.types[node]
        name = f"{LETTERS[kind]}{len(self.lines)}"
        self.lines.append(self.language.local(kind, name, bare(text)))
        return name

    def _output(self, target: Target) -> str:
        if target.struct == "rays":
            return self.language.output(target, None)
        struct = "state" if target.struct == "init" else target.struct
        return self.language.output(target, self.program.places[struct][target.number])


def _shared(program: Program, language: Language, cone: Cone, number: int) -> str:
    """What occurs often as a function."""
    types = program.graph.types
    function = _Function(program, language, Part(list(cone.nodes), []), Repeats([], {}))
    arguments = []
    for letter, argument in zip(ascii_lowercase, cone.arguments, strict=False):
        function.texts[argument] = letter
        arguments.append((types[argument], letter))
    function.compute()
    last = cone.nodes[-1]
    lines = [*function.lines, f"return {bare(function.texts[last])};"]
    return language.shared(f"@shared_{number}", types[last], arguments, lines)


def bare(text: str) -> str:
    """An expression without parentheses around all of it."""
    if not text.startswith("("):
        return text
    depth = 0
    for position, letter in enumerate(text):
        depth += (letter == "(") - (letter == ")")
        if depth == 0:
            return text[1:-1] if position == len(text) - 1 else text
    return text
