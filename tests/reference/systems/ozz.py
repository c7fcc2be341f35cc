"""The `ozz` system, after the foot IK sample of ozz-animation."""

import functools
import math
from dataclasses import dataclass

import numpy as np

from reference import characters, maths
from reference.characters import Frame, Ground, Leg, Parameters, Rig, carried, named
from reference.maths import Array, Motion, across, clip, cross, length, multiply, rotate, unit
from reference.stages import ground, limb
from reference.terrain import ALL_LAYERS, Hit

DEFAULTS = (
    named("root", enabled=True, ray_up=10.0, ray_down=math.inf, layers=ALL_LAYERS)
    | named("root", half_life=0.2, max_speed=4.0, max_step=0.4, max_gap=0.15)
    | named("probe", ray_up=0.5, ray_down=math.inf)
    | named("target", foot_height=0.12, max_slope=1.5)
    | named("pelvis", enabled=True, limit=math.inf, half_life=0.0, airborne_half_life=0.0)
    | named("leg", enabled=True, soften=1.0, twist=0.0, weight=1.0)
    | named("foot", enabled=True, twist=0.0, weight=1.0, offset=np.zeros(3))
)


@dataclass
class Root:
    """Memory of the root: where it was put, m along up, how fast it moved there, m/s."""

    height: float
    velocity: float
    lift: float  # m, of that height above the character's origin


@dataclass
class State:
    """Memory between frames."""

    root: Root
    pelvis_height: float


@dataclass(frozen=True)
class Foot(Leg):
    """A leg in a frame with its hit and target, the character already put on the ground."""

    ankle_ws: Array
    hit: Hit
    target_ws: Array


def step(
    parameters: Parameters, rig: Rig, terrain: Ground, state: State | None, frame: Frame
) -> tuple[State, dict[str, Array]]:
    """One frame."""
    up = terrain.up
    root = place_root(parameters, terrain, frame, state.root if state else None)
    legs = characters.legs_of(parameters, rig, terrain, frame)
    feet = [sense(leg, up * root.lift) for leg in legs]
    pelvis = pelvis_height(parameters, feet, up, state)
    pelvis_offset_ws = up * pelvis * frame.grounded
    body_offset_ws = up * root.lift + pelvis_offset_ws
    body = limb.body(frame, body_offset_ws, maths.IDENTITY)

    solved, foot_reached, weights = [], [], []
    for foot in feet:
        weight = foot.weight if foot.hit.found else 0.0
        leg_weight = weight if foot["leg.enabled"] else 0.0
        # The pole is the y axis of the carried knee.
        _, knee, ankle = limb.carry(body, foot)
        along_shin = unit(ankle.pos - knee.pos, np.zeros(3))
        target_ms = maths.unapply(frame.world_from_model, foot.target_ws)
        pole = cross(limb.hinge_of(foot, knee), along_shin)
        leg = limb.solve_leg_to_pole(foot, body, target_ms, pole, leg_weight)
        rot, aimed = aim_foot(foot, leg.ankle, weight)
        solved.append(limb.with_foot(foot, leg, rot))
        foot_reached.append(aimed)
        weights.append(leg_weight)

    output = characters.solution(body, solved) | {
        "lift": np.array(root.lift),
        "pelvis_height": np.array(pelvis),
        "pelvis_offset_ws": pelvis_offset_ws,
        "body_offset_ws": body_offset_ws,
        "found": np.array([foot.hit.found for foot in feet]),
        "target_ws": np.array([foot.target_ws for foot in feet]),
        "weight": np.array(weights),
        "foot_reached": np.array(foot_reached),
    }
    return State(root, pelvis), output


run = functools.partial(characters.run, step)


