"""Code of systems: it compiles without a warning, and gives the answers of `jaxik.step`."""

# pyright: reportArgumentType=false

import dataclasses
import functools
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax._src import xla_bridge
from jaxtyping import Array

import jaxik
from fitting.bench import workloads
from fitting.clips.clip_frames import frames_from_clip
from fitting.codegen import (
    c_code,
    crowd,
    cs_code,
    export,
    js_code,
    lanes_code,
    program,
    stablehlo,
    toolchain,
)
from fitting.codegen.graph import DTYPES, TABLES, Graph
from fitting.codegen.toolchain import Compiled, Playback
from jaxik.maths import parameter_tree, smoothing, vec
from jaxik.maths.gate import HARD
from jaxik.maths.struct import struct
from jaxik.pipeline import step_and_rays
from jaxik.pipeline.requests import Request
from jaxik.world import terrain
from jaxik.world.terrain import Hit
from support import node
from support.mono import DOUBLES, Mono, needs_mono
from support.node import needs_node

CLOSE = 1e-5  # m, or of a quaternion
STRICT = ("-Wall", "-Wextra", "-Werror", "-pedantic")
C, CPP = ("-std=c99", *STRICT), ("-x", "c++", "-std=c++11", *STRICT)


def compiler(language: str) -> str:
    path = toolchain.compiler(language)
    if path is None:
        pytest.skip(f"needs a compiler of {language}: none in $CC or $CXX, no cc or c++")
    return path


class Recorded(NamedTuple):
    """Frames of a system in JAX, with a leading axis of frames."""

    states: jaxik.State
    results: jaxik.Result
    rays: Request
    hits: Hit


@functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
def recorded(ik, rig, ground, frames) -> Recorded:
    def advance(state, frame):
        state, result, rays, hits = step_and_rays(ik, rig, ground, state, frame)
        return state, Recorded(state, result, rays, hits)

    return jax.lax.scan(advance, jaxik.init(ik, rig), frames)[1]


def largest_difference(ours: Any, theirs: Any) -> float:
    """Of all numbers of two trees; equal infinities do not differ."""
    differences = [0.0]
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
        with np.errstate(invalid="ignore"):
            differences.append(np.max(np.where(a == b, 0.0, np.abs(a - b)), initial=0.0))
    return float(np.max(differences))


@pytest.fixture(scope="module")
def walk() -> tuple[jaxik.Rig, jaxik.Frame]:
    clip = workloads.walk(60)
    rig, frames = workloads.single((clip.rig, frames_from_clip(clip)))
    restart = np.zeros(60, bool)
    restart[40] = True
    return rig, dataclasses.replace(frames, restart=jnp.asarray(restart))


@pytest.fixture(scope="module")
def hills() -> terrain.Terrain:
    x, z = np.meshgrid(np.linspace(-4, 4, 33), np.linspace(-4, 4, 33))
    heights = 0.05 * np.sin(2.0 * x) + 0.04 * np.cos(3.0 * z)
    return terrain.heightfield(heights.astype(np.float32), 0.25, origin=(-4.0, 0.0, -4.0))


@pytest.fixture(scope="module")
def unreal(walk, hills) -> tuple[jaxik.FootIK, Recorded]:
    """A small system of two rounds, which acts while the character walks, and its motion."""
    ik = parameter_tree.replace(jaxik.presets.unreal(walk[0]), {"contact.idle_speed": 9.0})
    ik = workloads.single(ik)
    with jax.enable_x64(False):
        return ik, jax.device_get(recorded(ik, walk[0], hills, walk[1]))


def test_generated_c_gives_the_answers_of_jaxik_step(tmp_path, walk, hills, unreal):
    rig, frames = walk
    ik, expected = unreal
    frame = jax.tree.map(lambda leaf: leaf[0], frames)
    exported = export.export_c(ik, rig, tmp_path, terrain=hills, frame=frame)
    assert [len(rays) for rays in exported.rounds] == [12, 12]
    assert 0 < expected.hits.found.mean() <= 1
    for language, flags in {"c": ("-O1", *C), "c++": ("-O0", *CPP)}.items():
        compiled = Compiled(exported, tmp_path, "footik", [compiler(language), *flags])
        play = Playback(compiled, (ik, rig), frames, expected.hits)
        play()
        states, rays, results = play.outputs()
        assert largest_difference(results, expected.results) < CLOSE, language
        assert largest_difference(states, expected.states) < CLOSE, language
        assert largest_difference(rays, expected.rays) < CLOSE, language


