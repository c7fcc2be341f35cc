"""Whole systems as choices of rules: those that exist elsewhere, and one for human strides."""

import math

from jaxik.pipeline import FootIK
from jaxik.stages.contact import HeightContact, IdleContact, LabelContact, StandingContact
from jaxik.stages.effector import (
    BodyEffector,
    DirectEffector,
    FadeEffector,
    FoundEffector,
    HeelEffector,
)
from jaxik.stages.foot import AimFoot, FlatFoot, KeepFoot, PitchRollFoot
from jaxik.stages.lean import NoLean, SlopeLean
from jaxik.stages.leg import HintLeg, PoleLeg, TwoBone
from jaxik.stages.lock import NoLock, OffsetLock, PlantLock
from jaxik.stages.pelvis import CapsulePelvis, LegLengthPelvis, LowestPelvis, ReachPelvis
from jaxik.stages.probe import CornerProbe, FootProbe, RootProbe
from jaxik.stages.root import GroundRoot, KeepRoot
from jaxik.stages.stride_probe import StrideProbe
from jaxik.stages.target import ContactTarget, RootTarget, SlopeTarget, SoleTarget


def record() -> FootIK:
    """The game's foot-IK parameter record (systems.md, 4), for a 1.8 m adult."""
    return FootIK(
        root=KeepRoot(),
        probe=FootProbe(),
        contact=HeightContact(),
        target=SlopeTarget(),
        lean=SlopeLean(),
        lock=OffsetLock(),
        pelvis=LowestPelvis(),
        effector=DirectEffector(),
        leg=TwoBone(),
        foot=PitchRollFoot(),
    )


def ozz() -> FootIK:
    """ozz-animation's foot-IK sample (systems.md, 1).

    Its four switches are `root.enabled` (character height), `pelvis.enabled`, `leg.enabled`
    (two-bone) and `foot.enabled` (aim). Nothing has memory. `probe.use_toe`, `probe.toe_ls` and
    `pelvis.vertical_only`, which come with rules of the record, change nothing here.

    Not taken over from ozz 0.16: an aim with a weight below 1 goes the longer way round in 10 to
    14 % of cases, and directions within 1.4 mrad of opposed count as opposed, so that the aim
    misses by as much. `tests/test_golden.py` shows both.
    """
    return FootIK(
        root=GroundRoot(),
        probe=FootProbe(ray_up=0.5, ray_down=math.inf, use_toe=False),
        contact=StandingContact(),
        target=SoleTarget(),
        lean=NoLean(),
        lock=NoLock(),
        pelvis=LowestPelvis(limit=math.inf, on_gain=1.0, off_gain=1.0),
        effector=FoundEffector(),
        leg=PoleLeg(),
        foot=AimFoot(),
    )


def unreal() -> FootIK:
    """An Unreal character's foot IK (systems.md, 2), faithful with its latch.

    It works only while the character stands still (`contact.idle_speed`). The latch stops all
    movement once the feet have arrived and may freeze the pelvis short of its goal: better switch
    `effector.latch` off. The root is the bottom of the capsule, whose half-height stands twice:
    `probe.ray_up` is where rays start, `pelvis.half_height` what shrinks. The game puts the capsule
    on the ground; where an animation's root has stayed on its flat floor, `root.enabled` does.
    """
    return FootIK(
        root=GroundRoot(enabled=False),
        probe=RootProbe(),
        contact=IdleContact(),
        target=RootTarget(),  # pyright: ignore[reportCallIssue]  # its `foot_height` is a property
        lean=NoLean(),
        lock=NoLock(),
        pelvis=CapsulePelvis(),
        effector=BodyEffector(latch=True),
        leg=TwoBone(max_knee_angle=math.pi, min_knee_angle=0.0, soften=1.0),
        foot=KeepFoot(),
    )


def mec() -> FootIK:
    """Mec Foot Placer (systems.md, 3).

    Give `LegTerrains` for feet and hands with an up of their own. `active`, the switches and all
    numbers of the probe, the lock and the legs may hold one value a leg. The game puts the
    character on the ground; where an animation's root has stayed on its flat floor,
    `root.enabled` does.
    """
    return FootIK(
        root=GroundRoot(enabled=False),
        probe=CornerProbe(),
        contact=StandingContact(),
        target=ContactTarget(),
        lean=NoLean(),
        lock=PlantLock(),
        pelvis=LegLengthPelvis(),
        effector=FadeEffector(),
        leg=HintLeg(),
        foot=FlatFoot(),
    )


def stride() -> FootIK:
    """Foot IK that knows its next foothold: people on uneven ground.

    Each foot goes from the ground of its last stance to that of its next, the pelvis where the feet
    want it as far as the legs reach, a trailing heel rises before its leg is too long, and a
    standing foot keeps its ball in place if `lock.enabled` asks for it. Give `Frame.stride` where
    the animation knows its footholds; else they follow from the character's velocity. On the flat
    floor for which an animation was made nothing changes.
    """
    return FootIK(
        root=KeepRoot(),
        probe=StrideProbe(),
        contact=LabelContact(),
        target=SlopeTarget(max_ankle_height=0.8),
        lean=NoLean(),
        lock=OffsetLock(enabled=False, hold_ball=True),
        pelvis=ReachPelvis(),
        effector=HeelEffector(),
        leg=TwoBone(max_knee_angle=math.pi, soften=0.985, as_animated=True),
        foot=PitchRollFoot(),
    )
