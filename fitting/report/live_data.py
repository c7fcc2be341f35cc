"""What a page needs to solve its clips again without Python: systems as scripts, and their inputs.

Numbers have 64 bits, of which the last 16 are left out: nearly straight legs turn far when their
inputs move a little. Places are relative to the corner of the clip on the page.
`assets/solver.js` solves in a worker, `assets/live.js` has the sliders.
"""

import base64
import functools
import hashlib
import json
import os
import zlib
from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import resources
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PyTree
from scipy.spatial import KDTree

import jaxik
from fitting.clips import Clip
from fitting.clips.clip_frames import with_descendants
from fitting.clips.joint_maps import find_trunk
from fitting.codegen import js_code
from fitting.codegen.memory import doubles
from fitting.codegen.program import blank_rig, build
from fitting.ground.ground_path import STEP
from fitting.problem.scene import Scene
from fitting.runtime import cache_folder, files, program_cache
from fitting.runtime.plain_tree import NotPlainError
from fitting.runtime.precision import in_float64
from fitting.runtime.validation import Content
from jaxik.maths import parameter_tree
from jaxik.world import body, places
from jaxik.world.heightfield import Heightfield
from jaxik.world.surfaces import AbstractSurface, Mesh, Plane
from jaxik.world.terrain import LegTerrains, Terrain

from .sliders import Slider

MARGIN = 3.0  # m around the path within which there is ground, for an adult
CELL = 0.25  # m, of the squares that say so
MAX_TRIANGLES = 60_000
MAX_BYTES = 1_500_000  # of all inputs and scripts of a page, before base64 adds a third
UP = (0.0, 1.0, 0.0)
LEFT_OUT = 2  # bytes of each number of a table
ROLES = ("hip", "knee", "ankle", "toe")
ANKLE, TOE = 2, 3


_scripts: dict[Hashable, "Script"] = {}  # in this process


class NotLiveError(Exception):
    """The clip cannot be solved on a page; the message says why."""


class NoScriptError(Exception):
    """A system has an operation without a rule."""


class Script(NamedTuple):
    """A system whose numbers are inputs."""

    code: str
    """Of an object `system`; see `js_code.script`."""
    places: Mapping[str, Mapping[str, int]]
    """At which number of its struct a field begins, by struct and by dotted name."""


@dataclass(frozen=True)
class LiveSystem:
    """A system whose parameters can be changed on the page."""

    starts: Mapping[str, jaxik.FootIK]
    """Systems to go back to, by what they are called; the first is the one that is shown."""
    sliders: Sequence[Slider]


@dataclass(frozen=True)
class LiveClip:
    """A clip that can be solved again on its ground."""

    animated: Clip
    """With its root where foot IK gets it."""
    frames: jaxik.Frame
    rig: jaxik.Rig
    terrain: Terrain
    observed: Bool[np.ndarray, " frames"]
    systems: Mapping[str, LiveSystem]
    """By the keys of their motions in the view."""
    has_tracks: bool = False
    """Whether parameters change along the clip."""


@in_float64
def pack(
    clips: Sequence[LiveClip | None], corners: Sequence[np.ndarray]
) -> tuple[list[Content | None], int]:
    """What the scripts of a page need of its clips, and how many bytes that takes before base64.

    It is None for a clip that is not to be live, or whose system cannot be exported. It has only a
    `reason` where the clip or its ground cannot be solved there.

    Args:
        clips: in their order.
        corners: m, that places of each clip are relative to.
    """
    known: set[str] = set()
    contents: list[Content | None] = []
    spent = 0
    for clip, corner in zip(clips, corners, strict=True):
        content, size = None, 0
        if clip is not None and clip.systems:
            try:
                content = _pack(clip, corner, known)
                size = 3 * len(json.dumps(content)) // 4
                if spent + size > MAX_BYTES:
                    raise NotLiveError("the page would become too large")
                known |= set(content["scripts"])
            except NotLiveError as error:
                content, size = {"reason": str(error)}, 0
            except NoScriptError:
                pass
        contents.append(content)
        spent += size
    return contents, spent


