"""Comparable programs: two-bone legs in plain NumPy, SciPy's least squares, and crowds in C."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PyTree
from scipy.optimize import OptimizeResult, least_squares

import jaxik
from fitting.codegen.crowd import Axes, kernel_of, run_crowd
from fitting.problem.problem import Problem
from jaxik.maths import parameter_tree
from jaxik.stages.leg import TwoBone
from jaxik.world.terrain import Terrain

from . import workloads
from .measurement import Call

Vectors = Float[np.ndarray, "legs 3"]
Rotations = Float[np.ndarray, "legs 4"]


class Legs(NamedTuple):
    """Animated legs and the targets of their ankles; model space, m."""

    hip: Vectors
    knee: Vectors
    ankle: Vectors
    hip_rot: Rotations
    knee_rot: Rotations
    knee_axis_ls: Vectors
    target: Vectors


def numpy_arguments(batch: workloads.LegBatch) -> tuple[Legs, float, float, float]:
    """A batch of legs, and the limits of its knees, as arguments of `two_bone`."""
    rule = batch.ik.leg
    assert isinstance(rule, TwoBone)
    pose = batch.frame.pose
    axis = jnp.broadcast_to(batch.rig.knee_axis_ls, pose.hip.pos.shape)
    arrays = (pose.hip.pos, pose.knee.pos, pose.ankle.pos, pose.hip.rot, pose.knee.rot, axis)
    flat = (np.asarray(x).reshape(-1, x.shape[-1]) for x in (*arrays, batch.target_ms))
    least, most = float(rule.min_knee_angle), float(rule.max_knee_angle)
    return Legs(*flat), least, most, float(rule.soften)


def two_bone(
    legs: Legs, min_angle: float, max_angle: float, soften: float
) -> tuple[Rotations, Rotations]:
    """Corrections of hips and knees, as `jaxik.stages.leg.TwoBone` makes them, by the cosine law.

    Legs that are straight or folded, or that lie along their hinge, are not handled. The other
    arguments are those of `TwoBone`: the angles of its knee, rad, and its softening.
    """
    hinge = _rotate(legs.knee_rot, legs.knee_axis_ls)
    to_hip, to_ankle = legs.hip - legs.knee, legs.ankle - legs.knee
    to_target = legs.target - legs.hip
    thigh, shin, distance = (np.linalg.norm(v, axis=-1) for v in (to_hip, to_ankle, to_target))
    shortest, longest = (
        np.sqrt(thigh**2 + shin**2 - 2.0 * thigh * shin * np.cos(angle))
        for angle in (min_angle, max_angle)
    )
    start = soften * longest
    room = longest - start
    beyond = np.maximum(distance - start, 0.0)
    soft = np.minimum(distance, start)
    if soften < 1:
        soft += room * (1.0 - np.exp(-beyond / room))
    reach = np.clip(soft, shortest, longest)

    along_hip, along_ankle = np.sum(to_hip * hinge, -1), np.sum(to_ankle * hinge, -1)
    flat_hip = to_hip - along_hip[:, None] * hinge
    flat_ankle = to_ankle - along_ankle[:, None] * hinge
    a, b = np.linalg.norm(flat_hip, axis=-1), np.linalg.norm(flat_ankle, axis=-1)
    across2 = reach**2 - (along_hip - along_ankle) ** 2
    target_angle = np.arccos(np.clip((a**2 + b**2 - across2) / (2.0 * a * b), -1.0, 1.0))
    angle = _angle(flat_hip, flat_ankle, hinge) % (2.0 * np.pi)
    knee_rot = _about(hinge, target_angle - angle)

    bent = _rotate(knee_rot, to_ankle) - to_hip
    start_ms = bent / np.linalg.norm(bent, axis=-1, keepdims=True)
    aim = to_target / distance[:, None]
    arc = _arc(start_ms, aim)
    swing = _multiply(_about(aim, _angle(_rotate(arc, hinge), hinge, aim)), arc)
    return _local(legs.hip_rot, swing), _local(legs.knee_rot, knee_rot)


def _multiply(p: Rotations, q: Rotations) -> Rotations:
    pw, pv, qw, qv = p[:, :1], p[:, 1:], q[:, :1], q[:, 1:]
    scalar = pw * qw - np.sum(pv * qv, axis=-1, keepdims=True)
    return np.concatenate([scalar, pw * qv + qw * pv + np.cross(pv, qv)], axis=-1)


def _conjugate(q: Rotations) -> Rotations:
    return q * np.array([1.0, -1.0, -1.0, -1.0], q.dtype)


def _local(joint_rot: Rotations, rot: Rotations) -> Rotations:
    return _multiply(_conjugate(joint_rot), _multiply(rot, joint_rot))


def _rotate(q: Rotations, v: Vectors) -> Vectors:
    twice = 2.0 * np.cross(q[:, 1:], v)
    return v + q[:, :1] * twice + np.cross(q[:, 1:], twice)


def _about(axis: Vectors, angle: np.ndarray) -> Rotations:
    half = 0.5 * angle[:, None]
    return np.concatenate([np.cos(half), np.sin(half) * axis], axis=-1)


def _angle(a: Vectors, b: Vectors, axis: Vectors) -> np.ndarray:
    """Signed angle from `a` to `b`, rad, seen along the axis."""
    a = a - np.sum(a * axis, -1, keepdims=True) * axis
    b = b - np.sum(b * axis, -1, keepdims=True) * axis
    return np.arctan2(np.sum(axis * np.cross(a, b), -1), np.sum(a * b, -1))


def _arc(a: Vectors, b: Vectors) -> Rotations:
    """Shortest rotation between unit vectors that are not opposite."""
    q = np.concatenate([1.0 + np.sum(a * b, -1, keepdims=True), np.cross(a, b)], axis=-1)
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def least_squares_with_scipy(
    problem: Problem, *, our_jacobian: bool
) -> Callable[[], OptimizeResult]:
    """SciPy's `least_squares` from the space's start, with our Jacobian or finite differences.

    The residuals are ours and compiled in both cases. It stops at our solver's tolerance.
    """

    def compiled(function: Callable[[Problem, jax.Array], jax.Array]) -> Callable:
        program = jax.jit(function)
        return lambda u: np.asarray(program(problem, jnp.asarray(u)))

    jacobian = compiled(lambda problem, u: problem.jacobian(u)) if our_jacobian else "2-point"
    start = np.asarray(problem.space.start, float)
    residuals = compiled(lambda problem, u: problem.residuals(u))
    return lambda: least_squares(residuals, start, jac=jacobian, ftol=1e-6)  # pyright: ignore


def taken_over(result: jaxik.Result) -> tuple:
    """What a game takes over of a result: corrections, the body's motion, what was reached."""
    return result.corrections, result.body, result.reached


