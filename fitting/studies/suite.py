"""Runs systems through made situations, and measures their motions against bounds.

The bounds of `fitting.motion.measures` say what a viewer notices, and what the animation and the
ground ask of any motion that puts the feet on the ground; none was chosen by what a system reaches.

The grounds are functions of the place, sampled on one grid, so that one compiled program runs a
system on any of them. Along the path it is so fine that a riser of stairs is one centimetre deep.
"""

import textwrap
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float64
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

import jaxik
from fitting.clips.assemble import JointMotion, clip_from_joints
from fitting.clips.clip import Clip
from fitting.ground import ground_path
from fitting.ground.ground_path import place_root
from fitting.motion.measures import BOUNDED, MEASURES, VISIBLE, Bounded, PlacedMotion
from fitting.report import style
from fitting.report.document import (
    Document,
    Finding,
    Grid,
    Plot,
    Points,
    Section,
    Terms,
    Text,
    View,
)
from fitting.report.formatting import Table, listed, meanings
from fitting.report.style import BEFORE, STAGES
from fitting.runtime import activity
from fitting.runtime.precision import in_float64
from fitting.synthetic import actions, footsteps, walker
from fitting.synthetic.footsteps import smoothstep
from jaxik.world.terrain import Terrain, combine, heightfield

from . import comparison
from .animations import Animation
from .comparison import ANIMATED, BOUND, MARKED, MISS, Comparison, run_systems
from .output import output_folder, publish

SPACING = 0.05, 0.01  # m, across the path and along it
HALF_WIDTH, BEHIND, AHEAD = 2.0, 3.0, 17.0  # m, around the origin
GRADE = np.tan(np.radians(15.0))
HILL_HEIGHT, HILL_LENGTH = 2.0, 7.0  # m; its steepest part has 24 degrees
RISE, TREAD, STEPS = 0.15, 0.30, 8  # m, m and count, of stairs
CURB, KERBSIDE = 0.15, 2.0  # m, height and width of a traffic island
RUBBLE, RUBBLE_CELL = 0.06, 0.4  # m, height over and under the floor, and spacing of its corners
FLIGHTS, FLIGHT, LEAN = (1.0, 3.05, 5.2), 4, 0.02  # m along the path, steps, and m of each riser
BLOCK, DIP = 0.12, 0.20  # m, under one foot
LEDGE = 0.15  # m, to the ground under the toes
TOES = actions.BALL_AHEAD + 0.02  # m along the path, from which there is nothing under them
PLANKS, PLANK = 8, 0.015  # in a stride, and m along the path, where a gap begins below an ankle
GAP, HOLLOW = 0.03, 0.30  # m, between planks and below them
STOREY = 0.34  # m; a root is moved for a floor that is much higher
PLATEAU = 0.5  # m

HeightAt: TypeAlias = Callable[[np.ndarray, np.ndarray], np.ndarray | float]
"""Height of the ground, m, at x (to the left) and z (ahead), m."""


FPS = 60.0
LONG, SHORT = 5.0, 3.0  # s
STRAIGHT = walker.WalkStyle(bend=0.0, knees=1.0)
ADULT, CHILD, GIANT = 1.8, 1.1, 3.0  # m, tall
LEAP = 8.0  # m, of a teleport
LIFT = 6.0  # m, of an elevator
YAW, PUSH = np.radians(45.0), 0.2  # rad/s and m/s, of an idle whose body does not step
TRAIN_SPEED, BRAKING = 20.0, 2.0  # m/s and s

Animate = Callable[[float], Clip]
"""Makes a clip of a length, s."""
Vehicle = Callable[[np.ndarray], np.ndarray]
"""How far a vehicle has moved, m, (frames, 3), at times, s."""


SystemsOf: TypeAlias = Callable[[jaxik.Rig], Mapping[str, jaxik.FootIK]]
"""Makes systems for the body of a rig, by name."""

TABLE, NUMBERS, PAGE = "suite.md", "suite.json", "suite.png"

