"""What calls generated code in Unreal Engine, Unity and Godot: compiled against as much of them as
it needs, it moves a character as `jaxik.step` does, in the engine's own axes."""

# pyright: reportArgumentType=false

import functools
import subprocess
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxik
from fitting.bench import workloads
from fitting.codegen import export, toolchain
from jaxik.maths import parameter_tree
from jaxik.world import terrain
from support import mono
from support.clips import make_rig, to_frames, wandering

FRAMES = 40
TILTED = Rotation.from_euler("xyz", [0.1, 0.2, -0.1]).as_quat(scalar_first=True)
ENGINES = Path(__file__).parent / "engines"
SLOPE = 0.1  # up to the right in Unreal and Unity, up along x in Godot
# Columns: the engine's axes in ours. Unreal's mesh faces y: its component is turned by 90°.
MATRICES = {
    "unreal": np.transpose([(0, 0, 1), (-1, 0, 0), (0, 1, 0)]),
    "unity": np.diag([-1.0, 1.0, 1.0]),
    "godot": np.eye(3),
}
UNITS = {"unreal": 0.01, "unity": 1.0, "godot": 1.0}
FACING = {"unreal": 90.0, "unity": 0.0, "godot": 0.0}
NORMALS = {"unreal": (SLOPE, 1.0, 0.0), "unity": (SLOPE, 1.0, 0.0), "godot": (-SLOPE, 1.0, 0.0)}


def to_engine(engine: str, transforms: jaxik.Transform) -> jaxik.Transform:
    """Places in the axes of an engine, with quaternions x y z w."""
    matrix = MATRICES[engine]
    quats = np.asarray(transforms.rot)
    turns = Rotation.from_quat(quats.reshape(-1, 4), scalar_first=True).as_matrix()
    rot = Rotation.from_matrix(matrix.T @ turns @ matrix).as_quat().reshape(quats.shape)
    return jaxik.Transform(np.asarray(transforms.pos) @ matrix / UNITS[engine], rot)


def from_engine(engine: str, numbers: np.ndarray) -> jaxik.Transform:
    matrix = MATRICES[engine]
    turns = Rotation.from_quat(numbers[..., 3:].reshape(-1, 4)).as_matrix()
    rot = Rotation.from_matrix(matrix @ turns @ matrix.T).as_quat(scalar_first=True)
    rot = rot.reshape(*numbers.shape[:-1], 4)
    return jaxik.Transform(numbers[..., :3] @ matrix.T * UNITS[engine], rot)


def numbers_of(transforms: jaxik.Transform) -> np.ndarray:
    return np.concatenate([transforms.pos, transforms.rot], axis=-1)


def turned(numbers: np.ndarray, by: Rotation) -> np.ndarray:
    """The bones of a component in which a mesh faces elsewhere."""
    rot = (by * Rotation.from_quat(numbers[..., 3:].reshape(-1, 4))).as_quat()
    pos = by.apply(numbers[..., :3].reshape(-1, 3))
    return np.concatenate([pos, rot], axis=-1).reshape(numbers.shape)


def joints(pose: jaxik.LegPose) -> jaxik.Transform:
    """Hip, knee, ankle and toe of the first leg, then of the other one."""
    parts = (pose.hip, pose.knee, pose.ankle, pose.toe)
    return jax.tree.map(lambda *leaves: np.stack(leaves, 2).reshape(FRAMES, 8, -1), *parts)


@functools.cache
def solved(normal: tuple[float, float, float]) -> tuple:
    """A system, its rig, frames, and what JAX makes of them on a slope."""
    frames = to_frames(wandering(make_rig(), np.random.default_rng(2), FRAMES))
    frames = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), frames)
    builder, parts = jaxik.FrameBuilder(), []
    for number in range(FRAMES):
        frame = jax.tree.map(lambda leaf, i=number: leaf[i], frames)
        parts.append(builder.build(frame.world_from_model, frame.pose, np.float32(1 / 30)))
    frames = jax.tree.map(lambda *leaves: np.stack(leaves), *parts)
    rig = jaxik.Rig.from_pose(parts[0].pose)
    ik = parameter_tree.replace(jaxik.presets.unreal(rig), {"contact.idle_speed": 9.0})
    ik = workloads.single(ik)
    with jax.enable_x64(False):
        quickly = {"xla_backend_optimization_level": 0}
        run = jax.jit(jaxik.run, compiler_options=quickly)
        return ik, rig, frames, jax.device_get(run(ik, rig, terrain.plane(normal=normal), frames))


def built(engine: str, folder: Path, ik: jaxik.FootIK, rig: jaxik.Rig) -> list[str]:
    """The command that runs a node over frames."""
    language, place = "cs" if engine == "unity" else "c", ENGINES / engine
    export.export_system(ik, rig, folder, language=language, axes=engine)
    if engine == "unity":
        files = ["Footik.cs", "FootikBehaviour.cs", *map(str, sorted(place.glob("*.cs")))]
        mono.compile_code(folder, "run.exe", "-define:UNITY_5_3_OR_NEWER", "-nowarn:649", *files)
        return [str(mono.MONO), "run.exe"]
    command = [str(toolchain.compiler("c++")), "-std=c++17", "-Wall", "-Werror", "-O0"]
    command += ["-I", place, "-I", ".", place / "run.cpp", "footik.c", "-o", "run", "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    return ["./run"]


@pytest.mark.parametrize(
    "engine",
    [
        "unreal",
        pytest.param("unity", marks=[mono.needs_mono, pytest.mark.slow]),
        pytest.param("godot", marks=pytest.mark.slow),
    ],
)
def test_a_node_moves_a_character_as_python_does(tmp_path, engine):
    if engine != "unity" and toolchain.compiler("c++") is None:
        pytest.skip("needs a compiler of C++: none in $CXX, no c++")
    ik, rig, frames, result = solved(NORMALS[engine])
    command = built(engine, tmp_path, ik, rig)
    facing = Rotation.from_euler("z", FACING[engine], degrees=True)
    places = np.tile([0.02, 0.9, 0.1], (FRAMES, 1, 1))
    pelvis = jaxik.Transform(places, np.tile(TILTED, (FRAMES, 1, 1)))
    bones = [numbers_of(to_engine(engine, each)) for each in (pelvis, joints(frames.pose))]
    bones = turned(np.concatenate(bones, axis=1), facing)
    roots = numbers_of(to_engine(engine, frames.world_from_model))
    roots[:, 3:] = (Rotation.from_quat(roots[:, 3:]) * facing.inv()).as_quat()
    feed = bones[0].tobytes() + np.concatenate([roots[:, None], bones], axis=1).tobytes()
    done = subprocess.run(command, cwd=tmp_path, input=feed, capture_output=True, check=True)
    moved = turned(np.frombuffer(bytearray(done.stdout)).reshape(FRAMES, 9, 7), facing.inv())

    ours = from_engine(engine, moved)
    theirs = joints(result.pose)
    assert np.abs(theirs.pos - joints(frames.pose).pos).max() > 0.05
    np.testing.assert_allclose(ours.pos[:, 1:], theirs.pos, atol=1e-5)
    body = jax.tree.map(lambda leaf: leaf[:, None], result.body)
    expected = [body.apply(pelvis.pos), body.apply_rot(pelvis.rot)]
    np.testing.assert_allclose(ours.pos[:, :1], expected[0], atol=1e-5)
    for rot, other in ((ours.rot[:, 1:], theirs.rot), (ours.rot[:, :1], expected[1])):
        np.testing.assert_allclose(np.abs(np.sum(rot * np.asarray(other), -1)), 1.0, atol=1e-5)
