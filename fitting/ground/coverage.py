"""How much ground a terrain has under the feet of a clip; what to do where it has little.

A terrain in another unit, with another axis up, or somewhere else, has no ground where the feet
stand; neither has a clip in another unit. Each of these mistakes is undone in turn, and what brings
ground under the feet, and takes none away that is near them, is the likely remedy. Lengths are
metres, y up.
"""

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64

from fitting.clips import guesses
from fitting.clips.clip import Clip
from fitting.runtime.declarations import keys
from jaxik.world import body
from jaxik.world.heightfield import Heightfield
from jaxik.world.surfaces import Mesh
from jaxik.world.terrain import Terrain

from .ground_path import SKY, heights_under, step_height
from .meshes import AS_IS, TerrainOptions

ENOUGH = 0.8  # fraction of stances with ground under them, from which the terrain is in place
LITTLE = 0.5  # below which there is nothing that could be fitted
PARTLY = 0.2  # above which the unit is right; also of those with ground near them
UNITS = (0.01, 0.001, 0.0254, 0.3048)  # m: centimetre, millimetre, inch, foot; by how usual
FACTORS = tuple(factor for unit in UNITS for factor in (unit, 1.0 / unit))

Points = Float64[np.ndarray, "points 3"]

FLAT = 0.05  # m between the lowest and the highest stance, below which ground is flat
MAX_TILT = np.radians(2.0)  # of a floor that is meant to be level
PLANE = 5  # stances, more than which may show how a floor is tilted


class GroundWarning(UserWarning):
    """There is little ground under the feet of a clip."""


class Box(NamedTuple):
    """Lowest and highest coordinates, m."""

    low: Float64[np.ndarray, "3"]
    high: Float64[np.ndarray, "3"]

    def __str__(self) -> str:
        sides = zip("xyz", self.low, self.high, strict=True)
        return ", ".join(f"{axis} {low:.2f} to {high:.2f}" for axis, low, high in sides) + " m"


@dataclass(frozen=True)
class Coverage:
    """How much ground there is under standing feet."""

    clip: str
    share: float
    """Fraction of the stance frames with ground at any height; 1 without stances."""
    feet: Box
    terrain: Box
    options: TerrainOptions
    """With which the terrain was read."""
    remedy: TerrainOptions | None
    """With which it has enough ground; None if nothing helps, or nothing needs to."""
    clip_scale: float | None = None
    """Metres per unit of the clip's file, which belong to the remedy; None leaves them."""

    @property
    def is_enough(self) -> bool:
        """Whether the terrain is in place."""
        return self.share >= ENOUGH

    def text(self, *, as_keys: bool = False) -> str:
        """What is wrong, where both are, and the likely remedy, in one line.

        Args:
            as_keys: whether options are spelled as in experiments, and not as on a command line.
        """
        remedy = "no other unit, up axis or offset helps: does the terrain cover the whole path?"
        if self.remedy is not None:
            changes = _changes(self.options, self.remedy, self.clip_scale, as_keys)
            remedy = f"likely remedy: {changes}"
        return (
            f"{self.clip}: there is ground under {100 * self.share:.1f} % of its standing feet: "
            f"the feet are at {self.feet}; the terrain is at {self.terrain}; {remedy}"
        )


def require(coverage: Coverage, *, as_keys: bool = True) -> None:
    """Raises ValueError where there is too little ground for a fit; warns where there is little."""
    if coverage.share < LITTLE:
        raise ValueError(coverage.text(as_keys=as_keys))
    warn(coverage, as_keys=as_keys)


def warn(coverage: Coverage, *, as_keys: bool = False) -> None:
    """Warns where there is little ground."""
    if not coverage.is_enough:
        warnings.warn(coverage.text(as_keys=as_keys), GroundWarning, stacklevel=3)