@needs_mono
def test_generated_csharp_gives_the_answers_of_jaxik_step(tmp_path, walk, hills, unreal):
    rig, frames = walk
    ik, expected = unreal
    frame = jax.tree.map(lambda leaf: leaf[0], frames)
    system = export.export_system(ik, rig, tmp_path, language="cs", terrain=hills, frame=frame)
    assert '"m/s, 0 to 3: Speed of the char' in (tmp_path / "Footik.cs").read_text()
    play = Playback(Mono(system, tmp_path, "footik"), (ik, rig), frames, expected.hits)
    play()
    states, rays, results = play.outputs()
    assert largest_difference(results, expected.results) < CLOSE
    assert largest_difference(states, expected.states) < CLOSE
    assert largest_difference(rays, expected.rays) < CLOSE


@needs_node
def test_generated_javascript_gives_the_answers_of_jaxik_step(tmp_path, walk, hills, unreal):
    rig, frames = walk
    ik, expected = unreal
    frame = jax.tree.map(lambda leaf: leaf[0], frames)
    system = export.export_system(ik, rig, tmp_path, language="js", terrain=hills, frame=frame)
    states, rays, results = node.played(
        system, tmp_path, "footik", (ik, rig), frames, expected.hits
    )
    assert largest_difference(results, expected.results) < CLOSE
    assert largest_difference(states, expected.states) < CLOSE
    assert largest_difference(rays, expected.rays) < CLOSE


@pytest.mark.slow
def test_a_crowd_in_lanes_gives_the_answers_of_jaxik_run(walk, hills, unreal, monkeypatch):
    """Characters that begin with the clip, or where it restarts, beside others that differ."""
    compiler("c")
    rig, frames = walk
    ik, expected = unreal
    characters, bad, other = 19, 3, 17
    starts = np.where(np.arange(characters) % 2, 40, 0)
    weight = np.repeat(np.asarray(frames.weight)[None], characters, axis=0)
    weight[bad, 45] = np.nan
    many = dataclasses.replace(frames, weight=weight)
    speeds = np.where(np.arange(characters) == other, 0.0, 9.0).astype(np.float32)
    varied = parameter_tree.replace(ik, {"contact.idle_speed": speeds})
    axes = [
        jax.tree.map(lambda a, b: None if np.shape(a) == np.shape(b) else 0, *pair)
        for pair in ((varied, ik), (many, frames))
    ]
    arguments = (varied, rig, hills, many, (axes[0], None, None, axes[1]))
    results = crowd.run_crowd(*arguments, starts=starts, count=20)
    last = crowd.run_crowd(*arguments, -1, starts=starts, count=20)
    assert crowd.kernel_of(*arguments).lanes in (4, 8, 16)
    for a, b in zip(jax.tree.leaves(results), jax.tree.leaves(last), strict=True):
        np.testing.assert_array_equal(a, np.moveaxis(b, -1, 0))
    for character, start in enumerate(starts):
        ours = jax.tree.map(lambda leaf: leaf[character], results)  # noqa: B023
        theirs = jax.tree.map(lambda leaf: leaf[start : start + 20], expected.results)  # noqa: B023
        if character == bad:
            assert ours.faulty[5].all() and ours.faulty.sum() == 2
            ours, theirs = (jax.tree.map(lambda leaf: leaf[:5], tree) for tree in (ours, theirs))
        near = largest_difference(ours, theirs) < CLOSE
        assert near == (character != other), character
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(ours))


