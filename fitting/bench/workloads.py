"""What the benchmarks run on: a walk, terrains, a batch of legs, a crowd, a fit."""

import dataclasses
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

import jaxik
from fitting.clips import clip_frames, load_clip, save_clip
from fitting.clips.clip import Clip
from fitting.codegen.export import with_restart
from fitting.experiment.problems import ClipData, make_scene
from fitting.ground import meshes
from fitting.problem.problem import Problem
from fitting.problem.residuals import residuals_of_scenes
from fitting.problem.scene import Scene
from fitting.problem.shared_world import share_world
from fitting.problem.space import free_parameter, make_space
from fitting.runtime import program_cache
from fitting.runtime.precision import with_floats
from fitting.synthetic import terrain_meshes, walker
from fitting.synthetic.walker import Slide, Slip
from jaxik.maths import parameter_tree, quat
from jaxik.world import terrain
from jaxik.world.frame import Sensed
from jaxik.world.terrain import Hit

Tree = TypeVar("Tree", bound=PyTree)

FPS, SEED = 60.0, 2
EXTENT = 64.0  # m, side of the mesh field
CLIPS, GROUND = ("reference.npz", "base.npz"), "ground.ply"  # files of a recording
POSITION_NOISE, ROTATION_NOISE = 0.002, 0.0087  # m, rad
SIGMAS = {"ankle": 0.002, "knee": 0.002, "pelvis": 0.002, "foot": 0.0087, "body": 0.0087}
# Twenty smooth parameters, with the values that made the clip to be fitted.
TRUTH = {
    "target.rise_half_life": 0.04, "target.fall_half_life": 0.07,
    "lean.forward_rate": -0.55, "lean.side_rate": 0.25,
    "lean.forward_rate_slide": 0.55, "lean.side_rate_slide": 0.85,
    "lean.half_life": 0.1807, "lean.half_life_slide": 0.1422,
    "lean.slide_on_half_life": 0.2771, "lean.slide_off_half_life": 0.3184,
    "lock.lock_half_life": 0.025, "lock.unlock_half_life": 0.06,
    "pelvis.limit": 0.22, "pelvis.half_life": 0.1422,
    "leg.max_knee_angle": 2.85, "leg.soften": 0.96,
    "foot.max_pitch": 0.26, "foot.min_pitch": -0.3,
    "foot.max_roll": 0.12, "foot.min_roll": -0.2,
}  # fmt: skip
# Of the clips of one fit, in this order.
GROUNDS = (
    terrain_meshes.uneven_walk, terrain_meshes.terraces, terrain_meshes.rubble,
    terrain_meshes.steps, terrain_meshes.slope, terrain_meshes.stop_and_go,
)  # fmt: skip
# Parameters that differ within a crowd, and the ranges from which they are drawn.
DRAWN = {
    "pelvis.half_life": (0.033, 0.45),
    "pelvis.limit": (0.1, 0.35),
    "lean.forward_rate": (-0.8, 0.4),
    "target.rise_half_life": (0.005, 0.12),
    "target.fall_half_life": (0.005, 0.12),
    "lock.release_distance": (0.0, 0.3),
    "contact.planted_height": (0.09, 0.14),
}


def single(tree: Tree) -> Tree:
    """The tree with its floats in 32 bits."""
    return with_floats(tree, jnp.float32)


def walk(frame_count: int, *, uneven_pace: bool = False) -> Clip:
    """A synthetic walk; with an uneven pace its feet slip and the character slides."""
    seconds = frame_count / FPS
    if not uneven_pace:
        return walker.walk(seconds, FPS, SEED)
    events = (
        Slip(0.06 * seconds, 0.4 * seconds, 0.06),
        Slip(0.5 * seconds, 0.74 * seconds, -0.06),
        Slide(0.78 * seconds, 0.92 * seconds),
    )
    return walker.walk(seconds, FPS, SEED, events)


def mesh_field(cells: int) -> meshes.Mesh:
    """A square of hills and rubble, EXTENT a side: 2 cells² triangles of about one size."""
    random = np.random.default_rng(0)
    pitch = EXTENT / cells
    lines = np.arange(cells + 1) * pitch
    x, z = np.meshgrid(lines, lines, indexing="ij")
    y = 0.15 * np.sin(x) + random.normal(0.0, min(0.03, 0.1 * pitch), x.shape)
    x = x + random.uniform(-0.2, 0.2, x.shape) * pitch
    z = z + random.uniform(-0.2, 0.2, z.shape) * pitch
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    a, b, c, d = corner, corner + 1, corner + cells + 1, corner + cells + 2
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([b, d, c], -1)])
    return meshes.Mesh(np.stack([x, y, z], -1).reshape(-1, 3), faces.astype(np.int64))


