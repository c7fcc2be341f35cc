"""Playbacks with known errors: two legs that stand still on level ground for ten seconds."""

import dataclasses

import numpy as np

from fitting.motion.playback import RESIDUAL_KINDS, Motion, Playback

FPS, FRAMES = 30.0, 300
LEGS = ("left", "right")
SIGMAS = {"ankle": 0.02, "knee": 0.03, "pelvis": 0.02, "foot": np.inf, "body": np.inf}
SIGMAS |= {"contact": np.inf, "smooth": np.inf}
SHAPES = {"ankle": (2, 3), "knee": (2, 3), "pelvis": (3,), "foot": (2, 3), "body": (3,)}
SHAPES |= {"contact": (2,), "smooth": (2, 3)}  # of the residuals of a frame
SOLE, LEVEL = 0.05, 0.30  # m, height of the ball above its sole, and of the ground


def standing(height: float) -> Motion:
    """A body at rest on ground of this height, m."""
    heights = {"pelvis": 0.95, "hip": 0.9, "knee": 0.5, "ankle": 0.09, "toe": SOLE}
    positions = {}
    for joint, up in heights.items():
        forward = 0.05 if joint == "knee" else 0.0
        pos = np.zeros((FRAMES, 2, 3)) + [0.0, height + up, forward]
        positions[joint] = pos[:, 0] if joint == "pelvis" else pos
    return Motion(**positions)


def error(kind: str, frames: slice | int, *vector: float, leg: int | None = None) -> dict:
    """Errors of one kind, m, in these frames, of one leg or of the body; 0 elsewhere."""
    values = np.zeros((FRAMES, *SHAPES[kind]))
    values[(frames,) if leg is None else (frames, leg)] = vector
    return {kind: values}


def playback(
    errors: dict[str, np.ndarray] | None = None,
    sigmas: dict[str, float] | None = None,
    **fields: np.ndarray,
) -> Playback:
    """A playback whose fitted motion has these errors by kind, and no others.

    `fields` replace those of the playback.
    """
    zeros = {
        kind: np.zeros((FRAMES - 2 if kind == "smooth" else FRAMES, *shape))
        for kind, shape in SHAPES.items()
    }
    all_errors, all_sigmas = zeros | (errors or {}), SIGMAS | (sigmas or {})
    before, captured = standing(0.0), standing(LEVEL)
    positions = {kind: getattr(captured, kind) for kind in ("ankle", "knee", "pelvis")}
    moved = {kind: pos + all_errors[kind] for kind, pos in positions.items()}
    after = dataclasses.replace(captured, **moved)
    animated = {kind: getattr(before, kind) - pos for kind, pos in positions.items()}
    seen = fields.get("seen", np.ones(FRAMES, bool))
    seen_by_kind = {kind: seen[1:-1] if kind == "smooth" else seen for kind in RESIDUAL_KINDS}
    residuals = {
        kind: values * seen_by_kind[kind].reshape(-1, *[1] * (values.ndim - 1)) / all_sigmas[kind]
        for kind, values in all_errors.items()
    }
    per_foot = np.ones((FRAMES, 2))
    ground = np.zeros((FRAMES, 2, 3)) + [0.0, LEVEL, 0.0]
    play = Playback(
        before=before, after=after, captured=captured,
        up_ws=np.array([0.0, 1.0, 0.0]), forward_ws=np.zeros((FRAMES, 3)) + [0.0, 0.0, 1.0],
        ground_ws=ground, grounded=per_foot, ball_ground_ws=ground, ball_grounded=per_foot,
        floor=np.zeros(FRAMES), dt=np.full(FRAMES, 1 / FPS),
        contact=per_foot, locked=0 * per_foot, reached=per_foot, stance=per_foot,
        slide=np.zeros(FRAMES), present=np.ones(2, bool),
        seen=seen, held_out=np.zeros(FRAMES, bool),
        errors=all_errors, animated_errors=zeros | animated, residuals=residuals,
        sigmas={kind: np.asarray(sigma) for kind, sigma in all_sigmas.items()}, label="captured",
    )  # fmt: skip
    return dataclasses.replace(play, **fields)