def test_a_crowd_without_compiled_code_says_why(walk, hills, unreal, monkeypatch):
    rig, frames = walk
    ik, _ = unreal
    many = jax.tree.map(lambda leaf: np.asarray(leaf)[None], frames)

    def reason(ground: Any, frames: jaxik.Frame = many, **options: Any) -> str:
        with pytest.raises(crowd.NoKernelError) as refused:
            crowd.kernel_of(ik, rig, ground, frames, **options)
        return str(refused.value)

    triangle = terrain.mesh(np.float32([[0, 0, 0], [0, 0, 1], [1, 0, 0]]), np.int32([[0, 1, 2]]))
    doubles = dataclasses.replace(many, weight=many.weight.astype(np.float64))
    assert "rays onto meshes have a loop" in reason(triangle)
    assert "'float64'" in reason(hills, doubles)
    monkeypatch.setattr(toolchain, "compiler", lambda: None)
    assert "no C compiler" in reason(hills, checked=True)
    monkeypatch.setenv(crowd.SWITCH, "0")
    assert crowd.SWITCH in reason(hills)
    for options, message in (
        ({"in_axes": (None,) * 4}, "numbers of characters: []; wanted one"),
        ({"starts": np.array([3])}, "60 frames from frames 3 to 3 on; the clip has 60"),
        ({"starts": np.array([0, 0])}, "numbers of characters: [1, 2]"),
    ):
        with pytest.raises(ValueError, match=re.escape(message)):
            crowd.run_crowd(ik, rig, hills, many, **options)


@struct
class Numbers:
    """A row of operands."""

    x: Array
    y: Array
    i: Array
    j: Array
    u: Array
    v: Array
    b: Array
    c: Array


@struct
class Outcomes:
    """What operations give for a row, by their names."""

    exact: dict[str, Array]
    rounded: dict[str, Array]


FLOATS = (0.0, -0.0, 1.0, -1.0, 0.5, -0.5, 1.5, 2.5, -2.5, 3.7, 1e-30, -1e-6, 0.9999999, 8388607.5)
FLOATS += (-8388606.5, 16777216.0, 3e9, -3e9, 5e9, 3e38, -3e38, np.inf, -np.inf, np.nan)
INTS = (0, 1, -1, 2, 31, 33, -7, 2**31 - 1, -(2**31))
SMALL = {name: np.arange(size, dtype=np.float32) for name, size in (("a", 4), ("b", 6))}
UNARY = "neg abs sign floor ceil".split()
ROUNDED = "sqrt rsqrt cbrt exp expm1 log log1p cos sin tan tanh logistic".split()
BINARY = "add sub mul div max min rem".split()
COMPARED = "lt le eq ne gt ge".split()
BITS = "and or xor".split()
SHIFTS = "shift_left shift_right_arithmetic shift_right_logical".split()


