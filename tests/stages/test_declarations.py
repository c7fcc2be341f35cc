"""The numbers of all rules, as they are published: defaults, and the ranges that fits search.

A range is a prior: what changes one changes what every fit finds, and kept fits and experiments no
longer mean the same. So a change is made here too, on purpose, and gets a line in the changelog.
The values themselves are judged elsewhere: `tests/pipeline` compares them with the descriptions of
the systems, `tests/studies` with what they do.
"""

import dataclasses
import importlib
import inspect
import pkgutil
from collections.abc import Iterator

import numpy as np
import pytest

import jaxik
from jaxik.maths import parameter_tree
from jaxik.maths.parameter_tree import Rule

# Of each parameter: its name, unit, default, and the low and high end of its range.
WORDS = {"yes": 1.0, "no": 0.0}
PUBLISHED = """
HeightContact.ground_height m 0 -0.5 0.5
HeightContact.planted_height m 0.1 0 0.4
HeightContact.raised_height m 0.16 0 0.6
IdleContact.idle_speed m/s 0 0 3
LabelContact.ground_height m 0 -0.5 0.5
SpeedContact.ground_height m 0 -0.5 0.5
SpeedContact.planted_height m 0.075000003 0 0.4
SpeedContact.raised_height m 0.1 0 0.6
SpeedContact.planted_speed m/s 0.25 0 1.5
SpeedContact.raised_speed m/s 0.5 0 3
SpeedContact.half_life s 0 0.002 0.5
BodyEffector.speed 1/s 15 0.5 30
BodyEffector.latch_distance m 0.0099999998 0 0.05
FadeEffector.transition_time s 0.2 0 1
HeelEffector.extension 1 0.98000002 0.8 1
HeelEffector.max_lift rad 0.60000002 0 1.2
SpeedFade.speed m/s 0.5 0.1 3
AimFoot.offset m 0,0,0 -0.2 0.2
AimFoot.twist rad 0 -1 1
AimFoot.weight 1 1 0 1
FlatFoot.max_tilt rad 0.78539819 0 1.5
PitchRollFoot.max_pitch rad 0.51999998 0 1.4
PitchRollFoot.min_pitch rad -0.79000002 -1.4 0
PitchRollFoot.max_roll rad 0.25999999 0 1
PitchRollFoot.min_roll rad -0.51999998 -1 0
SlopeLean.forward_rate 1 -0.30000001 -1 1
SlopeLean.side_rate 1 -0.1 -1 1
SlopeLean.forward_rate_slide 1 0.80000001 -1 1
SlopeLean.side_rate_slide 1 0.60000002 -1 1
SlopeLean.gain 1/tick 0.19 0.01 0.95
SlopeLean.gain_slide 1/tick 0.294 0.01 0.95
SlopeLean.slide_on_gain 1/tick 0.226 0.01 0.95
SlopeLean.slide_off_gain 1/tick 0.13500001 0.01 0.95
SpineLean.uphill_rate 1 -0.64999998 -1 1
SpineLean.downhill_rate 1 -0.25 -1 1
SpineLean.side_rate 1 0 -1 1
SpineLean.forward_rate_slide 1 0 -1 1
SpineLean.side_rate_slide 1 0 -1 1
SpineLean.head_share 1 0.5 0 1
SpineLean.pelvis_rate 1 -0.25 -1 1
SpineLean.pelvis_side_rate 1 0 -1 1
SpineLean.spacing m 0.30000001 0.05 2
SpineLean.half_life s 0.2 0.002 0.5
HintLeg.hint_offset m 0,0,0 -0.5 0.5
HintLeg.soften 1 1 0.1 1
HintLeg.twist rad 0 -1 1
HintLeg.weight 1 1 0 1
PoleLeg.soften 1 1 0.1 1
PoleLeg.twist rad 0 -1 1
PoleLeg.weight 1 1 0 1
TwoBone.max_knee_angle rad 3.0000532 2 3.1415927
TwoBone.min_knee_angle rad 0.69820082 0 1.8
TwoBone.soften 1 0.98000002 0.8 1
TwoBone.twist rad 0 -1 1
TwoBone.weight 1 1 0 1
OffsetLock.release_min_angle rad 0.87266463 0 1.8
OffsetLock.release_max_angle rad 3.0019662 2 3.1415927
OffsetLock.release_cone rad 0.43633232 0 1.5
OffsetLock.release_distance m 0.2 0 0.5
OffsetLock.release_heading rad 3.1415927 0.1 3.1415927
OffsetLock.release_speed m/s inf 0 3
OffsetLock.relock_threshold 1 0.2 0 1
OffsetLock.max_speed m/s inf 0 3
OffsetLock.lock_half_life s 0.050000001 0.002 0.5
OffsetLock.unlock_half_life s 0.1 0.002 0.5
OffsetLock.return_speed m/s inf 0.1 3
PlantLock.plant_weight 1 1 0 1
PlantLock.plant_speed 1/s inf 0.1 20
CapsulePelvis.speed 1/s 15 0.5 30
CapsulePelvis.half_height m 0.89999998 0.3 2
LegLengthPelvis.min_length m 0.5 0 1
LegLengthPelvis.max_length m 0.88 0.2 1.5
LegLengthPelvis.speed 1/s 10 0.5 30
LowestPelvis.limit m 0.30000001 0 0.6
LowestPelvis.on_gain 1/tick 0.22499999 0.01 0.95
LowestPelvis.off_gain 1/tick 0.116 0.01 0.95
ReachPelvis.highest_share 1 0.75 0 1.2
ReachPelvis.extension 1 0.958 0.85 1
ReachPelvis.softness m 0.025 0.002 0.1
ReachPelvis.shift 1 0.15000001 0 1
ReachPelvis.rise_half_life s 0 0.002 0.5
ReachPelvis.fall_half_life s 0 0.002 0.5
SupportPelvis.lowest_share 1 0.30000001 0 1
SupportPelvis.rise_half_life s 0.1 0.002 0.5
SupportPelvis.fall_half_life s 0.1 0.002 0.5
SweepProbe.max_step_up m 0.30000001 0.1 1
SweepProbe.max_step_down m 0.40000001 0.1 1
SweepProbe.max_slope rad 0.78500003 0.1 1.5
SweepProbe.min_support 1 0.5 0 1
SweepProbe.support_radius m 0.039999999 0.01 0.15
SweepProbe.ray_up m 0.5 0 2
SweepProbe.ray_down m 0.80000001 0 2
SweepProbe.radius m 0.039999999 0.01 0.1
SweepProbe.toe_length m 0.15000001 0 0.25
SweepProbe.heel_length m 0.029999999 0 0.15
CornerProbe.max_step_up m 0.30000001 0.1 1
CornerProbe.max_step_down m 0.40000001 0.1 1
CornerProbe.max_slope rad 0.78500003 0.1 1.5
CornerProbe.min_support 1 0.5 0 1
CornerProbe.support_radius m 0.039999999 0.01 0.15
CornerProbe.ray_up m 0.5 0 2
CornerProbe.foot_length m 0.2 0.02 0.5
CornerProbe.half_width m 0.050000001 0.01 0.2
CornerProbe.extra m 0.2 0 1
CornerProbe.extra_min m 0 0 1
CornerProbe.extra_max m 0.30000001 0 1
CornerProbe.stable_height m 0.12 0 0.5
CornerProbe.stable_speed m/s 0.5 0 3
FootProbe.max_step_up m 0.30000001 0.1 1
FootProbe.max_step_down m 0.40000001 0.1 1
FootProbe.max_slope rad 0.78500003 0.1 1.5
FootProbe.min_support 1 0.5 0 1
FootProbe.support_radius m 0.039999999 0.01 0.15
FootProbe.ray_up m 0.5 0 2
FootProbe.ray_down m 0.80000001 0 2
FootProbe.toe_ls m 0,-0.07,0.2 -0.4 0.4
RootProbe.max_step_up m 0.30000001 0.1 1
RootProbe.max_step_down m 0.40000001 0.1 1
RootProbe.max_slope rad 0.78500003 0.1 1.5
RootProbe.min_support 1 0.5 0 1
RootProbe.support_radius m 0.039999999 0.01 0.15
RootProbe.ray_up m 0.89999998 0 2
RootProbe.ray_down m 0.5 0 2
StrideProbe.max_step_up m 0.30000001 0.1 1
StrideProbe.max_step_down m 0.40000001 0.1 1
StrideProbe.max_slope rad 0.78500003 0.1 1.5
StrideProbe.min_support 1 0.5 0 1
StrideProbe.support_radius m 0.039999999 0.01 0.15
StrideProbe.ray_up m 1 0 2
StrideProbe.ray_down m 1 0 2
StrideProbe.rise_start 1 0 0 0.45
StrideProbe.rise_end 1 1 0.55 1
StrideProbe.steepness 1 1.875 1 4
StrideProbe.clearance m 0 -0.1 0.1
StrideProbe.way_slope 1 1.5 0.2 5
StrideProbe.heel_length m 0.07 0 0.2
StrideProbe.toe_length m 0.039999999 0 0.2
StrideProbe.ball_height m 0.055 0 0.15
StrideProbe.held_lift 1 0.60000002 0 1
StrideProbe.toe_clearance m 0.029999999 0 0.15
StrideProbe.lift_per_rise 1 0.5 0 1.5
StrideProbe.lift_per_fall 1 0.34999999 0 1.5
StrideProbe.lift_over 1 1.7 0 3
StrideProbe.toes_up rad 0.1 0 0.60000002
StrideProbe.toes_down rad 0.30000001 0 0.80000001
StrideProbe.toes_down_per_height rad/m 0.89999998 0 3
StrideProbe.toes_first rad/m 0.5 0 2
StrideProbe.min_sole 1 0.64999998 0 1
StrideProbe.max_slide m 0.1 0 0.2
StrideProbe.stance_time s 0.64999998 0.2 1.5
StrideProbe.swing_time s 0.44999999 0.1 1
GroundRoot.ray_up m 10 0 20
GroundRoot.ray_down m inf 0 20
GroundRoot.half_life s 0.2 0.002 0.5
GroundRoot.max_speed m/s 4 0.5 10
GroundRoot.max_step m 0.40000001 0.1 1
FootSeparation.distance m 0.1 0 0.3
FootSeparation.half_life s 0.039999999 0.002 0.5
ContactTarget.foot_height m 0.1 0 0.2
RootTarget.adjust m 0 -0.1 0.1
SlopeTarget.min_ankle_height m -0.30000001 -1 0.5
SlopeTarget.max_ankle_height m 0.55000001 0 1.5
SlopeTarget.foot_height m 0.079999998 0 0.2
SlopeTarget.max_slope rad 1.0471976 0.1 1.5
SlopeTarget.rise_half_life s 0 0.002 0.5
SlopeTarget.fall_half_life s 0 0.002 0.5
SoleTarget.foot_height m 0.12 0 0.2
SoleTarget.max_slope rad 1.5 0.1 1.5
StrideWarp.min_scale 1 0.40000001 0 1
StrideWarp.max_scale 1 1.5 1 2.5
StrideWarp.width 1 1 0 1
"""

