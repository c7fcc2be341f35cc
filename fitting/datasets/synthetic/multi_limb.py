"""Made motion of bodies on many limbs: a quadruped that walks, a climber on a wall.

A rigid body travels along a path at an even pace. Each limb stands on its foothold while the body
passes over it, for the same share of every stride, and swings to the next one. Limbs are closed by
the cosine law, so that bones keep their lengths exactly. Motion is made over a floor, y up and z
ahead; for the climber the floor is then set upright.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from fitting.datasets.clips.clip import Clip
from fitting.datasets.clips.formats.npz import clip_from_joints, leg_rotations
from fitting.datasets.clips.rigs import unit

from . import terrain_meshes
from .footsteps import Path
from .trajectories import smoothstep
from .walker import bent_knee

Point = tuple[float, float, float]  # left, up, ahead, m
PARTS = ("hip", "knee", "ankle", "toe")
UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class Limb:
    """A two-bone limb with a foot or hand; places are the body's, from its middle on the floor."""

    name: str
    root: Point  # m, of the hip or shoulder
    home: tuple[float, float]  # m, left and ahead: the ball of the foot amid its stance
    pole: Point  # where the knee or elbow points
    bones: tuple[float, float]  # m, the upper one first
    late: float  # of a stride, after the first limb


@dataclass(frozen=True)
class Body:
    """A body, the limbs on which it goes, and how it goes."""

    name: str
    limbs: tuple[Limb, ...]
    height: float  # m, of its middle over the floor
    stride: float  # m
    period: float  # s, of a stride
    standing: float  # share of a stride in which a limb stands
    lift: float  # m, of the ball at the height of a swing
    droop: float  # rad, by which toes point down there
    bob: float  # m, by which the body rises and falls, twice a stride
    foot: tuple[float, float]  # m, from ankle to ball, down and ahead
    sole: float  # m, from ball to sole


def _pair(name: str, root: Point, home: tuple[float, float], pole: Point,
          bones: tuple[float, float], late: tuple[float, float]) -> tuple[Limb, Limb]:  # fmt: skip
    """A left limb and its mirror image; `late` is that of the left one, then of the right one."""
    left, right = (
        Limb(
            f"{name}_{side}",
            (sign * root[0], *root[1:]),
            (sign * home[0], home[1]),
            (sign * pole[0], *pole[1:]),
            bones,
            own,
        )
        for side, sign, own in zip(("left", "right"), (1.0, -1.0), late, strict=True)
    )
    return left, right


# A large dog or a pony. Lateral sequence: each hind foot is followed by the fore foot of its side.
QUADRUPED = Body(
    "quadruped",
    (
        *_pair("fore", (0.11, 0.68, 0.36), (0.10, 0.42), (0.0, 0.0, -1.0), (0.35, 0.37),
               (0.25, 0.75)),
        *_pair("hind", (0.10, 0.68, -0.36), (0.11, -0.30), (0.0, 0.0, 1.0), (0.37, 0.36),
               (0.0, 0.5)),
    ),
    height=0.72, stride=0.80, period=0.85, standing=0.62, lift=0.09, droop=0.5, bob=0.008,
    foot=(0.05, 0.06), sole=0.03,
)  # fmt: skip

# An adult, chest to the wall, three limbs on it at any time. Elbows hang, knees open sideways.
CLIMBER = Body(
    "climber",
    (
        *_pair("hand", (0.19, 0.30, 0.26), (0.28, 0.62), (0.5, 0.4, -0.6), (0.30, 0.27),
               (0.0, 0.5)),
        *_pair("foot", (0.09, 0.30, -0.26), (0.26, -0.66), (0.9, 0.3, 0.3), (0.43, 0.41),
               (0.75, 0.25)),
    ),
    height=0.32, stride=0.40, period=3.0, standing=0.75, lift=0.10, droop=0.3, bob=0.0,
    foot=(0.04, 0.10), sole=0.03,
)  # fmt: skip