def operated(n: Numbers) -> Outcomes:
    """Every operation of StableHLO that has a rule, of one row."""
    bitwise = {name: getattr(jax.lax, f"bitwise_{name}") for name in BITS}
    exact = {name: getattr(jax.lax, name)(n.x) for name in UNARY}
    exact |= {name: getattr(jax.lax, name)(n.x, n.y) for name in BINARY}
    exact |= {f"{name}_int": getattr(jax.lax, name)(n.i) for name in ("neg", "abs", "sign")}
    for kind, left, right in (("int", n.i, n.j), ("unsigned", n.u, n.v)):
        for name in ("add", "sub", "mul", "max", "min", *SHIFTS):
            if (name, kind) != ("shift_right_arithmetic", "unsigned"):
                exact[f"{name}_{kind}"] = getattr(jax.lax, name)(left, right)
    for kind, left, right in (("int", n.i, n.j), ("unsigned", n.u, n.v), ("bool", n.b, n.c)):
        exact |= {f"{name}_{kind}": bitwise[name](left, right) for name in BITS}
        exact[f"not_{kind}"] = jax.lax.bitwise_not(left)
    exact |= {
        f"{name}_bool": getattr(jax.lax, name)(n.b, n.c) for name in (*COMPARED, "max", "min")
    }
    exact["neg_unsigned"] = jax.lax.neg(n.u)
    exact["select_bool"] = jnp.where(n.x > 0, n.b, n.c)
    for kind, left, right in (("float", n.x, n.y), ("int", n.i, n.j), ("unsigned", n.u, n.v)):
        exact |= {f"{name}_{kind}": getattr(jax.lax, name)(left, right) for name in COMPARED}
        exact[f"select_{kind}"] = jnp.where(n.b, left, right)
        for type_ in (np.float32, np.int32, np.uint32, bool):
            exact[f"{type_.__name__}_of_{kind}"] = left.astype(type_)
    for type_ in (np.float32, np.int32, np.uint32):
        exact[f"{type_.__name__}_of_bool"] = n.b.astype(type_)
    exact |= {
        "finite": jax.lax.is_finite(n.x),
        "even": jnp.round(n.x),
        "clamped": jax.lax.clamp(-1.0, n.x, 2.0),
        "clipped": smoothing.clip_to_one(n.x),
        "copied_sign": jnp.copysign(n.x, n.y),
        "guarded": vec.safe_sqrt(n.x) + vec.safe_divide(n.x, n.y),
        "bits": jax.lax.bitcast_convert_type(n.x, np.int32) & 255,
        "float_of_bits": jax.lax.bitcast_convert_type(n.u & 0x3F8FFFFF, np.float32),
        "decision": jnp.where(HARD.below(n.x, n.y, band=1.0) > 0.5, n.x, 1.0 - n.y),
    }
    row = jnp.stack([n.x, n.y, n.x, jnp.float32(2.0)])
    table = jnp.stack([row, row[::-1], jnp.arange(4.0, dtype=np.float32)])
    exact |= {
        "reshaped": table.reshape(2, 3, 2),
        "reversed": jax.lax.rev(table, (0, 1)),
        "padded": jax.lax.pad(table, n.y, ((1, -1, 0), (0, 1, 2))),
        "sliced": table.T[1::2],
        "dynamic": jax.lax.dynamic_slice(table, (n.i, n.j), (2, 3)),
        "gathered": table.at[jnp.stack([n.i, n.j])].get(mode="clip"),
        "elements": table.at[jnp.stack([n.j, n.i]), 2].get(mode="clip"),
        "largest": jnp.max(table, axis=1),
        "place": jnp.argmin(jnp.stack([n.x, n.y, jnp.float32(1.0)])),
        "once": jax.lax.optimization_barrier(n.x),
    }
    rounded = {name: getattr(jax.lax, name)(n.x) for name in ROUNDED}
    rounded |= {
        "power": jnp.where(n.x > 0, n.x, 1.0) ** jnp.where(jnp.isfinite(n.y), n.y, 1.0),
        "atan2": jax.lax.atan2(n.x, n.y),
        "third": n.x / 3.0,
        "scaled": (n.x * 3.0) * 0.7,
        "sum": jnp.sum(jnp.where(jnp.abs(table) < 1e6, table, 0.0), axis=0),
        "products": jnp.dot(jnp.where(jnp.abs(table) < 1e6, table, 0.0), jnp.ones((4, 2))),
        "arcsine": jnp.arcsin(n.x),
    }
    return Outcomes(exact, rounded)


def test_programs_are_lowered_for_a_cpu_whatever_accelerator_is_here(monkeypatch):
    monkeypatch.setattr(xla_bridge, "default_backend", lambda: "tpu")
    assert program.exported(jnp.sin, (jnp.ones(3),)).platforms == ("cpu",)


def program_of(function: Callable, row: Any, ik: jaxik.FootIK, rig: jaxik.Rig) -> program.Program:
    """A program whose result is that of a function of its frame."""
    graph, inputs = Graph(), []
    nodes = [program.input_nodes(graph, inputs, "frame", field) for field in program.fields_of(row)]
    outputs = stablehlo.read(program.exported(function, (row,)), graph, nodes)
    state = jaxik.init(ik, rig)
    places = program.places_of("state", state)
    zeros = [graph.constant(DTYPES[place.field.kind](0)) for place in places]
    trees = {"parameters": ik, "rig": rig, "state": state, "frame": row}
    trees["result"] = jax.eval_shape(function, row)
    results = {"init": zeros, "state": zeros, "result": program.flat(outputs)}
    return program.Program(ik, 2, 0, [], trees, graph, inputs, [], [], results)


