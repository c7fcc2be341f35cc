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

import jaxik
from jaxik.maths import parameter_tree
from jaxik.maths.parameter_tree import Rule

# Of each rule, or of several, each parameter: its name, unit, default, and both ends of its range.
PUBLISHED = """
HeightContact LabelContact SpeedContact: ground_height m 0 -0.5 0.5
HeightContact: planted_height m 0.1 0 0.4; raised_height m 0.16 0 0.6
StandingContact: idle_speed m/s inf 0 3
SpeedContact: planted_height m 0.075 0 0.4; raised_height m 0.1 0 0.6; planted_speed m/s 0.25 0 1.5;
  raised_speed m/s 0.5 0 3; half_life s 0 0.002 0.5
BodyEffector CapsulePelvis: speed 1/s 15 0.5 30
BodyEffector: latch_distance m 0.01 0 0.05
FadeEffector: transition_time s 0.2 0 1
HeelEffector: extension 1 0.98 0.8 1; max_lift rad 0.6 0 1.2
SpeedFade: speed m/s 0.5 0.1 3
AimFoot: offset m 0,0,0 -0.2 0.2
AimFoot PoleLeg TwoBone: twist rad 0 -1 1; weight 1 1 0 1
PoleLeg TwoBone: max_stretch 1 1.05 1 1.3
AimFoot FlatFoot KeepFoot PitchRollFoot: toe_length m 0.07 0.02 0.15; max_toe_up rad 1 0 1.4;
  max_toe_down rad 0.5 0 1
FlatFoot: max_tilt rad 0.7853982 0 1.5
PitchRollFoot: max_pitch rad 0.52 0 1.4; min_pitch rad -0.79 -1.4 0; max_roll rad 0.26 0 1;
  min_roll rad -0.52 -1 0
SlopeLean: forward_rate 1 -0.3 -1 1; side_rate 1 -0.1 -1 1; forward_rate_slide 1 0.8 -1 1;
  side_rate_slide 1 0.6 -1 1; half_life s 0.1096 0.002 0.5; half_life_slide s 0.06637 0.002 0.5;
  slide_on_half_life s 0.09019 0.002 0.5; slide_off_half_life s 0.1593 0.002 0.5
SpineLean: uphill_rate 1 -0.65 -1 1; downhill_rate 1 -0.25 -1 1; side_rate 1 0 -1 1;
  forward_rate_slide 1 0 -1 1; side_rate_slide 1 0 -1 1; head_share 1 0.5 0 1;
  pelvis_rate 1 -0.25 -1 1; pelvis_side_rate 1 0 -1 1; spacing m 0.3 0.05 2
SpineLean GroundRoot: half_life s 0.2 0.002 0.5
PoleLeg: hint_offset m 0,0,0 -0.5 0.5
PoleLeg: soften 1 1 0.1 1
TwoBone: max_knee_angle rad 3.000053 2 3.141593; min_knee_angle rad 0.6982008 0 1.8;
  soften 1 0.98 0.8 1
OffsetLock: release_min_angle rad 0.8726646 0 1.8; release_max_angle rad 3.001966 2 3.141593;
  release_cone rad 0.4363323 0 1.5; release_distance m 0.2 0 0.5;
  release_heading rad 3.141593 0.1 3.141593; release_speed m/s inf 0 3; relock_threshold 1 0.2 0 1;
  max_speed m/s inf 0 3; lock_half_life s 0.05 0.002 0.5; unlock_half_life s 0.1 0.002 0.5;
  return_speed m/s inf 0.1 3
PlantLock: plant_weight 1 1 0 1; plant_speed 1/s inf 0.1 20; release_distance m inf 0 0.5;
  release_angle rad 3.141593 0.1 3.141593; release_time s 0.3 0.05 1
CapsulePelvis: half_height m 0.9 0.3 2
LegLengthPelvis: min_length m 0.5 0 1; max_length m 0.88 0.2 1.5; speed 1/s 10 0.5 30
LowestPelvis: limit m 0.3 0 0.6; half_life s 0.09065 0.002 0.5;
  airborne_half_life s 0.1874 0.002 0.5; min_extension 1 0 0 0.8
ReachPelvis: highest_share 1 0.75 0 1.2; extension 1 0.958 0.85 1; softness m 0.025 0.002 0.1;
  shift 1 0.15 0 1; landing_time s 0 0.02 0.3; rise_speed m/s 0.3 0.05 3
ReachPelvis SlopeTarget: rise_half_life s 0 0.002 0.5; fall_half_life s 0 0.002 0.5
SupportPelvis: lowest_share 1 0.3 0 1; rise_half_life s 0.1 0.002 0.5;
  fall_half_life s 0.1 0.002 0.5
CornerProbe FootProbe RootProbe StrideProbe: max_step_up m 0.3 0.1 1;
  max_step_down m 0.4 0.1 1; max_slope rad 0.785 0.1 1.5; min_support 1 0.5 0 1;
  support_radius m 0.04 0.01 0.15
CornerProbe FootProbe: ray_up m 0.5 0 2
FootProbe: ray_down m 0.8 0 2
CornerProbe: foot_length m 0.2 0.02 0.5; half_width m 0.05 0.01 0.2; extra m 0.2 0 1;
  extra_min m 0 0 1; extra_max m 0.3 0 1; stable_height m 0.12 0 0.5; stable_speed m/s 0.5 0 3
FootProbe: toe_ls m 0,-0.07,0.2 -0.4 0.4
RootProbe: ray_up m 0.9 0 2; ray_down m 0.5 0 2
StrideProbe: ray_up m 1 0 2; ray_down m 1 0 2; rise_start 1 0 0 0.45; rise_end 1 1 0.55 1;
  steepness 1 1.875 1 4; clearance m 0 -0.1 0.1; heel_length m 0.07 0 0.2;
  toe_length m 0.04 0 0.2; ball_height m 0.055 0 0.15; held_lift 1 0.6 0 1;
  toe_clearance m 0.03 0 0.15; lift_per_rise 1 0.5 0 1.5; lift_ahead 1 0.85 0 2;
  lift_per_fall 1 0.35 0 1.5; lift_over 1 1.7 0 3; toes_up rad 0.1 0 0.6; toes_down rad 0.3 0 0.8;
  toes_down_per_height rad/m 0.9 0 3; toes_first rad/m 0.5 0 2; min_sole 1 0.65 0 1;
  max_slide m 0.1 0 0.2; stance_time s 0.65 0.2 1.5; swing_time s 0.55 0.1 1
GroundRoot: ray_up m 10 0 20; ray_down m inf 0 20; max_speed m/s 4 0.5 10; max_step m 0.4 0.1 1
FootSeparation: distance m 0.1 0 0.3; half_life s 0.04 0.002 0.5
RootTarget: adjust m 0 -0.1 0.1
SlopeTarget: min_ankle_height m -0.3 -1 0.5; max_ankle_height m 0.55 0 1.5;
  foot_height m 0.08 0 0.2; max_slope rad 1.047198 0.1 1.5; max_penetration m inf 0 0.2
SoleTarget: foot_height m 0.12 0 0.2; max_slope rad 1.5 0.1 1.5
StrideWarp: min_scale 1 0.4 0 1; max_scale 1 1.5 1 2.5; width 1 1 0 1;
  max_angle rad 1.5 0 1.570796; pelvis_share 1 0.5 0 1; half_life s 0.1 0.002 0.5
"""

