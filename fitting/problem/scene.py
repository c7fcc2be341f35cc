"""The data of one clip: the animation a system runs on, and the motion it should reproduce.

Errors of a capture (where its ground is, when it begins, where its joints are) belong to no system.
Left out of a fit, they pull the system's parameters to wherever these make up for them; fitted with
narrow priors, they have a share of the residuals, and intervals contain the rest.
"""

# pyright: reportInvalidTypeVarUse=false
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

import jaxik
from jaxik.maths.parameter_tree import Declared, Leaf, Rule, parameter
from jaxik.world.body import similar
from jaxik.world.skeleton import Transform
from jaxik.world.terrain import Terrain

GROUND = ("ground_height", "ground_tilt_x", "ground_tilt_z")
SHIFT = "time_shift"
SPREAD = 0.55  # of u: 95 % of such a prior are within half the reach, 2 standard deviations

MEASURED = ("ankle", "knee", "pelvis", "foot", "body")  # kinds that have a noise of their own
WHITENED = (*MEASURED, "contact")  # kinds whose residuals have a correlation from frame to frame
PER_LEG = ("ankle", "knee", "foot", "contact", "smooth")  # kinds that each leg has
# No capture is known better than this: 1 mm, and 0.1 degrees.
LEAST_SIGMAS = {"ankle": 1e-3, "knee": 1e-3, "pelvis": 1e-3, "foot": 0.00175, "body": 0.00175}


def nuisance(default: float, *, unit: str, reach: float, doc: str) -> Declared:
    """Declares an error of a capture, which stays within `reach` of its default.

    The standard deviation of its prior is a quarter of that.
    """
    low, high = default - reach, default + reach
    return parameter(default, unit=unit, low=low, high=high, doc=doc, follows="nothing")


class Capture(Rule):
    """Errors of a capture: numbers of one clip, or of several, (clips).

    Offsets are those of the captured joint from the one of the system's leg, along the axes of the
    foot; both feet of a character share them.
    """

    per_leg: ClassVar[bool] = False

    ground_height: Leaf = nuisance(
        0.0, unit="m", reach=0.08, doc="By how much the ground is higher than its file says."
    )
    ground_tilt_x: Leaf = nuisance(
        0.0, unit="rad", reach=0.07, doc="Angle by which the ground rises along the world's x."
    )
    ground_tilt_z: Leaf = nuisance(
        0.0, unit="rad", reach=0.07, doc="Angle by which the ground rises along the world's z."
    )
    time_shift: Leaf = nuisance(
        0.0, unit="s", reach=0.08, doc="How long after the animation the capture shows a motion."
    )
    ankle_forward: Leaf = nuisance(
        0.0, unit="m", reach=0.08, doc="How far before the ankle the captured one lies."
    )
    ankle_up: Leaf = nuisance(
        0.0, unit="m", reach=0.08, doc="How far above the ankle the captured one lies."
    )
    ankle_outward: Leaf = nuisance(
        0.0, unit="m", reach=0.08, doc="How far outside the ankle the captured one lies."
    )
    ball_up: Leaf = nuisance(
        0.0,
        unit="m",
        reach=0.08,
        doc="How far above the ball the captured one lies, which pitches the captured foot.",
    )
    ball_outward: Leaf = nuisance(
        0.0,
        unit="m",
        reach=0.08,
        doc="How far outside the ball the captured one lies, which turns the captured foot.",
    )
    scale: Leaf = nuisance(
        1.0, unit="1", reach=0.04, doc="Captured lengths over true ones, about the middle."
    )

    def of_clip(self, number: int) -> "Capture":
        """The numbers of one of several clips."""
        return jax.tree.map(lambda values: values[number], self)

    def for_clips(self, count: int) -> "Capture":
        """The same numbers for each of several clips."""
        return jax.tree.map(lambda value: jnp.full(count, value), self)


class Sigmas(eqx.Module):
    """Standard deviations of the residuals, by kind; an infinite one switches its kind off."""

    ankle: Float[Array, ""]
    """Metres."""
    knee: Float[Array, ""]
    """Metres."""
    pelvis: Float[Array, ""]
    """Metres."""
    foot: Float[Array, ""]
    """rad, orientation of the ankle joint."""
    body: Float[Array, ""]
    """rad, orientation of the pelvis."""
    contact: Float[Array, ""]
    """Of the contact weight, 0..1."""
    smooth: Float[Array, ""]
    """m/s², of the ankle's acceleration."""
    correlation: Float[Array, "*#kinds"]
    """AR(1) coefficient between frames, 0 if they are independent: one for all kinds, or one for
    each of `WHITENED`."""

    def correlation_of(self, kind: str) -> Float[Array, "*frames"]:
        """The correlation of the residuals of a kind."""
        frames = self.correlation.shape[:-1]  # one where clips run in a row
        each = jnp.broadcast_to(self.correlation, (*frames, len(WHITENED)))
        return each[..., WHITENED.index(kind)]


