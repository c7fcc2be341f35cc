"""Clips, terrain and rigs for pipeline tests, and conversions from the reference's types to ours.

Clips have `FRAMES` frames and two legs, and terrain has three planes, unless a test needs others:
equal shapes fraction one compiled program.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxik
from fitting.clips.clip import Clip
from fitting.synthetic import walker
from jaxik.maths import parameter_tree
from jaxik.stages import contact, pelvis
from jaxik.world import terrain
from reference import characters, maths, sample_poses
from reference.systems import record as reference
from reference.terrain import LegTerrains
from reference.terrain import Terrain as PlainTerrain

FRAMES = 240
HZ = 60.0


def named(stage: str, **values: Any) -> dict[str, Any]:
    """Values of a stage's parameters by dotted name."""
    return {f"{stage}.{name}": value for name, value in values.items()}


ODD: dict[str, Any] = (  # all parameters away from their defaults
    named("contact", ground_height=0.01, planted_height=0.095, raised_height=0.15)
    | named("probe", ray_up=0.4, ray_down=0.42, toe_ls=[0.02, -0.05, 0.18])
    | named("target", min_ankle_height=0.05, max_ankle_height=0.24, foot_height=0.07)
    | named("target", max_slope=0.3, rise_half_life=0.03, fall_half_life=0.06)
    | named("target", spring=True, follow_slopes=True, max_penetration=0.01)
    | named("lean", forward_rate=0.5, side_rate=-0.4, half_life=0.06, spring=True)
    | named("lean", forward_rate_slide=-0.6, side_rate_slide=0.7, half_life_slide=0.03)
    | named("lean", slide_on_half_life=0.07, slide_off_half_life=0.1)
    | named("lock", release_min_angle=1.2, release_max_angle=2.9, release_cone=0.2)
    | named("lock", release_distance=0.12, relock_threshold=0.4, max_speed=0.9, hold_ball=True)
    | named("lock", release_heading=0.15, release_speed=1.2, return_speed=0.3)
    | named("lock", lock_half_life=0.02, unlock_half_life=0.07)
    | named("pelvis", limit=0.05, half_life=0.06, airborne_half_life=0.14)
    | named("pelvis", vertical_only=False, wait_to_rise=True)
    | named("leg", max_knee_angle=2.8, min_knee_angle=1.6, soften=0.94)
    | named("leg", twist=0.1, as_animated=True, weight=0.9)
    | named("foot", max_pitch=0.1, min_pitch=-0.15, max_roll=0.08, min_roll=-0.1)
)


def to_transform(t: reference.Transform) -> jaxik.Transform:
    # `jnp.asarray` would compile a program for each shape.
    return jaxik.Transform(jax.device_put(t.pos), jax.device_put(t.rot))


def to_rig(rig: reference.Rig) -> jaxik.Rig:
    legs = len(rig.side)
    ones = jnp.ones(legs)
    return jaxik.Rig(
        knee_axis_ls=jnp.asarray(rig.knee_axis_ls),
        ankle_from_foot=jnp.asarray(rig.ankle_from_foot),
        thigh=ones * sample_poses.THIGH,
        shin=ones * sample_poses.SHIN,
        foot=ones * rig.foot,
        ankle_height=ones * 0.085,
        ball_height=ones * 0.05,
        side=jnp.asarray(rig.side, float),
        present=jnp.ones(legs, bool),
        names=tuple(f"leg {leg}" for leg in range(legs)),
        joints=tuple((4 * leg, 4 * leg + 1, 4 * leg + 2, 4 * leg + 3) for leg in range(legs)),
        pelvis=4 * legs,
    )


