"""Solves a clip for any values of a system's parameters, by programs that are compiled once."""

import time
from collections.abc import Collection
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import jax
import numpy as np
from jaxtyping import Float, UInt8

import jaxik
from fitting.clips import Clip
from fitting.clips.clip_frames import clip_from_result
from fitting.ground import ground_path
from fitting.motion.measures import Soles
from fitting.motion.playback import stage_outputs
from fitting.report import motion_data
from fitting.report.motion_data import ViewedClip, ViewedMotion
from fitting.runtime.precision import in_float64
from fitting.runtime.program_cache import committed
from jaxik.world import body
from jaxik.world.body import similar
from jaxik.world.terrain import Hit

from .edits import SOLVED
from .session import Session

Colour: TypeAlias = tuple[int, int, int]
"""RGB, 0..255."""

FOUND, MISSED = (0, 158, 115), (150, 150, 150)
FOOTHOLD, LOCK, TARGET = (0, 114, 178), (230, 159, 0), (204, 61, 130)
WITHIN, BEYOND = (0, 158, 115), (230, 30, 30)
ARM = 0.05  # m, half a cross, for an adult
LAYERS = {
    "rays": "Rays, grey where they miss",
    "footholds": "Footholds (blue)",
    "locks": "Locks (orange)",
    "targets": "Targets of ankles (pink)",
    "reach": "Reach, red beyond it",
}


class Lines(NamedTuple):
    """Segments in each frame; what is not there in a frame has no length."""

    points: Float[np.ndarray, "frames lines 2 3"]
    """m, both ends."""
    colours: UInt8[np.ndarray, "frames lines 3"]
    """RGB."""


@dataclass(frozen=True)
class Solved:
    """What a system makes of a clip."""

    clip: Clip
    soles: Soles
    layers: dict[str, Lines]
    """Those that were wanted."""
    cost: float | None
    """None where no captured motion is known."""
    seconds: float
    """That it took."""


class Solver:
    """Solves one clip of a session again and again.

    Args:
        session: what is viewed.
        number: index of the clip.
    """

    def __init__(self, session: Session, number: int = 0):
        self.session = session
        self.clip = session.clips[number]
        self.animation = self.clip.animation

    @in_float64
    def solve(self, ik: jaxik.FootIK, layers: Collection[str] = ()) -> Solved:
        """What a system makes of the clip.

        Args:
            ik: the system.
            layers: names of `LAYERS` that are wanted.

        Raises:
            ValueError: the poses are not finite.
        """
        began, own = time.perf_counter(), self.animation
        ik = committed(ik)  # once for both programs
        cost = None if self.session.cost is None else self.session.cost(ik)  # runs meanwhile
        size = self.clip.size
        result = self.animation.run(ik if size is None else similar(ik, size))
        result = jax.tree.map(np.asarray, result)
        solved = clip_from_result(own.clip, result, floor=own.floor, rise=own.root.rise)
        lines = overlays(result, solved, layers) if layers else {}
        soles, cost = own.soles(solved), None if cost is None else float(cost)
        return Solved(solved, soles, lines, cost, time.perf_counter() - began)

    @in_float64
    def viewed(self) -> ViewedClip:
        """The clip as the page shows it at first: animation, first system, captured motion."""
        own, first = self.animation, next(iter(self.session.starts.values()))
        flat, solved = own.place(own.placed_clip), own.place(self.solve(first).clip)
        motions = {
            "animated": ViewedMotion("flat animation", flat, motion_data.ANIMATED, True),
            SOLVED: ViewedMotion("solved", solved, motion_data.FITTED, True),
        }
        if own.captured is not None:
            captured = own.place(own.captured)
            motions["captured"] = ViewedMotion("captured", captured, motion_data.CAPTURED, True)
        return ViewedClip(
            motions,
            self.clip.labelled.stance_labels(),
            own.own_speed,
            ground_path.around_path(own.placed_clip, own.terrain),
            watched=SOLVED,
        )


def overlays(result: jaxik.Result, solved: Clip, names: Collection[str]) -> dict[str, Lines]:
    """What is drawn on demand, by name, in world space.

    Args:
        result: of a system.
        solved: the clip as the system leaves it.
        names: of `LAYERS`.
    """
    trace = stage_outputs(result)
    sensed, advanced = trace.sensed, trace.advanced
    arm = ARM * body.ratio(solved.rig)
    found = np.asarray(sensed.foothold.found)
    foothold_ws = np.asarray(advanced.foothold_ws)
    held_ws = foothold_ws + np.asarray(advanced.hold.offset_ws)
    target_ws = np.asarray(advanced.effector.target_ws)
    hits = (sensed.ground.ankle, sensed.ground.toe, sensed.ground.corner)
    up_ws = np.asarray(sensed.leg_up_ws)
    up_ws = up_ws if up_ws.ndim == 3 else up_ws[:, None]
    makers = {
        "rays": lambda: joined(*(_rays(hit, up_ws) for hit in hits)),
        "footholds": lambda: crosses(foothold_ws, found, arm, FOOTHOLD),
        "locks": lambda: crosses(held_ws, np.asarray(advanced.hold.locked), 1.5 * arm, LOCK),
        "targets": lambda: crosses(target_ws, found, arm, TARGET),
        "reach": lambda: _reach(solved, target_ws),
    }
    return {name: make() for name, make in makers.items() if name in names}


def lines(
    starts: Float[np.ndarray, "frames *n 3"],
    ends: Float[np.ndarray, "frames *n 3"],
    colours: Colour | UInt8[np.ndarray, "frames *n 3"],
) -> Lines:
    """Lines between points, m, in one colour or a colour for each."""
    points, frames = np.stack([starts, ends], axis=-2), len(starts)
    each = np.broadcast_to(np.asarray(colours, np.uint8), starts.shape)
    return Lines(points.reshape(frames, -1, 2, 3), each.reshape(frames, -1, 3))


def crosses(
    points: Float[np.ndarray, "frames n 3"],
    present: Float[np.ndarray, "frames n"],
    arm: float,
    colour: Colour,
) -> Lines:
    """A cross of three lines at each point that is present.

    Args:
        points: m.
        present: above a half where there is something to show.
        arm: m, half the length of a line.
        colour: of all.
    """
    arms = arm * np.eye(3) * (present > 0.5)[..., None, None]
    return lines(points[..., None, :] - arms, points[..., None, :] + arms, colour)


def joined(*parts: Lines) -> Lines:
    """Lines side by side, over the same frames."""
    return Lines(*(np.concatenate(arrays, axis=1) for arrays in zip(*parts, strict=True)))


def _rays(hit: Hit, up_ws: np.ndarray) -> Lines:
    """The rays that end in these hits; those that were not cast have no length."""
    ends = np.asarray(hit.point)
    starts = ends + np.asarray(hit.distance)[..., None] * up_ws
    colours = np.where(np.asarray(hit.found)[..., None] > 0.5, FOUND, MISSED).astype(np.uint8)
    return lines(starts, ends, colours)


def _reach(solved: Clip, target_ws: np.ndarray) -> Lines:
    """From each hip to its ankle's target: as far as the leg reaches, and the rest."""
    hips = solved.joints_ws(0)
    length = np.asarray(solved.rig.thigh) + np.asarray(solved.rig.shin)
    offset = target_ws - hips
    distance = np.maximum(np.linalg.norm(offset, axis=-1), 1e-9)
    ends = hips + np.minimum(length / distance, 1.0)[..., None] * offset
    return joined(lines(hips, ends, WITHIN), lines(ends, target_ws, BEYOND))
