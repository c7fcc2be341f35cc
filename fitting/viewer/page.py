"""A session on a page: moves of sliders become solutions, and these become pictures."""

import contextlib
import functools
import io
import re
import socket
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from itertools import groupby
from pathlib import Path

import numpy as np
import viser
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import uniform_filter1d
from websockets.asyncio import server as asyncio_server

import jaxik
from fitting.ground import ground_path
from fitting.ground.ground_path import GroundPatch
from fitting.ground.meshes import grid_faces
from fitting.report.formatting import figures_table, markdown, transposed
from fitting.report.sliders import Slider, sliders
from fitting.runtime.precision import in_float64
from jaxik.world import body

from . import tuning
from .session import Lines, Session
from .solving import NAMES, SKELETONS, Drawn, Solved, Solver
from .tuning import Tuning

GROUND = (150, 138, 116)
BONE, FOOT, OVERLAY, FINE = 0.016, 0.03, 0.012, 0.006  # m, thickness of lines
SQUARE = 0.5  # m, between lines on the ground
LIFT = np.array([0.0, 0.002, 0.0])  # m, of these lines, so that the ground does not hide them
STEADY = 1.0  # s, over which the camera averages the path that it follows
VIEW_FROM = np.array([1.9, 0.6, 1.5])  # m, from the pelvis, for an adult
ROOT = "/world"

SKELETON_LABELS = {
    "before": "Before: flat animation (grey)",
    "after": "After: solved (blue)",
    "captured": "Captured (orange)",
}
SPEEDS = ("0.1", "0.25", "0.5", "1", "2")
Moved = Callable[[Slider, float | bool], object]

RATE = 30.0  # Hz, at which frames are drawn at most

MARKS = re.compile(r"([\\`*_{}\[\]<>()#+.!|~&-])")
MEASURES = "penetration", "contact", "slide"  # of each motion

ANY_PORT = 0
OWN = re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?")
"""Origins of pages that this machine serves."""


