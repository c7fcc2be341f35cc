"""Skating: standing feet all move at one velocity, as in a cycle in place or under a wrong root.

Balls near their lowest height stand or are about to, and those that stand share a velocity in the
character's own axes: none in a capture, that of the ground in a cycle in place, and what is too
much in a root that travels too far for its steps.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float64
from scipy.ndimage import gaussian_filter1d

from . import contacts
from .rigs import unit

Travel = Literal["auto", "stances", "none"]
TRAVELS = get_args(Travel)
LOW = 0.04  # m over its lowest twentieth, of an adult's ball that may stand
SWING = 0.25  # s: width of the Gaussian that takes the pelvis' swing out of its way and heading
MOST = 500  # velocities among which the common one is sought
NOTICED = 0.12  # m/s, of an adult: the balls of feet that roll in a capture are as fast
STEADY = 0.45  # of the skating's speed: the deviation of its velocity, below which it is clear
UNEVEN = 0.2  # of it, by which feet in a cycle in place differ, as a pelvis hastens and slows
SURE = 0.1  # of it, below which it is sure
IN_PLACE = 0.15  # of a skating's speed: a slower pelvis stays in place
BLEND = 0.05  # s inside a stance, at which its velocity counts as much as the common one
DIRECTIONS = ("forward", "forward and left", "left", "back and left")
OPPOSITE = ("back", "back and right", "right", "forward and right")


@dataclass(frozen=True)
class Skating:
    """How the standing feet of a clip move over the floor, all alike."""

    velocity: Float64[np.ndarray, "2"]
    """m/s, forward and left."""
    spread: float
    """m/s, median deviation of standing balls from it."""
    is_clear: bool
    """Whether standing feet clearly move like that, and do not stand still."""
    in_place: bool
    """Whether the pelvis stays where it is while the feet skate."""
    root_speed: float
    """m/s, of the pelvis on its way over the floor."""
    stance: Bool[np.ndarray, "frames legs"]
    """Where each foot stands, skating or not."""
    travel_ws: Float64[np.ndarray, "frames 3"]
    """m, by which the character is moved so that standing feet stay where they stand."""

    @property
    def speed(self) -> float:
        """m/s."""
        return float(np.linalg.norm(self.velocity))

    def moves_root(self, travel: str | None) -> bool:
        """Whether the root is to travel as standing feet show.

        Args:
            travel: one of `TRAVELS`; None is "auto".

        Raises:
            ValueError: it has to, and no foot stands.
        """
        if travel == "stances" and not self.stance.any():
            raise ValueError(
                "no foot ever stands, from which travel could follow; leave out --travel stances "
                "(travel=... in Python)"
            )
        return travel == "stances" or (self.in_place and travel != "none")

    def remarks(self, travel: str | None) -> list[str]:
        """How feet skate, how sure that is, and what became of the root; nothing if they do not."""
        if not self.is_clear:
            return []
        moved = self.moves_root(travel)
        remedy = f"give --travel {'none' if moved else 'stances'} (travel=... in Python)"
        if not moved:
            ending = f"to move the root so that they stay put, {remedy}"
        elif self.in_place:
            ending = (
                f"the root now travels {_direction(-self.velocity)} at {self.speed:.2f} m/s; to "
                f"keep it in place, {remedy}"
            )
        else:
            ending = "the root now travels so that they stay put"
        return [f"{self._text()}; {ending}"]

    def _text(self) -> str:
        """How feet skate, and how sure that is."""
        certainty = "sure" if self.spread < SURE * self.speed else "likely"
        count = sum(len(contacts.runs(leg)) for leg in self.stance.T)
        evidence = f"{certainty}: within {100 * self.spread:.1f} cm/s in {count} stances"
        direction = _direction(self.velocity)
        if self.in_place:
            return f"in place: standing feet move {direction} at {self.speed:.2f} m/s ({evidence})"
        return (
            f"standing feet slide {direction} by {100 * self.speed:.0f} cm/s ({evidence}), while "
            f"the root travels at {100 * self.root_speed:.0f} cm/s"
        )


def measure(
    balls_ws: Float64[np.ndarray, "frames legs 3"],
    pelvis_ws: Float64[np.ndarray, "frames 3"],
    left_ws: Float64[np.ndarray, "frames 3"],
    fps: float,
    size: float,
) -> Skating:
    """How the standing feet of a clip skate, and when they stand.

    Args:
        balls_ws: of the feet, m, y up.
        pelvis_ws: m.
        left_ws: unit, to the character's left.
        fps: frames per second.
        size: length of the legs relative to an adult's.
    """
    still = contacts.detect_stances(balls_ws, fps, size)
    count = len(balls_ws)
    if count < 2:
        return Skating(np.zeros(2), 0.0, False, False, 0.0, still, np.zeros((count, 3)))
    axes_ws = _axes(left_ws, fps)
    steadied_ws = contacts.steadied(balls_ws, fps, size)
    steps_ws = np.diff(steadied_ws, axis=0)
    own = np.einsum("flk,fka->fla", steps_ws, axes_ws[:-1]) * fps
    heights = steadied_ws[:-1, :, 1]
    low = heights <= np.quantile(heights, 0.05, axis=0) + LOW * size
    velocity = _common(own[low], contacts.speed_limit(size))
    speed = float(np.linalg.norm(velocity))
    common_ws = axes_ws[:-1] @ velocity / fps
    slack = UNEVEN * speed
    stance = contacts.detect_stances(balls_ws - _path(common_ws)[:, None], fps, size, slack)
    deviations = np.linalg.norm(own - velocity, axis=-1)[stance[:-1]]
    spread = float(np.median(deviations)) if len(deviations) else np.inf
    travel_ws = -_path(_standing_steps(steps_ws, stance, common_ws, BLEND * fps))
    stance = contacts.detect_stances(balls_ws + travel_ws[:, None], fps, size)
    is_clear = bool(
        speed > NOTICED * size**contacts.SPEED_POWER
        and spread < STEADY * speed
        and stance.any(axis=0).all()
        and not stance.all(axis=0).any()
        and stance.sum() >= still.sum()
    )
    root_speed = _root_speed(pelvis_ws, fps)
    in_place = is_clear and root_speed < IN_PLACE * speed
    stance = stance if is_clear else still
    return Skating(velocity, spread, is_clear, in_place, root_speed, stance, travel_ws)


def _root_speed(pelvis_ws: Float64[np.ndarray, "frames 3"], fps: float) -> float:
    """Median speed of the pelvis over the floor, without its sway, m/s."""
    way_ws = gaussian_filter1d(pelvis_ws, SWING * fps, axis=0, mode="nearest")
    steps = np.linalg.norm(np.diff(way_ws[:, [0, 2]], axis=0), axis=-1)
    return float(np.median(steps)) * fps


def _axes(
    left_ws: Float64[np.ndarray, "frames 3"], fps: float
) -> Float64[np.ndarray, "frames 3 2"]:
    """Unit vectors forward and to the left, level and without the swing of the pelvis."""
    level = left_ws * [1.0, 0.0, 1.0]
    left_ws = unit(gaussian_filter1d(level, SWING * fps, axis=0, mode="nearest"))
    return np.stack([np.cross(left_ws, [0.0, 1.0, 0.0]), left_ws], axis=-1)


def _common(velocities: Float64[np.ndarray, "n 2"], limit: float) -> Float64[np.ndarray, "2"]:
    """The velocity, m/s, to which most others are nearer than `limit`."""
    chosen = velocities[np.linspace(0, len(velocities) - 1, min(MOST, len(velocities))).astype(int)]
    apart = np.linalg.norm(chosen[:, None] - chosen, axis=-1)
    near = apart < limit
    best = int(np.argmax(near.sum(axis=1)))
    return np.median(chosen[near[best]], axis=0)


def _standing_steps(
    steps_ws: Float64[np.ndarray, "steps legs 3"],
    stance: Bool[np.ndarray, "frames legs"],
    common_ws: Float64[np.ndarray, "steps 3"],
    blend: float,
) -> Float64[np.ndarray, "steps 3"]:
    """How far standing feet move from each frame to the next, m, level.

    A foot counts by how many frames it has stood and will stand; the common step counts as much as
    `blend` frames, so that it rules at the ends of stances and in the air.
    """
    weight = np.zeros((len(steps_ws), stance.shape[1], 1))
    for leg in range(stance.shape[1]):
        for first, last in contacts.runs(stance[:, leg]):
            inside = np.arange(last - first)
            weight[first:last, leg, 0] = np.minimum(inside, inside[::-1])
    moved_ws = (weight * steps_ws).sum(axis=1) + blend * common_ws
    return moved_ws / (weight.sum(axis=1) + blend) * [1.0, 0.0, 1.0]


def _path(steps_ws: Float64[np.ndarray, "steps 3"]) -> Float64[np.ndarray, "frames 3"]:
    """Where these steps lead from the origin."""
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps_ws, axis=0)])


def _direction(velocity: Float64[np.ndarray, "2"]) -> str:
    """The nearest of eight directions, in words."""
    octant = round(float(np.arctan2(velocity[1], velocity[0])) / (np.pi / 4)) % 8
    return (DIRECTIONS + OPPOSITE)[octant]
