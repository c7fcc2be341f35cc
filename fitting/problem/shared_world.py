"""Clips that share one world: run one after another or side by side, they need one program.

Compiling takes most of the time of a fit, and with a program for each clip would grow with their
number. So the terrains of all clips are put side by side into one mesh, far enough apart that no
ray of a clip meets the ground of another, and all frames go through one loop, in which memory
starts anew at the first frame of each clip. Foot IK is the same wherever a world has its origin.
Terrains that are not static meshes can be shared only by clips that have the same one.

Side by side, clips of different length are one array. A clip is made longer by repeating its last
frame, which then counts as not observed: no frame depends on later ones, and frames that were not
observed have no residuals. Lengths are rounded up to a few, so that a thousand clips of a
thousand lengths need a few programs.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

import jaxik
from jaxik.maths import parameter_tree
from jaxik.pipeline import Result
from jaxik.world import grid, places
from jaxik.world.surfaces import Mesh
from jaxik.world.terrain import Terrain, merge

from .scene import WHITENED, Place, Scene, own_system

Tree = TypeVar("Tree")

# m, to either side of where a clip goes, that stay its own: further than any ray is cast from its
# root, also for the next foothold of a sprinter.
MARGIN = 10.0

StackedTree = TypeVar("StackedTree", bound=PyTree)

GROWTH = 1.25  # of the lengths that clips are rounded up to: at most a fifth is padding
SHORTEST = 32  # frames


def share_world(scenes: Sequence[Scene]) -> list[Scene]:
    """The scenes with places in worlds that as many as possible share; on the host.

    Args:
        scenes: of one system.
        probe: its rule for rays, which may need a terrain prepared.
    """
    placed = list(scenes)
    for numbers in _worlds(scenes):
        if len(numbers) == 1:
            continue
        members = [scenes[number] for number in numbers]
        distinct = _distinct([scene.terrain for scene in members])
        offsets = np.zeros((len(members), 3))
        terrain = members[0].terrain
        if len(set(distinct)) > 1:
            offsets = _side_by_side(members, distinct)
            firsts = [distinct.index(terrain) for terrain in sorted(set(distinct))]
            grounds = [members[first].terrain for first in firsts]
            terrain = merge(grounds, offsets[firsts])
        for number, scene, offset in zip(numbers, members, offsets, strict=True):
            offset_ws = jnp.asarray(offset, scene.frames.dt.dtype)
            place = Place(terrain, offset_ws, numbers[0])
            placed[number] = dataclasses.replace(scene, place=place)
    return placed


class Row(NamedTuple):
    """The inputs of a system: one clip, or several that share a world, one after another."""

    ik: jaxik.FootIK
    rig: jaxik.Rig
    terrain: Terrain
    frames: jaxik.Frame
    tracks: dict[str, Array]


def row_of(ik: jaxik.FootIK, scenes: Sequence[Scene]) -> Row:
    """One scene as it is, or several that share a world, in a row."""
    first = scenes[0]
    if len(scenes) == 1:
        return Row(own_system(ik, first), first.rig, first.terrain, first.frames, first.tracks)
    assert first.place is not None  # they share a world
    warped = {
        name: jnp.asarray(neutral)
        for name, neutral in (("stride_scale", 1.0), ("orientation", 0.0))
        if any(getattr(scene.frames, name) is not None for scene in scenes)
    }
    frames = in_a_row([_frames_in_world(scene, first.rig, warped) for scene in scenes])
    return Row(ik, first.rig, first.place.terrain, frames, _tracks_in_a_row(ik, scenes))


def run_scene(ik: jaxik.FootIK, scene: Scene) -> jaxik.Result:
    """The result of a system on the clip of one scene, in its own world."""
    return run_row(ik, [scene])


def run_scenes(ik: jaxik.FootIK, scenes: Sequence[Scene]) -> tuple[jaxik.Result, ...]:
    """The result of a system on the clip of each scene: one loop for those that share a world."""
    results: dict[int, Result] = {}
    for numbers in groups(scenes):
        members = [scenes[number] for number in numbers]
        result = run_row(ik, members)
        parts = [result]
        if len(members) > 1:
            parts = list(map(_result_at_home, split(result, members), members))
        results |= zip(numbers, parts, strict=True)
    return tuple(results[number] for number in range(len(scenes)))


def run_row(ik: jaxik.FootIK, scenes: Sequence[Scene]) -> jaxik.Result:
    """The result of a system on one scene, or several in a row, in the world that they share."""
    row = row_of(ik, scenes)
    # Clips are checked when they are loaded.
    return jaxik.run(
        row.ik, row.rig, row.terrain, row.frames, tracks=row.tracks or None, checked=True
    )


def scene_in_a_row(scenes: Sequence[Scene]) -> Scene:
    """The scenes one after another, each in its own world; body and sigmas are those of frames."""
    first, plain = scenes[0], {"restart": None, "stride_scale": None, "rig": None}
    plain |= {"orientation": None}
    parts = []
    for scene in scenes:
        each = jnp.broadcast_to(scene.sigmas.correlation, len(WHITENED))  # where all share one, too
        part = (
            _bodies(scene, first.rig),
            dataclasses.replace(scene.frames, **plain),
            scene.pelvis,
            dataclasses.replace(scene.reference, label=first.reference.label),
            _for_frames(dataclasses.replace(scene.sigmas, correlation=each), scene),
        )
        parts.append(part)
    rig, frames, pelvis, reference, sigmas = in_a_row(parts)
    return Scene(rig, first.terrain, frames, pelvis, reference, sigmas)


def _bodies(scene: Scene, rig: jaxik.Rig) -> jaxik.Rig:
    """The body of a scene in each of its frames.

    Names and joints are not of a frame, but of the skeleton of a clip: here of that of `rig`.
    """
    body = dataclasses.replace(scene.rig, names=rig.names, joints=rig.joints, pelvis=rig.pelvis)
    return _for_frames(body, scene)


def _for_frames(tree: Tree, scene: Scene) -> Tree:
    """Arrays that all frames of a scene share, once for each."""
    count = len(scene.frames.dt)
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), tree)


def in_a_row(trees: Sequence[Tree]) -> Tree:
    """Trees of arrays, one after another along the first axis."""
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *trees)


def split(tree: Tree, scenes: Sequence[Scene], length: int | None = None) -> list[Tree]:
    """Arrays over the frames of these scenes in a row, scene by scene.

    Their length is less than that of the scenes where frames at both ends of a clip have no value.
    """
    counts = [len(scene.frames.dt) for scene in scenes]
    ends = np.cumsum(counts)
    missing = 0 if length is None else ends[-1] - length
    return [
        jax.tree.map(lambda leaf: leaf[end - count : end - missing], tree)  # noqa: B023
        for count, end in zip(counts, ends, strict=True)
    ]


def moved_out(tree: Tree, scene: Scene) -> Tree:
    """Places in the world of a scene, moved to where the scene is in the shared one."""
    return tree if scene.place is None else _moved(tree, scene, scene.place.offset_ws)


def _result_at_home(result: Result, scene: Scene) -> Result:
    """The result in the scene's own world, of a run in the shared one."""
    assert scene.place is not None and result.trace is not None
    by_ws, state = -scene.place.offset_ws, result.trace.advanced.state
    moved = _moved(result, scene, by_ws)
    if places.centre_about(by_ws) is None:  # else memory is about a centre, which moves instead
        return moved
    state = dataclasses.replace(state, centre_ws=state.centre_ws + by_ws)
    return eqx.tree_at(lambda result: result.trace.advanced.state, moved, state)


