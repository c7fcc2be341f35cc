"""Random grounds that are not stairs, as `flights.Flight`s: their profile along the way."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64

from stairs.flights import BEFORE, BEYOND, SPACING, Flight

KINDS = ("rubble", "curb", "ledge", "ramp", "roots", "gaps", "furniture")
BRIDGED = 0.1  # m, half the width of the widest gap that the root crosses on its level
FIRST, LAST = 0.3, 5.0  # m, between which the ground is not level
EDGE = 1e-3  # m, along the way, of a vertical side


@dataclass(frozen=True)
class Ground(Flight):
    """Ground that changes along z, and how it is crossed."""

    kind: str = "rubble"
    corners: Float64[np.ndarray, "corners 2"] = field(default_factory=lambda: np.zeros((0, 2)))
    """z and height, m, between which it is even."""

    def profile(self) -> Float64[np.ndarray, "points 2"]:
        """z and height, m, of its corners seen from above."""
        first, last = self.corners[[0, -1], 1]
        return np.array([[BEFORE - 1.0, first], *self.corners, [BEYOND, last]])

    def levels(self, z: np.ndarray) -> np.ndarray:
        """Height of the way, m: that of the ground without its gaps."""
        away = np.linspace(-BRIDGED, BRIDGED, 2 * round(BRIDGED / SPACING) + 1)
        return self.heights(z[..., None, None] + away[:, None] + away).max(-1).min(-1)


def corners_of(rng: np.random.Generator, kind: str) -> Float64[np.ndarray, "corners 2"]:
    """z and height, m, of random ground of a kind."""
    corners, z, height = [(FIRST, 0.0)], FIRST, 0.0

    def plate(width: float, top: float) -> None:
        """Ground of another height for a while, between vertical sides."""
        corners.extend([(z, height), (z + EDGE, top), (z + width, top), (z + width + EDGE, height)])

    while z < LAST:
        z += rng.uniform(0.05, 0.9)
        match kind:
            case "rubble":
                z += rng.uniform(0.03, 0.15)
                corners.append((z, rng.uniform(-0.04, 0.04)))
            case "curb" | "ledge":
                low, high = (0.08, 0.18) if kind == "curb" else (0.12, 0.25)
                goes_up = height < (0.1 if kind == "curb" else 0.0)
                after = height + rng.uniform(low, high) * (1.0 if goes_up else -1.0)
                corners += [(z, height), (z + EDGE, after)]
                height = after
                z += 0.8
            case "ramp":
                length = rng.uniform(0.5, 1.5)
                after = height + length * np.tan(np.radians(rng.uniform(-15.0, 15.0)))
                corners += [(z, height), (z + length, after)]
                height = after
                z += length
            case "roots":
                z += 0.2
                width, top = rng.uniform(0.06, 0.12), rng.uniform(0.03, 0.08)
                corners += [(z, 0.0), (z + 0.3 * width, top), (z + 0.7 * width, top)]
                corners.append((z + width, 0.0))
                z += width
            case "gaps":
                z += 0.2
                width = rng.uniform(0.03, 0.15)
                plate(width, -rng.uniform(0.3, 1.0))
                z += width
            case "furniture":
                width = rng.uniform(0.3, 0.6)
                plate(width, rng.uniform(0.15, 0.3))
                z += width + 0.5
    return np.array(corners)


def sample(rng: np.random.Generator) -> Ground:
    """Random ground of a random kind."""
    kind = str(rng.choice(KINDS))
    return Ground(
        riser="vertical",
        tread=0.3,
        rise=0.15,
        depth=0.0,
        landing=False,
        down=False,
        field=True,
        start=0.0,
        heading=float(rng.uniform(-0.7, 0.7) * (rng.uniform() < 0.4)),
        phase=rng.uniform(),
        kind=kind,
        corners=corners_of(rng, kind),
    )
