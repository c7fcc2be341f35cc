"""Solves a clip for any values of a system's parameters, by programs that are compiled once."""

import time
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float, Float64, UInt8

import jaxik
from fitting.clips import Clip
from fitting.clips.clip_frames import clip_from_result
from fitting.motion import measures
from fitting.motion.measures import VISIBLE, Measures, PlacedMotion, Soles
from fitting.motion.playback import stage_outputs
from fitting.runtime.precision import in_float64
from jaxik.world import body
from jaxik.world.body import similar
from jaxik.world.terrain import Hit

from .session import Colour, Lines, Session, crosses, joined, lines

IN_GROUND, SLIDES = (230, 30, 30), (214, 39, 214)  # colours, RGB

SKELETONS: dict[str, Colour] = {  # by name; the colours of reports
    "before": (140, 140, 140),
    "after": (0, 114, 178),
    "captured": (213, 94, 0),
}
HEEL, BALL, ANKLE, TOE = range(4)  # corners of a foot as it is drawn
EDGES = ((ANKLE, HEEL), (HEEL, BALL), (BALL, TOE))

FOUND, MISSED = (0, 158, 115), (150, 150, 150)
FOOTHOLD, LOCK, TARGET = (0, 114, 178), (230, 159, 0), (204, 61, 130)
WITHIN, BEYOND = (0, 158, 115), (230, 30, 30)
ARM = 0.05  # m, half a cross, for an adult
NAMES = {
    "rays": "Rays, grey where they miss",
    "footholds": "Footholds (blue)",
    "locks": "Locks (orange)",
    "targets": "Targets of ankles (pink)",
    "reach": "Reach, red beyond it",
}


@dataclass(frozen=True)
class FootFaults:
    """How deep each foot is in the ground, and how far it has slid, in each frame."""

    depth: Float64[np.ndarray, "frames legs"]
    """m in the ground, 0 above it and without any."""
    slide: Float64[np.ndarray, "frames legs"]
    """m, horizontal path of the ball since its stance began, beyond the animated one; 0 in a
    swing."""
    size: float = 1.0
    """Length of the legs relative to an adult's: what is visible is as many times as large."""

    @property
    def sunk(self) -> Float64[np.ndarray, "frames legs"]:
        """How far a foot is in the ground, 0..1; 1 where it counts as penetration."""
        return np.clip(self.depth / (VISIBLE * self.size), 0.0, 1.0)

    @property
    def slid(self) -> Float64[np.ndarray, "frames legs"]:
        """How far a standing foot has slid, 0..1; 1 at the bound of a slide."""
        return np.clip(self.slide / (VISIBLE * self.size), 0.0, 1.0)

    def colours(self, plain: tuple[int, int, int]) -> UInt8[np.ndarray, "frames legs 3"]:
        """The colour of each foot: plain, the redder the deeper, the more purple the further slid.

        Args:
            plain: of a foot with nothing wrong, RGB.
        """
        colours = np.full((*self.depth.shape, 3), plain, np.float64)
        for share, colour in ((self.slid, SLIDES), (self.sunk, IN_GROUND)):
            colours += share[..., None] * (np.array(colour) - colours)
        return np.round(colours).astype(np.uint8)


def foot_faults(feet: Soles, motion: Clip, animated: Clip) -> FootFaults:
    """How deep and how far the feet of a motion are in the ground and slide.

    Args:
        feet: of the motion.
        motion: over the same frames.
        animated: whose slides are not counted.
    """
    depth = np.maximum(-np.nan_to_num(feet.gap), 0.0)
    slide = np.nan_to_num(measures.travelled(motion, animated, feet.stance))
    return FootFaults(depth, np.maximum(slide, 0.0), body.ratio(motion.rig))


@dataclass(frozen=True)
class Drawn:
    """One motion as it is drawn."""

    bones: Lines
    feet: Lines
    """Coloured by what is wrong with them."""
    faults: FootFaults
    measures: Measures


@dataclass(frozen=True)
class Solved:
    """What a system makes of a clip."""

    motion: Drawn
    overlays: dict[str, Lines]
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
        self.before = self._drawn(self.animation.placed_clip, "before")
        captured = self.animation.captured
        self.captured = None if captured is None else self._drawn(captured, "captured")

    @property
    def path_ws(self) -> Float[np.ndarray, "frames 3"]:
        """Where the animated pelvis is, m."""
        clip = self.animation.placed_clip
        return clip.positions_ws[:, clip.rig.pelvis]

    @in_float64
    def solve(self, ik: jaxik.FootIK) -> Solved:
        """What a system makes of the clip.

        Raises:
            ValueError: the poses are not finite.
        """
        began, own = time.perf_counter(), self.animation
        cost = None if self.session.cost is None else self.session.cost(ik)  # runs meanwhile
        size = self.clip.size
        result = self.animation.run(ik if size is None else similar(ik, size))
        result = jax.tree.map(np.asarray, result)
        solved = clip_from_result(own.clip, result, floor=own.floor, rise=own.root.rise)
        if not np.isfinite(solved.positions_ws).all():
            raise ValueError("these parameters give poses that are not finite")
        motion, layers = self._drawn(solved, "after"), overlays(result, solved)
        cost = None if cost is None else float(cost)
        return Solved(motion, layers, cost, time.perf_counter() - began)

    @in_float64
    def _drawn(self, clip: Clip, name: str) -> Drawn:
        placed = self.animation.place(clip)
        faults = foot_faults(placed.soles, clip, self.animation.own_speed)
        bones = np.array([[parent, j] for j, parent in enumerate(clip.parents) if parent >= 0])
        starts, ends = np.moveaxis(clip.positions_ws[:, bones], 2, 0)
        feet = _feet(placed, faults.colours(SKELETONS[name]))
        return Drawn(lines(starts, ends, SKELETONS[name]), feet, faults, placed.measures)


def _feet(motion: PlacedMotion, colours: np.ndarray) -> Lines:
    """The soles of a motion, in a colour for each foot in each frame."""
    joints = np.stack([motion.clip.joints_ws(2), motion.clip.joints_ws(3)], axis=2)
    corners = np.concatenate([motion.soles.points_ws, joints], axis=2)
    return joined(
        *(lines(corners[:, :, start], corners[:, :, end], colours) for start, end in EDGES)
    )


def overlays(result: jaxik.Result, solved: Clip) -> dict[str, Lines]:
    """What is drawn on demand, by name, in world space.

    Args:
        result: of a system.
        solved: the clip as the system leaves it.
    """
    trace = stage_outputs(result)
    sensed, advanced = trace.sensed, trace.advanced
    arm = ARM * body.ratio(solved.rig)
    found = np.asarray(sensed.foothold.found)
    held_ws = np.asarray(advanced.foothold_ws) + np.asarray(advanced.hold.offset_ws)
    target_ws = np.asarray(advanced.effector.target_ws)
    hits = (sensed.ground.ankle, sensed.ground.toe, sensed.ground.corner)
    up_ws = np.asarray(sensed.leg_up_ws)
    up_ws = up_ws if up_ws.ndim == 3 else up_ws[:, None]
    return {
        "rays": joined(*(_rays(hit, up_ws) for hit in hits)),
        "footholds": crosses(np.asarray(advanced.foothold_ws), found, arm, FOOTHOLD),
        "locks": crosses(held_ws, np.asarray(advanced.hold.locked), 1.5 * arm, LOCK),
        "targets": crosses(target_ws, found, arm, TARGET),
        "reach": _reach(solved, target_ws),
    }


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