def _moved(tree: Tree, scene: Scene, by_ws: Float[Array, "3"]) -> Tree:
    up_ws = scene.terrain.up_ws
    return places.moved(tree, by_ws, up_ws, up_ws)


def _frames_in_world(scene: Scene, rig: jaxik.Rig, warped: Mapping[str, Array]) -> jaxik.Frame:
    """The frames of a scene in the shared world, each with its body.

    Fields in `warped` have that value where the scene leaves them out.
    """
    frames = moved_out(scene.frames, scene)
    begins = jnp.arange(len(frames.dt)) == 0
    restart = begins if frames.restart is None else frames.restart | begins
    bodies = _bodies(scene, rig)
    neutral = {
        name: value + jnp.zeros_like(frames.dt)
        for name, value in warped.items()
        if getattr(frames, name) is None
    }
    return dataclasses.replace(frames, restart=restart, rig=bodies, **neutral)


def _tracks_in_a_row(ik: jaxik.FootIK, scenes: Sequence[Scene]) -> dict[str, Array]:
    """The parameters that differ between clips or along them, with a value for each frame."""
    systems = [own_system(ik, scene) for scene in scenes]
    tracked = {name for scene in scenes for name in scene.tracks}
    if any(scene.size is not None for scene in scenes):
        tracked |= {
            slot.name
            for slots in zip(*map(parameter_tree.slots, systems), strict=True)
            for slot in slots[:1]
            if any(other.value is not slot.value for other in slots)
        }
    return {
        name: jnp.concatenate(
            [_track(system, scene, name) for system, scene in zip(systems, scenes, strict=True)]
        )
        for name in sorted(tracked)
    }


