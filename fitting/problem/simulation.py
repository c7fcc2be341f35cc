"""Problems whose truth is known: references made by a system itself, plus noise."""

import dataclasses
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxik
from fitting.runtime import program_cache
from fitting.runtime.precision import in_float64
from fitting.runtime.program_cache import cached
from jaxik.maths import quat
from jaxik.world.skeleton import Transform

from . import capture_system
from .capture_system import system_and_scenes
from .problem import Problem
from .scene import Scene, legs_ws, own_system, pelvis_ws
from .shared_world import run_scenes
from .space import Vector

Noise = Float[np.ndarray, "frames *shape"]
# Pelvis, knees, ankles and contact weights along a clip, world space.
Motion: TypeAlias = tuple[Transform, Array, Transform, Array]


@in_float64
def simulate(problem: Problem[jaxik.FootIK], u: Vector, seed: int = 0) -> Problem[jaxik.FootIK]:
    """The same problem with references that the system at `u` makes, plus the noise assumed.

    The noise is normal and has the scenes' sigmas and correlation; kinds with an infinite sigma
    get none. A weight below 1 counts as the fraction of the residuals that are independent: they
    are correlated so that `(1 - rho) / (1 + rho)` of a first-order autoregression is. Frames that
    were not observed stay so. With a robust loss the noise has no outliers.

    Args:
        problem: whose clips, sigmas and priors are used.
        u: the truth.
        seed: of the noise.

    Raises:
        ValueError: residuals of kind "smooth" are on; they follow from the ankles', so that no
            noise has independent ones of both kinds.
    """
    random = np.random.default_rng(seed)
    fraction = min(1.0, float(problem.weight))
    motions = zip(problem.data, _motions(*system_and_scenes(problem, u)), strict=True)
    scenes = tuple(_simulated(scene, motion, fraction, random) for scene, motion in motions)
    return eqx.tree_at(lambda problem: problem.data, problem, scenes)


@in_float64
def with_motion_of(problem: Problem[jaxik.FootIK], ik: jaxik.FootIK) -> Problem[jaxik.FootIK]:
    """The same problem with references that any system makes, without noise."""
    scenes = []
    for scene in problem.data:
        own, tracks = own_system(ik, scene), scene.tracks or None
        # The program that also plays clips, which a fit by the same system needs anyway.
        result = program_cache.run(own, scene.rig, scene.terrain, scene.frames, tracks=tracks)
        scenes.append(_with_reference(scene, *_motion(scene, result)))
    return eqx.tree_at(lambda problem: problem.data, problem, tuple(scenes))


def _with_reference(
    scene: Scene, pelvis: Transform, knee_ws: Array, ankle: Transform, contact: Array
) -> Scene:
    """A scene with this motion in its reference; the same frames count."""
    reference = dataclasses.replace(
        scene.reference,
        pelvis=pelvis,
        knee_ws=knee_ws,
        ankle=ankle,
        contact=contact,
        label="simulated",
    )
    return eqx.tree_at(lambda scene: scene.reference, scene, reference)


def _simulated(
    scene: Scene, motion: Motion, independent_fraction: float, random: np.random.Generator
) -> Scene:
    """A scene whose reference is the motion of a system plus noise."""
    sigmas = scene.sigmas
    if np.isfinite(sigmas.smooth):
        raise ValueError(
            f"sigmas.smooth is {float(sigmas.smooth):g}: residuals of accelerations follow from "
            "those of the ankles and have no noise of their own; wanted inf"
        )

    def noise(kind: str, shape: tuple[int, ...]) -> Noise:
        sigma = float(getattr(sigmas, kind))
        correlation = float(sigmas.correlation_of(kind))
        errors = correlated(random.normal(size=shape), correlation, independent_fraction)
        return sigma * errors if np.isfinite(sigma) else np.zeros(shape)

    pelvis, knee_ws, ankle, contact = motion
    return _with_reference(
        scene,
        displaced(pelvis, noise("pelvis", pelvis.pos.shape), noise("body", pelvis.pos.shape)),
        knee_ws + noise("knee", knee_ws.shape),
        displaced(ankle, noise("ankle", ankle.pos.shape), noise("foot", ankle.pos.shape)),
        contact + noise("contact", contact.shape),
    )


@cached
def _motions(ik: jaxik.FootIK, scenes: tuple[Scene, ...]) -> list[Motion]:
    """The motion of a system on each clip, as a capture would record it."""
    return [_motion(*pair) for pair in zip(scenes, run_scenes(ik, scenes), strict=True)]


@cached
def _motion(scene: Scene, result: jaxik.Result) -> Motion:
    assert result.trace is not None  # `jaxik.run` always has one
    legs, pelvis = legs_ws(scene, result), pelvis_ws(scene, result)
    contact = result.trace.sensed.contact.weight
    if (capture := scene.capture) is not None:
        legs, pelvis = capture_system.recorded(capture, scene.rig, scene.frames, legs, pelvis)
        contact = capture_system.delayed(capture, scene.frames, contact)
    return pelvis, legs.knee.pos, legs.ankle, contact


def correlated(draws: Noise, correlation: float, independent_fraction: float) -> Noise:
    """Independent draws made a series whose residuals count, and are correlated, as assumed."""
    between = (1 - independent_fraction) / (1 + independent_fraction)
    return autoregression(autoregression(draws, between), correlation)


def autoregression(innovations: Noise, correlation: float) -> Noise:
    """A stationary first-order autoregression over the first axis, with the innovations' variance.

    `x_t = rho x_{t-1} + sqrt(1 - rho²) e_t`, begun with `x_0 = e_0`.
    """
    from scipy.signal import lfilter  # here, for it takes a quarter of a second to import

    gain = np.sqrt(1 - correlation**2)
    scaled = np.concatenate([innovations[:1], gain * innovations[1:]])
    return np.asarray(lfilter([1.0], [1.0, -correlation], scaled, axis=0))


def displaced(joint: Transform, shift: Noise, turn: Noise) -> Transform:
    """A joint moved by `shift`, m, and turned so that its residual from the original is `-turn`."""
    half = turn / 2  # the residual is twice the sine of half the angle
    w = np.sqrt(np.maximum(1 - np.sum(half**2, axis=-1, keepdims=True), 0))
    rotation = jnp.asarray(np.concatenate([w, half], axis=-1), joint.rot.dtype)
    rotation = rotation / jnp.linalg.norm(rotation, axis=-1, keepdims=True)
    return Transform(joint.pos + jax.device_put(shift), quat.multiply(joint.rot, rotation))
