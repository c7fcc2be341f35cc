"""What `jaxik bench` holds us against: a two-bone leg in plain NumPy, SciPy's least squares."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from fitting.problem.problem import Problem

Vectors = Float[np.ndarray, "legs 3"]
Turns = Float[np.ndarray, "legs 4"]


class Legs(NamedTuple):
    """Animated legs and where their ankles shall go, model space, m."""

    hip: Vectors
    knee: Vectors
    ankle: Vectors
    hip_rot: Turns
    knee_rot: Turns
    knee_axis_ls: Vectors
    target: Vectors


def two_bone(legs: Legs, min_angle: float, max_angle: float, soften: float) -> tuple[Turns, Turns]:
    """Corrections of hips and knees, as `jaxik.stages.leg.TwoBone` makes them, by the cosine law.

    Legs that are straight, folded or lie along their hinge are not looked after.

    Args:
        legs: all of them at once.
        min_angle, max_angle: of the knee, rad.
        soften: share of the longest reach from which legs resist.
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
    soft = np.minimum(distance, start) + room * (1.0 - np.exp(-beyond / room))
    reach = np.clip(soft, shortest, longest)

    along_hip, along_ankle = np.sum(to_hip * hinge, -1), np.sum(to_ankle * hinge, -1)
    flat_hip = to_hip - along_hip[:, None] * hinge
    flat_ankle = to_ankle - along_ankle[:, None] * hinge
    a, b = np.linalg.norm(flat_hip, axis=-1), np.linalg.norm(flat_ankle, axis=-1)
    across2 = reach**2 - (along_hip - along_ankle) ** 2
    wanted = np.arccos(np.clip((a**2 + b**2 - across2) / (2.0 * a * b), -1.0, 1.0))
    present = _angle(flat_hip, flat_ankle, hinge) % (2.0 * np.pi)
    turn = _about(hinge, wanted - present)

    bent = _rotate(turn, to_ankle) - to_hip
    start_ms = bent / np.linalg.norm(bent, axis=-1, keepdims=True)
    aim = to_target / distance[:, None]
    arc = _arc(start_ms, aim)
    swing = _multiply(_about(aim, _angle(_rotate(arc, hinge), hinge, aim)), arc)
    return _local(legs.hip_rot, swing), _local(legs.knee_rot, turn)


def _multiply(p: Turns, q: Turns) -> Turns:
    pw, pv, qw, qv = p[:, :1], p[:, 1:], q[:, :1], q[:, 1:]
    scalar = pw * qw - np.sum(pv * qv, axis=-1, keepdims=True)
    return np.concatenate([scalar, pw * qv + qw * pv + np.cross(pv, qv)], axis=-1)


def _conjugate(q: Turns) -> Turns:
    return q * np.array([1.0, -1.0, -1.0, -1.0], q.dtype)


def _local(rot: Turns, turn: Turns) -> Turns:
    return _multiply(_conjugate(rot), _multiply(turn, rot))


def _rotate(q: Turns, v: Vectors) -> Vectors:
    twice = 2.0 * np.cross(q[:, 1:], v)
    return v + q[:, :1] * twice + np.cross(q[:, 1:], twice)


def _about(axis: Vectors, angle: np.ndarray) -> Turns:
    half = 0.5 * angle[:, None]
    return np.concatenate([np.cos(half), np.sin(half) * axis], axis=-1)


def _angle(a: Vectors, b: Vectors, axis: Vectors) -> np.ndarray:
    """Signed angle from `a` to `b`, rad, seen along the axis."""
    a = a - np.sum(a * axis, -1, keepdims=True) * axis
    b = b - np.sum(b * axis, -1, keepdims=True) * axis
    return np.arctan2(np.sum(axis * np.cross(a, b), -1), np.sum(a * b, -1))


def _arc(a: Vectors, b: Vectors) -> Turns:
    """Shortest rotation between unit vectors that are not opposed."""
    q = np.concatenate([1.0 + np.sum(a * b, -1, keepdims=True), np.cross(a, b)], axis=-1)
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


class Descent(NamedTuple):
    """Where SciPy came to."""

    cost: float
    evaluations: int
    jacobians: int


def with_scipy(problem: Problem, *, our_slopes: bool) -> Callable[[], Descent]:
    """SciPy's `least_squares` from the prior's centre, with our Jacobian or with differences.

    The rows are ours and compiled in both cases; it stops at the solver's own tolerance.
    """
    start = np.asarray(problem.space.u0, float)
    rows = jax.jit(lambda problem, u: problem.residuals(u))
    slopes = jax.jit(lambda problem, u: problem.jacobian(u))

    def fun(u: np.ndarray) -> np.ndarray:
        return np.asarray(rows(problem, jnp.asarray(u)))

    def jac(u: np.ndarray) -> np.ndarray:
        return np.asarray(slopes(problem, jnp.asarray(u)))

    def solve() -> Descent:
        way: Any = jac if our_slopes else "2-point"
        found = least_squares(fun, start, jac=way, ftol=1e-6)
        return Descent(float(found.cost), int(found.nfev), int(found.njev))

    return solve
