"""Runs systems through situations, and measures what comes out against its bounds.

How good is good enough: one bound for each measure, with its reason.

None of them was chosen by what a system reaches. They say what a viewer notices, and what the
animation and the ground ask of any motion that puts the feet on the ground.

Grounds of the suite: functions of the place, sampled on one grid.

All have the same grid, so that one compiled program runs a system on any of them. Along the path it
is so fine that a riser of stairs is one centimetre deep.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float64

import jaxik
from fitting.clips import contacts
from fitting.clips.assemble import JointMotion, clip_from_joints
from fitting.clips.clip import Clip
from fitting.ground.ground_path import place_root
from fitting.motion import measures
from fitting.motion.measures import (
    SHARE_LIMIT,
    SLIDE_LIMIT,
    VISIBLE,
    Cause,
    Extreme,
    Placement,
    Soles,
)
from fitting.runtime import activity
from fitting.synthetic import actions, walker
from fitting.synthetic.footsteps import smoothstep
from jaxik.world.terrain import Terrain, heightfield

from .animations import Animation

FLAT_SLIDE = 0.002  # m
POP = 0.01  # m in 1/60 s
SWING_PEAK = 1.875  # speed of a path of minimum jerk at its middle, over its mean speed
WALK_JERK = 80.0  # m/s³, of the pelvis in our walk over a flat floor
MISSED = 0.05  # of the targets of standing feet

REASONS = {
    "penetration": f"in at most {SHARE_LIMIT:.0%} of the frames may a sole be {100 * VISIBLE:.0f} "
    "cm or more in the ground, which a viewer notices",
    "float": f"in at most {SHARE_LIMIT:.0%} of its frames may a standing sole be "
    f"{100 * VISIBLE:.0f} cm or more above the ground",
    "slide": f"in a stance a foot may slide {1000 * FLAT_SLIDE:.0f} mm further than animated on a "
    f"level floor, where nothing has to move it, and {100 * SLIDE_LIMIT:.0f} cm elsewhere",
    "pop": f"in 1/60 s a foot's correction may change by {100 * POP:.0f} cm, beyond what a smooth "
    "swing from one foothold to the next needs on this ground",
    "jerk": f"the pelvis may have the animation's jerk and {WALK_JERK:.0f} m/s³ more, as much as a "
    "walk over a level floor has itself",
    "reach": f"at most {MISSED:.0%} of the targets of standing feet may be missed, by 5 mm or more",
}
"""What each bound is and why, by measure."""

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


@dataclass(frozen=True)
class Cell:
    """One measure of one motion, and its bound."""

    value: float
    """In SI units or fractions of 1; NaN where there is nothing to measure."""
    bound: float
    """Largest value that is good enough; of `reach`, the smallest."""
    worst: Extreme | None = None
    """Where the motion is worst, for measures that know."""
    is_least: bool = False
    """Whether the bound is the smallest value."""

    @property
    def is_within(self) -> bool:
        """Whether the value is good enough; true where there is nothing to measure."""
        if math.isnan(self.value):
            return True
        return self.value >= self.bound if self.is_least else self.value <= self.bound


def cells(
    placed: Placement, jerk: float, reached: float, bounds: Mapping[str, float]
) -> dict[str, Cell]:
    """The cells of a motion, by measure.

    Args:
        placed: how its feet are placed.
        jerk: of the height of its pelvis, m/s³.
        reached: fraction of the targets of its standing feet.
        bounds: of its situation; see `bounds_of`.
    """
    return {
        "penetration": Cell(placed.sunk_frames, bounds["penetration"], placed.deepest),
        "float": Cell(placed.floating, bounds["float"], placed.highest),
        "slide": Cell(placed.slide, bounds["slide"], placed.largest_slide),
        "pop": Cell(placed.pop.value, bounds["pop"], placed.pop),
        "jerk": Cell(jerk, bounds["jerk"]),
        "reach": Cell(reached, bounds["reach"], is_least=True),
    }


def bounds_of(animation: Animation, *, is_flat: bool) -> dict[str, float]:
    """The bounds of a situation, by measure, in SI units and fractions of 1.

    They depend on the animation and the ground alone, so that every system has the same.
    """
    return {
        "penetration": SHARE_LIMIT,
        "float": SHARE_LIMIT,
        "slide": FLAT_SLIDE if is_flat else SLIDE_LIMIT,
        "pop": POP + swing_speed(animation) * measures.TICK,
        "jerk": pelvis_jerk(animation.placed_clip) + WALK_JERK,
        "reach": 1.0 - MISSED,
    }


def pelvis_jerk(clip: Clip) -> float:
    """Jerk of the height of a clip's pelvis, m/s³."""
    return measures.jerk(clip.positions_ws[:, clip.rig.pelvis, 1], clip.fps, clip.cuts)