def rows_of_operands() -> Numbers:
    """All pairs of edge cases of floats, with those of other types in turn."""
    x, y = (column.ravel() for column in np.meshgrid(np.float32(FLOATS), np.float32(FLOATS)))
    i, j = (column.ravel() for column in np.meshgrid(np.int32(INTS), np.int32(INTS)))
    i, j = np.resize(i, len(x)), np.resize(j, len(x))
    u, v, b = i.view(np.uint32), j.view(np.uint32), np.resize([True, False, False], len(x))
    return Numbers(x, y, i, j, u, v, b, np.resize([True, False], len(x)))


@pytest.fixture(scope="module")
def operands():
    with jax.enable_x64(False):
        rows = rows_of_operands()
        compiled = jax.jit(
            jax.vmap(operated), compiler_options={"xla_backend_optimization_level": 0}
        )
        return rows, jax.device_get(compiled(rows))


SMALLEST = 1.2e-38  # below, XLA takes numbers for 0


def differing(ours: Outcomes, theirs: Outcomes, exact: float = SMALLEST) -> dict[str, Any]:
    """What differs, by operation: how often, and the first place.

    Args:
        ours: of the code.
        theirs: of JAX.
        exact: by which fraction operations may differ that every processor rounds alike.
    """
    wrong = {}
    for name, b in (theirs.exact | theirs.rounded).items():
        a = (ours.exact | ours.rounded)[name]
        rounding = 3e-6 if name in theirs.rounded else exact
        same = np.isclose(a, b, rtol=rounding, atol=rounding, equal_nan=True)
        if not same.all():
            wrong[name] = (
                int((~same).sum()),
                *(x[~same][0] for x in (a, b)),
                np.argwhere(~same)[0],
            )
    return wrong


@pytest.fixture(scope="module")
def operations(operands, walk) -> program.Program:
    with jax.enable_x64(False):
        row = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), operands[0])
        return program_of(
            operated, row, workloads.single(jaxik.presets.ozz(faithful=True)), walk[0]
        )


@pytest.fixture
def no_routines(monkeypatch):
    """As of frames that are rows of operands."""
    for module in (c_code, cs_code, js_code):
        monkeypatch.setattr(module, "routines", lambda program: [])


@pytest.mark.usefixtures("no_routines")
def test_every_operation_gives_the_answers_of_jax(tmp_path, walk, operands, operations):
    rows, expected = operands
    for file, text in c_code.sources(operations, "rules").items():
        (tmp_path / file).write_text(text)
    compiled = Compiled(operations, tmp_path, "rules", [compiler("c"), "-O0", *C])
    hits = Hit(*(jnp.zeros((len(rows.x), 0, *size), jnp.float32) for size in ((3,), (3,), (), ())))
    play = Playback(compiled, (operations.ik, walk[0]), rows, hits)
    play()
    assert differing(play.outputs().results, expected) == {}


@needs_mono
@pytest.mark.usefixtures("no_routines")
@pytest.mark.parametrize("options", [(), (DOUBLES,)], ids=["floats", "doubles"])
def test_every_operation_in_csharp_gives_the_answers_of_jax(
    tmp_path, walk, operands, operations, options
):
    rows, expected = operands
    for file, text in cs_code.sources(operations, "rules").items():
        (tmp_path / file).write_text(text)
    compiled = Mono(operations, tmp_path, "rules", *options)
    hits = Hit(*(jnp.zeros((len(rows.x), 0, *size), jnp.float32) for size in ((3,), (3,), (), ())))
    play = Playback(compiled, (operations.ik, walk[0]), rows, hits)
    play()
    results: Any = play.outputs().results
    huge = np.abs(rows.x) > 2.0**63
    for name in ("cos", "sin"):  # Mono gives such numbers back, as processors do
        results.rounded[name][huge] = expected.rounded[name][huge]
    assert differing(results, expected) == {}


