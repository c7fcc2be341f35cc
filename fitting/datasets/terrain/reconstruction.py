"""Reconstruction from motion: what a captured clip's stances say of a ground that nobody measured.

Three kinds of ground are put through the stances: a plane, a smooth surface and level blocks on a
grid. Each is asked for the height of every stance when it knows the others only, and the simplest
kind that no other predicts clearly better is chosen.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float64, Int64

from fitting.datasets.clips import contacts, edit
from fitting.datasets.clips.clip import Clip
from fitting.datasets.clips.rigs import flat_frames

from . import block_grids, surfaces
from .block_grids import Footprints
from .surfaces import Surface

SOLE = 0.055  # m, ball joint over the sole: subject 03 of the CMU database in his shoes
# A foot stands on its toes where it is pitched down more than it usually is: by 5 degrees, and by
# three standard deviations, told from the median deviation, where slopes make the pitch vary.
TOES, DEVIATIONS = np.radians(5.0), 3.0 * 1.4826
NEAR = 0.3  # m, about a foot's length: a stance on toes is not asked where a flat one is as near
FEWEST = 4  # stances: three make a plane, and one tests it
SURFACE_KINDS = ("plane", "smooth", "blocks")  # the simplest first
Fit = Callable[[Footprints], Surface]


@dataclass(frozen=True)
class Stances:
    """Where feet stood, in the order of time."""

    leg: Int64[np.ndarray, " stances"]
    first: Int64[np.ndarray, " stances"]  # frames, both included
    last: Int64[np.ndarray, " stances"]
    points: Float64[np.ndarray, "stances 2"]  # m, (x, z) of the ball
    ankles: Float64[np.ndarray, "stances 2"]  # m, (x, z)
    heights: Float64[np.ndarray, " stances"]  # m, of the ground below it
    toes: Bool[np.ndarray, " stances"]  # with the heel in the air
    used: Bool[np.ndarray, " stances"]

    @property
    def footprints(self) -> Footprints:
        """Of the stances that are used."""
        used = self.used
        return Footprints(self.points[used], self.heights[used], self.ankles[used])


@dataclass(frozen=True)
class Prediction:
    """How well a kind of ground predicts each stance from the others."""

    errors: Float64[np.ndarray, " stances"]  # m, predicted - measured, of the used stances
    alone: Bool[np.ndarray, " stances"]  # on a block of its own: predicted from those next to it

    @property
    def rms(self) -> float:
        """m, over all stances."""
        return _rms(self.errors)

    @property
    def rms_shared(self) -> float:
        """m, over the stances that are not alone; NaN without any."""
        return _rms(self.errors[~self.alone])


@dataclass(frozen=True)
class Reconstruction:
    """The grounds that a clip's stances make, and which of them was chosen."""

    stances: Stances
    surfaces: Mapping[str, Surface]  # by kind
    predictions: Mapping[str, Prediction]
    grids: block_grids.RankedGrids
    chosen: str

    @property
    def surface(self) -> Surface:
        """The chosen one."""
        return self.surfaces[self.chosen]

    def extent(self, margin: float) -> tuple[Float64[np.ndarray, "2"], Float64[np.ndarray, "2"]]:
        """Lowest and highest (x, z) of all stances, m, with a margin around them."""
        points = self.stances.points
        return points.min(axis=0) - margin, points.max(axis=0) + margin