def measure(
    clip: Clip,
    terrain: Terrain,
    options: TerrainOptions = AS_IS,
    reload: Callable[[TerrainOptions], Terrain] | None = None,
) -> Coverage:
    """How much ground there is under the standing feet of a clip, and what would bring more.

    Args:
        clip: on its floor, or captured.
        terrain: y up.
        options: with which it was read.
        reload: reads it with others; None tries no other up axis.
    """
    stance, balls = clip.stance_labels(), clip.joints_ws(3)
    feet = np.concatenate([clip.joints_ws(2), balls], axis=1).reshape(-1, 3)
    standing = balls[stance & clip.observed[:, None]]
    share = _share(terrain, standing) if len(standing) else 1.0
    remedy, clip_scale = None, None
    if share < ENOUGH:
        clip_scale = None if clip.source.lower().endswith(".npz") else _person_scale(clip)
        factor = 1.0 if clip_scale is None else clip_scale / clip.scale
        stances = _Stances(factor * standing, factor * step_height(clip))
        ground = _Ground(terrain, options)
        if clip_scale is not None and stances.are_over(terrain):
            remedy = options
        else:
            before = stances.near(terrain)
            stances = replace(stances, enough_near=before if before >= PARTLY else 0.0)
            remedy = _find_remedy(stances, ground, reload, share < PARTLY)
        clip_scale = None if remedy is None else clip_scale
    box = Box(feet.min(axis=0), feet.max(axis=0))
    return Coverage(clip.source, share, box, bounds(terrain), options, remedy, clip_scale)


def _person_scale(clip: Clip) -> float | None:
    """Metres per unit of the clip's file that make its body a person's; None where others do."""
    return guesses.likelier(body.leg_length(clip.rig) / clip.scale, clip.scale)


def bounds(terrain: Terrain) -> Box:
    """The box around all surfaces; infinite around planes and functions."""
    points = np.concatenate([_extremes(surface) for surface in terrain.surfaces])
    return Box(points.min(axis=0), points.max(axis=0))


@dataclass(frozen=True)
class _Stances:
    """Balls of standing feet, m, and what ground they need."""

    points: Points
    step: float
    """m, difference in height that is near, and that needs no offset."""
    enough_near: float = 0.0
    """Fraction of the points that need ground near them."""

    def near(self, terrain: Terrain) -> float:
        """Fraction of the points that have ground near them."""
        heights = heights_under(terrain, self.points, self.points[:, 1] + self.step)
        return float(np.mean(heights >= self.points[:, 1] - self.step))  # NaN is not

    def are_over(self, terrain: Terrain) -> bool:
        """Whether they have the ground that they need."""
        covered = _share(terrain, self.points) >= ENOUGH
        return covered and self.near(terrain) >= self.enough_near

    def moved(self, offset: np.ndarray) -> "_Stances":
        """Relative to a terrain that is moved by an offset, m."""
        return replace(self, points=self.points - offset)

    def scaled(self, factor: float) -> "_Stances":
        """As many times as large."""
        return replace(self, points=self.points * factor, step=self.step * factor)


class _Ground(NamedTuple):
    """A terrain, and the options with which it was read."""

    terrain: Terrain
    options: TerrainOptions


def _find_remedy(
    stances: _Stances,
    ground: _Ground,
    reload: Callable[[TerrainOptions], Terrain] | None,
    any_unit: bool,
) -> TerrainOptions | None:
    """The first change of the options that brings enough ground under feet; None if none does.

    Args:
        stances: where they stand.
        ground: as it was read.
        reload: reads it with other options.
        any_unit: whether other units of length are tried.
    """
    if stances.enough_near:  # axis and unit are right
        reload, any_unit = None, False
    grounds = [ground, *_turned(ground, reload)]
    for other in grounds[1:]:
        if stances.are_over(other.terrain):
            return other.options
    grounds.sort(key=lambda each: float(_size(each.terrain)[1]))  # one that stands upright is last
    for terrain, options in grounds:
        offset, scale = np.array(options.offset), options.terrain_scale or 1.0
        too_small = (_size(terrain) < np.ptp(stances.points, axis=0))[[0, 2]].any()
        for factor in FACTORS if any_unit else ():
            if factor > 1.0 and not too_small:
                continue
            if stances.moved(offset).scaled(1.0 / factor).moved(-offset).are_over(terrain):
                return replace(options, terrain_scale=scale * factor)
    for terrain, options in grounds:
        moved = _offset_to(terrain, stances)
        if moved is not None and stances.moved(moved).are_over(terrain):
            x, y, z = (float(value) + 0.0 for value in np.round(options.offset + moved, 2))
            return replace(options, terrain_offset=(x, y, z))
    return None


