"""A clip before and after foot IK, and as captured: the numbers of reports and pictures."""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import jaxik
from fitting.inference.optimise import evolution
from fitting.problem.capture_system import system_and_scenes
from fitting.problem.problem import Problem
from fitting.problem.residuals import errors_by_kind, errors_of_pose, residuals_by_kind
from fitting.problem.scene import PER_LEG, Scene, animated_legs_ws, legs_ws, own_system, pelvis_ws
from fitting.problem.shared_world import groups, in_a_row, moved_out, row_of, run_scenes, split
from fitting.runtime import program_cache
from fitting.runtime.precision import in_float64, with_floats
from jaxik.maths import parameter_tree, vec
from jaxik.pipeline import Trace
from jaxik.world import frame
from jaxik.world.skeleton import Transform
from jaxik.world.terrain import cast

from .measures import knee_angle

RAY_START = 1.0  # m above a joint, where the ray to the ground under it starts
RAY_LENGTH = 3.0  # m

# In the order of a scene's residuals.
RESIDUAL_KINDS = ("ankle", "knee", "pelvis", "foot", "body", "contact", "smooth")

Series: TypeAlias = Array | np.ndarray  # NumPy in a finished playback


NUDGE = 0.1  # fraction of its range by which a threshold is moved to see what changes
Poses: TypeAlias = tuple[Array, ...]  # of body and legs, (frames, ...) each
ROUNDING = 1e-7  # m, and in quaternions: smaller changes of a pose are rounding


class Motion(eqx.Module):
    """Positions of pelvis and leg joints; world space, m."""

    pelvis: Float[Series, "frames 3"]
    hip: Float[Series, "frames legs 3"]
    knee: Float[Series, "frames legs 3"]
    ankle: Float[Series, "frames legs 3"]
    toe: Float[Series, "frames legs 3"]

    @property
    def knee_angle(self) -> Float[np.ndarray, "frames legs"]:
        """Angle between thigh and shin, rad; pi for a straight leg."""
        return knee_angle(*map(np.asarray, (self.hip, self.knee, self.ankle)))


class Playback(eqx.Module):
    """One clip before and after foot IK, and as captured. Weights are 0..1."""

    before: Motion
    """The animation on its flat floor."""
    after: Motion
    captured: Motion
    up_ws: Float[Series, "3"]
    forward_ws: Float[Series, "frames 3"]
    ground_ws: Float[Series, "frames legs 3"]
    """Under the captured ankles."""
    grounded: Float[Series, "frames legs"]
    """1 where there is ground under them."""
    ball_ground_ws: Float[Series, "frames legs 3"]
    """Under the captured toe joints."""
    ball_grounded: Float[Series, "frames legs"]
    """1 where there is ground under them."""
    floor: Float[Series, " frames"]
    """m, height of the animation's floor."""
    dt: Float[Series, " frames"]
    """Seconds."""
    contact: Float[Series, "frames legs"]
    """Contact weight of the system."""
    locked: Float[Series, "frames legs"]
    """1 where the foot is locked."""
    reached: Float[Series, "frames legs"]
    """1 where the ankle is at its target."""
    stance: Float[Series, "frames legs"]
    """Captured contact labels; all 0 where there are none."""
    slide: Float[Series, " frames"]
    """Weight with which the character slides."""
    seen: Bool[Series, " frames"]
    """False in frames that the fit leaves out."""
    held_out: Bool[Series, " frames"]
    """True in frames that it leaves out to test itself."""
    present: Bool[Series, " legs"]
    """False for legs that the rig only has in name."""
    errors: Mapping[str, Float[Series, "frames_of_kind ..."]]
    """After - captured, m, rad, ..."""
    animated_errors: Mapping[str, Float[Series, "frames ..."]]
    """Before - captured, of kinds that measure something; m, rad."""
    residuals: Mapping[str, Float[Series, "frames_of_kind ..."]]
    """As the fit sees them, in sigmas."""
    sigmas: Mapping[str, Float[Series, ""]]
    label: str = eqx.field(static=True)
    """The name of the captured motion in pictures."""
    left_out: Bool[Series, "frames legs"] | None = None
    """True where a leg counts for nothing; None where all legs count."""

    @cached_property
    def time(self) -> Float[np.ndarray, " frames"]:
        """Seconds since the first frame."""
        return np.cumsum(self.dt) - self.dt[0]

    @cached_property
    def travelled(self) -> Float[np.ndarray, " frames"]:
        """Forward distance travelled by the captured pelvis, m; backward steps count negatively."""
        steps = np.diff(np.asarray(self.captured.pelvis), axis=0, prepend=self.captured.pelvis[:1])
        return np.cumsum(np.sum(steps * self.forward_ws, axis=-1))

    @property
    def fitted_kinds(self) -> list[str]:
        """Kinds of residuals that the fit uses: those whose sigma is finite."""
        return [kind for kind in RESIDUAL_KINDS if np.isfinite(self.sigmas[kind])]

    def counts(self, kind: str, frames: Bool[Series, " frames"]) -> Bool[np.ndarray, "frames n"]:
        """Where errors of a kind count in some of the frames, for each leg or for the body."""
        counts = np.asarray(frames)[:, None]
        if kind in PER_LEG:
            counts = counts & np.asarray(self.present, bool)
            if self.left_out is not None:
                counts = counts & ~np.asarray(self.left_out)
        return counts

    def height(self, points_ws: Float[Series, "*b 3"]) -> Float[np.ndarray, "*b"]:
        """Heights of points along the up axis, m."""
        return np.asarray(points_ws) @ np.asarray(self.up_ws)

    def ground_height(self) -> Float[np.ndarray, "frames legs"]:
        """Height of the ground under the captured ankles, m; NaN where there is none."""
        return np.where(np.asarray(self.grounded) > 0, self.height(self.ground_ws), np.nan)

    def along(self, points_ws: Float[Series, "frames ... 3"]) -> Float[np.ndarray, "frames ..."]:
        """Positions of points along the distance travelled, m."""
        per_frame = (slice(None),) + (None,) * (points_ws.ndim - 2)
        offset = np.asarray(points_ws) - self.captured.pelvis[per_frame]
        return self.travelled[per_frame] + np.sum(offset * self.forward_ws[per_frame], axis=-1)