RED = "#CC0000"
OFF = f"sole off its ground by {100 * VISIBLE:.0f} cm"
SOLES = STAGES[0], STAGES[1]
NARROWEST = 1.5  # m along the path
PANEL = 2.6, 1.45  # inches
ENTRY = 2.3, 0.32  # inches, an entry of the legend
ENTRIES = 6
MARGIN = 0.3  # m, around what is shown
JUMP = 1.0  # m in a frame, from which a line is interrupted
HEAD = 0.5, 1.45  # place of a column's heading, in heights of a panel
SAMPLES = 600  # of the ground
TITLE = 42  # characters over a panel, in a line


def sampled(height: HeightAt) -> Terrain:
    """The ground of a function as a heightfield, in JAX's default precision."""
    x = np.arange(-HALF_WIDTH, HALF_WIDTH + SPACING[0] / 2, SPACING[0])
    z = np.arange(-BEHIND, AHEAD + SPACING[1] / 2, SPACING[1])
    heights = np.broadcast_to(height(x, z[:, None]), (len(z), len(x)))
    return heightfield(heights, SPACING, origin=(-HALF_WIDTH, 0.0, -BEHIND))


class Cover(NamedTuple):
    """A level surface over the ground: a ceiling, or the seat of a bench."""

    height: float
    """Metres."""
    begin: float
    """m along the path."""
    end: float
    """m along the path."""
    aside: float = 0.0
    """m, of its middle from the path."""

    def terrain(self) -> Terrain:
        """It alone, in JAX's default precision."""
        size = 2.0 * HALF_WIDTH, self.end - self.begin
        corner = self.aside - HALF_WIDTH, self.height, self.begin
        return heightfield(np.zeros((2, 2)), size, origin=corner)


CEILING = Cover(2.4, 1.0, AHEAD)
SEAT = Cover(0.45, -0.65, -0.20)
NO_COVER = Cover(0.0, 0.0, 1.0, aside=1e3)  # far away, so that all grounds have one structure


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


