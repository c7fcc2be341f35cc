"""Draws a clip on its ground: skeletons, feet, and what the stages saw."""

import threading

import numpy as np
import viser
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import uniform_filter1d

from fitting.datasets import ground_patch
from fitting.datasets.ground_patch import GroundPatch
from fitting.datasets.terrain.meshes import grid_faces
from fitting.runtime.precision import in_float64
from fitting.viewer.lines import Lines
from fitting.viewer.solving import Drawn, Solved, Solver
from jaxik.world import body

GROUND = (150, 138, 116)
BONE, FOOT, OVERLAY, FINE = 0.016, 0.03, 0.012, 0.006  # m, thickness of lines
SQUARE = 0.5  # m, between lines on the ground
LIFT = np.array([0.0, 0.002, 0.0])  # m, of these lines, so that the ground does not hide them
STEADY = 1.0  # s, over which the camera averages the path that it follows
VIEW_FROM = np.array([1.9, 0.6, 1.5])  # m, from the pelvis, for an adult
ROOT = "/world"


class Figure:
    """The nodes of one clip; calls may come from several threads.

    The camera follows by moving the world and not the camera, so that it can be turned meanwhile.

    Args:
        server: of the page.
        solver: of the clip.
    """

    @in_float64
    def __init__(self, server: viser.ViserServer, solver: Solver):
        self.server, self.solver = server, solver
        clip = solver.take.animated
        self.frame_count, self.fps = clip.frame_count, clip.fps
        self.origin = solver.path_ws[0].copy()  # what is drawn has 32 bits
        frames = max(1, round(STEADY * clip.fps))
        self._path = uniform_filter1d(solver.path_ws, frames, axis=0, mode="nearest") - self.origin
        self._lines: dict[str, Lines] = {}
        self._nodes: dict[str, viser.LineSegmentsHandle] = {}
        self._lock, self._removed = threading.RLock(), False
        self._world = server.scene.add_frame(ROOT, show_axes=False)
        self.follows, self.frame = True, 0
        server.initial_camera.look_at = np.zeros(3)
        server.initial_camera.position = VIEW_FROM * body.ratio(clip.rig)
        server.initial_camera.up = (0.0, 1.0, 0.0)
        self._add_ground(ground_patch.around_path(clip, solver.take.terrain))
        self._put_motion("before", solver.before)
        if solver.captured is not None:
            self._put_motion("captured", solver.captured)

    def _add_ground(self, patch: GroundPatch) -> None:
        rows, columns = patch.heights.shape
        x, z = np.meshgrid(np.arange(columns), np.arange(rows))
        heights = np.nan_to_num(patch.heights)
        across = (patch.corner[0] + patch.spacing * x, heights, patch.corner[1] + patch.spacing * z)
        points = np.stack(across, axis=-1) - self.origin
        vertices = points.reshape(-1, 3)
        faces = grid_faces(rows, columns)
        known = np.isfinite(patch.heights).reshape(-1)
        faces = faces[known[faces].all(axis=-1)]
        self.server.scene.add_mesh_simple(
            f"{ROOT}/ground",
            vertices.astype(np.float32),
            faces.astype(np.uint32),
            color=GROUND,
            side="double",
        )
        grid = _grid(points + LIFT, np.isfinite(patch.heights), patch.spacing).astype(np.float32)
        if len(grid):
            self.server.scene.add_line_segments(
                f"{ROOT}/grid", grid, _linear(np.full(grid.shape, GROUND, np.uint8)), thickness=FINE
            )

    def show(self, solved: Solved) -> None:
        """Draws another solution, in the same frame."""
        with self._lock:
            if self._removed:
                return
            self._put_motion("after", solved.motion)
            for name, lines in solved.overlays.items():
                self._put(name, lines, OVERLAY, visible=False)
            self.draw(self.frame)

    def _put_motion(self, name: str, drawn: Drawn) -> None:
        self._put(name, drawn.bones, BONE)
        self._put(f"feet {name}", drawn.feet, FOOT)

    def _put(self, name: str, lines: Lines, thickness: float, *, visible: bool = True) -> None:
        """Keeps lines to be drawn, and makes a node for them, if there is none yet."""
        points = (lines.points - self.origin).astype(np.float32)
        colours = _linear(lines.colours)
        self._lines[name] = Lines(points, colours)
        if name not in self._nodes:
            self._nodes[name] = self.server.scene.add_line_segments(
                f"{ROOT}/{name}", points[0], colours[0], thickness=thickness, visible=visible
            )

    def set_visible(self, name: str, visible: bool) -> None:
        """Shows or hides a skeleton with its feet, or an overlay."""
        with self._lock:
            for node in (name, f"feet {name}"):
                if node in self._nodes:
                    self._nodes[node].visible = visible

    def draw(self, frame: int) -> None:
        """Draws a frame, by its index."""
        with self._lock, self.server.atomic():
            if self._removed:
                return
            self.frame = frame
            for name, node in self._nodes.items():
                points, colours = self._lines[name]
                node.points = points[frame]
                if not np.array_equal(node.colors, colours[frame]):
                    node.colors = colours[frame]
            if self.follows:
                self._world.position = -self._path[frame]

    def remove(self) -> None:
        """Takes everything off the page; whoever still draws then draws nothing."""
        with self._lock:
            self._removed = True
            self._world.remove()
            self._nodes.clear()


def _grid(
    points: Float[np.ndarray, "rows columns 3"],
    known: Bool[np.ndarray, "rows columns"],
    spacing: float,
) -> Float[np.ndarray, "lines 2 3"]:
    """Lines on the ground in both directions, which show how it rises and falls."""
    every = max(1, round(SQUARE / spacing))
    segments = []
    for way, there in ((points, known), (points.swapaxes(0, 1), known.T)):
        whole = there[::every, :-1] & there[::every, 1:]
        ends = np.stack([way[::every, :-1], way[::every, 1:]], axis=2)
        segments.append(ends[whole])
    return np.concatenate(segments)


def _linear(colours: UInt8[np.ndarray, "*any 3"]) -> UInt8[np.ndarray, "*any 3"]:
    """Colours of lines as viser wants them: it takes them for linear light, and brightens them."""
    parts = colours / 255.0
    light = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return np.round(255.0 * light).astype(np.uint8)
