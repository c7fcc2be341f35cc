"""What `jaxik bench` measures on: a walk, legs, grounds, a crowd, a fit."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxik
from fitting.datasets import clip_frames
from fitting.datasets.clips.clip import Clip
from fitting.datasets.synthetic import terrain_meshes, walker
from fitting.datasets.synthetic.speed_profile import Slide, Slip
from fitting.experiments.problems import ClipData, make_scene
from fitting.problem.free_parameters import free_parameter
from fitting.problem.problem import Problem
from fitting.problem.residuals import residuals_of_scenes
from fitting.problem.space import make_space
from jaxik.maths import parameter_tree, quat
from jaxik.world import terrain
from jaxik.world.frame import Sensed

FPS, SEED = 60.0, 2
EXTENT = 64.0  # m, side of the field
POSITION_NOISE, ROTATION_NOISE = 0.002, 0.0087  # m, rad; as of the embedded walk
SIGMAS = {"ankle": 0.002, "knee": 0.002, "pelvis": 0.002, "foot": 0.0087, "body": 0.0087}
# Twenty parameters that have slopes, with the values that made the clip to be fitted.
TRUTH = {
    "target.rise_half_life": 0.04, "target.fall_half_life": 0.07,
    "lean.forward_rate": -0.55, "lean.side_rate": 0.25,
    "lean.forward_rate_slide": 0.55, "lean.side_rate_slide": 0.85,
    "lean.gain": 0.12, "lean.gain_slide": 0.15,
    "lean.slide_on_gain": 0.08, "lean.slide_off_gain": 0.07,
    "lock.lock_half_life": 0.025, "lock.unlock_half_life": 0.06,
    "pelvis.limit": 0.22, "pelvis.on_gain": 0.15,
    "leg.max_knee_angle": 2.85, "leg.soften": 0.96,
    "foot.max_pitch": 0.26, "foot.min_pitch": -0.3,
    "foot.max_roll": 0.12, "foot.min_roll": -0.2,
}  # fmt: skip
# What the members of a crowd differ in, and between which values.
DRAWN = {
    "pelvis.on_gain": (0.05, 0.5),
    "pelvis.limit": (0.1, 0.35),
    "lean.forward_rate": (-0.8, 0.4),
    "target.rise_half_life": (0.005, 0.12),
    "target.fall_half_life": (0.005, 0.12),
    "lock.release_distance": (0.0, 0.3),
    "contact.planted_height": (0.09, 0.14),
}


@dataclasses.dataclass(frozen=True)
class Sizes:
    """How large things are and how often they run."""

    repeats: int = 7
    legs: int = 200_000
    feet: int = 100_000
    characters: int = 4096
    frames: int = 600  # of a clip; 10 s
    derived: int = 512  # of them, whose gradient is taken
    chunk: int = 64  # characters at once
    crowd_repeats: int = 3
    cells: int = 500  # along a side of the field; 2 cells² triangles
    rays: int = 1_000_000
    read: int = 1 << 26  # floats, against memory
    side: int = 2048  # of matrices, against arithmetic
    fits: int = 3  # warm, and cold ones of each kind
    cold: bool = True  # whether there are cold ones, and SciPy by differences
    floats: tuple[str, ...] = ("float64", "float32")  # of the residuals
    walkers: int = 64
    steps: int = 1000
    chains: int = 1  # so many times
    batches: tuple[int, ...] = (2, 10, 100, 1000, 10_000, 100_000, 1_000_000)  # legs
    lengths: tuple[int, ...] = (100, 1000, 10_000, 100_000)  # frames
    grids: tuple[int, ...] = (7, 22, 71, 224, 707, 2236)  # cells a side: 10² to 10⁷ triangles
    parameters: tuple[int, ...] = (5, 10, 20, 40)
    legs_each: tuple[int, ...] = (2, 4, 6, 8)


def single(tree: Any) -> Any:
    """The tree with its floats in 32 bits."""
    return jax.tree.map(
        lambda leaf: (
            jnp.asarray(leaf, jnp.float32)
            if eqx.is_array_like(leaf) and jnp.issubdtype(jnp.asarray(leaf).dtype, jnp.floating)
            else leaf
        ),
        tree,
    )


def walk(count: int, *, uneven_pace: bool = False) -> Clip:
    """A walk of so many frames; with an uneven pace feet slip, and the character slides."""
    seconds = count / FPS
    if not uneven_pace:
        return walker.walk(seconds, FPS, SEED)
    slips = (Slip(0.06 * seconds, 0.4 * seconds, 0.06), Slip(0.5 * seconds, 0.74 * seconds, -0.06))
    slides = (Slide(0.78 * seconds, 0.92 * seconds),)
    return walker.walk(seconds, FPS, SEED, slips=slips, slides=slides)


def field(cells: int, seed: int = 0) -> terrain_meshes.Mesh:
    """Hills and rubble over EXTENT by EXTENT, 2 cells² triangles of about one size."""
    random = np.random.default_rng(seed)
    pitch = EXTENT / cells
    lines = np.arange(cells + 1) * pitch
    x, z = np.meshgrid(lines, lines, indexing="ij")
    y = 0.15 * np.sin(x) + random.normal(0.0, min(0.03, 0.1 * pitch), x.shape)
    x = x + random.uniform(-0.2, 0.2, x.shape) * pitch
    z = z + random.uniform(-0.2, 0.2, z.shape) * pitch
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    a, b, c, d = corner, corner + 1, corner + cells + 1, corner + cells + 2
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([b, d, c], -1)])
    return terrain_meshes.Mesh(np.stack([x, y, z], -1).reshape(-1, 3), faces.astype(np.int64))


def ground(mesh: terrain_meshes.Mesh) -> terrain.Terrain:
    """The terrain of a mesh, in 32 bits."""
    return terrain.mesh(np.asarray(mesh.vertices, np.float32), mesh.faces)


def ray_origins(count: int, seed: int = 1) -> Float[np.ndarray, "rays 3"]:
    """Places over the field, m."""
    origins = np.random.default_rng(seed).uniform(0.0, EXTENT, (count, 3))
    origins[:, 1] = 5.0
    return origins.astype(np.float32)


def tiled(motion: jaxik.Frame, count: int) -> jaxik.Frame:
    """The frames again and again, `count` of them."""
    return jax.tree.map(lambda leaf: leaf[jnp.arange(count) % leaf.shape[0]], motion)


def with_legs(rig: jaxik.Rig, motion: jaxik.Frame, legs: int) -> tuple[jaxik.Rig, jaxik.Frame]:
    """The same character with its two legs several times over."""
    which = np.arange(legs) % len(rig.side)

    def taken(tree: Any, axis: int) -> Any:
        return jax.tree.map(lambda leaf: jnp.take(jnp.asarray(leaf), which, axis=axis), tree)

    wide = dataclasses.replace(
        taken(rig, 0),
        names=tuple(f"{rig.names[i]} {n}" for n, i in enumerate(which)),
        joints=tuple(rig.joints[i] for i in which),
    )
    # No other axis of a frame is two long: places have three numbers, turns four.
    moving = jax.tree.map(
        lambda leaf: taken(leaf, 1) if leaf.shape[1:2] == (len(rig.side),) else leaf, motion
    )
    return wide, moving


class Batch(eqx.Module):
    """Legs that have been sensed, all on one axis, as their rules get them."""

    ik: jaxik.FootIK
    rig: jaxik.Rig
    frame: jaxik.Frame  # what a character has, each of its legs has
    sensed: Sensed
    target_ms: Float[Array, "legs 3"]  # m, of the ankles

    @property
    def legs(self) -> int:
        """How many legs there are in all."""
        return len(self.target_ms)

    def in_lanes(self) -> tuple[jaxik.FootIK, tuple]:
        """The system, and batches of one leg side by side on the last axis."""
        parts = (self.rig, self.frame, self.sensed, self.target_ms)
        return self.ik, jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1)[None], parts)


@jax.jit
def _sensed(
    ik: jaxik.FootIK, rig: jaxik.Rig, ground: terrain.Terrain, motion: jaxik.Frame
) -> Sensed:
    return jaxik.run(ik, rig, ground, motion).trace.sensed


def batch(legs: int) -> Batch:
    """So many legs, two a character, on a tilted plane, each with an ankle's target of its own."""
    clip = walk(600)
    rig = single(clip.rig)
    motion = single(tiled(clip_frames.frames_from_clip(clip), max(legs // 2, 1)))
    ik = single(jaxik.presets.record())
    tilted = single(terrain.plane(normal=(0.1, 1.0, 0.05)))
    sensed = _sensed(ik, rig, tilted, motion)
    drawn = np.random.default_rng(0).uniform(-0.06, 0.06, motion.pose.ankle.pos.shape)
    target = motion.pose.ankle.pos + jnp.asarray(drawn, jnp.float32)
    rigs = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(target), *leaf.shape)), rig)
    return jax.block_until_ready(Batch(ik, *_side_by_side((rigs, motion, sensed, target))))


