"""Comparisons that need no pipeline: systems that shift a flat animation."""

import dataclasses

import numpy as np

from fitting.clips import edit
from fitting.clips.clip import Clip
from fitting.ground.meshes import load_terrain
from fitting.motion.flat_animation import load_flat_animation
from fitting.motion.measures import Measures
from fitting.report.formatting import MEASURES
from fitting.studies import comparison
from fitting.studies.animations import Animation
from fitting.studies.comparison import ANIMATED, Comparison

from .experiments import ROOT

WALK = "data/clips/uneven_walk.npz", "data/clips/uneven_walk_base.npz"
GROUND = "data/terrains/uneven_walk.ply"
DEEP = 0.1  # m, by which one of the systems is in the ground


def walk() -> Animation:
    """A fifth of a second of a captured walk, whose captured motion is known."""
    captured, flat = (edit.trim(load_flat_animation(ROOT / name), 1.0, 1.2) for name in WALK)
    return Animation(flat, load_terrain(ROOT / GROUND), captured=captured)


def invented_comparison(animation: Animation, title: str = "walk on steps") -> Comparison:
    """Of `captured`, which moves as captured, and `deep`, which is `DEEP` m lower."""
    flat, captured = animation.placed_clip, animation.captured
    assert captured is not None
    clips = {ANIMATED: flat, "close": captured, "deep": lowered(captured, DEEP)}
    zero = Measures(**dict.fromkeys(MEASURES, 0.0))
    measured = {name: dataclasses.replace(zero, reached=0.5) for name in clips}
    return Comparison(
        title=title,
        legs=flat.rig.names,
        fps=flat.fps,
        ground=np.zeros((flat.frame_count, len(flat.rig.names))),
        groundless=0.0,
        animation=animation,
        clips=clips,
        motions={name: comparison.motion_of(clip) for name, clip in clips.items()},
        measures=measured,
        placements={name: animation.assess(clips[name]) for name in ("close", "deep")},
    )


def lowered(clip: Clip, depth: float) -> Clip:
    """The clip so many metres further down."""
    return clip.with_motion(clip.positions_ws - [0.0, depth, 0.0], clip.rotations_ws)