def to_frames(frames: Sequence[reference.Frame]) -> jaxik.Frame:
    """The frames stacked on a leading axis."""

    def stacked(arrays: Iterable[np.ndarray]) -> jax.Array:
        return jax.device_put(np.stack(list(arrays)))

    def transform(name: str) -> jaxik.Transform:
        each = [getattr(frame, name) for frame in frames]
        return to_transform(
            reference.Transform(np.stack([t.pos for t in each]), np.stack([t.rot for t in each]))
        )

    def platforms(name: str) -> jaxik.Transform:
        poses = [pose for frame in frames for pose in getattr(frame, name)]
        return jaxik.Transform(
            jax.device_put(np.reshape([pose.pos for pose in poses], (len(frames), -1, 3))),
            jax.device_put(np.reshape([pose.rot for pose in poses], (len(frames), -1, 4))),
        )

    return jaxik.Frame(
        world_from_model=transform("world_from_model"),
        pose=jaxik.LegPose(*map(transform, ("hip", "knee", "ankle", "toe"))),
        weight=stacked(frame.weight for frame in frames),
        grounded=jnp.asarray([float(frame.grounded) for frame in frames]),
        slide=jnp.asarray([float(frame.slide) for frame in frames]),
        velocity_ws=stacked(frame.travel_ws for frame in frames),
        foot_speed=stacked(frame.foot_speed for frame in frames),
        toe_speed=stacked(frame.toe_speed for frame in frames),
        stride=jaxik.world.frame.Stride(
            **{
                field.name: stacked(getattr(frame.stride, field.name) for frame in frames)
                for field in dataclasses.fields(characters.Stride)
                if getattr(frames[0].stride, field.name) is not None
            }
        ),
        dt=jnp.asarray([float(frame.dt) for frame in frames]),
        platforms=platforms("platforms"),
        platforms_before=platforms("platforms_before"),
    )


def by_speed() -> jaxik.FootIK:
    """`stride` with the rules for animations without contact labels, and another pelvis."""
    rules = {"contact": contact.SpeedContact(), "pelvis": pelvis.SupportPelvis()}
    return dataclasses.replace(jaxik.presets.stride(), **rules)


SYSTEMS = {  # for `to_ik`, beside the presets
    "by speed": by_speed,
    "record": functools.partial(jaxik.presets.record, faithful=True),
    "unreal": functools.partial(jaxik.presets.unreal, faithful=True),
    "mec": functools.partial(jaxik.presets.mec, faithful=True),
    "record as it comes": jaxik.presets.record,
    "mec as it comes": jaxik.presets.mec,
}


def to_ik(values: dict[str, Any], preset: str = "record") -> jaxik.FootIK:
    """The preset or system with this name, with some values replaced.

    As in the originals, its probe refuses no ground, nothing fades, and `unreal` and `mec` do not
    put themselves on the ground: `tests/stages/test_limits`, `test_fade` and `test_root` are about
    that. With the value `probe.limited` the probe refuses ground.
    """
    values = dict(values)
    limited = values.pop("probe.limited", False)
    if preset in ("unreal", "mec", "mec as it comes"):
        values = {"root.enabled": False} | values
    ik = (SYSTEMS.get(preset) or getattr(jaxik.presets, preset))()
    probe = dataclasses.replace(ik.probe, limited=limited)
    ik = dataclasses.replace(ik, probe=probe, fade=jaxik.stages.fade.NoFade())
    return parameter_tree.replace(ik, values)


def to_terrain(ground: PlainTerrain) -> terrain.Terrain:
    surfaces = [
        terrain.plane(point, normal, up=ground.up, layer=layer)
        for (point, normal), layer in zip(ground.planes, ground.plane_layers, strict=True)
    ]
    if len(ground.triangles):
        vertices = np.asarray(ground.triangles).reshape(-1, 3)
        triangles = np.arange(len(vertices)).reshape(-1, 3)
        layers = np.asarray(ground.triangle_layers)
        surfaces.append(terrain.mesh(vertices, triangles, up=ground.up, layer=layers))
    combined = terrain.combine(*surfaces)
    return combined if ground.platform < 0 else terrain.moving(combined, ground.platform)


def to_leg_terrains(ground: LegTerrains) -> terrain.LegTerrains:
    return terrain.LegTerrains(to_terrain(ground.body), tuple(map(to_terrain, ground.legs)))


def make_rig(seed: int = 0, legs: int = 2) -> reference.Rig:
    """A rig with random joint spaces."""
    return sample_poses.make_rig(np.random.default_rng(seed), legs)


def planes(*tilts: tuple[float, float, float]) -> PlainTerrain:
    """Three planes, each with its slope forward and to the left, and its height, m.

    Rays hit the highest plane below their start. Missing planes repeat the last one, each 100 m
    lower: with two equal planes, rounding would decide which of them gets the gradient.
    """
    all_tilts = (*tilts, *((*tilts[-1][:2], tilts[-1][2] - depth) for depth in (100.0, 200.0)))[:3]
    return PlainTerrain(
        maths.Y,
        planes=[
            (np.array([0.0, height, 0.0]), np.array([-left, 1.0, -forward]))
            for forward, left, height in all_tilts
        ],
    )


