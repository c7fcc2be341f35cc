"""The residuals of each kind in each clip: their size, correlation, outliers and worst seconds."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import special

from fitting.analysis.playback import Playback
from fitting.analysis.worst_window import PER_LEG, SECONDS, window_sums
from fitting.problem.loss import TAILS, Loss
from fitting.problem.scene import MEASURED

from . import noise
from .noise import Noise

NEAR, FAR = 3.0, 5.0  # sigmas beyond which residuals are counted
EXPECTED = {size: float(2 * special.ndtr(-size)) for size in (NEAR, FAR)}  # fraction, of a normal
MANY_OUTLIERS = 0.005  # fraction beyond FAR; a normal has 6e-7, noise of Student's t with 4.4 this
LONGEST_OUTLIER = 3  # frames; what is far off for longer is a misfit
MIN_SEEN = 0.5  # fraction of a stretch that must have been observed


@dataclass(frozen=True)
class Assumed:
    """What a fit assumes of its residuals, apart from their sigmas."""

    loss: Loss = "squares"
    weight: float = 1.0
    """Of the log-likelihood, as `Problem.weight`."""
    tails: float = TAILS
    """Degrees of freedom, under the loss `student`."""
    sigmas_estimated: bool = False
    """From the residuals themselves: then their size says nothing."""
    whitened: bool = False
    """Whether their correlation was estimated and taken out."""
    counted: bool = False
    """Whether intervals follow from size and correlation of the residuals: then sigmas are no
    more than what a difference weighs."""
    parameters: float = 0.0
    """How many parameters the data determine: the degrees of freedom that the fit has used."""

    @property
    def median(self) -> float:
        """Median size that the residuals should have, in sigmas."""
        return float(special.stdtrit(self.tails, 0.75)) if self.loss == "student" else noise.MEDIAN


@dataclass(frozen=True)
class Stretch:
    """The seconds of a clip in which the residuals of a kind are largest."""

    start: float
    """Seconds from the beginning of the clip."""
    end: float
    scale: float
    """Root mean square, sigmas."""
    p: float
    """Probability of one at least as large, anywhere in the clip, at the size of the others."""


@dataclass(frozen=True)
class Group:
    """The residuals of one kind in one clip."""

    clip: int
    """From 0."""
    kind: str
    sigma: float
    """That was given; m, rad, ..."""
    correlation: float
    """From frame to frame, that was given."""
    dt: float
    """s, of a frame."""
    plain: Noise
    """Of the errors over their sigma, outliers left aside."""
    left: Noise
    """Of the residuals before the loss: what is left once the given correlation is taken out. Under
    a robust loss its size comes from the median."""
    near: float
    """Fraction of the residuals beyond 3 standard deviations, these taken from the median."""
    far: float
    """Fraction beyond 5."""
    has_outliers: bool
    """Too many are beyond 5, most of them for a few frames only."""
    swing_ratio: float | None
    """Size in swing over size in stance; of the body: while a foot swings, and while none does.
    None if either never happens."""
    swing_p: float
    """Probability of a ratio at least as far from 1."""
    worst: Stretch | None
    """None for a kind that is not measured, or never observed."""

    @property
    def is_measured(self) -> bool:
        """Whether its residuals should look like noise.

        A contact label is 0 or 1, and `smooth` repeats the ankles: neither has a normal noise.
        """
        return self.kind in MEASURED


def measure_groups(
    playbacks: Sequence[Playback], correlations: Sequence[Mapping[str, float]], assumed: Assumed
) -> list[Group]:
    """All groups of a fit: of each clip, the kinds with a finite sigma.

    Args:
        playbacks: the clips with the fitted system.
        correlations: that were given, of each clip, by kind; 0 for those left out.
        assumed: by the fit.
    """
    counts = [
        int(_active(playback, kind).sum())
        for playback in playbacks
        for kind in playback.fitted_kinds
    ]
    used = min(assumed.parameters / max(sum(counts), 1), 0.5)
    return [
        _measure_group(playback, kind, clip, correlation.get(kind, 0.0), used, assumed)
        for clip, (playback, correlation) in enumerate(zip(playbacks, correlations, strict=True))
        for kind in playback.fitted_kinds
    ]


def series(playback: Playback, kind: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors over their sigma, residuals, and which of them count; (frames, columns) each."""
    active = _active(playback, kind)
    residuals = np.asarray(playback.residuals[kind], np.float64).reshape(active.shape)
    errors = np.asarray(playback.errors[kind], np.float64).reshape(active.shape)
    plain = np.where(active, errors / float(playback.sigmas[kind]), 0.0)
    return plain, np.where(active, residuals, 0.0), active


