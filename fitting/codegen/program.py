"""One frame of a system as a graph of single numbers, with the rays that it wants in rounds."""

import dataclasses
import functools
import math
import operator
from collections.abc import Callable, Iterator, Sequence
from itertools import groupby
from typing import Any, NamedTuple, TypeAlias, get_args, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jaxtyping import Array, PyTree

import jaxik
from fitting.runtime.precision import with_floats
from jaxik.maths.gate import HARD
from jaxik.pipeline.requests import Request, open_terrain
from jaxik.pipeline.simulation import open_step
from jaxik.stages.inputs import Inputs
from jaxik.world.frame import Stride
from jaxik.world.skeleton import LegPose, Transform
from jaxik.world.terrain import Hit, LegTerrains, Terrain, from_hits

from . import stablehlo
from .graph import BOOL, DTYPES, FLOAT, INT, UNSIGNED, Graph, Node
from .schedule import Schedule, Target, plan

KINDS = {"f": FLOAT, "i": INT, "u": UNSIGNED, "b": BOOL}


class Field(NamedTuple):
    """An array of a struct."""

    path: tuple[str, ...]
    """Names of the structs in which it lies, then its own."""
    kind: str
    shape: tuple[int, ...]
    is_vector: bool = False
    """Whether its last axis is that of vectors or quaternions."""

    @property
    def size(self) -> int:
        """How many numbers it has."""
        return math.prod(self.shape)


Members: TypeAlias = "dict[str, Field | Members]"
"""Of a struct, by their names: arrays, and structs within it."""


class Place(NamedTuple):
    """A number of a struct."""

    struct: str
    field: Field
    index: tuple[int, ...]


class Ray(NamedTuple):
    """The nodes of a ray."""

    origin: tuple[Node, Node, Node]
    direction: tuple[Node, Node, Node]
    length: Node
    layers: Node


@dataclasses.dataclass(frozen=True)
class Program:
    """A system's frame, and its memory before the first one."""

    ik: jaxik.FootIK
    legs: int
    platforms: int
    ups: list[np.ndarray]
    """Up of the body, then of each leg where these have their own."""
    trees: dict[str, PyTree]
    """Parameters, rig, state, frame and result, or their shapes."""
    graph: Graph
    inputs: list[Place]
    """By the number of the input; hits are fields of the struct "hits"."""
    rounds: list[list[Ray]]
    order: list[int]
    """Of each ray of the rounds, its number in `jaxik.step`."""
    results: dict[str, list[Node]]
    """Of memory before the first frame ("init"), of memory after a frame and of its result."""

    @property
    def ray_count(self) -> int:
        """How many rays there are in a frame."""
        return len(self.order)

    def fields(self, struct: str) -> list[Field]:
        """The arrays of a struct, in the order of its leaves."""
        return fields_of(self.trees[struct])

    @functools.cached_property
    def places(self) -> dict[str, list[Place]]:
        """All numbers of each struct, in order."""
        return {struct: list(places_of(struct, tree)) for struct, tree in self.trees.items()}

    def schedule(self) -> Schedule:
        """Its phases: memory before the first frame, the rays of each round, the results."""
        first = [(Target("init", i), node) for i, node in enumerate(self.results["init"])]
        last = [
            (Target(struct, i), node)
            for struct in ("state", "result")
            for i, node in enumerate(self.results[struct])
        ]
        begin, phases = 0, [first]
        for rays in self.rounds:
            phases.append(
                [target for i, ray in enumerate(rays, begin) for target in _targets(i, ray)]
            )
            begin += len(rays)
        return plan(self.graph, [*phases, last])


def blank_frame(legs: int, platforms: int = 0) -> jaxik.Frame:
    """A frame of zeros with a `restart`, as an example of which fields there are."""

    def zeros(*shape: int) -> Array:
        return jnp.zeros(shape, jnp.float32)

    def transforms(*shape: int) -> Transform:
        return Transform(zeros(*shape, 3), zeros(*shape, 4))

    return jaxik.Frame(
        world_from_model=transforms(),
        pose=LegPose(*(transforms(legs) for _ in range(4))),
        weight=zeros(legs), grounded=zeros(), slide=zeros(), velocity_ws=zeros(3),
        foot_speed=zeros(legs), toe_speed=zeros(legs), stride=Stride.unknown(zeros(legs)),
        dt=zeros(), platforms=transforms(platforms), platforms_before=transforms(platforms),
        restart=jnp.zeros((), bool),
    )  # fmt: skip