def leaning_stairs_up(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Three flights, each met at another place of a stride, whose risers lean by 2 cm."""
    edges = [start + TREAD * step for start in FLIGHTS for step in range(FLIGHT)]
    return RISE * np.sum([np.clip((z - edge) / LEAN, 0.0, 1.0) for edge in edges], axis=0)


def leaning_stairs_down(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """The same down."""
    return -leaning_stairs_up(x, z)


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


def dip(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """A dip under the right foot."""
    return -DIP * (x < 0.0)


def ledge(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """A ledge over which the toes of an idle stand."""
    return -LEDGE * (z > TOES)


def planks(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Planks with gaps over a hollow; a walk without variation has its balls between two gaps."""
    pitch = footsteps.STRIDE / PLANKS
    return -HOLLOW * (np.mod(z - PLANK, pitch) < GAP)


def higher_floor(x: np.ndarray, z: np.ndarray) -> float:
    """A level floor higher than that of the animation, but still left to foot IK."""
    return STOREY


def plateau(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """A plateau of half a metre, which begins 8 m ahead."""
    return PLATEAU * smoothstep((z - 4.0) / 4.0)


@dataclass(frozen=True)
class Situation:
    """An animation on a ground."""

    name: str
    animate: Animate
    height: HeightAt
    cover: Cover = NO_COVER
    quick: bool = False
    """Whether it belongs to the short form of the suite."""
    vehicle: Vehicle | None = None
    """A vehicle that carries ground and character."""

    def animation(self, seconds: float) -> Animation:
        """The animation, with its root where the commands put it."""
        terrain = combine(sampled(self.height), self.cover.terrain())
        clip, root = place_root(self.animate(seconds), terrain)
        times = np.arange(clip.frame_count) / clip.fps
        carried = None if self.vehicle is None else self.vehicle(times)
        return Animation(clip, terrain, root=root, carried=carried, is_synthetic=True)


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


def plank_walk(seconds: float) -> Clip:
    """A walk whose steps are all alike."""
    return walker.walk(seconds, FPS, style=walker.WalkStyle(bend=0.0, variation=0.0, knees=1.0))


def carried_idle(seconds: float) -> Clip:
    """An idle that turns, and then is pushed ahead, without a step."""
    clip = actions.idle(seconds, FPS)
    time = np.arange(clip.frame_count) / FPS
    yaw = YAW * np.minimum(time, seconds / 2)
    turn = Rotation.from_rotvec(yaw[:, None] * [0.0, 1.0, 0.0])
    pushed = PUSH * np.maximum(time - seconds / 2, 0.0)
    positions, rotations = clip.positions_ws.copy(), clip.rotations_ws.copy()
    for joint in range(len(clip.joint_names)):
        turned = turn * Rotation.from_quat(rotations[:, joint], scalar_first=True)
        positions[:, joint] = turn.apply(positions[:, joint]) + pushed[:, None] * [0.0, 0.0, 1.0]
        rotations[:, joint] = turned.as_quat(scalar_first=True)
    return replace(clip.with_motion(positions, rotations), source="carried idle")


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
    Situation("leaning stairs up", walk, leaning_stairs_up),
    Situation("leaning stairs down", walk, leaning_stairs_down, quick=True),
    Situation("slope along", walk, slope_along),
    Situation("slope across", walk, slope_across, quick=True),
    Situation("rubble", walk, rubble, quick=True),
    Situation("curb", walk, curb),
    Situation("planks", plank_walk, planks, quick=True),
    Situation("room", walk, flat, cover=CEILING),
    Situation("higher floor", walk, higher_floor),
    Situation("elevator", actions.turn, flat, vehicle=elevator),
    Situation("train", walk, flat, vehicle=train),
    Situation("jump", actions.jump, rubble, quick=True),
    Situation("crouch", actions.crouch, block, quick=True),
    Situation("squat on a block", actions.squat, block),
    Situation("squat on a slope", actions.squat, slope_along),
    Situation("bench", actions.sit, flat, cover=SEAT),
    Situation("carried idle", carried_idle, flat),
    Situation("dip", actions.idle, dip),
    Situation("ledge", actions.idle, ledge),
    Situation("turn in place", actions.turn, slope_along),
    Situation("giant", walk_of(GIANT), rubble),
    Situation("child", walk_of(CHILD), rubble),
    Situation("teleport", teleport, plateau),
)


class Limitation(NamedTuple):
    """What a preset cannot do with its defaults, and why."""

    preset: str
    situations: str
    """Names, separated by commas."""
    measures: str
    """Names, separated by spaces."""
    reason: str

    def covers(self, system: str, situation: str, measure: str) -> bool:
        """Whether it is about this measure of this system in this situation."""
        return (
            system == self.preset
            and situation in self.situations.split(", ")
            and measure in self.measures.split()
        )


STAIRS = "stairs up, stairs down, leaning stairs up, leaning stairs down"
SLOPES = "hill, slope along"
WALKS = f"{STAIRS}, {SLOPES}, slope across, rubble, curb, turn in place, giant, child"
LIMITATIONS = (
    Limitation(
        "record", f"{STAIRS}, curb", "penetration contact pop pelvis_jerk reached",
        "its original casts one ray under each foot, which meets a step once it is over it",
    ),
    Limitation(
        "record", SLOPES, "penetration contact slide pelvis_jerk reached",
        "its original lowers the body to the lowest standing foot, whatever the legs reach",
    ),
    Limitation(
        "record", "carried idle", "foot_skating",
        "its original locks feet with which nobody steps; they go back once they are let go",
    ),
    Limitation(
        "ozz", f"{WALKS}, flat walk, flat run, planks, room, higher floor, elevator, train, jump, "
        "teleport", "slide foot_skating pop pelvis_jerk",
        "its original lays all soles flat on the ground, at once and without memory",
    ),
    Limitation(
        "ozz", "stairs up, leaning stairs up, curb", "penetration contact",
        "its original has each foot on the ground below it, also in mid-swing before a step",
    ),
    Limitation(
        "unreal", f"{WALKS}, planks, jump, squat on a block, squat on a slope",
        "penetration contact pop pelvis_jerk",
        "its original works only while the character stands, and a moving pelvis is motion",
    ),
    Limitation(
        "unreal", "dip", "penetration contact",
        "the latch of its original freezes the pelvis short of its goal",
    ),
    Limitation(
        "mec", WALKS, "penetration contact pop pelvis_jerk reached",
        "its original leaves feet as animated unless they are low and slow, and the body with them",
    ),
    Limitation(
        "mec", "planks", "penetration contact slide pop pelvis_jerk reached",
        "the rays of its original fall through gaps",
    ),
    Limitation(
        "mec", "carried idle", "foot_skating",
        "its original plants feet with which nobody steps; they go back once they are let go",
    ),
)  # fmt: skip
"""What the presets miss."""


def reason_of(system: str, situation: str, measure: str) -> str | None:
    """Why a preset misses a bound in a situation; None where that is not known."""
    miss = system, situation, measure
    return next((entry.reason for entry in LIMITATIONS if entry.covers(*miss)), None)


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
    """A situation, and the motions of the systems in it."""

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


def run_situations(systems_of: SystemsOf, plan: Plan) -> Suite:
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
                    compared = run_systems(
                        systems, animation, title=situation.name, keep_going=True
                    )
                    scenes.append(Scene(situation, compared))
    except KeyboardInterrupt:
        interrupted = True
    return Suite(plan, names if scenes else (), tuple(scenes), interrupted)


def missed(suite: Suite) -> list[str]:
    """What is beyond its bound, a line each."""
    return [
        f"{scene.situation.name}, {system}: {words}"
        for scene in suite.scenes
        for system in suite.systems
        for words in misses(scene, system)
    ]


def misses(scene: Scene, system: str) -> list[str]:
    """What is beyond its bound with its reason, a phrase each, and why feet are off the ground."""
    compared = scene.comparison
    if system in compared.failures:
        return [f"no motion: {compared.failures[system]}"]
    cause = compared.causes[system]
    known = (
        []
        if cause is None or cause.kind in ("unknown", "late")
        else [f"likely cause: {cause.kind}"]
    )
    beyond = [
        words
        if (reason := reason_of(system, scene.situation.name, name)) is None
        else f"{words}: {reason}"
        for name, _, words in scene.beyond(system)
    ]
    return [*beyond, *known]


def _numbers(suite: Suite) -> dict[str, Any]:
    """The content of suite.json: SI units and fractions of 1; null for NaN."""
    within, count = suite.counts
    return {
        "seconds": suite.plan.seconds,
        "interrupted": suite.interrupted,
        "measures": count,
        "within": within,
        "situations": [comparison.numbers(scene.comparison) for scene in suite.scenes],
    }


def table(suite: Suite) -> Table:
    """The measures: for each situation a row with its bounds and a row for each system."""
    rows = [["situation", "system", *(measure.title for measure in BOUNDED.values())]]
    for scene in suite.scenes:
        of_system = {name: cells for name, *cells in _rows(scene)}
        rows.append([scene.situation.name, BOUND, *of_system[BOUND]])
        rows += [["", system, *of_system[system]] for system in suite.systems]
    return rows


def _rows(scene: Scene) -> Table:
    return comparison.rows(scene.comparison, list(BOUNDED))


@style.styled
def page(suite: Suite) -> Figure:
    """Ground, soles, ankles and pelvis of every system in every situation."""
    rows, columns = len(suite.scenes), len(suite.systems)
    width = PANEL[0] * columns + 1.0
    across = max(1, min(ENTRIES, int(width / ENTRY[0])))  # entries of the legend side by side
    height = PANEL[1] * rows + 1.0 + ENTRY[1] * -(-ENTRIES // across)
    figure = Figure(figsize=(width, height), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharex="row", sharey="row")
    for scene, row in zip(suite.scenes, panels, strict=True):
        row[0].set_ylim(_heights(scene))
        for system, axes in zip(suite.systems, row, strict=True):
            _panel(axes, scene, system)
        row[0].set_ylabel(f"{scene.situation.name}\nheight, m", fontsize=10)
    for system, axes in zip(suite.systems, panels[0], strict=True):
        axes.annotate(system, HEAD, xycoords="axes fraction", ha="center", fontsize=15)
    panels[-1, 0].set_xlabel("along the path, m", fontsize=9)
    style.legend(
        figure,
        style.ground_key("ground below the path"),
        style.line_key("left sole", SOLES[0]),
        style.line_key("right sole", SOLES[1]),
        style.line_key("ankles", BEFORE),
        style.line_key("pelvis"),
        style.line_key(OFF, RED, marker=".", linestyle=""),
        columns=across,
    )  # fmt: skip
    return figure


def _panel(axes: Axes, scene: Scene, system: str) -> None:
    axes.tick_params(labelsize=8)
    if system in scene.comparison.failures:
        _title(axes, ["no motion"])
        return
    motion = scene.comparison.motions[system]
    clip, soles, visible = motion.clip, motion.soles, motion.measures.visible
    pelvis, balls = clip.positions_ws[:, clip.rig.pelvis], clip.joints_ws(3)
    _line(axes, pelvis, color="black", linewidth=1.2)
    for leg, ankle in enumerate(np.moveaxis(clip.joints_ws(2), 1, 0)):
        _line(axes, ankle, color=BEFORE, linewidth=0.6)
        sole = balls[:, leg].copy()
        sole[:, 1] = soles.height[:, leg, 1] + soles.ground[:, leg, 1]
        _line(axes, sole, color=SOLES[leg % len(SOLES)], linewidth=1.0)
        gap = soles.gap[:, leg]
        off = (gap < -visible) | (soles.stance[:, leg] & (gap > visible))
        axes.plot(sole[off, 2], sole[off, 1], ".", color=RED, markersize=3)
    middle = (balls[..., 2].min() + balls[..., 2].max()) / 2
    reach = max(NARROWEST / 2, np.ptp(balls[..., 2]) / 2 + MARGIN)
    points = np.zeros((SAMPLES, 3))
    points[:, 2] = middle + np.linspace(-reach, reach, SAMPLES)
    axes.set_xlim(points[0, 2], points[-1, 2])
    top = clip.positions_ws[..., 1].max()  # below a ceiling
    ground = ground_path.heights_under(scene.comparison.animation.terrain, points, top)
    style.earth(axes, points[:, 2], ground)
    _title(axes, [_short(motion, bounded.name) for bounded in scene.beyond(system)])


def _short(motion: PlacedMotion, name: str) -> str:
    measure = MEASURES[name]
    return f"{measure.heading} {measure.format(getattr(motion.measures, name))}{MISS}"


def _line(axes: Axes, points: np.ndarray, **properties: Any) -> None:
    """A path from the side, interrupted where it jumps."""
    jumps = np.linalg.norm(np.diff(points, axis=0), axis=1) > JUMP
    broken = np.insert(points, np.flatnonzero(jumps) + 1, np.nan, axis=0)
    axes.plot(broken[:, 2], broken[:, 1], **properties)


def _heights(scene: Scene) -> tuple[float, float]:
    """The range of heights of a row, m."""
    motions = scene.comparison.motions
    clips = [motions[name].clip for name in scene.comparison.systems or [ANIMATED]]
    highest = max(float(clip.positions_ws[:, clip.rig.pelvis, 1].max()) for clip in clips)
    lowest = min(float(clip.joints_ws(3)[..., 1].min()) for clip in clips)
    return lowest - MARGIN, highest + MARGIN / 2


def _title(axes: Axes, missed: list[str]) -> None:
    """Says what misses its bound, in red, with a red frame."""
    whole = ", ".join(part.replace(" ", "\xa0") for part in missed)  # no part is broken
    axes.set_title(textwrap.fill(whole, TITLE), fontsize=7, color=RED)
    for spine in axes.spines.values() if missed else ():
        spine.set(visible=True, color=RED)


@in_float64
def document(suite: Suite) -> Document:
    """What a suite says."""
    within, count = suite.counts
    plots = [Plot(PAGE, "Each system in each situation, from the side", lambda: page(suite))]
    return Document(
        file=TABLE,
        kind="Foot IK systems in made situations",
        title="Suite of situations",
        verdict=f"{within} of {count} within bounds",
        good=within == count and not suite.interrupted,
        findings=findings(suite),
        sections=[
            Section(
                "All situations",
                [
                    Text(f"{MARKED} Bounds stand in the first row of a situation."),
                    Grid(table(suite), "Measures of all systems in all situations"),
                    *(plots if suite.scenes else []),
                    Terms(meanings(BOUNDED)),
                ],
            ),
            Section("Bounds", [Points(comparison.reasons(), brief=True)]),
            Section("Beyond their bounds", [Points(missed(suite) or ["Nothing."])]),
            _limits(suite),
        ],
        setup=_setup(suite),
        numbers={NUMBERS: _numbers(suite)},
        view=_view(suite) if suite.scenes else None,
    )


def findings(suite: Suite) -> list[Finding]:
    """How many measures miss their bounds and whose, where that is worst, where all is well."""
    if not suite.scenes:
        return [Finding("No situation was finished, so nothing was found.", bad=True)]
    within, count = suite.counts
    text = f"{count - within} of {count} measures are beyond their bounds"
    of_system = _counts(suite)
    worst, best = (choose(of_system, key=of_system.__getitem__) for choose in (max, min))
    if within < count and len(of_system) > 1:
        text += f", most of them of `{worst}` ({of_system[worst]}), fewest of `{best}`"
        text += f" ({of_system[best]})"
    if suite.interrupted:
        text += (
            f", and {len(suite.plan.situations) - len(suite.scenes)} situations are missing, as "
            "the suite was interrupted"
        )
    first = Finding(f"{text}.", bad=within < count or suite.interrupted)
    return [first, _hardest(suite), _easy(suite)]


def _counts(suite: Suite) -> Counter[str]:
    """How many measures of each system miss their bounds."""
    return Counter(
        {name: sum(scene.count(name) for scene in suite.scenes) for name in suite.systems}
    )


def _hardest(suite: Suite) -> Finding:
    counts = [sum(map(scene.count, suite.systems)) for scene in suite.scenes]
    most = max(counts)
    if not most:
        return Finding("No situation makes any system miss a bound.")
    scene = suite.scenes[counts.index(most)]
    count = len(suite.systems) * len(BOUNDED)
    text = f"Hardest is `{scene.situation.name}`, with {most} of {count} measures beyond bounds"
    if failures := scene.comparison.failures:
        text += f"; {listed([f'`{name}`' for name in failures])} gave no motion there"
    return Finding(f"{text}.", bad=True)


def _easy(suite: Suite) -> Finding:
    names = [
        f"`{scene.situation.name}`"
        for scene in suite.scenes
        if not any(map(scene.count, suite.systems))
    ]
    if not names:
        return Finding("In no situation are all systems within all bounds.", bad=True)
    return Finding(f"All systems are within all bounds in {listed(names)}.")


def _view(suite: Suite) -> View:
    counts = _counts(suite)
    worst = max(counts, key=counts.__getitem__)
    clips = [
        comparison.viewed_clip(scene.comparison, suite.systems, watched=worst)
        for scene in suite.scenes
    ]
    names = [scene.situation.name for scene in suite.scenes]
    return View(clips, names, f"{100 * VISIBLE:.2g} cm (of an adult)")


def _limits(suite: Suite) -> Section:
    lines = [
        "Animations and grounds are made, not captured: the suite says whether feet stand, slide "
        "and pop, not whether people would move like this.",
        "Every system has its defaults or the parameters of its file; fitted to a situation, it "
        "may do better there.",
        "On vehicles the view shows the character as the vehicle's passengers see it.",
    ]
    roots = dict.fromkeys(scene.comparison.animation.root.reason for scene in suite.scenes)
    if roots:
        lines.append(f"Roots: {'; '.join(roots)}.")
    return Section("Limits of the data", [Points(lines)])


def _setup(suite: Suite) -> Table:
    return [
        ["Systems", ", ".join(f"`{name}`" for name in suite.systems) or "none was run"],
        ["Situations", ", ".join(entry.name for entry in suite.plan.situations)],
        ["Length of each", f"{suite.plan.seconds:g} s"],
    ]


@in_float64
def run_suite(
    systems_of: SystemsOf,
    plan: Plan,
    output: str | Path | None = None,
) -> Suite:
    """Runs systems through made situations and measures each against stated bounds.

    KeyboardInterrupt (Ctrl-C) ends the suite; the finished situations are written and returned,
    with `interrupted` set.

    Args:
        systems_of: makes systems for the body of a rig, by name.
        plan: which situations; see `choose`.
        output: folder for the table, the numbers, the pictures and the page.

    Raises:
        ValueError: the folder cannot be made.
    """
    with output_folder(output) as folder:
        finished = run_situations(systems_of, plan)
        if finished.interrupted:
            activity.log("interrupted; drawing and writing the finished situations")
        publish(folder, document(finished))
        return finished