def _active(playback: Playback, kind: str) -> Bool[np.ndarray, "frames columns"]:
    """Which residuals count: of frames that were observed, and of legs that are present."""
    residuals = np.asarray(playback.residuals[kind])
    seen = np.asarray(playback.seen)
    if kind == "smooth":
        seen = seen[2:] & seen[1:-1] & seen[:-2]
    counts = seen.reshape(-1, *[1] * (residuals.ndim - 1))
    if kind in PER_LEG:
        counts = counts & np.asarray(playback.present).reshape(-1, *[1] * (residuals.ndim - 2))
    return np.broadcast_to(counts, residuals.shape).reshape(len(residuals), -1)


def _measure_group(
    playback: Playback, kind: str, clip: int, correlation: float, used: float, assumed: Assumed
) -> Group:
    plain, residuals, active = series(playback, kind)
    deviation = noise.scale_by_median(residuals, active)
    in_deviations = np.abs(residuals) / (deviation or np.inf)
    far = in_deviations > FAR
    isolated = _fraction(~_lasting(far, LONGEST_OUTLIER), far) > 0.5
    has_outliers = bool(_fraction(far, active) > MANY_OUTLIERS and isolated)
    robust = assumed.loss != "squares"
    expected = assumed.median if robust else None
    left = noise.measure(residuals, active, expected, used)
    robust = robust or has_outliers
    size = noise.measure(plain, active, assumed.median if robust else None, used)
    if robust:
        plain, residuals = noise.tamed(plain, active), noise.tamed(residuals, active)
    swing_ratio, swing_p = _swing(playback, kind, residuals, active, left)
    measured = kind in MEASURED and bool(active.any())
    return Group(
        clip=clip,
        kind=kind,
        sigma=float(playback.sigmas[kind]),
        correlation=correlation,
        dt=float(np.median(playback.dt)),
        plain=size,
        left=left,
        near=_fraction(in_deviations > NEAR, active),
        far=_fraction(far, active),
        has_outliers=has_outliers and kind in MEASURED,
        swing_ratio=swing_ratio,
        swing_p=swing_p,
        worst=_worst_stretch(playback.time, plain, active, size) if measured else None,
    )


def _lasting(far: Bool[np.ndarray, "frames columns"], frames: int) -> np.ndarray:
    """Where something is so for more than this many frames on end."""
    length = frames + 1
    lasting = np.zeros_like(far)
    if len(far) >= length:
        windows = np.lib.stride_tricks.sliding_window_view(far, length, axis=0)
        whole = np.asarray(windows.all(axis=-1))
        for offset in range(length):
            lasting[offset : offset + len(whole)] |= whole
    return lasting


def _fraction(chosen: np.ndarray, among: np.ndarray) -> float:
    return float(np.mean(chosen[among])) if among.any() else 0.0


def _swing(
    playback: Playback, kind: str, residuals: np.ndarray, active: np.ndarray, whole: Noise
) -> tuple[float | None, float]:
    """Size in swing over size in stance, and the p-value of this ratio (F test)."""
    labelled = bool(np.any(playback.stance))
    weight = np.asarray(playback.stance if labelled else playback.contact)
    stands: np.ndarray = weight > 0.5
    if kind == "smooth":
        stands = stands[1:-1]
    if kind in PER_LEG:
        stands = np.repeat(stands, active.shape[1] // stands.shape[1], axis=1)
    else:
        absent = ~np.asarray(playback.present, bool)
        every = np.all(stands | absent, axis=1, keepdims=True)
        stands = np.broadcast_to(every, active.shape)
    swing, stance = active & ~stands, active & stands
    if not (residuals[swing].any() and residuals[stance].any()):
        return None, 1.0
    ratio = float(np.mean(residuals[swing] ** 2) / np.mean(residuals[stance] ** 2))
    degrees = [whole.degrees * part.sum() / whole.count for part in (swing, stance)]
    return ratio**0.5, noise.two_sided(float(special.fdtr(*degrees, ratio)))


def _worst_stretch(
    time: Float[np.ndarray, " frames"], residuals: np.ndarray, active: np.ndarray, whole: Noise
) -> Stretch:
    """The `SECONDS` with the largest residuals; of a shorter clip, the whole of it."""
    frames = min(len(time), 1 + round(SECONDS / float(np.median(np.diff(time)))))
    counts = window_sums(active.sum(axis=1), frames)
    sums = window_sums(np.sum(np.where(active, residuals, 0.0) ** 2, axis=1), frames)
    enough = counts >= MIN_SEEN * counts.max()
    mean_squares = np.where(enough, sums / np.maximum(counts, 1), -1.0)
    start = int(np.argmax(mean_squares))
    mean_square = max(float(mean_squares[start]), 0.0)
    degrees = whole.degrees * float(counts[start]) / whole.count
    windows = max(len(time) / frames, 1.0)
    expected = max(whole.mean_square, 1.0)
    p = float(special.chdtrc(degrees, degrees * mean_square / expected))
    return Stretch(
        start=float(time[start]),
        end=float(time[start + frames - 1]),
        scale=mean_square**0.5,
        p=min(1.0, windows * p),
    )