def blank_value(field: Field) -> np.ndarray:
    """What a frame to begin with has in a field: full foot IK, on the ground, footholds unknown."""
    if field.path[-1] == "rot":
        return np.broadcast_to(np.array([1.0, 0.0, 0.0, 0.0], np.float32), field.shape)
    ones = field.path[-1] in ("weight", "grounded", "standing", "stride_scale")
    return np.full(field.shape, ones, np.float32 if field.kind == FLOAT else np.int32)


def blank_rig(legs: int) -> jaxik.Rig:
    """A rig without measures, as an example of how many legs there are."""
    zeros = jnp.zeros(legs, jnp.float32)
    return jaxik.Rig(
        knee_axis_ls=jnp.zeros((legs, 3), jnp.float32),
        ankle_from_foot=jnp.zeros((legs, 4), jnp.float32),
        thigh=zeros, shin=zeros, foot=zeros, ankle_height=zeros, ball_height=zeros, side=zeros,
        present=jnp.ones(legs, bool), names=tuple(map(str, range(legs))),
        joints=((0, 0, 0, 0),) * legs, pelvis=0,
    )  # fmt: skip


def build(
    ik: jaxik.FootIK,
    rig: jaxik.Rig,
    terrain: Terrain | LegTerrains | None = None,
    frame: jaxik.Frame | None = None,
) -> Program:
    """The program of a system, with hard decisions and floats of 32 bits.

    Args:
        ik: the system; its rules and options are fixed, its numbers are inputs.
        rig: the legs; how many there are is fixed, their measures are inputs.
        terrain: whose up directions are fixed, and which says how many platforms there are; None
            is ground under (0, 1, 0) that does not move.
        frame: a single one with the fields that there are to be; None takes `blank_frame`.

    Raises:
        ValueError: the system has an operation without a rule, such as a loop, or its arrays do not
            fit the legs.
    """
    with jax.enable_x64(False):
        terrain = from_hits(None) if terrain is None else terrain
        if frame is None:
            frame = blank_frame(len(rig.side), terrain.platform_count)
        ik, rig, terrain, frame = with_floats((ik, rig, open_terrain(terrain), frame), jnp.float32)
        return _build(ik, rig, terrain, frame)


def _build(
    ik: jaxik.FootIK, rig: jaxik.Rig, terrain: Terrain | LegTerrains, frame: jaxik.Frame
) -> Program:
    state = jaxik.init(ik, rig)
    opened = open_step(ik, Inputs(rig, terrain, frame, HARD), state)
    arguments = {"parameters": ik, "rig": rig, "state": state, "frame": frame}
    hits = [_blank_hits(shape, terrain.platform_count) for shape in opened.ray_shapes]

    def frame_of(
        ik: jaxik.FootIK, rig: jaxik.Rig, state: jaxik.State, frame: jaxik.Frame, hits: list[Hit]
    ) -> tuple[list[Request], jaxik.State, jaxik.Result]:
        requests, answers = [], iter(hits)

        def answer(request: Request, number: int) -> Hit:
            requests.append(request)
            return next(answers)

        inputs = Inputs(rig, terrain, frame, HARD)
        after, result = opened(answer, ik, inputs, state)
        return requests, after, dataclasses.replace(result, trace=None)

    trees = (ik, rig, state, frame, hits)
    shapes = jax.eval_shape(frame_of, *trees)
    graph, inputs = Graph(), []
    nodes = [
        input_nodes(graph, inputs, name, field)
        for name, tree in arguments.items()
        for field in fields_of(tree)
    ]
    hit_nodes, first = [], 0
    for hit in hits:
        hit_nodes += _hit_inputs(graph, inputs, hit, first)
        first += hit.found.size
    outputs = stablehlo.read(exported(frame_of, trees), graph, [*nodes, *hit_nodes])
    requests, outputs = outputs[: 4 * len(hits)], outputs[4 * len(hits) :]
    after, result = outputs[: len(jax.tree.leaves(state))], outputs[len(jax.tree.leaves(state)) :]
    rounds, order = _rounds(
        graph, inputs, [requests[i : i + 4] for i in range(0, len(requests), 4)]
    )
    count = len(jax.tree.leaves((ik, rig)))
    initial = stablehlo.read(exported(jaxik.init, (ik, rig)), graph, nodes[:count])
    ups = [np.asarray(ground.up_ws) for ground in (terrain, *getattr(terrain, "legs", ()))]
    return Program(
        ik, len(rig.side), terrain.platform_count, ups, arguments | {"result": shapes[2]},
        graph, inputs, rounds, order,
        {"init": flat(initial), "state": flat(after), "result": flat(result)},
    )  # fmt: skip