# Of each preset, `!` where it is faithful to the original: the rules in the order of the stages,
# with what is other than their defaults.
PRESETS = """
record: SpeedContact planted_height=0.09 raised_height=0.12 raised_speed=0.35 half_life=0.03;
  KeepRoot; StrideWarp; FootProbe max_step_up=0.45;
  SlopeTarget max_ankle_height=1 rise_half_life=0.02 fall_half_life=0.02
  spring=yes follow_slopes=yes;
  SlopeLean;
  OffsetLock hold_ball=yes release_max_angle=3.14159 release_heading=0.5 relock_threshold=0.5
  unlock_half_life=0.05 return_speed=0.6;
  FootSeparation; LowestPelvis wait_to_rise=yes min_extension=0.36; DirectEffector;
  TwoBone as_animated=yes;
  PitchRollFoot max_pitch=1 min_pitch=-1 max_roll=0.45 min_roll=-0.6; SpeedFade
record!: HeightContact; KeepRoot; StrideWarp; FootProbe limited=no; SlopeTarget; SlopeLean;
  OffsetLock; NoSeparation; LowestPelvis; DirectEffector; TwoBone soften=1; PitchRollFoot; NoFade
ozz: StandingContact; GroundRoot; StrideWarp; FootProbe ray_down=inf use_toe=no; SoleTarget; NoLean;
  NoLock; NoSeparation; LowestPelvis limit=inf half_life=0 airborne_half_life=0;
  DirectEffector if_found=yes; PoleLeg; AimFoot; SpeedFade
ozz!: StandingContact; GroundRoot half_life=0 cross_gaps=no; StrideWarp;
  FootProbe limited=no ray_down=inf use_toe=no; SoleTarget; NoLean; NoLock; NoSeparation;
  LowestPelvis limit=inf half_life=0 airborne_half_life=0;
  DirectEffector if_found=yes; PoleLeg; AimFoot; NoFade
unreal: StandingContact idle_speed=0.1; GroundRoot; StrideWarp; RootProbe; RootTarget; NoLean;
  NoLock; NoSeparation; CapsulePelvis; BodyEffector latch=yes;
  TwoBone max_knee_angle=3.14159 min_knee_angle=0 soften=1; KeepFoot; SpeedFade
unreal!: StandingContact idle_speed=0; GroundRoot enabled=no cross_gaps=no; StrideWarp;
  RootProbe limited=no; RootTarget; NoLean; NoLock; NoSeparation; CapsulePelvis;
  BodyEffector latch=yes; TwoBone max_knee_angle=3.14159 min_knee_angle=0 soften=1; KeepFoot; NoFade
mec: SpeedContact planted_height=0.09 raised_height=0.12 raised_speed=0.35; GroundRoot; StrideWarp;
  CornerProbe by_speed=yes extra_min=-0.03 stable_height=0.095 stable_speed=0.25;
  SoleTarget max_slope=0 foot_height=0.085; NoLean;
  PlantLock release_distance=0.15 release_angle=0.5; FootSeparation;
  LegLengthPelvis max_length=0.84; FadeEffector; PoleLeg allow_stretch=yes; FlatFoot; SpeedFade
mec!: StandingContact; GroundRoot enabled=no cross_gaps=no; StrideWarp; CornerProbe limited=no;
  SoleTarget max_slope=0 foot_height=0.1; NoLean; PlantLock; NoSeparation; LegLengthPelvis;
  FadeEffector; PoleLeg to_hint=yes allow_stretch=yes; FlatFoot; NoFade
stride: LabelContact; KeepRoot; StrideWarp;
  StrideProbe max_step_up=0.6 max_step_down=0.6 max_slope=1.05 steepness=1.55
  slide_to_support=yes;
  SlopeTarget max_ankle_height=0.8; SpineLean; OffsetLock enabled=no hold_ball=yes; FootSeparation;
  ReachPelvis softness=0.04 landing_time=0.2 rise_half_life=0.08 fall_half_life=0.041
  spring=yes; HeelEffector;
  TwoBone max_knee_angle=3.14159 soften=0.985 as_animated=yes;
  PitchRollFoot max_pitch=1 min_pitch=-1 max_roll=0.45 min_roll=-0.6; SpeedFade
"""
WORDS = {"yes": 1.0, "no": 0.0}

