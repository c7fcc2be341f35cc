"""Reconstructs the ground below a captured clip from where its feet stood.

Three kinds of surface are fitted to the footprints: a plane, a smooth thin plate and level blocks
on a grid. Each predicts the height of every footprint from the others, and the simplest kind that
no other predicts clearly better is chosen.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import KDTree

from fitting.datasets.clips import contacts, edit
from fitting.datasets.clips.clip import Clip
from fitting.datasets.clips.rigs import flat_frames

from . import block_grids, surfaces
from .block_grids import Footprints, RankedGrids
from .surfaces import Surface

# A foot is on its toes where it is pitched down more than usual: by 5 degrees, and by three
# standard deviations (estimated from the median absolute deviation), as slopes make pitch vary.
TOE_PITCH, TOE_DEVIATIONS = np.radians(5.0), 3.0 * 1.4826
NEAR = 0.3  # m, about a foot's length: a stance on toes is not used if a flat one is as near
MIN_STANCES = 4  # three determine a plane, and one tests it
MOST_STANCES = 300  # evenly chosen where there are more: all kinds are fitted in some minutes
WIDEST = 1000.0  # m, between stances
SURFACE_KINDS = ("plane", "smooth", "blocks")  # from simple to complex
SurfaceFit = Callable[[Footprints], Surface]


@dataclass(frozen=True)
class Stances:
    """Where feet stood, in order of time."""

    leg: Int64[np.ndarray, " stances"]
    """Index."""
    first: Int64[np.ndarray, " stances"]
    """Frame."""
    last: Int64[np.ndarray, " stances"]
    """Frame, included."""
    points: Float64[np.ndarray, "stances 2"]
    """m, (x, z) of the ball."""
    ankles: Float64[np.ndarray, "stances 2"]
    """m, (x, z)."""
    heights: Float64[np.ndarray, " stances"]
    """m, of the ground below the ball."""
    toes: Bool[np.ndarray, " stances"]
    """True where the heel is in the air."""
    used: Bool[np.ndarray, " stances"]
    """True where the surfaces are fitted to it."""

    @property
    def footprints(self) -> Footprints:
        """The stances that are used."""
        used = self.used
        return Footprints(self.points[used], self.heights[used], self.ankles[used])


@dataclass(frozen=True)
class Prediction:
    """How well a kind of surface predicts each used stance from the others."""

    errors: Float64[np.ndarray, " stances"]
    """m, predicted minus measured."""
    alone: Bool[np.ndarray, " stances"]
    """No other stance on its block: predicted from neighbours."""

    @property
    def rms(self) -> float:
        """Root mean square error over all used stances, m."""
        return _rms(self.errors)

    @property
    def rms_shared(self) -> float:
        """Root mean square error over stances that share their block, m; NaN without any."""
        return _rms(self.errors[~self.alone])


@dataclass(frozen=True)
class Reconstruction:
    """The surfaces fitted to a clip's stances, and which of them was chosen."""

    stances: Stances
    surfaces: Mapping[str, Surface]
    """By kind."""
    predictions: Mapping[str, Prediction]
    """By kind."""
    grids: RankedGrids
    chosen: str
    """Kind."""
    sole: float
    """m, height of the ball joints above the soles."""

    @property
    def surface(self) -> Surface:
        """The chosen surface."""
        return self.surfaces[self.chosen]

    def extent(self, margin: float) -> tuple[Float64[np.ndarray, "2"], Float64[np.ndarray, "2"]]:
        """Lowest and highest (x, z) of all stances, m, with a margin around them."""
        points = self.stances.points
        return points.min(axis=0) - margin, points.max(axis=0) + margin


def reconstruct(
    clip: Clip, *, sole: float | None = None, kind: str | None = None
) -> Reconstruction:
    """The ground below a captured clip.

    Args:
        clip: over ground of any shape, with y up.
        sole: m, height of the ball joints above the soles; it shifts the whole ground. None is the
            mean of the rig's.
        kind: which of `SURFACE_KINDS` to choose; None chooses by cross-validation.

    Raises:
        ValueError: an unknown kind, a clip without legs, too few stances, or some too far apart.
    """
    if kind not in (None, *SURFACE_KINDS):
        raise ValueError(f"no kind of ground named {kind!r}; there are {list(SURFACE_KINDS)}")
    if sole is None:
        sole = float(np.mean(np.asarray(clip.rig.ball_height)))
    stances = find_stances(clip, sole)
    feet = stances.footprints
    if len(feet.balls) < MIN_STANCES:
        raise ValueError(
            f"{clip.source}: {len(feet.balls)} stances; reconstruction needs {MIN_STANCES} or more"
        )
    places = np.column_stack([feet.balls, feet.heights])
    if (extent := np.ptp(places, axis=0).max()) > WIDEST:
        raise ValueError(
            f"{clip.source}: its stances are up to {extent:.4g} m apart; wanted at most {WIDEST:g}"
        )
    stances = thin_out(stances)
    feet = stances.footprints
    grids = block_grids.search(feet)
    fits: dict[str, SurfaceFit] = {
        "plane": surfaces.fit_plane,
        "smooth": surfaces.fit_thin_plate,
        "blocks": partial(surfaces.fit_blocks, grids),
    }
    predictions = {name: leave_one_out(fit, feet) for name, fit in fits.items()}
    fitted = {name: fit(feet) for name, fit in fits.items()}
    chosen = choose(predictions) if kind is None else kind
    return Reconstruction(stances, fitted, predictions, grids, chosen, sole)