def place_root(parameters: Parameters, terrain: Ground, frame: Frame, before: Root | None) -> Root:
    """The root after this frame; without one before, it starts on the ground."""
    up, origin = terrain.up, frame.world_from_model.pos
    half_life = parameters["root.half_life"]
    lag = max(half_life / math.log(2.0) - frame.dt / 2.0, 0.0)
    travel = across(frame.travel_ws, up) * lag
    ray_up = parameters["root.ray_up"]
    reach, mask = ray_up + parameters["root.ray_down"], int(parameters["root.layers"])
    ahead = characters.forward(frame.world_from_model.rot, up)
    side = (ahead + maths.cross(ahead, up)) * (
        parameters["root.max_gap"] if half_life > 0.0 else 0.0
    )

    def below_body(point: Array) -> Hit:
        """What carries the character there: over a narrow gap its lower side."""
        hit, *sides = (
            terrain.cast(point + away + up * ray_up, reach, mask) for away in (0.0, side, -side)
        )
        if hit.found and all(x.found for x in sides):
            depth = min(float(up @ x.point) for x in sides) - float(up @ hit.point)
            hit = hit._replace(point=hit.point + up * max(depth, 0.0))
        return hit

    here, there = map(below_body, (origin, origin + travel))
    if not (parameters["root.enabled"] and here.found and frame.grounded > 0.5):
        lift = before.lift if before else 0.0
        return Root(float(up @ origin) + lift, 0.0, lift)

    below = goal = float(up @ here.point)
    if there.found:
        step = abs(float(up @ there.point) - goal) - length(travel)
        goal = float(up @ there.point) if step <= parameters["root.max_step"] else goal
    fastest = parameters["root.max_speed"] if half_life > 0.0 else math.inf
    if before is None:
        velocity = clip((goal - below) / lag, -fastest, fastest) if lag > 0.0 else 0.0
        return Root(below, velocity, below - float(up @ origin))

    # The platform's point that is below the character now was elsewhere one frame ago.
    start, *moved = (carried(frame, here, point) for point in (np.zeros(3), *np.eye(3)))
    axes = np.array(moved) - start
    height = before.height + float(up @ (here.point - axes @ (here.point - start)))
    eased = maths.follow(Motion(height, before.velocity), goal, half_life, frame.dt, True)
    height += clip(eased.value - height, -fastest * frame.dt, fastest * frame.dt)
    velocity = clip(eased.velocity, -fastest, fastest)
    return Root(height, velocity, height - float(up @ origin))


def sense(leg: Leg, lift_ws: Array) -> Foot:
    """Ray and ankle target of one leg."""
    up, ray_up = leg.up, leg["probe.ray_up"]
    target = ankle_ws = leg.pos_ws("ankle") + lift_ws
    hit = leg.terrain.cast(ankle_ws + up * ray_up, ray_up + leg["probe.ray_down"])
    if hit.found:
        cosine = max(float(hit.normal @ up), math.cos(leg["target.max_slope"]))
        target = hit.point + up * (leg["target.foot_height"] / cosine)
    return Foot(**vars(leg), ankle_ws=ankle_ws, hit=hit, target_ws=target)


def pelvis_height(
    parameters: Parameters, feet: list[Foot], up: Array, state: State | None
) -> float:
    """Height of the body above its animated position along up, m."""
    gaps = [float(up @ (foot.target_ws - foot.ankle_ws)) for foot in feet]
    weights = [foot.weight if foot.hit.found else 0.0 for foot in feet]
    contact = max(weights) if parameters["pelvis.enabled"] else 0.0
    before = state.pelvis_height if state else None
    low = ground.lowest_of(gaps, weights, [foot.weight for foot in feet])
    return ground.follow_standing(parameters, low, contact, before, feet[0].frame.dt)


def aim_foot(foot: Foot, ankle: maths.Transform, weight: float) -> tuple[Array, bool]:
    """Model-space rotation of the ankle with its sole on the ground, and whether it gets there."""
    weight = weight * foot["foot.weight"] if foot["foot.enabled"] else 0.0
    world = foot.frame.world_from_model
    carried_ws = multiply(world.rot, ankle.rot)
    world_from_foot = multiply(carried_ws, foot.rig.ankle_from_foot[foot.index])
    toes = rotate(world_from_foot, maths.Z)
    correction, reached = aim(
        forward=rotate(world_from_foot, maths.Y),
        offset=rotate(world_from_foot, np.asarray(foot["foot.offset"])),
        up=toes,
        target=foot.target_ws + foot.hit.normal - maths.apply(world, ankle.pos),
        pole=toes,
        twist=foot["foot.twist"],
    )
    correction = maths.nlerp(maths.IDENTITY, correction, weight)
    rot = multiply(maths.inverse(world.rot), multiply(correction, carried_ws))
    return rot, reached and weight >= 1.0


def aim(
    forward: Array, offset: Array, up: Array, target: Array, pole: Array, twist: float
) -> tuple[Array, bool]:
    """Rotation after which the ray from `offset` along `forward` passes through `target`.

    `up` then faces `pole`. All (3) in one space, from the joint. The identity where the ray passes
    the joint farther away than the target is, or where the target is on the joint. Also whether
    the target is reached.
    """
    along = float(offset @ forward)
    root = float(target @ target) - float(offset @ offset) + along**2
    if root < 0.0:
        return maths.IDENTITY, False
    distance = length(target)
    if distance < maths.DIRECTIONLESS:
        return maths.IDENTITY, True
    direction = target / distance
    reach = offset + forward * (math.sqrt(root) - along)
    arc = maths.shortest_arc(unit(reach, direction), direction, up)
    to_pole = maths.from_axis_angle(direction, maths.signed_angle(rotate(arc, up), pole, direction))
    return multiply(maths.from_axis_angle(direction, twist), multiply(to_pole, arc)), True