def _turned(
    ground: _Ground, reload: Callable[[TerrainOptions], Terrain] | None
) -> Iterator[_Ground]:
    """The terrain with the other axis of its file up; nothing where that is not possible."""
    if reload is None:
        return
    options = replace(ground.options, file_up="z" if ground.options.file_up == "y" else "y")
    try:
        yield _Ground(reload(options), options)
    except ValueError:  # a heightfield, or a mesh of walls alone
        return


def _size(terrain: Terrain) -> Float64[np.ndarray, "3"]:
    low, high = bounds(terrain)
    return high - low


def _offset_to(terrain: Terrain, stances: _Stances) -> np.ndarray | None:
    """By how much to move a terrain to have its middle under the feet, m; None if it does not help.

    It is moved in height where it is further from the feet than a step.
    """
    low, high = bounds(terrain)
    standing, step = stances.points, stances.step
    if not np.isfinite([low, high]).all():
        return None
    lowest, highest = standing.min(axis=0), standing.max(axis=0)
    offset = ((lowest + highest) - (low + high)) / 2 * [1.0, 0.0, 1.0]
    heights = heights_under(terrain, standing - offset, SKY)
    if np.isnan(heights).all():
        return None
    rise = float(np.nanmedian(standing[:, 1] - heights))
    return offset + [0.0, rise if abs(rise) > step else 0.0, 0.0]


def _share(terrain: Terrain, points: Points) -> float:
    """Fraction of points with ground at any height."""
    return float(np.mean(~np.isnan(heights_under(terrain, points, SKY))))


def _extremes(surface: object) -> Points:
    """Two corners of the box around a surface, m."""
    match surface:
        case Mesh():
            vertices, triangles, _ = surface.on_host()
            points = vertices[triangles.reshape(-1)].astype(np.float64)
            return np.stack([points.min(axis=0), points.max(axis=0)])
        case Heightfield():
            heights = np.asarray(surface.heights, np.float64)
            rows, columns = heights.shape
            x, z = np.asarray(surface.spacing) * [columns - 1, rows - 1]
            corners = np.array([[0.0, np.nanmin(heights), 0.0], [x, np.nanmax(heights), z]])
            return np.asarray(surface.origin_ws) + corners @ np.asarray(surface.axes_ws)
        case _:
            return np.array([[-np.inf] * 3, [np.inf] * 3])


def _changes(
    old: TerrainOptions, new: TerrainOptions, clip_scale: float | None, as_keys: bool
) -> str:
    """The scale of the clip and the options in which two differ, as a user writes them."""
    changes = []
    if clip_scale is not None:
        changes.append(f"scale = {clip_scale:.10g}" if as_keys else f"--scale {clip_scale:.10g}")
    for name in keys(TerrainOptions):
        if (value := getattr(new, name)) == getattr(old, name):
            continue
        numbers = [f"{number:.10g}" for number in np.atleast_1d(value)] if name != "file_up" else []
        if as_keys:
            text = repr(value).replace("'", '"') if not numbers else ", ".join(numbers)
            changes.append(f"{name} = {f'[{text}]' if len(numbers) > 1 else text}")
        else:
            changes.append(f"--{name.replace('_', '-')} {' '.join(numbers) or value}")
    return ", ".join(changes) if as_keys else " ".join(changes)


def relief(places: Float[np.ndarray, "stances 2"], ground: Float[np.ndarray, " stances"]) -> float:
    """By how much the ground differs between stances, m; a floor that is tilted a little is flat.

    Args:
        places: of the stances in the ground plane, m.
        ground: its height there, m.

    Returns:
        Infinite where there is no stance.
    """
    if not len(ground):
        return np.inf
    rest = ground - ground.mean()
    if len(ground) > PLANE:
        columns = np.column_stack([places - places.mean(axis=0), np.ones(len(places))])
        plane = np.linalg.lstsq(columns, rest, rcond=None)[0]
        if np.hypot(*plane[:2]) < np.tan(MAX_TILT):
            rest = rest - columns @ plane
    return float(np.ptp(rest))
