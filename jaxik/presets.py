"""Complete foot-IK systems: four that exist elsewhere, and `stride` for people on uneven ground.

Each function returns a `FootIK` with default parameters; print it to see them. They are those of an
adult of 1.8 m, or with a `rig` those of its body: `jaxik.world.body` says how they follow it. The
four are re-implementations from descriptions and source code, tested against independent NumPy
references.
"""

import dataclasses
import functools
import math

from jaxik.pipeline import FootIK
from jaxik.stages.contact import (
    HeightContact,
    LabelContact,
    SpeedContact,
    StandingContact,
)
from jaxik.stages.effector import (
    BodyEffector,
    DirectEffector,
    FadeEffector,
    HeelEffector,
)
from jaxik.stages.fade import NoFade, SpeedFade
from jaxik.stages.foot import AimFoot, FlatFoot, KeepFoot, PitchRollFoot
from jaxik.stages.lean import NoLean, SlopeLean, SpineLean
from jaxik.stages.leg import PoleLeg, TwoBone
from jaxik.stages.lock import NoLock, OffsetLock, PlantLock
from jaxik.stages.pelvis import CapsulePelvis, LegLengthPelvis, LowestPelvis, ReachPelvis
from jaxik.stages.probe import CornerProbe, FootProbe, RootProbe, StrideProbe
from jaxik.stages.root import GroundRoot, KeepRoot
from jaxik.stages.separation import FootSeparation, NoSeparation
from jaxik.stages.target import RootTarget, SlopeTarget, SoleTarget
from jaxik.stages.warp import StrideWarp
from jaxik.world import body
from jaxik.world.skeleton import Rig

# For locks: floors tilt by 3 cm along a walk, and no lock is to stay in a swing.
STANDING = {"planted_height": 0.09, "raised_height": 0.12, "raised_speed": 0.35}
SlopeFoot = functools.partial(
    PitchRollFoot, max_pitch=1.0, min_pitch=-1.0, max_roll=0.45, min_roll=-0.6
)
"""A foot with limits, rad, within which its sole lies on slopes of 25 degrees."""


def record(rig: Rig | None = None, *, faithful: bool = False) -> FootIK:
    """The foot IK behind a game engine's parameter record.

    Locks standing feet, leans the body on slopes and lowers the pelvis to the lowest standing foot.
    On the flat floor for which an animation was made only the locks change anything.

    Args:
        faithful: whether feet stand and lock by the height of their ankles and the ankles alone are
            held, as the record's fields have it. Feet then also lock while they swing low over the
            ground. If not, they stand while their balls are low and slow, ball and heading are
            held, feet that locks bring together keep apart, and steps of the ground are smoothed.
            `jaxik.record` reads and writes the bytes of the faithful system.
    """
    ik = FootIK(
        root=KeepRoot(),
        warp=StrideWarp(),
        probe=FootProbe(limited=False),
        contact=HeightContact(),
        target=SlopeTarget(),
        lean=SlopeLean(),
        lock=OffsetLock(),
        separation=NoSeparation(),
        pelvis=LowestPelvis(),
        effector=DirectEffector(),
        leg=TwoBone(soften=1.0),  # nothing in the record softens
        foot=PitchRollFoot(),
        fade=NoFade() if faithful else SpeedFade(),
    )
    if not faithful:
        ik = dataclasses.replace(
            ik,
            probe=FootProbe(max_step_up=0.45),  # onto boxes, from the animation's floor
            contact=SpeedContact(**STANDING, half_life=0.03),
            target=SlopeTarget(
                max_ankle_height=1.0,
                rise_half_life=0.02,
                fall_half_life=0.02,
                spring=True,
                follow_slopes=True,
            ),
            lean=SlopeLean(forward_rate=body.pitch_rate(rig, -0.30)),
            lock=OffsetLock(
                hold_ball=True,
                release_max_angle=math.pi,
                release_heading=0.5,
                relock_threshold=0.5,
                unlock_half_life=0.05,
                return_speed=0.6,
            ),
            separation=FootSeparation(),
            pelvis=LowestPelvis(wait_to_rise=True, min_extension=0.36),
            leg=TwoBone(as_animated=True),
            foot=SlopeFoot(),
        )
    return body.scale(ik, rig)


def ozz(rig: Rig | None = None, *, faithful: bool = False) -> FootIK:
    """ozz-animation's foot IK sample, on a root that takes steps without a jump.

    Its four switches are `root.enabled` (character height), `pelvis.enabled`, `leg.enabled`
    (two-bone) and `foot.enabled` (aim). Swinging feet stay on the ground. Only root and fade have
    memory. `probe.use_toe`, `probe.toe_ls`, `pelvis.vertical_only` and `pelvis.wait_to_rise` serve
    other systems and change nothing here.

    Two inaccuracies of ozz 0.16 are not reproduced: with a weight below 1 its aim goes the longer
    way round in 10 to 14 % of cases, and it treats directions within 1.4 mrad of opposed as
    opposed, so that its aim misses by as much. `tests/solvers/test_ozz_golden.py` shows both.

    Args:
        faithful: put the root on the ground at once, as the sample does: nothing has memory then.
    """
    ik = FootIK(
        root=GroundRoot(half_life=0.0, cross_gaps=False) if faithful else GroundRoot(),
        warp=StrideWarp(),
        probe=FootProbe(ray_up=0.5, ray_down=math.inf, use_toe=False, limited=not faithful),
        contact=StandingContact(),
        target=SoleTarget(),
        lean=NoLean(),
        lock=NoLock(),
        separation=NoSeparation(),
        pelvis=LowestPelvis(limit=math.inf, half_life=0.0, airborne_half_life=0.0),
        effector=DirectEffector(if_found=True),
        leg=PoleLeg(),
        foot=AimFoot(),
        fade=NoFade() if faithful else SpeedFade(),
    )
    return body.scale(ik, rig)


