"""The shape of a character on a page: limbs around its bones, so that a skeleton looks like a body.

A limb is round or flattened, and its radius changes smoothly from one end to the other. What of a
skeleton is a trunk, an arm or a head follows from the legs, from the joint that is called head, and
from what branches off between: any skeleton has a shape, one of legs only that of legs with hips.
Sizes are those of an adult with legs as long as the clip's.

A character that has a mesh, its skin, is shown with that: places of vertices have 16 bits of the
mesh's size, weights 8, and the parts of a quaternion 16.
"""

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from fitting.clips import Clip
from fitting.clips.formats import gltf_model
from fitting.clips.formats.gltf_model import Surface
from fitting.clips.joint_maps import find_trunk
from jaxik.world import body

MOST_FRAMES = 120  # that are looked at for the length of a bone
# Half the width of an adult's body, m: at the ends of each part and in its middle.
THIGH = (0.083, 0.074, 0.054)
SHIN = (0.052, 0.053, 0.034)
HIP_WIDTH, WIDEST = 0.07, 0.165  # beside the joints of the hips; and at most
WAIST, CHEST = 0.125, 0.152
SHOULDERS = 0.62  # of the distance of a shoulder from the middle: what the chest has at the top
DEPTH = 0.68  # of the trunk's width
NECK = (0.062, 0.05, 0.052)
JAW, SKULL = 0.062, 0.083
LEAST, MOST = 0.035, 0.125  # m, along the head from the base of the skull: middles of both
HEAD_DEPTH = 1.12  # of its width
LONGEST_NECK = 0.19  # m, from the line of the shoulders to the base of the skull
WAIST_AT = 0.42  # of the way from the hips to the shoulders
ARM_AT = (0.0, 0.2, 0.4, 0.5, 0.74, 0.86, 1.0)  # of the way from shoulder to finger tip
ARM = (0.05, 0.047, 0.037, 0.041, 0.026, 0.034, 0.02)
HAND = 0.17  # m, where the arm ends at a wrist
COLLAR = 0.1  # m beside the spine, within which there is no shoulder
LONG_ARM = 0.3  # m; what is shorter, and branches off the trunk, is drawn as bones
BONE = 0.011  # of all other bones
BARREL, BARREL_DEPTH = (0.05, 0.1, 0.2), 0.85  # beside a pair of hips; least; most
UPPER = 0.8  # of the way to the head of a body without arms, up to which its trunk goes
SOLE_WIDTH = (0.27, 0.4)  # of the distance from ankle to ball: half the width of heel and ball
BEHIND, AHEAD = 0.36, 0.42  # likewise: heel behind the ankle, tip ahead of the ball
TIP = 0.185  # m ahead of the ankle
INSIDE = 0.25  # m from the joint of a head or an ankle: what hangs on it is in the head or the foot
NEAR = 0.3  # m from the pelvis: what is further above it is no part of the body
POINT_FOOT = 0.02  # m; a shorter foot has no direction


class Limb(NamedTuple):
    """A part of the body between two points."""

    start: int
    end: int
    radii: tuple[float, float, float]
    """m, across: at the start, in the middle and at the end."""
    depth: float = 1.0
    """Of the radius, forwards and backwards."""
    across: tuple[int, int] | None = None
    """Points from right to left; None for a round limb."""