class Viewer:
    """The page of a session, until it is closed.

    Args:
        server: of an empty page.
        session: what is viewed.
        folder: where Save writes.
    """

    def __init__(self, server: viser.ViserServer, session: Session, folder: Path):
        self.server, self.session, self.folder = server, session, folder
        self.tuning = Tuning(session.starts)
        self.solver = Solver(session)
        self.solved: Solved | None = None
        self._compiled: Solver | None = None  # whose programs are
        self.costs: dict[str, float] = {}
        """Of the systems to go back to, as far as they are known."""
        self._lock = threading.RLock()
        self._figure = Figure(server, self.solver)
        self._build_panel()
        clip = self.solver.animation.placed_clip
        self._player = Player(clip.seconds, self._draw_time)
        self._latest = Latest(self._solve)
        self._connect()
        self._latest.request()

    def _build_panel(self) -> None:
        gui, clip = self.server.gui, self.solver.animation.placed_clip
        gui.add_markdown(f"**{literal(self.session.title)}**")
        if len(self.session.clips) > 1:
            names = tuple(clip.name for clip in self.session.clips)
            choice = gui.add_dropdown("Clip", names)
            choice.on_update(lambda _: self._choose(names.index(choice.value)))
        self._history = HistoryPanel(gui, self.tuning.starts)
        self._time = TimePanel(gui, clip.frame_count)
        self._layers = LayerPanel(gui, any(clip.animation.captured for clip in self.session.clips))
        every = sliders(self.tuning.ik, self.session.rig, self.session.free)
        self._sliders = SliderPanel(gui, every, self.tuning.ik, self._move)

    def _connect(self) -> None:
        times, history = self._time, self._history
        times.play.on_update(lambda _: self._player.play(times.play.value))
        times.frame.on_update(lambda event: event.client and self._seek(times.frame.value))
        times.speed.on_update(lambda _: setattr(self._player, "speed", float(times.speed.value)))
        times.follow.on_update(lambda _: setattr(self._figure, "follows", times.follow.value))
        for box in self._layers.boxes.values():
            box.on_update(lambda _: self._update_layers())
        history.step.on_click(lambda _: self._step(history.step.value))
        history.reset.on_click(lambda _: self.reset(history.reset.value))
        history.save.on_click(lambda _: self.save())

    def wait(self, seconds: float | None = None) -> bool:
        """Waits until what was moved is solved and drawn; False if that takes longer."""
        return self._latest.wait(seconds)

    def reset(self, name: str) -> None:
        """Goes back to one of the session's systems."""
        with self._lock:
            self.tuning.reset(name)
        self._moved()

    def restart(self, name: str, ik: jaxik.FootIK, note: str) -> None:
        """Begins anew with another system, as a fit that goes on finds better ones."""
        with self._lock:
            self.tuning.restart(name, ik)
        self._history.reset.options = tuple(self.tuning.starts)
        self._history.message.content = literal(note)
        self._moved()

    def save(self) -> None:
        """Writes the system as it is, and reports what was written."""
        session = self.session
        try:
            with self._lock:
                messages = tuning.save(
                    self.folder, self.tuning.ik, session.preset, session.leg_length,
                    drop=self._history.drop.value,
                )  # fmt: skip
        except ValueError as error:
            messages = [str(error)]
        self._history.message.content = "\n\n".join(map(literal, messages))

    def close(self) -> None:
        """Ends its threads."""
        self._player.close()
        self._latest.close()

    def _move(self, slider: Slider, value: float | bool) -> None:
        try:
            with self._lock:
                ik = slider.write(self.tuning.ik, value)
                self.tuning.change(ik, slider.name, time.monotonic())
        except ValueError as error:
            self._history.message.content = literal(str(error))
        self._latest.request()

    def _step(self, way: str) -> None:
        with self._lock:
            (self.tuning.undo if way == "Undo" else self.tuning.redo)()
        self._moved()

    def _moved(self) -> None:
        self._sliders.follow(self.tuning.ik)
        self._latest.request()

    def _solve(self) -> None:
        with self._lock:
            ik, solver, figure = self.tuning.ik, self.solver, self._figure
        try:
            if solver is not self._compiled:
                self._history.cost.content = "Compiling, which takes a while the first time …"
                solver.solve(ik)
                self._compiled = solver
            solved = solver.solve(ik)
        except (ValueError, RuntimeError) as error:  # JAX raises the latter without memory
            self._history.cost.content = f"**{literal(str(error))}**"
            return
        if solver is not self.solver:
            return  # another clip was chosen meanwhile, which requests its own solution
        self.solved = solved
        figure.show(solved)
        self._update_layers()
        for name, start in self.tuning.starts.items():
            if start is ik and solved.cost is not None:
                self.costs[name] = solved.cost
        self._history.cost.content = cost_text(solver, solved, self.costs)

    def _draw_time(self, seconds: float) -> None:
        figure = self._figure
        frame = min(round(seconds * figure.fps), figure.frame_count - 1)
        figure.draw(frame)
        self._time.frame.value = frame

    def _seek(self, frame: int) -> None:
        self._player.seek(frame / self._figure.fps)

    def _update_layers(self) -> None:
        for name, box in self._layers.boxes.items():
            self._figure.set_visible(name, box.value)

    def _choose(self, number: int) -> None:
        """Shows another clip of the session."""
        with self._lock:
            solver = Solver(self.session, number)
            self._figure.remove()
            self.solver, self._figure = solver, Figure(self.server, solver)
            self._figure.follows = self._time.follow.value
            self._update_layers()
            clip = solver.animation.placed_clip
            self._player.seconds = clip.seconds
            self._time.frame.max = max(clip.frame_count - 1, 1)
            self._seek(0)
        self._latest.request()


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
        clip = solver.animation.placed_clip
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
        self._add_ground(ground_path.around_path(clip, solver.animation.terrain))
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


class TimePanel:
    """Play, scrub, speed, and a camera that follows."""

    def __init__(self, gui: viser.GuiApi, frames: int):
        with gui.add_folder("Time"):
            self.play = gui.add_checkbox("Play", False)
            self.frame = gui.add_slider("Frame", 0, max(frames - 1, 1), 1, 0)
            self.speed = gui.add_dropdown("Speed", SPEEDS, initial_value="1")
            self.follow = gui.add_checkbox("Camera follows", True)


class LayerPanel:
    """What is drawn."""

    def __init__(self, gui: viser.GuiApi, has_captured: bool):
        with gui.add_folder("Layers"):
            gui.add_markdown("Feet are red in the ground, purple where they slide.")
            names = [name for name in SKELETONS if name != "captured" or has_captured]
            self.boxes = {name: gui.add_checkbox(SKELETON_LABELS[name], True) for name in names}
            self.boxes |= {name: gui.add_checkbox(NAMES[name], False) for name in NAMES}


