"""The motion of a posterior's draws, and what follows from it: likelihoods, predictive checks."""

import hashlib
import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

import jaxik
from fitting.inference import noise
from fitting.inference.noise import NoiseDensity
from fitting.inference.sample.blocks import SECONDS, BlockLogLikelihood
from fitting.inference.sample.posterior import Posterior
from fitting.motion import goodness, playback
from fitting.motion.playback import RESIDUAL_KINDS, Playback
from fitting.motion.worst_window import PER_LEG
from fitting.problem.capture_system import system_and_scenes
from fitting.problem.problem import Problem
from fitting.problem.scene import MEASURED, Scene
from fitting.runtime import activity
from fitting.runtime.precision import in_float64

from . import predictive
from .predictive import Band, NoiseProcess, PredictiveCheck, Statistic

DRAWS = 512  # whose motion is made
REPLICATES = 256  # of them that get noise
POSITIONS = ("ankle", "knee", "pelvis")
UP, ABOUT_X = 1, 0  # components of positions and of rotations that bands show

ROUNDING = 1e-6  # of a block, by which a frame may begin too early


@dataclass(frozen=True)
class Replay:
    """What the motions of a posterior's draws say."""

    blocks: BlockLogLikelihood
    checks: tuple[PredictiveCheck, ...]
    """One for each kind and clip."""
    bands: tuple[Band, ...]
    """One channel for each."""


@in_float64
def replay(problem: Problem[jaxik.FootIK], posterior: Posterior, seed: int) -> Replay:
    """Runs draws of a posterior through the clips."""
    every = math.ceil(len(noise.thinned(posterior.draws_u)) / DRAWS)
    u = noise.thinned(posterior.draws_u)[::every]
    sigmas = {kind: draws[::every] for kind, draws in posterior.sigmas.items()}
    clips = [_Clip(problem, index, seed) for index in range(len(problem.data))]
    with activity.announced(f"Playing {len(u)} draws of the posterior", len(u)) as playing:
        for draw, row in enumerate(u):
            plays = playback.play_all(*system_and_scenes(problem, jnp.asarray(row)))
            drawn = {kind: float(values[draw]) for kind, values in sigmas.items()}
            replicated = draw % math.ceil(len(u) / REPLICATES) == 0
            for clip, played in zip(clips, plays, strict=True):
                clip.add(played, drawn, replicated)
            playing.advance()
    ess = min(row["ess"] for row in posterior.summary)
    values = np.concatenate([clip.log_likelihood for clip in clips], axis=1)
    numbers = np.concatenate([np.full(len(clip.starts), clip.index + 1) for clip in clips])
    observed = np.any(values != 0.0, axis=0)
    return Replay(
        blocks=BlockLogLikelihood(
            values=values[:, observed],
            clip=numbers[observed],
            start=np.concatenate([clip.starts for clip in clips])[observed],
            end=np.concatenate([clip.ends for clip in clips])[observed],
            data=digest(problem),
            efficiency=min(1.0, ess / len(u)),
        ),
        checks=tuple(check for clip in clips for check in clip.checks),
        bands=tuple(band for clip in clips for band in clip.bands),
    )


