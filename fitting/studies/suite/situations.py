"""The situations of the suite: who does what, where."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from fitting.datasets.clips.assemble import JointMotion, clip_from_joints
from fitting.datasets.clips.clip import Clip
from fitting.datasets.ground_path import place_root
from fitting.datasets.synthetic import actions, walker
from fitting.datasets.synthetic.trajectories import smoothstep
from fitting.studies.animations import Animation

from . import grounds

FPS = 60.0
LONG, SHORT = 5.0, 3.0  # s
STRAIGHT = walker.WalkStyle(bend=0.0, knees=1.0)
ADULT, CHILD, GIANT = 1.8, 1.1, 3.0  # m, tall
LEAP = 8.0  # m, of a teleport
LIFT = 6.0  # m, of an elevator
TRAIN_SPEED, BRAKING = 20.0, 2.0  # m/s and s

Animate = Callable[[float], Clip]
"""Makes a clip of a length, s."""
Vehicle = Callable[[np.ndarray], np.ndarray]
"""How far a vehicle has moved, m, (frames, 3), at times, s."""


@dataclass(frozen=True)
class Situation:
    """An animation on a ground."""

    name: str
    animate: Animate
    height: grounds.HeightAt
    quick: bool = False
    """Whether it belongs to the short form of the suite."""
    vehicle: Vehicle | None = None
    """What carries ground and character."""

    @property
    def is_flat(self) -> bool:
        """Whether the ground is a level floor, on which nothing needs a correction."""
        return self.height is grounds.flat

    def animation(self, seconds: float) -> Animation:
        """The animation, with its root where the commands put it."""
        terrain = grounds.sampled(self.height)
        clip, root = place_root(self.animate(seconds), terrain)
        times = np.arange(clip.frame_count) / clip.fps
        carried = None if self.vehicle is None else self.vehicle(times)
        return Animation(clip, terrain, root=root, carried=carried)


class Plan(NamedTuple):
    """What a suite runs."""

    situations: tuple[Situation, ...]
    seconds: float
    """Length of each animation."""


def walk(seconds: float) -> Clip:
    """A straight walk by an adult."""
    return walker.walk(seconds, FPS, style=STRAIGHT)


def walk_of(height: float) -> Animate:
    """A walk by somebody of a height, m, who sways as a pendulum of that length does."""
    size = height / ADULT

    def animate(seconds: float) -> Clip:
        fps = FPS * np.sqrt(size)
        clip = walker.walk(round(seconds * FPS) / fps, fps, style=STRAIGHT)
        motion = JointMotion(
            clip.joint_names, clip.parents, size * clip.positions_ws, clip.rotations_ws,
            clip.stance_labels(), FPS,
        )  # fmt: skip
        return clip_from_joints(motion, f"walk, {height:g} m tall")

    return animate


def teleport(seconds: float) -> Clip:
    """A walk that continues 8 m ahead from one frame to the next."""
    clip = walk(seconds)
    positions = clip.positions_ws.copy()
    positions[clip.frame_count // 2 :, :, 2] += LEAP
    return replace(clip.with_motion(positions, clip.rotations_ws), source="teleport")


def elevator(times: np.ndarray) -> np.ndarray:
    """Up by 6 m, with a start and a stop."""
    return LIFT * smoothstep(times / times[-1])[:, None] * [0.0, 1.0, 0.0]


def train(times: np.ndarray) -> np.ndarray:
    """A ride sideways at 20 m/s, and braking over the last two seconds."""
    braking = np.maximum(times - times[-1] + BRAKING, 0.0)
    distance = TRAIN_SPEED * (times - braking**2 / (2.0 * BRAKING))
    return distance[:, None] * [1.0, 0.0, 0.0]


SITUATIONS = (
    Situation("flat walk", walk, grounds.flat, quick=True),
    Situation("flat run", actions.run, grounds.flat, quick=True),
    Situation("hill", walk, grounds.hill, quick=True),
    Situation("stairs up", walk, grounds.stairs_up, quick=True),
    Situation("stairs down", walk, grounds.stairs_down),
    Situation("slope along", walk, grounds.slope_along),
    Situation("slope across", walk, grounds.slope_across, quick=True),
    Situation("rubble", walk, grounds.rubble, quick=True),
    Situation("curb", walk, grounds.curb),
    Situation("elevator", actions.turn, grounds.flat, vehicle=elevator),
    Situation("train", walk, grounds.flat, vehicle=train),
    Situation("jump", actions.jump, grounds.rubble, quick=True),
    Situation("crouch", actions.crouch, grounds.block, quick=True),
    Situation("turn in place", actions.turn, grounds.slope_along),
    Situation("giant", walk_of(GIANT), grounds.rubble),
    Situation("child", walk_of(CHILD), grounds.rubble),
    Situation("teleport", teleport, grounds.plateau),
)


def choose(only: str | None = None, *, quick: bool = False) -> Plan:
    """The situations of a suite, in their order.

    Args:
        only: names, separated by commas; None takes all.
        quick: shorter clips and, without `only`, fewer situations.

    Raises:
        ValueError: there is no situation of that name.
    """
    seconds = SHORT if quick else LONG
    if only is None:
        return Plan(tuple(entry for entry in SITUATIONS if entry.quick or not quick), seconds)
    known = [entry.name for entry in SITUATIONS]
    names = [part.strip() for part in only.split(",")]
    for name in names:
        if name not in known:
            raise ValueError(f"--only {name!r}: no such situation; there are {', '.join(known)}")
    return Plan(tuple(entry for entry in SITUATIONS if entry.name in names), seconds)
