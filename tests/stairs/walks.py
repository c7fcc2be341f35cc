"""Walks over flights of stairs, what `stride` makes of them, and how good that is."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

import fitting
import jaxik
from fitting.clips import contacts
from fitting.clips.clip import Clip
from fitting.ground import ground_path
from fitting.studies.animations import Animation
from fitting.studies.suite import NO_COVER
from fitting.synthetic import footsteps, walker
from fitting.synthetic.footsteps import SIDES, Foothold, Swing, stepping_foot
from jaxik.maths import quat, vec
from jaxik.world import terrain
from stairs import flights
from stairs.flights import Flight
from support.strides import WAYS

FPS, FRAMES = 60, 200
SECONDS = 9.0
STEP_LENGTHS = (0.25, 0.35, 0.45, 0.55, 0.65)  # m
STEP_SECONDS, STANCE = 0.55, 0.62  # s, and part of two steps
HIGHEST = 0.32  # m, rise of one step of a walk: two stairs
SETTLED = 20  # frames before and after which nothing is measured
STEPPED = 90  # frames in which each foot makes a whole step


class Walk(NamedTuple):
    """A walk on a level floor."""

    clip: Clip
    frames: jaxik.Frame
    step: float
    """m, length of a step."""
    stride: float
    """s, of two steps."""


class Verdict(NamedTuple):
    """What is wrong with a walk over a flight."""

    off: float
    """m, by which a standing foot is off its tread at most."""
    pop: float
    """m in 1/60 s, by which a foot's correction changes beyond a smooth swing, at most."""
    dip: float
    """m, by which an ankle sinks and rises again in a swing, at most."""
    bend: float
    """m, second difference of its height at 30 Hz, at most."""
    sunk: float
    """m, by which a swinging sole is in the ground at most."""


def stepping(step: float, toe_off: float = 0.5) -> Clip:
    """A straight walk in steps, m, with flat landings and heels that rise by an angle, rad."""
    time = np.arange(round(SECONDS * FPS)) / FPS
    speed, cycle = step / STEP_SECONDS, 2.0 * STEP_SECONDS
    feet = []
    for leg, side in enumerate(SIDES):
        starts = cycle * (np.arange(-1, int(SECONDS / cycle) + 3) + 0.5 * leg)
        holds = [
            Foothold(x, x + STANCE * cycle, side * 0.09, speed * (x + 0.5 * STANCE * cycle) + 0.06)
            for x in starts
        ]
        feet.append(stepping_foot(time, holds, Swing(0.10, toe_off)))
    height = 0.89 + 0.015 * np.cos(2.0 * np.pi * (time / STEP_SECONDS - STANCE))
    pelvis = np.stack([np.zeros_like(time), height, speed * time], axis=1)
    body = walker.Body(pelvis, np.zeros_like(time), (feet[0], feet[1]), float(FPS))
    return body.clip(f"steps of {step} m", body.sinking())


@functools.cache
def walks() -> tuple[Walk, ...]:
    """Walks of different steps; the last are captured ones."""
    style = walker.WalkStyle(bend=0.0, knees=1.0)
    made = [(stepping(step), step, 2.0 * STEP_SECONDS) for step in STEP_LENGTHS]
    usual = 0.5 * footsteps.STRIDE, footsteps.PERIOD
    made += [(walker.walk(SECONDS, FPS, seed, style=style), *usual) for seed in range(2)]
    return tuple(
        Walk(clip, fitting.frames_from_clip(clip), step, stride) for clip, step, stride in made
    )


def choose(flight: Flight) -> Walk:
    """A walk whose steps are short enough for a flight."""
    longest = HIGHEST * flight.tread / flight.rise
    possible = [walk for walk in walks() if walk.step <= longest]
    return possible[int(flight.phase * 1000) % len(possible)]


def placed(flight: Flight) -> tuple[jaxik.Frame, jaxik.Frame]:
    """The frames of a walk over a flight, with its root on the ground, and on a level floor."""
    walk = choose(flight)
    first = round((1.0 + flight.phase) * walk.stride * FPS)
    frames = jax.tree.map(lambda x: np.array(x, np.float64)[first : first + FRAMES], walk.frames)
    turn = np.array([np.cos(flight.heading / 2), 0.0, np.sin(flight.heading / 2), 0.0])
    rot = Rotation.from_rotvec([0.0, flight.heading, 0.0])
    away = frames.world_from_model.pos[0] * [1.0, 0.0, 1.0]

    def turned(points: np.ndarray) -> np.ndarray:
        return rot.apply((points - away).reshape(-1, 3)).reshape(points.shape)

    stride = frames.stride
    ways = {
        name: rot.apply(way.reshape(-1, 3)).reshape(way.shape)
        for name, way in ((name, getattr(stride, name)) for name in WAYS)
    }
    points = {"last_ws": turned(stride.last_ws), "next_ws": turned(stride.next_ws)}
    stride = dataclasses.replace(stride, **points, **ways)
    world = jaxik.Transform(
        jnp.asarray(turned(frames.world_from_model.pos)),
        jnp.asarray(quat.multiply(turn[None], frames.world_from_model.rot)),
    )
    level = dataclasses.replace(
        frames, world_from_model=world, velocity_ws=rot.apply(frames.velocity_ws), stride=stride
    )
    # The way before and after it, too, since the root looks a stride ahead and back.
    around = np.array(walk.frames.world_from_model.pos, np.float64)
    path = flight.levels(turned(around)[:, 2])
    rise = ground_path.smooth(path, walk.stride * FPS)[first : first + FRAMES]
    return level.translated(rise[:, None] * [0.0, 1.0, 0.0]), level