def _track(ik: jaxik.FootIK, scene: Scene, name: str) -> Array:
    """The value of a parameter in each frame of a scene."""
    if name in scene.tracks:
        return scene.tracks[name]
    value = jnp.asarray(parameter_tree.get(ik, name))
    return jnp.broadcast_to(value, (len(scene.frames.dt), *value.shape))


def groups(scenes: Sequence[Scene]) -> list[list[int]]:
    """The numbers of the scenes, those that share a world together."""
    groups: dict[tuple[bool, int], list[int]] = {}
    for number, scene in enumerate(scenes):
        key = (False, number) if scene.place is None else (True, scene.place.world)
        groups.setdefault(key, []).append(number)
    return list(groups.values())


def _worlds(scenes: Sequence[Scene]) -> list[list[int]]:
    """The numbers of the scenes that can share a world, together."""
    worlds: list[list[int]] = []
    for number, scene in enumerate(scenes):
        for numbers in worlds:
            if _can_share(scenes[numbers[0]], scene):
                numbers.append(number)
                break
        else:
            worlds.append([number])
    return worlds


def _can_share(a: Scene, b: Scene) -> bool:
    """Whether two clips can run in a row, in one world."""
    if (a.reference.left_out is None) != (b.reference.left_out is None):
        return False
    arrays = [(scene.rig.side, scene.frames.platforms.pos[0]) for scene in (a, b)]
    if jax.tree.map(jnp.shape, arrays[0]) != jax.tree.map(jnp.shape, arrays[1]):
        return False
    if _are_equal(a.terrain, b.terrain):
        return True
    meshes = all(isinstance(s, Mesh) for scene in (a, b) for s in scene.terrain.surfaces)
    return meshes and np.allclose(a.terrain.up_ws, b.terrain.up_ws, rtol=0, atol=1e-12)


def _distinct(terrains: Sequence[Terrain]) -> list[int]:
    """For each terrain, the number of the first that equals it."""
    numbers: list[int] = []
    for terrain in terrains:
        firsts = dict.fromkeys(numbers)
        same = (number for number in firsts if _are_equal(terrains[number], terrain))
        numbers.append(next(same, len(numbers)))
    return numbers


def _are_equal(a: Terrain, b: Terrain) -> bool:
    """Whether two terrains are the same ground."""
    if jax.tree.structure(a) != jax.tree.structure(b):
        return False
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(x is y or np.array_equal(x, y) for x, y in pairs)


def _side_by_side(scenes: Sequence[Scene], distinct: Sequence[int]) -> Float[np.ndarray, "n 3"]:
    """By how much each clip is moved, m, so that clips on different terrains stay apart.

    By multiples of the lattice of `jaxik.world.places`, so that numbers of 32 bits about the
    character stay as they are.
    """
    across = np.asarray(grid.frame_axes(scenes[0].terrain.up_ws))[0]
    extents = {terrain: (np.inf, -np.inf) for terrain in distinct}
    for scene, terrain in zip(scenes, distinct, strict=True):
        low, high = _extent(scene, across)
        extents[terrain] = min(extents[terrain][0], low), max(extents[terrain][1], high)
    shifts, end = {}, -np.inf
    for terrain, (low, high) in extents.items():
        shift = 0.0 if np.isinf(end) else places.LATTICE * np.ceil((end - low) / places.LATTICE)
        shifts[terrain], end = shift, high + shift
    return np.stack([shifts[terrain] * across for terrain in distinct])


def _extent(scene: Scene, across: np.ndarray) -> tuple[float, float]:
    """From where to where along an axis the ground of a clip and its rays are, m."""
    frames = scene.frames
    points = [np.asarray(frames.world_from_model.pos)]
    points += [np.asarray(s.vertices_ws) for s in scene.terrain.surfaces if isinstance(s, Mesh)]
    known = np.asarray(frames.stride.known) > 0
    points += [np.asarray(x)[known] for x in (frames.stride.last_ws, frames.stride.next_ws)]
    along = np.concatenate([part @ across for part in points])
    return along.min() - MARGIN, along.max() + MARGIN


class Stack(NamedTuple):
    """Clips with the same shapes, one after another on the first axis of each array."""

    scenes: Scene
    """On the host, as NumPy arrays; a terrain that all share has no such axis."""
    members: tuple[int, ...]
    """Which clips they are."""
    shares_terrain: bool

    @property
    def stacked(self) -> tuple[bool, ...]:
        """For each array, whether it has an axis of clips."""
        flags = jax.tree.map(lambda leaf: True, self.scenes)
        if self.shares_terrain:
            terrain = jax.tree.map(lambda leaf: False, self.scenes.terrain)
            flags = _with_terrain(flags, terrain)
        return tuple(jax.tree.leaves(flags))

    def one(self, number: int) -> Scene:
        """A clip of the stack, without an axis of clips."""
        return chosen(self.scenes, self.stacked, number)

    def part(self, first: int, count: int) -> Scene:
        """Clips from the first on; the last clip is repeated where there are too few."""
        numbers = np.minimum(np.arange(first, first + count), len(self.members) - 1)
        return chosen(self.scenes, self.stacked, numbers)