SWITCHES = """
AimFoot.bend_toes=no AimFoot.enabled=yes BodyEffector.by_contact=no BodyEffector.latch=no
CapsulePelvis.enabled=yes
CornerProbe.active=yes CornerProbe.by_height=yes CornerProbe.by_speed=no
CornerProbe.check_support=no
CornerProbe.simple_in_flight=no CornerProbe.limited=yes DirectEffector.by_contact=no
DirectEffector.if_found=no
FadeEffector.by_contact=no FlatFoot.bend_toes=no FootProbe.check_support=no
FootProbe.simple_in_flight=no
FootProbe.limited=yes FootProbe.use_toe=yes
GroundRoot.cross_gaps=yes GroundRoot.enabled=yes HeelEffector.by_contact=no
LegLengthPelvis.damp=yes LegLengthPelvis.enabled=yes LowestPelvis.enabled=yes
LowestPelvis.vertical_only=yes LowestPelvis.wait_to_rise=no OffsetLock.enabled=yes
OffsetLock.hold_ball=no PlantLock.plant=yes KeepFoot.bend_toes=no
PitchRollFoot.bend_toes=no PoleLeg.allow_stretch=no PoleLeg.enabled=yes
PoleLeg.to_hint=no ReachPelvis.spring=no
RootProbe.check_support=no
RootProbe.simple_in_flight=no RootProbe.limited=yes SlopeLean.spring=no SlopeTarget.follow_slopes=no
SlopeTarget.absorb_jumps=no
SlopeTarget.spring=no SpineLean.spring=no StrideProbe.check_support=no
StrideProbe.simple_in_flight=no StrideProbe.limited=yes
StrideProbe.remember_swings=no StrideProbe.slide_to_support=no StrideProbe.swing_as_animated=no
StrideProbe.use_strides=yes
SupportPelvis.spring=no TwoBone.allow_stretch=no TwoBone.as_animated=no
"""