class Solved(NamedTuple):
    """A walk as a system leaves it, (frames legs 3), m, world space."""

    ankle: np.ndarray
    soles: np.ndarray
    """Below ankle and ball, (frames legs 2 3)."""
    hip: np.ndarray


def solve(ik: jaxik.FootIK, flight: Flight, frames: jaxik.Frame) -> Solved:
    """What a system makes of a walk over a flight; those over fields share the suite's program."""
    clip = choose(flight).clip
    if flight.field:
        ground = terrain.combine(flights.field_of(flight.field_heights()), NO_COVER.terrain())
    else:
        ground = mesh_template().with_vertices(jnp.asarray(flight.vertices()))
    result = Animation(clip, ground, given_frames=frames).run(ik)
    world = jaxik.Transform(
        frames.world_from_model.pos[:, None], frames.world_from_model.rot[:, None]
    )
    hip, ankle, toe = (
        world.apply(joint.pos) for joint in (result.pose.hip, result.pose.ankle, result.pose.toe)
    )
    foot = quat.multiply(result.pose.ankle.rot, clip.rig.ankle_from_foot)
    up = quat.rotate(
        world.rot, quat.rotate(foot, jnp.broadcast_to(jnp.array([0.0, 1.0, 0.0]), ankle.shape))
    )
    heel = ankle - vec.scale(up, rig_heights()[0])
    ball = toe - vec.scale(up, rig_heights()[1])
    return Solved(np.asarray(ankle), np.stack([heel, ball], 2), np.asarray(hip))


@functools.cache
def mesh_template() -> terrain.Terrain:
    """The mesh whose vertices those of all flights replace."""
    return flights.mesh_of(flights.sample(np.random.default_rng(0), field=False))


def rig_heights() -> tuple[float, float]:
    """Of ankle and ball over the sole, m."""
    return footsteps.ANKLE_HEIGHT, footsteps.BALL_HEIGHT


def judge(flight: Flight, level: jaxik.Frame, solved: Solved, start: int = SETTLED) -> Verdict:
    """What is wrong with a walk over a flight from a frame on; see `Verdict`."""
    part = slice(start, FRAMES - SETTLED)
    standing = np.asarray(level.stride.standing) > 0
    above, sunk = flight.clearances(solved.soles)
    above, sunk = above.min(-1), sunk.max(-1)
    off = np.maximum(above, sunk)[part][standing[part]].max(initial=0.0)

    animated = np.asarray(
        jax.vmap(jaxik.Transform.apply)(level.world_from_model, level.pose.ankle.pos)
    )
    correction = solved.ankle - animated
    change = np.linalg.norm(np.diff(correction, axis=0, prepend=correction[:1]), axis=-1)
    pop = dip = bend = 0.0
    for leg in range(standing.shape[1]):
        heights = solved.ankle[:, leg, 1]
        runs = contacts.runs(standing[:, leg])
        for first, last in runs:
            at = slice(max(first + 1, start), min(last + 1, FRAMES - SETTLED))
            pop = max(pop, change[at, leg].max(initial=0.0))
        for (_, last), (first, _) in zip(runs, runs[1:], strict=False):
            needed = np.linalg.norm(correction[first, leg] - correction[last, leg])
            smooth = 1.875 * needed / (first - last)
            if last < start or first > FRAMES - SETTLED:
                continue
            pop = max(pop, change[last + 1 : first + 1, leg].max(initial=0.0) - smooth)
            swing = heights[last : first + 1]
            for odd in (0, 1):
                slow = heights[last - 2 + odd : first + 3 : 2]
                bend = max(bend, np.abs(np.diff(slow, 2)).max())
            before, after = np.maximum.accumulate(swing), np.maximum.accumulate(swing[::-1])[::-1]
            dip = max(dip, (np.minimum(before, after) - swing).max())
    swinging = sunk[part][~standing[part]].max(initial=0.0)
    return Verdict(float(off), float(pop), float(dip), float(bend), float(swinging))


def walked(
    ik: jaxik.FootIK, chosen: Sequence[Flight], *, known: bool = True, start: int = SETTLED
) -> list[tuple[Flight, Verdict]]:
    """Flights with the verdict on a walk over each from a frame on, footholds known or not."""
    verdicts = []
    for flight in chosen:
        frames, level = placed(flight)
        if not known:
            stride = dataclasses.replace(frames.stride, known=0.0 * frames.stride.known)
            frames = dataclasses.replace(frames, stride=stride)
        verdicts.append((flight, judge(flight, level, solve(ik, flight, frames), start)))
    return verdicts