# Of each stage of each preset, `!` where it is faithful to the original: the rule,
# and what is other than its default.
PRESETS = """
record contact SpeedContact planted_height=0.09 raised_height=0.12 raised_speed=0.35 \
    half_life=0.03
record root KeepRoot
record warp StrideWarp
record probe FootProbe max_step_up=0.33
record target SlopeTarget max_ankle_height=1 rise_half_life=0.02 fall_half_life=0.02 \
    spring=yes follow_slopes=yes
record lean SlopeLean
record lock OffsetLock hold_ball=yes release_max_angle=3.14159 release_heading=0.5 \
    relock_threshold=0.5 unlock_half_life=0.05 return_speed=0.6
record separation FootSeparation
record pelvis LowestPelvis wait_to_rise=yes
record effector DirectEffector
record leg TwoBone as_animated=yes
record foot PitchRollFoot max_pitch=0.8 min_pitch=-1 max_roll=0.45 min_roll=-0.6
record fade SpeedFade
record! contact HeightContact
record! root KeepRoot
record! warp StrideWarp
record! probe FootProbe limited=no
record! target SlopeTarget
record! lean SlopeLean
record! lock OffsetLock
record! separation NoSeparation
record! pelvis LowestPelvis
record! effector DirectEffector
record! leg TwoBone
record! foot PitchRollFoot
record! fade NoFade
ozz contact StandingContact
ozz root GroundRoot
ozz warp StrideWarp
ozz probe FootProbe ray_down=inf use_toe=no
ozz target SoleTarget
ozz lean NoLean
ozz lock NoLock
ozz separation NoSeparation
ozz pelvis LowestPelvis limit=inf on_gain=1 off_gain=1
ozz effector FoundEffector
ozz leg PoleLeg
ozz foot AimFoot
ozz fade SpeedFade
ozz! contact StandingContact
ozz! root GroundRoot half_life=0
ozz! warp StrideWarp
ozz! probe FootProbe limited=no ray_down=inf use_toe=no
ozz! target SoleTarget
ozz! lean NoLean
ozz! lock NoLock
ozz! separation NoSeparation
ozz! pelvis LowestPelvis limit=inf on_gain=1 off_gain=1
ozz! effector FoundEffector
ozz! leg PoleLeg
ozz! foot AimFoot
ozz! fade NoFade
unreal contact IdleContact
unreal root GroundRoot
unreal warp StrideWarp
unreal probe RootProbe
unreal target RootTarget
unreal lean NoLean
unreal lock NoLock
unreal separation NoSeparation
unreal pelvis CapsulePelvis
unreal effector BodyEffector latch=yes
unreal leg TwoBone max_knee_angle=3.14159 min_knee_angle=0 soften=1
unreal foot KeepFoot
unreal fade SpeedFade
unreal! contact IdleContact
unreal! root GroundRoot enabled=no
unreal! warp StrideWarp
unreal! probe RootProbe limited=no
unreal! target RootTarget
unreal! lean NoLean
unreal! lock NoLock
unreal! separation NoSeparation
unreal! pelvis CapsulePelvis
unreal! effector BodyEffector latch=yes
unreal! leg TwoBone max_knee_angle=3.14159 min_knee_angle=0 soften=1
unreal! foot KeepFoot
unreal! fade NoFade
mec contact SpeedContact planted_height=0.09 raised_height=0.12 raised_speed=0.35
mec root GroundRoot
mec warp StrideWarp
mec probe CornerProbe by_speed=yes extra_min=-0.03 stable_height=0.095 stable_speed=0.25
mec target ContactTarget foot_height=0.085
mec lean NoLean
mec lock PlantLock
mec separation FootSeparation
mec pelvis LegLengthPelvis
mec effector FadeEffector
mec leg PoleLeg
mec foot FlatFoot
mec fade SpeedFade
mec! contact StandingContact
mec! root GroundRoot enabled=no
mec! warp StrideWarp
mec! probe CornerProbe limited=no
mec! target ContactTarget
mec! lean NoLean
mec! lock PlantLock
mec! separation NoSeparation
mec! pelvis LegLengthPelvis
mec! effector FadeEffector
mec! leg HintLeg
mec! foot FlatFoot
mec! fade NoFade
stride contact LabelContact
stride root KeepRoot
stride warp StrideWarp
stride probe StrideProbe max_step_up=0.6 max_step_down=0.6 max_slope=1.05 slide_to_support=yes
stride target SlopeTarget max_ankle_height=0.8
stride lean SpineLean
stride lock OffsetLock enabled=no hold_ball=yes
stride separation FootSeparation
stride pelvis ReachPelvis rise_half_life=0.04 fall_half_life=0.04 spring=yes
stride effector HeelEffector
stride leg TwoBone max_knee_angle=3.14159 soften=0.985 as_animated=yes
stride foot PitchRollFoot max_pitch=0.8 min_pitch=-1 max_roll=0.45 min_roll=-0.6
stride fade SpeedFade
"""