@needs_node
@pytest.mark.usefixtures("no_routines")
def test_every_operation_in_javascript_gives_the_answers_of_jax(
    tmp_path, walk, operands, operations
):
    rows, expected = operands
    for file, text in js_code.sources(operations, "rules").items():
        (tmp_path / file).write_text(text)
    hits = Hit(*(jnp.zeros((len(rows.x), 0, *size), jnp.float32) for size in ((3,), (3,), (), ())))
    outputs = node.played(operations, tmp_path, "rules", (operations.ik, walk[0]), rows, hits)
    assert differing(outputs.results, expected, exact=1e-6) == {}


@pytest.mark.parametrize(
    "lanes", [None, *(pytest.param(count, marks=pytest.mark.slow) for count in (4, 8))]
)
def test_every_operation_gives_the_answers_of_jax_in_lanes(
    lanes, walk, operands, operations, monkeypatch
):
    compiler("c")
    if lanes is not None:  # narrower vectors than this processor's
        monkeypatch.setattr(crowd, "LANES", dict.fromkeys(crowd.LANES, lanes))
    rows, expected = operands
    built = crowd.of_program(operations, [])
    frames = jax.tree.map(lambda leaf: leaf[:, None], rows)
    trees, axes = (operations.ik, walk[0], terrain.plane(), frames), (None, None, None, 0)
    kernel = crowd.compiled(built)
    call = crowd._Call.of(trees, axes, None, None, crowd.without_trace, False)
    outcomes = jax.tree.map(lambda leaf: leaf[:, 0], crowd._by_kernel(kernel, call, 0))
    assert differing(outcomes, expected) == {}


def test_every_rule_is_among_those_operations(operations):
    with jax.enable_x64(False):
        text = program.exported(operated, (operations.trees["frame"],)).mlir_module()
    words = {
        rule: "call" if rule == "func.call" else f"stablehlo.{rule}" for rule in stablehlo.RULES
    }
    assert [rule for rule, word in words.items() if not re.search(rf"\b{word}\b", text)] == []
    graph = operations.graph
    used = {
        (name, graph.types[operands[-1]])
        for name, operands in zip(graph.operations, graph.operands, strict=True)
        if operands
    }
    for language in (c_code, cs_code, js_code):
        assert set(language.EXPRESSIONS) - used == set(), language
    of_tables = {key for key in lanes_code.EXPRESSIONS if key[1] in TABLES.values()}
    assert set(lanes_code.EXPRESSIONS) - of_tables == set(c_code.EXPRESSIONS)


def test_constants_are_folded_to_the_answers_of_jax(operands):
    rows, expected = operands
    every = slice(None, None, 37)
    graph = Graph()
    some = jax.tree.map(lambda leaf: leaf[every], (rows, expected))
    with jax.enable_x64(False):
        lowered = program.exported(operated, (jax.tree.map(lambda leaf: leaf[0], rows),))
    outcomes = []
    for index in range(len(some[0].x)):
        row = [np.asarray(graph.constant(leaf[index])) for leaf in jax.tree.leaves(some[0])]
        outcomes.append([
            np.reshape([graph.values[node] for node in nodes.flat], nodes.shape)
            for nodes in stablehlo.read(lowered, graph, row)
        ])  # fmt: skip
    folded = [np.stack(leaf) for leaf in zip(*outcomes, strict=True)]
    ours = jax.tree.unflatten(jax.tree.structure(expected), folded)
    assert differing(ours, some[1]) == {}


def test_what_has_no_rule_is_refused_by_name():
    def refusal_of(function: Callable, x: Any) -> str:
        with jax.enable_x64(False), pytest.raises(ValueError) as refused:
            lowered = program.exported(function, (x,))
            graph = Graph()
            stablehlo.read(lowered, graph, [np.asarray(graph.input("float", 0))])
        return str(refused.value)

    number = jnp.float32(1.0)
    looped = refusal_of(lambda x: jax.lax.while_loop(lambda x: x < 9, lambda x: 2 * x, x), number)
    assert "the system has a loop, 'while'" in looped and "rays onto meshes" in looped
    unknown = refusal_of(lambda x: jnp.fft.rfft(jnp.stack([x, x])).real, number)
    assert "there is no rule for the operation 'fft'" in unknown and "'add'" in unknown
    wide = refusal_of(lambda x: x.astype(jnp.float16), number)
    assert "numbers of the type f16 are not exported" in wide