def constants_of(program: Program) -> dict[str, tuple[str, dict[Field, np.ndarray]]]:
    """By their names, structs that code holds, and their values with floats of 32 bits.

    They are the parameters that the program was made from, and a frame to begin with.
    """
    leaves = (np.asarray(leaf) for leaf in jax.tree.leaves(program.ik))
    numbers = (leaf.astype(DTYPES[KINDS[leaf.dtype.kind]]) for leaf in leaves)
    defaults = dict(zip(program.fields("parameters"), numbers, strict=True))
    frame = {field: blank_value(field) for field in program.fields("frame")}
    return {"defaults": ("parameters", defaults), "blank_frame": ("frame", frame)}


def places_of(struct: str, tree: PyTree) -> Iterator[Place]:
    """All numbers of a struct, in order."""
    for field in fields_of(tree):
        for index in np.ndindex(*field.shape):
            yield Place(struct, field, index)


def fields_of(tree: PyTree) -> list[Field]:
    """The arrays of a tree of structs, in their order."""
    return [
        Field(
            tuple(map(_name, path)),
            KINDS[np.dtype(leaf.dtype).kind],
            tuple(leaf.shape),
            _is_vector(tree, path),
        )
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
    ]


def _is_vector(tree: PyTree, path: Sequence[Any]) -> bool:
    """Whether the class in which an array lies declares a last axis of 3 or 4 numbers."""
    for key in path[:-1]:
        if isinstance(key, jax.tree_util.GetAttrKey):
            tree = getattr(tree, key.name)
        else:
            tree = tree[key.key if isinstance(key, jax.tree_util.DictKey) else key.idx]
    return bool(path) and _name(path[-1]) in _vectors(type(tree))


@functools.cache
def _vectors(cls: type) -> set[str]:
    """The fields of a class with such an axis."""
    vectors, hints = set(), get_type_hints(cls)
    for field in dataclasses.fields(cls) if dataclasses.is_dataclass(cls) else ():
        hint, shape = hints[field.name], field.metadata.get("shape", ())
        axes = [getattr(kind, "dim_str", "").split()[-1:] for kind in (hint, *get_args(hint))]
        if ["3"] in axes or ["4"] in axes or shape[-1:] in ((3,), (4,)):
            vectors.add(field.name)
    return vectors


def members_of(fields: Sequence[Field], depth: int = 0) -> Members:
    """The members of a struct with these arrays, as far as they have numbers.

    Args:
        fields: in their order.
        depth: in how many structs this one lies.
    """
    members: Members = {}
    for name, group in groupby(fields, lambda field: field.path[depth]):
        within = [field for field in group if field.size]
        if within:
            is_array = len(within[0].path) == depth + 1
            members[name] = within[0] if is_array else members_of(within, depth + 1)
    return members


def _name(key: Any) -> str:
    """The name of a part: of a field, or of what lies at a place of a tuple."""
    if isinstance(key, jax.tree_util.SequenceKey):
        return f"part_{key.idx}"
    return str(key.key if isinstance(key, jax.tree_util.DictKey) else key.name)


def exported(function: Callable, trees: tuple) -> export.Exported:
    """A function in StableHLO, of all leaves of these arguments or shapes.

    Of arguments only the shapes count: arrays that are committed to a device would bring it along.
    Lowered for a CPU, as an accelerator that JAX finds here may have calls of its own.
    """
    shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), trees)
    return export.export(jax.jit(function, keep_unused=True), platforms=["cpu"])(*shapes)