def ground(mesh: meshes.Mesh) -> terrain.Terrain:
    """The terrain of a mesh, in 32 bits."""
    return terrain.mesh(np.asarray(mesh.vertices, np.float32), mesh.faces)


def height_field(cells: int) -> terrain.Terrain:
    """Hills and rubble as those of `mesh_field`, as heights."""
    random, pitch = np.random.default_rng(0), EXTENT / cells
    lines = np.arange(cells + 1) * pitch
    rough = random.normal(0.0, min(0.03, 0.1 * pitch), (len(lines), len(lines)))
    return terrain.heightfield((0.15 * np.sin(lines) + rough).astype(np.float32), pitch)


def ray_origins(count: int) -> Float[np.ndarray, "rays 3"]:
    """Random points above the mesh field, m."""
    origins = np.random.default_rng(1).uniform(0.0, EXTENT, (count, 3))
    origins[:, 1] = 5.0
    return origins.astype(np.float32)


def exported_walk() -> tuple[jaxik.Rig, jaxik.Frame]:
    """The legs and frames of a walk, in 32 bits, as C code takes them."""
    clip = walk(120)
    rig, frames = single((clip.rig, clip_frames.frames_from_clip(clip)))
    return rig, with_restart(frames)


def hits_at_random(frame_count: int, rays: int) -> Hit:
    """Hits (frames, rays) of uneven ground, so that decisions are as hard to foresee as there."""
    random, shape = np.random.default_rng(3), (frame_count, rays)
    points = np.zeros((*shape, 3), np.float32)
    points[..., 1] = random.normal(0.0, 0.03, shape)
    normals = random.normal((0.0, 1.0, 0.0), 0.1, (*shape, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    whole = np.ones(shape, np.float32)
    return Hit(*map(jnp.asarray, (points, normals, whole, whole)))


def tiled(motion: jaxik.Frame, count: int) -> jaxik.Frame:
    """The first `count` frames of an endless repetition."""
    return jax.tree.map(lambda leaf: leaf[jnp.arange(count) % leaf.shape[0]], motion)


def with_legs(rig: jaxik.Rig, motion: jaxik.Frame, legs: int) -> tuple[jaxik.Rig, jaxik.Frame]:
    """The same character with its two legs repeated until there are `legs`."""
    source = np.arange(legs) % len(rig.side)

    def repeated(tree: Tree, axis: int) -> Tree:
        return jax.tree.map(lambda leaf: jnp.take(jnp.asarray(leaf), source, axis=axis), tree)

    many_rig = dataclasses.replace(
        repeated(rig, 0),
        names=tuple(f"{rig.names[i]} {n}" for n, i in enumerate(source)),
        joints=tuple(rig.joints[i] for i in source),
    )
    # Only the axis of legs has length two: positions have three components, rotations four.
    many_motion = jax.tree.map(
        lambda leaf: repeated(leaf, 1) if leaf.shape[1:2] == (len(rig.side),) else leaf, motion
    )
    return many_rig, many_motion


class LegBatch(eqx.Module):
    """Legs after the sensing stages, on one axis, as the leg and foot rules read them."""

    ik: jaxik.FootIK
    rig: jaxik.Rig
    frame: jaxik.Frame
    """What belongs to a character is repeated for each of its legs."""
    sensed: Sensed
    target_ms: Float[Array, "legs 3"]
    """m, of the ankles."""

    @property
    def count(self) -> int:
        """How many legs there are."""
        return len(self.target_ms)

    @property
    def lanes(self) -> tuple:
        """Everything but the system, with the legs on the last axis, for `jaxik.lanes`."""
        parts = (self.rig, self.frame, self.sensed, self.target_ms)
        return _legs_last(parts)


@jax.jit  # one program instead of one for each shape
def _legs_last(tree: Tree) -> Tree:
    """Leaves (legs, ...) as (1, ..., legs)."""
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1)[None], tree)


@jax.jit
def _sensed(
    ik: jaxik.FootIK, rig: jaxik.Rig, ground: terrain.Terrain, motion: jaxik.Frame
) -> Sensed:
    trace = jaxik.run(ik, rig, ground, motion).trace
    assert trace is not None  # `run` always returns it
    return trace.sensed


def leg_batch(legs: int) -> LegBatch:
    """Legs on a tilted plane, two to a character, each with its own ankle target."""
    clip = walk(600)
    rig = single(clip.rig)
    motion = single(tiled(clip_frames.frames_from_clip(clip), max(legs // 2, 1)))
    ik = single(jaxik.presets.record(faithful=True))
    tilted = single(terrain.plane(normal=(0.1, 1.0, 0.05)))
    sensed = _sensed(ik, rig, tilted, motion)
    offset = np.random.default_rng(0).uniform(-0.06, 0.06, motion.pose.ankle.pos.shape)
    target = motion.pose.ankle.pos + jnp.asarray(offset, jnp.float32)
    rigs = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(target), *leaf.shape)), rig)
    return jax.block_until_ready(LegBatch(ik, *_by_leg((rigs, motion, sensed, target))))