def unreal(rig: Rig | None = None, *, faithful: bool = False) -> FootIK:
    """Unreal's foot IK control rig, with its latch.

    It works only while the character stands still: slower than `contact.idle_speed`, which is above
    0 because a captured character sways. As in the original, the
    latch stops all movement once the feet have arrived, which can freeze the pelvis short of its
    goal; better switch `effector.latch` off.

    The root is the bottom of the capsule. The capsule's half-height is needed twice: rays start at
    `probe.ray_up`, and `pelvis.half_height` is what shrinks.

    Args:
        faithful: leave it to the game to keep the capsule on the ground, and take any speed above 0
            for motion, as the original does.
    """
    ik = FootIK(
        root=GroundRoot(enabled=not faithful, cross_gaps=not faithful),
        warp=StrideWarp(),
        probe=RootProbe(limited=not faithful),
        contact=StandingContact(idle_speed=0.0 if faithful else 0.1),
        target=RootTarget(),  # pyright: ignore[reportCallIssue]  # its `foot_height` is a property
        lean=NoLean(),
        lock=NoLock(),
        separation=NoSeparation(),
        pelvis=CapsulePelvis(),
        effector=BodyEffector(latch=True),
        leg=TwoBone(max_knee_angle=math.pi, min_knee_angle=0.0, soften=1.0),
        foot=KeepFoot(),
        fade=NoFade() if faithful else SpeedFade(),
    )
    return body.scale(ik, rig)


def mec(rig: Rig | None = None, *, faithful: bool = False) -> FootIK:
    """Mec Foot Placer, a plug-in for Unity.

    Feet are planted while they are low and slow and their heels are down; else they move as they
    were animated.

    Use `LegTerrains` for feet and hands that each have their own up. All switches and numbers of
    the probe, the lock and the legs can be one value per leg.

    Args:
        rig: whose body it is for; None is the adult.
        faithful: whether, as in the original, every foot is placed and planted where its ray meets
            ground, even while it swings, knees turn to hints over the toes, and it is left to the
            game to keep the character on the ground. If not, knees bend as animated.
    """
    ik = FootIK(
        root=GroundRoot(enabled=not faithful, cross_gaps=not faithful),
        warp=StrideWarp(),
        probe=CornerProbe(limited=False),
        contact=StandingContact(),
        target=SoleTarget(max_slope=0.0, foot_height=0.1),
        lean=NoLean(),
        lock=PlantLock(),
        separation=NoSeparation(),
        pelvis=LegLengthPelvis(),
        effector=FadeEffector(),
        leg=PoleLeg(to_hint=True, allow_stretch=True),
        foot=FlatFoot(),
        fade=NoFade() if faithful else SpeedFade(),
    )
    if not faithful:
        ik = dataclasses.replace(
            ik,
            # A foot that is not stable has ground only once it is 3 cm in it.
            probe=CornerProbe(
                by_speed=True, stable_speed=0.25, stable_height=body.ANKLE + 0.01, extra_min=-0.03
            ),
            contact=SpeedContact(**STANDING),
            target=SoleTarget(max_slope=0.0, foot_height=body.ANKLE),
            lock=PlantLock(release_distance=0.15, release_angle=0.5),
            pelvis=LegLengthPelvis(max_length=body.LEG),
            separation=FootSeparation(),
            leg=PoleLeg(allow_stretch=True),
        )
    return body.scale(ik, rig)


def stride(rig: Rig | None = None, *, foretold: bool = True) -> FootIK:
    """Foot IK that looks ahead to the next foothold: people on uneven ground.

    Each foot goes from the ground of its last foothold to that of its next. The pelvis goes where
    the feet want it, as far as the legs reach, and a trailing heel rises before its leg gets too
    long. A standing foot keeps its ball in place if `lock.enabled` is on.

    Provide `Frame.stride` if the animation's footholds are known; else they are predicted from the
    character's velocity. On the flat floor for which an animation was made nothing changes.
    Feet turn far enough to walk flat on slopes of 25 degrees.

    Args:
        rig: whose body it is for; None is the adult.
        foretold: whether `Frame.stride` tells where feet will stand. If not, that is predicted
            from each swing so far instead of from each frame alone, feet are sent to ground that
            holds them, and go on smoothly where a prediction changes.
    """
    ik = FootIK(
        root=KeepRoot(),
        warp=StrideWarp(),
        probe=StrideProbe(
            max_step_up=0.6,
            max_step_down=0.6,
            max_slope=1.05,
            steepness=1.55,  # with minimum jerk, feet pop by 5 mm more on stairs
            slide_to_support=True,
            remember_swings=not foretold,
        ),
        contact=LabelContact(),
        target=SlopeTarget(max_ankle_height=0.8, absorb_jumps=not foretold),
        lean=SpineLean(pelvis_rate=body.pitch_rate(rig, -0.25)),
        lock=OffsetLock(enabled=False, hold_ball=True),
        separation=FootSeparation(),
        # As smooth as it may be if standing feet are to reach their treads on 500 random stairs.
        pelvis=ReachPelvis(
            softness=0.04,
            # 0.2 s before predicted landings put it 0.7 mm further off captured pelves.
            landing_time=0.2 if foretold else 0.14,
            rise_half_life=0.08,
            fall_half_life=0.041,
            spring=True,
        ),
        effector=HeelEffector(),
        leg=TwoBone(max_knee_angle=math.pi, soften=0.985, as_animated=True),
        foot=SlopeFoot(),
        fade=SpeedFade(),
    )
    return body.scale(ik, rig)