def _side_by_side(tree: Any) -> Any:
    """Leaves (frames, 2 legs, ...) and (frames, ...) as (legs, ...)."""

    def flat(leaf: Array) -> Array:
        paired = leaf if leaf.shape[1:2] == (2,) else jnp.repeat(leaf[:, None], 2, axis=1)
        return paired.reshape(-1, *paired.shape[2:])

    return jax.tree.map(flat, tree)


class Crowd(eqx.Module):
    """Characters that differ in parameters, place and moment, over one clip twice their length."""

    ik: jaxik.FootIK  # what they share
    rig: jaxik.Rig
    motion: jaxik.Frame
    drawn: dict[str, Float[Array, " characters"]]
    place_ws: Float[Array, "characters 3"]  # m, of the first frame
    first: Array  # frame of `motion` with which each begins
    span: int = eqx.field(static=True)  # frames of each

    def member(self, given: tuple) -> tuple[jaxik.FootIK, jaxik.Frame]:
        """The system and the frames of one of them, from its row of what differs."""
        drawn, place_ws, first = given
        cut = jax.tree.map(
            lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, first, self.span), self.motion
        )
        world = cut.world_from_model
        moved = world.pos + (place_ws - world.pos[0]) * jnp.array([1.0, 0.0, 1.0], place_ws.dtype)
        return parameter_tree.replace(self.ik, drawn), eqx.tree_at(
            lambda frame: frame.world_from_model.pos, cut, moved
        )

    @property
    def rows(self) -> tuple:
        """What differs, a row a member."""
        return self.drawn, self.place_ws, self.first


