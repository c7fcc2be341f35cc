"""What a graph computes again and again, as functions of their own: that makes code shorter.

A function takes the place of a node and of all nodes that only this one needs, as far down as they
depend on few others. A smoothstep, for example, occurs a thousand times in `stride`: as a function
it makes the code a tenth shorter, and faster too, since more of it stays in a processor's cache.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from .graph import CONSTANT, INPUT, Graph, Node, needed

ARGUMENTS = 4  # of a function, at most
SMALLEST, LARGEST = 5, 60  # nodes of a function
OFTEN = 12  # calls, at least


class Call(NamedTuple):
    """A node that is computed by a function."""

    number: int
    """Of the function."""
    arguments: tuple[Node, ...]


class Cone(NamedTuple):
    """A node with those that only it needs."""

    nodes: tuple[Node, ...]
    """Operands first; the last is the one that others need."""
    arguments: tuple[Node, ...]


class Repeats(NamedTuple):
    """The functions of a graph and their calls."""

    functions: list[Cone]
    """One of the places that each stands for."""
    calls: dict[Node, Call]

    def operands(self, graph: Graph, node: Node) -> tuple[Node, ...]:
        """What has to be there for a node to be computed."""
        return self.calls[node].arguments if node in self.calls else graph.operands[node]


def find(graph: Graph, results: Iterable[Node]) -> Repeats:
    """The functions that make the code of these results shortest, the largest first."""
    results = set(results)
    live = needed(graph, results)
    users: defaultdict[Node, set[Node]] = defaultdict(set)
    for node in live:
        for operand in graph.operands[node]:
            users[operand].add(node)
    alike: defaultdict[tuple, list[Cone]] = defaultdict(list)
    for node in sorted(live):
        if (cone := _cone(graph, node, users, results)) is not None:
            alike[_shape(graph, cone)].append(cone)
    functions: list[Cone] = []
    calls: dict[Node, Call] = {}
    taken: set[Node] = set()
    for cones in sorted(alike.values(), key=lambda cones: -len(cones) * len(cones[0].nodes)):
        vacant = _apart(cones, taken)
        if len(vacant) >= OFTEN:
            for cone in vacant:
                calls[cone.nodes[-1]] = Call(len(functions), cone.arguments)
                taken.update(cone.nodes)
            functions.append(vacant[0])
    return Repeats(functions, calls)


def _apart(cones: Sequence[Cone], taken: set[Node]) -> list[Cone]:
    """Those cones that share no node with others, or with what is taken."""
    met, apart = set(), []
    for cone in cones:
        if taken.isdisjoint(cone.nodes) and met.isdisjoint(cone.nodes):
            met.update(cone.nodes)
            apart.append(cone)
    return apart


def _cone(
    graph: Graph, root: Node, users: dict[Node, set[Node]], results: set[Node]
) -> Cone | None:
    """The largest cone of a node that has few arguments; None if it is small."""
    nodes, largest = {root}, None
    leaves = dict.fromkeys(_variable(graph, root))
    while len(nodes) < LARGEST:
        inner = [
            leaf
            for leaf in leaves
            if graph.operations[leaf] != INPUT and leaf not in results and users[leaf] <= nodes
        ]
        if not inner:
            break
        chosen = min(inner, key=lambda leaf: len(leaves.keys() | _variable(graph, leaf)))
        del leaves[chosen]
        nodes.add(chosen)
        leaves |= dict.fromkeys(_variable(graph, chosen))
        if len(leaves) <= ARGUMENTS:
            largest = tuple(sorted(nodes))
    if largest is None or len(largest) < SMALLEST:
        return None
    return Cone(largest, _arguments(graph, largest))


def _arguments(graph: Graph, nodes: tuple[Node, ...]) -> tuple[Node, ...]:
    """What a cone depends on, in the order in which its last node leads there."""
    inside, order, waiting = set(nodes), {}, [nodes[-1]]
    met = set()
    while waiting:
        node = waiting.pop()
        if node in met:
            continue
        met.add(node)
        if node in inside:
            waiting += reversed(graph.operands[node])
        elif graph.operations[node] != CONSTANT:
            order[node] = None
    return tuple(order)


def _shape(graph: Graph, cone: Cone) -> tuple:
    """Equal for cones that compute the same of their arguments."""
    numbers: dict[Node, int] = {}

    def describe(node: Node) -> tuple:
        if node in numbers:
            return ("again", numbers[node])
        if node in cone.arguments or graph.operations[node] == CONSTANT:
            value = graph.values[node]
            numbers[node] = len(numbers)
            return (graph.types[node], None if value is None else value.tobytes())
        parts = tuple(describe(operand) for operand in graph.operands[node])
        numbers[node] = len(numbers)
        return (graph.operations[node], *parts)

    return describe(cone.nodes[-1])


def _variable(graph: Graph, node: Node) -> set[Node]:
    """The operands of a node that are no constants."""
    return {other for other in graph.operands[node] if graph.operations[other] != CONSTANT}
