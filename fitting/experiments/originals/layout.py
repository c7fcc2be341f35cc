"""The settings of each original: their names, units, and the parameters that they are.

Names are spelled as where they are set: members of ozz's sample (constants of its source among
them), variables of Unreal's character in C++, and fields of Mec's inspector in Unity.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

import jaxik
from fitting.experiments.systems import Preset
from jaxik.maths import parameter_tree


class Unit(NamedTuple):
    """A unit of a setting."""

    name: str
    """Empty for switches."""
    factor: float | tuple[float, float, float] = 1.0
    """Of ours: how many of it are one of ours, for each component of a vector."""


METRES, CENTIMETRES = Unit("m"), Unit("cm", 100.0)
DEGREES, SECONDS, RATE = Unit("deg", 180.0 / math.pi), Unit("s"), Unit("1/s")
PLAIN, SWITCH = Unit("1"), Unit("")
TO_THE_RIGHT = Unit("m", (-1.0, 1.0, 1.0))  # Unity's x; ours is to the left


class Setting(NamedTuple):
    """A setting of an original, and what it is here."""

    name: str
    ours: tuple[str, ...]
    """The parameters that it is; where there are two, they have the same value."""
    unit: Unit


class Original(NamedTuple):
    """A system elsewhere."""

    preset: Preset
    settings: tuple[Setting, ...]
    per_leg: bool
    """Whether feet have settings of their own."""
    has_no_effect: Callable[[jaxik.FootIK], tuple[str, ...]]
    """Names, or their beginnings, of parameters that change nothing in a system."""

    @property
    def parameters(self) -> frozenset[str]:
        """Our names of all that the settings hold."""
        return frozenset(name for setting in self.settings for name in setting.ours)


LIMITS = ("probe.max_step_up", "probe.max_step_down", "probe.max_slope", "probe.step_fade")
SUPPORT = ("probe.min_support", "probe.support_radius")
ROOT = ("root.ray_", "root.layers", "root.half_life", "root.max_")
SPEED_OF_ROOT = ("root.max_speed", "root.max_step")


def _is_on(ik: jaxik.FootIK, name: str) -> bool:
    return bool(np.any(np.asarray(parameter_tree.get(ik, name))))


def _off(ik: jaxik.FootIK) -> tuple[str, ...]:
    """What belongs to something that is switched off, or that no original has."""
    options = parameter_tree.options(ik)
    names = ("warp.",)  # of `Frame.stride_scale`
    names += () if options.get("probe.limited") else LIMITS
    names += () if options.get("probe.check_support") else SUPPORT
    if not _is_on(ik, "root.enabled"):
        return names + ROOT
    return names + (() if _is_on(ik, "root.half_life") else SPEED_OF_ROOT)


def _off_in_ozz(ik: jaxik.FootIK) -> tuple[str, ...]:
    others = ("probe.use_toe", "probe.toe_ls", "pelvis.vertical_only", "pelvis.wait_to_rise")
    return (*_off(ik), *others, "pelvis.tick_hz", "pelvis.off_gain")


def _off_in_mec(ik: jaxik.FootIK) -> tuple[str, ...]:
    by_speed = _is_on(ik, "probe.by_speed")
    return _off(ik) if by_speed else (*_off(ik), "probe.stable_speed")


ORIGINALS = {
    "ozz": Original(
        Preset("ozz", faithful=True),
        (
            Setting("foot_heigh_", ("target.foot_height",), METRES),  # its own spelling
            Setting("weight_", ("leg.weight", "foot.weight"), PLAIN),
            Setting("soften_", ("leg.soften",), PLAIN),
            Setting("auto_character_height_", ("root.enabled",), SWITCH),
            Setting("pelvis_correction_", ("pelvis.enabled",), SWITCH),
            Setting("two_bone_ik_", ("leg.enabled",), SWITCH),
            Setting("aim_ik_", ("foot.enabled",), SWITCH),
            Setting("kCharacterRayHeightOffset.y", ("root.ray_up",), METRES),
            Setting("kFootRayHeightOffset.y", ("probe.ray_up",), METRES),
        ),
        per_leg=False,
        has_no_effect=_off_in_ozz,
    ),
    "unreal": Original(
        Preset("unreal", faithful=True),
        (
            Setting("m_IKCapsuleHalfHeight", ("pelvis.half_height", "probe.ray_up"), CENTIMETRES),
            Setting("m_IKTraceDistance", ("probe.ray_down",), CENTIMETRES),
            Setting("m_IKAdjustFootOffset", ("target.adjust",), CENTIMETRES),
            Setting("m_IKInterpSpeed", ("effector.speed",), RATE),
            Setting("m_IKHipInterpSpeed", ("pelvis.speed",), RATE),
        ),
        per_leg=False,
        has_no_effect=_off,
    ),
    "mec": Original(
        Preset("mec", faithful=True),
        (
            Setting("Plant Foot", ("lock.plant",), SWITCH),
            Setting("IK Hint Offset", ("leg.hint_offset",), TO_THE_RIGHT),
            Setting("Foot Offset Dist", ("probe.ray_up",), METRES),
            Setting("Foot Length", ("probe.foot_length",), METRES),
            Setting("Foot Half Width", ("probe.half_width",), METRES),
            Setting("Foot Height", ("target.foot_height",), METRES),
            Setting("Foot Rotation Limit", ("foot.max_tilt",), DEGREES),
            Setting("Transition Time", ("effector.transition_time",), SECONDS),
            Setting("Extra Ray Distance Check", ("probe.extra",), METRES),
            Setting("Set Extra Ray Distance Check Automatically", ("probe.by_height",), SWITCH),
            Setting("Foot Distance from Ground Threshold", ("probe.stable_height",), METRES),
            Setting("Extra Ray Distance Check Min", ("probe.extra_min",), METRES),
            Setting("Extra Ray Distance Check Max", ("probe.extra_max",), METRES),
            Setting("Adjust Pelvis Vertically", ("pelvis.enabled",), SWITCH),
            Setting("Damp Pelvis", ("pelvis.damp",), SWITCH),
            Setting("Max Leg Length", ("pelvis.max_length",), METRES),
            Setting("Min Leg Length", ("pelvis.min_length",), METRES),
            Setting("Pelvis Adjustment Speed", ("pelvis.speed",), RATE),
            Setting("SetActive", ("probe.active",), SWITCH),  # here and below, functions
            Setting("SetPlantBlendWeight", ("lock.plant_weight",), PLAIN),
        ),
        per_leg=True,
        has_no_effect=_off_in_mec,
    ),
}
