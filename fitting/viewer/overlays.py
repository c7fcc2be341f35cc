"""What the stages of a system saw and decided in each frame, as lines."""

import numpy as np

import jaxik
from fitting.analysis.playback import stage_outputs
from fitting.datasets.clips import Clip
from jaxik.world import body
from jaxik.world.terrain import Hit

from .lines import Colour, Lines, crosses, joined, lines

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


def overlays(result: jaxik.Result, solved: Clip) -> dict[str, Lines]:
    """What is shown on demand, by name, in world space.

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
    colours = np.where(np.asarray(hit.found)[..., None] > 0.5, _byte(FOUND), _byte(MISSED))
    return lines(starts, ends, colours)


def _reach(solved: Clip, target_ws: np.ndarray) -> Lines:
    """From each hip to its ankle's target: as far as the leg reaches, and the rest."""
    hips = solved.joints_ws(0)
    length = np.asarray(solved.rig.thigh) + np.asarray(solved.rig.shin)
    offset = target_ws - hips
    distance = np.maximum(np.linalg.norm(offset, axis=-1), 1e-9)
    ends = hips + np.minimum(length / distance, 1.0)[..., None] * offset
    return joined(lines(hips, ends, WITHIN), lines(ends, target_ws, BEYOND))


def _byte(colour: Colour) -> np.ndarray:
    return np.array(colour, np.uint8)
