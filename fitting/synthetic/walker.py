"""A synthetic walk: feet placed exactly, swings, pelvis and arms as an average adult's.

Played directly, the measured curves of `gait` leave feet sliding by centimetres; `footsteps` places
them instead. The pelvis follows its curve as far as both legs reach their feet (`body`).

Above it a trunk turns against it, with a head and arms that swing. Lengths are those of Drillis and
Contini (1966), as Winter (Biomechanics and Motor Control of Human Movement, 2009, figure 4.1) gives
them, for a body with the walk's legs. Arms swing as Murray, Sepic and Barnard (1967, Physical
Therapy 47:272) filmed them in men who walked at their free speed: at the shoulder by 32 degrees,
three quarters of it backward, and at the elbow by 30. Each arm goes with the leg of the other side.
The chest turns against the pelvis by as much as in Stokes, Andersson and Forssberg (1989, J.
Biomech. 22:43), about four degrees to either side. The pelvis itself does not turn with the steps.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import convolve1d, maximum_filter1d
from scipy.spatial.transform import Rotation

from fitting.clips.assemble import JointMotion, clip_from_joints
from fitting.clips.clip import Clip
from fitting.clips.rigs import knee_positions, leg_rotations, unit

from . import footsteps
from .footsteps import (
    PHASE_OFFSETS,
    SIDES,
    FootMotion,
    GroundPath,
    heading_vectors,
    sample_footsteps,
    smoothstep,
)

MAX_REACH = 0.992  # of a leg's length, to which it extends: the knee keeps 15 degrees
SETTLE = 0.1  # s, before and after the pelvis gives way to a leg

# Above the pelvis.
UPPER_JOINTS = ("spine", "chest", "neck", "head",
                "left_shoulder", "left_elbow", "left_wrist",
                "right_shoulder", "right_elbow", "right_wrist")  # fmt: skip
UPPER_PARENTS = ("pelvis", "spine", "chest", "neck",
                 "chest", "left_shoulder", "left_elbow",
                 "chest", "right_shoulder", "right_elbow")  # fmt: skip
# m, up and ahead, from the joint before.
SPINE, CHEST, NECK, HEAD = (0.07, -0.015), (0.19, 0.0), (0.23, 0.0), (0.10, 0.02)
SHOULDER, HALF_WIDTH = 0.18, 0.175  # m, above the chest's joint and beside it
UPPER_ARM, FOREARM = 0.318, 0.25  # m
SHOULDER_REST, SHOULDER_SWING = -8.0, 16.0  # degrees forward
ELBOW_REST, ELBOW_SWING = 30.0, 15.0  # degrees of flexion
HANGING, HANGING_ELBOW = 2.0, 14.0  # degrees, of an arm that does not swing
ABDUCTION = 7.0  # degrees
LEAN = 2.0  # degrees, of the chest, forward
TURN = 4.0  # degrees, of the chest, to either side
FOREMOST = -0.085  # phase of a leg, in which its thigh is furthest forward
ELBOW_LAG = 0.06  # of a stride, after the shoulder

LEGS = ("pelvis", "left_hip", "left_knee", "left_ankle", "left_toe",
        "right_hip", "right_knee", "right_ankle", "right_toe")  # fmt: skip
JOINTS = (*LEGS, *UPPER_JOINTS)
PARENTS = (-1, 0, 1, 2, 3, 0, 5, 6, 7, *map(JOINTS.index, UPPER_PARENTS))

FREEZE_PHASE = 0.43  # of the rear foot; the heel of the front one is just down
EASE = 0.4  # s, shortest transition between walking and freezing, and of a slip
SETTLING = 0.25  # fraction of the normal cadence below which feet settle flat; both are down then

X, Y, Z = np.eye(3)
BREATH, BREATH_HZ = 0.003, 0.3  # m and Hz: the pelvis of a standing body rises and falls


@dataclass(frozen=True)
class Body:
    """Pelvis and feet over the frames, an adult's."""

    pelvis: Float64[np.ndarray, "frames 3"]
    """m, before it gives way."""
    yaw: Float64[np.ndarray, " frames"]
    """rad, heading of the pelvis; 0 faces +z, pi/2 faces +x."""
    feet: tuple[FootMotion, FootMotion]
    """Left and right."""
    fps: float
    knees: float = 1.0
    """1 bends the knees forward, as people do, -1 backward, as birds seem to."""
    phase: Float64[np.ndarray, " frames"] | None = None
    """Of the steps, in strides; without it the arms hang."""
    swing: Float64[np.ndarray, " frames"] | float = 1.0
    """How far arms swing with the steps, 1 as measured."""

    @cached_property
    def heading(self) -> Rotation:
        """Rotation of the pelvis."""
        return Rotation.from_rotvec(self.yaw[:, None] * [0.0, 1.0, 0.0])

    @cached_property
    def hips(self) -> list[Float64[np.ndarray, "frames 3"]]:
        """Positions of the hips, m, before the pelvis gives way."""
        offsets = [[side * footsteps.HALF_PELVIS, -footsteps.HIP_DROP, 0.0] for side in SIDES]
        return [self.pelvis + self.heading.apply(offset) for offset in offsets]

    def sinking(self) -> Float64[np.ndarray, " frames"]:
        """How far the body sinks, m, smoothly, so that both legs reach their feet."""
        missing = np.zeros(len(self.pelvis))
        max_length = MAX_REACH * (footsteps.THIGH + footsteps.SHIN)
        for hip, foot in zip(self.hips, self.feet, strict=True):
            leg = hip - foot.ankle
            highest = np.sqrt(max_length**2 - leg[:, 0] ** 2 - leg[:, 2] ** 2)
            missing = np.maximum(missing, leg[:, 1] - highest)
        # A mean of maxima over the same window is nowhere below what is needed.
        kernel = np.hanning(2 * round(SETTLE * self.fps) + 3)[1:-1]
        upper = maximum_filter1d(missing, len(kernel), mode="nearest")
        return convolve1d(upper, kernel / kernel.sum(), mode="nearest")

    def clip(self, source: str, sinking: np.ndarray, drifted: np.ndarray | float = 0.0) -> Clip:
        """The body as a clip with contact labels.

        Args:
            source: name of the clip.
            sinking: how far the body sinks, m, (frames,); see `sinking`.
            drifted: how far it has drifted, feet included, m, (frames, 3).
        """
        lowered = sinking[:, None] * [0.0, 1.0, 0.0]
        left_ws = heading_vectors(self.yaw + np.pi / 2)
        positions = [self.pelvis - lowered]
        rotations = [self.heading.as_quat(scalar_first=True)]
        for hip, foot in zip(self.hips, self.feet, strict=True):
            hip = hip - lowered
            forward = self.knees * unit(np.cross(unit(foot.ankle - hip), left_ws))
            knee = knee_positions(hip, foot.ankle, forward, (footsteps.THIGH, footsteps.SHIN))
            positions += [hip, knee, foot.ankle, foot.ball]
            rotations += [*leg_rotations(hip, knee, foot.ankle, left_ws), foot.rot, foot.rot]
        phase = np.zeros(len(self.yaw)) if self.phase is None else self.phase
        swing = np.broadcast_to(0.0 if self.phase is None else self.swing, phase.shape)
        upper = upper_body(positions[0], self.heading, phase, swing)
        drift = np.broadcast_to(drifted, self.pelvis.shape)
        motion = JointMotion(
            JOINTS, PARENTS,
            np.concatenate([np.stack(positions, axis=1), upper[0]], axis=1) + drift[:, None],
            np.concatenate([np.stack(rotations, axis=1), upper[1]], axis=1),
            np.stack([foot.stance for foot in self.feet], axis=-1),
            float(self.fps),
        )  # fmt: skip
        return clip_from_joints(motion, source)