def entries_of(table: str) -> Iterator[tuple[str, list[list[str]]]]:
    """The heading of each paragraph of a table, and its entries, divided into words."""
    for paragraph in table.strip().replace("\n  ", " ").splitlines():
        heading, _, entries = paragraph.partition(": ")
        yield heading, [entry.split() for entry in entries.split("; ")]


def rules() -> Iterator[Rule]:
    """Every rule of the package, with its defaults."""
    for module in pkgutil.walk_packages(jaxik.__path__, "jaxik."):
        for member in vars(importlib.import_module(module.name)).values():
            own = inspect.isclass(member) and member.__module__ == module.name
            if own and issubclass(member, Rule) and not inspect.isabstract(member):
                if member is not jaxik.FootIK:
                    yield member()


def test_defaults_and_ranges_are_those_that_are_published():
    published = {
        f"{rule}.{name}": numbers
        for rules, entries in entries_of(PUBLISHED)
        for rule in rules.split()
        for name, *numbers in entries
    }
    actual = {}
    for rule in rules():
        for name, declared in parameter_tree.declarations(rule).items():
            values = parameter_tree.get(rule, name), declared.low, declared.high
            texts = [",".join(f"{x:.7g}" for x in np.ravel(each)) for each in values]
            actual[f"{type(rule).__name__}.{name}"] = [declared.unit, *texts]
    assert actual == published


def test_switches_are_as_they_are_published():
    switches = {
        f"{type(rule).__name__}.{field.name}={'yes' if np.all(getattr(rule, field.name)) else 'no'}"
        for rule in rules()
        for field in dataclasses.fields(rule)
        if np.asarray(getattr(rule, field.name)).dtype == bool
    }
    assert switches == set(SWITCHES.split())


def test_presets_consist_of_the_rules_and_numbers_that_are_published():
    published = dict(entries_of(PRESETS))
    assert "stride!" not in published
    assert "faithful" not in inspect.signature(jaxik.presets.stride).parameters
    for name, entries in published.items():
        preset = getattr(jaxik.presets, name.removesuffix("!"))
        ik = preset(faithful=True) if name.endswith("!") else preset()
        stages = [field.name for field in dataclasses.fields(ik)]
        for stage, (rule_name, *changes) in zip(stages, entries, strict=True):
            rule = getattr(ik, stage)
            assert type(rule).__name__ == rule_name, (name, stage)
            expected = dict(change.split("=") for change in changes)
            for field in dataclasses.fields(rule):
                value, usual = (np.ravel(getattr(x, field.name)) for x in (rule, type(rule)()))
                text = expected.pop(field.name, None)
                wanted = usual if text is None else WORDS.get(text, text)
                message = f"{name}: {stage}.{field.name}"
                np.testing.assert_allclose(value, np.array(wanted, float), 1e-5, err_msg=message)
            assert not expected, (name, stage)
