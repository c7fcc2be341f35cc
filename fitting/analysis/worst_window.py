"""The two seconds of a clip in which the fit is worst, and what went wrong in them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fitting.report.plots.fit_plots import WORDS
from fitting.report.tables import share

from .playback import Playback

SECONDS = 2.0
OF_LEGS = ("ankle", "knee", "foot", "contact", "smooth")  # kinds of residuals that each leg has
PLACES = ("ankle", "knee", "pelvis")  # kinds that are a distance in the world
EQUAL = 1e-9  # relative: windows as bad as each other
KEPT = 0.5  # share of the window's frames that must have been seen


@dataclass(frozen=True)
class Ground:
    """How far captured soles are over the ground while they stand, m; below 0 in the ground."""

    mean: float
    rms: float
    frames: int  # of standing feet over ground, in the window
    largest: float  # in size
    frame: int  # where it is
    leg: int


@dataclass(frozen=True)
class Worst:
    """The window with the largest residuals, and what they are made of."""

    start: int  # frame
    end: int  # frame, the last of the window
    rms: float  # of the rows in the window, sigmas
    whole: float  # of the rows of the whole clip, sigmas
    shares: Mapping[str, float]  # of the squared rows, by kind, the largest first
    leg_shares: Float[np.ndarray, " legs"]  # of the legs' squared rows
    frame: int  # where the error of the largest kind is largest
    leg: int | None  # there; None where the kind is of the body
    size: float  # of that error, in the unit of its sigma
    offset: Float[np.ndarray, "3"] | None  # m, system - captured: up, forward, left; None of angles
    out_of_reach: float  # share of frames and legs in the window
    pelvis: float  # m, mean height over the captured one; NaN where nothing was seen
    ground: Ground | None  # None where no captured foot stands

    @property
    def kind(self) -> str:
        """The kind of residual that has most of the squared rows."""
        return next(iter(self.shares))


def find_worst(play: Playback) -> Worst:
    """The two seconds with the largest root mean square of the rows that the fit sees.

    Frames that were not seen do not count, and half of the window must have been seen; of a shorter
    clip it is the whole.
    """
    power = {kind: _power(play, kind) for kind in play.used}
    of_frame = np.sum([one.sum(axis=1) for one in power.values()], axis=0)
    seen = np.asarray(play.seen)
    rows = sum(int(np.prod(np.shape(play.rows[kind])[1:])) for kind in play.used)
    frames = min(len(seen), 1 + round(SECONDS / float(np.median(play.dt))))
    count = _sums(seen.astype(float), frames)
    mean = np.where(
        count >= min(KEPT * frames, count.max()),
        _sums(of_frame, frames) / (rows * np.maximum(count, 1.0)),
        -1.0,
    )
    equal = np.flatnonzero(mean >= mean.max() * (1 - EQUAL))
    start = int(equal[len(equal) // 2])  # a lone error is in the middle
    inside = slice(start, start + frames)
    total = {kind: float(one[inside].sum()) for kind, one in power.items()}
    order = sorted(total, key=lambda kind: -total[kind])
    legs = sum((power[kind][inside].sum(axis=0) for kind in order if kind in OF_LEGS), np.zeros(()))
    legs = np.broadcast_to(legs, play.stance.shape[1:])
    size = _size(play, order[0])[inside]
    frame, column = np.unravel_index(int(np.argmax(size)), size.shape)
    frame, leg = start + int(frame), int(column) if order[0] in OF_LEGS else None
    seen_inside = seen & _within(inside, len(seen))
    pelvis = play.height(play.after.pelvis) - play.height(play.captured.pelvis)
    return Worst(
        start=start,
        end=start + frames - 1,
        rms=float(np.sqrt(max(mean[start], 0.0))),
        whole=float(np.sqrt(of_frame.sum() / (rows * max(int(seen.sum()), 1)))),
        shares={kind: total[kind] / max(sum(total.values()), 1e-300) for kind in order},
        leg_shares=legs / max(float(legs.sum()), 1e-300),
        frame=frame,
        leg=leg,
        size=float(size[frame - start, column]),
        offset=_offset(play, order[0], frame, leg),
        out_of_reach=float(np.mean(np.asarray(play.reached)[inside] < 0.5)),
        pelvis=float(pelvis[seen_inside].mean()) if seen_inside.any() else np.nan,
        ground=_ground(play, seen_inside),
    )


def _power(play: Playback, kind: str) -> Float[np.ndarray, "frames columns"]:
    """Squared rows of a kind, a column a leg or one of the body; 0 where it was not seen."""
    rows = np.square(np.asarray(play.rows[kind], np.float64))
    if kind == "smooth":  # an acceleration is that of the middle of three frames
        rows = np.pad(rows, [(1, 1), (0, 0), (0, 0)])
    columns = rows.shape[1] if kind in OF_LEGS else 1
    return rows.reshape(len(rows), columns, -1).sum(axis=-1)


def _size(play: Playback, kind: str) -> Float[np.ndarray, "frames columns"]:
    """Length of the error of a kind, in the unit of its sigma; 0 where it was not seen."""
    error = np.abs(np.asarray(play.errors[kind], np.float64))
    if kind == "smooth":
        error = np.pad(error, [(1, 1), (0, 0), (0, 0)])
    columns = error.shape[1] if kind in OF_LEGS else 1
    size = np.linalg.norm(error.reshape(len(error), columns, -1), axis=-1)
    return size * np.asarray(play.seen)[:, None]


def _sums(series: Float[np.ndarray, " frames"], frames: int) -> Float[np.ndarray, " windows"]:
    """Sums over as many frames in a row, one for each first frame."""
    sums = np.concatenate([[0.0], np.cumsum(series)])
    return sums[frames:] - sums[:-frames]


def _within(inside: slice, frames: int) -> np.ndarray:
    chosen = np.zeros(frames, bool)
    chosen[inside] = True
    return chosen


def _offset(
    play: Playback, kind: str, frame: int, leg: int | None
) -> Float[np.ndarray, "3"] | None:
    """How far up, forward and to the left a joint is of the captured one, m."""
    if kind not in PLACES:
        return None
    error = np.asarray(play.errors[kind], np.float64)[frame]
    error = error if leg is None else error[leg]
    up, forward = np.asarray(play.up_ws), np.asarray(play.forward_ws)[frame]
    return np.array([error @ up, error @ forward, error @ np.cross(up, forward)])


def _ground(play: Playback, chosen: np.ndarray) -> Ground | None:
    """Captured soles over the ground under their balls.

    The sole is as far below the ball as the animation's ball is over its floor when the foot
    stands, the median over the clip.
    """
    stands = np.asarray(play.stance) > 0.5
    over_floor = play.height(play.before.toe) - np.asarray(play.floor)[:, None]
    depth = np.array(
        [np.median(over_floor[one, leg]) if one.any() else 0.0 for leg, one in enumerate(stands.T)]
    )
    gap = play.height(play.captured.toe) - depth - play.height(play.ball_ground_ws)
    here = chosen[:, None] & stands & (np.asarray(play.ball_grounded) > 0)
    if not here.any():
        return None
    frame, leg = np.unravel_index(int(np.argmax(np.where(here, np.abs(gap), -1.0))), gap.shape)
    return Ground(
        mean=float(gap[here].mean()),
        rms=float(np.sqrt(np.mean(gap[here] ** 2))),
        frames=int(here.sum()),
        largest=float(gap[frame, leg]),
        frame=int(frame),
        leg=int(leg),
    )


def told(play: Playback, worst: Worst, legs: Sequence[str]) -> list[str]:
    """What went wrong, in sentences."""
    first, last = play.time[worst.start], play.time[worst.end]
    others = [f"{_words(kind)} {share(part, 0)}" for kind, part in worst.shares.items()][1:]
    said = [
        f"From {first:.2f} s to {last:.2f} s the residuals are {worst.rms:.2f} sigmas (rms), "
        f"{worst.whole:.2f} over the whole clip.",
        f"{_words(worst.kind).capitalize()} has {share(worst.shares[worst.kind], 0)} of their "
        f"squares{'; ' + ', '.join(others) if others else ''}.",
        f"{_where(play, worst, legs)} {_stands(play, worst, legs)}",
    ]
    if worst.leg_shares.sum() > 0:
        most = int(np.argmax(worst.leg_shares))
        part = share(worst.leg_shares[most], 0)
        said.append(f"Of the squares of the legs the {legs[most]} one has {part}.")
    said.append(_reach(play, worst))
    if np.isfinite(worst.pelvis):
        way = "high" if worst.pelvis > 0 else "low"
        said.append(f"The pelvis is {100 * abs(worst.pelvis):.1f} cm too {way} on average.")
    said.append(_grounded(play, worst, legs))
    return said


def _words(kind: str) -> str:
    return WORDS[kind][0].lower()


def _where(play: Playback, worst: Worst, legs: Sequence[str]) -> str:
    """When and by how much the largest kind is worst."""
    _, unit, factor = WORDS[worst.kind]
    side = "" if worst.leg is None else f"of the {legs[worst.leg]} leg "
    text = (
        f"The {_words(worst.kind)} {side}is worst at {play.time[worst.frame]:.2f} s: "
        f"{factor * worst.size:.1f} {unit} off"
    )
    if worst.offset is not None:
        names = (("too high", "too low"), ("too far ahead", "too far behind"))
        names = (*names, ("too far to the left", "too far to the right"))
        most = int(np.argmax(np.abs(worst.offset)))
        text += f", mostly {names[most][int(worst.offset[most] < 0)]}"
        text += f" ({100 * abs(worst.offset[most]):.1f} cm)"
    return text + "."


def _stands(play: Playback, worst: Worst, legs: Sequence[str]) -> str:
    """What the feet do there, by the captured labels or else by the system's contact."""
    labelled = bool(np.any(play.stance))
    weight = np.asarray(play.stance if labelled else play.contact)[worst.frame]
    source = "as captured" if labelled else "by its contact weight"
    if worst.leg is not None:
        return f"The foot {'stands' if weight[worst.leg] > 0.5 else 'swings'} there, {source}."
    standing = [name for name, one in zip(legs, weight, strict=True) if one > 0.5]
    return f"There stand, {source}: {', '.join(standing) or 'none of the feet'}."


def _reach(play: Playback, worst: Worst) -> str:
    """Whether the targets could be reached."""
    part = f"in {share(worst.out_of_reach, 0)} of these frames and feet"
    if worst.leg is None:
        return f"The target of the ankle is out of reach {part}."
    missed = np.asarray(play.reached)[worst.frame, worst.leg] < 0.5
    return f"The target of its ankle is {'out of' if missed else 'within'} reach; out of it {part}."


def _grounded(play: Playback, worst: Worst, legs: Sequence[str]) -> str:
    """How well the ground and the captured soles agree."""
    found = worst.ground
    if found is None:
        return "No captured foot is known to stand over ground, so the terrain is not checked."
    return (
        f"While they stand, captured soles are {_over(found.mean)} the ground on average "
        f"({100 * found.rms:.1f} cm rms; the {legs[found.leg]} one {_over(found.largest)} it at "
        f"{play.time[found.frame]:.2f} s): an error of the terrain or of the calibration, which no "
        "parameter removes."
    )


def _over(gap: float) -> str:
    return f"{100 * abs(gap):.1f} cm {'over' if gap > 0 else 'in'}"