@in_float64
def run(ik: jaxik.FootIK, scene: Scene) -> jaxik.Result:
    """The result of a system on the scene's clip, in the scene's precision."""
    ik = own_system(with_floats(ik, scene.frames.dt.dtype), scene)
    tracks = scene.tracks or None
    return program_cache.run(ik, scene.rig, scene.terrain, scene.frames, tracks=tracks)


@in_float64
def run_all(ik: jaxik.FootIK, scenes: Sequence[Scene]) -> tuple[jaxik.Result, ...]:
    """The result of a system on each scene's clip; those that share a world share a program."""
    results: dict[int, jaxik.Result] = {}
    for numbers in groups(scenes):
        members = tuple(scenes[number] for number in numbers)
        alone = len(members) == 1  # then by the program that all other clips use, too
        of_group = (run(ik, *members),) if alone else _run_group(ik, members)
        results |= zip(numbers, of_group, strict=True)
    return tuple(results[number] for number in range(len(scenes)))


@program_cache.cached
def _run_group(ik: jaxik.FootIK, scenes: tuple[Scene, ...]) -> tuple[jaxik.Result, ...]:
    return run_scenes(with_floats(ik, scenes[0].frames.dt.dtype), scenes)


def stage_outputs(result: jaxik.Result) -> Trace:
    """The outputs of each stage, which results of `jaxik.run` always have."""
    if result.trace is None:
        raise ValueError("this result holds no trace; wanted one of jaxik.run")
    return result.trace


@in_float64
def play(scene: Scene, result: jaxik.Result) -> Playback:
    """The scene's clip with this result, as NumPy arrays."""
    return jax.tree.map(np.asarray, _play(scene, result))


def play_all(ik: jaxik.FootIK, scenes: Sequence[Scene]) -> tuple[Playback, ...]:
    """Each scene's clip with a system."""
    pairs = zip(scenes, run_all(ik, scenes), strict=True)
    return tuple(play(scene, result) for scene, result in pairs)