def _pack(live: LiveClip, corner: np.ndarray, known: set[str]) -> Content:
    """A clip; scripts that are `known` are left out."""
    _check(live)
    surfaces = [pack_surface(each, live, corner) for each in live.terrain.surfaces]
    frames = places.moved(live.frames, *map(jnp.asarray, (-corner, UP, UP)))
    first = jax.tree.map(lambda leaf: leaf[0], live.frames)
    legs, scripts, systems = len(live.rig.side), {}, []
    for key, system in live.systems.items():
        try:
            program = script(next(iter(system.starts.values())), legs, live.terrain, first)
        except ValueError as error:
            raise NoScriptError(str(error)) from error
        code = program.code + solver()
        digest = hashlib.sha256(code.encode()).hexdigest()[:16]
        if digest not in known:
            scripts[digest] = {"code": packed(code.encode()), "layout": _layout(program, legs)}
        content = pack_system(key, system, program.places["parameters"], _numbers)
        systems.append(content | {"script": digest, "trunk": _trunk(live, program)})
    return {
        "scripts": scripts,
        "systems": systems,
        "frames": len(live.observed),
        "columns": doubles(frames).shape[1],
        "numbers": packed_table(doubles(frames)),
        "measures": packed(_numbers(live.rig).astype("<f8")),
        "surfaces": surfaces,
        "observed": packed(live.observed.astype("u1")),
        "anchors": _anchors(live.animated),
        "reach": STEP * body.ratio(live.rig),
    }


def _check(live: LiveClip) -> None:
    terrain = live.terrain
    if live.has_tracks:
        raise NotLiveError("a track changes parameters along the clip")
    if terrain.platform_count:
        raise NotLiveError("its ground moves")
    if not np.allclose(terrain.up_ws, UP, atol=1e-6):
        raise NotLiveError("up is not the y axis")
    if not np.asarray(live.rig.present).all():
        raise NotLiveError("a leg is missing")


@functools.cache
def solver() -> str:
    """The script that solves a clip with the object `system`."""
    return (resources.files("fitting.report") / "assets" / "solver.js").read_text("utf-8")


def packed(content: bytes | np.ndarray) -> str:
    """Bytes, or an array row by row, compressed, in base64."""
    data = content if isinstance(content, bytes) else np.ascontiguousarray(content).tobytes()
    return base64.b64encode(zlib.compress(data, 9)).decode("ascii")


def unpacked_doubles(text: str) -> Float[np.ndarray, " numbers"]:
    """Numbers that a page has sent, in base64.

    Raises:
        ValueError: they are not.
    """
    return np.frombuffer(base64.b64decode(text, validate=True), "<f8")


def packed_table(table: Float[np.ndarray, "rows columns"]) -> str:
    """Numbers as 48 bits, column by column: first the last byte of each.

    Neighbours in a column are alike, and so are their first bytes: that halves what is compressed.
    """
    bytes_of = np.ascontiguousarray(table.T, "<f8").view("u1").reshape(-1, 8)
    return packed(bytes_of[:, LEFT_OUT:].T)


def _numbers(tree: PyTree) -> Float[np.ndarray, " numbers"]:
    """The numbers of a struct."""
    return doubles(jax.tree.map(lambda leaf: np.asarray(leaf)[None], tree))[0]


def _layout(program: Script, legs: int) -> Content:
    """At which numbers of a frame and of a result there are transforms: position and rotation."""

    def transforms(struct: str) -> list[list[int]]:
        own = program.places[struct]
        return [
            [own[f"pose.{role}.pos"] + 3 * leg, own[f"pose.{role}.rot"] + 4 * leg]
            for leg in range(legs)
            for role in ROLES
        ]

    frame, result = program.places["frame"], program.places["result"]
    return {
        "root": [frame["world_from_model.pos"], frame["world_from_model.rot"]],
        "body": [result["body.pos"], result["body.rot"]],
        "before": transforms("frame"),
        "after": transforms("result"),
    }


def _trunk(live: LiveClip, program: Script) -> list[Content]:
    """The joints that a system turns above the pelvis, as `clip_from_result` does."""
    clip, result = live.animated, program.places["result"]
    trunk = find_trunk(clip.joint_names, clip.parents, clip.rig.pelvis)
    turns = [(joint, "twist", 1.0 / len(trunk.twisted)) for joint in trunk.twisted]
    if trunk.spine is not None:
        turns += [(trunk.spine, "spine", 1.0), (trunk.head, "head", 1.0)]
    return [
        {
            "joint": joint,
            "rot": result[f"corrections.{kind}"],
            "part": part,
            "members": with_descendants([joint], clip.parents),
        }
        for joint, kind, part in turns
        if joint is not None and f"corrections.{kind}" in result
    ]


