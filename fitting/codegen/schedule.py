"""In which order and in which functions the nodes of a program are computed.

A program has a phase for the rays of each round and one for its results. A phase is divided into
parts of bounded length, since the time to compile a function grows faster than its length. What one
part computes and a later one reads, within a frame, is kept in memory between them: in places of
one type each, which are used again once nobody reads them any more.
"""

import dataclasses
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from .graph import CONSTANT, INPUT, Graph, Node
from .repeats import Repeats, find

LONGEST = 1500


class Target(NamedTuple):
    """A number that a phase hands out."""

    struct: str
    """"rays", "state" or "result"."""
    number: int
    """Of the number in its struct, or of the ray."""
    name: str = ""
    """Of a ray: "origin", "direction", "length" or "layers"."""
    axis: int = 0


@dataclasses.dataclass
class Part:
    """What one function computes."""

    nodes: list[Node]
    """In order."""
    targets: list[tuple[Target, Node]]
    reads: dict[Node, int] = dataclasses.field(default_factory=dict)
    """Of earlier parts, with their places in memory."""
    writes: dict[Node, int] = dataclasses.field(default_factory=dict)
    """For later ones."""


@dataclasses.dataclass(frozen=True)
class Schedule:
    """All parts."""

    repeats: Repeats
    """What has a function of its own."""
    phases: list[list[Part]]
    memory: Counter[str]
    """How many places of each type there are."""


def plan(graph: Graph, phases: Sequence[Sequence[tuple[Target, Node]]]) -> Schedule:
    """The parts in which to compute what each phase hands out."""
    repeats = find(graph, [node for targets in phases for _, node in targets])
    computed: set[Node] = set()
    parts = [list(_parts(graph, repeats, targets, computed)) for targets in phases]
    memory = _place(graph, repeats, [part for phase in parts for part in phase])
    return Schedule(repeats, parts, memory)


def is_free(graph: Graph, node: Node) -> bool:
    """Whether a node needs no computing."""
    return graph.operations[node] in (CONSTANT, INPUT)


def _parts(
    graph: Graph,
    repeats: Repeats,
    targets: Sequence[tuple[Target, Node]],
    computed: set[Node],
) -> Iterator[Part]:
    """The parts of a phase; what has been `computed` grows."""
    part = Part([], [])
    for target, result in targets:
        for node in _missing(graph, repeats, result, computed):
            part.nodes.append(node)
            computed.add(node)
            if len(part.nodes) >= LONGEST:
                yield part
                part = Part([], [])
        part.targets.append((target, result))
    yield part


def _missing(graph: Graph, repeats: Repeats, result: Node, computed: set[Node]) -> Iterator[Node]:
    """What has to be computed for a result, operands first."""
    waiting = [(result, False)]
    while waiting:
        node, ready = waiting.pop()
        if node in computed or is_free(graph, node):
            continue
        if ready:
            yield node
            continue
        waiting.append((node, True))
        waiting += [(operand, False) for operand in reversed(repeats.operands(graph, node))]


def _place(graph: Graph, repeats: Repeats, parts: Sequence[Part]) -> Counter[str]:
    """Gives what is read by later parts its place, and counts the places of each type."""
    home = {node: number for number, part in enumerate(parts) for node in part.nodes}
    last: dict[Node, int] = {}
    for number, part in enumerate(parts):
        used = [other for node in part.nodes for other in repeats.operands(graph, node)]
        for node in [*used, *(node for _, node in part.targets)]:
            if home.get(node, number) < number:
                part.reads[node] = -1
                last[node] = number
    counts: Counter[str] = Counter()
    places: dict[Node, int] = {}
    vacant: defaultdict[str, list[int]] = defaultdict(list)
    for number, part in enumerate(parts):
        part.reads = {node: places[node] for node in part.reads}
        for node in part.reads:
            if last[node] == number:
                vacant[graph.types[node]].append(places[node])
        for node in part.nodes:
            if node in last:
                kind = graph.types[node]
                if vacant[kind]:
                    places[node] = vacant[kind].pop()
                else:
                    places[node] = counts[kind]
                    counts[kind] += 1
                part.writes[node] = places[node]
    return counts
