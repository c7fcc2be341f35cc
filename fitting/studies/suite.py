"""Runs systems through made situations, and measures what comes out against its bounds.

The bounds of `fitting.motion.measures` say what a viewer notices, and what the animation and the
ground ask of any motion that puts the feet on the ground; none was chosen by what a system reaches.

The grounds are functions of the place, sampled on one grid, so that one compiled program runs a
system on any of them. Along the path it is so fine that a riser of stairs is one centimetre deep.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float64

import jaxik
from fitting.clips.assemble import JointMotion, clip_from_joints
from fitting.clips.clip import Clip
from fitting.ground.ground_path import place_root
from fitting.motion.measures import BOUNDED, Bounded
from fitting.runtime import activity
from fitting.synthetic import actions, walker
from fitting.synthetic.footsteps import smoothstep
from jaxik.world.terrain import Terrain, heightfield

from .animations import Animation
from .comparison import Comparison, compare

SPACING = 0.05, 0.01  # m, across the path and along it
HALF_WIDTH, BEHIND, AHEAD = 2.0, 3.0, 17.0  # m, around the origin
GRADE = np.tan(np.radians(15.0))
HILL_HEIGHT, HILL_LENGTH = 2.0, 7.0  # m; its steepest part has 24 degrees
RISE, TREAD, STEPS = 0.15, 0.30, 8  # m, m and count, of stairs
CURB, KERBSIDE = 0.15, 2.0  # m, height and width of a traffic island
RUBBLE, RUBBLE_CELL = 0.06, 0.4  # m, height over and under the floor, and spacing of its corners
BLOCK = 0.12  # m, under one foot
PLATEAU = 0.5  # m

HeightAt: TypeAlias = Callable[[np.ndarray, np.ndarray], np.ndarray | float]
"""Height of the ground, m, at x (to the left) and z (ahead), m."""


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


SystemsOf: TypeAlias = Callable[[jaxik.Rig], Mapping[str, jaxik.FootIK]]
"""Makes systems for the body of a rig, by name."""


def sampled(height: HeightAt) -> Terrain:
    """The ground of a function as a heightfield, in JAX's default precision."""
    x = np.arange(-HALF_WIDTH, HALF_WIDTH + SPACING[0] / 2, SPACING[0])
    z = np.arange(-BEHIND, AHEAD + SPACING[1] / 2, SPACING[1])
    heights = np.broadcast_to(height(x, z[:, None]), (len(z), len(x)))
    return heightfield(heights, SPACING, origin=(-HALF_WIDTH, 0.0, -BEHIND))


def flat(x: np.ndarray, z: np.ndarray) -> float:
    """A level floor."""
    return 0.0


