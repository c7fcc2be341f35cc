"""A small system with the structure of foot IK: a scan over frames and two legs, with hysteresis.

A foot is locked while it is near the ground and slow. Its anchor follows it while it is free and
freezes when it locks. Offsets, pelvis and pitch are smoothed and clamped. Metres, seconds, radians.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.inference.optimisation import search
from fitting.problem import space
from fitting.problem.free_parameters import free_parameter
from fitting.problem.loss import Loss
from fitting.problem.problem import Problem
from jaxik.maths import parameter_tree, smoothing
from jaxik.maths.gate import HARD

SIGMA_POS = 0.002  # m
SIGMA_PITCH = 0.02  # rad


class Lock(eqx.Module):
    height_on: Array = parameter_tree.parameter(
        0.06, unit="m", low=0.01, high=0.12, kind="threshold", doc="Height on of the test rule."
    )
    height_off: Array = parameter_tree.parameter(
        0.10,
        unit="m",
        low=0.02,
        high=0.2,
        kind="threshold",
        above="height_on",
        doc="Height off of the test rule.",
    )
    speed_on: Array = parameter_tree.parameter(
        0.6, unit="m/s", low=0.1, high=1.5, kind="threshold", doc="Speed on of the test rule."
    )
    speed_off: Array = parameter_tree.parameter(
        1.2,
        unit="m/s",
        low=0.2,
        high=2.5,
        kind="threshold",
        above="speed_on",
        doc="Speed off of the test rule.",
    )
    half_life: Array = parameter_tree.parameter(
        0.06, unit="s", low=0.01, high=0.3, scale="log", doc="Half life of the test rule."
    )
    release: Array = parameter_tree.parameter(
        0.1, unit="s", low=0.01, high=0.5, scale="log", doc="Release of the test rule."
    )


class Body(eqx.Module):
    gain: Array = parameter_tree.parameter(
        0.3, unit="1/tick", low=0.02, high=0.9, scale="gain", doc="Gain of the test rule."
    )
    tick_hz: Array = eqx.field(default=30.0, converter=parameter_tree.as_float_array)
    drop: Array = parameter_tree.parameter(
        0.15, unit="m", low=0.0, high=0.4, doc="Drop of the test rule."
    )
    rise: Array = parameter_tree.parameter(
        0.05, unit="m", low=0.0, high=0.2, doc="Rise of the test rule."
    )


class Foot(eqx.Module):
    share: Array = parameter_tree.parameter(
        0.6, unit="1", low=0.0, high=1.2, doc="Share of the test rule."
    )
    limit: Array = parameter_tree.parameter(
        (0.4, 0.4), unit="rad", low=0.1, high=0.8, doc="Limit of the test rule."
    )
    half_life: Array = parameter_tree.parameter(
        0.08, unit="s", low=0.01, high=0.4, scale="log", doc="Half life of the test rule."
    )
    idle: Array = parameter_tree.parameter(
        0.5, unit="1", low=0.0, high=1.0, doc="Idle of the test rule."
    )  # does nothing


class Toy(eqx.Module):
    lock: Lock = eqx.field(default_factory=Lock)
    body: Body = eqx.field(default_factory=Body)
    foot: Foot = eqx.field(default_factory=Foot)


class Inputs(eqx.Module):
    """Animation and ground, per frame and leg."""

    pos: Float[Array, "frames legs"]  # m, along the way
    height: Float[Array, "frames legs"]  # m, above the ground
    ground: Float[Array, "frames legs"]  # m
    slope: Float[Array, "frames legs"]  # rad
    dt: Float[Array, ""]  # s


class Data(eqx.Module):
    inputs: Inputs
    observed: tuple[Array, Array, Array]  # pos, pelvis, pitch


THRESHOLDS = ("lock.height_on", "lock.height_off", "lock.speed_on", "lock.speed_off")
SMOOTH = (
    "lock.half_life",
    "lock.release",
    "body.gain",
    "body.drop",
    "body.rise",
    "foot.share",
    "foot.limit[0]",
    "foot.limit[1]",
    "foot.half_life",
)
TRUTH = {
    "lock.height_on": 0.042,
    "lock.height_off": 0.078,
    "lock.speed_on": 0.42,
    "lock.speed_off": 0.95,
    "lock.half_life": 0.04,
    "lock.release": 0.15,
    "body.gain": 0.17,
    "body.drop": 0.11,
    "body.rise": 0.03,
    "foot.share": 0.85,
    "foot.limit[0]": 0.28,
    "foot.limit[1]": 0.36,
    "foot.half_life": 0.05,
}


def run(ik: Toy, inputs: Inputs) -> tuple[Array, Array, Array]:
    """Foot positions, pelvis height and foot pitches over the frames."""
    lock, body, foot, dt = ik.lock, ik.body, ik.foot, inputs.dt

    def step(state: tuple[Array, ...], frame: tuple[Array, ...]):
        before, anchor, offset, locked, pelvis, pitch = state
        pos, height, ground, slope = frame
        speed = jnp.abs(pos - before) / dt
        near = HARD.below(height, HARD.choose(locked, lock.height_off, lock.height_on), band=0.01)
        slow = HARD.below(speed, HARD.choose(locked, lock.speed_off, lock.speed_on), band=0.1)
        locked = near * slow
        anchor = HARD.choose(locked, anchor, pos)
        half_life = HARD.choose(locked, lock.half_life, lock.release)
        share = smoothing.fraction_of_half_life(half_life, dt)
        offset = smoothing.lerp(offset, locked * (anchor - pos), share)
        goal = HARD.clip(HARD.minimum(ground, band=0.01), -body.drop, body.rise, band=0.01)
        pelvis = smoothing.lerp(
            pelvis, goal, smoothing.fraction_of_gain(body.gain, dt, body.tick_hz)
        )
        tilt = HARD.clip(foot.share * slope, -foot.limit, foot.limit, band=0.03)
        pitch = smoothing.lerp(pitch, tilt, smoothing.fraction_of_half_life(foot.half_life, dt))
        return (pos, anchor, offset, locked, pelvis, pitch), (pos + offset, pelvis, pitch)

    first = inputs.pos[0]
    zero = jnp.zeros_like(first)
    start = (first, first, zero, zero, zero[0], zero)
    frames = (inputs.pos, inputs.height, inputs.ground, inputs.slope)
    return jax.lax.scan(step, start, frames)[1]


def residuals(ik: Toy, data: Data) -> Array:
    """Residuals in sigmas."""
    sigmas = (SIGMA_POS, SIGMA_POS, SIGMA_PITCH)
    parts = [
        ((modelled - observed) / sigma).ravel()
        for modelled, observed, sigma in zip(
            run(ik, data.inputs), data.observed, sigmas, strict=True
        )
    ]
    return jnp.concatenate(parts)


def make_inputs(seed: int = 0, frames: int = 400, fps: float = 60.0) -> Inputs:
    """A walk of changing stride, speed and lift over rough ground."""
    random = np.random.default_rng(seed)
    time = np.arange(frames) / fps
    phase = 2 * np.pi * np.cumsum(1.0 + 0.3 * np.sin(0.9 * time + random.uniform(0, 6))) / fps
    legs = np.stack([phase, phase + np.pi], axis=1)
    wander = np.sin(0.7 * time + random.uniform(0, 6))[:, None]
    drift = 0.25 * (1.2 + wander) * (1.0 + 0.5 * np.sin(5.3 * time + random.uniform(0, 6)))[:, None]
    swing = np.clip(np.sin(legs), 0, None)
    speed = drift + 2.2 * swing**2 + random.normal(0, 0.12, (frames, 2))
    height = (
        0.03 * (1 + 0.6 * np.sin(3.1 * legs)) + 0.16 * swing + random.normal(0, 0.008, (frames, 2))
    )
    waves = [
        random.uniform(0.04, 0.1) * np.sin(rate * time[:, None] + random.uniform(0, 6, 2))
        for rate in (0.8, 1.7, 3.1)
    ]
    slopes = [0.3 * np.sin(rate * time[:, None] + random.uniform(0, 6, 2)) for rate in (1.1, 2.9)]
    return Inputs(
        pos=jnp.asarray(np.cumsum(speed, axis=0) / fps),
        height=jnp.asarray(height),
        ground=jnp.asarray(sum(waves)),
        slope=jnp.asarray(sum(slopes)),
        dt=jnp.asarray(1.0 / fps),
    )


def make_data(truth: Toy, seed: int = 0, frames: int = 400, outliers: float = 0.0) -> Data:
    """Motion of the true system, with noise of one sigma and a fraction of gross outliers."""
    inputs = make_inputs(seed, frames)
    random = np.random.default_rng(seed + 1000)
    observed = []
    for clean, sigma in zip(run(truth, inputs), (SIGMA_POS, SIGMA_POS, SIGMA_PITCH), strict=True):
        noise = random.normal(0, sigma, clean.shape)
        gross = random.random(clean.shape) < outliers
        observed.append(clean + noise + gross * 30 * sigma * random.random(clean.shape))
    return Data(inputs, tuple(observed))  # type: ignore[arg-type]


NAMES = (*THRESHOLDS, *SMOOTH, "foot.idle")


@functools.cache
def solved(seed: int) -> tuple[Problem, search.Solution]:
    """A problem and its solution, computed once for all tests."""
    problem = make_problem(seed)
    return problem, search.find_best_fit(problem)


def make_problem(
    seed: int = 0,
    frames: int = 400,
    names: tuple[str, ...] = NAMES,
    truth: dict[str, float] = TRUTH,
    outliers: float = 0.0,
    loss: Loss = "squares",
) -> Problem:
    """A problem that starts at the defaults, with data made from the truth."""
    free = [free_parameter(Toy(), name) for name in names]
    known = space.make_space(Toy(), [free_parameter(Toy(), name) for name in TRUTH])
    data = make_data(known.unpack(known.pack(truth)), seed, frames, outliers)
    return Problem(space.make_space(Toy(), free), data, residuals, loss)