SWITCHES = """
AimFoot.enabled=yes BodyEffector.by_contact=no BodyEffector.latch=no CapsulePelvis.enabled=yes
CornerProbe.active=yes CornerProbe.by_height=yes CornerProbe.by_speed=no
CornerProbe.check_support=no CornerProbe.limited=yes DirectEffector.by_contact=no
FadeEffector.by_contact=no FootProbe.check_support=no FootProbe.limited=yes FootProbe.use_toe=yes
FoundEffector.by_contact=no GroundRoot.enabled=yes HeelEffector.by_contact=no
LegLengthPelvis.damp=yes LegLengthPelvis.enabled=yes LowestPelvis.enabled=yes
LowestPelvis.vertical_only=yes LowestPelvis.wait_to_rise=no OffsetLock.enabled=yes
OffsetLock.hold_ball=no PlantLock.plant=yes PoleLeg.enabled=yes ReachPelvis.spring=no
RootProbe.check_support=no RootProbe.limited=yes SlopeLean.spring=no SlopeTarget.follow_slopes=no
SlopeTarget.spring=no SpineLean.spring=no StrideProbe.check_support=no StrideProbe.limited=yes
StrideProbe.remember_swings=no StrideProbe.slide_to_support=no StrideProbe.swing_as_animated=no
StrideProbe.use_strides=yes
SupportPelvis.spring=no SweepProbe.check_support=no SweepProbe.limited=yes TwoBone.as_animated=no
"""


