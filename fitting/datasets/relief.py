"""How uneven the ground is under the stances of a clip. Lengths are for an adult."""

import numpy as np
from jaxtyping import Float

FLAT = 0.05  # m between the lowest and the highest stance, below which ground is flat
MAX_TILT = np.radians(2.0)  # of a floor that is meant to be level
PLANE = 5  # stances, more than which may show how a floor is tilted


def relief(places: Float[np.ndarray, "stances 2"], ground: Float[np.ndarray, " stances"]) -> float:
    """By how much the ground differs between stances, m; a floor that is tilted a little is flat.

    Args:
        places: of the stances in the ground plane, m.
        ground: its height there, m.

    Returns:
        Infinite where there is no stance.
    """
    if not len(ground):
        return np.inf
    rest = ground - ground.mean()
    if len(ground) > PLANE:
        columns = np.column_stack([places - places.mean(axis=0), np.ones(len(places))])
        plane = np.linalg.lstsq(columns, rest, rcond=None)[0]
        if np.hypot(*plane[:2]) < np.tan(MAX_TILT):
            rest = rest - columns @ plane
    return float(np.ptp(rest))