def crawl(
    body: Body,
    seconds: float,
    fps: float = 30.0,
    seed: int = 0,
    *,
    start: float = 0.0,
    turn: float = 0.09,
    jitter: float = 0.015,
) -> Clip:
    """The body's way over the floor y = 0, along +z, with its contact labels.

    A limb is labelled as standing while its ball is placed; its foot then lies flat and does not
    move.

    Args:
        body: what goes.
        seconds: length of the clip.
        fps: frames per second.
        seed: of the differences between steps.
        start: m, where on the way the body begins.
        turn: rad, how far the path turns away from +z to either side, about.
        jitter: m, standard deviation of footholds, along the way and across.

    Raises:
        ValueError: for a length or a rate that is not above 0; a limb that does not reach its
            foothold.
    """
    if not (seconds > 0 and fps > 0):
        raise ValueError(f"wanted seconds and fps above 0, got {seconds} s at {fps} fps")
    phase = np.arange(round(seconds * fps)) / (fps * body.period)
    rng = np.random.default_rng(seed)
    path = Path(turn, rng.uniform(0.0, 2.0 * np.pi))
    along = start + body.stride * phase
    height = body.height + body.bob * np.cos(4.0 * np.pi * phase)
    middle, yaw = path.at(along, 0.0, height), path.yaw(along)
    heading = Rotation.from_rotvec(yaw[:, None] * UP)
    joints, parents = ["trunk"], [-1]
    positions, turns, stance = [middle], [heading.as_quat(scalar_first=True)], []
    for limb in body.limbs:
        hip = middle + heading.apply(np.array(limb.root) - [0.0, body.height, 0.0])
        ankle, ball, rot, stands = _foot(body, limb, path, start, phase, jitter, rng)
        if np.linalg.norm(ankle - hip, axis=-1).max() > 0.995 * sum(limb.bones):
            raise ValueError(f"the {limb.name} limb of the {body.name} does not reach its foothold")
        hinge = unit(np.cross(ankle - hip, heading.apply(limb.pole)))
        knee = bent_knee(hip, ankle, hinge, *limb.bones)
        joints += [f"{limb.name}_{part}" for part in PARTS]
        parents += [0, len(joints) - 4, len(joints) - 3, len(joints) - 2]
        positions += [hip, knee, ankle, ball]
        turns += [*leg_rotations(hip, knee, ankle, hinge), rot, rot]
        stance.append(stands)
    roles = {f"{part}_{limb.name}": f"{limb.name}_{part}" for limb in body.limbs for part in PARTS}
    return clip_from_joints(
        tuple(joints),
        tuple(parents),
        np.stack(positions, axis=1),
        np.stack(turns, axis=1),
        float(fps),
        f"{body.name} seed {seed}",
        np.stack(stance, axis=-1),
        {"pelvis": "trunk"} | roles,
    )


def climb(seconds: float = 6.0, fps: float = 30.0, seed: int = 0, *, start: float = 1.3) -> Clip:
    """A climber on the wall z = 0, whose normal is `terrain_meshes.WALL_UP`; straight up from `start`, m.

    Pass that normal as `up_ws` to whatever asks where the character's root is.

    Raises:
        ValueError: as `crawl`.
    """
    flat = crawl(CLIMBER, seconds, fps, seed, start=start, turn=0.0)
    upright = terrain_meshes.WALL_FROM_FLOOR
    turned = upright * Rotation.from_quat(flat.rotations_ws.reshape(-1, 4), scalar_first=True)
    rotations = turned.as_quat(scalar_first=True).reshape(flat.rotations_ws.shape)
    return flat.with_motion(flat.positions_ws @ upright.as_matrix().T, rotations)


def _foot(
    body: Body,
    limb: Limb,
    path: Path,
    start: float,
    phase: Float64[np.ndarray, " frames"],
    jitter: float,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Ankle and ball, m, rotation and contact label of a limb's foot over the frames."""
    own = phase - limb.late
    step = np.floor(own).astype(int)  # a stance begins with each whole number
    share = np.clip((own - step - body.standing) / (1.0 - body.standing), 0.0, 1.0)
    swing = np.sin(np.pi * share) ** 2
    steps = np.arange(-1, step[-1] + 2)
    middles = start + body.stride * (steps + limb.late + 0.5 * body.standing) + limb.home[1]
    middles = middles + jitter * rng.normal(size=len(steps))
    aside = limb.home[0] + jitter * rng.normal(size=len(steps))
    places = path.at(middles, aside, np.full(len(steps), body.sole))
    yaws = path.yaw(middles)

    ease = smoothstep(share)
    here, there = step + 1, step + 2
    ball = places[here] + ease[:, None] * (places[there] - places[here])
    ball[:, 1] += body.lift * swing
    yaw = yaws[here] + ease * (yaws[there] - yaws[here])
    turned = Rotation.from_rotvec(yaw[:, None] * UP)
    tilted = Rotation.from_rotvec((body.droop * swing)[:, None] * [1.0, 0.0, 0.0])
    rot = turned * tilted
    down, ahead = body.foot
    ankle = ball - rot.apply([0.0, -down, ahead])
    return ankle, ball, rot.as_quat(scalar_first=True), share == 0.0
