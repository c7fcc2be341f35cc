"""How far motions are from the captured one, in m and rad, and whether a fit fits.

Three motions are compared on the same frames: the flat animation without foot IK, the system as it
was before the fit, and the fitted one. Distances are root mean squares over frames and legs. Frames
that were held out test the parameters on motion to which they were not fitted.

The verdict rests on size and autocorrelation of the residuals, each with its significance.
Residuals come in standard deviations, frames first and a column for each leg and component, which
count as independent and are pooled. The expected mean is zero and is not subtracted: a constant
offset is a misfit, and shows as correlation. With ten thousand residuals everything is significant,
so a finding must be large as well. The sizes are those from which intervals are wrong by a quarter.
`tests/analysis/test_goodness.py` holds them against simulated noise: no false alarm in 95 % of fits
whose noise is as assumed, and every violation found.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias, get_args

import numpy as np
from jaxtyping import Bool, Float
from scipy import special

from fitting.problem.problem import TAILS, Loss
from fitting.problem.scene import MEASURED, PER_LEG

from .playback import Playback
from .worst_window import SECONDS, window_sums

Part: TypeAlias = Literal["fitted", "held_out"]
Motion: TypeAlias = Literal["animation", "before", "fitted"]
Kinds: TypeAlias = Mapping[str, float]
MOTIONS: tuple[Motion, ...] = get_args(Motion)
PARTS: tuple[Part, ...] = get_args(Part)

# Distances up to which two motions look the same, m and rad, as after a good fit of a capture.
CLOSE = {"ankle": 0.02, "knee": 0.03, "pelvis": 0.02, "foot": 0.1}
# Differences between two distances that nobody sees, m and rad: 2 mm, of a foot at heel and tip.
UNSEEN = {"ankle": 0.002, "knee": 0.002, "pelvis": 0.002, "foot": math.radians(1.0)}
HALF_FOOT = UNSEEN["ankle"] / UNSEEN["foot"]  # m, from where a turn moves by what can be seen

LAGS = 10  # of the Ljung-Box test
INSIGNIFICANT = 2.0  # standard errors, below which an autocorrelation ends the sums over lags
MIN_SPACING = 1e-3  # frames; the sum over lags may come out below zero
MEDIAN = float(special.ndtri(0.75))  # median size of a standard normal
MEDIAN_EFFICIENCY = 0.3675  # of the median of sizes as an estimate of scale (Huber 1981, 5.1)
LARGEST = 3.0  # sigmas, to which residuals are clipped where outliers are expected

NEAR, FAR = 3.0, 5.0  # sigmas beyond which residuals are counted
MANY_OUTLIERS = 0.005  # fraction beyond FAR; a normal has 6e-7, noise of Student's t with 4.4 this
LONGEST_OUTLIER = 3  # frames; residuals far off for longer are a misfit
MIN_SEEN = 0.5  # fraction of a stretch that must have been observed

SIGNIFICANT = 1e-3  # p-value, over all groups, above which nothing is a finding
TOO_LARGE = 1.25  # noise over the sigma that was given; its inverse is too small
STRUCTURED = 0.2  # autocorrelation from which residuals larger than their sigma are a misfit
LOCAL = 1.5  # size of the worst seconds over that of the clip, from which they are a misfit
CROWDED = 1.75  # frames for each residual that counts as independent: 32 % too narrow
SPARSE = 0.5  # frames for each such residual: 41 % too wide
ABOUT_RIGHT = 0.1  # by which intervals may be too narrow or too wide and still be about right
SMALL = 1e-4  # a p-value below it is called so
ALMOST_NONE = 1e-6  # noise over its sigma, below which it is none
ALIKE = 1.25  # ratio of noises up to which one number stands for all kinds

NAMES = {
    "ankle": "ankles",
    "knee": "knees",
    "pelvis": "pelvis",
    "foot": "orientation of the feet",
    "body": "orientation of the pelvis",
}
PART_NAMES: Mapping[Part, str] = {"fitted": "fitted frames", "held_out": "held-out frames"}


class Setback(NamedTuple):
    """A distance that is larger for the fitted motion than for another one."""

    part: Part
    kind: str
    fitted: float
    """m or rad."""
    other: Motion
    """Which is closer."""
    distance: float
    """Of the other motion; m or rad."""


@dataclass(frozen=True)
class Distances:
    """How far the animation, the system before the fit, and the fitted one are from the capture."""

    parts: Mapping[Part, Mapping[Motion, Kinds]]
    """m and rad, of `CLOSE`'s kinds; no part of which no frame was observed."""
    judged: Sequence[str] = tuple(CLOSE)
    """Kinds that say whether a fit is good: without those that it was told to ignore."""

    @property
    def setbacks(self) -> list[Setback]:
        """Where the fitted motion is visibly worse than another, the largest ones first."""
        worse = [
            Setback(part, kind, motions["fitted"][kind], other, distance)
            for part, motions in self.parts.items()
            for other in ("animation", "before")
            for kind, distance in motions[other].items()
            if kind in self.judged and _is_worse(kind, motions["fitted"], motions[other])
        ]
        return sorted(worse, key=lambda s: (s.distance - s.fitted) / CLOSE[s.kind])

    @property
    def far(self) -> list[tuple[Part, str, float]]:
        """Where the fitted motion visibly differs from the captured: part, kind and distance."""
        return [
            (part, kind, distance)
            for part, motions in self.parts.items()
            for kind, distance in motions["fitted"].items()
            if kind in self.judged and distance > CLOSE[kind]
        ]

    @property
    def better(self) -> Motion:
        """Whose parameters are better: the fitted ones, or those from before the fit."""
        worse = any(setback.other == "before" for setback in self.setbacks)
        return "before" if worse and self._score("before") < self._score("fitted") else "fitted"

    @property
    def best(self) -> Motion:
        """Which motion is nearest as a whole; of equal ones the fitted one."""
        return min(reversed(MOTIONS), key=self._score)

    def _score(self, motion: Motion) -> float:
        """All distances as one number: the sum of their squares, in units of `CLOSE`."""
        return sum(
            (distance / CLOSE[kind]) ** 2
            for motions in self.parts.values()
            for kind, distance in motions[motion].items()
            if kind in self.judged
        )