@jax.jit
def _by_leg(tree: Tree) -> Tree:
    """Leaves (frames, 2 legs, ...) and (frames, ...) as (legs, ...)."""

    def flat(leaf: Array) -> Array:
        per_leg = leaf if leaf.shape[1:2] == (2,) else jnp.repeat(leaf[:, None], 2, axis=1)
        return per_leg.reshape(2 * len(per_leg), *per_leg.shape[2:])  # some leaves are empty

    return jax.tree.map(flat, tree)


class Member(NamedTuple):
    """What is different about one character of a crowd, or about several."""

    drawn: dict[str, Float[Array, "*characters"]]
    """Parameters by name."""
    place_ws: Float[Array, "*characters 3"]
    """m, of the first frame."""
    first: Int[Array, "*characters"]
    """Frame of the crowd's `motion` with which it starts."""


class Crowd(eqx.Module):
    """Characters with different parameters, places and starting frames, in one shared clip."""

    ik: jaxik.FootIK
    """Shared, except for the parameters that members have drawn."""
    rig: jaxik.Rig
    motion: jaxik.Frame
    """Twice as long as each character needs."""
    members: Member
    """All characters, on the first axis."""
    frame_count: int = eqx.field(static=True)
    """Of each."""

    def character(self, member: Member) -> tuple[jaxik.FootIK, jaxik.Frame]:
        """The system and the frames of one character."""
        drawn, place_ws, first = member
        frames = jax.tree.map(
            lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, first, self.frame_count), self.motion
        )
        world = frames.world_from_model
        moved = world.pos + (place_ws - world.pos[0]) * jnp.array([1.0, 0.0, 1.0], place_ws.dtype)
        return parameter_tree.replace(self.ik, drawn), eqx.tree_at(
            lambda frame: frame.world_from_model.pos, frames, moved
        )


def crowd(characters: int, frame_count: int) -> Crowd:
    """Characters that walk on the mesh field for so many frames each."""
    random = np.random.default_rng(0)
    clip = walk(2 * frame_count)
    drawn = {
        name: jnp.asarray(random.uniform(low, high, characters))
        for name, (low, high) in DRAWN.items()
    }
    place = random.uniform([4.0, 0.0, 2.0], [EXTENT - 4.0, 0.0, EXTENT - 20.0], (characters, 3))
    return Crowd(
        single(jaxik.presets.record(faithful=True)),
        single(clip.rig),
        single(clip_frames.frames_from_clip(clip)),
        Member(
            single(drawn),
            jnp.asarray(place, jnp.float32),
            jnp.asarray(random.integers(0, frame_count, characters), jnp.int32),
        ),
        frame_count,
    )


def parameter_names(count: int) -> tuple[str, ...]:
    """Names of parameters to fit: those of `TRUTH`, then others, the smooth ones first."""
    declared = parameter_tree.declarations(jaxik.presets.record(faithful=True))
    others = [name for name in declared if name not in TRUTH and name != "probe.toe_ls"]
    others.sort(key=lambda name: declared[name].kind)
    return (*TRUTH, *others, "probe.toe_ls[2]")[:count]


def recording(
    frame_count: int, make_ground: Callable[[], meshes.Mesh] = terrain_meshes.uneven_walk
) -> tuple[Clip, Clip, meshes.Mesh]:
    """A clip that known parameters made, plus noise; its flat animation; and its ground."""
    random = np.random.default_rng(SEED)
    base, mesh = walk(frame_count, uneven_pace=True), make_ground()
    truth = parameter_tree.replace(jaxik.presets.record(faithful=True), TRUTH)
    uneven = terrain.mesh(mesh.vertices, mesh.faces)
    solved = clip_frames.clip_from_result(
        base, program_cache.run(truth, base.rig, uneven, clip_frames.frames_from_clip(base))
    )
    reference = solved.with_motion(
        solved.positions_ws + random.normal(0.0, POSITION_NOISE, solved.positions_ws.shape),
        _with_noise(solved.rotations_ws, random),
    )
    return reference, base, mesh


def save_recording(folder: str, frame_count: int) -> None:
    """Writes a recording's `CLIPS` and `GROUND`."""
    *clips, mesh = recording(frame_count)
    for name, clip in zip(CLIPS, clips, strict=True):
        save_clip(Path(folder, name), clip)
    meshes.save_mesh(Path(folder, GROUND), mesh.vertices, mesh.faces)


