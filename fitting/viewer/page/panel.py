"""The panel beside the picture: time, what is shown, the cost, and a slider for every number."""

from collections.abc import Callable, Iterable, Mapping
from itertools import groupby

import viser

import jaxik
from fitting.viewer.knobs import Knob
from fitting.viewer.overlays import NAMES
from fitting.viewer.solving import SKELETONS

SKELETON_LABELS = {
    "before": "Before: flat animation (grey)",
    "after": "After: solved (blue)",
    "captured": "Captured (orange)",
}
SPEEDS = ("0.1", "0.25", "0.5", "1", "2")
Moved = Callable[[Knob, float | bool], object]


class TimePanel:
    """Play, scrub, speed, and a camera that follows."""

    def __init__(self, gui: viser.GuiApi, frames: int):
        with gui.add_folder("Time"):
            self.play = gui.add_checkbox("Play", False)
            self.frame = gui.add_slider("Frame", 0, max(frames - 1, 1), 1, 0)
            self.speed = gui.add_dropdown("Speed", SPEEDS, initial_value="1")
            self.follow = gui.add_checkbox("Camera follows", True)


class ShownPanel:
    """What is drawn."""

    def __init__(self, gui: viser.GuiApi, has_captured: bool):
        with gui.add_folder("Shown"):
            gui.add_markdown("Feet are red in the ground, purple where they slide.")
            names = [name for name in SKELETONS if name != "captured" or has_captured]
            self.boxes = {name: gui.add_checkbox(SKELETON_LABELS[name], True) for name in names}
            self.boxes |= {name: gui.add_checkbox(NAMES[name], False) for name in NAMES}


class WayBackPanel:
    """Undo, redo, reset and Save, with what they said."""

    def __init__(self, gui: viser.GuiApi, starts: Mapping[str, jaxik.FootIK]):
        self.cost = gui.add_markdown("")
        self.step = gui.add_button_group("Step", ("Undo", "Redo"))
        self.reset = gui.add_button_group("Reset to", tuple(starts))
        self.save = gui.add_button("Save parameters and record")
        self.drop = gui.add_checkbox(
            "Record without what it cannot hold", False,
            hint="Else there is no record of parameters that 128 bytes cannot hold.",
        )  # fmt: skip
        self.said = gui.add_markdown("")


class KnobPanel:
    """A slider for each number and a box for each switch, in folders by stage.

    Args:
        gui: of the page.
        knobs: stage by stage.
        ik: the system at first.
        moved: called when the user has moved one.
    """

    def __init__(self, gui: viser.GuiApi, knobs: Iterable[Knob], ik: jaxik.FootIK, moved: Moved):
        self._handles: list[tuple[Knob, viser.GuiInputHandle]] = []
        ordered = list(knobs)
        if free := [knob for knob in ordered if knob.is_free]:
            self._add_folder(gui, "Fitted parameters", free, ik, moved)
        for stage, of_stage in groupby(ordered, key=lambda knob: knob.stage):
            if rest := [knob for knob in of_stage if not knob.is_free]:
                self._add_folder(gui, stage, rest, ik, moved)

    def _add_folder(
        self, gui: viser.GuiApi, name: str, knobs: list[Knob], ik: jaxik.FootIK, moved: Moved
    ) -> None:
        with gui.add_folder(name, expand_by_default=knobs[0].is_free):
            for knob in knobs:
                handle = _add_knob(gui, knob, ik)
                handle.on_update(_callback(knob, handle, moved))
                self._handles.append((knob, handle))

    def follow(self, ik: jaxik.FootIK) -> None:
        """Moves sliders to where a system has its numbers."""
        for knob, handle in self._handles:
            handle.value = knob.shown(ik)


def _add_knob(gui: viser.GuiApi, knob: Knob, ik: jaxik.FootIK) -> viser.GuiInputHandle:
    label = knob.name if knob.is_free else knob.label
    value = knob.shown(ik)
    if isinstance(value, bool):
        return gui.add_checkbox(label, value, hint=knob.hint)
    return gui.add_slider(label, knob.low, knob.high, knob.step, value, hint=knob.hint)


def _callback(
    knob: Knob, handle: viser.GuiInputHandle, moved: Moved
) -> Callable[[viser.GuiEvent], None]:
    def on_update(event: viser.GuiEvent) -> None:
        if event.client is not None:  # else the page was moved, and not by a user
            moved(knob, handle.value)

    return on_update