@dataclass
class Shape:
    """What is drawn of a clip; points are its joints, its soles, and then those named here."""

    clip: Clip
    between: list[tuple[int, int, float]] = field(default_factory=list)
    """Further points: on the line through two others, as a share of the way."""
    limbs: list[Limb] = field(default_factory=list)
    bones: set[tuple[int, int]] = field(default_factory=set)
    """Parent and joint of each bone inside a limb."""

    def __post_init__(self) -> None:
        step = -(-self.clip.frame_count // MOST_FRAMES)
        self.frames = slice(None, None, step)
        self.size = float(body.ratio(self.clip.rig))
        self.first = len(self.clip.joint_names) + 2 * len(self.clip.rig.names)
        self.left_ws = self.clip.left_ws()[self.frames]
        self.length = cache(self._length)

    def places(self, point: int) -> Float64[np.ndarray, "frames 3"]:
        """A joint, or one of the points between, m."""
        if point < self.first:
            return self.clip.positions_ws[self.frames, point]
        a, b, share = self.between[point - self.first]
        return self.places(a) + share * (self.places(b) - self.places(a))

    def _length(self, a: int, b: int) -> float:
        """Median distance of two points, m of an adult."""
        return (
            float(np.median(np.linalg.norm(self.places(b) - self.places(a), axis=-1))) / self.size
        )

    def side(self, a: int, b: int) -> float:
        """How far the second point is to the left of the first, m of an adult."""
        offsets = self.places(b) - self.places(a)
        return float(np.median(np.sum(offsets * self.left_ws, axis=-1))) / self.size

    def on_line(self, a: int, b: int, metres: float) -> int:
        """A point on the line through two others, so many adult's metres from the first."""
        return self.point(a, b, metres / max(self.length(a, b), 1e-6))

    def point(self, a: int, b: int, share: float) -> int:
        """A point on the line through two others."""
        self.between.append((a, b, share))
        return self.first + len(self.between) - 1

    def limb(
        self,
        start: int,
        end: int,
        radii: Sequence[float],
        depth: float = 1.0,
        across: tuple[int, int] | None = None,
    ) -> None:
        """Adds a limb; radii are those of an adult, m, and the second one that of the middle."""
        first, middle, last = radii
        scaled = self.size * first, self.size * middle, self.size * last
        self.limbs.append(Limb(start, end, scaled, depth, across))

    def cover(self, joints: Sequence[int]) -> None:
        """Bones from each of these joints to the next are inside limbs."""
        self.bones |= set(zip(joints, joints[1:], strict=False))


def pack(clip: Clip) -> dict[str, Any]:
    """The shape of a clip's body, as the page's scripts read it."""
    shape = Shape(clip)
    pairs = _pairs(shape)
    for hip, knee, ankle, toe in clip.rig.joints:
        shape.limb(hip, knee, THIGH)
        shape.limb(knee, ankle, SHIN)
        for start, end in ((hip, knee), (knee, ankle), (ankle, toe)):
            shape.cover(_way(clip.parents, start, end))
        _swallow(shape, ankle)
    if len(pairs) > 1:
        _barrel(shape, pairs)
    else:
        _person(shape, pairs[0])
    _add_bones(shape)
    feet = [_foot(shape, leg) for leg in range(len(clip.rig.names))]
    return {
        "between": [[a, b, round(share, 4)] for a, b, share in shape.between],
        "limbs": [
            [limb.start, limb.end, *(round(r, 4) for r in limb.radii), limb.depth,
             *(limb.across or (-1, -1))]
            for limb in shape.limbs
        ],
        "feet": feet,
    }  # fmt: skip


def _pairs(shape: Shape) -> list[list[int]]:
    """The hips, right one first, as those of a pair; a leg without another is one of its own."""
    hips = [joints[0] for joints in shape.clip.rig.joints]
    sides = np.asarray(shape.clip.rig.side)
    right = [hip for hip, side in zip(hips, sides, strict=True) if side < 0]
    pairs = []
    for hip, side in zip(hips, sides, strict=True):
        if side > 0 and right:
            other = min(right, key=lambda joint: shape.length(hip, joint))
            right.remove(other)
            pairs.append([other, hip])
        elif side >= 0:
            pairs.append([hip])
    return pairs + [[hip] for hip in right]


def _way(parents: tuple[int, ...], start: int, end: int) -> list[int]:
    """The joints from one to another below it; only the last if it is not below."""
    way = [end]
    while way[0] != start and parents[way[0]] >= 0:
        way.insert(0, parents[way[0]])
    return way if way[0] == start else [end]


def _barrel(shape: Shape, pairs: list[list[int]]) -> None:
    """A trunk from each pair of legs to the next."""
    middles = [shape.point(pair[0], pair[-1], 0.5) for pair in pairs]
    for pair in pairs:
        _girdle(shape, pair)
    beside, least, most = BARREL
    widths = [0.5 * shape.length(pair[0], pair[-1]) + beside for pair in pairs]
    widths = np.clip(widths, least, most).tolist()
    for number, (start, end) in enumerate(zip(middles, middles[1:], strict=False)):
        first, last = widths[number : number + 2]
        across = pairs[number][0], pairs[number][-1]
        shape.limb(start, end, (first, 0.46 * (first + last), last), BARREL_DEPTH, across)


def _girdle(shape: Shape, pair: list[int]) -> None:
    """The hips of a pair of legs."""
    for hip in pair:
        shape.cover(_way(shape.clip.parents, shape.clip.rig.pelvis, hip))
    if len(pair) > 1:
        width = THIGH[0] + 0.004
        shape.limb(pair[0], pair[-1], (width, 1.1 * width, width))


def _person(shape: Shape, hips: list[int]) -> None:
    """Hips and what is above them: trunk, shoulders, arms, neck and head, as far as there are."""
    clip = shape.clip
    pelvis = clip.rig.pelvis
    _girdle(shape, hips)
    middle = shape.point(hips[0], hips[-1], 0.5)
    across = (hips[0], hips[-1]) if len(hips) > 1 else None
    half = min(0.5 * shape.length(hips[0], hips[-1]) + HIP_WIDTH, WIDEST)
    trunk = find_trunk(clip.joint_names, clip.parents, pelvis)
    chain = _chain(clip, trunk.spine, trunk.head)
    if not chain:
        radii = half, 0.95 * half, 0.8 * half
        shape.limb(middle, pelvis, radii, DEPTH, across)
        return
    shape.cover([clip.parents[chain[0]], *chain])
    head = trunk.head
    arms = _arms(shape, chain)
    if len(arms) == 2:
        right, left = arms[0][0], arms[1][0]
        top, lines = shape.point(right, left, 0.5), (right, left)
        upper = SHOULDERS * 0.5 * shape.length(right, left)
    elif head is not None:
        top, lines, upper = shape.point(middle, head, UPPER), across, 0.9 * WAIST
    else:
        top, lines, upper = chain[-1], across, 0.9 * WAIST
    waist = shape.point(middle, top, WAIST_AT)
    shape.limb(middle, waist, (half, 0.93 * half, WAIST), DEPTH, across)
    shape.limb(waist, top, (WAIST, CHEST, max(upper, 0.08)), DEPTH, lines)
    if head is not None:
        _head(shape, top, head, lines)
    if len(arms) == 2:
        for arm in arms:
            neck = top if head is None else shape.point(top, head, 0.4)
            shape.limb(neck, arm[0], (NECK[1], 0.045, ARM[0]))
            _arm(shape, arm)


def _chain(clip: Clip, spine: int | None, head: int | None) -> list[int]:
    """The joints from the base of the spine to the head, or as far as one goes on without it."""
    if head is not None:
        return [head] if spine is None else _way(clip.parents, spine, head)
    chain = [] if spine is None else [spine]
    while chain and clip.parents.count(chain[-1]) == 1:
        chain.append(clip.parents.index(chain[-1]))
    return chain


def _arms(shape: Shape, chain: list[int]) -> list[list[int]]:
    """The joints of both arms from shoulder to tip, right one first; none without a pair."""
    clip = shape.clip
    arms: dict[bool, list[int]] = {}
    for joint in chain[:-1] or chain:
        for branch in _children(clip.parents, joint):
            if branch in chain:
                continue
            way = [joint, *_longest(shape, branch)]
            is_left = shape.side(joint, way[-1]) > 0
            if _reach(shape, way) > max(LONG_ARM, _reach(shape, arms.get(is_left, []))):
                arms[is_left] = way
    return [_from_shoulder(shape, arms[side]) for side in (False, True)] if len(arms) == 2 else []


def _children(parents: tuple[int, ...], joint: int) -> list[int]:
    return [child for child, parent in enumerate(parents) if parent == joint]


def _longest(shape: Shape, joint: int) -> list[int]:
    """The longest way from a joint to an end below it."""
    children = _children(shape.clip.parents, joint)
    ways = [[joint, *_longest(shape, child)] for child in children]
    return max(ways, key=lambda way: _reach(shape, way), default=[joint])


def _reach(shape: Shape, way: list[int]) -> float:
    """Length of a way, m of an adult."""
    return sum(shape.length(a, b) for a, b in zip(way, way[1:], strict=False))


def _from_shoulder(shape: Shape, way: list[int]) -> list[int]:
    """An arm without what leads to it: its upper arm and forearm are the longest two bones."""
    shape.cover(way)
    starts = range(1, max(len(way) - 2, 2))
    aside = [i for i in starts if abs(shape.side(way[0], way[i])) > COLLAR]
    return way[max(aside or starts, key=lambda i: _reach(shape, way[i : i + 3])) :]


def _arm(shape: Shape, arm: list[int]) -> None:
    """Limbs from the shoulder to the tip of the hand."""
    if len(arm) == 1:
        return
    if len(arm) <= 3:  # it ends at the wrist, or before
        arm = [*arm, shape.on_line(arm[-2], arm[-1], shape.length(*arm[-2:]) + HAND)]
    ends = np.cumsum([0.0, *(shape.length(a, b) for a, b in zip(arm, arm[1:], strict=False))])
    ends = ends / max(ends[-1], 1e-6)
    for start, end, first, last in zip(arm, arm[1:], ends, ends[1:], strict=False):
        if last > first:
            at = np.interp([first, 0.5 * (first + last), last], ARM_AT, ARM)
            shape.limb(start, end, at.tolist())


def _head(shape: Shape, top: int, head: int, across: tuple[int, int] | None) -> None:
    """Neck and head; which way the head looks is that of a bone that goes on from it, if any."""
    base = shape.point(top, head, min(1.0, LONGEST_NECK / max(shape.length(top, head), 1e-6)))
    shape.limb(top, base, NECK)
    name = shape.clip.joint_names[head].lower()
    _swallow(shape, head)
    ends = _children(shape.clip.parents, head)
    ends = [joint for joint in ends if shape.clip.joint_names[joint].lower().startswith(name)]
    if ends and shape.length(head, ends[0]) > 0.03:
        jaw, skull = (shape.on_line(head, ends[0], at) for at in (LEAST, MOST))
    else:
        jaw, skull = (shape.on_line(base, top, -at) for at in (LEAST, MOST))
    shape.limb(jaw, skull, (JAW, 0.5 * (JAW + SKULL), SKULL), HEAD_DEPTH, across)


def _swallow(shape: Shape, joint: int) -> None:
    """Bones near a joint that hang on it are inside what is drawn there."""
    parents = shape.clip.parents
    for below, parent in enumerate(parents):
        if joint in _way(parents, joint, below)[:-1] and shape.length(joint, below) < INSIDE:
            shape.cover([parent, below])


def _add_bones(shape: Shape) -> None:
    """Whatever is in no limb, as bones; not what leads to the body from elsewhere."""
    clip = shape.clip
    above, joint = set(), clip.rig.pelvis
    while clip.parents[joint] >= 0:
        joint = clip.parents[joint]
        above.add(joint)
    for joint, parent in enumerate(clip.parents):
        is_far = parent in above and shape.length(parent, clip.rig.pelvis) > NEAR
        if parent < 0 or (parent, joint) in shape.bones or is_far or joint in above:
            continue
        shape.limb(parent, joint, (BONE, BONE, 0.7 * BONE))


def _foot(shape: Shape, leg: int) -> list[float]:
    """m, half the widths of heel and ball, and how far the sole goes on behind and ahead."""
    _, _, ankle, toe = shape.clip.rig.joints[leg]
    length = float(np.asarray(shape.clip.rig.foot)[leg])
    if shape.length(ankle, toe) < POINT_FOOT:
        return []
    ahead = min(AHEAD * length, max(TIP * shape.size - length, 0.1 * length))
    return [*(round(length * share, 4) for share in (*SOLE_WIDTH, BEHIND)), round(ahead, 4)]


# Skinned meshes, and the rotations of the joints that they follow.

STEPS = 65_535  # of a coordinate
FULL = 255  # weight of a joint that a vertex follows alone
LARGEST = 32_767  # of a part of a quaternion


class Skin(NamedTuple):
    """The mesh of a character, packed, and the joints whose rotations it needs."""

    content: dict[str, Any]
    joints: tuple[int, ...]
    """By index, parents first."""
    size: int
    """Bytes before base64."""


def pack_skin(clip: Clip) -> Skin | None:
    """The mesh of a clip's character; None for one without."""
    surface = gltf_model.surface(clip)
    if surface is None or not len(surface.triangles):
        return None
    joints = tuple(sorted(set(surface.joints)))
    low = surface.vertices.min(axis=0)
    step = np.maximum(np.ptp(surface.vertices, axis=0), 1e-9) / STEPS
    arrays = {
        "vertices": np.round((surface.vertices - low) / step).astype("<u2"),
        "triangles": surface.triangles.astype("<u2" if len(surface.vertices) <= STEPS else "<u4"),
        "followed": surface.followed.astype("<u2"),
        "weights": _weights(surface),
        "binds": surface.binds.astype("<f4"),
    }
    content = {name: _base64(array) for name, array in arrays.items()}
    content |= {
        "low": low.tolist(),
        "step": step.tolist(),
        "slots": [joints.index(joint) for joint in surface.joints],
        "joints": joints,
        "above": [_above(clip, joints, joint) for joint in joints],
        "towards": [_next(clip, joint) for joint in joints],
    }
    return Skin(content, joints, sum(array.nbytes for array in arrays.values()))


def pack_rotations(rotations_ws: Float64[np.ndarray, "frames joints 4"]) -> str:
    """Quaternions of a skin's joints, wxyz, in base64."""
    return _base64(rounded_rotations(rotations_ws))


def rounded_rotations(rotations_ws: Float64[np.ndarray, "frames joints 4"]) -> np.ndarray:
    """Quaternions of a skin's joints, wxyz, as integers of 16 bits."""
    return np.round(rotations_ws * LARGEST).astype("<i2")


def _weights(surface: Surface) -> np.ndarray:
    """In steps whose sum is `FULL`: what rounding takes, the largest gets."""
    steps = np.floor(surface.weights * FULL).astype(int)
    rows, largest = np.arange(len(steps)), steps.argmax(axis=1)
    steps[rows, largest] += FULL - steps.sum(axis=1)
    return steps.astype("u1")


def _above(clip: Clip, joints: tuple[int, ...], joint: int) -> int:
    """Where among the joints the nearest one above is; -1 if there is none."""
    parent = clip.parents[joint]
    while parent >= 0 and parent not in joints:
        parent = clip.parents[parent]
    return joints.index(parent) if parent >= 0 else -1


def _next(clip: Clip, joint: int) -> int:
    """The first joint below one that is not in the same place; -1 at an end."""
    for child, parent in enumerate(clip.parents):
        if parent == joint and np.linalg.norm(clip.offsets_ls[child]) > 1e-3:
            return child
    return -1


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")