def _anchors(clip: Clip) -> list[tuple[int, int]]:
    """What each point of the skeleton moves with: joints, then heel and ball of each sole.

    The first number is the joint of a leg at which it is or from which it has its distance, of
    which there are four a leg; -1 is the body. The second is the one with which the distance turns;
    -1 where the point is the joint itself.
    """
    own: dict[int, int] = {}
    for leg, joints in enumerate(clip.rig.joints):
        for role in (TOE, ANKLE, 1, 0):  # as in `clip_from_result`, an ankle may be a toe, too
            own[joints[role]] = len(ROLES) * leg + role
    anchors: list[tuple[int, int]] = []
    for joint, parent in enumerate(clip.parents):
        if joint in own:
            anchors.append((own[joint], -1))
        else:
            above = anchors[parent][0] if parent >= 0 else -1
            anchors.append((above, above))
    for leg, joints in enumerate(clip.rig.joints):
        ankle = len(ROLES) * leg + ANKLE
        anchors += [(ankle, ankle), (own[joints[TOE]], ankle)]
    return anchors


def pack_system(
    key: str,
    system: LiveSystem,
    place: Mapping[str, int],
    numbers: Callable[[jaxik.FootIK], Float[np.ndarray, " numbers"]],
) -> Content:
    """The sliders of a system, and the values of those to go back to that have as many.

    Args:
        key: of its motion in the view.
        system: with its sliders.
        place: of the first number of each array of parameters among the values.
        numbers: the values of a system.
    """
    first = next(iter(system.starts.values()))
    shapes = {slot.name: np.shape(slot.value) for slot in parameter_tree.slots(first)}

    def span(leaf: str) -> list[int]:
        return [place[leaf], place[leaf] + int(np.prod(shapes[leaf], dtype=int))]

    return {
        "key": key,
        "starts": {
            name: packed(numbers(ik).astype("<f8"))
            for name, ik in system.starts.items()
            if is_alike(ik, first)
        },
        "sliders": [
            {
                "name": slider.name,
                "leaf": slider.leaf,
                "at": place[slider.leaf] + _flat(slider.index, shapes[slider.leaf]),
                "low": slider.low,
                "high": slider.high,
                "step": slider.step,
                "unit": slider.unit,
                "meaning": slider.meaning,
                "switch": slider.is_switch,
                "free": slider.is_free,
                "above": [] if slider.above is None else span(slider.above),
                "below": [span(leaf) for leaf in slider.below],
            }
            for slider in system.sliders
        ],
    }


def is_alike(ik: jaxik.FootIK, other: jaxik.FootIK) -> bool:
    """Whether two systems have the same arrays; some have a number for each leg."""
    shapes = [jax.tree.map(np.shape, each) for each in (ik, other)]
    return jax.tree.structure(ik) == jax.tree.structure(other) and shapes[0] == shapes[1]


def _flat(index: tuple[int, ...], shape: tuple[int, ...]) -> int:
    return int(np.ravel_multi_index(index, shape)) if index else 0


def pack_surface(surface: AbstractSurface, live: LiveClip, corner: np.ndarray) -> Content:
    """A surface, as far as it is near the path of a clip, relative to a corner, m.

    Raises:
        NotLiveError: it is of another kind than the solver knows, or has too many triangles.
    """
    match surface:
        case Plane():
            return {
                "kind": "Plane",
                "point": (np.asarray(surface.point_ws) - corner).tolist(),
                "normal": np.asarray(surface.normal_ws).tolist(),
                "layers": int(surface.layers),
            }
        case Mesh():
            return _pack_mesh(surface, live, corner)
        case Heightfield():
            return _pack_heights(surface, live, corner)
    raise NotLiveError("its ground is neither a mesh, nor a plane, nor a grid of heights")


def _path(live: LiveClip) -> tuple[np.ndarray, float]:
    """x and z of the pelvis, m, and how far around it ground counts."""
    pelvis = live.animated.positions_ws[:, live.animated.rig.pelvis]
    return pelvis[:, [0, 2]], MARGIN * body.ratio(live.rig)


def _pack_mesh(mesh: Mesh, live: LiveClip, corner: np.ndarray) -> Content:
    path, margin = _path(live)
    vertices, triangles, layers = mesh.on_host()
    near = _near(vertices[:, [0, 2]][triangles], path, margin)
    if near.sum() > MAX_TRIANGLES:
        raise NotLiveError(f"the ground near its path has {near.sum():,} triangles")
    used, corners = np.unique(triangles[near], return_inverse=True)
    return {
        "kind": "Mesh",
        "low": (path.min(axis=0) - margin - corner[[0, 2]]).tolist(),
        "high": (path.max(axis=0) + margin - corner[[0, 2]]).tolist(),
        "vertices": packed_table(vertices[used] - corner),
        "triangles": packed(corners.astype("<u4")),
        "layers": packed(layers[near].astype("<u4")),
    }