def _is_worse(kind: str, fitted: Kinds, other: Kinds) -> bool:
    """Whether a fitted motion is visibly further off in one kind.

    A foot that is turned further off counts unless its ankle has come closer by more than the turn
    moves heel and tip. A flat animation that was made from the capture has its rotations exactly.
    """
    rise = fitted[kind] - other[kind]
    if kind == "foot":
        rise -= max(other["ankle"] - fitted["ankle"], 0.0) / HALF_FOOT
    return rise > UNSEEN[kind]


def measure_distances(before: Sequence[Playback], fitted: Sequence[Playback]) -> Distances:
    """The distances of three motions from the captured one, over all clips.

    The clips are those with the system as it was before the fit, and with the fitted one. A kind
    whose sigma is infinite in all of them is not judged.
    """
    parts: dict[Part, dict[Motion, Kinds]] = {}
    frames: dict[Part, list] = {
        "fitted": [clip.seen for clip in fitted],
        "held_out": [clip.held_out for clip in fitted],
    }
    for part in PARTS:
        if any(np.any(chosen) for chosen in frames[part]):
            motions: dict[Motion, list] = {
                "animation": [clip.animated_errors for clip in fitted],
                "before": [clip.errors for clip in before],
                "fitted": [clip.errors for clip in fitted],
            }
            parts[part] = {
                motion: {
                    kind: _rms([clip[kind] for clip in errors], kind, fitted, frames[part])
                    for kind in CLOSE
                }
                for motion, errors in motions.items()
            }
    sigmas = [clip.sigmas for clip in fitted]
    judged = [kind for kind in CLOSE if any(np.isfinite(each[kind]) for each in sigmas)]
    return Distances(parts, judged)


def _rms(
    errors: Sequence[np.ndarray], kind: str, clips: Sequence[Playback], frames: Sequence[np.ndarray]
) -> float:
    """Root mean square of the lengths of errors, over frames and present legs of all clips."""
    squares = []
    for values, clip, chosen in zip(errors, clips, frames, strict=True):
        lengths = np.sum(np.asarray(values) ** 2, axis=-1).reshape(len(chosen), -1)
        squares.append(lengths[clip.counts(kind, chosen)])
    return float(np.sqrt(np.mean(np.concatenate(squares))))


