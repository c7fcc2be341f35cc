"""A subject on a page: moves of sliders become solutions, and these become pictures."""

import threading
import time
from pathlib import Path

import viser

import jaxik
from fitting.viewer import saving
from fitting.viewer.knobs import Knob, knobs
from fitting.viewer.latest import Latest
from fitting.viewer.solving import Solved, Solver
from fitting.viewer.subject import Subject
from fitting.viewer.tuning import Tuning

from .figure import Figure
from .panel import KnobPanel, ShownPanel, TimePanel, WayBackPanel
from .player import Player
from .words import cost_text, literal


class Viewer:
    """The page of a subject, until it is closed.

    Args:
        server: of an empty page.
        subject: what is viewed.
        folder: where Save writes.
    """

    def __init__(self, server: viser.ViserServer, subject: Subject, folder: Path):
        self.server, self.subject, self.folder = server, subject, folder
        self.tuning = Tuning(subject.starts)
        self.solver = Solver(subject)
        self.solved: Solved | None = None
        self._compiled: Solver | None = None  # whose programs are
        self.costs: dict[str, float] = {}
        """Of the systems to go back to, as far as they are known."""
        self._lock = threading.RLock()
        self._figure = Figure(server, self.solver)
        self._build_panel()
        clip = self.solver.take.animated
        self._player = Player(clip.seconds, self._draw_time)
        self._latest = Latest(self._solve)
        self._connect()
        self._latest.ask()

    def _build_panel(self) -> None:
        gui, clip = self.server.gui, self.solver.take.animated
        gui.add_markdown(f"**{literal(self.subject.title)}**")
        if len(self.subject.takes) > 1:
            names = tuple(take.name for take in self.subject.takes)
            choice = gui.add_dropdown("Clip", names)
            choice.on_update(lambda _: self._choose(names.index(choice.value)))
        self._way_back = WayBackPanel(gui, self.tuning.starts)
        self._time = TimePanel(gui, clip.frame_count)
        self._shown = ShownPanel(gui, any(take.captured for take in self.subject.takes))
        every = knobs(self.tuning.ik, self.subject.rig, self.subject.free)
        self._knobs = KnobPanel(gui, every, self.tuning.ik, self._move)

    def _connect(self) -> None:
        times, way_back = self._time, self._way_back
        times.play.on_update(lambda _: self._player.play(times.play.value))
        times.frame.on_update(lambda event: event.client and self._seek(times.frame.value))
        times.speed.on_update(lambda _: setattr(self._player, "speed", float(times.speed.value)))
        times.follow.on_update(lambda _: setattr(self._figure, "follows", times.follow.value))
        for box in self._shown.boxes.values():
            box.on_update(lambda _: self._show_chosen())
        way_back.step.on_click(lambda _: self._step(way_back.step.value))
        way_back.reset.on_click(lambda _: self.reset(way_back.reset.value))
        way_back.save.on_click(lambda _: self.save())

    def wait(self, seconds: float | None = None) -> bool:
        """Waits until what was moved is solved and shown; False if that takes longer."""
        return self._latest.wait(seconds)

    def reset(self, name: str) -> None:
        """Goes back to one of the subject's systems."""
        with self._lock:
            self.tuning.reset(name)
        self._moved()

    def restart(self, name: str, ik: jaxik.FootIK, note: str) -> None:
        """Begins anew with another system, as a fit that goes on finds better ones."""
        with self._lock:
            self.tuning.restart(name, ik)
        self._way_back.reset.options = tuple(self.tuning.starts)
        self._way_back.said.content = literal(note)
        self._moved()

    def save(self) -> None:
        """Writes the system as it is, and says what was written."""
        subject = self.subject
        try:
            with self._lock:
                said = saving.save(
                    self.folder, self.tuning.ik, subject.preset, subject.leg_length,
                    drop=self._way_back.drop.value,
                )  # fmt: skip
        except ValueError as error:
            said = [str(error)]
        self._way_back.said.content = "\n\n".join(map(literal, said))

    def close(self) -> None:
        """Ends its threads."""
        self._player.close()
        self._latest.close()

    def _move(self, knob: Knob, value: float | bool) -> None:
        try:
            with self._lock:
                self.tuning.change(knob.write(self.tuning.ik, value), knob.name, time.monotonic())
        except ValueError as error:
            self._way_back.said.content = literal(str(error))
        self._latest.ask()

    def _step(self, way: str) -> None:
        with self._lock:
            (self.tuning.undo if way == "Undo" else self.tuning.redo)()
        self._moved()

    def _moved(self) -> None:
        self._knobs.follow(self.tuning.ik)
        self._latest.ask()

    def _solve(self) -> None:
        with self._lock:
            ik, solver, figure = self.tuning.ik, self.solver, self._figure
        try:
            if solver is not self._compiled:
                self._way_back.cost.content = "Compiling, which takes a while the first time …"
                solver.solve(ik)
                self._compiled = solver
            solved = solver.solve(ik)
        except (ValueError, RuntimeError) as error:  # JAX raises the latter without memory
            self._way_back.cost.content = f"**{literal(str(error))}**"
            return
        if solver is not self.solver:
            return  # another clip was chosen meanwhile, and has asked, too
        self.solved = solved
        figure.show(solved)
        self._show_chosen()
        for name, start in self.tuning.starts.items():
            if start is ik and solved.cost is not None:
                self.costs[name] = solved.cost
        self._way_back.cost.content = cost_text(solver, solved, self.costs)

    def _draw_time(self, seconds: float) -> None:
        figure = self._figure
        frame = min(round(seconds * figure.fps), figure.frame_count - 1)
        figure.draw(frame)
        self._time.frame.value = frame

    def _seek(self, frame: int) -> None:
        self._player.seek(frame / self._figure.fps)

    def _show_chosen(self) -> None:
        for name, box in self._shown.boxes.items():
            self._figure.set_visible(name, box.value)

    def _choose(self, number: int) -> None:
        """Shows another clip of the subject."""
        with self._lock:
            solver = Solver(self.subject, number)
            self._figure.remove()
            self.solver, self._figure = solver, Figure(self.server, solver)
            self._figure.follows = self._time.follow.value
            self._show_chosen()
            clip = solver.take.animated
            self._player.seconds = clip.seconds
            self._time.frame.max = max(clip.frame_count - 1, 1)
            self._seek(0)
        self._latest.ask()
