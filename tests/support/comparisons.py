"""Comparisons that need no pipeline: systems that shift a flat animation."""

from fitting.clips import edit
from fitting.clips.clip import Clip
from fitting.ground.meshes import load_terrain
from fitting.motion.flat_animation import load_flat_animation
from fitting.studies.animations import Animation
from fitting.studies.comparison import ANIMATED, Comparison

from .experiments import ROOT

WALK = "data/clips/uneven_walk.npz", "data/clips/uneven_walk_base.npz"
GROUND = "data/terrains/uneven_walk.ply"
DEEP = 0.1  # m, by which one of the systems is in the ground


def walk(seconds: float = 0.2) -> Animation:
    """A part of a captured walk, from 2.5 s on, whose captured motion is known."""
    captured, flat = (
        edit.trim(load_flat_animation(ROOT / name), 2.5, 2.5 + seconds) for name in WALK
    )
    return Animation(flat, load_terrain(ROOT / GROUND), captured=captured)


def invented_comparison(animation: Animation, title: str = "walk on steps") -> Comparison:
    """Of `captured`, which moves as captured, and `deep`, which is `DEEP` m lower."""
    captured = animation.captured
    assert captured is not None
    clips = {ANIMATED: animation.placed_clip, "close": captured, "deep": lowered(captured, DEEP)}
    motions = {name: animation.place(clip) for name, clip in clips.items()}
    causes = {name: animation.cause(motions[name]) for name in ("close", "deep")}
    return Comparison(title, animation, motions, causes)


def lowered(clip: Clip, depth: float) -> Clip:
    """The clip so many metres further down."""
    return clip.with_motion(clip.positions_ws - [0.0, depth, 0.0], clip.rotations_ws)
