"""Errors as captures have them: slow, constant, sudden, and of people who are no system.

None of them is the noise that a fit assumes, which is independent of frame and joint.
"""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

import jaxik
from fitting.datasets.clips import contacts, edit
from fitting.problem.problem import Problem
from fitting.problem.scene import Scene
from fitting.problem.simulation import displaced
from jaxik.world.skeleton import Transform

DRIFT_PERIODS = (10.0, 30.0)  # s
POP_EVERY = 2.0  # s, on average
POP_FRAMES = 4  # at most
SWING_SPEED = 0.4  # m/s, of an animated ankle, above which its foot swings
KNEE_SHARE = 0.5  # of the ankle's deviation in a swing

Series = Float[np.ndarray, "frames ..."]


@dataclasses.dataclass(frozen=True)
class ErrorSizes:
    """How large the errors of a capture are."""

    drift: float
    """m, by which the floor rises and sinks in `DRIFT_PERIODS`."""
    offset: float
    """m, standard deviation of each coordinate of a joint's constant offset, which turns with the
    pelvis."""
    turn: float
    """rad, likewise of the constant rotations of pelvis and feet."""
    pop: float
    """m, by which a marker jumps, with one or more frames of one joint."""
    swing: float
    """m, by which a swinging ankle is off its path in mid-swing, smoothly."""
    noise: float
    """m, standard deviation of each coordinate, independent in each frame."""


LARGEST = ErrorSizes(drift=0.01, offset=0.01, turn=0.03, pop=0.10, swing=0.03, noise=0.002)


def draw_sizes(random: np.random.Generator, factor: float = 1.0) -> ErrorSizes:
    """Sizes between none and `factor` times the `LARGEST`, all equally likely."""
    return ErrorSizes(*factor * random.random(6) * dataclasses.astuple(LARGEST))


def with_errors(
    problem: Problem[jaxik.FootIK],
    sizes: ErrorSizes,
    mask_pops: Sequence[bool],
    random: np.random.Generator,
) -> Problem[jaxik.FootIK]:
    """The problem with errors in its references.

    Args:
        problem: whose references have none.
        sizes: of the errors.
        mask_pops: of each clip, whether frames in which a joint jumps are left out, as in a fit.
        random: what they are drawn from.
    """
    scenes = tuple(
        _with_errors(scene, sizes, masked, random)
        for scene, masked in zip(problem.data, mask_pops, strict=True)
    )
    return eqx.tree_at(lambda problem: problem.data, problem, scenes)


def _with_errors(
    scene: Scene, sizes: ErrorSizes, mask_pops: bool, random: np.random.Generator
) -> Scene:
    reference, dt = scene.reference, np.asarray(scene.frames.dt)
    time, count = np.cumsum(dt) - dt[0], len(scene.rig.side)
    joints = (len(dt), 1 + 2 * count, 3)  # pelvis, knees, ankles
    deviation = swing_deviation(np.asarray(scene.frames.foot_speed), sizes.swing, random)
    shift = sizes.noise * random.normal(size=joints) + pops(joints, time, sizes.pop, random)
    drift = floor_drift(time, sizes.drift, random)
    shift += drift[:, None, None] * np.asarray(scene.terrain.up_ws)
    heading = Rotation.from_quat(np.asarray(reference.pelvis.rot), scalar_first=True)
    for joint, offset in enumerate(sizes.offset * random.normal(size=joints[1:])):
        shift[:, joint] += heading.apply(offset)
    shift[:, 1 : 1 + count] += KNEE_SHARE * deviation
    shift[:, 1 + count :] += deviation
    turns = sizes.turn * random.normal(size=(1 + count, 3))
    pelvis = _displaced(reference.pelvis, shift[:, 0], turns[0])
    knee_ws = np.asarray(reference.knee_ws) + shift[:, 1 : 1 + count]
    ankle = _displaced(reference.ankle, shift[:, 1 + count :], turns[1:])
    seen = np.ones(len(dt), bool)
    if mask_pops:
        positions = [pelvis.pos[:, None], knee_ws, ankle.pos]
        seen = ~edit.jumps(np.concatenate(positions, axis=1), float(1 / dt.mean()))
    captured = dataclasses.replace(
        reference,
        pelvis=pelvis,
        knee_ws=jax.device_put(knee_ws),
        ankle=ankle,
        observed=reference.observed & seen,
        held_out=reference.held_out & seen,
    )
    return dataclasses.replace(scene, reference=captured)


def floor_drift(time: Series, size: float, random: np.random.Generator) -> Series:
    """Height, m, (frames,), of a floor that slowly rises and sinks by `size`; time in s."""
    phase, period = random.uniform(0.0, 2 * np.pi), random.uniform(*DRIFT_PERIODS)
    return size * np.sin(phase + 2 * np.pi * time / period)


def swing_deviation(speed: Series, size: float, random: np.random.Generator) -> Series:
    """How far each ankle is off its path, m, (frames, legs, 3): smooth, and 0 while a foot stands.

    Each swing has a direction of its own.

    Args:
        speed: of the animated ankles, m/s, (frames, legs).
        size: m, in mid-swing.
        random: what directions are drawn from.
    """
    deviation = np.zeros((*speed.shape, 3))
    for leg, moving in enumerate((speed > SWING_SPEED).T):
        for first, last in contacts.runs(moving):
            direction = random.normal(size=3)
            place = (np.arange(first, last + 1) - first + 1) / (last - first + 2)
            bump = size * np.sin(np.pi * place) ** 2
            deviation[first : last + 1, leg] = bump[:, None] * direction / np.linalg.norm(direction)
    return deviation


def pops(
    shape: tuple[int, int, int], time: Series, size: float, random: np.random.Generator
) -> Series:
    """Jumps, m, of single joints for a few frames, as a marker's that is mistaken for another.

    Args:
        shape: frames, joints, 3.
        time: s.
        size: m.
        random: what they are drawn from.
    """
    frames, joints, _ = shape
    jumps = np.zeros(shape)
    for _ in range(random.poisson(time[-1] / POP_EVERY)):
        first, joint = random.integers(frames), random.integers(joints)
        direction = random.normal(size=3)
        last = first + random.integers(1, POP_FRAMES + 1)
        jumps[first:last, joint] = size * direction / np.linalg.norm(direction)
    return jumps


def _displaced(joint: Transform, shift: Series, turn: Float[np.ndarray, "*joints 3"]) -> Transform:
    return displaced(joint, shift, np.broadcast_to(turn, shift.shape))