def crowd(characters: int, span: int, seed: int = 0) -> Crowd:
    """So many characters, each with `span` frames of a walk on the field."""
    random = np.random.default_rng(seed)
    clip = walk(2 * span)
    drawn = {name: random.uniform(low, high, characters) for name, (low, high) in DRAWN.items()}
    place = random.uniform([4.0, 0.0, 2.0], [EXTENT - 4.0, 0.0, EXTENT - 20.0], (characters, 3))
    return Crowd(
        single(jaxik.presets.record()),
        single(clip.rig),
        single(clip_frames.frames_from_clip(clip)),
        single(drawn),
        jnp.asarray(place, jnp.float32),
        jnp.asarray(random.integers(0, span, characters), jnp.int32),
        span,
    )


def others() -> tuple[str, ...]:
    """Names of the record's further parameters, what has a slope first."""
    declared = parameter_tree.declarations(jaxik.presets.record())
    left = [name for name in declared if name not in TRUTH and name != "probe.toe_ls"]
    left.sort(key=lambda name: declared[name].kind)
    return (*left, "probe.toe_ls[2]")


def recording(count: int) -> tuple[Clip, Clip, terrain_meshes.Mesh]:
    """A clip of `count` frames that known parameters made, plus noise; its base, its ground."""
    random = np.random.default_rng(SEED)
    base, made = walk(count, uneven_pace=True), terrain_meshes.uneven()
    truth = parameter_tree.replace(jaxik.presets.record(), TRUTH)
    uneven = terrain.mesh(made.vertices, made.faces)
    solved = clip_frames.clip_from_result(
        base, jaxik.run(truth, base.rig, uneven, clip_frames.frames_from_clip(base))
    )
    reference = solved.with_motion(
        solved.positions_ws + random.normal(0.0, POSITION_NOISE, solved.positions_ws.shape),
        _shaken(solved.rotations_ws, random),
    )
    return reference, base, made


def problem_of(
    reference: Clip, base: Clip, uneven: terrain.Terrain, names: tuple[str, ...] = tuple(TRUTH)
) -> Problem:
    """The fit of these parameters to a recording."""
    scene = make_scene(ClipData(reference, base, uneven), SIGMAS)
    ik = jaxik.presets.record()
    return Problem(
        make_space(ik, [free_parameter(ik, name) for name in names]), (scene,), residuals_of_scenes
    )


def problem(count: int, names: tuple[str, ...] = tuple(TRUTH)) -> Problem:
    """The fit of these parameters to a recording of `count` frames."""
    reference, base, made = recording(count)
    return problem_of(reference, base, terrain.mesh(made.vertices, made.faces), names)


def _shaken(wxyz: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Rotations with noise; for small angles a quaternion's own."""
    noise = random.normal(0.0, ROTATION_NOISE / 2, (*wxyz.shape[:-1], 3))
    turns = np.concatenate([np.ones((*noise.shape[:-1], 1)), noise], axis=-1)
    turned = np.asarray(quat.multiply(jnp.asarray(turns), jnp.asarray(wxyz)))
    return turned / np.linalg.norm(turned, axis=-1, keepdims=True)