def _blank_hits(shape: tuple[int, ...], platforms: int) -> Hit:
    numbers = jnp.zeros(shape, jnp.int32) if platforms else None
    vectors, lengths = jnp.zeros((*shape, 3), jnp.float32), jnp.zeros(shape, jnp.float32)
    return Hit(vectors, vectors, lengths, lengths, numbers)


def input_nodes(graph: Graph, inputs: list[Place], struct: str, field: Field) -> np.ndarray:
    """New inputs of a graph for an array of a struct, in its shape."""
    nodes = np.empty(field.shape, np.int64)
    for index in np.ndindex(*field.shape):
        nodes[index] = graph.input(field.kind, len(inputs))
        inputs.append(Place(struct, field, tuple(index)))
    return nodes


def _hit_inputs(graph: Graph, inputs: list[Place], hits: Hit, first: int) -> list[np.ndarray]:
    """New inputs of a graph for the hits of a call, whose first ray has this number."""
    rank, nodes = hits.found.ndim, []
    for field in fields_of(hits):
        array = np.empty(field.shape, np.int64)
        for number, index in enumerate(np.ndindex(*field.shape[:rank])):
            for axis in np.ndindex(*field.shape[rank:]):
                array[(*index, *axis)] = graph.input(field.kind, len(inputs))
                inputs.append(Place("hits", field, (first + number, *axis)))
        nodes.append(array)
    return nodes


def flat(arrays: Sequence[np.ndarray]) -> list[Node]:
    """The nodes of all arrays, in order."""
    return [int(node) for array in arrays for node in array.flat]


def _rounds(
    graph: Graph, inputs: list[Place], calls: list[Sequence[np.ndarray]]
) -> tuple[list[list[Ray]], list[int]]:
    """The rays in rounds, of which none needs hits of its own round or a later one; see `Program`.

    The hits among the inputs get the numbers of this order.
    """
    sizes = [call[2].size for call in calls]
    firsts = [sum(sizes[:number]) for number in range(len(sizes))]
    call_of_ray = [number for number, size in enumerate(sizes) for _ in range(size)]
    known: list[int] = []  # of each node, a bit for each call on whose hits it depends
    for node, operands in enumerate(graph.operands):
        known.append(functools.reduce(operator.or_, (known[other] for other in operands), 0))
        place = inputs[graph.inputs[node]] if node in graph.inputs else None
        if place is not None and place.struct == "hits":
            known[node] = 1 << call_of_ray[place.index[0]]
    levels: list[int] = []
    for call in calls:
        bits = functools.reduce(operator.or_, (known[node] for x in call for node in x.flat), 0)
        levels.append(1 + max((levels[i] for i in range(len(levels)) if bits >> i & 1), default=-1))
    rounds: list[list[Ray]] = [[] for _ in range(max(levels, default=-1) + 1)]
    order: list[int] = []
    for level in range(len(rounds)):
        for number, call in enumerate(calls):
            if levels[number] == level:
                rounds[level] += _rays(graph, call)
                order += range(firsts[number], firsts[number] + sizes[number])
    place_of = {ray: place for place, ray in enumerate(order)}
    for number, place in enumerate(inputs):
        if place.struct == "hits":
            moved = (place_of[place.index[0]], *place.index[1:])
            inputs[number] = place._replace(index=moved)
    return rounds, order


def _rays(graph: Graph, call: Sequence[np.ndarray]) -> Iterator[Ray]:
    """The rays of a call; they run along -up."""
    origins, ups, lengths, layers = call
    rows = zip(
        origins.reshape(-1, 3).tolist(), ups.reshape(-1, 3).tolist(),
        lengths.ravel().tolist(), layers.ravel().tolist(), strict=True,
    )  # fmt: skip
    for (x, y, z), up, length, mask in rows:
        a, b, c = (graph.add("negate", node) for node in up)
        yield Ray((x, y, z), (a, b, c), length, mask)


def _targets(number: int, ray: Ray) -> Iterator[tuple[Target, Node]]:
    for name, nodes in (("origin", ray.origin), ("direction", ray.direction)):
        for axis, node in enumerate(nodes):
            yield Target("rays", number, name, axis), node
    yield Target("rays", number, "length"), ray.length
    yield Target("rays", number, "layers"), ray.layers