def rules() -> Iterator[Rule]:
    """Every rule of the package, with its defaults."""
    for module in pkgutil.walk_packages(jaxik.__path__, "jaxik."):
        members = vars(importlib.import_module(module.name)).values()
        for member in members:
            if inspect.isclass(member) and member.__module__ == module.name:
                if issubclass(member, Rule) and not inspect.isabstract(member):
                    if member is not jaxik.FootIK:
                        yield member()


def test_defaults_and_ranges_are_those_that_are_published():
    rows = [line.split() for line in PUBLISHED.splitlines()[1:]]
    published = {name: (unit, default, low, high) for name, unit, default, low, high in rows}
    names = set()
    for rule in rules():
        for name, declared in parameter_tree.declarations(rule).items():
            names.add(full_name := f"{type(rule).__name__}.{name}")
            unit, default, low, high = published[full_name]
            assert declared.unit == unit, full_name
            ends = [float(low), float(high)]
            np.testing.assert_allclose(
                (declared.low, declared.high), ends, 1e-6, 0, err_msg=full_name
            )
            expected = np.array(default.split(","), float)
            value = np.ravel(parameter_tree.get(rule, name))
            np.testing.assert_allclose(value, expected, rtol=1e-6, err_msg=full_name)
    assert names == published.keys()