def hill(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """A rise of 2 m, as smooth as a cosine."""
    return HILL_HEIGHT * 0.5 * (1.0 - np.cos(np.pi * np.clip(z / HILL_LENGTH, 0.0, 1.0)))


def stairs_up(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Eight steps up, from 1 m ahead."""
    return RISE * np.clip(np.floor((z - 1.0) / TREAD) + 1.0, 0.0, STEPS)


def stairs_down(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Eight steps down, from 1 m ahead."""
    return -stairs_up(x, z)


def slope_along(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """A slope up the path."""
    return GRADE * z


def slope_across(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """A slope up to the left."""
    return GRADE * x


def rubble(x: np.ndarray, z: np.ndarray) -> Float64[np.ndarray, "rows columns"]:
    """Corners at random heights, with straight lines between them."""
    rows, columns = np.floor(z / RUBBLE_CELL), np.floor(x / RUBBLE_CELL)
    along, across = z / RUBBLE_CELL - rows, x / RUBBLE_CELL - columns
    corners = np.random.default_rng(3).uniform(-RUBBLE, RUBBLE, (64, 16))

    def corner(row: int, column: int) -> np.ndarray:
        return corners[(rows + row).astype(int) + 8, (columns + column).astype(int) + 8]

    near = corner(0, 0) + across * (corner(0, 1) - corner(0, 0))
    far = corner(1, 0) + across * (corner(1, 1) - corner(1, 0))
    return near + along * (far - near)


def curb(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """A traffic island: up a curb 1 m ahead, and down again after 2 m."""
    return CURB * ((z >= 1.0) & (z < 1.0 + KERBSIDE))


def block(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """A block under the left foot."""
    return BLOCK * (x > 0.0)


def plateau(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """A plateau of half a metre, which begins 8 m ahead."""
    return PLATEAU * smoothstep((z - 4.0) / 4.0)


@dataclass(frozen=True)
class Situation:
    """An animation on a ground."""

    name: str
    animate: Animate
    height: HeightAt
    quick: bool = False
    """Whether it belongs to the short form of the suite."""
    vehicle: Vehicle | None = None
    """What carries ground and character."""

    def animation(self, seconds: float) -> Animation:
        """The animation, with its root where the commands put it."""
        terrain = sampled(self.height)
        clip, root = place_root(self.animate(seconds), terrain)
        times = np.arange(clip.frame_count) / clip.fps
        carried = None if self.vehicle is None else self.vehicle(times)
        return Animation(clip, terrain, root=root, carried=carried, is_made=True)


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
    Situation("flat walk", walk, flat, quick=True),
    Situation("flat run", actions.run, flat, quick=True),
    Situation("hill", walk, hill, quick=True),
    Situation("stairs up", walk, stairs_up, quick=True),
    Situation("stairs down", walk, stairs_down),
    Situation("slope along", walk, slope_along),
    Situation("slope across", walk, slope_across, quick=True),
    Situation("rubble", walk, rubble, quick=True),
    Situation("curb", walk, curb),
    Situation("elevator", actions.turn, flat, vehicle=elevator),
    Situation("train", walk, flat, vehicle=train),
    Situation("jump", actions.jump, rubble, quick=True),
    Situation("crouch", actions.crouch, block, quick=True),
    Situation("turn in place", actions.turn, slope_along),
    Situation("giant", walk_of(GIANT), rubble),
    Situation("child", walk_of(CHILD), rubble),
    Situation("teleport", teleport, plateau),
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


@dataclass(frozen=True)
class Scene:
    """A situation, and what the systems made of it."""

    situation: Situation
    comparison: Comparison

    @property
    def systems(self) -> tuple[str, ...]:
        """Names, in their order."""
        return (*self.comparison.systems, *self.comparison.failures)

    def beyond(self, system: str) -> list[Bounded]:
        """What is beyond its bound, the worst first; of a system that gave a motion."""
        return [bounded for bounded in self.comparison.against(system) if bounded.is_beyond]

    def count(self, system: str) -> int:
        """How many measures of a system are beyond their bounds; all, if it gave no motion."""
        failed = system in self.comparison.failures
        return len(BOUNDED) if failed else len(self.beyond(system))


@dataclass(frozen=True)
class Suite:
    """All scenes that are finished, in order."""

    plan: Plan
    systems: tuple[str, ...]
    """Names, in their order; none before the first scene is finished."""
    scenes: tuple[Scene, ...]
    interrupted: bool = False

    @property
    def counts(self) -> tuple[int, int]:
        """How many measures are within their bounds, and how many there are."""
        count = len(BOUNDED) * len(self.systems) * len(self.scenes)
        beyond = sum(scene.count(system) for scene in self.scenes for system in self.systems)
        return count - beyond, count


def run_suite(systems_of: SystemsOf, plan: Plan) -> Suite:
    """Runs systems through the situations of a plan.

    KeyboardInterrupt (Ctrl-C) ends the suite; the finished situations are returned with
    `interrupted` set. A system that gives no motion is noted, and the others go on.

    Args:
        systems_of: makes the systems for a body.
        plan: which situations, and how long they are.
    """
    names: tuple[str, ...] = ()
    scenes: list[Scene] = []
    interrupted = False
    try:
        total = len(plan.situations)
        with activity.announced(f"Running {total} situations", total) as running:
            for situation in plan.situations:
                with running.part(situation.name):
                    animation = situation.animation(plan.seconds)
                    systems = systems_of(animation.clip.rig)
                    names = tuple(systems)
                    compared = compare(systems, animation, title=situation.name, keep_going=True)
                    scenes.append(Scene(situation, compared))
    except KeyboardInterrupt:
        interrupted = True
    return Suite(plan, names if scenes else (), tuple(scenes), interrupted)