@program_cache.cached
def _play(scene: Scene, result: jaxik.Result) -> Playback:
    world, reference, up = scene.frames.world_from_model, scene.reference, scene.terrain.up_ws
    animated, solved = animated_legs_ws(scene), legs_ws(scene, result)
    animated_pelvis, solved_pelvis = world @ scene.pelvis, pelvis_ws(scene, result)
    # The reference has no hips and toes: their offsets from pelvis and ankles are as animated.
    hip_offset = _per_leg(animated_pelvis).inverse().apply(animated.hip.pos)
    hips = _per_leg(reference.pelvis).apply(hip_offset)
    toes = reference.ankle.apply(animated.ankle.inverse().apply(animated.toe.pos))
    under_ankle, under_ball = (
        cast(scene.terrain, joints + vec.scale(up, jnp.asarray(RAY_START)), RAY_LENGTH)
        for joints in (reference.ankle.pos, toes)
    )
    trace, errors = stage_outputs(result), errors_by_kind(scene, result)
    return Playback(
        before=Motion(animated_pelvis.pos, *_positions(animated)),
        after=Motion(solved_pelvis.pos, *_positions(solved)),
        captured=Motion(reference.pelvis.pos, hips, reference.knee_ws, reference.ankle.pos, toes),
        up_ws=up,
        forward_ws=jax.vmap(lambda root: frame.heading(root, up)[0])(world),
        ground_ws=under_ankle.point,
        grounded=under_ankle.found,
        ball_ground_ws=under_ball.point,
        ball_grounded=under_ball.found,
        floor=vec.dot(world.pos, up),
        dt=scene.frames.dt,
        contact=trace.sensed.contact.weight,
        locked=trace.advanced.hold.locked,
        reached=result.reached,
        stance=reference.contact,
        slide=scene.frames.slide,
        seen=reference.observed,
        held_out=reference.held_out,
        present=scene.rig.present,
        errors=errors,
        animated_errors=errors_of_pose(scene, animated, animated_pelvis),
        residuals=residuals_by_kind(scene, errors),
        sigmas={kind: getattr(scene.sigmas, kind) for kind in errors},
        label=reference.label,
        left_out=reference.left_out,
    )


def _per_leg(transform: Transform) -> Transform:
    return Transform(transform.pos[:, None], transform.rot[:, None])


def _positions(legs: jaxik.LegPose) -> tuple[Array, Array, Array, Array]:
    return legs.hip.pos, legs.knee.pos, legs.ankle.pos, legs.toe.pos


@dataclasses.dataclass(frozen=True)
class ClipActivity:
    """The activity of a system on one clip; fractions are of the clip's frames."""

    legs: tuple[str, ...]
    frames: int
    seconds: float
    grounded: Float[np.ndarray, " legs"]
    """Fraction with ground under the foot."""
    in_contact: Float[np.ndarray, " legs"]
    """Fraction with a contact weight above 0."""
    reached: Float[np.ndarray, " legs"]
    """Fraction with the ankle at its target."""
    locked: Float[np.ndarray, " legs"]
    """Fraction."""
    locks: tuple[int, ...]
    """How often each foot locks."""
    releases: tuple[int, ...]
    limits: dict[str, float]
    """Fraction in which a limit changes the pose, by parameter name."""


def measure_activity(
    ik: jaxik.FootIK, scenes: Sequence[Scene], results: Sequence[jaxik.Result]
) -> list[ClipActivity]:
    """The activity of a system on the clip of each scene, from its results on them."""
    limits = active_limits(ik, scenes, results)
    return [_activity(*clip) for clip in zip(scenes, results, limits, strict=True)]


def _activity(scene: Scene, result: jaxik.Result, limits: dict[str, float]) -> ClipActivity:
    trace, present = stage_outputs(result), np.asarray(scene.rig.present)
    locked = np.asarray(trace.advanced.hold.locked)[:, present] > 0.5
    switches = np.diff(locked.astype(int), axis=0)

    def fraction(weights: Array) -> np.ndarray:
        return (np.asarray(weights)[:, present] > 0).mean(axis=0)

    return ClipActivity(
        legs=tuple(n for n, here in zip(scene.rig.names, present, strict=True) if here),
        frames=len(locked),
        seconds=float(np.sum(scene.frames.dt)),
        grounded=fraction(trace.sensed.foothold.found),
        in_contact=fraction(trace.sensed.contact.weight),
        reached=fraction(result.reached),
        locked=fraction(trace.advanced.hold.locked),
        locks=tuple(int(n) for n in (switches > 0).sum(axis=0)),
        releases=tuple(int(n) for n in (switches < 0).sum(axis=0)),
        limits=limits,
    )


def active_limits(
    ik: jaxik.FootIK, scenes: Sequence[Scene], results: Sequence[jaxik.Result]
) -> list[dict[str, float]]:
    """Fraction of each clip's frames that would differ with a limit at the end of its range.

    Each frame is stepped from the system's state before it, so that only the limit's effect in this
    frame counts. Limits are the smooth parameters named `limit`, `max_…` or
    `min_…`.
    """
    pairs = zip(scenes, results, strict=True)
    before = [_states_before(ik, scene, result) for scene, result in pairs]
    limited = _step_all(ik, scenes, before)
    fractions: list[dict[str, float]] = [{} for _ in scenes]
    for name, declared in parameter_tree.declarations(ik).items():
        leaf = name.rpartition(".")[2]
        if declared.kind == "threshold" or not (leaf == "limit" or leaf[:4] in ("max_", "min_")):
            continue
        value = parameter_tree.get(ik, name)
        lowest, highest = jnp.minimum(value, declared.low), jnp.maximum(value, declared.high)
        end = lowest if leaf[:4] == "min_" else highest
        unlimited = _step_all(parameter_tree.replace(ik, {name: end}), scenes, before)
        for of_clip, *poses in zip(fractions, limited, unlimited, strict=True):
            of_clip[name] = float(np.mean(_differ(*poses)))
    return fractions