FLAT = planes((0.0, 0.0, 0.0))
BROKEN = planes(
    (0.2, 0.0, 0.0), (-0.25, 0.3, -0.3), (0.0, -0.35, -0.95)
)  # `wandering` hits two of them


def animate(
    rig: reference.Rig,
    ankles: Any = None,
    *,
    count: int = FRAMES,
    hz: float = HZ,
    hip_height: Any = 0.90,
    place: Any = (0.0, 0.0, 0.0),
    heading: Any = 0.0,
    foot: Any = 0.0,
    slide: Any = 0.0,
    weight: Any = 1.0,
    platform: Callable[[float], reference.Transform] | None = None,
) -> list[reference.Frame]:
    """Frames of two legs. Each argument is a value or a function of time, s.

    Args:
        rig: joint spaces.
        ankles: (legs, 3), m, model space; standing by default.
        count: frames.
        hz: frames per second.
        hip_height: m.
        place: position of the root, m, world space.
        heading: of the root about up, rad.
        foot: pitch of the feet, rad, toes up.
        slide: 0..1.
        weight: 0..1, one for all legs or one per leg.
        platform: world_from_platform, if there is one.
    """

    def at(x: Any, time: float) -> Any:
        return x(time) if callable(x) else x

    frames = []
    for index in range(count):
        time = index / hz
        root = reference.Transform(
            np.asarray(at(place, time), float), maths.from_axis_angle(maths.Y, at(heading, time))
        )
        frame = sample_poses.make_frame(
            rig,
            np.asarray(at(sample_poses.standing() if ankles is None else ankles, time), float),
            hip_height=at(hip_height, time),
            world_from_model=root,
            slide=at(slide, time),
            weight=np.broadcast_to(at(weight, time), len(rig.side)).astype(float),
            dt=1.0 / hz,
        )
        if platform is not None:
            frame.platforms = [platform(time)]
            frame.platforms_before = [platform(max(index - 1, 0) / hz)]
        tilt = maths.from_axis_angle(-maths.X, at(foot, time))
        rot = np.array([maths.multiply(tilt, r) for r in frame.ankle.rot])
        frames.append(dataclasses.replace(frame, ankle=frame.ankle._replace(rot=rot)))
    return sample_poses.with_speeds(frames)


def stepping(rig: reference.Rig, drift: float = 0.0, **changes: Any) -> list[reference.Frame]:
    """A walk of 0.6 m/s whose feet rise vertically, swing, and come down vertically.

    An ankle below the raised height does not move over the ground, except for `drift`, m/s, by
    which the whole walk slides sideways.
    """

    def ankles(time: float) -> np.ndarray:
        return np.array([_step(2.0 * time, leg) for leg in range(2)])

    def place(time: float) -> list[float]:
        return [drift * time, 0.0, 0.6 * time]

    changes.setdefault("place", place)
    return animate(rig, ankles, **changes)


def _step(cycles: float, leg: int) -> list[float]:
    cycle, phase = divmod(cycles + 0.5 * leg, 1.0)
    swing = min(max((phase - 0.65) / 0.2, 0.0), 1.0)
    lifted = min(max((phase - 0.5) / 0.15, 0.0), 1.0, (1.0 - phase) / 0.15)
    stride = 0.3 * (cycle + swing - 0.5 * leg) - 0.3 * cycles + 0.05
    return [0.1 - 0.2 * leg, sample_poses.ANKLE + 0.12 * lifted, stride]


def padded(frames: list, count: int = FRAMES) -> list:
    """The clip, extended by repeating its last frame."""
    return frames + [frames[-1]] * (count - len(frames))