def _near(corners: np.ndarray, path: np.ndarray, margin: float) -> np.ndarray:
    """Which triangles, x and z of whose corners are (triangles, 3, 2), are near a path."""
    low, high = path.min(axis=0) - margin, path.max(axis=0) + margin
    size = np.maximum(1, np.ceil((high - low) / CELL)).astype(int)
    middles = np.stack(np.meshgrid(*(np.arange(n) for n in size), indexing="ij"), -1) + 0.5
    distance = KDTree(path).query(low + CELL * middles, distance_upper_bound=margin + CELL)[0]
    counts = np.zeros(size + 1, int)  # of near squares, up to a row and a column
    counts[1:, 1:] = np.isfinite(distance).cumsum(axis=0).cumsum(axis=1)
    first = np.clip(np.floor((corners.min(axis=1) - low) / CELL), 0, size).astype(int)
    last = np.clip(np.floor((corners.max(axis=1) - low) / CELL) + 1, 0, size).astype(int)
    (a, b), (c, d) = first.T, last.T
    return counts[c, d] - counts[a, d] - counts[c, b] + counts[a, b] > 0


def _pack_heights(field: Heightfield, live: LiveClip, corner: np.ndarray) -> Content:
    path, margin = _path(live)
    heights, spacing = np.asarray(field.heights), np.asarray(field.spacing)
    origin = np.asarray(field.origin_ws)
    last = np.array(heights.shape[::-1]) - 1
    first = np.clip(np.floor((path.min(axis=0) - margin - origin[[0, 2]]) / spacing), 0, last - 1)
    end = np.clip(np.ceil((path.max(axis=0) + margin - origin[[0, 2]]) / spacing), first + 1, last)
    (left, near), (right, far) = first.astype(int), end.astype(int) + 1
    part = heights[near:far, left:right]
    shift = np.array([left * spacing[0], 0.0, near * spacing[1]])
    return {
        "kind": "Heights",
        "origin": (origin + shift - corner).tolist(),
        "spacing": spacing.tolist(),
        "rows": len(part),
        "columns": len(part[0]),
        "heights": packed_table(part),
        "bilinear": field.interpolation == "bilinear",
        "layers": int(field.layers),
    }


def prepare(ik: jaxik.FootIK, scene: Scene) -> None:
    """Makes the script of a system for a clip, which its page then need not wait for."""
    first = jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf)[0]), scene.frames)
    with suppress(ValueError):  # the page then does without
        script(ik, len(scene.rig.side), scene.terrain, first)


def script(
    ik: jaxik.FootIK, legs: int, terrain: Terrain | LegTerrains, frame: jaxik.Frame
) -> Script:
    """The script of a system; it is written anew only if none of its kind is cached.

    Args:
        ik: the system, whose numbers do not matter.
        legs: how many a character has.
        terrain: whose up directions are fixed, and which says how many platforms there are.
        frame: a single one with the fields that there are to be.

    Raises:
        ValueError: the system cannot be exported; see `program.build`.
    """
    ups = [ground.up_ws.tolist() for ground in (terrain, *getattr(terrain, "legs", ()))]
    rest = legs, terrain.platform_count, json.dumps(ups)
    shapes = tuple((leaf.shape, leaf.dtype) for leaf in jax.tree.leaves((ik, frame)))
    here = jax.tree.structure((ik, frame)), shapes, rest
    if here not in _scripts:
        try:
            key = program_cache.program_key(script, ((ik, frame, rest), {}))
            _scripts[here] = _cached(key, lambda: _make(ik, legs, terrain, frame))
        except NotPlainError:  # a rule of the user's own, which may change
            _scripts[here] = _make(ik, legs, terrain, frame)
    return _scripts[here]


def _cached(key: str, make: Callable[[], Script]) -> Script:
    """The script with this key on disk, or a new one, which is then written there."""
    try:
        path = cache_folder.traced() / f"script-{key}"
    except (cache_folder.SwitchedOffError, OSError):
        return make()
    try:
        with path.open(encoding="utf-8") as file:
            cache_folder.check_own(path, os.fstat(file.fileno()))
            return Script(**json.load(file))
    except (OSError, ValueError, TypeError):  # there is none, or it is damaged
        new = make()
        with suppress(OSError, ValueError):  # the disk is full, or the like
            files.write_text(path, json.dumps(new._asdict()))
        return new


def _make(
    ik: jaxik.FootIK, legs: int, terrain: Terrain | LegTerrains, frame: jaxik.Frame
) -> Script:
    program = build(ik, blank_rig(legs), terrain, frame)
    starts = {
        struct: {".".join(path): start for path, start in js_code.starts(program, struct).items()}
        for struct in program.trees
    }
    return Script(js_code.script(program), starts)