class HistoryPanel:
    """Undo, redo, reset and Save, with their messages."""

    def __init__(self, gui: viser.GuiApi, starts: Mapping[str, jaxik.FootIK]):
        self.cost = gui.add_markdown("")
        self.step = gui.add_button_group("Step", ("Undo", "Redo"))
        self.reset = gui.add_button_group("Reset to", tuple(starts))
        self.save = gui.add_button("Save parameters and record")
        self.drop = gui.add_checkbox(
            "Record without what it cannot hold", False,
            hint="Else there is no record of parameters that 128 bytes cannot hold.",
        )  # fmt: skip
        self.message = gui.add_markdown("")


class SliderPanel:
    """A slider for each number and a box for each switch, in folders by stage.

    Args:
        gui: of the page.
        every: slider, stage by stage.
        ik: the system at first.
        moved: called when the user has moved one.
    """

    def __init__(self, gui: viser.GuiApi, every: list[Slider], ik: jaxik.FootIK, moved: Moved):
        self._handles: list[tuple[Slider, viser.GuiInputHandle]] = []
        if free := [slider for slider in every if slider.is_free]:
            self._add_folder(gui, "Fitted parameters", free, ik, moved)
        for stage, of_stage in groupby(every, key=lambda slider: slider.stage):
            if rest := [slider for slider in of_stage if not slider.is_free]:
                self._add_folder(gui, stage, rest, ik, moved)

    def _add_folder(
        self, gui: viser.GuiApi, name: str, sliders: list[Slider], ik: jaxik.FootIK, moved: Moved
    ) -> None:
        with gui.add_folder(name, expand_by_default=sliders[0].is_free):
            for slider in sliders:
                handle = _add_control(gui, slider, ik)
                handle.on_update(_callback(slider, handle, moved))
                self._handles.append((slider, handle))

    def follow(self, ik: jaxik.FootIK) -> None:
        """Moves sliders to where a system has its numbers."""
        for slider, handle in self._handles:
            handle.value = slider.clamped(ik)


def _add_control(gui: viser.GuiApi, slider: Slider, ik: jaxik.FootIK) -> viser.GuiInputHandle:
    label = slider.name if slider.is_free else slider.label
    value = slider.clamped(ik)
    if isinstance(value, bool):
        return gui.add_checkbox(label, value, hint=slider.hint)
    return gui.add_slider(label, slider.low, slider.high, slider.step, value, hint=slider.hint)


def _callback(
    slider: Slider, handle: viser.GuiInputHandle, moved: Moved
) -> Callable[[viser.GuiEvent], None]:
    def on_update(event: viser.GuiEvent) -> None:
        if event.client is not None:  # otherwise the program moved it, not a user
            moved(slider, handle.value)

    return on_update


class Player:
    """Counts time while it plays, from the end to the beginning again.

    Args:
        seconds: length of what is played.
        draw: called with the time, s.
    """

    def __init__(self, seconds: float, draw: Callable[[float], object]):
        self.seconds, self.speed = seconds, 1.0
        self._draw = draw
        self._time = 0.0
        self._playing, self._closed = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="jaxik view: player", daemon=True)
        self._thread.start()

    @property
    def playing(self) -> bool:
        """Whether time goes on."""
        return self._playing.is_set()

    def play(self, on: bool) -> None:
        """Goes on, or stops."""
        (self._playing.set if on else self._playing.clear)()

    def seek(self, seconds: float) -> None:
        """Goes to a time, s, and draws it."""
        self._time = min(max(seconds, 0.0), self.seconds)
        self._draw(self._time)

    def close(self) -> None:
        """Ends its thread."""
        self._closed.set()
        self._playing.set()
        self._thread.join()

    def _run(self) -> None:
        before = time.monotonic()
        while not self._closed.is_set():
            if not self.playing:
                self._playing.wait()
                before = time.monotonic()
            self._closed.wait(1.0 / RATE)
            now = time.monotonic()
            if self.playing and not self._closed.is_set():
                later = self._time + self.speed * (now - before)
                self.seek(later if later <= self.seconds else 0.0)
            before = now