def swing_speed(animation: Animation) -> float:
    """How fast corrections must change, m/s, for swings between footholds on the ground.

    A standing ball needs a correction of as much as it is in the ground. Between two stances that
    changes along a path of minimum jerk, whose fastest moment counts; of all swings, the largest.
    """
    clip = animation.placed_clip
    needed = -measures.soles(clip, animation.clip, animation.terrain, animation.floor).height
    stance, fastest = clip.stance_labels(), 0.0
    for leg in range(stance.shape[1]):
        runs = contacts.runs(stance[:, leg])
        for (_, last), (first, _) in zip(runs, runs[1:], strict=False):
            change = abs(needed[first, leg, 1] - needed[last, leg, 1])
            if not np.isnan(change):
                fastest = max(fastest, float(SWING_PEAK * change * clip.fps / (first - last)))
    return fastest


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

    @property
    def is_flat(self) -> bool:
        """Whether the ground is a level floor, on which nothing needs a correction."""
        return self.height is flat

    def animation(self, seconds: float) -> Animation:
        """The animation, with its root where the commands put it."""
        terrain = sampled(self.height)
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
class Outcome:
    """What a system made of a situation."""

    clip: Clip
    """The solved motion."""
    soles: Soles
    placement: Placement
    cause: Cause | None
    """Why feet are off their ground; None where they are not."""
    cells: Mapping[str, Cell]
    """By measure."""


@dataclass(frozen=True)
class Scene:
    """A situation, what it asks, and what the systems made of it."""

    situation: Situation
    animation: Animation
    systems: tuple[str, ...]
    """Names, in their order."""
    bounds: Mapping[str, float]
    """By measure."""
    outcomes: dict[str, Outcome] = field(default_factory=dict)
    """By system."""
    failures: dict[str, str] = field(default_factory=dict)
    """What went wrong, of systems that gave no motion."""


@dataclass(frozen=True)
class Suite:
    """All scenes that are finished, in order."""

    plan: Plan
    scenes: tuple[Scene, ...]
    interrupted: bool = False

    @property
    def systems(self) -> tuple[str, ...]:
        """Names of the systems, in their order; none before the first scene is finished."""
        return self.scenes[0].systems if self.scenes else ()

    @property
    def counts(self) -> tuple[int, int]:
        """How many cells are within their bounds, and how many there are."""
        outcomes = [outcome for scene in self.scenes for outcome in scene.outcomes.values()]
        every = [cell for outcome in outcomes for cell in outcome.cells.values()]
        failed = sum(len(scene.failures) * len(scene.bounds) for scene in self.scenes)
        return sum(bool(cell.is_within) for cell in every), len(every) + failed


def run_suite(systems_of: SystemsOf, plan: Plan) -> Suite:
    """Runs systems through the situations of a plan.

    KeyboardInterrupt (Ctrl-C) ends the suite; the finished situations are returned with
    `interrupted` set. A system that gives no motion is noted, and the others go on.

    Args:
        systems_of: makes the systems for a body.
        plan: which situations, and how long they are.
    """
    scenes: list[Scene] = []
    try:
        total = len(plan.situations)
        with activity.announced(f"Running {total} situations", total) as running:
            for situation in plan.situations:
                with running.part(situation.name):
                    scenes.append(_run(situation, systems_of, plan.seconds))
    except KeyboardInterrupt:
        return Suite(plan, tuple(scenes), interrupted=True)
    return Suite(plan, tuple(scenes))


def _run(situation: Situation, systems_of: SystemsOf, seconds: float) -> Scene:
    animation = situation.animation(seconds)
    systems = systems_of(animation.clip.rig)
    bounds = bounds_of(animation, is_flat=situation.is_flat)
    scene = Scene(situation, animation, tuple(systems), bounds)
    for name, ik in systems.items():
        try:
            scene.outcomes[name] = _outcome(animation, ik, bounds)
        except ValueError as error:
            scene.failures[name] = str(error)
    return scene


def _outcome(animation: Animation, ik: jaxik.FootIK, bounds: Mapping[str, float]) -> Outcome:
    animation.check_shapes(ik)
    result, solved = animation.solve(ik)
    placed, cause = animation.assess(solved)
    soles = measures.soles(solved, animation.clip, animation.terrain, animation.floor)
    reached = animation.reached(result)[animation.clip.stance_labels()]
    share = float(np.nanmean(reached)) if not np.isnan(reached).all() else float("nan")
    measured = cells(placed, pelvis_jerk(solved), share, bounds)
    return Outcome(solved, soles, placed, cause, measured)