def reconstruct(clip: Clip, *, sole: float = SOLE, kind: str | None = None) -> Reconstruction:
    """The ground below a captured clip.

    Args:
        clip: over ground of any shape, y up. A stance is where its labels or its motion say so.
        sole: m, height of the ball joint over the sole. It shifts the whole ground.
        kind: of ground, of `SURFACE_KINDS`; None chooses by the error of prediction.

    Raises:
        ValueError: another kind, a clip without legs, too few stances.
    """
    if kind not in (None, *SURFACE_KINDS):
        raise ValueError(f"no kind of ground named {kind!r}; there are {list(SURFACE_KINDS)}")
    stances = find_stances(clip, sole)
    feet = stances.footprints
    if len(feet.balls) < FEWEST:
        raise ValueError(
            f"{clip.source}: {len(feet.balls)} stances; wanted {FEWEST} or more to tell a ground"
        )
    ranked = block_grids.search(feet)
    fits: dict[str, Fit] = {
        "plane": surfaces.fit_plane,
        "smooth": surfaces.fit_thin_plate,
        "blocks": partial(surfaces.fit_blocks, ranked),
    }
    tested = {name: leave_one_out(fit, feet) for name, fit in fits.items()}
    found = {name: fit(feet) for name, fit in fits.items()}
    return Reconstruction(stances, found, tested, ranked, choose(tested) if kind is None else kind)


def find_stances(clip: Clip, sole: float = SOLE) -> Stances:
    """Place and height of every stance of a clip.

    They are those of the ball while its foot is stillest, the median; frames in which a marker
    popped are left out. A foot on its toes often leans on an edge, or hangs over one: it is used
    only where no flat stance is near. ValueError where no foot ever stands.
    """
    clip = edit.mask_pops(clip)
    good = np.ones(clip.frame_count, bool) if clip.mask is None else clip.mask
    standing, ankles, balls = clip.stance_labels(), clip.joints_ws(2), clip.joints_ws(3)
    rows = []
    for leg in range(standing.shape[1]):
        for first, last in contacts.runs(standing[:, leg]):
            during = good.copy()
            during[:first] = during[last + 1 :] = False
            if during.any():
                still = flat_frames(ankles[:, leg], balls[:, leg], during)
                ball, ankle = (np.median(one[still, leg], axis=0) for one in (balls, ankles))
                foot = ball - ankle
                pitch = np.arctan2(foot[1], np.linalg.norm(foot[[0, 2]]))
                rows.append((first, leg, last, *ball, *ankle[[0, 2]], pitch))
    if not rows:
        raise ValueError(f"{clip.source}: no foot ever stands; wanted {FEWEST} stances or more")
    first, leg, last, x, y, z, *ankle, pitch = np.array(sorted(rows)).reshape(-1, 9).T
    for one in np.unique(leg):
        pitch[leg == one] -= np.median(pitch[leg == one])
    toes = -pitch > np.maximum(TOES, DEVIATIONS * np.median(np.abs(pitch)))
    points, ankles = (np.stack(pair, axis=-1) for pair in ((x, z), ankle))
    apart = np.linalg.norm(points[:, None] - points[~toes], axis=-1)
    used = ~toes | (apart > NEAR).all(axis=1)
    leg, first, last = (part.astype(np.int64) for part in (leg, first, last))
    return Stances(leg, first, last, points, ankles, y - sole, toes, used)


def leave_one_out(fit: Fit, feet: Footprints) -> Prediction:
    """Errors of a kind of ground at each stance when it was fitted to all the others.

    A grid of blocks is chosen anew each time among those around the one that all stances made.
    """
    errors, shared = np.zeros(len(feet.balls)), np.zeros(len(feet.balls), bool)
    for one in range(len(feet.balls)):
        surface, at = fit(feet.without(one)), feet.balls[[one]]
        errors[one] = surface.heights(at)[0] - feet.heights[one]
        shared[one] = surface.shared(at)[0]
    return Prediction(errors, ~shared)


def choose(tested: Mapping[str, Prediction]) -> str:
    """The simplest kind whose squared error is within one standard error of the least.

    The standard error is that of the mean difference, stance by stance, to the best kind: the rule
    of Breiman, Friedman, Olshen and Stone (1984), for errors of the same stances.
    """
    squares = {kind: tested[kind].errors ** 2 for kind in SURFACE_KINDS}
    best = min(SURFACE_KINDS, key=lambda kind: squares[kind].mean())
    for kind in SURFACE_KINDS:
        more = squares[kind] - squares[best]
        if more.mean() <= more.std() / np.sqrt(len(more)):
            return kind
    return best


def _rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(errors**2))) if errors.size else float("nan")