@dataclass(frozen=True)
class Noise:
    """Size and autocorrelation of residuals, in units of their sigma."""

    count: int
    """Active residuals."""
    degrees: float
    """Of freedom: independent values in the mean of the squares, less those used by the fit."""
    mean_square: float
    """Reduced chi-square: 1 where the sigma is right."""
    autocorrelation: float
    """From one frame to the next."""
    ljung_box: float
    """Statistic of Ljung and Box (1978); chi-square with `lags` degrees of freedom for noise."""
    lags: int
    spacing: float
    """Frames from one independent residual to the next: 1 + 2 * sum of autocorrelations."""

    @property
    def scale(self) -> float:
        """Size in sigmas, root mean square."""
        return math.sqrt(self.mean_square)

    @property
    def p(self) -> float:
        """Probability of a mean square at least as far from 1, to either side; 1 without data."""
        if not self.degrees > 0:
            return 1.0
        return two_sided(float(special.chdtr(self.degrees, self.degrees * self.mean_square)))

    @property
    def autocorrelation_p(self) -> float:
        """Probability of a Ljung-Box statistic at least as large; 1 without data."""
        return float(special.chdtrc(self.lags, self.ljung_box)) if self.lags else 1.0


def measure_noise(
    residuals: Float[np.ndarray, "frames columns"],
    active: Bool[np.ndarray, "frames columns"],
    median: float | None = None,
    used: float = 0.0,
) -> Noise:
    """Size and autocorrelation of residuals.

    The mean of the squares of correlated values has `count / (1 + 2 * sum of r_k²)` degrees of
    freedom, `r_k` their autocorrelations (Bartlett 1946).

    Args:
        residuals: in sigmas.
        active: which of them count.
        median: expected median size in sigmas; the size then follows from the median, and the
            autocorrelation from clipped residuals, so that a few outliers do not matter.
        used: fraction of the degrees of freedom that the fit has used up.
    """
    count = int(active.sum())
    if not count:
        return Noise(0, 0.0, 0.0, 0.0, 0.0, 0, 1.0)
    r, pairs = autocorrelations(clipped(residuals, active) if median else residuals, active)
    small = np.abs(r) < INSIGNIFICANT / np.sqrt(np.maximum(pairs, 1))
    end = int(np.argmax(small)) if small.any() else len(r)
    lags = min(LAGS, len(r))
    spread = 1.0 + 2.0 * float(np.sum(r[:end] ** 2))
    free = 1.0 - used
    if median:
        size = _median_size(residuals, active) / median
    else:
        size = float(np.mean(residuals[active] ** 2) ** 0.5)
    return Noise(
        count=count,
        degrees=count / spread * free * (MEDIAN_EFFICIENCY if median else 1.0),
        mean_square=size**2 / free,
        autocorrelation=float(r[0]) if lags else 0.0,
        ljung_box=float(np.sum(pairs[:lags] * r[:lags] ** 2)),
        lags=lags,
        spacing=max(1.0 + 2.0 * float(np.sum(r[:end])), MIN_SPACING),
    )


def pooled(noises: Sequence[Noise]) -> Noise:
    """Several series as one; means are weighted by their counts."""
    count = sum(noise.count for noise in noises)

    def mean(name: str) -> float:
        return sum(noise.count * getattr(noise, name) for noise in noises) / max(count, 1)

    return Noise(
        count=count,
        degrees=sum(noise.degrees for noise in noises),
        mean_square=mean("mean_square"),
        autocorrelation=mean("autocorrelation"),
        ljung_box=sum(noise.ljung_box for noise in noises),
        lags=sum(noise.lags for noise in noises),
        spacing=mean("spacing"),
    )