@dataclass(frozen=True)
class Event:
    """A part of a walk."""

    start: float
    """Seconds."""
    end: float
    """Seconds."""


@dataclass(frozen=True)
class Slip(Event):
    """The root moves faster or slower than the feet step, as game roots do."""

    speed_change: float
    """Fraction of the walking speed, added; negative if the root lags behind."""


class Slide(Event):
    """The walk freezes and the whole body glides on at walking speed."""


class Stop(Event):
    """The walk slows down, stands on both feet, and walks on.

    It slows down from `start` for 0.4 to 1.5 s, until the next step is complete, and then stands
    exactly still until `end`.
    """


class SpeedProfile(NamedTuple):
    """How fast a walk goes in each frame."""

    cadence: Float64[np.ndarray, " frames"]
    """Fraction of the normal cadence."""
    drift: Float64[np.ndarray, " frames"]
    """m/s, speed of the whole body beyond what the feet step."""
    slide: Float64[np.ndarray, " frames"]
    """1 in a slide, else 0."""
    still: Float64[np.ndarray, " frames"]
    """0..1, 1 while the character stands."""


def speed_profile(
    time: Float64[np.ndarray, " frames"], fps: float, events: Sequence[Event]
) -> SpeedProfile:
    """The speed at these times, s; slides and stops begin once both feet are down.

    Args:
        time: s, from 0.
        fps: frames per second.
        events: slides and stops must not overlap.
    """
    speed = footsteps.STRIDE / footsteps.PERIOD
    cadence, gliding, standing = np.ones_like(time), np.ones_like(time), np.ones_like(time)
    slide = np.zeros_like(time)
    freezes = [event for event in events if not isinstance(event, Slip)]
    for event in sorted(freezes, key=lambda event: event.start):
        phase = cadence[time < event.start].sum() / (fps * footsteps.PERIOD)
        remaining = (FREEZE_PHASE - phase - 0.2) % 0.5 + 0.2  # of a stride, until the walk freezes
        down = smoothstep((time - event.start) / (2.0 * footsteps.PERIOD * remaining))
        up = smoothstep((time - event.end) / EASE)
        walking = 1.0 - np.minimum(down, 1.0 - up)
        cadence *= walking
        if isinstance(event, Stop):
            standing *= walking
        else:
            gliding *= walking
            slide[(time >= event.start) & (time < event.end)] = 1.0
    drift = speed * (1.0 - gliding)
    for event in events:
        if isinstance(event, Slip):
            fade_in = smoothstep((time - event.start) / EASE)
            fade_out = smoothstep((event.end - time) / EASE)
            drift = drift + event.speed_change * speed * (fade_in * fade_out) * cadence
    return SpeedProfile(cadence, drift, slide, smoothstep(1.0 - standing / SETTLING))