def find_stances(clip: Clip, sole: float) -> Stances:
    """Position and height of every stance of a clip.

    They are medians over the frames in which the foot is stillest, without frames in which a marker
    popped. A foot on its toes often leans on an edge or hangs over one, so it is used only if no
    flat stance is near.

    Raises:
        ValueError: no foot ever stands.
    """
    clip = edit.mask_pops(clip)
    standing, ankles, balls = clip.stance_labels(), clip.joints_ws(2), clip.joints_ws(3)
    records = []
    for leg in range(standing.shape[1]):
        for first, last in contacts.runs(standing[:, leg]):
            beside = slice(max(first - 1, 0), last + 2)  # a frame before and after, for speeds
            frames = np.arange(beside.start, min(beside.stop, clip.frame_count))
            good = clip.observed[beside] & (first <= frames) & (frames <= last)
            if good.any():
                here = ankles[beside, leg], balls[beside, leg]
                flat = flat_frames(here[0], here[1], good)
                ankle, ball = (np.median(joint[flat], axis=0) for joint in here)
                foot = ball - ankle
                pitch = np.arctan2(foot[1], np.linalg.norm(foot[[0, 2]]))
                records.append((first, leg, last, *ball, *ankle[[0, 2]], pitch))
    if not records:
        raise ValueError(
            f"{clip.source}: no foot ever stands; wanted {MIN_STANCES} stances or more"
        )
    first, leg, last, x, y, z, *ankle, pitch = np.array(sorted(records)).reshape(-1, 9).T
    for index in np.unique(leg):
        pitch[leg == index] -= np.median(pitch[leg == index])
    toes = -pitch > np.maximum(TOE_PITCH, TOE_DEVIATIONS * np.median(np.abs(pitch)))
    points, ankles = (np.stack(pair, axis=-1) for pair in ((x, z), ankle))
    distance_to_flat = np.full(len(points), np.inf)
    if not toes.all():
        distance_to_flat, _ = KDTree(points[~toes]).query(points)
    used = ~toes | (distance_to_flat > NEAR)
    leg, first, last = (column.astype(np.int64) for column in (leg, first, last))
    return Stances(leg, first, last, points, ankles, y - sole, toes, used)


def thin_out(stances: Stances) -> Stances:
    """The stances, of which no more than `MOST_STANCES` are used, chosen evenly in time.

    A surface takes time by the cube of their number, and is fitted without each of them.
    """
    used = np.flatnonzero(stances.used)
    if len(used) <= MOST_STANCES:
        return stances
    chosen = used[np.linspace(0, len(used) - 1, MOST_STANCES).round().astype(int)]
    return replace(stances, used=np.isin(np.arange(len(stances.used)), chosen))


def leave_one_out(fit: SurfaceFit, feet: Footprints) -> Prediction:
    """How well a kind of surface predicts each footprint when it is fitted to all the others.

    For blocks, the grid is chosen anew each time among the candidates found from all footprints.
    """
    errors, supported = np.zeros(len(feet.balls)), np.zeros(len(feet.balls), bool)
    for index in range(len(feet.balls)):
        surface, point = fit(feet.without(index)), feet.balls[[index]]
        errors[index] = surface.heights(point)[0] - feet.heights[index]
        supported[index] = surface.supported(point)[0]
    return Prediction(errors, ~supported)


def choose(predictions: Mapping[str, Prediction]) -> str:
    """The simplest kind whose squared error is within one standard error of the smallest.

    The standard error is that of the mean difference to the best kind, stance by stance: the
    one-standard-error rule of Breiman, Friedman, Olshen and Stone, "Classification and regression
    trees" (1984), for paired errors.
    """
    squares = {kind: predictions[kind].errors ** 2 for kind in SURFACE_KINDS}
    best = min(SURFACE_KINDS, key=lambda kind: squares[kind].mean())
    for kind in SURFACE_KINDS:
        excess = squares[kind] - squares[best]
        if excess.mean() <= excess.std() / np.sqrt(len(excess)):
            return kind
    return best


def _rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(errors**2))) if errors.size else float("nan")
