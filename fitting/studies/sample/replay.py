"""Posterior predictive checks: is the captured motion one that the posterior would make?

Replicates are the motions of some draws of the posterior, each with noise of its own (Gelman et
al., Bayesian Data Analysis, 3rd edition, 6.3). What is compared are the residuals from the draw's
own motion, so that a replicate's are its noise.
"""

import hashlib
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypedDict

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

import jaxik
from fitting.inference import noise
from fitting.inference.noise import NoiseDensity
from fitting.inference.sample.blocks import SECONDS, BlockLogLikelihood
from fitting.inference.sample.posterior import Posterior
from fitting.motion import goodness, playback
from fitting.motion.playback import RESIDUAL_KINDS, Playback
from fitting.problem.capture_system import system_and_scenes
from fitting.problem.problem import Problem
from fitting.problem.scene import MEASURED, PER_LEG, Scene
from fitting.problem.simulation import correlated
from fitting.runtime import activity
from fitting.runtime.precision import in_float64
from fitting.studies.fit.fit import FittedParameter

SURPRISING = 0.005  # probability, to either side, of a capture that is unlike the replicates
BAND = (2.5, 50.0, 97.5)  # per cent

# Widths of the posterior's interval, in units of the fit's, that are clearly another answer. The
# interval of a threshold's profile is meant to be wide (Hansen 2000).
NARROW = {"smooth": 0.5, "threshold": 0.25}
WIDE = 2.0

Reason = Literal["leaves out the fit", "narrower", "wider"]


DRAWS = 512  # whose motion is made
REPLICATES = 256  # of them that get noise
POSITIONS = ("ankle", "knee", "pelvis")
UP, ABOUT_X = 1, 0  # components of positions and of rotations that bands show

ROUNDING = 1e-6  # of a block, by which a frame may begin too early


@dataclass(frozen=True)
class NoiseProcess:
    """Noise of one kind in one clip, in sigmas."""

    density: NoiseDensity
    correlation: float
    """From one frame to the next."""
    independent_fraction: float
    """Of the residuals."""

    def draw(
        self, random: np.random.Generator, shape: tuple[int, int]
    ) -> Float[np.ndarray, "frames columns"]:
        """A series of this noise."""
        draws = self.density.draw(random, shape)
        return correlated(draws, self.correlation, self.independent_fraction)


@dataclass(frozen=True)
class Statistic:
    """One statistic of the residuals, of the capture and of replicates."""

    captured: Float[np.ndarray, " draws"]
    """Each from the motion of its draw."""
    replicated: Float[np.ndarray, " draws"]

    @property
    def median(self) -> float:
        """Of the capture."""
        return float(np.median(self.captured))

    @property
    def replicated_interval(self) -> tuple[float, float]:
        """95 % of the replicates."""
        low, high = np.percentile(self.replicated, [2.5, 97.5])
        return float(low), float(high)

    @property
    def p(self) -> float:
        """Posterior predictive p-value: how often a replicate's is as large as the capture's."""
        larger = np.mean(self.replicated > self.captured)
        return float(larger + 0.5 * np.mean(self.replicated == self.captured))

    @property
    def is_surprising(self) -> bool:
        """Whether hardly any replicate is like the capture."""
        return not SURPRISING <= self.p <= 1 - SURPRISING


@dataclass(frozen=True)
class PredictiveCheck:
    """The residuals of one kind in one clip beside those of replicates."""

    clip: int
    """From 0."""
    kind: str
    rms: Statistic
    """Root mean square, sigmas."""
    autocorrelation: Statistic
    """From one frame to the next."""
    largest: Statistic
    """Largest size, sigmas."""

    @property
    def surprises(self) -> list[str]:
        """What of the capture is unlike the replicates."""
        named = {
            "size": self.rms,
            "autocorrelation": self.autocorrelation,
            "largest residual": self.largest,
        }
        return [name for name, statistic in named.items() if statistic.is_surprising]


@dataclass(frozen=True)
class Band:
    """One channel of the capture inside the band of its replicates; relative to their median."""

    clip: int
    """From 0."""
    kind: str
    channel: str
    """Which of them, in words."""
    time: Float[np.ndarray, " frames"]
    """s."""
    captured: Float[np.ndarray, " frames"]
    """m or rad; NaN where it was not observed."""
    low: Float[np.ndarray, " frames"]
    """2.5 % of the replicates, m or rad."""
    high: Float[np.ndarray, " frames"]
    """97.5 %."""

    @property
    def outside(self) -> float:
        """Fraction of the captured frames outside the band; 0.05 is expected."""
        seen = ~np.isnan(self.captured)
        beyond = (self.captured < self.low) | (self.captured > self.high)
        return float(beyond[seen].mean()) if seen.any() else 0.0


def statistics_of(
    residuals: Float[np.ndarray, "frames columns"], active: Bool[np.ndarray, "frames columns"]
) -> tuple[float, float, float]:
    """Root mean square, autocorrelation from frame to frame, and largest size."""
    values = np.where(active, residuals, 0.0)
    squares = float(np.sum(values**2))
    if not squares > 0:
        return 0.0, 0.0, 0.0
    pairs = active[1:] & active[:-1]
    products = float(np.sum(values[1:] * values[:-1])) / max(int(pairs.sum()), 1)
    mean_square = squares / int(active.sum())
    return mean_square**0.5, products / mean_square, float(np.abs(values).max())


def make_band(
    place: tuple[int, str, str],
    time: Float[np.ndarray, " frames"],
    observed: Bool[np.ndarray, " frames"],
    errors: Float[np.ndarray, "draws frames"],
    noise: Float[np.ndarray, "draws frames"],
) -> Band:
    """The band of a channel.

    Args:
        place: clip, kind and channel.
        time: s.
        observed: where the capture counts.
        errors: motion of each draw minus the capture.
        noise: of each draw's replicate.
    """
    low, middle, high = np.percentile(errors + noise, BAND, axis=0)
    captured = np.where(observed, -middle, np.nan)
    return Band(*place, time, captured, low - middle, high - middle)


class Disagreement(TypedDict):
    """A parameter of which fit and chain give clearly different intervals."""

    name: str
    reason: Reason
    value: float
    """Of the fit, in the parameter's unit."""
    interval_of_fit: list[float]
    """95 %."""
    interval: list[float]
    """95 %, of the posterior."""


def disagreements(
    parameters: Sequence[FittedParameter], posterior: Posterior
) -> list[Disagreement]:
    """Parameters whose posterior leaves out the fit, or is clearly narrower or wider than it says.

    A chain that has not converged contradicts nothing.
    """
    if not posterior.converged:
        return []
    rows = []
    for fitted, sampled in zip(parameters, posterior.summary, strict=True):
        low, high = sampled["low95"], sampled["high95"]
        reason = _reason(fitted, low, high)
        if reason is not None:
            rows.append(
                Disagreement(
                    name=fitted["name"],
                    reason=reason,
                    value=fitted["value"],
                    interval_of_fit=fitted["interval"],
                    interval=[low, high],
                )
            )
    return rows


def _reason(fitted: FittedParameter, low: float, high: float) -> Reason | None:
    """Why an interval of the posterior contradicts the fit; None if it does not."""
    if not low <= fitted["value"] <= high:
        return "leaves out the fit"
    width = fitted["interval"][1] - fitted["interval"][0]
    if high - low < NARROW[fitted["kind"]] * width:
        return "narrower"
    return "wider" if high - low > WIDE * width else None


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
            rows = [statistics_of(residuals, active) for residuals in both]
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
            bands.append(make_band(place, self.played.time, observed, errors, noise))
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