def chosen(tree: StackedTree, stacked: Sequence[bool], numbers: int | np.ndarray) -> StackedTree:
    """A tree whose stacked arrays have only these members, or a member and no axis of them."""
    leaves, structure = jax.tree.flatten(tree)
    pairs = zip(leaves, stacked, strict=True)
    return jax.tree.unflatten(structure, [x[numbers] if flag else x for x, flag in pairs])


def labelled(tree: PyTree, stacked: Sequence[bool], label: object, other: object = None) -> PyTree:
    """The tree with a label for each stacked array and another for others: axes or shardings."""
    leaves = [label if flag else other for flag in stacked]
    return jax.tree.unflatten(jax.tree.structure(tree), leaves)


def frame_count(scene: Scene) -> int:
    """How many frames a clip has."""
    return scene.frames.dt.shape[0]


def rounded_up(frames: int) -> int:
    """The number of frames to which a clip is made longer."""
    steps = math.ceil(math.log(max(frames, SHORTEST) / SHORTEST, GROWTH) - 1e-9)
    return max(frames, math.ceil(SHORTEST * GROWTH**steps))


def padded(scene: Scene, frames: int) -> Scene:
    """A clip with its last frame repeated up to a length; repetitions are not observed.

    Raises:
        ValueError: it has more frames than that.
    """
    missing = frames - frame_count(scene)
    if missing < 0:
        raise ValueError(f"the clip has {frame_count(scene)} frames; wanted at most {frames}")

    def lengthen(leaf: np.ndarray) -> np.ndarray:
        return np.concatenate([leaf, np.repeat(leaf[-1:], missing, axis=0)])

    parts = (scene.frames, scene.pelvis, scene.reference, scene.tracks)
    motion, pelvis, reference, tracks = jax.tree.map(lambda leaf: lengthen(np.asarray(leaf)), parts)
    observed = np.concatenate([np.asarray(scene.reference.observed), np.zeros(missing, bool)])
    reference = dataclasses.replace(reference, observed=observed)
    return dataclasses.replace(
        scene, frames=motion, pelvis=pelvis, reference=reference, tracks=tracks
    )


def stack(scenes: Sequence[Scene]) -> list[Stack]:
    """Clips in as few stacks as their shapes allow, each with clips in their order."""
    groups: dict[object, list[tuple[int, Scene]]] = {}
    for number, scene in enumerate(scenes):
        longer = padded(scene, rounded_up(frame_count(scene)))
        plain = _without_names(dataclasses.replace(longer, place=None))
        groups.setdefault(_shapes(plain), []).append((number, plain))
    return [_stacked(members) for members in groups.values()]


def _stacked(members: Sequence[tuple[int, Scene]]) -> Stack:
    numbers, scenes = zip(*members, strict=True)
    shares_terrain = all(_are_equal(scenes[0].terrain, scene.terrain) for scene in scenes[1:])
    apart = [_with_terrain(scene, None) if shares_terrain else scene for scene in scenes]
    stacked = jax.tree.map(lambda *leaves: np.stack([np.asarray(x) for x in leaves]), *apart)
    if shares_terrain:
        stacked = _with_terrain(stacked, jax.tree.map(np.asarray, scenes[0].terrain))
    return Stack(stacked, numbers, shares_terrain)


def _with_terrain(scene: Scene, terrain: PyTree) -> Scene:
    return eqx.tree_at(lambda s: s.terrain, scene, terrain, is_leaf=lambda leaf: leaf is None)


def _without_names(scene: Scene) -> Scene:
    """The clip without names and labels, which would separate it from others."""
    rig, reference = scene.rig, scene.reference
    legs = len(rig.names)
    names, joints = tuple(f"{i}" for i in range(legs)), ((0, 0, 0, 0),) * legs
    return dataclasses.replace(
        scene,
        rig=dataclasses.replace(rig, names=names, joints=joints, pelvis=0),
        reference=dataclasses.replace(reference, label=""),
    )


def _shapes(scene: Scene) -> object:
    """Equal for clips that one program computes."""
    leaves, structure = jax.tree.flatten(scene)
    return structure, tuple((np.shape(leaf), np.asarray(leaf).dtype.str) for leaf in leaves)