@dataclass(frozen=True)
class WalkStyle:
    """How straight and how regular a walk is."""

    bend: float = 0.09
    """rad, about how far the path turns away from +z to either side."""
    variation: float = 1.0
    """Of strides, 1 as measured; 0 makes all alike."""
    knees: float = 1.0
    """1 bends the knees forward, -1 backward."""


def walk(
    seconds: float = 12.0,
    fps: float = 60.0,
    seed: int = 0,
    events: Sequence[Event] = (),
    style: WalkStyle = WalkStyle(),
) -> Clip:
    """A walk over the floor y = 0, from the origin along +z, with its contact labels.

    A foot is labelled as standing while its ball is placed. It then does not move, except in slips
    and slides, which carry the whole body along, standing feet included. In a stop both feet lie
    flat and nothing moves but the pelvis, which breathes up and down.

    Args:
        seconds: length of the clip.
        fps: frames per second.
        seed: of the differences between strides.
        events: slips, slides and stops. Slides and stops must be 2 s or more apart. `Clip.slide` is
            1 in slides, and None without any.
        style: how straight and how regular the walk is.

    Raises:
        ValueError: a length or rate that is not above 0, or an event outside the clip.
    """
    if not (seconds > 0 and fps > 0):
        raise ValueError(f"wanted seconds and fps above 0, got {seconds} s at {fps} fps")
    for event in events:
        if not 0 <= event.start < event.end <= seconds:
            raise ValueError(f"{event} does not lie in the clip's {seconds} s")
    time = np.arange(round(seconds * fps)) / fps
    cadence, drift, slide, still = speed_profile(time, fps, events)
    phase = np.concatenate([[0.0], np.cumsum(cadence[:-1])]) / (fps * footsteps.PERIOD)
    strides = int(phase[-1]) + 3
    rng = np.random.default_rng(seed)
    path = GroundPath(style.bend, rng.uniform(0.0, 2.0 * np.pi))

    along = footsteps.STRIDE * phase
    yaw = path.yaw(along)
    drift_ws = drift[:, None] * heading_vectors(yaw)
    drifted = np.concatenate([np.zeros((1, 3)), np.cumsum(drift_ws[:-1], axis=0)]) / fps
    bob = _smooth_noise(phase, strides, rng) * footsteps.HEIGHT_SD * style.variation
    pelvis = path.points(along, 0.0, footsteps.curve(footsteps.HEIGHT, phase) + bob)
    left, right = (
        sample_footsteps(leg, strides, path, style.variation, rng).motion(phase, still)
        for leg in range(len(SIDES))
    )
    body = Body(pelvis, yaw, (left, right), fps, style.knees, phase, cadence)
    breath = BREATH * 0.5 * (1.0 - np.cos(2.0 * np.pi * BREATH_HZ * time))
    clip = body.clip(f"walker seed {seed}", body.sinking() + still * breath, drifted)
    has_slide = any(isinstance(event, Slide) for event in events)
    return replace(clip, slide=slide if has_slide else None)