def literal(text: str) -> str:
    """Somebody's text in Markdown, where it stays text: viser would run a script in it."""
    return MARKS.sub(r"\\\1", text)


def cost_text(solver: Solver, solved: Solved, costs: Mapping[str, float]) -> str:
    """The cost, and how the feet of each motion stand, in Markdown.

    Args:
        solver: of the clip.
        solved: what the system makes of it.
        costs: of systems to compare with, by name.
    """
    motions = {"before": solver.before, "after": solved.motion, "captured": solver.captured}
    measured = {name: drawn.measures for name, drawn in motions.items() if drawn is not None}
    table = markdown(transposed(figures_table("", measured, MEASURES)))
    return "\n\n".join([_cost(solved, costs), table])


def _cost(solved: Solved, costs: Mapping[str, float]) -> str:
    took = f"solved in {1000 * solved.seconds:.0f} ms"
    if solved.cost is None:
        return took[0].upper() + took[1:]
    others = ", ".join(f"{name} {cost:.6g}" for name, cost in costs.items())
    return f"**Cost {solved.cost:.6g}**{f' ({others})' if others else ''}, {took}"


class Latest:
    """Does some work again whenever it is requested; requests do not queue up.

    Args:
        work: what to do; it reads by itself what is newest.
    """

    def __init__(self, work: Callable[[], object]):
        self.work = work
        self._requested = self._closed = self._busy = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="jaxik view: solver", daemon=True)
        self._thread.start()

    def request(self) -> None:
        """Requests the work, and returns at once."""
        with self._changed:
            self._requested = True
            self._changed.notify_all()

    def wait(self, seconds: float | None = None) -> bool:
        """Waits until all that was requested is done; False if that takes longer."""
        with self._changed:
            return self._changed.wait_for(lambda: not (self._requested or self._busy), seconds)

    def close(self) -> None:
        """Ends the thread, after the work that it is doing."""
        with self._changed:
            self._closed, self._requested = True, False
            self._changed.notify_all()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._requested or self._closed)
                if self._closed:
                    return
                self._requested, self._busy = False, True
            try:
                self.work()
            except Exception:  # the next request may do better
                traceback.print_exc()
            finally:
                with self._changed:
                    self._busy = False
                    self._changed.notify_all()


def open_server(host: str, port: int, *, own_pages_only: bool = True) -> viser.ViserServer:
    """A page without anything on it; the next free port is taken where this one is in use.

    Args:
        host: the address on which to listen.
        port: 0 for any that is free.
        own_pages_only: whether pages that other machines serve cannot connect to it.

    Raises:
        ValueError: there is no such address here.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.create_server((host, ANY_PORT), family=family):
            pass
    except (OSError, UnicodeError) as error:
        raise ValueError(f"--host {host}: no address of this machine: {error}") from None
    with _silenced(), _origins(OWN if own_pages_only else None):
        server = viser.ViserServer(host, port, "jaxik view", verbose=False)
    server.request_share_url = lambda *_, **__: None  # no client opens a tunnel to this machine
    server.gui.configure_theme(
        control_width="large",
        show_logo=False,
        show_share_button=False,
        brand_color=(0, 114, 178),
    )
    server.gui.main_panel.dock_right()
    server.scene.set_up_direction("+y")
    server.scene.configure_default_lights(cast_shadow=False)  # slow without a graphics card
    return server


@contextlib.contextmanager
def _origins(wanted: re.Pattern[str] | None) -> Iterator[None]:
    """Servers made meanwhile take no connection from pages of other origins, if some are wanted.

    Browsers let any page connect to a server on this machine; viser does not ask which one it is.
    """
    serve = asyncio_server.serve
    if wanted is not None:
        asyncio_server.serve = functools.partial(serve, origins=[wanted, None])
    try:
        yield
    finally:
        asyncio_server.serve = serve


def address(server: viser.ViserServer) -> str:
    """What to open in a browser."""
    host = server.get_host()
    host = "localhost" if host in ("0.0.0.0", "::") else host
    return f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}"


def stop(server: viser.ViserServer) -> None:
    """Closes the page."""
    with _silenced():
        server.stop()


def _silenced() -> contextlib.redirect_stdout[io.StringIO]:
    """Without what viser prints of itself."""
    return contextlib.redirect_stdout(io.StringIO())