def _states_before(ik: jaxik.FootIK, scene: Scene, result: jaxik.Result) -> jaxik.State:
    """The memory before each frame."""
    first = jaxik.init(own_system(ik, scene), scene.rig)
    states = stage_outputs(result).advanced.state
    first, states = jax.device_get((first, states))
    return jax.tree.map(
        lambda start, rest: jax.device_put(np.concatenate([start[None], rest[:-1]])), first, states
    )


@dataclasses.dataclass(frozen=True)
class Nudge:
    """The changes when one threshold moves by a tenth of its range."""

    flipped: float
    """Fraction of the feet's decisions."""
    rise: float
    """Of the cost."""


def nudge_thresholds(
    problem: Problem, u: Float[np.ndarray, " free"]
) -> dict[str, tuple[Nudge, Nudge]]:
    """The changes when a threshold moves down and up, by name.

    Each threshold moves by a tenth of its range, but not beyond it, and the other parameters keep
    their values. The decisions are those of every foot in every frame: planted, lifted, locked, and
    whether ground was found.
    """
    space = problem.space
    values = dict(zip(space.names, np.asarray(space.values(jnp.asarray(u))), strict=True))

    def decisions(packed: Array) -> Bool[np.ndarray, " decisions"]:
        results = run_all(*system_and_scenes(problem, packed))
        return np.concatenate([_decisions(result) for result in results])

    def nudge(name: str, value: float) -> Nudge:
        moved = space.pack(values | {name: value})
        flipped = float(np.mean(decisions(moved) != unmoved))
        both = evolution.evaluate(problem, np.stack([u, np.asarray(moved)])).cost
        return Nudge(flipped, float(both[1] - both[0]))

    unmoved, nudges = decisions(space.pack(values)), {}
    for parameter in space.parameters:
        if parameter.kind == "threshold":
            distance = NUDGE * (parameter.high - parameter.low)
            ends = values[parameter.name] + np.array([-distance, distance])
            down, up = np.clip(ends, parameter.low, parameter.high)
            nudges[parameter.name] = nudge(parameter.name, down), nudge(parameter.name, up)
    return nudges


def _decisions(result: jaxik.Result) -> Bool[np.ndarray, " decisions"]:
    trace = stage_outputs(result)
    sensed, held = trace.sensed, trace.advanced.hold
    weights = (sensed.contact.planted, sensed.contact.lifted, held.locked, sensed.foothold.found)
    return np.stack([np.asarray(weight) > 0.5 for weight in weights], axis=-1).ravel()


def _step_all(
    ik: jaxik.FootIK, scenes: Sequence[Scene], before: Sequence[jaxik.State]
) -> list[Poses]:
    """Body and legs of every frame of each clip, each stepped from its own state."""
    poses: dict[int, Poses] = {}
    for numbers in groups(scenes):
        members = tuple(scenes[number] for number in numbers)
        states = tuple(before[number] for number in numbers)
        poses |= zip(numbers, _step_each(ik, members, states), strict=True)
    return [poses[number] for number in range(len(scenes))]


@program_cache.cached
def _step_each(
    ik: jaxik.FootIK, scenes: tuple[Scene, ...], before: tuple[jaxik.State, ...]
) -> list[Poses]:
    """The same for one clip, or for several that share a world."""
    row = row_of(ik, scenes)

    def step(state: jaxik.State, frame: jaxik.Frame, values: dict[str, Array]) -> Poses:
        at = parameter_tree.replace(row.ik, values) if values else row.ik
        result = jaxik.step(at, row.rig, row.terrain, state, frame)[1]
        ankle, body = result.pose.ankle, result.body
        return body.pos, body.rot, ankle.pos, ankle.rot, result.pose.knee.pos

    if len(scenes) > 1:
        before = tuple(map(moved_out, before, scenes))
    return split(jax.vmap(step)(in_a_row(before), row.frames, row.tracks), scenes)


def _differ(a: Poses, b: Poses) -> Bool[np.ndarray, " frames"]:
    """Frames in which anything differs."""
    changes = [
        np.abs(np.asarray(x - y)).reshape(len(x), -1).max(axis=1) for x, y in zip(a, b, strict=True)
    ]
    return np.max(changes, axis=0) > ROUNDING
