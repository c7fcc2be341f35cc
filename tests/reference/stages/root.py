"""The root of the references: the height at which the whole character is put."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from reference import maths
from reference.characters import Frame, Ground, Parameters, carried
from reference.maths import Motion, across, clip, length
from reference.terrain import ALL_LAYERS

DEFAULTS: dict[str, Any] = {
    "root.enabled": True,
    "root.ray_up": 10.0,
    "root.ray_down": math.inf,
    "root.layers": ALL_LAYERS,
    "root.half_life": 0.2,
    "root.max_speed": 4.0,
    "root.max_step": 0.4,
}


@dataclass
class Root:
    """Memory of the root: where it was put, m along up, how fast it moved there, m/s."""

    height: float
    velocity: float
    lift: float  # m, of that height above the character's origin


def place(parameters: Parameters, terrain: Ground, frame: Frame, before: Root | None) -> Root:
    """The root after this frame; without one before, it starts on the ground."""
    up, origin = terrain.up, frame.world_from_model.pos
    lag = max(parameters["root.half_life"] / math.log(2.0) - frame.dt / 2.0, 0.0)
    travel = across(frame.travel_ws, up) * lag
    ray_up = parameters["root.ray_up"]
    reach, mask = ray_up + parameters["root.ray_down"], int(parameters["root.layers"])
    here, there = (
        terrain.cast(point + up * ray_up, reach, mask) for point in (origin, origin + travel)
    )
    if not (parameters["root.enabled"] and here.found and frame.grounded > 0.5):
        lift = 0.0 if before is None else before.lift
        return Root(float(up @ origin) + lift, 0.0, lift)

    below = goal = float(up @ here.point)
    if there.found:
        step = abs(float(up @ there.point) - goal) - length(travel)
        goal = float(up @ there.point) if step <= parameters["root.max_step"] else goal
    fastest = parameters["root.max_speed"] if parameters["root.half_life"] > 0.0 else math.inf
    if before is None:
        velocity = clip((goal - below) / lag, -fastest, fastest) if lag > 0.0 else 0.0
        return Root(below, velocity, below - float(up @ origin))

    # The platform's point that is below the character now was elsewhere one frame ago.
    start, turned = carried(frame, here, np.zeros(3)), [carried(frame, here, a) for a in np.eye(3)]
    axes = np.array([axis - start for axis in turned])
    height = before.height + float(up @ (here.point - axes @ (here.point - start)))
    moved = maths.follow(
        Motion(height, before.velocity), goal, parameters["root.half_life"], frame.dt, True
    )
    height += clip(moved.value - height, -fastest * frame.dt, fastest * frame.dt)
    velocity = clip(moved.velocity, -fastest, fastest)
    return Root(height, velocity, height - float(up @ origin))