def _smooth_noise(phase: np.ndarray, strides: int, rng: np.random.Generator) -> np.ndarray:
    """A smooth curve through one standard normal value per stride."""
    values = rng.normal(size=strides + 1)
    stride = np.floor(phase).astype(int)
    return values[stride] + smoothstep(phase - stride) * (values[stride + 1] - values[stride])


def upper_body(
    pelvis: Float64[np.ndarray, "frames 3"],
    heading: Rotation,
    phase: Float64[np.ndarray, " frames"],
    strength: Float64[np.ndarray, " frames"],
) -> tuple[Float64[np.ndarray, "frames joints 3"], Float64[np.ndarray, "frames joints 4"]]:
    """Positions, m, and rotations, wxyz, of `UPPER_JOINTS` over a pelvis.

    Args:
        pelvis: its position, m.
        heading: its rotation.
        phase: of the walk, in strides.
        strength: of arm swing and turn, 1 as measured; at 0 arms hang.
    """
    # The left leg is in front at the phase 0: the chest then faces left, with the right arm.
    turn = np.radians(TURN) * strength * np.cos(2.0 * np.pi * (phase - FOREMOST))
    spine_rot = heading * _about(Y, 0.5 * turn)
    chest_rot = heading * _about(Y, turn) * _about(X, np.full_like(turn, np.radians(LEAN)))
    spine = pelvis + heading.apply(_offset(SPINE))
    chest = spine + spine_rot.apply(_offset(CHEST))
    neck = chest + chest_rot.apply(_offset(NECK))
    head = neck + heading.apply(_offset(HEAD))
    positions, rotations = [spine, chest, neck, head], [spine_rot, chest_rot, heading, heading]
    for side, offset in zip(SIDES, PHASE_OFFSETS, strict=True):
        own = phase - offset - FOREMOST
        forward = -np.cos(2.0 * np.pi * own)  # against the leg of its side
        late = -np.cos(2.0 * np.pi * (own - ELBOW_LAG))
        shoulder_angle = _blend(HANGING, SHOULDER_REST + SHOULDER_SWING * forward, strength)
        elbow_angle = _blend(HANGING_ELBOW, ELBOW_REST + ELBOW_SWING * late, strength)
        outward = _about(Z, np.full_like(turn, np.radians(side * ABDUCTION)))
        upper_rot = chest_rot * outward * _about(X, -shoulder_angle)
        fore_rot = upper_rot * _about(X, -elbow_angle)
        shoulder = chest + chest_rot.apply([side * HALF_WIDTH, SHOULDER, 0.0])
        elbow = shoulder + upper_rot.apply([0.0, -UPPER_ARM, 0.0])
        wrist = elbow + fore_rot.apply([0.0, -FOREARM, 0.0])
        positions += [shoulder, elbow, wrist]
        rotations += [upper_rot, fore_rot, fore_rot]
    quats = [rotation.as_quat(scalar_first=True) for rotation in rotations]
    return np.stack(positions, axis=1), np.stack(quats, axis=1)


def _offset(up_and_ahead: tuple[float, float]) -> list[float]:
    up, ahead = up_and_ahead
    return [0.0, up, ahead]


def _about(axis: np.ndarray, angle: np.ndarray) -> Rotation:
    return Rotation.from_rotvec(angle[:, None] * axis)


def _blend(rest: float, moving: np.ndarray, strength: np.ndarray) -> np.ndarray:
    """An angle, rad, between one at rest and one that swings, both in degrees."""
    return np.radians(rest + strength * (moving - rest))