def autocorrelations(
    residuals: Float[np.ndarray, "frames columns"], active: Bool[np.ndarray, "frames columns"]
) -> tuple[Float[np.ndarray, " lags"], Float[np.ndarray, " lags"]]:
    """Autocorrelations at lags 1, 2, ..., and from how many pairs each comes.

    There are lags up to half of the frames; no autocorrelation where all residuals are zero.
    """
    values, seen = np.where(active, residuals, 0.0), active.astype(float)
    size = 2 * len(values)  # padded, so that the last frames do not meet the first ones

    def products(series: np.ndarray) -> np.ndarray:
        spectrum = np.abs(np.fft.rfft(series, size, axis=0)) ** 2
        return np.fft.irfft(spectrum.sum(axis=1), size)[: len(series) // 2 + 1]

    of_values, pairs = products(values), np.round(products(seen))
    variance = of_values[0] / max(pairs[0], 1.0)
    if not variance > 0:
        return np.zeros(len(pairs) - 1), pairs[1:]
    return of_values[1:] / np.maximum(pairs[1:], 1.0) / variance, pairs[1:]


def scale_by_median(
    residuals: Float[np.ndarray, "frames columns"], active: Bool[np.ndarray, "frames columns"]
) -> float:
    """Standard deviation of normal residuals from the medians of their sizes; 0 without any."""
    return _median_size(residuals, active) / MEDIAN


def _median_size(
    residuals: Float[np.ndarray, "frames columns"], active: Bool[np.ndarray, "frames columns"]
) -> float:
    """Root mean square over the columns, by their counts, of the median size of each.

    Not the median of all columns together: under an animation that has the captured paths seen from
    above, positions err in height only, and a median over all three axes would be zero.
    """
    if not active.any():
        return 0.0
    columns = zip(np.abs(residuals).T, active.T, strict=True)
    medians = [np.median(sizes[seen]) if seen.any() else 0.0 for sizes, seen in columns]
    return math.sqrt(np.average(np.square(medians), weights=active.sum(axis=0)))


def clipped(
    residuals: Float[np.ndarray, "frames columns"], active: Bool[np.ndarray, "frames columns"]
) -> Float[np.ndarray, "frames columns"]:
    """Residuals clipped to `LARGEST` times their median-based scale."""
    limit = LARGEST * scale_by_median(residuals, active)
    return np.clip(residuals, -limit, limit)


def two_sided(below: float) -> float:
    """The two-sided p-value of a statistic, given the probability of a smaller one."""
    return min(1.0, 2.0 * min(below, 1.0 - below))


def size(kind: str, distance: float) -> str:
    """A distance with its unit, cm or degrees."""
    if kind in ("foot", "body"):
        return f"{math.degrees(distance):.1f}°"
    return f"{100 * distance:.{1 if distance >= 0.01 else 2}f} cm"


EXPECTED = {size: float(2 * special.ndtr(-size)) for size in (NEAR, FAR)}  # fraction, of a normal


@dataclass(frozen=True)
class Assumed:
    """The assumptions of a fit about its residuals, apart from their sigmas."""

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
    """Whether intervals follow from size and correlation of the residuals: then sigmas are only
    weights of differences."""
    parameters: float = 0.0
    """How many parameters the data determine: the degrees of freedom that the fit has used."""

    @property
    def median(self) -> float:
        """Median size that the residuals should have, in sigmas."""
        return float(special.stdtrit(self.tails, 0.75)) if self.loss == "student" else MEDIAN


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
    """As the user set it; m, rad, ..."""
    correlation: float
    """From frame to frame, as the user set it."""
    dt: float
    """s, of a frame."""
    plain: Noise
    """Of the errors over their sigma, outliers left aside."""
    left: Noise
    """Of the residuals before the loss, whitened by the correlation that was given. Under a robust
    loss its size comes from the median."""
    near: float
    """Fraction of the residuals beyond 3 standard deviations, which follow from the median."""
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

    The correlations are those of each clip that were given, by kind; 0 for those left out.
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
    """Which residuals count: of frames that were observed, and of legs that are fitted."""
    residuals = np.asarray(playback.residuals[kind])
    counts = playback.counts(kind, playback.seen)
    if kind == "smooth":
        counts = counts[2:] & counts[1:-1] & counts[:-2]
    counts = counts.reshape(*counts.shape, *[1] * (residuals.ndim - 2))
    return np.broadcast_to(counts, residuals.shape).reshape(len(residuals), -1)


def _measure_group(
    playback: Playback, kind: str, clip: int, correlation: float, used: float, assumed: Assumed
) -> Group:
    plain, residuals, active = series(playback, kind)
    deviation = scale_by_median(residuals, active)
    in_deviations = np.abs(residuals) / (deviation or np.inf)
    far = in_deviations > FAR
    isolated = _fraction(~_lasting(far, LONGEST_OUTLIER), far) > 0.5
    has_outliers = bool(_fraction(far, active) > MANY_OUTLIERS and isolated)
    robust = assumed.loss != "squares"
    expected = assumed.median if robust else None
    left = measure_noise(residuals, active, expected, used)
    robust = robust or has_outliers
    size = measure_noise(plain, active, assumed.median if robust else None, used)
    if robust:
        plain, residuals = clipped(plain, active), clipped(residuals, active)
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
    """Where a column is true for more than this many consecutive frames."""
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
    return ratio**0.5, two_sided(float(special.fdtr(*degrees, ratio)))


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


@dataclass(frozen=True)
class Verdict:
    """Whether a fit fits."""

    fits: bool
    sentence: str


def judge(groups: Sequence[Group], assumed: Assumed, distances: Distances) -> Verdict:
    """Whether a fit is close to the capture, and no further off than its sigmas allow.

    Autocorrelation distinguishes a misfit from too small a sigma: motion that a system cannot
    follow lasts for many frames.
    """
    measured = [group for group in groups if group.is_measured and group.left.count]
    if not measured or not distances.parts:
        return Verdict(True, "Nothing was observed that could fit or not.")
    if setbacks := distances.setbacks:
        sentence = f"Worse: {describe_setback(setbacks[0])}"
        if len(setbacks) > 1:
            sentence += f", and in {len(setbacks) - 1} more of the distances below"
        better = "of the fit" if distances.better == "fitted" else "from before the fit"
        sentence += f". The parameters {better} are the better ones"
        if distances.best == "animation":
            sentence += ", but without foot IK the whole motion is nearer"
        return Verdict(False, f"{sentence}.")
    if far := distances.far:
        off = "; ".join(
            f"{NAMES[kind]} {size(kind, distance)} off the capture in {PART_NAMES[part]}, and "
            f"{size(kind, CLOSE[kind])} would be seen"
            for part, kind, distance in far
        )
        return Verdict(False, f"Does not fit: {off}.")
    level = SIGNIFICANT / len(measured)
    if misfits := [group for group in measured if _is_misfit(group, level)]:
        return Verdict(False, f"Does not fit: {_describe_misfits(misfits)}.")
    findings = _noise_findings(measured, assumed, level)
    first, *others = [
        f"{describe_distances(motions['fitted'])} off the capture in {PART_NAMES[part]}"
        for part, motions in distances.parts.items()
    ]
    off = "; ".join([first, *others])
    if findings:
        return Verdict(True, f"Fits, but {findings}; {off}.")
    if assumed.sigmas_estimated:
        return Verdict(True, f"Fits: {off}; the size of the noise is estimated from it.")
    chi_square = pooled([group.left for group in measured]).mean_square
    return Verdict(True, f"Fits: {off}; reduced chi-square {chi_square:.3g}.")


def describe_setback(setback: Setback) -> str:
    """Where the fit has made something worse, in words."""
    other = {"animation": "without foot IK", "before": "before the fit"}[setback.other]
    fitted, better = size(setback.kind, setback.fitted), size(setback.kind, setback.distance)
    part = PART_NAMES[setback.part]
    return f"{NAMES[setback.kind]} {fitted} off the capture in {part}, {better} {other}"


def describe_distances(kinds: Mapping[str, float]) -> str:
    """Distances of all kinds of joints, in words."""
    return ", ".join(f"{NAMES[kind]} {size(kind, distance)}" for kind, distance in kinds.items())


def judge_tolerances(groups: Sequence[Group]) -> Verdict:
    """Whether a motion is reproduced within its sigmas, where the reference has no noise."""
    measured = [group for group in groups if group.is_measured and group.left.count]
    beyond = [group for group in measured if group.plain.scale > 1 or _worst_scale(group) > LOCAL]
    if beyond:
        return Verdict(False, f"Not the same motion: {_describe_misfits(beyond, 'tolerance')}.")
    return Verdict(True, "The same motion, within the tolerances.")


def _is_misfit(group: Group, level: float) -> bool:
    structured = group.left.autocorrelation > STRUCTURED and group.left.autocorrelation_p < level
    large = group.plain.scale > TOO_LARGE and group.plain.p < level
    return (structured and large) or _is_local_misfit(group, level)


def _is_local_misfit(group: Group, level: float) -> bool:
    expected = max(1.0, group.plain.scale)
    return (
        group.worst is not None and group.worst.scale > LOCAL * expected and group.worst.p < level
    )


def _worst_scale(group: Group) -> float:
    return group.worst.scale if group.worst is not None else 0.0


def _describe_misfits(misfits: Sequence[Group], limit: str = "sigma") -> str:
    """The worst group with its worst seconds, then the other kinds."""
    several = len({group.clip for group in misfits}) > 1 or misfits[0].clip > 0
    by_size = sorted(misfits, key=lambda group: -_worst_scale(group))
    worst, others = by_size[0], []
    for group in by_size[1:]:
        if group.kind not in (worst.kind, *(other.kind for other in others)):
            others.append(group)
    stretch = worst.worst
    assert stretch is not None  # of a measured group
    clip = f" in clip {worst.clip + 1}" if several else ""
    seconds = f"from {stretch.start:.1f} s to {stretch.end:.1f} s"
    if worst.plain.scale > TOO_LARGE:
        text = f"{NAMES[worst.kind]} {_times(worst.plain.scale)} worse than their {limit}{clip}"
        text += f", most of all {seconds} ({_times(stretch.scale)})"
    else:
        text = f"{NAMES[worst.kind]} {_times(stretch.scale)} worse than their {limit}{clip}"
        text += f" {seconds}"
    rest = [f"{NAMES[group.kind]} {_times(_worst_scale(group))}" for group in others]
    return f"{text}; at their worst also {', '.join(rest)}" if rest else text


def _noise_findings(measured: Sequence[Group], assumed: Assumed, level: float) -> str:
    """Errors of the assumed noise, and their effect on intervals; "" if there are none."""
    left = pooled([group.left for group in measured])
    frames = left.spacing * assumed.weight
    significant = any(group.left.autocorrelation_p < level for group in measured)
    correlated = significant and not SPARSE < frames < CROWDED
    width = left.mean_square * frames
    correlated = correlated and not assumed.counted
    findings, remedies = [], []
    if not (assumed.sigmas_estimated or assumed.counted) and (
        off := _wrong_sigmas(measured, level, correlated=correlated)
    ):
        findings.append(off)
        remedies.append("set the sigmas below")
    if correlated:
        assumption = measured[0].correlation
        plain = pooled([group.plain for group in measured])
        observation = plain.autocorrelation
        # Relative to the frames for each independent error at the correlation that was given.
        width = plain.mean_square * plain.spacing * assumed.weight
        width *= (1 - assumption) / (1 + assumption)
        than = f", not by {assumption:.2f}" if assumption else ""
        size = f"{observation:.2f} from one frame to the next{than}"
        if assumed.whitened:
            findings.append("the residuals are correlated even where the estimate is taken out")
            remedies.append('set `correlation = "counted"` in [noise]')
        else:
            findings.append(f"the residuals are correlated ({size})")
            remedies.append(f"set `correlation = {observation:.2f}`")
    text = ""
    if findings:
        text = f"{' and '.join(findings)}: the intervals are {_width(width**0.5)}; "
        text += " and ".join(remedies)
    outliers = [group for group in measured if group.has_outliers]
    if outliers and assumed.loss == "squares":
        names = ", ".join(dict.fromkeys(NAMES[group.kind] for group in outliers))
        count = sum(group.left.count for group in outliers)
        part = sum(group.left.count * group.near for group in outliers) / count
        text += "; " if text else ""
        text += f"{100 * part:.1f} % of the residuals ({names}) are outliers, beyond "
        text += f"{NEAR:g} standard deviations, where noise has "
        loss = "student" if assumed.sigmas_estimated else "cauchy"  # which has no sigma to estimate
        text += f'{100 * EXPECTED[NEAR]:.1f} %: set `loss = "{loss}"`'
    return text


def _wrong_sigmas(measured: Sequence[Group], level: float, *, correlated: bool) -> str:
    """The noise over the sigmas, where these are wrong; "" if none are.

    With a wrong correlation the size of the residuals is not that of the errors.
    """
    ratios, wrong = {}, False
    for kind in dict.fromkeys(group.kind for group in measured):
        of_kind = [group for group in measured if group.kind == kind]
        outliers = any(group.has_outliers for group in of_kind)
        size = pooled([g.plain if correlated or outliers else g.left for g in of_kind])
        ratios[kind] = size.scale
        wrong |= not 1 / TOO_LARGE < size.scale < TOO_LARGE and size.p < level
    if not wrong:
        return ""
    low, high = min(ratios.values()), max(ratios.values())
    if high < ALIKE * low:
        return f"the noise is about {(low * high) ** 0.5:.2g} of the sigmas that were given"
    each = ", ".join(f"{NAMES[kind]} {ratio:.2g}" for kind, ratio in ratios.items())
    return f"the noise is not that of the sigmas that were given, but times these: {each}"


def _width(factor: float) -> str:
    """How far intervals are from those that would be right."""
    if factor > 1 + ABOUT_RIGHT:
        return f"about {_times(factor)} too narrow"
    if factor < 1 - ABOUT_RIGHT:
        return f"about {_times(1 / max(factor, ALMOST_NONE))} too wide"
    return "about right all the same"


def _times(factor: float) -> str:
    return f"{factor:.2g} times"
