"""What is to be said of the heights of ankles and balls over their soles."""

import numpy as np
from jaxtyping import Bool, Float64

from fitting.datasets.clips.rigs import measure_soles
from jaxik.world.skeleton import Rig

SUBJECT = "sole"  # a word of each of these remarks, and of no others
OFFSET = 0.015  # m, from which feet count as off their floor


def remarks(
    rig: Rig,
    positions_ws: Float64[np.ndarray, "frames joints 3"],
    rotations_ws: Float64[np.ndarray, "frames joints 4"],
    stance: Bool[np.ndarray, "frames legs"],
    floor: float = 0.0,
) -> tuple[str, ...]:
    """Feet that stand over or in their floor, or else those whose heights are a guess.

    Args:
        rig: with the heights that were measured, guessed or given.
        positions_ws: m, y up.
        rotations_ws: wxyz.
        stance: when each foot stands.
        floor: its height, m.
    """
    soles = measure_soles(rig, positions_ws, rotations_ws, stance, floor)
    balls = np.asarray(rig.ball_height, np.float64)
    over = soles.standing - balls
    if (over > OFFSET).all() or (over < -OFFSET).all():
        height, ball, standing = float(over.mean()), float(balls.mean()), soles.standing.mean()
        remedy = f"--floor {floor + height:.3f}"
        if standing > 0:
            remedy += f", or --sole {standing:.3f} (sole=... in Python) if they are that thick"
        place = "over" if height > 0 else "in"
        return (
            f"standing feet are {100 * abs(height):.1f} cm {place} the floor at height {floor:g} m "
            f"in all stances, if their balls are {100 * ball:.1f} cm over their soles: a floor "
            f"offset? Then give {remedy}",
        )
    guessed = ~soles.measured & np.isclose(balls, soles.ball)
    return tuple(
        f"the {name} foot stands flat on no level floor at height {floor:g}; its ankle is taken to "
        f"be {height:.3f} m over its sole, from the foot's length"
        for name, height, is_guess in zip(rig.names, rig.ankle_height, guessed, strict=True)
        if is_guess
    )
