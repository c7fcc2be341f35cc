"""What generated code has for an engine beside the system: legs, speeds and axes."""

# pyright: reportArgumentType=false

import ctypes
import subprocess

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxik
from fitting.bench import workloads
from fitting.codegen import c_code, cs_code, meanings, memory, program, toolchain
from fitting.codegen.axes import ENGINES, conversions
from jaxik.maths import parameter_tree
from support import mono

# Of each engine: what its axes are in ours (x left, y up, z forward), and its unit in m.
AXES = {
    "unreal": ([(0, 0, 1), (-1, 0, 0), (0, 1, 0)], 0.01),  # forward, right, up
    "unity": ([(-1, 0, 0), (0, 1, 0), (0, 0, 1)], 1.0),  # right, up, forward
    "godot": ([(1, 0, 0), (0, 1, 0), (0, 0, 1)], 1.0),  # MODEL_LEFT, up, MODEL_FRONT
}


SLIDERS = """\
using Jaxik;
static class Sliders {
    static void Main() {
        Walker.Parameters parameters = Walker.Defaults;
        for (int i = 0; i < Walker.SliderCount; i++) {
            Walker.Slider s = Walker.GetSlider(in parameters, i);
            Walker.SetSlider(ref parameters, i, s.High);
            float after = Walker.GetSlider(in parameters, i).Value;
            string numbers = $"{s.Value:r}|{s.Low:r}|{s.High:r}|{after:r}";
            System.Console.WriteLine($"{s.Name}|{s.Unit}|{s.Meaning}|{numbers}");
        }
    }
}
"""


def compiled(folder, system: program.Program, engine: str | None) -> ctypes.CDLL:
    """The code of a system, of which the functions of the header can be called."""
    compiler = toolchain.compiler("c")
    if compiler is None:
        pytest.skip("needs a compiler of C: none in $CC, no cc")
    for file, text in c_code.sources(system, "walker", engine).items():
        (folder / file).write_text(text.replace("static inline ", ""))
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", "-O0"]
    subprocess.run([compiler, *flags, "walker.c", "-o", "lib.so", "-lm"], cwd=folder, check=True)
    return ctypes.CDLL(str(folder / "lib.so"))


@pytest.fixture(scope="module")
def system() -> program.Program:
    """A small system whose frames have one platform."""
    ik = workloads.single(jaxik.presets.unreal())
    ground = jaxik.world.terrain.moving(jaxik.world.terrain.plane(), 0)
    return program.build(ik, program.blank_rig(2), ground)


@pytest.fixture(scope="module")
def library(tmp_path_factory, system) -> ctypes.CDLL:
    return compiled(tmp_path_factory.mktemp("walker"), system, None)


def words_of(tree) -> np.ndarray:
    return np.frombuffer(memory.words(tree), np.uint32).copy()


def call(function, *arguments) -> None:
    function(*(x.ctypes if isinstance(x, np.ndarray) else ctypes.c_int(x) for x in arguments))


def random_transform(random, *shape: int) -> jaxik.Transform:
    rot = Rotation.random(*shape, rng=random).as_quat(scalar_first=True)
    return jaxik.Transform(np.float32(random.normal(size=(*shape, 3))), np.float32(rot))


def still(*shape: int) -> jaxik.Transform:
    rot = np.broadcast_to(np.float32([1.0, 0.0, 0.0, 0.0]), (*shape, 4))
    return jaxik.Transform(np.zeros((*shape, 3), np.float32), rot)