class Reference(eqx.Module):
    """The motion that a system should reproduce; world space, frames first."""

    pelvis: Transform
    """Frames."""
    knee_ws: Float[Array, "frames legs 3"]
    ankle: Transform
    """Frames legs."""
    contact: Float[Array, "frames legs"]
    """0 or 1."""
    observed: Bool[Array, " frames"]
    """False where a marker jumped or nothing was captured, and in frames that are held out."""
    held_out: Bool[Array, " frames"]
    """True where the capture was observed, and is not fitted but tests the fit."""
    label: str = eqx.field(static=True, default="captured")
    """Its name in plots."""
    left_out: Bool[Array, "frames legs"] | None = None
    """True where a leg neither is fitted nor tests the fit; None where all legs count."""

    def fitted(self, kind: str) -> Bool[Array, " frames *legs"]:
        """In which frames the residuals of a kind count: for each leg where one is left out."""
        if self.left_out is None or kind not in PER_LEG:
            return self.observed
        return self.observed[:, None] & ~self.left_out


class Place(eqx.Module):
    """Where the clip of a scene is in a world that it shares with others; see `shared_world`."""

    terrain: Terrain
    """The grounds of all clips of the world."""
    offset_ws: Float[Array, "3"]
    """m, by which this clip is moved there."""
    world: int = eqx.field(static=True)
    """Its number."""


class Scene(eqx.Module):
    """One clip: rig, terrain and animation as inputs, and the reference with its sigmas."""

    rig: jaxik.Rig
    terrain: Terrain
    frames: jaxik.Frame
    pelvis: Transform
    """Frames, of the flat animation, model space."""
    reference: Reference
    sigmas: Sigmas
    tracks: dict[str, Array] = eqx.field(default_factory=dict)
    """Parameters that change along the clip, (frames, ...) by dotted name."""
    size: Float[Array, ""] | None = None
    """Leg length over that of the body for which systems are meant; they become `similar`. None
    leaves them as they are."""
    capture: Capture | None = None
    """Errors of the capture; None where it counts as exact."""
    place: Place | None = None
    """In a world shared with other scenes, with which it then runs in one loop; None runs alone."""

    def counts(self, kind: str) -> Bool[Array, "frames columns"]:
        """Where errors of a kind count: of each leg that is present, or one column of the body."""
        fitted = self.reference.fitted(kind)
        columns = fitted.reshape(len(fitted), -1)
        return columns & self.rig.present if kind in PER_LEG else columns


def own_system(ik: jaxik.FootIK, scene: Scene) -> jaxik.FootIK:
    """The system as it is for the body of a scene."""
    return ik if scene.size is None else similar(ik, scene.size)


def animated_legs_ws(scene: Scene) -> jaxik.LegPose:
    """The animated legs, (frames legs), world space."""
    world = scene.frames.world_from_model
    return scene.frames.pose.transformed(Transform(world.pos[:, None], world.rot[:, None]))


def left_alone(scene: Scene) -> Scene:
    """The scene with its animation as the motion that a system should reproduce."""
    legs, reference = animated_legs_ws(scene), scene.reference
    animated = Reference(
        pelvis=scene.frames.world_from_model @ scene.pelvis,
        knee_ws=legs.knee.pos,
        ankle=legs.ankle,
        contact=reference.contact,
        observed=reference.observed | reference.held_out,
        held_out=jnp.zeros_like(reference.held_out),
        label="animated",
        left_out=reference.left_out,
    )
    return eqx.tree_at(lambda scene: scene.reference, scene, animated)


def pelvis_ws(scene: Scene, result: jaxik.Result) -> Transform:
    """The pelvis after the system has moved the body, (frames), world space."""
    return scene.frames.world_from_model @ (result.body @ scene.pelvis)


def legs_ws(scene: Scene, result: jaxik.Result) -> jaxik.LegPose:
    """The solved legs, (frames legs), world space."""
    world = scene.frames.world_from_model
    return result.pose.transformed(Transform(world.pos[:, None], world.rot[:, None]))