def load_recording(folder: str) -> ClipData:
    """What `save_recording` has written."""
    reference, base = (load_clip(Path(folder, name)) for name in CLIPS)
    return ClipData(reference, base, meshes.load_terrain(Path(folder, GROUND)))


def problem_from_clips(clips: Iterable[ClipData], names: tuple[str, ...] = tuple(TRUTH)) -> Problem:
    """The fit of these parameters to recordings."""
    ik = jaxik.presets.record(faithful=True)
    space = make_space(ik, [free_parameter(ik, name) for name in names])
    scenes = share_world([make_scene(clip, SIGMAS) for clip in clips])
    return Problem(space, tuple(scenes), residuals_of_scenes)


def problem(frame_count: int, names: tuple[str, ...] = tuple(TRUTH), clips: int = 1) -> Problem:
    """The fit of these parameters to recordings of about so many frames, each on its own ground."""
    data = []
    for number, make_ground in enumerate(GROUNDS[:clips]):
        reference, base, mesh = recording(frame_count + 10 * number, make_ground)
        data.append(ClipData(reference, base, terrain.mesh(mesh.vertices, mesh.faces)))
    return problem_from_clips(data, names)


def first_frames(scene: Scene, count: int) -> Scene:
    """The beginning of a clip."""
    parts = (scene.frames, scene.pelvis, scene.reference, scene.tracks)
    motion, pelvis, reference, tracks = jax.tree.map(lambda leaf: leaf[:count], parts)
    return dataclasses.replace(
        scene, frames=motion, pelvis=pelvis, reference=reference, tracks=tracks
    )


def _with_noise(wxyz: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Rotations with noise, which is that of their quaternions as long as angles are small."""
    noise = random.normal(0.0, ROTATION_NOISE / 2, (*wxyz.shape[:-1], 3))
    small = np.concatenate([np.ones((*noise.shape[:-1], 1)), noise], axis=-1)
    noisy = np.asarray(quat.multiply(jnp.asarray(small), jnp.asarray(wxyz)))
    return noisy / np.linalg.norm(noisy, axis=-1, keepdims=True)


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Sizes of workloads and numbers of runs; the defaults are those of a full run."""

    repeats: int = 7
    """Samples of each call."""
    legs: int = 200_000
    feet: int = 100_000
    characters: int = 4096
    frames: int = 600
    """Of a clip; 10 s."""
    derived: int = 512
    """Characters whose gradient is taken."""
    chunk: int = 64
    """Characters computed at once."""
    crowd_repeats: int = 3
    """Samples of a crowd and of rays."""
    cells: int = 500
    """Along a side of the mesh; 2 cells² triangles."""
    rays: int = 1_000_000
    read: int = 1 << 26
    """Floats read to measure memory bandwidth."""
    side: int = 2048
    """Of the matrices multiplied to measure arithmetic."""
    fits: int = 3
    """Samples of warm fits, and of cold fits of each kind."""
    cold: bool = True
    """Whether to run cold fits, and SciPy with finite differences."""
    floats: tuple[str, ...] = ("float64", "float32")
    """Of the residuals."""
    walkers: int = 64
    steps: int = 1000
    """Of the sampler."""
    chains: int = 1
    """Samples of the sampler."""
    exported: tuple[str, ...] = ("mec", "ozz", "record", "stride", "unreal")
    """Presets as C code."""
    # Sizes of the scaling curves.
    batches: tuple[int, ...] = (2, 10, 100, 1000, 10_000, 100_000, 1_000_000)
    """Legs."""
    lengths: tuple[int, ...] = (100, 1000, 10_000, 100_000)
    """Frames."""
    grids: tuple[int, ...] = (7, 22, 71, 224, 707, 2236)
    """Cells a side: 10² to 10⁷ triangles."""
    parameters: tuple[int, ...] = (5, 10, 20, 40)
    legs_each: tuple[int, ...] = (2, 4, 6, 8)
    devices: tuple[int, ...] = (1, 2, 4, 8)
    clips: tuple[int, ...] = (10, 100, 1000)
    workers: tuple[int, ...] = (1, 2, 4)


FULL = Sizes()
QUICK = Sizes(
    repeats=3, characters=64, derived=64, cells=200, rays=200_000, read=1 << 24, crowd_repeats=2,
    fits=1, cold=False, floats=("float64",), steps=20, exported=("mec", "record"),
    batches=(100, 1000, 10_000), lengths=(100, 1000), grids=(22, 71), parameters=(5, 20),
    legs_each=(2, 4), devices=(1, 2), clips=(10, 100), workers=(1, 2),
)  # fmt: skip