def by_kernel(crowd: workloads.Crowd, ground: Terrain, size: int) -> tuple[Call, str]:
    """A call that computes a crowd in parts of a size, on all cores, and what by.

    Raises:
        NoKernelError: there is no compiled code for it.
    """
    count = len(crowd.members.first)
    firsts = (min(first, count - size) for first in range(0, count, size))
    parts = [_arguments(crowd, ground, slice(first, first + size)) for first in firsts]
    kernel = kernel_of(*parts[0][0], keep=taken_over)

    def call() -> list[PyTree]:
        return [
            run_crowd(*trees, -1, starts=starts, count=crowd.frame_count, keep=taken_over)
            for trees, starts in parts
        ]

    return call, f"C, {kernel.lanes} lanes"


def _arguments(
    crowd: workloads.Crowd, ground: Terrain, part: slice
) -> tuple[tuple[jaxik.FootIK, jaxik.Rig, Terrain, jaxik.Frame, Axes], np.ndarray]:
    """Those of `run_crowd` for some of a crowd, and the frames with which they start."""
    members = jax.tree.map(lambda leaf: np.asarray(leaf)[part], crowd.members)
    world_ws = np.asarray(crowd.motion.world_from_model.pos)
    to_place = (members.place_ws - world_ws[members.first]) * np.array([1, 0, 1], np.float32)
    frames = eqx.tree_at(
        lambda frame: frame.world_from_model.pos, crowd.motion, world_ws + to_place[:, None]
    )
    ik = parameter_tree.replace(crowd.ik, members.drawn)
    trees, shared = (ik, frames), (crowd.ik, crowd.motion)
    of_ik, of_frames = (
        jax.tree.map(lambda many, one: 0 if np.ndim(many) > np.ndim(one) else None, *pair)
        for pair in zip(trees, shared, strict=True)
    )
    return (ik, crowd.rig, ground, frames, (of_ik, None, None, of_frames)), members.first
