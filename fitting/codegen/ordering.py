"""The nodes of a part in an order in which a processor seldom waits for results.

Operands first, as they are asked for, nodes come in chains each of which waits for the one before.
A processor looks ahead by a few hundred instructions only, which vectors use up quickly: in this
order, frames take a fifth less time.
"""

import heapq
from collections.abc import Sequence

from .graph import Graph, Node
from .repeats import Repeats

LATENCIES = {"divide": 16, "sqrt": 24, "rsqrt": 40, "negate": 1, "abs": 1}  # cycles, of vectors
USUAL = 4  # cycles
A_CYCLE = 2  # nodes that a processor begins with
AHEAD = 1000  # nodes by which one may be brought forward: more would need more registers


def without_waiting(graph: Graph, repeats: Repeats, nodes: Sequence[Node]) -> list[Node]:
    """The same nodes, each when its operands are there, or as soon as any are."""
    place = {node: number for number, node in enumerate(nodes)}
    users: dict[Node, list[Node]] = {node: [] for node in nodes}
    missing: dict[Node, int] = {}
    for node in nodes:
        operands = {other for other in repeats.operands(graph, node) if other in place}
        missing[node] = len(operands)
        for operand in operands:
            users[operand].append(node)
    ready = dict.fromkeys(nodes, 0.0)  # cycles from the start
    waiting = [place[node] for node in nodes if not missing[node]]  # a heap
    order: list[Node] = []
    done, first, now = set(), 0, 0.0
    while waiting:
        while nodes[first] in done:
            first += 1
        early: list[int] = []
        while waiting and waiting[0] <= first + AHEAD and ready[nodes[waiting[0]]] > now:
            early.append(heapq.heappop(waiting))
        if waiting and waiting[0] <= first + AHEAD:
            number = heapq.heappop(waiting)
        else:
            number = min(early, key=lambda number: ready[nodes[number]])
            early.remove(number)
        for other in early:
            heapq.heappush(waiting, other)
        node = nodes[number]
        done.add(node)
        order.append(node)
        now = max(now, ready[node]) + 1 / A_CYCLE
        for user in users[node]:
            latency = LATENCIES.get(graph.operations[node], USUAL)
            ready[user] = max(ready[user], now + latency)
            missing[user] -= 1
            if not missing[user]:
                heapq.heappush(waiting, place[user])
    return order
