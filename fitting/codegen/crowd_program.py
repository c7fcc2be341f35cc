"""One frame of a system with its rays, as a graph of single numbers."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
from jaxtyping import PyTree

import jaxik
from jaxik.world.terrain import LegTerrains, Terrain

from . import lanes_code, stablehlo
from .graph import BOOL, TABLES, Graph, Node, needed
from .program import Field, Place, Program, exported, fields_of, flat, input_nodes

LARGEST = 16  # numbers of an array of the terrain that become inputs; others are tables

Keep = Callable[[jaxik.Result], PyTree]
"""What of a frame's result is handed out, as a tree of its arrays."""


class CrowdProgram(NamedTuple):
    """A system's frame with its rays."""

    program: Program
    """Without rounds of rays."""
    setup: list[Place]
    """The inputs that it reads of parameters, rig and terrain."""
    moving: list[Place]
    """Those of a frame."""
    tables: list[int]
    """Of the terrain's leaves, the large ones."""

    def source(self, lanes: int) -> str:
        """In C, for so many characters at once."""
        return lanes_code.source(self.program, self.setup, self.moving, lanes)


def build(
    ik: jaxik.FootIK,
    rig: jaxik.Rig,
    terrain: Terrain | LegTerrains,
    frame: jaxik.Frame,
    keep: Keep,
    *,
    checked: bool = False,
) -> CrowdProgram:
    """The program of one character, of these arguments or their shapes, in floats of 32 bits.

    Raises:
        ValueError: the system or its terrain has an operation without a rule, such as a loop, or
            its arrays do not fit the legs.
    """
    with jax.enable_x64(False):
        return _build(ik, rig, terrain, frame, keep, checked)


def _build(
    ik: jaxik.FootIK,
    rig: jaxik.Rig,
    terrain: Terrain | LegTerrains,
    frame: jaxik.Frame,
    keep: Keep,
    checked: bool,
) -> CrowdProgram:
    state = jax.eval_shape(jaxik.init, ik, rig)

    def of_frame(
        ik: jaxik.FootIK, rig: jaxik.Rig, terrain: Terrain, state: jaxik.State, frame: jaxik.Frame
    ) -> tuple[jaxik.State, PyTree]:
        after, result = jaxik.step(ik, rig, terrain, state, frame, trace=True, checked=checked)
        return after, keep(result)

    graph, inputs, tables = Graph(), [], []
    nodes: dict[str, list] = {}
    for struct, tree in (("parameters", ik), ("rig", rig)):
        nodes[struct] = [input_nodes(graph, inputs, struct, f) for f in fields_of(tree)]
    nodes["terrain"] = []
    for number, field in enumerate(fields_of(terrain)):
        if field.size <= LARGEST:
            nodes["terrain"].append(input_nodes(graph, inputs, "terrain", field))
        else:
            nodes["terrain"].append(_table(graph, inputs, field, len(tables)))
            tables.append(number)
    for struct, tree in (("state", state), ("frame", frame)):
        nodes[struct] = [input_nodes(graph, inputs, struct, f) for f in fields_of(tree)]
    trees = (ik, rig, terrain, state, frame)
    outputs = stablehlo.read(
        exported(of_frame, trees), graph, [node for part in nodes.values() for node in part]
    )
    count = len(jax.tree.leaves(state))
    initial = stablehlo.read(
        exported(jaxik.init, (ik, rig)), graph, [*nodes["parameters"], *nodes["rig"]]
    )
    results = {"init": initial, "state": outputs[:count], "result": outputs[count:]}
    kept = jax.eval_shape(of_frame, *trees)[1]
    structs = {"parameters": ik, "rig": rig, "state": state, "frame": frame, "result": kept}
    numbers = {name: flat(part) for name, part in results.items()}
    legs, platforms = len(rig.side), terrain.platform_count
    program = Program(ik, legs, platforms, [], structs, graph, inputs, [], [], numbers)
    return of_program(program, tables)


def of_program(program: Program, tables: list[int]) -> CrowdProgram:
    """A program without rounds of rays, which reads these tables, for many characters."""
    graph = program.graph
    results = {
        name: [_word(graph, node) for node in nodes] for name, nodes in program.results.items()
    }
    reached = needed(graph, [node for nodes in results.values() for node in nodes])
    used = [program.inputs[number] for node, number in graph.inputs.items() if node in reached]
    setup = [place for place in used if place.struct in ("parameters", "rig", "terrain")]
    moving = [place for place in used if place.struct == "frame"]
    return CrowdProgram(dataclasses.replace(program, results=results), setup, moving, tables)


def _word(graph: Graph, node: Node) -> Node:
    """A number as it lies in memory."""
    return graph.add("int_of_bool", node) if graph.types[node] == BOOL else node


def _table(graph: Graph, inputs: list[Place], field: Field, number: int) -> stablehlo.Table:
    """A new input of a graph for a large array."""
    kind = TABLES[field.kind]
    node = graph.input(kind, len(inputs))
    inputs.append(Place("tables", field._replace(kind=kind), (number,)))
    return stablehlo.Table(node, field.kind, field.shape)