def test_legs_and_speeds_are_those_of_python(library):
    random = np.random.default_rng(3)
    pose = jaxik.LegPose(*(random_transform(random, 2) for _ in range(4)))
    builder, frames = jaxik.FrameBuilder(), []
    moments = (-1, 0.02), (-1, 0.03), (0, 0.02), (0, 0.0)
    for platform, dt in moments:
        root, platforms = random_transform(random), random_transform(random, 1)
        pose = jax.tree.map(lambda leaf: leaf + np.float32(0.01), pose)
        frames.append(builder.build(root, pose, dt, platforms, platform))
    rig = words_of(program.blank_rig(2))
    call(library.walker_measure_rig, words_of(frames[0]), rig)
    measured = memory.tree_of(rig[None], program.blank_rig(2))
    expected = jaxik.Rig.from_pose(pose=frames[0].pose)
    for ours, theirs in zip(jax.tree.leaves(measured), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(ours[0], theirs, atol=2e-6)
    before = frames[0]
    for (platform, _), frame in zip(moments, frames, strict=True):
        names = "velocity_ws", "foot_speed", "toe_speed"
        empty = {name: np.full_like(getattr(frame, name), np.nan) for name in names}
        words = words_of(jaxik.Frame(**(vars(frame) | empty)))
        call(library.walker_measure_speeds, words_of(before), platform, words)
        filled = memory.tree_of(words[None], frame)
        for ours, theirs in zip(jax.tree.leaves(filled), jax.tree.leaves(frame), strict=True):
            np.testing.assert_allclose(ours[0], theirs, rtol=2e-5, atol=2e-4)
        before = frame


class Slider(ctypes.Structure):
    _fields_ = [
        ("number", ctypes.c_int),
        *((name, ctypes.c_char_p) for name in ("name", "unit", "meaning")),
        *((name, ctypes.c_float) for name in ("value", "low", "high")),
    ]


def test_sliders_say_what_each_parameter_is(library, system):
    declared = parameter_tree.declarations(system.ik)
    count = len(declared) + sum(
        slot.value.dtype == bool for slot in parameter_tree.slots(system.ik)
    )
    sliders = (Slider * count).in_dll(library, "walker_sliders")
    places = system.places["parameters"]
    defaults = (ctypes.c_float * len(places)).in_dll(library, "walker_defaults")
    for slider in sliders:
        name = slider.name.decode()
        assert name == ".".join(places[slider.number].field.path)
        if (declaration := declared.get(name)) is None:
            assert (slider.low, slider.high, slider.value in (0, 1)) == (0, 1, True)
        else:
            assert (slider.low, slider.high) == pytest.approx((declaration.low, declaration.high))
            assert slider.value == defaults[slider.number]
            assert slider.unit.decode() == declaration.unit
        assert slider.meaning.decode() == parameter_tree.docs(system.ik)[name]


@mono.needs_mono
def test_sliders_in_csharp_turn_parameters(tmp_path, system):
    for file, text in cs_code.sources(system, "walker").items():
        (tmp_path / file).write_text(text)
    (tmp_path / "Sliders.cs").write_text(SLIDERS)
    mono.compile_code(tmp_path, "Sliders.exe", "Walker.cs", "Sliders.cs")
    done = mono.run(tmp_path, "Sliders.exe")
    rows = [line.split("|") for line in done.stdout.splitlines()]
    for row, entry in zip(rows, meanings.table(system), strict=True):
        texts = [text.lower().replace("_", "") for text in (entry.name, entry.unit, entry.meaning)]
        *words, value, low, high, after = row
        assert [word.lower() for word in words] == texts
        numbers = [float(number) for number in (value, low, high, after)]
        expected = [entry.value, entry.low, entry.high, entry.high]
        np.testing.assert_allclose(numbers, expected, rtol=1e-6)


def test_a_blank_frame_has_whole_weights_on_the_ground(library, system):
    words = np.ctypeslib.as_array(
        (ctypes.c_uint32 * len(system.places["frame"])).in_dll(library, "walker_blank_frame")
    )
    blank = memory.tree_of(words[None].copy(), system.trees["frame"])
    expected = jaxik.FrameBuilder().build(
        still(),
        jaxik.LegPose(*(still(2) for _ in range(4))),
        0.0,
        still(1),
    )
    for ours, theirs in zip(jax.tree.leaves(blank), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(ours[0], theirs)


@pytest.mark.parametrize("engine", ENGINES)
def test_axes_of_engines_are_converted_and_back(tmp_path, system, engine):
    library = compiled(tmp_path, system, engine)
    columns, unit = AXES[engine]
    matrix, random = np.transpose(columns), np.random.default_rng(5)

    def converted(name: str, numbers) -> np.ndarray:
        ours = np.zeros(len(numbers), np.float32)
        call(getattr(library, f"walker_{name}_{engine}"), np.float32(numbers), ours)
        return ours

    assert len(conversions(engine)) == 6
    for _ in range(20):
        point = random.normal(size=3)
        turn = Rotation.random(rng=random)
        np.testing.assert_allclose(converted("point_from", point / unit), matrix @ point, atol=1e-6)
        np.testing.assert_allclose(converted("direction_from", point), matrix @ point, atol=1e-6)
        rotation = converted("rotation_from", turn.as_quat())
        ours = Rotation.from_quat(rotation, scalar_first=True)
        turned = matrix @ turn.apply(point)
        np.testing.assert_allclose(ours.apply(matrix @ point), turned, atol=1e-5)
        np.testing.assert_allclose(converted("rotation_to", rotation), turn.as_quat(), atol=1e-6)
        back = converted("point_to", converted("point_from", point))
        np.testing.assert_allclose(back, point, atol=1e-6)
        back = converted("direction_to", converted("direction_from", point))
        np.testing.assert_allclose(back, point, atol=1e-6)
