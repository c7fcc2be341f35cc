"""Compared motions as the page's view shows them."""

from fitting.report.page.motion_data import ANIMATED, CAPTURED, Look, ShownClip, ShownMotion
from fitting.report.plots.comparison_plots import COLOURS
from fitting.report.plots.style import BEFORE
from fitting.studies.comparison import ANIMATED as ANIMATION
from fitting.studies.motions.comparison_motions import ComparedMotions

RADIUS = 0.018  # m, of the bones of a system
CAPTURE = "captured"  # key of the captured motion, which no system has


def shown(compared: ComparedMotions, systems: tuple[str, ...], watched: str) -> ShownClip:
    """What the view shows: colours are those of the plots.

    Args:
        compared: the motions.
        systems: names of all systems, which decide the colours.
        watched: the one that is watched at first, if it gave a motion.
    """
    flat = ANIMATED._replace(colour=BEFORE)
    looks = {ANIMATION: flat} | {
        name: Look(COLOURS[index % len(COLOURS)], RADIUS) for index, name in enumerate(systems)
    }
    motions = {
        key(name): ShownMotion(
            "flat animation" if name == ANIMATION else name,
            motion,
            looks[name],
            visible=name != ANIMATION,
            worst=compared.worst[name],
        )
        for name, motion in compared.motions.items()
    }
    if compared.captured is not None:
        motions[CAPTURE] = ShownMotion("captured", compared.captured, CAPTURED, visible=True)
    return ShownClip(
        motions,
        compared.stance,
        compared.ground,
        watched=key(watched if watched in compared.motions else ANIMATION),
    )


def key(name: str) -> str:
    """Of the motion of a system, or of the animation, in the view."""
    return f"motion {name}"
