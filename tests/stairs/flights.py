"""Random flights of stairs as they are built: their profile, and the terrain that it makes."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from jaxik.world import terrain
from jaxik.world.terrain import Terrain

RISERS = ("vertical", "leaning", "rounded", "open")
STEPS, ROUNDING = 8, 4  # steps, and chords of a rounded edge
POINTS = ROUNDING + 2  # of the profile, for each step
BEFORE, BEYOND, HALF_WIDTH = -3.0, 17.0, 14.0  # m
LANDING = 1.2  # m
OVERLAP = 0.02  # m, by which an open tread reaches under the next
SPACING = 0.01  # m, between heights of a field
ROWS, COLUMNS = 2001, 81  # of a field, as in the suite
TOUCH = 0.01  # m, to either side, within which an edge may be for a point to touch it
SLACK = 2.0 * BEYOND


@dataclass(frozen=True)
class Flight:
    """A flight of stairs along z, up or down, and how it is crossed."""

    riser: str
    tread: float
    """Metres."""
    rise: float
    """m, of each step."""
    depth: float
    """m, by which risers lean, or radius of their rounded edges."""
    landing: bool
    """Whether the tread in the middle is a landing."""
    down: bool
    field: bool
    """Whether it is a heightfield, or else a mesh."""
    start: float
    """m, from where the walk begins."""
    heading: float
    """rad, of the walk from straight across."""
    phase: float
    """0..1, of the walk in its first frame."""

    def edges(self) -> Float64[np.ndarray, " steps"]:
        """z at which each step up begins, m from the first."""
        treads = np.full(STEPS, self.tread)
        if self.landing:
            treads[STEPS // 2] = LANDING
        return np.concatenate([[0.0], np.cumsum(treads)[:-1]])

    def profile(self) -> Float64[np.ndarray, "points 2"]:
        """Distance from where the walk begins and height, m, of its corners seen from above."""
        depth, rise = self.depth, self.rise
        angles = np.linspace(0.0, np.pi / 2, ROUNDING + 1)
        round_edge = np.stack([depth * (1 - np.cos(angles)), depth * np.sin(angles) - depth], 1)
        lean = np.linspace([0.0, 0.0], [depth, rise], POINTS)
        corner = {
            "rounded": np.concatenate([[[0.0, 0.0]], round_edge + [0.0, rise]]),
            "leaning": lean,
        }.get(self.riser, lean * [0.0, 1.0])
        steps = [corner + [edge, rise * n] for n, edge in enumerate(self.edges())]
        ends = np.array([[BEFORE - 1.0, 0.0], [BEYOND, rise * STEPS]])
        points = np.concatenate([ends[:1], *steps, ends[1:]])
        if self.down:
            points = points[::-1] * [-1.0, 1.0] - [0.0, rise * STEPS]
            points[:, 0] += self.edges()[-1]
            points[[0, -1], 0] = ends[:, 0]
        return points + [self.start, 0.0]

    def heights(self, z: np.ndarray) -> np.ndarray:
        """Height of the ground at these places, m."""
        points = self.profile()
        steps = np.diff(points[:, 0]) < 1e-9
        apart = points[:, 0] + 1e-7 * np.concatenate([[0], np.cumsum(steps)])
        if self.field:
            grid = np.linspace(BEFORE, BEYOND, ROWS)
            return np.interp(z, grid, np.interp(grid, apart, points[:, 1]))
        return np.interp(z, apart, points[:, 1])

    def levels(self, z: np.ndarray) -> np.ndarray:
        """Height of the way at these places, m, which the root follows."""
        return self.heights(z)

    def clearances(self, points_ws: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far points are above the ground and in it, m; both within `TOUCH` of an edge."""
        near = [self.heights(points_ws[..., 2] + away) for away in (-TOUCH, 0.0, TOUCH)]
        height = points_ws[..., 1]
        return np.maximum(height - np.max(near, 0), 0.0), np.maximum(np.min(near, 0) - height, 0.0)

    def quads(self) -> Float64[np.ndarray, "quads 2 2"]:
        """Both ends of each strip of the mesh: z and height, m."""
        points = self.profile()
        quads = np.stack([points[:-1], points[1:]], axis=1)
        if self.riser == "open":
            walls = quads[:, 0, 0] == quads[:, 1, 0]
            treads = quads.copy()
            towards = int(self.down)  # the end of each tread from which it goes down
            under = OVERLAP * (1.0 if self.down else -1.0)
            hidden = 1 - towards
            treads[:, hidden, 0] -= under
            quads = np.where(walls[:, None, None], quads[:, :1], treads)
        return quads

    def vertices(self) -> Float64[np.ndarray, "vertices 3"]:
        """Of the mesh, four for each strip."""
        ends = self.quads()[:, :, None]
        x = np.array([-HALF_WIDTH, HALF_WIDTH])[None, None, :]
        z, y = (np.broadcast_to(ends[..., axis], (*ends.shape[:2], 2)) for axis in (0, 1))
        return np.stack([np.broadcast_to(x, z.shape), y, z], -1).reshape(-1, 3)

    def field_heights(self) -> Float64[np.ndarray, "rows columns"]:
        """Of the heightfield, whose rows are `SPACING` apart."""
        return np.repeat(self.heights(np.linspace(BEFORE, BEYOND, ROWS))[:, None], COLUMNS, axis=1)


def sample(rng: np.random.Generator, field: bool) -> Flight:
    """A random flight that is built as stairs are: steep ones have narrow treads."""
    tread = rng.uniform(0.20, 0.35)
    return Flight(
        riser=str(rng.choice(RISERS[:3] if field else RISERS)),
        tread=tread,
        rise=float(np.clip(0.5 * (rng.uniform(0.60, 0.65) - tread), 0.13, 0.21)),
        depth=rng.uniform(0.01, 0.02),
        landing=bool(rng.uniform() < 0.3),
        down=bool(rng.uniform() < 0.5),
        field=field,
        start=rng.uniform(0.3, 1.3),
        heading=float(rng.uniform(-0.7, 0.7) * (rng.uniform() < 0.4)),
        phase=rng.uniform(),
    )


def mesh_of(flight: Flight) -> Terrain:
    """A mesh that every flight's vertices can be given to."""
    vertices = flight.vertices()
    first = 4 * np.arange(len(vertices) // 4)[:, None]
    triangles = np.concatenate([first + [0, 1, 2], first + [2, 1, 3]])
    return terrain.mesh(vertices.astype(np.float32), triangles, slack=SLACK)


def field_of(heights: np.ndarray) -> Terrain:
    """A heightfield of these heights."""
    spacing = (2.0 * HALF_WIDTH / (COLUMNS - 1), SPACING)
    return terrain.heightfield(heights, spacing, origin=(-HALF_WIDTH, 0.0, BEFORE))