def test_switches_are_as_they_are_published():
    switches = {
        f"{type(rule).__name__}.{field.name}={'yes' if np.all(getattr(rule, field.name)) else 'no'}"
        for rule in rules()
        for field in dataclasses.fields(rule)
        if np.asarray(getattr(rule, field.name)).dtype == bool
    }
    assert switches == set(SWITCHES.split())


@pytest.mark.parametrize("name", ["record", "ozz", "unreal", "mec", "stride"])
@pytest.mark.parametrize("faithful", [False, True])
def test_presets_consist_of_the_rules_and_numbers_that_are_published(name, faithful):
    preset = getattr(jaxik.presets, name)
    mark = name + "!" * faithful
    rows = [line.split() for line in PRESETS.strip().splitlines()]
    published = {stage: (rule, changes) for key, stage, rule, *changes in rows if key == mark}
    if not published:
        assert "faithful" not in inspect.signature(preset).parameters
        return
    ik = preset(faithful=True) if faithful else preset()
    assert published.keys() == {field.name for field in dataclasses.fields(ik)} - {"per_leg"}
    for stage, (rule_name, changes) in published.items():
        rule = getattr(ik, stage)
        assert type(rule).__name__ == rule_name, stage
        default = type(rule)()
        expected = {key: text for key, _, text in (change.partition("=") for change in changes)}
        for field in dataclasses.fields(rule):
            value, usual = (np.ravel(getattr(x, field.name)) for x in (rule, default))
            text = expected.get(field.name)
            wanted = usual if text is None else WORDS.get(text, text)
            np.testing.assert_allclose(value, np.array(wanted, float), 1e-5, err_msg=stage)
