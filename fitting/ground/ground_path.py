"""The ground along a character's path: where to put its root, and a patch of it for pictures.

A flat animation keeps its root on its own floor. On a hill or on stairs that is metres away from
the ground, further than foot IK reaches. The root then follows the ground below it, smoothed over a
stride in both directions of time, so that it climbs stairs as evenly as a ramp and lags behind
nothing. Distances are for an adult; others' are as their legs.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Float64
from scipy.ndimage import convolve1d
from scipy.spatial import KDTree

from fitting.clips import contacts
from fitting.clips.clip import Clip
from fitting.clips.clip_frames import raised
from jaxik.world import body
from jaxik.world.grid import padded
from jaxik.world.terrain import HORIZON, Terrain, cast

Root = Literal["auto", "animation", "ground"]
ROOTS = get_args(Root)
STEP = 1.0  # m: ground further above or below the last one is a ceiling, or has to be fallen to
FALL = 2.0  # m/s, towards ground further below; a gap is crossed before its bottom counts
GROUND = 0.5  # fraction of a path with ground below it, from which it is a path over it
REACH = 0.35  # m between an animation's floor and ground that foot IK is left to correct
STRAY = 0.02  # fraction of stance frames that may be beyond `REACH`
FOLLOWING = 0.5  # of the ground's variation that remains under soles which follow it
SKY = HORIZON / 2  # m, above all ground
RAYS = 1024  # that are cast in one call
MISSING = "there is no ground below most of its path"
USUAL_STRIDE = 1.05  # s, where a clip shows none

MARGIN = 1.5  # m around the path of a patch, for an adult
FINEST = 0.025  # m between heights, for an adult
MAX_HEIGHTS = 40_000  # within the margin
MAX_CELLS = 200_000  # of the grid, which also covers what is further away
HEADROOM = 0.3  # m above the highest joint, where rays start: below a ceiling


@dataclass(frozen=True)
class RootChoice:
    """Where the root of a clip is put."""

    rise: Float64[np.ndarray, " frames"] | None
    """m, by which the character is raised from its floor; None leaves it as animated."""
    reason: str

    @property
    def root(self) -> str:
        """What chooses the same for the same flat animation: `animation` or `ground`."""
        return "animation" if self.rise is None else "ground"


AS_ANIMATED = RootChoice(None, "as animated")


def place_root(
    clip: Clip, terrain: Terrain, root: str = "auto", floor: float = 0.0
) -> tuple[Clip, RootChoice]:
    """The animation on its floor, and where to put its root on a terrain.

    Args:
        clip: the animation, y up.
        terrain: y up.
        root: `animation` leaves the root as it is. `ground` makes it follow the ground below it.
            `auto` leaves it where foot IK reaches the ground from the animation's floor; from a
            clip whose feet follow this terrain already, the ground is first taken out.
        floor: height of the floor on which the clip was animated, m.

    Raises:
        ValueError: no such root, or `ground` without ground below the path.
    """
    if root not in ROOTS:
        raise ValueError(f"root is {root!r}; wanted one of {', '.join(ROOTS)}")
    if root == "animation":
        return clip, AS_ANIMATED
    path = path_heights(clip, terrain, floor)
    if path is None:
        if root == "ground":
            raise ValueError(f"{clip.source}: {MISSING}, on which to put the root")
        return clip, RootChoice(None, f"as animated: {MISSING}")
    window = stride_seconds(clip) * clip.fps
    rise = np.concatenate([smooth(path[piece], window) for piece in clip.pieces]) - floor
    if root == "auto" and (above := _ground_under_stances(clip, terrain, path, floor)).size:
        heights, soles = above
        if np.mean(np.abs(heights) > REACH * body.ratio(clip.rig)) <= STRAY:
            return clip, RootChoice(None, f"as animated: the ground is {_range(heights)} its floor")
        if np.std(heights - soles) < FOLLOWING * np.std(heights):
            reason = "as animated: the clip follows this terrain already"
            return raised(clip, -rise), RootChoice(rise, reason)
    return clip, RootChoice(rise, f"on the ground below it, {_range(rise)} its floor")


def path_heights(
    clip: Clip, terrain: Terrain, floor: float = 0.0, pieces: Sequence[slice] | None = None
) -> Float64[np.ndarray, " frames"] | None:
    """Height of the ground below the pelvis in each frame, m; None with less than `GROUND` of it.

    The path starts on the ground that is next below `STEP` above the floor, or else on the highest
    one, and goes on from there: it passes under ceilings, and over gaps and holes at the height
    that it had before them. Where the clip has a cut, it starts anew.

    Args:
        clip: y up.
        terrain: y up.
        floor: height of the floor on which the clip was animated, m.
        pieces: the frames between cuts; None is the clip's own.
    """
    points = clip.positions_ws[:, clip.rig.pelvis]
    highest = heights_under(terrain, points, SKY)
    if np.mean(~np.isnan(highest)) < GROUND:
        return None
    step = step_height(clip)
    near = heights_under(terrain, points, floor + step)
    starts = np.full(len(points), np.nan)
    for piece in clip.pieces if pieces is None else pieces:
        start = near[piece] if not np.isnan(near[piece]).all() else highest[piece]
        starts[piece.start] = next(iter(start[~np.isnan(start)]), np.nan)
    starts[0] = next(iter(starts[~np.isnan(starts)]))
    fall = FALL * body.ratio(clip.rig) ** 0.5 / clip.fps
    # Paths of different lengths share a program.
    arrays = jnp.asarray(padded(points, points[-1])), jnp.asarray(padded(starts, np.nan))
    return np.asarray(_followed(terrain, *arrays, step, fall))[: len(points)]


def step_height(clip: Clip) -> float:
    """How far above the last ground the next one may be for this body, m: `STEP` for an adult."""
    return STEP * body.ratio(clip.rig)


def heights_under(
    terrain: Terrain, points_ws: Float64[np.ndarray, "*b 3"], start: float | np.ndarray
) -> Float64[np.ndarray, "*b"]:
    """Height of the first ground that rays from a height meet, m; NaN where there is none.

    Args:
        terrain: y up.
        points_ws: whose x and z the rays have, m.
        start: height at which they start, m, one or one for each point.
    """
    origins = np.array(points_ws)
    origins[..., 1] = start
    rays = origins.reshape(-1, 3)
    heights = [_heights(terrain, rays[i : i + RAYS]) for i in range(0, len(rays), RAYS)]
    return np.concatenate([np.empty(0), *heights]).reshape(origins.shape[:-1])


def _heights(terrain: Terrain, origins_ws: np.ndarray) -> np.ndarray:
    """`heights_under`, for `RAYS` rays at most; rays are added so that there is one program."""
    hit = cast(terrain, jnp.asarray(np.resize(origins_ws, (RAYS, 3))), jnp.inf)
    heights = np.where(np.asarray(hit.found) > 0, np.asarray(hit.point, np.float64)[:, 1], np.nan)
    return heights[: len(origins_ws)]


@jax.jit
def _followed(
    terrain: Terrain,
    points_ws: Float[Array, "frames 3"],
    starts: Float[Array, " frames"],
    step: ArrayLike,
    fall: ArrayLike,
) -> Float[Array, " frames"]:
    """Heights of the ground along a path, m.

    It starts at the heights `starts`, where they are not NaN; ground more than `step` below is
    fallen to, by `fall` a frame.
    """

    def advance(height: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        point, start = now
        height = jnp.where(jnp.isnan(start), height, start)
        hit = cast(terrain, point.at[1].set(height + step), jnp.inf)
        falling = jnp.maximum(hit.point[1], height - fall)
        below = jnp.where(height - hit.point[1] > step, falling, hit.point[1])
        height = jnp.where(hit.found > 0, below, height)
        return height, height

    return jax.lax.scan(advance, starts[0], (points_ws, starts))[1]


def smooth(
    heights: Float64[np.ndarray, " frames"], window: float
) -> Float64[np.ndarray, " frames"]:
    """Heights averaged over `window` frames by a Hann window, whose middle half weighs most.

    The average looks as far ahead as back, so that a ramp stays where it is. Before the first frame
    and after the last, heights stay as they are there.
    """
    half = max(1, round(window / 2))
    kernel = np.hanning(2 * half + 1)
    return convolve1d(heights, kernel / kernel.sum(), mode="nearest")


def stride_seconds(clip: Clip) -> float:
    """Duration of a stride, s: the median time from one touchdown of a foot to its next."""
    touchdowns = [
        [first for first, _ in contacts.runs(stance)] for stance in clip.stance_labels().T
    ]
    strides = [time for firsts in touchdowns for time in np.diff(firsts)]
    return (
        float(np.median(strides)) / clip.fps
        if strides
        else USUAL_STRIDE * body.ratio(clip.rig) ** 0.5
    )


def _ground_under_stances(
    clip: Clip, terrain: Terrain, path: np.ndarray, floor: float
) -> Float64[np.ndarray, "2 standing"]:
    """Heights of the ground below standing balls, and of these balls, m above the floor."""
    stance, balls = clip.stance_labels(), clip.joints_ws(3)
    ground = heights_under(
        terrain, balls, np.maximum(path[:, None], balls[..., 1]) + step_height(clip)
    )
    known = stance & clip.observed[:, None] & ~np.isnan(ground)
    return np.stack([ground[known], balls[known][:, 1]]) - floor


def _range(heights: np.ndarray) -> str:
    return f"{100 * heights.min():.0f} to {100 * heights.max():.0f} cm above"


@dataclass(frozen=True)
class GroundPatch:
    """Heights of the ground on a grid that is aligned with x and z."""

    corner: Float64[np.ndarray, "2"]
    """x and z of the first height, m."""
    spacing: float
    """m, in both directions."""
    heights: Float64[np.ndarray, "rows columns"]
    """m; rows follow z, columns x. NaN where there is no ground, and further from the path."""


def around_path(clip: Clip, terrain: Terrain) -> GroundPatch:
    """The ground around the path of a clip's pelvis.

    Rays start a little above the character, so that a roof is not ground.

    Args:
        clip: y up, of one frame or more.
        terrain: y up.
    """
    size = body.ratio(clip.rig)
    path = clip.positions_ws[:, clip.rig.pelvis][:, [0, 2]]
    tops = clip.positions_ws[..., 1].max(axis=1) + HEADROOM * size
    tree, margin = KDTree(path), MARGIN * size
    low, high = path.min(axis=0) - margin, path.max(axis=0) + margin
    extent = high - low
    spacing = max(FINEST * size, float(np.sqrt(extent[0] * extent[1] / MAX_CELLS)))
    points, near = _grid(low, high, spacing, tree, margin)
    if near.sum() > MAX_HEIGHTS:
        spacing *= float(np.sqrt(near.sum() / MAX_HEIGHTS))
        points, near = _grid(low, high, spacing, tree, margin)
    nearest = tree.query(points[near])[1]
    heights = np.full(points.shape[:2], np.nan)
    heights[near] = heights_under(terrain, np.insert(points[near], 1, 0.0, axis=1), tops[nearest])
    return GroundPatch(low, spacing, heights)


def _grid(
    low: np.ndarray, high: np.ndarray, spacing: float, tree: KDTree, margin: float
) -> tuple[Float64[np.ndarray, "rows columns 2"], Bool[np.ndarray, "rows columns"]]:
    """Points x, z of a grid, and which of them are near the path."""
    x, z = (np.arange(a, b + spacing, spacing) for a, b in zip(low, high, strict=True))
    points = np.stack(np.meshgrid(x, z), axis=-1)
    distance = tree.query(points, distance_upper_bound=margin)[0]
    return points, np.isfinite(distance)