class _Clip:
    """What the draws make of one clip, draw by draw."""

    def __init__(self, problem: Problem[jaxik.FootIK], index: int, seed: int):
        self.index = index
        self._scene: Scene = problem.data[index]
        self._random = np.random.default_rng([seed, index])
        self._density = NoiseDensity(problem.loss, float(problem.tails))
        self._weight = float(problem.weight)
        self._frames: list[Float[np.ndarray, " frames"]] = []
        self._statistics: dict[str, list[np.ndarray]] = defaultdict(list)
        self._channels: dict[str, list[np.ndarray]] = defaultdict(list)
        self._last: Playback | None = None

    def add(self, played: Playback, sigmas: Mapping[str, float], replicated: bool) -> None:
        """Adds the motion of one draw, and replicates of it if `replicated`."""
        assumed = {kind: float(sigma) for kind, sigma in played.sigmas.items()}
        ratios = {kind: sigma / assumed[kind] for kind, sigma in sigmas.items()}
        frames = of_frames(played, self._scene, self._density, ratios)
        self._frames.append(self._weight * frames)
        self._last = played
        if not replicated:
            return
        for kind in self.kinds:
            plain, _, active = goodness.series(played, kind)
            correlation = float(self._scene.sigmas.correlation_of(kind))
            process = NoiseProcess(self._density, correlation, min(1.0, self._weight))
            noise = process.draw(self._random, (len(plain), plain.shape[1]))
            both = (plain / ratios.get(kind, 1.0), noise)
            rows = [predictive.statistics_of(residuals, active) for residuals in both]
            self._statistics[kind].append(np.array(rows))
            column, sigma = self.column(kind), assumed[kind]
            in_units = (sigma * plain, ratios.get(kind, 1.0) * sigma * noise)
            self._channels[kind].append(np.stack([series[:, column] for series in in_units]))

    @property
    def played(self) -> Playback:
        """The clip with the last draw."""
        assert self._last is not None  # there is a draw
        return self._last

    @property
    def kinds(self) -> list[str]:
        """Kinds of residuals with a noise of their own."""
        return [kind for kind in self.played.fitted_kinds if kind in MEASURED]

    def column(self, kind: str) -> int:
        """The channel that is shown: of the first leg, upwards or about x."""
        component = UP if kind in POSITIONS else ABOUT_X
        return 3 * self._first_leg + component if kind in PER_LEG else component

    def channel(self, kind: str) -> str:
        """The channel that is shown, in words."""
        direction = "upwards" if kind in POSITIONS else "about its x axis"
        leg = f"{self._scene.rig.names[self._first_leg]}, " if kind in PER_LEG else ""
        return leg + direction

    @property
    def _first_leg(self) -> int:
        return int(np.argmax(np.asarray(self._scene.rig.present) > 0))

    @property
    def _blocks(self) -> np.ndarray:
        return block_of_frames(self.played)

    @property
    def starts(self) -> Float[np.ndarray, " blocks"]:
        """Of the blocks, s."""
        return self.played.time[np.unique(self._blocks, return_index=True)[1]]

    @property
    def ends(self) -> Float[np.ndarray, " blocks"]:
        """Of the blocks, s."""
        return np.append(self.starts[1:], self.played.time[-1])

    @property
    def log_likelihood(self) -> Float[np.ndarray, "draws blocks"]:
        """Of the blocks, for each draw."""
        first = np.unique(self._blocks, return_index=True)[1]
        return np.add.reduceat(np.stack(self._frames), first, axis=1)

    @property
    def checks(self) -> list[PredictiveCheck]:
        """One for each kind."""
        checks = []
        for kind in self.kinds:
            rows = np.stack(self._statistics[kind])  # draws, captured or replicated, statistics
            statistics = [Statistic(rows[:, 0, i], rows[:, 1, i]) for i in range(rows.shape[2])]
            checks.append(PredictiveCheck(self.index, kind, *statistics))
        return checks

    @property
    def bands(self) -> list[Band]:
        """A channel of each kind."""
        bands = []
        for kind in self.kinds:
            column = self.column(kind)
            observed = goodness.series(self.played, kind)[2][:, column]
            channels = np.stack(self._channels[kind])
            place = (self.index, kind, self.channel(kind))
            errors, noise = channels[:, 0], channels[:, 1]
            bands.append(predictive.make_band(place, self.played.time, observed, errors, noise))
        return bands


def of_frames(
    playback: Playback, scene: Scene, density: NoiseDensity, ratios: Mapping[str, float]
) -> Float[np.ndarray, " frames"]:
    """Log-likelihood of each frame given the one before it.

    Args:
        playback: the clip with the system of a draw.
        scene: the clip.
        density: of independent residuals.
        ratios: sigmas of the draw in units of the scene's, by kind; 1 for those left out.
    """
    total = np.zeros(len(playback.dt))
    for kind in playback.fitted_kinds:
        _, residuals, active = goodness.series(playback, kind)
        ratio = ratios.get(kind, 1.0)
        log_density = density.log_density(residuals / ratio)
        log_density -= np.log(ratio * float(getattr(scene.sigmas, kind)))
        if kind == "smooth":  # an acceleration takes three frames; it counts for the one between
            total[1:-1] += np.where(active, log_density, 0.0).sum(axis=1)
            continue
        follows = np.concatenate([np.zeros_like(active[:1]), active[1:] & active[:-1]])
        correlation = float(scene.sigmas.correlation_of(kind))
        log_density -= 0.5 * np.log1p(-(correlation**2)) * follows
        total += np.where(active, log_density, 0.0).sum(axis=1)
    return total


def block_of_frames(playback: Playback) -> Int[np.ndarray, " frames"]:
    """The block of each frame, from 0; a short rest at the end belongs to the last one."""
    time = playback.time
    blocks = max(1, round(float(time[-1]) / SECONDS))
    return np.minimum((time / SECONDS + ROUNDING).astype(int), blocks - 1)


def digest(problem: Problem[jaxik.FootIK]) -> str:
    """16 characters that change with the captured motion, and with what of it counts."""
    digested = hashlib.sha256()
    for scene in problem.data:
        counts = [kind for kind in RESIDUAL_KINDS if np.isfinite(getattr(scene.sigmas, kind))]
        digested.update(repr(counts).encode())
        for leaf in jax.tree.leaves(eqx.filter((scene.reference, scene.frames.dt), eqx.is_array)):
            digested.update(np.asarray(leaf, np.float64).tobytes())
    return digested.hexdigest()[:16]
