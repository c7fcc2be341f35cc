"""A synthetic walk: feet placed exactly, swings, pelvis and arms as an average adult's.

Played directly, the measured curves of `gait` leave feet sliding by centimetres; `footsteps` places
them instead. The pelvis follows its curve as far as both legs reach their feet (`body`).
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

from . import footsteps, upper_body
from .footsteps import SIDES, FootMotion, GroundPath, heading_vectors, sample_footsteps, smoothstep

MAX_REACH = 0.992  # of a leg's length, to which it extends: the knee keeps 15 degrees
SETTLE = 0.1  # s, before and after the pelvis gives way to a leg
LEGS = ("pelvis", "left_hip", "left_knee", "left_ankle", "left_toe",
        "right_hip", "right_knee", "right_ankle", "right_toe")  # fmt: skip
JOINTS = (*LEGS, *upper_body.JOINTS)
PARENTS = (-1, 0, 1, 2, 3, 0, 5, 6, 7, *map(JOINTS.index, upper_body.PARENTS))

FREEZE_PHASE = 0.43  # of the rear foot; the heel of the front one is just down
EASE = 0.4  # s, shortest transition between walking and freezing, and of a slip
SETTLING = 0.25  # fraction of the normal cadence below which feet settle flat; both are down then

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
        upper = upper_body.motion(positions[0], self.heading, phase, swing)
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