def wandering(
    rig: reference.Rig,
    rng: np.random.Generator,
    count: int = FRAMES,
    stand: tuple[float, ...] = (),
    hz: float = HZ,
) -> list:
    """A clip with a bit of everything.

    It has steps, drifting feet, slides, half-weighted legs, time in the air, uneven frame times, a
    turning root, swinging hips and tilted feet. Its footholds are known in the first half only.

    Between the fractions `stand` of the clip (start, end, start, end, ...) the root stands still,
    at a speed of exactly 0, and the feet, paused in their step, only sway and bob a little.
    """
    stands = list(zip(stand[::2], stand[1::2], strict=True))
    legs = len(rig.side)
    frames = []
    heading, place, phase, stood = 0.3, np.array([-2.2, 0.0, -2.4]), 0.0, 0.0
    for index in range(count):
        dt = 1 / hz if index % 97 else 2 / hz
        sway = np.zeros(3)
        if any(start <= index / count < end for start, end in stands):
            stood += dt
            sway = np.array([0.004, 0.01, 0.004]) * np.sin(np.array([5.0, 9.0, 7.0]) * stood)
        else:
            phase += dt / 1.05
            heading += 0.25 * dt * np.sin(phase)
            place = place + dt * 0.6 * np.array([np.sin(heading), 0.0, np.cos(heading)])
        turned = maths.from_axis_angle(maths.Y, heading)
        ankles, swung = [], []
        for leg in range(legs):
            cycle = (phase + leg / legs) % 1.0
            swung.append(np.clip((cycle - 0.55) / 0.4, 0.0, 1.0) % 1.0)
            swing = np.sin(np.pi * swung[-1])
            x = 0.1 * rig.side[leg] + 0.01 * np.sin(3.1 * phase)
            ankle = [x, 0.08 + 0.12 * swing, 0.18 * np.cos(2 * np.pi * cycle)]
            ankles.append(ankle + sway * (-1.0) ** leg)
        fraction = index / count
        weight = np.ones(legs)
        if 0.67 < fraction < 0.73:
            weight[0] = 0.5
        if 0.77 < fraction < 0.78:
            weight[-1] = 0.0
        grounded = 0.0 if 0.85 < fraction < 0.88 else 0.4 if 0.88 < fraction < 0.91 else 1.0
        frame = sample_poses.make_frame(
            rig,
            np.array(ankles),
            hip_height=0.86 + 0.02 * np.sin(4 * np.pi * phase),
            hinge_yaw=0.2 * np.sin(phase),
            world_from_model=reference.Transform(place.copy(), turned),
            weight=weight,
            grounded=grounded,
            slide=float(0.3 < fraction < 0.5),
            dt=dt,
        )
        axis = rng.normal(size=3)
        tilt = maths.from_axis_angle(axis / np.linalg.norm(axis), rng.uniform(0.0, 0.2))
        rot = np.array([maths.multiply(tilt, r) for r in frame.ankle.rot])
        stride = _strides(frame, np.array(swung), known=fraction < 0.5)
        ankle = frame.ankle._replace(rot=rot)
        frames.append(dataclasses.replace(frame, ankle=ankle, stride=stride))
    return sample_poses.with_speeds(frames)


def _strides(frame: reference.Frame, fraction: np.ndarray, known: bool) -> characters.Stride:
    """Strides of half a metre forward, of which each foot has covered `fraction` (legs)."""
    balls = np.array([maths.apply(frame.world_from_model, pos) for pos in frame.toe.pos])
    forward = 0.5 * maths.rotate(frame.world_from_model.rot, maths.Z)
    return characters.Stride(
        standing=(fraction == 0.0).astype(float),
        last_ws=balls - fraction[:, None] * forward,
        next_ws=balls + (1.0 - fraction[:, None]) * forward,
        fraction=fraction,
        known=np.full(len(fraction), float(known)),
    )


def at(tree: Any, index: Any) -> Any:
    """Each leaf, indexed along its first axis."""
    return jax.tree.map(lambda leaf: leaf[index], tree)


def assert_close(actual: Any, expected: Any, tolerance: float) -> None:
    """Asserts that all leaves of two trees agree within `tolerance`; NaN never agrees."""
    paths = jax.tree_util.tree_leaves_with_path(expected)
    for (path, b), a in zip(paths, jax.tree.leaves(actual), strict=True):
        name = jax.tree_util.keystr(path)
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance, equal_nan=False, err_msg=name)


def legs_alone(clip: Clip) -> Clip:
    """A made walk without what is above its pelvis."""
    count = len(walker.LEGS)
    return dataclasses.replace(
        clip,
        joint_names=clip.joint_names[:count],
        parents=clip.parents[:count],
        offsets_ls=clip.offsets_ls[:count],
        positions_ws=clip.positions_ws[:, :count],
        rotations_ws=clip.rotations_ws[:, :count],
    )
